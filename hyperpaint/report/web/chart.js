// Curves over wavelength as SVG. A curve: {name, nm, values, sd?, good?, look}; texts are only ever text.

const SVG = "http://www.w3.org/2000/svg";
const [LEFT, RIGHT, TOP, BOTTOM] = [56, 20, 8, 38];

function element(name, attributes, ...children) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// Return round numbers, some five of them, between two.
function ticks(low, high, most) {
  const rough = (high - low) / most || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((digit) => digit * power).find((each) => each >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Array.from({ length: count }, (_, k) => [(first + k) * step, ((first + k) * step).toFixed(digits)]);
}

export const isShown = (curve, band) => Number.isFinite(curve.values[band]) && (!curve.good || curve.good[band]);

function limits(curves, spread) {
  let [left, right, low, high] = [Infinity, -Infinity, 0, 0];
  for (const curve of curves) {
    for (let band = 0; band < curve.nm.length; band += 1) {
      if (!isShown(curve, band)) continue;
      left = Math.min(left, curve.nm[band]);
      right = Math.max(right, curve.nm[band]);
      low = Math.min(low, curve.values[band]);
      high = Math.max(high, curve.values[band] + (spread && curve.sd ? curve.sd[band] || 0 : 0));
    }
  }
  return left < right ? { left, right, low, high: high > low ? high + 0.05 * (high - low) : low + 1 } : null;
}

// Return the path of a curve, broken where it has no value or the band is bad.
function path(curve, x, y) {
  let [text, isOn] = ["", false];
  for (let band = 0; band < curve.nm.length; band += 1) {
    const isDrawn = isShown(curve, band);
    if (isDrawn) text += `${isOn ? "L" : "M"}${x(curve.nm[band]).toFixed(1)} ${y(curve.values[band]).toFixed(1)}`;
    isOn = isDrawn;
  }
  return text;
}

function spread(curve, x, y) {
  const bands = [...curve.nm.keys()].filter((band) => isShown(curve, band) && Number.isFinite(curve.sd[band]));
  const edge = (sign) => (band) => `${x(curve.nm[band]).toFixed(1)} ${y(curve.values[band] + sign * curve.sd[band]).toFixed(1)}`;
  return bands.length ? `M${bands.map(edge(1)).join("L")}L${bands.reverse().map(edge(-1)).join("L")}Z` : "";
}

// Draw curves with axes in place of what `host` shows; `read(nm)` is called where the pointer is, with null where it left.
export function drawChart(host, curves, read) {
  const range = limits(curves, true);
  if (!range) {
    host.replaceChildren();
    return;
  }
  const width = Math.max(240, host.clientWidth);
  const height = Math.round(Math.min(420, Math.max(230, 0.62 * width)));
  const x = (nm) => LEFT + ((nm - range.left) / (range.right - range.left)) * (width - LEFT - RIGHT);
  const y = (value) => height - BOTTOM - ((value - range.low) / (range.high - range.low)) * (height - TOP - BOTTOM);
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img" });
  svg.setAttribute("aria-label", `Reflectance over wavelength of ${curves.map((curve) => curve.name).join(", ")}`);
  for (const [value, text] of ticks(range.low, range.high, 5)) {
    svg.append(element("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    svg.append(element("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, text));
  }
  for (const [value, text] of ticks(range.left, range.right, width < 420 ? 4 : 7)) {
    svg.append(element("line", { class: "axis", x1: x(value), x2: x(value), y1: height - BOTTOM, y2: height - BOTTOM + 4 }));
    svg.append(element("text", { x: x(value), y: height - BOTTOM + 17, "text-anchor": "middle" }, text));
  }
  svg.append(element("line", { class: "axis", x1: LEFT, x2: width - RIGHT, y1: height - BOTTOM, y2: height - BOTTOM }));
  svg.append(element("text", { x: (LEFT + width) / 2, y: height - 4, "text-anchor": "middle" }, "Wavelength [nm]"));
  svg.append(element("text", { x: 12, y: height / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${height / 2})` }, "Reflectance factor [1]"));
  const draw = (curve, kind, d) => {
    const drawn = element("path", { class: `${kind} ${curve.look}`, d });
    if (curve.colour) drawn.style.setProperty("--own", curve.colour);
    svg.append(drawn);
  };
  for (const curve of curves) if (curve.sd) draw(curve, "spread", spread(curve, x, y));
  for (const curve of curves) {
    if (curve.colour) svg.append(element("path", { class: "rim", d: path(curve, x, y) })); // seen on every ground
    draw(curve, "curve", path(curve, x, y));
  }
  const guide = element("line", { class: "guide", y1: TOP, y2: height - BOTTOM, visibility: "hidden" });
  svg.append(guide);
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const share = (((event.clientX - box.left) / box.width) * width - LEFT) / (width - LEFT - RIGHT);
    const nm = range.left + Math.min(1, Math.max(0, share)) * (range.right - range.left);
    for (const key of ["x1", "x2"]) guide.setAttribute(key, x(nm));
    guide.setAttribute("visibility", "visible");
    read(nm);
  });
  svg.addEventListener("pointerleave", () => {
    guide.setAttribute("visibility", "hidden");
    read(null);
  });
  host.replaceChildren(svg);
}

// Return a curve as a small picture, from 0 to `top`.
export function sparkline(curve, top) {
  const range = limits([curve], false) ?? { left: 0, right: 1 };
  const x = (nm) => 1 + ((nm - range.left) / (range.right - range.left)) * 118;
  const y = (value) => 33 - (Math.max(0, value) / top) * 31;
  const svg = element("svg", { viewBox: "0 0 120 34", "aria-hidden": "true", preserveAspectRatio: "none", height: 34 });
  svg.append(element("path", { class: "curve", d: path(curve, x, y), "vector-effect": "non-scaling-stroke" }));
  return svg;
}
