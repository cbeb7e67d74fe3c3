"""Reflectance of the body under a clear coat near its normal, from reflectance under sun and sky."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.mirrored_light import BODY, EXCLUDED, mirror_reflection
from hyperpaint.base.schema import BAND, SIGNATURE
from hyperpaint.base.units import takes_quantities
from hyperpaint.light.coat_transmission import COAT_INDEX, COAT_INDEX_U, sky_reflectance, transmitted_share

from .corrections import (
    LEVELS,
    NORMAL_REFLECTANCE,
    WIDTHS,
    as_fractions,
    note_unusable,
    sky_above,
    with_correction,
)
from .light_split import LightSplit, split_of
from .sun_and_sky import sun_zenith_of

#: Attribute of reflectance with the assumed coat.
COAT_CORRECTED = "coat_corrected"

#: Standard deviation of the lean of roofs and bonnets that are assumed to be level [degree].
LEAN_U_DEG = 2.0


@takes_quantities(sun_zenith="degree", view_zenith="degree", lean_u="degree")
def correct_coat(
    line: xr.Dataset,
    *,
    index: float = COAT_INDEX,
    index_u: float = COAT_INDEX_U,
    lean_u: float = LEAN_U_DEG,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    view_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Divide by the transmission of a clear coat relative to its transmission near the normal.

    Lazy. For paint whose mirrored sky was removed (`remove_mirrored_sky`): a body under a coat receives less
    light the lower the sun stands, 5 % less at 60 degrees, 8 % at 65. Assumes a level body part, unless
    `correct_light` was applied; then ``sun_zenith`` is the angle of the sun to its normal.

    Parameters
    ----------
    line
        Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``; or a paint library,
        with ``sun_zenith``, ``view_zenith`` and ``diffuse_fraction`` of each paint.
    index, index_u
        Refractive index of the coat, and its standard uncertainty [1].
    lean_u
        Standard uncertainty of the angle between sun and body part [degree].
    diffuse, sun_zenith, sky
        As for `remove_mirrored_sky`.
    view_zenith
        Angle between the body part's normal and the camera [degree]; by default that of a library's paints, 0
        for a line: up to 40 degrees its effect is 0.6 %.

    Returns
    -------
    Dataset
        The same with ``reflectance``, its spread, quantiles, members and uncertainties divided, the
        uncertainty of the coat included in ``reflectance_u_systematic`` where present, and
        ``coat_transmission`` C and ``coat_transmission_u`` [1]; for a library also ``reflectance_u_coat``
        [1], the uncertainty from C and the subtracted mirrored sky, common to all pixels of a paint.
        Attributes of reflectance: ``coat_corrected``; ``quantity``, which is then the body under the coat;
        ``specular_component`` "excluded".

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are out of range, the mirrored sky is included,
        the coat was corrected before, or the split or the sun is unknown; all are listed.

    Warns
    -----
    PaintWarning
        The state of the sky is unknown, and a clear one is assumed.

    Notes
    -----
    .. math:: \rho = \rho_{seen} / C, \qquad C = \frac{f_{dir} (1 - F(\theta_s)) + f_{dif} (1 - F_{sky})}
              {1 - F(0)} \cdot \frac{1 - F(\theta_v)}{1 - F(0)}

    with Fresnel's reflectance F, see `hyperpaint.light.coat_transmission`. The uncertainty of C combines
    those of the index, the lean, and the diffuse fraction; the uncertainty of the mirrored sky combines the
    index, on which F(0) depends with :math:`4 (n - 1) / (n + 1)^3`, and the fraction.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.475, 0.475]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [450.0, 850.0], {"units": "nm"})})
    >>> paint.reflectance.attrs["mirror_reflection"] = "excluded"
    >>> correct_coat(paint, sun_zenith=60.0, diffuse="model").reflectance.values.round(3)
    array([0.508, 0.504], dtype=float32)
    """
    line = schema.rename_to_roles(line)
    problems = Problems("the coat's share cannot be corrected", SchemaError)
    numbers = {"index": (index, 1.0, 3.0), "index_u": (index_u, 0.0, 1.0), "lean_u": (lean_u, 0.0, 45.0)}
    note_unusable(problems, line, numbers)
    if "reflectance" in line.variables:
        attrs = line["reflectance"].attrs
        if COAT_CORRECTED in attrs:
            problems.add(
                f"the coat was corrected before: {COAT_CORRECTED} is {attrs[COAT_CORRECTED]!r}",
                mend="start from reflectance without this correction",
                code="corrected-before",
            )
        elif mirror_reflection(line) != EXCLUDED:
            problems.add(
                "the reflectance includes the sky mirrored by the coat, or does not declare its exclusion",
                mend="call remove_mirrored_sky first, or set reflectance.attrs['mirror_reflection'] = "
                f"{EXCLUDED!r} where no mirrored sky is included",
                option="give --specular-sky",
                code="mirrored-sky-included",
            )
    problems.raise_if_any()
    line = as_fractions(line)
    coat = (float(index), float(index_u), float(lean_u))
    if SIGNATURE in line["reflectance"].dims:
        shares = _paint_shares(line, coat, (diffuse, sun_zenith, sky), view_zenith)
    else:
        split = split_of(line, diffuse, sun_zenith, sky)
        zenith = split.zenith if np.isfinite(split.zenith) else sun_zenith_of(line, sun_zenith)
        shares = _shares(split, zenith, 0.0 if view_zenith is None else view_zenith, coat)
    share, share_u, mirror_u = (array.astype(np.float32) for array in shares)
    corrected = {name: line[name] / share for name in (*LEVELS, *WIDTHS) if name in line.variables}
    # index and split also determine the uncertainty of the subtracted mirrored sky
    was_removed = "mirrored_sky_removed" in line["reflectance"].attrs
    coat_u = ((corrected["reflectance"] * share_u) ** 2 + float(was_removed) * mirror_u**2) ** 0.5 / share
    if "reflectance_u_systematic" in corrected:
        corrected["reflectance_u_systematic"] = (
            corrected["reflectance_u_systematic"] ** 2 + coat_u**2
        ) ** 0.5
    text = f"clear coat of index {index:g} +- {index_u:g}, panel level +- {lean_u:g} degree"
    result = with_correction(line, corrected, COAT_CORRECTED, text)
    quantity = {"quantity": BODY, "specular_component": EXCLUDED, "mirror_reflection": EXCLUDED}
    result["reflectance"] = result["reflectance"].assign_attrs(quantity)
    layers = {"coat_transmission": share, "coat_transmission_u": share_u}
    table = schema.LIBRARY_VARIABLES if SIGNATURE in line["reflectance"].dims else schema.VARIABLES
    if SIGNATURE in line["reflectance"].dims:
        layers["reflectance_u_coat"] = coat_u.transpose(SIGNATURE, BAND).astype(np.float32)
    return result.assign({name: layer.assign_attrs(table[name].attrs) for name, layer in layers.items()})


