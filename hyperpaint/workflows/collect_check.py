"""Checks of a collect before it is processed: implausible inputs are listed, refused or warned of."""

import itertools
import os
import warnings
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import xarray as xr

from hyperpaint.base import CollectError, PaintWarning, warn_user
from hyperpaint.geometry.navigation_checking import navigation_findings
from hyperpaint.io.collect.collect_toml import OpenedCollect, read_collect
from hyperpaint.io.spectrometers.record_faults import RECORD
from hyperpaint.plausibility import KINDS, Finding, judge_dark_cube, judge_line
from hyperpaint.radiometry.counts_to_reflectance import panel_closure
from hyperpaint.radiometry.panels import RULES, declared_panels
from hyperpaint.radiometry.planning import has_white

from .collects import opened_collect


def check_collect(path: str | os.PathLike[str], *, passed: bool = False) -> tuple[Finding, ...]:
    """Return findings of implausible inputs of a collect, from samples of its cubes and all records.

    Reflectance of the samples is judged as well, by level, colour and pattern. Conventions of the navigation
    and clocks are tested on the picture of one line. ``passed`` adds the judgements of the product that
    passed, with their values.

    Raises `CollectError` if the collect or one of its files cannot be opened; all problems are listed.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> path = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6)
    >>> check_collect(path)
    ()
    """
    needs_irradiance = read_collect(path, need_irradiance=False).irradiance is not None
    texts: tuple[str, ...] = ()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            opened = opened_collect(path, need_irradiance=needs_irradiance)
        findings = list(itertools.chain(*_findings(opened, opened.members, lit=needs_irradiance).values()))
        texts = tuple(finding.found for finding in findings if finding.line == RECORD)
    finally:
        # a fault of the record is a finding where a line uses it, and a warning otherwise
        for each in caught:
            if not any(text in str(each.message) for text in texts):
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    lines = {name: opened.tree[name].to_dataset() for name in opened.members}
    for line, found in navigation_findings(lines):
        kind = KINDS["navigation-clock" if "clock" in found.field else "navigation-convention"]
        text = f"{found.field} {found.declared}: {found.evidence}"
        findings.append(Finding(kind, str(lines[line].attrs["name"]), text, found.likely))
    if needs_irradiance:
        findings += itertools.chain(*(_panel_findings(line) for line in lines.values()))
    return tuple(finding for finding in findings if passed or not finding.passes)


def _panel_findings(line: xr.Dataset) -> Iterator[Finding]:
    # Measure the panels that a line declares; processing refuses or warns of the same.
    name = str(line.attrs["name"])
    for panel in declared_panels(line) if "wavelength" in line.coords else ():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PaintWarning)
            closure = panel_closure(line, panel).compute()
        factor = float(closure["panel_factor"].median())
        texts = [
            str(each.message) for each in caught if getattr(each.message, "code", "") == "panel-doubtful"
        ]
        is_other = max(factor, 1.0 / factor) > RULES.most_factor
        is_other &= line.attrs.get("absolute_scale") != "unknown"
        kind = KINDS["panel-level" if is_other else "panel-doubtful"]
        found = texts[0].rpartition(" [")[0] if texts else f"a panel measures {factor:.3f} of its certificate"
        yield Finding(kind, name, found, "1 within its uncertainty", passes=not texts)


def refuse_findings(
    opened: OpenedCollect, lines: Iterable[str], accept: Collection[str], *, lit: bool
) -> dict[str, dict[str, Any]]:
    # Check flight lines of an opened collect, named by their groups; return what was accepted and passed.
    #
    # ``accept``: names of accepted findings. ``lit``: whether reflectance is computed, which needs
    # irradiance.
    #
    # Returns by group the attributes for the store: accepted findings of a line, and judgements that it
    # passed. Raises `CollectError`
    # for findings that would make results wrong; all are listed. Warns (`PaintWarning`) of other findings.
    refused = []
    accepted: dict[str, dict[str, Any]] = {}
    for group, findings in _findings(
        opened, [name for name in lines if name in opened.members], lit=lit
    ).items():
        for finding in findings:
            if finding.passes:
                accepted.setdefault(group, {}).setdefault("passed_checks", []).append(
                    f"{finding.found}; expected {finding.expected}"
                )
            elif finding.kind.name in accept:
                accepted.setdefault(group, {}).setdefault("accepted_findings", []).append(str(finding))
            elif finding.kind.refused:
                refused.append(finding.problem(acceptable=True))
            elif finding.line != RECORD:  # whose faults were told when it was opened
                warn_user(str(replace(finding.problem(), code="")), finding.kind.name)
    if refused:
        raise CollectError(
            f"{opened.settings.path} is implausible, and is not processed",
            problems=refused,
        )
    return accepted


def _findings(opened: OpenedCollect, lines: Iterable[str], *, lit: bool) -> dict[str, list[Finding]]:
    # findings on a dark cube or the record are listed with the first line that uses it
    cubes = {str(entry.name): entry for entry in opened.settings.flightlines}
    findings: dict[str, list[Finding]] = {}
    darks: set[Path] = set()
    listed: set[str] = set()
    for name in lines:
        members = tuple(cubes[member] for member in opened.members[name])
        line = opened.tree[name].to_dataset()
        judged = judge_line(line, members, lit=lit and not has_white(line))
        findings[name] = [each for each in judged if each.line != RECORD or each.found not in listed]
        listed |= {each.found for each in findings[name]}
        dark = members[0].dark if "counts" in opened.tree[name] else None
        for path in dark if isinstance(dark, tuple) else ():
            if path not in darks:
                findings[name] += judge_dark_cube(path)
                darks.add(path)
    return findings
