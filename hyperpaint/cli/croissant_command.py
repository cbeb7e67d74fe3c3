"""The command ``hyperpaint croissant``."""

from __future__ import annotations

from pathlib import Path

import click

from .console import FILE, FOLDER
from .options import command


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
