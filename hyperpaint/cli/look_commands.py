"""The commands ``view``, ``report`` and ``site``."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FAILED_CHECK, FOLDER, PLACE, beside, is_watched, progress_bar
from .options import command, takes


@command(
    renamed={"--group": "--line"},
    epilog="""\b
Examples:
  hyperpaint view lot.zarr
  hyperpaint view lot.zarr --line raw_1 --regions cars.geojson
  hyperpaint view lot.zarr --library paints.zarr --port 8000 --no-browser

\b
Then, with the regions drawn:
  hyperpaint signatures lot.zarr --regions cars.geojson""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "pictures.exploring:serve_explorer",
    without=["announce"],
    line={"metavar": "ID"},
    regions={"metavar": "FILE.geojson", "type": PLACE},
    library={"type": EXISTING},
    port={"type": click.IntRange(0, 65535), "metavar": "PORT", "help": "0 takes any free port."},
)
@click.option("--browser/--no-browser", default=True, help="Open a browser.")
def view(store: Path, browser: bool, **options: Any) -> None:
    """Look at the flight lines of a store in a browser, until Ctrl-C.

    Click for the spectrum of a pixel, drag for the median of a box, each with flags, uncertainty and the
    nearest paints of a library. Show true colour, colour infrared, single bands or flags; draw, name, edit
    and save regions for `hyperpaint signatures --regions`.

    The page is served to this machine only, at a new address in every call. It needs `python -m pip install
    'hyperpaint[interactive]'`. To see it from another machine: --port 8000 --no-browser here, and ssh -L
    8000:localhost:8000 HOST there.
    """
    from hyperpaint.pictures.exploring import serve_explorer

    def announce(address: str) -> None:
        click.echo(f"{address} shows {store}; Ctrl-C ends it")
        if browser:
            webbrowser.open(address)

    serve_explorer(store, announce=announce, **options)


@command(
    "report",
    renamed={"--signatures": "--library", "--lines": "--max-lines"},
    epilog="""\b
Examples:
  hyperpaint report lot.zarr
  hyperpaint report lot.zarr --out report.html --library paints.zarr
  hyperpaint report lot.zarr --out raw_0.html --line raw_0 --overwrite
  hyperpaint report map.zarr --out map.html""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "report.store_report:write_report",
    out={
        "metavar": "REPORT.html",
        "type": PLACE,
        "required": False,
        "help": "The page.  [default: report.html beside STORE.zarr]",
    },
    library={"type": EXISTING, "help": "Paint library to show as well."},
    max_lines={"type": click.IntRange(min=1)},
    cards={"type": click.IntRange(min=0)},
    sun_zenith={"type": click.FloatRange(0.0, 90.0), "metavar": "DEGREE"},
)
@click.pass_context
def make_report(
    ctx: click.Context,
    /,
    store: Path,
    out: Path | None,
    flightlines: tuple[str, ...],
    **options: Any,
) -> None:
    """Write one self-contained HTML page about a store.

    For every flight line: true colour, flags, irradiance over time, panels, histograms of reflectance, the
    steps from counts to reflectance, map, alignment, provenance, and a card for every paint. For the store:
    paint signatures with uncertainty, agreement with references, and the calibration. Unreadable parts are
    listed on the page and on stderr, with exit status 1.
    """
    from hyperpaint.report.store_report import write_report

    out = out or beside(store, "report.html")
    with progress_bar("drawing") as progress:
        page = write_report(store, out, flightlines=flightlines or None, progress=progress, **options)
    click.echo(
        f"{page.path}: {_listed(page.flightlines, page.maps)}, {page.path.stat().st_size / 1e6:.1f} MB"
    )
    for problem in page.problems:
        click.echo(f"cannot be read: {problem}", err=True)
    if page.problems:
        ctx.exit(FAILED_CHECK)


def _listed(groups: tuple[str, ...], maps: tuple[str, ...]) -> str:
    names = ", ".join(group.rpartition("/")[2] for group in groups)
    lines = f"{len(groups)} flight line{'' if len(groups) == 1 else 's'}" + (f" ({names})" if names else "")
    maps_text = f"map {', '.join(maps)}" if maps else ""
    return ", ".join(text for text in (lines if groups or not maps else "", maps_text) if text)


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

    page = write_site(store, out, flightlines=flightlines or None, progress=is_watched(), **options)
    names = ", ".join(group.rpartition("/")[2] for group in (*page.flightlines, *page.maps)) or "paints"
    size = sum(file.stat().st_size for file in page.path.rglob("*") if file.is_file())
    click.echo(f"{page.path}: {names}, {size / 1e6:.1f} MB")
    click.echo(f"look at it: python -m http.server --directory {page.path} 8000, then http://localhost:8000")
    for problem in page.problems:
        click.echo(f"cannot be shown: {problem}", err=True)
    if page.problems:
        ctx.exit(FAILED_CHECK)
