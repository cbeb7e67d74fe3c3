"""Tracing the paths of light through a scene, and relighting: radiance for any paints, atmosphere and camera.

*Tracing* records the weights of paths, lazily, in blocks of lines. It needs no spectra. The random numbers of
a pixel depend only on the seed and its position in the flight line, so that results have the same bits for
all blocks, threads and machines.

*Spectra of the factors of paths*: names, tables, functions, or paints of a library with their populations. A
pixel shows a member of the population of its dominant surface: in the products of its paths, the factor of
this surface is multiplied by member over mean, band by band. Paths are not traced again; light from other
surfaces has their mean spectra. Members are ranked by brightness, and a smooth random field over the surface
gives the rank, so that all members are equally likely and neighbours are similar (`Octaves`).

*Relighting*: a path of weight ``w`` adds ``w E(lambda)/pi x product of its factors`` to the radiance of a
pixel. The term after ``w`` depends only on the path's code, of which a scene has some thousands: it is
computed once for every code and band, and cached.

Shares of light are shares of the radiance at the surface, before the air, as a mean over all bands at the
wavelengths of the centre column. Shares of sun and sky add up to 1; glint, mirrored sky and indirect light
are disjoint parts of them.
"""

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import dask
import dask.array as da
import numpy as np
import xarray as xr
from numcodecs.blosc import SHUFFLE, Blosc

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    FORMAT_VERSION,
    INCLUDED,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    MEMBER,
    SIGNATURE,
    SLOT,
    SUN,
    VARIABLES,
    Array,
    ArrayLike,
    Bools,
    Floats,
    Floats32,
    Ints,
    PaintError,
    Problems,
    SchemaError,
    convert,
    dtype_of,
    flake_exponents,
    label,
    mirror_reflection,
    require,
    shows_flakes,
    takes_quantities,
    warn_if,
    with_new_names,
)
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.light.sky_functions import function_tables
from hyperpaint.simulation.atmosphere import Atmosphere, BrokenClouds, preset_atmosphere
from hyperpaint.simulation.camera import BandResponses, BandSet, cell_means, convolve_gaussian
from hyperpaint.simulation.transport.hierarchy import Geometry, build_geometry
from hyperpaint.simulation.transport.mixing import (
    Grain,
    Texture,
    index_paths,
    integrate_bands,
    member_rows,
    mix,
    mix_shifted,
    through_air,
)
from hyperpaint.simulation.transport.path_codes import (
    CLEAR_SKY_FUNCTIONS,
    FIRST_CLEAR_SKY,
    FIRST_SUN,
    OVERCAST_SKY,
    SKY,
    SOURCES,
    PathCodes,
    is_direct,
    is_indirect,
    is_mirrored,
    source_of,
)
from hyperpaint.simulation.transport.paths import Block, Rays, Settings, Sources, trace_lines
from hyperpaint.simulation.transport.surfaces import Surfaces, surfaces_of

from .materials import measured_factor
from .platforms import Platform
from .scene import LabelTable, Scene, SceneRecord, TraceSettings, label_layers, sun_vectors
from .scene_spectra import MEASURED, Octaves, Spectrum, is_paint, paint_spec, spectrum_of

# --- tracing -----------------------------------------------------------------------------------------------

Sun = tuple[float, float] | Atmosphere | str


# Arguments of the kernel for a scene; prepared once and shared by all tasks.
class PreparedScene(NamedTuple):
    geometry: Geometry
    surfaces: Surfaces
    sources: Sources
    codes: PathCodes  # layout of the codes of paths
    settings: TraceSettings
    labels: dict[str, LabelTable]


def prepare_scene(scene: Scene, settings: TraceSettings) -> PreparedScene:
    # build the hierarchy of a scene's triangles, and the tables of its surfaces
    record = SceneRecord.of(scene)
    geometry = build_geometry(
        scene.vertices, scene.faces, scene.normals, scene.face_material, scene.face_instance
    )
    radius = np.full(len(settings.suns), np.radians(settings.sun_radius))
    sources = Sources(sun_vectors(settings.suns), radius, settings.overcast)
    if settings.clear:
        sources = sources._replace(skies=np.stack([function_tables(zenith) for zenith, _ in settings.suns]))
    coats = [material.coat for material in record.materials]
    flakes = [material.flakes for material in record.materials]
    # numbers of the factors of every material: base, flakes, transmittance, turned flakes
    factors = np.full((4, len(coats)), -1, np.int32)
    for number, factor in enumerate(record.factors):
        row = (3 if factor.turned else 1) if factor.flakes else (2 if factor.through else 0)
        factors[row, factor.material] = number
    surfaces = surfaces_of(
        np.array([0.0 if coat is None else coat.index for coat in coats]),
        np.array([1.0 if coat is None else coat.roughness for coat in coats]),
        np.radians([0.0 if coat is None else coat.waviness for coat in coats]),
        np.array([0.0 if flake is None else flake.share for flake in flakes]),
        np.array([1.0 if flake is None else flake.roughness for flake in flakes]),
        *factors[:3],
        turned_factor=factors[3],
    )
    return PreparedScene(geometry, surfaces, sources, record.codes(settings), settings, record.labels())


def trace_block(prepared: PreparedScene, platform: Platform, start: int, stop: int) -> Block:
    # trace the lines from ``start`` to before ``stop`` of a whole flight line, now
    here = slice(start, stop)
    edges = platform.column_edges, platform.along_edges
    return trace_rays(prepared, platform.origin[here], platform.rotation[here], edges, start)


def trace_rays(
    prepared: PreparedScene, origin: Array, rotation: Array, edges: tuple[Array, Array], first_line: int
) -> Block:
    chosen = prepared.settings
    numbers = Settings(first_line, chosen.samples, chosen.depth, prepared.codes.digit_bits, chosen.seed)
    block = Block.empty(len(origin), chosen.slot_count, edges[0].size - 1, len(chosen.suns))
    scene = prepared.geometry, prepared.surfaces, prepared.sources
    trace_lines(*scene, Rays(origin, rotation, *edges), numbers, block)
    return block


@takes_quantities(sun_radius="degree")
def trace(
    scene: Scene,
    platform: Platform,
    suns: Sequence[Sun] | Sun = ("noon",),
    *,
    samples: int = TraceSettings.samples,
    depth: int = TraceSettings.depth,
    seed: int = TraceSettings.seed,
    slots: int | None = None,
    overcast: bool = False,
    clear: bool = True,
    sun_radius: float = TraceSettings.sun_radius,
    chunk_lines: int = CHUNK_LINES,
) -> xr.Dataset:
    r"""Trace the paths of light through a scene, without their spectra.

    The result can be relit with any paints, atmosphere and camera (`hyperpaint.simulation.relight`); only
    geometry, sun directions and coats are fixed. `hyperpaint.to_store` stores it.

    Parameters
    ----------
    scene
        The scene.
    platform
        Path, attitude and pixels of the camera.
    suns
        Up to six directions of direct light: (zenith, azimuth clockwise from north) [degree], an
        `Atmosphere`, or the name of a preset one ("noon", "near_sunset", "cloudy"). Equal directions are
        traced once.
    samples
        Number of paths of a pixel, spread over its footprint and the exposure.
    depth
        Maximum number of reflections of a path.
    seed
        Random seed; equal seeds give equal bits for all chunks and schedulers.
    slots
        Maximum number of different paths stored for a pixel; by default 24 for each sun and sky, times the
        square root of ``samples`` / 64. Of more paths the heaviest are kept, and a random, unbiased choice
        represents the others; few slots cause noise.
    overcast
        Also record a sky whose radiance is proportional to the cosine of the zenith angle, for atmospheres
        with an ``overcast_share``; recorded as well if ``suns`` contains such an atmosphere.
    clear
        Also record the functions of every sun's clear sky (`hyperpaint.light.sky_functions`); without them
        only atmospheres with a uniform or overcast sky can be used.
    sun_radius
        Angular radius of the suns [degree]; 0 for a point with sharp shadows.
    chunk_lines
        Number of lines of a dask chunk, which is one task.

    Returns
    -------
    Dataset
        Lazy. ``transport_weight`` and ``transport_path`` (along_track, slot, cross_track); labels
        ``material``, ``instance``, ``surface_class``, ``paint_id`` and ``car_id``, ``purity``, ``distance``
        and the position ``east``, ``north``, ``up`` (along_track, cross_track) [m]; ``sun_visibility`` and
        ``sun_incidence`` (along_track, sun, cross_track). Attributes explain the numbers.

    Raises
    ------
    SchemaError
        Settings are out of range, or there are too many spectra for ``depth``; all are listed.

    Notes
    -----
    The radiance of a pixel is

    .. math:: L(\lambda) = \sum_p w_p \frac{E_{s(p)}(\lambda)}{\pi} \prod_{f \in p} \rho'_f(\lambda)

    with weights :math:`w_p` that do not depend on wavelength, as coats have one refractive index.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.platforms import pushbroom
    >>> from hyperpaint.simulation.rendering.scene import plane
    >>> traced = trace(plane(100.0), pushbroom(64, 8), [(30.0, 180.0)], samples=4)
    >>> dict(traced.sizes)
    {'along_track': 64, 'slot': 40, 'cross_track': 8, 'sun': 1}
    """
    directions, overcast_light = _directions(suns)
    settings = TraceSettings(
        directions,
        samples=samples,
        depth=depth,
        seed=seed,
        slots=slots,
        overcast=bool(overcast) or overcast_light,
        clear=bool(clear),
        sun_radius=sun_radius,
    )
    SchemaError.raise_if(
        isinstance(chunk_lines, bool) or not isinstance(chunk_lines, int) or chunk_lines < 1,
        f"chunk_lines={chunk_lines!r}",
        expected="a whole number above 0",
        code="value-out-of-range",
    )
    record = SceneRecord.of(scene)
    record.codes(settings)  # raises here, before any task, if they do not fit
    # one task a block computes all variables; it holds the poses of its lines only
    poses = np.empty(
        platform.lines, [("line", "i8"), ("origin", "f8", (2, 3)), ("rotation", "f8", (2, 3, 3))]
    )
    poses["line"] = np.arange(platform.lines)
    poses["origin"], poses["rotation"] = platform.origin, platform.rotation
    # the scene is one node of the graph, prepared once; compressed, as dask warns of graphs above 10 MB
    pickled = bytes(Blosc("lz4", 5, SHUFFLE, typesize=8).encode(pickle.dumps(scene, protocol=5)))
    packed = dask.delayed(pickled, name=f"scene-{dask.base.tokenize(scene)}", traverse=False)
    blocks = da.blockwise(
        _trace_task,
        "l",
        da.from_array(poses, chunks=chunk_lines),
        "l",
        dask.delayed(_prepare_packed, pure=True)(packed, settings),
        None,
        edges=(platform.column_edges, platform.along_edges),
        dtype=object,
        meta=np.empty(0, object),
    )
    sizes = {"s": settings.slot_count, "u": len(settings.suns), "x": platform.columns}
    arrays = split_outputs(
        blocks, "l", {name: (dims, dtype_of(name)) for name, dims in _LAYOUT.items()}, sizes
    )
    labels = record.labels()
    utc = platform.utc.astype("datetime64[ns]")
    coords = {
        "time": (ALONG_TRACK, utc),
        "sun_zenith": (SUN, np.array([zenith for zenith, _ in settings.suns], np.float64)),
        "sun_azimuth": (SUN, np.array([azimuth for _, azimuth in settings.suns], np.float64)),
    }
    traced = xr.Dataset(
        {name: ([_DIMS[dim] for dim in _LAYOUT[name]], array) for name, array in arrays.items()},
        {name: (dims, values, VARIABLES[name].attrs) for name, (dims, values) in coords.items()},
        {
            "hyperpaint_format": FORMAT_VERSION,
            "name": record.name,
            **record.to_attrs(settings),
            "time_coverage_start": str(utc.min()),
            "time_coverage_end": str(utc.max()),
        },
    )
    return traced.assign(
        {name: label(traced[name], name, **(labels[name].attrs if name in labels else {})) for name in arrays}
    )


