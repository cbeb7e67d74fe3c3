"""Share of small changes of the package that the tests of a room notice.

``python tests/campaigns/mutants.py kernels light --number 10 --seed 31`` changes one operator or number at a
time in a copy of the working tree, runs the tests of its room, and prints whether they failed;
``--thresholds`` doubles and halves numbers of tables of thresholds instead. Changes of texts, of annotations
and of documented limits of sizes are not made.
"""

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Files of the package and tests of every room.
ROOMS = {
    "kernels": ("kernels", ["kernels"]),
    "light": ("light", ["light", "surroundings/test_corrections.py"]),
    "signatures": ("paints/signatures", ["paints"]),
    "store": ("io/store", ["io/store", "workflows/test_pipeline.py"]),
    "spectrometers": ("io/spectrometers", ["io/spectrometers", "validation/test_validate.py"]),
    "surroundings": ("surroundings", ["surroundings", "regions"]),
    "regions": ("regions", ["regions", "system"]),
}
_SWAPS = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.And: "or", ast.Or: "and",
}  # fmt: skip
_SIGNS = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.And: "and", ast.Or: "or",
}  # fmt: skip


def places(source: str, thresholds: bool) -> Iterator[tuple[int, int, str]]:
    # Return begin and end [byte] of what is replaced, and the replacement
    tree, raw = ast.parse(source), source.encode()
    starts = [0, *(n + 1 for n, byte in enumerate(raw) if byte == 10)]

    def at(node: ast.expr, end: bool = False) -> int:
        line, column = (node.end_lineno, node.end_col_offset) if end else (node.lineno, node.col_offset)
        return starts[(line or 1) - 1] + (column or 0)

    def is_number(node: ast.AST) -> bool:
        return isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value != 0

    if thresholds:
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            if isinstance(call.func, ast.Name) and call.func.id == "SimpleNamespace":
                for number in (node for word in call.keywords for node in ast.walk(word.value)):
                    if is_number(number):
                        for factor in (2.0, 0.5):
                            value = type(number.value)(number.value * factor)
                            yield at(number), at(number, True), repr(value)
        return
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for node in (inner for statement in function.body for inner in ast.walk(statement)):
            if isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPS:
                between = (at(node.left, True), at(node.comparators[0]), node.ops[0])
            elif isinstance(node, ast.BinOp) and type(node.op) in _SWAPS:
                between = (at(node.left, True), at(node.right), node.op)
            elif isinstance(node, ast.BoolOp):
                between = (at(node.values[0], True), at(node.values[1]), node.op)
            elif is_number(node):
                larger = node.value + 1 if isinstance(node.value, int) else node.value * 1.5
                yield at(node), at(node, True), repr(larger)
                continue
            else:
                continue
            begin, end, operator = between
            text = raw[begin:end].decode()
            if text.count(_SIGNS[type(operator)]) == 1:
                yield begin, end, text.replace(_SIGNS[type(operator)], _SWAPS[type(operator)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rooms", nargs="+", choices=list(ROOMS))
    parser.add_argument("--number", type=int, default=10)
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--thresholds", action="store_true")
    parser.add_argument("--processes", default="1")
    arguments = parser.parse_args()
    for room in arguments.rooms:
        folder, tests = ROOMS[room]
        files = sorted((ROOT / "hyperpaint" / folder).rglob("*.py"))
        every = [(path, *place) for path in files for place in places(path.read_text(), arguments.thresholds)]
        chosen = random.Random(f"{arguments.seed} {room}").sample(every, min(arguments.number, len(every)))
        caught = 0
        for path, begin, end, text in [(files[0], 0, 0, ""), *chosen]:  # first without a change
            with tempfile.TemporaryDirectory() as copy:
                tree = Path(copy, "project")
                shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git", ".venv", "_build"))
                Path(copy, "shared").symlink_to(ROOT.parent / "shared")  # real files
                raw = path.read_bytes()
                name = path.relative_to(ROOT)
                (tree / name).write_bytes(raw[:begin] + text.encode() + raw[end:])
                command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", arguments.processes,
                           "-m", "not campaign", "-p", "no:cacheprovider"]  # fmt: skip
                command += [f"hyperpaint/{folder}", *(f"tests/{test}" for test in tests)]
                done = subprocess.run(command, cwd=tree, capture_output=True, text=True)
            if begin == end:
                if done.returncode:
                    sys.exit(f"{room}: its tests fail without a change:\n{done.stdout[-2000:]}")
                continue
            caught += done.returncode != 0
            row = raw[:begin].count(b"\n") + 1
            old = raw[begin:end].decode().strip()
            verdict = "caught" if done.returncode else "MISSED"
            print(f"{verdict} {name}:{row}: {old!r} -> {text.strip()!r}", flush=True)
        print(f"{room}: {caught} of {len(chosen)} caught, of {len(every)} possible changes", flush=True)


if __name__ == "__main__":
    main()
