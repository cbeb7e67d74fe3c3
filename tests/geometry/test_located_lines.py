"""A located line in the hands of the rest of the package: reflectance, regions of the map, signatures."""

import numpy as np
import xarray as xr
from support.geocentric_rays import LEFT_TO_RIGHT, UTM, flown
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.regions import pixels

POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
CAMERA = hp.geometry.PinholeCamera(6, field_of_view=40.0, edges="centres")


def line_with_poses() -> xr.Dataset:
    line = flight().line
    poses = flown(line.sizes["along_track"], 6, wobble=0.05)
    made = line.assign_coords({name: poses[name].variable for name in POSE})
    made["roll"][3] = np.nan
    return made.assign_attrs(LEFT_TO_RIGHT.to_attrs())


def test_reflectance_and_place_in_either_order() -> None:
    line = line_with_poses()
    before = line.paint.locate(ground=0.0, camera=CAMERA).paint.reflectance()
    after = line.paint.reflectance().paint.locate(ground=0.0, camera=CAMERA)
    for made in (before, after):
        assert (made.quality.values[3] & hp.Quality.OFF_SWATH == hp.Quality.OFF_SWATH).all()
        assert not (np.delete(made.quality.values, 3, axis=0) & hp.Quality.OFF_SWATH).any()
    for name in ("reflectance", "quality", "east", "view_zenith"):
        np.testing.assert_array_equal(before[name], after[name])
    np.testing.assert_array_equal(before.reflectance, line.paint.reflectance().reflectance)


def test_regions_of_the_map_find_their_pixels() -> None:
    located = line_with_poses().paint.locate(ground=0.0, camera=CAMERA).paint.reflectance()
    east, north = located.east.values, located.north.values
    corner = (east[10, 2], north[10, 2])
    region = hp.Region(
        "panel", [(corner[0] + a, corner[1] + b) for a, b in ((-1, -0.03), (1, -0.03), (1, 0.03), (-1, 0.03))]
    )
    along, across = pixels(region, located, coordinates="map", crs=UTM)
    inside = (np.abs(east - corner[0]) <= 1) & (np.abs(north - corner[1]) <= 0.03)
    assert inside[10, 2]
    np.testing.assert_array_equal(np.stack([along, across]), np.stack(np.nonzero(inside)))
    assert 3 not in along
    paints = hp.extract_signatures(located, hp.Regions((region,), "map", UTM))
    assert int(paints.n[0]) == inside.sum()
    assert paints.attrs["view_geometry"] == "view_zenith and view_azimuth of the pixels"
    np.testing.assert_allclose(paints.view_zenith[0], located.view_zenith.values[inside].mean(), atol=0.2)
