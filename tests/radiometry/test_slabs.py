"""What tasks share: the plan, its values, and chunks of whole lines."""

import importlib
import pickle
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

import hyperpaint as hp
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


# --- saturated pixels of traced glossy and metallic cars, against counts that no converter clipped ----------


@pytest.fixture(scope="module")
def scenes() -> Any:
    # Return campaigns.saturated_pixels, and a scene of it
    module = importlib.import_module("campaigns.saturated_pixels")
    return module, *module.trace_scene(303, lines=120, columns=150)


@pytest.mark.slow
def test_every_clipped_pixel_is_found_and_few_others(scenes: Any) -> None:
    module, traced, _, sky = scenes
    found, clipped = [], []
    for exposure in module.EXPOSURES:
        line, true = module.exposed(traced, sky, exposure, 303)
        found.append(module.found_in(line))
        clipped.append(true["clipped"])
        assert 10 <= true["clipped"].sum() < 0.2 * true["clipped"].size
        # what the flag promises: any band within 16 counts of the converter's end
        np.testing.assert_array_equal(found[-1], true["margin"])
    # within those 16 counts the converter is not trusted, though some of the samples were not clipped
    recall, precision = module.recall_and_precision(np.stack(found), np.stack(clipped))
    assert recall == 1.0
    assert precision >= 0.99


def test_samples_that_were_clipped_are_missing_and_the_others_stay(scenes: Any) -> None:
    module, traced, _, sky = scenes
    line, true = module.exposed(traced, sky, 0.012, 303, bands=30)
    radiance = hp.radiance(line).radiance.values
    full = line.counts.values >= line.saturation_count.values - module.MARGIN
    assert np.isnan(radiance[full]).all()
    assert np.isfinite(radiance[~full]).all()
    assert full.any(axis=1)[true["clipped"]].all()
    assert np.isfinite(radiance).any(axis=1)[true["clipped"]].mean() > 0.9
