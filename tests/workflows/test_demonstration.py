"""The demonstration, end to end, and that its comparison can fail."""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.workflows import demonstration
from hyperpaint.workflows.demonstration import (
    compare,
    compare_with_field,
    field_table,
    refuse_foreign,
)

pytestmark = pytest.mark.slow

SHAPE = ("--lines", "110", "--bands", "48", "--columns", "140", "--samples", "4")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    # Folder of a small demonstration, and what it printed
    folder = tmp_path_factory.mktemp("demo") / "out"
    done = hyperpaint("demo", "--out", folder, *SHAPE, status=0)
    assert done.stderr == ""
    return folder, done.stdout


def test_demo_leaves_what_it_says(demo: tuple[Path, str]) -> None:
    folder, shown = demo
    left = {entry.name for entry in folder.iterdir()} - {"quicklook.png"}
    assert left == {
        "asd", "asd_reflectance", "calibration.zarr", "collect.toml", "dark", "flight", "lot.zarr",
        "regions.geojson", "survey.csv", "svc", "truth.zarr",
    }  # fmt: skip
    assert hp.verify(folder / "lot.zarr").ok
    expect_words(shown, "within tolerance", "Now try:", f"hyperpaint verify {folder / 'lot.zarr'}")


def test_demo_prints_an_aligned_table(demo: tuple[Path, str]) -> None:
    lines = demo[1].splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("material "))
    stop = next(number for number, line in enumerate(lines) if line.startswith("all pixels"))
    table = lines[start : stop + 1]
    assert len({len(line) for line in table}) == 1
    assert {"worn_asphalt", "mixed_grass"} <= {line.split()[0] for line in table}


def test_demo_draws_a_picture(demo: tuple[Path, str]) -> None:
    picture = demo[0] / "quicklook.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert f"picture: {picture}" in demo[1]


def test_without_matplotlib_the_demo_says_how_to_get_a_picture(
    demo: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    demonstration.draw_comparison(demo[0] / "lot.zarr", tmp_path / "quicklook.png", said.append)
    (text,) = said
    assert text.startswith("no picture: a quicklook needs matplotlib")
    assert text.endswith("[extra-missing]")
    assert not (tmp_path / "quicklook.png").exists()


def test_comparison_agrees_with_a_plain_computation(demo: tuple[Path, str]) -> None:
    folder, _ = demo
    found = compare(folder / "lot.zarr", folder / "truth.zarr")
    line = xr.open_zarr(folder / "lot.zarr", group="flightlines/raw_0").load()
    truth = xr.open_zarr(folder / "truth.zarr").isel(along_track=line["frame"].values).load()
    bands = (line["wavelength"].values >= 420) & (line["wavelength"].values <= 980)
    clean = line["quality"].values == 0
    grass = str(truth["surface"].attrs["flag_meanings"]).split().index("mixed_grass")
    chosen = clean & (truth["surface"].values == grass)
    one = next(agreement for agreement in found.materials if agreement.material == "mixed_grass")
    rec = line["reflectance"].transpose(..., "band").values[chosen][:, bands].astype(np.float64)
    true = truth["reflectance"].transpose(..., "band").values[chosen][:, bands].astype(np.float64)
    assert (one.pixels, one.bias, one.rmse) == (
        chosen.sum(),
        pytest.approx((rec - true).mean(), abs=1e-12),
        pytest.approx(np.sqrt(((rec - true) ** 2).mean()), rel=1e-9),
    )
    assert one.recovered == pytest.approx(rec.mean(), rel=1e-9)
    assert sum(agreement.pixels for agreement in found.materials) == found.overall.pixels == clean.sum()


def test_a_wrong_chain_is_outside_tolerance(
    demo: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One per cent of gain is enough
    folder, _ = demo
    line = xr.open_zarr(folder / "lot.zarr", group="flightlines/raw_0").load().drop_encoding()
    wrong = line.assign(reflectance=line["reflectance"] * np.float32(1.02))
    hp.to_store(wrong, tmp_path / "wrong.zarr", "flightlines/raw_0")
    found = compare(tmp_path / "wrong.zarr", folder / "truth.zarr")
    assert not found.ok
    assert any(problem.startswith("all pixels: bias") for problem in found.problems)
    assert any("oxygen" in problem for problem in found.problems)
    monkeypatch.setattr(demonstration, "compare", lambda *_: found)
    done = hyperpaint(
        "demo", "--out", tmp_path / "again", "--scene", "plan", "--lines", "8", "--bands", "8", status=1
    )
    assert "OUTSIDE TOLERANCE" in done.stdout
    # a small plan has no regions
    assert compare_with_field(tmp_path / "again" / "lot.zarr", tmp_path / "again") is None


def test_demo_replaces_only_demos(demo: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = demo
    refuse_foreign(folder, overwrite=False)
    refuse_foreign(tmp_path / "new", overwrite=False)
    hp.simulate_collect(tmp_path / "only_simulated", scene="plan", lines=8, bands=4, columns=4)
    expect_error(
        hp.StoreError,
        "folder-not-empty",
        lambda: refuse_foreign(tmp_path / "only_simulated", overwrite=False),
    )
    shutil.rmtree(tmp_path / "only_simulated")
    (tmp_path / "thesis.tex").write_text("text")
    done = hyperpaint("demo", "--out", tmp_path, *SHAPE, status=2)
    expect_words(done.stderr, "is not empty (thesis.tex)", "--overwrite")
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    "name", ["flight/raw_0.hdr", "svc/red.sig", "asd_reflectance/red.asd", "regions.geojson"]
)
def test_real_raw_data_are_never_replaced(tmp_path: Path, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("ENVI\nsamples = 640\n")
    expect_error(hp.StoreError, "raw-data-present", lambda: refuse_foreign(tmp_path, overwrite=True))


def test_a_pipe_among_the_files_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "flight").mkdir()
    os.mkfifo(tmp_path / "flight" / "gps.hdr")
    expect_error(hp.StoreError, "raw-data-present", lambda: refuse_foreign(tmp_path, overwrite=True))


def test_the_field_spectrometer_comes_first(demo: tuple[Path, str], tmp_path: Path) -> None:
    folder, shown = demo
    assert shown.index("seen by") < shown.index("closure with the simulator's own pixels")
    found = compare_with_field(folder / "lot.zarr", folder)
    names = [region.name for region in hp.read_regions(folder / "regions.geojson")]
    assert found.statistics["signature"].values.tolist() == names
    assert found.statistics["reference"].values.tolist() == names
    assert (folder / "svc" / f"{names[0]}.sig").exists()
    assert field_table(found) in shown
    assert {"solid", "metallic"} <= {name.split()[1] for name in names}
    assert found.statistics["passes"].values[np.array(["solid" in name for name in names])].all()
    # a chain that is wrong by a fifth fails
    line = xr.open_zarr(folder / "lot.zarr", group="flightlines/raw_0").load().drop_encoding()
    wrong = line.assign(reflectance=line["reflectance"] * np.float32(1.2))
    hp.to_store(wrong, tmp_path / "wrong.zarr", "flightlines/raw_0")
    assert "FAIL" in field_table(compare_with_field(tmp_path / "wrong.zarr", folder))


# --- Every block of README and tour runs as it stands, on the files of the demonstration ---


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
