"""A library against its specification: planted faults are found by their rules, right libraries pass."""

import itertools
import json
import sys
import warnings
import zipfile
from functools import partial
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from click.testing import CliRunner
from support.library_examples import declared_library
from support.refusals import expect_error, expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.base.old_names import with_new_names
from hyperpaint.cli.program import main
from hyperpaint.io.library.library_formats import TERMS

ROOT = Path(__file__).resolve().parents[3]
SCHEMA = json.loads((ROOT / "docs" / "paint-library.schema.json").read_text(encoding="utf-8"))
PAGE = (ROOT / "docs" / "paint-library.md").read_text(encoding="utf-8")


@pytest.fixture
def library() -> xr.Dataset:
    return declared_library()


def changed(name: str, change):
    def fault(library: xr.Dataset) -> xr.Dataset:
        array = library[name]
        return (
            library.assign_coords({name: change(array)})
            if name in library.coords
            else library.assign({name: change(array)})
        )

    return fault


def with_units(units):
    return lambda array: array.assign_attrs(units=units)


def poked(value):
    def change(array: xr.DataArray) -> xr.DataArray:
        values = array.values.copy()
        values.flat[1] = value
        return array.copy(data=values)

    return change


def attr(**attrs):
    return lambda library: library.assign_attrs(attrs)


def without(*names):
    def fault(library: xr.Dataset) -> xr.Dataset:
        kept = library.drop_vars([name for name in names if name in library.variables])
        kept.attrs = {key: value for key, value in library.attrs.items() if key not in names}
        return kept

    return fault


FAULTS = {
    "no reflectance": ("structure", without("reflectance")),
    "no wavelengths": ("structure", without("wavelength")),
    "spread on bands alone": (
        "dims",
        lambda lib: lib.assign(reflectance_sd=lib.reflectance_sd.mean("signature")),
    ),
    "name twice": ("paint-names", lambda lib: lib.assign_coords(signature=["red", "red", "black"])),
    "name empty": ("paint-names", lambda lib: lib.assign_coords(signature=["red", " ", "black"])),
    "micrometres": ("wavelength-units", changed("wavelength", with_units("um"))),
    "micrometres by value": (
        "wavelength-range",
        changed("wavelength", lambda a: (a / 1e3).assign_attrs(units="nm")),
    ),
    "wavelength twice": (
        "wavelength-order",
        changed("wavelength", lambda a: a.copy(data=np.sort(poked(400.0)(a).values))),
    ),
    "wavelengths turn back": ("wavelength-order", changed("wavelength", poked(900.0))),
    "width of nothing": ("fwhm", changed("fwhm", poked(-6.0))),
    "good as text": ("good", changed("good", lambda a: a.astype(int))),
    "percent": ("reflectance-range", changed("reflectance", lambda a: (100 * a).assign_attrs(units="1"))),
    "percent by unit": ("reflectance-units", changed("reflectance", with_units("%"))),
    "counts": (
        "reflectance-dtype",
        changed("reflectance", lambda a: (1e4 * a).astype("uint16").assign_attrs(units="1")),
    ),
    "marks of missing values": ("reflectance-range", changed("reflectance", poked(-9999.0))),
    "empty paint": (
        "reflectance-empty",
        changed("reflectance", lambda a: a.where(a["signature"] != "blue").assign_attrs(units="1")),
    ),
    "negative spread": ("uncertainty-sign", changed("reflectance_sd", poked(-0.1))),
    "spread in percent": ("uncertainty-units", changed("reflectance_u_random", with_units("%"))),
    "no uncertainty": ("uncertainty", without("reflectance_sd", "reflectance_u_random")),
    "quantiles cross": (
        "quantiles",
        changed("reflectance_quantiles", lambda a: a.copy(data=a.values[:, ::-1])),
    ),
    "quantiles beyond one": ("quantiles", lambda lib: lib.assign_coords(quantile=[0.05, 0.5, 95.0])),
    "no pixels": ("n", changed("n", poked(0))),
    "more independent pixels than pixels": ("n", changed("n_eff", poked(1000.0))),
    "members without values": (
        "members",
        changed("member_reflectance", lambda a: a.where(False).assign_attrs(units="1")),
    ),
    "sun below ground": ("angles", changed("sun_zenith", poked(120.0))),
    "sun in radians": ("angles", changed("sun_zenith", with_units("rad"))),
    "time as text": ("time", lambda lib: lib.assign_coords(time=("signature", ["noon"] * 3))),
    "diffuse in percent": ("diffuse-fraction", changed("diffuse_fraction", poked(20.0))),
    "no version": ("version", without("paint_library_version")),
    "no title": ("title", attr(title="")),
    "no quantity": ("quantity", without("quantity")),
    "another quantity": ("quantity", attr(quantity="albedo")),
    "no specular component": ("specular_component", without("specular_component")),
    "no geometry": ("measurement_geometry", without("measurement_geometry")),
    "finish of none": (
        "finish",
        lambda lib: lib.assign_coords(finish=("signature", ["solid", "glittery", "pearl"])),
    ),
    "no provenance": ("provenance", without("provenance")),
    "no licence": ("licence", without("licence")),
    "SCI without the mirror image": (
        "contradiction",
        attr(quantity="8/d SCI", specular_component="excluded"),
    ),
}


