"""Irradiance series in files (comma-separated values, Zarr, netCDF), and default widths."""

from __future__ import annotations

import datetime as dt
import math
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, IncompleteStoreError, PaintWarning
from hyperpaint.base.input_files import input_path
from hyperpaint.io.files.reading import load_netcdf, number, numbered_lines, numbers, read_limited_text
from hyperpaint.io.store import list_groups, load_group
from hyperpaint.io.store.reader import is_zarr

#: Spectral resolution of ASD instruments [nm], as the maker states it for 700 nm and for 1400 to 2100 nm.
ASD_FWHM_NM, ASD_SWIR_FWHM_NM = 3.0, 10.0
#: Last wavelength of the silicon detector [nm], of instruments with a further detector and without.
_ASD_SPLICE_NM, _ASD_VNIR_END_NM = 1000.0, 1100.0

_MAX_BYTES = 2**29
#: Largest number of values in a file: three hours of an ASD instrument with one spectrum per second.
_MAX_VALUES = 24_000_000

_MAX_TIME_S = 7.2e9  # [s since 1970], the year 2198
_YEARS = range(1970, 2200)  # datetime64[ns] overflows silently from 2262 on


@dataclass(frozen=True, eq=False)
class IrradianceTable:
    """Content of one csv file."""

    name: str  # file name without its folder
    times: tuple[dt.datetime, ...]  # (sample), with a zone where the file gives one
    lines: tuple[int, ...]  # (sample), line numbers in the file
    wavelength: npt.NDArray[np.float64]  # (wavelength) [nm]
    values: npt.NDArray[np.float64]  # (sample, wavelength), NaN where a cell is empty
    units: str | None  # from a comment, or None
    fwhm_nm: float | None  # from a comment, or None


def is_irradiance_csv(head: bytes) -> bool:
    """Return whether the first bytes of a file are an irradiance table."""
    lines = head.decode("utf-8-sig", "replace").splitlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return first.split(",")[0].strip().strip('"').lower() == "time"


