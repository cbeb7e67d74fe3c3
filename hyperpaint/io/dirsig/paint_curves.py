"""Reflectance of a paint library for DIRSIG: ascending, without gaps, with the clear coat counted once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError, warn_user
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, Variable, require

from .dirsig_files import WAVELENGTH_DECIMALS


@dataclass(frozen=True)
class Coat:
    # Treatment of the light mirrored by the clear coat.
    mirror_reflection: str  # ``included`` in the library's reflectance, or ``excluded``
    is_declared: bool  # Whether the library has this attribute; else it is assumed
    # Specular fraction of DIRSIG's reflectance; ``library``: computed from ``specular_reflectance``
    specular: float | str

    @property
    def attrs(self) -> dict[str, str]:
        # Attributes that describe the treatment.
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
        """Return the specular fraction of a paint [1], rounded to the written decimals.

        ``centre``, ``mirror``: reflectance of body and coat (band,) [1]; NaN in bands that are not used.
        """
        if not isinstance(self.specular, str):
            return round(float(self.specular), 4)
        if mirror is None:
            return 0.0
        is_known = np.isfinite(mirror) & np.isfinite(centre)
        coat, body = (float(np.clip(spectrum[is_known], 0.0, 1.0).sum()) for spectrum in (mirror, centre))
        return min(round(coat / (coat + body), 4), 0.9999) if coat > 0.0 else 0.0


def coat_of(library: xr.Dataset, specular: float | str) -> Coat:
    """Return the treatment of a library's mirrored light.

    Raises `SchemaError`: The attribute ``mirror_reflection`` is neither ``included`` nor ``excluded``; the
    specular fraction is below 0, or 1 or more, or would count the coat twice; or ``specular`` is
    ``library`` without a ``specular_reflectance``.
    """
    problems = Problems("the specular term cannot be written", SchemaError)
    has_specular = _SPECULAR in library.variables
    declared = None
    try:
        declared = mirror_reflection(library)
    except SchemaError as error:
        problems.add_error("", error)
    # without a declaration the coat is taken as included, so that it cannot count twice
    mirror = declared or INCLUDED
    is_number = not isinstance(specular, str) and 0.0 <= specular < 1.0
    for is_wrong, found, expected, mend, option, code in (
        (
            specular != "library" and not is_number,
            f"specular={specular!r}",
            "0 to below 1, or 'library'",
            "",
            "",
            "value-out-of-range",
        ),
        (
            specular == "library" and not has_specular,
            "specular='library', but the library has no specular_reflectance (signature, band)",
            "",
            "",
            "",
            "variable-missing",
        ),
        (
            specular != 0.0 and mirror == INCLUDED and (specular != "library" or has_specular),
            f"specular={specular!r}, but the reflectance includes the mirrored light: the clear coat would "
            "count twice",
            "",
            "leave specular out, or pass body reflectance (remove_mirrored_sky) with "
            f"reflectance.attrs['mirror_reflection'] = {EXCLUDED!r}",
            "leave specular out, or give body reflectance (signatures --specular-sky)",
            "coat-counted-twice",
        ),
    ):
        if is_wrong:
            problems.add(found, expected=expected, mend=mend, option=option, code=code)
    problems.raise_if_any()
    return Coat(mirror, declared is not None, specular)


_SPECULAR = "specular_reflectance"
_ROWS = {
    **LIBRARY_VARIABLES,
    _SPECULAR: Variable(_SPECULAR, (SIGNATURE, BAND), "1", "float32", "Mirror reflectance"),
}

#: Variables of a library with the curves of a paint, by the choice of the caller.
CURVES = {"members": "member_reflectance", "quantiles": "reflectance_quantiles", "centre": "reflectance"}

GAPS = ("interpolate", "refuse")

#: Wavelengths that can be written [nm].
MIN_NM, MAX_NM = 1.0, 1e5

#: Maximum size of the curves in memory [byte].
_BLOCK_BYTES = 8 * 2**20


@dataclass(frozen=True)
class Choices:
    # Choices of the caller for the curves.
    curves: str  # Key of `CURVES`
    wavelength_range: tuple[float, float] | None  # Low and high end [nm]; None for the measured range
    extrapolate: bool  # Whether curves are constant beyond the measured range
    gaps: str  # Treatment of bands without values between others: one of `GAPS`
    max_curves: int | None = None  # Maximum number of curves of a paint; None for all


class Axis:
    """Bands of a library, in ascending order.

    Raises `SchemaError`: A wavelength is not finite or out of range, or two are equal as written.
    """

    def __init__(self, library: xr.Dataset) -> None:
        names = [name for name in ("wavelength", "good") if name in library.variables]
        arrays = require(library, names, "DIRSIG materials", LIBRARY_VARIABLES)
        wavelength = np.asarray(arrays["wavelength"].values, np.float64)
        is_finite = np.isfinite(wavelength).all() and wavelength.size
        if not (is_finite and wavelength.min() >= MIN_NM and wavelength.max() <= MAX_NM):
            raise SchemaError(
                "a wavelength is not finite, or out of range",
                expected=f"{MIN_NM:g} to {MAX_NM:g} nm",
                mend="drop the band",
                code="wavelength-range",
            )
        self.order = np.argsort(wavelength, kind="stable")
        self.wavelength = wavelength[self.order]
        steps = np.diff(wavelength)
        if not ((steps > 0).all() or (steps < 0).all()):
            msg = (
                "wavelengths of detectors overlap: bands are sorted, so that samples of both alternate; "
                "keep one detector per wavelength, as open_svc(overlap='trim') does"
            )
            warn_user(msg, "wavelength-unordered")
        micrometres = np.round(self.wavelength / 1000.0, WAVELENGTH_DECIMALS)
        if equal := np.flatnonzero(np.diff(micrometres) <= 0.0).tolist():
            examples = ", ".join(f"{self.wavelength[band]:.4f}" for band in equal[:8])
            raise SchemaError(
                f"two bands at {examples} nm",
                expected="one",
                mend="keep the band of one detector",
                code="wavelength-duplicate",
            )
        is_good = arrays["good"].values.astype(bool) if "good" in arrays else np.ones(len(micrometres), bool)
        self.good = is_good[self.order]


def blocks_of(library: xr.Dataset, choices: Choices) -> Iterator[tuple[slice, dict[str, Array]]]:
    """Yield a library's values in blocks of paints, so that memory stays bounded.

    Yields the slice of the block's paints; and ``centre`` (signature, band) and ``curves`` (signature, curve,
    band) [1], in the library's order of bands.
    """
    name = CURVES[choices.curves]
    names = [key for key in dict.fromkeys(["reflectance", name, _SPECULAR]) if key in library.variables]
    count = library.sizes[SIGNATURE]
    size = 4 * library[name].size // max(count, 1)
    step = max(1, _BLOCK_BYTES // max(size, 1))
    # blocks of complete chunks, so that every chunk is decoded once
    stored = library[name].chunksizes or library[name].encoding.get("preferred_chunks", {})
    chunk = max(1, int(np.ravel(stored.get(SIGNATURE, 1))[0]))
    step = chunk * max(1, step // chunk) if chunk * size <= 8 * _BLOCK_BYTES else step
    for start in range(0, count, step):
        paints = slice(start, min(start + step, count))
        arrays = require(library[names].isel({SIGNATURE: paints}).load(), names, "DIRSIG materials", _ROWS)
        blocks = {key: array.values for key, array in arrays.items()}
        curves = blocks[name] if blocks[name].ndim == 3 else blocks[name][:, np.newaxis]
        yield paints, {**blocks, "centre": blocks["reflectance"], "curves": curves}


def curves_of(
    axis: Axis, centre: Array, curves: Array, choices: Choices
) -> tuple[Array, Array, Array, dict[str, Any]]:
    """Return the curves of one paint, as they are written, and their items of its record.

    ``centre``, ``curves``: reflectance (band,) and (curve, band) in the library's order of bands; curves
    without a value are dropped. Returns ascending wavelengths (wavelength,) [nm], the centre (wavelength,)
    [1], the population (curve, wavelength) [1] with complete curves first, and items of the record: the
    range and the ``measured`` range [nm]; numbers of ``complete`` curves, of ``interpolated`` samples, of
    members ``left_out`` without a value at an end, of curves ``thinned`` above ``max_curves``; ``gaps`` [nm];
    ends ``extrapolated``; ``is_centre`` where no member has values at both ends, so that the
    centre is the only curve.

    Raises `SchemaError`: The paint has no values, has gaps although ``choices`` refuse them, or does not
    cover the wavelength range.
    """
    centre = np.where(axis.good, centre[axis.order].astype(np.float64), np.nan)
    curves = np.where(axis.good, curves[:, axis.order].astype(np.float64), np.nan)
    curves = curves[np.isfinite(curves).any(axis=1)]
    usable = np.flatnonzero(np.isfinite(centre))
    if usable.size < 2:
        raise SchemaError(
            "fewer than two bands have a value", mend="leave the paint out", code="value-missing"
        )
    if not len(curves):  # a paint without members
        curves = centre[np.newaxis]
    measured = (float(axis.wavelength[usable[0]]), float(axis.wavelength[usable[-1]]))
    low, high = choices.wavelength_range or measured
    below, above = bool(low < measured[0]), bool(high > measured[1])
    is_outside = low >= measured[1] or high <= measured[0]
    if is_outside or ((below or above) and not choices.extrapolate):
        wanted = f"{low:g} to {high:g} nm"
        advice = "narrow wavelength_range, or pass extrapolate=True for constant values beyond the ends"
        raise SchemaError(
            f"measured {measured[0]:g} to {measured[1]:g} nm{', outside ' * is_outside}{wanted * is_outside}",
            expected="" if is_outside else wanted,
            mend="" if is_outside else advice,
            code="wavelength-uncovered",
        )
    # usable bands within the range, and the next band beyond each end, so that the range is covered
    first = max(int(usable[0]), int(np.searchsorted(axis.wavelength, low, "right")) - 1)
    last = min(int(usable[-1]), int(np.searchsorted(axis.wavelength, high, "left")))
    bands = slice(first, last + 1)
    wavelength = axis.wavelength[bands]
    if np.median(centre[usable]) > 1.0:
        raise SchemaError(
            f"median reflectance {np.median(centre[usable]):g}",
            expected="0 to 1",
            mend="divide percent by 100",
            code="value-out-of-range",
        )
    curves = curves[:, bands]
    has_ends = np.isfinite(curves[:, [0, -1]]).all(axis=1)
    missing, centre_missing = ~np.isfinite(curves), ~np.isfinite(centre[bands])
    for subject, is_gap in (
        (f"{int(missing.any(axis=1).sum())} of {len(curves)} curves have", missing.any(axis=0)),
        ("the centre has", centre_missing),
    ):
        if choices.gaps == "refuse" and is_gap.any():
            gaps = wavelength[is_gap]
            examples = ", ".join(f"{nm:.1f}" for nm in gaps[:6]) + (", ..." if gaps.size > 6 else "")
            raise SchemaError(
                f"{subject} no value at {examples} nm, inside the range",
                mend="omit gaps= to interpolate, or pass a wavelength_range without them",
                code="value-missing",
            )
    centre = np.interp(wavelength, axis.wavelength[usable], centre[usable])
    if has_ends.any():
        curves, missing = curves[has_ends], missing[has_ends]
        order = np.argsort(missing.any(axis=1), kind="stable")
        curves, missing = curves[order], missing[order]
        for row, gaps in zip(curves, missing, strict=True):
            row[gaps] = np.interp(wavelength[gaps], wavelength[~gaps], row[~gaps])
        rows = thinned_rows(curves, np.asarray(missing.any(axis=1)), choices.max_curves)
    else:
        curves, missing, rows = centre[np.newaxis], centre_missing[np.newaxis], np.zeros(1, np.int64)
    thinned, curves, missing = len(curves) - len(rows), curves[rows], missing[rows]
    gap_nm = [round(float(nm), 2) for nm in wavelength[missing.any(axis=0)]]
    padding = (int(below), int(above))
    wavelength = np.concatenate([[low][: padding[0]], wavelength, [high][: padding[1]]])
    record = {
        "wavelength": [float(wavelength[0]), float(wavelength[-1])],
        "measured": list(measured),
        "bands": len(wavelength),
        "curves": len(curves),
        "complete": int((~missing.any(axis=1)).sum()),
        "gaps": gap_nm,
        "is_centre": not has_ends.any(),
        "clipped": 0,
        "centre_clipped": 0,
        "interpolated": int(missing.sum()),
        "centre_interpolated": int(centre_missing.sum()),
        "left_out": int((~has_ends).sum()),
        "thinned": thinned,
        "extrapolated": " and ".join(["below"] * below + ["above"] * above),
    }
    return wavelength, np.pad(centre, padding, "edge"), np.pad(curves, ((0, 0), padding), "edge"), record


def thinned_rows(curves: Array, is_filled: Array, max_curves: int | None) -> Array:
    """Return the rows of a population (curve, wavelength) that are written, at most ``max_curves``.

    They have equal steps of rank in mean reflectance, so that the distribution of brightness is kept. Curves
    with interpolated samples (``is_filled``) are only used if there are too few complete curves.

    Examples
    --------
    >>> population = np.array([[0.3], [0.1], [0.2], [0.5], [0.4]])
    >>> thinned_rows(population, np.zeros(5, bool), 3)
    array([1, 0, 3])
    """
    if max_curves is None or len(curves) <= max_curves:
        return np.arange(len(curves))
    complete = np.flatnonzero(~is_filled)
    rows = complete if complete.size >= max_curves else np.arange(len(curves))
    ranked = rows[np.argsort(curves[rows].mean(axis=1), kind="stable")]
    # the middle curve of every one of `max_curves` classes with the same number of curves
    chosen = ranked[np.floor((np.arange(max_curves) + 0.5) * len(ranked) / max_curves).astype(np.int64)]
    return chosen[np.argsort(is_filled[chosen], kind="stable")]
