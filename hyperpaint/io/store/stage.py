"""Where a local store is staged: one folder beside it, with the lock of the one writer.

``.partial-<store>/`` holds

* ``hyperpaint``: the mark of the owner; a folder without it is left alone, and the store is not written;
* ``lock``: who writes, see `locked`;
* ``build-<group>-<content>-<attempt>``: a group under construction, a small Zarr store of its own;
* ``replaced-<group>``: the old group, for the moment between two renames;
* ``discarded-<number>``: what is being removed.

A finished group and the one it replaces change places in one step, where the system can exchange two names
(Linux, most local disks): at no instant is there no group. Elsewhere it takes two renames.

Whatever a killed writer left there is put right by the next one, before it does anything else. It takes up
what was built of the same group with the same content, and removes the rest. Links and names that lead
elsewhere are refused.
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
from urllib.parse import quote, unquote

from hyperpaint.base.errors import StoreError

from .disk import exchange
from .groups import groups_above, make_groups_above
from .location import METADATA, MOST_DEPTH, Location, clean_group, is_temporary, sync
from .record import CHUNKS

_ROOT = "%root"
_PATIENCE_S = 3.0
"""How long a lock without a record is watched; filelock takes it over after 2 s without a change."""
_EMPTY_AGE_S = 30.0
"""Age from which an empty lock is taken for what a power failure left: a writer fills it at once."""
_MOST_LOCK_BYTES = 1024
"""Of the record of a writer; filelock reads no more either."""
_TRIES = 20
_MARK = "hyperpaint"
_MARK_TEXT = b"hyperpaint builds a store here, and removes this folder in the end; nothing else belongs.\n"
_OURS = re.compile(r"lock|build-.+-[0-9A-Za-z_]+-[0-9a-f]{12}|discarded-[0-9a-f]{12}|replaced-.*")
"""Names that versions before the mark left in such a folder."""
_DISCARDED = re.compile(r"discarded-[0-9a-f]{12}")
_BUILD = re.compile(r"build-(.+)-[0-9A-Za-z_]+-[0-9a-f]{12}")


class Staging:
    """The folder beside a store in which its groups are built."""

    def __init__(self, store: Path) -> None:
        self.store = store
        self.folder = store.parent / f".partial-{store.name}"

    def build(self, group: str, content: str) -> Path:
        """Return a new folder name for a group; no other attempt, ended or not, writes there."""
        return self.folder / f"{_build_prefix(group, content)}{uuid.uuid4().hex[:12]}"

    def leftovers(self, group: str, content: str) -> list[Path]:
        """Return what earlier attempts built of a group with the same content."""
        prefix = _build_prefix(group, content)
        return [entry for entry in self._entries() if entry.name.startswith(prefix)]

    def begun(self) -> list[str]:
        """Return the groups of which earlier attempts built something."""
        groups = (_group_of_build(entry.name) for entry in self._entries())
        return list(dict.fromkeys(group for group in groups if group is not None))

    def discard_others(self, group: str, content: str) -> None:
        """Remove what earlier attempts built of a group with other content."""
        prefix = _build_prefix(group, content)
        for entry in self._entries():
            if _group_of_build(entry.name) == group and not entry.name.startswith(prefix):
                discard(entry)

    def close(self, build: Path, group: str, content: str) -> Path:
        """Give what has been built another name, and return that.

        A cluster repeats a task whose worker dies, even one that is no longer waited for. From here on such a
        task finds no folder to write to.
        """
        closed = self.build(group, content)
        os.rename(build, closed)
        return closed

    def publish(self, build: Path, group: str) -> None:
        """Put a finished group in its place, in one step where the system can; else the old one goes first.

        The old group stands again where that fails.
        """
        target = self._place(group)
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            os.rename(build, target)
            old = None
        else:
            old = self._exchanged(build, target) or self._replaced(build, target, group)
        sync(target.parent)
        sync(self.store.parent)
        if old is not None:
            discard(old)

    def _exchanged(self, build: Path, target: Path) -> Path | None:
        """Let a finished group and the old one change places; return where that is, None if it cannot."""
        # a writer killed right after leaves the old group under a name that is cleared up
        place = _to_discard(self.folder)
        os.rename(build, place)
        done = False
        try:
            done = exchange(place, target)
        finally:
            if not done:
                os.rename(place, build)
        return place if done else None

    def _replaced(self, build: Path, target: Path, group: str) -> Path:
        """Rename the old group, then the finished one; return where the old one is."""
        old = self.folder / f"replaced-{_quoted(group)}"
        try:
            os.rename(target, old)
            os.rename(build, target)
        except BaseException:
            if old.exists() and not target.exists():
                os.rename(old, target)
            raise
        return old

    def recover(self, wanted: Collection[str] = ()) -> None:
        """Undo a replacement that was cut short, and remove half-built groups but for those wanted.

        StoreError where there is what no writer leaves: links, or names that lead out of the store.
        """
        entries = self._entries()
        replaced = {entry: self._group_of(entry) for entry in entries if entry.name.startswith("replaced-")}
        for entry in entries:
            if entry in replaced:
                self._put_back(entry, replaced[entry])
            elif _DISCARDED.fullmatch(entry.name) or _group_of_build(entry.name) not in (None, *wanted):
                discard(entry)
        above = {name for group in wanted for name in groups_above(group)}
        for leftover in _temporaries(self.store, above):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(leftover)

    def _put_back(self, old: Path, group: str) -> None:
        target = self._place(group)
        if target.exists():
            discard(old)
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        os.rename(old, target)
        make_groups_above(group, Location.of(self.store))

    def _group_of(self, old: Path) -> str:
        name = old.name.removeprefix("replaced-")
        group = "" if name == _ROOT else unquote(name)
        with contextlib.suppress(StoreError):
            if clean_group(group) == group and _quoted(group) == name:
                return group
        raise StoreError(
            f"{old} names no group of a store, and no writer left it there; look at it, then remove it"
        )

    def _entries(self) -> list[Path]:
        """Return what is in the folder, sorted; the folder and all in it must be no links."""
        try:
            entries = [] if self.folder.is_symlink() else sorted(self.folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []
        for entry in (self.folder, *entries):
            if entry.is_symlink():
                raise StoreError(f"{entry} is a link, which no writer left there; look at it, then remove it")
        return entries

    def _place(self, group: str) -> Path:
        """Return where a group belongs; no link leads there."""
        place = self.store
        for part in group.split("/") if group else ():
            place = place / part
            if place.is_symlink():
                raise StoreError(f"{place} is a link; a store holds plain files and folders")
        return place


def _temporaries(store: Path, above: Collection[str]) -> Iterator[str]:
    """Yield half-written metadata in the folders of a store and of groups ``above``, through no link."""
    tops = dict.fromkeys([store, *(store / name for name in above if not (store / name).is_symlink())])
    for folder, folders, names in (step for top in tops for step in os.walk(top)):
        places = {name: os.path.join(folder, name) for name in (*folders, *names)}
        if len(Path(folder).relative_to(store).parts) > MOST_DEPTH:
            folders.clear()  # deeper groups are of no store
        # of a recorded array nothing is half-written
        folders[:] = [
            name
            for name in folders
            if os.path.lexists(os.path.join(places[name], METADATA))
            and not os.path.lexists(os.path.join(places[name], CHUNKS))
        ]
        for name in filter(is_temporary, names):
            if stat.S_ISREG(os.lstat(places[name]).st_mode):
                yield places[name]


def flight_content(codec: str) -> str:
    """Return what stands in the place of the content of a group whose line is still being recorded."""
    return f"flight_{codec}"


def discard(build: Path) -> None:
    """Remove what has been built, or replaced.

    dask does not wait for the tasks that still run when another fails: once the folder has another name, they
    cannot write any more. And what is half removed has no name that stands for something whole.
    """
    discarded = build
    if not build.name.startswith("discarded-"):
        discarded = _to_discard(build.parent)
        with contextlib.suppress(OSError):
            os.rename(build, discarded)
    for path in (discarded, build):
        shutil.rmtree(path, ignore_errors=True)
        with contextlib.suppress(OSError):  # a file in a group's place
            path.unlink(missing_ok=True)


def _check_owner(folder: Path) -> None:
    """Refuse a folder that hyperpaint did not make: whatever is in it is somebody's.

    One without a mark is ours where all in it has names that earlier versions gave; a power failure leaves
    an empty mark, which is none.
    """
    try:
        names = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return
    cut_off = _MARK if _is_empty(folder / _MARK) else ""
    others = [name for name in names if not _OURS.fullmatch(name) and name != cut_off]
    if others and not _is_marked(folder):
        named = ", ".join(others[:3]) + (" ..." if len(others) > 3 else "")
        raise StoreError(
            f"{folder} is not of hyperpaint, which builds there: it holds {named}",
            mend="move it away, or choose another path for the store; nothing in it was touched",
        )


def _is_empty(path: Path) -> bool:
    try:
        status = os.lstat(path)
    except OSError:
        return False
    return stat.S_ISREG(status.st_mode) and not status.st_size


def _is_marked(folder: Path) -> bool:
    mark = folder / _MARK
    return mark.is_file() and not mark.is_symlink() and mark.read_bytes()[:200] == _MARK_TEXT


def _to_discard(folder: Path) -> Path:
    return folder / f"discarded-{uuid.uuid4().hex[:12]}"


def _quoted(group: str) -> str:
    return quote(group, safe="") or _ROOT


def _group_of_build(name: str) -> str | None:
    """Return the group that a folder was built for, None where its name is of no build."""
    match = _BUILD.fullmatch(name)
    return None if match is None else "" if match[1] == _ROOT else unquote(match[1])


def _build_prefix(group: str, content: str) -> str:
    return f"build-{_quoted(group)}-{content}-"


@contextlib.contextmanager
def locked(lock: Path, store: Path) -> Iterator[None]:
    """Hold the lock of a store; its folder is made, and removed where it is empty in the end.

    `filelock.SoftFileLock` writes the process, its start and its host into the file, and takes over the lock
    of a process that has died; a file without such a record it takes over after 2 s without a change.
    StoreError where another writer holds it, where it cannot be seen from here whether that one has died, or
    where it is no file, or one that no writer left.
    """
    import filelock

    # not shared with another call in this process: two writers in two threads exclude each other as well
    holder = filelock.SoftFileLock(lock, poll_interval=0.05, thread_local=False, is_singleton=False)
    for _ in range(_TRIES):
        _refuse_what_is_no_lock(lock, store)
        _check_owner(lock.parent)
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            holder.acquire(timeout=_PATIENCE_S if holder.pid is None else 0.0)
            break
        except FileNotFoundError:  # the writer before us has just removed the folder
            continue
        except filelock.Timeout:
            raise _being_written(lock, store) from None
    else:
        raise StoreError(
            f"{store} is being written: {lock} comes and goes; wait for the other writer to finish"
        )
    mark = lock.with_name(_MARK)
    try:
        mark.write_bytes(_MARK_TEXT)
        # a power failure would leave both empty: nobody could tell then whose they are, or that we have died
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


def _refuse_what_is_no_lock(lock: Path, store: Path) -> None:
    """Refuse what is no record in the place of a lock; remove the empty file that a power failure left."""
    with contextlib.suppress(FileNotFoundError):
        status = os.lstat(lock)
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MOST_LOCK_BYTES:
            raise StoreError(
                f"{lock} is a link, a folder, a pipe or a file of {status.st_size} bytes",
                expected="the file that a writer leaves there",
                mend=f"delete it once no process writes {store}",
            )
        if not status.st_size and time.time() - status.st_mtime > _EMPTY_AGE_S:
            os.unlink(lock)


def _being_written(lock: Path, store: Path) -> StoreError:
    """Return the error that names the process which holds a lock."""
    try:
        with open(lock, encoding="utf-8", errors="replace") as file:
            process, host, *_ = [*file.read(400).splitlines(), "unknown", "unknown"]
        since = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(os.lstat(lock).st_mtime))
    except OSError:  # it has just finished
        process, host, since = "unknown", "unknown", "just now"
    return StoreError(
        f"{store} is being written by process {process[:80]} on {host[:80]} since {since}",
        mend=f"wait for it to finish, or delete {lock} once you know that it has died",
    )


@contextlib.contextmanager
def staging(store: Path, wanted: Collection[str] = ()) -> Iterator[Staging]:
    """Open the staging folder of a store, as its only writer, else a StoreError.

    What earlier attempts built of the groups ``wanted``, which are about to be written, is kept.
    """
    stage = Staging(store)
    if stage.folder.is_symlink():
        raise StoreError(f"{stage.folder} is a link, which no writer left there; look at it, then remove it")
    with locked(stage.folder / "lock", store):
        stage.recover(wanted)
        yield stage


def clear_up(store: Path) -> None:
    """Remove what a writer that died at its very end left beside a store.

    Nothing is done where another writer is at work, or where there is something to take up.
    """
    folder = Staging(store).folder
    with contextlib.suppress(StoreError, OSError):
        if not any(entry.name.startswith("build-") for entry in folder.iterdir()):
            with staging(store):
                pass
