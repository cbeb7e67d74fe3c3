"""The command ``hyperpaint warm``: kernels are compiled once, before anyone waits for them."""

from __future__ import annotations

import click

from .console import progress_bar
from .options import command


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
