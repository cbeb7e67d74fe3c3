"""Spectra as validation compares them, out of paint libraries and spectrometer datasets alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError, UnitsError
from hyperpaint.base.mirrored_light import mirror_reflection
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, PAINT
from hyperpaint.base.units import convert

from .detectors import channel_widths, join_detectors
from .names import Names, names_of_paint, names_of_spectrum

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Measured", "references_from", "signatures_from"]


UNKNOWN = "unknown"
_MIRRORS = ("included", "excluded")
_SPREADS = ("reflectance_u_random", "reflectance_u_systematic", "reflectance_sd")
_NARROWEST, _WIDEST = 0.05, 100.0
"""Of widths of channels, [nm] and in distances of channels; what is beyond is a mistake of the data."""


@dataclass(frozen=True, eq=False)
class Measured:
    """One spectrum of reflectance, and what is known of it.

    Attributes
    ----------
    names
        What it can be paired by, and where it is from.
    wanted
        Name of the reference that a signature asks for; empty where it does not.
    instrument
        Its make.
    serial
        What else its data say of the instrument, mostly a serial number; may be empty.
    wavelength, fwhm, values : (channel,), float64
        Increasing wavelengths [nm], widths of channels [nm], reflectance [1], NaN where there is none.
    u_random, u_systematic : (channel,) or None
        Standard uncertainties [1]: independent from channel to channel, and common to all.
    sd : (channel,) or None
        Standard deviation of what the spectrum is a mean of [1].
    count
        Of how many readings or independent pixels it is; 1 where that is not known.
    overlap
        What was done with channels where detectors overlap, as the reader says it: preserved, removed or
        unknown.
    matched
        Whether values were changed there, to make detectors meet.
    mirror
        Whether the mirror image of sky and surroundings is included, excluded, or unknown.
    absolute
        Whether reflectance is of a perfect diffuser, rather than of a panel.
    notes
        What else a reader of results should know.
    """

    names: Names
    wanted: str
    instrument: str
    serial: str
    wavelength: Floats
    fwhm: Floats
    values: Floats
    u_random: Floats | None
    u_systematic: Floats | None
    sd: Floats | None
    count: float
    overlap: str
    matched: bool
    mirror: str
    absolute: bool
    notes: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name as results tell it."""
        return self.names.shown

    @property
    def has_uncertainty(self) -> bool:
        """Whether anything is known of how uncertain it is."""
        return any(each is not None for each in (self.u_random, self.u_systematic, self.sd))

    def gaps(self) -> list[str]:
        """Return what is not known of the uncertainty, for a reader of the result."""
        if self.u_random is None and self.u_systematic is None:
            return []
        gaps, there = [], np.isfinite(self.values)
        for name, spread, other in (
            ("random", self.u_random, "systematic"),
            ("systematic", self.u_systematic, "random"),
        ):
            if spread is None:
                gaps.append(f"{other} part only, the {name} one is not known")
            elif not np.isfinite(spread[there]).all():
                count = int(np.isfinite(spread[there]).sum())
                gaps.append(
                    f"{name} part known in {count} of {int(there.sum())} channels; elsewhere none is told"
                )
        return gaps

    def errors(self, rng: np.random.Generator, draws: int) -> Floats:
        """Return what may be wrong with the values (draw, channel), at random.

        Random errors are independent, systematic ones common to all channels. Where neither is known, the
        standard deviation of the mean is taken for systematic: readings of a surface differ in level more
        than in shape. NaN where one of them is known of other channels, but not there.
        """
        errors = np.zeros((draws, self.values.size))
        if self.u_random is not None:
            errors += self.u_random * rng.standard_normal(errors.shape)
        common = self.u_systematic
        if common is None and self.u_random is None and self.sd is not None:
            common = self.sd / np.sqrt(self.count)
        if common is not None:
            errors += common * rng.standard_normal((draws, 1))
        return errors


def signatures_from(signatures: xr.Dataset) -> list[Measured]:
    """Return the spectra of a paint library; what is not ``good`` is NaN.

    Raises
    ------
    SchemaError
        It is no paint library; all problems are listed.
    UnitsError
        Units cannot be read.
    """
    if not hasattr(signatures, "data_vars"):
        raise SchemaError(
            f"signatures are {type(signatures).__name__}, expected a paint library (xarray.Dataset)"
        )
    return list(_of_library(signatures, 0, None, "band"))


def references_from(references: Any, fwhm: float | None) -> list[Measured]:
    """Return the spectra of spectrometer datasets and paint libraries.

    Parameters
    ----------
    references
        A Dataset, or several.
    fwhm
        Width of channels [nm], where the user says it.

    Raises
    ------
    SchemaError
        Datasets that hold no reflectance; all are listed.
    """
    datasets = [references] if hasattr(references, "data_vars") else references
    if isinstance(datasets, Mapping):
        datasets = list(datasets.values())
    if not isinstance(datasets, Iterable) or isinstance(datasets, str):
        raise SchemaError(
            f"references are {type(references).__name__}, expected a Dataset, or several; see open_svc"
        )
    problems = Problems("references cannot be used", SchemaError)
    spectra: list[Measured] = []
    for number, dataset in enumerate(datasets, 1):
        try:
            spectra += _of_dataset(dataset, number, fwhm)
        except (SchemaError, UnitsError) as error:
            problems.add(f"reference {number}: {error}")
    if not spectra and not problems:
        problems.add("there is none; open some with open_svc, open_asd or open_library")
    problems.raise_if_any()
    return _told_apart(spectra)


