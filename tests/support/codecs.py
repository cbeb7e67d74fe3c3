"""Zarr stores of other programs, in codecs that hyperpaint reads; and a damaged chunk."""

from pathlib import Path
from typing import Any

import xarray as xr
from zarr.codecs import BloscCodec


def plain_zarr(dataset: xr.Dataset, path: Path | str, group: str | None = None) -> None:
    # Write a dataset with plain xarray, compressed with blosc
    encoding: dict[Any, dict[str, Any]] = {
        name: {"compressors": [BloscCodec()]} for name in dataset.variables
    }
    dataset.to_zarr(path, group=group, mode="w", zarr_format=3, consolidated=False, encoding=encoding)


def flip(path: Path) -> None:
    # Change one bit in the middle of a file
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
