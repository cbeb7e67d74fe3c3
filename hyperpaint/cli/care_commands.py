"""The commands ``verify`` and ``croissant``."""

from __future__ import annotations

from pathlib import Path

import click

from .console import EXISTING_FILE, FAILED_CHECK, FILE, FOLDER, PLACE
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
    """Read every chunk of a store and compare it with its record; exit status 1 where one is wrong.

    Missing groups are listed, with the command that writes them.
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


@command(
    epilog="""\b
Examples:
  hyperpaint croissant scene.zarr --licence https://spdx.org/licenses/CC-BY-4.0.html
  hyperpaint croissant scene.zarr --licence unknown --creator "A. Painter" --published 2026-11-24""",
)
@click.argument("store", metavar="STORE.zarr", type=FOLDER)
@click.option(
    "--out", metavar="FILE", type=FILE, help="In the store's folder.  [default: croissant.json there]"
)
@click.option(
    "--licence", required=True, help="Address or SPDX name of the licence; unknown where nobody has said."
)
@click.option("--name", help="Of the data set.  [default: that of the store]")
@click.option("--description", help="What it is, for people.  [default: a list of its groups]")
@click.option("--creator", help="Who made it.")
@click.option("--cite-as", metavar="BIBTEX", help="How it is cited.")
@click.option("--version", help="Such as 1.0.0.")
@click.option("--published", metavar="YYYY-MM-DD", help="When it was published.")
@click.option("--url", help="Its page.")
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
def croissant(store: Path, out: Path | None, licence: str, overwrite: bool, **about: str | None) -> None:
    """Write Croissant 1.1 metadata (JSON-LD) of a whole store, a rendered training set above all.

    Every chunk is compared with its record first; a store that is not whole is refused. The document lists
    files, groups and variables with types, shapes and units, and what the groups say of seeds and scene.
    """
    from hyperpaint.workflows.croissant_metadata import write_croissant

    out = out or store.absolute().parent / "croissant.json"
    document = write_croissant(store, out, licence=licence, overwrite=overwrite, **about)
    fields = sum(len(group["field"]) for group in document["recordSet"])
    click.echo(f"{out}: {len(document['recordSet'])} groups, {fields} variables")
    lacking = [key for key in ("creator", "datePublished", "url") if key not in document]
    if lacking:
        click.echo(f"Croissant wants these too before it is published: {', '.join(lacking)}", err=True)
