"""The files of a simulated collect, read back with code of the test's own, and the effect of every switch."""

import datetime as dt
import re
import struct
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.folders import contents
from support.refusals import expect_error, expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.base.schema import SWEEP_VARIABLES
from hyperpaint.cli.program import main
from hyperpaint.simulation import (
    SimulationSettings,
    SweepSettings,
    simulate_collect,
    simulate_line,
    simulate_sweep,
    write_sweep,
)
from hyperpaint.simulation.atmosphere import Sky
from hyperpaint.simulation.camera import convolve_gaussian, nominal_responsivity
from hyperpaint.simulation.flight import Checkerboard, CheckerboardFlight, PlanFlight
from hyperpaint.simulation.instruments import SVC_DETECTORS, SVC_WAVELENGTH
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, MATERIALS, reflectance
from hyperpaint.simulation.settings import PIXEL_ANGLE_RAD

# --- simulate collect ---

SMALL: dict[str, Any] = {"scene": "plan", "lines": 70, "bands": 12, "columns": 10, "seed": 7}
SECOND = np.timedelta64(1, "s")


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect of three cubes with dropped frames and bad elements
    folder = tmp_path_factory.mktemp("simulated")
    return simulate_collect(folder, **SMALL, cubes=3, dropped=[30, 31, 44], bad_elements=3, glint=0.05).parent


def header(path: Path) -> tuple[dict[str, str], dict[str, str]]:
    # Read an ENVI header that holds nothing surprising: keys, and keys of the comment lines
    text = path.read_text()
    assert text.startswith("ENVI\n")
    comments = dict(
        (part.strip() for part in line[1:].split("=", 1))
        for line in text.splitlines()
        if line.startswith(";")
    )
    keys: dict[str, str] = {}
    lines = iter(line for line in text.splitlines()[1:] if not line.startswith(";"))
    for line in lines:
        key, value = (part.strip() for part in line.split("=", 1))
        while value.startswith("{") and "}" not in value:
            value += next(lines)
        keys[key] = value.strip("{} ")
    return keys, comments


def cube(path: Path) -> np.ndarray:
    keys, _ = header(path.with_name(path.name + ".hdr"))
    shape = tuple(int(keys[key]) for key in ("lines", "bands", "samples"))
    assert path.stat().st_size == 2 * np.prod(shape)
    return np.fromfile(path, dtype="<u2").reshape(shape)


def table(path: Path) -> list[dict[str, str]]:
    first, *rows = path.read_text().splitlines()
    return [dict(zip(first.split("\t"), row.split("\t"), strict=True)) for row in rows]


def test_headers_cubes_and_toml_of_a_collect(collect: Path) -> None:
    keys, comments = header(collect / "flight" / "raw_0.hdr")
    assert {
        "data type": "12",
        "interleave": "bil",
        "byte order": "0",
        "header offset": "0",
        "bands": "12",
    }.items() <= keys.items()
    assert keys["wavelength units"] == "nm"
    np.testing.assert_allclose(
        np.array(keys["wavelength"].split(","), dtype=float), np.linspace(399.356, 1001.42, 12), atol=5e-4
    )
    assert comments["Exposure (ms)"] == "5.0"
    assert "\n," in (collect / "flight" / "raw_0.hdr").read_text()
    settings = dict(
        line.split(" = ") for line in (collect / "flight" / "settings.txt").read_text().splitlines()
    )
    assert settings["Exposure (ms)"] == "5.0"
    # cubes hold the frames that were recorded
    numbers = [int(path.stem[4:]) for path in sorted((collect / "flight").glob("raw_*.hdr"))]
    assert sorted(numbers) == [0, 23, 46]
    frames = []
    for number in sorted(numbers):
        rows = table(collect / "flight" / f"frameIndex_{number}.txt")
        frames += [int(row["Frame#"]) for row in rows]
        assert len(rows) == len(cube(collect / "flight" / f"raw_{number}"))
    assert sorted(set(range(70)) - set(frames)) == [30, 31, 44]
    np.testing.assert_array_equal(
        np.flatnonzero(xr.open_zarr(collect / "truth.zarr").load()["no_data"]), [30, 31, 44]
    )
    document = tomllib.loads((collect / "collect.toml").read_text())
    assert [line["id"] for line in document["flightlines"]] == ["raw_0", "raw_23", "raw_46"]
    for line in document["flightlines"]:
        for key in ("cube", "frame_index", "nav"):
            assert (collect / line[key]).is_file()
    assert (collect / document["dark"]["cubes"][0]).is_file()
    assert document["camera"] == {
        "bit_depth": 12, "exposure_time_ms": 5.0, "frame_period_ms": 7.0, "stamp": "end",
    }  # fmt: skip
    assert document["irradiance"]["clock_offset_s"] == 37.25


def test_frame_stamps_lead_to_the_middle_of_each_exposure(collect: Path) -> None:
    rows = table(collect / "flight" / "imu_gps.txt")
    assert " ".join(rows[0]) == "Roll Pitch Yaw Lat Lon Alt Timestamp Gps_UTC_Date&Time Status Heading"
    stamps = np.array([int(row["Timestamp"]) for row in rows])
    assert set(np.diff(stamps)) == {10_000}
    utc = np.array(
        [row["Gps_UTC_Date&Time"].replace("/", "-").replace(" ", "T") for row in rows], dtype="datetime64[us]"
    )
    offset = set((utc.astype(np.int64) - stamps).tolist())
    assert len(offset) == 1
    truth = xr.open_zarr(collect / "truth.zarr")
    for number in (0, 23, 46):
        for row in table(collect / "flight" / f"frameIndex_{number}.txt"):
            middle = np.datetime64(int(row["Timestamp"]) + min(offset) - 2500, "us")
            assert middle == truth["time"].values[int(row["Frame#"])]
    assert 0 < np.abs(np.array([float(row["Roll"]) for row in rows])).max() < 1
    assert stamps[0] < int(table(collect / "flight" / "frameIndex_0.txt")[0]["Timestamp"])


def asd(path: Path) -> dict[str, Any]:
    # Read an ASD binary of version 7 with 726 channels, to its last byte
    raw = path.read_bytes()
    n = struct.unpack_from("<H", raw, 204)[0]
    assert raw[:3] == b"as7"
    made: dict[str, Any] = {
        "type": raw[186],
        "first": struct.unpack_from("<ff", raw, 191),
        "integration": struct.unpack_from("<I", raw, 390)[0],
        "averages": struct.unpack_from("<3H", raw, 425),
        "tm": struct.unpack_from("<9h", raw, 160),
        "reference_epoch": struct.unpack_from("<i", raw, 187)[0],
        "splice": struct.unpack_from("<ff", raw, 444),
        "counts": np.frombuffer(raw, "<f8", n, 484),
    }
    at = 484 + 8 * n
    made["flag"], made["reference_ole"], made["ole"], described = struct.unpack_from("<HddH", raw, at)
    at += 20 + described + 8 * n + 2
    for _ in range(20):
        at += 2 + struct.unpack_from("<H", raw, at)[0]
    assert struct.unpack_from("<HH", raw, at) == (0, 0)
    assert struct.unpack_from("<hhHH", raw, at + 4) == (0, 0, 0, 0)
    number = raw[at + 12]
    heads = [struct.unpack_from("<b20sihh", raw, at + 13 + 29 * index) for index in range(number)]
    at += 13 + 29 * number
    made["blocks"] = {
        head[0]: (head[2], np.frombuffer(raw, "<f8", n, at + 8 * n * index))
        for index, head in enumerate(heads)
    }
    assert at + 8 * n * number == len(raw)
    return made


