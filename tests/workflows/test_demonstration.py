"""The demonstration, end to end, and that its comparison can fail."""

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_words

import hyperpaint as hp
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
    pytest.importorskip("matplotlib")
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
