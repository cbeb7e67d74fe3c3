"""The inputs of a collect judged together, before they are processed."""

from __future__ import annotations

import itertools
import os
import warnings
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import CollectError, PaintWarning, Problems
from hyperpaint.base.schema import flag_shares
from hyperpaint.plausibility import KINDS, Finding, judge_dark_cube, judge_line

if TYPE_CHECKING:
    from hyperpaint.io.collect.collect_opening import OpenedCollect

#: Share of flagged pixels of a line from which `process` warns [1].
MANY_FLAGGED = 0.2

_LINES_A_READ = 4096


def check_collect(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Return implausible findings on the inputs of a collect; samples of its cubes are read.

    Raises `CollectError`: the file, or a file it names, cannot be opened; all problems are listed.

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
    return tuple(itertools.chain(*_findings(opened, opened.members, lit=lit).values()))


def refuse_findings(
    opened: OpenedCollect, lines: Iterable[str], accept: Collection[str], *, lit: bool
) -> dict[str, dict[str, Any]]:
    """Check lines of an opened collect, by the names of their groups, for findings that are not accepted.

    ``lit``: whether reflectance is computed, so that the record of irradiance matters.

    Returns attributes by group for the store: the accepted findings of a line.

    Raises `CollectError`: Findings that make results wrong; all are listed. Warns `PaintWarning`: The others.
    """
    refused = []
    accepted: dict[str, dict[str, Any]] = {}
    groups = [name for name in lines if name in opened.members]
    for group, findings in _findings(opened, groups, lit=lit).items():
        for finding in findings:
            if finding.kind.name in accept:
                accepted.setdefault(group, {"accepted_findings": []})["accepted_findings"].append(
                    str(finding)
                )
            elif finding.kind.refused:
                refused.append(finding.problem(acceptable=True))
            else:
                warnings.warn(PaintWarning(str(finding), code=finding.kind.name), stacklevel=3)
    if refused:
        raise CollectError(
            f"{opened.settings.path} is implausible, and is not processed",
            problems=refused,
        )
    return accepted


def check_accepted(accept: Collection[str], problems: Problems) -> None:
    """Note names that no finding has."""
    for name in [accept] if isinstance(accept, str) else accept:
        if name not in KINDS or isinstance(accept, str):
            expected = f"a list of some of {', '.join(KINDS)}"
            problems.add(f"accept={name!r}", expected=expected, code="choice-unknown")


def _findings(opened: OpenedCollect, lines: Iterable[str], *, lit: bool) -> dict[str, list[Finding]]:
    # findings on a dark cube count for the first line with it

    cubes = {str(entry.name): entry for entry in opened.settings.flightlines}
    findings: dict[str, list[Finding]] = {}
    darks: set[Path] = set()
    for name in lines:
        members = tuple(cubes[member] for member in opened.members[name])
        findings[name] = list(judge_line(opened.tree[name].to_dataset(), members, lit=lit))
        dark = members[0].dark if "counts" in opened.tree[name] else None
        for path in dark if isinstance(dark, tuple) else ():
            if path not in darks:
                findings[name] += judge_dark_cube(path)
                darks.add(path)
    return findings


def warn_of_flags(store: Path, lines: Iterable[str]) -> None:
    """Warn of every flag that many pixels of a stored line have, with its share."""
    import zarr

    for name in lines:
        if not (store / name / "quality").exists():
            continue
        quality = zarr.open_array(store / name / "quality", mode="r", zarr_format=3)
        counts: Counter[str] = Counter()
        for start in range(0, quality.shape[0], _LINES_A_READ):
            part = np.asarray(quality[start : start + _LINES_A_READ])
            counts.update({str(flag.name): share * part.size for flag, share in flag_shares(part).items()})
        many = {flag: count / quality.size for flag, count in counts.items()}
        texts = [
            f"{100 * share:.0f} % {flag.lower()}" for flag, share in many.items() if share > MANY_FLAGGED
        ]
        if texts:
            message = f"{name}: many pixels are flagged: {', '.join(texts)}; look at them before their values"
            warnings.warn(PaintWarning(message, code="pixels-flagged"), stacklevel=3)
