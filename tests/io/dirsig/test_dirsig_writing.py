"""Materials for DIRSIG, judged by a parser that shares nothing with the package."""

import contextlib
import json
import re
import subprocess
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ET
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from oracles.fresnel import plain_fresnel
from support.dirsig_exports import BANDS, NM, library, specular_fraction, strict_ems
from support.files import write_file
from support.folders import contents
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, StoreError
from hyperpaint.io.dirsig import (
    Section,
    materials_text,
    open_emissivity,
    read_emissivity,
    read_materials,
    write_dirsig_scene,
)
from hyperpaint.io.dirsig.dirsig_files import ColumnText, material_ids, material_names, plain_name
from hyperpaint.io.dirsig.dirsig_writing import texture_picture
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Coat, Material, fresnel_reflectance
from hyperpaint.simulation.rendering.mesh_files import parse_obj
from hyperpaint.simulation.rendering.scene import Instance, Scene
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of


def test_every_member_is_a_curve(tmp_path: Path) -> None:
    paints = library()
    done: list[tuple[int, int]] = []
    made = hp.write_dirsig(paints, tmp_path / "out", progress=lambda *step: done.append(step))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    for number in range(3):
        weights, micrometres, emissivity = strict_ems(tmp_path / "out" / f"emissivity/paint_{number}.ems")
        assert (weights, emissivity.shape) == ([1.0] * 91, (5, BANDS))
        np.testing.assert_allclose(micrometres, NM / 1000, atol=5.1e-8)
        members = paints.member_reflectance.values[number].astype(float)
        np.testing.assert_allclose(emissivity, 1 - members, atol=5.1e-7)
        wavelength, centre = np.loadtxt(tmp_path / "out" / f"reflectance/paint_{number}.txt").T
        np.testing.assert_array_equal(wavelength, micrometres)
        np.testing.assert_allclose(centre, paints.reflectance.values[number], atol=5.1e-7)
    assert (made.curves.values.tolist(), made.curves.dtype) == ([5, 5, 5], np.int64)
    assert made.attrs["specular_term"].startswith("none")
    assert done[-1] == (3, 3)


def test_materials_glist_and_readme(tmp_path: Path) -> None:
    paints = library().assign_coords(signature=["Türkis, matt", "rot/blau", "rot/blau"])
    made = hp.write_dirsig(paints, tmp_path / "out", thermal=THERM, double_sided=True)
    materials = read_materials(tmp_path / "out/materials.mat")
    names = ["Tuerkis, matt", "rot/blau", "rot/blau (2)"]
    tokens = ["Tuerkis_matt", "rot_blau", "rot_blau_2"]
    assert [material.name for material in materials] == names
    assert [material.id for material in materials] == tokens == made.material_id.values.tolist()
    for material in materials:
        assert material.emissivity_file is not None
        assert (tmp_path / "out" / material.emissivity_file).is_file()
        assert (specular_fraction(material), material.entry.get("DOUBLE_SIDED")) == (0.0, "TRUE")
        colour = [float(part) for part in (material.entry.get("EDITOR_COLOR") or "").split(",")]
        assert len(colour) == 3
        assert all(0 <= part <= 1 for part in colour)
    assert materials[0].entry.section("TEMP_SOLVER").get("MASS_DENSITY") == "2.7"  # type: ignore[union-attr]
    root = ET.fromstring((tmp_path / "out/paints.glist").read_text())
    assert [each.attrib["id"] for each in root.iter("assign")] == tokens
    readme = (tmp_path / "out/README.txt").read_text()
    assert "'Türkis, matt' is called 'Tuerkis, matt'" in readme
    assert "would count twice" in readme
    record = json.loads((tmp_path / "out/paints.json").read_text())["paints"][0]
    assert (record["paint"], record["about"]) == ("Türkis, matt", {"make": "Lada"})


THERM = {
    "specific_heat": 0.2, "mass_density": 2.7, "thermal_conductivity": 0, "solar_absorption": 0.5,
    "thermal_emissivity": 0.9, "exposed_area": 0.5, "thickness": 0.1,
}  # fmt: skip


@pytest.mark.parametrize(
    "name", ["\udc80", "a\x00b", "\u202e\u00a0", "]]>--><x>&", "x" * 5000, "..", "%s{0}"]
)
def test_any_name_is_written(name: str, tmp_path: Path) -> None:
    made = hp.write_dirsig(library(paints=1).assign_coords(signature=[name]), tmp_path / "out")
    token = made.material_id.item()
    assert (tmp_path / "out/emissivity" / f"{token}.ems").is_file()
    assert read_materials(tmp_path / "out/materials.mat")[0].id == token
    ET.fromstring((tmp_path / "out/paints.glist").read_text())
    assert json.loads((tmp_path / "out/paints.json").read_text())["paints"][0]["paint"] == name


def test_write_read_write_is_byte_stable(tmp_path: Path) -> None:
    hp.write_dirsig(library(), tmp_path / "one")
    parts = [open_emissivity(tmp_path / f"one/emissivity/paint_{number}.ems") for number in range(3)]
    hp.write_dirsig(xr.concat(parts, "signature"), tmp_path / "two")
    first, second = contents(tmp_path / "one"), contents(tmp_path / "two")
    for name in first:
        if name.endswith(".ems"):
            assert first[name] == second[name]
    hp.write_dirsig(library(), tmp_path / "three")
    assert contents(tmp_path / "three") == first


@settings(max_examples=12)
@given(
    st.lists(st.floats(0.0, 1.0, width=32), min_size=8, max_size=8),
    st.lists(st.floats(200, 2500), min_size=4, max_size=4, unique_by=lambda nm: round(nm, 3)),
)
def test_any_spectrum_survives(values: list[float], nm: list[float]) -> None:
    paint = xr.Dataset(
        {"reflectance": (("signature", "band"), np.float32(values).reshape(2, 4), {"units": "1"})},
        {"signature": ["x", "y"], "wavelength": ("band", nm, {"units": "nm"})},
    )
    order = np.argsort(nm)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        hp.write_dirsig(paint, Path(folder) / "one")
        for name, rho in zip("xy", paint.reflectance.values.astype(float), strict=True):
            path = Path(folder) / f"one/emissivity/{name}.ems"
            _, micrometres, emissivity = strict_ems(path)
            np.testing.assert_allclose(micrometres, np.array(nm)[order] / 1000, atol=5.1e-8)
            np.testing.assert_allclose(emissivity[0], 1 - rho[order], atol=5.1e-7)
            hp.write_dirsig(open_emissivity(path), Path(folder) / name)
            assert (Path(folder) / f"{name}/emissivity/{name}.ems").read_bytes() == path.read_bytes()


@st.composite
def odd_libraries(draw: st.DrawFn) -> xr.Dataset:
    paints, members, bands = draw(st.integers(1, 3)), draw(st.integers(0, 4)), draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    low, high = draw(
        st.sampled_from([(0.0, 1.0), (0.0, 0.01), (-0.1, 1.1), (0.0, 1.0), (0.0, 0.5), (5.0, 90.0)])
    )
    values = rng.uniform(low, high, (paints, members + 1, bands)).astype(np.float32)
    values[rng.random(values.shape) < draw(st.sampled_from([0.0, 0.0, 0.02, 0.1]))] = np.nan
    values[rng.random(values.shape[:2]) < draw(st.sampled_from([0.0, 0.3]))] = np.nan
    values[rng.random(values.shape) < draw(st.sampled_from([0.0, 0.0, 0.02]))] = np.inf
    nm = rng.uniform(300, 2500, bands)
    nm = nm if draw(st.booleans()) else np.sort(nm)
    made = xr.Dataset(
        {
            "reflectance": (("signature", "band"), values[:, 0], {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), values[:, 1:], {"units": "1"}),
        },
        {"signature": draw(st.lists(st.text(max_size=5), min_size=paints, max_size=paints))},
    )
    made = made.assign_coords(wavelength=("band", nm, {"units": "nm"}))
    if draw(st.booleans()):
        made["reflectance"].attrs["mirror_reflection"] = draw(st.sampled_from(["included", "excluded"]))
    return made.assign_coords(good=("band", rng.random(bands) < draw(st.sampled_from([0.8, 1.1, 1.1]))))


