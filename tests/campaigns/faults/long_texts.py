"""Long texts of nothing: what every reader of texts takes of time and memory for them.

Each text is read by a process of its own. A reader may refuse it, with its own error. It is wrong to take
more than 256 MB beside what is imported, or 2 s for 10 MB, or time that grows faster than size ** 1.2.
"""

import contextlib
import gc
import math
import multiprocessing
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import parsers
from .outcome import MOST_BYTES, Outcome, begin_peak, resident

SIZES = (12 * 10**6, 24 * 10**6, 48 * 10**6, 100 * 10**6)
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
BINARY = ("asd", "sbet", "geotiff", "mesh-ply", "mesh-glb", "rgl")


def text_of(piece: str, seed: bytes, size: int) -> bytes:
    # Return a text of ``size`` bytes: of one piece, or a whole file whose last lines come again
    if piece != "beginning":
        return (PIECES[piece] * (size // len(PIECES[piece]) + 1))[:size]
    last = b"".join(seed.splitlines(keepends=True)[-2:])
    return (seed + last * (max(size - len(seed), 0) // max(len(last), 1)))[:size]


def measure(name: str, path: Path, results: Any) -> None:
    # Send seconds, the growth of memory and how it ended; what is imported is in memory already
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
    # Return what a process of its own measures; it is stopped after a time
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


def judge(name: str, piece: str, sizes: Sequence[int], folder: Path, seeds: Path) -> list[str]:
    # Return what is wrong with how a reader takes longer and longer texts of one kind
    (warm, seed), *_ = parsers.placed(parsers.PARSERS[name], seeds, folder)
    path = warm.with_name(f"{'long' if piece != 'beginning' else 'more'}-{warm.name}")
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
    # slope of time against size, both as logarithms; none where it takes no time to speak of
    slope = 0.0
    if seconds[-1] >= SHORTEST and seconds[0] > 0.0 and len(sizes) > 1:
        least = [max(each, SHORTEST / 5) for each in seconds]
        slope = math.log(least[-1] / least[0]) / math.log(sizes[-1] / sizes[0])
    wrong = [str(result["ending"]) for result in results if str(result["ending"]).startswith("WRONG")]
    slow = any(took > max(size * MOST_SECONDS_A_BYTE, 1.0) for took, size in zip(seconds, sizes, strict=True))
    for is_wrong, text in (
        (most > MOST_BYTES, f"{most / 2**20:.0f} MB"),
        (slow, f"{max(seconds):.1f} s"),
        (slope > MOST_SLOPE, f"slope {slope:.2f}"),
    ):
        wrong += [text] if is_wrong else []
    return [f"{name}, {piece}: {text}" for text in wrong]


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every reader and kind of text; none is left for ``first`` above 0
    sizes = [max(10**6, round(size * scale)) for size in SIZES]
    names = [name for name in parsers.PARSERS if name not in BINARY and not first]
    with tempfile.TemporaryDirectory() as scratch:
        parsers.prepare(Path(scratch) / "seeds")
        for name in names:
            for piece in PIECES:
                folder = Path(scratch) / f"{name}-{piece}"
                folder.mkdir()
                yield Outcome(
                    f"long texts: {name}", 1, judge(name, piece, sizes, folder, Path(scratch) / "seeds")
                )
