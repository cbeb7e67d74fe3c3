"""Collects flown over a rendered car park: what their files, their truth and their regions hold."""

import itertools
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from click.testing import CliRunner, Result
from support.folders import contents
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.cli.program import main
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line
from hyperpaint.simulation.collect import PaintedRectangles
from hyperpaint.simulation.flight import Lines, PlanFlight
from hyperpaint.simulation.rendering.scene_spectra import MATERIALS

# --- rendered collect ---

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


@pytest.mark.slow
def test_same_seed_same_bytes_whatever_the_blocks(tmp_path: Path, collect: Path) -> None:
    first = contents(collect)  # in blocks of 32 lines
    made = simulate_collect(tmp_path / "7", **SMALL, cubes=2, dropped=[30, 31], block_lines=7)
    assert contents(made.parent) == first
    other = simulate_collect(tmp_path / "seed", **{**SMALL, "seed": 8, "lines": 25}, truth=False).parent
    assert contents(other)["flight/raw_0"] != first["flight/raw_0"]


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
    # glint is marked where it adds light
    glint = truth["glint"].values
    assert 0 < glint.sum() < 0.05 * glint.size
    assert glint[cars].mean() > 5 * glint[~cars].mean()


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
    # neighbours can be left out
    assert not {"leaf", "brick", "bark"} & set(
        simulate_line(**SMALL, neighbours=False)["surface"].attrs["flag_meanings"].split()
    )


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


def test_more_samples_are_less_noise() -> None:
    size = {**SMALL, "lines": 12, "noise": False, "quantise": False, "coat": False, "neighbours": False}
    best = simulate_line(**{**size, "samples": 256})["true_reflectance"].values
    error = [
        np.abs(simulate_line(**{**size, "samples": number})["true_reflectance"].values - best).mean()
        for number in (4, 64)
    ]
    assert error[1] < 0.5 * error[0]


def test_a_flight_too_long_to_render_is_refused(tmp_path: Path) -> None:
    expect_error(
        SchemaError, "flight-too-long", lambda: simulate_collect(tmp_path / "new", lines=512, columns=2)
    )
    assert not (tmp_path / "new").exists()


def test_rendered_is_what_is_simulated_unless_told(tmp_path: Path) -> None:
    assert "east" not in simulate_line(lines=4, bands=3, columns=8)
    size = ["--lines", "6", "--bands", "4", "--columns", "16"]
    asked = ["--samples", "2", "--atmosphere", "overcast"]
    asked += ["--set", "coat=no", "--set", "neighbours=no"]
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "sim"), *size, *asked])
    assert done.exit_code == 0, done.output
    made = xr.open_zarr(tmp_path / "sim" / "truth.zarr")
    assert "east" in made
    assert not made["glint"].any()
    assert "leaf" not in made["surface"].attrs["flag_meanings"]
    wrong = CliRunner().invoke(main, ["simulate", str(tmp_path / "no"), "--scene", "3d"])
    assert wrong.exit_code == 2
    assert "rendered" in wrong.stderr


# --- painted regions ---

SIZE: dict[str, Any] = {"lines": 96, "bands": 40, "columns": 160, "samples": 8, "seed": 3, "fleet": "solid"}
DROPPED = [30, 60, 61, 150]


