"""Parametric cars, realistic from above for pixels of a centimetre and more.

A body is a lofted sheet: cross sections at stations along its length, from the left sill over flank, belt,
window, roof rail and roof to the right sill. Bonnet, windscreen, roof, rear window and boot are ranges of
stations; seams are cells a centimetre wide. Positions along the car are fractions of its length from the
nose, heights are metres above the ground.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats

from .scene import Mesh, Part, built, cuboid, lattice, polygon, tube

_CREASE_DEG = 38.0  # angle above which an edge is not smoothed
_TREAD_CREASE_DEG = 40.0
_SEAM_M = 0.009  # width of a gap between body parts
_SILL_M = 0.19  # height of the lower edge of the body
_WHEEL_M = (0.315, 0.20)  # radius and width
_WHEEL_SIDES = 10


# Proportions of a type of car: positions as fractions of its length from the nose, heights in metres
@dataclass(frozen=True)
class CarShape:
    # length, width, height: minimum and maximum dimensions [m]
    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    # cowl, windscreen_top, roof_end, rear_base: positions at which windscreen, roof and rear window begin and
    # end
    cowl: float
    windscreen_top: float
    roof_end: float
    rear_base: float
    edge: tuple[tuple[float, float], ...]  # height of the shoulder: (fraction, metres) from nose to tail
    roof_share: float  # half width of the roof as a share of the half width of the car
    pillars: tuple[tuple[float, float], ...]  # ranges of the pillars between side windows: (from, to)
    doors: tuple[float, ...]  # positions of the vertical seams of the doors
    share: float  # share of all cars [1]
    bed: tuple[float, float] | None = None  # start and end of a cargo bed; None for a closed car
    rails: bool = False  # whether the car may have roof rails

    @property
    def boot_seam(self) -> float:
        # position of the seam between boot lid and bumper
        return 0.972 if self.rear_base < 0.9 else 0.988


#: Types of cars.
CAR_TYPES: dict[str, CarShape] = {
    "sedan": CarShape(
        (4.45, 4.75), (1.78, 1.86), (1.42, 1.47), 0.285, 0.42, 0.68, 0.835,
        ((0.0, 0.56), (0.02, 0.66), (0.07, 0.74), (0.285, 0.92),
         (0.835, 0.99), (0.955, 0.97), (0.98, 0.86), (1.0, 0.60)),
        0.68, ((0.525, 0.55), (0.735, 0.86)), (0.335, 0.537, 0.73), 0.27,
    ),
    "hatchback": CarShape(
        (3.85, 4.25), (1.72, 1.80), (1.44, 1.50), 0.27, 0.415, 0.87, 0.965,
        ((0.0, 0.56), (0.02, 0.67), (0.08, 0.76), (0.27, 0.93),
         (0.90, 1.00), (0.965, 0.96), (0.985, 0.72), (1.0, 0.58)),
        0.70, ((0.56, 0.585), (0.80, 0.98)), (0.335, 0.572, 0.78), 0.28,
    ),
    "estate": CarShape(
        (4.50, 4.75), (1.79, 1.86), (1.45, 1.50), 0.275, 0.40, 0.90, 0.970,
        ((0.0, 0.56), (0.02, 0.66), (0.07, 0.74), (0.275, 0.93),
         (0.90, 1.00), (0.970, 0.95), (0.985, 0.72), (1.0, 0.58)),
        0.70, ((0.515, 0.54), (0.715, 0.74), (0.92, 0.99)), (0.33, 0.527, 0.715), 0.15, rails=True,
    ),
    "suv": CarShape(
        (4.35, 4.70), (1.82, 1.90), (1.62, 1.72), 0.265, 0.385, 0.88, 0.965,
        ((0.0, 0.66), (0.02, 0.80), (0.07, 0.90), (0.265, 1.05),
         (0.90, 1.12), (0.965, 1.06), (0.985, 0.80), (1.0, 0.66)),
        0.72, ((0.52, 0.545), (0.72, 0.745), (0.90, 0.99)), (0.325, 0.532, 0.72), 0.18, rails=True,
    ),
    "van": CarShape(
        (4.55, 4.80), (1.84, 1.92), (1.88, 1.98), 0.175, 0.315, 0.965, 0.985,
        ((0.0, 0.66), (0.02, 0.82), (0.06, 0.92), (0.175, 1.06),
         (0.90, 1.10), (0.97, 1.08), (0.99, 0.80), (1.0, 0.62)),
        0.80, ((0.46, 0.995),), (0.26, 0.45, 0.70), 0.06,
    ),
    "pickup": CarShape(
        (4.70, 4.90), (1.82, 1.90), (1.70, 1.80), 0.255, 0.365, 0.545, 0.575,
        ((0.0, 0.68), (0.02, 0.82), (0.07, 0.94), (0.255, 1.08),
         (0.60, 1.10), (0.975, 1.10), (0.99, 0.98), (1.0, 0.64)),
        0.72, ((0.41, 0.43), (0.54, 0.60)), (0.315, 0.42, 0.545), 0.06, bed=(0.605, 0.965),
    ),
}  # fmt: skip

#: Half width of the plan outline: fraction of the length, share of the half width.
_PLAN = (
    (0.0, 0.70), (0.006, 0.80), (0.02, 0.885), (0.05, 0.945), (0.12, 0.985), (0.25, 1.0),
    (0.75, 1.0), (0.88, 0.985), (0.95, 0.945), (0.98, 0.89), (0.994, 0.81), (1.0, 0.72),
)  # fmt: skip
#: Distance of the middle of a section ahead of its ends: position, distance, as fractions of the length.
_BOW = ((0.0, 0.026), (0.25, 0.020), (0.45, 0.006), (0.60, 0.0), (0.85, -0.010), (1.0, -0.020))

#: Columns of cells of a half section from the sill to the middle: flank (3), shoulder, window, seam, rail,
#: and top (2).
_SHOULDER, _WINDOW, _DITCH = 3, 4, 5
_FLANK, _SIDE, _DECK, _EDGES, _TOP = range(4), range(5), range(5, 9), range(5, 7), range(7, 9)
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
    # surface and body part of every cell of half the sheet; later rows overwrite earlier ones
    middles = 0.5 * (stations[1:] + stations[:-1])
    surface = np.full((len(middles), _COLUMNS - 1), "paint", object)
    part = np.full((len(middles), _COLUMNS - 1), "", object)
    for begin, end, columns, word, name in _cells(shape, length, sunroof=sunroof):
        cells = np.ix_((middles > begin) & (middles < end), np.atleast_1d(columns))
        surface[cells], part[cells] = word, name
    surface, part = (np.hstack([half, half[:, ::-1]]) for half in (surface, part))
    # a floor between the sills blocks light from below
    rows = np.unique(np.linspace(0, len(sections) - 1, 8).astype(int))
    parts = [
        Part(lattice, (sections, surface, part), crease=_CREASE_DEG),
        *_ends(sections),
        Part(lattice, (sections[rows][:, [-1, 0]], "trim", "underbody")),
        *_wheels(length, width),
    ]
    station = shape.cowl + 0.45 * (shape.windscreen_top - shape.cowl)
    mirror = (0.5 * width + 0.045, length * (0.5 - station), float(_profile(station, shape.edge)) + 0.01)
    parts += [
        Part(cuboid, ((0.17, 0.08, 0.12), "paint", "mirror"), (side * mirror[0], *mirror[1:]))
        for side in (-1, 1)
    ]
    # number plates, and the dark grille above the front plate: y, side, lower edge, half width, height
    nose, tail = sections[0, :, 1].max() + 0.004, sections[-1, :, 1].min() - 0.004
    for y, side, base, half_width, plate_height, *words in (
        (nose, -1, 0.34, 0.26, 0.11, "plate", "plate"),
        (tail, 1, 0.44, 0.26, 0.11, "plate", "plate"),
        (nose, -1, 0.47, 0.40, 0.07, "trim", "bumper"),
    ):
        corners = [
            (side * half_width * x, y, base + plate_height * z) for x, z in ((-1, 0), (1, 0), (1, 1), (-1, 1))
        ]
        parts.append(Part(polygon, (corners, *words)))
    if rails and shape.rails:
        begin, end = shape.windscreen_top + 0.04, shape.roof_end - 0.04
        y, x = (0.5 - 0.5 * (begin + end)) * length, shape.roof_share * 0.5 * width - 0.03
        rail = (0.035, (end - begin) * length, 0.05), "rim", ""
        parts += [Part(cuboid, rail, (side * x, y, height - 0.075)) for side in (-1, 1)]
    return built(parts)


def _stations(shape: CarShape, length: float) -> Floats:
    # stations of sections, from nose (0) to tail (1)
    gap = _SEAM_M / length
    seams = [0.045, *shape.doors, *(() if shape.bed else (shape.boot_seam,))]
    bends = [0.0, 0.006, 0.02, 0.085, 0.16, shape.cowl - 0.018, 0.96, 0.982, 0.994, 1.0]
    glass = [shape.cowl, 0.5 * (shape.cowl + shape.windscreen_top), shape.windscreen_top]
    glass += [0.5 * (shape.windscreen_top + shape.roof_end), shape.roof_end]
    glass += [0.5 * (shape.roof_end + shape.rear_base), shape.rear_base]
    posts = [post for pillar in shape.pillars for post in pillar if post < 0.97]
    bed = [end + step for end in shape.bed or () for step in (0.0, gap)]
    stations = np.array(sorted({*bends, *glass, *posts, *bed, *(s + d for s in seams for d in (0.0, gap))}))
    return stations[~(np.diff(stations, prepend=-1.0) < 0.6 * gap)]


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


def _profile(stations: Floats | float, points: tuple[tuple[float, float], ...]) -> Floats:
    return np.asarray(np.interp(stations, *np.transpose(points)), np.float64)


def _cells(
    shape: CarShape, length: float, *, sunroof: bool
) -> Iterable[tuple[float, float, int | range, str, str]]:
    # ranges of stations and columns with their surface and part of the car
    lid, nose, gap = shape.boot_seam, 0.045, _SEAM_M / length
    cowl, top, roof_end, rear = shape.cowl, shape.windscreen_top, shape.roof_end, shape.rear_base
    # flanks
    yield 0.0, 1.0, _SIDE, "paint", "wing"
    yield shape.doors[0], shape.doors[-1], _FLANK, "paint", "door"
    yield 0.0, 0.045, _SIDE, "paint", "bumper"
    yield 0.972, 1.0, _SIDE, "paint", "bumper"
    yield cowl, rear, _WINDOW, "paint", "pillar"
    yield cowl + 0.3 * (top - cowl), rear, _WINDOW, "glass", "side_window"
    yield from ((begin, min(end, rear), _WINDOW, "paint", "pillar") for begin, end in shape.pillars)
    yield from ((door, door + gap, _FLANK, "trim", "seam") for door in shape.doors)
    yield 0.006, 0.085, range(_SHOULDER, _WINDOW + 1), "lamp", "lamp"
    yield 0.96, 0.994, range(_SHOULDER - 1, _SHOULDER + 1), "tail_lamp", "lamp"
    # from above
    for begin, end, name in ((0.0, cowl, "bonnet"), (top, roof_end, "roof"), (rear, 1.0, "boot")):
        yield begin, end, _DECK, "paint", name
        yield begin, end, _DITCH, "trim", "seam"
    for begin, end, name in ((cowl, top, "windscreen"), (roof_end, rear, "rear_window")):
        yield begin, end, _EDGES, "paint", "pillar"
        yield begin, end, _TOP, "glass", name
    yield cowl - 0.018, cowl, _DECK, "trim", "seam"  # recess of the wipers
    yield 0.0, nose, _DECK, "paint", "bumper"
    yield lid, 1.0, _DECK, "paint", "bumper"
    yield nose, nose + gap, _DECK, "trim", "seam"
    if shape.bed:
        begin, end = shape.bed
        yield begin, end, _DECK, "trim", "bed"
        yield begin, begin + gap, _DECK, "paint", "bed"
        yield end, 1.0, _DECK, "paint", "bed"
        return
    if sunroof:
        yield top + 0.03, top + (roof_end - top) / 2, _TOP, "glass", "roof"
    yield lid, lid + gap, _DECK, "trim", "seam"


def _ends(sections: Floats) -> Iterator[Part]:
    # sheets that close the body at nose and tail; cells next to the centre line are triangles
    for row, order in ((0, 1), (-1, -1)):
        left, right = sections[row, :_COLUMNS], sections[row, : _COLUMNS - 2 : -1]
        yield Part(lattice, (np.stack([left, right], axis=1)[::order], "paint", "bumper"), crease=_CREASE_DEG)


def _wheels(length: float, width: float) -> Iterator[Part]:
    radius, wheel_width = _WHEEL_M
    angle = 2 * np.pi * np.arange(_WHEEL_SIDES) / _WHEEL_SIDES
    for side in (-1, 1):
        x = side * (0.5 * width + 0.006)
        rim = np.stack([np.zeros(_WHEEL_SIDES), side * np.cos(angle), np.sin(angle)], axis=1)
        for axle in (0.5 - 0.185, 0.5 - 0.80):
            hub = np.array([x, axle * length, radius])
            back = hub - (side * wheel_width, 0, 0)
            arch = hub - (side * 0.003, 0, 0) + 1.17 * radius * rim
            arch[:, 2] = np.maximum(arch[:, 2], _SILL_M)
            tread = back, hub, (radius, radius), "tyre", "wheel", _WHEEL_SIDES, False
            yield Part(tube, tread, crease=_TREAD_CREASE_DEG)
            yield Part(polygon, (hub + radius * rim, "tyre", "wheel"))
            yield Part(polygon, (hub + (side * 0.004, 0, 0) + 0.62 * radius * rim, "rim", "wheel"))
            # smoothing drops the triangles without area that clipping at the sill leaves
            yield Part(polygon, (arch, "trim", "wing"), crease=1.0)
