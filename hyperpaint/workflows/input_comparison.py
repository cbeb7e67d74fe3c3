"""Whether the files that a store was made from are still those: every byte of them, or their absence."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import PaintError, StoreError
from hyperpaint.io.store.groups import INPUTS
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.record import SETTINGS, ArrayRecord, read_record, recorded_form

from .store_inputs import inputs_digest

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["InputReport", "compare_inputs"]

_RAW = ("counts", "radiance")
"""What a cube holds; the first of them that a line has is what its file holds."""


@dataclass(frozen=True)
class InputReport:
    """What `compare_inputs` found."""

    collect: Path  #: The ``collect.toml`` that was opened.
    blocks: int  #: Blocks of cubes that were read.
    problems: tuple[str, ...]  #: One line each; empty where no input is another than it was.

    def __str__(self) -> str:
        state = f"{len(self.problems)} differ" if self.problems else "all as they were"
        return "\n  ".join(
            [f"inputs of {self.collect}: {self.blocks} blocks of cubes, {state}", *self.problems]
        )


def compare_inputs(store: Path, collect: Path | None = None) -> InputReport:
    """Read every input of a store whole, and compare it with what the store was made from.

    Cubes are held against the checksums of the stored samples, block by block; of all other files the values
    that are read from them count. ``collect``: where the ``collect.toml`` is now; by default where it was.

    Raises `StoreError`: the store was not made by `process`, or its ``collect.toml`` is not known;
    `CollectError`: that, or what it names, cannot be opened.
    """
    from .laboratory import opened_collect

    location = Location.of(store)
    words = _words(location)
    source = Path(words[2]) if collect is None else collect
    if not source.is_file():
        raise StoreError(
            f"there is no {source}, from which {store} was made",
            mend="say where it is now: compare_inputs(store, collect)",
            option="say where it is now: --collect COLLECT.toml",
        )
    opened = opened_collect(source, need_irradiance="radiance" not in words)
    problems: list[str] = []
    blocks = 0
    for group in location.groups():
        attributes = (location.metadata(group) or {}).get("attributes") or {}
        if INPUTS not in attributes:
            continue  # a user's
        if f"/{group}" not in opened.tree.groups:
            problems.append(f"/{group}: {source.name} does not name it any more")
            continue
        dataset = opened.tree[group].to_dataset()
        cubes = opened.cubes.get(group, ())
        if inputs_digest(dataset, cubes, str(attributes.get(SETTINGS))) != attributes[INPUTS]:
            problems.append(f"/{group}: its inputs are not those that it was made from")
        for name in [name for name in _RAW if name in dataset][:1] if cubes else []:
            record = read_record(location, group)
            if record is not None and name in record.arrays:
                blocks += len(record.arrays[name].chunks)
                problems += _different_blocks(location, group, dataset[name], record.arrays[name])
    return InputReport(source, blocks, tuple(problems))


def _words(location: Location) -> list[str]:
    """Return the command that a store was made by."""
    from hyperpaint.io.store.root_record import read_set

    record = read_set(location)
    try:
        words = shlex.split(record.command) if record is not None else []
    except ValueError:  # unbalanced quotes: hyperpaint did not write it
        words = []
    if words[:2] != ["hyperpaint", "process"] or len(words) < 3:
        raise StoreError(
            f"{location.url} does not say what it was made from: hyperpaint process did not write it"
        )
    return words


def _different_blocks(
    location: Location, group: str, cube: xr.DataArray, record: ArrayRecord
) -> Iterator[str]:
    """Yield the blocks of a cube whose samples are not those that were stored."""
    import numpy as np

    from hyperpaint.io.store.chunks import region
    from hyperpaint.io.store.record import checksum

    name = str(cube.name)
    form = recorded_form(location, group, name, record)
    if cube.shape != form.shape:
        yield f"/{group}: {name} of {cube.shape} samples, stored are {form.shape}"
        return

    def differs(index: tuple[int, ...], expected: int) -> str:
        inside = region(index, form.chunk, form.shape)
        try:
            values = cube[inside].compute(scheduler="synchronous").values
        except (PaintError, OSError) as error:
            return f"/{group}: {name} cannot be read: {error!s:.300}"
        lines = f"lines {inside[0].start} to {inside[0].stop - 1}"
        return "" if checksum(values) == expected else f"/{group}: {name}, {lines}: not what was stored"

    with ThreadPoolExecutor() as pool:
        yield from filter(None, pool.map(differs, np.ndindex(record.grid), record.chunks))
