"""Paint libraries written as ENVI spectral libraries, with their metadata beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import BAND, PAINT
from hyperpaint.io.envi.envi_header import MAX_LIBRARY_HEADER_BYTES
from hyperpaint.io.files.publishing import published_files

from .envi_names import MARK, header_names, record_name
from .metadata import metadata_path, metadata_text
from .records import blocks_of, names_of, spectral_variables

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["write_envi_library"]


def write_envi_library(
    library: xr.Dataset, path: Path, *, overwrite: bool, progress: Callable[[int, int], None] | None
) -> None:
    """Write a checked library to ``path`` (``.sli``), its header and its metadata beside it.

    Raises
    ------
    SchemaError
        Names or metadata cannot be written, or the header would be larger than what is read.
    StoreError
        Files exist, or cannot be written.
    """
    data = path.with_suffix(".sli")
    variables = spectral_variables(library)
    names = header_names(names_of(library))
    metadata = metadata_text(library, variables)
    total = len(variables) * len(names)
    records: list[str] = []
    targets = [data, metadata_path(data), data.with_suffix(".hdr")]
    with published_files(targets, overwrite=overwrite) as (values_file, metadata_file, header_file):
        with open(values_file, "wb") as file:
            for block in blocks_of(library, variables):
                np.asarray(block.values, "<f4").tofile(file)
                places = zip(block.paint.tolist(), block.inner.tolist(), strict=True)
                records += [record_name(names[paint], block.variable, inner) for paint, inner in places]
                if progress is not None and block.paint.size:
                    progress(variables.index(block.variable) * len(names) + int(block.paint[-1]) + 1, total)
        header_file.write_bytes(_header(library, records))
        metadata_file.write_bytes(metadata.encode())
    if progress is not None:
        progress(total, total)


def _header(library: xr.Dataset, records: Sequence[str]) -> bytes:
    lists = {"wavelength": [repr(float(value)) for value in library["wavelength"].values]}
    # a header holds finite numbers only; what is unknown stays in the metadata
    if "fwhm" in library.variables and np.isfinite(library["fwhm"].values).all():
        lists["fwhm"] = [repr(float(value)) for value in library["fwhm"].values]
    if "good" in library.variables:
        lists["bbl"] = ["1" if value else "0" for value in library["good"].values]
    lists["spectra names"] = list(records)
    lines = [
        "ENVI",
        f"description = {{Paint library of hyperpaint: {library.sizes[PAINT]} paints}}",
        f"samples = {library.sizes[BAND]}",
        f"lines = {len(records)}",
        "bands = 1",
        "header offset = 0",
        "file type = ENVI Spectral Library",
        "data type = 4",
        "interleave = bsq",
        "sensor type = Unknown",
        "byte order = 0",
        "wavelength units = Nanometers",
        "reflectance scale factor = 1.0",
        "z plot titles = {Wavelength (nm), Reflectance}",
        f"{MARK} = 1",
        *(f"{key} = {{\n {_wrapped(values)}}}" for key, values in lists.items()),
    ]
    text = ("\n".join(lines) + "\n").encode()
    if len(text) > MAX_LIBRARY_HEADER_BYTES:
        raise SchemaError(
            f"the header would take {len(text)} bytes for {len(records)} spectra, at most "
            f"{MAX_LIBRARY_HEADER_BYTES} are read again; shorten names, write fewer members, or write Zarr"
        )
    return text


def _wrapped(values: Sequence[str]) -> str:
    """Return a list as ENVI writes it, some values a line."""
    rows = (", ".join(values[at : at + 8]) for at in range(0, len(values), 8))
    return ",\n ".join(rows)
