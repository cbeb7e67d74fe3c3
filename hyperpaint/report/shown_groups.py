"""Groups of a store that a page can show: flight lines, maps, paint libraries; flags of flight lines."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import xarray as xr

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import PaintError, SchemaError, StoreError
from hyperpaint.base.old_names import with_new_names
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, SIGNATURE
from hyperpaint.io.store import list_groups, open_group, open_store, open_unverified
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.manifest import store_state
from hyperpaint.io.store.reader import place_of
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.surroundings.flags import flag_line, is_flagged
from hyperpaint.surroundings.scratch import compute_into, scratch_array, survey_planned

from .report_sections import LAYERS as DRAWN

MAX_LINES = 64  # flight lines of one page: each takes some megabytes

_SCENE_FLAGS = "Glint, shadow and light of neighbours"


class ShownGroups(NamedTuple):
    """Opened groups of a store by name."""

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
    """Return the chosen flight lines, all maps and libraries of a store, and a library beside it.

    Raises `SchemaError` for an unknown flight line, or if ``signatures`` is not a paint library; `StoreError`
    if the store has nothing to show.
    """
    groups, problems = _open_groups(store)
    lines = _select_lines({name: line for name, line in groups.items() if _is_line(line)}, flightlines, store)
    maps = {
        name or Path(store).name: group for name, group in groups.items() if {"y", "x"} <= set(group.dims)
    }
    libraries = {name: group for name, group in groups.items() if _is_library(group)}
    if signatures is not None:
        libraries[Path(signatures).name] = _library(signatures)
    if not lines and not libraries and not maps:
        reason = "; ".join(problems) or f"its groups are {', '.join(groups) or 'none'}"
        raise StoreError(
            f"{store} has no flight line, map or signatures to show: {reason}", code="store-empty"
        )
    return ShownGroups(groups, lines, maps, libraries, problems)


def _open_groups(store: str | os.PathLike[str]) -> tuple[dict[str, xr.Dataset], list[str]]:
    # readable groups, and the reasons why groups are unreadable
    groups = list_groups(store)
    datasets = {}
    # an unfinished store is a problem, but its finished groups are shown
    problems = list(store_state(place_of(store)[0] or Location.of(store), groups).problems)
    for group in groups:
        try:
            datasets[group] = with_new_names(open_group(store, group))
        except StoreError as error:
            problems.append(f"/{group}: {error}")
            with contextlib.suppress(StoreError):  # show the readable variables
                datasets[group] = open_unverified(store, group)
    return datasets, problems


def _is_line(group: xr.Dataset) -> bool:
    cubes = {"counts", "radiance", "reflectance", "quality"} & set(group.variables)
    return {ALONG_TRACK, CROSS_TRACK} <= set(group.dims) and bool(cubes)


def _is_library(group: xr.Dataset) -> bool:
    return "reflectance" in group.variables and SIGNATURE in group["reflectance"].dims


def _select_lines(
    lines: dict[str, xr.Dataset], names: Sequence[str] | None, store: str | os.PathLike[str]
) -> dict[str, xr.Dataset]:
    if names is None:
        return dict(list(lines.items())[:MAX_LINES])
    matches = {
        name: next((key for key in lines if name in (key, key.rpartition("/")[2])), None) for name in names
    }
    if unknown := [name for name, key in matches.items() if key is None]:
        raise SchemaError(
            f"{store} has no flight line {', '.join(map(repr, unknown))}",
            expected=", ".join(lines) or "none",
            code="flightline-unknown",
        )
    return {key: lines[key] for key in matches.values() if key is not None}


def _library(path: str | os.PathLike[str]) -> xr.Dataset:
    library = with_new_names(open_store(path, ""))
    if not _is_library(library):
        raise SchemaError(
            f"{path} is no paint library",
            expected="reflectance (signature, band), as `hyperpaint signatures` writes",
            code="library-missing",
        )
    return library


def flagged(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> tuple[xr.Dataset, str]:
    """Return a line with scene flags, detected if it has none, and a note for the page about their origin."""
    if not {"reflectance", "irradiance"} & set(line.variables):
        return line, ""
    try:
        if is_flagged(line):
            return line, ""
        line = _with_flags(line, sun_zenith, progress)
    # the line is shown even if detection fails; drawing reports damaged data again
    except Exception as error:
        return line, f"{_SCENE_FLAGS} could not be detected: {message_of(error)}"
    return line, f"{_SCENE_FLAGS} were detected for this page; the store has no such flags."


def _with_flags(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> xr.Dataset:
    # survey the line, then detect all flags in one pass
    calibrated = line if "reflectance" in line.variables else reflectance(line)
    with survey_planned(line, "the survey"):
        flags = flag_line(calibrated, sun_zenith=sun_zenith, progress=part_of(progress, 0, 2)).line
        names = ["quality", *DRAWN]
        lazy = [flags[name].transpose(ALONG_TRACK, CROSS_TRACK).data for name in names]
        values = [scratch_array(array.shape, array.dtype) for array in lazy]
        compute_into(lazy, values)
    return line.assign(
        {
            name: flags[name].reset_coords(drop=True).copy(data=array)
            for name, array in zip(names, values, strict=True)
        }
    )


def message_of(error: Exception) -> str:
    """Return the message of an error for the page; errors of other packages with their class."""
    kind = "" if isinstance(error, PaintError) else f"{type(error).__name__}: "
    return f"{kind}{error!s:.1000}"
