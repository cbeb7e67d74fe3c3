"""Angles a hair below north, and maps whose axes point elsewhere."""

import pytest

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.geometry.georeference.locating import angles_of, crs_of, is_in_metres, quaternions

pytest.importorskip("pyproj")


def test_headings_stay_below_360() -> None:
    assert Convention().canonical(0.0, 0.0, -1e-20)[2] == 0.0
    assert angles_of(quaternions(0.0, 0.0, -1e-20))[2] == 0.0


@pytest.mark.parametrize(
    ("crs", "metres"),
    [
        ("EPSG:2053", False),  # Hartebeesthoek94 / Lo29: west and south
        ("EPSG:4326", False),
        ("EPSG:2225", False),  # feet
        ("EPSG:32617", True),
        ("EPSG:3413", True),  # both axes to the south, from the pole
        ("EPSG:3031", True),
    ],
)
def test_maps_in_metres_east_and_north(crs: str, metres: bool) -> None:
    assert is_in_metres(crs_of(crs)) is metres