@given(
    odd_libraries(),
    st.fixed_dictionaries(
        {
            "gaps": st.sampled_from(["refuse", "interpolate", None]),
            "extrapolate": st.sampled_from([False, True, True]),
        },
        optional={
            "curves": st.sampled_from(["members", "centre"]),
            "specular": st.sampled_from([0.0, 0.04, 0.5]),
            "wavelength_range": st.sampled_from([(400.0, 1000.0), (100.0, 3000.0), (700.0, 700.001)]),
        },
    ),
)
@pytest.mark.slow
def test_any_library_is_written_strictly_or_refused(paints: xr.Dataset, options: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        out = Path(folder) / "out"
        try:
            made = hp.write_dirsig(paints, out, **options)
        except SchemaError:
            assert not list(Path(folder).iterdir())
            return
        materials = read_materials(out / "materials.mat")
        assert len(materials) == paints.sizes["signature"] == made.sizes["signature"]
        for material, count in zip(materials, made.curves.values, strict=True):
            path = out / (material.emissivity_file or "")
            _, micrometres, emissivity = strict_ems(path)
            assert (emissivity.shape[0], len(read_emissivity(path).curves)) == (count, count)
            if not options["extrapolate"]:
                measured = paints.wavelength.values[paints.good.values] / 1000
                assert measured.min() - 1e-6 <= micrometres[0] < micrometres[-1] <= measured.max() + 1e-6
            wanted = options.get("wavelength_range")
            if wanted is not None:
                assert micrometres[0] <= wanted[0] / 1000 + 1e-6
                assert micrometres[-1] >= wanted[1] / 1000 - 1e-6


# --- what is handed in -------------------------------------------------------------------------------------


def test_other_units_and_order_give_the_same_bytes(tmp_path: Path) -> None:
    paints = library()
    hp.write_dirsig(paints, tmp_path / "plain")
    hp.write_dirsig(paints.isel(band=slice(None, None, -1)), tmp_path / "backwards")
    micro = paints.assign_coords(wavelength=("band", NM / 1000, {"units": "um"}))
    hp.write_dirsig(micro, tmp_path / "micro")
    percent = paints.copy(deep=True)
    for name in ("reflectance", "member_reflectance"):
        percent[name] = (percent[name].astype(np.float64) * 100).assign_attrs(units="percent")
    hp.write_dirsig(percent, tmp_path / "percent")
    turned = paints.transpose("band", "member", "quantile", "signature").chunk({"signature": 1})
    hp.write_dirsig(turned, tmp_path / "turned")
    plain = contents(tmp_path / "plain")
    for name in ("backwards", "micro", "percent", "turned"):
        assert contents(tmp_path / name) == plain, name


def members(number: int, rows: Any = slice(None)) -> Callable[[xr.Dataset], np.ndarray]:
    return lambda paints: paints.member_reflectance.values[number][rows].astype(float)


def quantiles(paints: xr.Dataset) -> np.ndarray:
    return paints.reflectance_quantiles.values[1].astype(float)


def centre(number: int) -> Callable[[xr.Dataset], np.ndarray]:
    return lambda paints: paints.reflectance.values[number : number + 1].astype(float)


def bridged(paints: xr.Dataset) -> np.ndarray:
    # complete curves first, in their order; then those of the bad column, a straight line in their gap
    rho = members(1)(paints)
    rho[[0, 3], 4] = (rho[[0, 3], 3] + rho[[0, 3], 5]) / 2
    return rho[[1, 2, 4, 0, 3]]


MEMBERS, CENTRE = "member_reflectance", "reflectance"


@pytest.mark.parametrize(
    ("plants", "options", "counts", "number", "expected", "readme"),
    [
        # variables, places and values that are planted; columns of the summary; a paint, its curves, a text
        ([], {"curves": "quantiles"}, {}, 1, quantiles, ""),
        ([], {"curves": "centre"}, {"curves": [1, 1, 1]}, 1, centre(1), ""),
        # padding is no member; the centre stands for a paint without members
        (
            [(MEMBERS, np.s_[0, 3:], np.nan), (MEMBERS, np.s_[1], np.nan)],
            {}, {"curves": [3, 1, 5]}, 1, centre(1), "",
        ),
        # values outside 0 to 1 are clipped and counted
        (
            [(MEMBERS, np.s_[0, 0, 2:4], -0.01), (MEMBERS, np.s_[2, 1, 5], 1.2)],
            {}, {"clipped": [2, 0, 1]}, 0, lambda lib: members(0)(lib).clip(0, 1), "2 + 0",
        ),
        (
            [(CENTRE, np.s_[0, 2:4], -0.01)],
            {}, {"centre_clipped": [2, 0, 0], "clipped": [0, 0, 0]}, 1, members(1), "0 + 2",
        ),
        # members that lack an end are left out
        (
            [(MEMBERS, np.s_[0, 1, 0], np.nan)],
            {}, {"curves": [4, 5, 5], "left_out": [1, 0, 0]}, 0, members(0, [0, 2, 3, 4]), "",
        ),
        # a bad detector element stops nothing
        (
            [(MEMBERS, np.s_[1, [0, 3], 4], np.nan)],
            {}, {"curves": [5, 5, 5], "complete": [5, 3, 5], "interpolated": [0, 2, 0]}, 1, bridged,
            "paint_1: 3 of 5 curves are complete, and come first; filled in at 700.4 nm",
        ),
        # one column lacks the first band, another the last: none reaches as far as the centre
        (
            [(MEMBERS, np.s_[2, :3, 0], np.nan), (MEMBERS, np.s_[2, 3:, -1], np.nan)],
            {}, {"curves": [5, 5, 1]}, 2, centre(2), "the centre is the only curve",
        ),
    ],
)  # fmt: skip
def test_what_is_done_to_spectra_is_counted_and_said(
    plants: Any, options: Any, counts: Any, number: int, expected: Any, readme: str, tmp_path: Path
) -> None:
    paints = library()
    whole = paints.copy(deep=True)
    for name, place, value in plants:
        paints[name].values[place] = value
    is_changed = bool(plants) and counts.get("curves") != [3, 1, 5]
    with pytest.warns(PaintWarning, match="spectra-changed") if is_changed else contextlib.nullcontext():
        made = hp.write_dirsig(paints, tmp_path / "out", **options)
    for key, values in counts.items():
        assert made[key].values.tolist() == values, key
    emissivity = strict_ems(tmp_path / f"out/emissivity/paint_{number}.ems")[2]
    source = whole if expected is bridged else paints
    np.testing.assert_allclose(1 - emissivity, expected(source), atol=6e-7)
    text = (tmp_path / "out/README.txt").read_text()
    assert readme in text
    assert "paint_0: " not in text
    if "left_out" in counts:
        expect_error(
            SchemaError, "value-missing", lambda: hp.write_dirsig(paints, tmp_path / "refused", gaps="refuse")
        )


def test_unmeasured_ends_are_left_away_and_holes_refused(tmp_path: Path) -> None:
    paints = library()
    for name in ("reflectance", "member_reflectance"):
        paints[name][..., 0] = np.nan
    paints = paints.assign_coords(good=("band", np.arange(BANDS) != BANDS - 1))
    hp.write_dirsig(paints, tmp_path / "ends")
    micrometres = strict_ems(tmp_path / "ends/emissivity/paint_0.ems")[1]
    np.testing.assert_allclose(micrometres, NM[1:-1] / 1000, atol=6e-8)
    paints = paints.assign_coords(good=("band", ~np.isin(np.arange(BANDS), [3, 4])))
    caught = expect_error(
        SchemaError, "value-missing", lambda: hp.write_dirsig(paints, tmp_path / "holes", gaps="refuse")
    )
    assert str(caught).count("'paint ") == 3  # all paints are told
    assert not (tmp_path / "holes").exists()
    made = hp.write_dirsig(paints, tmp_path / "holes", gaps="interpolate")
    assert made.interpolated.values.tolist() == [10, 10, 10]
    emissivity = strict_ems(tmp_path / "holes/emissivity/paint_2.ems")[2]
    rho = paints.member_reflectance.values[2].astype(float)
    np.testing.assert_allclose(1 - emissivity[:, 2], rho[:, 2] + (rho[:, 5] - rho[:, 2]) / 3, atol=1e-6)
    assert "10" in (tmp_path / "holes/README.txt").read_text().split("extrapolated")[1]


def test_holes_of_the_centre_are_no_less_refused(tmp_path: Path) -> None:
    # Rationale: the .txt of a paint whose members are whole was filled in without a word.
    paints = library()
    paints["reflectance"][1, 3:5] = np.nan
    expect_error(
        SchemaError, "value-missing", lambda: hp.write_dirsig(paints, tmp_path / "out", gaps="refuse")
    )
    hp.write_dirsig(paints, tmp_path / "before", wavelength_range=(400.0, 540.0))
    made = hp.write_dirsig(paints, tmp_path / "out", gaps="interpolate")
    assert made.centre_interpolated.values.tolist() == [0, 2, 0]
    assert made.interpolated.values.tolist() == [0, 0, 0]
    _, centre = np.loadtxt(tmp_path / "out/reflectance/paint_1.txt").T
    own = paints.reflectance.values[1].astype(float)
    np.testing.assert_allclose(centre[3:5], own[2] + (own[5] - own[2]) * np.array([1, 2]) / 3, atol=6e-7)
    assert "0 + 2" in (tmp_path / "out/README.txt").read_text().split("paint_1 ")[1].splitlines()[0]


def test_nothing_is_extrapolated_unasked(tmp_path: Path) -> None:
    paints = library()
    expect_error(
        SchemaError,
        "wavelength-uncovered",
        lambda: hp.write_dirsig(paints, tmp_path / "out", wavelength_range=(380, 1100)),
    )
    made = hp.write_dirsig(
        paints, tmp_path / "out", wavelength_range=(np.float32(380), np.int64(1100)), extrapolate=True
    )
    _, micrometres, emissivity = strict_ems(tmp_path / "out/emissivity/paint_0.ems")
    assert (micrometres[0], micrometres[-1], len(micrometres)) == (0.38, 1.1, BANDS + 2)
    np.testing.assert_array_equal(emissivity[:, [0, -1]], emissivity[:, [1, -2]])
    assert made.extrapolated.values.tolist() == ["below and above"] * 3
    assert "below and above" in (tmp_path / "out/README.txt").read_text()
    assert made.range.values.tolist() == [[380.0, 1100.0]] * 3
    expect_error(
        SchemaError,
        "wavelength-uncovered",
        lambda: hp.write_dirsig(paints, tmp_path / "far", wavelength_range=(1200, 1300), extrapolate=True),
    )
    # a range inside is covered, and no more
    hp.write_dirsig(paints, tmp_path / "inside", wavelength_range=(500.0, 625.0))
    micrometres = strict_ems(tmp_path / "inside/emissivity/paint_0.ems")[1]
    np.testing.assert_allclose(micrometres, NM[1:4] / 1000, atol=6e-8)


def test_detectors_that_overlap(tmp_path: Path) -> None:
    nm = NM.copy()
    nm[5:] -= 160.0
    paints = library().assign_coords(wavelength=("band", nm, {"units": "nm"}))
    with pytest.warns(PaintWarning, match="wavelength-unordered") as noted:
        hp.write_dirsig(paints, tmp_path / "out")
    assert noted[0].filename == __file__  # the line of the caller
    micrometres = strict_ems(tmp_path / "out/emissivity/paint_0.ems")[1]
    np.testing.assert_allclose(micrometres, np.sort(nm) / 1000, atol=6e-8)
    nm[5] = nm[2]
    paints = library().assign_coords(wavelength=("band", nm, {"units": "nm"}))
    with pytest.warns(PaintWarning), pytest.raises(SchemaError, match="wavelength-duplicate"):
        hp.write_dirsig(paints, tmp_path / "same")


# --- the clear coat ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("attrs", "source"),
    [
        ({"mirror_reflection": "included"}, "stated by the library"),
        ({}, "not stated by the library, assumed"),
        # a sky that was not removed is in the reflectance
        ({"mirrored_sky_removed": "none"}, "stated by the library"),
        ({"mirrored_sky_removed": "F0 0.04; none"}, "stated by the library"),
    ],
)
def test_a_coat_does_not_count_twice(attrs: dict[str, str], source: str, tmp_path: Path) -> None:
    paints, out = library(**attrs), tmp_path / "out"
    expect_errors((SchemaError, "coat-counted-twice", lambda: hp.write_dirsig(paints, out, specular=0.1)))
    made = hp.write_dirsig(paints, out)
    assert (made.attrs["mirror_reflection"], made.attrs["mirror_reflection_source"]) == ("included", source)


