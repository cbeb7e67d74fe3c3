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
from hyperpaint.simulation.rendering.scene_spectra import paint_spec
from hyperpaint.workflows import demonstration
from hyperpaint.workflows.demonstration import (
    PaintAgreement,
    compare,
    compare_paints,
    refuse_foreign,
    signature_problems,
    signature_table,
)

pytestmark = pytest.mark.slow

SHAPE = ("--lines", "64", "--bands", "100", "--columns", "24")


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
    start = next(number for number, line in enumerate(lines) if line.startswith("material"))
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
    demonstration._draw(demo[0] / "lot.zarr", tmp_path / "quicklook.png", said.append)
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
    # a plan has no signatures
    assert compare(tmp_path / "again" / "lot.zarr", tmp_path / "again" / "truth.zarr").paints == ()


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


# --- Signatures of paints that the demonstration prints, and that their comparison can fail ---

BANDS = (420.0, 980.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A small rendered collect, processed
    made = tmp_path_factory.mktemp("closure")
    collect = hp.simulate_collect(
        made, lines=120, bands=24, columns=80, samples=8, seed=2, dropped=4, cubes=2, fleet="solid"
    )
    hp.process(collect, made / "lot.zarr")
    return made


@pytest.fixture(scope="module")
def paints(folder: Path) -> tuple[PaintAgreement, ...]:
    return compare_paints(folder / "lot.zarr", folder / "truth.zarr", BANDS)


def test_signatures_agree_with_a_plain_computation(folder: Path, paints: tuple[PaintAgreement, ...]) -> None:
    found = {one.paint: one for one in paints}
    assert len(found) >= 4
    truth = xr.open_zarr(folder / "truth.zarr").load()
    names = truth["paint_id"].attrs["flag_meanings"].split()
    lines = [xr.open_zarr(folder / "lot.zarr", group=f"flightlines/raw_{n}").load() for n in (0, 60)]
    quality = np.full(truth["paint_id"].shape, 2048)
    recovered = np.full(truth["reflectance"].shape, np.nan)
    for line in lines:
        quality[line["frame"].values] = line["quality"].values
        recovered[line["frame"].values] = line["reflectance"].values
    wavelength = lines[0]["wavelength"].values
    bands = (wavelength >= 420) & (wavelength <= 980)
    clean = (quality == 0) & (truth["purity"].values > 0.999) & (truth["shadow"].values < 0.001)
    clean &= (truth["up"].values > 0.7) & ~truth["glint"].values
    field = hp.open_asd(folder / "asd_reflectance")
    for name, one in found.items():
        here = clean & (truth["paint_id"].values == names.index(name))
        seen = recovered.transpose(0, 2, 1)[here][:, bands].mean(axis=0, dtype=np.float64)
        true = (
            truth["reflectance"].transpose(..., "band").values[here][:, bands].mean(axis=0, dtype=np.float64)
        )
        assert ((one.pixels, one.cars), one.recovered) == (
            (here.sum(), len(np.unique(truth["car_id"].values[here]))),
            pytest.approx(seen.mean(), rel=1e-9),
        )
        assert one.error == pytest.approx(np.sqrt(((seen / true - 1) ** 2).mean()), rel=1e-6)
        file = [Path(str(source)).stem for source in field["source"].values].index(name)
        wanted = np.interp(wavelength[bands], field["wavelength"], field["reflectance"][file]).mean()
        assert one.field == pytest.approx(wanted, rel=1e-9)


def test_field_spectra_and_scene_show_the_same_paints(paints: tuple[PaintAgreement, ...]) -> None:
    # What the ASD saw and what roofs show differ by sky and slope; flakes shine towards the sun
    for one in paints:
        solid = paint_spec(one.paint).finish == "solid"
        if one.pixels > 20:
            assert 0.75 * one.field < one.recovered < one.field + (0.06 if solid else 0.2), one.paint


def test_a_wrong_chain_shows_in_the_signatures(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demonstration, "_MIN_PIXELS", 20)
    right = compare(folder / "lot.zarr", folder / "truth.zarr")
    for name in ("raw_0", "raw_60"):
        line = xr.open_zarr(folder / "lot.zarr", group=f"flightlines/{name}").load().drop_encoding()
        wrong = line.assign(reflectance=line["reflectance"] * np.float32(1.03))
        hp.to_store(wrong, tmp_path / "wrong.zarr", f"flightlines/{name}")
    (tmp_path / "truth.zarr").symlink_to(folder / "truth.zarr")
    (tmp_path / "asd_reflectance").symlink_to(folder / "asd_reflectance")
    found = compare(tmp_path / "wrong.zarr", tmp_path / "truth.zarr")
    assert not signature_problems([one for one in right.paints if one.recovered > 0.05])
    assert len(signature_problems(found.paints)) >= 3
    assert set(signature_problems(found.paints)) <= set(found.problems)
    assert "signature of" in found.problems[-1]


def test_table(paints: tuple[PaintAgreement, ...]) -> None:
    table = signature_table(paints).splitlines()[: len(paints) + 2]
    assert (len({len(line) for line in table}), [line.split()[0] for line in table[2:]]) == (
        1,
        sorted(one.paint for one in paints),
    )
    assert "ASD" in signature_table(paints)
