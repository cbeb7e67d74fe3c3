"""Comparison of the input files of a store with the data that were processed."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.errors import PaintError, StoreError
from hyperpaint.base.schema import ALONG_TRACK, CHUNK_LINES
from hyperpaint.io.store import open_group
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.manifest import Manifest, content_of

from .store_inputs import inputs_digest

#: Variables of a raw cube; the first of these in a line is the one in its file.
_RAW = ("counts", "radiance")


@dataclass(frozen=True)
class InputReport:
    """Result of `compare_inputs`."""

    collect: Path  #: The ``collect.toml`` that was opened.
    blocks: int  #: Blocks of cubes that were read.
    problems: tuple[str, ...]  #: Inputs that differ, one line each; empty if all are unchanged.

    def __str__(self) -> str:
        state = f"{len(self.problems)} differ" if self.problems else "all unchanged"
        return "\n  ".join(
            [f"inputs of {self.collect}: {self.blocks} blocks of cubes, {state}", *self.problems]
        )


def compare_inputs(store: Path, collect: Path | None = None) -> InputReport:
    """Read all inputs of a store and compare them with the store's record of its inputs.

    Cubes are compared with the checksums of the stored samples, block by block; other files by their values.
    ``collect``: present path of the ``collect.toml``; by default the path recorded in the store.

    Raises `StoreError` if `process` did not write the store, or the ``collect.toml`` is not found;
    `CollectError` if the collect, or one of its files, cannot be opened.
    """
    from .laboratory import opened_collect

    location = Location.of(store)
    manifest = Manifest.read(location)
    command = _process_command(location, manifest)
    source = Path(command[2]) if collect is None else collect
    if not source.is_file():
        raise StoreError(
            f"{source}, the collect of {store}, does not exist",
            mend="pass its present path: compare_inputs(store, collect)",
            option="pass its present path: --collect COLLECT.toml",
            code="file-not-found",
        )
    opened = opened_collect(source, need_irradiance="radiance" not in command)
    problems: list[str] = []
    blocks = 0
    for group in location.groups():
        words = content_of(location, group, manifest).split(" ", 2)
        if len(words) < 3:
            continue  # not written by a run, which records group, inputs and settings
        if f"/{group}" not in opened.tree.groups:
            problems.append(f"/{group}: {source.name} no longer has this group")
            continue
        dataset = opened.tree[group].to_dataset()
        cubes = opened.cubes.get(group, ())
        if inputs_digest(dataset, cubes, words[2]) != words[1]:
            problems.append(f"/{group}: its inputs have changed")
        for name in [name for name in _RAW if name in dataset][:1] if cubes else []:
            stored = open_group(store, group, chunks=None)
            if name in stored:
                blocks += -(-stored.sizes[ALONG_TRACK] // CHUNK_LINES)
                problems += _different_blocks(group, dataset[name], stored[name])
    return InputReport(source, blocks, tuple(problems))


def _process_command(location: Location, manifest: Manifest | None) -> list[str]:
    try:
        words = shlex.split(manifest.command) if manifest is not None else []
    except ValueError:  # unbalanced quotes, which hyperpaint does not write
        words = []
    if words[:2] != ["hyperpaint", "process"] or len(words) < 3:
        raise StoreError(
            f"{location.url} was not written by hyperpaint process and has no record of inputs",
            code="inputs-unrecorded",
        )
    return words


def _different_blocks(group: str, cube: xr.DataArray, stored: xr.DataArray) -> Iterator[str]:
    name = str(cube.name)
    if cube.shape != stored.shape:
        yield f"/{group}: {name} has the shape {cube.shape}, stored is {stored.shape}"
        return

    def block_problem(start: int) -> str:
        lines = {ALONG_TRACK: slice(start, start + CHUNK_LINES)}
        try:
            values = cube.isel(lines).compute(scheduler="synchronous").values
            is_equal = np.array_equal(values, stored.isel(lines).values, equal_nan=values.dtype.kind == "f")
        except (PaintError, OSError, ValueError) as error:
            return f"/{group}: {name} cannot be read: {error!s:.300}"
        end = min(start + CHUNK_LINES, len(cube)) - 1
        return (
            "" if is_equal else f"/{group}: {name}, lines {start} to {end}: differs from the stored samples"
        )

    with ThreadPoolExecutor() as pool:
        yield from filter(None, pool.map(block_problem, range(0, cube.sizes[ALONG_TRACK], CHUNK_LINES)))
