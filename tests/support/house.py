"""Checks of the layout of the package: rooms, arrows, names. ``python tests/support/house.py`` prints them.

Exit status 1 where a limit is passed; ``--list NAME`` shows the members of a count. `count_house` beside
this file prints sizes, which have no limits.
"""

from __future__ import annotations

import argparse
import ast
import functools
import re
import sys
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hyperpaint"
#: What stands for its content no better than `x` does.
RIDDLES = ("made", "told", "found", "known", "kept")
MAX_POSITIONAL = 8
#: Names that xarray, Jupyter, click and numba call.
_CALLED_BY_OTHERS = {
    "AsdBackendEntrypoint", "CollectBackendEntrypoint", "EnviBackendEntrypoint", "SvcBackendEntrypoint",
    "guess_can_open", "open_groups_as_dict", "_repr_html_", "get_command", "format_commands",
    "add_overload", "load_overload", "_finalize_final_module",
    "worked_example",  # by doctests
}  # fmt: skip

Names = list[str]


@dataclass(frozen=True)
class Promise:
    # A count, and what it may be at the most; sizes are printed without a limit
    name: str
    limit: int | None
    members: Names
    count: int | None = None

    @property
    def value(self) -> int:
        return len(self.members) if self.count is None else self.count


@functools.cache
def modules() -> dict[str, Path]:
    # Return every module of the package by its dotted name inside it
    return {
        ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
        for path in sorted(PACKAGE.rglob("*.py"))
    }


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    # Return all nodes of a module, which many checks walk
    return tuple(ast.walk(tree_of(path)))


def module_of(target: str) -> str:
    # Return the longest part of a dotted name that is a module, without the package's name
    parts = target.split(".")[1:]
    while parts:
        path = PACKAGE.joinpath(*parts)
        if path.with_suffix(".py").is_file():
            return ".".join(parts)
        if (path / "__init__.py").is_file():
            return ".".join([*parts, "__init__"])
        parts = parts[:-1]
    return "__init__"


@functools.cache
def imports(name: str) -> dict[str, frozenset[str]]:
    # Return what a module imports: ``inside`` the package, ``outside``, and inside at its ``top`` only
    here = ["hyperpaint", *name.split(".")][:-1]
    sets: dict[str, set[str]] = {"inside": set(), "outside": set(), "top": set()}
    nodes: list[tuple[ast.AST, bool]] = [(tree_of(modules()[name]), False)]
    while nodes:
        node, is_lazy = nodes.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            for target in _targets(node, here):
                if target.split(".")[0] != "hyperpaint":
                    sets["outside"].add(target.split(".")[0])
                    continue
                sets["inside"].add(module_of(target))
                if not is_lazy:
                    sets["top"].add(module_of(target))
        elif isinstance(node, ast.stmt | ast.Module | ast.ExceptHandler):  # no expression holds an import
            is_lazy |= isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or (
                isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
            )
            nodes += [(child, is_lazy) for child in ast.iter_child_nodes(node)]
    return {key: frozenset(value - {name}) for key, value in sets.items()}


def _targets(node: ast.Import | ast.ImportFrom, here: list[str]) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    base = here[: len(here) - node.level + 1] if node.level else []
    stem = ".".join([*base, *([node.module] if node.module else [])])
    return [f"{stem}.{alias.name}" for alias in node.names]


def room_of(name: str) -> str:
    # Return the room a module is in, or the module at the top of the package
    return name.split(".")[0]


def arrows() -> dict[tuple[str, str], Names]:
    # Return who imports whom among rooms, with the imports that make each arrow
    pairs: dict[tuple[str, str], Names] = defaultdict(list)
    for name in modules():
        for target in imports(name)["inside"]:
            if room_of(target) != room_of(name):
                pairs[room_of(name), room_of(target)].append(f"{name} -> {target}")
    return dict(pairs)


def circles() -> Names:
    # Return the groups of files that import one another, lazily or not (Tarjan)
    edges = {
        name: {target for target in imports(name)["inside"] if not target.endswith("__init__")}
        for name in modules()
    }
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: Names = []
    rings: Names = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for target in sorted(edges[name]):
            if target not in order:
                visit(target)
                low[name] = min(low[name], low[target])
            elif target in stack:
                low[name] = min(low[name], order[target])
        if low[name] == order[name]:
            ring = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(ring) > 1:
                rings.append(" <-> ".join(sorted(ring)))

    for name in edges:
        if name not in order:
            visit(name)
    return rings


