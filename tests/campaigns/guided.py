"""Inputs that coverage guides (atheris): what reaches new code of a parser is kept, and mutated further.

    python tests/campaigns/guided.py --seconds 7200               two hours, shared by all parsers
    python tests/campaigns/guided.py --only svc,collect-toml --seconds 600
    python tests/campaigns/guided.py --only svc --seconds 600 --keep      what is new goes into the corpus

A target is a parser of `faults.parsers` and one kind of its seeds. It starts from these seeds and from
``corpus/<parser>.zip``, may refuse an input with its own errors only, and has a second and 256 MB for it,
measured again without the instruments. What breaks that is kept in the folder ``--wrong``, one file a place
in the code; once mended it belongs into ``regressions/<parser>/``, under a name that says what it was.
`test_corpus.py` reads both. Needs the extra ``fuzz``. Exits with 1 where an input was wrong.
"""

import argparse
import contextlib
import hashlib
import io
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

HERE = Path(__file__).resolve().parent
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(HERE.parent))

from campaigns.faults import parsers  # noqa: E402

CORPUS, REGRESSIONS = HERE / "corpus", HERE / "regressions"
#: Kernels are compiled from their bytecode, which instruments would change.
_COMPILED = ["hyperpaint.kernels", "hyperpaint.base.jit", "hyperpaint.simulation.transport"]
_LARGEST_INPUT = 64 * 2**10
#: What the corpus of one target may hold [byte], and the longest input in it.
_CORPUS_BYTES, _LARGEST_KEPT = 200 * 2**10, 16 * 2**10
#: An input that takes longer than this with the instruments is timed again without them [s].
_SUSPECT_S = 0.5


@dataclass(frozen=True)
class Target:
    # A parser, and the number of the seed whose place inputs take
    parser: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.parser}:{self.seed}"

    @classmethod
    def of(cls, name: str) -> "Target":
        parser, _, seed = name.rpartition(":")
        return cls(parser, int(seed))


def targets(names: Iterable[str], folder: Path) -> list[Target]:
    # Return a target for every kind of file that a parser reads, told apart by its suffix
    first: dict[tuple[str, str], Target] = {}
    for name in names:
        for number, path in enumerate(parsers.PARSERS[name].files(folder)):
            first.setdefault((name, path.suffix), Target(name, number))
    return list(first.values())


# --- the corpus --------------------------------------------------------------------------------------------


def corpus(target: Target) -> list[bytes]:
    # Return the inputs that are kept of a target
    archive = CORPUS / f"{target.parser}.zip"
    if not archive.is_file():
        return []
    with zipfile.ZipFile(archive) as file:
        return [file.read(name) for name in file.namelist() if name.startswith(f"{target.seed}/")]


def keep(target: Target, inputs: Sequence[bytes]) -> int:
    # Make these inputs the corpus of a target; return how many were not in it before
    archive, before = CORPUS / f"{target.parser}.zip", set(corpus(target))
    others: dict[str, bytes] = {}
    if archive.is_file():
        with zipfile.ZipFile(archive) as file:
            names = [name for name in file.namelist() if not name.startswith(f"{target.seed}/")]
            others = {name: file.read(name) for name in names}
    own = {f"{target.seed}/{hashlib.sha256(data).hexdigest()[:16]}": data for data in inputs}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        for name, data in sorted((others | own).items()):  # dates are none: the same inputs, the same bytes
            file.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED, 9)
    CORPUS.mkdir(exist_ok=True)
    archive.write_bytes(packed.getvalue())
    return len(set(inputs) - before)


def covering(read: Any, inputs: Iterable[bytes]) -> list[bytes]:
    # Return the inputs, short ones first, each of which reaches a step that none before it does
    reached: set[tuple[str, int, int]] = set()
    kept: list[bytes] = []
    room = _CORPUS_BYTES
    for data in sorted(set(inputs), key=lambda data: (len(data), data)):
        steps = _steps(read, data)
        if not steps <= reached and len(data) <= min(room, _LARGEST_KEPT):
            reached |= steps
            kept.append(data)
            room -= len(data)
    return kept


