"""Mountings that are known, found again from points picked with a known error."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_refusals
from support.wobbly_flights import Flight
from support.wrong_declarations import DECLARED

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.geometry.georeference.locating import BoresightSolution, solve_boresight

pyproj = pytest.importorskip("pyproj")

MOUNTED = (0.4, -0.6, 0.8)
CLOCK = 0.02
CRS = "EPSG:32618"
LIMITS = [0.01, 0.01, 0.1, 0.05, 0.002]


def flights(count: int = 4, wobble: str = "calm") -> dict[str, Flight]:
    told: dict[str, Any] = {"boresight": MOUNTED, "clock_offset": CLOCK, "attitude_noise": 0.0}
    return {
        f"raw_{k}": Flight(seed=50 + k, wobble=wobble, lines=900, columns=640, heading=20 + 90 * k, **told)
        for k in range(count)
    }


def true_points(
    flown: dict[str, Flight], seed: int, count: int = 8, column: float | None = None
) -> xr.Dataset:
    # Return points where they are seen, without error; some on things, some on the ground
    rng = np.random.default_rng(seed)
    to_map = pyproj.Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
    rows = []
    for name, flight in flown.items():
        at = rng.uniform(5, flight.lines - 6, count), rng.uniform(5, flight.columns - 6, count)
        for line, anywhere, up in zip(*at, rng.uniform(0, 0.3, count), strict=True):
            sample = anywhere if column is None else column
            east, north = flight.hits(np.array([1.0 + flight.period * line]), np.array([sample]), up)[0, 0]
            x, y, height = to_map.transform(
                *flight.topocentric().transform(east, north, up, direction="INVERSE")
            )
            rows.append((name, line, sample, x, y, height))
    columns = zip(
        ("flightline", "along_track_pixel", "cross_track_pixel", "east", "north", "height"),
        zip(*rows, strict=True),
        strict=True,
    )
    return xr.Dataset({name: ("point", np.array(values)) for name, values in columns}, attrs={"crs": CRS})


def picked(points: xr.Dataset, seed: int, sd: float = 0.3) -> xr.Dataset:
    rng = np.random.default_rng([seed, 1])
    return points.assign(
        {
            n: points[n] + sd * rng.standard_normal(points.sizes["point"])
            for n in ("along_track_pixel", "cross_track_pixel")
        }
    )


def solved(flown: dict[str, Flight], points: xr.Dataset, **changes: Any) -> BoresightSolution:
    flight = next(iter(flown.values()))
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    told = {"convention": DECLARED, "camera": camera, "lever_arm": flight.lever_arm, **changes}
    lines = {name: one.line(image=False) for name, one in flown.items()}
    return solve_boresight(
        lines, points, navigation={name: one.navigation() for name, one in flown.items()}, **told
    )


def errors(found: BoresightSolution) -> np.ndarray:
    return np.array([found.value(n) - t for n, t in zip(found.solved, (*MOUNTED, 0.0, CLOCK), strict=True)])


def test_without_errors_it_is_exact() -> None:
    flown = flights(2)
    for one in flown.values():
        one.rate = 1000.0  # so that interpolation leaves nothing
    found = solved(flown, true_points(flown, 0))
    np.testing.assert_array_less(np.abs(errors(found)), [1e-4, 1e-4, 1e-3, 1e-3, 5e-5])
    assert found.points.miss.max() < 0.05


@pytest.mark.slow
def test_eight_points_on_four_lines() -> None:
    # the benchmark repeats it 100 times: 0.01 degrees, 0.1 degrees of heading, 2 ms
    both = [flights(4, wobble) for wobble in ("calm", "rough")]
    scores, within = [], 0
    for seed in range(6):
        flown = both[seed % 2]
        found = solved(flown, picked(true_points(flown, seed), seed))
        scores.append(errors(found) / list(found.sd.values()))
        within += bool((np.abs(errors(found)) < LIMITS).all())
        assert found.picking_sd == pytest.approx(0.3, rel=0.35)
    assert within >= 5
    # 30 numbers of unit variance: the standard deviation of their mean square is 0.26
    assert 0.4 < np.mean(np.square(scores)) < 1.9


def test_an_outlier_is_named_and_left_out() -> None:
    flown = flights(2)
    points = picked(true_points(flown, 3), 3)
    points["cross_track_pixel"][5] += 25.0
    points = points.assign_coords(name=("point", [f"cone {k}" for k in range(points.sizes["point"])]))
    found = solved(flown, points)
    assert (
        found.points.point[found.points.outlier].values.tolist(),
        (np.abs(errors(found)) < [0.02, 0.02, 0.1, 0.05, 0.005]).all(),
        "left out: cone 5" in found.table(),
    ) == (["cone 5"], True, True)
    assert found.points.miss.sel(point="cone 5") > 10


def test_a_steady_line_does_not_part_pitch_from_clock() -> None:
    flown = flights(1, "none")
    points = picked(true_points(flown, 1, 20), 1)
    codes = ("parameter-correlated", "parameter-correlated", "condition-poor")
    expect_refusals((SchemaError, codes, lambda: solved(flown, points)))
    found = solved(flown, points, solve=("roll", "pitch", "heading"), clock_offset_s=CLOCK)
    assert (
        found.solved,
        (np.abs(np.subtract(found.boresight, MOUNTED)) < [0.02, 0.02, 0.2]).all(),
        found.clock_offset_s,
    ) == (("roll", "pitch", "heading"), True, CLOCK)


@pytest.mark.parametrize(("column", "named"), [(319.5, "heading"), (40.0, "pitch.*\n.*heading")])
def test_points_in_one_column_do_not_tell_the_heading(column: float, named: str) -> None:
    flown = flights(1, "none")
    points = true_points(flown, 1, 12, column)
    expect_error(SchemaError, named, lambda: solved(flown, points, solve=("roll", "pitch", "heading")))


def test_one_line_alone_and_what_was_flown_is_located() -> None:
    # The solution, handed to `locate`, puts points where they are
    flown = flights(1, "rough")
    points = true_points(flown, 2)
    flight = flown["raw_0"]
    line = flight.line(image=False)
    found = solved(flown, points)
    camera = hp.geometry.PinholeCamera(flight.columns, pixel_pitch=flight.spacing, focal_length=1.0)
    located = hp.geometry.locate(
        line,
        navigation=flight.navigation(),
        convention=DECLARED,
        camera=camera,
        boresight=found.boresight,
        lever_arm=flight.lever_arm,
        clock_offset_s=found.clock_offset_s,
        ground=float(points.height[0]) - found.height_offset_m,
        crs=CRS,
    )
    at = {
        "along_track": float(points.along_track_pixel[0]),
        "cross_track": float(points.cross_track_pixel[0]),
    }
    here = located[["east", "north"]].assign_coords(along_track=np.arange(flight.lines)).compute().interp(at)
    assert (float(here.east), float(here.north)) == (
        pytest.approx(float(points.east[0]), abs=0.002),
        pytest.approx(float(points.north[0]), abs=0.002),
    )


def test_what_cannot_be_is_refused() -> None:
    flown = flights(1)
    points = true_points(flown, 0)
    nowhere = points.assign(height=points.height.where(points.height > 1e9))
    other = points.assign(flightline=points.flightline.str.replace("raw_0", "raw_7"))
    far = points.assign(along_track_pixel=points.along_track_pixel + 1e6)
    for wrong, options, match in (
        (points, {"solve": ("yaw",)}, r"yaw.*choice-unknown"),
        (points.isel(point=[0, 1]), {}, "control-points-few"),
        (far, {}, "pixel-outside"),
        (points.drop_attrs(), {}, "crs-missing"),
        (other, {}, r"raw_7.*flightline-unknown"),
        (points.drop_vars("height"), {}, "variable-missing"),
        (nowhere, {}, "not-finite"),
    ):
        with pytest.raises(SchemaError, match=match):
            solved(flown, wrong, **options)
    with pytest.raises(ValueError, match="unpack"):  # one number would be taken for all three axes
        solved(flown, points, lever_arm=(0.5,))
    # what fits nothing
    flown = flights(2)
    told: dict[str, Any] = {"solve": ("roll", "pitch", "heading"), "clock_offset_s": CLOCK + 0.3}
    points = picked(true_points(flown, 0), 1)
    expect_refusals((SchemaError, "control-points-misfit", lambda: solved(flown, points, **told)))
    assert solved(flown, points, largest_picking_sd=1000.0, **told).picking_sd > 3.0


@pytest.mark.parametrize("late", [-1.0, -0.3, 0.7])
@pytest.mark.slow
def test_a_clock_that_begins_with_another_swing_is_found(late: float) -> None:
    # Every swing of the platform has a minimum of its own, which leaves 6 pixel and a pitch off by 2
    flown = flights(4)
    found = solved(flown, picked(true_points(flown, 0), 1), clock_offset_s=CLOCK + late)
    assert (np.abs(errors(found)) < LIMITS).all()
    assert found.picking_sd < 0.5


@pytest.mark.parametrize(("field", "by"), [("east", 1e5), ("height", 5000.0)])
def test_a_blunder_is_named_and_does_not_hide_the_others(field: str, by: float) -> None:
    flown = flights(4)
    points = picked(true_points(flown, 0), 2)
    points[field][0] += by
    found = solved(flown, points)
    assert (np.flatnonzero(found.points.outlier).tolist(), (np.abs(errors(found)) < LIMITS).all()) == (
        [0],
        True,
    )
