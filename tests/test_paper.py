"""The paper's equations: what holds corrected, and fails as printed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pint
import pytest
from support.refusals import expect_error

from hyperpaint import paper
from hyperpaint.base.facts import conversion_factor, registry
from hyperpaint.paper import Setup, Variant
from hyperpaint.radiometry.pixel_reading import worked_example

RADIANCE, IRRADIANCE = 0.40 * 1.30 / np.pi, 1.30
EXAMPLE = Setup()


def chain(setup: Setup, counts: float, variant: Variant) -> float:
    """Return the radiance after equations 4 and 5."""
    per_count = paper.radiance_per_count(setup, variant=variant)
    return float(paper.radiance(counts, 0.0, per_count, variant=variant))


# --- the worked example -----------------------------------------------------------------------------------


def test_counts_of_the_worked_example() -> None:
    assert EXAMPLE.counts(RADIANCE) == pytest.approx(1966.09, abs=0.005)
    assert EXAMPLE.line_amplitude == pytest.approx(2846.05, abs=0.005)
    assert EXAMPLE.line_area == pytest.approx(8654.12, abs=0.005)


def test_corrected_chain_returns_the_truth() -> None:
    found = chain(EXAMPLE, EXAMPLE.counts(RADIANCE), "corrected")
    assert found == pytest.approx(0.165521, abs=5e-7)
    assert paper.reflectance(found, IRRADIANCE) == pytest.approx(0.4, rel=1e-12)
    assert paper.lambertian_radiance(IRRADIANCE, 0.4) == pytest.approx(RADIANCE, rel=1e-12)


def test_printed_chain_loses_the_scale() -> None:
    """0.0678 = exposures 0.01 x etendues 1.0546 x 1/pi 0.3183 x widths 20.197 (physics 2.3)."""
    found = chain(EXAMPLE, EXAMPLE.counts(RADIANCE), "as_printed")
    assert (found, found / RADIANCE) == (pytest.approx(0.011222, abs=5e-7), pytest.approx(0.0678, abs=5e-5))
    exposures = (5e-3 / 50e-3) ** 2
    etendues = 1.8598e-11 / (8e-3 * 8e-3 / 15.24) ** 2
    widths = np.sqrt(np.pi / (4 * np.log(2))) * np.sqrt(6.0**2 + 2.0**2) * 6.0 / 2.0
    assert ((etendues, widths)) == ((pytest.approx(1.0546, abs=5e-5), pytest.approx(20.197, abs=5e-4)))
    assert found / RADIANCE == pytest.approx(exposures * etendues / np.pi * widths, rel=1e-9)
    # eq. 6 as printed, by bare numbers, and repaired
    assert found * IRRADIANCE / np.pi == pytest.approx(0.00464, abs=5e-6)
    assert paper.reflectance(found, IRRADIANCE) == pytest.approx(0.0271, abs=5e-5)
    # with R_norm normalised to one
    assert found * EXAMPLE.line_amplitude == pytest.approx(31.9, abs=0.05)


def test_gaussian_fit_and_line_area_agree() -> None:
    width = np.sqrt(np.pi / (4 * np.log(2))) * np.hypot(6.0, 2.0)
    assert EXAMPLE.line_amplitude * width == pytest.approx(EXAMPLE.line_area * 600 / 271, rel=1e-12)


def test_the_package_itself_uses_the_corrected_chain() -> None:
    line = worked_example()
    counts = float((line.counts - line.dark_counts)[0, 0, 0])
    assert counts == pytest.approx(EXAMPLE.counts(RADIANCE), rel=1e-6)
    gain = float(line.radiance_gain[0, 0]) / float(line.exposure_time)
    assert paper.radiance_per_count(EXAMPLE) == pytest.approx(gain, rel=1e-6)


# --- invariances: each holds corrected, and fails as printed -----------------------------------------------


def longer_exposure(setup: Setup) -> Setup:
    return replace(setup, flight_exposure=2 * setup.flight_exposure)


def longer_lab_exposure(setup: Setup) -> Setup:
    return replace(setup, reference_exposure=3 * setup.reference_exposure)


def higher_flight(setup: Setup) -> Setup:
    return replace(setup, ground_sample=2 * setup.ground_sample)


def wider_monochromator(setup: Setup) -> Setup:
    return replace(setup, reference_bandwidth=4 * setup.reference_bandwidth)


@pytest.mark.parametrize(
    ("change", "printed"),
    [
        (longer_exposure, 4.0), (longer_lab_exposure, 1 / 9), (higher_flight, 1 / 4),
        (wider_monochromator, np.sqrt(36 + 64) / np.sqrt(36 + 4) / 4),
    ],
)  # fmt: skip
def test_radiance_depends_on_the_scene_only(change: Callable[[Setup], Setup], printed: float) -> None:
    """The same scene, seen otherwise; as printed its radiance changes by the factor beside."""
    changed = change(EXAMPLE)
    counts, seen = EXAMPLE.counts(RADIANCE), changed.counts(RADIANCE)
    corrected = chain(changed, seen, "corrected") / chain(EXAMPLE, counts, "corrected")
    assert corrected == pytest.approx(1.0, rel=1e-12)
    as_printed = chain(changed, seen, "as_printed") / chain(EXAMPLE, counts, "as_printed")
    assert as_printed == pytest.approx(printed, rel=1e-12)
    assert abs(as_printed - 1) > 0.5


@pytest.mark.parametrize("width", [0.5, 2.0, 6.0, 12.0])
@pytest.mark.parametrize("power", [0.1, 1.0, 7.0])
def test_monochromator_and_lamp_do_not_matter(width: float, power: float) -> None:
    setup = replace(EXAMPLE, reference_bandwidth=width, flux=power * 3e-12)
    expected = paper.radiance_per_count(EXAMPLE)
    assert paper.radiance_per_count(setup) == pytest.approx(expected, rel=1e-12)


def test_reflectance_does_not_depend_on_the_units() -> None:
    """Radiance and irradiance both per W m-2 or both per uW cm-2 give one reflectance; as printed two."""
    factor = conversion_factor("W m-2 nm-1", "uW cm-2 nm-1")
    corrected = [np.pi * (s * RADIANCE) / (s * IRRADIANCE) for s in (1.0, factor)]
    printed = [(s * RADIANCE) * (s * IRRADIANCE) / np.pi for s in (1.0, factor)]
    assert corrected[0] == pytest.approx(corrected[1], rel=1e-12)
    assert printed[1] / printed[0] == pytest.approx(1e4)


def test_reflectance_does_not_depend_on_the_light() -> None:
    for level in (0.1, 1.0, 3.0):
        L = paper.lambertian_radiance(level * IRRADIANCE, 0.99)
        assert paper.reflectance(L, level * IRRADIANCE) == pytest.approx(0.99, rel=1e-12)


# --- units ------------------------------------------------------------------------------------------------


def in_other_units() -> Setup:
    quantity = registry().Quantity
    return Setup(
        flux=quantity(3e-6, "uW"),
        reference_exposure=quantity(50, "ms"),
        flight_exposure=quantity(5, "ms"),
        etendue=quantity(1.8598e-7, "cm2 sr"),
        ground_sample=quantity(8, "mm"),
        ifov=quantity(np.degrees(8e-3 / 15.24), "degree"),
        reference_bandwidth=quantity(20, "angstrom"),
        flight_bandwidth=quantity(0.006, "um"),
        band_spacing=quantity(600 / 271, "nm"),
        peak_responsivity=quantity(2.0e10, "count uJ-1"),
    )


@pytest.mark.parametrize("variant", ["corrected", "as_printed"])
def test_quantities_are_converted(variant: Literal["corrected", "as_printed"]) -> None:
    setup = in_other_units()
    assert setup.counts(registry().Quantity(RADIANCE * 100, "uW cm-2 sr-1 nm-1")).magnitude == pytest.approx(
        1966.09, abs=0.005
    )
    found = paper.radiance_per_count(setup, variant=variant)
    assert found.magnitude == pytest.approx(paper.radiance_per_count(EXAMPLE, variant=variant), rel=1e-9)


def test_corrected_chain_with_units_is_dimensionless_without_being_told() -> None:
    quantity, setup = registry().Quantity, in_other_units()
    per_count = paper.radiance_per_count(setup)
    L = paper.radiance(quantity(2066.09, "count"), quantity(100.0, "count"), per_count)
    rho = paper.reflectance(L, quantity(130.0, "uW cm-2 nm-1"))
    assert rho.dimensionless
    assert rho.magnitude == pytest.approx(0.4, rel=1e-5)


def test_equation_6_as_printed_has_the_wrong_dimension() -> None:
    expect_error(
        pint.DimensionalityError,
        "dimensionless",
        lambda: paper.reflectance(RADIANCE, IRRADIANCE, variant="as_printed"),
    )
    quantity = registry().Quantity
    expect_error(
        pint.DimensionalityError,
        None,
        lambda: paper.reflectance(
            quantity(RADIANCE, "W m-2 sr-1 nm-1"), quantity(IRRADIANCE, "W m-2 nm-1"), variant="as_printed"
        ),
    )


def test_equations_4_and_5_as_printed_give_no_spectral_radiance() -> None:
    per_count = paper.radiance_per_count(in_other_units(), variant="as_printed")
    expect_error(pint.DimensionalityError, None, lambda: per_count.to("W m-2 sr-1 nm-1 count-1"))
    counts = registry().Quantity(1966.09, "count")
    L = paper.radiance(counts, 0.0, per_count, variant="as_printed")
    expect_error(pint.DimensionalityError, None, lambda: paper.reflectance(L, IRRADIANCE))
    expect_error(pint.DimensionalityError, None, lambda: paper.radiance(counts, 0.0, per_count))


@pytest.mark.parametrize(
    "call",
    [
        lambda q: paper.lambertian_radiance(q, 0.4), lambda q: paper.electrons(q, 0.05, 550.0, 0.5),
        lambda q: paper.spectral_responsivity(q, 100.0, 3e-12, 0.05), lambda q: paper.radiance(q, 0.0, 1e-5),
        lambda q: paper.reflectance(q, 1.3), lambda q: paper.radiance_per_count(Setup(flux=q)),
    ],
)  # fmt: skip
def test_a_quantity_of_another_dimension_is_refused(call: Callable[[Any], Any]) -> None:
    expect_error(pint.DimensionalityError, None, lambda: call(registry().Quantity(1.0, "m")))


# --- equations 1 to 3 -------------------------------------------------------------------------------------


def test_the_cosine_is_in_a_level_irradiance_already() -> None:
    tilted = np.radians(60.0)
    assert paper.lambertian_radiance(1.3, 0.4, tilted) == pytest.approx(RADIANCE)
    assert paper.lambertian_radiance(1.3, 0.4, tilted, variant="as_printed") == pytest.approx(RADIANCE / 2)


@pytest.mark.parametrize("variant", ["corrected", "as_printed"])
def test_electrons_of_a_photon(variant: Literal["corrected", "as_printed"]) -> None:
    """A joule of light at 1239.84 nm is as many photons as an elementary charge goes into a coulomb."""
    photons = paper.electrons(1.0, 1.0, 1239.841984, 1.0, variant=variant)
    assert photons == pytest.approx(1 / 1.602176634e-19, rel=1e-9)


def test_responsivity_belongs_to_the_camera_and_not_to_the_exposure() -> None:
    def counts(exposure: float) -> float:
        return 100.0 + 2.0e16 * 3e-12 * exposure

    found = [paper.spectral_responsivity(counts(t), 100.0, 3e-12, t) for t in (0.05, 0.1)]
    assert found == pytest.approx([2.0e16, 2.0e16])
    printed = [
        paper.spectral_responsivity(counts(t), 100.0, 3e-12, t, variant="as_printed") for t in (0.05, 0.1)
    ]
    assert printed[1] / printed[0] == pytest.approx(2.0)


def test_arrays_go_through() -> None:
    counts = np.array([[1966.09, 983.045], [0.0, 196.609]])
    L = paper.radiance(counts, 0.0, paper.radiance_per_count(EXAMPLE))
    np.testing.assert_allclose(paper.reflectance(L, IRRADIANCE), [[0.4, 0.2], [0.0, 0.04]], rtol=1e-5)


def test_unknown_variant() -> None:
    with pytest.raises(ValueError, match="variant='printed'"):
        paper.reflectance(0.1, 1.0, variant="printed")  # type: ignore[arg-type]
