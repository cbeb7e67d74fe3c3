// A hyperpaint store in the browser. Values are read from the Zarr store; `site.json` lists its lines and pictures.
// Texts of a store enter the page as text only, never as HTML.

import { FetchStore, get, open, registry, root } from "./zarrita.min.js";
import { drawChart, isShown, sparkline } from "./chart.js";
import { checked, unblosc } from "./codecs.js";

const MAX_CURVES = 8;
const MAX_CACHED_SPECTRA = 500;
const codec = (decode) => async () => ({ fromConfig: () => ({ kind: "bytes_to_bytes", decode }) });
registry.set("blosc", codec(unblosc));
registry.set("crc32c", codec(checked));

const traffic = { bytes: 0, requests: 0 };

// Every chunk of a finished store exists: a missing chunk is an error, not a fill value.
class WholeStore extends FetchStore {
  async get(key, options) {
    const bytes = await super.get(key, options);
    if (!bytes && /\/c(\/\d+)*$/.test(key)) throw new Error(`${key} is missing`);
    traffic.bytes += bytes?.length ?? 0;
    traffic.requests += 1;
    return bytes;
  }
}

const parts = Object.fromEntries([...document.querySelectorAll("[id]")].map((each) => [each.id, each]));

function node(name, properties = {}, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

function say(text, isProblem = false) {
  parts.status.textContent = text;
  parts.status.classList.toggle("problem", isProblem);
}

// --- the store --------------------------------------------------------------------------------------------

let site;
let base;
const opened = new Map();
const spectra = new Map();

// Each array is opened as a store: zarrita reads paths as URLs, and would misread names with # or %.
function nodeOf(group, name) {
  const path = [...group.split("/"), name].filter(Boolean).map(encodeURIComponent).join("/");
  return open.v3(root(new WholeStore(`${base}/${path}`)), { kind: "array" });
}

async function whole(entry, name) {
  return entry.variables.includes(name) ? get(await nodeOf(entry.group, name)) : null;
}

const numbers = (array) => (array ? Array.from(array.data, Number) : null);

function lineOf(name) {
  const entry = site.lines.find((each) => each.name === name);
  if (!entry) return Promise.reject(new Error(`there is no line ${name}`));
  if (!opened.has(name)) {
    const load = async () => {
      const [cube, quality, nm, good, shift] = await Promise.all([
        nodeOf(entry.group, "reflectance"),
        entry.variables.includes("quality") ? nodeOf(entry.group, "quality") : null,
        whole(entry, "wavelength"), whole(entry, "good"), whole(entry, "wavelength_shift"),
      ]);
      const dims = cube.dimensionNames;
      const axes = dims.map((dim) => ({ along_track: "y", y: "y", cross_track: "x", x: "x" })[dim] ?? "band");
      return { ...entry, cube, quality, axes, nm: numbers(nm), good: numbers(good), shift };
    };
    opened.set(name, load().catch((error) => {
      opened.delete(name);
      throw error;
    }));
  }
  return opened.get(name);
}

// Return the wavelengths of a column: with smile they differ from column to column.
function wavelengths(line, column) {
  if (!line.shift) return line.nm;
  const [data, columns] = [line.shift.data, line.columns];
  const at = (band) => (line.shift.shape.length === 1 ? data[column] : data[band * columns + column]);
  return line.nm.map((nm, band) => nm + at(band));
}

// Return the spectrum of a pixel: {nm, values (Float32Array), good, quality}. `x`, `y`: numbers of column and line.
export function spectrum(name, x, y) {
  const key = JSON.stringify([name, x, y]);
  if (!spectra.has(key)) {
    const read = async () => {
      const line = await lineOf(name);
      const place = { x: x - line.first[1], y: y - line.first[0] };
      if (!(place.x >= 0 && place.x < line.columns && place.y >= 0 && place.y < line.rows)) throw new Error(`${name} has no pixel ${x}, ${y}`);
      const [values, quality] = await Promise.all([
        get(line.cube, line.axes.map((axis) => (axis === "band" ? null : place[axis]))),
        line.quality ? get(line.quality, [place.y, place.x]) : null,
      ]);
      return { nm: wavelengths(line, place.x), values: values.data, good: line.good, quality };
    };
    if (spectra.size >= MAX_CACHED_SPECTRA) spectra.delete(spectra.keys().next().value);
    spectra.set(key, read().catch((error) => {
      spectra.delete(key);
      throw error;
    }));
  }
  return spectra.get(key);
}

export const paints = [];

async function loadPaints() {
  for (const entry of site.libraries) {
    const [cube, nm, good, sd, counts, names] = await Promise.all([
      ...["reflectance", "wavelength", "good", "reflectance_sd", "n"].map((name) => whole(entry, name)),
      whole(entry, "signature").catch(async () => get(await nodeOf(entry.group, "paint"))), // of hyperpaint 0.2
    ]);
    const bands = cube.shape[1];
    const row = (array, number) => array && array.data.subarray(number * bands, (number + 1) * bands);
    for (let number = 0; number < cube.shape[0]; number += 1) {
      paints.push({
        name: String(names.data[number]), nm: numbers(nm), good: numbers(good), values: row(cube, number), sd: row(sd, number),
        count: counts ? Number(counts.data[number]) : null, colour: entry.colours[number], outlines: entry.outlines[number],
      });
    }
  }
}

// --- the view, which the address holds ----------------------------------------------------------------------

const state = { line: null, x: null, y: null, kept: [], paints: [], flags: false, zoom: 0 };

const wholeNumber = (text) => (/^-?\d{1,9}$/.test(text ?? "") ? Number(text) : null);

function readAddress() {
  const asked = new URLSearchParams(location.hash.slice(1));
  const names = site.lines.map((entry) => entry.name);
  // x is horizontal and y vertical on the picture: line and column of a flight line, column and row of a map
  const lies = (line) => site.lines.find((entry) => entry.name === line)?.lies;
  const pixel = (line, x, y) => ({ line, x: wholeNumber(lies(line) ? y : x), y: wholeNumber(lies(line) ? x : y) });
  state.line = names.includes(asked.get("line")) ? asked.get("line") : (names[0] ?? null);
  Object.assign(state, pixel(state.line, asked.get("x"), asked.get("y")));
  state.kept = asked.getAll("keep").map((text) => text.split(",")).map(([x, y, ...line]) => pixel(line.join(","), x, y));
  state.kept = state.kept.filter((each) => names.includes(each.line) && each.x !== null && each.y !== null);
  state.paints = asked.getAll("paint").filter((name) => paints.some((paint) => paint.name === name));
  state.flags = asked.get("flags") === "1";
  state.zoom = Math.min(16, Math.max(0, Number(asked.get("zoom")) || 0));
}

function writeAddress() {
  const address = new URLSearchParams();
  if (state.line !== null) address.set("line", state.line);
  const places = ({ line, x, y }) => (site.lines.find((entry) => entry.name === line).lies ? [y, x] : [x, y]);
  if (state.x !== null && state.y !== null) places(state).forEach((number, axis) => address.set("xy"[axis], number));
  for (const each of state.kept) address.append("keep", [...places(each), each.line].join(","));
  for (const name of state.paints) address.append("paint", name);
  if (state.flags) address.set("flags", "1");
  if (state.zoom) address.set("zoom", state.zoom);
  history.replaceState(null, "", `#${address}`);
}

// --- picture ------------------------------------------------------------------------------------------------

const placeOf = ({ line, x, y }) => (site.lines.find((each) => each.name === line).lies ? `line ${y}, column ${x}` : `column ${x}, row ${y}`);
const entryOf = () => site.lines.find((each) => each.name === state.line);

// Lines are flown to the right, maps have north up.
function onPicture(entry, row, column) {
  const across = entry.mirrored ? entry.columns - 1 - column : column;
  return entry.lies ? [row, across] : [across, row];
}

function inCube(entry, left, top) {
  const [row, across] = entry.lies ? [left, top] : [top, left];
  return [row, entry.mirrored ? entry.columns - 1 - across : across];
}

const sizeOf = (entry) => (entry.lies ? [entry.rows, entry.columns] : [entry.columns, entry.rows]);

function scaleOf(entry) {
  const [width, height] = sizeOf(entry);
  if (state.zoom) return state.zoom;
  const room = [parts.view.clientWidth - 2, Math.max(220, (innerWidth < 800 ? 0.42 : 0.66) * innerHeight)];
  return Math.max(Math.min(room[0] / width, room[1] / height, 16), Math.min(120 / width, 120 / height));
}

function layOut() {
  const entry = entryOf();
  if (!entry) return;
  const [scale, [width, height]] = [scaleOf(entry), sizeOf(entry)];
  const style = (each, values) => Object.entries(values).forEach(([key, value]) => each.style.setProperty(key, `${value}px`));
  style(parts.stage, { width: width * scale, height: height * scale });
  // the picture has every n-th line and column, and so reaches beyond the last ones by less than n
  const [rowStep, columnStep] = entry.steps;
  const covered = [Math.ceil(entry.rows / rowStep) * rowStep, Math.ceil(entry.columns / columnStep) * columnStep];
  const [wide, tall] = entry.lies ? covered : [covered[1], covered[0]];
  const beyond = entry.mirrored ? entry.columns - covered[1] : 0;
  const place = entry.lies ? { left: 0, top: beyond * scale } : { left: beyond * scale, top: 0 };
  for (const each of [parts.picture, parts.layer]) style(each, { width: wide * scale, height: tall * scale, ...place });
  const isChosen = state.x !== null && state.y !== null;
  parts.cross.hidden = !isChosen;
  parts.place.textContent = isChosen ? placeOf(state) : "";
  if (isChosen) {
    const [left, top] = onPicture(entry, state.y - entry.first[0], state.x - entry.first[1]);
    style(parts.cross, { left: (left + 0.5) * scale, top: (top + 0.5) * scale });
  }
}

// Draw where the paints were measured; polygons go through pixel centres, as columns and lines.
function showOutlines() {
  const entry = entryOf();
  const shown = paints.filter((paint) => entry && paint.outlines.some((each) => each.line === entry.name));
  parts.outlined.hidden = !shown.length;
  const [width, height] = entry ? sizeOf(entry) : [1, 1];
  parts.outlines.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const place = ([x, y]) => onPicture(entry, y - entry.first[0], x - entry.first[1]).map((each) => each + 0.5);
  const polygons = shown.flatMap((paint) => paint.outlines.filter((each) => each.line === entry.name).map((each) => {
    const group = svgNode("g", state.paints.includes(paint.name) ? "ticked" : "");
    group.style.setProperty("--own", paint.colour);
    for (const name of ["rim", "own"]) {
      const polygon = svgNode("polygon", name);
      polygon.setAttribute("points", each.polygon.map(place).join(" "));
      group.append(polygon);
    }
    return group;
  }));
  parts.outlines.replaceChildren(...(parts.outlining.checked ? polygons : []));
}

function svgNode(name, className) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  made.setAttribute("class", className);
  return made;
}

