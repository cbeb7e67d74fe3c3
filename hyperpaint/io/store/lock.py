"""The lock of a store's one writer: a file that says who writes, and outlives him where he is killed."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from hyperpaint.base.errors import StoreError

__all__ = ["locked"]

#: Seconds after which a lock without content is taken for the leftover of a killed writer.
_EMPTY_AGE = 30.0
_MOST_BYTES = 4096
_TRIES, _PAUSE = 20, 0.02
#: Tokens of the locks that this process holds, or is about to: any other that names it is a leftover.
_HELD: set[str] = set()


@contextlib.contextmanager
def locked(lock: Path, store: Path) -> Iterator[None]:
    """Hold the lock of a store; its folder is made, and removed where it is empty in the end.

    Parameters
    ----------
    lock
        The file.
    store
        What it stands for, for messages.

    Raises
    ------
    StoreError
        Another writer holds it, or nobody can tell whether he still lives; or it is no lock of ours.
    """
    token = uuid.uuid4().hex
    owner = json.dumps(_owner(token)).encode()
    # before the file is there: another thread that finds it must not take us for dead
    _HELD.add(token)
    try:
        _acquire(lock, owner, store)
        try:
            yield
        finally:
            _let_go(lock, owner)
    finally:
        _HELD.discard(token)


def _owner(token: str) -> dict[str, Any]:
    return {
        **_here(),
        "pid": os.getpid(),
        "started": _process_start(os.getpid()),
        "since": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "token": token,
    }


def _here() -> dict[str, str | None]:
    """Return what tells this machine, its run and this space of process numbers from others."""
    return {
        "host": socket.gethostname(),
        "machine": _line_of("/etc/machine-id"),
        "boot": _line_of("/proc/sys/kernel/random/boot_id"),
        "namespace": _link_of("/proc/self/ns/pid"),
    }


def _line_of(path: str) -> str | None:
    try:
        return Path(path).read_text().strip() or None
    except (OSError, ValueError):
        return None


def _link_of(path: str) -> str | None:
    try:
        return os.readlink(path)
    except OSError:
        return None


def _acquire(lock: Path, owner: bytes, store: Path) -> None:
    for _ in range(_TRIES):
        lock.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            if _take_over(lock, owner, store):
                return
            time.sleep(_PAUSE)
            continue
        except FileNotFoundError:  # the writer before us has just removed the folder
            continue
        with os.fdopen(descriptor, "wb") as file:
            _write(file, owner, lock)
        return
    raise StoreError(f"{store} is being written: {lock} comes and goes; wait for the other writer to finish")


def _write(file: BinaryIO, owner: bytes, lock: Path) -> None:
    try:
        file.write(owner)
        # a power cut shall leave no lock of which nobody knows whose it was
        file.flush()
        os.fsync(file.fileno())
    except OSError:  # a full disk: nobody shall wait for an empty lock
        _remove(lock)
        raise


def _take_over(lock: Path, owner: bytes, store: Path) -> bool:
    """Make a dead writer's lock ours; raise where the writer lives, return False to try again.

    The kernel's lock on the file makes sure that of two processes that find it stale only one wins.
    """
    try:
        import fcntl
    except ImportError:  # pragma: no cover - Windows
        fcntl = None  # type: ignore[assignment]
    try:
        file = _opened(lock, store)
    except FileNotFoundError:
        return False
    with file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            if not os.path.samestat(os.fstat(file.fileno()), os.lstat(lock)):
                return False
        except FileNotFoundError:
            return False
        raw = file.read(_MOST_BYTES + 1)
        if not raw and time.time() - os.fstat(file.fileno()).st_mtime < _EMPTY_AGE:
            return False
        _refuse_living(_holder(raw, lock, store), lock, store, can_take_over=fcntl is not None)
        file.seek(0)
        file.truncate()
        _write(file, owner, lock)
    return True


def _opened(lock: Path, store: Path) -> BinaryIO:
    """Open a lock that is there; a pipe or a link in its place is not touched."""
    if not stat.S_ISREG(os.lstat(lock).st_mode):
        raise _no_lock(lock, store, "a link, a folder or a pipe")
    flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    return os.fdopen(os.open(lock, os.O_RDWR | flags), "r+b")


def _no_lock(lock: Path, store: Path, found: str) -> StoreError:
    msg = (
        f"{lock} is {found}, expected what a writer leaves there; delete it once you know that nobody "
        f"writes {store}"
    )
    return StoreError(msg)


def _let_go(lock: Path, owner: bytes) -> None:
    """Remove our lock, and its folder where nothing else is in there; never another writer's."""
    with contextlib.suppress(OSError):  # a disk may have become read-only
        if stat.S_ISREG(os.lstat(lock).st_mode):
            with open(lock, "rb") as file:
                ours = file.read(_MOST_BYTES) == owner
            if ours:
                _remove(lock)


def _remove(lock: Path) -> None:
    with contextlib.suppress(OSError):
        lock.unlink(missing_ok=True)
        lock.parent.rmdir()


def _holder(raw: bytes, lock: Path, store: Path) -> dict[str, Any]:
    """Return what a lock says of its writer; nothing of one that was torn by a power cut.

    Raises
    ------
    StoreError
        It was written by something else.
    """
    if len(raw) > _MOST_BYTES:
        raise _no_lock(lock, store, f"more than {_MOST_BYTES} bytes long")
    try:
        document = json.loads(raw.decode()) if raw else {}
    except UnicodeDecodeError:
        raise _no_lock(lock, store, "no text") from None
    except RecursionError:
        raise _no_lock(lock, store, "nested deeply") from None
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def _refuse_living(holder: dict[str, Any], lock: Path, store: Path, *, can_take_over: bool) -> None:
    if not holder:
        return
    dead = _is_dead(holder)
    if dead and can_take_over:
        return
    hint = (
        "wait for it to finish"
        if dead is False
        else f"wait for it to finish, or delete {lock} once you know that it has died"
    )
    words = {key: str(holder.get(key))[:80] for key in ("pid", "host", "since")}
    raise StoreError(
        f"{store} is being written by process {words['pid']} on {words['host']} "
        f"since {words['since']}; {hint}"
    )


def _is_dead(holder: dict[str, Any]) -> bool | None:
    """Tell whether a writer has died; None where that cannot be seen from here."""
    here = _here()
    # locks of other systems lack some of this
    known = {key for key, value in here.items() if value is not None and isinstance(holder.get(key), str)}
    same = {key for key in known if holder[key] == here[key]}
    if "host" not in same or "machine" in known - same:
        return None
    if "boot" in known - same:
        # this machine has been started anew; or another one has the same name
        return True if "machine" in same else None
    if "namespace" in known - same:
        return None
    pid, started = holder.get("pid"), holder.get("started")
    if pid == os.getpid() and started == _process_start(os.getpid()) and "token" in holder:
        return holder["token"] not in list(_HELD)
    return not _alive(pid, started)


def _alive(pid: Any, started: Any) -> bool:
    if type(pid) is not int or not 0 < pid < 2**31:
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
        words = Path(f"/proc/{pid}/stat").read_text()
        return int(words.rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None
