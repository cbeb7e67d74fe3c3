"""Light, paints, scene and imager of the simulator against hand calculations."""

import dataclasses
import functools
import itertools
import math
import re
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from support.refusals import expect_error, expect_words, refusal

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line, simulate_sweep
from hyperpaint.simulation.atmosphere import Light, Sky, solar_irradiance, spectral_grid
from hyperpaint.simulation.camera import (
    ETENDUE,
    Camera,
    Detector,
    Imager,
    Optics,
    OpticsSettings,
    convolve_gaussian,
    expected_counts,
    keystone,
    line_shape,
    point_spread,
    smile,
    stray_light_wings,
)
from hyperpaint.simulation.collect import flight_of
from hyperpaint.simulation.flight import surface_classes
from hyperpaint.simulation.rendering.platforms import (
    LocalFrame,
    Platform,
    Trajectory,
    TransverseMercator,
    geocentric,
    geodetic,
    platform_from_poses,
    pushbroom,
)
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, MATERIALS, Paint, reflectance
from hyperpaint.simulation.settings import CAMERA_FIELDS, ORIGIN, SHAPES
from hyperpaint.workflows import rendering
from hyperpaint.workflows.rendering import example_scene, read_scene_file

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


def test_worked_examples_of_field_and_lab() -> None:
    imager = worked_imager()
    radiance = np.full((1, len(GRID)), 0.40 * 1.30 / np.pi)
    counts = expected_counts(imager.integrals(radiance, GRID), 5e-3, 1.8598e-11)
    assert counts[0, 136, 0] == pytest.approx(1966.09, abs=0.005)
    recovered = counts / (5e-3 * 1.8598e-11 * imager.integrals(np.ones_like(radiance), GRID))
    np.testing.assert_allclose(np.pi * recovered / 1.30, 0.40, rtol=1e-12)
    # in the lab
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


def test_slit_is_the_convolution_of_two_boxes() -> None:
    step = 0.01
    offset = np.arange(-800, 801) * step
    boxes = [np.clip((width / 2 - np.abs(offset)) / step + 0.5, 0, 1) / width for width in (6.0, 2.2)]
    np.testing.assert_allclose(
        line_shape(offset, 6.0, 2.2, "slit", step), np.convolve(*boxes, mode="same") * step, atol=2e-4
    )


def test_integrals_over_the_responses_of_columns() -> None:
    shift = smile(5, 0.8)
    np.testing.assert_allclose(shift, [0.8, 0.2, 0.0, 0.2, 0.8])
    imager = Imager(
        wavelength=np.array([500.0, 510.0]), wavelength_shift=shift, fwhm=6.0, shape="gaussian",
        responsivity=np.ones_like, element_factor=np.ones((2, 5)),
    )  # fmt: skip
    grid = spectral_grid(450.0, 560.0)
    moments = imager.integrals(np.stack([np.ones_like(grid), grid]), grid)
    np.testing.assert_allclose(moments[1] / moments[0], imager.wavelength[:, None] + shift, atol=1e-9)
    # and agree with each response
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
    expect_error(
        ValueError,
        "grid covers",
        lambda: worked_imager().integrals(np.ones((1, 100)), spectral_grid(500.0, 505.0)[:100]),
    )


def test_convolution_of_gaussians_adds_their_variances() -> None:
    seen = convolve_gaussian(
        line_shape(GRID - 700.0, 4.0, 0.0, "gaussian", 0.05)[None], GRID, np.arange(690.0, 711.0), 3.0
    )[0]
    np.testing.assert_allclose(
        seen, line_shape(np.arange(690.0, 711.0) - 700.0, 5.0, 0.0, "gaussian", 1.0), atol=1e-12
    )


def test_etendue_from_either_pupil() -> None:
    assert (
        pytest.approx(np.pi / 4 * (12e-3 / 2.5) ** 2 * (7.4e-6 / 12e-3) * (20e-6 / 12e-3), rel=1e-12)
        == ETENDUE
    )
    assert pytest.approx(1.8598e-11, rel=1e-4) == ETENDUE


def test_noise_has_the_variance_of_the_model_and_the_converter_rounds() -> None:
    detector = Detector(np.full((400, 500), 100.0), 20.0, 0.5, 12)
    for signal in (0.0, 50.0, 3000.0):
        counts = detector.read(np.full((400, 500), signal), np.random.default_rng(1))
        assert counts.mean() == pytest.approx(100.0 + signal, abs=5 * counts.std() / 447)
        # 2e5 samples: the variance is known to 0.3 %
        assert counts.var() == pytest.approx(signal / 20.0 + 0.25, rel=0.015)
    whole = Detector(np.zeros((1, 4)), 20.0, 0.5, 12).convert(np.array([[-3.0, 17.4, 17.6, 5000.0]]))
    assert (whole.dtype, whole.tolist()) == (np.uint16, [[0, 17, 18, 4095]])


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


