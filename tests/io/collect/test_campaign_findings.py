"""Inputs that the fault campaigns found: each once left its parser in a wrong way."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import refusal

from hyperpaint.base.errors import CollectError, FormatError, PaintWarning
from hyperpaint.io.collect.collect_toml import read_collect
from hyperpaint.io.envi.envi_header import parse_header
from hyperpaint.io.spectrometers.asd import open_asd
from hyperpaint.io.spectrometers.irradiance import open_irradiance


@pytest.mark.parametrize(
    ("pattern", "code"),
    [
        ("*/" * 3000, "pattern-invalid"),
        ("**/" * 30 + "*.asd", "file-not-found"),
        ("[" * 5000, "pattern-invalid"),
    ],
)
def test_globs_that_recurse_or_never_end(pattern: str, code: str, tmp_path: Path) -> None:
    # RecursionError from glob (a level a folder); with many '**' the time multiplies
    path = tmp_path / "collect.toml"
    path.write_text(f'[irradiance]\nfiles = "{pattern}"\n')
    with pytest.raises(CollectError, match=code):
        read_collect(path)


def test_a_pipe_that_a_glob_matches_is_missed(tmp_path: Path) -> None:
    # it was left out, and with it a spectrum of the sky, without a word
    os.mkfifo(tmp_path / "sky.asd")
    (tmp_path / "sky_1.asd").touch()
    path = tmp_path / "collect.toml"
    path.write_text('[irradiance]\nfiles = "*.asd"\n')
    with pytest.raises(CollectError, match=r"sky\.asd .*file-special"):
        read_collect(path)


@pytest.mark.parametrize("number", ["9" * 400, "-" + "9" * 400, "0x" + "f" * 5000, "[0x" + "f" * 5000 + "]"])
def test_whole_numbers_beyond_float64(number: str, tmp_path: Path) -> None:
    # OverflowError: int too large to convert to float; ValueError where it is printed
    path = tmp_path / "collect.toml"
    path.write_text(f"[camera]\nexposure_time_ms = {number}\n")
    with pytest.raises(CollectError) as caught:
        read_collect(path)
    assert caught.value.codes[0] == ("type-wrong" if number.startswith("[") else "not-finite")
    assert "exposure_time_ms" in caught.value.problems[0].found


@pytest.mark.parametrize("cell", ["1e39", "-1e300", "1.7e308"])
def test_irradiance_beyond_float32(cell: str, tmp_path: Path) -> None:
    # RuntimeWarning: overflow encountered in cast, and inf in the series
    path = tmp_path / "sky.csv"
    rows = "2024-05-21T12:00:00Z,0.9,0.9,0.9\n" + f"2024-05-21T12:00:02Z,0.9,{cell},0.9\n"
    path.write_text(f"# units: uW cm-2 nm-1\n# fwhm_nm: 3\ntime,500,600,700\n{rows}")
    with refusal(FormatError, "value-out-of-range", "sky.csv:5"):
        open_irradiance(path, units="kW m-2 nm-1")


def test_asd_product_beyond_float64(write_asd: Callable[..., Path]) -> None:
    # RuntimeWarning: overflow encountered in multiply
    damaged = np.full(11, 1000.0)
    damaged[4] = 1e300
    blocks: dict[int, Any] = {2: (136, np.full(11, 1e10)), 3: (136, np.full(11, 1.0))}
    path = write_asd("sky.asd", damaged, data_type=7, blocks=blocks, utc_offset_h=0.0)
    with pytest.warns(PaintWarning, match="not finite"):
        opened = open_asd(path, "irradiance", utc_offset_h=0.0)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(opened.irradiance.values[0])), [4])


@pytest.mark.parametrize(
    "lists", ["wavelength = {1e305, 2e305}", "wavelength = {0.4, 0.5}\nfwhm = {1, 1e306}"]
)
def test_wavelengths_beyond_float64(lists: str) -> None:
    # RuntimeWarning: overflow encountered in multiply
    head = "ENVI\nsamples = 1\nlines = 1\nbands = 2\ndata type = 12\ninterleave = bil\nbyte order = 0\n"
    with pytest.raises(FormatError, match="not-finite"):
        parse_header(f"{head}wavelength units = Meters\n{lists}\n", "cube.hdr")
