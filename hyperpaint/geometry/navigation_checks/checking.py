"""Test of a declared convention against the track and the picture of a flight line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.constants import MID_EXPOSURE_OFFSETS
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.base.units import conversion_factor, takes_quantities
from hyperpaint.geometry.georeference.cameras import PinholeCamera
from hyperpaint.geometry.georeference.poses import ANGLES, LOCATION_UNITS

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
        Declared value.
    verdict
        ``"right"``, ``"wrong"``, or ``"undecided"``: neither the track nor the picture decides.
    likely
        More likely value; empty where the declaration is right.
    evidence
        Reason, with numbers.
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
        One finding per declaration.
    suggested
        The declared convention, with wrong fields replaced where a single alternative remains; not applied.
    lines
        First line of the check, and the line after the last.
    """

    findings: tuple[Finding, ...]
    suggested: Convention
    lines: tuple[int, int]

    @property
    def wrong(self) -> tuple[str, ...]:
        """Fields that look wrong."""
        return tuple(finding.field for finding in self.findings if finding.verdict == "wrong")

    @property
    def undecided(self) -> tuple[str, ...]:
        """Fields that could not be decided."""
        return tuple(finding.field for finding in self.findings if finding.verdict == "undecided")

    def __getitem__(self, field: str) -> Finding:
        """Return the finding on a field."""
        return next(finding for finding in self.findings if finding.field == field)

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
    #: Ratio of fitted and recorded height above which the record is wrong; leaning structures bias the fit.
    height_ratio: float = 1.4
    clock_sd: float = 3.0  #: standard deviations of a fitted offset above which the clock is wrong
    #: Range and step of the search for another clock offset, where another convention fits better.
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

    Roll of the platform shifts the rows of a picture sideways, and pitch makes neighbouring rows more or less
    alike; the convention of positions and angles determines the expected shifts. All combinations of signs,
    units, orders of rotation and of columns, and of latitude and longitude, are compared by how well they
    explain the picture. The data are not changed: wrong and undecided declarations are reported.

    Parameters
    ----------
    line
        Flight line with ``time`` at mid exposure and a cube; its own poses where there is no ``navigation``.
    navigation
        See `hyperpaint.open_navigation`.
    convention
        Declared convention; by default that of the attributes.
    camera, boresight, lever_arm
        See `hyperpaint.geometry.locate`; a boresight of about a degree or less may be omitted; without one
        of several degrees everything is undecided.
    ground
        Height of the ground above the ellipsoid, accurate to some tenths of the flight height [m]; by default
        that of a located line.
    image
        Picture (along_track, cross_track) to be used instead of a mean of bands.
    lines
        Lines to compare; by default 4000 in the middle. They should contain the part with the strongest
        wobble.
    crs

    Returns
    -------
    ConventionCheck
        ``findings``, ``wrong`` and ``undecided`` (names), ``suggested`` and ``table()``.

    Raises
    ------
    SchemaError
        No convention, camera, ground, pose or picture; or too few successive lines with poses and texture.

    Notes
    -----
    A single line cannot decide which north headings count from, since a heading with a constant error
    looks like wind, or like leaning structures on the ground; nor ``"ZYX"`` from ``"ZXY"``, which
    differ by the product of roll and pitch; nor a wrong stamp from a clock offset of the same size. Where the
    platform does not wobble signs cannot be decided.

    Shifts between rows: `hyperpaint.geometry.navigation_checks.picture_motion`; expected shifts:
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
    labelled, *other_units = {str(source[name].attrs.get("units")) for name in ANGLES}
    is_labelled = not other_units and labelled != "None"
    if is_labelled and conversion_factor(labelled, setting.declared.angle_unit) != 1.0:
        evidence = f"the variables have units {labelled!r}"
        unit = Finding("angle_unit", setting.declared.angle_unit, "wrong", labelled, evidence)
        findings = [unit if finding.field == "angle_unit" else finding for finding in findings]
    first, stop, _ = setting.lines.indices(line.sizes[ALONG_TRACK])
    # a wrong field is replaced only where one alternative remains
    changes = {
        finding.field: finding.likely
        for finding in findings
        if finding.verdict == "wrong"
        and hasattr(setting.declared, finding.field)
        and " or " not in finding.likely
    }
    return ConventionCheck(tuple(findings), setting.declared.replace(**changes), (first, stop))


