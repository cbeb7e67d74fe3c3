"""Paint libraries as materials of the simulator DIRSIG, and scenes of triangles with them, as folders.

Reflectance is written ascending, without gaps, and with the clear coat counted once.
"""

import contextlib
import json
import os
import re
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import jinja2
import numpy as np
import xarray as xr

from hyperpaint.base import (
    BAND,
    EXCLUDED,
    INCLUDED,
    LIBRARY_VARIABLES,
    SIGNATURE,
    Array,
    Floats,
    Ints,
    Problem,
    Problems,
    SchemaError,
    Variable,
    as_path,
    documented,
    is_number,
    mirror_reflection,
    one_of,
    require,
    takes_quantities,
    warn_if,
)
from hyperpaint.io.files.publishing import foreign_content, published_folder

from .dirsig_files import (
    CURVE_BEGIN,
    WAVELENGTH_DECIMALS,
    ColumnText,
    Material,
    Section,
    emissivity_head,
    material_ids,
    material_names,
    materials_text,
    plain_name,
    read_emissivity,
    read_materials,
)

_SPECULAR = "specular_reflectance"
_ROWS = {
    **LIBRARY_VARIABLES,
    _SPECULAR: Variable(_SPECULAR, (SIGNATURE, BAND), "1", "float32", "Mirror reflectance"),
}

#: Variables of a library with the curves of a paint, by the choice of the caller.
CURVES = {"members": "member_reflectance", "quantiles": "reflectance_quantiles", "centre": "reflectance"}

GAPS = ("interpolate", "refuse")

#: Wavelengths that can be written [nm].
MIN_NM, MAX_NM = 1.0, 1e5

#: Maximum size of the curves in memory [byte].
_BLOCK_BYTES = 8 * 2**20


#: Reflectance of a clear coat at normal incidence above which it is none [1].
_MOST_COAT = 0.5


class Coats(NamedTuple):
    # Clear coats of the paints of a library, 0 for matte paints.
    reflectance: Floats  # Fresnel reflectance at normal incidence (signature,) [1]
    roughness: Floats  # GGX alpha (signature,) [1]


