"""The commands ``verify``, ``croissant`` and ``warm``."""

from __future__ import annotations

from pathlib import Path

import click

from .console import EXISTING_FILE, FAILED_CHECK, FILE, FOLDER, PLACE, progress_bar
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
        from hyperpaint.workflows.input_comparison import compare_inputs

        compared = compare_inputs(store, collect)
        click.echo(str(compared))
        has_faults |= bool(compared.problems)
    if has_faults:
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


@command(
    epilog="""\b
Examples:
  hyperpaint warm                                     after an installation or an update
  NUMBA_CACHE_DIR=/shared/kernels hyperpaint warm     for all nodes of a cluster

\b
In a container image (a Dockerfile):
  ENV NUMBA_CACHE_DIR=/opt/kernels NUMBA_CPU_NAME=generic
  RUN pip install hyperpaint && hyperpaint warm --quiet""",
)
def warm() -> None:
    """Compile the loops that hyperpaint computes with, and keep them on disk: a minute, once.

    Without it the first reflectance on a machine waits some seconds for them, the first render some more. A
    small scene is simulated, processed, flagged, mapped and rendered in a temporary folder: reflectance and
    its uncertainties, smoothing, maps, signatures and renders are then ready. What has been compiled already
    is not compiled again; what is rarely asked for is compiled when it is, as ever.

    Kernels are kept in the folder that NUMBA_CACHE_DIR names; else beside the package; else, where that must
    not be written, in the user's cache folder. Set the same folder for every process that is to find them: it
    may be one that the nodes of a cluster share, and may be read-only afterwards. Each kernel is of one kind
    of processor and one version of hyperpaint, numba and Python; others compile their own beside it. An image
    that is built on one machine and runs on others wants NUMBA_CPU_NAME=generic, or the NUMBA_CPU_NAME and
    NUMBA_CPU_FEATURES that all of them have in common, both when it is built and where it runs.
    """
    from hyperpaint.workflows.kernel_warming import warm_kernels

    with progress_bar("compiling") as progress:
        warmth = warm_kernels(progress)
    done = f"compiled {warmth.kernels} kernels" if warmth.kernels else "all kernels were there already"
    click.echo(f"{done}, for {warmth.processor}, in {warmth.folder.parent}")
