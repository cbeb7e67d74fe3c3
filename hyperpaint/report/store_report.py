"""One page about a store: pictures, flags, light, signatures and provenance of every flight line.

The page is one file that opens anywhere: it contains its pictures, refers to nothing outside, and runs no
script. All texts of a store are escaped.
"""

from __future__ import annotations

import contextlib
import datetime
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import PaintError, SchemaError, StoreError
from hyperpaint.base.facts import documented
from hyperpaint.base.old_names import renamed, with_new_names
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, SIGNATURE
from hyperpaint.io.files.publishing import check_place, publish_file
from hyperpaint.io.store import list_groups, open_group, open_store, open_unverified
from hyperpaint.io.store.groups import version_of_program
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.manifest import store_state
from hyperpaint.io.store.reader import place_of
from hyperpaint.pictures.figures import new_figure
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.surroundings.flags import flag_line, is_flagged
from hyperpaint.surroundings.scratch import compute_into, release, scratch_array, survey_planned

from .report_sections import (
    LAYERS,
    calibration_section,
    card_parts,
    library_section,
    line_section,
    map_section,
    regions_of,
    validation_section,
)
from .summaries import Part, page_part

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
    for option, value, least in (("max_lines", max_lines, 1), ("cards", cards, 0)):
        if value < least:
            raise SchemaError(f"{option}={value}", expected=f"{least} or more", code="value-out-of-range")
    groups = groups_to_show(store, flightlines, library)
    lines, maps, libraries, problems = groups.lines, groups.maps, groups.libraries, groups.problems
    paints: list[tuple[str, xr.Dataset, str, Region]] = []  # flight line, library, name and region of paints
    for name, library_of_paints in libraries.items():
        try:
            paints += [
                (line, library_of_paints, paint, region)
                for line, paint, region in regions_of(library_of_paints)
            ]
        except Exception as error:  # see _draw_section
            problems.append(f"/{name}, regions: {message_of(error)}")
    calibration = groups.groups.get("calibration")
    references = [group for name, group in groups.groups.items() if name.startswith("references/")]
    has_validation = bool(libraries and references)
    steps = len(lines) + len(libraries) + has_validation + (calibration is not None)
    sections: list[tuple[str, Iterator[Part]]] = []
    for number, (name, line) in enumerate(lines.items()):
        share = part_of(progress, number, steps)
        on_line = [row for row in paints if row[0] in ("", name, name.rpartition("/")[2])]
        detect = partial(flagged, sun_zenith=sun_zenith, progress=share) if flags else None
        sections.append((name, _line_parts(line, max_lines, on_line, cards, detect)))
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
    created = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
    collects = [str(group.attrs["collect"]) for group in groups.groups.values() if "collect" in group.attrs]
    title = Path(store).resolve().name
    facts = {
        "store": title,
        "collect": ", ".join(dict.fromkeys(collects)),
        "groups": ", ".join(f"/{name}" for name in groups.groups),
        "reported": f"{created.removesuffix('+00:00')} UTC by hyperpaint {version_of_program()}",
    }
    head = page_part("head", pairs=list(facts.items()), problems=problems)
    page = page_part("page", title=title, head=head, sections=drawn_sections)
    publish_file(page_path, page.encode("utf-8", "replace"), overwrite=True)
    if progress is not None:
        progress(1000 * steps, 1000 * steps)
    return Written(page_path, tuple(lines), tuple(maps), tuple(problems))


def _line_parts(
    line: xr.Dataset,
    lines: int,
    paints: Sequence[tuple[str, xr.Dataset, str, Region]],
    cards: int,
    detect: Callable[[xr.Dataset], tuple[xr.Dataset, str]] | None,
) -> Iterator[Part]:
    line, note = (line, "") if detect is None else detect(line)
    for section_part in line_section(line, lines, [region for *_, region in paints], note):
        yield section_part
        # detected flags lie in memory-mapped files, which a picture reads completely
        for name in ("quality", *LAYERS):
            values = line.variables[name]._data if name in line.variables else None
            if isinstance(values, np.ndarray):
                release(values)
    yield from card_parts(line, [(library, paint) for _, library, paint, _ in paints], cards)


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


MAX_LINES = 64  # flight lines of one page: each takes some megabytes

_SCENE_FLAGS = "Glint, shadow and light of neighbours"


