"""Reflectance of a paint library as DIRSIG takes it: ascending, without gaps, the clear coat counted once."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import PaintError, PaintWarning, Problems, SchemaError
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, Variable, require

from .emissivity_files import WAVELENGTH_DECIMALS


@dataclass(frozen=True)
class Coat:
    """Treatment of the light mirrored by the clear coat."""

    mirror_reflection: str  # Whether the library's reflectance holds it: ``included`` or ``excluded``
    is_declared: bool  # Whether the library declares it
    # Specular fraction of DIRSIG's reflectance; ``library`` takes it from ``specular_reflectance``
    specular: float | str

    @property
    def attrs(self) -> dict[str, str]:
        """Attributes on the treatment."""
        source = "stated by the library" if self.is_declared else "not stated by the library, assumed"
        term = (
            "none: reflectance is diffuse"
            if self.specular == 0.0
            else f"SPECULAR_FRACTION of {self.specular}; emissivity = 1 - reflectance / (1 - fraction)"
        )
        return {
            "mirror_reflection": self.mirror_reflection,
            "mirror_reflection_source": source,
            "specular_term": term,
        }

    def fraction(self, centre: npt.NDArray[Any], mirror: npt.NDArray[Any] | None) -> float:
        """Return the specular fraction of a paint [1], rounded as it is written.

        ``centre``, ``mirror``: reflectance of body and coat (band,) [1]; NaN where a band is not to be used.
        """
        if not isinstance(self.specular, str):
            return round(float(self.specular), 4)
        if mirror is None:
            return 0.0
        is_known = np.isfinite(mirror) & np.isfinite(centre)
        part, body = (float(np.clip(spectrum[is_known], 0.0, 1.0).sum()) for spectrum in (mirror, centre))
        return min(round(part / (part + body), 4), 0.9999) if part > 0.0 else 0.0


def coat_of(library: xr.Dataset, specular: float | str) -> Coat:
    """Return the treatment of a library's mirrored light.

    Raises `SchemaError`: The attribute ``mirror_reflection`` is neither of both; the specular fraction is not
    from 0 to below 1, or would count the coat twice, or is to be taken from a library that has none.
    """
    problems = Problems("the specular term cannot be written", SchemaError)
    has_specular = _SPECULAR in library.variables
    declared = None
    try:
        declared = mirror_reflection(library)
    except SchemaError as error:
        problems.add_error("", error)
    # the safe guess for measured reflectance: a coat counted twice would go unnoticed
    mirror = declared or INCLUDED
    if specular != "library" and (isinstance(specular, str) or not 0.0 <= specular < 1.0):
        problems.add(
            f"specular={specular!r}", expected="0 to below 1, or 'library'", code="value-out-of-range"
        )
    if specular == "library" and not has_specular:
        problems.add(
            "specular='library', but the library has no specular_reflectance (signature, band)",
            code="variable-missing",
        )
    elif specular != 0.0 and mirror == INCLUDED:
        problems.add(
            (
                f"specular={specular!r}, but the reflectance includes the mirrored light: the clear "
                "coat would count twice"
            ),
            mend=(
                "leave specular out, or pass body reflectance (remove_mirrored_sky) with "
                f"reflectance.attrs['mirror_reflection'] = {EXCLUDED!r}"
            ),
            option="leave specular out, or give body reflectance (signatures --specular-sky)",
            code="coat-counted-twice",
        )
    problems.raise_if_any()
    return Coat(mirror, declared is not None, specular)


_SPECULAR = "specular_reflectance"
_ROWS = {
    **LIBRARY_VARIABLES,
    _SPECULAR: Variable(_SPECULAR, (SIGNATURE, BAND), "1", "float32", "Mirror reflectance"),
}

#: Which variable of a library holds the curves of a paint.
CURVES = {"members": "member_reflectance", "quantiles": "reflectance_quantiles", "centre": "reflectance"}

GAPS = ("interpolate", "refuse")

#: Wavelengths that can be written [nm].
MIN_NM, MAX_NM = 1.0, 1e5

#: Bytes of the curves held at a time.
_BLOCK_BYTES = 8 * 2**20


class PaintProblemError(PaintError):
    """One paint cannot be written."""


@dataclass(frozen=True)
class Choices:
    """Choices of the caller for the curves."""

    curves: str  # A key of `CURVES`
    wavelength_range: tuple[float, float] | None  # Low and high end [nm]; None for all that was measured
    extrapolate: bool  # Whether curves are held constant beyond the measured range
    gaps: str  # Treatment of bands without values between others: one of `GAPS`
    max_curves: int | None = None  # Curves of a paint at the most; None for all


@dataclass(frozen=True, eq=False)
class PaintCurves:
    """Curves of one paint as written."""

    wavelength: Array  # Ascending (wavelength,) [nm]
    centre: Array  # Reflectance (wavelength,) [1]
    curves: Array  # Reflectance of the population (curve, wavelength) [1], complete ones first
    complete: int  # Curves of which no sample was filled in
    gaps: Array  # Where samples of curves were filled in (wavelength,) [nm]
    measured: tuple[float, float]  # First and last measured wavelength [nm]
    extrapolated: str  # Where a sample was added beyond that: ``below``, ``above``, both, or empty
    # interpolated, centre_interpolated: Samples of the curves, and of the centre, that were filled in
    # between others
    interpolated: int
    centre_interpolated: int
    left_out: int  # Members without values at the ends, which are not written
    is_centre: bool  # Whether no member reaches both ends, so that the centre is written instead
    thinned: int = 0  # Curves left out above `max_curves`


class Axis:
    """The bands of a library, in ascending order.

    Raises `SchemaError`: A wavelength is not known or not above 0, or two are the same.
    """

    def __init__(self, library: xr.Dataset) -> None:
        names = [name for name in ("wavelength", "good") if name in library.variables]
        arrays = require(library, names, "DIRSIG materials", LIBRARY_VARIABLES)
        wavelength = np.asarray(arrays["wavelength"].values, np.float64)
        is_finite = np.isfinite(wavelength).all() and wavelength.size
        if not (is_finite and wavelength.min() >= MIN_NM and wavelength.max() <= MAX_NM):
            raise SchemaError(
                "a wavelength is unknown or out of range",
                expected=f"{MIN_NM:g} to {MAX_NM:g} nm",
                mend="drop the band",
                code="wavelength-range",
            )
        self.order = np.argsort(wavelength, kind="stable")
        self.wavelength = wavelength[self.order]
        steps = np.diff(wavelength)
        if not ((steps > 0).all() or (steps < 0).all()):
            msg = (
                "wavelengths fall at the joins of detectors: bands are sorted, so that curves of overlapping "
                "detectors alternate; keep one detector a wavelength, as open_svc(overlap='trim') does"
            )
            warnings.warn(PaintWarning(msg, code="wavelength-unordered"), stacklevel=3)
        written = np.round(self.wavelength / 1000.0, WAVELENGTH_DECIMALS)
        if same := np.flatnonzero(np.diff(written) <= 0.0).tolist():
            shown = ", ".join(f"{self.wavelength[band]:.4f}" for band in same[:8])
            raise SchemaError(
                f"two bands at {shown} nm",
                expected="one",
                mend="keep one detector there",
                code="wavelength-duplicate",
            )
        good = arrays["good"].values.astype(bool) if "good" in arrays else np.ones(len(written), bool)
        self.good = good[self.order]


def blocks_of(library: xr.Dataset, choices: Choices) -> Iterator[tuple[slice, dict[str, Array]]]:
    """Yield a library's values in blocks of paints, so that memory stays bounded.

    Yields the paints of the block; ``centre`` (signature, band) and ``curves`` (signature, curve, band) [1],
    in the library's own order of bands.
    """
    name = CURVES[choices.curves]
    names = [key for key in dict.fromkeys(["reflectance", name, _SPECULAR]) if key in library.variables]
    count = library.sizes[SIGNATURE]
    size = 4 * library[name].size // max(count, 1)
    step = max(1, _BLOCK_BYTES // max(size, 1))
    # a chunk is decoded as a whole: once is enough
    stored = library[name].chunksizes or library[name].encoding.get("preferred_chunks", {})
    chunk = max(1, int(np.ravel(stored.get(SIGNATURE, 1))[0]))
    step = chunk * max(1, step // chunk) if chunk * size <= 8 * _BLOCK_BYTES else step
    for start in range(0, count, step):
        paints = slice(start, min(start + step, count))
        arrays = require(library[names].isel({SIGNATURE: paints}).load(), names, "DIRSIG materials", _ROWS)
        blocks = {key: array.values for key, array in arrays.items()}
        curves = blocks[name] if blocks[name].ndim == 3 else blocks[name][:, np.newaxis]
        yield paints, {**blocks, "centre": blocks["reflectance"], "curves": curves}


def curves_of(axis: Axis, centre: Array, curves: Array, choices: Choices) -> PaintCurves:
    """Return the curves of one paint as written.

    ``axis``: the bands; ``centre``, ``curves``: reflectance (band,) and (curve, band) in the library's order;
    curves of NaN alone are dropped; ``choices``: of the caller.

    Raises `PaintProblemError`: It has no values, holes that nobody asked to fill, or does not reach as far as
    was asked.
    """
    centre = np.where(axis.good, centre[axis.order].astype(np.float64), np.nan)
    curves = np.where(axis.good, curves[:, axis.order].astype(np.float64), np.nan)
    curves = curves[np.isfinite(curves).any(axis=1)]
    usable = np.flatnonzero(np.isfinite(centre))
    if usable.size < 2:
        raise PaintProblemError(
            "fewer than two bands have a value", mend="leave the paint out", code="value-missing"
        )
    if not len(curves):  # a paint without members
        curves = centre[np.newaxis]
    measured = (float(axis.wavelength[usable[0]]), float(axis.wavelength[usable[-1]]))
    below, above = _beyond(measured, choices)
    chosen = _inside(axis.wavelength, usable, choices.wavelength_range)
    wavelength = axis.wavelength[chosen]
    if np.median(centre[usable]) > 1.0:
        raise PaintProblemError(
            f"median reflectance {np.median(centre[usable]):g}",
            expected="0 to 1",
            mend="divide percent by 100",
            code="value-out-of-range",
        )
    curves = curves[:, chosen]
    whole = np.isfinite(curves[:, [0, -1]]).all(axis=1)
    missing, holes = ~np.isfinite(curves), ~np.isfinite(centre[chosen])
    if choices.gaps == "refuse":
        if missing.any():
            which = f"{int(missing.any(axis=1).sum())} of {len(curves)} curves have"
            raise _hole_error(which, wavelength[missing.any(axis=0)])
        if holes.any():
            raise _hole_error("the centre has", wavelength[holes])
    centre = np.interp(wavelength, axis.wavelength[usable], centre[usable])
    if whole.any():
        curves, missing = curves[whole], missing[whole]
        order = np.argsort(missing.any(axis=1), kind="stable")
        curves, missing = curves[order], missing[order]
        for row, gaps in zip(curves, missing, strict=True):
            row[gaps] = np.interp(wavelength[gaps], wavelength[~gaps], row[~gaps])
        rows = thinned_rows(curves, np.asarray(missing.any(axis=1)), choices.max_curves)
    else:
        curves, missing, rows = centre[np.newaxis], holes[np.newaxis], np.zeros(1, np.int64)
    thinned, curves, missing = len(curves) - len(rows), curves[rows], missing[rows]
    low, high = choices.wavelength_range or measured
    before, after = int(below), int(above)
    extrapolated = " and ".join(name for name, is_so in (("below", below), ("above", above)) if is_so)
    return PaintCurves(
        wavelength=np.concatenate([[low][:before], wavelength, [high][:after]]),
        centre=np.pad(centre, (before, after), "edge"),
        curves=np.pad(curves, ((0, 0), (before, after)), "edge"),
        complete=int((~missing.any(axis=1)).sum()),
        gaps=wavelength[missing.any(axis=0)],
        measured=measured,
        extrapolated=extrapolated,
        interpolated=int(missing.sum()),
        centre_interpolated=int(holes.sum()),
        left_out=int((~whole).sum()),
        is_centre=not whole.any(),
        thinned=thinned,
    )


def thinned_rows(curves: Array, is_filled: Array, most: int | None) -> Array:
    """Return the rows of a population (curve, wavelength) to write: at most ``most``, in order.

    They stand at even ranks of the curves' means, so that brightness keeps its distribution; complete curves
    alone are taken where they suffice.

    Examples
    --------
    >>> population = np.array([[0.3], [0.1], [0.2], [0.5], [0.4]])
    >>> thinned_rows(population, np.zeros(5, bool), 3)
    array([1, 0, 3])
    """
    if most is None or len(curves) <= most:
        return np.arange(len(curves))
    rows = np.flatnonzero(~is_filled) if np.count_nonzero(~is_filled) >= most else np.arange(len(curves))
    ranked = rows[np.argsort(curves[rows].mean(axis=1), kind="stable")]
    # the middles of equal parts: the ends of a distribution are not worth more than its inside
    chosen = ranked[np.floor((np.arange(most) + 0.5) * len(ranked) / most).astype(np.int64)]
    return chosen[np.argsort(is_filled[chosen], kind="stable")]


def _beyond(measured: tuple[float, float], choices: Choices) -> tuple[bool, bool]:
    if choices.wavelength_range is None:
        return False, False
    low, high = choices.wavelength_range
    below, above = low < measured[0], high > measured[1]
    if low >= measured[1] or high <= measured[0]:
        raise PaintProblemError(
            f"measured {measured[0]:g} to {measured[1]:g} nm, nothing of {low:g} to {high:g} nm",
            code="wavelength-uncovered",
        )
    if (below or above) and not choices.extrapolate:
        raise PaintProblemError(
            f"measured {measured[0]:g} to {measured[1]:g} nm",
            expected=f"{low:g} to {high:g} nm",
            mend="narrow wavelength_range, or pass extrapolate=True to hold the ends constant",
            code="wavelength-uncovered",
        )
    return below, above


def _inside(wavelength: Array, usable: Array, wanted: tuple[float, float] | None) -> slice:
    # The bands of a range and the next ones outside, so that the range is covered.
    first, last = int(usable[0]), int(usable[-1])
    if wanted is not None:
        low = int(np.searchsorted(wavelength, wanted[0], "right")) - 1
        first, last = max(first, low), min(last, int(np.searchsorted(wavelength, wanted[1], "left")))
    return slice(first, last + 1)


def _hole_error(subject: str, at: Array) -> PaintProblemError:
    shown = ", ".join(f"{nm:.1f}" for nm in at[:6]) + (", ..." if at.size > 6 else "")
    return PaintProblemError(
        f"{subject} no value at {shown} nm, inside the range",
        mend="omit gaps= to fill them in, or pass a wavelength_range without them",
        code="value-missing",
    )
