"""Paint libraries written in the style of the ECOSTRESS library: a folder with a text file for each paint."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import PAINT
from hyperpaint.io.files.publishing import published_folder

from .ecostress import METADATA
from .records import CENTRE, names_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["SUFFIX", "file_names", "write_ecostress_library"]

SUFFIX = ".spectrum.txt"
_LONGEST_STEM = 80
_SPELLINGS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})
_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))}
_MOST_SHOWN = 5

_MEASUREMENT = "Hemispherical-conical reflectance factor"

_SAMPLE = (
    ("Type", "type", "manmade"),
    ("Class", "class", "Paint"),
    ("Subclass", "subclass", "none"),
    ("Particle Size", "particle_size", "Solid"),
    ("Sample No.", "sample_no", "none"),
    ("Owner", "owner", "none"),
    ("Wavelength Range", "wavelength_range", "none"),
    ("Origin", "origin", "none"),
    ("Collection Date", "collection_date", "N/A"),
    ("Description", "description", "none"),
    ("Measurement", "measurement", _MEASUREMENT),
)
"""Keys of a header before those of the axes, the coordinate that holds each, and what stands otherwise."""


def write_ecostress_library(
    library: xr.Dataset, path: Path, *, overwrite: bool, progress: Callable[[int, int], None] | None
) -> None:
    """Write the centre of every paint of a checked library to a text file of its own.

    Bands that are not good, and bands at which no paint has a value, are left out. What else the library says
    of its paints, in words or numbers, stands as JSON in "Additional Information".

    Raises
    ------
    SchemaError
        Names cannot be written; or a paint has no value at a band at which others have one, since the format
        knows no missing values.
    StoreError
        The folder exists, holds something else, or cannot be written.
    """
    names = names_of(library)
    if broken := [name for name in names if name != name.strip()]:
        raise SchemaError(
            f"{len(broken)} names begin or end with blanks, such as {broken[0]!r}, which a header does not "
            "keep; rename them"
        )
    values = np.asarray(library[CENTRE].values, np.float64)
    kept = np.isfinite(values).any(axis=0)
    if "good" in library.variables:
        kept &= np.asarray(library["good"].values, np.bool_)
    values = values[:, kept]
    _refuse_gaps(values, names)
    micrometres = np.asarray(library["wavelength"].values, np.float64)[kept] / 1e3
    columns = {**_said_of_all(library, micrometres), **_columns(library)}
    with published_folder(path, overwrite=overwrite, foreign=_foreign) as folder:
        for at, (name, stem) in enumerate(zip(names, file_names(names), strict=True)):
            about = {key: column[at] for key, column in columns.items()}
            text = _text(name, about, micrometres, values[at])
            (folder / f"{stem}{SUFFIX}").write_bytes(_encoded(text))
            if progress is not None:
                progress(at + 1, len(names))


def _foreign(folder: Path) -> str:
    for path in folder.iterdir():
        if not (path.name.endswith(SUFFIX) and path.is_file() and not path.is_symlink()):
            return f"{path.name}, which no library has"
    return ""


def _refuse_gaps(values: Floats, names: Sequence[str]) -> None:
    problems = Problems("the library cannot be written as ECOSTRESS text", SchemaError)
    gaps = np.flatnonzero(~np.isfinite(values).all(axis=1))
    for at in gaps[:_MOST_SHOWN]:
        missing = int((~np.isfinite(values[at])).sum())
        problems.add(f"paint {names[at]!r} has no value at {missing} of {values.shape[1]} bands")
    if gaps.size:
        problems.add(
            f"{gaps.size} paints in all; choose bands that all have (.isel(band=...)), or another format"
        )
    if not values.size:
        problems.add("no band is good and has values")
    problems.raise_if_any()


def file_names(names: Sequence[str]) -> list[str]:
    """Return the stem of a file for each paint: plain letters, no two alike on any file system.

    Examples
    --------
    >>> file_names(["Grün, matt", "a/b", "A b", "", "aux"])
    ['Gruen_matt', 'a_b', 'A_b_2', 'unnamed', 'aux_']
    """
    made: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain = unicodedata.normalize("NFKD", name.translate(_SPELLINGS))
        words = "".join(
            c if c.isascii() and (c.isalnum() or c in "-+") else " "
            for c in plain
            if not unicodedata.combining(c)
        )
        stem = "_".join(words.split())[:_LONGEST_STEM] or "unnamed"
        if stem.lower() in _RESERVED:
            stem += "_"
        unique, turn = stem, 1
        while unique.lower() in taken:
            turn += 1
            unique = f"{stem}_{turn}"
        taken.add(unique.lower())
        made.append(unique)
    return made


def _said_of_all(library: xr.Dataset, micrometres: Floats) -> dict[str, list[Any]]:
    """Return fields of the header that the library says once; those of single paints win."""
    mirrored = library[CENTRE].attrs.get("mirror_reflection")
    made = {
        "origin": library.attrs.get("source"),
        "measurement": f"{_MEASUREMENT}, mirror reflection {mirrored}" if mirrored else None,
        "wavelength_range": _range(micrometres),
    }
    return {name: [str(value)] * library.sizes[PAINT] for name, value in made.items() if value}


def _range(micrometres: Floats) -> str:
    """Return the words of the ECOSTRESS library for a range of wavelengths."""
    if micrometres.max() <= 3.0:
        return "VSWIR"
    return "TIR" if micrometres.min() >= 2.0 else "All"


def _columns(library: xr.Dataset) -> dict[str, list[Any]]:
    """Return what the library says of each paint, as texts and numbers."""
    made: dict[str, list[Any]] = {}
    for name, array in library.variables.items():
        # the name of a file that was read is none of the file that is written
        if array.dims != (PAINT,) or name in (PAINT, "file") or not str(name).isidentifier():
            continue
        values = array.values
        if values.dtype.kind == "M":
            made[str(name)] = ["" if np.isnat(value) else str(value) for value in values]
        elif values.dtype.kind in "biufOUT":
            plain = values.tolist()
            made[str(name)] = [None if isinstance(v, float) and not np.isfinite(v) else v for v in plain]
    return made


def _text(name: str, about: dict[str, Any], micrometres: Floats, values: Floats) -> str:
    """Return a file; its header has the keys of the ECOSTRESS library, in their order."""
    about = dict(about)
    lines = [f"Name: {name}"]
    if "collection_date" not in about and about.get("time"):
        about["collection_date"] = str(about["time"])[:10]
    for key, coordinate, otherwise in _SAMPLE:
        told = " ".join(str(about.pop(coordinate, "") or "").split())
        lines.append(f"{key}: {told or otherwise}")
    more = " ".join(str(about.pop("additional_information", "") or "none").split())
    if about:
        more = METADATA + json.dumps(about, ensure_ascii=False, allow_nan=False)
    axis = [f"{value:.10g}" for value in micrometres]
    lines += [
        "First Column: X",
        "Second Column: Y",
        "X Units: Wavelength (micrometers)",
        "Y Units: Reflectance (percent)",
        f"First X Value: {axis[0]}",
        f"Last X Value: {axis[-1]}",
        f"Number of X Values: {len(axis)}",
        f"Additional Information: {more}",
        "",
        # nine digits of the percentage lead back to the float32
        *(f"{x}\t{100.0 * y:.9g}" for x, y in zip(axis, values, strict=True)),
    ]
    return "\n".join(lines) + "\n"


def _encoded(text: str) -> bytes:
    """Return latin-1, as these libraries use it; UTF-8 where that would not lead back."""
    try:
        raw = text.encode("latin-1")
    except UnicodeEncodeError:
        return text.encode()
    if raw.isascii():
        return raw
    try:
        raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw
    return text.encode()
