"""Counts, and the folder of a flight of one cube, its dark cube and navigation."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.headwall_flights import BANDS, COLUMNS, LINES, write_cube, write_index, write_nav


@pytest.fixture
def counts() -> np.ndarray[Any, Any]:
    return np.random.default_rng(5).integers(100, 4000, (LINES, BANDS, COLUMNS)).astype(np.uint16)


@pytest.fixture
def folder(tmp_path: Path, counts: np.ndarray[Any, Any]) -> Path:
    # A flight of one cube, its dark cube and navigation
    flight = tmp_path / "flight"
    write_cube(flight, "raw_0", counts, ";Exposure (ms) = 5\n;Serial Number = G4-426\n")
    (flight / "settings.txt").write_bytes(b"Exposure (ms) = 5.0\r\n")
    write_index(flight / "frameIndex_0.txt", np.arange(LINES))
    write_nav(flight / "imu_gps.txt")
    dark = np.random.default_rng(6).poisson(100, (40, BANDS, COLUMNS)).astype(np.uint16)
    write_cube(tmp_path / "dark", "raw_0", dark)
    (tmp_path / "dark" / "settings.txt").write_text("Exposure (ms) = 5\n")
    return tmp_path
