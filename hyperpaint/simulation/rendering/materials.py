"""Surfaces, and their readings in gloss units and as flop index.

A surface is a diffuse base, with or without a clear coat over it, with or without metal flakes in it.

Light enters a clear coat through its interface (transmittance ``Ti`` of its direction), is scattered by the
base of albedo ``b``, and leaves (``To``) or is reflected back to the base by the interface (share ``Fi``).
The sum over all returns (Saunderson 1942) gives the BRDF without the mirror reflection:

    f_d = To Ti b / (pi n^2 (1 - b Fi)) = To Ti rho' / (pi n^2 (1 - Fi)),  rho' = b (1 - Fi) / (1 - b Fi)

where ``n^2`` is the widening of the cone of light that leaves. Only the *effective factor* ``rho'``, at most
1, depends on wavelength; the tracer records all other factors. A measured reflectance factor without the
mirror reflection is ``R = pi f_d`` in the geometry of the instrument, so that ``rho'`` is proportional to
``R``; the albedo of the base is ``b = q / (1 + q Fi)`` with ``q = R n^2 / (To Ti)``.
"""

import functools
from dataclasses import MISSING, dataclass, replace
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np

from hyperpaint.base import (
    ArrayLike,
    Floats,
    Problems,
    SchemaError,
    check_fields,
    declared,
    documented,
    fact,
    one_of,
    warn_user,
)

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
        with Problems("a clear coat cannot be made", SchemaError) as problems:
            check_fields(self, problems)


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
        with Problems("metal flakes cannot be made", SchemaError) as problems:
            check_fields(self, problems)
            problems.add_if(
                not self.spectrum,
                "spectrum is empty",
                expected="a name such as 'aluminium'",
                code="argument-missing",
            )


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
        with Problems(f"material {self.name!r} cannot be made", SchemaError) as problems:
            problems.add_if(not self.name, "name is empty", code="argument-missing")
            problems.add_if(
                not self.spectrum,
                "spectrum is empty",
                expected="the name of a reflectance spectrum",
                code="argument-missing",
            )
            one_of(self.kind, KINDS, "kind", problems=problems)
            problems.add_if(
                self.flakes is not None and self.coat is None,
                "flakes without a coat",
                mend="pass coat=Coat()",
                code="coat-missing",
            )
            problems.add_if(
                self.transmittance and self.coat is not None,
                "transmittance with a coat",
                mend="leave one out: only thin surfaces without a coat transmit light",
                code="option-conflict",
            )


