"""Spectral responses, and the operators that turn one instrument's channels into another's bands.

Sampling a 3 nm spectrometer at the band centres of a 6 nm imager leaves tens of per cent at the oxygen band.
Here the weights on the spectrometer's channels are chosen so that their summed responses reproduce the
imager's band response; for two Gaussians this equals the residual kernel ``sqrt(FWHM_i^2 - FWHM_s^2)``, and
it holds for any other pair of shapes too.
"""

import functools
import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hyperpaint.base import SRF_SHAPES, ArrayLike, Floats, Ints, Problems, SchemaError, one_of

#: Standard deviation of a Gaussian per unit of full width at half maximum.
GAUSSIAN_SIGMA = 1.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))

#: Half support of a Gaussian line shape in FWHM; beyond it lie 2e-7 of its area.
_REACH = 2.2

#: Steps of the grid of responses per width of the narrowest channel.
STEPS_PER_FWHM = 40.0

#: Maximum grid steps of one band, and of grid steps times nearby channels; widths may differ a thousandfold.
MAX_GRID_STEPS, MAX_GRID_SAMPLES = 200_000, 100_000_000

#: Ridge of the least squares, in units of the mean squared norm of a spectrometer response.
RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class Responses:
    # Spectral responses of a set of bands.
    #
    # A response is the line shape times the responsivity, which over one band is an exponential in
    # wavelength.
    wavelength: Floats  #: (band,): centres [nm]
    fwhm: Floats  #: (band,): full widths at half maximum [nm]
    #: ``"gaussian"``; ``"slit"``: the slit image, a box ``fwhm`` wide, convolved with a pixel one band
    #: spacing wide: a trapezoid; ``"tabulated"``: `table` on `offset`
    shape: str = "gaussian"
    spacing: Floats | None = None  #: (band,): band spacing [nm]; only the slit shape uses it
    slope: Floats | None = None  #: (band,): relative slope of the responsivity, d ln R / d wavelength [nm-1]
    #: offset (srf_offset,), table (band, srf_offset): tabulated line shapes: distances from the centre [nm]
    #: and values of any scale
    offset: Floats | None = None
    table: Floats | None = None

    def __post_init__(self) -> None:
        wavelength = np.atleast_1d(np.asarray(self.wavelength, np.float64))
        fwhm = np.broadcast_to(np.asarray(self.fwhm, np.float64), wavelength.shape)
        with Problems("spectral responses cannot be used", SchemaError) as problems:
            one_of(self.shape, SRF_SHAPES, "line shape", problems=problems)
            problems.add_if(
                not np.isfinite(wavelength).all(), "wavelengths are not finite", code="not-finite"
            )
            problems.add_if(
                self.shape != "tabulated" and not (np.isfinite(fwhm).all() and (fwhm > 0).all()),
                "'fwhm' is not finite and positive",
                expected="widths in nm",
                code="fwhm-invalid",
            )
            if self.shape == "tabulated" and (self.offset is None or self.table is None):
                problems.add(
                    "line shape 'tabulated' without its table",
                    expected="'srf' (band, srf_offset) and 'srf_offset' [nm]",
                    code="variable-missing",
                )
            elif self.shape == "tabulated":
                offset, table = np.asarray(self.offset), np.asarray(self.table)
                if table.shape != (wavelength.size, offset.size):
                    problems.add(
                        f"'srf' has shape {table.shape}",
                        expected=f"({wavelength.size}, {offset.size}): (band, srf_offset)",
                        code="length-mismatch",
                    )
                elif not (np.isfinite(table).all() and (table.sum(axis=1) > 0).all()):
                    problems.add(
                        "a row of 'srf' is not finite or has no positive sum", code="response-table-invalid"
                    )
                problems.add_if(
                    offset.size < 3 or not (np.diff(offset) > 0).all(),
                    "'srf_offset' does not increase or is too short",
                    expected="three or more values in nm",
                    code="response-table-invalid",
                )
        object.__setattr__(self, "wavelength", wavelength)
        object.__setattr__(self, "fwhm", fwhm)
        if self.shape == "slit":
            steps = np.abs(np.diff(wavelength))
            jumps = np.abs(np.log(steps[1:] / steps[:-1])) if steps.all() else np.array([np.inf])
            is_even = wavelength.size > 1 and jumps.max(initial=0.0) <= np.log(1.3)
            SchemaError.raise_if(
                self.spacing is None and not is_even,
                "a slit-shaped response needs the camera's band spacing, and these bands are not contiguous",
                mend="give 'band_spacing' (band) [nm], or select bands after computing the reflectance",
                code="band-spacing-missing",
            )
            spacing = band_spacing(wavelength) if self.spacing is None else self.spacing
            object.__setattr__(self, "spacing", np.broadcast_to(spacing, wavelength.shape))

    def _content(self) -> tuple[Any, ...]:
        arrays = (self.wavelength, self.fwhm, self.spacing, self.slope, self.offset, self.table)
        return (self.shape, *(None if a is None else np.asarray(a, np.float64).tobytes() for a in arrays))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Responses) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def shifted(self, shift: float) -> "Responses":
        # Return the same responses with every centre moved by ``shift`` [nm].
        return replace(self, wavelength=self.wavelength + shift)

    def reach(self) -> Floats:
        # Half support of each band [nm], beyond which a response is negligible.
        if self.shape == "gaussian":
            return np.asarray(_REACH * self.fwhm)
        return (
            np.asarray(0.5 * (self.fwhm + np.asarray(self.spacing)))
            if self.shape == "slit"
            else np.full(self.wavelength.shape, float(np.max(np.abs(np.asarray(self.offset)))))
        )

    def on(self, grid: Floats, band: int | Ints) -> Floats:
        # Return responses on an even grid [nm], (point,) of one band or (band, point) of several.
        #
        # Each row times the grid step sums to 1.
        bands = np.atleast_1d(band)
        distance = grid - self.wavelength[bands, None]
        width = self.fwhm[bands, None]
        if self.shape == "gaussian":
            # tails are cut off: their products are denormal numbers, which are a hundred times slower
            tail = np.abs(distance) > _REACH * width
            response = np.where(tail, 0.0, np.exp(-0.5 * (distance / (GAUSSIAN_SIGMA * width)) ** 2))
        elif self.shape == "slit":
            pixel = np.asarray(self.spacing)[bands, None]
            response = np.clip(0.5 * (width + pixel) - np.abs(distance), 0.0, np.minimum(width, pixel))
        else:
            offset, table = np.asarray(self.offset), np.asarray(self.table)
            rows = zip(distance, table[bands], strict=True)
            response = np.stack([np.interp(distances, offset, row, 0.0, 0.0) for distances, row in rows])
        if self.slope is not None:
            response = response * np.exp(self.slope[bands, None] * distance)
        total = response.sum(axis=1, keepdims=True)
        # a response without a grid point inside stays zero
        total = np.where(total > 0, total, np.inf)
        response = response / (total * (grid[1] - grid[0]))
        return np.asarray(response if np.ndim(band) else response[0])


