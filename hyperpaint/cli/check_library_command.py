"""The command ``hyperpaint check-library``: a paint library against its specification."""

from __future__ import annotations

from pathlib import Path

import click

from .console import FAILED_CHECK, PLACE
from .options import command


@command(
    "check-library",
    epilog="""\b
Examples:
  hyperpaint check-library paints.zarr
  hyperpaint check-library paints.csv""",
)
@click.argument("library", metavar="LIBRARY", type=PLACE)
@click.pass_context
def check_library(ctx: click.Context, /, library: Path) -> None:
    """Compare a paint library, in any format that hyperpaint reads, with its specification.

    Prints every departure: names, wavelengths, values, spread, uncertainty, and declarations that are
    missing: quantity, specular_component, measurement_geometry, finish, provenance, licence.
    hp.io.declare_library adds them. Exit status 1 where something was found.
    """
    from hyperpaint.io.library import check_library as compare

    report = compare(str(library))
    click.echo(str(report))
    if not report.ok:
        ctx.exit(FAILED_CHECK)
