"""Shadows of what is not in the picture: by spectrum and level; under no sun; and with a wrong heading."""

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from support.analytic_scenes import as_line, box_shadow, smooth_edge, wavelengths

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import diffuse_fraction

NM = wavelengths(48)
ASPHALT = smooth_edge(NM, 600.0, 0.07, 0.12, 150.0)
WHITE = smooth_edge(NM, 430.0, 0.3, 0.75)
TRAPS = (
    (2, 2, smooth_edge(NM, 520.0, 0.05, 0.012, 30.0)),  # dark blue paint
    (2, 30, np.full(NM.size, 0.05)),  # grey ones
    (82, 20, np.full(NM.size, 0.12)),
    (2, 60, 0.55 * ASPHALT),  # a stain
    (82, 90, smooth_edge(NM, 480.0, 0.09, 0.02, 40.0)),  # blue paint, as bright as some shadows
)
Mask = npt.NDArray[np.bool_]


def target(
    zenith: float, sky: float, turn: float, grey: float, penumbra: float = 4.0, split: Any = None
) -> tuple[Any, Any]:
    # Return a flat grey target on asphalt, half of it in the shade of something unseen; its blocked beam
    diffuse = diffuse_fraction(NM, zenith) if split is None else split
    y, x = np.mgrid[:96, :128]
    on = (y > 18) & (y < 78) & (x > 24) & (x < 104)
    along = (y - 48) * np.cos(np.radians(turn)) + (x - 64) * np.sin(np.radians(turn))
    blocked = np.clip(along / penumbra + 0.5, 0.0, 1.0) * on
    # what casts it hides more of the sky farther in
    seen = np.where(on, 1.0 - (1.0 - sky) * np.clip(along / 8.0 + 0.5, 0.0, 1.0), 1.0)
    texture = 1.0 + 0.02 * np.random.default_rng(4).normal(size=y.shape)
    body = np.where(on[..., None], grey, ASPHALT * texture[..., None])
    cube = body * ((1.0 - blocked)[..., None] * (1.0 - diffuse) + seen[..., None] * diffuse)
    for top, left, paint in TRAPS:
        cube[top : top + 13, left : left + 20] = paint
    return cube, blocked


def shadows(cube: Any, **options: Any) -> Mask:
    bits = hp.surroundings.flag(as_line(cube, NM, snr=100.0, seed=1), **options).quality.values
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
    cube, _ = target(40.0, 1.0, 25.0, 0.3, split=np.ones(NM.size))
    cube[30:40, 40:50] *= 0.3  # under an overcast sky darker things are only that
    cube[50:52, 60:62] += 3.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flagged = hp.surroundings.flag(as_line(cube, NM, snr=100.0), diffuse=np.ones(NM.size)).compute()
    assert not (flagged.quality.values & int(Quality.SHADOW | Quality.GLINT)).any()
    assert np.isfinite(flagged.blocked_direct.values).all()


def test_a_heading_the_wrong_way_round_is_said_and_the_picture_believed() -> None:
    cube, blocked, _ = box_shadow(NM, ASPHALT, WHITE)
    line = as_line(cube, NM, snr=100.0, seed=100)
    right = hp.surroundings.flag(line, sun_zenith=40.0, sun_azimuth=180.0, heading=0.0).quality.values
    with pytest.warns(PaintWarning, match="shadow-side"):
        turned = hp.surroundings.survey(line, sun_zenith=40.0, sun_azimuth=180.0, heading=180.0)
    found = (hp.surroundings.flag(line, turned).quality.values & int(Quality.SHADOW)) > 0
    assert (found == ((right & int(Quality.SHADOW)) > 0)).mean() > 0.999
    assert (found & (blocked >= 0.2)).sum() >= 0.99 * (blocked >= 0.2).sum()


def test_a_black_roof_beside_a_kerb_is_no_shadow_of_it() -> None:
    # its coat mirrors the sky: together like a bright kerb under little of the sun and a quarter of the sky
    diffuse = diffuse_fraction(NM, 40.0)
    cube = ASPHALT * np.random.default_rng(4).normal(1.0, 0.02, (96, 128, 1))
    cube[:, 110:114] = 0.36
    # and not smooth: light in bands of gases differs by 2 %
    cube[36:50, 40:72] = (0.013 + 0.085 * diffuse) * (1.0 + 0.02 * np.sin(NM / 30.0))
    cube[50:60, 40:72] = ASPHALT * (0.02 * (1.0 - diffuse) + 0.7 * diffuse)  # shadow of the car
    cube[60:70, 110:114] = 0.36 * 0.6 * diffuse  # another one, on the kerb
    found = shadows(cube, sun_zenith=40.0)
    assert not found[38:48, 43:69].any()
    assert found[52:58, 43:69].mean() > 0.9
    assert found[61:69, 111:113].all()