def band_spacing(wavelength: ArrayLike) -> Floats:
    """Return the distance between neighbouring bands at each band [nm], in any order of bands.

    Examples
    --------
    >>> band_spacing([400.0, 402.0, 405.0])
    array([2. , 2.5, 3. ])
    """
    wavelength = np.asarray(wavelength, np.float64)
    spacing, order = np.ones_like(wavelength), np.argsort(wavelength, kind="stable")
    if wavelength.size > 1:
        spacing[order] = np.gradient(wavelength[order])
    return spacing


def spectral_parts(wavelength: ArrayLike) -> list[slice]:
    """Return the parts of a spectral axis between detector joins, overlaps and gaps.

    A new part begins where wavelengths run back, and after a step of more than four times its neighbours.

    Examples
    --------
    >>> spectral_parts([400.0, 410.0, 420.0, 415.0, 425.0, 435.0, 535.0, 545.0])
    [slice(0, 3, None), slice(3, 6, None), slice(6, 8, None)]
    """
    steps = np.diff(np.asarray(wavelength, np.float64))
    forward = steps * (-1.0 if steps.size and np.median(steps) < 0 else 1.0)
    padded = np.pad(np.maximum(forward, 0.0), 1)
    is_join = (forward <= 0) | ((steps.size > 1) & (forward > 4.0 * np.maximum(padded[:-2], padded[2:])))
    edges = [0, *(np.flatnonzero(is_join) + 1).tolist(), steps.size + 1]
    return [slice(start, stop) for start, stop in itertools.pairwise(edges)]


