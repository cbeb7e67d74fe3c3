"""A field day in one call: from a ``collect.toml`` to store, library, validation, maps and report.

Steps are separate workflows. They are run in order; a step whose inputs have not changed is skipped.

Paint libraries in files: signatures of the regions of a store, and validation of a library.
"""

import contextlib
import csv
import functools
import io
import itertools
import json
import math
import operator
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    CROSS_TRACK,
    Alignment,
    CollectError,
    PaintError,
    Problems,
    Progress,
    SchemaError,
    StoreError,
    as_path,
    flags_named,
    one_of,
    part_of,
)
from hyperpaint.geometry import locate
from hyperpaint.geometry.orthorectification.mapping import describe_swath
from hyperpaint.io.collect.collect_toml import Collect, read_collect
from hyperpaint.io.dirsig import write_dirsig
from hyperpaint.io.files.publishing import check_place, publish_file
from hyperpaint.io.files.reading import safe_cell
from hyperpaint.io.library import open_library
from hyperpaint.io.maps.map_grids import RGB_WAVELENGTHS, nearest_bands
from hyperpaint.io.spectrometers.reference_files import open_references, read_pairs
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
from hyperpaint.io.store import (
    INPUTS,
    budget,
    list_groups,
    open_store,
    to_store,
    verify,
)
from hyperpaint.paints.signatures import EXCLUDED, extract_signatures
from hyperpaint.paints.signatures.extraction import MAX_GATHERED_BYTES
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.planning import is_lamp_lit
from hyperpaint.regions import Regions, read_regions, regions_from
from hyperpaint.regions.proposals import propose_regions
from hyperpaint.report.store_report import write_report
from hyperpaint.surroundings.scratch import survey_planned
from hyperpaint.surroundings.surveying import Flagged, flag_line, is_flagged, without_scene_flags
from hyperpaint.validation import Validation, validate

from .maps import LINES, lines_of_store, location_of, map_of_store, mosaic_of_store, write_map
from .pipeline import Record, StepOutcome, run, states_of

