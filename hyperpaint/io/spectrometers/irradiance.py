"""The record of a sky-pointing spectrometer as one series in UTC: spectra, csv files, Zarr or netCDF."""

import datetime as dt
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import xarray as xr

from hyperpaint.base import (
    DULL_MEDIAN,
    HIGHEST_MEDIAN,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    LOWEST_MEDIAN,
    MID_EXPOSURE_OFFSETS,
    VARIABLES,
    Bools,
    Floats,
    FormatError,
    IncompleteStoreError,
    Problem,
    Problems,
    SchemaError,
    TimeError,
    Times,
    UnitsError,
    as_path,
    brightest_median,
    conversion_factor,
    convert,
    input_path,
    is_number,
    label,
    listed,
    one_of,
    require,
    takes_quantities,
    unit_slip,
    warn_if,
)
from hyperpaint.io.files.reading import (
    decoded_text,
    load_netcdf,
    number,
    numbered_lines,
    read_limited_text,
    refuse,
)
from hyperpaint.io.navigation.navigation_records import GPS_EPOCH, gps_to_utc
from hyperpaint.io.store import is_zarr, list_groups, load_group

from .asd import NETCDF_NAME, Spectrum, find_files, mask_undefined, read_spectra, sniff, utc_offsets
from .record_faults import FAULTS_ATTR, judge_record, warn_of_faults
from .spectrum_texts import (
    NM_HEADING,
    TIME_HEADING,
    LocalStamp,
    Paths,
    check_utc_offset,
    for_all,
    heading_cells,
    orders_of,
    read_stamp,
)

Stamp = Literal["start", "mid", "end"]

#: Names of the dims of a series, in order of preference.
_AXES = ((IRRADIANCE_TIME, "time"), (IRRADIANCE_WAVELENGTH, "wavelength"))
_SHAPE = "irradiance_srf_shape"
_GAP_INTERVALS = 2.5
_LINE_MARGIN = np.timedelta64(60, "s")
#: Wavelengths of sunlight, and resolutions of spectrometers [nm].
_SUNLIGHT_RANGE_NM, _FWHM_RANGE_NM = (200.0, 2600.0), (0.02, 100.0)
#: Difference of stamps and GPS time in the files that is told [s]: saving a spectrum takes seconds.
_GPS_TOLERANCE_S = 20.0
#: Largest number of sample pairs in a message.
_MAX_SHOWN = 20

#: Spectral resolution of ASD instruments [nm], as the maker states it for 700 nm and for 1400 to 2100 nm.
ASD_FWHM_NM, ASD_SWIR_FWHM_NM = 3.0, 10.0
#: Last wavelength of the silicon detector [nm], of instruments with a further detector and without.
_ASD_SPLICE_NM, _ASD_VNIR_END_NM = 1000.0, 1100.0


# --- csv files ---------------------------------------------------------------------------------------------


_MAX_BYTES = 2**29
#: Largest number of values in a file: three hours of an ASD instrument with one spectrum per second.
_MAX_VALUES = 24_000_000
_EPOCH = re.compile(r"(\d{9,10}|\d{12,13})(?:[.,]\d{1,9})?")  # seconds or milliseconds since 1970
# Comments that are read; another value of a key is refused
_KEYS = ("units", "fwhm_nm", "quantity", "time_scale")
_OTHER_QUANTITY = re.compile(r"\bupwelling|(?<!ir)radiance|reflect|\bcounts\b", re.IGNORECASE)
#: Zone in the heading of the times, such as ``UTC`` or ``GMT+2``.
_ZONE = re.compile(
    r"(?:utc|gmt)(?:\s*([+\-\u2212\u2013])\s*(1[0-4]|0?[0-9])(?!\d)(?::?([0-5][0-9]))?|(?!\s*[+\-\u2212\u2013]\s*\d))"
)
_YEARS = range(1970, 2200)  # datetime64[ns] overflows silently from 2262 on


#: Words before a wavelength, such as ``E_350``.
_OF_IRRADIANCE = re.compile(r"^(?:E[ds]?|irradiance|wl)[ _]+(?=\d)", re.IGNORECASE)
#: Headings of columns that are no irradiance.
_HOUSEKEEPING = re.compile(r"temp|humid|volt|batt|tilt|pressure|record|status", re.IGNORECASE)
#: Cells of a row of units.
_UNIT_CELL = re.compile(r"[Ww].*\bm|mol.*\bm")


class IrradianceTable(NamedTuple):
    # Content of one csv file.
    name: str  # file name without its folder
    times: tuple[dt.datetime, ...]  # (sample), with a zone where the file gives one
    lines: tuple[int, ...]  # (sample), line numbers in the file
    wavelength: Floats  # (wavelength) [nm]
    values: Floats  # (sample, wavelength), NaN where a cell is empty
    units: str | None  # from a comment, or None
    fwhm_nm: float | None  # from a comment, or None


