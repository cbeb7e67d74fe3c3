"""Paint libraries in files: from a store and its regions to one, and from one to its validation.

The one place where readers meet signatures and validation.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import itertools
import json
import math
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import PaintError, Problems, SchemaError, StoreError
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, flags_named
from hyperpaint.io.files.publishing import check_place, publish_file
from hyperpaint.io.files.reading import safe_cell
from hyperpaint.io.store import budget, list_groups, open_store, to_store
from hyperpaint.regions import Regions, regions_from
from hyperpaint.surroundings.flags import Flagged, flag_line, is_flagged
from hyperpaint.surroundings.scratch import survey_planned
from hyperpaint.validation import Validation, validate

from .maps import location_of

MAX_LISTED_REJECTIONS = 10
MAX_STORED_REJECTIONS = 200
#: Attribute ``flags`` of a library whose lines have no flags of glint, shadow and neighbours.
NOT_LOOKED_FOR = "not looked for"
#: Options of flags that proposals take as well.
_SHARED = ("glint", "shadow", "adjacency", "sun_zenith")


def write_signatures(
    store: str | os.PathLike[str],
    regions: Any,
    out: str | os.PathLike[str],
    *,
    keep: Sequence[str] = (),
    flags: bool | Mapping[str, Any] = True,
    sun_zenith: float | None = None,
    location: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    """Write the signatures of regions on the flight lines of a store, or on a map, and return them.

    Lines without flags are surveyed and flagged first. Reflectance is computed from the stored counts where
    they are, with its uncertainties where the noise of the camera is known; else it is what is stored.

    Parameters
    ----------
    store
        A store with groups ``flightlines/<id>``, as `hyperpaint.process` writes it; or one of a single line
        or map, as `hyperpaint.workflows.maps.write_map` does. A map is not searched for flags.
    regions
        See `hyperpaint.regions.regions_from`; None has `hyperpaint.regions.propose_regions` propose some on
        every line, with the survey that flags were made with.
    keep
        Names of flags whose pixels are used, though they are left out otherwise; not with ``exclude``.
    flags
        False flags nothing; or thresholds of `hyperpaint.surroundings.flag` and options of its survey.
    sun_zenith
        For flags, proposals and the mirrored sky [degree]; by default from time and position of each line.
    location
        Options of `hyperpaint.workflows.maps.location_of`, by which lines are placed for regions of a map; by
        default as the lines say.
    progress
        Called with work done and to do: surveys, then extraction.
    **options
        As `hyperpaint.extract_signatures`.

    Raises
    ------
    FormatError, MissingExtraError, SchemaError, UnitsError
        As `hyperpaint.extract_signatures` and `hyperpaint.surroundings.flag`; or ``keep`` names an unknown
        flag, or comes with ``exclude``.
    StoreError
        The store has no finished flight line of the regions; or the library cannot be written, or its store
        holds something else, and ``overwrite`` is False.
    """
    from hyperpaint.paints.signatures import EXCLUDED, extract_signatures
    from hyperpaint.paints.signatures.extraction import MAX_GATHERED_BYTES

    inside, around = Path(out).resolve(), Path(store).resolve()
    if inside == around or around in inside.parents:
        raise SchemaError(
            f"{out} is in the store itself",
            mend="choose another path for the library",
            code="output-in-store",
        )
    if keep:
        if options.get("exclude") is not None:
            raise SchemaError(
                "keep= and exclude= exclude each other", mend="pass one of them", code="option-conflict"
            )
        options["exclude"] = EXCLUDED & ~functools.reduce(operator.or_, flags_named(keep))
    given = None if regions is None else regions_from(regions)
    lines, looked_at = _lines(store, () if given is None else given.flightlines)
    maps = {name for name, line in lines.items() if ALONG_TRACK not in line.dims}
    if location or (maps and given is None):
        lines = _placed(lines, given, location or {}, maps)
    wanted = [name for name in lines if flags is not False and name not in looked_at | maps]
    surveys = {} if flags is True or flags is False else dict(flags)
    surveys.setdefault("sun_zenith", sun_zenith)
    flagged = {}
    for number, name in enumerate(wanted):
        share = part_of(progress, number, len(wanted) + 1)
        with survey_planned(lines[name], f"the survey of {name or store}"):
            try:
                flagged[name] = flag_line(lines[name], **{**surveys, "progress": share})
            except PaintError as error:
                error.note(
                    f"flight line {name!r} has no flags of glint or shadow yet",
                    mend="flags=False does without",
                    option="--no-flags does without",
                )
                raise
    origin = _origin(lines, flagged, looked_at)
    targets, refused = _proposed(lines, flagged, surveys) if given is None else (given, [])
    lines |= {name: done.line for name, done in flagged.items()}
    if options.get("specular_sky"):
        options["sun_zenith"] = sun_zenith
        word = surveys.get("diffuse")
        # a shadow is looked for in the image by flags alone
        options.setdefault("diffuse", None if isinstance(word, str) and word == "shadow" else word)
    share = part_of(progress, len(wanted), len(wanted) + 1)
    with contextlib.ExitStack() as stack:
        for name, line in lines.items():
            if name not in maps:
                load, besides = budget.Load.of(line), budget.LOADED + MAX_GATHERED_BYTES
                subject = f"extracting from {name or store}"
                stack.enter_context(budget.planned(subject, a_thread=load.a_thread, fixed=besides))
        library = extract_signatures(lines, targets, progress=share, **options)
    library.attrs |= {"store": around.name, "flags": origin}
    if refused:
        library.attrs["refused"] = refused[:MAX_STORED_REJECTIONS]
    to_store(library, Path(out), overwrite=overwrite)
    return library


def _placed(
    lines: Mapping[str, xr.Dataset], regions: Regions | None, location: Mapping[str, Any], maps: set[str]
) -> dict[str, xr.Dataset]:
    from hyperpaint.geometry import locate

    problems = Problems("signatures cannot be extracted", SchemaError)
    if maps and regions is None:
        problems.add(
            "regions are proposed on flight lines, not on a map",
            mend="draw and name some",
            code="regions-missing",
        )
    if location and maps:
        problems.add(
            "a map is located already", mend=f"leave out {', '.join(location)}", code="location-on-map"
        )
    elif location and (regions is None or regions.coordinates != "map"):
        problems.add(
            f"{', '.join(location)} apply to regions in map coordinates, and these are in sensor coordinates",
            code="location-unused",
        )
    problems.raise_if_any()
    return {name: locate(line, **location_of(line, **location)) for name, line in lines.items()}


def _lines(
    store: str | os.PathLike[str], wanted: tuple[str, ...]
) -> tuple[dict[str, xr.Dataset], frozenset[str]]:
    # second, the names of lines that have flags
    from hyperpaint.radiometry.counts_to_reflectance import reflectance

    listed = list_groups(store)
    groups = [group for group in listed if group.startswith("flightlines/")]
    names = [group.removeprefix("flightlines/") for group in groups]
    opened = {}
    if listed == [""]:
        only = open_store(store)
        if {ALONG_TRACK, CROSS_TRACK} <= set(only.dims) or {"y", "x"} <= set(only.dims):
            opened[str(only.attrs.get("name", ""))] = only
    for name in names if not wanted or not set(wanted) <= set(names) else wanted:
        opened[name] = open_store(store, f"flightlines/{name}")
    if not opened:
        raise StoreError(
            f"{store} holds no flight line",
            expected="groups flightlines/<id>, as hyperpaint process writes, or a map (y, x)",
            code="flightline-missing",
        )
    lines, flagged = {}, set()
    for name, line in opened.items():
        # as it is stored: computed from counts, all of them would be read for it
        if is_flagged(line):
            flagged.add(name)
        if "counts" in line.variables:
            line = reflectance(line, uncertainty={"electrons_per_count", "read_noise"} <= set(line.variables))
        lines[name] = line
    return lines, frozenset(flagged)


def _origin(
    lines: Mapping[str, xr.Dataset], flagged: Mapping[str, Flagged], looked_at: frozenset[str]
) -> str:
    origins = []
    for name, line in lines.items():
        if name in flagged:
            origins.append(str(flagged[name].line["quality"].attrs["flags_from"]))
        else:
            text = str(line["quality"].attrs.get("flags_from", "not said from what"))
            origins.append(f"those of the store, {text}" if name in looked_at else NOT_LOOKED_FOR)
    return "; ".join(dict.fromkeys(origins))


def _proposed(
    lines: Mapping[str, xr.Dataset], flagged: Mapping[str, Flagged], options: Mapping[str, Any]
) -> tuple[Regions, list[str]]:
    # accepted regions, and rejected ones with place and reasons, cars first
    from hyperpaint.regions.proposals import propose_regions

    # with several lines, names of paints begin with the name of the line
    by_line = {}
    for name, line in lines.items():
        paint = "paint" if len(lines) == 1 else f"{name}_paint"
        done = flagged.get(name)
        seen, model = (line, None) if done is None else (done.surveyed, done.model)
        # beside a model, the survey's other options were used already
        taken = _SHARED if done else set(options) - {"edge"}
        shared = {key: options[key] for key in taken if key in options}
        by_line[name] = propose_regions(seen, model, flightline=name, name=paint, **shared)
    regions = Regions(tuple(region for proposals in by_line.values() for region in proposals))
    refused = [
        f"{name}, line {along:.0f}, column {across:.0f}: {'; '.join(region.properties['refused'])}"
        for name, proposals in by_line.items()
        for region in proposals.refused
        for across, along in [region.polygon.mean(axis=0)]
    ]
    if not len(regions):
        shown = "".join(f"\n  {text}" for text in refused[:MAX_LISTED_REJECTIONS])
        raise SchemaError(
            f"no region can be proposed, {len(refused)} were rejected{shown}",
            mend="draw and name some",
            code="proposals-empty",
        )
    return regions, refused


def table_of(library: xr.Dataset) -> str:
    """Return a line of text for every paint of a library."""
    names = [str(name) for name in library["signature"].values]
    width = max(map(len, names))
    rows = zip(names, *(library[name].values for name in ("n", "n_eff", "n_excluded")), strict=True)
    return "\n".join(
        f"  {name:<{width}}  {n} pixels, {n_eff:.0f} independent" + (f", {left} left out" if left else "")
        for name, n, n_eff, left in rows
    )


_TABLES = (".csv", ".json")
_PAIR = ("signature", "reference", "instrument", "overlap", "overlap_matched", "mirror_reflection")
_DEPTHS = ("oxygen_residual", "reference_oxygen_residual")


def validate_files(
    library: str | os.PathLike[str],
    references: Sequence[str | os.PathLike[str]] = (),
    *,
    pairs: str | os.PathLike[str] | None = None,
    panel: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Validation:
    """Compare a stored paint library with references in files; see `hyperpaint.validate` for the options.

    ``references`` are as of `open_references`, by default those of the store that the library was made from,
    where it is beside the library; ``pairs`` as of `read_pairs`, ``panel`` as of `read_certificate`.

    Raises `FormatError`, `SchemaError`, `StoreError`, `UnitsError`: something cannot be read, or as
    `validate`.
    """
    from hyperpaint.io.library import open_library
    from hyperpaint.io.spectrometers.reference_files import open_references, read_pairs
    from hyperpaint.io.spectrometers.spectrum_csv import read_certificate

    signatures = open_library(library)
    named = None if pairs is None else read_pairs(pairs)
    certified = None if panel is None else read_certificate(panel)
    opened = open_references(references or [_store_of(signatures, Path(library))])
    return validate(signatures, opened, named, panel=certified, **options)


def _store_of(signatures: xr.Dataset, library: Path) -> Path:
    name = signatures.attrs.get("store")
    place = library.absolute().parent / str(name)
    # only a name: no path from inside a file leads out of the folder
    plain = isinstance(name, str) and name not in ("", ".", "..") and Path(name).name == name
    if not plain or not (place / "references").is_dir():
        raise SchemaError(
            f"no references: the store of {library} has none, or is not beside it",
            mend="pass references=",
            option="name files with --reference",
            code="references-missing",
        )
    return place


# --- tables ------------------------------------------------------------------------------------------------


def check_table(path: Path, *, overwrite: bool = False) -> None:
    """Refuse a place for a table before anything is read (`StoreError`, which lists all reasons)."""
    check_place(path, "the table", example="agreement.csv", kinds=_TABLES, overwrite=overwrite)


def write_table(validation: Validation, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write the statistics of a validation: ``.csv``, a line for every part of every pair, or ``.json``.

    Numbers have all their digits; what is not known is empty, or null. Raises `StoreError`: see
    `check_table`.
    """
    path = Path(path)
    check_table(path, overwrite=overwrite)
    text = _as_csv(validation) if path.suffix.lower() == ".csv" else _as_json(validation)
    publish_file(path, text.encode(), overwrite=overwrite)


