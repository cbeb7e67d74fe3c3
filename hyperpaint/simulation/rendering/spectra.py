"""Every reflectance spectrum that a scene can name: near normal, without the mirror reflection.

Car paints lie under a clear coat whose first reflection the renderer makes itself, so that it is left out
here: of the paints of `hyperpaint.simulation.paints`, Saunderson's k1 is taken off. What has no coat keeps
all that it reflects. Of glass, what is behind it is left.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.paints import CAR_PAINTS, MATERIALS, Bump, Edge, Paint, Plain

from .pigments import aluminium, parse_name, pigments_of, seen_through_coat

__all__ = ["SPECTRA", "Spectrum", "spectrum_of"]

Spectrum = Callable[[Floats], Floats]
"""Reflectance factor, 0 to 1, by wavelength [nm]."""


def _without_mirror(paint: Paint) -> Spectrum:
    return lambda wavelength: paint(wavelength) - paint.interface


_MORE_PAINTS = {
    "beige": Paint(0.09, [Edge(500.0, -45.0, 0.45), Edge(405.0, -6.0, 2.0)]),
    "brown": Paint(0.30, [Edge(570.0, -50.0, 3.0)]),
}

_RED_LENS = Plain(0.03, 0.0, [Edge(606.0, 7.0, 0.35)])
_REFLECTOR = Plain(0.30, 0.05)  # behind a clear lens

SPECTRA: dict[str, Spectrum] = {
    **MATERIALS,
    **{name: _without_mirror(paint) for name, paint in {**CAR_PAINTS, **_MORE_PAINTS}.items()},
    "glass": Plain(0.012),
    "aluminium": aluminium,
    "leaf": Plain(0.045, 0.01, [Bump(552.0, 28.0, 0.08), Edge(716.0, 12.0, 0.42), Bump(968.0, 22.0, -0.03)]),
    "brick": Plain(0.13, 0.10, [Edge(585.0, 22.0, 0.16), Bump(870.0, 60.0, -0.015)]),
    "lamp_red": _RED_LENS,
    "tail_lamp": _RED_LENS,
    "lamp_clear": _REFLECTOR,
    "lamp": _REFLECTOR,
    "rim": Plain(0.42, 0.03, [Bump(825.0, 65.0, -0.015)]),
    "plate": Plain(0.55, 0.02, [Edge(415.0, 8.0, 0.15)]),
    "trim": Plain(0.045, 0.005),
    "bark": Plain(0.11, 0.22, [Edge(600.0, 60.0, 0.04)]),
    "steel": Plain(0.36, 0.06),
    "patch": Plain(0.055, 0.05),
}
"""The named spectra; generated paints are reached by `spectrum_of` alone."""


def spectrum_of(name: str) -> Spectrum:
    """Return a reflectance spectrum by name.

    Parameters
    ----------
    name
        A key of `SPECTRA`; or of a generated paint, "pigment:<family>:<number>", with ":flakes" behind it for
        those of its flakes.

    Returns
    -------
    callable
        Takes wavelengths of any shape [nm], gives the reflectance factor, same shape, float64, 0 to 1.

    Raises
    ------
    SchemaError
        There is no such spectrum.

    Examples
    --------
    >>> spectrum_of("panel_20")(np.array([550.0, 800.0]))
    array([0.2, 0.2])
    >>> bool(spectrum_of("pigment:solid:17")(np.array([550.0]))[0] < 1.0)
    True
    >>> spectrum_of("panel_21")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: there is no spectrum 'panel_21'; did you mean 'panel_20'?
    """
    generated = parse_name(name)
    if generated is not None:
        family, number, flakes = generated
        pigments = pigments_of(family, number)
        if flakes:
            return _limited(pigments.flakes)
        return _limited(lambda wavelength: seen_through_coat(pigments, wavelength))
    if name in SPECTRA:
        return _limited(SPECTRA[name])
    close = difflib.get_close_matches(name, SPECTRA, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(SPECTRA)}"
    raise SchemaError(f"there is no spectrum {name!r}; {hint}")


def _limited(spectrum: Spectrum) -> Spectrum:
    """Return ``spectrum`` for any wavelength: straight lines leave 0 to 1 far from where they were drawn."""

    def limited(wavelength: Floats) -> Floats:
        grid = np.asarray(wavelength, dtype=np.float64)
        return np.clip(spectrum(grid), 0.0, 1.0)

    return limited
