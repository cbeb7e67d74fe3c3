"""`hyperpaint signatures`: from a processed store and a GeoJSON file to a stored library."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.workflows.library_files import write_signatures

signatures = partial(hyperpaint, "signatures")
HOOD = hp.Region("hood", [(1, 2), (9, 2), (9, 12), (1, 12)], flightline="raw_0", properties={"make": "x"})
ROOF = hp.Region("roof", [(2, 3), (12, 9), (4, 15)], flightline="raw_16", properties={"reference": "svc"})


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a processed collect of two flight lines
    folder = tmp_path_factory.mktemp("collect")
    collect = hp.simulate_collect(
        folder / "raw", lines=32, bands=24, columns=16, cubes=2, scene="plan", truth=False
    )
    return hp.process(collect, folder / "lot.zarr")


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
    assert signatures(store, "--regions", drawn, "--out", out).exit_code == 0
    before = xr.open_zarr(out).attrs["created"]
    assert (
        signatures(store, "--regions", drawn, "--out", out).exit_code,
        xr.open_zarr(out).attrs["created"],
    ) == (
        0,
        before,
    )
    refused = signatures(store, "--regions", drawn, "--out", out, "--smooth", "box", "--window", 5, status=2)
    assert "pass --overwrite to replace it" in refused.stderr
    signatures(
        store, "--regions", drawn, "--out", out, "--smooth", "box", "--window", 5, "--overwrite", status=0
    )
    assert xr.open_zarr(out).attrs["smoothing"] == "box, 5 bands"


def test_regions_without_a_flight_line(store: Path, tmp_path: Path) -> None:
    nameless = hp.Regions((hp.Region("hood", HOOD.polygon),))
    path = hp.write_regions(nameless, tmp_path / "r.geojson")
    done = signatures(store, "--regions", path, "--out", tmp_path / "l.zarr", status=2)
    assert "'hood' names no flight line, expected 'raw_0' or 'raw_16'" in done.stderr


@pytest.mark.slow
def test_bad_calls_are_one_message(store: Path, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "l.zarr"
    bad = tmp_path / "bad.geojson"
    bad.write_text("{")
    far = hp.write_regions(
        hp.Regions((hp.Region("far", [(90, 0), (99, 0), (99, 9)], (), "raw_0"),)), tmp_path / "f"
    )
    for words, told in {
        (store, "--regions", bad, "--out", out): "bad.geojson: not GeoJSON",
        (store, "--regions", far, "--out", out): "region 'far' contains no pixel",
        (
            store,
            "--regions",
            drawn,
            "--out",
            out,
            "--keep",
            "glitter",
        ): "no flag 'glitter', expected some of saturated",
        (store, "--regions", drawn, "--out", store / "signatures"): "in the store itself",
        (store, "--regions", drawn, "--out", out, "--smooth", "box", "--window", "4"): "window 4",
        (
            store,
            "--regions",
            drawn,
            "--out",
            out,
            "--min-pixels",
            "5000",
            "--no-flags",
        ): "'hood': 99 of 99 pixels are usable",
        (drawn.parent, "--regions", drawn, "--out", out): "not a Zarr store",
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
def test_flags_that_are_kept(store: Path, drawn: Path, tmp_path: Path) -> None:
    made = write_signatures(store, drawn, tmp_path / "l.zarr", keep=["GLINT", "shadow"])
    assert made.attrs["exclude"] == "saturated irradiance_gap adjacency mixed_edge no_data"
    told: list[tuple[int, int]] = []
    write_signatures(store, drawn, tmp_path / "m.zarr", progress=lambda *each: told.append(each))
    assert told[-1][0] == told[-1][1]
    np.testing.assert_array_equal(made.n + made.n_excluded, [99, made.n[1] + made.n_excluded[1]])


@pytest.mark.slow
def test_flags_are_kept_or_excluded(store: Path, drawn: Path, tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="option-conflict"):
        write_signatures(store, drawn, tmp_path / "l.zarr", keep=["glint"], exclude=hp.Quality.SHADOW)
    assert not (tmp_path / "l.zarr").exists()
    made = write_signatures(store, drawn, tmp_path / "l.zarr", keep=["glint"], exclude=None)
    assert "glint" not in made.attrs["exclude"]
    made = write_signatures(store, drawn, tmp_path / "m.zarr", exclude=hp.Quality.SHADOW)
    assert made.attrs["exclude"] == "shadow"


def test_command_without_the_mirrored_sky(store: Path, drawn: Path, tmp_path: Path) -> None:
    out = tmp_path / "l.zarr"
    signatures(store, "--regions", drawn, "--out", out, "--specular-sky", status=0)
    assert xr.open_zarr(out).attrs["corrections"].startswith("mirrored_sky_removed: F0 0.04")
