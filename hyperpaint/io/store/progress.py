"""How far a computation is, and how long it will still take, in blocks that are done."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Collection, Iterator
from typing import Any

__all__ = ["BlockBar", "bar_over_blocks"]

_WIDTH = 40
_FEWEST = 0.02  # share that must be done before the rest is guessed


class BlockBar:
    """A bar on stdout, as dask draws it, with the time that is left.

    Parameters
    ----------
    total
        Blocks to do.
    """

    def __init__(self, total: int) -> None:
        self._total, self._done, self._shown = total, 0, 0
        self._begun = time.perf_counter()

    def advance(self, blocks: int = 1) -> None:
        """Count blocks that are done, and draw."""
        from dask.utils import format_time

        self._done += blocks
        elapsed = time.perf_counter() - self._begun
        share = self._done / max(self._total, 1)
        bar, percent = "#" * int(_WIDTH * share), int(100 * share)
        text = f"[{bar:<{_WIDTH}}] | {percent}% Completed | {format_time(elapsed)}"
        if _FEWEST <= share < 1.0:
            text += f", {format_time(elapsed / share - elapsed).strip()} left"
        # what a longer text has left would stay
        sys.stdout.write(("\r" + " " * self._shown if len(text) < self._shown else "") + "\r" + text)
        sys.stdout.flush()
        self._shown = len(text)


@contextlib.contextmanager
def bar_over_blocks(keys: Collection[Any]) -> Iterator[None]:
    """Draw a bar while dask computes these keys in this process; an error is told below the bar."""
    from dask.callbacks import Callback

    bar, wanted = BlockBar(len(keys)), set(keys)

    def count(key: Any, *_: Any) -> None:
        if key in wanted:
            bar.advance()

    bar.advance(0)
    try:
        with Callback(posttask=count):
            yield
    finally:
        sys.stdout.write("\n")
        sys.stdout.flush()