def test_a_right_library_passes(library):
    assert (
        str(hp.io.check_library(library)) == "the library: 3 paints, 24 bands: a paint library of version 2"
    )


@pytest.mark.parametrize("name", FAULTS)
def test_planted_faults_are_found_by_their_rule(library, name):
    rule, fault = FAULTS[name]
    report = hp.io.check_library(fault(library))
    assert rule in {finding.rule for finding in report.findings}, str(report)
    assert rule in str(report)
    # nothing is accused beside it
    assert len({finding.rule for finding in report.findings}) <= 2, str(report)


def test_rules_stand_in_the_page(library):
    assert all(f"`{rule}`" in PAGE for rule in {rule for rule, _ in FAULTS.values()})
    assert all(f"`{word}`" in PAGE for _, words, _ in TERMS for word in words)


def test_signatures_and_the_starter_library_say_what_is_asked_for():
    starter = hp.paints.starter_library(members=2)
    assert not hp.io.check_library(starter).ok
    assert hp.io.check_library(hp.io.declare_library(starter, licence="CC0-1.0")).ok


def test_a_word_that_is_none_is_refused(library):
    expect_refusals(
        (hp.SchemaError, "choice-unknown", lambda: hp.io.declare_library(library, color="red")),
        (hp.SchemaError, "choice-unknown", lambda: hp.io.declare_library(library, quantity="albedo")),
    )


@pytest.mark.parametrize("suffix", ["csv", "sli", "parquet"])
def test_metadata_pass_the_schema_and_libraries_come_back(library, tmp_path, suffix):
    path = hp.write_library(library, tmp_path / f"paints.{suffix}", curves="all")
    jsonschema.validate(json.loads(path.with_name(f"{path.name}.json").read_text(encoding="utf-8")), SCHEMA)
    xr.testing.assert_identical(hp.open_library(path), library)
    assert hp.io.check_library(path).ok


def test_metadata_that_lack_a_term_fail_the_schema(library, tmp_path):
    for name, *_ in TERMS:
        path = hp.write_library(without(name)(library), tmp_path / f"{name}.csv")
        expect_error(
            jsonschema.ValidationError,
            None,
            partial(jsonschema.validate, json.loads(path.with_name(f"{path.name}.json").read_text()), SCHEMA),
        )
    words = {name: list(allowed) for name, allowed, _ in TERMS if allowed}
    of_schema = SCHEMA["$defs"]["attrs"]["properties"]
    assert {name: of_schema[name]["enum"] for name in words} == words


def test_command(library, tmp_path):
    path = hp.write_library(library, tmp_path / "paints.csv")
    result = CliRunner().invoke(main, ["check-library", str(path)])
    assert (result.exit_code, "uncertainty" in result.output) == (1, True)  # a table of centres has no spread
    hp.write_library(library, path, curves="all", overwrite=True)
    assert CliRunner().invoke(main, ["check-library", str(path)]).exit_code == 0
    (tmp_path / "none.csv").write_text("a,b\n")
    assert CliRunner().invoke(main, ["check-library", str(tmp_path / "none.csv")]).exit_code == 2


# --- libraries of hyperpaint 0.2 and before, whose dimension was `paint`

FILES = ("paints.csv", "paints.sli", "paints.parquet", "paints.zarr")


