"""Regions on the mosaic of several flight lines: the pixels of each line are its own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.regions import Region, Regions, pixels

GSD, SIZE, MAP = 2.0, 30, "EPSG:32617"
DIMS = ("along_track", "cross_track")


def flight_line(name: str, first: float, value: float, *, back: bool = False) -> xr.Dataset:
    # Return a line of one paint, whose columns are east of ``first`` [m]; flown ``back`` to the south
    step = -1 if back else 1
    north, east = (
        axis[::step, ::step].copy()
        for axis in np.meshgrid(GSD * np.arange(SIZE), first + GSD * np.arange(SIZE), indexing="ij")
    )
    noise = np.random.default_rng(SIZE).normal(0.0, 1e-3, (SIZE, 4, SIZE))
    metres = {"units": "m", "crs": MAP}
    return xr.Dataset(
        {
            "reflectance": (
                ("along_track", "band", "cross_track"),
                np.float32(value + noise),
                {"units": "1"},
            ),
            "view_zenith": (DIMS, np.ones((SIZE, SIZE)), {"units": "degree"}),
            "quality": (DIMS, np.zeros((SIZE, SIZE), np.uint16)),
        },
        coords={
            "wavelength": ("band", [450.0, 550.0, 650.0, 750.0], {"units": "nm"}),
            "east": (DIMS, east, metres),
            "north": (DIMS, north, metres),
        },
        attrs={"name": name},
    )


@pytest.fixture(scope="module")
def lines() -> dict[str, xr.Dataset]:
    # Return two lines on opposite courses, side by side
    return {"a": flight_line("a", 0.0, 0.2), "b": flight_line("b", 60.0, 0.8, back=True)}


@pytest.fixture(scope="module", params=["made", "stored"])
def mosaic(
    lines: dict[str, xr.Dataset], request: Any, tmp_path_factory: pytest.TempPathFactory
) -> xr.Dataset:
    mosaic = hp.geometry.mosaic(lines, GSD)
    if request.param == "made":
        return mosaic
    path: Path = tmp_path_factory.mktemp("mosaic") / "map.zarr"
    hp.to_store(mosaic, path)
    return hp.open_store(path)


def square(name: str, low: float, high: float, **more: Any) -> Region:
    return Region(name, [(low, low), (high, low), (high, high), (low, high)], **more)


def test_a_region_of_a_line_is_of_its_cells_alone(lines: dict[str, xr.Dataset], mosaic: xr.Dataset) -> None:
    drawn = Regions((square("ours", 4.5, 15.5, flightline="a"), square("theirs", 3.5, 12.5, flightline="b")))
    of_lines, of_map = (hp.extract_signatures(source, drawn) for source in (lines, mosaic))
    np.testing.assert_allclose(of_map.reflectance, of_lines.reflectance, atol=2e-4)
    np.testing.assert_allclose(of_map.reflectance[:, 0], [0.2, 0.8], atol=1e-3)
    # nearest cells show each pixel of these lines
    np.testing.assert_array_equal(of_map.n, of_lines.n)
    np.testing.assert_array_equal(of_map.n, [121, 81])


def test_a_region_over_a_seam_has_the_pixels_of_both_lines(mosaic: xr.Dataset) -> None:
    seam = Regions((Region("seam", [(45, 21), (73, 21), (73, 37), (45, 37)]),), "map", MAP)
    row, col = pixels(seam[0], mosaic, coordinates="map", crs=MAP)
    shown = mosaic.flightline.values[row, col]
    assert min(np.sum(shown == number) for number in (0, 1)) >= 30
    # the two lines are flown towards each other: some pixels have the line and column of others
    places = np.stack([mosaic[name].values[row, col] for name in ("nearest_line", "nearest_sample")])
    assert np.unique(places[:, shown >= 0], axis=1).shape[1] < np.sum(shown >= 0)
    library = hp.extract_signatures(mosaic, seam, members=10**4)
    keyed = np.unique(np.concatenate([places, shown[None]])[:, shown >= 0], axis=1)
    assert library.n.item() == keyed.shape[1]
    assert library.reflectance_quantiles.values[0, [0, -1], 0] == pytest.approx([0.2, 0.8], abs=0.005)
    # what two lines show alike is not one neighbourhood
    assert 1.0 <= library.n_eff.item() <= library.n.item() / 1.3


@pytest.mark.parametrize("flightline", ["", "c"])
def test_a_region_of_the_sensor_names_its_line(mosaic: xr.Dataset, flightline: str) -> None:
    regions = Regions((square("hood", 4.5, 15.5, flightline=flightline),))
    with pytest.raises(SchemaError, match="flightline-unknown"):
        hp.extract_signatures(mosaic, regions)
    with pytest.raises(SchemaError, match="one of a, b;"):
        pixels(regions[0], mosaic)


def test_a_mosaic_of_one_line_needs_no_name(lines: dict[str, xr.Dataset]) -> None:
    alone = hp.geometry.mosaic({"a": lines["a"]}, GSD)
    library = hp.extract_signatures(alone, Regions((square("hood", 4.5, 15.5),)))
    assert library.n.item() == 121
