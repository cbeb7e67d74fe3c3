"""The direction of imports, and what importing costs."""

from __future__ import annotations

import ast
import graphlib
import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import hyperpaint

ROOT = Path(hyperpaint.__file__).parent
FOUNDATION = {"errors", "units", "schema", "budget"}
SHARED = FOUNDATION | {"conventions", "mirrored_light", "responses", "sun"}
LOWER: dict[str, set[str]] = {
    "errors": set(),
    "units": {"errors"},
    "dimensions": {"errors"},
    "quality_bits": set(),
    "conventions": {"errors"},
    "mirrored_light": {"errors"},
    "variables": {"units"},
    "schema": {"errors", "units", "dimensions", "quality_bits", "variables"},
    "budget": {"errors", "units", "schema"},
    "responses": FOUNDATION,
    "sun": FOUNDATION,
}
#: What a subject imports beside what all share: exactly this, so that nothing is allowed that is not used.
SUBJECTS: dict[str, set[str]] = {
    "illumination": set(),
    "synchrony": set(),
    "slabs": {"illumination", "synchrony"},  # the layer of tasks that subjects share
    "uncertainty": {"slabs"},
    "planning": {"slabs", "illumination", "synchrony", "uncertainty"},
    "radiometry": {"slabs", "illumination", "synchrony", "planning", "uncertainty"},
    "smoothing": {"slabs"},
    "bands": {"slabs"},
    "calibration": set(),
    "alignment": {"slabs", "synchrony", "radiometry"},
    "paper": set(),
    "validation": {"alignment"},
    "mixing": set(),
    "regions": {"georeference"},
    "signatures": {"bands", "corrections", "radiometry", "regions", "slabs", "smoothing", "uncertainty"},
    "scene_model": {"slabs"},
    "flags": {"scene_model", "slabs"},
    "corrections": {"scene_model"},
    "proposals": {"flags", "regions", "scene_model", "slabs"},
    "georeference": {"slabs"},
    "orthorectification": {"bands", "georeference", "radiometry"},
    "navigation_checks": {"georeference", "synchrony"},
}
#: Whose loops a subject runs, again exactly.
KERNELS: dict[str, set[str]] = {
    "slabs": {"kernels.radiometry"},
    "smoothing": {"kernels.smoothing"},
    "bands": {"kernels.resampling"},
    "calibration": {"kernels.line_fits"},
    "scene_model": {"kernels.segmentation", "kernels.unmixing"},
    "flags": {"kernels.unmixing"},
    "georeference": {"kernels.rays"},
    "orthorectification": {"kernels.gathering", "kernels.inverse_map"},
}
#: Above the subjects: what is here imports of its like only what has a lower rank.
RANKS = {
    "figures": 0,
    "colour_difference": 0,
    "facts": 0,
    "markup": 0,
    "summaries": 1,
    "report_page": 1,
    "plot": 1,
    "plot_calibration": 1,
    "plot_flags": 2,
    "plot_spectra": 2,
    "plot_adjacency": 3,
    "plot_library": 3,
    "plot_validation": 3,
    "picking_view": 2,
    "picking": 3,
    "report_sections": 4,
    "report": 5,
    "laboratory": 3,
    "accessor": 4,
    "paint_search": 4,
    "starter_paints": 4,
    "running": 4,
    "console": 4,
    "flagging": 3,
    "signature_files": 4,
    "validation_files": 4,
    "pipeline": 5,
    "paint_closure": 5,
    "scene_rendering": 6,
    "info": 6,
    "demonstration": 6,
    "__init__": 7,
    "render_command": 7,
    "report_command": 7,
    "validate_command": 7,
    "export_command": 7,
    "maps": 4,
    "orthorectify_command": 7,
    "paints_command": 7,
    "cli": 8,
    "__main__": 9,
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


def layer_of(name: str) -> str:
    """Return the module, or the package it belongs to."""
    return name.split(".")[0]


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_go_one_way(name: str) -> None:
    layer = layer_of(name)
    found = {layer_of(target) for target in IMPORTS[name][0]} - {layer}
    if layer in RANKS:
        assert all(RANKS[target] < RANKS[layer] for target in found & set(RANKS))
        assert "kernels" not in found
    elif layer == "kernels":
        assert not found
        assert IMPORTS[name][1] <= {"__future__", "typing", "collections", "math", "numpy", "numba"}
    elif layer == "simulation":
        # a closed loop through shared code would prove nothing; tracing light is shared by nothing
        assert found <= {"errors", "units", "schema", "kernels"}
        kernels = {target for target in IMPORTS[name][0] if layer_of(target) == "kernels"}
        assert all(target.startswith("kernels.transport.") for target in kernels)
    elif layer == "io":
        # readers hold no physics
        assert found <= FOUNDATION | {"conventions", "mirrored_light"}
    elif layer in SUBJECTS:
        assert found <= SHARED | SUBJECTS[layer] | {"kernels"}
    else:
        assert found <= LOWER[layer]


@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_subject_is_allowed_what_it_uses(subject: str) -> None:
    targets = set().union(*(IMPORTS[name][0] for name in MODULES if layer_of(name) == subject))
    kernels = {target for target in targets if layer_of(target) == "kernels"}
    assert {layer_of(target) for target in targets - kernels} - SHARED - {subject} == SUBJECTS[subject]
    assert kernels == KERNELS.get(subject, set())


def test_subjects_do_not_import_in_a_ring() -> None:
    tuple(graphlib.TopologicalSorter(SUBJECTS).static_order())


def test_every_module_has_a_layer() -> None:
    known = {*LOWER, *SUBJECTS, *RANKS, "kernels", "simulation", "io"}
    assert {layer_of(name) for name in MODULES} == known


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
