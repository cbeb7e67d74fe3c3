"""Regions of a simulated collect: they lie on their paint, and close the chain without a drawing."""

import itertools
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner, Result

import hyperpaint as hp
from hyperpaint.cli.program import main
from hyperpaint.simulation import SimulationSettings, simulate_collect
from hyperpaint.simulation.collect import PaintedRectangles
from hyperpaint.simulation.flight import Lines, PlanFlight

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


def test_regions_of_a_plan_show_one_surface(tmp_path: Path) -> None:
    folder = simulate_collect(
        tmp_path, scene="plan", lines=120, bands=4, columns=160, cubes=2, dropped=4, glint=0.01
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


def test_no_region_where_pixels_are_too_coarse(tmp_path: Path) -> None:
    folder = simulate_collect(tmp_path, scene="plan", lines=40, bands=4, columns=24).parent
    assert len(hp.read_regions(folder / "regions.geojson")) == 0


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