def _steps(read: Any, data: bytes) -> set[tuple[str, int, int]]:
    # Return the pairs of lines of hyperpaint that follow one another while an input is read
    steps: set[tuple[str, int, int]] = set()

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        name = frame.f_code.co_filename
        if "hyperpaint" not in name:
            return None
        last = frame.f_lineno

        def line(frame: FrameType, event: str, _: Any) -> Any:
            nonlocal last
            if event == "line":
                steps.add((name, last, frame.f_lineno))
                last = frame.f_lineno
            return line

        return line

    sys.settrace(trace)
    try:
        read(data)
    finally:
        sys.settrace(None)
    return steps


# --- one target, in a process of its own -------------------------------------------------------------------


@dataclass(frozen=True)
class Bench:
    # Where a child process works: whole seeds, the folder of its units, and that of wrong inputs
    seeds: Path
    units: Path
    wrong: Path


class Reading:
    # Puts an input in its place and reads it; what is wrong is written down, once a place in the code
    def __init__(self, target: Target, path: Path, wrong: Path) -> None:
        self.target, self.path, self.wrong = target, path, wrong
        self.parser = parsers.PARSERS[target.parser]
        self.seen: set[str] = set()

    def __call__(self, data: bytes) -> None:
        self.path.write_bytes(data)
        begun = time.process_time()
        try:
            self.parser.read(self.path)
        except self.parser.errors:
            pass
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            self._write(f"{type(error).__name__} {last.filename}:{last.lineno}", data)
        if time.process_time() - begun > _SUSPECT_S:
            self._write("slow", data)

    def _write(self, place: str, data: bytes) -> None:
        if place not in self.seen:
            self.seen.add(place)
            (self.wrong / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)


