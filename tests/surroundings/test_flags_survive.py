"""Flags that are set once are set in everything that is made afterwards."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.schema import Quality
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.simulation import simulate_line
from hyperpaint.surroundings.surveying import LAYERS

SUN = {"sun_zenith": 35.0}
REGION = hp.Region("part", [(2, 4), (17, 4), (17, 27), (2, 27)])

STEPS: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
    "smooth": lambda line: line.paint.smooth("box", 5),
    "savitzky-golay": lambda line: line.paint.smooth(),
    "to_nominal": lambda line: line.paint.to_nominal(),
    "at": lambda line: line.paint.at([500.0, 600.0, 700.0]),
    "remove_mirrored_sky": lambda line: line.paint.remove_mirrored_sky(**SUN),
    "correct_light": lambda line: line.paint.correct_light(direct=0.9, **SUN),
    "reflectance": lambda line: line.paint.reflectance(),
    "flag": lambda line: line.paint.flag(**SUN, glint=9.0, shadow=9.0, adjacency=9.0, edge=0),
}


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    # Return a line from counts, flagged, with every bit that is not of the counts set somewhere
    exposure = {"exposure_time_ms": 14.0, "frame_period_ms": 15.0}
    made = simulate_line(lines=32, bands=24, columns=20, smile_nm=0.6, seed=5, **exposure)
    made = made.drop_vars([name for name in made if str(name).startswith("true_")]).chunk(along_track=8)
    flagged = made.paint.reflectance().paint.flag(**SUN).compute()
    assert (flagged.quality & int(Quality.SATURATED)).any()
    bits = flagged.quality.values.copy()
    # the others are found anew whenever reflectance is computed from counts
    for number, flag in enumerate(flag for flag in Quality if Quality.GLINT <= flag <= Quality.OFF_SWATH):
        bits[number : number + 3, 7] |= np.uint16(flag)
    return flagged.assign(quality=flagged.quality.copy(data=bits)).chunk(along_track=8)


def assert_still_set(made: xr.Dataset, line: xr.Dataset, name: str) -> None:
    before, after = line.quality.values, made.quality.values
    assert made.quality.dtype == np.uint16, name
    np.testing.assert_array_equal(after & before, before, err_msg=name)
    assert made.quality.attrs["flag_meanings"].split()[6] == "glint", name
    assert made.quality.attrs["flags_from"] == line.quality.attrs["flags_from"], name


@pytest.mark.parametrize("name", STEPS)
def test_after_one_step(line: xr.Dataset, name: str) -> None:
    made = STEPS[name](line)
    assert_still_set(made, line, name)
    if name not in ("reflectance", "flag"):
        np.testing.assert_array_equal(made.quality, line.quality)
    for layer in LAYERS:
        assert layer in made, (name, layer)


def test_saturated_samples_stay_missing_and_flagged_through_smoothing(line: xr.Dataset) -> None:
    saturated = (line.quality.values & int(Quality.SATURATED)) > 0
    assert np.isnan(line.reflectance.values).any(axis=1)[saturated].all()
    smoothed = line.paint.smooth("box", 5)
    # what a window fills in is still a value of a pixel that is flagged
    assert_still_set(smoothed, line, "smooth")
    np.testing.assert_array_equal(
        smoothed.paint.remove_mirrored_sky(**SUN).paint.correct_light(direct=0.9, **SUN).quality, line.quality
    )


def test_after_everything_a_store_and_signatures(line: xr.Dataset, tmp_path: Path) -> None:
    made = line
    for name in ("remove_mirrored_sky", "to_nominal", "correct_light", "smooth"):
        made = STEPS[name](made)
        assert_still_set(made, line, name)
    hp.to_store(made, tmp_path / "lot.zarr", "flightlines/raw_0")
    opened = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    np.testing.assert_array_equal(opened.quality, line.quality)
    assert_still_set(opened, line, "to_store")
    once = opened.paint.signatures(REGION, exclude=0, min_pixels=1)
    first = line.paint.signatures(REGION, exclude=0, min_pixels=1)
    np.testing.assert_array_equal(once.quality_share, first.quality_share)
    assert int(once.quality[0]) == int(first.quality[0])
    assert int(once.quality[0]) & int(Quality.GLINT | Quality.SHADOW | Quality.ADJACENCY)


def test_pixels_that_are_flagged_are_those_left_out(line: xr.Dataset, tmp_path: Path) -> None:
    smoothed = line.paint.smooth("box", 5)
    along, across = hp.regions.pixels(REGION, line)
    bits = line.quality.values[along, across]
    present = np.isfinite(smoothed.reflectance.values[along, :, across]).any(axis=1)
    left: dict[str, Any] = {}
    for name, given in (("as it was", line), ("smoothed", smoothed)):
        left[name] = given.paint.signatures(REGION, min_pixels=1)
    exclude = int(EXCLUDED)
    expected = int(((bits & exclude == 0) & present).sum())
    assert int(left["smoothed"].n[0]) == expected < along.size
    np.testing.assert_array_equal(left["smoothed"].member_along_track, left["as it was"].member_along_track)
