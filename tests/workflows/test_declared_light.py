"""What a collect.toml says of its light sensor and its panels reaches the reflectance."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_words, refusal

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning, SchemaError
from hyperpaint.radiometry.panels import declared_panels

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*of the light sensor have no attitude:hyperpaint.base.errors.PaintWarning"  # before and after
)


@pytest.fixture
def collect(tmp_path: Path) -> Path:
    effects: dict[str, Any] = {"wobble": "rough", "irradiance_interval_s": 1, "clock_offset_s": 0.0}
    return hp.simulate_collect(
        tmp_path / "collect", scene="plan", lines=600, bands=24, columns=28, seed=17, **effects
    )


def said(path: Path, old: str, new: str) -> Path:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def test_a_light_sensor_on_the_aircraft_is_levelled(collect: Path) -> None:
    plain = hp.open_collect(collect)["irradiance"].to_dataset()
    levelled = hp.open_collect(said(collect, "[irradiance]", '[irradiance]\nmount = "aircraft"'))
    record = levelled["irradiance"].to_dataset()
    navigation = hp.open_navigation(collect.parent / "flight" / "imu_gps.txt")
    line = next(iter(levelled["flightlines"].children.values())).to_dataset()
    declared = {name: text for name, text in line.attrs.items() if name.startswith("convention_")}
    expected = hp.light.level_irradiance(plain, navigation.assign_attrs(declared))
    np.testing.assert_array_equal(record.irradiance, expected.irradiance)
    there = np.isfinite(record.irradiance_tilt.values)
    assert 2 < there.sum() < there.size
    assert record.attrs["irradiance_mount"].startswith("aircraft, corrected to level")
    assert not np.array_equal(record.irradiance[there], plain.irradiance[there])


def test_it_needs_an_attitude_in_utc(collect: Path) -> None:
    said(collect, "[irradiance]", '[irradiance]\nmount = "aircraft"')
    text = collect.read_text(encoding="utf-8")
    lines = [each for each in text.splitlines() if not each.startswith("nav = ")]
    # beside the cube it would be found
    (collect.parent / "flight" / "imu_gps.txt").rename(collect.parent / "flight" / "hidden.txt")
    collect.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(CollectError) as caught:
        hp.open_collect(collect)
    assert caught.value.codes == ("line-times-missing", "attitude-missing")
    assert 'mount = "aircraft"' in caught.value.problems[1].found


PANEL = "\n[[panels]]\nline = 'raw_0'\nalong_track = [7, 11]\ncross_track = [44, 48]\n"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("panels") / "collect"
    return hp.simulate_collect(folder, scene="plan", lines=60, bands=24, columns=80, seed=17)


def with_panels(flown: Path, text: str) -> Path:
    path = flown.with_name("declared.toml")
    path.write_text(flown.read_text(encoding="utf-8") + text, encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_declared_panel_scales_its_line_and_is_reported(flown: Path, tmp_path: Path) -> None:
    (flown.parent / "grey.csv").write_text("nm;R\n380;0.5\n1020;0.5\n", encoding="utf-8")
    panels = PANEL + "reflectance = 0.5\nuncertainty = 0.02\n" + PANEL + "certificate = 'grey.csv'\n"
    store = hp.process(with_panels(flown, panels), tmp_path / "out.zarr")
    line = hp.open_store(store, "flightlines/raw_0")
    assert line.panel_factor.shape == (2, 24)
    np.testing.assert_array_equal(line.panel_state, 0)
    np.testing.assert_allclose(line.panel_factor[0], line.panel_factor[1], rtol=1e-6)
    np.testing.assert_allclose(np.median(line.panel_factor), 1.0, atol=0.01)
    assert float(line.panel_scale_u.min()) > 0.02
    seen = line.reflectance.isel(along_track=slice(7, 11), cross_track=slice(44, 48)).mean(
        ["along_track", "cross_track"]
    )
    np.testing.assert_allclose(seen, 0.5, rtol=2e-3)
    page = hp.report.write_report(store, tmp_path / "page.html", flags=False).path.read_text(encoding="utf-8")
    assert "Ratio of measured to certified reflectance" in page


def test_what_a_panel_lacks_is_listed(flown: Path) -> None:
    collect = with_panels(flown, "\n[[panels]]\nline = 'raw_0'\nalong_track = [11, 7]\nreflectance = 0.5\n")
    with pytest.raises(CollectError) as error:
        hp.open_collect(collect)
    assert error.value.codes == ("type-wrong", "key-missing")
    assert "along_track = [11, 7]" in error.value.problems[0].found
    assert "cross_track" in error.value.problems[1].found
    collect = with_panels(flown, PANEL + "reflectance = 0.5\ncertificate = 'none.csv'\n")
    with pytest.raises(CollectError, match="option-conflict") as error:
        hp.open_collect(collect)
    assert "certificate" in error.value.problems[0].found
    collect = with_panels(flown, PANEL.replace("raw_0", "raw_7") + "reflectance = 0.5\n")
    with pytest.raises(CollectError, match=r"raw_0.*choice-unknown"):
        hp.open_collect(collect)
    collect = with_panels(flown, PANEL + "reflectance = 50\nuncertainty = 5\n")
    with refusal(CollectError, "value-out-of-range", "reflectance = 50", "uncertainty = 5", "0 to below 1"):
        hp.open_collect(collect)


def test_a_refused_panel_stops_the_run_before_it_writes(flown: Path, tmp_path: Path) -> None:
    # grass and asphalt
    collect = with_panels(flown, PANEL.replace("[44, 48]", "[0, 40]") + "reflectance = 0.5\n")
    refused = pytest.raises(CollectError, match="panel-refused")
    with pytest.warns(PaintWarning, match="show something else"), refused as error:
        hp.process(collect, tmp_path / "out.zarr")
    assert "Panel(..., tilt=(angle, azimuth))" in str(error.value)
    text = error.value.text(on_command_line=True)
    expect_words(text, "under [[panels]] of the collect.toml", without=("Panel(",))


def test_an_attribute_that_declares_no_panels(flown: Path) -> None:
    line = next(iter(hp.open_collect(flown)["flightlines"].children.values())).to_dataset()
    for text in ("[{}]", "7", "{", '[{"along_track": 3}]'):
        with pytest.raises(SchemaError, match="panels-unreadable"):
            declared_panels(line.assign_attrs(panels=text))


@pytest.fixture(scope="module")
def too_bright(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a flight whose calibration's gain is 8 % too high
    folder = tmp_path_factory.mktemp("gain") / "collect"
    collect = hp.simulate_collect(folder, scene="plan", lines=60, bands=24, columns=80, seed=23)
    calibration = xr.open_zarr(folder / "calibration.zarr").load()
    calibration["radiance_gain"] = calibration.radiance_gain * np.float32(1.08)
    hp.to_store(calibration, folder / "calibration.zarr", overwrite=True)
    return collect


def signatures_of(store: Path, regions: Path, *words: str) -> xr.Dataset:
    out = store.with_name(f"paints_of_{store.name}")
    command = ["signatures", str(store), "--regions", str(regions), "--out", str(out), "--no-flags", *words]
    hyperpaint(*command, status=0)
    return xr.open_zarr(out).load()


@pytest.mark.slow
@pytest.mark.parametrize("kept", ["stored", "none"])
def test_signatures_have_the_scale_of_a_declared_panel(too_bright: Path, tmp_path: Path, kept: Any) -> None:
    regions = too_bright.parent / "regions.geojson"
    truth = xr.open_zarr(too_bright.parent / "truth.zarr")
    entry = PANEL + "reflectance = 0.5\nuncertainty = 0.02\n"
    departures = []
    for name, collect in (("plain", too_bright), ("scaled", with_panels(too_bright, entry))):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "the panel at lines .* measures", PaintWarning)
            store = hp.process(collect, tmp_path / f"{name}.zarr", reflectance=kept)
        paints = signatures_of(store, regions)
        drawn = hp.regions.regions_from(regions)
        expected = [
            truth.reflectance.isel(
                along_track=slice(*each.polygon[[0, 2], 1].astype(int)),
                cross_track=slice(*each.polygon[[0, 2], 0].astype(int)),
            ).mean(["along_track", "cross_track"])
            for each in drawn
        ]
        ratio = paints.reflectance / xr.concat(expected, "signature").values
        departures.append(float(ratio.median()) - 1.0)
    np.testing.assert_allclose(departures, [0.08, 0.0], atol=0.01)
    line = hp.open_store(store, "flightlines/raw_0")
    again = hp.reflectance(line, uncertainty=True)
    np.testing.assert_allclose(again.panel_scale_u, line.panel_scale_u)
    assert "panel" in again.reflectance_u_systematic.attrs["components"]
    # a crop without the panel has its scale as well
    crop = hp.reflectance(line.isel(along_track=slice(30, 40), cross_track=slice(0, 20)))
    expected_crop = again.reflectance.isel(along_track=slice(30, 40), cross_track=slice(0, 20))
    np.testing.assert_array_equal(crop.reflectance, expected_crop)
