"""What the poses of a flight line mean is kept with them."""

import re
from pathlib import Path

import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import CollectError, SchemaError
from hyperpaint.io.collect.collect_toml import open_collect
from hyperpaint.simulation import simulate_collect


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meaning")
    return simulate_collect(folder, scene="plan", lines=40, bands=4, columns=6, stamp="mid")


def opened(collect: Path, **options: object) -> xr.Dataset:
    flight = collect.parent / "flight"
    return hp.open_flightline(
        flight / "raw_0.hdr",
        frame_index=flight / "frameIndex_0.txt",
        nav=flight / "imu_gps.txt",
        dark="none",
        calibration=collect.parent / "calibration.zarr",
        stamp="mid",
        **options,
    )


def changed(collect: Path, old: str, new: str) -> Path:
    text, count = re.subn(old, new, collect.read_text(), flags=re.MULTILINE)
    assert count == 1
    path = collect.with_name("changed.toml")
    path.write_text(text)
    return path


def test_what_nobody_declares_is_listed(collect: Path) -> None:
    line = opened(collect)
    assert Convention.from_attrs(line.attrs) == Convention(stamp_reference="mid")
    assert set(line.attrs["navigation_assumed"].split(", ")) == {
        "roll_positive", "pitch_positive", "heading_positive", "heading_reference", "angle_unit",
        "euler_order", "height_reference",
    }  # fmt: skip


def test_what_is_declared_is_kept(collect: Path) -> None:
    declared = {"roll_positive": "right_wing_up", "height_reference": "geoid", "geoid_undulation": -34.2}
    line = opened(collect, convention=declared)
    assert Convention.from_attrs(line.attrs) == Convention(stamp_reference="mid", **declared)
    assert "roll_positive" not in line.attrs["navigation_assumed"]
    assert "pitch_positive" in line.attrs["navigation_assumed"]


@pytest.mark.parametrize(
    ("declared", "told"),
    [
        ({"roll": "up"}, "key-unknown"),
        ({"angle_unit": "radian"}, "key-unknown"),
        ({"stamp_reference": "mid"}, "key-unknown"),
        ({"column_order": "backwards"}, "column_order='backwards'"),
    ],
)
def test_what_does_not_exist_is_refused(collect: Path, declared: dict[str, str], told: str) -> None:
    with pytest.raises(SchemaError, match=re.escape(told)):
        opened(collect, convention=declared)


def test_collect_declares_it(collect: Path) -> None:
    line = open_collect(changed(collect, "^column_order = .*", 'column_order = "right_to_left"'))
    meant = Convention.from_attrs(line["flightlines/raw_0"].attrs)
    assert meant == Convention(stamp_reference="mid", column_order="right_to_left")


def test_mistakes_in_a_collect_are_told(collect: Path) -> None:
    with pytest.raises(CollectError) as caught:
        open_collect(changed(collect, "^roll_positive = .*", 'roll_positive = "up"\nwander = 3'))
    assert "[navigation] roll_positive = 'up', expected one of right_wing_down" in str(caught.value)
    assert "wander" in str(caught.value)


def test_a_line_without_navigation_means_nothing(collect: Path) -> None:
    flight = collect.parent / "flight"
    line = hp.open_flightline(
        flight / "raw_0.hdr", start_time="2024-06-01T12:00:00Z", frame_period=0.007, dark="none",
        calibration=collect.parent / "calibration.zarr",
    )  # fmt: skip
    assert Convention.from_attrs(line.attrs) is None