# --- Point spread, keystone, stray light and pedestal of the simulated camera, against loops in plain numpy


Floats = NDArray[np.float64]

NM = np.linspace(400.0, 1000.0, 5)
KERNEL = [[0.0, 1.0, 0.0, 2.0, 0.0], [1.0, 6.0, 3.0, 0.0, 1.0], [0.0, 2.0, 0.5, 0.0, 0.0]]
EVERYTHING: dict[str, Any] = {
    "psf_across_columns": 1.7, "psf_along_lines": 1.3, "keystone_columns": 1.3, "stray_light": 0.03,
}  # fmt: skip
SMALL: dict[str, Any] = {
    "lines": 40, "bands": 6, "columns": 24, "fwhm_nm": 25.0, "noise": False, "quantise": False
}  # fmt: skip


def mirrored(place: int, size: int) -> int:
    # Return a place outside as its mirror image in the edge, however far out it is
    while not 0 <= place < size:
        place = -1 - place if place < 0 else 2 * size - 1 - place
    return place


def gaussian(fwhm: float) -> Floats:
    # Return exp(-t) I_n(t) by its integral over an angle, the generating function of Bessel functions
    t = fwhm**2 / (8.0 * np.log(2.0))
    angle = (np.arange(4000) + 0.5) * np.pi / 4000
    return np.array([np.mean(np.exp(t * (np.cos(angle) - 1)) * np.cos(n * angle)) for n in range(-12, 13)])


