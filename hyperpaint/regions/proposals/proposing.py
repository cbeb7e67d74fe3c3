"""`propose_regions`: from a flight line to regions of paint, ranked, each with its reasons."""

import contextlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from inspect import signature
from typing import Any

import dask
import numpy as np
import xarray as xr

from hyperpaint.base import (
    Array,
    Bools,
    Floats,
    PaintError,
    Problems,
    Progress,
    Quality,
    SchemaError,
    documented,
    flag_names,
    is_number,
    schema,
    takes_quantities,
)
from hyperpaint.geometry import locate
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of
from hyperpaint.light.daylight_colours import colour_name
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.regions import Region, Regions
from hyperpaint.regions.polygons import ground_of, renumbered
from hyperpaint.surroundings import SceneModel, survey
from hyperpaint.surroundings.corrections import shadow_side_of, sun_zenith_of
from hyperpaint.surroundings.surveying import flag, to_channels

from .cars import Picture, Verdict, find_cars, height_model_of, judge_car, measured, pieces, sunny_lines

#: Steps (line, column) right, down, left, up, clockwise: a right turn is the next step.
_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))


def outline(mask: Bools, origin: tuple[int, int] = (0, 0)) -> tuple[Floats, tuple[Floats, ...]]:
    """Return the ring around a connected set of pixels, and those around its holes.

    Takes ``mask`` (line, column): the pixels; neighbours share a side; ``first``: line and column of the
    first pixel of ``mask`` in the flight line. Rings are x (column) and y (line) of corners (vertex, 2),
    halfway between pixel centres.

    Examples
    --------
    >>> outline(np.ones((1, 2), bool), (4, 10))[0].tolist()
    [[9.5, 3.5], [11.5, 3.5], [11.5, 4.5], [9.5, 4.5]]
    """
    # sides of the mask that begin at every corner, as indices into `_STEPS`; the mask is on their right
    padded = np.pad(mask, 1)
    neighbours = (padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2])
    # corner of a pixel where its upper, right, lower, left side begins
    corners = ((0, 0), (0, 1), (1, 1), (1, 0))
    sides: dict[tuple[int, int], list[int]] = {}
    for direction, (neighbour, (dy, dx)) in enumerate(zip(neighbours, corners, strict=True)):
        for line, column in np.argwhere(mask & ~neighbour).tolist():
            sides.setdefault((line + dy, column + dx), []).append(direction)
    rings = []
    while sides:
        # start at the first corner in line order: the first ring then is the outer ring
        corner = start = min(sides)
        direction, previous = min(sides[start]), -1
        ring: list[tuple[int, int]] = []
        rings.append(ring)
        while corner in sides and not (ring and corner == start):
            directions = sides[corner]
            if ring:
                # where two pixels touch only at this corner, the right turn stays with the current pixel
                direction = min(directions, key=lambda candidate: (candidate - previous - 1) % 4)
            directions.remove(direction)
            if not directions:
                del sides[corner]
            if direction != previous:
                ring.append(corner)
            corner = (corner[0] + _STEPS[direction][0], corner[1] + _STEPS[direction][1])
            previous = direction
    offset = np.array([origin[1] - 0.5, origin[0] - 0.5])
    outlines = [np.array([(x, y) for y, x in ring], np.float64) + offset for ring in rings]
    return outlines[0], tuple(outlines[1:])


#: Flags that a signature of a proposed region excludes; brightness has already excluded glint and adjacency.
_EXCLUDED_FLAGS = Quality.SATURATED | Quality.IRRADIANCE_GAP | Quality.NO_DATA | Quality.SHADOW

_WGS84 = "EPSG:4326"
_DIMS = (schema.ALONG_TRACK, schema.CROSS_TRACK)
#: Variables of a flagged line that proposals use.
_LAYERS = ("glint_fraction", "blocked_direct", "adjacency", "quality")


