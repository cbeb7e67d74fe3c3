"""``hyperpaint paints``."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_words

import hyperpaint as hp


def run(*arguments: object, status: int = 0) -> str:
    return hyperpaint("paints", *arguments, status=status).output


def test_it_lists_the_starter_library() -> None:
    told = run("--members", 0)
    assert told.startswith("40 of 40 paints, 272 bands\n")
    expect_words(told, "Synthetic Signal Red", "#831b2a")


def test_it_searches_saves_and_draws(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out, picture = tmp_path / "red.zarr", tmp_path / "red.png"
    told = run("--colour", "red", "--limit", 3, "--members", 2, "--out", out, "--picture", picture)
    expect_words(told, "3 of 40 paints", "colour difference")
    saved = hp.open_library(out)
    assert (saved["signature"].values[0], saved.member_reflectance.shape) == (
        "Synthetic Signal Red",
        (3, 2, 272),
    )
    assert picture.stat().st_size > 5000
    assert "pass --overwrite" in run("--out", out, "--members", 3, status=2)
    run("--out", out, "--members", 3, "--overwrite")
    assert hp.open_library(out).sizes["signature"] == 40


def test_a_library_of_ones_own(tmp_path: Path) -> None:
    library = hp.paints.starter_library(members=0)
    names = np.array([f"Škoda, grün {k}" for k in range(40)], object)
    path = hp.write_library(library.assign_coords(signature=names), tmp_path / "own.csv")
    assert "1 of 40" in run(path, "--name", "skoda, gruen 7")
    assert "angle 0.0000 rad" in run(path, "--like", "Škoda, grün 7", "--limit", 1)
    assert "no paint meets" in run(path, "--name", "volvo")
    assert "--members is only for the starter" in run(path, "--members", 3, status=2)


def test_a_spectrum_in_a_file(tmp_path: Path) -> None:
    red = hp.paints.starter_library(members=0).isel(signature=[5])
    pairs = zip(red.wavelength.values, red.reflectance.values[0], strict=True)
    table = "wavelength (nm),reflectance\n" + "".join(f"{nm:.2f},{value:.6f}\n" for nm, value in pairs)
    (tmp_path / "mine.csv").write_text(table)
    told = run("--like", tmp_path / "mine.csv", "--maximum-angle", 0.001)
    expect_words(told, "1 of 40", "Synthetic Signal Red")


@pytest.mark.real_data
def test_a_real_field_spectrum_is_taken(shared_data: Path) -> None:
    files = sorted(shared_data.glob("**/*.sig"))
    assert files
    assert "angle" in run("--like", files[0], "--limit", 2)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--like", "nothing"], "paint-unknown"),
        (["--colour", "rde"], "did you mean 'red'"),
        (["--maximum-angle", "0.1"], "--maximum-angle needs --like"),
        (["--maximum-difference", "5"], "--maximum-difference needs --colour"),
        (["--out", "paints.xyz"], "suffix"),
    ],
)
def test_what_it_refuses(arguments: list[str], text: str) -> None:
    assert text in run(*arguments, status=2)


def test_help_teaches() -> None:
    expect_words(run("--help"), "hyperpaint export starter.zarr --format dirsig", "not measured")


def test_info_of_dirsigs_files(tmp_path: Path) -> None:
    made = hp.write_dirsig(hp.paints.starter_library(members=2).isel(signature=[0, 3]), tmp_path / "dirsig")
    emissivity = tmp_path / "dirsig" / made.emissivity_file.values[0]
    told = [hyperpaint("info", path).output for path in (emissivity, tmp_path / "dirsig" / "materials.mat")]
    assert "1 signature x 2 member x 272 band" in told[0]
    expect_words(told[1], "DIRSIG material list: 2 materials", "Synthetic Carbon Black")
    assert isinstance(hp.open_library(emissivity), xr.Dataset)
