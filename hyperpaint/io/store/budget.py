"""The memory plan of a run, made before it starts.

A model gives the memory: a fixed share, the calibration and matched spectra that every task reads, and for
every thread its slabs of lines; `MARGIN` is added. The figures of merit (docs) compare the
model with measured peaks.

A limit of the address space (``ulimit -v``, some batch systems) counts more than resident memory: stacks, and
the arenas that glibc reserves for every thread, see `HELPER_SPACE` and `THREAD_SPACE`.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError, StoreError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, IRRADIANCE_TIME

# Memory that kernels, codecs and the writer add to a process with an open collect [byte].
RUNNING = 100 * 10**6

# Memory of a fresh process after compiling the kernels, without any slab [byte].
PROCESS = 330 * 10**6

# Memory of a worker of dask.distributed, without any slab [byte].
WORKER = 380 * 10**6

# Slabs of a thread: one is computed while another waits for its last chunk to be stored.
SLABS_IN_HAND = 2

# Memory for encoding a chunk, over the chunk's size: worst case, and a copy of the result.
ENCODED_COPIES = 1.5

# Memory of the dask graph of one slab [byte].
TASK_BYTES = 16_000

# Planned memory over modelled memory.
MARGIN = 1.1

# Memory of a process with all modules that read, calibrate and survey lines, without any slab [byte].
LOADED = 390 * 10**6

# Share of the available memory that a run uses if the user sets no limit.
USABLE = 0.8

# Address space of each of zarr's file threads beyond its resident memory [byte]; zarr starts up to four more
# than there are processors.
HELPER_SPACE = 48 * 2**20

# Address space of a computing thread beyond its slabs: a stack of 8 MiB, an arena of 64 MiB [byte].
THREAD_SPACE = 72 * 2**20

# Spacing of the shifts at which matched irradiance is stored [nm].
SMILE_STEP = 0.5


@dataclass(frozen=True)
class Load:
    """Memory that one flight line takes; all in bytes.

    Examples
    --------
    >>> load = Load(scan_line=1_044_480, light=34_816, encoded=33_423_360, shared=4_000_000, lines=640)
    >>> load.peak(lines=32, threads=2, fixed=270_000_000) // 10**6
    479
    """

    scan_line: int  # Counts and float32 product of one scan line
    light: int  # Irradiance of one scan line while it is interpolated
    encoded: int  # The chunk that is encoded, of the widest stored cube, and its result
    shared: int  # Calibration, darks and matched spectra, which all tasks read
    lines: int  # Scan lines of the flight line

    @classmethod
    def of(cls, line: xr.Dataset) -> Load:
        cube = next(line[name] for name in ("counts", "radiance", "reflectance") if name in line)
        samples = cube.sizes[BAND] * cube.sizes[CROSS_TRACK]
        single = np.dtype(np.float32).itemsize
        # cells of the smile; many where the smile is not in memory
        cells, shift = 1, line.variables.get("wavelength_shift")
        if shift is not None and shift.chunks is not None:
            cells = 16
        elif shift is not None and shift.size:
            cells += math.ceil(float(np.ptp(shift.values)) / SMILE_STEP)
        cubic = line.sizes[BAND] * cells * 4 * np.dtype(np.float64).itemsize
        small = sum(v.nbytes for v in line.variables.values() if ALONG_TRACK not in v.dims or v.ndim == 1)
        return cls(
            scan_line=samples * (cube.dtype.itemsize + single),
            light=4 * cubic,
            encoded=int(ENCODED_COPIES * min(CHUNK_LINES, cube.sizes[ALONG_TRACK]) * samples * single),
            # as read, and as passed to the tasks
            shared=2 * (small + line.sizes.get(IRRADIANCE_TIME, 0) * cubic),
            lines=cube.sizes[ALONG_TRACK],
        )

    @property
    def a_thread(self) -> int:
        """Memory of a thread with slabs as high as a storage chunk [byte]."""
        slab = min(CHUNK_LINES, self.lines) * (self.scan_line + self.light)
        return SLABS_IN_HAND * slab + self.encoded // 2

    def peak(self, *, lines: int, threads: int, fixed: int) -> int:
        """Return the modelled peak [byte] at ``lines`` a task; ``fixed``: memory without any slab."""
        slabs = math.ceil(self.lines / lines)
        slab = min(lines, self.lines) * (self.scan_line + self.light)
        a_thread = min(SLABS_IN_HAND, slabs) * slab + self.encoded
        return fixed + self.shared + TASK_BYTES * slabs + min(threads, slabs) * a_thread


@dataclass(frozen=True)
class Demand:
    """Lines a task and threads with which a run stays within its memory."""

    lines: int  # Scan lines a task
    threads: int  # Threads at once, in one process
    needed: int  # Peak memory of that process, margin included [byte]


def fit(
    loads: Mapping[str, Load],
    *,
    lines: int,
    threads: int,
    fixed: int,
    limit: int | None,
    least_threads: int = 1,
    a_thread: int = 0,
) -> Demand:
    """Return lines a task and threads with which every flight line stays within a limit.

    Lines are halved first, down to the 32 of a storage chunk, then threads are taken away one by one.

    ``loads``: by name of the flight line; they are processed one after the other; ``lines``, ``threads``: the
    numbers wished for, of threads ``least_threads`` at least; ``fixed``: memory without any slab; ``limit``:
    most memory of the process, None for no limit; ``a_thread``: memory of a thread besides its slabs, see
    `thread_space`; all in bytes.

    Raises `StoreError`: Not even the fewest threads with 32 lines a task stay within the limit.

    Examples
    --------
    >>> load = Load(scan_line=1_044_480, light=34_816, encoded=33_423_360, shared=4_000_000, lines=6400)
    >>> fit({"raw_0": load}, lines=256, threads=4, fixed=270 * 10**6, limit=600 * 10**6)
    Demand(lines=32, threads=2, needed=530416268)
    """

    def demand(lines: int, threads: int) -> Demand:
        peaks = [load.peak(lines=lines, threads=threads, fixed=fixed) for load in loads.values()]
        return Demand(lines, threads, int(MARGIN * max(peaks, default=0)) + threads * a_thread * bool(peaks))

    plan = demand(lines, threads)
    limit = plan.needed if limit is None else limit
    while plan.needed > limit and plan.lines > CHUNK_LINES:
        plan = demand(max(CHUNK_LINES, plan.lines // 2), threads)
    while plan.needed > limit and plan.threads > least_threads:
        plan = demand(plan.lines, plan.threads - 1)
    if plan.needed > limit:
        worst = max(loads, key=lambda name: loads[name].peak(lines=plan.lines, threads=1, fixed=fixed))
        mend = "fewer threads a worker, " if least_threads > 1 else ""
        which = "the limit of the address space (ulimit -v)" if a_thread else "the memory limit"
        raise StoreError(
            f"/{worst} needs {size_text(plan.needed)} of memory with {counted(plan.threads, 'thread')} and "
            f"{plan.lines} lines a task, the fewest possible",
            expected=f"at most {size_text(limit)}",
            mend=f"{mend}end other programs, raise {which}, or take a larger machine",
            code="memory-short",
        )
    return plan


_LIMIT: ContextVar[int | None] = ContextVar("memory_limit", default=None)


@contextlib.contextmanager
def memory_limit(size: str | int | None) -> Iterator[None]:
    """Limit the memory that this process plans with; None restores 80 % of the available memory.

    Raises `SchemaError`: not a size.
    """
    token = _LIMIT.set(None if size is None else parse_size(size))
    try:
        yield
    finally:
        _LIMIT.reset(token)


@contextlib.contextmanager
def planned(subject: str, *, a_thread: int, fixed: int = LOADED, least: int = 0) -> Iterator[None]:
    """Limit the number of threads to the memory limit; on a cluster, change nothing.

    ``a_thread``: memory of a thread; ``fixed``: memory without any thread; ``least``: memory needed at
    another time, whatever the threads; all in bytes.

    Raises `StoreError`: not even one thread stays within the limit.
    """
    from dask.base import get_scheduler

    # without distributed imported there is no client
    scheduler = get_scheduler() if "distributed" in sys.modules else None
    if hasattr(getattr(scheduler, "__self__", None), "scheduler_info"):
        yield
        return
    resident = resident_memory()
    limit = process_limit(resident)
    fixed = max(fixed, resident)

    def needed(threads: int) -> int:
        return int(MARGIN * max(least, fixed + threads * a_thread)) + threads * thread_space()

    threads = _threads_within(limit, needed)
    if needed(threads) > limit:
        raise StoreError(
            f"{subject} needs {size_text(needed(threads))} of memory with {counted(threads, 'thread')}",
            expected=f"at most {size_text(limit)}",
            mend="end other programs, raise the memory limit, take fewer lines, or a larger machine",
            code="memory-short",
        )
    with limited_threads(threads):
        yield


# --- available memory --------------------------------------------------------------------------------------


def parse_size(size: str | int) -> int:
    """Return a size such as ``"2 GiB"`` in bytes; SchemaError where it is no positive size.

    Examples
    --------
    >>> parse_size("2 GiB"), parse_size("500 MB"), parse_size(4096)
    (2147483648, 500000000, 4096)
    """
    from dask.utils import parse_bytes

    try:
        # dask would read text without a number as one
        number = int(parse_bytes(size)) if any(map(str.isdigit, str(size))) else 0
    except (ValueError, OverflowError, TypeError, AttributeError):
        number = 0
    if number <= 0:
        raise SchemaError(
            f"memory size {size!r}",
            expected="bytes above 0, or text such as '2 GiB' or '500 MB'",
            code="size-unreadable",
        )
    return number


def available_memory(system: Path = Path("/")) -> int:
    """Return the memory that can still be allocated [byte]; ``system``: root of ``proc`` and ``sys``.

    The least of the memory left by the machine, its container and the address space limit of this process.
    The reserve of helper threads is subtracted from the address space first.
    """
    space, limit = _address_space(), _LIMIT.get()
    shared = _shared_memory(system)
    own = shared if limit is None else limit - resident_memory()
    return max(0, min(shared, own, shared if space is None else space))


def _shared_memory(system: Path) -> int:
    # The memory left by the machine and its container, which other programs share.
    import psutil

    # includes the file cache, which is freed on demand
    return min([int(psutil.virtual_memory().available), *_container_memory(system)])


def process_limit(resident: int, limit: int | None = None) -> int:
    """Return the memory that this process, which holds ``resident`` bytes, may take at most [byte].

    ``limit`` of the user replaces `USABLE` of the available memory; a limit of the address space,
    which no other program shares, applies as well.
    """
    limit = _LIMIT.get() if limit is None else limit
    if limit is None:
        limit = resident + int(USABLE * max(0, _shared_memory(Path("/"))))
    space = _address_space()
    return limit if space is None else min(limit, resident + max(0, space))


def thread_space() -> int:
    """Return the address space of a computing thread besides its slabs [byte]; 0 without a limit."""
    return 0 if _address_limit() is None else THREAD_SPACE


def _address_limit() -> int | None:
    try:
        import resource
    except ImportError:  # pragma: no cover - Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def _address_space() -> int | None:
    # The address space left for slabs; None without a limit.
    limit = _address_limit()
    if limit is None:
        return None
    import psutil

    # zarr's threads are threads of asyncio; running ones have their space reserved
    running = sum(thread.name.startswith(("asyncio_", "zarr_io")) for thread in threading.enumerate())
    helpers = max(0, min(32, (os.cpu_count() or 1) + 4) + 1 - running)
    return limit - int(psutil.Process().memory_info().vms) - helpers * HELPER_SPACE


def _container_memory(system: Path) -> Iterator[int]:
    # The memory left by each control group (version 2 or 1) of this process, and by those above.
    # psutil knows no control groups, and distributed only the limit of the innermost one.
    root = system / "sys/fs/cgroup"
    try:
        entries = (system / "proc/self/cgroup").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return
    for number, controllers, path in (entry.split(":", 2) for entry in entries if entry.count(":") >= 2):
        if number == "0":
            base, limit, used = root, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            base, limit, used = root / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        inside = base.joinpath(*(part for part in path.split("/") if part not in ("", "..")))
        for folder in (inside, *(above for above in inside.parents if above.is_relative_to(base))):
            with contextlib.suppress(OSError, ValueError):  # no such group, or no limit ("max")
                left = int((folder / limit).read_text()) - int((folder / used).read_text())
                # the file cache is freed on demand
                with contextlib.suppress(OSError):
                    cached = re.search(r"^inactive_file (\d+)$", (folder / "memory.stat").read_text(), re.M)
                    left += int(cached[1]) if cached else 0
                yield left


def resident_memory() -> int:
    """Return the resident memory of this process [byte]."""
    import psutil

    return int(psutil.Process().memory_info().rss)


# --- threads -----------------------------------------------------------------------------------------------


def thread_count() -> int:
    """Return the number of threads that dask would use."""
    import dask
    from dask.system import CPU_COUNT

    if dask.config.get("scheduler", None) in ("sync", "synchronous", "single-threaded"):
        return 1
    pool = dask.config.get("pool", None)
    return int(getattr(pool, "_max_workers", 0) or dask.config.get("num_workers", None) or CPU_COUNT)


@contextlib.contextmanager
def limited_threads(count: int | None) -> Iterator[None]:
    """Limit the number of dask threads; None leaves it unchanged."""
    import dask

    saved = count is not None and count < thread_count()
    with dask.config.set(num_workers=count, pool=None) if saved else contextlib.nullcontext():
        yield


def check_memory(dataset: xr.Dataset, subject: str) -> int | None:
    """Return the number of threads that may store a dataset; StoreError if not even one block fits.

    The dask chunks cannot be changed here, only the number of threads. No value is read. Dask arrays count:
    cubes along the flight are computed together, line by line, other arrays one by one.

    ``subject`` names the dataset in errors. None where any number will do.

    Raises `StoreError`: one block is larger than the available memory.
    """
    available, fixed = available_memory(), thread_space()
    problems = Problems(f"{subject} does not fit into {size_text(available)} of memory", StoreError)
    cubes = []
    for name, variable in dataset.variables.items():
        if variable.chunks and ALONG_TRACK in variable.dims and variable.ndim > 1:
            cubes.append(variable)
        elif variable.chunks and variable.size:
            sizes = tuple(map(max, variable.chunks))
            block = math.prod(sizes) * variable.dtype.itemsize + fixed
            if block > available:
                problems.add(
                    f"{name!r} needs {size_text(block)} for one dask chunk of {sizes}",
                    mend="take smaller chunks, end other programs, or raise the memory limit",
                    code="memory-short",
                )
    problems.raise_if_any()
    if not cubes or not all(v.size for v in cubes):
        return None
    length = cubes[0].sizes[ALONG_TRACK]
    a_line = [v.nbytes // length for v in cubes]
    lines = max(max(v.chunksizes[ALONG_TRACK]) for v in cubes)
    encoded = int(ENCODED_COPIES * min(CHUNK_LINES, length) * max(a_line))
    surely = lines * sum(a_line) + encoded + fixed
    if surely > available:
        raise StoreError(
            f"{subject} needs {size_text(surely)} of memory for one dask chunk of {counted(lines, 'line')}",
            expected=f"at most {size_text(available)}",
            mend=f"take fewer lines a chunk (chunks={{'{ALONG_TRACK}': {CHUNK_LINES}}}), end other programs, "
            "or raise the memory limit",
            code="memory-short",
        )
    # a single cube is assumed to be computed from one half as large: 16-bit counts
    alone = sum(size > max(a_line) // 4 for size in a_line) == 1
    load = Load(sum(a_line) + alone * max(a_line) // 2, 0, encoded, 0, length)
    resident = resident_memory()

    def needed(threads: int) -> float:
        return MARGIN * load.peak(lines=lines, threads=threads, fixed=resident + RUNNING) + threads * fixed

    return _threads_within(process_limit(resident), needed)


def _threads_within(limit: int, needed: Callable[[int], float]) -> int:
    # The largest number of threads, at least one, within a memory limit.
    threads = thread_count()
    while threads > 1 and needed(threads) > limit:
        threads -= 1
    return threads


# --- sizes ------------------------------------------------------------------------------------------------


def size_text(size: int) -> str:
    """Return a size in MiB, or in GiB from one GiB on.

    Examples
    --------
    >>> size_text(3 * 2**30), size_text(5 * 2**20)
    ('3.00 GiB', '5 MiB')
    """
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{math.ceil(size / 2**20)} MiB"


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the singular or plural."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
