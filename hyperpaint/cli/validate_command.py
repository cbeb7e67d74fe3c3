"""The command ``hyperpaint validate``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from .console import EXISTING, EXISTING_FILE, FAILED_CHECK, FILE, without_none
from .options import command, takes

_PART = re.compile(r"(?P<name>[^=]+)=(?P<first>[0-9]+(\.[0-9]*)?)-(?P<last>[0-9]+(\.[0-9]*)?)", re.ASCII)


def _limits(_ctx: click.Context, _param: click.Parameter, values: tuple[str, ...]) -> dict[str, float] | None:
    """Return tolerances by name of a statistic: each is a number, or NAME=NUMBER."""
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


def _parts(
    _ctx: click.Context, _param: click.Parameter, values: tuple[str, ...]
) -> dict[str, tuple[float, float]] | None:
    """Return parts of the spectrum: each is NAME=FIRST-LAST [nm]."""
    parts = {}
    for value in values:
        match = _PART.fullmatch(value)
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
A paint's reference is the one its region names (property reference), else the one of its own name, with or
without folder and suffix; --pairs says otherwise. Nothing is paired by likeness.""",
)
@click.argument("library", metavar="LIBRARY", type=EXISTING)
@click.option(
    "--reference",
    "references",
    multiple=True,
    metavar="FILES",
    help="File, glob or folder of .sig or .asd files, a paint library, or a store; may be repeated. "
    " [default: the references of the store that the library was made from]",
)
@click.option("--pairs", metavar="PAIRS.csv", type=EXISTING_FILE, help="Table of paint and reference.")
@click.option(
    "--tolerance",
    multiple=True,
    metavar="LIMIT",
    callback=_limits,
    help="Largest RMSE of reflectance, or NAME=LIMIT of relative (a share of the paint's level), floor "
    "(added to it), bias, mae, spectral_angle [degree], scale or scale_free_error; may be given several "
    "times.  [default: relative=0.05, floor=0.005]",
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
    callback=_parts,
    help="Part of the spectrum [nm]; may be given several times.  [default: VIS=400-700, NIR=700-1000, all]",
)
@takes(
    "validation.validating:validate",
    only=["reference_fwhm", "require_all"],
    reference_fwhm={
        "type": click.FloatRange(min=0.0, min_open=True),
        "metavar": "NM",
        "help": "Width of the references' channels.  [default: from the files, or usual for the instrument]",
    },
    require_all={"help": "Fail where any paint has no reference, not only one whose region names it."},
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
    spectrum, bias, RMSE, MAE, spectral angle, scale and scale-free error, with uncertainties where they are
    known, and pass or fail; references of several instruments against one another; and unpaired spectra.
    Exit status 1 outside tolerance, where a reference that a region names is missing, or where a part has too
    few bands to judge.
    """
    from hyperpaint.workflows.library_files import check_table, validate_files, write_table

    if out is not None:
        check_table(out, overwrite=overwrite)
    if picture is not None:
        from hyperpaint.pictures.figures import check_picture

        check_picture(picture)
    given = without_none(options)
    validation = validate_files(library, references, **given)
    click.echo(validation.table())
    if out is not None:
        write_table(validation, out, overwrite=overwrite)
        click.echo(f"all digits are in {out}")
    if picture is not None:
        from hyperpaint.pictures.plot_validation import validation_figure

        validation_figure(validation, picture)
        click.echo(f"look at it in {picture}")
    for problem in validation.problems:
        click.echo(f"not passed: {problem}", err=True)
    if not validation.passed:
        ctx.exit(FAILED_CHECK)
