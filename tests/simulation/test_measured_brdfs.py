"""Measured BRDFs against formulas that wrote them, and against Mitsuba's plugin ``measured``."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import refusal
from support.tensor_files import gridded_brdf, rough_brdf, write_tensors
from support.traced_scenes import FEW_BANDS, flat_light

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.rendering.materials import (
    Coat,
    Flakes,
    Material,
    fresnel_reflectance,
    reflectance_factor,
)
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane

NM = np.array([400.0, 555.0, 640.0, 950.0])
MATERIALS = {
    "isotropic": {},
    "without division": {"jacobian": 0},
    "all azimuths": {"azimuths": 9},
    "half of the azimuths": {"azimuths": 9, "span": 1.0},
    "quarter of the azimuths": {"azimuths": 5, "span": 0.5},
}
WORKER = """
import sys
import mitsuba as mi, numpy as np
mi.set_variant("scalar_spectral")
request = np.load("request.npz")
surface, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
surface.wavelengths = request["nm"]
values = {}
for name in request["names"]:
    brdf = mi.load_dict({"type": "measured", "filename": f"{name}.bsdf"})
    rows = []
    for light, view in zip(request["light"], request["view"]):
        surface.wi = mi.Vector3f(*light)
        rows.append(np.array(brdf.eval(context, surface, mi.Vector3f(*view))) / view[2])
    values[str(name)] = np.array(rows)
