"""What coverage found and what once broke a parser: refused with own errors only, in a second and 256 MB."""

import importlib
import warnings
from pathlib import Path
from typing import Any

import pytest
from support import ROOT

from hyperpaint.base.errors import PaintWarning

HERE = Path(__file__).parent
ARCHIVES = sorted(path.stem for path in (HERE / "corpus").glob("*.zip"))
FAILURES = sorted(path for path in (HERE / "regressions").glob("*/*") if path.suffix != ".md")


@pytest.fixture(scope="module")
def guided() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        yield importlib.import_module("campaigns.guided")


@pytest.fixture(scope="module")
def seeds(guided: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("seeds") / "collect"
    guided.parsers.prepare(folder)
    return folder


def _needs(parser: str) -> None:
    # Skip where what reads the files of a parser is not installed
    if parser.startswith("mesh-"):
        pytest.importorskip("trimesh")


def _wrong(guided: Any, seeds: Path, own: Path, target: Any, inputs: list[bytes]) -> list[str]:
    # Return what is wrong with how a parser takes inputs in the place of a seed
    parsers = guided.parsers
    parser = parsers.PARSERS[target.parser]
    own.mkdir()
    path, _ = parsers.placed(parser, seeds, own)[target.seed]
    wrong = []
    with warnings.catch_warnings(), parsers.limits():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", PaintWarning)
        parser.read(path)
        for data in inputs:
            path.write_bytes(data)
            wrong.append(parsers.complaint(parser, path))
    return list(filter(None, wrong))


@pytest.mark.campaign
@pytest.mark.parametrize("name", ARCHIVES)
def test_the_corpus_is_read_or_refused(name: str, guided: Any, seeds: Path, tmp_path: Path) -> None:
    _needs(name)
    wanted = guided.targets([name], seeds)
    inputs = {target: guided.corpus(target) for target in wanted}
    assert sum(map(len, inputs.values()))
    for target in wanted:
        assert not _wrong(guided, seeds, tmp_path / str(target.seed), target, inputs[target])


@pytest.mark.parametrize("path", FAILURES, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_broke_a_parser_is_refused(path: Path, guided: Any, seeds: Path, tmp_path: Path) -> None:
    _needs(path.parent.name)
    (target,) = [
        target for target in guided.targets([path.parent.name], seeds)
        if guided.parsers.PARSERS[target.parser].files(seeds)[target.seed].suffix == path.suffix
    ]  # fmt: skip
    assert not _wrong(guided, seeds, tmp_path / "own", target, [path.read_bytes()])


def test_a_corpus_is_the_shortest_inputs_that_reach_all_that_is_reached(guided: Any) -> None:
    from hyperpaint.io.files.reading import number

    inputs = [b"1.50", b"1", b"word", b"2"]
    assert guided.covering(lambda data: number(data.decode()), inputs) == [b"1", b"word"]
    assert guided.covering(len, inputs) == []  # no step of hyperpaint
