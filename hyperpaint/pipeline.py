"""A whole collect, from the instruments' files to one finished store."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from .errors import CollectError, MissingExtraError, PaintError, Problems, SchemaError, StoreError
from .io.store.listing import INPUTS
from .schema import ALONG_TRACK, CHUNK_LINES, CROSS_TRACK, FORMAT_VERSION, VARIABLES

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

    from .budget import Demand
    from .io.store.location import Location

__all__ = ["Outcome", "process", "run"]

KEPT_BITS = 12
"""Mantissa bits of the stored reflectance: a relative error of at most 2**-13, 1.2e-4."""

CLUSTER_LINES = 256
"""Lines in one task on a cluster, where a task costs more than on threads."""

WORKERS_WAIT = 60
"""How long a cluster without workers is waited for [s]."""

OVERVIEW_SHAPE = (1000, 640)
"""Most lines and columns of the stored picture."""

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")
"""A URL of fsspec, also one that has been made a `Path`; no drive's letter."""

Product = Literal["radiance", "reflectance"]
Kept = Literal["none", "stored"]


@dataclass(frozen=True)
class Outcome:
    """What `run` did.

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


def process(
    collect: str | Path,
    out: str | Path,
    *,
    to: Product = "reflectance",
    reflectance: Kept = "stored",
    scheduler: str | None = None,
    memory_limit: str | int | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Path:
    """Process a collect into one Zarr store.

    Each flight line becomes a group ``flightlines/<id>``: counts, everything that calibrates them,
    ``quality``, ``irradiance_age``, ``reflectance`` with 12 mantissa bits kept and a small true-colour
    ``overview``. The whole irradiance record and the calibration are archived beside them.

    Everything is opened, and one slab of every line computed, before anything is written. A rerun writes only
    the groups that are missing, and nothing where all are there.

    Parameters
    ----------
    collect
        A ``collect.toml``; see `open_collect`.
    out
        The store, a folder. To write to a URL, give `open_collect` and `to_store` the single groups.
    to
        ``"radiance"`` needs no irradiance, and stores ``radiance``, unrounded, in place of ``reflectance``.
    reflectance
        ``"none"`` leaves the computed cube out; ``.paint.reflectance()`` makes it from the stored counts.
    scheduler
        Address of a dask.distributed scheduler, whose workers see the same files. By default the client
        that is active, else threads.
    memory_limit
        Most memory of this process, or of each worker: bytes, or text such as ``"2 GiB"``. By default 80 % of
        what is available. The peak is computed before the run; where it would be larger, fewer lines a task
        and fewer threads are taken.
    overwrite
        Replace groups that were made from other inputs or parameters.
    progress
        Show on stderr which line is being written, and how far it is.

    Returns
    -------
    Path of the store.

    Raises
    ------
    CollectError
        The collect, or anything it names, cannot be used; all problems of all files are listed.
    SchemaError
        ``to`` or ``reflectance`` is none of the words above, or ``memory_limit`` is no size.
    StoreError
        ``out`` is a URL; the store holds something else, is being written, or cannot be written; or memory
        or disk would not suffice, of which the needed figure is told before anything is written; or workers,
        or the scheduler, were lost, or a block failed again and again: the message names it, and the same
        call finishes the run.
    MissingExtraError
        ``scheduler`` is given, and distributed is not installed.

    Warns
    -----
    PaintWarning
        As `open_collect`.

    Examples
    --------
    >>> path = process("collect.toml", "lot.zarr")                                # doctest: +SKIP
    >>> xr.open_zarr(path, group="flightlines/raw_0").paint.rgb()                 # doctest: +SKIP
    """
    return run(
        collect,
        out,
        to=to,
        reflectance=reflectance,
        scheduler=scheduler,
        memory_limit=memory_limit,
        overwrite=overwrite,
        progress=progress,
    ).path


def run(
    collect: str | Path,
    out: str | Path,
    *,
    to: Product = "reflectance",
    reflectance: Kept = "stored",
    scheduler: str | None = None,
    memory_limit: str | int | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Outcome:
    """Do what `process` does, and tell what was written; the arguments are those of `process`."""
    import xarray as xr

    from .budget import limited_threads, parse_size
    from .io.store import to_store
    from .io.store.computing import errors_of_the_cluster
    from .io.store.writer import check_room

    _check_words(to, reflectance)
    out = _folder(out)
    limit = None if memory_limit is None else parse_size(memory_limit)
    parameters = {"to": to, "reflectance": reflectance}
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(_cluster(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot process {collect}"))
        lines_a_task = CHUNK_LINES if client is None else CLUSTER_LINES
        tree, groups = _opened(collect, lines_a_task, parameters)
        kept = _kept(groups, out, overwrite=overwrite)
        pending = [name for name in groups if name not in kept]
        demand = _demand({name: groups[name] for name in pending}, lines_a_task, client, limit)
        stack.enter_context(limited_threads(demand.threads if client is None else None))
        if demand.lines < lines_a_task:
            tree, groups = _opened(collect, demand.lines, parameters)
        made = {name: _product(groups[name], name, to, reflectance) for name in pending}
        check_room(made, out, {name: _token(dataset) for name, dataset in made.items()})
        _rehearse(made, collect, client)
        lines = [name for name, dataset in made.items() if ALONG_TRACK in dataset.dims]
        for name, dataset in made.items():
            if progress and name in lines:
                which = f"flight line {lines.index(name) + 1} of {len(lines)}"
                sys.stderr.write(f"{name}: {which}, {dataset.sizes[ALONG_TRACK]} scan lines\n")
            with _bars_on_stderr() if progress else contextlib.nullcontext():
                to_store(
                    dataset, out, name, overwrite=overwrite, progress=progress, source_token=_token(dataset)
                )
        root = xr.DataTree(xr.Dataset(attrs=tree.attrs))
        to_store(root, out, overwrite=overwrite)
    return Outcome(out, tuple(made), tuple(kept))


def _check_words(to: str, reflectance: str) -> None:
    problems = Problems("cannot process", SchemaError)
    for name, value, allowed in (
        ("to", to, ("radiance", "reflectance")),
        ("reflectance", reflectance, ("none", "stored")),
    ):
        if value not in allowed:
            problems.add(f"{name}={value!r}, expected {' or '.join(map(repr, allowed))}")
    problems.raise_if_any()


def _folder(out: str | Path) -> Path:
    """Return the store's folder; refuse what is none."""
    if _URL.match(os.fspath(out)):
        msg = (
            f"process writes to a folder, not to {os.fspath(out)!r}; process to a folder and copy it, or "
            "write the groups of open_collect with to_store, which takes URLs (README, 'Object stores')"
        )
        raise StoreError(msg)
    return Path(out)


