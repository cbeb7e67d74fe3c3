"""All commands but ``info``: from raw cubes to stores and maps, paint libraries, scenes and pages."""

import contextlib
import functools
import json
import re
import textwrap
import time
import webbrowser
from pathlib import Path
from typing import Any

import click
import numpy as np
import xarray as xr

import hyperpaint as hp
import hyperpaint.workflows as workflows
from hyperpaint.base import as_path, byte_size, flags_named, url_of
from hyperpaint.io.maps.map_grids import RASTER_FORMATS
from hyperpaint.io.spectrometers.asd import sniff
from hyperpaint.io.store import outside, virtual_groups
from hyperpaint.pictures.figures import check_picture

from .options import (
    COLLECT,
    EXISTING,
    EXISTING_FILE,
    FAILED_CHECK,
    FILE,
    FOLDER,
    PLACE,
    WRONG_INPUT,
    PathOrUrl,
    beside,
    command,
    end_with_problems,
    is_watched,
    keys_of,
    program_option,
    progress_bar,
    refuse_if,
    refuse_in_store,
    say_outcome,
    say_picture,
    settable,
    takes,
    without_none,
)

MIN_SIZE = click.IntRange(min=8)

# --- from raw cubes to stores and maps ---------------------------------------------------------------------


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
    """Simulate a collect, process it like a real one, and compare paints with a field spectrometer.

    Writes raw files in the instruments' own formats, collect.toml, a store, truth.zarr and a picture into the
    folder. Prints the spectra of the paints as camera and field spectrometer see them, whether they agree,
    then closure: recovered minus simulated reflectance of the same pixels, for every material. Exit status 1
    if the closure is outside tolerance.
    """
    start = time.perf_counter()
    with progress_bar("simulating") as simulated:
        comparison = workflows.demonstration.run_demonstration(
            folder, **shape, progress=is_watched(), simulated=simulated, say=click.echo
        )
    store, picture = (folder / getattr(workflows.demonstration, name) for name in ("STORE", "PICTURE"))
    look = f"and look at {picture}; " if picture.is_file() else ""
    click.echo(f"""
{time.perf_counter() - start:.0f} s in all. Now try:
  hyperpaint info {folder / "collect.toml"}
  hyperpaint verify {store}
  {look}or in Python:
    import xarray as xr, hyperpaint as hp
    line = xr.open_zarr("{store}", group="flightlines/raw_0").paint.reflectance()
    paints = line.paint.flag().paint.signatures(hp.read_regions("{folder / "regions.geojson"}"))
    print(paints.reflectance.swap_dims(band="wavelength").isel(signature=0).to_series())""")
    if not comparison.ok:
        ctx.exit(FAILED_CHECK)


_FOLDER = PathOrUrl(exists=True, file_okay=False, path_type=Path)


@command(
    epilog="""\b
Examples:
  hyperpaint init 2021_07_20
  hyperpaint init 2021_07_20 --asd ../asd/morning --dark ../dark --calibration ../camera.zarr
  hyperpaint init 2021_07_20 --references '../svc/*.sig' --references ../paints.csv
  hyperpaint run 2021_07_20/collect.toml""",
)
@click.argument("folder", metavar="FOLDER", type=_FOLDER)
@takes(
    "workflows.field_folder:find_field_files",
    asd={"metavar": "DIR", "type": _FOLDER},
    dark={"metavar": "DIR", "type": _FOLDER},
    calibration={"metavar": "PATH", "type": EXISTING},
    references={
        "metavar": "PATH",
        "type": PLACE,
        "multiple": True,
        "spelling": "--references --svc",
    },
)
@click.option("--out", metavar="FILE", type=FILE, help="The file.  [default: collect.toml in FOLDER]")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def init(folder: Path, out: Path | None, overwrite: bool, **folders: Any) -> None:
    """Write a commented collect.toml from the files in the folder of a flight.

    Finds raw cubes, their frame indices and navigation, darks, ASD and SVC files and the calibration. Values
    that no file contains are marked "?"; process lists them until they are filled in.
    """
    files = workflows.field_folder.find_field_files(folder, **folders)
    path = workflows.field_folder.write_collect_toml(files, out, overwrite=overwrite)
    click.echo(
        f"{path}: {len(files.cubes)} cube{'' if len(files.cubes) == 1 else 's'}, {len(files.darks)} dark, "
        f"{len(files.irradiance)} folder of irradiance, {len(files.references)} of references"
    )
    for note in files.notes:
        click.echo(f"note: {note}", err=True)
    if unknown := workflows.field_folder.unknown_keys(path):
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
        "type": click.Choice(keys_of("workflows.field_day:STEPS")[1:]),
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
    with contextlib.ExitStack() as bars:

        def progress(step: str) -> Any:
            return bars.enter_context(progress_bar(step))

        def say(outcome: workflows.pipeline.StepOutcome) -> None:
            bars.close()
            text = "see below" if outcome.state == "failed" else outcome.text
            click.echo(f"{outcome.step:<10}  {outcome.state:<9}  {text}")

        day = workflows.field_day.run_field_day(
            collect, progress=progress if is_watched() else None, say=say, **options
        )
    for error in day.errors:
        click.echo(f"error: {error.text(on_command_line=True)}", err=True)
    if (report := day.out / "report.html").exists():
        click.echo(f"look at {report}")
    if day.errors:
        ctx.exit(WRONG_INPUT)
    if day.passed is False:
        text = next(outcome.text for outcome in day.outcomes if outcome.step == "validate")
        click.echo(f"{text}\nall pairs: hyperpaint validate {day.out / 'paints.zarr'}", err=True)
        ctx.exit(FAILED_CHECK)


def _list_kinds(ctx: click.Context, _parameter: click.Parameter, is_set: bool) -> None:
    from hyperpaint.plausibility import KINDS

    if is_set and not ctx.resilient_parsing:
        for kind in KINDS.values():
            texts = (textwrap.indent(textwrap.fill(text, 96), "    ") for text in (kind.meaning, kind.mend))
            click.echo("\n".join([f"{kind.name}  ({'refused' if kind.refused else 'warned of'})", *texts]))
        ctx.exit()


@command(
    epilog="""\b
Examples:
  hyperpaint check collect.toml
  hyperpaint check collect.toml --json                for programs: findings with codes, and what passed
  hyperpaint check --list                             all possible findings by name""",
)
@click.argument("collect", metavar="COLLECT.toml", type=COLLECT)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_kinds,
    help="List all possible findings, and exit.",
)
@click.pass_context
def check(ctx: click.Context, /, collect: Path, as_json: bool, **_options: Any) -> None:
    """Check whether the inputs of a collect are plausible, in seconds.

    Prints every finding: its name, the observed value, the expected value, and the remedy. process and run
    check the same first, except conventions and clocks of the navigation: they stop at findings that make
    results wrong, and warn of others; --accept FINDING accepts a finding. Exit status 1 if there are
    findings.
    """
    judged = workflows.collects.check_collect(collect, passed=True)
    findings = [finding for finding in judged if not finding.passes]
    if as_json:
        rows: dict[str, list[dict[str, str]]] = {"findings": [], "passed": []}
        for finding in judged:
            facts = {
                "code": finding.kind.name,
                "line": finding.line,
                "found": finding.found,
                "expected": finding.expected,
            }
            if not finding.passes:
                state = "wrong" if finding.kind.refused else "doubtful"
                facts |= {"kind": state, "likely_cause": finding.kind.meaning, "mend": finding.kind.mend}
            rows["passed" if finding.passes else "findings"].append(facts)
        click.echo(json.dumps({"collect": str(collect), **rows}, indent=1, ensure_ascii=False))
    for finding in [] if as_json else findings:
        click.echo(f"{'wrong' if finding.kind.refused else 'doubtful'}: {finding}")
    if findings:
        ctx.exit(FAILED_CHECK)
    if not as_json:
        click.echo(f"{collect}: no findings; {len(judged)} judgements passed")