def run(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A rendered collect of two cubes, in the middle of which frames were dropped
    folder = tmp_path_factory.mktemp("rendered")
    return simulate_collect(
        folder, lines=200, bands=6, columns=240, samples=6, seed=3, cubes=2, dropped=DROPPED, fleet="solid"
    ).parent


def boxes(folder: Path) -> dict[str, tuple[str, tuple[slice, slice]]]:
    # Return flight line and pixels of every region, edges included
    made = {}
    for region in hp.read_regions(folder / "regions.geojson"):
        (left, first), (right, last) = region.polygon.min(axis=0), region.polygon.max(axis=0)
        assert set(map(tuple, region.polygon)) == {(x, y) for x in (left, right) for y in (first, last)}
        made[region.name] = (
            region.flightline,
            (slice(int(first), int(last) + 1), slice(int(left), int(right) + 1)),
        )
    return made


def truth_of(folder: Path, dropped: list[int]) -> dict[str, xr.Dataset]:
    # Return the truth of each flight line, without the frames that were never recorded
    known = xr.open_zarr(folder / "truth.zarr").drop_vars(["radiance", "reflectance"]).load()
    frames = np.setdiff1d(np.arange(known.sizes["along_track"]), dropped)
    starts = [int(path.stem.removeprefix("raw_")) for path in folder.glob("flight/raw_*.hdr")]
    bounds = [*sorted(starts), known.sizes["along_track"]]
    return {
        f"raw_{first}": known.isel(along_track=frames[(frames >= first) & (frames < last)])
        for first, last in itertools.pairwise(bounds)
    }


@pytest.mark.slow
def test_regions_lie_on_their_paint(rendered: Path) -> None:
    lines = truth_of(rendered, DROPPED)
    found = boxes(rendered)
    assert len(found) >= 3
    for name, (flightline, (along, across)) in found.items():
        shown = lines[flightline].isel(along_track=along, cross_track=across)
        assert min(shown.sizes["along_track"], shown.sizes["cross_track"]) >= 4
        assert (shown["paint_id"] == shown["paint_id"].attrs["flag_meanings"].split().index(name)).all()
        assert len(np.unique(shown["car_id"])) == 1
        assert (shown["purity"] == 1).all()
        assert (shown["shadow"] == 0).all()
        assert not shown["glint"].any()
        # roofs, bonnets and boots, nearly level as a whole
        assert float(shown["up"].min()) > 0.5
        flat = shown["up"].values
        rise = [np.ptp(flat.mean(axis=1)), np.ptp(flat.mean(axis=0))]
        assert (rise < 0.1 * (16 / 240 * np.array([flat.shape[0] - 1, flat.shape[1] - 1]))).all()


def test_regions_say_what_is_known(rendered: Path) -> None:
    for region in hp.read_regions(rendered / "regions.geojson"):
        assert (rendered / "svc" / f"{region.properties['reference']}.sig").is_file()
        assert (region.properties["reference"], region.properties["finish"]) == (region.name, "solid")
        assert region.properties["colour"]


@pytest.mark.slow
def test_simulate_process_signatures_validate_without_a_drawing(tmp_path: Path) -> None:
    size = [text for name, value in SIZE.items() if name != "fleet" for text in (f"--{name}", value)]
    size += ["--set", f"fleet={SIZE['fleet']}"]
    assert run("simulate", tmp_path / "sim", *size).exit_code == 0
    assert run("process", tmp_path / "sim" / "collect.toml", "--out", tmp_path / "lot.zarr").exit_code == 0
    regions = tmp_path / "sim" / "regions.geojson"
    done = run(
        "signatures", tmp_path / "lot.zarr", *(("--regions", regions, "--out", tmp_path / "paints.zarr"))
    )
    assert done.exit_code == 0, done.output
    done = run("validate", tmp_path / "paints.zarr", "--require-all")
    assert done.exit_code == 0, done.output
    paints = hp.open_store(tmp_path / "paints.zarr")
    assert tuple(paints["signature"].values) == hp.read_regions(regions).names
    assert float(paints["n"].min()) >= 12
    assert f"{paints.sizes['signature']} of {paints.sizes['signature']} paints compared" in done.stdout


def test_same_bytes_whatever_the_blocks(tmp_path: Path) -> None:
    size = {**SIZE, "scene": "plan", "bands": 4, "cubes": 2, "dropped": 3}
    made = [
        simulate_collect(tmp_path / str(block), **size, block_lines=block, truth=block > 10).parent
        for block in (7, 500)
    ]
    first, second = ((folder / "regions.geojson").read_bytes() for folder in made)
    assert first == second
    assert json.loads(first)["features"]


def test_regions_of_a_plan_show_one_surface_unless_pixels_are_too_coarse(tmp_path: Path) -> None:
    folder = simulate_collect(
        tmp_path / "fine", scene="plan", lines=120, bands=4, columns=160, cubes=2, dropped=4, glint=0.01
    ).parent
    known = xr.open_zarr(folder / "truth.zarr")
    lines = truth_of(folder, np.flatnonzero(known["no_data"]).tolist())
    names = known["surface"].attrs["flag_meanings"].split()
    found = boxes(folder)
    assert found
    for name, (flightline, (along, across)) in found.items():
        shown = lines[flightline].isel(along_track=along, cross_track=across)
        assert (shown["surface"] == names.index(name)).all()
        assert not shown["glint"].any()
    # none where pixels are too coarse
    coarse = simulate_collect(tmp_path / "coarse", scene="plan", lines=40, bands=4, columns=24).parent
    assert len(hp.read_regions(coarse / "regions.geojson")) == 0


def test_squares_of_a_checkerboard(tmp_path: Path) -> None:
    folder = simulate_collect(
        tmp_path, scene="checkerboard", swath=4, square=0.5, lines=60, bands=4, columns=100
    ).parent
    known = xr.open_zarr(folder / "truth.zarr")
    found = boxes(folder)
    assert set(found) == {"panel_05", "panel_50"}
    for name, (_, (along, across)) in found.items():
        assert (
            known["bright_share"].isel(along_track=along, cross_track=across) == (name == "panel_50")
        ).all()


class _Painted(PlanFlight):
    # A flight that sees what it is told
    def clean_paint(self, lines: Lines) -> np.ndarray[Any, np.dtype[np.int32]]:
        return lines.surface.astype(np.int32)


def _found(label: Any, up: Any = None) -> list[dict[str, Any]]:
    # Return the regions of a picture of labels
    label = np.asarray(label, np.int16)
    flight = _Painted(SimulationSettings(lines=label.shape[0], bands=2, columns=label.shape[1], scene="plan"))
    none = np.empty((0,), np.float32)
    layers = {} if up is None else {"up": np.asarray(up)}
    rectangles = PaintedRectangles(flight)
    rectangles.begin("raw_0")
    rectangles.add(
        Lines(label, np.zeros(label.shape, bool), none, none, none, layers), np.ones(len(label), bool)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "regions.geojson"
        rectangles.write(path, "a test")
        features: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))["features"]
    return features


