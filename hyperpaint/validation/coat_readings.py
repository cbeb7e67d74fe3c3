"""Readings outside of a clear coat and of the body under it: distinguished, and converted where possible."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.mirrored_light import BODY, EXCLUDED, INCLUDED, OUTSIDE, THROUGH_COAT
from hyperpaint.light.coat_transmission import (
    COAT_INDEX,
    COAT_INDEX_U,
    interface_reflectance,
    sky_reflectance,
)

from .measured_spectra import Measured

#: Zenith angle of the sun above which a degree of lean changes the direct light by more than the usual
#: tolerance, 5 % [degree].
_LOW_SUN_DEG = 70.0


def coat_of(attrs: Any) -> dict[str, Any]:
    """Return quantity, instrument geometry and index of the coat, by the attributes of a dataset.

    ``quantity`` is one of the words of `hyperpaint.base.mirrored_light`; without it, ``specular_component``
    determines the quantity.
    """
    quantity = attrs.get("quantity")
    if quantity not in (BODY, OUTSIDE, THROUGH_COAT):
        quantity = OUTSIDE if attrs.get("specular_component") == INCLUDED else ""
    index = attrs.get("coat_index", COAT_INDEX)
    usable = isinstance(index, int | float) and 1.0 <= float(index) <= 3.0
    return {
        "quantity": quantity,
        "geometry": str(attrs.get("measurement_geometry", "")),
        "coat_index": float(index) if usable else COAT_INDEX,
    }


def light_notes(sun_zenith: float, sky_is_contradictory: bool) -> list[str]:
    """Return reasons why the level of a signature is uncertain, for the reader of the result."""
    notes = []
    if sun_zenith > _LOW_SUN_DEG:
        change = 100.0 * np.tan(np.radians(min(sun_zenith, 89.0))) * np.pi / 180.0
        notes.append(
            f"the sun stood {sun_zenith:.0f} degrees from the zenith: one degree of lean changes its light "
            f"by {change:.0f} %; judge the shape of the signature rather than its level"
        )
    if sky_is_contradictory:
        notes.append(
            "the irradiance record contradicted every sky at that time, so the level is uncertain: check "
            "clocks and the receiver's calibration, or give sun_zenith= to signatures"
        )
    return notes


def as_body(reference: Measured, signature: Measured) -> Measured:
    r"""Return a reading outside of a coat converted to the body under it, if the signature is of the body.

    The attribute ``measurement_geometry`` of the reference must be "0/0", "0/45", "45/0", or that of an
    integrating sphere, such as "d/8". Without it, or for a reading of the body, the reference is returned
    unchanged.

    Notes
    -----
    .. math:: R_{body} = (R - s F(0)) \frac{1 - F(0)}{1 - F_{in}}

    with s = 1 where the mirror image is included, and the interface's reflectance :math:`F_{in}` of the
    instrument's light.
    """
    if signature.quantity != BODY or reference.quantity != OUTSIDE:
        return reference
    # reflectance of the coat for the light of the instrument [1]
    index, angles = reference.coat_index, {"0/0": 0.0, "0/45": 45.0, "45/0": 45.0}
    if reference.geometry in angles:
        incident = float(interface_reflectance(angles[reference.geometry], index))
    elif reference.geometry in ("d/0", "0/d", "d/8", "8/d"):
        incident = float(sky_reflectance([550.0], None, index=index)[0])
    else:
        return reference
    normal = float(interface_reflectance(0.0, index))
    mirrored = normal if reference.mirror == INCLUDED and reference.geometry not in ("0/45", "45/0") else 0.0
    factor = (1.0 - normal) / (1.0 - incident)

    def times(spread: Floats | None) -> Floats | None:
        return None if spread is None else spread * factor

    # uncertainty of the subtracted reflectance from that of the index, the largest part for black paint
    normal_u = float(mirrored > 0.0) * 4.0 * (index - 1.0) / (index + 1.0) ** 3 * COAT_INDEX_U
    known_u = 0.0 if reference.u_systematic is None else reference.u_systematic
    systematic = factor * np.hypot(known_u, normal_u) * np.ones_like(reference.values)

    note = (
        f"the reference, a reading of the coat's outside in {reference.geometry}, was converted to the body "
        f"under it: less {mirrored:.3f}, times {factor:.3f}"
    )
    return replace(
        reference,
        values=(reference.values - mirrored) * factor,
        u_random=times(reference.u_random),
        u_systematic=systematic,
        sd=times(reference.sd),
        covariance=None,  # it lacks the uncertainty of the index
        mirror=EXCLUDED,
        quantity=BODY,
        notes=(*reference.notes, note),
    )


def difference(signature: Measured, reference: Measured) -> str:
    """Return the difference in quantity of signature and reference, and the mend; empty for none."""
    quantity, reference_quantity = signature.quantity, reference.quantity
    if not quantity or not reference_quantity or quantity == reference_quantity:
        return ""
    mend = {
        BODY: "give the reference the attributes measurement_geometry and specular_component, or extract "
        "signatures with coat=False",
        OUTSIDE: "extract signatures without the mirrored sky (specular_sky=True, or --specular-sky)",
        THROUGH_COAT: "extract signatures with coat=True, or call correct_coat",
    }[quantity]
    return f"the signature is a {quantity}, the reference a {reference_quantity}: {mend}"