def slow_image(scene: Floats, kernel: Floats, shifts: Floats, stray: Floats) -> Floats:
    # Return the image of a scene (line, band, column), place by place
    lines, _, columns = scene.shape
    half = [size // 2 for size in kernel.shape]
    blurred = np.zeros_like(scene)
    for y, b, x in np.ndindex(*scene.shape):
        for i, j in np.ndindex(*kernel.shape):
            row, column = mirrored(y - (i - half[0]), lines), x - (j - half[1])
            # an image displaced by s shows what was at column - s, between two of which it is shared
            place = column - shifts[b]
            left = int(np.floor(place))
            for at, share in ((left, 1.0 - (place - left)), (left + 1, place - left)):
                blurred[y, b, x] += kernel[i, j] * share * scene[row, b, mirrored(at, columns)]
    return blurred + np.einsum("bc,ycx->ybx", stray, blurred)


def images(optics: Optics, scene: Floats) -> Floats:
    return np.stack(
        [optics.image([scene[row] for row in optics.rows_of(y, len(scene))]) for y in range(len(scene))]
    )


# --- the operators -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("fwhm", [0.0, 0.3, 1.0, 2.5, 9.0])
def test_a_point_spread_keeps_energy_and_variance(fwhm: float) -> None:
    weights = point_spread(fwhm)
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_array_equal(weights, weights[::-1])
    assert (weights * (np.arange(len(weights)) - len(weights) // 2) ** 2).sum() == pytest.approx(
        fwhm**2 / (8 * np.log(2)), rel=1e-6, abs=1e-15
    )


def test_point_spreads_follow_their_integral_and_add() -> None:
    weights, expected = point_spread(1.6), gaussian(1.6)
    middle = len(weights) // 2
    np.testing.assert_allclose(weights, expected[12 - middle : 13 + middle], atol=1e-9)
    two = np.convolve(point_spread(1.5), point_spread(2.0))
    one = point_spread(2.5)
    spare = (len(two) - len(one)) // 2
    np.testing.assert_allclose(two[spare : len(two) - spare], one, atol=1e-8)


@pytest.mark.parametrize(
    "given",
    [
        {"psf_kernel": KERNEL}, {"psf_kernel": KERNEL, "keystone_columns": -1.3}, {"stray_light": 0.05},
        {"psf_along_lines": 0.8}, {"psf_across_columns": 1.1, "keystone_columns": 0.4}, EVERYTHING,
    ],
)  # fmt: skip
def test_images_against_loops(given: dict[str, Any]) -> None:
    settings = OpticsSettings(**given)
    scene = np.random.default_rng(1).random((6, 5, 7))
    if settings.psf_kernel is None:
        along, across = gaussian(settings.psf_along_lines), gaussian(settings.psf_across_columns)
        kernel = np.outer(along, across)
    else:
        kernel = np.asarray(KERNEL)
    shifts = settings.keystone_columns * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    expected = slow_image(scene, kernel / kernel.sum(), shifts, stray_light_wings(NM, settings.stray_light))
    np.testing.assert_allclose(images(Optics(settings, NM), scene), expected, rtol=1e-6)


@pytest.mark.parametrize("place", [(0, 0), (5, 9), (10, 19)])
def test_a_blur_keeps_the_energy_of_a_point_even_at_the_edge(place: tuple[int, int]) -> None:
    scene = np.zeros((11, 5, 20))
    scene[place[0], :, place[1]] = 3.0
    seen = images(Optics(OpticsSettings(psf_across_columns=2.0, psf_along_lines=3.0), NM), scene)
    np.testing.assert_allclose(seen.sum(axis=(0, 2)), 3.0, rtol=1e-12)
    # nothing happens to an even scene
    settings = OpticsSettings(psf_kernel=KERNEL, keystone_columns=2.7)
    np.testing.assert_allclose(images(Optics(settings, NM), np.full((4, 5, 6), 2.0)), 2.0, rtol=1e-14)


@pytest.mark.parametrize("shift", [-1.75, 0.3, 2.0])
def test_keystone_moves_the_centre_of_mass(shift: float) -> None:
    scene = np.zeros((1, 5, 41))
    scene[..., 18:23] = np.random.default_rng(2).random(5)
    optics = Optics(OpticsSettings(keystone_columns=shift, psf_across_columns=2.0), NM)
    seen = images(optics, scene)
    column = np.arange(41)
    moved = (seen @ column / seen.sum(axis=2) - scene @ column / scene.sum(axis=2))[0]
    np.testing.assert_allclose(moved, shift * np.array([-1.0, -0.5, 0.0, 0.5, 1.0]), atol=1e-6)
    np.testing.assert_allclose(seen.sum(axis=2), scene.sum(axis=2), rtol=1e-12)
    np.testing.assert_array_equal(keystone(5, shift), optics.keystone)


def test_stray_light_adds_its_share_of_every_band() -> None:
    share = stray_light_wings(NM, 0.02)
    np.testing.assert_allclose(share.sum(axis=0), 0.02, rtol=1e-12)
    assert (share > 0).all()
    assert (np.diff(share[:, 0]) < 0).all()


# --- in a flight -------------------------------------------------------------------------------------------


def signal_of(line: xr.Dataset) -> Floats:
    return (line.counts.astype("f8") - line.dark_counts).values  # type: ignore[no-any-return]


def test_optics_are_part_of_the_camera_and_cost_nothing_where_off() -> None:
    assert Camera.of(SimulationSettings()).optics is None
    assert Camera.of(SimulationSettings(psf_along_lines=1.0)).optics is not None
    assert {field.name for field in dataclasses.fields(OpticsSettings)} <= CAMERA_FIELDS


def test_counts_are_those_of_the_blurred_scene() -> None:
    plain, blurred = simulate_line(**SMALL), simulate_line(**SMALL, **EVERYTHING)
    factor = Camera.of(SimulationSettings(**SMALL)).imager.element_factor
    optics = Optics(OpticsSettings(**EVERYTHING), plain.wavelength.values)
    np.testing.assert_allclose(
        signal_of(blurred), images(optics, signal_of(plain) / factor) * factor, rtol=2e-6, atol=2e-3
    )
    # the truth is the scene, whatever the optics make of it
    for name in ("true_radiance", "true_reflectance", "surface"):
        np.testing.assert_array_equal(blurred[name], plain[name])


@pytest.mark.parametrize("scene", ["plan", "checkerboard", pytest.param("rendered", marks=pytest.mark.slow)])
def test_lines_do_not_depend_on_how_they_are_grouped(scene: str) -> None:
    size = {"lines": 23, "bands": 5, "columns": 12, "samples": 2, "scene": scene, "seed": 3}
    flight = flight_of(SimulationSettings(**size, fleet="solid", neighbours=False, **EVERYTHING))
    whole = flight.lines(0, 23)
    memory = None
    for first, last in itertools.pairwise((0, 1, 8, 10, 23)):
        part = memory = flight.lines(first, last, into=memory)
        for field in ("counts", "radiance", "reflectance", "surface"):
            np.testing.assert_array_equal(getattr(part, field), getattr(whole, field)[first:last], field)
        for name, layer in part.layers.items():
            np.testing.assert_array_equal(layer, whole.layers[name][first:last])


def test_files_do_not_depend_on_how_lines_are_grouped(tmp_path: Path) -> None:
    size = {"lines": 30, "bands": 4, "columns": 12, "scene": "plan", **EVERYTHING}
    for blocks in (7, 64):
        simulate_collect(tmp_path / str(blocks), block_lines=blocks, **size)
    one, other = ((tmp_path / name / "flight" / "raw_0").read_bytes() for name in ("7", "64"))
    assert one == other
    with xr.open_zarr(tmp_path / "7" / "calibration.zarr") as calibration:
        camera = Camera.of(SimulationSettings(**size))
        assert camera.optics is not None
        np.testing.assert_array_equal(calibration.stray_light, camera.optics.stray_matrix)


def test_memory_does_not_grow_with_the_flight() -> None:
    def peak(lines: int) -> int:
        flight = flight_of(SimulationSettings(lines=lines, bands=20, columns=64, scene="plan", **EVERYTHING))
        flight.lines(0, 32)
        tracemalloc.start()
        memory = None
        # as many calls for every flight: threads of a cluster of other tests add to a peak with time
        for start in [*range(0, lines, 32)] * (512 // lines):
            memory = flight.lines(start, start + 32, into=memory)
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return highest

    assert min(peak(512), peak(512)) < 1.1 * peak(128)


def test_masked_columns_show_the_pedestal() -> None:
    line = simulate_line(**SMALL, pedestal=4.5, masked_columns=3, psf_across_columns=3.0, stray_light=0.05)
    signal = signal_of(line)
    np.testing.assert_allclose(signal[..., :3], 4.5, atol=1e-4)
    np.testing.assert_allclose(signal[..., -3:], 4.5, atol=1e-4)
    assert (signal[..., 3:-3] > 4.5).all()
    is_blind = np.isnan(line.radiance_gain.values)
    assert is_blind[:, [0, 1, 2, -3, -2, -1]].all()
    assert not is_blind[:, 3:-3].any()
    # of noisy lines too
    noisy = simulate_line(lines=60, bands=40, columns=20, pedestal=2.25, masked_columns=2)
    blind = signal_of(noisy)[..., [0, 1, -2, -1]].mean(axis=(1, 2))
    # 160 elements of a read noise of 0.5 and a rounding of 0.29 counts
    np.testing.assert_allclose(blind, 2.25, atol=5 * np.hypot(0.5, 0.29) / np.sqrt(160) + 0.05)


# --- in a render -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [False, True])
def test_counts_of_a_render_do_not_depend_on_chunks(noise: bool) -> None:
    settings = SimulationSettings(lines=24, columns=8, bands=4, fwhm_nm=200.0, pedestal=3.0, **EVERYTHING)
    camera = Camera.of(settings)
    values = np.random.default_rng(0).uniform(0.0, 0.1, (24, 4, 8)).astype(np.float32)
    cube = xr.DataArray(values, dims=("along_track", "band", "cross_track"))

    def counts(lines: int) -> Any:
        return rendering.counts_of(
            cube.chunk(along_track=lines), camera, 5e-3, 7, "noon", noise=noise
        ).counts.values

    whole = counts(24)
    for lines in (1, 7):
        np.testing.assert_array_equal(counts(lines), whole)
    if not noise:
        assert camera.optics is not None
        factor = camera.imager.element_factor
        scale = 5e-3 * camera.etendue * camera.response_area / factor
        expected = images(camera.optics, values.astype(np.float64) * scale) * factor
        np.testing.assert_array_equal(
            whole, np.rint(np.clip(expected + camera.detector(5e-3).dark + 3.0, 0, 4095))
        )


def test_the_example_shows_the_optics(tmp_path: Path) -> None:
    text, names = example_scene(), [field.name for field in dataclasses.fields(OpticsSettings)]
    for name in names:
        assert name in text
        text = text.replace(f"\n# {name} =", f"\n{name} =")
    path = tmp_path / "scene.toml"
    path.write_text(text)
    given = read_scene_file(path).camera
    settings = SimulationSettings.of({key: given[key] for key in names if key != "psf_kernel"})
    assert (settings.psf_across_columns, settings.masked_columns) == (1.2, 4)
    path.write_text(text.replace("psf_across_columns", "psf_kernel").replace("= 1.2 ", "= [1.0] "))
    expect_error(FormatError, r"psf_kernel.*type-wrong", lambda: read_scene_file(path))


# --- in the lab --------------------------------------------------------------------------------------------


def test_a_sweep_sees_the_keystone_of_its_beam() -> None:
    lab: dict[str, Any] = {
        "steps": 3, "bands": 61, "columns": 61, "fwhm_nm": 20.0, "smile_nm": 0.0, "nonuniformity": 0.0,
        "beam_fwhm_columns": 9.0, "noise": False, "quantise": False,
    }  # fmt: skip
    sweep = simulate_sweep(**lab, keystone_columns=1.5)
    signal = (sweep.counts - sweep.dark_counts).values.astype(np.float64)
    band = signal.sum(axis=2).argmax(axis=1)
    lines = signal[np.arange(3), band]
    np.testing.assert_allclose(
        (lines @ np.arange(61) / lines.sum(axis=1)) - 30, sweep.true_keystone.values[band], atol=1e-4
    )
    assert "true_keystone" not in simulate_sweep(**lab)


def test_a_sweep_has_the_stray_light_and_the_pedestal_of_the_camera() -> None:
    size: dict[str, Any] = {"bands": 30, "columns": 4, "fwhm_nm": 30.0}
    quiet: dict[str, Any] = {"noise": False, "quantise": False}
    camera = SimulationSettings(**size, stray_light=0.02, pedestal=3.0, **quiet)
    assert Camera.of(camera).pedestal == 3.0
    plain = simulate_sweep(steps=3, **size, **quiet)
    sweep = simulate_sweep(steps=3, **size, stray_light=0.02, pedestal=3.0, **quiet)
    np.testing.assert_array_equal(sweep.dark_counts, plain.dark_counts)
    factor = Camera.of(camera).imager.element_factor
    light = (plain.counts - plain.dark_counts).values / factor
    stray = stray_light_wings(sweep.true_wavelength.values, 0.02)
    expected = (light + np.einsum("bc,scx->sbx", stray, light)) * factor + 3.0
    np.testing.assert_allclose((sweep.counts - sweep.dark_counts).values, expected, rtol=1e-6, atol=1e-4)
    np.testing.assert_array_equal(sweep.true_stray_light, stray)
    assert float(sweep.true_pedestal) == 3.0


# --- Platforms: where rays start and look, how drones move, and the ellipsoid, against scipy and PROJ


NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
ANGLE = st.floats(-80.0, 80.0)


def ground_of(platform: Platform, along: float, across: float, moment: int = 0) -> np.ndarray:
    # Return where the ray (along, across, 1) of every line meets z = 0
    direction = platform.rotation[:, moment] @ np.array([along, across, 1.0])
    origin = platform.origin[:, moment]
    return origin - direction * (origin[:, 2:] / direction[:, 2:])


def test_a_level_flight_north_looks_down_with_columns_to_the_east() -> None:
    flight = pushbroom(5, 4, altitude=10.0, ground_sample=0.1, exposure_time=0.0)
    assert flight.origin.dtype == flight.rotation.dtype == np.float64
    assert flight.time.dtype == np.int64
    assert flight.time.tolist() == [0, 7_000_000, 14_000_000, 21_000_000, 28_000_000]
    np.testing.assert_allclose(flight.position[:, 1], [-0.2, -0.1, 0.0, 0.1, 0.2], atol=1e-12)
    left, right = (ground_of(flight, 0.0, edge) for edge in flight.column_edges[[0, -1]])
    np.testing.assert_allclose(left[:, 0], -0.2, atol=1e-12)
    np.testing.assert_allclose(right[:, 0], 0.2, atol=1e-12)
    near, far = (ground_of(flight, edge, 0.0) for edge in flight.along_edges)
    np.testing.assert_allclose((far - near)[:, 1], 0.1, atol=1e-12)
    # the exposure smears by speed times time
    smeared = pushbroom(4, 2, altitude=15.0, speed=4.0, exposure_time=5e-3)
    np.testing.assert_allclose((smeared.origin[:, 1] - smeared.origin[:, 0])[:, 1], 0.02, atol=1e-12)
    # times of a record are UTC
    time = np.array(["2021-07-20T17:00:00", "2021-07-20T17:00:10"], dtype="datetime64[ns]")
    lines = np.array(["2021-07-20T17:00:02.5", "2021-07-20T17:00:03"], dtype="datetime64[ns]")
    recorded = platform_from_poses(time, *[[0, 0]] * 2, [9, 9], *[[0, 0]] * 3, columns=1, line_time=lines)
    np.testing.assert_array_equal(recorded.utc, lines)


@pytest.mark.parametrize(
    ("heading", "ahead", "right"), [(0, (0, 1), (1, 0)), (90, (1, 0), (0, -1)), (225, (-1, -1), (-1, 1))]
)
def test_headings_turn_clockwise(heading: float, ahead: tuple[int, int], right: tuple[int, int]) -> None:
    flight = pushbroom(3, 2, altitude=10.0, heading=heading, start=(3.0, 4.0), line_spacing=1.0)
    unit = np.array(ahead) / np.hypot(*ahead)
    np.testing.assert_allclose(flight.position[0, :2], [3.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(np.diff(flight.position[:, :2], axis=0), [unit, unit], atol=1e-12)
    aside = ground_of(flight, 0.0, 0.1)[1, :2] - flight.position[1, :2]
    exposed = flight.position[1, :2] - flight.origin[1, 0, :2]
    np.testing.assert_allclose(aside + exposed, np.array(right) / np.hypot(*right), atol=1e-9)


@given(ANGLE, ANGLE, st.floats(0.0, 359.9))
def test_rotations_are_those_of_scipy_and_angles_come_back(roll: float, pitch: float, heading: float) -> None:
    flight = platform_from_poses(
        [0, 1], [0, 0], [0, 0], [9, 9], [roll] * 2, [pitch] * 2, [heading] * 2, columns=1
    )
    expected = NED_TO_ENU @ Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    np.testing.assert_allclose(flight.rotation[0, 1], expected, atol=1e-12)
    found = flight.attitude[0]
    np.testing.assert_allclose(found[:2], [roll, pitch], atol=1e-6)
    assert abs((found[2] - heading + 180.0) % 360.0 - 180.0) < 1e-6


def test_poses_between_samples_are_on_the_great_arc() -> None:
    time = np.array([0.0, 0.4, 1.0])
    angles = np.array([[3.0, -2.0, 350.0], [-8.0, 4.0, 10.0], [1.0, 1.0, 40.0]])
    at = np.array([0.1, 0.35, 0.77])
    flight = platform_from_poses(
        time, [0, 1, 2], [0, 3, 5], [20, 21, 20], *angles.T, columns=3, line_time=at, exposure_time=0.02
    )
    slerp = Slerp(time, Rotation.from_euler("ZYX", angles[:, ::-1], degrees=True))
    for moment, shift in enumerate((-0.01, 0.01)):
        np.testing.assert_allclose(
            flight.rotation[:, moment], NED_TO_ENU @ slerp(at + shift).as_matrix(), atol=1e-9
        )
        np.testing.assert_allclose(flight.origin[:, moment, 0], np.interp(at + shift, time, [0, 1, 2]))
    assert flight.time.tolist() == [0, 250_000_000, 670_000_000]


def test_boresight_and_lever_arm_are_in_the_frame_of_the_unit() -> None:
    poses = ([0, 1], [0, 0], [0, 0], [10, 10], [2, 2], [3, 3], [90, 90])
    flight = platform_from_poses(*poses, columns=2, boresight=(1.0, -2.0, 5.0), lever_arm=(0.5, 0.2, 0.1))
    unit = Rotation.from_euler("ZYX", [90, 3, 2], degrees=True)
    camera = unit * Rotation.from_euler("ZYX", [5, -2, 1], degrees=True)
    np.testing.assert_allclose(flight.rotation[0, 0], NED_TO_ENU @ camera.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(flight.origin[0, 0], NED_TO_ENU @ unit.apply([0.5, 0.2, 0.1]) + [0, 0, 10])


def test_wobble_has_the_spread_it_is_given_and_follows_the_seed() -> None:
    one = pushbroom(20_000, 1, wobble=(0.5, 0.3, 1.0), heading=180.0, sway=0.2, seed=4)
    np.testing.assert_allclose(one.attitude.std(axis=0), [0.5, 0.3, 1.0], rtol=0.15)
    assert one.position[:, 2].std() == pytest.approx(0.2, rel=0.2)
    again = pushbroom(20_000, 1, wobble=(0.5, 0.3, 1.0), heading=180.0, sway=0.2, seed=4)
    other = pushbroom(20_000, 1, wobble=(0.5, 0.3, 1.0), heading=180.0, sway=0.2, seed=5)
    np.testing.assert_array_equal(one.rotation, again.rotation)
    assert not np.allclose(one.rotation, other.rotation)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"lines": 0}, "lines=0"),
        ({"lines": 10**12}, "lines=1000000000000"),
        ({"columns": True}, "columns=True"),
        ({"altitude": math.nan}, "altitude=nan"),
        ({"altitude": 10**400}, "altitude=1000"),
        ({"altitude": "high"}, "altitude='high'"),
        ({"ifov": 0.001, "ground_sample": 0.1}, "option-conflict"),
        ({"speed": 1.0, "line_spacing": 0.1}, "option-conflict"),
        ({"wobble": (1.0, 2.0)}, "wobble="),
        ({"centre": (0.0, math.inf)}, "centre="),
        ({"exposure_time": 8e-3}, "exposure-too-long"),
        ({"columns": 20_000, "ifov": 0.01}, "view-too-wide"),
        ({"start_time": "now"}, "start_time='now'"),
        ({"start_time": "yesterday"}, "start_time='yesterday'"),
    ],
)
def test_flights_that_cannot_be_flown_are_refused(wrong: dict[str, Any], text: str) -> None:
    expect_error(SchemaError, re.escape(text), lambda: pushbroom(**{"lines": 4, "columns": 4, **wrong}))


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"time": [0, 0]}, "time-unordered"),
        ({"time": [0]}, "pose-missing"),
        ({"roll": [math.nan, 0]}, "roll"),
        ({"north": [0, 0, 0]}, "north.*dims-wrong"),
        ({"heading": [0, 170]}, "poses 0 and 1.*turn-too-large"),
        ({"line_time": [2.0]}, "lines-outside-poses"),
        ({"line_time": np.array(["2021-01-01"], "datetime64[ns]")}, "type-wrong"),
        ({"columns": 0}, "columns=0"),
        ({"up": [0, 1e9]}, "up has.*value-out-of-range"),
        ({"east": ["a", "b"]}, "east"),
    ],
)
def test_records_that_cannot_be_used_are_refused(wrong: dict[str, Any], text: str) -> None:
    poses: dict[str, Any] = {name: [0, 0] for name in ("east", "north", "roll", "pitch", "heading")}
    poses |= {"time": [0, 1], "up": [9, 9], "columns": 2, "line_time": [0.5]}
    expect_error(SchemaError, text, lambda: platform_from_poses(**(poses | wrong)))