def _shares(
    split: LightSplit, incidence: float, view: float, coat: tuple[float, float, float]
) -> tuple[xr.DataArray, xr.DataArray, xr.DataArray]:
    # Relative transmission C, its standard uncertainty, and the uncertainty of the mirrored sky, on the dims
    # of the split. `coat`: index, its uncertainty, uncertainty of the lean [degree].
    index, index_u, lean_u = coat

    def share(fraction: Any, n: float, angle: float) -> Any:
        sky = _mean_sky_reflectance(split, incidence, n)
        return transmitted_share(fraction, sky, float(np.clip(angle, 0.0, 89.9)), view, n)

    # uncertainties by finite differences in index, lean and diffuse fraction
    relative = share(split.fraction, index, incidence)
    by_index = 0.5 * (
        share(split.fraction, index + index_u, incidence)
        - share(split.fraction, max(1.0, index - index_u), incidence)
    )
    leans = [abs(share(split.fraction, index, incidence + turn) - relative) for turn in (-lean_u, lean_u)]
    by_sky = split.u * abs(share(1.0, index, incidence) - share(0.0, index, incidence))
    relative_u = np.sqrt(by_index**2 + (0.5 * (leans[0] + leans[1])) ** 2 + by_sky**2)
    normal_u = 4.0 * (index - 1.0) / (index + 1.0) ** 3 * index_u
    mirror_u = sky_above(split) * np.sqrt(
        (normal_u * split.fraction) ** 2 + (NORMAL_REFLECTANCE * split.u) ** 2
    )
    return relative, relative_u, mirror_u


def _mean_sky_reflectance(split: LightSplit, sun_zenith: float, index: float) -> Any:
    # Reflectance of the coat for the light of the whole sky, between clear and overcast
    def reflectance(zenith: float | None, cloud: float) -> xr.DataArray:
        return xr.DataArray(sky_reflectance(split.wavelength, zenith, cloud, index), dims=BAND)

    if split.sky == "uniform":
        return reflectance(None, 0.0)
    sun = min(sun_zenith, 89.0)
    return (1.0 - split.cloud) * reflectance(sun, 0.0) + split.cloud * reflectance(sun, 1.0)


def _paint_shares(
    library: xr.Dataset,
    coat: tuple[float, float, float],
    light: tuple[Any, float | None, str | None],
    view_zenith: float | None,
) -> tuple[xr.DataArray, ...]:
    # `_shares` of every paint under its sun (signature, band); `light`: arguments of `split_of`
    diffuse, sun_zenith, sky = light
    names = (
        "wavelength",
        "diffuse_fraction",
        "diffuse_fraction_u",
        "sky_state",
        "sun_zenith",
        "view_zenith",
    )
    light_variables = library[[name for name in names if name in library.variables]].reset_coords().compute()
    rows = []
    for number in range(library.sizes[SIGNATURE]):
        paint = light_variables.isel({SIGNATURE: number})
        zenith = sun_zenith
        if zenith is None and "sun_zenith" in paint and np.isfinite(paint["sun_zenith"].item()):
            zenith = float(paint["sun_zenith"].item())
        if "diffuse_fraction" in paint and not np.isfinite(paint["diffuse_fraction"]).any():
            paint = paint.drop_vars("diffuse_fraction")
        split = split_of(paint, diffuse, zenith, sky)
        incidence = split.zenith if np.isfinite(split.zenith) else sun_zenith_of(paint, zenith)
        view = paint["view_zenith"].item() if view_zenith is None and "view_zenith" in paint else view_zenith
        view_angle = 0.0 if view is None or not np.isfinite(view) else min(float(view), 85.0)
        rows.append(_shares(split, incidence, view_angle, coat))
    return tuple(
        xr.concat([array.reset_coords(drop=True) for array in arrays], SIGNATURE).transpose(SIGNATURE, BAND)
        for arrays in zip(*rows, strict=True)
    )