@dataclass(frozen=True)
class Matching:
    # Operators from a spectrometer's channels to an imager's bands.
    #: (node, band, channel): weights on the spectrometer's channels; each row sums to 1, or is NaN where the
    #: spectrometer does not cover the band
    weights: Floats
    #: (node, band): root-mean-square distance of the two responses over that of the imager's [1]
    misfit: Floats
    #: (node, band): norm of a row: the noise of a matched value over that of one channel [1]
    noise_gain: Floats
    coverage: Floats  #: (node, band): part of the imager's response inside the spectrometer's range [1]

    @functools.cached_property
    def used(self) -> Ints:
        # Channels that any band weighs.
        return np.flatnonzero((np.nan_to_num(self.weights) != 0.0).any(axis=(0, 1)))


@functools.lru_cache(maxsize=8)
def matching_operator(
    spectrometer: Responses, imager: Responses, nodes: tuple[float, ...] = (0.0,)
) -> Matching:
    r"""Return the weights that combine a spectrometer's channels into an imager's bands.

    Cached: all flight lines of a camera share an operator.

    Parameters
    ----------
    spectrometer
        Responses of the spectrometer's channels.
    imager
        Responses of the imager's bands at its centre column.
    nodes
        Wavelength shifts [nm] of the operators, for the imager's smile.

    Raises
    ------
    SchemaError
        Widths differ so much that responses would need more samples than memory holds.

    Notes
    -----
    With :math:`s_j` the responses of the channels and :math:`r` the response of a band, all of unit area, the
    weights minimise

    .. math:: \int \Big(\sum_j w_j s_j - r\Big)^2 d\lambda + \epsilon\,\overline{\|s\|^2} \sum_j w_j^2,
              \qquad \sum_j w_j = 1 .

    A row is NaN where less than 99.9 % of the band's response lies inside the spectrometer's range, or where
    channels are missing over more than two widths inside it: nothing is extrapolated. The ridge
    :math:`\epsilon` is `RIDGE`.
    """
    shifts = np.array(nodes)
    order = np.argsort(spectrometer.wavelength, kind="stable")
    centres, reach = spectrometer.wavelength[order], spectrometer.reach()[order]
    step = min(spectrometer.fwhm.min(), imager.fwhm.min()) / STEPS_PER_FWHM
    shape = (shifts.size, imager.wavelength.size)
    weights = np.zeros((*shape, centres.size))
    misfit, noise_gain, coverage = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape)
    shifted_imagers = [imager.shifted(float(shift)) for shift in shifts]
    # one grid and one set of channels for all shifts of a band
    half_support = imager.reach() + np.ptp(shifts) / 2
    for band, centre in enumerate(imager.wavelength + (shifts.min() + shifts.max()) / 2):
        nearby = np.flatnonzero(np.abs(centres - centre) <= half_support[band] + 0.5 * reach)
        # detectors of a spectrometer differ in width: use the widths of the channels around the band
        widest = reach[nearby].max() if nearby.size else reach.max()
        steps = (2.0 * half_support[band] + 4.0 * widest) / step
        if steps > MAX_GRID_STEPS or steps * nearby.size > MAX_GRID_SAMPLES:
            fwhm = np.concatenate([spectrometer.fwhm, imager.fwhm])
            raise SchemaError(
                f"'fwhm' reaches from {fwhm.min():g} to {fwhm.max():g} nm, which cannot be matched",
                mend="check the widths and their units",
                code="fwhm-range",
            )
        grid = (
            np.arange(-half_support[band] - 2 * widest, half_support[band] + 2 * widest + step, step) + centre
        )
        responses = np.stack([bands.on(grid, band) for bands in shifted_imagers])
        coverage[:, band] = responses[:, (grid >= centres[0]) & (grid <= centres[-1])].sum(axis=1) * step
        widths = spectrometer.fwhm[order[nearby]] if nearby.size else spectrometer.fwhm
        # channels missing inside the band
        around = imager.fwhm[band] + np.ptp(shifts)
        first = max(int(np.searchsorted(centres, centre - around)) - 1, 0)
        gaps = np.diff(centres[first : int(np.searchsorted(centres, centre + around)) + 1])
        if gaps.size and gaps.max() > 2.0 * widths.max():
            coverage[:, band] = 0.0
        covered = coverage[:, band] >= 0.999
        weights[~covered, band] = np.nan
        if nearby.size == 0 or not covered.any():
            weights[:, band] = np.nan
            continue
        channels = spectrometer.on(grid, order[nearby])
        # ridge weights (node, channel) that combine channels into responses, each row of sum 1;
        # einsum: with busy cores, BLAS threads make products this small ten times slower
        gram = np.einsum("ig,jg->ij", channels, channels)
        gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / len(gram)
        products = np.einsum("ig,ng->in", channels, responses[covered])
        solved = np.linalg.solve(gram, np.column_stack([products, np.ones(len(gram))])).T
        rows, correction = solved[:-1], solved[-1]
        rows = rows + correction * ((1.0 - rows.sum(axis=1)) / correction.sum())[:, None]
        for node, row in zip(np.flatnonzero(covered), rows, strict=True):
            weights[node, band, order[nearby]] = row
        residual = np.einsum("ni,ig->ng", rows, channels) - responses[covered]
        misfit[covered, band] = np.sqrt((residual**2).sum(axis=1) / (responses[covered] ** 2).sum(axis=1))
        noise_gain[covered, band] = np.sqrt((rows**2).sum(axis=1))
    for array in (weights, misfit, noise_gain, coverage):
        array.flags.writeable = False
    return Matching(weights, misfit, noise_gain, coverage)


