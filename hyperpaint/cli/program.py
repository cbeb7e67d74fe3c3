"""The command line: ``hyperpaint`` or ``python -m hyperpaint``.

Thin: options in, one function of the package, text out. What is heavy is imported inside a command.

Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from hyperpaint import __version__

from .console import FAILED_CHECK, Program, is_watched, listed, progress_bar
from .export_command import export
from .orthorectify_command import make_map
from .paints_command import list_paints
from .render_command import render
from .report_command import make_report
from .validate_command import validate

__all__ = ["main"]

_FOLDER = click.Path(file_okay=False, path_type=Path)
_INPUT = click.Path(exists=True, path_type=Path)


@click.group(
    cls=Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="""\b
Examples:
  hyperpaint demo --out demo                          see the whole chain on a simulated collect
  hyperpaint info flight/raw_0.hdr                    what is this file?
  hyperpaint info collect.toml                        does everything open, and what would be done?
  hyperpaint calibrate sweep.zarr --out cal.zarr      a lab sweep to a calibration
  hyperpaint process collect.toml --out lot.zarr      raw counts to calibrated reflectance
  hyperpaint verify lot.zarr                          is every chunk of it there and right?
  hyperpaint orthorectify lot.zarr --ground 152.4 --out map.tif   a map (see its --help for the camera)
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr
  hyperpaint validate paints.zarr --reference 'svc/*.sig'
  hyperpaint export paints.zarr --format dirsig --out dirsig
  hyperpaint paints --colour red                      red ones of the synthetic starter library
  hyperpaint report lot.zarr --out report.html        all of it on one page
  hyperpaint render --example > scene.toml            a synthetic scene to begin with
  hyperpaint render scene.toml --out scene.zarr       its cubes, with what is true of every pixel

\b
Then, in Python:
  import xarray as xr, hyperpaint
  line = xr.open_zarr("lot.zarr", group="flightlines/raw_0")
  line.paint.reflectance()                            lazy, from the stored counts
  line.paint.quicklook("line.png")

Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong.""",
)
@click.version_option(__version__, prog_name="hyperpaint")
def main() -> None:
    """Turn the raw counts of a pushbroom camera into calibrated reflectance, in labelled xarray."""


# --- demo and simulate -------------------------------------------------------------------------------------


@main.command(
    short_help="Simulate, process and compare with the truth.",
    epilog="""\b
Example:
  hyperpaint demo --out demo""",
)
@click.option("--out", "folder", required=True, type=_FOLDER, help="Folder for everything the demo makes.")
@click.option("--lines", default=256, show_default=True, type=click.IntRange(min=8), help="Scan lines.")
@click.option("--bands", default=272, show_default=True, type=click.IntRange(min=8), help="Spectral bands.")
@click.option("--columns", default=320, show_default=True, type=click.IntRange(min=8), help="Columns.")
@click.option(
    "--seed",
    default=0,
    show_default=True,
    type=click.IntRange(min=0),
    help="Random seed; same seed, same files.",
)
@click.option(
    "--scene", type=click.Choice(["rendered", "plan"]), default="rendered", show_default=True,
    help="A car park of triangles whose light is traced, or a flat picture.",
)  # fmt: skip
@click.option("--samples", type=int, metavar="N", help="Rays a pixel of a rendered scene.  [default: 16]")
@click.option("--overwrite", is_flag=True, help="Write into a folder that holds other files.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
@click.pass_context
def demo(ctx: click.Context, /, folder: Path, overwrite: bool, quiet: bool, **shape: Any) -> None:
    """Simulate a collect, process it as if it were real, and compare with the truth.

    Writes raw files in the instruments' own formats, collect.toml, a store, truth.zarr and a picture into the
    folder. Prints recovered against true reflectance of every material and, of a rendered scene, the
    signature of every paint. Exit status 1 outside tolerance.
    """
    import time

    from hyperpaint.workflows.demonstration import PICTURE, STORE, run_demonstration

    begin = time.perf_counter()
    shown = is_watched(quiet)
    with progress_bar("simulating", shown) as simulated:
        found = run_demonstration(
            folder, **shape, overwrite=overwrite, progress=shown, simulated=simulated, say=click.echo
        )
    click.echo(f"\n{time.perf_counter() - begin:.0f} s in all. Now try:")
    click.echo(f"  hyperpaint info {folder / 'collect.toml'}")
    click.echo(f"  hyperpaint verify {folder / STORE}")
    if (folder / PICTURE).is_file():
        click.echo(f"  and look at {folder / PICTURE}; or in Python:")
    else:
        click.echo("  or in Python:")
    click.echo("    import xarray as xr, hyperpaint")
    click.echo(f'    line = xr.open_zarr("{folder / STORE}", group="flightlines/raw_0")')
    click.echo("    line.paint.reflectance().reflectance")
    if not found.ok:
        ctx.exit(FAILED_CHECK)


@main.command(
    short_help="Write a simulated collect with known truth.",
    epilog="""\b
