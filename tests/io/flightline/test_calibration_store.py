"""Calibration stores that hyperpaint wrote must be whole; those of others are in test_any_zarr."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import FormatError
from hyperpaint.io.flightline.calibration_store import open_calibration


@pytest.fixture
def calibration() -> xr.Dataset:
    gain = np.linspace(1e-10, 2e-10, 12, dtype=np.float32).reshape(3, 4)
    return xr.Dataset(
        {"radiance_gain": (("band", "cross_track"), gain, {"units": "W m-2 sr-1 nm-1 s count-1"})},
        {
            "wavelength": ("band", [500.0, 550.0, 600.0], {"units": "nm"}),
            "fwhm": ("band", [6.0, 6.0, 6.0], {"units": "nm"}),
        },
        {"srf_shape": "slit"},
    )


def _chunk_lost(group: Path) -> None:
    shutil.rmtree(group / "radiance_gain" / "c")


def _array_lost(group: Path) -> None:
    shutil.rmtree(group / "fwhm")


def _attributes_changed(group: Path) -> None:
    document = json.loads((group / "zarr.json").read_text())
    document["attributes"]["srf_shape"] = "gaussian"
    (group / "zarr.json").write_text(json.dumps(document))


def _chunk_damaged(group: Path) -> None:
    chunk = group / "fwhm/c/0"
    chunk.write_bytes(chunk.read_bytes()[:-1])


@pytest.mark.parametrize("where", [None, "calibration"])
@pytest.mark.parametrize("damage", [_chunk_lost, _array_lost, _attributes_changed, _chunk_damaged])
def test_what_we_wrote_must_be_whole(
    damage: Callable[[Path], None], where: str | None, calibration: xr.Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "cal.zarr"
    hp.to_store(calibration, path, where)
    np.testing.assert_array_equal(open_calibration(path).radiance_gain, calibration.radiance_gain)
    damage(path / (where or ""))
    with pytest.raises(FormatError, match="file-unreadable"):
        open_calibration(path)
