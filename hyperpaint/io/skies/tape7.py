"""Irradiance from MODTRAN's ``tape7``, by the radiance of a grey ground of known reflectance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.base.units import takes_quantities
from hyperpaint.io.files.reading import numbers

from .sky_table import sky_dataset, sky_lines

_NEEDED = ("FREQ", "TOT_TRANS", "GRND_RFLT", "DRCT_RFLT")
#: Column names of two words in MODTRAN 4 and 5, of one word in 6.
_TWO_WORDS = (
    "TOT TRANS", "PTH THRML", "THRML SCT", "THRML EM", "SURF EMIS", "SOL SCAT", "SING SCAT", "SNGL SCAT",
    "MULT SCAT", "GRND RFLT", "DRCT RFLT", "TOTAL RAD", "REF SOL", "DIR EM", "TOA SUN",
)  # fmt: skip

# Mark below the last row.
_END = -9999.0


@takes_quantities(sun_zenith="degree")
def read_tape7(path: str | Path, *, sun_zenith: float, ground: float) -> xr.Dataset:
    r"""Return light at the ground from a ``tape7`` in radiance mode (IEMSCT 2) over wavenumbers.

    Parameters
    ----------
    path
        With a line of names FREQ [cm-1], TOT_TRANS, GRND_RFLT and DRCT_RFLT [W cm-2 sr-1 / cm-1].
    sun_zenith
        At the ground [degree].
    ground
        Reflectance of the ground in the run, the same at all wavelengths, above 0 (``SURREF``).

    Returns
    -------
    Dataset
        See `sky_dataset`.

    Raises
    ------
    FormatError
        There is no such line of names, as in ``.7sc`` and in runs over wavelengths, whose columns and units
        are others: they are refused, not guessed.
    SchemaError
        The sun is not above the horizon, or the ground reflects nothing.

    Notes
    -----
    .. math:: E = \pi L_{GRND} / (\rho T), \quad E_{dir} = \pi L_{DRCT} / (\rho T), \quad
              L_\lambda = 10^{-3} \nu^2 L_\nu

    with L per nm of m2 (L. Guanter et al., Int. J. Remote Sens. 30, 1407 (2009), has the same sums).

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "tape7")
    >>> _ = path.write_text('''  1 5 0 6
    ... FREQ TOT_TRANS THRML_EM THRML_SCT SURF_EMIS MULT_SCAT SING_SCAT GRND_RFLT DRCT_RFLT
    ... 22222.0 0.8 1e-9 9e-9 8e-9 2e-9 1e-9 1.70e-7 1.23e-7
    ... 11765.0 0.8 1e-9 9e-9 8e-9 2e-9 1e-9 2.76e-7 2.54e-7
    ... -9999.
    ... ''')
    >>> light = read_tape7(path, sun_zenith=60.0, ground=0.3)
    >>> light.wavelength.values.round(), light.direct_normal.values.round(2), light.diffuse.values.round(2)
    (array([450., 850.]), array([1.59, 0.92]), array([0.3 , 0.04]))
    """
    if not 0.0 <= sun_zenith < 90.0 or not 0.0 < ground <= 1.0:
        raise SchemaError(
            f"sun_zenith is {sun_zenith!r} and ground {ground!r}",
            expected="0 to below 90 degrees and 0 to 1",
            code="value-out-of-range",
        )
    lines = sky_lines(path)
    place, names = next(((n, _names(line)) for n, line in enumerate(lines) if "FREQ" in line), (0, []))
    if not set(_NEEDED) <= set(names):
        raise FormatError(
            f"{path}: no line of names with {', '.join(_NEEDED)}",
            expected="a tape7 over wavenumbers",
            mend="run MODTRAN with IEMSCT 2 and spectral units of cm-1, and give its tape7; give direct and "
            "diffuse light as CSV instead of a .7sc",
            code="model-output-wrong",
        )
    rows = []
    for count, line in enumerate(lines[place + 1 :], place + 2):
        row = numbers(line.split())
        if row is not None and row[:1] == [_END]:
            break
        if row is None or len(row) < len(names):
            raise FormatError(
                f"{path}: line {count}: {line[:60]!r}",
                expected=f"{len(names)} numbers or {_END:g}",
                code="number-unreadable",
            )
        rows.append(row[: len(names)])
    else:
        raise FormatError(
            f"{path} ends without the mark {_END:g}: it was cut short",
            mend="copy it again",
            code="file-truncated",
        )
    table = dict(zip(names, np.array(rows, np.float64).reshape(-1, len(names)).T, strict=True))
    lit = (table["FREQ"] > 0.0) & (table["TOT_TRANS"] > 1e-6)
    wavenumber, transmitted = table["FREQ"][lit], table["TOT_TRANS"][lit]
    with np.errstate(over="ignore", invalid="ignore"):  # checked by sky_dataset
        scale = np.pi * 1e-3 * wavenumber**2 / (ground * transmitted)
        whole, direct = scale * table["GRND_RFLT"][lit], scale * table["DRCT_RFLT"][lit]
        diffuse = np.where(
            np.abs(whole - direct) <= 1e-5 * whole, 0.0, whole - direct
        )  # rounding of the file
        normal, wavelength = direct / np.cos(np.radians(sun_zenith)), 1e7 / wavenumber
    return sky_dataset(str(path), wavelength, normal, diffuse)


def _names(line: str) -> list[str]:
    for name in _TWO_WORDS:
        line = line.replace(name, name.replace(" ", "_"))
    return line.split()