Examples:
  hyperpaint simulate sim --lines 2000
  hyperpaint simulate sim --sky near_sunset --samples 64
  hyperpaint simulate sim --shape slit --smile 1.5 --cloud 0.6 4 2 --dropped 12
  hyperpaint simulate sim --scene checkerboard --swath 5 --wobble rough
  hyperpaint simulate sim --no-noise --no-smile --seed 7 --overwrite""",
)
@click.argument("folder", metavar="DIR", type=_FOLDER)
@click.option("--lines", default=512, show_default=True, type=int, help="Scan lines.")
@click.option("--bands", default=272, show_default=True, type=int, help="Spectral bands.")
@click.option("--columns", default=320, show_default=True, type=int, help="Columns.")
@click.option("--seed", default=0, show_default=True, type=int, help="Random seed; same seed, same files.")
@click.option(
    "--scene", type=click.Choice(["rendered", "plan", "checkerboard"]), default="rendered", show_default=True,
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
    "--clock-offset",
    "clock_offset_s",
    type=float,
    metavar="S",
    help="Seconds the spectrometer's clock is slow.",
)
@click.option(
    "--utc-offset", "utc_offset_h", type=float, metavar="H", help="UTC offset of the logging PC [h]."
)
@click.option("--sun-zenith", type=float, metavar="DEGREE", help="Zenith angle of the sun.")
@click.option("--truth/--no-truth", default=True, show_default=True, help="Write truth.zarr.")
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

    given = {name: value for name, value in settings.items() if value is not None}
    if overwrite:
        refuse_foreign(folder, overwrite=True)
    with progress_bar("simulating", is_watched(quiet)) as simulated:
        path = simulate_collect(
            folder,
            truth=truth,
            sweep={} if sweep else None,
            overwrite=overwrite,
            progress=simulated,
            **given,
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")


# --- calibrate ---------------------------------------------------------------------------------------------


@main.command(
    short_help="Turn a lab sweep into a calibration.",
    epilog="""\b
Examples:
  hyperpaint calibrate lab/sweep.zarr --out calibration.zarr --report calibration.png
  hyperpaint calibrate lab/sweep.zarr --out calibration.zarr --flux-uncertainty 0.02 --overwrite

\b
A collect.toml can also name the sweep itself:
  [calibration]
  sweep = 'lab/sweep.zarr'""",
)
@click.argument("sweep", metavar="SWEEP.zarr", type=_INPUT)
@click.option(
    "--out", required=True, metavar="CAL.zarr", type=click.Path(path_type=Path), help="The calibration."
)
@click.option(
    "--shape", "srf_shape", type=click.Choice(["gaussian", "slit"]),
    help="Line shape of the camera.  [default: the one that the lines fit better]",
)  # fmt: skip
@click.option(
    "--flux-uncertainty", type=click.FloatRange(0.0, 1.0), metavar="SHARE", default=0.04, show_default=True,
    help="Relative standard uncertainty of the power meter.",
)  # fmt: skip
@click.option(
    "--capture-uncertainty", type=click.FloatRange(0.0, 1.0), metavar="SHARE", default=0.0, show_default=True,
    help="The same of the capture fraction.",
)  # fmt: skip
@click.option(
    "--etendue-uncertainty", type=click.FloatRange(0.0, 1.0), metavar="SHARE", default=0.0, show_default=True,
    help="The same of the etendue.",
)  # fmt: skip
@click.option(
    "--wavelength-uncertainty", type=click.FloatRange(0.0, 10.0), metavar="NM", default=0.1,
    show_default=True, help="Standard uncertainty of the monochromator's dial.",
)  # fmt: skip
@click.option(
    "--report", metavar="PICTURE", type=click.Path(dir_okay=False, path_type=Path),
    help="Also draw lines, residuals, smile and gain (png, pdf ...).",
)  # fmt: skip
@click.option(
    "--relative", is_flag=True, help="No capture fraction or etendue: the shape of the gain, without scale."
)
@click.option("--overwrite", is_flag=True, help="Replace a calibration made from something else.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def calibrate(
    sweep: Path, out: Path, report: Path | None, relative: bool, quiet: bool, **options: Any
) -> None:
    """Turn a monochromator sweep into the calibration of a camera.

    Fits every line over bands, and makes of them the wavelength of every element, the width and shape of the
    bands, and the gain, with uncertainties. Steps and elements that cannot be trusted are named and left out;
    nothing is extrapolated.

    SWEEP.zarr holds counts (step, band, cross_track), dark_counts, step_wavelength, flux, capture_fraction,
    exposure_time, monochromator_fwhm and etendue, with units.
    """
    from hyperpaint.workflows.laboratory import write_calibration

    with progress_bar("calibrating", is_watched(quiet)) as shown:
        made = write_calibration(sweep, out, absolute=not relative, report=report, progress=shown, **options)
    good = made.wavelength[made.good]
    click.echo(f"{out}: {int(made.good.sum())} of {made.sizes['band']} bands have a gain", nl=False)
    click.echo(f", {float(good.min()):.1f} to {float(good.max()):.1f} nm")
    click.echo(
        f"line shape {made.srf_shape}, FWHM {float(made.fwhm.median()):.2f} nm, "
        f"smile {float(made.wavelength_shift.max() - made.wavelength_shift.min()):.2f} nm, "
        f"wavelengths to {float(made.wavelength_u):.2g} nm"
    )
    if report is not None:
        click.echo(f"look at it in {report}")


# --- process, info, verify ---------------------------------------------------------------------------------


@main.command(
    short_help="Process a collect into one Zarr store.",
    epilog="""\b
