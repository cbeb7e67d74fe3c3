"""Every library that hyperpaint writes is rendered as it is."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.traced_scenes import SUN, flat_light, flight, two_cars

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError
from hyperpaint.paints import starter_library
from hyperpaint.simulation.rendering.camera_bands import BandSet
from hyperpaint.simulation.rendering.painting import by_name, factor_spectra
from hyperpaint.simulation.rendering.scene_record import SceneRecord
from hyperpaint.workflows.scene_files import read_paints, read_spectra, spectra_digest

BANDS = BandSet(np.linspace(420.0, 980.0, 29), np.array(6.0))
NAMES = ["red, matt", "Türkis", "white"]

Write = Callable[[xr.Dataset, Path], Path]


def library() -> xr.Dataset:
    # Return three paints with populations
    paints = starter_library(members=4).isel(signature=[5, 9, 0])
    return paints.assign_coords(signature=("signature", np.array(NAMES, object)))


def export(**options: str) -> Write:
    def write(paints: xr.Dataset, place: Path) -> Path:
        return hp.write_library(paints, place, **options)

    return write


def dirsig(part: str, **options: str) -> Write:
    def write(paints: xr.Dataset, place: Path) -> Path:
        hp.write_dirsig(paints, place, **options)
        return place / part

    return write


@pytest.mark.parametrize(
    ("name", "write", "paints"),
    [
        ("x.zarr", export(), NAMES),
        ("x.sli", export(), NAMES),
        ("x.sli", export(curves="all"), NAMES),
        ("x.csv", export(), NAMES),
        ("x", dirsig(""), NAMES),
        ("x", dirsig("materials.mat"), NAMES),
        ("x", dirsig("materials.mat", surface="SimpleReflectance"), NAMES),
        ("x", dirsig("emissivity/Tuerkis.ems"), ["Tuerkis"]),
        ("x", dirsig("reflectance/Tuerkis.txt"), ["Tuerkis"]),
    ],
)
def test_every_export_gives_its_paints_back(
    tmp_path: Path, name: str, write: Write, paints: list[str]
) -> None:
    truth = library()
    path = write(truth, tmp_path / name)
    read = by_name(read_paints(path))
    assert sorted(read) == sorted(paints)
    record = SceneRecord.of(two_cars())
    for paint, place in zip(paints, [1] if len(paints) == 1 else range(3), strict=True):
        spectra = factor_spectra(record, BANDS, {"car_0": paint}, read)
        one = truth.isel(signature=place)
        # the curves of a single .ems have no centre but their mean
        centre = one.member_reflectance.mean("member") if "ems" in str(path) else one.reflectance
        expected = factor_spectra(record, BANDS, {"car_0": "it"}, {"it": centre})
        nm = np.arange(420.0, 981.0)
        np.testing.assert_allclose(spectra(nm), expected(nm), atol=1.5e-6)


def test_a_library_in_spectra_names_its_paints_behind_its_own(tmp_path: Path) -> None:
    hp.write_library(library(), tmp_path / "x.zarr")
    mine = {"mine": read_spectra(tmp_path / "x.zarr")}
    record = SceneRecord.of(two_cars())
    assert "mine/Türkis" in factor_spectra(record, BANDS, {"red": "mine/Türkis"}, mine).names
    with pytest.raises(SchemaError, match="spectrum-unknown"):
        factor_spectra(record, BANDS, {"red": "mine"}, mine)
    one = {"mine": library().isel(signature=[1])}
    assert "mine" in factor_spectra(record, BANDS, {"red": "mine"}, one).names


def test_a_digest_follows_every_value() -> None:
    paints = library()
    other = paints.copy(deep=True)
    other.member_reflectance[2, 3, 7] += 0.01
    plain = np.array([400.0, 900.0]), np.array([0.2, 0.3])
    digests = {spectra_digest(one) for one in ({"a": paints}, {"a": other}, {"b": paints}, {"a": plain})}
    assert (len(digests), spectra_digest({"a": paints})) == (4, spectra_digest({"a": paints.copy(deep=True)}))


def test_bands_without_values_are_named_and_held_on_request() -> None:
    paints = library().isel(signature=[0])
    nm = paints.wavelength.values
    hole = (nm < 430.0) | ((nm > 755.0) & (nm < 765.0))
    paints["reflectance"] = paints.reflectance.where(xr.DataArray(~hole, dims="band"))
    record = SceneRecord.of(two_cars())
    with pytest.raises(SchemaError) as caught:
        factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints)
    assert caught.value.codes == ("spectrum-coverage", "not-finite")
    assert "424.4 to 428.8, 756.5 to 763.1 nm" in caught.value.problems[1].found
    held = factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints, hold_edges=True)
    known = np.interp(np.array([425.0, 760.0]), nm[~hole], paints.reflectance.values[0][~hole])
    np.testing.assert_allclose(held.spectra["red, matt"](np.array([425.0, 760.0])), known, rtol=1e-6)
    short = paints.isel(band=slice(60, 200))
    with pytest.raises(SchemaError, match="spectrum-coverage"):
        factor_spectra(record, BANDS, {"car_0": "red, matt"}, short)
    bad = library().isel(signature=[0]).assign_coords(good=("band", nm < 900.0))
    with pytest.raises(SchemaError, match="not-finite"):
        factor_spectra(record, BANDS, {"car_0": "red, matt"}, bad)


def test_what_may_mislead_is_said() -> None:
    paints = library()
    paints["reflectance"] = paints.reflectance - 0.06
    paints.reflectance.attrs = {"units": "1", "mirror_reflection": "included"}
    record = SceneRecord.of(two_cars())
    with pytest.warns(PaintWarning) as caught:
        factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints)
    texts = [str(one.message) for one in caught]
    assert any("reflectance-clipped" in text for text in texts)
    assert any("mirror-counted-twice" in text for text in texts)


def test_a_library_paints_the_cars_of_a_traced_scene() -> None:
    traced = hp.simulation.trace(two_cars(), flight(), [SUN], samples=4).compute()
    paints = library().isel(signature=[0, 1])
    dealt = traced.paint.relight(BANDS, paints=paints, atmosphere=flat_light()).radiance
    named = traced.paint.relight(
        BANDS, paints={"car_0": "red, matt", "car_1": "Türkis"}, spectra=paints, atmosphere=flat_light()
    ).radiance
    np.testing.assert_array_equal(dealt.values, named.values)
    with pytest.raises(SchemaError, match="paint-ambiguous"):
        traced.paint.relight(BANDS, paints=library().isel(signature=[0, 0]), atmosphere=flat_light())


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("nothing here\n")
    with pytest.raises(FormatError, match="table-missing"):
        read_spectra(tmp_path / "x.csv")
    hp.write_dirsig(library(), tmp_path / "d")
    (tmp_path / "d" / "emissivity" / "Tuerkis.ems").unlink()
    with pytest.raises(FormatError, match="file-not-found"):
        read_paints(tmp_path / "d")


SCENE = """\
[scene]
kind = "car_park"
length_m = 5
width_m = 16
margin_m = 5
neighbours = []
[platform]
lines = 16
columns = 16
ground_sample_m = 0.8
[camera]
bands = 6
fwhm_nm = 30
first_wavelength_nm = 450
last_wavelength_nm = 900
[sampling]
samples = 2
[spectra]
mine = "x.zarr"
[paints]
car_001 = "mine/white"
"""


@pytest.mark.slow  # the tracer is compiled
def test_render_takes_a_library_and_traces_once(tmp_path: Path) -> None:
    hp.write_library(library(), tmp_path / "x.zarr")
    (tmp_path / "scene.toml").write_text(SCENE)
    arguments = ["render", str(tmp_path / "scene.toml"), "--quiet"]
    hyperpaint(*arguments, status=0)
    again = hyperpaint(*arguments, "--library", tmp_path / "x.zarr", "--overwrite", status=0)
    assert "transport" in again.output
    line = hp.open_store(tmp_path / "scene.zarr", "renders/noon")
    painted = dict(zip(line.paint_id.flag_values, line.paint_id.flag_meanings.split(), strict=True))
    shown = {painted[number] for number in np.unique(line.paint_id) if number >= 0}
    assert {"mine/white", "white"} & shown
    assert shown & {"red,_matt", "Türkis"}
