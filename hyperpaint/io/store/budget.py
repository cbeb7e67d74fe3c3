"""The memory plan of a run, computed before it starts.

Modelled memory is the sum of a fixed part, of the calibration and matched spectra that all tasks read, and of
the slabs of lines of every thread; it is multiplied by `MARGIN`. The figures of merit (docs) compare the
model with measured peaks.

A limit of the address space (``ulimit -v``, some batch systems) includes more than resident memory: stacks,
and the arenas that glibc reserves for every thread, see `HELPER_SPACE` and `THREAD_SPACE`.
"""

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
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    Problems,
    SchemaError,
    StoreError,
)

# Memory that kernels, codecs and the writer add to a process with an open collect [byte].
RUNNING = 100 * 10**6

# Memory of a fresh process after compiling the kernels, without any slab [byte].
PROCESS = 330 * 10**6

# Memory of a worker of dask.distributed, without any slab [byte].
WORKER = 380 * 10**6

COPIES = SimpleNamespace(
    # Number of slabs of a thread in memory: one is computed while the last chunk of another is being stored.
    slabs_in_hand=2,
    # Memory for encoding a chunk, relative to its size: result in the worst case, and its copy.
    encoded_copies=1.5,
    # Memory of the dask graph of one slab [byte].
    task_bytes=16_000,
    # Spacing of the shifts at which matched irradiance is stored [nm].
    smile_step_nm=0.5,
)


# Ratio of planned to modelled memory.
MARGIN = 1.1

# Memory of a process with all modules that read, calibrate and survey lines, without any slab [byte].
LOADED = 390 * 10**6

# Share of the available memory that a run uses if the user sets no limit.
USABLE = 0.8

# Address space of a file thread of zarr beyond its resident memory [byte]; zarr starts up to 4 threads more
# than there are processors.
HELPER_SPACE = 48 * 2**20

# Address space of a computing thread beyond its slabs: a stack of 8 MiB, an arena of 64 MiB [byte].
THREAD_SPACE = 72 * 2**20