Examples:
  hyperpaint process collect.toml --out lot.zarr
  hyperpaint process collect.toml --out lot.zarr --reflectance none     a third of the disk
  hyperpaint process collect.toml --out lot.zarr --scheduler tcp://node0:8786""",
)
@click.argument(
    "collect", metavar="COLLECT.toml", type=click.Path(exists=True, dir_okay=False, path_type=Path)
)
@click.option(
    "--out", required=True, metavar="STORE.zarr", type=click.Path(path_type=Path), help="The store."
)
@click.option(
    "--to", type=click.Choice(["radiance", "reflectance"]), default="reflectance", show_default=True,
    help="Radiance needs no irradiance.",
)  # fmt: skip
@click.option(
    "--reflectance", type=click.Choice(["none", "stored"]), default="stored", show_default=True,
    help="'stored' also writes the computed cube, for other programs; 'none' leaves it to be computed "
    "from counts.",
)  # fmt: skip
@click.option("--scheduler", metavar="ADDRESS", help="Compute on this dask.distributed cluster.")
@click.option(
    "--memory-limit", metavar="SIZE",
    help="Most memory of the process, or of each worker, such as '2 GiB'.  [default: 80% of the available]",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace groups made from other inputs or parameters.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def process(collect: Path, out: Path, quiet: bool, **options: Any) -> None:
    """Process a collect into one Zarr store of calibrated flight lines.

    Everything is checked before anything is written. An interrupted run is resumed by running it again; a
    store that is already complete is left as it is.
    """
    from hyperpaint.workflows.pipeline import run

    done = run(collect, out, progress=is_watched(quiet), **options)
    if not done.written:
        click.echo(f"{out} is already complete: same inputs, same parameters; nothing was done")
        return
    click.echo(f"{out}: wrote {listed(done.written)}")
    if done.kept:
        click.echo(f"{out}: {listed(done.kept)} there already, from the same inputs")


# --- signatures --------------------------------------------------------------------------------------------


@main.command(
    short_help="Turn regions of a store into paint signatures.",
    epilog="""\b
Examples:
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr
  hyperpaint signatures lot.zarr --out paints.zarr                     roofs of cars, proposed by rule
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --keep shadow
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --no-flags
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --smooth box --window 5""",
)
@click.argument("store", metavar="STORE.zarr", type=_INPUT)
@click.option(
    "--regions", metavar="R.geojson", type=_INPUT, help="The regions.  [default: some are proposed by rule]"
)
@click.option(
    "--out", required=True, metavar="LIB.zarr", type=click.Path(path_type=Path), help="The paint library."
)
@click.option(
    "--keep", multiple=True, metavar="FLAG",
    help="Use pixels with this flag, which are left out otherwise, such as shadow.",
)  # fmt: skip
@click.option(
    "--centre", type=click.Choice(["trimmed_mean", "geometric_median", "median"]), default="trimmed_mean",
    show_default=True, help="What stands for a region's pixels.",
)  # fmt: skip
@click.option(
    "--smooth", type=click.Choice(["savitzky-golay", "box"]), help="Smooth spectra.  [default: not at all]"
)
@click.option(
    "--window", type=int, default=11, show_default=True, help="Bands that are smoothed over, an odd number."
)
@click.option("--specular-sky", is_flag=True, help="Subtract the sky that a clear coat mirrors.")
@click.option(
    "--flags/--no-flags", default=True, show_default=True,
    help="Look for glint, shadow and light of neighbours first, on lines where nobody has.",
)  # fmt: skip
@click.option(
    "--sun-zenith", type=click.FloatRange(0.0, 90.0), metavar="DEGREE",
    help="Zenith angle of the sun.  [default: from time and position of the line]",
)  # fmt: skip
@click.option(
    "--diffuse", type=click.Choice(["model", "pvlib", "shadow"]),
    help="Where the part of the sky in the light is known from.  [default: model]",
)  # fmt: skip
@click.option(
    "--glint", type=click.FloatRange(0.0), metavar="SHARE", help="Limit of mirrored sun.  [default: 0.02]"
)
@click.option(
    "--shadow", type=click.FloatRange(0.0), metavar="SHARE", help="Limit of missing beam.  [default: 0.2]"
)
@click.option(
    "--adjacency", type=click.FloatRange(0.0), metavar="SHARE",
    help="Limit of a coloured neighbour's light.  [default: 0.01]",
)  # fmt: skip
@click.option(
    "--members", type=click.IntRange(min=0), default=256, show_default=True,
    help="Pixels of a region that are kept as they are.",
)  # fmt: skip
@click.option(
    "--min-pixels", type=click.IntRange(min=1), default=5, show_default=True,
    help="Pixels that a region must have left.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace a library made from something else.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def signatures(
    store: Path,
    regions: Path | None,
    out: Path,
    smooth: str | None,
    window: int,
    flags: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Turn regions of a processed store into a library of paint signatures.

    Regions are polygons in GeoJSON, x the column and y the line of the cube, each with a property name (and
    flightline, where the store has several). A paint has centre, spread, quantiles, single pixels,
    uncertainty, flags and all that its region says. Left out are saturated pixels, and those in glint, in
    shadow or in a neighbour's light. Lines of which the store does not say where these are, as process leaves
    them, are looked at as a whole first; --no-flags does without.
    """
    from hyperpaint.workflows.signature_files import table_of, write_signatures

    smoothing = None if smooth is None else {"method": smooth, "window": window}
    limits = {name: options.pop(name) for name in ("diffuse", "glint", "shadow", "adjacency")}
    given = {name: value for name, value in limits.items() if value is not None}
    if given and not flags:
        named = ", ".join(f"--{name}" for name in given)
        raise click.UsageError(f"--no-flags looks for nothing; leave out {named}")
    with progress_bar("flags and signatures" if flags else "extracting", is_watched(quiet)) as shown:
        made = write_signatures(
            store, regions, out, smooth=smoothing, flags=given or flags, progress=shown, **options
        )
    click.echo(f"{out}: {made.sizes['paint']} paints, {made.sizes['band']} bands\n{table_of(made)}")


@main.command(
    short_help="Show what a file, collect or store is.",
    epilog="""\b
Examples:
  hyperpaint info collect.toml
  hyperpaint info lot.zarr/flightlines/raw_0""",
)
@click.argument("path", type=_INPUT)
def info(path: Path) -> None:
    """Show what a file or store is: dims, units, wavelengths, times, exposure, completeness.

    PATH is an ENVI header or cube, an ASD file, a text or csv export, a frame index, a navigation record, a
    collect.toml, or a Zarr store or one of its groups. Of a collect everything is opened; shown is what
    `process` would do.
    """
    from .info import describe_path

    click.echo(describe_path(path))


@main.command(
    short_help="Check every chunk of a store against its record.",
    epilog="""\b
Example:
  hyperpaint verify lot.zarr""",
)
@click.argument("store", metavar="STORE.zarr", type=click.Path(path_type=Path))
@click.pass_context
def verify(ctx: click.Context, /, store: Path) -> None:
    """Read every chunk of a store and compare it with its record; exit status 1 where one is wrong."""
    from hyperpaint.io.store import verify as verify_store

    report = verify_store(store)
    click.echo(str(report))
    if not report.ok:
        ctx.exit(FAILED_CHECK)


main.add_command(export)
main.add_command(list_paints)
main.add_command(make_map)
main.add_command(render)
main.add_command(make_report)
main.add_command(validate)
