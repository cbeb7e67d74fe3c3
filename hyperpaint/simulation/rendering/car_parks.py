"""A parametric car park: rows of bays with cars, aisles with grey panels, and objects around them.

The park extends from x = -width/2 (west) to +width/2 (east), and from y = 0 northwards, so that a flight
line along x = 0 images all of it. From west to east it has grass with trees, a kerb, rows of bays and aisles
in turn, and a wall: two rows share an aisle, and are back to back with the next two. Generators of random
numbers are keyed by (seed, bay, row), so that a longer park of the same seed contains the cars of the shorter
one, under the same names.

A crown is a cloud of leaves of two triangles each, bent along the midrib, most of them near the surface of a
few overlapping spheres, and facing outwards in random directions. Leaves of clean car parks are opaque
Lambert surfaces; those of a real fleet's car park also transmit light.

Cars are parametric, and realistic from above for pixels of a centimetre and more. A body is a lofted sheet:
cross sections at stations along its length, from the left sill over flank, belt, window, roof rail and roof
to the right sill. Bonnet, windscreen, roof, rear window and boot are ranges of stations; seams are cells a
centimetre wide. Positions along the car are fractions of its length from the nose, heights are metres above
the ground.
"""

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np

from hyperpaint.base import (
    Fact,
    Floats,
    Problems,
    SchemaError,
    Spelling,
    argument_facts,
    as_argument,
    check_values,
)
from hyperpaint.simulation.settings import FLEETS, MAX_SEED

from .materials import Coat, Material
from .scene import Instance, Mesh, Part, Scene, built, cuboid, lattice, polygon, put_together, tube, uniform
from .scene_spectra import FOURTEEN, PANELS, fleet_names, is_paint, paint_spec

# --- cars ---------------------------------------------------------------------------------------------------


_BODY = SimpleNamespace(
    crease_deg=38.0,  # angle above which an edge is not smoothed
    tread_crease_deg=40.0,
    seam_m=0.009,  # width of a gap between body parts
    sill_m=0.19,  # height of the lower edge of the body
    wheel_m=(0.315, 0.20),  # radius and width
    wheel_sides=10,
)


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
    # Stations of sections, from nose (0) to tail (1)
    gap = _BODY.seam_m / length
    seams = [0.045, *shape.doors, *(() if shape.bed else (shape.boot_seam,))]
    bends = [0.0, 0.006, 0.02, 0.085, 0.16, shape.cowl - 0.018, 0.96, 0.982, 0.994, 1.0]
    glass = [shape.cowl, 0.5 * (shape.cowl + shape.windscreen_top), shape.windscreen_top]
    glass += [0.5 * (shape.windscreen_top + shape.roof_end), shape.roof_end]
    glass += [0.5 * (shape.roof_end + shape.rear_base), shape.rear_base]
    posts = [post for pillar in shape.pillars for post in pillar if post < 0.97]
    bed = [end + step for end in shape.bed or () for step in (0.0, gap)]
    stations = np.array(sorted({*bends, *glass, *posts, *bed, *(s + d for s in seams for d in (0.0, gap))}))
    stations = stations[~(np.diff(stations, prepend=-1.0) < 0.6 * gap)]
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
        Part(lattice, (sections, surface, part), crease=_BODY.crease_deg),
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