// Return whether two colours (#rrggbb) are hard to tell apart.
function isNear(one, other) {
  const parts = (colour) => [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  const [mine, theirs] = [parts(one), parts(other)];
  return Math.hypot(...mine.map((value, part) => value - theirs[part])) < 60;
}

function zoomBy(factor) {
  const now = scaleOf(entryOf());
  const middle = [(parts.view.scrollLeft + parts.view.clientWidth / 2) / now, (parts.view.scrollTop + parts.view.clientHeight / 2) / now];
  state.zoom = factor ? Math.min(16, Math.max(0.05, Number((now * factor).toPrecision(3)))) : 0;
  writeAddress();
  layOut();
  const then = scaleOf(entryOf());
  parts.view.scrollLeft = middle[0] * then - parts.view.clientWidth / 2;
  parts.view.scrollTop = middle[1] * then - parts.view.clientHeight / 2;
}

function choose(x, y) {
  const entry = entryOf();
  const inside = (value, first, count) => Math.min(first + count - 1, Math.max(first, value));
  [state.x, state.y] = [inside(x, entry.first[1], entry.columns), inside(y, entry.first[0], entry.rows)];
  writeAddress();
  layOut();
  return showSpectra();
}

// --- flags ---------------------------------------------------------------------------------------------------

const flagNames = (quality) => site.flags.filter((flag) => quality & flag.mask).map((flag) => flag.name);
const unticked = new Set();
let layerDrawn = "";

async function showFlags() {
  const entry = entryOf();
  const wanted = JSON.stringify([state.line, [...unticked]]);
  parts.layer.hidden = parts.legend.hidden = !state.flags;
  if (!state.flags || !entry || layerDrawn === wanted) return;
  const line = await lineOf(entry.name);
  if (!line.quality) {
    parts.legend.replaceChildren(node("li", { textContent: "This line has no flags." }));
    return;
  }
  line.flags ??= get(line.quality);
  const { data } = await line.flags;
  if (entryOf() !== entry) return;
  const counts = new Map();
  for (const value of data) if (value) counts.set(value, (counts.get(value) ?? 0) + 1);
  const present = site.flags
    .map((flag) => ({ ...flag, count: [...counts].reduce((sum, [value, count]) => sum + (value & flag.mask ? count : 0), 0) }))
    .filter((flag) => flag.count)
    .sort((one, other) => one.count - other.count); // of several the rarest is shown
  drawFlags(entry, data, present.filter((flag) => !unticked.has(flag.mask)));
  parts.legend.replaceChildren(...present.map((flag) => legendItem(flag, data.length)));
  if (!present.length) parts.legend.replaceChildren(node("li", { textContent: "No flag is set on any pixel." }));
  layerDrawn = wanted;
}

function legendItem(flag, pixels) {
  const box = node("input", { type: "checkbox", checked: !unticked.has(flag.mask) });
  box.addEventListener("change", () => {
    if (box.checked) unticked.delete(flag.mask);
    else unticked.add(flag.mask);
    guarded(showFlags());
  });
  const share = (100 * flag.count) / pixels;
  const text = `${flag.name}, ${share < 0.01 ? "< 0.01" : share.toPrecision(2)} %`;
  return node("li", {}, node("label", {}, box, " ", swatch(flag.colour), text));
}

function swatch(colour, className = "swatch") {
  const patch = node("span", { className });
  if (/^#[0-9a-f]{6}$/i.test(colour)) patch.style.background = colour;
  return patch;
}

function drawFlags(entry, data, shown) {
  const [rowStep, columnStep] = entry.steps;
  const [rows, columns] = [Math.ceil(entry.rows / rowStep), Math.ceil(entry.columns / columnStep)];
  [parts.layer.width, parts.layer.height] = entry.lies ? [rows, columns] : [columns, rows];
  const context = parts.layer.getContext("2d", { willReadFrequently: true });
  const image = context.createImageData(parts.layer.width, parts.layer.height);
  const ranks = new Uint8Array(parts.layer.width * parts.layer.height).fill(255);
  const rankOf = Uint8Array.from({ length: 65536 }, (_, value) => {
    const rank = shown.findIndex((flag) => value & flag.mask);
    return rank < 0 ? 255 : rank;
  });
  for (let row = 0, k = 0; row < entry.rows; row += 1) {
    for (let column = 0; column < entry.columns; column += 1, k += 1) {
      const rank = data[k] ? rankOf[data[k]] : 255;
      if (rank === 255) continue;
      let across = Math.floor(column / columnStep);
      if (entry.mirrored) across = columns - 1 - across;
      const along = Math.floor(row / rowStep);
      const at = entry.lies ? across * rows + along : along * columns + across;
      if (rank >= ranks[at]) continue;
      ranks[at] = rank;
      const colour = shown[rank].colour;
      for (let part = 0; part < 3; part += 1) image.data[4 * at + part] = parseInt(colour.slice(1 + 2 * part, 3 + 2 * part), 16);
      image.data[4 * at + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
}

// --- spectra ---------------------------------------------------------------------------------------------------

const labelOf = (pixel) => (site.lines.length > 1 ? `${pixel.line}, ${placeOf(pixel)}` : placeOf(pixel));
let turn = 0;
let curves = [];

async function showSpectra() {
  const mine = (turn += 1);
  const [start, before] = [performance.now(), traffic.bytes];
  const pixels = [...(state.x === null || state.y === null ? [] : [{ ...state }]), ...state.kept];
  const read = await Promise.all(pixels.map((each) => spectrum(each.line, each.x, each.y)));
  if (mine !== turn) return; // another pixel was chosen meanwhile
  const named = state.paints.map((name) => paints.find((paint) => paint.name === name));
  curves = [...read.map((each, number) => ({ ...each, name: labelOf(pixels[number]) })), ...named]
    .slice(0, MAX_CURVES)
    .map((curve, number) => ({ ...curve, look: `c${number}` }));
  curves.forEach((curve, number) => {
    if (!curve.colour) return;
    const isLike = curves.slice(0, number).some((other) => other.colour && isNear(other.colour, curve.colour));
    curve.look = isLike ? "paint near" : "paint";
  });
  drawChart(parts.chart, curves, readOut);
  parts.curves.replaceChildren(...curves.map((curve) => {
    const item = node("li", { className: curve.look, textContent: curve.name });
    if (curve.colour) item.style.setProperty("--own", curve.colour);
    return item;
  }));
  const isChosen = state.x !== null && state.y !== null;
  const names = isChosen ? flagNames(read[0].quality) : [];
  const unflagged = isChosen && read[0].quality === null ? "There are no flags here." : "No flag is set on this pixel.";
  parts.flagged.textContent = !isChosen ? "No pixel is chosen yet." : names.length ? `Flags: ${names.join(", ")}` : unflagged;
  parts.flagged.classList.toggle("problem", names.length > 0);
  const hasValues = curves.some((curve) => curve.values.some((_, band) => isShown(curve, band)));
  const bytes = traffic.bytes - before;
  if (curves.length && !hasValues) say("No band has a value here.");
  else say(bytes ? `${(bytes / 1000).toFixed(0)} kB read in ${((performance.now() - start) / 1000).toFixed(2)} s.` : "");
  parts.keep.disabled = !isChosen || curves.length >= MAX_CURVES;
  parts.clear.disabled = !curves.length;
  parts.csv.hidden = !curves.length;
}

function readOut(nm) {
  const nearest = (curve) => curve.nm.reduce((best, each, band) => (Math.abs(each - nm) < Math.abs(curve.nm[best] - nm) ? band : best), 0);
  const text = (value) => (Number.isFinite(value) ? value.toFixed(4) : "no value");
  parts.readout.textContent = nm === null ? "\u00a0" : `${nm.toFixed(1)} nm: ${curves.map((curve) => text(curve.values[nearest(curve)])).join(" \u00b7 ")}`;
}

// Return the curves shown as a table; numbers are those of the store, every digit.
function table() {
  const cell = (value) => (Number.isFinite(value) ? String(value) : "");
  const quoted = (text) => `"${text.replace(/^[=+\-@\t\r]/, "'$&").replaceAll('"', '""')}"`;
  const heads = curves.flatMap((curve) => [`wavelength of ${curve.name} [nm]`, curve.name]).map(quoted);
  const rows = Array.from({ length: Math.max(...curves.map((curve) => curve.nm.length)) }, (_, band) =>
    curves.flatMap((curve) => [cell(curve.nm[band]), cell(curve.values[band])]).join(","));
  return [heads.join(","), ...rows].join("\r\n") + "\r\n";
}

function showPaints() {
  parts["paints-part"].hidden = !paints.length;
  const top = Math.max(0.1, ...paints.map((paint) => paint.values.reduce((most, value, band) => (isShown(paint, band) ? Math.max(most, value) : most), 0)));
  parts.paints.replaceChildren(...paints.map((paint) => {
    const box = node("input", { type: "checkbox", checked: state.paints.includes(paint.name) });
    box.addEventListener("change", () => {
      state.paints = state.paints.filter((name) => name !== paint.name);
      if (box.checked) state.paints.push(paint.name);
      writeAddress();
      showOutlines();
      guarded(showSpectra());
    });
    const count = paint.count === null ? "" : `${paint.count} pixels`;
    return node("li", {}, node("label", {}, swatch(paint.colour, "patch"), box, node("span", { className: "name", textContent: paint.name }),
      sparkline(paint, top), node("span", { className: "note", textContent: count })));
  }));
}

// --- together ----------------------------------------------------------------------------------------------------

function guarded(promise) {
  return promise.catch((error) => say(`This cannot be read: ${error.cause?.message ?? error.message}`, true));
}

function showAll() {
  readAddress();
  const entry = entryOf();
  parts["picture-part"].hidden = !entry;
  parts.choice.hidden = site.lines.length < 2;
  if (entry) {
    parts.line.value = entry.name;
    parts.picture.src = entry.picture;
    parts.picture.alt = `${entry.name} in true colour`;
  }
  parts.flags.checked = state.flags;
  showPaints();
  showOutlines();
  layOut();
  return Promise.all([guarded(showFlags()), guarded(showSpectra())]);
}

function listen() {
  parts.stage.addEventListener("click", (event) => {
    const entry = entryOf();
    const box = parts.stage.getBoundingClientRect();
    const scale = scaleOf(entry);
    const [row, column] = inCube(entry, Math.floor((event.clientX - box.left) / scale), Math.floor((event.clientY - box.top) / scale));
    guarded(choose(column + entry.first[1], row + entry.first[0]));
  });
  parts.stage.addEventListener("keydown", (event) => {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!move || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    const entry = entryOf();
    const far = event.shiftKey ? 10 : 1;
    const middle = [Math.floor(entry.rows / 2), Math.floor(entry.columns / 2)];
    const now = state.x === null || state.y === null ? middle : [state.y - entry.first[0], state.x - entry.first[1]];
    const [left, top] = onPicture(entry, ...now);
    const [row, column] = state.x === null ? now : inCube(entry, left + far * move[0], top + far * move[1]);
    guarded(choose(column + entry.first[1], row + entry.first[0]));
    parts.cross.scrollIntoView({ block: "nearest", inline: "nearest" });
  });
  parts.fit.addEventListener("click", () => zoomBy(0));
  parts.smaller.addEventListener("click", () => zoomBy(1 / 1.5));
  parts.larger.addEventListener("click", () => zoomBy(1.5));
  parts.flags.addEventListener("change", () => {
    state.flags = parts.flags.checked;
    writeAddress();
    guarded(showFlags());
  });
  parts.outlining.addEventListener("change", showOutlines);
  parts.line.addEventListener("change", () => {
    Object.assign(state, { line: parts.line.value, x: null, y: null });
    writeAddress();
    showAll();
  });
  parts.keep.addEventListener("click", () => {
    state.kept.push({ line: state.line, x: state.x, y: state.y });
    writeAddress();
    guarded(showSpectra());
  });
  parts.clear.addEventListener("click", () => {
    Object.assign(state, { x: null, y: null, kept: [], paints: [] });
    writeAddress();
    showAll();
  });
  parts.csv.addEventListener("click", () => {
    const address = URL.createObjectURL(new Blob([table()], { type: "text/csv" }));
    parts.csv.href = address;
    setTimeout(() => URL.revokeObjectURL(address), 60_000);
  });
  addEventListener("hashchange", showAll);
  addEventListener("resize", () => {
    layOut();
    drawChart(parts.chart, curves, readOut);
  });
}

async function start() {
  const answer = await fetch("site.json");
  if (!answer.ok) throw new Error(`site.json: ${answer.status} ${answer.statusText}`);
  site = await answer.json();
  const place = new URL(site.store, document.baseURI);
  base = place.href.replace(/\/+$/, "");
  document.title = parts.title.textContent = site.title;
  parts.store.textContent = site.store;
  if (/^https?:$/.test(place.protocol)) parts.store.href = place.href;
  parts.line.replaceChildren(...site.lines.map((entry) => node("option", { value: entry.name, textContent: entry.name })));
  await loadPaints();
  listen();
  await showAll();
}

await guarded(start());
parts.stage.dataset.ready = "1";
