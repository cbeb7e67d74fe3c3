"""What the pages of the docs name is there: commands with their options, names of `hp`, links."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

import hyperpaint as hp
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
        options = {spelling for each in found.params for spelling in (*each.opts, *each.secondary_opts)}
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
