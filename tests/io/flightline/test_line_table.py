"""The line table: every number keeps its bits, and the pose is read again as navigation."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError, StoreError

POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
START = np.datetime64("2024-06-01T12:00:00.000000001", "ns")


def line_of(pose: dict[str, Any], lines: int = 3) -> xr.Dataset:
    coords = {
        name: ("along_track", np.asarray(pose[name], float), schema.VARIABLES[name].attrs) for name in POSE
    }
    return xr.Dataset(
        {
            "reflectance": (schema.CUBE, np.zeros((lines, 2, 4), "f4"), {"units": "1"}),
            "irradiance_age": ("along_track", np.linspace(0, 1, lines, dtype="f4"), {"units": "s"}),
            "exposure_time": ((), 5e-3, {"units": "s"}),
            "wavelength_note": ("band", ["a", "b"]),
        },
        {
            "time": ("along_track", START + np.arange(lines) * np.timedelta64(7, "ms")),
            "frame": ("along_track", np.arange(10, 10 + lines)),
            "comment": ("along_track", ["x,y"] * lines),
            **coords,
        },
        Convention(column_order="left_to_right", stamp_reference="end").to_attrs(),
    )


def test_a_table_of_lines(tmp_path: Path) -> None:
    line = line_of({name: [0.1, np.nan, 1 / 3] for name in POSE})
    line["time"] = line.time.where(line.frame != 11)
    text = hp.io.write_line_table(line, tmp_path / "lines.csv").read_text().splitlines()
    assert "# convention_column_order: left_to_right" in text
    rows = [row for row in text if not row.startswith("#")]
    assert rows[0] == (
        "line,frame,time,latitude [degree],longitude [degree],altitude [m],roll [degree],pitch [degree],"
        "heading [degree],exposure_time [s],irradiance_age [s]"
    )
    assert rows[1] == "0,10,2024-06-01T12:00:00.000000001Z,0.1,0.1,0.1,0.1,0.1,0.1,0.005,0.0"
    assert rows[2] == "1,11,,,,,,,,0.005,0.5"
    flight = hp.open_navigation(tmp_path / "lines.csv")
    assert flight.attrs["rows_without_time"] == 1
    assert Convention.from_attrs(flight.attrs) == Convention.from_attrs(line.attrs)
    assert "assumed" not in flight.attrs


@settings(max_examples=30)
@given(st.data())
def test_the_pose_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    lines = data.draw(st.integers(1, 8))
    number = st.floats(-90.0, 90.0) | st.just(float("nan"))
    pose = {name: data.draw(st.lists(number, min_size=lines, max_size=lines)) for name in POSE}
    line = line_of(pose, lines)
    flight = hp.open_navigation(hp.io.write_line_table(line, tmp_path_factory.mktemp("table") / "lines.csv"))
    for name in POSE:
        np.testing.assert_array_equal(flight[name], line[name])
    np.testing.assert_array_equal(flight.navigation_time, line.time)


def test_what_is_no_line_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="dim-missing"):
        hp.io.write_line_table(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "lines.csv")
    path = hp.io.write_line_table(line_of({name: [0.0] * 3 for name in POSE}), tmp_path / "lines.csv")
    with pytest.raises(StoreError, match="overwrite=True"):
        hp.io.write_line_table(line_of({name: [0.0] * 3 for name in POSE}), path)
    assert [one.name for one in tmp_path.iterdir()] == ["lines.csv"]
