"""Every block of README and tour runs as it stands, on the files of the demonstration."""

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from support.commands import hyperpaint

from hyperpaint.base.errors import PaintWarning

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
    # Folder with the demonstration, and what it printed: the first command, in a process of its own
    folder = tmp_path_factory.mktemp("first")
    *installs, command = blocks("README.md", "Try it")[0][1].splitlines()
    assert all(line.startswith(INSTALLS) for line in installs)
    words = [sys.executable, "-m", *shlex.split(command)]
    shown = subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True, timeout=600).stdout
    (folder / "shown.txt").write_text(shown)
    return folder


def run(home: Path, language: str, text: str) -> str:
    # Run a block as a new process would, without its imports; return what it printed
    printed = io.StringIO()
    heredoc = re.fullmatch(r"python - <<'PY'\n(.*)^PY\n", text, re.M | re.S)
    with contextlib.chdir(home), contextlib.redirect_stdout(printed), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a process prints them
        warnings.simplefilter("error", PaintWarning)  # the first lines of a new user need no warning
        if heredoc or language == "python":
            exec(compile(heredoc[1] if heredoc else text, "block", "exec"), {"__name__": "__main__"})
        else:
            for line in text.splitlines():
                words = shlex.split(line, comments=True)
                if words and not line.startswith(INSTALLS):
                    assert words[0] == "hyperpaint"
                    printed.write(hyperpaint(*words[1:], status=0).stdout)
    return printed.getvalue()


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
