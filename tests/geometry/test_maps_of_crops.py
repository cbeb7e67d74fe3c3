"""A crop of a flight line keeps its numbers: on its map they are the places of the whole line."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter
from support.flown_lines import GSD, fly, located

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.geometry.georeference.locating import angles_of, crs_of, is_in_metres, quaternions
from hyperpaint.regions import Region, Regions, pixels

PLACES = ("nearest_line", "nearest_sample", "glt_line", "glt_sample")


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    flown = fly(120, 50, "calm", heading=30.0)
    values = np.random.default_rng(2).random((120, 3, 50)).astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
    return line.assign_coords(
        wavelength=("band", [450.0, 550.0, 650.0], {"units": "nm"}),
        along_track=np.arange(120), cross_track=np.arange(50),
    )  # fmt: skip


CROP = {"along_track": slice(33, 110), "cross_track": slice(7, 41)}


@pytest.mark.parametrize("grid", ["north", "flight"])
def test_places_on_the_map_of_a_crop_are_those_of_the_whole_line(line: xr.Dataset, grid: Any) -> None:
    crop = line.isel(CROP)
    numbered = hp.geometry.orthorectify(crop, GSD, grid=grid).compute()
    plain = hp.geometry.orthorectify(crop.drop_vars(["along_track", "cross_track"]), GSD, grid=grid).compute()
    for name in PLACES:
        first = 33 if name.endswith("line") else 7
        assert numbered[name].dtype == plain[name].dtype
        shown = plain[name].values >= 0
        assert shown.mean() > 0.3
        np.testing.assert_allclose(
            numbered[name].values[shown], plain[name].values[shown] + first, rtol=1e-13
        )
        np.testing.assert_array_equal(numbered[name].values[~shown], plain[name].values[~shown])
    np.testing.assert_array_equal(numbered.reflectance, plain.reflectance)


def test_numbers_of_averaged_lines_name_no_pixel_and_positions_stay(line: xr.Dataset) -> None:
    thin = line.isel(along_track=slice(0, 120, 2))
    halves = thin.assign_coords(along_track=thin.along_track + 0.5)
    made, half, plain = (
        hp.geometry.orthorectify(one, GSD).nearest_line.values
        for one in (thin, halves, thin.drop_vars("along_track"))
    )
    np.testing.assert_array_equal(made[plain >= 0], 2 * plain[plain >= 0])
    np.testing.assert_array_equal(half, plain)


def test_a_region_of_the_whole_line_gives_its_pixels_on_the_map_of_a_crop(line: xr.Dataset) -> None:
    regions = Regions((Region("hood", [(10.5, 40.5), (35.5, 42.5), (30.5, 90.5), (12.5, 80.5)]),))
    orthomap = hp.geometry.orthorectify(line.isel(CROP), GSD / 2)
    row, col = pixels(regions[0], orthomap)
    shown = {
        (int(a), int(c))
        for a, c in zip(
            orthomap.nearest_line.values[row, col], orthomap.nearest_sample.values[row, col], strict=True
        )
    }
    along, across = pixels(regions[0], line)
    wanted = set(zip(along.tolist(), across.tolist(), strict=True))
    assert shown <= wanted
    assert len(shown) >= 0.98 * len(wanted)
    library, direct = (
        hp.extract_signatures(one, regions, exclude=0, members=10**6) for one in (orthomap, line)
    )
    members = [
        set(
            zip(
                *(one[f"member_{dim}"].values[0].tolist() for dim in ("along_track", "cross_track")),
                strict=True,
            )
        )
        for one in (library, direct)
    ]
    assert members == [shown, wanted]


def test_tie_points_in_a_crop_are_positions_in_it() -> None:
    flown = fly(220, 160, "none")
    grey = gaussian_filter(np.random.default_rng(3).random((220, 160)), 2.0)[:, None].astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), grey, {"units": "1"}))
    heights = ("along_track", "cross_track"), np.zeros((220, 160)), {"units": "m"}
    whole = line.assign_coords(ground_height=heights)
    crop = whole.assign_coords(along_track=np.arange(220)).isel(along_track=slice(20, 220))
    numbered, plain = (
        hp.geometry.find_tie_points({"a": whole, "b": one}, GSD)
        for one in (crop, crop.drop_vars("along_track"))
    )
    xr.testing.assert_equal(numbered, plain)
    assert np.median(numbered.along_track_pixel.values @ [1.0, -1.0]) == pytest.approx(20.0, abs=0.05)


# --- angles a hair below north, and maps whose axes point elsewhere -----------------------------------------


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
