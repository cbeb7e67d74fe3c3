"""Aspecular angles, and what changes from the dark to the bright end of a panel."""

import functools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.paints.signatures.extraction import aspecular_angle, flop_of, lean_range
from hyperpaint.regions import Region, Regions
from hyperpaint.simulation import simulate_line
from hyperpaint.simulation.rendering.materials import (
    Coat,
    Flakes,
    Material,
    flakes_of_flop,
    fresnel_reflectance,
    reflectance_factor,
)

_ZENITH = st.floats(0.0, 85.0)


@given(_ZENITH, _ZENITH, st.floats(0.0, 180.0))
def test_the_angle_is_that_between_vectors(sun: float, view: float, turn: float) -> None:
    def towards(zenith: float, azimuth: float) -> np.ndarray:
        a, b = np.radians([zenith, azimuth])
        return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])

    mirrored = towards(sun, 0.0) * (-1.0, -1.0, 1.0)
    # well-conditioned for small angles too
    seen = towards(view, turn)
    expected = np.degrees(np.arctan2(np.linalg.norm(np.cross(mirrored, seen)), mirrored @ seen))
    assert float(aspecular_angle(sun, view, turn)) == pytest.approx(expected, abs=2e-5)


NM = np.linspace(400.0, 1000.0, 40)
GOOD = (NM > 420.0) & (NM < 950.0)
BODY = 0.05 + 0.4 / (1.0 + np.exp(-(NM - 600.0) / 15.0))


def leaning_part(lobe: Flakes | None, metal: float, leans: np.ndarray, direct: np.ndarray) -> np.ndarray:
    # Return what pixels (pixel, band) of a panel send that lean towards the sun, seen from above
    material, sun = Material("m", "m", "paint", Coat(), lobe), 45.0
    seen = []
    for lean in leans:
        # of a panel that leans towards the sun, the vertical is on the side of the mirror direction
        angles = {"light": sun - lean, "view": abs(lean), "azimuth": 180.0 if lean > 0 else 0.0}
        factor = reflectance_factor(material, BODY, metal, **angles)
        turned = np.cos(np.radians(sun - lean)) / np.cos(np.radians(sun))
        seen.append(direct * turned * factor + (1.0 - direct) * BODY)
    return np.array(seen)


def test_solid_paint_changes_with_the_light_and_flakes_with_their_own_colour() -> None:
    direct = np.interp(NM, [400.0, 1000.0], [0.6, 0.9])
    leans = np.random.default_rng(3).permutation(np.linspace(-3.0, 3.0, 200))
    solid = flop_of(leaning_part(None, 0.0, leans, direct), GOOD)
    # the means of the outer fifths lean 2.4 degrees either way; the coat lets more light in the steeper it is
    away, towards = 1.0 - fresnel_reflectance(np.cos(np.radians([47.4, 42.6])), 1.5)
    expected = direct * (2 * np.tan(np.radians(2.4)) + (towards - away) / 0.95)
    np.testing.assert_allclose(solid[0], expected, rtol=0.01)
    lobe = flakes_of_flop(9.0, Material("m", "m", "paint", Coat(), Flakes(0.5)), NM, BODY, 0.85)
    flakes = flop_of(leaning_part(lobe, 0.85, leans, direct), GOOD)
    # flakes are neutral here, and weigh most where the pigment is dark
    assert flakes[1] > 1.5 * solid[1]
    assert flakes[0][NM < 550].mean() > 1.2 * flakes[0][NM > 700].mean()
    # a bound on the lean, which is close for solid paint and generous for flakes
    middle = float(direct[GOOD].mean())
    assert 4.8 < lean_range(solid[1], 45.0, middle) < 5.6
    assert lean_range(flakes[1], 45.0, middle) > 5.6


@functools.cache
def small_line() -> xr.Dataset:
    return simulate_line(lines=32, bands=40, columns=24, smile_nm=0.0)