def _directions(suns: Any) -> tuple[Any, bool]:
    # Different directions, and whether an atmosphere among them is overcast.
    if isinstance(suns, str | Atmosphere):
        suns = [suns]
    if not isinstance(suns, list | tuple):
        return suns, False
    lights = [preset_atmosphere(sun) if isinstance(sun, str) else sun for sun in suns]
    named = [light for light in lights if isinstance(light, Atmosphere)]
    directions = [
        (light.sun_zenith, light.sun_azimuth) if isinstance(light, Atmosphere) else light for light in lights
    ]
    return [sun for place, sun in enumerate(directions) if sun not in directions[:place]], any(
        light.overcast_share > 0 for light in named
    )


#: Variable to its dims, one letter each: line, slot, sun (u), column (x).
_LAYOUT = {
    **dict.fromkeys(("transport_weight", "transport_path"), "lsx"),
    **dict.fromkeys(("material", "instance", "surface_class", "paint_id", "car_id", "purity"), "lx"),
    **dict.fromkeys(("distance", "east", "north", "up"), "lx"),
    **dict.fromkeys(("sun_visibility", "sun_incidence"), "lux"),
}
_DIMS = {"l": ALONG_TRACK, "s": SLOT, "u": SUN, "x": CROSS_TRACK}


def _prepare_packed(packed: bytes, settings: TraceSettings) -> PreparedScene:
    return prepare_scene(pickle.loads(Blosc().decode(packed)), settings)


def _trace_task(poses: Array, prepared: PreparedScene, edges: tuple[Array, Array]) -> dict[str, Array]:
    block = trace_rays(prepared, poses["origin"], poses["rotation"], edges, int(poses["line"][0]))
    return {
        name: np.ascontiguousarray(block.position[:, axis])
        for axis, name in enumerate(("east", "north", "up"))
    } | {
        "transport_weight": block.weight,
        "transport_path": block.code,
        "material": block.material,
        "instance": block.instance,
        "purity": block.purity,
        "distance": block.distance,
        "sun_visibility": block.sun_visibility,
        "sun_incidence": block.incidence,
        **label_layers(prepared.labels, block.material, block.instance),
    }


#: Maximum number of members of a population in a render; more would change its quantiles by less than 0.2 %.
MAX_MEMBERS = 512

#: Maximum excess of measured reflectance beyond 0 or 1 by noise [1]; more is an error of scale or light.
_NOISE = 0.05

#: Maximum range at an end of the bands over which a spectrum is held constant by default [nm].
HELD_NM = 25.0

_CROPPING = SimpleNamespace(
    max_ranges_shown=6,
    #: Maximum relative standard deviation of the level of members at one angle [1].
    max_spread=0.05,
    #: Minimum mean by which members are divided [1].
    min_mean=1e-4,
    #: Maximum of member over mean [1], which limits noise for a mean near 0.
    max_ratio=50.0,
)

#: Variables of a library that the change of a paint with flakes needs.
_FLAKES = frozenset(("flop", "aspecular_angle", "aspecular_range"))

#: Variables of a library that the renderer reads.
PAINT_VARIABLES = (
    "reflectance",
    "member_reflectance",
    *sorted(_FLAKES),
    "sun_zenith",
    "diffuse_fraction",
)


#: Number of angles for which the change of a paint with flakes is tabulated; odd, so that one is the middle.
_ANGLES = 65


# --- spectra of a user -------------------------------------------------------------------------------------


# A tabulated spectrum: linear between its points, constant beyond them
@dataclass(frozen=True, eq=False)
class Table:
    wavelength: Floats  # (point,): increasing wavelengths [nm]
    reflectance: Floats  # (point,): reflectance [1]
    members: Floats | None = None  # (member, point): population [1]; None without a population
    # angle between view and mirrored sun of the middle member, and range of the angles [degree], for members
    # in the order of this angle; a range of 0 for others
    angles: tuple[float, float] = (0.0, 0.0)

    octaves = MEASURED

    def __call__(self, wavelength: Floats) -> Floats:
        return np.interp(wavelength, self.wavelength, self.reflectance)

    def population(self, wavelength: Floats) -> Floats | None:
        # members at ``wavelength`` [nm], (member, wavelength); None without a population
        return (
            None
            if self.members is None
            else np.stack([np.interp(wavelength, self.wavelength, row) for row in self.members])
        )


def is_library(value: Any) -> bool:
    # whether a value is a dataset with ``reflectance`` (signature, band)
    is_dataset = hasattr(value, "data_vars") and "reflectance" in value
    # "paint" is the dim in libraries of version 0.2
    return is_dataset and not {SIGNATURE, "paint"}.isdisjoint(value["reflectance"].dims)


def _paints_by_name(library: xr.Dataset) -> dict[str, xr.Dataset]:
    # paints of a library by name, lazily, with the variables that the renderer needs; SchemaError for other
    # datasets, and for paints without or with equal names
    library = with_new_names(library) if is_library(library) else library
    SchemaError.raise_if(
        not is_library(library) or SIGNATURE not in library.variables,
        f"spectra is {type(library).__name__}",
        expected="a mapping of names to spectra, or a paint library with reflectance (signature, band)",
        code="type-wrong",
    )
    names = [str(name) for name in library[SIGNATURE].values]
    SchemaError.raise_if(
        duplicates := sorted({name for name in names if names.count(name) > 1}),
        f"the library has several paints named {', '.join(map(repr, duplicates))}",
        mend="rename them, or select one with library.isel(signature=...)",
        code="paint-ambiguous",
    )
    reduced = library[[name for name in PAINT_VARIABLES if name in library.variables]].reset_coords(drop=True)
    reduced = reduced.assign_coords(
        {name: library[name].variable for name in (("wavelength", "good")) if name in library.variables}
    )
    reduced.attrs = dict(library.attrs)
    return {name: reduced.isel({SIGNATURE: number}) for number, name in enumerate(names)}


def by_name(spectra: Any) -> dict[str, Any]:
    # spectra by name: paints of a library, and paints ``name/paint`` of libraries in a mapping.
    # The paint of a library of one paint in a mapping has the library's name.
    if spectra is None:
        return {}
    if is_library(spectra) or not isinstance(spectra, Mapping):
        return dict(_paints_by_name(spectra))
    by_key: dict[str, Any] = {}
    for name, value in spectra.items():
        if not is_library(value):
            by_key[str(name)] = value
            continue
        paints = _paints_by_name(value)
        is_single = len(paints) == 1
        by_key |= {
            str(name) if is_single else f"{name}/{paint}": spectrum for paint, spectrum in paints.items()
        }
    return by_key


