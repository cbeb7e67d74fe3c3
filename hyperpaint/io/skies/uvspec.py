"""Output of libRadtran's ``uvspec`` with the solver disort and its default columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.base.units import conversion_factor, takes_quantities
from hyperpaint.io.files.reading import numbers

from .sky_table import sky_dataset, sky_lines

_COLUMNS = 7  # lambda edir edn eup uavgdir uavgdn uavgup


@takes_quantities(sun_zenith="degree", sun_azimuth="degree")
def read_uvspec(
    path: str | Path, *, sun_zenith: float, units: str, sun_azimuth: float = 0.0, directions: int = 0
) -> xr.Dataset:
    """Return light at the ground from an output of ``uvspec``.

    Parameters
    ----------
    path
        Lines ``lambda edir edn eup uavgdir uavgdn uavgup``, the default of disort, at one output level. With
        ``umu`` and ``phi`` in its input, each is followed by a line of the azimuths and by lines ``umu u0u
        uu(phi)``.
    sun_zenith, sun_azimuth
        ``sza`` and ``phi0`` of its input [degree].
    units
        Units of its irradiance, which are those of the source, such as "mW m-2 nm-1"; not stated in the file.
    directions
        Number of ``umu`` in its input, 0 for none. Of these those with umu < 0 look up, at the sky; a ``phi``
        of ``phi0`` looks towards the sun.

    Returns
    -------
    Dataset
        See `sky_dataset`.

    Raises
    ------
    FormatError
        Lines are others than these (``output_user``, another solver): they are refused, not guessed.
    SchemaError
        The sun is not above the horizon, or ``units`` are no irradiance of a wavelength.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "uvspec.out")
    >>> _ = path.write_text('''450.0 500.0 180.0 61. 79. 45. 12.
    ... 850.0 420.0 40.0 61. 79. 45. 12.
    ... ''')
    >>> light = read_uvspec(path, sun_zenith=60.0, units="mW m-2 nm-1")
    >>> light.direct_normal.values.round(2), light.diffuse.values.round(2)
    (array([1.  , 0.84]), array([0.18, 0.04]))
    """
    if not 0.0 <= sun_zenith < 90.0:
        raise SchemaError(
            f"sun_zenith is {sun_zenith!r}", expected="0 to below 90 degrees", code="value-out-of-range"
        )
    factor = conversion_factor(units, "W m-2 nm-1")
    rows = [numbers(line.split()) for line in sky_lines(path) if line.strip() and not line.startswith("#")]
    step = 1 if directions == 0 else 2 + directions
    if not rows or len(rows) % step or any(row is None for row in rows):
        raise FormatError(
            f"{path}: {len(rows)} lines",
            expected=f"{step} lines of numbers for each wavelength",
            mend="pass the number of umu in the input of uvspec as directions=; write one output level "
            "(zout)",
            code="length-mismatch",
        )
    flux = [row or [] for row in rows[::step]]
    if any(len(row) != _COLUMNS for row in flux):
        raise FormatError(
            f"{path}: a line of {next(len(row) for row in flux if len(row) != _COLUMNS)} numbers",
            expected=f"{_COLUMNS}: lambda edir edn eup uavgdir uavgdn uavgup",
            mend="run uvspec with rte_solver disort and without output_user",
            code="model-output-wrong",
        )
    table = np.array(flux, np.float64)
    light = table[:, 0], factor * table[:, 1] / np.cos(np.radians(sun_zenith)), factor * table[:, 2]
    if not directions:
        return sky_dataset(str(path), *light)
    blocks = [[row or [] for row in rows[start + 1 : start + step]] for start in range(0, len(rows), step)]
    azimuths = blocks[0][0]
    if any(
        block[0] != azimuths or {len(row) for row in block[1:]} != {len(azimuths) + 2} for block in blocks
    ):
        raise FormatError(
            f"{path}: blocks of radiance differ",
            expected=f"a line of phi and {directions} of umu u0u uu",
            code="grid-mismatch",
        )
    radiance = np.array([block[1:] for block in blocks], np.float64)
    cosine = radiance[0, :, 0]
    if (radiance[:, :, 0] != cosine).any() or not (-1.0 <= cosine.min() < 0.0):
        raise FormatError(
            f"{path}: umu {cosine.tolist()}",
            expected="the same at all wavelengths, some from -1 to 0",
            code="grid-mismatch",
        )
    up = np.flatnonzero(cosine < 0.0)[::-1]  # from the zenith downwards
    up = up[np.argsort(-cosine[up])[::-1]]
    zenith = np.degrees(np.arccos(-cosine[up]))
    from_sun = (np.array(azimuths) - sun_azimuth) % 360.0
    return sky_dataset(str(path), *light, (zenith, from_sun, factor * radiance[:, up, 2:]))
