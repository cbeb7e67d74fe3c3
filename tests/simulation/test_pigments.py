"""Car paints from a few parameters, and the catalogue of spectra."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

from hyperpaint.simulation.rendering.materials import Coat, base_albedo
from hyperpaint.simulation.rendering.scene_spectra import (
    CAR_PAINTS,
    FAMILIES,
    FINISHES,
    FOURTEEN,
    MATERIALS,
    SPECTRA,
    Pigments,
    generate_paint,
    paint_spec,
    spectrum_of,
)

GRID = np.arange(380.0, 1021.0, 1.0)
VISIBLE = (GRID > 430) & (GRID < 680)
INFRARED = GRID > 850


@given(st.sampled_from(FAMILIES), st.integers(0, 10**9 - 1))
@settings(max_examples=150)
def test_generated_paints_are_physical_and_smooth(family: str, number: int) -> None:
    paint = generate_paint(family, number)
    spectra = [paint.reflectance(GRID)]
    if paint.flakes is not None:
        spectra.append(spectrum_of(paint.flakes.spectrum)(GRID))
    for found in spectra:
        assert found.dtype == np.float64
        assert 0.0 < found.min() <= found.max() < 1.0
        # no step that a nanometre's sampling would miss
        assert np.abs(np.diff(found)).max() < 0.04
    assert paint.finish in FINISHES
    assert all((paint.trade_name, paint.colour))
    assert paint_spec(paint.name) == paint


@given(st.sampled_from(FAMILIES), st.integers(0, 10**6))
@settings(max_examples=30)
def test_a_number_is_one_paint(family: str, number: int) -> None:
    name = f"pigment:{family}:{number}"
    first = spectrum_of(name)(GRID)
    generate_paint.cache_clear()
    assert (spectrum_of(name)(GRID) == first).all()


def test_a_paint_is_the_same_in_another_process() -> None:
    code = (
        "import numpy as np\n"
        "from hyperpaint.simulation.rendering.scene_spectra import spectrum_of\n"
        "print(spectrum_of('pigment:tinted:5')(np.array([450.0, 650.0])).tobytes().hex())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == spectrum_of("pigment:tinted:5")(np.array([450.0, 650.0])).tobytes().hex()


def test_names_mean_the_same_next_year() -> None:
    # stored scenes name these; a change of the generator would repaint them
    for name, expected in {
        "pigment:solid:17": [0.2132, 0.0338, 0.0223, 0.5099],
        "pigment:pearl:17": [0.0219, 0.0248, 0.4804, 0.4805],
        "pigment:metallic:17:flakes": [0.8971, 0.6944, 0.5554, 0.8695],
    }.items():
        assert_allclose(spectrum_of(name)(np.array([450.0, 550.0, 650.0, 850.0])), expected, atol=5e-5)


def test_flakes_shine_through_the_tint_twice() -> None:
    # exp(-2 K d) with S d = 0.05: a K/S of 2 leaves exp(-0.2)
    clear, tinted = (Pigments(ratio).flakes(GRID) for ratio in (0.0, 2.0))
    assert_allclose(tinted / clear, np.exp(-0.2), rtol=1e-12)
    green, dip = np.searchsorted(GRID, [550.0, 825.0])
    assert (clear[green], clear[dip]) == (pytest.approx(0.92, abs=0.01), pytest.approx(0.87, abs=0.01))


def test_the_base_under_the_coat_is_the_kubelka_munk_layer() -> None:
    for family in FAMILIES:
        paint = generate_paint(family, 3)
        assert_allclose(
            base_albedo(paint.reflectance(GRID), Coat().index), paint.pigments.albedo(GRID), rtol=1e-10
        )


def test_kubelka_munk() -> None:
    # K/S = (1 - R)^2 / 2 R by its definition
    for ratio in (0.001, 0.5, 20.0):
        albedo = Pigments(ratio).albedo(np.array([500.0]))[0]
        assert (1.0 - albedo) ** 2 / (2.0 * albedo) == pytest.approx(ratio, rel=1e-9)


class TestFamilies:
    def spectra(self, family: str) -> np.ndarray:
        return np.stack([generate_paint(family, number).reflectance(GRID) for number in range(40)])

    def test_families_look_as_they_are_called(self) -> None:
        found = {family: self.spectra(family) for family in FAMILIES}
        seen = {family: spectra[:, VISIBLE] for family, spectra in found.items()}
        assert seen["white"].min() > 0.6
        assert found["carbon_black"].max() < 0.06
        assert seen["ir_black"].max() < 0.05 < 0.15 < found["ir_black"][:, INFRARED].min()
        assert (np.ptp(seen["grey"], axis=1) / seen["grey"].mean(axis=1)).max() < 0.1
        assert seen["tinted"].mean() > 1.5 * seen["solid"].mean()

    def test_only_metallic_and_pearl_have_flakes(self) -> None:
        for family in FAMILIES:
            paint = generate_paint(family, 1)
            assert (paint.flakes is not None) == (family in ("metallic", "pearl"))
            assert paint.finish == (family if paint.flakes else "solid")

    @pytest.mark.parametrize("family", FAMILIES)
    def test_there_is_variety(self, family: str) -> None:
        found = self.spectra(family)
        apart = np.sqrt(((found[:, None] - found[None]) ** 2).mean(axis=2))
        assert (apart + np.eye(len(found)) > 1e-6).all()
        if family in ("solid", "tinted", "metallic", "pearl"):
            assert np.median(apart) > 0.08
            assert len({generate_paint(family, number).colour for number in range(40)}) >= 6

    def test_pearl_flakes_have_an_interference_colour(self) -> None:
        pearl = generate_paint("pearl", 2).pigments
        assert pearl.interference is not None
        thickness, depth = pearl.interference
        plain = Pigments(pearl.absorption, pearl.absorbers)
        expected = 1.0 - depth * np.cos(2.0 * np.pi * thickness / GRID) ** 2
        assert_allclose(pearl.flakes(GRID) / plain.flakes(GRID), expected, rtol=1e-12)


class TestFourteen:
    def test_they_are_fourteen_and_differ(self) -> None:
        assert len(set(FOURTEEN)) == 14
        found = np.stack([spectrum_of(name)(GRID) for name in FOURTEEN])
        assert 0.0 < found.min() <= found.max() < 1.0
        assert (np.sqrt(((found[:, None] - found[None]) ** 2).mean(axis=2)) + np.eye(14)).min() > 0.03
        assert {paint_spec(name).finish for name in FOURTEEN} <= set(FINISHES)

    def test_they_look_as_they_are_called(self) -> None:
        at = dict(
            zip(
                ("blue", "green", "red", "infrared"), np.searchsorted(GRID, [460, 540, 650, 900]), strict=True
            )
        )
        found = {name: {k: spectrum_of(name)(GRID)[i] for k, i in at.items()} for name in FOURTEEN}
        for name, bright, factor, dark in (
            ("red", "red", 5, "green"), ("blue", "blue", 3, "red"), ("green", "green", 2, "blue"),
            ("green", "green", 2, "red"), ("yellow", "green", 5, "blue"),
        ):  # fmt: skip
            assert found[name][bright] > factor * found[name][dark]
        assert found["beige"]["red"] > found["beige"]["green"] > found["beige"]["blue"] > 0.1
        assert 0.05 < found["brown"]["red"] < 0.2
        assert found["ir_black"]["infrared"] > 10 * found["ir_black"]["red"]
        assert found["black"]["infrared"] < 0.05

    def test_material(self) -> None:
        silver = paint_spec("silver").material("paint of car_007")
        assert (silver.name, silver.spectrum, silver.kind) == ("paint of car_007", "silver", "paint")
        assert silver.coat == Coat()
        assert silver.flakes is not None
        assert paint_spec("red").material().flakes is None


class TestCatalogue:
    @pytest.mark.parametrize("name", [*SPECTRA, "pigment:solid:17", "pigment:metallic:4:flakes"])
    def test_every_spectrum_is_a_reflectance_from_the_ultraviolet_on(self, name: str) -> None:
        found = spectrum_of(name)(np.arange(300.0, 2501.0))
        assert (found.shape, found.dtype) == ((2201,), np.float64)
        assert ((found >= 0.0) & (found <= 1.0)).all()

    def test_any_shape(self) -> None:
        assert spectrum_of("red")(np.full((2, 3), 500.0)).shape == (2, 3)
        assert spectrum_of("panel_50")(np.array(500)) == 0.5

    def test_paints_come_without_the_first_reflection(self) -> None:
        for name, paint in CAR_PAINTS.items():
            assert_allclose(spectrum_of(name)(GRID), paint(GRID) - 0.04, rtol=1e-12)

    def test_everything_of_the_simulator_is_there(self) -> None:
        assert set(MATERIALS) | set(FOURTEEN) <= set(SPECTRA)
        assert {"aluminium", "leaf", "brick", "lamp_red", "lamp_clear", "trim"} <= set(SPECTRA)