def surface_of(folder: Path, token: str) -> tuple[str, str, dict[str, str]]:
    # Return solver, surface model and its pairs of a material
    entry = {each.id: each.entry for each in read_materials(folder / "materials.mat")}[token]
    (properties,) = [each for each in entry.sections() if each.name == "SURFACE_PROPERTIES"]
    (model,) = properties.sections()
    pairs = dict(pair for pair in model.items if isinstance(pair, tuple))
    return str(entry.get("RAD_SOLVER_NAME")), str(properties.get(f"{model.name}_NAME")), pairs


@pytest.mark.parametrize("attrs", [{"mirror_reflection": "excluded"}, {"mirrored_sky_removed": "F0 0.04"}])
def test_a_coat_is_a_brdf_over_the_body(attrs: dict[str, str], tmp_path: Path) -> None:
    paints = library(**attrs)
    paints["member_reflectance"] *= 0.8
    paints["member_reflectance"].attrs["units"] = "1"
    out = tmp_path / "out"
    made = hp.write_dirsig(paints, out, specular=0.04, roughness=0.02)
    assert made.coat_reflectance.values.tolist() == [0.04] * 3
    assert made.fit_file.values.tolist() == [f"brdf/paint_{number}.fit" for number in range(3)]
    assert surface_of(out, "paint_1") == (
        "Generic", "ShellTarget",
        {"EMISSIVITY_FILE": "emissivity/paint_1.ems", "BRDF_FIT_FILE": "brdf/paint_1.fit"},
    )  # fmt: skip
    body = 1 - strict_ems(out / "emissivity/paint_1.ems")[2] - 0.04
    np.testing.assert_allclose(body, paints.member_reflectance.values[1].astype(float), atol=6e-7)
    fit = (out / "brdf/paint_1.fit").read_text()
    values = {
        key: np.array(re.findall(rf"^    {key} = (\S+)$", fit, re.M), float) for key in ("DHR", "RHO_D")
    }
    np.testing.assert_allclose(values["DHR"] - np.pi * values["RHO_D"], 0.04, atol=2e-6)
    wavelength, centre = np.loadtxt(out / "reflectance/paint_1.txt").T
    lambdas = np.array(re.findall(r"^    LAMBDA = (\S+)$", fit, re.M), float)
    np.testing.assert_allclose(np.pi * values["RHO_D"], np.interp(lambdas, wavelength, centre), atol=2e-6)
    # both ends of the curves are covered, and nothing is far from a parameter
    assert (lambdas[0], lambdas[-1]) == (wavelength[0], wavelength[-1])
    assert np.diff(lambdas).max() <= 0.02
    readme = (out / "README.txt").read_text()
    assert "BRDF Shell Target of 3 paints" in readme
    assert max(map(len, readme.splitlines())) <= 120
    hp.write_dirsig(paints, tmp_path / "plain")
    assert "body below the coat" in (tmp_path / "plain/README.txt").read_text()
    assert surface_of(tmp_path / "plain", "paint_1") == (
        "Classic", "ClassicEmissivity",
        {"FILENAME": "emissivity/paint_1.ems", "SPECULAR_FRACTION": "0"},
    )  # fmt: skip
    assert not (tmp_path / "plain/brdf").exists()


