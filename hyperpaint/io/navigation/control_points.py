"""Ground control points: surveyed coordinates, and the pixels where the points are visible."""

import csv
import re
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base import FormatError, Problems, documented, is_unit, needs_extra, same_dimension
from hyperpaint.io.files.reading import name_rows, read_limited_text, table_of

from .navigation_records import limited_numbers

_MAX_BYTES = 16 << 20
_MAX_ROWS = 100_000
_MAX_COORDINATE = 1e8
_UNIT_TOLERANCE = 1e-9  # rounding error of unit factors; international and US survey feet differ by 2e-6
_NUMBERS = ("along_track", "cross_track", "east", "north", "height")
_ALIASES = {
    **dict.fromkeys(("along_track", "line", "row"), "along_track"),
    **dict.fromkeys(("cross_track", "sample", "column", "col"), "cross_track"),
    **dict.fromkeys(("east", "easting", "x", "e"), "east"),
    **dict.fromkeys(("north", "northing", "y", "n"), "north"),
    **dict.fromkeys(("height", "elevation", "z", "h", "altitude"), "height"),
    **dict.fromkeys(("flightline", "flight_line", "image"), "flightline"),
    **dict.fromkeys(("name", "point", "id", "label"), "name"),
}
_SUFFIXES = ("m", "ft", "km", "cm", "mm", "foot", "feet", "px", "usft", "ftus")
_BRACKETS = re.compile(r"[\[(]([^\[\]()]*)[\])]")
_PIXELS = ("", "1", "px", "pixel", "pixels")
_ONE_BASED = re.compile(r"\b(?:1|one)[ -]?based|(?:from|at) (?:1|one)\b", re.IGNORECASE)
_METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "intft", "internationalfoot", "internationalfeet"), 0.3048),
    **dict.fromkeys(("usft", "ftus", "usfoot", "usfeet", "sft", "surveyfoot", "surveyfeet"), 1200 / 3937),
    **dict.fromkeys(("ussurveyfoot", "ussurveyfeet", "ussft", "sftus"), 1200 / 3937),
    **dict.fromkeys(("km", "kilometre", "kilometres", "kilometer", "kilometers"), 1000.0),
    "cm": 0.01,
    "mm": 0.001,
}
#: Words of lengths other than metres: a heading with one is refused, since metres would be assumed.
_LENGTHS = {
    *("yd", "yds", "yard", "yards", "inch", "inches", "mi", "mile", "miles", "nmi"),
    *("furlong", "furlongs", "fathom", "fathoms", "chain", "chains"),
    *(word for word, metres in _METRES.items() if metres != 1.0),
}


