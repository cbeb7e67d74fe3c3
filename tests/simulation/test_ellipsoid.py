"""The simulator's own geodesy, against PROJ."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from hyperpaint.simulation.rendering.platforms import (
    LocalFrame,
    TransverseMercator,
    geocentric,
    geodetic,
    north_east_down,
)

RNG = np.random.default_rng(8)
LATITUDE = RNG.uniform(0.0, 83.0, 500)
LONGITUDE = -75.0 + RNG.uniform(-3.0, 3.0, 500)
HEIGHT = RNG.uniform(-100.0, 5000.0, 500)


def transformed(source: str, target: str, *values: np.ndarray) -> tuple[np.ndarray, ...]:
    made = pyproj.Transformer.from_crs(source, target, always_xy=True).transform(*values)
    return tuple(np.asarray(part) for part in made)


def test_geocentric_and_back() -> None:
    expected = np.stack(transformed("EPSG:4979", "EPSG:4978", LONGITUDE, LATITUDE, HEIGHT), axis=-1)
    np.testing.assert_allclose(geocentric(LATITUDE, LONGITUDE, HEIGHT), expected, atol=1e-8, rtol=0)
    latitude, longitude, height = geodetic(expected)
    assert np.abs(latitude - LATITUDE).max() < 1e-11  # degree: a micrometre
    assert np.abs(longitude - LONGITUDE).max() < 1e-12
    assert np.abs(height - HEIGHT).max() < 1e-7


@pytest.mark.parametrize("zone", [1, 18, 31, 60])
def test_map_is_that_of_utm(zone: int) -> None:
    plane = TransverseMercator(zone)
    longitude = LONGITUDE + 6.0 * (zone - 18)
    east, north = plane.project(LATITUDE, longitude)
    x, y = transformed("EPSG:4326", plane.crs, longitude, LATITUDE)
    assert np.abs(east - x).max() < 1e-7
    assert np.abs(north - y).max() < 1e-7


def test_zone_of_a_place() -> None:
    zones = [TransverseMercator.of(43.0, longitude).zone for longitude in (-180.0, -77.7, 0.0, 179.9)]
    assert zones == [1, 18, 31, 60]
    with pytest.raises(ValueError, match="-20"):
        TransverseMercator.of(-20.0, 0.0)


def test_local_frame_is_that_of_proj() -> None:
    frame = LocalFrame(43.0845, -77.6749, 160.0)
    latitude, longitude = 43.0845 + RNG.normal(0, 0.01, 50), -77.6749 + RNG.normal(0, 0.01, 50)
    height = RNG.uniform(100.0, 300.0, 50)
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=-77.6749 +lat_0=43.0845 +h_0=160"
    )
    expected = np.stack(pipeline.transform(longitude, latitude, height), axis=-1)
    made = frame.local(latitude, longitude, height)
    np.testing.assert_allclose(made, expected, atol=1e-7, rtol=0)
    back = frame.geodetic(made)
    for value, wanted, within in zip(back, (latitude, longitude, height), (1e-11, 1e-11, 1e-7), strict=True):
        np.testing.assert_allclose(value, wanted, atol=within, rtol=0)


def test_directions_are_those_of_small_steps() -> None:
    """Expected: a metre north, east and down of a place, by its coordinates, is a column of the rotation."""
    here = geocentric(43.0, -77.0, 160.0)
    turned = north_east_down(43.0, -77.0)
    step = 1e-6
    for axis, moved in enumerate(
        (geocentric(43.0 + step, -77.0, 160.0), geocentric(43.0, -77.0 + step, 160.0), None)
    ):
        way = (geocentric(43.0, -77.0, 159.0) if moved is None else moved) - here
        np.testing.assert_allclose(turned[:, axis], way / np.linalg.norm(way), atol=2e-7)
    np.testing.assert_allclose(turned.T @ turned, np.eye(3), atol=1e-15)
