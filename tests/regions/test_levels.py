"""Levels of crowned roofs against roofs whose shape and paint are known in closed form."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.regions.proposals import (
    Footprint,
    Level,
    Place,
    Roof,
    find_roof,
    height_model_of,
    level_light,
    level_place,
    measured_lean,
)

Floats = npt.NDArray[np.float64]
AXIS = np.array([0.0, 1.0])
PLACE = Place(20.3, 40.2, 1.0, 0.4, 15.0, 22.0)
CROWN_RAD = PLACE.crown / PLACE.half_width
"""Lean a pixel, along and across."""


class Sun(NamedTuple):
    # Where the sun stands over a roof that points to the right [degree]
    zenith: float
    azimuth: float

    @property
    def direction(self) -> Floats:
        # Unit vector (along, across, up)
        zenith, azimuth = np.radians([self.zenith, self.azimuth])
        return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


def crowned(sun: Sun, flakes: float = 0.0, shape: tuple[int, int] = (40, 80)) -> Floats:
    # Return the brightness of a roof of constant curvature, 1 where it is level, seen from straight above
    # A Lambertian body, and a share of flakes whose normals are spread by 12 degrees about the roof's, which
    # mirror the sun into the camera
    y, x = np.indices(shape, np.float64)
    # the car's own axes: across is line * axis[1] - column * axis[0]
    lean = np.stack([(x - PLACE.column) * CROWN_RAD[0], (y - PLACE.line) * CROWN_RAD[1], np.ones(shape)])
    normal = lean / np.linalg.norm(lean, axis=0)
    half = sun.direction + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)

    def light(normal: Floats) -> Floats:
        off = np.tan(np.arccos(np.clip(np.tensordot(half, normal, 1), -1.0, 1.0)))
        body = np.tensordot(sun.direction, normal, 1)
        return np.asarray(
            (1.0 - flakes) * body + 8.0 * flakes * np.exp(-((off / np.tan(np.radians(12.0))) ** 2))
        )

    return light(normal) / light(np.array([0.0, 0.0, 1.0]))


def level_of(brightness: Floats, place: Place = PLACE) -> Level:
    level = level_light(brightness, np.ones(brightness.shape, bool), place, AXIS)
    assert level is not None
    return level


@pytest.mark.parametrize("flakes", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("sun", [Sun(20.0, 30.0), Sun(35.0, -90.0), Sun(45.0, 70.0), Sun(58.0, 180.0)])
def test_level__is_that_of_the_level_place(sun: Sun, flakes: float) -> None:
    # Rationale: over a roof the lobe of flakes is steep and bent, where a plane takes another level
    # Expected: within 1.5 % of the truth and within its own uncertainty, with the noise of a camera
    noise = 1.0 + 0.01 * np.random.default_rng(1).normal(size=(40, 80))
    level = level_of(crowned(sun, flakes) * noise)
    assert abs(level.brightness - 1.0) < 0.015
    assert abs(level.brightness - 1.0) < 2.0 * level.sd


@pytest.mark.parametrize("zenith", [25.0, 45.0, 60.0])
@pytest.mark.parametrize("azimuth", [0.0, 35.0, 90.0])
def test_change_with_lean__is_the_tangent_of_a_solid_paint(zenith: float, azimuth: float) -> None:
    # Rationale: d ln(cos) = tan(zenith) towards the sun. Expected: that, whatever the azimuth, to 2 %.
    change = level_of(crowned(Sun(zenith, azimuth))).lean_change
    assert change == pytest.approx(np.tan(np.radians(zenith)), rel=0.02)


def test_change_with_lean__is_more_of_flakes() -> None:
    # Expected: more than three times that of a solid paint at 20 degrees from the mirror direction
    sun = Sun(40.0, 90.0)
    assert level_of(crowned(sun, 0.7)).lean_change > 3.0 * level_of(crowned(sun)).lean_change


def test_glint__is_left_out() -> None:
    # Rationale: drops and dents mirror the sun, and only add. Expected: the level stays to 0.5 %.
    seen = crowned(Sun(40.0, 60.0))
    with_glint = seen.copy()
    with_glint[np.random.default_rng(4).random(seen.shape) < 0.08] *= 1.6
    assert level_of(with_glint).brightness == pytest.approx(level_of(seen).brightness, rel=0.005)


def test_level__scales_with_brightness_and_is_that_of_the_mirror_image() -> None:
    # Expected: three times as bright is three times the level; sd and change with lean stay
    seen = crowned(Sun(50.0, 20.0), 0.4)
    one, other = level_of(seen), level_of(3.0 * seen)
    assert (other.brightness, other[1:]) == (pytest.approx(3.0 * one.brightness), pytest.approx(one[1:]))
    # Expected: a picture flown the other way gives the same level, sd and change with lean
    mirrored = PLACE._replace(column=seen.shape[1] - 1.0 - PLACE.column)
    assert tuple(level_of(seen[:, ::-1], mirrored)) == pytest.approx(tuple(level_of(seen)))


def test_level__is_as_unsure_as_its_place() -> None:
    # Expected: relative change a pixel times how far the place may be off, where that is all there is
    seen = crowned(Sun(55.0, 90.0))
    slope = np.tan(np.radians(55.0)) * CROWN_RAD[1]
    level = level_of(seen, PLACE._replace(across_sd=2.0))
    assert level.sd == pytest.approx(2.0 * slope, rel=0.05)


def test_too_little__has_no_level() -> None:
    # Expected: None of a roof of which 20 pixels are lit
    lit = np.zeros((40, 80), bool)
    lit[18:22, 38:43] = True
    assert level_light(crowned(Sun(40.0, 0.0)), lit, PLACE, AXIS) is None


# --- the axis between the edges of a roof ------------------------------------------------------------------


def roofed(middle: float, half: float, slope: float) -> tuple[Footprint, Roof]:
    # Return a roof whose brightness falls by ``slope`` a pixel across, and its footprint
    y, x = np.indices((60, 90), np.float64)
    # what a pixel shows is the mean over it
    paint = np.clip(half + 0.5 - np.abs(y - middle), 0.0, 1.0)
    brightness = np.exp(-slope * (y - middle)) * paint + 0.1 * (1.0 - paint)
    inside = (np.abs(y - int(middle) - 1.0) < 0.75 * half) & (x > 20) & (x < 70)
    footprint = Footprint(
        (0, 0),
        paint > 0.5,
        np.ones(paint.shape, bool),
        brightness,
        AXIS,
        np.array([30.0, 45.0]),
        90.0,
        60.0,
        False,
    )
    return footprint, Roof(inside, (int(middle) + 1.0, 45.0), AXIS, 1.5, 1.7, "", 1.0, True, True, 0.0)


@pytest.mark.parametrize("slope", [0.0, 0.03, -0.06])
@pytest.mark.parametrize("middle", [30.0, 29.3, 30.6])
def test_axis__is_halfway_between_edges(middle: float, slope: float) -> None:
    # Rationale: windows tell pixels, and shading moves an edge. Expected: 0.3 of one.
    footprint, roof = roofed(middle, 13.0, slope)
    place = level_place(footprint, roof)
    assert (place.line, place.column) == (pytest.approx(middle, abs=0.3), pytest.approx(45.0))
    assert place.half_width == pytest.approx(13.5, abs=0.5)


def test_axis__is_less_sure_without_edges() -> None:
    # Expected: where windows say it is, and as surely, where paint ends nowhere
    footprint, roof = roofed(30.0, 13.0, 0.02)
    endless = level_place(footprint._replace(brightness=np.ones((60, 90))), roof)
    assert (endless.line, endless.across_sd) == (31.0, pytest.approx(1.7 / np.sqrt(3.0)))


# --- which section is a roof -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("windows", "beside", "width", "is_roof"),
    [
        (((40, 50), (61, 70)), 0, 40, False),  # a roof is longer than 12 % of its car
        (((40, 50), (63, 72)), 0, 40, True),
        (((0, 10), (29, 39)), 19, 40, False),  # than 20 % without a bonnet before its windscreen
        (((0, 10), (31, 41)), 21, 40, True),
        (((0, 25), (55, 65)), 4, 40, False),  # with side windows along 15 % of it
        (((0, 25), (55, 65)), 5, 40, True),
        (((11, 21),), 0, 40, False),  # the roof of a van is at most 78 % of it
        (((11, 23),), 0, 40, True),
        (((30, 46),), 0, 40, False),  # and at least 55 %
        (((30, 44),), 0, 40, True),
        (((9, 24),), 0, 40, False),  # a bonnet has 10 % at least
        (((20, 41),), 0, 40, False),  # and a windscreen 20 % at most
        (((20, 39),), 0, 40, True),
        (((35, 55),), 21, 40, False),  # a section that is longer than a bonnet has side windows along half
        (((35, 55),), 24, 40, True),
        (((50, 70),), 17, 40, False),  # any other along 60 %
        (((50, 70),), 19, 40, True),
        (((20, 39),), 0, 60, False),  # cars are 1.7 to 3.3 times as long as wide
        (((20, 39),), 0, 58, True),
        (((20, 39),), 0, 30, False),
        (((20, 39),), 0, 31, True),
    ],
)
def test_roofs__are_told_by_proportions(
    windows: tuple[tuple[int, int], ...], beside: int, width: int, is_roof: bool
) -> None:
    # Expected: a roof on one side of every threshold, none on the other; side windows begin the section
    level = np.full((width, 100), 0.5)
    for first, last in windows:
        level[6 : width - 6, first:last] = 0.02
    section = windows[0][1]
    level[3:6, section : section + beside] = level[width - 6 : width - 3, section : section + beside] = 0.02
    area = np.ones(level.shape, bool)
    centre = np.array([0.5 * (width - 1), 49.5])
    car = Footprint((0, 0), level > 0.1, area, level / 0.5, AXIS, centre, 100.0, float(width), False)
    assert isinstance(find_roof(car, level), Roof) is is_roof


# --- Leans of roofs from height models


SPACING, SHAPE = 0.04, (40, 50)
NORTH = np.array([1.0, 0.0])
"""Shadows fall to later lines, so that the sun is towards earlier ones."""


def leaning(lean_deg: float) -> np.ndarray:
    # Return ground with a roof of 1.2 x 1.6 m, whose ends lie 5 cm below its middle, leaning to the sun
    y, x = (np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2) * SPACING
    top = 1.5 - 0.05 * ((y / 0.6) ** 2 + (x / 0.8) ** 2) + y * np.tan(np.radians(lean_deg))
    return np.where((np.abs(y) <= 0.6) & (np.abs(x) <= 0.8), top, 0.0)


def lean_of(height: np.ndarray | None, prior: float = 1.1) -> tuple[float, float, float]:
    window = np.s_[6:35, 7:44]
    inside = np.ones((29, 37), bool)
    model = None if height is None else (height, SPACING)
    sd, shift, angle = measured_lean(model, window, inside, (14.0, 18.0), prior, NORTH)
    return sd, float(shift[0]), angle


@pytest.mark.parametrize("lean", [-2.0, 0.0, 1.5])
def test_lean__is_that_of_the_heights(lean: float) -> None:
    # Rationale: z = -0.05 (y / 0.6)^2 + y tan(b) is level tan(b) 0.36 / 0.1 m from its middle
    # Expected: that lean, and the way to where it is level, shortened by what was thought before
    sd, shift, angle = lean_of(leaning(lean))
    weight = 1.1**2 / (1.1**2 + 0.3**2)
    assert angle == pytest.approx(lean, abs=1e-6)
    assert shift == pytest.approx(weight * np.tan(np.radians(lean)) * 0.36 / 0.1 / SPACING, abs=1e-6)
    assert sd == pytest.approx(1.1 * 0.3 / np.hypot(1.1, 0.3), rel=1e-6)


def test_noise__is_stated() -> None:
    # Rationale: 1 cm of noise that is alike over 15 cm. Expected: found leans scatter as is stated.
    rng = np.random.default_rng(2)
    found, stated = [], []
    for _ in range(200):
        rough = np.kron(0.01 * rng.normal(size=(10, 13)), np.ones((4, 4)))[: SHAPE[0], : SHAPE[1]]
        sd, _, angle = lean_of(leaning(1.0) + rough, prior=50.0)
        found.append(angle)
        stated.append(np.sqrt(sd**2 - 0.3**2))
    assert np.std(found) == pytest.approx(np.mean(stated), rel=0.25)
    assert np.mean(found) == pytest.approx(1.0, abs=0.1)


def test_bare_ground_and_flat_roofs_have_no_lean() -> None:
    # Rationale: most height models show the ground without cars. Expected: as if there were none.
    assert lean_of(np.add.outer(0.02 * np.arange(40.0), np.zeros(50)))[:2] == lean_of(None)[:2] == (1.1, 0.0)
    y = (np.arange(40) - 20) * SPACING
    height = np.full(SHAPE, 1.5) + 0.05 * y[:, None]
    height[:4] = height[-4:] = 0.0
    assert not np.isfinite(lean_of(height)[1])
    # Expected: the spacing of pixels from their places; None of a line without places
    y, x = np.indices((5, 6)).astype(np.float64)
    dims = ("along_track", "cross_track")
    line = xr.Dataset(coords={"east": (dims, 0.1 * x), "north": (dims, 0.1 * y), "ground_height": (dims, y)})
    model = height_model_of(line)
    assert model is not None
    assert model[1] == pytest.approx(0.1)
    assert height_model_of(line.drop_vars("north")) is None
    assert {"east", "north", "ground_height"} <= set(hp.base.schema.VARIABLES)