def _names_by_part(table: xr.Dataset) -> list[str]:
    return [str(name) for name, array in table.data_vars.items() if array.dims == ("pair", "part")]


def _as_csv(validation: Validation) -> str:
    names = [*_PAIR, "part", *_names_by_part(validation.statistics), *_DEPTHS]
    written = io.StringIO()
    rows = csv.writer(written, lineterminator="\n")
    rows.writerow(names)
    between = [] if validation.between is None else [validation.between.statistics]
    for table in (validation.statistics, *between):
        for row, column in itertools.product(range(table.sizes["pair"]), range(table.sizes["part"])):
            one = table.isel(pair=row, part=column)
            cells = [_plain(one[name].values.item()) for name in names]
            safe = (safe_cell(cell) if isinstance(cell, str) else cell for cell in cells)
            rows.writerow(["" if cell is None else cell for cell in safe])
    return written.getvalue()


def _pairs_of(validation: Validation) -> list[dict[str, Any]]:
    table = validation.statistics
    pairs = []
    for row in range(table.sizes["pair"]):
        pair = table.isel(pair=row)
        entry = {name: _plain(pair[name].values.item()) for name in (*_PAIR, *_DEPTHS)}
        entry["notes"] = list(validation.notes[row])
        entry["parts"] = {
            str(part): {name: _plain(pair[name].values[column].item()) for name in _names_by_part(table)}
            for column, part in enumerate(table["part"].values)
        }
        pairs.append(entry)
    return pairs


def _as_json(validation: Validation) -> str:
    table = validation.statistics
    by_part = _names_by_part(table)
    document = {
        "passed": validation.passed,
        "tolerance": dict(validation.tolerance),
        "units": {name: table[name].attrs["units"] for name in by_part if "units" in table[name].attrs},
        "parts": {
            str(part): [_plain(float(edge)) for edge in edges]
            for part, *edges in zip(
                table["part"].values,
                table["first_wavelength"].values,
                table["last_wavelength"].values,
                strict=True,
            )
        },
        "pairs": _pairs_of(validation),
        "references_against_one_another": [] if validation.between is None else _pairs_of(validation.between),
        "unpaired_signatures": list(validation.unpaired_signatures),
        "unpaired_references": list(validation.unpaired_references),
        "missing": list(validation.missing),
    }
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