def test_spectrometer_files_hold_irradiance_and_local_time(collect: Path) -> None:
    files = [asd(path) for path in sorted((collect / "asd").glob("*.asd"))]
    assert (files[0]["type"], files[0]["first"], files[0]["splice"]) == (4, (350.0, 1.0), (1075.0, -1.0))
    assert set(files[0]["blocks"]) == {1, 2, 3}
    length = files[0]["integration"] * files[0]["averages"][2] / 1000
    flight = PlanFlight(SimulationSettings(**SMALL))
    clear = convolve_gaussian(
        np.stack(Sky().irradiance(flight.grid)), flight.grid, np.arange(350.0, 1076), 3.0
    )
    for file in files:
        second, minute, hour, day, month, year, weekday, yearday, _ = file["tm"]
        local = np.datetime64(f"{1900 + year}-{month + 1:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}")
        ole = np.datetime64("1899-12-30T00:00:00") + np.timedelta64(round(file["ole"] * 86400), "s")
        assert local == ole
        assert (weekday, yearday) == (2, 200)  # 20 July 2021 was a Tuesday
        # the computer's zone: local reference time less its epoch
        assert round((file["reference_ole"] - 25569) * 86400 - file["reference_epoch"]) == -5 * 3600
        lamp, lamp_counts, lamp_ms = file["blocks"][2][1], file["blocks"][3][1], file["blocks"][3][0]
        irradiance = lamp * file["counts"] / lamp_counts * (lamp_ms / file["integration"])
        true = local.astype("datetime64[ns]") + 5 * 3600 * SECOND + np.timedelta64(37_250_000_000, "ns")
        seconds = (true - np.datetime64("2021-07-20T17:10:00")) / SECOND - length / 2
        np.testing.assert_allclose(
            irradiance, flight.light.factors(np.array([seconds]))[:, 0] @ clear, rtol=1e-10
        )
    spans = [file["ole"] * 86400 for file in files]
    np.testing.assert_allclose(np.diff(spans), 2.0, atol=1e-4)
    assert spans[-1] - spans[0] > 12.0


def test_truth_and_calibration_recover_each_other(collect: Path) -> None:
    # Counts, dark, gain and truth close within the noise; dead elements have no gain
    truth = xr.open_zarr(collect / "truth.zarr").load()
    assert truth["reflectance"].dims == ("along_track", "band", "cross_track")
    assert truth["reflectance"].shape == (70, 12, 10)
    assert truth["reflectance"].dtype == truth["radiance"].dtype == np.float32
    assert truth["surface"].dtype == np.int16
    assert truth["saturated"].dtype == truth["no_data"].dtype == bool
    assert truth["surface"].attrs["flag_meanings"].split() == list(MATERIALS)
    assert truth["time"].dtype == np.dtype("datetime64[ns]")
    assert truth["time"].values[1] - truth["time"].values[0] == np.timedelta64(7, "ms")
    calibration = xr.open_zarr(collect / "calibration.zarr").load()
    gain = calibration["radiance_gain"]
    assert (gain.dtype, gain.attrs["units"]) == (np.float32, "W m-2 sr-1 nm-1 s count-1")
    assert (int(np.isnan(gain).sum()), calibration["wavelength_shift"].values[5]) == (3, 0.0)
    assert calibration.attrs["srf_shape"] == "gaussian"
    dark = cube(collect / "dark" / "raw_0").astype(float)
    assert dark.shape == (64, 12, 10)
    assert dark.std(axis=0).mean() == pytest.approx(np.hypot(0.5, np.sqrt(1 / 12)), rel=0.1)
    recorded = ~truth["no_data"].values
    counts = np.concatenate([cube(collect / "flight" / f"raw_{n}") for n in (0, 23, 46)]).astype(float)
    wanted = truth["radiance"].values[recorded] * 5e-3 / gain.values
    z = (((counts - dark.mean(axis=0)) - wanted) / np.sqrt(wanted / 20 + 0.25 + 1 / 12 + 0.34 / 64))[
        (counts < 4095) & np.isfinite(wanted)
    ]
    assert z.mean() == pytest.approx(0.0, abs=0.06)  # 8,000 samples, dark shared by a column
    assert z.std() == pytest.approx(1.0, abs=0.03)
    saturated = (counts == 4095).any(axis=1)
    np.testing.assert_array_equal(saturated, truth["saturated"].values[recorded])
    assert 0 < saturated.sum() < truth["glint"].values[recorded].sum() + 5


def test_same_seed_same_bytes_whatever_the_blocks(tmp_path: Path) -> None:
    made = [
        simulate_collect(tmp_path / str(block), **SMALL, block_lines=block, cubes=2, dropped=3).parent
        for block in (7, 32, 500)
    ]
    first = contents(made[0])
    assert len(first) > 20
    for other in made[1:]:
        assert contents(other) == first
    changed = simulate_collect(tmp_path / "seed", **{**SMALL, "seed": 8}).parent
    assert contents(changed)["dark/raw_0"] != first["dark/raw_0"]


