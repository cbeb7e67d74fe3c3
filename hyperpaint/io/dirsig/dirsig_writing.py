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
from hyperpaint.base.facts import documented, is_number, one_of
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
_EXPORT_NAME = re.compile(
    r"emissivity|reflectance|geometry|maps|materials|README\.txt|materials\.mat|paints\.(glist|json)|.*\.(scene|jsim)"
)

_MAX_BYTES = 256 * 2**20
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")


@contextlib.contextmanager
def export_folder(
    folder: str | os.PathLike[str], *, overwrite: bool, inside: Sequence[str] = (EMISSIVITY, REFLECTANCE)
) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to ``folder`` when the block ends without an error.

    ``folder``: path of a new or empty folder, or of an earlier export; ``overwrite``: whether an export may
    be replaced; ``inside``: folders that are created in it.

    Raises `StoreError`: ``folder`` contains other files, or an export that may not be replaced; another
    process writes there; or it cannot be written.
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
    # Description of files that no export contains, empty for an export
    try:
        document = json.loads(read_limited(folder / MARKER, _MAX_BYTES, "an export"))
    except (FormatError, ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        return "other files"
    foreign = sorted(path.name for path in folder.iterdir() if not _EXPORT_NAME.fullmatch(path.name))
    return f"{foreign[0]}, which no export has" if foreign else ""


SURFACES = ("ClassicEmissivity", "SimpleReflectance")
_MAX_SHOWN = 20
#: Number of curves that are formatted as text together.
_CURVES_AT_ONCE = 64

_RGB = (640.0, 550.0, 460.0)  # [nm]


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

    Every paint becomes an ``.ems`` file with many curves, from which a texture can select, a two-column
    ``.txt`` of its centre and a MATERIAL_ENTRY. The folder also contains a fragment of a geometry list and a
    README with the steps to add the paints to a scene. It appears when all files are complete. Paints are
    read and written in blocks.

    Parameters
    ----------
    library
        A paint library: ``reflectance`` (signature, band) [1], ``wavelength`` (band) [nm], in any order.
    folder
    curves
        ``members`` for the single pixels, ``quantiles``, or ``centre`` for one curve per paint. By default
        members if the library has them, else the centre.
    wavelength_range
        Low and high end [nm]; the next band beyond each end is written too, so that the range is covered. By
        default the measured range.
    extrapolate
        Continue curves as constants where ``wavelength_range`` exceeds the measured range; the README says
        where.
    gaps
        Treatment of bands without values, or not ``good``, within the range: ``interpolate`` linearly, or
        ``refuse`` with an error. By default they are interpolated, with a warning; the README lists the
        curves and the wavelengths; complete curves come first in a file. Bands at an end that have no value
        in any pixel are not written; nor are members without a value at an end, and if no member has values
        at both ends, the centre is the only curve.
    max_curves
        Maximum number of curves of a paint, chosen at equal steps of their rank in brightness, complete
        curves first; None for all.
    specular
        Fraction of reflectance that is specular in DIRSIG [1], or ``library`` to compute it from the
        library's ``specular_reflectance`` (signature, band). Only for reflectance without mirrored light.
    surface
        Surface model: ``ClassicEmissivity`` (reads the ``.ems``) or ``SimpleReflectance`` (reads the
        ``.txt``).
    rad_solver
        Name of DIRSIG's radiometry solver.
    thermal
        Parameters of the temperature solver Therm, all of ``specific_heat``, ``mass_density``,
        ``thermal_conductivity``, ``solar_absorption``, ``thermal_emissivity``, ``exposed_area`` and
        ``thickness``, in DIRSIG's units. By default no temperature is computed.
    double_sided
        Whether the back of a facet has the paint, too.
    scene_materials
        Material list of the scene; its IDs and names are not given to paints.
    overwrite
    progress

    Returns
    -------
    Dataset
        Properties of the materials (signature): ``material_id``, ``emissivity_file``; numbers of ``curves``,
        of ``complete`` curves, of their samples that were ``clipped`` and ``interpolated``, of samples of the
        ``.txt`` that were ``centre_clipped`` and ``centre_interpolated``, of members ``left_out`` (without
        values at an end) and ``thinned`` (above ``max_curves``); the range, and the ends ``extrapolated``.
        Its attributes describe the treatment of mirrored light: ``mirror_reflection``, ``specular_term``.

    Raises
    ------
    SchemaError
        ``library`` is not a paint library, or has no such ``curves``; an option is not among those above; a
        specular term would count the clear coat twice; paints have no values, gaps with ``gaps="refuse"``, or
        do not cover the range; all are listed.
    UnitsError
        Units cannot be read.
    FormatError
        ``scene_materials`` is not a material list.
    StoreError
        The folder contains other files, is being written by another process, or cannot be written.

    Notes
    -----
    Of an opaque paint

    .. math:: \epsilon = 1 - \rho / (1 - s)

    with the specular fraction s (``specular``, by default 0), so that the diffuse part :math:`(1 - s)(1 -
    \epsilon)` is the body reflectance :math:`\rho` [1]_. That DIRSIG divides reflectance in this way is an
    assumption from the name of SPECULAR_FRACTION. Emissivity has six decimals; samples outside 0 to 1 are
    clipped and counted, with a warning.

    IDs and file names have ASCII letters, digits and underscores; names are ASCII: umlauts become two
    letters, other accents are dropped, brackets and similar signs become underscores, equal names get a
    number. ``paints.json`` has the names of the library.

    References
    ----------
    .. [1] DIRSIG manual, "Surface Properties", https://dirsig.cis.rit.edu/docs/new/surface_props.html

    Examples
    --------
    >>> import tempfile, numpy as np, xarray as xr
    >>> values = np.float32([[0.04, 0.05, 0.6]])
    >>> reflectance = xr.DataArray(values, dims=("signature", "band"), attrs={"units": "1"})
    >>> nm = ("band", [450.0, 550.0, 650.0], {"units": "nm"})
    >>> paints = xr.Dataset({"reflectance": reflectance}, {"signature": ["Türkis, matt"], "wavelength": nm})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     summary = write_dirsig(paints, folder)
    ...     print(summary.emissivity_file.item(), *sorted(path.name for path in Path(folder).iterdir()))
    emissivity/Tuerkis_matt.ems README.txt emissivity materials.mat paints.glist paints.json reflectance
    """
    problems = Problems("no DIRSIG materials can be written", SchemaError)
    curves = curves or ("members" if CURVES["members"] in library.variables else "centre")
    # dims and units are checked on the library without its paints, so that no values are read
    empty = library.isel({SIGNATURE: slice(0)}) if SIGNATURE in library.dims else library
    names = {"reflectance", "wavelength", CURVES.get(curves, "reflectance")} & {*map(str, library.variables)}
    require(empty, sorted(names | {"reflectance", "wavelength"}), "DIRSIG materials", LIBRARY_VARIABLES)
    if one_of(curves, CURVES, "curves", problems=problems):
        name = CURVES[curves]
        if name not in library.variables:
            problems.add(
                f"curves={curves!r} needs {name}, which the library lacks",
                mend="pass curves='centre'",
                code="variable-missing",
            )
        elif library[name].dtype.kind not in "fiu" or library["reflectance"].dtype.kind not in "fiu":
            problems.add(f"{name} is {library[name].dtype}", expected="numbers", code="type-wrong")
    if not library.sizes[SIGNATURE]:
        problems.add("the library has no paints", code="empty-input")
    if wavelength_range is not None and not _is_range(wavelength_range):
        problems.add(
            f"wavelength_range={wavelength_range!r}",
            expected="two wavelengths such as (400, 1000) [nm]",
            code="value-out-of-range",
        )
    one_of(GAPS[0] if gaps is None else gaps, GAPS, "gaps", problems=problems)
    one_of(surface, SURFACES, "surface", problems=problems)
    if surface == "SimpleReflectance" and specular != 0.0:
        problems.add(
            "SimpleReflectance has no specular term",
            mend="leave specular out, or use ClassicEmissivity",
            code="option-conflict",
        )
    if not (rad_solver.isascii() and rad_solver.isalnum()):
        problems.add(
            f"rad_solver={rad_solver!r}", expected="a name such as 'Classic'", code="value-out-of-range"
        )
    if thermal is not None and (set(thermal) != set(THERMAL) or not all(map(is_number, thermal.values()))):
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
    choices = Choices(curves, wavelength_range, extrapolate, gaps or GAPS[0], max_curves)
    records = paint_records(library, () if scene_materials is None else read_materials(scene_materials))
    with export_folder(folder, overwrite=overwrite) as build:
        write_spectra(library, build, axis, choices, coat, records, progress)
        entries = (
            material_section(
                record, surface=surface, rad_solver=rad_solver, thermal=thermal, double_sided=double_sided
            )
            for record in records
        )
        attrs = {**coat.attrs, "surface": surface, "curves_of": curves}
        for name in ("title", "source", "provenance", "references", "license"):
            if name in library.attrs:
                attrs[f"library_{name}"] = str(library.attrs[name])
        # by this file `_foreign` recognises an export
        marker = {"format": FORMAT, "version": 1, **attrs, "paints": records}
        texts = {
            "materials.mat": materials_text(entries),
            "paints.glist": glist_text(records),
            "README.txt": readme_text(records, attrs),
            MARKER: json.dumps(marker, indent=1, ensure_ascii=False) + "\n",
        }
        for name, text in texts.items():
            # a name may contain half a surrogate pair, which UTF-8 cannot encode
            (build / name).write_bytes(text.encode("utf-8", "backslashreplace"))
    _warn(records, gaps_chosen=gaps is not None)
    return _summary(records, {**attrs, "folder": os.fspath(folder)})


def _is_range(value: Any) -> bool:
    try:
        low, high = value
    except (TypeError, ValueError):
        return False
    return is_number(low) and is_number(high) and MIN_NM <= low < high <= MAX_NM


def paint_records(library: xr.Dataset, used: Collection[Material]) -> list[dict[str, Any]]:
    """Return the first items of every paint's record: names, files, and columns of the library.

    ``used``: materials whose IDs and names are not given to paints.
    """
    names = [str(name) for name in library[SIGNATURE].values] if SIGNATURE in library.variables else []
    names = names or [f"paint {number}" for number in range(1, library.sizes[SIGNATURE] + 1)]
    tokens = material_ids(names, [material.id for material in used])
    plain = material_names(names, [material.name for material in used])
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
    """Write the files of all paints and complete their records; after a fault, only check further paints."""
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
        number_more = (
            [Problem(f"and {len(problems) - _MAX_SHOWN} more paints", code="paint-unwritable")]
            if problems[_MAX_SHOWN:]
            else []
        )
        raise SchemaError(
            "paints cannot be written for DIRSIG",
            problems=problems[:_MAX_SHOWN] + number_more,
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
    # Red, green and blue for DIRSIG's editor, with gamma; white if the visible range is not covered
    if wavelength[0] > _RGB[2] or wavelength[-1] < _RGB[0]:
        return [1.0, 1.0, 1.0]
    return [round(float(value), 3) for value in np.sqrt(np.interp(_RGB, wavelength, reflectance))]


def _warn(records: list[dict[str, Any]], *, gaps_chosen: bool) -> None:
    messages = []
    for key, change in (
        ("clipped", "samples outside 0 to 1 were clipped"),
        ("centre_clipped", "samples of centres outside 0 to 1 were clipped"),
        ("left_out", "members without a value at an end of the range were left out"),
        ("is_centre", "paints have no member with values at both ends: their centre is written"),
        ("interpolated", "samples in gaps of curves were interpolated"),
        ("centre_interpolated", "samples in gaps of centres were interpolated"),
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
    # with pyarrow, pandas cannot store half a surrogate pair
    names = [record["paint"].encode("utf-8", "backslashreplace").decode() for record in records]
    coords = {SIGNATURE: (SIGNATURE, np.array(names, object)), "material_id": column("id", object)}
    return xr.Dataset(values, {**coords, "end": ["low", "high"]}, {"title": "DIRSIG materials", **attrs})