# --- what is to be written ---------------------------------------------------------------------------------


def _opened(
    collect: str | Path, lines: int, parameters: Mapping[str, Any]
) -> tuple[xr.DataTree, dict[str, xr.Dataset]]:
    """Open a collect with so many lines a task; return it, and the groups of a store."""
    from .laboratory import open_collect

    need_irradiance = parameters["to"] == "reflectance"
    tree = open_collect(collect, need_irradiance=need_irradiance, chunks={ALONG_TRACK: lines})
    return tree, _groups(tree, Path(collect), parameters)


def _groups(tree: xr.DataTree, collect: Path, parameters: Mapping[str, Any]) -> dict[str, xr.Dataset]:
    """Return the groups of a store as they were opened, each naming what it is made from."""
    from .io.collect import read_collect
    from .io.envi import find_pair

    entries = read_collect(collect, need_irradiance=parameters["to"] == "reflectance").flightlines
    cubes = {f"flightlines/{entry.id}": find_pair(entry.cube)[1] for entry in entries}
    groups = {}
    for name in (*cubes, "irradiance", "calibration"):
        if f"/{name}" not in tree.groups:
            continue
        dataset = tree[name].to_dataset()
        said = dict(parameters) if name in cubes else {}
        digest = _digest(dataset, cubes.get(name), said)
        groups[name] = dataset.assign_attrs({INPUTS: digest})
    return groups


def _digest(dataset: xr.Dataset, cube: Path | None, parameters: Mapping[str, Any]) -> str:
    """Return a digest of all values but the cube's, of the cube's size and time, and of the parameters."""
    import dask
    import numpy as np

    found = hashlib.sha256(json.dumps([FORMAT_VERSION, KEPT_BITS, parameters], sort_keys=True).encode())
    if cube is not None:
        status = cube.stat()
        found.update(f"{cube.name} {status.st_size} {status.st_mtime_ns}".encode())
    found.update(json.dumps(dataset.attrs, sort_keys=True, default=str).encode())
    for name, variable in sorted(dataset.variables.items(), key=lambda item: str(item[0])):
        found.update(f"{name} {variable.dims} {variable.shape} {variable.dtype} {variable.attrs}".encode())
        if not dask.is_dask_collection(variable):
            found.update(np.ascontiguousarray(variable.values).tobytes())
    return found.hexdigest()[:32]


def _token(dataset: xr.Dataset) -> str:
    return str(dataset.attrs[INPUTS])


def _kept(groups: Mapping[str, xr.Dataset], out: Path, *, overwrite: bool) -> list[str]:
    """Return the groups that are there already; refuse a store that holds anything else.

    Raises
    ------
    StoreError
        Groups of other inputs stand where ours would, or beside them; all are listed.
    """
    from .io.store import is_complete, open_store
    from .io.store.listing import groups_above
    from .io.store.location import Location
    from .io.store.occupied import problems_above

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
            if name.startswith("flightlines/"):
                problems.add(f"it holds /{name}, which is not of this collect; choose another path")
        elif same == _token(groups[name]):
            # a chunk that is missing is made again by `to_store`, with all others of its group
            if _has_all_chunks(location, name):
                kept.append(name)
        elif not overwrite:
            state = "with other inputs or parameters" if same else "never finished, or not by process"
            problems.add(f"/{name} is there already, {state}; pass overwrite=True to replace it")
    problems.raise_if_any()
    return kept


