"""Colours in daylight: sRGB of reflectance spectra, CIE Lab, CIEDE2000, and names of car colours."""

import difflib
import re

import numpy as np

from hyperpaint.base import Array, ArrayLike, Floats, SchemaError

from .responses import band_spacing

# XYZ of an equal-energy white, adapted to D65 (Bradford), to linear sRGB (IEC 61966-2-1)
_BRADFORD_E_TO_D65 = np.array(
    [
        [0.9531874, -0.0265906, 0.0238731],
        [-0.0382467, 1.0288406, 0.0094060],
        [0.0026068, -0.0030332, 1.0892565],
    ]
)
_XYZ_TO_SRGB = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)


def colour_matching(wavelength: ArrayLike) -> Array:
    """Return the CIE 1931 colour-matching functions x, y, z (3, band) at wavelengths [nm].

    The multi-lobe fit of [1]_, within 1 % of the tables.

    References
    ----------
    .. [1] C. Wyman, P.-P. Sloan, P. Shirley, "Simple Analytic Approximations to the CIE XYZ Color Matching
       Functions", J. Computer Graphics Techniques 2(2), 1-11 (2013).

    Examples
    --------
    >>> print(colour_matching([555.0]).round(2).ravel())
    [0.52 1.   0.01]
    """
    nm = np.asarray(wavelength, np.float64)

    def lobe(centre: float, below: float, above: float) -> Array:
        return np.asarray(np.exp(-0.5 * ((nm - centre) / np.where(nm < centre, below, above)) ** 2))

    x = 1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2)
    y = 0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1)
    return np.stack([x, y, 1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8)])


def srgb(spectra: ArrayLike, wavelength: ArrayLike) -> Array:
    """Return the colours of reflectance spectra in daylight (..., 3), sRGB from 0 to 1, white being 1.

    ``spectra`` (..., band): reflectance [1], NaN is interpolated from the neighbours; ``wavelength`` (band,):
    increasing [nm]. NaN where no visible band has a value.

    Raises `SchemaError`: there are fewer than three bands between 380 and 780 nm.

    Examples
    --------
    >>> nm = np.arange(400.0, 700.0, 5.0)
    >>> srgb(np.where(nm > 600.0, 0.8, 0.05), nm).argmax()
    np.int64(0)
    """
    nm = np.asarray(wavelength, np.float64)
    visible = np.flatnonzero((nm > 380) & (nm < 780))
    SchemaError.raise_if(
        visible.size < 3,
        f"{visible.size} bands between 380 and 780 nm",
        expected="at least 3 for a colour",
        code="visible-bands-missing",
    )
    nm = nm[visible]
    values = np.asarray(spectra, np.float64)[..., visible]
    flat = values.reshape(-1, visible.size)
    filled = np.full_like(flat, np.nan)
    for row, spectrum in zip(filled, flat, strict=True):
        is_finite = np.isfinite(spectrum)
        if is_finite.any():
            row[:] = np.interp(nm, nm[is_finite], spectrum[is_finite])
    linear = filled @ srgb_weights(nm, None)[..., 0].T.astype(np.float64)
    return encode_srgb(linear.clip(0.0, 1.0)).reshape(*values.shape[:-1], 3)


def encode_srgb(linear: Array) -> Array:
    # Return linear values 0 to 1 in the encoding of the sRGB standard.
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.asarray(np.where(linear <= 0.0031308, 12.92 * linear, curved), np.float32)


def srgb_weights(wavelength: Array, shift: Array | None) -> Array:
    # Return the weights of bands in linear sRGB (rgb, band, 1), or (rgb, band, column) with smile.
    centres = wavelength[:, None]
    if shift is not None:
        centres = centres + np.atleast_2d(shift)
    matching = colour_matching(centres) * band_spacing(wavelength)[:, None]
    matching = matching / matching.sum(axis=1, keepdims=True)
    return np.asarray(np.tensordot(_XYZ_TO_SRGB @ _BRADFORD_E_TO_D65, matching, 1), np.float32)


#: sRGB of typical paints by the words for their colours.
COLOURS = {
    "white": "#eeeeec", "ivory": "#ece2c6", "beige": "#cdbb98", "silver": "#b4b7b9", "grey": "#7c7f82",
    "anthracite": "#3c4044", "black": "#141416", "yellow": "#f2c61f", "gold": "#b8963f", "orange": "#e8742a",
    "red": "#a3222a", "dark red": "#5c1a20", "pink": "#e69aa6", "violet": "#74459a", "brown": "#6f4b32",
    "light blue": "#86b7dc", "blue": "#27509e", "dark blue": "#18264d", "turquoise": "#25959a",
    "light green": "#9bc98f", "green": "#2f7d43", "dark green": "#1d4030",
}  # fmt: skip

_HEX = re.compile(r"#?([0-9a-f]{6})")
#: Linear sRGB to XYZ (IEC 61966-2-1).
_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def parse_colour(colour: str) -> Floats:
    """Return sRGB (rgb,) from 0 to 1 of a colour name or hexadecimal digits; `SchemaError` for other text.

    Examples
    --------
    >>> parse_colour("#ff8000").round(2), parse_colour("gray").round(2)
    (array([1. , 0.5, 0. ]), array([0.49, 0.5 , 0.51]))
    """
    word = " ".join(colour.lower().replace("_", " ").replace("-", " ").split()).replace("gray", "grey")
    match = _HEX.fullmatch(COLOURS.get(word, colour.strip().lower()))
    if match is None:
        close = difflib.get_close_matches(word, COLOURS, 1)
        raise SchemaError(
            f"colour {colour!r:.60} is unknown",
            expected="a name or sRGB such as '#a3222a'",
            mend=f"did you mean {close[0]!r}?" if close else f"known are {', '.join(COLOURS)}",
            code="colour-unknown",
        )
    return np.frombuffer(bytes.fromhex(match[1]), np.uint8) / 255.0


