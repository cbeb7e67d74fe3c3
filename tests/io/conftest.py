"""Writers of instrument files, independent of the package's readers and simulator."""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def asd_bytes(
    spectrum: Any,
    *,
    version: int = 7,
    dtype: str = "<f8",
    data_type: int = 0,
    local: dt.datetime = dt.datetime(2024, 5, 21, 11, 33, 7),
    first: float = 350.0,
    step: float = 1.0,
    reference: Any = None,
    reference_epoch: int = 0,
    utc_offset_h: float = 0.0,
    integration_ms: int = 136,
    averages: int = 1,
    splices: tuple[float, float] = (1000.0, 1800.0),
    dark_subtracted: bool = True,
    saturation: int = 0,
    gps: bytes = bytes(56),
    blocks: Mapping[int, tuple[int, Any]] | None = None,
    labels: tuple[str, ...] = (),
    audit: tuple[str, ...] = (),
    trailer: bytes = b"",
    fore_optic: int = 180,
) -> bytes:
    # Return an ``.asd`` file, written field by field from the table of the format's description
    values = np.asarray(spectrum).astype(dtype)
    n = len(values)
    out = b"ASD" if version == 1 else b"as%d" % version
    out += b"a comment".ljust(157, b"\0")
    tm = local.timetuple()
    out += struct.pack(
        "<9h",
        local.second,
        local.minute,
        local.hour,
        local.day,
        local.month - 1,
        local.year - 1900,
        0,
        tm.tm_yday,
        0,
    )
    out += bytes([0x56, 0x10 * version, 0, dark_subtracted]) + struct.pack("<i", 0)
    out += bytes([data_type]) + struct.pack("<iff", reference_epoch, first, step)
    out += bytes([{"<f4": 0, "<i4": 1, "<f8": 2}[dtype], 0, 0, 0, 0]) + struct.pack("<H", n)
    out += bytes(128) + gps + struct.pack("<IhhHH", integration_ms, fore_optic, 0, 4, 6355)
    out += struct.pack("<4fHB", 0, 2.5, first, first + step * (n - 1), 16, 0)
    out += bytes([0, saturation, 0, 0]) + struct.pack("<3HBI", 10, 10, averages, 4, 0)
    out += struct.pack("<4H2f", 31, 16, 2051, 2069, *splices) + bytes(27 + 5)
    assert len(out) == 484
    out += values.tobytes()
    if version >= 2:
        ole = 25569 + (reference_epoch + utc_offset_h * 3600) / 86400 if reference_epoch else 0.0
        out += struct.pack("<Hdd", 0xFFFF if reference is not None else 0, ole, 45433.48)
        out += _text("white")
        out += (values * 0 if reference is None else np.asarray(reference).astype(dtype)).tobytes()
    if version >= 6:
        out += bytes(2 + 20 * 2 + 2 + 2)
    if version >= 7:
        out += struct.pack("<hh", 0, len(labels)) + _safe_array([_text(label) for label in labels])
        out += _safe_array([struct.pack("<f", 1.5) for _ in labels])
        blocks = blocks or {}
        out += bytes([len(blocks)])
        for kind, (milliseconds, _) in blocks.items():
            out += struct.pack("<b20sihh", kind, b"block.ref", milliseconds, 31, 16)
        for _, block in blocks.values():
            out += np.asarray(block).astype("<f8").tobytes()
    if version >= 8:
        out += struct.pack("<i", len(audit)) + _safe_array([_text(event) for event in audit])
        out += struct.pack("<Bq", 0, 0) + 7 * _text("") + bytes(128)
    return out + trailer


def _text(text: str) -> bytes:
    return struct.pack("<H", len(text)) + text.encode("latin-1")


def _safe_array(items: list[bytes]) -> bytes:
    return struct.pack("<HIi", 1, len(items), 0) + b"".join(items) if items else struct.pack("<H", 0)


@pytest.fixture
def write_asd(tmp_path: Path) -> Callable[..., Path]:
    # Return a function that writes ``name`` into the test's folder with what `asd_bytes` takes
    def write(name: str, spectrum: Any, **fields: Any) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(asd_bytes(spectrum, **fields))
        return path

    return write
