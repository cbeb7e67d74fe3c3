"""What a run takes: its peak memory and its disk space, known before it starts.

Memory is modelled, not measured: a fixed share, the calibration and matched spectra that every task reads,
and for every thread the slabs of lines it has in hand. Peaks measured at 272 x 640 and
136 x 320 elements, with 1 to 4 threads and 32 to 128 lines a task, lay 5 to 17 % below the model with kernels
compiled before; `MARGIN` comes on top.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import SchemaError, StoreError
from .schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, IRRADIANCE_TIME

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "PROCESS",
    "RUNNING",
    "USABLE",
    "WORKER",
    "Demand",
    "Load",
    "available_memory",
    "check_disk",
    "disk_needed",
    "fit",
    "parse_size",
    "resident_memory",
]

RUNNING = 100 * 10**6
"""Bytes that kernels, codecs and the writer add to what is resident once a collect is open."""

PROCESS = 330 * 10**6
"""Bytes of a process that did nothing else before, kernels compiled in it, without any slab."""

WORKER = 380 * 10**6
"""Bytes of a worker of dask.distributed, without any slab."""

SLABS_IN_HAND = 2
"""Slabs of a thread: one is made while another waits for its last chunk to be stored."""

ENCODED_COPIES = 1.5
"""Encoding a chunk takes room for the worst case, and a copy of what came out."""

TASK_BYTES = 16_000
"""Graph of one slab."""

MARGIN = 1.1
"""Needed is what the model says, and a tenth more."""

USABLE = 0.8
"""Share of the available memory that a run takes when it is given no limit."""

STORED_SHARE = {"counts": 0.55, "rounded": 0.45}
"""Bytes on disk of a byte in memory: 12-bit counts in uint16, float32 with 12 mantissa bits."""

SMILE_STEP = 0.5
"""Distance of the shifts at which matched irradiance is kept [nm]."""


@dataclass(frozen=True)
class Load:
    """What one flight line asks of memory; all in bytes.

    Attributes
    ----------
    scan_line
        Counts and float32 product of one scan line.
    light
        Irradiance of one scan line while it is interpolated.
    encoded
        The chunk that is encoded, of the widest stored cube, and its result.
    shared
        Calibration, darks and matched spectra, which all tasks read.
    lines
        Scan lines of the flight line.

    Examples
    --------
    >>> load = Load(scan_line=1_044_480, light=34_816, encoded=33_423_360, shared=4_000_000, lines=640)
    >>> load.peak(lines=32, threads=2, fixed=270_000_000) // 10**6
    479
    """

    scan_line: int
    light: int
    encoded: int
    shared: int
    lines: int

    @classmethod
    def of(cls, line: xr.Dataset) -> Load:
        """Return the load of a flight line as `open_flightline` returns it."""
        import numpy as np

        cube = line["counts"] if "counts" in line else line["radiance"]
        samples = cube.sizes[BAND] * cube.sizes[CROSS_TRACK]
        single = np.dtype(np.float32).itemsize
        cells = _smile_cells(line)
        cubic = line.sizes[BAND] * cells * 4 * np.dtype(np.float64).itemsize
        small = sum(v.nbytes for v in line.variables.values() if ALONG_TRACK not in v.dims or v.ndim == 1)
        return cls(
            scan_line=samples * (cube.dtype.itemsize + single),
            light=4 * cubic,
            encoded=int(ENCODED_COPIES * min(CHUNK_LINES, cube.sizes[ALONG_TRACK]) * samples * single),
            # once as it was read, once as the tasks take it
            shared=2 * (small + line.sizes.get(IRRADIANCE_TIME, 0) * cubic),
            lines=cube.sizes[ALONG_TRACK],
        )

    def peak(self, *, lines: int, threads: int, fixed: int) -> int:
        """Return the modelled peak [byte] at ``lines`` a task; ``fixed`` is there without any slab."""
        slabs = math.ceil(self.lines / lines)
        slab = min(lines, self.lines) * (self.scan_line + self.light)
        a_thread = min(SLABS_IN_HAND, slabs) * slab + self.encoded
        return fixed + self.shared + TASK_BYTES * slabs + min(threads, slabs) * a_thread


def _smile_cells(line: xr.Dataset) -> int:
    """Return how many pieces the smile is cut into, or a large number where it is not at hand."""
    if "wavelength_shift" not in line.variables:
        return 1
    variable = line.variables["wavelength_shift"]
    if variable.chunks is not None:
        return 16
    values = variable.values
    return 1 + math.ceil(float(values.max() - values.min()) / SMILE_STEP) if values.size else 1


@dataclass(frozen=True)
class Demand:
    """How a run is done so that it stays within its memory.

    Attributes
    ----------
    lines
        Scan lines a task.
    threads
        Threads at once, in one process.
    needed
        Peak memory of that process, margin included [byte].
    """

    lines: int
    threads: int
    needed: int


def fit(
    loads: Mapping[str, Load],
    *,
    lines: int,
    threads: int,
    fixed: int,
    limit: int | None,
    least_threads: int = 1,
) -> Demand:
    """Return lines a task and threads with which every flight line stays within a limit.

    Lines are halved first, down to the 32 of a storage chunk, then threads are taken away one by one.

    Parameters
    ----------
    loads
        Name of a flight line to its load; lines are processed one after the other.
    lines, threads
        What is wished for.
    fixed
        Memory there is without any slab [byte].
    limit
        Most memory of the process [byte]; None for no limit.
    least_threads
        Threads that there are at least.

    Raises
    ------
    StoreError
        Not even the fewest threads with 32 lines a task stay within the limit.

    Examples
    --------
    >>> load = Load(scan_line=1_044_480, light=34_816, encoded=33_423_360, shared=4_000_000, lines=6400)
    >>> fit({"raw_0": load}, lines=256, threads=4, fixed=270 * 10**6, limit=600 * 10**6)
    Demand(lines=32, threads=2, needed=530416268)
    """

    def demand(lines: int, threads: int) -> Demand:
        peaks = [load.peak(lines=lines, threads=threads, fixed=fixed) for load in loads.values()]
        return Demand(lines, threads, int(MARGIN * max(peaks, default=0)))

    found = demand(lines, threads)
    if limit is None:
        return found
    while found.needed > limit and found.lines > CHUNK_LINES:
        found = demand(max(CHUNK_LINES, found.lines // 2), found.threads)
    while found.needed > limit and found.threads > least_threads:
        found = demand(found.lines, found.threads - 1)
    if found.needed > limit:
        worst = max(loads, key=lambda name: loads[name].peak(lines=found.lines, threads=1, fixed=fixed))
        mend = "fewer threads a worker, " if least_threads > 1 else ""
        msg = (
            f"/{worst} needs {_text(found.needed)} of memory with {_counted(found.threads, 'thread')} and "
            f"{found.lines} lines a task, the fewest possible, but {_text(limit)} may be taken; "
            f"{mend}end other programs, raise the memory limit, or take a larger machine"
        )
        raise StoreError(msg)
    return found


# --- what there is -----------------------------------------------------------------------------------------


def parse_size(size: str | int) -> int:
    """Return a size such as ``"2 GiB"`` in bytes.

    Raises
    ------
    SchemaError
        It is no positive size.

    Examples
    --------
    >>> parse_size("2 GiB"), parse_size("500 MB"), parse_size(4096)
    (2147483648, 500000000, 4096)
    """
    from dask.utils import parse_bytes

    try:
        # without a number dask would take one
        found = int(parse_bytes(size)) if any(map(str.isdigit, str(size))) else 0
    except (ValueError, OverflowError, TypeError, AttributeError):
        found = 0
    if found <= 0:
        msg = f"{size!r} is no size of memory; expected bytes, or text such as '2 GiB' or '500 MB'"
        raise SchemaError(msg)
    return found


def available_memory(system: Path = Path("/")) -> int | None:
    """Return the memory that can still be taken [byte], of the machine or its container; None if unknown.

    Parameters
    ----------
    system
        Where ``proc`` and ``sys`` are.
    """
    found = [_machine_memory(system), *_container_memory(system)]
    known = [each for each in found if each is not None]
    return max(0, min(known)) if known else None


def _machine_memory(system: Path) -> int | None:
    # free pages alone would leave out the cache of files, which gives way
    for line in _read(system / "proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _container_memory(system: Path) -> Iterable[int]:
    """Yield what the control groups of this process (version 2 or 1), and those above them, leave."""
    root = system / "sys/fs/cgroup"
    for entry in _read(system / "proc/self/cgroup").splitlines():
        number, _, rest = entry.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0":
            base, limit, used = root, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            base, limit, used = root / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        inside = [part for part in path.split("/") if part not in ("", "..")]
        for depth in range(len(inside) + 1):
            folder = base.joinpath(*inside[:depth])
            most, taken = _read(folder / limit).strip(), _read(folder / used).strip()
            if most.isdigit() and taken.isdigit():
                yield int(most) - int(taken) + _reclaimable(folder)


def _reclaimable(group: Path) -> int:
    for line in _read(group / "memory.stat").splitlines():
        name, _, value = line.partition(" ")
        if name in ("inactive_file", "total_inactive_file") and value.isdigit():
            return int(value)
    return 0


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""


def resident_memory() -> int:
    """Return the memory this process holds now [byte]; 200 MB where the system does not say."""
    pages = _read(Path("/proc/self/statm")).split()
    return int(pages[1]) * os.sysconf("SC_PAGE_SIZE") if len(pages) > 1 else 200 * 10**6


# --- disk --------------------------------------------------------------------------------------------------


def disk_needed(dataset: xr.Dataset) -> int:
    """Return the bytes a group takes on disk at the most, margin included.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = (("along_track", "band", "cross_track"), np.zeros((640, 272, 640), "uint16"))
    >>> disk_needed(xr.Dataset({"counts": cube})) // 10**6
    138
    """
    needed = 0.0
    for name, variable in dataset.variables.items():
        if name == "counts" and variable.dtype.itemsize == 2:
            share = STORED_SHARE["counts"]
        else:
            share = STORED_SHARE["rounded"] if "keep_bits" in variable.attrs else 1.0
        needed += share * variable.nbytes
    return int(MARGIN * needed) + 4 * 10**6


def check_disk(store: Path, needed: int) -> None:
    """Refuse a store for which its disk has no room.

    Parameters
    ----------
    store
        Where it will be; neither it nor the folders above need be there yet.
    needed
        Bytes to be written; those an interrupted run left beside the store are taken off.

    Raises
    ------
    StoreError
        There is less room; the figures are given.
    """
    store = store.absolute()
    above = next((folder for folder in store.parents if folder.exists()), None)
    if above is None:
        return
    free = shutil.disk_usage(above).free
    begun = store.with_name(f".partial-{store.name}")
    left = needed - sum(_size(path) for path in begun.rglob("*")) if begun.is_dir() else needed
    if left > free:
        msg = (
            f"cannot write {store}: {_text(left)} of disk are needed, {_text(free)} are free; make room, "
            "choose another disk, or leave reflectance to be computed from counts (reflectance='none')"
        )
        raise StoreError(msg)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size if path.is_file() else 0
    except OSError:  # another run clears it up
        return 0


def _text(size: int) -> str:
    """Return a size for reading: MiB below one GiB.

    Examples
    --------
    >>> _text(3 * 2**30), _text(5 * 2**20)
    ('3.00 GiB', '5 MiB')
    """
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{math.ceil(size / 2**20)} MiB"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
