r"""Kubelka and Munk's thick layer, and Saunderson's interface above it.

An opaque layer with absorption K and scattering S per depth reflects

.. math:: R_\infty = 1 + q - \sqrt{q^2 + 2 q}, \qquad q = K / S = (1 - R_\infty)^2 / (2 R_\infty)

(Kubelka & Munk, Z. techn. Phys. 12, 593, 1931). An interface above it mirrors k1 of the light from outside
and k2 of the diffuse light from inside, so that light returns to the layer repeatedly. The sum over the
returns, :math:`(1 - k_1) R_\infty (1 - k_2) \sum_j (k_2 R_\infty)^j`, adds to the mirrored light:

.. math:: R = k_1 + \frac{(1 - k_1) (1 - k_2) R_\infty}{1 - k_2 R_\infty}

(Saunderson, J. Opt. Soc. Am. 32, 727, 1942). R rises from k1 to 1 with :math:`R_\infty`; the inverse is
:math:`R_\infty = (R - k_1) / ((1 - k_1) (1 - k_2) + k_2 (R - k_1))`. All quantities are pure numbers.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.mirrored_light import EXCLUDED, mirror_reflection
from hyperpaint.base.schema import BAND


def absorption_to_scattering(reflectance: npt.ArrayLike) -> Floats:
    """Return K/S [1] of a thick layer without an interface from its reflectance, above 0 and up to 1 [1].

    Examples
    --------
    >>> absorption_to_scattering([0.5, 1.0])
    array([0.25, 0.  ])
    """
    layer = np.asarray(reflectance, np.float64)
    return np.asarray((1.0 - layer) ** 2 / (2.0 * layer))


def thick_layer_reflectance(ratio: npt.ArrayLike) -> Floats:
    """Return the reflectance [1] of a thick layer from its K/S [1]; inverse of `absorption_to_scattering`.

    Examples
    --------
    >>> thick_layer_reflectance([0.25, 0.0])
    array([0.5, 1. ])
    """
    q = np.asarray(ratio, np.float64)
    # equal to 1 + q - sqrt(q^2 + 2 q), without cancellation where the layer is dark
    return np.asarray(1.0 / (1.0 + q + np.sqrt(q * (q + 2.0))))


@dataclass(frozen=True)
class Interface:
    """The surface of a paint, which reflects light on both sides.

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
        A value is negative, or 1 and more; all are listed.

    Examples
    --------
    >>> coat = Interface()
    >>> coat.outside([0.5]).round(4), coat.layer(coat.outside([0.5])).round(4)
    (array([0.2743]), array([0.5]))
    """

    k1: float = 0.04
    k2: float = 0.60

    def __post_init__(self) -> None:
        problems = Problems("the interface of a paint cannot have these values", SchemaError)
        for name, value in (("k1", self.k1), ("k2", self.k2)):
            if not 0.0 <= value < 1.0:
                problems.add(
                    f"{name}={value!r}", expected="a reflectance from 0 to below 1", code="value-out-of-range"
                )
        problems.raise_if_any()

    def outside(self, layer: npt.ArrayLike) -> Floats:
        """Return the reflectance outside the interface of a layer, without mirrored light: 0 to 1 - k1."""
        inside = np.asarray(layer, np.float64)
        return np.asarray((1.0 - self.k1) * (1.0 - self.k2) * inside / (1.0 - self.k2 * inside))

    def layer(self, outside: npt.ArrayLike) -> Floats:
        """Return the reflectance of the layer; inverse of `outside`, above 1 for inputs above 1 - k1."""
        body = np.asarray(outside, np.float64)
        return np.asarray(body / ((1.0 - self.k1) * (1.0 - self.k2) + self.k2 * body))


#: Minimum reflectance of a layer without an interface [1]: lower values are noise (soot in a binder has
#: 0.02), and their K/S would dominate any mixture.
MIN_LAYER_REFLECTANCE = 1e-3

#: Maximum share of a spectrum that noise may make darker than the mirrored light [1].
MAX_DARK_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Coating:
    """Interface and mirrored light between a layer of paint and its reflectance in the library."""

    interface: Interface  #: Interface above the layer.
    mirrored: Floats  #: (band,) or (): Mirrored light in the reflectance [1].

    def ratio(self, reflectance: npt.ArrayLike, names: list[str]) -> Floats:
        """Return K/S [1] of spectra (signature, ..., band); NaN stays NaN.

        Raises `SchemaError`: more than 5 % of a paint's spectrum is darker than the light mirrored by the
        coat; all such paints are listed. Warns of values that are impossible for such a layer; they are
        replaced by the nearest possible value.
        """
        values = np.asarray(reflectance, np.float64)
        layer = self.interface.layer(values - self.mirrored)
        # values far below 0, where the denominator changes its sign, are too low as well
        low = (layer < MIN_LAYER_REFLECTANCE) | (values < self.mirrored)
        high = ~low & (layer > 1.0)
        problems = Problems("the library's reflectance is lower than its mirrored light", SchemaError)
        for name, is_dark, has_value in zip(names, values < self.mirrored, np.isfinite(values), strict=True):
            share = float(is_dark.sum() / max(int(has_value.sum()), 1))
            if self.mirrored.any() and share > MAX_DARK_SHARE:
                problems.add(
                    f"{share:.0%} of {name!r} is darker than {float(self.mirrored.max()):g}",
                    mend="pass as mirrored= the mirrored light in its reflectance (0 for none; outdoors k1 "
                    "times the diffuse fraction), or call remove_mirrored_sky first",
                    code="paint-too-dark",
                )
        problems.raise_if_any()
        if low.any() or high.any():
            finite_count = int(np.isfinite(values).sum())
            msg = (
                f"{int(low.sum())} of {finite_count} reflectances are darker than any paint layer under an "
                f"interface with k1 = {self.interface.k1:g}, {int(high.sum())} brighter; they were "
                f"replaced by the nearest possible values, of R_inf = {MIN_LAYER_REFLECTANCE:g} and 1"
            )
            warnings.warn(PaintWarning(msg, code="reflectance-outside-model"), stacklevel=4)
        layer = np.where(low, MIN_LAYER_REFLECTANCE, np.minimum(layer, 1.0))
        return absorption_to_scattering(np.where(np.isfinite(values), layer, np.nan))

    def reflectance(self, ratio: npt.ArrayLike) -> Floats:
        """Return the reflectance of layers from their K/S [1], clipped to 0 to 1; inverse of `ratio`."""
        reflectance = self.interface.outside(thick_layer_reflectance(ratio)) + self.mirrored
        return np.asarray(np.clip(reflectance, 0.0, 1.0))


def coating_of(library: xr.Dataset, k1: float, k2: float, mirrored: Any) -> Coating:
    """Return the coating between the layers of a library's paints and their reflectance.

    Takes ``library``: its reflectance may have the attribute ``mirror_reflection``; ``k1``, ``k2``: see
    `Interface`; ``mirrored``: mirrored light in the reflectance [1], one number, or one per band; by default
    0 if the library declares mirrored light excluded, or has a ``specular_reflectance``; else k1.

    Raises `SchemaError`: a value is no reflectance, or the attribute is invalid; all are listed.
    """
    interface = Interface(k1, k2)
    problems = Problems("the light mirrored by the coat is unknown", SchemaError)
    declared = None
    try:
        declared = mirror_reflection(library)
    except SchemaError as error:
        problems.add_error(str(library.attrs.get("title", "the library")), error)
    if mirrored is None:
        mirrored = 0.0 if declared == EXCLUDED else k1
    values = np.asarray(mirrored, np.float64)
    if values.shape not in ((), (library.sizes[BAND],)):
        problems.add(
            f"mirrored= has shape {values.shape}",
            expected="one number, or one per band",
            code="length-mismatch",
        )
    elif not ((values >= 0.0) & (values < 1.0)).all():
        problems.add(
            f"mirrored={mirrored!r:.40}", expected="values from 0 to below 1", code="value-out-of-range"
        )
    problems.raise_if_any()
    return Coating(interface, values)