MAX_LISTED_REJECTIONS = 10
MAX_STORED_REJECTIONS = 200
#: Attribute ``flags`` of a library from lines without flags of glint, shadow and neighbours.
NOT_DETECTED = "not looked for"
#: Options of `hyperpaint.surroundings.flag` that proposals of regions take too.
_SHARED_OPTIONS = ("glint", "shadow", "adjacency", "sun_zenith")


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
    # Write the signatures of regions on the flight lines of a store, or on a map, and return them.
    #
    # Lines without flags are surveyed and flagged first. Reflectance is computed from stored counts if they
    # exist, with its uncertainty if the noise of the camera is known; else the stored reflectance is used.
    #
    # ``store``: A store with groups ``flightlines/<id>``, as from `hyperpaint.process`; or a store of a
    # single line or map, as from `hyperpaint.workflows.maps.write_map`. Flags are not detected on a map.
    # ``regions``: See `hyperpaint.regions.regions_from`; None takes the regions that
    # `hyperpaint.regions.propose_regions` proposes on every line, with the survey of the flags. ``keep``:
    # Names of flags whose pixels are used, although they are excluded by default; not with ``exclude``.
    # ``flags``: False detects no flags; a mapping holds thresholds of `hyperpaint.surroundings.flag` and
    # options of its survey. ``sun_zenith``: Zenith angle of the sun for flags, proposals and the mirrored sky
    # [degree]; by default from time and position of each line. ``location``: Options of
    # `hyperpaint.workflows.maps.location_of`, which locate lines for regions in map coordinates; by default
    # the attributes of the lines. ``progress``: Called with the work done and the total: surveys, then
    # extraction. ``**options``: As `hyperpaint.extract_signatures`.
    #
    # Raises `FormatError, MissingExtraError, SchemaError, UnitsError`: As `hyperpaint.extract_signatures` and
    # `hyperpaint.surroundings.flag`; or ``keep`` holds an unknown flag, or is combined with ``exclude``.
    # Raises `StoreError`: The store lacks a flight line of the regions; or the library cannot be written, or
    # ``out`` holds other data and ``overwrite`` is False.
    library_path, store_path = as_path(out).resolve(), as_path(store).resolve()
    SchemaError.raise_if(
        library_path == store_path or store_path in library_path.parents,
        f"{out} is in the store itself",
        mend="choose another path for the library",
        code="output-in-store",
    )
    if keep:
        SchemaError.raise_if(
            options.get("exclude") is not None,
            "keep= and exclude= cannot be combined",
            mend="pass one of them",
            code="option-conflict",
        )
        options["exclude"] = EXCLUDED & ~functools.reduce(operator.or_, flags_named(keep))
    outlines = None if regions is None else regions_from(regions)
    requested = () if outlines is None else outlines.flightlines
    # opened lines by name, and the names of lines that have flags
    names, datasets = lines_of_store(store), {}
    if list_groups(store) == [""]:
        dataset = open_store(store)
        if {ALONG_TRACK, CROSS_TRACK} <= set(dataset.dims) or {"y", "x"} <= set(dataset.dims):
            datasets[str(dataset.attrs.get("name", ""))] = dataset
    opened = requested if requested and set(requested) <= set(names) else names
    datasets |= {name: open_store(store, f"{LINES}{name}") for name in opened}
    StoreError.raise_if(
        not datasets,
        f"{store} holds no flight line",
        expected="groups flightlines/<id>, as hyperpaint process writes, or a map (y, x)",
        code="flightline-missing",
    )
    # check the stored flags: computed flags would need all counts
    flagged = {name for name, line in datasets.items() if is_flagged(line)}
    noise = {"electrons_per_count", "read_noise"}
    lines = {
        name: reflectance(line, uncertainty=noise <= set(line.variables))
        if "counts" in line.variables
        else line
        for name, line in datasets.items()
    }
    maps = {name for name, line in lines.items() if ALONG_TRACK not in line.dims}
    if location or (maps and outlines is None):
        # Locate the lines, unless location does not apply
        location = location or {}
        with Problems("signatures cannot be extracted", SchemaError) as problems:
            problems.add_if(
                maps and outlines is None,
                "regions are proposed on flight lines, not on a map",
                mend="draw regions on the map",
                code="regions-missing",
            )
            if location and maps:
                problems.add(
                    "a map has a location", mend=f"leave out {', '.join(location)}", code="location-on-map"
                )
            elif location and (outlines is None or outlines.coordinates != "map"):
                problems.add(
                    f"{', '.join(location)} need regions in map coordinates; "
                    "these regions are in sensor coordinates",
                    code="location-unused",
                )
        lines = {name: locate(line, **location_of(line, **location)) for name, line in lines.items()}
    # thresholds of the caller need flags of their own; proposals need the survey, which stores do not hold
    is_set = flags is not False and (flags is not True or sun_zenith is not None)
    stored = frozenset() if is_set else frozenset(flagged)
    kept = stored if outlines is not None else frozenset()
    lamp_lit = {name for name, line in lines.items() if is_lamp_lit(line)}
    without_flags = kept | maps | (lamp_lit if sun_zenith is None else set())
    unflagged = [name for name in lines if flags is not False and name not in without_flags]
    survey_options = {} if flags is True or flags is False else dict(flags)
    survey_options.setdefault("sun_zenith", sun_zenith)
    new_flags = {}
    for number, name in enumerate(unflagged):
        step_progress = part_of(progress, number, len(unflagged) + 1)
        with survey_planned(lines[name], f"the survey of {name or store}"):
            try:
                line = without_scene_flags(lines[name])
                new_flags[name] = flag_line(line, **{**survey_options, "progress": step_progress})
            except PaintError as error:
                error.note(
                    f"flight line {name!r} has no flags of glint or shadow",
                    mend="flags=False extracts without them",
                    option="--no-flags extracts without them",
                )
                raise
    origins = dict.fromkeys(lines, NOT_DETECTED) | {
        name: f"those of the store, {lines[name]['quality'].attrs.get('flags_from', 'not said from what')}"
        for name in stored & set(lines)
    }
    found = {name: new.line for name, new in new_flags.items() if name not in stored}
    origins |= {name: str(line["quality"].attrs["flags_from"]) for name, line in found.items()}
    targets, refused = _propose(lines, new_flags, survey_options) if outlines is None else (outlines, [])
    lines |= found
    if options.get("specular_sky"):
        options["sun_zenith"] = sun_zenith
        diffuse = survey_options.get("diffuse")
        # diffuse="shadow" is an option of flags only
        options.setdefault("diffuse", None if isinstance(diffuse, str) and diffuse == "shadow" else diffuse)
    step_progress = part_of(progress, len(unflagged), len(unflagged) + 1)
    with contextlib.ExitStack() as stack:
        for name, line in lines.items():
            if name not in maps:
                load, besides = budget.Load.of(line), budget.LOADED + MAX_GATHERED_BYTES
                stack.enter_context(
                    budget.planned(f"extracting from {name or store}", a_thread=load.a_thread, fixed=besides)
                )
        library = extract_signatures(lines, targets, progress=step_progress, **options)
    library.attrs |= {"store": store_path.name, "flags": "; ".join(dict.fromkeys(origins.values()))}
    if refused:
        library.attrs["refused"] = refused[:MAX_STORED_REJECTIONS]
    to_store(library, as_path(out), overwrite=overwrite)
    return library


