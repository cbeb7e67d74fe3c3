"""Every benchmark runs, at its smallest size: a benchmark that broke is found here, not months later."""

from __future__ import annotations

import importlib
import inspect
import itertools
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import ROOT

MODULES = (
    "calibration",
    "detection",
    "dirsig",
    "graph",
    "import",
    "io",
    "kernels",
    "library",
    "memory",
    "orthorectification",
    "pipeline",
    "render",
)


def _benchmarks() -> Iterator[Any]:
    if not (ROOT / "benchmarks").is_dir():
        return
    sys.path.insert(0, str(ROOT))
    try:
        os.environ.setdefault("HYPERPAINT_SMOKE", "1")  # a small camera
        for name in (f"bench_{subject}" for subject in MODULES):
            module = importlib.import_module(f"benchmarks.{name}")
            for label, kind in inspect.getmembers(module, inspect.isclass):
                if kind.__module__ == module.__name__:
                    yield pytest.param(kind, id=f"{name}-{label}")
    finally:
        sys.path.remove(str(ROOT))


@pytest.mark.skipif(not (ROOT / "benchmarks").is_dir(), reason="installed without its benchmarks")
@pytest.mark.parametrize("kind", list(_benchmarks()))
@pytest.mark.slow
def test_benchmark_runs_at_its_smallest_size(kind: Any) -> None:
    methods = [name for name in dir(kind) if name.startswith(("time_", "track_", "timeraw_", "peakmem_"))]
    assert methods
    for arguments in itertools.product(*(values[:1] for values in getattr(kind, "params", ()))):
        case = kind()
        getattr(case, "setup", lambda *_: None)(*arguments)
        try:
            for name in methods:
                made = getattr(case, name)(*arguments)
                if name.startswith("timeraw_"):
                    compile(made, name, "exec")
                elif name.startswith("track_"):
                    assert made >= 0
        finally:
            getattr(case, "teardown", lambda *_: None)(*arguments)


@pytest.mark.skipif(not (ROOT / "benchmarks").is_dir(), reason="installed without its benchmarks")
def test_counts_are_those_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    common = importlib.import_module("benchmarks.common")
    first = common.counts_block(64, 40, 96)
    common.counts_block.cache_clear()
    assert first.dtype == "uint16"
    assert (first == common.counts_block(64, 40, 96)).all()
    assert 0.0002 < (first == common.FULL_SCALE).any(axis=1).mean() < 0.02
    # shot noise: neighbouring lines of one surface differ by the square root of their electrons
    assert 5 < first[:, 20, 2].std() < 200


def test_the_bare_job_makes_what_the_store_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ratio means something only where both sides do the same work."""
    monkeypatch.syspath_prepend(str(ROOT))
    common, pipeline = (importlib.import_module(f"benchmarks.{n}") for n in ("common", "bench_pipeline"))
    case = pipeline.ToStore()
    case.setup(64)
    try:
        case.time_floor(64)
        case.time_to_store(64)
        floor, ours = sorted(common.scratch().glob("out-*"), key=lambda p: int(p.name.split("-")[1]))
        for number, file in enumerate(common.chunk_files(ours, "reflectance")):
            assert file.read_bytes() == (floor / str(number)).read_bytes()
        assert np.isfinite(case.line.paint.reflectance()["reflectance"].values).mean() > 0.98
    finally:
        case.teardown(64)


@pytest.mark.skipif(not (ROOT / "benchmarks").is_dir(), reason="installed without its benchmarks")
def test_asv_takes_nothing_else_for_a_benchmark() -> None:
    """asv walks the other files as well, and would build any class with a method of such a name."""
    reserved = re.compile(r"\s*def (time|timeraw|mem|peakmem|track)_\w*\(")
    files = sorted((ROOT / "benchmarks").rglob("*.py"))
    others = [path for path in files if not path.name.startswith("bench_")]
    found = [path.name for path in others if any(map(reserved.match, path.read_text().splitlines()))]
    assert others
    assert not found


def _flagged_scenes() -> Any:
    return importlib.import_module("campaigns.flagged_scenes")


def test_flags_are_counted_by_surface_and_apart_from_mixed_pixels() -> None:
    scenes = _flagged_scenes()
    glint, shadow, adjacency, mixed = 64, 128, 256, 512
    bits = np.array([[glint, 0, glint | mixed, glint], [shadow, shadow, adjacency, mixed]], np.uint16)
    true = {
        "glint": np.array([[1, 1, 1, 0], [0, 0, 0, 0]], bool),
        "shadow": np.array([[0.0, 0.0, 0.0, 0.0], [0.2, 0.1, 0.0, 1.0]]),
        "indirect": np.zeros((2, 4)),
        "turned": np.zeros((2, 4), bool),
        "mixed": np.array([[False, False, True, True], [False, False, False, False]]),
    }
    counts = scenes.count(bits, true, np.array([[0, 0, 0, 3], [4, 4, 0, 4]]))
    assert counts["glint, outside mixed pixels, coloured paint"] == ((1, 1, 2))
    assert counts["glint, outside mixed pixels, glass"] == ((0, 1, 0))
    assert counts["glint, with mixed pixels, all"] == ((2, 3, 3))
    assert counts["shadow, outside mixed pixels, ground"] == ((1, 2, 1))
    assert counts["shadow, with mixed pixels, all"] == ((1, 2, 2))
    assert counts["adjacency on clean paint"] == ((1, 1, 3))
    assert counts["mixed pixels"] == ((1, 2, 2))
    twice = scenes.total([counts, counts])
    assert twice["pixels"] == (4, 4, 16)
    rows = scenes.rows_of(twice)
    assert "glint with mixed pixels all 0.667 0.667 6 6" in {" ".join(row.split()) for row in rows}
    assert "33.33% of 6 pixels" in rows[-2]
    assert scenes.precision_and_recall(0, 0, 4)[1] == 0.0


def test_flagged_scenes_runs_at_its_smallest_size(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A corner of a scene, with few rays: its truth is in the units of the thresholds."""
    scenes = _flagged_scenes()
    cars = importlib.import_module("campaigns.proposed_cars")
    for name, value in {"LINES": 64, "COLUMNS": 96, "BANDS": 30}.items():
        monkeypatch.setattr(cars, name, value)
    line, sky = cars.render(1, False, 4, ("walls",))
    true = scenes.true_layers(line, sky)
    assert 0.05 < (true["shadow"] >= scenes.SHADOW).mean() < 0.9
    assert 0.0 <= true["indirect"].min() <= np.median(true["indirect"]) < 0.1
    assert not true["glint"][np.isin(scenes.surfaces_of(line), [4])].any()
    assert true["glint"].any()
    assert scenes.main(["--seeds", "1", "--samples", "4", "--json", str(tmp_path / "made.json")]) in (0, 1)
    assert "mixed_edge" in capsys.readouterr().out
    made = json.loads((tmp_path / "made.json").read_text())
    assert (made["all"]["pixels"][2], made["all"]) == (64 * 96, made["scenes"]["1"])
