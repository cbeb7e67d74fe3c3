"""What is said of a scene to Mitsuba; none of it needs Mitsuba."""

import functools
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from oracles.mitsuba_scenes import FrameCamera, to_mitsuba
from support.refusals import expect_error, expect_words

from hyperpaint.base.errors import MissingExtraError, PaintWarning, SchemaError
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material, base_albedo
from hyperpaint.simulation.rendering.scene import Scene, plane


@functools.cache
def noon() -> Atmosphere:
    # Return an even sky
    return replace(Atmosphere.clear(30.0, 90.0, haze=None), clear_shares=None)


GREY = Material("grey", "panel_20", "panel")


class Transform:
    # As much of Mitsuba's transform as is used: it remembers what it was asked for
    def look_at(self, **asked: Any) -> dict[str, Any]:
        return asked


@pytest.fixture(autouse=True)
def mitsuba(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    module = SimpleNamespace(variant=lambda: "scalar_spectral", ScalarTransform4f=Transform)
    monkeypatch.setitem(sys.modules, "mitsuba", module)
    return module


def numbers(text: str) -> np.ndarray:
    return np.array([float(number) for number in text.split(",")])


def test_keys_of_a_plane(tmp_path: Path) -> None:
    described = to_mitsuba(plane(4.0, GREY), noon(), tmp_path, wavelength=[450.0, 650.0], depth=3, samples=7)
    assert set(described) == {"type", "integrator", "sensor", "sun", "sky", "grey", "mesh of grey"}
    assert (described["integrator"]["max_depth"], described["sensor"]["sampler"]["sample_count"]) == (4, 7)
    assert described["mesh of grey"]["surface"] == {"type": "ref", "id": "grey"}
    assert described["grey"]["type"] == "twosided"
    np.testing.assert_allclose(numbers(described["grey"]["surface"]["reflectance"]["values"]), 0.2)


def test_the_sun_shines_from_where_it_stands(tmp_path: Path) -> None:
    described = to_mitsuba(plane(4.0, GREY), noon(), tmp_path, wavelength=[550.0])
    np.testing.assert_allclose(described["sun"]["direction"], [-0.5, 0.0, -np.sqrt(0.75)], atol=1e-12)
    wavelength, values = (numbers(described["sky"]["radiance"][key]) for key in ("wavelengths", "values"))
    assert wavelength[0] <= 550.0 - 12.0
    assert wavelength[-1] >= 550.0 + 12.0
    np.testing.assert_allclose(
        values, np.interp(wavelength, noon().wavelength, noon().sky) / np.pi, rtol=1e-6
    )


def test_light_that_is_not_there_is_left_out(tmp_path: Path) -> None:
    with pytest.warns(PaintWarning, match="sky-uniform"):
        described = to_mitsuba(plane(4.0, GREY), noon().clouded(8.0), tmp_path, wavelength=[550.0])
    assert "sun" not in described
    assert "sky" in described


def test_responses_have_the_area_one_and_the_width_asked_for(tmp_path: Path) -> None:
    film = to_mitsuba(plane(4.0, GREY), noon(), tmp_path, wavelength=[450.0, 650.0], fwhm=8.0)["sensor"][
        "film"
    ]
    bands = [film[name] for name in sorted(film) if name.startswith("band_")]
    assert len(bands) == 2
    for centre, band in zip((450.0, 650.0), bands, strict=True):
        wavelength, values = numbers(band["wavelengths"]), numbers(band["values"])
        assert np.trapezoid(values, wavelength) == pytest.approx(1.0, rel=1e-6)
        assert wavelength[values > values.max() / 2].min() == pytest.approx(centre - 4.0, abs=0.4)
        assert np.average(wavelength, weights=values) == pytest.approx(centre)


def test_what_lies_under_a_coat_is_its_base(tmp_path: Path) -> None:
    smooth = Material("smooth", "panel_20", "paint", Coat(1.4, 0.01))
    rough = Material("rough", "panel_20", "paint", Coat(1.4, 0.1))
    scene = Scene.join([plane(4.0, smooth, instance="a"), plane(4.0, rough, instance="b")], "coats")
    described = to_mitsuba(scene, noon(), tmp_path, wavelength=[550.0])
    for name, kind in (("smooth", "plastic"), ("rough", "roughplastic")):
        surface = described[name]["surface"]
        assert surface["type"] == kind
        assert surface["nonlinear"]
        np.testing.assert_allclose(
            numbers(surface["diffuse_reflectance"]["values"]), base_albedo(0.2, 1.4), rtol=1e-6
        )
    assert described["rough"]["surface"]["alpha"] == 0.1


def test_flakes_become_metal_beside_the_base(tmp_path: Path) -> None:
    paint = Material("silver", "silver", "paint", Coat(), Flakes(0.4, 0.3))
    with pytest.warns(PaintWarning, match="flakes-as-metal"):
        described = to_mitsuba(plane(4.0, paint), noon(), tmp_path, wavelength=[550.0])
    surface = described["silver"]["surface"]
    assert (surface["weight"], surface["flakes"]["alpha"]) == (0.4, 0.3)


def test_paints_and_spectra_are_those_of_relight(tmp_path: Path) -> None:
    options: dict[str, Any] = {"wavelength": [550.0], "spectra": {"mine": ([400.0, 900.0], [0.3, 0.3])}}
    described = to_mitsuba(plane(4.0, GREY), noon(), tmp_path, paints={"grey": "mine"}, **options)
    np.testing.assert_allclose(numbers(described["grey"]["surface"]["reflectance"]["values"]), 0.3)


def test_meshes_hold_the_triangles_with_a_normal_at_every_corner(tmp_path: Path) -> None:
    lower = plane(2.0, GREY)
    corners = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    tilted = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
    smooth = Scene.from_arrays(corners, [[0, 1, 2]], Material("red", "red", "paint"), normals=tilted)
    described = to_mitsuba(Scene.join([lower, smooth], "two"), noon(), tmp_path, wavelength=[550.0])
    for name, points, normals in (
        ("grey", lower.vertices[lower.faces].reshape(-1, 3), np.tile([0.0, 0.0, 1.0], (6, 1))),
        ("red", corners, tilted),
    ):
        header, body = Path(described[f"mesh of {name}"]["filename"]).read_bytes().split(b"end_header\n", 1)
        assert f"element vertex {len(points)}\n".encode() in header
        table = np.frombuffer(body, "<f4", 6 * len(points)).reshape(-1, 6)
        np.testing.assert_allclose(table, np.hstack([points, normals]), atol=1e-6)
        listed = np.frombuffer(body, [("count", "u1"), ("corner", "<i4", 3)], offset=table.nbytes)
        assert listed["corner"].ravel().tolist() == list(range(len(points)))


def test_all_that_cannot_be_said_is_listed(tmp_path: Path) -> None:
    scene = plane(4.0, Material("paint no. 7", "panel_20", "paint"))
    with pytest.raises(SchemaError) as caught:
        to_mitsuba(scene, noon(), tmp_path / "new", wavelength=[650.0, 550.0], fwhm=0.0, samples=0)
    expect_words(str(caught.value), "wavelength-unordered", "fwhm is 0.0", "samples=0", "name-reserved")
    assert not (tmp_path / "new").exists()
    expect_error(
        SchemaError,
        "spectrum-unknown",
        lambda: to_mitsuba(plane(4.0, GREY), noon(), tmp_path, wavelength=[550.0], paints={"grey": "puce"}),
    )


@pytest.mark.parametrize("variant", [None, "scalar_rgb"])
def test_a_variant_without_spectra_is_refused(
    tmp_path: Path, mitsuba: SimpleNamespace, variant: str | None
) -> None:
    mitsuba.variant = lambda: variant
    expect_error(
        SchemaError,
        "variant-unsuitable",
        lambda: to_mitsuba(plane(4.0, GREY), noon(), tmp_path, wavelength=[550.0]),
    )


def test_without_mitsuba_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    expect_error(
        MissingExtraError,
        r"hyperpaint\[oracles\]",
        lambda: to_mitsuba(plane(4.0, GREY), noon(), tmp_path, wavelength=[550.0], camera=FrameCamera()),
    )
