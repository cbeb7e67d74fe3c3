"""Thresholds of detection: inputs on both sides of each, so that twice or half of it changes a decision."""

import itertools
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from oracles.disort_sky import relative_sky
from scipy.optimize import brentq, nnls
from support.analytic_scenes import as_line, smooth_edge

from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings.corrections import split_of
from hyperpaint.surroundings.model import GLINTED, LIT, SHADED, SceneModel
from hyperpaint.surroundings.segments import (
    BRIGHT_IN_LOBE,
    IN_LOBE,
    SATURATED_IN_LOBE,
    Light,
    Matches,
    Picture,
    beyond,
    divide,
    match_segments,
    mirror_lobes,
    mixtures_of,
    sample_pixels,
    senders_of,
    touching,
)
from hyperpaint.surroundings.surveying import (
    channel_noise,
    clean_references,
    flag,
    flag_line,
    fraction_in_shadow,
    is_vegetation,
    match_shade,
    nearest_coloured,
    of_shadows,
    penumbrae,
    shaded_pixels,
    survey,
)

Floats = npt.NDArray[np.float64]
#: Diffuse fractions of six channels, as steep as those of a clear sky.
SIX = Light.under(np.linspace(0.4, 0.1, 6))
UNEVEN = np.resize([1.0, -1.0], 6)

# --- mirror images of the sun ------------------------------------------------------------------------------


def lobes_of(
    brightness: Floats,
    paint: float,
    body: Any = 0,
    ground: Any = False,
    saturated: Any = False,
    ripple: float = 0.0,
    is_coloured: bool = False,
) -> npt.NDArray[np.uint8]:
    # Lobes of a picture (line, column) with a grey body 0 whose excess over its paint is direct light; a
    # body 1 is ground or another part
    shape = brightness.shape
    added = (brightness - paint)[..., None] / SIX.direct.mean() * SIX.direct * (1.0 + ripple * UNEVEN)
    colour = np.linspace(0.2, 1.8, 6) if is_coloured else np.ones(6)
    number = np.broadcast_to(body, shape).astype(np.int32)
    return mirror_lobes(
        Picture(
            np.ascontiguousarray(paint * colour + added, np.float32),
            np.broadcast_to(saturated, shape),
            lambda index: number[index],
            np.array([False, ground, False]),
            np.stack([paint * colour] * 3),
            np.full(3, is_coloured),
            SIX,
        )
    )


def disc(radius: float, size: int = 81) -> npt.NDArray[np.bool_]:
    y, x = np.indices((size, size)) - size // 2
    return np.asarray(np.hypot(y, x) <= radius)


@pytest.mark.parametrize(
    ("paint", "peak", "evenness", "ripple", "is_lobe"),
    [
        (0.1, 0.28, 1.0, 0.0, False),  # three times as bright as the ring around it
        (0.1, 0.32, 1.0, 0.0, True),
        (0.1, 1.0, 0.65, 0.0, False),  # beside an edge, three pixels of the ring are darker
        (0.1, 1.0, 0.75, 0.0, True),
        (0.004, 0.022, 1.0, 0.0, False),  # on black paint, 0.02 at least
        (0.004, 0.026, 1.0, 0.0, True),
        (0.1, 1.0, 1.0, 0.27, True),  # a lamp's glass has another colour than the sun
        (0.1, 1.0, 1.0, 0.33, False),
        (1.5, 2.8, 1.0, 0.0, False),  # flakes reach 2.5
        (1.5, 3.2, 1.0, 0.0, True),
    ],
)
def test_core__is_brighter_than_its_surroundings(
    paint: float, peak: float, evenness: float, ripple: float, is_lobe: bool
) -> None:
    brightness = np.full((41, 41), paint)
    brightness[17, 19:22] *= evenness
    brightness[20, 20] = peak
    assert bool(lobes_of(brightness, paint, ripple=ripple)[20, 20]) == is_lobe


def streak(core: int, peak: float, excess: float, length: int = 90) -> Floats:
    # Brightness of a square core, and of a streak that begins at its right side
    brightness = np.ones((61, 130))
    half = core // 2
    brightness[30, 30 : 30 + length] += excess
    brightness[30 - half : 30 - half + core, 30 - core : 30] = peak
    return brightness


@pytest.mark.parametrize(
    ("core", "peak", "excess", "fewest", "most"),
    [
        # the lobe of a core of half width h reaches 2 + 2 h pixels, 14 at most
        (1, 3.5, 0.25, 4, 4),
        (3, 3.5, 0.25, 6, 6),
        (15, 40.0, 0.25, 14, 14),
        # from an end that is 1.3 times as bright as the body it reaches on, once for 8 pixels of the core
        (4, 40.0, 0.4, 18, 18),
        (7, 40.0, 0.4, 50, 60),  # five times at most
        (1, 3.5, 0.035, 0, 0),  # 4 % brighter than the body
        (1, 3.5, 0.045, 4, 4),
    ],
)
def test_streak__is_followed_from_its_core(
    core: int, peak: float, excess: float, fewest: int, most: int
) -> None:
    lobes = lobes_of(0.1 * streak(core, peak, excess), 0.1)
    assert fewest <= (lobes[30, 30:] > 0).sum() <= most


@pytest.mark.parametrize(
    ("paint", "excess", "spread", "is_lobe"),
    [
        (0.01, 0.25, 0.0, False),  # 0.003 in reflectance on black paint
        (0.01, 0.35, 0.0, True),
        # four standard deviations of an uneven body: of its texture, and 0.2 % of noise
        (0.1, 4.0 * (1.4826 * 0.01 + 0.0017), 0.01, False),
        (0.1, 4.0 * (1.4826 * 0.01 + 0.0025), 0.01, True),
    ],
)
def test_lobe__exceeds_what_else_is_uneven(paint: float, excess: float, spread: float, is_lobe: bool) -> None:
    texture = 1.0 + spread * np.resize([1.0, -1.0], (130, 61)).T
    texture[30, 30:33] = 1.0
    assert (lobes_of(paint * streak(1, 9.0, excess, 3) * texture, paint)[30, 30:33] > 0).all() == is_lobe


@pytest.mark.parametrize(("apart", "is_lobe"), [(2, False), (4, True)])
def test_streak__is_brighter_than_its_body_within_three_pixels(apart: int, is_lobe: bool) -> None:
    # A second streak beside it may be the edge of a body part that leans to the sun
    brightness = streak(1, 40.0, 0.2)
    brightness[30 + apart] = brightness[30 - apart] = brightness[30]
    brightness[[30 - apart, 30 + apart], :30] = 1.0
    assert (lobes_of(0.1 * brightness, 0.1)[30, 31] == BRIGHT_IN_LOBE) == is_lobe


