"""A region in coordinates of the sensor and of the map: the same pixels, from Python and the command line."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import map_coordinates
from support.commands import hyperpaint

import hyperpaint as hp

LINES, COLUMNS = 120, 80
MOUNTED = (0.34, -0.95, -0.13)
BORESIGHT = ("--set", f"boresight={','.join(map(str, MOUNTED))}")
SETTINGS = ("focal_length_mm=12", "pixel_pitch_um=7.4", "column_order=left_to_right")
CAMERA = tuple(word for setting in SETTINGS for word in ("--set", setting))
#: Corners between pixels, so that no centre lies on an edge.
OUTLINES = {
    "panel": np.array([(8.5, 10.5), (60.5, 20.5), (70.5, 100.5), (12.5, 90.5)]),
    "hood": np.array([(20.5, 30.5), (61.5, 30.5), (61.5, 60.5), (20.5, 60.5)]),
}
Pairs = set[tuple[int, int]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a folder with a processed line, and its regions in both kinds of coordinates
    pytest.importorskip("pyproj")
    folder = tmp_path_factory.mktemp("lot")
    collect = hp.simulate_collect(
        folder / "collect", lines=LINES, bands=4, columns=COLUMNS, scene="checkerboard", boresight=MOUNTED,
        wobble="calm", swath=COLUMNS * 0.008,
    )  # fmt: skip
    run("process", collect, "--out", folder / "lot.zarr")
    truth = xr.open_zarr(folder / "collect" / "truth.zarr")
    sensor, ground = [], []
    for name, corners in OUTLINES.items():
        sensor.append(hp.Region(name, corners, flightline="raw_0"))
        # along the edges of the outline, as the truth places them
        closed = np.concatenate([corners, corners[:1]])
        steps = np.linspace(0.0, 1.0, 60, endpoint=False)[:, None]
        x, y = np.concatenate([a + steps * (b - a) for a, b in pairwise(closed)]).T
        places = [map_coordinates(truth[key].values, [y, x], order=1) for key in ("east", "north")]
        ground.append(hp.Region(name, np.stack(places, axis=-1), flightline="raw_0"))
    hp.write_regions(hp.Regions(tuple(sensor)), folder / "sensor.geojson")
    hp.write_regions(hp.Regions(tuple(ground), "map", truth.attrs["crs"]), folder / "map.geojson")
    return folder


def run(*words: object) -> str:
    return hyperpaint(*words, "--quiet", status=0).output


def ground_of(folder: Path) -> float:
    return float(xr.open_zarr(folder / "collect" / "truth.zarr").attrs["ground"])


def signatures(folder: Path, store: str, regions: str, *options: object) -> xr.Dataset:
    # Return the library that the command writes, with all pixels as members
    out = folder / "paints.zarr"
    words = ("--no-flags", "--members", 10_000, "--overwrite", *options)
    run("signatures", folder / store, "--regions", folder / regions, "--out", out, *words)
    return xr.open_zarr(out).load()


def pixels_of(library: xr.Dataset) -> dict[str, Pairs]:
    names = ("member_along_track", "member_cross_track")
    places = np.stack([library[name].values for name in names], axis=-1)
    return {
        str(paint): {(int(a), int(c)) for a, c in of_paint if a >= 0}
        for paint, of_paint in zip(library["signature"].values, places, strict=True)
    }


def agreement(one: dict[str, Pairs], other: dict[str, Pairs]) -> float:
    # Return the least share of pixels that both have, of all that either has
    assert set(one) == set(other) == set(OUTLINES)
    return min(len(one[name] & other[name]) / len(one[name] | other[name]) for name in one)


def test_the_same_pixels_of_a_stored_line_from_the_command_line(folder: Path) -> None:
    where = ("--ground", ground_of(folder), *CAMERA, *BORESIGHT)
    drawn = pixels_of(signatures(folder, "lot.zarr", "sensor.geojson"))
    placed = pixels_of(signatures(folder, "lot.zarr", "map.geojson", *where))
    assert agreement(drawn, placed) >= 0.99
    # what the collect declares, and the store carries, stands for options
    assert pixels_of(signatures(folder, "lot.zarr", "map.geojson")) == placed
    off = pixels_of(signatures(folder, "lot.zarr", "map.geojson", *where[:2], "--set", "boresight=0,0,0"))
    assert agreement(drawn, off) < 0.9  # the boresight counts


def test_the_same_pixels_in_python_before_and_after_a_map_is_stored(folder: Path) -> None:
    line = hp.open_store(folder / "lot.zarr", "flightlines/raw_0").paint.reflectance()
    camera = hp.geometry.PinholeCamera(COLUMNS, focal_length=0.012, pixel_pitch=7.4e-6)
    located = line.paint.locate(ground=ground_of(folder), camera=camera, boresight=MOUNTED)
    sensor, ground = (hp.read_regions(folder / f"{name}.geojson") for name in ("sensor", "map"))
    drawn = pixels_of(line.paint.signatures(sensor, members=10_000))
    assert agreement(drawn, pixels_of(located.paint.signatures(ground, members=10_000))) >= 0.99
    fine = located.paint.orthorectify(0.004, grid="north")
    hp.to_store(fine, folder / "fine.zarr")
    for source in (fine, hp.open_store(folder / "fine.zarr"), xr.open_zarr(folder / "fine.zarr")):
        assert agreement(drawn, pixels_of(source.paint.signatures(ground, members=10_000))) >= 0.97
        assert agreement(drawn, pixels_of(source.paint.signatures(sensor, members=10_000))) >= 0.99


def test_a_stored_map_from_the_command_line(folder: Path) -> None:
    where = ("--ground", ground_of(folder), *CAMERA, *BORESIGHT)
    run("orthorectify", folder / "lot.zarr", *where, "--grid", "north", "--out", folder / "map.zarr")
    line, of_map = (
        signatures(folder, "lot.zarr", "map.geojson", *where), signatures(folder, "map.zarr", "map.geojson")
    )  # fmt: skip
    for name, pixels in pixels_of(of_map).items():
        assert len(pixels & pixels_of(line)[name]) >= 0.98 * len(pixels)
    np.testing.assert_allclose(of_map["reflectance"], line["reflectance"], atol=0.02)
    assert (of_map["view_zenith"].values, of_map["sun_zenith"].values) == (
        pytest.approx(line["view_zenith"].values, abs=0.3),
        pytest.approx(line["sun_zenith"].values, abs=0.01),
    )


def test_what_does_not_fit_is_said(folder: Path) -> None:
    call = ["signatures", str(folder / "lot.zarr"), "--out", str(folder / "no.zarr"), "--quiet"]
    line = hp.open_store(folder / "lot.zarr", "flightlines/raw_0")
    line.attrs = {name: value for name, value in line.attrs.items() if name != "ground"}
    hp.to_store(line, folder / "unknown.zarr", group="flightlines/raw_0")
    unknown = ["signatures", str(folder / "unknown.zarr"), *call[2:], "--regions"]
    refused = hyperpaint(*unknown, folder / "map.geojson", status=2)
    assert "--ground or --dem, or [geometry] ground" in refused.output
    sensor = hyperpaint(*call, "--regions", folder / "sensor.geojson", "--ground", "0", status=2)
    assert "location-unused" in sensor.output


@pytest.mark.slow
def test_signatures_of_a_map_are_those_of_its_line(tmp_path: Path) -> None:
    # Cars of the real fleet, a third of them with flakes, in the sun: the map is flagged as the line is, and
    # its cells are smaller than pixels, so that none is left out. Cells of their size leave out a tenth.
    collect = hp.simulate_collect(
        tmp_path / "collect", scene="rendered", lines=320, bands=40, columns=224, samples=4, seed=12
    )
    run("process", collect, "--out", tmp_path / "lot.zarr")
    for name, options in {"map": ("--gsd", 0.05), "plain": ("--gsd", 0.3, "--no-flags")}.items():
        out = tmp_path / f"{name}.zarr"
        run("orthorectify", tmp_path / "lot.zarr", "--ground", 160, "--out", out, *options)
    found = {}
    for name in ("lot", "map"):
        out = tmp_path / f"{name}_paints.zarr"
        words = ("--regions", collect.parent / "regions.geojson", "--out", out)
        run("signatures", tmp_path / f"{name}.zarr", *words)
        found[name] = xr.open_zarr(out).load()
    assert {"metallic", "pearl", "solid"} <= set(found["lot"]["finish"].values)
    assert found["map"].attrs["exclude"] == found["lot"].attrs["exclude"]
    levels = {name: library["reflectance"].mean("band").values for name, library in found.items()}
    np.testing.assert_allclose(levels["map"], levels["lot"], rtol=0.002)
    is_glint = xr.open_zarr(tmp_path / "map.zarr")["quality"] & hp.Quality.GLINT > 0
    assert is_glint.any()
    assert not (xr.open_zarr(tmp_path / "plain.zarr")["quality"] & hp.Quality.GLINT > 0).any()
