"""Saturated pixels of traced glossy and metallic cars, against counts that no converter clipped."""

import importlib
from typing import Any

import numpy as np
import pytest

import hyperpaint as hp


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