def test_a_library_with_its_coat_apart(tmp_path: Path) -> None:
    paints = library()
    coat = xr.full_like(paints.reflectance, 0.04)
    coat[2] = 0.0  # a matte paint
    paints["specular_reflectance"] = coat.assign_attrs(units="1")
    made = hp.write_dirsig(paints, tmp_path / "out", specular="library", gaps="interpolate")
    np.testing.assert_allclose(made.coat_reflectance, [0.04, 0.04, 0.0], atol=1e-8)
    assert made.fit_file.values.tolist() == ["brdf/paint_0.fit", "brdf/paint_1.fit", ""]
    members = paints.member_reflectance.values.astype(float)
    for number, level in enumerate((0.04, 0.04, 0.0)):
        emissivity = strict_ems(tmp_path / f"out/emissivity/paint_{number}.ems")[2]
        np.testing.assert_allclose(1 - emissivity - level, members[number], atol=1e-6)
    assert surface_of(tmp_path / "out", "paint_2")[:2] == ("Classic", "ClassicEmissivity")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        *(({"specular": term}, "specular=") for term in (1.0, -0.1, float("nan"), "much", "library")),
        ({"curves": "members"}, "needs member_reflectance"),
    ],
)
def test_terms_and_curves_that_a_library_lacks_are_refused(options: Any, match: str, tmp_path: Path) -> None:
    paints = library(mirror_reflection="excluded").drop_vars("member_reflectance")
    expect_errors((SchemaError, match, lambda: hp.write_dirsig(paints, tmp_path / "out", **options)))


# --- A call of `write_dirsig` that makes no sense, and the folder that it fills: whole, or not at all ------


def test_all_wrong_options_are_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(SchemaError) as caught:
        hp.write_dirsig(
            library(), tmp_path / "out", curves="all", wavelength_range=(900, 400), gaps="ignore",
            surface="Ward", rad_solver="a b", thermal={"thickness": 1.0}, max_curves=0,
        )  # fmt: skip
    options = ("curves", "wavelength_range", "gaps", "surface", "rad_solver", "thermal", "max_curves")
    assert [name for name in options if f"{name}=" not in str(caught.value)] == []
    excluded, conflict = (
        library(mirror_reflection="excluded"),
        {"surface": "SimpleReflectance", "specular": 0.1},
    )
    expect_errors(
        (
            SchemaError,
            "empty-input",
            lambda: hp.write_dirsig(library().isel(signature=slice(0)), tmp_path / "o"),
        ),
        (SchemaError, "option-conflict", lambda: hp.write_dirsig(excluded, tmp_path / "out", **conflict)),
        (SchemaError, "type-wrong", lambda: hp.write_dirsig(library(), tmp_path / "out", max_curves=2.5)),
    )
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
    expect_error(
        FormatError,
        r"bad\.mat",
        lambda: hp.write_dirsig(library(), tmp_path / "three", scene_materials=tmp_path / "bad.mat"),
    )


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    out = tmp_path / "out"
    hp.write_dirsig(library(), out)
    before = contents(out)
    expect_errors((StoreError, "overwrite=True", lambda: hp.write_dirsig(library(seed=1), out)))
    assert contents(out) == before
    hp.write_dirsig(library(paints=2, seed=1), out, overwrite=True)
    assert not (out / "emissivity/paint_2.ems").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_files_of_others_are_never_replaced(tmp_path: Path) -> None:
    hp.write_dirsig(library(), tmp_path / "out")
    for name in ("out/thesis.txt", "scene/scene.mat", "file"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "scene")
    before = contents(tmp_path)
    for name, message in (
        ("out", r"thesis\.txt"),
        ("scene", "folder-occupied"),
        ("file", "path-not-folder"),
        ("link", "path-not-folder"),
    ):
        expect_error(
            StoreError, message, partial(hp.write_dirsig, library(), tmp_path / name, overwrite=True)
        )
    assert contents(tmp_path) == before
    (tmp_path / "empty").mkdir()
    hp.write_dirsig(library(), tmp_path / "empty")


def test_what_fails_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    hp.write_dirsig(library(), out)
    before = contents(out)

    def stop(done: int, _: int) -> None:
        raise KeyboardInterrupt

    expect_error(
        KeyboardInterrupt, None, lambda: hp.write_dirsig(library(seed=1), out, overwrite=True, progress=stop)
    )
    assert (contents(out), [path.name for path in tmp_path.iterdir()]) == (before, ["out"])

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hyperpaint.io.files.publishing.flush_group", full)
    expect_errors((StoreError, "disk-full", lambda: hp.write_dirsig(library(seed=1), out, overwrite=True)))
    assert (contents(out), [path.name for path in tmp_path.iterdir()]) == (before, ["out"])


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
    assert (steps, contents(tmp_path / "one")) == ([(3, 7), (6, 7), (7, 7)], contents(tmp_path / "two"))
    # coordinates may have other blocks than spectra
    places = ("signature", da.arange(7.0, chunks=7))
    hp.write_dirsig(library(paints=7).assign_coords(place=places).chunk({"band": 5}), tmp_path / "three")
    mixed = library(paints=7).chunk({"signature": 3}).assign_coords(place=places)
    hp.write_dirsig(mixed, tmp_path / "four")
    assert contents(tmp_path / "three") == contents(tmp_path / "four")


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


# --- populations -------------------------------------------------------------------------------------------


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


# --- Emissivity files and material lists: the real ones with their known values, and what is refused ---


NEW = [
    "2",
    *["1.0"] * 91,
    "CURVE_BEGIN\t",
    "0.4\t0.9",
    "0.5\t0.8",
    "CURVE_BEGIN",
    "0.4 0.7",
    "0.6 1e-1",
    "",
    " ",
]
OLD = ["1", *["1.0"] * 91, "0", *(f"{wave} 0.5" for wave in range(39850, 349, -100))]


def written(folder: Path, lines: list[str], end: str = "\n") -> Path:
    return write_file(folder / "paint.ems", end.join(lines).encode())


# --- real files --------------------------------------------------------------------------------------------


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "layout", "count", "rows", "ends", "values"),
    [
        ("muddy_water", "old", 1, 396, (1e4 / 39850, 1e4 / 350), (0.95943, 1.0)),
        ("grass_texture", "old", 43, 396, (1e4 / 39850, 1e4 / 350), (0.494154, 1.0)),
        ("ideal_mat_1", "new", 1, 3879, (0.35, 14.983), (1.0, 1.0)),
        ("ideal_mat_2", "new", 1, 3879, (0.35, 14.983), (0.9, 0.9)),
        ("background_1", "new", 1, 3879, (0.35, 14.983), (0.98, 0.98)),
    ],
)
def test_real_files(name, layout, count, rows, ends, values, shared_data: Path) -> None:
    found = read_emissivity(shared_data / "dirsig" / "emissivity" / f"{name}.ems")
    assert (found.layout, len(found.curves), found.weights.shape) == (layout, count, (91,))
    assert {len(curve.wavelength) for curve in found.curves} == {rows}
    all_values = np.concatenate([curve.emissivity for curve in found.curves])
    assert (all_values.min(), all_values.max()) == values
    np.testing.assert_allclose(found.curves[0].wavelength[[0, -1]], ends, rtol=0, atol=0)
    assert (np.diff(found.curves[0].wavelength) > 0).all()