def test_progress_and_overwrite(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    simulate_collect(tmp_path / "a", **SMALL, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(32, 70), (64, 70), (70, 70)]
    expect_error(StoreError, "folder-not-empty", lambda: simulate_collect(tmp_path / "a", **SMALL))
    (tmp_path / "a" / "mine.txt").write_text("kept")
    before = contents(tmp_path / "a")
    simulate_collect(tmp_path / "a", **SMALL, overwrite=True)
    assert contents(tmp_path / "a") == before
    assert not (simulate_collect(tmp_path / "b", **SMALL, truth=False).parent / "truth.zarr").exists()
    (tmp_path / "file").write_text("")
    expect_error(StoreError, "folder-is-file", lambda: simulate_collect(tmp_path / "file", **SMALL))
    # a real collect is not replaced
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight" / "raw_0").write_text("precious")
    for text in (None, "[collect]\n"):
        if text is not None:
            (tmp_path / "collect.toml").write_text(text)
        with pytest.raises(StoreError, match="folder-foreign"):
            simulate_collect(tmp_path, **SMALL, overwrite=True)
    assert (tmp_path / "flight" / "raw_0").read_text() == "precious"


def test_reflectance_and_radiance_are_weighted_by_the_irradiance() -> None:
    size: dict[str, Any] = {"lines": 60, "bands": 30, "columns": 32, "texture": 0.0}
    line = simulate_line(**size, noise=False, quantise=False, matched=True, drift_per_minute=0.0)
    seen, surface = line["true_reflectance"].transpose(..., "band").values, line["surface"].values
    for level in (5, 20, 50, 90):
        panel = seen[surface == list(MATERIALS).index(f"panel_{level:02d}")]
        assert len(panel) > 0
        np.testing.assert_allclose(panel, level / 100, rtol=3e-7)
    matched = np.broadcast_to(line["matched_irradiance"].values[0], line["true_radiance"].shape)
    ratio = (line["true_radiance"].values * np.pi / matched).transpose(0, 2, 1)
    np.testing.assert_allclose(ratio[surface == list(MATERIALS).index("panel_50")], 0.5, rtol=3e-7)
    flight = PlanFlight(SimulationSettings(**size))
    grid, imager = flight.grid, flight.imager
    by_hand = imager.integrals((MATERIALS["green"](grid) * flight.sky.sum(axis=0))[None], grid)[0]
    by_hand /= imager.integrals(flight.sky.sum(axis=0)[None], grid)[0]
    _, column = shown = np.nonzero(surface == list(MATERIALS).index("green"))
    np.testing.assert_allclose(seen[shown], by_hand.T[column], rtol=3e-6)


def test_closure_of_float_counts() -> None:
    line = simulate_line(
        lines=40, bands=25, columns=9, noise=False, quantise=False, matched=True, drift_per_minute=0.5
    )
    assert (line["counts"].dtype, line["dark_counts"].dtype) == (np.float32, np.float32)
    radiance = (line["counts"] - line["dark_counts"]) * line["radiance_gain"] / line["exposure_time"]
    np.testing.assert_allclose(radiance, line["true_radiance"], rtol=1e-5)
    # linear in time between the samples, as the light drifts
    recovered = (
        np.pi * radiance / line["matched_irradiance"].interp(irradiance_time=line["time"])
    ).transpose(*line["counts"].dims)
    np.testing.assert_allclose(recovered, line["true_reflectance"], rtol=1e-5)


def test_counts_are_linear_in_exposure() -> None:
    short, long = (
        simulate_line(
            lines=8, bands=6, columns=6, noise=False, quantise=False, exposure_time_ms=ms, glint=0.0
        )
        for ms in (2.0, 4.0)
    )
    signal = [line["counts"] - line["dark_counts"] for line in (short, long)]
    np.testing.assert_allclose(signal[1], 2 * signal[0], rtol=2e-5)
    np.testing.assert_array_equal(short["true_radiance"], long["true_radiance"])


PLAIN: dict[str, Any] = {"lines": 24, "bands": 20, "columns": 16, "noise": False, "quantise": False}
OFF: dict[str, Any] = {
    "smile_nm": 0.0,
    "nonuniformity": 0.0,
    "texture": 0.0,
    "glint": 0.0,
    "drift_per_minute": 0.0,
}


def difference(name: str, **change: Any) -> float:
    # Largest relative change of a variable when one effect is switched on
    without, with_it = simulate_line(**PLAIN, **OFF), simulate_line(**{**PLAIN, **OFF, **change})
    return float(np.nanmax(np.abs(with_it[name].values / without[name].values - 1)))


@pytest.mark.parametrize(
    ("change", "moved", "still"),
    [
        ({"smile_nm": 1.0}, "true_radiance", "dark_counts"),
        ({"nonuniformity": 0.05}, "radiance_gain", "true_radiance"),
        ({"texture": 0.05}, "true_reflectance", "radiance_gain"),
        ({"glint": 0.5}, "true_reflectance", "radiance_gain"),
        ({"drift_per_minute": 0.5}, "irradiance", "radiance_gain"),
        ({"cloud": (0.5, 1.0, 0.05)}, "true_radiance", "radiance_gain"),
        ({"srf_shape": "slit"}, "true_radiance", "irradiance"),
        ({"fwhm_nm": 9.0}, "true_radiance", "irradiance"),
        ({"dark_level": 50.0}, "counts", "true_radiance"),
        ({"dark_pattern": 6.0}, "dark_counts", "true_radiance"),
        ({"noise": True}, "counts", "true_radiance"),
        ({"irradiance_noise": 0.01}, "irradiance", "true_radiance"),
        ({"irradiance_fwhm_nm": 5.0}, "irradiance", "true_radiance"),
        ({"sun_zenith": 60.0}, "irradiance", "radiance_gain"),
        ({"electrons_per_count": 10.0}, "radiance_gain", "true_radiance"),
        ({"clock_offset_s": 3.5}, "matched_time", "true_radiance"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_each_effect_moves_what_it_should_and_nothing_else(
    change: dict[str, Any], moved: str, still: str
) -> None:
    assert difference(still, **change) == 0.0
    if moved == "matched_time":
        assert set(
            simulate_line(**{**PLAIN, **OFF, **change})["irradiance_time"].values.astype(np.int64) % 10**9
        ) == {500_000_000 - 340_000_000}
    else:
        assert difference(moved, **change) > 1e-4


def test_cloud_takes_its_fraction_of_the_direct_light() -> None:
    clear, cloudy = (simulate_line(**PLAIN, **OFF, cloud=cloud) for cloud in (None, (0.65, 0.02, 0.08)))
    ratio = (cloudy["true_radiance"] / clear["true_radiance"]).values
    np.testing.assert_allclose(ratio[:12], 1.0, rtol=1e-6)
    assert 0.35 < ratio[-1, -1].mean() < 0.42  # little diffuse light in the near infrared
    assert ratio[-1, 0].mean() > ratio[-1, -1].mean() + 0.05


def test_clock_and_zone_stamps_move_and_the_light_stays(tmp_path: Path) -> None:
    paths = [
        simulate_collect(
            tmp_path / f"{hours}", **SMALL, truth=False, clock_offset_s=offset, utc_offset_h=hours
        )
        for hours, offset in ((-5.0, 37.25), (5.5, -200.0))
    ]
    for path, hours, offset in zip(paths, (-5.0, 5.5), (37.25, -200.0), strict=True):
        stamps = [asd(name)["ole"] for name in sorted((path.parent / "asd").glob("*.asd"))]
        utc = [(ole - 25569) * 86400 - hours * 3600 + offset for ole in stamps]
        start = np.datetime64("2021-07-20T17:10:00").astype(np.int64)
        assert start - 11 < utc[0] < start - 6
        assert start + 6 < utc[-1] < start + 12


def test_gap_in_the_irradiance_record() -> None:
    line = simulate_line(lines=4, bands=4, columns=4, irradiance_interval_s=1, irradiance_gap=(-2.0, 3.0))
    seconds = (line["irradiance_time"].values - np.datetime64("2021-07-20T17:10:00")) / SECOND
    assert not ((seconds >= -2.0) & (seconds <= 3.0)).any()
    assert np.diff(seconds).max() >= 5.0
    assert seconds.min() < -6
    assert seconds.max() > 6


@pytest.mark.parametrize("stamp", ["start", "mid", "end"])
def test_frame_stamp_marks_what_was_asked(tmp_path: Path, stamp: str) -> None:
    path = simulate_collect(tmp_path, scene="plan", lines=4, bands=2, columns=2, stamp=stamp, truth=False)
    first = int(table(path.parent / "flight" / "frameIndex_0.txt")[0]["Timestamp"])
    assert first - 1_234_567_891 == {"start": -2500, "mid": 0, "end": 2500}[stamp]


def test_in_memory_line_equals_the_files(collect: Path) -> None:
    line = simulate_line(**SMALL, dropped=[30, 31, 44], bad_elements=3, glint=0.05)
    counts = np.concatenate([cube(collect / "flight" / f"raw_{n}") for n in (0, 23, 46)])
    recorded = np.isfinite(line["counts"].values[:, 0, 0]) & ~np.isnat(line["time"].values)
    np.testing.assert_array_equal(line["counts"].values[recorded], counts)
    np.testing.assert_allclose(line["dark_counts"], cube(collect / "dark" / "raw_0").mean(axis=0), rtol=1e-6)
    # dropped frames have no time
    line = simulate_line(lines=12, bands=3, columns=3, dropped=[4, 5])
    assert line["counts"].dtype == np.uint16
    assert (line["counts"].values[[4, 5]] == 65535).all()
    np.testing.assert_array_equal(np.flatnonzero(np.isnat(line["time"].values)), [4, 5])
    np.testing.assert_array_equal(line["frame"], np.arange(12))
    settings = SimulationSettings(lines=40, cubes=2, dropped=9)
    assert len(settings.dropped_frames) == 9
    assert not {0, 19, 20, 39} & set(settings.dropped_frames.tolist())


@pytest.mark.parametrize(
    "wrong",
    [
        {"exposure_time_ms": -5.0}, {"exposure_time_ms": 8.0}, {"exposure_time_ms": float("nan")},
        {"exposure_time_ms": "5"}, {"srf_shape": "box"}, {"stamp": None}, {"lines": 0}, {"lines": 3.5},
        {"bands": 1}, {"columns": 0}, {"seed": -1}, {"cubes": 300}, {"bit_depth": 17}, {"noise": 1},
        {"cloud": (2.0, 1.0, 0.0)}, {"cloud": (0.5, 0.0, 0.0)}, {"cloud": "dark"}, {"irradiance_gap": (1.0,)},
        {"dropped": 1000}, {"dropped": [99999]}, {"dropped": list(range(512))}, {"dropped": "7"},
        {"start_time": "noon"}, {"start_time": "2021-07-20T17:10:00Z"},
        {"start_time": "2050-01-01"}, {"start_time": "NaT"}, {"irradiance_margin_s": 1e12},
        {"utc_offset_h": 30.0}, {"irradiance_interval_s": 0},
        {"first_wavelength": 900.0, "last_wavelength": 500.0}, {"drift_per_minute": 1.0, "lines": 10_000},
        {"bad_elements": 10**9}, {"dark_level": 5000.0}, {"glint": 1.5}, {"fwhm": 6.0},
        {"scene": "3d"}, {"samples": 0}, {"samples": 2.5}, {"sky": "blue"}, {"coat": 1},
        {"neighbours": None}, {"sun_azimuth": 400.0},
        {"psf_across_columns": -1.0}, {"psf_along_lines": 99.0}, {"keystone_columns": "wide"},
        {"stray_light": 0.9}, {"pedestal": float("nan")}, {"masked_columns": 1.5}, {"masked_columns": 160},
        {"psf_kernel": [[1.0, 1.0]]}, {"psf_kernel": [[-1.0]]}, {"psf_kernel": [[0.0]]},
        {"psf_kernel": 3.0}, {"psf_kernel": [[1.0], [1.0, 2.0, 1.0], [1.0]]}, {"pedestal": 4000.0},
        {"psf_kernel": [[1.0]], "psf_along_lines": 1.0},
    ],
    ids=str,
)  # fmt: skip
def test_hostile_arguments_are_refused_before_anything_is_written(
    tmp_path: Path, wrong: dict[str, Any]
) -> None:
    expect_error(SchemaError, next(iter(wrong)), lambda: simulate_collect(tmp_path / "new", **wrong))
    assert not (tmp_path / "new").exists()


def test_all_problems_are_listed_at_once(tmp_path: Path) -> None:
    wrong = {"lines": -1, "exposure_time_ms": 0.0, "srf_shape": "box", "read_noise": -1.0}
    error = expect_error(SchemaError, None, lambda: simulate_line(**wrong))
    expect_words(str(error), *(f"{name}=" for name in wrong))
    expect_error(SchemaError, "fwhm, smell", lambda: simulate_line(smell=1, fwhm=3))
    # files hold whole counts only
    expect_errors(
        (SchemaError, "option-conflict", lambda: simulate_collect(tmp_path / "new", quantise=False)),
        (SchemaError, "block_lines", lambda: simulate_collect(tmp_path / "new", block_lines=0)),
    )
    assert not (tmp_path / "new").exists()


# --- reference files ---

#: What a line of the header may look like. `test_the_pattern_is_that_of_real_files` holds it to real files.
PAIR = r"-?[\d.]+, ?-?[\d.]+"
CLOCK = r"\d{1,2}/\d{1,2}/\d{4} \d{1,2}:\d\d:\d\d( ?[AP]M)?"
PLACE = r"(\d{4,5}\.\d{4}[NSEW])?"
HEADER = {
    "name": r"\S+\.sig",
    "instrument": r"HI: \w{7} \(HR-1024i\)",
    "integration": r"[\d.]+(, [\d.]+){5}",
    "scan method": "Time-based, Time-based",
    "scan coadds": r"\d+(, \d+){5}",
    "scan time": PAIR,
    "scan settings": "AI, AI",
    "external data set1": r"\d+(, ?\d+){15}((, ?\d+){16})?",
    "external data set2": r"\d+(, ?\d+){15}((, ?\d+){16})?",
    "external data dark": r"\d+(, ?\d+){7}((, ?\d+){8})?",
    "external data mask": r"\d+",
    "optic": r"[\w ]+\(\d\), [\w ]+\(\d\)",
    "temp": r"-?[\d.]+(, -?[\d.]+){5}",
    "vis detector temp": PAIR,
    "battery": PAIR,
    "error": PAIR,
    "units": "Radiance, Radiance",
    "time": f"{CLOCK}, {CLOCK}",
    "longitude": f"{PLACE} *, ?{PLACE} *",
    "latitude": f"{PLACE} *, ?{PLACE} *",
    "gpstime": r"(\d{6}\.\d{3})? *, ?(\d{6}\.\d{3})? *",
    "comm": ".*",
    "memory slot": PAIR,
    "factors": r"([\d.]+, [\d.]+, [\d.]+ \[Overlap: .*\])+",
    "inclinometer x offset": PAIR,
    "inclinometer y offset": PAIR,
    "sun zenith": PAIR,
    "sun azimuth": PAIR,
    "weather": r"\{.*\}",
    "data": "",
}
OPTIONAL = {  # later versions of the firmware have them
    "vis detector temp", "inclinometer x offset", "inclinometer y offset", "sun zenith", "sun azimuth",
    "weather",
}  # fmt: skip
ROW = re.compile(r"\d{3,4}\.\d  -?\d+\.\d\d  -?\d+\.\d\d  -?\d+\.\d\d")


def svc(path: Path) -> tuple[dict[str, str], np.ndarray]:
    # Read a file of an HR-1024i strictly: keys in their order, then rows of four numbers (row, 4)
    first, *lines = path.read_bytes().decode("ascii").replace("\r\n", "\n").removesuffix("\n").split("\n")
    assert first == "/*** Spectra Vista SIG Data ***/"
    keys: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition("=")
        assert value.startswith(" ") or not value, line
        keys[key] = value.strip()
        if key == "data":
            break
    assert list(keys) == [key for key in HEADER if key in keys or key not in OPTIONAL]
    for key, value in keys.items():
        assert re.fullmatch(HEADER[key], value), f"{key}= {value}"
    rows = lines[len(keys) :]
    assert all(ROW.fullmatch(row) for row in rows)
    return keys, np.array([row.split() for row in rows], dtype=np.float64)


@pytest.fixture(scope="module")
def spectrometers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A small collect with its spectrometers' files
    return simulate_collect(
        tmp_path_factory.mktemp("references"), scene="plan", lines=4, bands=4, columns=4, utc_offset_h=5.5
    ).parent


@pytest.mark.real_data
def test_the_pattern_is_that_of_real_files(shared_data: Path) -> None:
    files = sorted((shared_data / "svc_sig").glob("*.sig"))
    assert files
    for path in files:
        keys, rows = svc(path)
        np.testing.assert_allclose(
            rows[:, 3], 100 * rows[:, 2] / rows[:, 1], atol=0.01 + 1 / rows[:, 1].min()
        )
        if "Preserve" in keys["factors"] and "Remove" not in keys["factors"]:
            # three detectors of the sizes that are simulated, within what differs from unit to unit
            assert (np.flatnonzero(np.diff(rows[:, 0]) < 0) + 1).tolist() == [512, 768]
            np.testing.assert_allclose(rows[:, 0], SVC_WAVELENGTH, atol=20)


def test_svc_files_hold_the_paints_in_units_of_the_instrument(spectrometers: Path) -> None:
    files = sorted((spectrometers / "svc").glob("*.sig"))
    assert [path.stem for path in files] == sorted(CAR_PAINTS)
    for path in files:
        keys, rows = svc(path)
        assert (keys["name"], len(rows)) == (path.name, 1024)
        np.testing.assert_array_equal(rows[:, 0], SVC_WAVELENGTH)
        np.testing.assert_allclose(rows[:, 3], 100 * rows[:, 2] / rows[:, 1], atol=0.0051)
        # what a detector's resolution takes from the paints' edges, most at the sun's G band, 430 nm
        np.testing.assert_allclose(
            rows[:, 2] / rows[:, 1], reflectance([path.stem], rows[:, 0])[0], atol=0.0045
        )
    # 1e-10 W cm-2 sr-1 nm-1: a white panel at noon, by hand from the light that the flight has
    _, rows = svc(spectrometers / "svc" / "grey.sig")
    flight = PlanFlight(SimulationSettings(lines=4, bands=4, columns=4))
    for nm in (550.2, 870.0):
        row = int(np.abs(rows[:512, 0] - nm).argmin())
        weight = np.exp(-4 * np.log(2) * ((flight.grid - rows[row, 0]) / SVC_DETECTORS[0].fwhm) ** 2)
        assert rows[row, 1] * 1e-10 * 1e4 == pytest.approx(
            ((flight.sky.sum(axis=0) * weight).sum() / weight.sum()) / np.pi, rel=1e-3
        )


def test_svc_files_of_a_low_sun_hold_numbers(tmp_path: Path) -> None:
    # channels without light have no ratio
    collect = simulate_collect(tmp_path, scene="plan", lines=4, bands=4, columns=4, sun_zenith=75.0)
    _, rows = svc(collect.parent / "svc/grey.sig")
    assert (rows[:, 1] == 0.0).any()
    assert np.isfinite(rows).all()


def test_svc_clocks_and_places(spectrometers: Path) -> None:
    # Local time of the instrument's clock, UTC of its GPS, the panel first, all before the flight
    keys, _ = svc(spectrometers / "svc" / "red.sig")
    panel, target = (dt.datetime.strptime(text, "%m/%d/%Y %I:%M:%S %p") for text in keys["time"].split(", "))
    assert dt.timedelta(0) < target - panel < dt.timedelta(minutes=1)
    utc = [local - dt.timedelta(hours=5.5) for local in (panel, target)]
    assert [text.strip() for text in keys["gpstime"].split(",")] == [f"{moment:%H%M%S}.000" for moment in utc]
    assert utc[1] < dt.datetime(2021, 7, 20, 17, 10)
    assert (keys["latitude"].split()[0], keys["longitude"].split()[0]) == ("4305.0700N", "07740.4940W")


@pytest.mark.parametrize(
    ("moment", "shown"),
    [
        ("2021-07-20T00:30:00", "7/19/2021 11:31:00 PM"),
        ("2021-07-20T01:30:00", "7/20/2021 12:31:00 AM"),
        ("2021-12-31T13:30:00", "12/31/2021 12:31:00 PM"),
    ],
)
def test_svc_hours_are_those_of_a_clock_face(tmp_path: Path, moment: str, shown: str) -> None:
    # The panel of the first paint is seen 59 minutes before the flight
    simulate_collect(
        tmp_path, scene="plan", lines=4, bands=4, columns=4, start_time=moment, utc_offset_h=0.0, truth=False
    )
    keys, _ = svc(tmp_path / "svc" / "white.sig")
    assert keys["time"].split(", ")[0] == shown


def test_asd_files_hold_the_paints_and_the_toml_names_both(spectrometers: Path) -> None:
    files = sorted((spectrometers / "asd_reflectance").glob("*.asd"))
    assert [path.stem for path in files] == sorted(CAR_PAINTS)
    made = hp.open_asd(files)
    assert set(made.data_vars) == {"reflectance"}
    wavelength = made["wavelength"].values
    for index, path in enumerate(made["source"].values.tolist()):
        np.testing.assert_allclose(
            made["reflectance"].values[index], reflectance([Path(path).stem], wavelength)[0], atol=0.004
        )
    seconds = (np.datetime64("2021-07-20T17:10:00") - made["time"].values) / np.timedelta64(1, "s")
    assert (seconds > 0).all()
    assert (seconds < 7200).all()
    assert tomllib.loads((spectrometers / "collect.toml").read_text())["references"] == [
        {"instrument": "svc", "files": "svc/*.sig"},
        {"instrument": "asd", "files": "asd_reflectance/*.asd"},
    ]
    hp.open_collect(spectrometers / "collect.toml")


@pytest.mark.real_data
def test_asd_headers_say_what_those_of_reflectance_do(spectrometers: Path, shared_data: Path) -> None:
    # Data type, fore optic, ordinate and reference flag, as in a file of the same version
    def told(path: Path) -> dict[str, Any]:
        raw = path.read_bytes()
        channels = int.from_bytes(raw[204:206], "little")
        return {
            "version": raw[:3],
            "type": raw[186],
            "format": raw[199],
            "ordinate": tuple(np.frombuffer(raw, "<f4", 2, 402).tolist()),
            "reference": raw[484 + 8 * channels :][:2],
        }

    assert told(spectrometers / "asd_reflectance" / "red.asd") == told(
        shared_data / "asd_binary" / "v7sample00003.asd"
    )


# --- checkerboard ---


def is_bright(board: Any, east: Any, north: Any) -> Any:
    # Tell which places are on bright squares: those whose numbers differ in being odd
    first, second = np.floor(board.numbers(east, north))
    return (first + second) % 2 == 1


BOARD = {
    "scene": "checkerboard", "lines": 70, "columns": 96, "bands": 3, "swath": 0.96, "wobble": "rough",
    "boresight": (0.4, -0.6, 0.8), "lever_arm": (0.05, -0.02, 0.12), "course": 350.0,
}  # fmt: skip


def flight(**effects: object) -> CheckerboardFlight:
    return CheckerboardFlight(SimulationSettings.of({**BOARD, **effects}))


def test_corners_are_where_four_squares_meet() -> None:
    board = Checkerboard((500.0, 4000.0), 0.16, 27.0)
    corners = board.corners(np.array([[0, 0], [3, -2], [-5, 7]]))
    around = 0.01 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    turn = np.radians(27.0)
    along = np.array([[np.sin(turn), np.cos(turn)], [np.cos(turn), -np.sin(turn)]])
    for corner in corners:
        bright = is_bright(board, *(corner + around @ along).T)
        assert bright.sum() == 2
        assert bright[0] == bright[2] != bright[1]
    assert np.hypot(*(corners[1] - corners[0])) == pytest.approx(0.16 * np.hypot(3, 2))


def test_lines_are_the_same_however_they_are_asked_for() -> None:
    whole, part = flight().lines(0, 70), flight().lines(33, 60)
    np.testing.assert_array_equal(whole.counts[33:60], part.counts)
    assert np.abs(whole.layers["height"] - 160.0).max() < 1e-6  # the ground is level
    for name, values in whole.layers.items():
        np.testing.assert_array_equal(values[33:60], part.layers[name])


@pytest.mark.slow
def test_share_is_the_mean_over_pixel_and_exposure() -> None:
    # Expected: what 40 x 40 x 40 places and moments give, to what 80 of them can; on average, closer
    still = flight(wobble="none", boresight=(0, 0, 0), lever_arm=(0, 0, 0), course=0.0, board_turn=0.0)
    made = still.lines(0, 70).layers
    assert 0.02 < (abs(made["bright_share"] - 0.5) < 0.45).mean() < 0.4
    half = still.settings.exposure_time / 2
    parts = np.arange(-39, 40, 2) / 80
    errors = []
    for line in (10, 31):
        origin, rotation = still.trajectory.camera(still.line_times[line] / 1e9 + 2 * half * parts)
        for column in range(15, 40):
            across = (column - 47.5 + parts) * PIXEL_ANGLE_RAD
            fine = [
                is_bright(
                    still.board, *still._map_coordinates(still._places(origin, rotation, across, t))[:2]
                ).mean()
                for t in parts * PIXEL_ANGLE_RAD
            ]
            errors.append(made["bright_share"][line, column] - np.mean(fine))
    assert np.abs(errors).max() < 0.07
    assert abs(np.mean(errors)) < 0.01


def test_files_hold_what_was_flown(tmp_path: Path) -> None:
    # Expected: both navigation files give the true pose, the truth says how the camera was mounted, and the
    # mean radiance of bright pixels is ten times that of dark ones
    path = simulate_collect(tmp_path / "board", **BOARD, navigation_rate=200, frame_clock_offset_s=0.004)
    truth = xr.open_zarr(path.parent / "truth.zarr")
    assert (truth.attrs["crs"], truth.attrs["boresight"]) == ("EPSG:32618", [0.4, -0.6, 0.8])
    assert (truth.attrs["lever_arm"], truth.attrs["frame_clock_offset_s"]) == ([0.05, -0.02, 0.12], 0.004)
    assert truth.sizes["corner"] > 50
    log = hp.open_navigation(path.parent / "flight" / "imu_gps.txt")
    sbet = hp.open_navigation(path.parent / "flight" / "trajectory.sbet", date="2021-07-20")
    assert log.sizes == sbet.sizes
    assert abs(log["navigation_time"] - sbet["navigation_time"]).max() <= np.timedelta64(1, "us")
    seconds = (log["navigation_time"].values - np.datetime64("2021-07-20T17:10:00", "ns")) / np.timedelta64(
        1, "s"
    )
    pose = flight().trajectory.pose(seconds)
    np.testing.assert_allclose(np.diff(seconds), 0.005)
    for name, within in (("latitude", 1e-9), ("roll", 1e-6), ("heading", 1e-6), ("altitude", 1e-4)):
        np.testing.assert_allclose(log[name], pose[name], atol=within, rtol=0)
    for name in ("roll", "heading"):
        np.testing.assert_allclose(np.degrees(sbet[name]), pose[name], atol=1e-9)
    frame, stamp = np.loadtxt(path.parent / "flight" / "frameIndex_0.txt", skiprows=1).T
    # the stamp is at the end of 5 ms, by a clock that is 4 ms behind
    clock = np.loadtxt(path.parent / "flight" / "imu_gps.txt", skiprows=1, usecols=6)[0]
    np.testing.assert_allclose((stamp - clock) / 1e6 + seconds[0], frame * 0.007 + 0.0025 - 0.004, atol=2e-6)
    share, radiance = truth["bright_share"].values, truth["radiance"].isel(band=1).values
    assert radiance[share == 1].mean() == pytest.approx(10 * radiance[share == 0].mean(), rel=1e-3)


def test_line_in_memory_can_be_located() -> None:
    line = simulate_line(**{**BOARD, "boresight": (0, 0, 0), "lever_arm": (0, 0, 0)})
    placed = line.paint.locate(ground=160.0)
    # the poses are exact, and so are places
    assert (
        float(np.hypot(placed["east"] - line["true_east"], placed["north"] - line["true_north"]).max()) < 1e-5
    )


def test_from_a_terminal(tmp_path: Path) -> None:
    options = [
        "--scene",
        "checkerboard",
        "--lines",
        "8",
        "--columns",
        "40",
        "--bands",
        "4",
        "--sweep",
        "--quiet",
    ]
    flown = (
        "swath=0.5 wobble=calm course=90 boresight=0.4,-0.6,0.8 lever_arm=0.05,-0.02,0.12 navigation_rate=50"
    )
    for setting in flown.split():
        options += ["--set", setting]
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "sim"), *options])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "sim" / "lab" / "sweep.zarr" / "zarr.json").is_file()
    truth = xr.open_zarr(tmp_path / "sim" / "truth.zarr")
    assert truth.attrs["lever_arm"] == [0.05, -0.02, 0.12]
    assert np.ptp(truth["north"].values) > np.ptp(truth["east"].values)  # eight lines, flown east
    done = CliRunner().invoke(
        main, ["simulate", str(tmp_path / "two"), "--scene", "plan", "--set", "swath=3"]
    )
    assert done.exit_code == 2
    assert "swath=3.0, expected 16 for all scenes but a checkerboard" in done.output


