"""From where a signature is seen: against cameras turned by rotation matrices, and against traced rays."""

from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation
from support.painted_lines import RAW, TWO, assert_same_bits, made, raw

import hyperpaint as hp
from hyperpaint import Region, extract_signatures
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.schema import LIBRARY_VARIABLES, VARIABLES
from hyperpaint.light.sun import solar_position

ANGLES = ("view_zenith", "view_azimuth", "relative_azimuth")


def with_camera(line: xr.Dataset, *, turned: float = 8.0, heading: float = 100.0) -> xr.Dataset:
    # Return a line with look angles and an attitude that changes from line to line
    rng = np.random.default_rng(1)
    lines, columns = line.sizes["along_track"], line.sizes["cross_track"]
    angles = {
        "roll": turned * rng.standard_normal(lines),
        "pitch": turned * rng.standard_normal(lines),
        "heading": heading + turned * rng.standard_normal(lines),
    }
    line = line.assign_coords({k: ("along_track", v, {"units": "degree"}) for k, v in angles.items()})
    return line.assign(look_angle=("cross_track", np.linspace(-12.0, 20.0, columns), {"units": "degree"}))


def to_camera(line: xr.Dataset, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    # Return the mean unit vector to the camera (east, north, up), by scipy's rotations
    attitude = np.stack([line[name].values[along] for name in ("heading", "pitch", "roll")], axis=1)
    look = np.radians(line["look_angle"].values[across])
    sight = np.stack([np.zeros_like(look), np.sin(look), np.cos(look)], axis=1)
    north, east, down = Rotation.from_euler("ZYX", attitude, degrees=True).apply(sight).T
    mean: np.ndarray = -np.stack([east, north, -down], axis=1).mean(axis=0)
    return mean


def test_the_attitude_of_the_camera() -> None:
    line = with_camera(made())
    library = extract_signatures(line, TWO, exclude=0)
    for region, paint in zip(TWO, library["signature"].values, strict=True):
        along, across = hp.regions.pixels(region, line)
        present = np.isfinite(line.reflectance.values[along, :, across]).any(axis=1)
        east, north, up = to_camera(line, along[present], across[present])
        found = library.sel(signature=paint)
        assert float(found.view_zenith) == pytest.approx(np.degrees(np.arctan2(np.hypot(east, north), up)))
        assert float(found.view_azimuth) == pytest.approx(np.degrees(np.arctan2(east, north)) % 360)
    assert library.attrs["view_geometry"].startswith("look_angle with roll, pitch, heading")


def test_a_level_camera() -> None:
    line = with_camera(made(), turned=0.0, heading=0.0)
    line["look_angle"] = ("cross_track", np.full(16, 10.0), {"units": "degree"})
    library = extract_signatures(line, TWO)
    # what is seen to the right of a flight north lies in the east; the camera is then in the west
    np.testing.assert_allclose(library.view_zenith, 10.0)
    np.testing.assert_allclose(library.view_azimuth, 270.0)
    radians = line.assign(look_angle=("cross_track", np.radians(np.full(16, 10.0)), {"units": "radian"}))
    np.testing.assert_allclose(extract_signatures(radians, TWO).view_zenith, 10.0)
    line = with_camera(made(), turned=0.0)
    line["look_angle"] = ("cross_track", np.linspace(-15.0, 15.0, 16), {"units": "degree"})
    library = extract_signatures(line, Region("whole", [(0, 0), (15, 0), (15, 39), (0, 39)]), exclude=0)
    assert float(library.view_zenith[0]) < 0.5


@pytest.mark.parametrize("chunks", [None, {"along_track": 7}, {"along_track": 16, "cross_track": 4}])
def test_directions_of_the_pixels_come_first(chunks: Any) -> None:
    line = with_camera(made())
    zenith = np.full((40, 16), 30.0, np.float32)
    zenith[line.quality.values > 0] = 80.0  # of pixels that are left out
    dims, attrs = ("along_track", "cross_track"), {"units": "degree"}
    azimuth = np.full((40, 16), 350.0, np.float32)
    line = line.assign(view_zenith=(dims, zenith, attrs), view_azimuth=(dims, azimuth, attrs))
    every = int(np.bitwise_or.reduce(line.quality.values, axis=None))
    library = extract_signatures(line if chunks is None else line.chunk(chunks), TWO, exclude=every)
    np.testing.assert_allclose(library.view_zenith, 30.0, rtol=1e-6)
    np.testing.assert_allclose(library.view_azimuth, 350.0, rtol=1e-6)
    assert library.attrs["view_geometry"] == "view_zenith and view_azimuth of the pixels"
    without = extract_signatures(line.drop_vars("view_azimuth"), TWO, exclude=every)
    np.testing.assert_allclose(without.view_zenith, 30.0, rtol=1e-6)
    assert np.isnan(without.view_azimuth).all()
    assert np.isnan(without.relative_azimuth).all()


def test_what_is_not_known_is_said() -> None:
    plain = extract_signatures(made(), TWO)
    for name in ANGLES:
        assert np.isnan(plain[name]).all()
    assert plain.attrs["view_geometry"] == (
        "unknown: no view_zenith of the pixels, and no look_angle, roll, pitch"
    )
    camera = with_camera(made())
    assert "and no roll" in extract_signatures(camera.drop_vars("roll"), TWO).attrs["view_geometry"]
    camera["pitch"].attrs = {}
    found = extract_signatures(camera, TWO)
    assert np.isnan(found.view_zenith).all()
    assert "'pitch' has no units" in found.attrs["view_geometry"]
    without = extract_signatures(with_camera(made()).drop_vars("heading"), TWO)
    assert np.isfinite(without.view_zenith).all()
    assert np.isnan(without.view_azimuth).all()
    lost = with_camera(made())
    lost["roll"] = lost["roll"].where(False).assign_attrs(units="degree")
    assert np.isnan(extract_signatures(lost, TWO).view_zenith).all()
    grid = posed({"heading_reference": "grid"})
    library, plain = (
        extract_signatures(one, TWO, exclude=0) for one in (grid, posed({}).drop_vars("heading"))
    )
    # without azimuths both are plain means
    np.testing.assert_allclose(library.view_zenith, plain.view_zenith)
    assert np.isnan(library.view_azimuth).all()
    nonsense = posed({}).assign_attrs(convention_roll_positive="sideways")
    assert "sideways" in extract_signatures(nonsense, TWO, exclude=0).attrs["view_geometry"]


def test_sun_and_camera() -> None:
    line = raw()
    with dask.config.set(scheduler="synchronous"):
        library = extract_signatures(line, RAW)
    at = line.time.values[20], float(line.latitude[20]), float(line.longitude[20])
    azimuth = float(solar_position(*at)[1])
    apart = np.abs((library.view_azimuth.values - azimuth + 180) % 360 - 180)
    np.testing.assert_allclose(library.relative_azimuth, apart, atol=0.05)
    assert ((library.relative_azimuth >= 0) & (library.relative_azimuth <= 180)).all()
    assert (library.view_zenith < 2.0).all()
    for name, standard in (
        ("sun_zenith", "solar_zenith_angle"),
        ("sun_azimuth", "solar_azimuth_angle"),
        ("view_zenith", "sensor_zenith_angle"),
        ("view_azimuth", "sensor_azimuth_angle"),
    ):
        assert library[name].attrs["standard_name"] == standard
        assert library[name].attrs["units"] == LIBRARY_VARIABLES[name].units == "degree"
    assert_same_bits(library, extract_signatures(line.chunk(along_track=7), RAW))


@pytest.mark.slow
def test_look_angles_come_with_the_calibration(tmp_path: Path) -> None:
    collect = hp.simulate_collect(
        tmp_path / "raw", lines=32, bands=12, columns=16, scene="plan", truth=False, cubes=1
    )
    line = hp.open_store(hp.process(collect, tmp_path / "lot.zarr"), "flightlines/raw_0")
    assert line.look_angle.dtype == VARIABLES["look_angle"].dtype
    # 7.4 um at 12 mm
    np.testing.assert_allclose(np.tan(np.radians(line.look_angle)), (np.arange(16) - 7.5) * 7.4e-6 / 12e-3)
    library = extract_signatures(line, Region("right", [(12, 2), (15, 2), (15, 20), (12, 20)]), exclude=0)
    assert np.isfinite(library.view_zenith).all()


@pytest.mark.slow
def test_traced_rays_come_from_there() -> None:
    from hyperpaint.simulation.rendering.platforms import pushbroom
    from hyperpaint.simulation.rendering.scene import plane
    from hyperpaint.workflows.rendering import look_angle_of, pose_of

    flight = pushbroom(16, 24, altitude=20.0, ground_sample=0.6, line_spacing=0.3, heading=30.0, wobble=5.0)
    traced = hp.simulation.trace(plane(200.0), flight, ["noon"], samples=64).compute()
    cube = (("along_track", "band", "cross_track"), np.full((16, 2, 24), 0.3, "f4"), {"units": "1"})
    line = xr.Dataset(
        {"reflectance": cube, "look_angle": look_angle_of(flight)},
        {"wavelength": ("band", [500.0, 600.0], {"units": "nm"}), **pose_of(flight)},
    )
    region = Region("left", [(1, 4), (3, 4), (3, 6), (1, 6)])
    library = extract_signatures(line, region, exclude=0)
    along, across = hp.regions.pixels(region, line)
    camera = flight.origin.mean(axis=1)[along]
    seen = np.stack([traced[name].values[along, across] for name in ("east", "north", "up")], axis=1)
    away = camera - seen
    east, north, up = (away / np.linalg.norm(away, axis=1, keepdims=True)).mean(axis=0)
    zenith, azimuth = np.degrees([np.arctan2(np.hypot(east, north), up), np.arctan2(east, north)])
    # the middle of 64 rays through a pixel of 1.7 degrees
    assert float(library.view_zenith[0]) == pytest.approx(zenith, abs=0.1)
    assert float(library.view_azimuth[0]) == pytest.approx(azimuth % 360, abs=0.5)


CONVENTIONS = {
    "canonical": {},
    "roll": {"roll_positive": "right_wing_up"},
    "pitch": {"pitch_positive": "nose_down"},
    "heading": {"heading_positive": "counterclockwise"},
    "order": {"euler_order": "ZXY"},
    "all": {"roll_positive": "right_wing_up", "pitch_positive": "nose_down", "euler_order": "XYZ"},
    "magnetic": {"heading_reference": "magnetic", "declination": -6.5},
    "grid": {"heading_reference": "grid", "grid_crs": "EPSG:32616"},
}


def posed(declared: dict[str, Any], *, mounted: tuple[float, ...] = (0.0, 0.0, 0.0)) -> xr.Dataset:
    # Return a line with poses, and the angles that its calibration and a table of the camera have
    line = with_camera(made(), heading=70.0)
    place = {
        "latitude": (34.0, "degrees_north"),
        "longitude": (-81.0, "degrees_east"),
        "altitude": (300.0, "m"),
    }
    line = line.assign_coords(
        {
            name: ("along_track", np.full(40, value), {"units": units})
            for name, (value, units) in place.items()
        }
    )
    convention = Convention(**declared)
    return line.assign_attrs(convention.to_attrs(), ground=0.0, boresight=list(mounted))


@pytest.mark.parametrize("mounted", [(0.0, 0.0, 0.0), (2.0, -3.0, 5.0)])
@pytest.mark.parametrize("declared", CONVENTIONS)
@pytest.mark.parametrize("table", ["look_angle", "look_along"])
def test_a_line_is_seen_from_where_its_located_self_is(
    declared: str, mounted: tuple[float, ...], table: str
) -> None:
    pytest.importorskip("pyproj")
    line = posed(CONVENTIONS[declared], mounted=mounted)
    angles: dict[str, Any] = {}
    if table != "look_angle":
        # of [geometry]: goes before what the calibration says
        angles["look_across"] = ("cross_track", np.linspace(9.0, 31.0, 16), {"units": "degree"})
    if table == "look_along":
        angles["look_along"] = ("cross_track", np.linspace(1.0, 2.0, 16), {"units": "degree"})
    line = line.assign_coords(angles)
    seen, located = (extract_signatures(one, TWO, exclude=0) for one in (line, hp.geometry.locate(line)))
    # the earth is round: over 100 m its vertical turns by a thousandth of a degree
    np.testing.assert_allclose(seen.view_zenith, located.view_zenith, atol=0.003)
    apart = np.abs((seen.view_azimuth - located.view_azimuth + 180.0) % 360.0 - 180.0)
    assert float((apart * np.sin(np.radians(located.view_zenith))).max()) < 0.003
    assert ("boresight" in seen.attrs["view_geometry"]) == any(mounted)
