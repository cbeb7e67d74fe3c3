"""Reflectance of a paint library for DIRSIG: ascending, without gaps, with the clear coat counted once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problem, Problems, SchemaError, warn_user
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, Variable, require

from .dirsig_files import WAVELENGTH_DECIMALS

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


class PaintCurves:
    # Curves of the paints of a library as they are written, and the treatment of the light that the clear
    # coat mirrors.
    # specular: specular fraction of DIRSIG's reflectance; ``library`` to compute it from
    # ``specular_reflectance``. curves: key of `CURVES`. wavelength_range: low and high end [nm], None for the
    # measured range. extrapolate: whether curves are constant beyond the measured range. gaps: treatment of
    # bands without values between others, one of `GAPS`. max_curves: maximum number of curves of a paint,
    # None for all.
    # Raises `SchemaError`: The attribute ``mirror_reflection`` is neither ``included`` nor ``excluded``; the
    # specular fraction is below 0, or 1 or more, or would count the coat twice; or ``specular`` is
    # ``library`` without a ``specular_reflectance``. A wavelength is not finite or out of range, or two are
    # equal as written.

    def __init__(
        self,
        library: xr.Dataset,
        specular: float | str,
        *,
        curves: str = "centre",
        wavelength_range: tuple[float, float] | None = None,
        extrapolate: bool = False,
        gaps: str | None = None,
        max_curves: int | None = None,
    ) -> None:
        self.library, self.specular, self.curves = library, specular, curves
        self.wavelength_range, self.extrapolate = wavelength_range, extrapolate
        self.gaps, self.max_curves = gaps or GAPS[0], max_curves
        problems = Problems("the specular term cannot be written", SchemaError)
        has_specular = _SPECULAR in library.variables
        declared = None
        try:
            declared = mirror_reflection(library)
        except SchemaError as error:
            problems.add_error("", error)
        # without a declaration the coat is taken as included, so that it cannot count twice
        self.mirror_reflection = mirror = declared or INCLUDED
        is_number = not isinstance(specular, str) and 0.0 <= specular < 1.0
        problems.extend(
            Problem(found, expected=expected, mend=mend, option=option, code=code)
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
                    f"specular={specular!r}, but the reflectance includes the mirrored light: the clear coat "
                    "would count twice",
                    "",
                    "leave specular out, or pass body reflectance (remove_mirrored_sky) with "
                    f"reflectance.attrs['mirror_reflection'] = {EXCLUDED!r}",
                    "leave specular out, or give body reflectance (signatures --specular-sky)",
                    "coat-counted-twice",
                ),
            )
            if is_wrong
        )
        problems.raise_if_any()
        term = f"SPECULAR_FRACTION of {specular}; emissivity = 1 - reflectance / (1 - fraction)"
        self.attrs = {
            "mirror_reflection": mirror,
            "mirror_reflection_source": "stated by the library"
            if declared
            else "not stated by the library, assumed",
            "specular_term": "none: reflectance is diffuse" if specular == 0.0 else term,
        }
        # bands in ascending order
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

    def blocks(self) -> Iterator[tuple[slice, dict[str, Array]]]:
        # Yield the values of the library in blocks of paints, so that memory stays bounded: the slice of the
        # paints; and ``centre`` (signature, band) and ``curves`` (signature, curve, band) [1], in the
        # library's order of bands.
        library, name = self.library, CURVES[self.curves]
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
            arrays = require(
                library[names].isel({SIGNATURE: paints}).load(), names, "DIRSIG materials", _ROWS
            )
            blocks = {key: array.values for key, array in arrays.items()}
            curves = blocks[name] if blocks[name].ndim == 3 else blocks[name][:, np.newaxis]
            yield paints, {**blocks, "centre": blocks["reflectance"], "curves": curves}

    def of_paint(
        self, centre: Array, curves: Array, mirror: Array | None
    ) -> tuple[Array, Array, Array, dict[str, Any]]:
        # Return the curves of one paint, as they are written, and their items of its record.
        # ``centre``, ``mirror``, ``curves``: reflectance of body and coat (band,) and of the population
        # (curve, band) in the library's order of bands; curves without a value are dropped. Returns ascending
        # wavelengths (wavelength,) [nm], the centre (wavelength,) [1], the population (curve, wavelength) [1]
        # with complete curves first, and items of the record: the ``specular_fraction``; the range and the
        # ``measured`` range [nm]; numbers of ``complete`` curves, of ``interpolated`` samples, of members
        # ``left_out`` without a value at an end, of curves ``thinned`` above ``max_curves``; ``gaps`` [nm];
        # ends ``extrapolated``; ``is_centre`` where no member has values at both ends, so that the centre is
        # the only curve.
        # Raises `SchemaError`: The paint has no values, has gaps that are refused, or does not cover the
        # wavelength range.
        centre = np.where(self.good, centre[self.order], np.nan)
        fraction = 0.0 if isinstance(self.specular, str) else round(float(self.specular), 4)
        if self.specular == "library" and mirror is not None:
            mirror = mirror[self.order]
            is_known = np.isfinite(mirror) & np.isfinite(centre)
            coat, body = (float(np.clip(values[is_known], 0.0, 1.0).sum()) for values in (mirror, centre))
            fraction = min(round(coat / (coat + body), 4), 0.9999) if coat > 0.0 else 0.0
        centre = centre.astype(np.float64)
        curves = np.where(self.good, curves[:, self.order].astype(np.float64), np.nan)
        curves = curves[np.isfinite(curves).any(axis=1)]
        usable = np.flatnonzero(np.isfinite(centre))
        if usable.size < 2:
            raise SchemaError(
                "fewer than two bands have a value", mend="leave the paint out", code="value-missing"
            )
        if not len(curves):  # a paint without members
            curves = centre[np.newaxis]
        measured = (float(self.wavelength[usable[0]]), float(self.wavelength[usable[-1]]))
        low, high = self.wavelength_range or measured
        below, above = bool(low < measured[0]), bool(high > measured[1])
        is_outside = low >= measured[1] or high <= measured[0]
        if is_outside or ((below or above) and not self.extrapolate):
            wanted = f"{low:g} to {high:g} nm"
            outside = f", outside {wanted}" if is_outside else ""
            advice = "narrow wavelength_range, or pass extrapolate=True for constant values beyond the ends"
            raise SchemaError(
                f"measured {measured[0]:g} to {measured[1]:g} nm{outside}",
                expected="" if is_outside else wanted,
                mend="" if is_outside else advice,
                code="wavelength-uncovered",
            )
        # usable bands within the range, and the next band beyond each end, so that the range is covered
        first = max(int(usable[0]), int(np.searchsorted(self.wavelength, low, "right")) - 1)
        last = min(int(usable[-1]), int(np.searchsorted(self.wavelength, high, "left")))
        bands = slice(first, last + 1)
        wavelength = self.wavelength[bands]
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
            if self.gaps == "refuse" and is_gap.any():
                gaps = wavelength[is_gap]
                examples = ", ".join(f"{nm:.1f}" for nm in gaps[:6]) + (", ..." if gaps.size > 6 else "")
                raise SchemaError(
                    f"{subject} no value at {examples} nm, inside the range",
                    mend="omit gaps= to interpolate, or pass a wavelength_range without them",
                    code="value-missing",
                )
        centre = np.interp(wavelength, self.wavelength[usable], centre[usable])
        if has_ends.any():
            curves, missing = curves[has_ends], missing[has_ends]
            order = np.argsort(missing.any(axis=1), kind="stable")
            curves, missing = curves[order], missing[order]
            for row, gaps in zip(curves, missing, strict=True):
                row[gaps] = np.interp(wavelength[gaps], wavelength[~gaps], row[~gaps])
            rows = thinned_rows(curves, np.asarray(missing.any(axis=1)), self.max_curves)
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
            "specular_fraction": fraction,
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
