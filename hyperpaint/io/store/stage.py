"""The staging folder beside a local store, with the lock of its one writer.

``.partial-<store>/`` holds

* ``hyperpaint``: the mark of the owner; a folder without it belongs to other programs and is never touched;
* ``lock``: the process that writes, see `locked`;
* ``build-<group>-<content>-<attempt>``: a group under construction, a small Zarr store;
* ``replaced-<group>``: the old group, between the two renames that replace it;
* ``discarded-<number>``: a folder that is being removed.

Linux exchanges the names of a finished group and the old one in one step, on most local disks, so that one of
them is always in place. Elsewhere that takes two renames.

The next writer first repairs the state that a killed writer left. It resumes builds of the same group and
content, and removes all others. It refuses links, and names that lead out of the store.
"""

from __future__ import annotations

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

from hyperpaint.base.errors import StoreError
from hyperpaint.base.input_files import head_of

from .disk import exchange
from .groups import groups_above
from .location import MANIFEST_NODE, clean_group, sync, temporaries

_ROOT = "%root"
# Time to wait for a lock without a process record [s]; filelock takes it over after 2 s.
_PATIENCE_S = 3.0
# An older empty lock was left by a power failure [s]: a writer fills its lock at once.
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
    """The folder beside a store in which its groups are built."""

    def __init__(self, store: Path) -> None:
        self.store = store
        self.folder = store.parent / f".partial-{store.name}"

    def build(self, group: str, content: str) -> Path:
        """Return a new folder name for a group; no other attempt writes there."""
        return self.folder / f"build-{_quoted(group)}-{content}-{uuid.uuid4().hex[:12]}"

    def leftovers(self, group: str, content: str) -> list[Path]:
        """Return the builds of a group with the same content that earlier attempts left."""
        return [entry.path for entry in self._builds() if (entry.group, entry.content) == (group, content)]

    def discard_others(self, group: str, content: str) -> None:
        for entry in self._builds():
            if entry.group == group and entry.content != content:
                discard(entry.path)

    def close(self, build: Path, group: str, content: str) -> Path:
        """Rename a build, and return its new name.

        A cluster repeats the task of a worker that dies, even after the run has ended. Such a task then finds
        no folder to write to.
        """
        closed = self.build(group, content)
        os.rename(build, closed)
        return closed

    def publish(self, build: Path, group: str) -> None:
        """Move a finished group to its place; the old group stays there if that fails."""
        target = self._place(group)
        target.parent.mkdir(parents=True, exist_ok=True)
        old = None
        if not target.exists():
            os.rename(build, target)
        else:
            # in one step, from a name that the next writer removes: after a kill the old group has that name
            old, exchanged = _to_discard(self.folder), False
            inode = os.stat(build).st_ino
            os.rename(build, old)
            try:
                exchanged = exchange(old, target)
            finally:  # an interruption may come after the exchange
                if not exchanged and os.stat(old).st_ino == inode:
                    os.rename(old, build)
            # in two steps where the system cannot exchange names
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

    def recover(self, wanted: Collection[str] = ()) -> None:
        """Repair the state that a killed writer left, and keep builds of the groups ``wanted``.

        Raises `StoreError`: the folder holds links, or names that lead out of the store.
        """
        for entry in self._entries():
            if entry.kind == "replaced":  # killed between two renames
                target = self._place(entry.group)
                if not target.exists():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    os.rename(entry.path, target)
                    continue
            if entry.kind != "build" or entry.group not in wanted:
                discard(entry.path)
        above = {name for group in wanted for name in groups_above(group)}
        for folder in {self.store, self.store / MANIFEST_NODE, *(self.store / name for name in above)}:
            if folder.is_dir() and not folder.is_symlink():
                for leftover in temporaries(folder):
                    leftover.unlink(missing_ok=True)

    def _entries(self) -> list[_Entry]:
        # The entries with names of writers, sorted; links and invalid group names are refused.
        try:
            paths = [] if self.folder.is_symlink() else sorted(self.folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []
        entries = []
        for path in (self.folder, *paths):
            if path.is_symlink():
                raise StoreError(
                    f"{path} is a link, which no writer left there",
                    mend="look at it, then remove it",
                    code="link-refused",
                )
            match = _NAMES.fullmatch(path.name)
            if match is None:
                continue
            name = match["new"] if match["old"] is None else match["old"]
            group = "" if name in (None, _ROOT) else unquote(name)
            good = name is None
            with contextlib.suppress(StoreError):
                good = good or (clean_group(group) == group and _quoted(group) == name)
            if not good:
                raise StoreError(
                    f"{path} names no group, and no writer left it there",
                    mend="look at it, then remove it",
                    code="staging-foreign",
                )
            entries.append(_Entry(path, path.name.partition("-")[0], group, match["content"] or ""))
        return entries

    def _builds(self) -> list[_Entry]:
        return [entry for entry in self._entries() if entry.kind == "build"]

    def _place(self, group: str) -> Path:
        # The place of a group; links along the path are refused.
        place = self.store
        for part in group.split("/") if group else ():
            place = place / part
            if place.is_symlink():
                raise StoreError(
                    f"{place} is a link", expected="plain files and folders in a store", code="link-refused"
                )
        return place


def discard(build: Path) -> None:
    """Remove a build, or a replaced group.

    It is renamed first. Tasks that dask still runs after the error of another one then find no folder
    to write to, and no half-removed folder has the name of a complete one.
    """
    discarded = _to_discard(build.parent)
    with contextlib.suppress(OSError):
        os.rename(build, discarded)
    for path in (discarded, build):
        shutil.rmtree(path, ignore_errors=True)
        with contextlib.suppress(OSError):  # a file in the place of a group
            path.unlink(missing_ok=True)


def _to_discard(folder: Path) -> Path:
    return folder / f"discarded-{uuid.uuid4().hex[:12]}"


def _quoted(group: str) -> str:
    return quote(group, safe="") or _ROOT


@contextlib.contextmanager
def locked(lock: Path, store: Path) -> Iterator[None]:
    """Hold the lock of a store; its folder is created, and removed at the end if empty.

    `filelock.SoftFileLock` writes the process, its start and its host into the file, and takes over the lock
    of a process that has died; a file without such a record it takes over after 2 s without a change.

    Raises `StoreError`: another writer holds the lock, on this host or on one that cannot be asked; or the
    lock or its folder belong to another program.
    """
    import filelock

    # not a singleton, so that two threads of this process exclude each other
    holder = filelock.SoftFileLock(lock, poll_interval=0.05, thread_local=False, is_singleton=False)
    for _ in range(_TRIES):
        _check_folder(lock, store)
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            holder.acquire(timeout=_PATIENCE_S if holder.pid is None else 0.0)
        except FileNotFoundError:  # the writer before us has just removed the folder
            continue
        except filelock.Timeout:
            pass
        break
    if not holder.is_locked:
        process, host, since = "unknown", "unknown", "just now"
        with contextlib.suppress(OSError):  # it has just finished
            with open(lock, encoding="utf-8", errors="replace") as file:
                process, host, *_ = [*file.read(400).splitlines(), process, host]
            since = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(os.lstat(lock).st_mtime))
        raise StoreError(
            f"{store} is being written by process {process[:80]} on {host[:80]} since {since}",
            mend=f"wait for it to finish, or delete {lock} once you know that it has died",
            code="store-locked",
        )
    mark = lock.with_name(_MARK)
    try:
        mark.write_bytes(_MARK_TEXT)
        # a power failure would otherwise leave both empty, without owner and process
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
    # Refuse a lock that no writer left, and a folder of another program.
    # The mark shows that a folder is ours. A power failure may leave an empty mark or an empty lock, nothing
    # else.
    folder = lock.parent
    if folder.is_symlink():
        raise StoreError(
            f"{folder} is a link, which no writer left there",
            mend="look at it, then remove it",
            code="link-refused",
        )
    try:
        there = {path.name: path.lstat() for path in folder.iterdir()}
    except (FileNotFoundError, NotADirectoryError):  # the writer before us removes it
        return
    mark = there.get(_MARK)
    text = head_of(folder / _MARK, 200) if mark is not None and stat.S_ISREG(mark.st_mode) else None
    status = there.pop(lock.name, None)
    if status is not None and (not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_LOCK_BYTES):
        raise StoreError(
            f"{lock} is a link, a folder, a pipe or a file of {status.st_size} bytes",
            expected="the file that a writer leaves there",
            mend=f"delete it once no process writes {store}",
            code="lock-foreign",
        )
    if there and text != _MARK_TEXT and (text != b"" or len(there) > 1):
        named = ", ".join(sorted(there)[:3]) + (" ..." if len(there) > 3 else "")
        raise StoreError(
            f"{folder} is not of hyperpaint, which builds there: it holds {named}",
            mend="move it away, or choose another path for the store; nothing in it was touched",
            code="staging-foreign",
        )
    if status is not None and not status.st_size and time.time() - status.st_mtime > _EMPTY_AGE_S:
        lock.unlink(missing_ok=True)


@contextlib.contextmanager
def staging(store: Path, wanted: Collection[str] = ()) -> Iterator[Staging]:
    """Open the staging folder of a store, as its only writer.

    Builds of the groups ``wanted``, which are about to be written, are kept.

    Raises `StoreError`: see `locked` and `Staging.recover`.
    """
    stage = Staging(store)
    with locked(stage.folder / "lock", store):
        stage.recover(wanted)
        yield stage


def clear_up(store: Path) -> None:
    """Remove the staging folder of a writer that was killed at its very end.

    Nothing is done while another writer is at work, or where a build can be resumed.
    """
    folder = Staging(store).folder
    with contextlib.suppress(StoreError, OSError):
        if not any(entry.name.startswith("build-") for entry in folder.iterdir()):
            with staging(store):
                pass
