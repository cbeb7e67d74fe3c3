"""The command ``verify``."""

from __future__ import annotations

from pathlib import Path

import click

from .console import EXISTING_FILE, FAILED_CHECK, PLACE
from .options import command


@command(
    epilog="""\b
Examples:
  hyperpaint verify lot.zarr
  hyperpaint verify lot.zarr --inputs     and every byte of its input files""",
)
@click.argument("store", metavar="STORE.zarr", type=PLACE)
@click.option("--inputs", is_flag=True, help="Read all inputs, and compare them with the stored checksums.")
@click.option(
    "--collect",
    metavar="COLLECT.toml",
    type=EXISTING_FILE,
    help="Where the inputs are now.  [default: where they were processed]",
)
@click.pass_context
def verify(ctx: click.Context, /, store: Path, inputs: bool, collect: Path | None) -> None:
    """Read every chunk of a store and compare it with its checksum; exit status 1 if a chunk is wrong.

    Missing groups are listed, with the command that writes them.
    """
    from hyperpaint.io.store import verify as verify_store

    report = verify_store(store)
    click.echo(str(report))
    has_faults = not report.ok
    if inputs or collect is not None:
        from hyperpaint.workflows.pipeline import compare_inputs

        compared = compare_inputs(store, collect)
        click.echo(str(compared))
        has_faults |= bool(compared.problems)
    if has_faults:
        ctx.exit(FAILED_CHECK)