def _has_all_chunks(location: Location, group: str) -> bool:
    from .io.store.listing import has_all_chunks
    from .io.store.record import read_record

    record = read_record(location, group)
    return record is not None and has_all_chunks(location, group, record)


def _product(dataset: xr.Dataset, name: str, to: Product, kept: Kept) -> xr.Dataset:
    """Return a flight line with all that is stored of it; other groups as they are."""
    if not name.startswith("flightlines/"):
        return dataset
    made: xr.Dataset
    if to == "radiance":
        made = dataset.paint.radiance()
        return made.drop_vars("radiance") if kept == "none" and "counts" in made else made
    made = dataset.paint.reflectance(keep_bits=KEPT_BITS)
    made["reflectance"].attrs["keep_bits"] = KEPT_BITS
    picture = _overview(made)
    if picture is not None:
        made = made.assign(overview=picture)
    return made.drop_vars("reflectance") if kept == "none" else made


def _overview(dataset: xr.Dataset) -> xr.DataArray | None:
    """Return a small true-colour picture, (overview_y, overview_x, rgb) uint8, or None without colours.

    Lazy, from the same slabs that are written: no cube is read twice.
    """
    import numpy as np

    from .plot import rgb

    steps = {
        dim: -(-dataset.sizes[dim] // most)
        for dim, most in zip((ALONG_TRACK, CROSS_TRACK), OVERVIEW_SHAPE, strict=True)
    }
    few = dataset[["reflectance"]].isel({dim: slice(None, None, step) for dim, step in steps.items()})
    try:
        picture = rgb(few)
    except SchemaError:  # fewer than three visible bands
        return None
    row = VARIABLES["overview"]
    made = (picture * np.float32(255.0) + np.float32(0.5)).astype(np.uint8).reset_coords(drop=True)
    made = made.drop_vars(list(made.coords)).rename(dict(zip(made.dims, row.dims, strict=True)))
    made.attrs = {**row.attrs, "line_step": steps[ALONG_TRACK], "column_step": steps[CROSS_TRACK]}
    return made.rename("overview")


def _rehearse(groups: Mapping[str, xr.Dataset], collect: str | Path, client: Client | None) -> None:
    """Compute the first slab of every line, so that values that cannot be are found before writing.

    On a cluster this also compiles the kernels once, where the workers share a cache.
    """
    from .io.store.computing import RETRIES, errors_of_the_cluster

    options = {} if client is None else {"retries": RETRIES}
    problems = Problems(f"{collect} cannot be processed", CollectError)
    for name, dataset in groups.items():
        if "quality" in dataset.variables:
            try:
                with errors_of_the_cluster(f"cannot compute the first lines of /{name}"):
                    dataset["quality"].isel({ALONG_TRACK: slice(0, 1)}).compute(**options)
            except StoreError:  # of the cluster, not of the data
                raise
            except (PaintError, OSError) as error:
                problems.add(f"/{name}: {error}")
    problems.raise_if_any()


# --- where it is computed ----------------------------------------------------------------------------------


def _demand(groups: Mapping[str, xr.Dataset], lines: int, client: Client | None, limit: int | None) -> Demand:
    """Return lines a task and threads that keep this process, or each worker, within its memory."""
    from . import budget

    loads = {name: budget.Load.of(line) for name, line in groups.items() if ALONG_TRACK in line.dims}
    if client is None:
        resident = budget.resident_memory()
        return budget.fit(
            loads,
            lines=lines,
            threads=budget.thread_count(),
            fixed=max(budget.PROCESS, resident + budget.RUNNING),
            limit=budget.process_limit(resident, limit),
            a_thread=budget.thread_space(),
        )
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    limits = [worker["memory_limit"] for worker in workers if worker["memory_limit"]]
    if limit is None and limits:
        limit = int(budget.USABLE * min(limits))
    threads = max((worker["nthreads"] for worker in workers), default=1)
    return budget.fit(
        loads, lines=lines, threads=threads, fixed=budget.WORKER, limit=limit, least_threads=threads
    )


@contextlib.contextmanager
def _cluster(address: str | None) -> Iterator[Client | None]:
    """Make a cluster the place where dask computes; the caller's own, or threads, without an address."""
    from .io.store.computing import client_in_force

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
        msg = f"no dask scheduler answers at {address!r} ({error}); expected something like tcp://host:8786"
        raise CollectError(msg) from error
    with client:
        _wait_for_workers(client)
        yield client


def _wait_for_workers(client: Client) -> None:
    """Wait for the first worker, whose memory decides how the run is done; refuse a cluster without any."""
    try:
        client.wait_for_workers(1, timeout=WORKERS_WAIT)
    except TimeoutError as error:
        msg = (
            f"no worker has come to the scheduler at {client.scheduler_info()['address']} within "
            f"{WORKERS_WAIT} s; start some (dask worker ADDRESS), or wait longer yourself: "
            "client.wait_for_workers(1)"
        )
        raise StoreError(msg) from error


@contextlib.contextmanager
def _bars_on_stderr() -> Iterator[None]:
    """Send progress bars to stderr, so that stdout holds results only."""
    with contextlib.redirect_stdout(sys.stderr):
        yield