def test_members_of_flakes_have_the_stated_angle_and_others_stay() -> None:
    def extracted(part: np.ndarray) -> xr.Dataset:
        # signatures of a body part of 32 lines x 24 columns (pixel, band), with noise of 1 %
        line = small_line()
        noise = 1.0 + 0.01 * np.random.default_rng(2).normal(size=part.shape)
        cube = (part * noise).reshape(32, 24, 40).transpose(0, 2, 1).astype(np.float32)
        line = line.paint.reflectance().compute()
        line["reflectance"] = line.reflectance.dims, cube, line.reflectance.attrs
        corners = [(0, 0), (0, 31), (23, 31), (23, 0)]
        return hp.extract_signatures(line, Regions((Region("bonnet", corners),)), exclude=0)

    nm = np.linspace(400.0, 1000.0, 40)
    body, leans = 0.2 + 0.1 * np.sin(nm / 90.0), np.linspace(-0.5, 0.5, 32 * 24)[:, None]
    lobe = extracted(body * np.exp(leans * (1.4 + 0.6 * np.cos(nm / 70.0))))
    ratio = lobe.member_reflectance.values[0] / lobe.reflectance.values[0]
    assert 0.85 < np.nanmin(ratio) < np.nanmax(ratio) < 1.15
    assert float(lobe.reflectance_quantiles.sel(quantile=0.95).max() / lobe.reflectance.max()) > 1.5
    # a region of several materials is no paint with flakes
    others = np.where(leans < 0.3, 0.5 + 0.3 * np.cos(nm / 60.0), 0.6 - 0.3 * np.cos(nm / 40.0))
    mixed = extracted(np.where(leans < 0.1, body, others))
    assert np.nanmax(mixed.member_reflectance.values[0] / mixed.reflectance.values[0]) > 1.5


def test_noise_and_few_pixels_make_no_flop() -> None:
    noisy = BODY * (1.0 + 0.01 * np.random.default_rng(1).normal(size=(256, NM.size)))
    flop = flop_of(noisy, GOOD)
    assert abs(flop[1]) < 0.006
    assert np.abs(flop[0]).max() < 0.012
    few = np.tile(BODY, (19, 1))
    assert np.isnan(flop_of(few, GOOD)[0]).all()
    padded = np.full((60, NM.size), np.nan)
    padded[:19] = few
    assert np.isnan(flop_of(padded, GOOD)[1])
    assert np.isnan(flop_of(np.tile(BODY, (60, 1)), np.zeros(NM.size, bool))[1])
    dead = np.tile(BODY, (60, 1))
    dead[:, 3] = np.nan  # a band without values among good ones leaves its pixels out, so it is not good
    flop = flop_of(dead, GOOD & np.isfinite(dead[0]))
    assert np.isnan(flop[0][3])
    assert flop[1] == 0.0
    assert np.isnan(lean_range(np.nan, 30.0, 0.8))


def test_a_library_says_its_geometry() -> None:
    line = small_line()
    corners = [(0, 0), (0, 31), (6, 31), (6, 0)]
    paints = hp.extract_signatures(
        line, Regions((Region("bonnet", corners, properties={"finish": "metallic"}),))
    )
    angles = [float(paints[name][0]) for name in ("sun_zenith", "view_zenith", "relative_azimuth")]
    assert float(paints.aspecular_angle[0]) == pytest.approx(float(aspecular_angle(*angles)))
    expected = flop_of(paints.member_reflectance.values[0], paints.good.values)
    np.testing.assert_allclose(paints.flop.values[0], expected[0], rtol=1e-6)
    assert 0.0 < float(paints.aspecular_range[0]) <= 30.0
    assert paints.finish.item() == "metallic"
    told = hp.extract_signatures(
        line, Regions((Region("bonnet", corners),)), sun_zenith=30.0, specular_sky=True
    )
    angles[0] = 30.0
    assert float(told.aspecular_angle[0]) == pytest.approx(float(aspecular_angle(*angles)))
    # the coat is not divided out of a metallic paint
    regions = [Region(name, corners, properties={"finish": name}) for name in ("solid", "metallic")]
    both = hp.extract_signatures(line, Regions(tuple(regions)), specular_sky=True, diffuse="model")
    assert (both.coat_transmission.values[0] < 0.999).all()
    np.testing.assert_array_equal(both.coat_transmission.values[1], 1.0)
    assert (both.reflectance.values[0] > both.reflectance.values[1]).all()
    alone = both.isel(signature=[1])
    reading = alone[["reflectance"]].assign(reflectance=alone.reflectance + np.float32(0.03))
    reading.reflectance.attrs = {
        "units": "1", "quantity": "reflectance factor of the outside of the coat",
        "specular_component": "included", "measurement_geometry": "d/8",
    }  # fmt: skip
    reading.attrs = {}
    for library in (both, alone):
        # the reading of a coat's outside is not brought to a body that the signature is not of
        with pytest.warns(PaintWarning, match="clear coat"):
            validation = hp.validate(library, reading, pairs={"metallic": "metallic"})
        assert float(validation.statistics.bias.sel(part="VIS").item()) == pytest.approx(-0.03, abs=1e-3)
