"""The command ``hyperpaint verify``: every chunk of a store against its record."""

from __future__ import annotations

from pathlib import Path

import click

from .console import FAILED_CHECK, PLACE

__all__ = ["verify"]


@click.command(
    short_help="Check every chunk of a store against its record.",
    epilog="""\b
Example:
  hyperpaint verify lot.zarr""",
)
@click.argument("store", metavar="STORE.zarr", type=PLACE)
@click.pass_context
def verify(ctx: click.Context, /, store: Path) -> None:
    """Read every chunk of a store and compare it with its record; exit status 1 where one is wrong."""
    from hyperpaint.io.store import verify as verify_store

    report = verify_store(store)
    click.echo(str(report))
    if not report.ok:
        ctx.exit(FAILED_CHECK)
