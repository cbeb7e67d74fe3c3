"""What a map says of height, swath and pixels, and when it warns."""

import pytest
import xarray as xr
from support.geocentric_rays import flown

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.geometry.orthorectification.mapping import swath_attrs

CAMERA = hp.geometry.PinholeCamera(41, field_of_view=30.0, edges="outer")
CONVENTION = hp.Convention(column_order="left_to_right")


def mapped(ground: float, **pose: float) -> xr.Dataset:
    line = flown(40, 41, **({"roll": 0, "pitch": 0, "heading": 0, "altitude": 100.0} | pose))
    line = line.assign(red=(("along_track", "cross_track"), [[1.0] * 41] * 40))
    located = hp.geometry.locate(line, ground=ground, camera=CAMERA, convention=CONVENTION)
    return hp.geometry.orthorectify(located, variables="red", grid="north")


def test_height_swath_and_aspect_by_hand() -> None:
    attrs = mapped(40.0).attrs
    assert attrs["height_above_ground"] == pytest.approx(60.0)
    # 2 tan(15 deg) x 60 m, and the scale of the map
    assert attrs["swath"] == pytest.approx(2 * 0.2679491924 * 60.0, rel=1e-3)
    assert attrs["pixel_aspect"] == pytest.approx(attrs["spacing_along"] / attrs["spacing_across"])
    # a ground above the sea is noticed
    with pytest.warns(PaintWarning, match=r"2 m above.*swath-implausible") as caught:
        mapped(98.0)
    assert caught[0].filename == __file__


def test_swath_and_pixels_of_a_whole_camera_are_judged() -> None:
    narrow = xr.Dataset(coords={"cross_track": range(640)})
    with pytest.warns(PaintWarning, match=r"3.2 m wide.*swath-implausible"):
        swath_attrs(narrow, across=0.005, along=0.005)
    with pytest.warns(PaintWarning, match=r"10 times.*swath-implausible"):
        swath_attrs(narrow, across=0.05, along=0.5)
    assert swath_attrs(narrow, across=0.05, along=0.06) == pytest.approx({"swath": 32.0, "pixel_aspect": 1.2})
