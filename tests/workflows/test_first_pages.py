"""Every block of README and tour runs as it stands, on the files of the demonstration."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
#: Lines that install the package; the tests have it.
INSTALLS = ("python3 -m venv", ". .venv", "python -m pip")


def blocks(page: str, heading: str = "") -> list[tuple[str, str]]:
    # Language and text of the blocks of a page, or of one of its sections
    text = (ROOT / page).read_text(encoding="utf-8")
    if heading:
        text = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"^```(\w+)\n(.*?)^```", text, re.M | re.S)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Folder with the demonstration, and what it printed
    folder = tmp_path_factory.mktemp("first")
    (folder / "bin").mkdir()
    for name, words in {"python": "", "hyperpaint": " -m hyperpaint"}.items():
        (folder / "bin" / name).write_text(f'#!/bin/sh\nexec "{sys.executable}"{words} "$@"\n')
        (folder / "bin" / name).chmod(0o755)
    (folder / "shown.txt").write_text(run(folder, *blocks("README.md", "Try it")[0]))
    return folder


def run(home: Path, language: str, text: str) -> str:
    # Run a block in a new process; return what it printed
    path = f"{home / 'bin'}{os.pathsep}{os.environ['PATH']}"
    python = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    lines = [line for line in text.splitlines() if not line.startswith(INSTALLS)]
    words = [sys.executable, "-c"] if language == "python" else ["bash", "-e", "-c"]
    done = subprocess.run(
        [*words, "\n".join(lines)],
        cwd=home,
        env={**os.environ, "PATH": path, "PYTHONPATH": python, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_the_tour(home: Path) -> None:
    pytest.importorskip("matplotlib")
    (_, first), *others = blocks("docs/tour.md")
    assert first == blocks("README.md", "Try it")[0][1]
    for language, text in others:
        if language == "text":  # what the demo prints
            shown = (home / "shown.txt").read_text().splitlines()
            assert [line for line in text.splitlines() if line not in shown] == []
        elif "FOLDER" not in text:
            assert "nan" not in run(home, language, text).lower()
    assert (home / "paints.png").exists()
    assert (home / "report.html").exists()


def test_the_readme(home: Path) -> None:
    pytest.importorskip("rasterio")
    pytest.importorskip("matplotlib")
    (_, install), (_, spectra), *_ = blocks("README.md", "Try it")
    assert "hyperpaint demo" in install
    assert "448 nm" in run(home, "sh", spectra)
    # a flight in a folder: the files of the demo; the user fills in what no file contains
    folder = home / "2021_07_20"
    names = ("flight", "dark", "asd", "svc", "asd_reflectance", "calibration.zarr")
    for name in names:
        shutil.copytree(home / "demo" / name, folder / name)
    (_, commands), (_, python), *_ = blocks("README.md", "A real flight")
    _, init, process = [line for line in commands.splitlines() if line]
    assert "collect.toml" in run(home, "sh", init)
    assert '"?"' in (folder / "collect.toml").read_text()
    shutil.copy(home / "demo" / "collect.toml", folder)
    assert "report" in run(home, "sh", process)
    shown = run(home, "python", python)
    assert "1 of 1 pair within tolerance" in shown
    for text in (text for _, text in blocks("docs/tour.md") if "FOLDER" in text):
        check, again = [line.replace("FOLDER", folder.name) for line in text.splitlines()[1:]]
        assert "no findings" in run(home, "sh", check)
        assert "unchanged" in run(home, "sh", again)
