"""The slab kernel against plain numpy, in every mode; with compilation and without."""

from typing import Any

import numpy as np
import pytest
from support.slab_arguments import calibrate, oracle, problem, round_values

from hyperpaint.kernels.arguments import SlabOutputs
from hyperpaint.kernels.radiometry import average_slab, filter_slab, resample_slab
from hyperpaint.radiometry.spectral_axis import lagrange_weights, window_polynomials
from hyperpaint.simulation.transport import mixing
from hyperpaint.simulation.transport.mixing import integrate_bands


def run(p: dict[str, Any], dropped: int = 0, flagging: bool = True) -> tuple[np.ndarray, np.ndarray]:
    shape = p["counts"].shape
    out = np.full(shape, 77, np.float32)
    quality = np.full((shape[0], shape[2]) if flagging else (0, 0), 9999, np.uint16)
    cube = np.empty((0, 0, 0), np.float32)
    calibrate(p, SlabOutputs(out, quality, cube, cube), dropped)
    return out, quality


@pytest.mark.parametrize("own_limit", [False, True], ids=["one limit", "own limits"])
@pytest.mark.parametrize("darks", [1, 3])
@pytest.mark.parametrize("smile", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_against_plain_numpy(dtype: Any, smile: int, darks: int, own_limit: bool) -> None:
    p = problem(dtype, smile=smile, darks=darks, own_limit=own_limit)
    before = {name: value.copy() for name, value in p.items()}
    expected, flags = oracle(p)
    out, quality = run(p)
    assert {1, 2, 4, 8, 32} <= {bit for bit in (1, 2, 4, 8, 32) if (flags & bit).any()}
    np.testing.assert_allclose(out, expected, rtol=3e-6, atol=1e-10)
    np.testing.assert_array_equal(quality, flags)
    for name, value in p.items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("smile", [0, 1])
def test_no_bit_depends_on_the_number_of_lines(smile: int) -> None:
    p = problem(np.uint16, smile=smile, darks=3)
    whole, quality = run(p, dropped=11)
    for line in range(7):
        part = dict(p)
        for name in ("counts", "dark_index", "dark_weight", "light", "line_flags"):
            part[name] = p[name][line : line + 1]
        out, flags = run(part, dropped=11)
        assert out.tobytes() == whole[line : line + 1].tobytes()
        np.testing.assert_array_equal(flags[0], quality[line])


def test_missing_counts_hide_no_saturation_and_quality_may_be_left_out() -> None:
    p = problem(np.float32)
    p["counts"][:] = 500.0
    p["counts"][0, 3, 6] = 4090.0
    p["counts"][0, 4:, 6] = np.nan
    p["counts"][1, 0, 7] = np.nan
    p["counts"][1, 3, 7] = 4090.0
    out, quality = run(p)
    np.testing.assert_array_equal(np.argwhere(quality & 1), [[0, 6], [1, 7]])
    assert np.isnan(out[0, 4:, 6]).all()
    # without quality nothing else changes
    p = problem(np.uint16)
    np.testing.assert_array_equal(run(p)[0], run(p, flagging=False)[0])


@pytest.mark.parametrize("keep", [1, 7, 12, 20, 22, 23])
def test_rounding_is_that_of_numcodecs(keep: int) -> None:
    codec = pytest.importorskip("numcodecs").BitRound(keepbits=keep)
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3, 4, 50)).astype(np.float32) * 10.0 ** rng.integers(-30, 30, (3, 4, 50))
    values = values.astype(np.float32)
    values[0, 0, :6] = [0.0, -0.0, np.inf, -np.inf, 1.0, np.float32(1 + 2**-12)]
    expected = np.frombuffer(codec.encode(values.copy()), np.float32).reshape(values.shape)
    made = values.copy()
    if keep < 23:
        round_values(made, 23 - keep)
    np.testing.assert_array_equal(made.view(np.uint32), expected.view(np.uint32))


def test_rounding_inside_the_slab_is_the_same_and_leaves_nan() -> None:
    p = problem(np.uint16)
    plain = run(p)[0]
    round_values(plain, 11)
    assert plain.tobytes() == run(p, dropped=11)[0].tobytes()
    # what is missing stays missing
    missing = np.full((1, 1, 4), np.nan, np.float32)
    round_values(missing, 11)
    assert np.isnan(missing).all()


# --- interpolation with weights of every column's own -------------------------------------------------------


