"""The command ``hyperpaint calibrate``: a lab sweep to a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, PLACE, progress_bar
from .options import command, takes

SHARE = click.FloatRange(0.0, 1.0)


@command(
    renamed={"--report": "--picture"},
    epilog="""\b
Examples:
  hyperpaint calibrate lab/sweep.zarr --picture calibration.png
  hyperpaint calibrate lab/sweep.zarr --out calibration.zarr --flux-uncertainty 0.02 --overwrite

\b
A collect.toml can also name the sweep itself:
  [calibration]
  sweep = 'lab/sweep.zarr'""",
)
@click.argument("sweep", metavar="SWEEP.zarr", type=EXISTING)
@click.option(
    "--out",
    metavar="CAL.zarr",
    type=PLACE,
    help="The calibration.  [default: calibration.zarr beside SWEEP.zarr]",
)
@takes(
    "calibration.calibrating:calibrate",
    only=[
        "srf_shape",
        "flux_uncertainty",
        "capture_uncertainty",
        "etendue_uncertainty",
        "wavelength_uncertainty",
    ],
    srf_shape={"type": click.Choice(["gaussian", "slit"])},
    flux_uncertainty={"type": SHARE, "help": "Relative standard uncertainty of the power meter."},
    capture_uncertainty={"type": SHARE, "help": "Relative standard uncertainty of the capture fraction."},
    etendue_uncertainty={"type": SHARE, "help": "Relative standard uncertainty of the etendue."},
    wavelength_uncertainty={"type": click.FloatRange(0.0, 10.0), "metavar": "NM"},
)
@click.option("--relative", is_flag=True, help="Gain without scale: capture fraction or etendue are unknown.")
@takes(
    "workflows.laboratory:write_calibration",
    only=["picture", "overwrite"],
    picture={"help": "Draw lamp lines, residuals, smile and gain (png, pdf ...)."},
)
def calibrate(
    sweep: Path, out: Path | None, picture: Path | None, relative: bool, overwrite: bool, **options: Any
) -> None:
    """Turn a monochromator sweep into the calibration of a camera.

    Fits every lamp line over bands; from the fits follow wavelength, width and shape of every band, and the
    gain, with uncertainties. Unreliable steps and elements are named and left out; nothing is extrapolated.

    SWEEP.zarr holds counts (step, band, cross_track), dark_counts, step_wavelength, flux, capture_fraction,
    exposure_time, monochromator_fwhm and etendue, with units.
    """
    from hyperpaint.workflows.laboratory import write_calibration

    out = out or sweep.with_name("calibration.zarr")
    with progress_bar("calibrating") as shown:
        calibration = write_calibration(
            sweep, out, absolute=not relative, picture=picture, overwrite=overwrite, progress=shown, **options
        )
    good = calibration.wavelength[calibration.good]
    click.echo(
        f"{out}: {int(calibration.good.sum())} of {calibration.sizes['band']} bands have a gain", nl=False
    )
    click.echo(f", {float(good.min()):.1f} to {float(good.max()):.1f} nm")
    click.echo(
        f"line shape {calibration.srf_shape}, FWHM {float(calibration.fwhm.median()):.2f} nm, "
        f"smile {float(calibration.wavelength_shift.max() - calibration.wavelength_shift.min()):.2f} nm, "
        f"wavelengths to {float(calibration.wavelength_u):.2g} nm"
    )
    if picture is not None:
        click.echo(f"look at it in {picture}")