def _propose(
    lines: Mapping[str, xr.Dataset], flagged: Mapping[str, Flagged], options: Mapping[str, Any]
) -> tuple[Regions, list[str]]:
    # accepted regions, and texts with place and reasons of rejected regions

    # with several lines, names of paints start with the name of the line
    proposals_by_line = {}
    for name, line in lines.items():
        survey = flagged.get(name)
        surveyed, model = (line, None) if survey is None else (survey.surveyed, survey.model)
        # with the model of a survey, only the shared options remain
        names = _SHARED_OPTIONS if survey else set(options) - {"edge"}
        proposals_by_line[name] = propose_regions(
            surveyed,
            model,
            flightline=name,
            name="" if len(lines) == 1 else name,
            **{key: options[key] for key in names if key in options},
        )
    regions = Regions(tuple(region for proposals in proposals_by_line.values() for region in proposals))
    refused = [
        f"{name}, line {along:.0f}, column {across:.0f}: {'; '.join(region.properties['refused'])}"
        for name, proposals in proposals_by_line.items()
        for region in proposals.refused
        for across, along in [region.polygon.mean(axis=0)]
    ]
    listed = "".join(f"\n  {text}" for text in refused[:MAX_LISTED_REJECTIONS])
    SchemaError.raise_if(
        not len(regions),
        f"no region can be proposed, {len(refused)} were rejected{listed}",
        mend="draw regions",
        code="proposals-empty",
    )
    return regions, refused


def table_of(library: xr.Dataset) -> str:
    # Return a table of the paints of a library, one line each.
    names = [str(name) for name in library["signature"].values]
    width = max(map(len, names))
    return "\n".join(
        f"  {name:<{width}}  {n} pixels, {n_eff:.0f} independent"
        + (f", {excluded} left out" if excluded else "")
        for name, n, n_eff, excluded in zip(
            names, *(library[name].values for name in ("n", "n_eff", "n_excluded")), strict=True
        )
    )


_TABLES = (".csv", ".json")
_PAIR_COLUMNS = ("signature", "reference", "instrument", "overlap", "overlap_matched", "mirror_reflection")
_OXYGEN = ("oxygen_residual", "reference_oxygen_residual")