@pytest.mark.real_data
def test_water_shines_less_at_the_horizon(shared_data: Path) -> None:
    weights = read_emissivity(shared_data / "dirsig/emissivity/muddy_water.ems").weights
    assert (weights[:3].tolist(), weights[90]) == ([1.0, 0.995893, 0.991786], 0.0)


@pytest.mark.real_data
def test_grass_as_a_paint_library(shared_data: Path) -> None:
    grass = open_emissivity(shared_data / "dirsig/emissivity/grass_texture.ems")
    assert dict(grass.sizes) == {"signature": 1, "band": 396, "member": 43}
    assert grass.member_reflectance.dtype == grass.reflectance.dtype == np.float32
    assert (grass["signature"].item(), grass.wavelength.attrs["units"]) == ("grass_texture", "nm")
    # the last row of the file, by hand: 350 cm-1, emissivity 0.950167
    np.testing.assert_allclose(grass.wavelength[-1], 1e7 / 350)
    np.testing.assert_allclose(grass.member_reflectance[0, -1, -1], 1 - 0.950167, atol=1e-7)


# --- what is read and what is refused ----------------------------------------------------------------------


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_new_file_may_have_tabs_and_blank_lines(tmp_path: Path, end: str) -> None:
    found = read_emissivity(written(tmp_path, NEW, end))
    assert [curve.wavelength.tolist() for curve in found.curves] == [[0.4, 0.5], [0.4, 0.6]]
    assert [curve.emissivity.tolist() for curve in found.curves] == [[0.9, 0.8], [0.7, 0.1]]
    expect_errors((FormatError, "grid-mismatch", lambda: open_emissivity(tmp_path / "paint.ems")))
    # the last line needs no end
    assert len(read_emissivity(written(tmp_path, NEW[:-2])).curves) == 2


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (0, "3", "2 curves, expected 3"),
        (0, "1", "2 curves, expected 1"),
        (0, "0", "line 1: '0', expected a number of curves"),
        (0, "1e3", "line 1: '1e3'"),
        (0, "99999999999", "line 1"),
        (5, "one", "line 6: 'one', expected the weight of 4 degrees"),
        (5, "-1", "negative"),
        (5, "1e400", "value-out-of-range"),
        (5, "1.0 1.0", "line 6"),
        (92, "CURVE", "line 93: 'CURVE', expected CURVE_BEGIN or the number 0"),
        (93, "0.4", "line 94: '0.4', expected two numbers"),
        (93, "0.4 0.9 0.8", "line 94"),
        (93, "0,4 0,9", "line 94"),
        (93, "nan 0.9", "line 94"),
        (93, "0.6 0.9", "curve 0, from line 94: wavelengths do not ascend"),
        (93, "0.5 0.9", "do not ascend"),
        (93, "0 0.9", "do not ascend"),
        (94, "500 0.9", "up to 500, expected micrometres"),
        (94, "0.5 90", "emissivity from 0.9 to 90"),
        (94, "0.5 -0.1", "expected 0 to 1"),
        (94, "0.5 1e999", "expected 0 to 1"),
        (97, "0.6 0x1", "line 98"),
        (98, "and so on", "line 99: 'and so on'"),
        # the old layout
        (92, "1", "line 93: curve 1, expected 0"),
        (93, "39849 0.5", "396 wavenumbers"),
        (100, "", "line 101"),
        (100, "0.5", "line 101"),
        (487, "450 0.5\n350 0.5", "397 rows, expected the 396"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused(line: int, text: str, said: str, tmp_path: Path) -> None:
    lines = OLD.copy() if ((line, text) in [(92, "1"), (93, "39849 0.5")] or line > 99) else NEW.copy()
    lines[line] = text
    error = expect_error(FormatError, "DIRSIG emissivity", lambda: read_emissivity(written(tmp_path, lines)))
    assert said in str(error)


def test_an_old_file_is_read_and_all_problems_are_told_at_once(tmp_path: Path) -> None:
    assert read_emissivity(written(tmp_path, OLD)).curves[0].emissivity.tolist() == [0.5] * 396
    lines = NEW.copy()
    lines[94], lines[96] = "0.5 7", "x"
    error = expect_error(FormatError, None, lambda: read_emissivity(written(tmp_path, lines)))
    assert str(error).count("\n") == 2


@pytest.mark.parametrize("data", [b"", b"\n", b"1\n", b"1\n" * 93, b"\xff\xfe\x00", b"9" * 100_000])
def test_what_is_no_such_file_is_refused(data: bytes, tmp_path: Path) -> None:
    path = write_file(tmp_path / "x.ems", data)
    expect_errors(
        (FormatError, r"x\.ems", lambda: read_emissivity(path)),
        (FormatError, "file-unreadable", lambda: read_emissivity(tmp_path / "missing.ems")),
    )


# --- text --------------------------------------------------------------------------------------------------


@given(
    st.lists(st.floats(0.01, 99_000), min_size=1, max_size=12, unique_by=lambda nm: round(nm, 2)),
    st.integers(1, 4),
    st.randoms(use_true_random=False),
)
def test_text_is_what_formatting_one_by_one_gives(wavelength, count, random) -> None:
    wavelength = sorted(wavelength)
    # whole millionths and their neighbours; halves may round either way
    values = np.array(
        [[random.choice((0.0, 1.0, random.random())) for _ in wavelength] for _ in range(count)]
    )
    expected = "".join(
        "TITLE\n"
        + "".join(f"{nm / 1000:.7f}\t{value:.6f}\n" for nm, value in zip(wavelength, row, strict=True))
        for row in values
    )
    assert ColumnText(wavelength, "TITLE").text(values) == expected.encode()


def test_wavelengths_that_are_written_alike_are_refused() -> None:
    expect_errors((SchemaError, "wavelength-unordered", lambda: ColumnText([400.0, 400.00001])))


# --- Material lists: the real one with its known values, the grammar, and what is refused ------------------

ENTRY = """MATERIAL_ENTRY {
    ID = a
    NAME = paint a, (matt)

    SURFACE_PROPERTIES {
        EMISSIVITY_PROP_NAME = ClassicEmissivity
        EMISSIVITY_PROP {
            FILENAME = emissivity/a.ems
            SPECULAR_FRACTION = 0.25
        }
    }
}
"""


def written_materials(folder: Path, text: str) -> Path:
    return write_file(folder / "x.mat", text, encoding="utf-8")


@pytest.mark.real_data
def test_the_real_list(shared_data: Path) -> None:
    path = shared_data / "dirsig/anadirsig.mat"
    found = read_materials(path)
    assert [(m.id, m.name, m.emissivity_file, specular_fraction(m)) for m in found] == [
        ("100", "Terrain (remapped)", None, None),
        ("2", "water", "emissivity/muddy_water.ems", 1.0),
        ("4", "grass", "emissivity/grass_texture.ems", 0.1),
        ("13", "dirt", "emissivity/grass_dirt.ems", 1.0),
    ]
    therm = found[1].entry.section("TEMP_SOLVER")
    assert therm is not None
    assert therm.get("THERMAL_CONDUCTIVITY") == "5.13"
    # we write what DIRSIG's people wrote, to the byte
    assert materials_text(material.entry for material in found).encode() == path.read_bytes()


def test_proxies_bundles_and_old_entries(tmp_path: Path) -> None:
    text = ENTRY + "MATERIAL_MAP {\n IMAGE_FILENAME = m.png\n LUT {\n  0:a\n 255 : b\n }\n}\n"
    text += "MATERIAL_ENTRY {\n MATERIAL_ID = 7\n MATERIAL_NAME = old\n EMISSIVITY_FILE = x.ems\n}\n"
    found = read_materials(written_materials(tmp_path, text.replace("\n", "\r\n")))
    assert [(material.id, material.name) for material in found] == [("a", "paint a, (matt)"), ("7", "old")]
    assert specular_fraction(found[0]) == 0.25
    assert found[0].reflectance_file is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ID = a", "ID = a b", "id-missing"),
        ("    ID = a\n", "", "id-missing"),
        ("    NAME = paint a, (matt)\n", "", "name-missing"),
        ("ID = a", "ID = a\nID = b", "key-duplicate"),
        ("0.25", "1.5", "SPECULAR_FRACTION = '1.5', expected 0 to 1"),
        ("0.25", "nan", "SPECULAR_FRACTION"),
        ("0.25", "", "SPECULAR_FRACTION"),
        ("NAME = paint", "NAME paint", "line 3"),
        ("MATERIAL_ENTRY {", "MATERIAL_ENTRY\n{", "line 1: 'MATERIAL_ENTRY', expected 'NAME {', '}'"),
        ("    ID = a", "}\n}", "line 3: '}', expected no bracket"),
        ("\n}\n", "\n", "line 1: section MATERIAL_ENTRY is not closed"),
        ("    ID = a", "# no comment", "line 2"),
        ("    ID = a", "0:a", "line 2"),
        ("    EMISSIVITY_PROP {", "    PROP {", "EMISSIVITY_PROP_NAME without a section EMISSIVITY_PROP"),
        ("    ID = a", "A {\n" * 30 + "}\n" * 30, "at most 16 deep"),
    ],
)  # fmt: skip
def test_what_is_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    assert old in ENTRY
    caught = expect_error(
        FormatError,
        "DIRSIG material list",
        lambda: read_materials(written_materials(tmp_path, ENTRY.replace(old, new, 1))),
    )
    assert said in str(caught)