def test_against_plain_numpy_with_missing_taps() -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, (3, 9, 5)).astype(np.float32)
    values[1, 4, 2] = np.nan
    first = rng.integers(0, 6, (9, 5))
    weights = rng.normal(size=(9, 5, 4)).astype(np.float32)
    weights[3, 1] = np.nan
    weights[:, 4] = [0, 1, 0, 0]
    out = np.full(values.shape, 77, np.float32)
    resample_slab(values, first, weights, out)
    for line, band, x in np.ndindex(values.shape):
        taps = values[line, first[band, x] : first[band, x] + 4, x].astype(np.float64)
        used = weights[band, x] != 0
        expected = (taps[used] * weights[band, x][used]).sum()
        np.testing.assert_allclose(out[line, band, x], expected, rtol=1e-5, atol=1e-6)


def test_a_cubic_is_interpolated_exactly() -> None:
    wavelength = np.array([400.0, 402.0, 405.0, 407.0, 410.0, 414.0, 415.0])
    shift = np.array([[-0.7, 0.0, 0.4]])
    own = wavelength[:, None] + shift

    def cubic(nm: np.ndarray) -> np.ndarray:
        s = (nm - 407) / 8
        return 0.3 + 0.2 * s - 0.1 * s**2 + 0.25 * s**3

    for turn in (slice(None), slice(None, None, -1)):
        first, weights = lagrange_weights(wavelength[turn], shift)
        values = cubic(own)[turn][None].astype(np.float32)
        out = np.empty(values.shape, np.float32)
        resample_slab(np.ascontiguousarray(values), first, weights, out)
        expected = np.broadcast_to(cubic(wavelength)[turn][:, None], out.shape[1:])
        there = ~np.isnan(out[0])
        np.testing.assert_allclose(out[0][there], expected[there], atol=2e-6)
        missing = np.argwhere(~there[turn])
        np.testing.assert_array_equal(missing, [[0, 2], [6, 0]])  # beyond the outermost bands
        np.testing.assert_array_equal(out[0][:, 1], values[0][:, 1])  # without shift, not a bit


# --- filters over the bands against scipy, and what a missing band touches ----------------------------------


def filtered(values: np.ndarray, method: str, window: int, order: int = 2) -> np.ndarray:
    out = np.full(values.shape, 77, np.float32)
    if method == "box":
        average_slab(values, window, out)
    else:
        first, weights, fallback = window_polynomials(window, order, values.shape[1])
        filter_slab(values, weights, first, fallback, out)
    return out


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (3, 25, 7)).astype(np.float32)


@pytest.mark.parametrize(("window", "order"), [(3, 1), (5, 2), (11, 2), (11, 3), (25, 4), (7, 0)])
def test_savitzky_golay_is_that_of_scipy(values: np.ndarray, window: int, order: int) -> None:
    signal = pytest.importorskip("scipy.signal")
    expected = signal.savgol_filter(values.astype(np.float64), window, order, axis=1, mode="interp")
    np.testing.assert_allclose(filtered(values, "savitzky-golay", window, order), expected, atol=2e-6)


