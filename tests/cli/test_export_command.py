"""The command ``hyperpaint export``."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_words

import hyperpaint as hp
from hyperpaint.io.dirsig import open_emissivity, read_materials
from hyperpaint.io.library import open_library

export = partial(hyperpaint, "export")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    # Return the path of a stored library of two paints with three members each
    members = np.random.default_rng(0).uniform(0.1, 0.8, (2, 3, 6)).astype(np.float32)
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), members.mean(axis=1), {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), members, {"units": "1"}),
        },
        {
            "signature": np.array(["Türkis, matt", "rot/blau"], object),
            "wavelength": ("band", np.linspace(400.0, 1000.0, 6), {"units": "nm"}),
        },
    )
    hp.to_store(library, tmp_path / "paints.zarr")
    return tmp_path / "paints.zarr"


def test_dirsig(store: Path, tmp_path: Path) -> None:
    out = tmp_path / "dirsig"
    done = export(store, "--format", "dirsig", "--out", out, status=0)
    expect_words(done.output, "2 paints, 6 curves", "README.txt")
    assert [material.id for material in read_materials(out / "materials.mat")] == ["Tuerkis_matt", "rot_blau"]
    again = open_emissivity(out / "emissivity/rot_blau.ems").member_reflectance[0]
    np.testing.assert_allclose(again, open_library(store).member_reflectance[1], atol=1e-6)
    refused = export(store, "--format", "dirsig", "--out", out, status=2)
    assert "pass --overwrite" in refused.output
    assert export(store, "--format", "dirsig", "--out", out, "--overwrite").exit_code == 0


def test_options_of_dirsig(store: Path, tmp_path: Path) -> None:
    out, more = tmp_path / "one", tmp_path / "two"
    done = export(
        store,
        "--format",
        "dirsig",
        "--out",
        out,
        "--range",
        300,
        900,
        "--extrapolate",
        "--curves",
        "centre",
        "--surface",
        "SimpleReflectance",
        status=0,
    )
    assert open_emissivity(out / "emissivity/rot_blau.ems").wavelength.values.tolist()[0] == 300.0
    done = export(store, "--format", "dirsig", "--out", more, "--scene-materials", out / "materials.mat")
    assert [material.id for material in read_materials(more / "materials.mat")] == [
        "Tuerkis_matt_2",
        "rot_blau_2",
    ]
    done = export(store, "--format", "dirsig", "--out", tmp_path / "three", "--specular", "0.1", status=2)
    assert "would count twice" in done.output
    done = export(store, "--format", "dirsig", "--out", tmp_path / "three", "--specular", "much", status=2)
    assert "expected a number or 'library'" in done.output


@pytest.mark.parametrize(("form", "name"), [("envi", "p.sli"), ("csv", "p.csv"), ("zarr", "p.zarr")])
def test_libraries(form: str, name: str, store: Path, tmp_path: Path) -> None:
    done = export(store, "--format", form, "--out", tmp_path / name, status=0)
    assert "2 paints, 6 bands" in done.output
    opened = open_library(tmp_path / name)
    assert sorted(opened["signature"].values.tolist()) == ["Türkis, matt", "rot/blau"]
    again = export(store, "--format", form, "--out", tmp_path / name, "--gaps", "refuse", status=2)
    assert "--gaps only with --format dirsig" in again.output


def test_one_row_a_paint_or_all_of_them(store: Path, tmp_path: Path) -> None:
    # Expected: two paints with three members each are 2 rows, or 2 x (1 + 3)
    done = export(store, "--format", "csv", "--out", tmp_path / "p.csv")
    assert "one row a paint, its centre; --curves all also writes members" in done.output
    assert len((tmp_path / "p.csv").read_text("utf-8-sig").splitlines()) == 1 + 2
    done = export(store, "--format", "csv", "--out", tmp_path / "all.csv", "--curves", "all")
    assert "one row" not in done.output
    assert len((tmp_path / "all.csv").read_text("utf-8-sig").splitlines()) == 1 + 8
    done = export(store, "--format", "csv", "--out", tmp_path / "x.csv", "--curves", "members", status=2)
    assert "expected centre or all for csv" in done.output
    done = export(store, "--format", "dirsig", "--out", tmp_path / "x", "--curves", "all", status=2)
    assert "choice-unknown" in done.output


def test_what_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_text("nothing")
    done = export(tmp_path / "x.txt", "--format", "dirsig", "--out", tmp_path / "out", status=2)
    assert done.output.startswith("error: ")
    assert export(tmp_path / "x.txt", "--format", "obj", "--out", tmp_path / "out").exit_code == 2
    assert not (tmp_path / "out").exists()


SCENE = """
[scene]
kind = "car_park"
length_m = 12.0
seed = 3
fleet = "solid"
[platform]
lines = 4
columns = 4
altitude_m = 15.0
ground_sample_m = 0.1
[paints]
car_000 = "Türkis, matt"
"""


def test_a_scene(store: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    out = tmp_path / "lot"
    done = export(
        store, "--format", "dirsig", "--out", out, "--scene", tmp_path / "scene.toml", "--quiet", status=0
    )
    expect_words(done.output, "2 of them populations", "vis,nir")
    (materials,) = (out / "materials").glob("*.mat")
    tokens = {material.id for material in read_materials(materials)}
    # one paint is on the car that the file names, the other on the rest
    assert {"Tuerkis_matt", "rot_blau", "asphalt"} <= tokens
    again = open_emissivity(out / "materials/emissivity/Tuerkis_matt.ems").member_reflectance[0]
    np.testing.assert_allclose(again, open_library(store).member_reflectance[0], atol=1e-6)
    assert {path.name for path in (out / "maps").iterdir()} == {"Tuerkis_matt.pgm", "rot_blau.pgm"}


def test_options_that_a_scene_has_not(store: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    options = ("--format", "dirsig", "--scene", tmp_path / "scene.toml", "--specular", "0.1")
    refused = export(store, "--out", tmp_path / "lot", *options, status=2)
    assert "--specular not with --scene" in refused.output
    assert not (tmp_path / "lot").exists()
    refused = export(store, "--format", "dirsig", "--out", tmp_path / "lot", "--coat-brdf")
    assert "--coat-brdf only with --scene" in refused.output
    refused = export(store, "--format", "csv", "--scene", tmp_path / "scene.toml")
    assert "--scene only with --format dirsig" in refused.output


_EXPORTS = """
import sys
from click.testing import CliRunner
from hyperpaint.cli.program import main
for name, format, *more in (
    ("a.sli", "envi", "--curves", "all"), ("b.csv", "csv", "--curves", "all"),
    ("c.parquet", "parquet", "--curves", "all"), ("d", "dirsig"),
):
    words = ["export", sys.argv[1], "--format", format, "--out", f"{sys.argv[2]}/{name}", *more]
    done = CliRunner().invoke(main, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
"""


def test_exports_are_the_same_bytes_in_every_process(store: Path, tmp_path: Path) -> None:
    # Rationale: xarray gathers coordinates from sets, whose order is another one in every process
    pytest.importorskip("pyarrow")
    library = open_library(store)
    names = ("standard_error", "spread", "lower", "upper", "median")
    library = library.assign_coords(dict.fromkeys(names, library["reflectance"] / 9))
    library = library.assign_coords({f"note_{at}": ("paint", ["x", "y"]) for at in range(5)})
    hp.to_store(library, tmp_path / "many.zarr")
    contents = []
    for seed in ("1", "2", "3"):
        out = tmp_path / seed
        out.mkdir()
        command = [sys.executable, "-c", _EXPORTS, str(tmp_path / "many.zarr"), str(out)]
        subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": seed}, check=True)
        files = sorted(file for file in out.rglob("*") if file.is_file())
        contents.append({str(file.relative_to(out)): file.read_bytes() for file in files})
    assert len(contents[0]) > 10
    assert [
        name for name in contents[0] if any(each.get(name) != contents[0][name] for each in contents)
    ] == []
