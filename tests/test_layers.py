"""The direction of imports, and what importing costs."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import hyperpaint

ROOT = Path(hyperpaint.__file__).parent
FOUNDATION = {"errors", "units", "schema"}
SHARED = FOUNDATION | {"responses", "sun"}
SUBJECTS = {
    "illumination", "synchrony", "slabs", "planning", "radiometry", "smoothing", "bands", "calibration",
    "noise", "quality", "georeference", "regions", "signatures", "validation", "mixing", "paper", "budget",
    "alignment", "alignment_applied", "alignment_fit", "column_means", "oxygen",
    "propagation",
}  # fmt: skip
TASKS = {"slabs"}  # the layer of tasks that subject modules share
TOP = {
    "plot",
    "plot_calibration",
    "report",
    "accessor",
    "demonstration",
    "info",
    "pipeline",
    "cli",
    "__main__",
    "__init__",
    "laboratory",
}
ALLOWED = {
    "errors": set(),
    "units": {"errors"},
    "schema": {"errors", "units"},
    "responses": FOUNDATION,
    "sun": FOUNDATION,
    "budget": FOUNDATION,
    "illumination": SHARED,
    "synchrony": SHARED,
    "slabs": SHARED | {"illumination", "synchrony"},
    "propagation": SHARED | TASKS,
    "planning": SHARED | TASKS | {"illumination", "synchrony", "propagation"},
    "radiometry": SHARED | TASKS | {"illumination", "synchrony", "planning", "propagation"},
    "alignment": SHARED | TASKS | {"synchrony", "radiometry", "alignment_fit", "column_means"},
    "oxygen": SHARED | TASKS | {"radiometry", "column_means"},
}


def modules() -> dict[str, Path]:
    """Return every module of the package by its dotted name inside it."""
    found = {}
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts)] = path
    return found


def imports(name: str, path: Path) -> tuple[set[str], set[str]]:
    """Return which modules of the package, and which of others, a module imports, at its top or inside."""
    here = ["hyperpaint", *name.split(".")][:-1]
    inside, outside = set(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            targets = [f"{stem}.{alias.name}" for alias in node.names]
        else:
            continue
        for target in targets:
            if target.split(".")[0] == "hyperpaint":
                inside.add(_module_of(target))
            else:
                outside.add(target.split(".")[0])
    return inside, outside


def _module_of(target: str) -> str:
    """Return the longest part of a dotted name that is a module, without the package's name."""
    parts = target.split(".")[1:]
    while parts:
        path = ROOT.joinpath(*parts)
        if path.with_suffix(".py").is_file() or (path / "__init__.py").is_file():
            return ".".join(parts)
        parts = parts[:-1]
    return "__init__"


MODULES = modules()
IMPORTS = {name: imports(name, path) for name, path in MODULES.items()}


def test_the_parser_sees_imports() -> None:
    assert {"slabs", "schema", "errors", "illumination"} <= IMPORTS["radiometry"][0]
    assert "numba" in IMPORTS["kernels._jit"][1]
    assert "kernels.smoothing" in IMPORTS["smoothing"][0]


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_go_one_way(name: str) -> None:
    found = {target for target in IMPORTS[name][0] if target != name}
    layer = name.split(".")[0]
    if layer in TOP:
        # the command line is above everything, accessors above subjects
        above = {"accessor": {"pipeline", "cli", "demonstration"}, "plot": {"pipeline", "cli", "accessor"}}
        above["plot_calibration"] = above["plot"]
        above["pipeline"] = {"cli", "demonstration"}
        assert not found & above.get(layer, set())
        return
    if layer == "kernels":
        assert all(target.startswith("kernels") for target in found)
        assert IMPORTS[name][1] <= {"__future__", "typing", "collections", "math", "numpy", "numba"}
    elif layer == "simulation":
        allowed = {"errors", "units", "schema", "kernels.transport"}
        assert all(target in allowed or target.startswith("simulation") for target in found)
    elif layer == "calibration":
        # a subject in several rooms, which may see one another and no other subject
        kernels = {"kernels.lines"}
        assert all(target in SHARED | kernels or target.startswith("calibration") for target in found)
    elif layer == "io":
        # readers hold no physics
        assert all(target in FOUNDATION | {"budget"} or target.startswith("io") for target in found)
    else:
        allowed = ALLOWED.get(name, SHARED | TASKS)
        kernels = {target for target in found if target.startswith("kernels.")}
        assert found - kernels <= allowed
        assert not kernels or name in SUBJECTS


def test_every_module_has_a_layer() -> None:
    known = SHARED | SUBJECTS | TOP | {"kernels", "simulation", "io"}
    assert {name.split(".")[0] for name in MODULES} <= known


def test_backends_import_xarray_alone_at_their_top() -> None:
    tree = ast.parse((ROOT / "io" / "backends.py").read_text(encoding="utf-8"))
    names = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").split(".")[0] if not node.level else "hyperpaint")
    assert names - set(sys.stdlib_module_names) <= {"xarray", "numpy"}


HEAVY = {
    "numba", "pint", "scipy", "dask", "zarr", "matplotlib", "numcodecs", "click", "distributed", "h5py",
    "netCDF4", "pvlib", "pint_xarray", "rasterio",
}  # fmt: skip


@pytest.mark.parametrize("statement", ["import hyperpaint", "import hyperpaint.io.backends"])
def test_importing_costs_what_xarray_costs(statement: str) -> None:
    code = f"import sys, xarray\nbefore = set(sys.modules)\n{statement}\nprint(*(set(sys.modules) - before))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & HEAVY
    assert "hyperpaint" in loaded


def test_every_public_name_resolves() -> None:
    assert sorted(hyperpaint.__all__) == sorted(set(hyperpaint.__all__))
    for name in hyperpaint.__all__:
        assert getattr(hyperpaint, name) is not None, name
    assert set(hyperpaint.__all__) <= set(dir(hyperpaint))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = hyperpaint.nothing


def test_lazy_names_are_public_and_live_where_they_say() -> None:
    assert set(hyperpaint._HOME) <= set(hyperpaint.__all__)
    for name, home in hyperpaint._HOME.items():
        module = importlib.import_module(f"hyperpaint.{home}")
        assert name in module.__all__, name


def test_no_module_shares_its_name_with_a_public_function() -> None:
    stems = {name.rsplit(".", 1)[-1] for name in MODULES} | {
        module.name for module in pkgutil.iter_modules([str(ROOT)])
    }
    public = set(hyperpaint.__all__)
    for name in SHARED | SUBJECTS | {"plot"}:
        if name in MODULES:
            public |= set(getattr(importlib.import_module(f"hyperpaint.{name}"), "__all__", ()))
    assert not stems & public


def test_every_public_function_says_what_it_raises_and_returns() -> None:
    for name in hyperpaint.__all__:
        found = getattr(hyperpaint, name)
        if inspect.isfunction(found):
            assert found.__doc__, name
            assert "Returns\n" in found.__doc__, name
