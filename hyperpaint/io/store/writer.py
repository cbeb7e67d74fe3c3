"""`to_store` and `whole_run`: the one writer of Zarr stores.

A group is built beside its store, flushed, and moved to its path; the manifest is written last. `whole_run`
writes the groups of a run; the store is unfinished until all of them are at their paths.

The staging folder beside a local store, with the lock of its single writer.

``.partial-<store>/`` contains

* ``hyperpaint``: a file by which writers recognise the folder; a folder without it is never changed;
* ``lock``: the process that writes, see `locked`;
* ``build-<group>-<content>-<attempt>``: a group under construction, a small Zarr store;
* ``replaced-<group>``: the old group, between the two renames that replace it;
* ``discarded-<number>``: a folder that is being removed.

Linux exchanges the names of a finished group and the old group in one step, on most local disks, so that one
of them is always at the group's path. Other systems need two renames.

The next writer first repairs the state that a killed writer left. It resumes builds of the same group and
content, and removes other builds. Links, and names of paths outside the store, are errors.
"""

import contextlib
import itertools
import json
import os
import re
import shutil
import stat
import sys
import threading
import time
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, get_args
from urllib.parse import quote, unquote

import numpy as np
import xarray as xr

from hyperpaint.base import (
    DEFAULT_CODEC,
    FORMAT_VERSION,
    IncompleteStoreError,
    Problem,
    Problems,
    StoreError,
    documented,
    forget,
    has_own_means,
    has_own_overview,
    head_of,
    one_of,
    takes_quantities,
)

from . import computing
from .budget import check_memory, client_in_force, limited_threads, thread_space
from .computing import Layout, check_disk, disk_needed, errors_of_the_system, exchange, flush_group
from .manifest import (
    CONTENT,
    INPUTS,
    MANIFEST_NODE,
    METADATA,
    OWN_ATTRS,
    SEAL,
    SETTINGS,
    TEMPORARY,
    ArrayEntry,
    GroupEntry,
    Location,
    Manifest,
    Write,
    check_state,
    chunk_digest,
    clean_group,
    content_of,
    content_text,
    document_checksum,
    entry_of,
    joined,
    seal_of,
    store_state,
    sync,
)
from .reader import (
    VOLATILE_ATTRS,
    check_above,
    ensure_groups,
    group_document,
    groups_above,
    has_attributes,
    is_named_by_content,
    listed_documents,
    occupant,
    reads_from,
    set_attributes,
    stamped,
    version_of_program,
    with_listed,
)

_ROOT = "%root"
_LOCK = SimpleNamespace(
    # Time to wait for a lock without a process record [s]; filelock takes it over after 2 s.
    patience_s=3.0,
    # Age from which an empty lock was left by a power failure [s]: a writer fills its lock at once.
    empty_age_s=30.0,
    max_lock_bytes=1024,
    tries=20,
)
_MARK = "hyperpaint"
MARK_TEXT = b"hyperpaint builds a store here, and removes this folder in the end; nothing else belongs.\n"
_NAMES = re.compile(
    r"discarded-[0-9a-f]{12}|replaced-(?P<old>.*)|build-(?P<new>.+)-(?P<content>[0-9A-Za-z_]+)-[0-9a-f]{12}"
)


class _Entry(NamedTuple):
    path: Path
    kind: str  # "discarded", "replaced" or "build"
    group: str
    content: str