def read_irradiance_csv(path: str | os.PathLike[str]) -> IrradianceTable:
    r"""Read an irradiance series from comma-separated values.

    The file contains comments ``# units: W m-2 nm-1`` and ``# fwhm_nm: 3`` (both optional), a header of
    ``time`` and the wavelengths in nanometres, and one row for each sample: an ISO 8601 stamp and the values.
    Either all stamps have a zone (``2024-05-21T12:00:00.5Z``), or none has.

    Returns IrradianceTable: Values (sample, wavelength), and units and spectral width from the comments.
    Raises FormatError: The file cannot be read, or its header or a row deviates from this.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "sky.csv")
    >>> _ = path.write_text("# units: W m-2 nm-1\ntime,550,551\n2024-05-21T12:00:00Z,0.89,0.9\n")
    >>> table = read_irradiance_csv(path)
    >>> table.units, table.values
    ('W m-2 nm-1', array([[0.89, 0.9 ]]))
    """
    path = Path(path)
    name = path.name
    data = read_limited_text(path, _MAX_BYTES, "an irradiance series (a longer one fits Zarr)")
    if (comma_count := data.count(b",")) > _MAX_VALUES:
        raise FormatError(
            f"{path}: {comma_count} values",
            expected=f"at most {_MAX_VALUES}",
            mend="split it into several files, or convert it to Zarr",
            code="file-too-large",
        )
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").decode("utf-8-sig", errors="replace")
    del data  # to free memory
    comments: dict[str, str] = {}
    # the text is split row by row, to save memory
    rows = (
        (line_number, [cell.strip().strip('"') for cell in line.strip().split(",")])
        for line_number, line in _rows_without_comments(text, comments)
    )
    _, header = next(rows, (0, [""]))
    if header[0].lower() != "time":
        raise FormatError(
            f"{name}: no header 'time,<wavelength>,...'",
            expected="an irradiance series",
            code="format-unknown",
        )
    wavelength = np.array(numbers(header[1:]) or [], np.float64)
    if not (wavelength.size and wavelength[0] > 0 and np.all(np.diff(wavelength) > 0)):
        raise FormatError(
            f"{name}: the header is 'time,{','.join(header[1:])[:60]}'",
            expected="'time' and increasing positive wavelengths [nm]",
            code="header-unreadable",
        )
    times, lines = [], []
    values = np.empty((comma_count // len(wavelength) + 1, len(wavelength)))
    for index, (line_number, cells) in enumerate(rows):
        try:
            time = dt.datetime.fromisoformat(cells[0])
            if time.year not in _YEARS:
                raise ValueError(f"the year {time.year} lies outside {_YEARS.start} to {_YEARS.stop - 1}")
            if len(cells) != len(wavelength) + 1:
                raise ValueError(f"{len(cells) - 1} values")
            values[index] = [float(cell) if cell else math.nan for cell in cells[1:]]
        except (ValueError, OverflowError) as error:
            raise FormatError(
                f"{name}: line {line_number} is unreadable ({error})",
                expected=f"an ISO 8601 time such as 2024-05-21T12:00:00Z and {len(wavelength)} numbers",
                code="row-unreadable",
            ) from error
        lines.append(line_number)
        times.append(time)
    if not times:
        raise FormatError(
            f"{name}: no rows", expected=f"a time and {len(wavelength)} values in each", code="table-missing"
        )
    if len({time.tzinfo is None for time in times}) > 1:
        raise FormatError(
            f"{name}: some stamps have a zone and some have not",
            mend="write a zone in all stamps, or in none",
            code="zone-missing",
        )
    width = number(comments.get("fwhm_nm", ""))
    if "fwhm_nm" in comments and (width is None or not width > 0):
        raise FormatError(
            f"{name}: '# fwhm_nm: {comments['fwhm_nm'][:40]}'",
            expected="a positive number",
            code="number-unreadable",
        )
    return IrradianceTable(
        name,
        tuple(times),
        tuple(lines),
        wavelength,
        values[: len(times)],
        comments.get("units"),
        width if "fwhm_nm" in comments else None,
    )


def _rows_without_comments(text: str, comments: dict[str, str]) -> Iterator[tuple[int, str]]:
    # Yield number and text of each line that is not a comment; add comments on the way to ``comments``.
    for line_number, line in numbered_lines(text):
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            comments[key.strip().lower()] = value.strip()
        elif line.strip():
            yield line_number, line


_SUFFIXES = (".nc", ".nc4", ".h5")


def is_store(path: Any) -> bool:
    """Return whether a path or store object is Zarr or netCDF, by its name or content."""
    is_name = isinstance(path, str | os.PathLike)
    return is_zarr(path) or (is_name and os.fspath(path).lower().endswith(_SUFFIXES))


def stored_series(path: Any) -> xr.Dataset:
    """Return the dataset with the series: the root of the store, or a collect's group ``irradiance``."""
    try:
        if not is_zarr(path):
            return _series_of_hypernets(load_netcdf(input_path(path, "an irradiance series")))
        return _series_of_hypernets(
            load_group(path, "irradiance" if "irradiance" in list_groups(path) else None)
        )
    except IncompleteStoreError:
        raise
    except Exception as error:  # damaged files make h5py and xarray raise errors of many classes
        raise FormatError(
            f"{path}: no readable Zarr or netCDF store ({type(error).__name__}: {error!s:.400})",
            code="file-unreadable",
        ) from error


def _series_of_hypernets(data: xr.Dataset) -> xr.Dataset:
    # Return an irradiance product of HYPERNETS (L1A to L1C) as a series, and other data unchanged.
    # Its dims are ``wavelength`` and ``scan`` or ``series``; ``acquisition_time`` counts seconds of UTC from
    # 1970, and ``bandwidth`` [nm] is the width at half maximum (hypernets_processor, variables of its data
    # format).
    dim = next((name for name in ("series", "scan") if name in data.dims), None)
    if dim is None or not {"irradiance", "acquisition_time", "wavelength"} <= set(data.variables):
        return data
    stamps = data["acquisition_time"].values
    if stamps.dtype.kind != "M":
        count = stamps / np.timedelta64(1, "s") if stamps.dtype.kind == "m" else stamps.astype(np.float64)
        if (np.abs(count) > _MAX_TIME_S).any():
            raise FormatError(
                "'acquisition_time' is out of range", expected="seconds from 1970", code="time-unreadable"
            )
        nanoseconds = np.where(np.isfinite(count), count * 1e9, 0.0).round().astype(np.int64)
        stamps = np.where(
            np.isfinite(count), nanoseconds.astype("datetime64[ns]"), np.datetime64("NaT", "ns")
        )
    is_good = ~np.isnat(stamps)
    if "quality_flag" in data.variables:
        is_good &= data["quality_flag"].values == 0
    if not is_good.all():
        text = (
            f"{np.sum(~is_good)} of {is_good.size} spectra have no time or a quality flag, and are left out"
        )
        warnings.warn(PaintWarning(text, code="samples-flagged"), stacklevel=2)
    data, time = data.isel({dim: is_good}), stamps[is_good].astype("datetime64[ns]")
    series: xr.Dataset = data[["irradiance"]].reset_coords(drop=True)
    series = series.assign_coords(time=(dim, time), wavelength=data["wavelength"]).swap_dims({dim: "time"})
    if "bandwidth" in data.variables:
        series["irradiance_fwhm"] = data["bandwidth"].reset_coords(drop=True).assign_attrs(units="nm")
    return series.sortby("time")


def are_widths(value: Any) -> bool:
    """Return whether a value is a positive number, or pairs (n, 2) of wavelength and width."""
    try:
        widths = np.asarray(value, np.float64)
    except (TypeError, ValueError):  # pairs of unlike lengths
        return False
    if not (np.isfinite(widths).all() and (widths > 0).all()):
        return False
    is_pairs = widths.ndim == 2 and widths.shape[1] == 2 and bool((np.diff(widths[:, 0]) > 0).all())
    return widths.ndim == 0 or is_pairs


def widths_at(wavelength: Floats, widths: Any) -> Any:
    """Return widths [nm] at wavelengths, from pairs (n, 2) of wavelength and width; a number unchanged."""
    pairs = np.asarray(widths, np.float64)
    return np.interp(wavelength, pairs[:, 0], pairs[:, 1]) if pairs.ndim == 2 else pairs


def asd_widths(wavelength: Floats) -> tuple[Floats | float, str]:
    """Return the widths assumed for an ASD instrument [nm], and the text of the assumption."""
    text = f"assumed: {ASD_FWHM_NM:g} nm, the resolution of ASD instruments at 700 nm"
    if wavelength.max() <= _ASD_VNIR_END_NM:
        return ASD_FWHM_NM, text
    swir_text = f"; {ASD_SWIR_FWHM_NM:g} nm beyond {_ASD_SPLICE_NM:g} nm, of their other detectors"
    return np.where(wavelength <= _ASD_SPLICE_NM, ASD_FWHM_NM, ASD_SWIR_FWHM_NM), text + swir_text
