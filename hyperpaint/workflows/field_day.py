"""A whole field day in one call: from a ``collect.toml`` to store, library, validation, maps and report.

Every step is a workflow of its own; here they are put in order, and left alone where what they are made from
has not changed.
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
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.progress_reports import part_of
from hyperpaint.io.collect.collect_toml import Collect, read_collect
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.regions import Regions, read_regions

from .maps import map_of_store, mosaic_of_store, write_map

#: Steps of a field day, in this order; all but the first may be skipped.
STEPS = ("process", "signatures", "validate", "map", "mosaic", "dirsig", "report")

#: File with the inputs and outputs of every step: a step with equal inputs is not repeated, and files that
#: another program wrote are replaced on request only.
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
    """Outcome of one step.

    Attributes
    ----------
    step
        One of `STEPS`.
    state
        ``"done"``, ``"unchanged"`` (complete, from the same inputs), ``"left out"`` or ``"failed"``.
    text
        Products written, or the reason for none.
    paths
        Files to look at.
    """

    step: str
    state: str
    text: str
    paths: tuple[Path, ...] = ()


@dataclass(frozen=True)
class FieldDay:
    """Outcomes of all steps, and whether the validation passed; None where nothing was compared.

    ``errors``: of the steps that failed.
    """

    out: Path
    outcomes: tuple[StepOutcome, ...]
    passed: bool | None = None
    errors: tuple[PaintError, ...] = ()

    def __str__(self) -> str:
        width = max(map(len, STEPS))
        return "\n".join([f"{one.step:<{width}}  {one.state:<9}  {one.text}" for one in self.outcomes])


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
    """Do all that a field day asks for: process, signatures, validation, maps, DIRSIG materials, report.

    A step whose inputs are those of an earlier run is left as it is, so that an interrupted run goes on where
    it ended. A step that the collect has nothing for (no references, no height of the ground) is left out,
    and says so. Where processing is done, a step that fails says why, and the others are done.

    Parameters
    ----------
    collect
        A ``collect.toml``, such as ``hyperpaint init`` writes, or the folder that holds it.
    out
        Folder of the products; by default ``products`` beside the ``collect.toml``.
    regions
        Regions of paint; by default ``regions.geojson`` beside the ``collect.toml``, else roofs of cars that
        are proposed by rule.
    skip
        Names of `STEPS` that are left out; not ``"process"``.
    specular_sky
        Subtract the sky that clear coats mirror from the signatures, see `hyperpaint.extract_signatures`:
        what a field spectrometer with a contact probe, or a sphere, does not see.
    alignment, accept
        See `hyperpaint.process`: what is corrected between camera and record, findings to go on with.
    overwrite
        Replace a store of other inputs, and products that were not written by a run.
    progress
        Called with the name of a step; returns what is called with work done and to do.
    say
        Called with each outcome as soon as it is known.

    Returns
    -------
    FieldDay
        ``str`` of it is a table.

    Raises
    ------
    SchemaError
        ``skip`` names no step, or there is no such file of regions.
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
                mend="call the functions of those steps",
                code="step-required",
            )
        elif name not in STEPS:
            problems.add(
                f"skip={name!r}", expected=f"one of {', '.join(map(repr, STEPS[1:]))}", code="choice-unknown"
            )
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
    # before hours of processing, not after them
    if regions is not None and not Path(regions).exists():
        raise SchemaError(f"no file of regions {regions}", mend="check the path", code="file-not-found")
    day = _Day(
        settings=settings,
        out=folder,
        regions=None if regions is None else read_regions(regions),
        skip=frozenset(skip),
        specular_sky=specular_sky,
        alignment=alignment,
        accept=tuple(accept),
        overwrite=overwrite,
        progress=progress or (lambda _: None),
        is_watched=progress is not None,
        say=say,
    )
    folder.mkdir(parents=True, exist_ok=True)
    for step in STEPS:
        day.do(step)
    return FieldDay(folder, tuple(day.outcomes), day.passed, tuple(day.errors))


