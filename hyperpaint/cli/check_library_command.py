"""The command ``hyperpaint check-library``: a paint library against its specification."""

from __future__ import annotations

from pathlib import Path

import click

from .console import FAILED_CHECK, PLACE


@click.command(
    "check-library",
    short_help="Is a paint library what its specification says?",
    epilog="""\b
Examples:
  hyperpaint check-library paints.zarr
  hyperpaint check-library paints.csv""",
)
@click.argument("library", metavar="LIB", type=PLACE)
@click.pass_context
def check_library(ctx: click.Context, /, library: Path) -> None:
    """Compare a paint library, in any format that hyperpaint reads, with its specification.

    Shown is every departure: names, wavelengths, values, spread and uncertainty, and what must be said, or
    said to be unknown: quantity, specular_component, measurement_geometry, finish, provenance, licence.
    hp.io.declare_library says it of a library. Exit status 1 where something was found.
    """
    from hyperpaint.io.library import check_library as compare

    report = compare(str(library))
    click.echo(str(report))
    if not report.ok:
        ctx.exit(FAILED_CHECK)
