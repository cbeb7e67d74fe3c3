"""Light, paints and scene of the simulator."""

import numpy as np
import pytest

from hyperpaint.simulation.atmosphere import Light, Sky, solar_irradiance, spectral_grid
from hyperpaint.simulation.camera import convolve_gaussian
from hyperpaint.simulation.flight import surface_classes
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, MATERIALS, Paint, reflectance


def test_noon_irradiance_is_of_the_right_level() -> None:
    grid = spectral_grid(380.0, 1030.0)
    direct, diffuse = Sky(sun_zenith=25.0).irradiance(grid)
    total = direct + diffuse
    at = dict(
        zip(
            (450, 550, 650, 870),
            convolve_gaussian(total[None], grid, np.array([450.0, 550, 650, 870]), 10.0)[0],
            strict=False,
        )
    )
    assert 1.2 < at[450] < 1.7
    assert 1.2 < at[550] < 1.6
    assert 1.1 < at[650] < 1.5
    assert 0.75 < at[870] < 1.0
    share = diffuse / total
    assert share[grid < 410].mean() > 0.2 > 0.1 > share[grid > 850].mean()
    # the sun above the atmosphere: the measured sun (TSIS) gives 886 W m-2 in this range
    assert solar_irradiance(grid).sum() * 0.05 == pytest.approx(886.0, rel=0.07)


def test_lines_are_finer_than_any_instrument_and_where_they_belong() -> None:
    grid = spectral_grid(640.0, 990.0)
    total = sum(Sky().irradiance(grid))
    seen = convolve_gaussian(total[None], grid, np.arange(650.0, 981.0), 3.0)[0]
    nm = np.arange(650.0, 981.0)

    def depth(centre: float, left: float, right: float) -> float:
        shoulder = np.interp(centre, [left, right], np.interp([left, right], nm, seen))
        return float(1 - seen[np.abs(nm - centre) <= 2].min() / shoulder)

    assert 0.4 < depth(761, 755, 774) < 0.9
    assert 0.1 < depth(687.5, 683, 698) < 0.6
    assert 0.1 < depth(723, 708, 745) < 0.6
    assert 0.05 < depth(820, 800, 845) < 0.6
    assert 0.2 < depth(938, 885, 988) < 0.9
    inside = (grid > 758) & (grid < 770)
    # the band swings between its floor and the open window many times within one response
    windows = np.diff((total[inside] > 0.8).astype(int))
    assert np.count_nonzero(windows) > 15
    head = grid[(grid > 755) & (grid < 764)][np.argmax(total[(grid > 755) & (grid < 764)] < 0.6)]
    assert 759.0 < head < 760.5


def test_light_drifts_linearly_and_clouds_ramp() -> None:
    times = np.array([0.0, 30.0, 60.0])
    np.testing.assert_allclose(Light(0.01).factors(times), [[1, 1.005, 1.01], [1, 0.9975, 0.995]])
    cloud = Light(cloud=(0.6, 2.0, 10.0))
    np.testing.assert_allclose(cloud.factors(np.array([9.0, 10, 11, 12, 90]))[0], [1, 1, 0.7, 0.4, 0.4])
    mean = cloud.mean_factors(np.array([10.0]), np.array([12.0]))
    assert mean[0, 0] == pytest.approx(0.7)


def test_kubelka_munk_with_saunderson() -> None:
    # a layer with R_inf = 0.9: 0.04 + 0.96 x 0.4 x 0.9 / (1 - 0.54)
    ratio = (1 - 0.9) ** 2 / (2 * 0.9)
    assert Paint(ratio)(np.array([500.0]))[0] == pytest.approx(0.04 + 0.96 * 0.4 * 0.9 / 0.46)


def test_materials_lie_between_three_and_ninety_percent() -> None:
    grid = np.arange(400.0, 1001.0)
    rho = reflectance(list(MATERIALS), grid)
    assert rho.min() >= 0.03
    assert rho.max() <= 0.90
    assert len(CAR_PAINTS) == 12
    paint = dict(zip(MATERIALS, rho, strict=False))
    assert paint["ir_black"][grid < 650].max() < 0.07 < 0.25 < paint["ir_black"][grid > 850].min()
    assert paint["red"][grid == 450] < 0.1 < 0.5 < paint["red"][grid == 660]
    assert paint["grass"][grid == 670] < paint["grass"][grid == 550] < 0.2 < paint["grass"][grid == 850]


def test_scene_does_not_depend_on_the_lines_asked_together() -> None:
    whole = surface_classes(0, 300, 64, 2)
    pieces = np.concatenate([surface_classes(*ends, 64, 2) for ends in ((0, 1), (1, 32), (32, 300))])
    np.testing.assert_array_equal(whole, pieces)
    names = np.array(list(MATERIALS))[np.unique(whole)]
    assert {"asphalt", "painted_line", "grass", "concrete", "glass", "panel_05", "panel_90"} <= set(names)
    assert sum(name in CAR_PAINTS for name in names) >= 10
    assert (whole != surface_classes(0, 300, 64, 3)).mean() > 0.05