# --- The simulated monochromator sweep against integrals written out here, and the effect of every switch


QUIET: dict[str, Any] = {"noise": False, "quantise": False}
EVEN: dict[str, Any] = {"nonuniformity": 0.0, "smile_nm": 0.0}
SHORT: dict[str, Any] = {"steps": 7, "bands": 272, "columns": 3}


def above_dark(sweep: xr.Dataset) -> xr.DataArray:
    return sweep.counts - sweep.dark_counts


def energy(sweep: xr.Dataset) -> xr.DataArray:
    return sweep.flux * sweep.capture_fraction * sweep.exposure_time


# --- the integral -----------------------------------------------------------------------------------------


def gaussian(offset: np.ndarray, fwhm: float) -> np.ndarray:
    sigma = fwhm / (2 * np.sqrt(2 * np.log(2)))
    return np.exp(-0.5 * (offset / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


def triangle(offset: np.ndarray, fwhm: float) -> np.ndarray:
    return np.maximum(1 - np.abs(offset) / fwhm, 0) / fwhm


def trapezoid(offset: np.ndarray, one: float, other: float) -> np.ndarray:
    # Return two boxes convolved: how much of a box ``one`` wide lies in a box ``other`` wide
    return np.maximum(
        np.minimum(offset + one / 2, other / 2) - np.maximum(offset - one / 2, -other / 2), 0
    ) / (one * other)


def oracle(sweep: xr.Dataset, step: int, band: int, column: int) -> float:
    # Return the counts above dark of one element by a sum over 100 000 points
    centre, width = float(sweep.step_wavelength[step]), float(sweep.monochromator_fwhm)
    nm = np.linspace(centre - 4 * width, centre + 4 * width, 100_001)
    line = {"gaussian": gaussian, "triangle": triangle}[sweep.monochromator_shape](nm - centre, width)
    wavelength = sweep.true_wavelength.values
    offset = nm - wavelength[band] - float(sweep.true_wavelength_shift[column])
    fwhm = float(sweep.true_fwhm[band])
    if sweep.true_srf_shape == "gaussian":
        shape = gaussian(offset, fwhm)
    else:
        shape = trapezoid(offset, fwhm, np.gradient(wavelength)[band])
    return float(
        np.sum(line * (nominal_responsivity(20.0)(nm) * shape)) * (nm[1] - nm[0]) * energy(sweep)[step]
    )


@pytest.mark.parametrize("width", [0.3, 2.0, 12.0])
@pytest.mark.parametrize("monochromator", ["gaussian", "triangle"])
@pytest.mark.parametrize("camera", ["gaussian", "slit"])
def test_every_element_against_a_plain_sum(camera: str, monochromator: str, width: float) -> None:
    sweep = simulate_sweep(
        steps=3, columns=40, first_step_nm=441.3, last_step_nm=955.0, srf_shape=camera, smile_nm=1.5,
        monochromator_fwhm_nm=width, monochromator_shape=monochromator, nonuniformity=0.0, fwhm_slope=0.15,
        dispersion_bow_nm=3.0, dark_level=0.0, dark_pattern=0.0, **QUIET,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    for step in range(3):
        seen = above_dark(sweep)[step].values
        peak = seen.max()
        for band, column in rng.choice(np.argwhere(seen > 0.01 * peak), 12):
            assert seen[band, column] == pytest.approx(
                oracle(sweep, step, band, column), abs=2.5e-5 * float(peak)
            )


@pytest.mark.parametrize("camera", ["gaussian", "slit"])
@pytest.mark.parametrize("width", [0.5, 2.0, 6.0, 12.0])
def test_line_area_is_the_responsivity_at_the_line(camera: str, width: float) -> None:
    # SUM_b counts / energy = responsivity per band spacing (physics 2.1), but for its curvature
    sweep = simulate_sweep(
        **SHORT,
        first_step_nm=450,
        last_step_nm=950,
        srf_shape=camera,
        monochromator_fwhm_nm=width,
        **EVEN,
        **QUIET,
    )
    truth = sweep.true_responsivity.isel(cross_track=0).values
    at_line = np.interp(sweep.step_wavelength, sweep.true_wavelength, truth)
    np.testing.assert_allclose(
        (above_dark(sweep).sum("band") / energy(sweep)).isel(cross_track=0), at_line, rtol=2e-3
    )
    gain = sweep.true_radiance_gain.isel(cross_track=0)
    np.testing.assert_allclose(
        gain * np.gradient(sweep.true_wavelength) * float(sweep.etendue) * truth, 1.0, rtol=1e-12
    )


def test_columns_of_an_uneven_slit() -> None:
    size: dict[str, Any] = {"steps": 2, "first_step_nm": 500, "last_step_nm": 800, "columns": 40}
    uneven = simulate_sweep(**size, column_nonuniformity=0.03, **EVEN, **QUIET)
    factor = above_dark(uneven).sum("band") / above_dark(simulate_sweep(**size, **EVEN, **QUIET)).sum("band")
    np.testing.assert_allclose(factor[0], factor[1], rtol=1e-4)
    assert 0.02 < float(factor[0].std()) < 0.04
    gain = uneven.true_radiance_gain.isel(band=100)
    np.testing.assert_allclose(gain * factor[0], float(gain[0] * factor[0, 0]), rtol=1e-4)


def test_columns_differ_by_their_own_factor_and_their_smile() -> None:
    plain = simulate_sweep(steps=1, first_step_nm=600, columns=21, seed=4, smile_nm=0.0, **QUIET)
    even = simulate_sweep(
        steps=1, first_step_nm=600, columns=21, seed=4, nonuniformity=0.0, smile_nm=0.0, **QUIET
    )
    lit = above_dark(even)[0].values > 1
    assert 0.01 < (above_dark(plain)[0].values[lit] / above_dark(even)[0].values[lit]).std() < 0.03
    bent = simulate_sweep(
        steps=1, first_step_nm=600, columns=21, seed=4, nonuniformity=0.0, smile_nm=1.5, **QUIET
    )
    counts = above_dark(bent)[0].values
    centre = (counts * np.arange(272)[:, None]).sum(axis=0) / counts.sum(axis=0)
    # an element of longer wavelength sees the line at a lower band
    np.testing.assert_allclose(
        (centre[10] - centre) * np.gradient(bent.true_wavelength)[90], bent.true_wavelength_shift, atol=0.01
    )


# --- the contract -----------------------------------------------------------------------------------------


def test_variables_are_those_of_the_table() -> None:
    sweep = simulate_sweep(
        steps=4, bands=12, columns=5, step_exposure_ms=[10.0, 20.0, 30.0, 40.0], beam_fwhm_columns=3.0
    )
    for name in sweep.variables:
        if str(name).startswith("true_"):
            continue
        row, array = SWEEP_VARIABLES[str(name)], sweep[name]
        assert array.dims in (row.dims, *row.alternatives)
        assert (array.dtype, array.attrs["units"]) == (row.dtype, row.units)
    # what a real sweep may state, and this camera has not
    absent = {"electrons_per_count", "read_noise", "band_shift_time", "level"}
    assert (set(SWEEP_VARIABLES) - set(sweep.variables), sweep.flux.dims) == (absent, ("step", "cross_track"))
    assert sweep.exposure_time.dims == sweep.dark_exposure_time.dims == ("step",)
    assert sweep.dark_counts.dims == ("step", "band", "cross_track")


def test_same_camera_in_the_lab_and_in_the_air() -> None:
    camera: dict[str, Any] = {
        "bands": 24, "columns": 9, "seed": 11, "smile_nm": 1.1, "srf_shape": "slit", "fwhm_nm": 5.0,
        "fwhm_slope": 0.1, "dispersion_bow_nm": 2.0, "bad_elements": 6, "dark_rate": 300.0,
    }  # fmt: skip
    lab = simulate_sweep(steps=2, **camera)
    line = simulate_line(lines=2, exposure_time_ms=6.0, **camera, **QUIET)
    np.testing.assert_allclose(lab.true_radiance_gain, line.radiance_gain, rtol=1e-6)
    assert int(np.isnan(line.radiance_gain).sum()) == int(lab.true_bad.sum()) == 6
    for name in ("wavelength", "wavelength_shift", "fwhm"):
        np.testing.assert_allclose(lab[f"true_{name}"], line[name], rtol=1e-12)
    np.testing.assert_allclose(lab.true_dark_bias + lab.true_dark_rate * 6e-3, line.dark_counts, rtol=1e-5)
    other = simulate_sweep(steps=2, **{**camera, "seed": 12})
    assert not np.allclose(other.true_radiance_gain, lab.true_radiance_gain, equal_nan=True)


# --- effects ----------------------------------------------------------------------------------------------


def test_bad_elements_see_no_light() -> None:
    sweep = simulate_sweep(**SHORT, bad_elements=40, **QUIET)
    assert int(sweep.true_bad.sum()) == 40
    assert float(abs(above_dark(sweep).where(sweep.true_bad)).max()) < 1e-4
    assert np.isnan(sweep.true_radiance_gain.values[sweep.true_bad.values]).all()


def test_dark_is_bias_and_rate() -> None:
    sweep = simulate_sweep(
        **SHORT, dark_rate=400.0, dark_exposure_ms=[5.0, 50.0, 200.0], step_exposure_ms=20.0, **QUIET
    )
    assert sweep.dark_counts.dims[0] == "step"
    np.testing.assert_array_equal(sweep.dark_exposure_time * 1e3, [5, 50, 200, 5, 50, 200, 5])
    expected = sweep.true_dark_bias + sweep.true_dark_rate * sweep.dark_exposure_time
    np.testing.assert_allclose(sweep.dark_counts, expected.transpose("step", ...), rtol=1e-5)
    unlit = sweep.counts.isel(step=0, band=-1)
    np.testing.assert_allclose(unlit, (sweep.true_dark_bias + 0.02 * sweep.true_dark_rate)[-1], rtol=1e-5)


def test_counts_grow_with_exposure_and_flux() -> None:
    one = above_dark(simulate_sweep(**SHORT, dark_rate=0.0, **QUIET)).astype(float)
    exposures = np.linspace(10, 70, 7)
    long = simulate_sweep(
        **SHORT, step_exposure_ms=exposures, beam_power_w=6e-6, dark_exposure_ms=50.0, **QUIET
    )
    factor = xr.DataArray(2 * exposures / 50.0, dims="step")
    np.testing.assert_allclose(above_dark(long), (one * factor).transpose("step", ...), atol=1e-3)


def test_beam_along_the_slit() -> None:
    beam: dict[str, Any] = {"steps": 9, "columns": 41, "beam_fwhm_columns": 10.0, "beam_wander_columns": 4.0}
    known = simulate_sweep(**beam, **EVEN, **QUIET)
    counts = above_dark(known).sum("band")
    centre = (counts * np.arange(41)).sum("cross_track") / counts.sum("cross_track")
    assert float(centre.max() - centre.min()) == pytest.approx(8.0, abs=0.3)
    area = (counts / energy(known)).where(known.flux > 0.2 * known.flux.max("cross_track"))
    np.testing.assert_allclose(area.max("cross_track"), area.min("cross_track"), rtol=1e-5)
    assert int((known.flux[0] >= 0.5 * known.flux[0].max()).sum()) in (10, 11)
    unknown = simulate_sweep(**beam, beam_recorded=False, **EVEN, **QUIET)
    assert unknown.flux.dims == ("step",)
    np.testing.assert_array_equal(unknown.counts, known.counts)
    np.testing.assert_allclose(unknown.true_flux.max("cross_track"), unknown.flux, rtol=0.02)


def test_power_meter_dial_and_converter_are_off() -> None:
    exact = simulate_sweep(**SHORT, **QUIET)
    meter = simulate_sweep(**SHORT, flux_bias=0.05, flux_noise=0.01, **QUIET)
    np.testing.assert_array_equal(meter.counts, exact.counts)
    ratio = meter.flux / exact.flux
    assert float(ratio.mean()) == pytest.approx(1.05, abs=0.012)
    assert 0.002 < float(ratio.std()) < 0.03
    dial = simulate_sweep(**SHORT, monochromator_offset_nm=1.3, monochromator_jitter_nm=0.1, **EVEN, **QUIET)
    np.testing.assert_array_equal(dial.step_wavelength, exact.step_wavelength)
    off = dial.true_step_wavelength - dial.step_wavelength
    assert float(off.mean()) == pytest.approx(1.3, abs=0.2)
    assert float(off.std()) > 0.02
    counts = above_dark(dial)[3, :, 0]
    # the responsivity's slope pulls the centre of gravity by a hundredth
    assert float((counts * dial.true_wavelength).sum() / counts.sum()) == pytest.approx(
        float(dial.true_step_wavelength[3]), abs=0.05
    )
    straight = above_dark(exact).astype(float)
    bent = simulate_sweep(**SHORT, nonlinearity=0.04, **QUIET)
    np.testing.assert_allclose(above_dark(bent), straight - 0.04 * straight**2 / 4095, atol=2e-3)


def test_stray_light_is_the_matrix_it_says() -> None:
    plain = above_dark(simulate_sweep(**SHORT, nonuniformity=0.0, **QUIET))
    hazy = simulate_sweep(**SHORT, nonuniformity=0.0, stray_light=0.02, **QUIET)
    share = hazy.true_stray_light.values
    np.testing.assert_allclose(share.sum(axis=0), 0.02, rtol=1e-12)
    assert ((above_dark(hazy)[3, 5] / above_dark(hazy)[3].max("band")) > 1e-6).all()
    mended = np.linalg.solve(np.eye(272) + share, above_dark(hazy)[3].values.astype(float))
    np.testing.assert_allclose(mended, plain[3], atol=2e-3)


def test_second_order_falls_at_twice_the_wavelength() -> None:
    sweep = simulate_sweep(
        steps=1, first_step_nm=450, columns=3, second_order=0.05, monochromator_fwhm_nm=2.0, **EVEN, **QUIET
    )
    counts, wavelength = above_dark(sweep)[0, :, 0].values.astype(float), sweep.true_wavelength.values
    late = wavelength > 800
    assert np.average(wavelength[late], weights=counts[late]) == pytest.approx(900.0, abs=0.2)
    assert counts[late].sum() == pytest.approx(0.05 * counts[~late].sum(), rel=1e-3)
    # as wide as camera and a monochromator of twice the width make it
    assert np.sqrt(np.average((wavelength[late] - 900) ** 2, weights=counts[late])) * 2 * np.sqrt(
        2 * np.log(2)
    ) == pytest.approx(np.hypot(6.0, 4.0), rel=0.01)


# --- noise ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quantise", [False, True])
def test_noise_of_mean_and_variance(quantise: bool) -> None:
    size: dict[str, Any] = {"steps": 1, "first_step_nm": 600, "columns": 400, "frames": 25, **EVEN}
    exact = above_dark(simulate_sweep(**size, **QUIET))[0].values.astype(float)
    noisy = simulate_sweep(**size, quantise=quantise)
    error = noisy.counts[0].values - exact - noisy.true_dark_bias.values
    expected = exact / 20.0 + 0.25 + quantise / 12
    for lit in (exact > 500, exact < 1e-3):
        z = (error / np.sqrt(expected / 25))[lit]
        count = len(z)
        assert abs(z.mean()) < 5 / np.sqrt(count)
        assert z.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * count))
        ratio = (noisy.counts_variance[0].values / expected)[lit]
        assert ratio.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / 24 / count))
        assert ratio.std() == pytest.approx(np.sqrt(2 / 24), rel=0.1)
    if quantise:
        np.testing.assert_allclose(noisy.counts * 25, np.rint(noisy.counts * 25), atol=0.01)