@pytest.mark.parametrize(
    ("count", "distance", "is_lobe"),
    [(12, 7, True), (12, 10, False), (10, 7, True), (8, 7, False)],  # 9 pixels of a coat, within 4 + 4
)
def test_core_beyond_lit_surfaces__has_a_coat_around_it(count: int, distance: int, is_lobe: bool) -> None:
    body, brightness = np.ones((41, 41), np.int32), np.full((41, 41), 0.1)
    body[20 - count // 4 : 20 + count // 4, 20 + distance] = 0
    body[20 - count // 4 : 20 + (count + 3) // 4, 20 - distance] = 0
    body[20, 20], brightness[20, 20] = 0, 4.0
    assert bool(lobes_of(brightness, 0.1, body, ground=True)[20, 20]) == is_lobe


def sector(share: float, size: int = 81) -> npt.NDArray[np.bool_]:
    y, x = np.indices((size, size)) - size // 2
    return np.asarray(np.arctan2(y, x) / (2.0 * np.pi) % 1.0 < share)


@pytest.mark.parametrize(("share", "is_lobe"), [(0.45, False), (0.55, True)])
def test_core__lies_on_one_body(share: float, is_lobe: bool) -> None:
    body = np.where(sector(share), 0, np.where(sector(0.5 + share / 2.0), 1, 2))
    body[40, 40] = 0
    assert bool(lobes_of(np.where(disc(0.0), 1.0, 0.1), 0.1, body)[40, 40]) == is_lobe


@pytest.mark.parametrize(
    ("paint", "core", "glint", "is_coloured", "is_lobe"),
    [
        (0.5, 5, 0.9, True, False),  # a lobe of roughness 0.1 has a glint of 1 at its peak
        (0.5, 5, 1.1, True, True),
        (0.5, 2, 1.1, True, False),  # over some pixels
        (0.5, 3, 1.1, True, True),
        (0.045, 5, 1.3, False, True),  # grey flakes look like it, black bodies have none
        (0.055, 5, 1.3, False, False),
    ],
)
def test_wide_core__is_as_bright_as_a_white_surface(
    paint: float, core: int, glint: float, is_coloured: bool, is_lobe: bool
) -> None:
    # Around the core brightness falls by half in a pixel, so that it is not sharp
    outside = np.maximum(np.abs(np.indices((81, 81)) - 40 + (core % 2 == 0) / 2).max(axis=0) - core / 2, 0.0)
    added = glint * np.where(outside > 0.0, 0.8 * np.exp(-outside / 4.0), 1.0)
    lobes = lobes_of(paint + added * SIX.direct.mean(), paint, is_coloured=is_coloured)
    assert bool(lobes[40, 40]) == is_lobe


@pytest.mark.parametrize(
    ("paint", "is_coloured", "added", "fewest", "most"),
    [
        # on black within six half widths of the core, on coloured paint within 120 pixels
        (0.04, False, 0.02, 18, 24),
        (0.5, True, 0.02, 119, 123),
        (0.5, True, 0.009, 10, 35),  # brighter than 2 % of the paint
        (0.5, True, 0.011, 119, 123),
    ],
)
def test_wide_lobe__is_followed_around_its_core(
    paint: float, is_coloured: bool, added: float, fewest: int, most: int
) -> None:
    y, x = np.indices((41, 360)) - np.array([20, 180])[:, None, None]
    glint = 1.3 * np.exp(-(np.hypot(y, x) ** 2) / 32.0) * SIX.direct.mean()
    lobes = lobes_of(paint + np.maximum(glint, added), paint, is_coloured=is_coloured)
    reach = (lobes[20, 180:] > 0).sum()
    assert fewest <= reach <= most


@pytest.mark.parametrize(("radius", "is_lobe"), [(3.0, True), (5.5, False)])
def test_saturated_spot__may_be_a_core_where_it_is_small(radius: float, is_lobe: bool) -> None:
    # a white roof that saturates is larger than 4 pixels to all sides
    spot = disc(radius)
    assert (lobes_of(np.where(spot, 2.9, 0.1), 0.1, saturated=spot)[40, 40] == SATURATED_IN_LOBE) == is_lobe


@pytest.mark.parametrize(("share", "is_lobe"), [(0.42, False), (0.58, True)])
def test_saturated_pixels__are_in_a_lobe_that_encloses_them(share: float, is_lobe: bool) -> None:
    spot = disc(6.0)
    brightness = np.where(disc(14.0) & sector(share), 0.5 + 1.1 * SIX.direct.mean(), 0.5)
    lobes = lobes_of(brightness, 0.5, saturated=spot, is_coloured=True)
    assert lobes[52, 40] == IN_LOBE
    assert (lobes[40, 40] == SATURATED_IN_LOBE) == is_lobe


# --- cast shadows ------------------------------------------------------------------------------------------

NM = np.linspace(412.0, 988.0, 24)
CLEAR = Light.under(diffuse_fraction(NM, 40.0))
HAZY = Light.under(np.linspace(0.7, 0.35, 24))
ZIGZAG = np.resize([1.0, -1.0], 24)
#: Side to which shadows fall: to higher lines.
AWAY = np.array([1.0, 0.0])
#: Ground, a white roof, and a redder thing as bright as the ground.
GROUND, WHITE, THING = np.full(24, 0.25), np.full(24, 0.7), np.linspace(0.16, 0.44, 24)
RED = smooth_edge(NM, 600.0, 0.04, 0.6)


def lit(
    body: Any,
    direct: float = 0.0,
    sky: float = 0.8,
    sent: float = 0.0,
    misfit: float = 0.0,
    by: Light = CLEAR,
) -> Floats:
    # A body under parts of its light, with a misfit beside the floor of 0.01 under the error of a spectrum
    spectrum = body * (direct * by.direct + sky * by.diffuse + sent * RED)
    return np.asarray(spectrum + misfit * (spectrum + 0.01) * ZIGZAG)


def states(
    number: Any, spectra: list[Floats], side: Any = AWAY, by: Light = CLEAR
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.bool_]]:
    # States of the segments of a map, and whether they are ground
    numbers, count = np.ascontiguousarray(number, np.int32), len(spectra)
    size = np.bincount(numbers.ravel(), minlength=count).astype(np.int64)
    matches, ground = match_shade(numbers, np.stack(spectra), size, touching(numbers, count), by, side)
    return matches.state, ground


def contact(
    far: int,
    near: int = 0,
    across: int = 0,
    shape: tuple[int, int] = (20, 20),
    body: int = 1,
    right: int = 0,
    touched: int | None = None,
) -> npt.NDArray[np.int32]:
    # Map of a rectangle 2 inside a thing 3, which lets it touch its body, or another segment, on some pixels
    # of its sides: a white roof 1 on the ground 0, or this ground. The shadow 4 of another thing shows the
    # side of the sun
    number = np.zeros((100, 100), np.int32)
    number[20:75, 20:80] = body
    number[85:88, 20:80] = 3
    number[88:96, 20:80] = 4
    top, left = 50 - shape[0] // 2, 50 - shape[1] // 2
    end, last = top + shape[0], left + shape[1]
    number[top - 3 : end + 3, left - 3 : last + 3] = 3
    number[top:end, left:last] = 2
    touched = body if touched is None else touched
    number[end : end + 3, left : left + far] = touched
    number[top - 3 : top, left : left + near] = touched
    number[top : top + (across + 1) // 2 + right, last : last + 3] = touched
    number[top : top + across // 2, left - 3 : left] = touched
    return number


#: A misfit with which no shadow is found by its spectrum alone.
UNSURE = {"misfit": 0.027}


@pytest.mark.parametrize(
    ("sides", "light", "is_shadow"),
    [
        # a tenth of the border, at least 4 sides, touches the lit body
        ({"far": 10}, {}, True),
        ({"far": 6}, {}, False),
        ({"far": 5, "shape": (8, 8)}, {}, True),
        ({"far": 3, "shape": (7, 7)}, {}, False),
        # on the side away from the sun: by a fifth
        ({"far": 3, "across": 9}, {}, True),
        ({"far": 2, "across": 11}, {}, False),
        # or on 0.6 of the border, not by more than 0.35 on the side of the sun
        ({"far": 6, "near": 6, "across": 40}, {}, True),
        ({"far": 2, "near": 2, "across": 40}, {}, False),
        ({"far": 0, "near": 20, "across": 40}, {}, True),
        ({"far": 0, "near": 20, "across": 32}, {}, False),
        # it sees 0.45 of the sky, and no sun
        ({"far": 20}, {"sky": 0.48}, True),
        ({"far": 20}, {"sky": 0.42}, False),
        ({"far": 20}, {"direct": 0.013}, True),
        ({"far": 20}, {"direct": 0.017}, False),
        # where things hide the sky below 0.75 they send light: 0.12 of that
        ({"far": 20}, {"direct": 0.042, "sky": 0.5}, True),
        ({"far": 20}, {"direct": 0.048, "sky": 0.5}, False),
        ({"far": 20}, {"misfit": 0.033}, True),
        ({"far": 20}, {"misfit": 0.037}, False),
        # half as bright as the body, under a hazy sky
        ({"far": 20}, {"sky": 0.9, "by": HAZY}, True),
        ({"far": 20}, {"sky": 0.99, "by": HAZY}, False),
    ],
)
def test_clear_shadow__touches_its_lit_body(sides: Any, light: Any, is_shadow: bool) -> None:
    by = light.get("by", CLEAR)
    spectra = [GROUND, WHITE, lit(WHITE, **{**UNSURE, **light}), THING, lit(GROUND, sky=0.5, by=by)]
    assert states(contact(**sides), spectra, by=by)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(
    ("sides", "light", "is_shadow"),
    [
        # clear ones touch it on any side but the sun's
        ({"far": 0, "near": 3, "across": 17}, UNSURE, True),
        ({"far": 0, "near": 5, "across": 15}, UNSURE, False),
        # other ones on 0.04 of the border, by a tenth away from the sun
        ({"far": 5, "shape": (30, 30)}, {"misfit": 0.05}, True),
        ({"far": 4, "shape": (30, 30)}, {"misfit": 0.05}, False),
        ({"far": 1, "across": 8}, {"misfit": 0.05}, True),
        ({"far": 1, "across": 11}, {"misfit": 0.05}, False),
        ({"far": 10}, {"misfit": 0.062}, True),
        ({"far": 10}, {"misfit": 0.068}, False),
        # more direct light on 0.15 of the border, by a quarter away from the sun
        ({"far": 14}, {"direct": 0.045, "sky": 0.7}, True),
        ({"far": 10}, {"direct": 0.045, "sky": 0.7}, False),
        ({"far": 6, "across": 14}, {"direct": 0.045, "sky": 0.7}, True),
        ({"far": 4, "across": 16}, {"direct": 0.045, "sky": 0.7}, False),
        ({"far": 20}, {"direct": 0.048, "sky": 0.75}, True),
        ({"far": 20}, {"direct": 0.052, "sky": 0.75}, False),
        ({"far": 20}, {"direct": 0.132, "sky": 0.4}, True),  # 0.05 + 0.25 x 0.35
        ({"far": 20}, {"direct": 0.143, "sky": 0.4}, False),
    ],
)
def test_shadow_on_the_ground__has_less_contact(sides: Any, light: Any, is_shadow: bool) -> None:
    spectra = [GROUND, WHITE, lit(GROUND, **light), THING, lit(GROUND, sky=0.5)]
    assert states(contact(body=0, **sides), spectra)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(
    ("width", "light", "level", "is_shadow"),
    [
        # 2 % in all channels of the sky's light, without sun and light of neighbours
        (16, {"misfit": 0.018}, 0.7, True),
        (16, {"misfit": 0.022}, 0.7, False),
        (16, {"direct": 0.018, "sky": 0.6}, 0.7, True),
        (16, {"direct": 0.022, "sky": 0.6}, 0.7, False),
        (16, {"sent": 0.018}, 0.7, True),
        (16, {"sent": 0.022}, 0.7, False),
        (16, {"sky": 0.48}, 0.7, True),
        (16, {"sky": 0.42}, 0.7, False),
        # glass and black paint mirror less than 0.09 of the sky
        (16, {"sky": 0.5}, 0.187, True),
        (16, {"sky": 0.5}, 0.173, False),
        (4, {}, 0.7, True),  # 32 pixels
        (3, {}, 0.7, False),
    ],
)
def test_shadow__is_found_by_its_spectrum_beside_its_body(
    width: int, light: Any, level: float, is_shadow: bool
) -> None:
    # Nothing touches its lit body 1, which is some pixels away
    number = np.zeros((60, 100), np.int32)
    number[10:40, 10:60] = 3
    number[10:40, 20 + width + 4 : 60] = 1
    number[10:18, 20 : 20 + width] = 2
    number[20:38, 20:36] = 4  # a red car may send light
    spectra = [0.2 * GROUND, level * np.ones(24), lit(level * np.ones(24), **light), 0.7 * THING, RED]
    assert states(number, spectra, side=None)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(("apart", "is_shadow"), [(7, True), (9, False)])
def test_shadow_by_its_spectrum__is_within_eight_pixels_of_its_body(apart: int, is_shadow: bool) -> None:
    number = np.full((40, 100), 3, np.int32)
    number[:, :20], number[:, 30 + apart :] = 0, 1
    number[10:22, 20:30] = 2
    assert states(number, [GROUND, WHITE, lit(WHITE), THING])[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(
    ("level", "shape", "rows", "has_roof", "is_shadow"),
    [
        # a patch of the roof may be brighter by 0.35, or of another shape by 0.08
        (1.30, 0.0, 3, True, True),
        (1.40, 0.0, 3, True, False),
        (1.0, 0.07, 3, True, True),
        (1.0, 0.09, 3, True, False),
        # the lit part of a body is a fifth of its shadow
        (1.0, 0.0, 5, False, True),
        (1.0, 0.0, 3, False, False),
    ],
)
def test_lit_body__shows_the_surface_of_the_shadow(
    level: float, shape: float, rows: int, has_roof: bool, is_shadow: bool
) -> None:
    number = contact(0)
    number[number == 1] = 1 if has_roof else 3
    number[60 : 60 + rows, 40:60] = 5
    patch = level * WHITE * (1.0 + shape * ZIGZAG)
    spectra = [GROUND, WHITE, lit(WHITE, **UNSURE), THING, lit(GROUND, sky=0.5), patch]
    assert states(number, spectra)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(("larger", "is_shadow"), [(38, True), (41, False)])
def test_lit_body_far_away__is_one_of_the_forty_largest(larger: int, is_shadow: bool) -> None:
    # The shadow touches only a patch of its surface; ground, the thing around it, another shadow and itself
    # are larger, too
    number = contact(0, shape=(8, 8))
    number[number == 1] = 0
    number[54, 46:54] = 5
    number[2:6, 2:7] = 1
    for k in range(larger - 4):
        number[8 + k // 16 * 4 :, 6 * (k % 16) :][:4, :6] = 6 + k
    spectra = [GROUND, WHITE, lit(WHITE, **UNSURE), THING, lit(GROUND, sky=0.5), WHITE, *37 * [THING]]
    assert states(number, spectra)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(("sky", "is_shadow"), [(0.33, True), (0.27, False)])
def test_dark_shadow__does_not_show_its_side(sky: float, is_shadow: bool) -> None:
    number = contact(20, body=0)
    number[number == 4] = 0
    spectra = [GROUND, WHITE, lit(GROUND, sky=sky, **UNSURE), THING]
    assert states(number, spectra, side=None)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(("sent", "is_shadow"), [(0.18, True), (0.22, False)])
def test_clear_shadow__gets_less_light_of_a_neighbour_than_half_the_hidden_sky(
    sent: float, is_shadow: bool
) -> None:
    number = contact(12, shape=(12, 12))
    number[42:58, 24:40] = 5
    spectra = [GROUND, WHITE, lit(WHITE, sky=0.6, sent=sent, **UNSURE), THING, lit(GROUND, sky=0.5), RED]
    assert states(number, spectra)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(
    ("rows", "level", "size", "is_ground"),
    [
        (15, 0.4, 400, True),  # a tenth of all shadows lies on it: 540 pixels
        (11, 0.4, 400, False),
        (15, 0.48, 400, True),  # white cars are brighter than 0.5
        (15, 0.52, 400, False),
        (15, 0.4, 330, True),  # 0.03 of the line
        (15, 0.4, 270, False),
    ],
)
def test_ground__has_many_shadows(rows: int, level: float, size: int, is_ground: bool) -> None:
    number = contact(0)
    number[20:75, 20:80] = 0
    number[10 : 10 + size // 10, 5:15] = 1
    number[1 : 1 + 4, 5 : 5 + rows] = 2
    number[5:7, 5 : 5 + rows] = 1
    concrete = np.full(24, level)
    spectra = [GROUND, concrete, lit(concrete), THING, lit(GROUND, sky=0.5)]
    assert states(number, spectra)[1][1] == is_ground


@pytest.mark.parametrize(
    ("near", "right", "second", "is_contradictory"),
    [
        (4, 16, False, False),  # by a cosine of -0.3
        (6, 16, False, True),
        (12, 14, True, True),  # the sum of two shadows on different sides is 0.65 and 0.55 of both
        (10, 15, True, False),
    ],
)
def test_side_of_shadows__contradicts_the_predicted_one(
    near: int, right: int, second: bool, is_contradictory: bool
) -> None:
    number = contact(0, near, right=right, body=0)
    number[number == 4] = 0
    if second:
        number = np.hstack([number, np.where(number == 2, 4, number)[:, ::-1]])
    shadow = lit(GROUND, **UNSURE)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PaintWarning)
        states(number, [GROUND, WHITE, shadow, THING, shadow][: number.max() + 1])
    assert any("shadow-side" in str(warning.message) for warning in caught) == is_contradictory


@pytest.mark.parametrize(
    ("sides", "level", "light", "is_shadow"),
    [
        ({"near": 20}, 0.7, {"direct": 0.08, "sky": 0.6, "misfit": 0.018}, True),
        ({"near": 20}, 0.7, {"direct": 0.08, "sky": 0.6, "misfit": 0.022}, False),
        # ground and cars send a tenth of the sun's light, less than 0.4 of the sky's
        ({"near": 20}, 0.7, {"direct": 0.095, "sky": 0.6}, True),
        ({"near": 20}, 0.7, {"direct": 0.105, "sky": 0.6}, False),
        ({"near": 20}, 0.7, {"direct": 0.09, "sky": 0.24}, True),
        ({"near": 20}, 0.7, {"direct": 0.09, "sky": 0.21}, False),
        # brighter bodies are in glint
        ({"near": 20}, 0.95, {"direct": 0.08, "sky": 0.6}, True),
        ({"near": 20}, 1.05, {"direct": 0.08, "sky": 0.6}, False),
        # and a coat mirrors up to 0.13 of the sky
        ({"near": 20}, 0.7, {"direct": 0.05, "sky": 0.2}, True),
        ({"near": 20}, 0.7, {"direct": 0.05, "sky": 0.17}, False),
        # its lit side is on the side of the sun
        ({"near": 10}, 0.7, {"direct": 0.08, "sky": 0.6}, True),
        ({"near": 6}, 0.7, {"direct": 0.08, "sky": 0.6}, False),
        ({"near": 8, "across": 12}, 0.7, {"direct": 0.08, "sky": 0.6}, True),
        ({"near": 6, "across": 14}, 0.7, {"direct": 0.08, "sky": 0.6}, False),
    ],
)
def test_side_turned_away__gets_light_of_things_around(
    sides: Any, level: float, light: Any, is_shadow: bool
) -> None:
    roof = level * np.ones(24)
    spectra = [GROUND, roof, lit(roof, **light), THING, lit(GROUND, sky=0.5)]
    assert states(contact(0, **sides), spectra)[0][2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(
    ("sides", "body", "light", "is_shadow"),
    [
        # a clear shadow touches another one on 0.04 of its border, of 48 pixels, another one on 0.4
        ({"far": 2}, GROUND, {"sky": 0.5, **UNSURE}, True),
        ({"far": 1}, GROUND, {"sky": 0.5, **UNSURE}, False),
        ({"across": 20}, GROUND, {"sky": 0.5, "misfit": 0.05}, True),
        ({"across": 18}, GROUND, {"sky": 0.5, "misfit": 0.05}, False),
        ({"across": 24}, GROUND, {"sky": 0.5, "misfit": 0.062}, True),
        ({"across": 24}, GROUND, {"sky": 0.5, "misfit": 0.068}, False),
        ({"across": 24}, GROUND, {"sky": 0.72, "misfit": 0.05}, True),
        ({"across": 24}, GROUND, {"sky": 0.78, "misfit": 0.05}, False),
        # on a thing, where it sees 0.45 of the sky
        ({"across": 24}, WHITE, {"sky": 0.5, "misfit": 0.17}, True),
        ({"across": 24}, WHITE, {"sky": 0.5, "misfit": 0.19}, False),
        ({"across": 20}, WHITE, {"sky": 0.5, "misfit": 0.05}, True),
        ({"across": 18}, WHITE, {"sky": 0.5, "misfit": 0.05}, False),
        # enclosed by others on 0.7 of its border, it may get a quarter of the sun's light
        ({"far": 11, "across": 24}, GROUND, {"direct": 0.2, "sky": 0.5}, True),
        ({"far": 8, "across": 24}, GROUND, {"direct": 0.2, "sky": 0.5}, False),
        ({"far": 12, "across": 24}, GROUND, {"direct": 0.23, "sky": 0.5}, True),
        ({"far": 12, "across": 24}, GROUND, {"direct": 0.27, "sky": 0.5}, False),
        ({"far": 12, "across": 24}, GROUND, {"direct": 0.2, "sky": 0.11}, True),
        ({"far": 12, "across": 24}, GROUND, {"direct": 0.2, "sky": 0.09}, False),
    ],
)
def test_shadow__touches_others(sides: Any, body: Any, light: Any, is_shadow: bool) -> None:
    number = contact(**{"far": 0, **sides}, shape=(12, 12), body=0, touched=4)
    number[25:35, 22:40] = 1 if body is WHITE else 0
    spectra = [GROUND, WHITE, lit(body, **light), THING, lit(GROUND, sky=0.5)]
    assert states(number, spectra)[0][2] == (SHADED if is_shadow else LIT)


def test_shadow_beside_another__may_get_as_much_light_from_a_neighbour_as_the_hidden_sky_has() -> None:
    number = contact(4, shape=(12, 12), body=0, touched=4)
    number[42:58, 24:40] = 5
    spectra = [GROUND, WHITE, lit(GROUND, sky=0.6, sent=0.28, **UNSURE), THING, lit(GROUND, sky=0.5), RED]
    assert states(number, spectra)[0][2] == SHADED


@pytest.mark.parametrize(
    ("sides", "shape", "light", "is_shadow"),
    [
        # on a bay line as wide as its lit part, beside shadows on the ground: 0.3 of the border
        ({"far": 9}, (4, 10), {}, True),
        ({"far": 8}, (4, 10), {}, False),
        ({"far": 10}, (5, 10), {}, False),
        # dark glass over a bay line would get less of the sky, and more of the sun
        ({"far": 10}, (4, 10), {"sky": 0.24}, True),
        ({"far": 10}, (4, 10), {"sky": 0.20}, False),
        ({"far": 10}, (4, 10), {"direct": 0.037}, True),
        ({"far": 10}, (4, 10), {"direct": 0.043}, False),
        ({"far": 10}, (4, 10), {"misfit": 0.075}, True),
        ({"far": 10}, (4, 10), {"misfit": 0.085}, False),
    ],
)
def test_shadow_on_a_marking__is_no_black_roof(
    sides: Any, shape: tuple[int, int], light: Any, is_shadow: bool
) -> None:
    number = contact(**sides, shape=shape, body=0, touched=4)
    number[25:29, 25:65] = 1
    dark_ground = 0.5 * GROUND
    spectra = [
        dark_ground,
        WHITE,
        lit(WHITE, **{"sky": 0.3, **light}),
        0.5 * THING,
        lit(dark_ground, sky=0.5),
    ]
    assert states(number, spectra)[0][2] == (SHADED if is_shadow else LIT)


def test_shadows__extend_twelve_times() -> None:
    # A row of parts that touch only one another
    number = contact(0)
    number[20:75, 20:80] = 3
    number[0, :2] = 1, 2
    number[20:23, 30:40] = 4
    number[23:53, 30:40] = 5 + np.repeat(np.arange(15), 2)[:, None]
    spectra = [GROUND, WHITE, GROUND, THING, lit(GROUND, sky=0.5), *15 * [lit(GROUND, sky=0.5, misfit=0.05)]]
    assert (states(number, spectra)[0][5:] == SHADED).tolist() == 12 * [True] + 3 * [False]


@pytest.mark.parametrize(("misfit", "is_shadow"), [(0.048, True), (0.051, False)])
def test_shadow__fits_as_well_as_on_the_best_ground(misfit: float, is_shadow: bool) -> None:
    # The misfit of the other ground, with too much sun, is 0.03: 1.5 of that and 0.004
    other = np.full(24, 0.15)
    smooth, error = lit(other, 0.1, 0.7), lit(other, 0.1, 0.7, misfit=0.03) - lit(other, 0.1, 0.7)
    ground = (smooth + error * (1.0 - misfit / 0.03)) / (0.6 * CLEAR.diffuse)
    number = contact(10, body=0)
    number[2:14, 20:80], number[2:6, 30:50] = 1, 5
    spectra = [ground, other, smooth + error, 2.0 * other, lit(ground, sky=0.5), lit(other)]
    found, is_ground = states(number, spectra)
    assert is_ground[:2].all()
    assert found[2] == (SHADED if is_shadow else LIT)


@pytest.mark.parametrize(
    ("light", "by", "is_shadow"),
    [
        ({"direct": 0.78, "sky": 0.99}, HAZY, True),  # darker than 0.9 of the ground
        ({"direct": 0.78, "sky": 1.06}, HAZY, False),
        ({"direct": 0.78, "sky": 0.95}, CLEAR, True),
        ({"direct": 0.82, "sky": 0.95}, CLEAR, False),
        ({"direct": 0.70, "sky": 0.76}, CLEAR, True),  # grains of the ground lack both
        ({"direct": 0.70, "sky": 0.74}, CLEAR, False),
        ({"direct": 0.40, "sky": 0.90, "misfit": 0.19}, CLEAR, True),
        ({"direct": 0.40, "sky": 0.90, "misfit": 0.21}, CLEAR, False),
    ],
)
def test_pixel_of_the_ground__lacks_sun(light: Any, by: Light, is_shadow: bool) -> None:
    pixel = lit(GROUND, **light, by=by).astype(np.float32)
    number = np.zeros((1, 1), np.int32)
    assert shaded_pixels(pixel[None, None], number, np.array([True]), GROUND[None], by)[0, 0] == is_shadow


@pytest.mark.parametrize(
    ("length", "width", "is_shadow"), [(18, 1, True), (14, 1, False), (22, 4, True), (18, 4, False)]
)
def test_shadow_of_a_post__is_long_and_thin(length: int, width: int, is_shadow: bool) -> None:
    # 16 pixels, and five times as long as wide
    shaded = np.zeros((30, 30), bool)
    shaded[2 : 2 + length, 2 : 2 + width] = True
    assert of_shadows(shaded, np.zeros_like(shaded)).any() == is_shadow


@pytest.mark.parametrize(("brightness", "is_shadow"), [(0.37, True), (0.43, False)])
def test_spot_on_the_ground__is_a_shadow_where_no_texture_is_as_dark(
    brightness: float, is_shadow: bool
) -> None:
    cube = np.broadcast_to(GROUND, (40, 40, 24)).copy()
    sky = 0.95 * CLEAR.diffuse.mean()
    cube[20:23, 20:23] = lit(GROUND, (brightness - sky) / CLEAR.direct.mean(), 0.95)
    model = survey(as_line(cube, NM), sun_zenith=40.0, diffuse="model")
    assert (model.shade_distance[21, 21] == 0) == is_shadow


@pytest.mark.parametrize(
    ("light", "fades"),
    [
        ({"direct": 0.5, "sky": 1.25}, True),
        ({"direct": 0.5, "sky": 1.35}, False),
        ({"direct": 0.5, "sky": 0.9, "misfit": 0.062}, True),
        ({"direct": 0.5, "sky": 0.9, "misfit": 0.068}, False),
    ],
)
def test_light__fades_over_eight_pixels_beside_a_shadow(light: Any, fades: bool) -> None:
    number = np.repeat([[1] * 10 + [2] * 30], 5, axis=0).astype(np.int32)
    number[0] = 0
    spectra = np.stack([WHITE, lit(WHITE), lit(WHITE, **light)]).astype(np.float32)
    matches = Matches(np.array([LIT, SHADED, LIT], np.int8), np.array([0, 0, 2], np.int32))
    found = penumbrae(spectra[number], number, matches, np.zeros(3, bool), CLEAR)
    assert (found == 1).sum(axis=1).tolist() == [0] + 4 * [18 if fades else 10]


def test_diffuse_fraction__is_that_of_pixels_under_the_open_sky() -> None:
    # Expected: the mean of the 60th to the 90th percentile of 61 pixels, 0.75 of the sky's light
    channels = np.concatenate([[GROUND], np.linspace(0.0, 1.0, 61)[:, None] * GROUND * CLEAR.diffuse])
    samples, matches = (
        [np.array([0]), np.arange(1, 62)],
        Matches(np.array([LIT, SHADED], np.int8), np.zeros(2, np.int32)),
    )
    arguments = channels[None].astype(np.float32), samples, channels[[0, 31]]
    found = fraction_in_shadow(*arguments, np.array([900, 61]), matches)
    np.testing.assert_allclose(found, 0.75 * CLEAR.diffuse, rtol=1e-3)
    with pytest.raises(SchemaError, match="shadow-missing"):
        fraction_in_shadow(*arguments, np.array([900, 59]), matches)


# --- black paint in the sun --------------------------------------------------------------------------------

#: A pattern that no zigzag adds to.
STEPS = np.resize([1.0, 1.0, -1.0, -1.0], 24)


@pytest.mark.parametrize(
    ("body", "slope", "mirrored", "misfit", "as_shade", "is_coat"),
    [
        (0.0034, 0.0, 0.05, 0.0, 0.03, True),  # with less its light does not show the sun
        (0.0026, 0.0, 0.05, 0.0, 0.03, False),
        (0.035, 0.0, 0.10, 0.0, 0.03, True),  # 0.05 with the mirrored sky
        (0.039, 0.0, 0.10, 0.0, 0.03, False),
        (0.007, 0.0, 0.033, 0.0, 0.03, True),  # a level coat mirrors 0.04, a leaning one up to 0.12
        (0.007, 0.0, 0.027, 0.0, 0.03, False),
        (0.007, 0.0, 0.125, 0.0, 0.03, True),
        (0.007, 0.0, 0.138, 0.0, 0.03, False),
        (0.030, 0.55, 0.05, 0.0, 0.03, True),  # black changes over the spectrum by 0.6
        (0.030, 0.68, 0.05, 0.0, 0.03, False),
        (0.007, 0.0, 0.05, 0.0036, 0.03, True),
        (0.007, 0.0, 0.05, 0.0044, 0.03, False),
        (0.007, 0.0, 0.05, 0.0035, 0.0050, True),  # a shadow fits worse by 1.3
        (0.007, 0.0, 0.05, 0.0035, 0.0040, False),
    ],
)
def test_black_coat_in_the_sun__mirrors_the_sky(
    body: float, slope: float, mirrored: float, misfit: float, as_shade: float, is_coat: bool
) -> None:
    # The ground is such that its shadow, in a tenth of the sun's light or less, has the same spectrum but for
    # a misfit
    paint = body * (1.0 + slope * np.linspace(-1.0, 1.0, 24)) + mirrored * CLEAR.diffuse
    direct, sky = 0.03, 0.5
    ground = paint / (direct * CLEAR.direct + sky * CLEAR.diffuse)
    ground *= 1.0 + np.sqrt(as_shade**2 - misfit**2) * (1.0 + 0.01 / paint) * STEPS
    spectra = [ground, WHITE, paint + misfit * (paint + 0.01) * ZIGZAG, ground.mean() * (1.0 + 0.5 * STEPS)]
    number = contact(6, body=0)
    number[number == 4] = 0
    assert states(number, spectra)[0][2] == (LIT if is_coat else SHADED)


# --- mirror images that cover a segment --------------------------------------------------------------------

#: A light in which a shadow may be a third as bright as its body.
MILD = Light.under(np.linspace(0.5, 0.2, 24))


def is_glint(
    body: Floats,
    seen: Floats,
    *,
    body_px: int = 100,
    step: float = 0.1,
    zenith: float = 45.0,
    by: Light = CLEAR,
) -> bool:
    # Whether a segment beside a body is this body under the mirrored sun
    spectra, number = np.stack([body, seen]), np.repeat([[0] * 10 + [1] * 10], 10, axis=0).astype(np.int32)
    matches = Matches(np.zeros(2, np.int8), np.arange(2, dtype=np.int32))
    pairs, contrast = touching(number, 2), abs(seen.mean() - body.mean())
    steps = np.full(2, step * contrast)
    found = match_segments(spectra, np.array([body_px, 100]), pairs, by, matches, steps, zenith)
    return bool(found.state[1] == GLINTED)


@pytest.mark.parametrize(
    ("level", "glint", "misfit", "options", "expected"),
    [
        (0.1, 0.0036, 0.0, {}, False),  # a lean adds as much
        (0.1, 0.0064, 0.0, {}, True),
        (1.0, 0.3, 0.93, {}, True),  # within the tolerance of 2 % and 0.0005
        (1.0, 0.3, 1.07, {}, False),
        (0.03, 0.02, 0.93, {}, True),
        (0.03, 0.02, 1.07, {}, False),
        (1.0, 0.3, 0.0, {"body_px": 105}, True),  # the body is as large
        (1.0, 0.3, 0.0, {"body_px": 95}, False),
        (1.0, 0.3, 0.0, {"step": 0.33}, True),  # mirror images fade out, bodies have edges
        (1.0, 0.3, 0.0, {"step": 0.37}, False),
    ],
)
def test_segment__is_a_body_under_the_mirrored_sun(
    level: float, glint: float, misfit: float, options: Any, expected: bool
) -> None:
    seen = level * RED + glint * CLEAR.direct
    assert is_glint(level * RED, seen + misfit * (0.02 * seen + 0.0005) * ZIGZAG, **options) == expected


@pytest.mark.parametrize(("direct", "expected"), [(1.50, False), (1.62, True)])
def test_lean__explains_brightness_up_to_the_sun_at_normal_incidence(direct: float, expected: bool) -> None:
    # 1.1 / cos(45 degrees) = 1.556
    assert is_glint(GROUND, GROUND * (direct * CLEAR.direct + CLEAR.diffuse)) == expected


@pytest.mark.parametrize(
    ("sky", "misfit", "level", "by", "expected"),
    [
        (0.22, 0.0, 0.1, MILD, False),  # a shadow sees 0.2 of the sky and more, up to 1.15
        (0.18, 0.0, 0.1, MILD, True),
        (1.11, 0.0, 0.1, MILD, False),
        (1.19, 0.0, 0.1, MILD, True),
        (0.90, 0.0, 0.1, HAZY, False),  # and is less than half as bright
        (0.99, 0.0, 0.1, HAZY, True),
        (0.80, 0.105, 0.01, MILD, False),  # with a misfit of 0.11
        (0.80, 0.115, 0.01, MILD, True),
    ],
)
def test_darker_segment__may_be_the_brighter_one_in_shadow(
    sky: float, misfit: float, level: float, by: Light, expected: bool
) -> None:
    # The only bodies that are each other in shadow and in glint
    share = sky * by.diffuse
    body = by.direct * share / (1.0 - share)
    glint = level / body.mean()
    body = glint * body
    body = body + misfit * (body + 0.00625) / (1.0 - share) * ZIGZAG
    assert is_glint(body, body + glint * by.direct, by=by) == expected


def test_glint__extends_six_times() -> None:
    # Every segment is larger than the one before, which therefore is not its body, and touches only that
    number = np.repeat([[0] * 10 + [k for k in range(1, 9) for _ in range(4)]], 10, axis=0).astype(np.int32)
    spectra = np.stack([RED, *8 * [RED + 0.3 * CLEAR.direct]]) * np.linspace(1.0, 1.01, 9)[:, None]
    matches = Matches(np.zeros(9, np.int8), np.arange(9, dtype=np.int32))
    sizes, pairs = np.array([999, *range(40, 120, 10)]), touching(number, 9)
    found = match_segments(spectra, sizes, pairs, CLEAR, matches, np.zeros(pairs.one.size), 45.0)
    assert (found.state == GLINTED).tolist() == [False, *6 * [True], False, False]


# --- amounts of light of pairs, and neighbours that send light ---------------------------------------------


@pytest.mark.parametrize(
    ("light", "is_possible"),
    [
        ({"direct": 0.38, "sky": 0.5}, True),
        ({"direct": 0.42, "sky": 0.5}, False),
        ({"sky": 1.08}, True),  # bright things beside it add to the sky
        ({"sky": 1.12}, False),
        ({"misfit": 0.28}, True),
        ({"misfit": 0.32}, False),
    ],
)
def test_mixture__may_be_a_shadow(light: Any, is_possible: bool) -> None:
    one, none = np.array([1]), np.full((2, 0), -1)
    found = mixtures_of(one, one - 1, np.stack([GROUND, lit(GROUND, **light)]), none, CLEAR)
    assert found.segment.size == is_possible


def test_no_segment_lights_itself() -> None:
    # on a body without colour its own light would be any share of the diffuse light
    shadow, itself = lit(GROUND, sky=0.6), np.array([[-1], [1]])
    one = np.array([1])
    alone = mixtures_of(one, one - 1, np.stack([GROUND, shadow]), np.full((2, 0), -1), CLEAR)
    found = mixtures_of(one, one - 1, np.stack([GROUND, shadow]), itself, CLEAR)
    np.testing.assert_array_equal(found, alone)


def sent_to(number: Any, senders: list[Floats]) -> Any:
    # Segments that may send light to the first one
    spectra = np.stack([GROUND, *senders])
    return senders_of(number.astype(np.int32), spectra, np.bincount(number.ravel(), minlength=len(spectra)))


@pytest.mark.parametrize(
    ("level", "colour", "px", "distance", "sends"),
    [
        (0.043, 0.5, 400, 20, True),
        (0.037, 0.5, 400, 20, False),
        (0.3, 0.33, 400, 20, True),
        (0.3, 0.27, 400, 20, False),
        (0.3, 0.5, 160, 20, True),
        (0.3, 0.5, 140, 20, False),
        (0.3, 0.5, 400, 56, True),
        (0.3, 0.5, 400, 68, False),
    ],
)
def test_sender__is_bright_coloured_large_and_near(
    level: float, colour: float, px: int, distance: int, sends: bool
) -> None:
    number = np.full((20, 120), 2)
    number[:, :4] = 0
    number[:, 4 + distance : 4 + distance + px // 20] = 1
    senders = sent_to(number, [level * (1.0 + colour * ZIGZAG), GROUND])
    assert (1 in senders[0]) == sends


@pytest.mark.parametrize(("size", "count"), [(2, 4), (40, 6)])
def test_senders__are_four_of_a_place_and_six_of_a_segment(size: int, count: int) -> None:
    # Eight red cars around it
    y, x = np.indices((80, 80)) - 40
    number = 1 + ((np.arctan2(y, x) / (2.0 * np.pi) % 1.0) * 8).astype(int)
    number[(np.abs(y) <= size // 2) & (np.abs(x) <= size // 2)] = 0
    assert (sent_to(number, 8 * [RED])[0] >= 0).sum() == count


# --- coloured bodies, and their spectra without glint ------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "colour", "px", "sends"),
    [
        (0.3, 0.042, 400, True),
        (0.3, 0.038, 400, False),
        (0.5, 0.055, 400, True),  # a tenth of its brightness, or it may be the mirrored sun
        (0.5, 0.045, 400, False),
        (0.3, 0.200, 42, True),
        (0.3, 0.200, 38, False),
        (0.95, 0.200, 400, True),  # brighter ones mirror the sun
        (1.05, 0.200, 400, False),
    ],
)
def test_coloured_neighbour__lights_others(level: float, colour: float, px: int, sends: bool) -> None:
    number = np.zeros((40, 40), np.int32)
    number[10:30, 10:30] = 1
    spectra, lit_ones = (
        np.stack([GROUND, level + colour * ZIGZAG]),
        Matches(np.zeros(2, np.int8), np.arange(2, dtype=np.int32)),
    )
    found = nearest_coloured(number, np.array([1200, px]), spectra, lit_ones, CLEAR, 120)
    assert (found == 1).any() == sends


def test_cells__have_four_coloured_neighbours() -> None:
    y, x = np.indices((80, 80)) - 40
    number = (1 + ((np.arctan2(y, x) / (2.0 * np.pi) % 1.0) * 8).astype(int)).astype(np.int32)
    matches = Matches(np.zeros(9, np.int8), np.arange(9, dtype=np.int32))
    found = nearest_coloured(number, np.full(9, 800), np.stack([GROUND, *8 * [RED]]), matches, CLEAR, 120)
    assert ((found >= 0).sum(axis=2) == 4).all()


def cleaned(*bodies: Floats, zenith: float = 0.0, same: Any = ((), ())) -> tuple[Floats, Floats]:
    # Spectra without glint, and the spread of direct light, of bodies with pixels (pixel, channel)
    ends = np.cumsum([0, *map(len, bodies)])
    samples = [np.arange(start, stop) for start, stop in itertools.pairwise(ends)]
    spectra, channels = np.stack([np.median(body, axis=0) for body in bodies]), np.concatenate(bodies)[None]
    count = len(bodies)
    matches = Matches(np.zeros(count, np.int8), np.arange(count, dtype=np.int32))
    pairs = np.array(same[0], np.int64), np.array(same[1], np.int64)
    return clean_references(
        channels.astype(np.float32), samples, spectra, matches, pairs, CLEAR,
        lambda pixels: np.full((pixels.size, 2), -1, np.int32), zenith,
    )  # fmt: skip


#: Level of direct light in a spectrum that is flat.
FLAT_LEVEL = CLEAR.direct.sum() / (CLEAR.direct**2).sum()


def grey_body(
    ratios: Any, level: float = 0.3, count: int = 1000, sky: float = 1.0, colour: float = 0.0
) -> Floats:
    # Pixels of a grey body by ascending brightness: quantiles and ratios to its level of direct light; its
    # darkest fifth sees a part of the sky only
    quantile = (np.arange(count) + 0.5) / count
    added = (np.interp(quantile, *np.transpose(ratios)) - 1.0) * FLAT_LEVEL * level
    seen = np.where(quantile[:, None] < 0.2, sky, 1.0)
    return np.asarray(
        level * (CLEAR.direct + seen * CLEAR.diffuse) + added[:, None] * CLEAR.direct + colour * ZIGZAG
    )


def mostly_glint(top: float = 1.6, median: float = 1.15, lowest: float = 1.0) -> Any:
    # Quantiles and ratios of a body of which more than half is brighter than its darkest parts
    return [(0.10, lowest), (0.11, 1.0), (0.20, 1.0), (0.22, median), (0.90, median), (0.95, top)]


@pytest.mark.parametrize(
    ("body", "is_mostly_glint"),
    [
        (grey_body(mostly_glint()), True),
        # glint is brighter by 1.3 than a surface that faces the sun
        (grey_body(mostly_glint(top=1.36)), True),
        (grey_body(mostly_glint(top=1.24)), False),
        (grey_body(mostly_glint(top=1.27, lowest=0.95)), False),
        # and the median by 1.08 than the darkest parts
        (grey_body(mostly_glint(median=1.11)), True),
        (grey_body(mostly_glint(median=1.06)), False),
        # beside a shadow the darkest parts are much darker
        (grey_body(mostly_glint(median=3.3, top=9.0)), True),
        (grey_body(mostly_glint(median=3.7, top=9.0)), False),
        # and lack light of the sky
        (grey_body(mostly_glint(), sky=0.84), True),
        (grey_body(mostly_glint(), sky=0.76), False),
        # lean of bodies brighter than 0.1 is as bright as glint
        (grey_body(mostly_glint(median=1.3, top=2.0), level=0.105), True),
        (grey_body(mostly_glint(median=1.3, top=2.0), level=0.095), False),
        (grey_body(mostly_glint(), colour=0.3 * 0.078), True),
        (grey_body(mostly_glint(), colour=0.3 * 0.100), False),
        (grey_body(mostly_glint(), count=52), True),
        (grey_body(mostly_glint(), count=48), False),
    ],
)
def test_grey_body__is_mostly_in_glint(body: Floats, is_mostly_glint: bool) -> None:
    # Its parts lean by less than others': two degrees under a sun at 45 degrees, not six
    (spread,) = cleaned(body)[1]
    assert (0.02 < spread < 0.04) if is_mostly_glint else (0.07 < spread < 0.15)


@pytest.mark.parametrize(
    ("plateau", "quantile"),
    [
        (0.060, 0.20),  # mostly without glint: the mean of the 5th to the 35th percentile
        (0.073, 0.06),  # else that of the 2nd to the 10th
        (0.300, 0.06),
    ],
)
def test_grey_body_without_glint__is_its_darker_part(plateau: float, quantile: float) -> None:
    slope = plateau / (FLAT_LEVEL * 0.3)
    ratios = [(0.0, 1.0), (0.5, 1.0 + 0.5 * slope), (0.6, 2.5), (1.0, 4.0)]
    (reference,) = cleaned(grey_body(ratios, count=5000))[0]
    np.testing.assert_allclose(reference, 0.3 + quantile * plateau * CLEAR.direct, atol=0.004 * plateau)


@pytest.mark.parametrize(
    ("glint", "count", "quantile"),
    [
        (0.1000, 5000, 0.055),  # the 1st to the 10th percentile of glint is nearly without it
        (0.0085, 5000, 0.055),  # where it differs by more than noise, 0.003
        (0.0065, 5000, 0.500),
        (0.1800, 5000, 0.055),  # up to 0.1 below the median
        (0.1000, 70, 0.055),  # 6 pixels
        (0.1000, 50, 0.500),  # 4 pixels
    ],
)
def test_coloured_body_without_glint__is_where_least_is_added(
    glint: float, count: int, quantile: float
) -> None:
    added = glint * (np.arange(count) + 0.5) / count
    (reference,) = cleaned(RED + added[:, None] * CLEAR.direct)[0]
    tolerance = 0.0015 if count > 100 else 0.03
    np.testing.assert_allclose(
        reference.mean(), (RED + quantile * glint * CLEAR.direct).mean(), atol=tolerance * glint
    )


@pytest.mark.parametrize(("px", "is_clean"), [(110, True), (90, False)])
def test_body_all_in_glint__has_the_spectrum_of_another_part(px: int, is_clean: bool) -> None:
    # That is a tenth as large
    glint = RED + 0.05 * CLEAR.direct
    reference = cleaned(np.tile(glint, (1000, 1)), np.tile(RED, (px, 1)), same=([0], [1]))[0]
    np.testing.assert_allclose(reference[0], RED if is_clean else glint, atol=0.003)


# --- leaves ------------------------------------------------------------------------------------------------


def leaves(*spikes: tuple[float, float, float]) -> Floats:
    # Reflectance of leaves, with other values (from, to, reflectance) in a range of wavelengths [nm]
    nm = np.arange(400.0, 1001.0, 5.0)
    spectrum = np.interp(nm, [500, 530, 570, 600, 690, 735], [0.03, 0.08, 0.08, 0.04, 0.04, 0.5])
    for first, last, value in spikes:
        spectrum[(nm >= first) & (nm <= last)] = value
    return np.asarray(spectrum)


@pytest.mark.parametrize(
    ("spectrum", "is_leaf"),
    [
        (leaves(), True),
        # blue, green, red, the red edge and the plateau are where they are
        (leaves((400, 425, 0.9), (495, 530, 0.0), (570, 655, 0.0), (695, 730, 0.0), (905, 1000, 3.0)), True),
        (leaves((400, 425, 0.0), (495, 530, 0.9), (570, 655, 0.9), (695, 730, 0.9), (905, 1000, 0.0)), True),
        (leaves((770, 785, 9.0)), True),
        (leaves((430, 490, 0.1)), False),
        (leaves((535, 565, 0.02)), False),
        (leaves((660, 690, 0.3)), False),
        (leaves((735, 765, 0.1)), False),
        (leaves((790, 900, 0.8)), False),
        (leaves((660, 690, 0.155)), True),  # three times as bright after the red edge
        (leaves((660, 690, 0.180)), False),
        (leaves((790, 900, 0.68)), True),  # and not 1.4 times as bright after that
        (leaves((790, 900, 0.72)), False),
    ],
)
def test_leaves__have_a_red_edge(spectrum: Floats, is_leaf: bool) -> None:
    assert is_vegetation(spectrum[None], np.arange(400.0, 1001.0, 5.0))[0] == is_leaf


# --- segments and channels ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("step", "count"), [(0.0108, 2), (0.0092, 1)])
@pytest.mark.parametrize("level", [0.005, 0.3])
def test_segments__are_joined_over_steps_below_one_over_their_pixels(
    level: float, step: float, count: int
) -> None:
    # Halves of 100 pixels; steps are relative to the reflectance and 0.01
    picture = np.full((10, 20, 4), level, np.float32)
    picture[:, 10:] += step * (level + 0.01) / (1.0 - 0.5 * step)
    assert divide(picture).size.size == count


@pytest.mark.parametrize(
    ("rows", "columns", "corners", "is_segment"),
    [
        (3, 5, 3, True),  # 12 pixels
        (3, 5, 4, False),
        (3, 5, 0, True),  # of which three are inside
        (3, 4, 0, False),
    ],
)
def test_segment__is_large_and_wide(rows: int, columns: int, corners: int, is_segment: bool) -> None:
    picture = np.full((20, 20, 4), 0.1, np.float32)
    spot = np.ones((rows, columns), bool)
    for corner in [(0, 0), (0, -1), (-1, 0), (-1, -1)][:corners]:
        spot[corner] = False
    picture[8 : 8 + rows, 8 : 8 + columns][spot] = 0.9
    assert divide(picture).size.size == 1 + is_segment


@pytest.mark.parametrize(
    ("sides", "px", "are_linked"), [(4, 2900, True), (2, 2900, False), (4, 3100, False)]
)  # fmt: skip
def test_small_segment__links_its_neighbours(sides: int, px: int, are_linked: bool) -> None:
    # Over three sides and more: all things in a car park touch the asphalt
    number = np.repeat([[0] * 4 + [2] * 4 + [1] * 4], sides, axis=0).astype(np.int32)
    one, other = beyond(touching(number, 3), np.array([50, 50, px]))
    assert ((one == 0) & (other == 1)).any() == are_linked


def test_samples__are_two_thousand_pixels_at_most() -> None:
    number = np.zeros((50, 100), np.int32)
    (sample,) = sample_pixels(number, np.ones(number.shape, bool), 1)
    assert 1024 < sample.size <= 2048


@pytest.mark.parametrize("level", [0.008, 0.012, 0.2])
def test_noise__is_relative_to_reflectance_but_on_black(level: float) -> None:
    channels = np.random.default_rng(3).normal(level, 1e-4, (60, 60, 5)).astype(np.float32)
    noise = channel_noise(channels, np.zeros((60, 60), np.int32), np.ones((60, 60), bool))
    np.testing.assert_allclose(noise, 1e-4 / max(level, 0.01), rtol=0.07)


def test_spectra__are_of_pixels_two_pixels_from_the_border() -> None:
    cube = np.full((40, 60, 24), 0.1)
    cube[:, 20:26] = np.array([0.3030, 0.3015, 0.3000, 0.3000, 0.3015, 0.3030])[:, None]
    model = survey(as_line(cube, NM), sun_zenith=40.0, diffuse="model")
    np.testing.assert_allclose(model.spectrum[model.segment[20, 22]], 0.30075, rtol=1e-4)


@pytest.mark.parametrize(("direct", "has_lobe"), [(0.055, True), (0.045, False)])
def test_without_sun__no_sun_is_mirrored(direct: float, has_lobe: bool) -> None:
    cube = np.full((40, 40, 24), 0.3)
    cube[20, 20] += 5.0
    model = survey(as_line(cube, NM), diffuse=np.full(24, 1.0 - direct))
    assert model.lobe.any() == has_lobe


@pytest.mark.parametrize("sun", [30.0, 55.0])
def test_bright_sky__is_that_within_five_degrees_of_the_sun(sun: float) -> None:
    # A coat of usual roughness mirrors no direction alone; expected: another reading of the tables
    nm = np.array([430.0, 550.0, 860.0])
    line = xr.Dataset(coords={"wavelength": ("band", nm, {"units": "nm"})})
    fractions = diffuse_fraction(nm, sun, aerosol_optical_depth=0.1)
    _, sunward = split_of(line, fractions, sun, "clear").mirrored()
    bright, zenith = (
        [float(relative_sky(k, sun, np.cos(np.radians(angle)), 0.0, aerosol=0.1)) for k in nm]
        for angle in (sun - 5.0, 0.0)
    )
    np.testing.assert_allclose(sunward, np.subtract(bright, zenith), rtol=0.03)


# --- flags of single pixels --------------------------------------------------------------------------------

BLUE = smooth_edge(NM, 500.0, 0.5, 0.05)


def pixels_flagged(
    pixels: Any, bodies: Any, zenith: float = 0.0, sunward: float = 0.0, **fields: Any
) -> xr.Dataset:
    # Flags of a line of one pixel a column on the first of some bodies
    columns, count = len(pixels), len(bodies)
    plane = (1, columns)
    model = SceneModel(
        wavelength=NM,
        channel=np.arange(24),
        channel_wavelength=NM,
        diffuse_fraction=CLEAR.diffuse,
        zenith_radiance=np.ones(24),
        sunward_radiance=np.full(24, sunward),
        shift=np.zeros((24, columns)),
        noise=np.zeros(24),
        segment=np.zeros(plane, np.int32),
        neighbour=np.broadcast_to(
            np.arange(1, count, dtype=np.int32), (1, -(-columns // 4), count - 1)
        ).copy(),
        size=np.full(count, 900),
        body=np.arange(count, dtype=np.int32),
        paint=np.arange(count, dtype=np.int32),
        tilt=np.full(count, 0.1),
        spectrum=np.stack(bodies),
        reference=np.stack(bodies),
        attrs={"sun_zenith": zenith},
        **{
            "edge_distance": np.full(plane, 9, np.uint8),
            "shade_distance": np.full(plane, 255, np.uint8),
            "lobe": np.ones(plane, np.uint8),
            "state": np.full(count, LIT, np.int8),
            "ground": np.ones(count, np.int8),
            **fields,
        },
    )
    return flag(as_line(np.asarray(pixels)[None], NM), model).compute()


def has(line: xr.Dataset, bit: Quality) -> list[bool]:
    return ((line.quality.values[0] & int(bit)) > 0).tolist()


def misfit_of(seen: Floats, parts: list[Floats], expected: list[float], spread: list[float]) -> float:
    # Sum of squares of a non-negative fit, in standard deviations of 0.7 % and 0.001, and of its priors
    sigma = 0.007 * seen + 0.001
    design = np.concatenate([np.stack(parts, axis=1) / sigma[:, None], np.diag(1.0 / np.array(spread))])
    return float(nnls(design, np.concatenate([seen / sigma, np.divide(expected, spread)]))[1] ** 2)


#: Direct light and sky of a body within its leans, and the sky and its bright part in a clear coat.
OWN = [1.0, 1.0, 0.0, 0.0], [0.1, 0.3, 0.02, 0.03]


@pytest.mark.parametrize(
    ("body", "senders", "added"),
    [
        (RED, [], None),
        (0.02 * RED, [], None),
        (0.02 + 0.01 * STEPS, [RED], 0),
        (0.02 * GROUND, [0.03 * RED], 1),
        (0.02 + 0.01 * STEPS, [BLUE, RED], 2),
        (0.02 * GROUND, [0.03 * BLUE, 0.03 * RED], 3),
    ],
)
def test_light__is_detected_from_three_standard_deviations_on(
    body: Floats, senders: list[Floats], added: int | None
) -> None:
    # Expected: the amount without which a fit is worse by 9, from an independent solution. The light is the
    # mirrored sun (None), or of a neighbour, which lights the body by 0.2 of the sun, or 0.1 of which a coat
    # mirrors; a coat mirrors 0.04 of the sky around the sun beside glint
    own = [body * CLEAR.direct, body * CLEAR.diffuse, CLEAR.diffuse, 0.5 * CLEAR.diffuse]
    sent = [part for sender in senders for part in (body * sender, sender)]
    parts, coat, spread = (sent, 0.0, [0.2, 0.1] * len(senders)) if sent else ([CLEAR.direct], 0.04, [10.0])
    light = parts[added or 0]

    def evidence(amount: float) -> float:
        seen = body + amount * light
        expected = [1.0, 1.0, 0.0, coat] + [0.0] * len(parts)
        return misfit_of(seen, own, *OWN) - misfit_of(seen, own + parts, expected, OWN[1] + spread) - 9.0

    limit = float(brentq(evidence, 1e-5, 10.0))
    line = pixels_flagged(
        [body + factor * limit * light for factor in (0.985, 1.015)], [body, *senders], np.nan, sunward=0.5
    )
    layer = line.glint_fraction if added is None else line.adjacency
    assert (layer.values[0] > 0.0).tolist() == [False, True]


def test_lean__is_up_to_the_sun_at_normal_incidence() -> None:
    # 1.1 / cos(45 degrees) = 1.556 of the direct light
    line = pixels_flagged([lit(RED, direct, 1.0) for direct in (1.5, 3.0)], [RED], zenith=45.0)
    np.testing.assert_allclose(line.blocked_direct.values[0], [-0.5, -0.556], atol=0.02)


@pytest.mark.parametrize(("glint", "has_bit"), [(0.0037, False), (0.0043, True)])
def test_glint_on_black_paint__adds_a_minimum_of_reflectance(glint: float, has_bit: bool) -> None:
    body = 0.01 * RED
    line = pixels_flagged([body + glint / CLEAR.direct.mean() * CLEAR.direct], [body])
    assert has(line, Quality.GLINT) == [has_bit]


def test_missing_light__is_shadow_near_one_on_the_ground() -> None:
    distance = np.array([[0, 1, 2]], np.uint8)
    line = pixels_flagged(3 * [lit(GROUND, 0.5, 1.0)], [GROUND], shade_distance=distance)
    assert has(line, Quality.SHADOW) == [True, True, False]


def test_missing_light__is_shadow_on_things_where_no_lean_explains_it() -> None:
    fields = {"state": np.array([SHADED], np.int8), "ground": np.zeros(1, np.int8)}
    line = pixels_flagged([lit(GROUND, direct, 0.95) for direct in (0.45, 0.35)], [GROUND], **fields)
    assert has(line, Quality.SHADOW) == [False, True]


def test_leaning_coat__mirrors_an_eighth_of_the_zenith_at_most() -> None:
    # At 40 degrees; with more the direction would be that of the horizon
    body = 0.01 * RED
    line = pixels_flagged([body + sky * CLEAR.diffuse for sky in (0.11, 0.3)], [body])
    np.testing.assert_allclose(line.mirrored_sky.values[0], [0.11, 0.12], atol=0.006)


def test_sky_around_the_sun__is_mirrored_with_the_sun() -> None:
    # A coat mirrors 0.04 of it beside glint, and 0.065 at most: the rest of a tenth looks like more glint
    body, sky = 0.1 * RED, 4.0 * CLEAR.diffuse
    line = pixels_flagged(
        [body + 0.5 * CLEAR.direct + amount * sky for amount in (0.04, 0.06, 0.10)], [body], sunward=4.0
    )
    usual, most, beyond_it = line.glint_fraction.values[0]
    assert usual == pytest.approx(0.5, abs=1e-5)
    assert most == pytest.approx(0.5, abs=1e-3)
    assert beyond_it > 0.51


@pytest.mark.parametrize(("shift", "is_resampled"), [(1.1, True), (0.9, False)])
def test_line_with_smile__is_resampled_above_a_nanometre(shift: float, is_resampled: bool) -> None:
    line = as_line(np.broadcast_to(GROUND, (16, 16, 24)), NM)
    line = line.assign_coords(wavelength_shift=("cross_track", np.linspace(0.0, shift, 16), {"units": "nm"}))
    assert (flag_line(line, sun_zenith=40.0, diffuse="model").surveyed is not line) == is_resampled
