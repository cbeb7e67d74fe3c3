"""The command ``hyperpaint init``: a collect.toml from what lies in a folder."""

from __future__ import annotations

from pathlib import Path

import click

from .console import EXISTING, FILE

__all__ = ["init"]

_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


@click.command(
    short_help="Write a collect.toml from what lies in a folder.",
    epilog="""\b
Examples:
  hyperpaint init 2021_07_20
  hyperpaint init 2021_07_20 --asd ../asd/morning --dark ../dark --calibration ../camera.zarr
  hyperpaint run 2021_07_20/collect.toml""",
)
@click.argument("folder", metavar="FOLDER", type=_FOLDER)
@click.option("--asd", metavar="DIR", type=_FOLDER, help="ASD files, where they lie elsewhere.")
@click.option("--dark", metavar="DIR", type=_FOLDER, help="Dark cubes, where they lie elsewhere.")
@click.option(
    "--calibration", metavar="PATH", type=EXISTING,
    help="The camera's calibration, or a lab sweep.  [default: the one in FOLDER]",
)  # fmt: skip
@click.option(
    "--out", metavar="FILE", type=FILE,
    help="The file.  [default: collect.toml in FOLDER]",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
def init(
    folder: Path, asd: Path | None, dark: Path | None, calibration: Path | None, out: Path | None,
    overwrite: bool,
) -> None:  # fmt: skip
    """Write a commented collect.toml from what lies in the folder of a flight.

    Looks for raw cubes, their frame indices and navigation, darks, ASD and SVC files and the calibration.
    Nothing is asked: what no file says is marked "?" in the file, and process names it until it is filled in.
    """
    from hyperpaint.workflows.collect_template import unknown_keys, write_collect_toml
    from hyperpaint.workflows.field_folder import find_field_files

    found = find_field_files(folder, asd=asd, dark=dark, calibration=calibration)
    path = write_collect_toml(found, out, overwrite=overwrite)
    cubes = len(found.cubes)
    click.echo(
        f"{path}: {cubes} cube{'' if cubes == 1 else 's'}, {len(found.darks)} dark, "
        f"{len(found.irradiance)} folder of irradiance, {len(found.references)} of references"
    )
    for note in found.notes:
        click.echo(f"note: {note}", err=True)
    if unknown := unknown_keys(path):
        click.echo("fill in, then process:\n  " + "\n  ".join(unknown))
    else:
        place = path.parent if path.name == "collect.toml" else path
        click.echo(f"next: hyperpaint check {path}, then hyperpaint run {place}")
