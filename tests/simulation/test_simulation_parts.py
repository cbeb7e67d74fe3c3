"""Light, paints, scene and imager of the simulator against hand calculations."""

import numpy as np
import pytest

from hyperpaint.simulation.atmosphere import Light, Sky, solar_irradiance, spectral_grid
from hyperpaint.simulation.camera import (
    Detector,
    Imager,
    convolve_gaussian,
    expected_counts,
    filled_etendue,
    line_shape,
    smile,
)
from hyperpaint.simulation.flight import surface_classes
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, MATERIALS, Paint, reflectance
from hyperpaint.simulation.settings import SHAPES

K = np.sqrt(np.pi / (4 * np.log(2)))
PEAK, WIDTH, SPACING = 2.0e16, 6.0, 600 / 271
GRID = spectral_grid(380.0, 1030.0)


def worked_imager(shape: str = "gaussian", slope: float = 0.0) -> Imager:
    # Imager of the worked example: 272 bands from 400 to 1000 nm
    return Imager(
        wavelength=400.0 + SPACING * np.arange(272),
        wavelength_shift=np.zeros(1),
        fwhm=WIDTH,
        shape=shape,
        responsivity=lambda nm: PEAK * K * WIDTH * (1.0 + slope * (nm - 700.0)),
        element_factor=np.ones((272, 1)),
    )


def test_worked_example_field() -> None:
    imager = worked_imager()
    radiance = np.full((1, len(GRID)), 0.40 * 1.30 / np.pi)
    counts = expected_counts(imager.integrals(radiance, GRID), 5e-3, 1.8598e-11)
    assert counts[0, 136, 0] == pytest.approx(1966.09, abs=0.005)
    recovered = counts / (5e-3 * 1.8598e-11 * imager.integrals(np.ones_like(radiance), GRID))
    np.testing.assert_allclose(np.pi * recovered / 1.30, 0.40, rtol=1e-12)


