"""What a collect.toml says of its light sensor and its panels reaches the reflectance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.base.errors import CollectError

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*of the light sensor have no attitude:hyperpaint.base.errors.PaintWarning"  # before and after
)


@pytest.fixture
def collect(tmp_path: Path) -> Path:
    effects: dict[str, Any] = {"wobble": "rough", "irradiance_interval_s": 1, "clock_offset_s": 0.0}
    return hp.simulate_collect(
        tmp_path / "collect", scene="plan", lines=600, bands=24, columns=28, seed=17, **effects
    )


def said(path: Path, old: str, new: str) -> Path:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def test_a_light_sensor_on_the_aircraft_is_levelled(collect: Path) -> None:
    plain = hp.open_collect(collect)["irradiance"].to_dataset()
    levelled = hp.open_collect(said(collect, "[irradiance]", '[irradiance]\nmount = "aircraft"'))
    record = levelled["irradiance"].to_dataset()
    navigation = hp.open_navigation(collect.parent / "flight" / "imu_gps.txt")
    line = next(iter(levelled["flightlines"].children.values())).to_dataset()
    declared = {name: text for name, text in line.attrs.items() if name.startswith("convention_")}
    expected = hp.light.level_irradiance(plain, navigation.assign_attrs(declared))
    np.testing.assert_array_equal(record.irradiance, expected.irradiance)
    there = np.isfinite(record.irradiance_tilt.values)
    assert 2 < there.sum() < there.size
    assert record.attrs["irradiance_mount"].startswith("aircraft, corrected to level")
    assert not np.array_equal(record.irradiance[there], plain.irradiance[there])


def test_it_needs_an_attitude_in_utc(collect: Path) -> None:
    said(collect, "[irradiance]", '[irradiance]\nmount = "aircraft"')
    text = collect.read_text(encoding="utf-8")
    lines = [each for each in text.splitlines() if not each.startswith("nav = ")]
    # beside the cube it would be found
    (collect.parent / "flight" / "imu_gps.txt").rename(collect.parent / "flight" / "hidden.txt")
    collect.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(CollectError, match='mount = "aircraft" needs the attitude'):
        hp.open_collect(collect)
