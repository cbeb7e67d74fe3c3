"""The command ``hyperpaint render``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING_FILE, FILE, PLACE, is_watched, say_outcome
from .options import command, takes


def _print_example(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        from hyperpaint.workflows.scene_files import example_scene

        click.echo(example_scene(), nl=False)
        ctx.exit()


@command(
    renamed={"--paints": "--library"},
    epilog="""\b
Examples:
  hyperpaint render --example > scene.toml                       a car park to begin with
  hyperpaint render scene.toml
  hyperpaint render scene.toml --out quick.zarr --samples 8      a first look
  hyperpaint render scene.toml --out scene.zarr --atmosphere noon --picture noon.png
  hyperpaint render scene.toml --library paints.zarr --out again.zarr     with paints of a flight

\b
Then, in Python:
  import xarray as xr, hyperpaint
  line = xr.open_zarr("scene.zarr", group="renders/noon")
  line.paint.reflectance()                                as a flight would recover it
  line.true_reflectance, line.surface_class, line.car_id  and what is true
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
        "help": "Paint the cars with this library: a paint replaces the scene's paint of the same name, the "
        "others go to the remaining cars.",
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
