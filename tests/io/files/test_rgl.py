"""Files of the RGL material database, written here after their layout, and what they must not claim."""

import contextlib
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.refusals import refusal
from support.tensor_files import rough_brdf, write_tensors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError


def test_tensors_are_read_with_dims_and_units(tmp_path: Path) -> None:
    tensors = rough_brdf(azimuths=3)
    brdf = hp.io.read_rgl(write_tensors(tmp_path / "paint.bsdf", tensors))
    for name in ("ndf", "sigma", "vndf", "luminance", "spectra"):
        np.testing.assert_array_equal(brdf[name], tensors[name])
        assert brdf[name].dtype == np.float32
    assert brdf.spectra.dims == ("light_azimuth", "light_zenith", "wavelength", "sample_v", "sample_u")
    np.testing.assert_allclose(brdf.light_azimuth, [-180.0, 0.0, 180.0], atol=1e-4)
    np.testing.assert_allclose(brdf.wavelength, tensors["wavelengths"])
    units = [brdf[name].attrs["units"] for name in ("light_zenith", "wavelength", "ndf", "spectra")]
    assert units == ["degree", "nm", "sr-1", "1"]
    assert (brdf.attrs["description"], brdf.attrs["jacobian"]) == ("rough paint", 1)


def _of(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda tensors: {**tensors, name: change(tensors[name])}


#: By code: changes of the tensors that it refuses.
WRONG: dict[str, list[Callable[[dict[str, Any]], dict[str, Any]]]] = {
    "tensor-missing": [lambda tensors: {k: v for k, v in tensors.items() if k != "sigma"}],
    "spectra-missing": [lambda tensors: {("rgb" if k == "spectra" else k): v for k, v in tensors.items()}],
    "tensor-type": [_of("ndf", lambda ndf: ndf.astype("<f8"))],
    "tensor-shape": [
        _of("ndf", lambda ndf: ndf[0]),
        _of("ndf", lambda ndf: ndf[:1]),
        _of("spectra", lambda spectra: spectra[:, :, 1:]),
        _of("jacobian", lambda flag: np.repeat(flag, 2)),
    ],
    "tensor-empty": [_of("ndf", lambda ndf: ndf[:0])],
    "tensor-rank": [_of("ndf", lambda ndf: ndf[(None,) * 7])],
    "tensor-count": [lambda tensors: tensors | {f"n{k}": tensors["jacobian"] for k in range(64)}],
    "not-finite": [_of("spectra", lambda spectra: np.full_like(spectra, np.nan))],
    "value-out-of-range": [
        _of("theta_i", lambda angle: angle + np.float32(1.0)),
        _of("wavelengths", lambda micron: micron / np.float32(1000.0)),
    ],
    "order-wrong": [_of("theta_i", lambda angle: angle[::-1].copy())],
    "density-wrong": [
        _of("ndf", lambda ndf: -ndf),
        _of("vndf", lambda vndf: vndf * (np.arange(5.0, dtype="<f4") > 0)[:, None, None]),
    ],
}


@pytest.mark.parametrize("code", WRONG)
def test_wrong_tensors_are_refused(tmp_path: Path, code: str) -> None:
    for change in WRONG[code]:
        path = write_tensors(tmp_path / "paint.bsdf", change(rough_brdf()))
        with refusal(FormatError, code, "paint.bsdf"):
            hp.io.read_rgl(path)


def test_headers_that_lie_are_refused(tmp_path: Path) -> None:
    data = write_tensors(tmp_path / "paint.bsdf", rough_brdf()).read_bytes()
    place = data.index(b"spectra") + len(b"spectra")  # rank, type, offset and shape of the largest tensor
    path = tmp_path / "wrong.bsdf"
    for code, wrong in {
        "format-unknown": b"X" + data[1:],
        "format-version": data[:12] + b"\x02" + data[13:],
        "header-truncated": data[:30],
        "file-truncated": data[:-1],
        "file-truncated ": data[: place + 11] + struct.pack("<Q", 2**62) + data[place + 19 :],
        "tensor-type": data[: place + 2] + b"\x63" + data[place + 3 :],
        "tensor-repeated": data.replace(b"theta_i", b"version", 1),
    }.items():
        path.write_bytes(wrong)
        with refusal(FormatError, code.strip()):
            hp.io.read_rgl(path)


@given(st.data())
def test_no_header_crashes(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("rgl")
    original = write_tensors(folder / "paint.bsdf", rough_brdf()).read_bytes()
    changed = bytearray(original[: data.draw(st.integers(30, len(original)))])
    for _ in range(data.draw(st.integers(0, 4))):
        changed[data.draw(st.integers(0, min(len(changed), 500) - 1))] = data.draw(st.integers(0, 255))
    path = folder / "changed.bsdf"
    path.write_bytes(bytes(changed))
    with contextlib.suppress(FormatError):  # any other error fails
        hp.io.read_rgl(path)
