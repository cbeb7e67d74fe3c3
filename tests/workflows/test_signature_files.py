"""`hyperpaint signatures`: from a processed store and a GeoJSON file to a stored library."""

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.files import write_file
from support.refusals import expect_error, expect_refusals, expect_words
from support.tiny_collects import without_references

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning, SchemaError, StoreError
from hyperpaint.radiometry.panels import declared_panels
from hyperpaint.workflows.field_day import write_signatures

signatures = partial(hyperpaint, "signatures")
NO_ATTITUDE = pytest.mark.filterwarnings(
    "ignore:.*of the light sensor have no attitude:hyperpaint.base.errors.PaintWarning"
)
HOOD = hp.Region("hood", [(1, 2), (9, 2), (9, 12), (1, 12)], flightline="raw_0", properties={"make": "x"})
ROOF = hp.Region("roof", [(2, 3), (12, 9), (4, 15)], flightline="raw_16", properties={"reference": "svc"})


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a processed collect of two flight lines
    folder = tmp_path_factory.mktemp("collect")
    collect = hp.simulate_collect(
        folder / "raw", lines=32, bands=24, columns=16, cubes=2, scene="plan", truth=False
    )
    return hp.process(without_references(collect), folder / "lot.zarr")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hp.write_regions(hp.Regions((HOOD, ROOF)), tmp_path_factory.mktemp("regions") / "r.geojson")


