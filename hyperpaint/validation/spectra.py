"""Spectra as validation compares them, out of paint libraries and spectrometer datasets alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint import schema
from hyperpaint.errors import Problems, SchemaError, UnitsError
from hyperpaint.schema import BAND, LIBRARY_VARIABLES, PAINT
from hyperpaint.units import convert

from .detectors import channel_widths, join_detectors

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Measured", "references_from", "scaled_by_panel", "signatures_from"]

Float = npt.NDArray[np.float64]

UNKNOWN = "unknown"
_MIRRORS = ("included", "excluded")
_SUFFIXES = (".asd", ".sig", ".txt", ".tsv", ".csv")
_SPREADS = ("reflectance_u_random", "reflectance_u_systematic", "reflectance_sd")


@dataclass(frozen=True, eq=False)
class Measured:
    """One spectrum of reflectance, and what is known of it.

    Attributes
    ----------
    name
        As results tell it.
    aliases
        All names that it can be paired by.
    wanted
        Name of the reference that a signature asks for; empty where it does not.
    instrument
    wavelength, fwhm, values : (channel,), float64
        Increasing wavelengths [nm], widths of channels [nm], reflectance [1], NaN where there is none.
    u_random, u_systematic : (channel,) or None
        Standard uncertainties [1]: independent from channel to channel, and common to all.
    sd : (channel,) or None
        Standard deviation of what the spectrum is a mean of [1].
    count
        Of how many readings or pixels it is; 1 where that is not known.
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

    name: str
    aliases: frozenset[str]
    wanted: str
    instrument: str
    wavelength: Float
    fwhm: Float
    values: Float
    u_random: Float | None
    u_systematic: Float | None
    sd: Float | None
    count: float
    overlap: str
    matched: bool
    mirror: str
    absolute: bool
    notes: tuple[str, ...]

    @property
    def has_uncertainty(self) -> bool:
        """Whether anything is known of how uncertain it is."""
        return any(each is not None for each in (self.u_random, self.u_systematic, self.sd))

    def errors(self, rng: np.random.Generator, draws: int) -> Float:
        """Return what may be wrong with the values (draw, channel), at random.

        Random errors are independent, systematic ones common to all channels. Where neither is known, the
        standard deviation of the mean is taken for systematic: readings of a surface differ in level more
        than in shape.
        """
        made = np.zeros((draws, self.values.size))
        if self.u_random is not None:
            made += np.nan_to_num(self.u_random) * rng.standard_normal(made.shape)
        common = self.u_systematic
        if common is None and self.u_random is None and self.sd is not None:
            common = self.sd / np.sqrt(self.count)
        if common is not None:
            made += np.nan_to_num(common) * rng.standard_normal((draws, 1))
        return made


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
        msg = f"signatures are {type(signatures).__name__}, expected a paint library (xarray.Dataset)"
        raise SchemaError(msg)
    return list(_of_library(signatures, "signatures", None, "band"))


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
        msg = f"references are {type(references).__name__}, expected a Dataset, or several; see open_svc"
        raise SchemaError(msg)
    problems = Problems("references cannot be used", SchemaError)
    made: list[Measured] = []
    for number, dataset in enumerate(datasets, 1):
        try:
            made += _of_dataset(dataset, f"reference {number}", fwhm)
        except (SchemaError, UnitsError) as error:
            problems.add(f"reference {number}: {error}")
    if not made and not problems:
        problems.add("there is none; open some with open_svc, open_asd or open_library")
    problems.raise_if_any()
    return made


def _of_dataset(dataset: Any, label: str, fwhm: float | None) -> Iterator[Measured]:
    if not hasattr(dataset, "data_vars"):
        msg = f"{type(dataset).__name__}, expected a Dataset"
        raise SchemaError(msg)
    if "reflectance" not in dataset.data_vars:
        held = ", ".join(map(str, dataset.data_vars)) or "nothing"
        msg = f"holds {held}, expected reflectance; open it with quantity='reflectance'"
        raise SchemaError(msg)
    dims = set(dataset["reflectance"].dims)
    if BAND in dims:
        return _of_library(dataset, label, fwhm, "library")
    if "wavelength" in dims and dims <= {"spectrum", "wavelength"}:
        return _of_spectrometer(dataset, fwhm)
    msg = (
        f"'reflectance' has dims ({', '.join(map(str, dataset['reflectance'].dims))}), expected "
        "(spectrum, wavelength) of a spectrometer or (paint, band) of a library"
    )
    raise SchemaError(msg)