@pytest.mark.parametrize(
    ("text", "message"),
    [(ENTRY + ENTRY, "id-duplicate"), ("\n", "section-missing"), ("\n" * 400_001, "400001 lines")],
    ids=["twice", "empty", "long"],
)
def test_ids_and_lines_are_counted(text: str, message: str, tmp_path: Path) -> None:
    expect_errors((FormatError, message, lambda: read_materials(written_materials(tmp_path, text))))


_KEYS = st.from_regex(r"[A-Z][A-Z0-9_]{0,12}", fullmatch=True).filter(lambda key: not key.endswith("_NAME"))
_VALUES = st.text("abcXYZ019 .,/()-", max_size=20).map(str.strip)


@given(st.dictionaries(_KEYS, _VALUES, max_size=6), st.dictionaries(_KEYS, _VALUES, max_size=4))
def test_write_read_write_is_stable(outer: dict[str, str], inner: dict[str, str]) -> None:
    outer = {key: value for key, value in outer.items() if key != "INNER"}
    items = (("ID", "x"), ("NAME", "n"), *((f"K_{key}", value) for key, value in outer.items()))
    entry = Section("MATERIAL_ENTRY", (*items, Section("INNER", tuple(inner.items()))))
    text = materials_text([entry])
    with tempfile.TemporaryDirectory() as folder:
        read = read_materials(written_materials(Path(folder), text))
    assert (read[0].entry, materials_text([read[0].entry])) == (entry, text)


# --- names -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "plain", "token"),
    [
        ("Türkis, matt", "Tuerkis, matt", "Tuerkis_matt"),
        ("rot/weiß {1}", "rot/weiss _1_", "rot_weiss_1"),
        ("a\nb\tc", "a b c", "a_b_c"),
        ("bleu métallisé", "bleu metallise", "bleu_metallise"),
        ("u\u0308ber", "ueber", "ueber"),
        ("ID = 3 # x", "ID _ 3 _ x", "ID_3_x"),
        ("../../etc/passwd", "../../etc/passwd", "etc_passwd"),
        ("赤", "paint 1", "paint_1"),
        ("", "paint 1", "paint_1"),
        ("42", "42", "paint_42"),
        ("NUL", "NUL", "paint_NUL"),
        ("x" * 300, "x" * 120, "x" * 48),
    ],
)
def test_names_become_plain(name: str, plain: str, token: str) -> None:
    assert (material_names([name]), material_ids([name])) == ([plain], [token])


@given(st.lists(st.text(max_size=12), max_size=12), st.lists(st.text("abAB_ 2()", max_size=4), max_size=6))
def test_no_two_names_or_tokens_are_alike(names: list[str], taken: list[str]) -> None:
    for function in (material_ids, material_names):
        made = function(names, taken)
        folded = [text.casefold() for text in made]
        assert len(set(folded)) == len(names)
        assert not set(folded) & {text.casefold() for text in taken}
        assert all(text.isascii() and text.isprintable() and text.strip() == text for text in made)
        assert not any(sign in text for text in made for sign in "{}=\n")
    assert all(token.replace("_", "a").isalnum() for token in material_ids(names))


def test_a_thousand_names_alike_take_no_long_time() -> None:
    assert (material_ids(["red"] * 5000)[-1], plain_name("a  b")) == ("red_5000", "a b")


# --- A scene of triangles for DIRSIG: every file reads back, every name leads somewhere ---


SCENE_NM = np.arange(396.0, 1005.0, 4.0)
UNITS = {"units": "1"}


def painted_library(names: list[str], members: int = 0, **attrs: Any) -> xr.Dataset:
    # Return the simulator's own spectra as a library, with members of other brightness where asked.
    values = np.stack([spectrum_of(name)(SCENE_NM) for name in names]).astype(np.float32)
    variables: dict[str, Any] = {"reflectance": (("signature", "band"), values, {**UNITS, **attrs})}
    if members:
        level = np.random.default_rng(1).uniform(0.7, 1.0, (len(names), members, 1))
        population = (values[:, None] * level).astype(np.float32)
        variables["member_reflectance"] = (("signature", "member", "band"), population, UNITS)
    return xr.Dataset(variables, {"signature": names, "wavelength": ("band", SCENE_NM, {"units": "nm"})})


def boxes() -> Scene:
    # Return two painted triangles with normals, and a grey one.
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2], [5, 5, 0], [7, 5, 0], [5, 5, 2]], float)
    normals = np.zeros_like(corners)
    normals[4:] = [0.0, -1.0, 0.0]
    materials = (
        Material("paint of one", "red", "paint", Coat()),
        Material("floor", "asphalt", "asphalt"),
        Material("paint of two", "red", "paint", Coat()),
    )
    things = (
        Instance("car one", "car", "red"),
        Instance("ground", "ground"),
        Instance("car zwölf", "car", "red"),
    )
    faces = np.array([[4, 5, 6], [0, 1, 2], [0, 1, 3]])
    return Scene("Two cars, Ä", corners, faces, normals, [0, 1, 2], [0, 1, 2], materials, things)


@pytest.fixture(scope="module")
def park() -> Scene:
    return car_park(length=12.0, width=16.0, seed=4, name="car park")


@pytest.fixture(scope="module")
def exported(park: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, xr.Dataset]:
    names = sorted({material.spectrum for material in park.materials})
    folder = tmp_path_factory.mktemp("dirsig") / "park"
    paints = painted_library(names, 100, mirror_reflection="excluded")
    return folder, write_dirsig_scene(park, folder, paints, max_curves=16)


def test_the_geometry_reads_back_with_its_materials(park: Scene, exported: tuple[Path, xr.Dataset]) -> None:
    folder, summary = exported
    raw = parse_obj((folder / "geometry/objects/car_park.obj").read_bytes(), "car_park.obj")
    # a paint under a coat and without one are two materials of one spectrum
    of_spectrum: dict[str, set[str]] = {}
    for paint, token in zip(summary["signature"].values, summary.material_id.values, strict=True):
        of_spectrum.setdefault(str(token), set()).add(str(paint))
    read = [
        (raw.groups[group][1], next(iter(of_spectrum[raw.groups[group][0]])))
        for group in raw.face_group.tolist()
    ]
    given = [
        (park.instances[thing].name, park.materials[material].spectrum)
        for thing, material in zip(park.face_instance.tolist(), park.face_material.tolist(), strict=True)
    ]
    np.testing.assert_allclose(raw.vertices, park.vertices, atol=1e-7)
    sides = [
        sorted((*key, *face) for key, face in zip(keys, faces.tolist(), strict=True))
        for keys, faces in ((read, raw.faces), (given, park.faces))
    ]
    assert sides[0] == sides[1]
    assert int(summary.faces.sum()) == len(park.faces) == summary.attrs["faces"]


