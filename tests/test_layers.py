"""The direction of imports, and what importing costs."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from support import house
from support.refusals import expect_error
from support.rooms import ALONE, ROOMS, SKY

import hyperpaint

ROOT = Path(hyperpaint.__file__).parent
MODULES = house.modules()


def test_the_parser_sees_imports() -> None:
    assert "numba" in house.imports("base.jit")["outside"]


def test_imports_point_down() -> None:
    upward = {
        (room, target): names
        for (room, target), names in house.arrows().items()
        if (room in ALONE and target not in ALONE[room])
        or (room in ROOMS and target not in {*ROOMS[: ROOMS.index(room)], "paper"})
    }
    assert not upward


def test_the_simulator_shares_the_sky_and_nothing_else_of_the_light() -> None:
    for name in MODULES:
        if house.room_of(name) == "simulation":
            assert {target for target in house.imports(name)["inside"] if target.startswith("light")} <= SKY


def test_kernels_are_loops_over_arrays() -> None:
    for name in MODULES:
        if house.room_of(name) == "kernels":
            assert house.imports(name)["outside"] <= {
                "__future__",
                "typing",
                "collections",
                "math",
                "numpy",
                "numba",
            }


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
@pytest.mark.slow
def test_importing_costs_what_xarray_costs(statement: str) -> None:
    code = f"import sys, xarray\nbefore = set(sys.modules)\n{statement}\nprint(*(set(sys.modules) - before))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert not loaded & HEAVY
    assert "hyperpaint" in loaded


ROOMS_WITH_DOORS = [path.parent.name for path in sorted(ROOT.glob("*/__init__.pyi"))]


@pytest.mark.parametrize("room", ["", *ROOMS_WITH_DOORS])
def test_every_public_name_resolves(room: str) -> None:
    module = importlib.import_module(f"hyperpaint.{room}".rstrip("."))
    assert len(module.__all__) == len(set(module.__all__))
    for name in module.__all__:
        assert getattr(module, name) is not None, name
    assert set(module.__all__) <= set(dir(module))


def test_a_name_of_a_room_is_pointed_to() -> None:
    caught = expect_error(
        AttributeError, "orthorectify", lambda: vars(hyperpaint)["__getattr__"]("orthorectify")
    )
    assert "hyperpaint.geometry.orthorectify" in caught.__notes__[0]
    expect_error(AttributeError, "nothing", lambda: hyperpaint.nothing)


def test_no_module_shares_its_name_with_a_public_function() -> None:
    # one would hide the other: `from .staging import staging` in a package replaces its module
    shared = {}
    stems = {name.removesuffix(".__init__").rpartition(".")[2] for name in MODULES}
    for name in MODULES:
        if name != "__main__":
            home = "hyperpaint" if name == "__init__" else f"hyperpaint.{name.removesuffix('.__init__')}"
            module = importlib.import_module(home)
            functions = {
                each
                for each, value in vars(module).items()
                if inspect.isfunction(value) and value.__module__ == home and not each.startswith("_")
            }
            shared[name] = stems & functions
    assert not {name: both for name, both in shared.items() if both}


def test_every_public_function_says_what_it_raises_and_returns() -> None:
    for room in ("", *ROOMS_WITH_DOORS):
        module = importlib.import_module(f"hyperpaint.{room}".rstrip("."))
        for name in module.__all__:
            function = getattr(module, name)
            if inspect.isfunction(function):
                assert function.__doc__, name
                assert "Returns\n" in function.__doc__ or "Return " in function.__doc__, name