def test_worked_example_lab() -> None:
    imager = worked_imager()
    line = line_shape(GRID - imager.wavelength[136], 2.0, 0.0, "gaussian", 0.05)[None]
    counts = 50e-3 * 3.0e-12 * imager.integrals(line, GRID)
    assert counts[0, 136, 0] == pytest.approx(2846.05, abs=0.005)
    assert counts.sum() == pytest.approx(8654.12, abs=0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_line_area_identity(shape: str) -> None:
    # SUM_b INT m R_b = R0(lambda) / spacing, whatever the shape and the monochromator's width
    imager = worked_imager(shape, slope=1e-3)
    for width in (0.5, 2.0, 12.0):
        total = imager.integrals(line_shape(GRID - 650.3, width, 0.0, "gaussian", 0.05)[None], GRID).sum()
        assert total * SPACING == pytest.approx(PEAK * K * WIDTH * (1 - 1e-3 * 49.7), rel=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("centre", [500.0, 500.0137])
def test_line_shape_has_unit_area_and_its_width(shape: str, centre: float) -> None:
    offset = GRID - centre
    response = line_shape(offset, 6.0, 2.2, shape, 0.05)
    assert response.sum() * 0.05 == pytest.approx(1.0, abs=1e-12)
    assert (response * offset).sum() * 0.05 == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(offset[response >= response.max() / 2]) == pytest.approx(6.0, abs=0.11)
    if shape == "slit":
        # variance of two boxes: (a^2 + b^2) / 12, and of the grid cell
        assert ((response * offset**2).sum() * 0.05) == pytest.approx((36 + 2.2**2 + 0.05**2) / 12, rel=1e-6)
        assert not response[np.abs(offset) > 4.2].any()


def test_slit_is_the_convolution_of_two_boxes() -> None:
    step = 0.01
    offset = np.arange(-800, 801) * step
    boxes = [np.clip((width / 2 - np.abs(offset)) / step + 0.5, 0, 1) / width for width in (6.0, 2.2)]
    np.testing.assert_allclose(
        line_shape(offset, 6.0, 2.2, "slit", step), np.convolve(*boxes, mode="same") * step, atol=2e-4
    )


def test_smile_moves_the_response_of_a_column() -> None:
    shift = smile(5, 0.8)
    np.testing.assert_allclose(shift, [0.8, 0.2, 0.0, 0.2, 0.8])
    imager = Imager(
        wavelength=np.array([500.0, 510.0]), wavelength_shift=shift, fwhm=6.0, shape="gaussian",
        responsivity=np.ones_like, element_factor=np.ones((2, 5)),
    )  # fmt: skip
    grid = spectral_grid(450.0, 560.0)
    moments = imager.integrals(np.stack([np.ones_like(grid), grid]), grid)
    np.testing.assert_allclose(moments[1] / moments[0], imager.wavelength[:, None] + shift, atol=1e-9)


def test_integrals_agree_with_each_response() -> None:
    rng = np.random.default_rng(3)
    factor = 1 + 0.1 * rng.random((3, 21))
    imager = Imager(
        wavelength=np.array([500.0, 503.0, 506.0]), wavelength_shift=smile(21, 1.3), fwhm=4.0, shape="slit",
        responsivity=np.square, element_factor=factor,
    )  # fmt: skip
    grid = spectral_grid(480.0, 530.0)
    spectra = rng.random((2, len(grid)))
    made = imager.integrals(spectra, grid)
    for band in range(3):
        response = imager.response(band, grid, imager.wavelength_shift) * factor[band]
        np.testing.assert_allclose(made[:, band], spectra @ response * 0.05, rtol=1e-9)


def test_a_grid_that_ends_inside_a_response_is_refused() -> None:
    with pytest.raises(ValueError, match="grid covers"):
        worked_imager().integrals(np.ones((1, 100)), spectral_grid(500.0, 505.0)[:100])


def test_convolution_of_gaussians_adds_their_variances() -> None:
    seen = convolve_gaussian(
        line_shape(GRID - 700.0, 4.0, 0.0, "gaussian", 0.05)[None], GRID, np.arange(690.0, 711.0), 3.0
    )[0]
    np.testing.assert_allclose(
        seen, line_shape(np.arange(690.0, 711.0) - 700.0, 5.0, 0.0, "gaussian", 1.0), atol=1e-12
    )


def test_etendue_from_either_pupil() -> None:
    assert filled_etendue() == pytest.approx(
        np.pi / 4 * (12e-3 / 2.5) ** 2 * (7.4e-6 / 12e-3) * (20e-6 / 12e-3), rel=1e-12
    )
    assert filled_etendue() == pytest.approx(1.8598e-11, rel=1e-4)


def test_noise_has_the_variance_of_the_model() -> None:
    detector = Detector(np.full((400, 500), 100.0), 20.0, 0.5, 12)
    for signal in (0.0, 50.0, 3000.0):
        counts = detector.read(np.full((400, 500), signal), np.random.default_rng(1))
        assert counts.mean() == pytest.approx(100.0 + signal, abs=5 * counts.std() / 447)
        # 2e5 samples: the variance is known to 0.3 %
        assert counts.var() == pytest.approx(signal / 20.0 + 0.25, rel=0.015)


def test_converter_rounds_and_clips() -> None:
    counts = Detector(np.zeros((1, 4)), 20.0, 0.5, 12).convert(np.array([[-3.0, 17.4, 17.6, 5000.0]]))
    assert (counts.dtype, counts.tolist()) == (np.uint16, [[0, 17, 18, 4095]])


def test_noon_irradiance_is_of_the_right_level() -> None:
    grid = spectral_grid(380.0, 1030.0)
    direct, diffuse = Sky(sun_zenith=25.0).irradiance(grid)
    total = direct + diffuse
    levels = convolve_gaussian(total[None], grid, np.array([450.0, 550.0, 650.0, 870.0]), 10.0)[0]
    assert ((levels > [1.2, 1.2, 1.1, 0.75]) & (levels < [1.7, 1.6, 1.5, 1.0])).all()
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

    for least, place, most in (
        (0.4, (761, 755, 774), 0.9),
        (0.1, (687.5, 683, 698), 0.6),
        (0.1, (723, 708, 745), 0.6),
        (0.05, (820, 800, 845), 0.6),
        (0.2, (938, 885, 988), 0.9),
    ):
        assert least < depth(*place) < most
    # the band swings between its floor and the open window many times within one response
    assert np.count_nonzero(np.diff((total[(grid > 758) & (grid < 770)] > 0.8).astype(int))) > 15
    head = grid[(grid > 755) & (grid < 764)][np.argmax(total[(grid > 755) & (grid < 764)] < 0.6)]
    assert 759.0 < head < 760.5


def test_light_drifts_linearly_and_clouds_ramp() -> None:
    np.testing.assert_allclose(
        Light(0.01).factors(np.array([0.0, 30.0, 60.0])), [[1, 1.005, 1.01], [1, 0.9975, 0.995]]
    )
    cloud = Light(cloud=(0.6, 2.0, 10.0))
    np.testing.assert_allclose(cloud.factors(np.array([9.0, 10, 11, 12, 90]))[0], [1, 1, 0.7, 0.4, 0.4])
    assert cloud.mean_factors(np.array([10.0]), np.array([12.0]))[0, 0] == pytest.approx(0.7)


def test_kubelka_munk_with_saunderson() -> None:
    # a layer with R_inf = 0.9: 0.04 + 0.96 x 0.4 x 0.9 / (1 - 0.54)
    assert Paint((1 - 0.9) ** 2 / (2 * 0.9))(np.array([500.0]))[0] == pytest.approx(
        0.04 + 0.96 * 0.4 * 0.9 / 0.46
    )


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