def test_frames_drawn_together_are_as_frames_drawn_one_by_one() -> None:
    # Mean and variance have the distributions of real averages of whole counts
    rng, frames = np.random.default_rng(3), 8
    raw = np.rint(110.3 + 6.0 + np.sqrt(6.0 / 20 + 0.25) * rng.standard_normal((frames, 40_000)))
    means, variances = raw.mean(axis=0), raw.var(axis=0, ddof=1)
    sweep = simulate_sweep(
        steps=1, first_step_nm=600, columns=400, frames=frames, dark_level=110.3, dark_pattern=0.0, **EVEN
    )
    unlit = np.s_[0, -100:]
    assert np.std(sweep.counts.values[unlit]) == pytest.approx(np.sqrt((0.25 + 1 / 12) / frames), rel=0.02)
    assert means.std() == pytest.approx(np.sqrt((0.3 + 0.25 + 1 / 12) / frames), rel=0.02)
    assert np.mean(sweep.counts_variance.values[unlit]) / (0.25 + 1 / 12) == pytest.approx(
        np.mean(variances) / (0.3 + 0.25 + 1 / 12), rel=0.01
    )


def test_full_converter_single_frames_and_seeds() -> None:
    sweep = simulate_sweep(**SHORT, beam_power_w=1e-4)
    assert float(sweep.counts.max()) == float(sweep.saturation_count) == 4095
    assert float(sweep.counts_variance.where(sweep.counts == 4095).max()) == 0.0
    assert float(sweep.counts.min()) > 0
    # one frame has no variance
    sweep = simulate_sweep(steps=2, bands=8, columns=4, frames=1)
    assert np.isnan(sweep.counts_variance).all()
    np.testing.assert_array_equal(sweep.counts, np.rint(sweep.counts))
    assert "counts_variance" not in simulate_sweep(steps=2, bands=8, columns=4, variance=False)
    # the seed decides
    size: dict[str, Any] = {"steps": 3, "bands": 16, "columns": 4}
    one, same = simulate_sweep(**size, seed=5), simulate_sweep(**size, seed=5)
    xr.testing.assert_identical(one, same)
    assert (one.counts != simulate_sweep(**size, seed=6).counts).any()


