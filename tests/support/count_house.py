#!/usr/bin/env python3
"""Counts of a tree of Python code: statements, definitions, habits of language.

``python tests/support/count_house.py ROOT ...`` prints them. Statements are counted, so packing lines gains
nothing. The options of the command line are counted too where the package can be imported.
"""

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

LONG_MATCH = "match= texts of 25 and more characters"
COUNTS = (
    "statements",
    "functions",
    "classes",
    "files",
    "raises",
    "own lazy imports",
    "other lazy imports",
    "fmt: skip",
    "more than 8 positional parameters",
    "docstrings",
    LONG_MATCH,
)
WHAT = "docstrings with 'what' in the first sentence"


def first_sentence(text):
    return re.split(r"(?<=[.:;])\s|\n\s*\n", text.strip(), maxsplit=1)[0]


def count(root):
    total, lengths, package = Counter(), [], Path(root).name
    for path in sorted(Path(root).rglob("*.py")):
        source = path.read_text(encoding="utf-8", errors="replace")
        tree = ast.parse(source)
        total["files"] += 1
        if "#" in source:
            for token in tokenize.generate_tokens(io.StringIO(source).readline):
                if token.type == tokenize.COMMENT:
                    total["comments"] += 1
                    total["fmt: skip"] += "fmt: skip" in token.string or "fmt: off" in token.string
        # nodes inside a function
        inside, functions = set(), (ast.FunctionDef, ast.AsyncFunctionDef)
        stack = [(tree, False)]
        while stack:
            node, within = stack.pop()
            if within:
                inside.add(id(node))
            stack.extend(
                (child, within or isinstance(node, functions)) for child in ast.iter_child_nodes(node)
            )
        for node in ast.walk(tree):
            total["statements"] += isinstance(node, ast.stmt)
            total["classes"] += isinstance(node, ast.ClassDef)
            total["raises"] += isinstance(node, ast.Raise)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                total["functions"] += 1
                lengths.append(sum(isinstance(each, ast.stmt) for each in ast.walk(node)) - 1)
                a = node.args
                total["more than 8 positional parameters"] += len(a.posonlyargs) + len(a.args) > 8
            if isinstance(node, ast.keyword) and node.arg == "match" and isinstance(node.value, ast.Constant):
                total[LONG_MATCH] += len(str(node.value.value)) >= 25
            if isinstance(node, ast.ImportFrom | ast.Import) and id(node) in inside:
                is_from = isinstance(node, ast.ImportFrom)
                names = [node.module or ""] if is_from else [alias.name for alias in node.names]
                own = getattr(node, "level", 0) > 0 or any(name.split(".")[0] == package for name in names)
                total["own lazy imports"] += own
                total["other lazy imports"] += not own
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
                text = ast.get_docstring(node)
                if text:
                    total["docstrings"] += 1
                    total[WHAT] += bool(re.search(r"\bwhat\b", first_sentence(text), re.IGNORECASE))
    lengths.sort()
    return total, lengths


def options(package):
    try:
        import click

        program = __import__(f"{package}.cli.program", fromlist=["main"])
        group = next(each for each in vars(program).values() if isinstance(each, click.Group))
        context = click.Context(group)
        commands = [group.get_command(context, name) for name in group.list_commands(context)]
        return len(commands), sum(isinstance(one, click.Option) for each in commands for one in each.params)
    except Exception as error:
        return f"not counted ({type(error).__name__})", f"not counted ({error!s:.80})"


def main(roots):
    for root in roots:
        total, lengths = count(root)
        print(f"== {root}")
        rows = [(name, f"{total[name]:>8,}") for name in COUNTS]
        rows.append((WHAT, f"{total[WHAT] / max(total['docstrings'], 1):>8.1%}"))
        rows.append(
            ("comments a 100 statements", f"{100 * total['comments'] / max(total['statements'], 1):>8.1f}")
        )
        if lengths:
            middle, long = lengths[len(lengths) // 2], lengths[int(0.9 * len(lengths))]
            rows.append(("statements of a function: median, 90 %, most", f"{middle} {long} {lengths[-1]}"))
        if Path(root, "cli", "program.py").is_file():
            commands, number = options(Path(root).name)
            rows.append(("commands, options of the command line", f"{commands}, {number}"))
        for name, text in rows:
            print(f"{name:<50} {text}")


if __name__ == "__main__":
    main(sys.argv[1:] or ["hyperpaint"])
