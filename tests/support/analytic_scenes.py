"""Scenes whose light follows from geometry: view factors, shadows of boxes, the sun's image in a bonnet.

Nothing here knows how flags divide a pixel's light.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.sun import diffuse_fraction

Float = npt.NDArray[np.float64]


def wavelengths(bands: int = 96) -> Float:
    # Return the wavelengths of a 400-1000 nm camera [nm]
    return np.linspace(400.0, 1000.0, bands)


def smooth_edge(nm: Float, centre: float, low: float, high: float, width: float = 15.0) -> Float:
    # Return a spectrum that rises at a wavelength
    return low + (high - low) / (1.0 + np.exp(-(nm - centre) / width))


def as_line(
    cube: Float, nm: Float, *, lines: int = 32, snr: float | None = None, seed: int = 0
) -> xr.Dataset:
    # Return a cube (line, column, band) as a flight line, with noise if wished
    if snr is not None:
        cube = cube * (1.0 + np.random.default_rng(seed).normal(size=cube.shape) / snr)
    values = np.ascontiguousarray(cube.transpose(0, 2, 1), np.float32)
    made = xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), values, {"units": "1"})},
        {"wavelength": ("band", nm, {"units": "nm"})},
    )
    return made.chunk(along_track=lines)


def _rectangle_view_factor(distance: Float, offset: Float, height: float, half: float) -> Float:
    # Return the view factor from a level element to an upright rectangle on the ground
    # The element lies at ``distance`` in front of it and ``offset`` beside its middle. From the factor of a
    # rectangle with one corner at the foot of the perpendicular (Howell, catalogue B-4): F = (atan(1/Y) - A Y
    # atan(A)) / 2 pi with Y = distance / width, A = 1 / sqrt(X2 + Y2), X = height / width.
    def corner(width: Float) -> Float:
        sign, size = np.sign(width), np.maximum(np.abs(width), 1e-9)
        y, x = distance / size, height / size
        root = 1.0 / np.hypot(x, y)
        return sign * (np.arctan(1.0 / y) - y * root * np.arctan(root)) / (2.0 * np.pi)

    return corner(half - offset) + corner(half + offset)


def wall_beside_plane(
    nm: Float, plane: Float, wall: Float, *, zenith: float = 35.0, pixel: float = 0.03, height: float = 1.0
) -> tuple[Float, Float, xr.Dataset]:
    # Return a plane with a wall in the sun at its side: cube, added reflectance, and masks
    # The wall stands at the left on a thick base whose top is seen, is as long as the scene, and faces the
    # sun, which stands in the right. It sends to the plane wall x E_wall x F, and hides F of the sky.
    lines, columns, top = 96, 128, 16
    diffuse = diffuse_fraction(nm, zenith)
    distance = (np.arange(columns - top) + 0.5)[None] * pixel * np.ones((lines, 1))
    offset = ((np.arange(lines) - lines / 2 + 0.5) * pixel)[:, None] * np.ones((1, columns - top))
    factor = _rectangle_view_factor(distance, offset, height, lines * pixel / 2)
    lit = (1.0 - diffuse) * np.tan(np.radians(zenith)) + 0.5 * diffuse
    added = factor[..., None] * (wall * lit * plane)
    ground = plane * (1.0 - factor[..., None] * diffuse) + added
    cube = np.concatenate([np.broadcast_to(wall, (lines, top, nm.size)), ground], axis=1)
    whole = np.concatenate([np.zeros((lines, top)), added.max(axis=2)], axis=1)
    masks = xr.Dataset(
        {"plane": (("line", "column"), np.arange(columns)[None] >= top + np.zeros((lines, 1)))}
    )
    return cube, whole, masks


def box_shadow(nm: Float, ground: Float, box: Float, *, zenith: float = 40.0) -> tuple[Float, Float, Any]:
    # Return a box on the ground with its shadow: cube, blocked part of the direct light, mask of the ground
    # The sun stands over the lower lines, so that the shadow, as wide as the box and height x tan(zenith)
    # long, lies behind it; its end has a penumbra of the sun's 0.53 degrees. A point of the shadow sees the
    # sky but for the box's face (rectangle view factor).
    lines, columns, pixel, height = 160, 160, 0.02, 0.8
    diffuse = diffuse_fraction(nm, zenith)
    y, x = (np.mgrid[:lines, :columns] + 0.5) * pixel
    first, last, left, right = 0.8, 1.4, 0.8, 2.4
    on_box = (y > first) & (y < last) & (x > left) & (x < right)
    reach = last + height * np.tan(np.radians(zenith))
    blur = height / np.cos(np.radians(zenith)) ** 2 * np.radians(0.53)
    behind = np.clip((reach - y) / blur + 0.5, 0.0, 1.0) * (y > last)
    blocked = np.where((x > left) & (x < right), behind, 0.0)
    middle = (left + right) / 2
    hidden = np.zeros_like(y)
    inside = (y > last) & ~on_box
    hidden[inside] = _rectangle_view_factor(y[inside] - last, x[inside] - middle, height, (right - left) / 2)
    light = (1.0 - blocked)[..., None] * (1.0 - diffuse) + (1.0 - hidden)[..., None] * diffuse
    return np.where(on_box[..., None], box, ground * light), np.where(on_box, 0.0, blocked), ~on_box


def bonnet(nm: Float, body: Float, *, zenith: float = 30.0, alpha: float = 0.05) -> tuple[Float, Float]:
    # Return a coated bonnet, bent along the lines, beside asphalt: cube and the sun's mirror image g [1]
    # Its normals lean by up to 20 degrees towards the sun and away. The coat is a GGX surface of index 1.5; g
    # is what it sends of the sun, over what a white Lambert surface on level ground would. It mirrors the
    # clear sky where that is, twice as far from the zenith as it leans.
    lines, columns, margin = 160, 96, 24
    diffuse = diffuse_fraction(nm, zenith)
    sun = np.radians(zenith)
    lean = np.radians(np.linspace(-20.0, 20.0, lines))
    cosine = np.cos(np.abs(lean - sun / 2.0))
    spread = alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1.0) + 1.0) ** 2)
    out = np.cos(lean)
    fresnel = 0.04
    mirror = np.pi * fresnel * spread / (4.0 * np.maximum(out, 0.1)) / np.cos(sun)
    direct = np.clip(np.cos(lean - sun), 0.0, None) / np.cos(sun)
    light = direct[:, None] * (1.0 - diffuse) + ((1.0 + np.cos(lean)) / 2.0)[:, None] * diffuse
    upwards, azimuth = np.cos(2.0 * lean), np.where(lean > 0.0, 0.0, np.pi)
    seen_sky = ClearSky(zenith).relative_radiance(nm, upwards, azimuth).T
    panel = body * light + mirror[:, None] * (1.0 - diffuse) + fresnel * diffuse * seen_sky
    asphalt = smooth_edge(nm, 600.0, 0.07, 0.12, 150.0)
    cube = np.broadcast_to(asphalt, (lines, columns, nm.size)).copy()
    cube[:, margin:-margin] = panel[:, None]
    glint = np.zeros((lines, columns))
    glint[:, margin:-margin] = mirror[:, None]
    return cube, glint
