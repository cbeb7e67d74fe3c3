"""The staging folder beside a local store, with the lock of its single writer.

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
import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, unquote

from hyperpaint.base import StoreError, head_of

from .computing import exchange
from .manifest import MANIFEST_NODE, TEMPORARY, clean_group, sync
from .reader import groups_above

_ROOT = "%root"
# Time to wait for a lock without a process record [s]; filelock takes it over after 2 s.
_PATIENCE_S = 3.0
# Age from which an empty lock was left by a power failure [s]: a writer fills its lock at once.
_EMPTY_AGE_S = 30.0
_MAX_LOCK_BYTES = 1024
_TRIES = 20
_MARK = "hyperpaint"
_MARK_TEXT = b"hyperpaint builds a store here, and removes this folder in the end; nothing else belongs.\n"
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

    def discard_others(self, group: str, content: str) -> None:
        for entry in self._entries():
            if (entry.kind, entry.group) == ("build", group) and entry.content != content:
                discard(entry.path)

    def close(self, build: Path, group: str, content: str) -> Path:
        # Rename a build, and return its new name.
        #
        # A cluster may repeat the task of a worker that died after the run has ended. With the new name such
        # a task does not find the folder.
        closed = self.build(group, content)
        os.rename(build, closed)
        return closed

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
            old, exchanged = _to_discard(self.folder), False
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
    discarded = _to_discard(build.parent)
    with contextlib.suppress(OSError):
        os.rename(build, discarded)
    for path in (discarded, build):
        shutil.rmtree(path, ignore_errors=True)
        with contextlib.suppress(OSError):  # the path may be a file
            path.unlink(missing_ok=True)


def _to_discard(folder: Path) -> Path:
    return folder / f"discarded-{uuid.uuid4().hex[:12]}"


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
    for _ in range(_TRIES):
        _check_folder(lock, store)
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            holder.acquire(timeout=_PATIENCE_S if holder.pid is None else 0.0)
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
        mark.write_bytes(_MARK_TEXT)
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
    if status is not None and (not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_LOCK_BYTES):
        raise StoreError(
            f"{lock} is a link, a folder, a pipe or a file of {status.st_size} bytes",
            expected="a small file of a writer",
            mend=f"delete it once no process writes {store}",
            code="lock-foreign",
        )
    if files and text != _MARK_TEXT and (text != b"" or len(files) > 1):
        file_names = ", ".join(sorted(files)[:3]) + (" ..." if len(files) > 3 else "")
        raise StoreError(
            f"{folder}, the staging folder of the store, contains files of other programs: {file_names}",
            mend="move it away, or choose another path for the store; nothing in it was changed",
            code="staging-foreign",
        )
    if status is not None and not status.st_size and time.time() - status.st_mtime > _EMPTY_AGE_S:
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
