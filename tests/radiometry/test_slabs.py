"""What tasks share: the plan, its values, and chunks of whole lines."""

import pickle
from typing import Any

import numpy as np
import xarray as xr
from support.strategies import flight

from hyperpaint.radiometry import slabs
from hyperpaint.radiometry.planning import make_plan


def plan_of(line: xr.Dataset) -> slabs.Plan:
    light = ("irradiance", "irradiance_fwhm", "irradiance_time", "irradiance_wavelength")
    cube = ("dark_counts", "radiance_gain", "exposure_time", "saturation_count", "time", "wavelength", "fwhm")
    return make_plan(
        line.counts.shape,
        line.counts.dtype.str,
        np.array([0]),
        cube={name: line[name].values for name in cube},
        light={**{name: line[name].values for name in light}, **line.attrs},
    )


def test_a_plan_does_not_grow_with_the_cube() -> None:
    small, large = (len(pickle.dumps(plan_of(flight(lines=n, bands=4, columns=3).line))) for n in (10, 1010))
    assert (large - small) / 1000 < 100  # bytes a line


def test_light_of_a_slab_is_that_of_its_lines() -> None:
    plan = plan_of(flight(lines=9).line)
    whole = plan.light(0, 9)
    assert whole.dtype == np.float32
    np.testing.assert_array_equal(plan.light(4, 7), whole[4:7])


def test_a_count_at_the_limit_is_saturated() -> None:
    assert plan_of(flight(dtype=np.uint16).line).saturation_limit.tolist() == [[4079]]


def test_chunks_are_whole_lines(no_compute: Any) -> None:
    cube = xr.DataArray(np.zeros((70, 4, 5), "u2"), dims=("along_track", "band", "cross_track"))
    with no_compute():
        assert slabs.line_chunked(cube).chunks == ((32, 32, 6), (4,), (5,))
        turned = cube.transpose("cross_track", "along_track", "band").chunk(
            band=2, cross_track=3, along_track=10
        )
        assert slabs.line_chunked(turned).chunks == ((10,) * 7, (4,), (5,))
        assert slabs.line_chunked(cube.chunk(along_track=(1, 69))).chunks == ((1, 69), (4,), (5,))


def test_small_values_stay_lazy() -> None:
    array = xr.DataArray(np.ones(3), dims="band")
    assert isinstance(slabs.small(array), np.ndarray)
    assert not isinstance(slabs.small(array.chunk()), np.ndarray)
