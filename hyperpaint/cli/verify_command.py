"""The command ``hyperpaint verify``: every chunk of a store against its record."""

from __future__ import annotations

from pathlib import Path

import click

from .console import EXISTING_FILE, FAILED_CHECK, PLACE


@click.command(
    short_help="Check every chunk of a store against its record.",
    epilog="""\b
Examples:
  hyperpaint verify lot.zarr
  hyperpaint verify lot.zarr --inputs     also every byte of the files that it was made from""",
)
@click.argument("store", metavar="STORE.zarr", type=PLACE)
@click.option("--inputs", is_flag=True, help="Read all inputs whole, and compare them with what is stored.")
@click.option(
    "--collect", metavar="COLLECT.toml", type=EXISTING_FILE,
    help="Where the inputs are now.  [default: where they were processed]",
)  # fmt: skip
@click.pass_context
def verify(ctx: click.Context, /, store: Path, inputs: bool, collect: Path | None) -> None:
    """Read every chunk of a store and compare it with its record; exit status 1 where one is wrong.

    The store must also hold the groups that it is to hold: what it lacks is said, and how to finish it.
    """
    from hyperpaint.io.store import verify as verify_store

    report = verify_store(store)
    click.echo(str(report))
    wrong = not report.ok
    if inputs or collect is not None:
        from hyperpaint.workflows.input_comparison import compare_inputs

        compared = compare_inputs(store, collect)
        click.echo(str(compared))
        wrong |= bool(compared.problems)
    if wrong:
        ctx.exit(FAILED_CHECK)
