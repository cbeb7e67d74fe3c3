"""`to_store`: the one writer of Zarr stores."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from hyperpaint.base.errors import IncompleteStoreError, Problems, SchemaError, StoreError
from hyperpaint.base.schema import FORMAT_VERSION, has_own_means
from hyperpaint.base.units import takes_quantities

from . import computing, layout
from .budget import check_memory, limited_threads
from .chunks import is_mendable
from .disk import check_disk, disk_needed, errors_of_the_system
from .group_writing import Job, seal_group, write_arrays
from .groups import (
    INPUTS,
    VOLATILE_ATTRS,
    announce,
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
)
from .layout import Layout
from .location import METADATA, Location, clean_group
from .record import OWN_ATTRS
from .root_record import Intention, Member, intention, read_set
from .stage import Staging, clear_up, discard, flight_content, staging

if TYPE_CHECKING:
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
    codec: layout.Codec = "compact",
    layout: Layout = "cube",
) -> PathT:
    """Write a dataset, or a tree of them, into a Zarr v3 store.

    Cubes are stored in chunks of 32 whole lines, everything with a checksum (blosc lz4 + shuffle, then
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
    codec
        ``"compact"`` shuffles bits before lz4; ``"fast"`` shuffles bytes, which takes half the processor time
        for a seventh (counts) to two fifths (rounded reflectance) more room. Values are the same, and so is
        the content: what is there whole is not written again for another codec.
    layout
        ``"cube"``: a chunk of a cube holds all bands, one task computes on one chunk. ``"explore"``: an
        eighth of the bands, so that a picture of one band reads an eighth of the cube; it has eight times the
        files, and plain `xarray.open_zarr` eight times the tasks (`open_store` one a slab). ``"web"``: all
        bands of 16 x 16 pixels, so that a spectrum reads some 100 kB, see `hyperpaint.report.write_site`.
        What is there whole is not written again for another layout.

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
    check_codec(codec)
    location = Location.of(path)
    jobs, attrs = _plan(data, clean_group(group), source_token, (codec, layout))
    with errors_of_the_system(location, {job.group: job.dataset for job in jobs}):
        _refuse_own_source(jobs, location)
        above = _groups_without_arrays(jobs, attrs)
        pending = refused_jobs(jobs, above, location, overwrite=overwrite)
        damaged = damaged_groups(above, location)
        wanted = {job.group: job.member for job in jobs}
        done = not pending and not damaged and is_sealed(wanted, location)
        if done and is_listed(wanted, attrs, location):
            if location.local is not None:
                clear_up(real_folder(location.local))
            return path
        _check_room(pending, location)
        with Turn.at(location, wanted, [job.group for job in pending], above, overwrite=overwrite) as turn:
            # what another writer finished while we waited counts
            for job in refused_jobs(jobs, above, location, overwrite=overwrite):
                turn.write(job, progress=progress)
            turn.finish(attrs)
    return path


def is_sealed(wanted: Mapping[str, Member], location: Location, *, overwrite: bool = False) -> bool:
    """Tell whether a store's record names these groups, and nothing is under way.

    ``overwrite``: nor may it name groups that are gone, which are then forgotten.
    """
    try:
        record = read_set(location)
    except IncompleteStoreError:
        return False
    if record is None:
        return not any(wanted)
    if overwrite and not all(location.has(group, METADATA) for group in record.groups):
        return False
    return record.finished and all(record.groups.get(group) == each for group, each in wanted.items())


class Turn:
    """One writer's turn at a store: groups get their places one by one, then the root record is sealed.

    Made by `Turn.at`. Other writers are refused meanwhile.
    """

    def __init__(
        self, location: Location, stage: Staging | None, intended: Intention, pending: Collection[str]
    ) -> None:
        self._location, self._stage, self._intended, self._pending = location, stage, intended, pending
        self._announced = False

    @classmethod
    @contextlib.contextmanager
    def at(
        cls,
        location: Location,
        wanted: Mapping[str, Member],
        pending: Collection[str],
        above: Collection[str],
        *,
        command: str | None = None,
        overwrite: bool = False,
    ) -> Iterator[Turn]:
        """Hold a store to write the groups ``pending``, after which it is to hold those ``wanted``.

        ``above``: groups without arrays around them; ``command``: see `intention`.
        """
        with _held(location, pending) as stage:
            rebuild_groups(damaged_groups(above, location), location)
            intended = intention(location, wanted, pending, command=command, overwrite=overwrite)
            turn = cls(location, stage, intended, pending)
            if not location.has("", METADATA) and len(pending) > 1 and "" not in pending:
                turn.announce()
            yield turn

    @property
    def stage(self) -> Staging | None:
        """Where groups are built; None behind a URL."""
        return self._stage

    @property
    def _record(self) -> str:
        """The root record's text; empty where the root is the only group."""
        return self._intended.record.text if any(self._intended.record.groups) else ""

    def announce(self) -> None:
        """Write into the root what the store is to hold, unless that has been done."""
        if self._record and not self._announced:
            announce(self._record, self._pending, self._location)
        self._announced = True

    def write(self, job: Job, *, progress: bool = False) -> None:
        """Write a group, and put it in its place."""
        self.begin(job, progress=progress)()

    def begin(self, job: Job, *, progress: bool = False) -> Callable[[], None]:
        """Write a group's arrays; return what seals it and puts it in its place.

        Another thread may do that while the next group begins, for one group at a time.
        """
        with limited_threads(_check_room([job], self._location)):
            if self._stage is None:
                self._write_in_place(job, progress=progress)
                return lambda: None
            return self._write_beside(job, self._stage, progress=progress)

    def _write_in_place(self, job: Job, *, progress: bool) -> None:
        location = self._location
        if job.group:
            self.announce()
        # without its seal the group is incomplete from here on
        if location.has(job.group):
            location.fs.rm(location.key(job.group), recursive=True)
        place = Location.of(location.group_url(job.group))
        seal_group(job, place, write_arrays(job, place, [], progress=progress), self._record)
        make_groups_above(job.group, location)

    def _write_beside(self, job: Job, stage: Staging, *, progress: bool) -> Callable[[], None]:
        stage.discard_others(job.group, job.content)
        leftovers = stage.leftovers(job.group, job.content)
        folder = stage.build(job.group, job.content)
        with _discarded_unless_mendable(folder, *leftovers):
            sums = write_arrays(job, Location.of(folder), leftovers, progress=progress)

        def place() -> None:
            with _discarded_unless_mendable(folder):
                closed = stage.close(folder, job.group, job.content)
            with _discarded_unless_mendable(closed):
                seal_group(job, Location.of(closed), sums, self._record)
                if job.group:
                    self.announce()
                make_groups_above(job.group, self._location)
                stage.publish(closed, job.group)

        return place

    def finish(self, attrs: Mapping[str, dict[str, Any]]) -> bool:
        """Set the attributes of groups without arrays (by group), seal the root record unless groups lack.

        Return whether it is sealed.
        """
        record = self._intended.sealed(self._location)
        finish_root(attrs, record.text if any(record.groups) else "", self._location)
        return record.finished


@contextlib.contextmanager
def _discarded_unless_mendable(*folders: Path) -> Iterator[None]:
    """Remove what was built where the same run would end with the same error."""
    try:
        yield
    except BaseException as error:
        if not is_mendable(error):
            for built in folders:
                discard(built)
        raise


def _groups_without_arrays(jobs: list[Job], attrs: Iterable[str]) -> list[str]:
    """Return the groups that a call makes around those it writes."""
    above = (each for job in jobs for each in groups_above(job.group))
    return list(dict.fromkeys((*above, *(each for group in attrs for each in (*groups_above(group), group)))))


def real_folder(local: Path) -> Path:
    """Return the folder itself, where a link leads to it: what is renamed must lie on one disk."""
    return Path(os.path.realpath(local))


def _plan(
    data: xr.Dataset | xr.DataTree, group: str, source_token: str | None, form: tuple[layout.Codec, Layout]
) -> tuple[list[Job], dict[str, dict[str, Any]]]:
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
        if "coarse_reflectance" in node.variables and not has_own_means(node):
            node = node.drop_vars("coarse_reflectance")  # of reflectance as it was before
        dataset = layout.with_layout(_without_foreign_inputs(node, source_token), form[1])
        prepared = layout.prepare(dataset, name)
        if is_tree and not dataset.variables:
            attrs[name] = {key: value for key, value in prepared.attrs.items() if key not in OWN_ATTRS}
        else:
            jobs.append(Job(name, prepared, _token(dataset, source_token), codec=form[0]))
    return jobs, attrs


def job_of(group: str, dataset: xr.Dataset, member: Member, codec: layout.Codec) -> Job:
    """Return what is to be written of a group of a run, which says itself what it is made from."""
    token = _token(dataset, member.identity)
    return Job(group, layout.prepare(dataset, group), token, member.settings, codec)


def check_codec(codec: str) -> None:
    """Refuse a word that is no codec (`SchemaError`)."""
    if codec not in get_args(layout.Codec):
        raise SchemaError(f"codec={codec!r}, expected 'compact' or 'fast'")


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


def _refuse_own_source(jobs: list[Job], location: Location) -> None:
    problems = Problems(f"cannot write {location.url}", StoreError)
    for job in jobs:
        if names := reads_from(job.dataset, location, job.group):
            problems.add(
                f"group {'/' + job.group!r} would be overwritten while {', '.join(names)} "
                f"{'is' if len(names) == 1 else 'are'} read from it; "
                "write to another group or path, or .load() the dataset first"
            )
    problems.raise_if_any()


def refused_jobs(jobs: list[Job], above: list[str], location: Location, *, overwrite: bool) -> list[Job]:
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
                f"group {'/' + job.group!r} holds other groups, or files and folders that are none of its "
                "arrays, which would be lost; choose another group, or move them away first"
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
def _held(location: Location, groups: Collection[str]) -> Iterator[Staging | None]:
    """Be the only writer of a store; where that is a folder, what was built of ``groups`` before is kept."""
    if location.local is None:
        yield None
        return
    location.local.parent.mkdir(parents=True, exist_ok=True)
    with staging(real_folder(location.local), groups) as stage:
        yield stage


def check_room(
    groups: Mapping[str, xr.Dataset],
    path: str | Path,
    tokens: Mapping[str, str],
    codec: layout.Codec = "compact",
) -> None:
    """Refuse groups (name to what `to_store` will be given) that together do not fit on a store's disk.

    ``tokens`` are their source tokens; the error gives the figures.
    """
    jobs = [
        Job(name, dataset, _token(dataset, tokens[name]), codec=codec) for name, dataset in groups.items()
    ]
    _check_disk(jobs, Location.of(path))


def _check_disk(jobs: list[Job], location: Location) -> None:
    if location.local is None or not jobs:
        return
    stage = Staging(real_folder(location.local))
    begun = [
        folder
        for job in jobs
        for content in (job.content, flight_content(job.codec))
        for folder in stage.leftovers(job.group, content)
    ]
    check_disk(location.local, sum(disk_needed(job.dataset, job.codec) for job in jobs), begun)


def _check_room(jobs: list[Job], location: Location) -> int | None:
    """Refuse what disk or memory will not hold; return how many threads it may take, None for any."""
    _check_disk(jobs, location)
    if computing.client_in_force() is not None:
        return None  # the memory is that of the workers
    threads = [check_memory(job.dataset, f"group {'/' + job.group!r}") for job in jobs]
    return min((count for count in threads if count is not None), default=None)
