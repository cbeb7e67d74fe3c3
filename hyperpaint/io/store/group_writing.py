"""One group of a store: its arrays, the records of their chunks, and its seal, which comes last."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import chunks, computing, layout
from .chunks import adopt
from .disk import flush_group
from .groups import INPUTS, stamped, version_of_program, without_known_warnings
from .location import METADATA, Location
from .record import (
    CHUNKS,
    COMPLETE,
    PLACE,
    SET,
    SETTINGS,
    ArrayRecord,
    GroupRecord,
    attributes_checksum,
    checksum,
    metadata_checksum,
)
from .root_record import Member
from .stage import discard

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

__all__ = ["Job", "seal_group", "targets_of", "write_arrays"]


@dataclass(frozen=True)
class Job:
    """One group to write."""

    group: str
    dataset: xr.Dataset
    token: str
    settings: str = ""  # Of the run that writes it
    codec: layout.Codec = "compact"

    @property
    def content(self) -> str:
        """Names what is built: by one version of the program, with one codec, in one layout."""
        from dask.base import tokenize

        layouts = sorted(set(layout.layouts_of(self.dataset).values()))
        return str(tokenize(self.token, version_of_program(), self.codec, *layouts))

    @property
    def member(self) -> Member:
        """What the group is to the store's record."""
        return Member(str(self.dataset.attrs.get(INPUTS) or self.token), self.settings)


def seal_group(
    job: Job, place: Location, sums: Mapping[str, np.ndarray[Any, Any]], root_record: str = ""
) -> None:
    """Write the records of a group's chunks, flush all of it to the disk, and write the seal last.

    ``root_record``: what the group says of others, where it is the root and there are others.
    """
    _remove_hidden(place)
    arrays = _records(job.dataset, place, sums)
    for name, array in arrays.items():
        place.write_json(array.to_document(), name, CHUNKS, durable=False)  # flushed with all others
    if place.local is not None:
        flush_group(place.local, _chunk_files(job.dataset, place.local, arrays))
    document = place.metadata("") or {}
    record = GroupRecord(job.token, attributes_checksum(document), arrays)
    extra = {SET: root_record} if root_record and not job.group else {}
    document["attributes"] = {**document.get("attributes", {}), COMPLETE: record.seal, **extra}
    place.write_json(document, METADATA)


def write_arrays(
    job: Job, place: Location, leftovers: list[Path], *, progress: bool
) -> dict[str, np.ndarray[Any, Any]]:
    """Write a group's metadata and the chunks that no leftover has; return the chunks' checksums."""
    import zarr

    dataset = job.dataset.copy(deep=False)
    dataset.attrs = _own_attributes(job)
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    streamed = {name: variable for name, variable in variables.items() if chunks.is_streamed(variable)}
    with computing.errors_of_the_cluster(f"cannot store /{job.group}"):
        files = _written_by_xarray(dataset, list(streamed), job.codec)
        sums = _checksums(files, (name for name in variables if name not in streamed))
        place.write_files({key: content.to_bytes() for key, content in files.items()})
        node = zarr.open_group(place.url, mode="r+", zarr_format=3, use_consolidated=False)
        targets = {name: _target(node, name, job, place) for name in streamed}
        finished = _taken_up(targets, leftovers)
        lazy = {
            name: chunks.lazy_checksums(variable, targets[name], finished[name])
            for name, variable in streamed.items()
        }
        return sums | computing.compute(lazy, targets, group=job.group, progress=progress)


def _own_attributes(job: Job) -> dict[str, Any]:
    """Return a group's attributes: its dataset's, but for those of the store it came from, and its own."""
    settings = {SETTINGS: job.settings} if job.settings else {}
    return {**stamped(job.dataset.attrs, "to_store"), PLACE: f"/{job.group}", **settings}


