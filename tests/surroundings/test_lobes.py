"""Mirror images of the sun as spots: told from flakes' broad lobe, from stains of light and from edges."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from support.analytic_scenes import as_line, smooth_edge, wavelengths

import hyperpaint as hp
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import diffuse_fraction

NM = wavelengths(48)
ZENITH = 35.0
DIRECT = 1.0 - diffuse_fraction(NM, ZENITH)
ASPHALT = smooth_edge(NM, 600.0, 0.07, 0.12, 150.0)
SILVER = smooth_edge(NM, 500.0, 0.28, 0.32, 200.0)
RED = smooth_edge(NM, 600.0, 0.04, 0.6)
SPOT = (40, 52)
Mask = npt.NDArray[np.bool_]


def panel(paint: Any, flakes: float, peak: float, width: float = 0.8) -> tuple[Any, Mask]:
    # Return a panel on asphalt with a broad lobe of flakes and a spot of the sun, and where that matters
    y, x = np.mgrid[:80, :104]
    far = (y - SPOT[0]) ** 2 + (x - SPOT[1]) ** 2
    inside = (y > 10) & (y < 70) & (x > 12) & (x < 92)
    broad = flakes * np.exp(-far / (2.0 * 14.0**2))
    spot = np.where(inside, peak * np.exp(-far / (2.0 * width**2)), 0.0)
    cube = np.where(inside[..., None], paint + broad[..., None] * DIRECT, ASPHALT) + spot[..., None] * DIRECT
    return cube, spot * DIRECT.mean() > 0.04 * (cube.mean(axis=2) - spot * DIRECT.mean())


def flagged(cube: Any, **variables: Any) -> Mask:
    line = as_line(cube, NM, snr=100.0, seed=7)
    if variables:
        line = line.assign({name: (("along_track", "cross_track"), bits) for name, bits in variables.items()})
    bits = hp.surroundings.flag(line, sun_zenith=ZENITH).quality.values
    return np.asarray((bits & int(Quality.GLINT)) > 0)


@pytest.mark.parametrize(("paint", "flakes"), [(SILVER, 0.5), (SILVER, 0.0), (RED, 0.0), (0.1 * SILVER, 0.1)])
def test_the_spot_is_glint_and_the_flakes_around_it_are_not(paint: Any, flakes: float) -> None:
    cube, true = panel(paint, flakes, 20.0)
    found = flagged(cube)
    assert (found & true).sum() >= 0.7 * true.sum() > 5
    assert (found & ~true).sum() <= 0.1 * found.sum()


@pytest.mark.parametrize(("across", "along"), [(0.8, 8.0), (4.0, 7.0)], ids=["a streak", "a wide lobe"])
def test_a_streak_and_a_wide_lobe__are_glint_to_their_ends(across: float, along: float) -> None:
    """Rationale: body parts that curve one way only stretch the mirrored sun; rough coats widen it."""
    cube, _ = panel(SILVER, 0.0, 0.0)
    y, x = np.mgrid[:80, :104]
    far = ((y - SPOT[0]) / across) ** 2 + ((x - SPOT[1]) / along) ** 2
    spot = 12.0 * np.exp(-far / 2.0)
    found, true = flagged(cube + spot[..., None] * DIRECT), spot * DIRECT.mean() > 0.04 * SILVER.mean()
    assert (found & true).sum() >= 0.6 * true.sum() > 50
    assert (found & ~true).sum() <= 0.05 * found.sum()


def test_flakes_and_red_spots_are_no_glint() -> None:
    cube, _ = panel(SILVER, 0.6, 0.0)
    assert not flagged(cube).any()
    cube, _ = panel(SILVER, 0.0, 0.0)
    cube[39:42, 51:54] += 2.0 * RED  # a lamp's glass
    assert not flagged(cube).any()


def test_saturated_pixels_and_models_of_before() -> None:
    cube, true = panel(SILVER, 0.3, 60.0, 1.0)
    bits = np.zeros(true.shape, np.uint16)
    saturated = cube.max(axis=2) > 2.0
    assert saturated.sum() > 5
    cube[saturated] = np.nan
    bits[saturated] = int(Quality.SATURATED)
    found = flagged(cube, quality=bits)
    assert found[saturated].all()
    assert (found & true).sum() >= 0.7 * true.sum()
    # a white car that is saturated all over is none
    cube, _ = panel(SILVER, 0.0, 0.0)
    cube[20:60, 20:80] = np.nan
    bits[:] = 0
    bits[20:60, 20:80] = int(Quality.SATURATED)
    assert not flagged(cube, quality=bits).any()
    cube, _ = panel(RED, 0.0, 20.0)
    line = as_line(cube, NM, snr=100.0)
    model = hp.surroundings.survey(line, sun_zenith=ZENITH)
    before = hp.surroundings.SceneModel.from_dataset(model.to_dataset().drop_vars("lobe"))
    assert (before.lobe == 1).all()
    now, then = (hp.surroundings.flag(line, each).quality.values & 64 for each in (model, before))
    assert (then[now > 0] > 0).all()