# --- paint libraries ---------------------------------------------------------------------------------------


def _of_library(dataset: xr.Dataset, label: str, fwhm: float | None, otherwise: str) -> Iterator[Measured]:
    if PAINT not in dataset.dims and BAND in dataset.dims:
        # one paint of a library, as isel gives it
        if PAINT not in dataset.coords:
            dataset = dataset.assign_coords({PAINT: label})
        dataset = dataset.expand_dims(PAINT)
    optional = [name for name in (*_SPREADS, "fwhm", "n") if name in dataset.variables]
    purpose = "a validation"
    required = schema.require(dataset, [PAINT, "reflectance", "wavelength"], purpose, LIBRARY_VARIABLES)
    found = {**required, **schema.find(dataset, optional, LIBRARY_VARIABLES)[0]}
    attrs = {**dataset.attrs, **dataset["reflectance"].attrs}
    values = found["reflectance"].values.astype(np.float64)
    if "good" in dataset.variables and dataset["good"].dims == (BAND,):
        values = np.where(dataset["good"].values.astype(bool), values, np.nan)
    channels = _Channels.of(
        found["wavelength"].values, found.get("fwhm"), fwhm, str(attrs.get("instrument", ""))
    )
    for number, name in enumerate(found[PAINT].values):
        own = {key: found[key].values[number] for key in _SPREADS if key in found}
        yield channels.spectrum(
            values[number],
            own,
            float(found["n"].values[number]) if "n" in found else None,
            name=str(name),
            aliases=frozenset({str(name)}),
            wanted=_text_of(dataset, "reference", number, PAINT),
            instrument=str(attrs.get("instrument", "")) or otherwise,
            **_overlap_of(attrs.get("overlap"), attrs.get("overlap_matched", False)),
            mirror=_mirror_of(attrs),
            absolute=attrs.get("reflectance_scale", "absolute") == "absolute",
        )


def _mirror_of(attrs: Mapping[str, Any]) -> str:
    told = _one_of(_MIRRORS, attrs.get("mirror_reflection"))
    if told == UNKNOWN and attrs.get("mirrored_sky_removed", "none") != "none":
        return "excluded"
    return told


# --- spectrometers -----------------------------------------------------------------------------------------


def _of_spectrometer(dataset: xr.Dataset, fwhm: float | None) -> Iterator[Measured]:
    if "spectrum" not in dataset["reflectance"].dims:
        dataset = dataset.expand_dims("spectrum")
    if "wavelength" not in dataset.coords:
        msg = "'wavelength' is missing, the coordinate of reflectance [nm]"
        raise SchemaError(msg)
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
        aliases = frozenset(alias for text in texts for alias in _aliases(text))
        told = {
            key: _text_of(dataset, key, number, "spectrum") or attrs.get(key)
            for key in ("overlap", "mirror_reflection", "instrument")
        }
        count = dataset["n"].values[number] if "n" in dataset.variables and dataset["n"].dims else None
        yield channels.spectrum(
            spectrum,
            {name: array[number] for name, array in spreads.items()},
            None if count is None else float(count),
            name=next((text for text in texts if text), f"spectrum {number}"),
            aliases=aliases,
            wanted="",
            instrument=str(attrs.get("instrument") or told["instrument"] or "spectrometer"),
            **_overlap_of(told["overlap"], _flag_of(dataset, "overlap_matched", number)),
            mirror=_one_of(_MIRRORS, told["mirror_reflection"]),
            absolute=attrs.get("reflectance_scale", "relative") == "absolute",
        )


def _detectors_of(dataset: xr.Dataset) -> npt.NDArray[np.intp] | None:
    """Return the number of every channel's detector in the order of the file; None where it is not told."""
    if "detector" not in dataset.variables or dataset["detector"].dims != ("wavelength",):
        return None
    names = [str(name) for name in dataset["detector"].values]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.array([numbers[name] for name in names], np.intp)