def _sections(shape: CarShape, stations: Floats, length: float, width: float, height: float) -> Floats:
    # points of the sections from left to right sill, shape (station, column, 3) [m]
    half_width = 0.5 * width * _profile(stations, _PLAN)
    edge = _profile(stations, shape.edge)
    rise = edge - _BODY.sill_m
    # height of a section between deck (0) and roof (1)
    front = np.clip((stations - shape.cowl) / (shape.windscreen_top - shape.cowl), 0.0, 1.0)
    back = np.clip((shape.rear_base - stations) / (shape.rear_base - shape.roof_end), 0.0, 1.0)
    roof_share = np.asarray((1 - (1 - front) ** 1.2) * (1 - (1 - back) ** 1.2))
    flank = [
        (0.945 * half_width, np.full_like(half_width, _BODY.sill_m)),
        (1.0 * half_width, _BODY.sill_m + 0.33 * rise),
        (0.995 * half_width, _BODY.sill_m + 0.78 * rise),
        (0.965 * half_width, edge - 0.02),
        (0.905 * half_width, edge + 0.004),
    ]
    roof = shape.roof_share * 0.5 * width
    roof_position = np.clip(
        (stations - shape.windscreen_top) / (shape.roof_end - shape.windscreen_top), 0.0, 1.0
    )
    top = height - 0.035 * (2 * roof_position - 1) ** 2 - 0.01
    seam = _BODY.seam_m / 0.905
    inner = []
    for share, inset, drop in (
        (0.86, 0.0, 0.10),
        (0.86 - seam, _BODY.seam_m, 0.094),
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
    lid, nose, gap = shape.boot_seam, 0.045, _BODY.seam_m / length
    cowl, top, roof_end, rear = shape.cowl, shape.windscreen_top, shape.roof_end, shape.rear_base
    cells: list[tuple[float, float, int | range, str, str]] = [
        # flanks
        (0.0, 1.0, _SIDE, "paint", "wing"),
        (shape.doors[0], shape.doors[-1], _FLANK, "paint", "door"),
        (0.0, 0.045, _SIDE, "paint", "bumper"),
        (0.972, 1.0, _SIDE, "paint", "bumper"),
        (cowl, rear, _WINDOW, "paint", "pillar"),
        (cowl + 0.3 * (top - cowl), rear, _WINDOW, "glass", "side_window"),
        *((begin, min(end, rear), _WINDOW, "paint", "pillar") for begin, end in shape.pillars),
        *((door, door + gap, _FLANK, "trim", "seam") for door in shape.doors),
        (0.006, 0.085, range(_SHOULDER, _WINDOW + 1), "lamp", "lamp"),
        (0.96, 0.994, range(_SHOULDER - 1, _SHOULDER + 1), "tail_lamp", "lamp"),
        # from above
        (0.0, cowl, _DECK, "paint", "bonnet"),
        (0.0, cowl, _DITCH, "trim", "seam"),
        (top, roof_end, _DECK, "paint", "roof"),
        (top, roof_end, _DITCH, "trim", "seam"),
        (rear, 1.0, _DECK, "paint", "boot"),
        (rear, 1.0, _DITCH, "trim", "seam"),
        (cowl, top, _EDGES, "paint", "pillar"),
        (cowl, top, _TOP, "glass", "windscreen"),
        (roof_end, rear, _EDGES, "paint", "pillar"),
        (roof_end, rear, _TOP, "glass", "rear_window"),
        (cowl - 0.018, cowl, _DECK, "trim", "seam"),  # recess of the wipers
        (0.0, nose, _DECK, "paint", "bumper"),
        (lid, 1.0, _DECK, "paint", "bumper"),
        (nose, nose + gap, _DECK, "trim", "seam"),
    ]
    if shape.bed:
        begin, end = shape.bed
        return [
            *cells,
            (begin, end, _DECK, "trim", "bed"),
            (begin, begin + gap, _DECK, "paint", "bed"),
            (end, 1.0, _DECK, "paint", "bed"),
        ]
    if sunroof:
        cells.append((top + 0.03, top + (roof_end - top) / 2, _TOP, "glass", "roof"))
    return [*cells, (lid, lid + gap, _DECK, "trim", "seam")]


def _ends(sections: Floats) -> Iterator[Part]:
    # sheets that close the body at nose and tail; cells next to the centre line are triangles
    for row, order in ((0, 1), (-1, -1)):
        left, right = sections[row, :_COLUMNS], sections[row, : _COLUMNS - 2 : -1]
        yield Part(
            lattice,
            (np.stack([left, right], axis=1)[::order], "paint", "bumper"),
            crease=_BODY.crease_deg,
        )


def _wheels(length: float, width: float) -> Iterator[Part]:
    radius, wheel_width = _BODY.wheel_m
    angle = 2 * np.pi * np.arange(_BODY.wheel_sides) / _BODY.wheel_sides
    for side in (-1, 1):
        x = side * (0.5 * width + 0.006)
        rim = np.stack([np.zeros(_BODY.wheel_sides), side * np.cos(angle), np.sin(angle)], axis=1)
        for axle in (0.5 - 0.185, 0.5 - 0.80):
            hub = np.array([x, axle * length, radius])
            back = hub - (side * wheel_width, 0, 0)
            arch = hub - (side * 0.003, 0, 0) + 1.17 * radius * rim
            arch[:, 2] = np.maximum(arch[:, 2], _BODY.sill_m)
            tread = back, hub, (radius, radius), "tyre", "wheel", _BODY.wheel_sides, False
            yield from (
                Part(tube, tread, crease=_BODY.tread_crease_deg),
                Part(polygon, (hub + radius * rim, "tyre", "wheel")),
                Part(polygon, (hub + (side * 0.004, 0, 0) + 0.62 * radius * rim, "rim", "wheel")),
                # smoothing drops the triangles without area that clipping at the sill leaves
                Part(polygon, (arch, "trim", "wing"), crease=1.0),
            )


# --- car parks ----------------------------------------------------------------------------------------------

#: Length and width of a bay [m].
BAY = (5.0, 2.5)

#: Maximum number of rows of bays.
MAX_ROWS = 199

_BEYOND = 7.0  # length of asphalt before the first bay and behind the last [m]
_LOT = SimpleNamespace(
    rounding_m=1e-9,  # by which a width may be too small for its rows
    tufted_m=2.5,  # width of the strip of lawn with blades, from the kerb [m]
    fleet_size=5000,  # different cars of a fleet: more than a car park has bays
)
_GRASS, _KERB, _GUTTER = 1.0, 0.3, 0.1  # widths of the strips west of the first row [m]
_AISLE, _WIDEST_AISLE = 4.5, 6.5
_KERB_HEIGHT, _LAWN = 0.12, 0.10  # above the asphalt [m]
_ISLAND_PERIOD, _ISLAND_START = 11, 7  # bays
_PANEL_SIZE, _PANEL_PERIOD, _PANEL_START = 0.90, 30.0, 1.4  # grey panels lie along the aisle [m]
_TREE_PITCH, _LAMP_PITCH = 7.5, 25.0  # along the edges [m]
_LEAF = 0.20  # length of a leaf, or of a tuft that represents several [m]
_CREASE_DEG = 40.0  # crease angle of trunks and posts
_CARS, _PAINTS, _TREES, _WEAR = 1, 2, 3, 4  # keys of random streams


# Positions of the parts of a car park; x from west to east, y from south to north [m]
@dataclass(frozen=True)
class Layout:
    # length, width, margin, line_width: arguments of `car_park`
    length: float
    width: float
    margin: float
    line_width: float
    bays: int  # number of bays in a row, including an incomplete last one
    # rows, aisles: west and east end of every row and aisle
    rows: tuple[tuple[float, float], ...]
    aisles: tuple[tuple[float, float], ...]
    # bay and row of every island, which replaces a bay; islands of two rows back to back are adjacent
    islands: tuple[tuple[int, int], ...]
    # kerb, east_kerb: west and east end of the kerbs before the first row and behind the last
    kerb: tuple[float, float]
    east_kerb: tuple[float, float]
    # wall, west_trees, hedge: position of the wall, of the line of trees outside the park in the west, and of
    # the hedge
    wall: float
    west_trees: float
    hedge: float


def strips_across(
    length: float,
    width: float,
    rows: int | None,
    *,
    margin: float,
    line_width: float,
    islands: bool,
    walls: bool = True,
) -> Layout:
    """Return the layout of ``rows`` of bays, as many as fit by default, and of aisles.

    Examples
    --------
    >>> layout = strips_across(20.0, 16.0, None, margin=10.0, line_width=0.1, islands=False)
    >>> [(round(a, 3), round(b, 3)) for a, b in (*layout.rows, *layout.aisles)]
    [(-6.6, -1.6), (2.9, 7.9), (-1.6, 2.9)]
    """
    edge = _GRASS + _KERB + _GUTTER
    wanted = rows or max(n for n in range(1, MAX_ROWS + 1) if _least_width(n) <= width + _LOT.rounding_m)
    aisles = (wanted + 1) // 2
    aisle = min(_AISLE + (width - _least_width(wanted)) / aisles, _WIDEST_AISLE) if wanted < 4 else _AISLE
    west, row_ends, aisle_ends = edge - 0.5 * width, [], []
    for row in range(wanted):
        row_ends.append((west, west + BAY[0]))
        west += BAY[0]
        if row % 2 == 0:
            aisle_ends.append((west, west + aisle))
            west += aisle
    bays = int(np.ceil(round(length / BAY[1], 9)))
    kerb, last_edge = -0.5 * width + _GRASS, row_ends[-1][1] + _GUTTER
    wall, west_trees = max(0.5 * width - 0.5, last_edge + _KERB + 0.2), -0.5 * width - 0.3
    return Layout(
        length,
        width,
        margin,
        line_width,
        bays,
        tuple(row_ends),
        tuple(aisle_ends),
        tuple(
            (bay, row)
            for bay, row in itertools.product(range(bays), range(wanted))
            if islands and (bay + 5 * ((row + 1) // 2)) % _ISLAND_PERIOD == _ISLAND_START
        ),
        (kerb, kerb + _KERB),
        (last_edge, last_edge + _KERB),
        wall,
        west_trees,
        west_trees - 1.2 if walls else wall - 0.8,
    )


def _least_width(rows: int) -> float:
    return _GRASS + _KERB + 2 * _GUTTER + BAY[0] * rows + _AISLE * ((rows + 1) // 2)


def paved(layout: Layout) -> Iterator[Part]:
    # ground, of the surfaces "asphalt", "line", "concrete" and "grass".
    # Painted lines are cells of the ground, not plates on it; kerbs and islands are raised. A sheet of
    # asphalt 5 cm below closes the joints.
    south, north = -layout.margin, layout.length + layout.margin
    first, last = max(-_BEYOND, south), min(layout.length + _BEYOND, north)
    west, east = layout.kerb[1], layout.east_kerb[0]
    far_west, far_east = -0.5 * layout.width - layout.margin, 0.5 * layout.width + layout.margin
    yield _level(far_west, far_east, south, north, "asphalt", -0.05)
    # between the rows, and under the kerbs
    gaps = [
        (before[1], behind[0])
        for before, behind in itertools.pairwise([(west, west), *layout.rows, (east, east)])
        if behind[0] - before[1] > 1e-6
    ]
    for begin, end in (*gaps, (layout.kerb[0], west), (east, layout.east_kerb[1])):
        yield _level(begin, end, first, last, "asphalt")
    # rows of bays: asphalt and the painted lines
    for begin, end in layout.rows:
        asphalt = first
        for line in range(layout.bays + 1):
            low, high = (line * BAY[1] + side * 0.5 * layout.line_width for side in (-1, 1))
            if high > last:
                break
            if low > asphalt:
                yield _level(begin, end, asphalt, low, "asphalt")
            if low >= asphalt:
                yield _level(begin, end, low, high, "line")
                asphalt = high
        if last > asphalt:
            yield _level(begin, end, asphalt, last, "asphalt")
    for begin, end in (layout.kerb, layout.east_kerb):
        size = (end - begin, last - first, _KERB_HEIGHT + 0.03)
        yield Part(cuboid, (size, "concrete"), (0.5 * (begin + end), 0.5 * (first + last), -0.03))
    begin, end = layout.kerb[0], layout.east_kerb[1]
    for edge in (first - 0.5 * _KERB, last + 0.5 * _KERB):
        size = (end - begin, _KERB, _KERB_HEIGHT + 0.04)
        yield Part(cuboid, (size, "concrete"), (0.5 * (end + begin), edge, -0.03))
    lawns = ((far_west, begin, south, north), (end, far_east, south, north))
    for lawn in (*lawns, (begin, end, south, first), (begin, end, last, north)):
        if lawn[1] > lawn[0] and lawn[3] > lawn[2]:
            yield _level(*lawn, "grass", _LAWN)
    for bay, row in layout.islands:
        begin, end = layout.rows[row]
        x, y = 0.5 * (begin + end), (bay + 0.5) * BAY[1]
        length, wide = end - begin - 0.1, BAY[1] - 0.3
        yield Part(cuboid, ((length, wide, _KERB_HEIGHT + 0.03), "concrete"), (x, y, -0.03))
        yield Part(cuboid, ((length - 0.4, wide - 0.4, 0.06), "grass"), (x, y, _KERB_HEIGHT - 0.03))
    # arrows in the aisles
    for number, (begin, end) in enumerate(layout.aisles):
        way = -1.0 if number % 2 else 1.0
        for y, outline in itertools.product(np.arange(10.0, layout.length, 15.0), _ARROW):
            corners = [(0.5 * (begin + end) + way * px, y + way * py, 0.004) for px, py in outline]
            yield Part(polygon, (corners, "line"))


#: Outlines of shaft and head of an arrow, east and north [m].
_ARROW = (
    ((-0.09, -1.2), (0.09, -1.2), (0.09, 0.4), (-0.09, 0.4)),
    ((-0.32, 0.4), (0.32, 0.4), (0.0, 1.2)),
)


def _level(west: float, east: float, south: float, north: float, surface: str, height: float = 0.0) -> Part:
    corners = [(west, south), (east, south), (east, north), (west, north)]
    return Part(polygon, ([(*corner, height) for corner in corners], surface))


def worn(layout: Layout, seed: int) -> list[Mesh]:
    # traces of wear: stains in bays and patches in aisles, 3 mm thick, and tufts of grass.
    # Its surfaces are "patch" and "grass".
    pieces = []
    angle = 2 * np.pi * np.arange(11) / 11
    for row, (begin, end) in enumerate(layout.rows):
        for bay in range(layout.bays):
            rng = np.random.default_rng([seed, _WEAR, bay, row])
            if (bay, row) in layout.islands or rng.random() < 0.4:
                continue
            radius = rng.uniform(0.08, 0.30) * rng.uniform(0.75, 1.2, (11, 1))
            middle = (rng.uniform(begin + 1.2, end - 1.2), (bay + 0.5) * BAY[1] + rng.uniform(-0.4, 0.4))
            rim = middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            pieces.append(polygon(np.column_stack([rim, np.full(11, 0.003)]), "patch"))
    for number, (begin, end) in enumerate(layout.aisles):
        for step in range(int(layout.length // 12.0)):
            rng = np.random.default_rng([seed, _WEAR, step, number, 1])
            west, south = rng.uniform(begin + 0.2, end - 1.6), 12.0 * step + rng.uniform(4.0, 9.0)
            size = rng.uniform((0.5, 0.6), (1.3, 2.5))
            pieces.append(built([_level(west, west + size[0], south, south + size[1], "patch", 0.003)]))
    # blades of grass on the lawn nearest to the cars: one mesh for every bay's length
    east, count = layout.kerb[0], 300
    for bay in range(layout.bays):
        rng = np.random.default_rng([seed, _WEAR, bay])
        foot = rng.uniform(
            (east - _LOT.tufted_m, bay * BAY[1], _LAWN), (east, (bay + 1) * BAY[1], _LAWN), (count, 3)
        )
        lean = rng.normal(0.0, 0.05, (count, 3)) * (1, 1, 0) + (0, 0, 0.07)
        side = rng.normal(0.0, 0.06, (count, 3)) * (1, 1, 0)
        corners = np.stack([foot - side, foot + side, foot + lean], axis=1)
        pieces.append(uniform(corners.reshape(-1, 3), np.arange(3 * count), "grass"))
    return pieces


# An object that stands in the car park
class Thing(NamedTuple):
    # name, kind: see `Instance`
    name: str
    kind: str
    at: tuple[float, float]  # east and north of its origin [m]
    # its parts, of surfaces of `_SURROUNDINGS`; or a function of a random generator and the number of leaves
    # of a tree that returns them
    parts: Iterable[Part] | Callable[[np.random.Generator, int], Iterable[Part]]
    key: tuple[int, ...] = ()  # distinguishes its random numbers
    jitter: tuple[float, float] = (0.0, 0.0)  # maximum random shift to the east and north [m]


def _panels(layout: Layout) -> Iterator[Thing]:
    begin, end = layout.aisles[0]
    pitch = (end - begin) / len(PANELS)
    for line, north in enumerate(np.arange(_PANEL_START + _PANEL_SIZE / 2, layout.length, _PANEL_PERIOD)):
        for place, level in enumerate(PANELS):
            panel = f"panel_{round(100 * level):02d}"
            plate = Part(cuboid, ((_PANEL_SIZE, _PANEL_SIZE, 0.03), panel), (0.0, 0.0, -0.01))
            yield Thing(
                f"{panel}_{line:03d}", "panel", ((begin + (place + 0.5) * pitch, float(north))), (plate,)
            )


def _trees(layout: Layout) -> Iterator[Thing]:
    places = {
        f"tree_west_{number:03d}": (layout.west_trees, float(y))
        for number, y in enumerate(np.arange(2.5, layout.length, _TREE_PITCH))
    }
    for bay, row in layout.islands:
        begin, end = layout.rows[row]
        places[f"tree_{bay:03d}_{begin:+.0f}"] = (0.5 * (begin + end), (bay + 0.5) * BAY[1])
    for name, (east, north) in places.items():
        key = _TREES, round(1000 * north), round(1000 * (east + layout.width))
        yield Thing(name, "tree", (east, north), _tree, key, (0.2, 0.5))


def _walls(layout: Layout) -> Iterator[Thing]:
    # 1.6 m high, 0.24 m thick, with a coping
    length = layout.length
    body = Part(cuboid, ((0.24, length, 1.6 + 0.05), "brick"), (0, length / 2, -0.05))
    coping = Part(cuboid, ((0.24 + 0.08, length, 0.06), "concrete"), (0, length / 2, 1.6))
    yield Thing("wall", "wall", (layout.wall, 0.0), (body, coping))


#: A lamp, 6 m high, the arm to the east.
_LAMP = (
    Part(tube, ((0, 0, -0.05), (0, 0, 6.0), (0.07, 0.045), "steel", "", 8), crease=_CREASE_DEG),
    Part(tube, ((0, 0, 6.0), (1.2, 0, 6.0 + 0.12), (0.035, 0.03), "steel", "", 6), crease=_CREASE_DEG),
    Part(cuboid, ((0.55, 0.24, 0.07), "steel"), (1.2 + 0.2, 0, 6.0 + 0.09)),
    Part(cuboid, ((0.45, 0.18, 0.02), "lamp"), (1.2 + 0.2, 0, 6.0 + 0.075)),
    Part(cuboid, ((0.3, 0.3, 0.1), "steel"), (0, 0, -0.02)),
)


#: Objects around the cars by kind, in the order in which a scene has them.
_NEIGHBOURS: dict[str, Callable[[Layout], Iterable[Thing]]] = {
    "trees": _trees,
    "walls": _walls,
    "hedges": lambda layout: [
        Thing("hedge", "tree", (layout.hedge, 0.0), lambda rng, _: _hedge(rng, layout.length), (_TREES,))
    ],
    "lamps": lambda layout: [
        Thing(f"lamp_{number:03d}", "other", (-0.5 * layout.width + 0.6, float(north)), _LAMP)
        for number, north in enumerate(np.arange(8.75, layout.length, _LAMP_PITCH))
    ],
}

#: Kinds of objects around the cars.
NEIGHBOURS = tuple(_NEIGHBOURS)


def car_park(
    *,
    length: float = 50.0,
    width: float = 32.0,
    rows: int | None = None,
    occupancy: float = 0.85,
    paints: Sequence[str] | None = None,
    fleet: str = "solid",
    types: Sequence[str] | None = None,
    seed: int = 0,
    neighbours: Sequence[str] = ("trees", "walls", "lamps"),
    panels: bool = True,
    islands: bool = True,
    coat: Coat | Literal["own"] | None = "own",
    flakes: bool = True,
    line_width: float = 0.12,
    leaves: int = 2000,
    margin: float = 30.0,
    name: str = "car park",
) -> Scene:
    """Return a car park.

    Parameters
    ----------
    length
    width
    rows
    occupancy
    paints
    fleet
    types
    seed
    neighbours
    panels
    islands
    coat
        Clear coat of all paints; "own" for the coat of each paint in the catalogue (``Coat()`` for paints
        beyond the catalogue), None for Lambert paints.
    flakes
        Whether paints have the metal flakes of the catalogue; paints without a coat have none.
    line_width
    leaves
    margin
    name
        Name of the scene.

    Returns
    -------
    Scene
        Instances "ground", "car_000", "panel_20_000", "tree_west_000", "wall" ... ; `Scene.face_part` has the
        part of a car of every triangle.

    Raises
    ------
    SchemaError
        The rows do not fit into the width, a number is out of range, or a name is unknown; all problems are
        listed.

    Examples
    --------
    >>> park = car_park(length=10.0, width=16.0, neighbours=())
    >>> sorted({one.kind for one in park.instances})
    ['car', 'ground', 'panel']
    """
    values: dict[str, Any] = {
        "length": length, "width": width, "rows": rows, "occupancy": occupancy, "paints": paints,
        "fleet": fleet, "types": types, "seed": seed, "neighbours": neighbours, "panels": panels,
        "islands": islands, "line_width": line_width, "leaves": leaves, "margin": margin,
    }  # fmt: skip
    for key in ("paints", "types", "neighbours"):  # any collection of names, such as an array
        if isinstance(values[key], Collection) and not isinstance(values[key], str):
            values[key] = list(values[key])
    with Problems("the car park cannot be laid out", SchemaError) as problems:
        note_car_park_faults(values, problems)
    if paints is None:
        first = int(np.random.default_rng([seed, _PAINTS]).integers(0, 10**8)) if fleet == "real" else 0
        paints = fleet_names(first, _LOT.fleet_size) if fleet == "real" else FOURTEEN
    cards = tuple(paints)
    surroundings = _WORN if fleet == "real" else _SURROUNDINGS
    layout = strips_across(
        length,
        width,
        rows,
        margin=margin,
        line_width=line_width,
        islands=islands,
        walls="walls" in neighbours,
    )
    ground = put_together([built(paved(layout)), *worn(layout, seed)])
    scenes = [ground.scene(surroundings, Instance("ground", "ground"))]

    def placed(things: Iterable[Thing]) -> Iterator[Scene]:
        for thing in things:
            rng = np.random.default_rng([seed, *thing.key])
            mesh = built(thing.parts(rng, leaves) if callable(thing.parts) else thing.parts)
            east, north = np.add(thing.at, rng.uniform(np.negative(thing.jitter), thing.jitter))
            yield mesh.shifted((east, north, 0.0)).scene(surroundings, Instance(thing.name, thing.kind))

    if panels:
        scenes += placed(_panels(layout))
    dealt = 0  # paints go by cars, not by places, so that none is lost to an empty bay
    kinds = tuple(CAR_TYPES) if types is None else tuple(types)
    for bay, (row, (begin, end)) in itertools.product(range(layout.bays), enumerate(layout.rows)):
        rng = np.random.default_rng([seed, _CARS, bay, row])
        if rng.random() >= occupancy or (bay, row) in layout.islands:
            continue
        # consecutive cars use every paint once before any is used again; a fleet is spread evenly as it comes
        deck, card = divmod(dealt, len(cards))
        if len(cards) != _LOT.fleet_size:
            card = int(np.random.default_rng([seed, _PAINTS, deck]).permutation(len(cards))[card])
        car, paint = f"car_{bay * len(layout.rows) + row:03d}", cards[card]
        dealt += 1
        # its material: coat and flakes of the catalogue unless given
        name_of_paint = f"paint of {car}"
        surface = (
            paint_spec(paint).material(name_of_paint)
            if is_paint(paint)
            else Material(name_of_paint, paint, "paint", Coat())
        )
        own_coat = surface.coat if coat == "own" else coat
        surface = replace(surface, coat=own_coat, flakes=surface.flakes if flakes and own_coat else None)
        # its type, and its place in the bay
        chances = np.array([CAR_TYPES[kind].share for kind in kinds])
        body = car_body(kinds[int(rng.choice(len(chances), p=chances / chances.sum()))], rng)
        spare = max(end - begin - float(np.ptp(body.vertices[:, 1])) - 0.1, 0.0)
        east = 0.5 * (begin + end) + spare * rng.uniform(-0.4, 0.4)
        north = (bay + 0.5) * BAY[1] + float(np.clip(rng.normal(0.0, 0.09), -0.2, 0.2))
        # most drive in nose first: away from the aisle
        heading = (90.0 if rng.random() < (0.7 if row % 2 else 0.3) else 270.0) + rng.normal(0.0, 1.2)
        standing = body.scene({**surroundings, "paint": surface}, Instance(car, "car", paint))
        scenes.append(standing.moved((east, north, 0.0), heading))
    for kind, things in _NEIGHBOURS.items():
        if kind in neighbours:
            scenes += placed(things(layout))
    return Scene.join(scenes, name)


_LENGTH: dict[str, Any] = {"kind": "number", "unit": "m", "scale": 1.0, "most": 10_000.0}

#: Facts of the arguments of `car_park`; ``key`` is the spelling in ``[scene]`` of a ``scene.toml``.
CAR_PARK = argument_facts(
    car_park,
    (
        Fact(
            name="length", key="length_m", **_LENGTH, least=0.0, above=True,
            doc="length of the car park, northwards from y = 0",
        ),
        Fact(
            name="width", key="width_m", **_LENGTH, least=0.0, above=True,
            doc="width of the car park; 16 m hold two rows of cars and an aisle, 32 m four rows",
        ),
        Fact(name="rows", kind="whole", least=1, most=MAX_ROWS,
             doc="number of rows of parking bays; by default all that fit"),
        Fact(name="occupancy", kind="number", least=0.0, most=1.0,
             doc="share of the parking bays with a car"),
        Fact(
            name="paints", kind="words",
            doc="names of the paint spectra of the cars, instead of the spectra of the fleet; every spectrum "
            "is used once before one is used again",
        ),
        Fact(
            name="fleet", kind="choice", choices=FLEETS,
            doc="paints of the cars and state of the ground; real: colours, finishes, age and dust as in "
            "real car parks, on worn ground; solid: fourteen non-metallic paints in equal numbers, on clean "
            "ground",
        ),
        Fact(name="types", kind="words", choices=tuple(CAR_TYPES),
             doc="types of cars in the scene; by default all types"),
        Fact(name="seed", kind="whole", least=0, most=MAX_SEED,
             doc="seed of the random numbers for cars, paints, positions and trees"),
        Fact(
            name="neighbours", kind="words", choices=NEIGHBOURS,
            doc="objects around the car park; [] for none",
        ),
        Fact(name="panels", kind="flag",
             doc="whether grey panels of known reflectance lie every 30 m along an aisle"),
        Fact(name="islands", kind="flag",
             doc="whether kerbed islands with grass replace about every tenth bay"),
        Fact(
            name="line_width", key="line_width_m", **_LENGTH | {"most": 1.0}, least=0.02,
            doc="width of the painted lines between parking bays",
        ),
        Fact(name="leaves", kind="whole", least=0, most=100_000, doc="number of leaves of a tree"),
        Fact(
            name="margin", key="margin_m", **_LENGTH, least=0.0,
            doc="width of the strip of ground around the car park",
        ),
    ),
)  # fmt: skip


def note_car_park_faults(
    values: Mapping[str, Any], problems: Problems, spelled: Spelling = as_argument
) -> None:
    before = len(problems)
    check_values(CAR_PARK, values, problems, spelled)
    for name in ("paints", "types"):
        if values[name] is not None and not values[name]:
            problems.add(spelled(name, values[name]), expected="at least one name", code="empty-input")
    if len(problems) > before:
        return
    rows = values["rows"] or 1
    least = _least_width(rows)
    problems.add_if(
        values["width"] + _LOT.rounding_m < least,
        spelled("width", values["width"]),
        expected=f"{least:.1f} m or more for {rows} rows of bays",
        mend="make it wider, or take fewer rows",
        code="car-park-too-narrow",
    )


_GLOSS = Coat(1.5, 0.02, waviness=0.0)  # glass has no orange peel

#: Materials other than car paint, by the names that meshes use.
_SURROUNDINGS = {
    name: Material(name, spectrum, kind, coat)
    for name, spectrum, kind, coat in (
        ("asphalt", "asphalt", "asphalt", None),
        ("patch", "patch", "asphalt", None),
        ("line", "painted_line", "line", None),
        ("concrete", "concrete", "concrete", None),
        ("grass", "grass", "grass", None),
        ("glass", "glass", "glass", _GLOSS),
        ("trim", "trim", "trim", None),
        ("tyre", "tyre", "tyre", None),
        ("rim", "aluminium", "trim", None),
        ("lamp", "lamp_clear", "lamp", _GLOSS),
        ("tail_lamp", "lamp_red", "lamp", _GLOSS),
        ("plate", "painted_line", "trim", None),
        ("leaf", "leaf", "leaf", None),
        ("bark", "bark", "other", None),
        ("brick", "brick", "wall", None),
        ("steel", "steel", "other", None),
        *((f"panel_{round(100 * level):02d}",) * 2 + ("panel", None) for level in PANELS),
    )
}

#: The same after some years, and leaves that light shines through.
_WORN = {
    **_SURROUNDINGS,
    **{
        name: replace(_SURROUNDINGS[name], spectrum=spectrum)
        for name, spectrum in (
            ("asphalt", "worn_asphalt"),
            ("patch", "worn_patch"),
            ("line", "worn_line"),
            ("concrete", "weathered_concrete"),
            ("grass", "mixed_grass"),
        )
    },
    "leaf": replace(_SURROUNDINGS["leaf"], transmittance="leaf_through"),
}


def _tree(rng: np.random.Generator, leaves: int) -> list[Part]:
    # radius of its crown and height of its top [m]
    crown = rng.uniform(1.4, 2.1)
    height = crown * rng.uniform(2.4, 3.0)
    middle = np.array([0.0, 0.0, height - 0.95 * crown])
    blobs = 9
    direction = _directions(rng, blobs)
    direction[:, 2] = 0.75 * np.abs(direction[:, 2]) - 0.2
    centres = middle + crown * 0.55 * direction
    radii = crown * rng.uniform(0.38, 0.52, blobs)
    chosen = rng.choice(blobs, leaves, p=radii**2 / (radii**2).sum())
    outward = _directions(rng, leaves)
    places = centres[chosen] + (radii[chosen] * rng.uniform(0.55, 1.0, leaves) ** 0.5)[:, None] * outward
    places[:, 2] = np.minimum(places[:, 2], height)
    trunk = (0, 0, -0.05), middle, (0.045 * crown + 0.06, 0.05), "bark", "", 8
    fork = middle - (0, 0, 0.4 * crown)
    return [
        _foliage(rng, places, outward),
        Part(tube, trunk, crease=_CREASE_DEG),
        *(Part(tube, (fork, centre, (0.05, 0.02), "bark", "", 5)) for centre in centres[:5]),
    ]


def _hedge(rng: np.random.Generator, length: float) -> list[Part]:
    # From the origin to the north, clipped, with 160 leaves a square metre of its outside.
    height, thickness = 1.3, 0.7
    core = (0.8 * thickness, length - 0.1, 0.9 * height), "leaf"
    top, side, end = length * thickness, length * height, thickness * height
    sizes = np.array([top, side, side, end, end])
    normals = np.array([[0, 0, 1], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], np.float64)
    count = int(160.0 * sizes.sum())
    outward = normals[rng.choice(5, count, p=sizes / sizes.sum())]
    inside = rng.uniform(-1.0, 1.0, (count, 3))
    places = np.where(outward != 0, outward * rng.uniform(0.85, 1.0, (count, 1)), inside)
    places = 0.5 * places * (thickness, length, height) + (0.0, 0.5 * length, 0.5 * height)
    return [_foliage(rng, places, outward), Part(cuboid, core, (0, length / 2, -0.05))]


def _directions(rng: np.random.Generator, count: int) -> Floats:
    vectors = rng.standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _foliage(rng: np.random.Generator, places: Floats, outward: Floats) -> Part:
    # Leaves at ``places`` (leaf, 3) face roughly ``outward`` (leaf, 3) and up.
    count = len(places)
    facing = outward + (0.0, 0.0, 0.5) + 0.9 * rng.standard_normal((count, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    along = np.cross(facing, _directions(rng, count))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    size = _LEAF * rng.uniform(0.7, 1.3, (count, 1))
    fold = 0.12 * size * facing
    tip, edge = 0.5 * size * along, 0.32 * size * np.cross(facing, along)
    corners = np.stack([places - tip, places + edge + fold, places + tip, places - edge + fold], axis=1)
    faces = ((4 * np.arange(count)[:, None, None]) + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Part(uniform, (corners.reshape(-1, 3), faces, "leaf"))