@functools.lru_cache(maxsize=64)
def misfit_through(
    declared: Responses, spectrometer: Responses, imager: Responses, nodes: tuple[float, ...]
) -> Floats:
    # Return the misfit (node, band) of an operator for spectrometer ``declared`` applied to another one [1].
    #
    # ``declared``: responses that define the operator; ``spectrometer``: true responses of the channels.
    # NaN where the operator is NaN. Cached, since a flight line is planned twice: to inspect it, and to write
    # it.
    matching = matching_operator(declared, imager, nodes)
    reach = spectrometer.reach()
    step = min(spectrometer.fwhm.min(), imager.fwhm.min()) / STEPS_PER_FWHM
    misfit = np.full(matching.misfit.shape, np.nan)
    for node, shift in enumerate(nodes):
        shifted_imager = imager.shifted(shift)
        for band in np.flatnonzero(np.isfinite(matching.misfit[node])):
            row = matching.weights[node, band]
            used_channels = np.flatnonzero(row)
            half_support = shifted_imager.reach()[band] + 2.0 * reach[used_channels].max()
            grid = np.arange(-half_support, half_support + step, step) + shifted_imager.wavelength[band]
            response = shifted_imager.on(grid, int(band))
            combined = row[used_channels] @ spectrometer.on(grid, used_channels)
            misfit[node, band] = np.sqrt(((combined - response) ** 2).sum() / (response**2).sum())
    misfit.flags.writeable = False
    return misfit
