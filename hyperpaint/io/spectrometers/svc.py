"""Spectra of SVC field spectrometers as labelled arrays."""

from __future__ import annotations

import datetime as dt
import json
import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import one_of
from hyperpaint.base.schema import VARIABLES, label

from .spectrum_files import (
    QUANTITIES,
    Paths,
    check_utc_offset,
    common_quantity,
    find_paths,
    for_all,
    listed,
    name_spectra,
    ratio,
    require_one_grid,
    same_grids,
)
from .svc_layout import (
    DETECTORS,
    SvcFile,
    SvcOverlap,
    detectors_of,
    error_bits,
    items,
    overlap_of,
    pair,
    position_of,
    read_svc,
)

Scan = Literal["reference", "target"]
Overlap = Literal["keep", "trim"]

#: Wavelengths [nm] at which the vendor's software changes detectors by default.
SVC_JOINS = (990.0, 1900.0)

_SCALE = {
    "radiance": 1e-6,
    "irradiance": 1e-6,
    "counts": 1.0,
}  # to SI, from the files' 1e-10 W cm-2 [sr-1] nm-1


def open_svc(
    paths: Paths,
    quantity: str | None = None,
    *,
    scan: Scan = "target",
    overlap: Overlap = "keep",
    joins: tuple[float, float] | None = None,
    dayfirst: bool | None = None,
    utc_offset_h: float | None = None,
) -> xr.Dataset:
    r"""Open spectra of an SVC (Spectra Vista) field spectrometer, as ``.sig`` files hold them.

    Parameters
    ----------
    paths
        A file, a glob, a folder, or a list of these.
    quantity
        ``reflectance`` (target / white reference), ``radiance``, ``counts`` or ``irradiance``. By default
        reflectance from two scans in radiance, else the quantity of the scan.
    scan
        Scan to return as radiance, counts or irradiance: of the ``target`` or of the white ``reference``.
    overlap
        ``keep`` returns all channels in the file's order: where detectors overlap, wavelengths step
        back, and a range of them occurs twice. ``trim`` keeps one detector's channels, so that they increase.
    joins
        Wavelengths [nm] at which ``trim`` changes from VNIR to SWIR 1 and from SWIR 1 to SWIR 2: a channel at
        the join is the lower detector's, the next one the higher's. By default 990 and 1900, as in the
        vendor's software, or the nearest end of the overlap. No value changes; the attribute
        ``overlap_trimmed_at_nm`` contains the wavelengths.
    dayfirst
        Whether dates with slashes that are valid in both orders begin with the day. By default as in files of
        the same instrument whose order is unambiguous; else their time is NaT, with a warning.
    utc_offset_h
        Local time minus UTC [h], for files without GPS time; with GPS time it is not needed.

    Returns
    -------
    xarray.Dataset
        One variable, named by its quantity, on (spectrum, wavelength), float64, in the order of the files,
        and ``spectrum``, the names of the files without ``.sig``. Coordinates of each spectrum: ``time``
        and, for reflectance, ``reference_time`` (UTC, NaT where it cannot be known); ``latitude`` and
        ``longitude`` (NaN without a fix); ``overlap_matched``, whether the software changed values to make
        detectors meet, and ``overlap``, the treatment of the channels there; the file's ``factors`` as text
        and as ``factor_reference`` and ``factor_target``; ``error_reference`` and ``error_target``, the bits
        that the instrument set; ``column_difference``, how far the file's own rounded reflectance is from
        the one returned; ``instrument``, ``source``, and ``header``, all of the file's header as JSON.
        Coordinate of each channel, where the files tell: ``detector``.

    Raises
    ------
    FormatError
        Files are missing or damaged, lack what the quantity needs, or differ in wavelengths; all are named.
    SchemaError
        An argument is not one of those above.
    TimeError
        ``utc_offset_h`` is the offset of no zone.

    Warns
    -----
    PaintWarning
        Undefined samples, which become NaN; a rounded reflectance in the file that contradicts its scans;
        times or positions that cannot be known or read; a ``utc_offset_h`` that contradicts the GPS.

    Notes
    -----
    Reflectance is the ratio of the two scans, which has more digits than the file's fourth column, and is
    relative to the white panel. Radiance is scaled by 1e-6 W m-2 sr-1 nm-1 (the vendor's 1e-10 W cm-2 sr-1
    nm-1), which the files do not say. The ``factors`` are VNIR over SWIR 1 in their overlap, of the reference
    and of the target; they are applied only where ``overlap_matched``: the first detector is then divided by
    a ramp from 1 in the blue to them, and faded into the second over the range that ``factors`` name.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "red.sig")
    >>> times = "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n"
    >>> text = f"/*** Spectra Vista SIG Data ***/\nunits= Radiance, Radiance\n{times}data= \n"
    >>> _ = path.write_text(text + "550,1  8000,00  401,00  5,01\n551,5  8000,00  800,00  10,00\n")
    >>> opened = open_svc(path, utc_offset_h=2)
    >>> opened["reflectance"].values
    array([[0.050125, 0.1     ]])
    >>> opened["spectrum"].values.tolist(), opened["time"].values
    (['red'], array(['2025-05-27T07:42:59.000000000'], dtype='datetime64[ns]'))
    """
    problems = Problems("SVC files cannot be opened with these arguments", SchemaError)
    if quantity is not None:
        one_of(quantity, QUANTITIES, "quantity", problems=problems)
    one_of(scan, SCANS, "scan", problems=problems)
    if scan == "reference" and quantity == "reflectance":
        problems.add(
            "scan='reference' with quantity='reflectance', which is a ratio of both scans",
            mend="omit scan, or pass quantity='radiance'",
            code="option-conflict",
        )
    one_of(overlap, get_args(Overlap), "overlap", problems=problems)
    if joins is not None and not (np.size(joins) == 2 and 0.0 < joins[0] < joins[1] < math.inf):
        problems.add(
            f"joins={joins!r}", expected="two increasing wavelengths in nm", code="value-out-of-range"
        )
    problems.raise_if_any()
    if utc_offset_h is not None:
        check_utc_offset(utc_offset_h)
    files = find_paths(
        paths, lambda folder_files: [p for p in folder_files if p.suffix.lower() == ".sig"], ".sig files"
    )
    contents = for_all(files, read_svc)
    scan_number = SCANS.index(scan)
    # by default, reflectance of targets whose two scans are in radiance
    target_quantity = quantity or common_quantity(
        (
            "reflectance"
            if scan_number == 1 and file.units == ("radiance", "radiance") and file.has_reference
            else file.units[scan_number],
            file.name,
        )
        for file in contents
    )

    def measure(file_and_path: tuple[SvcFile, Path]) -> SvcMeasurement:
        return _measurement(*file_and_path, target_quantity, scan_number, joins, trim=overlap == "trim")

    measurements = for_all(zip(contents, files, strict=True), measure)
    require_one_grid(
        ((measurement.file.name, measurement.wavelength) for measurement in measurements),
        lambda: _joins_advice(measurements),
    )
    values = np.stack(
        [
            np.where(np.isfinite(measurement.values), measurement.values, np.nan)
            for measurement in measurements
        ]
    )
    warn_of(
        "samples that are undefined (not finite) become NaN",
        [
            measurement.file.name
            for measurement, row in zip(measurements, values, strict=True)
            if np.isnan(row).any()
        ],
        "samples-undefined",
    )
    coords = {
        **coords_of_channels(measurements),
        **coords_of_times(
            contents,
            1 if target_quantity == "reflectance" else scan_number,
            target_quantity,
            dayfirst,
            utc_offset_h,
        ),
        **coords_of_positions(contents, scan_number),
        **coords_of_files(measurements, target_quantity),
    }
    attrs: dict[str, Any] = {"instrument": "SVC"}
    if target_quantity != "reflectance":
        attrs["scan"] = scan
    trimmed_at = [measurement.trimmed_at for measurement in measurements if measurement.trimmed_at]
    if trimmed_at:
        attrs["overlap_trimmed_at_nm"] = list(trimmed_at[0])
    data = xr.DataArray(values, dims=("spectrum", "wavelength"))
    extra = {"reflectance_scale": "relative"} if target_quantity == "reflectance" else {}
    return xr.Dataset({target_quantity: label(data, target_quantity, **extra)}, coords=coords, attrs=attrs)


