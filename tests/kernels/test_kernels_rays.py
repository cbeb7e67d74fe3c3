"""Rays on a flat earth, where a frame is its map: by hand, and against a march in small steps."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from hyperpaint.kernels.arguments import BLOCK, LineFits, LineFrames, LineRays, LineSamples, Places, Raster
from hyperpaint.kernels.line_fits import (
    AREA,
    CENTRE,
    GAUSSIAN,
    OFFSET,
    SLIT,
    WIDTH,
    fit_lines,
    full_widths,
    line_profile,
    profiles,
)
from hyperpaint.kernels.rays import PLACES, gather_bilinear, gather_nearest, level_places, raster_places

DOWN = np.diag([1.0, 1.0, -1.0])[None]  # camera x is east, y north, z down


def axis(direction: int, scale: float = 1.0, first: float = 0.0) -> np.ndarray:
    made = np.zeros((1, 10))
    made[0, 0], made[0, 1 + direction] = first, scale
    return made


def placed(
    look: np.ndarray, origin: tuple[float, float, float], heights: np.ndarray | None = None
) -> np.ndarray:
    # Return the places of one line at ``origin``, over level 0 or a raster with its first cell at (0, 0)
    look = np.asarray(look, float)
    look = look / np.linalg.norm(look, axis=1, keepdims=True)
    out = np.full((PLACES, 1, len(look)), 7.0)
    rays = LineRays(np.array([origin]), DOWN, look)
    frames = LineFrames(axis(0), axis(1), axis(2), np.zeros(1))
    if heights is None:
        level_places(rays, frames, 0.0, out)
        return out[:, 0]
    filled = np.where(np.isnan(heights), -np.inf, heights)
    blocks = [range(0, size - 1, BLOCK) for size in heights.shape]
    tops = np.array(
        [[filled[r : r + BLOCK + 1, c : c + BLOCK + 1].max() for c in blocks[1]] for r in blocks[0]]
    )
    raster = Raster(axis(1), axis(0), heights, tops, np.nanmin(heights), np.nanmax(heights))
    raster_places(rays, frames, raster, out)
    return out[:, 0]


def test_rays_by_hand_to_the_horizon_and_below_ground() -> None:
    x, y, height, zenith, azimuth = placed([(0, 0, 1), (1, 0, 1), (0, -0.5, 1)], (5.0, 7.0, 10.0))
    np.testing.assert_allclose(x, [5, 15, 5], atol=1e-12)
    np.testing.assert_allclose(y, [7, 7, 2], atol=1e-12)
    np.testing.assert_allclose(height, 0, atol=1e-12)
    np.testing.assert_allclose(zenith, [0, 45, np.degrees(np.arctan(0.5))], atol=1e-12)
    # the camera is seen to the west of what lies east of it, to the north of what lies south
    np.testing.assert_allclose(azimuth, [0, 270, 0], atol=1e-12)
    # to the horizon and below ground
    up = placed([(1, 0, 1e-6), (1, 0, 0), (1, 0, -1e-6), (0, 0, -1)], (0, 0, 10.0))
    assert np.isfinite(up).all(axis=0).tolist() == [True, False, False, False]
    assert np.isnan(up[:, 1:]).all()
    assert np.isnan(placed([(0, 0, 1)], (0, 0, -1.0))).all()
    assert np.isnan(placed([(np.nan, 0, 1)], (0, 0, 1.0))).all()


def test_the_curved_earth_and_north_that_turns_with_the_way_east() -> None:
    # height above a sphere of radius R rises with the square of the way
    radius, altitude = 6.4e6, 1000.0
    height = axis(2, 1.0, altitude)
    height[0, [4, 5]] = 0.5 / radius
    out = np.empty((PLACES, 1, 2))
    look = np.array([[1.0, 0, 1], [1.0, 0, np.tan(np.radians(0.9))]])
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    frames = LineFrames(axis(0), axis(1), height, np.zeros(1))
    level_places(LineRays(np.zeros((1, 3)), DOWN, look), frames, 0.0, out)
    # the horizon of 1000 m is 1.013 degrees below the horizontal
    assert np.isnan(out[:, 0, 1]).all()
    assert (out[0, 0, 0] - 1000.0, out[3, 0, 0] - 45.0) == (
        pytest.approx(1000.0**2 / (2 * radius), rel=1e-2),
        pytest.approx(np.degrees(1000.0 / radius), rel=1e-2),
    )
    # north turns with the way east
    out = np.empty((PLACES, 1, 1))
    look = np.array([[1.0, 0, 1]]) / np.sqrt(2)
    frames = LineFrames(axis(0), axis(1), axis(2), np.array([1e-6]))
    level_places(LineRays(np.array([[0, 0, 100.0]]), DOWN, look), frames, 0.0, out)
    assert out[4, 0, 0] == pytest.approx(270.0 + np.degrees(1e-4), abs=1e-9)


def bilinear(heights: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    j = np.minimum(x.astype(int), heights.shape[1] - 2)
    i = np.minimum(y.astype(int), heights.shape[0] - 2)
    v, w = y - i, x - j
    return np.asarray(
        (1 - v) * ((1 - w) * heights[i, j] + w * heights[i, j + 1])
        + v * ((1 - w) * heights[i + 1, j] + w * heights[i + 1, j + 1])
    )


def march(look: np.ndarray, origin: np.ndarray, heights: np.ndarray, step: float = 2e-3) -> float:
    # Return the height of the first hit, in steps so small that none is missed by more than they are
    direction = look * [1, 1, -1] / np.linalg.norm(look)
    way = origin + np.arange(step, (origin[2] + 1.0) / -direction[2] + step, step)[:, None] * direction
    x, y, _ = way.T
    outside = (x < 0) | (x > heights.shape[1] - 1) | (y < 0) | (y > heights.shape[0] - 1)
    inside = way[: int(np.argmax(outside)) if outside.any() else len(way)].T
    hits = np.flatnonzero(inside[2] <= bilinear(heights, inside[0], inside[1]))
    return float(inside[2, hits[0]]) if hits.size else np.nan


def test_rasters_against_a_march() -> None:
    rng = np.random.default_rng(5)
    heights = rng.uniform(0, 2, (40, 53))
    look = np.column_stack([rng.uniform(-2, 2, (60, 2)), np.ones(60)])
    origin = np.array([26.0, 20.0, 6.0])
    found = placed(look, (26.0, 20.0, 6.0), heights)
    wanted = np.array([march(one, origin, heights) for one in look])
    # a ray that only just misses a crest in one and meets it in the other is not to be expected of 60
    np.testing.assert_allclose(found[2], wanted, atol=4e-3)
    inside = np.isfinite(wanted)
    assert inside.sum() > 40
    np.testing.assert_allclose(found[2, inside], bilinear(heights, *found[:2, inside]), atol=1e-8)


def test_rays_along_the_lines_of_the_raster() -> None:
    heights = np.zeros((33, 49))
    heights[:, 40] = 3.0
    heights[20, :] = 1.0
    x, y, height, *_ = placed([(1, 0, 0.1), (0, 1, 1), (0, 0, 1), (-1, 0, 1)], (16.0, 16.0, 4.0), heights)
    # up the ramp of the wall from 39 to 40, to the crest of row 20, straight down on a corner, along a row
    assert height[0] == pytest.approx(4 - 0.1 * (x[0] - 16.0))
    assert 39 < x[0] < 40
    assert ((x[1], y[1]), (x[2], y[2], height[2]), (x[3], y[3], height[3])) == (
        pytest.approx((16.0, 19.5)),
        pytest.approx((16, 16, 0)),
        pytest.approx((12, 16, 0)),
    )


def test_holes() -> None:
    heights = np.zeros((33, 49))
    heights[:, 20:24] = np.nan
    heights[:, 30:] = 2.0
    look = np.column_stack([np.linspace(0.05, 2.95, 30), np.zeros(30), np.ones(30)])
    x, _, height, *_ = placed(look, (16.0, 16.0, 8.0), heights)
    end = 16.0 + 8.0 * look[:, 0]
    np.testing.assert_array_equal(np.isnan(x), (end > 19.0) & (end < 24.0))
    assert np.nanmax(height) == pytest.approx(2.0)
    # entering from outside below the surface says nothing of what is seen
    assert np.isnan(placed([(1, 0, 0.1)], (-5.0, 16.0, 1.0), np.full((33, 49), 1.0))).all()
    assert placed([(1, 0, 0.5)], (-5.0, 16.0, 5.0), np.full((33, 49), 1.0))[0, 0] == pytest.approx(3.0)
    assert np.isnan(
        placed([(0, 0, 1)], (5.0, 5.0, 9.0), np.where(np.indices((33, 49))[0] < 20, np.nan, 1.0))
    ).all()


# --- line profiles against numerical convolution, and fits against what was put in ------------------------


CASES = [
    (shape, triangular, source)
    for shape in (GAUSSIAN, SLIT)
    for triangular in (False, True)
    for source in (0.0, 0.9, 5.4)
]


def convolved(x: np.ndarray, width: float, source: float, shape: int, triangular: bool) -> np.ndarray:
    # Return the profile by sums on a fine grid: an oracle that shares no formula with the kernel
    step = 0.002
    grid = np.arange(-20, 20 + step / 2, step)

    def box(w: float) -> np.ndarray:
        return np.clip((w / 2 - np.abs(grid)) / step + 0.5, 0, 1)

    def bell(w: float) -> np.ndarray:
        return np.exp(-4 * np.log(2) * (grid / w) ** 2)

    parts = [bell(width)] if shape == GAUSSIAN else [box(width), box(1.0)]
    if source > 0:
        parts.append(np.clip(1 - np.abs(grid) / source, 0, None) if triangular else bell(source))
    own = np.fft.ifft(np.prod([np.fft.fft(np.fft.ifftshift(part)) for part in parts], axis=0)).real
    return np.interp(x, grid, np.fft.fftshift(own) / (own.sum() * step))


@pytest.mark.parametrize(("shape", "triangular", "source"), CASES)
def test_profiles_are_convolutions(shape: int, triangular: bool, source: float) -> None:
    x = np.linspace(-8, 8, 81)
    made = np.array([line_profile(float(at), 2.7, source, shape, triangular) for at in x])
    np.testing.assert_allclose(made, convolved(x, 2.7, source, shape, triangular), atol=1e-3 * made.max())
    fine = np.arange(-30, 30, 0.01)[None]
    out = np.empty_like(fine)
    profiles(fine, np.array([2.7]), np.array([source]), shape, triangular, out)
    assert out.sum() * 0.01 == pytest.approx(1.0, abs=1e-6)
    assert (out >= 0).all()


def fitted(samples: LineSamples, start: np.ndarray, shape: int, triangular: bool) -> LineFits:
    # Return fits from start values; what is not written stays 0, and lines are not converged
    lines = len(start)
    fits = LineFits(start.copy(), np.zeros((lines, 4, 4)), np.zeros(lines), np.zeros(lines, bool))
    fit_lines(samples, shape, triangular, fits)
    return fits


def lamp_lines(truth: np.ndarray, light: np.ndarray, shape: int, triangular: bool) -> np.ndarray:
    values = np.empty((len(truth), 41))
    places = np.arange(41.0) - truth[:, CENTRE, None]
    profiles(places, truth[:, WIDTH].copy(), light, shape, triangular, values)
    return truth[:, AREA, None] * values + truth[:, OFFSET, None]


@pytest.mark.parametrize(("shape", "triangular", "source"), CASES)
def test_fits_find_what_was_put_in(shape: int, triangular: bool, source: float) -> None:
    truth, light = np.array([[20.3, 2.7, 5000.0, 3.0], [19.8, 3.1, 800.0, -1.0]]), np.full(2, source)
    values = lamp_lines(truth, light, shape, triangular)
    samples = LineSamples(values, np.ones((2, 41)), np.zeros(2, np.int64), light)
    fits = fitted(samples, truth * [1.0, 1.3, 0.8, 0.0] + [0.7, 0, 0, 0], shape, triangular)
    assert fits.converged.all()
    np.testing.assert_allclose(fits.parameters, truth, rtol=2e-5, atol=2e-3)


def test_covariance_is_that_of_repeated_fits() -> None:
    lines, sigma, none = 800, 20.0, np.zeros(800)
    truth = np.tile([20.3, 2.7, 5000.0, 3.0], (lines, 1))
    noise = sigma * np.random.default_rng(5).standard_normal((lines, 41))
    values = lamp_lines(truth, none, GAUSSIAN, False) + noise
    samples = LineSamples(values, np.full(values.shape, sigma**-2), np.zeros(lines, np.int64), none)
    fits = fitted(samples, truth, GAUSSIAN, False)
    assert fits.converged.all()
    told = np.sqrt(np.diagonal(fits.covariance, axis1=1, axis2=2)).mean(axis=0)
    np.testing.assert_allclose(fits.parameters.std(axis=0), told, rtol=0.1)
    assert fits.chi2.mean() == pytest.approx(37, rel=0.03)


def test_widths_are_where_the_profile_is_half() -> None:
    out = np.empty(1)
    for source, shape, width in ((1.0, GAUSSIAN, np.hypot(2.7, 1.0)), (0.0, SLIT, 2.7)):
        full_widths(np.array([2.7]), np.array([source]), shape, False, out)
        assert out[0] == pytest.approx(width, rel=1e-9)


def test_what_cannot_be_fitted_is_said() -> None:
    samples = LineSamples(np.zeros((2, 5)), np.zeros((2, 5)), np.zeros(2, np.int64), np.zeros(2))
    start = np.array([[np.nan, 1, 1, 0], [2.0, 1.0, 1.0, 0.0]])
    fits = LineFits(start, np.empty((2, 4, 4)), np.empty(2), np.ones(2, bool))
    fit_lines(samples, GAUSSIAN, False, fits)
    assert not fits.converged.any()
    assert np.isnan(fits.covariance).all()


# --- Gathering against fancy indexing and scipy's interpolation


def pixels(count: int, lines: int, columns: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    line = np.sort(rng.integers(0, lines, count))
    return line, rng.integers(0, columns, count), rng.permutation(count)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_nearest_is_indexing(dtype) -> None:
    slab = (1000 * np.random.default_rng(1).random((5, 7, 40))).astype(dtype)
    line, column, cell = pixels(60, 5, 40)
    out = np.zeros((60, 7), dtype)
    gather_nearest(slab, line, column, cell, np.empty((40, 7), dtype), out)
    wanted = np.empty_like(out)
    wanted[cell] = slab[line, :, column]
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize(("dtype", "made"), [(np.uint16, np.float32), (np.float64, np.float64)])
def test_bilinear_is_interpolation(dtype, made) -> None:
    rng = np.random.default_rng(2)
    cube = (1000 * rng.random((6, 3, 20))).astype(dtype)
    line, column, cell = pixels(50, 5, 19)
    along, across = rng.random((2, 50)).astype(made)
    out = np.zeros((50, 3), made)
    turned = np.empty((20, 3), made)
    places = Places(line, column, along, across, cell)
    gather_bilinear(cube[:5], cube[5], places, turned, turned.copy(), out)
    for band in range(3):
        points = np.stack([line + along, column + across])
        wanted = map_coordinates(cube[:, band].astype(float), points, order=1)
        np.testing.assert_allclose(out[cell, band], wanted, rtol=2e-5)


def test_what_has_no_weight_is_not_looked_at() -> None:
    cube = np.ones((2, 1, 3), np.float32)
    cube[0, 0, 2] = cube[1] = np.nan
    one = np.zeros(1, np.int64)
    out, turned = np.zeros((1, 1), np.float32), np.empty((3, 1), np.float32)
    for across, wanted in ((0.0, 1.0), (0.5, np.nan)):
        ways = np.zeros(1, np.float32), np.array([across], np.float32)
        gather_bilinear(cube[:1], cube[1], Places(one, one + 1, *ways, one), turned, turned.copy(), out)
        np.testing.assert_array_equal(out, [[wanted]])
