"""A paint library as a folder of materials of the simulator DIRSIG."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import jinja2
import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, Problem, Problems, SchemaError, StoreError, warn_user
from hyperpaint.base.facts import documented, is_number, one_of
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE, require
from hyperpaint.base.units import takes_quantities
from hyperpaint.io.files.publishing import published_folder

from .dirsig_files import (
    CURVE_BEGIN,
    ColumnText,
    Material,
    Section,
    emissivity_head,
    material_ids,
    material_names,
    materials_text,
    read_materials,
)
from .paint_curves import CURVES, GAPS, MAX_NM, MIN_NM, PaintCurves

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

#: Texts of exports, templates of this folder; ``escaped`` and ``quoted`` are for XML.
TEXTS = jinja2.Environment(
    loader=jinja2.PackageLoader("hyperpaint", "io/dirsig"),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    keep_trailing_newline=True,
)
TEXTS.filters |= {"escaped": escape, "quoted": quoteattr}


@contextlib.contextmanager
def export_folder(
    folder: str | os.PathLike[str], *, overwrite: bool, inside: Sequence[str] = (EMISSIVITY, REFLECTANCE)
) -> Iterator[Path]:
    # Yield a temporary folder, which is renamed to ``folder`` when the block ends without an error.
    # ``folder``: path of a new or empty folder, or of an earlier export; ``overwrite``: whether an export may
    # be replaced; ``inside``: folders that are created in it.
    # Raises `StoreError`: ``folder`` contains other files, or an export that may not be replaced; another
    # process writes there; or it cannot be written.
    if _URL.match(os.fspath(folder)):
        raise StoreError(
            f"{os.fspath(folder)!r} is a URL",
            expected="a folder",
            mend="write to a folder and copy it",
            code="folder-is-url",
        )

    def foreign(existing: Path) -> str:
        # Description of files that no export contains, empty for an export
        try:
            document = json.loads(read_limited(existing / MARKER, _MAX_BYTES, "an export"))
        except (FormatError, ValueError, RecursionError):
            document = None
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            return "other files"
        names = sorted(path.name for path in existing.iterdir() if not _EXPORT_NAME.fullmatch(path.name))
        return f"{names[0]}, which no export has" if names else ""

    with published_folder(Path(os.path.abspath(folder)), overwrite=overwrite, foreign=foreign) as build:
        for name in inside:
            (build / name).mkdir(parents=True)
        yield build


SURFACES = ("ClassicEmissivity", "SimpleReflectance")
_MAX_SHOWN = 20
#: Number of curves that are formatted as text together.
_CURVES_AT_ONCE = 64

_RGB = (640.0, 550.0, 460.0)  # [nm]

#: Parameters of DIRSIG's temperature solver Therm; its keys are in capitals.
THERMAL = (
    "specific_heat",
    "mass_density",
    "thermal_conductivity",
    "solar_absorption",
    "thermal_emissivity",
    "exposed_area",
    "thickness",
)
#: Settings of the radiometry solvers, as in files of DIRSIG's distribution.
_SOLVERS = {
    "Classic": (("ENABLE_SAMPLED_DIFFUSE", "FALSE"),),
    "Generic": (
        ("INITIAL_SAMPLE_COUNT", "100"),
        ("SAMPLE_DECAY_RATE", "2"),
        ("MAX_BOUNCES", "3"),
        ("MU_SAMPLES", "10"),
        ("PHI_SAMPLES", "20"),
        ("MIN_QUAD_SAMPLES", "1"),
    ),
}
#: Properties of the surface models: section, then keys with the items of a paint's record.
_PROPERTIES = {
    "ClassicEmissivity": (
        "EMISSIVITY_PROP",
        (("FILENAME", "emissivity_file"), ("SPECULAR_FRACTION", "specular_fraction")),
    ),
    "SimpleReflectance": ("REFLECTANCE_PROP", (("TXT_FILENAME", "reflectance_file"),)),
    "ShellTarget": (
        "REFLECTANCE_PROP",
        (("EMISSIVITY_FILE", "emissivity_file"), ("BRDF_FIT_FILE", "fit_file")),
    ),
}
#: Changes of spectra that are warned of: item of a paint's record, and its description.
_CHANGES = (
    ("clipped", "samples outside 0 to 1 were clipped"),
    ("centre_clipped", "samples of centres outside 0 to 1 were clipped"),
    ("left_out", "members without a value at an end of the range were left out"),
    ("is_centre", "paints have no member with values at both ends: their centre is written"),
    ("interpolated", "samples in gaps of curves were interpolated"),
    ("centre_interpolated", "samples in gaps of centres were interpolated"),
)


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
    names = {CURVES.get(curves, "reflectance")} & {*map(str, library.variables)}
    require(empty, sorted(names | {"reflectance", "wavelength"}), "DIRSIG materials", LIBRARY_VARIABLES)
    one_of(curves, CURVES, "curves", problems=problems)
    one_of(GAPS[0] if gaps is None else gaps, GAPS, "gaps", problems=problems)
    one_of(surface, SURFACES, "surface", problems=problems)
    name = CURVES.get(curves, "reflectance")
    kinds = {library[key].dtype.kind for key in ("reflectance", name) if key in library.variables}
    limits = [] if wavelength_range is None else np.ravel(np.asarray(wavelength_range, object)).tolist()
    is_range = len(limits) == 2 and all(map(is_number, limits)) and MIN_NM <= limits[0] < limits[1] <= MAX_NM
    parameters = {} if thermal is None else dict(thermal)
    problems.extend(
        Problem(found, expected=expected, mend=mend, code=code)
        for is_wrong, found, expected, mend, code in (
            (
                name not in library.variables,
                f"curves={curves!r} needs {name}, which the library lacks",
                "",
                "pass curves='centre'",
                "variable-missing",
            ),
            (
                not kinds <= set("fiu"),
                f"{name} is {library[name].dtype if name in library.variables else ''}",
                "numbers",
                "",
                "type-wrong",
            ),
            (not library.sizes[SIGNATURE], "the library has no paints", "", "", "empty-input"),
            (
                wavelength_range is not None and not is_range,
                f"wavelength_range={wavelength_range!r}",
                "two wavelengths such as (400, 1000) [nm]",
                "",
                "value-out-of-range",
            ),
            (
                surface == "SimpleReflectance" and specular != 0.0,
                "SimpleReflectance has no specular term",
                "",
                "leave specular out, or use ClassicEmissivity",
                "option-conflict",
            ),
            (
                not (rad_solver.isascii() and rad_solver.isalnum()),
                f"rad_solver={rad_solver!r}",
                "a name such as 'Classic'",
                "",
                "value-out-of-range",
            ),
            (
                thermal is not None
                and (set(thermal) != set(THERMAL) or not all(map(is_number, parameters.values()))),
                f"thermal={parameters!r}",
                f"numbers for all of {', '.join(THERMAL)}",
                "",
                "value-out-of-range",
            ),
            (
                max_curves is not None and not (isinstance(max_curves, int) and max_curves >= 1),
                f"max_curves={max_curves!r}",
                "a whole number above 0, or None",
                "",
                "value-out-of-range",
            ),
        )
        if is_wrong
    )
    problems.raise_if_any()
    paint_curves = PaintCurves(
        library,
        specular,
        curves=curves,
        wavelength_range=wavelength_range,
        extrapolate=extrapolate,
        gaps=gaps,
        max_curves=max_curves,
    )
    records = paint_records(library, () if scene_materials is None else read_materials(scene_materials))
    with export_folder(folder, overwrite=overwrite) as build:
        write_spectra(paint_curves, build, records, progress)
        attrs = {**paint_curves.attrs, "surface": surface, "curves_of": curves}
        for name in ("title", "source", "provenance", "references", "license"):
            if name in library.attrs:
                attrs[f"library_{name}"] = str(library.attrs[name])
        content = {"paints": records, "about": attrs, "width": max(2, *(len(r["id"]) for r in records))}
        write_texts(
            build,
            {
                "materials.mat": materials_text(
                    material_section(
                        record,
                        surface=surface,
                        rad_solver=rad_solver,
                        thermal=thermal,
                        double_sided=double_sided,
                    )
                    for record in records
                ),
                "paints.glist": TEXTS.get_template("paints.glist.j2").render(content),
                "README.txt": TEXTS.get_template("paints_readme.txt.j2").render(content),
                # by this file an export is recognised
                MARKER: json.dumps(
                    {"format": FORMAT, "version": 1, **attrs, "paints": records}, indent=1, ensure_ascii=False
                )
                + "\n",
            },
        )
    messages = []
    for key, change in _CHANGES:
        counts = [int(record[key]) for record in records]
        if any(counts) and not (gaps is not None and "interpolated" in key):
            paints = f"in {sum(map(bool, counts))} of {len(records)} paints"
            messages.append(f"{sum(counts)} {change} ({paints})")
    if messages:
        warn_user(f"DIRSIG materials: {'; '.join(messages)}; see README.txt", "spectra-changed")
    numbers = ("curves", "complete", "clipped", "centre_clipped", "interpolated", "centre_interpolated")
    summary = summary_of(
        records,
        "DIRSIG materials",
        {**attrs, "folder": os.fspath(folder)},
        **dict.fromkeys((*numbers, "left_out", "thinned", "bands"), np.int64),
        **dict.fromkeys(("emissivity_file", "reflectance_file", "extrapolated"), object),
    )
    ranges = np.array([record["wavelength"] for record in records])
    return summary.assign(range=((SIGNATURE, "end"), ranges, {"units": "nm"})).assign_coords(
        end=["low", "high"]
    )


def write_texts(build: Path, texts: Mapping[str, str]) -> None:
    # Write texts by their names; half a surrogate pair in a name, which UTF-8 lacks, is escaped.
    for name, text in texts.items():
        (build / name).write_bytes(text.encode("utf-8", "backslashreplace"))


def material_section(
    record: Mapping[str, Any],
    *,
    surface: str,
    rad_solver: str,
    thermal: Mapping[str, float] | None,
    double_sided: bool,
) -> Section:
    # Return the entry of one paint in a material list.
    # ``record``: record of the paint in ``paints.json``; ``surface``: ``ClassicEmissivity``,
    # ``SimpleReflectance``, or ``ShellTarget`` with a ``fit_file``; ``rad_solver``: name of the radiometry
    # solver; ``thermal``: values of `THERMAL`, None if temperature is not computed; ``double_sided``: whether
    # the back of a facet has the paint, too.
    name, keys = _PROPERTIES[surface]
    items = ((key, record[item]) for key, item in keys)
    properties = tuple((key, value if isinstance(value, str) else f"{value:g}") for key, value in items)
    values = tuple((key.upper(), f"{float(value):.6g}") for key, value in (thermal or {}).items())
    return Section(
        "MATERIAL_ENTRY",
        (
            ("ID", record["id"]),
            ("NAME", record["name"]),
            ("EDITOR_COLOR", ", ".join(f"{value:.3g}" for value in record["editor_color"])),
            ("DOUBLE_SIDED", "TRUE" if double_sided else "FALSE"),
            ("RAD_SOLVER_NAME", rad_solver),
            Section("RAD_SOLVER", _SOLVERS.get(rad_solver, ())),
            ("TEMP_SOLVER_NAME", "Therm" if thermal else "Null"),
            Section("TEMP_SOLVER", values),
            Section("SURFACE_PROPERTIES", ((f"{name}_NAME", surface), Section(name, properties))),
        ),
    )


def paint_records(library: xr.Dataset, used: Collection[Material]) -> list[dict[str, Any]]:
    # Return the first items of every paint's record: names, files, and columns of the library.
    # ``used``: materials whose IDs and names are not given to paints.
    numbered = [f"paint {number}" for number in range(1, library.sizes[SIGNATURE] + 1)]
    names = list(map(str, library[SIGNATURE].values)) if SIGNATURE in library.variables else numbered
    tokens = material_ids(names, [material.id for material in used])
    plain = material_names(names, [material.name for material in used])
    about = {
        str(name): list(map(str, library[name].values))
        for name in sorted(library.coords, key=str)
        if library[name].dims == (SIGNATURE,) and name != SIGNATURE
    }
    return [
        {
            "paint": names[number],
            "id": tokens[number],
            "name": plain[number],
            "emissivity_file": f"{EMISSIVITY}/{tokens[number]}.ems",
            "reflectance_file": f"{REFLECTANCE}/{tokens[number]}.txt",
            "about": {name: values[number] for name, values in about.items() if values[number]},
        }
        for number in range(len(names))
    ]


def write_spectra(
    paint_curves: PaintCurves,
    build: Path,
    records: list[dict[str, Any]],
    progress: Callable[[int, int], None] | None,
) -> None:
    # Write the files of all paints and complete their records; after a fault, only check further paints.
    problems: list[Problem] = []
    formats: dict[bytes, tuple[ColumnText, ColumnText]] = {}
    for paints, values in paint_curves.blocks():
        for number, record in enumerate(records[paints]):
            mirror = values["specular_reflectance"][number] if "specular_reflectance" in values else None
            try:
                wavelength, centre, curves, items = paint_curves.of_paint(
                    values["centre"][number], values["curves"][number], mirror
                )
            except SchemaError as error:
                problems.append(error.about(repr(record["paint"])).problem)
                continue
            if problems:
                continue
            key = wavelength.tobytes()
            if key not in formats:
                formats.clear()  # successive paints share wavelengths; older formats are dropped
                formats[key] = ColumnText(wavelength, CURVE_BEGIN), ColumnText(wavelength)
            curve_text, plain_text = formats[key]
            with open(build / record["emissivity_file"], "wb") as file:
                file.write(emissivity_head(len(curves)))
                for start in range(0, len(curves), _CURVES_AT_ONCE):
                    total = curves[start : start + _CURVES_AT_ONCE] / (1.0 - items["specular_fraction"])
                    items["clipped"] += int(((total < 0.0) | (total > 1.0)).sum())
                    file.write(curve_text.text(1.0 - np.clip(total, 0.0, 1.0)))
            items["centre_clipped"] = int(((centre < 0.0) | (centre > 1.0)).sum())
            centre = np.clip(centre, 0.0, 1.0)
            (build / record["reflectance_file"]).write_bytes(plain_text.text(centre[np.newaxis]))
            # red, green and blue for DIRSIG's editor, with gamma; white if the visible range is not covered
            is_visible = wavelength[0] <= _RGB[2] and wavelength[-1] >= _RGB[0]
            colour = np.sqrt(np.interp(_RGB, wavelength, centre)) if is_visible else np.ones(3)
            record |= items | {
                "editor_color": [round(float(value), 3) for value in colour],
            }
        if progress is not None:
            progress(paints.stop, len(records))
    if problems:
        further = f"and {len(problems) - _MAX_SHOWN} more paints"
        more = [Problem(further, code="paint-unwritable")] if problems[_MAX_SHOWN:] else []
        raise SchemaError(
            "paints cannot be written for DIRSIG",
            problems=problems[:_MAX_SHOWN] + more,
            code="paint-unwritable",
        )


def summary_of(
    records: Sequence[Mapping[str, Any]], title: str, attrs: Mapping[str, Any], **dtypes: Any
) -> xr.Dataset:
    # Return items of the records (signature), by their dtypes, with names, IDs and specular fractions.
    columns = {
        key: (SIGNATURE, np.array([record[key] for record in records], dtype))
        for key, dtype in {**dtypes, "specular_fraction": np.float64, "id": object}.items()
    }
    # with pyarrow, pandas cannot store half a surrogate pair
    names = [record["paint"].encode("utf-8", "backslashreplace").decode() for record in records]
    coords = {SIGNATURE: (SIGNATURE, np.array(names, object)), "material_id": columns.pop("id")}
    return xr.Dataset(columns, coords, {"title": title, **attrs})
