"""Values of measured BRDFs (`hyperpaint.io.read_rgl`), and the paints of the renderer nearest to them.

The tracer records paths without spectra and applies the spectra of base and flakes afterwards, so that one
trace serves all light and paints. A measured BRDF changes its directions with wavelength, and cannot be
recorded so. It is rendered as the nearest coat and flakes, with the residual.
"""

import itertools
from typing import NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import ArrayLike, Floats, SchemaError

from .materials import (
    ALPHAS,
    Coat,
    Flakes,
    Material,
    coated_reflectance,
    internal_reflectance,
    lobe_factors,
    reflectance_factor,
)

#: Directions of a fit: zenith angles of light and view, and their difference of azimuth [degree].
_DIRECTIONS = (15.0, 30.0, 45.0, 60.0), (0.0, 15.0, 30.0, 45.0, 60.0), (0.0, 60.0, 120.0, 180.0)
#: Minimum angle of the view from the mirror direction [degree], the first of ASTM E2194: nearer to it, a
#: gonioreflectometer measures the coat.
_MIN_ASPECULAR_DEG = 15.0
_ALUMINIUM = 0.92  # reflectance of flakes in the band where they are brightest
_MIN_SHARE = 1e-3  # of flakes in a paint that has them
_ROUNDS = 20  # of the light that the coat reflects back to flakes and base


def _cumulative(values: Floats, place: Floats) -> Floats:
    # share of the integral below places (direction,), 0 to 1, of functions that are linear between evenly
    # spaced nodes (direction, node)
    position = place * (values.shape[1] - 1)
    cell = np.minimum(position.astype(np.intp), values.shape[1] - 2)
    rows, part = np.arange(len(values)), position - cell
    left, right = values[rows, cell], values[rows, cell + 1]
    sums = np.cumsum(np.pad(0.5 * (values[:, 1:] + values[:, :-1]), ((0, 0), (1, 0))), axis=1)
    return np.asarray((sums[rows, cell] + part * (left + 0.5 * part * (right - left))) / sums[:, -1])


