"""Mixing spectra against einsum."""

import numpy as np
import pytest
from support.transport_scenes import COMPILED

from hyperpaint.simulation.transport.mixing import index_paths, mix, mix_shifted

LINES, SLOTS, COLUMNS, PATHS, BANDS = (3, 7, 37, 50, 19) if COMPILED else (1, 3, 18, 9, 4)


def recorded() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    index = rng.integers(-1, PATHS, (LINES, SLOTS, COLUMNS)).astype(np.int32)
    return rng.uniform(size=index.shape).astype(np.float32), index


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_mix_is_a_sum_over_slots(kind: type) -> None:
    weight, index = recorded()
    table = np.random.default_rng(1).uniform(size=(PATHS, BANDS)).astype(kind)
    out = np.full((LINES, BANDS, COLUMNS), np.nan, np.float32)
    mix(weight, index, table, out)
    spectra = np.where((index >= 0)[..., None], table[index], 0)
    np.testing.assert_allclose(out, np.einsum("lsc,lscb->lbc", weight.astype(float), spectra), rtol=2e-6)


def test_each_column_has_its_own_spectra() -> None:
    weight, index = recorded()
    rng = np.random.default_rng(2)
    table = rng.uniform(size=(6, PATHS, BANDS))
    node = rng.integers(0, 3, COLUMNS)
    share = rng.uniform(size=(COLUMNS, 4))
    out = np.empty((LINES, BANDS, COLUMNS), np.float32)
    mix_shifted(weight, index, table, node, share, out)
    expected = np.zeros(out.shape)
    for column in range(COLUMNS):
        own = np.einsum("k,kpb->pb", share[column], table[node[column] : node[column] + 4])
        spectra = np.where((index[:, :, column] >= 0)[..., None], own[index[:, :, column]], 0)
        expected[:, :, column] = np.einsum("ls,lsb->lb", weight[:, :, column].astype(float), spectra)
    np.testing.assert_allclose(out, expected, rtol=3e-6)


def test_mixing_does_not_depend_on_blocks() -> None:
    weight, index = recorded()
    table = np.random.default_rng(1).uniform(size=(PATHS, BANDS))
    whole = np.empty((LINES, BANDS, COLUMNS), np.float32)
    mix(weight, index, table, whole)
    for line in range(LINES):
        part = np.empty((1, BANDS, COLUMNS), np.float32)
        mix(weight[line : line + 1], index[line : line + 1], table, part)
        np.testing.assert_array_equal(part[0], whole[line])


def test_codes_are_numbered_as_numpy_does() -> None:
    rng = np.random.default_rng(3)
    for count, kinds in ((5000, 40), (5000, 4000), (0, 1), (7, 1)) if COMPILED else ((200, 9), (0, 1)):
        code = rng.choice(rng.integers(0, 2**62, kinds), count).reshape(-1, 1)
        code[::5] = -1
        distinct, index = index_paths(code)
        assert (distinct.dtype, index.dtype) == (np.int64, np.int32)
        np.testing.assert_array_equal(distinct, np.unique(code[code >= 0]))
        assert index.shape == code.shape
        np.testing.assert_array_equal(index < 0, code < 0)
        np.testing.assert_array_equal(distinct[index[index >= 0]], code[code >= 0])
