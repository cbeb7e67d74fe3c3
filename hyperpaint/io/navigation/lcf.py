"""Resonon ``.lcf``: the navigation beside a cube of an airborne Pika.

A table without a header, its columns parted by blanks or tabs: time [s of GPS time], roll, pitch, heading
[rad], longitude, latitude [degree], altitude [m], and two that are not used. No vendor description is public;
what the columns mean is what public readers were told by the maker (massipipe, mi3nts). Roll is positive with
the right wing UP.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.flightline.headwall import Table, name_rows, read_text

from .gps_weeks import GPS_EPOCH, WEEK_S, nanoseconds, unwrap_weeks
from .navigation_records import LIMITS, limited_numbers
from .pose_records import PoseRecord, check_poses, check_time_order

__all__ = ["read_lcf"]

_COLUMNS = ("time", "roll", "pitch", "heading", "longitude", "latitude", "altitude")
_LARGEST = 2**30
_MOST_CELLS = 64
_LATEST = 7e9
"""Seconds from 1980 to 2199."""
_CONVENTION = Convention(roll_positive="right_wing_up", angle_unit="radian")


def read_lcf(path: str | Path) -> PoseRecord:
    """Read a Resonon ``.lcf`` file.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    PoseRecord
        Roll, pitch and heading [rad]: right wing UP, nose up, clockwise from true north; heights above the
        ellipsoid. Stamps count from the beginning of GPS time, or of a week where they are below two weeks.

    Raises
    ------
    FormatError
        Not such a table, or cells that are no numbers or no positions and angles; all are listed.
    TimeError
        Time runs backwards.
    """
    path = Path(path)
    table = _table(path)
    problems = Problems(f"{path} cannot be used as a Resonon .lcf file", FormatError)
    values = {
        name: limited_numbers(table, name, _LATEST if name == "time" else LIMITS[name], problems)
        for name in _COLUMNS
    }
    seconds = values.pop("time")
    if problem := _time_problem(seconds, table):
        problems.add(problem)
    if not len(problems):  # the same cells would be named twice
        check_poses(values, "radian", problems, "row")
    problems.raise_if_any()
    weekly = bool((seconds <= 2.0 * WEEK_S).all())
    stamp = unwrap_weeks(nanoseconds(seconds)) if weekly else nanoseconds(seconds) + GPS_EPOCH
    check_time_order(path.name, stamp, "row")
    return PoseRecord(
        path.name, "Resonon lcf", stamp, "week" if weekly else "1970", values, _CONVENTION,
        assumed=("euler_order",),
    )  # fmt: skip


def _time_problem(seconds: np.ndarray[tuple[int], np.dtype[np.float64]], table: Table) -> str:
    wrong = table.rows[~(seconds >= 0.0)]
    if wrong.size:
        return f"time is negative or unknown in {name_rows(wrong)}, expected seconds of GPS time"
    weekly = seconds <= 2.0 * WEEK_S
    if weekly.any() and not weekly.all():
        lesser = table.rows[weekly] if 2 * weekly.sum() < weekly.size else table.rows[~weekly]
        return f"time counts from elsewhere in {name_rows(lesser)} than in the other rows"
    return ""


def _table(path: Path) -> Table:
    rows: list[int] = []
    cells: list[list[str]] = []
    wrong: list[int] = []
    for number, line in enumerate(read_text(path, _LARGEST).split("\n"), start=1):
        if not line.strip():
            continue
        row = line.replace(",", " ").split(None, _MOST_CELLS)
        if len(row) < len(_COLUMNS) or (cells and len(row) != len(cells[0])) or len(row) > _MOST_CELLS:
            wrong.append(number)
            continue
        rows.append(number)
        cells.append(row)
    if wrong or not cells:
        said = f"{name_rows(wrong)} without them" if wrong else "no rows"
        raise FormatError(
            f"{path}: expected at least {len(_COLUMNS)} columns ({', '.join(_COLUMNS)}), found {said}"
        )
    columns = list(zip(*cells, strict=True))
    named = {name: list(columns[place]) for place, name in enumerate(_COLUMNS)}
    return Table(path.name, np.array(rows, np.int64), named)