def test_the_largest_rectangle_is_that_of_all_rectangles() -> None:
    # Against a search of all of them, on pictures of blots
    rng = np.random.default_rng(5)
    for _ in range(4):
        label = np.full((26, 30), -1)
        for _ in range(5):
            top, left, tall, wide = rng.integers([0, 0, 5, 5], [20, 22, 16, 20])
            label[top : top + tall, left : left + wide] = rng.integers(0, 2)
        found = {each["properties"]["name"]: each["geometry"]["coordinates"][0] for each in _found(label)}
        for number, name in enumerate(PlanFlight.paints[:2]):
            sizes = [
                (
                    tall - 2 * max(1, min(tall, wide) // 8),
                    wide - 2 * max(1, min(tall, wide) // 8),
                    tall * wide,
                )
                for tall in range(6, 27)
                for wide in range(6, 31)
                if np.lib.stride_tricks.sliding_window_view(label == number, (tall, wide))
                .all(axis=(2, 3))
                .any()
            ]
            assert (name in found) == bool(sizes)
            if sizes:
                (left, first), _, (right, last), *_ = found[name]
                assert (last - first + 1, right - left + 1) in {
                    (tall, wide) for tall, wide, area in sizes if area == max(size[2] for size in sizes)
                }


def test_a_step_in_height_or_another_car_ends_a_rectangle() -> None:
    same = np.zeros((12, 20), int)
    (whole,) = _found(same)
    assert whole["geometry"]["coordinates"] == [[[1, 1], [18, 1], [18, 10], [1, 10], [1, 1]]]
    (part,) = _found(same, np.where(np.arange(20) < 7, 0.0, 1.0) * np.ones((12, 1)))
    assert part["geometry"]["coordinates"] == [[[8, 1], [18, 1], [18, 10], [8, 10], [8, 1]]]
    assert _found(same + np.where(np.arange(20) < 7, 0, len(PlanFlight.paints))) == [part]
    (below,) = _found(same, np.where(np.arange(12)[:, None] < 5, 0.0, 1.0) * np.ones((1, 20)))
    assert below["geometry"]["coordinates"][0][:2] == [[1, 6], [18, 6]]
