"""Certificates of panels, lists of pairs, and files of references."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

import hyperpaint as hp
from hyperpaint.base.errors import FormatError
from hyperpaint.io.spectrometers.reference_files import open_references, read_pairs


@pytest.mark.real_data
def test_real_certificates(shared_data: Path) -> None:
    panel = hp.io.read_certificate(shared_data / "spectra_ascii" / "R90.txt")
    assert (panel.dtype, panel.attrs["units"], panel["wavelength"].attrs["units"]) == (np.float64, "1", "nm")
    assert float(panel.sel(wavelength=250.0)) == 0.942517
    zenith = hp.io.read_certificate(shared_data / "lab_calibration" / "zenith_lite_95R_certificate.csv")
    assert (float(zenith.sel(wavelength=250.0)), float(zenith.sel(wavelength=312.0))) == (0.911211, 0.967611)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"400,98.1\n500,98.5\n", "divide percent by 100"),
        (b"400,0.9\n", "table-missing"),
        (b"0.4,0.9\n0.5,0.9\n", "expected nanometres"),
        (b"500,0.9\n400,0.9\n", "wavelength-unordered"),
        (b"heading\n" * 41 + b"400,0.9\n500,0.9\n", "line 41"),
        (b"400,0.9\noops\n500,0.9\n", "line 2"),
        (b"400,nan\n500,0.9\n", "not finite"),
        (b"\0" * 50, "line 1: "),
        (b"", "0 lines"),
    ],
)
def test_no_certificate(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "panel.csv"
    path.write_bytes(content)
    if content.startswith(b"\0"):
        told = "0 lines of numbers"
    with pytest.raises(FormatError, match=told):
        hp.io.read_certificate(path)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("p.csv", "paint,reference\na,b\na,c\nd,e\na,b\n", {"a": ("b", "c"), "d": ("e",)}),
        ("p.csv", '\ufeff"a, b",x\n# note\n\nümlaut , y \n', {"a, b": ("x",), "ümlaut": ("y",)}),
        ("p.json", '{"a": "b", "c": ["d", "e"]}', {"a": ("b",), "c": ("d", "e")}),
    ],
)
def test_pairs(tmp_path: Path, name: str, content: str, expected: dict[str, tuple[str, ...]]) -> None:
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    assert read_pairs(path) == expected


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("p.csv", b"a\nb,c,d\n", "line 1.*row-unreadable"),
        ("p.csv", b"", "empty-input"),
        ("p.csv", b"\xff\xfe", "save it as UTF-8"),
        ("p.csv", b'a,"b\n', "after line"),
        ("p.json", b"[" * 100_000, "text-unreadable"),
        ("p.json", b"[1]", "type-wrong"),
        ("p.json", b'{"a": 3, "b": []}', "'a': 3.*\n.*'b'"),
    ],
)
def test_no_pairs(tmp_path: Path, name: str, content: bytes, told: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FormatError, match=told):
        read_pairs(path)


@given(st.binary(max_size=80), st.sampled_from([b"", b'{"a":', b'{"a":["b",']))
def test_any_bytes_are_read_or_refused(tmp_path: Path, data: bytes, head: bytes) -> None:
    path = tmp_path / "a.json"  # the fault campaign has the other form
    path.write_bytes(head + data)
    with contextlib.suppress(FormatError):
        read_pairs(path)


def test_all_bad_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.sig").write_text("nothing")
    (tmp_path / "b.asd").write_bytes(b"asd" + b"\0" * 20)
    (tmp_path / "c.txt").write_text("poem")
    with pytest.raises(FormatError, match="references cannot") as caught:
        open_references([tmp_path / name for name in ("a.sig", "b.asd", "c.txt")])
    for name in ("a.sig", "b.asd", "c.txt"):
        assert name in str(caught.value)
    with pytest.raises(FormatError, match="file-not-found"):
        open_references([tmp_path / "none*"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match="file-not-found"):
        open_references([tmp_path / "empty"])


def test_a_store_without_references(tmp_path: Path) -> None:
    import xarray as xr

    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "s.zarr", "flightlines/raw_0")
    with pytest.raises(FormatError, match="library-missing"):
        open_references([tmp_path / "s.zarr"])
