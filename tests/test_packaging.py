"""The recipe, the citation and the workflows say what pyproject.toml says."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import hyperpaint

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def bounds(requirements: list[str]) -> dict[str, str]:
    """Return the lower bound of every requirement by its name; dask-core is dask."""
    parts = (re.fullmatch(r"([\w.-]+)(?:\[.*\])? ?>=([\d.]+)", each) for each in requirements)
    return {part[1].replace("dask-core", "dask").lower(): part[2] for part in parts if part}


def test_the_recipe_asks_for_what_the_package_asks_for():
    recipe = (ROOT / ".conda" / "meta.yaml").read_text(encoding="utf-8")
    run = recipe.partition("  run:\n")[2].partition("\n\n")[0]
    asked = bounds([line.strip(" -") for line in run.splitlines()])
    assert asked.pop("python") == PROJECT["requires-python"].removeprefix(">=")
    assert asked == bounds(PROJECT["dependencies"])


def test_one_version():
    assert PROJECT["version"] == hyperpaint.__version__
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.+)$", citation, re.M)[1] == hyperpaint.__version__


def test_workflows_call_what_is_there():
    for workflow in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        for script in re.findall(r"bash (\S+)", workflow.read_text(encoding="utf-8")):
            assert (ROOT / script).is_file(), f"{workflow.name}: {script}"


def test_every_name_is_there_right_after_the_import():
    names = [name for name in hyperpaint.__all__ if name != "__version__"]
    code = "import sys, hyperpaint; getattr(hyperpaint, sys.argv[1])"
    for name in ("errors", names[0]):  # each needs a process of its own; the first was missing once
        subprocess.run([sys.executable, "-c", code, name], check=True)


def test_workflows_pin_actions_and_may_only_read():
    for workflow in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        text = workflow.read_text(encoding="utf-8")
        uses = re.findall(r"uses: (.+)", text)
        assert [each for each in uses if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v[\d.]+", each)] == []
        assert "\npermissions: {contents: read}\n" in text, workflow.name
        assert set(re.findall(r"(\S+): write", text.replace("{", " "))) <= {"id-token"}, workflow.name
