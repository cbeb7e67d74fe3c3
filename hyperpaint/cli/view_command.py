"""The command ``hyperpaint view``."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import click

from .console import EXISTING, PLACE


@click.command(
    short_help="Look at a store in a browser.",
    epilog="""\b
Examples:
  hyperpaint view lot.zarr
  hyperpaint view lot.zarr --group raw_1 --regions cars.geojson
  hyperpaint view lot.zarr --library paints.zarr --port 8000 --no-browser

\b
Then, with what was drawn:
  hyperpaint signatures lot.zarr --regions cars.geojson""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--group", metavar="LINE", help="Flight line that is shown first, such as raw_0.  [default: the first]"
)
@click.option(
    "--regions", metavar="FILE.geojson", type=PLACE,
    help="Regions of the first line to begin with; what is drawn is saved there, regions of other lines are "
    "kept; not replaced if changed elsewhere meanwhile.  [default: STORE-LINE-regions.geojson here]",
)  # fmt: skip
@click.option(
    "--library", metavar="LIB", type=EXISTING,
    help="Paint library to compare with.  [default: the synthetic starter library]",
)  # fmt: skip
@click.option(
    "--port", type=click.IntRange(0, 65535), metavar="PORT", default=0,
    help="0 takes any that is free.",
)  # fmt: skip
@click.option("--browser/--no-browser", default=True, help="Open a browser.")
def view(
    store: Path, group: str | None, regions: Path | None, library: Path | None, port: int, browser: bool
) -> None:
    """Look at the flight lines of a store in a browser, until Ctrl-C.

    Click on the picture for the spectrum of a pixel, drag for the median of a box, with flags, uncertainty
    and the nearest paints of a library. Choose true colour, colour infrared or one band; show flags; draw,
    name, edit and save regions, which `hyperpaint signatures --regions` takes.

    The page is served to this machine only, to those who know its address, which is new with every call. It
    needs `python -m pip install 'hyperpaint[interactive]'`. Of a machine far away forward the same port: ssh
    -L 8000:localhost:8000 HOST, with --port 8000 --no-browser there.
    """
    from hyperpaint.pictures.exploring import serve_explorer

    def announce(address: str) -> None:
        click.echo(f"{address} shows {store}; Ctrl-C ends it")
        if browser:
            webbrowser.open(address)

    serve_explorer(store, group, regions=regions, library=library, port=port, announce=announce)
