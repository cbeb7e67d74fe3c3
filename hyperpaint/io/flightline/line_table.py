"""Flight lines as a table of text: time, place, attitude, and every other variable of a line."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented, takes_quantities
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.io.files.publishing import published_files

#: Variables of the first columns, in their order.
_FIRST_COLUMNS = (
    *("frame", "time", "latitude", "longitude", "altitude", "roll", "pitch", "heading"),
    *("exposure_time", "irradiance_age"),
)


@takes_quantities()
@documented()
def write_line_table(line: xr.Dataset, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write the variables on ``along_track`` of a flight line as comma-separated values.

    `open_navigation` reads a file with the pose again, and every number keeps its bits; the first lines of
    the file declare the conventions of its angles.

    Parameters
    ----------
    line
        A flight line; its variables of numbers or times with the only dim ``along_track`` are written. A
        scalar exposure time is repeated.
    path
    overwrite

    Returns
    -------
    pathlib.Path
        The file: ``line``, then a column a variable with its unit, ``roll [degree]``; times are UTC at mid
        exposure, ISO 8601; unknown values are empty.

    Raises
    ------
    SchemaError
        There is no ``along_track``, or no variable on it.
    StoreError
        The file exists, or cannot be written. An existing file is unchanged.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> scratch = tempfile.TemporaryDirectory()
    >>> line = xr.Dataset({"roll": ("along_track", [0.5, -0.25], {"units": "degree"})})
    >>> print(write_line_table(line, Path(scratch.name) / "lines.csv").read_text())
    line,roll [degree]
    0,0.5
    1,-0.25
    >>> scratch.cleanup()
    """
    path = Path(path)
    lines = line.sizes.get(ALONG_TRACK)
    names = [str(name) for name, array in line.variables.items() if array.dims == (ALONG_TRACK,)]
    if lines is None or not names:
        raise SchemaError(
            f"no variable has the only dim {ALONG_TRACK!r}, dims are {dict(line.sizes)}",
            mend="pass a flight line",
            code="dim-missing",
        )
    names += [name for name in _FIRST_COLUMNS if name in line.variables and line.variables[name].dims == ()]
    order = {name: number for number, name in enumerate(_FIRST_COLUMNS)}
    columns: dict[str, Any] = {}
    for name in sorted(set(names), key=lambda name: (order.get(name, len(order)), name)):
        values = line[name].values
        if values.dtype.kind not in "iufbM":
            continue
        units = line[name].attrs.get("units")
        plain = units in (None, "", "1") or values.dtype.kind in "Mb" or "," in str(units)
        columns[name if plain else f"{name} [{units}]"] = np.broadcast_to(values, (lines,))
    convention = Convention.from_attrs(line.attrs)
    declared = {} if convention is None else convention.to_attrs()
    with (
        published_files([path], overwrite=overwrite) as (target,),
        open(target, "w", encoding="utf-8", newline="\n") as file,
    ):
        file.writelines(f"# {key}: {value}\n" for key, value in declared.items())
        file.write(",".join(["line", *columns]) + "\n")
        cells = (map(str, range(line.sizes[ALONG_TRACK])), *map(_texts, columns.values()))
        file.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))
    return path


def _texts(values: Any) -> list[str]:
    if values.dtype.kind == "M":
        stamps = np.datetime_as_string(values.astype("datetime64[ns]"), unit="ns")
        return ["" if stamp == "NaT" else f"{stamp}Z" for stamp in stamps]
    if values.dtype.kind == "f":
        # the shortest text that is read as the same number
        return ["" if np.isnan(value) else str(value) for value in values]
    return [str(int(value)) for value in values]
