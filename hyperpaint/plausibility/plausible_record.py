"""Check that records of irradiance and navigation belong to the flight."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.variables import IRRADIANCE_TIME
from hyperpaint.radiometry.plausible_light import light_level

from .finding import KINDS, Finding


@dataclass(frozen=True)
class RecordRules:
    """Thresholds beyond which records do not belong to the flight.

    samples
        Fewest equal spectra in a row that are not a coincidence [1].
    still_factor
        Length of a standstill relative to the others of the record [1]: loggers write a reading several
        times.
    least_share, most_share
        Irradiance over a clear sky's [1]: a thunderstorm transmits 0.02, sides of clouds add 0.5.
    still_lines, still_share, still_m
        Fewest lines, share of the lines [1] with bit-identical positions, and extent of all positions [m]
        below which a platform does not move.
    turned
        Change of attitude that shows a camera turning in place [degree].
    gap_share
        Lines without a position or angle [1].
    """

    samples: int = 3
    still_factor: float = 3.0
    least_share: float = 0.015
    most_share: float = 3.6
    still_lines: int = 24
    still_share: float = 0.25
    still_m: float = 0.03
    turned: float = 5.0
    gap_share: float = 0.2


RULES = RecordRules()
_ANGLES = ("roll", "pitch", "heading")


def judge_irradiance(name: str, line: xr.Dataset) -> Iterator[Finding]:
    """Judge the record that lights a line."""
    if "irradiance" not in line:
        return
    spectra = line["irradiance"].transpose(IRRADIANCE_TIME, ...).values
    times = line[IRRADIANCE_TIME].values
    if not np.isfinite(spectra).any():
        yield Finding(
            KINDS["irradiance-level"],
            name,
            f"all {len(spectra)} spectra are zero or undefined",
            "daylight",
        )
        return
    yield from _judge_changes(name, spectra, times, line["time"].values)
    channels = line["irradiance_wavelength"].values.astype(np.float64)
    place = {key: line[key].values for key in ("latitude", "longitude") if key in line.coords}
    level = light_level(place, spectra, channels, times)
    share = level.median / level.clear
    if math.isfinite(share) and not RULES.least_share <= share <= RULES.most_share:
        slip = f", {level.slip}" if level.slip else ""
        yield Finding(
            KINDS["irradiance-level"],
            name,
            f"the median irradiance of 400-1000 nm is {level.median:.3g} W m-2 nm-1, {share:.2g} times "
            f"a clear sky's at its place and time{slip}",
            f"{RULES.least_share:g} to {RULES.most_share:g} times",
        )


def _judge_changes(name: str, spectra: Array, times: Array, flown: Array) -> Iterator[Finding]:
    same = (spectra[1:] == spectra[:-1]) | (np.isnan(spectra[1:]) & np.isnan(spectra[:-1]))
    same = same.all(axis=1) & np.isfinite(spectra[1:]).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2] + 1
    if not lengths.size or lengths.max() < RULES.samples:
        return
    longest = int(np.argmax(lengths))
    first, last = starts[longest], starts[longest] + lengths[longest] - 1
    others = float(np.median(np.delete(lengths, longest))) if lengths.size > 1 else 1.0
    flown = flown[~np.isnat(flown)]
    covers = flown.size and times[first] <= flown.min() and flown.max() <= times[last]
    if lengths[longest] == len(spectra) or (covers and lengths[longest] > RULES.still_factor * others):
        seconds = (times[last] - times[first]) / np.timedelta64(1, "s")
        yield Finding(
            KINDS["irradiance-constant"],
            name,
            f"{lengths[longest]} of {len(spectra)} spectra in a row are bit-identical, for {seconds:.3g} s",
            "spectra that differ, at least by noise",
        )


def judge_navigation(name: str, line: xr.Dataset) -> Iterator[Finding]:
    """Judge positions and angles of the lines."""
    if "latitude" not in line.coords:
        return
    timed = ~np.isnat(line["time"].values)
    if timed.sum() < RULES.still_lines:
        return
    pose = {
        key: line[key].values[timed]
        for key in ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
        if key in line.coords
    }
    gaps = {key: float(np.mean(~np.isfinite(values))) for key, values in pose.items()}
    # angles that were never measured are no gap: functions that need them ask for them
    gaps = {key: share for key, share in gaps.items() if share < 1.0 or key not in _ANGLES}
    if max(gaps.values()) > RULES.gap_share:
        lost = ", ".join(
            f"{key} {100 * share:.3g} %" for key, share in gaps.items() if share > RULES.gap_share
        )
        yield Finding(
            KINDS["navigation-gaps"],
            name,
            f"missing for the lines: {lost}",
            f"at most {100 * RULES.gap_share:g} %",
        )
    located = np.isfinite(pose["latitude"]) & np.isfinite(pose["longitude"])
    if located.sum() < RULES.still_lines:
        return
    north, east = np.radians(pose["latitude"][located]), np.radians(pose["longitude"][located])
    metres = 6.371e6 * np.stack([north, east * math.cos(float(north.mean()))])
    extent = float(np.hypot(*np.ptp(metres, axis=1)))
    angles = [pose[key][located] for key in _ANGLES if key in pose]
    finite = [values[np.isfinite(values)] for values in angles]
    turned = max(
        (float(np.ptp(np.unwrap(angle, period=360.0))) for angle in finite if angle.size), default=0.0
    )
    still = float(np.mean((np.diff(metres, axis=1) == 0.0).all(axis=0)))
    if turned < RULES.turned and (still > RULES.still_share or extent < RULES.still_m):
        yield Finding(
            KINDS["navigation-still"],
            name,
            f"positions stay the same over {100 * still:.3g} % of the lines, and lie within {extent:.3g} m",
            "a platform that moves between lines",
        )
