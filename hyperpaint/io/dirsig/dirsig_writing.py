"""A paint library as a folder of materials of the simulator DIRSIG."""

from __future__ import annotations

import contextlib
import json
import os
import re
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import FormatError, PaintWarning, Problem, Problems, SchemaError, StoreError
from hyperpaint.base.facts import documented
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE, require
from hyperpaint.base.units import takes_quantities
from hyperpaint.io.files.publishing import published_folder

from .emissivity_files import CURVE_BEGIN, ColumnText, emissivity_head
from .instructions import THERMAL, glist_text, material_section, readme_text
from .material_list import Material, material_ids, material_names, materials_text, read_materials
from .paint_curves import (
    CURVES,
    GAPS,
    MAX_NM,
    MIN_NM,
    Axis,
    Choices,
    Coat,
    PaintCurves,
    PaintProblemError,
    blocks_of,
    coat_of,
    curves_of,
)

EMISSIVITY, REFLECTANCE = "emissivity", "reflectance"

#: Name of the file that identifies an export.
MARKER = "paints.json"

FORMAT = "hyperpaint DIRSIG export"
#: Names of files and folders in exports.
_OWN = re.compile(
    r"emissivity|reflectance|geometry|maps|materials|README\.txt|materials\.mat|paints\.(glist|json)|.*\.(scene|jsim)"
)

_MAX_BYTES = 256 * 2**20
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")


@contextlib.contextmanager
def export_folder(
    folder: str | os.PathLike[str], *, overwrite: bool, inside: Sequence[str] = (EMISSIVITY, REFLECTANCE)
) -> Iterator[Path]:
    """Yield a folder for an export, moved to its place when the block ends without error.

    ``folder``: the place: new, empty, or an earlier export; ``overwrite``: whether that may be replaced;
    ``inside``: folders to make in it.

    Raises `StoreError`: The place holds anything else, or an export that may not be replaced; another writes
    there; or it, or a file inside, cannot be written.
    """
    if _URL.match(os.fspath(folder)):
        raise StoreError(
            f"{os.fspath(folder)!r} is a URL",
            expected="a folder",
            mend="write to a folder and copy it",
            code="folder-is-url",
        )
    with published_folder(Path(os.path.abspath(folder)), overwrite=overwrite, foreign=_foreign) as build:
        for name in inside:
            (build / name).mkdir(parents=True)
        yield build


