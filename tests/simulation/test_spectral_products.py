"""Products of spectra over bands: against a dense sum, and the same whoever asks first."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.refusals import expect_refusals, refusal
from support.traced_scenes import seen_by
from support.transport_scenes import code as code_of

from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.camera import BandResponses, BandSet, Camera, cell_means, nominal_responsivity
from hyperpaint.simulation.rendering import relighting
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.relighting import ProductTable
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, reflectance
from hyperpaint.simulation.settings import SimulationSettings
from hyperpaint.simulation.transport.path_codes import (
    PathCodes,
    is_direct,
    is_indirect,
    is_mirrored,
    source_of,
)

NAMES = list(CAR_PAINTS)
CODES = PathCodes.of(len(NAMES), 4)
LIGHT = Atmosphere.clear(60.0)
SOURCES = {0: LIGHT.sky, 2: LIGHT.sun}
GRID = np.arange(350.0, 1050.0, 0.05)


def paints(grid: np.ndarray) -> np.ndarray:
    return reflectance(NAMES, grid)


def some_codes(number: int = 400, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    made = [
        code_of(
            int(rng.choice([0, 2])),
            *rng.integers(0, len(NAMES), rng.integers(0, 5)),
            digit_bits=CODES.digit_bits,
        )
        for _ in range(number)
    ]
    return np.unique(made)


def product(code: int, grid: np.ndarray = GRID) -> np.ndarray:
    made = np.interp(grid, LIGHT.wavelength, SOURCES[code % 8]) / np.pi
    for factor in CODES.factors(np.array([code]))[0]:
        if factor >= 0:
            made = made * CAR_PAINTS[NAMES[factor]](grid)
    return made


def at_columns(table: ProductTable, codes: np.ndarray) -> np.ndarray:
    # Return the products of paths as every column sees them, (path, band, cross_track)
    return table.to_columns(table.rows(codes).astype(np.float64).swapaxes(0, 1))


@given(
    factors=st.integers(1, 2**14 - 1),
    source=st.integers(0, 7),
    flags=st.tuples(st.booleans(), st.booleans()),
    data=st.data(),
)
def test_codes_say_what_went_in(factors: int, source: int, flags: Any, data: st.DataObject) -> None:
    codes = PathCodes.of(factors, 4)
    met = data.draw(st.lists(st.integers(0, factors - 1), max_size=4))
    code = code_of(source, *met, mirror=flags[0], indirect=flags[1], digit_bits=codes.digit_bits)
    assert 0 <= code < 2**63
    as_array = np.array([code])
    found = codes.factors(as_array)[0]
    assert (sorted(found[found >= 0].tolist()), source_of(as_array)[0]) == (sorted(met), source)
    assert is_direct(as_array)[0] == (source >= 2)
    assert (is_mirrored(as_array)[0], is_indirect(as_array)[0]) == flags


def test_codes_that_do_not_fit_are_refused() -> None:
    assert PathCodes.of(2**14 - 1, 4).digit_bits == 14
    expect_refusals(
        (SchemaError, "path-code-too-long", "depth=3", lambda: PathCodes.of(2**14, 4)),
        (SchemaError, "value-out-of-range", lambda: PathCodes.of(3, 0)),
    )


@pytest.mark.parametrize(
    ("shape", "fwhm", "responsivity"),
    [
        ("gaussian", 6.0, None),
        ("gaussian", 2.0, nominal_responsivity(20.0)),
        ("slit", 5.0, None),
    ],
)
def test_products_are_dense_integrals(shape: str, fwhm: float, responsivity: Any) -> None:
    # Sharp lines and steep edges; the sum itself is no better than some 1e-5
    bands = BandSet(np.linspace(399.356, 1001.42, 272), np.array(fwhm), shape, None, responsivity)
    codes = some_codes()[::97]
    rows = ProductTable(bands, CODES, LIGHT.wavelength, SOURCES, paints).rows(codes)
    assert (rows.dtype, rows.shape) == (np.float32, (1, codes.size, 272))
    grid = np.arange(350.0, 1050.0, 0.05 if fwhm > 3.0 else 0.01)
    for row, code in zip(rows[0], codes.tolist(), strict=True):
        np.testing.assert_allclose(row, seen_by(bands, grid, product(code, grid)), rtol=1e-4)


def test_the_slope_of_the_responsivity_counts() -> None:
    centres = np.linspace(750.0, 775.0, 12)
    flat, sloping = (
        ProductTable(
            BandSet(centres, np.array(6.0), "gaussian", None, response),
            CODES,
            LIGHT.wavelength,
            SOURCES,
            paints,
        ).rows(np.array([2]))
        for response in (None, lambda nm: 1.0 - 0.03 * (nm - 760.0))
    )
    assert np.abs(flat / sloping - 1).max() > 0.005


def test_columns_see_their_own_wavelengths() -> None:
    shift = 1.5 * np.linspace(-1.0, 1.0, 9) ** 2
    bands = BandSet(np.linspace(399.356, 1001.42, 272), np.array(6.0), "gaussian", shift)
    codes = some_codes()[::61]
    seen = at_columns(ProductTable(bands, CODES, LIGHT.wavelength, SOURCES, paints), codes)
    for column in (0, 1, 4, 7):
        for place, code in enumerate(codes.tolist()):
            np.testing.assert_allclose(
                seen[place, :, column], seen_by(bands, GRID, product(code), shift[column]), rtol=1e-4
            )


@pytest.mark.parametrize("shift", [None, np.linspace(-0.6, 0.7, 5)], ids=["no smile", "smile"])
def test_mixing_is_the_weighted_sum_over_paths(shift: Any) -> None:
    bands = BandSet(np.linspace(450.0, 900.0, 7), np.array(6.0), wavelength_shift=shift)
    table = ProductTable(bands, CODES, LIGHT.wavelength, SOURCES, paints)
    rng, known = np.random.default_rng(1), some_codes(6)
    codes = rng.choice(known, (2, 3, 5))
    codes[:, 2, :2] = -1  # empty slots, whatever their weight
    weight = rng.random(codes.shape).astype(np.float32)
    out = np.full((2, 7, 5), np.nan, np.float32)
    table.mix(weight, codes, out)
    products = np.broadcast_to(at_columns(table, known), (known.size, 7, 5))
    expected = np.zeros(out.shape)
    for line, slot, column in zip(*np.nonzero(codes >= 0), strict=True):
        path = np.searchsorted(known, codes[line, slot, column])
        expected[line, :, column] += weight[line, slot, column] * products[path, :, column]
    np.testing.assert_allclose(out, expected, rtol=1e-5)


def test_an_imager_integrates_without_norm() -> None:
    camera = Camera.of(SimulationSettings(bands=40, columns=7, smile_nm=0.8, srf_shape="slit"))
    table = ProductTable(BandSet.of(camera.imager), CODES, LIGHT.wavelength, SOURCES, paints, normalise=False)
    codes = some_codes()[::97]
    grid = np.arange(340.0, 1080.0, 0.05)
    expected = camera.imager.integrals(
        np.stack([np.interp(grid, GRID, product(code)) for code in codes.tolist()]), grid
    )
    np.testing.assert_allclose(at_columns(table, codes) * camera.imager.element_factor, expected, rtol=1e-4)


def test_a_source_without_light_gives_nothing() -> None:
    table = ProductTable(BandSet.of(), CODES, LIGHT.wavelength, {2: LIGHT.sun, 3: 0 * LIGHT.sun}, paints)
    assert not table.rows(np.array([0, 1, 3, 4])).any()
    np.testing.assert_allclose(
        table.irradiance(2)[0],
        seen_by(BandSet.of(), GRID, np.interp(GRID, LIGHT.wavelength, LIGHT.sun)),
        rtol=1e-4,
    )


def test_who_asks_first_changes_no_bit() -> None:
    codes = some_codes()
    args = (BandSet.of(), CODES, LIGHT.wavelength, SOURCES, paints)
    together = ProductTable(*args).rows(codes)
    one_by_one, shared = ProductTable(*args), ProductTable(*args)
    for place in np.random.default_rng(1).permutation(codes.size)[:50]:
        np.testing.assert_array_equal(one_by_one.rows(codes[place : place + 1])[:, 0], together[:, place])
    np.testing.assert_array_equal(one_by_one.rows(codes), together)

    def ask(seed: int) -> None:
        chosen = np.sort(np.random.default_rng(seed).choice(codes.size, 60, replace=False))
        np.testing.assert_array_equal(shared.rows(codes[chosen]), together[:, chosen])

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(ask, range(64)))
    assert np.unique(shared._cached_codes).size == shared._cached_codes.size == len(shared._products)


def test_a_table_travels_without_what_it_has_made(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = some_codes()
    table = ProductTable(BandSet.of(), CODES, LIGHT.wavelength, SOURCES, paints)
    empty = len(pickle.dumps(table))
    rows = table.rows(codes)
    assert len(pickle.dumps(table)) == empty
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(table)).rows(codes), rows)
    # and what does not fit is made again each time
    monkeypatch.setattr(relighting, "_MAX_CACHE_BYTES", 100 * 272 * 4)
    small = pickle.loads(pickle.dumps(table))
    for start in range(0, codes.size, 30):
        np.testing.assert_array_equal(small.rows(codes[start : start + 30]), rows[:, start : start + 30])
    assert 0 < small._products.nbytes <= 100 * 272 * 4


def test_codes_of_another_scene_are_refused() -> None:
    table = ProductTable(
        BandSet.of(), PathCodes.of(3, 4), LIGHT.wavelength, SOURCES, lambda nm: np.ones((2, nm.size))
    )
    assert table.rows(np.empty(0, np.int64)).shape == (1, 0, 272)
    with pytest.raises(SchemaError, match="path-code-unknown"):
        table.rows(np.array([code_of(0, 2, digit_bits=CODES.digit_bits)]))


def test_means_over_cells_keep_the_integral() -> None:
    rng = np.random.default_rng(3)
    wavelength = np.sort(rng.uniform(400.0, 500.0, 300))
    spectrum = rng.uniform(0.0, 2.0, 300)
    for step in (0.05, 0.7, 5.0):
        grid = np.arange(380.0, 520.0, step)
        inside = np.diff(
            np.concatenate([grid - step / 2, grid[-1:] + step / 2]).clip(wavelength[0], wavelength[-1])
        )
        assert (cell_means(wavelength, spectrum, grid) * inside).sum() == pytest.approx(
            np.trapezoid(spectrum, wavelength), rel=1e-12
        )


def test_bands_that_cannot_be_are_all_named() -> None:
    with pytest.raises(SchemaError) as caught:
        BandSet(np.array([500.0, 400.0]), np.array([1.0, 2.0, 3.0]), "box", np.array([[1.0]]))
    assert str(caught.value).count("\n") == 4
    with pytest.raises(SchemaError, match="wavelength"):
        BandSet(np.array([500.0, np.nan]), np.array(6.0))
    with refusal(SchemaError, "variable-missing", "'wavelength'", "'fwhm'"):
        BandSet.of(object())


@pytest.mark.parametrize("bands", [1, 2, 5, 272])
def test_few_bands(bands: int) -> None:
    centres = np.linspace(420.0, 980.0, bands)
    table = ProductTable(
        BandSet(centres, np.array(6.0)), CODES, LIGHT.wavelength, {0: np.ones_like(LIGHT.sky)}, paints
    )
    np.testing.assert_allclose(table.rows(np.array([0])), 1 / np.pi, rtol=1e-6)
    assert BandResponses(BandSet(centres, np.array(6.0))).width <= bands