@pytest.mark.parametrize("window", [3, 5, 11, 25])
def test_box_is_the_mean_of_what_is_there(values: np.ndarray, window: int) -> None:
    values[0, 8, 2] = values[1, 0, 0] = values[2, 23:, 4] = values[2, 4:9, 5] = np.nan
    made = filtered(values, "box", window)
    for line, band, x in np.ndindex(values.shape):
        near = values[line, max(0, band - window // 2) : band + window // 2 + 1, x].astype(np.float64)
        expected = np.nan if np.isnan(values[line, band, x]) else np.nanmean(near)
        np.testing.assert_allclose(made[line, band, x], expected, rtol=2e-6)


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
@pytest.mark.parametrize("gap", [0, 2, 12, 24])
def test_a_missing_band_touches_its_window_only(values: np.ndarray, method: str, gap: int) -> None:
    before = filtered(values, method, 5)
    values[1, gap, 3] = np.nan
    after = filtered(values, method, 5)
    changed = np.argwhere(after.view(np.uint32) != before.view(np.uint32))
    assert {(line, x) for line, _, x in changed} == {(1, 3)}
    # at the ends the window of a polynomial keeps its width
    assert np.abs(changed[:, 1] - gap).max() <= (2 if method == "box" or 4 < gap < 20 else 4)
    assert np.isnan(after[1, gap, 3])
    assert np.isnan(after).sum() == 1


def test_a_polynomial_passes_a_gap_unchanged() -> None:
    band = np.arange(25.0)
    curve = (0.2 + 0.01 * band - 0.0004 * band**2).astype(np.float32)
    values = np.tile(curve[None, :, None], (1, 1, 25))
    for x in range(25):
        values[0, x, x] = np.nan
    made = filtered(values, "savitzky-golay", 7)
    np.testing.assert_array_equal(np.isnan(made), np.isnan(values))
    np.testing.assert_allclose(made[~np.isnan(made)], values[~np.isnan(made)], atol=1e-6)


def test_two_gaps_leave_the_value_as_it_is_and_nothing_stays_nothing(values: np.ndarray) -> None:
    values[0, [10, 12], 0] = np.nan
    made = filtered(values, "savitzky-golay", 5)
    assert made[0, 11, 0] == values[0, 11, 0]
    assert np.isnan(made[0, [10, 12], 0]).all()
    # nothing at all
    empty = np.full((1, 9, 2), np.nan, np.float32)
    assert np.isnan(filtered(empty, "box", 3)).all()
    assert np.isnan(filtered(empty, "savitzky-golay", 5)).all()


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
@pytest.mark.parametrize("value", [1e30, np.inf])
def test_a_huge_band_touches_its_window_only(values: np.ndarray, method: str, value: float) -> None:
    before = filtered(values, method, 7)
    values[1, 12, 3] = value
    with np.errstate(invalid="ignore"):  # infinity without weight, where loops are plain Python
        after = filtered(values, method, 7)
    changed = np.argwhere(after.view(np.uint32) != before.view(np.uint32))
    assert {(line, x) for line, _, x in changed} == {(1, 3)}
    assert sorted({band for _, band, _ in changed}) == list(range(9, 16))


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
def test_no_bit_depends_on_other_lines_and_columns(values: np.ndarray, method: str) -> None:
    values[0, 8, 2] = values[2, 4:9, 5] = np.nan
    whole = filtered(values, method, 11)
    for line, x in np.ndindex(3, 7):
        alone = np.ascontiguousarray(values[line : line + 1, :, x : x + 1])
        assert filtered(alone, method, 11).tobytes() == whole[line, :, x].tobytes()


# --- loops of relighting against numpy, compiled and not ----------------------------------------------------


@pytest.mark.parametrize("compiled", [True, False])
def test_products_are_sums_over_the_grid(compiled: bool) -> None:
    rng = np.random.default_rng(0)
    grid, bands, nodes, width = 40, 7, 2, 3
    factors, weights = rng.random((4, grid)), rng.random((2, nodes, grid, width))
    first = np.sort(rng.integers(0, bands - width + 1, grid))
    chosen = np.array([[2, 0], [3, -1], [-1, -1], [1, 1]])
    source = np.array([0, 1, 1, -1])
    out = np.full((nodes, len(chosen), bands), np.nan, np.float32)
    run = integrate_bands if compiled else getattr(integrate_bands, "py_func", integrate_bands)
    run(factors, chosen, source, weights, first, out)
    dense = np.zeros((2, nodes, grid, bands))
    for point in range(grid):
        dense[:, :, point, first[point] : first[point] + width] = weights[:, :, point]
    products = [factors[2] * factors[0], factors[3], np.ones(grid), factors[1] ** 2]
    for path, product in enumerate(products):
        expected = np.einsum("g,ngb->nb", product, dense[source[path]]) * (source[path] >= 0)
        np.testing.assert_allclose(out[:, path], expected, rtol=1e-6)


@pytest.mark.parametrize("depth", [0.0, 1e-4, 0.1, 0.149, 0.151, 3.0])
@pytest.mark.parametrize("in_place", [False, True])
def test_air_is_an_exponential(depth: float, in_place: bool) -> None:
    surface = np.random.default_rng(1).random((5, 4, 6)).astype(np.float32)
    given = surface.copy()
    extinction = np.linspace(0.0, 1e-3, 4)[:, None].astype(np.float32)
    path_radiance = np.full((4, 1), 2e-5, np.float32)
    distance = np.full((5, 6), depth / 1e-3, np.float32)
    distance[0, 0] = np.nan
    out = surface if in_place else np.empty_like(surface)
    mixing.through_air(surface, extinction, path_radiance, distance, out)
    metres = np.nan_to_num(distance.astype(np.float64))[:, None]
    expected = given * np.exp(-extinction.astype(np.float64) * metres) + 2e-5 * metres
    np.testing.assert_allclose(out, expected, rtol=4e-7)
    np.testing.assert_array_equal(out[0, :, 0], given[0, :, 0])


def test_the_series_and_the_exponential_meet() -> None:
    plain = getattr(mixing.thin_air, "py_func", mixing.thin_air)
    made = np.empty((1, 3), np.float32)
    take, metres = np.full((1, 3), 1e-3, np.float32), np.array([0.0, 80.0, 149.0], np.float32)
    plain(np.ones((1, 3), np.float32), take, np.zeros((1, 3), np.float32), metres, made)
    np.testing.assert_allclose(made[0], np.exp(-1e-3 * metres), rtol=2e-7)