# --- stores -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dark_exposure", [None, [5.0, 50.0]])
def test_store_is_what_memory_holds(tmp_path: Path, dark_exposure: Any) -> None:
    size: dict[str, Any] = {"steps": 4, "bands": 16, "columns": 5, "stray_light": 0.01}
    seen: list[tuple[int, int]] = []
    path = write_sweep(
        tmp_path / "sweep.zarr",
        **size,
        dark_exposure_ms=dark_exposure,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    memory = simulate_sweep(**size, dark_exposure_ms=dark_exposure)
    with xr.open_zarr(path) as stored, xr.open_zarr(tmp_path / "sweep_truth.zarr") as truth:
        assert not [name for name in stored.variables if "true" in str(name)]
        assert "true_srf_shape" not in stored.attrs
        for name in (*stored.variables, *truth.variables):
            found = stored[name] if name in stored.variables else truth[name]
            np.testing.assert_array_equal(found, memory[name])
            assert (found.dims, found.attrs) == (memory[name].dims, memory[name].attrs)
            assert found.dtype == memory[name].dtype
        assert set(stored.variables) | set(truth.variables) == set(memory.variables)
        assert stored.counts.chunks[0] == (1, 1, 1, 1)


def test_store_is_replaced_only_on_request(tmp_path: Path) -> None:
    size: dict[str, Any] = {"steps": 2, "bands": 8, "columns": 3}
    path = write_sweep(tmp_path / "sweep.zarr", **size)
    expect_error(StoreError, "store-exists", lambda: write_sweep(path, **size))
    write_sweep(path, **size, seed=1, truth=False, overwrite=True)
    assert not (tmp_path / "sweep_truth.zarr").exists()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "keep.txt").write_text("dear")
    expect_error(StoreError, "store-exists", lambda: write_sweep(tmp_path / "notes", **size, overwrite=True))
    assert (tmp_path / "notes" / "keep.txt").is_file()
    (tmp_path / "notes" / "zarr.json").write_text('{"attributes": {"name": "lot"}, "node_type": "group"}')
    expect_error(StoreError, "store-exists", lambda: write_sweep(tmp_path / "notes", **size, overwrite=True))
    assert (tmp_path / "notes" / "keep.txt").is_file()


