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
    Name to a file with a spectrum, or to a paint library, whose paints are "name/paint"; name of a spectrum,
    material or car to that of its new spectrum.
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
from hyperpaint.base.keyword_names import renamed
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
from .scene_parts import Parts, build_parts, chosen_atmospheres
from .store_inputs import finishing_command, refuse_to_write_over

#: Group of the traced scene.
TRANSPORT = "transport"

#: Prefix of the groups of renders.
RENDERS = "renders/"

# lower bounds of compressed bytes: a pixel of the traced scene takes hundreds, a sample of a render two
MIN_BYTES_PER_PIXEL, MIN_BYTES_PER_SAMPLE = 30, 1

#: Lines in one task on a cluster; tracing a line takes some tenths of a second.
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
    """Render a scene into one Zarr store: cubes of hundreds of bands, with everything true of each pixel.

    The scene is traced once, without spectra, into the group ``transport``. From what is stored there, each
    atmosphere becomes a group ``renders/<name>``, which is a flight line: ``radiance`` or ``counts`` with all
    that calibrates them, the irradiance of a spectrometer beside the scene, and so ``.paint.reflectance()``.
    Beside them stand what is true of every pixel: material, instance, class, paint and car, with their names
    in ``flag_meanings`` or in the attributes; purity, shadow, the shares of sun, sky, glint and indirect
    light; and the reflectance without noise.

    Everything is built and checked before anything is written. An interrupted run is resumed by the same
    call; a store that is finished is left alone. Another atmosphere, paint or camera in the file costs no
    tracing, unless the light comes from a sun that has not been traced.

    Parameters
    ----------
    path
        A ``scene.toml``; see `hyperpaint.workflows.rendering`.
    out
        The store, a folder.
    samples
        Rays of a pixel, in place of those of the file.
    to
        ``"radiance"`` or ``"counts"``, in place of what the file says.
    atmospheres
        Names of those of the file that are to be rendered; all by default.
    library
        A paint library, such as signatures of a flight: anything that `hyperpaint.write_library` or
        `hyperpaint.write_dirsig` wrote. A paint that is called like a spectrum, a material or a thing of the
        scene goes there, the others in turn to the cars that are left; what the file says in ``[paints]``
        comes before. The scene is not traced again.
    hold_edges
        Hold spectra constant beyond their last band with values, and bridge bands without, in place of what
        the file says.
    scheduler
    overwrite
    progress

    Returns
    -------
    Path of the store.

    Raises
    ------
    FormatError
        The file, or one that it names, cannot be used; all problems are listed.
    SchemaError
        An argument is out of range, a name unknown, or spectra do not cover the bands or leave 0 to 1.
    StoreError
        The store holds something else, is being written, or cannot be written, or memory or disk would not
        suffice, of which the message names the needed figure before anything is written.
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
    file = _changed(read_scene_file(path), samples, to)
    if hold_edges is not None:
        file = dataclasses.replace(file, hold_edges=hold_edges)
    refuse_to_write_over(out, (file, library and Path(library)), "render")
    # before the scene is built; `check_room` is exact later
    folder = next(parent for parent in out.absolute().parents if parent.exists())
    pixels = file.platform["lines"] * file.platform["columns"]
    bands = file.camera.get("bands", SimulationSettings.bands)
    least = pixels * (MIN_BYTES_PER_PIXEL + MIN_BYTES_PER_SAMPLE * bands)
    free = shutil.disk_usage(folder).free
    if least > free:
        raise StoreError(
            f"{file.path} needs at least {size_text(least)} of disk; {size_text(free)} are free in {folder}",
            mend="take fewer lines, columns or bands, or another disk",
            code="disk-full",
        )
    parts = build_parts(file)
    if library is not None:
        file, parts = _painted(file, parts, Path(library))
    chosen = [each.name for each in chosen_atmospheres(parts, atmospheres)]
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(computing_on(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot render {path}"))
        lines = CHUNK_LINES if client is None else CLUSTER_LINES
        traced = _traced(file, parts, lines)
        settings = {SETTINGS: f"numerics={NUMERICS_VERSION}"}
        planned = {TRANSPORT: traced, **_renders(traced, file, parts, chosen)}
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
            if name != TRANSPORT:  # of the scene as it is stored
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


def _changed(file: SceneFile, samples: int | None, to: str | None) -> SceneFile:
    problems = Problems("cannot render", SchemaError)
    if samples is not None:
        SCHEMA["sampling"]["samples"].note(problems, as_argument("samples", samples), samples)
        file = dataclasses.replace(file, sampling={**file.sampling, "samples": samples})
    if to is not None:
        SCHEMA["output"]["product"].note(problems, as_argument("to", to), to)
    problems.raise_if_any()
    return file if to is None else dataclasses.replace(file, product=to)


def _painted(file: SceneFile, parts: Parts, paints: Path) -> tuple[SceneFile, Parts]:
    # paints of the file take precedence over the library
    from hyperpaint.simulation.rendering.given_spectra import by_name
    from hyperpaint.simulation.rendering.painting import assigned_paints
    from hyperpaint.simulation.rendering.scene_record import SceneRecord

    library = by_name(read_paints(paints))
    dealt = assigned_paints(SceneRecord.of(parts.scene), list(library))
    file = dataclasses.replace(file, paints={**dealt, **file.paints})
    return file, dataclasses.replace(parts, spectra={**library, **parts.spectra})


# --- groups to write ---------------------------------------------------------------------------------------


def _traced(file: SceneFile, parts: Parts, lines: int) -> xr.Dataset:
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
        "meshes": [[_content(mesh.path), mesh.name, dict(mesh.options)] for mesh in file.meshes],
        "platform": dict(file.platform),
        "sampling": dict(file.sampling),
        "suns": parts.suns,
        "overcast": parts.overcast,
    }
    return traced.assign_coords(pose_of(parts.platform)).assign_attrs({INPUTS: _digest(inputs)})


def _renders(
    traced: xr.Dataset, file: SceneFile, parts: Parts, names: Sequence[str]
) -> dict[str, xr.Dataset]:
    renders = {}
    for atmosphere in parts.atmospheres:
        if atmosphere.name in names:
            inputs = {
                "transport": traced.attrs[INPUTS],
                "atmosphere": _light(atmosphere),
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
    # renders of other parameters keep the traced scene below them

    if TRANSPORT in complete or not out.exists():
        return
    left = [name for name in list_groups(out) if name.startswith(RENDERS) and name not in planned]
    if left:
        raise StoreError(
            f"{out} holds /{', /'.join(left)}, of a scene traced with other parameters",
            mend="render them too, or choose another path",
            code="renders-outdated",
        )


def _light(atmosphere: Any) -> str:
    digest = hashlib.sha256()
    for field in dataclasses.fields(atmosphere):
        value = getattr(atmosphere, field.name)
        digest.update(f"{field.name} ".encode())
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def _content(path: Path) -> str:
    with open_input(path, "an input of a scene") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(inputs: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()[:32]


_WIDTH, _DPI = 4.0, 150  # of one picture [inch]


def draw_renders(store: Path, groups: Sequence[str], path: Path) -> None:
    """Draw the stored overviews of renders (``groups`` of the store) side by side, north up.

    Raises `MissingExtraError`: matplotlib is not installed; `StoreError`: no group has an overview, of fewer
    than three visible bands; `SchemaError`: matplotlib writes no such picture.
    """
    from hyperpaint.pictures.figures import new_figure, save_figure

    opened = {group: open_store(store, group) for group in groups}
    shown = {group: dataset["overview"] for group, dataset in opened.items() if "overview" in dataset}
    if not shown:
        raise StoreError(
            f"{store} has no overview to draw, which needs three visible bands", code="overview-missing"
        )
    lines, columns = next(iter(shown.values())).shape[:2]
    size = (_WIDTH * len(shown), _WIDTH * min(lines / columns, 5.0) + 0.4)
    figure = new_figure("a picture", figsize=size, layout="constrained")
    for axes, (group, picture) in zip(
        figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True
    ):
        # the first line is the southernmost of a flight to the north
        axes.imshow(picture.values, origin="lower", interpolation="nearest")
        axes.set_title(group.rpartition("/")[2].replace("_", " "))
        axes.set_axis_off()
    save_figure(figure, path, dpi=_DPI)
