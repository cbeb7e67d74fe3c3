"""Parametric cars, realistic from above for pixels of a centimetre and more.

A body is a lofted sheet: cross sections at stations along its length, from the left sill over flank, belt,
window, roof rail and roof to the right sill. Bonnet, windscreen, roof, rear window and boot are ranges of
stations; seams are cells a centimetre wide. Positions along the car are fractions of its length from the
nose, heights are metres above the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .primitives import Mesh, cuboid, lattice, polygon, put_together, smoothed, tube

Words = NDArray[np.object_]

_CREASE_DEG = 38.0  # angle above which an edge is not smoothed
_SEAM_M = 0.009  # width of a gap between body parts
_SILL_M = 0.19  # height of the lower edge of the body
_WHEEL_M = (0.315, 0.20)  # radius and width
_WHEEL_SIDES = 10


@dataclass(frozen=True)
class CarShape:
    """Proportions of a type of car: positions as fractions of its length from the nose, heights in metres.

    Attributes
    ----------
    length, width, height
        Minimum and maximum dimensions [m].
    cowl, windscreen_top, roof_end, rear_base
        Positions at which windscreen, roof and rear window begin and end.
    edge
        Height of the shoulder: (fraction, metres) from nose to tail.
    roof_share
        Half width of the roof as a share of the half width of the car.
    pillars
        Ranges of the pillars between side windows: (from, to).
    doors
        Positions of the vertical seams of the doors.
    bed
        Start and end of a cargo bed; None for a closed car.
    rails
        Whether the car may have roof rails.
    """

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    cowl: float
    windscreen_top: float
    roof_end: float
    rear_base: float
    edge: tuple[tuple[float, float], ...]
    roof_share: float
    pillars: tuple[tuple[float, float], ...]
    doors: tuple[float, ...]
    bed: tuple[float, float] | None = None
    rails: bool = False


#: Types of cars.
CAR_TYPES: dict[str, CarShape] = {
    "sedan": CarShape(
        (4.45, 4.75), (1.78, 1.86), (1.42, 1.47), 0.285, 0.42, 0.68, 0.835,
        ((0.0, 0.56), (0.02, 0.66), (0.07, 0.74), (0.285, 0.92),
         (0.835, 0.99), (0.955, 0.97), (0.98, 0.86), (1.0, 0.60)),
        0.68, ((0.525, 0.55), (0.735, 0.86)), (0.335, 0.537, 0.73),
    ),
    "hatchback": CarShape(
        (3.85, 4.25), (1.72, 1.80), (1.44, 1.50), 0.27, 0.415, 0.87, 0.965,
        ((0.0, 0.56), (0.02, 0.67), (0.08, 0.76), (0.27, 0.93),
         (0.90, 1.00), (0.965, 0.96), (0.985, 0.72), (1.0, 0.58)),
        0.70, ((0.56, 0.585), (0.80, 0.98)), (0.335, 0.572, 0.78),
    ),
    "estate": CarShape(
        (4.50, 4.75), (1.79, 1.86), (1.45, 1.50), 0.275, 0.40, 0.90, 0.970,
        ((0.0, 0.56), (0.02, 0.66), (0.07, 0.74), (0.275, 0.93),
         (0.90, 1.00), (0.970, 0.95), (0.985, 0.72), (1.0, 0.58)),
        0.70, ((0.515, 0.54), (0.715, 0.74), (0.92, 0.99)), (0.33, 0.527, 0.715), rails=True,
    ),
    "suv": CarShape(
        (4.35, 4.70), (1.82, 1.90), (1.62, 1.72), 0.265, 0.385, 0.88, 0.965,
        ((0.0, 0.66), (0.02, 0.80), (0.07, 0.90), (0.265, 1.05),
         (0.90, 1.12), (0.965, 1.06), (0.985, 0.80), (1.0, 0.66)),
        0.72, ((0.52, 0.545), (0.72, 0.745), (0.90, 0.99)), (0.325, 0.532, 0.72), rails=True,
    ),
    "van": CarShape(
        (4.55, 4.80), (1.84, 1.92), (1.88, 1.98), 0.175, 0.315, 0.965, 0.985,
        ((0.0, 0.66), (0.02, 0.82), (0.06, 0.92), (0.175, 1.06),
         (0.90, 1.10), (0.97, 1.08), (0.99, 0.80), (1.0, 0.62)),
        0.80, ((0.46, 0.995),), (0.26, 0.45, 0.70),
    ),
    "pickup": CarShape(
        (4.70, 4.90), (1.82, 1.90), (1.70, 1.80), 0.255, 0.365, 0.545, 0.575,
        ((0.0, 0.68), (0.02, 0.82), (0.07, 0.94), (0.255, 1.08),
         (0.60, 1.10), (0.975, 1.10), (0.99, 0.98), (1.0, 0.64)),
        0.72, ((0.41, 0.43), (0.54, 0.60)), (0.315, 0.42, 0.545), bed=(0.605, 0.965),
    ),
}  # fmt: skip

#: Half width of the plan outline: fraction of the length, share of the half width.
_PLAN = (
    (0.0, 0.70), (0.006, 0.80), (0.02, 0.885), (0.05, 0.945), (0.12, 0.985), (0.25, 1.0),
    (0.75, 1.0), (0.88, 0.985), (0.95, 0.945), (0.98, 0.89), (0.994, 0.81), (1.0, 0.72),
)  # fmt: skip
#: Distance of the middle of a section ahead of its ends: position, distance, as fractions of the length.
_BOW = ((0.0, 0.026), (0.25, 0.020), (0.45, 0.006), (0.60, 0.0), (0.85, -0.010), (1.0, -0.020))

#: Cells of a half section from the sill to the middle: flank (3), shoulder, window, seam, rail, and top (2).
_FLANK, _SHOULDER, _WINDOW, _DITCH, _RAIL, _TOP = range(3), 3, 4, 5, 6, range(7, 9)
_COLUMNS = 10


def car_body(kind: str, rng: np.random.Generator) -> Mesh:
    """Return a car on the ground around the origin, with its nose to the north.

    ``kind`` is one of `CAR_TYPES`; ``rng`` chooses size, sunroof and roof rails. Surfaces are "paint",
    "glass", "trim", "tyre", "rim", "lamp", "tail_lamp" and "plate".

    Examples
    --------
    >>> body = car_body("sedan", np.random.default_rng(0))
    >>> 800 < len(body.faces) < 1500, bool(4.4 < np.ptp(body.vertices[:, 1]) < 4.9)
    (True, True)
    """
    shape = CAR_TYPES[kind]
    length, width, height = (rng.uniform(*limits) for limits in (shape.length, shape.width, shape.height))
    sunroof, rails = rng.random() < 0.15, rng.random() < 0.6
    stations = _stations(shape, length)
    sections = _sections(shape, stations, length, width, height)
    surface, part = _cells(shape, 0.5 * (stations[1:] + stations[:-1]), length, sunroof=sunroof)
    shell = lattice(sections, surface, part)
    # a floor between the sills blocks light from below
    rows = np.unique(np.linspace(0, len(sections) - 1, 8).astype(int))
    floor_cells = (len(rows) - 1, 1)
    floor = lattice(
        sections[rows][:, [-1, 0]],
        np.full(floor_cells, "trim", object),
        np.full(floor_cells, "underbody", object),
    )
    pieces = [smoothed(put_together([shell]), _CREASE_DEG), *_ends(sections), floor, *_wheels(length, width)]
    # mirrors
    station = shape.cowl + 0.45 * (shape.windscreen_top - shape.cowl)
    mirror_height = float(_profile(np.array(station), shape.edge)) + 0.01
    mirror = cuboid((0.17, 0.08, 0.12), "paint", "mirror")
    for side in (-1, 1):
        offset = (side * (0.5 * width + 0.045), length * (0.5 - station), mirror_height)
        pieces.append(mirror.shifted(offset))
    # number plates, and the dark grille above the front plate
    nose, tail = sections[0, :, 1].max() + 0.004, sections[-1, :, 1].min() - 0.004
    for y, side, base, (half_width, plate_height), word in (
        (nose, -1, 0.34, (0.26, 0.11), "plate"),
        (tail, 1, 0.44, (0.26, 0.11), "plate"),
        (nose, -1, 0.47, (0.40, 0.07), "trim"),
    ):
        corners = [
            (side * half_width * x, y, base + plate_height * z) for x, z in ((-1, 0), (1, 0), (1, 1), (-1, 1))
        ]
        pieces.append(polygon(corners, word, "plate" if word == "plate" else "bumper"))
    if rails and shape.rails:
        begin, end = shape.windscreen_top + 0.04, shape.roof_end - 0.04
        rail = cuboid((0.035, (end - begin) * length, 0.05), "rim", "")
        y, x = (0.5 - 0.5 * (begin + end)) * length, shape.roof_share * 0.5 * width - 0.03
        pieces += [rail.shifted((side * x, y, height - 0.075)) for side in (-1, 1)]
    return put_together(pieces)


def _stations(shape: CarShape, length: float) -> Floats:
    # stations of sections, from nose (0) to tail (1)
    gap = _SEAM_M / length
    seams = [0.045, *shape.doors, *(() if shape.bed else (_boot_seam(shape),))]
    bends = [0.0, 0.006, 0.02, 0.085, 0.16, shape.cowl - 0.018, 0.96, 0.982, 0.994, 1.0]
    glass = [shape.cowl, 0.5 * (shape.cowl + shape.windscreen_top), shape.windscreen_top]
    glass += [0.5 * (shape.windscreen_top + shape.roof_end), shape.roof_end]
    glass += [0.5 * (shape.roof_end + shape.rear_base), shape.rear_base]
    posts = [post for pillar in shape.pillars for post in pillar if post < 0.97]
    bed = [end + step for end in shape.bed or () for step in (0.0, gap)]
    stations = np.array(sorted({*bends, *glass, *posts, *bed, *(s + d for s in seams for d in (0.0, gap))}))
    return stations[~(np.diff(stations, prepend=-1.0) < 0.6 * gap)]


def _boot_seam(shape: CarShape) -> float:
    # position of the seam between boot lid and bumper
    return 0.972 if shape.rear_base < 0.9 else 0.988


def _sections(shape: CarShape, stations: Floats, length: float, width: float, height: float) -> Floats:
    # points of the sections from left to right sill, shape (station, column, 3) [m]
    half_width = 0.5 * width * _profile(stations, _PLAN)
    edge = _profile(stations, shape.edge)
    rise = edge - _SILL_M
    # height of a section between deck (0) and roof (1)
    front = np.clip((stations - shape.cowl) / (shape.windscreen_top - shape.cowl), 0.0, 1.0)
    back = np.clip((shape.rear_base - stations) / (shape.rear_base - shape.roof_end), 0.0, 1.0)
    roof_share = np.asarray((1 - (1 - front) ** 1.2) * (1 - (1 - back) ** 1.2))
    flank = [
        (0.945 * half_width, np.full_like(half_width, _SILL_M)),
        (1.0 * half_width, _SILL_M + 0.33 * rise),
        (0.995 * half_width, _SILL_M + 0.78 * rise),
        (0.965 * half_width, edge - 0.02),
        (0.905 * half_width, edge + 0.004),
    ]
    roof = shape.roof_share * 0.5 * width
    roof_position = np.clip(
        (stations - shape.windscreen_top) / (shape.roof_end - shape.windscreen_top), 0.0, 1.0
    )
    top = height - 0.035 * (2 * roof_position - 1) ** 2 - 0.01
    seam = _SEAM_M / 0.905
    inner = []
    for share, inset, drop in (
        (0.86, 0.0, 0.10),
        (0.86 - seam, _SEAM_M, 0.094),
        (0.78, 0.075, 0.045),
        (0.40, 0.5 * roof, 0.010),
        (0.0, roof, 0.0),
    ):
        deck = edge + 0.004 + 0.05 * (1 - (share / 0.9) ** 2) * np.clip(rise / 0.5, 0, 1)
        half_span = share * half_width + roof_share * (roof - inset - share * half_width)
        inner.append((half_span, deck + roof_share * (top - drop - deck)))
    if shape.bed:
        in_bed = (stations > shape.bed[0]) & (stations <= shape.bed[1])
        inner[1:] = [(x, np.where(in_bed, 0.72, z)) for x, z in inner[1:]]
    x, z = (np.stack([point[axis] for point in flank + inner], axis=1) for axis in (0, 1))
    x, z = np.concatenate([-x, x[:, -2::-1]], axis=1), np.concatenate([z, z[:, -2::-1]], axis=1)
    bow = _profile(stations, _BOW)[:, None] * (1 - (x / (0.5 * width)) ** 2)
    return np.stack([x, length * (0.5 - stations[:, None] + bow), z], axis=-1)


def _profile(stations: Floats, points: tuple[tuple[float, float], ...]) -> Floats:
    table = np.asarray(points)
    return np.asarray(np.interp(stations, table[:, 0], table[:, 1]), np.float64)


def _cells(shape: CarShape, middles: Floats, length: float, *, sunroof: bool) -> tuple[Words, Words]:
    # surface and body part of every cell of the sheet, shape (station - 1, column - 1)
    half_columns = _COLUMNS - 1
    surface = np.full((len(middles), half_columns), "paint", object)
    part = np.full((len(middles), half_columns), "", object)

    def mark(rows: NDArray[np.bool_], columns: int | range, word: str, part_name: str) -> None:
        cells = np.ix_(rows, np.atleast_1d(columns))
        surface[cells], part[cells] = word, part_name

    _mark_top(shape, middles, length, mark, sunroof=sunroof)
    _mark_flank(shape, middles, length, mark)
    return np.hstack([surface, surface[:, ::-1]]), np.hstack([part, part[:, ::-1]])


Mark = Callable[[NDArray[np.bool_], "int | range", str, str], None]


def _mark_top(shape: CarShape, s: Floats, length: float, mark: Mark, *, sunroof: bool) -> None:
    lid, nose, gap = _boot_seam(shape), 0.045, _SEAM_M / length
    at_bonnet, at_windscreen = s < shape.cowl, (s > shape.cowl) & (s < shape.windscreen_top)
    at_roof = (s > shape.windscreen_top) & (s < shape.roof_end)
    at_boot, at_rear_window = s > shape.rear_base, (s > shape.roof_end) & (s < shape.rear_base)
    centre_columns = range(_DITCH, _TOP.stop)
    for rows, name in ((at_bonnet, "bonnet"), (at_roof, "roof"), (at_boot, "boot")):
        mark(rows, centre_columns, "paint", name)
        mark(rows, _DITCH, "trim", "seam")
    mark(at_windscreen | at_rear_window, range(_DITCH, _TOP.start), "paint", "pillar")
    mark(at_windscreen, _TOP, "glass", "windscreen")
    mark(at_rear_window, _TOP, "glass", "rear_window")
    # the recess of the wipers
    mark(at_bonnet & (s > shape.cowl - 0.018), range(_DITCH, _TOP.stop), "trim", "seam")
    mark((s < nose) | (s > lid), centre_columns, "paint", "bumper")
    mark(_is_between(s, nose, nose + gap), centre_columns, "trim", "seam")
    if sunroof and not shape.bed:
        quarter = (shape.roof_end - shape.windscreen_top) / 2
        mark(
            _is_between(s, shape.windscreen_top + 0.03, shape.windscreen_top + quarter), _TOP, "glass", "roof"
        )
    if shape.bed:
        mark(_is_between(s, *shape.bed), centre_columns, "trim", "bed")
        mark(
            _is_between(s, shape.bed[0], shape.bed[0] + gap) | _is_between(s, shape.bed[1], 1.0),
            centre_columns,
            "paint",
            "bed",
        )
    else:
        mark(_is_between(s, lid, lid + gap), centre_columns, "trim", "seam")


def _mark_flank(shape: CarShape, s: Floats, length: float, mark: Mark) -> None:
    gap = _SEAM_M / length
    cabin, flank = _is_between(s, shape.cowl, shape.rear_base), range(_FLANK.start, _SHOULDER + 1)
    mark(np.ones(len(s), bool), range(_FLANK.start, _WINDOW + 1), "paint", "wing")
    mark(_is_between(s, shape.doors[0], shape.doors[-1]), flank, "paint", "door")
    mark((s < 0.045) | (s > 0.972), range(_FLANK.start, _WINDOW + 1), "paint", "bumper")
    mark(cabin, _WINDOW, "paint", "pillar")
    at_window = cabin & (s > shape.cowl + 0.3 * (shape.windscreen_top - shape.cowl))
    for begin, end in shape.pillars:
        at_window &= ~_is_between(s, begin, end)
    mark(at_window, _WINDOW, "glass", "side_window")
    for door in shape.doors:
        mark(_is_between(s, door, door + gap), flank, "trim", "seam")
    mark(_is_between(s, 0.006, 0.085), range(_SHOULDER, _WINDOW + 1), "lamp", "lamp")
    mark(_is_between(s, 0.96, 0.994), range(_FLANK.stop - 1, _SHOULDER + 1), "tail_lamp", "lamp")


def _is_between(s: Floats, begin: float, end: float) -> NDArray[np.bool_]:
    return np.asarray((s > begin) & (s < end))


def _ends(sections: Floats) -> list[Mesh]:
    # sheets that close the body at nose and tail
    sheets = []
    for row, order in ((0, 1), (-1, -1)):
        left, right = sections[row, :_COLUMNS], sections[row, : _COLUMNS - 2 : -1]
        points = np.stack([left, right], axis=1)[::order]
        cells = (len(points) - 1, 1)
        sheet = lattice(points, np.full(cells, "paint", object), np.full(cells, "bumper", object))
        sheets.append(smoothed(sheet, _CREASE_DEG))  # cells next to the centre line are triangles
    return sheets


def _wheels(length: float, width: float) -> list[Mesh]:
    radius, wheel_width = _WHEEL_M
    angle = 2 * np.pi * np.arange(_WHEEL_SIDES) / _WHEEL_SIDES
    pieces = []
    for side in (-1, 1):
        x = side * (0.5 * width + 0.006)
        rim = np.stack([np.zeros(_WHEEL_SIDES), side * np.cos(angle), np.sin(angle)], axis=1)
        for axle in (0.5 - 0.185, 0.5 - 0.80):
            hub = np.array([x, axle * length, radius])
            back = hub - (side * wheel_width, 0, 0)
            tread = tube(back, hub, (radius, radius), "tyre", sides=_WHEEL_SIDES, part="wheel", closed=False)
            arch = hub - (side * 0.003, 0, 0) + 1.17 * radius * rim
            arch[:, 2] = np.maximum(arch[:, 2], _SILL_M)
            pieces += [
                smoothed(tread),
                polygon(hub + radius * rim, "tyre", "wheel"),
                polygon(hub + (side * 0.004, 0, 0) + 0.62 * radius * rim, "rim", "wheel"),
                # smoothing drops the triangles without area that clipping at the sill leaves
                smoothed(polygon(arch, "trim", "wing"), 1.0),
            ]
    return pieces
