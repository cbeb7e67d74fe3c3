"""Values of measured BRDFs, as `hyperpaint.io.read_rgl` reads them."""

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Floats


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
    light: npt.ArrayLike,
    view: npt.ArrayLike,
    azimuth: npt.ArrayLike = 180.0,
    *,
    light_azimuth: npt.ArrayLike = 0.0,
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
    >>> grid = [0.0, 1.0]
    >>> flat = xr.Dataset(
    ...     {name: ((f"{name}_v", f"{name}_u"), np.ones((2, 2))) for name in ("ndf", "sigma")}
    ...     | {"vndf": (("light_azimuth", "light_zenith", "vndf_v", "vndf_u"), np.ones((1, 2, 2, 2)))}
    ...     | {"spectra": (("light_azimuth", "light_zenith", "wavelength", "sample_v", "sample_u"),
    ...        np.full((1, 2, 1, 2, 2), 0.4))},
    ...     {"light_azimuth": [0.0], "light_zenith": [0.0, 90.0], "wavelength": [550.0]}
    ...     | {f"{name}_{axis}": grid for name in ("ndf", "sigma", "vndf", "sample") for axis in "uv"},
    ...     {"jacobian": 1},
    ... )
    >>> measured_brdf(flat, light=[0.0, 45.0], view=60.0).values.round(3).tolist()
    [[0.2], [0.2]]
    """
    names = {"ndf", "sigma", "vndf", "spectra"}
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
    if brdf.attrs.get("jacobian", 1):
        value *= at(brdf["ndf"], ndf_u=u, ndf_v=v) / (
            4.0 * at(brdf["sigma"], sigma_u=light_u, sigma_v=light_v)
        )
    attrs = {"units": "sr-1", "long_name": "Bidirectional reflectance distribution function"}
    return (value / xr.DataArray(outgoing[2], dims="direction")).rename("brdf").assign_attrs(attrs)