def store_of(collect: Path) -> Path:
    """Return where the store of a collect is written, where nobody says otherwise."""
    return collect.parent / "products" / "lot.zarr"


@dataclass
class _Day:
    settings: Collect
    out: Path
    regions: Regions | None
    skip: frozenset[str]
    specular_sky: bool
    alignment: Alignment | None
    accept: tuple[str, ...]
    overwrite: bool
    progress: Callable[[str], Progress | None]
    is_watched: bool
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

    def do(self, step: str) -> None:
        if step in self.skip:
            self._note(StepOutcome(step, "left out", "as asked"))
            return
        if step == "process":
            self._note(self._process())
            return
        missing = self._lacks(step)
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
            # whatever is there from now on is of this run, should it be interrupted
            self._write_record({step: _UNKNOWN})
            text = {
                "signatures": self._signatures,
                "validate": self._validate,
                "map": self._map,
                "mosaic": self._mosaic,
                "dirsig": self._dirsig,
                "report": self._report,
            }[step]()
        except PaintError as error:
            # the steps after it do not depend on it, but for the library, which they look for
            self.errors.append(error)
            self._note(StepOutcome(step, "failed", str(error)))
            return
        entries: dict[str, Any] = {step: {"inputs": inputs, "products": _states(products)}}
        if step == "validate":
            entries["passed"] = self.passed
        self._write_record(entries)
        self._note(StepOutcome(step, "done", text, products))

    def _refuse_foreign(self, entry: Any, products: Collection[Path]) -> None:
        if self.overwrite or entry == _UNKNOWN:
            return
        states = entry["products"] if entry else {}
        foreign = [
            path for path in products if path.exists() and _states([path])[path.name] != states.get(path.name)
        ]
        if foreign:
            raise StoreError(
                f"{_listed(foreign)}: not written by a run, or changed since",
                mend="move it away, or pass overwrite=True",
                option="move it away, or use --overwrite",
                code="product-foreign",
            )

    @property
    def _library_failed(self) -> bool:
        return any(each.step == "signatures" and each.state == "failed" for each in self.outcomes)

    def _note(self, outcome: StepOutcome) -> None:
        self.outcomes.append(outcome)
        self.say(outcome)

    # --- inputs of a step ---

    def _lacks(self, step: str) -> str:
        # empty where the inputs of the step exist
        needs_library = step in ("validate", "dirsig")
        if needs_library and self._library_failed:
            return "the signatures failed; a library that is there is of an earlier run"
        if needs_library and not self.library.exists():
            return "there is no library of signatures"
        if step == "validate" and not self.settings.references:
            return "the collect names no [[references]]"
        if step == "validate" and self.regions is None:
            return (
                "paints that are proposed by rule have names of their own; draw regions that are named as "
                "the references are, or compare with hyperpaint validate --pairs"
            )
        if step in ("map", "mosaic"):
            if not {"ground", "dem"} & set(self.settings.geometry):
                return "the height of the ground is not known: [geometry] ground, above the ellipsoid, or dem"
            if not self._mapped():
                return "no flight line has navigation"
        if step == "mosaic" and len(self._mapped()) < 2:
            return "one flight line makes no mosaic"
        return ""

    def _products(self, step: str) -> tuple[Path, ...]:
        if step == "map":
            return tuple(self.out / f"{name}.tif" for name in self._mapped())
        return (self.out / _PRODUCTS[step],)

    def _mapped(self) -> tuple[str, ...]:
        lines = [name for name in list_groups(self.store) if name.startswith("flightlines/")]
        located = [name for name in lines if "latitude" in open_store(self.store, name).variables]
        return tuple(name.removeprefix("flightlines/") for name in located)

    def _digest(self, step: str) -> str:
        # of groups of the store, regions, settings, version
        from hyperpaint.io.store.groups import version_of_program
        from hyperpaint.io.store.manifest import INPUTS

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
        # entries that a damaged record has lost may belong to a run
        return {
            step: _UNKNOWN if step in STEPS and not _is_entry(entry) else entry
            for step, entry in entries.items()
        }

    def _write_record(self, entries: Mapping[str, Any]) -> None:
        from hyperpaint.io.files.publishing import publish_file

        content = json.dumps({**self._record(), **entries}, indent=1, sort_keys=True)
        publish_file(self.out / RECORD, content.encode(), overwrite=True)

    # --- the steps ---

    def _process(self) -> StepOutcome:
        from .pipeline import run

        done = run(
            self.settings.path,
            self.store,
            alignment=self.alignment,
            accept=self.accept,
            overwrite=self.overwrite,
            progress=self.is_watched,
        )
        state = "done" if done.written else "unchanged"
        corrected = [f"{name}: {text}" for name, text in done.corrected.items()]
        return StepOutcome("process", state, "\n".join([str(self.store), *corrected]), (self.store,))

    def _signatures(self) -> str:
        from .library_files import write_signatures

        # lines carry all of [geometry] but a height model, which only regions of a map need
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
        from .library_files import validate_files, write_table

        validation = validate_files(self.library)
        self.passed = validation.passed
        table = self.out / "agreement.csv"
        write_table(validation, table, overwrite=True)
        verdict = "passed" if validation.passed else f"NOT passed: {'; '.join(validation.problems[:3])}"
        return f"{table}: {verdict}"

    def _map(self) -> str:
        from hyperpaint.geometry.orthorectification.mapping import describe_swath

        lines, texts = self._mapped(), []
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
        # lines without navigation have no place; the step map lists them
        lines = self._mapped()
        mosaic = mosaic_of_store(self.store, lines, progress=self.progress("mosaic"), **self._heights)
        write_map(mosaic, path, overwrite=True)
        return f"{path}: lines {', '.join(mosaic.attrs['flightlines'])}, the steepest view on top"

    @property
    def _heights(self) -> dict[str, Any]:
        geometry = self.settings.geometry
        return {name: geometry[name] for name in ("dem", "dem_heights", "geoid") if name in geometry}

    def _dirsig(self) -> str:
        from hyperpaint.io.dirsig import write_dirsig
        from hyperpaint.io.library import open_library

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
        from hyperpaint.report.store_report import write_report

        library = self.library if self.library.exists() and not self._library_failed else None
        done = write_report(
            self.store,
            self.out / "report.html",
            library=library,
            overwrite=True,
            progress=self.progress("report"),
        )
        problems = f"; cannot be read: {'; '.join(done.problems)}" if done.problems else ""
        return f"{done.path}{problems}"


