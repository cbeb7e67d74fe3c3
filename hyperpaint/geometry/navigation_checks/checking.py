"""Test of a declared convention against the track and the picture of a flight line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.constants import STAMP_TO_MID_EXPOSURES
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.base.units import conversion_factor, takes_quantities
from hyperpaint.geometry.georeference import LOCATION_UNITS, PinholeCamera
from hyperpaint.geometry.georeference.poses import ANGLES

from .hypotheses import Hypothesis, Scored, fields_of, score
from .motion_fit import Refined, costs_of, fit_clock, fit_height
from .pose_motion import Setting, course_of, local_metres, setting_of

Verdict = Literal["right", "wrong", "undecided"]


@dataclass(frozen=True)
class Finding:
    """Result of a check of one declaration.

    Attributes
    ----------
    field
        Field of the `hyperpaint.Convention`; or ``"positions"``, ``"clock"``.
    declared
        What is declared.
    verdict
        ``"right"``, ``"wrong"``, or ``"undecided"``: neither the track nor the picture decides.
    likely
        What it looks like instead; empty where it is right.
    evidence
        Why, in figures.
    """

    field: str
    declared: str
    verdict: Verdict
    likely: str
    evidence: str


@dataclass(frozen=True)
class ConventionCheck:
    """Result of a check of a declared convention.

    Attributes
    ----------
    findings
        One for everything that is declared.
    suggested
        The convention declared, with what is wrong replaced where one alternative is left; it is not applied.
    lines
        First line looked at, and the one after the last.
    """

    findings: tuple[Finding, ...]
    suggested: Convention
    lines: tuple[int, int]

    @property
    def wrong(self) -> tuple[str, ...]:
        """Fields that look wrong."""
        return tuple(one.field for one in self.findings if one.verdict == "wrong")

    @property
    def undecided(self) -> tuple[str, ...]:
        """Fields that could not be decided."""
        return tuple(one.field for one in self.findings if one.verdict == "undecided")

    def __getitem__(self, field: str) -> Finding:
        """Return the finding on a field."""
        return next(one for one in self.findings if one.field == field)

    def table(self) -> str:
        """Return the findings as text."""
        rows = [("", "declared", "verdict", "looks like", "evidence")]
        rows += [(f.field, f.declared, f.verdict, f.likely, f.evidence) for f in self.findings]
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        return "\n".join(
            "  ".join([*(cell.ljust(n) for cell, n in zip(row, widths, strict=False)), row[4]]).rstrip()
            for row in rows
        )


@dataclass(frozen=True)
class Rules:
    """Thresholds for calling a convention right or wrong; set on simulated flights."""

    min_parts: int = 500  #: parts of rows that must be comparable
    #: Logarithm of the likelihood ratio beyond which a meaning is ruled out: 22,000 to 1.
    log_odds: float = 10.0
    #: Ratio of heights above ground from which one is called wrong; what leans on the ground biases the fit.
    height_ratio: float = 1.4
    clock_sd: float = 3.0  #: standard deviations from which a clock is off
    #: How far, and how finely, another clock is looked for where another meaning seems better.
    clock_search_s: float = 1.0
    clock_step_s: float = 0.02


RULES = Rules()


@takes_quantities(**LOCATION_UNITS)
@documented()
def check_conventions(
    line: xr.Dataset,
    navigation: xr.Dataset | None = None,
    *,
    convention: Convention | None = None,
    camera: PinholeCamera | xr.Dataset | None = None,
    ground: float | None = None,
    boresight: Sequence[float] = (0.0, 0.0, 0.0),
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
    image: xr.DataArray | None = None,
    lines: slice | None = None,
    crs: Any = None,
) -> ConventionCheck:
    """Test the declared convention of a navigation record against the track and the picture (eager).

    A platform that rolls shifts the rows of a picture sideways, and one that pitches makes them more or less
    alike; what positions and angles mean decides which shifts are to be expected. All combinations of signs,
    units, orders of rotation and of columns, and of latitude and longitude, are compared by how well they
    explain the picture. Nothing is changed: what looks wrong is named, and so is what cannot be decided.

    Parameters
    ----------
    line
        Flight line with ``time`` at mid exposure and a cube; its own poses where there is no ``navigation``.
    navigation
        See `hyperpaint.open_navigation`.
    convention
        What is declared; by default what the attributes say.
    camera, boresight, lever_arm
        See `hyperpaint.geometry.locate`; a boresight may be left out where it is about a degree or less: one
        of several degrees, not given, leaves everything undecided.
    ground
        Height of the ground above the ellipsoid, to some tenths of the height above it [m]; by default
        that of a located line.
    image
        Picture (along_track, cross_track) to be used instead of a mean of bands.
    lines
        Lines to look at; by default 4000 in the middle. They should hold the wobbliest part.
    crs

    Returns
    -------
    ConventionCheck
        ``findings``, ``wrong`` and ``undecided`` (names), ``suggested`` and ``table()``.

    Raises
    ------
    SchemaError
        No convention, camera, ground, pose or picture; or no two lines whose motion is known of both.

    Notes
    -----
    What one line cannot decide: which north headings count from, since a heading that is off by a
    constant looks like wind, or like structures that lean on the ground; ``"ZYX"`` from ``"ZXY"``, which
    differ by the product of roll and pitch; a wrong stamp from a clock that is off by as much. Where the
    platform does not wobble signs cannot be decided.

    The shift between rows is `hyperpaint.geometry.navigation_checks.picture_motion`, what is to be expected
    `hyperpaint.geometry.navigation_checks.pose_motion`.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> size = dict(lines=400, bands=2, columns=320, swath=8.0)
    >>> line = simulate_line(scene="checkerboard", wobble="rough", **size)
    >>> mirrored = line.assign(roll=-line["roll"])
    >>> check_conventions(line, ground=160.0).wrong, check_conventions(mirrored, ground=160.0).wrong
    ((), ('roll_positive',))
    """
    setting = setting_of(
        line, navigation, convention=convention, camera=camera, ground=ground, boresight=boresight,
        lever_arm=lever_arm, image=image, lines=lines, crs=crs,
    )  # fmt: skip
    findings = _findings(setting)
    source = line if navigation is None else navigation
    labelled, *others = {str(source[name].attrs.get("units")) for name in ANGLES}
    is_labelled = not others and labelled != "None"
    if is_labelled and conversion_factor(labelled, setting.declared.angle_unit) != 1.0:
        evidence = f"the variables are labelled {labelled!r}"
        wrong = Finding("angle_unit", setting.declared.angle_unit, "wrong", labelled, evidence)
        findings = [wrong if one.field == "angle_unit" else one for one in findings]
    first, stop, _ = setting.lines.indices(line.sizes[ALONG_TRACK])
    return ConventionCheck(tuple(findings), _suggested(setting.declared, findings), (first, stop))


def _findings(setting: Setting) -> list[Finding]:
    declared = Hypothesis(setting.declared)
    given = _height(declared, setting)
    if given <= 0.0:
        # any height does for signs: one at which pixels are square, as flights are planned
        setting = _at_height(setting, declared, _square(declared, setting))
    scored, used = _scores(setting)
    if not scored or scored[0].over_rest < RULES.log_odds:
        evidence = (
            "the picture does not follow the attitude: no wobble, little to see, clocks far apart, or a "
            "boresight of some degrees that was not given"
        )
        silent = {**fields_of(declared), "height_reference": setting.declared.height_reference}
        silent |= {"stamp_reference": str(setting.declared.stamp_reference)}
        return [Finding(n, str(v), "undecided", "", evidence) for n, v in silent.items()] + [
            _north(declared, setting)
        ]
    best = _best(scored, declared)
    poses, view = best.poses(setting.recorded), best.view(setting.view)
    fitted = fit_height(setting.seen, poses, view, used, setting.interval, _height(best, setting))
    if given > 0.0 and _is_off(fitted, given):
        setting = _at_height(setting, best, fitted.value)
        scored, used = _scores(setting)
        best = _best(scored, declared)
    findings = _senses(setting, scored, declared, used)
    findings += [_north(best, setting), _heights(setting.declared.height_reference, given, fitted)]
    return [*findings, _stamps(setting, best, used)]


# --- which meaning -----------------------------------------------------------------------------------------


def _scores(setting: Setting) -> tuple[list[Scored], Bools]:
    # all conventions by fit, and the compared parts of the picture
    plain = Hypothesis(setting.declared.replace(angle_unit="degree", column_order="left_to_right"))
    used = setting.comparable(setting.view.motion(plain.poses(setting.recorded)))
    if used.sum() < RULES.min_parts:
        raise SchemaError(
            f"{int(used.sum())} parts of rows show a motion and have poses",
            expected=f"{RULES.min_parts}",
            mend="check the times of line and record, and the contrast of the line",
            code="motion-not-seen",
        )
    scored = score(
        setting.seen, setting.recorded, setting.view, Hypothesis(setting.declared),
        columns_matter=setting.columns_matter, used=used, interval=setting.interval,
    )  # fmt: skip
    return scored, used


def _best(scored: list[Scored], declared: Hypothesis) -> Hypothesis:
    # among equal fits the one nearest to the declared one
    own = fields_of(declared)
    near = [one.hypothesis for one in scored if one.odds > -RULES.log_odds]
    return min(near, key=lambda h: sum(own[n] != v for n, v in fields_of(h).items()))


def _senses(setting: Setting, scored: list[Scored], declared: Hypothesis, used: Bools) -> list[Finding]:
    near = [fields_of(one.hypothesis) for one in scored if one.odds > -RULES.log_odds]
    late = "" if fields_of(declared) in near else _late(setting, declared, scored[0].hypothesis, used)
    findings = []
    for name, own in fields_of(declared).items():
        fits = [v for v in dict.fromkeys(fields[name] for fields in near) if v is not None]
        others = [one.odds for one in scored if fields_of(one.hypothesis)[name] != own]
        mine = [one.odds for one in scored if fields_of(one.hypothesis)[name] == own]
        likely = " or ".join(v for v in fits if v != own)
        verdict: Verdict = "right"
        if own in (None, "None"):
            verdict, evidence = "undecided", "not declared"
        elif late:
            verdict, evidence = "undecided", late
        elif own not in fits:
            verdict, evidence = "wrong", f"log odds {min(-max(mine, default=-9999.0), 9999.0):.0f} against it"
        elif len(fits) > 1:
            verdict, evidence = "undecided", f"{' and '.join(fits)} fit alike"
        elif not others:
            verdict, evidence = "undecided", "not tested"
        else:
            evidence = f"log odds {min(-max(others), 9999.0):.0f} for it"
        findings.append(Finding(name, str(own), verdict, "" if verdict == "right" else likely, evidence))
    return findings


def _late(setting: Setting, declared: Hypothesis, best: Hypothesis, used: Bools) -> str:
    # why a clock offset explains the picture as well as another convention, or ""
    offsets = np.arange(
        -RULES.clock_search_s, RULES.clock_search_s + RULES.clock_step_s / 2, RULES.clock_step_s
    )

    def curve(hypothesis: Hypothesis) -> Floats:
        def poses(offset: float) -> Floats:
            return hypothesis.poses(setting.recorded, offset)

        return costs_of(setting.seen, poses, hypothesis.view(setting.view), used, offsets)

    own, other = curve(declared), curve(best)
    if np.isnan(own).all() or np.nanmin(own) > np.nanmin(other):
        return ""
    offset = float(offsets[np.nanargmin(own)])
    if abs(offset) <= RULES.clock_step_s:
        return ""
    return (
        f"clocks {offset:+.2f} s apart explain the picture as well; see "
        "hyperpaint.geometry.estimate_clock_offset"
    )


# --- what changes little by little -------------------------------------------------------------------------


def _height(hypothesis: Hypothesis, setting: Setting) -> float:
    # median height above the ground [m]; NaN where no line has a pose
    heights = hypothesis.poses(setting.recorded)[2]
    finite = heights[np.isfinite(heights)]
    return float(np.median(finite)) - setting.view.ground if finite.size else float("nan")


def _at_height(setting: Setting, hypothesis: Hypothesis, height: float) -> Setting:
    ground = setting.view.ground + _height(hypothesis, setting) - height
    return replace(setting, view=replace(setting.view, ground=ground))


def _square(hypothesis: Hypothesis, setting: Setting) -> float:
    # height at which pixels are square [m]
    north, east = local_metres(*hypothesis.poses(setting.recorded)[:2])
    way = float(np.nanmedian(np.hypot(np.diff(north), np.diff(east))))
    return max(way / float(np.abs(setting.view.step).mean()), 1.0)


def _is_off(fitted: Refined, given: float) -> bool:
    ratio = max(fitted.value / given, given / fitted.value)
    return fitted.odds > RULES.log_odds and np.isfinite(fitted.sd) and ratio > RULES.height_ratio


def _heights(declared: str, given: float, fitted: Refined) -> Finding:
    other = "geoid" if declared == "ellipsoid" else "ellipsoid"
    seen = f"{fitted.value:.0f} +- {fitted.sd:.0f} m above ground by the picture, {given:.0f} m by the record"
    name = "height_reference"
    if not given > 0.0:
        return Finding(name, declared, "wrong", other, f"the camera would be {-given:.0f} m below the ground")
    if _is_off(fitted, given):
        return Finding(name, declared, "wrong", other, f"{seen}; or ground= is not that of the ellipsoid")
    if fitted.sd * 4.0 < given:
        return Finding(name, declared, "right", "", seen)
    return Finding(name, declared, "undecided", "", seen)


def _stamps(setting: Setting, best: Hypothesis, used: Bools) -> Finding:
    # the part of the exposure that time stamps mark, by the fitted clock
    fitted = fit_clock(
        setting.seen, lambda offset: best.poses(setting.recorded, offset), best.view(setting.view), used
    )
    declared, half = setting.declared.stamp_reference, setting.exposure / 2
    evidence = f"clock {1e3 * fitted.value:+.1f} +- {1e3 * fitted.sd:.1f} ms"
    name = "stamp_reference"
    if declared is None:
        return Finding(name, "None", "undecided", "", f"{evidence}; not declared")
    if not abs(fitted.value) > RULES.clock_sd * fitted.sd:
        sharp = np.isfinite(half) and RULES.clock_sd * fitted.sd < half
        return Finding(name, declared, "right" if sharp else "undecided", "", evidence)
    shifts = {
        other: 2.0 * half * (to - STAMP_TO_MID_EXPOSURES[declared])
        for other, to in STAMP_TO_MID_EXPOSURES.items()
    }
    away = {other: abs(fitted.value - shift) for other, shift in shifts.items() if np.isfinite(shift)}
    likely = min(away, key=lambda other: away[other]) if away else declared
    if likely == declared or away[likely] > max(3.0 * fitted.sd, half / 2):
        return Finding(
            "clock", "0 s", "wrong", f"{fitted.value:+.4f} s", f"{evidence}; add it as clock_offset_s"
        )
    return Finding(
        name, declared, "wrong", likely, f"{evidence}; a clock that is off by as much looks the same"
    )


def _north(hypothesis: Hypothesis, setting: Setting) -> Finding:
    # the angle between heading and course alone decides no reference of north
    poses = hypothesis.poses(setting.recorded)
    has_heading = np.isfinite(poses[5])
    turned = np.exp(1j * np.radians(poses[5][has_heading] - course_of(poses)))
    crab = float(np.degrees(np.angle(turned.mean()))) if has_heading.any() else float("nan")
    evidence = f"heading {crab:+.1f} degrees from the course: wind, boresight and declination look alike"
    return Finding("heading_reference", setting.declared.heading_reference, "undecided", "", evidence)


def _suggested(declared: Convention, findings: list[Finding]) -> Convention:
    # a wrong field is replaced only where one alternative remains
    changes = {
        one.field: one.likely
        for one in findings
        if one.verdict == "wrong" and hasattr(declared, one.field) and " or " not in one.likely
    }
    return declared.replace(**changes)
