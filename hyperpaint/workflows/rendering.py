"""Rendering of a ``scene.toml``: scene, flight, camera and light.

The tables of the file, each key with its unit in its name; `EXAMPLE` shows them all (``hyperpaint render
--example``):

``[scene]``
    ``kind``: "car_park" (arguments of `hyperpaint.simulation.rendering.car_parks.car_park`), "plane"
    (``size_m``, ``spectrum``) or "empty"; ``name``, ``seed``.
``[[meshes]]``
    ``path`` of an .obj, .glb or .ply file; ``spectrum``, or ``materials`` by the names of its parts;
    ``name``, ``kind``, ``class``, ``coat_index``, ``coat_roughness``, ``coat_gloss``, ``coat_waviness_deg``,
    ``flakes``; ``offset_m``, ``heading_deg``, ``unit_m``, ``up``.
``[platform]``
    ``lines`` and ``columns``, and arguments of `hyperpaint.simulation.rendering.platforms.pushbroom`.
``[camera]``
    Fields of `hyperpaint.simulation.SimulationSettings` that make a camera.
``[[atmospheres]]``
    ``name``, and a ``preset`` ("noon", "near_sunset", "cloudy"), a ``table`` of four curves, or the
    ``irradiance`` files of a spectrometer; ``sun_zenith_deg``, ``sun_azimuth_deg``, ``oktas`` and others.
``[sampling]``
    ``samples``, ``depth``, ``slots``, ``seed``, ``sun_radius_deg``.
``[spectra]``, ``[paints]``
    ``[spectra]``: a file with a spectrum, or a paint library, by name; paints of a library are "name/paint".
    ``[paints]``: the new spectrum, by the name of a spectrum, material or car.
``[output]``
    ``product``: "radiance" or "counts"; ``true_reflectance``; ``hold_edges``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import shutil
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.constants import KEPT_BITS, NUMERICS_VERSION
from hyperpaint.base.errors import Problems, SchemaError, StoreError
from hyperpaint.base.facts import arguments_of, as_argument, documented
from hyperpaint.base.input_files import open_input
from hyperpaint.base.mirrored_light import EXCLUDED
from hyperpaint.base.old_names import renamed
from hyperpaint.base.schema import (
    CHUNK_LINES,
    CUBE,
    FORMAT_VERSION,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    VARIABLES,
    Floats,
    Floats32,
    round_bits,
)
from hyperpaint.io.dirsig import write_dirsig_scene
from hyperpaint.io.store import list_groups, open_group, open_store
from hyperpaint.io.store.budget import size_text
from hyperpaint.io.store.computing import errors_of_the_cluster
from hyperpaint.io.store.manifest import INPUTS, SETTINGS
from hyperpaint.io.store.writer import WholeRun
from hyperpaint.pictures.figures import new_figure, save_figure
from hyperpaint.pictures.plot import overview
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.collect import labelled
from hyperpaint.simulation.rendering.relighting import assigned_paints, by_name, relight, trace
from hyperpaint.simulation.rendering.scene_record import SceneRecord
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of
from hyperpaint.simulation.settings import ORIGIN, SimulationSettings

from .products import (
    Outcome,
    computing_on,
    digest_of,
    local_folder,
    refuse_to_write_over,
    write_groups,
)
from .scene_files import (
    SCHEMA,
    SceneFile,
    build_parts,
    chosen_atmospheres,
    read_paints,
    read_scene_file,
    spectra_digest,
)

if TYPE_CHECKING:
    from hyperpaint.simulation.camera import Camera
    from hyperpaint.simulation.rendering.four_curves import Atmosphere
    from hyperpaint.simulation.rendering.platforms import Platform

    from .scene_files import RenderParts

_INTERVAL_S = 2  # time between samples of the spectrometer
_MARGIN_S = 6  # record before and after the flight
_DARK_FRAMES = 64  # number of frames averaged for a dark
# keys of the random streams, different from those of other simulators
_NOISE, _DARK = 20, 21


def flight_line(
    traced: xr.Dataset, atmosphere: Atmosphere, file: SceneFile, parts: RenderParts
) -> xr.Dataset:
    # Return the flight line of a traced scene under an atmosphere, lazily; see `hyperpaint.render_scene`.
    # Bands of counts are weighted by the responsivity of the detector. Bands of radiance are not: readers of
    # radiance do not know the responsivity, and resample the irradiance without it.
    bands = BandSet.of(parts.camera.imager)
    relit = relight(
        traced,
        bands if file.product == "counts" else dataclasses.replace(bands, responsivity=None),
        paints=dict(file.paints),
        atmosphere=atmosphere,
        spectra=dict(parts.spectra),
        hold_edges=file.hold_edges,
    )
    picture = overview(relit)
    line = relit.rename(reflectance="true_reflectance")
    if file.true_reflectance:
        # rounded to the mantissa bits of a stored reflectance, half to even
        rounded: xr.DataArray = xr.apply_ufunc(
            round_bits,
            line["true_reflectance"],
            KEPT_BITS,
            dask="parallelized",
            output_dtypes=[np.float32],
            keep_attrs=True,
        )
        rounded.attrs |= {"long_name": "Reflectance factor without noise", "keep_bits": KEPT_BITS}
        line["true_reflectance"] = rounded
    else:
        line = line.drop_vars("true_reflectance")
    if file.product == "counts":
        exposure_time, seed = parts.platform.exposure_time, file.sampling["seed"]
        line = line.drop_vars("radiance").merge(
            counts_of(line["radiance"], parts.camera, exposure_time, seed, atmosphere.name, noise=parts.noise)
        )
    # the irradiance that a spectrometer logs every 2 s, from before to after the flight
    first, last = (moment.astype("datetime64[s]") for moment in parts.platform.utc[[0, -1]])
    count = int((last - first).astype(np.int64) + 2 * _MARGIN_S) // _INTERVAL_S + 2
    seconds = _INTERVAL_S * np.arange(count) - _MARGIN_S
    time = (first + seconds.astype("timedelta64[s]")).astype("datetime64[ns]")
    spectrum = np.asarray(line["irradiance"][0].values)
    wavelength = line[IRRADIANCE_WAVELENGTH].variable
    line = line.drop_vars(("irradiance", IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH)).assign(
        irradiance=_variable("irradiance", np.broadcast_to(spectrum, (count, len(spectrum)))),
        irradiance_max_gap=_variable("irradiance_max_gap", 2.5 * _INTERVAL_S),
        look_angle=look_angle_of(parts.platform),
    )
    coords = {IRRADIANCE_TIME: _variable(IRRADIANCE_TIME, time), IRRADIANCE_WAVELENGTH: wavelength}
    line = line.assign_coords({**coords, **pose_of(parts.platform)})
    return line if picture is None else line.assign(overview=picture)


def pose_of(platform: Platform) -> dict[str, xr.Variable]:
    # Return the pose of the camera at mid-exposure of every line, as variables of a flight line.
    roll, pitch, heading = platform.attitude.T
    pose = {"altitude": platform.position[:, 2], "roll": roll, "pitch": pitch, "heading": heading}
    return {name: _variable(name, values) for name, values in pose.items()}


def look_angle_of(platform: Platform) -> xr.Variable:
    # Return the angles of column centres from the camera's axis, positive to the right [degree].
    edges = platform.column_edges
    return _variable("look_angle", np.degrees(np.arctan(0.5 * (edges[1:] + edges[:-1]))))


def counts_of(
    radiance: xr.DataArray, camera: Camera, exposure_time: float, seed: int, name: str, *, noise: bool = True
) -> xr.Dataset:
    # Return the counts of a camera under this radiance, with all variables that calibrate them.
    #
    # Lazy. The noise of a line is drawn from a generator keyed by seed, name of the render and number of the
    # line, so that counts do not depend on chunks or workers; without ``noise`` counts are still rounded. The
    # optics of the camera blur the radiance. ``radiance``: mean over the camera's responses (along_track,
    # band, cross_track) [W m-2 sr-1 nm-1]; ``exposure_time``: [s].
    import dask.array as da

    # a mean radiance of 1 gives (exposure time) x (etendue) x (integral of the response) counts; dead
    # elements 0
    scale, factor = exposure_time * camera.etendue * camera.response_area, np.where(camera.bad, 0.0, 1.0)
    if camera.optics is not None:  # optics act before the response of single elements
        scale, factor = scale / camera.imager.element_factor, factor * camera.imager.element_factor
    detector = camera.detector(exposure_time)
    key = (seed, _NOISE, zlib.crc32(name.encode()))
    cube = radiance.transpose(*CUBE).data
    reach = 0 if camera.optics is None else camera.optics.reach
    number, stops = cube.shape[0], np.cumsum(cube.chunks[0]).tolist()

    def exposed(block: Floats32, first: int, lines: range) -> NDArray[np.uint16]:
        # counts of ``lines`` in their order, because afterglow of a line adds to the next; the block starts
        # at the line ``first``
        block = np.nan_to_num(block, nan=0.0)  # beyond the scene there is no light
        counts = np.empty((len(lines), *block.shape[1:]), dtype=np.uint16)
        for line, row in zip(lines, counts, strict=True):
            rng = np.random.default_rng([*key, line]) if noise else None
            if camera.optics is None:
                signal = np.asarray(block[line - first] * (scale * factor))
            else:
                rows = camera.optics.rows_of(line, number)
                signal = camera.optics.image([block[row - first] * scale for row in rows]) * factor
            electrons = detector.read(signal, rng)
            if camera.pedestal:
                electrons += camera.pedestal
            row[...] = detector.convert(electrons[None])[0]
        return counts

    blocks = []
    for start, stop in zip([0, *stops], stops, strict=False):
        # include the lines around a block that blur into it
        window_start, window_end = max(start - reach, 0), min(stop + reach, number)
        window = cube[window_start:window_end].rechunk(-1)
        block = da.map_blocks(
            exposed,
            window,
            first=window_start,
            lines=range(start, stop),
            dtype=np.uint16,
            chunks=((stop - start,), *window.chunks[1:]),
            meta=np.empty((0, 0, 0), dtype=np.uint16),
        )
        blocks.append(block)
    dark = detector.dark
    if noise:  # the mean of frames has residual noise and rounding errors
        sd = np.sqrt((detector.read_noise**2 + 1.0 / 12.0) / _DARK_FRAMES)
        dark = np.asarray(dark + sd * np.random.default_rng([seed, _DARK]).standard_normal(dark.shape))
    variables = {
        "counts": xr.Variable(CUBE, da.concatenate(blocks), VARIABLES["counts"].attrs),
        "dark_counts": _variable("dark_counts", dark),
        "radiance_gain": _variable("radiance_gain", camera.radiance_gain()),
        "exposure_time": _variable("exposure_time", exposure_time),
        "saturation_count": _variable("saturation_count", detector.saturation_count),
        "electrons_per_count": _variable("electrons_per_count", camera.electrons_per_count),
        "read_noise": _variable("read_noise", camera.read_noise),
    }
    return xr.Dataset(variables)


def _variable(name: str, values: Any) -> xr.Variable:

    return labelled(VARIABLES[name], values)


#: Group of the traced scene.
TRANSPORT = "transport"

#: Prefix of the groups of renders.
RENDERS = "renders/"
_SETTINGS = {SETTINGS: f"numerics={NUMERICS_VERSION}"}

# lower bounds of the compressed size: hundreds of bytes for a pixel of a traced scene, two for a sample of a
# render
MIN_BYTES_PER_PIXEL, MIN_BYTES_PER_SAMPLE = 30, 1

#: Lines in a task on a cluster; tracing a line takes some tenths of a second.
CLUSTER_LINES = 64


@renamed(paints="library")
@documented(overwrite="group overwrite", progress="stderr progress")
def render_scene(
    path: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    to: Literal["radiance", "counts"] | None = None,
    atmospheres: Sequence[str] = (),
    library: str | Path | None = None,
    hold_edges: bool | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Path:
    """Render a scene into a Zarr store: cubes of hundreds of bands, with the truth of every pixel.

    The scene is traced once, without spectra, into the group ``transport``. From this group, each atmosphere
    gives a group ``renders/<name>``, a flight line: ``radiance``, or ``counts`` with all variables that
    calibrate them, and the irradiance of a spectrometer beside the scene, so that ``.paint.reflectance()``
    works. The group also has the truth of every pixel: material, instance, class, paint and car, with their
    names in ``flag_meanings`` or in the attributes; purity, shadow, the shares of sun, sky, glint and
    indirect light; and the reflectance without noise.

    All parts are built and checked before anything is written. The same call resumes an interrupted run, and
    does nothing for a finished store. A new atmosphere, paint or camera in the file needs no tracing, unless
    its sun has not been traced.

    Parameters
    ----------
    path
        A ``scene.toml``; see `hyperpaint.workflows.rendering`.
    out
        The store, a folder.
    samples
        Rays of a pixel; by default those of the file.
    to
        ``"radiance"`` or ``"counts"``; by default the product of the file.
    atmospheres
        Names of atmospheres of the file to render; all by default.
    library
        A paint library, such as signatures of a flight, in a format of `hyperpaint.write_library` or
        `hyperpaint.write_dirsig`. A paint with the name of a spectrum, material or instance of the scene
        replaces its spectrum; other paints are assigned in turn to the remaining cars; ``[paints]`` of the
        file takes precedence. The scene is not traced again.
    hold_edges
        Extend spectra by their first and last value, and interpolate bands without a value; by default as in
        the file, else over at most 25 nm at the ends, with a warning.
    scheduler
    overwrite
    progress

    Returns
    -------
    Path of the store.

    Raises
    ------
    FormatError
        The scene file, or one of its files, cannot be used; all problems are listed.
    SchemaError
        An argument is out of range, a name unknown, or spectra do not cover the bands or leave 0 to 1.
    StoreError
        The store holds other data, is being written by another process, or cannot be written; or memory or
        disk does not suffice, which is checked before anything is written.
    MissingExtraError
        A package is not installed that ``scheduler`` or a mesh needs.

    Examples
    --------
    >>> import tempfile, hyperpaint as hp
    >>> scene = Path(tempfile.mkdtemp(), "lawn.toml")
    >>> _ = scene.write_text('''[scene]
    ... kind = "plane"
    ... spectrum = "grass"
    ... [platform]
    ... lines = 2
    ... columns = 2
    ... ground_sample_m = 0.1
    ... altitude_m = 15.0
    ... ''')
    >>> path = render_scene(scene, scene.with_name("lawn.zarr"))
    >>> hp.open_store(path, "renders/noon").radiance.shape
    (2, 272, 2)
    """
    return run(
        path,
        out,
        samples=samples,
        to=to,
        atmospheres=atmospheres,
        library=library,
        hold_edges=hold_edges,
        scheduler=scheduler,
        overwrite=overwrite,
        progress=progress,
    ).path


def run(
    path: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    to: Literal["radiance", "counts"] | None = None,
    atmospheres: Sequence[str] = (),
    library: str | Path | None = None,
    hold_edges: bool | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Outcome:
    # Render a scene, as `render_scene` does with the same arguments, and return the groups written.
    out = local_folder(out, "render")
    file, problems = read_scene_file(path), Problems("cannot render", SchemaError)
    if samples is not None:
        if SCHEMA["sampling"]["samples"].note(problems, as_argument("samples", samples), samples):
            samples = int(samples)  # a number of numpy would give another digest
        file = dataclasses.replace(file, sampling={**file.sampling, "samples": samples})
    if to is not None:
        SCHEMA["output"]["product"].note(problems, as_argument("to", to), to)
    problems.raise_if_any()
    changes: dict[str, Any] = {"product": to, "hold_edges": hold_edges}
    file = dataclasses.replace(file, **{name: value for name, value in changes.items() if value is not None})
    refuse_to_write_over(out, (file, library and Path(library)), "render")
    # a rough check before the scene is built; `check_room` is exact
    folder = next(parent for parent in out.absolute().parents if parent.exists())
    pixels = file.platform["lines"] * file.platform["columns"]
    min_bytes = pixels * (
        MIN_BYTES_PER_PIXEL + MIN_BYTES_PER_SAMPLE * file.camera.get("bands", SimulationSettings.bands)
    )
    free_bytes = shutil.disk_usage(folder).free
    StoreError.raise_if(
        min_bytes > free_bytes,
        f"{file.path} needs at least {size_text(min_bytes)} of disk; {size_text(free_bytes)} are free in "
        f"{folder}",
        mend="reduce lines, columns or bands, or use another disk",
        code="disk-full",
    )
    parts = build_parts(file)
    if library is not None:
        # paints of the file take precedence over those of the library
        paints = by_name(read_paints(Path(library)))
        file = dataclasses.replace(
            file, paints={**assigned_paints(SceneRecord.of(parts.scene), list(paints)), **file.paints}
        )
        parts = dataclasses.replace(parts, spectra={**paints, **parts.spectra})
    names = [light.name for light in chosen_atmospheres(parts, atmospheres)]
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(computing_on(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot render {path}"))
        lines = CHUNK_LINES if client is None else CLUSTER_LINES
        traced = trace(
            parts.scene,
            parts.platform,
            parts.suns,
            **arguments_of(SCHEMA["sampling"], file.sampling),
            overcast=parts.overcast,
            chunk_lines=lines,
        )
        meshes = []
        for mesh in file.meshes:
            with open_input(mesh.path, "an input of a scene") as content:
                meshes.append(
                    [hashlib.file_digest(content, "sha256").hexdigest(), mesh.name, dict(mesh.options)]
                )
        inputs = {
            "format": [FORMAT_VERSION, NUMERICS_VERSION],
            "scene": {**file.scene, "name": file.name},
            "meshes": meshes,
            "platform": dict(file.platform),
            "sampling": dict(file.sampling),
            "suns": parts.suns,
            "overcast": parts.overcast,
        }
        traced = traced.assign_coords(pose_of(parts.platform)).assign_attrs(
            {INPUTS: digest_of(inputs)[:32], **_SETTINGS}
        )
        planned = {TRANSPORT: traced, **_renders(traced, file, parts, names)}
        size = f"{file.platform['lines']} lines of {file.platform['columns']} columns"

        def pending_groups(pending: list[str]) -> dict[str, xr.Dataset]:
            # a new traced scene would not fit the renders that are kept
            stored = list_groups(out) if TRANSPORT in pending and out.exists() else []
            orphans = [name for name in stored if name.startswith(RENDERS) and name not in planned]
            StoreError.raise_if(
                orphans,
                f"{out} holds /{', /'.join(orphans)}, of a scene traced with other parameters",
                mend="render these atmospheres too, or choose another path",
                code="renders-outdated",
            )
            return {name: planned[name] for name in pending}

        def from_stored(name: str, turn: WholeRun) -> xr.Dataset:
            if name == TRANSPORT:
                return planned[name]
            turn.settle()
            return _renders(open_group(out, TRANSPORT), file, parts, [name.removeprefix(RENDERS)])[name]

        def announced(name: str) -> str:
            if name == TRANSPORT:
                return f"tracing {size}, {file.sampling['samples']} rays a pixel\n"
            return f"{name.removeprefix(RENDERS)}: {file.product} of {size}\n"

        return write_groups(
            out,
            planned,
            pending_groups,
            {"name": file.name, "scene_file": file.path.read_text(encoding="utf-8")},
            source=path,
            command="render",
            options={
                "--samples": samples,
                "--to": to,
                "--atmosphere": list(atmospheres),
                "--overwrite": overwrite,
                "--library": library and Path(library).absolute(),
                "--hold-edges" if hold_edges else "--no-hold-edges": hold_edges is not None,
            },
            from_stored=from_stored,
            announce=announced if progress else None,
            overwrite=overwrite,
            client=client,
        )


# --- groups to write ---------------------------------------------------------------------------------------


def _renders(
    traced: xr.Dataset, file: SceneFile, parts: RenderParts, names: Sequence[str]
) -> dict[str, xr.Dataset]:
    renders = {}
    for atmosphere in parts.atmospheres:
        if atmosphere.name in names:
            light = hashlib.sha256()
            for field in dataclasses.fields(atmosphere):
                value = getattr(atmosphere, field.name)
                light.update(f"{field.name} ".encode())
                light.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
            inputs = {
                "transport": traced.attrs[INPUTS],
                "atmosphere": light.hexdigest(),
                "camera": dict(file.camera),
                "exposure_time": parts.platform.exposure_time,
                "spectra": spectra_digest(parts.spectra),
                "hold_edges": file.hold_edges,
                "paints": dict(file.paints),
                "product": [file.product, file.true_reflectance, file.sampling["seed"]],
            }
            renders[RENDERS + atmosphere.name] = flight_line(traced, atmosphere, file, parts).assign_attrs(
                {INPUTS: digest_of(inputs)[:32], **_SETTINGS}
            )
    return renders


_PICTURE_INCH, _DPI = 4.0, 150


def draw_renders(store: Path, groups: Sequence[str], path: Path) -> None:
    # Draw the stored overviews of renders (``groups`` of the store) side by side, north up.
    #
    # Raises `MissingExtraError` if matplotlib is not installed; `StoreError` if no group has an overview,
    # which needs three visible bands; `SchemaError` if matplotlib does not write this file type.
    datasets = {group: open_store(store, group) for group in groups}
    overviews = {group: dataset["overview"] for group, dataset in datasets.items() if "overview" in dataset}
    StoreError.raise_if(
        not overviews,
        f"{store} has no overview to draw, which needs three visible bands",
        code="overview-missing",
    )
    lines, columns = next(iter(overviews.values())).shape[:2]
    size = (_PICTURE_INCH * len(overviews), _PICTURE_INCH * min(lines / columns, 5.0) + 0.4)
    figure = new_figure("a picture", figsize=size, layout="constrained")
    for axes, (group, picture) in zip(
        figure.subplots(1, len(overviews), squeeze=False)[0], overviews.items(), strict=True
    ):
        # on a flight to the north the first line is in the south
        axes.imshow(picture.values, origin="lower", interpolation="nearest")
        axes.set_title(group.rpartition("/")[2].replace("_", " "))
        axes.set_axis_off()
    save_figure(figure, path, dpi=_DPI)


_GRID_NM = np.arange(380.0, 1051.0, 2.0)  # wavelengths on which built-in spectra are written


def export_dirsig_scene(
    scene_file: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    library: xr.Dataset | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    r"""Write the scene of a ``scene.toml`` for DIRSIG.

    Parameters
    ----------
    scene_file
        A scene file of `hyperpaint.render_scene`; its ``[paints]`` repaint materials and cars.
    folder
        A folder, new or empty.
    library
        Measured paints, which take precedence over the file's ``[spectra]`` and over built-in spectra of the
        same name. Paints that are not named in the scene are assigned in turn to the cars without another
        repaint.
    overwrite, progress, **options
        As for `hyperpaint.io.dirsig.write_dirsig_scene`.

    Returns
    -------
    Dataset
        The written materials, as returned by `hyperpaint.io.dirsig.write_dirsig_scene`.

    Raises
    ------
    FormatError, SchemaError, StoreError
        As `hyperpaint.render_scene` and `hyperpaint.io.dirsig.write_dirsig_scene`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "lawn.toml")
    ...     text = '[scene]\nkind = "plane"\nspectrum = "grass"\n[platform]\nlines = 2\ncolumns = 2\n'
    ...     _ = path.write_text(text + "ground_sample_m = 0.1\naltitude_m = 15.0\n")
    ...     export_dirsig_scene(path, Path(folder, "out")).material_id.values.tolist()
    ['grass']
    """
    file = read_scene_file(Path(scene_file))
    parts = build_parts(file)
    repaint = dict(file.paints)
    libraries = [] if library is None else [library]
    if library is not None:
        repaint = painted_cars(parts.scene, list(map(str, library["signature"].values)), repaint)
    libraries += [*named_libraries(parts.spectra), _spectra_library(parts, repaint)]
    return write_dirsig_scene(
        parts.scene,
        folder,
        libraries,
        repaint=repaint,
        origin=ORIGIN,
        overwrite=overwrite,
        progress=progress,
        **options,
    )


def painted_cars(scene: Any, names: Sequence[str], repaint: Mapping[str, str]) -> dict[str, str]:
    """Return new paints by instance: ``repaint``, and other ``names`` in turn for cars without a repaint.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.car_parks import car_park
    >>> scene = car_park(length=5.0, width=16.0, neighbours=(), seed=1)
    >>> [instance.paint for instance in scene.instances if instance.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> painted_cars(scene, ["yellow", "roof 7", "roof 8"], {"car_000": "roof 8"})
    {'car_000': 'roof 8', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    scene_names = {item.name for item in (*scene.materials, *scene.instances)}
    scene_names |= {item.spectrum for item in scene.materials} | set(repaint.values())
    new_paints = [name for name in names if name not in scene_names]
    cars = [
        item.name
        for item in scene.instances
        if item.kind == "car" and item.name not in repaint and not {item.paint} & {*names, *repaint}
    ]
    return {
        **repaint,
        **{car: new_paints[number % len(new_paints)] for number, car in enumerate(cars) if new_paints},
    }


def named_libraries(spectra: Mapping[str, Any]) -> list[xr.Dataset]:
    # Return the paint libraries among spectra; paints are "<key>/<name>", a single paint also "<key>".
    libraries = []
    for key, value in spectra.items():
        if hasattr(value, "data_vars"):
            names = [str(name) for name in value["signature"].values]
            libraries.append(value.assign_coords(signature=[f"{key}/{name}" for name in names]))
            if len(names) == 1:
                libraries.append(value.assign_coords(signature=[key]))
    return libraries


def _spectra_library(parts: RenderParts, repaint: Mapping[str, str]) -> xr.Dataset:
    # spectra of the file and built-in spectra as a library; DIRSIG has no flakes, so that the reflectance of
    # a paint with flakes is the sum of pigment and flakes

    flakes = {
        material.spectrum: material.flakes
        for material in parts.scene.materials
        if material.flakes is not None
    }
    names = [material.spectrum for material in parts.scene.materials] + list(repaint.values())
    spectra: dict[str, Floats] = {}
    for name in dict.fromkeys(names):
        file_spectrum: Any = parts.spectra.get(name)
        if file_spectrum is not None and not hasattr(file_spectrum, "data_vars"):
            wavelength, values = file_spectrum
            spectra[name] = np.interp(_GRID_NM, wavelength, values, left=np.nan, right=np.nan)
            continue
        try:
            body = spectrum_of(name)(_GRID_NM)
        except SchemaError:
            continue  # a paint of the library; the writer reports unknown names
        flake = flakes.get(name)
        if flake is not None:
            body = (1.0 - flake.share) * body + flake.share * spectrum_of(flake.spectrum)(_GRID_NM)
        spectra[name] = body
    reflectance = np.array(list(spectra.values()), np.float32).reshape(-1, len(_GRID_NM))
    return xr.Dataset(
        {"reflectance": (("signature", "band"), reflectance, {"units": "1", "mirror_reflection": EXCLUDED})},
        {
            "signature": np.array(list(spectra), object),
            "wavelength": ("band", _GRID_NM, {"units": "nm"}),
        },
    )
