"""The command ``hyperpaint export``: a paint library in the formats of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, EXISTING_FILE, PLACE, beside, is_watched, progress_bar

_LIBRARIES = ("envi", "csv", "parquet", "ecostress", "zarr")
_NAMES = {"envi": "{}.sli", "csv": "{}.csv", "zarr": "{}_export.zarr"}


@click.command(
    short_help="Write a paint library for simulators and other programs.",
    epilog="""\b
Examples:
  hyperpaint export paints.zarr --format dirsig
  hyperpaint export paints.zarr --format dirsig --out dirsig --range 400 1000 --gaps refuse
  hyperpaint export paints.zarr --format dirsig --out dirsig --scene-materials scene.mat
  hyperpaint export paints.zarr --format dirsig --out lot --scene scene.toml
  hyperpaint export paints.zarr --format csv --out paints.csv
  hyperpaint export paints.zarr --format envi --out paints.sli --curves all
  hyperpaint export paints.zarr --format ecostress --out spectra""",
)
@click.argument("library", metavar="LIB", type=EXISTING)
@click.option(
    "--format", "form", required=True, type=click.Choice(["dirsig", *_LIBRARIES]),
    help="DIRSIG materials, an ENVI .sli, a table in CSV or Parquet, one text file a paint, or a Zarr store.",
)  # fmt: skip
@click.option(
    "--out", metavar="OUT", type=PLACE,
    help="Where to write: a file for envi (.sli), csv and parquet, a new or empty folder for the others.  "
    "[default: beside LIB, of its name for a file, of the format's for a folder]",
)  # fmt: skip
@click.option(
    "--curves", type=click.Choice(["centre", "all", "members", "quantiles"]),
    help="centre: one spectrum a paint; all: members, quantiles and spread as well; DIRSIG: centre, members "
    "or quantiles.  [default: centre; zarr all; DIRSIG members where there are any]",
)  # fmt: skip
@click.option(
    "--range", "wavelength_range", type=float, nargs=2, metavar="LOW HIGH", default=None,
    help="DIRSIG: wavelengths in nm.  [default: what was measured]",
)  # fmt: skip
@click.option("--extrapolate", is_flag=True, help="DIRSIG: hold curves constant beyond what was measured.")
@click.option(
    "--gaps", type=click.Choice(["interpolate", "refuse"]),
    help="DIRSIG: what to do about bands without values.  [default: interpolate, and say so]",
)  # fmt: skip
@click.option(
    "--max-curves", type=click.IntRange(1), metavar="N",
    help="DIRSIG: curves of a paint at the most.  [default: all; 64 of a scene]",
)  # fmt: skip
@click.option(
    "--specular", metavar="SHARE",
    help="DIRSIG: share of reflectance to mirror, or 'library'; only for body reflectance.  [default: 0]",
)  # fmt: skip
@click.option(
    "--surface", type=click.Choice(["ClassicEmissivity", "SimpleReflectance"]),
    help="DIRSIG: what materials use.  [default: ClassicEmissivity]",
)  # fmt: skip
@click.option(
    "--scene-materials", type=EXISTING_FILE, metavar="SCENE.mat",
    help="DIRSIG: use no ID of this material list again.",
)  # fmt: skip
@click.option(
    "--scene", type=EXISTING_FILE, metavar="SCENE.toml",
    help="DIRSIG: write the whole scene of a render, painted with LIB.",
)  # fmt: skip
@click.option("--coat-brdf", is_flag=True, help="DIRSIG: clear coats of a scene as the BRDF Shell Target.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier export.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def export(library: Path, form: str, out: Path | None, overwrite: bool, quiet: bool, **options: Any) -> None:
    """Write a paint library for simulators and other programs.

    LIB is a library's Zarr store, as `signatures` writes it, or any file of spectra that hyperpaint reads.
    For DIRSIG every paint becomes emissivity with many curves, so that a texture can draw from them, and a
    MATERIAL_ENTRY; README.txt beside them says how to add them to a scene.
    """
    from hyperpaint.io.library import open_library, write_library

    out = out or beside(library, _NAMES.get(form, form).format(library.stem))
    given = {name: value for name, value in options.items() if value not in (None, False)}
    curves = given.get("curves")
    if set(given) - {"curves"} and form != "dirsig":
        given.pop("curves", None)
        names = ", ".join(f"--{name.replace('_', '-').replace('wavelength-', '')}" for name in given)
        raise click.UsageError(f"{names} only with --format dirsig")
    paints = open_library(library)
    with progress_bar("writing", is_watched(quiet)) as shown:
        if "scene" in given:
            from hyperpaint.workflows.dirsig_export import export_dirsig_scene

            _echo_scene(out, export_dirsig_scene(**_of_scene(given), folder=out, library=paints,
                                                 overwrite=overwrite, progress=shown))  # fmt: skip
            return
        if form == "dirsig":
            if given.pop("coat_brdf", False):
                raise click.UsageError("--coat-brdf only with --scene")
            from hyperpaint.io.dirsig import write_dirsig

            materials = write_dirsig(paints, out, overwrite=overwrite, progress=shown, **_options(given))
            click.echo(
                f"{out}: {materials.sizes['signature']} paints, {int(materials['curves'].sum())} curves"
            )
            if filled := int(materials["interpolated"].sum()):
                complete = int(materials["complete"].sum())
                click.echo(
                    f"{complete} curves are complete; {filled} samples in gaps of the others filled in"
                )
            attrs = materials.attrs
            click.echo(f"mirrored light {attrs['mirror_reflection']}, {attrs['mirror_reflection_source']}")
            click.echo(f"how to add them: {out / 'README.txt'}")
            return
        path = write_library(paints, out, format=form, curves=curves, overwrite=overwrite, progress=shown)
    click.echo(f"{path}: {paints.sizes['signature']} paints, {paints.sizes['band']} bands")
    if curves is None and form in ("envi", "csv", "parquet") and "member_reflectance" in paints.variables:
        click.echo("one row a paint, its centre; --curves all writes members, quantiles and spread as well")


def _of_scene(given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a whole scene."""
    others = sorted(
        set(given) - {"scene", "wavelength_range", "extrapolate", "gaps", "max_curves", "coat_brdf"}
    )
    if others:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in others)
        raise click.UsageError(f"{names} not with --scene, whose materials are ClassicEmissivity")
    return {"scene_file": given["scene"], **{key: given[key] for key in given if key != "scene"}}


def _echo_scene(out: Path, written: Any) -> None:
    populations = int((written["curves"] > 1).sum())
    click.echo(
        f"{out}: {written.sizes['signature']} materials, {populations} of them populations, "
        f"{written.attrs['faces']} triangles, {written.attrs['features']}"
    )
    click.echo(f"how to run it, and what was checked: {out / 'README.txt'}")


def _options(given: dict[str, Any]) -> dict[str, Any]:
    """Return options with the specular share as a number, where it is one."""
    share = given.get("specular")
    if share is None or share == "library":
        return given
    try:
        return {**given, "specular": float(share)}
    except ValueError:
        raise click.UsageError(f"--specular {share!r}, expected a number or 'library'") from None