def test_collect_with_its_sweep(tmp_path: Path) -> None:
    size: dict[str, Any] = {
        "scene": "plan", "lines": 8, "bands": 16, "columns": 6, "seed": 3, "srf_shape": "slit",
    }  # fmt: skip
    toml = simulate_collect(tmp_path / "with", **size, sweep={"steps": 5, "frames": 9, "noise": False})
    assert tomllib.loads(toml.read_text())["calibration"] == {"sweep": "lab/sweep.zarr"}
    lab = xr.open_zarr(toml.parent / "lab" / "sweep.zarr")
    truth = xr.open_zarr(toml.parent / "lab" / "sweep_truth.zarr")
    exact = xr.open_zarr(toml.parent / "calibration.zarr")
    assert (dict(lab.counts.sizes), int(lab.frame_count)) == ({"step": 5, "band": 16, "cross_track": 6}, 9)
    assert float(lab.monochromator_fwhm) > 40.0  # the bands are 40 nm apart
    assert truth.attrs["true_srf_shape"] == exact.attrs["srf_shape"] == "slit"
    np.testing.assert_allclose(truth.true_radiance_gain, exact.radiance_gain, rtol=1e-6)
    without = simulate_collect(tmp_path / "without", **size)
    assert tomllib.loads(without.read_text())["calibration"] == {"path": "calibration.zarr"}
    assert not (without.parent / "lab").exists()
    for name in ("flight/raw_0", "dark/raw_0"):
        assert (toml.parent / name).read_bytes() == (without.parent / name).read_bytes()
    simulate_collect(toml.parent, **size, overwrite=True)
    assert not (toml.parent / "lab").exists()


