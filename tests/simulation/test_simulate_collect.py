"""The files of a simulated collect, read back with code of the test's own, and the effect of every switch."""

import hashlib
import itertools
import struct
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors

from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line
from hyperpaint.simulation.atmosphere import Sky
from hyperpaint.simulation.camera import convolve_gaussian
from hyperpaint.simulation.flight import PlanFlight
from hyperpaint.simulation.rendering.scene_spectra import MATERIALS

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
    ],
    ids=str,
)  # fmt: skip
def test_hostile_arguments_are_refused_before_anything_is_written(
    tmp_path: Path, wrong: dict[str, Any]
) -> None:
    with pytest.raises(SchemaError):
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


def test_memory_is_used_again_without_a_trace() -> None:
    flight = PlanFlight(SimulationSettings(**SMALL))
    fresh = [flight.lines(a, b).counts.copy() for a, b in itertools.pairwise((0, 32, 64, 70))]
    memory = flight.lines(0, 32)
    for kept, (first, last) in zip(fresh, itertools.pairwise((0, 32, 64, 70)), strict=True):
        np.testing.assert_array_equal(flight.lines(first, last, into=memory).counts, kept)
