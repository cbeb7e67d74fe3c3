"""The command ``hyperpaint view``."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Any

import click

from .console import EXISTING, PLACE
from .options import command, takes


@command(
    renamed={"--group": "--line"},
    epilog="""\b
Examples:
  hyperpaint view lot.zarr
  hyperpaint view lot.zarr --line raw_1 --regions cars.geojson
  hyperpaint view lot.zarr --library paints.zarr --port 8000 --no-browser

\b
Then, with what was drawn:
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

    The page is served to this machine only, at an address that is new with every call. It needs
    `python -m pip install 'hyperpaint[interactive]'`. From another machine: --port 8000 --no-browser here,
    and ssh -L 8000:localhost:8000 HOST there.
    """
    from hyperpaint.pictures.exploring import serve_explorer

    def announce(address: str) -> None:
        click.echo(f"{address} shows {store}; Ctrl-C ends it")
        if browser:
            webbrowser.open(address)

    serve_explorer(store, announce=announce, **options)
