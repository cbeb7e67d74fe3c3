"""One axis of wavelengths out of those of several detectors, and how wide their channels are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError

__all__ = ["Axis", "channel_widths", "join_detectors"]


_MOST_DETECTORS = 8

_WIDTHS: dict[str, tuple[float, ...]] = {"asd": (3.0, 10.0, 10.0), "svc": (3.5, 9.5, 6.5)}
"""Widths of the channels of three detectors, as the makers of FieldSpec 3/4 and HR-1024i tell them [nm]."""
_NAMES = {"asd": ("asd", "fieldspec", "handheld"), "svc": ("svc", "spectra vista", "hr-1024", "hr-768")}
_EDGES = (1000.0, 1900.0)
"""Where the detectors end, of a file that does not tell them apart [nm]."""


@dataclass(frozen=True, eq=False)
class Axis:
    """Which channels are used, in the order of wavelength.

    Attributes
    ----------
    order : (channel,)
        Positions in the file.
    detector : (channel,)
        Number of the detector that each is of.
    joins
        Where one detector takes over from the other [nm].
    """

    order: npt.NDArray[np.intp]
    detector: npt.NDArray[np.intp]
    joins: tuple[float, ...]


def join_detectors(wavelength: Floats) -> Axis:
    """Return which channels make one increasing axis of wavelengths.

    Where wavelengths fall, another detector begins. Of two that overlap, each serves to the middle of the
    overlap: no sample is averaged with one of the other detector, whose scale and resolution differ.

    Parameters
    ----------
    wavelength : (channel,)
        In the order of the file [nm]; a file that descends as a whole is turned round.

    Raises
    ------
    SchemaError
        Wavelengths are not finite, or in an order that detectors do not have.

    Examples
    --------
    >>> axis = join_detectors(np.array([980.0, 990.0, 1000.0, 970.0, 988.0, 1006.0]))
    >>> axis.order.tolist(), axis.joins
    ([0, 4, 5], (985.0,))
    """
    if not (wavelength.size and np.isfinite(wavelength).all()):
        raise SchemaError("wavelengths must be finite, and at least one [nm]")
    order = np.arange(wavelength.size)
    if (np.diff(wavelength) < 0).sum() > wavelength.size // 2:
        order = order[::-1]
    begins = np.flatnonzero(np.diff(wavelength[order]) <= 0) + 1
    detectors = np.split(order, begins)
    if len(detectors) > _MOST_DETECTORS:
        raise SchemaError(
            f"wavelengths fall {len(begins)} times, expected an axis that increases but for joins of "
            "detectors; sort the spectrum"
        )
    channels, number, joins = detectors[0], np.zeros(detectors[0].size, np.intp), []
    for index, following in enumerate(detectors[1:], 1):
        middle = float(0.5 * (wavelength[channels[-1]] + wavelength[following[0]]))
        before = wavelength[channels] <= middle
        after = following[wavelength[following] > middle]
        if not (before.any() and after.size):
            raise SchemaError(
                f"one detector's wavelengths lie within another's near {middle:g} nm; open them apart"
            )
        channels = np.concatenate([channels[before], after])
        number = np.concatenate([number[before], np.full(after.size, index)])
        joins.append(middle)
    return Axis(channels, number, tuple(joins))


def channel_widths(wavelength: Floats, detector: npt.NDArray[Any], instrument: str) -> tuple[Floats, str]:
    """Return how wide channels are, where the data do not say, and what that was taken from.

    Parameters
    ----------
    wavelength, detector : (channel,)
        Increasing wavelengths [nm], and the detector that each is of.
    instrument
        Its name, as the data tell it.

    Returns
    -------
    fwhm : (channel,)
        Full widths at half maximum [nm].
    source
        What they were taken from, for a reader of the result.
    """
    lowered = instrument.lower()
    for kind, names in _NAMES.items():
        if any(name in lowered for name in names):
            told_apart = detector.max() > 0 and wavelength[0] < _EDGES[0]
            part = detector if told_apart else np.searchsorted(_EDGES, wavelength, "right")
            widths = np.array(_WIDTHS[kind])[np.minimum(part, len(_EDGES))]
            return widths, f"widths of channels as usual for {kind.upper()}"
    if wavelength.size < 2:
        return np.ones(wavelength.size), "widths of channels assumed, 1 nm"
    spacing = np.gradient(wavelength)
    return 2.0 * spacing, "widths of channels assumed, twice their distance"
