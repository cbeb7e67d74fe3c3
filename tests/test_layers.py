"""The direction of imports, and what importing costs."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import hyperpaint

ROOT = Path(hyperpaint.__file__).parent
#: One row a room, from the ground up: a room imports rooms below it.
ROOMS = (
    "base",
    "kernels",
    "simulation",
    "io",
    "light",
    "radiometry",
    "calibration",
    "alignment",
    "surroundings",
    "geometry",
    "regions",
    "paints",
    "validation",
    "pictures",
    "report",
    "workflows",
    "accessor",
    "__init__",
    "cli",
)
ALONE = {"base": set(), "kernels": {"base"}, "simulation": {"base"}, "io": {"base"}, "paper": {"base"}}
"""All that these may import: a loop closed through shared code proves nothing, readers hold no physics."""


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
    assert "numba" in IMPORTS["base.jit"][1]


def room_of(name: str) -> str:
    """Return the room a module is in, or the module at the top of the package."""
    return name.split(".")[0]


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_point_down(name: str) -> None:
    room = room_of(name)
    targets = {room_of(target) for target in IMPORTS[name][0]} - {room}
    if room in ALONE:
        assert targets <= ALONE[room]
    elif room in ROOMS:
        assert targets <= {*ROOMS[: ROOMS.index(room)], "paper"}


def test_kernels_are_loops_over_arrays() -> None:
    for name in MODULES:
        if room_of(name) == "kernels":
            assert IMPORTS[name][1] <= {"__future__", "typing", "collections", "math", "numpy", "numba"}


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
    # one would hide the other: `from .staging import staging` in a package replaces its module
    shared = {}
    stems = {name.removesuffix(".__init__").rpartition(".")[2] for name in MODULES}
    for name in MODULES:
        if name != "__main__":
            home = "hyperpaint" if name == "__init__" else f"hyperpaint.{name.removesuffix('.__init__')}"
            public = getattr(importlib.import_module(home), "__all__", ())
            shared[name] = stems & set(public)
    assert not {name: both for name, both in shared.items() if both}


def test_every_public_function_says_what_it_raises_and_returns() -> None:
    for name in hyperpaint.__all__:
        found = getattr(hyperpaint, name)
        if inspect.isfunction(found):
            assert found.__doc__, name
            assert "Returns\n" in found.__doc__, name
