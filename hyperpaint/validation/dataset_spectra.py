"""Spectra from paint libraries and spectrometer datasets, on one axis of wavelengths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError, UnitsError
from hyperpaint.base.mirrored_light import BODY, THROUGH_COAT, mirror_reflection
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.base.units import convert
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.paints.band_ratios import covariance

from .coat_readings import coat_of, light_notes
from .measured_spectra import Measured, names_of_paint, names_of_spectrum

_MAX_DETECTORS = 8

#: Channel widths of the three detectors of FieldSpec 3/4 and HR-1024i, as their makers state them [nm].
_WIDTHS_NM: dict[str, tuple[float, ...]] = {"asd": (3.0, 10.0, 10.0), "svc": (3.5, 9.5, 6.5)}
_NAMES = {"asd": ("asd", "fieldspec", "handheld"), "svc": ("svc", "spectra vista", "hr-1024", "hr-768")}
#: Wavelengths between detectors, for files without gaps or overlaps at these [nm].
_DETECTOR_EDGES_NM = (1000.0, 1900.0)


@dataclass(frozen=True, eq=False)
class Axis:
    """Channels in use, in the order of wavelength."""

    order: npt.NDArray[np.intp]  #: (channel,): Positions in the file.
    detector: npt.NDArray[np.intp]  #: (channel,): Number of the channel's detector.
    joins: tuple[float, ...]  #: Wavelengths at which the next detector begins [nm].


def join_detectors(wavelength: Floats) -> Axis:
    """Return the channels that form one increasing axis of wavelengths.

    Where wavelengths fall, another detector begins. Two overlapping detectors are joined in the middle of
    their overlap: samples of different detectors are not averaged, since scale and resolution differ.

    ``wavelength`` (channel,): wavelengths in the order of the file [nm]; descending files are reversed.

    Raises `SchemaError`: Wavelengths are not finite, or in an order that no set of detectors has.

    Examples
    --------
    >>> axis = join_detectors(np.array([980.0, 990.0, 1000.0, 970.0, 988.0, 1006.0]))
    >>> axis.order.tolist(), axis.joins
    ([0, 4, 5], (985.0,))
    """
    if not (wavelength.size and np.isfinite(wavelength).all()):
        raise SchemaError("wavelengths must be finite, and at least one [nm]", code="not-finite")
    order = np.arange(wavelength.size)
    if (np.diff(wavelength) < 0).sum() > wavelength.size // 2:
        order = order[::-1]
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
    return Axis(channels, number, tuple(joins))


def channel_widths(wavelength: Floats, detector: npt.NDArray[Any], instrument: str) -> tuple[Floats, str]:
    """Return usual widths of channels for data that do not state them, and the source of these widths.

    ``wavelength`` (channel,): increasing wavelengths [nm]; ``detector`` (channel,): number of the detector;
    ``instrument``: name of the instrument in the data.

    Returns full widths at half maximum (channel,) [nm], and their source, for the reader of the result.
    """
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
    """Return the spectra of a paint library; bad bands are NaN.

    Raises `SchemaError`: It is not a paint library; all problems are listed. Raises `UnitsError`: Units
    cannot be read.
    """
    if not hasattr(signatures, "data_vars"):
        raise SchemaError(
            f"signatures are {type(signatures).__name__}",
            expected="a paint library (xarray.Dataset)",
            code="type-wrong",
        )
    return list(_library_spectra(signatures, 0, None, "band"))


def references_from(references: Any, fwhm: float | None) -> list[Measured]:
    """Return the spectra of spectrometer datasets and paint libraries.

    ``references``: a Dataset, or several; ``fwhm``: width of channels [nm], if given by the user.

    Raises `SchemaError`: Datasets that hold no reflectance; all are listed.
    """
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
            names=names_of_paint(str(name), dataset_number),
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
    values = {
        name: dataset[name].isel({SIGNATURE: number}).values[()]
        for name in ("sun_zenith", "sky_state")
        if name in dataset.variables and dataset[name].dims == (SIGNATURE,)
    }
    has_split = "diffuse_fraction" in dataset.variables and SIGNATURE in dataset["diffuse_fraction"].dims
    has_split = has_split and bool(np.isfinite(dataset["diffuse_fraction"].isel({SIGNATURE: number})).all())
    contradictory = has_split and values.get("sky_state") == SKY_STATES.index("contradictory")
    return light_notes(float(values.get("sun_zenith", np.nan)), contradictory)


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
    widths = dataset["fwhm"] if "fwhm" in dataset.variables else None
    if widths is not None and widths.dims != ("wavelength",):
        widths = None
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
        axis = join_detectors(wavelength)
        nm_sorted = wavelength[axis.order]
        joins = ", ".join(f"{nm:.4g}" for nm in axis.joins)
        notes = [f"detectors joined at {joins} nm"] if joins else []
        if user_fwhm is not None:
            _check_widths(np.array([user_fwhm]), nm_sorted)
            notes.append(f"widths of channels {user_fwhm:g} nm, as given")
            return cls(axis.order, nm_sorted, np.full(nm_sorted.size, user_fwhm), tuple(notes))
        if data_fwhm is not None:
            fwhm = convert(data_fwhm, "nm").values.astype(np.float64)[axis.order]
            if np.isfinite(fwhm).all() and (fwhm > 0).all():
                _check_widths(fwhm, nm_sorted)
                return cls(axis.order, nm_sorted, fwhm, tuple(notes))
        channel_detector = axis.detector if detector is None else detector[axis.order]
        fwhm, source = channel_widths(nm_sorted, channel_detector, instrument)
        return cls(axis.order, nm_sorted, fwhm, (*notes, source))

    def spectrum(
        self, values: Floats, spreads: Mapping[str, Any], count: float | None, **description: Any
    ) -> Measured:
        u_random, u_systematic, sd = (_in_order(spreads.get(name), self.order) for name in _SPREADS)
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


def _in_order(spread: Any, order: npt.NDArray[np.intp]) -> Floats | None:
    # A spread in the order of wavelength; None without finite values
    if spread is None:
        return None
    ordered = np.asarray(spread, np.float64)[order]
    return ordered if np.isfinite(ordered).any() else None