def test_platforms_of_wrong_arrays_are_refused() -> None:
    good = pushbroom(3, 2)
    given = {
        name: getattr(good, name) for name in ("origin", "rotation", "column_edges", "along_edges", "time")
    }
    for name, wrong, text in (
        ("origin", np.zeros((3, 3)), r"origin.*dims-wrong"),
        ("rotation", -good.rotation, "rotation-invalid"),
        ("column_edges", good.column_edges[::-1], "edges-invalid"),
        ("time", good.time.astype(float), "type-wrong"),
    ):
        with pytest.raises(SchemaError, match=text):
            Platform(**(given | {name: wrong}))
    # all problems of a flight at once
    with refusal(SchemaError, "value-out-of-range", "lines=0", "altitude=0", "wobble=-1", "seed=-1"):
        pushbroom(0, 4, altitude=0, wobble=-1, seed=-1)


# --- the motion of a drone ----------------------------------------------------------------------------------

SECONDS = np.arange(0.0, 600.0, 0.01)


def flown(**effects: object) -> Trajectory:
    return Trajectory.of(
        SimulationSettings.of({"scene": "checkerboard", **effects}), LocalFrame(*ORIGIN), 1.14, 15.24
    )


@pytest.mark.parametrize(
    ("wobble", "tilt", "heading", "fastest"),
    [("calm", 0.15, 1.1, (2.2, 2.8, 12.0)), ("rough", 0.42, 3.1, (6.0, 8.0, 34.0))],
)
def test_wobble_is_that_of_drones(
    wobble: str, tilt: float, heading: float, fastest: tuple[float, float, float]
) -> None:
    # Expected: spreads and highest rates [degree, degree s-1] of ``georeference_reliability.md`` 1.2
    path = flown(wobble=wobble, seed=3)
    pose = path.pose(SECONDS)
    yaw = (pose["heading"] + 180.0) % 360.0 - 180.0
    assert pose["roll"].std() == pytest.approx(tilt, rel=0.1)
    assert (pose["pitch"].std(), yaw.std()) == (pytest.approx(tilt, rel=0.1), pytest.approx(heading, rel=0.1))
    for angle, most in zip((pose["roll"], pose["pitch"], yaw), fastest, strict=True):
        assert np.abs(np.gradient(angle, 0.01)).max() == pytest.approx(most, rel=0.35)
    # which crosses north, and is written from 0 to 360
    assert pose["heading"].min() >= 0.0
    assert pose["heading"].max() < 360.0
    assert np.abs(np.diff(pose["heading"])).max() > 350.0
    assert max(np.abs(pose["roll"]).max(), np.abs(pose["pitch"]).max()) < path.steepest
    assert np.abs(yaw).max() < path.max_yaw


