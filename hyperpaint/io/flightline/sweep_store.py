"""Lab sweeps: stores of what the camera counted while a monochromator stepped through the spectrum."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import FormatError
from hyperpaint.base.schema import STEP, SWEEP_VARIABLES
from hyperpaint.io.files.reading import load_netcdf

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["open_sweep"]


def open_sweep(path: str | os.PathLike[str], *, group: str | None = None) -> xr.Dataset:
    """Open a lab sweep, lazily where it is a Zarr store; what it must hold is checked when it is calibrated.

    Parameters
    ----------
    path
        A Zarr store or netCDF file with the rows of `hyperpaint.base.schema.SWEEP_VARIABLES`.
    group
        Group of the store that holds them; by default the root.

    Returns
    -------
    xarray.Dataset
        Variables of the table; others, such as the truth of a simulated sweep, are left behind.

    Raises
    ------
    FormatError
        It cannot be read, or holds no counts of steps.
    """
    from hyperpaint.io.store import open_unverified

    path = Path(path)
    if not path.exists():
        raise FormatError(f"{path}: no such sweep; expected a Zarr store or a netCDF file")
    try:
        # counts change from step to step only along one dim: a chunk of steps is all that is in memory
        opened = open_unverified(path, group, chunks={}) if path.is_dir() else load_netcdf(path, group)
    except Exception as error:  # zarr, codecs, numpy and the netCDF engines each have their own
        raise FormatError(
            f"{path}: not a readable Zarr store or netCDF file ({type(error).__name__}: {error!s:.200})"
        ) from error
    if "counts" not in opened.variables or STEP not in opened["counts"].dims:
        held = ", ".join(sorted(map(str, opened.variables))[:8]) or "nothing"
        raise FormatError(f"{path}: no lab sweep: expected 'counts' (step, band, cross_track), found {held}")
    names = [name for name in SWEEP_VARIABLES if name in opened.variables]
    return opened[names].reset_coords(drop=True) if not set(names) & set(opened.coords) else opened[names]
