"""Progress reports: for the parts of a task, and as a bar on stderr."""

import sys

from .schema import Progress

_BAR_CHARACTERS = 40


def part_of(progress: Progress | None, number: int, total: int) -> Progress | None:
    """Return the progress callback of part ``number`` of ``total``, in thousandths of a part; None for None.

    Examples
    --------
    >>> part_of(print, 1, 4)(5, 10)
    1500 4000
    """
    return (
        None
        if progress is None
        else (lambda done, steps: progress(1000 * number + 1000 * done // max(steps, 1), 1000 * total))
    )


def as_progress(progress: Progress | bool | None, label: str) -> Progress | None:
    # Return a bar on stderr for True, None for False, else ``progress`` itself.
    if progress is None or progress is False:
        return None
    if progress is not True:
        return progress

    def draw(done: int, total: int) -> None:
        filled = _BAR_CHARACTERS * done // max(total, 1)
        end = "\n" if done >= total else ""
        bar = "#" * filled + "-" * (_BAR_CHARACTERS - filled)
        sys.stderr.write(f"\r{label} [{bar}] {done}/{total} lines{end}")
        sys.stderr.flush()

    return draw
