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


def test_chunks_are_whole_lines_and_small_values_stay_lazy(no_compute: Any) -> None:
    cube = xr.DataArray(np.zeros((70, 4, 5), "u2"), dims=("along_track", "band", "cross_track"))
    turned = cube.transpose("cross_track", "along_track", "band")
    with no_compute():
        for source, lines in (
            (cube, (32, 32, 6)),
            (turned.chunk(band=2, cross_track=3, along_track=10), (10,) * 7),
            (cube.chunk(along_track=(1, 69)), (1, 69)),
        ):
            assert slabs.line_chunked(source).chunks == (lines, (4,), (5,))
    assert isinstance(slabs.small(cube[0, 0]), np.ndarray)
    assert not isinstance(slabs.small(cube[0, 0].chunk()), np.ndarray)


def test_light_of_a_slab_is_that_of_its_lines() -> None:
    plan = plan_of(flight(lines=9).line)
    whole = plan.light(0, 9)
    assert whole.dtype == np.float32
    np.testing.assert_array_equal(plan.light(4, 7), whole[4:7])
    # a count at the limit is saturated
    assert plan_of(flight(dtype=np.uint16).line).saturation_limit.tolist() == [[4079]]
