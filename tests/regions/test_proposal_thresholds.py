"""Thresholds of proposals: inputs on both sides of each, so that twice or half of it changes a decision."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.regions.proposals import (
    JOININGS,
    MIRRORED_SKY,
    Car,
    CarPark,
    Footprint,
    Level,
    Measures,
    NoRoof,
    Picture,
    Piece,
    Place,
    Roof,
    Verdict,
    change_with_lean,
    find_cars,
    find_roof,
    footprints_of,
    judge_car,
    judge_level,
    judge_pixels,
    level_light,
    level_place,
    measured,
    pieces,
    region_of,
)
from hyperpaint.surroundings.model import SHADED

NM = np.linspace(412.0, 988.0, 24)
AXIS = np.array([0.0, 1.0])
LIMITS = {"erode": 3, "glint": 0.02, "shadow": 0.2, "adjacency": 0.02, "brightness": 0.03, "angle": 5.0} | {
    "min_pixels": 40,
    "max_level_u": 0.15,
}
#: Unit vectors (channel,) of a flat spectrum, and of one that is orthogonal to it.
FLAT, SLOPED = (
    np.ones(24) / np.sqrt(24.0),
    np.linspace(-1.0, 1.0, 24) / np.linalg.norm(np.linspace(-1, 1, 24)),
)
GROUND = 0.1 * np.ones(24)
RED = np.where(NM > 600.0, 0.6, 0.04)

Floats = npt.NDArray[np.float64]


def turned(level: float, degrees: float) -> Floats:
    # Spectrum of some mean length at an angle to a flat one
    angle = np.radians(degrees)
    return np.asarray(level * np.sqrt(24.0) * (np.cos(angle) * FLAT + np.sin(angle) * SLOPED))


def picture_of(
    *spectra: Floats, number: Any = None, diffuse: Any = 0.0, zenith: float = 45.0, **more: Any
) -> Picture:
    # Picture of the segments of a map (line, column), the first of them ground, under a uniform sky
    number = np.zeros((40, 40), np.int32) if number is None else np.asarray(number, np.int32)
    table, count = np.stack([GROUND, *spectra]), len(spectra) + 1
    sizes = np.array([number.size, *[1] * len(spectra)])
    model: Any = SimpleNamespace(
        attrs={}, channel_wavelength=NM, diffuse_fraction=np.broadcast_to(diffuse, 24), spectrum=table,
        reference=table, body=np.arange(count, dtype=np.int32), size=sizes, segments=count,
        segment=number, state=np.zeros(count, np.int8), edge_distance=np.full(number.shape, 99, np.uint8),
    )  # fmt: skip
    zero = np.zeros(number.shape)
    layers = {
        "glint_fraction": zero,
        "blocked_direct": zero,
        "adjacency": zero,
        "quality": zero.astype(np.uint16),
    }
    return Picture(model, table[number].astype(np.float32), layers, zenith, **more)


# --- pieces of bodies, and their pixels --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spectrum", "is_piece"),
    [
        (turned(0.1, 2.5), False),  # a spectrum within 3 degrees of the ground's, and within 0.2 in ln
        (turned(0.1, 4.0), True),
        (turned(0.115, 0.0), False),
        (turned(0.125, 0.0), True),
        (turned(0.0095, 0.0), False),  # windows before a black interior are as dark as 0.01
        (turned(0.011, 0.0), True),
    ],
)
def test_pieces__are_no_ground_and_no_window(spectrum: Floats, is_piece: bool) -> None:
    number = np.zeros((40, 40), np.int32)
    number[:, 30:] = 1
    assert len([*pieces(picture_of(spectrum, number=number).model, 3, 10)]) == is_piece


@pytest.mark.parametrize(
    ("level", "step", "spike", "usable"),
    [
        (0.02, 0.20, 0.0, 288),  # on dark paint 0.005 is allowed: a quarter of 0.02
        (0.02, 0.35, 0.0, 192),
        (0.3, 0.0, 0.6, 288),  # one pixel is a 25th of the square around it
        (0.3, 0.0, 1.0, 263),
    ],
)
def test_pixels__may_differ_a_little(level: float, step: float, spike: float, usable: int) -> None:
    picture = picture_of(number=np.zeros((12, 24)))
    picture.channels[:] = level
    picture.channels[:, 14:] *= 1.0 + step
    picture.channels[6, 6] *= 1.0 + spike
    assert measured(Piece(0, (0, 0), np.ones((12, 24), bool)), picture, LIMITS).pixels == usable


# --- verdicts ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("brightness", [0.03, 0.5])
@pytest.mark.parametrize("clouds", [0.0, 0.025])
def test_level__is_as_uncertain_as_its_parts(brightness: float, clouds: float) -> None:
    # A third of the glint is a contribution; signatures state the uncertainty of the mirrored sky themselves
    picture = picture_of(diffuse=diffuse_fraction(NM, 45.0), sun=(np.ones(40, bool), 0.1) if clouds else None)
    sky, sky_u = (float(part.mean()) for part in picture.sky)
    verdict = verdict_of(brightness + sky, glint=0.03)
    judge_level(verdict, picture, 0.0, Level(), LIMITS)
    parts = [0.008, 0.0099, 0.0007 / brightness, clouds]
    assert verdict.level_sd == pytest.approx(np.hypot.reduce([*parts, sky_u / brightness]))
    stated = region_of(verdict, "roof", "", {}).properties
    assert stated["level_uncertainty"] == pytest.approx(np.hypot.reduce(parts), abs=1e-5)
    assert stated["level_terms"][MIRRORED_SKY] == pytest.approx(sky_u / brightness, abs=1e-5)


def test_sky__is_that_of_the_direction_of_the_view() -> None:
    # Expected: by column the sky that a level coat mirrors to the camera, darker away from the sun
    view = np.stack([np.abs(np.linspace(-20.0, 20.0, 40)), np.repeat([0.0, 180.0], 20)], axis=1)
    picture = picture_of(diffuse=diffuse_fraction(NM, 45.0), view=view)
    sky, sky_u = picture.sky
    assert sky.shape == (40, 24)
    assert sky_u.shape == (40,)
    # the camera behind the sun's azimuth sees the sky opposite to the sun
    assert (sky[0] < sky[19]).all()
    assert (sky[19] < sky[-1]).all()
    window = np.s_[3:5, 7:9]
    np.testing.assert_array_equal(picture.without_sky(window), picture.channels[window] - sky[7:9])


def verdict_of(level: float, **measures: Any) -> Verdict:
    piece = Piece(0, (0, 0), np.ones((8, 8), bool))
    return Verdict(
        piece,
        Measures(piece.inside, np.full(24, level), {}, **{"pixels": 64, "glint": 0.0, **measures}),
        "roof",
    )


@pytest.mark.parametrize(
    ("sd", "brightness", "max_level_u", "is_refused"),
    [
        (0.075, 0.5, 0.15, False),  # half a 95 % interval of 15 % is 1.96 times 7.6 %
        (0.078, 0.5, 0.15, True),
        (0.150, 0.5, 0.30, False),  # the user's limit
        (0.155, 0.5, 0.30, True),
        (0.113, 0.02, 0.15, False),  # of paint darker than 0.03 the same as of 0.03: 0.0045 in reflectance
        (0.117, 0.02, 0.15, True),
    ],
)
def test_level__is_known_within_the_limit(
    sd: float, brightness: float, max_level_u: float, is_refused: bool
) -> None:
    # Without diffuse light no sky is mirrored; the other contributions are 0.008 and 0.0007 in reflectance
    picture, verdict = picture_of(), verdict_of(brightness)
    level_sd = np.sqrt(sd**2 - 0.008**2 - (0.0007 / brightness) ** 2)
    judge_level(verdict, picture, 0.0, Level(sd=level_sd), {**LIMITS, "max_level_u": max_level_u})
    assert verdict.level_sd == pytest.approx(sd)
    assert bool(verdict.objections) == is_refused
    assert verdict.level_terms["the position where it is level"] == level_sd


@pytest.mark.parametrize(
    ("sd", "lean", "direct", "is_refused"),
    [
        (0.056, 3.2, 0.9, False),  # in the lobe of flakes, from three times a solid body on, 3/4 of the limit
        (0.059, 3.2, 0.9, True),
        (0.059, 2.8, 0.9, False),
        (0.056, 4.0, 0.55, False),  # where half of the light is direct
        (0.059, 4.0, 0.55, True),
        (0.059, 4.0, 0.45, False),
    ],
)
def test_level__near_the_lobe_of_flakes_has_a_lower_limit(
    sd: float, lean: float, direct: float, is_refused: bool
) -> None:
    # Paint of 50 mirrors no sky to speak of
    picture, verdict = (
        picture_of(diffuse=1.0 - direct),
        verdict_of(50.0, glint=0.5 if lean > 3.0 and direct > 0.5 else 0.0),
    )
    level = Level(1.0, np.sqrt(sd**2 - 0.008**2), lean * direct * change_with_lean(45.0))
    judge_level(verdict, picture, 0.0, level, LIMITS)
    assert bool(verdict.objections) == is_refused


def car_of(paint: float, roof: float, windows: float, complete: bool = True) -> tuple[Car, Picture]:
    # A car of 100 x 40 pixels, and its picture: brightness of its paint and of its roof, level of its windows
    number = np.ones((40, 100), np.int32)
    number[2:38, 40:60] = 2
    picture = picture_of(paint * np.ones(24), roof * np.ones(24), number=number)
    inside = (number == 2) & (np.abs(np.indices(number.shape)[0] - 19.5) < 13.0)
    every = np.ones(number.shape, bool)
    footprint = Footprint(
        (0, 0), every, every, picture.level / paint, AXIS, np.array([19.5, 49.5]), 100.0, 40.0, False
    )
    found = Roof(inside, (19.5, 49.5), AXIS, 1.5, 0.5, "", 1.0, complete, False, windows)
    return Car([], footprint, found), picture


@pytest.mark.parametrize(
    ("level", "ratio", "zenith", "words"),
    [
        (0.3, 1.13, 20.0, ""),  # by 0.15 at most
        (0.3, 1.17, 20.0, "times as bright"),
        (0.3, 1.28, 60.0, ""),  # or by a lean of 10 degrees under a lower sun
        (0.3, 1.33, 60.0, "times as bright"),
        (0.14, 1.0, 20.0, "colour of the ground"),  # which is at most 1.5 times as bright
        (0.16, 1.0, 20.0, ""),
    ],
)
def test_parts__are_as_bright_as_other_paint(level: float, ratio: float, zenith: float, words: str) -> None:
    number = np.ones((40, 100), np.int32)
    number[:, 80:] = 2
    picture = picture_of(level * np.ones(24), ratio * level * np.ones(24), number=number, zenith=zenith)
    every = np.ones(number.shape, bool)
    paint = Footprint(
        (0, 0), number == 1, every, every * 1.0, AXIS, np.array([19.5, 49.5]), 100.0, 40.0, False
    )
    part = Piece(2, (5, 84), np.ones((30, 12), bool))
    (verdict,) = judge_car(Car([part], paint, NoRoof("", True)), picture, LIMITS)
    told = [text for text in verdict.objections if "bright" in text]
    assert bool(told) == bool(words)
    assert words in " ".join(told)
    # its lean is unknown by 7 degrees; its brightness changes by 3 over a radian of lean, like flakes
    assert (verdict.lean, verdict.level_sd) == (7.0, pytest.approx(3.0 * np.radians(7.0), rel=2e-3))


@pytest.mark.parametrize(
    ("paint", "roof", "windows", "complete", "words"),
    [
        (0.3, 0.3, 0.22, True, ""),  # windows are darker than paint by a quarter of it
        (0.3, 0.3, 0.23, True, "itself be a window"),
        (0.008, 0.008, 0.0053, True, ""),  # and by 0.0025
        (0.008, 0.008, 0.0057, True, "itself be a window"),
        (0.055, 0.055, 0.01, False, ""),  # dark roofs, below 0.05, lie between windows
        (0.045, 0.045, 0.01, False, "a dark roof needs"),
        (0.03, 0.0216, 0.01, True, ""),  # and are 0.7 to 1.4 times as bright as the other paint
        (0.03, 0.0204, 0.01, True, "a dark roof needs"),
        (0.03, 0.0411, 0.01, True, ""),
        (0.03, 0.0435, 0.01, True, "a dark roof needs"),
    ],
)
def test_roofs__differ_from_windows(
    paint: float, roof: float, windows: float, complete: bool, words: str
) -> None:
    car, picture = car_of(paint, roof, windows, complete)
    (verdict,) = judge_car(car, picture, LIMITS)
    told = " ".join(text for text in verdict.objections if "by hand" in text)
    assert words in told
    assert bool(told) == bool(words)


@pytest.mark.parametrize(
    ("step", "min_pixels", "pixels"),
    [
        (0.05, 40, 240),  # 240 pixels are near the level, which is more than 40
        (0.05, 250, 520),  # the others are within 2 times 3 % of it
        (0.08, 250, 320),  # 80 of them are within 4 times 3 %, away from the step
    ],
)
def test_pixels_of_roofs__are_near_the_level_where_enough_are(
    step: float, min_pixels: int, pixels: int
) -> None:
    # Rails on both sides of a roof are brighter by a step
    car, picture = car_of(0.3, 0.3, 0.05)
    line, column = np.indices((40, 100))
    is_rail = (np.abs(line - 19.5) > 6) & (column >= 40) & (column < 60)
    picture.channels[is_rail] *= 1.0 + step
    assert car.footprint is not None
    car.footprint.brightness[is_rail] *= 1.0 + step
    (verdict,) = judge_car(car, picture, {**LIMITS, "min_pixels": min_pixels})
    assert verdict.measures.pixels == pixels


def test_score__halves_where_each_of_its_measures_does() -> None:
    # Expected: 100 of 200 pixels, and an angle of 2 degrees, halve it; three penalties of 1 divide it by 4
    verdict = verdict_of(0.3, pixels=100, angle=2.0, adjacency=0.01, glint=0.02, spread=0.03)
    judge_pixels(verdict, picture_of(), LIMITS)
    assert verdict.score == pytest.approx(0.5 * 0.5 / 4.0)


@pytest.mark.parametrize(
    ("degrees", "direct", "is_refused"),
    [(0.0, 0.8, True), (4.0, 0.8, True), (6.0, 0.8, False), (0.0, 0.4, False)],
)
def test_paint_in_the_colour_of_the_sky__may_lie_in_shade(
    degrees: float, direct: float, is_refused: bool
) -> None:
    # Expected: refused within 5 degrees of it from 430 nm on, where half of the light is direct
    sky = (1.0 - direct) * np.linspace(1.6, 0.4, 24)
    across = FLAT - (FLAT[1:] @ sky[1:]) / (sky[1:] @ sky[1:]) * sky
    angle = np.radians(degrees)
    spectrum = np.cos(angle) * sky / np.linalg.norm(sky[1:])
    spectrum += np.sin(angle) * across / np.linalg.norm(across[1:])
    spectrum[0] = 0.0
    verdict = verdict_of(0.3)
    verdict.measures = verdict.measures._replace(spectrum=spectrum, angle=0.0, adjacency=0.0, spread=0.0)
    judge_pixels(verdict, picture_of(diffuse=sky), LIMITS)
    assert any("shade" in text for text in verdict.objections) == is_refused


# --- the level place, and the axis -------------------------------------------------------------------------


@pytest.mark.parametrize(("half_length", "along"), [(20.0, 0.05), (5.0, np.radians(5.0))])
def test_crown__is_twelve_degrees_across_and_five_along_at_most(half_length: float, along: float) -> None:
    place = Place(0.0, 0.0, 1.0, 1.0, 10.0, half_length)
    np.testing.assert_allclose(place.crown, [along, np.radians(12.0)])


@pytest.mark.parametrize(
    ("fall", "offset", "half", "ramp_px", "has_edges"),
    [
        (1.25, 0.0, 12.0, 1.0, True),  # brightness falls to 1 / 1.2 at an edge
        (1.15, 0.0, 12.0, 1.0, False),
        (3.0, 2.5, 12.0, 1.0, True),
        (3.0, 0.0, 7.0, 1.0, False),  # within 0.7 to 1.25 half widths, of 12, of the windows
        (3.0, 0.0, 10.5, 1.0, True),
        (3.0, 0.0, 14.0, 1.0, True),
        (3.0, 0.0, 17.0, 1.0, False),
        (np.exp(0.66), 0.0, 15.0, 6.0, False),  # and over 1.5 pixels
        (np.exp(0.82), 0.0, 15.0, 6.0, True),
    ],
)
def test_edges__are_seen_near_the_windows(
    fall: float, offset: float, half: float, ramp_px: float, has_edges: bool
) -> None:
    y, x = np.indices((60, 90), np.float64)
    # share of the fall, in logarithms
    outside = np.clip((np.abs(y - 30.0 - offset) - half) / ramp_px + 1.0, 0.0, 1.0)
    inside = (np.abs(y - 30.0) < 0.75 * 13.0) & (x > 20) & (x < 70)
    every = np.ones(y.shape, bool)
    car = Footprint((0, 0), every, every, fall**-outside, AXIS, np.array([30.0, 45.0]), 90.0, 60.0, False)
    place = level_place(car, Roof(inside, (30.0, 45.0), AXIS, 1.5, 1.7, "", 1.0, True, True, 0.0))
    assert (place.across_sd == 0.4) == has_edges


def crown_of(logs: Floats, lit: Any = True) -> Level | None:
    # Level of a roof of half a width of 15 pixels from the logarithms of its brightness
    lit = np.broadcast_to(lit, logs.shape)
    return level_light(np.exp(logs), lit, Place(20.0, 40.0, 0.0, 0.0, 15.0, 20.0), AXIS)


@pytest.mark.parametrize(
    ("lines", "columns", "has_level"),
    [
        (slice(18, 22), slice(37, 43), False),  # of 25 pixels at least
        (slice(18, 22), slice(37, 44), True),
        (slice(14, 27), slice(51, 54), True),  # within 0.9 half widths along the car
        (slice(14, 27), slice(54, 57), False),
        (slice(25, 28), slice(34, 47), True),  # and 0.5 across it
        (slice(28, 31), slice(34, 47), False),
    ],
)
def test_level__is_of_the_middle_of_a_roof(lines: slice, columns: slice, has_level: bool) -> None:
    lit = np.zeros((41, 81), bool)
    lit[lines, columns] = True
    assert (crown_of(np.zeros(lit.shape), lit) is not None) == has_level


def test_level__is_as_uncertain_as_its_pixels() -> None:
    # Expected: the scatter of pixels, 0.003 at least, over the root of the number of squares of 3 x 3 pixels
    y, x = np.indices((41, 81))
    count = 15 * 27
    for scatter, expected in ((0.0, 0.003), (0.01, 0.01)):
        level = crown_of(scatter * (-1.0) ** (y + x))
        assert level is not None
        assert level.sd == pytest.approx(expected * np.sqrt(9.0 / count), rel=0.01)


@pytest.mark.parametrize(("times", "is_fitted"), [(2.3, True), (2.7, False), (-2.8, True), (-3.2, False)])
def test_fit__leaves_out_glint_and_dark_spots(times: float, is_fitted: bool) -> None:
    # Expected: residuals from -3 to 2.5 standard deviations are fitted, and raise the scatter
    y, x = np.indices((41, 81))
    logs = 0.01 * (-1.0) ** (y + x)
    spots = np.s_[[15, 15, 25, 25], [32, 48, 32, 48]]
    logs[spots] = 0.01 * 1.4826 * times
    level, without = (
        crown_of(logs),
        crown_of(logs, ~np.isin(np.arange(41 * 81).reshape(41, 81), 81 * y[spots] + x[spots])),
    )
    assert level is not None
    assert without is not None
    assert (level.sd > 1.01 * without.sd) == is_fitted


# --- footprints and cars -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "joining", "length"),
    [
        ([(0, 20, 24), (24, 44, 24)], 0, 44),  # gaps of 4 pixels are closed
        ([(0, 20, 24), (26, 46, 24)], 0, 20),
        ([(0, 20, 24), (20, 25, 4), (25, 45, 24)], 1, 20),  # bridges of 4 pixels are cut
        ([(0, 20, 24), (20, 25, 6), (25, 45, 24)], 1, 45),
        ([(0, 24, 24), (24, 30, 5)], 0, 27),  # parts of a quarter of the width of the widest are none of it
        ([(0, 24, 24), (24, 30, 9)], 0, 30),
        ([(0, 24, 9), (24, 30, 3)], 0, 25),  # nor are parts of 5 pixels
        ([(0, 24, 9), (24, 30, 5)], 0, 30),
        ([(0, 24, 24), (68, 92, 24)], 2, 92),  # over windows: 4.5 half widths
        ([(0, 24, 24), (78, 102, 24)], 2, 24),
    ],
)
def test_footprints__join_parts(parts: list[tuple[int, int, int]], joining: int, length: int) -> None:
    # Parts (first and last column, width) of a red car one behind another; windows between them with rule 2
    number = np.zeros((60, 160), np.int32)
    if joining == 2:
        number[18:42, 30 : 30 + parts[-1][1]] = 2
    for first, last, width in parts:
        number[30 - width // 2 : 30 - width // 2 + width, 30 + first : 30 + last] = 1
    picture = picture_of(RED, 0.01 * np.ones(24), number=number)
    first, width = parts[0][1], parts[0][2]
    seed, origin = np.ones((width, first), bool), (30 - width // 2, 30)
    (footprint,) = footprints_of(seed, origin, RED, picture, JOININGS[joining : joining + 1])
    assert footprint.area.any(axis=0).sum() == length


@pytest.mark.parametrize(
    ("scale", "rule", "factors"),
    [
        (1.0, 0, {0.38: 20, 0.42: 40, 1.65: 40, 1.75: 20}),  # parts that lean, of solid paint
        (1.0, 4, {0.19: 20, 0.21: 40, 3.9: 40, 4.1: 20}),  # of paint with flakes
        (0.1, 0, {0.68: 20, 0.72: 40, 1.65: 40, 1.75: 20}),  # of dark paint: windows reflect half as much
        (0.1, 4, {0.68: 20, 0.72: 40, 2.9: 40, 3.1: 20}),
    ],
)
def test_footprints__have_parts_of_other_brightness(
    scale: float, rule: int, factors: dict[float, int]
) -> None:
    number = np.zeros((60, 120), np.int32)
    number[18:42, 30:50], number[18:42, 50:70] = 1, 2
    for factor, length in factors.items():
        picture = picture_of(scale * RED, scale * factor * RED, number=number)
        seed = np.ones((24, 20), bool)
        (footprint,) = footprints_of(seed, (18, 30), scale * RED, picture, JOININGS[rule : rule + 1])
        assert footprint.area.any(axis=0).sum() == length, factor


@pytest.mark.parametrize(("on_paint", "cars"), [(22, 1), (11, 2)])
def test_cars__have_the_pieces_on_their_paint(on_paint: int, cars: int) -> None:
    # Expected: a piece of which half lies on the paint of a car belongs to it, a quarter does not
    number = np.zeros((80, 180), np.int32)
    number[20:60, 20:120] = 1
    number[22:42, 120:160] = 3
    for window in (slice(45, 55), slice(75, 85)):
        number[23:57, window] = 2
    picture = picture_of(RED, 0.01 * np.ones(24), RED[::-1], number=number)
    bonnet = Piece(1, (22, 22), np.ones((36, 20), bool))
    other = Piece(3, (22, 120 - on_paint), np.ones((20, 40), bool))
    assert len(find_cars([bonnet, other], picture)) == cars


def block(first: int, last: int) -> Car:
    # Car of 40 lines in a range of columns, whose windows are not seen, and without paint
    area = np.ones((40, last - first), bool)
    centre = np.array([19.5, 0.5 * (last - first - 1)])
    seen = Footprint((0, first), ~area, area, area * 1.0, AXIS, centre, float(last - first), 40.0, False)
    return Car([Piece(1, (0, first), area)], seen, NoRoof("", True))


@pytest.mark.parametrize(
    ("on_paint", "in_area", "is_assigned"),
    [
        (0, 17, True),  # 0.8 of it in the area of a car
        (0, 15, False),
        (11, 11, True),  # or half of it on its paint
        (9, 9, False),
    ],
)
def test_pieces__belong_to_the_car_that_they_lie_on(on_paint: int, in_area: int, is_assigned: bool) -> None:
    car_park, car = CarPark(picture_of(number=np.zeros((40, 200)))), block(0, 100)
    assert car.footprint is not None
    car.footprint.paint[:, 100 - on_paint :] = True
    car_park.add(car)
    assert car_park.assign(Piece(2, (0, 100 - in_area), np.ones((40, 20), bool))) == is_assigned


@pytest.mark.parametrize(("shared", "cars"), [(35, 1), (25, 2)])
def test_footprints__that_overlap_are_of_one_car(shared: int, cars: int) -> None:
    # Expected: 0.3 of the smaller one, of 100 columns
    car_park = CarPark(picture_of(number=np.zeros((40, 320))))
    for car in (block(0, 150), block(150 - shared, 250 - shared)):
        car_park.add(car)
    assert len(car_park.cars) == cars


@pytest.mark.parametrize(
    ("lengths", "has_roof"),
    [
        ((100, 100, 130), True),  # at most 1.8 times as large as the median of three cars
        ((100, 100, 138), False),
        ((100, 310), True),  # of fewer cars none is too large
    ],
)
def test_cars__are_not_larger_than_others(lengths: tuple[int, ...], has_roof: bool) -> None:
    # Cars of equal proportions one below another
    number, found = np.zeros((sum(lengths), 450), np.int32), []
    for length, top in zip(lengths, np.cumsum((20, *lengths)), strict=False):
        for body, (first, last), inset in (
            (1, (0.0, 1.0), 0.0),
            (2, (0.25, 0.35), 0.03),
            (2, (0.55, 0.65), 0.03),
        ):
            rows = slice(top + round(inset * length), top + round((0.4 - inset) * length))
            number[rows, 50 + round(first * length) : 50 + round(last * length)] = body
        found.append(Piece(1, (top + 2, 52), np.ones((round(0.36 * length), round(0.2 * length)), bool)))
    cars = find_cars(found, picture_of(RED, 0.01 * np.ones(24), number=number))
    assert len(cars) == len(lengths)
    largest = max(cars, key=lambda car: car.size)
    assert isinstance(largest.roof, Roof) == has_roof


@pytest.mark.parametrize(
    ("first", "last", "level", "is_roof"),
    [
        (20, 48, 0.02, False),  # side windows along 30 to 80 % of a car
        (20, 54, 0.02, True),
        (12, 90, 0.02, True),
        (8, 92, 0.02, False),
        (20, 54, 0.06, False),  # that is as dark as its windows
    ],
)
def test_roofs__of_dark_cars_lie_between_side_windows(
    first: int, last: int, level: float, is_roof: bool
) -> None:
    # No window crosses the car: its windscreens mirror as much sky as its paint
    shown = np.full((40, 100), level)
    shown[3:6, first:last] = shown[34:37, first:last] = 0.4 * level
    car = Footprint(
        (0, 0), shown == level, np.ones(shown.shape, bool), shown / level, AXIS, np.array([19.5, 49.5]),
        100.0, 40.0, False,
    )  # fmt: skip
    roof = find_roof(car, shown)
    assert isinstance(roof, Roof) is is_roof
    if isinstance(roof, Roof):
        # its middle, in which pixels are kept
        assert roof.centre[1] == pytest.approx(0.5 * (first + last) - 0.5, abs=1.0)
        assert np.ptp(np.nonzero(roof.inside)[1]) < 0.4 * (last - first)
        assert roof.window_level == pytest.approx(0.4 * level)


@pytest.mark.parametrize(("is_shaded", "length"), [(False, 60), (True, 40)])
def test_footprints__of_dark_paint_end_at_cast_shadows(is_shaded: bool, length: int) -> None:
    # A shadow beside black paint is as dark, and has its colour
    number = np.zeros((60, 120), np.int32)
    number[18:42, 30:70], number[18:42, 70:90] = 1, 2
    picture = picture_of(0.02 * np.ones(24), 0.02 * np.ones(24), number=number)
    picture.model.state[2] = SHADED if is_shaded else 0
    seed = np.ones((24, 40), bool)
    (footprint,) = footprints_of(seed, (18, 30), 0.02 * np.ones(24), picture, JOININGS[:1])
    assert footprint.area.any(axis=0).sum() == length


# --- which pixels are windows ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("paint", "window", "is_roof"),
    [
        (0.1, 0.065, True),  # windows reflect less than 0.07
        (0.1, 0.075, False),
        (0.5, 0.24, True),  # or less than half of the paint
        (0.5, 0.26, False),
    ],
)
def test_windows__are_dark(paint: float, window: float, is_roof: bool) -> None:
    level = np.full((40, 100), paint)
    level[3:37, 30:42] = level[3:37, 70:82] = window
    every = np.ones(level.shape, bool)
    car = Footprint(
        (0, 0), level == paint, every, level / paint, AXIS, np.array([19.5, 49.5]), 100.0, 40.0, False
    )
    assert isinstance(find_roof(car, level), Roof) is is_roof
