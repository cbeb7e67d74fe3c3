"""Cast shadows among segments: told from dark glass and black paint by what lies around them."""

import functools
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import scipy.optimize
import xarray as xr
from support.analytic_scenes import as_line, box_shadow, smooth_edge, wavelengths

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings.corrections import split_of
from hyperpaint.surroundings.model import LIT, SHADED
from hyperpaint.surroundings.segments import (
    Light,
    Segments,
    distance_to,
    edge_distance,
    senders_of,
    solve,
    touching,
)
from hyperpaint.surroundings.surveying import match_shade, of_shadows, shaded_pixels

NM = np.linspace(412.0, 988.0, 24)
DIFFUSE = diffuse_fraction(NM, 40.0)
LIGHT = Light.under(DIFFUSE)
ASPHALT = smooth_edge(NM, 600.0, 0.07, 0.12, 150.0)
RED = smooth_edge(NM, 600.0, 0.04, 0.6)
AWAY = np.array([1.0, 0.0])
"""Shadows fall on to higher lines."""


def shadow_of(body: np.ndarray, direct: float, sky: float, sent: float = 0.0) -> np.ndarray:
    # Return a body in little light
    return body * (direct * LIGHT.direct + sky * LIGHT.diffuse + sent * RED)


def matched(
    number: np.ndarray, spectra: list[np.ndarray], side: np.ndarray | None = AWAY, light: Light = LIGHT
) -> list[int]:
    # Return the segments that are taken for shadows on the first one
    count = len(spectra)
    numbers = number.astype(np.int32)
    size = np.bincount(number.ravel(), minlength=count).astype(np.int64)
    found, ground = match_shade(numbers, np.stack(spectra), size, touching(numbers, count), light, side)
    assert ground[0]
    assert set(found.state) <= {LIT, SHADED}
    shaded = np.flatnonzero(found.state == SHADED)
    assert (found.body[shaded] == 0).all()
    return shaded.tolist()


@pytest.mark.parametrize("parts", [2, 3])
def test_the_amounts_are_those_of_non_negative_least_squares(parts: int) -> None:
    body, sender, seen = np.random.default_rng(3).uniform(0.02, 0.6, (3, 40, 24))
    amount, misfit = solve(seen, body, sender if parts == 3 else None, LIGHT)
    for row in range(40):
        sigma = 0.05 * seen[row] + 0.0005
        columns = [body[row] * LIGHT.direct, body[row] * LIGHT.diffuse, body[row] * sender[row]][:parts]
        expected, rest = scipy.optimize.nnls(np.stack(columns, axis=1) / sigma[:, None], seen[row] / sigma)
        np.testing.assert_allclose(amount[row], expected, atol=1e-5)
        np.testing.assert_allclose(misfit[row], 0.05 * rest / np.sqrt(24), rtol=1e-6)


@pytest.mark.parametrize("side", [AWAY, None])
def test_glass_of_the_spectrum_of_a_shadow_is_none_where_its_car_surrounds_it(
    side: np.ndarray | None,
) -> None:
    number = np.zeros((60, 60), int)
    number[10:30, 10:50] = 1  # a red car
    number[30:40, 10:50] = 2  # its shadow
    number[15:25, 20:40] = 3  # its roof window
    dark = shadow_of(ASPHALT, 0.01, 0.8)
    assert matched(number, [ASPHALT, RED, dark, dark], side) == [2]


def test_a_black_car_and_an_enclosed_shadow() -> None:
    number = np.zeros((60, 60), int)
    number[10:30, 10:50] = 1
    number[30:40, 10:50] = 2
    assert matched(number, [ASPHALT, shadow_of(ASPHALT, 0.015, 0.7), shadow_of(ASPHALT, 0.005, 0.75)]) == [2]
    number = np.zeros((40, 40), int)
    number[12:24, 12:24] = 1
    assert matched(number, [ASPHALT, shadow_of(ASPHALT, 0.01, 0.85)]) == [1]
    # an oil stain is darker in the light of the sun as well as in that of the sky
    assert matched(number, [ASPHALT, 0.4 * ASPHALT]) == []


