"""What stands for a dataset in a few words: dims, units, wavelengths, times."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.schema import BAND, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "Facts",
    "counted",
    "facts_of_bands",
    "facts_of_irradiance",
    "facts_of_line",
    "form_of",
    "range_of",
    "size_of",
    "times_of",
]

Facts = Iterator[tuple[str, str]]
"""Names and texts."""


def facts_of_line(line: xr.Dataset) -> Facts:
    """Yield what stands for a flight line, opened or stored."""
    for name in ("counts", "radiance", "reflectance"):
        if name in line:
            yield name, form_of(line[name])
    yield from facts_of_bands(line)
    if "time" in line.coords:
        yield "times", times_of(line["time"].values)
    if "exposure_time" in line.variables:
        source = line.attrs.get("exposure_source", "")
        text = range_of(np.unique(line["exposure_time"].values) * 1e3, "ms")
        yield "exposure", f"{text} ({source})" if source else text
    yield "dark", str(line.attrs.get("dark_source", ""))
    if "irradiance" in line:
        yield "irradiance", f"{counted(line.sizes[IRRADIANCE_TIME], 'sample')} around the line"


def facts_of_irradiance(dataset: xr.Dataset) -> Facts:
    """Yield what stands for a series of irradiance."""
    yield "irradiance", form_of(dataset["irradiance"])
    yield "wavelength", range_of(dataset[IRRADIANCE_WAVELENGTH].values, "nm")
    yield "times", times_of(dataset[IRRADIANCE_TIME].values)


def form_of(array: xr.DataArray) -> str:
    """Return the dims, dtype and units of an array."""
    shape = " x ".join(f"{size} {dim}" for dim, size in array.sizes.items()) or "scalar"
    units = array.attrs.get("units")
    return f"{shape}, {array.dtype}" + (f" [{units}]" if units else "")


def facts_of_bands(dataset: xr.Dataset) -> Facts:
    """Yield the wavelengths of the bands, and how many are bad."""
    if "wavelength" not in dataset.coords:
        yield "wavelength", "unknown" if BAND in dataset.dims else ""
        return
    text = range_of(dataset["wavelength"].values, "nm")
    if "fwhm" in dataset.coords:
        text += f", fwhm {range_of(dataset['fwhm'].values, 'nm')}"
    if "good" in dataset.coords and not dataset["good"].values.all():
        text += f", {counted(int((~dataset['good'].values).sum()), 'bad band')}"
    yield "wavelength", text


def counted(number: int, thing: str) -> str:
    """Return a number of things, in the singular or plural."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def range_of(values: Any, units: str, digits: int = 3) -> str:
    """Return the lowest and the highest of numbers."""
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    if not known.size:
        return "unknown"
    low, high = (f"{value:.{digits}f}".rstrip("0").rstrip(".") for value in (known.min(), known.max()))
    return f"{low} {units}" if low == high else f"{low} to {high} {units}"


def times_of(times: Any) -> str:
    """Return the first and the last of times."""
    if times.dtype.kind != "M":
        return f"no times, but {times.dtype}"
    known = times[~np.isnat(times)]
    if not known.size:
        return "times unknown"
    first, last = (np.datetime_as_string(time, unit="ms") for time in (known.min(), known.max()))
    lost = f", {times.size - known.size} without a time" if known.size < times.size else ""
    return f"{first} to {last} UTC{lost}"


def size_of(count: int) -> str:
    """Return a number of bytes for reading."""
    size = float(count)
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"
