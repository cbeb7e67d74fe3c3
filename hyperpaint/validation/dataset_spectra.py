"""Spectra of paint libraries and spectrometer datasets, prepared for validation.

Names, values, uncertainties and channels on one axis of wavelengths; readings outside of a clear coat and of
the body under it are distinguished, and converted where possible.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problem, Problems, SchemaError, UnitsError
from hyperpaint.base.mirrored_light import BODY, EXCLUDED, INCLUDED, OUTSIDE, THROUGH_COAT, mirror_reflection
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.base.units import convert
from hyperpaint.light.coat_transmission import (
    COAT_INDEX,
    COAT_INDEX_U,
    interface_reflectance,
    sky_reflectance,
)
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.paints.band_ratios import covariance

_SUFFIXES = (".asd", ".sig", ".txt", ".tsv", ".csv")


@dataclass(frozen=True)
class Names:
    # Names of one spectrum
    shown: str  #: Name in results.
    #: Names for pairing, by rank: full names; names without suffix; names without folder, which spectra of
    #: other folders may share. A match of one rank excludes matches of later ranks.
    ranks: tuple[frozenset[str], frozenset[str], frozenset[str]]
    #: Number of the dataset, and folder in it: only readings of one origin are repeats of one another.
    origin: tuple[int, str]


def names_of_spectrum(spectrum: str, source: str, further: str, number: int, dataset: int) -> Names:
    """Return the names of a spectrum of a field spectrometer.

    ``spectrum``: its name, preceded by the folder where names repeat; ``source``: its file; ``further``: a
    further name; any of these may be empty. ``number``: number of the spectrum in its dataset; ``dataset``:
    number of the dataset.

    Examples
    --------
    >>> names = names_of_spectrum("site1/red", "red.sig", "", 0, 1)
    >>> [sorted(rank) for rank in names.ranks], names.origin
    ([['site1/red', 'site1/red.sig'], [], ['red', 'red.sig']], (1, 'site1/'))
    """
    base = PurePath(spectrum).name
    folder = spectrum[: len(spectrum) - len(base)] if spectrum.endswith(base) else ""
    full = frozenset(text for text in (spectrum, further, source and folder + source) if text)
    no_suffix = frozenset(name for text in full for name in _without_suffix(text)) - full
    aliases = frozenset(alias for text in (spectrum, source, further) for alias in _aliases(text))
    # readers number equal names in one folder, such as "red (1)" of red.sig: these are not repeats either
    numbered = base if source and base not in set(_aliases(source)) else ""
    shown = spectrum or source or further or f"spectrum {number}"
    return Names(shown, (full, no_suffix, aliases - full - no_suffix), (dataset, folder + numbered))


def _aliases(text: str) -> Iterator[str]:
    """Yield the names of a file, or of a column in it: with and without folder and suffixes.

    Examples
    --------
    >>> sorted(set(_aliases("svc/red.asd.txt")))
    ['red', 'red.asd', 'red.asd.txt', 'svc/red.asd.txt']
    """
    if not text:
        return
    yield text
    for path in (text, text.rpartition(":")[2]):
        name = PurePath(path).name
        yield name
        yield from _without_suffix(name)


def _without_suffix(name: str) -> Iterator[str]:
    while name.lower().endswith(_SUFFIXES):
        name = name[: name.rindex(".")]
        yield name


@dataclass(frozen=True, eq=False)
class Measured:
    """One spectrum of reflectance with its origin and uncertainty."""

    names: Names  #: Names for pairing, and the origin.
    reference_name: str  #: Name of the reference in the properties of a signature; empty without it.
    instrument: str  #: Make of the instrument.
    serial: str  #: Serial number of the instrument, or a similar text; may be empty.
    wavelength: Floats  #: (channel,), float64: Increasing centre wavelengths [nm].
    fwhm: Floats  #: (channel,), float64: Widths [nm].
    values: Floats  #: (channel,), float64: Reflectance [1]; NaN without a value.
    u_random: Floats | None  #: (channel,): Standard uncertainty independent from channel to channel [1].
    u_systematic: Floats | None  #: (channel,): Standard uncertainty common to all channels [1].
    sd: Floats | None  #: (channel,): Standard deviation of the averaged readings or pixels [1].
    count: float  #: Number of averaged readings or independent pixels; 1 where unknown.
    overlap: str  #: Treatment of overlapping detectors by the reader: preserved, removed or unknown.
    matched: bool  #: Whether values were changed there to make detectors meet.
    mirror: str  #: Whether the mirror image of sky and surroundings is included, excluded, or unknown.
    absolute: bool  #: Whether reflectance is relative to a perfect diffuser, not to a panel.
    notes: tuple[str, ...]  #: Remarks for the reader of results.
    quantity: str = ""  #: Body under a coat or outside of the coat, see base.mirrored_light.
    geometry: str = ""  #: Measurement geometry of the instrument, such as d/8.
    coat_index: float = 1.5  #: Refractive index of the coat.
    covariance: Floats | None = (
        None  #: (channel, channel): Covariance of both uncertainties [1]; None if unknown.
    )

    @property
    def name(self) -> str:
        """Name in results."""
        return self.names.shown

    @property
    def has_uncertainty(self) -> bool:
        """Whether any part of the uncertainty is known."""
        return any(component is not None for component in (self.u_random, self.u_systematic, self.sd))

    def times(self, factor: Floats | float, **changes: Any) -> Measured:
        """Return the spectrum with values and spreads multiplied by a factor, and other changed fields."""
        spreads = {"u_random": self.u_random, "u_systematic": self.u_systematic, "sd": self.sd}
        scaled = {name: None if spread is None else spread * factor for name, spread in spreads.items()}
        return replace(self, **{"values": self.values * factor, **scaled, **changes})

    def gaps(self) -> list[str]:
        """Return the unknown parts of the uncertainty, for the reader of the result."""
        if self.u_random is None and self.u_systematic is None:
            return []
        gaps, has_value = [], np.isfinite(self.values)
        for name, u, counterpart in (
            ("random", self.u_random, "systematic"),
            ("systematic", self.u_systematic, "random"),
        ):
            if u is None:
                gaps.append(f"{counterpart} part only, the {name} part is unknown")
            elif not np.isfinite(u[has_value]).all():
                count = int(np.isfinite(u[has_value]).sum())
                gaps.append(
                    f"{name} part known in {count} of {int(has_value.sum())} channels; no uncertainty "
                    "elsewhere"
                )
        return gaps

    def errors(self, rng: np.random.Generator, draws: int) -> Floats:
        """Return random draws of the errors of the values (draw, channel).

        They follow the covariance where it is known; else random errors are independent and systematic errors
        common to all channels. Where neither is known, the standard deviation of the mean counts as
        systematic: readings of a surface differ in level more than in shape. NaN in channels without an
        uncertainty that other channels have.
        """
        if self.covariance is not None:
            missing = np.isnan(np.diagonal(self.covariance))
            # truncated correlations cause eigenvalues slightly below zero
            variances, vectors = np.linalg.eigh(np.nan_to_num(self.covariance))
            components = vectors * np.sqrt(np.maximum(variances, 0.0))
            errors = rng.standard_normal((draws, variances.size)) @ components.T
            return np.asarray(np.where(missing, np.nan, errors))
        errors = np.zeros((draws, self.values.size))
        if self.u_random is not None:
            errors += self.u_random * rng.standard_normal(errors.shape)
        systematic = self.u_systematic
        if systematic is None and self.u_random is None and self.sd is not None:
            systematic = self.sd / np.sqrt(self.count)
        if systematic is not None:
            errors += systematic * rng.standard_normal((draws, 1))
        return errors


def scaled_by_panel(spectra: list[Measured], panel: Any) -> list[Measured]:
    # Return references multiplied by the reflectance of their white panel.
    # ``spectra``: references relative to the panel; ``panel``: reflectance of the panel on ``wavelength``: a
    # DataArray, or a Dataset with ``reflectance``. It is interpolated linearly; beyond its wavelengths the
    # result is NaN.
    # Raises `SchemaError, UnitsError`: A reference is absolute already, or the panel is not a certificate;
    # all problems are listed.
    array = panel["reflectance"] if hasattr(panel, "data_vars") and "reflectance" in panel else panel
    if not hasattr(array, "dims") or tuple(array.dims) != ("wavelength",) or "wavelength" not in array.coords:
        raise SchemaError(
            f"panel= is {type(panel).__name__}",
            expected="a DataArray of reflectance on wavelength",
            mend="see read_certificate",
            code="type-wrong",
        )
    problems = Problems("references cannot be scaled by the panel", SchemaError)
    wavelength = convert(array["wavelength"], "nm").values.astype(np.float64)
    values = convert(array, "1", "panel").values.astype(np.float64)
    order = np.argsort(wavelength)
    wavelength, values = wavelength[order], values[order]
    if not (np.isfinite(wavelength).all() and np.isfinite(values).all() and (np.diff(wavelength) > 0).all()):
        problems.add("panel= has wavelengths twice, or values that are not finite", code="not-finite")
    elif not ((values > 0.0) & (values <= 1.2)).all():
        limits = f"{values.min():g} to {values.max():g}"
        problems.add(
            f"panel= has values from {limits}",
            expected="above 0, at most 1.2",
            mend="divide percent by 100",
            code="value-out-of-range",
        )
    problems.extend(
        Problem(
            f"reference {spectrum.name!r} is absolute already, or from a library",
            mend="remove the argument panel=",
            code="option-conflict",
        )
        for spectrum in spectra
        if spectrum.absolute
    )
    problems.raise_if_any()
    scaled = []
    for spectrum in spectra:
        factor = np.interp(spectrum.wavelength, wavelength, values, np.nan, np.nan)
        covariance = None if spectrum.covariance is None else spectrum.covariance * np.outer(factor, factor)
        notes = (*spectrum.notes, "scaled by the panel's certificate")
        scaled.append(spectrum.times(factor, covariance=covariance, absolute=True, notes=notes))
    return scaled


# --- clear coats -------------------------------------------------------------------------------------------

#: Zenith angle of the sun above which a degree of lean changes the direct light by more than the usual
#: tolerance, 5 % [degree].
_LOW_SUN_DEG = 70.0


def coat_of(attrs: Any) -> dict[str, Any]:
    # Return quantity, instrument geometry and index of the coat, by the attributes of a dataset.
    # ``quantity`` is one of the words of `hyperpaint.base.mirrored_light`; without it, ``specular_component``
    # determines the quantity.
    declared, index = attrs.get("quantity"), attrs.get("coat_index", COAT_INDEX)
    implied = OUTSIDE if attrs.get("specular_component") == INCLUDED else ""
    usable = isinstance(index, int | float) and 1.0 <= float(index) <= 3.0
    return {
        "quantity": declared if declared in (BODY, OUTSIDE, THROUGH_COAT) else implied,
        "geometry": str(attrs.get("measurement_geometry", "")),
        "coat_index": float(index) if usable else COAT_INDEX,
    }


def as_body(reference: Measured, signature: Measured) -> Measured:
    r"""Return a reading outside of a coat converted to the body under it, if the signature is of the body.

    The attribute ``measurement_geometry`` of the reference must be "0/0", "0/45", "45/0", or that of an
    integrating sphere, such as "d/8". Without it, or for a reading of the body, the reference is returned
    unchanged.

    Notes
    -----
    .. math:: R_{body} = (R - s F(0)) \frac{1 - F(0)}{1 - F_{in}}

    with s = 1 where the mirror image is included, and the interface's reflectance :math:`F_{in}` of the
    instrument's light.
    """
    if signature.quantity != BODY or reference.quantity != OUTSIDE:
        return reference
    # reflectance of the coat for the light of the instrument [1]
    index, angles = reference.coat_index, {"0/0": 0.0, "0/45": 45.0, "45/0": 45.0}
    if reference.geometry in angles:
        incident = float(interface_reflectance(angles[reference.geometry], index))
    elif reference.geometry in ("d/0", "0/d", "d/8", "8/d"):
        incident = float(sky_reflectance([550.0], None, index=index)[0])
    else:
        return reference
    normal = float(interface_reflectance(0.0, index))
    mirrored = normal if reference.mirror == INCLUDED and reference.geometry not in ("0/45", "45/0") else 0.0
    factor = (1.0 - normal) / (1.0 - incident)

    # uncertainty of the subtracted reflectance from that of the index, the largest part for black paint
    normal_u = float(mirrored > 0.0) * 4.0 * (index - 1.0) / (index + 1.0) ** 3 * COAT_INDEX_U
    known_u = 0.0 if reference.u_systematic is None else reference.u_systematic
    systematic = factor * np.hypot(known_u, normal_u) * np.ones_like(reference.values)

    note = (
        f"the reference, a reading of the coat's outside in {reference.geometry}, was converted to the body "
        f"under it: less {mirrored:.3f}, times {factor:.3f}"
    )
    return reference.times(
        factor,
        values=(reference.values - mirrored) * factor,
        u_systematic=systematic,
        covariance=None,  # it lacks the uncertainty of the index
        mirror=EXCLUDED,
        quantity=BODY,
        notes=(*reference.notes, note),
    )


def difference(signature: Measured, reference: Measured) -> str:
    """Return the difference in quantity of signature and reference, and the mend; empty for none."""
    quantity, reference_quantity = signature.quantity, reference.quantity
    if not quantity or not reference_quantity or quantity == reference_quantity:
        return ""
    mend = {
        BODY: "give the reference the attributes measurement_geometry and specular_component, or extract "
        "signatures with coat=False",
        OUTSIDE: "extract signatures without the mirrored sky (specular_sky=True, or --specular-sky)",
        THROUGH_COAT: "extract signatures with coat=True, or call correct_coat",
    }[quantity]
    return f"the signature is a {quantity}, the reference a {reference_quantity}: {mend}"


# --- datasets ----------------------------------------------------------------------------------------------

_MAX_DETECTORS = 8

#: Channel widths of the three detectors of FieldSpec 3/4 and HR-1024i, as their makers state them [nm].
_WIDTHS_NM: dict[str, tuple[float, ...]] = {"asd": (3.0, 10.0, 10.0), "svc": (3.5, 9.5, 6.5)}
_NAMES = {"asd": ("asd", "fieldspec", "handheld"), "svc": ("svc", "spectra vista", "hr-1024", "hr-768")}
#: Wavelengths between detectors, for files without gaps or overlaps at these [nm].
_DETECTOR_EDGES_NM = (1000.0, 1900.0)


def join_detectors(
    wavelength: Floats,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], tuple[float, ...]]:
    """Return the channels that form one increasing axis of wavelengths.

    Their positions in the file (channel,), the number of every channel's detector (channel,), and the
    wavelengths at which the next detector begins [nm].

    Where wavelengths fall, another detector begins. Two overlapping detectors are joined in the middle of
    their overlap: samples of different detectors are not averaged, since scale and resolution differ.

    ``wavelength`` (channel,): wavelengths in the order of the file [nm]; descending files are reversed.

    Raises `SchemaError`: Wavelengths are not finite, or in an order that no set of detectors has.

    Examples
    --------
    >>> order, _, joins = join_detectors(np.array([980.0, 990.0, 1000.0, 970.0, 988.0, 1006.0]))
    >>> order.tolist(), joins
    ([0, 4, 5], (985.0,))
    """
    if not (wavelength.size and np.isfinite(wavelength).all()):
        raise SchemaError("wavelengths must be finite, and at least one [nm]", code="not-finite")
    is_falling = (np.diff(wavelength) < 0).sum() > wavelength.size // 2
    order = np.arange(wavelength.size)[:: -1 if is_falling else 1]
    begins = np.flatnonzero(np.diff(wavelength[order]) <= 0) + 1
    detectors = np.split(order, begins)
    if len(detectors) > _MAX_DETECTORS:
        raise SchemaError(
            f"wavelengths fall {len(begins)} times",
            expected="an increasing axis, except where detectors join",
            mend="sort the spectrum",
            code="wavelengths-unordered",
        )
    channels, number, joins = detectors[0], np.zeros(detectors[0].size, np.intp), []
    for index, following in enumerate(detectors[1:], 1):
        join = float(0.5 * (wavelength[channels[-1]] + wavelength[following[0]]))
        below_join = wavelength[channels] <= join
        above_join = following[wavelength[following] > join]
        if not (below_join.any() and above_join.size):
            raise SchemaError(
                f"one detector's wavelengths lie within another's near {join:g} nm",
                mend="open the detectors as separate datasets",
                code="detectors-overlap",
            )
        channels = np.concatenate([channels[below_join], above_join])
        number = np.concatenate([number[below_join], np.full(above_join.size, index)])
        joins.append(join)
    return channels, number, tuple(joins)


def channel_widths(wavelength: Floats, detector: npt.NDArray[Any], instrument: str) -> tuple[Floats, str]:
    # Return usual widths of channels for data that do not state them, and the source of these widths.
    # ``wavelength`` (channel,): increasing wavelengths [nm]; ``detector`` (channel,): number of the detector;
    # ``instrument``: name of the instrument in the data.
    # Returns full widths at half maximum (channel,) [nm], and their source, for the reader of the result.
    lowered = instrument.lower()
    for make, names in _NAMES.items():
        if any(name in lowered for name in names):
            has_detectors = detector.max() > 0 and wavelength[0] < _DETECTOR_EDGES_NM[0]
            number = detector if has_detectors else np.searchsorted(_DETECTOR_EDGES_NM, wavelength, "right")
            widths = np.array(_WIDTHS_NM[make])[np.minimum(number, len(_DETECTOR_EDGES_NM))]
            return widths, f"widths of channels as usual for {make.upper()}"
    if wavelength.size < 2:
        return np.ones(wavelength.size), "widths of channels assumed, 1 nm"
    return 2.0 * np.gradient(wavelength), "widths of channels assumed, twice their distance"


UNKNOWN = "unknown"
_MIRRORS = ("included", "excluded")
_SPREADS = ("reflectance_u_random", "reflectance_u_systematic", "reflectance_sd")
#: Range of plausible channel widths: minimum [nm], and maximum in distances of channels.
_MIN_WIDTH_NM, _MAX_WIDTH_SPACINGS = 0.05, 100.0


def signatures_from(signatures: xr.Dataset) -> list[Measured]:
    # Return the spectra of a paint library; bad bands are NaN.
    # Raises `SchemaError`: It is not a paint library; all problems are listed. Raises `UnitsError`: Units
    # cannot be read.
    if not hasattr(signatures, "data_vars"):
        raise SchemaError(
            f"signatures are {type(signatures).__name__}",
            expected="a paint library (xarray.Dataset)",
            code="type-wrong",
        )
    return list(_library_spectra(signatures, 0, None, "band"))


def references_from(references: Any, fwhm: float | None) -> list[Measured]:
    # Return the spectra of spectrometer datasets and paint libraries.
    # ``references``: a Dataset, or several; ``fwhm``: width of channels [nm], if given by the user.
    # Raises `SchemaError`: Datasets that hold no reflectance; all are listed.
    datasets = [references] if hasattr(references, "data_vars") else references
    if isinstance(datasets, Mapping):
        datasets = list(datasets.values())
    if not isinstance(datasets, Iterable) or isinstance(datasets, str):
        raise SchemaError(
            f"references are {type(references).__name__}",
            expected="a Dataset, or several",
            mend="see open_svc",
            code="type-wrong",
        )
    problems = Problems("references cannot be used", SchemaError)
    spectra: list[Measured] = []
    for number, dataset in enumerate(datasets, 1):
        try:
            spectra += _dataset_spectra(dataset, number, fwhm)
        except (SchemaError, UnitsError) as error:
            problems.add_error(f"reference {number}", error)
    if not spectra and not problems:
        problems.add(
            "references= is empty",
            mend="open references with open_svc, open_asd or open_library",
            code="empty-input",
        )
    problems.raise_if_any()
    # serial numbers distinguish several instruments of one make
    serials: dict[str, set[str]] = {}
    for spectrum in spectra:
        serials.setdefault(spectrum.instrument, set()).add(spectrum.serial)
    return [
        replace(spectrum, instrument=f"{spectrum.instrument} {spectrum.serial}")
        if spectrum.serial and len(serials[spectrum.instrument]) > 1
        else spectrum
        for spectrum in spectra
    ]


def _dataset_spectra(dataset: Any, number: int, fwhm: float | None) -> Iterator[Measured]:
    if not hasattr(dataset, "data_vars"):
        raise SchemaError(f"{type(dataset).__name__}", expected="a Dataset", code="type-wrong")
    if "reflectance" not in dataset.data_vars:
        variables = ", ".join(map(str, dataset.data_vars)) or "nothing"
        raise SchemaError(
            f"holds {variables}",
            expected="reflectance",
            mend="open it with quantity='reflectance'",
            code="variable-missing",
        )
    dims = set(dataset["reflectance"].dims)
    if BAND in dims:
        return _library_spectra(dataset, number, fwhm, "library")
    if "wavelength" in dims and dims <= {"spectrum", "wavelength"}:
        return _spectrometer_spectra(dataset, number, fwhm)
    raise SchemaError(
        f"'reflectance' has dims ({', '.join(map(str, dataset['reflectance'].dims))})",
        expected="(spectrum, wavelength) of a spectrometer or (signature, band) of a library",
        code="dim-missing",
    )


# --- paint libraries ---------------------------------------------------------------------------------------


def _library_spectra(
    dataset: xr.Dataset, dataset_number: int, fwhm: float | None, default_instrument: str
) -> Iterator[Measured]:
    if SIGNATURE not in dataset.dims and BAND in dataset.dims:
        # a single paint, as isel returns it
        if SIGNATURE not in dataset.coords:
            label = f"reference {dataset_number}" if dataset_number else "signatures"
            dataset = dataset.assign_coords({SIGNATURE: label})
        dataset = dataset.expand_dims(SIGNATURE)
    optional = [name for name in (*_SPREADS, "fwhm", "n", "n_eff") if name in dataset.variables]
    purpose = "a validation"
    required = schema.require(dataset, [SIGNATURE, "reflectance", "wavelength"], purpose, LIBRARY_VARIABLES)
    arrays = {**required, **schema.find(dataset, optional, LIBRARY_VARIABLES)[0]}
    attrs = {**dataset.attrs, **dataset["reflectance"].attrs}
    values = arrays["reflectance"].values.astype(np.float64)
    if "good" in dataset.variables and dataset["good"].dims == (BAND,):
        values = np.where(dataset["good"].values.astype(bool), values, np.nan)
    channels = _Channels.of(
        arrays["wavelength"].values, arrays.get("fwhm"), fwhm, str(attrs.get("instrument", ""))
    )
    has_sources = {"reflectance_errors", *_SPREADS[:2]} <= set(dataset.variables)
    covariances = covariance(dataset).transpose(SIGNATURE, ...).values if has_sources else None
    for number, name in enumerate(arrays[SIGNATURE].values):
        spreads = {key: arrays[key].values[number] for key in _SPREADS if key in arrays}
        # the number of independent pixels if it is known: neighbours share errors
        counts = (float(arrays[key].values[number]) for key in ("n_eff", "n") if key in arrays)
        yield channels.spectrum(
            values[number],
            spreads,
            next((count for count in counts if np.isfinite(count)), None),
            names=Names(str(name), (frozenset({str(name)}), frozenset(), frozenset()), (dataset_number, "")),
            reference_name=_text_of(dataset, "reference", number, SIGNATURE),
            instrument=str(attrs.get("instrument", "")) or default_instrument,
            serial="",
            **_overlap_of(attrs.get("overlap"), attrs.get("overlap_matched", False)),
            mirror=mirror_reflection(dataset) or UNKNOWN,
            absolute=attrs.get("reflectance_scale", "absolute") == "absolute",
            covariance=None
            if covariances is None
            else covariances[number][np.ix_(channels.order, channels.order)],
            notes=(*channels.notes, *_light_notes(dataset, number)),
            **(coat_of(attrs) | _uncorrected_coat(dataset, number, attrs)),
        )


def _uncorrected_coat(dataset: xr.Dataset, number: int, attrs: Mapping[str, Any]) -> dict[str, str]:
    # The quantity of a paint without correction for its coat, in a library of corrected paints
    if attrs.get("quantity") != BODY or "coat_transmission" not in dataset.variables:
        return {}
    names = ("coat_transmission", "coat_transmission_u")
    shares = [dataset[name].values for name in names if name in dataset]
    if any(share.ndim != 2 for share in shares):
        return {}
    is_uncorrected = (shares[0][number] == 1.0).all() and all((u[number] == 0.0).all() for u in shares[1:])
    return {"quantity": THROUGH_COAT} if is_uncorrected else {}


def _light_notes(dataset: xr.Dataset, number: int) -> list[str]:
    # Reasons why the level of a signature is uncertain, for the reader of the result
    values = {
        name: dataset[name].isel({SIGNATURE: number}).values[()]
        for name in ("sun_zenith", "sky_state")
        if name in dataset.variables and dataset[name].dims == (SIGNATURE,)
    }
    has_split = "diffuse_fraction" in dataset.variables and SIGNATURE in dataset["diffuse_fraction"].dims
    has_split = has_split and bool(np.isfinite(dataset["diffuse_fraction"].isel({SIGNATURE: number})).all())
    notes, sun_zenith = [], float(values.get("sun_zenith", np.nan))
    if sun_zenith > _LOW_SUN_DEG:
        change = 100.0 * np.tan(np.radians(min(sun_zenith, 89.0))) * np.pi / 180.0
        notes.append(
            f"the sun stood {sun_zenith:.0f} degrees from the zenith: one degree of lean changes its light "
            f"by {change:.0f} %; judge the shape of the signature rather than its level"
        )
    if has_split and values.get("sky_state") == SKY_STATES.index("contradictory"):
        notes.append(
            "the irradiance record contradicted every sky at that time, so the level is uncertain: check "
            "clocks and the receiver's calibration, or give sun_zenith= to signatures"
        )
    return notes


# --- spectrometers -----------------------------------------------------------------------------------------


def _spectrometer_spectra(dataset: xr.Dataset, dataset_number: int, fwhm: float | None) -> Iterator[Measured]:
    if "spectrum" not in dataset["reflectance"].dims:
        dataset = dataset.expand_dims("spectrum")
    if "wavelength" not in dataset.coords:
        raise SchemaError(
            "the coordinate 'wavelength' of reflectance is missing [nm]", code="variable-missing"
        )
    order = ("spectrum", "wavelength")
    values = convert(dataset["reflectance"], "1").transpose(*order).values.astype(np.float64)
    wavelength = convert(dataset["wavelength"], "nm").values.astype(np.float64)
    spreads = {
        name: convert(dataset[name], "1").transpose(*order).values.astype(np.float64)
        for name in _SPREADS
        if name in dataset.variables and set(dataset[name].dims) == set(order)
    }
    has_widths = "fwhm" in dataset.variables and dataset["fwhm"].dims == ("wavelength",)
    widths = dataset["fwhm"] if has_widths else None
    attrs = {**dataset.attrs, **dataset["reflectance"].attrs}
    # number of every channel's detector, in the order of the file; None where it is not stated
    detectors = None
    if "detector" in dataset.variables and dataset["detector"].dims == ("wavelength",):
        names = [str(name) for name in dataset["detector"].values]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        detectors = np.array([numbers[name] for name in names], np.intp)
    channels = _Channels.of(wavelength, widths, fwhm, str(attrs.get("instrument", "")), detectors)
    for number, spectrum in enumerate(values):
        texts = [_text_of(dataset, key, number, "spectrum") for key in ("spectrum", "source", "name")]
        attributes = {
            key: _text_of(dataset, key, number, "spectrum") or attrs.get(key)
            for key in ("overlap", "mirror_reflection", "specular_component", "instrument")
        }
        mirror = attributes["mirror_reflection"] or attributes["specular_component"]
        count = dataset["n"].values[number] if "n" in dataset.variables and dataset["n"].dims else None
        yield channels.spectrum(
            spectrum,
            {name: array[number] for name, array in spreads.items()},
            None if count is None else float(count),
            names=names_of_spectrum(texts[0], texts[1], texts[2], number, dataset_number),
            reference_name="",
            instrument=str(attrs.get("instrument") or attributes["instrument"] or "spectrometer"),
            serial=_text_of(dataset, "instrument", number, "spectrum"),
            notes=(*channels.notes, *_instrument_errors(dataset, number)),
            **_overlap_of(attributes["overlap"], _flag_of(dataset, "overlap_matched", number)),
            mirror=mirror if mirror in _MIRRORS else UNKNOWN,
            absolute=attrs.get("reflectance_scale", "relative") == "absolute",
            **coat_of(attrs),
        )


def _text_of(dataset: xr.Dataset, key: str, number: int, dim: str) -> str:
    # Text of a variable for one spectrum; empty without such a text
    if key not in dataset.variables:
        return ""
    array = dataset[key]
    if array.dims not in ((dim,), ()) or array.dtype.kind not in "OUST":
        return ""
    value = array.values[number] if array.dims else array.values.item()
    return value if isinstance(value, str) else ""


def _flag_of(dataset: xr.Dataset, key: str, number: int) -> bool:
    if key not in dataset.variables:
        return bool(dataset.attrs.get(key, False))
    array = dataset[key]
    return bool(array.values[number] if array.dims == ("spectrum",) else array.values.any())


def _instrument_errors(dataset: xr.Dataset, number: int) -> list[str]:
    # Error bits of the scans, as the instrument recorded them
    errors = []
    for scan in ("target", "reference"):
        key = f"error_{scan}"
        if key in dataset.variables and dataset[key].dims in (("spectrum",), ()):
            bits = int(np.ravel(dataset[key].values)[number if dataset[key].dims else 0])
            if bits > 0:
                panel = " of the white panel" if scan == "reference" else ""
                errors.append(f"the instrument set error bits {bits} in the {scan} scan{panel}")
    return errors


def _overlap_of(text: Any, matched: Any) -> dict[str, Any]:
    overlap = text if isinstance(text, str) and text else UNKNOWN
    return {"overlap": overlap, "matched": bool(matched) or overlap == "matched"}


# --- channels ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Channels:
    # Channels on one increasing axis of wavelengths
    order: npt.NDArray[np.intp]  # (channel,): Positions in the data
    wavelength: Floats
    fwhm: Floats
    notes: tuple[str, ...]  # Joins of detectors, and the source of the widths

    @classmethod
    def of(
        cls, wavelength: Any, data_fwhm: Any, user_fwhm: float | None, instrument: str, detector: Any = None
    ) -> _Channels:
        # `data_fwhm`: widths in the data; `user_fwhm`: width that the user states
        wavelength = np.asarray(wavelength, np.float64)
        order, number, joins = join_detectors(wavelength)
        nm_sorted = wavelength[order]
        text = ", ".join(f"{nm:.4g}" for nm in joins)
        notes = [f"detectors joined at {text} nm"] if joins else []
        if user_fwhm is not None:
            _check_widths(np.array([user_fwhm]), nm_sorted)
            notes.append(f"widths of channels {user_fwhm:g} nm, as given")
            return cls(order, nm_sorted, np.full(nm_sorted.size, user_fwhm), tuple(notes))
        if data_fwhm is not None:
            fwhm = convert(data_fwhm, "nm").values.astype(np.float64)[order]
            if np.isfinite(fwhm).all() and (fwhm > 0).all():
                _check_widths(fwhm, nm_sorted)
                return cls(order, nm_sorted, fwhm, tuple(notes))
        channel_detector = number if detector is None else detector[order]
        fwhm, source = channel_widths(nm_sorted, channel_detector, instrument)
        return cls(order, nm_sorted, fwhm, (*notes, source))

    def spectrum(
        self, values: Floats, spreads: Mapping[str, Any], count: float | None, **description: Any
    ) -> Measured:
        # spreads in the order of wavelength; None without finite values
        u_random, u_systematic, sd = (
            np.asarray(spread, np.float64)[self.order]
            if (spread := spreads.get(name)) is not None and np.isfinite(spread[self.order]).any()
            else None
            for name in _SPREADS
        )
        return Measured(
            wavelength=self.wavelength,
            fwhm=self.fwhm,
            values=np.asarray(values, np.float64)[self.order],
            u_random=u_random,
            u_systematic=u_systematic,
            sd=sd,
            count=max(count, 1.0) if count is not None and np.isfinite(count) else 1.0,
            **{"notes": self.notes, **description},
        )


def _check_widths(fwhm: Floats, wavelength: Floats) -> None:
    # A single wrong width would determine the step of all responses
    spacing = float(np.median(np.diff(wavelength))) if wavelength.size > 1 else np.inf
    if not ((fwhm >= _MIN_WIDTH_NM) & (fwhm <= _MAX_WIDTH_SPACINGS * spacing)).all():
        raise SchemaError(
            f"'fwhm' is {np.min(fwhm):g} to {np.max(fwhm):g} nm",
            expected=f"{_MIN_WIDTH_NM:g} to {_MAX_WIDTH_SPACINGS * spacing:g} nm, {_MAX_WIDTH_SPACINGS:g} "
            "distances of channels",
            mend="correct it, or pass reference_fwhm=",
            code="value-out-of-range",
        )
