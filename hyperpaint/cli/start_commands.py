"""The commands ``demo``, ``init`` and ``run``."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import click

from .console import (
    EXISTING,
    EXISTING_FILE,
    FAILED_CHECK,
    FILE,
    FOLDER,
    WRONG_INPUT,
    is_watched,
    progress_bar,
)
from .options import command, takes

MIN_SIZE = click.IntRange(min=8)


@command(
    epilog="""\b
Example:
  hyperpaint demo --out demo""",
)
@takes(
    "workflows.demonstration:run_demonstration",
    only=["folder", "lines", "bands", "columns", "seed", "scene", "samples", "overwrite"],
    folder={
        "spelling": "--out",
        "type": FOLDER,
        "default": "hyperpaint_demo",
        "help": "Folder of all files of the demo.",
    },
    lines={"type": MIN_SIZE},
    bands={"type": MIN_SIZE},
    columns={"type": MIN_SIZE},
    seed={"type": click.IntRange(min=0)},
    scene={"type": click.Choice(["rendered", "plan"])},
    samples={"metavar": "N"},
    overwrite={"help": "Write into a folder that holds other files."},
)
@click.pass_context
def demo(ctx: click.Context, /, folder: Path, **shape: Any) -> None:
    """Simulate a collect, process it like a real one, and compare the result with the truth.

    Writes raw files in the instruments' own formats, collect.toml, a store, truth.zarr and a picture into the
    folder. Prints recovered and true reflectance of every material and, for a rendered scene, the signature
    of every paint. Exit status 1 outside tolerance.
    """
    import time

    from hyperpaint.workflows.demonstration import PICTURE, STORE, run_demonstration

    start = time.perf_counter()
    with progress_bar("simulating") as simulated:
        comparison = run_demonstration(
            folder, **shape, progress=is_watched(), simulated=simulated, say=click.echo
        )
    click.echo(f"\n{time.perf_counter() - start:.0f} s in all. Now try:")
    click.echo(f"  hyperpaint info {folder / 'collect.toml'}")
    click.echo(f"  hyperpaint verify {folder / STORE}")
    if (folder / PICTURE).is_file():
        click.echo(f"  and look at {folder / PICTURE}; or in Python:")
    else:
        click.echo("  or in Python:")
    click.echo("    import xarray as xr, hyperpaint as hp")
    click.echo(f'    line = xr.open_zarr("{folder / STORE}", group="flightlines/raw_0").paint.reflectance()')
    click.echo(f'    paints = line.paint.signatures(hp.read_regions("{folder / "regions.geojson"}"))')
    click.echo("    print(paints.reflectance.isel(signature=0).to_series())")
    if not comparison.ok:
        ctx.exit(FAILED_CHECK)


_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


@command(
    epilog="""\b
Examples:
  hyperpaint init 2021_07_20
  hyperpaint init 2021_07_20 --asd ../asd/morning --dark ../dark --calibration ../camera.zarr
  hyperpaint run 2021_07_20/collect.toml""",
)
@click.argument("folder", metavar="FOLDER", type=_FOLDER)
@takes(
    "workflows.field_folder:find_field_files",
    asd={"metavar": "DIR", "type": _FOLDER},
    dark={"metavar": "DIR", "type": _FOLDER},
    calibration={"metavar": "PATH", "type": EXISTING},
)
@click.option("--out", metavar="FILE", type=FILE, help="The file.  [default: collect.toml in FOLDER]")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def init(folder: Path, out: Path | None, overwrite: bool, **folders: Path | None) -> None:
    """Write a commented collect.toml from the files in the folder of a flight.

    Finds raw cubes, their frame indices and navigation, darks, ASD and SVC files and the calibration. Values
    that no file contains are marked "?"; process lists them until they are filled in.
    """
    from hyperpaint.workflows.field_folder import find_field_files, unknown_keys, write_collect_toml

    files = find_field_files(folder, **folders)
    path = write_collect_toml(files, out, overwrite=overwrite)
    cubes = len(files.cubes)
    click.echo(
        f"{path}: {cubes} cube{'' if cubes == 1 else 's'}, {len(files.darks)} dark, "
        f"{len(files.irradiance)} folder of irradiance, {len(files.references)} of references"
    )
    for note in files.notes:
        click.echo(f"note: {note}", err=True)
    if unknown := unknown_keys(path):
        click.echo("fill in, then process:\n  " + "\n  ".join(unknown))
    else:
        target = path.parent if path.name == "collect.toml" else path
        click.echo(f"next: hyperpaint check {path}, then hyperpaint run {target}")


@command(
    epilog="""\b
Examples:
  hyperpaint run 2021_07_20
  hyperpaint run collect.toml --regions cars.geojson --out products
  hyperpaint run collect.toml --skip map --skip dirsig

\b
Maps need the height of the ground [m above the ellipsoid] in collect.toml: [geometry] ground = 152.4""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING)
@takes(
    "workflows.field_day:run_field_day",
    without=["say"],
    out={"metavar": "DIR", "type": FOLDER},
    regions={"metavar": "R.geojson", "type": EXISTING_FILE},
    skip={
        "type": click.Choice(["signatures", "validate", "map", "mosaic", "dirsig", "report"]),
        "help": "Leave out this step; repeatable.",
    },
    specular_sky={"help": "Subtract the sky that clear coats mirror, which contact probes do not see."},
    alignment={"help": "Correct wavelengths between camera and record.  [default: as COLLECT.toml]"},
)
@click.pass_context
def run(ctx: click.Context, /, collect: Path, **options: Any) -> None:
    """Process a field day, from the files of the instruments to the report.

    Writes the store, paint signatures, their comparison with the references, maps, a mosaic, DIRSIG materials
    and a report. A step whose inputs have not changed is not repeated, so that an interrupted run resumes.
    Exit status 1 where the validation fails.
    """
    from hyperpaint.workflows.field_day import StepOutcome, run_field_day

    with contextlib.ExitStack() as bars:

        def progress(step: str) -> Any:
            return bars.enter_context(progress_bar(step))

        def say(outcome: StepOutcome) -> None:
            bars.close()
            text = "see below" if outcome.state == "failed" else outcome.text
            click.echo(f"{outcome.step:<10}  {outcome.state:<9}  {text}")

        day = run_field_day(collect, progress=progress if is_watched() else None, say=say, **options)
    for error in day.errors:
        click.echo(f"error: {error.text(on_command_line=True)}", err=True)
    report = day.out / "report.html"
    if report.exists():
        click.echo(f"look at {report}")
    if day.errors:
        ctx.exit(WRONG_INPUT)
    if day.passed is False:
        ctx.exit(FAILED_CHECK)
