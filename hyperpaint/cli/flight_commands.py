"""The commands from raw cubes to stores and maps: ``check``, ``process``, ``mosaic`` and others."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click

from .console import (
    EXISTING,
    EXISTING_FILE,
    FAILED_CHECK,
    FILE,
    PLACE,
    beside,
    is_watched,
    program_option,
    progress_bar,
    refuse_in_store,
    say_outcome,
    without_none,
)
from .options import command, settable, takes


def _list_kinds(ctx: click.Context, _parameter: click.Parameter, is_set: bool) -> None:
    from hyperpaint.plausibility import KINDS

    if is_set and not ctx.resilient_parsing:
        for kind in KINDS.values():
            click.echo(f"{kind.name}  ({'refused' if kind.refused else 'warned of'})")
            for text in (kind.meaning, kind.mend):
                click.echo(textwrap.fill(text, 100, initial_indent="    ", subsequent_indent="    "))
        ctx.exit()


@command(
    epilog="""\b
Examples:
  hyperpaint check collect.toml
  hyperpaint check --list                             all possible findings by name""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_kinds,
    help="List all possible findings, and exit.",
)
@click.pass_context
def check(ctx: click.Context, /, collect: Path, **_options: Any) -> None:
    """Check whether the inputs of a collect are plausible, in seconds.

    Prints every finding: its name, the observed value, the expected value, and the remedy. process and run
    check the same first: they stop at findings that make results wrong, and warn of others; --accept FINDING
    accepts a finding. Exit status 1 if there are findings.
    """
    from hyperpaint.workflows.pipeline import check_collect

    findings = check_collect(collect)
    for finding in findings:
        click.echo(f"{'wrong' if finding.kind.refused else 'doubtful'}: {finding}")
    if findings:
        ctx.exit(FAILED_CHECK)
    click.echo(f"{collect}: no findings")


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
    from hyperpaint.workflows.field_day import store_of
    from hyperpaint.workflows.pipeline import run

    limit = program_option("memory_limit")
    say_outcome(run(collect, out or store_of(collect), memory_limit=limit, progress=is_watched(), **options))


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
    "workflows.virtual_store:virtualise",
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
    from hyperpaint.io.store.raw_references import outside, virtual_groups
    from hyperpaint.workflows.virtual_store import virtualise

    say_outcome(virtualise(collect, out, **options))
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
    from hyperpaint.workflows.laboratory import write_calibration

    out = out or sweep.with_name("calibration.zarr")
    with progress_bar("calibrating") as progress:
        calibration = write_calibration(
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
        f"{out}: {int(calibration.good.sum())} of {calibration.sizes['band']} bands have a gain", nl=False
    )
    click.echo(f", {float(good_nm.min()):.1f} to {float(good_nm.max()):.1f} nm")
    click.echo(
        f"line shape {calibration.srf_shape}, FWHM {float(calibration.fwhm.median()):.2f} nm, "
        f"smile {float(calibration.wavelength_shift.max() - calibration.wavelength_shift.min()):.2f} nm, "
        f"wavelengths to {float(calibration.wavelength_u):.2g} nm"
    )
    if picture is not None:
        click.echo(f"look at it in {picture}")


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
    from hyperpaint.workflows.maps import map_of_store, write_map

    out = out or beside(store, f"{line or 'map'}.tif")
    map_options = {name: options.pop(name) for name in ("stac", "geozarr", "overwrite")}
    if map_options["geozarr"] and out.suffix.lower() != ".zarr":
        raise click.UsageError(f"--geozarr needs an --out that ends in .zarr, not {out} [option-conflict]")
    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}, expected a name that ends in .tif or .zarr [suffix-unknown]")
    refuse_in_store(store, out)
    arguments = {**settings, **without_none(options)}
    with progress_bar("locating") as progress:
        orthomap = map_of_store(store, line, progress=progress, **arguments)
    notes = write_map(orthomap, out, progress=is_watched(), **map_options)
    rows, cols = orthomap.sizes["y"], orthomap.sizes["x"]
    facts = [f"{rows} x {cols} cells of {orthomap.attrs['gsd']:.4g} m", describe_swath(orthomap.attrs), notes]
    click.echo(f"{out}: {', '.join(fact for fact in facts if fact)}")


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
    from hyperpaint.workflows.maps import mosaic_of_store, write_map

    out = out or beside(store, "mosaic.tif")
    if out.suffix.lower() not in (".tif", ".tiff", ".zarr"):
        raise click.UsageError(f"--out {out}, expected a name that ends in .tif or .zarr [suffix-unknown]")
    refuse_in_store(store, out, seams)
    for path in (out, seams):
        if path is not None and path.exists() and not overwrite:
            raise click.UsageError(f"{path} exists; choose another path, or --overwrite [output-exists]")
    with progress_bar("locating") as progress:
        mosaic = mosaic_of_store(store, lines, progress=progress, **settings, **without_none(options))
    write_map(mosaic, out, seams=seams, overwrite=overwrite, progress=is_watched())
    rows, cols = mosaic.sizes["y"], mosaic.sizes["x"]
    names = ", ".join(mosaic.attrs["flightlines"])
    click.echo(f"{out}: {rows} x {cols} cells of {mosaic.attrs['gsd']:.4g} m, of the lines {names}")
