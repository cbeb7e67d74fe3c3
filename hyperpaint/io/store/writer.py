"""`to_store`: the one writer of Zarr stores."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hyperpaint.base.errors import Problems, StoreError
from hyperpaint.base.schema import FORMAT_VERSION
from hyperpaint.base.units import takes_quantities

from . import chunks, computing, layout
from .budget import check_memory, limited_threads
from .chunks import adopt, is_mendable
from .disk import check_disk, disk_needed, errors_of_the_system, flush_group
from .groups import (
    INPUTS,
    VOLATILE_ATTRS,
    damaged_groups,
    finish_root,
    groups_above,
    is_listed,
    is_named_by_content,
    make_groups_above,
    occupant,
    problems_above,
    reads_from,
    rebuild_groups,
    stamped,
    unlist,
    version_of_program,
    without_known_warnings,
)
from .location import METADATA, Location, clean_group
from .record import (
    CHUNKS,
    COMPLETE,
    ArrayRecord,
    GroupRecord,
    attributes_checksum,
    checksum,
    metadata_checksum,
)
from .stage import Staging, clear_up, discard, staging

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

PathT = TypeVar("PathT", str, Path)


@takes_quantities()
def to_store(
    data: xr.Dataset | xr.DataTree,
    path: PathT,
    group: str | None = None,
    *,
    overwrite: bool = False,
    progress: bool = False,
    source_token: str | None = None,
) -> PathT:
    """Write a dataset, or a tree of them, into a Zarr v3 store.

    Cubes are stored in chunks of 32 whole lines, everything with a checksum (blosc lz4 + bitshuffle, then
    crc32c). `xarray.open_zarr(path, group=...)` opens the result as it went in: counts as uint16, reflectance
    as float32, times to the nanosecond.

    A group is built beside the store, in ``.partial-<store>``, and put in its place when it is whole and its
    completion record is written; it changes places with the one it replaces in one step where the system has
    such a step (Linux, most local disks), else by two renames. Other groups are never touched. A run that is
    killed, or ends on a full disk, leaves the store as it was. The next run with the same content takes up
    its finished blocks, once they have been read and found whole, and computes only the others. Every file
    and folder is flushed to the disk before the record is written, and before the group gets its place: after
    a power cut a group that has a record is whole, as far as the disk keeps what it has confirmed.

    Whether disk and memory will do is looked at before anything is written; no value is read for it.

    Behind a URL (``memory://``, ``s3://`` ...) nothing can be renamed or locked: there the group is written
    in place and always from the start, its record still comes last, and the caller sees to it that there is
    one writer.

    Parameters
    ----------
    data
        A Dataset becomes one group; every node of a DataTree that holds variables becomes one. Lazy arrays
        are computed block by block, with the scheduler in force; a cluster must see the same file system.
    path
        Folder, or a URL of fsspec.
    group
        Group inside the store, such as ``"flightlines/raw_0"``; by default its root.
    overwrite
        Replace groups that exist. Without it, a finished group of the same content is left alone (made again
        where a chunk of it is missing), any other is refused. Damaged metadata of the groups above are
        written anew too; whole groups stay.
    progress
        Show a progress bar.
    source_token
        Names the content: equal tokens, equal content. By default derived from the arrays: dask's names for
        lazy ones, the values for others. What reads files lazily without dask, or a Zarr store other than by
        `open_store`, has no name that follows its content: it is always written anew. Give a token there, or
        where names do not follow the data, such as a digest of the files read and of the parameters.

    Returns
    -------
    str or Path
        ``path``.

    Raises
    ------
    StoreError
        The group exists, is being written, feeds the data, or cannot be written; or names, dtypes or
        attributes cannot be stored; all problems of the call are listed. Or disk or memory would not suffice,
        or ran out; the figure needed is given. The store is as it was.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = xr.Dataset({"counts": (("along_track", "band", "cross_track"), np.ones((64, 3, 2), "uint16"))})
    >>> to_store(cube, "memory://lot.zarr", "flightlines/raw_0")
    'memory://lot.zarr'
    >>> xr.open_zarr("memory://lot.zarr", group="flightlines/raw_0")["counts"].data.chunksize
    (32, 3, 2)
    """
    location = Location.of(path)
    jobs, attrs = _plan(data, clean_group(group), source_token)
    with errors_of_the_system(location, {job.group: job.dataset for job in jobs}):
        _refuse_own_source(jobs, location)
        above = _groups_without_arrays(jobs, attrs)
        pending = _pending(jobs, above, location, overwrite=overwrite)
        damaged = damaged_groups(above, location)
        if not pending and not damaged and is_listed([job.group for job in jobs], attrs, location):
            if location.local is not None:
                clear_up(_folder(location.local))
            return path
        threads = _check_room(pending, location)
        with _opened(location, pending) as stage, limited_threads(threads):
            # what another writer finished while we waited counts
            pending = _pending(jobs, above, location, overwrite=overwrite)
            rebuild_groups(damaged_groups(above, location), location)
            for job in pending:
                _write_group(job, location, stage, progress=progress)
            finish_root(attrs, location)
    return path


def _groups_without_arrays(jobs: list[_Job], attrs: Iterable[str]) -> list[str]:
    """Return the groups that a call makes around those it writes."""
    above = (each for job in jobs for each in groups_above(job.group))
    return list(dict.fromkeys((*above, *(each for group in attrs for each in (*groups_above(group), group)))))


def _folder(local: Path) -> Path:
    """Return the folder itself, where a link leads to it: what is renamed must lie on one disk."""
    return Path(os.path.realpath(local))


@dataclass(frozen=True)
class _Job:
    """One group to write."""

    group: str
    dataset: xr.Dataset
    token: str

    @property
    def content(self) -> str:
        """Names what is built: one group is never made by two versions of the program."""
        from dask.base import tokenize

        return str(tokenize(self.token, version_of_program()))


def _plan(
    data: xr.Dataset | xr.DataTree, group: str, source_token: str | None
) -> tuple[list[_Job], dict[str, dict[str, Any]]]:
    """Return the groups to write, and the attributes of groups without variables."""
    import xarray as xr

    is_tree = not isinstance(data, xr.Dataset)
    if isinstance(data, xr.Dataset):
        nodes = {group: data}
    else:
        # the tree itself, whose path is ".", is stored as ``group``
        paths = {f"{group}/{part.relative_to(data)}": part for part in data.subtree}
        nodes = {
            path.removesuffix("/.").strip("/"): part.to_dataset(inherit=False) for path, part in paths.items()
        }
    jobs, attrs = [], {}
    for name, node in nodes.items():
        dataset = _without_foreign_inputs(node, source_token)
        prepared = layout.prepare(dataset, name)
        if is_tree and not dataset.variables:
            attrs[name] = dict(prepared.attrs)
        else:
            jobs.append(_Job(name, prepared, _token(dataset, source_token)))
    return jobs, attrs


def _without_foreign_inputs(dataset: xr.Dataset, source_token: str | None) -> xr.Dataset:
    """Drop what names the inputs of another group: it came along from what the dataset was made of."""
    if INPUTS not in dataset.attrs or (source_token is not None and dataset.attrs[INPUTS] == source_token):
        return dataset
    unmarked = dataset.copy(deep=False)
    del unmarked.attrs[INPUTS]
    return unmarked


def _token(dataset: xr.Dataset, source_token: str | None) -> str:
    from dask.base import tokenize

    def content_attrs(attrs: Any) -> dict[str, Any]:
        return {key: value for key, value in attrs.items() if key not in VOLATILE_ATTRS}

    variables = []
    for name, variable in sorted(dataset.variables.items(), key=lambda item: str(item[0])):
        form = (str(name), variable.dims, variable.shape, str(variable.dtype), content_attrs(variable.attrs))
        content = _content(variable) if source_token is None else None
        variables.append((*form, content))
    coords = sorted(map(str, dataset.coords))
    return str(tokenize(FORMAT_VERSION, source_token, variables, coords, content_attrs(dataset.attrs)))


def _content(variable: xr.Variable) -> Any:
    """Return what stands for a variable's values."""
    if layout.is_at_hand(variable) and is_named_by_content(variable):
        return variable.data
    if variable.size == 1:
        return variable.values
    # a lazy array does not say what its file holds, and would be read whole to find out; what dask calls it
    # stays the same when a Zarr store is rewritten
    return uuid.uuid4().hex


def _refuse_own_source(jobs: list[_Job], location: Location) -> None:
    problems = Problems(f"cannot write {location.url}", StoreError)
    for job in jobs:
        if names := reads_from(job.dataset, location, job.group):
            problems.add(
                f"group {'/' + job.group!r} would be overwritten while {', '.join(names)} "
                f"{'is' if len(names) == 1 else 'are'} read from it; "
                "write to another group or path, or .load() the dataset first"
            )
    problems.raise_if_any()


def _pending(jobs: list[_Job], above: list[str], location: Location, *, overwrite: bool) -> list[_Job]:
    """Return the jobs that are not done yet; refuse those that would touch what must stay."""
    problems = Problems(f"cannot write {location.url}", StoreError)
    for text in problems_above(above, location, overwrite=overwrite):
        problems.add(text)
    pending = []
    for job in jobs:
        state = occupant(job.group, job.token, location)
        if state == "same":
            continue
        if state == "parent":
            problems.add(
                f"group {'/' + job.group!r} holds other groups, or folders that are none of its "
                "arrays, which would be lost; choose another group, or remove them first"
            )
        elif state == "array":
            problems.add(f"{'/' + job.group!r} or a group above it is an array; choose another group")
        elif state not in ("", "lacks chunks") and not overwrite:
            problems.add(
                f"group {'/' + job.group!r} exists, {state}",
                mend="pass overwrite=True to replace it",
                option="pass --overwrite to replace it",
            )
        pending.append(job)
    problems.raise_if_any()
    return pending


@contextlib.contextmanager
def _opened(location: Location, jobs: list[_Job]) -> Iterator[Staging | None]:
    if location.local is None:
        yield None
        return
    location.local.parent.mkdir(parents=True, exist_ok=True)
    with staging(_folder(location.local), [(job.group, job.content) for job in jobs]) as stage:
        yield stage


def check_room(groups: Mapping[str, xr.Dataset], path: str | Path, tokens: Mapping[str, str]) -> None:
    """Refuse groups (name to what `to_store` will be given) that together do not fit on a store's disk.

    ``tokens`` are their source tokens; the error gives the figures.
    """
    jobs = [_Job(name, dataset, _token(dataset, tokens[name])) for name, dataset in groups.items()]
    _check_disk(jobs, Location.of(path))


def _check_disk(jobs: list[_Job], location: Location) -> None:
    if location.local is None or not jobs:
        return
    stage = Staging(_folder(location.local))
    begun = [folder for job in jobs for folder in stage.leftovers(job.group, job.content)]
    check_disk(location.local, sum(disk_needed(job.dataset) for job in jobs), begun)


def _check_room(jobs: list[_Job], location: Location) -> int | None:
    """Refuse what disk or memory will not hold; return how many threads it may take, None for any."""
    _check_disk(jobs, location)
    if computing.client_in_force() is not None:
        return None  # the memory is that of the workers
    threads = [check_memory(job.dataset, f"group {'/' + job.group!r}") for job in jobs]
    return min((count for count in threads if count is not None), default=None)


def _write_group(job: _Job, location: Location, stage: Staging | None, *, progress: bool) -> None:
    if stage is None:
        # in place: without its seal the group is incomplete from here on
        if location.has(job.group):
            location.fs.rm(location.key(job.group), recursive=True)
        place = Location.of(location.group_url(job.group))
        _seal(job, place, _write_arrays(job, place, [], progress=progress))
        make_groups_above(job.group, location)
        return
    leftovers = stage.leftovers(job.group, job.content)
    folder = stage.build(job.group, job.content)
    try:
        sums = _write_arrays(job, Location.of(folder), leftovers, progress=progress)
        folder = stage.close(folder, job.group, job.content)
        _seal(job, Location.of(folder), sums)
        unlist(job.group, location)
        make_groups_above(job.group, location)
        stage.publish(folder, job.group)
    except BaseException as error:
        if not is_mendable(error):
            for built in (folder, *leftovers):
                discard(built)
        raise


def _seal(job: _Job, place: Location, sums: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Write the records of a group's chunks, flush all of it to the disk, and write the seal last."""
    _remove_hidden(place)
    arrays = _records(job.dataset, place, sums)
    for name, array in arrays.items():
        place.write_json(array.to_document(), name, CHUNKS)
    if place.local is not None:
        flush_group(place.local, _chunk_files(job.dataset, place.local, arrays))
    document = place.metadata("") or {}
    record = GroupRecord(job.token, attributes_checksum(document), arrays)
    document["attributes"] = {**document.get("attributes", {}), COMPLETE: record.seal}
    place.write_json(document, METADATA)


def _write_arrays(
    job: _Job, place: Location, leftovers: list[Path], *, progress: bool
) -> dict[str, np.ndarray[Any, Any]]:
    """Write a group's metadata and the chunks that no leftover has; return the chunks' checksums."""
    import zarr

    dataset = job.dataset
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    streamed = {name: variable for name, variable in variables.items() if chunks.is_streamed(variable)}
    with computing.errors_of_the_cluster(f"cannot store /{job.group}"):
        _write_metadata(dataset.assign_attrs(stamped(dataset.attrs, "to_store")), list(streamed), place.url)
        node = zarr.open_group(place.url, mode="r+", zarr_format=3, use_consolidated=False)
        targets = {name: _target(node, name, variable, place) for name, variable in streamed.items()}
        finished = _taken_up(targets, leftovers)
        lazy = {
            name: chunks.lazy_checksums(variable, targets[name], finished[name])
            for name, variable in streamed.items()
        }
        return computing.compute(lazy, targets, group=job.group, progress=progress)


def _records(
    dataset: xr.Dataset, place: Location, sums: Mapping[str, np.ndarray[Any, Any]]
) -> dict[str, ArrayRecord]:
    """Return the records of all arrays; checksums that are not given are those of the values."""
    import numpy as np
    import zarr

    node = zarr.open_group(place.url, mode="r", zarr_format=3, use_consolidated=False)
    records = {}
    for name in map(str, dataset.variables):
        array = node[name]
        if name in sums:
            grid, checksums = sums[name].shape, sums[name].ravel().tolist()
        else:
            # what xarray wrote is small: it is read again, which also proves that it can be
            grid = tuple(-(-size // step) for size, step in zip(array.shape, array.chunks, strict=True))
            pieces = (chunks.region(index, array.chunks, array.shape) for index in np.ndindex(grid))
            checksums = [checksum(np.asarray(array[piece])) for piece in pieces]
        metadata = metadata_checksum(place.metadata("", name) or {})
        records[name] = ArrayRecord(metadata, grid, tuple(checksums))
    return records


def _chunk_files(dataset: xr.Dataset, folder: Path, arrays: Mapping[str, ArrayRecord]) -> Iterator[Path]:
    """Yield the files of all chunks that blocks were written to."""
    import numpy as np

    for name, array in arrays.items():
        if chunks.is_streamed(dataset.variables[name]):
            for position in np.ndindex(array.grid):
                yield folder.joinpath(name, "c", *map(str, position))


def _target(node: Any, name: str, variable: xr.Variable, place: Location) -> chunks.Target:
    import zarr

    config: Any = {"write_empty_chunks": True}
    array = zarr.open_array(node.store_path / name, mode="r+", zarr_format=3, config=config)
    folder = None if place.local is None else place.local / name
    return chunks.Target(array, folder, array.chunks, layout.fill_value(variable.dtype))


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


def _write_metadata(dataset: xr.Dataset, streamed: list[str], url: str) -> None:
    """Let xarray write the metadata of all variables and the values of those that are not streamed."""
    holders = {name: chunks.placeholder(dataset.variables[name]) for name in streamed}
    template = layout.with_variables(dataset.drop_vars(streamed).compute(), holders, dataset.coords)
    template, encoding = template[list(dataset.variables)], layout.encoding(dataset)
    with without_known_warnings():
        template.to_zarr(url, mode="w", encoding=encoding, zarr_format=3, consolidated=False, compute=False)
