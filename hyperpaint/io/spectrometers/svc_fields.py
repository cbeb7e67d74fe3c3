"""What the header of an SVC file says: pairs of reference and target, matching factors, overlap, position."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .svc_layout import SvcFile, svc_number

__all__ = [
    "DETECTORS",
    "SvcOverlap",
    "detectors_of",
    "error_bits",
    "items",
    "overlap_of",
    "pair",
    "position_of",
]

DETECTORS = ("VNIR", "SWIR1", "SWIR2")

_ITEM = re.compile(r",(?=\s|$)")
_RECORD = re.compile(r"([^\[\]]*)\[([^\[\]]*)\]?")
_REMOVED = re.compile(r"remove\s*@\s*(\d{3,4})(?:[.,]0)?\s*,\s*(\d{3,4})(?![\d])", re.IGNORECASE)
_MATCHING = re.compile(r"matching type:\s*([^\]]*)", re.IGNORECASE)
_ANGLE = re.compile(r"(\d{3,5})[.,](\d{1,8})\s*,?\s*([NSEW])", re.ASCII | re.IGNORECASE)
_LONGEST = 2000  # characters of the line that are looked at
_BITS = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True)
class SvcOverlap:
    """What was done where detectors overlap, as the line ``factors`` says it.

    Attributes
    ----------
    kept
        True where all channels are there, False where channels were removed, None where the file is silent.
    joins
        Wavelengths [nm] at which the next detector takes over, where channels were removed.
    matching
        How detectors were matched (``Radiance @ 976 - 1010 / NIR-SWIR On``); ``None`` where they were not,
        empty where the file is silent. Matching scales the first detector by a ramp, and fades it into
        the second up to the end of the range that is named.
    factors
        VNIR over SWIR1 in the overlap, for reference and target; NaN where unknown.
    """

    kept: bool | None
    joins: tuple[float, float] | None
    matching: str
    factors: tuple[float, float]

    @property
    def matched(self) -> bool:
        """Whether the file says that its values were matched."""
        return self.matching.lower() not in ("", "none")

    @property
    def text(self) -> str:
        """In a word or two."""
        if self.joins is not None:
            return f"removed @ {self.joins[0]:g}, {self.joins[1]:g} nm"
        return {True: "preserved", False: "removed", None: "unknown"}[self.kept]


def items(value: str) -> list[str]:
    """Return the items of a list in the header; a comma without a blank behind it is a decimal comma.

    Examples
    --------
    >>> items("1000,0, 40,0, 10,0"), items("                ,                 ")
    (['1000,0', '40,0', '10,0'], ['', ''])
    """
    return [item.strip() for item in _ITEM.split(value)]


def pair(header: Mapping[str, str], key: str) -> tuple[str, str]:
    """Return the texts for reference and target, empty where there is none."""
    found = items(header.get(key, ""))
    return (found[0], found[1]) if len(found) == 2 else ("", found[0] if len(found) == 1 else "")


def overlap_of(header: Mapping[str, str]) -> SvcOverlap:
    """Return what the line ``factors`` says.

    A file that was processed again holds a record a time, the latest first.

    Examples
    --------
    >>> line = "0.795, 0.848, 1.000 [Overlap: Remove @ 970,1901, Matching Type: None]"
    >>> overlap_of({"factors": line})
    SvcOverlap(kept=False, joins=(970.0, 1901.0), matching='None', factors=(0.795, 0.848))
    """
    line = header.get("factors", "")[:_LONGEST]
    records = _RECORD.findall(line)
    numbers, latest = records[0] if records else (line, "")
    values = [svc_number(item) for item in items(numbers)]
    first, second = (math.nan if value is None else value for value in (*values, None, None)[:2])
    removed = _REMOVED.search(latest)
    word = latest.lower()
    kept = True if "preserve" in word else False if "remove" in word else None
    found = [match[1].strip() for _, record in records if (match := _MATCHING.search(record))]
    applied = [text for text in found if text.lower() != "none"]
    return SvcOverlap(
        kept=kept,
        joins=(float(removed[1]), float(removed[2])) if removed else None,
        matching=applied[0] if applied else found[0] if found else "",
        factors=(first, second),
    )


def error_bits(header: Mapping[str, str]) -> tuple[int, int]:
    """Return the instrument's error bits of reference and target, -1 where the file is silent."""
    first, second = (int(text) if _BITS.fullmatch(text) else -1 for text in pair(header, "error"))
    return first, second


def position_of(header: Mapping[str, str], scan: int) -> tuple[float, float] | None:
    """Return latitude and longitude [degree], north and east positive, NaN without a fix.

    None where something else stands there.

    Parameters
    ----------
    header
        Of the file.
    scan
        0 for the reference, 1 for the target.

    Examples
    --------
    >>> position_of({"latitude": "5230.0000N , 5215.0000S", "longitude": "01332.0665E, 01345.0000W"}, 1)
    (-52.25, -13.75)
    """
    try:
        latitude = _angle(header.get("latitude", ""), scan, "NS", 90.0)
        longitude = _angle(header.get("longitude", ""), scan, "EW", 180.0)
    except ValueError:
        return None
    missing = not math.isfinite(latitude + longitude) or latitude == longitude == 0.0
    return (math.nan, math.nan) if missing else (latitude, longitude)


def _angle(value: str, scan: int, letters: str, limit: float) -> float:
    found = items(value)
    # old firmware puts the letter behind a comma of its own: 11121.2335,W, 11121.2324,W
    text = found[scan] if len(found) == 2 else ""
    if not text.strip(", "):
        return math.nan
    match = _ANGLE.fullmatch(text)
    if match is None or match[3].upper() not in letters:
        raise ValueError
    degrees, minutes = int(match[1]) // 100, int(match[1]) % 100 + float(f"0.{match[2]}")
    angle = degrees + minutes / 60.0
    if minutes >= 60.0 or angle > limit:
        raise ValueError
    return -angle if match[3].upper() == letters[1] else angle


def detectors_of(file: SvcFile, joins: tuple[float, float] | None) -> npt.NDArray[np.int64] | None:
    """Return the number of the detector that each channel is of, None where the file does not tell."""
    if len(file.starts) > 1:
        number = np.zeros(len(file.wavelength), np.int64)
        for start in file.starts[1:]:
            number[start:] += 1
        return number
    return None if joins is None else np.searchsorted(np.array(sorted(joins)), file.wavelength)
