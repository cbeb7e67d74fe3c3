"""Tracing: the weights of the paths of light through a scene, lazily, in blocks of lines.

Tracing needs no spectra; `relighting` applies them. The random numbers of a pixel depend only on the seed and
its position in the flight line, so that results have the same bits for all blocks, threads and machines.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr
from numcodecs.blosc import SHUFFLE, Blosc

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.base.schema import (
    ALONG_TRACK,
    CHUNK_LINES,
    CROSS_TRACK,
    FORMAT_VERSION,
    SLOT,
    SUN,
    VARIABLES,
    dtype_of,
    label,
)
from hyperpaint.base.units import takes_quantities
from hyperpaint.light.sky_functions import function_shapes
from hyperpaint.simulation.transport.hierarchy import Geometry, build_geometry
from hyperpaint.simulation.transport.path_codes import PathCodes
from hyperpaint.simulation.transport.paths import Block, Rays, Settings, Sources, trace_lines
from hyperpaint.simulation.transport.surfaces import Surfaces, surfaces_of

from .four_curves import Atmosphere, preset_atmosphere
from .platforms import Platform
from .scene import Scene
from .scene_record import LabelTable, SceneRecord, TraceSettings, label_layers, sun_vectors

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
        sources = sources._replace(shapes=np.stack([function_shapes(zenith) for zenith, _ in settings.suns]))
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
    return _trace_rays(prepared, platform.origin[here], platform.rotation[here], edges, start)


def _trace_rays(
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
    {'along_track': 64, 'slot': 24, 'cross_track': 8, 'sun': 1}
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
    if isinstance(chunk_lines, bool) or not isinstance(chunk_lines, int) or chunk_lines < 1:
        raise SchemaError(
            f"chunk_lines={chunk_lines!r}", expected="a whole number above 0", code="value-out-of-range"
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
    layout = {name: (dims, dtype_of(name)) for name, dims in _LAYOUT.items()}
    arrays = split_outputs(blocks, "l", layout, sizes)
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
    different = [sun for place, sun in enumerate(directions) if sun not in directions[:place]]
    return different, any(light.overcast_share > 0 for light in named)


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
    block = _trace_rays(prepared, poses["origin"], poses["rotation"], edges, int(poses["line"][0]))
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
