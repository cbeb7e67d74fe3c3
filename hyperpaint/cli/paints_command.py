"""The command ``hyperpaint paints``: list, search and save paints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import EXISTING, FILE, PLACE, progress_bar
from .options import command, takes

if TYPE_CHECKING:
    import xarray as xr

_ABOUT = ("finish", "colour", "srgb", "make", "model", "year")


@command(
    "paints",
    epilog="""\b
Examples:
  hyperpaint paints                                        what is in the starter library?
  hyperpaint paints --out starter.zarr                     save it, with 24 variants of each paint
  hyperpaint paints --colour "dark red" --limit 5          what looks most like it in daylight
  hyperpaint paints --colour '#27509e' --picture blue.png  the same of sRGB, with spectra
  hyperpaint paints paints.zarr --name '*volvo*'           paints of a library of yours
  hyperpaint paints paints.zarr --like svc/roof.sig --maximum-angle 0.1
  hyperpaint paints --colour grey --limit 8 --out grey.sli for ENVI; .csv and .zarr go as well

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
        "help": "Largest difference from --colour; 1 is just visible, 10 is another shade.",
    },
    maximum_angle={
        "type": click.FloatRange(min=0.0),
        "metavar": "RAD",
        "help": "Largest spectral angle to --like.",
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
@click.option("--overwrite", is_flag=True, help="Replace a library that is there.")
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
    from hyperpaint.paints.paint_search import search_library

    if options["maximum_angle"] is not None and like is None:
        raise click.UsageError("--maximum-angle needs --like [argument-missing]")
    if options["maximum_colour_difference"] is not None and options["colour"] is None:
        raise click.UsageError("--maximum-difference needs --colour [argument-missing]")
    paints = _opened(library, members)
    matches = search_library(paints, like=_spectrum(like, paints), **options)
    count = matches.sizes["signature"]
    click.echo(f"{count} of {paints.sizes['signature']} paints, {paints.sizes['band']} bands")
    if not count:
        click.echo("no paint meets all conditions")
        return
    click.echo(_table(matches))
    if out is not None:
        from hyperpaint.io.library import write_library

        with progress_bar("writing") as shown:
            path = write_library(matches, out, overwrite=overwrite, progress=shown)
        click.echo(f"saved in {path}")
    if picture is not None:
        from hyperpaint.pictures.plot_spectra import library_overview

        library_overview(matches, picture)
        click.echo(f"look at them in {picture}")


def _opened(library: Path | None, members: int | None) -> xr.Dataset:
    if library is None:
        from hyperpaint.paints.starter_paints import starter_library

        return starter_library() if members is None else starter_library(members=members)
    if members is not None:
        raise click.UsageError("--members is only for the starter library; leave it out [option-conflict]")
    from hyperpaint.io.library import open_library

    return open_library(library)


def _spectrum(like: str | None, paints: xr.Dataset) -> Any:
    """Return the spectrum of a file; a name of the library stays one."""
    if like is None or like in [str(name) for name in paints["signature"].values]:
        return like
    path = Path(like)
    if not path.exists():
        raise click.UsageError(f"--like {like!r} is neither a paint nor a file [paint-unknown]")
    if path.suffix.lower() == ".sig":
        from hyperpaint.io.spectrometers.svc import open_svc

        return open_svc(path)
    from hyperpaint.io.spectrometers.asd import sniff

    if path.is_file() and sniff(path) == "binary":
        from hyperpaint.io.spectrometers.asd import open_asd

        return open_asd(path)
    from hyperpaint.io.library import open_library

    return open_library(path)


def _table(matches: xr.Dataset) -> str:
    """Return a line of text for every paint, with its difference from the one asked for."""
    from hyperpaint.validation.validation_result import aligned

    columns = [[str(name) for name in matches["signature"].values]]
    properties = [
        name for name in _ABOUT if name in matches.variables and matches[name].dims == ("signature",)
    ]
    columns += [[str(value) for value in matches[name].values] for name in properties]
    if "colour_difference" in matches.coords:
        columns.append([f"looks {value:.1f} off" for value in matches["colour_difference"].values])
    if "spectral_angle" in matches.coords:
        columns.append([f"angle {value:.4f} rad" for value in matches["spectral_angle"].values])
    rows = aligned(list(zip(*columns, strict=True)), names=len(columns))
    return "\n".join(f"  {row}" for row in rows)
