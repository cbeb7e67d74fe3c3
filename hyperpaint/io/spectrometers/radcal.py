"""Radiometric calibration of a field spectrometer as FRM4SOC and HyperCP exchange it: text of sections."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.reading import number, numbers, read_limited_text

_MAX_BYTES = 16 << 20
_MAX_ROWS = 100_000
_FIRST_LINES = ("!FRM4SOC_CP", "!RADCAL")
#: Number of columns of each table.
_TABLES = {"LAMPDATA": 4, "PANELDATA": 4, "CALDATA": 10}
_TEXTS = {
    "DEVICE": "device",
    "CALDATE": "calibration_time",
    "CALLAB": "laboratory",
    "LAMP_ID": "lamp",
    "PANEL_ID": "panel",
}
_NUMBERS = {"AMBIENT_TEMP": "ambient_temperature_degC", "DEVICE_TEMP": "device_temperature_degC"}
#: Factor from an expanded uncertainty (k = 2) in percent to a standard uncertainty as a fraction.
_STANDARD_PER_EXPANDED_PERCENT = 1.0 / 200.0


def read_radcal(path: str | os.PathLike[str]) -> xr.Dataset:
    r"""Read a radiometric calibration of FRM4SOC: lamp, panel and coefficients of a spectrometer.

    Parameters
    ----------
    path
        Text file that begins with ``!FRM4SOC_CP`` and ``!RADCAL``, with sections ``[LAMPDATA]``,
        ``[PANELDATA]`` and ``[CALDATA]``, such as ``CP_SAT0385_RADCAL_20220606105303.TXT``.

    Returns
    -------
    xarray.Dataset
        ``lamp_irradiance`` (lamp_wavelength) [W m-2 nm-1] at the lamp's distance; ``panel_reflectance``
        (panel_wavelength) [1]; ``panel_radiance`` (lamp_wavelength) [W m-2 sr-1 nm-1] of the panel under
        the lamp, NaN outside the wavelengths of its certificate; ``coefficient`` (wavelength), in units of
        the instrument's class, NaN where missing, ``dark`` and two series of ``counts`` (series,
        wavelength). The first two and the coefficient have a relative standard uncertainty each,
        ``..._u``, half of the file's value for k = 2. All float64. Attributes: device, time, laboratory,
        lamp, panel and temperatures.

    Raises
    ------
    FormatError
        The file is of another kind, or sections are missing or damaged; all problems are listed.

    Notes
    -----
    .. math:: L = E \rho / \pi

    of a panel of reflectance factor :math:`\rho` for 0 degrees to 45 under the lamp's irradiance :math:`E`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp(), "radcal.txt")
    >>> _ = path.write_text('''!FRM4SOC_CP
    ... !RADCAL
    ... [DEVICE]
    ... X1
    ... [LAMPDATA]
    ... 400 0 2.0 1.0
    ... 500 0 4.0 1.0
    ... [END_OF_LAMPDATA]
    ... [PANELDATA]
    ... 400 0 0.99 1.2
    ... 500 0 0.99 1.2
    ... [END_OF_PANELDATA]
    ... [CALDATA]
    ... 0 0 1024 0 0 0 1024 0 512 0
    ... 1 400 1e-4 1.5 10 0 900 1 901 1
    ... 2 410 1e-4 1.5 10 0 950 1 951 1
    ... [END_OF_CALDATA]
    ... ''')
    >>> lamp = read_radcal(path)
    >>> lamp.panel_radiance.values.round(4), lamp.lamp_irradiance_u.values
    (array([0.0006, 0.0013]), array([0.005, 0.005]))
    """
    path = Path(path)
    text = read_limited_text(path, _MAX_BYTES, "a radiometric calibration").decode("utf-8", "replace")
    lines = [line.strip() for line in text.splitlines()]
    if tuple(lines[:2]) != _FIRST_LINES:
        raise FormatError(
            f"{path} begins with {' '.join(lines[:2])[:60]!r}",
            expected=" and ".join(_FIRST_LINES),
            code="format-unknown",
        )
    problems = Problems(f"{path} cannot be used as a radiometric calibration", FormatError)
    sections = _sections(lines)
    tables = {name: _table(name, sections, columns, problems) for name, columns in _TABLES.items()}
    problems.raise_if_any()
    lamp_table, panel_table, channel_table = (tables[name] for name in _TABLES)
    channel_table = channel_table[1:]  # the first row holds integration times
    lamp_nm, lamp_irradiance = lamp_table[:, 0], lamp_table[:, 2] * 1e-3
    reflectance = np.interp(lamp_nm, panel_table[:, 0], panel_table[:, 2], np.nan, np.nan)
    has_coefficient = channel_table[:, 2] > 0
    values = {
        "lamp_irradiance": ("lamp_wavelength", lamp_irradiance, "W m-2 nm-1"),
        "lamp_irradiance_u": ("lamp_wavelength", lamp_table[:, 3] * _STANDARD_PER_EXPANDED_PERCENT, "1"),
        "panel_reflectance": ("panel_wavelength", panel_table[:, 2], "1"),
        "panel_reflectance_u": ("panel_wavelength", panel_table[:, 3] * _STANDARD_PER_EXPANDED_PERCENT, "1"),
        "panel_radiance": ("lamp_wavelength", lamp_irradiance * reflectance / np.pi, "W m-2 sr-1 nm-1"),
        "coefficient": ("wavelength", np.where(has_coefficient, channel_table[:, 2], np.nan), ""),
        "coefficient_u": (
            "wavelength",
            np.where(has_coefficient, channel_table[:, 3] * _STANDARD_PER_EXPANDED_PERCENT, np.nan),
            "1",
        ),
        "dark": ("wavelength", channel_table[:, 4], "count"),
        "counts": (("series", "wavelength"), channel_table[:, [6, 8]].T, "count"),
    }
    coords = {
        "lamp_wavelength": lamp_nm,
        "panel_wavelength": panel_table[:, 0],
        "wavelength": channel_table[:, 1],
    }
    attrs: dict[str, str | float] = {
        key: sections[name][0][1] for name, key in _TEXTS.items() if sections.get(name)
    }
    for name, key in _NUMBERS.items():
        value = number(sections[name][0][1]) if sections.get(name) else None
        if value is not None:
            attrs[key] = value
    return xr.Dataset(
        {
            name: (dims, value, {"units": units} if units else {})
            for name, (dims, value, units) in values.items()
        },
        {name: (name, value, {"units": "nm"}) for name, value in coords.items()},
        {**attrs, "source": path.name},
    )


def _sections(lines: list[str]) -> dict[str, list[tuple[int, str]]]:
    sections: dict[str, list[tuple[int, str]]] = {}
    section_rows: list[tuple[int, str]] | None = None
    for line_number, line in enumerate(lines, 1):
        if not line or line.startswith(("#", "!")):
            continue
        if line.startswith("[") and line.endswith("]"):
            name = line[1:-1].upper()
            section_rows = None if name.startswith("END_OF_") else sections.setdefault(name, [])
            if name.startswith("END_OF_"):
                sections[name] = []
        elif section_rows is not None:
            section_rows.append((line_number, line))
    return sections


def _table(name: str, sections: dict[str, list[tuple[int, str]]], columns: int, problems: Problems) -> Floats:
    # Return the numbers of a section (row, column); note faults in ``problems``.
    rows = sections.get(name, [])
    if len(rows) < 2 or f"END_OF_{name}" not in sections or len(rows) > _MAX_ROWS:
        problems.add(
            f"[{name}] has {len(rows)} rows",
            expected=f"at least two up to [END_OF_{name}]",
            code="table-missing",
        )
        return np.zeros((0, columns))
    table = []
    for line_number, text in rows:
        cells = numbers(text.split())
        if cells is None or len(cells) != columns:
            problems.add(
                f"line {line_number}: {text[:60]!r}",
                expected=f"{columns} numbers of [{name}]",
                code="row-unreadable",
            )
            return np.zeros((0, columns))
        table.append(cells)
    values = np.array(table, np.float64)
    wavelengths = values[1:, 1] if name == "CALDATA" else values[:, 0]
    if not np.isfinite(values).all() or (np.diff(wavelengths) <= 0).any():
        problems.add(
            f"[{name}] has wavelengths that do not increase, or values that are not finite",
            code="wavelength-unordered",
        )
    return values
