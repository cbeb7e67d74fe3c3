"""Materials for DIRSIG, judged by a parser that shares nothing with the package."""

import contextlib
import json
import re
import subprocess
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from support.dirsig_exports import BANDS, NM, library, specular_fraction, strict_ems
from support.folders import contents
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, StoreError
from hyperpaint.io.dirsig import open_emissivity, read_emissivity, read_materials


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
        with pytest.raises(SchemaError, match="value-missing"):
            hp.write_dirsig(paints, tmp_path / "refused", gaps="refuse")


def test_unmeasured_ends_are_left_away_and_holes_refused(tmp_path: Path) -> None:
    paints = library()
    for name in ("reflectance", "member_reflectance"):
        paints[name][..., 0] = np.nan
    paints = paints.assign_coords(good=("band", np.arange(BANDS) != BANDS - 1))
    hp.write_dirsig(paints, tmp_path / "ends")
    micrometres = strict_ems(tmp_path / "ends/emissivity/paint_0.ems")[1]
    np.testing.assert_allclose(micrometres, NM[1:-1] / 1000, atol=6e-8)
    paints = paints.assign_coords(good=("band", ~np.isin(np.arange(BANDS), [3, 4])))
    with pytest.raises(SchemaError, match="value-missing") as caught:
        hp.write_dirsig(paints, tmp_path / "holes", gaps="refuse")
    assert str(caught.value).count("'paint ") == 3  # all paints are told
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
    with pytest.raises(SchemaError, match="value-missing"):
        hp.write_dirsig(paints, tmp_path / "out", gaps="refuse")
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
    with pytest.raises(SchemaError, match="wavelength-uncovered"):
        hp.write_dirsig(paints, tmp_path / "out", wavelength_range=(380, 1100))
    made = hp.write_dirsig(
        paints, tmp_path / "out", wavelength_range=(np.float32(380), np.int64(1100)), extrapolate=True
    )
    _, micrometres, emissivity = strict_ems(tmp_path / "out/emissivity/paint_0.ems")
    assert (micrometres[0], micrometres[-1], len(micrometres)) == (0.38, 1.1, BANDS + 2)
    np.testing.assert_array_equal(emissivity[:, [0, -1]], emissivity[:, [1, -2]])
    assert made.extrapolated.values.tolist() == ["below and above"] * 3
    assert "below and above" in (tmp_path / "out/README.txt").read_text()
    assert made.range.values.tolist() == [[380.0, 1100.0]] * 3
    with pytest.raises(SchemaError, match="wavelength-uncovered"):
        hp.write_dirsig(paints, tmp_path / "far", wavelength_range=(1200, 1300), extrapolate=True)
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
    with pytest.raises(FormatError, match=r"bad\.mat"):
        hp.write_dirsig(library(), tmp_path / "three", scene_materials=tmp_path / "bad.mat")


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
        with pytest.raises(StoreError, match=message):
            hp.write_dirsig(library(), tmp_path / name, overwrite=True)
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
