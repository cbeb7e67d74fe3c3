"""A field day in one call: from a ``collect.toml`` to store, library, validation, maps and report.

Steps are separate workflows. They are run in order; a step whose inputs have not changed is skipped.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hyperpaint.base.constants import Alignment
from hyperpaint.base.errors import CollectError, PaintError, Problems, SchemaError, StoreError
from hyperpaint.base.facts import one_of
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.progress_reports import part_of
from hyperpaint.geometry.orthorectification.mapping import describe_swath
from hyperpaint.io.collect.collect_toml import Collect, read_collect
from hyperpaint.io.dirsig import write_dirsig
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.library import open_library
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.io.store.groups import version_of_program
from hyperpaint.io.store.manifest import INPUTS
from hyperpaint.regions import Regions, read_regions
from hyperpaint.report.store_report import write_report

from .library_files import validate_files, write_signatures, write_table
from .maps import map_of_store, mosaic_of_store, write_map
from .pipeline import run

#: Steps of a field day in their order; all except the first may be skipped.
STEPS = ("process", "signatures", "validate", "map", "mosaic", "dirsig", "report")

#: File with checksums of inputs and products of every step: a step with equal inputs is not repeated, and
#: products that another program wrote are replaced only on request.
RECORD = "steps.json"

_PRODUCTS = {
    "signatures": "paints.zarr",
    "validate": "agreement.csv",
    "mosaic": "mosaic.tif",
    "dirsig": "dirsig",
    "report": "report.html",
}

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class StepOutcome:
    """Outcome of a step.

    Attributes
    ----------
    step
        One of `STEPS`.
    state
        ``"done"``, ``"unchanged"`` (products of the same inputs exist), ``"left out"`` or ``"failed"``.
    text
        Products, or the reason why there are none.
    paths
        Files of the products.
    """

    step: str
    state: str
    text: str
    paths: tuple[Path, ...] = ()


@dataclass(frozen=True)
class FieldDay:
    """Outcomes of all steps.

    ``passed``: whether the validation passed, None if nothing was compared; ``errors``: of the failed steps.
    """

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
            one_of(name, STEPS[1:], "skip", problems=problems)
    problems.raise_if_any()
    path = Path(collect)
    if path.is_dir():
        path = path / "collect.toml"
        if not path.exists():
            raise CollectError(
                f"{path.parent} holds no collect.toml",
                mend=f"write one with `hyperpaint init {path.parent}`",
                code="collect-missing",
            )
    settings = read_collect(path)
    folder = store_of(path).parent if out is None else Path(out)
    if regions is None and (path.parent / "regions.geojson").is_file():
        regions = path.parent / "regions.geojson"
    # check this before hours of processing
    if regions is not None and not Path(regions).exists():
        raise SchemaError(f"regions {regions}: no such file", mend="check the path", code="file-not-found")
    day = _FieldDayRun(
        settings=settings,
        out=folder,
        regions=None if regions is None else read_regions(regions),
        skip=frozenset(skip),
        specular_sky=specular_sky,
        alignment=alignment,
        accept=tuple(accept),
        overwrite=overwrite,
        progress=progress or (lambda _: None),
        shows_progress=progress is not None,
        say=say,
    )
    folder.mkdir(parents=True, exist_ok=True)
    for step in STEPS:
        day.run_step(step)
    return FieldDay(folder, tuple(day.outcomes), day.passed, tuple(day.errors))


def store_of(collect: Path) -> Path:
    """Return the default path of the store of a collect."""
    return collect.parent / "products" / "lot.zarr"


@dataclass
class _FieldDayRun:
    settings: Collect
    out: Path
    regions: Regions | None
    skip: frozenset[str]
    specular_sky: bool
    alignment: Alignment | None
    accept: tuple[str, ...]
    overwrite: bool
    progress: Callable[[str], Progress | None]
    shows_progress: bool
    say: Callable[[StepOutcome], None]
    outcomes: list[StepOutcome] = field(default_factory=list)
    passed: bool | None = None
    errors: list[PaintError] = field(default_factory=list)

    @property
    def store(self) -> Path:
        return self.out / store_of(self.settings.path).name

    @property
    def library(self) -> Path:
        return self.out / "paints.zarr"

    def run_step(self, step: str) -> None:
        if step in self.skip:
            self._note(StepOutcome(step, "left out", "as asked"))
            return
        if step == "process":
            self._note(self._process())
            return
        missing = self._missing_input(step)
        if missing:
            self._note(StepOutcome(step, "left out", missing))
            return
        inputs, products = self._digest(step), self._products(step)
        entry = self._record().get(step)
        if entry == {"inputs": inputs, "products": _states(products)} and all(map(Path.exists, products)):
            if step == "validate":
                self.passed = self._record().get("passed")
            self._note(StepOutcome(step, "unchanged", _listed(products), products))
            return
        try:
            self._refuse_foreign(entry, products)
            # if this run is interrupted, its products are not taken for those of another program
            self._write_record({step: _UNFINISHED})
            text = {
                "signatures": self._signatures,
                "validate": self._validate,
                "map": self._map,
                "mosaic": self._mosaic,
                "dirsig": self._dirsig,
                "report": self._report,
            }[step]()
        except PaintError as error:
            # later steps do not depend on this one, except on the library, which they check
            self.errors.append(error)
            self._note(StepOutcome(step, "failed", str(error)))
            return
        entries: dict[str, Any] = {step: {"inputs": inputs, "products": _states(products)}}
        if step == "validate":
            entries["passed"] = self.passed
        self._write_record(entries)
        self._note(StepOutcome(step, "done", text, products))

    def _refuse_foreign(self, entry: Any, products: Collection[Path]) -> None:
        if self.overwrite or entry == _UNFINISHED:
            return
        states = entry["products"] if entry else {}
        foreign = [
            path for path in products if path.exists() and _states([path])[path.name] != states.get(path.name)
        ]
        if foreign:
            raise StoreError(
                f"{_listed(foreign)}: written or changed by another program",
                mend="move them away, or pass overwrite=True",
                option="move them away, or use --overwrite",
                code="product-foreign",
            )

    @property
    def _library_failed(self) -> bool:
        return any(outcome.step == "signatures" and outcome.state == "failed" for outcome in self.outcomes)

    def _note(self, outcome: StepOutcome) -> None:
        self.outcomes.append(outcome)
        self.say(outcome)

    # --- inputs of a step ---

    def _missing_input(self, step: str) -> str:
        # the missing input of a step in words; empty if all exist
        needs_library = step in ("validate", "dirsig")
        if needs_library and self._library_failed:
            return "the step signatures failed, and an existing library is from an earlier run"
        if needs_library and not self.library.exists():
            return "there is no library of signatures"
        if step == "validate" and not self.settings.references:
            return "the collect names no [[references]]"
        if step == "validate" and self.regions is None:
            return (
                "proposed regions do not have the names of the references; draw regions with these names, or "
                "compare with hyperpaint validate --pairs"
            )
        if step in ("map", "mosaic"):
            if not {"ground", "dem"} & set(self.settings.geometry):
                return "the height of the ground is missing: [geometry] ground, above the ellipsoid, or dem"
            if not self._located_lines():
                return "no flight line has navigation"
        if step == "mosaic" and len(self._located_lines()) < 2:
            return "a mosaic needs at least two flight lines with navigation"
        return ""

    def _products(self, step: str) -> tuple[Path, ...]:
        if step == "map":
            return tuple(self.out / f"{name}.tif" for name in self._located_lines())
        return (self.out / _PRODUCTS[step],)

    def _located_lines(self) -> tuple[str, ...]:
        lines = [name for name in list_groups(self.store) if name.startswith("flightlines/")]
        located = [name for name in lines if "latitude" in open_store(self.store, name).variables]
        return tuple(name.removeprefix("flightlines/") for name in located)

    def _digest(self, step: str) -> str:
        # digest of the inputs of a step: groups of the store, regions, settings, version

        groups = {
            name: open_store(self.store, name).attrs.get(INPUTS) for name in list_groups(self.store) if name
        }
        parts: list[Any] = [version_of_program(), step, groups]
        if step not in ("map", "mosaic"):
            parts.append(self.specular_sky)
        if step in ("signatures", "validate", "dirsig", "report"):
            parts.append(None if self.regions is None else self.regions.digest)
        if step in ("validate", "dirsig", "report"):
            parts.append(_states([self.library]))
        if step in ("map", "mosaic"):
            parts.append({key: str(value) for key, value in sorted(self.settings.geometry.items())})
            parts.append(
                _states(value for value in self.settings.geometry.values() if isinstance(value, Path))
            )
        if step == "report":
            parts.append(self.library.exists() and not self._library_failed)
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()

    def _record(self) -> dict[str, Any]:
        path = self.out / RECORD
        if not path.is_file():
            return {}
        try:
            record = json.loads(read_limited(path, 1 << 20, "the record of a field day"))
        except ValueError:
            record = None
        entries = record if isinstance(record, dict) else dict.fromkeys(STEPS)
        # products whose entry is damaged may be those of a run, and may be replaced
        return {
            step: _UNFINISHED if step in STEPS and not _is_entry(entry) else entry
            for step, entry in entries.items()
        }

    def _write_record(self, entries: Mapping[str, Any]) -> None:

        content = json.dumps({**self._record(), **entries}, indent=1, sort_keys=True)
        publish_file(self.out / RECORD, content.encode(), overwrite=True)

    # --- the steps ---

    def _process(self) -> StepOutcome:

        outcome = run(
            self.settings.path,
            self.store,
            alignment=self.alignment,
            accept=self.accept,
            overwrite=self.overwrite,
            progress=self.shows_progress,
        )
        state = "done" if outcome.written else "unchanged"
        corrected = [f"{name}: {text}" for name, text in outcome.corrected.items()]
        return StepOutcome("process", state, "\n".join([str(self.store), *corrected]), (self.store,))

    def _signatures(self) -> str:

        # lines have all of [geometry] except a height model, which only regions in map coordinates need
        is_map = self.regions is not None and self.regions.coordinates == "map"
        library = write_signatures(
            self.store,
            self.regions,
            self.library,
            overwrite=True,
            specular_sky=self.specular_sky,
            location=self._heights if is_map else {},
            drop_small=True,
            progress=self.progress("signatures"),
        )
        left_out = [f"left out {text}" for text in library.attrs.get("left_out", ())]
        return "\n".join([f"{self.library}: {library.sizes['signature']} paints", *left_out])

    def _validate(self) -> str:

        validation = validate_files(self.library)
        self.passed = validation.passed
        table = self.out / "agreement.csv"
        write_table(validation, table, overwrite=True)
        verdict = "passed" if validation.passed else f"NOT passed: {'; '.join(validation.problems[:3])}"
        return f"{table}: {verdict}"

    def _map(self) -> str:

        lines, texts = self._located_lines(), []
        for number, line in enumerate(lines):
            share = part_of(self.progress("map"), number, len(lines))
            orthomap = map_of_store(
                self.store, line, gsd=None, grid="north", method="nearest", progress=share, **self._heights
            )
            path = self.out / f"{line}.tif"
            write_map(orthomap, path, overwrite=True)
            texts.append(f"{path}: {describe_swath(orthomap.attrs)}")
        return "\n".join(texts)

    def _mosaic(self) -> str:
        path = self.out / _PRODUCTS["mosaic"]
        # lines without navigation cannot be mapped
        lines = self._located_lines()
        mosaic = mosaic_of_store(self.store, lines, progress=self.progress("mosaic"), **self._heights)
        write_map(mosaic, path, overwrite=True)
        return f"{path}: lines {', '.join(mosaic.attrs['flightlines'])}, the steepest view on top"

    @property
    def _heights(self) -> dict[str, Any]:
        geometry = self.settings.geometry
        return {name: geometry[name] for name in ("dem", "dem_heights", "geoid") if name in geometry}

    def _dirsig(self) -> str:

        folder = self.out / "dirsig"
        materials = write_dirsig(
            open_library(self.library),
            folder,
            gaps="interpolate",
            overwrite=True,
            progress=self.progress("dirsig"),
        )
        return f"{folder}: {materials.sizes['signature']} materials"

    def _report(self) -> str:

        library = self.library if self.library.exists() and not self._library_failed else None
        page = write_report(
            self.store,
            self.out / "report.html",
            library=library,
            overwrite=True,
            progress=self.progress("report"),
        )
        problems = f"; cannot be read: {'; '.join(page.problems)}" if page.problems else ""
        return f"{page.path}{problems}"


#: Entry of a step that was started and not finished: its products may be those of a run.
_UNFINISHED: dict[str, Any] = {"inputs": None, "products": None}


_HASH = "blake2b"


def _is_entry(entry: Any) -> bool:
    # whether an entry has checksums of products in the form that `_states` returns
    products = entry["products"] if isinstance(entry, dict) and set(entry) == set(_UNFINISHED) else None
    return isinstance(products, dict) and all(
        not state or str(state).startswith(f"{_HASH}:") for state in products.values()
    )


def _states(paths: Iterable[Path]) -> dict[str, str]:
    # checksums by name: of a file's content, of all files of a folder, of the metadata of a store
    states: dict[str, str] = {}
    for path in paths:
        files = [path] if path.is_file() else []
        if path.is_dir():
            # metadata of a store contain checksums of its chunks
            pattern = "zarr.json" if (path / "zarr.json").is_file() else "*"
            files = sorted(file_path for file_path in path.rglob(pattern) if file_path.is_file())
        sums = []
        for file_path in files:
            with open(file_path, "rb") as file:
                sums.append(
                    (file_path.relative_to(path).as_posix(), hashlib.file_digest(file, _HASH).hexdigest())
                )
        states[path.name] = f"{_HASH}:{hashlib.sha256(json.dumps(sums).encode()).hexdigest()}" if sums else ""
    return states


def _listed(paths: Collection[Path]) -> str:
    return ", ".join(map(str, paths))