def _measurement(
    file: SvcFile,
    path: Path,
    quantity: str,
    scan_number: int,
    joins: tuple[float, float] | None,
    *,
    trim: bool,
) -> SvcMeasurement:
    overlap = overlap_of(file.header)
    detector = detectors_of(file, overlap.joins)
    reference_units, target_units = file.units
    if (quantity == "reflectance" or scan_number == 0) and not file.has_reference:
        raise FormatError(
            f"{file.name}: no white reference was taken",
            mend="pass quantity='radiance'" if quantity == "reflectance" else "pass scan='target'",
            code="reference-missing",
        )
    if quantity != "reflectance":
        if file.units[scan_number] != quantity:
            raise FormatError(
                f"{file.name}: the scan of the {SCANS[scan_number]} is in {file.units[scan_number]}",
                expected=quantity,
                mend=(
                    f"pass quantity={file.units[scan_number]!r}, or save the file in {quantity} with the "
                    "vendor's software"
                ),
                code="quantity-wrong",
            )
        values = (file.reference, file.target)[scan_number] * _SCALE[quantity]
    else:
        # the scans must have the same units and, in counts, the same integration times
        integration_times = items(file.header.get("integration", ""))
        if reference_units != target_units:
            raise FormatError(
                f"{file.name}: its reference is in {reference_units} and its target in {target_units}",
                mend=f"pass quantity={target_units!r}",
                code="units-conflict",
            )
        if (
            target_units == "counts"
            and integration_times[: len(integration_times) // 2]
            != integration_times[len(integration_times) // 2 :]
        ):
            raise FormatError(
                f"{file.name}: reference and target are counts of different or unknown integration times",
                mend="save the file in radiance with the vendor's software, or pass quantity='counts'",
                code="integration-time-conflict",
            )
        values = ratio(file.target, file.reference)
    handovers = _handovers(file, joins) if trim else ()
    is_used = _trimmed_channels(file, handovers)
    if not is_used.any():
        raise FormatError(
            f"{file.name}: no channel remains after trimming; detectors are not in order of wavelength",
            mend="copy the file again",
            code="wavelength-unordered",
        )
    return SvcMeasurement(
        file=file,
        path=path,
        overlap=overlap,
        wavelength=file.wavelength[is_used],
        values=values[is_used],
        detector=None if detector is None else detector[is_used],
        trimmed_at=handovers,
    )


def _handovers(file: SvcFile, joins: tuple[float, float] | None) -> tuple[float, ...]:
    # Return the wavelength [nm] at which each detector but the last ends.
    handovers = []
    for start, join in zip(file.starts[1:], joins or SVC_JOINS, strict=False):
        first, last = float(file.wavelength[start]), float(file.wavelength[start - 1])
        # the vendor's software may begin the next detector at its first channel, one step above the join
        low = first - float(np.ptp(file.wavelength[start : start + 2]))
        high = last + float(np.ptp(file.wavelength[max(start - 2, 0) : start]))
        if joins is not None and not low <= join <= high:
            raise FormatError(
                f"{file.name}: the join at {join:g} nm is outside the overlap of detectors",
                expected=f"{first:g} to {last:g} nm",
                mend="pass joins= within the overlaps",
                code="join-outside-overlap",
            )
        handovers.append(min(max(join, low), high))
    return tuple(handovers)


def _trimmed_channels(file: SvcFile, handovers: Sequence[float]) -> npt.NDArray[np.bool_]:
    # Return which channels remain: below a join those of the lower detector, above it those of the next.
    is_used = np.ones(len(file.wavelength), bool)
    for start, join in zip(file.starts[1:], handovers, strict=False):
        is_used[:start] &= file.wavelength[:start] <= join
        is_used[start:] &= file.wavelength[start:] > join
    return is_used


def _joins_advice(measurements: Sequence[SvcMeasurement]) -> str:
    # Return the advice to trim, if trimming gives all files the same wavelengths; or an empty text.
    for joins in sorted(
        {measurement.overlap.joins for measurement in measurements if measurement.overlap.joins is not None}
    ):
        try:
            grids = [
                (
                    measurement.file.name,
                    measurement.file.wavelength[
                        _trimmed_channels(measurement.file, _handovers(measurement.file, joins))
                    ],
                )
                for measurement in measurements
            ]
        except FormatError:
            continue
        if len(same_grids(grids)) == 1:
            return f", or pass overlap='trim', joins=({joins[0]:g}, {joins[1]:g}), which makes them equal"
    return ""


# ----------------------------------------------------------------------------------------------------------
# Coordinates of SVC spectra: channels, times, places, and header fields of their files.


#: The two scans of a file, in the order of its columns.
SCANS = ("reference", "target")

_HALF_DIGIT = 0.005  # rounding error of numbers with two decimals
_NAT = np.datetime64("NaT", "ns")
_NO_POSITION = (math.nan, math.nan)


@dataclass(frozen=True, eq=False)
class SvcMeasurement:
    """One file in one quantity, on the channels that remain."""

    file: SvcFile
    path: Path
    overlap: SvcOverlap
    wavelength: Floats
    values: Floats
    detector: npt.NDArray[np.int64] | None
    trimmed_at: tuple[float, ...]

    @property
    def overlap_text(self) -> str:
        """Treatment of the channels at which detectors overlap."""
        if self.trimmed_at:
            return f"trimmed @ {', '.join(f'{join:g}' for join in self.trimmed_at)} nm"
        return self.overlap.text


def coords_of_channels(measurements: Sequence[SvcMeasurement]) -> dict[str, Any]:
    """Return the coordinate of the wavelengths, and that of the detectors if it is the same in all files."""
    first = measurements[0]
    attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the spectrometer"}
    coords: dict[str, Any] = {"wavelength": ("wavelength", first.wavelength, attrs)}
    if first.detector is not None and all(
        measurement.detector is not None and np.array_equal(measurement.detector, first.detector)
        for measurement in measurements
    ):
        names = np.array(DETECTORS, object)[first.detector]
        coords["detector"] = ("wavelength", names, {"long_name": "Detector of the channel"})
    return coords


def coords_of_times(
    contents: Sequence[SvcFile],
    scan_number: int,
    quantity: str,
    dayfirst: bool | None,
    utc_offset_h: float | None,
) -> dict[str, Any]:
    """Return the coordinates of UTC of the scans; for reflectance, of target and reference."""
    stamps = [[read_stamp(text) for text in pair(file.header, "time")] for file in contents]
    orders = orders_of(
        (file.header.get("instrument", ""), stamp)
        for file, stamps_of_file in zip(contents, stamps, strict=True)
        for stamp in stamps_of_file
        if stamp is not None
    )
    clock = _Clock(orders, dayfirst, utc_offset_h)
    names = {scan_number: "time"} if quantity != "reflectance" else {0: "reference_time", 1: "time"}
    coords: dict[str, Any] = {}
    for scan, name in sorted(names.items(), reverse=True):
        times = [
            clock.utc(file, stamps_of_file[scan], scan)
            for file, stamps_of_file in zip(contents, stamps, strict=True)
        ]
        target_name = "white reference" if scan == 0 else "target"
        coords[name] = _spectrum_coordinate(
            np.array(times, "datetime64[ns]"), f"UTC of the scan of the {target_name}"
        )
    clock.warn()
    return coords


class _Clock:
    # Converts stamps to UTC, and collects the reasons why stamps become NaT.
    def __init__(self, orders: Mapping[str, bool], dayfirst: bool | None, utc_offset_h: float | None) -> None:
        self._orders = orders
        self._dayfirst = dayfirst
        self._utc_offset_h = utc_offset_h
        self._files_by_reason: dict[tuple[str, str], dict[str, None]] = {}

    def _nat_with_reason(self, reason: str, code: str, file: SvcFile) -> np.datetime64:
        self._files_by_reason.setdefault((reason, code), {})[file.name] = None
        return _NAT

    def utc(self, file: SvcFile, stamp: LocalStamp | None, scan: int) -> np.datetime64:
        if stamp is None:
            return self._nat_with_reason("missing or unreadable times are NaT", "time-unreadable", file)
        order = self._orders.get(file.header.get("instrument", ""))
        local = stamp.read(order if self._dayfirst is None and stamp.slashes else self._dayfirst)
        if local is None:
            return self._nat_with_reason(
                "dates of unknown order are NaT; pass dayfirst=", "date-ambiguous", file
            )
        gps = None
        try:
            gps = read_gps_time(pair(file.header, "gpstime")[scan])
        except ValueError:
            self._nat_with_reason("unreadable GPS times are ignored", "gps-time-unreadable", file)
        utc = utc_of(local, gps, (position_of(file.header, scan) or _NO_POSITION)[1], self._utc_offset_h)
        if utc is None:
            return self._nat_with_reason(
                "local times without GPS time are NaT; pass utc_offset_h=", "zone-missing", file
            )
        if (
            self._utc_offset_h is not None
            and gps is not None
            and abs((local - utc).total_seconds() / 3600.0 - self._utc_offset_h) > 0.25
        ):
            reason = f"utc_offset_h={self._utc_offset_h:+g} contradicts GPS time, which is used"
            self._nat_with_reason(reason, "utc-offset-conflict", file)
        return np.datetime64(utc, "ns")

    def warn(self) -> None:
        for (reason, code), names in self._files_by_reason.items():
            warn_of(reason, list(names), code)


def coords_of_positions(contents: Sequence[SvcFile], scan_number: int) -> dict[str, Any]:
    """Return coordinates of the scans' GPS positions; ``scan_number`` is 0 for references, 1 for targets."""
    positions = [position_of(file.header, scan_number) for file in contents]
    files_unreadable = [
        file.name for file, position in zip(contents, positions, strict=True) if position is None
    ]
    warn_of("unreadable positions are NaN", files_unreadable, "position-unreadable")
    columns = np.array([position or _NO_POSITION for position in positions], np.float64).T
    coords: dict[str, Any] = {}
    for name, column in zip(("latitude", "longitude"), columns, strict=True):
        attrs = {**VARIABLES[name].attrs, "long_name": f"{name.capitalize()} of the spectrometer"}
        coords[name] = ("spectrum", column, attrs)
    return coords


def _spectrum_coordinate(values: Any, meaning: str, **attrs: str) -> tuple[str, Array, dict[str, str]]:
    # Return a coordinate along ``spectrum``; a list contains texts.
    array = np.array(values, object) if isinstance(values, list) else values
    return "spectrum", array, {"long_name": meaning, **attrs}


def coords_of_files(measurements: Sequence[SvcMeasurement], quantity: str) -> dict[str, Any]:
    """Return coordinates of the files' names, instruments, overlap treatment, matching and error bits."""
    files = [measurement.file for measurement in measurements]
    names = name_spectra(
        [
            (measurement.path, measurement.path.name.removesuffix(measurement.path.suffix))
            for measurement in measurements
        ]
    )
    errors = np.array([error_bits(file.header) for file in files], np.int64)
    factors = np.array([measurement.overlap.factors for measurement in measurements], np.float64)
    overlaps = [measurement.overlap_text for measurement in measurements]
    matched = np.array([measurement.overlap.matched for measurement in measurements], bool)
    instruments = [file.header.get("instrument", "") for file in files]
    factors_texts = [file.header.get("factors", "") for file in files]
    headers = [json.dumps(dict(file.header), ensure_ascii=False) for file in files]
    coords: dict[str, Any] = {
        "spectrum": _spectrum_coordinate(names, "Name of the spectrum"),
        "source": _spectrum_coordinate([file.name for file in files], "File"),
        "instrument": _spectrum_coordinate(instruments, "Instrument"),
        "overlap": _spectrum_coordinate(overlaps, "What became of channels where detectors overlap"),
        "overlap_matched": _spectrum_coordinate(
            matched, "Whether values were changed to make detectors meet"
        ),
        "factors": _spectrum_coordinate(factors_texts, "Matching of the detectors as the file says it"),
        "header": _spectrum_coordinate(headers, "Header of the file as JSON"),
    }
    for scan, name in enumerate(SCANS):
        meaning = f"VNIR over SWIR 1 in their overlap, scan of the {name}"
        coords[f"factor_{name}"] = _spectrum_coordinate(factors[:, scan], meaning, units="1")
        meaning = f"Error bits of the instrument, scan of the {name}; -1 where unknown"
        coords[f"error_{name}"] = _spectrum_coordinate(errors[:, scan], meaning)
    if quantity == "reflectance":
        meaning = "Largest distance of the file's own rounded reflectance from the recomputed"
        coords["column_difference"] = _spectrum_coordinate(_column_differences(files), meaning, units="1")
    return coords


def _column_differences(files: Sequence[SvcFile]) -> Floats:
    # Return the difference of each file's fourth column from the ratio; warn if it exceeds rounding.
    differences = np.full(len(files), np.nan)
    contradictory = []
    for number, file in enumerate(files):
        with np.errstate(all="ignore"):
            scan_ratio = file.target / file.reference
            difference = np.abs(100.0 * scan_ratio - file.percent)
            # the file rounds all numbers, of the scans and of the ratio
            limit = _HALF_DIGIT * (1.0 + 100.0 * (1.0 + np.abs(scan_ratio)) / np.abs(file.reference))
            is_contradictory = (difference > limit * (1.0 + 1e-9) + 1e-9) | (
                np.isfinite(scan_ratio) & ~np.isfinite(file.percent)
            )
        if np.isfinite(difference).any():
            differences[number] = np.nanmax(np.where(np.isfinite(difference), difference, np.nan)) / 100.0
        if is_contradictory.any():
            contradictory.append(f"{file.name} ({np.count_nonzero(is_contradictory)} channels)")
    warn_of(
        "the reflectance in the file contradicts its two scans (edited or resampled?); their ratio is used",
        contradictory,
        "reflectance-conflict",
    )
    return differences


def warn_of(problem: str, names: Sequence[str], code: str) -> None:
    """Warn of a problem of the named files, if there are any."""
    if names:
        warnings.warn(PaintWarning(f"{problem}. Files: {listed(names)}", code=code), stacklevel=2)


_STAMP = re.compile(
    r"(\d{1,4})([/.-])(\d{1,2}|[^\W\d_]{3,9})\.?\2(\d{1,4})"
    r"(?:\s+|T)(\d{1,2})[:.](\d{2})(?:[:.](\d{2}))?(?:[.,]\d{1,9})?"
    r"\s*(?:([AP])\.?\s?M\.?)?",
    re.IGNORECASE,
)
# abbreviated months in English, German, Italian, French, Spanish and Portuguese
_MONTHS = (
    ("jan", "gen", "ene", "jän"),
    ("feb", "fev", "fév"),
    ("mar", "mär", "mrz"),
    ("apr", "avr", "abr"),
    ("may", "mai", "mag"),
    ("jun", "giu", "juin"),
    ("jul", "lug", "juil"),
    ("aug", "ago", "aoû", "aou"),
    ("sep", "set"),
    ("oct", "okt", "ott", "out"),
    ("nov",),
    ("dec", "dez", "dic", "déc"),
)
_GPS_TIME = re.compile(r"(\d{1,2})(\d\d)(\d\d)(?:[.,](\d{1,6})\d{0,3})?", re.ASCII)
_DAY = dt.timedelta(days=1)


@dataclass(frozen=True)
class LocalStamp:
    """Date and time of a local clock, without a zone."""

    day_first: dt.datetime | None  # date read in this order; None if there is no such date
    month_first: dt.datetime | None
    slashes: bool  # whether slashes separate the numbers; only then do both orders occur

    @property
    def order(self) -> bool | None:
        """True if the day comes first, False if the month does, None if both are possible."""
        if self.day_first == self.month_first:
            return None
        if self.day_first is None or self.month_first is None:
            return self.month_first is None
        return None if self.slashes else True

    @property
    def ambiguous(self) -> bool:
        """Whether the two orders give two dates."""
        return self.order is None and self.day_first != self.month_first

    def read(self, dayfirst: bool | None) -> dt.datetime | None:
        """Return the date in the given or the only possible order; None if it is ambiguous."""
        if self.day_first is None or self.month_first is None:
            return self.day_first or self.month_first
        order = self.order if dayfirst is None else dayfirst
        if order is None:
            return None if self.ambiguous else self.day_first
        return self.day_first if order else self.month_first


def read_stamp(text: str) -> LocalStamp | None:
    """Return a time stamp, None where it is unreadable.

    Examples
    --------
    >>> read_stamp("02/08/2024 10:07:36AM").ambiguous
    True
    >>> read_stamp("16/10/2024 10:47:58").read(None), read_stamp("11-lug-15 13.08.32").read(None)
    (datetime.datetime(2024, 10, 16, 10, 47, 58), datetime.datetime(2015, 7, 11, 13, 8, 32))
    """
    match = _STAMP.fullmatch(text.strip()) if len(text) <= 80 else None
    if match is None:
        return None
    first, separator, second, third, hour, minute, seconds, am_pm = match.groups()
    year = first if len(first) == 4 else third
    if len(year) not in (2, 4) or (am_pm is not None and not 1 <= int(hour) <= 12):
        return None
    hours = int(hour) if am_pm is None else int(hour) % 12 + 12 * (am_pm.upper() == "P")
    clock = (hours, int(minute), int(seconds or 0))
    month = _month(second)
    # the order is certain if the year comes first, or the month is a word
    if len(first) == 4 or month is None or not second.isdecimal():
        day = third if len(first) == 4 else first
        date = None if month is None else _date(int(year), month, int(day), clock)
        return None if date is None else LocalStamp(date, date, slashes=False)
    day_first = _date(int(year), month, int(first), clock)
    month_first = _date(int(year), int(first), month, clock)
    if day_first is None and month_first is None:
        return None
    return LocalStamp(day_first, month_first, slashes=separator == "/")


def _month(text: str) -> int | None:
    # Return the number of a month from its name; a number unchanged, which may be a day.
    if text.isdecimal():
        return int(text)
    word = text.lower()
    return next((i for i, prefixes in enumerate(_MONTHS, 1) if word.startswith(prefixes)), None)


def _date(year: int, month: int, day: int, clock: tuple[int, int, int]) -> dt.datetime | None:
    try:
        date = dt.datetime(year + 2000 if year < 100 else year, month, day, *clock)
    except ValueError:
        return None
    return date if 1990 <= date.year < 2200 else None


def orders_of(stamps: Iterable[tuple[str, LocalStamp]]) -> dict[str, bool]:
    """Return the order of dates of each instrument whose unambiguous dates agree: True for day first.

    stamps: Instrument and stamp of every scan.

    Examples
    --------
    >>> dates = ("6/5/2024 9:00:00", "6/30/2024 9:00:00")
    >>> orders_of(("HI: 1152050", read_stamp(text)) for text in dates)
    {'HI: 1152050': False}
    """
    orders_by_instrument: dict[str, set[bool]] = {}
    for instrument, stamp in stamps:
        if stamp.slashes and stamp.order is not None:
            orders_by_instrument.setdefault(instrument, set()).add(stamp.order)
    return {
        instrument: next(iter(orders))
        for instrument, orders in orders_by_instrument.items()
        if len(orders) == 1
    }


def read_gps_time(text: str) -> dt.timedelta | None:
    """Return the time of day in UTC from ``HHMMSS.sss``; None if the text is empty, as without a fix.

    Raises ValueError: The text is not a time of day.

    Examples
    --------
    >>> read_gps_time("090724.786")
    datetime.timedelta(seconds=32844, microseconds=786000)
    """
    if not text:
        return None
    match = _GPS_TIME.fullmatch(text)
    if match is None or int(match[1]) > 23 or int(match[2]) > 59 or int(match[3]) > 60:
        raise ValueError(f"{text[:20]!r}: expected a time of day, HHMMSS.sss")
    return dt.timedelta(
        hours=int(match[1]),
        minutes=int(match[2]),
        seconds=int(match[3]),
        microseconds=int((match[4] or "0").ljust(6, "0")),
    )


def utc_of(
    local: dt.datetime, gps: dt.timedelta | None, longitude: float, utc_offset_h: float | None
) -> dt.datetime | None:
    """Return UTC of a scan: the GPS time of day on the nearest date of the local clock.

    local: Time of the local clock.
    gps: Time of day in UTC, used instead of the local clock's.
    longitude: Degrees east; gives the UTC offset to within hours, which suffices to find the date.
    utc_offset_h: Local time minus UTC [h], needed without GPS time.

    Examples
    --------
    >>> utc_of(dt.datetime(2024, 2, 8, 20, 30), dt.timedelta(hours=1, minutes=30, seconds=4), -75.0, None)
    datetime.datetime(2024, 2, 9, 1, 30, 4)
    """
    if gps is None:
        return None if utc_offset_h is None else local - dt.timedelta(hours=utc_offset_h)
    if utc_offset_h is None:
        utc_offset_h = longitude / 15.0 if math.isfinite(longitude) else 0.0
    approximate_utc = local - dt.timedelta(hours=utc_offset_h)
    midnight = approximate_utc.replace(hour=0, minute=0, second=0, microsecond=0)
    return min(
        (midnight + days * _DAY + gps for days in (-1, 0, 1)), key=lambda utc: abs(utc - approximate_utc)
    )
