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
from hyperpaint.base.keyword_names import renamed
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
    problems: tuple[str, ...]  #: Unreadable parts of the store, which the page lists too.


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
    store, and the calibration, where there are any. Unreadable parts are named on the page; the rest is
    shown.

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
        `hyperpaint.surroundings.flag`; where that is not possible, the page gives the reason. Nothing is
        stored.
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
        Path of the page, the flight lines on it, and the problems met.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``max_lines`` is not positive, ``cards`` is negative, or there are no such flight lines.
    StoreError
        There is no store, or it has nothing to show; or the page exists already, or cannot be written.

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
    place = Path(out)
    check_place(place, "the report", example="report.html", store=Path(store), overwrite=overwrite)
    if max_lines < 1:
        raise SchemaError(f"max_lines={max_lines}", expected="1 or more", code="value-out-of-range")
    if cards < 0:
        raise SchemaError(f"cards={cards}", expected="0 or more", code="value-out-of-range")
    groups = groups_to_show(store, flightlines, library)
    shown, maps, libraries, problems = groups.lines, groups.maps, groups.libraries, groups.problems
    measured = _measured(shown, libraries, problems)
    calibration = groups.opened.get("calibration")
    references = [group for name, group in groups.opened.items() if name.startswith("references/")]
    validated = bool(libraries and references)
    steps = len(shown) + len(libraries) + validated + (calibration is not None)
    parts: list[tuple[str, Iterator[Part]]] = []
    for number, (name, line) in enumerate(shown.items()):
        share = part_of(progress, number, steps)
        section = _flagged_section(line, max_lines, measured[name], cards, flags, sun_zenith, share)
        parts.append((name, section))
    parts += [(name, map_section(group, max_lines)) for name, group in maps.items()]
    parts += [(name, library_section(paints)) for name, paints in libraries.items()]
    if validated:
        parts.append(("validation", validation_section(libraries, references)))
    if calibration is not None:
        parts.append(("calibration", calibration_section(calibration)))
    sections = []
    for number, (name, draw) in enumerate(parts):
        if progress is not None:
            progress(1000 * number, 1000 * steps)
        sections.append((name, _drawn(name, draw, problems)))
    head = _head(store, groups.opened, problems)
    page = page_part("page", title=Path(store).resolve().name, head=head, sections=sections)
    publish_file(place, page.encode("utf-8", "replace"), overwrite=True)
    if progress is not None:
        progress(1000 * steps, 1000 * steps)
    return Written(place, tuple(shown), tuple(maps), tuple(problems))


def _flagged_section(
    line: xr.Dataset,
    lines: int,
    measured: Sequence[_Measured],
    cards: int,
    flags: bool,
    sun_zenith: float | None,
    progress: Progress | None,
) -> Iterator[Part]:
    line, note = flagged(line, sun_zenith, progress) if flags else (line, "")
    for part in line_section(line, lines, [paint.region for paint in measured], note):
        yield part
        # detected flags lie in memory-mapped files, which a picture reads completely
        for name in ("quality", *LAYERS):
            values = line.variables[name]._data if name in line.variables else None
            if isinstance(values, np.ndarray):
                release(values)
    yield from card_parts(line, [(paint.library, paint.paint) for paint in measured], cards)


# --- paints on their lines ---------------------------------------------------------------------------------


class _Measured(NamedTuple):
    library: xr.Dataset
    paint: str
    region: Region


def _measured(
    lines: dict[str, xr.Dataset], libraries: dict[str, xr.Dataset], problems: list[str]
) -> dict[str, list[_Measured]]:
    # for every flight line, the paints of the libraries measured on it
    paints: list[tuple[str, _Measured]] = []
    for name, library in libraries.items():
        try:
            paints += [(line, _Measured(library, paint, on)) for line, paint, on in regions_of(library)]
        except Exception as error:  # see _drawn
            problems.append(f"/{name}, regions: {message_of(error)}")
    return {
        group: [paint for name, paint in paints if name in ("", group, group.rpartition("/")[2])]
        for group in lines
    }


# --- the page ----------------------------------------------------------------------------------------------


def _drawn(name: str, parts: Iterator[Part], problems: list[str]) -> list[Markup]:
    # a part that cannot be drawn is replaced by its problem
    drawn: list[Markup] = []
    for part, draw in parts:
        try:
            drawn.append(draw())
        # a damaged chunk fails when it is read, data of other programs may fail when they are drawn
        except Exception as error:
            message = message_of(error)
            problems.append(f"/{name}, {part}: {message}")
            text = f"This could not be shown: {part}: {message}"
            drawn.append(page_part("paragraph", text=text, kind="problem"))
    return drawn


def _head(store: str | os.PathLike[str], opened: dict[str, xr.Dataset], problems: list[str]) -> Markup:
    now = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
    collects = [str(group.attrs["collect"]) for group in opened.values() if "collect" in group.attrs]
    facts = {
        "store": Path(store).resolve().name,
        "collect": ", ".join(dict.fromkeys(collects)),
        "groups": ", ".join(f"/{name}" for name in opened),
        "reported": f"{now.removesuffix('+00:00')} UTC by hyperpaint {version_of_program()}",
    }
    return page_part("head", pairs=list(facts.items()), problems=problems)
