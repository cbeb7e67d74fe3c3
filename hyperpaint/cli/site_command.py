"""The command ``hyperpaint site``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FAILED_CHECK, FOLDER, is_watched, takes_memory_limit


@click.command(
    "site",
    short_help="Write a page that shows a store in a browser, from any web server.",
    epilog="""\b
Examples:
  hyperpaint site lot.zarr --out page --signatures paints.zarr
  python -m http.server --directory page 8000          then open http://localhost:8000
  aws s3 sync page s3://bucket/lot                     or any other place for files
  hyperpaint site lot.zarr --out page --link https://data.example.org/lot.zarr""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option("--out", metavar="DIR", type=FOLDER, required=True, help="The folder to serve.")
@click.option(
    "--line", "flightlines", multiple=True, metavar="ID",
    help="Show this flight line only; may be given several times.",
)  # fmt: skip
@click.option("--signatures", metavar="LIB.zarr", type=EXISTING, help="Show the paints of this library too.")
@click.option(
    "--link", metavar="URL",
    help="Copy nothing: read the store at this address. A click then reads a chunk of that store, often 8 to "
    "20 MB in place of some 100 kB.",
)  # fmt: skip
@click.option(
    "--lines", type=click.IntRange(min=1), default=4000,
    help="Lines of a picture at the most; of a longer one every n-th is shown, and all can be clicked.",
)  # fmt: skip
@click.option(
    "--flags/--no-flags", default=True,
    help="Look for glint, shadow and light of neighbours, on lines without such flags.",
)  # fmt: skip
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace a site that is there.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
@click.pass_context
def site(
    ctx: click.Context, /, store: Path, out: Path, flightlines: tuple[str, ...], quiet: bool, **options: Any
) -> None:
    """Write a folder that any web server or bucket can serve: the page reads the Zarr store itself.

    Lines and maps in true colour, flags on them, the spectrum of any pixel by a click, paints side by side,
    addresses that can be passed on. No program runs on the server, nothing is loaded from elsewhere, and the
    values are those of the store, bit for bit. store.zarr in the folder is a copy of what the page shows, cut
    into small tiles.
    """
    from hyperpaint.report.static_site import write_site

    done = write_site(store, out, flightlines=flightlines or None, progress=is_watched(quiet), **options)
    names = ", ".join(each.rpartition("/")[2] for each in (*done.flightlines, *done.maps)) or "paints"
    size = sum(file.stat().st_size for file in done.path.rglob("*") if file.is_file())
    click.echo(f"{done.path}: {names}, {size / 1e6:.1f} MB")
    click.echo(f"look at it: python -m http.server --directory {done.path} 8000, then http://localhost:8000")
    for problem in done.problems:
        click.echo(f"cannot be shown: {problem}", err=True)
    if done.problems:
        ctx.exit(FAILED_CHECK)
