"""Tables of control points: read, or refused as FormatError and nothing else."""

from pathlib import Path

import numpy as np
import pytest

from hyperpaint.base.errors import FormatError
from hyperpaint.io.navigation.control_points import read_control_points

TABLE = """# crs: EPSG:32617
Name;Flightline;Line;Sample;Easting [m];Northing [m];Height_m
A;raw_0;10.5;3;500000.25;3700000.5;-20
B;raw_1;11;4;500001;3700001;-19.5
"""


def test_a_table(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(TABLE)
    points = read_control_points(path)
    assert points.attrs == {"source": "points.csv", "crs": "EPSG:32617"}
    assert points.along_track_pixel.values.tolist() == [10.5, 11.0]
    assert points.east.values.tolist() == [500000.25, 500001.0]
    assert points.height.attrs["units"] == "m"
    assert points.flightline.values.tolist() == ["raw_0", "raw_1"]
    assert {points[name].dtype for name in points.data_vars} == {np.dtype(np.float64)}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "0 points"),
        ("line,sample,east,north,height\n", "0 points"),
        ("line,sample,east,north\n1,2,3,4\n", "'height'"),
        ("line,row,sample,east,north,height\n1,1,2,3,4,5\n", "'along_track'.*column-missing"),
        ("line,sample,east,north,height\n1,2,3,4\n", "line 2 without 5 cells"),
        ("line,sample,east,north,height\n1,2,3,nan,5\n", "line 2.*not-finite"),
        ("line,sample,east,north,height\n1,2,x,4,inf\n", "line 2.*value-out-of-range"),
        ("line (1-based),sample,east,north,height\n1,2,3,4,50\n", "pixel-origin"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "points.csv"
    with pytest.raises(FormatError, match="file-unreadable"):
        read_control_points(path)
    path.write_text(text)
    with pytest.raises(FormatError, match=told):
        read_control_points(path)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("[ft]", 0.3048),
        ("(feet)", 0.3048),
        ("[km]", 1000.0),
        ("(FT)", 0.3048),
        ("(M)", 1.0),
        ("[KM]", 1e3),
        ("[US survey feet]", 1200 / 3937),
        ("[ftUS]", 1200 / 3937),
        ("(us-ft)", 1200 / 3937),
        ("(UTM 17N)", 1.0),
        ("(grid) [ft]", 0.3048),
        ("(E)", 1.0),
        ("(m above the grid)", 1.0),
        ("(in UTM)", 1.0),
        ("(8/h)", 1.0),
    ],
)
def test_a_unit_in_a_heading_is_converted(tmp_path: Path, unit: str, metres: float) -> None:
    path = tmp_path / "points.csv"
    path.write_text(f"line (0-based);sample [px];east {unit};north_m;height (ft, ellipsoidal)\n1;2;3;4;50\n")
    points = read_control_points(path)
    assert points.east.item() == pytest.approx(3 * metres, rel=1e-11)
    assert (points.north.item(), points.height.item()) == (4.0, 50 * 0.3048)


@pytest.mark.parametrize(
    ("heading", "told"),
    [
        ("east [s]", "'east' in 's'"),
        ("east [degree]", "'degree'"),
        ("east [2 m]", "'2 m'"),
        ("east [yd]", "'yd'"),
        ("east (in)", "'in'"),
        ("east [miles]", "'miles'"),
        ("east (feet of the grid)", "'feet of the grid'"),
    ],
)
def test_a_unit_of_something_else_is_refused(tmp_path: Path, heading: str, told: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(f"line [m],sample,{heading},north,height\n1,2,3,4,50\n")
    with pytest.raises(FormatError, match="units-unknown") as caught:
        read_control_points(path)
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("crs", "unit", "east"),
    [
        ("EPSG:2263", "ft", 3.0), ("EPSG:2263", "US survey feet", 3.0), ("EPSG:2263", "m", 3 * 3937 / 1200),
        ("EPSG:2263", "UTM", 3.0), ("EPSG:32617", "ft", 3 * 0.3048), ("EPSG:32617", "m", 3.0),
        ("EPSG:2222", "ft", 3.0), ("EPSG:4326", "degrees", 3.0),
    ],
)  # fmt: skip
def test_east_and_north_come_in_the_unit_of_their_map(
    tmp_path: Path, crs: str, unit: str, east: float
) -> None:
    pytest.importorskip("pyproj")
    path = tmp_path / "points.csv"
    path.write_text(f"# crs: {crs}\nline,sample,east [{unit}],north [{unit}],height [ft]\n1,2,3,3,50\n")
    points = read_control_points(path)
    assert points.east.item() == points.north.item() == pytest.approx(east, rel=1e-11)
    assert points.height.item() == 50 * 0.3048
    assert (points.east.attrs["units"] == "m") == (crs == "EPSG:32617" or unit == "UTM")


@pytest.mark.parametrize(
    ("crs", "unit", "problem"),
    [
        ("EPSG:4326", "m", "'east'.*units-conflict"),
        ("EPSG:2263", "degree", "'east'.*units-unknown"),
        ("EPSG:0", "ft", "'EPSG:0'.*crs-unknown"),
    ],
)
def test_units_that_are_not_of_the_map_are_refused(tmp_path: Path, crs: str, unit: str, problem: str) -> None:
    pytest.importorskip("pyproj")
    path = tmp_path / "points.csv"
    path.write_text(f"# crs: {crs}\nline,sample,east [{unit}],north,height\n1,2,3,4,50\n")
    with pytest.raises(FormatError, match=problem):
        read_control_points(path)
