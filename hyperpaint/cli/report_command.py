"""The command ``hyperpaint report``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FAILED_CHECK, PLACE, beside, progress_bar
from .options import command, takes


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
    paint signatures with uncertainty, agreement with references, and the calibration. Parts that cannot be
    read are named on the page and on stderr, with exit status 1.
    """
    from hyperpaint.report.store_report import write_report

    out = out or beside(store, "report.html")
    with progress_bar("drawing") as shown:
        done = write_report(store, out, flightlines=flightlines or None, progress=shown, **options)
    click.echo(
        f"{done.path}: {_listed(done.flightlines, done.maps)}, {done.path.stat().st_size / 1e6:.1f} MB"
    )
    for problem in done.problems:
        click.echo(f"cannot be read: {problem}", err=True)
    if done.problems:
        ctx.exit(FAILED_CHECK)


def _listed(groups: tuple[str, ...], maps: tuple[str, ...]) -> str:
    names = ", ".join(group.rpartition("/")[2] for group in groups)
    lines = f"{len(groups)} flight line{'' if len(groups) == 1 else 's'}" + (f" ({names})" if names else "")
    shown = f"map {', '.join(maps)}" if maps else ""
    return ", ".join(part for part in (lines if groups or not maps else "", shown) if part)
