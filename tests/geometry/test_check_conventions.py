"""Wrong declarations are named, right ones are not; the whole table: campaigns/wrong_conventions.py."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors, expect_refusals
from support.wobbly_flights import START, Flight
from support.wrong_declarations import DECLARED, Made, cases, flown, right

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import NAVIGATION_TIME
from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.geometry.navigation_checking import (
    ClockOffset,
    ConventionCheck,
    check_conventions,
    estimate_clock_offset,
    navigation_findings,
    row_motion,
)
from hyperpaint.simulation import simulate_collect, simulate_line
from hyperpaint.workflows.collects import check_collect

pytest.importorskip("pyproj")


@functools.cache
def flight_of(seed: int, lines: int = 400) -> tuple[Flight, xr.Dataset, xr.Dataset]:
    # Return a flight, its line and its record
    flight = flown(seed, lines=lines)
    return flight, flight.line(), flight.navigation()


def check(flight: Flight, made: Made, **options: Any) -> ConventionCheck:
    line, nav, declared = made
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    return check_conventions(
        line, nav, **{"convention": declared, "camera": camera, "ground": flight.ground} | options
    )


@pytest.mark.slow
def test_ten_wrong_declarations() -> None:
    # without the signs of roll and pitch, which `test_signs_of_roll_and_pitch` turns
    flight, *_ = flight_of(1)
    fields, checks = {}, {}
    for name, (field, make) in cases(flight).items():
        if field not in ("roll_positive", "pitch_positive"):
            fields[name], checks[name] = field, check(flight, make())
    named = [name for name, field in fields.items() if field in checks[name].wrong]
    undecided = {name for name, field in fields.items() if field in checks[name].undecided}
    assert len(named) >= 7, named
    assert undecided >= {"rotations in the order ZXY", "magnetic north, declination -11"}
    assert not [(name, checks[name].wrong) for name in fields if set(checks[name].wrong) - {fields[name]}]


@pytest.mark.slow
def test_nothing_is_named_of_a_right_declaration() -> None:
    flights = {seed: flight_of(seed) for seed in (201, 202)}  # rough, calm
    named = {seed: check(flight, (*made, DECLARED)).wrong for seed, (flight, *made) in flights.items()}
    assert named == dict.fromkeys(flights, ())


@pytest.mark.slow
def test_signs_of_roll_and_pitch_and_a_platform_that_flies_nose_up() -> None:
    flight, line, nav = flight_of(3, 700)
    upside = check(flight, (line, nav.assign(roll=-nav["roll"]), DECLARED))
    assert upside.suggested == DECLARED.replace(roll_positive="right_wing_up")
    assert ("right_wing_up" in upside.table(), upside["roll_positive"].verdict) == (True, "wrong")
    both = check(flight, (line, nav.assign(roll=-nav["roll"], pitch=-nav["pitch"]), DECLARED))
    assert set(both.wrong) == {"roll_positive", "pitch_positive"}
    # such a pitch in radians looks past the horizon: the last meanings tried are left out
    nose_up = nav.assign(pitch=nav["pitch"] + 2.5)
    found = check(flight, (line, nose_up, DECLARED), boresight=(0.0, -2.5, 0.0))
    assert (found.wrong, found["roll_positive"].verdict) == ((), "right")


def test_a_calm_platform_and_a_picture_of_noise_tell_nothing() -> None:
    still = Flight(seed=4, wobble="none", lines=400, attitude_noise=0.0)
    found = check(still, right(still))
    assert found.wrong == ()
    assert {"roll_positive", "pitch_positive", "heading_positive"} <= set(found.undecided)
    flight, line, nav = flight_of(5)
    noise = np.random.default_rng(0).integers(900, 1100, line.counts.shape).astype(np.uint16)
    assert check(flight, (line.assign(counts=line.counts.copy(data=noise)), nav, DECLARED)).wrong == ()


def test_lines_of_which_some_have_no_pose_tell_nothing() -> None:
    line = simulate_line(scene="checkerboard", wobble="rough", lines=400, bands=2, columns=320, swath=8.0)
    pose = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
    columns = {name: (NAVIGATION_TIME, line[name].values, line[name].attrs) for name in pose}
    nav = xr.Dataset(columns, {NAVIGATION_TIME: line["time"].values}, line.attrs)
    late = line.assign_coords(time=line["time"] + np.timedelta64(20, "ms"))
    assert check_conventions(late, nav, ground=160.0).wrong == ()


@pytest.mark.slow
def test_what_is_not_declared_and_what_units_contradict() -> None:
    flight, line, nav = flight_of(5)
    found = check(flight, (line, nav, hp.Convention()))
    assert {"stamp_reference", "column_order"} <= set(found.undecided)
    assert found["column_order"].likely == "left_to_right"
    radian = nav.assign({n: nav[n].assign_attrs(units="radian") for n in ("roll", "pitch", "heading")})
    assert "angle_unit" in check(flight, (line, radian, DECLARED)).wrong


def test_what_is_missing_is_named() -> None:
    flight = Flight(lines=100)
    line, nav, declared = right(flight)
    late = line.assign_coords(time=line.time + np.timedelta64(1, "h"))
    short = line.isel(along_track=slice(0, 40))
    no_roll, no_counts = nav.drop_vars("roll"), line.drop_vars("counts")
    expect_errors(
        (SchemaError, "ground-height-missing", lambda: check(flight, (line, nav, declared), ground=None)),
        (SchemaError, r"roll.*variable-missing", lambda: check(flight, (line, no_roll, declared))),
        (SchemaError, r"picture.*picture-missing", lambda: check(flight, (no_counts, nav, declared))),
        (SchemaError, "motion-not-seen", lambda: check(flight, (late, nav, declared))),
        (SchemaError, "line-too-short", lambda: check(flight, (short, nav, declared))),
    )


@pytest.mark.slow
def test_a_collect_with_a_wrong_sign_or_height_is_named_by_check(tmp_path: Path) -> None:
    size = {"lines": 400, "bands": 4, "columns": 256, "swath": 2.56 * 0.8, "truth": False}
    collect = simulate_collect(tmp_path, scene="checkerboard", wobble="rough", **size)
    text = collect.read_text()
    for old, new, likely in (
        ("", "", ()),
        ("ground = 160.0\n", "", ()),
        ("right_wing_down", "right_wing_up", ("right_wing_down",)),
        ("ground = 160.0", "ground = 199.0", ("geoid",)),
        ("ground = 160.0", "ground = 525.0", ("another ground= or unit of heights",)),  # feet
    ):
        collect.write_text(text.replace(old, new))
        findings = check_collect(collect)
        assert tuple(finding.expected for finding in findings) == likely
        assert {finding.kind.name for finding in findings} <= {"navigation-convention"}


def test_shifts_of_rows_are_measured_to_a_tenth_of_a_pixel() -> None:
    # The same row, moved by a known amount; a texture of sines has no interpolation of ours in it
    rng = np.random.default_rng(1)
    waves, phases = rng.uniform(0.2, 1.2, 40), rng.uniform(0, 6, 40)
    shifts = rng.uniform(-5, 5, 600)
    at = np.arange(256)[None, :] + np.cumsum(np.concatenate([[0.0], shifts]))[:, None]
    seen = row_motion(100 + 3 * np.sin(at[..., None] * waves + phases).sum(-1))
    assert seen is not None
    away = np.nanmedian(seen.shift, axis=1) - shifts
    np.testing.assert_array_less(
        [np.sqrt(np.mean(away**2)), np.abs(away).max(), 0.95], [0.06, 0.2, np.isfinite(seen.shift).mean()]
    )


# --- clocks that are known to be apart; and cases in which nobody can tell ----------------------------------


def by_attitude(flight: Flight, **changes: object) -> ClockOffset:
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    told = {"convention": DECLARED, "camera": camera, "ground": flight.ground, "max_offset_s": 0.6}
    told |= {"navigation": flight.navigation(), **changes}
    return estimate_clock_offset(flight.line(), **told)  # type: ignore[arg-type]


@pytest.mark.parametrize(("seed", "offset"), [(1, 0.137), (3, -0.402)])
def test_attitude_against_the_picture(seed: int, offset: float) -> None:
    found = by_attitude(Flight(seed=seed, wobble="rough", lines=1200, clock_offset=offset))
    assert found.method == "attitude"
    assert abs(found.offset_s - offset) < 4 * found.uncertainty_s
    assert found.uncertainty_s < 0.005
    assert found.curve.offset[int(found.curve.argmin("offset"))] == pytest.approx(offset, abs=0.02)
    assert "explains" in found.table()


def test_a_steady_platform_and_an_offset_beyond_the_search_are_refused() -> None:
    steady = Flight(seed=4, wobble="none", lines=400, attitude_noise=0.0)
    late = Flight(seed=1, wobble="rough", lines=800, clock_offset=0.45)
    expect_refusals(
        (TimeError, "motion-too-small", lambda: by_attitude(steady)),
        (TimeError, "motion-mismatch", lambda: by_attitude(late, max_offset_s=0.2)),
    )
    # a record of another day
    flight = Flight(seed=1, lines=100)
    nav = flight.navigation()
    nav = nav.assign_coords(navigation_time=nav.navigation_time + np.timedelta64(1, "D"))
    expect_refusals((TimeError, "pose-missing", lambda: by_attitude(flight, navigation=nav)))


# --- irradiance --------------------------------------------------------------------------------------------

PERIOD = 0.05


def light(t: np.ndarray, depth: float, seed: int) -> np.ndarray:
    # Return the level of the light: clouds with edges of some seconds
    edges = np.random.default_rng([seed, 1]).uniform(0, 120, 6)
    steps = sum((-1) ** k / (1 + np.exp(-(t - e) / 1.5)) for k, e in enumerate(np.sort(edges)))
    return np.asarray(1.0 - depth * steps)


def lit(offset: float, depth: float, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    # Return a line of 120 s, and a record every 2 s whose stamps are ``offset`` early
    rng = np.random.default_rng([seed, 2])
    t = PERIOD * np.arange(2400)
    ground = np.ones((t.size, 96))
    for _ in range(150):  # things on the ground, some over half of the swath
        a, b = rng.integers(0, t.size), rng.integers(0, 96)
        ground[a : a + rng.integers(20, 300), b : b + rng.integers(5, 50)] *= rng.uniform(0.4, 2.0)
    ground *= 1 + 0.03 * rng.standard_normal(ground.shape)
    counts = 800 * ground * light(t, depth, seed)[:, None]
    line = xr.Dataset(
        {"counts": (("along_track", "band", "cross_track"), counts[:, None].astype(np.uint16))},
        coords={"time": ("along_track", START + np.round(t * 1e9).astype("timedelta64[ns]"))},
    )
    s = np.arange(-20.0, 140.0, 2.0)
    level = light(s, depth, seed) * (1 + 1e-3 * rng.standard_normal(s.size))
    record = xr.Dataset(
        {"irradiance": (("irradiance_time", "irradiance_wavelength"), level[:, None] * np.ones(3))},
        coords={
            "irradiance_time": START + np.round((s - offset) * 1e9).astype("timedelta64[ns]"),
            "irradiance_wavelength": ("irradiance_wavelength", [500.0, 600.0, 700.0], {"units": "nm"}),
        },
    )
    record.irradiance.attrs["units"] = "W m-2 nm-1"
    return line, record


@pytest.mark.parametrize(("seed", "offset"), [(0, 1.3), (1, -4.2), (2, 0.0)])
def test_clouds_in_the_record_and_in_the_picture(seed: int, offset: float) -> None:
    line, record = lit(offset, 0.5, seed)
    found = estimate_clock_offset(line, irradiance=record, max_offset_s=8.0)
    assert found.method == "irradiance"
    assert abs(found.offset_s - offset) < 4 * found.uncertainty_s
    assert found.uncertainty_s < 1.0


@pytest.mark.parametrize(("offset", "names"), [(1.6, ["raw_0"]), (0.85, [])])
def test_an_offset_of_the_irradiance_record_is_a_finding(offset: float, names: list[str]) -> None:
    line, record = lit(offset, 0.5, 1)
    found = navigation_findings(
        {"short": line.isel(along_track=slice(0, 50)), "raw_0": xr.merge([line, record])}
    )
    assert [name for name, _ in found] == names
    for _, finding in found:
        assert (finding.field, finding.verdict) == ("irradiance clock", "wrong")
        assert float(finding.likely.removesuffix(" s")) == pytest.approx(offset, abs=0.5)


@pytest.mark.parametrize("moved", [np.timedelta64(-41 * 365, "D"), np.timedelta64("NaT")])
def test_a_line_without_a_time_near_the_record_gives_no_finding(moved: np.timedelta64) -> None:
    line, record = lit(1.6, 0.5, 1)
    line = line.assign_coords(time=line.time + moved)
    expect_refusals((TimeError, "record-elsewhere", lambda: estimate_clock_offset(line, irradiance=record)))
    assert navigation_findings({"raw_0": xr.merge([line, record])}) == []


def test_flat_light_clouds_elsewhere_and_other_than_one_record_are_refused() -> None:
    line, flat = lit(0.0, 0.0, 0)
    _, other = lit(0.0, 0.5, 3)
    expect_refusals(
        (TimeError, "light-constant", lambda: estimate_clock_offset(line, irradiance=flat)),
        (
            TimeError,
            "light-mismatch",
            lambda: estimate_clock_offset(line, irradiance=other, max_offset_s=8.0),
        ),
    )
    # one record is asked for
    expect_refusals(
        (SchemaError, "option-conflict", lambda: estimate_clock_offset(line)),
        (
            SchemaError,
            "value-out-of-range",
            "max_offset_s",
            lambda: estimate_clock_offset(line, irradiance=other, max_offset_s=-1.0),
        ),
    )