class PaintCurves:
    # Curves of the paints of a library as they are written.
    # coats: of the paints. curves: key of `CURVES`. wavelength_range: low and high end [nm], None for the
    # measured range. extrapolate: whether curves are constant beyond the measured range, or up to which
    # distance [nm]. gaps: treatment of bands without values between others, one of `GAPS`. max_curves:
    # maximum number of curves of a paint, None for all.
    # Raises `SchemaError`: The attribute ``mirror_reflection`` is neither ``included`` nor ``excluded``. A
    # wavelength is not finite or out of range, or two are equal as written.

    def __init__(
        self,
        library: xr.Dataset,
        coats: Coats,
        *,
        curves: str = "centre",
        wavelength_range: tuple[float, float] | None = None,
        extrapolate: bool | float = False,
        gaps: str | None = None,
        max_curves: int | None = None,
    ) -> None:
        self.library, self.coats, self.curves = library, coats, curves
        self.wavelength_range, self.extrapolate = wavelength_range, extrapolate
        self.gaps, self.max_curves = gaps or GAPS[0], max_curves
        declared = mirror_reflection(library)
        self.mirror_reflection = declared or INCLUDED
        glossy = int((coats.reflectance > 0.0).sum())
        self.attrs = {
            "mirror_reflection": self.mirror_reflection,
            "mirror_reflection_source": "stated by the library"
            if declared
            else "not stated by the library, assumed",
            "specular_term": f"the BRDF Shell Target of {glossy} paints; emissivity = 1 - reflectance - coat"
            if glossy
            else "none: reflectance is diffuse",
        }
        # bands in ascending order
        names = [name for name in ("wavelength", "good") if name in library.variables]
        arrays = require(library, names, "DIRSIG materials", LIBRARY_VARIABLES)
        wavelength = np.asarray(arrays["wavelength"].values, np.float64)
        is_finite = np.isfinite(wavelength).all() and wavelength.size
        SchemaError.raise_if(
            not (is_finite and wavelength.min() >= MIN_NM and wavelength.max() <= MAX_NM),
            "a wavelength is not finite, or out of range",
            expected=f"{MIN_NM:g} to {MAX_NM:g} nm",
            mend="drop the band",
            code="wavelength-range",
        )
        self.order = np.argsort(wavelength, kind="stable")
        self.wavelength = wavelength[self.order]
        steps = np.diff(wavelength)
        warn_if(
            not ((steps > 0).all() or (steps < 0).all()),
            "wavelengths of detectors overlap: bands are sorted, so that samples of both alternate; keep one "
            "detector per wavelength, as open_svc(overlap='trim') does",
            "wavelength-unordered",
        )
        micrometres = np.round(self.wavelength / 1000.0, WAVELENGTH_DECIMALS)
        if equal := np.flatnonzero(np.diff(micrometres) <= 0.0).tolist():
            examples = ", ".join(f"{self.wavelength[band]:.4f}" for band in equal[:8])
            raise SchemaError(
                f"two bands at {examples} nm",
                expected="one",
                mend="keep the band of one detector",
                code="wavelength-duplicate",
            )
        is_good = arrays["good"].values.astype(bool) if "good" in arrays else np.ones(len(micrometres), bool)
        self.good = is_good[self.order]

    def blocks(self) -> Iterator[tuple[slice, dict[str, Array]]]:
        # Yield the values of the library in blocks of paints, so that memory stays bounded: the slice of the
        # paints; and ``centre`` (signature, band) and ``curves`` (signature, curve, band) [1], in the
        # library's order of bands.
        library, name = self.library, CURVES[self.curves]
        names = [*dict.fromkeys(["reflectance", name])]
        count = library.sizes[SIGNATURE]
        size = 4 * library[name].size // max(count, 1)
        step = max(1, _BLOCK_BYTES // max(size, 1))
        # blocks of complete chunks, so that every chunk is decoded once
        stored = library[name].variable.chunksizes or library[name].encoding.get("preferred_chunks", {})
        chunk = max(1, int(np.ravel(stored.get(SIGNATURE, 1))[0]))
        step = chunk * max(1, step // chunk) if chunk * size <= 8 * _BLOCK_BYTES else step
        for start in range(0, count, step):
            paints = slice(start, min(start + step, count))
            arrays = require(
                library[names].isel({SIGNATURE: paints}).load(), names, "DIRSIG materials", _ROWS
            )
            blocks = {key: array.values for key, array in arrays.items()}
            curves = blocks[name] if blocks[name].ndim == 3 else blocks[name][:, np.newaxis]
            yield paints, {**blocks, "centre": blocks["reflectance"], "curves": curves}

    def of_paint(self, centre: Array, curves: Array) -> tuple[Array, Array, Array, dict[str, Any]]:
        # Return the curves of one paint, as they are written, and their items of its record.
        # ``centre``, ``curves``: reflectance (band,), and of the population (curve, band), in the library's
        # order of bands; curves without a value are dropped. Returns ascending wavelengths (wavelength,)
        # [nm], the centre (wavelength,) [1], the population (curve, wavelength) [1] with complete curves
        # first, and items of the record: the range and the ``measured`` range [nm]; numbers of ``complete``
        # curves, of ``interpolated`` samples, of members ``left_out`` without a value at an end, of curves
        # ``thinned`` above ``max_curves``; ``gaps`` [nm]; ends ``extrapolated``; ``is_centre`` where no
        # member has values at both ends, so that the centre is the only curve.
        # Raises `SchemaError`: The paint has no values, has gaps that are refused, or does not cover the
        # wavelength range.
        centre = np.where(self.good, centre[self.order], np.nan).astype(np.float64)
        curves = np.where(self.good, curves[:, self.order].astype(np.float64), np.nan)
        curves = curves[np.isfinite(curves).any(axis=1)]
        usable = np.flatnonzero(np.isfinite(centre))
        SchemaError.raise_if(
            usable.size < 2,
            "fewer than two bands have a value",
            mend="leave the paint out",
            code="value-missing",
        )
        if not len(curves):  # a paint without members
            curves = centre[np.newaxis]
        measured = (float(self.wavelength[usable[0]]), float(self.wavelength[usable[-1]]))
        low, high = self.wavelength_range or measured
        below, above = bool(low < measured[0]), bool(high > measured[1])
        is_outside = low >= measured[1] or high <= measured[0]
        limit = np.inf if self.extrapolate is True else float(self.extrapolate)
        SchemaError.raise_if(
            is_outside or max(measured[0] - low, high - measured[1]) > limit,
            f"measured {measured[0]:g} to {measured[1]:g} nm",
            expected=f"{low:g} to {high:g} nm",
            mend="leave the paint out, or choose a range within"
            if is_outside
            else "narrow wavelength_range, or pass extrapolate=True for constant values beyond the ends",
            option="leave the paint out, or give another --range, or --extrapolate",
            code="wavelength-uncovered",
        )
        # usable bands within the range, and the next band beyond each end, so that the range is covered
        first = max(int(usable[0]), int(np.searchsorted(self.wavelength, low, "right")) - 1)
        last = min(int(usable[-1]), int(np.searchsorted(self.wavelength, high, "left")))
        bands = slice(first, last + 1)
        wavelength = self.wavelength[bands]
        SchemaError.raise_if(
            np.median(centre[usable]) > 1.0,
            f"median reflectance {np.median(centre[usable]):g}",
            expected="0 to 1",
            mend="divide percent by 100",
            code="value-out-of-range",
        )
        curves = curves[:, bands]
        has_ends = np.isfinite(curves[:, [0, -1]]).all(axis=1)
        missing, centre_missing = ~np.isfinite(curves), ~np.isfinite(centre[bands])
        for subject, is_gap in (
            (f"{int(missing.any(axis=1).sum())} of {len(curves)} curves have", missing.any(axis=0)),
            ("the centre has", centre_missing),
        ):
            if self.gaps == "refuse" and is_gap.any():
                gaps = wavelength[is_gap]
                examples = ", ".join(f"{nm:.1f}" for nm in gaps[:6]) + (", ..." if gaps.size > 6 else "")
                raise SchemaError(
                    f"{subject} no value at {examples} nm, inside the range",
                    mend="omit gaps= to interpolate, or pass a wavelength_range without them",
                    code="value-missing",
                )
        centre = np.interp(wavelength, self.wavelength[usable], centre[usable])
        if has_ends.any():
            curves, missing = curves[has_ends], missing[has_ends]
            order = np.argsort(missing.any(axis=1), kind="stable")
            curves, missing = curves[order], missing[order]
            for row, gaps in zip(curves, missing, strict=True):
                row[gaps] = np.interp(wavelength[gaps], wavelength[~gaps], row[~gaps])
            # rows of the population (curve, wavelength) that are written, at most `max_curves`
            is_filled = np.asarray(missing.any(axis=1))
            if self.max_curves is None or len(curves) <= self.max_curves:
                rows = np.arange(len(curves))
            else:
                complete = np.flatnonzero(~is_filled)
                rows = complete if complete.size >= self.max_curves else np.arange(len(curves))
                ranked = rows[np.argsort(curves[rows].mean(axis=1), kind="stable")]
                # the middle curve of every one of `max_curves` classes with the same number of curves
                middles = (np.arange(self.max_curves) + 0.5) * len(ranked) / self.max_curves
                chosen = ranked[np.floor(middles).astype(np.int64)]
                rows = chosen[np.argsort(is_filled[chosen], kind="stable")]
        else:
            curves, missing, rows = centre[np.newaxis], centre_missing[np.newaxis], np.zeros(1, np.int64)
        thinned, curves, missing = len(curves) - len(rows), curves[rows], missing[rows]
        gap_nm = [round(float(nm), 2) for nm in wavelength[missing.any(axis=0)]]
        padding = (int(below), int(above))
        wavelength = np.concatenate([[low][: padding[0]], wavelength, [high][: padding[1]]])
        record = {
            "wavelength": [float(wavelength[0]), float(wavelength[-1])],
            "measured": list(measured),
            "bands": len(wavelength),
            "curves": len(curves),
            "complete": int((~missing.any(axis=1)).sum()),
            "gaps": gap_nm,
            "is_centre": not has_ends.any(),
            "clipped": 0,
            "centre_clipped": 0,
            "interpolated": int(missing.sum()),
            "centre_interpolated": int(centre_missing.sum()),
            "left_out": int((~has_ends).sum()),
            "thinned": thinned,
            "extrapolated": " and ".join(["below"] * below + ["above"] * above),
        }
        return wavelength, np.pad(centre, padding, "edge"), np.pad(curves, ((0, 0), padding), "edge"), record


# --- the folder of an export -------------------------------------------------------------------------------


EMISSIVITY, REFLECTANCE, BRDF = "emissivity", "reflectance", "brdf"

#: Name of the file that identifies an export.
MARKER = "paints.json"

FORMAT = "hyperpaint DIRSIG export"
#: Names of files and folders in exports.
_EXPORT_NAME = re.compile(
    r"emissivity|reflectance|brdf|geometry|maps|materials|README\.txt|materials\.mat|paints\.(glist|json)|.*\.(scene|jsim)"
)

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
    foreign = partial(
        foreign_content, product="an export", marker=MARKER, form=FORMAT, is_own=_EXPORT_NAME.fullmatch
    )
    with published_folder(as_path(folder).absolute(), overwrite=overwrite, foreign=foreign) as build:
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
#: Properties of the surface models: section, keys with the items of a paint's record, and constant pairs.
_PROPERTIES = {
    "ClassicEmissivity": (
        "EMISSIVITY_PROP",
        (("FILENAME", "emissivity_file"),),
        (("SPECULAR_FRACTION", "0"),),
    ),
    "SimpleReflectance": ("REFLECTANCE_PROP", (("TXT_FILENAME", "reflectance_file"),), ()),
    "ShellTarget": (
        "REFLECTANCE_PROP",
        (("EMISSIVITY_FILE", "emissivity_file"), ("BRDF_FIT_FILE", "fit_file")),
        (),
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
    extrapolate: bool | float = False,
    gaps: str | None = None,
    max_curves: int | None = None,
    specular: float | str = 0.0,
    roughness: float = 1e-3,
    surface: str = "ClassicEmissivity",
    rad_solver: str | None = None,
    thermal: Mapping[str, float] | None = None,
    double_sided: bool = False,
    scene_materials: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    r"""Write the paints of a library as materials of the simulator DIRSIG.

    Every paint becomes an ``.ems`` file with many curves, from which a texture can select, a two-column
    ``.txt`` of its centre and a MATERIAL_ENTRY; a clear coat is a ``.fit`` file of the BRDF Shell Target. The
    folder also contains a fragment of a geometry list and a
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
        Continue curves as constants where ``wavelength_range`` exceeds the measured range, or only over a
        distance [nm]; the README says where.
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
        Reflectance of the clear coats at normal incidence [1], such as 0.04, or ``library`` for the mean of
        the library's ``specular_reflectance`` (signature, band). Only for reflectance without mirrored light.
    roughness
        Roughness of the clear coats, the parameter alpha of the GGX model [1].
    surface
        Surface model of paints without a coat: ``ClassicEmissivity`` (reads the ``.ems``) or
        ``SimpleReflectance`` (reads the ``.txt``).
    rad_solver
        Name of DIRSIG's radiometry solver; by default ``Generic`` for coats, ``Classic`` for other paints.
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
        Properties of the materials (signature): ``material_id``, ``emissivity_file``, ``fit_file``, empty
        without a coat, ``coat_reflectance``; numbers of ``curves``,
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
    Of an opaque paint of body reflectance :math:`\rho` under a coat of reflectance :math:`F_0` (``specular``)

    .. math:: \epsilon = 1 - \rho - F_0

    and the BRDF of the coat is that of `hyperpaint.io.dirsig.dirsig_writing.fit_text`; paints without a coat
    are matte (SPECULAR_FRACTION of 0) [1]_. Emissivity has six decimals; samples outside 0 to 1 are clipped
    and counted, with a warning. The README lists what was checked, and what was not: DIRSIG has not run these
    files.

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
                "SimpleReflectance has no clear coat",
                "",
                "leave specular out, or surface",
                "option-conflict",
            ),
            (
                rad_solver is not None and not (rad_solver.isascii() and rad_solver.isalnum()),
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
    # clear coats of the paints: `specular` is their reflectance at normal incidence [1], or "library" for
    # the mean of `specular_reflectance`
    with Problems("clear coats cannot be written", SchemaError) as problems:
        is_from_library = specular == "library"
        has_specular = _SPECULAR in library.variables
        try:
            declared = mirror_reflection(library)
        except SchemaError as error:
            problems.add_error("", error)
            declared = None
        if is_from_library and has_specular:
            mirrored = require(library, [_SPECULAR], "DIRSIG materials", _ROWS)[_SPECULAR]
            values = np.nan_to_num(mirrored.astype(np.float64).mean(BAND).values)
        else:
            level = 0.0 if is_from_library else float(specular) if is_number(specular) else np.nan
            values = np.full(library.sizes[SIGNATURE], level)
        for is_wrong, found, expected, mend, option, code in (
            (
                not ((values >= 0.0) & (values < _MOST_COAT)).all(),
                f"specular={specular!r}" + (f" of up to {values.max():g}" if is_from_library else ""),
                f"0 to below {_MOST_COAT:g}, or 'library'",
                "pass the reflectance of the coat at normal incidence, such as 0.04",
                "",
                "value-out-of-range",
            ),
            (
                not (is_number(roughness) and 0.0 <= roughness <= 1.0),
                f"roughness={roughness!r}",
                "0 to 1",
                "",
                "",
                "value-out-of-range",
            ),
            (
                is_from_library and not has_specular,
                "specular='library', but the library has no specular_reflectance (signature, band)",
                "",
                "",
                "",
                "variable-missing",
            ),
            (
                # without a declaration the coat is taken as included, so that it cannot count twice
                specular != 0.0
                and (declared or INCLUDED) == INCLUDED
                and (not is_from_library or has_specular),
                f"specular={specular!r}, but the reflectance includes the mirrored light: the clear coat "
                "would count twice",
                "",
                "leave specular out, or pass body reflectance (remove_mirrored_sky) with "
                f"reflectance.attrs['mirror_reflection'] = {EXCLUDED!r}",
                "leave specular out, or give body reflectance (signatures --specular-sky)",
                "coat-counted-twice",
            ),
        ):
            problems.add_if(is_wrong, found, expected=expected, mend=mend, option=option, code=code)
    paint_curves = PaintCurves(
        library,
        Coats(values, np.full(values.shape, float(roughness))),
        curves=curves,
        wavelength_range=wavelength_range,
        extrapolate=extrapolate,
        gaps=gaps,
        max_curves=max_curves,
    )
    records = paint_records(library, () if scene_materials is None else read_materials(scene_materials))
    inside = (EMISSIVITY, REFLECTANCE, *([BRDF] if paint_curves.coats.reflectance.any() else []))
    with export_folder(folder, overwrite=overwrite, inside=inside) as build:
        write_spectra(paint_curves, build, records, progress)
        attrs = {**paint_curves.attrs, "surface": surface, "curves_of": curves}
        described = ("title", "source", "provenance", "references", "license")
        attrs |= {f"library_{name}": str(library.attrs[name]) for name in described if name in library.attrs}
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
    warn_if(messages, f"DIRSIG materials: {'; '.join(messages)}; see README.txt", "spectra-changed")
    numbers = ("curves", "complete", "clipped", "centre_clipped", "interpolated", "centre_interpolated")
    summary = summary_of(
        records,
        "DIRSIG materials",
        {**attrs, "folder": os.fspath(folder)},
        **dict.fromkeys((*numbers, "left_out", "thinned", "bands"), np.int64),
        **dict.fromkeys(("emissivity_file", "reflectance_file", "fit_file", "extrapolated"), object),
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
    rad_solver: str | None,
    thermal: Mapping[str, float] | None,
    double_sided: bool,
) -> Section:
    # Return the entry of one paint in a material list.
    # ``record``: record of the paint in ``paints.json``; ``surface``: ``ClassicEmissivity`` or
    # ``SimpleReflectance`` of a paint without a ``fit_file``; ``rad_solver``: name of the radiometry solver,
    # None for the solver of the surface; ``thermal``: values of `THERMAL`, None if temperature is not
    # computed; ``double_sided``: whether the back of a facet has the paint, too.
    surface = "ShellTarget" if record["fit_file"] else surface
    rad_solver = rad_solver or ("Generic" if record["fit_file"] else "Classic")
    name, keys, constants = _PROPERTIES[surface]
    properties = (*((key, record[item]) for key, item in keys), *constants)
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
            coat, roughness = (float(column[paints][number]) for column in paint_curves.coats)
            try:
                wavelength, centre, curves, items = paint_curves.of_paint(
                    values["centre"][number], values["curves"][number]
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
                    total = curves[start : start + _CURVES_AT_ONCE] + coat
                    items["clipped"] += int(((total < 0.0) | (total > 1.0)).sum())
                    file.write(curve_text.text(1.0 - np.clip(total, 0.0, 1.0)))
            items["centre_clipped"] = int(((centre < 0.0) | (centre > 1.0)).sum())
            centre = np.clip(centre, 0.0, 1.0)
            (build / record["reflectance_file"]).write_bytes(plain_text.text(centre[np.newaxis]))
            record |= {"coat_reflectance": coat, "fit_file": f"{BRDF}/{record['id']}.fit" if coat else ""}
            if coat:
                (build / record["fit_file"]).write_text(fit_text(coat, roughness, wavelength, centre))
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
    # Return items of the records (signature), by their dtypes, with names, IDs and coats.
    columns = {
        key: (SIGNATURE, np.array([record[key] for record in records], dtype))
        for key, dtype in {**dtypes, "coat_reflectance": np.float64, "id": object}.items()
    }
    # with pyarrow, pandas cannot store half a surrogate pair
    names = [record["paint"].encode("utf-8", "backslashreplace").decode() for record in records]
    return xr.Dataset(
        columns,
        {SIGNATURE: (SIGNATURE, np.array(names, object)), "material_id": columns.pop("id")},
        {"title": title, **attrs},
    )


# --- scenes of triangles: geometry, materials with populations, texture maps, lists ------------------------


#: Default of the largest number of curves of a population.
MAX_CURVES = 64

_WINDOW_NM = (400.0, 700.0)  # wavelengths of which a texture's picture shows the mean reflectance
#: Features of a scene, by the wavelengths that all materials must cover [nm].
_FEATURES = {"vis": (410.0, 690.0), "nir": (710.0, 890.0)}


class _Surface(NamedTuple):
    # Material of faces: a spectrum, and a clear coat
    spectrum: str  # name
    coat_index: float  # refractive index, 0 without a coat
    roughness: float

    @property
    def mirrored(self) -> float:
        # Fresnel reflectance of the coat at normal incidence [1]
        return ((self.coat_index - 1.0) / (self.coat_index + 1.0)) ** 2 if self.coat_index else 0.0


@takes_quantities(wavelength_range="nm")
@documented(overwrite="own overwrite")
def write_dirsig_scene(
    scene: Any,
    folder: str | os.PathLike[str],
    paints: xr.Dataset | Sequence[xr.Dataset],
    *,
    repaint: Mapping[str, str] | None = None,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    max_curves: int = MAX_CURVES,
    wavelength_range: tuple[float, float] | None = None,
    extrapolate: bool | float = False,
    gaps: str | None = None,
    texture_m: float = 2.0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    r"""Write a scene of triangles as files of the simulator DIRSIG.

    The folder contains the geometry as OBJ with its MTL, a geometry list, the ``.scene``, a skeleton of a
    ``.jsim``, the materials with their spectra, a texture map of every population of curves, and a README on
    how to run it and which constructs were checked. The folder appears when all files are complete.

    Parameters
    ----------
    scene
        A scene of `hyperpaint.simulation`, or an object with its ``name``; ``vertices`` (vertex, 3) [m], x
        east, y north, z up, and their ``normals`` (vertex, 3), zero for flat faces; ``faces`` (face, 3),
        ``face_material`` and ``face_instance`` (face,), indices of its ``materials`` and ``instances``.
    folder
    paints
        A paint library, or several; a spectrum is taken from the first with its name. ``reflectance``
        (signature, band) [1] must have the names of the spectra in the scene's materials. Members become a
        population of curves.
    repaint
        New spectra by the name of an instance (its paint), of a material, or of a spectrum, in this order of
        priority.
    origin
        Latitude and longitude [degree] of the scene's origin, and its height [m].
    max_curves
        Maximum number of curves in a population. They are chosen at equal steps of their rank in brightness,
        complete curves first.
    wavelength_range, extrapolate, gaps
        As for `write_dirsig`.
    texture_m
        Side of the square that a picture of a texture covers [m].
    overwrite
    progress

    Returns
    -------
    Dataset
        Properties of the materials (signature): ``material_id``, ``curves``, ``complete``, ``thinned``,
        ``coat_reflectance``, ``faces``, the ends ``extrapolated``, and ``texture``, empty without a texture
        map. Attributes: ``name``, ``features``, ``coverage_nm``.

    Raises
    ------
    SchemaError
        A spectrum of the scene is in no library, a name of ``repaint`` is not in the scene, an option is out
        of range, or paints have no values, or none at the ends of the range; all are listed.
    StoreError
        The folder contains other files, is being written by another process, or cannot be written.

    Notes
    -----
    A clear coat of refractive index n becomes the BRDF Shell Target, with the coat's reflectance at normal
    incidence F_0 = ((n - 1) / (n + 1))^2 in its first term, and the roughness of the coat; its lobe has the
    colour of the light. It is only written if the library declares its reflectance as free of mirrored light;
    else the coat would count twice. The README lists the constructs that were checked.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> from hyperpaint.simulation.rendering.materials import Material
    >>> from hyperpaint.simulation.rendering.scene import plane
    >>> grey = xr.DataArray([[0.2, 0.2]], dims=("signature", "band"), attrs={"units": "1"})
    >>> nm = ("band", [400.0, 1000.0], {"units": "nm"})
    >>> paints = xr.Dataset({"reflectance": grey}, {"signature": ["panel_20"], "wavelength": nm})
    >>> scene = plane(2.0, Material("grey", "panel_20", "panel"))
    >>> with tempfile.TemporaryDirectory() as out:
    ...     summary = write_dirsig_scene(scene, out, paints)
    ...     print(summary.features, *sorted(path.name for path in Path(out).iterdir()))
    vis,nir README.txt geometry ground.jsim ground.scene maps materials paints.json
    """
    libraries = list(paints) if isinstance(paints, Sequence) else [paints]
    place = np.asarray(origin, np.float64)
    is_place = place.shape == (3,) and np.isfinite(place).all() and (abs(place[:2]) <= [90.0, 360.0]).all()
    checks = (
        (
            isinstance(max_curves, int) and max_curves >= 1,
            f"max_curves={max_curves!r}",
            "a whole number above 0",
        ),
        (
            is_number(texture_m) and 1e-3 <= texture_m <= 1e4,
            f"texture_m={texture_m!r}",
            "0.001 to 10000 m",
        ),
        (is_place, f"origin={origin!r}", "latitude and longitude [degree] and height [m]"),
    )
    Problems("no DIRSIG scene can be written", SchemaError).raise_if_any(
        *(
            (not is_right, Problem(found, expected=expected, code="value-out-of-range"))
            for is_right, found, expected in checks
        )
    )
    for library in libraries:
        require(library, ["reflectance", "wavelength"], "a DIRSIG scene", LIBRARY_VARIABLES)
    repaint = dict(repaint or {})
    # Distinct surfaces, and the index of the surface of every face (face,)
    with Problems("the scene cannot be painted", SchemaError) as paint_problems:
        materials, instances = scene.materials, scene.instances
        names = {item.name for item in (*materials, *instances)} | {item.spectrum for item in materials}
        paint_problems.extend(
            Problem(
                f"repaint[{key!r}]: the scene has no instance, material or spectrum of this name",
                code="key-unknown",
            )
            for key in repaint.keys() - names
        )
    pair = scene.face_material.astype(np.int64) * len(instances) + scene.face_instance
    distinct, face_pair = np.unique(pair, return_inverse=True)
    number_of_surface: dict[_Surface, int] = {}
    surface_of_pair = []
    for code in distinct.tolist():
        material, instance = materials[code // len(instances)], instances[code % len(instances)]
        spectrum = repaint.get(material.name, repaint.get(material.spectrum, material.spectrum))
        if material.kind == "paint":
            spectrum = repaint.get(instance.name, spectrum)
        coat_index, roughness = (
            (0.0, 0.0) if (coat := material.coat) is None else (coat.index, coat.roughness)
        )
        pair_surface = _Surface(spectrum, float(coat_index), float(roughness))
        surface_of_pair.append(number_of_surface.setdefault(pair_surface, len(number_of_surface)))
    surfaces, face_surface = list(number_of_surface), np.asarray(surface_of_pair, np.int64)[face_pair.ravel()]
    # for every library the surfaces painted from it: pairs of their index and the index of their paint
    with Problems("the scene cannot be painted", SchemaError) as problems:
        surfaces_of: list[list[tuple[int, int]]] = [[] for _ in libraries]
        paint_indices = [
            {str(name): index for index, name in enumerate(library[SIGNATURE].values)}
            for library in libraries
        ]
        for number, surface in enumerate(surfaces):
            source = next((k for k, indices in enumerate(paint_indices) if surface.spectrum in indices), None)
            if source is None:
                problems.add(
                    f"spectrum {surface.spectrum!r} of the scene is in no library", code="spectrum-missing"
                )
            else:
                surfaces_of[source].append((number, paint_indices[source][surface.spectrum]))
    options = {
        "wavelength_range": wavelength_range,
        "extrapolate": extrapolate,
        "gaps": gaps,
        "max_curves": max_curves,
    }
    title = scene.name or "scene"
    stem = material_ids([title])[0]
    with export_folder(folder, overwrite=overwrite, inside=_FOLDERS) as build:
        records = _write_materials(
            build / "materials",
            libraries,
            surfaces_of,
            surfaces,
            options,
            progress=progress,
        )
        records.sort(key=lambda record: record["surface"])
        for record in records:
            record["faces"] = int((face_surface == record.pop("surface")).sum())
        attrs = _attrs(scene, records, origin, texture_m)
        low, high = attrs["window_nm"]
        grid = np.linspace(low, high, 301)
        for record in records:
            record["texture"] = ""
            if record["curves"] > 1:
                # mean reflectance of every curve over the window
                curves = read_emissivity(build / "materials" / record["emissivity_file"]).curves
                levels = (np.interp(grid, one.wavelength * 1000.0, one.emissivity).mean() for one in curves)
                picture = texture_picture(np.array([float(1.0 - level) for level in levels]), record["id"])
                if picture is not None:
                    record["texture"] = f"{record['id']}.pgm"
                    head = f"P5\n{picture.shape[1]} {picture.shape[0]}\n255\n".encode()
                    (build / "maps" / record["texture"]).write_bytes(head + picture.tobytes())
        with open(build / f"geometry/objects/{stem}.obj", "w", encoding="ascii", newline="\n") as file:
            identifiers = [record["id"] for record in records]
            for line in obj_lines(scene, identifiers, face_surface, f"{stem}.mtl", texture_m):
                file.write(line + "\n")
        width = max(2, *(len(record["id"]) for record in records))
        content = {"title": title, "stem": stem, "paints": records, "about": attrs, "width": width}
        marker = {"format": FORMAT, "version": 1, **attrs, "paints": records}
        simulation = [{"scene_list": [{"inputs": f"./{stem}.scene"}], "plugin_list": []}]
        templates = {
            f"{stem}.scene": "scene.scene.j2",
            f"geometry/lists/{stem}.glist": "scene.glist.j2",
            f"geometry/objects/{stem}.mtl": "scene.mtl.j2",
            "README.txt": "scene_readme.txt.j2",
        }
        sections = (
            material_section(
                record, surface="ClassicEmissivity", rad_solver=None, thermal=None, double_sided=True
            )
            for record in records
        )
        texts = {name: TEXTS.get_template(template).render(content) for name, template in templates.items()}
        texts |= {
            f"materials/{stem}.mat": materials_text(sections),
            # users add atmosphere and platform to the simulation
            f"{stem}.jsim": json.dumps(simulation, indent=4) + "\n",
            MARKER: json.dumps(marker, indent=1) + "\n",
        }
        write_texts(build, texts)
    numbers = dict.fromkeys(("curves", "complete", "thinned", "faces", "interpolated"), np.int64)
    attrs = {"name": title, **attrs, "folder": os.fspath(folder)}
    return summary_of(records, "DIRSIG scene", attrs, **numbers, texture=object, extrapolated=object)


_FOLDERS = (
    "geometry/lists",
    "geometry/objects",
    f"materials/{EMISSIVITY}",
    f"materials/{REFLECTANCE}",
    f"materials/{BRDF}",
    "maps",
)


def _write_materials(
    build: Path,
    libraries: Sequence[xr.Dataset],
    surfaces_of: Sequence[list[tuple[int, int]]],
    surfaces: Sequence[_Surface],
    options: Mapping[str, Any],
    *,
    progress: Callable[[int, int], None] | None,
) -> list[dict[str, Any]]:
    # Write the spectra of all surfaces; return their records, with the index of their ``surface``
    records: list[dict[str, Any]] = []
    for library, pairs in zip(libraries, surfaces_of, strict=True):
        if not pairs:
            continue
        numbers, paints = zip(*pairs, strict=True)
        # over reflectance with mirrored light a coat would count twice
        is_body = mirror_reflection(library) == EXCLUDED
        coats = Coats(
            np.array([surfaces[number].mirrored for number in numbers]) * is_body,
            np.array([surfaces[number].roughness for number in numbers]),
        )
        painted = library.isel({SIGNATURE: list(paints)})
        written = [Material(record["id"], record["name"], Section("")) for record in records]
        library_records = paint_records(painted, written)
        curves = "members" if "member_reflectance" in painted.variables else "centre"
        paint_curves = PaintCurves(painted, coats, curves=curves, **options)
        write_spectra(paint_curves, build, library_records, None)
        for record, number in zip(library_records, numbers, strict=True):
            record |= {"surface": number, "mirror_reflection": paint_curves.mirror_reflection}
        records += library_records
        if progress is not None:
            progress(len(records), len(surfaces))
    return records


def _attrs(
    scene: Any, records: Sequence[Mapping[str, Any]], origin: Sequence[float], texture_m: float
) -> dict[str, Any]:
    low = max(record["wavelength"][0] for record in records)
    high = min(record["wavelength"][1] for record in records)
    features = [name for name, (start, end) in _FEATURES.items() if low <= start and high >= end]
    window = max(low, _WINDOW_NM[0]), min(high, _WINDOW_NM[1])
    lobes = sum(bool(record["fit_file"]) for record in records)
    included = sum(record["mirror_reflection"] != EXCLUDED for record in records)
    advice = (
        f"{lobes} materials have a clear coat as the BRDF Shell Target; their curves include its "
        "reflectance\nat normal incidence."
    )
    if included:
        advice += (
            f"\nThe curves of {included} include light mirrored by a coat, or do not declare it: these "
            "materials\nhave no coat; do not add one, it would count twice."
        )
    return {
        "origin": [float(value) for value in origin],
        "faces": len(scene.faces),
        "texture_m": float(texture_m),
        "coverage_nm": [low, high],
        "features": ",".join(features),
        "window_nm": list(window if window[0] < window[1] else (low, high)),
        "coat_advice": advice,
    }


#: Side of a texture's picture [pixel].
PICTURE_PX = 128

_GRAIN_PX = 3.0  # standard deviation of the Gaussian blur of the noise in a picture


def obj_lines(
    scene: Any, material_id: Sequence[str], face_id: Ints, library: str, texture_m: float
) -> Iterator[str]:
    # Yield the lines of a scene as Wavefront OBJ, one object per instance.
    # ``face_id`` (face,): index of the face's material in ``material_id``; ``library``: the ``.mtl`` file.
    # Texture coordinates are in units of ``texture_m``, in the coordinate plane that is most parallel to the
    # face, so that a picture has a similar size on all faces.
    yield f"mtllib {library}"
    yield from (f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in scene.vertices.tolist())
    # distinct pairs of a vertex and the plane of its face: 0, 1 or 2 for the plane across x, y or z
    corners = scene.vertices[scene.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    plane: Ints = np.argmax(np.abs(normals), axis=1, keepdims=True)
    projected, texture = np.unique(scene.faces + plane * len(scene.vertices), return_inverse=True)
    axes = np.array([(1, 2), (0, 2), (0, 1)])[projected // len(scene.vertices)]
    points = np.take_along_axis(scene.vertices[projected % len(scene.vertices)], axes, axis=1) / texture_m
    yield from (f"vt {a:.5f} {b:.5f}" for a, b in points.tolist())
    yield from (f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in scene.normals.tolist())
    smooth = (scene.normals != 0.0).any(axis=1)[scene.faces].all(axis=1).tolist()
    order = np.lexsort((face_id, scene.face_instance))
    instance, material = -1, -1
    # OBJ counts from 1
    vertices, textures = (scene.faces + 1).tolist(), (texture.reshape(scene.faces.shape) + 1).tolist()
    for face in order.tolist():
        previous = instance, material
        instance, material = int(scene.face_instance[face]), int(face_id[face])
        if instance != previous[0]:
            yield f"o {plain_name(scene.instances[instance].name)}"
        if (instance, material) != previous:
            yield f"usemtl {material_id[material]}"
        pairs = zip(vertices[face], textures[face], strict=True)
        # the normal of a vertex has the number of the vertex
        yield "f " + " ".join(f"{a}/{b}/{a}" if smooth[face] else f"{a}/{b}" for a, b in pairs)


def texture_picture(means: Array, name: str) -> Array | None:
    """Return a picture (row, column) by which DIRSIG uses every curve of a population equally often.

    DIRSIG compares standard scores: a pixel gets the curve whose mean over the picture's wavelengths, in
    standard deviations of the population, is nearest to the pixel's brightness in standard deviations of the
    picture. The pixels have the mean reflectances of the curves as brightness, and every curve has the same
    number of pixels, so that both scores are equal. Curves that differ by less than 1/255 of their range
    share pixels.

    ``means`` (curve,): mean reflectances of the curves over these wavelengths; ``name``: seed of the noise.
    None for one curve, or curves of equal means.

    Examples
    --------
    >>> np.unique(texture_picture(np.array([0.2, 0.4, 0.25, 0.32]), "red"), return_counts=True)
    (array([  0,  64, 153, 255], dtype=uint8), array([4096, 4096, 4096, 4096]))
    """
    spread = float(np.ptp(means))
    if not spread > 1e-6:
        return None
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    frequency = np.fft.fftfreq(PICTURE_PX)
    blur = np.exp(-2.0 * (np.pi * _GRAIN_PX) ** 2 * (frequency[:, None] ** 2 + frequency**2))
    grain = np.fft.ifft2(np.fft.fft2(rng.standard_normal((PICTURE_PX, PICTURE_PX))) * blur).real
    rank = np.empty(grain.size, np.int64)
    rank[np.argsort(grain.ravel(), kind="stable")] = np.arange(grain.size)
    level = np.rint(255.0 * (np.sort(means) - means.min()) / spread).astype(np.uint8)
    return np.asarray(level[rank * len(means) // grain.size].reshape(grain.shape))


#: Largest distance of the wavelengths of a coat's parameters [nm].
_FIT_STEP_NM = 20.0
_SMOOTH_DEG = 90.0  # tau and omega of a coat with hardly any shadowing and obscuration


def fit_text(coat: float, roughness: float, wavelength: Array, body: Array) -> str:
    r"""Return the ``.fit`` file of a clear coat over a Lambert body, for DIRSIG's Shell Target BRDF.

    That is the Beard-Maxwell model of the NEF database [1]_, equation 10,

    .. math:: f = \frac{F(\beta)}{F(0)} \frac{B e^{-(\theta_h / \sigma)^2} \cos^2 \theta_h}
                  {\cos \theta_i \cos \theta_r} S + \rho_d + \frac{2 \rho_v}{\cos \theta_i + \cos \theta_r}

    with B such that the first term reflects F(0) of light from the normal, :math:`\rho_d` the reflectance of
    the body over pi, and :math:`\rho_v` = 0. DHR is the total reflectance at normal incidence. Parameters are
    written at many wavelengths, both ends of the range included, so that the kind of interpolation between
    them has no influence.

    Parameters
    ----------
    coat, roughness
        Reflectance F(0) of the coat at normal incidence [1], and GGX alpha of its surface; the Gaussian has
        the same peak.
    wavelength, body
        Wavelengths [nm], and reflectance of the body through the coat (wavelength,) [1].

    References
    ----------
    .. [1] H. B. Westlund, G. W. Meyer, "A BRDF database employing the Beard-Maxwell reflection model",
       Graphics Interface 2002, 189-200, https://doi.org/10.20380/GI2002.22

    Examples
    --------
    >>> text = fit_text(0.04, 0.05, np.array([400.0, 410.0]), np.array([0.1, 0.1]))
    >>> print(*text.splitlines()[:6], sep="\n")
    FIT_PARAMS {
        LAMBDA = 0.4000000
        N = 1.5
        K = 0
        DHR = 0.14
        BIAS = 1.28092
    """
    index = (1.0 + np.sqrt(coat)) / (1.0 - np.sqrt(coat))
    sigma = max(roughness, 1e-4)
    # light from the normal is reflected at twice the facet's tilt: d omega = 2 sin(2 theta) d theta d phi
    tilt = np.linspace(0.0, min(8.0 * sigma, np.pi / 4.0), 4001)
    shadow = np.degrees(tilt) / _SMOOTH_DEG
    shadow = (1.0 + shadow * np.exp(-2.0 * shadow)) / (1.0 + shadow)
    # reflectance for unpolarised light
    cos_air, cos_coat = np.cos(tilt), np.sqrt(1.0 - (np.sin(tilt) / index) ** 2)
    s_wave = (cos_air - index * cos_coat) / (cos_air + index * cos_coat)
    fresnel = 0.5 * (s_wave**2 + ((index * cos_air - cos_coat) / (index * cos_air + cos_coat)) ** 2)
    lobe = np.exp(-((tilt / sigma) ** 2)) * np.cos(tilt) ** 2 * shadow * fresnel / coat
    flux = float(np.trapezoid(2.0 * np.pi * lobe * 2.0 * np.sin(2.0 * tilt), tilt))
    number = max(2, int(np.ceil((wavelength[-1] - wavelength[0]) / _FIT_STEP_NM)) + 1)
    blocks = []
    for nm in np.linspace(wavelength[0], wavelength[-1], number).tolist():
        level = float(np.interp(nm, wavelength, body))
        values = {
            "N": index,
            "K": 0.0,
            "DHR": coat + level,
            "BIAS": coat / flux,
            "SIGMA": sigma,
            "TAU": _SMOOTH_DEG,
            "OMEGA": _SMOOTH_DEG,
            "RHO_D": level / np.pi,
            "RHO_V": 0.0,
        }
        rows = "".join(f"    {key} = {value:.6g}\n" for key, value in values.items())
        # the ends with the digits of the curves, so that rounding leaves nothing uncovered
        at = f"{nm / 1000.0:.{WAVELENGTH_DECIMALS}f}"
        blocks.append(f"FIT_PARAMS {{\n    LAMBDA = {at}\n{rows}}}\n")
    return "".join(blocks)