class SpectrumReader:
    """Turns user spectra into functions of wavelength, and collects their problems.

    Parameters
    ----------
    given
        Spectra by name, from `by_name`.
    bands
        Bands that the spectra must cover.
    problems
        List to which problems are added.
    clip
        Limit reflectances to 0 to 1 instead of an error.
    hold_edges
        Extend spectra by their first and last good value, and interpolate bands without a value; None extends
        by at most `HELD_NM`, with a warning.
    """

    def __init__(
        self,
        given: Mapping[str, Any],
        bands: BandSet,
        problems: Problems,
        *,
        clip: bool,
        hold_edges: bool | None,
    ) -> None:
        self._given, self._bands, self._problems = given, bands, problems
        self._clip, self._hold_edges = clip, hold_edges
        self._clipped: list[str] = []
        self._mirroring: list[str] = []
        self._held: dict[str, float] = {}  # longest range without values at an end [nm]

    def read(self, name: str) -> Spectrum | None:
        # spectrum by name as a function of wavelength; None after a problem
        value, problems, bands = self._given.get(name, name), self._problems, self._bands
        spectrum: Spectrum | None = None
        if isinstance(value, str):
            try:
                spectrum = spectrum_of(value)
            except SchemaError as error:
                library_paints = [key for key in self._given if key.startswith(f"{value}/")]
                hint = (
                    f"choose one of {some_names(library_paints)}"
                    if library_paints
                    else f"or pass spectra={{{value!r}: ...}}"
                )
                problems.add(
                    error.problem.found,
                    mend="; ".join(filter(None, (error.problem.mend, hint))),
                    code="spectrum-unknown",
                )
                return None
        elif callable(value) and not hasattr(value, "dims"):
            spectrum = value
        if spectrum is not None:
            values = np.asarray(spectrum(np.arange(bands.limits[0], bands.limits[1] + 1.0)), np.float64)
        else:
            try:
                is_dataset = hasattr(value, "data_vars")
                table = self._library_table(value, name) if is_dataset else Table(*_columns(value))
            except (PaintError, TypeError, ValueError) as error:
                problems.add(
                    f"spectrum {name!r} cannot be read: {error}",
                    expected="a name, (wavelength [nm], reflectance), a DataArray with a coordinate "
                    "'wavelength', or a paint library",
                    code="spectrum-unreadable",
                )
                return None
            spectrum = cropped = self._cropped(table, name)
            if cropped is None:
                return None
            values = cropped.reflectance
        if not (values.size and np.isfinite(values).all()):
            problems.add(f"spectrum {name!r} is not finite", mend="fill the gaps", code="not-finite")
        elif not self._clip and (values.min() < 0.0 or values.max() > 1.0):
            problems.add(
                f"spectrum {name!r} ranges from {values.min():.4g} to {values.max():.4g}",
                expected="0 to 1",
                mend="divide per cent by 100, or pass clip=True",
                option="divide per cent by 100",
                code="value-out-of-range",
            )
        return spectrum

    def warn(self) -> None:
        warn_if(
            self._clipped,
            f"reflectances of {some_names(self._clipped)} exceed 0 to 1 by noise, up to {_NOISE:g}; they are "
            "clipped for the render",
            "reflectance-clipped",
        )
        warn_if(
            self._held,
            f"{some_names(self._held)} have no values at the ends of the bands and are held constant there, "
            f"over up to {max(self._held.values(), default=0.0):.1f} nm; pass hold_edges=True to accept this "
            "(--hold-edges), or False to refuse it",
            "edge-bands-held",
        )
        warn_if(
            self._mirroring,
            f"{some_names(self._mirroring)} contain the mirror reflection of the coat, which the renderer "
            "adds again; extract signatures with specular_sky=True (--specular-sky)",
            "mirror-counted-twice",
        )

    def _cropped(self, table: Table, name: str) -> Table | None:
        # usable part of a table in the range of the bands, since gaps elsewhere do not matter
        nm, reflectance, bands, problems = table.wavelength, table.reflectance, self._bands, self._problems
        if nm.ndim != 1 or nm.shape != reflectance.shape or nm.size < 2:
            problems.add(
                f"spectrum {name!r} has wavelengths {nm.shape} and reflectances {reflectance.shape}",
                expected="two arrays of one length, at least 2",
                code="length-mismatch",
            )
            return None
        if not np.isfinite(nm).all() or not (np.diff(nm) > 0).all():
            problems.add(
                f"wavelengths of spectrum {name!r} do not increase",
                mend="sort them",
                code="wavelength-unordered",
            )
            return None
        # values may end up to half a width inside the centres of the outer bands
        first_centre, last_centre = bands.wavelength[[0, -1]]
        first_needed, last_needed = first_centre + bands.fwhm[0] / 2, last_centre - bands.fwhm[-1] / 2
        is_used = np.isfinite(reflectance)
        most_held = {None: HELD_NM, False: 0.0, True: np.inf}[self._hold_edges]
        if not self._hold_edges:
            missing = ~is_used & (nm >= first_needed) & (nm <= last_needed)
            if self._hold_edges is None and is_used.any():  # bands at the ends are held
                first, last = nm[is_used][[0, -1]]
                missing &= (nm > first) & (nm < last)
            is_used |= missing
        if is_used.sum() < 2:
            gaps = _ranges_text(nm, ~np.isfinite(reflectance))
            problems.add(
                f"spectrum {name!r} is not finite at {gaps} nm", mend="fill the gaps", code="not-finite"
            )
            return None
        nm, reflectance = nm[is_used], reflectance[is_used]
        held = max(nm[0] - first_needed, last_needed - nm[-1])
        if held > most_held:
            problems.add(
                f"spectrum {name!r} covers {nm[0]:.1f} to {nm[-1]:.1f} nm",
                expected=f"the range of the bands, {first_centre:.1f} to {last_centre:.1f} nm",
                mend="pass hold_edges=True to extend it by its first and last value",
                option="pass --hold-edges to extend it by its first and last value",
                code="spectrum-coverage",
            )
        elif held > 0.0 and self._hold_edges is None:
            self._held[name] = float(held)
        start = min(max(int(np.searchsorted(nm, bands.limits[0])) - 1, 0), nm.size - 1)
        points = slice(start, max(int(np.searchsorted(nm, bands.limits[1])) + 1, start + 1))
        is_missing = ~np.isfinite(reflectance[points])
        if is_missing.any():
            problems.add(
                f"spectrum {name!r} is not finite at {_ranges_text(nm[points], is_missing)} nm",
                mend="fill the gaps, or pass hold_edges=True to interpolate them",
                option="fill the gaps, or pass --hold-edges to interpolate them",
                code="not-finite",
            )
            return None
        # members without gaps, of which a population has at least two
        members = table.members
        if members is not None:
            members = members[:, is_used]
            members = members[np.isfinite(members).all(axis=1)][:, points]
            members = members if len(members) > 1 else None
        return Table(nm[points], reflectance[points], members, table.angles)

    def _library_table(self, paint: xr.Dataset, name: str) -> Table:
        # table of a library paint: bands by wavelength, NaN in bands that are not good
        nm, reflectance = _columns(paint["reflectance"])
        order = np.argsort(nm, kind="stable")
        is_good = np.asarray(paint["good"].values, bool) if "good" in paint.coords else np.ones(nm.size, bool)
        values = np.where(is_good, reflectance, np.nan)[order]
        members, angles, spread = None, (0.0, 0.0), 0.0
        if "member_reflectance" in paint:
            population = paint["member_reflectance"].transpose(MEMBER, BAND)
            rows = np.asarray(
                (convert(population, "1") if "units" in population.attrs else population).values
            )
            members = np.where(is_good, rows, np.nan)[:, order].astype(np.float64)
            members = members[np.isfinite(members).any(axis=1)]
            if len(members) > MAX_MEMBERS:  # keep evenly spaced members
                members = members[np.linspace(0, len(members) - 1, MAX_MEMBERS).round().astype(np.int64)]
            level = np.nansum(members, axis=1)
            spread = float(level.std() / max(level.mean(), _CROPPING.min_mean)) if level.size else 0.0
        if (
            set(paint.variables) >= _FLAKES
            and spread <= _CROPPING.max_spread
            and shows_flakes(paint["flop"].values[is_good], paint["aspecular_range"].values)
        ):
            # members at the angles of the measurement, from the dark to the bright end
            exponents = np.where(is_good, flake_exponents(paint["flop"].values), 0.0)[order]
            places = np.linspace(-0.5, 0.5, _ANGLES)[:, None]
            members = np.exp(places * exponents)
            if {"sun_zenith", "diffuse_fraction"} <= set(paint.variables):
                # the renderer adds the cosine of the sun on a part that leans by half of the angle
                lean = np.radians(places * float(paint["aspecular_range"]) / 2.0)
                direct = np.nan_to_num(1.0 - paint["diffuse_fraction"].values[order])
                members /= 1.0 + lean * direct * np.tan(np.radians(float(paint["sun_zenith"])))
            members = values * members / members.mean(axis=0)  # the signature is the mean of its part
            angles = float(paint["aspecular_angle"]), float(paint["aspecular_range"])
        if mirror_reflection(paint) == INCLUDED:
            self._mirroring.append(name)
        is_outside = (values < 0.0) | (values > 1.0)
        if is_outside.any() and bool((np.abs(values[is_outside] - 0.5) <= 0.5 + _NOISE).all()):
            self._clipped.append(name)
            values = np.clip(values, 0.0, 1.0)
        return Table(nm[order], values, members, angles)


