"""Checks of the inputs of a collect before processing."""

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
from hyperpaint.geometry.navigation_checking import navigation_findings
from hyperpaint.plausibility import KINDS, Finding, judge_dark_cube, judge_line

if TYPE_CHECKING:
    from hyperpaint.io.collect.collect_opening import OpenedCollect

#: Share of flagged pixels of a line from which `process` warns [1].
MANY_FLAGGED = 0.2

_LINES_A_READ = 4096


def check_collect(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Return findings of implausible inputs of a collect, from samples of its cubes and all records.

    Conventions of the navigation and clocks are tested on the picture of one line.

    Raises `CollectError` if the collect or one of its files cannot be opened; all problems are listed.

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

    needs_irradiance = read_collect(path, need_irradiance=False).irradiance is not None
    opened = opened_collect(path, need_irradiance=needs_irradiance)
    findings = list(itertools.chain(*_findings(opened, opened.members, lit=needs_irradiance).values()))
    lines = {name: opened.tree[name].to_dataset() for name in opened.members}
    for line, found in navigation_findings(lines):
        kind = KINDS["navigation-clock" if "clock" in found.field else "navigation-convention"]
        text = f"{found.field} {found.declared}: {found.evidence}"
        findings.append(Finding(kind, str(lines[line].attrs["name"]), text, found.likely))
    return tuple(findings)


def refuse_findings(
    opened: OpenedCollect, lines: Iterable[str], accept: Collection[str], *, lit: bool
) -> dict[str, dict[str, Any]]:
    """Check flight lines of an opened collect, named by their groups; return the accepted findings.

    ``accept``: names of accepted findings. ``lit``: whether reflectance is computed, which needs irradiance.

    Returns by group the attributes for the store: the accepted findings of a line. Raises `CollectError` for
    findings that would make results wrong; all are listed. Warns (`PaintWarning`) of other findings.
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
    """Add names in ``accept`` that are no kinds of finding to ``problems``."""
    for name in [accept] if isinstance(accept, str) else accept:
        if name not in KINDS or isinstance(accept, str):
            expected = f"a list of some of {', '.join(KINDS)}"
            problems.add(f"accept={name!r}", expected=expected, code="choice-unknown")


def _findings(opened: OpenedCollect, lines: Iterable[str], *, lit: bool) -> dict[str, list[Finding]]:
    # findings on a dark cube are listed with the first line that uses it
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
    """Warn of flags that more than `MANY_FLAGGED` of the pixels of a stored line have."""
    import zarr

    for name in lines:
        if not (store / name / "quality").exists():
            continue
        quality = zarr.open_array(store / name / "quality", mode="r", zarr_format=3)
        counts: Counter[str] = Counter()
        for start in range(0, quality.shape[0], _LINES_A_READ):
            values = np.asarray(quality[start : start + _LINES_A_READ])
            counts.update(
                {str(flag.name): share * values.size for flag, share in flag_shares(values).items()}
            )
        shares = {flag: count / quality.size for flag, count in counts.items()}
        texts = [
            f"{100 * share:.0f} % {flag.lower()}" for flag, share in shares.items() if share > MANY_FLAGGED
        ]
        if texts:
            message = (
                f"{name}: many pixels are flagged: {', '.join(texts)}; check these flags before using values"
            )
            warnings.warn(PaintWarning(message, code="pixels-flagged"), stacklevel=3)
