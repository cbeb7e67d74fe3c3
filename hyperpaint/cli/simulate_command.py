"""The command ``hyperpaint simulate``: a collect with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import FOLDER, progress_bar, without_none
from .options import command, settable, takes


@command(
    renamed={"--sky": "--atmosphere", "--no-smile": "--set smile_nm=0"},
    epilog="""\b
Examples:
  hyperpaint simulate sim --lines 2000
  hyperpaint simulate sim --atmosphere near_sunset --samples 64
  hyperpaint simulate sim --set srf_shape=slit --set smile_nm=1.5 --set cloud=0.6,4,2 --set dropped=12
  hyperpaint simulate sim --scene checkerboard --set swath=5 --set wobble=rough
  hyperpaint simulate sim --set noise=no --set smile_nm=0 --seed 7 --overwrite""",
)
@click.argument("folder", metavar="DIR", type=FOLDER)
@takes(
    "simulation.collect:simulate_collect",
    only=["lines", "bands", "columns", "seed", "scene"],
    lines={"help": "Scan lines."},
    bands={"help": "Spectral bands."},
    columns={"help": "Columns."},
    scene={
        "type": click.Choice(["rendered", "plan", "checkerboard"]),
        "help": "A ray-traced car park, a flat picture, or squares of known corners.",
    },
)
@takes(
    "simulation.settings:SimulationSettings",
    only=["samples", "sky"],
    samples={"metavar": "N", "default": None, "help": "Rays a pixel of a rendered scene.  [default: 16]"},
    sky={
        "spelling": "--atmosphere",
        "type": click.Choice(["clear", "near_sunset", "overcast"]),
        "default": None,
        "help": "Light on the scene.  [default: clear]",
    },
)
@settable(
    {"simulation.settings:SimulationSettings": []},
    without=["lines", "bands", "columns", "seed", "scene", "samples", "sky", "quantise", "psf_kernel"],
)
@takes(
    "simulation.collect:simulate_collect",
    only=["truth", "sweep", "overwrite"],
    truth={"help": "Write truth.zarr."},
    sweep={"is_flag": True, "default": False, "help": "Write a lab sweep, named by collect.toml."},
)
def simulate(
    folder: Path, truth: bool, sweep: bool, overwrite: bool, settings: dict[str, Any], **options: Any
) -> None:
    """Write a simulated collect with known truth, in the instruments' own formats.

    DIR receives a Headwall folder (flight), a dark cube, ASD and SVC files, calibration.zarr, truth.zarr,
    regions.geojson (clean pixels of the paints, for signatures --regions) and collect.toml. --set changes
    or switches off every effect of camera, light and instruments.
    """
    from hyperpaint.simulation import simulate_collect
    from hyperpaint.workflows.demonstration import refuse_foreign

    effects = {**without_none(options), **settings}
    if overwrite:
        refuse_foreign(folder, overwrite=True)
    with progress_bar("simulating") as simulated:
        path = simulate_collect(
            folder,
            truth=truth,
            sweep={} if sweep else None,
            overwrite=overwrite,
            progress=simulated,
            **effects,
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")
