"""Dark references, against plain means of the frames."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.io.flightline.dark import DARK_NONE, open_dark
from hyperpaint.io.flightline.timing import Timing

BANDS, COLUMNS = 3, 4
CUBE = ("along_track", "band", "cross_track")
ELEMENT = ("band", "cross_track")
LINE = xr.DataArray(np.zeros((2, BANDS, COLUMNS), np.uint16), dims=CUBE)
NOON = np.datetime64("2024-06-01T12:00:00", "ns")


def frames(lines: int, seed: int = 0) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(10, 60, (lines, BANDS, COLUMNS)).astype(np.uint16)


def cube(
    counts: np.ndarray[Any, Any], second: int | None = None, exposure: float | None = None
) -> xr.Dataset:
    made = xr.Dataset({"counts": (CUBE, counts, {"units": "count"})})
    if second is not None:
        made = made.assign_coords(
            time=("along_track", np.full(len(counts), NOON + np.timedelta64(second, "s")))
        )
    if exposure is not None:
        made["exposure_time"] = ((), exposure, {"units": "s"})
    return made


def test_one_cube_is_the_mean_of_its_lines_and_their_spread() -> None:
    counts = frames(20)
    dark = open_dark(cube(counts, exposure=0.005), Timing(), None, LINE)
    assert dark is not None
    assert (dark.counts.dims, dark.counts.dtype) == (ELEMENT, np.float32)
    np.testing.assert_allclose(dark.counts, counts.mean(axis=0, dtype="f8"), rtol=1e-6)
    assert dark.read_noise is not None
    assert dark.read_noise.dtype == np.float32
    variance = counts.var(axis=0, ddof=1, dtype="f8")
    np.testing.assert_allclose(dark.read_noise, np.sqrt(variance - 1 / 12), rtol=1e-6)
    assert dark.uncertainty is not None
    np.testing.assert_allclose(dark.uncertainty, np.sqrt(variance / 20), rtol=1e-6)
    made = dark.variables(needs_noise=True)
    assert (float(made["dark_exposure_time"]), set(dark.variables(needs_noise=False))) == (
        0.005,
        {*("dark_counts", "dark_exposure_time", "dark_counts_u_random")},
    )


def test_few_lines_measure_no_noise_of_elements() -> None:
    counts = frames(15)
    dark = open_dark(cube(counts), Timing(), None, LINE)
    assert dark is not None
    assert dark.read_noise is None
    # their mean is less sure than that of many, which must not be unsaid
    assert set(dark.variables(needs_noise=True)) == {"dark_counts", "dark_counts_u_random"}
    assert dark.uncertainty is not None
    own = counts.var(axis=0, ddof=1, dtype="f8")
    np.testing.assert_allclose(dark.uncertainty, np.sqrt(((14 * own + 16 * own.mean()) / 30) / 15), rtol=1e-6)
    single = open_dark(cube(frames(1)), Timing(), None, LINE)
    assert single is not None
    assert set(single.variables(needs_noise=True)) == {"dark_counts"}


def test_cubes_of_known_times_stay_apart_in_order() -> None:
    late, early = frames(2, 1), frames(3, 2)
    dark = open_dark([cube(late, 60, 0.004), cube(early, 0, 0.005)], Timing(), None, LINE)
    assert dark is not None
    assert dark.counts.dims == ("dark_time", *ELEMENT)
    np.testing.assert_allclose(dark.counts[0], early.mean(axis=0, dtype="f8"), rtol=1e-6)
    np.testing.assert_allclose(dark.counts[1], late.mean(axis=0, dtype="f8"), rtol=1e-6)
    assert dark.counts["dark_time"].dtype == "datetime64[ns]"
    assert (dark.counts["dark_time"].values - NOON).astype("timedelta64[s]").astype(int).tolist() == [0, 60]
    assert dark.variables(needs_noise=False)["dark_exposure_time"].values.tolist() == [0.005, 0.004]


def test_cubes_of_unknown_times_are_averaged_line_by_line() -> None:
    one, two = frames(2, 1), frames(5, 2)
    dark = open_dark([cube(one), cube(two, 0)], Timing(), None, LINE)
    assert dark is not None
    np.testing.assert_allclose(dark.counts, np.concatenate([one, two]).mean(axis=0, dtype="f8"), rtol=1e-6)
    assert "averaged" in dark.source


def test_different_exposures_are_not_averaged() -> None:
    with pytest.raises(SchemaError, match=r"5 ms.*unknown.*exposure-conflict"):
        open_dark([cube(frames(2), exposure=0.005), cube(frames(2))], Timing(), None, LINE)


def test_none_and_the_calibrations() -> None:
    none = open_dark(DARK_NONE, Timing(), None, LINE)
    assert none is not None
    assert none.counts.dtype == np.float32
    assert not none.counts.any()
    assert none.counts.attrs["dark"] == "none"
    calibration = xr.Dataset(
        {
            "dark_counts": (ELEMENT, np.full((BANDS, COLUMNS), 12.5), {"units": "count"}),
            "dark_exposure_time": ((), 5.0, {"units": "ms"}),
        }
    )
    given = open_dark("calibration", Timing(), calibration, LINE)
    assert given is not None
    assert (given.counts == 12.5).all()
    assert given.counts.dtype == np.float32
    assert given.exposures == (0.005,)


def test_what_failed_to_open_is_not_reported_again() -> None:
    assert open_dark(DARK_NONE, Timing(), None, None) is None
    assert open_dark("calibration", Timing(), None, LINE) is None


@pytest.mark.parametrize("missing", [None, [], ()])
def test_a_dark_must_be_named(missing: Any) -> None:
    with pytest.raises(SchemaError, match="dark-missing"):
        open_dark(missing, Timing(), None, LINE)


def test_wrong_shapes_and_contents_are_refused() -> None:
    with pytest.raises(SchemaError, match="grid-mismatch"):
        open_dark(cube(frames(2)), Timing(), None, LINE.isel(cross_track=[0, 1, 2, 3, 3]))
    radiance = xr.Dataset({"radiance": (CUBE, np.ones((2, BANDS, COLUMNS), np.float32))})
    with pytest.raises(FormatError, match="counts-missing"):
        open_dark(radiance, Timing(), None, LINE)
    hollow = xr.Dataset({"dark_counts": (ELEMENT, np.full((BANDS, COLUMNS), np.nan), {"units": "count"})})
    with pytest.raises(SchemaError, match="not-finite"):
        open_dark(hollow, Timing(), None, LINE)
