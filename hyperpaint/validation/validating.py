"""Validation of paint signatures against references, band by band and in parts of the spectrum."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.alignment import oxygen_depth
from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import Problem, Problems, SchemaError, warn_user
from hyperpaint.base.facts import documented, one_of
from hyperpaint.base.units import takes_quantities

from .comparing import (
    Compared,
    between_references,
    compare,
    paired,
    statistics_of,
    uncertainty_of,
)
from .dataset_spectra import references_from, scaled_by_panel, signatures_from
from .validation_result import FLOOR, MAX_TOLERANCE_SHARE, MEANINGS, RELATIVE, STATISTICS, Validation

#: Parts of the spectrum [nm]: first wavelength, and end, exclusive.
PARTS: Mapping[str, tuple[float, float]] = {
    "VIS": (400.0, 700.0),
    "NIR": (700.0, 1000.0),
    "all": (0.0, np.inf),
}

#: Maximum RMSE between signature and reference: a share of the paint's level plus a floor [1]. These are the
#: values of the specification for surface reflectance of MODIS and Landsat, +-(0.005 + 0.05 rho): Vermote and
#: Kotchenova, J. Geophys. Res. 113, D23S90 (2008).
TOLERANCE: Mapping[str, float] = {RELATIVE: 0.05, FLOOR: 0.005}

#: Minimum number of compared bands of a part that is judged, and their minimum share of its bands.
_MIN_BANDS, _MIN_SHARE = 3, 0.5


@takes_quantities(reference_fwhm="nm", parts="nm")
@documented(signatures="library")
def validate(
    signatures: xr.Dataset,
    references: Any,
    pairs: Mapping[str, str | Sequence[str]] | None = None,
    *,
    tolerance: float | Mapping[str, float] | None = None,
    panel: xr.DataArray | xr.Dataset | None = None,
    parts: Mapping[str, tuple[float, float]] | None = None,
    reference_fwhm: float | None = None,
    require_all: bool = False,
    seed: int = 0,
) -> Validation:
    r"""Compare paint signatures with reference measurements of the same paints.

    Eager.

    Parameters
    ----------
    signatures
    references
        Datasets of reflectance, one or several: spectra of a field spectrometer (spectrum, wavelength), as of
        `hyperpaint.open_asd` and ``open_svc``, or a paint library (signature, band).
    pairs
        One or several names of references by name of a paint. By default the region property ``reference``
        names the reference of a paint; without it, the paint's name does. Names of files match with and
        without folder and suffix; full names take precedence. Similar names do not match. Several readings of
        one instrument are averaged if they come from one folder and dataset, or if ``pairs`` names them all.
    tolerance
        By default the maximum RMSE is 0.005 + 5 % of the paint's level, the mean of the reference in a part:
        0.0065 for a black of 0.03, 0.045 for a white of 0.8, as in the specification for surface reflectance
        of MODIS and Landsat [1]_. A number is the maximum RMSE at any level [1]. A mapping has limits by
        name: ``relative`` (a share of the level) and ``floor`` (added to it, 0.005 by default), and
        statistics: ``bias``, ``rmse``, ``mae``, ``spectral_angle`` [degree], ``scale`` (its distance from 1),
        ``scale_free_error``. All limits hold in every part with bands; uncertainty does not widen them. A
        part with fewer than 3 compared bands, with less than half of its bands, or with a limit above half of
        its level, is not judged: it can fail, but not pass. If ``parts`` names such a part, or no part of a
        pair is judged, the pair fails.
    panel
        Certified reflectance of the white panel on ``wavelength`` [1], which multiplies references that are
        relative to it.
    parts
        Parts of the spectrum by name: first wavelength, and end, exclusive [nm]. By default `PARTS`.
    reference_fwhm
        Width of the references' channels [nm]. By default ``fwhm`` of the data, else the usual width of the
        instrument, else twice the distance of channels; the result names the source.
    require_all
        Whether every paint must have a reference; by default only those whose region names one.
    seed
        Seed of the random draws for uncertainties.

    Returns
    -------
    Validation
        Statistics of every pair and part with uncertainties, spectra on common bands, unpaired names, and
        whether all pairs are within tolerance. Where several instruments measured a paint, ``between``
        compares their references in the same way.

    Raises
    ------
    SchemaError, UnitsError
        An input is not a library, has no reflectance or is not a certificate; a reference is absolute while
        ``panel`` is given; widths of channels are implausible; a pair has no band in common; ``pairs`` has
        unknown names; several paints, or references of several folders or datasets, share a name; or nothing
        can be paired. All problems of a kind are listed.

    Warns
    -----
    PaintWarning
        Only one of a pair includes the mirror image of the sky, or one is of the body under a coat and the
        other of the coat's outside (``quantity``); repeated readings, or readings of two instruments, differ
        by more than the tolerance; two paints agree with the references of one another, not with their own.

    Notes
    -----
    The finer spectrum is resampled to the bands of the coarser one, mostly the signature's: weights on its
    channels, with their widths, reproduce the response of each band
    (`hyperpaint.light.responses.matching_operator`; Gaussian line shapes). Bands covered by less than 99.9 %
    are excluded and counted, as are bands so narrow that resampling would multiply noise by more than 3. Two
    overlapping detectors, where wavelengths fall, are joined in the middle of the overlap, 987 nm for an SVC;
    ``open_svc(..., overlap="trim", joins=)`` joins them elsewhere. Reflectance is weighted by the response
    only: variation of the light within a band matters little.

    Equal quantities are compared: where the signature is of the body under a clear coat, and the attributes
    of a reference declare a reading of the coat's outside (``quantity``, or ``specular_component``
    "included") and its geometry (``measurement_geometry`` such as "d/8", ``coat_index``), the reference is
    converted to the body, see `hyperpaint.validation.dataset_spectra.as_body`; the result notes it.

    Statistics are plain means over bands, see `statistics_of`. Their uncertainty comes from propagated draws
    (JCGM 101): random errors independent from channel to channel, systematic errors common to all. The
    standard deviation of a single reference counts as systematic. Of n readings :math:`r_k` of one paint and
    one instrument the mean is compared, with errors drawn as

    .. math:: \delta r = \sum_k g_k (r_k - \bar r) / \sqrt{n (n - 1)}, \qquad g_k \sim N(0, 1),

    whose covariance over bands is the covariance of the mean. The systematic uncertainty of the readings,
    common to all, and their random uncertainty over :math:`\sqrt n` are added, since a few readings may agree
    by chance. Unknown components are not included, and the result notes it; uncertainties are NaN in bands
    without a component that other bands have.

    References
    ----------
    .. [1] E. F. Vermote, S. Kotchenova, "Atmospheric correction for the monitoring of land surfaces",
       J. Geophys. Res. 113, D23S90 (2008).

    Examples
    --------
    >>> import xarray as xr
    >>> nm = np.linspace(400.0, 700.0, 301)
    >>> field = xr.Dataset(
    ...     {"reflectance": (("spectrum", "wavelength"), [0.2 + 0.001 * (nm - 400.0)], {"units": "1"})},
    ...     {"wavelength": ("wavelength", nm, {"units": "nm"}), "spectrum": ["hood"]},
    ... )
    >>> at = np.linspace(430.0, 670.0, 25)
    >>> paints = xr.Dataset(
    ...     {"reflectance": (("signature", "band"), [0.21 + 0.001 * (at - 400.0)], {"units": "1"})},
    ...     {"signature": ["hood"], "wavelength": ("band", at, {"units": "nm"})},
    ... )
    >>> found = validate(paints, field, reference_fwhm=3.0)  # 0.01 of 0.35: less than 0.005 + 5 %
    >>> found.passed, round(float(found.statistics.bias.sel(part="VIS").item()), 4)
    (True, 0.01)
    """
    limits = _limits(tolerance)
    user_parts = parts is not None
    parts = PARTS if parts is None else parts
    problems = Problems("parts= cannot be used", SchemaError)
    if not isinstance(parts, Mapping) or not parts:
        problems.add(
            f"{parts!r:.60}", expected="names with first and last wavelength [nm]", code="type-wrong"
        )
        problems.raise_if_any()
    problems.extend(
        Problem(f"{name!r}: {edges!r:.60}", expected="first and last wavelength [nm]", code="type-wrong")
        for name, edges in parts.items()
        if len(tuple(edges)) != 2 or not edges[0] < edges[1]
    )
    problems.raise_if_any()
    reference_spectra = references_from(references, reference_fwhm)
    if panel is not None:
        reference_spectra = scaled_by_panel(reference_spectra, panel)
    matched, unpaired_signatures, unpaired_references, missing = paired(
        signatures_from(signatures), reference_spectra, pairs
    )
    compared = [compare(pair, seed) for pair in matched]
    between = [compare(pair, seed) for pair in between_references(matched)]
    between = [comparison for comparison in between if comparison.used.any()]
    problems = Problems("pairs have no band in common", SchemaError)
    problems.extend(
        Problem(
            f"{comparison.pair.signature.name!r}: paint and reference share no complete band "
            f"({comparison.ranges})",
            code="range-disjoint",
        )
        for comparison in compared
        if not comparison.used.any()
    )
    problems.raise_if_any()
    scatters = [_scatter(comparison, limits) for comparison in compared]
    messages = [message for comparison in compared for message in comparison.warnings()]
    messages += [
        ("reference-scatter", f"{comparison.pair.signature.name}: {text}")
        for comparison, texts in zip(compared, scatters, strict=True)
        for text in texts
    ]
    messages += [("references-exchanged", text) for text in _exchanged(compared)]
    between_instruments = None
    if between:
        between_instruments = Validation(
            statistics=_statistics(between, parts, limits, user_parts=user_parts),
            spectra=tuple(comparison.dataset() for comparison in between),
            notes=((),) * len(between),
            unpaired_signatures=(),
            unpaired_references=(),
            missing=(),
            tolerance=limits,
        )
        found = between_instruments.statistics
        outside = (found["judged"] & ~found["passes"]).values
        messages += [
            (
                "references-disagree",
                f"{found['signature'].values[row]}: {found['instrument'].values[row]} is beyond the "
                f"tolerance in {', '.join(found['part'].values[outside[row]])}; check both references",
            )
            for row in np.flatnonzero(outside.any(axis=1))
        ]
    for code, text in dict.fromkeys(messages):
        warn_user(text, code)
    return Validation(
        statistics=_statistics(compared, parts, limits, user_parts=user_parts),
        spectra=tuple(comparison.dataset() for comparison in compared),
        notes=tuple(
            (*comparison.notes(), *texts) for comparison, texts in zip(compared, scatters, strict=True)
        ),
        unpaired_signatures=unpaired_signatures,
        unpaired_references=unpaired_references,
        missing=unpaired_signatures if require_all else missing,
        tolerance=limits,
        between=between_instruments,
    )


#: Two paints seem exchanged where their RMSE with the references of one another over the RMSE with their own
#: references is below this share [1]: samples that laboratories exchanged have 0.15 to 0.45.
_EXCHANGED_SHARE = 0.6
#: Minimum RMSE of a paint with its own reference that may be exchanged [1].
_EXCHANGED_MIN_RMSE = 0.01
#: Maximum number of paints in this search: those farthest from their references.
_EXCHANGED_MAX_PAINTS = 200


def _exchanged(compared: Sequence[Compared]) -> list[str]:
    # Texts about pairs of paints that agree with the references of one another better than with their own
    def rmse(signature_side: Compared, reference_side: Compared) -> float:
        used = signature_side.used & reference_side.used
        difference = (signature_side.signature - reference_side.reference)[used]
        return float(np.sqrt((difference**2).mean())) if used.any() else np.nan

    own_rmse = np.array([rmse(comparison, comparison) for comparison in compared])
    candidates = np.flatnonzero(own_rmse > _EXCHANGED_MIN_RMSE)
    farthest = np.sort(candidates[np.argsort(-own_rmse[candidates])][:_EXCHANGED_MAX_PAINTS]).tolist()
    texts = []
    for i, j in itertools.combinations(farthest, 2):
        first, second = compared[i], compared[j]
        names = first.pair.signature.name, second.pair.signature.name
        comparable = first.instrument == second.instrument and names[0] != names[1]
        if not (comparable and np.array_equal(first.bands.wavelength, second.bands.wavelength)):
            continue
        crossed = rmse(first, second), rmse(second, first)
        limit = _EXCHANGED_SHARE * (own_rmse[i] + own_rmse[j])
        # both must agree: of three paints exchanged in turn, only one of two does
        both_agree = (np.array(crossed) < own_rmse[[i, j]]).all() and max(crossed) < 0.5 * limit
        if sum(crossed) < limit and both_agree:
            texts.append(
                f"{names[0]} and {names[1]}: each agrees with the reference of the other (RMSE "
                f"{crossed[0]:.3f} and {crossed[1]:.3f}, with its own {own_rmse[i]:.3f} and "
                f"{own_rmse[j]:.3f}); check whether the samples, or their names, were exchanged"
            )
    return texts


def _rmse_limit(limits: Mapping[str, float], level: Floats) -> Floats:
    # Maximum RMSE at levels of paints; NaN without a limit
    of_level = limits[FLOOR] + limits[RELATIVE] * np.abs(level) if RELATIVE in limits else np.inf
    limit = np.fmin(np.full(np.shape(level), limits.get("rmse", np.inf)), of_level)
    return np.where(np.isfinite(limit), limit, np.nan)


def _scatter(compared: Compared, limits: Mapping[str, float]) -> list[str]:
    # A text if repeated readings scatter by more than the tolerance of their mean
    level = np.asarray(compared.reference[compared.used].mean())
    limit = float(np.fmin(_rmse_limit(limits, level), limits.get("mae", np.nan)))
    if not compared.scatter > limit:
        return []
    return [
        f"readings of the reference scatter by {compared.scatter:.2g}, more than the tolerance of "
        f"{limit:.2g}; check whether they show one paint"
    ]


def _limits(tolerance: Any) -> dict[str, float]:
    limits = {"rmse": tolerance} if tolerance is not None else TOLERANCE
    limits = dict(tolerance) if isinstance(tolerance, Mapping) else dict(limits)
    problems = Problems("tolerance= cannot be used", SchemaError)
    for name, limit in limits.items():
        one_of(name, (RELATIVE, FLOOR, *STATISTICS), "statistic", problems=problems)
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not limit >= 0.0:
            problems.add(f"{name}: {limit!r}", expected="a number from 0 on", code="value-out-of-range")
    if not limits:
        problems.add("no limit", mend="pass at least one limit, such as rmse 0.02", code="argument-missing")
    if FLOOR in limits and RELATIVE not in limits:
        problems.add(
            "floor is added to a share of the paint's level",
            mend="pass relative as well, such as 0.05",
            code="option-conflict",
        )
    if RELATIVE in limits:
        limits.setdefault(FLOOR, TOLERANCE[FLOOR])
    problems.raise_if_any()
    return {name: float(limit) for name, limit in limits.items()}


def _statistics(
    compared: Sequence[Compared],
    parts: Mapping[str, tuple[float, float]],
    limits: Mapping[str, float],
    *,
    user_parts: bool,
) -> xr.Dataset:
    # Statistics of every pair and part; `user_parts`: whether the user named the parts
    shape = len(compared), len(parts)
    statistics = {name: np.full(shape, np.nan) for name in STATISTICS}
    statistics |= {f"{name}_u": np.full(shape, np.nan) for name in STATISTICS}
    statistics |= {"coverage": np.full(shape, np.nan), "level": np.full(shape, np.nan)}
    bands, excluded_bands = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for row, comparison in enumerate(compared):
        for column, edges in enumerate(parts.values()):
            nm = comparison.bands.wavelength
            in_part = (nm >= edges[0]) & (nm < edges[1])
            used = in_part & comparison.used
            bands[row, column], excluded_bands[row, column] = used.sum(), (in_part & ~used).sum()
            if not used.any():
                continue
            spectra = comparison.signature[used], comparison.reference[used]
            statistics["coverage"][row, column] = comparison.coverage[used].min()
            statistics["level"][row, column] = comparison.reference[used].mean()
            for name, value in statistics_of(*spectra).items():
                statistics[name][row, column] = value
            if comparison.errors is not None:
                uncertainties = uncertainty_of(*spectra, *(errors[:, used] for errors in comparison.errors))
                for name, value in uncertainties.items():
                    statistics[f"{name}_u"][row, column] = value
    statistics["rmse_limit"] = _rmse_limit(limits, statistics["level"])
    dims = ("pair", "part")
    variables: dict[str, Any] = {name: (dims, values, _attrs(name)) for name, values in statistics.items()}
    variables["bands"] = (dims, bands, _attrs("bands"))
    variables["bands_left_out"] = (dims, excluded_bands, _attrs("bands_left_out"))
    too_dark = (
        statistics["rmse_limit"] > MAX_TOLERANCE_SHARE * statistics["level"] if RELATIVE in limits else False
    )
    judged = (bands >= _MIN_BANDS) & (bands >= _MIN_SHARE * (bands + excluded_bands)) & ~np.asarray(too_dark)
    passes = _passes(statistics, judged, limits, user_parts=user_parts)
    for name, flags in (("judged", judged), ("passes", passes)):
        variables[name] = (dims, flags, {"long_name": MEANINGS[name]})
    for name, side in (("oxygen_residual", "signature"), ("reference_oxygen_residual", "reference")):
        depth = [
            oxygen_depth(comparison.bands.wavelength, getattr(comparison, side)) for comparison in compared
        ]
        variables[name] = ("pair", np.array(depth, np.float64), _attrs(name))
    texts = {
        "signature": [comparison.pair.signature.name for comparison in compared],
        "reference": [comparison.names for comparison in compared],
        "instrument": [comparison.instrument for comparison in compared],
        "overlap": [comparison.common("overlap") for comparison in compared],
        "mirror_reflection": [comparison.common("mirror") for comparison in compared],
    }
    matched = np.array([comparison.matched for comparison in compared], bool)
    coords: dict[str, Any] = {
        name: ("pair", np.array(column, object), {"long_name": MEANINGS[name]})
        for name, column in texts.items()
    }
    coords["overlap_matched"] = ("pair", matched, {"long_name": MEANINGS["overlap_matched"]})
    coords["part"] = np.array(list(parts), object)
    for name, end in (("first_wavelength", 0), ("last_wavelength", 1)):
        coords[name] = ("part", np.array([edges[end] for edges in parts.values()], np.float64), _attrs(name))
    return xr.Dataset(variables, coords, {"title": "Agreement of paint signatures with references"})


def _attrs(name: str) -> dict[str, str]:
    units = "degree" if name.startswith("spectral_angle") else "nm" if name.endswith("wavelength") else "1"
    meaning = MEANINGS[name] if name in MEANINGS else f"Standard uncertainty of {name.removesuffix('_u')}"
    return {"units": units, "long_name": meaning}


def _passes(
    statistics: Mapping[str, Floats], judged: Bools, limits: Mapping[str, float], *, user_parts: bool
) -> Bools:
    # Whether pairs pass in parts (pair, part).
    # A part that is not judged fails outside of a limit, if the user named it, or if no part of the pair is
    # judged.
    within, outside = np.ones(judged.shape, bool), np.zeros(judged.shape, bool)
    statistic_limits: dict[str, Any] = {
        name: limit for name, limit in limits.items() if name in STATISTICS and name != "rmse"
    }
    if "rmse" in limits or RELATIVE in limits:
        statistic_limits["rmse"] = statistics["rmse_limit"]
    for name, limit in statistic_limits.items():
        deviation = np.abs(statistics[name] - 1.0 if name == "scale" else statistics[name])
        # NaN is neither within nor outside
        within &= deviation <= limit
        outside |= deviation > limit
    may_pass = judged | ~np.logical_or(user_parts, ~judged.any(axis=1, keepdims=True))
    return np.asarray(~outside & may_pass & (within | ~judged))