@dataclass(frozen=True)
class Proposals(Regions):
    """Proposed regions, best first, and the refused pieces.

    Attributes
    ----------
    refused
        Every examined piece with an objection, those that look like windows, shadows or leaves last; the
        property ``refused`` lists the objections. Writing the proposals does not write these pieces. Three
        kinds of pieces are not examined: bodies with the colour of the ground, pixels in cast shadow, and
        pieces with fewer than a quarter of ``min_pixels`` pixels away from edges. So a car with the colour of
        the ground is in neither list; nor are regions that exceed ``most``.

    Examples
    --------
    >>> from hyperpaint.regions import Region, Regions
    >>> pane = Region("refused_01", [(6, 0), (9, 0), (9, 3)], properties={"refused": "a window"})
    >>> proposals = Proposals((Region("red-01", [(0, 0), (4, 0), (4, 3)]),), refused=Regions((pane,)))
    >>> len(proposals), proposals.refused[0].properties["refused"]
    (1, 'a window')
    """

    refused: Regions = field(default_factory=lambda: Regions(()))

    def table(self) -> str:
        """Return a line of text for every proposed and every refused region."""
        rows = [
            f"{region.name}  at {region.properties['place']}  score {region.properties['score']:.2f}  "
            f"{'; '.join(region.properties['reasons'])}"
            for region in self.regions
        ]
        rows += [f"{region.name}  {'; '.join(region.properties['refused'])}" for region in self.refused]
        return "\n".join(rows)


