"""A store on one page: pictures, flags, light, signatures and provenance of every flight line.

The page is one file that opens anywhere: pictures are inside it, nothing outside is named, no script runs.
Whatever a store says of itself is escaped.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.keyword_names import renamed
from hyperpaint.base.progress_reports import part_of
from hyperpaint.io.files.publishing import check_place, publish_file
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
)  # fmt: skip
from .shown_groups import flagged, groups_to_show, message_of

if TYPE_CHECKING:
    import xarray as xr
    from markupsafe import Markup

    from hyperpaint.regions import Region


@dataclass(frozen=True)
class Written:
    """What a report came to."""

    path: Path  #: The page.
    flightlines: tuple[str, ...]  #: Groups that it shows.
    maps: tuple[str, ...]  #: Groups of maps that it shows.
    problems: tuple[str, ...]  #: What of the store could not be read, as the page says it too.


@renamed(signatures="library", lines="max_lines")
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
    """Write what a store holds as one HTML page that needs nothing else.

    For every flight line and map: true colour, flags on it and their shares, irradiance over time, panels,
    how reflectance is spread, the steps from counts to reflectance, where it lies on the ground, alignment of
    camera and record, provenance; then paint signatures with their uncertainty, their agreement with the
    references in the store, and the calibration, where there are any. What cannot be read is named on the
    page, and does not keep the rest from it.

    Parameters
    ----------
    store
        A finished store, as `hyperpaint.process` or `hyperpaint.render_scene` writes it, or of a map.
    out
        The page, a file.
    flightlines
        Names of those that are shown, such as ``["raw_0"]``; by default all, of more than 64 the first.
    library
        A paint library beside the store, as ``hyperpaint signatures`` writes it; libraries in the store are
        always shown.
    max_lines
        Maximum picture height [lines]; longer flight lines are subsampled. Flags are read whole, two bytes a
        pixel.
    flags
        Look for glint, shadow and light of neighbours on lines without these flags, see
        `hyperpaint.surroundings.flag`, and show what is found; of a line where that cannot be done, the page
        says why. Nothing is stored.
    cards
        Paints of a flight line, at the most, that are shown one by one: place, pixels used and left out,
        signature (`hyperpaint.pictures.paint_card`). Each takes half a second and 60 kB.
    sun_zenith
        For the flags [degree]; by default from time and position of each line.
    overwrite
        Replace a file that is there.
    progress
        Called with steps done and to do.

    Returns
    -------
    Written
        Path of the page, the flight lines on it, and the problems that were met.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``max_lines`` is not positive, ``cards`` is negative, or there are no such flight lines.
    StoreError
        There is no store, or nothing in it to show; or the page is there already, or cannot be written.

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
        raise SchemaError(f"max_lines={max_lines}, expected 1 or more")
    if cards < 0:
        raise SchemaError(f"cards={cards}, expected 0 or more")
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
    # no half page ever stands under its name
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
    """Yield the parts of a flight line's section, flags looked for first where the line has none."""
    line, note = flagged(line, sun_zenith, progress) if flags else (line, "")
    for part in line_section(line, lines, [one.region for one in measured], note):
        yield part
        for name in (
            "quality",
            *LAYERS,
        ):  # those that were looked for lie in files; a picture reads them whole
            values = line.variables[name]._data if name in line.variables else None
            if isinstance(values, np.ndarray):
                release(values)
    yield from card_parts(line, [(one.library, one.paint) for one in measured], cards)


# --- paints on their lines ---------------------------------------------------------------------------------


class _Measured(NamedTuple):
    """A paint on the flight line that it was measured on."""

    library: xr.Dataset
    paint: str
    region: Region


def _measured(
    lines: dict[str, xr.Dataset], libraries: dict[str, xr.Dataset], problems: list[str]
) -> dict[str, list[_Measured]]:
    """Return the paints of the libraries that were measured on every flight line."""
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
    """Return the parts of a section; what cannot be drawn is named instead, and added to the problems."""
    drawn: list[Markup] = []
    for what, draw in parts:
        try:
            drawn.append(draw())
        # a damaged chunk shows when it is read; and what a store of another hand holds, when it is drawn
        except Exception as error:
            message = message_of(error)
            problems.append(f"/{name}, {what}: {message}")
            text = f"This could not be shown: {what}: {message}"
            drawn.append(page_part("paragraph", text=text, kind="problem"))
    return drawn


def _head(store: str | os.PathLike[str], opened: dict[str, xr.Dataset], problems: list[str]) -> Markup:
    """Return what stands above all sections: what the store is, and what is wrong with it."""
    import datetime

    from hyperpaint.io.store.groups import version_of_program

    now = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
    collects = [str(group.attrs["collect"]) for group in opened.values() if "collect" in group.attrs]
    facts = {
        "store": Path(store).resolve().name,
        "collect": ", ".join(dict.fromkeys(collects)),
        "groups": ", ".join(f"/{name}" for name in opened),
        "reported": f"{now.removesuffix('+00:00')} UTC by hyperpaint {version_of_program()}",
    }
    return page_part("head", pairs=list(facts.items()), problems=problems)