class ShownGroups(NamedTuple):
    # Opened groups of a store by name.
    groups: dict[str, xr.Dataset]
    lines: dict[str, xr.Dataset]
    maps: dict[str, xr.Dataset]
    libraries: dict[str, xr.Dataset]
    problems: list[str]  #: Unreadable groups, with the reason


def groups_to_show(
    store: str | os.PathLike[str],
    flightlines: Sequence[str] | None,
    signatures: str | os.PathLike[str] | None,
) -> ShownGroups:
    # Return the chosen flight lines, all maps and libraries of a store, and a library beside it.
    #
    # Raises `SchemaError` for an unknown flight line, or if ``signatures`` is not a paint library;
    # `StoreError` if the store has nothing to show.
    listed, groups = list_groups(store), {}
    # an unfinished store is a problem, but its finished groups are shown
    problems = list(store_state(place_of(store)[0] or Location.of(store), listed).problems)
    for name in listed:
        try:
            groups[name] = with_new_names(open_group(store, name))
        except StoreError as error:
            problems.append(f"/{name}: {error}")
            with contextlib.suppress(StoreError):  # show the readable variables
                groups[name] = open_unverified(store, name)
    cubes = {"counts", "radiance", "reflectance", "quality"}
    lines = {
        name: group
        for name, group in groups.items()
        if {ALONG_TRACK, CROSS_TRACK} <= set(group.dims) and cubes & set(group.variables)
    }
    if flightlines is None:
        lines = dict(list(lines.items())[:MAX_LINES])
    else:
        keys = {
            name: next((key for key in lines if name in (key, key.rpartition("/")[2])), None)
            for name in flightlines
        }
        if unknown := [name for name, key in keys.items() if key is None]:
            raise SchemaError(
                f"{store} has no flight line {', '.join(map(repr, unknown))}",
                expected=", ".join(lines) or "none",
                code="flightline-unknown",
            )
        lines = {key: lines[key] for key in keys.values() if key is not None}
    maps = {
        name or Path(store).name: group for name, group in groups.items() if {"y", "x"} <= set(group.dims)
    }
    libraries = {name: group for name, group in groups.items() if _is_library(group)}
    if signatures is not None:
        library = with_new_names(open_store(signatures, ""))
        SchemaError.raise_if(
            not _is_library(library),
            f"{signatures} is no paint library",
            expected="reflectance (signature, band), as `hyperpaint signatures` writes",
            code="library-missing",
        )
        libraries[Path(signatures).name] = library
    if not lines and not libraries and not maps:
        reason = "; ".join(problems) or f"its groups are {', '.join(groups) or 'none'}"
        raise StoreError(
            f"{store} has no flight line, map or signatures to show: {reason}", code="store-empty"
        )
    return ShownGroups(groups, lines, maps, libraries, problems)


def _is_library(group: xr.Dataset) -> bool:
    return "reflectance" in group.variables and SIGNATURE in group["reflectance"].dims


def flagged(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> tuple[xr.Dataset, str]:
    # Return a line with scene flags, detected if it has none, and a note for the page about their origin.
    if not {"reflectance", "irradiance"} & set(line.variables):
        return line, ""
    names = ("quality", *LAYERS)
    try:
        if is_flagged(line):
            return line, ""
        # survey the line, then detect all flags in one pass
        calibrated = line if "reflectance" in line.variables else reflectance(line)
        with survey_planned(line, "the survey"):
            flags = flag_line(calibrated, sun_zenith=sun_zenith, progress=part_of(progress, 0, 2)).line
            lazy = [flags[name].transpose(ALONG_TRACK, CROSS_TRACK).data for name in names]
            values = [scratch_array(array.shape, array.dtype) for array in lazy]
            compute_into(lazy, values)
    # the line is shown even if detection fails; drawing reports damaged data again
    except Exception as error:
        return line, f"{_SCENE_FLAGS} could not be detected: {message_of(error)}"
    arrays = {
        name: flags[name].reset_coords(drop=True).copy(data=array)
        for name, array in zip(names, values, strict=True)
    }
    return line.assign(arrays), f"{_SCENE_FLAGS} were detected for this page; the store has no such flags."


def message_of(error: Exception) -> str:
    # Return the message of an error for the page; errors of other packages with their class.
    kind = "" if isinstance(error, PaintError) else f"{type(error).__name__}: "
    return f"{kind}{error!s:.1000}"
