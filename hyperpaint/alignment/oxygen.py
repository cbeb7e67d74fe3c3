"""Mean spectra of columns, and the residual oxygen A band in them: a sign of wrong wavelengths."""

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented, takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    Bools,
    Floats,
    Indices,
    Ints,
    Progress,
    rename_to_roles,
    require,
)
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.radiometry.stray_light import described

#: Number of first lines in which bad elements are detected.
_FIRST_LINES = 64


def radiance_of_bands(dataset: xr.Dataset, used: Indices) -> xr.DataArray:
    # Return radiance of some bands on any scale, lazily; stray light is subtracted with all bands.
    dataset = dataset.assign_attrs(absolute_scale="not needed")  # wavelengths do not depend on the scale
    if described(dataset.variables) is None:
        return radiance(dataset.isel({BAND: used}))["radiance"]
    return radiance(dataset)["radiance"].isel({BAND: used})


def mean_over_lines(
    cube: xr.DataArray, level: Floats, progress: Progress | None = None
) -> tuple[Floats, Ints]:
    # Return the mean over lines of a cube over its light's level (band, column), and its number of pixels.
    #
    # One slab is in memory at a time. Lines are added in order, so that the result does not depend
    # on chunks. A pixel counts if all bands are valid, apart from bands without values in all of the first
    # lines, whose mean is NaN.
    cube = line_chunked(cube)
    count = cube.sizes[ALONG_TRACK]
    first_lines = cube[:_FIRST_LINES].values
    has_values = np.isfinite(first_lines).any(axis=1, keepdims=True)
    is_bad = (np.isnan(first_lines) | ~has_values).all(axis=0) & has_values.any(axis=0)
    total = np.zeros(cube.shape[1:])
    scaled = np.empty_like(total)
    pixels = np.zeros(cube.shape[2], np.int64)
    start = 0
    for size in cube.chunks[0] if cube.chunks else (count,):
        stop = start + size
        slab = first_lines[start:stop] if stop <= len(first_lines) else cube[start:stop].values
        for values, light in zip(slab, level[start:stop], strict=True):
            if np.isfinite(light):
                is_complete = (np.isfinite(values) | is_bad).all(axis=0)
                pixels += is_complete
                np.add(total, np.divide(values, light, out=scaled), out=total, where=is_complete & ~is_bad)
        start += size
        if progress is not None:
            progress(start, count)
    with np.errstate(invalid="ignore"):
        return np.where(is_bad | (pixels == 0), np.nan, total / pixels), pixels


#: Intervals beside the oxygen A band, free of it at a width of 6 nm [nm].
SHOULDERS = ((740.0, 753.0), (775.0, 788.0))
#: Weights of bands fall linearly from 1 at this wavelength to 0 at this distance [nm].
CENTRE, REACH = 760.0, 5.0
MIN_SHOULDER_BANDS = 4


