"""Surfaces: a diffuse base, with or without a clear coat over it, with or without metal flakes in it.

Light enters a clear coat through its interface (transmittance ``Ti`` of its direction), is scattered by the
base of albedo ``b``, and leaves (``To``) or is reflected back to the base by the interface (share ``Fi``).
The sum over all returns (Saunderson 1942) gives the BRDF without the mirror reflection:

    f_d = To Ti b / (pi n^2 (1 - b Fi)) = To Ti rho' / (pi n^2 (1 - Fi)),  rho' = b (1 - Fi) / (1 - b Fi)

where ``n^2`` is the widening of the cone of light that leaves. Only the *effective factor* ``rho'``, at most
1, depends on wavelength; the tracer records all other factors. A measured reflectance factor without the
mirror reflection is ``R = pi f_d`` in the geometry of the instrument, so that ``rho'`` is proportional to
``R``; the albedo of the base is ``b = q / (1 + q Fi)`` with ``q = R n^2 / (To Ti)``.
"""

from __future__ import annotations

import warnings
from dataclasses import MISSING, dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import check_fields, declared, fact, one_of

Geometry = Literal["0/0", "0/45", "d/0"]

#: Semantic classes; the index in this tuple is the number in ``surface_class``.
KINDS = (
    "asphalt",
    "paint",
    "glass",
    "tyre",
    "trim",
    "lamp",
    "line",
    "concrete",
    "grass",
    "leaf",
    "wall",
    "panel",
    "other",
)


@declared
@dataclass(frozen=True)
class Coat:
    """A clear coat of one refractive index at all wavelengths.

    Raises
    ------
    SchemaError
        An attribute is outside its range; all are listed.
    """

    index: float = fact(
        1.5, "refractive index of the clear coat", key="coat_index", scale=1.0, least=1.001, most=3.0
    )
    roughness: float = fact(
        1e-3,
        "roughness of the clear coat, the parameter alpha of the GGX model; 0 is a mirror",
        key="coat_roughness",
        scale=1.0,
        least=0.0,
        most=1.0,
    )
    waviness: float = fact(
        0.15,
        "orange peel of the clear coat: root mean square slope of waves with lengths from 1 to 10 mm",
        unit="degree",
        key="coat_waviness_deg",
        scale=1.0,
        least=0.0,
        most=5.0,
    )

    def __post_init__(self) -> None:
        problems = Problems("a clear coat cannot be made", SchemaError)
        check_fields(self, problems)
        problems.raise_if_any()


@declared
@dataclass(frozen=True)
class Flakes:
    """Metal flakes under the coat, a broad lobe around the mirror direction.

    Attributes
    ----------
    spectrum
        Name of their reflectance spectrum, for light and view in the same direction.
    turned
        For flakes with an interference colour, name of their spectrum for light and view at right angles in
        the coat; for other angles the two spectra are mixed (`transport.surfaces.turned_part`). Empty if the
        spectrum does not depend on angles.

    Raises
    ------
    SchemaError
        An attribute is outside its range; all are listed.
    """

    share: float = fact(
        MISSING,
        "share of the light in the paint that metal flakes reflect; pigment reflects the rest",
        kind="number",
        key="flakes",
        scale=1.0,
        least=0.0,
        most=1.0,
    )
    roughness: float = fact(0.15, "GGX alpha of the lobe", least=0.0, above=True, most=1.0)
    spectrum: str = "aluminium"
    turned: str = ""

    def __post_init__(self) -> None:
        problems = Problems("metal flakes cannot be made", SchemaError)
        check_fields(self, problems)
        if not self.spectrum:
            problems.add("spectrum is empty", expected="a name such as 'aluminium'", code="argument-missing")
        problems.raise_if_any()