# --- settings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": 0}, {"monochromator_shape": "box"}, {"monochromator_fwhm_nm": 0.0}, {"frames": 2.5},
        {"monochromator_fwhm_nm": [1.0, 2.0]}, {"step_exposure_ms": -1.0}, {"dark_exposure_ms": []},
        {"stray_light": 2.0}, {"beam_fwhm_columns": 0.0}, {"capture_fraction": 0.0}, {"beam_recorded": 1},
        {"flux_noise": float("nan")}, {"srf_shape": "box"}, {"lines": 5},
        {"exposure_time_ms": 5.0}, {"colour": 1},
    ],
)  # fmt: skip
def test_wrong_settings(wrong: dict[str, Any]) -> None:
    expect_error(SchemaError, next(iter(wrong)), lambda: SweepSettings.of(wrong))


def test_all_problems_are_listed_together(tmp_path: Path) -> None:
    wrong = {"steps": 0, "second_order": -1.0, "monochromator_shape": "box", "beam_power_w": "bright"}
    expect_words(str(expect_error(SchemaError, None, lambda: SweepSettings.of(wrong))), *wrong)
    # a sweep cannot change the camera of a flight
    expect_errors(
        (
            SchemaError,
            r"smile_nm.*key-unknown",
            lambda: SweepSettings.of({"smile_nm": 1.0}, SimulationSettings()),
        ),
        (
            SchemaError,
            "seed",
            lambda: simulate_collect(
                tmp_path / "sim", scene="plan", lines=4, bands=4, columns=4, sweep={"seed": 1}
            ),
        ),
    )
    assert not (tmp_path / "sim").exists()
