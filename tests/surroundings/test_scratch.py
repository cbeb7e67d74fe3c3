"""What a survey keeps in files, or counts line by line, has the bits of what it kept and sorted in memory."""

import os
import tempfile

import numpy as np
import pytest
from support.analytic_scenes import as_line, box_shadow, smooth_edge, wavelengths

import hyperpaint as hp
from hyperpaint.base.errors import StoreError
from hyperpaint.kernels.segmentation import count_steps
from hyperpaint.surroundings import scratch
from hyperpaint.surroundings.detection_rules import SEGMENTS
from hyperpaint.surroundings.segments import sample_pixels, sorted_steps


def test_a_survey_in_files_has_the_bits_of_one_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    nm = wavelengths()
    asphalt, red = smooth_edge(nm, 600.0, 0.07, 0.12, 150.0), smooth_edge(nm, 600.0, 0.04, 0.6)
    cube, _, _ = box_shadow(nm, asphalt, red)
    line = as_line(cube, nm, snr=100.0)
    shift = ("cross_track", np.linspace(-1.0, 1.0, line.sizes["cross_track"]), {"units": "nm"})
    line = line.assign_coords(wavelength_shift=shift)
    made: list[str] = []
    plain = tempfile.TemporaryFile
    in_memory = hp.surroundings.survey(line, sun_zenith=40.0)
    monkeypatch.setattr(scratch, "MAX_ARRAY_BYTES_IN_MEMORY", 0)
    monkeypatch.setattr(scratch, "_LINES", 7)
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **named: made.append("file") or plain(**named))
    in_files = hp.surroundings.survey(line, sun_zenith=40.0)
    assert len(made) >= 3
    for name, values in vars(in_memory).items():
        if isinstance(values, np.ndarray):
            np.testing.assert_array_equal(values, getattr(in_files, name), err_msg=name)


def test_a_scratch_array_keeps_its_values_when_memory_is_released(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "MAX_ARRAY_BYTES_IN_MEMORY", 0)
    array = scratch.scratch_array((300, 70), np.float32)
    assert not array.any()
    array[:] = np.arange(21000).reshape(300, 70)
    scratch.release(array[5:9])
    np.testing.assert_array_equal(array.ravel(), np.arange(21000))
    places = np.array([0, 299, 7] * 50)
    np.testing.assert_array_equal(scratch.gather(array, places), array[places])


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system reserves no room on a disk")
def test_a_full_disk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scratch, "MAX_ARRAY_BYTES_IN_MEMORY", 0)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(StoreError, match=r"TMPDIR.*disk-full"):
        scratch.scratch_array((8,), np.float64)


def test_steps_are_sorted_as_numpy_sorts_them() -> None:
    rng = np.random.default_rng(4)
    steps = rng.choice(rng.exponential(0.1, 500).astype(np.float32), (90, 31, 2))
    steps[rng.random(steps.shape) < 0.1] = np.inf
    steps[3:5] = 0.0
    counts = np.zeros(1 << 15, np.int64)
    count_steps(steps.ravel(), steps.ravel().view(np.uint32), counts)
    parts = [(places.copy(), values.copy()) for places, values in sorted_steps(steps, counts)]
    assert len(parts) > 3
    expected = np.argsort(steps.ravel(), kind="stable")[: np.isfinite(steps).sum()]
    np.testing.assert_array_equal(np.concatenate([places for places, _ in parts]), expected)
    np.testing.assert_array_equal(np.concatenate([values for _, values in parts]), steps.ravel()[expected])


def test_samples_are_every_so_many_chosen_pixels_in_line_order() -> None:
    rng = np.random.default_rng(5)
    number = rng.integers(-1, 6, (80, 90)).astype(np.int32)
    number[20:70, 20:85] = 2  # more than are sampled
    chosen = (rng.random(number.shape) < 0.8) & (number != 4)  # none of one segment
    samples = sample_pixels(number, chosen, 6)
    for segment, places in enumerate(samples):
        here = (number == segment).ravel()
        of = np.flatnonzero(here & chosen.ravel()) if segment != 4 else np.flatnonzero(here)
        np.testing.assert_array_equal(places, of[:: max(1, -(-of.size // SEGMENTS.max_sample_px))])
    assert samples[2].size < (number == 2).sum()
