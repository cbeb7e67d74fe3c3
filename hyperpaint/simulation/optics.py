"""Optics and spectrograph between a scene and its detector: blur, keystone, stray light.

The fore optics blur the scene across and along the track, equally in all bands; behind the slit the
spectrograph displaces the image of a band along the slit (keystone) and scatters light into other bands. With
the integrals I = INT L R0 s d lambda of the scene, without element factors,

    I'[b, y, x] = SUM_ij k_ij I[b, y - i, x - j - keystone_b],    I'' = (1 + D) I',

where k has unit sum, so that no light is lost. The scene is constant within a column: an image displaced by a
fraction f of a column is f of one neighbour and 1 - f of the other, and its centre of mass moves by f. Beyond
its outer lines and columns the scene is mirrored. The smile changes so little between columns that the order
of blur and response does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.facts import declared, fact, is_number

_SIGMA_PER_FWHM = 1.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))
_TAIL = 1e-9  # minimum weight of a neighbour in a point spread
_RANK = (
    1e-12  # minimum singular value of a kernel, relative to the largest; smaller values are rounding errors
)
#: Decay length of scattered light [nm], and its share; the rest is equal in all bands.
_WINGS = (60.0, 0.6)
_MAX_FWHM_PIXELS = 50.0  # maximum width of a point spread
_MAX_TAPS = 101  # maximum rows or columns of a kernel


def _is_kernel(value: Any) -> bool:
    try:
        rows = [list(row) for row in value]
    except TypeError:
        return False
    width = len(rows[0]) if rows else 0
    has_odd_size = len(rows) % 2 == width % 2 == 1 and max(len(rows), width) <= _MAX_TAPS
    is_valid = has_odd_size and all(
        len(row) == width and all(is_number(x) and x >= 0 for x in row) for row in rows
    )
    return is_valid and sum(map(sum, rows)) > 0


@declared
@dataclass(frozen=True, kw_only=True)
class OpticsSettings:
    """Imperfections of a camera's optics and electronics, all off by default.

    Examples
    --------
    >>> OpticsSettings(psf_across_columns=1.5, keystone_columns=0.3).stray_light
    0.0
    """

    psf_across_columns: float = fact(
        0.0,
        "full width at half maximum of a Gaussian blur across the track [columns]; 0 for no blur; the "
        "variance is exact also for widths below a pixel",
        least=0.0,
        most=_MAX_FWHM_PIXELS,
    )
    psf_along_lines: float = fact(
        0.0,
        "full width at half maximum of a Gaussian blur along the track [lines]; 0 for no blur",
        least=0.0,
        most=_MAX_FWHM_PIXELS,
    )
    psf_kernel: Sequence[Sequence[float]] | None = fact(
        None,
        "weights of a blur that replaces the Gaussian blur, one row per line; they are divided by their sum; "
        "a weight right of the middle column moves light to the right, a weight after the middle row to "
        "later lines",
        kind="own",
        accepts=_is_kernel,
        phrase="rows of equally many numbers from 0 on, rows and columns odd and at most "
        f"{_MAX_TAPS}, with a sum above 0",
    )
    keystone_columns: float = fact(
        0.0,
        "displacement of the image of the last band to the right [columns]; the first band is displaced "
        "equally to the left, bands between them in proportion",
        least=-20.0,
        most=20.0,
    )
    stray_light: float = fact(
        0.0,
        "share of the light of a band that is scattered into all bands",
        least=0.0,
        most=0.5,
    )
    pedestal: float = fact(
        0.0,
        "offset of the counts of every frame, in flight and in the lab, that the dark does not contain",
        unit="count",
        least=-1000.0,
        most=30_000.0,
    )
    masked_columns: int = fact(
        0,
        "number of columns at each edge of the detector that receive no light; their gain is NaN, and their "
        "counts minus dark are the pedestal",
        least=0,
        most=10_000,
    )


def point_spread(fwhm: float) -> Floats:
    """Return an odd number of weights of a Gaussian blur, with unit sum.

    Parameters
    ----------
    fwhm
        Full width at half maximum [pixels].

    Notes
    -----
    The discrete analogue of a Gaussian, w_n = exp(-t) I_n(t) with the modified Bessel function I_n [1]_, has
    exactly the variance t = sigma^2; samples of a Gaussian narrower than a pixel have a smaller variance.

    References
    ----------
    .. [1] T. Lindeberg, "Scale-space for discrete signals", IEEE Trans. PAMI 12 (1990) 234-254,
       https://doi.org/10.1109/34.49051

    Examples
    --------
    >>> weights = point_spread(1.0)
    >>> place = np.arange(len(weights)) - len(weights) // 2
    >>> print(f"{weights.sum():.6f} {(weights * place**2).sum() * 8 * np.log(2):.6f}")
    1.000000 1.000000
    """
    from scipy.special import ive

    variance = (_SIGMA_PER_FWHM * fwhm) ** 2
    right_side = np.asarray(ive(np.arange(int(np.ceil(8.0 * _SIGMA_PER_FWHM * fwhm + 8.0)) + 1), variance))
    right_side = right_side[: int(np.flatnonzero(right_side > _TAIL).max()) + 1]
    weights = np.concatenate([right_side[:0:-1], right_side])
    return np.asarray(weights / weights.sum())


def keystone(bands: int, columns: float) -> Floats:
    """Return the displacement of the image of every band to the right, shape (band,) [columns].

    Examples
    --------
    >>> keystone(5, 0.4)
    array([-0.4, -0.2,  0. ,  0.2,  0.4])
    """
    return np.asarray(columns * np.linspace(-1.0, 1.0, bands))


def stray_light_wings(wavelength: Floats, share: float) -> Floats:
    """Return stray counts of a band per count of a source band, shape (band, source_band).

    Each column sums to ``share``: a part decreases with the distance in wavelength, the rest is equal in all
    bands.

    Examples
    --------
    >>> stray_light_wings(np.array([400.0, 700.0, 1000.0]), 0.02).sum(axis=0).round(6)
    array([0.02, 0.02, 0.02])
    """
    decay_nm, peaked_share = _WINGS
    wing = np.exp(-np.abs(wavelength[:, None] - wavelength) / decay_nm)
    wing = peaked_share * wing / wing.sum(axis=0) + (1.0 - peaked_share) / len(wavelength)
    return np.asarray(share * wing)


# A separable term of a point spread: weights of lines (line,), and of columns in every band (band, column).
class _Term(NamedTuple):
    along: Floats
    across: Floats


class Optics:
    """Blur, keystone and stray light of a camera; `image` applies them to a scene.

    Parameters
    ----------
    settings
        Blur, keystone and stray light.
    wavelength
        Centres of the bands, shape (band,) [nm].

    Attributes
    ----------
    reach
        Number of lines before and behind that contribute to a line.
    keystone
        Displacement of the bands' images, shape (band,) [columns].
    has_stray_light, stray_matrix
        Whether there is stray light, and its `stray_light_wings`.

    Examples
    --------
    >>> optics = Optics(OpticsSettings(keystone_columns=0.25), np.array([400.0, 1000.0]))
    >>> optics.image([np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])])
    array([[0.25, 0.75, 0.  ],
           [0.  , 0.75, 0.25]])
    """

    def __init__(self, settings: OpticsSettings, wavelength: Floats) -> None:
        self.keystone = keystone(len(wavelength), settings.keystone_columns)
        self.stray_matrix = stray_light_wings(wavelength, settings.stray_light)
        self.has_stray_light = settings.stray_light > 0
        if settings.psf_kernel is None:
            pairs = [(point_spread(settings.psf_along_lines), point_spread(settings.psf_across_columns))]
        else:
            pairs = _separable_terms(np.asarray(settings.psf_kernel, np.float64))
        self._terms = [_Term(along, _displaced(across, self.keystone)) for along, across in pairs]
        self.reach = len(pairs[0][0]) // 2

    @classmethod
    def of(cls, settings: OpticsSettings, wavelength: Floats) -> Optics | None:
        # optics with these settings, or None if all effects are off
        blurs = settings.psf_across_columns or settings.psf_along_lines or settings.psf_kernel is not None
        is_on = blurs or settings.keystone_columns or settings.stray_light
        return cls(settings, wavelength) if is_on else None

    def image(self, window: Sequence[Floats]) -> Floats:
        """Return the signal of the elements of a line, shape (band, column).

        Parameters
        ----------
        window
            ``2 * reach + 1`` lines around the line, each (band, column), without element factors.
        """
        total = np.zeros(window[0].shape)
        for along, across in self._terms:
            line = np.zeros_like(total)
            # a convolution: weights are applied in reversed order
            for weight, row in zip(along[::-1].tolist(), window, strict=True):
                line += weight * row
            total += _convolved(line, across)
        if self.has_stray_light:
            total += self.stray_matrix @ total
        return total

    def displaced(self, profile: Floats) -> Floats:
        # profile along the slit (column,) displaced by keystone, shape (band, column)
        return _convolved(np.broadcast_to(profile, (len(self.keystone), len(profile))),
                          _displaced(np.ones(1), self.keystone))  # fmt: skip

    def rows_of(self, line: int, lines: int) -> list[int]:
        """Return the line numbers of the window of `image`, mirrored at the first and last of ``lines``.

        Examples
        --------
        >>> Optics(OpticsSettings(psf_kernel=[[1], [1], [1]]), np.array([400.0, 500.0])).rows_of(0, 4)
        [0, 0, 1]
        """
        numbers = np.arange(line - self.reach, line + self.reach + 1) % (2 * lines)
        return [int(row) for row in np.minimum(numbers, 2 * lines - 1 - numbers)]


def _separable_terms(kernel: Floats) -> list[tuple[Floats, Floats]]:
    # write a kernel (line, column) as a sum of products of weights along and across the track
    along, singular_values, across = np.linalg.svd(kernel / kernel.sum(), full_matrices=False)
    rank = int(np.count_nonzero(singular_values > _RANK * singular_values[0]))
    return [(along[:, k] * singular_values[k], across[k]) for k in range(rank)]


def _displaced(across: Floats, shift: Floats) -> Floats:
    # weights (column,) displaced by the shifts of the bands, shape (band, column), odd number of columns
    extra = int(np.ceil(np.abs(shift).max()))
    whole_columns = np.floor(shift).astype(int)
    weights = np.zeros((len(shift), len(across) + 2 * extra))
    places = zip((whole_columns + extra).tolist(), (shift - whole_columns).tolist(), strict=True)
    for band, (start, fraction) in enumerate(places):
        weights[band, start : start + len(across)] += (1.0 - fraction) * across
        if fraction:
            weights[band, start + 1 : start + 1 + len(across)] += fraction * across
    return weights


def _convolved(line: Floats, weights: Floats) -> Floats:
    # convolve ``line`` with ``weights``, both (band, column), along the columns
    reach, columns = weights.shape[1] // 2, line.shape[1]
    padded = np.pad(line, ((0, 0), (reach, reach)), mode="symmetric") if reach else line
    result = np.zeros(line.shape)
    for tap in range(weights.shape[1]):
        tap_weights = weights[:, tap, None]
        if tap_weights.any():
            start = 2 * reach - tap
            result += tap_weights * padded[:, start : start + columns]
    return result
