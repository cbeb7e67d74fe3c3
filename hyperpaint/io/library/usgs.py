"""Spectra of the USGS spectral library (splib06, splib07) as text.

A title, then one value a line. Wavelengths and bandwidths are in files of their own, one for each
spectrometer, that lie beside the spectra or in a folder above them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError

from .library_spectra import Spectra, reflectances, text_column
from .text_spectra import in_nanometres, lines_of, numbers_of_lines, wavelength_factor

_TITLE = re.compile(r"\s*(\S{1,40})\s+Record\s*=\s*(\d{1,9})\s*:(.*)$", re.IGNORECASE)
_MEASUREMENT = re.compile(r"[A-Z]{4}")
_AXIS = re.compile(r"\s*\S{1,40}\s+Record\s*=\s*\d{1,9}\s*:\s*(?:wave|bandpass|resolution|fwhm)", re.I)
_SPECTROMETERS = ("BECK", "NIC4", "AVIRIS", "ASD")
_MAX_CANDIDATES = 64
_LEVELS = 3  # chapters lie in folders of their own


def is_usgs(head: str) -> bool:
    """Return whether the first line of a text is that of a USGS spectrum."""
    return _TITLE.match(head.partition("\n")[0]) is not None


def is_usgs_axis(head: str) -> bool:
    """Return whether the first line of a text is that of USGS wavelengths or bandwidths."""
    return _AXIS.match(head.partition("\n")[0]) is not None


def read_usgs(
    path: Path, *, scale: float | None = None, wavelength: Floats | None = None, fwhm: Floats | None = None
) -> Spectra:
    """Read a spectrum of the USGS library.

    scale: Value of a reflectance of one, 1 by default.
    wavelength, fwhm: Of the bands [nm]; by default from files beside the spectrum, or in the two folders
        above it.
    Raises FormatError: The numbers are not as they should be; it is no reflectance; or its wavelengths cannot
        be found.
    """
    source = path.name
    title, values = _column(path)
    record = _TITLE.match(title)
    heading = record[3].strip() if record else title.strip()
    name, spectrometer, measurement = heading, "", ""
    words = heading.rsplit(None, 2)
    if len(words) == 3 and _MEASUREMENT.fullmatch(words[2]):
        name, spectrometer, measurement = words
    if is_usgs_axis(title):
        raise FormatError(
            f"{source}: {heading[:60]!r} holds no spectrum",
            expected="reflectance",
            mend="pass the file as wavelength= or fwhm=",
            code="quantity-wrong",
        )
    if measurement == "TRAN":
        raise FormatError(
            f"{source}: {heading[:60]!r} is a transmittance", expected="reflectance", code="quantity-wrong"
        )
    notes: list[str] = []
    nm = _axis(path, "wave", values.size, spectrometer, notes) if wavelength is None else wavelength
    if nm is None:
        raise FormatError(
            f"{source}: no file of {values.size} wavelengths beside it or in the folders above",
            mend=f"pass wavelength=, '..._Wavelengths_...txt' of the spectrometer {spectrometer}".rstrip(),
            code="wavelength-missing",
        )
    width = _axis(path, "bandpass", values.size, spectrometer, notes) if fwhm is None else fwhm
    columns = {"spectrometer": spectrometer, "measurement": measurement}
    if record:
        columns |= {"library": record[1], "record": record[2]}
    return Spectra(
        source=source,
        form="USGS spectral library text",
        names=[name],
        wavelength=nm,
        fwhm=width,
        reflectance=reflectances(values[None, :], source, file_scale=None, scale=scale),
        columns={key: text_column([value]) for key, value in columns.items()},
        notes=notes,
    )


def _column(path: Path) -> tuple[str, Floats]:
    lines = lines_of(path, "a file of the USGS spectral library")
    values = numbers_of_lines(lines, 1, 1, path.name)[:, 0]
    if values.size < 2:
        raise FormatError(
            f"{path.name}: {values.size} values",
            expected="a title and one value a line",
            code="table-missing",
        )
    return lines[0], values


def read_usgs_axis(path: Path) -> tuple[Floats, str]:
    """Return the wavelengths or bandwidths of a USGS file [nm], and a note on their units.

    Raises FormatError: The file is damaged, or holds something else.
    """
    title, values = _column(path)
    factor, note = wavelength_factor(title.replace("_", " "), values, path.name)
    if not np.isfinite(values).all():
        raise FormatError(f"{path.name}: not all of its {values.size} values are finite", code="not-finite")
    return in_nanometres(values, factor), note


def _axis(path: Path, kind: str, count: int, spectrometer: str, notes: list[str]) -> Floats | None:
    # The wavelengths or bandwidths from a file near a spectrum; None without one of equal length.
    axes = {}
    for file in _candidates(path, kind):
        try:
            values, note = read_usgs_axis(file)
        except FormatError:
            continue
        if values.size == count:
            axes[file] = (values, note)
    code = next((code for code in _SPECTROMETERS if spectrometer.upper().startswith(code)), None)
    if len(axes) > 1 and code:
        axes = {file: axis for file, axis in axes.items() if code in file.name.upper()} or axes
    if len({values.tobytes() for values, _ in axes.values()}) > 1:
        listed = ", ".join(sorted(file.name for file in axes))
        option = "wavelength=" if kind == "wave" else "fwhm="
        raise FormatError(
            f"{path.name}: {listed} have {count} values each",
            mend=f"pass the right one as {option}",
            code="wavelength-ambiguous",
        )
    for file, (values, note) in axes.items():
        notes.append(f"{'wavelengths' if kind == 'wave' else 'fwhm'} of {file.name}{note and ': ' + note}")
        return values
    return None


def _candidates(path: Path, kind: str) -> list[Path]:
    words = ("wavelength",) if kind == "wave" else ("bandpass", "fwhm", "resolution")
    folder = path.absolute().parent
    for above in [folder, *folder.parents][:_LEVELS]:
        try:
            names = sorted(entry.name for entry in above.iterdir())
        except OSError:
            continue
        fitting = [n for n in names if n.lower().endswith(".txt") and any(w in n.lower() for w in words)]
        if kind != "wave":  # names of spectra convolved to another spectrometer hold "wavelength"
            fitting = [name for name in fitting if "wavelength" not in name.lower()]
        if fitting:
            return [above / name for name in fitting[:_MAX_CANDIDATES] if (above / name) != path.absolute()]
    return []