@takes_quantities(angle="degree", sun_zenith="degree", sun_azimuth="degree", heading="degree")
@documented(progress="survey progress")
def propose_regions(
    line: xr.Dataset,
    model: SceneModel | xr.Dataset | None = None,
    *,
    most: int | None = None,
    min_pixels: int = 40,
    erode: int = 3,
    glint: float = 0.02,
    shadow: float = 0.2,
    adjacency: float = 0.02,
    brightness: float = 0.03,
    angle: float = 5.0,
    flightline: str = "",
    name: str = "",
    progress: Progress | bool | None = None,
    **options: Any,
) -> Proposals:
    r"""Propose regions of car paint, best first, each with its reasons, and list the refused pieces.

    Eager: reads the line once, and once more for the scene model without ``model``. Results have the same
    bits for any chunking. The rules use only the common proportions of cars:

    * Pieces are connected parts of a body of the scene model, away from its edges, not in cast shadow,
      and neither like the ground (the largest body) nor like leaves (steep red edge, then flat).
    * A car is the area between the thick parts of a piece's colour, pixel by pixel: parts that are connected
      or, where these show no roof, separated by dark pixels only, or as bright as flakes at another lean. It
      contains no lit ground. Cars whose roof is certain from proportions and windows come first; a car 1.8
      times larger than most of them is several cars of one colour.
    * Windows are dark and cross the car. The roof lies between two of them, or has one at an end and others
      along its sides, or is longer than any bonnet. It is level in its middle; a window longer than any
      windscreen contains a sunroof, and the roof is level beside it.
    * Across, the roof is level halfway between its edges. Its brightness there is the value of a smooth
      surface through the logarithm of its brightness nearby; glint lies above the surface. The largest
      connected set of pixels with a brightness within 3 % of this value is used, or within 6 to 12 % if that
      is too small. ``glint`` and ``adjacency`` do not apply to a roof: brightness shows glint, and
      no neighbour is higher.
    * The uncertainty of its level follows from the uncertainty of that place and from an unknown lean of 0.5
      degrees across the car and 0.8 along it (parking areas are drained), times the change of light over its
      crown: roofs curve by 12 degrees over half their width, and by up to 5 over the same length. The
      mirrored sky adds an uncertainty that grows with haze. The property ``level_uncertainty`` holds it; a
      roof is refused above 4.2 %, near the lobe of flakes 5.5 %, or 0.0026 in reflectance where that is more.
      Where the line has the heights of surfaces, as `hyperpaint.geometry.locate` adds them from a ``dem``
      that shows cars, lean and level place are also estimated from them.
    * Under broken clouds a car is judged only where the record had free sun for 10 s before and after, and a
      shadow beside the car shows free sun, too.
    * ``finish`` is "metallic" where its light changes with lean more than for any solid paint, or where the
      change is grey on coloured paint, and so is ``kind``; "solid" where the sun is 20 to 32 degrees from the
      zenith and almost nothing changes, or where coloured paint changes as a solid paint does, under a sun up
      to 45 degrees, and the change has its own colour. Else it is "unknown": far from the sun's mirror image
      flakes look like solid paint. A signature of paint with flakes holds for this sun and view only.
    * Another part of a car may lean by 7 degrees or more, and is used only where the car's roof is certain
      but has no usable pixels, and the part's level is certain enough. Pixels without glint, shadow or light
      from coloured neighbours are used, with a brightness within 3 % of the part's median. Its colour and
      brightness must agree with the roof, and differ from the ground.
    * Black paint is distinguished from windows by still darker windows, and a black roof by paint beyond both
      its windows, or by a bonnet before the windscreen and windows along it.
    * Each car gives one region.

    Parameters
    ----------
    line
    model
        From `hyperpaint.surroundings.survey` of the same line; by default surveyed with ``options``.
    most
        Maximum number of regions; by default all.
    min_pixels
        Minimum number of pixels of a region.
    erode
        Distance from the edge of a body within which pixels are left out [pixel].
    glint, shadow, adjacency
        Largest ``glint_fraction``, ``blocked_direct`` and, as a mean over 5 x 5 pixels, ``adjacency`` of a
        pixel, see `hyperpaint.surroundings.flag` [1]; for a roof only ``blocked_direct``.
    brightness
        Largest relative difference of a pixel, as a mean over 5 x 5, from the middle of a roof or the median
        of another piece; for dark paint at least 0.005 in reflectance [1].
    angle
        Largest median spectral angle to the median [degree].
    flightline
        Name of the flight line, stored in the regions.
    name
        Prefix of the names of the regions, which are a colour and a number along the line: ``red-02`` is the
        second red paint from the start, whatever ``most`` is; `hyperpaint.light.daylight_colours.COLOURS`
        lists the words.
    progress
    **options
        Options of `hyperpaint.surroundings.survey`; ``sun_zenith`` also applies with ``model``.

    Returns
    -------
    Proposals
        `Regions` with properties ``rank``, ``score``, ``kind`` ("roof", "panel", "metallic"), ``finish``
        ("solid", "metallic", "unknown"), ``place`` (line and column of its centre, and position),
        ``latitude``, ``longitude`` [degree, WGS 84] where the line has ground positions, or poses and the
        height of the ground, as `hyperpaint.geometry.locate` takes them, ``level_uncertainty`` (standard,
        relative) [1], ``lean`` (standard deviation) [degree], ``pixels``, ``spectral_angle`` [degree],
        ``brightness_spread``, ``brightness_slope``, ``glint``, ``blocked_direct``, ``adjacency`` [1],
        ``excluded_flags`` (see `hyperpaint.extract_signatures`) and ``reasons``; its attribute ``refused``
        holds the refused pieces, with objections in the property ``refused``; see `Proposals` for pieces in
        neither.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, limits are negative or not finite, or the model is of another line.

    Notes
    -----
    With n pixels, the spectral angle :math:`\alpha`, adjacency a, glint g and spread of brightness t,

    .. math:: score = \min(1, n/200) \; \frac{1}{1 + (\alpha/2°)^2} \;
              \frac{1}{1 + a/0.01 + g/0.02 + t/0.03}.

    A proposal can be wrong, more often for metallic and black paints. For measured rates see
    ``benchmarks/fleet.py``.

    The spectra still include the sky mirrored by the clear coat; see
    `hyperpaint.surroundings.corrections.remove_mirrored_sky`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.light.sun import diffuse_fraction
    >>> nm = np.linspace(400.0, 1000.0, 24)
    >>> sky = 0.04 * diffuse_fraction(nm, 30.0)[:, None]
    >>> seen = np.full((60, 24, 100), 0.1)  # ground
    >>> seen[15:45, :, 5:95] = np.where(nm > 600.0, 0.6, 0.04)[:, None] + sky  # a red car
    >>> seen[19:41, :, 25:40] = seen[19:41, :, 70:80] = 0.012 + sky  # two windows
    >>> cube = ("along_track", "band", "cross_track"), seen.astype("float32"), {"units": "1"}
    >>> line = xr.Dataset({"reflectance": cube}, {"wavelength": ("band", nm, {"units": "nm"})})
    >>> found = propose_regions(line, sun_zenith=30.0)
    >>> [(region.name, region.properties["kind"]) for region in found]
    [('red-01', 'roof')]
    """
    line = schema.rename_to_roles(line)
    limits: dict[str, Any] = {
        "erode": erode,
        "glint": glint,
        "shadow": shadow,
        "adjacency": adjacency,
        "brightness": brightness,
        "angle": angle,
    }
    problems = Problems("regions cannot be proposed", SchemaError)
    for key, value in limits.items():
        problems.add_if(
            not is_number(value) or value < 0,
            f"{key}={value!r}",
            expected="a number from 0 on",
            code="value-out-of-range",
        )
    for key, count in (("min_pixels", min_pixels), ("most", most)):
        problems.add_if(
            count is not None and count < 1,
            f"{key}={count!r}",
            expected="1 or more",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    limits["min_pixels"] = min_pixels
    unknown = sorted(set(options) - set(signature(survey).parameters))
    if unknown:
        raise TypeError(f"propose_regions() got unexpected keyword arguments {', '.join(unknown)}")
    if model is None:
        model = survey(line, progress=progress, **options)
    scene = model if isinstance(model, SceneModel) else SceneModel.from_dataset(model)
    if not scene.segments:
        return Proposals(())
    zenith = options.get("sun_zenith", scene.attrs.get("sun_zenith"))
    try:
        zenith = sun_zenith_of(line, zenith)
    except SchemaError:  # unknown
        if zenith is not None:
            raise
    side = shadow_side_of(line, options.get("sun_azimuth"), options.get("heading"))
    sun = sunny_lines(line, scene, options.get("diffuse"), zenith)
    picture = Picture(scene, *_read(line, scene), zenith, side, height_model_of(line), sun)
    painted, judged = [], []
    for piece, is_vegetation in pieces(scene, erode, max(min_pixels // 4, 1)):
        if is_vegetation:
            objection = "its red edge is that of leaves"
            measures = measured(piece, picture, limits)
            judged.append(Verdict(piece, measures, objections=[objection], scenery=True))
        else:
            painted.append(piece)
    for car in find_cars(painted, picture):
        judged += judge_car(car, picture, limits)
    # Accepted pieces by score, and refused pieces with their objections
    places = _Places(line, scene.channel_wavelength, name)
    accepted = [verdict for verdict in judged if not verdict.objections]
    accepted.sort(key=lambda verdict: (-verdict.score, verdict.piece.origin, verdict.piece.body))
    refused = [verdict for verdict in judged if verdict.objections]
    refused.sort(key=lambda verdict: verdict.scenery)
    digits = len(str(max(len(refused), 10)))
    proposed = [
        _region(verdict, name, flightline, {"rank": rank, "score": round(verdict.score, 4), **place})
        for rank, (verdict, (name, place)) in enumerate(
            zip(accepted, places.of(accepted), strict=True), start=1
        )
    ][:most]
    others = [
        _region(verdict, f"refused_{rank:0{digits}}", flightline, {"refused": verdict.objections})
        for rank, verdict in enumerate(refused, start=1)
    ]
    proposals = Proposals(tuple(proposed), refused=Regions(tuple(others)))
    return replace(renumbered(proposals, line), refused=renumbered(proposals.refused, line))


class _Places:
    # Names of paints by colour and order along a line, and their places.

    def __init__(self, line: xr.Dataset, wavelength: Floats, prefix: str) -> None:
        self.line, self.wavelength, self.prefix = line, wavelength, prefix

    def of(self, verdicts: list[Verdict]) -> list[tuple[str, dict[str, Any]]]:
        # Return name and place of every verdict.
        centres = np.array([_centre(verdict) for verdict in verdicts], np.int64).reshape(-1, 2)
        lines, columns = (
            schema.numbers_of(self.line, dim)[k] for dim, k in zip(_DIMS, centres.T, strict=True)
        )
        places: list[dict[str, Any]] = [
            {"place": f"line {line:.0f}, column {column:.0f}"}
            for line, column in zip(lines, columns, strict=True)
        ]
        for place, (longitude, latitude) in zip(places, self._positions(centres), strict=False):
            if np.isfinite(latitude + longitude):
                place["place"] += f", {latitude:.6f}, {longitude:.6f}"
                place |= {"latitude": round(latitude, 7), "longitude": round(longitude, 7)}
        colours = [
            colour_name(verdict.measures.spectrum, self.wavelength).replace(" ", "-") for verdict in verdicts
        ]
        names, counts = [""] * len(verdicts), Counter[str]()
        for k in np.lexsort(centres.T[::-1]):
            counts[colours[k]] += 1
            names[k] = f"{self.prefix}{'_' * bool(self.prefix)}{colours[k]}-{counts[colours[k]]:02}"
        return list(zip(names, places, strict=True))

    def _positions(self, centres: Array) -> list[list[float]]:
        # Longitude and latitude of pixels (n, 2) [degree]; empty without the geometry of the line
        with contextlib.suppress(PaintError):
            is_located = {"east", "north"} <= set(self.line.variables)
            x, y, crs = ground_of(self.line if is_located else locate(self.line), _WGS84)
            at = {dim: xr.DataArray(k, dims="place") for dim, k in zip(_DIMS, centres.T, strict=True)}
            ground = np.stack(dask.compute(x.isel(at).data, y.isel(at).data), axis=1)
            if crs is not None or x.name in ("longitude", "lon"):
                positions: list[list[float]] = between_maps(ground, crs_of(crs or _WGS84), _WGS84).tolist()
                return positions
        return []


def _centre(verdict: Verdict) -> Array:
    # Line and column of the usable pixel that is nearest to the mean of the usable pixels, (2,)
    inside = np.argwhere(verdict.measures.usable) + np.array(verdict.piece.origin)
    nearest: Array = inside[((inside - inside.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    return nearest


def _read(line: xr.Dataset, model: SceneModel) -> tuple[Array, dict[str, Array]]:
    # The line in the model's channels (line, column, channel), and its variables `_LAYERS`, by one pass
    flagged = flag(line, model)
    quality = line.get("quality")
    cube = line_chunked(schema.require(line, ["reflectance"], "regions")["reflectance"])
    numbers = dask.delayed(model.channel)
    blocks = [
        dask.delayed(to_channels, pure=True)(block, numbers) for block in np.ravel(cube.data.to_delayed())
    ]
    results = dask.compute(*blocks, *[flagged[name].data for name in _LAYERS[:3]])
    channels = np.concatenate(results[: len(blocks)])
    layers = dict(zip(_LAYERS, results[len(blocks) :], strict=False))
    layers["quality"] = np.zeros(channels.shape[:2], np.uint16) if quality is None else quality.values
    return channels, layers


def _region(verdict: Verdict, name: str, flightline: str, ranking: Mapping[str, Any]) -> Region:
    piece, measures = verdict.piece, verdict.measures
    ring, holes = outline(measures.usable if measures.pixels else piece.inside, piece.origin)
    numbers = {
        "spectral_angle": measures.angle,
        "brightness_spread": measures.spread,
        "brightness_slope": measures.slope,
        "glint": measures.glint,
        "blocked_direct": measures.shadow,
        "adjacency": measures.adjacency,
        "level_uncertainty": verdict.level_sd,
        "lean": verdict.lean,
    }
    properties = {
        **ranking,
        "kind": verdict.kind or "unknown",
        "finish": verdict.finish,
        "pixels": measures.pixels,
        "excluded_flags": flag_names(_EXCLUDED_FLAGS),
        **{key: round(value, 5) for key, value in numbers.items() if np.isfinite(value)},
        "reasons": verdict.reasons,
    }
    return Region(name, ring, holes, flightline, properties)
