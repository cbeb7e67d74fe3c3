"""Signatures of paints that the demonstration prints, and that their comparison can fail."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.simulation.rendering.scene_spectra import paint_spec
from hyperpaint.workflows import demonstration
from hyperpaint.workflows.demonstration import compare, compare_paints, signature_problems, signature_table

pytestmark = pytest.mark.slow

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


def test_signatures_agree_with_a_plain_computation(folder: Path) -> None:
    found = {one.paint: one for one in compare_paints(folder / "lot.zarr", folder / "truth.zarr", BANDS)}
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


def test_field_spectra_and_scene_show_the_same_paints(folder: Path) -> None:
    # What the ASD saw and what roofs show differ by sky and slope; flakes shine towards the sun
    for one in compare_paints(folder / "lot.zarr", folder / "truth.zarr", BANDS):
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


def test_table(folder: Path) -> None:
    found = compare_paints(folder / "lot.zarr", folder / "truth.zarr", BANDS)
    table = signature_table(found).splitlines()[: len(found) + 2]
    assert (len({len(line) for line in table}), [line.split()[0] for line in table[2:]]) == (
        1,
        sorted(one.paint for one in found),
    )
    assert "ASD" in signature_table(found)


def test_a_plan_has_no_signatures(tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path, scene="plan", lines=8, bands=12, columns=8)
    assert compare(hp.process(collect, tmp_path / "lot.zarr"), tmp_path / "truth.zarr").paints == ()
