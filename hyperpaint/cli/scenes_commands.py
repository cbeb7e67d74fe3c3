"""The commands ``simulate`` and ``render``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING_FILE, FILE, FOLDER, PLACE, is_watched, progress_bar, say_outcome, without_none
from .options import command, settable, takes


@command(
    renamed={"--sky": "--atmosphere", "--no-smile": "--set smile_nm=0"},
    epilog="""\b
Examples:
  hyperpaint simulate sim --lines 2000
  hyperpaint simulate sim --atmosphere near_sunset --samples 64
  hyperpaint simulate sim --set srf_shape=slit --set smile_nm=1.5 --set cloud=0.6,4,2 --set dropped=12
  hyperpaint simulate sim --scene checkerboard --set swath=5 --set wobble=rough
  hyperpaint simulate sim --set noise=no --set smile_nm=0 --seed 7 --overwrite""",
)
@click.argument("folder", metavar="DIR", type=FOLDER)
@takes(
    "simulation.collect:simulate_collect",
    only=["lines", "bands", "columns", "seed", "scene"],
    lines={"help": "Scan lines."},
    bands={"help": "Spectral bands."},
    columns={"help": "Columns."},
    scene={
        "type": click.Choice(["rendered", "plan", "checkerboard"]),
        "help": "A ray-traced car park, a flat picture, or squares of known corners.",
    },
)
@takes(
    "simulation.settings:SimulationSettings",
    only=["samples", "sky"],
    samples={"metavar": "N", "default": None, "help": "Rays a pixel of a rendered scene.  [default: 16]"},
    sky={
        "spelling": "--atmosphere",
        "type": click.Choice(["clear", "near_sunset", "overcast"]),
        "default": None,
        "help": "Light on the scene.  [default: clear]",
    },
)
@settable(
    {"simulation.settings:SimulationSettings": []},
    without=["lines", "bands", "columns", "seed", "scene", "samples", "sky", "quantise", "psf_kernel"],
)
@takes(
    "simulation.collect:simulate_collect",
    only=["truth", "sweep", "overwrite"],
    truth={"help": "Write truth.zarr."},
    sweep={"is_flag": True, "default": False, "help": "Write a lab sweep, named by collect.toml."},
)
def simulate(
    folder: Path, truth: bool, sweep: bool, overwrite: bool, settings: dict[str, Any], **options: Any
) -> None:
    """Write a simulated collect with known truth, in the instruments' own formats.

    DIR receives a Headwall folder (flight), a dark cube, ASD and SVC files, calibration.zarr, truth.zarr,
    regions.geojson (pure, sunlit pixels of the paints, for signatures --regions) and collect.toml. --set
    changes or switches off every effect of camera, light and instruments.
    """
    from hyperpaint.simulation import simulate_collect
    from hyperpaint.workflows.demonstration import refuse_foreign

    effects = {**without_none(options), **settings}
    if overwrite:
        refuse_foreign(folder, overwrite=True)
    with progress_bar("simulating") as progress:
        path = simulate_collect(
            folder,
            truth=truth,
            sweep={} if sweep else None,
            overwrite=overwrite,
            progress=progress,
            **effects,
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")


def _print_example(ctx: click.Context, _: click.Parameter, is_set: bool) -> None:
    if is_set and not ctx.resilient_parsing:
        from hyperpaint.workflows.scene_files import example_scene

        click.echo(example_scene(), nl=False)
        ctx.exit()


@command(
    renamed={"--paints": "--library"},
    epilog="""\b
Examples:
  hyperpaint render --example > scene.toml                       a car park as a start
  hyperpaint render scene.toml
  hyperpaint render scene.toml --out quick.zarr --samples 8      a first look
  hyperpaint render scene.toml --out scene.zarr --atmosphere noon --picture noon.png
  hyperpaint render scene.toml --library paints.zarr --out again.zarr     with paints of a flight

\b
Then, in Python:
  import xarray as xr, hyperpaint
  line = xr.open_zarr("scene.zarr", group="renders/noon")
  line.paint.reflectance()                                as a flight would recover it
  line.true_reflectance, line.surface_class, line.car_id  the truth
  traced = xr.open_zarr("scene.zarr", group="transport")
  traced.paint.relight(paints={"car_003": "red"}, atmosphere="cloudy")    no tracing again""",
)
@click.argument("scene", metavar="SCENE.toml", type=EXISTING_FILE)
@takes(
    "workflows.rendering:render_scene",
    out={
        "metavar": "SCENE.zarr",
        "type": PLACE,
        "required": False,
        "help": "The store.  [default: SCENE.zarr beside SCENE.toml]",
    },
    samples={"metavar": "N", "help": "Rays a pixel.  [default: as SCENE.toml, or 64]"},
    to={"help": "Product of the camera.  [default: as SCENE.toml, or radiance]"},
    atmospheres={"spelling": "--atmosphere", "metavar": "NAME", "help": "Only this atmosphere; repeatable."},
    library={
        "type": PLACE,
        "help": "Paint the cars with this library: a paint replaces the scene's paint of the same name, "
        "other paints go to the remaining cars.",
    },
    hold_edges={"help": "Extend spectra beyond their last band, and bridge gaps.  [default: as SCENE.toml]"},
    scheduler={"metavar": "ADDRESS", "help": "Compute on this dask.distributed cluster."},
)
@click.option("--picture", metavar="PICTURE", type=FILE, help="Draw the renders side by side (png, pdf ...).")
@click.option(
    "--example",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_example,
    help="Print a commented SCENE.toml and exit.",
)
def render(scene: Path, out: Path | None, picture: Path | None, **options: Any) -> None:
    """Render a synthetic scene: cubes of hundreds of bands, with the truth of every pixel.

    Light is traced once, without spectra, into the group transport; each atmosphere becomes a group
    renders/NAME, a flight line with labels for training: surface_class, paint_id, car_id, instance, purity,
    shadow, and shares of sun, sky, glint and indirect light. Run again, the command resumes an interrupted
    run and leaves a complete store unchanged.
    """
    from hyperpaint.workflows.rendering import draw_renders, run

    out = out or scene.with_suffix(".zarr")
    outcome = run(scene, out, progress=is_watched(), **options)
    say_outcome(outcome)
    if picture is not None:
        draw_renders(out, (*outcome.written, *outcome.unchanged), picture)
        click.echo(f"look at it in {picture}")
