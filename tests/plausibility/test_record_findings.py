"""Faults of the irradiance record as findings of a collect, and in a line without a collect."""

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning
from hyperpaint.base.schema import Quality
from hyperpaint.io.spectrometers.record_faults import judge_record
from hyperpaint.simulation import simulate_collect, simulate_line
from hyperpaint.workflows.collects import check_collect
from hyperpaint.workflows.pipeline import process

pytestmark = pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    simulate_collect(
        folder, scene="plan", lines=40, bands=24, columns=12, irradiance_margin_s=20, truth=False
    )
    return folder


def _change_counts(folder: Path, change: Callable[[int, np.ndarray], np.ndarray]) -> None:
    # Change the raw counts of every scan; 484 bytes of header come before them
    for number, path in enumerate(sorted((folder / "asd").glob("*.asd"))):
        data = bytearray(path.read_bytes())
        size = 8 * int.from_bytes(data[204:206], "little")
        counts = np.frombuffer(bytes(data[484 : 484 + size]), "<f8")
        data[484 : 484 + size] = np.asarray(change(number, counts), "<f8").tobytes()
        path.write_bytes(data)


@pytest.mark.parametrize(
    ("change", "code", "is_refused"),
    [
        (lambda _, counts: np.minimum(counts, 0.8 * counts.max()), "irradiance-channels", False),
        (lambda number, counts: counts * (0.1 if number == 9 else 1.0), "irradiance-scans", False),
        (lambda number, counts: counts * (0.5 if number > 10 else 1.0), "irradiance-step", True),
    ],
)
def test_faults_of_the_record_are_findings(
    flown: Path,
    tmp_path: Path,
    change: Callable[[int, np.ndarray], np.ndarray],
    code: str,
    is_refused: bool,
) -> None:
    folder = shutil.copytree(flown, tmp_path / "collect")
    assert check_collect(folder / "collect.toml") == ()
    _change_counts(folder, change)
    with warnings.catch_warnings(record=True) as checked:
        warnings.simplefilter("always")
        (finding,) = check_collect(folder / "collect.toml")
    assert (finding.kind.name, finding.kind.refused) == (code, is_refused)
    assert not [each for each in checked if "irradiance-" in str(each.message)]
    if is_refused:
        expect_error(
            CollectError,
            code,
            lambda: process(folder / "collect.toml", tmp_path / "lot.zarr", reflectance="none"),
        )
        return
    with warnings.catch_warnings(record=True) as processed:
        warnings.simplefilter("always")
        process(folder / "collect.toml", tmp_path / "lot.zarr")
    assert [
        getattr(each.message, "code", "") for each in processed if "irradiance-" in str(each.message)
    ] == [code]


@pytest.mark.parametrize("value", [0.0, -1.0, 9999.0, np.nan])
def test_light_that_cannot_be_is_missing(value: float) -> None:
    line = simulate_line(lines=24, bands=24, columns=6, irradiance_noise=0.002)
    record = line["irradiance"].load()
    times = record["irradiance_time"]
    inside = times.values.searchsorted(line["time"].values[12])
    changed = record.where(times != times[inside], value)
    right = hp.reflectance(line)
    found = hp.reflectance(line.assign(irradiance=changed))
    np.testing.assert_allclose(found["reflectance"], right["reflectance"], rtol=0.01)
    assert not (found["quality"] & np.uint16(Quality.ILLUMINATION_UNSTABLE)).any()


@pytest.mark.parametrize(("every", "dark"), [(5, 1), (2, 1), (30, 6)])
@pytest.mark.parametrize("level", [0.0, 1e-3])
def test_scans_of_a_closed_shutter_are_left_out(every: int, dark: int, level: float) -> None:
    nm, scan = np.arange(400.0, 1000.0), np.arange(60)
    is_dark, rng = (scan + every // 2) % every < dark, np.random.default_rng(every)
    stamps = np.datetime64("2024-06-01T12", "ns") + scan * np.timedelta64(2, "s")
    cloud = 0.1 + 0.9 / (1.0 + np.exp((scan - 30.0) / 8.0))[:, None]
    values = np.where(is_dark[:, None], level, 1.0) * cloud * (1.2 - nm / 2000.0)
    values += 1e-4 * rng.normal(size=values.shape)
    kept, faults = judge_record(nm, stamps, values)
    assert (np.isfinite(kept).all(axis=1) == ~is_dark).all()
    assert [fault.code for fault in faults] == ["irradiance-scans"]


@pytest.mark.parametrize(("scans", "clouded"), [(5, 1), (5, 2), (6, 3)])
def test_a_cloud_at_the_end_of_a_short_record_stays(scans: int, clouded: int) -> None:
    nm, stamps = np.arange(400.0, 1000.0), np.datetime64("2024-06-01T12", "ns") + np.arange(scans) * 10**10
    level = np.where(np.arange(scans) < scans - clouded, 1.0, 0.6)[:, None]
    noise = 1.0 + 0.002 * np.random.default_rng(scans).normal(size=(scans, nm.size))
    values, _ = judge_record(nm, stamps, level * noise * (1.0 + np.exp(-(((nm - 500.0) / 300.0) ** 2))))
    assert np.isfinite(values).all()


def test_a_scan_that_is_left_out_is_told() -> None:
    line = simulate_line(lines=24, bands=24, columns=6, irradiance_noise=0.002)
    scale = xr.where(np.arange(line.sizes["irradiance_time"]) == 5, 0.1, 1.0)
    shaded = line.assign(irradiance=line["irradiance"] * xr.DataArray(scale, dims="irradiance_time"))
    with pytest.warns(PaintWarning) as caught:
        hp.reflectance(shaded).compute()
    assert "irradiance-scans" in {warning.message.code for warning in caught}  # type: ignore[union-attr]


def test_warnings_stay_where_a_collect_cannot_be_opened(flown: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(flown, tmp_path / "c")
    _change_counts(folder, lambda number, counts: counts * (number != 3))
    (folder / "flight/frameIndex_0.txt").write_text("no index")
    with pytest.warns(PaintWarning, match="zero"), pytest.raises(CollectError):
        check_collect(folder / "collect.toml")