def stems_used_twice() -> Names:
    # Return file names that several rooms have; a kernel may be named as what it is the loop of
    places: dict[str, Names] = defaultdict(list)
    for name in modules():
        stem = name.rpartition(".")[2]
        if stem != "__init__" and room_of(name) != "kernels":
            places[stem].append(name)
    return [f"{stem}: {', '.join(names)}" for stem, names in sorted(places.items()) if len(names) > 1]


def long_signatures() -> Names:
    # Return functions that take more than eight positional arguments
    long = []
    for name, path in modules().items():
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                count = len(node.args.posonlyargs) + len(node.args.args)
                if count > MAX_POSITIONAL:
                    long.append(f"{name}.{node.name}: {count}")
    return long


def uncalled() -> Names:
    # Return functions and classes that no other line of the package, and no public name, refers to
    uses: Counter[str] = Counter()
    definitions: dict[str, Names] = defaultdict(list)
    for name, path in modules().items():
        tree = tree_of(path)
        for node in nodes_of(path):
            if isinstance(node, ast.Name):
                uses[node.id] += 1
            elif isinstance(node, ast.Attribute):
                uses[node.attr] += 1
            elif isinstance(node, ast.ImportFrom) and path.name != "__init__.py":
                uses.update(alias.name for alias in node.names)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
                # entry points, lazy names, names of methods looked up by text; not __all__
                uses[node.value] += 1
        uses.subtract(_exported(tree))
        for owner in nodes_of(path):
            for node in getattr(owner, "body", ()) if isinstance(owner, ast.Module | ast.ClassDef) else ():
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                    decorated = bool(node.decorator_list) and not _is_plain(node)
                    if not (node.name.startswith("__") or decorated):
                        definitions[node.name].append(f"{name}.{node.name}")
    public = public_names()
    return [
        place
        for name, places in sorted(definitions.items())
        if uses[name] <= 0 and name not in public | _CALLED_BY_OTHERS
        for place in places
        if place.split(".")[0] not in ("accessor", "paper")
    ]