def test_a_red_car_reddens_the_shadow_beside_it() -> None:
    number = np.zeros((60, 60), int)
    number[10:24, 10:50] = 1
    number[24:32, 10:50] = 2
    number[32:46, 10:50] = 3
    number[24:32, 50:56] = 4  # where the shadow between the cars comes into the open
    between = shadow_of(ASPHALT, 0.03, 0.3, sent=0.15)
    spectra = [ASPHALT, 0.5 + 0.0 * RED, between, RED, shadow_of(ASPHALT, 0.01, 0.7)]
    assert senders_of(number.astype(np.int32), np.stack(spectra), np.bincount(number.ravel()))[2, 0] == 3
    assert matched(number, spectra) == [2, 4]


def test_single_pixels_of_shadows_lack_the_sun() -> None:
    number = np.zeros((5, 6), np.int32)
    number[:, 3:] = 1
    number[4, 5] = -1
    seen = np.broadcast_to(ASPHALT, (5, 6, 24)).astype(np.float32)
    seen = np.where((number == 1)[..., None], RED, seen).astype(np.float32)
    seen[1, 1] = shadow_of(ASPHALT, 0.4, 0.95)
    seen[2, 1] = 0.5 * ASPHALT
    seen[1, 4] = shadow_of(RED, 0.4, 0.95)  # a door: it leans, or lies in shadow
    seen[3, 1] = np.nan
    found = shaded_pixels(seen, number, np.array([True, False]), np.stack([ASPHALT, RED]), LIGHT)
    assert np.argwhere(found).tolist() == [[1, 1]]
    dark = np.zeros((40, 60), bool)
    dark[10:20, 10:30] = True  # a car's shadow
    shaded = np.zeros_like(dark)
    shaded[20:22, 12:28] = True  # its fading edge
    shaded[5:35, 50] = True  # a post's
    shaded[30, 5] = shaded[33, 20] = True  # grains of asphalt
    shaded[25:30, 35:40] = True  # a stain
    found = of_shadows(shaded, dark)
    assert found[20:22, 12:28].all()
    assert found[5:35, 50].all()
    assert found.sum() == 32 + 30
    assert not of_shadows(dark, np.zeros_like(dark))[~dark].any()


def test_no_material_is_mixed_where_parts_of_one_car_meet() -> None:
    number = np.repeat(np.arange(3), 6)[None].repeat(9, axis=0).astype(np.int32)
    sure = np.ones(number.shape, bool)
    sure[4, 6] = False
    segments = Segments(number, sure, np.bincount(number.ravel()).astype(np.int64))
    body = np.arange(3, dtype=np.int32)
    distance = edge_distance(segments, body, np.array([0, 0, 2], np.int32))
    assert distance.dtype == np.uint8
    assert (distance[0].tolist()[:12], distance[4, 6]) == ([12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1], 0)
    assert edge_distance(segments, body, body)[0, 5:7].tolist() == [1, 1]
    chosen = np.zeros((4, 7), bool)
    assert (distance_to(chosen) == 255).all()
    chosen[2, 1] = True
    assert distance_to(chosen)[2].tolist() == [1, 0, 1, 2, 3, 4, 5]


LOW_SUN = 65.0
BANDS = xr.Dataset(coords={"wavelength": ("band", NM)})


@functools.cache
def low_light() -> Light:
    # Under a low sun most of the sky's light is around it, and the zenith is much bluer than the mean
    return Light.under(diffuse_fraction(NM, LOW_SUN), *split_of(BANDS, "model", LOW_SUN).mirrored())


def test_under_a_low_sun_shade_is_as_blue_as_the_zenith() -> None:
    light = low_light()
    seen = 0.3 * ASPHALT * light.diffuse + 0.7 * ASPHALT * light.above
    amount, misfit = solve(seen[None], ASPHALT[None], None, light)
    assert misfit[0] < 1e-3
    assert amount[0, 0] == 0.0
    assert amount[0, 1] == pytest.approx(0.3 + 0.7 * light.above.sum() / light.diffuse.sum(), rel=1e-4)
    assert solve(seen[None], ASPHALT[None], None, light._replace(above=light.diffuse))[1][0] > 0.03