@command(
    epilog="""\b
Examples:
  hyperpaint process collect.toml
  hyperpaint process collect.toml --out lot.zarr --reflectance none     a third of the disk
  hyperpaint process collect.toml --out lot.zarr --scheduler tcp://node0:8786""",
)
@click.argument("collect", metavar="COLLECT.toml", type=COLLECT)
@takes(
    "workflows.pipeline:process",
    without=["memory_limit"],
    out={
        "metavar": "STORE.zarr",
        "type": PLACE,
        "required": False,
        "help": "The store.  [default: products/lot.zarr beside COLLECT.toml; run's store has --flags]",
    },
    to={"help": "Radiance needs no irradiance."},
    reflectance={
        "help": "'none' leaves reflectance to be computed from counts: half the time, a third of the disk."
    },
    alignment={"help": "Correct wavelengths between camera and record.  [default: as COLLECT.toml]"},
    codec={"help": "'fast' compresses in half the time and takes 15 to 40 % more disk."},
    layout={"help": "'explore' splits cubes into eight band groups, for pictures of single bands."},
)
def process(collect: Path, out: Path | None, **options: Any) -> None:
    """Process a collect into one Zarr store of calibrated flight lines.

    Everything is checked before anything is written. Run again, the command resumes an interrupted run and
    leaves a complete store unchanged.
    """
    out = out or workflows.field_day.store_of(collect)
    limit = program_option("memory_limit")
    say_outcome(workflows.pipeline.run(collect, out, memory_limit=limit, progress=is_watched(), **options))


@command(
    epilog="""\b
Examples:
  hyperpaint virtual collect.toml --out lot.icechunk
  hyperpaint virtual s3://bucket/flight/collect.toml --out lot.icechunk

\b
Then, in Python:
  import hyperpaint as hp
  line = hp.io.open_virtual("lot.icechunk", "flightlines/raw_0")
  line.paint.reflectance()                            the bits of `process`, from the raw file

Raw files that lie neither beside the store nor below its folder are read only if they are allowed:
  hyperpaint info lot.icechunk --allow /data/day
  hp.io.open_virtual("lot.icechunk", allow="/data/day")""",
)
@click.argument("collect", metavar="COLLECT.toml", type=COLLECT)
@takes(
    "workflows.pipeline:virtualise",
    out={"metavar": "STORE", "type": PLACE, "help": "A folder, a repository of icechunk."},
    alignment={"help": "See process."},
)
def virtual(collect: Path, out: Path, **options: Any) -> None:
    """Write a store of a few kilobytes that refers to the raw cubes of a collect.

    It holds all variables that calibrate the lines; counts stay in the raw files of the camera, and are read
    when a product is computed. Raw files that were moved, truncated or changed are refused.
    """
    say_outcome(workflows.pipeline.virtualise(collect, out, **options))
    _, allow = outside(out, virtual_groups(out))
    if allow:
        shown = allow[0] if len(allow) == 1 else allow
        click.echo(
            f"its raw files are outside its folder: open_virtual needs allow={shown!r}, `info` --allow"
        )


SHARE = click.FloatRange(0.0, 1.0)