def _foreign(folder: Path) -> str:
    try:
        document = json.loads(read_limited(folder / MARKER, _MAX_BYTES, "an export"))
    except (FormatError, ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        return "other files"
    strange = sorted(path.name for path in folder.iterdir() if not _OWN.fullmatch(path.name))
    return f"{strange[0]}, which no export has" if strange else ""


SURFACES = ("ClassicEmissivity", "SimpleReflectance")
_MAX_SHOWN = 20
#: Curves formatted as text at a time.
_CURVES_AT_ONCE = 64

_RGB = (640.0, 550.0, 460.0)


@takes_quantities(wavelength_range="nm")
@documented(overwrite="own overwrite")
def write_dirsig(
    library: xr.Dataset,
    folder: str | os.PathLike[str],
    *,
    curves: str | None = None,
    wavelength_range: tuple[float, float] | None = None,
    extrapolate: bool = False,
    gaps: str | None = None,
    max_curves: int | None = None,
    specular: float | str = 0.0,
    surface: str = "ClassicEmissivity",
    rad_solver: str = "Classic",
    thermal: Mapping[str, float] | None = None,
    double_sided: bool = False,
    scene_materials: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    r"""Write the paints of a library as materials of the simulator DIRSIG.

    Every paint becomes an ``.ems`` file with many curves, so that a texture can draw from the population, a
    two-column ``.txt`` of its centre and a MATERIAL_ENTRY; with them go a fragment of a geometry list and a
    README that says step by step how to add them. The folder appears when all is written, or not at all.
    Paints are read and written some at a time.

    Parameters
    ----------
    library
        A paint library: ``reflectance`` (signature, band) [1], ``wavelength`` (band) [nm], in any order.
    folder
    curves
        ``members`` for the single pixels, ``quantiles``, or ``centre`` for one curve a paint. By default
        members where the library has them, else the centre.
    wavelength_range
        Low and high end [nm]; the bands next to it outside are written too, so that all of it is covered. By
        default all that was measured.
    extrapolate
        Hold curves constant where ``wavelength_range`` goes beyond what was measured; the README says where.
    gaps
        What to do about bands without values, or not ``good``, between others: ``interpolate`` by a straight
        line, or ``refuse``. By default they are interpolated, with a warning; the README says in which
        curves, and at which wavelengths: complete curves come first in a file. Bands that no pixel has at an
        end are left away; single members that lack an end are left out, and where all do, the centre is the
        only curve.
    max_curves
        Curves of a paint at the most, at even ranks of their brightness, complete ones first; None for all.
    specular
        Fraction of reflectance that DIRSIG shall mirror [1], or ``library`` to take it from the library's
        ``specular_reflectance`` (signature, band). Only for reflectance without mirrored light.
    surface
        What the materials use: ``ClassicEmissivity`` (the ``.ems``) or ``SimpleReflectance`` (the ``.txt``).
    rad_solver
        Name of DIRSIG's radiometry solver.
    thermal
        Parameters of the temperature solver Therm, all of ``specific_heat``, ``mass_density``,
        ``thermal_conductivity``, ``solar_absorption``, ``thermal_emissivity``, ``exposed_area`` and
        ``thickness``, in DIRSIG's units. By default no temperature is computed.
    double_sided
        Whether the back of a facet shows the paint too.
    scene_materials
        A scene's own material list, whose IDs and names are not used again.
    overwrite
    progress

    Returns
    -------
    Dataset
        What was written (signature): ``material_id``, ``emissivity_file``, ``curves``, how many of them are
        ``complete``, their samples ``clipped`` and ``interpolated``, those of the ``.txt`` ``centre_clipped``
        and ``centre_interpolated``, members ``left_out`` and ``thinned``, the range and ``extrapolated``. Its
        attributes describe the treatment of mirrored light: ``mirror_reflection``, ``specular_term``.

    Raises
    ------
    SchemaError
        It is no paint library, or has no curves of the kind; an option is not one of those above; a specular
        term would count the clear coat twice; paints have no values, holes, or do not reach as far as asked;
        all are listed.
    UnitsError
        Units cannot be read.
    FormatError
        ``scene_materials`` is no material list.
    StoreError
        The folder holds something, is being written by another, or cannot be written.

    Notes
    -----
    Of an opaque paint

    .. math:: \epsilon = 1 - \rho / (1 - s)

    with the specular fraction s, so that the diffuse part :math:`(1 - s)(1 - \epsilon)` is the body
    reflectance :math:`\rho` [1]_; s is 0 unless asked for. That DIRSIG shares reflectance in this way is
    taken from the name of SPECULAR_FRACTION. Emissivity has six decimals, samples outside 0 to 1 are clipped
    and counted, with a warning.

    IDs and file names are ASCII letters, digits and underscores; names are ASCII: umlauts become two letters,
    other accents are dropped, brackets and the like become underscores, doubles get a number.
    ``paints.json`` keeps the names as they were.

    References
    ----------
    .. [1] DIRSIG manual, "Surface Properties", https://dirsig.cis.rit.edu/docs/new/surface_props.html

    Examples
    --------
    >>> import tempfile, numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([[0.04, 0.05, 0.6]]), dims=("signature", "band"), attrs={"units": "1"})
    >>> nm = ("band", [450.0, 550.0, 650.0], {"units": "nm"})
    >>> paints = xr.Dataset({"reflectance": seen}, {"signature": ["Türkis, matt"], "wavelength": nm})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = write_dirsig(paints, folder)
    ...     print(made.emissivity_file.item(), *sorted(path.name for path in Path(folder).iterdir()))
    emissivity/Tuerkis_matt.ems README.txt emissivity materials.mat paints.glist paints.json reflectance
    """
    problems = Problems("no DIRSIG materials can be written", SchemaError)
    kind = curves or ("members" if CURVES["members"] in library.variables else "centre")
    # dims and units are judged without reading values: an empty library has them, too
    empty = library.isel({SIGNATURE: slice(0)}) if SIGNATURE in library.dims else library
    names = {"reflectance", "wavelength", CURVES.get(kind, "reflectance")} & {*map(str, library.variables)}
    require(empty, sorted(names | {"reflectance", "wavelength"}), "DIRSIG materials", LIBRARY_VARIABLES)
    if kind not in CURVES:
        problems.add(f"curves={curves!r}", expected=", ".join(CURVES), code="choice-unknown")
    elif CURVES[kind] not in library.variables:
        problems.add(
            f"curves={kind!r} needs {CURVES[kind]}, which the library lacks",
            mend="pass curves='centre'",
            code="variable-missing",
        )
    elif library[CURVES[kind]].dtype.kind not in "fiu" or library["reflectance"].dtype.kind not in "fiu":
        problems.add(
            f"{CURVES[kind]} is {library[CURVES[kind]].dtype}", expected="numbers", code="type-wrong"
        )
    if not library.sizes[SIGNATURE]:
        problems.add("the library has no paints", code="empty-input")
    if wavelength_range is not None and not _is_range(wavelength_range):
        problems.add(
            f"wavelength_range={wavelength_range!r}",
            expected="two wavelengths such as (400, 1000) [nm]",
            code="value-out-of-range",
        )
    if gaps not in (None, *GAPS):
        problems.add(f"gaps={gaps!r}", expected=" or ".join(GAPS), code="choice-unknown")
    if surface not in SURFACES:
        problems.add(f"surface={surface!r}", expected=" or ".join(SURFACES), code="choice-unknown")
    elif surface == "SimpleReflectance" and specular != 0.0:
        problems.add(
            "SimpleReflectance has no specular term",
            mend="leave specular out, or use ClassicEmissivity",
            code="option-conflict",
        )
    if not (rad_solver.isascii() and rad_solver.isalnum()):
        problems.add(
            f"rad_solver={rad_solver!r}", expected="a name such as 'Classic'", code="value-out-of-range"
        )
    if thermal is not None and (set(thermal) != set(THERMAL) or not all(map(_is_number, thermal.values()))):
        problems.add(
            f"thermal={dict(thermal)!r}",
            expected=f"numbers for all of {', '.join(THERMAL)}",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    if max_curves is not None and not (isinstance(max_curves, int) and max_curves >= 1):
        raise SchemaError(
            f"max_curves={max_curves!r}",
            expected="a whole number above 0, or None",
            code="value-out-of-range",
        )
    coat = coat_of(library, specular)
    axis = Axis(library)
    choices = Choices(kind, wavelength_range, extrapolate, gaps or GAPS[0], max_curves)
    records = paint_records(library, () if scene_materials is None else read_materials(scene_materials))
    with export_folder(folder, overwrite=overwrite) as build:
        write_spectra(library, build, axis, choices, coat, records, progress)
        entries = (
            material_section(
                record, surface=surface, rad_solver=rad_solver, thermal=thermal, double_sided=double_sided
            )
            for record in records
        )
        attrs = {**coat.attrs, "surface": surface, "curves_of": kind}
        for name in ("title", "source", "provenance", "references", "license"):
            if name in library.attrs:
                attrs[f"library_{name}"] = str(library.attrs[name])
        # identifies the folder as an export
        marker = {"format": FORMAT, "version": 1, **attrs, "paints": records}
        written = {
            "materials.mat": materials_text(entries),
            "paints.glist": glist_text(records),
            "README.txt": readme_text(records, attrs),
            MARKER: json.dumps(marker, indent=1, ensure_ascii=False) + "\n",
        }
        for name, text in written.items():
            # a name may hold halves of surrogate pairs, which no encoding has
            (build / name).write_bytes(text.encode("utf-8", "backslashreplace"))
    _warn(records, gaps_chosen=gaps is not None)
    return _summary(records, {**attrs, "folder": os.fspath(folder)})


def _is_range(value: Any) -> bool:
    try:
        low, high = value
    except (TypeError, ValueError):
        return False
    return _is_number(low) and _is_number(high) and MIN_NM <= low < high <= MAX_NM


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def paint_records(library: xr.Dataset, taken: Collection[Material]) -> list[dict[str, Any]]:
    """Return the first part of every paint's record: names, files, and columns of the library.

    IDs and names of materials that are ``taken`` are not used again.
    """
    names = [str(name) for name in library[SIGNATURE].values] if SIGNATURE in library.variables else []
    names = names or [f"paint {number}" for number in range(1, library.sizes[SIGNATURE] + 1)]
    tokens = material_ids(names, [material.id for material in taken])
    plain = material_names(names, [material.name for material in taken])
    about = [
        name for name, column in library.coords.items() if column.dims == (SIGNATURE,) and name != SIGNATURE
    ]
    texts = {str(name): [str(value) for value in library[name].values] for name in sorted(about, key=str)}
    return [
        {
            "paint": names[number],
            "id": tokens[number],
            "name": plain[number],
            "emissivity_file": f"{EMISSIVITY}/{tokens[number]}.ems",
            "reflectance_file": f"{REFLECTANCE}/{tokens[number]}.txt",
            "about": {name: values[number] for name, values in texts.items() if values[number]},
        }
        for number in range(len(names))
    ]


def write_spectra(
    library: xr.Dataset,
    build: Path,
    axis: Axis,
    choices: Choices,
    coat: Coat,
    records: list[dict[str, Any]],
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write the files of all paints and complete their records; after a fault, only check the rest."""
    problems: list[Problem] = []
    formats: dict[bytes, tuple[ColumnText, ColumnText]] = {}
    for paints, values in blocks_of(library, choices):
        for number, record in enumerate(records[paints]):
            centre, curves = values["centre"][number], values["curves"][number]
            try:
                spectra = curves_of(axis, centre, curves, choices)
            except PaintProblemError as error:
                problems.append(error.about(repr(record["paint"])).problem)
                continue
            mirror = values["specular_reflectance"][number] if "specular_reflectance" in values else None
            fraction = coat.fraction(
                np.where(axis.good, centre[axis.order], np.nan),
                None if mirror is None else mirror[axis.order],
            )
            if not problems:
                key = spectra.wavelength.tobytes()
                if key not in formats:
                    formats.clear()  # successive paints share wavelengths; older formats are dropped
                    formats[key] = ColumnText(spectra.wavelength, CURVE_BEGIN), ColumnText(spectra.wavelength)
                record |= _write_paint(spectra, fraction, build, record, *formats[key])
        if progress is not None:
            progress(paints.stop, len(records))
    if problems:
        rest = (
            [Problem(f"and {len(problems) - _MAX_SHOWN} more paints", code="paint-unwritable")]
            if problems[_MAX_SHOWN:]
            else []
        )
        raise SchemaError(
            "paints cannot be written for DIRSIG",
            problems=problems[:_MAX_SHOWN] + rest,
            code="paint-unwritable",
        )


def _write_paint(
    spectra: PaintCurves,
    fraction: float,
    build: Path,
    record: Mapping[str, Any],
    curve_text: ColumnText,
    plain_text: ColumnText,
) -> dict[str, Any]:
    clipped = 0
    with open(build / record["emissivity_file"], "wb") as file:
        file.write(emissivity_head(len(spectra.curves)))
        for start in range(0, len(spectra.curves), _CURVES_AT_ONCE):
            total = spectra.curves[start : start + _CURVES_AT_ONCE] / (1.0 - fraction)
            clipped += int(((total < 0.0) | (total > 1.0)).sum())
            file.write(curve_text.text(1.0 - np.clip(total, 0.0, 1.0)))
    outside = int(((spectra.centre < 0.0) | (spectra.centre > 1.0)).sum())
    centre = np.clip(spectra.centre, 0.0, 1.0)
    (build / record["reflectance_file"]).write_bytes(plain_text.text(centre[np.newaxis]))
    return {
        "wavelength": [float(spectra.wavelength[0]), float(spectra.wavelength[-1])],
        "measured": list(spectra.measured),
        "bands": len(spectra.wavelength),
        "curves": len(spectra.curves),
        "complete": spectra.complete,
        "gaps": [round(float(nm), 2) for nm in spectra.gaps],
        "is_centre": spectra.is_centre,
        "clipped": clipped,
        "centre_clipped": outside,
        "interpolated": spectra.interpolated,
        "centre_interpolated": spectra.centre_interpolated,
        "left_out": spectra.left_out,
        "thinned": spectra.thinned,
        "extrapolated": spectra.extrapolated,
        "specular_fraction": fraction,
        "editor_color": _colour(spectra.wavelength, centre),
    }


def _colour(wavelength: Array, reflectance: Array) -> list[float]:
    # Red, green and blue for DIRSIG's editor, brightened; white where unknown.
    if wavelength[0] > _RGB[2] or wavelength[-1] < _RGB[0]:
        return [1.0, 1.0, 1.0]
    return [round(float(value), 3) for value in np.sqrt(np.interp(_RGB, wavelength, reflectance))]


def _warn(records: list[dict[str, Any]], *, gaps_chosen: bool) -> None:
    messages = []
    for key, change in (
        ("clipped", "samples outside 0 to 1 were clipped"),
        ("centre_clipped", "samples of centres outside 0 to 1 were clipped"),
        ("left_out", "members that lack an end of the range were left out"),
        ("is_centre", "paints have no member that reaches both ends: their centre is written"),
        ("interpolated", "samples in gaps of curves were filled in by straight lines"),
        ("centre_interpolated", "samples in gaps of centres were filled in by straight lines"),
    ):
        number, paints = sum(record[key] for record in records), sum(bool(record[key]) for record in records)
        if number and not (gaps_chosen and "interpolated" in key):
            messages.append(f"{number} {change} (in {paints} of {len(records)} paints)")
    if messages:
        warnings.warn(
            PaintWarning(f"DIRSIG materials: {'; '.join(messages)}; see README.txt", code="spectra-changed"),
            stacklevel=3,
        )


def _summary(records: list[dict[str, Any]], attrs: Mapping[str, str]) -> xr.Dataset:
    def column(key: str, dtype: Any) -> tuple[str, Array]:
        return SIGNATURE, np.array([record[key] for record in records], dtype)

    counts = (
        "curves",
        "complete",
        "clipped",
        "centre_clipped",
        "interpolated",
        "centre_interpolated",
        "left_out",
        "thinned",
        "bands",
    )
    values: dict[str, Any] = {key: column(key, np.int64) for key in counts}
    values |= {key: column(key, object) for key in ("emissivity_file", "reflectance_file", "extrapolated")}
    values["specular_fraction"] = column("specular_fraction", np.float64)
    values["range"] = (
        (SIGNATURE, "end"),
        np.array([record["wavelength"] for record in records]),
        {"units": "nm"},
    )
    # pandas keeps texts as Arrow's where pyarrow is installed, and cannot hold halves of surrogate pairs
    names = [record["paint"].encode("utf-8", "backslashreplace").decode() for record in records]
    coords = {SIGNATURE: (SIGNATURE, np.array(names, object)), "material_id": column("id", object)}
    return xr.Dataset(values, {**coords, "end": ["low", "high"]}, {"title": "DIRSIG materials", **attrs})