@documented()
def read_control_points(path: str | Path) -> xr.Dataset:
    r"""Read ground control points from a table of text.

    The header names ``along_track`` and ``cross_track`` (or ``line`` and ``sample``; pixels, whole numbers
    at their centres, counted from 0), ``east``, ``north`` (of a map) and ``height`` above the ellipsoid, in
    metres, or in the unit that follows their name, ``height [ft]`` or ``height_ft`` (other text in
    brackets, ``height (ellipsoidal)``, is a label; ``[US survey feet]`` are 1200/3937 m); ``flightline``, if
    the points belong to several flight lines; and ``name``, which is optional. Cells are separated by commas,
    semicolons or tabs. A comment ``# crs: EPSG:32617`` before the header declares the map's CRS; east and
    north are returned in its unit, which is also that of columns without a unit.

    Parameters
    ----------
    path

    Returns
    -------
    xarray.Dataset
        ``along_track_pixel``, ``cross_track_pixel`` [1], ``east``, ``north`` [m, or the unit of ``crs``],
        ``height`` [m] (point), float64, coordinates ``name`` and ``flightline`` (str; empty if the file
        has none), and the attribute ``crs`` if the file declares it.

    Raises
    ------
    FormatError
        The file cannot be read; columns are missing, duplicate, or not in a unit of length; cells
        are not finite numbers; the first problems are listed.
    MissingExtraError
        The file declares a CRS and coordinates in another unit than metres, and pyproj is not installed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "points.csv"
    ...     _ = path.write_text("# crs: EPSG:32617\nname,line,sample,east,north,height\nA,10.5,3,1,2,50\n")
    ...     points = read_control_points(path)
    >>> points.attrs["crs"], points.along_track_pixel.values.tolist(), points.name.values.tolist()
    ('EPSG:32617', [10.5], ['A'])
    """
    path = Path(path)
    text = read_limited_text(path, _MAX_BYTES, "a table of control points").decode("utf-8-sig", "replace")
    problems = Problems(f"{path} cannot be used as control points", FormatError)
    rows = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    comments = [line for _, line in rows if line.lstrip().startswith("#")]
    rows = [(number, line) for number, line in rows if not line.lstrip().startswith("#")]
    FormatError.raise_if(
        len(rows) < 2 or len(rows) > _MAX_ROWS,
        f"{path}: {max(len(rows) - 1, 0)} points",
        expected=f"a header and 1 to {_MAX_ROWS}",
        code="table-missing",
    )
    separator = next((separator for separator in ("\t", ";", ",") if separator in rows[0][1]), ",")
    cells = _cells(rows[0][1], separator)
    headings = [column_heading(cell) for cell in cells]
    header = [_ALIASES.get(name, "") for name, _ in headings]
    units = dict(zip(header, (unit for _, unit in headings), strict=True))
    for name in _NUMBERS:
        problems.add_if(
            header.count(name) != 1,
            f"{header.count(name)} columns for {name!r} in {rows[0][1][:80]!r}",
            expected="one column",
            code="column-missing",
        )
    for name, cell in zip(header, cells, strict=True):
        problems.add_if(
            name.endswith("_track") and _ONE_BASED.search(cell),
            f"column {name!r} is {cell.strip()[:40]!r}",
            expected="pixels counted from 0",
            mend="subtract 1",
            code="pixel-origin",
        )
    problems.raise_if_any()
    table = table_of(path, header, [(number, _cells(line, separator)) for number, line in rows[1:]])
    # the last comment with a CRS is valid
    pairs = (comment.lstrip("# \t").partition(":") for comment in comments)
    crs_texts = [value.strip() for key, _, value in pairs if key.strip().lower() == "crs" and value.strip()]
    crs = crs_texts[-1][:10_000] if crs_texts else None
    map_units = {units[name] for name in ("east", "north")} - {""}
    # metres do not require pyproj, which is needed only to convert another unit
    needs_axis = crs and (
        any(_metres(unit) != 1.0 for unit in map_units) or (map_units and find_spec("pyproj"))
    )
    axis = _map_axis(crs, problems) if crs and needs_axis else None
    numbers = {
        name: limited_numbers(table, name, _MAX_COORDINATE, problems)
        * _factor(name, units[name], problems, axis if name in ("east", "north") else None)
        for name in _NUMBERS
    }
    for name, values in numbers.items():
        problems.add_if(
            np.isnan(values).any(),
            f"column {name!r} is not finite in {name_rows(table.rows[np.isnan(values)])}",
            code="not-finite",
        )
    problems.raise_if_any()
    variable_names = {name: f"{name}_pixel" if name.endswith("_track") else name for name in _NUMBERS}
    texts = {name: table.columns.get(name, [""] * len(table.rows)) for name in ("name", "flightline")}
    points = xr.Dataset(
        {
            variable_names[name]: ("point", values, {"units": "1" if name.endswith("_track") else "m"})
            for name, values in numbers.items()
        },
        coords={
            name: ("point", np.array([cell.strip()[:200] for cell in cells], dtype=str))
            for name, cells in texts.items()
        },
        attrs={"source": path.name},
    )
    if axis is not None:
        for name in ("east", "north"):
            points[name].attrs["units"] = "m" if axis[1] == 1.0 else axis[0]
    return points if crs is None else points.assign_attrs(crs=crs)