def _aliases(text: str) -> Iterator[str]:
    """Yield the names that a file, or a column of one, may be called by.

    Examples
    --------
    >>> sorted(set(_aliases("svc/red.asd.txt")))
    ['red', 'red.asd', 'red.asd.txt', 'svc/red.asd.txt']
    """
    if not text:
        return
    yield text
    for part in (text, text.rpartition(":")[2]):
        name = PurePath(part).name
        yield name
        while name.lower().endswith(_SUFFIXES):
            name = name[: name.rindex(".")]
            yield name


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


def _overlap_of(text: Any, matched: Any) -> dict[str, Any]:
    told = text if isinstance(text, str) and text else UNKNOWN
    return {"overlap": told, "matched": bool(matched) or told == "matched"}


def _one_of(known: tuple[str, ...], value: Any) -> str:
    return str(value) if value in known else UNKNOWN


# --- channels that the spectra of a dataset share ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Channels:
    """Channels that the spectra of a dataset share."""

    order: npt.NDArray[np.intp]
    wavelength: Float
    fwhm: Float
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
            return cls(
                axis.order, at, np.full(at.size, said), (*notes, f"widths of channels {said:g} nm, as said")
            )
        if held is not None:
            own = convert(held, "nm").values.astype(np.float64)[axis.order]
            if np.isfinite(own).all() and (own > 0).all():
                return cls(axis.order, at, own, tuple(notes))
        own_detector = axis.detector if detector is None else detector[axis.order]
        fwhm, source = channel_widths(at, own_detector, instrument)
        return cls(axis.order, at, fwhm, (*notes, source))

    def spectrum(
        self, values: Float, spreads: Mapping[str, Any], count: float | None, **about: Any
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
            notes=self.notes,
            **about,
        )


def _known(spread: Any, order: npt.NDArray[np.intp]) -> Float | None:
    if spread is None:
        return None
    own = np.asarray(spread, np.float64)[order]
    return own if np.isfinite(own).any() else None


# --- the panel ---------------------------------------------------------------------------------------------


def scaled_by_panel(spectra: list[Measured], panel: Any) -> list[Measured]:
    """Return references multiplied by the reflectance of the panel that they are relative to.

    Parameters
    ----------
    spectra
        References relative to the panel.
    panel
        Reflectance of the panel on ``wavelength``: a DataArray, or a Dataset with ``reflectance``. Linear
        between its wavelengths; outside of them it is not known, and neither is the reference.

    Raises
    ------
    SchemaError, UnitsError
        A reference is absolute already, or the panel is no certificate; all problems are listed.
    """
    array = panel["reflectance"] if hasattr(panel, "data_vars") and "reflectance" in panel else panel
    if not hasattr(array, "dims") or tuple(array.dims) != ("wavelength",) or "wavelength" not in array.coords:
        msg = "panel= must be a DataArray of reflectance on wavelength; see read_certificate"
        raise SchemaError(msg)
    problems = Problems("references cannot be scaled by the panel", SchemaError)
    wavelength = convert(array["wavelength"], "nm").values.astype(np.float64)
    values = convert(array, "1", "panel").values.astype(np.float64)
    order = np.argsort(wavelength)
    wavelength, values = wavelength[order], values[order]
    if not (np.isfinite(wavelength).all() and np.isfinite(values).all() and (np.diff(wavelength) > 0).all()):
        problems.add("panel= has wavelengths twice, or values that are not finite")
    elif not ((values > 0.0) & (values <= 1.2)).all():
        found = f"{values.min():g} to {values.max():g}"
        problems.add(f"panel= reaches from {found}, expected more than 0, at most 1.2; is it in percent?")
    for each in spectra:
        if each.absolute:
            problems.add(f"reference {each.name!r} is absolute already, or of a library; leave out panel=")
    problems.raise_if_any()
    return [_scaled(each, wavelength, values) for each in spectra]


def _scaled(spectrum: Measured, wavelength: Float, values: Float) -> Measured:
    factor = np.interp(spectrum.wavelength, wavelength, values, np.nan, np.nan)

    def times(spread: Float | None) -> Float | None:
        return None if spread is None else spread * factor

    return replace(
        spectrum,
        values=spectrum.values * factor,
        u_random=times(spectrum.u_random),
        u_systematic=times(spectrum.u_systematic),
        sd=times(spectrum.sd),
        absolute=True,
        notes=(*spectrum.notes, "scaled by the panel's certificate"),
    )
