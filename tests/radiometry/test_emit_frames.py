"""Raw frames of EMIT through dark, pedestal, linearity, flat, bad elements and scattered light, step by step.

The order is that of emit-sds/emit-sds-l1b; plain numpy in double precision does every step.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp  # noqa: F401 (the accessor)

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.filterwarnings("ignore:.*counts-averaged"),
    pytest.mark.filterwarnings("ignore:.*elements-weak"),
]

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "emit_l1b"
SHAPE = (328, 1280)
LIT = (slice(None), slice(19, 307), slice(24, 1266))
ROWS, COLUMNS = np.r_[0:14, 315:328], np.r_[0:10, 1272:1280]
ELEMENT, CUBE = ("band", "cross_track"), ("along_track", "band", "cross_track")


def file_of(name: str) -> Path:
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"{path} is not here: frames of EMIT come with the project's shared data")
    return path


def frame(name: str, dtype: Any) -> np.ndarray:
    return np.fromfile(file_of(name), dtype).reshape(-1, *SHAPE).astype(np.float64)


@functools.cache
def steps() -> dict[str, np.ndarray]:
    # Return the frames after every step, by numpy alone
    raw, dark = (
        4 * frame("emit20220305t002601_subset_raw", "<i2"),
        frame("emit20220305t002444_subset_raw", "<i2"),
    )
    dark = 4 * dark.mean(axis=0)
    raw[:, 0], dark[0] = raw[:, 1], dark[1]  # telemetry
    net = raw - dark
    by_row = net - np.median(net[:, :, COLUMNS], axis=2)[:, :, None]
    level = by_row - np.median(by_row[:, ROWS], axis=1)[:, None]
    # the curves of this set are the identity; these are made up
    nodes = np.arange(65536.0)
    mean, basis = 1 + 2e-7 * nodes, np.stack([np.sin(nodes / 9000), (nodes / 65535) ** 2])
    weights = np.random.default_rng(0).normal(0, 0.01, (2, *SHAPE))
    factors = [np.interp(level, nodes, nodes * each) for each in (mean, *basis)]
    linear = factors[0] + weights[0] * factors[1] + weights[1] * factors[2]
    linear = np.where(level < 0, level * (1.0 + 2e-7 + weights[0] * np.sin(1 / 9000)), linear)
    flat = frame("EMIT_FlatField_20220504", "<f4")[0]
    bad = (frame("EMIT_BadElements_20220307", "<i2")[0] != 0) | ~(flat > 0)
    flat = np.where(bad, np.nan, flat)
    even = linear * flat
    filled = even.copy()
    masked = np.isin(np.arange(328), ROWS)[:, None] | np.isin(np.arange(1280), COLUMNS)
    for column in range(1280):
        good = np.flatnonzero(~bad[:, column] & ~masked[:, column])
        for band in np.flatnonzero(bad[:, column] & ~masked[:, column]):
            filled[:, band, column] = filled[:, good[np.argmin(np.abs(good - band))], column]
    filled[:, masked] = 0.0
    operator = np.fromfile(file_of("EMIT_SpectralScatter_20220406"), "<f4").reshape(328, 328).astype(float)
    scattered = np.where(bad, np.nan, operator @ filled)
    factor = np.loadtxt(file_of("EMIT_RadiometricCoeffs_20220504.txt"))[:, 1]
    factor = np.where(factor > 0, factor, 1.0)  # of rows that are not lit
    return {
        "raw": raw,
        "dark": dark,
        "nodes": nodes,
        "mean": mean,
        "basis": basis,
        "weights": weights,
        "bad": bad,
        "flat": flat,
        "operator": operator,
        "factor": factor,
        "masked": masked,
        "net": net,
        "level": level,
        "linear": linear,
        "even": even,
        "scattered": scattered,
        "radiance": scattered * factor[:, None],
    }


def line_of(until: str) -> xr.Dataset:
    # Return the frames as a flight line whose calibration declares the steps until one of them
    made, names = steps(), ["net", "level", "linear", "even", "scattered", "radiance"]
    done = names[: names.index(until) + 1]
    gain = np.ones(SHAPE)
    if "even" in done:
        gain = gain * made["flat"]
    if "radiance" in done:
        gain = gain * made["factor"][:, None] * 0.01  # uW cm-2 sr-1 nm-1 in W m-2 sr-1 nm-1
    variables: dict[str, Any] = {
        "counts": (CUBE, made["raw"].astype(np.float32), {"units": "count"}),
        "dark_counts": (ELEMENT, made["dark"].astype(np.float32), {"units": "count"}),
        "radiance_gain": (ELEMENT, gain, {"units": "W m-2 sr-1 nm-1 s count-1"}),
        "exposure_time": ((), 1.0, {"units": "s"}),
        "saturation_count": ((), 65535.0, {"units": "count"}),
    }
    attrs: dict[str, Any] = {}
    if "level" in done:
        variables["masked"] = (ELEMENT, made["masked"])
        attrs = {"pedestal": "band, column", "pedestal_statistic": "median"}
    if "linear" in done:
        nodes, term = made["nodes"], "linearity_term"
        variables["linearity_counts"] = ("linearity_counts", nodes, {"units": "count"})
        variables["linear_counts"] = ("linearity_counts", nodes * made["mean"], {"units": "count"})
        variables["linearity_basis"] = ((term, "linearity_counts"), made["basis"], {"units": "1"})
        variables["linearity_map"] = ((term, *ELEMENT), made["weights"], {"units": "1"})
    if "scattered" in done:
        share = np.linalg.inv(made["operator"]) - np.eye(328)
        variables["stray_light"] = (("band", "source_band"), share, {"units": "1"})
        variables["flat_field"] = (ELEMENT, made["flat"], {"units": "1"})
    return xr.Dataset(variables, attrs=attrs)


@pytest.mark.parametrize("step", ["net", "level", "linear", "even", "scattered", "radiance"])
def test_every_step_is_that_of_plain_numpy(step: str) -> None:
    # radiance in uW cm-2 sr-1 nm-1, compared in counts
    unit = 0.01 * steps()["factor"][:, None] if step == "radiance" else np.ones((328, 1))
    made, expected = line_of(step).paint.radiance().radiance.values / unit, steps()[step]
    if step == "radiance":
        expected = expected * 0.01 / unit
    np.testing.assert_array_equal(np.isnan(made[LIT]), np.isnan(expected[LIT]))
    error, level = np.abs(made - expected)[LIT], np.abs(expected[LIT])
    assert np.nanmax(error) < 1e-6 * np.nanpercentile(level, 99)
    bright = level > 10.0
    assert np.nanmedian(error[bright] / level[bright]) < 1e-6


@pytest.mark.parametrize("has_flat", [True, False], ids=["declared", "fitted"])
def test_scattered_light_of_a_wild_flat_is_that_of_the_operator(has_flat: bool) -> None:
    # the flat as it is, without bad elements by list: factors in the lit area are up to 1,700
    made = steps()
    flat = frame("EMIT_FlatField_20220504", "<f4")[0]
    line = line_of("scattered")[["counts", "dark_counts", "exposure_time", "saturation_count", "stray_light"]]
    line.attrs.clear()  # no pedestal: its masked elements are not taken over
    line["radiance_gain"] = line.dark_counts.copy(data=np.where(flat > 0, flat, np.nan))
    line.radiance_gain.attrs["units"] = "W m-2 sr-1 nm-1 s count-1"
    if has_flat:
        line["flat_field"] = line.dark_counts.copy(data=flat)
        line.flat_field.attrs["units"] = "1"
    expected = made["operator"] @ (np.where(flat > 0, flat, 0.0) * made["net"])
    error = (line.paint.radiance().radiance.values - expected)[LIT]
    assert np.isnan(error).sum() == 3  # one element, whose factor is negative
    assert np.sqrt(np.nanmean(error**2)) < (0.02 if has_flat else 0.8)
