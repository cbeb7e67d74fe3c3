"""The thick layer, its interface, and what they are worth against another way to the same numbers."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import solve_ivp

from hyperpaint.base.errors import SchemaError
from hyperpaint.paints.paint_libraries import (
    Interface,
    absorption_to_scattering,
    thick_layer_reflectance,
)
from hyperpaint.simulation.rendering.materials import fresnel_reflectance, internal_reflectance
from hyperpaint.simulation.rendering.scene_spectra import Paint


@pytest.mark.parametrize("ratio", [0.003, 0.2, 1.5, 20.0])
def test_a_thick_layer_is_what_the_two_streams_end_at(ratio: float) -> None:
    # dR/dx = S - 2 (S + K) R + S R^2 from a black ground up: Kubelka and Munk's differential equation
    found = solve_ivp(
        lambda _, r: 1.0 - 2.0 * (1.0 + ratio) * r + r**2, (0.0, 400.0), [0.0], rtol=1e-10, atol=1e-12
    )
    assert thick_layer_reflectance(ratio) == pytest.approx(found.y[0, -1], rel=1e-8)


def test_judds_table_and_the_interface() -> None:
    # Judd & Wyszecki, Color in Business, Science and Industry: K/S of 0.5, 0.1 and 0.9
    np.testing.assert_allclose(absorption_to_scattering([0.5, 0.1, 0.9]), [0.25, 4.05, 0.005556], rtol=1e-4)
    interface, layer = Interface(), 0.7
    light, left = 1.0 - interface.k1, 0.0
    for _ in range(200):
        up = light * layer
        left += up * (1.0 - interface.k2)
        light = up * interface.k2
    assert interface.outside(layer) == pytest.approx(left, rel=1e-12)
    assert Interface().k1 == pytest.approx(float(fresnel_reflectance(1.0, 1.5)))
    assert Interface().k2 == pytest.approx(internal_reflectance(1.5), abs=0.005)
    ratio = np.array([0.01, 0.3, 12.0])
    simulated = np.array([Paint(q)(np.array([550.0]))[0] for q in ratio])
    mine = Interface().k1 + Interface().outside(thick_layer_reflectance(ratio))
    np.testing.assert_allclose(mine, simulated, rtol=1e-12)
    with pytest.raises(SchemaError, match=r"(?s)k1=1\.0.*k2=-0\.1"):
        Interface(1.0, -0.1)


@given(st.floats(1e-6, 1.0), st.floats(0.0, 0.9), st.floats(0.0, 0.9))
def test_both_are_undone_and_bounded(layer: float, k1: float, k2: float) -> None:
    interface = Interface(k1, k2)
    seen = interface.outside(layer)
    assert 0.0 <= seen <= (1.0 - k1) * (1.0 + 1e-12)
    assert interface.layer(seen) == pytest.approx(layer, rel=1e-9)
    assert thick_layer_reflectance(absorption_to_scattering(layer)) == pytest.approx(layer, rel=1e-7)