def _columns(value: Any) -> tuple[Floats, Floats]:
    if hasattr(value, "dims"):
        if "wavelength" not in value.coords:
            raise ValueError("it has no coordinate 'wavelength'")
        axis = value["wavelength"]
        axis = convert(axis, "nm") if "units" in axis.attrs else axis
        values = convert(value, "1") if "units" in value.attrs else value
        return np.asarray(axis.values, np.float64), np.asarray(values.values, np.float64)
    wavelength, reflectance = value
    return np.asarray(wavelength, np.float64), np.asarray(reflectance, np.float64)


def _ranges_text(wavelength: Floats, is_missing: Bools) -> str:
    # wavelengths of missing values as text, with ranges of neighbours
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_missing, [False]]).astype(np.int8)))
    runs = [(wavelength[begin], wavelength[end - 1]) for begin, end in edges.reshape(-1, 2)]
    texts = [
        f"{first_nm:.1f}" if first_nm == last_nm else f"{first_nm:.1f} to {last_nm:.1f}"
        for first_nm, last_nm in runs
    ]
    return ", ".join(texts[: _CROPPING.max_ranges_shown]) + (
        ", ..." if len(texts) > _CROPPING.max_ranges_shown else ""
    )


def some_names(names: Iterable[str]) -> str:
    different = list(dict.fromkeys(names))
    return ", ".join(map(repr, different[:12])) + (", ..." if len(different) > 12 else "")


# --- spectra of all factors --------------------------------------------------------------------------------


# All factors of a scene as functions of wavelength
@dataclass(frozen=True, eq=False)
class FactorSpectra:
    names: tuple[str, ...]  # name of the spectrum of every factor
    # refractive index of the coat over every factor; None for bare surfaces and for flakes
    coats: tuple[float | None, ...]
    spectra: Mapping[str, Spectrum]  # spectra by name
    # multiplier of every factor, for paints with another share of flakes than was traced
    scales: tuple[float, ...]
    clip: bool = False  # limit reflectances to 0 to 1

    def __call__(self, wavelength: Floats) -> Floats:
        # Return the factors ``rho'`` at wavelengths [nm], shape (factor, wavelength).
        limits = (0.0, 1.0) if self.clip else (-np.inf, np.inf)
        keys = list(zip(self.names, self.coats, strict=True))
        rows = {
            (name, coat): measured_factor(
                np.broadcast_to(self.spectra[name](wavelength), wavelength.shape).clip(*limits), coat
            )
            for name, coat in dict.fromkeys(keys)
        }
        return np.asarray(np.stack([rows[key] for key in keys]) * np.asarray(self.scales)[:, None])


def factor_spectra(
    record: SceneRecord,
    bands: BandSet,
    paints: Mapping[str, Any] | xr.Dataset | None = None,
    spectra: Mapping[str, Any] | xr.Dataset | None = None,
    *,
    clip: bool = False,
    hold_edges: bool | None = None,
) -> FactorSpectra:
    # Return the spectra of all factors of a scene.
    #
    # ``record``: The scene without its geometry. ``bands``: Bands whose centres tabulated spectra must cover
    # to half a width. ``paints``, ``spectra``, ``clip``, ``hold_edges``: As for `relight`.
    #
    # Raises `SchemaError`: Names are unknown, values cannot be read, leave 0 to 1, or do not cover the bands;
    # all are listed.
    problems = Problems("the scene cannot be painted", SchemaError)
    library = by_name(spectra)
    targets: Any = {} if paints is None else paints
    if is_library(paints):
        library_paints = by_name(paints)
        library |= library_paints
        targets = assigned_paints(record, list(library_paints))
    paints = dict(targets)
    # Name of the spectrum, and scale, of every factor; new spectra are added to ``library``
    original = []
    for factor in record.factors:
        material = record.materials[factor.material]
        flakes = material.flakes
        name = material.transmittance if factor.through else material.spectrum
        if factor.flakes and flakes is not None:
            name = flakes.turned if factor.turned else flakes.spectrum
        original.append(name)
    assigned, scales = list(original), [1.0] * len(original)
    instances = [instance.name for instance in record.instances]
    materials = [material.name for material in record.materials]
    rank = {**dict.fromkeys(original, 0), **dict.fromkeys(materials, 1), **dict.fromkeys(instances, 2)}
    for key in paints:
        problems.add_if(
            key not in rank,
            f"paints[{key!r}] names no instance, material or spectrum of the scene",
            expected=f"a spectrum such as {some_names(original)}, or an instance such as "
            f"{some_names(instances)}",
            code="paint-target-unknown",
        )
    for key in sorted((key for key in paints if key in rank), key=rank.__getitem__):
        name = paints[key] if isinstance(paints[key], str) else key
        if not isinstance(paints[key], str):
            library[key] = paints[key]
        factor_numbers = (
            [number for number, spectrum in enumerate(original) if spectrum == key]
            if rank[key] == 0
            else [materials.index(key)]
            if rank[key] == 1
            else _paint_factor(record, instances.index(key), problems)
        )
        # a repainted base gets the flakes of its new paint; scales correct the flake shares in the weights
        for number in factor_numbers:
            assigned[number] = name
            base = record.factors[number].material
            traced_flakes = record.materials[base].flakes
            if record.factors[number].flakes or traced_flakes is None:
                continue
            if traced_flakes.share >= 1.0:
                problems.add(
                    f"{record.materials[base].name!r} has flakes only and cannot be repainted",
                    code="paint-all-flakes",
                )
                continue
            new_flakes = (
                paint_spec(name).flakes if (isinstance(paints[key], str) and is_paint(name)) else None
            )
            scales[number] = (1.0 - (new_flakes.share if new_flakes else 0.0)) / (1.0 - traced_flakes.share)
            for other_number, factor in enumerate(record.factors):
                if factor.material == base and factor.flakes:
                    scales[other_number] = new_flakes.share / traced_flakes.share if new_flakes else 0.0
                    if new_flakes is not None:
                        assigned[other_number] = (
                            new_flakes.turned if factor.turned else ""
                        ) or new_flakes.spectrum
    reader = SpectrumReader(library, bands, problems, clip=clip, hold_edges=hold_edges)
    spectra_or_none = {name: reader.read(name) for name in dict.fromkeys(assigned)}
    problems.raise_if_any()
    reader.warn()
    spectra_by_name = {name: spectrum for name, spectrum in spectra_or_none.items() if spectrum is not None}
    pairs = [(factor, record.materials[factor.material].coat) for factor in record.factors]
    coats = tuple(None if coat is None or factor.flakes else coat.index for factor, coat in pairs)
    return FactorSpectra(tuple(assigned), coats, spectra_by_name, tuple(scales), clip)


