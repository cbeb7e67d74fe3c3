"""The command ``hyperpaint export``: a paint library in the formats of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import EXISTING, EXISTING_FILE, PLACE, beside, progress_bar
from .options import command, takes

_LIBRARIES = ("envi", "csv", "parquet", "ecostress", "zarr")
_NAMES = {"envi": "{}.sli", "csv": "{}.csv", "zarr": "{}_export.zarr"}


@command(
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
@click.argument("library", metavar="LIBRARY", type=EXISTING)
@click.option(
    "--format",
    "form",
    required=True,
    type=click.Choice(["dirsig", *_LIBRARIES]),
    help="DIRSIG materials, an ENVI .sli, a table in CSV or Parquet, one text file a paint, or a Zarr store.",
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
        "help": "DIRSIG: reuse no ID of this material list.",
    },
)
@click.option(
    "--scene",
    type=EXISTING_FILE,
    metavar="SCENE.toml",
    help="DIRSIG: write the whole scene of a render, painted with LIBRARY.",
)
@click.option("--coat-brdf", is_flag=True, help="DIRSIG: clear coats of a scene as the BRDF Shell Target.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier export.")
def export(library: Path, form: str, out: Path | None, overwrite: bool, **options: Any) -> None:
    """Write a paint library for simulators and other programs.

    LIBRARY is a Zarr store of signatures, or any file of spectra that hyperpaint reads.
    For DIRSIG every paint becomes emissivity with many curves, so that a texture can draw from them, and a
    MATERIAL_ENTRY; README.txt explains how to add them to a scene.
    """
    from hyperpaint.io.library import open_library, write_library

    out = out or beside(library, _NAMES.get(form, form).format(library.stem))
    given = {name: value for name, value in options.items() if value not in (None, False)}
    curves = given.get("curves")
    if set(given) - {"curves"} and form != "dirsig":
        given.pop("curves", None)
        names = ", ".join(f"--{name.replace('_', '-').replace('wavelength-', '')}" for name in given)
        raise click.UsageError(f"{names} only with --format dirsig [option-conflict]")
    paints = open_library(library)
    with progress_bar("writing") as shown:
        if "scene" in given:
            from hyperpaint.workflows.dirsig_export import export_dirsig_scene

            _echo_scene(
                out,
                export_dirsig_scene(
                    **_of_scene(given), folder=out, library=paints, overwrite=overwrite, progress=shown
                ),
            )
            return
        if form == "dirsig":
            if given.pop("coat_brdf", False):
                raise click.UsageError("--coat-brdf only with --scene [option-conflict]")
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
    others = sorted(
        set(given) - {"scene", "wavelength_range", "extrapolate", "gaps", "max_curves", "coat_brdf"}
    )
    if others:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in others)
        raise click.UsageError(f"{names} not with --scene (ClassicEmissivity) [option-conflict]")
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
        raise click.UsageError(
            f"--specular {share!r}, expected a number or 'library' [number-unreadable]"
        ) from None
