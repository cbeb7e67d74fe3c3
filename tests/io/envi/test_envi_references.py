"""Slabs of raw cubes as runs of bytes, and the parser of VirtualiZarr that offers them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_errors

from hyperpaint.base.errors import FormatError
from hyperpaint.io.envi.envi_cubes import EnviParser, slab_lines, slab_offsets

SHAPE = (40, 3, 5)


@given(st.lists(st.integers(1, 5000), min_size=1, max_size=4))
def test_slabs_that_are_broken_are_as_few_as_can_be(sizes: list[int]) -> None:
    chosen = slab_lines(np.cumsum(sizes).tolist())
    assert 8 <= chosen <= 64

    def broken(lines: int) -> int:
        # by hand: a slab is whole where all its lines are there and in one cube
        owner = np.repeat(np.arange(len(sizes)), sizes)
        slabs = [owner[first : first + lines] for first in range(0, len(owner), lines)]
        return sum(len(slab) < lines or slab[0] != slab[-1] for slab in slabs)

    assert broken(chosen) == min(broken(lines) for lines in range(8, 65))


def test_offsets_count_from_the_line_a_slab_begins_at() -> None:
    assert slab_offsets(10, 3, 2, 100, 7).tolist() == [121, 191]
    assert slab_offsets(10, 0, 0, 0, 7).size == 0


def _cube(folder: Path, interleave: str, code: int, dtype: str, offset: int) -> np.ndarray[Any, Any]:
    # Write a cube; return its samples in the order of the file
    order = {"bil": (0, 1, 2), "bip": (0, 2, 1), "bsq": (1, 0, 2)}[interleave]
    samples = np.arange(np.prod(SHAPE)).reshape(SHAPE).transpose(order).astype(dtype)
    (folder / "raw_0").write_bytes(bytes(offset) + samples.tobytes())
    (folder / "raw_0.hdr").write_text(
        f"ENVI\nsamples = 5\nlines = 40\nbands = 3\nheader offset = {offset}\ndata type = {code}\n"
        f"interleave = {interleave}\nbyte order = {int(dtype[0] == '>')}\nwavelength units = nm\n"
        "wavelength = {450, 550, 650}\n"
    )
    return samples


@pytest.fixture
def registry(tmp_path: Path) -> Any:
    pytest.importorskip("virtualizarr", reason="virtualizarr is not installed (extra `virtual`)")
    from obspec_utils.registry import ObjectStoreRegistry
    from obstore.store import LocalStore

    return ObjectStoreRegistry({"file://": LocalStore()})


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
@pytest.mark.parametrize(("code", "dtype"), [(12, "<u2"), (12, ">u2"), (4, "<f4")])
@pytest.mark.parametrize("suffix", ["", ".hdr"])
def test_the_parser_gives_the_samples(
    tmp_path: Path, registry: Any, interleave: str, code: int, dtype: str, suffix: str
) -> None:
    samples = _cube(tmp_path, interleave, code, dtype, offset=128)
    store = EnviParser()(f"file://{tmp_path}/raw_0{suffix}", registry)
    with xr.open_zarr(store, consolidated=False, zarr_format=3) as opened:
        assert opened["counts"].dims[{"bil": 0, "bip": 0, "bsq": 1}[interleave]] == "along_track"
        assert opened["counts"].chunksizes["along_track"] == (40,)
        np.testing.assert_array_equal(opened["counts"].values, samples)
        assert opened.attrs["wavelength"] == [450.0, 550.0, 650.0]


def test_the_parser_serves_virtualizarr(tmp_path: Path, registry: Any) -> None:
    from virtualizarr import open_virtual_dataset

    samples = _cube(tmp_path, "bil", 12, "<u2", 0)
    url = f"file://{tmp_path}/raw_0"
    with open_virtual_dataset(url, registry=registry, parser=EnviParser("raw", lines=8)) as opened:
        manifest = opened["raw"].data.manifest.dict()
    assert len(manifest) == 5
    entry = manifest["2.0.0"]
    content = (tmp_path / "raw_0").read_bytes()[entry["offset"] : entry["offset"] + entry["length"]]
    assert content == samples[16:24].tobytes()


def test_the_parser_refuses_what_would_be_read_wrongly(tmp_path: Path, registry: Any) -> None:
    _cube(tmp_path, "bil", 12, "<u2", 0)
    url = f"file://{tmp_path}/raw_0"
    expect_errors((FormatError, "length-mismatch", lambda: EnviParser(lines=32)(url, registry)))
    (tmp_path / "raw_0").write_bytes(bytes(1198))
    expect_errors((FormatError, "file-size", lambda: EnviParser()(url, registry)))
    (tmp_path / "raw_0.hdr").write_text("ENVI\nsamples = 5\n")
    expect_errors((FormatError, "key-missing", lambda: EnviParser()(url, registry)))