def assigned_paints(record: SceneRecord, names: Sequence[str]) -> dict[str, str]:
    """Return the assignment of library paints to spectra, materials and instances of a scene.

    A paint with the name of a spectrum, material or instance of the scene is assigned to it. Other paints are
    assigned in turn, in their order, to the remaining cars.

    Parameters
    ----------
    record
        The scene without its geometry.
    names
        Names of the paints.

    Raises
    ------
    SchemaError
        No paint can be assigned: none has a name of the scene, and the scene has no car.

    Examples
    --------
    >>> from .car_parks import car_park
    >>> record = SceneRecord.of(car_park(length=5.0, width=16.0, neighbours=(), seed=1))
    >>> [instance.paint for instance in record.instances if instance.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> assigned_paints(record, ["yellow", "roof 7"])
    {'yellow': 'yellow', 'car_000': 'roof 7', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    labels = [{material.name, material.spectrum} for material in record.materials]
    cars = {instance.name for instance in record.instances}
    by_name = {name: name for name in names if name in cars.union(*labels)}
    other_paints = [name for name in names if name not in by_name]
    other_cars = [
        instance.name
        for instance, members in zip(record.instances, record.members, strict=True)
        if instance.kind == "car"
        and not by_name.keys() & {instance.name}.union(*(labels[n] for n in members))
    ]
    if other_paints and not other_cars and not by_name:
        raise SchemaError(
            f"the scene has no car for {some_names(other_paints)}",
            mend=f"pass the materials to paint: paints={{{record.materials[0].name!r}: ...}}",
            code="car-missing",
        )
    return by_name | {
        car: other_paints[number % len(other_paints)] for number, car in enumerate(other_cars) if other_paints
    }


def _paint_factor(record: SceneRecord, instance: int, problems: Problems) -> list[int]:
    # the paint factor of an instance, in a list; an empty list after a problem
    members, name = record.members[instance], record.instances[instance].name
    candidates = [number for number in members if record.materials[number].kind == "paint"] or list(members)
    if len(candidates) != 1:
        names = some_names([record.materials[number].name for number in candidates])
        problems.add(
            f"paints[{name!r}]: {len(candidates)} materials to paint",
            mend=f"choose one of {names}",
            code="paint-target-ambiguous",
        )
        return []
    shared = [
        record.instances[other_instance].name
        for other_instance, numbers in enumerate(record.members)
        if other_instance != instance and candidates[0] in numbers
    ]
    if shared:
        material = record.materials[candidates[0]].name
        problems.add(
            f"paints[{name!r}]: {some_names(shared)} would change too",
            mend=f"use the material, {material!r}",
            code="paint-target-shared",
        )
        return []
    return candidates


# --- populations -------------------------------------------------------------------------------------------


# Members of all populations of a scene, in the form that mixing of paths needs.
class Populations(NamedTuple):
    grain: Grain
    factor: Array  # (row,) number of the factor that a member changes
    ratio: Floats32  # (row, band) member over mean

    def of_rows(self, rows: Array) -> Texture:
        # members of pixels, from their rows (line, column)
        return Texture(rows, self.factor, self.ratio, np.zeros((0, 1), np.int64))


def populations_of(record: SceneRecord, painted: FactorSpectra, bands: BandSet) -> Populations | None:
    # populations of a scene's materials; None if no spectrum has one.
    # The mean over the members of a population is the spectrum itself, in every band; of members by angle
    # the middle one.
    count = np.zeros((2, len(record.materials)), np.int64)
    members: list[tuple[Any, int, int, Floats]] = []
    for factor_number, (factor, name) in enumerate(zip(record.factors, painted.names, strict=True)):
        spectrum: Any = painted.spectra[name]
        if factor.flakes or factor.through or getattr(spectrum, "population", None) is None:
            continue
        rows = spectrum.population(bands.wavelength)
        if rows is not None:
            members.append((spectrum, factor.material, factor_number, rows))
    if not members:
        return None
    shape = len(record.materials), max(len(spectrum.octaves.lengths) for spectrum, *_ in members)
    lengths, shares, is_averaged = np.ones(shape), np.zeros(shape), np.zeros(shape[0], bool)
    angles = np.zeros((2, shape[0]))
    ratios, factors, first_row = [], [], 0
    for spectrum, material, factor_number, rows in members:
        octaves: Octaves = spectrum.octaves
        angles[:, material] = getattr(spectrum, "angles", 0.0)
        # members over their mean, darkest first
        mean = rows[len(rows) // 2] if angles[1, material] else rows.mean(axis=0)
        ratio = np.minimum(
            np.clip(rows, 0.0, 1.0) / np.maximum(mean, _CROPPING.min_mean), _CROPPING.max_ratio
        )
        if angles[1, material] == 0.0:
            # clipping to 0 and 1 must not change the mean
            ratio /= np.maximum(ratio.mean(axis=0), _CROPPING.min_mean)
            ratio = ratio[np.argsort(rows.mean(axis=1), kind="stable")]
        ratios.append(ratio)
        factors.append(np.full(len(rows), factor_number, np.int64))
        count[:, material] = first_row, len(rows)
        first_row += len(rows)
        lengths[material, : len(octaves.lengths)] = octaves.lengths
        shares[material, : len(octaves.shares)] = octaves.shares
        is_averaged[material] = octaves.is_averaged
    grain = Grain(count[0], count[1], lengths, shares, is_averaged, *angles)
    return Populations(grain, np.concatenate(factors), np.concatenate(ratios).astype(np.float32))


# --- relighting --------------------------------------------------------------------------------------------

_PATHS = ("transport_weight", "transport_path", "distance")

#: Layers of the traced dataset that no light changes.
_UNLIT_LAYERS = (
    "material",
    "instance",
    "surface_class",
    "car_id",
    "purity",
    "distance",
    "east",
    "north",
    "up",
)

_COVERED = 1.5  # full widths around the bands' centres that an atmosphere must cover

#: Layers with the shares of light in a pixel by source.
SHARES = ("sun_share", "sky_share", "glint_share", "mirrored_sky_share", "indirect_share")

_RECORD = SimpleNamespace(
    max_sun_angle_deg=0.01,  # between the sun of an atmosphere and the traced sun
    grid_step_nm=0.05,
    max_times=2000,
)
_MAX_CACHE_BYTES = 96 * 2**20  # maximum size of cached products; others are computed whenever needed

_FWHM_NM, _STEP_NM = 3.0, 1.0  # of the irradiance spectrometer
_REACH = 3.3  # extent of its line shape [full widths]
_MARGIN = np.timedelta64(10**9, "ns")  # record before the first and after the last line


def relight(
    traced: xr.Dataset,
    bands: Any = None,
    *,
    paints: Mapping[str, Any] | xr.Dataset | None = None,
    atmosphere: Atmosphere | str = "noon",
    spectra: Mapping[str, Any] | xr.Dataset | None = None,
    variation: ArrayLike | BrokenClouds | None = None,
    truth: bool = True,
    clip: bool = False,
    hold_edges: bool | None = None,
    population: bool = True,
) -> xr.Dataset:
    r"""Return the radiance of a traced scene under an atmosphere in the bands of a camera.

    Parameters
    ----------
    traced
        Dataset from `hyperpaint.simulation.trace`, or read from its store.
    bands
        A `BandSet`, an imager of the simulator, or a Dataset with ``wavelength`` and ``fwhm`` (attribute
        ``srf_shape``); by default the 272 bands of a Nano-Hyperspec.
    paints
        New spectra by name of an instance ("car_007": its paint), of a material, or of a spectrum of the
        scene's materials, in this order of precedence. A value is the name of a spectrum, ``(wavelength
        [nm], reflectance)``, a DataArray with a coordinate ``wavelength``, or a function of wavelength [nm].
        Reflectances are near normal, without the specular component. A car traced with flakes gets the flake
        share of the named paint, and no flakes from a measured spectrum; a car traced without flakes gets
        none. A paint library instead of a mapping: its paints replace the spectrum, material or instance of
        their name, and the other paints are assigned in turn to the remaining cars.
    atmosphere
        The light; or the name of a preset one: "noon", "near_sunset", "cloudy".
    spectra
        Further spectra by name, as values of ``paints`` or as a paint library; they replace built-in spectra
        of the same name. A library of one paint as a value has its key as name; of several paints each is
        named ``key/paint``.
    variation
        Factors of direct and of diffuse light in every line, shape (2, along_track), for a cloud that passes
        during the flight; or `BrokenClouds`, whose shadows move over the scene. Light from neighbouring
        surfaces has the factors of the pixel that it reaches.
    truth
        Add ``reflectance`` and the layers with the shares of light by source.
    clip
        Limit reflectances to 0 to 1 instead of an error.
    hold_edges
        Hold tabulated spectra constant beyond their ends and their last bands with values, and interpolate
        bands without values, or not ``good``, linearly, instead of an error. By default spectra are held over
        at most 25 nm, with a warning; False refuses this, too.
    population
        Show in every pixel a member of the population of its paint, if a library has
        ``member_reflectance``; False shows the mean.

    Returns
    -------
    Dataset
        Lazy; a flight line on which ``.paint.reflectance()`` runs. ``radiance`` (along_track, band,
        cross_track) at the sensor; the layers ``material``, ``instance``, ``surface_class``, ``paint_id``,
        ``car_id``, ``purity``, ``distance``, ``east``, ``north``, ``up``; ``irradiance`` as a spectrometer of
        3 nm beside the scene records it. With ``truth``: ``reflectance``, of the surfaces themselves, before
        the air between; ``sun_share``, ``sky_share``, ``glint_share``, ``mirrored_sky_share``,
        ``indirect_share`` of the mean radiance over all bands, before the air between; ``shadow``.

    Raises
    ------
    SchemaError
        The dataset is no traced one; the atmosphere's sun (to 0.01 degrees) or its overcast sky was not
        traced, or it does not cover the bands; names are unknown, spectra leave 0 to 1 or do not cover the
        bands; ``variation`` has another shape. All problems of a kind are listed.

    Warns
    -----
    PaintWarning
        Paints of a library exceed 0 to 1 by noise and are clipped; spectra are held at the ends of the
        bands; or a library contains the mirror reflection of coats, which the renderer adds again.

    Notes
    -----
    Of a band of response R,

    .. math:: L = e^{-k d} \sum_p w_p \frac{\int R E_{s(p)} \prod_f \rho'_f\, d\lambda}{\pi \int R\, d\lambda}
              + L_p d, \qquad \rho = \frac{\pi L_{d=0}}{\int R E\, d\lambda / \int R\, d\lambda}

    The integrals are exact to 1e-5 for all absorption lines of the light; they are computed once for every
    code. k and L_p are means over the band.

    A random field over the dominant surface of a pixel selects its member. The field varies over 20, 5 and
    1.25 cm, each with a third of the variance: pixels of any size have the spread of the members, and
    neighbours are similar. Light from other surfaces has their mean spectra. The mean over all members is
    the reflectance of the library. The member depends only on seed, position and instance.

    A measured paint with flakes (``flop``, ``aspecular_angle`` and ``aspecular_range`` of the library) has
    the reflectance of the angle at which a pixel is lit instead: between the view from above and the
    mirrored sun, from the pixel's incidence. Beyond the measured angles it is held; in shade and without
    direct sunlight a pixel shows the library's reflectance.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.platforms import pushbroom
    >>> from hyperpaint.simulation.rendering.scene import plane
    >>> traced = trace(plane(100.0), pushbroom(64, 8), ["noon"], samples=4)
    >>> line = relight(traced, atmosphere="noon")
    >>> line.radiance.dims, line.radiance.dtype, line.radiance.attrs["units"]
    (('along_track', 'band', 'cross_track'), dtype('float32'), 'W m-2 sr-1 nm-1')
    """
    record, settings = SceneRecord.from_attrs(traced.attrs)
    variables = require(traced, _PATHS, "radiance from traced paths")
    sky = preset_atmosphere(atmosphere) if isinstance(atmosphere, str) else atmosphere
    SchemaError.raise_if(
        not isinstance(sky, Atmosphere),
        f"atmosphere is {type(sky).__name__}",
        expected="an Atmosphere or the name of a preset",
        code="type-wrong",
    )
    camera = BandSet.of(bands)
    lines, columns = (variables["distance"].sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK))
    with Problems("the traced scene cannot be relit", SchemaError) as problems:
        min_nm = camera.wavelength[0] + camera.nodes.min() - _COVERED * camera.fwhm[0]
        max_nm = camera.wavelength[-1] + camera.nodes.max() + _COVERED * camera.fwhm[-1]
        first_nm, last_nm = sky.wavelength[[0, -1]]
        problems.add_if(
            first_nm > min_nm or last_nm < max_nm,
            f"atmosphere {sky.name!r} covers {first_nm:.1f} to {last_nm:.1f} nm",
            expected=f"the range of the bands and their wings, {min_nm:.1f} to {max_nm:.1f} nm",
            code="atmosphere-coverage",
        )
        if camera.wavelength_shift is not None and camera.wavelength_shift.size != columns:
            problems.add(
                f"wavelength_shift has {camera.wavelength_shift.size} columns",
                expected=f"{columns}, as the traced scene",
                code="length-mismatch",
            )
    if variation is not None and not isinstance(variation, BrokenClouds):
        variation = np.ascontiguousarray(variation, np.float64)
        SchemaError.raise_if(
            variation.shape != (2, lines),
            f"variation has shape {variation.shape}",
            expected=f"(2, along_track) = (2, {lines})",
            code="dims-wrong",
        )
        SchemaError.raise_if(
            not np.isfinite(variation).all() or (variation < 0).any(),
            "variation has factors that are negative or not finite",
            code="value-out-of-range",
        )
    painted = factor_spectra(record, camera, paints, spectra, clip=clip, hold_edges=hold_edges)
    sun = traced_sun(sky, settings)
    # light and camera are a node of the dask graph, shared by all tasks
    shared = (camera, record.codes(settings), sky, settings, painted(BandResponses(camera).grid))
    light = dask.delayed(make_lighting, pure=True)(*shared)
    populations = populations_of(record, painted, camera) if population else None
    # direct sunlight of pixels, which the angle of a paint with flakes needs
    incidence = xr.full_like(traced["material"], np.nan, np.float32)
    if "sun_incidence" in traced.variables and sky.sun.any():
        lit = traced[["sun_incidence", "sun_visibility"]].isel({SUN: sun}, drop=True)
        incidence = lit["sun_incidence"].where(lit["sun_visibility"] > 0.5)
    placed = traced.assign(incidence=incidence)
    rows = {"sun_zenith": settings.suns[sun][0], "seed": settings.seed}
    cubes = _lazy_cubes(placed, light, camera, variation, populations, rows, truth=truth)
    names = [""] * len(record.materials)  # spectra of the bases
    for factor, name in zip(record.factors, painted.names, strict=True):
        if not (factor.flakes or factor.through):
            names[factor.material] = name
    line = _dataset(cubes, traced, camera, record.labels(names)["paint_id"])
    if truth and "sun_visibility" in traced.variables:
        line["shadow"] = label(
            (1.0 - traced["sun_visibility"].isel({SUN: sun}, drop=True)).astype(np.float32), "shadow"
        )
    # ``irradiance`` and related variables of a spectrometer beside the scene, for the wavelengths of the
    # bands, from before until after the flight. With light that varies between lines, (2, line), the record
    # is lazy.
    # wavelengths of the channels [nm]
    wavelength, reach = sky.wavelength, _REACH * _FWHM_NM
    lower_nm = max(wavelength[0], camera.limits[0] - 4 * _FWHM_NM)
    upper_nm = min(wavelength[-1], camera.limits[1] + 4 * _FWHM_NM)
    centres = np.arange(np.ceil(lower_nm / _STEP_NM), np.floor(upper_nm / _STEP_NM) + 1) * _STEP_NM
    # at the ends of the spectra a channel uses the available part of its line shape
    grid_start, grid_end = max(wavelength[0], centres[0] - reach), min(wavelength[-1], centres[-1] + reach)
    grid = (
        np.arange(np.ceil(grid_start / _RECORD.grid_step_nm), np.floor(grid_end / _RECORD.grid_step_nm) + 1)
        * _RECORD.grid_step_nm
    )
    # direct and diffuse irradiance, (2, channel)
    direct = sky.sun * float(np.cos(np.radians(settings.suns[sun][0])))
    curves = np.stack([cell_means(wavelength, curve, grid) for curve in (direct, sky.sky)])
    channel_spectra = convolve_gaussian(curves, grid, centres, _FWHM_NM)
    # times before and after the flight; with varying light also times during the flight
    with SchemaError.instead_of(
        (KeyError, ValueError, TypeError),
        "not a traced dataset: time_coverage_start or _end: $whole",
        mend="pass a dataset from hyperpaint.simulation.trace",
        code="metadata-damaged",
    ):
        start, end = (np.datetime64(traced.attrs[f"time_coverage_{name}"], "ns") for name in ("start", "end"))
    count = 0 if variation is None or not lines else min(max(lines, 2), _RECORD.max_times)
    span = int(np.asarray(end - start, "timedelta64[ns]").astype(np.int64))
    during = start + np.unique(np.linspace(0, span, count).astype(np.int64)).astype("timedelta64[ns]")
    times = np.concatenate([[start - _MARGIN], during, [end + _MARGIN]]).astype("datetime64[ns]")
    values: Any = np.broadcast_to(channel_spectra.sum(axis=0), (times.size, centres.size)).astype(np.float32)
    if isinstance(variation, BrokenClouds):
        seconds = (times - (times[0] + _MARGIN)) / np.timedelta64(1, "s")
        values = (variation.factors(*variation.station, seconds).T @ channel_spectra).astype(np.float32)
    elif variation is not None:
        lazy_values = dask.delayed(_irradiance_at_times, pure=True)(
            traced["time"].data, times, variation, channel_spectra
        )
        values = da.from_delayed(lazy_values, (times.size, centres.size), dtype=dtype_of("irradiance"))
    arrays = {
        "irradiance": ((IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), values),
        "irradiance_fwhm": ((), np.float64(_FWHM_NM)),
        "irradiance_max_gap": ((), np.float64(2.5 * (np.diff(times).max() / np.timedelta64(1, "s")))),
        "irradiance_clock_uncertainty": ((), np.float64(0.0)),
        IRRADIANCE_TIME: (IRRADIANCE_TIME, times),
        IRRADIANCE_WAVELENGTH: (IRRADIANCE_WAVELENGTH, centres),
    }
    labelled = {name: (*value, VARIABLES[name].attrs) for name, value in arrays.items()}
    coords = {name: labelled.pop(name) for name in (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH)}
    attrs = {
        "hyperpaint_format": FORMAT_VERSION,
        "name": str(traced.attrs.get("name", record.name)),
        "atmosphere": sky.name,
        "materials": traced.attrs["materials"],
        "instances": traced.attrs["instances"],
        "srf_shape": camera.shape,
        "irradiance_srf_shape": "gaussian",
    }
    return line.assign_coords(coords).assign(labelled).assign_attrs(attrs)


def _whole_lines(array: xr.DataArray) -> da.Array:
    if array.chunks is None:
        array = array.chunk({ALONG_TRACK: CHUNK_LINES})
    split = [dim for dim in (SLOT, CROSS_TRACK) if len(array.variable.chunksizes.get(dim, (0,))) > 1]
    return cast("da.Array", array.chunk(dict.fromkeys(split, -1)).data if split else array.data)


_PIXEL_LAYERS = ("material", "instance", "east", "north", "up", "incidence")


def _lazy_cubes(
    traced: xr.Dataset,
    light: Any,
    bands: BandSet,
    variation: Floats | BrokenClouds | None,
    populations: Populations | None,
    chosen: Mapping[str, float],
    *,
    truth: bool,
) -> dict[str, da.Array]:
    # lazy radiance, reflectance and shares; without truth a block of radiance is a single task
    weight, code, distance = (_whole_lines(traced[name]) for name in _PATHS)
    line_chunks = weight.chunks[0]
    varied: tuple[Any, Any] = (None, None)
    if isinstance(variation, BrokenClouds):
        east, north = (_whole_lines(traced[name]).rechunk({0: line_chunks}) for name in ("east", "north"))
        first = np.datetime64(traced.attrs["time_coverage_start"], "ns")
        seconds = da.asarray((traced["time"].data - first) / np.timedelta64(1, "s"))
        places = (east, "lx", north, "lx", seconds.rechunk((line_chunks,))[:, None], "lx")
        factors = da.blockwise(
            BrokenClouds.factors, "vlx", variation, None, *places, new_axes={"v": 2}, dtype=np.float64,
            meta=np.empty((0, 0, 0)),
        )  # fmt: skip
        varied = factors, "vlx"
    elif variation is not None:
        varied = da.from_array(variation, chunks=(-1, line_chunks)), "vl"
    lit = (weight, "lsx", code, "lsx", *varied)
    textured: tuple[Any, ...] = (*lit, None, None, None, None)
    if populations is not None:
        # population member of every pixel as row of a table, and the table
        layers = [_whole_lines(traced[name].reset_coords(drop=True)) for name in _PIXEL_LAYERS]
        inputs = [part for layer in layers for part in (layer, "lx")]
        rows = da.blockwise(
            member_rows,
            "lx",
            *inputs,
            grain=populations.grain,
            **chosen,
            meta=np.empty((0, 0), np.int32),
            dtype=np.int32,
        )
        textured = (*lit, rows, "lx", dask.delayed(populations, pure=True, traverse=False), None)

    def cube(method: Callable[..., Array], dims: str, *arguments: Any, **axes: int) -> da.Array:
        return da.blockwise(
            method, dims, light, None, *arguments, new_axes=axes, concatenate=True, dtype=np.float32,
            meta=np.empty((0, 0, 0), np.float32),
        )  # fmt: skip

    count = bands.wavelength.size
    if not truth:
        return {"radiance": cube(Lighting.radiance, "lbx", *textured, distance, "lx", b=count)}
    surface = cube(Lighting.radiance, "lbx", *textured, b=count)
    shares = cube(Lighting.shares, "lcx", *lit, c=len(SHARES))
    return {
        "radiance": cube(Lighting.at_sensor, "lbx", surface, "lbx", distance, "lx"),
        "reflectance": cube(Lighting.reflectance, "lbx", surface, "lbx", *varied),
        **{name: shares[:, index] for index, name in enumerate(SHARES)},
    }


def _dataset(
    cubes: dict[str, da.Array], traced: xr.Dataset, bands: BandSet, paints: LabelTable
) -> xr.Dataset:
    variables = {
        name: (CUBE if array.ndim == 3 else (ALONG_TRACK, CROSS_TRACK), array, VARIABLES[name].attrs)
        for name, array in cubes.items()
    }
    coords: dict[str, Any] = {
        "wavelength": (BAND, bands.wavelength),
        "fwhm": (BAND, bands.fwhm),
        "good": (BAND, np.ones(bands.wavelength.size, bool)),
    }
    if bands.wavelength_shift is not None:
        coords["wavelength_shift"] = (CROSS_TRACK, bands.wavelength_shift)
    line = xr.Dataset(variables, {n: (*value, VARIABLES[n].attrs) for n, value in coords.items()})
    if "time" in traced.variables:
        line = line.assign_coords(time=traced["time"].variable)
    line = line.assign({name: traced[name].variable for name in _UNLIT_LAYERS if name in traced.variables})
    if "material" in traced.variables:
        paint_id = xr.apply_ufunc(
            paints.table.__getitem__,
            traced["material"].reset_coords(drop=True),
            dask="parallelized",
            output_dtypes=[dtype_of("paint_id")],
            keep_attrs=True,
        )
        line["paint_id"] = label(paint_id, "paint_id", **paints.attrs)
    return line


def _irradiance_at_times(line_times: Any, times: Any, variation: Floats, spectra: Floats) -> Floats32:
    line_ns = np.asarray(line_times).astype("datetime64[ns]").astype(np.int64)
    order = np.argsort(line_ns, kind="stable")
    relative_ns = times.astype(np.int64) - line_ns[order[0]]
    factors = np.stack(
        [np.interp(relative_ns, line_ns[order] - line_ns[order[0]], factor[order]) for factor in variation]
    )
    return (factors.T @ spectra).astype(np.float32)


def traced_sun(atmosphere: Atmosphere, settings: TraceSettings) -> int:
    # Return the number of the traced sun of an atmosphere; without direct light, of the nearest sun.
    #
    # Raises `SchemaError`: The sun of the atmosphere, or its overcast or clear sky, was not traced.
    towards = sun_vectors([(atmosphere.sun_zenith, atmosphere.sun_azimuth)])
    angles = np.degrees(
        2 * np.arcsin(np.linalg.norm(sun_vectors(settings.suns) - towards, axis=1).clip(0, 2) / 2)
    )
    nearest = int(angles.argmin())
    has_clear_sky = bool((atmosphere.sky * atmosphere.clear_shares).any())
    traced_directions = ", ".join(f"({zenith:g}, {azimuth:g})" for zenith, azimuth in settings.suns)
    SchemaError.raise_if(
        angles[nearest] > _RECORD.max_sun_angle_deg and (atmosphere.sun.any() or has_clear_sky),
        f"atmosphere {atmosphere.name!r} has its sun at (zenith, azimuth) = "
        f"({atmosphere.sun_zenith:g}, {atmosphere.sun_azimuth:g}) degrees",
        expected=f"a traced sun: {traced_directions}",
        mend="trace the scene with this sun as well",
        code="sun-not-traced",
    )
    SchemaError.raise_if(
        atmosphere.overcast_share > 0 and atmosphere.sky.any() and not settings.overcast,
        f"atmosphere {atmosphere.name!r} has an overcast share of {atmosphere.overcast_share:.3g}, "
        "but no overcast sky was traced",
        mend="trace the scene with overcast=True",
        code="sky-not-traced",
    )
    SchemaError.raise_if(
        has_clear_sky and not settings.clear,
        f"atmosphere {atmosphere.name!r} has a clear sky, but no clear sky was traced",
        mend="trace the scene with clear=True",
        code="sky-not-traced",
    )
    return nearest


def source_spectra(atmosphere: Atmosphere, settings: TraceSettings) -> dict[int, Floats]:
    # irradiance of every traced source that shines, by number, on the atmosphere's grid
    sun = traced_sun(atmosphere, settings)
    first_function = FIRST_CLEAR_SKY + CLEAR_SKY_FUNCTIONS * sun
    shares = {
        SKY: atmosphere.uniform,
        OVERCAST_SKY: np.asarray(atmosphere.overcast_share),
        **{first_function + number: share for number, share in enumerate(atmosphere.clear_shares)},
    }
    skies = {number: atmosphere.sky * share for number, share in shares.items() if share.any()}
    return {**skies, FIRST_SUN + sun: atmosphere.sun}


# Light and camera, shared by all tasks of a relighting
@dataclass(frozen=True, eq=False)
class Lighting:
    table: "ProductTable"  # products of paths
    # direct, diffuse: (band, cross_track or 1): irradiance of a level surface in the bands [W m-2 nm-1]
    direct: Floats
    diffuse: Floats
    # extinction, path_radiance: (band, cross_track or 1), float32: properties of the air before the camera
    # [m-1], [W m-2 sr-1 nm-1 m-1]
    extinction: Floats32
    path_radiance: Floats32

    def radiance(
        self,
        weight: Floats32,
        code: Array,
        variation: Floats | None,
        rows: Array | None = None,
        populations: Populations | None = None,
        distance: Floats32 | None = None,
    ) -> Floats32:
        # radiance towards the camera, (line, band, column) [W m-2 sr-1 nm-1]: at the surface, or after a
        # distance of air
        # weight, code : (line, slot, column): paths as traced
        # variation : (2, line) or (2, line, column): factors of direct and diffuse light; None for factors of
        # 1
        # rows : (line, column): members of ``populations`` shown by pixels
        # populations: None for the means
        # distance: (line, column) [m]
        lines, _, columns = weight.shape
        radiance = np.empty((lines, self.table.bands.wavelength.size, columns), np.float32)
        texture = None if populations is None or rows is None else populations.of_rows(rows)
        self.table.mix(_varied(weight, code, variation), code, radiance, texture)
        return radiance if distance is None else self.at_sensor(radiance, distance, in_place=True)

    def at_sensor(self, surface: Floats32, distance: Floats32, *, in_place: bool = False) -> Floats32:
        # L exp(-k d) + Lp d, the radiance after a distance d of air; NaN distances have no air
        if not (self.extinction.any() or self.path_radiance.any()):
            return surface
        out = surface if in_place else np.empty_like(surface)
        through_air(surface, self.extinction, self.path_radiance, distance, out)
        return out

    def reflectance(self, surface: Floats32, variation: Floats | None) -> Floats32:
        # pi L / E of the radiance at the surface [1]; NaN without light
        factor = np.empty_like(surface)
        for line, (direct, diffuse) in enumerate(
            zip(*(np.ones((2, len(surface))) if variation is None else variation), strict=True)
        ):
            light = self.direct * direct + self.diffuse * diffuse
            scale = np.divide(np.pi, light, out=np.full_like(light, np.nan), where=light > 0)
            np.multiply(surface[line], scale.astype(np.float32), out=factor[line])
        return factor

    def shares(self, weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
        # shares of light by source, (line, share, column); see `SHARES`
        distinct, index = index_paths(code)
        level = self.table.rows(distinct)[int(np.abs(self.table.bands.nodes).argmin())].mean(
            axis=1, dtype=np.float64
        )
        # weight of every path in the total light, and in the layers of `SHARES`
        sun, mirrored, indirect = is_direct(distinct), is_mirrored(distinct), is_indirect(distinct)
        mirror_image = mirrored & ~indirect
        all_paths = np.ones(distinct.shape, bool)
        members = [all_paths, sun, ~sun, mirror_image & sun, mirror_image & ~sun, indirect]
        terms = np.stack(
            [np.where(is_member, level.astype(np.float32), 0.0) for is_member in members], axis=1
        )
        sums = np.empty((len(weight), terms.shape[1], weight.shape[2]), np.float32)
        mix(_varied(weight, code, variation), index, terms.astype(np.float32), sums)
        total = sums[:, :1]
        return np.divide(sums[:, 1:], total, out=np.full_like(sums[:, 1:], np.nan), where=total > 0)


def _varied(weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
    return (
        weight
        if variation is None
        else np.asarray(
            weight * np.where(is_direct(code), *variation.astype(np.float32).reshape(2, len(weight), 1, -1))
        )
    )


def make_lighting(
    bands: BandSet, codes: PathCodes, atmosphere: Atmosphere, settings: TraceSettings, factors: Floats
) -> Lighting:
    # light, spectra and camera of a relighting.
    # ``factors`` (factor, grid): spectra of all factors of paths, on the grid of `BandResponses`.
    wavelength, sources = atmosphere.wavelength, source_spectra(atmosphere, settings)
    sun_cosine = float(np.cos(np.radians(settings.suns[traced_sun(atmosphere, settings)][0])))
    table = ProductTable(bands, codes, wavelength, sources, lambda _grid: factors)
    responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])))
    curves = atmosphere.extinction, atmosphere.path_radiance
    air = np.stack([cell_means(wavelength, curve, responses.fine) for curve in curves])
    extinction, path = table.to_columns(responses.means(air)).astype(np.float32)
    light = {number: table.to_columns(table.irradiance(number)) for number in sources}
    suns = [number for number in light if is_direct(np.array(number))]
    direct = sum((light[number] for number in suns), np.zeros(1)) * sun_cosine
    diffuse = sum((light[number] for number in light if number not in suns), np.zeros(1))
    return Lighting(table, np.asarray(direct), np.asarray(diffuse), extinction, path)


class ProductTable:
    """Band spectra of path codes, computed when first needed.

    Products are means over the responses [W m-2 sr-1 nm-1]. With ``normalise=False`` they are integrals INT L
    R d lambda [W m-2 sr-1 count J-1] for a detector; the caller multiplies the sum over paths by the element
    factors (`Imager.element_factor`) to get the input of `simulation.camera.expected_counts`.

    Threads share a table; of products that several add at the same time, those of one may be lost. It can be
    sent to other processes, where it starts empty. Products do not depend on earlier or simultaneous
    requests.

    Parameters
    ----------
    bands
        Bands of the camera.
    codes
        Layout of the path codes.
    wavelength : (point,)
        Wavelengths of the sources, increasing [nm]; responses are cut to this range.
    sources
        Irradiance by number of the source, shape (point,) [W m-2 nm-1]: direct normal for a sun, diffuse on a
        level surface for a sky. Missing sources are dark.
    factors
        Function that returns all factors at wavelengths [nm], shape (factor, wavelength); see
        `factor_spectra`.
    normalise
        See `BandResponses`.

    Examples
    --------
    A grey panel of reflectance 0.4 under a sun of 1.3 W m-2 nm-1; its path has source 2 and factor 0.

    >>> light = np.array([300.0, 1100.0]), {2: np.array([1.3, 1.3])}
    >>> codes, bands = PathCodes.of(factors=1, depth=4), BandSet.nano_hyperspec()
    >>> table = ProductTable(bands, codes, *light, lambda grid: np.full((1, grid.size), 0.4))
    >>> rows = table.rows(np.array([2 + (1 << 7)]))
    >>> rows.shape, rows.dtype, round(float(rows[0, 0, 0]), 6)  # (node, path, band), 0.4 x 1.3 / pi
    ((1, 1, 272), dtype('float32'), 0.165521)
    """

    def __init__(
        self,
        bands: BandSet,
        codes: PathCodes,
        wavelength: Floats,
        sources: Mapping[int, Floats],
        factors: Callable[[Floats], Floats],
        *,
        normalise: bool = True,
    ) -> None:
        self.bands, self.codes = bands, codes
        responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])), normalise=normalise)
        means = {
            number: cell_means(wavelength, np.asarray(spectrum, np.float64), responses.fine)
            for number, spectrum in sources.items()
        }
        lit = {number: spectrum for number, spectrum in means.items() if spectrum.any()}
        self._row_of_source = np.full(SOURCES, -1, np.int64)
        self._row_of_source[list(lit)] = np.arange(len(lit))
        spectra = np.stack([*lit.values()]) if lit else np.zeros((1, responses.fine.size))
        self._weights = responses.weights(spectra) / np.pi
        self._first_band = responses.first_band
        self._factors = np.ascontiguousarray(factors(responses.grid), np.float64)
        # codes, ascending, and their products (path, node, band); replaced as a whole, never changed
        no_products = np.empty((0, bands.nodes.size, bands.wavelength.size), np.float32)
        self._cache: tuple[Ints, Floats32] = np.empty(0, np.int64), no_products

    def __getstate__(self) -> dict[str, Any]:
        codes, products = self._cache
        return {**self.__dict__, "_cache": (codes[:0], products[:0])}

    def rows(self, codes: Ints) -> Floats32:
        # Return the products of paths, shape (node, path, band), float32.
        #
        # ``codes`` (path,): Distinct codes, without empty slots.
        #
        # Raises `SchemaError`: A code names a factor that the scene does not have.
        codes = np.ascontiguousarray(codes, np.int64)
        cached_codes, products = self._cache
        rows = _lookup(cached_codes, codes)
        is_new = rows < 0
        if not is_new.any():
            return np.ascontiguousarray(products[rows].swapaxes(0, 1))
        # products of codes that are not cached
        new_codes = codes[is_new]
        computed = np.empty((self.bands.nodes.size, new_codes.size, self.bands.wavelength.size), np.float32)
        chosen, source = self.codes.factors(new_codes), self._row_of_source[source_of(new_codes)]
        SchemaError.raise_if(
            chosen.max(initial=-1) >= len(self._factors),
            f"a path code names spectrum {chosen.max()}",
            expected=f"a number below {len(self._factors)}, the spectra of the scene",
            mend="trace the scene again: transport_path is damaged, or belongs to another scene",
            code="path-code-unknown",
        )
        integrate_bands(self._factors, chosen, source, self._weights, self._first_band, computed)
        new_products = computed.swapaxes(0, 1)
        gathered = np.empty((codes.size, *new_products.shape[1:]), np.float32)
        gathered[~is_new], gathered[is_new] = products[rows[~is_new]], new_products
        cached_codes, products = self._cache
        if products.nbytes + new_products.nbytes <= _MAX_CACHE_BYTES:
            added = _lookup(cached_codes, new_codes) < 0  # another thread may have added some
            all_codes = np.concatenate([cached_codes, new_codes[added]])
            order = np.argsort(all_codes)
            self._cache = all_codes[order], np.concatenate([products, new_products[added]])[order]
        return np.ascontiguousarray(gathered.swapaxes(0, 1))

    def to_columns(self, at_nodes: Floats) -> Floats:
        # interpolate values at nodes (..., node, band) to columns, (..., band, cross_track or 1)
        first, weight = self.bands.between_nodes(1)
        terms = (at_nodes[..., first + j, :] * weight[:, j, None] for j in range(weight.shape[1]))
        return np.moveaxis(np.asarray(sum(terms)), -2, -1)

    def mix(
        self,
        weight: Floats32,
        codes: Ints,
        out: Floats32,
        texture: Texture | None = None,
    ) -> None:
        # write the sum of weight x product over the paths of every pixel, with the smile of the columns
        # weight, codes : (line, slot, column): paths as traced; empty slots add nothing
        # out : (line, band, column): result, in the units of the table
        # texture: members of populations shown by pixels; None for the means
        distinct, index = index_paths(codes)
        lit = self._row_of_source[source_of(distinct)] >= 0
        if not lit.all():  # skip paths from dark sources
            new_index = np.append(np.where(lit, np.cumsum(lit) - 1, -1), -1).astype(np.int32)
            distinct, index = distinct[lit], new_index[index]
        products = self.rows(distinct)
        nodes = self.bands.between_nodes(out.shape[2])
        if texture is not None:
            texture = texture._replace(paths=self.codes.factors(distinct))
        mix_shifted(weight, index, products, *nodes, out, texture)

    def irradiance(self, source: int) -> Floats:
        # Irradiance of a source in the bands, shape (node, band).
        return np.pi * self.rows(np.array([source], np.int64))[:, 0].astype(np.float64)


def _lookup(sorted_codes: Ints, codes: Ints) -> Ints:
    # -1 for codes that are not in the array.
    if not sorted_codes.size:
        return np.full(codes.shape, -1, np.int64)
    index = np.searchsorted(sorted_codes, codes).clip(max=sorted_codes.size - 1)
    return np.where(sorted_codes[index] == codes, index, -1)
