"""The tables and keys of a ``scene.toml``, and what each value must be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hyperpaint.io.files.toml_tables import Check, flag, number, one_of, positive, text, texts, time, whole
from hyperpaint.simulation.rendering.materials import KINDS
from hyperpaint.simulation.rendering.scene import INSTANCE_KINDS
from hyperpaint.simulation.rendering.scene_record import MOST_SAMPLES

__all__ = ["LISTS", "MATERIAL", "NAMED", "SCENE_KINDS", "SCHEMA"]

SCENE_KINDS = ("car_park", "plane", "empty")
"""Scenes that are made; any of them may hold meshes as well."""


def _between(lowest: float, highest: float) -> Check:
    def check(value: Any) -> str | None:
        good = number(value) is None and lowest <= value <= highest
        return None if good else f"a number from {lowest:g} to {highest:g}"

    return check


def _numbers(length: int) -> Check:
    def check(value: Any) -> str | None:
        good = isinstance(value, list) and len(value) == length and all(number(one) is None for one in value)
        return None if good else f"a list of {length} numbers"

    return check


def _number_or(length: int) -> Check:
    several = _numbers(length)

    def check(value: Any) -> str | None:
        good = number(value) is None or several(value) is None
        return None if good else f"a number or {several(value)}"

    return check


def _words(value: Any) -> str | None:
    """Expect a list of texts, which may be empty."""
    good = isinstance(value, list) and all(text(one) is None for one in value)
    return None if good else "a list of texts"


_share = _between(0.0, 1.0)

MATERIAL: Mapping[str, Check] = {
    "spectrum": text,
    "class": one_of(*KINDS),
    "coat_index": _between(1.0, 3.0),
    "coat_roughness": _share,
    "flakes": _share,
}
"""What a material of a mesh may say of itself."""


def _materials(value: Any) -> str | None:
    """Expect a table of spectra, or of tables of `MATERIAL`."""
    if not isinstance(value, dict):
        return "a table: name of a part = spectrum"
    for name, one in value.items():
        table = {"spectrum": one} if isinstance(one, str) else one
        if not isinstance(table, dict) or "spectrum" not in table:
            return f"for {name!r:.40} a spectrum, or a table with spectrum"
        for key, entry in table.items():
            wrong = (
                MATERIAL[key](entry)
                if key in MATERIAL
                else f"none of that name; known are {', '.join(MATERIAL)}"
            )
            if wrong is not None:
                return f"for {name!r:.40}.{key:.40} {wrong}"
    return None


_seed = whole(0, 2**63 - 1)

SCHEMA: Mapping[str, Mapping[str, Check]] = {
    "scene": {
        "name": text,
        "kind": one_of(*SCENE_KINDS),
        "seed": _seed,
        # of a plane
        "size_m": _number_or(2),
        "spectrum": text,
        # of a car park
        "length_m": _between(1.0, 2000.0),
        "width_m": _between(1.0, 500.0),
        "rows": whole(1, 100),
        "occupancy": _share,
        "paints": _words,
        "types": _words,
        "neighbours": _words,
        "panels": flag,
        "islands": flag,
        "coat": flag,
        "coat_index": _between(1.0, 3.0),
        "coat_roughness": _share,
        "line_width_m": _between(0.02, 1.0),
        "leaves": whole(0, 100_000),
        "margin_m": _between(0.0, 10_000.0),
    },
    "meshes": {
        "path": text,
        "name": text,
        "kind": one_of(*INSTANCE_KINDS),
        **MATERIAL,
        "materials": _materials,
        "offset_m": _numbers(3),
        "heading_deg": _between(-360.0, 360.0),
        "unit_m": positive,
        "up": one_of("x", "y", "z"),
    },
    "platform": {
        "lines": whole(1, 1_000_000),
        "columns": whole(1, 20_000),
        "altitude_m": positive,
        "ground_sample_m": positive,
        "ifov_mrad": positive,
        "speed_m_s": positive,
        "line_spacing_m": positive,
        "centre_m": _numbers(2),
        "start_m": _numbers(2),
        "heading_deg": _between(-360.0, 360.0),
        "exposure_time_ms": _between(0.0, 3.6e6),
        "frame_period_ms": positive,
        "wobble_deg": _number_or(3),
        "sway_m": _between(0.0, 100.0),
        "start_time": time,
        "seed": _seed,
    },
    "camera": {
        "bands": whole(2, 10_000),
        "first_wavelength_nm": positive,
        "last_wavelength_nm": positive,
        "dispersion_bow_nm": number,
        "fwhm_nm": positive,
        "fwhm_slope": number,
        "srf_shape": one_of("gaussian", "slit"),
        "smile_nm": number,
        "bit_depth": whole(1, 16),
        "electrons_per_count": positive,
        "read_noise": number,
        "dark_level": number,
        "dark_pattern": number,
        "dark_rate": number,
        "dark_frames": whole(1, 100_000),
        "nonuniformity": number,
        "column_nonuniformity": number,
        "bad_elements": whole(0, 2**40),
        "noise": flag,
        "seed": _seed,
    },
    "atmospheres": {
        "name": text,
        "preset": text,
        "table": text,
        "irradiance": texts,
        "time": time,
        "direct_fraction": _share,
        "sun_zenith_deg": _between(0.0, 89.0),
        "sun_azimuth_deg": _between(-360.0, 360.0),
        "aerosol": _between(0.0, 10.0),
        "water": _between(0.0, 100.0),
        "oktas": _between(0.0, 8.0),
        "overcast_share": _share,
    },
    "sampling": {
        "samples": whole(1, MOST_SAMPLES),
        "depth": whole(1, 16),
        "slots": whole(1, 1024),
        "seed": _seed,
        "sun_radius_deg": _between(0.0, 5.0),
    },
    "spectra": {},
    "paints": {},
    "output": {"product": one_of("radiance", "counts"), "true_reflectance": flag},
}
"""Check of every key of every table; the keys of `NAMED` are names."""

NAMED = ("spectra", "paints")
"""Tables whose keys are names of the user's, each with a text."""

LISTS = ("meshes", "atmospheres")
"""Tables that may be there several times."""