def test_seeds_wobble_differently_and_without_wobble_it_flies_straight() -> None:
    rolls = [flown(wobble="calm", seed=seed).pose(SECONDS)["roll"] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(rolls[0], rolls[1])
    assert np.abs(np.corrcoef(rolls[0], rolls[2])[0, 1]) < 0.2
    # without wobble it flies straight
    pose = flown(wobble="none", course=63.0).pose(SECONDS)
    assert not pose["roll"].any()
    assert not pose["pitch"].any()
    assert (pose["heading"] == 63.0).all()
    assert (pose["altitude"] == 160.0 + 15.24).all()
    azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(
        pose["longitude"][0], pose["latitude"][0], pose["longitude"][-1], pose["latitude"][-1]
    )
    assert (azimuth, distance) == (pytest.approx(63.0, abs=1e-3), pytest.approx(1.14 * SECONDS[-1], rel=1e-4))


def test_camera_is_where_pose_and_mounting_put_it() -> None:
    # Expected: by scipy's rotations and PROJ's geodesy, lever arm and boresight as rotations
    path = flown(
        wobble="rough", course=300.0, boresight=(0.4, -0.6, 0.8), lever_arm=(0.05, -0.02, 0.12), seed=5
    )
    seconds = np.array([0.0, 3.0, 50.0])
    pose, (origin, rotation) = path.pose(seconds), path.camera(seconds)
    to_scene = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={ORIGIN[1]} +lat_0={ORIGIN[0]} +h_0={ORIGIN[2]}"
    )
    place = np.stack(to_scene.transform(pose["longitude"], pose["latitude"], pose["altitude"]), axis=-1)
    body = Rotation.from_euler("ZYX", np.stack([pose[n] for n in ("heading", "pitch", "roll")], -1), True)
    camera = body * Rotation.from_euler("ZYX", [0.8, -0.6, 0.4], degrees=True)
    swap = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    # the vertical there is not that of the origin: 57 m are 5e-4 degrees
    np.testing.assert_allclose(rotation, swap @ camera.as_matrix(), atol=2e-5)
    np.testing.assert_allclose(origin, place + body.apply([0.05, -0.02, 0.12]) @ swap.T, atol=1e-5)


