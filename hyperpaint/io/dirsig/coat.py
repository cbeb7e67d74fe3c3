"""Body reflectance and mirror image of a paint, so that its clear coat is counted once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Coat", "coat_of"]


@dataclass(frozen=True)
class Coat:
    """What becomes of the light that a clear coat mirrors.

    Attributes
    ----------
    mirror_reflection
        Whether the library's reflectance holds it: ``included`` or ``excluded``.
    is_declared
        Whether the library says so.
    specular
        Fraction of DIRSIG's reflectance that is specular; ``library`` for what the library's
        ``specular_reflectance`` gives.
    """

    mirror_reflection: str
    is_declared: bool
    specular: float | str

    @property
    def attrs(self) -> dict[str, str]:
        """Attributes that say what was done."""
        source = "told by the library" if self.is_declared else "not told by the library, taken to be so"
        term = (
            "none: reflectance is diffuse"
            if self.specular == 0.0
            else f"SPECULAR_FRACTION of {self.specular}; emissivity = 1 - reflectance / (1 - fraction)"
        )
        return {
            "mirror_reflection": self.mirror_reflection,
            "mirror_reflection_source": source,
            "specular_term": term,
        }

    def fraction(self, centre: npt.NDArray[Any], mirror: npt.NDArray[Any] | None) -> float:
        """Return the specular fraction of a paint [1], to the decimals that are written.

        Parameters
        ----------
        centre, mirror
            Reflectance of body and coat (band,) [1]; NaN where a band is not to be used.
        """
        if not isinstance(self.specular, str):
            return round(float(self.specular), 4)
        if mirror is None:
            return 0.0
        both = np.isfinite(mirror) & np.isfinite(centre)
        part, body = (float(np.clip(each[both], 0.0, 1.0).sum()) for each in (mirror, centre))
        return min(round(part / (part + body), 4), 0.9999) if part > 0.0 else 0.0


def coat_of(library: xr.Dataset, specular: float | str) -> Coat:
    """Return what becomes of a library's mirrored light.

    Raises
    ------
    SchemaError
        The attribute ``mirror_reflection`` is neither of both; the specular fraction is not from 0 to below
        1, or would count the coat twice, or is to be taken from a library that has none.
    """
    problems = Problems("no specular term can be written", SchemaError)
    apart = "specular_reflectance" in library.variables
    declared = None
    try:
        declared = mirror_reflection(library)
    except SchemaError as error:
        problems.add(str(error))
    # of measured reflectance the safe guess: a coat that is counted twice is not seen by anyone
    mirror = declared or INCLUDED
    number = specular if not isinstance(specular, str) else None
    if number is not None and not 0.0 <= number < 1.0:
        problems.add(f"specular={specular!r}, expected 0 to below 1, or 'library'")
    if isinstance(specular, str) and specular != "library":
        problems.add(f"specular={specular!r}, expected a number or 'library'")
    elif specular == "library" and not apart:
        problems.add("specular='library', but the library has no specular_reflectance (paint, band)")
    elif specular != 0.0 and mirror == INCLUDED:
        problems.add(
            f"specular={specular!r}, but the reflectance holds the mirrored light already: the clear coat "
            "would count twice; leave it away, or pass body reflectance (remove_mirrored_sky, or signatures "
            f"--specular-sky), with reflectance.attrs['mirror_reflection'] = {EXCLUDED!r}"
        )
    problems.raise_if_any()
    return Coat(mirror, declared is not None, number if number is not None else specular)
