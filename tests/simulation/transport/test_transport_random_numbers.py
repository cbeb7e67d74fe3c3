"""Philox against its published vectors, and numbers that belong to where they are used."""

from __future__ import annotations

import numpy as np
import pytest
from support.transport_scenes import COMPILED

from hyperpaint.simulation.transport.random_numbers import philox, uniforms

#: Known answers of the authors' library Random123 1.09, kat_vectors, "philox4x32 10".
KNOWN = [
    ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_philox_gives_the_published_words(counter: list[int], key: list[int], words: list[int]) -> None:
    assert [int(word) for word in philox(*map(np.uint64, counter), *map(np.uint64, key))] == words


def test_numbers_are_even_inside_the_interval() -> None:
    count = 20000 if COMPILED else 500
    found = np.array([uniforms(7, 3, 5, sample, 2) for sample in range(count)])
    assert ((found > 0) & (found < 1)).all()
    np.testing.assert_allclose(found.mean(axis=0), 0.5, atol=4 / np.sqrt(12 * count))
    np.testing.assert_allclose(np.corrcoef(found.T), np.eye(4), atol=5 / np.sqrt(count))


def test_every_part_of_the_key_matters() -> None:
    places = [
        (0, 0, 0, 0, 0), (1, 0, 0, 0, 0), (1 << 40, 0, 0, 0, 0), (0, 1, 0, 0, 0), (0, 0, 1, 0, 0),
        (0, 0, 0, 1, 0), (0, 0, 0, 0, 1),
    ]  # fmt: skip
    assert len({uniforms(*place) for place in places}) == len(places)
    assert uniforms(1, 2, 3, 4, 5) == uniforms(1, 2, 3, 4, 5)
