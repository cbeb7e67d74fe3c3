"""Declaration whether reflectance contains the light that a clear coat mirrors, and how flakes change it."""

import numpy as np
import xarray as xr

from .constants import finite_mean
from .facts import one_of
from .schema import Bools, Floats

#: Values of the attribute ``mirror_reflection``.
INCLUDED, EXCLUDED = "included", "excluded"

#: Attribute ``quantity``: painted surface lit and seen near its normal, without its mirror image.
BODY = "body reflectance factor under the clear coat"

#: Attribute ``quantity``: without the mirror image, but under the light of the flight: a coat passes less of
#: a low sun.
THROUGH_COAT = "reflectance factor of the body through its clear coat"

#: Attribute ``quantity``: all light from the painted surface, including its mirror image of the sky.
OUTSIDE = "reflectance factor of the outside of the coat"

#: Variable ``quantity`` of a paint with flakes, or whose finish is unknown: it changes with sun and view.
AT_GEOMETRY = "reflectance factor at this geometry"

_ATTRIBUTE = "mirror_reflection"
_MAKERS_ATTRIBUTE = "specular_component"
_REMOVAL_ATTRIBUTE = "mirrored_sky_removed"
_SPECULAR_VARIABLE = "specular_reflectance"


def mirror_reflection(library: xr.Dataset) -> str | None:
    """Return whether a library's reflectance contains mirrored light: "included", "excluded", or None.

    The attribute ``mirror_reflection`` of ``reflectance``, or else of the library, decides; or
    ``specular_component``, the term of instrument makers. Without either, mirrored light is excluded where a
    variable ``specular_reflectance`` holds it, or where ``mirrored_sky_removed`` states its subtraction; it
    is included where that attribute states "none", even for one of several sources ("F0 0.04; none").

    Parameters
    ----------
    library
        Paint library with ``reflectance``.

    Raises
    ------
    SchemaError
        The attribute is neither "included" nor "excluded".

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> paints = xr.Dataset({"reflectance": (("signature", "band"), np.float32([[0.3, 0.4]]))})
    >>> print(mirror_reflection(paints))
    None
    >>> paints.reflectance.attrs["mirrored_sky_removed"] = "F0 0.04 x sky view 1"
    >>> mirror_reflection(paints)
    'excluded'
    """
    attrs = {**library.attrs, **library["reflectance"].attrs}
    declared: str | None = attrs.get(_ATTRIBUTE, attrs.get(_MAKERS_ATTRIBUTE))
    if declared is not None:
        one_of(declared, (INCLUDED, EXCLUDED), f"reflectance attribute {_ATTRIBUTE}")
        return declared
    if _SPECULAR_VARIABLE in library.variables:
        return EXCLUDED
    if _REMOVAL_ATTRIBUTE not in attrs:
        return None
    # a library of several flight lines states the subtraction of each of them
    sources = [text.strip() for text in str(attrs[_REMOVAL_ATTRIBUTE]).split(";")]
    return INCLUDED if any(text in ("", "none") for text in sources) else EXCLUDED


#: Values of ``finish``, ``material`` or ``kind`` of paints with flakes: their signature holds for one
#: geometry of sun and view and includes the coat.
FLAKE_PAINTS = frozenset({"metallic", "pearl"})
#: Values of ``finish``. Matt paint has no clear coat that mirrors: its surface scatters the sky.
FINISHES = ("solid", "metallic", "pearl", "matt", "unknown")

#: Maximum range of angles between view and mirrored sun that a change of brightness infers [degree].
MAX_ASPECULAR_RANGE_DEG = 30.0

#: Minimum mean change between the two ends of a body part for a paint with flakes [1].
MIN_FLAKE_FLOP = 0.25


def shows_flakes(flop: Floats, aspecular_range: Floats) -> Bools:
    """Return whether paints (signature,) change with the angle to the mirrored sun as only flakes do.

    The change is at least `MIN_FLAKE_FLOP`, and more than the largest lean of a solid paint explains.

    Takes ``flop`` (signature, band) [1] and ``aspecular_range`` (signature,) [degree] of a library.

    Examples
    --------
    >>> shows_flakes(np.array([[0.5, 0.7], [0.1, 0.1], [0.5, 0.7]]), np.array([30.0, 30.0, 18.0]))
    array([ True, False, False])
    """
    mean = finite_mean(flop, axis=-1)
    return np.asarray((mean >= MIN_FLAKE_FLOP) & (aspecular_range >= MAX_ASPECULAR_RANGE_DEG - 1e-6))


def flake_exponents(flop: Floats) -> Floats:
    """Return ln(bright / dark) of the two ends of a body part from its flop; 0 where it is unknown.

    A paint with flakes changes by ``exp(s g)`` from its stated angle to the mirrored sun, with these
    exponents g and s from -0.5 at the dark end to 0.5 at the bright end.

    Examples
    --------
    >>> flake_exponents(np.array([0.0, 2.0 / 3.0, np.nan])).round(3)
    array([0.   , 0.693, 0.   ])
    """
    known = np.where(np.isfinite(flop), flop, 0.0)
    return np.asarray(2.0 * np.arctanh(np.clip(known, -1.9, 1.9) / 2.0))