@pytest.fixture
def released(tmp_path: Path) -> Path:
    with zipfile.ZipFile(Path(__file__).with_name("released") / "version_1.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path


@pytest.fixture
def library_released() -> xr.Dataset:
    return declared_library(bands=6)


def old(library_released: xr.Dataset) -> xr.Dataset:
    # Return a library as a session of hyperpaint 0.2 held it.
    return library_released.rename(signature="paint").assign_attrs(paint_library_version=1)


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_0_2_is_todays_library(released: Path, library_released: xr.Dataset, name: str) -> None:
    with pytest.warns(PaintWarning, match="'paint'.*'signature'") as caught:
        opened = hp.open_library(released / name)
    assert len(caught) == 1
    xr.testing.assert_equal(opened.load(), library_released)
    assert opened.attrs["paint_library_version"] == 2
    assert "signature" in opened.indexes
    with pytest.warns(PaintWarning, match="'signature'"):
        assert hp.io.check_library(released / name).ok
    xr.testing.assert_equal(
        hp.open_library(hp.write_library(opened, released / "again" / name, curves="all")).load(),
        library_released,
    )


@pytest.mark.parametrize("name", FILES[:3])
def test_metadata_of_version_2_are_read(tmp_path: Path, library_released: xr.Dataset, name: str) -> None:
    with zipfile.ZipFile(Path(__file__).with_name("released") / "version_2.zip") as archive:
        archive.extractall(tmp_path)
    xr.testing.assert_identical(hp.open_library(tmp_path / name), library_released)


def test_a_table_of_0_2_without_its_metadata_opens(released: Path) -> None:
    (released / "paints.csv.json").unlink()
    with pytest.warns(PaintWarning, match="is missing"):
        opened = hp.open_library(released / "paints.csv")
    assert opened["signature"].values.tolist() == ["red", "blue", "black"]


def test_a_netcdf_of_0_2_is_taken_by_functions(released: Path, library_released: xr.Dataset) -> None:
    pytest.importorskip("netCDF4")
    with xr.open_dataset(released / "paints.nc") as opened, pytest.warns(PaintWarning, match="'signature'"):
        path = hp.write_library(opened, released / "new.zarr")
    xr.testing.assert_equal(hp.open_library(path).load(), library_released)


def test_a_library_of_an_old_session_is_taken_everywhere(
    library_released: xr.Dataset, tmp_path: Path
) -> None:
    jobs = {
        "validate": lambda lib: hp.validate(lib, lib).statistics["signature"].values.tolist(),
        "dirsig": lambda lib: hp.write_dirsig(lib, tmp_path / str("paint" in lib.dims))[
            "signature"
        ].values.tolist(),
        "search": lambda lib: hp.paints.search_library(lib, name="red")["signature"].values.tolist(),
        "colours": lambda lib: hp.paints.paint_colours(lib).tolist(),
        "sample": lambda lib: hp.paints.sample_paints(lib, 3)["signature"].values.tolist(),
        "mix": lambda lib: hp.paints.shade_paints(lib, [0.5])["signature"].values.tolist(),
        "check": lambda lib: hp.io.check_library(lib).ok,
        "declare": lambda lib: dict(hp.io.declare_library(lib).sizes),
        "summary": lambda lib: "3 paints" in repr(lib.paint),
        "figure": lambda lib: len(lib.paint.spectrum().lines),
    }
    for name, job in jobs.items():
        with pytest.warns(PaintWarning, match="'signature'"):
            found = job(old(library_released))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PaintWarning)
            assert found == job(library_released), name


def test_only_libraries_are_renamed(library_released: xr.Dataset) -> None:
    for dataset in (
        xr.Dataset({"reflectance": (("paint", "band", "cross_track"), np.zeros((1, 2, 3)))}),
        xr.Dataset({"reflectance": ("x", [1.0])}, {"paint": ("x", ["red"])}),
        library_released,
        xr.Dataset({"paint": ("paint", [1])}),
    ):
        assert with_new_names(dataset) is dataset
    with pytest.warns(PaintWarning):
        one = with_new_names(old(library_released).isel(paint=0))
    assert one["signature"].item() == "red"
    with pytest.warns(PaintWarning):
        spectra = with_new_names(old(library_released)["reflectance"])
    assert spectra.dims == ("signature", "band")


def test_a_property_called_signature_keeps_its_values(library_released: xr.Dataset) -> None:
    mine = old(library_released).assign_coords(signature=("paint", ["a", "b", "c"]))
    with pytest.warns(PaintWarning):
        renamed = with_new_names(mine)
    assert renamed["signature"].values.tolist() == ["red", "blue", "black"]
    assert renamed["paint"].values.tolist() == ["a", "b", "c"]
    assert "signature" in renamed.indexes


