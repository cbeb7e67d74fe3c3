"""Lines of reflectance and of counts with regions on them, and what equal libraries are."""

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint import Quality, Region, Regions
from hyperpaint.base.schema import CUBE
from hyperpaint.simulation import simulate_line

TWO = Regions(
    (
        Region("hood", [(1, 2), (8, 2), (8, 12), (3, 17), (1, 12)], (), "", {"colour": "red", "year": 2019}),
        Region("roof", [(6, 10), (13, 14), (9, 22)], ([(9, 15), (10, 15), (10, 16)],), "", {"make": "x"}),
    )
)  # fmt: skip
CHUNKINGS: tuple[Any, ...] = (
    None,
    {"along_track": 1},
    {"along_track": 7},
    {"along_track": (3, 20, 1, 16), "band": 5},
    {"along_track": 16, "cross_track": 4},
    {"along_track": -1, "band": 1},
)
SPECTRA = ("reflectance", "reflectance_sd", "reflectance_quantiles", "member_reflectance")


def made(lines: int = 40, bands: int = 12, columns: int = 16, seed: int = 0) -> xr.Dataset:
    # Return a line of reflectance with outliers, missing samples and flags
    rng = np.random.default_rng(seed)
    base = 0.3 + 0.1 * np.sin(np.arange(bands) / 3)
    values = base[:, None] * (1 + 0.05 * rng.standard_normal((lines, 1, columns)))
    values = values + 0.004 * rng.standard_normal((lines, bands, columns))
    values = (values + 0.4 * (rng.random((lines, 1, columns)) < 0.05)).astype("f4")
    values[rng.random(values.shape) < 0.01] = np.nan
    values[:, 5, 7] = np.nan
    quality = np.where(rng.random((lines, columns)) < 0.1, int(Quality.GLINT), 0)
    quality |= np.where(rng.random((lines, columns)) < 0.2, int(Quality.LOW_SUN), 0)
    return xr.Dataset(
        {
            "reflectance": (CUBE, values, {"units": "1"}),
            "quality": (("along_track", "cross_track"), quality.astype("u2")),
        },
        {"wavelength": ("band", np.linspace(400.0, 900.0, bands), {"units": "nm"})},
        {"name": "raw_0"},
    )


def assert_same_bits(first: xr.Dataset, second: xr.Dataset) -> None:
    assert set(first.variables) == set(second.variables)
    for name in first.variables:
        a, b = first[name].values, second[name].values
        assert a.dtype == b.dtype, name
        assert a.tolist() == b.tolist() if a.dtype == object else a.tobytes() == b.tobytes(), name


RAW = Regions((Region("a", [(0, 0), (20, 0), (20, 39), (0, 30)]), Region("b", [(4, 20), (9, 20), (9, 38)])))


def raw(**more: Any) -> xr.Dataset:
    # Return a line of counts with smile, noise that is known, and errors of the gain that are
    line = simulate_line(lines=40, bands=24, columns=24, smile_nm=1.5, seed=3, **more)
    gain_u = {"radiance_gain_u_systematic": ((), np.float32(0.04), {"units": "1"})}
    return line.drop_vars([name for name in line if str(name).startswith("true_")]).assign(gain_u)
