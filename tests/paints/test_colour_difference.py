"""CIE Lab and CIEDE2000 against published values."""

import numpy as np
import pytest

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.daylight_colours import COLOURS, ciede2000, lab_of, parse_colour, srgb_hex

PAIRS = [
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, 3.1571, -77.2803), (50.0, 0.0, -82.7485), 2.8615),
    ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0000),
    ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
    ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0009), 7.1792),
    ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0011), 7.2195),
    ((50.0, 2.5, 0.0), (50.0, 0.0, -2.5), 4.3065),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((22.7233, 20.0904, -46.6940), (23.0331, 14.9730, -42.5619), 2.0373),
    ((90.8027, -2.0831, 1.4410), (91.1528, -1.6435, 0.0447), 1.4441),
    ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
]
"""Some of the pairs of Sharma, Wu & Dalal (2005), table 1, those with turns of hue among them."""


@pytest.mark.parametrize(("one", "other", "expected"), PAIRS)
def test_published_pairs(one: tuple[float, ...], other: tuple[float, ...], expected: float) -> None:
    assert ciede2000(one, other) == pytest.approx(expected, abs=5e-5)
    assert ciede2000(other, one) == pytest.approx(expected, abs=5e-5)


def test_lab_of_the_primaries() -> None:
    # the usual values of sRGB's primaries under D65
    expected = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [32.30, 79.19, -107.86]]
    np.testing.assert_allclose(lab_of(np.eye(3)), expected, atol=0.02)


def test_names_and_digits() -> None:
    for name, digits in COLOURS.items():
        assert srgb_hex(parse_colour(name)) == digits
        np.testing.assert_array_equal(parse_colour(digits.upper()), parse_colour(name))
    assert srgb_hex(parse_colour(" GRAY")) == COLOURS["grey"]
    assert (srgb_hex(parse_colour("Dark_Red")), srgb_hex([np.nan, 0.0, 0.0])) == (COLOURS["dark red"], "")


@pytest.mark.parametrize(("colour", "hint"), [("rde", "did you mean 'red'"), ("#12345", "colour-unknown")])
def test_what_is_no_colour(colour: str, hint: str) -> None:
    with pytest.raises(SchemaError, match=hint):
        parse_colour(colour)
