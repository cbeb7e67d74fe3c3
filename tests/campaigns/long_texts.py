"""Long texts of nothing: what every reader of texts takes of time and memory for them.

    python tests/campaigns/long_texts.py                   all readers, 12, 24, 48 and 100 MB
    python tests/campaigns/long_texts.py --megabytes 3,6 --only svc,regions

Each text is read by a process of its own. A reader may refuse it, with its own error. Exits with 1 where one
takes more than 256 MB beside what it imports, or 2 s for 10 MB, or time grows faster than size ** 1.2.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
import multiprocessing
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(ROOT))

from campaigns.faults import parsers  # noqa: E402
from campaigns.faults.outcome import MOST_BYTES, begin_peak, resident  # noqa: E402

MOST_SECONDS_A_BYTE = 2.0 / 10e6
MOST_SLOPE = 1.2
#: Seconds below which a time is that of the clock and the disk, and no slope is taken of it.
SHORTEST = 0.05

#: What a text is made of, again and again; "beginning" goes on as the reader's own file ends.
PIECES: Mapping[str, bytes] = {
    "short lines": b"1 1\n", "one line": b"1 ", "brackets": b"[{(", "blanks": b" ", "empty lines": b"\n",
    "beginning": b"",
}  # fmt: skip
#: Files that are no text, or too slow to begin with: their readers bound them by other means.
BINARY = ("asd", "sbet", "geotiff", "mesh-ply", "mesh-glb")


def text_of(piece: str, seed: bytes, size: int) -> bytes:
    """Return a text of ``size`` bytes: of one piece, or a whole file whose last lines come again."""
    if piece != "beginning":
        return (PIECES[piece] * (size // len(PIECES[piece]) + 1))[:size]
    lines = seed.splitlines(keepends=True)[-2:]
    last = b"".join(lines)
    return (seed + last * (max(size - len(seed), 0) // max(len(last), 1)))[:size]


def measure(name: str, path: Path, results: Any) -> None:
    """Send seconds, the growth of memory and how it ended; what is imported is in memory already."""
    warnings.simplefilter("ignore")
    gc.freeze()  # objects of the process that was forked are not the reader's to walk through, and to copy
    before = begin_peak()
    begun, ending = time.process_time(), "read"
    try:
        parsers.PARSERS[name].read(path)
    except parsers.PARSERS[name].errors as error:
        ending = f"refused: {str(error).replace(str(path), '')[:60]}"
    except BaseException as error:
        ending = f"WRONG: {type(error).__name__}: {str(error)[:60]}"
    seconds = time.process_time() - begun
    results.send({"seconds": seconds, "bytes": resident("VmHWM") - before, "ending": ending})


def measured(name: str, path: Path, limit_s: float) -> dict[str, Any]:
    """Return what a process of its own measures; it is stopped after a time."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=measure, args=(name, path, sender))
    process.start()
    sender.close()
    answer: dict[str, Any] = {"seconds": limit_s, "bytes": 0, "ending": "WRONG: it was stopped"}
    if receiver.poll(limit_s):
        with contextlib.suppress(EOFError):
            answer = receiver.recv()
    process.kill()
    process.join()
    return answer


def slope_of(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Return the slope of time against size, both as logarithms; 0 where it takes no time to speak of."""
    if seconds[-1] < SHORTEST or seconds[0] <= 0.0 or len(sizes) < 2:
        return 0.0
    least = [max(each, SHORTEST / 5) for each in seconds]
    return math.log(least[-1] / least[0]) / math.log(sizes[-1] / sizes[0])


def judge(name: str, piece: str, sizes: Sequence[int], folder: Path, seeds: Path) -> tuple[str, list[str]]:
    """Return a row of the table, and what is wrong with a reader."""
    (warm, seed), *_ = parsers.placed(parsers.PARSERS[name], seeds, folder)
    path = (
        warm.with_name(f"long-{warm.name}") if piece != "beginning" else warm.with_name(f"more-{warm.name}")
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parsers.PARSERS[name].read(warm)  # what it imports is no part of what is measured
    results = []
    for size in sizes:
        path.write_bytes(text_of(piece, seed, size))
        results.append(measured(name, path, 20.0 + 2.0 * size * MOST_SECONDS_A_BYTE))
    path.unlink()
    seconds = [float(result["seconds"]) for result in results]
    most = max(float(result["bytes"]) for result in results)
    slope, ending = slope_of(sizes, seconds), str(results[-1]["ending"])
    wrong = [str(result["ending"]) for result in results if str(result["ending"]).startswith("WRONG")]
    if most > MOST_BYTES:
        wrong.append(f"{most / 2**20:.0f} MB")
    if any(took > max(size * MOST_SECONDS_A_BYTE, 1.0) for took, size in zip(seconds, sizes, strict=True)):
        wrong.append(f"{max(seconds):.1f} s")
    if slope > MOST_SLOPE:
        wrong.append(f"slope {slope:.2f}")
    row = f"{name:<18} {piece:<12} {seconds[-1]:>7.2f} {most / 2**20:>7.0f} {slope:>6.2f}  {ending}"
    return row, [f"{name}, {piece}: {text}" for text in wrong]


def main(arguments: list[str] | None = None) -> int:
    """Print the table of all readers; 1 where one takes more than it may."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    given.add_argument("--megabytes", default="12,24,48,100", help="sizes, separated by commas")
    given.add_argument("--only", default="", help="readers, separated by commas")
    given.add_argument("--pieces", default=",".join(PIECES), help="kinds of text, separated by commas")
    asked = given.parse_args(arguments)
    names = [name for name in parsers.PARSERS if name not in BINARY]
    names = asked.only.split(",") if asked.only else names
    sizes = [int(float(text) * 1e6) for text in asked.megabytes.split(",")]
    print(f"{'reader':<18} {'text':<12} {'s':>7} {'MB':>7} {'slope':>6}  of the largest", flush=True)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        parsers.prepare(Path(scratch) / "seeds")
        for name in names:
            for number, piece in enumerate(asked.pieces.split(",")):
                folder = Path(scratch) / f"{name}-{number}"
                folder.mkdir()
                row, problems = judge(name, piece, sizes, folder, Path(scratch) / "seeds")
                print(row, flush=True)
                wrong += problems
    print("\n".join(wrong) or "all within limits")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
