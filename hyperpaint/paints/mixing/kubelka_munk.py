r"""Kubelka and Munk's thick layer, and Saunderson's interface above it.

A layer so thick that nothing shines through, with absorption K and scattering S per depth, reflects

.. math:: R_\infty = 1 + q - \sqrt{q^2 + 2 q}, \qquad q = K / S = (1 - R_\infty)^2 / (2 R_\infty)

(Kubelka & Munk, Z. techn. Phys. 12, 593, 1931). Under an interface that mirrors k1 of the light from outside
and k2 of the diffuse light from inside, light is thrown back at the layer again and again. The sum over the
returns, :math:`(1 - k_1) R_\infty (1 - k_2) \sum_j (k_2 R_\infty)^j`, is what leaves beside the mirror image:

.. math:: R = k_1 + \frac{(1 - k_1) (1 - k_2) R_\infty}{1 - k_2 R_\infty}

(Saunderson, J. Opt. Soc. Am. 32, 727, 1942). It rises from k1 to 1 with :math:`R_\infty`, and is undone by
:math:`R_\infty = (R - k_1) / ((1 - k_1) (1 - k_2) + k_2 (R - k_1))`. All quantities are pure numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError

__all__ = ["Interface", "absorption_to_scattering", "thick_layer_reflectance"]


def absorption_to_scattering(reflectance: npt.ArrayLike) -> Floats:
    """Return K/S of a thick layer [1].

    Parameters
    ----------
    reflectance
        Of the layer without an interface [1], above 0 and up to 1, any shape.

    Examples
    --------
    >>> absorption_to_scattering([0.5, 1.0])
    array([0.25, 0.  ])
    """
    layer = np.asarray(reflectance, np.float64)
    return np.asarray((1.0 - layer) ** 2 / (2.0 * layer))


def thick_layer_reflectance(ratio: npt.ArrayLike) -> Floats:
    """Return the reflectance of a thick layer without an interface [1]; undoes `absorption_to_scattering`.

    Parameters
    ----------
    ratio
        K/S [1], 0 or more, any shape.

    Examples
    --------
    >>> thick_layer_reflectance([0.25, 0.0])
    array([0.5, 1. ])
    """
    q = np.asarray(ratio, np.float64)
    # the other root of the same square: no cancellation where the layer is dark
    return np.asarray(1.0 / (1.0 + q + np.sqrt(q * (q + 2.0))))


@dataclass(frozen=True)
class Interface:
    """The surface of a paint, which mirrors light on both of its sides.

    Attributes
    ----------
    k1
        Reflectance for light from outside [1]: ((n - 1) / (n + 1))^2 near normal, 0.04 for an index of 1.5.
    k2
        Reflectance for diffuse light from inside [1]: 0.60 for an index of 1.5; less where scattered light is
        no longer diffuse (0.4 to 0.5: Mudgett & Richards, Appl. Opt. 10, 1485, 1971).

    Raises
    ------
    SchemaError
        One is outside 0 to below 1; both are listed.

    Examples
    --------
    >>> coat = Interface()
    >>> coat.seen([0.5]).round(4), coat.layer(coat.seen([0.5])).round(4)
    (array([0.2743]), array([0.5]))
    """

    k1: float = 0.04
    k2: float = 0.60

    def __post_init__(self) -> None:
        problems = Problems("there is no such interface of a paint", SchemaError)
        for name, value in (("k1", self.k1), ("k2", self.k2)):
            if not 0.0 <= value < 1.0:
                problems.add(f"{name}={value!r}, expected a reflectance from 0 to below 1")
        problems.raise_if_any()

    def seen(self, layer: npt.ArrayLike) -> Floats:
        """Return what leaves of a layer's reflectance, without the mirror image: from 0 to 1 - k1."""
        inside = np.asarray(layer, np.float64)
        return np.asarray((1.0 - self.k1) * (1.0 - self.k2) * inside / (1.0 - self.k2 * inside))

    def layer(self, seen: npt.ArrayLike) -> Floats:
        """Return the reflectance of the layer below; undoes `seen`, and is above 1 for more than 1 - k1."""
        body = np.asarray(seen, np.float64)
        return np.asarray(body / ((1.0 - self.k1) * (1.0 - self.k2) + self.k2 * body))