def read_irradiance_csv(path: str | os.PathLike[str]) -> IrradianceTable:
    r"""Read an irradiance series from the csv of a logger.

    The file contains comments ``# units: W m-2 nm-1`` and ``# fwhm_nm: 3`` (both optional), a header of
    ``time`` (``timestamp``, ``date,time``, ``time (UTC)`` ...) and the wavelengths in nanometres (``350``,
    ``350nm``, ``E_350``; rising or falling), and one row for each sample: a stamp and the values, separated
    by commas, semicolons or tabs; with semicolons and tabs also with decimal commas. A stamp is ISO 8601,
    seconds since 1970, or a date such as ``06/13/2024 10:00:00 AM`` or ``13.06.2024 10:00:00``; dates with
    slashes need one in the file that is valid in one order alone. A first column without a heading is
    the time or, before it, an index of pandas. Stamps without a zone have that of the
    heading (``time (UTC+2)``); those of ``gps_time`` are GPS time. A row of units may follow the header;
    columns of temperature and the like are left out with a warning. Either all stamps have a zone
    (``2024-05-21T12:00:00.5Z``), or none has.

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
    path = as_path(path)
    name = path.name
    data = read_limited_text(path, _MAX_BYTES, "an irradiance series (a longer one fits Zarr)")
    counts = {separator: data.count(separator.encode()) for separator in ",;\t"}
    refuse(
        str(path),
        (
            max(counts.values()) > _MAX_VALUES,
            Problem(
                f"{max(counts.values())} values",
                expected=f"at most {_MAX_VALUES}",
                mend="split it into several files, or convert it to Zarr",
                code="file-too-large",
            ),
        ),
    )
    text = decoded_text(data).replace("\r\n", "\n").replace("\r", "\n")
    del data  # to free memory
    comments: dict[str, str] = {}

    def lines() -> Iterator[tuple[int, str]]:
        # the text is split row by row, to save memory
        for line_number, line in numbered_lines(text):
            if line.startswith("#"):
                key, _, value = (part.strip() for part in line[1:].rstrip(",; \t").partition(":"))
                FormatError.raise_if(
                    key.lower() in _KEYS and comments.setdefault(key.lower(), value) != value,
                    f"{name}: line {line_number} says {key} {value[:40]!r}, a line before "
                    f"{comments.get(key.lower(), '')[:40]!r}",
                    mend="delete the wrong one",
                    code="key-repeated",
                )
            elif line.strip():
                yield line_number, line.strip(" ")

    rows = lines()
    separator, header = heading_cells(next(rows, (0, ""))[1])
    while len(header) > 1 and not header[-1]:  # every line ends with separators
        header.pop()
    # an index of pandas is the time, or stands before it
    start = int(not header[0] and any(map(TIME_HEADING.fullmatch, header[1:2])))
    header = ["time", *header[1:]] if header[1:] and not header[0] else header
    # one column of times, or a date and a time
    time_columns = 1 + sum(TIME_HEADING.fullmatch(cell) is not None for cell in header[1 : 2 + start])
    headings = [NM_HEADING.fullmatch(_OF_IRRADIANCE.sub("", cell)) for cell in header]
    # a logger may write its temperature beside the time: columns whose headings are words
    columns = [at for at in range(time_columns, len(header)) if _HOUSEKEEPING.search(header[at]) is None]
    unreadable = [at for at in columns if headings[at] is None]
    nm = [float(h[1].replace(",", ".")) for at in columns if not unreadable and (h := headings[at])]
    if len(nm) > 1 and all(after < before for before, after in pairwise(nm)):
        columns, nm = columns[::-1], nm[::-1]
    wavelength = np.array(nm, np.float64)
    refuse(
        name,
        (
            not TIME_HEADING.fullmatch(header[0]),
            Problem(
                "no header 'time,<wavelength>,...'",
                expected="an irradiance series",
                code="format-unknown",
            ),
        ),
        (
            not (wavelength.size and wavelength[0] > 0 and np.all(np.diff(wavelength) > 0)),
            Problem(
                f"the header is '{','.join(header)[:60]}'"
                + "".join(f"; {header[at]!r:.40} is no wavelength" for at in unreadable[:1]),
                expected="'time' and increasing positive wavelengths [nm]",
                code="header-unreadable",
            ),
        ),
    )
    left_out = [header[at] for at in range(time_columns, len(header)) if at not in columns]
    warn_if(left_out, f"{name}: columns {', '.join(left_out)} are left out", "column-unknown")
    first_row = next(rows, None)
    heading = " ".join(header[start:time_columns]).lower()
    if first_row is not None:
        units = [cell.strip().strip('"') for cell in first_row[1].split(separator)]
        is_stamp = re.search(r"\d", "".join(units[:time_columns]))
        if not is_stamp and len(units) == len(header) and all(_UNIT_CELL.search(units[at]) for at in columns):
            # a row of units below the names
            comments.setdefault("units", units[columns[0]])
            heading = f"{heading} {' '.join(units[:time_columns]).lower()}"
        else:
            rows = chain([first_row], rows)
    zone: dt.timezone | None = None
    if found := _ZONE.search(heading):
        offset = dt.timedelta(hours=int(found[2] or 0), minutes=int(found[3] or 0))
        is_stated = found[1] is not None or not {"not", "local"} & set(re.findall("[a-z]+", heading))
        zone = dt.timezone(offset if found[1] == "+" else -offset) if is_stated else None
    is_gps = "gps" in heading and "utc" not in heading and comments.get("time_scale", "").lower() != "utc"
    times: list[dt.datetime | LocalStamp] = []
    line_numbers = []
    values = np.empty((counts[separator] // len(wavelength) + 1, len(wavelength)))
    for index, (line_number, line) in enumerate(rows):
        cells = [cell.strip().strip('"') for cell in line.split(separator)]
        with FormatError.instead_of(
            (ValueError, OverflowError),
            f"{name}: line {line_number} is unreadable ($whole)",
            expected=f"an ISO 8601 time such as 2024-05-21T12:00:00Z and {len(wavelength)} numbers",
            code="row-unreadable",
        ):
            time = _time_of_cell(" ".join(cells[start:time_columns]), is_gps)
            while len(cells) > len(header) and not cells[-1]:
                cells.pop()
            if len(cells) != len(header):
                raise ValueError(f"{len(cells) - time_columns} values")
            if separator != ",":
                cells = [cell.replace(",", ".") for cell in cells]
            values[index] = [float(cells[at]) if cells[at] else math.nan for at in columns]
        line_numbers.append(line_number)
        times.append(time)
    # times with the zone of the heading; dates with slashes have one order in the file
    order = orders_of((name, time) for time in times if isinstance(time, LocalStamp)).get(name)
    stamps = []
    for time in times:
        local = time
        if isinstance(time, LocalStamp):
            both = sorted(f"{each:%Y-%m-%d}" for each in (time.day_first, time.month_first) if each)
            local = FormatError.raise_if_none(
                time.read(order if time.slashes else None),
                f"{name}: a date is {' or '.join(both)}",
                expected="an order of day and month that the file decides",
                mend="write ISO 8601, such as 2024-06-01T10:00:00Z",
                code="date-ambiguous",
            )
        assert isinstance(local, dt.datetime)
        stamps.append(local.replace(tzinfo=zone) if local.tzinfo is None and zone else local)
    width_text = comments.get("fwhm_nm")
    width = None if width_text is None else number(width_text)
    refuse(
        name,
        (
            not stamps,
            Problem("no rows", expected=f"a time and {len(wavelength)} values in each", code="table-missing"),
        ),
        (
            len({time.tzinfo is None for time in stamps}) > 1,
            Problem(
                "some stamps have a zone and some have not",
                mend="write a zone in all stamps, or in none",
                code="zone-missing",
            ),
        ),
        (
            _OTHER_QUANTITY.search(comments.get("quantity", "")) is not None,
            Problem(
                f"'# quantity: {comments.get('quantity', '')[:40]}'",
                expected="downwelling irradiance",
                code="quantity-wrong",
            ),
        ),
        (
            width_text is not None and not (width is not None and width > 0),
            Problem(
                f"'# fwhm_nm: {(width_text or '')[:40]}'",
                expected="a positive number",
                code="number-unreadable",
            ),
        ),
    )
    if is_gps and stamps[0].tzinfo is None:
        gps = np.array(stamps, "datetime64[ns]").astype(np.int64)
        utc = gps_to_utc(gps).astype("datetime64[ns]").astype("datetime64[us]")
        stamps = [stamp.replace(tzinfo=dt.UTC) for stamp in utc.tolist()]
    table, lines_of = values[: len(stamps)], tuple(line_numbers)
    return IrradianceTable(name, tuple(stamps), lines_of, wavelength, table, comments.get("units"), width)


def _time_of_cell(text: str, is_gps: bool) -> dt.datetime | LocalStamp:
    # Return the time of a cell; a date whose order another line may decide as it stands. Times of a GPS clock
    # have no zone.
    # Raises ValueError: The text is not a time, or lies outside `_YEARS`.
    if match := _EPOCH.fullmatch(text):
        seconds = float(match[0]) * (1e-3 if len(match[1]) > 11 else 1.0) + is_gps * GPS_EPOCH / 1e9
        return dt.datetime.fromtimestamp(seconds, dt.UTC).replace(tzinfo=None if is_gps else dt.UTC)
    try:
        time = dt.datetime.fromisoformat(f"{text[:-3].rstrip()}Z" if text.endswith("UTC") else text)
    except ValueError:
        if (stamp := read_stamp(text)) is None:
            raise
        return stamp
    if time.year not in _YEARS:
        raise ValueError(f"the year {time.year} lies outside {_YEARS.start} to {_YEARS.stop - 1}")
    return time


# --- stores ------------------------------------------------------------------------------------------------


#: An irradiance product of HYPERNETS (L1A to L1C): dims along time, and names of the variables. The time
#: counts seconds of UTC from 1970; the width is the full width at half maximum [nm]; a flag is the bit of its
#: place among ``flag_meanings`` (hypernets_processor, variables of its data format).
_HYPERNETS_DIMS = (("series",), ("scan",))
_HYPERNETS_TIME, _HYPERNETS_WIDTH, _HYPERNETS_FLAG = "acquisition_time", "bandwidth", "quality_flag"
#: Flags of scans without a GPS fix, whose spectra are good.
_POSITION_FLAGS = ("lon_default", "lat_default")
_LEFT_OUT = "irradiance_left_out"
_MAX_TIME_S = 7.2e9  # [s since 1970], the year 2198


def _stored_data(path: Any) -> xr.Dataset:
    # Return the dataset with the series: the root of the store, or a collect's group ``irradiance``.
    try:
        return (
            load_group(path, "irradiance" if "irradiance" in list_groups(path) else None)
            if is_zarr(path)
            else load_netcdf(input_path(path, "an irradiance series"))
        )
    except (FormatError, IncompleteStoreError):
        raise
    except Exception as error:  # damaged files make h5py and xarray raise errors of many classes
        raise FormatError(
            f"{path}: no readable Zarr or netCDF store ({type(error).__name__}: {error!s:.400})",
            code="file-unreadable",
        ) from error


def _hypernets_series(data: xr.Dataset, origin: str) -> xr.Dataset:
    # Return an irradiance product of HYPERNETS as a series; other data stay unchanged.
    if not (
        {"irradiance", _HYPERNETS_TIME, "wavelength"} <= set(data.variables)
        and (clock := data[_HYPERNETS_TIME]).dims in _HYPERNETS_DIMS
        and clock.dtype.kind in "Mmiuf"
        and set(clock.dims) <= set(data["irradiance"].dims)
        and data.get(_HYPERNETS_FLAG, clock).dims == clock.dims
    ):
        return data
    stamps = clock.values
    if stamps.dtype.kind != "M":
        count = stamps / np.timedelta64(1, "s") if stamps.dtype.kind == "m" else stamps.astype(np.float64)
        FormatError.raise_if(
            (np.abs(count) > _MAX_TIME_S).any(),
            f"{origin}: 'acquisition_time' is out of range",
            expected="seconds from 1970",
            code="time-unreadable",
        )
        stamps = np.nan_to_num(count * 1e9).round().astype(np.int64).astype("datetime64[ns]")
        stamps[np.isnan(count)] = np.datetime64("NaT")
    flag = data.get(_HYPERNETS_FLAG, xr.zeros_like(clock, np.int64))
    bits = {name: 1 << bit for bit, name in enumerate(str(flag.attrs.get("flag_meanings", "")).split())}
    # a filled flag (NaN) is a bit without a name
    flags = np.nan_to_num(flag.values.astype(np.float64), nan=2.0**62).astype(np.int64)
    flags &= ~sum(bits.get(name, 0) for name in _POSITION_FLAGS)
    is_good = (flags == 0) & ~np.isnat(stamps)
    names = ", ".join(name for name, bit in bits.items() if (flags & bit).any())
    found = f"{np.sum(~is_good)} of {is_good.size} spectra have no time or a quality flag"
    found += f" ({names})" if names else ""
    warn_if(not is_good.all(), f"{origin}: {found}, and are left out", "samples-flagged")
    series: xr.Dataset = (
        data[["irradiance"]]
        .reset_coords(drop=True)
        .isel({clock.dims[0]: is_good})
        .assign_coords(time=(clock.dims, stamps[is_good]), wavelength=data["wavelength"])
        .swap_dims({clock.dims[0]: "time"})
        .assign_attrs({} if is_good.any() else {_LEFT_OUT: found})
    )
    if _HYPERNETS_WIDTH in data.variables:
        series["irradiance_fwhm"] = data[_HYPERNETS_WIDTH].reset_coords(drop=True).assign_attrs(units="nm")
    return series.sortby("time")


# --- the series --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Series:
    # Samples as logged, before correction of clocks and units, or as stored.
    sources: Sequence[str]
    stamps: Times  # (sample), in the zone of utc_offset_h
    utc_offset_h: Sequence[float]  # (sample)
    averaging_s: Floats  # (sample)
    wavelength: Floats
    values: Floats  # (sample, wavelength)
    units: str
    origin: str
    fwhm: Floats | float | None = None
    fwhm_source: str = "given by the data"
    max_gap_s: float | None = None
    clock_uncertainty_s: float | None = None
    attrs: Mapping[str, Any] = field(default_factory=dict)
    clipped: Bools | None = None  # (sample, wavelength), True where raw counts were clipped
    receptor: str = ""  # Setting that contradicts a cosine receptor
    ahead_s: float = math.nan  # Median of UTC by the stamps minus the GPS time in the files


@takes_quantities(clock_offset_s="s", fwhm_nm="nm", max_gap_s="s", averaging_s="s", clock_uncertainty_s="s")
def open_irradiance(
    paths: Paths | xr.Dataset | xr.DataArray,
    quantity: str | None = None,
    *,
    utc_offset_h: float | None = None,
    clock_offset_s: float = 0.0,
    stamp: Stamp = "end",
    fwhm_nm: Any = None,
    max_gap_s: float | None = None,
    units: str | None = None,
    calibration: Mapping[str, str | os.PathLike[str]] | None = None,
    averaging_s: float | None = None,
    clock_uncertainty_s: float | None = None,
) -> xr.Dataset:
    """Open a series of downwelling irradiance spectra.

    Parameters
    ----------
    paths
        A file, a glob, a folder or a list of files: binary ``.asd`` files, text exports of ASD spectra, texts
        of other spectrometers (Spectral Evolution, Ocean Optics, Avantes, LI-180, StellarNet), or csv series
        of loggers (``time, 350nm, ...``, see `read_irradiance_csv`); or any Zarr (folder, zip file, URL or
        store object), netCDF files or an xarray object, with ``irradiance`` on a time and a wavelength dim
        (of a collect's store, the group ``irradiance``); or netCDF products of HYPERNETS, L1A to L1C.
    quantity
        ``irradiance`` states what text exports do not state. Without it, it is guessed from their plot range,
        with a warning. Binary files become irradiance through their calibration.
    utc_offset_h
        Clock of the logging PC minus UTC [h], zones only. By default from the files; csv stamps may carry
        their zone; xarray objects and HYPERNETS are in UTC.
    clock_offset_s
        Correction added to the stamps of the logging PC [s]: UTC = stamp - utc_offset_h + clock_offset_s.
    stamp
        Instant of the averaging window that a stamp marks: ``start``, ``mid`` or ``end``.
    fwhm_nm
        Full width at half maximum of the spectrometer [nm]: a number, or pairs of wavelength and width,
        linear between and constant beyond them. For ASD instruments 3 nm are assumed, and 10 nm beyond
        1000 nm where there are more detectors than the first; other files must state it.
    max_gap_s
        Longest interval [s] that may be interpolated; by default 2.5 times the median interval.
    units
        Units of the values where the data do not say. For ASD spectra W m-2 nm-1 are taken, the vendor's.
    calibration
        Calibration files of the instrument, see `hyperpaint.io.spectrometers.asd.open_asd`.
    averaging_s
        Length of the averaging window [s]. By default from the file (integration time times the spectra
        averaged), else 0.
    clock_uncertainty_s
        Largest remaining difference between the clocks of camera and spectrometer [s]. By default up to
        40 s are assumed; see `hyperpaint.light.illumination`.

    Returns
    -------
    xarray.Dataset
        ``irradiance`` (irradiance_time, irradiance_wavelength) [W m-2 nm-1] float32, in memory, ordered by
        time; ``irradiance_fwhm`` [nm], ``irradiance_max_gap`` [s] and, where it is known,
        ``irradiance_clock_uncertainty`` [s]; coordinates ``irradiance_time`` (UTC at
        the middle of each sample, datetime64[ns]) and ``irradiance_wavelength`` [nm]. The attributes name
        the assumptions. ASD stamps are whole seconds, as in the files; fractions are lost.

    Raises
    ------
    FormatError
        Files are missing or damaged, cannot give irradiance, or differ in wavelengths; all are named.
    TimeError
        The UTC offset is unknown, samples have no stamp or the same one, or a single sample has no
        ``max_gap_s``.
    UnitsError
        Units are missing or wrong, or the sun cannot have been as bright or as dim as they say.
    SchemaError
        An argument is invalid, the spectral width is unknown, an xarray object is not such a series, or too
        few scans or channels can be daylight.
    IncompleteStoreError
        The store is hyperpaint's own, and its group was never finished.

    Warns
    -----
    PaintWarning
        Stamps that differ from the GPS time in the files; saturated or undefined samples, which become NaN;
        scans and channels that cannot be daylight, which become NaN, and a step in gain (attribute
        ``irradiance_faults``), see `hyperpaint.io.spectrometers.record_faults`; and see
        `hyperpaint.io.spectrometers.asd.open_asd`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> times = np.array(["2024-05-21T12:00:02", "2024-05-21T12:00:00"], "datetime64[us]")
    >>> sky = xr.DataArray(
    ...     [[0.9, 1.0], [0.8, 0.9]],
    ...     coords={"time": times, "wavelength": ("wavelength", [500.0, 600.0], {"units": "nm"})},
    ...     dims=("time", "wavelength"),
    ...     attrs={"units": "W m-2 nm-1"},
    ... )
    >>> series = open_irradiance(sky, fwhm_nm=3.0, clock_offset_s=37.25)
    >>> series["irradiance_time"].values
    array(['2024-05-21T12:00:37.250000000', '2024-05-21T12:00:39.250000000'], dtype='datetime64[ns]')
    >>> series["irradiance"].values[:, 0]
    array([0.8, 0.9], dtype=float32)
    """
    problems = Problems("an irradiance series cannot be opened with these arguments", SchemaError)
    checks = (
        (
            quantity not in (None, "irradiance"),
            Problem(
                f"quantity={quantity!r}",
                expected="'irradiance'",
                mend="hp.open_asd opens other quantities",
                code="choice-unknown",
            ),
        ),
        (
            not is_number(clock_offset_s),
            Problem(f"clock_offset_s={clock_offset_s}", expected="seconds", code="not-finite"),
        ),
        (
            max_gap_s is not None and not (is_number(max_gap_s) and max_gap_s > 0),
            Problem(f"max_gap_s={max_gap_s}", expected="a positive number", code="value-out-of-range"),
        ),
        (
            fwhm_nm is not None and not _are_widths(fwhm_nm),
            Problem(
                f"fwhm_nm={fwhm_nm}",
                expected="a positive number, or pairs of increasing wavelength and width [nm]",
                code="value-out-of-range",
            ),
        ),
        *(
            (
                value is not None and not (is_number(value) and value >= 0),
                Problem(f"{name}={value}", expected="seconds, not negative", code="value-out-of-range"),
            )
            for name, value in (("averaging_s", averaging_s), ("clock_uncertainty_s", clock_uncertainty_s))
        ),
    )
    problems.extend(problem for is_wrong, problem in checks if is_wrong)
    one_of(stamp, MID_EXPOSURE_OFFSETS, "stamp", problems=problems)
    problems.raise_if_any()
    if isinstance(paths, xr.Dataset | xr.DataArray):
        series = _from_xarray(paths, utc_offset_h, units)
    elif is_zarr(paths):
        name = (
            os.path.basename(os.fspath(paths))
            if isinstance(paths, str | os.PathLike)
            else type(paths).__name__
        )
        series = _from_xarray(_stored_data(paths), utc_offset_h, units, name)
    elif all(map(NETCDF_NAME.search, map(str, files := find_files(paths)))):
        series = _joined([_from_xarray(_stored_data(path), utc_offset_h, units, path.name) for path in files])
    else:
        series = _from_files(files, quantity, utc_offset_h, units, calibration)
    FormatError.raise_if(
        not len(series.stamps) and _LEFT_OUT in series.attrs,
        f"{series.origin}: no spectrum is left: {series.attrs.get(_LEFT_OUT)}",
        mend="choose other files; to use flagged spectra, set 'quality_flag' to 0",
        code="samples-flagged",
    )
    window = series.averaging_s if averaging_s is None else np.full(len(series.stamps), averaging_s)
    # UTC at the middle of each sample
    shift_s = MID_EXPOSURE_OFFSETS[stamp] * window
    seconds = clock_offset_s - np.asarray(series.utc_offset_h, np.float64) * 3600.0 + shift_s
    times = series.stamps + np.rint(seconds * 1e9).astype("timedelta64[ns]")
    warn_if(
        abs(series.ahead_s + clock_offset_s) > _GPS_TOLERANCE_S,
        f"{series.origin}: the stamps are {series.ahead_s + clock_offset_s:+.0f} s from the GPS time in the "
        f"files; clock_offset_s={-series.ahead_s:.0f} would fit, if the clock of the PC was wrong",
        "clock-conflict",
    )
    order = np.argsort(times, kind="stable")
    # samples with the same time
    repeats = np.flatnonzero(np.diff(times[order]) == np.timedelta64(0, "ns"))
    problems = Problems(
        "samples of one series have the same time stamp; remove one spectrum of each pair, or write a csv "
        "series with finer stamps",
        TimeError,
    )
    for first, second in zip(order[repeats[:_MAX_SHOWN]], order[repeats[:_MAX_SHOWN] + 1], strict=True):
        is_same_spectrum = np.array_equal(series.values[first], series.values[second], equal_nan=True)
        remark = " (the same spectrum twice)" if is_same_spectrum else ""
        problems.add(
            f"{series.stamps[second]}: {series.sources[first]} and {series.sources[second]}{remark}",
            code="time-duplicate",
        )
    problems.raise_if_any(
        (len(repeats) > _MAX_SHOWN, Problem(f"... ({len(repeats)} pairs in all)", code="time-duplicate")),
    )
    factor = conversion_factor(series.units, VARIABLES["irradiance"].units)
    # in the units of the schema; refused where float32 would overflow
    raw = series.values[order]
    with np.errstate(over="ignore"):
        values: Floats = raw * factor
    is_overflow = np.isfinite(raw) & ~(np.abs(values) <= np.finfo(np.float32).max)
    sources_text = listed([series.sources[number] for number in order[is_overflow.any(axis=1)]])
    FormatError.raise_if(
        is_overflow.any(),
        f"irradiance up to {np.abs(raw[is_overflow]).max(initial=0.0):.3g} {series.units}: {sources_text}",
        mend="check whether the file is damaged",
        code="value-out-of-range",
    )
    faults = str(series.attrs.get(FAULTS_ATTR, ""))
    if not faults:  # a record that was opened before is judged
        clipped = None if series.clipped is None else series.clipped[order]
        values, found = judge_record(series.wavelength, times[order], values, clipped)
        warn_of_faults(found)
        faults = "\n".join(f"{fault.code}: {fault.found}" for fault in found)
    # Refuse a series whose magnitude is impossible for daylight, as with wrong units.
    first, last = series.wavelength[0], series.wavelength[-1]
    UnitsError.raise_if(
        last < _SUNLIGHT_RANGE_NM[0] or first > _SUNLIGHT_RANGE_NM[1],
        f"wavelengths from {first:g} to {last:g} nm, where there is no sunlight",
        mend="convert micrometres, angstroms or wavenumbers to nanometres",
        code="wavelength-range",
    )
    brightest = brightest_median(series.wavelength, values)
    slip = unit_slip(brightest)
    median = f"the median irradiance of 400-1000 nm is {brightest:.3g} W m-2 nm-1"
    warn_if(
        LOWEST_MEDIAN <= brightest < DULL_MEDIAN and slip,
        f"{median} at its brightest, {slip}; check its units, unless the sun was below the horizon",
        "irradiance-dim",
    )
    direction = (
        f"brighter than the sun above the atmosphere (expected at most {HIGHEST_MEDIAN:g})"
        if brightest > HIGHEST_MEDIAN
        else f"darker than deep twilight (expected at least {LOWEST_MEDIAN:g})"
    )
    UnitsError.raise_if(
        brightest < LOWEST_MEDIAN or brightest > HIGHEST_MEDIAN,
        f"{median}, {direction}",
        mend=f"check for other units ({slip or 'uW labelled as W?'}) or another quantity, such as counts; "
        "pass units=, or convert the values",
        code="irradiance-implausible",
    )
    dataset = _dataset(series, times[order], values, fwhm_nm, max_gap_s)
    uncertainty_s = series.clock_uncertainty_s if clock_uncertainty_s is None else clock_uncertainty_s
    if uncertainty_s is not None:
        name = "irradiance_clock_uncertainty"
        dataset[name] = label(xr.DataArray(np.float64(uncertainty_s)), name)
    dataset.attrs.update(
        irradiance_utc_offset_h=sorted(set(map(float, series.utc_offset_h))),
        irradiance_clock_offset_s=float(clock_offset_s),
        irradiance_stamp=stamp,
        irradiance_averaging_s=float(np.median(window)),
        **({FAULTS_ATTR: faults} if faults else {}),
    )
    return dataset


def _are_widths(value: Any) -> bool:
    # Return whether a value is a positive number, or pairs (n, 2) of wavelength and width.
    try:
        widths = np.asarray(value, np.float64)
    except (TypeError, ValueError):  # pairs of unlike lengths
        return False
    is_pairs = widths.ndim == 2 and widths.shape[1] == 2 and bool((np.diff(widths[:, 0]) > 0).all())
    return bool(np.isfinite(widths).all() and (widths > 0).all()) and (widths.ndim == 0 or is_pairs)


def _from_files(
    files: Sequence[Path],
    quantity: str | None,
    utc_offset_h: float | None,
    units: str | None,
    calibration: Mapping[str, str | os.PathLike[str]] | None,
) -> _Series:
    kinds = ["text" if (kind := sniff(path)) == "table" else kind for path in files]
    default_units = VARIABLES["irradiance"].units
    if "csv" in kinds:
        other_names = [path.name for path, kind in zip(files, kinds, strict=True) if kind != "csv"]
        FormatError.raise_if(
            other_names,
            f"csv and other files in one series; not csv: {listed(other_names)}",
            mend="open them separately",
            code="formats-mixed",
        )
        tables = for_all(files, read_irradiance_csv)
        names = listed([table.name for table in tables])
        for field_name in ("units", "fwhm_nm", "wavelength"):
            found = [getattr(table, field_name) for table in tables]
            FormatError.raise_if(
                any(not np.array_equal(content, found[0]) for content in found),
                f"the csv files differ in their {field_name}: {names}",
                mend="open them separately",
                code="series-mismatch",
            )
        stated = tables[0].units
        UnitsError.raise_if(
            units and stated and conversion_factor(stated, units) != 1.0,
            f"units={units!r}, but {names} has {stated!r}",
            mend="correct one of them",
            code="units-conflict",
        )
        units = UnitsError.raise_if_none(
            units or stated,
            f"{names}: no units",
            mend=f"pass units=, or add a line on top, for example '# units: {default_units}'",
            code="units-missing",
        )
        spectra = [
            Spectrum(
                f"{table.name}:{line}",
                table.wavelength,
                values,
                time.replace(tzinfo=None),
                utc_offset_h=None if (zone := time.utcoffset()) is None else zone / dt.timedelta(hours=1),
            )
            for table in tables
            for line, time, values in zip(table.lines, table.times, table.values, strict=True)
        ]
        return _from_spectra(
            mask_undefined(spectra, "irradiance"),
            utc_offset_h,
            units,
            one_clock=False,
            fwhm=tables[0].fwhm_nm,
        )
    is_declared = quantity is not None
    are_texts = "instrument" in kinds
    # binary files yield irradiance by their calibration, whatever quantity was displayed; units of light
    # declare what a column without a heading is
    if quantity is None and ("text" not in kinds or (are_texts and units is not None)):
        quantity = "irradiance"
    spectra, file_quantity = read_spectra(
        files, quantity, calibration=calibration, is_declared=is_declared, units=units
    )
    FormatError.raise_if(
        file_quantity != "irradiance",
        f"the files seem to hold {file_quantity}: {listed([path.name for path in files])}",
        expected="irradiance",
        mend="pass quantity='irradiance' if they hold it",
        code="quantity-wrong",
    )
    others = [path.name for path, kind in zip(files, kinds, strict=True) if kind != "instrument"]
    FormatError.raise_if(
        are_texts and others,
        f"texts of other spectrometers and files of ASD in one series: {listed(others)}",
        mend="open them separately",
        code="formats-mixed",
    )
    if are_texts:  # read in SI units; their resolution is that of the slit, which no file states
        return _from_spectra(spectra, utc_offset_h, default_units)
    wavelength = spectra[0].wavelength
    # the widths that are assumed for an ASD instrument, which may have more detectors than the first
    fwhm: Floats | float = ASD_FWHM_NM
    source = f"assumed: {ASD_FWHM_NM:g} nm, the resolution of ASD instruments at 700 nm"
    if wavelength.max() > _ASD_VNIR_END_NM:
        fwhm = np.where(wavelength <= _ASD_SPLICE_NM, ASD_FWHM_NM, ASD_SWIR_FWHM_NM)
        source += f"; {ASD_SWIR_FWHM_NM:g} nm beyond {_ASD_SPLICE_NM:g} nm, of their other detectors"
    return _from_spectra(
        spectra,
        utc_offset_h,
        units or default_units,
        fwhm=fwhm,
        fwhm_source=source,
        attrs={"irradiance_units_source": f"assumed: {default_units}, the vendor's; text exports do not say"}
        if units is None and "text" in kinds
        else {},
        receptor=next((spectrum.conflict for spectrum in spectra if spectrum.conflict), ""),
    )


def _from_spectra(
    spectra: Sequence[Spectrum],
    utc_offset_h: float | None,
    units: str,
    *,
    one_clock: bool = True,
    **extra: Any,
) -> _Series:
    without_stamp = [spectrum.source for spectrum in spectra if spectrum.local_time is None]
    TimeError.raise_if(
        without_stamp,
        f"spectra without a time stamp cannot make a series: {listed(without_stamp)}",
        mend="export them with the header ('Spectrum saved: ...'), or write a csv series",
        code="time-missing",
    )
    sources = [spectrum.source for spectrum in spectra]
    is_clipped = [spectrum.clipped for spectrum in spectra if spectrum.clipped is not None]
    offsets = utc_offsets(spectra, utc_offset_h, one_clock=one_clock)
    # the GPS time in a file has no date: differences within half a day
    ahead_s = [
        ((local - dt.datetime.combine(local, spectrum.gps.utc)).total_seconds() - 3600.0 * hours + 43_200.0)
        % 86_400.0
        - 43_200.0
        for spectrum, hours in zip(spectra, offsets, strict=True)
        if spectrum.gps is not None and (local := spectrum.local_time) is not None
    ]
    last_source_text = f" to {sources[-1]} ({len(sources)} spectra)" if len(sources) > 1 else ""
    return _Series(
        sources=sources,
        stamps=np.array([spectrum.local_time for spectrum in spectra], "datetime64[ns]"),
        utc_offset_h=offsets,
        averaging_s=np.array([spectrum.averaging_s or 0.0 for spectrum in spectra], np.float64),
        wavelength=spectra[0].wavelength,
        values=np.stack([spectrum.values for spectrum in spectra]),
        clipped=np.stack(is_clipped) if len(is_clipped) == len(spectra) else None,
        units=units,
        origin=f"{sources[0]}{last_source_text}",
        ahead_s=float(np.median(ahead_s)) if ahead_s else math.nan,
        **extra,
    )


def _from_xarray(
    data: xr.Dataset | xr.DataArray,
    utc_offset_h: float | None,
    units: str | None,
    origin: str = "an xarray object",
) -> _Series:
    data = data.to_dataset(name="irradiance") if isinstance(data, xr.DataArray) else data
    names = [str(name) for name in data.data_vars]
    refuse(
        origin,
        (
            "irradiance" not in names,
            Problem(f"no variable 'irradiance', only {names}", mend="rename it", code="variable-missing"),
        ),
        error=SchemaError,
    )
    if (product := _hypernets_series(data, origin)) is not data:
        warn_if(
            utc_offset_h,
            f"utc_offset_h={utc_offset_h} is unused: stamps of HYPERNETS are UTC; clock_offset_s= moves them",
            "utc-offset-conflict",
        )
        data, utc_offset_h = product, None
    array = data["irradiance"]
    # spectra whose time is a coordinate beside their dim, as `open_asd` returns them
    array = array.swap_dims(
        {
            array[name].dims[0]: name
            for name in _AXES[0]
            if name in array.coords and array[name].ndim == 1 and name not in array.dims
        }
    )
    axes = [next((n for n in names if n in array.dims and n in array.coords), "") for names in _AXES]
    refuse(
        origin,
        (
            "" in axes or array.ndim != 2,
            Problem(
                f"'irradiance' has dims {tuple(map(str, array.dims))}",
                expected=(
                    f"a time and a wavelength with coordinates, named {IRRADIANCE_TIME!r} or 'time', "
                    f"{IRRADIANCE_WAVELENGTH!r} or 'wavelength'"
                ),
                code="dims-wrong",
            ),
        ),
        error=SchemaError,
    )
    time, wavelength = (array[name] for name in axes)
    refuse(
        origin,
        (
            time.dtype.kind != "M" or time.isnull().any(),
            Problem(
                f"{time.name!r} has dtype {time.dtype}", expected="datetime64 without NaT", code="type-wrong"
            ),
        ),
        error=TimeError,
    )
    check_utc_offset(utc_offset_h)
    array = array.transpose(*axes)
    found_units = array.attrs.get("units") or units
    refuse(
        origin,
        (
            found_units is None,
            Problem(
                "'irradiance' has no units",
                mend="pass units=, for example 'W m-2 nm-1'",
                code="units-missing",
            ),
        ),
        (
            None not in (units, found_units) and conversion_factor(str(found_units), str(units)) != 1.0,
            Problem(
                f"units={units!r}, but the data have {found_units!r}",
                mend="correct one of them",
                code="units-conflict",
            ),
        ),
        error=UnitsError,
    )
    nanometres = convert(wavelength, "nm", str(wavelength.name)).values.astype(np.float64)
    refuse(
        origin,
        (
            not (np.all(np.isfinite(nanometres)) and np.all(np.diff(nanometres) > 0)),
            Problem(
                f"{wavelength.name!r} does not increase",
                mend="sort by it, and remove repeated values",
                code="wavelength-unordered",
            ),
        ),
        error=SchemaError,
    )
    values = array.values.astype(np.float64)
    sources = [f"sample {number}" for number in range(len(values))]
    if np.isinf(values).any():
        spectra = [Spectrum(name, nanometres, row) for name, row in zip(sources, values, strict=True)]
        values = np.stack([spectrum.values for spectrum in mask_undefined(spectra, "irradiance")])
    fwhm, gap, clock = (data.get(f"irradiance_{name}") for name in ("fwhm", "max_gap", "clock_uncertainty"))
    return _Series(
        sources=sources,
        stamps=time.values.astype("datetime64[ns]"),
        utc_offset_h=[utc_offset_h or 0.0] * len(values),
        averaging_s=np.zeros(len(values)),
        wavelength=nanometres,
        values=values,
        units=str(found_units),
        origin=origin,
        fwhm=None if fwhm is None else convert(fwhm, "nm").values,
        max_gap_s=None if gap is None else float(convert(gap, "s")),
        clock_uncertainty_s=None if clock is None else float(convert(clock, "s")),
        attrs={key: value for key, value in data.attrs.items() if str(key).startswith("irradiance_")},
    )


def _joined(parts: Sequence[_Series]) -> _Series:
    # Return the series of several files, those without a spectrum left out.
    parts = [part for part in parts if len(part.stamps)] or parts[:1]
    first = parts[0]
    FormatError.raise_if(
        any(
            not np.array_equal(getattr(part, name), getattr(first, name))
            for part in parts[1:]
            for name in ("wavelength", "units", "fwhm")
        ),
        f"the files differ in wavelengths, widths or units: {listed([part.origin for part in parts])}",
        mend="open them separately",
        code="series-mismatch",
    )
    return replace(
        first,
        sources=[f"{part.origin}: {source}" for part in parts for source in part.sources],
        utc_offset_h=list(chain.from_iterable(part.utc_offset_h for part in parts)),
        origin=first.origin + (f" to {parts[-1].origin} ({len(parts)} files)" if parts[1:] else ""),
        attrs={} if parts[1:] else first.attrs,  # the faults of several files are judged again
        stamps=np.concatenate([part.stamps for part in parts]),
        averaging_s=np.concatenate([part.averaging_s for part in parts]),
        values=np.concatenate([part.values for part in parts]),
    )


def _dataset(
    series: _Series,
    times: Times,
    values: Floats,
    fwhm_nm: Any,
    max_gap_s: float | None,
) -> xr.Dataset:
    # the widths: of the caller (a number, or pairs of wavelength and width), or of the data
    width = np.asarray(series.fwhm if fwhm_nm is None else fwhm_nm, np.float64)
    if fwhm_nm is not None and width.ndim == 2:
        width = np.interp(series.wavelength, width[:, 0], width[:, 1])
    least, most = (width.min(), width.max()) if width.size else (math.nan, math.nan)
    refuse(
        series.origin,
        (
            fwhm_nm is None and series.fwhm is None,
            Problem("no spectral resolution", mend="pass fwhm_nm=", code="fwhm-missing"),
        ),
        (
            width.shape not in ((), series.wavelength.shape) or not np.all(width > 0),
            Problem(
                "irradiance_fwhm is not positive, or of another shape than the wavelengths",
                expected="a positive number, or one per wavelength",
                code="value-out-of-range",
            ),
        ),
        (
            not _FWHM_RANGE_NM[0] <= least <= most <= _FWHM_RANGE_NM[1],
            Problem(
                f"irradiance_fwhm from {least:g} to {most:g} nm",
                expected=f"{_FWHM_RANGE_NM[0]:g} to {_FWHM_RANGE_NM[1]:g} nm",
                mend="check whether it is in micrometres or angstroms",
                code="value-out-of-range",
            ),
        ),
        error=SchemaError,
    )
    gap_s = series.max_gap_s if max_gap_s is None else max_gap_s
    refuse(
        series.origin,
        (
            gap_s is None and len(times) < 2,
            Problem(
                "a single irradiance sample has no interval",
                mend="open the whole series: its files, a csv with a row for each time, or an xarray object; "
                "or pass max_gap_s=",
                code="argument-missing",
            ),
        ),
        error=TimeError,
    )
    if gap_s is None:
        gap_s = _GAP_INTERVALS * float(np.median(np.diff(times).astype(np.int64))) / 1e9
    dims = (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH)
    arrays = {
        "irradiance": xr.DataArray(values.astype(np.float32), dims=dims),
        "irradiance_fwhm": xr.DataArray(width, dims=dims[1 : 1 + width.ndim]),
        "irradiance_max_gap": xr.DataArray(np.float64(gap_s)),
    }
    axes = zip(dims, (times, series.wavelength), strict=True)
    receptor = {"receptor": series.receptor} if series.receptor else {}
    return xr.Dataset(
        {name: label(a, name, **receptor if name == "irradiance" else {}) for name, a in arrays.items()},
        coords={name: (name, axis, VARIABLES[name].attrs) for name, axis in axes},
        attrs={
            _SHAPE: "gaussian",
            **series.attrs,
            "irradiance_source": series.origin,
            "irradiance_fwhm_source": series.fwhm_source if fwhm_nm is None else "given by the user",
        },
    )


class UncoveredError(TimeError):
    # An irradiance record of other times than the flight lines, with the clock that would fit.
    lines: list[Times] = []  # noqa: RUF012

    @classmethod
    def of(
        cls,
        irradiance: xr.Dataset,
        lines: list[Times],
        subject: str = "the flight line was",
        others: Sequence[Times] = (),
    ) -> Self:
        # The error for all ``lines``, sorted times of lines outside the record; ``others``: inside it.
        record = irradiance[IRRADIANCE_TIME].values.astype("datetime64[ns]")
        flight = np.sort(np.concatenate([*lines, *others]))
        covered, flown = (
            "{} to {} UTC".format(*np.datetime_as_string(times[[0, -1]], "s")) if times.size else ""
            for times in (record, np.sort(np.concatenate(lines)))
        )
        mend = "check utc_offset_h and clock_offset_s"
        if record.size and flight.size:
            # shifts of the record with which it covers all lines [s]; zones are whole hours, or quarters
            least, most = (flight[[-1, 0]] - record[[-1, 0]]) / np.timedelta64(1, "s")
            zones = np.ravel(irradiance.attrs.get("irradiance_utc_offset_h", [])).astype(np.float64)
            clock = float(irradiance.attrs.get("irradiance_clock_offset_s", 0.0))
            fitting: Floats = np.empty(0)
            for step in (3600.0, 900.0) if zones.size == 1 else ():
                shifts = step * np.arange(np.ceil(least / step), np.floor(most / step) + 1)
                offsets = zones[0] - shifts[np.argsort(np.abs(shifts))] / 3600.0
                fitting = fitting if fitting.size else offsets[np.abs(offsets) <= 14.0]
            if fitting.size:
                hours = " or ".join(f"{offset:g}" for offset in fitting[:3])
                mend = f"utc_offset_h = {hours} instead of {zones[0]:g} would fit"
                if abs(clock) >= 900.0:  # the given offset may be the mistake
                    mend += f", or clock_offset_s = {clock + least:.0f} to {clock + most:.0f}"
            elif least <= most:
                mend += f": clock_offset_s = {clock + least:.0f} to {clock + most:.0f} would fit"
            else:
                mend += f"; the record is {least - most:.0f} s shorter than the flight: files are missing"
        error = cls(
            f"the irradiance record covers {covered or 'nothing'}, {subject} recorded "
            f"{flown or 'at unknown times'}",
            mend=mend,
            code="time-uncovered",
        )
        error.lines = lines
        return error


def cut_irradiance(irradiance: xr.Dataset, time: Times) -> xr.Dataset:
    # Cut an irradiance record to a flight line +- 60 s, or to its bracketing samples where these are wider.
    #
    # irradiance: ``irradiance`` (irradiance_time, irradiance_wavelength), ``irradiance_fwhm``,
    #     ``irradiance_max_gap`` and, where known, ``irradiance_clock_uncertainty``.
    # time: UTC of the lines, NaT allowed, (along_track,).
    # Returns xarray.Dataset: In memory, in the units of the table.
    # Raises SchemaError: Variables or units are missing.
    # Raises TimeError: Irradiance times do not increase, or no sample and no interval covers the line.
    names = ["irradiance", "irradiance_fwhm", "irradiance_max_gap"]
    if "irradiance_clock_uncertainty" in irradiance:
        names.append("irradiance_clock_uncertainty")
    variables = require(irradiance, names, "the irradiance of a flight line")
    stamps = variables["irradiance"][IRRADIANCE_TIME].values.astype("datetime64[ns]")
    TimeError.raise_if(
        np.isnat(stamps).any() or (np.diff(stamps) <= np.timedelta64(0, "ns")).any(),
        "irradiance times repeat, run backwards or are missing",
        mend="sort them, and remove repeated ones",
        code="time-unordered",
    )
    lines = np.sort(time[~np.isnat(time)])
    if not lines.size or not stamps.size or stamps[-1] < lines[0] or stamps[0] > lines[-1]:
        raise UncoveredError.of(irradiance, [lines])
    first, last = lines[0], lines[-1]
    start = min(
        np.searchsorted(stamps, first - _LINE_MARGIN),
        max(np.searchsorted(stamps, first, side="right") - 1, 0),
    )
    stop = max(np.searchsorted(stamps, last + _LINE_MARGIN, side="right"), np.searchsorted(stamps, last) + 1)
    cut = xr.Dataset({name: label(array, name) for name, array in variables.items()})
    if "receptor" in irradiance["irradiance"].attrs:
        cut["irradiance"].attrs["receptor"] = irradiance["irradiance"].attrs["receptor"]
    cut = cut.isel({IRRADIANCE_TIME: slice(int(start), int(stop))}).load()
    cut = cut.assign_coords({IRRADIANCE_TIME: cut[IRRADIANCE_TIME].astype("datetime64[ns]")})
    return cut.drop_encoding().assign_attrs({_SHAPE: "gaussian"} | record_attrs(irradiance))


def record_attrs(irradiance: xr.Dataset) -> dict[str, Any]:
    # Return the attributes of a record that a flight line needs: shape of its responses, and faults.
    return {name: irradiance.attrs[name] for name in (_SHAPE, FAULTS_ATTR) if name in irradiance.attrs}
