"""The command line: ``hyperpaint`` or ``python -m hyperpaint``.

Thin: options in, one function of the package, text out. What is heavy is imported inside a command.

Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from . import __version__
from .errors import PaintError, PaintWarning

__all__ = ["main"]

FAILED_CHECK, WRONG_INPUT = 1, 2

_FOLDER = click.Path(file_okay=False, path_type=Path)
_INPUT = click.Path(exists=True, path_type=Path)


class _Program(click.Group):
    """A group of commands whose errors are one readable message, and whose warnings are one line each."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that the context names."""
        with _short_warnings():
            try:
                return super().invoke(ctx)
            except (PaintError, OSError) as error:
                # what Python calls an argument is an option here
                text = "\n".join([str(error), *getattr(error, "__notes__", ())])
                text = text.replace("pass overwrite=True", "pass --overwrite")
                text = text.replace("with overwrite=True", "with --overwrite")
                click.echo(f"error: {text}", err=True)
                ctx.exit(WRONG_INPUT)


@contextlib.contextmanager
def _short_warnings() -> Iterator[None]:
    """Print each of hyperpaint's own warnings once, without Python's file and line."""
    seen: set[str] = set()
    with warnings.catch_warnings():
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if not issubclass(category, PaintWarning):
                otherwise(message, category, *where, **more)
            elif str(message) not in seen:
                seen.add(str(message))
                click.echo(f"warning: {message}", err=True)

        warnings.showwarning = show
        warnings.simplefilter("always", PaintWarning)
        yield


@click.group(
    cls=_Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="""\b
Examples:
  hyperpaint demo --out demo                          see the whole chain on a simulated collect
  hyperpaint info flight/raw_0.hdr                    what is this file?
  hyperpaint info collect.toml                        does everything open, and what would be done?
  hyperpaint calibrate sweep.zarr --out cal.zarr      a lab sweep to a calibration
  hyperpaint process collect.toml --out lot.zarr      raw counts to calibrated reflectance
  hyperpaint verify lot.zarr                          is every chunk of it there and right?

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
@click.option("--overwrite", is_flag=True, help="Write into a folder that holds other files.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
@click.pass_context
def demo(ctx: click.Context, /, folder: Path, overwrite: bool, quiet: bool, **shape: Any) -> None:
    """Simulate a collect, process it as if it were real, and compare with the truth.

    Writes raw files in the instruments' own formats, collect.toml, a store, truth.zarr and a picture into the
    folder, and prints recovered against true reflectance of every paint. Exit status 1 outside tolerance.
    """
    import time

    from .demonstration import PICTURE, STORE, run_demonstration

    begin = time.perf_counter()
    shown = _is_watched(quiet)
    with _bar("simulating", shown) as simulated:
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
  hyperpaint simulate sim --shape slit --smile 1.5 --cloud 0.6 4 2 --dropped 12
  hyperpaint simulate sim --no-noise --no-smile --seed 7 --overwrite""",
)
@click.argument("folder", metavar="DIR", type=_FOLDER)
@click.option("--lines", default=512, show_default=True, type=int, help="Scan lines.")
@click.option("--bands", default=272, show_default=True, type=int, help="Spectral bands.")
@click.option("--columns", default=320, show_default=True, type=int, help="Columns.")
@click.option("--seed", default=0, show_default=True, type=int, help="Random seed; same seed, same files.")
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
@click.option("--glint", type=float, metavar="SHARE", help="Share of car pixels that mirror the sun.")
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

    DIR receives a Headwall folder (flight), a dark cube, ASD files, calibration.zarr, truth.zarr and
    collect.toml. What is not given has the simulator's default; every effect can be switched off.
    """
    from .demonstration import refuse_foreign
    from .simulation import simulate_collect

    given = {name: value for name, value in settings.items() if value is not None}
    if overwrite:
        refuse_foreign(folder, overwrite=True)
    with _bar("simulating", _is_watched(quiet)) as simulated:
        path = simulate_collect(
            folder,
            truth=truth,
            sweep={} if sweep else None,
            overwrite=overwrite,
            progress=simulated,
            **given,
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")


def _is_watched(quiet: bool) -> bool:
    """Tell whether progress is wanted: a log file is no place for a bar."""
    return not quiet and sys.stderr.isatty()


@contextlib.contextmanager
def _bar(label: str, shown: bool) -> Iterator[Any]:
    """Yield what a function calls with (done, to do), to draw a bar on stderr; None where not shown."""
    if not shown:
        yield None
        return
    bars: list[Any] = []
    with contextlib.ExitStack() as stack:

        def update(done: int, total: int) -> None:
            if not bars:
                bar = click.progressbar(length=total, label=label, file=sys.stderr)
                bars.append(stack.enter_context(bar))
            bars[0].update(done - bars[0].pos)
            if done >= total:
                stack.close()

        yield update


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
    from .laboratory import write_calibration

    with _bar("calibrating", _is_watched(quiet)) as shown:
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
    from .pipeline import run

    done = run(collect, out, progress=_is_watched(quiet), **options)
    if not done.written:
        click.echo(f"{out} is already complete: same inputs, same parameters; nothing was done")
        return
    click.echo(f"{out}: wrote {_listed(done.written)}")
    if done.kept:
        click.echo(f"{out}: {_listed(done.kept)} there already, from the same inputs")


def _listed(groups: tuple[str, ...]) -> str:
    return ", ".join(f"/{group}" for group in groups)


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
    from .io.store import verify as verify_store

    report = verify_store(store)
    click.echo(str(report))
    if not report.ok:
        ctx.exit(FAILED_CHECK)
