"""The command ``hyperpaint calibrate``: a lab sweep to a calibration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from .console import EXISTING, FILE, PLACE, is_watched, progress_bar


def _uncertainty(name: str, default: float, text: str) -> Callable[[Any], Any]:
    share = click.FloatRange(0.0, 1.0)
    return click.option(f"--{name}-uncertainty", type=share, metavar="SHARE", default=default, help=text)


@click.command(
    short_help="Turn a lab sweep into a calibration.",
    epilog="""\b
Examples:
  hyperpaint calibrate lab/sweep.zarr --report calibration.png
  hyperpaint calibrate lab/sweep.zarr --out calibration.zarr --flux-uncertainty 0.02 --overwrite

\b
A collect.toml can also name the sweep itself:
  [calibration]
  sweep = 'lab/sweep.zarr'""",
)
@click.argument("sweep", metavar="SWEEP.zarr", type=EXISTING)
@click.option(
    "--out", metavar="CAL.zarr", type=PLACE,
    help="The calibration.  [default: calibration.zarr beside SWEEP.zarr]",
)  # fmt: skip
@click.option(
    "--shape", "srf_shape", type=click.Choice(["gaussian", "slit"]),
    help="Line shape of the camera.  [default: the one that the lines fit better]",
)  # fmt: skip
@_uncertainty("flux", 0.04, "Relative standard uncertainty of the power meter.")
@_uncertainty("capture", 0.0, "The same of the capture fraction.")
@_uncertainty("etendue", 0.0, "The same of the etendue.")
@click.option(
    "--wavelength-uncertainty", type=click.FloatRange(0.0, 10.0), metavar="NM", default=0.1,
    help="Standard uncertainty of the monochromator's dial.",
)  # fmt: skip
@click.option(
    "--report", metavar="PICTURE", type=FILE,
    help="Also draw lines, residuals, smile and gain (png, pdf ...).",
)  # fmt: skip
@click.option(
    "--relative", is_flag=True, help="No capture fraction or etendue: the shape of the gain, without scale."
)
@click.option("--overwrite", is_flag=True, help="Replace a calibration made from something else.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def calibrate(
    sweep: Path, out: Path | None, report: Path | None, relative: bool, quiet: bool, **options: Any
) -> None:
    """Turn a monochromator sweep into the calibration of a camera.

    Fits every line over bands, and makes of them the wavelength of every element, the width and shape of the
    bands, and the gain, with uncertainties. Steps and elements that cannot be trusted are named and left out;
    nothing is extrapolated.

    SWEEP.zarr holds counts (step, band, cross_track), dark_counts, step_wavelength, flux, capture_fraction,
    exposure_time, monochromator_fwhm and etendue, with units.
    """
    from hyperpaint.workflows.laboratory import write_calibration

    out = out or sweep.with_name("calibration.zarr")
    with progress_bar("calibrating", is_watched(quiet)) as shown:
        calibration = write_calibration(
            sweep, out, absolute=not relative, report=report, progress=shown, **options
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
    if report is not None:
        click.echo(f"look at it in {report}")
