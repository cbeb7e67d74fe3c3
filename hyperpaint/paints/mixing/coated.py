"""From the reflectance of a library to K/S, and back: mirrored light off, interface off, and on again."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.mirrored_light import EXCLUDED, mirror_reflection
from hyperpaint.base.schema import BAND

from .kubelka_munk import Interface, absorption_to_scattering, thick_layer_reflectance

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["BLACKEST", "Coating", "coating_of"]


BLACKEST = 1e-3
"""Of a layer without an interface [1]: blacker is no paint (soot in a binder is 0.02), but noise, whose K/S
would drown all others in a mixture."""

_FEW = 0.05
"""Share of a spectrum that may be darker than its own interface, by noise."""


@dataclass(frozen=True, eq=False)
class Coating:
    """What lies between a layer of paint and its reflectance as the library holds it.

    Attributes
    ----------
    interface
        Of the layer.
    mirrored : (band,) or ()
        Mirrored light that the reflectance holds [1].
    """

    interface: Interface
    mirrored: Floats

    def ratio(self, reflectance: npt.ArrayLike, names: list[str]) -> Floats:
        """Return K/S [1] of spectra (paint, ..., band); NaN where there is none.

        Raises
        ------
        SchemaError
            Over a twentieth of the spectra of a paint is darker than the light that the coat mirrors; all
            such paints are listed.

        Warns
        -----
        PaintWarning
            Some values no such layer can have; they are replaced by the nearest that it can.
        """
        values = np.asarray(reflectance, np.float64)
        layer = self.interface.layer(values - self.mirrored)
        # far below 0, where the denominator has changed its sign, is dark as well
        low = (layer < BLACKEST) | (values < self.mirrored)
        high = ~low & (layer > 1.0)
        self._refuse_dark(values < self.mirrored, np.isfinite(values), names)
        if low.any() or high.any():
            known = int(np.isfinite(values).sum())
            msg = (
                f"{int(low.sum())} of {known} reflectances are darker than any layer of paint under an "
                f"interface with k1 = {self.interface.k1:g}, {int(high.sum())} brighter; they were replaced "
                f"by what is nearest, of R_inf = {BLACKEST:g} and 1"
            )
            warnings.warn(msg, PaintWarning, stacklevel=4)
        layer = np.where(low, BLACKEST, np.minimum(layer, 1.0))
        return absorption_to_scattering(np.where(np.isfinite(values), layer, np.nan))

    def reflectance(self, ratio: npt.ArrayLike) -> Floats:
        """Return the reflectance of layers by their K/S [1], 0 to 1; undoes `ratio`."""
        seen = self.interface.seen(thick_layer_reflectance(ratio)) + self.mirrored
        return np.asarray(np.clip(seen, 0.0, 1.0))

    def _refuse_dark(self, dark: npt.NDArray[np.bool_], known: Any, names: list[str]) -> None:
        if not self.mirrored.any():
            return
        problems = Problems("the library's reflectance cannot hold that much mirrored light", SchemaError)
        for name, one, there in zip(names, dark, known, strict=True):
            share = float(one.sum() / max(int(there.sum()), 1))
            if share > _FEW:
                problems.add(f"{share:.0%} of {name!r} is darker than {float(self.mirrored.max()):g}")
        if len(problems):
            problems.add(
                "pass mirrored= what it holds of mirrored light: 0 for none; outdoors k1 times the diffuse "
                "fraction of the light; or use remove_mirrored_sky first"
            )
        problems.raise_if_any()


def coating_of(library: xr.Dataset, k1: float, k2: float, mirrored: Any) -> Coating:
    """Return what lies between the layers of a library's paints and their reflectance.

    Parameters
    ----------
    library
        Its reflectance may have the attribute ``mirror_reflection``.
    k1, k2
        See `Interface`.
    mirrored
        Mirrored light that the reflectance holds [1]: a number, or one a band. None: none where the library
        says that it is excluded, or has it apart as ``specular_reflectance``; else k1.

    Raises
    ------
    SchemaError
        One of them is no reflectance, or the attribute says neither; all are listed.
    """
    interface = Interface(k1, k2)
    problems = Problems("the light that the coat mirrors is not known", SchemaError)
    told = None
    try:
        told = mirror_reflection(library)
    except SchemaError as error:
        problems.add(str(error))
    if mirrored is None:
        mirrored = 0.0 if told == EXCLUDED else k1
    values = np.asarray(mirrored, np.float64)
    if values.shape not in ((), (library.sizes[BAND],)):
        problems.add(f"mirrored= has shape {values.shape}, expected a number or one a band")
    elif not ((values >= 0.0) & (values < 1.0)).all():
        problems.add("mirrored= leaves 0 to below 1")
    problems.raise_if_any()
    return Coating(interface, values)
