"""Maps are computed stage by stage: every task once, and what is shared is held no longer than needed."""

import re

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_words

import hyperpaint as hp
from hyperpaint.io.store import computing, to_store
from hyperpaint.io.store.computing import in_stages


def _slabs_and_tiles(slabs: int, counted: list[int]) -> tuple[dict, dict]:
    # Return a graph in which a tile reads two slabs of which the next reads one, and the tiles' stages
    def slab(number: int) -> np.ndarray:
        counted.append(number)
        return np.full(3, number)

    graph: dict = {("slab", k): (slab, k) for k in range(slabs)}
    graph |= {("tile", k): (np.add, ("slab", k), ("slab", k + 1)) for k in range(slabs - 1)}
    return graph, {("tile", k): k for k in range(slabs - 1)}


def test_tasks_that_stages_share_are_computed_once_and_in_turn() -> None:
    counted: list[int] = []
    graph, stages = _slabs_and_tiles(6, counted)
    seen = []
    for (_, tile), value in in_stages(dask.get, graph, stages):
        seen.append(tile)
        assert (value == 2 * tile + 1).all()
        assert max(counted) == tile + 1, "no slab is read ahead of its stage"
    assert (seen, sorted(counted)) == (list(range(5)), list(range(6)))


def test_one_stage_is_one_call() -> None:
    calls = []

    def get(graph: dict, keys: list) -> list:
        calls.append(len(keys))
        return dask.get(graph, keys)

    graph, stages = _slabs_and_tiles(4, [])
    values = dict(in_stages(get, graph, dict.fromkeys(stages, 0)))
    assert (calls, [int(value[0]) for value in values.values()]) == ([3], [1, 3, 5])


def test_a_wide_map_is_stored_by_columns(tmp_path) -> None:
    order: list[int] = []

    def tile(block_info: dict | None = None) -> np.ndarray:
        (rows, columns) = block_info[None]["chunk-location"]
        order.append(columns)
        return np.full(block_info[None]["chunk-shape"], 10.0 * rows + columns)

    def cells(rows: int, columns: int) -> xr.Dataset:
        chunks = ((256,) * rows, (256,) * columns)
        lazy = da.map_blocks(tile, chunks=chunks, dtype=float, meta=np.empty((0, 0)))
        return xr.Dataset({"red": (("y", "x"), lazy)})

    with dask.config.set(scheduler="sync"):
        hp.to_store(cells(2, 4), tmp_path / "wide.zarr")
        assert order == sorted(order)
        order.clear()
        hp.to_store(cells(4, 2), tmp_path / "high.zarr")
    assert order != sorted(order)
    stored = hp.open_store(tmp_path / "wide.zarr").red.values
    assert (stored[0, 300], stored[300, 900]) == (1.0, 13.0)


# --- the bar counts blocks, says what time is left, and leaves nothing of a longer line ---------------------


def test_the_bar_says_what_is_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 0.0, 1.0, 70.0, 80.0])
    monkeypatch.setattr(computing.time, "perf_counter", lambda: next(clock))
    bar = computing.BlockBar(8)
    for blocks in (0, 1, 6, 1):
        bar.advance(blocks)
    drawn = [part for part in re.split(r"\r+ *", capsys.readouterr().out) if part]
    expect_words(drawn[0], "] | 0% Completed | ", without=("left",))
    assert drawn[1].startswith("[" + "#" * 5 + " " * 35 + "] | 12% Completed | ")
    assert drawn[1].endswith("7.00 s left")
    assert drawn[2].endswith("10.00 s left")
    assert drawn[3].startswith("[" + "#" * 40 + "] | 100% Completed")
    assert "left" not in drawn[3]


def test_every_block_moves_the_bar(capsys: pytest.CaptureFixture[str], tmp_path: object) -> None:
    cube = da.zeros((96, 2, 3), chunks=(32, 2, 3), dtype="uint16")
    line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), cube)})
    to_store(line, f"{tmp_path}/lot.zarr", progress=True)
    shown = capsys.readouterr().out
    assert [int(share) for share in re.findall(r"(\d+)% Completed", shown)] == [0, 33, 66, 100]
    assert shown.endswith("\n")