def colour_name(spectrum: ArrayLike, wavelength: ArrayLike) -> str:
    """Return the word of `COLOURS` that is nearest to a reflectance spectrum (band,) [1], in CIEDE2000.

    ``wavelength`` (band,): increasing [nm]. "paint" with fewer than three visible bands or values.

    Examples
    --------
    >>> nm = np.arange(400.0, 700.0, 5.0)
    >>> colour_name(np.where(nm > 600.0, 0.4, 0.02), nm), colour_name(np.full(60, 0.8), nm)
    ('red', 'white')
    """
    nm, values = np.asarray(wavelength, np.float64), np.asarray(spectrum, np.float64)
    if np.count_nonzero((nm > 380) & (nm < 780) & np.isfinite(values)) < 3:
        return "paint"
    words = lab_of([parse_colour(word) for word in COLOURS])
    return list(COLOURS)[int(ciede2000(words, lab_of(srgb(values, nm))).argmin())]


def srgb_hex(colour: ArrayLike) -> str:
    """Return sRGB (rgb,) from 0 to 1 as hexadecimal digits; empty for NaN.

    Examples
    --------
    >>> srgb_hex([1.0, 0.5, 0.0])
    '#ff8000'
    """
    values = np.asarray(colour, np.float64)
    return (
        ""
        if not np.isfinite(values).all()
        else "#" + np.rint(values.clip(0.0, 1.0) * 255.0).astype(np.uint8).tobytes().hex()
    )


def lab_of(srgb: ArrayLike) -> Floats:
    """Return CIE 1976 L*, a*, b* of sRGB (..., rgb) from 0 to 1, relative to its white (D65).

    Examples
    --------
    >>> (lab_of([[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]]).round(1) + 0.0).tolist()
    [[100.0, 0.0, 0.0], [53.4, 0.0, 0.0]]
    """
    encoded = np.asarray(srgb, np.float64)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    relative = linear @ (_TO_XYZ / _TO_XYZ.sum(axis=1, keepdims=True)).T
    edge = 6.0 / 29.0
    x, y, z = np.moveaxis(
        np.where(relative > edge**3, np.cbrt(relative), relative / (3.0 * edge**2) + 4.0 / 29.0), -1, 0
    )
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def ciede2000(lab: ArrayLike, other: ArrayLike) -> Floats:
    """Return the CIEDE2000 difference of colours in CIE Lab (..., 3); a difference of 1 is just visible.

    CIE 142-2001, as in Sharma, Wu & Dalal, Color Res. Appl. 30, 21 (2005).

    Examples
    --------
    >>> ciede2000([[50.0, 2.6772, -79.7751]], [50.0, 0.0, -82.7485]).round(4)
    array([2.0425])
    """
    (light, a, b), (light2, a2, b2) = (
        np.moveaxis(np.asarray(colour, np.float64), -1, 0) for colour in (lab, other)
    )
    mean_chroma = (np.hypot(a, b) + np.hypot(a2, b2)) / 2.0
    stretch = 1.0 + 0.5 * (1.0 - np.sqrt(mean_chroma**7 / (mean_chroma**7 + 25.0**7)))
    chroma, chroma2 = np.hypot(stretch * a, b), np.hypot(stretch * a2, b2)
    hue, hue2 = (np.degrees(np.arctan2(y, stretch * x)) % 360.0 for x, y in ((a, b), (a2, b2)))
    grey = chroma * chroma2 == 0.0
    turn = np.where(grey, 0.0, (hue2 - hue + 180.0) % 360.0 - 180.0)
    # halfway along the shorter arc; a grey has no hue
    mean_hue = np.where(grey, hue + hue2, (hue + turn / 2.0) % 360.0)
    mean_light, mean_chroma = (light + light2) / 2.0, (chroma + chroma2) / 2.0
    hue_weight = 1.0 + sum(
        height * np.cos(np.radians(times * mean_hue + shift))
        for height, times, shift in ((-0.17, 1, -30.0), (0.24, 2, 0.0), (0.32, 3, 6.0), (-0.20, 4, -63.0))
    )
    squared = (mean_light - 50.0) ** 2
    d_light = (light2 - light) / (1.0 + 0.015 * squared / np.sqrt(20.0 + squared))
    d_chroma = (chroma2 - chroma) / (1.0 + 0.045 * mean_chroma)
    d_hue = 2.0 * np.sqrt(chroma * chroma2) * np.sin(np.radians(turn / 2.0))
    d_hue = d_hue / (1.0 + 0.015 * mean_chroma * hue_weight)
    blue_turn = 30.0 * np.exp(-(((mean_hue - 275.0) / 25.0) ** 2))
    rotation = -2.0 * np.sqrt(mean_chroma**7 / (mean_chroma**7 + 25.0**7))
    rotation = rotation * np.sin(np.radians(2.0 * blue_turn))
    return np.asarray(np.sqrt(d_light**2 + d_chroma**2 + d_hue**2 + rotation * d_chroma * d_hue))