#: Entry of a step that is under way, or of which nothing is known: any product may be its own.
_UNKNOWN: dict[str, Any] = {"inputs": None, "products": None}


_HASH = "blake2b"


def _is_entry(entry: Any) -> bool:
    # checksums by name, as version 0.3 writes them
    products = entry["products"] if isinstance(entry, dict) and set(entry) == set(_UNKNOWN) else None
    return isinstance(products, dict) and all(
        not state or str(state).startswith(f"{_HASH}:") for state in products.values()
    )


def _states(paths: Iterable[Path]) -> dict[str, str]:
    # a file by its content, a folder by all its files, a store by its metadata
    states: dict[str, str] = {}
    for path in paths:
        files = [path] if path.is_file() else []
        if path.is_dir():
            # metadata hold checksums of the chunks
            pattern = "zarr.json" if (path / "zarr.json").is_file() else "*"
            files = sorted(each for each in path.rglob(pattern) if each.is_file())
        sums = []
        for each in files:
            with open(each, "rb") as file:
                sums.append((each.relative_to(path).as_posix(), hashlib.file_digest(file, _HASH).hexdigest()))
        states[path.name] = f"{_HASH}:{hashlib.sha256(json.dumps(sums).encode()).hexdigest()}" if sums else ""
    return states


def _listed(paths: Collection[Path]) -> str:
    return ", ".join(map(str, paths))