class Staging:
    # The folder beside a store in which its groups are built.
    def __init__(self, store: Path) -> None:
        self.store = store
        self.folder = store.parent / f".partial-{store.name}"

    def build(self, group: str, content: str) -> Path:
        # Return a new folder for building a group, which no other attempt uses.
        return self.folder / f"build-{_quoted(group)}-{content}-{uuid.uuid4().hex[:12]}"

    def leftovers(self, group: str, content: str) -> list[Path]:
        # Return the builds of a group with a content from earlier attempts.
        return [entry.path for entry in self._entries() if entry[1:] == ("build", group, content)]

    def publish(self, build: Path, group: str) -> None:
        # Move a finished group to its path; if that fails, the old group stays there.
        target = self._path(group)
        target.parent.mkdir(parents=True, exist_ok=True)
        old = None
        if not target.exists():
            os.rename(build, target)
        else:
            # exchange from a name of the form `discarded-`: if this process is killed after the exchange, the
            # old group has this name, and the next writer removes it
            old, exchanged = (self.folder / f"discarded-{uuid.uuid4().hex[:12]}"), False
            inode = os.stat(build).st_ino
            os.rename(build, old)
            try:
                exchanged = exchange(old, target)
            finally:  # an interruption may come after the exchange
                if not exchanged and os.stat(old).st_ino == inode:
                    os.rename(old, build)
            # two renames if the system cannot exchange names
            if not exchanged:
                old = self.folder / f"replaced-{_quoted(group)}"
                try:
                    os.rename(target, old)
                    os.rename(build, target)
                except BaseException:
                    if old.exists() and not target.exists():
                        os.rename(old, target)
                    raise
        for folder in (target.parent, *target.parent.parents):  # some of them may be new
            sync(folder)
            if folder == self.store.parent:
                break
        if old is not None:
            discard(old)

    def recover(self, kept_groups: Collection[str] = ()) -> None:
        # Repair the state that a killed writer left, and keep builds of ``kept_groups``.
        #
        # Raises `StoreError`: The folder contains links, or names of paths outside the store.
        for entry in self._entries():
            if entry.kind == "replaced":  # the writer was killed between two renames
                target = self._path(entry.group)
                if not target.exists():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    os.rename(entry.path, target)
                    continue
            if entry.kind != "build" or entry.group not in kept_groups:
                discard(entry.path)
        parents = {name for group in kept_groups for name in groups_above(group)}
        for folder in {self.store, self.store / MANIFEST_NODE, *(self.store / name for name in parents)}:
            if folder.is_dir() and not folder.is_symlink():
                for leftover in folder.iterdir():
                    if (
                        TEMPORARY.fullmatch(leftover.name)
                        and leftover.is_file()
                        and not leftover.is_symlink()
                    ):
                        leftover.unlink(missing_ok=True)

    def _entries(self) -> list[_Entry]:
        # Sorted entries with names that writers give; links and invalid group names are errors
        try:
            paths = [] if self.folder.is_symlink() else sorted(self.folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []
        entries = []
        for path in (self.folder, *paths):
            StoreError.raise_if(
                path.is_symlink(),
                f"{path} is a link, which no writer creates",
                mend="look at it, then remove it",
                code="link-refused",
            )
            match = _NAMES.fullmatch(path.name)
            if match is None:
                continue
            name = match["new"] if match["old"] is None else match["old"]
            group = "" if name in (None, _ROOT) else unquote(name)
            is_valid = name is None
            with contextlib.suppress(StoreError):
                is_valid = is_valid or (clean_group(group) == group and _quoted(group) == name)
            StoreError.raise_if(
                not is_valid,
                f"{path} contains no valid group name, and no writer creates it",
                mend="look at it, then remove it",
                code="staging-foreign",
            )
            entries.append(_Entry(path, path.name.partition("-")[0], group, match["content"] or ""))
        return entries

    def _path(self, group: str) -> Path:
        # Folder of a group; links along the path are errors
        path = self.store
        for name in group.split("/") if group else ():
            path = path / name
            StoreError.raise_if(
                path.is_symlink(),
                f"{path} is a link",
                expected="plain files and folders in a store",
                code="link-refused",
            )
        return path


def discard(build: Path) -> None:
    # Remove a build, or a replaced group.
    #
    # The folder is renamed first, so that tasks that dask still runs after an error do not find it, and that
    # a folder which is partly removed does not have the name of a build.
    discarded = build.parent / f"discarded-{uuid.uuid4().hex[:12]}"
    with contextlib.suppress(OSError):
        os.rename(build, discarded)
    for path in (discarded, build):
        shutil.rmtree(path, ignore_errors=True)
        with contextlib.suppress(OSError):  # the path may be a file
            path.unlink(missing_ok=True)


def _quoted(group: str) -> str:
    return quote(group, safe="") or _ROOT


@contextlib.contextmanager
def locked(lock: Path, store: Path) -> Iterator[None]:
    # Lock a store; the folder of the lock is created, and removed at the end if empty.
    #
    # `filelock.SoftFileLock` writes the process, its start and its host into the file, and replaces the lock
    # of a process that has died, or a lock without such a record that did not change for 2 s.
    #
    # Raises `StoreError`: Another writer has the lock, on this host or on another, whose processes cannot be
    # checked; or the lock or its folder belong to another program.
    import filelock

    # not a singleton, so that two threads of this process exclude each other
    holder = filelock.SoftFileLock(lock, poll_interval=0.05, thread_local=False, is_singleton=False)
    for _ in range(_LOCK.tries):
        _check_folder(lock, store)
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            holder.acquire(timeout=_LOCK.patience_s if holder.pid is None else 0.0)
        except FileNotFoundError:  # the previous writer has just removed the folder
            continue
        except filelock.Timeout:
            pass
        break
    if not holder.is_locked:
        process, host, start = "unknown", "unknown", "just now"
        with contextlib.suppress(OSError):  # the other writer may have just finished
            with open(lock, encoding="utf-8", errors="replace") as file:
                process, host, *_ = [*file.read(400).splitlines(), process, host]
            start = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(os.lstat(lock).st_mtime))
        raise StoreError(
            f"{store} is being written by process {process[:80]} on {host[:80]} since {start}",
            mend=f"wait until it has finished, or delete {lock} if this process no longer exists",
            code="store-locked",
        )
    mark = lock.with_name(_MARK)
    try:
        mark.write_bytes(MARK_TEXT)
        # flushed, since a power failure could otherwise leave both files empty
        for path in (lock, mark, lock.parent):
            sync(path)
        yield
    finally:
        with contextlib.suppress(OSError):  # a disk may have become read-only
            if set(os.listdir(lock.parent)) <= {lock.name, _MARK}:
                mark.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            holder.release()
            lock.parent.rmdir()


def _check_folder(lock: Path, store: Path) -> None:
    # Raise for a lock that is not of a writer, and for a folder of another program.
    # A folder of hyperpaint contains the mark. After a power failure the mark or the lock may be empty, and
    # are then the only files.
    folder = lock.parent
    StoreError.raise_if(
        folder.is_symlink(),
        f"{folder} is a link, which no writer creates",
        mend="look at it, then remove it",
        code="link-refused",
    )
    try:
        files = {path.name: path.lstat() for path in folder.iterdir()}
    except (FileNotFoundError, NotADirectoryError):  # the previous writer removes it
        return
    mark = files.get(_MARK)
    text = head_of(folder / _MARK, 200) if mark is not None and stat.S_ISREG(mark.st_mode) else None
    status = files.pop(lock.name, None)
    if status is not None and (not stat.S_ISREG(status.st_mode) or status.st_size > _LOCK.max_lock_bytes):
        raise StoreError(
            f"{lock} is a link, a folder, a pipe or a file of {status.st_size} bytes",
            expected="a small file of a writer",
            mend=f"delete it once no process writes {store}",
            code="lock-foreign",
        )
    if files and text != MARK_TEXT and (text != b"" or len(files) > 1):
        file_names = ", ".join(sorted(files)[:3]) + (" ..." if len(files) > 3 else "")
        raise StoreError(
            f"{folder}, the staging folder of the store, contains files of other programs: {file_names}",
            mend="move it away, or choose another path for the store; nothing in it was changed",
            code="staging-foreign",
        )
    if status is not None and not status.st_size and time.time() - status.st_mtime > _LOCK.empty_age_s:
        lock.unlink(missing_ok=True)


