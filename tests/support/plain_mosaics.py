"""A mosaic by a loop over cells and lines: what `hyperpaint.geometry.mosaic` must equal bit for bit."""

from typing import Any

import numpy as np
import xarray as xr

NO_DATA = 1024 | 2048


def better(rule: str, new: Any, old: Any) -> bool:
    # Tell whether a pixel is better than another; each is zenith, quality and time
    (zenith, quality, time), (zenith0, quality0, time0) = new, old
    if bool(quality & NO_DATA) != bool(quality0 & NO_DATA):
        return not quality & NO_DATA
    if rule == "newest":
        return bool(time > time0)
    if rule == "unflagged" and (quality == 0) != (quality0 == 0):
        return bool(quality == 0)
    return bool(zenith < zenith0)


def plain_mosaic(maps: dict[str, xr.Dataset], rule: str, names: list[str]) -> dict[str, np.ndarray]:
    # Return the variables of computed maps with north up, and ``flightline``, over all of them
    some = next(iter(maps.values()))
    gsd = float(some.spatial_ref.attrs["GeoTransform"].split()[1])
    corners = {}
    for name, one in maps.items():
        east, *_, north, _, _ = (float(part) for part in one.spatial_ref.attrs["GeoTransform"].split())
        corners[name] = round(-north / gsd), round(east / gsd)
    top, left = (min(corner[k] for corner in corners.values()) for k in (0, 1))
    bottom = max(corners[name][0] + one.sizes["y"] for name, one in maps.items())
    right = max(corners[name][1] + one.sizes["x"] for name, one in maps.items())
    shape = bottom - top, right - left
    out: dict[str, np.ndarray] = {"flightline": np.full(shape, -1, np.int16)}
    fills = {"quality": 1024, "line_time": np.datetime64("NaT", "ns"), "nearest_line": -1}
    for name in names:
        values = some[name].values
        out[name] = np.full((*shape, *values.shape[2:]), fills.get(name, np.nan), values.dtype)
    best: dict[tuple[int, int], Any] = {}
    for number, name in enumerate(sorted(maps)):
        one = {key: maps[name][key].values for key in {*names, "hits", "view_zenith", "quality", "line_time"}}
        for row, col in np.argwhere(one["hits"] > 0).tolist():
            at = row + corners[name][0] - top, col + corners[name][1] - left
            pixel = one["view_zenith"][row, col], int(one["quality"][row, col]), one["line_time"][row, col]
            if at not in best or better(rule, pixel, best[at]):
                best[at] = pixel
                out["flightline"][at] = number
                for key in names:
                    out[key][at] = one[key][row, col]
    return out