def _findings(setting: Setting) -> list[Finding]:
    declared = Hypothesis(setting.declared)
    recorded_height = _median_height(declared, setting)
    if recorded_height <= 0.0:
        # signs can be tested at any height: use the height of square pixels, as flights are planned
        north, east = local_metres(*declared.poses(setting.recorded)[:2])
        distance = float(np.nanmedian(np.hypot(np.diff(north), np.diff(east))))
        setting = _at_height(setting, declared, max(distance / float(np.abs(setting.view.step).mean()), 1.0))
    scored, compared = _scores(setting)
    if not scored or scored[0].over_rest < RULES.log_odds:
        evidence = (
            "the picture does not follow the attitude: no wobble, low contrast, a large clock offset, or a "
            "boresight of some degrees that was not passed"
        )
        declarations = {**fields_of(declared), "height_reference": setting.declared.height_reference}
        declarations |= {"stamp_reference": str(setting.declared.stamp_reference)}
        return [Finding(n, str(v), "undecided", "", evidence) for n, v in declarations.items()] + [
            _north_finding(declared, setting)
        ]
    best = _nearest_plausible(scored, declared)
    poses, view = best.poses(setting.recorded), best.view(setting.view)
    fitted = fit_height(
        setting.observed, poses, view, compared, setting.interval, _median_height(best, setting)
    )
    if recorded_height > 0.0 and _is_off(fitted, recorded_height):
        setting = _at_height(setting, best, fitted.value)
        scored, compared = _scores(setting)
        best = _nearest_plausible(scored, declared)
    findings = _sign_findings(setting, scored, declared, compared)
    findings += [
        _north_finding(best, setting),
        _height_finding(setting.declared.height_reference, recorded_height, fitted),
    ]
    return [*findings, _stamp_finding(setting, best, compared)]


# --- convention -----------------------------------------------------------------------------------------


def _scores(setting: Setting) -> tuple[list[Scored], Bools]:
    # Return all conventions ordered by fit, and which parts of the picture are compared.
    plain_hypothesis = Hypothesis(setting.declared.replace(angle_unit="degree", column_order="left_to_right"))
    compared = setting.comparable(setting.view.motion(plain_hypothesis.poses(setting.recorded)))
    if compared.sum() < RULES.min_parts:
        raise SchemaError(
            f"{int(compared.sum())} parts of rows show a motion and have poses",
            expected=f"{RULES.min_parts}",
            mend="check the times of line and record, and the contrast of the line",
            code="motion-not-seen",
        )
    scored = score(
        setting.observed, setting.recorded, setting.view, Hypothesis(setting.declared),
        columns_matter=setting.columns_matter, compared=compared, interval=setting.interval,
    )  # fmt: skip
    return scored, compared


def _nearest_plausible(scored: list[Scored], declared: Hypothesis) -> Hypothesis:
    # Return, of the hypotheses that fit equally well, the nearest to the declared one.
    declared_fields = fields_of(declared)
    plausible = [one.hypothesis for one in scored if one.odds > -RULES.log_odds]
    return min(plausible, key=lambda h: sum(declared_fields[n] != v for n, v in fields_of(h).items()))


def _sign_findings(
    setting: Setting, scored: list[Scored], declared: Hypothesis, compared: Bools
) -> list[Finding]:
    plausible = [fields_of(one.hypothesis) for one in scored if one.odds > -RULES.log_odds]
    clock_reason = (
        ""
        if fields_of(declared) in plausible
        else _clock_alternative(setting, declared, scored[0].hypothesis, compared)
    )
    findings = []
    for name, declared_value in fields_of(declared).items():
        fitting_values = [v for v in dict.fromkeys(fields[name] for fields in plausible) if v is not None]
        other_odds = [one.odds for one in scored if fields_of(one.hypothesis)[name] != declared_value]
        own_odds = [one.odds for one in scored if fields_of(one.hypothesis)[name] == declared_value]
        likely = " or ".join(v for v in fitting_values if v != declared_value)
        verdict: Verdict = "right"
        if declared_value in (None, "None"):
            verdict, evidence = "undecided", "not declared"
        elif clock_reason:
            verdict, evidence = "undecided", clock_reason
        elif declared_value not in fitting_values:
            verdict, evidence = (
                "wrong",
                f"log odds {min(-max(own_odds, default=-9999.0), 9999.0):.0f} against it",
            )
        elif len(fitting_values) > 1:
            verdict, evidence = "undecided", f"{' and '.join(fitting_values)} fit alike"
        elif not other_odds:
            verdict, evidence = "undecided", "not tested"
        else:
            evidence = f"log odds {min(-max(other_odds), 9999.0):.0f} for it"
        findings.append(
            Finding(name, str(declared_value), verdict, "" if verdict == "right" else likely, evidence)
        )
    return findings


