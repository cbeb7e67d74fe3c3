"""xarray's entry point to our readers.

xarray loads this module at any user's first `open_dataset`: it imports nothing but xarray.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from xarray.backends import BackendEntrypoint

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["EnviBackendEntrypoint"]

# a file with another suffix is taken for ENVI data only if "name.suffix.hdr" lies beside it
_DATA_SUFFIXES = ("", ".img", ".dat", ".raw", ".bil", ".bip", ".bsq")


class EnviBackendEntrypoint(BackendEntrypoint):
    """Opens ENVI cubes lazily: ``xr.open_dataset("raw_0.hdr")``, or with ``engine="envi"``.

    See `hyperpaint.io.envi.envi_cubes.open_envi` for what is returned.
    """

    description: ClassVar[str] = "ENVI cubes (.hdr and data file) through hyperpaint"
    open_dataset_parameters: ClassVar[tuple[str, ...]] = (
        "filename_or_obj",
        "drop_variables",
        "keep_whole_lines",
    )

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Tell whether this is an ENVI header, or a data file that has one beside it."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        path = Path(os.fsdecode(filename_or_obj))
        if path.suffix.lower() == ".hdr":
            return _is_envi_header(path)
        try:
            if not path.is_file():
                return False
        except (OSError, ValueError):
            return False
        beside = [Path(f"{path}{suffix}") for suffix in (".hdr", ".HDR")]
        if path.suffix.lower() in _DATA_SUFFIXES:
            beside += [path.with_suffix(suffix) for suffix in (".hdr", ".HDR")]
        return any(_is_envi_header(header) for header in beside)

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        keep_whole_lines: bool = False,
    ) -> xr.Dataset:
        """Open an ENVI cube lazily.

        Parameters
        ----------
        filename_or_obj
            Path of the header or of the data file.
        drop_variables
            Names left out of the dataset.
        keep_whole_lines
            Open recordings that were cut short; see `hyperpaint.io.envi.envi_cubes.open_envi`.

        Raises
        ------
        FormatError
            The header is damaged, contradicts itself or does not fit the size of the data file.
        FileNotFoundError
            There is no such file.
        """
        from .envi.envi_cubes import open_envi

        dataset = open_envi(filename_or_obj, keep_whole_lines=keep_whole_lines)
        if drop_variables is None:
            return dataset
        dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables)
        return dataset.drop_vars(dropped, errors="ignore")


def _is_envi_header(path: Path) -> bool:
    try:
        if not path.is_file():  # a pipe would wait
            return False
        with open(path, "rb") as file:
            return file.read(7).removeprefix(b"\xef\xbb\xbf").startswith(b"ENVI")
    except (OSError, ValueError):
        return False
