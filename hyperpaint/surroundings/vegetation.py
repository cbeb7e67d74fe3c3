"""Leaves by their spectrum: lawns are ground and hold shadows; crowns of trees are no cars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Bools, Floats


@dataclass(frozen=True)
class VegetationRules:
    """The red edge: leaves rise within 50 nm, no further; blue paints do, too, and are brighter in blue."""

    blue_nm: tuple[float, float] = (430.0, 490.0)  #: In which leaves are darker than in the green [nm].
    green_nm: tuple[float, float] = (535.0, 565.0)  #: In which they are brighter [nm].
    red_nm: tuple[float, float] = (660.0, 690.0)  #: Below the red edge [nm].
    edge_nm: tuple[float, float] = (735.0, 765.0)  #: End of the red edge [nm].
    infrared_nm: tuple[float, float] = (790.0, 900.0)  #: Beyond it [nm].
    min_edge: float = 3.0  #: Reflectance there over that in the red, at least [1].
    max_rise: float = 1.4  #: Reflectance beyond over that, at most [1].


VEGETATION = VegetationRules()


def is_vegetation(spectrum: Floats, wavelength: Floats) -> Bools:
    """Return whether spectra (n, channel) [1] are those of leaves (n,); ``wavelength`` (channel,) [nm]."""
    rules = VEGETATION
    spans = (rules.blue_nm, rules.green_nm, rules.red_nm, rules.edge_nm, rules.infrared_nm)
    blue, green, red, edge, infrared = (
        _mean_over(np.nan_to_num(spectrum), wavelength, span) for span in spans
    )
    return np.asarray(
        (edge > rules.min_edge * red) & (infrared < rules.max_rise * edge) & (green > blue) & (red > 0.0)
    )


def _mean_over(spectrum: Floats, wavelength: Floats, span: tuple[float, float]) -> Floats:
    chosen = (wavelength >= span[0]) & (wavelength <= span[1])
    if not chosen.any():
        chosen[np.argmin(np.abs(wavelength - 0.5 * sum(span)))] = True
    return np.asarray(spectrum[:, chosen].mean(axis=1))
