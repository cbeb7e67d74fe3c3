"""The command ``hyperpaint demo``: a simulated collect, processed and compared with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import FAILED_CHECK, FOLDER, is_watched, progress_bar
from .options import command, takes

AT_LEAST_8 = click.IntRange(min=8)


@command(
    epilog="""\b
Example:
  hyperpaint demo --out demo""",
)
@takes(
    "workflows.demonstration:run_demonstration",
    only=["folder", "lines", "bands", "columns", "seed", "scene", "samples", "overwrite"],
    folder={
        "spelling": "--out",
        "type": FOLDER,
        "default": "hyperpaint_demo",
        "help": "Folder of everything that the demo writes.",
    },
    lines={"type": AT_LEAST_8},
    bands={"type": AT_LEAST_8},
    columns={"type": AT_LEAST_8},
    seed={"type": click.IntRange(min=0)},
    scene={"type": click.Choice(["rendered", "plan"])},
    samples={"metavar": "N"},
    overwrite={"help": "Write into a folder that holds other files."},
)
@click.pass_context
def demo(ctx: click.Context, /, folder: Path, **shape: Any) -> None:
    """Simulate a collect, process it as if it were real, and compare with the truth.

    Writes raw files in the instruments' own formats, collect.toml, a store, truth.zarr and a picture into the
    folder. Prints recovered against true reflectance of every material and, of a rendered scene, the
    signature of every paint. Exit status 1 outside tolerance.
    """
    import time

    from hyperpaint.workflows.demonstration import PICTURE, STORE, run_demonstration

    begin = time.perf_counter()
    with progress_bar("simulating") as simulated:
        comparison = run_demonstration(
            folder, **shape, progress=is_watched(), simulated=simulated, say=click.echo
        )
    click.echo(f"\n{time.perf_counter() - begin:.0f} s in all. Now try:")
    click.echo(f"  hyperpaint info {folder / 'collect.toml'}")
    click.echo(f"  hyperpaint verify {folder / STORE}")
    if (folder / PICTURE).is_file():
        click.echo(f"  and look at {folder / PICTURE}; or in Python:")
    else:
        click.echo("  or in Python:")
    click.echo("    import xarray as xr, hyperpaint as hp")
    click.echo(f'    line = xr.open_zarr("{folder / STORE}", group="flightlines/raw_0").paint.reflectance()')
    click.echo(f'    paints = line.paint.signatures(hp.read_regions("{folder / "regions.geojson"}"))')
    click.echo("    print(paints.reflectance.isel(signature=0).to_series())")
    if not comparison.ok:
        ctx.exit(FAILED_CHECK)