@dataclass(frozen=True)
class Load:
    """Memory for processing one flight line [byte].

    Examples
    --------
    >>> load = Load(scan_line=1_044_480, light=34_816, encoded=33_423_360, shared=4_000_000, lines=640)
    >>> load.peak(lines=32, threads=2, fixed=270_000_000) // 10**6
    479
    """

    scan_line: int  # Counts and float32 product of one scan line
    light: int  # Arrays for the interpolation of irradiance, per scan line
    encoded: int  # A chunk of the cube and its encoded bytes
    shared: int  # Calibration, darks and matched spectra, which all tasks read
    lines: int  # Number of scan lines of the flight line

    @classmethod
    def of(cls, line: xr.Dataset) -> "Load":
        cube = next(line[name] for name in ("counts", "radiance", "reflectance") if name in line)
        samples = cube.sizes[BAND] * cube.sizes[CROSS_TRACK]
        single = np.dtype(np.float32).itemsize
        # number of wavelength shifts of matched irradiance; 16 if the smile is not in memory
        cells, shift = 1, line.variables.get("wavelength_shift")
        if shift is not None and shift.chunks is not None:
            cells = 16
        elif shift is not None and shift.size:
            cells += math.ceil(float(np.ptp(shift.values)) / COPIES.smile_step_nm)
        cubic = line.sizes[BAND] * cells * 4 * np.dtype(np.float64).itemsize
        small = sum(v.nbytes for v in line.variables.values() if ALONG_TRACK not in v.dims or v.ndim == 1)
        return cls(
            scan_line=samples * (cube.dtype.itemsize + single),
            light=4 * cubic,
            encoded=int(COPIES.encoded_copies * min(CHUNK_LINES, cube.sizes[ALONG_TRACK]) * samples * single),
            # twice: as read, and as passed to the tasks
            shared=2 * (small + line.sizes.get(IRRADIANCE_TIME, 0) * cubic),
            lines=cube.sizes[ALONG_TRACK],
        )

    @property
    def a_thread(self) -> int:
        # Memory of a thread with slabs of the lines of a storage chunk [byte].
        slab = min(CHUNK_LINES, self.lines) * (self.scan_line + self.light)
        return int(COPIES.slabs_in_hand * slab + self.encoded // 2)

    def peak(self, *, lines: int, threads: int, fixed: int) -> int:
        # Return the modelled peak [byte]; ``lines``: per task; ``fixed``: memory without any slab.
        slabs = math.ceil(self.lines / lines)
        slab = min(lines, self.lines) * (self.scan_line + self.light)
        a_thread = min(COPIES.slabs_in_hand, slabs) * slab + self.encoded
        return int(fixed + self.shared + COPIES.task_bytes * slabs + min(threads, slabs) * a_thread)


@dataclass(frozen=True)
class Demand:
    # Lines per task and threads of a run, and its peak memory.
    lines: int  # Scan lines per task
    threads: int  # Number of parallel threads of the process
    needed: int  # Peak memory of the process, margin included [byte]


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
    """Return lines per task and threads with which every flight line stays within a memory limit.

    Lines are halved first, down to the 32 of a storage chunk, then threads are removed one by one.

    ``loads``: memory by flight line, which are processed one after the other; ``lines``, ``threads``: the
    desired numbers; ``least_threads``: minimum number of threads; ``fixed``: memory without any slab;
    ``limit``: maximum memory of the process, None for no limit; ``a_thread``: memory of a thread besides its
    slabs, see `thread_space`; all in bytes.

    Raises `StoreError`: The minimum number of threads with 32 lines per task exceeds the limit.

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
        mend = "take fewer threads per worker, " if least_threads > 1 else ""
        limit_name = "the limit of the address space (ulimit -v)" if a_thread else "the memory limit"
        raise StoreError(
            f"/{worst} needs {size_text(plan.needed)} of memory with {counted(plan.threads, 'thread')} and "
            f"{plan.lines} lines per task, the fewest possible",
            expected=f"at most {size_text(limit)}",
            mend=f"{mend}end other programs, raise {limit_name}, or take a larger machine",
            code="memory-short",
        )
    return plan


_LIMIT: ContextVar[int | None] = ContextVar("memory_limit", default=None)


@contextlib.contextmanager
def memory_limit(size: str | int | None) -> Iterator[None]:
    # Limit the memory in plans of this process; None for 80 % of the available memory.
    #
    # Raises `SchemaError`: ``size`` is not a size.
    token = _LIMIT.set(None if size is None else parse_size(size))
    try:
        yield
    finally:
        _LIMIT.reset(token)


@contextlib.contextmanager
def planned(subject: str, *, a_thread: int, fixed: int = LOADED, min_bytes: int = 0) -> Iterator[None]:
    # Limit the number of threads to the memory limit; on a cluster, change nothing.
    #
    # ``a_thread``: memory of a thread; ``fixed``: memory without any thread; ``min_bytes``: memory of another
    # step, which does not depend on threads; all in bytes.
    #
    # Raises `StoreError`: One thread exceeds the limit.
    if client_in_force() is not None:
        yield
        return
    resident = resident_memory()
    limit = process_limit(resident)
    fixed = max(fixed, resident)

    def needed(threads: int) -> int:
        return int(MARGIN * max(min_bytes, fixed + threads * a_thread)) + threads * thread_space()

    threads = _threads_within(limit, needed)
    StoreError.raise_if(
        needed(threads) > limit,
        f"{subject} needs {size_text(needed(threads))} of memory with {counted(threads, 'thread')}",
        expected=f"at most {size_text(limit)}",
        mend="end other programs, raise the memory limit, take fewer lines, or a larger machine",
        code="memory-short",
    )
    with limited_threads(threads):
        yield


# --- available memory --------------------------------------------------------------------------------------


def parse_size(size: str | int) -> int:
    """Return a size such as ``"2 GiB"`` in bytes; SchemaError if it is not a positive size.

    Examples
    --------
    >>> parse_size("2 GiB"), parse_size("500 MB"), parse_size(4096)
    (2147483648, 500000000, 4096)
    """
    from dask.utils import parse_bytes

    try:
        # dask reads a unit without a number as 1 of it
        number = int(parse_bytes(size)) if any(map(str.isdigit, str(size))) else 0
    except (ValueError, OverflowError, TypeError, AttributeError):
        number = 0
    SchemaError.raise_if(
        number <= 0,
        f"memory size {size!r}",
        expected="bytes above 0, or text such as '2 GiB' or '500 MB'",
        code="size-unreadable",
    )
    return number


def available_memory(system: Path = Path("/")) -> int:
    # Return the memory that can still be allocated [byte]; ``system``: root of ``proc`` and ``sys``.
    #
    # That is the minimum of the free memory of the machine, of its container, of the user's limit, and of the
    # address space limit of this process, without the address space of helper threads.
    space, limit = _address_space(), _LIMIT.get()
    shared = _shared_memory(system)
    allowed = shared if limit is None else limit - resident_memory()
    return max(0, min(shared, allowed, shared if space is None else space))


def _shared_memory(system: Path) -> int:
    # Free memory of the machine and its container, which other programs use as well
    # `available` includes the file cache, which is freed on demand
    free_bytes = [int(psutil.virtual_memory().available)]
    # and of every control group (version 2 or 1) of this process, and of their parents: psutil does not read
    # control groups, and distributed only the limit of the innermost
    root, entries = system / "sys/fs/cgroup", list[str]()
    with contextlib.suppress(OSError):
        entries = (system / "proc/self/cgroup").read_text(encoding="ascii", errors="replace").splitlines()
    for number, controllers, path in (entry.split(":", 2) for entry in entries if entry.count(":") >= 2):
        if number == "0":
            base, limit, usage = root, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            base, limit, usage = root / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        group_folder = base.joinpath(*(part for part in path.split("/") if part not in ("", "..")))
        for folder in (
            group_folder,
            *(parent for parent in group_folder.parents if parent.is_relative_to(base)),
        ):
            with contextlib.suppress(OSError, ValueError):  # the group does not exist, or its limit is "max"
                free = int((folder / limit).read_text()) - int((folder / usage).read_text())
                # the file cache is freed on demand
                with contextlib.suppress(OSError):
                    cached = re.search(r"^inactive_file (\d+)$", (folder / "memory.stat").read_text(), re.M)
                    free += int(cached[1]) if cached else 0
                free_bytes.append(free)
    return min(free_bytes)


def process_limit(resident: int, limit: int | None = None) -> int:
    # Return the maximum memory of this process, which has ``resident`` bytes [byte].
    #
    # ``limit``: of the user; by default `USABLE` of the available memory is added to ``resident``. A limit of
    # the address space applies as well.
    limit = _LIMIT.get() if limit is None else limit
    if limit is None:
        limit = resident + int(USABLE * max(0, _shared_memory(Path("/"))))
    space = _address_space()
    return limit if space is None else min(limit, resident + max(0, space))


def thread_space() -> int:
    # Return the address space of a computing thread besides its slabs [byte]; 0 without a limit.
    return 0 if _address_limit() is None else THREAD_SPACE


def _address_limit() -> int | None:
    try:
        import resource
    except ImportError:  # pragma: no cover - Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def _address_space() -> int | None:
    # Address space free for slabs, None without a limit
    limit = _address_limit()
    if limit is None:
        return None
    # zarr's threads are threads of asyncio; the space of running threads is already reserved
    running = sum(thread.name.startswith(("asyncio_", "zarr_io")) for thread in threading.enumerate())
    helpers = max(0, min(32, (os.cpu_count() or 1) + 4) + 1 - running)
    return limit - int(psutil.Process().memory_info().vms) - helpers * HELPER_SPACE


def resident_memory() -> int:
    # Return the resident memory of this process [byte].
    return int(psutil.Process().memory_info().rss)


# --- threads -----------------------------------------------------------------------------------------------


def client_in_force() -> Any:
    # Return the current client of dask.distributed, None without a cluster.
    client = getattr(scheduler_in_force(), "__self__", None)
    return client if hasattr(client, "scheduler_info") else None


def scheduler_in_force() -> Any:
    # Return the scheduler with which dask computes arrays.
    #
    # Without an import of distributed there is no client. dask would import it to look for one, which takes a
    # quarter of a second.
    import dask
    import dask.threaded
    from dask.base import get_scheduler

    is_chosen = "distributed" in sys.modules or dask.config.get("scheduler", None)
    return (is_chosen and get_scheduler()) or dask.threaded.get


def thread_count() -> int:
    # Return the number of threads that dask would use.
    import dask
    from dask.system import CPU_COUNT

    return (
        1
        if dask.config.get("scheduler", None) in ("sync", "synchronous", "single-threaded")
        else int(
            getattr(dask.config.get("pool", None), "_max_workers", 0)
            or dask.config.get("num_workers", None)
            or CPU_COUNT
        )
    )


@contextlib.contextmanager
def limited_threads(count: int | None) -> Iterator[None]:
    # Limit the number of dask threads; None leaves it unchanged.
    import dask

    saved = count is not None and count < thread_count()
    with dask.config.set(num_workers=count, pool=None) if saved else contextlib.nullcontext():
        yield


def check_memory(dataset: xr.Dataset, subject: str) -> int | None:
    # Return the number of threads with which a dataset can be stored, None for any number.
    #
    # No value is read, and dask chunks are not changed. Cubes along the flight are computed together, block
    # by block of lines, other dask arrays one after the other. ``subject``: the dataset in errors.
    #
    # Raises `StoreError`: One block is larger than the available memory.
    available, fixed = available_memory(), thread_space()
    with Problems(f"{subject} does not fit into {size_text(available)} of memory", StoreError) as problems:
        cubes = []
        for name, variable in dataset.variables.items():
            if variable.chunks and ALONG_TRACK in variable.dims and variable.ndim > 1:
                cubes.append(variable)
            elif variable.chunks and variable.size:
                sizes = tuple(map(max, variable.chunks))
                block = math.prod(sizes) * variable.dtype.itemsize + fixed
                problems.add_if(
                    block > available,
                    f"{name!r} needs {size_text(block)} for one dask chunk of {sizes}",
                    mend="take smaller chunks, end other programs, or raise the memory limit",
                    code="memory-short",
                )
    if not cubes or not all(v.size for v in cubes):
        return None
    length = cubes[0].sizes[ALONG_TRACK]
    a_line = [v.nbytes // length for v in cubes]
    lines = max(max(v.chunksizes[ALONG_TRACK]) for v in cubes)
    encoded = int(COPIES.encoded_copies * min(CHUNK_LINES, length) * max(a_line))
    one_thread = lines * sum(a_line) + encoded + fixed
    StoreError.raise_if(
        one_thread > available,
        f"{subject} needs {size_text(one_thread)} of memory for a dask chunk of {counted(lines, 'line')}",
        expected=f"at most {size_text(available)}",
        mend=(
            f"take fewer lines per chunk (chunks={{'{ALONG_TRACK}': {CHUNK_LINES}}}), "
            "end other programs, or raise the memory limit"
        ),
        code="memory-short",
    )
    # a single float32 cube is assumed to be computed from a cube of 16-bit counts, which is half as large
    is_single = sum(size > max(a_line) // 4 for size in a_line) == 1
    load = Load(sum(a_line) + is_single * max(a_line) // 2, 0, encoded, 0, length)
    resident = resident_memory()

    def memory_of(threads: int) -> float:
        return MARGIN * load.peak(lines=lines, threads=threads, fixed=resident + RUNNING) + threads * fixed

    return _threads_within(process_limit(resident), memory_of)


def _threads_within(limit: int, memory_of: Callable[[int], float]) -> int:
    # Maximum number of threads within a memory limit; 1 if even that exceeds it
    threads = thread_count()
    while threads > 1 and memory_of(threads) > limit:
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
    # Return a number with its noun, in the singular or plural.
    return f"{number} {noun}{'' if number == 1 else 's'}"
