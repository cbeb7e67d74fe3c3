"""The inputs of a collect judged together, before they are processed."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from hyperpaint.base.errors import CollectError, PaintWarning, Problems

if TYPE_CHECKING:
    from hyperpaint.io.collect.collect_opening import OpenedCollect
    from hyperpaint.plausibility import Finding

__all__ = ["check_accepted", "check_collect", "refuse_findings"]


def check_collect(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Return all that can hardly be true of the inputs of a collect; samples of its cubes are read.

    Raises `CollectError`: the file, or anything it names, cannot be opened; all problems are listed.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> path = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6)
    >>> check_collect(path)
    ()
    """
    from hyperpaint.io.collect.collect_toml import read_collect

    from .laboratory import opened_collect

    lit = read_collect(path, need_irradiance=False).irradiance is not None
    opened = opened_collect(path, need_irradiance=lit)
    return _findings(opened, opened.members)


def refuse_findings(opened: OpenedCollect, lines: Iterable[str], accept: Collection[str]) -> None:
    """Judge lines of an opened collect, by the names of their groups, but for what is accepted.

    Raises `CollectError`: Findings that make results wrong; all are listed. Warns `PaintWarning`: The others.
    """
    refused = []
    for finding in _findings(opened, [name for name in lines if name in opened.members]):
        if finding.kind.name in accept:
            continue
        if finding.kind.refused:
            refused.append(finding.problem(acceptable=True))
        else:
            warnings.warn(str(finding), PaintWarning, stacklevel=3)
    if refused:
        raise CollectError(f"{opened.settings.path} cannot be true, and is not processed", problems=refused)


def check_accepted(accept: Collection[str], problems: Problems) -> None:
    """Note names that are those of no finding."""
    from hyperpaint.plausibility import KINDS

    for name in accept:
        if name not in KINDS:
            problems.add(f"accept={name!r}, expected some of {', '.join(KINDS)}")


def _findings(opened: OpenedCollect, lines: Iterable[str]) -> tuple[Finding, ...]:
    from hyperpaint.plausibility import judge_line

    cubes = {str(entry.name): entry for entry in opened.settings.flightlines}
    return tuple(
        finding
        for name in lines
        for finding in judge_line(
            opened.tree[name].to_dataset(), tuple(cubes[member] for member in opened.members[name])
        )
    )