def fresnel_reflectance(cosine: ArrayLike, index: float = 1.5) -> Floats:
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
    reflectance: ArrayLike,
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
    SchemaError.raise_if(
        (nonfinite_count := int((~np.isfinite(measured)).sum())),
        f"{nonfinite_count} of {measured.size} measured reflectances are not finite",
        mend="fill the gaps",
        code="not-finite",
    )
    SchemaError.raise_if(
        (largest := measured.max(initial=0.0)) > 2.0,
        f"a measured reflectance reaches {largest:.4g}",
        expected="a fraction",
        mend="divide per cent by 100",
        code="value-out-of-range",
    )
    if specular_included:
        SchemaError.raise_if(
            geometry == "0/45",
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
        warn_user(
            f"{int(is_impossible.sum())} of {factor.size} reflectances, from {measured.min():.4g} "
            f"to {measured.max():.4g}, were clipped to the possible range, "
            f"0 to {double_transmittance / (1.0 - returned):.4g}",
            "reflectance-clipped",
        )
    return np.clip(factor, 0.0, 1.0)


def base_albedo(
    reflectance: ArrayLike,
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
    albedo: ArrayLike, index: float = 1.5, *, geometry: Geometry = "0/0", specular_included: bool = False
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


# --- gloss and flop index -----------------------------------------------------------------------------------


_GLOSS_AND_FLOP = SimpleNamespace(
    gloss_angle_deg=20.0,
    glass_index=1.567,  # refractive index of the black glass with 100 gloss units
    receptor_deg=(1.8, 3.6),  # field of the receptor in and across the plane of incidence: ISO 2813, table 1
    source_deg=(0.75, 2.5),  # size of the image of the source
    aspecular_deg=(15.0, 45.0, 110.0),
    #: Maximum flop index of car paints: 0 is solid, 15 to 17 the highest flop of metallic and pearl
    #: basecoats. D. H. Alman, "Directional color measurement of metallic flake finishes", ISCC Williamsburg
    #: conference (1987); BYK-Gardner, "Instrumental color measurement of effect coatings". Sharp lobes exceed
    #: it.
    max_flop_index=17.0,
)
_LIGHT_DEG = 45.0


ALPHAS = np.geomspace(0.03, 1.0, 40)  # GGX alphas of flakes for which flop indices are tabulated

#: Relative spectrum of D65, 380 to 780 nm in steps of 20 nm (CIE 15).
_D65 = (
    49.98, 82.75, 93.43, 104.86, 117.81, 115.92, 109.35, 104.79, 104.41, 100.00, 95.79, 90.01, 87.70, 83.70,
    80.21, 78.28, 71.61, 61.60, 75.09, 46.42, 63.38,
)  # fmt: skip


def gloss_units(coat: Coat) -> float:
    """Return the gloss of a clear coat at 20 degrees, in gloss units: 100 for black glass of index 1.567.

    Flux of the coat in the receptor over the flux of the glass (ISO 2813). The field of the receptor is 1.8
    degrees in the plane of incidence and 3.6 across; the image of the source is 0.75 by 2.5 degrees. Facets
    have the slopes of GGX; orange peel, which is smaller than the spot of the instrument, adds Gaussian
    slopes. Light reflected by the paint under the coat is excluded.

    Parameters
    ----------
    coat
        Coat with index, roughness and waviness.

    Examples
    --------
    >>> round(gloss_units(Coat(1.567, 0.0, 0.0)), 1)
    100.0
    >>> gloss_units(Coat()) > 80, gloss_units(Coat(roughness=0.05)) < 6
    (True, True)
    """
    quantile = (np.arange(400) + 0.5) / 400  # of the slopes of facets
    radius = coat.roughness * np.sqrt(quantile / (1.0 - quantile))
    angle = 2.0 * np.pi * (np.arange(48) + 0.5) / 48
    tilt, weight = np.polynomial.hermite_e.hermegauss(16)
    tilt, weight = tilt * np.radians(coat.waviness) / np.sqrt(2.0), weight / weight.sum()
    slopes = radius[:, None] * np.cos(angle)  # slopes in the plane of incidence
    cross_slopes = radius[:, None] * np.sin(angle)
    cosine = np.cos(np.radians(_GLOSS_AND_FLOP.gloss_angle_deg))

    def overlap(deflection: Floats, axis: int) -> Floats:
        # share of the source's image, shifted by an angle [rad], inside the field of the receptor
        receptor, source = (
            np.radians(_GLOSS_AND_FLOP.receptor_deg[axis]),
            np.radians(_GLOSS_AND_FLOP.source_deg[axis]),
        )
        return np.asarray(np.clip((0.5 * (receptor + source) - np.abs(deflection)) / source, 0.0, 1.0))

    flux = 0.0
    for tilt_along, weight_along in zip(tilt, weight, strict=True):
        along = overlap(2.0 * (slopes + tilt_along), 0)
        for tilt_across, weight_across in zip(tilt, weight, strict=True):
            overlaps = along * overlap(2.0 * cosine * (cross_slopes + tilt_across), 1)
            flux += weight_along * weight_across * float(overlaps.mean())
    mirrors = [
        float(fresnel_reflectance(cosine, index)) for index in (coat.index, _GLOSS_AND_FLOP.glass_index)
    ]
    return float(100.0 * flux * mirrors[0] / mirrors[1])


def coat_of_gloss(gloss: float, index: float = 1.5, waviness: float = Coat.waviness) -> Coat:
    """Return the clear coat with this gloss at 20 degrees, the inverse of `gloss_units`.

    Parameters
    ----------
    gloss
        Gloss units, above 1.
    index, waviness
        See `Coat`.

    Raises
    ------
    SchemaError
        No roughness of such a coat has this gloss.

    Examples
    --------
    >>> round(coat_of_gloss(70.0).roughness, 4)
    0.0036
    """
    low, high = 0.0, 1.0
    max_gloss, min_gloss = (gloss_units(Coat(index, alpha, waviness)) for alpha in (low, high))
    SchemaError.raise_if(
        not min_gloss < gloss <= max_gloss,
        f"gloss is {gloss} units",
        expected=f"{min_gloss:.1f} to {max_gloss:.1f} for index {index} and waviness {waviness} degrees",
        mend="raise the index for more gloss",
        code="value-out-of-range",
    )
    for _ in range(30):
        alpha = 0.5 * (low + high)
        low, high = (alpha, high) if gloss_units(Coat(index, alpha, waviness)) > gloss else (low, alpha)
    return Coat(index, 0.5 * (low + high), waviness)


class _Lobes(NamedTuple):
    # reflectance factors for unit spectra: of a base, of flakes, and of the light that flakes return to the
    # paint
    base: float
    flakes: float
    recycled: float
    turned: float  # share of the flakes' spectrum ``turned``

    def factor(self, share: float, pigment: Floats, metal: Floats) -> Floats:
        # reflectance factor of a paint with this share of flakes
        returned = share * metal + (1.0 - share) * pigment
        return (1.0 - share) * self.base * pigment + share * metal * (self.flakes + self.recycled * returned)


@functools.lru_cache(maxsize=256)
def _unit_surface(index: float, alpha: float) -> Any:
    # a smooth coat (index 0: none) over a white base (alpha 0), or half of the light on flakes of an alpha
    from hyperpaint.simulation.transport.surfaces import surfaces_of

    ones, factor = np.ones(1), np.array([0 if alpha else -1], np.int32)
    return surfaces_of(index * ones, 0 * ones, 0 * ones, 0.5 * ones, alpha * ones, 0 * factor, factor)


def lobe_factors(index: float, alpha: float, light: float, view: float, azimuth: float) -> _Lobes:
    # lobes of a smooth coat (index 0: no coat) over a base only, and over flakes of an alpha (0: no flakes)
    # only, for light and view at zenith angles with a difference of azimuth [degree]
    from hyperpaint.simulation.transport.surfaces import weights_under_coat

    surfaces = _unit_surface(index, alpha)
    a, b, turn = np.radians([light, view, azimuth])
    towards_light = float(np.sin(a)), 0.0, float(np.cos(a))
    towards_view = float(np.sin(b) * np.cos(turn)), float(np.sin(b) * np.sin(turn)), float(np.cos(b))
    base, flakes, recycled, turned = weights_under_coat(surfaces, towards_light, towards_view)
    scale = (2.0 if alpha else 1.0) / towards_light[2]  # with flakes, half of the light meets them
    return _Lobes(
        scale * base,
        2.0 * flakes / towards_light[2],
        2.0 * recycled / towards_light[2],
        turned,
    )


@documented()
def reflectance_factor(
    material: Material,
    body: ArrayLike,
    flakes: ArrayLike = 0.0,
    *,
    light: float,
    view: float,
    azimuth: float = 180.0,
    turned: ArrayLike | None = None,
) -> Floats:
    """Return the reflectance factor pi f of a paint in a geometry, without mirror reflection of its coat.

    Parameters
    ----------
    material
    body
        Reflectance of its spectrum, near normal, without the specular component, any shape [1].
    flakes
        Reflectance of its flakes.
    light, view
        Zenith angles [degree].
    azimuth
        Difference of their azimuths [degree]; 180 with the view on the side of the mirror direction.
    turned
        Reflectance of the flakes for light and view at right angles (`Flakes.turned`); None if it does not
        depend on angles.

    Examples
    --------
    >>> silver = Material("silver", "silver", "paint", Coat(), Flakes(0.5))
    >>> near, far = (reflectance_factor(silver, 0.4, 0.85, light=45.0, view=view) for view in (30.0, 0.0))
    >>> bool(near > 2 * far)
    True
    """
    index = None if material.coat is None else material.coat.index
    share, alpha = (material.flakes.share, material.flakes.roughness) if material.flakes else (0.0, 0.0)
    lobes = lobe_factors(index or 0.0, alpha, light, view, azimuth)
    metal = np.asarray(flakes, np.float64)
    mixed = metal if turned is None else metal + lobes.turned * (np.asarray(turned, np.float64) - metal)
    return np.asarray(
        lobes.factor(share, measured_factor(body, index), metal) + share * lobes.flakes * (mixed - metal)
    )


@documented()
def flop_index(material: Material, wavelength: ArrayLike, body: ArrayLike, flakes: ArrayLike = 0.0) -> float:
    """Return the flop index: decrease of lightness away from the mirror direction; near 0 for solid paints.

    Alman's index 2.69 (L*15 - L*110)^1.11 / L*45^0.86 of CIE 1976 lightness at three aspecular angles, lit
    at 45 degrees; D65, 10 degree observer (its luminosity as fitted by C. Wyman, P.-P. Sloan, P. Shirley,
    JCGT 2 (2013)). A. B. J. Rodrigues, "Metallic flake sizes and flop index" (DuPont); ASTM E2194 has the
    angles.

    Parameters
    ----------
    material
    wavelength
        Of the reflectances [nm], shape (band,).
    body, flakes
        As for `reflectance_factor`, shape (band,) or one number.

    Examples
    --------
    >>> solid, silver = (Material("m", "m", "paint", Coat(), lobe) for lobe in (None, Flakes(0.5, 0.3)))
    >>> [round(flop_index(paint, [400.0, 700.0], 0.3, 0.85), 1) for paint in (solid, silver)]
    [0.2, 2.7]
    """
    alpha = material.flakes.roughness if material.flakes else 0.0
    index = material.coat.index if material.coat else 0.0
    return _flops(material, [_three_geometries(index, alpha)], wavelength, body, flakes)[0]


def _three_geometries(index: float, alpha: float) -> list[_Lobes]:
    # view angles, positive on the side of the mirror direction
    views = [_LIGHT_DEG - aspecular for aspecular in _GLOSS_AND_FLOP.aspecular_deg]
    return [lobe_factors(index, alpha, _LIGHT_DEG, abs(view), 180.0 if view >= 0 else 0.0) for view in views]


@functools.cache
def _lobes_by_alpha(index: float) -> list[list[_Lobes]]:
    return [_three_geometries(index, float(alpha)) for alpha in ALPHAS]


def _flops(
    material: Material,
    candidates: list[list[_Lobes]],
    wavelength: ArrayLike,
    body: ArrayLike,
    flakes: ArrayLike,
) -> list[float]:
    # flop indices of a paint with each of several lobes in the three geometries
    grid = np.linspace(380.0, 780.0, len(_D65))
    pigment, metal = (
        np.interp(grid, np.asarray(wavelength, float), np.broadcast_to(curve, np.shape(wavelength)))
        for curve in (body, flakes)
    )
    pigment = measured_factor(pigment, material.coat.index if material.coat else None)
    share = material.flakes.share if material.flakes else 0.0
    weights = np.array(_D65) * np.exp(-0.5 * ((grid - 556.1) / 46.14) ** 2)
    flops = []
    for geometries in candidates:
        lightness = []
        for lobes in geometries:
            luminance = float((weights * lobes.factor(share, pigment, metal)).sum() / weights.sum())
            is_bright = luminance > 216 / 24389
            lightness.append(116.0 * np.cbrt(luminance) - 16.0 if is_bright else 24389 / 27 * luminance)
        near, face, far = lightness
        flops.append(float(2.69 * max(near - far, 0.0) ** 1.11 / face**0.86))
    return flops


def flakes_of_flop(
    flop: float,
    material: Material,
    wavelength: ArrayLike,
    body: ArrayLike,
    flakes: ArrayLike,
    *,
    nearest: bool = False,
) -> Flakes:
    """Return the flakes of a paint, with the lobe roughness that gives a flop index.

    Parameters
    ----------
    flop
        Flop index, at most 17.
    material
        Coat, and flakes whose share and spectrum are kept.
    wavelength, body, flakes
        As for `flop_index`.
    nearest
        Return the lobe with the nearest flop index if none has this index.

    Raises
    ------
    SchemaError
        The paint has no flakes, no lobe of this share has the index, or no real paint has it.

    Examples
    --------
    >>> paint = Material("m", "m", "paint", Coat(), Flakes(0.5))
    >>> lobe = flakes_of_flop(10.0, paint, [400.0, 700.0], 0.3, 0.85)
    >>> round(flop_index(replace(paint, flakes=lobe), [400.0, 700.0], 0.3, 0.85), 1)
    10.0
    """
    old_flakes = SchemaError.raise_if_none(
        material.flakes,
        f"material {material.name!r} has no flakes",
        mend="pass flakes=Flakes(share)",
        code="flakes-missing",
    )
    index = 0.0 if material.coat is None else round(material.coat.index, 2)
    flops = np.array(_flops(material, _lobes_by_alpha(index), wavelength, body, flakes))
    peak = int(flops.argmax())  # sharper lobes do not reach the first angle
    most = min(float(flops[peak]), _GLOSS_AND_FLOP.max_flop_index)
    SchemaError.raise_if(
        not (nearest or flops[-1] <= flop <= most),
        f"flop index is {flop}",
        expected=f"{flops[-1]:.1f} to {most:.1f} for a flake share of {old_flakes.share}",
        mend="for more flop, raise the flake share or darken the pigment",
        code="value-out-of-range",
    )
    return replace(
        old_flakes,
        roughness=float(np.exp(np.interp(-min(flop, most), -flops[peak:], np.log(ALPHAS[peak:])))),
    )
