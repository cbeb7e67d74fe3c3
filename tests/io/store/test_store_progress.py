"""The bar counts blocks, says what time is left, and leaves nothing of a longer line."""

import re

import dask.array as da
import pytest
import xarray as xr
from support.refusals import expect_words

from hyperpaint.io.store import computing, to_store


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
