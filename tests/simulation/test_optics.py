"""Point spread, keystone, stray light and pedestal of the simulated camera, against loops in plain numpy."""

import dataclasses
import itertools
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.simulation import SimulationSettings, simulate_collect, simulate_line, simulate_sweep
from hyperpaint.simulation.camera import (
    Camera,
    Optics,
    OpticsSettings,
    keystone,
    point_spread,
    stray_light_wings,
)
from hyperpaint.simulation.collect import flight_of
from hyperpaint.workflows import rendering
from hyperpaint.workflows.rendering import example_scene, read_scene_file

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


def test_a_point_spread_is_that_of_its_integral() -> None:
    weights, expected = point_spread(1.6), gaussian(1.6)
    middle = len(weights) // 2
    np.testing.assert_allclose(weights, expected[12 - middle : 13 + middle], atol=1e-9)


def test_two_blurs_are_one() -> None:
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


def test_nothing_happens_to_an_even_scene() -> None:
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


def test_off_costs_nothing() -> None:
    assert Camera.of(SimulationSettings()).optics is None
    assert Camera.of(SimulationSettings(psf_along_lines=1.0)).optics is not None


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


def test_masked_columns_count_the_pedestal() -> None:
    line = simulate_line(**SMALL, pedestal=4.5, masked_columns=3, psf_across_columns=3.0, stray_light=0.05)
    signal = signal_of(line)
    np.testing.assert_allclose(signal[..., :3], 4.5, atol=1e-4)
    np.testing.assert_allclose(signal[..., -3:], 4.5, atol=1e-4)
    assert (signal[..., 3:-3] > 4.5).all()
    is_blind = np.isnan(line.radiance_gain.values)
    assert is_blind[:, [0, 1, 2, -3, -2, -1]].all()
    assert not is_blind[:, 3:-3].any()


def test_masked_columns_show_the_pedestal_of_noisy_lines() -> None:
    line = simulate_line(lines=60, bands=40, columns=20, pedestal=2.25, masked_columns=2)
    blind = signal_of(line)[..., [0, 1, -2, -1]].mean(axis=(1, 2))
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
    with pytest.raises(FormatError, match=r"psf_kernel.*type-wrong"):
        read_scene_file(path)


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


def test_a_sweep_cannot_have_other_optics_than_the_flight(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match=r"stray_light.*key-unknown"):
        simulate_collect(tmp_path / "sim", lines=8, bands=4, columns=6, sweep={"stray_light": 0.01})


# --- settings ----------------------------------------------------------------------------------------------


def test_every_field_of_the_optics_makes_the_camera() -> None:
    from hyperpaint.simulation.settings import CAMERA_FIELDS

    assert {field.name for field in dataclasses.fields(OpticsSettings)} <= CAMERA_FIELDS
