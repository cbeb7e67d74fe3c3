"""Spectra of SVC field spectrometers as labelled arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.errors import FormatError, Problems, SchemaError
from hyperpaint.base.schema import label

from .spectrum_files import (
    QUANTITIES,
    Paths,
    check_utc_offset,
    common_quantity,
    find_paths,
    for_all,
    ratio,
    require_one_grid,
    same_grids,
)
from .svc_coords import (
    SCANS,
    SvcMeasurement,
    coords_of_channels,
    coords_of_files,
    coords_of_places,
    coords_of_times,
    warn_of,
)
from .svc_layout import SvcFile, detectors_of, items, overlap_of, read_svc

Scan = Literal["reference", "target"]
Overlap = Literal["keep", "trim"]

#: Wavelengths at which the vendor's software ends a detector by default [nm].
SVC_JOINS = (990.0, 1900.0)

_SCALE = {"radiance": 1e-6, "irradiance": 1e-6, "counts": 1.0}  # files count in 1e-10 W cm-2 [sr-1] nm-1


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
        Which scan radiance, counts or irradiance are of: of the ``target`` or of the white ``reference``.
    overlap
        ``keep`` returns every channel of the file, in its order: where detectors overlap, wavelengths fall
        back and occur twice. ``trim`` takes one detector at each join, so that wavelengths increase.
    joins
        Where ``trim`` hands over from VNIR to SWIR 1 and from SWIR 1 to SWIR 2 [nm]: a channel at the join
        is the lower detector's, the next one the higher's. By default 990 and 1900, as in the vendor's
        software, or the end of the overlap that is next to these. It chooses among channels and changes no
        value; the attribute ``overlap_trimmed_at_nm`` tells where.
    dayfirst
        How to read dates with slashes that make sense both ways. By default as the other files of the same
        instrument read where these leave no doubt; else their time is NaT, with a warning.
    utc_offset_h
        Local time minus UTC [h], for files without GPS time. Where there is GPS time, UTC is that.

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
    _check_arguments(quantity, scan, overlap, joins, utc_offset_h)
    files = find_paths(paths, lambda inside: [p for p in inside if p.suffix.lower() == ".sig"], ".sig files")
    contents = for_all(files, read_svc)
    side = SCANS.index(scan)
    # by default reflectance from targets with both scans in radiance
    wanted = quantity or common_quantity(
        (
            "reflectance"
            if side == 1 and file.units == ("radiance", "radiance") and file.has_reference
            else file.units[side],
            file.name,
        )
        for file in contents
    )

    def measure(pair_: tuple[SvcFile, Path]) -> SvcMeasurement:
        return _measurement(*pair_, wanted, side, joins, trim=overlap == "trim")

    measured = for_all(zip(contents, files, strict=True), measure)
    require_one_grid(
        ((item.file.name, item.wavelength) for item in measured), lambda: _joins_that_help(measured)
    )
    values = np.stack([np.where(np.isfinite(item.values), item.values, np.nan) for item in measured])
    warn_of(
        "samples that are undefined (not finite) become NaN",
        [item.file.name for item, row in zip(measured, values, strict=True) if np.isnan(row).any()],
        "samples-undefined",
    )
    coords = {
        **coords_of_channels(measured),
        **coords_of_times(contents, 1 if wanted == "reflectance" else side, wanted, dayfirst, utc_offset_h),
        **coords_of_places(contents, side),
        **coords_of_files(measured, wanted),
    }
    attrs: dict[str, Any] = {"instrument": "SVC"}
    if wanted != "reflectance":
        attrs["scan"] = scan
    trimmed_at = [item.trimmed_at for item in measured if item.trimmed_at]
    if trimmed_at:
        attrs["overlap_trimmed_at_nm"] = list(trimmed_at[0])
    data = xr.DataArray(values, dims=("spectrum", "wavelength"))
    extra = {"reflectance_scale": "relative"} if wanted == "reflectance" else {}
    return xr.Dataset({wanted: label(data, wanted, **extra)}, coords=coords, attrs=attrs)


def _check_arguments(
    quantity: str | None,
    scan: str,
    overlap: str,
    joins: tuple[float, float] | None,
    utc_offset_h: float | None,
) -> None:
    problems = Problems("SVC files cannot be opened as asked", SchemaError)
    if quantity is not None and quantity not in QUANTITIES:
        problems.add(
            f"quantity={quantity!r}", expected=f"one of {', '.join(QUANTITIES)}", code="choice-unknown"
        )
    if scan not in SCANS:
        problems.add(f"scan={scan!r}", expected="'target' or 'reference'", code="choice-unknown")
    if scan == "reference" and quantity == "reflectance":
        problems.add(
            "scan='reference' with quantity='reflectance', which is a ratio of both scans",
            mend="leave scan out, or pass quantity='radiance'",
            code="option-conflict",
        )
    if overlap not in ("keep", "trim"):
        problems.add(f"overlap={overlap!r}", expected="'keep' or 'trim'", code="choice-unknown")
    if joins is not None and not (np.size(joins) == 2 and 0.0 < joins[0] < joins[1] < math.inf):
        problems.add(
            f"joins={joins!r}", expected="two increasing wavelengths in nm", code="value-out-of-range"
        )
    problems.raise_if_any()
    if utc_offset_h is not None:
        check_utc_offset(utc_offset_h)


def _measurement(
    file: SvcFile, path: Path, quantity: str, side: int, joins: tuple[float, float] | None, *, trim: bool
) -> SvcMeasurement:
    overlap = overlap_of(file.header)
    detector = detectors_of(file, overlap.joins)
    of_reference, of_target = file.units
    if (quantity == "reflectance" or side == 0) and not file.has_reference:
        raise FormatError(
            f"{file.name}: no white reference was taken",
            mend="pass quantity='radiance'" if quantity == "reflectance" else "pass scan='target'",
            code="reference-missing",
        )
    if quantity != "reflectance":
        if file.units[side] != quantity:
            raise FormatError(
                f"{file.name}: its {SCANS[side]} is in {file.units[side]}",
                expected=quantity,
                mend=(
                    f"pass quantity={file.units[side]!r}, or save the file in {quantity} with the "
                    "vendor's software"
                ),
                code="quantity-wrong",
            )
        values = (file.reference, file.target)[side] * _SCALE[quantity]
    else:
        # the ratio of the scans, which must be in the same units and of the same integration times
        times = items(file.header.get("integration", ""))
        if of_reference != of_target:
            raise FormatError(
                f"{file.name}: its reference is in {of_reference} and its target in {of_target}",
                mend=f"pass quantity={of_target!r}",
                code="units-conflict",
            )
        if of_target == "counts" and times[: len(times) // 2] != times[len(times) // 2 :]:
            raise FormatError(
                f"{file.name}: reference and target are counts of different or unknown integration times",
                mend="save the file in radiance with the vendor's software, or pass quantity='counts'",
                code="integration-time-conflict",
            )
        values = ratio(file.target, file.reference)
    at = _handovers(file, joins) if trim else ()
    used = _trimmed(file, at)
    if not used.any():
        raise FormatError(
            f"{file.name}: its detectors do not follow one another in wavelength",
            mend="copy the file again",
            code="wavelength-unordered",
        )
    return SvcMeasurement(
        file=file,
        path=path,
        overlap=overlap,
        wavelength=file.wavelength[used],
        values=values[used],
        detector=None if detector is None else detector[used],
        trimmed_at=at,
    )


def _handovers(file: SvcFile, joins: tuple[float, float] | None) -> tuple[float, ...]:
    # The wavelength of the change of detectors, for each step back of the wavelengths [nm].
    handovers = []
    for start, join in zip(file.starts[1:], joins or SVC_JOINS, strict=False):
        first, last = float(file.wavelength[start]), float(file.wavelength[start - 1])
        # the vendor's software lets the next detector begin at its very first channel, a step above the join
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


def _trimmed(file: SvcFile, handovers: Sequence[float]) -> npt.NDArray[np.bool_]:
    # Which channels remain with one detector on each side of a join.
    used = np.ones(len(file.wavelength), bool)
    for start, join in zip(file.starts[1:], handovers, strict=False):
        used[:start] &= file.wavelength[:start] <= join
        used[start:] &= file.wavelength[start:] > join
    return used


def _joins_that_help(measured: Sequence[SvcMeasurement]) -> str:
    # The advice to trim, where trimming gives all files one set of wavelengths.
    for joins in sorted({item.overlap.joins for item in measured if item.overlap.joins is not None}):
        try:
            grids = [
                (item.file.name, item.file.wavelength[_trimmed(item.file, _handovers(item.file, joins))])
                for item in measured
            ]
        except FormatError:
            continue
        if len(same_grids(grids)) == 1:
            return f", or pass overlap='trim', joins=({joins[0]:g}, {joins[1]:g}), which makes them one"
    return ""