@command(
    renamed={"--report": "--picture"},
    epilog="""\b
Examples:
  hyperpaint calibrate lab/sweep.zarr --picture calibration.png
  hyperpaint calibrate lab --out calibration.zarr            cubes, and power_meter.csv that names them
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
    "calibration.calibration_dataset:calibrate",
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
@click.option(
    "--relative", is_flag=True, help="Gain without absolute scale, for unknown capture fraction or etendue."
)
@takes(
    "workflows.collects:write_calibration",
    only=["picture", "overwrite"],
    picture={"help": "Draw lamp lines, residuals, smile and gain (png, pdf ...)."},
)
def calibrate(
    sweep: Path, out: Path | None, picture: Path | None, relative: bool, overwrite: bool, **options: Any
) -> None:
    """Turn a monochromator sweep into the calibration of a camera.

    Fits every lamp line over bands; the fits give wavelength, width and shape of every band, and the gain,
    with uncertainties. Unreliable steps and elements are listed and excluded; nothing is extrapolated.

    SWEEP.zarr holds counts (step, band, cross_track), dark_counts, step_wavelength, flux, capture_fraction,
    exposure_time, monochromator_fwhm and etendue, with units.
    """
    out = out or sweep.with_name("calibration.zarr")
    with progress_bar("calibrating") as progress:
        calibration = workflows.collects.write_calibration(
            sweep,
            out,
            absolute=not relative,
            picture=picture,
            overwrite=overwrite,
            progress=progress,
            **options,
        )
    good_nm = calibration.wavelength[calibration.good]
    click.echo(
        f"{out}: {good_nm.size} of {calibration.sizes['band']} bands have a gain, "
        f"{float(good_nm.min()):.1f} to {float(good_nm.max()):.1f} nm\n"
        f"line shape {calibration.srf_shape}, FWHM {float(calibration.fwhm.median()):.2f} nm, "
        f"smile {float(calibration.wavelength_shift.max() - calibration.wavelength_shift.min()):.2f} nm, "
        f"wavelengths to {float(calibration.wavelength_u):.2g} nm"
    )
    say_picture(picture)


@command(
    "orthorectify",
    epilog="""\b
Examples:
  hyperpaint orthorectify lot.zarr --line raw_0 --ground 152.4 --out map.tif \\
      --set field_of_view=18.9 --set column_order=left_to_right
  hyperpaint orthorectify lot.zarr --line raw_0 --dem dsm.tif --out map.zarr --gsd 0.01 \\
      --set dem_heights=ellipsoid --set focal_length_mm=12 --set pixel_pitch_um=7.4 \\
      --set column_order=left_to_right --set boresight=0.34,-0.95,-0.13
  hyperpaint orthorectify lot.zarr --line raw_0 --out map.tif           a line that is already located

\b
Heights are above the ellipsoid, as from GPS, not above sea level. If the map is shifted or distorted, check
boresight, ground, clock_offset and column_order first. The signs of angles are declared in the table
[navigation] of collect.toml.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option("--line", metavar="ID", help="Flight line of the store.  [default: the only line]")
@click.option(
    "--out",
    metavar="MAP",
    type=PLACE,
    help="map.tif, a GeoTIFF with overviews, or map.zarr.  [default: ID.tif, or map.tif, beside STORE.zarr]",
)
@takes(
    "geometry.orthorectification.mapping:orthorectify",
    only=["gsd", "grid", "method"],
    gsd={"metavar": "M"},
    grid={"help": "North up, or rows across the flight: a smaller file."},
    method={"help": "Unchanged spectra, or interpolated ones."},
)
@click.option(
    "--flags/--no-flags",
    default=None,
    help="Flag an unflagged line first, so that signatures of the map leave out glint and shadow.  "
    "[default: for map.zarr]",
)
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable({"workflows.maps:location_of": []}, without=["flightline", "ground", "dem"])
@takes("workflows.maps:write_map", only=["stac", "geozarr", "overwrite"])
def make_map(
    store: Path,
    line: str | None,
    out: Path | None,
    flags: bool | None,
    settings: dict[str, Any],
    **options: Any,
) -> None:
    """Resample a flight line to a map of square cells, by the position and attitude of its lines.

    A GeoTIFF holds reflectance; a store also holds flags, line times, view angles, and the line and column of
    every cell. Nothing is averaged.
    """
    from hyperpaint.geometry.orthorectification.mapping import describe_swath

    out = out or beside(store, f"{line or 'map'}.tif")
    map_options = {name: options.pop(name) for name in ("stac", "geozarr", "overwrite")}
    is_store = out.suffix.lower() == ".zarr"
    for name, is_set in (("geozarr", map_options["geozarr"]), ("flags", flags)):
        refuse_if(
            is_set and not is_store,
            f"--{name} needs an --out that ends in .zarr, not {out} [option-conflict]",
        )
    _check_map(store, out)
    arguments = {**settings, **without_none(options)}
    with progress_bar("locating") as progress:
        orthomap = workflows.maps.map_of_store(
            store, line, flags=flags if is_store else False, progress=progress, **arguments
        )
    notes = workflows.maps.write_map(orthomap, out, progress=is_watched(), **map_options)
    facts = [_cells(orthomap), describe_swath(orthomap.attrs), notes]
    click.echo(f"{out}: {', '.join(fact for fact in facts if fact)}")


def _check_map(store: Path, out: Path, *companions: Path | None) -> None:
    suffixes = f"{', '.join(RASTER_FORMATS)} or .zarr"
    refuse_if(
        out.suffix.lower() not in (*RASTER_FORMATS, ".zarr"),
        f"--out {out}, expected a name that ends in {suffixes} [suffix-unknown]",
    )
    refuse_in_store(store, out, *companions)


def _cells(orthomap: Any) -> str:
    return f"{orthomap.sizes['y']} x {orthomap.sizes['x']} cells of {orthomap.attrs['gsd']:.4g} m"


@command(
    "mosaic",
    epilog="""\b
Examples:
  hyperpaint mosaic lot.zarr --out mosaic.zarr                       all lines, the steepest view on top
  hyperpaint mosaic lot.zarr --rule unflagged --gsd 0.05 --out mosaic.tif --seamlines seams.geojson
  hyperpaint mosaic lot.zarr --line raw_0 --line raw_3 --ground 152.4 --out two.tif

\b
Options of location default to the table [geometry] of collect.toml. Nothing is averaged; the map stores
the line of every cell. --levelling changes spectra; its factors are stored.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option(
    "--out",
    metavar="MAP",
    type=PLACE,
    help="mosaic.tif, all bands in a GeoTIFF; or mosaic.zarr, with line, flags and angles of every cell.  "
    "[default: mosaic.tif beside STORE.zarr]",
)
@click.option("--line", "lines", multiple=True, metavar="ID", help="Only this line; repeatable.")
@takes(
    "geometry.mosaicking.composing:mosaic",
    only=["rule", "levelling", "gsd"],
    rule={"help": "Line shown in overlaps: the steepest view, unflagged pixels first, or the last flown."},
    levelling={"help": "Multiply each line by one factor a band, so that overlaps agree."},
    gsd={"metavar": "M"},
)
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable({"workflows.maps:location_of": []}, without=["flightline", "ground", "dem"])
@takes(
    "workflows.maps:write_map",
    only=["seams", "overwrite"],
    seams={"spelling": "--seamlines", "metavar": "FILE", "type": FILE},
)
def make_mosaic(
    store: Path,
    out: Path | None,
    lines: tuple[str, ...],
    seams: Path | None,
    overwrite: bool,
    settings: dict[str, Any],
    **options: Any,
) -> None:
    """Combine flight lines of a store on one map with north up; a cell shows a pixel of a single line."""
    out = out or beside(store, "mosaic.tif")
    _check_map(store, out, seams)
    for path in (out, seams):
        refuse_if(
            path is not None and path.exists() and not overwrite,
            f"{path} exists; choose another path, or --overwrite [output-exists]",
        )
    with progress_bar("locating") as progress:
        mosaic = workflows.maps.mosaic_of_store(
            store, lines, progress=progress, **settings, **without_none(options)
        )
    workflows.maps.write_map(mosaic, out, seams=seams, overwrite=overwrite, progress=is_watched())
    click.echo(f"{out}: {_cells(mosaic)}, of the lines {', '.join(mosaic.attrs['flightlines'])}")


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
    report = hp.verify(store)
    click.echo(str(report))
    is_whole = report.ok
    if inputs or collect is not None:
        compared = workflows.pipeline.compare_inputs(store, collect)
        click.echo(str(compared))
        is_whole &= not compared.problems
    if not is_whole:
        ctx.exit(FAILED_CHECK)


@command(
    "signatures",
    epilog="""\b
Examples:
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr
  hyperpaint signatures lot.zarr --out paints.zarr                     roofs of cars, proposed by rule
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --keep shadow
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --no-flags
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr --smooth box --window 5
  hyperpaint signatures lot.zarr --regions qgis.geojson --out paints.zarr --ground 152.4
  hyperpaint signatures map.zarr --regions qgis.geojson --out paints.zarr
""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@click.option("--regions", metavar="R.geojson", type=EXISTING, help="Regions.  [default: proposed by rule]")
@click.option(
    "--out",
    metavar="LIBRARY.zarr",
    type=PLACE,
    help="The paint library.  [default: paints.zarr beside STORE.zarr]",
)
@click.option(
    "--keep",
    multiple=True,
    metavar="FLAG",
    help="Use pixels with this flag, such as shadow, which are excluded by default; repeatable.",
)
@click.option("--smooth", type=click.Choice(["savitzky-golay", "box"]), help="Smooth spectra.")
@click.option("--window", type=int, default=11, help="Window of --smooth [bands], an odd number.")
@takes(
    "paints.signatures.extraction:extract_signatures",
    only=["centre", "specular_sky", "coat", "sun_zenith", "members", "min_pixels", "drop_small"],
    centre={
        "type": click.Choice(["trimmed_mean", "geometric_median", "median"]),
        "help": "Estimator of the centre.",
    },
    specular_sky={"help": "Subtract the sky that a clear coat mirrors."},
    coat={"help": "Correct the transmission of the clear coat.  [default: with --specular-sky]"},
    sun_zenith={
        "type": click.FloatRange(0.0, 90.0),
        "metavar": "DEGREE",
        "help": "Zenith angle of the sun.  [default: from time and position of the line]",
    },
    members={"type": click.IntRange(min=0), "help": "Maximum number of pixels of a region to store."},
    min_pixels={"type": click.IntRange(min=1), "help": "Minimum number of pixels of a region."},
    drop_small={"help": "Leave out regions with fewer pixels, instead of an error."},
)
@click.option("--flags/--no-flags", default=True, help="Flag unflagged lines first.")
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable(
    {
        "workflows.maps:location_of": [],
        "surroundings.surveying:flag": ["glint", "shadow", "adjacency"],
        "paints.signatures.extraction:extract_signatures": ["diffuse", "coat_index"],
    },
    without=["flightline", "ground", "dem"],
)
@click.option("--overwrite", is_flag=True, help="Replace an existing library of other inputs.")
def make_signatures(
    store: Path,
    regions: Path | None,
    out: Path | None,
    smooth: str | None,
    window: int,
    flags: bool,
    settings: dict[str, Any],
    **options: Any,
) -> None:
    """Extract a library of paint signatures from regions of a processed store.

    STORE is the output of process or orthorectify. Regions are polygons in GeoJSON: x the column and y the
    line of the cube, or map coordinates if the file has a crs; a region needs the property name (and
    flightline, if the store has several). A paint has centre, spread, quantiles, pixels, uncertainty, flags
    and the properties of its region. Pixels with saturation, glint, shadow or light of neighbours are
    excluded. --ground, --dem and --set locate the lines for regions in map coordinates.
    """
    smoothing = None if smooth is None else {"method": smooth, "window": window}
    limits: dict[str, Any] = {
        name: settings.pop(name) for name in ("diffuse", "glint", "shadow", "adjacency") if name in settings
    }
    options |= {name: settings.pop(name) for name in ("coat_index",) if name in settings}
    location = without_none({name: options.pop(name) for name in ("ground", "dem")}) | settings
    spellings = ", ".join(f"--set {name}" for name in limits)
    refuse_if(
        limits and not flags,
        f"--no-flags and {spellings} cannot be combined; leave out one of them [option-conflict]",
    )
    out = out or beside(store, "paints.zarr")
    with progress_bar("flags and signatures" if flags else "extracting") as progress:
        library = workflows.field_day.write_signatures(
            store,
            regions,
            out,
            smooth=smoothing,
            flags=limits or flags,
            location=location,
            progress=progress,
            **options,
        )
    if flags and library.attrs["flags"] == workflows.field_day.NOT_DETECTED:
        click.echo(
            "glint, shadow and light of neighbours are not flagged on this map: make it again with "
            "hyperpaint orthorectify --flags, or extract from the store of the flight line",
            err=True,
        )
    for text in library.attrs.get("left_out", ()):
        click.echo(f"left out {text}", err=True)
    table = workflows.field_day.table_of(library)
    click.echo(f"{out}: {library.sizes['signature']} paints, {library.sizes['band']} bands\n{table}")


_PART_PATTERN = re.compile(
    r"(?P<name>[^=]+)=(?P<first>[0-9]+(\.[0-9]*)?)-(?P<last>[0-9]+(\.[0-9]*)?)", re.ASCII
)


def _limits(_ctx: click.Context, _param: click.Parameter, values: tuple[str, ...]) -> dict[str, float] | None:
    # limits by statistic, from NUMBER (for rmse) or NAME=NUMBER
    tolerances = {}
    for value in values:
        name, _, number = value.rpartition("=")
        try:
            tolerances[name or "rmse"] = float(number)
        except ValueError as error:
            raise click.BadParameter(
                f"{value!r}, expected a number of RMSE, or a statistic such as bias=0.01 [number-unreadable]"
            ) from error
    return tolerances or None


def _spectral_parts(
    _ctx: click.Context, _param: click.Parameter, values: tuple[str, ...]
) -> dict[str, tuple[float, float]] | None:
    # first and last wavelength [nm] by name, from NAME=FIRST-LAST
    parts = {}
    for value in values:
        match = _PART_PATTERN.fullmatch(value)
        if match is None:
            raise click.BadParameter(f"{value!r}, expected a part such as red=620-700 [nm] [part-unreadable]")
        parts[match["name"]] = float(match["first"]), float(match["last"])
    return parts or None


@command(
    "validate",
    renamed={"--plot": "--picture"},
    epilog="""\b
Examples:
  hyperpaint validate paints.zarr --reference 'svc/*.sig'
  hyperpaint validate paints.zarr --reference 'svc/*.sig' --panel spectralon.csv --picture agreement.png
  hyperpaint validate paints.zarr --reference 'asd/*.asd' --pairs pairs.csv --out agreement.csv
  hyperpaint validate paints.zarr --tolerance relative=0.1 --tolerance spectral_angle=3
  hyperpaint validate paints.zarr --reference other.zarr --part red=620-700

\b
A paint is compared with the reference that its region names (property reference), else with the reference of
the same name, with or without folder and suffix; --pairs replaces these rules.""",
)
@click.argument("library", metavar="LIBRARY", type=EXISTING)
@click.option(
    "--reference",
    "references",
    multiple=True,
    metavar="FILES",
    help="File, glob or folder of .sig or .asd files, a paint library, or a store; repeatable. "
    " [default: the references in the store of the library]",
)
@click.option("--pairs", metavar="PAIRS.csv", type=EXISTING_FILE, help="Table of paint and reference.")
@click.option(
    "--tolerance",
    multiple=True,
    metavar="LIMIT",
    callback=_limits,
    help="Maximum RMSE of reflectance, or NAME=LIMIT of relative (a share of the paint's level), floor "
    "(added to it), bias, mae, spectral_angle [degree], scale or scale_free_error; "
    "repeatable.  [default: relative=0.05, floor=0.005]",
)
@click.option(
    "--panel",
    metavar="CERTIFICATE.csv",
    type=EXISTING_FILE,
    help="Reflectance of the white panel that the references are relative to.",
)
@click.option(
    "--panel-surface",
    metavar="SURFACE",
    default="lambertian",
    help="Surface of the panel: lambertian, sintered-ptfe, or a table of its factors (csv).  "
    "[default: lambertian]",
)
@click.option(
    "--part",
    "parts",
    multiple=True,
    metavar="NAME=FIRST-LAST",
    callback=_spectral_parts,
    help="Part of the spectrum [nm]; repeatable.  [default: VIS=400-700, NIR=700-1000, all]",
)
@takes(
    "validation.validating:validate",
    only=["reference_fwhm", "require_all"],
    reference_fwhm={
        "type": click.FloatRange(min=0.0, min_open=True),
        "metavar": "NM",
        "help": "FWHM of the references' channels.  [default: from the files, or typical for the instrument]",
    },
    require_all={
        "help": "Fail if any paint has no reference, not only if a reference named by a region is missing."
    },
)
@click.option("--out", metavar="TABLE", type=FILE, help="Write the statistics (csv or json).")
@click.option("--picture", metavar="PICTURE", type=FILE, help="Draw spectra and differences (png, pdf ...).")
@click.option("--overwrite", is_flag=True, help="Replace an existing table.")
@click.pass_context
def validate(
    ctx: click.Context,
    /,
    library: Path,
    references: tuple[str, ...],
    out: Path | None,
    picture: Path | None,
    overwrite: bool,
    **options: Any,
) -> None:
    """Compare a paint library with field spectra of the same paints.

    Both are resampled to common bands with their spectral responses. Prints, for every paint and part of the
    spectrum, bias, RMSE, MAE, spectral angle, scale and scale-free error, with known uncertainties, and pass
    or fail; differences between references of several instruments; and unpaired spectra. Exit status 1
    outside tolerance, if a reference named by a region is missing, or if a part has too few bands to judge.
    """
    if out is not None:
        workflows.field_day.check_table(out, overwrite=overwrite)
    if picture is not None:
        check_picture(picture)
    validation = workflows.field_day.validate_files(library, references, **without_none(options))
    click.echo(validation.table())
    if out is not None:
        workflows.field_day.write_table(validation, out, overwrite=overwrite)
        click.echo(f"all digits are in {out}")
    if picture is not None:
        hp.pictures.validation_figure(validation, picture)
    say_picture(picture)
    end_with_problems(ctx, validation.problems, "not passed")


_RATE = click.FloatRange(0.0, 1.0, min_open=True)


@command(
    "detect",
    renamed={"--rate": "--false-alarm-rate"},
    epilog="""\b
Examples:
  hyperpaint detect lot.zarr --library wanted.zarr --out found.zarr
  hyperpaint detect lot.zarr --library wanted.zarr --false-alarm-rate 1e-2 --others fleet.zarr
  hyperpaint detect lot.zarr --library wanted.zarr --regions cars.geojson     which of the cars?
  hyperpaint detect lot.zarr --library wanted.zarr --background no_cars.geojson
  hyperpaint detect lot.zarr --library wanted.zarr --method matched_filter --unknown-rate 1

\b
Thresholds hold --false-alarm-rate over the background: all pixels that no paint explains. The share of
explained pixels is printed; if it is far above the rate, outline pixels without paints in --background.

\b
At most a share --unknown-rate of the spectra of --others is accepted as a paint. A distance limit of 0 means
that a paint is too similar to others for this rate (most white, silver and grey paints): raise the rate.""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "paints.detection:detect",
    only=["library", "others", "method", "false_alarm_rate", "background", "unknown_rate", "shrinkage"],
    library={"type": EXISTING, "help": "Paints to find: a store of signatures, or a file of spectra."},
    others={
        "metavar": "LIBRARY",
        "type": EXISTING,
        "help": "Other paints that may occur.  [default: the starter library]",
    },
    method={
        "type": click.Choice(["ace", "matched_filter", "spectral_angle"]),
        "help": "Detection statistic.",
    },
    false_alarm_rate={"type": _RATE, "metavar": "SHARE", "help": "Maximum share of the background detected."},
    background={
        "metavar": "R.geojson",
        "type": EXISTING_FILE,
        "help": "Outlines of areas without these paints.  [default: all pixels that no paint explains]",
    },
    unknown_rate={
        "type": _RATE,
        "metavar": "SHARE",
        "help": "Share of other paints accepted; 1 rejects none.  [default: as --false-alarm-rate]",
    },
    shrinkage={"type": click.FloatRange(0.0, 1.0), "help": "Weight of the diagonal in the covariance."},
)
@click.option("--line", metavar="ID", help="The flight line, if the store has several.")
@click.option("--flags", is_flag=True, help="Flag and exclude glint, shadow and mixed pixels.")
@click.option("--keep", multiple=True, metavar="FLAG", help="Search pixels with this flag, such as shadow.")
@click.option("--regions", metavar="R.geojson", type=EXISTING_FILE, help="Cars to list, with their paints.")
@click.option("--out", metavar="FOUND.zarr", type=PLACE, help="[default: detections.zarr beside STORE.zarr]")
@click.option("--overwrite", is_flag=True, help="Replace an existing store.")
def detect_paints(
    store: Path,
    library: Path,
    out: Path | None,
    overwrite: bool,
    background: Path | None,
    **options: Any,
) -> None:
    """Find the paints of a library in a flight line of a store, or in a map."""
    from hyperpaint.paints.signatures import EXCLUDED
    from hyperpaint.validation.validating import aligned

    others, regions, line = (options.pop(name) for name in ("others", "regions", "line"))
    out = out or beside(store, "detections.zarr")
    refuse_in_store(store, out)
    exclude = functools.reduce(lambda flags, kept: flags & ~kept, flags_named(options.pop("keep")), EXCLUDED)
    searched = hp.reflectance(workflows.maps.line_of_store(store, line))
    if options.pop("flags"):
        searched = hp.surroundings.flag(searched)
    is_background = (
        hp.regions.region_mask(_regions_of_line(background, searched), searched) >= 0
        if background is not None
        else None
    )
    detections = hp.paints.detect(
        searched,
        hp.open_library(library),
        exclude=exclude,
        others=None if others is None else hp.open_library(others),
        background=is_background,
        **options,
    )
    hp.to_store(detections, out, overwrite=overwrite, progress=is_watched())
    detections = hp.open_store(out, "")
    detected = detections["detected"]
    numbers = detections["best_paint"].values[detections["detected"].values]
    rows = [
        (str(name), f"{count} pixels", f"threshold {threshold:.4g}", f"distance {limit:.3g} at the most")
        for name, count, threshold, limit in zip(
            detections["signature"].values,
            np.bincount(numbers, minlength=detections.sizes["signature"]),
            detections["score_threshold"].values,
            detections["distance_limit"].values,
            strict=True,
        )
    ]
    checked, checked_u, share = (
        detections[name].item() for name in ("checked_rate", "checked_rate_u", "explained_share")
    )
    rows_below = (
        f"above thresholds from other parts of the line: {checked:.2g} +- {checked_u:.1g} of the background",
        f"excluded from the background, because a paint explains them: {share:.2g} of the pixels",
    )
    summary = "\n".join(f"  {row}" for row in (*aligned(rows, names=4), *rows_below))
    click.echo(f"{out}: {int(detected.sum())} of {detected.size} pixels\n{summary}")
    if regions is not None and (cars := _regions_of_line(regions, searched)):
        table = hp.paints.detected_regions(detections, cars).to_dataframe().reset_index()
        click.echo(table.to_string(index=False, float_format=lambda value: f"{value:.3g}"))


def _regions_of_line(path: Path, line: xr.Dataset) -> hp.Regions:

    regions = hp.read_regions(path)
    name = str(line.attrs.get("name", ""))
    line_regions = tuple(region for region in regions if not name or region.flightline in ("", name))
    if len(line_regions) < len(regions):
        click.echo(
            f"{path}: {len(regions) - len(line_regions)} of {len(regions)} regions are of other flight lines"
        )
    return hp.Regions(line_regions, regions.coordinates, regions.crs)


_LISTED_PROPERTIES = ("finish", "colour", "srgb", "make", "model", "year")


@command(
    "paints",
    epilog="""\b
Examples:
  hyperpaint paints                                        paints of the starter library
  hyperpaint paints --out starter.zarr                     save it, with 24 variants of each paint
  hyperpaint paints --colour "dark red" --limit 5          the most similar colours in daylight
  hyperpaint paints --colour '#27509e' --picture blue.png  the same for sRGB, with spectra
  hyperpaint paints paints.zarr --name '*volvo*'           paints of your library
  hyperpaint paints paints.zarr --like svc/roof.sig --maximum-angle 0.1
  hyperpaint paints --colour grey --limit 8 --out grey.sli for ENVI; also .csv and .zarr

\b
Then, to put them into a simulator:
  hyperpaint export starter.zarr --format dirsig --out dirsig

\b
The starter library is synthetic: forty car paints computed by Kubelka-Munk theory, not measured,
with invented names. reflectance is that of the body under the clear coat; specular_reflectance is
mirrored by clear coat and flakes.""",
)
@click.argument("library", metavar="[LIBRARY]", required=False, type=EXISTING)
@takes(
    "paints.paint_libraries:search_library",
    without=["like"],
    name={"metavar": "TEXT", "help": "Part of the name, or a pattern with * and ?; case is ignored."},
    colour={
        "spelling": "--colour --color",
        "metavar": "COLOUR",
        "help": "A word such as red or 'dark blue', or sRGB as '#27509e'; sorts by colour difference.",
    },
    maximum_colour_difference={
        "spelling": "--maximum-difference",
        "type": click.FloatRange(min=0.0),
        "metavar": "CIEDE2000",
        "help": "Maximum difference from --colour; 1 is just visible, 10 is another shade.",
    },
    maximum_angle={
        "type": click.FloatRange(min=0.0),
        "metavar": "RAD",
        "help": "Maximum spectral angle to --like.",
    },
    limit={"type": click.IntRange(min=1), "metavar": "N", "help": "Maximum number of paints."},
)
@click.option(
    "--like",
    metavar="PAINT",
    help="A paint of the library, or a file of one spectrum (.sig, .asd, .csv); sorts by spectral angle.",
)
@click.option(
    "--members",
    type=click.IntRange(min=0, max=10_000),
    metavar="N",
    help="Variants of each paint of the starter library.  [default: 24]",
)
@click.option("--out", metavar="OUT", type=PLACE, help="Also save the paints found; .zarr, .sli or .csv.")
@click.option(
    "--picture",
    metavar="PICTURE",
    type=FILE,
    help="Also draw their spectra and colours (png, pdf ...).",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing library.")
def list_paints(
    library: Path | None,
    like: str | None,
    members: int | None,
    out: Path | None,
    picture: Path | None,
    overwrite: bool,
    **options: Any,
) -> None:
    """List, search and save the paints of a library.

    LIBRARY is a Zarr store of signatures, or any file of spectra that hyperpaint reads; by default the
    starter library. A paint must meet all conditions.
    """
    from hyperpaint.validation.validating import aligned

    refuse_if(
        options["maximum_angle"] is not None and like is None,
        "--maximum-angle needs --like [argument-missing]",
    )
    refuse_if(
        options["maximum_colour_difference"] is not None and options["colour"] is None,
        "--maximum-difference needs --colour [argument-missing]",
    )
    refuse_if(
        library is not None and members is not None,
        "--members is only for the starter library; leave it out [option-conflict]",
    )
    variants = without_none({"members": members})
    paints = hp.paints.starter_library(**variants) if library is None else hp.open_library(library)
    matches = hp.paints.search_library(paints, like=_spectrum(like, paints), **options)
    count = matches.sizes["signature"]
    click.echo(f"{count} of {paints.sizes['signature']} paints, {paints.sizes['band']} bands")
    if not count:
        click.echo("no paint meets all conditions")
        return
    columns = [[str(name) for name in matches["signature"].values]]
    properties = [
        name
        for name in _LISTED_PROPERTIES
        if name in matches.variables and matches[name].dims == ("signature",)
    ]
    columns += [[str(value) for value in matches[name].values] for name in properties]
    distances = {"colour_difference": "colour difference {:.1f}", "spectral_angle": "angle {:.4f} rad"}
    columns += [
        [text.format(value) for value in matches[name].values]
        for name, text in distances.items()
        if name in matches.coords
    ]
    click.echo("\n".join(f"  {row}" for row in aligned(list(zip(*columns, strict=True)), names=len(columns))))
    if out is not None:
        with progress_bar("writing") as progress:
            path = hp.write_library(matches, out, overwrite=overwrite, progress=progress)
        click.echo(f"saved in {path}")
    if picture is not None:
        hp.pictures.library_overview(matches, picture)
    say_picture(picture, "them")


def _spectrum(like: str | None, paints: xr.Dataset) -> Any:
    # the name of a paint of the library, or an opened file
    if like is None or like in [str(name) for name in paints["signature"].values]:
        return like
    path = as_path(like)
    refuse_if(not path.exists(), f"--like {like!r} is neither a paint nor a file [paint-unknown]")
    is_svc = path.suffix.lower() == ".sig"
    is_asd = not is_svc and path.is_file() and sniff(path) == "binary"
    return (hp.open_svc if is_svc else hp.open_asd if is_asd else hp.open_library)(path)


@command(
    "check-library",
    epilog="""\b
Examples:
  hyperpaint check-library paints.zarr
  hyperpaint check-library paints.csv""",
)
@click.argument("library", metavar="LIBRARY", type=PLACE)
@click.pass_context
def check_library(ctx: click.Context, /, library: Path) -> None:
    """Compare a paint library, in any format that hyperpaint reads, with its specification.

    Prints every departure: names, wavelengths, values, spread, uncertainty, and declarations that are
    missing: quantity, specular_component, measurement_geometry, finish, provenance, licence.
    hp.io.declare_library adds them. Exit status 1 if there are departures.
    """
    report = hp.io.check_library(str(library))
    click.echo(str(report))
    if not report.ok:
        ctx.exit(FAILED_CHECK)


_LIBRARY_FORMATS = ("envi", "csv", "parquet", "zarr")
_SCENE_OPTIONS = {"scene", "wavelength_range", "extrapolate", "gaps", "max_curves"}
_DEFAULT_NAMES = {"envi": "{}.sli", "csv": "{}.csv", "zarr": "{}_export.zarr"}


@command(
    epilog="""\b
Examples:
  hyperpaint export paints.zarr --format dirsig
  hyperpaint export paints.zarr --format dirsig --out dirsig --range 400 1000 --gaps refuse
  hyperpaint export paints.zarr --format dirsig --out dirsig --scene-materials scene.mat
  hyperpaint export paints.zarr --format dirsig --out lot --scene scene.toml
  hyperpaint export paints.zarr --format csv --out paints.csv
  hyperpaint export paints.zarr --format envi --out paints.sli --curves all""",
)
@click.argument("library", metavar="LIBRARY", type=EXISTING)
@click.option(
    "--format",
    "form",
    required=True,
    type=click.Choice(["dirsig", *_LIBRARY_FORMATS]),
    help="DIRSIG materials, an ENVI .sli, a table in CSV or Parquet, or a Zarr store.",
)
@click.option(
    "--out",
    metavar="OUT",
    type=PLACE,
    help="Where to write: a file for envi (.sli), csv and parquet, a new or empty folder for the others.  "
    "[default: beside LIBRARY]",
)
@takes(
    "io.dirsig.dirsig_writing:write_dirsig",
    only=[
        "curves",
        "wavelength_range",
        "extrapolate",
        "gaps",
        "max_curves",
        "specular",
        "surface",
        "scene_materials",
    ],
    curves={
        "type": click.Choice(["centre", "all", "members", "quantiles"]),
        "help": "One spectrum a paint, or with members, quantiles and spread; DIRSIG: not all.  "
        "[default: centre; zarr all; DIRSIG members where there are any]",
    },
    wavelength_range={
        "spelling": "--range",
        "metavar": "LOW HIGH",
        "help": "DIRSIG: wavelengths [nm].  [default: all measured]",
    },
    extrapolate={"help": "DIRSIG: hold curves constant beyond the measured range."},
    gaps={
        "type": click.Choice(["interpolate", "refuse"]),
        "help": "DIRSIG: treatment of bands without values.  [default: interpolate, with a warning]",
    },
    max_curves={
        "type": click.IntRange(1),
        "metavar": "N",
        "help": "DIRSIG: maximum curves a paint.  [default: all; 64 of a scene]",
    },
    specular={
        "type": str,
        "metavar": "F0",
        "default": None,
        "help": "DIRSIG: reflectance of clear coats at normal incidence, or 'library'.  [default: 0]",
    },
    surface={
        "type": click.Choice(["ClassicEmissivity", "SimpleReflectance"]),
        "default": None,
        "help": "DIRSIG: surface model of paints without a coat.  [default: ClassicEmissivity]",
    },
    scene_materials={
        "type": EXISTING_FILE,
        "metavar": "SCENE.mat",
        "help": "DIRSIG: do not reuse IDs of this material list.",
    },
)
@click.option(
    "--scene",
    type=EXISTING_FILE,
    metavar="SCENE.toml",
    help="DIRSIG: write the complete scene of a render, painted with LIBRARY.",
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier export.")
def export(library: Path, form: str, out: Path | None, overwrite: bool, **options: Any) -> None:
    """Write a paint library for simulators and other programs.

    LIBRARY is a Zarr store of signatures, or any file of spectra that hyperpaint reads.
    For DIRSIG every paint becomes emissivity with many curves, so that a texture can draw from them, and a
    MATERIAL_ENTRY; README.txt explains how to add them to a scene.
    """
    out = out or beside(library, _DEFAULT_NAMES.get(form, form).format(library.stem))
    options_set = {name: value for name, value in options.items() if value not in (None, False)}
    curves = options_set.get("curves")
    of_dirsig = [
        f"--{name.replace('_', '-').replace('wavelength-', '')}" for name in options_set if name != "curves"
    ]
    refuse_if(
        of_dirsig and form != "dirsig", f"{', '.join(of_dirsig)} only with --format dirsig [option-conflict]"
    )
    paints = hp.open_library(library)
    with progress_bar("writing") as progress:
        if "scene" in options_set:
            unused = [f"--{name.replace('_', '-')}" for name in sorted(set(options_set) - _SCENE_OPTIONS)]
            refuse_if(unused, f"{', '.join(unused)} not with --scene [option-conflict]")
            scene = workflows.rendering.export_dirsig_scene(
                options_set.pop("scene"),
                out,
                library=paints,
                overwrite=overwrite,
                progress=progress,
                **options_set,
            )
            click.echo(
                f"{out}: {scene.sizes['signature']} materials, {int((scene['curves'] > 1).sum())} of them "
                f"populations, {scene.attrs['faces']} triangles, {scene.attrs['features']}\n"
                f"how to run it, and what was checked: {out / 'README.txt'}"
            )
            return
        if form == "dirsig":
            share = options_set.get("specular", "library")
            if share != "library":
                try:
                    options_set["specular"] = float(share)
                except ValueError:
                    raise click.UsageError(
                        f"--specular {share!r}, expected a number or 'library' [number-unreadable]"
                    ) from None
            materials = hp.write_dirsig(paints, out, overwrite=overwrite, progress=progress, **options_set)
            click.echo(
                f"{out}: {materials.sizes['signature']} paints, {int(materials['curves'].sum())} curves"
            )
            if filled_samples := int(materials["interpolated"].sum()):
                click.echo(
                    f"{int(materials['complete'].sum())} curves are complete; {filled_samples} samples in "
                    "gaps of others interpolated"
                )
            mirrored = "mirrored light {mirror_reflection}, {mirror_reflection_source}"
            click.echo(f"{mirrored.format(**materials.attrs)}\nhow to add them: {out / 'README.txt'}")
            return
        path = hp.write_library(
            paints, out, format=form, curves=curves, overwrite=overwrite, progress=progress
        )
    click.echo(f"{path}: {paints.sizes['signature']} paints, {paints.sizes['band']} bands")
    if curves is None and form in ("envi", "csv", "parquet") and "member_reflectance" in paints.variables:
        click.echo("one row a paint, its centre; --curves all also writes members, quantiles and spread")


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
    regions.geojson (pure, sunlit pixels of the paints, for signatures --regions) and collect.toml. --set
    changes or switches off every effect of camera, light and instruments.
    """
    effects = {**without_none(options), **settings}
    if overwrite:
        workflows.demonstration.refuse_foreign(folder, overwrite=True)
    with progress_bar("simulating") as progress:
        path = hp.simulate_collect(
            folder,
            truth=truth,
            sweep={} if sweep else None,
            overwrite=overwrite,
            progress=progress,
            **effects,
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")
    collect = hp.simulation.collect
    if not len(hp.read_regions(path.parent / collect.REGIONS)):
        side = collect.MIN_SIDE_PIXELS
        click.echo(
            f"note: {collect.REGIONS} has no region: no paint has a clean level area of {side} by {side} "
            "pixels; pass more --columns, or more --lines",
            err=True,
        )


def _print_example(ctx: click.Context, _: click.Parameter, is_set: bool) -> None:
    if is_set and not ctx.resilient_parsing:
        click.echo(workflows.rendering.example_scene(), nl=False)
        ctx.exit()


@command(
    renamed={"--paints": "--library"},
    epilog="""\b
Examples:
  hyperpaint render --example > scene.toml                       a car park as a start
  hyperpaint render scene.toml
  hyperpaint render scene.toml --out quick.zarr --samples 8      a first look
  hyperpaint render scene.toml --out scene.zarr --atmosphere noon --picture noon.png
  hyperpaint render scene.toml --library paints.zarr --out again.zarr     with paints of a flight

\b
Then, in Python:
  import xarray as xr, hyperpaint
  line = xr.open_zarr("scene.zarr", group="renders/noon")
  line.paint.reflectance()                                as a flight would recover it
  line.true_reflectance, line.surface_class, line.car_id  the truth
  traced = xr.open_zarr("scene.zarr", group="transport")
  traced.paint.relight(paints={"car_003": "red"}, atmosphere="cloudy")    no tracing again""",
)
@click.argument("scene", metavar="SCENE.toml", type=EXISTING_FILE)
@takes(
    "workflows.rendering:render_scene",
    out={
        "metavar": "SCENE.zarr",
        "type": PLACE,
        "required": False,
        "help": "The store.  [default: SCENE.zarr beside SCENE.toml]",
    },
    samples={"metavar": "N", "help": "Rays a pixel.  [default: as SCENE.toml, or 64]"},
    to={"help": "Product of the camera.  [default: as SCENE.toml, or radiance]"},
    atmospheres={"spelling": "--atmosphere", "metavar": "NAME", "help": "Only this atmosphere; repeatable."},
    library={
        "type": PLACE,
        "help": "Paint the cars with this library: a paint replaces the scene's paint of the same name, "
        "other paints go to the remaining cars.",
    },
    hold_edges={"help": "Extend spectra beyond their last band, and bridge gaps.  [default: as SCENE.toml]"},
)
@click.option("--picture", metavar="PICTURE", type=FILE, help="Draw the renders side by side (png, pdf ...).")
@click.option(
    "--example",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_example,
    help="Print a commented SCENE.toml and exit.",
)
def render(scene: Path, out: Path | None, picture: Path | None, **options: Any) -> None:
    """Render a synthetic scene: cubes of hundreds of bands, with the truth of every pixel.

    Light is traced once, without spectra, into the group transport; each atmosphere becomes a group
    renders/NAME, a flight line with labels for training: surface_class, paint_id, car_id, instance, purity,
    shadow, and shares of sun, sky, glint and indirect light. Run again, the command resumes an interrupted
    run and leaves a complete store unchanged.
    """
    if picture is not None and picture.suffix:
        check_picture(picture)
    out = out or scene.with_suffix(".zarr")
    outcome = workflows.rendering.run(scene, out, progress=is_watched(), **options)
    say_outcome(outcome)
    if picture is not None:
        workflows.rendering.draw_renders(out, (*outcome.written, *outcome.unchanged), picture)
    say_picture(picture)


@command(
    renamed={"--group": "--line"},
    epilog="""\b
Examples:
  hyperpaint view lot.zarr
  hyperpaint view raw_0.hdr                    raw counts, radiance or reflectance of any ENVI cube
  hyperpaint view lot.zarr --line raw_1 --regions cars.geojson
  hyperpaint view lot.zarr --library paints.zarr --port 8000 --no-browser

\b
Then, with the regions drawn:
  hyperpaint signatures lot.zarr --regions cars.geojson""",
)
@click.argument("store", metavar="STORE.zarr|CUBE.hdr", type=EXISTING)
@takes(
    "pictures.exploring:serve_explorer",
    without=["announce"],
    line={"metavar": "ID"},
    regions={"metavar": "FILE.geojson", "type": PLACE},
    library={"type": EXISTING},
    port={"type": click.IntRange(0, 65535), "metavar": "PORT", "help": "0 takes any free port."},
)
@click.option("--browser/--no-browser", default=True, help="Open a browser.")
def view(store: Path, browser: bool, **options: Any) -> None:
    """Look at an ENVI cube, or the flight lines and maps of a store, in a browser, until Ctrl-C.

    Raw counts, radiance and reflectance are shown in their units, also without wavelengths. Click for the
    spectrum of a pixel, drag for the median of a box, each with flags, uncertainty and the nearest paints of
    a library. Show true colour, colour infrared, single bands or flags; draw, name, edit and save regions for
    `hyperpaint signatures --regions`.

    The page is served to this machine only, at a new address in every call. It needs `python -m pip install
    'hyperpaint[interactive]'`. To see it from another machine: --port 8000 --no-browser here, and ssh -L
    8000:localhost:8000 HOST there.
    """
    from hyperpaint.pictures.exploring import serve_explorer

    def announce(address: str) -> None:
        click.echo(f"{address} shows {store}; Ctrl-C ends it")
        if browser:
            webbrowser.open(address)

    serve_explorer(store, announce=announce, **options)


@command(
    "report",
    renamed={"--signatures": "--library", "--lines": "--max-lines"},
    epilog="""\b
Examples:
  hyperpaint report lot.zarr
  hyperpaint report lot.zarr --out report.html --library paints.zarr
  hyperpaint report lot.zarr --out raw_0.html --line raw_0 --overwrite
  hyperpaint report map.zarr --out map.html""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "report.store_report:write_report",
    without=("validation",),
    out={
        "metavar": "REPORT.html",
        "type": PLACE,
        "required": False,
        "help": "The page.  [default: report.html beside STORE.zarr]",
    },
    library={"type": EXISTING, "help": "Paint library to show as well."},
    max_lines={"type": click.IntRange(min=1)},
    cards={"type": click.IntRange(min=0)},
    sun_zenith={"type": click.FloatRange(0.0, 90.0), "metavar": "DEGREE"},
)
@click.pass_context
def make_report(
    ctx: click.Context,
    /,
    store: Path,
    out: Path | None,
    flightlines: tuple[str, ...],
    **options: Any,
) -> None:
    """Write one self-contained HTML page about a store.

    For every flight line: true colour, flags, irradiance over time, panels, histograms of reflectance, the
    steps from counts to reflectance, map, alignment, provenance, and a card for every paint. For the store:
    paint signatures with uncertainty, agreement with references, and the calibration. Unreadable parts are
    listed on the page and on stderr, with exit status 1.
    """
    out = out or beside(store, "report.html")
    with progress_bar("drawing") as progress:
        page = hp.report.write_report(
            store, out, flightlines=flightlines or None, progress=progress, **options
        )
    names = ", ".join(group.rpartition("/")[2] for group in page.flightlines)
    count = len(page.flightlines)
    lines = f"{count} flight line{'' if count == 1 else 's'}" + (f" ({names})" if names else "")
    maps = f"map {', '.join(page.maps)}" if page.maps else ""
    texts = (lines if count or not maps else "", maps, f"{byte_size(page.path) / 1e6:.1f} MB")
    click.echo(f"{page.path}: {', '.join(filter(None, texts))}")
    end_with_problems(ctx, page.problems, "cannot be read")


@command(
    "site",
    renamed={"--signatures": "--library", "--lines": "--max-lines"},
    epilog="""\b
Examples:
  hyperpaint site lot.zarr --out page --library paints.zarr
  python -m http.server --directory page 8000          then open http://localhost:8000
  aws s3 sync page s3://bucket/lot                     or any other place for files
  hyperpaint site lot.zarr --out page --link https://data.example.org/lot.zarr""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "report.store_report:write_site",
    out={"metavar": "DIR", "type": FOLDER},
    library={"type": EXISTING, "help": "Paint library to show as well."},
    link={"metavar": "URL"},
    max_lines={"type": click.IntRange(min=1)},
)
@click.pass_context
def site(ctx: click.Context, /, store: Path, out: Path, flightlines: tuple[str, ...], **options: Any) -> None:
    """Write a folder that any web server or bucket can serve: the page reads the Zarr store itself.

    The page shows lines and maps in true colour, flags, the spectrum of a clicked pixel, and paints; every
    view has its own address. No program runs on the server, nothing is loaded from elsewhere, and values
    equal those of the store bit for bit. The folder's store.zarr is a copy in small tiles.
    """
    page = hp.report.write_site(store, out, flightlines=flightlines or None, progress=is_watched(), **options)
    names = ", ".join(group.rpartition("/")[2] for group in (*page.flightlines, *page.maps)) or "paints"
    look = (
        f"look at it: python -m http.server --directory {page.path} 8000, then http://localhost:8000"
        if url_of(page.path) is None
        else "look at it: index.html, where the bucket is served by http"
    )
    click.echo(f"{page.path}: {names}, {byte_size(page.path) / 1e6:.1f} MB\n{look}")
    end_with_problems(ctx, page.problems, "cannot be shown")
