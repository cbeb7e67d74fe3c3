"""Validation of paint signatures against references, band by band and in parts of the spectrum."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.alignment import oxygen_depth
from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.units import takes_quantities

from .agreement import statistics_of, uncertainty_of
from .comparing import Compared, between_references, compare, paired
from .dataset_spectra import references_from, signatures_from
from .measured_spectra import scaled_by_panel
from .validation_result import FLOOR, MAX_TOLERANCE_SHARE, MEANINGS, RELATIVE, STATISTICS, Validation

#: Parts of the spectrum [nm]: the first wavelength belongs to it, the last does not.
PARTS: Mapping[str, tuple[float, float]] = {
    "VIS": (400.0, 700.0),
    "NIR": (700.0, 1000.0),
    "all": (0.0, np.inf),
}

#: Largest RMSE between signature and reference: a share of the paint's level plus a floor [1]. It is the
#: specification of surface reflectance of MODIS and Landsat, +-(0.005 + 0.05 rho): Vermote and Kotchenova,
#: J. Geophys. Res. 113, D23S90 (2008).
TOLERANCE: Mapping[str, float] = {RELATIVE: 0.05, FLOOR: 0.005}

_MIN_BANDS, _MIN_SHARE = 3, 0.5  # bands compared in a part that is judged, and their share of its bands


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
        Names of references by names of paints, one or several each. By default the region property
        ``reference`` names the reference of a paint; without it, the paint's own name does. Names of files
        match with and without folder and suffix; full names come before short ones. Nothing is paired by
        similarity. Several readings of one instrument are averaged if they come from one folder and dataset,
        or ``pairs`` names them all.
    tolerance
        By default RMSE may be 0.005 + 5 % of the paint's level, the mean of the reference in a part: 0.0065
        for a black of 0.03, 0.045 for a white of 0.8: the specification of surface reflectance of MODIS and
        Landsat [1]_. A number is the largest RMSE at any level [1]. A mapping has limits by name:
        ``relative`` (a share of the level) and ``floor`` (added to it, 0.005 by default), and statistics:
        ``bias``, ``rmse``, ``mae``, ``spectral_angle`` [degree], ``scale`` (its distance from 1),
        ``scale_free_error``. All limits hold in every part that has bands; uncertainty does not widen them. A
        part with fewer than 3 bands, with less than half of its bands, or with a limit above half of its
        level, is not judged: it can fail, but not pass. If ``parts`` names it, or no part of a pair is
        judged, the pair fails.
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
        whether all is within tolerance. Where several instruments measured a paint, ``between`` holds the
        same for their references against one another.

    Raises
    ------
    SchemaError, UnitsError
        An input is no library, no reflectance or no certificate; a reference is absolute and a panel is
        given; widths of channels are implausible; a pair has no band in common; ``pairs`` has unknown names;
        several paints, or references of several folders or datasets, share a name; or nothing can be paired.
        All problems of a kind are listed.

    Warns
    -----
    PaintWarning
        One of a pair includes the mirror image of the sky and the other does not, or one is of the body under
        a coat and the other of its outside (``quantity``); repeated readings, or readings of two instruments,
        differ by more than the tolerance; two paints agree with each other's references and not with their
        own.

    Notes
    -----
    The finer spectrum is brought onto the bands of the coarser one, mostly the signature's: weights on its
    channels reproduce the response of each band, the channels' own width considered
    (`hyperpaint.light.responses.matching_operator`; Gaussian line shapes). A band covered by less than 99.9 %
    is left out and counted, so that nothing is renormalised over missing channels; so is a band too narrow
    for them, whose noise they would multiply by more than 3. Where detectors overlap, and wavelengths fall,
    each is used up to the middle of the overlap, 987 nm for an SVC; ``open_svc(..., overlap="trim", joins=)``
    chooses otherwise. Reflectance is weighted by the response alone: variation of the light within a band
    matters only where the paint varies too, and little even then.

    Equal quantities are compared: where the signature is of the body under a clear coat, and the attributes
    of a reference declare a reading of the coat's outside (``quantity``, or ``specular_component``
    "included") and its geometry (``measurement_geometry`` such as "d/8", ``coat_index``), the reference is
    converted to the body, see `hyperpaint.validation.coat_readings.as_body`; the result notes it.

    Statistics are plain means over bands, see `statistics_of`. Their uncertainty comes from propagated draws
    (JCGM 101): random errors independent from channel to channel, systematic errors common to all. For one
    reference its standard deviation counts as systematic; of n readings :math:`r_k` of one paint and one
    instrument the mean is compared, and its errors are drawn as

    .. math:: \delta r = \sum_k g_k (r_k - \bar r) / \sqrt{n (n - 1)}, \qquad g_k \sim N(0, 1),

    whose covariance over bands is the covariance of the mean; the readings' own systematic uncertainty,
    common to all, and their random uncertainty over :math:`\sqrt n` are added, so that a few readings that
    agree by chance do not seem too certain. Unknown components are not included, and the result notes it; a
    component known only in other bands makes uncertainties NaN.

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
    named = parts is not None
    parts = PARTS if parts is None else parts
    problems = Problems("parts= cannot be used", SchemaError)
    if not isinstance(parts, Mapping) or not parts:
        problems.add(
            f"{parts!r:.60}", expected="names with first and last wavelength [nm]", code="type-wrong"
        )
        problems.raise_if_any()
    for name, edges in parts.items():
        if len(tuple(edges)) != 2 or not edges[0] < edges[1]:
            problems.add(
                f"{name!r}: {edges!r:.60}", expected="first and last wavelength [nm]", code="type-wrong"
            )
    problems.raise_if_any()
    measured = references_from(references, reference_fwhm)
    if panel is not None:
        measured = scaled_by_panel(measured, panel)
    pairing = paired(signatures_from(signatures), measured, pairs)
    compared = [compare(pair, seed) for pair in pairing.pairs]
    between = [compare(pair, seed) for pair in between_references(pairing.pairs)]
    between = [each for each in between if each.used.any()]
    problems = Problems("there are pairs without a band in common", SchemaError)
    for each in compared:
        if not each.used.any():
            problems.add(
                f"{each.pair.signature.name!r}: paint and reference share no complete band ({each.ranges})",
                code="range-disjoint",
            )
    problems.raise_if_any()
    scatters = [_scatter(each, limits) for each in compared]
    noticed = [pair for each in compared for pair in each.warnings()]
    noticed += [
        ("reference-scatter", f"{each.pair.signature.name}: {text}")
        for each, texts in zip(compared, scatters, strict=True)
        for text in texts
    ]
    noticed += [("references-exchanged", text) for text in _exchanged(compared)]
    references_apart = None
    if between:
        references_apart = Validation(
            statistics=_statistics(between, parts, limits, named=named),
            spectra=tuple(each.dataset() for each in between),
            notes=((),) * len(between),
            unpaired_signatures=(),
            unpaired_references=(),
            missing=(),
            tolerance=limits,
        )
        noticed += [("references-disagree", text) for text in _disagreements(references_apart.statistics)]
    for code, text in dict.fromkeys(noticed):
        warnings.warn(PaintWarning(text, code=code), stacklevel=2)
    return Validation(
        statistics=_statistics(compared, parts, limits, named=named),
        spectra=tuple(each.dataset() for each in compared),
        notes=tuple((*each.notes(), *texts) for each, texts in zip(compared, scatters, strict=True)),
        unpaired_signatures=pairing.signatures,
        unpaired_references=pairing.references,
        missing=pairing.signatures if require_all else pairing.missing,
        tolerance=limits,
        between=references_apart,
    )


def _disagreements(between: xr.Dataset) -> list[str]:
    outside = (between["judged"] & ~between["passes"]).values
    return [
        f"{one['signature'].item()}: {one['instrument'].item()} is beyond the tolerance in "
        f"{', '.join(between['part'].values[outside[row]])}; which of them is right?"
        for row in np.flatnonzero(outside.any(axis=1))
        for one in [between.isel(pair=row)]
    ]


# RMSE with each other's references over RMSE with their own, below which two paints seem exchanged, and the
# smallest RMSE of each [1]: samples that real laboratories exchanged have 0.15 to 0.45
_EXCHANGED_SHARE, _EXCHANGED_MIN_RMSE = 0.6, 0.01
_EXCHANGED_MAX_PAINTS = 200  # searched, those furthest from their references


def _exchanged(compared: Sequence[Compared]) -> list[str]:
    # paints that agree with each other's references better than with their own
    def rmse(seen: Compared, known: Compared) -> float:
        used = seen.used & known.used
        return (
            float(np.sqrt(((seen.signature - known.reference)[used] ** 2).mean())) if used.any() else np.nan
        )

    own_rmse = np.array([rmse(each, each) for each in compared])
    places = np.flatnonzero(own_rmse > _EXCHANGED_MIN_RMSE)
    texts = []
    for i, j in itertools.combinations(
        sorted(places[np.argsort(-own_rmse[places])][:_EXCHANGED_MAX_PAINTS]), 2
    ):
        one, other = compared[i], compared[j]
        names = one.pair.signature.name, other.pair.signature.name
        same = one.instrument == other.instrument and names[0] != names[1]
        if not (same and np.array_equal(one.bands.wavelength, other.bands.wavelength)):
            continue
        across = rmse(one, other), rmse(other, one)
        whole = _EXCHANGED_SHARE * (own_rmse[i] + own_rmse[j])
        # both must agree: of three paints exchanged in turn, only one of two would
        if sum(across) < whole and (np.array(across) < own_rmse[[i, j]]).all() and max(across) < 0.5 * whole:
            texts.append(
                f"{names[0]} and {names[1]}: each agrees with the reference of the other (RMSE "
                f"{across[0]:.3f} and {across[1]:.3f}, with its own {own_rmse[i]:.3f} and "
                f"{own_rmse[j]:.3f}); were the samples, or their names, exchanged?"
            )
    return texts


def _rmse_limit(limits: Mapping[str, float], level: Floats) -> Floats:
    # NaN without a limit
    most = np.full(np.shape(level), limits.get("rmse", np.inf))
    if RELATIVE in limits:
        most = np.fmin(most, limits[FLOOR] + limits[RELATIVE] * np.abs(level))
    return np.where(np.isfinite(most), most, np.nan)


def _scatter(compared: Compared, limits: Mapping[str, float]) -> list[str]:
    # repeated readings that scatter more than the tolerance of their mean
    level = np.asarray(compared.reference[compared.used].mean())
    limit = float(np.fmin(_rmse_limit(limits, level), limits.get("mae", np.nan)))
    if not compared.scatter > limit:
        return []
    return [
        f"readings of the reference scatter by {compared.scatter:.2g}, more than the tolerance of "
        f"{limit:.2g}; are they of one paint?"
    ]


def _limits(tolerance: Any) -> dict[str, float]:
    limits = {"rmse": tolerance} if tolerance is not None else TOLERANCE
    limits = dict(tolerance) if isinstance(tolerance, Mapping) else dict(limits)
    problems = Problems("tolerance= cannot be used", SchemaError)
    for name, limit in limits.items():
        if name not in (RELATIVE, FLOOR, *STATISTICS):
            problems.add(
                f"there is no statistic {name!r}",
                expected=", ".join((RELATIVE, FLOOR, *STATISTICS)),
                code="choice-unknown",
            )
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not limit >= 0.0:
            problems.add(f"{name}: {limit!r}", expected="a number from 0 on", code="value-out-of-range")
    if not limits:
        problems.add("no limit", mend="name one, such as 0.02 of RMSE", code="argument-missing")
    if FLOOR in limits and RELATIVE not in limits:
        problems.add(
            "floor is added to a share of the paint's level",
            mend="name relative as well, such as 0.05",
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
    named: bool,
) -> xr.Dataset:
    shape = len(compared), len(parts)
    statistics = {name: np.full(shape, np.nan) for name in STATISTICS}
    statistics |= {f"{name}_u": np.full(shape, np.nan) for name in STATISTICS}
    statistics |= {"coverage": np.full(shape, np.nan), "level": np.full(shape, np.nan)}
    bands, left_out = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for row, each in enumerate(compared):
        for column, edges in enumerate(parts.values()):
            inside = each.part(edges)
            here = inside & each.used
            bands[row, column], left_out[row, column] = here.sum(), (inside & ~here).sum()
            if not here.any():
                continue
            sides = each.signature[here], each.reference[here]
            statistics["coverage"][row, column] = each.coverage[here].min()
            statistics["level"][row, column] = each.reference[here].mean()
            for name, value in statistics_of(*sides).items():
                statistics[name][row, column] = value
            if each.errors is not None:
                drawn = uncertainty_of(*sides, *(errors[:, here] for errors in each.errors))
                for name, value in drawn.items():
                    statistics[f"{name}_u"][row, column] = value
    statistics["rmse_limit"] = _rmse_limit(limits, statistics["level"])
    dims = ("pair", "part")
    variables: dict[str, Any] = {name: (dims, values, _attrs(name)) for name, values in statistics.items()}
    variables["bands"] = (dims, bands, _attrs("bands"))
    variables["bands_left_out"] = (dims, left_out, _attrs("bands_left_out"))
    too_dark = (
        statistics["rmse_limit"] > MAX_TOLERANCE_SHARE * statistics["level"] if RELATIVE in limits else False
    )
    judged = (bands >= _MIN_BANDS) & (bands >= _MIN_SHARE * (bands + left_out)) & ~np.asarray(too_dark)
    for name, flags in (("judged", judged), ("passes", _passes(statistics, judged, limits, named=named))):
        variables[name] = (dims, flags, {"long_name": MEANINGS[name]})
    for name, side in (("oxygen_residual", "signature"), ("reference_oxygen_residual", "reference")):
        depth = [oxygen_depth(each.bands.wavelength, getattr(each, side)) for each in compared]
        variables[name] = ("pair", np.array(depth, np.float64), _attrs(name))
    texts = {
        "signature": [each.pair.signature.name for each in compared],
        "reference": [each.names for each in compared],
        "instrument": [each.instrument for each in compared],
        "overlap": [each.overlap for each in compared],
        "mirror_reflection": [each.mirror for each in compared],
    }
    matched = np.array([each.matched for each in compared], bool)
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
    statistics: Mapping[str, Floats], judged: Bools, limits: Mapping[str, float], *, named: bool
) -> Bools:
    # a part that is not judged fails outside of a limit, if the user named it, or if no part of the pair is
    # judged
    within, outside = np.ones(judged.shape, bool), np.zeros(judged.shape, bool)
    of_statistics: dict[str, Any] = {
        name: limit for name, limit in limits.items() if name in STATISTICS and name != "rmse"
    }
    if "rmse" in limits or RELATIVE in limits:
        of_statistics["rmse"] = statistics["rmse_limit"]
    for name, limit in of_statistics.items():
        away = np.abs(statistics[name] - 1.0 if name == "scale" else statistics[name])
        # NaN is neither within nor outside
        within &= away <= limit
        outside |= away > limit
    enough = judged | ~np.logical_or(named, ~judged.any(axis=1, keepdims=True))
    return np.asarray(~outside & enough & (within | ~judged))