def test_motions_and_mountings_that_cannot_be_flown() -> None:
    for told, wrong in (
        (
            ("wobble='wild'", "boresight=(1.0, 2.0)", "lever_arm=", "swath=0.0", "course=999.0"),
            {
                "wobble": "wild",
                "boresight": (1.0, 2.0),
                "lever_arm": (0, 0, 9),
                "swath": 0.0,
                "course": 999.0,
            },
        ),
        (
            ("course=10.0", "swath=5.0", "navigation_rate=300"),
            {"scene": "plan", "course": 10.0, "swath": 5.0, "navigation_rate": 300},
        ),
    ):
        make = functools.partial(SimulationSettings, **wrong)
        expect_words(str(expect_error(SchemaError, None, make)), *told)


# --- the ellipsoid and the map ------------------------------------------------------------------------------

RNG = np.random.default_rng(8)
LATITUDE = RNG.uniform(0.0, 83.0, 500)
LONGITUDE = -75.0 + RNG.uniform(-3.0, 3.0, 500)
HEIGHT = RNG.uniform(-100.0, 5000.0, 500)


def transformed(source: str, target: str, *values: np.ndarray) -> tuple[np.ndarray, ...]:
    made = pyproj.Transformer.from_crs(source, target, always_xy=True).transform(*values)
    return tuple(np.asarray(part) for part in made)