def validate_files(
    library: str | os.PathLike[str],
    references: Sequence[str | os.PathLike[str]] = (),
    *,
    pairs: str | os.PathLike[str] | None = None,
    panel: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Validation:
    # Compare a stored paint library with references in files; see `hyperpaint.validate` for the options.
    #
    # ``references``: as in `open_references`; by default those of the library's store, if it is beside the
    # library; ``pairs``: as in `read_pairs`; ``panel``: as in `read_certificate`.
    #
    # Raises `FormatError`, `SchemaError`, `StoreError` or `UnitsError` if a file cannot be read, or as
    # `validate`.
    signatures = open_library(library)
    name_pairs = None if pairs is None else read_pairs(pairs)
    certificate = None if panel is None else read_certificate(panel)
    if not references:
        name = signatures.attrs.get("store")
        store = as_path(library).absolute().parent / str(name)
        # a plain name only: a path stored in a file must not lead out of the folder
        is_name = isinstance(name, str) and name not in ("", ".", "..") and Path(name).name == name
        SchemaError.raise_if(
            not is_name or not (store / "references").is_dir(),
            f"no references: the store of {library} has none, or is not beside it",
            mend="pass references=",
            option="pass files with --reference",
            code="references-missing",
        )
        references = [store]
    return validate(signatures, open_references(references), name_pairs, panel=certificate, **options)


# --- tables ------------------------------------------------------------------------------------------------


def check_table(path: Path, *, overwrite: bool = False) -> None:
    # Check the path of a table before anything is read; `StoreError` lists all problems.
    check_place(path, "the table", example="agreement.csv", kinds=_TABLES, overwrite=overwrite)


def write_table(validation: Validation, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    # Write the statistics of a validation: ``.csv``, with a row for every part of every pair, or ``.json``.
    #
    # Numbers have all digits; missing values are empty, or null. Raises `StoreError` as `check_table`.
    path = as_path(path)
    check_table(path, overwrite=overwrite)
    statistics, between = validation.statistics, validation.between
    names = _names_by_part(statistics)
    if path.suffix.lower() == ".csv":
        columns, text = [*_PAIR_COLUMNS, "part", *names, *_OXYGEN], io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        for table in (statistics, *([] if between is None else [between.statistics])):
            for pair, part in itertools.product(range(table.sizes["pair"]), range(table.sizes["part"])):
                row = table.isel(pair=pair, part=part)
                cells = [_json_value(row[name].values.item()) for name in columns]
                safe = (safe_cell(cell) if isinstance(cell, str) else cell for cell in cells)
                writer.writerow(["" if cell is None else cell for cell in safe])
        content = text.getvalue()
    else:
        spans = (statistics[name].values for name in ("part", "first_wavelength", "last_wavelength"))
        document = {
            "passed": validation.passed,
            "tolerance": dict(validation.tolerance),
            "units": {
                name: statistics[name].attrs["units"] for name in names if "units" in statistics[name].attrs
            },
            "parts": {
                str(part): [_json_value(float(edge)) for edge in edges]
                for part, *edges in zip(*spans, strict=True)
            },
            "pairs": _pair_entries(validation),
            "references_against_one_another": [] if between is None else _pair_entries(between),
            "unpaired_signatures": list(validation.unpaired_signatures),
            "unpaired_references": list(validation.unpaired_references),
            "missing": list(validation.missing),
        }
        content = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    publish_file(path, content.encode(), overwrite=overwrite)


def _names_by_part(table: xr.Dataset) -> list[str]:
    return [str(name) for name, array in table.data_vars.items() if array.dims == ("pair", "part")]


def _pair_entries(validation: Validation) -> list[dict[str, Any]]:
    table = validation.statistics
    pairs = []
    for row in range(table.sizes["pair"]):
        pair = table.isel(pair=row)
        parts = {
            str(part): {name: _json_value(pair[name].values[column].item()) for name in _names_by_part(table)}
            for column, part in enumerate(table["part"].values)
        }
        entry = {name: _json_value(pair[name].values.item()) for name in (*_PAIR_COLUMNS, *_OXYGEN)}
        pairs.append(entry | {"notes": list(validation.notes[row]), "parts": parts})
    return pairs


def _json_value(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


#: File with checksums of inputs and products of every step: a step with equal inputs is not repeated, and
#: products that another program wrote are replaced only on request.
RECORD = "steps.json"


@dataclass(frozen=True)
class FieldDay:
    # Outcomes of all steps.
    #
    # ``passed``: whether the validation passed, None if nothing was compared; ``errors``: of the failed
    # steps.
    out: Path
    outcomes: tuple[StepOutcome, ...]
    passed: bool | None = None
    errors: tuple[PaintError, ...] = ()

    def __str__(self) -> str:
        width = max(map(len, STEPS))
        return "\n".join(
            [f"{outcome.step:<{width}}  {outcome.state:<9}  {outcome.text}" for outcome in self.outcomes]
        )


def run_field_day(
    collect: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    regions: str | os.PathLike[str] | None = None,
    skip: Collection[str] = (),
    specular_sky: bool = False,
    alignment: Alignment | None = None,
    accept: Collection[str] = (),
    overwrite: bool = False,
    progress: Callable[[str], Progress | None] | None = None,
    say: Callable[[StepOutcome], None] = lambda _: None,
) -> FieldDay:
    """Run all steps of a field day: process, signatures, validation, maps, DIRSIG materials, report.

    A step with the inputs of an earlier run is not repeated, so that the same call resumes an interrupted
    run. A step without inputs in the collect (no references, no height of the ground) is left out. After
    processing, a failing step does not stop the steps after it. Outcomes give the reasons.

    Parameters
    ----------
    collect
        A ``collect.toml``, such as ``hyperpaint init`` writes, or the folder that holds it.
    out
        Folder of the products; by default ``products`` beside the ``collect.toml``.
    regions
        Regions of paint; by default ``regions.geojson`` beside the ``collect.toml``, else proposed roofs of
        cars, see `hyperpaint.regions.propose_regions`.
    skip
        Names of `STEPS` to leave out, except ``"process"``.
    specular_sky
        Subtract the sky that clear coats mirror from the signatures, see `hyperpaint.extract_signatures`. Use
        it for comparison with a contact probe or an integrating sphere, which do not measure mirrored sky.
    alignment, accept
        Correction of wavelengths between camera and record, and accepted findings; see `hyperpaint.process`.
    overwrite
        Replace a store of other inputs, and products that another program wrote or changed.
    progress
        Called with the name of a step; returns a function that is called with the work done and the total.
    say
        Called with the outcome of every step when the step ends.

    Returns
    -------
    FieldDay
        Outcomes of all steps; ``str`` of it is a table.

    Raises
    ------
    SchemaError
        ``skip`` holds an unknown step, or the file of regions does not exist.
    CollectError, FormatError, StoreError, UnitsError, MissingExtraError
        As `hyperpaint.process`.

    Examples
    --------
    >>> print(run_field_day("2021_07_20/collect.toml"))                           # doctest: +SKIP
    """
    with Problems("the field day cannot be run", SchemaError) as problems:
        for name in skip:
            if name == "process":
                problems.add(
                    "skip='process', which all other steps need",
                    mend="call the functions of the other steps",
                    code="step-required",
                )
            else:
                one_of(name, list(STEPS)[1:], "skip", problems=problems)
    path = as_path(collect)
    if path.is_dir():
        path = path / "collect.toml"
        CollectError.raise_if(
            not path.exists(),
            f"{path.parent} holds no collect.toml",
            mend=f"write one with `hyperpaint init {path.parent}`",
            code="collect-missing",
        )
    settings = read_collect(path)
    folder = store_of(path).parent if out is None else as_path(out)
    # every line has a map of its name, and a picture
    names = [str(entry.name) for entry in settings.flightlines]
    makers = Counter(f"{name}{end}".lower() for name in (*names, "mosaic") for end in ("", "_colour"))
    doubles = [name for name, count in makers.items() if count > 1]
    CollectError.raise_if(
        doubles and "map" not in skip,
        f"two products of the flight lines {', '.join(names)} would be {doubles[0] if doubles else ''}.tif",
        mend="change the id of a line in the collect: none can be 'mosaic', or that of another and '_colour'",
        code="name-duplicate",
    )
    if regions is None and (path.parent / "regions.geojson").is_file():
        regions = path.parent / "regions.geojson"
    # check this before hours of processing
    SchemaError.raise_if(
        regions is not None and not as_path(regions).exists(),
        f"regions {regions}: no such file",
        mend="check the path",
        code="file-not-found",
    )
    with StoreError.instead_of(OSError, f"{folder} cannot be written: $error", code="file-unwritable"):
        folder.mkdir(parents=True, exist_ok=True)
    day = FieldDayRun(
        settings=settings,
        out=folder,
        regions=None if regions is None else read_regions(regions),
        specular_sky=specular_sky,
        alignment=alignment,
        accept=tuple(accept),
        overwrite=overwrite,
        progress=progress or (lambda _: None),
        shows_progress=progress is not None,
    )
    for name in STEPS:
        outcome = StepOutcome(name, "left out", "as asked") if name in skip else day.outcome_of(name)
        day.outcomes[name] = outcome
        say(outcome)
    outcomes = tuple(day.outcomes.values())
    errors = tuple(outcome.error for outcome in outcomes if outcome.error is not None)
    return FieldDay(folder, outcomes, day.passed, errors)


def store_of(collect: Path) -> Path:
    # Return the default path of the store of a collect.
    return collect.parent / "products" / "lot.zarr"


@dataclass
class FieldDayRun:
    # Inputs, settings and outcomes of a field day, for the functions of its steps.
    settings: Collect
    out: Path
    regions: Regions | None
    specular_sky: bool
    alignment: Alignment | None
    accept: tuple[str, ...]
    overwrite: bool
    progress: Callable[[str], Progress | None]
    shows_progress: bool
    outcomes: dict[str, StepOutcome] = field(default_factory=dict)
    passed: bool | None = None
    validation: Validation | None = None  #: Result of the step, unless it was made by an earlier run.

    @property
    def store(self) -> Path:
        # Store of the flight lines.
        return self.out / STEPS["process"].product

    @property
    def record(self) -> Record:
        # Record of the products.
        return Record(self.out / RECORD, STEPS)

    @property
    def library(self) -> Path:
        # Library of the signatures.
        return self.out / STEPS["signatures"].product

    @property
    def has_failed(self) -> bool:
        # Whether the library is from an earlier run, because its step failed.
        return self.outcomes["signatures"].state == "failed"

    @functools.cached_property
    def stored_inputs(self) -> dict[str, Any]:
        # Digests of the inputs of the store's groups, which no step after `process` changes.
        groups = (group for group in list_groups(self.store) if group)
        return {group: open_store(self.store, group).attrs.get(INPUTS) for group in groups}

    @functools.cached_property
    def located_lines(self) -> tuple[str, ...]:
        # Names of the flight lines with navigation, from which maps are made: two scan lines or more.
        lines = ((name, open_store(self.store, f"{LINES}{name}")) for name in lines_of_store(self.store))
        return tuple(
            name for name, line in lines if "latitude" in line.variables and line.sizes[ALONG_TRACK] > 1
        )

    @property
    def is_visible(self) -> bool:
        # Whether maps have the bands of a picture in true colours; all lines were flown with one camera.
        line = open_store(self.store, f"{LINES}{self.located_lines[0]}")
        return nearest_bands(line["wavelength"].values, RGB_WAVELENGTHS) is not None

    @property
    def heights(self) -> dict[str, Any]:
        # Height model of ``[geometry]``; the lines of the store have all of its other keys.
        geometry = self.settings.geometry
        return {name: geometry[name] for name in ("dem", "dem_heights", "geoid") if name in geometry}

    def outcome_of(self, name: str) -> StepOutcome:
        # Make the product of a step, unless an input is missing or the product is current.
        step = STEPS[name]
        if name == "process":
            return _process(self)
        for need in step.needs:
            is_met, reason = _NEEDS[need]
            if not is_met(self):
                return StepOutcome(name, "left out", reason)
        lines = self.located_lines if "{line}" in step.product else ("",)
        paths = tuple(self.out / step.product.format(line=line) for line in lines)
        if step.inputs == _OF_MAPS and self.is_visible:
            paths += tuple(map(colours_of, paths))
        inputs = [
            self.stored_inputs,
            {entry: _INPUTS[entry](self) for entry in step.inputs},
        ]
        record = self.record
        outcome = record.produce(
            name, paths, inputs, functools.partial(step.make, self), overwrite=self.overwrite
        )
        if name == "validate" and outcome.state == "unchanged":
            self.passed = record.entries().get("passed")
        # proposed regions have no names to compare, and references may have no places
        return (
            StepOutcome(name, "left out", outcome.error.text(on_command_line=True))
            if self.regions is None and outcome.error and "reference-unmatched" in outcome.error.codes
            else outcome
        )


# --- the steps ---------------------------------------------------------------------------------------------


def _process(day: FieldDayRun) -> StepOutcome:

    outcome = run(
        day.settings.path,
        day.store,
        alignment=day.alignment,
        flags=True,
        accept=day.accept,
        overwrite=day.overwrite,
        progress=day.shows_progress,
    )
    state = "done" if outcome.written else "unchanged"
    corrected = [f"{name}: {text}" for name, text in outcome.corrected.items()]
    return StepOutcome("process", state, "\n".join([str(day.store), *corrected]), (day.store,))


def _signatures(day: FieldDayRun) -> str:

    # lines have all of [geometry] except a height model, which only regions in map coordinates need
    is_map = day.regions is not None and day.regions.coordinates == "map"
    library = write_signatures(
        day.store,
        day.regions,
        day.library,
        overwrite=True,
        specular_sky=day.specular_sky,
        location=day.heights if is_map else {},
        drop_small=True,
        progress=day.progress("signatures"),
    )
    left_out = [f"left out {text}" for text in library.attrs.get("left_out", ())]
    return "\n".join([f"{day.library}: {library.sizes['signature']} paints", *left_out])


def _validate(day: FieldDayRun) -> str:

    day.validation = validation = validate_files(day.library)
    day.passed = validation.passed
    table = day.out / "agreement.csv"
    write_table(validation, table, overwrite=True)
    # before the step is recorded as done: a run that is killed between them validates again
    day.record.write({"passed": validation.passed})
    verdict = "passed" if validation.passed else f"NOT passed: {'; '.join(validation.problems[:3])}"
    return f"{table}: {verdict}"


def colours_of(path: Path) -> Path:
    # Return the path of the picture in true colours of a map.
    return path.with_name(f"{path.stem}_colour{path.suffix}")


def _map(day: FieldDayRun) -> str:

    lines, texts = day.located_lines, []
    for number, line in enumerate(lines):
        share = part_of(day.progress("map"), number, len(lines))
        orthomap = map_of_store(
            day.store, line, gsd=None, grid="north", method="nearest", progress=share, **day.heights
        )
        path = day.out / f"{line}.tif"
        write_map(orthomap, path, colours=colours_of(path), overwrite=True)
        texts.append(f"{path}: {describe_swath(orthomap.attrs)}")
    others = [line for line in lines_of_store(day.store) if line not in lines]
    return "\n".join([*texts, *(f"left out {line}: no navigation, or a single scan line" for line in others)])


def _mosaic(day: FieldDayRun) -> str:
    path = day.out / "mosaic.tif"
    # lines without navigation cannot be mapped
    mosaic = mosaic_of_store(day.store, day.located_lines, progress=day.progress("mosaic"), **day.heights)
    write_map(mosaic, path, colours=colours_of(path), overwrite=True)
    return f"{path}: lines {', '.join(mosaic.attrs['flightlines'])}, the steepest view on top"


def _dirsig(day: FieldDayRun) -> str:

    folder = day.out / "dirsig"
    materials = write_dirsig(
        open_library(day.library),
        folder,
        gaps="interpolate",
        overwrite=True,
        progress=day.progress("dirsig"),
    )
    return f"{folder}: {materials.sizes['signature']} materials"


def _report(day: FieldDayRun) -> str:

    page = write_report(
        day.store,
        day.out / "report.html",
        library=day.library if day.library.exists() and not day.has_failed else None,
        validation=day.validation,
        overwrite=True,
        progress=day.progress("report"),
    )
    damaged = [text for text in (verify(day.store).problems if page.problems else ()) if "[chunk-" in text]
    StoreError.raise_if(
        damaged,
        f"{day.store}: {'; '.join(damaged[:3])}",
        mend="delete these files of the store, and run again: their lines are written again",
        code="store-damaged",
    )
    return "; ".join([str(page.path), *(f"cannot be read: {problem}" for problem in page.problems)])


# --- declarations ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    # Declaration of a step: its product, the function that makes it, and its inputs.
    product: str  #: File or folder of the product; with ``{line}`` a file for every located line.
    make: Callable[[FieldDayRun], Any]  #: Makes the product, and returns a text for the report.
    inputs: tuple[str, ...] = ()  #: Inputs besides the store; keys of `_INPUTS`.
    needs: tuple[str, ...] = ()  #: Conditions, without which the step is left out; keys of `_NEEDS`.


#: Values of the inputs of steps: a product is made again when they change.
_INPUTS: Mapping[str, Callable[[FieldDayRun], Any]] = {
    "specular_sky": lambda day: day.specular_sky,
    "regions": lambda day: None if day.regions is None else day.regions.digest,
    "library": lambda day: states_of([day.library]),
    "has_library": lambda day: day.library.exists() and not day.has_failed,
    "geometry": lambda day: {key: str(value) for key, value in day.settings.geometry.items()},
    "geometry_files": lambda day: states_of(
        value for value in day.settings.geometry.values() if isinstance(value, Path)
    ),
}

#: Conditions of steps, and the texts where they are not met.
_NEEDS: Mapping[str, tuple[Callable[[FieldDayRun], bool], str]] = {
    "new_library": (
        lambda day: not day.has_failed,
        "the step signatures failed, and an existing library is from an earlier run",
    ),
    "library": (lambda day: day.library.exists(), "there is no library of signatures"),
    "references": (lambda day: bool(day.settings.references), "the collect names no [[references]]"),
    "sun_or_regions": (
        lambda day: day.regions is not None or day.settings.white is None or bool(day.located_lines),
        "regions of paint are proposed in sunlight at a known place; draw regions.geojson beside the collect",
    ),
    "ground": (
        lambda day: bool({"ground", "dem"} & set(day.settings.geometry)),
        "the height of the ground is missing: [geometry] ground, above the ellipsoid, or dem",
    ),
    "located": (lambda day: bool(day.located_lines), "no flight line has navigation"),
    "two_located": (
        lambda day: len(day.located_lines) > 1,
        "a mosaic needs at least two flight lines with navigation",
    ),
}

_OF_PAINTS = ("specular_sky", "regions")
_OF_MAPS = ("geometry", "geometry_files")
_LIBRARY = ("new_library", "library")

#: Steps of a field day in their order; all except the first may be skipped.
STEPS: dict[str, Step] = {
    "process": Step("lot.zarr", _process),
    "signatures": Step("paints.zarr", _signatures, _OF_PAINTS, ("sun_or_regions",)),
    "validate": Step("agreement.csv", _validate, (*_OF_PAINTS, "library"), (*_LIBRARY, "references")),
    "map": Step("{line}.tif", _map, _OF_MAPS, ("ground", "located")),
    "mosaic": Step("mosaic.tif", _mosaic, _OF_MAPS, ("ground", "located", "two_located")),
    "dirsig": Step("dirsig", _dirsig, (*_OF_PAINTS, "library"), _LIBRARY),
    "report": Step("report.html", _report, (*_OF_PAINTS, "library", "has_library")),
}
