"""Checked dataset of irradiance and sky radiance at the ground, and its CSV reader."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.units import conversion_factor
from hyperpaint.io.files.reading import read_limited_text

# Largest file of a sky model [byte].
MAX_SKY_BYTES = 64 << 20

_COLUMNS = {
    "wavelength": "nm",
    "zenith": "degree",
    "azimuth": "degree",
    "radiance": "W m-2 sr-1 nm-1",
    "direct_normal": "W m-2 nm-1",
    "diffuse": "W m-2 nm-1",
}


def sky_lines(path: str | Path) -> list[str]:
    """Return the lines of a text file, at most `MAX_SKY_BYTES`; raises `FormatError`."""
    content = read_limited_text(Path(path), MAX_SKY_BYTES, "the output of a model of the atmosphere")
    return content.decode("utf-8", "replace").splitlines()


def sky_dataset(
    source: str,
    wavelength: Floats,
    direct_normal: Floats,
    diffuse: Floats,
    radiance: tuple[Floats, Floats, Floats] | None = None,
) -> xr.Dataset:
    """Return light at the ground as a Dataset, in order of wavelength.

    Parameters
    ----------
    source
        Name of the file or model.
    wavelength : (wavelength,)
        [nm]
    direct_normal, diffuse : (wavelength,)
        Normal to the beam, and of the sky on level ground [W m-2 nm-1].
    radiance
        Zenith angles (sky_zenith,) and azimuths from the sun (sky_azimuth,) [degree], and the radiance of the
        sky (wavelength, sky_zenith, sky_azimuth) [W m-2 sr-1 nm-1].

    Raises
    ------
    FormatError
        Values are not finite or negative, or wavelengths are there twice; all are listed.

    Examples
    --------
    >>> nm = np.array([850.0, 450.0])
    >>> sky_dataset("by hand", nm, np.array([0.8, 1.2]), np.array([0.05, 0.3])).diffuse.values
    array([0.3 , 0.05])
    """
    problems = Problems(f"{source}: no light at the ground", FormatError)
    order = np.argsort(wavelength, kind="stable")
    if wavelength.size < 2 or not (np.diff(wavelength[order]) > 0.0).all():
        problems.add(
            "wavelengths are fewer than two, or repeated",
            expected="two or more different wavelengths",
            code="wavelength-repeated",
        )
    arrays = {"direct_normal": direct_normal, "diffuse": diffuse}
    if radiance is not None:
        arrays["sky_radiance"] = radiance[2]
    for name, values in {"wavelength": wavelength, **arrays}.items():
        if not (np.isfinite(values).all() and (values >= 0.0).all()):
            problems.add(
                f"{name} has values that are negative or not finite",
                expected="finite values, 0 or above",
                code="value-out-of-range",
            )
    if radiance is not None and not all(np.isfinite(angles).all() for angles in radiance[:2]):
        problems.add("directions of the sky have angles that are not finite", code="not-finite")
    problems.raise_if_any()
    units = {"units": "W m-2 nm-1"}
    light = xr.Dataset(
        {name: ("wavelength", arrays[name][order], units) for name in ("direct_normal", "diffuse")},
        {"wavelength": ("wavelength", wavelength[order], {"units": "nm"})},
        {"source": source},
    )
    if radiance is not None:
        dims = ("wavelength", "sky_zenith", "sky_azimuth")
        light["sky_radiance"] = (dims, radiance[2][order], {"units": "W m-2 sr-1 nm-1"})
        degree = {"units": "degree"}
        light = light.assign_coords(
            sky_zenith=("sky_zenith", radiance[0], degree), sky_azimuth=("sky_azimuth", radiance[1], degree)
        )
    return light


def read_sky_csv(path: str | Path) -> xr.Dataset:
    """Return light at the ground from a table of commas, a row a wavelength and direction.

    Parameters
    ----------
    path
        Its first row that is no comment (``#``) has headings with units: ``wavelength [nm]``,
        ``direct_normal [W m-2 nm-1]``, ``diffuse [W m-2 nm-1]`` and, for radiance by direction, ``zenith
        [degree]``, ``azimuth [degree]`` from the sun and ``radiance [W m-2 sr-1 nm-1]``; other units of the
        same dimension are converted.

    Raises
    ------
    FormatError
        Headings are missing, rows are no numbers, or directions are not the same at every wavelength.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "sky.csv")
    >>> _ = path.write_text('''wavelength [um],direct_normal [mW m-2 nm-1],diffuse [mW m-2 nm-1]
    ... 0.45,1200,300
    ... 0.85,800,50
    ... ''')
    >>> light = read_sky_csv(path)
    >>> light.wavelength.values, light.diffuse.values
    (array([450., 850.]), array([0.3 , 0.05]))
    """
    lines = (line for line in sky_lines(path) if line.strip() and not line.startswith("#"))
    try:
        rows = list(csv.reader(lines))
    except csv.Error as error:
        raise FormatError(f"{path}: no table of commas: {error}", code="text-unreadable") from error
    problems = Problems(f"{path}: no table of a sky", FormatError)
    names = [cell.split("[")[0].strip() for cell in rows[0]] if rows else []
    needed = {"wavelength", "direct_normal", "diffuse"}
    by_direction = "radiance" in names
    needed |= {"zenith", "azimuth", "radiance"} if by_direction else set()
    if needed - set(names):
        problems.add(
            f"columns {sorted(needed - set(names))} are missing, found {names}", code="column-missing"
        )
    if len(set(names)) < len(names):
        problems.add(f"columns {names}: some are repeated", code="column-repeated")
    ragged = [number for number, row in enumerate(rows) if len(row) != len(names)]
    if ragged or len(rows) < 2:
        found = (
            f"row {ragged[0] + 1} of {len(rows[ragged[0]])} cells" if ragged else "no row below the headings"
        )
        problems.add(found, expected=f"rows of {len(names)}", code="length-mismatch")
    problems.raise_if_any()
    try:
        table = np.array(rows[1:], np.float64)
        factors = [
            conversion_factor(cell.partition("[")[2].rstrip("] "), _COLUMNS[name])
            for cell, name in zip(rows[0], names, strict=True)
        ]
    except (ValueError, KeyError) as error:
        raise FormatError(
            f"{path}: {error}",
            expected=f"rows of numbers below headings among {list(_COLUMNS)}",
            code="number-unreadable",
        ) from error
    with np.errstate(over="ignore", invalid="ignore"):  # checked below
        table = table * factors
    if not np.isfinite(table).all():
        place = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
        raise FormatError(
            f"{path}: row {place + 2} {rows[place + 1]}", expected="finite numbers", code="not-finite"
        )
    columns = dict(zip(names, table.T, strict=True))
    wavelength, first = np.unique(columns["wavelength"], return_index=True)
    light = columns["direct_normal"][first], columns["diffuse"][first]
    if not by_direction:
        return sky_dataset(str(path), columns["wavelength"], columns["direct_normal"], columns["diffuse"])
    zenith, azimuth = np.unique(columns["zenith"]), np.unique(columns["azimuth"])
    shape = wavelength.size, zenith.size, azimuth.size
    order = np.lexsort((columns["azimuth"], columns["zenith"], columns["wavelength"]))
    is_grid = math.prod(shape) == order.size  # checked first: the grid of scattered rows would be huge
    if is_grid:
        grid = np.stack(np.meshgrid(wavelength, zenith, azimuth, indexing="ij")).reshape(3, -1)
        rows_of_grid = np.stack([columns[name][order] for name in ("wavelength", "zenith", "azimuth")])
        is_grid = np.array_equal(rows_of_grid, grid)
    if not is_grid:
        raise FormatError(
            f"{path}: {order.size} rows",
            expected=f"every direction once at every wavelength, {shape}",
            code="grid-mismatch",
        )
    return sky_dataset(
        str(path), wavelength, *light, (zenith, azimuth, columns["radiance"][order].reshape(shape))
    )
