"""What `describe_path` says of files and stores; the command line's own tests cover every kind of file."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr
from support.commands import hyperpaint
from support.flown_lines import EAST, MAP, NORTH, fly, located
from support.library_examples import make_library
from support.refusals import expect_error, expect_refusals, expect_words
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.cli.info_command import describe_path
from hyperpaint.io.store.writer import WholeRun
from hyperpaint.report import write_report


@pytest.fixture
def line() -> xr.Dataset:
    counts = np.ones((40, 3, 2), np.uint16)
    return xr.Dataset(
        {
            "counts": (("along_track", "band", "cross_track"), counts, {"units": "count"}),
            "exposure_time": ((), 0.005, {"units": "s"}),
            "read_noise": ((), np.float32(2.0), {"units": "count"}),
        },
        {"wavelength": ("band", [450.0, 550.0, 650.0], {"units": "nm"})},
        {"exposure_source": "collect.toml"},
    )


def test_groups_say_whether_they_are_complete(tmp_path: Path, line: xr.Dataset) -> None:
    hp.to_store(line, tmp_path / "lot.zarr", "flightlines/raw_0")
    expect_words(
        describe_path(tmp_path / "lot.zarr"),
        "1 group with arrays",
        "state: complete, written 20",
        "counts: 40 along_track x 3 band x 2 cross_track, uint16 [count]",
        "wavelength: 450 to 650 nm",
        "exposure: 5 ms (collect.toml)",
        "also holds: read_noise",
    )
    hp.to_store(line, tmp_path / "damaged.zarr")
    next((tmp_path / "damaged.zarr/counts/c").rglob("*/0/0")).unlink()
    assert "NOT COMPLETE: " in describe_path(tmp_path / "damaged.zarr")
    # a copy without a manifest, and a store of another program
    plain_zarr(line.assign_attrs(hyperpaint_version="0.1"), tmp_path / "copy.zarr")
    plain_zarr(line, tmp_path / "other.zarr")
    unknown = "not in a manifest, so that completeness is unknown; written at an unknown time by another"
    expect_words(describe_path(tmp_path / "copy.zarr"), "not in a manifest", without=("another program",))
    expect_words(describe_path(tmp_path / "other.zarr"), unknown, without=("NOT COMPLETE",))
    expect_refusals(
        (hp.FormatError, "file-not-found", lambda: describe_path(tmp_path / "none")),
        (hp.StoreError, "format-unknown", lambda: describe_path(tmp_path)),
    )


def test_the_simulators_stores(tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path / "sim", scene="plan", lines=8, bands=4, columns=4)
    for name in ("calibration.zarr", "truth.zarr"):
        assert "not in a manifest" in describe_path(collect.parent / name)
    assert "5 ms (collect.toml)" in describe_path(collect)


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv", "paints.zarr"])
def test_a_paint_library(tmp_path: Path, name: str) -> None:
    path = hp.write_library(make_library().isel(band=[0, 1, 4]), tmp_path / name)
    text = describe_path(path)
    expect_words(text, "Grün; Grün", "reflectance", "400 to 800 nm")
    if path.suffix != ".zarr":
        expect_words(text, "5 spectra", "make")


def test_a_folder_of_texts_of_single_spectra() -> None:
    folder = Path(__file__).parents[1] / "io" / "library" / "conformance" / "ecostress"
    assert "3 spectra" in describe_path(folder)


# --- `verify`, `info` and `report` of a store that is not whole: what it lacks, and how to finish it ---


@pytest.fixture
def collect(tmp_path: Path) -> Path:
    return tiny_collect(tmp_path / "raw", 2)


def test_an_unfinished_store_says_how_it_is_finished(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, write = tmp_path / "lot.zarr", WholeRun.write

    def stop(self: WholeRun, group: str, dataset: xr.Dataset, **options: Any) -> None:
        if group.endswith("raw_1"):
            raise KeyboardInterrupt
        write(self, group, dataset, **options)

    monkeypatch.setattr(WholeRun, "write", stop)
    expect_error(KeyboardInterrupt, None, lambda: hp.process(collect, out, to="radiance"))
    again = "unfinished: 1 of 2 groups are written, without /flightlines/raw_1; to finish it"
    for command, status in (("verify", 1), ("info", 0)):
        expect_words(hyperpaint(command, out, status=status).output, again, f"--out {out} --to radiance")
    page = write_report(out, tmp_path / "report.html")
    assert page.flightlines == ("flightlines/raw_0",)
    assert again[:40] in page.problems[0]


def test_inputs_are_compared_on_request(collect: Path, tmp_path: Path) -> None:
    out = hp.process(collect, tmp_path / "lot.zarr", to="radiance")
    assert "all unchanged" in hyperpaint("verify", out, "--inputs", status=0).output
    collect.with_name("raw_0").write_bytes(bytes(collect.with_name("raw_0").stat().st_size))
    changed = hyperpaint("verify", out, "--collect", collect, status=1).output
    assert "/flightlines/raw_0: its inputs have changed" in changed
    hyperpaint("verify", out, status=0)


# --- `info` and `report` of maps, regions and folders, as text and as JSON ----------------------------------


pytest.importorskip("pyproj")
SQUARE = np.array([(EAST, NORTH), (EAST + 1, NORTH), (EAST + 1, NORTH + 1), (EAST, NORTH + 1)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    flown = fly(40, 30, "none", heading=30.0)
    values = np.random.default_rng(0).random((40, 6, 30)).astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
    line = line.assign_coords(wavelength=("band", np.linspace(450.0, 700.0, 6), {"units": "nm"}))
    hp.to_store(hp.geometry.orthorectify(line, 0.01), folder / "map.zarr")
    hp.to_store(hp.geometry.orthorectify(line, 0.01, grid="flight"), folder / "turned.zarr")
    hp.write_regions(
        hp.Regions((hp.Region("hood", SQUARE, properties={"make": "x"}),), "map", MAP), folder / "r.geojson"
    )
    return folder


def run(*words: object) -> str:
    return hyperpaint(*words, status=0).output


def facts(path: Path) -> dict[str, Any]:
    # Return what `info --json` says; the same as the text does
    document: dict[str, Any] = json.loads(run("info", path, "--json"))
    text = run("info", path)
    for name, value in document.items():
        for part in value if isinstance(value, list) else [value]:
            assert part in text, name
    return document


def test_info_of_maps(folder: Path) -> None:
    facts(folder / "map.zarr")
    expect_words(run("info", folder / "map.zarr"), "WGS 84 / UTM zone 17N", "0.01 x 0.01 map units, north up")
    turned = re.search(r"up is ([0-9.]+) degrees from north", run("info", folder / "turned.zarr"))
    assert turned is not None
    assert float(turned[1]) == pytest.approx(30.0, abs=0.1)


def test_info_of_a_geotiff(folder: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = hp.io.write_geotiff(hp.open_store(folder / "map.zarr"), tmp_path / "map.tif")
    document = facts(path)
    with rasterio.open(path) as raster:
        assert document["map"] == f"{raster.height} x {raster.width} cells, 6 bands, float32"
        bounds = raster.bounds
    assert (
        document["bounds"]
        == f"x {bounds.left:.10g} to {bounds.right:.10g}, y {bounds.bottom:.10g} to {bounds.top:.10g}"
    )
    assert (document["wavelength"], document["crs"]) == ("450 to 700 nm", "WGS 84 / UTM zone 17N")
    # what only calls itself so, and would have GDAL read another file
    trap = tmp_path / "trap.tif"
    source = f"<SimpleSource><SourceFilename>{path}</SourceFilename></SimpleSource>"
    band = f'<VRTRasterBand dataType="Byte" band="1">{source}</VRTRasterBand>'
    trap.write_text(f'<VRTDataset rasterXSize="9" rasterYSize="9">{band}</VRTDataset>')
    assert "not a TIFF" in hyperpaint("info", trap, status=2).output


def test_info_of_regions(folder: Path) -> None:
    document = facts(folder / "r.geojson")
    assert (document["is"], (document["names"], document["crs"], document["also says"])) == (
        "1 region in coordinates of the map",
        ("hood", MAP, "make"),
    )


def test_info_of_a_field_folder(tmp_path: Path) -> None:
    document = facts(
        hp.simulate_collect(tmp_path / "day", scene="plan", lines=8, bands=8, columns=6, truth=False).parent
    )
    assert document["is"].startswith("folder of a field day: 1 raw cube")
    assert any("frame index" in str(text) for text in document.values())
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "format-unknown" in hyperpaint("info", empty, status=2).output


@pytest.mark.parametrize(
    ("name", "head", "expected"),
    [
        ("a.nc", b"\x89HDF\r\n\x1a\n", "xr.open_dataset"),
        ("a.xlsx", b"PK\x03\x04", "save the sheet as CSV"),
        ("a.pdf", b"%PDF-1.7", "a PDF"),
        ("a.fits", b"SIMPLE  =", "astropy"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "scipy.io.loadmat"),
    ],
)
def test_files_of_other_programs_are_named(tmp_path: Path, name: str, head: bytes, expected: str) -> None:
    (tmp_path / name).write_bytes(head + b"\0" * 40)
    expect_refusals((hp.FormatError, "format-unknown", expected, lambda: describe_path(tmp_path / name)))


def test_a_report_of_a_map(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert "map map.zarr" in run("report", folder / "map.zarr", "--out", tmp_path / "map.html", "--quiet")
    page = (tmp_path / "map.html").read_text()
    expect_words(page, "WGS 84 / UTM zone 17N", without=("could not be shown",))
    assert page.count("data:image/png") >= 2  # true colour, and how reflectance is spread


@pytest.mark.parametrize("package", ["pyogrio", "fiona"])
def test_regions_of_a_geopackage(
    folder: Path, tmp_path: Path, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(package)
    import importlib.util

    drawn = hp.read_regions(folder / "r.geojson")
    path = tmp_path / "r.gpkg"
    if package == "pyogrio":
        import pyogrio
        import shapely

        shapes = np.array([shapely.to_wkb(shapely.Polygon(one.polygon)) for one in drawn])
        columns = [np.array(["hood"], object), np.array(["x"], object)]
        pyogrio.raw.write(
            path, shapes, columns, np.array(["name", "make"]), crs=MAP, geometry_type="Polygon", layer="cars"
        )
    else:
        import fiona

        schema = {"geometry": "Polygon", "properties": {"name": "str", "make": "str"}}
        with fiona.open(path, "w", driver="GPKG", crs=MAP, schema=schema, layer="cars") as layer:
            layer.writerecords([one.feature() for one in drawn])
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: found(name) if name == package else None)
    read = hp.read_regions(path)
    assert read.coordinates == "map"
    np.testing.assert_allclose(np.sort(read[0].polygon, axis=0), np.sort(drawn[0].polygon, axis=0))
    assert (read[0].name, dict(read[0].properties)["make"]) == ("hood", "x")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    expect_error(hp.errors.MissingExtraError, "extra-missing", lambda: hp.read_regions(path))
    path.write_text("<OGRVRTDataSource/>")
    expect_error(hp.FormatError, r"no gpkg file", lambda: hp.read_regions(path))
