"""Collects flown over a rendered car park: what their files and their truth hold."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from click.testing import CliRunner

from hyperpaint.base.errors import SchemaError
from hyperpaint.cli.program import main
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line
from hyperpaint.simulation.rendered_flight import RenderedFlight
from hyperpaint.simulation.rendering.scene_spectra import MATERIALS

SMALL: dict[str, Any] = {
    "scene": "rendered",
    "fleet": "solid",
    "lines": 50,
    "bands": 10,
    "columns": 40,
    "samples": 4,
    "seed": 7,
}


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A small rendered collect of two cubes with dropped frames
    return simulate_collect(tmp_path_factory.mktemp("rendered"), **SMALL, cubes=2, dropped=[30, 31]).parent


@pytest.fixture(scope="module")
def truth(collect: Path) -> xr.Dataset:
    return xr.open_zarr(collect / "truth.zarr").load()


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    # A line without noise, with the irradiance that every element saw itself, in light that stands still
    return simulate_line(**SMALL, matched=True, noise=False, quantise=False, drift_per_minute=0.0)


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_rendered_is_what_is_simulated_unless_told(tmp_path: Path) -> None:
    made = simulate_collect(
        tmp_path / "sim", lines=4, bands=3, columns=8, samples=1, fleet="solid", neighbours=False
    ).parent
    assert "east" in xr.open_zarr(made / "truth.zarr")
    assert "east" not in simulate_line(lines=4, bands=3, columns=8)


@pytest.mark.slow
def test_same_seed_same_bytes_whatever_the_blocks(tmp_path: Path, collect: Path) -> None:
    first = digests(collect)  # in blocks of 32 lines
    made = simulate_collect(tmp_path / "7", **SMALL, cubes=2, dropped=[30, 31], block_lines=7)
    assert digests(made.parent) == first
    other = simulate_collect(tmp_path / "seed", **{**SMALL, "seed": 8, "lines": 25}, truth=False).parent
    assert digests(other)["flight/raw_0"] != first["flight/raw_0"]


def test_layers_of_truth(truth: xr.Dataset) -> None:
    expected = {
        "surface": np.int16, "surface_class": np.int16, "paint_id": np.int16, "car_id": np.int32,
        "purity": np.float32, "shadow": np.float32, "east": np.float64, "north": np.float64, "up": np.float64,
        "height": np.float64,
        "glint": np.bool_, "saturated": np.bool_,
    }  # fmt: skip
    for name, dtype in expected.items():
        assert (truth[name].dims, truth[name].dtype) == (("along_track", "cross_track"), dtype), name
    for name in ("purity", "shadow"):
        assert truth[name].attrs["units"] == "1"
        assert 0.0 <= float(truth[name].min()) < float(truth[name].max()) <= 1.0
    for name in ("east", "north", "height", "up"):
        assert truth[name].attrs["units"] == "m"
        assert np.isfinite(truth[name].values).all()
    painted, cars = truth["paint_id"].values >= 0, truth["car_id"].values >= 0
    assert painted.any()
    assert cars[painted].all()  # what is painted belongs to a car
    assert cars.sum() > painted.sum()  # which has glass and tyres, too
    assert truth["up"].values[painted].mean() > 0.5
    assert abs(np.median(truth["up"].values[~cars])) < 0.2
    json.dumps(truth["surface_class"].attrs)


def test_surfaces_are_named_as_their_spectra(truth: xr.Dataset) -> None:
    paints = truth["paint_id"].attrs["flag_meanings"].split()
    kinds = truth["surface_class"].attrs["flag_meanings"].split()
    painted = truth["paint_id"].values >= 0
    surface = np.array(truth["surface"].attrs["flag_meanings"].split())[truth["surface"].values]
    assert (surface[painted] == np.array(paints)[truth["paint_id"].values[painted]]).all()
    assert (np.array(kinds)[truth["surface_class"].values[painted]] == "paint").all()
    assert (surface[~painted & (truth["surface_class"].values == kinds.index("asphalt"))] != "paint").all()
    assert {"asphalt", "painted_line"} <= set(surface[~painted])


def test_pixels_lie_where_the_navigation_file_says(collect: Path, truth: xr.Dataset) -> None:
    # Rationale: the wobble is in the pixels, so that georeferencing can be judged by where they really are
    # Expected: rays from the logged position and attitude, cut with the height of the pixel, hit it; in the
    # mean over pixels within a tenth of one, and each to what the mean of four samples spreads
    rows = [line.split("\t") for line in (collect / "flight" / "imu_gps.txt").read_text().splitlines()[1:]]
    log = np.array([row[:7] for row in rows], dtype=np.float64)
    frame, stamp = np.array(
        [line.split("\t") for line in (collect / "flight" / "frameIndex_0.txt").read_text().splitlines()[1:]],
        dtype=np.int64,
    ).T
    roll, pitch, yaw, lat, lon, alt = (np.interp(stamp - 2500, log[:, 6], log[:, k]) for k in range(6))
    local = "+proj=aeqd +lat_0=43.0845 +lon_0=-77.6749 +ellps=WGS84"
    from_map = pyproj.Transformer.from_crs(truth.attrs["crs"], local, always_xy=True)
    camera = pyproj.Transformer.from_crs("EPSG:4326", local, always_xy=True).transform(lon, lat)
    tangent = (np.arange(40) - 19.5) * (7.4e-6 / 12e-3)
    errors = []
    for n, line in enumerate(frame):
        r, p, h = np.radians([roll[n], pitch[n], yaw[n]])
        about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
        about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
        about_z = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
        looks = (
            about_z @ about_y @ about_x @ np.stack([np.zeros(40), tangent, np.ones(40)])
        )  # north east down
        one = truth.isel(along_track=line)
        reach = (alt[n] - 160.0 - one["up"].values) / looks[2]
        east, north = camera[0][n] + reach * looks[1], camera[1][n] + reach * looks[0]
        seen = np.stack(from_map.transform(one["east"].values, one["north"].values))
        flat = np.abs(one["up"].values - np.median(one["up"].values)) < 0.01
        errors.append((seen - np.stack([east, north]))[:, flat])
    error = np.concatenate(errors, axis=1)
    pixel = 16.0 / 40
    assert error.shape[1] > 200
    assert np.abs(error.mean(axis=1)).max() < 0.1 * pixel
    assert np.abs(error).max() < 0.75 * pixel
    assert np.ptp(truth["east"].values[:, 20]) > 0.2 * pixel  # it does wobble


def test_counts_are_what_radiance_gain_and_noise_make(collect: Path, truth: xr.Dataset) -> None:
    calibration = xr.open_zarr(collect / "calibration.zarr").load()
    counts = np.concatenate(
        [np.fromfile(collect / "flight" / name, "<u2").reshape(-1, 10, 40) for name in ("raw_0", "raw_25")]
    ).astype(float)
    dark = np.fromfile(collect / "dark" / "raw_0", "<u2").reshape(-1, 10, 40).mean(axis=0)
    recorded = ~truth["no_data"].values
    wanted = truth["radiance"].values[recorded] * 5e-3 / calibration["radiance_gain"].values
    usable = counts < 4095
    z = ((counts - dark - wanted) / np.sqrt(wanted / 20 + 0.25 + 1 / 12 + 0.34 / 64))[usable]
    assert (z.mean(), z.std()) == (pytest.approx(0.0, abs=0.06), pytest.approx(1.0, abs=0.03))
    np.testing.assert_array_equal((~usable).any(axis=1), truth["saturated"].values[recorded])
    assert usable.mean() > 0.99


def test_closure_of_float_counts(line: xr.Dataset) -> None:
    # Counts lead to the truth, and pi L / E with the light that each element saw is its reflectance
    radiance = (line["counts"] - line["dark_counts"]) * line["radiance_gain"] / line["exposure_time"]
    np.testing.assert_allclose(radiance, line["true_radiance"], rtol=2e-5, atol=5e-9)  # beside 110 of dark
    light = line["matched_irradiance"].values[0]
    np.testing.assert_allclose(np.pi * line["true_radiance"] / light, line["true_reflectance"], rtol=1e-5)


def test_sunlit_level_ground_reflects_what_its_spectrum_says() -> None:
    # Panels lie open in the aisle: neighbours take a few per cent of the sky, and the sun is theirs
    line = simulate_line(**{**SMALL, "columns": 160}, noise=False, quantise=False)
    names = line["surface"].attrs["flag_meanings"].split()
    lit = (line["true_shadow"].values == 0) & (line["true_purity"].values == 1)
    for level in (5, 20, 50, 90):
        here = lit & (line["surface"].values == names.index(f"panel_{level:02d}"))
        assert here.any(), "no panel is in view"
        seen = line["true_reflectance"].transpose(..., "band").values[here].mean(axis=0)
        np.testing.assert_allclose(seen, level / 100, rtol=0.08)
        assert (seen < 1.05 * level / 100).all()
    here = lit & (line["surface"].values == names.index("asphalt"))
    seen = line["true_reflectance"].transpose(..., "band").values[here].mean(axis=0)
    np.testing.assert_allclose(seen, MATERIALS["asphalt"](line["wavelength"].values), rtol=0.1)


def test_shadow_is_skylight_only(line: xr.Dataset) -> None:
    # In full shadow the light is blue: less is lost where the sky is bright
    asphalt = (line["surface"].values == line["surface"].attrs["flag_meanings"].split().index("asphalt")) & (
        line["true_purity"].values == 1
    )
    seen = line["true_reflectance"].transpose(..., "band").values
    ratio = seen[asphalt & (line["true_shadow"].values == 1)].mean(axis=0) / seen[
        asphalt & (line["true_shadow"].values == 0)
    ].mean(axis=0)
    assert (ratio < 0.35).all()
    assert ratio[1] > 1.5 * ratio[-1]


def test_sky_and_sun_keep_their_own_course_in_time() -> None:
    # A cloud that takes all of the sun leaves shadows as they were but for the light that it scatters
    size = {**SMALL, "noise": False, "quantise": False, "drift_per_minute": 0.0, "coat": False}
    clear, cloudy = (simulate_line(**size, cloud=cloud) for cloud in (None, (0.6, 0.001, -1.0)))
    ratio = (cloudy["true_radiance"] / clear["true_radiance"]).transpose(..., "band").values
    lit, dark = (clear["true_shadow"].values == level for level in (0, 1))
    assert ratio[lit].mean() < 0.6
    # direct light is 0.4 of what it was, diffuse 1.2
    assert ((ratio > 0.4 - 1e-5) & (ratio < 1.2 + 1e-5)).all()
    assert np.median(ratio[dark]) > 1.0


def test_coats_mirror_the_sun_and_lambert_paint_does_not() -> None:
    size = {**SMALL, "noise": False, "quantise": False, "columns": 80}
    coated, bare = (simulate_line(**size, coat=coat) for coat in (True, False))
    paint = coated["true_paint_id"].values >= 0
    assert coated["true_reflectance"].transpose(..., "band").values[paint].max() > 1.0
    assert bare["true_reflectance"].transpose(..., "band").values[paint].max() < 1.0
    np.testing.assert_array_equal(coated["true_east"], bare["true_east"])


def test_glint_is_marked_where_it_adds_light(truth: xr.Dataset) -> None:
    glint = truth["glint"].values
    car = truth["car_id"].values >= 0
    assert 0 < glint.sum() < 0.05 * glint.size
    assert glint[car].mean() > 5 * glint[~car].mean()


@pytest.mark.parametrize("sky", ["overcast", "near_sunset"])
def test_skies(sky: str, line: xr.Dataset) -> None:
    other = simulate_line(**SMALL, noise=False, quantise=False, drift_per_minute=0.0, sky=sky)
    # each at the hour of its sun
    light, usual = (each["irradiance"].mean("irradiance_time").values for each in (other, line))
    light = light / usual
    if sky == "overcast":
        assert ((light > 0.19) & (light < 0.4)).all()
        assert light[100] > light[600]  # clouds are slightly bluer
        assert other["true_reflectance"].max() < line["true_reflectance"].max()
    else:
        assert ((light > 0.0) & (light < 0.2)).all()
        assert light[500] > light[100]  # the low sun is redder
        assert other["true_shadow"].mean() > line["true_shadow"].mean() + 0.1


def test_neighbours_can_be_left_out() -> None:
    assert not {"leaf", "brick", "bark"} & set(
        simulate_line(**SMALL, neighbours=False)["surface"].attrs["flag_meanings"].split()
    )


def test_more_samples_are_less_noise() -> None:
    size = {**SMALL, "lines": 12, "noise": False, "quantise": False, "coat": False, "neighbours": False}
    best = simulate_line(**{**size, "samples": 256})["true_reflectance"].values
    error = [
        np.abs(simulate_line(**{**size, "samples": number})["true_reflectance"].values - best).mean()
        for number in (4, 64)
    ]
    assert error[1] < 0.5 * error[0]


@pytest.mark.parametrize(
    "wrong",
    [{"scene": "3d"}, {"samples": 0}, {"samples": 2.5}, {"sky": "blue"}, {"coat": 1}, {"neighbours": None},
     {"sun_azimuth": 400.0}],
    ids=str,
)  # fmt: skip
def test_wrong_settings_are_refused_before_anything_is_written(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(SchemaError, match=next(iter(wrong))):
        simulate_collect(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_a_flight_too_long_to_render_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="flight-too-long"):
        simulate_collect(tmp_path / "new", lines=512, columns=2)
    assert not (tmp_path / "new").exists()


def test_memory_is_used_again_without_a_trace() -> None:
    flight = RenderedFlight(SimulationSettings(**SMALL))
    fresh = flight.lines(32, 50).radiance.copy()
    np.testing.assert_array_equal(flight.lines(32, 50, into=flight.lines(0, 32)).radiance, fresh)


def test_command_line(tmp_path: Path) -> None:
    size = ["--lines", "6", "--bands", "4", "--columns", "16"]
    asked = ["--scene", "rendered", "--samples", "2", "--atmosphere", "overcast"]
    asked += ["--set", "coat=no", "--set", "neighbours=no"]
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "sim"), *size, *asked])
    assert done.exit_code == 0, done.output
    made = xr.open_zarr(tmp_path / "sim" / "truth.zarr")
    assert not made["glint"].any()
    assert "leaf" not in made["surface"].attrs["flag_meanings"]
    wrong = CliRunner().invoke(main, ["simulate", str(tmp_path / "no"), "--scene", "3d"])
    assert wrong.exit_code == 2
    assert "rendered" in wrong.stderr
