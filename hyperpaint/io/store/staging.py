"""Where a local store is staged: one folder beside it, with the lock of the one writer.

``.partial-<store>/`` holds

* ``lock``: host, process and start of the writer;
* ``build-<group>-<content>-<attempt>``: a group under construction, a small Zarr store of its own;
* ``replaced-<group>``: the old group, for the moment between two renames.

Whatever a killed writer left there is put right by the next one, before it does anything else. It takes up
what was built of the same group with the same content, and removes the rest.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from hyperpaint.errors import StoreError

from .location import sync_folder

__all__ = ["Staging", "clear_up", "discard", "staging"]

_ROOT = "%root"
_DISCARDED = "-discarded"
#: Seconds after which a lock without content is taken for the leftover of a killed writer.
_EMPTY_LOCK_AGE = 30.0


class Staging:
    """The folder beside a store in which its groups are built.

    Parameters
    ----------
    store
        Folder of the store.
    """

    def __init__(self, store: Path) -> None:
        self.store = store
        self.folder = store.parent / f".partial-{store.name}"

    def build(self, group: str, content: str) -> Path:
        """Return a new folder name for a group; no other attempt, ended or not, writes there."""
        return self.folder / f"{_build_prefix(group, content)}{uuid.uuid4().hex[:12]}"

    def leftovers(self, group: str, content: str) -> list[Path]:
        """Return what earlier attempts built of a group with the same content."""
        prefix = _build_prefix(group, content)
        try:
            entries = list(self.folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []
        return sorted(
            found
            for found in entries
            if found.name.startswith(prefix) and not found.name.endswith(_DISCARDED)
        )

    def close(self, build: Path, group: str, content: str) -> Path:
        """Give what has been built another name, and return that.

        A cluster repeats a task whose worker dies, even one that is no longer waited for. From here on such a
        task finds no folder to write to.
        """
        closed = self.build(group, content)
        os.rename(build, closed)
        return closed

    def publish(self, build: Path, group: str) -> None:
        """Put a finished group in its place by renaming, the old one out of the way first."""
        target = self.store / group if group else self.store
        replaced = self.folder / f"replaced-{_quoted(group)}"
        if target.exists():
            os.rename(target, replaced)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.rename(build, target)
        sync_folder(target.parent)
        sync_folder(self.store.parent)
        shutil.rmtree(replaced, ignore_errors=True)

    def recover(self, wanted: Collection[tuple[str, str]] = ()) -> None:
        """Undo a replacement that was cut short, and remove half-built groups but for those wanted."""
        prefixes = tuple(_build_prefix(group, content) for group, content in wanted)
        for found in sorted(self.folder.iterdir()):
            kind, _, name = found.name.partition("-")
            if kind == "replaced":
                group = "" if name == _ROOT else unquote(name)
                target = self.store / group if group else self.store
                if not target.exists():
                    os.rename(found, target)
                shutil.rmtree(found, ignore_errors=True)
            if kind == "build" and (not found.name.startswith(prefixes) or found.name.endswith(_DISCARDED)):
                discard(found)
        for pattern in (".zarr.json.*", "*.partial"):  # half-written metadata, zarr's and ours
            for leftover in (*self.store.glob(pattern), *self.store.glob(f"*/{pattern}")):
                if leftover.is_file():
                    leftover.unlink(missing_ok=True)


def discard(build: Path) -> None:
    """Remove what has been built.

    dask does not wait for the tasks that still run when another fails: once the folder has another name, they
    cannot write any more.
    """
    discarded = build.with_name(f"{build.name}{_DISCARDED}")
    with contextlib.suppress(OSError):
        os.rename(build, discarded)
    shutil.rmtree(discarded, ignore_errors=True)
    shutil.rmtree(build, ignore_errors=True)


def _quoted(group: str) -> str:
    return quote(group, safe="") or _ROOT


def _build_prefix(group: str, content: str) -> str:
    return f"build-{_quoted(group)}-{content}-"


@contextlib.contextmanager
def staging(store: Path, wanted: Collection[tuple[str, str]] = ()) -> Iterator[Staging]:
    """Open the staging folder of a store, as its only writer.

    Parameters
    ----------
    store
        Folder of the store.
    wanted
        Groups and contents about to be written: what earlier attempts built of them is kept.

    Raises
    ------
    StoreError
        Another process is writing the store.
    """
    made = Staging(store)
    lock = made.folder / "lock"
    _acquire(lock, store)
    try:
        made.recover(wanted)
        yield made
    finally:
        # a writer that waits for its turn may be in there already; a disk may have become read-only
        _let_go(lock)


def clear_up(store: Path) -> None:
    """Remove what a writer that died at its very end left beside a store.

    Nothing is done where another writer is at work, or where there is something to take up.
    """
    folder = Staging(store).folder
    with contextlib.suppress(StoreError, OSError):
        if not any(found.name.startswith("build-") for found in folder.iterdir()):
            with staging(store):
                pass


def _acquire(lock: Path, store: Path) -> None:
    owner = json.dumps(
        {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "started": _process_start(os.getpid()),
            "since": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }
    )
    for _ in range(20):
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            if not _take_over(lock, owner, store):
                time.sleep(0.02)
                continue
            return
        except FileNotFoundError:  # the writer before us has just removed the folder
            continue
        try:
            with os.fdopen(descriptor, "w") as file:
                file.write(owner)
                # a power cut shall leave no lock of which nobody knows whose it was
                file.flush()
                os.fsync(file.fileno())
        except OSError:  # a full disk: nobody shall wait for an empty lock
            _let_go(lock)
            raise
        return
    msg = f"{store} is being written: {lock} comes and goes; wait for the other writer to finish"
    raise StoreError(msg)


def _take_over(lock: Path, owner: str, store: Path) -> bool:
    """Make a dead writer's lock ours; raise where the writer lives, return False to try again.

    The kernel's lock on the file makes sure that of two processes that find it stale only one wins.
    """
    try:
        import fcntl
    except ImportError:  # pragma: no cover - Windows
        fcntl = None  # type: ignore[assignment]
    try:
        file = open(lock, "r+")  # noqa: SIM115 - closed below
    except FileNotFoundError:
        return False
    with file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            if not os.path.samestat(os.fstat(file.fileno()), os.stat(lock)):
                return False
        except FileNotFoundError:
            return False
        text = file.read()
        if not text and time.time() - os.fstat(file.fileno()).st_mtime < _EMPTY_LOCK_AGE:
            return False
        _refuse_living(text, lock, store, can_take_over=fcntl is not None)
        try:
            file.seek(0)
            file.truncate()
            file.write(owner)
            file.flush()
            os.fsync(file.fileno())
        except OSError:  # a full disk, as above
            _let_go(lock)
            raise
    return True


def _let_go(lock: Path) -> None:
    with contextlib.suppress(OSError):
        lock.unlink(missing_ok=True)
        lock.parent.rmdir()


def _refuse_living(text: str, lock: Path, store: Path, *, can_take_over: bool) -> None:
    try:
        holder: dict[str, Any] = dict(json.loads(text)) if text else {}
    except (ValueError, TypeError):
        holder = {}
    if not holder:
        return
    here = holder.get("host") == socket.gethostname()
    if here and can_take_over and not _alive(holder.get("pid"), holder.get("started")):
        return
    hint = (
        "wait for it to finish"
        if here
        else f"wait for it to finish, or delete {lock} once you know that it has died"
    )
    msg = (
        f"{store} is being written by process {holder.get('pid')} on {holder.get('host')} "
        f"since {holder.get('since')}; {hint}"
    )
    raise StoreError(msg)


def _alive(pid: Any, started: Any) -> bool:
    if not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    # a number is used again after a while: the start time distinguishes the processes
    return started is None or _process_start(pid) in (None, started)


def _process_start(pid: int) -> int | None:
    """Return a process's start in clock ticks since boot, where the system has it."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
        return int(stat.rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None