def measured_brdf(
    brdf: xr.Dataset,
    light: ArrayLike,
    view: ArrayLike,
    azimuth: ArrayLike = 180.0,
    *,
    light_azimuth: ArrayLike = 0.0,
) -> xr.DataArray:
    r"""Return the BRDF of a measured material in several directions.

    Parameters
    ----------
    brdf
        Tensors as `hyperpaint.io.read_rgl` returns them.
    light, view
        Zenith angles [degree], 0 to below 90, one or (direction,).
    azimuth
        Azimuth of the view from the azimuth of the light [degree]; 180 is the side of the mirror direction.
    light_azimuth
        Azimuth of the light [degree], of an anisotropic material.

    Returns
    -------
    DataArray
        (direction, wavelength) float64 [sr-1].

    Raises
    ------
    SchemaError
        The dataset lacks tensors, or an angle is out of range.

    Notes
    -----
    Dupuy and Jakob (2018) store the BRDF times the cosine of the view over D / (4 sigma), at points x of a
    unit square; the distribution of facets m that the light meets maps x to m:

    .. math:: f(\omega_i, \omega_o, \lambda) \cos\theta_o = \frac{D(m)}{4 \sigma(\omega_i)}
              S(x(m), \omega_i, \lambda)

    All tensors are interpolated linearly, and held beyond their angles.

    Examples
    --------
    >>> lights, samples = ("light_azimuth", "light_zenith"), ("sample_v", "sample_u")
    >>> even = xr.Dataset(
    ...     {"vndf": ((*lights, "vndf_v", "vndf_u"), np.ones((1, 2, 2, 2))),
    ...      "spectra": ((*lights, "wavelength", *samples), np.full((1, 2, 1, 2, 2), 0.1))},
    ...     {"light_azimuth": [0.0], "light_zenith": [0.0, 90.0], "wavelength": [550.0]}
    ...     | dict.fromkeys(("vndf_v", "vndf_u", *samples), [0.0, 1.0]),
    ...     {"jacobian": 0},
    ... )
    >>> measured_brdf(even, light=[0.0, 45.0], view=60.0).values.round(3).tolist()
    [[0.2], [0.2]]
    """
    is_divided = bool(brdf.attrs.get("jacobian", 1))
    names = {"vndf", "spectra"} | ({"ndf", "sigma"} if is_divided else set())
    SchemaError.raise_if(
        not names <= set(brdf.variables),
        f"a BRDF without {', '.join(sorted(names - set(brdf.variables)))}",
        mend="open it with hp.io.read_rgl",
        code="variable-missing",
    )
    angles = np.radians(
        np.stack(np.broadcast_arrays(*map(np.atleast_1d, (light, view, azimuth, light_azimuth))))
    )
    SchemaError.raise_if(
        not ((angles[:2] >= 0.0) & (angles[:2] < 0.5 * np.pi) & np.isfinite(angles[2:])).all(),
        f"zenith angles from {np.degrees(angles[:2].min()):g} to {np.degrees(angles[:2].max()):g} degrees",
        expected="0 to below 90, and finite azimuths",
        code="value-out-of-range",
    )
    incoming, outgoing = (
        np.stack([np.sin(zenith) * np.cos(turn), np.sin(zenith) * np.sin(turn), np.cos(zenith)])
        for zenith, turn in ((angles[0], angles[3]), (angles[1], angles[2] + angles[3]))
    )
    # anisotropic materials measured over a half or a quarter of the azimuths are symmetric: light from other
    # azimuths is mirrored into the measured ones
    azimuths = np.radians(brdf["light_azimuth"].values)
    is_isotropic = azimuths.size <= 2
    symmetry = 1 if is_isotropic else round(2.0 * np.pi / np.ptp(azimuths))
    if symmetry >= 2:
        y = np.where(incoming[1] > 0.0, -1.0, 1.0)
        x = np.where(incoming[0] > 0.0, -1.0, 1.0) if symmetry == 4 else y
        signs = np.stack([x, y, np.ones_like(x)])
        incoming, outgoing = signs * incoming, signs * outgoing
    facet = incoming + outgoing
    facet /= np.linalg.norm(facet, axis=0)
    # directions on unit squares: u is sqrt(2 zenith / pi), v is (azimuth + pi) / (2 pi)
    light_turn, facet_turn = (np.arctan2(vector[1], vector[0]) for vector in (incoming, facet))
    tilt = 2.0 * np.arcsin(0.5 * np.linalg.norm(facet - [[0.0], [0.0], [1.0]], axis=0))
    u, light_u = (np.sqrt(2.0 * zenith / np.pi) for zenith in (tilt, angles[0]))
    turn = facet_turn - light_turn if is_isotropic else facet_turn
    v, light_v = ((each + np.pi) / (2.0 * np.pi) % 1.0 for each in (turn, light_turn))
    # light is held at its first and last angles
    lights = {"light_zenith": np.degrees(angles[0]), "light_azimuth": np.degrees(light_turn)}

    def at(tensor: xr.DataArray, **squares: Floats) -> xr.DataArray:
        points = {dim: values for dim, values in (lights | squares).items() if dim in tensor.dims}
        tensor = tensor.isel({dim: 0 for dim in points if tensor.sizes[dim] == 1}, drop=True)
        places = {
            dim: xr.DataArray(values.clip(*tensor[dim].values[[0, -1]]), dims="direction")
            for dim, values in points.items()
            if dim in tensor.dims
        }
        return tensor.interp(places).transpose("direction", ...).drop_vars(list(places)).astype(np.float64)

    # place of the facet among the facets that the light meets: over u in its row, and over the rows
    density = brdf["vndf"].astype(np.float64)
    density = density / density.integrate(["vndf_u", "vndf_v"])
    sample_u = _cumulative(at(density, vndf_v=v).values, u)
    sample_v = _cumulative(at(density.integrate("vndf_u")).values, v)
    value = at(brdf["spectra"], sample_u=sample_u, sample_v=sample_v)
    if is_divided:
        value *= at(brdf["ndf"], ndf_u=u, ndf_v=v) / (
            4.0 * at(brdf["sigma"], sigma_u=light_u, sigma_v=light_v)
        )
    attrs = {"units": "sr-1", "long_name": "Bidirectional reflectance distribution function"}
    return (value / xr.DataArray(outgoing[2], dims="direction")).rename("brdf").assign_attrs(attrs)


class PaintFit(NamedTuple):
    """A paint of the renderer, fitted to a measured BRDF.

    Attributes
    ----------
    material
        Coat and flakes of the paint, for a scene.
    spectra
        Reflectance of its base and flakes by name, for `relight`: wavelengths [nm] and reflectance.
    residual
        (direction, wavelength): BRDF of the paint over the measured BRDF, minus 1, with ``light``, ``view``,
        ``azimuth`` and ``aspecular`` [degree].
    """

    material: Material
    spectra: dict[str, tuple[Floats, Floats]]
    residual: xr.DataArray