@pytest.mark.parametrize(
    ("part", "damage"),
    [
        *itertools.product(("spectra", "variables", "attrs", "sizes"), (None, 3, [1])),
        *itertools.product(("spectra", "variables"), ({"paint": 3}, {"paint": {"dims": [1, "paint"]}})),
    ],
)
def test_damaged_metadata_of_0_2_are_refused(released: Path, part: str, damage: object) -> None:
    file = released / "paints.csv.json"
    file.write_text(
        json.dumps({**json.loads(file.read_text(encoding="utf-8")), part: damage}), encoding="utf-8"
    )
    with pytest.warns(PaintWarning, match="'signature'"), pytest.raises(FormatError):
        hp.open_library(released / "paints.csv")


@pytest.mark.parametrize("curves", ["centre", "all"])
def test_our_table_comes_back_through_pandas_with_its_index(
    library_released: xr.Dataset, tmp_path: Path, curves: str
) -> None:
    path = hp.write_library(library_released, tmp_path / "own.csv", curves=curves)
    pd.read_csv(path).to_csv(tmp_path / "index.csv")
    with pytest.warns(PaintWarning, match="is missing"):
        opened = hp.open_library(tmp_path / "index.csv")
    assert opened["signature"].values.tolist() == ["red", "blue", "black"]
    np.testing.assert_array_equal(opened["reflectance"], library_released["reflectance"])
    pd.read_csv(path).iloc[::-1].to_csv(tmp_path / "turned.csv")
    expect_errors((FormatError, "column-name-missing", lambda: hp.open_library(tmp_path / "turned.csv")))


# --- conformance files: right ones, one a format, and faulty ones that name their rule ---------------------

# Whoever writes another reader or checker tries it on them. They change with the version of the specification
# alone: what is written today has their bytes. ``python`` and the path of this file wrote them.


sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # where this is run as a script


EXAMPLES = Path(__file__).with_name("conformance")
WHOLE = ("three_paints.csv", "three_paints.sli", "three_paints.parquet")  # nothing is lost
#: What is put into the attributes of the library; every rule finds its own.
FAULTY = {
    "version": {"paint_library_version": None},
    "title": {"title": ""},
    "quantity": {"quantity": "albedo"},
    "specular_component": {"specular_component": "perhaps"},
    "measurement_geometry": {"measurement_geometry": None},
    "provenance": {"provenance": "bought"},
    "licence": {"licence": None},
    "contradiction": {"quantity": "8/d SCI", "specular_component": "excluded"},
}


def write(folder: Path) -> None:
    library = declared_library(bands=6)
    for name in WHOLE:
        hp.write_library(library, folder / name, curves="all")
    (folder / "faulty").mkdir()
    for rule, words in FAULTY.items():
        attrs = {key: word for key, word in {**library.attrs, **words}.items() if word is not None}
        faulty = library.copy()
        faulty.attrs = attrs
        hp.write_library(faulty, folder / "faulty" / f"{rule}.csv", curves="all")


@pytest.mark.parametrize("name", WHOLE)
def test_right_files_are_one_library(name: str) -> None:
    xr.testing.assert_identical(hp.open_library(EXAMPLES / name), declared_library(bands=6))
    assert hp.io.check_library(EXAMPLES / name).ok


def test_texts_of_0_2_open() -> None:
    # Rationale: hyperpaint 0.2 wrote these texts in the format of the ECOSTRESS library.
    library, back = (
        declared_library(bands=6),
        hp.open_library(sorted((EXAMPLES / "ecostress").glob("*.txt"))),
    )
    np.testing.assert_allclose(
        back.reflectance, library.reflectance.sel(signature=back["signature"].values), rtol=1e-6
    )


@pytest.mark.parametrize("rule", FAULTY)
def test_faulty_files_are_found_by_their_rule(rule: str) -> None:
    report = hp.io.check_library(EXAMPLES / "faulty" / f"{rule}.csv")
    assert {finding.rule for finding in report.findings} == {rule}, str(report)


def test_what_is_written_today_has_their_bytes(tmp_path: Path) -> None:
    write(tmp_path)
    stored = {path.relative_to(EXAMPLES) for path in EXAMPLES.rglob("*") if path.is_file()}
    stored -= {path for path in stored if path.parts[0] == "ecostress"}
    assert {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()} == stored
    for name in sorted(stored):
        if name.suffix != ".parquet":  # its bytes are those of pyarrow's version
            assert (tmp_path / name).read_bytes() == (EXAMPLES / name).read_bytes(), name
    assert json.loads((EXAMPLES / "three_paints.csv.json").read_text(encoding="utf-8"))


if __name__ == "__main__":
    EXAMPLES.mkdir()
    write(EXAMPLES)
