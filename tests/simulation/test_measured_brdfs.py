"""Measured BRDFs against formulas that wrote them, and against Mitsuba's plugin ``measured``."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.refusals import refusal
from support.tensor_files import gridded_brdf, rough_brdf, write_tensors

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError

NM = np.array([400.0, 555.0, 640.0, 900.0])
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