def _told_apart(spectra: Sequence[Measured]) -> list[Measured]:
    """Return spectra whose instruments of one make are named by serial number, where there are several."""
    serials: dict[str, set[str]] = {}
    for each in spectra:
        serials.setdefault(each.instrument, set()).add(each.serial)
    return [
        replace(each, instrument=f"{each.instrument} {each.serial}")
        if each.serial and len(serials[each.instrument]) > 1
        else each
        for each in spectra
    ]


def _of_dataset(dataset: Any, number: int, fwhm: float | None) -> Iterator[Measured]:
    if not hasattr(dataset, "data_vars"):
        raise SchemaError(f"{type(dataset).__name__}, expected a Dataset")
    if "reflectance" not in dataset.data_vars:
        held = ", ".join(map(str, dataset.data_vars)) or "nothing"
        raise SchemaError(f"holds {held}, expected reflectance; open it with quantity='reflectance'")
    dims = set(dataset["reflectance"].dims)
    if BAND in dims:
        return _of_library(dataset, number, fwhm, "library")
    if "wavelength" in dims and dims <= {"spectrum", "wavelength"}:
        return _of_spectrometer(dataset, number, fwhm)
    raise SchemaError(
        f"'reflectance' has dims ({', '.join(map(str, dataset['reflectance'].dims))}), expected "
        "(spectrum, wavelength) of a spectrometer or (paint, band) of a library"
    )


# --- paint libraries ---------------------------------------------------------------------------------------


def _of_library(
    dataset: xr.Dataset, dataset_number: int, fwhm: float | None, otherwise: str
) -> Iterator[Measured]:
    if PAINT not in dataset.dims and BAND in dataset.dims:
        # one paint of a library, as isel gives it
        if PAINT not in dataset.coords:
            label = f"reference {dataset_number}" if dataset_number else "signatures"
            dataset = dataset.assign_coords({PAINT: label})
        dataset = dataset.expand_dims(PAINT)
    optional = [name for name in (*_SPREADS, "fwhm", "n", "n_eff") if name in dataset.variables]
    purpose = "a validation"
    required = schema.require(dataset, [PAINT, "reflectance", "wavelength"], purpose, LIBRARY_VARIABLES)
    arrays = {**required, **schema.find(dataset, optional, LIBRARY_VARIABLES)[0]}
    attrs = {**dataset.attrs, **dataset["reflectance"].attrs}
    values = arrays["reflectance"].values.astype(np.float64)
    if "good" in dataset.variables and dataset["good"].dims == (BAND,):
        values = np.where(dataset["good"].values.astype(bool), values, np.nan)
    channels = _Channels.of(
        arrays["wavelength"].values, arrays.get("fwhm"), fwhm, str(attrs.get("instrument", ""))
    )
    for number, name in enumerate(arrays[PAINT].values):
        own = {key: arrays[key].values[number] for key in _SPREADS if key in arrays}
        yield channels.spectrum(
            values[number],
            own,
            _count_of(arrays, number),
            names=names_of_paint(str(name), dataset_number),
            wanted=_text_of(dataset, "reference", number, PAINT),
            instrument=str(attrs.get("instrument", "")) or otherwise,
            serial="",
            **_overlap_of(attrs.get("overlap"), attrs.get("overlap_matched", False)),
            mirror=mirror_reflection(dataset) or UNKNOWN,
            absolute=attrs.get("reflectance_scale", "absolute") == "absolute",
        )


def _count_of(arrays: Mapping[str, Any], number: int) -> float | None:
    """Return how many independent pixels a paint is of: neighbours share what is wrong with them."""
    counts = (float(arrays[name].values[number]) for name in ("n_eff", "n") if name in arrays)
    return next((count for count in counts if np.isfinite(count)), None)


# --- spectrometers -----------------------------------------------------------------------------------------


