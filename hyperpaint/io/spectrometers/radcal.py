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
_FIRST = ("!FRM4SOC_CP", "!RADCAL")
#: Columns of the tables; of the last, two are the instrument's own.
_TABLES = {"LAMPDATA": 4, "PANELDATA": 4, "CALDATA": 10}
_TEXTS = {
    "DEVICE": "device",
    "CALDATE": "calibration_time",
    "CALLAB": "laboratory",
    "LAMP_ID": "lamp",
    "PANEL_ID": "panel",
}
_NUMBERS = {"AMBIENT_TEMP": "ambient_temperature_degC", "DEVICE_TEMP": "device_temperature_degC"}
#: Standard uncertainty, a fraction, of an expanded one (k = 2) in percent.
_HALF_OF_PERCENT = 1.0 / 200.0


def read_radcal(path: str | os.PathLike[str]) -> xr.Dataset:
    r"""Read a radiometric calibration of FRM4SOC: lamp, panel and coefficients of a spectrometer.

    Parameters
    ----------
    path
        Text that begins ``!FRM4SOC_CP``, ``!RADCAL``, with sections ``[LAMPDATA]``, ``[PANELDATA]`` and
        ``[CALDATA]``, such as ``CP_SAT0385_RADCAL_20220606105303.TXT``.

    Returns
    -------
    xarray.Dataset
        ``lamp_irradiance`` (lamp_wavelength) [W m-2 nm-1] at the lamp's distance; ``panel_reflectance``
        (panel_wavelength) [1]; ``panel_radiance`` (lamp_wavelength) [W m-2 sr-1 nm-1] of the panel under
        the lamp, NaN outside the wavelengths of its certificate; ``coefficient`` (wavelength), in units of
        the instrument's class, NaN where missing, ``dark`` and two series of ``counts`` (series,
        wavelength). With each of the first two and the coefficient comes a relative standard uncertainty,
        ``..._u``, half of what the file gives for k = 2. All float64. Attributes: device, time, laboratory,
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
    if tuple(lines[:2]) != _FIRST:
        raise FormatError(
            f"{path} begins {' '.join(lines[:2])[:60]!r}",
            expected=" and ".join(_FIRST),
            code="format-unknown",
        )
    problems = Problems(f"{path} cannot be used as a radiometric calibration", FormatError)
    sections = _sections(lines)
    tables = {name: _table(name, sections, columns, problems) for name, columns in _TABLES.items()}
    problems.raise_if_any()
    lamp, panel, device = (tables[name] for name in _TABLES)
    device = device[1:]  # the first row holds integration times
    lamp_nm, lamp_irradiance = lamp[:, 0], lamp[:, 2] * 1e-3
    reflectance = np.interp(lamp_nm, panel[:, 0], panel[:, 2], np.nan, np.nan)
    is_known = device[:, 2] > 0
    values = {
        "lamp_irradiance": ("lamp_wavelength", lamp_irradiance, "W m-2 nm-1"),
        "lamp_irradiance_u": ("lamp_wavelength", lamp[:, 3] * _HALF_OF_PERCENT, "1"),
        "panel_reflectance": ("panel_wavelength", panel[:, 2], "1"),
        "panel_reflectance_u": ("panel_wavelength", panel[:, 3] * _HALF_OF_PERCENT, "1"),
        "panel_radiance": ("lamp_wavelength", lamp_irradiance * reflectance / np.pi, "W m-2 sr-1 nm-1"),
        "coefficient": ("wavelength", np.where(is_known, device[:, 2], np.nan), ""),
        "coefficient_u": ("wavelength", np.where(is_known, device[:, 3] * _HALF_OF_PERCENT, np.nan), "1"),
        "dark": ("wavelength", device[:, 4], "count"),
        "counts": (("series", "wavelength"), device[:, [6, 8]].T, "count"),
    }
    coords = {"lamp_wavelength": lamp_nm, "panel_wavelength": panel[:, 0], "wavelength": device[:, 1]}
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
    current: list[tuple[int, str]] | None = None
    for place, line in enumerate(lines, 1):
        if not line or line.startswith(("#", "!")):
            continue
        if line.startswith("[") and line.endswith("]"):
            name = line[1:-1].upper()
            current = None if name.startswith("END_OF_") else sections.setdefault(name, [])
            if name.startswith("END_OF_"):
                sections[name] = []
        elif current is not None:
            current.append((place, line))
    return sections


def _table(name: str, sections: dict[str, list[tuple[int, str]]], columns: int, problems: Problems) -> Floats:
    # The numbers of a section (row, column); faults are noted.
    rows = sections.get(name, [])
    if len(rows) < 2 or f"END_OF_{name}" not in sections or len(rows) > _MAX_ROWS:
        problems.add(
            f"[{name}] has {len(rows)} rows",
            expected=f"at least two up to [END_OF_{name}]",
            code="table-missing",
        )
        return np.zeros((0, columns))
    table = []
    for line, text in rows:
        cells = numbers(text.split())
        if cells is None or len(cells) != columns:
            problems.add(
                f"line {line}: {text[:60]!r}",
                expected=f"{columns} numbers of [{name}]",
                code="row-unreadable",
            )
            return np.zeros((0, columns))
        table.append(cells)
    values = np.array(table, np.float64)
    at = values[1:, 1] if name == "CALDATA" else values[:, 0]
    if not np.isfinite(values).all() or (np.diff(at) <= 0).any():
        problems.add(
            f"[{name}] has wavelengths that do not increase, or values that are not finite",
            code="wavelength-unordered",
        )
    return values