def _map_axis(crs: str, problems: Problems) -> tuple[str, float] | None:
    # Return the unit of the axes of a CRS, and its size in metres or radians.
    with needs_extra("pyproj", "geo", "the unit of a map of control points"):
        import pyproj
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            axes = pyproj.CRS.from_user_input(crs).to_2d().axis_info
    except (pyproj.exceptions.CRSError, ValueError):
        axes = []
    units = {(axis.unit_name, axis.unit_conversion_factor) for axis in axes}
    if len(units) != 1:
        problems.add(
            f"crs {crs[:80]!r} is unknown, or its axes have no common unit",
            expected="a CRS such as 'EPSG:32617'",
            code="crs-unknown",
        )
        return None
    return units.pop()


def _cells(line: str, separator: str) -> list[str]:
    if '"' not in line:  # ten times as fast as the csv module
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return []


def column_heading(cell: str) -> tuple[str, str]:
    """Return the name in a column's heading, and its unit, empty without one.

    Examples
    --------
    >>> column_heading("Easting [m]"), column_heading("height_ft"), column_heading("Line (0-based)")
    (('easting', 'm'), ('height', 'ft'), ('line', ''))
    """
    bracket_texts = [
        text.strip() for content in _BRACKETS.findall(cell) for text in re.split("[,;]", content)
    ]
    unit = next(
        (text for text in bracket_texts if _metres(text) or text.lower() in _PIXELS or _is_unit(text)), ""
    )
    name = "_".join(_BRACKETS.sub(" ", cell).lower().split())
    if not unit and name.rpartition("_")[2] in _SUFFIXES:
        name, _, unit = name.rpartition("_")
    return name, unit


def metres_of(name: str, unit: str, problems: Problems) -> float:
    # Return the size of a column's unit in metres; 1 without a unit, and for a wrong one, which is noted.
    metres = _metres(unit or "m")
    if metres is None:
        problems.add(
            f"column {name!r} in {unit!r:.40}",
            expected="a unit of length, such as [m] or [ft]",
            code="units-unknown",
        )
    return metres or 1.0


def _metres(unit: str) -> float | None:
    return _METRES.get(re.sub(r"[ ._-]", "", unit).lower())


def _is_unit(text: str) -> bool:
    # whether a text in brackets is a unit, rather than a label
    if is_unit(text) or same_dimension(text, "m") or text.lower() == "in":
        return True
    return not _LENGTHS.isdisjoint(re.findall("[a-z]+", text.lower()))


def _factor(name: str, unit: str, problems: Problems, axis: tuple[str, float] | None = None) -> float:
    # Return the size of a column's unit in metres, pixels, or units of the CRS axis; 1 without a unit.
    if name.endswith("_track"):
        problems.add_if(
            unit.lower() not in _PIXELS,
            f"column {name!r} in {unit!r:.40}",
            expected="pixels, counted from 0",
            code="units-unknown",
        )
        return 1.0
    if axis is None or not unit:
        return metres_of(name, unit, problems)
    axis_unit, axis_unit_size = axis
    # "ft" with a CRS in US survey feet means US survey feet
    if unit.lower() in ("ft", "foot", "feet") and "foot" in axis_unit.lower():
        return 1.0
    if _metres(axis_unit) is None:
        problems.add_if(
            unit.lower() != axis_unit.lower()
            and not (axis_unit == "degree" and unit.lower().startswith(("deg", "°"))),
            f"column {name!r} in {unit!r:.40}",
            expected=f"{axis_unit!r}, the unit of the crs",
            code="units-conflict",
        )
        return 1.0
    factor = metres_of(name, unit, problems) / axis_unit_size
    return 1.0 if abs(factor - 1.0) < _UNIT_TOLERANCE else factor
