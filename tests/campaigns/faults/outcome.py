"""What a campaign counts, and the table it is shown in."""

import collections
import contextlib
import multiprocessing
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

_Part = TypeVar("_Part")

#: In memory where that is a folder, so that hundreds of runs take minutes.
SCRATCH = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
MOST_SECONDS = 1.0
MOST_BYTES = 256 * 2**20

HEADER = f"{'campaign':<34} {'count':>9} {'wrong':>6} {'worst s':>8} {'worst MB':>8}  verdict"


@dataclass
class Outcome:
    # Result of a campaign, or of a part of one
    # campaign: Its row of the table
    # count: Faults tried
    # wrong: Faults that nothing reported, or that were reported in a wrong way: number and what happened
    # seconds, memory: Of the worst fault: processor time [s] and growth of the resident memory [byte]; None
    # where no limit is set
    # allowed: Wrong ones that the campaign may have
    # notes: What else was counted
    campaign: str
    count: int = 0
    wrong: list[str] = field(default_factory=list)
    seconds: float | None = None
    memory: int | None = None
    allowed: int = 0
    notes: collections.Counter[str] = field(default_factory=collections.Counter)

    @property
    def good(self) -> bool:
        within = (self.seconds or 0.0) <= MOST_SECONDS and (self.memory or 0) <= MOST_BYTES
        return self.count > 0 and within and len(self.wrong) <= self.allowed

    def __str__(self) -> str:
        seconds = "-" if self.seconds is None else f"{self.seconds:.3f}"
        memory = "-" if self.memory is None else f"{self.memory / 2**20:.1f}"
        notes = ", ".join(f"{number} {what}" for what, number in sorted(self.notes.items()))
        verdict = ("held" if self.good else "FAILED") + (f" ({notes})" if notes else "")
        return f"{self.campaign:<34} {self.count:>9} {len(self.wrong):>6} {seconds:>8} {memory:>8}  {verdict}"


def total(parts: Iterable[Outcome]) -> list[Outcome]:
    # Return one outcome a campaign, in the order in which the campaigns first appear
    sums: dict[str, Outcome] = {}
    for part in parts:
        known = sums.setdefault(part.campaign, Outcome(part.campaign, allowed=part.allowed))
        known.count += part.count
        known.wrong += part.wrong
        known.notes += part.notes
        for name in ("seconds", "memory"):
            values = [v for v in (getattr(known, name), getattr(part, name)) if v is not None]
            setattr(known, name, max(values, default=None))
    return list(sums.values())


def in_parallel(function: Callable[[_Part], list[Outcome]], parts: Sequence[_Part]) -> Iterator[Outcome]:
    # Yield the outcomes of all parts, worked on by two processes that share nothing
    ignore = (signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who counts
    with multiprocessing.get_context("spawn").Pool(2, initializer=signal.signal, initargs=ignore) as pool:
        for done, made in enumerate(pool.imap(function, parts), start=1):
            if sys.stderr.isatty():
                print(f"\r{done}/{len(parts)} parts ", end="", file=sys.stderr, flush=True)
            yield from made
        pool.close()
        pool.join()


def numbers_of(full: int, scale: float, first: int = 0, step: int = 1) -> range:
    # Return the numbers of faults: a fraction of the full count, at least one
    return range(first, first + max(1, round(full * scale)), step)


def parts_of(numbers: range, size: int) -> list[range]:
    # Return numbers as parts that one process works on
    return [numbers[start : start + size] for start in range(0, len(numbers), size)]


def each(title: str, numbers: range, run: Callable[..., None], *arguments: Any) -> Iterator[Outcome]:
    # Yield the outcome of each number: ``run`` takes it, an empty folder, the arguments, and the outcome
    for number in numbers:
        outcome = Outcome(title)
        with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
            run(number, Path(folder), *arguments, outcome)
        yield outcome


def resident(key: str) -> int:
    # Return ``VmRSS`` or its peak ``VmHWM`` [byte]; 0 where the system does not tell
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return 0
    return int(text.partition(f"{key}:")[2].split()[0]) * 1024


def begin_peak() -> int:
    # Let the peak of the resident memory begin anew; return the memory at its beginning
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return resident("VmRSS")
