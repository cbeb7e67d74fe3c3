"""The tables and keys of a ``collect.toml``, and what each value must be."""

from __future__ import annotations

from collections.abc import Mapping

from hyperpaint.io.files.toml_checks import (
    Check,
    flag,
    not_negative,
    number,
    one_of,
    positive,
    table,
    text,
    texts,
    time,
    whole,
)

__all__ = ["LISTS", "SCHEMA"]

_STAMP = one_of("start", "mid", "end")
SCHEMA: Mapping[str, Mapping[str, Check]] = {
    "collect": {"name": text, "description": text},
    "camera": {
        "bit_depth": whole(1, 16),
        "saturation_count": positive,
        "exposure_time_ms": positive,
        "frame_period_ms": positive,
        "stamp": _STAMP,
        "clock_offset_s": number,
        "time_scale": one_of("utc", "gps"),
        "gps_leap_seconds": whole(-100, 100),
        "fwhm_nm": positive,
        "radiance_units": text,
    },
    "navigation": {
        "roll_positive": one_of("right_wing_down", "right_wing_up"),
        "pitch_positive": one_of("nose_up", "nose_down"),
        "heading_positive": one_of("clockwise", "counterclockwise"),
        "heading_reference": one_of("true", "grid", "magnetic"),
        "euler_order": one_of("ZYX", "ZXY", "XYZ"),
        "height_reference": one_of("ellipsoid", "geoid"),
        "column_order": one_of("left_to_right", "right_to_left"),
        "declination": number,
        "geoid_undulation": number,
        "grid_crs": text,
    },
    "calibration": {"path": text, "sweep": text},
    "dark": {"cubes": texts},
    "irradiance": {
        "files": texts,
        "quantity": text,
        "utc_offset_h": number,
        "clock_offset_s": number,
        "stamp": _STAMP,
        "fwhm_nm": positive,
        "max_gap_s": positive,
        "clock_uncertainty_s": not_negative,
        "units": text,
        "averaging_s": number,
        "calibration": table,
    },
    "flightlines": {
        "id": text,
        "cube": text,
        "frame_index": text,
        "nav": text,
        "gps_time": text,
        "date": time,
        "start_time": time,
        "exposure_time_ms": positive,
        "frame_period_ms": positive,
        "keep_whole_lines": flag,
    },
    "references": {"instrument": text, "files": texts},
}
"""Check of every key of every table."""

LISTS = ("flightlines", "references")
"""Tables that may be there several times."""
