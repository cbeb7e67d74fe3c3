"""Poses between the rows of a navigation record against scipy's, and what becomes of gaps."""

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp
from support.geocentric_rays import START
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.geometry.georeference.locating import angles_of, matrices, quaternions, slerp

POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
CANONICAL = Convention()
SECOND = np.timedelta64(1_000_000_000, "ns")


def record(rows: int = 60, period: float = 0.01, **fixed: Any) -> xr.Dataset:
    # Return a smooth record that turns through north
    t = np.arange(rows) * period
    values = {
        "latitude": 34 + 1e-5 * t, "longitude": -81 + 2e-5 * np.sin(t), "altitude": 15 + 0.2 * np.cos(3 * t),
        "roll": 4 * np.sin(7 * t), "pitch": 3 * np.cos(5 * t), "heading": np.mod(-2 + 20 * t, 360),
    } | {name: np.asarray(value, float) for name, value in fixed.items()}  # fmt: skip
    units = {"altitude": "m"}
    return xr.Dataset(
        {n: ("navigation_time", v, {"units": units.get(n, "degree")}) for n, v in values.items()},
        {"navigation_time": START + np.round(t * 1e9).astype("timedelta64[ns]")},
        CANONICAL.to_attrs(),
    )


def at(seconds: Any) -> xr.DataArray:
    return xr.DataArray(
        START + np.round(np.asarray(seconds, float) * 1e9).astype("timedelta64[ns]"), dims="along_track"
    )


def scipy_rotations(data: xr.Dataset) -> Rotation:
    return Rotation.from_euler(
        "ZYX", np.stack([data[n].values for n in ("heading", "pitch", "roll")], -1), degrees=True
    )


def turn_between(made: xr.Dataset, wanted: Rotation) -> np.ndarray:
    return np.degrees((scipy_rotations(made) * wanted.inv()).magnitude())


SECONDS = np.linspace(0.0, 0.58, 211)


def test_linear_poses_are_those_of_scipy() -> None:
    data = record()
    made = hp.geometry.interpolate_pose(data, at(SECONDS))
    knots = np.arange(60) * 0.01
    assert turn_between(made, Slerp(knots, scipy_rotations(data))(SECONDS)).max() < 1e-6
    for name in POSE[:3]:
        np.testing.assert_allclose(made[name], np.interp(SECONDS, knots, data[name]), rtol=0, atol=1e-9)
        assert made[name].dtype == np.float64
    assert ((made["heading"] >= 0).all(), (made["heading"] < 360).all()) == (True, True)


def test_cubic_poses_are_those_of_scipy() -> None:
    data = record(13, 0.05)
    made = hp.geometry.interpolate_pose(data, at(SECONDS), interpolation="cubic")
    knots = np.arange(13) * 0.05
    assert turn_between(made, RotationSpline(knots, scipy_rotations(data))(SECONDS)).max() < 1e-6
    np.testing.assert_allclose(made.altitude, CubicSpline(knots, data.altitude)(SECONDS), rtol=0, atol=1e-9)
    truth = record(584, 0.001)
    fine = truth.isel(navigation_time=slice(100, 500))  # away from the ends, where a spline is free
    times = at(np.arange(100, 500) * 0.001)
    errors = [
        turn_between(
            hp.geometry.interpolate_pose(data, times, interpolation=kind), scipy_rotations(fine)
        ).max()
        for kind in ("linear", "cubic")
    ]
    assert errors[1] < 0.2 * errors[0]


def test_quaternions_change_sign_without_harm() -> None:
    # the heading that jumps from 359 to 1 is a step of 2 degrees, the one from 179 to 181 too
    for before, after in ((359.0, 1.0), (179.0, 181.0), (-1.0, 1.0), (1.0, 359.0)):
        data = record(2, 0.1, roll=[0, 0], pitch=[0, 0], heading=[before, after])
        for kind in ("linear", "cubic"):
            made = hp.geometry.interpolate_pose(data, at([0.05]), interpolation=kind)
            gap = (float(made["heading"][0]) - before + 180) % 360 - 180
            assert abs(gap) == pytest.approx(1.0, abs=1e-9), (before, kind)
    data = record(2, 0.1, longitude=[179.9999, -179.9999])
    middle = hp.geometry.interpolate_pose(data, at([0.02, 0.05, 0.08])).longitude.values
    assert np.abs(np.abs(middle) - 180).max() < 1e-4


@given(st.lists(st.floats(-180, 180), min_size=6, max_size=6), st.floats(0, 1))
def test_rotations_are_those_of_scipy(angles: list[float], weight: float) -> None:
    ends = np.array(angles).reshape(2, 3)
    mine = quaternions(*ends.T)
    theirs = Rotation.from_euler("ZYX", ends[:, ::-1], degrees=True)
    np.testing.assert_allclose(matrices(mine), theirs.as_matrix(), rtol=0, atol=1e-12)
    between = slerp(mine[0], mine[1], np.float64(weight))
    arc = (theirs[0].inv() * theirs[1]).magnitude()
    if arc < np.pi - 1e-3:
        wanted = Slerp([0, 1], theirs)(weight).as_matrix()
        np.testing.assert_allclose(matrices(between), wanted, rtol=0, atol=1e-9)
        np.testing.assert_allclose(matrices(quaternions(*angles_of(between))), wanted, rtol=0, atol=1e-7)


