"""Surfaces under a clear coat: Fresnel's equations, energy, and what an instrument reads of a base."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad

from hyperpaint.base.errors import PaintWarning
from hyperpaint.simulation.rendering.materials import (
    Coat,
    Material,
    base_albedo,
    coated_reflectance,
    fresnel_reflectance,
    hemispherical_reflectance,
    internal_reflectance,
    measured_factor,
)
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane
from hyperpaint.simulation.rendering.scene_spectra import Paint
from hyperpaint.simulation.rendering.tracing import trace
from hyperpaint.simulation.transport.path_codes import is_direct, is_indirect, is_mirrored

GEOMETRIES = ("0/0", "0/45", "d/0")
INDICES = st.floats(1.05, 2.6)


def amplitudes(angle: float, index: float) -> float:
    # Return Fresnel's reflectance by angles (sine and tangent form), an oracle of its own
    inside = np.arcsin(np.sin(angle) / index)
    across = np.sin(angle - inside) / np.sin(angle + inside)
    along = np.tan(angle - inside) / np.tan(angle + inside)
    return float(0.5 * (across**2 + along**2))


def effective_factor(albedo: np.ndarray, index: float) -> np.ndarray:
    # Return rho' = b (1 - Fi) / (1 - b Fi) of a base of albedo b under a coat
    back = internal_reflectance(index)
    return np.asarray(albedo * (1.0 - back) / (1.0 - albedo * back))


class TestFresnel:
    @given(st.floats(0.01, 1.5), INDICES)
    @settings(max_examples=50)
    def test_equals_the_form_by_angles(self, angle: float, index: float) -> None:
        assert_allclose(fresnel_reflectance(np.cos(angle), index), amplitudes(angle, index), rtol=1e-9)

    def test_at_brewsters_angle_one_polarisation_is_left(self) -> None:
        brewster = np.arctan(1.5)
        assert_allclose(fresnel_reflectance(np.cos(brewster), 1.5), 0.5 * ((1 - 2.25) / (1 + 2.25)) ** 2)

    @given(INDICES)
    @settings(max_examples=20)
    def test_the_closed_form_is_the_integral(self, index: float) -> None:
        integral = quad(lambda u: 2.0 * u * float(fresnel_reflectance(u, index)), 0.0, 1.0)[0]
        assert_allclose(hemispherical_reflectance(index), integral, rtol=1e-6)

    @given(st.floats(1.2, 2.2))
    @settings(max_examples=10)
    def test_internal_reflectance_is_the_integral_from_within(self, index: float) -> None:
        def inside(u: float) -> float:
            sine = index * np.sqrt(1.0 - u**2)
            return 2.0 * u * (1.0 if sine >= 1.0 else amplitudes(np.arcsin(sine), index))

        critical = np.sqrt(1.0 - 1.0 / index**2)
        total = quad(inside, 0.0, critical)[0] + quad(inside, critical, 1.0, limit=200)[0]
        assert_allclose(internal_reflectance(index), total, rtol=1e-5)

    def test_known_values(self) -> None:
        assert fresnel_reflectance(1.0, 1.5) == pytest.approx(0.04, abs=1e-15)
        # Judd (1942), table for diffuse light: 0.0918 from outside, 0.5963 from within
        assert hemispherical_reflectance(1.5) == pytest.approx(0.0918, abs=5e-5)
        assert internal_reflectance(1.5) == pytest.approx(0.5963, abs=5e-5)


class TestCoatedBase:
    def brdf(self, albedo: float, index: float, cos_in: float, cos_out: float) -> float:
        # Return the diffuse BRDF by adding the returns of light one after the other
        returned = internal_reflectance(index)
        inside = sum(albedo * (albedo * returned) ** k for k in range(2000))
        entering = 1.0 - float(fresnel_reflectance(cos_in, index))
        leaving = 1.0 - float(fresnel_reflectance(cos_out, index))
        return entering * leaving * inside / (np.pi * index**2)

    @pytest.mark.parametrize("albedo", [0.02, 0.5, 0.97])
    @pytest.mark.parametrize("index", [1.3, 1.5, 1.8])
    def test_reads_the_brdf_near_normal_and_at_45_degrees(self, albedo: float, index: float) -> None:
        for geometry, cosine in (("0/0", 1.0), ("0/45", np.sqrt(0.5))):
            read = coated_reflectance(albedo, index, geometry=geometry)
            assert_allclose(read, np.pi * self.brdf(albedo, index, 1.0, cosine), rtol=1e-10)

    def test_a_sphere_reads_the_brdf_averaged_over_the_light(self) -> None:
        mean = quad(lambda u: 2.0 * u * np.pi * self.brdf(0.6, 1.5, 1.0, u), 0.0, 1.0)[0]
        assert_allclose(coated_reflectance(0.6, geometry="d/0"), mean, rtol=1e-6)

    @pytest.mark.parametrize("cosine", [1.0, 0.5, 0.1])
    def test_a_white_base_gives_all_light_back(self, cosine: float) -> None:
        diffuse = quad(lambda u: 2.0 * np.pi * u * self.brdf(1.0, 1.5, cosine, u), 0.0, 1.0)[0]
        assert diffuse + float(fresnel_reflectance(cosine)) == pytest.approx(1.0, abs=1e-6)

    def test_what_the_tracer_leaves_out_is_the_effective_factor(self) -> None:
        albedo, index = np.linspace(0.0, 1.0, 11), 1.5
        geometric = (1.0 - 0.04) ** 2 / (index**2 * (1.0 - internal_reflectance(index)))
        factor = effective_factor(albedo, index)
        assert_allclose(geometric * factor, coated_reflectance(albedo, index), atol=1e-15)
        assert factor[0] == 0.0
        assert factor[-1] == pytest.approx(1.0)

    def test_a_sphere_with_the_mirror_reflection_is_saundersons_correction(self) -> None:
        paint = Paint(0.3, interface=0.04, internal=internal_reflectance(1.5))
        bare = Paint(0.3, interface=0.0, internal=0.0)
        grid = np.array([500.0])
        read = coated_reflectance(bare(grid), geometry="d/0", specular_included=True)
        assert_allclose(read, paint(grid), rtol=1e-12)

    def test_a_sphere_reads_less_than_near_normal(self) -> None:
        ratio = coated_reflectance(0.4, geometry="d/0") / coated_reflectance(0.4)
        assert ratio == pytest.approx(0.946, abs=5e-4)


class TestInversion:
    @pytest.mark.parametrize("geometry", GEOMETRIES)
    @given(st.floats(0.0, 0.95), st.floats(1.1, 2.0))
    @settings(max_examples=30)
    def test_round_trip(self, geometry: str, measured: float, index: float) -> None:
        most = float(coated_reflectance(1.0, index, geometry=geometry))
        measured *= min(1.0, most)
        albedo = base_albedo(measured, index, geometry=geometry)
        assert 0.0 <= albedo <= 1.0
        assert coated_reflectance(albedo, index, geometry=geometry) == pytest.approx(measured, abs=1e-12)
        factor = measured_factor(measured, index, geometry=geometry)
        assert effective_factor(albedo, index) == pytest.approx(float(factor), abs=1e-12)

    def test_the_formula_of_the_contract(self) -> None:
        measured, index = np.array([0.05, 0.3, 0.8]), 1.5
        q = measured * index**2 / (1.0 - 0.04) ** 2
        assert_allclose(base_albedo(measured, index), q / (1.0 + q * internal_reflectance(index)), rtol=1e-14)

    @pytest.mark.parametrize("geometry", ["0/0", "d/0"])
    def test_the_mirror_reflection_is_taken_off(self, geometry: str) -> None:
        without = base_albedo(0.30, geometry=geometry)
        assert base_albedo(0.34, geometry=geometry, specular_included=True) == pytest.approx(float(without))

    def test_a_lambert_surface_is_its_reflectance_and_white_is_within_reach(self) -> None:
        assert_allclose(measured_factor([0.0, 0.3, 1.0], None), [0.0, 0.3, 1.0], atol=0)
        assert base_albedo(1.0) < 1.0
        assert float(coated_reflectance(1.0)) == pytest.approx(1.01473, abs=1e-5)
        assert base_albedo([]).shape == (0,)
        assert base_albedo(np.float32([0.5])).dtype == np.float64

    def test_what_no_surface_can_have_is_clamped_with_a_warning(self) -> None:
        with pytest.warns(PaintWarning, match="2 of 3.*reflectance-clipped"):
            factor = measured_factor([-0.01, 0.5, 1.2])
        assert factor[[0, 2]].tolist() == [0.0, 1.0]


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
    seen = weight * measured_factor(measured) / np.cos(np.radians(2.0))
    assert_allclose(seen, measured, rtol=1e-5)