def test_the_geometry_reads_in_another_program(park: Scene, exported: tuple[Path, xr.Dataset]) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(exported[0] / "geometry/objects/car_park.obj", process=False, force="scene")
    parts = list(mesh.geometry.values())
    assert sum(len(part.faces) for part in parts) == len(park.faces)
    assert sum(part.area for part in parts) == pytest.approx(float(park.area.sum()), rel=1e-5)
    np.testing.assert_allclose(mesh.bounds, park.bounds, atol=1e-6)


def test_every_name_leads_somewhere(exported: tuple[Path, xr.Dataset]) -> None:
    folder, summary = exported
    (simulation,) = json.loads((folder / "car_park.jsim").read_text())
    assert simulation["plugin_list"] == []
    (scene,) = [folder / entry["inputs"] for entry in simulation["scene_list"]]
    root = ElementTree.parse(scene).getroot()
    assert root.tag == "classicscene"
    assert root.find("properties").attrib["features"] == "vis,nir"  # type: ignore[union-attr]

    def place(tag: str) -> Path:
        text = root.findtext(tag)
        assert text is not None
        return folder / text.removeprefix("$SCENE_DIR/")

    (geometry,) = [place("gdbdirectory") / str(each.text) for each in root.iter("geometrylistinclude")]
    names = [str(each.text) for each in ElementTree.parse(geometry).getroot().iter("filename")]
    assert [name for name in names if not (place("gdbdirectory") / name).is_file()] == []
    obj = (place("gdbdirectory") / names[0]).read_text()
    assert (place("gdbdirectory") / "objects" / re.findall(r"mtllib (.+)", obj)[0]).is_file()
    materials = read_materials(place("matfilename"))
    for material in materials:
        assert (place("emsdirectory") / str(material.emissivity_file)).is_file()
    tokens = {material.id for material in materials}
    # the same IDs in the material list, in the geometry, in its colours, in the maps
    assert set(re.findall(r"^usemtl (.+)$", obj, re.MULTILINE)) == tokens == set(summary.material_id.values)
    colours = (place("gdbdirectory") / "objects/car_park.mtl").read_text()
    assert set(re.findall(r"^newmtl (.+)$", colours, re.MULTILINE)) == tokens
    maps = {
        str(each.findtext("matidlist/matid")): str(each.findtext("bandlist/band/image/filename"))
        for each in root.iter("texturemap")
    }
    assert set(maps) == set(summary.material_id.values[summary.curves.values > 1].tolist())
    assert len(maps) > 5
    assert all((place("mapdirectory") / name).is_file() for name in maps.values())
    assert {path.name for path in place("mapdirectory").iterdir()} == set(maps.values())


def test_the_readme_says_what_was_checked(exported: tuple[Path, xr.Dataset]) -> None:
    text = (exported[0] / "README.txt").read_text()
    parts = ('features "vis,nir"', "docs/new/glist.html", "tahoe.scene", "Not checked", "Ward")
    assert [part for part in (*parts, "DIRSIG itself has not run") if part not in text] == []
    assert max(map(len, text.splitlines())) <= 120


def picture_of(folder: Path, name: str) -> NDArray[np.uint8]:
    data = (folder / "maps" / name).read_bytes()
    head = re.match(rb"P5\n(\d+) (\d+)\n255\n", data)
    assert head is not None
    width, height = map(int, head.groups())
    return np.frombuffer(data[head.end() :], np.uint8).reshape(height, width)


def test_a_texture_draws_its_population(exported: tuple[Path, xr.Dataset]) -> None:
    folder, summary = exported
    number = int(np.flatnonzero(summary["signature"].values == "asphalt")[0])
    picture = picture_of(folder, str(summary.texture.values[number])).astype(float)
    _, micrometre, emissivity = strict_ems(folder / "materials/emissivity/asphalt.ems")
    assert len(emissivity) == summary.curves.values[number] == 16
    grid = np.linspace(0.4, 0.7, 301)
    means = np.array([1.0 - np.interp(grid, micrometre, curve).mean() for curve in emissivity])
    # the manual's rule: the curve whose standard score is nearest to the pixel's
    pixels = (picture - picture.mean()) / picture.std()
    drawn = np.abs(pixels[..., None] - ((means - means.mean()) / means.std())).argmin(axis=-1)
    assert np.bincount(drawn.ravel(), minlength=16).min() > 0.97 * picture.size / 16
    reflectance = 1.0 - emissivity
    np.testing.assert_allclose(reflectance[drawn.ravel()].mean(axis=0), reflectance.mean(axis=0), rtol=1e-3)
    np.testing.assert_allclose(reflectance[drawn.ravel()].std(axis=0), reflectance.std(axis=0), rtol=0.01)
    # neighbours are alike, and edges meet: it repeats
    steps = np.abs(np.diff(drawn, axis=1)).mean()
    assert steps < 0.5 * np.abs(np.subtract.outer(np.arange(16), np.arange(16))).mean()
    assert np.abs(drawn[:, 0] - drawn[:, -1]).mean() < 2 * steps


def test_a_picture_needs_different_curves() -> None:
    assert texture_picture(np.array([0.2]), "a") is None
    assert texture_picture(np.array([0.2, 0.2, 0.2]), "a") is None
    one, other = (texture_picture(np.linspace(0.1, 0.3, 7), name) for name in "ab")
    assert one is not None
    assert other is not None
    assert (one != other).any()


def test_no_coat_is_written_over_mirrored_light(tmp_path: Path) -> None:
    measured = write_dirsig_scene(boxes(), tmp_path / "out", painted_library(["red", "asphalt"]))
    assert (measured.coat_reflectance == 0.0).all()
    assert "it would count twice" in (tmp_path / "out/README.txt").read_text()
    assert not list((tmp_path / "out/materials/brdf").iterdir())
    assert "ShellTarget" not in (tmp_path / "out/materials/Two_cars_Ae.mat").read_text()


def blocks_of_fit(path: Path) -> list[dict[str, float]]:
    blocks = re.findall(r"FIT_PARAMS \{\n(.*?)\n\}", path.read_text(), re.DOTALL)
    return [{k: float(v) for k, v in re.findall(r"(\w+) = (\S+)", block)} for block in blocks]


def beard_maxwell(fit: dict[str, float], light: NDArray[Any], view: NDArray[Any]) -> NDArray[Any]:
    # Return first term and whole of the BRDF of Westlund and Meyer (2002), equation 10 [sr-1].
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    beta = np.arccos(np.clip((half * light).sum(axis=-1), -1.0, 1.0))
    tilt = np.arccos(np.clip(half[..., 2], -1.0, 1.0))

    obscured = np.degrees(tilt) / fit["OMEGA"]
    shadow = (1.0 + obscured * np.exp(-2.0 * np.degrees(beta) / fit["TAU"])) / (1.0 + obscured)
    mirrored = plain_fresnel(beta, fit["N"]) / plain_fresnel(0.0, fit["N"])
    first = mirrored * fit["BIAS"] * np.exp(-((tilt / fit["SIGMA"]) ** 2))
    first = first * np.cos(tilt) ** 2 / (light[..., 2] * view[..., 2]) * shadow
    return np.stack([first, first + fit["RHO_D"] + 2.0 * fit["RHO_V"] / (light[..., 2] + view[..., 2])])


