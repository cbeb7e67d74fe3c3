"""A paint library with everything that a library may hold, and hard names."""

import numpy as np
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.schema import LIBRARY_VARIABLES, quality_attrs

NAMES = ["red, matt", "Grün", "Grün (2)", 'a/b "x" | c {d}', ""]


def make_library(members: int = 4, bands: int = 7, seed: int = 1) -> xr.Dataset:
    # Return five paints with members, quantiles, times, flags; wavelengths fall once; some are NaN
    rng = np.random.default_rng(seed)
    paints = len(NAMES)

    def spectra(*shape: int) -> np.ndarray:
        return rng.random((*shape, bands), np.float32)

    wavelength = np.linspace(400.0, 1000.0, bands)
    wavelength[3] -= 150.5  # where two detectors overlap
    values = {
        "reflectance": spectra(paints),
        "reflectance_sd": spectra(paints),
        "reflectance_quantiles": spectra(paints, 2),
        "member_reflectance": spectra(paints, members),
        "member_along_track": rng.integers(0, 999, (paints, members)),
        "n": np.arange(paints),
        "n_eff": np.array([1.5, np.nan, 2.25, 3.0, 1e-7]),
        "quality": np.arange(paints, dtype=np.uint16),
        "signature": np.array(NAMES, object),
        "time": np.array(["2024-05-21T11:33:07.123456789", "NaT", *["2024-01-01"] * 3], "datetime64[ns]"),
        "quantile": np.array([0.05, 0.95]),
        "wavelength": wavelength,
        "fwhm": np.full(bands, 5.5),
        "good": np.ones(bands, bool),
    }
    made = xr.Dataset()
    for name, array in values.items():
        row = LIBRARY_VARIABLES[name]
        attrs = quality_attrs() if name == "quality" else row.attrs
        made[name] = xr.DataArray(array, dims=row.dims, attrs=attrs)
    made = made.set_coords([name for name in values if LIBRARY_VARIABLES[name].coordinate])
    made = made.assign_coords(
        make=("signature", np.array(["VW", "", "Škoda", "a\nb", "ß"], object)),
        year=("signature", [2001, 2, 3, 4, 5]),
    )
    made["member_reflectance"][1, 2:] = np.nan
    made["member_reflectance"][3] = np.nan
    made["reflectance"][0, 2] = np.nan
    made["reflectance"].attrs["mirror_reflection"] = "excluded"
    made.attrs = {"title": "Paint signatures", "flightlines": ["raw_0", "raw_1"], "n": 3, "share": 0.1}
    return made


def declared_library(bands: int = 24) -> xr.Dataset:
    # Return three paints that say all that the specification of a library asks for
    rng = np.random.default_rng(3)
    spectra = rng.uniform(0.1, 0.6, (3, bands)).astype(np.float32)
    one = {"units": "1"}
    paints = xr.Dataset(
        {
            "reflectance": (("signature", "band"), spectra, one),
            "reflectance_sd": (("signature", "band"), 0.02 * spectra, one),
            "reflectance_u_random": (("signature", "band"), 0.01 * spectra, one),
            "reflectance_quantiles": (
                ("signature", "quantile", "band"), np.stack([0.9 * spectra, spectra, 1.1 * spectra], 1), one,
            ),
            "member_reflectance": (("signature", "member", "band"), np.stack([spectra, spectra], 1), one),
            "n": ("signature", np.array([50, 60, 70]), one),
            "n_eff": ("signature", np.array([5.0, 6.0, 7.0]), one),
            "sun_zenith": ("signature", np.array([30.0, 31.0, 32.0]), {"units": "degree"}),
            "diffuse_fraction": (("signature", "band"), np.full_like(spectra, 0.2), one),
        },
        coords={
            "signature": ["red", "blue", "black"],
            "wavelength": ("band", np.linspace(400.0, 1000.0, bands), {"units": "nm"}),
            "fwhm": ("band", np.full(bands, 6.0), {"units": "nm"}),
            "good": ("band", np.ones(bands, bool)),
            "quantile": [0.05, 0.5, 0.95],
            "finish": ("signature", ["solid", "metallic", "unknown"]),
            "time": ("signature", np.array(["2021-07-20T17:00"] * 3, "datetime64[ns]")),
        },
    )  # fmt: skip
    return hp.io.declare_library(
        paints, quantity="HCRF", specular_component="included", provenance="measured", licence="CC-BY-4.0",
        title="Three paints", measurement_geometry="sun and view of each paint",
    )  # fmt: skip
