"""Sequences of what is done to a store, drawn by hypothesis: it is whole just where the wanted set is there.

A model knows what the store is to hold and what it holds; after every step `open_store` and the comparison of
the sets must say the same, and `verify` must not say more.
"""

import contextlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from support.refusals import expect_error
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store.manifest import Location, store_state

from .outcome import SCRATCH, Outcome

SEQUENCES = 300

LINES = ("flightlines/raw_0", "flightlines/raw_1", "flightlines/raw_2")
KINDS = ("a", "b")
STOPS = (None, None, 0, 1, 2, "seal")


class StoreSequence(RuleBasedStateMachine):
    # A store of a collect of three lines in two versions, and what a user adds to it
    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(dir=SCRATCH))
        collect = tiny_collect(self.folder / "raw", len(LINES))
        text = collect.read_text()
        self.collects = {kind: collect.with_name(f"{kind}.toml") for kind in KINDS}
        self.collects["a"].write_text(text)
        self.collects["b"].write_text(text.replace("= 7.0", "= 8.0"))
        self.path = self.folder / "lot.zarr"
        # what a group is: where it was written, and its version
        self.recorded: dict[str, tuple[str, str]] = {}  # By the manifest
        self.present: dict[str, tuple[str, str]] = {}  # On the disk
        self.writes: list[tuple[str, dict[str, tuple[str, str]]]] = []  # Not ended: of a version, or a user's
        self.source = ""  # The version that was processed last
        self.moves = 0

    def is_lacking(self, labels: dict[str, tuple[str, str]]) -> bool:
        # Tell whether a write that did not end is halfway
        untouched = all(name in self.recorded and self.at(name) == self.recorded[name] for name in labels)
        return not untouched and any(self.at(name) != label for name, label in labels.items())

    def at(self, name: str) -> tuple[str, str] | None:
        return self.present.get(name)

    def settle(self) -> None:
        # Take up what writes that are over have put in place
        for write in list(self.writes):
            if not self.is_lacking(write[1]):
                self.writes.remove(write)
                self.recorded |= {name: label for name, label in write[1].items() if self.at(name) == label}

    def teardown(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    # --- what is done ---

    @rule(
        kind=st.sampled_from(KINDS),
        overwrite=st.booleans(),
        stop=st.sampled_from(STOPS),
    )
    def process(self, kind: str, overwrite: bool, stop: Any) -> None:
        # Process a version, to the end or until a kill before a group gets its place, or before the seal
        lines = {name: (name, kind) for name in LINES}
        known = {name: {self.recorded.get(name)} | {w[1].get(name) for w in self.writes} for name in LINES}
        pending = [name for name in LINES if self.at(name) != lines[name] or lines[name] not in known[name]]
        if not overwrite and any(name in self.present and self.at(name) != lines[name] for name in pending):
            expect_error(PaintError, None, lambda: self._process(kind, stop, overwrite=overwrite))
            return
        if isinstance(stop, int) and stop >= len(pending):
            stop = None
        done = not pending and not any(set(w[1]) & set(lines) for w in self.writes)
        if done and lines.items() <= self.recorded.items():
            stop = None
            self._process(kind, stop, overwrite=overwrite)
            return
        self.settle()
        self.writes = [w for w in self.writes if w[0] != kind and not set(w[1]) <= set(lines)]
        if overwrite and kind == self.source:
            self.recorded = {name: label for name, label in self.recorded.items() if name in self.present}
        placed = pending[:stop] if isinstance(stop, int) else pending
        self.present |= {name: lines[name] for name in placed}
        if stop is None:
            self.recorded |= lines
        else:
            self.writes.append((kind, lines))
        self.source = kind
        left = stop is None and any(self.is_lacking(w[1]) for w in self.writes)
        self._process(kind, stop, overwrite=overwrite, unsealed=left)

    def _process(self, kind: str, stop: Any, *, overwrite: bool, unsealed: bool = False) -> None:
        from hyperpaint.io.store import writer

        publish, calls = writer.Staging.publish, iter(range(100))

        def killed(self: Any, *arguments: Any) -> None:
            if next(calls) == stop:
                raise KeyboardInterrupt
            publish(self, *arguments)

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(writer.Staging, "publish", killed)
            if stop == "seal":
                patch.setattr(writer.StoreWriter, "finish", interrupt)
            try:
                with pytest.raises(PaintError) if unsealed and stop is None else contextlib.nullcontext():
                    hp.process(self.collects[kind], self.path, to="radiance", overwrite=overwrite)
                ended = True
            except KeyboardInterrupt:
                ended = False
        assert ended == (stop is None)

    @rule(name=st.sampled_from(("signatures", "map", LINES[0])), value=st.integers(1, 2))
    def add(self, name: str, value: int) -> None:
        # Add a group of a user's, or replace what is there
        hp.to_store(xr.Dataset({"a": ("x", np.full(2, value))}), self.path, name, overwrite=True)
        label = (name, f"user {value}")
        self.settle()
        self.writes = [w for w in self.writes if not set(w[1]) <= {name}]
        self.present[name] = self.recorded[name] = label

    @precondition(lambda self: self.present)
    @rule(data=st.data(), again=st.booleans())
    def delete(self, data: Any, again: bool) -> None:
        # Delete a group, and list the rest anew
        name = data.draw(st.sampled_from(sorted(self.present)))
        shutil.rmtree(self.path / name)
        del self.present[name]
        if again:
            self.consolidate()

    @precondition(lambda self: {LINES[0], LINES[1]} <= set(self.present))
    @rule()
    def swap(self) -> None:
        # Let two lines change places
        spare = self.path / "flightlines" / "spare"
        for source, target in ((LINES[0], spare), (LINES[1], LINES[0]), (spare, LINES[1])):
            os.rename(self.path / source, self.path / target)
        first, second = (self.present[name] for name in LINES[:2])
        self.present |= {LINES[0]: second, LINES[1]: first}

    @precondition(lambda self: LINES[2] in self.present and "copied" not in self.present)
    @rule()
    def copy_in(self) -> None:
        # Copy a group to where none was written
        shutil.copytree(self.path / LINES[2], self.path / "copied")
        self.present["copied"] = self.present[LINES[2]]

    @precondition(lambda self: self.path.exists())
    @rule()
    def consolidate(self) -> None:
        # List all metadata with zarr alone
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(self.path)

    @precondition(lambda self: self.path.exists() and len(list(self.folder.iterdir())) == 2)
    @rule()
    def move(self) -> None:
        # Give the store another name
        self.moves += 1
        os.rename(self.path, self.path.with_name(f"lot-{self.moves}.zarr"))
        self.path = self.path.with_name(f"lot-{self.moves}.zarr")

    # --- what must hold ---

    @invariant()
    def the_set_is_the_wanted_set(self) -> None:
        if not self.path.exists():
            assert not self.present
            return
        written = {name for _, labels in self.writes for name in labels}
        whole = not any(self.is_lacking(labels) for _, labels in self.writes) and all(
            self.at(name) == label for name, label in self.recorded.items() if name not in written
        )
        state = store_state(Location.of(self.path))
        assert (not state.problems) == whole, (state.problems, self.recorded, self.present, self.writes)
        assert hp.verify(self.path).ok <= whole
        try:
            hp.open_store(self.path)
            opened = True
        except PaintError:
            opened = False
        assert opened == whole


def run_sequences(examples: int, steps: int = 8, *, derandomize: bool = False) -> None:
    # Draw sequences until one goes wrong, which is shown
    run_state_machine_as_test(  # type: ignore[no-untyped-call]
        StoreSequence,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            derandomize=derandomize,
            suppress_health_check=list(HealthCheck),
            database=None,
            phases=[Phase.generate],  # to make a sequence shorter takes many times as long as to find it
        ),
    )


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of sequences of up to eight steps; each call draws others
    examples = max(1, round(SEQUENCES * scale))
    outcome = Outcome("sequences of a store", examples)
    try:
        run_sequences(examples)
    except AssertionError as error:
        outcome.wrong.append(f"{error!s:.600}")
    yield outcome