def test_a_coat_as_a_brdf_reflects_what_its_curve_says(tmp_path: Path) -> None:
    paints = painted_library(["red", "asphalt"], mirror_reflection="excluded")
    summary = write_dirsig_scene(boxes(), tmp_path / "out", paints)
    coats = dict(zip(summary["signature"].values, summary.coat_reflectance.values, strict=True))
    assert coats == {"red": pytest.approx(0.04), "asphalt": 0.0}
    assert not any(summary.texture.values)
    folder = tmp_path / "out/materials"
    fits = blocks_of_fit(folder / "brdf/red.fit")
    assert [path.name for path in (folder / "brdf").iterdir()] == ["red.fit"]
    by_id = {material.id: material.entry for material in read_materials(folder / "Two_cars_Ae.mat")}
    surface = by_id["red"].section("SURFACE_PROPERTIES")
    assert surface is not None
    assert surface.get("REFLECTANCE_PROP_NAME") == "ShellTarget"
    named = surface.section("REFLECTANCE_PROP")
    assert named is not None
    assert (folder / str(named.get("BRDF_FIT_FILE"))).is_file()
    _, micrometre, curves = strict_ems(folder / str(named.get("EMISSIVITY_FILE")))
    # light from the normal, reflected all over the hemisphere: fine where the lobe is
    edges = np.concatenate([np.linspace(0.0, 0.6, 3001), np.linspace(0.6, np.pi / 2 - 1e-6, 2000)[1:]])
    zenith = 0.5 * (edges[1:] + edges[:-1])
    ring = 2.0 * np.pi * (np.cos(edges[:-1]) - np.cos(edges[1:]))
    view = np.stack([np.sin(zenith), np.zeros_like(zenith), np.cos(zenith)], axis=-1)
    light = np.broadcast_to([0.0, 0.0, 1.0], view.shape).copy()
    body = np.interp(
        [fit["LAMBDA"] for fit in fits], SCENE_NM / 1000.0, paints.reflectance.sel(signature="red").values
    )
    for fit, level in zip(fits, body.tolist(), strict=True):
        first, whole = (beard_maxwell(fit, light, view) * np.cos(zenith) * ring).sum(axis=1)
        assert first == pytest.approx(0.04, rel=2e-3)
        assert whole == pytest.approx(0.04 + level, rel=3e-3)
        assert whole == pytest.approx(fit["DHR"], rel=3e-3)
        assert whole == pytest.approx(1.0 - np.interp(fit["LAMBDA"], micrometre, curves[0]), rel=3e-3)
    assert max(np.diff([fit["LAMBDA"] for fit in fits])) < 0.021
    # the peak is that of the renderer's own lobe, F D / (4 cos^2), D = 1 / (pi alpha^2)
    angle = np.radians(20.0)
    inward = np.array([np.sin(angle), 0.0, np.cos(angle)])
    peak = float(beard_maxwell(fits[0], inward.copy(), (inward * [-1.0, 1.0, 1.0]))[0])
    alpha = boxes().materials[0].coat.roughness  # type: ignore[union-attr]
    ggx = float(fresnel_reflectance(np.cos(angle))) / (4.0 * np.pi * alpha**2 * np.cos(angle) ** 2)
    assert peak == pytest.approx(ggx, rel=0.02)


def test_names_and_normals(tmp_path: Path) -> None:
    write_dirsig_scene(boxes(), tmp_path / "out", painted_library(["red", "asphalt"]))
    text = (tmp_path / "out/geometry/objects/Two_cars_Ae.obj").read_text()
    assert re.findall(r"^o (.+)$", text, re.MULTILINE) == ["car one", "ground", "car zwoelf"]
    # a smooth face has normals, the others have none; texture lies on the plane that a face faces
    places = [tuple(map(float, row)) for row in re.findall(r"^vt (\S+) (\S+)$", text, re.MULTILINE)]
    faces = [row.split() for row in re.findall(r"^f (.+)$", text, re.MULTILINE)]
    smooth, level, upright = ([corner.split("/") for corner in face] for face in faces)
    assert [corner[::2] for corner in smooth] == [["5", "5"], ["6", "6"], ["7", "7"]]
    assert [len(corner) for corner in level + upright] == [2] * 6
    # metres over 2: east and up, east and north, east and up
    for face, expected in (
        (smooth, [(2.5, 0.0), (3.5, 0.0), (2.5, 1.0)]),
        (level, [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]),
        (upright, [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]),
    ):
        assert [places[int(corner[1]) - 1] for corner in face] == expected
    assert ElementTree.parse(tmp_path / "out/Two_cars_Ae.scene").getroot().attrib["name"] == "Two cars, Ä"


def test_a_car_can_be_repainted(tmp_path: Path) -> None:
    paints = painted_library(["red", "asphalt", "blue", "white"])
    repaint = {"car zwölf": "blue", "asphalt": "white"}
    summary = write_dirsig_scene(boxes(), tmp_path / "out", paints, repaint=repaint)
    assert sorted(summary["signature"].values) == ["blue", "red", "white"]
    text = (tmp_path / "out/geometry/objects/Two_cars_Ae.obj").read_text()
    assert re.findall(r"^(?:o|usemtl) (.+)$", text, re.MULTILINE) == [
        "car one", "red", "ground", "white", "car zwoelf", "blue",
    ]  # fmt: skip


def test_the_first_library_counts(tmp_path: Path) -> None:
    mine = painted_library(["red"], 30)
    mine = mine.assign(reflectance=mine.reflectance * 0.5, member_reflectance=mine.member_reflectance * 0.5)
    for name in ("reflectance", "member_reflectance"):
        mine[name].attrs = UNITS
    summary = write_dirsig_scene(boxes(), tmp_path / "out", [mine, painted_library(["red", "asphalt"])])
    assert dict(zip(summary["signature"].values, summary.curves.values, strict=True)) == {
        "red": 30,
        "asphalt": 1,
    }
    _, micrometre, curves = strict_ems(tmp_path / "out/materials/emissivity/red.ems")
    assert (1.0 - curves).max() <= 0.51 * float(painted_library(["red"]).reflectance.max())
    assert len(micrometre) == len(SCENE_NM)


@pytest.mark.parametrize(
    ("options", "messages"),
    [
        ({}, ["spectrum-missing"]),
        ({"repaint": {"car nine": "red"}}, ["key-unknown"]),
        (
            {"max_curves": 0, "texture_m": 0.0, "origin": (100.0, 0.0, 0.0)},
            ["max_curves", "texture_m", "origin"],
        ),
    ],
)
def test_what_cannot_be_written_is_said(options: Any, messages: list[str], tmp_path: Path) -> None:
    caught = expect_error(
        SchemaError,
        None,
        lambda: write_dirsig_scene(boxes(), tmp_path / "out", painted_library(["red"]), **options),
    )
    assert [message for message in messages if message not in str(caught)] == []
    assert not list(tmp_path.iterdir())


def test_a_bad_element_stops_nothing(tmp_path: Path) -> None:
    paints = painted_library(["red", "asphalt"], 20)
    population = paints.member_reflectance.values.copy()
    population[:, ::4, 30] = np.nan
    paints["member_reflectance"] = paints.member_reflectance.copy(data=population)
    summary = write_dirsig_scene(boxes(), tmp_path / "out", paints, max_curves=10)
    assert (summary.complete == 10).all()
    assert (summary.interpolated == 0).all()
    whole = write_dirsig_scene(boxes(), tmp_path / "whole", paints, max_curves=20)
    assert (whole.complete == 15).all()
    assert (whole.interpolated == 5).all()


def test_an_export_is_replaced_only_when_asked(tmp_path: Path) -> None:
    paints = painted_library(["red", "asphalt"], 5)
    write_dirsig_scene(boxes(), tmp_path / "out", paints)
    before = contents(tmp_path / "out")
    expect_errors((StoreError, "overwrite", lambda: write_dirsig_scene(boxes(), tmp_path / "out", paints)))
    write_dirsig_scene(boxes(), tmp_path / "out", paints, overwrite=True)
    assert contents(tmp_path / "out") == before  # the same bytes
