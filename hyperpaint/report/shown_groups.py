"""What of a store can be shown: flight lines with the flags that are looked for, maps and paint libraries."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import PaintError, SchemaError, StoreError
from hyperpaint.base.old_names import with_new_names
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, SIGNATURE
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.surroundings.flags import flag_line, is_flagged
from hyperpaint.surroundings.scratch import compute_into, scratch_array, survey_planned

from .report_sections import LAYERS as DRAWN

if TYPE_CHECKING:
    import xarray as xr

MOST_LINES = 64
"""Flight lines of one page at the most: each takes some megabytes."""

_SOUGHT = "Glint, shadow and light of neighbours"


class ShownGroups(NamedTuple):
    """Groups of a store, opened, by their names."""

    opened: dict[str, xr.Dataset]
    lines: dict[str, xr.Dataset]
    maps: dict[str, xr.Dataset]
    libraries: dict[str, xr.Dataset]
    problems: list[str]  #: What could not be read


def groups_to_show(
    store: str | os.PathLike[str],
    flightlines: Sequence[str] | None,
    signatures: str | os.PathLike[str] | None,
) -> ShownGroups:
    """Return what a store has to show, of its flight lines those wanted, and a library beside it.

    SchemaError where there are no such flight lines, or ``signatures`` is no library; StoreError where there
    is nothing to show.
    """
    opened, problems = _opened(store)
    lines = _chosen({name: line for name, line in opened.items() if _is_line(line)}, flightlines, store)
    maps = {
        name or Path(store).name: group for name, group in opened.items() if {"y", "x"} <= set(group.dims)
    }
    libraries = {name: group for name, group in opened.items() if _is_library(group)}
    if signatures is not None:
        libraries[Path(signatures).name] = _library(signatures)
    if not lines and not libraries and not maps:
        reason = "; ".join(problems) or f"its groups are {', '.join(opened) or 'none'}"
        raise StoreError(f"{store} has nothing to show, no flight line, map or signatures: {reason}")
    return ShownGroups(opened, lines, maps, libraries, problems)


def _opened(store: str | os.PathLike[str]) -> tuple[dict[str, xr.Dataset], list[str]]:
    """Return the groups that can be read, and why others cannot."""
    from hyperpaint.io.store import list_groups, open_group, open_unverified
    from hyperpaint.io.store.location import Location
    from hyperpaint.io.store.manifest import store_state

    groups = list_groups(store)
    opened = {}
    problems = list(
        store_state(Location.of(store), groups).problems
    )  # what is finished is shown all the same
    for group in groups:
        try:
            opened[group] = with_new_names(open_group(store, group))
        except StoreError as error:
            problems.append(f"/{group}: {error}")
            with contextlib.suppress(StoreError):  # what can be read of it
                opened[group] = open_unverified(store, group)
    return opened, problems


def _is_line(group: xr.Dataset) -> bool:
    cubes = {"counts", "radiance", "reflectance", "quality"} & set(group.variables)
    return {ALONG_TRACK, CROSS_TRACK} <= set(group.dims) and bool(cubes)


def _is_library(group: xr.Dataset) -> bool:
    return "reflectance" in group.variables and SIGNATURE in group["reflectance"].dims


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

    library = with_new_names(open_store(path, ""))
    if not _is_library(library):
        raise SchemaError(
            f"{path} is no paint library; expected reflectance (signature, band), as `hyperpaint "
            "signatures` writes"
        )
    return library


def flagged(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> tuple[xr.Dataset, str]:
    """Return a line with flags, looked for where it has none of the scene, and what is to be said of that."""
    if not {"reflectance", "irradiance"} & set(line.variables):
        return line, ""
    try:
        if is_flagged(line):
            return line, ""
        line = _with_flags(line, sun_zenith, progress)
    # a line that cannot be looked at is shown all the same; damage shows again where it is drawn
    except Exception as error:
        return line, f"{_SOUGHT} could not be looked for: {message_of(error)}"
    return line, f"{_SOUGHT} were looked for here; the store has no such flags."


def _with_flags(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> xr.Dataset:
    """Return a line with flags and layers in memory, found in one pass after a survey."""
    seen = line if "reflectance" in line.variables else reflectance(line)
    surveyed = part_of(progress, 0, 2)
    with survey_planned(line, "the survey"):
        flags = flag_line(seen, sun_zenith=sun_zenith, progress=surveyed).line
        names = ["quality", *DRAWN]
        lazy = [flags[name].transpose(ALONG_TRACK, CROSS_TRACK).data for name in names]
        values = [scratch_array(each.shape, each.dtype) for each in lazy]
        compute_into(lazy, values)
    return line.assign(
        {
            name: flags[name].reset_coords(drop=True).copy(data=each)
            for name, each in zip(names, values, strict=True)
        }
    )


def message_of(error: Exception) -> str:
    """Return what an error says, for the page; its kind where it is none of ours."""
    kind = "" if isinstance(error, PaintError) else f"{type(error).__name__}: "
    return f"{kind}{error!s:.1000}"
