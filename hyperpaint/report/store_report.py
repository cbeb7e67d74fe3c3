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

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import PaintError, SchemaError, StoreError
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, PAINT
from hyperpaint.io.files.publishing import check_place, publish_file
from hyperpaint.pictures.figures import new_figure
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.surroundings.flags import flag_line, is_flagged
from hyperpaint.surroundings.scratch import compute_into, scratch_array, survey_planned

from .pages import page_part
from .report_sections import (
    LAYERS as DRAWN,
    Part,
    calibration_section,
    card_parts,
    library_section,
    line_section,
    map_section,
    regions_of,
)  # fmt: skip

if TYPE_CHECKING:
    import xarray as xr
    from markupsafe import Markup

    from hyperpaint.regions import Region

__all__ = ["Written", "write_report"]

MOST_LINES = 64
"""Flight lines of one page at the most: each takes some megabytes."""

_SOUGHT = "Glint, shadow and light of neighbours"


@dataclass(frozen=True)
class Written:
    """What a report came to."""

    path: Path  #: The page.
    flightlines: tuple[str, ...]  #: Groups that it shows.
    maps: tuple[str, ...]  #: Groups of maps that it shows.
    problems: tuple[str, ...]  #: What of the store could not be read, as the page says it too.


def write_report(
    store: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    flightlines: Sequence[str] | None = None,
    signatures: str | os.PathLike[str] | None = None,
    lines: int = 1000,
    flags: bool = True,
    cards: int = 60,
    sun_zenith: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Written:
    """Write what a store holds as one HTML page that needs nothing else.

    For every flight line and map: true colour, flags on it and their shares, irradiance over time, how
    reflectance is spread, provenance; then paint signatures and the calibration, where there are any. What
    cannot be read is named on the page, and does not keep the rest from it.

    Parameters
    ----------
    store
        A finished store, as `hyperpaint.process` or `hyperpaint.render_scene` writes it, or of a map.
    out
        The page, a file.
    flightlines
        Names of those that are shown, such as ``["raw_0"]``; by default all, of more than 64 the first.
    signatures
        A paint library beside the store, as ``hyperpaint signatures`` writes it; what the store itself holds
        is shown anyway.
    lines
        Lines of a picture at the most; of a longer flight line every n-th is read. Flags are read whole, two
        bytes a pixel.
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
        ``lines`` is not positive, ``cards`` is negative, or there are no such flight lines.
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
    from hyperpaint.io.store import list_groups

    new_figure("a report")  # before anything is read
    place = Path(out)
    check_place(place, "the report", example="report.html", store=Path(store), overwrite=overwrite)
    if lines < 1:
        raise SchemaError(f"lines={lines}, expected 1 or more")
    if cards < 0:
        raise SchemaError(f"cards={cards}, expected 0 or more")
    opened, problems = _opened(store, list_groups(store))
    shown = _chosen({name: line for name, line in opened.items() if _is_line(line)}, flightlines, store)
    maps = {name or Path(store).name: group for name, group in opened.items() if _is_map(group)}
    libraries = {name: group for name, group in opened.items() if _is_library(group)}
    if signatures is not None:
        libraries[Path(signatures).name] = _library(signatures)
    if not shown and not libraries and not maps:
        reason = "; ".join(problems) or f"its groups are {', '.join(opened) or 'none'}"
        raise StoreError(f"{store} has nothing to show, no flight line, map or signatures: {reason}")
    measured = _measured(shown, libraries, problems)
    steps = len(shown) + len(libraries) + ("calibration" in opened)
    parts: list[tuple[str, Iterator[Part]]] = []
    for number, (name, line) in enumerate(shown.items()):
        share = part_of(progress, number, steps)
        section = _flagged_section(line, lines, measured[name], cards, flags, sun_zenith, share)
        parts.append((name, section))
    parts += [(name, map_section(group, lines)) for name, group in maps.items()]
    parts += [(name, library_section(library)) for name, library in libraries.items()]
    if "calibration" in opened:
        parts.append(("calibration", calibration_section(opened["calibration"])))
    sections = []
    for number, (name, draw) in enumerate(parts):
        if progress is not None:
            progress(1000 * number, 1000 * steps)
        sections.append((name, _drawn(name, draw, problems)))
    head = _head(store, opened, problems)
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
    note = ""
    if flags and {"reflectance", "irradiance"} & set(line.variables):
        try:
            if not is_flagged(line):
                line = _with_flags(line, sun_zenith, progress)
                note = f"{_SOUGHT} were looked for here; the store has no such flags."
        # a line that cannot be looked at is shown all the same; damage shows again where it is drawn
        except Exception as error:
            note = f"{_SOUGHT} could not be looked for: {_message_of(error)}"
    yield from line_section(line, lines, [one.region for one in measured], note)
    yield from card_parts(line, [(one.library, one.paint) for one in measured], cards)


def _with_flags(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> xr.Dataset:
    """Return a line with flags and layers in memory, found in one pass after a survey."""
    seen = line if "reflectance" in line.variables else reflectance(line)
    surveyed = part_of(progress, 0, 2)
    with survey_planned(line, "the survey"):
        flagged = flag_line(seen, sun_zenith=sun_zenith, progress=surveyed).line
        names = ["quality", *DRAWN]
        lazy = [flagged[name].transpose(ALONG_TRACK, CROSS_TRACK).data for name in names]
        found = [scratch_array(each.shape, each.dtype) for each in lazy]
        compute_into(lazy, found)
    return line.assign(
        {
            name: flagged[name].reset_coords(drop=True).copy(data=each)
            for name, each in zip(names, found, strict=True)
        }
    )


# --- what there is to show ---------------------------------------------------------------------------------


def _opened(store: str | os.PathLike[str], groups: Sequence[str]) -> tuple[dict[str, xr.Dataset], list[str]]:
    """Return the groups that can be read, and why others cannot."""
    from hyperpaint.io.store import open_group
    from hyperpaint.io.store.location import Location
    from hyperpaint.io.store.root_record import set_state

    opened = {}
    problems = list(set_state(Location.of(store), groups).problems)  # what is finished is shown all the same
    for group in groups:
        try:
            opened[group] = open_group(store, group)
        except StoreError as error:
            problems.append(f"/{group}: {error}")
    return opened, problems


def _is_line(group: xr.Dataset) -> bool:
    cubes = {"counts", "radiance", "reflectance", "quality"} & set(group.variables)
    return {ALONG_TRACK, CROSS_TRACK} <= set(group.dims) and bool(cubes)


def _is_map(group: xr.Dataset) -> bool:
    return {"y", "x"} <= set(group.dims)


def _is_library(group: xr.Dataset) -> bool:
    return "reflectance" in group.variables and PAINT in group["reflectance"].dims


def _chosen(
    lines: dict[str, xr.Dataset], wanted: Sequence[str] | None, store: str | os.PathLike[str]
) -> dict[str, xr.Dataset]:
    if wanted is None:
        return dict(list(lines.items())[:MOST_LINES])
    matches = {
        name: next((key for key in lines if name in (key, key.rpartition("/")[2])), None) for name in wanted
    }
    if unknown := [name for name, key in matches.items() if key is None]:
        held = ", ".join(lines) or "none"
        raise SchemaError(f"{store} has no flight line {', '.join(map(repr, unknown))}; there is {held}")
    return {key: lines[key] for key in matches.values() if key is not None}


def _library(path: str | os.PathLike[str]) -> xr.Dataset:
    from hyperpaint.io.store import open_store

    library = open_store(path, "")
    if not _is_library(library):
        raise SchemaError(
            f"{path} is no paint library; expected reflectance (paint, band), as hyperpaint signatures writes"
        )
    return library


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
            problems.append(f"/{name}, regions: {_message_of(error)}")
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
            message = _message_of(error)
            problems.append(f"/{name}, {what}: {message}")
            text = f"This could not be shown: {what}: {message}"
            drawn.append(page_part("paragraph", text=text, kind="problem"))
    return drawn


def _message_of(error: Exception) -> str:
    kind = "" if isinstance(error, PaintError) else f"{type(error).__name__}: "
    return f"{kind}{error!s:.1000}"


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
