"""How sure every sample is: noise, and what is common to a flight, beside the reflectance itself.

Called band by band while the slab's rows are at hand; each loop writes one array, since one that wrote two
would not be vectorised.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["propagate_line"]


_NOTHING = np.float32(0.0)
_ONE = np.float32(1.0)


@kernel
def light_run(
    shift: Array,
    light: Array,
    cell: Any,
    line: Any,
    band: Any,
    own: Any,
    first: Any,
    last: Any,
    row: Any,
    irradiance: Array,
) -> None:
    """Write a cubic in ``shift``, for columns ``first`` to ``last``."""
    c0, c1 = light[line, band, cell, 0], light[line, band, cell, 1]
    c2, c3 = light[line, band, cell, 2], light[line, band, cell, 3]
    for x in range(np.uint64(first), np.uint64(last)):
        s = shift[own, x]
        irradiance[row, x] = c0 + s * (c1 + s * (c2 + s * c3))


@kernel
def light_row(
    light: Array,
    shift: Array,
    edges: Array,
    cells: Array,
    line: Any,
    band: Any,
    row: Any,
    irradiance: Array,
    inverse: Array,
) -> None:
    """Write what dark-subtracted counts times gain are divided by, and its inverse."""
    if light.shape[3] == 1:
        inverse[row, :] = light[line, band, 0, 0]
        irradiance[row, :] = _ONE / light[line, band, 0, 0]
        return
    own = band if shift.shape[0] > 1 else 0
    for run in range(cells.shape[1]):
        first, last = edges[own, run], edges[own, run + 1]
        light_run(shift, light, cells[own, run], line, band, own, first, last, row, irradiance)
    for x in range(inverse.shape[1]):
        inverse[row, x] = _ONE / irradiance[row, x]


@kernel
def random_row(
    out: Array,
    gain: Array,
    inverse: Array,
    per_electron: Array,
    noise_floor: Array,
    line: Any,
    band: Any,
    row: Any,
    u_random: Array,
) -> None:
    """Write m sqrt(signal / k + floor), m reflectance per count; a negative signal adds no variance."""
    own_k = band if per_electron.shape[0] > 1 else 0
    own_floor = band if noise_floor.shape[0] > 1 else 0
    for x in range(gain.shape[1]):
        value, per_count = out[line, band, x], abs(gain[band, x] * inverse[row, x])
        # not max(), which would lose the NaN
        shot = _NOTHING if value < _NOTHING else value
        variance = per_count * (shot * per_electron[own_k, x] + per_count * noise_floor[own_floor, x])
        u_random[line, band, x] = np.sqrt(variance)


@kernel
def proportional_row(out: Array, relative: Array, line: Any, band: Any, u_systematic: Array) -> None:
    """Write the systematic uncertainty where all of it is proportional to reflectance."""
    own = band if relative.shape[0] > 1 else 0
    for x in range(out.shape[2]):
        u_systematic[line, band, x] = abs(out[line, band, x]) * relative[own, x]


@kernel
def systematic_row(
    out: Array,
    gain: Array,
    irradiance: Array,
    inverse: Array,
    relative: Array,
    offset: Array,
    slope: Array,
    line: Any,
    band: Any,
    low: Any,
    high: Any,
    u_systematic: Array,
) -> None:
    """Write the systematic uncertainty, given which bands are next to the band."""
    own = band if relative.shape[0] > 1 else 0
    own_offset = band if offset.shape[0] > 1 else 0
    up, up_alone, down, down_alone = slope[band, 0], slope[band, 1], slope[band, 2], slope[band, 3]
    row, row_low, row_high = band % 3, low % 3, high % 3
    for x in range(out.shape[2]):
        here, lit = out[line, band, x], inverse[row, x]
        # radiance of the neighbours, in units of this band's light
        below = out[line, low, x] * (irradiance[row_low, x] * lit)
        above = out[line, high, x] * (irradiance[row_high, x] * lit)
        rise = above - here if above == above else _NOTHING
        fall = here - below if below == below else _NOTHING
        # without one neighbour, the other alone tells the slope
        to_above = up if below == below else up_alone
        to_below = down if above == above else down_alone
        wavelength = rise * to_above + fall * to_below
        dark = gain[band, x] * lit * offset[own_offset, x]
        scale = here * relative[own, x]
        u_systematic[line, band, x] = np.sqrt(scale * scale + (wavelength * wavelength + dark * dark))


@kernel
def propagate_line(
    gain: Array,
    light: Array,
    shift: Array,
    edges: Array,
    cells: Array,
    per_electron: Array,
    noise_floor: Array,
    relative: Array,
    offset: Array,
    slope: Array,
    line: Any,
    out: Array,
    irradiance: Array,
    inverse: Array,
    u_random: Array,
    u_systematic: Array,
) -> None:
    """Write the random and the systematic uncertainty of a line.

    The systematic one of a band needs the light of the band after it, and so comes one band later.

    Parameters
    ----------
    gain, light, shift, edges, cells
        See `hyperpaint.kernels.radiometry.calibrate_slab`.
    per_electron, noise_floor, relative : (1 or band, column), float32
        Counts per electron, variance without light [count2], and relative systematic uncertainty.
    offset : (1 or band, column), float32
        Systematic uncertainty of the dark [count].
    slope : (0 or band, 4), float32
        Wavelength uncertainty over the distance to the neighbouring bands: what the rise to the band above is
        multiplied by with a band below, and without; what the rise from the band below is multiplied by
        with a band above, and without. Empty where neither wavelengths nor the dark are uncertain.
    out : (line, band, column), float32
        Reflectance, not yet rounded.
    irradiance, inverse : (3, column), float32
        Memory for the light of a band and the two before it.
    u_random, u_systematic : (line, band, column), float32
        Written.
    """
    last = out.shape[1] - 1
    for band in range(last + 1):
        light_row(light, shift, edges, cells, line, band, band % 3, irradiance, inverse)
        random_row(out, gain, inverse, per_electron, noise_floor, line, band, band % 3, u_random)
        if slope.shape[0] == 0:
            proportional_row(out, relative, line, band, u_systematic)
            continue
        for done in range(max(band - 1, 0), band + (band == last)):
            systematic_row(
                out, gain, irradiance, inverse, relative, offset, slope,
                line, done, max(done - 1, 0), min(done + 1, last), u_systematic,
            )  # fmt: skip
