"""How long runs are done: where they compute, what of a store they keep, and how they show their progress."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import CollectError, MissingExtraError, Problems, StoreError
from hyperpaint.io.store.listing import INPUTS

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

    from hyperpaint.io.store.location import Location

__all__ = ["Outcome", "bars_on_stderr", "computing_on", "kept_groups", "local_folder"]

WORKERS_WAIT = 60
"""How long a cluster without workers is waited for [s]."""

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")
"""A URL of fsspec, also one that has been made a `Path`; no drive's letter."""


@dataclass(frozen=True)
class Outcome:
    """What a run did.

    Attributes
    ----------
    path
        The store.
    written
        Groups that were written.
    kept
        Groups that were there already, made from the same inputs and parameters.
    """

    path: Path
    written: tuple[str, ...]
    kept: tuple[str, ...]


def local_folder(out: str | Path, command: str) -> Path:
    """Return the store's folder; refuse what is none.

    Raises
    ------
    StoreError
        ``out`` is a URL.
    """
    if _URL.match(os.fspath(out)):
        raise StoreError(
            f"{command} writes to a folder, not to {os.fspath(out)!r}; {command} to a folder and copy it, or "
            "write the groups of open_collect with to_store, which takes URLs (README, 'Object stores')"
        )
    return Path(out)


def kept_groups(
    groups: Mapping[str, xr.Dataset],
    out: Path,
    *,
    overwrite: bool,
    command: str,
    only: tuple[str, str] | None = None,
) -> list[str]:
    """Return the groups that are there already; refuse a store that holds anything else.

    Parameters
    ----------
    groups
        Those that are to be there, each with its `INPUTS`.
    out
        The store.
    overwrite
        Whether groups made from something else are to be replaced.
    command
        What writes the store, named in messages.
    only
        No other group whose name begins with the first may be there: it would not be of the second.

    Raises
    ------
    StoreError
        Groups of other inputs stand where ours would, or beside them; all are listed.
    """
    from hyperpaint.io.store import is_complete, open_store
    from hyperpaint.io.store.listing import groups_above
    from hyperpaint.io.store.location import Location
    from hyperpaint.io.store.overwriting import problems_above

    if not out.exists():
        return []
    location = Location.of(out)
    problems = Problems(f"cannot write {out}", StoreError)
    above = dict.fromkeys(each for name in groups for each in groups_above(name))
    for text in problems_above(above, location, overwrite=overwrite):
        problems.add(text)
    problems.raise_if_any()
    kept = []
    for name in location.groups():
        same = is_complete(out, name) and open_store(out, name).attrs.get(INPUTS)
        if name not in groups:
            if only is not None and name.startswith(only[0]):
                problems.add(f"it holds /{name}, which is not of {only[1]}; choose another path")
        elif same == groups[name].attrs[INPUTS]:
            # a chunk that is missing is made again by `to_store`, with all others of its group
            if _has_all_chunks(location, name):
                kept.append(name)
        elif not overwrite:
            state = "with other inputs or parameters" if same else f"never finished, or not by {command}"
            problems.add(
                f"/{name} is there already, {state}",
                mend="pass overwrite=True to replace it",
                option="pass --overwrite to replace it",
            )
    problems.raise_if_any()
    return kept


def _has_all_chunks(location: Location, group: str) -> bool:
    from hyperpaint.io.store.listing import has_all_chunks
    from hyperpaint.io.store.record import read_record

    record = read_record(location, group)
    return record is not None and has_all_chunks(location, group, record)


# --- where it is computed ---


@contextlib.contextmanager
def computing_on(address: str | None) -> Iterator[Client | None]:
    """Make a cluster the place where dask computes; the caller's own, or threads, without an address.

    Raises
    ------
    MissingExtraError
        distributed is not installed.
    CollectError
        No scheduler answers there.
    StoreError
        No worker comes.
    """
    from hyperpaint.io.store.computing import client_in_force

    if address is None:
        client = client_in_force()
        if client is not None:
            _wait_for_workers(client)
        yield client
        return
    try:
        from distributed import Client
    except ImportError as error:
        needed = MissingExtraError.of("distributed", "distributed", "processing on a cluster")
        raise needed from error
    try:
        client = Client(address, timeout="10s", set_as_default=True)
    except (OSError, ValueError, TimeoutError) as error:
        raise CollectError(
            f"no dask scheduler answers at {address!r} ({error}); expected something like tcp://host:8786"
        ) from error
    with client:
        _wait_for_workers(client)
        yield client


def _wait_for_workers(client: Client) -> None:
    """Wait for the first worker, whose memory decides how the run is done; refuse a cluster without any."""
    try:
        client.wait_for_workers(1, timeout=WORKERS_WAIT)
    except TimeoutError as error:
        raise StoreError(
            f"no worker has come to the scheduler at {client.scheduler_info()['address']} within "
            f"{WORKERS_WAIT} s; start some (dask worker ADDRESS), or wait longer yourself: "
            "client.wait_for_workers(1)"
        ) from error


@contextlib.contextmanager
def bars_on_stderr() -> Iterator[None]:
    """Send progress bars to stderr, so that stdout holds results only."""
    with contextlib.redirect_stdout(sys.stderr):
        yield
