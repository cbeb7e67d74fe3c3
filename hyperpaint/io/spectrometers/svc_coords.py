"""Coordinates of SVC spectra: channels, times, places, and what their files say of themselves."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import VARIABLES

from .spectrum_files import listed, name_spectra
from .svc_fields import DETECTORS, SvcOverlap, error_bits, pair, position_of
from .svc_layout import SvcFile
from .svc_times import LocalStamp, orders_of, read_gps_time, read_stamp, utc_of

__all__ = [
    "SCANS",
    "SvcMeasurement",
    "coords_of_channels",
    "coords_of_files",
    "coords_of_places",
    "coords_of_times",
    "defined",
    "warn_of",
]


SCANS = ("reference", "target")
"""The two scans of a file, in its order."""

_HALF = 0.005  # half of the last of two decimals
_NAT = np.datetime64("NaT", "ns")
_NOWHERE = (math.nan, math.nan)


@dataclass(frozen=True, eq=False)
class SvcMeasurement:
    """One file in one quantity, on the channels that are used."""

    file: SvcFile
    path: Path
    overlap: SvcOverlap
    wavelength: Floats
    values: Floats
    detector: npt.NDArray[np.int64] | None
    trimmed_at: tuple[float, ...]

    @property
    def overlap_text(self) -> str:
        """What became of the channels where detectors overlap."""
        if self.trimmed_at:
            return f"trimmed @ {', '.join(f'{join:g}' for join in self.trimmed_at)} nm"
        return self.overlap.text


def defined(values: Floats) -> Floats:
    """Return the values with NaN for what is not finite."""
    return np.where(np.isfinite(values), values, np.nan)


def coords_of_channels(measured: Sequence[SvcMeasurement]) -> dict[str, Any]:
    """Return the wavelengths, and the detectors where all files tell the same."""
    first = measured[0]
    attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the spectrometer"}
    coords: dict[str, Any] = {"wavelength": ("wavelength", first.wavelength, attrs)}
    if first.detector is not None and all(
        one.detector is not None and np.array_equal(one.detector, first.detector) for one in measured
    ):
        names = np.array(DETECTORS, object)[first.detector]
        coords["detector"] = ("wavelength", names, {"long_name": "Detector of the channel"})
    return coords


def coords_of_times(
    contents: Sequence[SvcFile], side: int, quantity: str, dayfirst: bool | None, utc_offset_h: float | None
) -> dict[str, Any]:
    """Return UTC of the scans; of reflectance, of target and reference."""
    stamps = [[read_stamp(text) for text in pair(file.header, "time")] for file in contents]
    orders = orders_of(
        (file.header.get("instrument", ""), stamp)
        for file, both in zip(contents, stamps, strict=True)
        for stamp in both
        if stamp is not None
    )
    clock = _Clock(orders, dayfirst, utc_offset_h)
    names = {side: "time"} if quantity != "reflectance" else {0: "reference_time", 1: "time"}
    coords: dict[str, Any] = {}
    for scan, name in sorted(names.items(), reverse=True):
        times = [clock.utc(file, both[scan], scan) for file, both in zip(contents, stamps, strict=True)]
        what = "white reference" if scan == 0 else "target"
        coords[name] = (
            "spectrum",
            np.array(times, "datetime64[ns]"),
            {"long_name": f"UTC of the scan of the {what}"},
        )
    clock.warn()
    return coords


class _Clock:
    """Turns stamps into UTC, and gathers why some cannot be."""

    def __init__(self, orders: Mapping[str, bool], dayfirst: bool | None, utc_offset_h: float | None) -> None:
        self._orders = orders
        self._dayfirst = dayfirst
        self._utc_offset_h = utc_offset_h
        self._reasons: dict[str, dict[str, None]] = {}

    def _note(self, reason: str, file: SvcFile) -> np.datetime64:
        self._reasons.setdefault(reason, {})[file.name] = None
        return _NAT

    def utc(self, file: SvcFile, stamp: LocalStamp | None, scan: int) -> np.datetime64:
        """Return UTC of a scan, or NaT."""
        if stamp is None:
            return self._note("times that are missing or cannot be read are NaT", file)
        order = self._orders.get(file.header.get("instrument", ""))
        local = stamp.read(order if self._dayfirst is None and stamp.slashes else self._dayfirst)
        if local is None:
            return self._note("dates whose day and month may be either way are NaT; pass dayfirst=", file)
        gps = None
        try:
            gps = read_gps_time(pair(file.header, "gpstime")[scan])
        except ValueError:
            self._note("GPS times that cannot be read are left out", file)
        utc = utc_of(local, gps, (position_of(file.header, scan) or _NOWHERE)[1], self._utc_offset_h)
        if utc is None:
            return self._note("local times without GPS time are NaT; pass utc_offset_h=", file)
        if self._utc_offset_h is not None and gps is not None:
            apart = (local - utc).total_seconds() / 3600.0 - self._utc_offset_h
            if abs(apart) > 0.25:
                self._note(
                    f"utc_offset_h={self._utc_offset_h:+g} contradicts the GPS time, which is used", file
                )
        return np.datetime64(utc, "ns")

    def warn(self) -> None:
        """Say what was found, one line a reason."""
        for reason, names in self._reasons.items():
            warn_of(reason, list(names))


def coords_of_places(contents: Sequence[SvcFile], side: int) -> dict[str, Any]:
    """Return where the scans were taken, after the GPS; ``side`` is 0 for references, 1 for targets."""
    places = [position_of(file.header, side) for file in contents]
    unreadable = [file.name for file, place in zip(contents, places, strict=True) if place is None]
    warn_of("positions that cannot be read are NaN", unreadable)
    columns = np.array([place or _NOWHERE for place in places], np.float64).T
    return {
        name: (
            "spectrum",
            column,
            {**VARIABLES[name].attrs, "long_name": f"{name.capitalize()} of the spectrometer"},
        )
        for name, column in zip(("latitude", "longitude"), columns, strict=True)
    }


def coords_of_files(measured: Sequence[SvcMeasurement], quantity: str) -> dict[str, Any]:
    """Return names, instruments, and what the files say of overlap, matching and errors."""
    files = [one.file for one in measured]
    names = name_spectra([(one.path, one.path.name.removesuffix(one.path.suffix)) for one in measured])
    errors = np.array([error_bits(file.header) for file in files], np.int64)
    factors = np.array([one.overlap.factors for one in measured], np.float64)

    def text(values: Sequence[str], meaning: str) -> Any:
        return "spectrum", np.array(values, object), {"long_name": meaning}

    coords: dict[str, Any] = {
        "spectrum": text(names, "Name of the spectrum"),
        "source": text([file.name for file in files], "File"),
        "instrument": text([file.header.get("instrument", "") for file in files], "Instrument"),
        "overlap": text(
            [one.overlap_text for one in measured], "What became of channels where detectors overlap"
        ),
        "overlap_matched": (
            "spectrum",
            np.array([one.overlap.matched for one in measured], bool),
            {"long_name": "Whether values were changed to make detectors meet"},
        ),
        "factors": text(
            [file.header.get("factors", "") for file in files],
            "Matching of the detectors as the file says it",
        ),
        "header": text(
            [json.dumps(dict(file.header), ensure_ascii=False) for file in files],
            "Header of the file as JSON",
        ),
    }
    for scan, name in enumerate(SCANS):
        coords[f"factor_{name}"] = (
            "spectrum",
            factors[:, scan],
            {"long_name": f"VNIR over SWIR 1 in their overlap, scan of the {name}", "units": "1"},
        )
        coords[f"error_{name}"] = (
            "spectrum",
            errors[:, scan],
            {"long_name": f"Error bits of the instrument, scan of the {name}; -1 where unknown"},
        )
    if quantity == "reflectance":
        coords["column_difference"] = (
            "spectrum",
            _column_differences(files),
            {
                "long_name": "Largest distance of the file's own rounded reflectance from the recomputed",
                "units": "1",
            },
        )
    return coords


def _column_differences(files: Sequence[SvcFile]) -> Floats:
    """Return how far each file's fourth column is from the ratio; warn where rounding does not explain it."""
    made = np.full(len(files), np.nan)
    contradictory = []
    for place, file in enumerate(files):
        with np.errstate(all="ignore"):
            share = file.target / file.reference
            apart = np.abs(100.0 * share - file.percent)
            # every number of the file is rounded, the two scans as well as the ratio
            allowed = _HALF * (1.0 + 100.0 * (1.0 + np.abs(share)) / np.abs(file.reference))
            wrong = (apart > allowed * (1.0 + 1e-9) + 1e-9) | (
                np.isfinite(share) & ~np.isfinite(file.percent)
            )
        if np.isfinite(apart).any():
            made[place] = np.nanmax(np.where(np.isfinite(apart), apart, np.nan)) / 100.0
        if wrong.any():
            contradictory.append(f"{file.name} ({np.count_nonzero(wrong)} channels)")
    warn_of(
        "the reflectance in the file contradicts its two scans, whose ratio is used; was it edited or "
        "resampled?",
        contradictory,
    )
    return made


def warn_of(problem: str, names: Sequence[str]) -> None:
    """Warn of a problem, where any files have it."""
    if names:
        warnings.warn(f"{problem}. Files: {listed(names)}", PaintWarning, stacklevel=2)