def known(made: xr.Dataset) -> list[bool]:
    states = np.stack([np.isfinite(made[name]) for name in POSE])
    assert (states == states[0]).all()  # half a pose places nothing
    return [bool(state) for state in states[0]]


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_nothing_is_extrapolated(kind: Any) -> None:
    assert known(
        hp.geometry.interpolate_pose(record(), at([-0.001, 0.0, 0.3, 0.59, 0.591]), interpolation=kind)
    ) == [False, True, True, True, False]
    times = at([0.1, 0.2])
    times[1] = np.datetime64("NaT", "ns")
    assert known(hp.geometry.interpolate_pose(record(), times, interpolation=kind)) == [True, False]


@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_gaps_are_not_bridged(kind: Any) -> None:
    data = record()
    rows = [*range(20), *range(35, 60)]  # 0.15 s are missing
    holed = data.isel(navigation_time=rows)
    seconds = [0.18, 0.19, 0.191, 0.3, 0.349, 0.35, 0.36]
    wanted = [True, True, False, False, False, True, True]
    assert known(hp.geometry.interpolate_pose(holed, at(seconds), interpolation=kind)) == wanted
    assert all(known(hp.geometry.interpolate_pose(holed, at(seconds), interpolation=kind, max_gap_s=0.2)))
    assert known(
        hp.geometry.interpolate_pose(data, at([0.005, 0.01]), interpolation=kind, max_gap_s=0.009)
    ) == [
        False,
        True,
    ]
    # a row without an attitude is missing for the attitude, one without a place for the place
    for name in ("pitch", "altitude"):
        lost = data.copy(deep=True)
        lost[name][20:35] = np.nan
        assert known(hp.geometry.interpolate_pose(lost, at(seconds), interpolation=kind)) == wanted
    lost["roll"][:] = np.nan
    assert not any(known(hp.geometry.interpolate_pose(lost, at(seconds), interpolation=kind)))
    # one that stands alone between two gaps holds at its own time
    lone = data.isel(navigation_time=[0, 1, 2, 25, 50, 51])
    made = hp.geometry.interpolate_pose(lone, at([0.25, 0.251, 0.505]), interpolation=kind)
    assert known(made) == [True, False, True]
    assert float(made.altitude[0]) == pytest.approx(float(data.altitude[25]), abs=1e-12)


def test_times_of_a_record() -> None:
    data = record(5)
    twice = xr.concat(
        [data.isel(navigation_time=[0, 1]), data.isel(navigation_time=[1, 2, 3])], "navigation_time"
    )
    made = hp.geometry.interpolate_pose(twice, at([0.015]))
    assert float(made.altitude[0]) == pytest.approx(float(data.altitude[1:3].mean()), abs=1e-12)
    backwards = data.isel(navigation_time=slice(None, None, -1))
    numbers = data.assign_coords(navigation_time=np.arange(5.0))
    expect_refusals(
        (TimeError, "time-backwards", "4 of 5", lambda: hp.geometry.interpolate_pose(backwards, at([0.0]))),
        (TimeError, "type-wrong", lambda: hp.geometry.interpolate_pose(numbers, at([0.0]))),
    )
    for kind in ("linear", "cubic"):
        one = data.isel(navigation_time=[2])
        made = hp.geometry.interpolate_pose(one, at([0.01, 0.02, 0.03]), interpolation=kind)  # type: ignore[arg-type]
        assert known(made) == [False, True, False]


def test_clock_offsets_shift_the_line() -> None:
    made = hp.geometry.interpolate_pose(record(), at(SECONDS[:100]), clock_offset_s=0.0375)
    wanted = hp.geometry.interpolate_pose(record(), at(SECONDS[:100] + 0.0375))
    for name in POSE:
        np.testing.assert_allclose(made[name], wanted[name], rtol=0, atol=1e-7)


# --- conventions -------------------------------------------------------------------------------------------

FOREIGN = {
    "roll": {"roll_positive": "right_wing_up"},
    "pitch": {"pitch_positive": "nose_down"},
    "heading": {"heading_positive": "counterclockwise"},
}


@pytest.mark.parametrize("name", FOREIGN)
def test_signs_of_makers(name: str) -> None:
    data = record()
    mirrored = data.assign({name: -data[name]})
    mirrored[name].attrs["units"] = "degree"
    made = hp.geometry.canonical_navigation(mirrored, convention=Convention(**FOREIGN[name]))
    for other in POSE:
        np.testing.assert_allclose(made[other], data[other], rtol=0, atol=1e-12)
    assert Convention.from_attrs(made.attrs) == CANONICAL


