"""Output of 6S: one monochromatic run a wavelength."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.base.units import takes_quantities
from hyperpaint.io.files.reading import number, numbers

from .sky_table import sky_dataset, sky_lines

_WAVELENGTH = re.compile(r"monochromatic calculation at wl\s*[:=]\s*([0-9.]+)\s*micron")


@takes_quantities(sun_zenith="degree")
def read_sixs(paths: Sequence[str | Path], *, sun_zenith: float) -> xr.Dataset:
    """Return light at the ground from the outputs of 6S, one monochromatic run a file.

    Parameters
    ----------
    paths
        Each with "monochromatic calculation at wl" [micron] and, under "irr. at ground level
        (w/m2/mic)", "direct solar irr.", "atm. diffuse irr." and "environment irr" on level ground.
    sun_zenith
        Of the runs [degree].

    Returns
    -------
    Dataset
        See `sky_dataset`; ``diffuse`` is of atmosphere and environment.

    Raises
    ------
    FormatError
        A file lacks these lines: runs over a filter are refused, because they print sums.
    SchemaError
        The sun is not above the horizon.

    Examples
    --------
    >>> import tempfile
    >>> run = '''* monochromatic calculation at wl : {} micron *
    ... *        irr. at ground level (w/m2/mic)            *
    ... * direct solar irr. atm. diffuse irr. environment irr *
    ... *         {}           {}           4.000 *
    ... '''
    >>> paths = [Path(tempfile.mkdtemp(), name) for name in ("450.txt", "650.txt")]
    >>> _ = paths[0].write_text(run.format("0.450", 500.0, 180.0))
    >>> _ = paths[1].write_text(run.format("0.650", 700.0, 100.0))
    >>> light = read_sixs(paths, sun_zenith=60.0)
    >>> light.direct_normal.values.round(3), light.diffuse.values.round(3)
    (array([1. , 1.4]), array([0.184, 0.104]))
    """
    if not 0.0 <= sun_zenith < 90.0:
        raise SchemaError(
            f"sun_zenith is {sun_zenith!r}", expected="0 to below 90 degrees", code="value-out-of-range"
        )
    rows = np.array([_run(path) for path in paths], np.float64).reshape(-1, 4)
    micron, direct, diffuse, environment = rows.T
    per_nm = 1e-3
    level = per_nm * direct / np.cos(np.radians(sun_zenith))
    return sky_dataset("6S", 1000.0 * micron, level, per_nm * (diffuse + environment))


def _run(path: str | Path) -> tuple[float, ...]:
    # Wavelength [micron] and the three irradiances [W m-2 micron-1].
    lines = sky_lines(path)
    wavelength = next((match[1] for line in lines if (match := _WAVELENGTH.search(line))), None)
    place = next((n for n, line in enumerate(lines[:-1]) if "direct solar irr." in line), None)
    if wavelength is None or place is None:
        raise FormatError(
            f"{path}: no monochromatic run of 6S with its irradiance at ground level",
            mend="run 6S with a single wavelength (IWAVE -1), a file each",
            code="model-output-wrong",
        )
    micron = number(wavelength)
    if micron is None:
        raise FormatError(
            f"{path}: a wavelength of {wavelength[:60]!r}",
            expected="a number [micron]",
            code="number-unreadable",
        )
    values = numbers(lines[place + 1].replace("*", " ").split())
    if values is None or len(values) != 3:
        raise FormatError(
            f"{path}: line {place + 2}: {lines[place + 1][:60]!r}",
            expected="three irradiances",
            code="number-unreadable",
        )
    return micron, *values
