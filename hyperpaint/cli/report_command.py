"""The command ``hyperpaint report``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FAILED_CHECK, PLACE, beside, is_watched, progress_bar, takes_memory_limit


@click.command(
    "report",
    short_help="Show what a store holds on one page.",
    epilog="""\b
Examples:
  hyperpaint report lot.zarr
  hyperpaint report lot.zarr --out report.html --signatures paints.zarr
  hyperpaint report lot.zarr --out raw_0.html --line raw_0 --overwrite
  hyperpaint report map.zarr --out map.html""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--out", metavar="REPORT.html", type=PLACE, help="The page.  [default: report.html beside STORE.zarr]"
)
@click.option(
    "--line", "flightlines", multiple=True, metavar="ID",
    help="Show this flight line only; may be given several times.",
)  # fmt: skip
@click.option("--signatures", metavar="LIB.zarr", type=EXISTING, help="Show the paints of this library too.")
@click.option(
    "--lines", type=click.IntRange(min=1), default=1000,
    help="Lines of a picture at the most; of a longer flight line every n-th is read.",
)  # fmt: skip
@click.option(
    "--flags/--no-flags", default=True,
    help="Look for glint, shadow and light of neighbours, on lines without such flags.",
)  # fmt: skip
@click.option(
    "--cards", type=click.IntRange(min=0), default=60,
    help="Paints that are shown one by one, at the most: place, pixels used and left out, signature.",
)  # fmt: skip
@click.option(
    "--sun-zenith", type=click.FloatRange(0.0, 90.0), metavar="DEGREE",
    help="Zenith angle of the sun, for the flags.  [default: from time and position of the line]",
)  # fmt: skip
@takes_memory_limit
@click.option("--overwrite", is_flag=True, help="Replace a page that is there.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
@click.pass_context
def make_report(
    ctx: click.Context,
    /,
    store: Path,
    out: Path | None,
    flightlines: tuple[str, ...],
    quiet: bool,
    **options: Any,
) -> None:
    """Show what a store holds on one page of HTML that needs nothing else.

    Of every flight line: true colour, flags, irradiance over time, panels, how reflectance is spread, the
    steps from counts to it, the map, alignment, provenance, and a card of every paint measured on it: place,
    pixels used and left out, signature; then paint signatures with their uncertainty and agreement with
    references, and the calibration, where there are any. What cannot be read is named on the page
    and here, with exit status 1.
    """
    from hyperpaint.report.store_report import write_report

    out = out or beside(store, "report.html")
    with progress_bar("drawing", is_watched(quiet)) as shown:
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