def _is_plain(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> bool:
    # Tell whether decorators leave a definition to be called by its name
    plain = {"dataclass", "kernel", "borrowing_kernel", "property", "classmethod", "staticmethod", "cache"}
    texts = {
        re.split(r"[.(]", ast.unparse(item).replace("functools.", ""))[0] for item in node.decorator_list
    }
    return texts <= plain | {"contextlib", "lru_cache", "cached_property"}


def _exported(tree: ast.Module) -> Names:
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return list(ast.literal_eval(node.value))
    return []


def public_names() -> set[str]:
    # Return the names of the package's top and of the rooms that a user reaches from there
    names = set(_exported(tree_of(PACKAGE / "__init__.py")))
    for path in PACKAGE.glob("*/__init__.py"):
        names.update(_exported(tree_of(path)))
    for path in PACKAGE.rglob("__init__.pyi"):
        for node in nodes_of(path):
            if isinstance(node, ast.ImportFrom):
                names.update(alias.asname or alias.name for alias in node.names)
    return names


def riddles() -> Names:
    # Return every place where a variable or argument has a name that says nothing of its content
    places = []
    for name, path in modules().items():
        for node in nodes_of(path):
            word = (
                node.id
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
                else node.arg
                if isinstance(node, ast.arg)
                else ""
            )
            if word in RIDDLES:
                places.append(f"{name}:{node.lineno}: {word}")
    return places


def bare_refusals() -> Names:
    # Return messages that say "cannot be" and nothing after it; docstrings are no messages
    bare = re.compile(r"cannot be(?! [a-z])|cannot be (had|told|so)\b")
    places = []
    for name, path in modules().items():
        docs = {id(node.value) for node in nodes_of(path) if isinstance(node, ast.Expr)}
        for node in nodes_of(path):
            text = node.value if isinstance(node, ast.Constant) and id(node) not in docs else None
            if isinstance(text, str) and bare.search(text):
                places += [f"{name}:{node.lineno}: {text.strip()[:60]!r}"]
    return places


ERRORS = {
    "CollectError",
    "FormatError",
    "IncompleteStoreError",
    "PaintError",
    "PaintWarning",
    "Problem",
    "SchemaError",
    "StoreError",
    "TimeError",
    "UnitsError",
}


def faults_without_code() -> Names:
    # Return the calls that build an error, a problem or a warning without its code
    places = []
    for name, path in modules().items():
        for node in nodes_of(path):
            if isinstance(node, ast.Call) and name != "base.errors":
                function = ast.unparse(node.func)
                is_fault = function.rpartition(".")[2] in ERRORS
                is_fault |= bool(
                    re.search(r"problems?\.add(_if)?$|Error\.(raise_if(_none)?|instead_of)$", function)
                )
                coded = {keyword.arg for keyword in node.keywords} & {"code", "problems", None}
                categories = map(ast.unparse, node.args[1:2])
                is_bare = function == "warnings.warn" and "PaintWarning" in categories
                if is_bare or (is_fault and node.args and not coded):
                    places.append(f"{name}:{node.lineno}: {ast.unparse(node)[:80]}")
    return places


def top_names() -> Names:
    # Return the names that ``hp.<Tab>`` shows, without those of rooms
    stub = PACKAGE / "__init__.pyi"
    names = public_names() if not stub.is_file() else set()
    if stub.is_file():
        for node in tree_of(stub).body:
            if isinstance(node, ast.ImportFrom):
                names.update(alias.asname or alias.name for alias in node.names)
    else:
        names = set(_exported(tree_of(PACKAGE / "__init__.py")))
    rooms = {room_of(name) for name in modules() if "." in name}
    return sorted(name for name in names - rooms if not name.startswith("__"))


def promises() -> list[Promise]:
    # Return all counts
    sys.path.insert(0, str(ROOT / "tests"))
    from support.rooms import ALONE, ROOMS

    names = modules()
    pairs = arrows()
    up = [
        text
        for (room, target), texts in pairs.items()
        if (room in ALONE and target not in ALONE[room])
        or (room in ROOMS and target in ROOMS and ROOMS.index(target) > ROOMS.index(room))
        for text in texts
    ]
    lines = {name: path.read_text(encoding="utf-8").count("\n") for name, path in names.items()}
    sizes = [f"{name}: {count}" for name, count in sorted(lines.items(), key=lambda item: -item[1])]
    return [
        Promise("rooms at the top", None, sorted({room_of(name) for name in names if "." in name})),
        Promise("loose modules at the top", None, [name for name in names if "." not in name]),
        Promise("arrows between rooms", None, [f"{a} -> {b}" for a, b in sorted(pairs)]),
        Promise("arrows up", 0, up),
        Promise("circles between files", 0, circles()),
        Promise("lines", None, sizes, sum(lines.values())),
        Promise("file names used twice", 0, stems_used_twice()),
        Promise("more than 8 positional parameters", 0, long_signatures()),
        Promise("definitions without a caller", 0, uncalled()),
        Promise("public names at the top", 35, top_names()),
        Promise("variables named made, told, found, known, kept", None, riddles()),
        Promise('bare "cannot be" errors', 0, bare_refusals()),
        Promise("errors, problems and warnings without a code", 0, faults_without_code()),
    ]  # fmt: skip


def main() -> int:
    # Print every count beside its limit; 1 where one is over
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--list", metavar="NAME", help="show what a count is made of")
    parser.add_argument("--under", metavar="PREFIX", default="", help="only members that begin with this")
    given = parser.parse_args()
    counts = promises()
    if given.list:
        for promise in counts:
            if given.list in promise.name:
                print("\n".join(member for member in promise.members if member.startswith(given.under)))
        return 0
    broken = 0
    for promise in counts:
        over = promise.limit is not None and promise.value > promise.limit
        broken += over
        limit = "" if promise.limit is None else f"   at most {promise.limit:6,}{'   OVER' if over else ''}"
        print(f"{promise.name:50} {promise.value:7,}{limit}")
    return int(bool(broken))


if __name__ == "__main__":
    raise SystemExit(main())