def fuzz(target: Target, bench: Bench, seconds: int) -> None:
    # Let atheris look for inputs; it ends the process
    import atheris

    _quiet()
    own = Path(tempfile.mkdtemp(dir=bench.units.parent))
    parser = parsers.PARSERS[target.parser]
    placed = parsers.placed(parser, bench.seeds, own)
    path, seed = placed[target.seed]
    with atheris.instrument_imports(include=["hyperpaint"], exclude=_COMPILED):
        for other, _ in placed:  # imports what reading takes
            with contextlib.suppress(*parser.errors):  # a seed may be of a kind that is refused
                parser.read(other)
    alike = [data for other, data in placed if other.suffix == path.suffix and len(data) <= _LARGEST_INPUT]
    for data in (*alike, *corpus(target)):
        (bench.units / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
    longest = min(_LARGEST_INPUT, max(4096, 2 * len(seed)))
    words = bench.units.parent / "words"
    words.write_text(dictionary(alike))
    for hook in ("RegEx", "str"):
        atheris.enabled_hooks.add(hook)
    options = [
        *([f"-dict={words}"] if words.stat().st_size else []),  # of binary files there are no words
        f"-max_total_time={seconds}", f"-max_len={longest}", "-timeout=20",
        "-rss_limit_mb=2048", "-print_final_stats=1", f"-artifact_prefix={bench.wrong}/", str(bench.units),
    ]  # fmt: skip
    atheris.Setup(["guided", *options], Reading(target, path, bench.wrong))
    atheris.Fuzz()


def dictionary(seeds: Iterable[bytes]) -> str:
    # Return the words of whole files, as libFuzzer reads them: what a mutation may put in one piece
    words = {word for seed in seeds for word in re.findall(rb"[A-Za-z_][A-Za-z0-9_-]{2,30}", seed[:20_000])}
    return "".join(f'"{word.decode()}"\n' for word in sorted(words)[:400])


def _quiet() -> None:
    from hyperpaint.base.errors import PaintWarning

    warnings.simplefilter("error")
    warnings.simplefilter("ignore", PaintWarning)


# --- all of them -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Result:
    # What a target came to: inputs tried, processor time [s], inputs kept, those new, and wrong ones
    target: Target
    runs: int
    seconds: float
    kept: int
    new: int
    wrong: list[str]

    def __str__(self) -> str:
        return (
            f"{self.target.name:<24} {self.runs:>10} {self.seconds:>8.0f} {self.kept:>6} {self.new:>6} "
            f"{len(self.wrong):>6}"
        )


HEADER = f"{'target':<24} {'inputs':>10} {'seconds':>8} {'corpus':>6} {'new':>6} {'wrong':>6}"


def run(target: Target, seeds: Path, seconds: int, wrong: Path, *, kept: bool) -> Result:
    # Fuzz one target in a child process; another judges, without instruments, what that calls wrong
    with tempfile.TemporaryDirectory() as scratch:
        bench = Bench(seeds, Path(scratch) / "units", wrong / f"{target.parser}-{target.seed}")
        bench.units.mkdir()
        bench.wrong.mkdir(parents=True, exist_ok=True)
        begun, runs = time.monotonic(), 0
        while (left := round(seconds - (time.monotonic() - begun))) > 0:
            child = _child("fuzz", target, bench, str(left))
            counts = [line for line in child.stderr.splitlines() if "number_of_executed_units" in line]
            runs += sum(int(line.split()[-1]) for line in counts)
            if child.returncode == 0:
                break
            if not counts and not any(bench.wrong.iterdir()):  # it never began
                raise RuntimeError(f"{target.name}: {child.stderr[-2000:]}")
        spent = time.monotonic() - begun
        child = _child("judge", target, bench, "keep" if kept else "count")
        if child.returncode:
            raise RuntimeError(f"{target.name}: {child.stderr[-2000:]}")
        *lines, counted = child.stdout.splitlines()
        held, new = map(int, counted.split())
        return Result(target, runs, spent, held, new, lines)


def _child(task: str, target: Target, bench: Bench, detail: str) -> subprocess.CompletedProcess[str]:
    places = map(str, (bench.seeds, bench.units, bench.wrong))
    call = [sys.executable, __file__, "--child", task, target.name, *places, detail]
    return subprocess.run(call, capture_output=True, text=True, errors="replace", check=False)


def judge(target: Target, bench: Bench, *, kept: bool) -> None:
    # Print a line for every input that is wrong, measured as `faults.parsers` does; then what is kept
    _quiet()
    parser = parsers.PARSERS[target.parser]
    with tempfile.TemporaryDirectory() as own:
        path, _ = parsers.placed(parser, bench.seeds, Path(own))[target.seed]
        for data in sorted(bench.wrong.iterdir()):
            path.write_bytes(data.read_bytes())
            wrong = parsers.complaint(parser, path)
            if wrong:
                print(f"{target.name} {data.name}: {wrong!r:.200}")
            else:
                data.unlink()
        units = [unit.read_bytes() for unit in bench.units.iterdir()]
        inputs = covering(Reading(target, path, bench.wrong), units)
    new = keep(target, inputs) if kept else len(set(inputs) - set(corpus(target)))
    print(len(inputs), new)


def main(arguments: list[str] | None = None) -> int:
    # Run what the command line asks for, print the table, return the exit status
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", default=",".join(parsers.PARSERS), help="parsers, separated by commas")
    parser.add_argument("--seconds", type=int, default=7200, help="of fuzzing, shared by all targets")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--keep", action="store_true", help="write what reaches new code into the corpus")
    parser.add_argument("--wrong", type=Path, default=Path("wrong_inputs"), help="folder for wrong inputs")
    asked = parser.parse_args(arguments)
    names = list(dict.fromkeys(asked.only.split(",")))
    if unknown := sorted(set(names) - set(parsers.PARSERS)):
        parser.error(f"no parser {', '.join(unknown)}; there are {', '.join(parsers.PARSERS)}")
    print(HEADER, flush=True)
    results: list[Result] = []
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(asked.processes) as pool:
        seeds = Path(scratch)
        parsers.prepare(seeds)
        wanted = targets(names, seeds)
        each = max(1, asked.seconds // len(wanted))
        wrong = asked.wrong.absolute()
        # of one parser one after another: they share an archive
        rows = pool.map(
            lambda name: [
                run(target, seeds, each, wrong, kept=asked.keep) for target in wanted if target.parser == name
            ],
            names,
        )
        for result in (result for row in rows for result in row):
            results.append(result)
            print("\n    ".join([str(result), *result.wrong]), flush=True)
    print(
        f"{sum(result.runs for result in results)} inputs, {sum(result.seconds for result in results):.0f} s"
    )
    return int(any(result.wrong for result in results))


def child(task: str, name: str, *details: str) -> None:
    # Do what `run` gives to a process of its own
    *places, detail = details
    target, bench = Target.of(name), Bench(*map(Path, places))
    if task == "fuzz":
        fuzz(target, bench, int(detail))
    else:
        judge(target, bench, kept=detail == "keep")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(*sys.argv[2:])
    else:
        sys.exit(main())
