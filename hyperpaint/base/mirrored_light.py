"""Whether reflectance holds the light that a clear coat mirrors, as those who hand it on say it."""

from __future__ import annotations

import xarray as xr

from .errors import SchemaError

INCLUDED, EXCLUDED = "included", "excluded"
"""What the attribute ``mirror_reflection`` may say."""

BODY = "body reflectance factor under the clear coat"
"""Attribute ``quantity``: what a panel shows, lit and seen near its normal, without its mirror image."""

THROUGH_COAT = "reflectance factor of the body through its clear coat"
"""The same without its mirror image, but lit as it was: less what the coat keeps of a low sun."""

OUTSIDE = "reflectance factor of the outside of the coat"
"""All that comes off the panel, its mirror image of the sky among it."""

_SAID = "mirror_reflection"
_COMPONENT = "specular_component"
_REMOVED = "mirrored_sky_removed"
_APART = "specular_reflectance"


def mirror_reflection(library: xr.Dataset) -> str | None:
    """Return whether a library's reflectance holds mirrored light: "included", "excluded", or None.

    The attribute ``mirror_reflection`` of ``reflectance``, or else of the library, decides; or
    ``specular_component``, as makers of instruments call it. Where none says it, light that is kept apart as
    ``specular_reflectance``, or was subtracted as ``mirrored_sky_removed`` says, is excluded. What was not
    subtracted ("none"), of one of several sources even ("F0 0.04; none"), is included.

    Parameters
    ----------
    library
        With ``reflectance``.

    Raises
    ------
    SchemaError
        The attribute is neither of both words.

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
    said = attrs.get(_SAID, attrs.get(_COMPONENT))
    if said is not None:
        if not isinstance(said, str) or said not in (INCLUDED, EXCLUDED):
            raise SchemaError(
                f"attribute {_SAID!r} of reflectance is {said!r:.60}, expected {INCLUDED!r} or {EXCLUDED!r}"
            )
        return said
    if _APART in library.variables:
        return EXCLUDED
    if _REMOVED not in attrs:
        return None
    # a library of several flight lines names what was subtracted from each of them
    sources = [text.strip() for text in str(attrs[_REMOVED]).split(";")]
    return INCLUDED if any(text in ("", "none") for text in sources) else EXCLUDED