def test_geocentric_and_back() -> None:
    expected = np.stack(transformed("EPSG:4979", "EPSG:4978", LONGITUDE, LATITUDE, HEIGHT), axis=-1)
    np.testing.assert_allclose(geocentric(LATITUDE, LONGITUDE, HEIGHT), expected, atol=1e-8, rtol=0)
    latitude, longitude, height = geodetic(expected)
    assert np.abs(latitude - LATITUDE).max() < 1e-11  # degree: a micrometre
    assert np.abs(longitude - LONGITUDE).max() < 1e-12
    assert np.abs(height - HEIGHT).max() < 1e-7


@pytest.mark.parametrize("zone", [1, 18, 31, 60])
def test_map_is_that_of_utm(zone: int) -> None:
    plane = TransverseMercator(zone)
    longitude = LONGITUDE + 6.0 * (zone - 18)
    east, north = plane.project(LATITUDE, longitude)
    x, y = transformed("EPSG:4326", plane.crs, longitude, LATITUDE)
    assert np.abs(east - x).max() < 1e-7
    assert np.abs(north - y).max() < 1e-7


def test_local_frame_and_zone_of_a_place() -> None:
    frame = LocalFrame(43.0845, -77.6749, 160.0)
    latitude, longitude = 43.0845 + RNG.normal(0, 0.01, 50), -77.6749 + RNG.normal(0, 0.01, 50)
    height = RNG.uniform(100.0, 300.0, 50)
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=-77.6749 +lat_0=43.0845 +h_0=160"
    )
    made = frame.local(latitude, longitude, height)
    np.testing.assert_allclose(
        made, np.stack(pipeline.transform(longitude, latitude, height), axis=-1), atol=1e-7, rtol=0
    )
    for value, wanted, within in zip(
        frame.geodetic(made), (latitude, longitude, height), (1e-11, 1e-11, 1e-7), strict=True
    ):
        np.testing.assert_allclose(value, wanted, atol=within, rtol=0)
    # zone of a place
    zones = [TransverseMercator.of(43.0, longitude).zone for longitude in (-180.0, -77.7, 0.0, 179.9)]
    assert zones == [1, 18, 31, 60]
    expect_error(ValueError, "-20", lambda: TransverseMercator.of(-20.0, 0.0))
