"""The files of a simulated collect, read back with code of the test's own, and the effect of every switch."""

import datetime as dt
import hashlib
import re
import struct
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.cli.program import main
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line
from hyperpaint.simulation.atmosphere import Sky
from hyperpaint.simulation.camera import convolve_gaussian
from hyperpaint.simulation.flight import Checkerboard, CheckerboardFlight, PlanFlight
from hyperpaint.simulation.instruments import SVC_DETECTORS, svc_wavelengths
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


def test_headers_say_what_headwall_says(collect: Path) -> None:
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


def test_cubes_hold_the_recorded_frames(collect: Path) -> None:
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


def test_collect_toml_names_files_that_exist(collect: Path) -> None:
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


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_same_seed_same_bytes_whatever_the_blocks(tmp_path: Path) -> None:
    made = [
        simulate_collect(tmp_path / str(block), **SMALL, block_lines=block, cubes=2, dropped=3).parent
        for block in (7, 32, 500)
    ]
    first = digests(made[0])
    assert len(first) > 20
    for other in made[1:]:
        assert digests(other) == first
    changed = simulate_collect(tmp_path / "seed", **{**SMALL, "seed": 8}).parent
    assert digests(changed)["dark/raw_0"] != first["dark/raw_0"]


def test_progress_and_overwrite(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    simulate_collect(tmp_path / "a", **SMALL, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(32, 70), (64, 70), (70, 70)]
    with pytest.raises(StoreError, match="folder-not-empty"):
        simulate_collect(tmp_path / "a", **SMALL)
    (tmp_path / "a" / "mine.txt").write_text("kept")
    before = digests(tmp_path / "a")
    simulate_collect(tmp_path / "a", **SMALL, overwrite=True)
    assert digests(tmp_path / "a") == before
    assert not (simulate_collect(tmp_path / "b", **SMALL, truth=False).parent / "truth.zarr").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="folder-is-file"):
        simulate_collect(tmp_path / "file", **SMALL)


def test_a_real_collect_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight" / "raw_0").write_text("precious")
    for text in (None, "[collect]\n"):
        if text is not None:
            (tmp_path / "collect.toml").write_text(text)
        with pytest.raises(StoreError, match="folder-foreign"):
            simulate_collect(tmp_path, **SMALL, overwrite=True)
    assert (tmp_path / "flight" / "raw_0").read_text() == "precious"


def test_panels_reflect_what_they_say() -> None:
    line = simulate_line(lines=60, bands=30, columns=32, noise=False, quantise=False)
    for level in (5, 20, 50, 90):
        panel = line["surface"] == list(MATERIALS).index(f"panel_{level:02d}")
        values = line["true_reflectance"].transpose(..., "band").values[panel.values]
        assert len(values) > 0
        np.testing.assert_allclose(values, level / 100, rtol=3e-7)


def test_radiance_is_the_weighted_irradiance_over_pi() -> None:
    line = simulate_line(
        lines=60, bands=30, columns=32, noise=False, quantise=False, matched=True, drift_per_minute=0.0
    )
    matched = np.broadcast_to(line["matched_irradiance"].values[0], line["true_radiance"].shape)
    ratio = (line["true_radiance"].values * np.pi / matched).transpose(0, 2, 1)[
        (line["surface"] == list(MATERIALS).index("panel_50")).values
    ]
    np.testing.assert_allclose(ratio, 0.5, rtol=3e-7)
    flight = PlanFlight(SimulationSettings(lines=60, bands=30, columns=32, texture=0.0))
    grid, imager = flight.grid, flight.imager
    by_hand = imager.integrals((MATERIALS["green"](grid) * flight.sky.sum(axis=0))[None], grid)[0]
    by_hand /= imager.integrals(flight.sky.sum(axis=0)[None], grid)[0]
    made = flight.lines(0, 1)  # seen at t = 0, where both factors are one
    index = list(MATERIALS).index("green")
    table = flight._reflected[:, :, slice(index * 32, (index + 1) * 32)].sum(axis=0) / flight.incident.sum(
        axis=0
    )
    np.testing.assert_allclose(table, by_hand, rtol=1e-12)
    assert made.counts.dtype == np.float32


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


def test_dropped_frames_in_memory() -> None:
    line = simulate_line(lines=12, bands=3, columns=3, dropped=[4, 5])
    assert line["counts"].dtype == np.uint16
    assert (line["counts"].values[[4, 5]] == 65535).all()
    np.testing.assert_array_equal(np.flatnonzero(np.isnat(line["time"].values)), [4, 5])
    np.testing.assert_array_equal(line["frame"], np.arange(12))
    settings = SimulationSettings(lines=40, cubes=2, dropped=9)
    assert len(settings.dropped_frames) == 9
    assert not {0, 19, 20, 39} & set(settings.dropped_frames.tolist())


