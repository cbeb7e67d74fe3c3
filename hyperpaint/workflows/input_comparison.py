"""Compare every input file of a store with the data that the store was made from."""

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

#: Possible variables of a raw cube; the first that a line has is the one in its file.
_RAW = ("counts", "radiance")


@dataclass(frozen=True)
class InputReport:
    """Result of `compare_inputs`."""

    collect: Path  #: The ``collect.toml`` that was opened.
    blocks: int  #: Blocks of cubes that were read.
    problems: tuple[str, ...]  #: One line each; empty where no input is another than it was.

    def __str__(self) -> str:
        state = f"{len(self.problems)} differ" if self.problems else "all as they were"
        return "\n  ".join(
            [f"inputs of {self.collect}: {self.blocks} blocks of cubes, {state}", *self.problems]
        )


def compare_inputs(store: Path, collect: Path | None = None) -> InputReport:
    """Read every input of a store, and compare it with the store's record of its inputs.

    Cubes are compared with the checksums of the stored samples, block by block; other files by their values.
    ``collect``: present path of the ``collect.toml``; by default the recorded one.

    Raises `StoreError`: `process` did not write the store, or its ``collect.toml`` is not found;
    `CollectError`: the collect, or one of its files, cannot be opened.
    """
    from .laboratory import opened_collect

    location = Location.of(store)
    manifest = Manifest.read(location)
    command = _words(location, manifest)
    source = Path(command[2]) if collect is None else collect
    if not source.is_file():
        raise StoreError(
            f"{source}, the collect of {store}, does not exist",
            mend="pass its present path: compare_inputs(store, collect)",
            option="give its present path: --collect COLLECT.toml",
            code="file-not-found",
        )
    opened = opened_collect(source, need_irradiance="radiance" not in command)
    problems: list[str] = []
    blocks = 0
    for group in location.groups():
        words = content_of(location, group, manifest).split(" ", 2)
        if len(words) < 3:
            continue  # a user's; a run names path, inputs and settings
        if f"/{group}" not in opened.tree.groups:
            problems.append(f"/{group}: {source.name} does not name it any more")
            continue
        dataset = opened.tree[group].to_dataset()
        cubes = opened.cubes.get(group, ())
        if inputs_digest(dataset, cubes, words[2]) != words[1]:
            problems.append(f"/{group}: its inputs are not those that it was made from")
        for name in [name for name in _RAW if name in dataset][:1] if cubes else []:
            stored = open_group(store, group, chunks=None)
            if name in stored:
                blocks += -(-stored.sizes[ALONG_TRACK] // CHUNK_LINES)
                problems += _different_blocks(group, dataset[name], stored[name])
    return InputReport(source, blocks, tuple(problems))


def _words(location: Location, manifest: Manifest | None) -> list[str]:
    try:
        words = shlex.split(manifest.command) if manifest is not None else []
    except ValueError:  # unbalanced quotes: hyperpaint did not write it
        words = []
    if words[:2] != ["hyperpaint", "process"] or len(words) < 3:
        raise StoreError(
            f"{location.url} records no inputs: hyperpaint process did not write it",
            code="inputs-unrecorded",
        )
    return words


def _different_blocks(group: str, cube: xr.DataArray, stored: xr.DataArray) -> Iterator[str]:
    name = str(cube.name)
    if cube.shape != stored.shape:
        yield f"/{group}: {name} of {cube.shape} samples, stored are {stored.shape}"
        return

    def difference(first: int) -> str:
        lines = {ALONG_TRACK: slice(first, first + CHUNK_LINES)}
        try:
            values = cube.isel(lines).compute(scheduler="synchronous").values
            same = np.array_equal(values, stored.isel(lines).values, equal_nan=values.dtype.kind == "f")
        except (PaintError, OSError, ValueError) as error:
            return f"/{group}: {name} cannot be read: {error!s:.300}"
        last = min(first + CHUNK_LINES, len(cube)) - 1
        return "" if same else f"/{group}: {name}, lines {first} to {last}: not what was stored"

    with ThreadPoolExecutor() as pool:
        yield from filter(None, pool.map(difference, range(0, cube.sizes[ALONG_TRACK], CHUNK_LINES)))