def test_command_makes_the_library_of_the_function(store: Path, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "paints.zarr"
    done = signatures(store, "--regions", drawn, "--out", out, "--members", 7, "--no-flags", status=0)
    assert done.stdout.splitlines()[0] == f"{out}: 2 paints, 24 bands"
    assert done.stdout.splitlines()[1].startswith("  hood  ")
    assert hp.verify(out).ok
    found = xr.open_zarr(out).load()
    lines = {
        name: hp.open_store(store, f"flightlines/{name}").paint.reflectance(uncertainty=True)
        for name in ("raw_0", "raw_16")
    }
    expected = hp.extract_signatures(lines, drawn, members=7)
    for name in expected.data_vars:
        assert found[name].values.tobytes() == expected[name].values.tobytes(), name
    assert (found["reference"].values.tolist(), found.flightline.values.tolist()) == (
        ["", "svc"],
        ["raw_0", "raw_16"],
    )
    assert (found.reflectance_u_random > 0).any("band").all()
    assert (found.attrs["store"], sorted(path.name for path in tmp_path.iterdir())) == (
        "lot.zarr",
        ["paints.zarr"],
    )


@pytest.mark.slow
def test_command_again(store: Path, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "paints.zarr"
    call = partial(signatures, store, "--regions", drawn, "--out", out, "--no-flags")
    call(status=0)
    before = xr.open_zarr(out).attrs["created"]
    call(status=0)
    assert xr.open_zarr(out).attrs["created"] == before
    smoothed = partial(call, "--smooth", "box", "--window", 5)
    assert "pass --overwrite to replace it" in smoothed(status=2).stderr
    smoothed("--overwrite", "--specular-sky", status=0)
    attrs = xr.open_zarr(out).attrs
    assert attrs["smoothing"] == "box, 5 bands"
    assert attrs["corrections"].startswith("mirrored_sky_removed: F0 0.04")


def test_regions_without_a_flight_line(store: Path, tmp_path: Path) -> None:
    path = hp.write_regions(hp.Regions((hp.Region("hood", HOOD.polygon),)), tmp_path / "r.geojson")
    done = signatures(store, "--regions", path, "--out", tmp_path / "l.zarr", status=2)
    assert "'hood' names no flight line, expected 'raw_0' or 'raw_16'" in done.stderr


@pytest.mark.slow
def test_bad_calls_are_one_message(store: Path, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "l.zarr"
    bad = write_file(tmp_path / "bad.geojson", "{")
    far = hp.write_regions(
        hp.Regions((hp.Region("far", [(90, 0), (99, 0), (99, 9)], (), "raw_0"),)), tmp_path / "f"
    )
    everything = ("--regions", drawn, "--out", out)
    for words, told in {
        (store, "--regions", bad, "--out", out): "bad.geojson: not GeoJSON",
        (store, "--regions", far, "--out", out): "region 'far' contains no pixel",
        (store, *everything, "--keep", "glitter"): "no flag 'glitter', expected some of saturated",
        (store, "--regions", drawn, "--out", store / "signatures"): "in the store itself",
        (store, *everything, "--smooth", "box", "--window", "4"): "window 4",
        (store, *everything, "--min-pixels", "5000", "--no-flags"): "'hood': 99 of 99 pixels are usable",
        (drawn.parent, *everything): "not a Zarr store",
        (store, "--regions", tmp_path / "none", "--out", out): "does not exist",
        (store, "--out", out): "no region can be proposed",
    }.items():
        done = signatures(*words, status=2)
        assert told in done.stderr, done.stderr
        assert "Traceback" not in done.output
        assert not out.exists()


def test_a_store_without_flight_lines(tmp_path: Path, drawn: Path) -> None:
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "other.zarr")
    expect_refusals(
        (
            StoreError,
            "flightline-missing",
            lambda: write_signatures(tmp_path / "other.zarr", drawn, tmp_path / "l.zarr"),
        ),
        (
            SchemaError,
            "output-in-store",
            lambda: write_signatures(tmp_path / "other.zarr", drawn, tmp_path / "other.zarr"),
        ),
    )


@pytest.mark.slow
def test_flags_are_kept_or_excluded(store: Path, drawn: Path, tmp_path: Path) -> None:
    write, steps = partial(write_signatures, store, drawn), list[tuple[int, int]]()
    both = {"keep": ["glint"], "exclude": hp.Quality.SHADOW}
    expect_error(SchemaError, "option-conflict", lambda: write(tmp_path / "l.zarr", **both))
    assert not (tmp_path / "l.zarr").exists()
    made = write(
        tmp_path / "l.zarr", keep=["GLINT", "shadow"], exclude=None, progress=lambda *step: steps.append(step)
    )
    assert made.attrs["exclude"] == "saturated irradiance_gap adjacency mixed_edge no_data"
    assert steps[-1][0] == steps[-1][1]
    np.testing.assert_array_equal(made.n + made.n_excluded, [99, made.n[1] + made.n_excluded[1]])
    assert write(tmp_path / "m.zarr", exclude=hp.Quality.SHADOW).attrs["exclude"] == "shadow"


# --- What a collect.toml says of its light sensor and its panels reaches the reflectance ---


@pytest.fixture
def collect(tmp_path: Path) -> Path:
    effects: dict[str, Any] = {"wobble": "rough", "irradiance_interval_s": 1, "clock_offset_s": 0.0}
    return without_references(
        hp.simulate_collect(
            tmp_path / "collect",
            scene="plan",
            lines=600,
            bands=6,
            columns=10,
            seed=17,
            truth=False,
            **effects,
        )
    )


def said(path: Path, old: str, new: str) -> Path:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


@NO_ATTITUDE
def test_a_light_sensor_on_the_aircraft_is_levelled(collect: Path) -> None:
    plain = hp.open_collect(collect)["irradiance"].to_dataset()
    levelled = hp.open_collect(said(collect, "[irradiance]", '[irradiance]\nmount = "aircraft"'))
    record = levelled["irradiance"].to_dataset()
    navigation = hp.open_navigation(collect.parent / "flight" / "imu_gps.txt")
    line = next(iter(levelled["flightlines"].children.values())).to_dataset()
    declared = {name: text for name, text in line.attrs.items() if name.startswith("convention_")}
    np.testing.assert_array_equal(
        record.irradiance, hp.light.level_irradiance(plain, navigation.assign_attrs(declared)).irradiance
    )
    there = np.isfinite(record.irradiance_tilt.values)
    assert 2 < there.sum() < there.size
    assert record.attrs["irradiance_mount"].startswith("aircraft, corrected to level")
    assert not np.array_equal(record.irradiance[there], plain.irradiance[there])


@NO_ATTITUDE
def test_it_needs_an_attitude_in_utc(collect: Path) -> None:
    said(collect, "[irradiance]", '[irradiance]\nmount = "aircraft"')
    lines = [
        each for each in collect.read_text(encoding="utf-8").splitlines() if not each.startswith("nav = ")
    ]
    # beside the cube it would be found
    (collect.parent / "flight" / "imu_gps.txt").rename(collect.parent / "flight" / "hidden.txt")
    collect.write_text("\n".join(lines), encoding="utf-8")
    caught = expect_error(CollectError, None, lambda: hp.open_collect(collect))
    assert caught.codes == ("line-times-missing", "attitude-missing")
    assert 'mount = "aircraft"' in caught.problems[1].found


PANEL = "\n[[panels]]\nline = 'raw_0'\nalong_track = [7, 11]\ncross_track = [44, 48]\n"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("panels") / "collect"
    return without_references(
        hp.simulate_collect(folder, scene="plan", lines=60, bands=24, columns=80, seed=17, truth=False)
    )


def with_panels(flown: Path, text: str) -> Path:
    return write_file(
        flown.with_name("declared.toml"), flown.read_text(encoding="utf-8") + text, encoding="utf-8"
    )


@NO_ATTITUDE
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


@NO_ATTITUDE
def test_a_declared_surface_reaches_the_line(flown: Path) -> None:
    (flown.parent / "own.csv").write_text("sun_zenith,factor\n0,1.06\n80,0.9\n", encoding="utf-8")
    panels = PANEL + "reflectance = 0.95\nsurface = 'sintered-ptfe'\nview = [4.0, 270.0]\n"
    panels += PANEL + "reflectance = 0.5\nsurface = 'own.csv'\n"
    line = hp.open_collect(with_panels(flown, panels))["flightlines"]["raw_0"].to_dataset()
    white, grey = declared_panels(line)
    assert (white.surface, white.view, grey.view) == ("sintered-ptfe", (4.0, 270.0), (0.0, 0.0))
    assert grey.surface.sel(sun_zenith=80.0).item() == 0.9


@NO_ATTITUDE
def test_what_a_panel_lacks_is_listed(flown: Path) -> None:
    def refused(text: str) -> CollectError:
        return expect_error(CollectError, None, lambda: hp.open_collect(with_panels(flown, text)))

    error = refused("\n[[panels]]\nline = 'raw_0'\nalong_track = [11, 7]\nreflectance = 0.5\n")
    assert error.codes == ("type-wrong", "key-missing")
    assert "along_track = [11, 7]" in error.problems[0].found
    assert "cross_track" in error.problems[1].found
    for text, code, *told in (
        (
            PANEL + "reflectance = 0.5\ncertificate = 'none.csv'\n", "file-not-found, option-conflict",
            "certificate",
        ),
        (PANEL + "reflectance = 0.5\nsurface = 'glossy'\n", "file-not-found", "surface"),
        (PANEL.replace("raw_0", "raw_7") + "reflectance = 0.5\n", "choice-unknown", "raw_0"),
        (
            PANEL + "reflectance = 50\nuncertainty = 5\n", "value-out-of-range",
            "reflectance = 50", "uncertainty = 5", "0 to below 1",
        ),
    ):  # fmt: skip
        error = refused(text)
        assert ", ".join(sorted(set(error.codes))) == code
        expect_words(str(error), *told)


@NO_ATTITUDE
def test_a_refused_panel_stops_the_run_before_it_writes(flown: Path, tmp_path: Path) -> None:
    # grass and asphalt
    collect = with_panels(flown, PANEL.replace("[44, 48]", "[0, 40]") + "reflectance = 0.5\n")
    refused = pytest.raises(CollectError, match="panel-refused")
    with pytest.warns(PaintWarning, match="show something else"), refused as error:
        hp.process(collect, tmp_path / "out.zarr")
    assert "Panel(..., tilt=(angle, azimuth))" in str(error.value)
    expect_words(
        error.value.text(on_command_line=True), "under [[panels]] of the collect.toml", without=("Panel(",)
    )


@NO_ATTITUDE
def test_an_attribute_that_declares_no_panels(flown: Path) -> None:
    line = next(iter(hp.open_collect(flown)["flightlines"].children.values())).to_dataset()
    for text in ("[{}]", "7", "{", '[{"along_track": 3}]'):
        expect_error(
            SchemaError, "panels-unreadable", partial(declared_panels, line.assign_attrs(panels=text))
        )


@pytest.fixture(scope="module")
def too_bright(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a flight whose calibration's gain is 8 % too high
    folder = tmp_path_factory.mktemp("gain") / "collect"
    collect = without_references(
        hp.simulate_collect(folder, scene="plan", lines=60, bands=24, columns=80, seed=23)
    )
    calibration = xr.open_zarr(folder / "calibration.zarr").load()
    calibration["radiance_gain"] = calibration.radiance_gain * np.float32(1.08)
    hp.to_store(calibration, folder / "calibration.zarr", overwrite=True)
    return collect


def signatures_of(store: Path, regions: Path, *words: str) -> xr.Dataset:
    out = store.with_name(f"paints_of_{store.name}")
    command = ["signatures", str(store), "--regions", str(regions), "--out", str(out), "--no-flags", *words]
    hyperpaint(*command, status=0)
    return xr.open_zarr(out).load()


@NO_ATTITUDE
@pytest.mark.slow
def test_signatures_have_the_scale_of_a_declared_panel(too_bright: Path, tmp_path: Path) -> None:
    regions = too_bright.parent / "regions.geojson"
    truth = xr.open_zarr(too_bright.parent / "truth.zarr")
    entry = PANEL + "reflectance = 0.5\nuncertainty = 0.02\n"
    departures, scaled, stores = [], with_panels(too_bright, entry), list[Path]()
    runs: list[tuple[Path, Any]] = [(too_bright, "stored"), (scaled, "stored"), (scaled, "none")]
    for number, (collect, kept) in enumerate(runs):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "the panel at lines .* measures", PaintWarning)
            store = hp.process(collect, tmp_path / f"{number}.zarr", reflectance=kept)
        stores.append(store)
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
    np.testing.assert_allclose(departures, [0.08, 0.0, 0.0], atol=0.01)
    for store in stores[1:]:
        line = hp.open_store(store, "flightlines/raw_0")
        again = hp.reflectance(line, uncertainty=True)
        np.testing.assert_allclose(again.panel_scale_u, line.panel_scale_u)
        assert "panel" in again.reflectance_u_systematic.attrs["components"]
        # a crop without the panel has its scale as well
        np.testing.assert_array_equal(
            hp.reflectance(line.isel(along_track=slice(30, 40), cross_track=slice(0, 20))).reflectance,
            again.reflectance.isel(along_track=slice(30, 40), cross_track=slice(0, 20)),
        )
