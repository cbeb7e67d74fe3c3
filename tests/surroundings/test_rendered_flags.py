"""Flags on a ray-traced car park, whose renderer knows nothing of them: what is reached so far."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import KINDS, Coat
from hyperpaint.simulation.rendering.platforms import pushbroom

pytestmark = pytest.mark.slow

ZENITH, AZIMUTH = 34.07, 94.19


#: Coats, samples a pixel, and pixels of coloured paint with glint that each has at least: a fresh one mirrors
#: the sun sharply.
COATS = {"worn": (Coat(roughness=0.05, waviness=0.0), 48, 1000), "fresh": (Coat(), 96, 25)}


def skies() -> dict[str, Atmosphere]:
    # Return a clear sky as it is, and with its light spread evenly
    # Around the sun a real sky is bright: what coats mirror of it there looks like glint
    clear = Atmosphere.clear(ZENITH, AZIMUTH)
    even = replace(clear, clear_shares=None)
    return {"uniform": even, "directional": clear}


@pytest.fixture(scope="module", params=COATS)
def traced(request: pytest.FixtureRequest) -> tuple[xr.Dataset, int]:
    # Return solid paints on seed 103: no threshold was tuned on it, though faults seen on it were mended
    coat, samples, glinting_px = COATS[request.param]
    park = car_park(
        length=11.7, width=16.0, seed=103, neighbours=("walls",), margin=10.0, flakes=False, coat=coat
    )
    flight = pushbroom(176, 192, altitude=15.0, ground_sample=0.035, line_spacing=0.035, start=(-4.0, 2.0))
    return hp.simulation.trace(
        park, flight, [*skies().values()], samples=samples, seed=103, sun_radius=0.267
    ).compute(), glinting_px


@pytest.mark.parametrize("sky", ["uniform", "directional"])
def test_shadows_on_the_ground_and_glint_on_coloured_paint(traced: tuple[xr.Dataset, int], sky: str) -> None:
    rays, glinting_px = traced
    scene = hp.simulation.relight(rays, atmosphere=skies()[sky]).compute()
    flagged = hp.surroundings.flag(scene, sun_zenith=ZENITH, sun_azimuth=AZIMUTH, heading=0.0).compute()
    bits = flagged.quality.values
    counted = (bits & int(Quality.MIXED_EDGE)) == 0
    kind = np.array(KINDS)[scene.surface_class.values]
    ground = counted & np.isin(kind, ["asphalt", "concrete", "line", "grass", "panel"])
    found, true = (bits & int(Quality.SHADOW)) > 0, scene.shadow.values >= 0.2
    assert (found & true & ground).sum() >= 0.99 * (found & ground).sum()
    # the split is that of a clear sky, which is never even
    assert (found & true & ground).sum() >= (0.8 if sky == "directional" else 0.78) * (true & ground).sum()
    # shade on asphalt beside concrete in the sun is known as asphalt: the border is an edge, and not counted
    assert (true & ground).sum() > 350
    level = scene.reflectance.values
    paint = counted & (kind == "paint") & ((np.ptp(level[:, 20:], axis=1) / level.mean(axis=1)) > 0.5)
    share = scene.glint_share.values * scene.radiance.mean("band").values
    direct = 1.0 - diffuse_fraction(scene.wavelength.values, ZENITH)
    white = np.nanmedian(np.pi * scene.radiance.values / level, axis=(0, 2)) / np.pi
    glint = share / (direct * white).mean()
    # what matters: over 4 % of the paint's own level; of what adds half as much again, little is missed
    mirrored = scene.glint_share.values / (1.0 - scene.glint_share.values)
    found, true, clear = (bits & int(Quality.GLINT)) > 0, mirrored > 0.04, (mirrored > 0.06) & (glint > 0.02)
    assert (found & true & paint).sum() >= 0.95 * (found & paint).sum()
    assert (found & clear & paint).sum() >= 0.9 * (clear & paint).sum()
    assert (clear & paint).sum() > glinting_px