@pytest.mark.parametrize(("is_coat", "shaded"), [(False, [1, 2]), (True, [1])])
def test_black_paint_in_the_sun_that_mirrors_the_sky_is_no_shadow(is_coat: bool, shaded: list[int]) -> None:
    number = np.zeros((60, 60), int)
    number[20:40, 10:50] = 1
    number[24:36, 14:30] = 2
    body = np.linspace(0.0065, 0.008, NM.size)
    light = low_light()
    coat = body * (light.direct + light.diffuse) + 0.05 * light.above
    shade = ASPHALT * (0.02 * light.direct + 0.7 * light.diffuse)
    spectra = [ASPHALT, shade, coat if is_coat else 0.6 * shade]
    assert matched(number, spectra, light=light) == shaded


@pytest.mark.parametrize(("sky", "direct", "shaded"), [(0.6, 0.08, [1]), (0.9, 0.4, []), (0.2, 0.1, [])])
def test_the_side_of_a_bright_thing_without_sun_is_in_shadow(
    sky: float, direct: float, shaded: list[int]
) -> None:
    white = np.full(NM.size, 0.7)
    number = np.zeros((60, 60), int)
    number[20:30, 20:40] = 2
    number[30:36, 20:40] = 1  # away from the sun, between roof and ground
    light_of_side = np.stack([ASPHALT, (white * (direct * LIGHT.direct + sky * LIGHT.diffuse)), white])
    numbers = number.astype(np.int32)
    size = np.bincount(number.ravel()).astype(np.int64)
    matches, ground = match_shade(numbers, light_of_side, size, touching(numbers, 3), LIGHT, AWAY)
    assert np.flatnonzero(matches.state == SHADED).tolist() == shaded
    assert ground.tolist() == [True, False, False]


def test_a_shadow_beside_a_dark_car_tells_its_side_by_the_ground(recwarn: pytest.WarningsRecorder) -> None:
    number = np.zeros((80, 80), int)
    number[20:35, 20:60] = 2
    number[35:42, 20:60] = 1
    # on the ground much of the sky is hidden; of the car's paint, it would be nearly all of it
    assert matched(number, [ASPHALT, 0.4 * ASPHALT * LIGHT.diffuse, 0.5 * ASPHALT]) == [1]
    assert not recwarn.list


# --- Shadows of what is not in the picture: by spectrum and level; under no sun; and with a wrong heading


WAVELENGTHS = wavelengths(48)
GROUND = smooth_edge(WAVELENGTHS, 600.0, 0.07, 0.12, 150.0)
WHITE = smooth_edge(WAVELENGTHS, 430.0, 0.3, 0.75)
TRAPS = (
    (2, 2, smooth_edge(WAVELENGTHS, 520.0, 0.05, 0.012, 30.0)),  # dark blue paint
    (2, 30, np.full(WAVELENGTHS.size, 0.05)),  # grey ones
    (82, 20, np.full(WAVELENGTHS.size, 0.12)),
    (2, 60, 0.55 * GROUND),  # a stain
    (82, 90, smooth_edge(WAVELENGTHS, 480.0, 0.09, 0.02, 40.0)),  # blue paint, as bright as some shadows
)
Mask = npt.NDArray[np.bool_]


def target(
    zenith: float, sky: float, turn: float, grey: float, penumbra: float = 4.0, split: Any = None
) -> tuple[Any, Any]:
    # Return a flat grey target on asphalt, half of it in the shade of something unseen; its blocked beam
    diffuse = diffuse_fraction(WAVELENGTHS, zenith) if split is None else split
    y, x = np.mgrid[:96, :128]
    on = (y > 18) & (y < 78) & (x > 24) & (x < 104)
    along = (y - 48) * np.cos(np.radians(turn)) + (x - 64) * np.sin(np.radians(turn))
    blocked = np.clip(along / penumbra + 0.5, 0.0, 1.0) * on
    # what casts it hides more of the sky farther in
    seen = np.where(on, 1.0 - (1.0 - sky) * np.clip(along / 8.0 + 0.5, 0.0, 1.0), 1.0)
    texture = 1.0 + 0.02 * np.random.default_rng(4).normal(size=y.shape)
    body = np.where(on[..., None], grey, GROUND * texture[..., None])
    cube = body * ((1.0 - blocked)[..., None] * (1.0 - diffuse) + seen[..., None] * diffuse)
    for top, left, paint in TRAPS:
        cube[top : top + 13, left : left + 20] = paint
    return cube, blocked