@contextlib.contextmanager
def staging(store: Path, kept_groups: Collection[str] = ()) -> Iterator[Staging]:
    # Open the staging folder of a store, as its only writer.
    #
    # ``kept_groups``: groups that will be written, whose builds are kept.
    #
    # Raises `StoreError`: see `locked` and `Staging.recover`.
    stage = Staging(store)
    with locked(stage.folder / "lock", store):
        stage.recover(kept_groups)
        yield stage


def clear_up(store: Path) -> None:
    # Remove the staging folder that a writer left which was killed after its last group.
    #
    # The folder stays if another writer is active, or if a build can be resumed.
    folder = Staging(store).folder
    with contextlib.suppress(StoreError, OSError):
        if not any(entry.name.startswith("build-") for entry in folder.iterdir()):
            with staging(store):
                pass


@takes_quantities()
@documented(progress="progress bar")
def to_store(
    data: xr.Dataset | xr.DataTree,
    path: Any,
    group: str | None = None,
    *,
    overwrite: bool = False,
    progress: bool = False,
    source_token: str | None = None,
    codec: computing.Codec = DEFAULT_CODEC,
    layout: Layout = "cube",
) -> Any:
    """Write a dataset, or a tree of them, into a Zarr v3 store.

    Cubes are stored in chunks of 32 complete lines, every chunk with a checksum (blosc lz4 + shuffle, then
    crc32c). `xarray.open_zarr(path, group=...)` opens the result unchanged: counts as uint16, reflectance
    as float32, times to the nanosecond.

    A group is built beside the store, in ``.partial-<store>``, and moved to its path when complete. If it
    replaces a group, both are exchanged in one step if the system can (Linux, most local disks), else by two
    renames. Other groups are never changed. The store's manifest, which lists every group with checksums of
    its metadata and chunks, is written last. A run that is killed, or stops at a full disk, leaves the store
    unchanged. The next run with the same content keeps finished blocks with valid checksums, and computes
    only the missing blocks. All files and folders of a group are flushed to the disk before it is moved, so
    that a group at its path survives a power failure, if the disk keeps the data it has confirmed.

    Free disk and memory are checked before anything is written, without reading a value.

    At a URL (``memory://``, ``s3://`` ...) nothing can be renamed or locked: a group is written from the
    start, with its metadata and the manifest last, and the caller must ensure a single writer. An old group
    stays until the new one is complete beside the store; then the server copies it. To a store object of
    zarr, such as that of an icechunk session, xarray writes the group in the same encoding but without a
    manifest, since such stores have transactions.

    Parameters
    ----------
    data
        A Dataset becomes one group; so does every node of a DataTree with variables. Lazy arrays are computed
        block by block with the current scheduler; a cluster must have access to the same file system.
    path
        Folder, a URL of fsspec, or a writable store object of zarr.
    group
        Group inside the store, such as ``"flightlines/raw_0"``; by default its root.
    overwrite
        Replace existing groups, and damaged metadata of their parents. By default a finished group of the
        same content is kept (rewritten if a chunk is missing), and a group of other content is an error.
    progress
    source_token
        Text that identifies the content, such as a digest of files and parameters: equal tokens mean equal
        content. By default it is computed from dask's names of lazy arrays and the values of other arrays.
        Arrays that are lazy without dask, or from a Zarr store not opened by `open_store`, have no name that
        depends on their content, and are always rewritten without a token.
    codec
    layout
        ``"cube"``: a chunk of a cube contains all bands, and a task computes one chunk. ``"explore"``: an
        eighth of the bands, so that a picture of one band reads an eighth of the cube; there are eight times
        as many files, and eight times as many tasks of `xarray.open_zarr` (one per slab of `open_store`).
        ``"web"``: all bands of 16 x 16 pixels, so that a spectrum reads some 100 kB, see
        `hyperpaint.report.write_site`. A complete group is not rewritten for another layout.

    Returns
    -------
    str or Path
        ``path``.

    Raises
    ------
    StoreError
        The group exists, is being written, is a source of the data, or cannot be written; or names, dtypes or
        attributes cannot be stored; all problems are listed. Or disk or memory is too small; the message has
        the size needed. The store is unchanged.
    IncompleteStoreError
        The manifest of the store is damaged, or another process removed the group while it was written.
    SchemaError
        ``codec`` or ``layout`` is not one of the choices.
    MissingExtraError
        The package for this kind of URL is not installed.

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
    jobs, attrs = _plan(data, clean_group(group), source_token, (codec, layout))
    if not isinstance(path, str | os.PathLike):
        import zarr

        groups: list[str] = []
        with contextlib.suppress(Exception):  # a new store; every kind of store has its own classes
            groups = list(zarr.open_group(path, mode="r", use_consolidated=False).group_keys())
        with Problems(f"cannot write {path}", StoreError) as problems:
            for job in jobs:
                problems.add_if(
                    names := reads_from(job.dataset, path, job.group),
                    f"group {'/' + job.group!r} would be overwritten while {', '.join(names)} are read",
                    code="source-overwritten",
                )
                problems.add_if(
                    not job.group and groups and overwrite,
                    f"its root contains groups, which would be lost: {', '.join(groups[:5])}",
                    code="group-occupied",
                )
        try:
            for group, attributes in attrs.items():
                zarr.open_group(path, path=group, mode="a").attrs.update(stamped(attributes, "to_store"))
            for job in jobs:
                encoding = computing.encoding(job.dataset, job.codec)
                dataset = job.dataset.assign_attrs(stamped(job.dataset.attrs, "to_store"))
                options: Any = {"consolidated": False, "mode": "w" if overwrite else "w-"}
                dataset.to_zarr(path, group=job.group or None, encoding=encoding, zarr_format=3, **options)
        except FileExistsError as error:  # zarr's ContainsGroupError is one
            raise StoreError(
                f"{path}: {error}", mend="pass overwrite=True to replace it", code="store-exists"
            ) from error
        except Exception as error:  # zarr and every kind of store have their own classes
            raise StoreError(
                f"{path} cannot be written: {type(error).__name__}: {error!s:.200}",
                expected="a folder, a URL, or a writable store object of zarr, as icechunk's session.store",
                code="store-unwritable",
            ) from error
        return path
    location = Location.of(path)
    contents = {job.group: job.content for job in jobs}
    with errors_of_the_system(location, {job.group: job.dataset for job in jobs}):
        # raise for a group that would be replaced while the data are read from it
        with Problems(f"cannot write {location.url}", StoreError) as problems:
            for job, target in itertools.product(jobs, jobs):
                problems.add_if(
                    names := reads_from(job.dataset, location, target.group),
                    f"group {'/' + target.group!r} would be overwritten while {', '.join(names)} "
                    f"{'is' if len(names) == 1 else 'are'} read from it",
                    mend="write to another group or path, or .load() the dataset first",
                    code="source-overwritten",
                )
        pending = pending_groups(contents, location, overwrite=overwrite, around=attrs)
        if not pending and _is_done(location, contents, attrs):
            if location.local is not None:
                clear_up(real_folder(location.local))
            return path
        _check_room([job for job in jobs if job.group in pending], location)
        with _writer(location, contents, pending, attrs, overwrite=overwrite) as writer:
            for job in jobs:
                writer.begin(job, progress=progress)()
            writer.finish()
    return path


@dataclass(frozen=True)
class Job:
    group: str
    dataset: xr.Dataset  # From `computing.prepare`
    token: str  # Identifies the content: equal tokens, equal content
    settings: str = ""  # Settings of the run that writes it
    codec: computing.Codec = DEFAULT_CODEC

    @property
    def content(self) -> str:
        # Content in the manifest: group's path, digest of its inputs or values, and the run's settings.
        return content_text(self.group, str(self.dataset.attrs.get(INPUTS) or self.token), self.settings)

    @property
    def build(self) -> str:
        # Name of the build, which depends on the version of the program, codec and layout too.
        from dask.base import tokenize

        layouts = sorted(set(computing.layouts_of(self.dataset).values()))
        return str(tokenize(self.token, version_of_program(), self.codec, *layouts))


# --- the writer of a store ---------------------------------------------------------------------------------


class StoreWriter:
    # Publishes groups one by one, then writes the manifest; created by `_writer`.
    def __init__(
        self,
        location: Location,
        stage: Staging | None,
        manifest: Manifest,
        write: Write,
        attrs: Mapping[str, Any],
        pending: Collection[str],
    ) -> None:
        self._location, self._stage, self._manifest, self._write = location, stage, manifest, write
        self._attrs, self._pending = attrs, pending
        self._documents: dict[str, Any] = {}  # Metadata of written nodes, by path
        self._entries: dict[str, GroupEntry] = {}
        self._ensured: set[str] = set()
        self._announced = False
        self._lock = threading.RLock()

    def begin(self, job: Job, *, progress: bool = False, as_one_task: bool = False) -> Callable[[], None]:
        # Write a group's arrays; return the function that publishes the group.
        #
        # ``as_one_task``: see `_arrays`.
        #
        # Another thread may call that while the next group begins, for one group at a time. Nothing is done
        # where the group exists.
        if job.group not in self._pending:
            return lambda: None
        with limited_threads(_check_room([job], self._location)):
            if self._stage is None:  # behind a URL: in place, the group's own metadata last
                return self._begin_at_url(job, progress=progress, as_one_task=as_one_task)
            stage = self._stage
            for entry in stage._entries():
                if (entry.kind, entry.group) == ("build", job.group) and entry.content != job.build:
                    discard(entry.path)
            leftovers = stage.leftovers(job.group, job.build)
            folder = stage.build(job.group, job.build)
            with _discarded_unless_mendable(folder, *leftovers):
                place = Location.of(folder)
                files, sums = _arrays(job, place, leftovers, progress=progress, as_one_task=as_one_task)

        def put_in_place() -> None:
            with _discarded_unless_mendable(folder):
                # A cluster may repeat the task of a worker that died after the run has ended: under the new
                # name such a task does not find the folder.
                closed = stage.build(job.group, job.build)
                os.rename(folder, closed)
            with _discarded_unless_mendable(closed):
                for hidden in closed.rglob(".*"):  # left by tasks that died while writing
                    hidden.unlink(missing_ok=True)
                root = self._note(job, files, sums)
                place = Location.of(closed)
                if not job.group:  # published with its manifest in one step
                    root = with_listed(root, {name: doc for name, doc in self._documents.items() if name})
                    writes = (self._write,) if len(self._write.contents) > 1 else ()
                    replace(self._manifest, groups={"": self._entries[""]}, writes=writes).write(place)
                place.write_files({METADATA: json.dumps(root).encode()})
                flush_group(
                    closed,
                    [closed.joinpath(name, *key.split("/")) for name, keys in sums.items() for key in keys],
                )
                if job.group:
                    self.announce(job.group)
                stage.publish(closed, job.group)

        return put_in_place

    def _begin_at_url(self, job: Job, *, progress: bool, as_one_task: bool) -> Callable[[], None]:
        # Write a group in its place, or beside the store where there is an old one, which stays until then.
        location, fs = self._location, self._location.fs
        self.announce(job.group)
        place = Location.of(joined(location.url, job.group))
        arrays = [name for name in location.folders(job.group) if location.has(job.group, name, METADATA)]
        old = {key for name in arrays for key in fs.find(place.key(name))}
        if old and not location.has(job.group, METADATA):  # of a run that was killed
            fs.rm(sorted(old))
            old = set()
        parent, _, name = location.url.rpartition("/")
        if "/" not in location.root.strip("/"):  # the root of a bucket
            parent = location.url
        beside = Location.of(f"{parent}/{joined(f'.partial-{name}', job.group)}")
        if beside.has(""):
            fs.rm(beside.root, recursive=True)
        build = beside if old else place
        files, sums = _arrays(job, build, [], progress=progress, as_one_task=as_one_task)

        def put_in_place() -> None:
            if old:  # no reader finds metadata of one group and chunks of another
                keys = fs.find(build.root)
                with self._lock:
                    root, listed = location.metadata(""), listed_documents(location)
                    others = {
                        name: document
                        for name, document in listed.items()
                        if name and not f"{name}/".startswith(f"{job.group}/")
                    }
                    if root is not None and job.group:
                        location.write_json(with_listed(root, others), METADATA)
                fs.rm(place.key(METADATA))
                moved = [place.key(key.removeprefix(build.root).lstrip("/")) for key in keys]
                fs.copy(keys, moved)
                fs.rm(sorted(old.difference(moved)) + keys)
            with self._lock:
                place.write_files({METADATA: json.dumps(self._note(job, files, sums)).encode()})

        return put_in_place

    def _note(
        self, job: Job, files: dict[str, bytes], sums: Mapping[str, Mapping[str, bytes]]
    ) -> dict[str, Any]:
        documents = {
            key.removesuffix(METADATA).rstrip("/"): json.loads(raw)
            for key, raw in files.items()
            if key.rpartition("/")[2] == METADATA
        }
        root = documents.pop("")
        arrays = {
            name: ArrayEntry(
                document_checksum(document),
                len(sums[name]),
                chunk_digest(job.group, name, sums[name].items()),
            )
            for name, document in documents.items()
        }
        root["attributes"][SEAL] = seal_of(arrays)
        self._entries[job.group] = GroupEntry(
            job.content, document_checksum(root), arrays, root["attributes"] if arrays else {}
        )
        self._documents |= {joined(job.group, name): document for name, document in documents.items()}
        self._documents[job.group] = root
        return dict(root)

    def announce(self, group: str) -> None:
        # Create the parents of a group; before the first group is published, record all groups of the write
        with self._lock:
            if not self._announced:
                replace(self._manifest, writes=(*self._manifest.writes, self._write)).write(self._location)
                self._announced = True
            missing = [name for name in groups_above(group) if name not in self._ensured]
            ensure_groups(missing, self._location)
            self._ensured.update(missing)

    def finish(self) -> None:
        # Write the consolidated metadata of the root, and the manifest
        if self._location.local is None:
            forget(self._location.url)
        location, manifest = self._location, self._manifest
        listed = listed_documents(location)
        published = [name for name in self._write.contents if location.has(name, METADATA)]
        present = [name for name in manifest.groups if location.has(name, METADATA)]
        parents = dict.fromkeys(
            parent
            for name in (*self._write.contents, *self._attrs, *present)
            for parent in groups_above(name)
        )
        ensure_groups(parents, location)
        for group, attributes in self._attrs.items():
            set_attributes(group, attributes, location)
        # entries of written groups, of groups that existed before, and of parents
        entries = dict(self._entries)
        for name in published:
            old = manifest.groups.get(name)
            if name not in entries:
                content = self._write.contents[name]
                entries[name] = (
                    old if old is not None and old.content == content else entry_of(location, name)
                )
        for name in dict.fromkeys((*parents, *self._attrs)):
            if name not in entries:
                document = self._documents[name] = location.metadata(name) or {}
                previous = manifest.groups.get(name, GroupEntry("", 0, {}))
                # attributes added to a root with arrays do not change its entry
                entries[name] = (
                    previous if previous.arrays else previous._replace(metadata=document_checksum(document))
                )
        groups = {**manifest.groups, **entries}
        # consolidated metadata of all groups; those of other groups are copied if they are up to date
        documents = dict(self._documents)
        recorded = {name: entry.metadata for name, entry in groups.items()} | {
            joined(name, array): array_entry.metadata
            for name, entry in groups.items()
            for array, array_entry in entry.arrays.items()
        }
        for name, document in listed.items():
            plain = {key: value for key, value in document.items() if key != "consolidated_metadata"}
            is_current = name not in recorded or recorded[name] == document_checksum(plain)
            if name not in documents and is_current and location.has(name, METADATA):
                documents[name] = plain
        for name in recorded:
            if name not in documents:
                with contextlib.suppress(IncompleteStoreError):  # `verify` reports damaged metadata
                    documents |= {name: node} if (node := location.metadata(name)) is not None else {}
        root = documents.pop("", None) or group_document(stamped({}, "created"))
        location.write_json(with_listed(root, documents), METADATA)
        is_incomplete = len(published) < len(self._write.contents)
        writes = (*manifest.writes, self._write) if is_incomplete else manifest.writes
        replace(manifest, groups=groups, writes=writes).write(location)
        if is_incomplete or (self._write.command and writes):
            check_state(location)
        if is_incomplete:
            missing = sorted(set(self._write.contents) - set(published))
            raise IncompleteStoreError(
                f"{location.url}: another process removed /{missing[0]} while it was written",
                mend="run the writer again",
                code="group-removed",
            )


@contextlib.contextmanager
def _writer(
    location: Location,
    contents: Mapping[str, str],
    pending: list[str],
    attrs: Mapping[str, Any],
    *,
    command: str = "",
    overwrite: bool = False,
) -> Iterator[StoreWriter]:
    # Open a store as its only writer.
    #
    # ``contents``: contents of all groups of this write; ``pending``: groups that must be written, whose
    # finished blocks are kept; ``attrs``: attributes of groups without arrays; ``command``: command of a run,
    # which removes earlier unfinished writes of the same command from the manifest, and with ``overwrite``
    # the entries of deleted groups.
    with contextlib.ExitStack() as stack:
        stage = None
        if location.local is not None:
            location.local.parent.mkdir(parents=True, exist_ok=True)
            stage = stack.enter_context(staging(real_folder(location.local), pending))
        # another writer may have finished groups while this one waited for the lock
        pending = pending_groups(contents, location, overwrite=overwrite, around=attrs)
        manifest = Manifest.read(location, ignore_damage=overwrite)
        # without a manifest, groups are kept whose content has their path, which copied groups do not have
        if manifest is None:
            groups = {}
            for name in location.groups() if location.has("") else ():
                if content_of(location, name).startswith(f"/{name} "):
                    with contextlib.suppress(IncompleteStoreError):  # the group is written again
                        groups[name] = entry_of(location, name)
            manifest = Manifest(groups)
        manifest = manifest.settled(location)
        write = Write(contents, command)
        writes = tuple(
            write_record
            for write_record in manifest.writes
            if not (command and write_record.source == write.source)
            and not write_record.contents.keys() <= contents.keys()
        )
        groups = dict(manifest.groups)
        if command and overwrite and (Write({}, manifest.command).source == write.source):
            groups = {name: entry for name, entry in groups.items() if location.has(name, METADATA)}
        manifest = Manifest(groups, writes, command or manifest.command)
        stack.enter_context(computing.watched(client_in_force()))
        yield StoreWriter(location, stage, manifest, write, attrs, pending)


def _is_done(location: Location, contents: Mapping[str, str], attrs: Mapping[str, Any]) -> bool:
    # Whether the manifest and the consolidated metadata have all groups, so that nothing must be written
    manifest = Manifest.read(location, ignore_damage=True)
    if manifest is None or any(set(write.contents) & set(contents) for write in manifest.writes):
        return False
    groups, listed = manifest.groups, listed_documents(location)
    return (
        all(name in groups and groups[name].content == content for name, content in contents.items())
        and all(has_attributes(group, expected, location) for group, expected in attrs.items())
        and all(joined(name, array) in listed for name in contents for array in groups[name].arrays)
    )


@contextlib.contextmanager
def _discarded_unless_mendable(*folders: Path) -> Iterator[None]:
    # Remove builds after an error that would recur in the same run.
    try:
        yield
    except BaseException as error:
        if not computing.is_mendable(error):
            for built in folders:
                discard(built)
        raise


# --- a run of several groups -------------------------------------------------------------------------------


class WholeRun:
    # Writer of the groups of a run, which are all declared at its start; created by `whole_run`.
    #
    # One thread publishes a group while the next is written. Groups have no file in common, so that a killed
    # run leaves two unfinished groups or fewer.
    def __init__(self, writer: StoreWriter | None, location: Location, codec: computing.Codec) -> None:
        self._writer, self._location, self._codec = writer, location, codec
        self._pool = ThreadPoolExecutor(1, "hyperpaint-place")
        self._placing: Future[None] | None = None
        self._placed: dict[str, xr.Dataset] = {}
        self._lock = threading.RLock()  # on a cluster several groups are written at once

    def write(
        self, group: str, dataset: xr.Dataset, *, progress: bool = False, as_one_task: bool = False
    ) -> None:
        # Write a group; it is published while the next is written, see `settle`.
        #
        # ``as_one_task``: see `_arrays`.
        #
        # Progress bars go to stderr, so that stdout holds results only.
        assert self._writer is not None  # without pending groups this method is not called
        with self._lock:
            # raise an earlier error before computing this group
            if self._placing is None or self._placing.done():
                self.settle()
        job = Job(
            group,
            computing.prepare(dataset, group),
            token_of(dataset, str(dataset.attrs.get(INPUTS))),
            str(dataset.attrs.get(SETTINGS, "")),
            self._codec,
        )
        output = contextlib.redirect_stdout(sys.stderr) if progress else contextlib.nullcontext()
        with output, errors_of_the_system(self._location, {group: dataset}):
            place = self._writer.begin(job, progress=progress, as_one_task=as_one_task)
        with self._lock:
            self.settle()
            self._placed = {group: dataset}
            if thread_space():  # a further thread would take the memory of a computing thread
                with errors_of_the_system(self._location, self._placed):
                    place()
            else:
                self._placing = self._pool.submit(place)

    def settle(self) -> None:
        # Wait until every group is published; raise the error of a failed group.
        with self._lock, errors_of_the_system(self._location, self._placed):
            if self._placing is not None:
                self._placing.result()
                self._placing = None

    def close(self) -> None:
        # Wait for the group that is being published, then stop the thread; also after Ctrl-C.
        ending, interruption = sys.exc_info()[1], None
        while self._placing is not None and not self._placing.done():
            try:
                wait([self._placing])
            except BaseException as error:  # Ctrl-C: keep the lock until the group is published
                interruption = error
        self._pool.shutdown()
        failure = None if self._placing is None else self._placing.exception()
        if failure is not None and ending is not None and failure is not ending:
            ending.add_note(f"before that, a group could not be published: {failure}")
        if interruption is not None:
            raise interruption


@contextlib.contextmanager
def whole_run(
    path: Path,
    contents: Mapping[str, str],
    pending: Mapping[str, xr.Dataset],
    attrs: Mapping[Any, Any],
    *,
    command: str,
    overwrite: bool,
    codec: computing.Codec = DEFAULT_CODEC,
) -> Iterator[WholeRun]:
    # Lock a store for a run, and write its manifest if the run succeeds; a complete store stays unchanged.
    #
    # ``contents``: contents of all groups of the run, see `run_contents`; ``pending``: groups that it will
    # write; ``attrs``: of the root; ``command``: finishes an interrupted run, with ``{store}`` for the path;
    # ``codec``: of `to_store`.
    #
    # Raises `StoreError`: Another writer is active, or the store cannot be written. `IncompleteStoreError`:
    # Groups of this run, or of another unfinished run, are missing at the end.
    location = Location.of(path)
    root = {"": dict(attrs)}
    with contextlib.ExitStack() as stack:
        writer = None
        with errors_of_the_system(location, pending):
            if not pending and _is_done(location, contents, root):
                clear_up(real_folder(path))
            else:
                writer = stack.enter_context(
                    _writer(location, contents, list(pending), root, command=command, overwrite=overwrite)
                )
                if len(pending) > 1 and not location.has(METADATA):  # so that `verify` shows how to resume
                    writer.announce(next(iter(contents)))
        run = WholeRun(writer, location, codec)
        with contextlib.closing(run):
            yield run
            run.settle()
        if writer is not None:
            with errors_of_the_system(location, pending):
                writer.finish()


def run_contents(groups: Mapping[str, xr.Dataset]) -> dict[str, str]:
    # Return the contents of the groups of a run, from their `INPUTS` and, if they have any, `SETTINGS`.
    return {
        name: content_text(name, str(group.attrs[INPUTS]), str(group.attrs.get(SETTINGS, "")))
        for name, group in groups.items()
    }


# --- the arrays of a group ---------------------------------------------------------------------------------


_Arrays = tuple[dict[str, bytes], dict[str, dict[str, bytes]]]


def _arrays(
    job: Job, place: Location, leftovers: list[Path], *, progress: bool, as_one_task: bool
) -> _Arrays:
    # Write the arrays of a group as `_write_arrays` does; ``as_one_task``: on a worker of the cluster, where
    # the group is one task and many short groups are written at once.
    if place.local is not None:
        place.local.mkdir(parents=True, exist_ok=True)
    if as_one_task and not leftovers:
        import dask

        write: Callable[..., _Arrays] = partial(_write_arrays, leftovers=[], progress=False, get=dask.get)
        return computing.on_one_worker(write, job, place, group=job.group)
    return _write_arrays(job, place, leftovers, progress=progress)


def _write_arrays(
    job: Job,
    place: Location,
    leftovers: list[Path],
    *,
    progress: bool,
    get: Callable[..., Any] | None = None,
) -> _Arrays:
    # Write the arrays of a group, and take finished chunks from builds of earlier runs (``leftovers``).
    #
    # ``get``: scheduler of dask, by default the one in force.
    #
    # Return the files from xarray, of which the metadata of the group are not yet written; and by array the
    # crc32c of every chunk, by key.
    from zarr.storage import MemoryStore

    # a task that is repeated after its run finds no folder, and must not create it again
    StoreError.raise_if(
        place.local is not None and not place.local.is_dir(),
        f"cannot store /{job.group}: {place.url} does not exist on the worker{computing.SAME_FILES}",
        mend=computing.RUN_AGAIN,
        code="block-failed",
    )
    dataset = job.dataset.copy(deep=False)
    dataset.attrs = {**stamped(job.dataset.attrs, "to_store"), CONTENT: job.content}
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    streamed = {name: variable for name, variable in variables.items() if computing.is_streamed(variable)}
    with computing.errors_of_the_cluster(f"cannot store /{job.group}"):
        # zarr writes metadata, and values of small arrays, in memory: on a disk its threads would write some
        # hundred small files slowly
        stored: dict[str, Any] = {}
        template = computing.with_variables(
            dataset.drop_vars(list(streamed)).compute(scheduler=get),
            {name: computing.placeholder(variable) for name, variable in streamed.items()},
            dataset.coords,
        )[list(dataset.variables)]
        options: Any = {"mode": "w", "zarr_format": 3, "consolidated": False, "compute": False}
        template.to_zarr(MemoryStore(stored), encoding=computing.encoding(dataset, job.codec), **options)
        files = {key: content.to_bytes() for key, content in stored.items()}
        place.write_files({key: raw for key, raw in files.items() if key != METADATA})
        targets = {name: computing.Target.of(name, v, place, job.codec) for name, v in streamed.items()}
        # chunks that an earlier run finished
        finished: dict[str, dict[tuple[int, ...], int]] = {name: {} for name in targets}
        for leftover in leftovers:
            for name, target in targets.items():
                computing.adopt(leftover / name, target, finished[name])
            discard(leftover)
        lazy = {
            name: computing.lazy_checksums(variable, targets[name], finished[name])
            for name, variable in streamed.items()
        }
        computed = computing.compute(lazy, targets, group=job.group, progress=progress, get=get)
    sums = {}
    for name in variables:
        if name in computed:
            sums[name] = {
                targets[name].key(index): int(value).to_bytes(4, "little")
                for index, value in np.ndenumerate(computed[name])
            }
        else:
            prefix = f"{name}/"
            keys = [key for key in files if key.startswith(prefix) and not key.endswith(METADATA)]
            keys.sort(key=lambda key: [int(part) for part in key.split("/") if part.isdigit()])  # C order
            sums[name] = {key.removeprefix(prefix): files[key][-4:] for key in keys}
    return files, sums


# --- groups to be written ----------------------------------------------------------------------------------


def real_folder(local: Path) -> Path:
    # Return a folder after links are resolved, since renames must stay on one disk.
    return Path(os.path.realpath(local))


def _plan(
    data: xr.Dataset | xr.DataTree, group: str, source_token: str | None, form: tuple[computing.Codec, Layout]
) -> tuple[list[Job], dict[str, dict[str, Any]]]:
    is_tree = not isinstance(data, xr.Dataset)
    if isinstance(data, xr.Dataset):
        nodes = {group: data}
    else:
        # the root of the tree, whose path is ".", is stored as ``group``
        paths = {f"{group}/{subtree_node.relative_to(data)}": subtree_node for subtree_node in data.subtree}
        nodes = {
            path.removesuffix("/.").strip("/"): subtree_node.to_dataset(inherit=False)
            for path, subtree_node in paths.items()
        }
    jobs, attrs = [], {}
    for name, node in nodes.items():
        if "coarse_reflectance" in node.variables and not has_own_means(node):
            node = node.drop_vars("coarse_reflectance")  # computed from earlier reflectance
        if "overview" in node.variables and not has_own_overview(node):
            node = node.drop_vars("overview")
        # drop the digest of inputs that a derived dataset got from another group
        if INPUTS in node.attrs and (source_token is None or node.attrs[INPUTS] != source_token):
            node = node.copy(deep=False)
            del node.attrs[INPUTS]
        dataset = computing.with_layout(node, form[1])
        prepared = computing.prepare(dataset, clean_group(name))
        if is_tree and not dataset.variables:
            attrs[name] = {key: value for key, value in prepared.attrs.items() if key not in OWN_ATTRS}
        else:
            jobs.append(Job(name, prepared, token_of(dataset, source_token), codec=form[0]))
    return jobs, attrs


def check_codec(codec: str) -> None:
    one_of(codec, get_args(computing.Codec), "codec")


def token_of(dataset: xr.Dataset, source_token: str | None) -> str:
    from dask.base import tokenize

    def content_attrs(attrs: Any) -> dict[str, Any]:
        return {key: value for key, value in attrs.items() if key not in VOLATILE_ATTRS}

    variables = []
    for name, variable in sorted(dataset.variables.items(), key=lambda item: str(item[0])):
        # a value that changes with the variable's content
        content: Any = None
        if source_token is None and computing.is_at_hand(variable) and is_named_by_content(variable):
            # dask's names of text arrays are ambiguous
            is_text = variable.dtype.kind in "OT" and variable._in_memory
            content = json.dumps(variable.values.tolist(), default=str) if is_text else variable.data
        elif source_token is None:
            # a random text: the content of a lazy array from a file is unknown without reading it, and its
            # dask name does not change when a Zarr store is rewritten
            content = variable.values if variable.size == 1 else uuid.uuid4().hex
        form = (str(name), variable.dims, variable.shape, str(variable.dtype), content_attrs(variable.attrs))
        variables.append((*form, content))
    return str(
        tokenize(
            FORMAT_VERSION,
            source_token,
            variables,
            sorted(map(str, dataset.coords)),
            content_attrs(dataset.attrs),
        )
    )


def pending_groups(
    contents: Mapping[str, str], location: Location, *, overwrite: bool, around: Iterable[str] = ()
) -> list[str]:
    # Return the groups of ``contents`` that must be written; raise if other groups or files would be lost.
    #
    # ``around``: groups without arrays that are written, too.
    with Problems(f"cannot write {location.url}", StoreError) as problems:
        parents = dict.fromkeys(parent for name in (*contents, *around) for parent in groups_above(name))
        check_above(parents, location, problems, overwrite=overwrite)
        try:
            manifest = Manifest.read(location, ignore_damage=overwrite)
        except IncompleteStoreError as error:
            problems.add_error(location.url, error)
            manifest = None
        pending: list[str] = []
        exists = location.has("")
        lost = store_state(location).faults if manifest is None and exists and not len(problems) else ()
        if lost and not overwrite:
            problems.add(
                lost[0].found,
                mend="pass overwrite=True to write it again",
                option="pass --overwrite to write it again",
                code=lost[0].code,
            )
        for group, content in contents.items():
            state = occupant(group, content, location, manifest) if exists else ""
            other = Problem(
                f"group {'/' + group!r} exists, {state}",
                mend="pass overwrite=True to replace it",
                option="pass --overwrite to replace it",
                code="store-exists",
            )
            faults: dict[str, Problem | None] = {
                "parent": Problem(
                    f"group {'/' + group!r} contains other groups, files or folders, which would be lost",
                    mend="choose another group, or move them away first",
                    code="group-occupied",
                ),
                "array": Problem(
                    f"{'/' + group!r} or a parent of it is an array",
                    mend="choose another group",
                    code="group-occupied",
                ),
                **dict.fromkeys(("same", "", "lacks chunks")),
            }
            fault = faults.get(state, None if overwrite else other)
            problems.extend([fault] if fault is not None else [])
            pending += [group] if state != "same" else []
    return pending


def check_room(
    groups: Mapping[str, xr.Dataset],
    path: str | Path,
    tokens: Mapping[str, str],
    codec: computing.Codec = DEFAULT_CODEC,
) -> None:
    # Raise if groups, datasets by name, together need more than the free space of a store's disk.
    #
    # ``tokens``: their source tokens.
    _check_disk(
        [
            Job(name, dataset, token_of(dataset, tokens[name]), codec=codec)
            for name, dataset in groups.items()
        ],
        Location.of(path),
    )


def _check_disk(jobs: list[Job], location: Location) -> None:
    if location.local is not None and jobs:
        stage = Staging(real_folder(location.local))
        check_disk(
            location.local,
            sum(disk_needed(job.dataset, job.codec) for job in jobs),
            [folder for job in jobs for folder in stage.leftovers(job.group, job.build)],
        )


def _check_room(jobs: list[Job], location: Location) -> int | None:
    # Raise for groups that exceed disk or memory; return the possible number of threads, None for any
    _check_disk(jobs, location)
    if client_in_force() is not None:
        return None  # the workers have their own memory
    threads = [check_memory(job.dataset, f"group {'/' + job.group!r}") for job in jobs]
    return min((count for count in threads if count is not None), default=None)
