"""What segments of a scene are by their spectra, and what lies around a piece of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.model import SHADED

__all__ = ["DARK", "Surfaces", "largest_body", "ring_around"]


DARK = 0.05
"""Mean reflectance below which a surface is a window, or a dark paint [1]."""
_DARKEST, _SURE = 0.002, 0.0125
"""Mean reflectance from which something is seen, and from which a bluish one is no shadow for sure [1]."""
_BLUENESS = (0.65, 2.5)
"""Of windows, which mirror the sky, and send a little of what is behind them."""
_BLUE, _RED, _EDGE_OF_RED, _INFRARED = (430.0, 490.0), (660.0, 690.0), (735.0, 765.0), (790.0, 900.0)
"""Of the red edge of leaves, and of what the sky's mirror image shows in [nm]."""
_SAME_GROUND, _LEVELS = np.cos(np.radians(3.0)), 0.2
"""Of what is like the ground: cosine of the spectral angle, and difference of the logarithm of length."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What segments of a scene model are by their spectra.

    Attributes
    ----------
    level, blueness : (segment,)
        Mean reflectance [1]; ratio of blue to near infrared.
    dark, ground, vegetation, shade : (segment,)
        Whether it is dark as glass, like the largest body, green as leaves, in another body's shadow.
    """

    level: Floats
    blueness: Floats
    dark: Bools
    ground: Bools
    vegetation: Bools
    shade: Bools

    @classmethod
    def of(cls, model: SceneModel) -> Surfaces:
        """Return those of a scene model."""
        spectrum = np.nan_to_num(model.spectrum)
        level = spectrum.mean(axis=1)
        blue, red, edge, infrared = (
            _mean_over(spectrum, model.channel_wavelength, span)
            for span in (_BLUE, _RED, _EDGE_OF_RED, _INFRARED)
        )
        blueness = blue / np.maximum(infrared, 1e-4)
        reference = np.nan_to_num(model.reference)
        length = np.linalg.norm(reference, axis=1, keepdims=True)
        direction = reference / np.maximum(length, 1e-9)
        ground = _like_the_largest(model, direction, length[:, 0])
        shade = model.state == SHADED
        dark = (level > _DARKEST) & (level < DARK)
        glassy = (blueness > _BLUENESS[0]) & (blueness < _BLUENESS[1]) & ~(shade & ground & (level < _SURE))
        dark &= glassy
        # leaves rise within 50 nm, and no further; pigments take their time
        leaves = (edge > 3.0 * red) & (infrared < 1.4 * edge)
        return cls(level, blueness, dark, ground, leaves, shade)


def largest_body(model: SceneModel) -> int:
    """Return the number of the body that most pixels show, which is taken for the ground."""
    return int(np.argmax(np.bincount(model.body, weights=model.size, minlength=model.segments)))


def _like_the_largest(model: SceneModel, direction: Floats, length: Floats) -> Bools:
    """Return which segments are the largest body, or look like it, whatever their light (segment,)."""
    if not model.segments:
        return np.zeros(0, bool)
    largest = largest_body(model)
    level = length / max(float(length[largest]), 1e-9)
    like = (direction @ direction[largest] > _SAME_GROUND) & (
        np.abs(np.log(np.maximum(level, 1e-9))) < _LEVELS
    )
    return np.asarray(like | (model.body == largest))


def _mean_over(spectrum: Floats, wavelength: Floats, span: tuple[float, float]) -> Floats:
    """Return the mean of channels in a span [nm], or of the nearest one."""
    chosen = (wavelength >= span[0]) & (wavelength <= span[1])
    if not chosen.any():
        chosen[np.argmin(np.abs(wavelength - 0.5 * sum(span)))] = True
    return np.asarray(spectrum[:, chosen].mean(axis=1))


def ring_around(mask: Bools, width: int) -> Bools:
    """Return the pixels around a mask (line, column), from 3 to 3 + width away."""
    from scipy.ndimage import binary_dilation

    square = np.ones((3, 3), bool)
    inner = binary_dilation(mask, square, iterations=3)
    return np.asarray(binary_dilation(inner, square, iterations=width) & ~inner)