def _records(
    dataset: xr.Dataset, place: Location, sums: Mapping[str, np.ndarray[Any, Any]]
) -> dict[str, ArrayRecord]:
    """Return the records of all arrays."""
    records = {}
    for name in map(str, dataset.variables):
        metadata = metadata_checksum(place.metadata("", name) or {})
        records[name] = ArrayRecord(metadata, sums[name].shape, tuple(sums[name].ravel().tolist()))
    return records


def _chunk_files(dataset: xr.Dataset, folder: Path, arrays: Mapping[str, ArrayRecord]) -> Iterator[Path]:
    """Yield the files of all chunks that blocks were written to."""
    import numpy as np

    for name, array in arrays.items():
        if chunks.is_streamed(dataset.variables[name]):
            for position in np.ndindex(array.grid):
                yield folder.joinpath(name, "c", *map(str, position))


def _target(node: Any, name: str, job: Job, place: Location) -> chunks.Target:
    import zarr

    config: Any = {"write_empty_chunks": True}
    array = zarr.open_array(node.store_path / name, mode="r+", zarr_format=3, config=config)
    folder = None if place.local is None else place.local / name
    fill = layout.fill_value(job.dataset.variables[name].dtype)
    return chunks.Target(array, folder, array.chunks, fill, job.codec)


def targets_of(dataset: xr.Dataset, folder: Path, codec: layout.Codec) -> dict[str, chunks.Target]:
    """Return where blocks of lazy variables go in a folder that takes chunks only, no metadata."""
    import zarr

    files = _written_by_xarray(dataset, list(map(str, dataset.variables)), codec)
    node = zarr.open_group(zarr.storage.MemoryStore(files), mode="r+", zarr_format=3, use_consolidated=False)
    job, place = Job("", dataset, "", codec=codec), Location.of(folder)
    return {name: _target(node, name, job, place) for name in map(str, dataset.variables)}


def _taken_up(
    targets: Mapping[str, chunks.Target], leftovers: list[Path]
) -> dict[str, dict[tuple[int, ...], int]]:
    """Take the finished chunks out of what earlier attempts left; return the checksums of each array's."""
    finished: dict[str, dict[tuple[int, ...], int]] = {name: {} for name in targets}
    for leftover in leftovers:
        for name, target in targets.items():
            adopt(leftover / name, target, finished[name])
        discard(leftover)
    return finished


def _remove_hidden(place: Location) -> None:
    """Remove the chunks' records, and the files of tasks that died while they wrote."""
    for hidden in place.local.rglob(".*") if place.local is not None else ():
        hidden.unlink(missing_ok=True)


def _written_by_xarray(dataset: xr.Dataset, streamed: list[str], codec: layout.Codec) -> dict[str, Any]:
    """Return the files of a group as zarr keeps them in memory: metadata, and values not streamed.

    On a disk each of some hundred small files would wait for zarr's threads.
    """
    from zarr.storage import MemoryStore

    files: dict[str, Any] = {}
    holders = {name: chunks.placeholder(dataset.variables[name]) for name in streamed}
    template = layout.with_variables(dataset.drop_vars(streamed).compute(), holders, dataset.coords)
    template, encoding = template[list(dataset.variables)], layout.encoding(dataset, codec)
    options: Any = {"mode": "w", "zarr_format": 3, "consolidated": False, "compute": False}
    with without_known_warnings():
        template.to_zarr(MemoryStore(files), encoding=encoding, **options)
    return files


def _checksums(files: dict[str, Any], names: Iterable[str]) -> dict[str, np.ndarray[Any, Any]]:
    """Return checksums of values that xarray wrote, read again: that proves that they can be."""
    import numpy as np
    import zarr

    node = zarr.open_group(zarr.storage.MemoryStore(files), mode="r", zarr_format=3, use_consolidated=False)
    sums = {}
    for name in names:
        array: Any = node[name]
        grid = tuple(-(-size // step) for size, step in zip(array.shape, array.chunks, strict=True))
        sums[name] = np.empty(grid, np.uint32)
        for index in np.ndindex(grid):
            piece = chunks.region(index, array.chunks, array.shape)
            sums[name][index] = checksum(np.asarray(array[piece]))
    return sums
