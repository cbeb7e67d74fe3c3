"""`verify`, `info` and `report` of a store that is not whole: what it lacks, and how to finish it."""

from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from click.testing import CliRunner
from support.refusals import expect_words
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.cli.flight_commands import verify
from hyperpaint.cli.info_command import info
from hyperpaint.io.store.writer import WholeRun
from hyperpaint.report import write_report


def said(command: Any, *words: object) -> tuple[int, str]:
    done = CliRunner().invoke(command, [str(word) for word in words])
    return done.exit_code, done.output


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
    with pytest.raises(KeyboardInterrupt):
        hp.process(collect, out, to="radiance")
    again = "unfinished: 1 of 2 groups are written, without /flightlines/raw_1; to finish it"
    for command, expected in ((verify, 1), (info, 0)):
        status, text = said(command, out)
        assert status == expected
        expect_words(text, again, f"--out {out} --to radiance")
    page = write_report(out, tmp_path / "report.html")
    assert page.flightlines == ("flightlines/raw_0",)
    assert again[:40] in page.problems[0]


def test_inputs_are_compared_on_request(collect: Path, tmp_path: Path) -> None:
    out = hp.process(collect, tmp_path / "lot.zarr", to="radiance")
    status, text = said(verify, out, "--inputs")
    assert (status, "all unchanged" in text) == (0, True)
    collect.with_name("raw_0").write_bytes(bytes(collect.with_name("raw_0").stat().st_size))
    status, text = said(verify, out, "--collect", collect)
    assert status == 1
    assert "/flightlines/raw_0: its inputs have changed" in text
    assert said(verify, out)[0] == 0
