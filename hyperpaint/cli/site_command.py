"""The command ``hyperpaint site``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FAILED_CHECK, FOLDER, is_watched
from .options import command, takes


@command(
    "site",
    renamed={"--signatures": "--library", "--lines": "--max-lines"},
    epilog="""\b
Examples:
  hyperpaint site lot.zarr --out page --library paints.zarr
  python -m http.server --directory page 8000          then open http://localhost:8000
  aws s3 sync page s3://bucket/lot                     or any other place for files
  hyperpaint site lot.zarr --out page --link https://data.example.org/lot.zarr""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "report.static_site:write_site",
    out={"metavar": "DIR", "type": FOLDER},
    library={"type": EXISTING, "help": "Paint library to show as well."},
    link={"metavar": "URL"},
    max_lines={"type": click.IntRange(min=1)},
)
@click.pass_context
def site(ctx: click.Context, /, store: Path, out: Path, flightlines: tuple[str, ...], **options: Any) -> None:
    """Write a folder that any web server or bucket can serve: the page reads the Zarr store itself.

    The page shows lines and maps in true colour, flags, the spectrum of a clicked pixel, and paints; every
    view has its own address. No program runs on the server, nothing is loaded from elsewhere, and values
    equal those of the store bit for bit. The folder's store.zarr is a copy in small tiles.
    """
    from hyperpaint.report.static_site import write_site

    done = write_site(store, out, flightlines=flightlines or None, progress=is_watched(), **options)
    names = ", ".join(each.rpartition("/")[2] for each in (*done.flightlines, *done.maps)) or "paints"
    size = sum(file.stat().st_size for file in done.path.rglob("*") if file.is_file())
    click.echo(f"{done.path}: {names}, {size / 1e6:.1f} MB")
    click.echo(f"look at it: python -m http.server --directory {done.path} 8000, then http://localhost:8000")
    for problem in done.problems:
        click.echo(f"cannot be shown: {problem}", err=True)
    if done.problems:
        ctx.exit(FAILED_CHECK)
