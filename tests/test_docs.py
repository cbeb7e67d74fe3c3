"""What the pages of the docs name is there: commands with their options, names of `hp`, links."""

from __future__ import annotations

import ast
import doctest
import functools
import importlib.util
import inspect
import json
import re
import shlex
import sys
import textwrap
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest

import hyperpaint as hp
from hyperpaint.accessor import PaintAccessor
from hyperpaint.cli.program import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [ROOT / "README.md", *(page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts)]
)
WRITTEN = [page for page in PAGES if "reference" not in page.parts]  # by hand, not by docs/public_names.py
NAMES = {page.relative_to(ROOT).as_posix(): page for page in WRITTEN}


def commands(text: str) -> list[list[str]]:
    """Return the words of every line of a shell block that begins with hyperpaint."""
    blocks = re.findall(r"^```(?:sh|bash|shell)\n(.*?)^```", text, re.M | re.S)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line, comments=True) for line in lines if line.startswith("hyperpaint ")]


@pytest.mark.parametrize("name", NAMES)
def test_commands_have_the_options_that_pages_give_them(name):
    context = click.Context(main)
    for _, command, *words in commands(NAMES[name].read_text(encoding="utf-8")):
        if command.startswith("-"):
            continue
        found = main.get_command(context, command)
        assert found is not None, f"{name}: there is no command {command}"
        given_to = [*found.params, *main.params]
        options = {spelling for each in given_to for spelling in (*each.opts, *each.secondary_opts)}
        options |= set(found.context_settings.get("help_option_names", ["--help"]))
        given = {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}
        assert given <= options, f"{name}: hyperpaint {command} has no {given - options}"


@pytest.mark.parametrize("name", NAMES)
def test_names_of_hp_are_there(name):
    text = NAMES[name].read_text(encoding="utf-8")
    for dotted in sorted(set(re.findall(r"\bhp((?:\.[A-Za-z_]\w*)+)", text))):
        value = hp
        for part in dotted.split(".")[1:]:
            value = getattr(value, part)  # an AttributeError says what is missing


@pytest.mark.parametrize("name", NAMES)
def test_links_between_pages_lead_somewhere(name):
    page = NAMES[name]
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link) or "/gallery/" in link:
            continue
        assert (page.parent / link).exists(), f"{name}: {link}"


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_notebooks_hold_trimmed_outputs_and_alternative_texts():
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text = path.read_text(encoding="utf-8")
        assert len(text.encode()) <= 300_000, path.name
        shown = [
            (cell, {kind for output in cell["outputs"] for kind in output.get("data", {})})
            for cell in json.loads(text)["cells"]
            if cell["cell_type"] == "code"
        ]
        assert any("image/png" in kinds for _, kinds in shown), f"{path.name}: run notebooks/refresh.py"
        for cell, kinds in shown if path.name[0].isdigit() else []:
            assert "image/png" not in kinds or cell["metadata"]["mystnb"]["image"]["alt"], path.name


@functools.cache
def of_docs(name: str) -> ModuleType:
    """Return a module of docs/, which is not a package."""
    if str(ROOT / "docs") not in sys.path:  # its modules import each other
        sys.path.append(str(ROOT / "docs"))
    return importlib.import_module(name)


def examples(value: Any) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(inspect.getdoc(value) or "")


#: Whose examples need an extra that the tests do without; run below where it is there.
WITH_EXTRAS = {"Dataset.paint.quantify": "pint_xarray"}


def public_values() -> dict[str, Any]:
    names = {
        name: functools.reduce(getattr, name.split(".")[1:], hp)
        for name in of_docs("public_names").public_names()
    }
    methods = {
        f"Dataset.paint.{name}": getattr(PaintAccessor, name)
        for name in of_docs("public_names").accessor_methods()
    }
    return {**names, **methods}


def test_every_public_name_has_an_example_that_runs():
    skips = {
        name: [one.options.get(doctest.SKIP, False) for one in examples(value)]
        for name, value in public_values().items()
    }
    assert len(skips) > 170
    lacking = {name for name, each in skips.items() if all(each)} - set(WITH_EXTRAS)
    assert not lacking, f"no example that runs: {sorted(lacking)}"


def public_functions() -> dict[str, Any]:
    """Return public functions, and public methods of public classes, without their decorators."""
    functions = {}
    for name, value in public_values().items():
        if name.startswith("Dataset.paint"):  # the same functions
            continue
        inner = vars(value).items() if inspect.isclass(value) else ()
        methods = {f"{name}.{key}": getattr(value, key) for key, _ in inner if not key.startswith("_")}
        functions |= {key: inspect.unwrap(each) for key, each in {name: value, **methods}.items()}
    return {name: one for name, one in functions.items() if inspect.isfunction(inspect.unwrap(one))}


def parameter_texts(doc: str) -> dict[str, str]:
    """Return the descriptions of the parameters of a numpydoc text, by their headings."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\S[^\n]*\n---|\Z)", doc, re.M | re.S)
    entries = re.findall(r"^(\S.*)((?:\n(?!\S).*)*)", section[1] if section else "", re.M)
    return {heading: " ".join(text.split()) for heading, text in entries}


def test_every_parameter_of_a_public_function_has_a_description():
    texts = {name: parameter_texts(inspect.getdoc(one) or "") for name, one in public_functions().items()}
    assert sum(map(len, texts.values())) > 500
    assert not [(name, key) for name, each in texts.items() for key, text in each.items() if not text]


def test_descriptions_of_parameters_that_functions_share_stand_in_one_table():
    counts: Counter[str] = Counter()
    for one in {id(one): one for one in public_functions().values()}.values():
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        counts.update(set(parameter_texts(ast.get_docstring(node) or "").values()))
    repeated = [text for text, count in counts.items() if text and count > 2]
    assert not repeated, "hyperpaint/base/facts.py has the table PARAMETERS for these"


@pytest.mark.parametrize("name", [*WITH_EXTRAS, "Dataset.paint.verify"])
def test_examples_that_need_an_extra_or_stand_in_the_accessor(name):
    if name in WITH_EXTRAS:
        pytest.importorskip(WITH_EXTRAS[name])
    value = public_values()[name]
    wanted = examples(value)
    for one in wanted:
        one.options.pop(doctest.SKIP, None)
    run = doctest.DocTest(wanted, inspect.getmodule(value).__dict__.copy(), name, None, 0, None)
    assert doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(run).failed == 0


def test_links_of_a_built_site_that_lead_nowhere_are_named(tmp_path):
    (tmp_path / "other.html").write_text('<h1 id="there">A</h1>')
    right = ["other.html", "other.html#there", "#here", "https://doi.org/10.1016/j.rse.2006.03.002"]
    wrong = {
        "other.html#gone": "no such anchor", "none.html": "no such file", "http://xarray.dev": "https",
        "https://nowhere": "https", "https://doi.org/j.rse": "no DOI",
    }  # fmt: skip
    links = "".join(f'<a href="{link}">x</a>' for link in [*right, *wrong])
    (tmp_path / "index.html").write_text(f'<p id="here">{links}</p>')
    count, faults = of_docs("check_links").faults(tmp_path)
    assert (count, [fault.split(": ")[1] for fault in faults]) == (len(right) + len(wrong), list(wrong))
    assert all(text in fault for text, fault in zip(wrong.values(), faults, strict=True))


def test_every_code_is_well_formed_and_has_a_section():
    module = of_docs("error_codes")
    codes = {fault.code for fault in module.faults()}
    assert not {code for code in codes if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+){0,4}", code)}
    page = module.codes_page()
    assert all(f"\n## {code}\n" in page for code in codes)
