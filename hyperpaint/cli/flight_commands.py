"""The commands from raw cubes to stores and maps: ``run``, ``check``, ``process``, ``mosaic`` and others."""

import contextlib
import json
import textwrap
import time
from pathlib import Path
from typing import Any

import click

import hyperpaint as hp
import hyperpaint.workflows as workflows
from hyperpaint.io.maps.map_grids import RASTER_FORMATS
from hyperpaint.io.store.raw_references import outside, virtual_groups

from .options import (
    EXISTING,
    EXISTING_FILE,
    FAILED_CHECK,
    FILE,
    FOLDER,
    PLACE,
    WRONG_INPUT,
    beside,
    command,
    is_watched,
    keys_of,
    program_option,
    progress_bar,
    refuse_in_store,
    say_outcome,
    say_picture,
    settable,
    takes,
    without_none,
)

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
    paints = line.paint.signatures(hp.read_regions("{folder / "regions.geojson"}"))
    print(paints.reflectance.swap_dims(band="wavelength").isel(signature=0).to_series())""")
    if not comparison.ok:
        ctx.exit(FAILED_CHECK)


_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


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
        "type": click.Path(path_type=Path),
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
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
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
    judged = workflows.collect_check.check_collect(collect, passed=True)
    findings = [finding for finding in judged if not finding.passes]
    if as_json:
        rows: dict[str, list[dict[str, str]]] = {"findings": [], "passed": []}
        for finding in judged:
            facts = {"code": finding.kind.name, "line": finding.line}
            facts |= {"found": finding.found, "expected": finding.expected}
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
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@takes(
    "workflows.pipeline:process",
    without=["memory_limit"],
    out={
        "metavar": "STORE.zarr",
        "type": PLACE,
        "required": False,
        "help": "The store.  [default: products/lot.zarr beside COLLECT.toml, as run makes it]",
    },
    to={"help": "Radiance needs no irradiance."},
    reflectance={
        "help": "'none' leaves reflectance to be computed from counts: half the time, a third of the disk."
    },
    alignment={"help": "Correct wavelengths between camera and record.  [default: as COLLECT.toml]"},
    scheduler={"metavar": "ADDRESS", "help": "Compute on this dask.distributed cluster."},
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
  hyperpaint virtual collect.toml --out lot.icechunk --prefix s3://bucket/flight

\b
Then, in Python:
  import hyperpaint as hp
  line = hp.io.open_virtual("lot.icechunk", "flightlines/raw_0")
  line.paint.reflectance()                            the bits of `process`, from the raw file

Raw files that lie neither beside the store nor below its folder are read only if they are allowed:
  hyperpaint info lot.icechunk --allow /data/day
  hp.io.open_virtual("lot.icechunk", allow="/data/day")""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@takes(
    "workflows.pipeline:virtualise",
    out={"metavar": "STORE", "type": PLACE, "help": "A folder, a repository of icechunk."},
    prefix={
        "metavar": "URL",
        "help": "Address of the raw files, laid out as below the folder of COLLECT.toml: s3, or http or "
        "https without a port. Region, endpoint and keys of s3 come from the environment (AWS_...).",
    },
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
@click.option(
    "--relative", is_flag=True, help="Gain without absolute scale, for unknown capture fraction or etendue."
)
@takes(
    "workflows.laboratory:write_calibration",
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
        calibration = workflows.laboratory.write_calibration(
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
@takes("workflows.maps:location_of", only=["ground", "dem"])
@settable({"workflows.maps:location_of": []}, without=["flightline", "ground", "dem"])
@takes("workflows.maps:write_map", only=["stac", "geozarr", "overwrite"])
def make_map(
    store: Path, line: str | None, out: Path | None, settings: dict[str, Any], **options: Any
) -> None:
    """Resample a flight line to a map of square cells, by the position and attitude of its lines.

    A GeoTIFF holds reflectance; a store also holds flags, line times, view angles, and the line and column of
    every cell. Nothing is averaged.
    """
    from hyperpaint.geometry.orthorectification.mapping import describe_swath

    out = out or beside(store, f"{line or 'map'}.tif")
    map_options = {name: options.pop(name) for name in ("stac", "geozarr", "overwrite")}
    if map_options["geozarr"] and out.suffix.lower() != ".zarr":
        raise click.UsageError(f"--geozarr needs an --out that ends in .zarr, not {out} [option-conflict]")
    _check_map(store, out)
    arguments = {**settings, **without_none(options)}
    with progress_bar("locating") as progress:
        orthomap = workflows.maps.map_of_store(store, line, progress=progress, **arguments)
    notes = workflows.maps.write_map(orthomap, out, progress=is_watched(), **map_options)
    facts = [_cells(orthomap), describe_swath(orthomap.attrs), notes]
    click.echo(f"{out}: {', '.join(fact for fact in facts if fact)}")


def _check_map(store: Path, out: Path, *companions: Path | None) -> None:
    if out.suffix.lower() not in (*RASTER_FORMATS, ".zarr"):
        suffixes = f"{', '.join(RASTER_FORMATS)} or .zarr"
        raise click.UsageError(f"--out {out}, expected a name that ends in {suffixes} [suffix-unknown]")
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
        if path is not None and path.exists() and not overwrite:
            raise click.UsageError(f"{path} exists; choose another path, or --overwrite [output-exists]")
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
