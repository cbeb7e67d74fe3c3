"""Spectra of ASD field spectrometers, binary or exported as text, as labelled arrays."""

from __future__ import annotations

import datetime as dt
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, TimeError
from hyperpaint.base.facts import one_of
from hyperpaint.base.input_files import head_of
from hyperpaint.base.schema import VARIABLES, label

from .asd_binary import AsdFile, AsdGps, is_asd, read_asd
from .asd_text import AsdText, is_asd_text, read_asd_text
from .irradiance_files import is_irradiance_csv
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
)

Kind = Literal["binary", "text", "csv", "unknown"]

_QUANTITY_OF_DATA_TYPE = {"raw": "counts", **{name: name for name in QUANTITIES[1:]}}
#: Kind of the block that a calibration file replaces, by its key in ``calibration``.
_CALIBRATION_KEYS = {"lamp": "LMP", "fore_optic": "FO", "panel": "BSE", "absolute": "ABS"}

_BLOCKS_BY_QUANTITY = {"irradiance": ("LMP", "FO"), "radiance": ("LMP", "FO", "BSE")}
_HEAD_BYTES = 16 * 1024
_TEXT_SUFFIXES = (".txt", ".tsv", ".csv")


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A spectrum of one quantity (such as radiance), from a binary or text file."""

    source: str  # file name, with the column if the file holds several spectra
    wavelength: Floats  # (wavelength) [nm], float64
    values: Floats
    # Local time of the logging PC, its UTC offset [h], and the averaging window [s]; None if not in the file
    local_time: dt.datetime | None = None
    utc_offset_h: float | None = None
    averaging_s: float | None = None
    dark_utc: dt.datetime | None = None  # UTC of the last dark measurement
    gps: AsdGps | None = None
    # (wavelength), True at channels of a detector that the file flags as saturated
    saturated: npt.NDArray[np.bool_] | None = None
    path: Path | None = None
    # Name of the white panel whose known reflectance scales the spectrum; empty for relative reflectance
    panel: str = ""


def open_asd(
    paths: Paths,
    quantity: str | None = None,
    *,
    absolute: bool = False,
    utc_offset_h: float | None = None,
    calibration: Mapping[str, str | os.PathLike[str]] | None = None,
) -> xr.Dataset:
    r"""Open spectra of an ASD field spectrometer.

    Parameters
    ----------
    paths
        A file, a glob, a folder, or a list of files: binary ``.asd`` files of any version, or text exports.
    quantity
        ``counts``, ``reflectance`` (spectrum / white reference), ``radiance`` or ``irradiance``. By default
        the quantity displayed to the operator, which binary files hold; for a text export it is guessed
        from the range of the operator's plot, with a warning.
    absolute
        Multiply reflectance, which is relative to the white panel, by the panel's own (the block ABS).
    utc_offset_h
        Local time of the logging PC minus UTC [h]. By default each file's own, which files with a white
        reference hold.
    calibration
        Files of the instrument's calibration, for files without calibration blocks: by ``lamp`` (``.ill``),
        ``fore_optic`` (``.raw``) and ``panel`` (``.ref``) for radiance and irradiance, by ``absolute``
        (``.ref``) for absolute reflectance.

    Returns
    -------
    xarray.Dataset
        One variable, named by its quantity, on (spectrum, wavelength), float64, ordered by time; coordinates
        ``spectrum`` (names of the files without ``.asd``, or of the columns of an export), ``wavelength``
        [nm], ``time`` (UTC, NaT without a stamp or its zone), ``source``, ``latitude``, ``longitude`` and
        ``altitude`` (NaN without a GPS fix). Stamps are whole seconds, as in the files. Attributes of
        reflectance: ``reflectance_scale``, relative (to the white panel) or absolute, and the ``panel``.

    Raises
    ------
    FormatError
        Files are missing or damaged, lack the reference or the calibration blocks the quantity needs, or
        differ in wavelengths; all are named.
    TimeError
        ``utc_offset_h`` is the offset of no zone.
    SchemaError
        ``quantity`` or ``calibration`` is not one of those above, or ``absolute`` is set for another
        quantity than reflectance.

    Warns
    -----
    PaintWarning
        Saturated or undefined samples, which become NaN; a guessed quantity; spectra whose dark current was
        not subtracted; a UTC offset that contradicts the files; local times whose zone is unknown, which are
        NaT.

    Notes
    -----
    A file always holds raw counts, from which, after the vendor's software,

        E = LMP * (DN / FO) * (t_cal / t),  L = E * BSE / pi

    with the lamp's irradiance LMP, the counts FO that it gave in t_cal, and the panel's reflectance BSE. The
    formula is proven for the VNIR detector alone, so that radiance and irradiance end at the first splice
    (1000 nm). Text exports come as the vendor's software computed them, to their last wavelength.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "paint.asd.txt")
    >>> _ = path.write_text("Wavelength;paint.asd\n550; 0.0669 \n551; 0.0671 \n")
    >>> open_asd(path, "reflectance")["reflectance"].values
    array([[0.0669, 0.0671]])
    """
    files = find_files(paths)
    spectra, quantity = read_spectra(files, quantity, absolute=absolute, calibration=calibration)
    with_stamp = [s for s in spectra if s.local_time is not None]
    if utc_offset_h is None and (without_zone := [s for s in with_stamp if s.utc_offset_h is None]):
        text = f"local times are NaT, since {_missing_zone_text(without_zone)}"
        warnings.warn(PaintWarning(text, code="zone-missing"), stacklevel=2)
        with_stamp = [s for s in with_stamp if s.utc_offset_h is not None]
    offsets = dict(zip(map(id, with_stamp), utc_offsets(with_stamp, utc_offset_h), strict=True))
    times = np.full(len(spectra), np.datetime64("NaT", "ns"))
    for number, spectrum in enumerate(spectra):
        if spectrum.local_time is not None and id(spectrum) in offsets:
            offset = np.timedelta64(round(offsets[id(spectrum)] * 3600e9), "ns")
            times[number] = np.datetime64(spectrum.local_time, "ns") - offset
    order = np.argsort(times, kind="stable")  # NaT last
    spectra = [spectra[i] for i in order]
    values = xr.DataArray(np.stack([s.values for s in spectra]), dims=("spectrum", "wavelength"))
    extra = {}
    if quantity == "reflectance":
        panels = sorted({spectrum.panel for spectrum in spectra} - {""})
        extra = (
            {"reflectance_scale": "absolute", "panel": listed(panels)}
            if panels
            else {"reflectance_scale": "relative"}
        )
    return xr.Dataset(
        {quantity: label(values, quantity, **extra)},
        coords=_coords(spectra, times[order]),
        attrs={"instrument": "ASD"},
    )


def _coords(spectra: Sequence[Spectrum], times: npt.NDArray[np.datetime64]) -> dict[str, Any]:
    names = name_spectra([(s.path or Path(s.source), _column_or_file_name(s)) for s in spectra])
    wavelength_attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the spectrometer"}
    coords: dict[str, Any] = {
        "spectrum": ("spectrum", np.array(names, object), {"long_name": "Name of the spectrum"}),
        "wavelength": ("wavelength", spectra[0].wavelength, wavelength_attrs),
        "time": ("spectrum", times, {"long_name": "UTC at which the spectrum was saved"}),
        "source": ("spectrum", np.array([s.source for s in spectra], object), {"long_name": "File"}),
    }
    for name in ("latitude", "longitude", "altitude"):
        positions = [np.nan if s.gps is None else getattr(s.gps, name) for s in spectra]
        attrs = {**VARIABLES[name].attrs, "long_name": f"{name.capitalize()} of the spectrometer"}
        coords[name] = ("spectrum", np.array(positions, np.float64), attrs)
    return coords


def _column_or_file_name(spectrum: Spectrum) -> str:
    # Return the column of a text export, or else the file name, without file endings.
    name = spectrum.source.rpartition(":")[2]
    while name.lower().endswith((".asd", *_TEXT_SUFFIXES)):  # ViewSpec adds its ending: paint.asd.txt
        name = name[:-4]
    return name


def find_files(paths: Paths) -> list[Path]:
    """Return the files of ``paths``: a file, a glob, a folder of spectra, or a list of these.

    From a folder, the ``.asd`` files (of old software: ``.000`` and other numbers), or else its text files.

    Raises FormatError: No such file is found.
    """

    def of_folder(files: list[Path]) -> list[Path]:
        binaries = [path for path in files if path.suffix.lower() == ".asd" or path.suffix[1:].isdigit()]
        return binaries or [path for path in files if path.suffix.lower() in _TEXT_SUFFIXES]

    return find_paths(paths, of_folder, ".asd files, text exports or a csv")


def read_spectra(
    files: Sequence[Path],
    quantity: str | None,
    *,
    absolute: bool = False,
    calibration: Mapping[str, str | os.PathLike[str]] | None = None,
) -> tuple[list[Spectrum], str]:
    """Read binary files and text exports into spectra of one quantity on one set of wavelengths.

    Returns spectra : list of Spectrum: In the order of ``files``.
    Returns quantity : str: Their quantity.
    Raises FormatError: See `open_asd`.
    Raises SchemaError: See `open_asd`.
    """
    if quantity is not None:
        one_of(quantity, QUANTITIES, "quantity")
    # calibration files of the caller, by kind of block
    calibration = calibration or {}
    if unknown := sorted(set(calibration) - set(_CALIBRATION_KEYS)):
        raise SchemaError(
            f"calibration keys {unknown}",
            expected=f"some of {', '.join(_CALIBRATION_KEYS)}",
            code="key-unknown",
        )
    calibration_files = for_all(calibration.values(), read_asd)
    external_files = {
        _CALIBRATION_KEYS[key]: file for key, file in zip(calibration, calibration_files, strict=True)
    }
    contents = for_all(files, _read_file)
    target_quantity = quantity or _common_quantity(contents)
    if absolute and target_quantity != "reflectance":
        raise SchemaError(
            f"absolute=True with quantity {target_quantity!r}",
            expected="reflectance",
            mend="omit absolute=, or pass quantity='reflectance'",
            code="option-conflict",
        )
    spectra_by_file = for_all(
        contents, lambda content: _spectra_of(content, target_quantity, external_files, absolute)
    )
    spectra = [
        replace(spectrum, path=path)
        for path, file_spectra in zip(files, spectra_by_file, strict=True)
        for spectrum in file_spectra
    ]
    require_one_grid((spectrum.source, spectrum.wavelength) for spectrum in spectra)
    names_with_dark = [
        content.name for content in contents if isinstance(content, AsdFile) and not content.dark_subtracted
    ]
    if names_with_dark and target_quantity != "counts":
        text = f"{target_quantity} is biased: dark current not subtracted in {listed(names_with_dark)}"
        warnings.warn(PaintWarning(text, code="dark-not-subtracted"), stacklevel=2)
    return mask_undefined(spectra, target_quantity), target_quantity


def _read_file(path: Path) -> AsdFile | AsdText:
    kind = sniff(path)
    if kind == "binary":
        return read_asd(path)
    if kind == "text":
        return read_asd_text(path)
    if path.is_file():
        found, code = "neither a binary .asd file nor a text export of ASD spectra", "format-unknown"
    elif os.path.lexists(path):
        found, code = "a pipe, a device or a broken link", "file-not-plain"
    else:
        found, code = "no such file", "file-not-found"
    raise FormatError(f"{path.name}: {found}", code=code)


def sniff(path: Path) -> Kind:
    """Return the kind of spectra in a file, by its first bytes; ``unknown`` also for a missing file."""
    head = head_of(path, _HEAD_BYTES)
    if is_asd(head):
        return "binary"
    if is_asd_text(head):
        return "text"
    return "csv" if is_irradiance_csv(head) else "unknown"


def _common_quantity(contents: Sequence[AsdFile | AsdText]) -> str:
    quantity = common_quantity(
        (
            _QUANTITY_OF_DATA_TYPE.get(content.data_type)
            if isinstance(content, AsdFile)
            else content.likely_quantity,
            content.name,
        )
        for content in contents
    )
    texts = [content.name for content in contents if isinstance(content, AsdText)]
    if texts:
        text = (
            f"text exports do not state their quantity; {quantity} is a guess from the range of the plot. "
            f"Pass quantity={quantity!r} if it is right. Files: {', '.join(texts)}"
        )
        warnings.warn(PaintWarning(text, code="quantity-assumed"), stacklevel=3)
    return quantity


def _spectra_of(
    content: AsdFile | AsdText, quantity: str, external_files: Mapping[str, AsdFile], absolute: bool
) -> list[Spectrum]:
    if isinstance(content, AsdFile):
        wavelength, values, saturated = _in_quantity(content, quantity, external_files, absolute=absolute)
        panel = external_files.get("ABS", content.calibrations.get("ABS"))
        return [
            Spectrum(
                content.name,
                wavelength,
                values,
                content.local_time,
                content.utc_offset_h,
                averaging_s=content.integration_ms * 1e-3 * max(content.sample_averages, 1),
                dark_utc=content.dark_utc,
                gps=content.gps,
                saturated=saturated,
                panel=panel.name if absolute and panel is not None else "",
            )
        ]
    if absolute:
        raise FormatError(
            f"{content.name}: a text export does not contain the panel's reflectance, which absolute= needs",
            mend="open the binary file",
            code="option-conflict",
        )
    averaging_s = None
    if content.integration_ms is not None:
        averaging_s = content.integration_ms * 1e-3 * max(content.sample_averages or 1, 1)
    has_several = len(content.spectra) > 1
    return [
        Spectrum(
            f"{content.name}:{column}" if has_several else content.name,
            content.wavelength,
            values,
            content.local_time,
            averaging_s=averaging_s,
        )
        for column, values in zip(content.spectra, content.values, strict=True)
    ]


def mask_undefined(spectra: Sequence[Spectrum], quantity: str) -> list[Spectrum]:
    """Replace saturated and undefined samples, and spectra of only zeros, by NaN, with a warning."""
    reasons: dict[str, list[str]] = {}
    masked = []
    for spectrum in spectra:
        is_undefined = ~np.isfinite(spectrum.values)
        if is_undefined.any():
            reasons.setdefault("undefined (not finite)", []).append(spectrum.source)
        if quantity != "counts" and not spectrum.values.any():
            reasons.setdefault("zero throughout", []).append(spectrum.source)
            is_undefined[:] = True
        # saturated counts are kept: users examine them for saturation
        if quantity != "counts" and spectrum.saturated is not None and spectrum.saturated.any():
            reasons.setdefault("saturated", []).append(spectrum.source)
            is_undefined |= spectrum.saturated
        masked.append(replace(spectrum, values=np.where(is_undefined, np.nan, spectrum.values)))
    for reason, names in reasons.items():
        text = (
            f"samples that are {reason} become NaN in {len(names)} of {len(spectra)} spectra: {listed(names)}"
        )
        warnings.warn(PaintWarning(text, code="samples-undefined"), stacklevel=2)
    return masked


def utc_offsets(
    spectra: Sequence[Spectrum], utc_offset_h: float | None, *, one_clock: bool = False
) -> list[float]:
    """Return local time minus UTC [h] of each spectrum.

    spectra: With the zone of the logging PC, where the file holds it.
    utc_offset_h: Given by the user. It takes precedence over the files' offsets; a difference is warned of.
    one_clock: Whether one PC stamped all spectra. Files without an offset then get that of the other files,
        which must agree.
    Raises TimeError: An offset is unknown or impossible, or the offsets of one PC differ.
    """
    sources_by_offset: dict[float, list[str]] = {}
    for spectrum in spectra:
        if spectrum.utc_offset_h is not None:
            sources_by_offset.setdefault(spectrum.utc_offset_h, []).append(spectrum.source)
    offsets_text = "; ".join(f"{hours:+g} h in {listed(names)}" for hours, names in sources_by_offset.items())
    if utc_offset_h is not None:
        check_utc_offset(utc_offset_h)
        if set(sources_by_offset) - {utc_offset_h}:
            text = f"utc_offset_h={utc_offset_h:+g} is used, although the files have {offsets_text}"
            warnings.warn(PaintWarning(text, code="utc-offset-conflict"), stacklevel=2)
        return [utc_offset_h] * len(spectra)
    if one_clock and len(sources_by_offset) > 1:
        raise TimeError(
            f"UTC offsets differ within one series: {offsets_text}",
            mend="pass utc_offset_h=",
            code="utc-offset-conflict",
        )
    if one_clock and sources_by_offset:
        return [next(iter(sources_by_offset))] * len(spectra)
    without_zone = [spectrum for spectrum in spectra if spectrum.utc_offset_h is None]
    if without_zone:
        raise TimeError(
            f"the time stamps are local, and {_missing_zone_text(without_zone)}", code="zone-missing"
        )
    return [spectrum.utc_offset_h for spectrum in spectra if spectrum.utc_offset_h is not None]


def _missing_zone_text(without_zone: Sequence[Spectrum]) -> str:
    hint = next((hint for hint in map(_offset_hint, without_zone) if hint), "")
    files = listed([spectrum.source for spectrum in without_zone])
    return (
        "the files contain no UTC offset; pass utc_offset_h= (local time minus UTC in hours)"
        f"{hint}. Files: {files}"
    )


def _offset_hint(spectrum: Spectrum) -> str:
    # Return a hint at the UTC offset from the GPS time, or from the UTC stamp of the dark current.
    if spectrum.gps is not None and spectrum.local_time is not None:
        gps_time = dt.datetime.combine(spectrum.local_time.date(), spectrum.gps.utc)
        hours = round((spectrum.local_time - gps_time) / dt.timedelta(hours=1))
        return f", perhaps {(hours + 11) % 24 - 11:+d} by the GPS"
    if spectrum.dark_utc is None or spectrum.local_time is None:
        return ""
    hours = (spectrum.local_time - spectrum.dark_utc) // dt.timedelta(hours=1)
    return f", perhaps {hours:+d} by the stamp of the dark current" if -12 <= hours <= 14 else ""


# --- from counts to quantities -----------------------------------------------------------------------------


def _in_quantity(
    file: AsdFile, quantity: str, external_files: Mapping[str, AsdFile], *, absolute: bool = False
) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Return the wavelengths, the values in ``quantity``, and where the detector was saturated.

    See the notes of `open_asd` for the formulas; ``external_files`` are calibration files by kind, used
    instead of the blocks in the file. ``absolute`` multiplies reflectance by the panel's reflectance.

    Raises FormatError: The reference or calibration blocks that the quantity needs are missing.
    """
    wavelength, values = file.wavelength, file.spectrum
    # saturation flags of the detectors VNIR, SWIR 1 and SWIR 2, whose ends are infinite if they are the last
    ends = [splice if splice > 0 else np.inf for splice in file.splices]
    detector = np.searchsorted([ends[0], max(ends)], wavelength)
    is_saturated = np.array([name in file.saturated for name in ("VNIR", "SWIR1", "SWIR2")])[detector]
    if quantity == "reflectance":
        if file.reference is None:
            raise FormatError(
                f"{file.name}: no white reference in the file, so no reflectance",
                mend="pass quantity='counts', or give files saved after the white reference was taken",
                code="reference-missing",
            )
        values = ratio(file.spectrum, file.reference)
        if absolute:
            with np.errstate(all="ignore"):
                values = (
                    values
                    * _calibration_blocks(file, ("ABS",), "absolute reflectance", external_files)["ABS"][0]
                )
    elif quantity in _BLOCKS_BY_QUANTITY:
        blocks = _calibration_blocks(file, _BLOCKS_BY_QUANTITY[quantity], quantity, external_files)
        lamp_counts, lamp_ms = blocks["FO"]
        if file.integration_ms <= 0 or lamp_ms <= 0:
            raise FormatError(
                f"{file.name}: integration times {file.integration_ms:g} ms, calibration {lamp_ms:g} ms",
                expected="positive numbers",
                code="value-out-of-range",
            )
        with np.errstate(all="ignore"):  # damaged values; those not finite are reported later
            per_count = ratio(blocks["LMP"][0], lamp_counts) * (lamp_ms / file.integration_ms)
            if quantity == "radiance":
                per_count = per_count * blocks["BSE"][0] / np.pi
            values = file.spectrum * per_count
        is_vnir = wavelength <= ends[0]
        if not is_vnir.any():
            raise FormatError(
                f"{file.name}: all wavelengths lie beyond the first splice",
                mend="copy the file again",
                code="wavelength-range",
            )
        return wavelength[is_vnir], values[is_vnir], is_saturated[is_vnir]
    return wavelength, values, is_saturated


def _calibration_blocks(
    file: AsdFile, kinds: tuple[str, ...], purpose: str, external_files: Mapping[str, AsdFile]
) -> dict[str, tuple[Floats, float]]:
    # Return values and integration time [ms] of the calibration blocks, by kind; all of ``kinds`` exist.
    blocks = {kind: (block.values, block.integration_ms) for kind, block in file.calibrations.items()}
    for kind, external_file in external_files.items():
        if kind in kinds and not np.array_equal(external_file.wavelength, file.wavelength):
            raise FormatError(
                f"{file.name}: wavelengths differ from calibration file {external_file.name}",
                code="grid-mismatch",
            )
        blocks[kind] = (external_file.spectrum, external_file.integration_ms)
    missing = [kind for kind in kinds if kind not in blocks]
    if missing:
        keys = [key for key, kind in _CALIBRATION_KEYS.items() if kind in missing]
        raise FormatError(
            f"{file.name}: no calibration block {' and '.join(missing)} in the file, so no {purpose}",
            mend=(
                f"pass calibration={{{', '.join(f'{key!r}: path' for key in keys)}}} with the files of the "
                "instrument (.ill, .raw, .ref), or export the spectra as text with the vendor's software"
            ),
            code="calibration-missing",
        )
    return blocks