@dataclass(frozen=True)
class Material:
    """The material of a surface.

    Attributes
    ----------
    name
        Name of the material: "asphalt", "paint of car_007".
    spectrum
        Name of its reflectance spectrum: near normal, without the specular component.
    kind
        Semantic class, one of `KINDS`.
    coat
        Clear coat; None for a Lambert surface.
    flakes
        Metal flakes, only under a coat; ``spectrum`` is then that of the pigment between them.
    transmittance
        Name of the spectrum of diffuse transmittance of a thin surface without a coat, such as a leaf; empty
        for opaque surfaces.

    Raises
    ------
    SchemaError
        A name is empty, the class is unknown, or flakes are without a coat; all are listed.
    """

    name: str
    spectrum: str
    kind: str = "other"
    coat: Coat | None = None
    flakes: Flakes | None = None
    transmittance: str = ""

    def __post_init__(self) -> None:
        problems = Problems(f"material {self.name!r} cannot be made", SchemaError)
        if not self.name:
            problems.add("name is empty", code="argument-missing")
        if not self.spectrum:
            problems.add(
                "spectrum is empty", expected="the name of a reflectance spectrum", code="argument-missing"
            )
        one_of(self.kind, KINDS, "kind", problems=problems)
        if self.flakes is not None and self.coat is None:
            problems.add("flakes without a coat", mend="pass coat=Coat()", code="coat-missing")
        if self.transmittance and self.coat is not None:
            problems.add(
                "transmittance with a coat",
                mend="leave one out: only thin surfaces without a coat transmit light",
                code="option-conflict",
            )
        problems.raise_if_any()


def fresnel_reflectance(cosine: npt.ArrayLike, index: float = 1.5) -> Floats:
    """Return the reflectance of an interface for unpolarised light from the air.

    Parameters
    ----------
    cosine
        Cosine of the angle of incidence, any shape.
    index
        Refractive index behind the interface.

    Examples
    --------
    >>> fresnel_reflectance([1.0, 0.0])
    array([0.04, 1.  ])
    """
    cosine = np.asarray(cosine, dtype=np.float64)
    inner_cosine = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    s_amplitude = (cosine - index * inner_cosine) / (cosine + index * inner_cosine)
    p_amplitude = (index * cosine - inner_cosine) / (index * cosine + inner_cosine)
    return np.asarray(0.5 * (s_amplitude**2 + p_amplitude**2))


def hemispherical_reflectance(index: float = 1.5) -> float:
    """Return the reflectance of an interface for diffuse light from the air.

    The integral of Fresnel's reflectance over a uniform hemisphere in closed form (Walsh 1926; Duntley 1942;
    Judd, J. Res. NBS 29, 329, 1942).

    Parameters
    ----------
    index
        Refractive index behind the interface, above 1.

    Examples
    --------
    >>> round(hemispherical_reflectance(1.5), 4)
    0.0918
    """
    n, square = index, index**2
    quartic = square**2 - 1.0
    return float(
        0.5
        + (n - 1.0) * (3.0 * n + 1.0) / (6.0 * (n + 1.0) ** 2)
        + square * (square - 1.0) ** 2 / (square + 1.0) ** 3 * np.log((n - 1.0) / (n + 1.0))
        - 2.0 * n**3 * (square + 2.0 * n - 1.0) / ((square + 1.0) * quartic)
        + 8.0 * square**2 * (square**2 + 1.0) / ((square + 1.0) * quartic**2) * np.log(n)
    )


def internal_reflectance(index: float = 1.5) -> float:
    """Return ``Fi``: the reflectance of an interface for diffuse light from inside the coat.

    Reciprocity relates it to diffuse light from outside: n^2 (1 - Fi) = 1 - F_diffuse. Most of it is total
    reflection.

    Parameters
    ----------
    index
        Refractive index of the coat, above 1.

    Examples
    --------
    >>> round(internal_reflectance(1.5), 3)
    0.596
    """
    return 1.0 - (1.0 - hemispherical_reflectance(index)) / index**2


def _through_interface(index: float, geometry: Geometry) -> float:
    # ``To Ti / n^2``: share of the light that crosses the interface twice [1]
    normal = float(fresnel_reflectance(1.0, index))
    second_interface = {
        "0/0": normal,
        "0/45": float(fresnel_reflectance(np.sqrt(0.5), index)),
        "d/0": hemispherical_reflectance(index),
    }
    one_of(geometry, second_interface, "geometry")
    return (1.0 - normal) * (1.0 - second_interface[geometry]) / index**2