def fit_paint(brdf: xr.Dataset, name: str, *, coat: Coat = Coat()) -> PaintFit:  # noqa: B008  (frozen)
    r"""Return the coat and flakes of the renderer that are nearest to a measured BRDF.

    Parameters
    ----------
    brdf
        Tensors as `hyperpaint.io.read_rgl` returns them.
    name
        Name of the paint and of its spectra.
    coat
        Its clear coat. It is not fitted: within 15 degrees of the mirror direction a measured BRDF shows the
        resolution of the instrument.

    Returns
    -------
    PaintFit
        ``material`` for a scene; ``spectra`` of base and flakes for `relight`; ``residual`` (direction,
        wavelength), BRDF of the paint over the measured BRDF minus 1, with the angles of the directions.

    Raises
    ------
    SchemaError
        The dataset lacks tensors, or its BRDF is not positive in a direction of the fit.

    Notes
    -----
    With the lobes B of the base, F of the flakes and R of light that the coat returns to them,

    .. math:: \pi f = B a + F b + R b (a + b), \quad a = (1 - s) \rho', \quad b = s m

    of base :math:`\rho'`, flakes :math:`m` and their share :math:`s`. For each roughness of the flakes,
    a and b of every wavelength minimise the squared relative differences; the roughness with the smallest sum
    is taken. Only a and b are measured: s is the share whose brightest flakes are aluminium.

    Examples
    --------
    >>> lights, samples = ("light_azimuth", "light_zenith"), ("sample_v", "sample_u")
    >>> even = xr.Dataset(
    ...     {"vndf": ((*lights, "vndf_v", "vndf_u"), np.ones((1, 2, 2, 2))),
    ...      "spectra": ((*lights, "wavelength", *samples), np.full((1, 2, 1, 2, 2), 0.1))},
    ...     {"light_azimuth": [0.0], "light_zenith": [0.0, 90.0], "wavelength": [550.0]}
    ...     | dict.fromkeys(("vndf_v", "vndf_u", *samples), [0.0, 1.0]),
    ...     {"jacobian": 0},
    ... )
    >>> paint = fit_paint(even, "even")
    >>> paint.material.spectrum, paint.residual.dims
    ('even', ('direction', 'wavelength'))
    """
    light, view, azimuth = np.array(list(itertools.product(*_DIRECTIONS))).T
    mirror = np.cos(np.radians(light)) * np.cos(np.radians(view))
    mirror -= np.sin(np.radians(light)) * np.sin(np.radians(view)) * np.cos(np.radians(azimuth))
    aspecular = np.degrees(np.arccos(mirror.clip(-1.0, 1.0)))
    is_far = aspecular >= _MIN_ASPECULAR_DEG - 1e-6
    light, view, azimuth, aspecular = (angle[is_far] for angle in (light, view, azimuth, aspecular))
    measured = measured_brdf(brdf, light, view, azimuth)
    SchemaError.raise_if(
        not bool((measured > 0.0).all()),
        f"the BRDF is {float(measured.min()):g} sr-1 in a direction",
        expected="above 0 up to 60 degrees from the normal",
        code="value-out-of-range",
    )
    factor = np.pi * measured.values
    directions = list(zip(light, view, azimuth, strict=True))
    fits = []
    for alpha in map(float, ALPHAS):
        lobes = [lobe_factors(coat.index, alpha, *angles) for angles in directions]
        base, flakes, recycled = np.array([(lobe.base, lobe.flakes, lobe.recycled) for lobe in lobes]).T[
            ..., None
        ]
        a, b = np.zeros((2, factor.shape[1]))
        for _ in range(_ROUNDS):
            # least squares of two positive factors at every wavelength
            u, v = base / factor, (flakes + recycled * (a + b)) / factor
            uu, uv, vv = ((first * second).sum(axis=0) for first, second in ((u, u), (u, v), (v, v)))
            b = ((uu * v.sum(axis=0) - uv * u.sum(axis=0)) / (uu * vv - uv**2)).clip(0.0, v.sum(axis=0) / vv)
            a = ((u.sum(axis=0) - uv * b) / uu).clip(0.0)
        fits.append((float(((u * a + v * b - 1.0) ** 2).sum()), alpha, a, b))
    _, alpha, a, b = min(fits, key=lambda fit: fit[0])
    # the share of flakes, and spectra of base and flakes as relighting takes them
    share = float(min(b.max() / _ALUMINIUM, max(b.max(), 1.0 - a.max()), 1.0))
    has_flakes = share > _MIN_SHARE
    metal = (b / share).clip(0.0, 1.0) if has_flakes else np.zeros_like(b)
    effective = (a / max(1.0 - share, _MIN_SHARE)).clip(0.0, 1.0)
    returned = internal_reflectance(coat.index)
    body = coated_reflectance(effective / (1.0 - returned * (1.0 - effective)), coat.index)
    lobe = Flakes(share, alpha, f"{name}:flakes") if has_flakes else None
    material = Material(name, name, "paint", coat, lobe)
    nm = brdf["wavelength"].values.astype(np.float64)
    fitted = np.stack(
        [
            reflectance_factor(material, body, metal, light=zenith, view=seen, azimuth=turn)
            for zenith, seen, turn in directions
        ]
    )
    angles = {"light": light, "view": view, "azimuth": azimuth, "aspecular": aspecular}
    residual = xr.DataArray(
        fitted / factor - 1.0,
        {key: ("direction", angle, {"units": "degree"}) for key, angle in angles.items()}
        | {"wavelength": measured["wavelength"]},
        measured.dims,
        "residual",
        {"units": "1", "long_name": "Relative difference of the fitted BRDF"},
    )
    return PaintFit(material, {name: (nm, body), f"{name}:flakes": (nm, metal)}, residual)
