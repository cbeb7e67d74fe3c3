"""Writes ``hyperpaint/accessor.pyi``: the accessor's methods as type checkers and editors see them.

``python tests/support/accessor_stub.py`` after a function that is a method has changed its arguments; a test
holds the file against what this makes of the functions.
"""

import ast
import builtins
import importlib
import inspect
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

from hyperpaint.accessor import ARRAY_METHODS, METHODS

STUB = Path(__file__).resolve().parents[2] / "hyperpaint" / "accessor.pyi"

_HEAD = '''"""What type checkers see of ``Dataset.paint``; written by tests/support/accessor_stub.py.

xarray lets type checkers take any attribute of a Dataset for anything. To have ``.paint`` completed and
checked, say once what a dataset is: ``line = cast(PaintDataset, xr.open_zarr(...))``; what its methods return
is one again. `PaintDataset` exists for type checkers only: import it under ``if TYPE_CHECKING:``.
"""
'''
_CLASS = '''
METHOD_GROUPS: dict[str, dict[str, str]]
METHODS: dict[str, str]
ARRAY_METHODS: tuple[str, ...]
Dims = Mapping[str, Hashable]

class PaintDataset(xr.Dataset):
    """A Dataset whose ``.paint`` is known."""

    @property
    def paint(self) -> PaintAccessor: ...

class PaintDataArray(xr.DataArray):
    """A DataArray whose ``.paint`` is known."""

    @property
    def paint(self) -> PaintArrayAccessor: ...

class PaintAccessor:
    """Methods on a flight line; each returns something new, lazily unless it says otherwise."""

    def __init__(self, dataset: xr.Dataset) -> None: ...
    def _repr_html_(self) -> str: ...
    def verify(self) -> StoreReport:
        """Read every chunk of the store that the dataset was opened from (eager)."""
    def quantify(self, registry: pint.UnitRegistry[Any] | None = None) -> PaintDataset:
        """Return a view for pint-xarray users: data variables as Quantities (extra ``units``)."""
'''

_ARRAY_CLASS = '''
class PaintArrayAccessor:
    """Methods on one cube; each returns something new."""

    def __init__(self, array: xr.DataArray) -> None: ...
    def quantify(self, registry: pint.UnitRegistry[Any] | None = None) -> PaintDataArray:
        """Return a view for pint-xarray users, a Quantity."""
'''


def stub() -> str:
    # Return the text of the stub
    imports = {
        "xr": "import xarray as xr",
        "Mapping": "from collections.abc import Mapping",
        "Hashable": "from collections.abc import Hashable",
        "pint": "import pint",
        "StoreReport": "from hyperpaint.io.store import StoreReport",
    }
    methods = []
    for name, home in METHODS.items():
        room, _, function_name = home.partition(":")
        function = getattr(importlib.import_module(f"hyperpaint.{room}"), function_name or name)
        methods.append(_method(name, function, imports))
    on_arrays = [
        text.replace("-> PaintDataset", "-> PaintDataArray")
        for name, text in zip(METHODS, methods, strict=True)
        if name in ARRAY_METHODS
    ]
    parts = [_HEAD, *sorted(set(imports.values())), _CLASS, *methods, _ARRAY_CLASS, *on_arrays]
    return "\n".join(parts) + "\n"


def _method(name: str, function: Any, imports: dict[str, str]) -> str:
    # Return a method's lines, and add what its annotations need to the imports
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(node, ast.FunctionDef)
    arguments = node.args
    parameters = inspect.signature(function).parameters
    for group, defaults in (
        (arguments.args[-len(arguments.defaults) or len(arguments.args) :], arguments.defaults),
        (arguments.kwonlyargs, arguments.kw_defaults),
    ):
        # a constant of the function's module says nothing elsewhere
        defaults[:] = [
            ast.parse(repr(parameters[each.arg].default), mode="eval").body
            if isinstance(text, ast.Name)
            else text
            for each, text in zip(group, defaults, strict=True)
        ]
    arguments.args[0] = ast.arg("self")
    arguments.kwonlyargs.append(ast.arg("dims", ast.parse("Dims | None", mode="eval").body))
    arguments.kw_defaults.append(ast.Constant(None))
    for annotation in ast.walk(ast.Module([ast.Expr(each) for each in _annotations(node)], [])):
        if isinstance(annotation, ast.Name) and annotation.id != "Dims":
            _import(annotation.id, function.__module__, imports)
    returns = ast.unparse(node.returns) if node.returns else "None"
    returns = "PaintDataset" if returns == "xr.Dataset" else returns
    first = (inspect.getdoc(function) or "").partition("\n\n")[0].replace("\n", " ")
    quote = 'r"""' if "\\" in first else '"""'
    head = f"    def {name}({ast.unparse(arguments)}) -> {returns}:"
    return f'{head}\n        {quote}{first}"""'


def _annotations(node: ast.FunctionDef) -> list[ast.expr]:
    every = [*node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
    return [each.annotation for each in every if each is not None and each.annotation is not None] + (
        [node.returns] if node.returns else []
    )


def _import(name: str, module_name: str, imports: dict[str, str]) -> None:
    # Add the import that brings a name of a module's annotations
    if name in imports or hasattr(builtins, name):
        return
    module = importlib.import_module(module_name)
    package = (
        module_name if Path(module.__file__ or "").name == "__init__.py" else module_name.rpartition(".")[0]
    )
    imports[name] = f"from {module_name} import {name}"  # unless it is imported there itself
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            home = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    imports[name] = f"from {home} import {alias.name}" + (
                        f" as {name}" if alias.asname else ""
                    )
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    imports[name] = f"import {alias.name}" + (f" as {name}" if alias.asname else "")


def formatted(text: str) -> str:
    # Return the text as ruff leaves it
    for command in (["check", "-q", "--select", "I", "--fix"], ["format", "-q"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--stdin-filename", str(STUB), "-"],
            input=text, capture_output=True, text=True, check=True,
        )  # fmt: skip
        text = done.stdout
    return text


def main() -> int:
    # Write the stub
    STUB.write_text(formatted(stub()), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
