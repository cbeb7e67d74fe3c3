"""The commands ``verify`` and ``warm``."""

from __future__ import annotations

from pathlib import Path

import click

from .console import EXISTING_FILE, FAILED_CHECK, PLACE, progress_bar
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
