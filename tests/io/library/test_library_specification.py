"""A library against its specification: planted faults are found by their rules, right libraries pass."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.library_examples import declared_library
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.cli.program import main
from hyperpaint.io.library.specification import TERMS

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
    assert all(f"`{word}`" in PAGE for term in TERMS for word in term.words)


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
    for term in TERMS:
        path = hp.write_library(without(term.name)(library), tmp_path / f"{term.name}.csv")
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(json.loads(path.with_name(f"{path.name}.json").read_text()), SCHEMA)
    words = {term.name: list(term.words) for term in TERMS if term.words}
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
