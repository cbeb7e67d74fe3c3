"""A scene of triangles for DIRSIG: every file reads back, every name leads somewhere."""

import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from oracles.fresnel import plain_fresnel
from support.dirsig_exports import strict_ems
from support.folders import contents
from support.refusals import expect_errors

from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.io.dirsig import read_materials, write_dirsig_scene
from hyperpaint.io.dirsig.dirsig_writing import texture_picture
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Coat, Material, fresnel_reflectance
from hyperpaint.simulation.rendering.mesh_files import parse_obj
from hyperpaint.simulation.rendering.scene import Instance, Scene
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of

NM = np.arange(396.0, 1005.0, 4.0)
UNITS = {"units": "1"}


def library(names: list[str], members: int = 0, **attrs: Any) -> xr.Dataset:
    # Return the simulator's own spectra as a library, with members of other brightness where asked.
    values = np.stack([spectrum_of(name)(NM) for name in names]).astype(np.float32)
    variables: dict[str, Any] = {"reflectance": (("signature", "band"), values, {**UNITS, **attrs})}
    if members:
        level = np.random.default_rng(1).uniform(0.7, 1.0, (len(names), members, 1))
        population = (values[:, None] * level).astype(np.float32)
        variables["member_reflectance"] = (("signature", "member", "band"), population, UNITS)
    return xr.Dataset(variables, {"signature": names, "wavelength": ("band", NM, {"units": "nm"})})


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
def written(park: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, xr.Dataset]:
    names = sorted({material.spectrum for material in park.materials})
    folder = tmp_path_factory.mktemp("dirsig") / "park"
    paints = library(names, 100, mirror_reflection="excluded")
    return folder, write_dirsig_scene(park, folder, paints, max_curves=16)


def test_the_geometry_reads_back_with_its_materials(park: Scene, written: tuple[Path, xr.Dataset]) -> None:
    folder, summary = written
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


def test_the_geometry_reads_in_another_program(park: Scene, written: tuple[Path, xr.Dataset]) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(written[0] / "geometry/objects/car_park.obj", process=False, force="scene")
    parts = list(mesh.geometry.values())
    assert sum(len(part.faces) for part in parts) == len(park.faces)
    assert sum(part.area for part in parts) == pytest.approx(float(park.area.sum()), rel=1e-5)
    np.testing.assert_allclose(mesh.bounds, park.bounds, atol=1e-6)


def test_every_name_leads_somewhere(written: tuple[Path, xr.Dataset]) -> None:
    folder, summary = written
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


def test_the_readme_says_what_was_checked(written: tuple[Path, xr.Dataset]) -> None:
    text = (written[0] / "README.txt").read_text()
    parts = ('features "vis,nir"', "docs/new/glist.html", "tahoe.scene", "Not checked", "Ward")
    assert [part for part in (*parts, "DIRSIG itself has not run") if part not in text] == []
    assert max(map(len, text.splitlines())) <= 120


def picture_of(folder: Path, name: str) -> NDArray[np.uint8]:
    data = (folder / "maps" / name).read_bytes()
    head = re.match(rb"P5\n(\d+) (\d+)\n255\n", data)
    assert head is not None
    width, height = map(int, head.groups())
    return np.frombuffer(data[head.end() :], np.uint8).reshape(height, width)


def test_a_texture_draws_its_population(written: tuple[Path, xr.Dataset]) -> None:
    folder, summary = written
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
    measured = write_dirsig_scene(boxes(), tmp_path / "out", library(["red", "asphalt"]))
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
    paints = library(["red", "asphalt"], mirror_reflection="excluded")
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
        [fit["LAMBDA"] for fit in fits], NM / 1000.0, paints.reflectance.sel(signature="red").values
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
    write_dirsig_scene(boxes(), tmp_path / "out", library(["red", "asphalt"]))
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
    paints = library(["red", "asphalt", "blue", "white"])
    repaint = {"car zwölf": "blue", "asphalt": "white"}
    summary = write_dirsig_scene(boxes(), tmp_path / "out", paints, repaint=repaint)
    assert sorted(summary["signature"].values) == ["blue", "red", "white"]
    text = (tmp_path / "out/geometry/objects/Two_cars_Ae.obj").read_text()
    assert re.findall(r"^(?:o|usemtl) (.+)$", text, re.MULTILINE) == [
        "car one", "red", "ground", "white", "car zwoelf", "blue",
    ]  # fmt: skip


def test_the_first_library_counts(tmp_path: Path) -> None:
    mine = library(["red"], 30)
    mine = mine.assign(reflectance=mine.reflectance * 0.5, member_reflectance=mine.member_reflectance * 0.5)
    for name in ("reflectance", "member_reflectance"):
        mine[name].attrs = UNITS
    summary = write_dirsig_scene(boxes(), tmp_path / "out", [mine, library(["red", "asphalt"])])
    assert dict(zip(summary["signature"].values, summary.curves.values, strict=True)) == {
        "red": 30,
        "asphalt": 1,
    }
    _, micrometre, curves = strict_ems(tmp_path / "out/materials/emissivity/red.ems")
    assert (1.0 - curves).max() <= 0.51 * float(library(["red"]).reflectance.max())
    assert len(micrometre) == len(NM)


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
    with pytest.raises(SchemaError) as caught:
        write_dirsig_scene(boxes(), tmp_path / "out", library(["red"]), **options)
    assert [message for message in messages if message not in str(caught.value)] == []
    assert not list(tmp_path.iterdir())


def test_a_bad_element_stops_nothing(tmp_path: Path) -> None:
    paints = library(["red", "asphalt"], 20)
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
    paints = library(["red", "asphalt"], 5)
    write_dirsig_scene(boxes(), tmp_path / "out", paints)
    before = contents(tmp_path / "out")
    expect_errors((StoreError, "overwrite", lambda: write_dirsig_scene(boxes(), tmp_path / "out", paints)))
    write_dirsig_scene(boxes(), tmp_path / "out", paints, overwrite=True)
    assert contents(tmp_path / "out") == before  # the same bytes