@documented()
def oxygen_residual(dataset: xr.Dataset, *, progress: Progress | None = None) -> xr.DataArray:
    r"""Return the residual depth of the oxygen A band in the reflectance of every column.

    Eager: reads the line once, a slab at a time; the result does not depend on chunks.

    Parameters
    ----------
    dataset
        A flight line with ``reflectance`` (along_track, band, cross_track) and ``wavelength`` (band), or with
        the variables that `hyperpaint.reflectance` needs.
    progress

    Returns
    -------
    (cross_track,), float64
        Depth [1]: positive where the band remains in reflectance, negative where it is overcorrected; NaN
        where no pixel has all samples.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, or no bands lie in the oxygen band or on one of its shoulders.

    Notes
    -----
    .. math:: d = 1 - \sum_b w_b \bar\rho_b / \rho_{c,b}, \qquad
              w_b \propto \max(0, 1 - |\lambda_b - 760| / 5), \qquad \sum_b w_b = 1

    with :math:`\bar\rho` the mean over lines at the column's own wavelengths, and :math:`\rho_c` the parabola
    through its shoulders, 740-753 and 775-788 nm. 760 nm is on the steep side of the band, where
    shift and width both show: with a 6 nm camera the depth is about -0.06 for each nanometre that declared
    wavelengths are too long, and 0.03 for each that declared widths are too large. The two can cancel;
    `hyperpaint.alignment.align_to_irradiance` separates them.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=8, columns=3, smile_nm=0.0, noise=False)
    >>> moved = line.assign_coords(wavelength=line.wavelength + 0.5)
    >>> bool(abs(oxygen_residual(line)).max() < 0.01 < abs(oxygen_residual(moved)).min())
    True
    """
    dataset = rename_to_roles(dataset)
    if "reflectance" not in dataset.variables:
        dataset = reflectance(dataset)
    names = ["wavelength", "reflectance", *(n for n in ("wavelength_shift",) if n in dataset.variables)]
    arrays = require(dataset, names, "the oxygen residual")
    cube = arrays["reflectance"]
    shift = arrays["wavelength_shift"].values if "wavelength_shift" in arrays else 0.0
    wavelengths = arrays["wavelength"].values[:, None] + np.broadcast_to(
        shift, (cube.sizes[BAND], cube.sizes[CROSS_TRACK])
    )
    shoulders, weight = _parts(wavelengths)
    SchemaError.raise_if(
        not (weight.any(axis=0) & (shoulders.sum(axis=0) >= MIN_SHOULDER_BANDS)).all(),
        "too few bands for the oxygen residual",
        expected=f"one in 755-765 nm and {MIN_SHOULDER_BANDS} in its shoulders, 740-753 and 775-788 nm, "
        "in every column",
        code="bands-too-few",
    )
    used_bands = np.flatnonzero((shoulders | (weight > 0)).any(axis=1))
    mean, _ = mean_over_lines(cube[:, used_bands], np.ones(cube.sizes[ALONG_TRACK]), progress)
    depth = np.array([oxygen_depth(wavelengths[used_bands, x], mean[:, x]) for x in range(mean.shape[1])])
    residual = xr.DataArray(depth, dims=CROSS_TRACK, name="oxygen_residual")
    return residual.assign_attrs(
        units="1", long_name="Depth of the oxygen A band left in reflectance; negative where overcorrected"
    )


def _parts(wavelength: Floats) -> tuple[Bools, Floats]:
    shoulders = np.logical_or.reduce([(wavelength >= low) & (wavelength <= high) for low, high in SHOULDERS])
    return shoulders, np.clip(1.0 - np.abs(wavelength - CENTRE) / REACH, 0.0, None)


@takes_quantities(wavelength="nm", spectrum="1")
def oxygen_depth(wavelength: Floats, spectrum: Floats) -> float:
    """Return the residual depth of the oxygen A band in one spectrum, see `oxygen_residual`.

    Parameters
    ----------
    wavelength, spectrum : (band,), float64
        [nm], and reflectance [1]; NaN where it is missing.

    Returns
    -------
    float
        Depth [1]; NaN where there are too few bands in it or on its shoulders.

    Examples
    --------
    >>> nm = np.arange(740.0, 781.0, 2.0)
    >>> left = oxygen_depth(nm, 0.3 - 0.03 * np.exp(-(((nm - 761.0) / 3.0) ** 2)))
    >>> abs(oxygen_depth(nm, np.full(nm.size, 0.3))) < 1e-12 < left
    True
    """
    shoulders, weight = _parts(wavelength)
    is_finite = np.isfinite(spectrum)
    in_shoulders, in_band = shoulders & is_finite, (weight > 0.0) & is_finite
    if in_shoulders.sum() < MIN_SHOULDER_BANDS or not in_band.any():
        return float("nan")
    curve = np.polynomial.Polynomial.fit(wavelength[in_shoulders], spectrum[in_shoulders], 2)
    return float(1.0 - np.average(spectrum[in_band] / curve(wavelength[in_band]), weights=weight[in_band]))
