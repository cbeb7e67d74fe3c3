"""The command ``hyperpaint render``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING_FILE, FILE, PLACE, is_watched, say_outcome, takes_memory_limit


def _print_example(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        from hyperpaint.workflows.scene_files import example_scene

        click.echo(example_scene(), nl=False)
        ctx.exit()


@click.command(
    short_help="Render a synthetic scene under one or more atmospheres.",
    epilog="""\b
Examples:
  hyperpaint render --example > scene.toml                       a car park to begin with
  hyperpaint render scene.toml
  hyperpaint render scene.toml --out quick.zarr --samples 8      a first look
  hyperpaint render scene.toml --out scene.zarr --atmosphere noon --picture noon.png
  hyperpaint render scene.toml --paints paints.zarr --out again.zarr     with paints of a flight

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
@click.option(
    "--out", metavar="SCENE.zarr", type=PLACE, help="The store.  [default: SCENE.zarr beside SCENE.toml]"
)
@click.option(
    "--samples", type=int, metavar="N", help="Rays of a pixel.  [default: what the file says, or 64]"
)
@click.option(
    "--to", type=click.Choice(["radiance", "counts"]),
    help="What the camera gives.  [default: what the file says, or radiance]",
)  # fmt: skip
@click.option(
    "--atmosphere", "atmospheres", multiple=True, metavar="NAME",
    help="Render under this one of the file only; may be given several times.",
)  # fmt: skip
@click.option(
    "--paints", metavar="LIBRARY", type=PLACE,
    help="Paint the cars with this library (.zarr, .sli, .csv, .ems, .mat, a folder of text ...): a paint "
    "that is called like one of the scene takes its place, the others are dealt to the other cars.",
)  # fmt: skip
@click.option(
    "--hold-edges/--no-hold-edges", default=None,
    help="Hold spectra beyond their last band with values, and bridge bands without.  [default: what the "
    "file says, or not]",
)  # fmt: skip
@click.option(
    "--picture", metavar="PICTURE", type=FILE,
    help="Also draw the renders side by side (png, pdf ...).",
)  # fmt: skip
@click.option("--scheduler", metavar="ADDRESS", help="Compute on this dask.distributed cluster.")
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace groups made from other inputs or parameters.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
@click.option(
    "--example", is_flag=True, is_eager=True, expose_value=False, callback=_print_example,
    help="Print a commented SCENE.toml and exit.",
)  # fmt: skip
def render(scene: Path, out: Path | None, picture: Path | None, quiet: bool, **options: Any) -> None:
    """Render a synthetic scene: cubes of hundreds of bands, with what is true of every pixel.

    Light is traced once, without spectra, into the group transport; each atmosphere then becomes a group
    renders/NAME, a flight line with labels for training: surface_class, paint_id, car_id, instance, purity,
    shadow, shares of sun, sky, glint and indirect light. Everything is checked before anything is written; an
    interrupted run is resumed by running it again, a store that is already complete is left as it is.
    """
    from hyperpaint.workflows.rendering import draw_renders, run

    out = out or scene.with_suffix(".zarr")
    outcome = run(scene, out, progress=is_watched(quiet), **options)
    say_outcome(outcome)
    if picture is not None:
        draw_renders(out, (*outcome.written, *outcome.unchanged), picture)
        click.echo(f"look at it in {picture}")
