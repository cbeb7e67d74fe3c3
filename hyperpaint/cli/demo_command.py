"""The command ``hyperpaint demo``: a simulated collect, processed and compared with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import FAILED_CHECK, FOLDER, is_watched, progress_bar


@click.command(
    short_help="Simulate, process and compare with the truth.",
    epilog="""\b
Example:
  hyperpaint demo --out demo""",
)
@click.option(
    "--out", "folder", type=FOLDER, default="hyperpaint_demo", show_default=True,
    help="Folder for everything the demo makes.",
)  # fmt: skip
@click.option("--lines", default=256, type=click.IntRange(min=8), help="Scan lines.")
@click.option("--bands", default=272, type=click.IntRange(min=8), help="Spectral bands.")
@click.option("--columns", default=320, type=click.IntRange(min=8), help="Columns.")
@click.option("--seed", default=0, type=click.IntRange(min=0), help="Random seed; same seed, same files.")
@click.option(
    "--scene", type=click.Choice(["rendered", "plan"]), default="rendered",
    help="A car park of triangles whose light is traced, or a flat picture.",
)  # fmt: skip
@click.option("--samples", type=int, metavar="N", help="Rays a pixel of a rendered scene.  [default: 16]")
@click.option("--overwrite", is_flag=True, help="Write into a folder that holds other files.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
@click.pass_context
def demo(ctx: click.Context, /, folder: Path, overwrite: bool, quiet: bool, **shape: Any) -> None:
    """Simulate a collect, process it as if it were real, and compare with the truth.

    Writes raw files in the instruments' own formats, collect.toml, a store, truth.zarr and a picture into the
    folder. Prints recovered against true reflectance of every material and, of a rendered scene, the
    signature of every paint. Exit status 1 outside tolerance.
    """
    import time

    from hyperpaint.workflows.demonstration import PICTURE, STORE, run_demonstration

    begin = time.perf_counter()
    shown = is_watched(quiet)
    with progress_bar("simulating", shown) as simulated:
        comparison = run_demonstration(
            folder, **shape, overwrite=overwrite, progress=shown, simulated=simulated, say=click.echo
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
