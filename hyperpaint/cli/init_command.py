"""The command ``hyperpaint init``: a collect.toml from what lies in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hyperpaint.report.summaries import Facts, counted

from .console import EXISTING, FILE
from .options import command, takes

if TYPE_CHECKING:
    from hyperpaint.workflows.field_folder import FieldFolder

_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)


def facts_of_field_folder(field: FieldFolder) -> Facts:
    """Yield the facts about the folder of a field day."""
    yield "is", f"folder of a field day: {counted(len(field.cubes), 'raw cube')}"
    for cube in field.cubes:
        beside = {"frame index": cube.frame_index, "navigation": cube.navigation}
        words = [name if place else f"no {name}" for name, place in beside.items()]
        exposure = "exposure" if cube.has_exposure else "no exposure"
        yield _within(field.folder, cube.header), ", ".join([*words, exposure])
    yield "dark", ", ".join(_within(field.folder, one) for one in field.darks) or "none"
    for name, place in (("calibration", field.calibration), ("lab sweep", field.sweep)):
        yield name, "" if place is None else _within(field.folder, place)
    yield "irradiance", ", ".join(_within(field.folder, place) for place, _ in field.irradiance) or "none"
    yield (
        "references",
        ", ".join(
            f"{instrument} in {_within(field.folder, place)}" for instrument, place, _ in field.references
        ),
    )
    yield "not used", "\n".join(field.notes)
    if (field.folder / "collect.toml").exists():
        yield "process", f"hyperpaint run {field.folder}"
    else:
        yield "process", f"hyperpaint init {field.folder} writes a collect.toml of it"


def _within(folder: Path, path: Path) -> str:
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


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
def init(folder: Path, out: Path | None, overwrite: bool, **elsewhere: Path | None) -> None:
    """Write a commented collect.toml from the files in the folder of a flight.

    Finds raw cubes, their frame indices and navigation, darks, ASD and SVC files and the calibration. Values
    that no file holds are marked "?"; process lists them until they are filled in.
    """
    from hyperpaint.workflows.collect_template import unknown_keys, write_collect_toml
    from hyperpaint.workflows.field_folder import find_field_files

    found = find_field_files(folder, **elsewhere)
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
