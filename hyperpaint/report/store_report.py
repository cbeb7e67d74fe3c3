"""One page about a store: pictures, flags, light, signatures and provenance of every flight line.

The page is one file that opens anywhere: it contains its pictures, refers to nothing outside, and runs no
script. All texts of a store are escaped.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.old_names import renamed
from hyperpaint.base.progress_reports import part_of
from hyperpaint.io.files.publishing import check_place, publish_file
from hyperpaint.io.store.groups import version_of_program
from hyperpaint.pictures.figures import new_figure
from hyperpaint.surroundings.scratch import release

from .chain_sections import validation_section
from .pages import Part, page_part
from .report_sections import (
    LAYERS,
    calibration_section,
    card_parts,
    library_section,
    line_section,
    map_section,
    regions_of,
)
from .shown_groups import flagged, groups_to_show, message_of

if TYPE_CHECKING:
    from markupsafe import Markup

    from hyperpaint.regions import Region


@dataclass(frozen=True)
class Written:
    """Result of `write_report` and `write_site`."""

    path: Path  #: The page.
    flightlines: tuple[str, ...]  #: Groups of flight lines on the page.
    maps: tuple[str, ...]  #: Groups of maps on the page.
    problems: tuple[str, ...]  #: Unreadable parts of the store; the page lists them too.


@renamed(signatures="library", lines="max_lines")
@documented(library="library page")
def write_report(
    store: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    flightlines: Sequence[str] | None = None,
    library: str | os.PathLike[str] | None = None,
    max_lines: int = 1000,
    flags: bool = True,
    cards: int = 60,
    sun_zenith: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Written:
    """Write the content of a store as one self-contained HTML page.

    For every flight line and map: true colour, flags on it and their shares, irradiance over time, panels,
    spread of reflectance, the steps from counts to reflectance, a map, alignment of camera and record,
    provenance; then paint signatures with their uncertainty, their agreement with the references in the
    store, and the calibration, if the store has them. The page lists unreadable parts and shows all others.

    Parameters
    ----------
    store
    out
        The page, a file.
    flightlines
    library
    max_lines
        Maximum picture height [lines]; longer flight lines are subsampled. Flags are read completely, two
        bytes a pixel.
    flags
        Detect glint, shadow and light of neighbours on lines without these flags, see
        `hyperpaint.surroundings.flag`; if detection fails, the page gives the reason. Flags are not stored.
    cards
        Maximum number of paints of a flight line shown one by one: region, pixels used and excluded,
        signature (`hyperpaint.pictures.paint_card`). Each takes half a second and 60 kB.
    sun_zenith
        Sun zenith angle for the flags [degree]; by default from time and position of each line.
    overwrite
    progress

    Returns
    -------
    Written
        Path of the page, groups on it, and unreadable parts.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``max_lines`` is not positive, ``cards`` is negative, or the store has no flight line of a name.
    StoreError
        The store is missing or has nothing to show; or the page exists already, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.io.store import to_store
    >>> from hyperpaint.simulation import simulate_line
    >>> folder = Path(tempfile.mkdtemp())
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> store = to_store(line, folder / "lot.zarr", "flightlines/raw_0")
    >>> write_report(store, folder / "report.html").flightlines
    ('flightlines/raw_0',)
    """
    new_figure("a report")  # before anything is read
    page_path = Path(out)
    check_place(page_path, "the report", example="report.html", store=Path(store), overwrite=overwrite)
    if max_lines < 1:
        raise SchemaError(f"max_lines={max_lines}", expected="1 or more", code="value-out-of-range")
    if cards < 0:
        raise SchemaError(f"cards={cards}", expected="0 or more", code="value-out-of-range")
    groups = groups_to_show(store, flightlines, library)
    lines, maps, libraries, problems = groups.lines, groups.maps, groups.libraries, groups.problems
    paints_by_line = _paints_by_line(lines, libraries, problems)
    calibration = groups.groups.get("calibration")
    references = [group for name, group in groups.groups.items() if name.startswith("references/")]
    has_validation = bool(libraries and references)
    steps = len(lines) + len(libraries) + has_validation + (calibration is not None)
    sections: list[tuple[str, Iterator[Part]]] = []
    for number, (name, line) in enumerate(lines.items()):
        share = part_of(progress, number, steps)
        section = _flagged_section(line, max_lines, paints_by_line[name], cards, flags, sun_zenith, share)
        sections.append((name, section))
    sections += [(name, map_section(group, max_lines)) for name, group in maps.items()]
    sections += [(name, library_section(paints)) for name, paints in libraries.items()]
    if has_validation:
        sections.append(("validation", validation_section(libraries, references)))
    if calibration is not None:
        sections.append(("calibration", calibration_section(calibration)))
    drawn_sections = []
    for number, (name, parts) in enumerate(sections):
        if progress is not None:
            progress(1000 * number, 1000 * steps)
        drawn_sections.append((name, _draw_section(name, parts, problems)))
    head = _head(store, groups.groups, problems)
    page = page_part("page", title=Path(store).resolve().name, head=head, sections=drawn_sections)
    publish_file(page_path, page.encode("utf-8", "replace"), overwrite=True)
    if progress is not None:
        progress(1000 * steps, 1000 * steps)
    return Written(page_path, tuple(lines), tuple(maps), tuple(problems))


def _flagged_section(
    line: xr.Dataset,
    lines: int,
    paints: Sequence[_PaintOnLine],
    cards: int,
    flags: bool,
    sun_zenith: float | None,
    progress: Progress | None,
) -> Iterator[Part]:
    line, note = flagged(line, sun_zenith, progress) if flags else (line, "")
    for section_part in line_section(line, lines, [paint.region for paint in paints], note):
        yield section_part
        # detected flags lie in memory-mapped files, which a picture reads completely
        for name in ("quality", *LAYERS):
            values = line.variables[name]._data if name in line.variables else None
            if isinstance(values, np.ndarray):
                release(values)
    yield from card_parts(line, [(paint.library, paint.paint) for paint in paints], cards)


# --- paints on their lines ---------------------------------------------------------------------------------


class _PaintOnLine(NamedTuple):
    library: xr.Dataset
    paint: str
    region: Region


def _paints_by_line(
    lines: dict[str, xr.Dataset], libraries: dict[str, xr.Dataset], problems: list[str]
) -> dict[str, list[_PaintOnLine]]:
    # paints measured on each flight line, by its group
    paints: list[tuple[str, _PaintOnLine]] = []
    for name, library in libraries.items():
        try:
            paints += [
                (line, _PaintOnLine(library, paint, region)) for line, paint, region in regions_of(library)
            ]
        except Exception as error:  # see _draw_section
            problems.append(f"/{name}, regions: {message_of(error)}")
    return {
        group: [paint for name, paint in paints if name in ("", group, group.rpartition("/")[2])]
        for group in lines
    }


# --- the page ----------------------------------------------------------------------------------------------


def _draw_section(name: str, parts: Iterator[Part], problems: list[str]) -> list[Markup]:
    # replace a part that cannot be drawn by a text with its problem
    markups: list[Markup] = []
    for part_name, draw in parts:
        try:
            markups.append(draw())
        # reading a damaged chunk fails, and drawing data of other programs may fail
        except Exception as error:
            message = message_of(error)
            problems.append(f"/{name}, {part_name}: {message}")
            text = f"This could not be shown: {part_name}: {message}"
            markups.append(page_part("paragraph", text=text, kind="problem"))
    return markups


def _head(store: str | os.PathLike[str], groups: dict[str, xr.Dataset], problems: list[str]) -> Markup:
    created = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
    collects = [str(group.attrs["collect"]) for group in groups.values() if "collect" in group.attrs]
    facts = {
        "store": Path(store).resolve().name,
        "collect": ", ".join(dict.fromkeys(collects)),
        "groups": ", ".join(f"/{name}" for name in groups),
        "reported": f"{created.removesuffix('+00:00')} UTC by hyperpaint {version_of_program()}",
    }
    return page_part("head", pairs=list(facts.items()), problems=problems)
