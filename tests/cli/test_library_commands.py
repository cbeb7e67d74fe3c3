"""``hyperpaint paints``."""

import csv
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray as xr
from support.agreeing_spectra import NM, agreeing, field, library, seen, smooth
from support.commands import hyperpaint
from support.files import write_file
from support.flown_lines import fly, located
from support.refusals import expect_words

import hyperpaint as hp
from hyperpaint.io.dirsig import open_emissivity, read_materials
from hyperpaint.io.library import open_library
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS


def run(*arguments: object, status: int = 0) -> str:
    return hyperpaint("paints", *arguments, status=status).output


def test_it_lists_the_starter_library() -> None:
    told = run("--members", 0)
    assert told.startswith("40 of 40 paints, 272 bands\n")
    expect_words(told, "Synthetic Signal Red", "#831b2a")


def test_it_searches_saves_and_draws(tmp_path: Path) -> None:
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


# --- The command ``hyperpaint export`` ---

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
    assert "pass --overwrite" in export(store, "--format", "dirsig", "--out", out, status=2).output
    assert export(store, "--format", "dirsig", "--out", out, "--overwrite").exit_code == 0


def test_options_of_dirsig(store: Path, tmp_path: Path) -> None:
    out, more = tmp_path / "one", tmp_path / "two"
    export(
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
    export(store, "--format", "dirsig", "--out", more, "--scene-materials", out / "materials.mat")
    assert [material.id for material in read_materials(more / "materials.mat")] == [
        "Tuerkis_matt_2",
        "rot_blau_2",
    ]


@pytest.mark.parametrize(("form", "name"), [("envi", "p.sli"), ("csv", "p.csv"), ("zarr", "p.zarr")])
def test_libraries(form: str, name: str, store: Path, tmp_path: Path) -> None:
    assert "2 paints, 6 bands" in export(store, "--format", form, "--out", tmp_path / name, status=0).output
    assert sorted(open_library(tmp_path / name)["signature"].values.tolist()) == ["Türkis, matt", "rot/blau"]


def test_one_row_a_paint_or_all_of_them(store: Path, tmp_path: Path) -> None:
    # Expected: two paints with three members each are 2 rows, or 2 x (1 + 3)
    done = export(store, "--format", "csv", "--out", tmp_path / "p.csv")
    assert "one row a paint, its centre; --curves all also writes members" in done.output
    assert len((tmp_path / "p.csv").read_text("utf-8-sig").splitlines()) == 1 + 2
    done = export(store, "--format", "csv", "--out", tmp_path / "all.csv", "--curves", "all")
    assert "one row" not in done.output
    assert len((tmp_path / "all.csv").read_text("utf-8-sig").splitlines()) == 1 + 8


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
    np.testing.assert_allclose(again[:, 1:-1], open_library(store).member_reflectance[0], atol=1e-6)
    # to half a width of the outer bands of the camera, the curves are held
    np.testing.assert_allclose(again.wavelength[[0, -1]], [399.356 - 3.0, 1001.42 + 3.0], atol=0.01)
    np.testing.assert_array_equal(again[:, [0, -1]], again[:, [1, -2]])
    assert {path.name for path in (out / "maps").iterdir()} == {"Tuerkis_matt.pgm", "rot_blau.pgm"}


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        (("dirsig", "--specular", "0.1"), "would count twice"),
        (("dirsig", "--specular", "much"), "expected a number or 'library'"),
        (("dirsig", "--curves", "all"), "choice-unknown"),
        (("dirsig", "--scene", "scene.toml", "--specular", "0.1"), "--specular not with --scene"),
        (("csv", "--curves", "members"), "expected centre or all for csv"),
        (("csv", "--scene", "scene.toml"), "--scene only with --format dirsig"),
        *(
            ((form, "--gaps", "refuse"), "--gaps only with --format dirsig")
            for form in ("envi", "csv", "zarr")
        ),
        (("obj",), "'obj' is not one of"),
    ],
)
def test_exports_that_are_refused(
    words: tuple[str, ...], refusal: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    assert refusal in export(store, "--out", "refused", "--format", *words, status=2).output
    assert not Path("refused").exists()


def test_what_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_text("nothing")
    done = export(tmp_path / "x.txt", "--format", "dirsig", "--out", tmp_path / "out", status=2)
    assert done.output.startswith("error: ")
    assert not (tmp_path / "out").exists()


_EXPORTS = """
from click.testing import CliRunner
from hyperpaint.cli.program import main
for name, format, *more in (
    ("a.sli", "envi", "--curves", "all"), ("b.csv", "csv", "--curves", "all"),
    ("c.parquet", "parquet", "--curves", "all"), ("d", "dirsig"),
):
    words = ["export", source, "--format", format, "--out", f"{out}/{name}", *more]
    done = CliRunner().invoke(main, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
"""


def test_exports_are_the_same_bytes_in_every_process(store: Path, tmp_path: Path) -> None:
    # Rationale: xarray gathers coordinates from sets, whose order is another one in every process
    library = open_library(store)
    names = ("standard_error", "spread", "lower", "upper", "median")
    library = library.assign_coords(dict.fromkeys(names, library["reflectance"] / 9))
    library = library.assign_coords({f"note_{at}": ("paint", ["x", "y"]) for at in range(5)})
    hp.to_store(library, tmp_path / "many.zarr")
    contents = []
    for here in (True, False):
        out = tmp_path / f"out_{here}"
        out.mkdir()
        if here:
            exec(_EXPORTS, {"source": str(tmp_path / "many.zarr"), "out": str(out)})
        else:  # another order of sets: a seed other than that of this process
            names = f"source, out = {str(tmp_path / 'many.zarr')!r}, {str(out)!r}"
            seed = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
            command = [sys.executable, "-c", f"{names}\n{_EXPORTS}"]
            subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": seed}, check=True)
        files = (file for file in out.rglob("*") if file.is_file())
        contents.append({str(file.relative_to(out)): file.read_bytes() for file in files})
    first, second = contents
    assert len(first) > 10
    assert [name for name in first | second if first.get(name) != second.get(name)] == []


# --- `hyperpaint validate` ---


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A simulated collect, processed, with signatures of its solid paints by the commands themselves
    folder = tmp_path_factory.mktemp("lot")
    size = ("--scene", "plan", "--lines", 64, "--bands", 60, "--columns", 48, "--seed", 1, "--set", "glint=0")
    assert hyperpaint("simulate", folder / "raw", *size).exit_code == 0
    assert hyperpaint("process", folder / "raw" / "collect.toml", "--out", folder / "lot.zarr").exit_code == 0
    hp.write_regions(_painted(folder / "raw" / "truth.zarr", folder / "lot.zarr"), folder / "cars.geojson")
    # in a plan every pixel shows one surface
    words = ("--regions", folder / "cars.geojson", "--out", folder / "paints.zarr", "--keep", "mixed_edge")
    hyperpaint("signatures", folder / "lot.zarr", *words, status=0)
    return folder


def _painted(truth: Path, store: Path) -> hp.Regions:
    # Return a square of each of four paints in four by four pixels; each is compared with all references
    known = xr.open_zarr(truth)["surface"]
    surface = known.values[xr.open_zarr(store, group="flightlines/raw_0")["frame"].values]
    made = {}
    for number, name in enumerate(known.attrs["flag_meanings"].split()):
        if name not in CAR_PAINTS:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(surface == number, (4, 4)).all(axis=(2, 3))
        if windows.any():
            y, x = map(int, np.argwhere(windows)[0])
            made[name] = hp.Region(name, [(x, y), (x + 3, y), (x + 3, y + 3), (x, y + 3)], flightline="raw_0")
    assert len(made) >= 4
    return hp.Regions(tuple(made.values())[:4])


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    hp.to_store(agreeing()[0], tmp_path / "paints.zarr")
    return tmp_path / "paints.zarr"


@pytest.fixture
def references(tmp_path: Path) -> Path:
    # A text export of the field spectrometer, named as the paint
    spectrum = agreeing()[1]
    rows = zip(spectrum["wavelength"].values, spectrum["reflectance"].values[0], strict=True)
    folder = tmp_path / "asd"
    folder.mkdir()
    (folder / "hood.asd.txt").write_text(
        "Wavelength;hood.asd\n" + "".join(f"{nm:g}; {value:.8f}\n" for nm, value in rows)
    )
    return folder


# --- from the raw files to the table -----------------------------------------------------------------------


@pytest.mark.slow
def test_simulate_process_signatures_validate(lot: Path) -> None:
    done = hyperpaint("validate", lot / "paints.zarr", "--reference", lot / "raw/svc/*.sig", status=0)
    assert "pairs within tolerance (RMSE 0.005 + 5 % of the paint's level)" in done.stdout
    found = hp.validate(hp.open_store(lot / "paints.zarr"), hp.open_svc(lot / "raw" / "svc"))
    assert found.table() in done.stdout
    # what texture and noise leave of sixteen pixels
    assert float(found.statistics["rmse"].max()) < 0.012
    assert found.statistics["overlap"].values.tolist() == ["preserved"] * found.statistics.sizes["pair"]


def test_the_store_keeps_its_references(lot: Path, tmp_path: Path) -> None:
    assert hp.verify(lot / "lot.zarr").ok
    for group, opened in {
        "references/svc": hp.open_svc(lot / "raw" / "svc"),
        "references/asd": hp.open_asd(lot / "raw" / "asd_reflectance"),
    }.items():
        kept = hp.open_store(lot / "lot.zarr", group)
        for name in ("reflectance", "wavelength", "time", "source"):
            np.testing.assert_array_equal(kept[name].values, opened[name].values)
        assert kept["reflectance"].attrs["units"] == "1"
    # the store of a library is where its references are looked for
    words = {"t.csv": (), "t.json": ("--reference", lot / "lot.zarr")}
    tables = [
        hyperpaint("validate", lot / "paints.zarr", *more, "--out", tmp_path / name, status=0).stdout
        for name, more in words.items()
    ]
    assert tables[0].replace("t.csv", "t.json") == tables[1]
    expect_words(tables[0], "(SVC)", "(ASD)", "references against one another")
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert ({row["instrument"] for row in rows}, {row["passes"] for row in rows}) == (
        {"ASD", "SVC", "ASD against SVC"},
        {"True"},
    )
    document = json.loads((tmp_path / "t.json").read_text())
    assert (len(document["references_against_one_another"]), document["units"]["spectral_angle"]) == (
        len(document["pairs"]) // 2,
        "degree",
    )


def test_a_wrong_gain_fails(lot: Path, tmp_path: Path) -> None:
    paints = hp.open_store(lot / "paints.zarr").load().drop_encoding()
    bright = paints.assign(reflectance=(paints["reflectance"] * np.float32(1.1)).assign_attrs(units="1"))
    hp.to_store(bright, tmp_path / "bright.zarr")
    words = ("validate", tmp_path / "bright.zarr", "--reference", lot / "raw/svc/*.sig")
    assert "not passed: " in hyperpaint(*words, status=1).stderr
    assert hyperpaint(*words, "--tolerance", "spectral_angle=1.7", "--tolerance", "scale=0.12").exit_code == 0


# --- options -----------------------------------------------------------------------------------------------


def test_options_reach_the_function(stored: Path, references: Path, tmp_path: Path) -> None:
    panel = write_file(tmp_path / "panel.csv", "Diffuse target\nnm;R\n300;0.9\n2500;0.9\n")
    pairs = write_file(tmp_path / "pairs.json", '{"hood": ["hood"]}')
    words = ("--panel", panel, "--pairs", pairs, "--part", "red=620-700", "--part", "blue=420-480.5")
    more = ("--tolerance", "0.5", "--reference-fwhm", 3, "--picture", tmp_path / "p.png")
    out = tmp_path / "t.json"
    hyperpaint("validate", stored, "--reference", references, *words, *more, "--out", out, status=0)
    made = json.loads(out.read_text())
    assert (made["parts"], made["tolerance"]) == (
        {"red": [620.0, 700.0], "blue": [420.0, 480.5]},
        {"rmse": 0.5},
    )
    assert made["passed"] is True
    assert made["pairs"][0]["parts"]["red"]["scale"] == pytest.approx(1 / 0.9, rel=1e-3)
    assert made["pairs"][0]["parts"]["red"]["rmse_u"] is None
    assert "widths of channels 3 nm, as given" in made["pairs"][0]["notes"]
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_tables_hold_all_digits(stored: Path, references: Path, tmp_path: Path) -> None:
    out = tmp_path / "agreement.csv"
    assert (
        hyperpaint("validate", stored, "--reference", references / "hood.asd.txt", "--out", out).exit_code
        == 0
    )
    found = hp.validate(agreeing()[0], hp.open_asd(references, "reflectance"))
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["part"] for row in rows] == ["VIS", "NIR", "all"]
    for column, row in enumerate(rows):
        assert (float(row["rmse"]), row["rmse_u"], int(row["bands"])) == (
            found.statistics["rmse"].values[0, column],
            "",
            found.statistics["bands"].values[0, column],
        )
    refused = hyperpaint("validate", stored, "--reference", references, "--out", out, status=2)
    assert "pass --overwrite to replace it" in refused.stderr
    assert (
        hyperpaint("validate", stored, "--reference", references, "--out", out, "--overwrite").exit_code == 0
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agreement.csv", "asd", "paints.zarr"]


def test_a_library_is_a_reference(stored: Path, tmp_path: Path) -> None:
    hp.to_store(library(1.01 * seen(NM, 6.0)), tmp_path / "other.zarr")
    done = hyperpaint("validate", stored, "--reference", tmp_path / "other.zarr", status=0)
    assert "(library)" in done.stdout


def test_a_library_of_another_program_is_a_reference_too(stored: Path, tmp_path: Path) -> None:
    path = tmp_path / "hood.csv"
    nm = np.arange(380.0, 1021.0)
    rows = "".join(f"{at:g},{100 * value:.6f}\n" for at, value in zip(nm, seen(nm, 3.0), strict=True))
    path.write_text("wavelength (nm),reflectance (%)\n" + rows)
    hyperpaint("validate", stored, "--reference", path, "--reference-fwhm", 3, "--tolerance", 1e-4, status=0)


def test_files_of_different_wavelengths_are_opened_apart(stored: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for name, step in (("hood", 1.0), ("roof", 2.0)):
        nm = np.arange(380.0, 1021.0, step)
        rows = "".join(f"{at:g};{value:.8f}\n" for at, value in zip(nm, smooth(nm), strict=True))
        (folder / f"{name}.txt").write_text(f"Wavelength;{name}.asd\n{rows}")
    done = hyperpaint("validate", stored, "--reference", folder / "*.txt", status=0)
    assert "references without a paint: roof" in done.stdout


def test_bad_calls_are_one_message(stored: Path, references: Path, tmp_path: Path) -> None:
    poem = write_file(tmp_path / "poem.txt", "Shall I compare thee\nto a summer's day\n")
    reference = ("--reference", references)
    for words, told in {
        (stored,): "pass files with --reference",
        (stored, "--reference", tmp_path / "no*.sig"): "no spectra found",
        (stored, "--reference", poem): "poem.txt",
        (stored, *reference, "--pairs", poem): "as a list of paints",
        (stored, *reference, "--panel", poem): "used as a spectrum",
        (stored, *reference, "--tolerance", "much"): "'much', expected a number of RMSE",
        (stored, *reference, "--tolerance", "colour=1"): "statistic='colour', expected one of",
        (stored, *reference, "--part", "red"): "part-unreadable",
        (stored, *reference, "--part", "=400-500"): "part-unreadable",
        (stored, *reference, "--out", tmp_path / "t.xlsx"): "suffix-unknown",
        (stored, *reference, "--out", tmp_path / "none" / "t.csv"): "folder-missing",
        (stored, *reference, "--picture", tmp_path / "p.nothing"): "suffix-unknown",
        (poem, *reference): "poem.txt",
        (tmp_path / "none.zarr", *reference): "does not exist",
    }.items():
        done = hyperpaint("validate", *words, status=2)
        assert told in done.stderr, (told, done.stderr)
        assert "Traceback" not in done.output
    assert not list(tmp_path.glob("t.*"))


def test_a_store_named_inside_a_library_is_looked_for_beside_it_only(tmp_path: Path) -> None:
    for name in ("../elsewhere.zarr", "/etc", "", ".."):
        hp.to_store(agreeing()[0].assign_attrs(store=name), tmp_path / "p.zarr", overwrite=True)
        (tmp_path / "references").mkdir(exist_ok=True)
        assert "pass files with --reference" in hyperpaint("validate", tmp_path / "p.zarr").stderr


def test_numbers_that_are_none_make_valid_json(tmp_path: Path) -> None:
    from hyperpaint.workflows.field_day import write_table

    paints, reference = agreeing()
    found = hp.validate(paints.isel(band=slice(0, 9)), field(reference["reflectance"].values))
    write_table(found, tmp_path / "t.json")
    made = json.loads((tmp_path / "t.json").read_text(), parse_constant=pytest.fail)
    assert made["pairs"][0]["parts"]["NIR"]["rmse"] is None
    assert made["parts"]["all"] == [0.0, None]


def test_messages_name_options_and_say_things_once(stored: Path, references: Path, tmp_path: Path) -> None:
    (references / "hood.asd.txt").rename(references / "door.asd.txt")
    done = hyperpaint("validate", stored, "--reference", references, status=2)
    assert "name them with --pairs, or give regions a property reference" in done.stderr
    done = hyperpaint("validate", stored, "--reference", tmp_path / "none.sig", status=2)
    assert done.stderr.count("references cannot be opened") == 1
    assert "none.sig: cannot be read" in done.stderr


def test_a_wrong_picture_is_refused_before_the_work(
    stored: Path, references: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(*_: object, **__: object) -> None:
        pytest.fail("the work was done first")

    monkeypatch.setattr("hyperpaint.workflows.field_day.validate_files", work)
    done = hyperpaint(
        "validate", stored, "--reference", references, "--picture", tmp_path / "p.nope", status=2
    )
    assert "suffix-unknown" in done.stderr


def test_what_is_not_judged_or_missing_is_exit_1(stored: Path, references: Path, tmp_path: Path) -> None:
    words = ("validate", stored, "--reference", references)
    assert hyperpaint(*words, "--require-all").exit_code == 0
    empty = hyperpaint(*words, "--part", "SWIR=1500-1700", status=1)
    assert "not passed: hood against hood of ASD: SWIR (0 of 0 bands, too few to judge)" in empty.stderr
    hp.to_store(library([seen(NM, 6.0)] * 2, ("hood", "roof")), tmp_path / "two.zarr")
    more = ("validate", tmp_path / "two.zarr", "--reference", references)
    assert hyperpaint(*more).exit_code == 0
    missing = hyperpaint(*more, "--require-all", status=1)
    assert "not passed: roof: its reference is missing" in missing.stderr
    assert "1 of 2 paints compared" in missing.stdout


# --- A map from the command line ---


def mapped(path: Path, count: int) -> Path:
    # Store flight lines that cross each other at right angles; the second looks down more steeply
    lines = {}
    for number in range(count):
        flown = fly(40, 20, "calm", heading=30.0 + 90.0 * number, seed=number)
        values = np.random.default_rng(number).random((40, 6, 20)).astype(np.float32)
        line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
        zenith = (("along_track", "cross_track"), np.full((40, 20), 5.0 - number), {"units": "degree"})
        wavelength = ("band", np.linspace(450.0, 700.0, 6), {"units": "nm"})
        lines[f"/flightlines/raw_{number}"] = line.assign_coords(wavelength=wavelength, view_zenith=zenith)
    return hp.to_store(xr.DataTree.from_dict(lines), path)


@pytest.fixture
def map_store(tmp_path: Path) -> Path:
    return mapped(tmp_path / "lot.zarr", 1)


def test_a_map_as_store_and_as_geotiff(map_store: Path) -> None:
    hyperpaint("orthorectify", map_store, "--out", map_store.parent / "map.zarr", "--quiet", status=0)
    made = xr.open_zarr(map_store.parent / "map.zarr")
    assert {"reflectance", "quality", "line_time", "glt_line", "hits", "gap"} <= set(made.variables)
    hyperpaint(
        "orthorectify", map_store, "--gsd", "0.01", "--out", map_store.parent / "map.tif", "--quiet", status=0
    )
    with rasterio.open(map_store.parent / "map.tif") as picture:
        assert (picture.count, picture.crs.to_epsg(), picture.transform.b) == (6, 32617, 0.0)


def test_what_is_wrong_is_said(map_store: Path) -> None:
    inside = (map_store, map_store / "map.tif", map_store / "flightlines" / "map.zarr")
    for options, refusal in (
        (("--out", "map.png"), "ends in .tif, .tiff or .zarr"),
        (("--line", "raw_9", "--out", "map.zarr"), "no flight line 'raw_9'"),
        *((("--out", place, "--overwrite"), "in the store itself") for place in inside),
    ):
        assert refusal in hyperpaint("orthorectify", map_store, *options, status=2).output
    assert hp.verify(map_store).ok


# rioxarray multiplies transforms the old way
_OLD_TRANSFORMS = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")
MOUNTED = (0.34, -0.95, -0.13)
SETTINGS = ("focal_length_mm=12", "pixel_pitch_um=7.4", "column_order=left_to_right")
CAMERA = tuple(word for setting in SETTINGS for word in ("--set", setting))
BORESIGHT = ("--set", f"boresight={','.join(map(str, MOUNTED))}")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return the folder of a simulated collect over a level checkerboard, with its DEM, after processing
    folder = tmp_path_factory.mktemp("board")
    collect = hp.simulate_collect(
        folder / "collect", lines=32, bands=4, columns=24, scene="checkerboard", boresight=MOUNTED
    )
    hyperpaint("process", collect, "--out", folder / "lot.zarr", "--quiet", status=0)
    truth = xr.open_zarr(folder / "collect" / "truth.zarr")
    corner = float(truth.east.min()) - 5.0, float(truth.north.max()) + 5.0
    size = int(max(np.ptp(truth.east.values), np.ptp(truth.north.values)) + 10.0) + 2
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "float32"}
    where = rasterio.Affine(1.0, 0.0, corner[0], 0.0, -1.0, corner[1])
    with rasterio.open(
        folder / "dem.tif", "w", crs=truth.attrs["crs"], transform=where, nodata=-9999.0, **profile
    ) as dem:
        heights = np.full((size, size), truth.attrs["ground"], np.float32)
        heights[0, 0] = -9999.0
        dem.write(heights, 1)
    return folder


def shift(board: Path, *options: str) -> float:
    # Return how far the pixel of a cell truly lies from it, as the median [cell]
    out = board / "map.zarr"
    call = ["orthorectify", str(board / "lot.zarr"), *options, "--grid", "flight", "--out", str(out)]
    call += ["--quiet", "--overwrite"]
    hyperpaint(*call, status=0)
    with xr.open_zarr(out) as made, xr.open_zarr(board / "collect" / "truth.zarr") as truth:
        line, sample = made.nearest_line.values, made.nearest_sample.values
        shown = line >= 0
        assert shown.mean() > 0.3
        assert np.isfinite(made.reflectance.values[shown]).any()
        pixel = line[shown], sample[shown]
        off = (made[name].values[shown] - truth[name].values[pixel] for name in ("east", "north"))
        return float(np.median(np.hypot(*off)) / made.attrs["gsd"])


@_OLD_TRANSFORMS
@pytest.mark.slow
def test_a_camera_a_dem_and_a_boresight_put_pixels_in_their_place(board: Path) -> None:
    dem = ("--dem", str(board / "dem.tif"), "--set", "dem_heights=ellipsoid")
    level = ("--ground", str(xr.open_zarr(board / "collect" / "truth.zarr").attrs["ground"]))
    for ground in (dem, level):
        assert shift(board, *ground, *CAMERA, *BORESIGHT) < 1.0
    assert shift(board, *level, *CAMERA) < 1.0  # the mounting that the collect declares
    assert shift(board, *level, *CAMERA, "--set", "boresight=0,0,0") > 5.0


@_OLD_TRANSFORMS
def test_a_dem_whose_heights_are_above_nothing(board: Path) -> None:
    call = ["orthorectify", str(board / "lot.zarr"), "--dem", str(board / "dem.tif"), *CAMERA]
    assert "dem_heights" in hyperpaint(*call, "--out", board / "none.zarr", "--quiet", status=2).output
    assert not (board / "none.zarr").exists()


def test_a_line_that_declares_no_signs_is_not_guessed_at(board: Path, tmp_path: Path) -> None:
    line = hp.open_store(board / "lot.zarr", "flightlines/raw_0")
    line.attrs = {name: value for name, value in line.attrs.items() if not name.startswith("convention_")}
    hp.to_store(xr.DataTree.from_dict({"/flightlines/raw_0": line}), tmp_path / "bare.zarr")
    call = ["orthorectify", str(tmp_path / "bare.zarr"), "--ground", "0", *CAMERA, "--quiet"]
    done = hyperpaint(*call, "--out", tmp_path / "map.zarr", status=2)
    expect_words(done.output, "roll_positive", "[navigation]")
    assert not (tmp_path / "map.zarr").exists()


def test_a_store_of_one_nameless_line_has_no_line_of_a_name(map_store: Path, tmp_path: Path) -> None:
    hp.to_store(hp.open_store(map_store, "flightlines/raw_0"), tmp_path / "one.zarr")
    call = ["orthorectify", str(tmp_path / "one.zarr"), "--out", str(tmp_path / "map.zarr"), "--quiet"]
    assert "no flight line 'nope'" in hyperpaint(*call, "--line", "nope", status=2).output
    assert hyperpaint(*call).exit_code == 0


# --- A mosaic from the command line ---


@pytest.fixture
def store_mosaic(tmp_path: Path) -> Path:
    return mapped(tmp_path / "lot.zarr", 2)


def test_a_mosaic_as_store_and_as_geotiff(store_mosaic: Path) -> None:
    folder = store_mosaic.parent
    done = hyperpaint("mosaic", store_mosaic, "--out", folder / "both.zarr", "--quiet", status=0)
    assert "raw_0, raw_1" in done.output
    made = xr.open_zarr(folder / "both.zarr")
    assert {"reflectance", "quality", "flightline", "line_time", "view_zenith", "gap"} <= set(made.variables)
    # the second looks down more steeply
    assert float((made.flightline == 1).sum()) > float((made.flightline == 0).sum()) > 0
    options = ["--rule", "newest", "--gsd", "0.01", "--seamlines", str(folder / "seams.geojson"), "--quiet"]
    done = hyperpaint("mosaic", store_mosaic, "--out", folder / "both.tif", *options, status=0)
    with rasterio.open(folder / "both.tif") as picture:
        assert (picture.count, picture.crs.to_epsg()) == (6, 32617)
    assert len(json.loads((folder / "seams.geojson").read_text())["features"]) == 2


def test_what_is_wrong_is_said_mosaic(store_mosaic: Path) -> None:
    for options, reason in (
        (["--out", "map.png"], "ends in .tif, .tiff or .zarr"),
        (["--line", "raw_9", "--out", "map.zarr"], "no raw_9"),
        (["--out", str(store_mosaic), "--overwrite"], "in the store itself"),
        (["--out", str(store_mosaic / "map.tif")], "in the store itself"),
        (
            ["--out", "map.tif", "--seamlines", str(store_mosaic / "zarr.json"), "--overwrite"],
            "in the store itself",
        ),
        (["--out", str(store_mosaic.parent), "--overwrite"], "ends in .tif, .tiff or .zarr"),
    ):
        assert reason in hyperpaint("mosaic", store_mosaic, *options, status=2).output