def test_in_memory_line_equals_the_files(collect: Path) -> None:
    line = simulate_line(**SMALL, dropped=[30, 31, 44], bad_elements=3, glint=0.05)
    counts = np.concatenate([cube(collect / "flight" / f"raw_{n}") for n in (0, 23, 46)])
    recorded = np.isfinite(line["counts"].values[:, 0, 0]) & ~np.isnat(line["time"].values)
    np.testing.assert_array_equal(line["counts"].values[recorded], counts)
    np.testing.assert_allclose(line["dark_counts"], cube(collect / "dark" / "raw_0").mean(axis=0), rtol=1e-6)


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
    with pytest.raises(SchemaError, match=next(iter(wrong))):
        simulate_collect(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_all_problems_are_listed_at_once() -> None:
    with pytest.raises(SchemaError) as caught:
        simulate_line(lines=-1, exposure_time_ms=0.0, srf_shape="box", read_noise=-1.0)
    for name in ("lines", "exposure_time_ms", "srf_shape", "read_noise"):
        assert f"{name}=" in str(caught.value)
    with pytest.raises(SchemaError, match="fwhm, smell"):
        simulate_line(smell=1, fwhm=3)


def test_files_hold_whole_counts_only(tmp_path: Path) -> None:
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
            np.testing.assert_allclose(rows[:, 0], svc_wavelengths(), atol=20)


def test_svc_files_hold_the_paints(spectrometers: Path) -> None:
    files = sorted((spectrometers / "svc").glob("*.sig"))
    assert [path.stem for path in files] == sorted(CAR_PAINTS)
    for path in files:
        keys, rows = svc(path)
        assert (keys["name"], len(rows)) == (path.name, 1024)
        np.testing.assert_array_equal(rows[:, 0], svc_wavelengths())
        np.testing.assert_allclose(rows[:, 3], 100 * rows[:, 2] / rows[:, 1], atol=0.0051)
        # what a detector's resolution takes from the paints' edges, most at the sun's G band, 430 nm
        np.testing.assert_allclose(
            rows[:, 2] / rows[:, 1], reflectance([path.stem], rows[:, 0])[0], atol=0.0045
        )


def test_svc_counts_radiance_in_units_of_the_instrument(spectrometers: Path) -> None:
    # 1e-10 W cm-2 sr-1 nm-1: a white panel at noon, by hand from the light that the flight has
    _, rows = svc(spectrometers / "svc" / "grey.sig")
    flight = PlanFlight(SimulationSettings(lines=4, bands=4, columns=4))
    for nm in (550.2, 870.0):
        row = int(np.abs(rows[:512, 0] - nm).argmin())
        weight = np.exp(-4 * np.log(2) * ((flight.grid - rows[row, 0]) / SVC_DETECTORS[0].fwhm) ** 2)
        assert rows[row, 1] * 1e-10 * 1e4 == pytest.approx(
            ((flight.sky.sum(axis=0) * weight).sum() / weight.sum()) / np.pi, rel=1e-3
        )


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


def test_asd_files_hold_the_paints(spectrometers: Path) -> None:
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


def test_collect_toml_names_the_references(spectrometers: Path) -> None:
    assert tomllib.loads((spectrometers / "collect.toml").read_text())["references"] == [
        {"instrument": "svc", "files": "svc/*.sig"},
        {"instrument": "asd", "files": "asd_reflectance/*.asd"},
    ]
    hp.open_collect(spectrometers / "collect.toml")


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


def test_ground_is_level() -> None:
    assert np.abs(flight().lines(0, 70).layers["height"] - 160.0).max() < 1e-6


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
    options = ["--scene", "checkerboard", "--lines", "8", "--columns", "40", "--bands", "4", "--quiet"]
    flown = (
        "swath=0.5 wobble=calm course=90 boresight=0.4,-0.6,0.8 lever_arm=0.05,-0.02,0.12 navigation_rate=50"
    )
    for setting in flown.split():
        options += ["--set", setting]
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "sim"), *options])
    assert done.exit_code == 0, done.output
    truth = xr.open_zarr(tmp_path / "sim" / "truth.zarr")
    assert truth.attrs["lever_arm"] == [0.05, -0.02, 0.12]
    assert np.ptp(truth["north"].values) > np.ptp(truth["east"].values)  # eight lines, flown east
    done = CliRunner().invoke(
        main, ["simulate", str(tmp_path / "two"), "--scene", "plan", "--set", "swath=3"]
    )
    assert done.exit_code == 2
    assert "swath=3.0, expected 16 for all scenes but a checkerboard" in done.output