@pytest.mark.parametrize("order", ["ZXY", "XYZ"])
def test_orders_of_turning(order: Any) -> None:
    rng = np.random.default_rng(3)
    angles = {"X": rng.uniform(-30, 30, 50), "Y": rng.uniform(-30, 30, 50), "Z": rng.uniform(0, 360, 50)}
    wanted = Rotation.from_euler(order, np.stack([angles[axis] for axis in order], -1), degrees=True)
    made = Convention(euler_order=order).canonical(angles["X"], angles["Y"], angles["Z"])
    found = Rotation.from_euler("ZYX", np.stack(made[::-1], -1), degrees=True)
    assert np.degrees((found * wanted.inv()).magnitude()).max() < 1e-6
    assert np.abs(made[0] - angles["X"]).max() > 0.1


def test_units_references_and_heights() -> None:
    data = record(8)
    radians = data.copy(deep=True)
    for name in ("roll", "pitch", "heading"):
        radians[name] = np.radians(data[name]).assign_attrs(units="radian")
    made = hp.geometry.canonical_navigation(radians, convention=Convention(angle_unit="radian"))
    np.testing.assert_allclose(made["heading"], data["heading"], rtol=0, atol=1e-12)
    assert made["heading"].attrs["units"] == "degree"
    turned = hp.geometry.canonical_navigation(
        data, convention=Convention(heading_reference="magnetic", declination=-7.5)
    )["heading"]
    assert np.abs((turned - data["heading"] + 7.5 + 180) % 360 - 180).max() < 1e-9
    high = Convention(height_reference="geoid", geoid_undulation=-33.2)
    np.testing.assert_allclose(
        hp.geometry.canonical_navigation(data, convention=high).altitude, data.altitude - 33.2
    )
    undeclared, geoid = Convention(heading_reference="magnetic"), Convention(height_reference="geoid")
    canonical = hp.geometry.canonical_navigation
    expect_refusals(
        (SchemaError, ("units-conflict",) * 3, lambda: canonical(radians)),
        (SchemaError, "declination-missing", lambda: canonical(data, convention=undeclared)),
        (SchemaError, "undulation-missing", lambda: canonical(data, convention=geoid)),
    )


def test_headings_from_grid_north() -> None:
    data = record(8, longitude=np.full(8, -79.0))
    gamma = pyproj.Proj("EPSG:32617").get_factors(-79.0, 34.0).meridian_convergence
    assert gamma > 1.0
    for convention, crs in ((Convention(heading_reference="grid"), 32617),
                            (Convention(heading_reference="grid", grid_crs="EPSG:32617"), None)):  # fmt: skip
        made = hp.geometry.canonical_navigation(data, convention=convention, crs=crs)["heading"]
        assert np.abs((made - data["heading"] - gamma + 180) % 360 - 180).max() < 1e-5
    expect_refusals(
        (
            SchemaError,
            "grid-crs-missing",
            lambda: hp.geometry.canonical_navigation(data, convention=Convention(heading_reference="grid")),
        )
    )


def test_conventions_are_stored_with_the_data(tmp_path: Path) -> None:
    convention = Convention(
        roll_positive="right_wing_up", height_reference="geoid", geoid_undulation=-33, stamp_reference="end",
        column_order="right_to_left", grid_crs="EPSG:32617",
    )  # fmt: skip
    data = record(3).assign_attrs(convention.to_attrs())
    data.to_netcdf(tmp_path / "nav.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "nav.nc", engine="h5netcdf") as opened:
        assert Convention.from_attrs(opened.attrs) == convention
    data.to_zarr(tmp_path / "nav.zarr", zarr_format=3, consolidated=False)
    assert Convention.from_attrs(xr.open_zarr(tmp_path / "nav.zarr", consolidated=False).attrs) == convention
    assert Convention.from_attrs({"title": "x"}) is None
    wrong: dict[str, Any] = {"roll_positive": "up", "column_order": 3, "declination": np.nan}
    codes, words = (
        ("choice-unknown", "choice-unknown", "not-finite"),
        (f"{k}={v!r}" for k, v in wrong.items()),
    )
    expect_refusals((SchemaError, codes, *words, lambda: Convention(**wrong)))


@pytest.mark.real_data
def test_a_real_flight_with_every_other_row_left_out(shared_data: Path) -> None:
    rows = np.fromfile(shared_data / "nav" / "ang20170323t202244_eph_att", "<f8").reshape(-1, 7)
    time, lat, lon, alt, pitch, roll, heading = rows.T
    data = record(
        len(rows), 0.1, latitude=lat, longitude=lon, altitude=alt, roll=roll, pitch=pitch, heading=heading
    )
    data = data.assign_coords(navigation_time=at(time - time[0]).values)
    made = hp.geometry.interpolate_pose(
        data.isel(navigation_time=slice(0, None, 2)), at(time - time[0])[1:-1:2], max_gap_s=1
    )
    error = turn_between(made, scipy_rotations(data.isel(navigation_time=slice(1, -1, 2))))
    np.testing.assert_array_less([np.sqrt(np.mean(error**2)), error.max()], [0.006, 0.08])