def _of_spectrometer(dataset: xr.Dataset, dataset_number: int, fwhm: float | None) -> Iterator[Measured]:
    if "spectrum" not in dataset["reflectance"].dims:
        dataset = dataset.expand_dims("spectrum")
    if "wavelength" not in dataset.coords:
        raise SchemaError("'wavelength' is missing, the coordinate of reflectance [nm]")
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
    channels = _Channels.of(
        wavelength, widths, fwhm, str(attrs.get("instrument", "")), _detectors_of(dataset)
    )
    for number, spectrum in enumerate(values):
        texts = [_text_of(dataset, key, number, "spectrum") for key in ("spectrum", "source", "name")]
        texts_of = {
            key: _text_of(dataset, key, number, "spectrum") or attrs.get(key)
            for key in ("overlap", "mirror_reflection", "instrument")
        }
        count = dataset["n"].values[number] if "n" in dataset.variables and dataset["n"].dims else None
        yield channels.spectrum(
            spectrum,
            {name: array[number] for name, array in spreads.items()},
            None if count is None else float(count),
            names=names_of_spectrum(texts[0], texts[1], texts[2], number, dataset_number),
            wanted="",
            instrument=str(attrs.get("instrument") or texts_of["instrument"] or "spectrometer"),
            serial=_text_of(dataset, "instrument", number, "spectrum"),
            notes=(*channels.notes, *_errors_told(dataset, number)),
            **_overlap_of(texts_of["overlap"], _flag_of(dataset, "overlap_matched", number)),
            mirror=_one_of(_MIRRORS, texts_of["mirror_reflection"]),
            absolute=attrs.get("reflectance_scale", "relative") == "absolute",
        )


def _detectors_of(dataset: xr.Dataset) -> npt.NDArray[np.intp] | None:
    """Return the number of every channel's detector in the order of the file; None where it is not told."""
    if "detector" not in dataset.variables or dataset["detector"].dims != ("wavelength",):
        return None
    names = [str(name) for name in dataset["detector"].values]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.array([numbers[name] for name in names], np.intp)


def _text_of(dataset: xr.Dataset, key: str, number: int, dim: str) -> str:
    """Return the text that a coordinate has for one spectrum; empty where there is none."""
    if key not in dataset.variables:
        return ""
    held = dataset[key]
    if held.dims not in ((dim,), ()) or held.dtype.kind not in "OUST":
        return ""
    value = held.values[number] if held.dims else held.values.item()
    return value if isinstance(value, str) else ""


def _flag_of(dataset: xr.Dataset, key: str, number: int) -> bool:
    if key not in dataset.variables:
        return bool(dataset.attrs.get(key, False))
    held = dataset[key]
    return bool(held.values[number] if held.dims == ("spectrum",) else held.values.any())


def _errors_told(dataset: xr.Dataset, number: int) -> list[str]:
    """Return what the instrument said was wrong with the scans."""
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


def _one_of(choices: tuple[str, ...], value: Any) -> str:
    return str(value) if value in choices else UNKNOWN


# --- channels that the spectra of a dataset share ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Channels:
    """Channels that the spectra of a dataset share."""

    order: npt.NDArray[np.intp]
    wavelength: Floats
    fwhm: Floats
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls, wavelength: Any, held: Any, said: float | None, instrument: str, detector: Any = None
    ) -> _Channels:
        """Return channels on one increasing axis; ``held`` are widths of the data, ``said`` the user's."""
        wavelength = np.asarray(wavelength, np.float64)
        axis = join_detectors(wavelength)
        at = wavelength[axis.order]
        notes = (
            [f"detectors joined at {', '.join(f'{nm:.4g}' for nm in axis.joins)} nm"] if axis.joins else []
        )
        if said is not None:
            _check_widths(np.array([said]), at)
            return cls(
                axis.order, at, np.full(at.size, said), (*notes, f"widths of channels {said:g} nm, as said")
            )
        if held is not None:
            own = convert(held, "nm").values.astype(np.float64)[axis.order]
            if np.isfinite(own).all() and (own > 0).all():
                _check_widths(own, at)
                return cls(axis.order, at, own, tuple(notes))
        own_detector = axis.detector if detector is None else detector[axis.order]
        fwhm, source = channel_widths(at, own_detector, instrument)
        return cls(axis.order, at, fwhm, (*notes, source))

    def spectrum(
        self, values: Floats, spreads: Mapping[str, Any], count: float | None, **about: Any
    ) -> Measured:
        """Return one spectrum on these channels; a spread whose every value is missing is not known."""
        u_random, u_systematic, sd = (_known(spreads.get(name), self.order) for name in _SPREADS)
        return Measured(
            wavelength=self.wavelength,
            fwhm=self.fwhm,
            values=np.asarray(values, np.float64)[self.order],
            u_random=u_random,
            u_systematic=u_systematic,
            sd=sd,
            count=max(count, 1.0) if count is not None and np.isfinite(count) else 1.0,
            **{"notes": self.notes, **about},
        )


def _check_widths(fwhm: Floats, wavelength: Floats) -> None:
    """Refuse widths of channels that no instrument has: one alone sets the step of all responses."""
    spacing = float(np.median(np.diff(wavelength))) if wavelength.size > 1 else np.inf
    if not ((fwhm >= _NARROWEST) & (fwhm <= _WIDEST * spacing)).all():
        raise SchemaError(
            f"'fwhm' reaches from {np.min(fwhm):g} to {np.max(fwhm):g} nm, expected {_NARROWEST:g} to "
            f"{_WIDEST * spacing:g} nm, {_WIDEST:g} distances of channels; correct it, or pass "
            "reference_fwhm="
        )


def _known(spread: Any, order: npt.NDArray[np.intp]) -> Floats | None:
    if spread is None:
        return None
    own = np.asarray(spread, np.float64)[order]
    return own if np.isfinite(own).any() else None
