"""Surfaces under a clear coat, their gloss and flop, and leaves that pass light."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from oracles.fresnel import plain_fresnel
from scipy.integrate import quad
from support.refusals import expect_error
from support.traced_scenes import FEW_BANDS, flat_light

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import (
    Coat,
    Flakes,
    Material,
    base_albedo,
    coat_of_gloss,
    coated_reflectance,
    flakes_of_flop,
    flop_index,
    fresnel_reflectance,
    gloss_units,
    hemispherical_reflectance,
    internal_reflectance,
    measured_factor,
    reflectance_factor,
)
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.relighting import trace
from hyperpaint.simulation.rendering.scene import Scene, plane
from hyperpaint.simulation.rendering.scene_spectra import (
    LEAF_INDEX,
    Paint,
    PaintSpec,
    leaf_optics,
    paint_spec,
    spectrum_of,
)
from hyperpaint.simulation.transport.path_codes import is_direct, is_indirect, is_mirrored

# --- materials ---

GEOMETRIES = ("0/0", "0/45", "d/0")
INDICES = st.floats(1.05, 2.6)


def effective_factor(albedo: np.ndarray, index: float) -> np.ndarray:
    # Return rho' = b (1 - Fi) / (1 - b Fi) of a base of albedo b under a coat
    back = internal_reflectance(index)
    return np.asarray(albedo * (1.0 - back) / (1.0 - albedo * back))


class TestFresnel:
    @given(st.floats(0.01, 1.5), INDICES)
    def test_equals_the_form_by_angles(self, angle: float, index: float) -> None:
        assert_allclose(fresnel_reflectance(np.cos(angle), index), plain_fresnel(angle, index), rtol=1e-9)

    def test_brewsters_angle_and_known_values(self) -> None:
        assert_allclose(
            fresnel_reflectance(np.cos(np.arctan(1.5)), 1.5), 0.5 * ((1 - 2.25) / (1 + 2.25)) ** 2
        )
        assert fresnel_reflectance(1.0, 1.5) == pytest.approx(0.04, abs=1e-15)
        # Judd (1942), table for diffuse light: 0.0918 from outside, 0.5963 from within
        assert hemispherical_reflectance(1.5) == pytest.approx(0.0918, abs=5e-5)
        assert internal_reflectance(1.5) == pytest.approx(0.5963, abs=5e-5)

    @given(INDICES)
    def test_the_closed_form_is_the_integral(self, index: float) -> None:
        integral = quad(lambda u: 2.0 * u * float(fresnel_reflectance(u, index)), 0.0, 1.0)[0]
        assert_allclose(hemispherical_reflectance(index), integral, rtol=1e-6)

    @given(st.floats(1.2, 2.2))
    @settings(max_examples=10)
    def test_internal_reflectance_is_the_integral_from_within(self, index: float) -> None:
        def inside(u: float) -> float:
            sine = index * np.sqrt(1.0 - u**2)
            return 2.0 * u * (1.0 if sine >= 1.0 else plain_fresnel(np.arcsin(sine), index))

        critical = np.sqrt(1.0 - 1.0 / index**2)
        total = quad(inside, 0.0, critical)[0] + quad(inside, critical, 1.0, limit=200)[0]
        assert_allclose(internal_reflectance(index), total, rtol=1e-5)


class TestCoatedBase:
    def brdf(self, albedo: float, index: float, cos_in: float, cos_out: float) -> float:
        # Return the diffuse BRDF by adding the returns of light one after the other
        returned = internal_reflectance(index)
        inside = sum(albedo * (albedo * returned) ** k for k in range(2000))
        leaving = 1.0 - float(fresnel_reflectance(cos_out, index))
        return (1.0 - float(fresnel_reflectance(cos_in, index))) * leaving * inside / (np.pi * index**2)

    @pytest.mark.parametrize("albedo", [0.02, 0.5, 0.97])
    @pytest.mark.parametrize("index", [1.3, 1.5, 1.8])
    def test_reads_the_brdf_near_normal_and_at_45_degrees(self, albedo: float, index: float) -> None:
        for geometry, cosine in (("0/0", 1.0), ("0/45", np.sqrt(0.5))):
            read = coated_reflectance(albedo, index, geometry=geometry)
            assert_allclose(read, np.pi * self.brdf(albedo, index, 1.0, cosine), rtol=1e-10)

    def test_a_sphere_reads_the_brdf_averaged_over_the_light(self) -> None:
        mean = quad(lambda u: 2.0 * u * np.pi * self.brdf(0.6, 1.5, 1.0, u), 0.0, 1.0)[0]
        assert_allclose(coated_reflectance(0.6, geometry="d/0"), mean, rtol=1e-6)
        # which is less than near normal
        assert (coated_reflectance(0.4, geometry="d/0") / coated_reflectance(0.4)) == pytest.approx(
            0.946, abs=5e-4
        )
        # with the mirror reflection it is Saunderson's correction
        grid = np.array([500.0])
        read = coated_reflectance(
            Paint(0.3, interface=0.0, internal=0.0)(grid), geometry="d/0", specular_included=True
        )
        assert_allclose(
            read, Paint(0.3, interface=0.04, internal=internal_reflectance(1.5))(grid), rtol=1e-12
        )

    @pytest.mark.parametrize("cosine", [1.0, 0.5, 0.1])
    def test_a_white_base_gives_all_light_back(self, cosine: float) -> None:
        diffuse = quad(lambda u: 2.0 * np.pi * u * self.brdf(1.0, 1.5, cosine, u), 0.0, 1.0)[0]
        assert diffuse + float(fresnel_reflectance(cosine)) == pytest.approx(1.0, abs=1e-6)

    def test_what_the_tracer_leaves_out_is_the_effective_factor(self) -> None:
        albedo, index = np.linspace(0.0, 1.0, 11), 1.5
        geometric = (1.0 - 0.04) ** 2 / (index**2 * (1.0 - internal_reflectance(index)))
        factor = effective_factor(albedo, index)
        assert_allclose(geometric * factor, coated_reflectance(albedo, index), atol=1e-15)
        assert (factor[0], factor[-1]) == (0.0, pytest.approx(1.0))


class TestInversion:
    @pytest.mark.parametrize("geometry", GEOMETRIES)
    @given(st.floats(0.0, 0.95), st.floats(1.1, 2.0))
    def test_round_trip(self, geometry: str, measured: float, index: float) -> None:
        measured *= min(1.0, float(coated_reflectance(1.0, index, geometry=geometry)))
        albedo = base_albedo(measured, index, geometry=geometry)
        assert 0.0 <= albedo <= 1.0
        assert coated_reflectance(albedo, index, geometry=geometry) == pytest.approx(measured, abs=1e-12)
        assert effective_factor(albedo, index) == pytest.approx(
            float(measured_factor(measured, index, geometry=geometry)), abs=1e-12
        )

    def test_the_formula_of_the_contract_its_ends_and_beyond(self) -> None:
        measured, index = np.array([0.05, 0.3, 0.8]), 1.5
        q = measured * index**2 / (1.0 - 0.04) ** 2
        assert_allclose(base_albedo(measured, index), q / (1.0 + q * internal_reflectance(index)), rtol=1e-14)
        # a Lambert surface is its reflectance, and white is within reach
        assert_allclose(measured_factor([0.0, 0.3, 1.0], None), [0.0, 0.3, 1.0], atol=0)
        assert base_albedo(1.0) < 1.0
        assert float(coated_reflectance(1.0)) == pytest.approx(1.01473, abs=1e-5)
        assert (base_albedo([]).shape, base_albedo(np.float32([0.5])).dtype) == ((0,), np.float64)
        # what no surface can have is clamped with a warning
        with pytest.warns(PaintWarning, match="2 of 3.*reflectance-clipped"):
            factor = measured_factor([-0.01, 0.5, 1.2])
        assert factor[[0, 2]].tolist() == [0.0, 1.0]

    @pytest.mark.parametrize("geometry", ["0/0", "d/0"])
    def test_the_mirror_reflection_is_taken_off(self, geometry: str) -> None:
        assert base_albedo(0.34, geometry=geometry, specular_included=True) == pytest.approx(
            float(base_albedo(0.30, geometry=geometry))
        )


@pytest.mark.parametrize("measured", [0.05, 0.5, 0.9])
def test_the_tracer_sees_what_was_measured(measured: float) -> None:
    # the weight of sunlight scattered once by the base, times its factor, near normal
    paint = Material("paint", "red", "paint", Coat())
    traced = trace(
        plane(100.0, paint), pushbroom(2, 3, altitude=50.0), [(2.0, 180.0)], samples=4, sun_radius=0.0
    )
    traced = traced.compute()
    codes = traced.transport_path.values
    base = is_direct(codes) & ~is_mirrored(codes) & ~is_indirect(codes) & (codes >= 0)
    weight = np.where(base, traced.transport_weight.values, 0.0).sum(axis=1)
    assert_allclose(weight * measured_factor(measured) / np.cos(np.radians(2.0)), measured, rtol=1e-5)


VISIBLE = np.array([380.0, 780.0])


def glossmeter(coat: Coat, steps: int = 75) -> float:
    # Return gloss units by a sum of the BRDF over receptor and source: ISO 2813 at 20 degrees, flat coat
    # GGX in tangents and Fresnel by Snell's angles, of directions on a grid: nothing of the package
    angle = np.radians(20.0)
    half = 0.5 * np.radians([1.8, 3.6])
    a, b = (((np.arange(steps * k) + 0.5) / (steps * k) * 2 - 1) * h for k, h in ((2, half[0]), (4, half[1])))
    a, b = (part.ravel() for part in np.meshgrid(a, b, indexing="ij"))
    seen = np.stack([np.sin(angle + a) * np.cos(b), np.sin(b), np.cos(angle + a) * np.cos(b)], axis=1)
    cell = np.cos(b) * (2 * half[0] / (2 * steps)) * (2 * half[1] / (4 * steps))

    flux, count = 0.0, 7
    for i in range(count):
        for j in range(count):
            c, d = (((k + 0.5) / count - 0.5) * np.radians(width) for k, width in ((i, 0.75), (j, 2.5)))
            light = np.array([-np.sin(angle + c) * np.cos(d), -np.sin(d), np.cos(angle + c) * np.cos(d)])
            normal = seen + light
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            tan2 = (1 - normal[:, 2] ** 2) / normal[:, 2] ** 2
            density = coat.roughness**2 / (np.pi * normal[:, 2] ** 4 * (coat.roughness**2 + tan2) ** 2)
            mirrored = plain_fresnel(np.arccos(normal @ light), coat.index)
            brdf = mirrored * density / (4 * light[2] * seen[:, 2])
            flux += float((brdf * seen[:, 2] * cell).sum()) / count**2
    return 100.0 * flux / float(plain_fresnel(angle, 1.567))


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.004, 0.01, 0.05])
def test_gloss_is_the_flux_into_the_receptor(roughness: float) -> None:
    flat = Coat(1.5, roughness, 0.0)
    assert gloss_units(flat) == pytest.approx(glossmeter(flat), rel=0.02, abs=0.1)


def test_a_topcoat_is_glossy_and_orange_peel_costs_little() -> None:
    assert 80.0 <= gloss_units(Coat()) <= 100.0
    assert 0.0 < gloss_units(replace(Coat(), waviness=0.0)) - gloss_units(Coat()) < 2.0
    assert gloss_units(Coat(1.5, 0.0, 0.0)) == pytest.approx(82.3, abs=0.4)  # F(1.5) / F(1.567) at 20 degrees
    assert gloss_units(Coat(1.5, 0.05, 0.0)) == pytest.approx(4.9, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("gloss", "index"), [(5.0, 1.5), (40.0, 1.5), (80.0, 1.5), (90.0, 1.55)])
def test_a_coat_of_a_gloss_has_it(gloss: float, index: float) -> None:
    assert gloss_units(coat_of_gloss(gloss, index)) == pytest.approx(gloss, abs=0.01)


def test_a_solid_paint_reads_as_its_base_under_glass() -> None:
    solid = Material("m", "m", "paint", Coat())
    body = coated_reflectance([0.2, 0.7])
    for view, geometry in ((0.0, "0/0"), (45.0, "0/45")):
        mirror = coated_reflectance([0.2, 0.7], geometry=geometry)  # type: ignore[arg-type]
        np.testing.assert_allclose(reflectance_factor(solid, body, light=0.0, view=view), mirror, rtol=1e-4)
    assert 0.0 <= flop_index(solid, VISIBLE, 0.3) < 0.3  # light at grazing angles stays outside


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("flop", [3.0, 7.0, 8.0])
def test_flakes_of_a_flop_have_it(flop: float, share: float) -> None:
    paint = Material("m", "m", "paint", Coat(), Flakes(share))
    lobe = flakes_of_flop(flop, paint, VISIBLE, 0.1, 0.85)
    assert lobe.share == share
    assert flop_index(replace(paint, flakes=lobe), VISIBLE, 0.1, 0.85) == pytest.approx(flop, abs=0.05)


def test_the_index_is_almans_formula_of_three_lightnesses() -> None:
    paint = Material("m", "m", "paint", Coat(), Flakes(0.5, 0.2))
    near, face, far = (
        116 * np.cbrt(float(reflectance_factor(paint, 0.1, 0.85, light=45.0, view=view, azimuth=side))) - 16
        for view, side in ((30.0, 180.0), (0.0, 180.0), (65.0, 0.0))
    )
    assert flop_index(paint, VISIBLE, 0.1, 0.85) == pytest.approx(2.69 * (near - far) ** 1.11 / face**0.86)


def luminous_flop(paint: PaintSpec) -> float:
    # Return Alman's index from reflectance factors with the hue shift of interference flakes
    grid = np.linspace(400.0, 700.0, 31)
    assert paint.flakes is not None
    body, metal = (spectrum_of(name)(grid) for name in (paint.name, paint.flakes.spectrum))
    turned = spectrum_of(paint.flakes.turned)(grid) if paint.flakes.turned else None
    eye = np.exp(-0.5 * ((grid - 556.1) / 46.14) ** 2)
    material, light = paint.material(), []
    for view, azimuth in ((30.0, 180.0), (0.0, 180.0), (65.0, 0.0)):
        factor = reflectance_factor(
            material, body, metal, light=45.0, view=view, azimuth=azimuth, turned=turned
        )
        y = float(np.average(factor, weights=eye))
        light.append(116.0 * y ** (1 / 3) - 16.0 if y > 216 / 24389 else 24389 / 27 * y)
    return float(2.69 * max(light[0] - light[2], 0.0) ** 1.11 / light[1] ** 0.86)


@pytest.mark.parametrize("family", ["metallic", "pearl", "fleet"])
def test_generated_paints_flop_as_paints_do(family: str) -> None:
    # Published: 0 for solid paints, 15 to 17 for the highest flop of metallic and pearl basecoats
    names = [f"fleet-{n}" if family == "fleet" else f"pigment:{family}:{n}" for n in range(240)]
    paints = [paint for paint in map(paint_spec, names) if paint.flakes]
    flops = [luminous_flop(paint) for paint in paints]
    assert len(paints) > 120
    assert (1.0 if family == "fleet" else 3.0) < min(flops) < max(flops) < 17.0
    assert 6.0 < np.median(flops) < 12.0
    assert min(gloss_units(paint.coat) for paint in paints[:40]) > 70.0


def test_a_flop_beyond_real_paints_is_refused() -> None:
    # Flakes of a share of 0.67 over a dark red reach 28 with a sharp lobe
    dark = Material("m", "m", "paint", Coat(), Flakes(0.67))
    assert flop_index(replace(dark, flakes=Flakes(0.67, 0.05)), VISIBLE, 0.02, 0.85) > 25.0
    expect_error(SchemaError, "value-out-of-range", lambda: flakes_of_flop(18.0, dark, VISIBLE, 0.02, 0.85))
    most = flakes_of_flop(28.0, dark, VISIBLE, 0.02, 0.85, nearest=True)
    assert flop_index(replace(dark, flakes=most), VISIBLE, 0.02, 0.85) == pytest.approx(17.0, abs=0.2)
    # one that no lobe gives becomes the nearest
    bright = replace(dark, flakes=Flakes(0.15))
    most = flakes_of_flop(16.0, bright, VISIBLE, 0.6, 0.85, nearest=True)
    assert flop_index(replace(bright, flakes=most), VISIBLE, 0.6, 0.85) < 4.0


# --- leaves ---

NM = np.arange(400.0, 1001.0, 25.0)
REFLECTED, PASSED = 0.45, 0.40
PLATE = {"r": (np.array([300.0, 1100.0]), np.full(2, REFLECTED)),
         "t": (np.array([300.0, 1100.0]), np.full(2, PASSED)),
         "k": (np.array([300.0, 1100.0]), np.zeros(2))}  # fmt: skip


def test_leaves_are_plates_upon_another_and_keep_light_without_absorption() -> None:
    # Of diffuse light between them, R = R1 + T1 r t / (1 - r r) and T = T1 t / (1 - r r)
    passed = np.array([0.2, 0.7, 0.95])
    top, through = leaf_optics(passed, layers=1.0)
    both, under = leaf_optics(passed, layers=2.0)
    outside = 1.0 - hemispherical_reflectance(LEAF_INDEX)
    back = 1.0 - outside / LEAF_INDEX**2
    t = outside * passed * (1.0 - back) / (1.0 - (back * passed) ** 2)
    r = 1.0 - outside + back * passed * t
    np.testing.assert_allclose(under, through * t / (1.0 - r**2), rtol=1e-9)
    np.testing.assert_allclose(both, top + through * r * t / (1.0 - r**2), rtol=1e-9)
    # without absorption all light is kept
    for layers in (1.0, 1.55, 3.0):
        reflected, transmitted = leaf_optics(np.array([1.0 - 1e-12, 1.0]), layers)
        np.testing.assert_allclose(reflected + transmitted, 1.0, rtol=1e-5)


def test_a_leaf_passes_half_of_the_near_infrared_and_no_red() -> None:
    reflectance, transmittance = (spectrum_of(name)(NM) for name in ("leaf", "leaf_through"))
    assert (reflectance + transmittance < 1.0).all()
    near_infrared, red = NM == 850.0, NM == 675.0
    assert 0.42 < reflectance[near_infrared][0] < 0.55
    assert 0.38 < transmittance[near_infrared][0] < 0.55
    assert transmittance[red][0] < 0.06
    assert transmittance[NM == 550.0][0] > 1.5 * transmittance[red][0]
    # in a real car park
    leaf = {one.name: one for one in car_park(length=15.0, fleet="real", leaves=20).materials}["leaf"]
    assert leaf.transmittance == "leaf_through"
    assert {one.name: one for one in car_park(length=15.0, leaves=20).materials}["leaf"].transmittance == ""


def plate_over_black(below: str = "k") -> Scene:
    # Return a plate of 200 m at a height of 2 m over black or other ground
    plate = Material("plate", "r", "leaf", transmittance="t")
    return Scene.join([plane(400.0, Material("ground", below)),
                       plane(200.0, plate, centre=(0.0, 0.0, 2.0), instance="plate")])  # fmt: skip


@pytest.mark.slow
def test_a_plate_reflects_from_above_and_passes_from_below() -> None:
    light = flat_light(sky=0.0, direction=(40.0, 150.0))
    over = hp.simulation.trace(
        plate_over_black(), pushbroom(4, 4, altitude=20.0, ground_sample=0.5), [(40.0, 150.0)], samples=4
    )
    seen = hp.simulation.relight(over, FEW_BANDS, spectra=PLATE, atmosphere=light).reflectance
    np.testing.assert_allclose(seen, REFLECTED, rtol=1e-6)
    # the camera flies below the plate, over white ground that the plate lights
    scene = plate_over_black("w")
    traced = hp.simulation.trace(
        scene, pushbroom(4, 4, altitude=1.0, ground_sample=0.05), [(40.0, 150.0)], samples=4000, depth=3
    )
    lit = hp.simulation.relight(
        traced, FEW_BANDS, spectra={**PLATE, "w": (np.array([300.0, 1100.0]), np.ones(2))}, atmosphere=light
    ).reflectance
    # three scatterings: ground and plate, no second time
    assert float(lit.mean()) == pytest.approx(PASSED, rel=0.03)


@pytest.mark.slow
def test_a_plate_that_takes_nothing_over_white_ground_gives_all_back() -> None:
    # Expected: r + t^2 / (1 - r) = 1 with r + t = 1, of light that goes to and fro; over nothing r alone
    flight = pushbroom(4, 4, altitude=20.0, ground_sample=0.5)
    ones = np.array([300.0, 1100.0]), np.ones(2)
    nothing_lost = {**PLATE, "t": (ones[0], np.full(2, 1.0 - REFLECTED)), "k": ones}
    alone = plane(200.0, Material("plate", "r", "leaf", transmittance="t"))
    light = flat_light(sun=0.0, sky=1.0, direction=(40.0, 150.0))
    for scene, expected in ((plate_over_black(), 1.0), (alone, REFLECTED)):
        traced = hp.simulation.trace(scene, flight, [(40.0, 150.0)], samples=64, depth=16)
        seen = hp.simulation.relight(traced, FEW_BANDS, spectra=nothing_lost, atmosphere=light).reflectance
        np.testing.assert_allclose(seen.mean(), expected, rtol=0.02)
