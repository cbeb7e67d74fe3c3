"""A parametric car park: rows of bays with cars, aisles with grey panels, and what stands around them.

The park lies between x = -width/2 (west) and +width/2 (east), and from y = 0 northwards, so that a flight
line along x = 0 sees all of it. Across it lie grass with trees, a kerb, and then rows of bays and aisles in
turns: two rows share an aisle, and stand back to back with the next two. In the east it ends at a wall.
Random numbers come from generators keyed by (seed, bay, row), so that a longer park of the same seed contains
the cars of the shorter one, under the same names.

A crown is a cloud of leaves: two triangles each, bent along the midrib, most of them near the surface of a
few overlapping blobs and turned any way around facing outwards. Leaves are Lambert and let no light through.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import Fact, Spelling, argument_facts, as_argument, check_values
from hyperpaint.simulation.paint_spectra import PANELS
from hyperpaint.simulation.settings import FLEETS, MAX_SEED

from .car_bodies import CAR_TYPES, car_body
from .materials import Coat, Material
from .primitives import Mesh, cuboid, polygon, put_together, smoothed, tube, uniform
from .scene import Instance, Scene
from .scene_spectra import FOURTEEN, fleet_names, is_paint, paint_spec

#: Length and width of a bay [m].
BAY = (5.0, 2.5)

#: Maximum number of rows of bays.
MAX_ROWS = 199

_ROUNDING_M = 1e-9  # by which a width may be too small for its rows
_GRASS, _KERB, _GUTTER = 1.0, 0.3, 0.1  # widths of what lies west of the first row [m]
_AISLE, _WIDEST_AISLE = 4.5, 6.5
_KERB_HEIGHT, _LAWN = 0.12, 0.10  # above the asphalt [m]
_ISLAND_PERIOD, _ISLAND_START = 11, 7  # bays
_TUFTED = 2.5  # how far from the kerb the lawn has blades [m]
_WEAR = 4  # what a random number is for
_BEYOND = 7.0  # how far the asphalt goes on before the first bay and behind the last [m]


@dataclass(frozen=True)
class Layout:
    """Where things are in a car park; x from west to east, y from south to north [m].

    Attributes
    ----------
    length, width, margin, line_width
        As of the car park.
    rows, aisles
        West and east end of each.
    with_islands
        Whether islands take the place of some bays.
    """

    length: float
    width: float
    margin: float
    line_width: float
    rows: tuple[tuple[float, float], ...]
    aisles: tuple[tuple[float, float], ...]
    with_islands: bool

    @property
    def bays(self) -> int:
        # Number of bays in a row, the last one perhaps only begun.
        return int(np.ceil(round(self.length / BAY[1], 9)))

    @property
    def kerb(self) -> tuple[float, float]:
        west = -0.5 * self.width + _GRASS
        return west, west + _KERB

    @property
    def east_kerb(self) -> tuple[float, float]:
        west = self.rows[-1][1] + _GUTTER
        return west, west + _KERB

    @property
    def wall(self) -> float:
        return max(0.5 * self.width - 0.5, self.east_kerb[1] + 0.2)

    @property
    def west_trees(self) -> float:
        # Line of trees in the west, just outside the park.
        return -0.5 * self.width - 0.3

    def is_island(self, bay: int, row: int) -> bool:
        # Whether an island takes the place of a bay; those of two rows back to back lie together.
        return self.with_islands and (bay + 5 * ((row + 1) // 2)) % _ISLAND_PERIOD == _ISLAND_START

    def islands(self) -> Iterator[tuple[int, tuple[float, float]]]:
        # Bay, and west and east end, of every island.
        for bay in range(self.bays):
            for row, ends in enumerate(self.rows):
                if self.is_island(bay, row):
                    yield bay, ends


def strips_across(
    length: float, width: float, rows: int | None, *, margin: float, line_width: float, islands: bool
) -> Layout:
    """Return the layout of ``rows`` of bays, as many as fit by default, and of aisles.

    Examples
    --------
    >>> layout = strips_across(20.0, 16.0, None, margin=10.0, line_width=0.1, islands=False)
    >>> [(round(a, 3), round(b, 3)) for a, b in (*layout.rows, *layout.aisles)]
    [(-6.6, -1.6), (2.9, 7.9), (-1.6, 2.9)]
    """
    edge = _GRASS + _KERB + _GUTTER
    wanted = rows or max(n for n in range(1, MAX_ROWS + 1) if _least_width(n) <= width + _ROUNDING_M)
    aisles = (wanted + 1) // 2
    aisle = min(_AISLE + (width - _least_width(wanted)) / aisles, _WIDEST_AISLE) if wanted < 4 else _AISLE
    west, row_ends, aisle_ends = edge - 0.5 * width, [], []
    for row in range(wanted):
        row_ends.append((west, west + BAY[0]))
        west += BAY[0]
        if row % 2 == 0:
            aisle_ends.append((west, west + aisle))
            west += aisle
    return Layout(length, width, margin, line_width, tuple(row_ends), tuple(aisle_ends), islands)


def _least_width(rows: int) -> float:
    return _GRASS + _KERB + 2 * _GUTTER + BAY[0] * rows + _AISLE * ((rows + 1) // 2)


def paved(layout: Layout) -> Mesh:
    """Return the ground, of the surfaces "asphalt", "line", "concrete" and "grass".

    Lines are cells of the ground, not plates upon it; kerbs and islands stand out of it. A sheet of asphalt
    a little deeper closes the joints.
    """
    south, north = -layout.margin, layout.length + layout.margin
    first, last = max(-_BEYOND, south), min(layout.length + _BEYOND, north)
    west, east = layout.kerb[1], layout.east_kerb[0]
    far_west, far_east = -0.5 * layout.width - layout.margin, 0.5 * layout.width + layout.margin
    pieces = [_level(far_west, far_east, south, north, "asphalt", -0.05)]
    # between the rows, and under the kerbs
    gaps = [
        (before[1], behind[0])
        for before, behind in itertools.pairwise([(west, west), *layout.rows, (east, east)])
        if behind[0] - before[1] > 1e-6
    ]
    for begin, end in (*gaps, (layout.kerb[0], west), (east, layout.east_kerb[1])):
        pieces.append(_level(begin, end, first, last, "asphalt"))
    for begin, end in layout.rows:
        pieces += _bays(layout, begin, end, first, last)
    for begin, end in (layout.kerb, layout.east_kerb):
        kerb = cuboid((end - begin, last - first, _KERB_HEIGHT + 0.03), "concrete")
        pieces.append(kerb.shifted((0.5 * (begin + end), 0.5 * (first + last), -0.03)))
    for edge in (first - 0.5 * _KERB, last + 0.5 * _KERB):
        kerb = cuboid((layout.east_kerb[1] - layout.kerb[0], _KERB, _KERB_HEIGHT + 0.04), "concrete")
        pieces.append(kerb.shifted((0.5 * (layout.east_kerb[1] + layout.kerb[0]), edge, -0.03)))
    lawns = [(far_west, layout.kerb[0], south, north), (layout.east_kerb[1], far_east, south, north)]
    lawns += [(layout.kerb[0], layout.east_kerb[1], *ends) for ends in ((south, first), (last, north))]
    pieces += [_level(*lawn, "grass", _LAWN) for lawn in lawns if lawn[1] > lawn[0] and lawn[3] > lawn[2]]
    for bay, (begin, end) in layout.islands():
        at = (0.5 * (begin + end), (bay + 0.5) * BAY[1])
        length, wide = end - begin - 0.1, BAY[1] - 0.3
        pieces += [
            cuboid((length, wide, _KERB_HEIGHT + 0.03), "concrete").shifted((*at, -0.03)),
            cuboid((length - 0.4, wide - 0.4, 0.06), "grass").shifted((*at, _KERB_HEIGHT - 0.03)),
        ]
    pieces += _arrows(layout)
    return put_together(pieces)


def worn(layout: Layout, seed: int) -> list[Mesh]:
    """Return traces of wear: stains in bays and patches in aisles, 3 mm thick, and tufts of grass.

    Its surfaces are "patch" and "grass".
    """
    pieces = []
    angle = 2 * np.pi * np.arange(11) / 11
    for row, (begin, end) in enumerate(layout.rows):
        for bay in range(layout.bays):
            rng = np.random.default_rng([seed, _WEAR, bay, row])
            if layout.is_island(bay, row) or rng.random() < 0.4:
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
            pieces.append(_level(west, west + size[0], south, south + size[1], "patch", 0.003))
    return [*pieces, *_tufts(layout, seed)]


def _tufts(layout: Layout, seed: int) -> list[Mesh]:
    # Blades of grass on the lawn nearest to the cars: one mesh for every bay's length.
    tufts = []
    for bay in range(layout.bays):
        rng = np.random.default_rng([seed, _WEAR, bay])
        east, count = layout.kerb[0], 300
        foot = rng.uniform(
            (east - _TUFTED, bay * BAY[1], _LAWN), (east, (bay + 1) * BAY[1], _LAWN), (count, 3)
        )
        lean = rng.normal(0.0, 0.05, (count, 3)) * (1, 1, 0) + (0, 0, 0.07)
        side = rng.normal(0.0, 0.06, (count, 3)) * (1, 1, 0)
        corners = np.stack([foot - side, foot + side, foot + lean], axis=1)
        tufts.append(uniform(corners.reshape(-1, 3), np.arange(3 * count), "grass"))
    return tufts


def _bays(layout: Layout, begin: float, end: float, first: float, last: float) -> Iterator[Mesh]:
    # One row of bays: asphalt and the painted lines.
    south = first
    for line in range(layout.bays + 1):
        low, high = (line * BAY[1] + side * 0.5 * layout.line_width for side in (-1, 1))
        if high > last:
            break
        if low > south:
            yield _level(begin, end, south, low, "asphalt")
        if low >= south:
            yield _level(begin, end, low, high, "line")
            south = high
    if last > south:
        yield _level(begin, end, south, last, "asphalt")


def _arrows(layout: Layout) -> Iterator[Mesh]:
    outline = [
        [[-0.09, -1.2], [0.09, -1.2], [0.09, 0.4], [-0.09, 0.4]],
        [[-0.32, 0.4], [0.32, 0.4], [0.0, 1.2]],
    ]
    for number, (begin, end) in enumerate(layout.aisles):
        way = -1.0 if number % 2 else 1.0
        for y in np.arange(10.0, layout.length, 15.0):
            for piece in outline:
                corners = [(0.5 * (begin + end) + way * px, y + way * py, 0.004) for px, py in piece]
                yield polygon(corners, "line")


def _level(west: float, east: float, south: float, north: float, surface: str, height: float = 0.0) -> Mesh:
    return polygon(
        [(west, south, height), (east, south, height), (east, north, height), (west, north, height)], surface
    )


#: Kinds of objects around the cars.
NEIGHBOURS = ("trees", "walls", "hedges", "lamps")

_PANEL_SIZE, _PANEL_PERIOD, _PANEL_START = 0.90, 30.0, 1.4  # grey panels lie along the aisle [m]
_TREE_PITCH, _LAMP_PITCH = 7.5, 25.0  # along the edges [m]
_CHANCE_OF_TYPE = {"sedan": 0.27, "hatchback": 0.28, "estate": 0.15, "suv": 0.18, "van": 0.06, "pickup": 0.06}
_LEAF = 0.20  # length of a leaf, or of the tuft that stands for several [m]
_CARS, _PAINTS, _TREES = 1, 2, 3  # what a random number is for


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
        Clear coat of all paints; "own" for what the catalogue says of each (``Coat()`` of paints it does not
        know), None for Lambert paints.
    flakes
        Whether paints have the metal flakes that the catalogue says; without a coat there are none.
    line_width
    leaves
    margin
    name
        Of the scene.

    Returns
    -------
    Scene
        Instances "ground", "car_000", "panel_20_000", "tree_west_000", "wall" ... ; `Scene.face_part` says
        which part of a car a triangle is.

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
    problems = Problems("the car park cannot be laid out", SchemaError)
    note_car_park_faults(values, problems)
    problems.raise_if_any()
    if paints is None:
        first = int(np.random.default_rng([seed, _PAINTS]).integers(0, 10**8)) if fleet == "real" else 0
        paints = fleet_names(first, _FLEET_SIZE) if fleet == "real" else FOURTEEN
    chosen = _Choices(
        tuple(paints),
        tuple(CAR_TYPES) if types is None else tuple(types),
        seed,
        occupancy,
        coat,
        flakes,
        _WORN if fleet == "real" else _SURROUNDINGS,
    )
    layout = strips_across(length, width, rows, margin=margin, line_width=line_width, islands=islands)
    ground = put_together([paved(layout), *worn(layout, seed)])
    things = [ground.scene(chosen.surroundings, Instance("ground", "ground"))]
    if panels:
        things += _panels(layout)
    things += _cars(layout, chosen)
    if "trees" in neighbours:
        things += _trees(layout, chosen, leaves)
    if "walls" in neighbours or "hedges" in neighbours:
        things += _enclosure(layout, chosen, neighbours)
    if "lamps" in neighbours:
        things += _lamps(layout)
    return Scene.join(things, name)


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
    if values["width"] + _ROUNDING_M < least:
        problems.add(
            spelled("width", values["width"]),
            expected=f"{least:.1f} m or more for {rows} rows of bays",
            mend="make it wider, or take fewer rows",
            code="car-park-too-narrow",
        )


@dataclass(frozen=True)
class _Choices:
    paints: tuple[str, ...]
    types: tuple[str, ...]
    seed: int
    occupancy: float
    coat: Coat | Literal["own"] | None
    flakes: bool
    surroundings: dict[str, Material]

    def material(self, name: str, paint: str) -> Material:
        surface = (
            paint_spec(paint).material(name) if is_paint(paint) else Material(name, paint, "paint", Coat())
        )
        coat = surface.coat if self.coat == "own" else self.coat
        return replace(surface, coat=coat, flakes=surface.flakes if self.flakes and coat else None)

    def paint(self, number: int) -> str:
        # Consecutive cars use every paint once before any is used again.
        if len(self.paints) == _FLEET_SIZE:  # spread evenly over the shares as they come
            return self.paints[number % _FLEET_SIZE]
        deck, card = divmod(number, len(self.paints))
        order = np.random.default_rng([self.seed, _PAINTS, deck]).permutation(len(self.paints))
        return self.paints[int(order[card])]

    def kind(self, rng: np.random.Generator) -> str:
        chances = np.array([_CHANCE_OF_TYPE[kind] for kind in self.types])
        return self.types[int(rng.choice(len(chances), p=chances / chances.sum()))]


#: Different cars of a fleet: more than a car park has bays.
_FLEET_SIZE = 5000


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


def _cars(layout: Layout, chosen: _Choices) -> Iterator[Scene]:
    dealt = 0  # paints go by cars, not by places, so that none is lost to an empty bay
    for bay in range(layout.bays):
        for row, (begin, end) in enumerate(layout.rows):
            rng = np.random.default_rng([chosen.seed, _CARS, bay, row])
            if rng.random() >= chosen.occupancy or layout.is_island(bay, row):
                continue
            place = bay * len(layout.rows) + row
            paint, car = chosen.paint(dealt), f"car_{place:03d}"
            dealt += 1
            body = car_body(chosen.kind(rng), rng)
            own = chosen.material(f"paint of {car}", paint)
            spare = max(end - begin - float(np.ptp(body.vertices[:, 1])) - 0.1, 0.0)
            east = 0.5 * (begin + end) + spare * rng.uniform(-0.4, 0.4)
            north = (bay + 0.5) * BAY[1] + float(np.clip(rng.normal(0.0, 0.09), -0.2, 0.2))
            # most drive in nose first: away from the aisle
            heading = (90.0 if rng.random() < (0.7 if row % 2 else 0.3) else 270.0) + rng.normal(0.0, 1.2)
            thing = body.scene({**chosen.surroundings, "paint": own}, Instance(car, "car", paint))
            yield thing.moved((east, north, 0.0), heading)


def _panels(layout: Layout) -> Iterator[Scene]:
    begin, end = layout.aisles[0]
    pitch = (end - begin) / len(PANELS)
    lines = np.arange(_PANEL_START + _PANEL_SIZE / 2, layout.length, _PANEL_PERIOD)
    for line, north in enumerate(lines):
        for place, level in enumerate(PANELS):
            name = f"panel_{round(100 * level):02d}"
            plate = cuboid((_PANEL_SIZE, _PANEL_SIZE, 0.03), "panel", "")
            at = (begin + (place + 0.5) * pitch, float(north), -0.01)
            panel = {"panel": Material(name, name, "panel")}
            yield plate.shifted(at).scene(panel, Instance(f"{name}_{line:03d}", "panel"))


def _trees(layout: Layout, chosen: _Choices, leaves: int) -> Iterator[Scene]:
    places = {
        f"tree_west_{number:03d}": (layout.west_trees, float(y))
        for number, y in enumerate(np.arange(2.5, layout.length, _TREE_PITCH))
    }
    for bay, (begin, end) in layout.islands():
        places[f"tree_{bay:03d}_{begin:+.0f}"] = (0.5 * (begin + end), (bay + 0.5) * BAY[1])
    for name, (east, north) in places.items():
        rng = np.random.default_rng(
            [chosen.seed, _TREES, round(1000 * north), round(1000 * (east + layout.width))]
        )
        crown = rng.uniform(1.4, 2.1)
        tree = _leafy_tree(rng, crown * rng.uniform(2.4, 3.0), crown, leaves)
        at = (east + rng.uniform(-0.2, 0.2), north + rng.uniform(-0.5, 0.5), 0.0)
        yield tree.shifted(at).scene(chosen.surroundings, Instance(name, "tree"))


def _enclosure(layout: Layout, chosen: _Choices, neighbours: Sequence[str]) -> Iterator[Scene]:
    if "walls" in neighbours:
        # 1.6 m high, 0.24 m thick, with a coping
        length = layout.length
        body = cuboid((0.24, length, 1.6 + 0.05), "brick").shifted((0, length / 2, -0.05))
        coping = cuboid((0.24 + 0.08, length, 0.06), "concrete").shifted((0, length / 2, 1.6))
        wall = put_together([body, coping]).shifted((layout.wall, 0.0, 0.0))
        yield wall.scene(chosen.surroundings, Instance("wall", "wall"))
    if "hedges" in neighbours:
        rng = np.random.default_rng([chosen.seed, _TREES])
        side = layout.wall - 0.8 if "walls" not in neighbours else layout.west_trees - 1.2
        leaves = _hedge(rng, layout.length).shifted((side, 0.0, 0.0))
        yield leaves.scene(chosen.surroundings, Instance("hedge", "tree"))


def _lamps(layout: Layout) -> Iterator[Scene]:
    # 6 m high, the arm to the east
    post = smoothed(tube((0, 0, -0.05), (0, 0, 6.0), (0.07, 0.045), "steel", sides=8))
    beam = smoothed(tube((0, 0, 6.0), (1.2, 0, 6.0 + 0.12), (0.035, 0.03), "steel", sides=6))
    head = cuboid((0.55, 0.24, 0.07), "steel").shifted((1.2 + 0.2, 0, 6.0 + 0.09))
    glass = cuboid((0.45, 0.18, 0.02), "lamp").shifted((1.2 + 0.2, 0, 6.0 + 0.075))
    foot = cuboid((0.3, 0.3, 0.1), "steel").shifted((0, 0, -0.02))
    lamp = put_together([post, beam, head, glass, foot])
    for number, north in enumerate(np.arange(8.75, layout.length, _LAMP_PITCH)):
        at = (-0.5 * layout.width + 0.6, float(north), 0.0)
        yield lamp.shifted(at).scene(_SURROUNDINGS, Instance(f"lamp_{number:03d}", "other"))


def _leafy_tree(rng: np.random.Generator, height: float, crown: float, leaves: int) -> Mesh:
    # At the origin; ``height`` of its top and radius of its ``crown`` [m].
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
    trunk = tube((0, 0, -0.05), middle, (0.045 * crown + 0.06, 0.05), "bark", sides=8)
    boughs = [
        tube(middle - (0, 0, 0.4 * crown), centre, (0.05, 0.02), "bark", sides=5) for centre in centres[:5]
    ]
    return put_together([_foliage(rng, places, outward), smoothed(trunk), *boughs])


def _hedge(rng: np.random.Generator, length: float) -> Mesh:
    # From the origin to the north, clipped, with 160 leaves a square metre of its outside.
    height, thickness = 1.3, 0.7
    core = cuboid((0.8 * thickness, length - 0.1, 0.9 * height), "leaf").shifted((0, length / 2, -0.05))
    top, side, end = length * thickness, length * height, thickness * height
    sizes = np.array([top, side, side, end, end])
    normals = np.array([[0, 0, 1], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], np.float64)
    count = int(160.0 * sizes.sum())
    outward = normals[rng.choice(5, count, p=sizes / sizes.sum())]
    inside = rng.uniform(-1.0, 1.0, (count, 3))
    places = np.where(outward != 0, outward * rng.uniform(0.85, 1.0, (count, 1)), inside)
    places = 0.5 * places * (thickness, length, height) + (0.0, 0.5 * length, 0.5 * height)
    return put_together([_foliage(rng, places, outward), core])


def _directions(rng: np.random.Generator, count: int) -> Floats:
    vectors = rng.standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _foliage(rng: np.random.Generator, places: Floats, outward: Floats) -> Mesh:
    # Leaves at ``places`` (leaf, 3) face roughly ``outward`` (leaf, 3) and up.
    count = len(places)
    facing = outward + (0.0, 0.0, 0.5) + 0.9 * rng.standard_normal((count, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    along = np.cross(facing, _directions(rng, count))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(facing, along)
    size = _LEAF * rng.uniform(0.7, 1.3, (count, 1))
    fold = 0.12 * size * facing
    tip, edge = 0.5 * size * along, 0.32 * size * aside
    corners = np.stack([places - tip, places + edge + fold, places + tip, places - edge + fold], axis=1)
    first = 4 * np.arange(count)[:, None, None]
    return uniform(corners.reshape(-1, 3), (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3), "leaf")
