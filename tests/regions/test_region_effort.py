"""Regions that would take too long, or cannot be: refused at once, with what to do."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.regions import Region, Regions, pixels


def zigzag(corners: int, lines: int, columns: int) -> Region:
    # Return a comb whose teeth run across all lines
    x = np.linspace(0.0, columns - 1.0, corners)
    return Region("comb", np.stack([x, np.where(np.arange(corners) % 2, lines - 1.0, 0.0)], axis=1))


def test_pixels__of_a_wild_zigzag_are_refused_at_once() -> None:
    # Rationale: 10,000 corners across 2.6 million pixels would take half an hour
    # Expected: an error that names the region and says what to do
    line = xr.Dataset(coords={"along_track": np.arange(4000), "cross_track": np.arange(640)})
    with pytest.raises(SchemaError, match=r"(?s)'comb'.*too-complex"):
        pixels(zigzag(10_000, 4000, 640), line)


def test_pixels__of_holes_like_a_zigzag_are_refused_at_once() -> None:
    line = xr.Dataset(coords={"along_track": np.arange(4000), "cross_track": np.arange(640)})
    comb = zigzag(1000, 4000, 640).polygon
    frame = np.array([(0.0, 0.0), (639.0, 0.0), (639.0, 3999.0), (0.0, 3999.0)])
    with pytest.raises(SchemaError, match="polygon-too-complex"):
        pixels(Region("grate", frame, (comb,)), line)


def test_pixels__of_many_corners_are_found() -> None:
    # Expected: a circle of 10,000 corners holds the pixels within its radius
    turn = np.linspace(0.0, 2.0 * np.pi, 10_000, endpoint=False)
    circle = Region("disc", 300.0 + 250.2 * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    line = xr.Dataset(coords={"along_track": np.arange(600), "cross_track": np.arange(600)})
    along, across = pixels(circle, line)
    y, x = np.mgrid[:600, :600]
    expected = np.hypot(y - 300.0, x - 300.0)
    assert along.size == np.count_nonzero(expected <= 250.2)
    assert expected[along, across].max() <= 250.2


@pytest.mark.parametrize(("coordinates", "crs"), [("sensor", 5), ("map", 5), ("map", b"EPSG:4326")])
def test_regions__with_a_crs_that_is_no_text_are_refused(coordinates: str, crs: Any) -> None:
    with pytest.raises(SchemaError, match="type-wrong"):
        Regions((), coordinates, crs)
