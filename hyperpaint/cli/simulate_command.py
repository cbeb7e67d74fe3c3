"""The command ``hyperpaint simulate``: a collect with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import FOLDER, given_of, is_watched, progress_bar


@click.command(
    short_help="Write a simulated collect with known truth.",
    epilog="""\b
Examples:
  hyperpaint simulate sim --lines 2000
  hyperpaint simulate sim --sky near_sunset --samples 64
  hyperpaint simulate sim --shape slit --smile 1.5 --cloud 0.6 4 2 --dropped 12
  hyperpaint simulate sim --scene checkerboard --swath 5 --wobble rough
  hyperpaint simulate sim --no-noise --no-smile --seed 7 --overwrite""",
)
@click.argument("folder", metavar="DIR", type=FOLDER)
@click.option("--lines", default=512, type=int, help="Scan lines.")
@click.option("--bands", default=272, type=int, help="Spectral bands.")
@click.option("--columns", default=320, type=int, help="Columns.")
@click.option("--seed", default=0, type=int, help="Random seed; same seed, same files.")
@click.option(
    "--scene", type=click.Choice(["rendered", "plan", "checkerboard"]), default="rendered",
    help="A car park of triangles whose light is traced, a flat picture, or squares of known corners.",
)  # fmt: skip
@click.option(
    "--wobble", type=click.Choice(["none", "slow", "calm", "rough"]),
    help="How the platform moves about its course.  [default: slow]",
)  # fmt: skip
@click.option(
    "--swath", type=float, metavar="M", help="Width of a checkerboard's flight line.  [default: 16]"
)
@click.option("--course", type=float, metavar="DEGREE", help="Course over a checkerboard, from true north.")
@click.option(
    "--boresight", type=float, nargs=3, default=None, metavar="ROLL PITCH HEADING",
    help="Angles of the camera in the platform [degree].",
)  # fmt: skip
@click.option(
    "--lever-arm", type=float, nargs=3, default=None, metavar="FORWARD RIGHT DOWN",
    help="Camera from the point that positions are of [m].",
)  # fmt: skip
@click.option(
    "--navigation-rate", type=int, metavar="HZ", help="Rows of navigation a second.  [default: 100]"
)
@click.option("--samples", type=int, metavar="N", help="Rays a pixel of a rendered scene.  [default: 16]")
@click.option(
    "--sky", type=click.Choice(["clear", "near_sunset", "overcast"]), help="Kind of light.  [default: clear]"
)
@click.option(
    "--fleet", type=click.Choice(["solid", "real"]),
    help="Paints of a rendered scene: fourteen without flakes, or what is seen on roads.  [default: real]",
)  # fmt: skip
@click.option("--coat/--no-coat", default=None, help="Clear coats of a rendered scene, or Lambert paints.")
@click.option(
    "--neighbours/--no-neighbours", default=None, help="Trees, a wall and lamps around a rendered scene."
)
@click.option("--cubes", type=int, help="Cubes the flight is cut into.")
@click.option(
    "--shape", "srf_shape", type=click.Choice(["gaussian", "slit"]), help="Line shape of the camera."
)
@click.option("--fwhm", "fwhm_nm", type=float, metavar="NM", help="Width of the camera's bands.")
@click.option(
    "--smile", "smile_nm", type=float, metavar="NM", help="Wavelength shift at the edge of the swath."
)
@click.option("--no-smile", "smile_nm", flag_value=0.0, type=float, help="The same as --smile 0.")
@click.option(
    "--psf-across", "psf_across_columns", type=float, metavar="COLUMNS",
    help="Full width of the point spread across the track.  [default: 0]",
)  # fmt: skip
@click.option("--psf-along", "psf_along_lines", type=float, metavar="LINES", help="The same along the track.")
@click.option(
    "--keystone", "keystone_columns", type=float, metavar="COLUMNS",
    help="Columns by which the last band's image lies right of the middle band's.",
)  # fmt: skip
@click.option("--stray-light", type=float, metavar="SHARE", help="Light scattered into all bands.")
@click.option("--pedestal", type=float, metavar="COUNTS", help="Counts of every frame but the dark ones.")
@click.option("--masked-columns", type=int, metavar="N", help="Columns at either edge that see no light.")
@click.option("--noise/--no-noise", default=None, help="Shot and read noise in the scene.")
@click.option("--dark-noise/--no-dark-noise", default=None, help="Read noise in the dark frames.")
@click.option("--bit-depth", type=int, help="Bits of the converter.")
@click.option("--exposure-ms", "exposure_time_ms", type=float, metavar="MS", help="Exposure of a line.")
@click.option("--period-ms", "frame_period_ms", type=float, metavar="MS", help="Time from line to line.")
@click.option("--stamp", type=click.Choice(["start", "mid", "end"]), help="What a frame's stamp marks.")
@click.option("--dropped", type=int, metavar="N", help="Frames that were never recorded.")
@click.option("--bad-elements", type=int, metavar="N", help="Detector elements that see no light.")
@click.option(
    "--glint", type=float, metavar="SHARE", help="Share of a plan's car pixels that mirror the sun."
)
@click.option(
    "--drift", "drift_per_minute", type=float, metavar="SHARE", help="Change of sunlight in a minute."
)
@click.option(
    "--cloud", type=float, nargs=3, default=None, metavar="SHARE RAMP START",
    help="A cloud takes a share of the sun, over a ramp of seconds, from a start in seconds on.",
)  # fmt: skip
@click.option(
    "--gap", "irradiance_gap", type=float, nargs=2, default=None, metavar="START STOP",
    help="Seconds between which no irradiance was logged.",
)  # fmt: skip
@click.option("--irradiance-noise", type=float, metavar="SHARE", help="Noise of each irradiance value.")
@click.option(
    "--clock-offset", "clock_offset_s", type=float, metavar="S",
    help="Seconds the spectrometer's clock is slow.",
)  # fmt: skip
@click.option(
    "--utc-offset", "utc_offset_h", type=float, metavar="H", help="UTC offset of the logging PC [h]."
)
@click.option("--sun-zenith", type=float, metavar="DEGREE", help="Zenith angle of the sun.")
@click.option("--truth/--no-truth", default=True, help="Write truth.zarr.")
@click.option(
    "--sweep", is_flag=True,
    help="Write a lab sweep of the same camera too, which collect.toml then names for its calibration.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace an earlier simulated collect.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def simulate(folder: Path, truth: bool, sweep: bool, overwrite: bool, quiet: bool, **settings: Any) -> None:
    """Write a simulated collect with known truth, in the instruments' own formats.

    DIR receives a Headwall folder (flight), a dark cube, ASD and SVC files, calibration.zarr, truth.zarr,
    regions.geojson (clean pixels of every paint that has enough, for signatures --regions) and collect.toml.
    What is not given has the simulator's default; every effect can be switched off.
    """
    from hyperpaint.simulation import simulate_collect
    from hyperpaint.workflows.demonstration import refuse_foreign

    given = given_of(settings)
    if overwrite:
        refuse_foreign(folder, overwrite=True)
    with progress_bar("simulating", is_watched(quiet)) as simulated:
        path = simulate_collect(
            folder, truth=truth, sweep={} if sweep else None, overwrite=overwrite, progress=simulated, **given
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")