np.savez("values.npz", **values)
"""


def vectors(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    # Return unit vectors (direction, 3)
    a, b = np.radians(zenith), np.radians(azimuth)
    return np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], axis=-1)


@pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed (extra oracles)"
)
def test_values_are_those_of_mitsuba(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    light, view = rng.uniform(0.0, 88.0, (2, 200))
    light_azimuth, azimuth = rng.uniform(-180.0, 180.0, (2, 200))
    for name, options in MATERIALS.items():
        write_tensors(tmp_path / f"{name}.bsdf", rough_brdf(**options))  # type: ignore[arg-type]
    directions = vectors(light, light_azimuth), vectors(view, light_azimuth + azimuth)
    np.savez(tmp_path / "request.npz", names=list(MATERIALS), nm=NM, light=directions[0], view=directions[1])
    subprocess.run([sys.executable, "-c", WORKER], cwd=tmp_path, check=True, timeout=300)
    expected = np.load(tmp_path / "values.npz")
    for name in MATERIALS:
        brdf = hp.io.read_rgl(tmp_path / f"{name}.bsdf")
        values = hp.simulation.measured_brdf(brdf, light, view, azimuth, light_azimuth=light_azimuth)
        assert values.attrs["units"] == "sr-1"
        np.testing.assert_allclose(values.interp(wavelength=NM), expected[name], rtol=2e-5, err_msg=name)


def lobe(light: np.ndarray, views: np.ndarray) -> np.ndarray:
    # Return a diffuse BRDF with a Gaussian lobe of half vectors, at four wavelengths
    half = (light + views) / np.linalg.norm(light + views, axis=-1, keepdims=True)
    tilt = np.arccos(half[..., 2])
    return np.asarray((0.1 + 0.3 * np.exp(-((tilt / 0.35) ** 2)))[..., None] * NM / 500.0)


def test_values_are_those_of_the_formula(tmp_path: Path) -> None:
    brdf = hp.io.read_rgl(write_tensors(tmp_path / "lobe.bsdf", gridded_brdf(lobe, NM)))
    light, view = np.array([0.0, 20.0, 45.0, 45.0, 70.0]), np.array([10.0, 30.0, 15.0, 60.0, 5.0])
    azimuth = np.array([0.0, 180.0, 90.0, 180.0, 45.0])
    values = hp.simulation.measured_brdf(brdf, light, view, azimuth, light_azimuth=77.0)
    pairs = zip(vectors(light, 0 * light), vectors(view, azimuth), strict=True)
    np.testing.assert_allclose(values, [lobe(*pair) for pair in pairs], rtol=0.01)


def test_wrong_arguments_are_refused(tmp_path: Path) -> None:
    brdf = hp.io.read_rgl(write_tensors(tmp_path / "rough.bsdf", rough_brdf()))
    for view in (90.0, -1.0, np.nan):
        with refusal(SchemaError, "value-out-of-range"):
            hp.simulation.measured_brdf(brdf, 0.0, view)
    with refusal(SchemaError, "variable-missing", "sigma"):
        hp.simulation.measured_brdf(brdf.drop_vars("sigma"), 0.0, 0.0)


PAINT = Material("silver", "body", "paint", Coat(), Flakes(0.35, 0.18, "metal"))
BODY = np.array([0.08, 0.25, 0.45, 0.5])
METAL = np.array([0.85, 0.84, 0.82, 0.76])


def flake_paint(light: np.ndarray, views: np.ndarray) -> np.ndarray:
    # Return the BRDF of a paint of the renderer, outside the mirror reflection of its coat
    zenith = np.degrees(np.arccos(views[..., 2].clip(0.02, 1.0)))
    azimuth = np.degrees(np.arctan2(views[..., 1], views[..., 0]))
    lit = float(np.degrees(np.arccos(light[2])))
    values = [
        reflectance_factor(PAINT, BODY, METAL, light=lit, view=view, azimuth=turn)
        for view, turn in zip(zenith.ravel(), azimuth.ravel(), strict=True)
    ]
    return np.asarray(np.reshape(values, (*zenith.shape, NM.size)) / np.pi)


@pytest.fixture(scope="module")
def silver(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    path = tmp_path_factory.mktemp("rgl") / "silver.bsdf"
    return hp.io.read_rgl(write_tensors(path, gridded_brdf(flake_paint, NM, size=32)))


def test_a_paint_of_the_renderer_is_found_again(silver: xr.Dataset) -> None:
    material, spectra, residual = hp.simulation.fit_paint(silver, "silver")
    assert material.flakes is not None
    assert material.flakes.roughness == pytest.approx(0.18, rel=0.05)
    share = material.flakes.share
    np.testing.assert_allclose(share * spectra["silver:flakes"][1], 0.35 * METAL, rtol=0.03)
    np.testing.assert_allclose((1.0 - share) * spectra["silver"][1], 0.65 * BODY, rtol=0.05)
    assert float(np.sqrt((residual**2).mean())) < 0.02
    assert residual.aspecular.min() > 14.99
    assert residual.dims == ("direction", "wavelength")


def test_a_solid_paint_gets_next_to_no_flakes(tmp_path: Path) -> None:
    solid = np.array([0.06, 0.1, 0.4, 0.5]) / np.pi

    def brdf(light: np.ndarray, views: np.ndarray) -> np.ndarray:
        # a white base under glass, by Fresnel's equations of both directions
        crossed = [1.0 - fresnel_reflectance(cosine) for cosine in (light[2], views[..., 2])]
        return np.asarray((crossed[0] * crossed[1] / 0.96**2)[..., None] * solid)

    measured = hp.io.read_rgl(write_tensors(tmp_path / "red.bsdf", gridded_brdf(brdf, NM, size=32)))
    fit = hp.simulation.fit_paint(measured, "red")
    assert fit.material.flakes is None or fit.material.flakes.share < 0.02
    np.testing.assert_allclose(fit.spectra["red"][1], np.pi * solid, rtol=0.05)
    assert abs(fit.residual).max() < 0.03


def test_a_measured_paint_is_rendered(silver: xr.Dataset) -> None:
    # a level plane, seen from above, under a sun at 40 degrees without a sky
    fit = hp.simulation.fit_paint(silver, "silver")
    traced = hp.simulation.trace(
        plane(100.0, fit.material), pushbroom(2, 2, altitude=50.0), [(40.0, 180.0)], samples=4, sun_radius=0.0
    )
    line = hp.simulation.relight(
        traced, FEW_BANDS, spectra=fit.spectra, atmosphere=flat_light(sky=0.0, direction=(40.0, 180.0)),
        hold_edges=True,
    )  # fmt: skip
    expected = np.pi * hp.simulation.measured_brdf(silver, 40.0, 0.0).interp(wavelength=FEW_BANDS.wavelength)
    seen = line.reflectance.mean(("along_track", "cross_track"))
    np.testing.assert_allclose(seen, expected.isel(direction=0), rtol=0.03)


def test_a_brdf_without_light_is_not_fitted(silver: xr.Dataset) -> None:
    with refusal(SchemaError, "value-out-of-range"):
        hp.simulation.fit_paint(silver.assign(spectra=0.0 * silver.spectra), "black")
