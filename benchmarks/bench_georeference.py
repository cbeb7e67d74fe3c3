"""A flight line put on the ground: 2000 lines of 640 columns, level or over a surface model of 2 cm."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import numpy as np
import xarray as xr

LINES, COLUMNS = 2000, 640


def wobbling_line(lines=LINES):
    """Return a line at 15.24 m that flies north at 1.14 m/s, with poses and no cube."""
    t = 0.007 * np.arange(lines)
    pose = {
        "latitude": 34.0 + 1.14 * t / 111e3,
        "longitude": np.full(lines, -80.2),
        "altitude": np.full(lines, 15.24),
        "roll": np.sin(2 * np.pi * 1.3 * t),
        "pitch": np.cos(2 * np.pi * 0.9 * t),
        "heading": 3 * np.sin(t),
    }
    units = {"altitude": "m"}
    coords = {
        name: ("along_track", value, {"units": units.get(name, "degree")}) for name, value in pose.items()
    }
    quality = np.zeros((lines, COLUMNS), np.uint16)
    attrs = {"convention_column_order": "left_to_right"}
    return xr.Dataset({"quality": (("along_track", "cross_track"), quality)}, coords, attrs)


def surface_model(level):
    """Return boxes of 1.5 m and poles of 4 m on rough ground, in cells of 2 cm, under a located line."""
    x = np.arange(float(level.east.min()) - 2, float(level.east.max()) + 2, 0.02)
    y = np.arange(float(level.north.min()) - 2, float(level.north.max()) + 2, 0.02)
    heights = np.random.default_rng(0).uniform(0, 0.05, (y.size, x.size))
    heights[200:700, 300:500] = 1.5
    heights[::151, ::133] = 4.0
    attrs = {"crs": level.east.attrs["crs"], "height_reference": "ellipsoid"}
    return xr.DataArray(heights, {"y": y, "x": x}, ("y", "x"), attrs=attrs)


class Places:
    """Rays of all pixels, warm, on all cores."""

    params = ("level", "raster")
    param_names = ("ground",)
    timeout = 300

    def setup(self, ground):
        import hyperpaint as hp

        self.locate = hp.geometry.locate
        self.line = wobbling_line()
        self.options = {"camera": hp.geometry.PinholeCamera(COLUMNS, pixel_pitch=7.4e-6, focal_length=14e-3)}
        level = hp.geometry.locate(self.line, ground=0.0, **self.options)
        self.options |= {"ground": 0.0} if ground == "level" else {"dem": surface_model(level)}
        self.time_places(ground)

    def time_places(self, ground):
        located = self.locate(self.line, **self.options)
        located[["east", "north", "view_zenith"]].compute()

    def time_graph(self, ground):
        self.locate(self.line, **self.options)
