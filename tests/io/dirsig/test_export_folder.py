"""A call of `write_dirsig` that makes no sense, and the folder that it fills: whole, or not at all."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.dirsig_exports import BANDS, NM, files, library
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, SchemaError, StoreError
from hyperpaint.io.dirsig import read_emissivity, read_materials


@pytest.mark.parametrize("max_curves", [0, 2.5])
def test_all_wrong_options_are_told_at_once(tmp_path: Path, max_curves: Any) -> None:
    with pytest.raises(SchemaError) as caught:
        hp.write_dirsig(
            library(), tmp_path / "out", curves="all", wavelength_range=(900, 400), gaps="ignore",
            surface="Ward", rad_solver="a b", thermal={"thickness": 1.0}, max_curves=max_curves,
        )  # fmt: skip
    options = ("curves", "wavelength_range", "gaps", "surface", "rad_solver", "thermal", "max_curves")
    assert [name for name in options if f"{name}=" not in str(caught.value)] == []
    with pytest.raises(SchemaError, match="empty-input"):
        hp.write_dirsig(library().isel(signature=slice(0)), tmp_path / "out")
    with pytest.raises(SchemaError, match="option-conflict"):
        hp.write_dirsig(library(mirror_reflection="excluded"), tmp_path / "out", surface="SimpleReflectance",
                        specular=0.1)  # fmt: skip
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda lib: lib.drop_vars("reflectance"), "reflectance"),
        (lambda lib: lib.drop_vars("wavelength"), "wavelength"),
        (lambda lib: lib.assign(reflectance=lib.reflectance.assign_attrs(units="W m-2")), "units"),
        (lambda lib: lib.rename(signature="spectrum"), "dims"),
        (lambda lib: lib.assign(reflectance=lib.reflectance.astype(object)), "expected numbers"),
        (
            lambda lib: lib.assign(reflectance=(lib.reflectance * np.nan).assign_attrs(units="1")),
            "value-missing",
        ),
        (lambda lib: lib.assign(reflectance=lib.reflectance.drop_attrs()), "units"),
        (
            lambda lib: lib.assign(reflectance=(lib.reflectance * 100).assign_attrs(units="1")),
            "value-out-of-range",
        ),
        (
            lambda lib: lib.assign(reflectance=lib.reflectance.where(lib.band < 1).assign_attrs(units="1")),
            "two",
        ),
        (
            lambda lib: lib.assign_coords(wavelength=("band", NM * np.nan, {"units": "nm"})),
            "expected 1 to 100000 nm",
        ),
        (
            lambda lib: lib.assign_coords(wavelength=("band", NM, {"units": "um"})),
            "expected 1 to 100000 nm",
        ),
    ],
)
def test_what_is_no_library_is_refused(change: Any, said: str, tmp_path: Path) -> None:
    expect_errors((SchemaError, said, lambda: hp.write_dirsig(change(library()), tmp_path / "out")))
    assert not list(tmp_path.iterdir())


def test_simple_reflectance(tmp_path: Path) -> None:
    hp.write_dirsig(library(), tmp_path / "out", surface="SimpleReflectance", rad_solver="Simple")
    material = read_materials(tmp_path / "out/materials.mat")[0]
    assert material.reflectance_file == "reflectance/paint_0.txt"
    assert material.emissivity_file is None
    assert material.entry.get("RAD_SOLVER_NAME") == "Simple"


def test_ids_of_the_scene_are_not_used_again(tmp_path: Path) -> None:
    hp.write_dirsig(library(), tmp_path / "one")
    made = hp.write_dirsig(library(), tmp_path / "two", scene_materials=tmp_path / "one/materials.mat")
    assert made.material_id.values.tolist() == ["paint_0_2", "paint_1_2", "paint_2_2"]
    (tmp_path / "bad.mat").write_text("nonsense")
    with pytest.raises(FormatError, match=r"bad\.mat"):
        hp.write_dirsig(library(), tmp_path / "three", scene_materials=tmp_path / "bad.mat")


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    out = tmp_path / "out"
    hp.write_dirsig(library(), out)
    before = files(out)
    expect_errors((StoreError, "overwrite=True", lambda: hp.write_dirsig(library(seed=1), out)))
    assert files(out) == before
    hp.write_dirsig(library(paints=2, seed=1), out, overwrite=True)
    assert not (out / "emissivity/paint_2.ems").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_files_of_others_are_never_replaced(tmp_path: Path) -> None:
    hp.write_dirsig(library(), tmp_path / "out")
    for name in ("out/thesis.txt", "scene/scene.mat", "file"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "scene")
    before = files(tmp_path)
    for name, message in (
        ("out", r"thesis\.txt"),
        ("scene", "folder-occupied"),
        ("file", "path-not-folder"),
        ("link", "path-not-folder"),
    ):
        with pytest.raises(StoreError, match=message):
            hp.write_dirsig(library(), tmp_path / name, overwrite=True)
    expect_errors((StoreError, "folder-is-url", lambda: hp.write_dirsig(library(), "s3://bucket/out")))
    assert files(tmp_path) == before
    (tmp_path / "empty").mkdir()
    hp.write_dirsig(library(), tmp_path / "empty")


def test_what_fails_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    hp.write_dirsig(library(), out)
    before = files(out)

    def stop(done: int, _: int) -> None:
        raise KeyboardInterrupt

    expect_error(
        KeyboardInterrupt, None, lambda: hp.write_dirsig(library(seed=1), out, overwrite=True, progress=stop)
    )
    assert (files(out), [path.name for path in tmp_path.iterdir()]) == (before, ["out"])

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hyperpaint.io.files.publishing.flush_group", full)
    expect_errors((StoreError, "disk-full", lambda: hp.write_dirsig(library(seed=1), out, overwrite=True)))
    assert (files(out), [path.name for path in tmp_path.iterdir()]) == (before, ["out"])


@pytest.mark.slow
def test_what_a_killed_writer_leaves_is_cleared_up(tmp_path: Path) -> None:
    code = (
        "import os, sys, numpy as np, xarray as xr, hyperpaint as hp\n"
        "rho = ('signature', 'band'), np.ones((1, 3), 'f4') / 2, {'units': '1'}\n"
        "nm = ('band', [400., 500., 600.], {'units': 'nm'})\n"
        "lib = xr.Dataset({'reflectance': rho}, {'wavelength': nm})\n"
        "hp.write_dirsig(lib, sys.argv[1], progress=lambda *_: os._exit(9))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], timeout=60, check=False)
    assert (done.returncode, [path.name for path in tmp_path.iterdir()]) == (9, [".partial-out"])
    hp.write_dirsig(library(), tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_large_library_is_written_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hyperpaint.io.dirsig.dirsig_writing._BLOCK_BYTES", 4 * 5 * BANDS)
    hp.write_dirsig(library(paints=7), tmp_path / "one")
    steps: list[tuple[int, int]] = []
    hp.write_dirsig(library(paints=7).chunk({"signature": 3}), tmp_path / "two",
                    progress=lambda *step: steps.append(step))  # fmt: skip
    assert (steps, files(tmp_path / "one")) == ([(3, 7), (6, 7), (7, 7)], files(tmp_path / "two"))


def test_the_marker_does_not_depend_on_the_order_of_coordinates(tmp_path: Path) -> None:
    paints = library().assign_coords(zone=("signature", ["a"] * library().sizes["signature"]))
    paints = paints.assign_coords(area=("signature", ["b"] * library().sizes["signature"]))
    coords = {key: paints.variables[key] for key in reversed([*paints.coords])}
    turned = xr.Dataset(paints.reset_coords(drop=True).data_vars, coords, paints.attrs)
    for folder, one in (("one", paints), ("two", turned)):
        hp.write_dirsig(one, tmp_path / folder)
    one, two = ((tmp_path / folder / "paints.json").read_bytes() for folder in ("one", "two"))
    assert one == two
    assert b'"area": "b"' in one


# --- populations ------------------------------------------------------------------------------------------


def crowd(members: int, seed: int = 0) -> xr.Dataset:
    # Return a library of one paint whose members differ in brightness, every third with a gap.
    rng = np.random.default_rng(seed)
    nm = np.linspace(400.0, 1000.0, 31)
    level = rng.lognormal(0.0, 0.2, members)[:, None]
    values = (0.2 * level * (1.0 + 0.3 * np.sin(nm / 90.0))).astype(np.float32)
    values[::3, 12] = np.nan
    units = {"units": "1"}
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.nanmedian(values, axis=0)[None], units),
            "member_reflectance": (("signature", "member", "band"), values[None], units),
        },
        {"signature": ["red"], "wavelength": ("band", nm, {"units": "nm"})},
    )


def test_a_population_is_thinned_at_even_ranks(tmp_path: Path) -> None:
    library = crowd(300)
    summary = hp.write_dirsig(library, tmp_path / "out", max_curves=50, gaps="interpolate")
    assert int(summary.curves[0]) == int(summary.complete[0]) == 50
    assert int(summary.thinned[0]) == 250
    curves = 1.0 - np.stack(
        [each.emissivity for each in read_emissivity(tmp_path / "out/emissivity/red.ems").curves]
    )
    whole = library.member_reflectance.values[0]
    whole = whole[np.isfinite(whole).all(axis=1)]
    for share in (0.1, 0.25, 0.5, 0.75, 0.9):
        expected = np.quantile(whole.mean(axis=1), share)
        assert np.quantile(curves.mean(axis=1), share) == pytest.approx(expected, rel=0.02)
    assert "red 250" in (tmp_path / "out" / "README.txt").read_text()


def test_gaps_are_taken_where_complete_curves_do_not_suffice(tmp_path: Path) -> None:
    summary = hp.write_dirsig(crowd(30), tmp_path / "out", max_curves=25, gaps="interpolate")
    assert (int(summary.curves[0]), int(summary.thinned[0])) == (25, 5)
    assert 15 <= int(summary.complete[0]) < 25
