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
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import numpy as np
import xarray as xr

from hyperpaint.base.constants import NUMERICS_VERSION
from hyperpaint.base.errors import Problems, SchemaError, StoreError
from hyperpaint.base.facts import arguments_of, as_argument, documented
from hyperpaint.base.input_files import open_input
from hyperpaint.base.old_names import renamed
from hyperpaint.base.schema import CHUNK_LINES, FORMAT_VERSION
from hyperpaint.io.store import list_groups, open_group, open_store
from hyperpaint.io.store.budget import size_text
from hyperpaint.io.store.computing import errors_of_the_cluster
from hyperpaint.io.store.manifest import INPUTS, SETTINGS
from hyperpaint.io.store.writer import check_room, run_contents, whole_run
from hyperpaint.simulation.settings import SimulationSettings

from .pipeline import Outcome, computing_on, kept_groups, local_folder, token_of
from .render_libraries import read_paints, spectra_digest
from .render_products import Render, pose_of
from .scene_files import SCHEMA, SceneFile, read_scene_file
from .scene_parts import RenderParts, build_parts, chosen_atmospheres
from .store_inputs import finishing_command, refuse_to_write_over

#: Group of the traced scene.
TRANSPORT = "transport"

#: Prefix of the groups of renders.
RENDERS = "renders/"

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
        the file.
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
    """Render a scene, as `render_scene` does with the same arguments, and return the groups written."""
    out = local_folder(out, "render")
    file = _with_options(read_scene_file(path), samples, to)
    if hold_edges is not None:
        file = dataclasses.replace(file, hold_edges=hold_edges)
    refuse_to_write_over(out, (file, library and Path(library)), "render")
    # a rough check before the scene is built; `check_room` is exact
    folder = next(parent for parent in out.absolute().parents if parent.exists())
    pixels = file.platform["lines"] * file.platform["columns"]
    min_bytes = pixels * (
        MIN_BYTES_PER_PIXEL + MIN_BYTES_PER_SAMPLE * file.camera.get("bands", SimulationSettings.bands)
    )
    free_bytes = shutil.disk_usage(folder).free
    if min_bytes > free_bytes:
        raise StoreError(
            f"{file.path} needs at least {size_text(min_bytes)} of disk; {size_text(free_bytes)} are free in "
            f"{folder}",
            mend="reduce lines, columns or bands, or use another disk",
            code="disk-full",
        )
    parts = build_parts(file)
    if library is not None:
        file, parts = _with_library(file, parts, Path(library))
    names = [light.name for light in chosen_atmospheres(parts, atmospheres)]
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(computing_on(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot render {path}"))
        lines = CHUNK_LINES if client is None else CLUSTER_LINES
        traced = _traced(file, parts, lines)
        settings = {SETTINGS: f"numerics={NUMERICS_VERSION}"}
        planned = {TRANSPORT: traced, **_renders(traced, file, parts, names)}
        planned = {name: dataset.assign_attrs(settings) for name, dataset in planned.items()}
        complete = kept_groups(planned, out, overwrite=overwrite, command="render")
        _refuse_orphans(out, planned, complete)
        pending = [name for name in planned if name not in complete]
        tokens = {name: token_of(planned[name]) for name in pending}
        check_room({name: planned[name] for name in pending}, out, tokens)
        attrs = {"name": file.name, "scene_file": file.path.read_text(encoding="utf-8")}
        contents = run_contents(planned)
        writing = {name: planned[name] for name in pending}
        again = {
            "--samples": samples,
            "--to": to,
            "--atmosphere": list(atmospheres),
            "--overwrite": overwrite,
            "--library": library and Path(library).absolute(),
            "--hold-edges" if hold_edges else "--no-hold-edges": hold_edges is not None,
        }
        command = finishing_command(f"render {quote(str(Path(path).absolute()))}", again)
        turn = stack.enter_context(
            whole_run(out, contents, writing, attrs, command=command, overwrite=overwrite)
        )
        for name in pending:
            dataset = traced
            if name != TRANSPORT:  # from the stored traced scene
                turn.settle()
                stored = open_group(out, TRANSPORT)
                dataset = _renders(stored, file, parts, [name.removeprefix(RENDERS)])[name]
            if progress:
                size = f"{file.platform['lines']} lines of {file.platform['columns']} columns"
                product = f"{name.removeprefix(RENDERS)}: {file.product} of {size}\n"
                tracing = f"tracing {size}, {file.sampling['samples']} rays a pixel\n"
                sys.stderr.write(tracing if name == TRANSPORT else product)
            turn.write(name, dataset.assign_attrs(settings), progress=progress)
    return Outcome(out, tuple(pending), tuple(complete))


def _with_options(file: SceneFile, samples: int | None, to: str | None) -> SceneFile:
    problems = Problems("cannot render", SchemaError)
    if samples is not None:
        if SCHEMA["sampling"]["samples"].note(problems, as_argument("samples", samples), samples):
            samples = int(samples)  # a number of numpy would give another digest
        file = dataclasses.replace(file, sampling={**file.sampling, "samples": samples})
    if to is not None:
        SCHEMA["output"]["product"].note(problems, as_argument("to", to), to)
    problems.raise_if_any()
    return file if to is None else dataclasses.replace(file, product=to)


def _with_library(file: SceneFile, parts: RenderParts, paints: Path) -> tuple[SceneFile, RenderParts]:
    # add the paints of a library; paints of the file take precedence
    from hyperpaint.simulation.rendering.given_spectra import by_name
    from hyperpaint.simulation.rendering.painting import assigned_paints
    from hyperpaint.simulation.rendering.scene_record import SceneRecord

    library = by_name(read_paints(paints))
    targets = assigned_paints(SceneRecord.of(parts.scene), list(library))
    file = dataclasses.replace(file, paints={**targets, **file.paints})
    return file, dataclasses.replace(parts, spectra={**library, **parts.spectra})


# --- groups to write ---------------------------------------------------------------------------------------


def _traced(file: SceneFile, parts: RenderParts, lines: int) -> xr.Dataset:
    from hyperpaint.simulation.rendering.tracing import trace

    traced = trace(
        parts.scene,
        parts.platform,
        parts.suns,
        **arguments_of(SCHEMA["sampling"], file.sampling),
        overcast=parts.overcast,
        chunk_lines=lines,
    )
    inputs = {
        "format": [FORMAT_VERSION, NUMERICS_VERSION],
        "scene": {**file.scene, "name": file.name},
        "meshes": [[_file_digest(mesh.path), mesh.name, dict(mesh.options)] for mesh in file.meshes],
        "platform": dict(file.platform),
        "sampling": dict(file.sampling),
        "suns": parts.suns,
        "overcast": parts.overcast,
    }
    return traced.assign_coords(pose_of(parts.platform)).assign_attrs({INPUTS: _digest(inputs)})


def _renders(
    traced: xr.Dataset, file: SceneFile, parts: RenderParts, names: Sequence[str]
) -> dict[str, xr.Dataset]:
    renders = {}
    for atmosphere in parts.atmospheres:
        if atmosphere.name in names:
            inputs = {
                "transport": traced.attrs[INPUTS],
                "atmosphere": _light_digest(atmosphere),
                "camera": dict(file.camera),
                "exposure_time": parts.platform.exposure_time,
                "spectra": spectra_digest(parts.spectra),
                "hold_edges": file.hold_edges,
                "paints": dict(file.paints),
                "product": [file.product, file.true_reflectance, file.sampling["seed"]],
            }
            render = Render(
                atmosphere, parts.camera, parts.platform, parts.spectra, file.paints, file.hold_edges
            )
            renders[RENDERS + atmosphere.name] = render.of(
                traced,
                product=file.product,
                true_reflectance=file.true_reflectance,
                seed=file.sampling["seed"],
                noise=parts.noise,
            ).assign_attrs({INPUTS: _digest(inputs)})
    return renders


def _refuse_orphans(out: Path, planned: Mapping[str, Any], complete: Sequence[str]) -> None:
    # a new traced scene would not fit the renders that are kept
    if TRANSPORT in complete or not out.exists():
        return
    orphans = [name for name in list_groups(out) if name.startswith(RENDERS) and name not in planned]
    if orphans:
        raise StoreError(
            f"{out} holds /{', /'.join(orphans)}, of a scene traced with other parameters",
            mend="render these atmospheres too, or choose another path",
            code="renders-outdated",
        )


def _light_digest(atmosphere: Any) -> str:
    digest = hashlib.sha256()
    for field in dataclasses.fields(atmosphere):
        value = getattr(atmosphere, field.name)
        digest.update(f"{field.name} ".encode())
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def _file_digest(path: Path) -> str:
    with open_input(path, "an input of a scene") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(inputs: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()[:32]


_PICTURE_INCH, _DPI = 4.0, 150


def draw_renders(store: Path, groups: Sequence[str], path: Path) -> None:
    """Draw the stored overviews of renders (``groups`` of the store) side by side, north up.

    Raises `MissingExtraError` if matplotlib is not installed; `StoreError` if no group has an overview, which
    needs three visible bands; `SchemaError` if matplotlib does not write this file type.
    """
    from hyperpaint.pictures.figures import new_figure, save_figure

    datasets = {group: open_store(store, group) for group in groups}
    overviews = {group: dataset["overview"] for group, dataset in datasets.items() if "overview" in dataset}
    if not overviews:
        raise StoreError(
            f"{store} has no overview to draw, which needs three visible bands", code="overview-missing"
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
