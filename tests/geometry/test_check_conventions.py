"""Wrong declarations are named, right ones are not; the whole table: campaigns/wrong_conventions.py."""

from __future__ import annotations

import numpy as np
import pytest
from support.wobbly_flights import Flight
from support.wrong_declarations import DECLARED, cases, flown, right

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.geometry.navigation_checks.checking import ConventionCheck, check_conventions
from hyperpaint.geometry.navigation_checks.picture_motion import row_motion

pytest.importorskip("pyproj")


def check(flight: Flight, made: tuple) -> ConventionCheck:
    line, nav, declared = made
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    return check_conventions(line, nav, convention=declared, camera=camera, ground=flight.ground)


@pytest.mark.slow
def test_twelve_wrong_declarations() -> None:
    flight = flown(1, lines=1200)
    named, undecided, beside = [], [], []
    for name, (field, make) in cases(flight).items():
        found = check(flight, make())
        named += [name] if field in found.wrong else []
        undecided += [name] if field in found.undecided else []
        beside += [other for other in found.wrong if other != field]
    assert len(named) >= 9, named
    assert set(undecided) >= {"rotations in the order ZXY", "magnetic north, declination -11"}
    assert not beside


@pytest.mark.parametrize("seed", [201, 202, 203, 204])
@pytest.mark.slow
def test_nothing_is_named_of_a_right_declaration(seed: int) -> None:
    flight = flown(seed, lines=1000)
    assert check(flight, right(flight)).wrong == ()


@pytest.mark.slow
def test_the_suggestion_is_what_was_flown() -> None:
    flight = flown(3, lines=1000)
    line, nav, _ = right(flight)
    upside = check(flight, (line, nav.assign(roll=-nav["roll"]), DECLARED))
    assert upside.suggested == DECLARED.replace(roll_positive="right_wing_up")
    assert "right_wing_up" in upside.table()
    assert upside["roll_positive"].verdict == "wrong"


@pytest.mark.parametrize("mean_pitch", [1.5, 2.5])
def test_a_platform_that_flies_nose_up(mean_pitch: float) -> None:
    # such a pitch in radians looks past the horizon: the last meanings tried are left out
    flight = flown(3, lines=600)
    line, nav, declared = right(flight)
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    found = check_conventions(
        line, nav.assign(pitch=nav["pitch"] + mean_pitch), convention=declared, camera=camera,
        ground=flight.ground, boresight=(0.0, -mean_pitch, 0.0),
    )  # fmt: skip
    assert found.wrong == ()
    assert found["roll_positive"].verdict == "right"


@pytest.mark.slow
def test_two_at_once() -> None:
    flight = flown(3, lines=1000)
    line, nav, _ = right(flight)
    found = check(flight, (line, nav.assign(roll=-nav["roll"], pitch=-nav["pitch"]), DECLARED))
    assert set(found.wrong) == {"roll_positive", "pitch_positive"}


def test_a_platform_that_does_not_turn_tells_nothing() -> None:
    flight = Flight(seed=4, wobble="none", lines=400, attitude_noise=0.0)
    found = check(flight, right(flight))
    assert found.wrong == ()
    assert {"roll_positive", "pitch_positive", "heading_positive"} <= set(found.undecided)


def test_a_picture_of_nothing_tells_nothing() -> None:
    flight = Flight(seed=4, lines=400)
    line, nav, declared = right(flight)
    rng = np.random.default_rng(0)
    line["counts"] = line.counts.copy(data=rng.integers(900, 1100, line.counts.shape).astype(np.uint16))
    assert check(flight, (line, nav, declared)).wrong == ()


@pytest.mark.slow
def test_what_is_not_declared_is_said_to_be_so() -> None:
    flight = flown(5, lines=600)
    line, nav, _ = right(flight)
    found = check(flight, (line, nav, hp.Convention()))
    assert {"stamp_reference", "column_order"} <= set(found.undecided)
    assert found["column_order"].likely == "left_to_right"


def test_units_of_the_variables_contradict() -> None:
    flight = flown(5, lines=600)
    line, nav, declared = right(flight)
    for name in ("roll", "pitch", "heading"):
        nav[name].attrs["units"] = "radian"
    assert "angle_unit" in check(flight, (line, nav, declared)).wrong


def test_what_is_missing_is_named() -> None:
    flight = Flight(lines=100)
    line, nav, declared = right(flight)
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    with pytest.raises(SchemaError, match="ground-height-missing"):
        check_conventions(line, nav, convention=declared, camera=camera)
    with pytest.raises(SchemaError, match=r"roll.*variable-missing"):
        check_conventions(
            line, nav.drop_vars("roll"), convention=declared, camera=camera, ground=flight.ground
        )
    with pytest.raises(SchemaError, match=r"picture.*picture-missing"):
        check(flight, (line.drop_vars("counts"), nav, declared))
    late = line.assign_coords(time=line.time + np.timedelta64(1, "h"))
    with pytest.raises(SchemaError, match="motion-not-seen"):
        check(flight, (late, nav, declared))


def test_shifts_of_rows_are_measured_to_a_tenth_of_a_pixel() -> None:
    """The same row, moved by a known amount; a texture of sines has no interpolation of ours in it."""
    rng = np.random.default_rng(1)
    waves, phases = rng.uniform(0.2, 1.2, 40), rng.uniform(0, 6, 40)
    shifts = rng.uniform(-5, 5, 600)
    at = np.arange(256)[None, :] + np.cumsum(np.concatenate([[0.0], shifts]))[:, None]
    picture = 100 + 3 * np.sin(at[..., None] * waves + phases).sum(-1)
    seen = row_motion(picture)
    assert seen is not None
    away = np.nanmedian(seen.shift, axis=1) - shifts
    assert np.sqrt(np.mean(away**2)) < 0.06
    assert np.abs(away).max() < 0.2
    assert np.isfinite(seen.shift).mean() > 0.95
