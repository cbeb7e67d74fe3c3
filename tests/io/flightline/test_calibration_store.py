"""Calibration stores: what hyperpaint wrote must be whole, what others wrote is taken as it is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr

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


def _record_lost(group: Path) -> None:
    (group / "fwhm" / "hyperpaint-chunks.json").unlink()


def _seal_lost(group: Path) -> None:
    document = json.loads((group / "zarr.json").read_text())
    del document["attributes"]["hyperpaint_complete"]
    (group / "zarr.json").write_text(json.dumps(document))


@pytest.mark.parametrize("where", [None, "calibration"])
@pytest.mark.parametrize("damage", [_chunk_lost, _array_lost, _record_lost, _seal_lost])
def test_what_we_wrote_must_be_whole(
    damage: Callable[[Path], None], where: str | None, calibration: xr.Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "cal.zarr"
    hp.to_store(calibration, path, where)
    np.testing.assert_array_equal(open_calibration(path).radiance_gain, calibration.radiance_gain)
    damage(path / (where or ""))
    with pytest.raises(FormatError, match=r"not a readable Zarr store .*(_gain|fwhm|finished|arrays)"):
        open_calibration(path)


def test_what_others_wrote_has_no_record(calibration: xr.Dataset, tmp_path: Path) -> None:
    plain_zarr(calibration, tmp_path / "cal.zarr")
    assert open_calibration(tmp_path / "cal.zarr").attrs["srf_shape"] == "slit"
