"""The commands on paint libraries: ``signatures``, ``validate``, ``detect``, ``paints`` and others."""

import functools
import re
from pathlib import Path
from typing import Any

import click
import numpy as np
import xarray as xr

import hyperpaint as hp
import hyperpaint.workflows as workflows
from hyperpaint.base.schema import flags_named
from hyperpaint.io.spectrometers.asd import sniff
from hyperpaint.pictures.figures import check_picture

from .options import (
    EXISTING,
    EXISTING_FILE,
    FAILED_CHECK,
    FILE,
    PLACE,
    beside,
    command,
    end_with_problems,
    is_watched,
    progress_bar,
    refuse_in_store,
    say_picture,
    settable,
    takes,
    without_none,
)


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
        "surroundings.flags:flag": ["glint", "shadow", "adjacency"],
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
    if limits and not flags:
        spellings = ", ".join(f"--set {name}" for name in limits)
        raise click.UsageError(
            f"--no-flags and {spellings} cannot be combined; leave out one of them [option-conflict]"
        )
    out = out or beside(store, "paints.zarr")
    with progress_bar("flags and signatures" if flags else "extracting") as progress:
        library = workflows.library_files.write_signatures(
            store,
            regions,
            out,
            smooth=smoothing,
            flags=limits or flags,
            location=location,
            progress=progress,
            **options,
        )
    if flags and library.attrs["flags"] == workflows.library_files.NOT_DETECTED:
        click.echo(
            "glint, shadow and light of neighbours are not flagged on a map; signatures from the store of "
            "the flight line exclude them",
            err=True,
        )
    for text in library.attrs.get("left_out", ()):
        click.echo(f"left out {text}", err=True)
    table = workflows.library_files.table_of(library)
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
        workflows.library_files.check_table(out, overwrite=overwrite)
    if picture is not None:
        check_picture(picture)
    validation = workflows.library_files.validate_files(library, references, **without_none(options))
    click.echo(validation.table())
    if out is not None:
        workflows.library_files.write_table(validation, out, overwrite=overwrite)
        click.echo(f"all digits are in {out}")
    if picture is not None:
        hp.pictures.validation_figure(validation, picture)
    say_picture(picture)
    end_with_problems(ctx, validation.problems, "not passed")
    if not validation.passed:
        ctx.exit(FAILED_CHECK)


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
    click.echo(f"{out}: {int(detected.sum())} of {detected.size} pixels\n{_detection_table(detections)}")
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


def _detection_table(detections: xr.Dataset) -> str:
    from hyperpaint.validation.validating import aligned

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
    return "\n".join(f"  {row}" for row in (*aligned(rows, names=4), *rows_below))


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
    "paints.paint_search:search_library",
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

    if options["maximum_angle"] is not None and like is None:
        raise click.UsageError("--maximum-angle needs --like [argument-missing]")
    if options["maximum_colour_difference"] is not None and options["colour"] is None:
        raise click.UsageError("--maximum-difference needs --colour [argument-missing]")
    if library is not None and members is not None:
        raise click.UsageError("--members is only for the starter library; leave it out [option-conflict]")
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
    if "colour_difference" in matches.coords:
        columns.append([f"colour difference {value:.1f}" for value in matches["colour_difference"].values])
    if "spectral_angle" in matches.coords:
        columns.append([f"angle {value:.4f} rad" for value in matches["spectral_angle"].values])
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
    path = Path(like)
    if not path.exists():
        raise click.UsageError(f"--like {like!r} is neither a paint nor a file [paint-unknown]")
    if path.suffix.lower() == ".sig":
        return hp.open_svc(path)
    return hp.open_asd(path) if path.is_file() and sniff(path) == "binary" else hp.open_library(path)


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
_SCENE_OPTIONS = {"scene", "wavelength_range", "extrapolate", "gaps", "max_curves", "coat_brdf"}
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
        "metavar": "SHARE",
        "default": None,
        "help": "DIRSIG: mirrored share of body reflectance, or 'library'.  [default: 0]",
    },
    surface={
        "type": click.Choice(["ClassicEmissivity", "SimpleReflectance"]),
        "default": None,
        "help": "DIRSIG: surface model of the materials.  [default: ClassicEmissivity]",
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
@click.option("--coat-brdf", is_flag=True, help="DIRSIG: clear coats of a scene as the BRDF Shell Target.")
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
    if set(options_set) - {"curves"} and form != "dirsig":
        options_set.pop("curves", None)
        names = ", ".join(f"--{name.replace('_', '-').replace('wavelength-', '')}" for name in options_set)
        raise click.UsageError(f"{names} only with --format dirsig [option-conflict]")
    paints = hp.open_library(library)
    with progress_bar("writing") as progress:
        if "scene" in options_set:
            if unused := sorted(set(options_set) - _SCENE_OPTIONS):
                names = ", ".join(f"--{name.replace('_', '-')}" for name in unused)
                raise click.UsageError(f"{names} not with --scene (ClassicEmissivity) [option-conflict]")
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
            if options_set.pop("coat_brdf", False):
                raise click.UsageError("--coat-brdf only with --scene [option-conflict]")

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