def shadows(cube: Any, **options: Any) -> Mask:
    bits = hp.surroundings.flag(as_line(cube, WAVELENGTHS, snr=100.0, seed=1), **options).quality.values
    return np.asarray((bits & int(Quality.SHADOW)) > 0)


@pytest.mark.parametrize(
    ("zenith", "sky", "turn", "grey"),
    [(40.0, 0.9, 25.0, 0.3), (30.0, 0.6, 90.0, 0.5), (60.0, 1.0, 0.0, 0.12), (40.0, 0.5, 135.0, 0.4)],
)
def test_a_target_half_in_the_shade_of_nothing_in_the_picture(
    zenith: float, sky: float, turn: float, grey: float
) -> None:
    cube, blocked = target(zenith, sky, turn, grey)
    found, true = shadows(cube, sun_zenith=zenith), blocked >= 0.2
    assert (found & true).sum() >= 0.9 * true.sum() > 1500
    assert (found & true).sum() >= 0.95 * found.sum()


@pytest.mark.parametrize("turn", [25.0, 205.0])
def test_the_same_whatever_the_heading_says(turn: float) -> None:
    cube, blocked = target(40.0, 0.9, turn, 0.3)
    found, true = shadows(cube, sun_zenith=40.0, sun_azimuth=180.0, heading=0.0), blocked >= 0.2
    assert (found & true).sum() >= 0.9 * true.sum()


def test_dark_things_without_a_shadow_are_none() -> None:
    cube, _ = target(40.0, 1.0, 25.0, 0.3, penumbra=1e-3)
    cube[19:78, 25:104] = 0.3
    assert not shadows(cube, sun_zenith=40.0).any()


def test_without_a_sun_nothing_is_in_shadow_nor_in_glint() -> None:
    cube, _ = target(40.0, 1.0, 25.0, 0.3, split=np.ones(WAVELENGTHS.size))
    cube[30:40, 40:50] *= 0.3  # under an overcast sky darker things are only that
    cube[50:52, 60:62] += 3.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flagged = hp.surroundings.flag(
            as_line(cube, WAVELENGTHS, snr=100.0), diffuse=np.ones(WAVELENGTHS.size)
        ).compute()
    assert not (flagged.quality.values & int(Quality.SHADOW | Quality.GLINT)).any()
    assert np.isfinite(flagged.blocked_direct.values).all()


def test_a_heading_the_wrong_way_round_is_said_and_the_picture_believed() -> None:
    cube, blocked, _ = box_shadow(WAVELENGTHS, GROUND, WHITE)
    line = as_line(cube, WAVELENGTHS, snr=100.0, seed=100)
    right = hp.surroundings.flag(line, sun_zenith=40.0, sun_azimuth=180.0, heading=0.0).quality.values
    with pytest.warns(PaintWarning, match="shadow-side"):
        turned = hp.surroundings.survey(line, sun_zenith=40.0, sun_azimuth=180.0, heading=180.0)
    found = (hp.surroundings.flag(line, turned).quality.values & int(Quality.SHADOW)) > 0
    assert (found == ((right & int(Quality.SHADOW)) > 0)).mean() > 0.999
    assert (found & (blocked >= 0.2)).sum() >= 0.99 * (blocked >= 0.2).sum()


def test_a_black_roof_beside_a_kerb_is_no_shadow_of_it() -> None:
    # its coat mirrors the sky: together like a bright kerb under little of the sun and a quarter of the sky
    diffuse = diffuse_fraction(WAVELENGTHS, 40.0)
    cube = GROUND * np.random.default_rng(4).normal(1.0, 0.02, (96, 128, 1))
    cube[:, 110:114] = 0.36
    # and not smooth: light in bands of gases differs by 2 %
    cube[36:50, 40:72] = (0.013 + 0.085 * diffuse) * (1.0 + 0.02 * np.sin(WAVELENGTHS / 30.0))
    cube[50:60, 40:72] = GROUND * (0.02 * (1.0 - diffuse) + 0.7 * diffuse)  # shadow of the car
    cube[60:70, 110:114] = 0.36 * 0.6 * diffuse  # another one, on the kerb
    found = shadows(cube, sun_zenith=40.0)
    assert not found[38:48, 43:69].any()
    assert found[52:58, 43:69].mean() > 0.9
    assert found[61:69, 111:113].all()
