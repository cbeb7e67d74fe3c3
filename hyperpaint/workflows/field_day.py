"""A field day in one call: from a ``collect.toml`` to store, library, validation, maps and report.

Steps are separate workflows. They are run in order; a step whose inputs have not changed is skipped.
"""

import functools
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hyperpaint.base import Alignment, CollectError, PaintError, Problems, SchemaError, one_of, part_of
from hyperpaint.geometry.orthorectification.mapping import describe_swath
from hyperpaint.io.collect.collect_toml import Collect, read_collect
from hyperpaint.io.dirsig import write_dirsig
from hyperpaint.io.library import open_library
from hyperpaint.io.maps.map_grids import RGB_WAVELENGTHS, nearest_bands
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.io.store.manifest import INPUTS
from hyperpaint.regions import Regions, read_regions
from hyperpaint.report.store_report import write_report
from hyperpaint.validation import Validation

from .library_files import validate_files, write_signatures, write_table
from .maps import LINES, lines_of_store, map_of_store, mosaic_of_store, write_map
from .pipeline import Record, StepOutcome, run, states_of

#: File with checksums of inputs and products of every step: a step with equal inputs is not repeated, and
#: products that another program wrote are replaced only on request.
RECORD = "steps.json"

Progress = Callable[[int, int], None]


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
    problems = Problems("the field day cannot be run", SchemaError)
    for name in skip:
        if name == "process":
            problems.add(
                "skip='process', which all other steps need",
                mend="call the functions of the other steps",
                code="step-required",
            )
        else:
            one_of(name, list(STEPS)[1:], "skip", problems=problems)
    problems.raise_if_any()
    path = Path(collect)
    if path.is_dir():
        path = path / "collect.toml"
        CollectError.raise_if(
            not path.exists(),
            f"{path.parent} holds no collect.toml",
            mend=f"write one with `hyperpaint init {path.parent}`",
            code="collect-missing",
        )
    settings = read_collect(path)
    folder = store_of(path).parent if out is None else Path(out)
    if regions is None and (path.parent / "regions.geojson").is_file():
        regions = path.parent / "regions.geojson"
    # check this before hours of processing
    SchemaError.raise_if(
        regions is not None and not Path(regions).exists(),
        f"regions {regions}: no such file",
        mend="check the path",
        code="file-not-found",
    )
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
    def located_lines(self) -> tuple[str, ...]:
        # Names of the flight lines with navigation, from which maps are made.
        lines = ((name, open_store(self.store, f"{LINES}{name}")) for name in lines_of_store(self.store))
        return tuple(name for name, line in lines if "latitude" in line.variables)

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
            {
                group: open_store(self.store, group).attrs.get(INPUTS)
                for group in list_groups(self.store)
                if group
            },
            {entry: _INPUTS[entry](self) for entry in step.inputs},
        ]
        record = self.record
        outcome = record.produce(
            name, paths, inputs, functools.partial(step.make, self), overwrite=self.overwrite
        )
        if name == "validate" and outcome.state == "unchanged":
            self.passed = record.entries().get("passed")
        # proposed regions have no names to compare, and references may have no places
        if self.regions is None and outcome.error and "reference-unmatched" in outcome.error.codes:
            return StepOutcome(name, "left out", outcome.error.text(on_command_line=True))
        return outcome


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
    return "\n".join(texts)


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

    library = day.library if day.library.exists() and not day.has_failed else None
    page = write_report(
        day.store,
        day.out / "report.html",
        library=library,
        validation=day.validation,
        overwrite=True,
        progress=day.progress("report"),
    )
    problems = f"; cannot be read: {'; '.join(page.problems)}" if page.problems else ""
    return f"{page.path}{problems}"


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