def _clock_alternative(setting: Setting, declared: Hypothesis, best: Hypothesis, compared: Bools) -> str:
    # Return the reason if a clock offset explains the picture as well as another convention, else "".
    offsets = np.arange(
        -RULES.clock_search_s, RULES.clock_search_s + RULES.clock_step_s / 2, RULES.clock_step_s
    )

    def curve(hypothesis: Hypothesis) -> Floats:
        def poses(offset: float) -> Floats:
            return hypothesis.poses(setting.recorded, offset)

        return costs_of(setting.observed, poses, hypothesis.view(setting.view), compared, offsets)

    own_costs, best_costs = curve(declared), curve(best)
    if np.isnan(own_costs).all() or np.nanmin(own_costs) > np.nanmin(best_costs):
        return ""
    offset = float(offsets[np.nanargmin(own_costs)])
    if abs(offset) <= RULES.clock_step_s:
        return ""
    return (
        f"a clock offset of {offset:+.2f} s explains the picture as well; see "
        "hyperpaint.geometry.estimate_clock_offset"
    )


# --- height, stamps and north -------------------------------------------------------------------------


def _median_height(hypothesis: Hypothesis, setting: Setting) -> float:
    # Return the median height above the ground [m]; NaN if no line has a pose.
    heights = hypothesis.poses(setting.recorded)[2]
    finite = heights[np.isfinite(heights)]
    return float(np.median(finite)) - setting.view.ground if finite.size else float("nan")


def _at_height(setting: Setting, hypothesis: Hypothesis, height: float) -> Setting:
    ground = setting.view.ground + _median_height(hypothesis, setting) - height
    return replace(setting, view=replace(setting.view, ground=ground))


def _is_off(fitted: Refined, recorded: float) -> bool:
    ratio = max(fitted.value / recorded, recorded / fitted.value)
    return fitted.odds > RULES.log_odds and np.isfinite(fitted.sd) and ratio > RULES.height_ratio


def _height_finding(declared: str, recorded: float, fitted: Refined) -> Finding:
    other = "geoid" if declared == "ellipsoid" else "ellipsoid"
    text = (
        f"{fitted.value:.0f} +- {fitted.sd:.0f} m above ground by the picture, {recorded:.0f} m by the record"
    )
    name = "height_reference"
    if not recorded > 0.0:
        return Finding(
            name, declared, "wrong", other, f"the camera would be {-recorded:.0f} m below the ground"
        )
    if _is_off(fitted, recorded):
        return Finding(name, declared, "wrong", other, f"{text}; or ground= is not that of the ellipsoid")
    if fitted.sd * 4.0 < recorded:
        return Finding(name, declared, "right", "", text)
    return Finding(name, declared, "undecided", "", text)


def _stamp_finding(setting: Setting, best: Hypothesis, compared: Bools) -> Finding:
    # Check which part of the exposure time stamps mark, by the fitted clock offset.
    fitted = fit_clock(
        setting.observed,
        lambda offset: best.poses(setting.recorded, offset),
        best.view(setting.view),
        compared,
    )
    declared, half_exposure = setting.declared.stamp_reference, setting.exposure / 2
    evidence = f"clock {1e3 * fitted.value:+.1f} +- {1e3 * fitted.sd:.1f} ms"
    name = "stamp_reference"
    if declared is None:
        return Finding(name, "None", "undecided", "", f"{evidence}; not declared")
    if not abs(fitted.value) > RULES.clock_sd * fitted.sd:
        is_precise = np.isfinite(half_exposure) and RULES.clock_sd * fitted.sd < half_exposure
        return Finding(name, declared, "right" if is_precise else "undecided", "", evidence)
    shifts = {
        other: 2.0 * half_exposure * (mid_offset - MID_EXPOSURE_OFFSETS[declared])
        for other, mid_offset in MID_EXPOSURE_OFFSETS.items()
    }
    distances = {other: abs(fitted.value - shift) for other, shift in shifts.items() if np.isfinite(shift)}
    likely = min(distances, key=lambda other: distances[other]) if distances else declared
    if likely == declared or distances[likely] > max(3.0 * fitted.sd, half_exposure / 2):
        return Finding(
            "clock", "0 s", "wrong", f"{fitted.value:+.4f} s", f"{evidence}; add it as clock_offset_s"
        )
    return Finding(
        name, declared, "wrong", likely, f"{evidence}; a clock that is off by as much looks the same"
    )


def _north_finding(hypothesis: Hypothesis, setting: Setting) -> Finding:
    # Report the angle between heading and course, which alone cannot decide the reference of north.
    poses = hypothesis.poses(setting.recorded)
    has_heading = np.isfinite(poses[5])
    direction = np.exp(1j * np.radians(poses[5][has_heading] - course_of(poses)))
    crab = float(np.degrees(np.angle(direction.mean()))) if has_heading.any() else float("nan")
    evidence = f"heading {crab:+.1f} degrees from the course: wind, boresight and declination look alike"
    return Finding("heading_reference", setting.declared.heading_reference, "undecided", "", evidence)