def measured_factor(
    reflectance: npt.ArrayLike,
    index: float | None = 1.5,
    *,
    geometry: Geometry = "0/0",
    specular_included: bool = False,
) -> Floats:
    """Return the effective factor ``rho'`` of a surface whose reflectance was measured.

    Parameters
    ----------
    reflectance
        Measured reflectance factor, any shape [1].
    index
        Refractive index of the coat; None for a Lambert surface, whose factor is its reflectance.
    geometry
        Geometry of the measurement: "0/0" illumination and view near normal; "0/45" (or 45/0); "d/0" an
        integrating sphere (d/8 or 8/d). For an index of 1.5, the sphere measures 5.4 % less than "0/0".
    specular_included
        Whether the measurement contains the mirror reflection, which is then subtracted: ((n-1)/(n+1))^2. A
        "0/45" measurement does not contain it.

    Returns
    -------
    numpy.ndarray
        float64, shape of ``reflectance``, 0 to 1.

    Raises
    ------
    SchemaError
        The reflectance is not finite or above 2 (per cent?), or the geometry is unknown, or cannot contain
        the mirror reflection.

    Warns
    -----
    PaintWarning
        Impossible values (below 0, or a base with an albedo above 1) are clipped.

    Examples
    --------
    >>> measured_factor([0.5], None)
    array([0.5])
    >>> measured_factor([0.5]).round(4)
    array([0.4927])
    """
    measured = np.asarray(reflectance, dtype=np.float64)
    if nonfinite_count := int((~np.isfinite(measured)).sum()):
        raise SchemaError(
            f"{nonfinite_count} of {measured.size} measured reflectances are not finite",
            mend="fill the gaps",
            code="not-finite",
        )
    if measured.size and measured.max() > 2.0:
        raise SchemaError(
            f"a measured reflectance reaches {measured.max():.4g}",
            expected="a fraction",
            mend="divide per cent by 100",
            code="value-out-of-range",
        )
    if specular_included:
        if geometry == "0/45":
            raise SchemaError(
                "a 0/45 measurement does not contain the mirror reflection",
                mend="leave specular_included out",
                code="option-conflict",
            )
        measured = measured - (0.0 if index is None else float(fresnel_reflectance(1.0, index)))
    double_transmittance = 1.0 if index is None else _through_interface(index, geometry)
    returned = 0.0 if index is None else internal_reflectance(index)
    factor = measured * ((1.0 - returned) / double_transmittance)
    is_impossible = (factor < 0.0) | (factor > 1.0 + 1e-12)
    if is_impossible.any():
        warnings.warn(
            PaintWarning(
                f"{int(is_impossible.sum())} of {factor.size} reflectances, from {measured.min():.4g} "
                f"to {measured.max():.4g}, were clipped to the possible range, "
                f"0 to {double_transmittance / (1.0 - returned):.4g}",
                code="reflectance-clipped",
            ),
            stacklevel=2,
        )
    return np.clip(factor, 0.0, 1.0)


def base_albedo(
    reflectance: npt.ArrayLike,
    index: float = 1.5,
    *,
    geometry: Geometry = "0/0",
    specular_included: bool = False,
) -> Floats:
    """Return the albedo of a base from its reflectance measured through a clear coat.

    ``b = q / (1 + q Fi)`` with ``q = R n^2 / (To Ti)``; near normal, To = Ti = 1 - F0. Parameters, errors and
    the warning where ``b`` would have to exceed 1 are those of `measured_factor`.

    Parameters
    ----------
    reflectance
        Measured reflectance factor, any shape [1].
    index
        Refractive index of the coat.
    geometry, specular_included
        As for `measured_factor`.

    Examples
    --------
    >>> base_albedo([0.05, 0.5]).round(4)
    array([0.1138, 0.7064])
    """
    factor = measured_factor(reflectance, index, geometry=geometry, specular_included=specular_included)
    returned = internal_reflectance(index)
    return np.asarray(factor / (1.0 - returned + factor * returned))


def coated_reflectance(
    albedo: npt.ArrayLike, index: float = 1.5, *, geometry: Geometry = "0/0", specular_included: bool = False
) -> Floats:
    """Return the measured reflectance of a base of albedo ``b`` under a clear coat; inverts `base_albedo`.

    Parameters
    ----------
    albedo
        Albedo of the base, 0 to 1, any shape.
    index
        Refractive index of the coat.
    geometry, specular_included
        As for `measured_factor`.

    Examples
    --------
    >>> coated_reflectance([0.5]).round(4)
    array([0.2918])
    >>> coated_reflectance([0.5], geometry="d/0", specular_included=True).round(4)
    array([0.3161])
    """
    base = np.asarray(albedo, dtype=np.float64)
    mirror = float(fresnel_reflectance(1.0, index)) if specular_included else 0.0
    return np.asarray(
        _through_interface(index, geometry) * base / (1.0 - base * internal_reflectance(index)) + mirror
    )
