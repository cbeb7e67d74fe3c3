"""Corners of a checkerboard in a picture, to a small part of a pixel.

Around a corner of four squares, with u and v [pixel] along the board's two directions, brightness is

    m + a tanh((u - u0) / p) tanh((v - v0) / q)

a saddle whose middle (u0, v0) is fitted with the other four by least squares (Gauss and Newton's steps). The
start is the middle of the pixel nearest to where the corner should be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_STEPS = 25
_LEAST, _MOST = 0.3, 4.0  # of the widths p and q [pixel]
_FARTHEST = 3.0  # that a fit may go from its start [pixel]


@dataclass(frozen=True)
class Fit:
    # Fitted corners
    # place: Column and row, 0 at the middle of the first pixel, shape (corner, 2); NaN where nothing was
    # fitted
    # misfit: Standard deviation of what is left, in parts of ``a``, shape (corner,)
    place: Floats
    misfit: Floats


def fit_saddles(picture: Floats, expected: Floats, directions: Floats, reach: float) -> Fit:
    # Fit corners near to where they should be
    # picture: Brightness, shape (row, column); corners with NaN around them are left out
    # expected: Column and row of corners, shape (corner, 2)
    # directions: Columns and rows of one pixel along either direction of the board, unit vectors, shape (2,
    # 2)
    # reach: How far along both directions pixels belong to the saddle [pixel]
    start = np.rint(expected).astype(np.int64)
    half = int(np.ceil(reach * np.abs(directions).sum(axis=0).max()))
    offset = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2, indexing="xy"), axis=-1).reshape(-1, 2)
    offset = offset[(np.abs(offset @ directions.T) <= reach).all(axis=1)]
    at = start[:, None] + offset
    within = ((at >= 0) & (at < np.array(picture.shape[::-1]))).all(axis=(1, 2))
    at = np.where(within[:, None, None], at, 0)
    seen = np.asarray(picture[at[..., 1], at[..., 0]], np.float64)
    fitted = within & np.isfinite(seen).all(axis=1)
    place, misfit = np.full(expected.shape, np.nan), np.full(len(expected), np.nan)
    if fitted.any():
        middle, misfit[fitted] = _fit(seen[fitted], offset @ directions.T)
        place[fitted] = start[fitted] + middle @ np.linalg.inv(directions).T
    return Fit(place, misfit)


def _fit(seen: Floats, uv: Floats) -> tuple[Floats, Floats]:
    # Return u0 and v0 of windows (corner, 2), and what is left; NaN where a fit runs away
    u, v = uv.T
    quarter = np.sign(u) * np.sign(v)
    mean = seen.mean(axis=1)
    height = (seen * quarter).sum(axis=1) / np.abs(quarter).sum()
    zero, one = np.zeros_like(mean), np.ones_like(mean)
    x = np.stack([zero, zero, mean, height, one, one], axis=1)
    for _ in range(_STEPS):
        f, g, model = _model(x, u, v)
        a, p, q = x[:, 3:4], x[:, 4:5], x[:, 5:6]
        slope_u, slope_v = a * (1 - f**2) * g / p, a * f * (1 - g**2) / q
        du, dv = (u - x[:, :1]) / p, (v - x[:, 1:2]) / q
        parts = np.stack([-slope_u, -slope_v, np.ones_like(f), f * g, -slope_u * du, -slope_v * dv], axis=-1)
        normal = np.einsum("cki,ckj->cij", parts, parts)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        step = np.linalg.solve(normal, np.einsum("cki,ck->ci", parts, seen - model)[..., None])[..., 0]
        x += np.clip(step, *(s * np.array([1, 1, np.inf, np.inf, 0.5, 0.5]) for s in (-1, 1)))
        x[:, 4:] = np.clip(x[:, 4:], _LEAST, _MOST)
    left = (seen - _model(x, u, v)[2]).std(axis=1) / np.abs(x[:, 3])
    lost = np.abs(x[:, :2]).max(axis=1) > _FARTHEST
    return np.where(lost[:, None], np.nan, x[:, :2]), left


def _model(x: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats, Floats]:
    f = np.tanh((u - x[:, :1]) / x[:, 4:5])
    g = np.tanh((v - x[:, 1:2]) / x[:, 5:6])
    return f, g, x[:, 2:3] + x[:, 3:4] * f * g


def misplacement(
    picture: Floats, transform: tuple[float, ...], east: Floats, north: Floats, turn: float, square: float
) -> Floats:
    # Return by how many pixels the corners of a board miss their places in a map, shape (corner, 2)
    # picture: Map of brightness, shape (y, x)
    # transform: Of its cells, in GDAL's order: map coordinates of the outer corner of the first, and steps
    # east, north: Where the corners are [m]
    # turn: Direction of one axis of the board, clockwise from the map's north [degree]
    # square: Side of its squares [m]
    # Returns: To the right and down [pixel], of those corners around which the map is whole
    east0, east_x, east_y, north0, north_x, north_y = transform
    to_cells = np.linalg.inv(np.array([[east_x, east_y], [north_x, north_y]]))
    expected = np.stack([east - east0, north - north0], axis=-1) @ to_cells.T - 0.5
    angle = np.radians(turn)
    axes = np.array([[np.sin(angle), np.cos(angle)], [np.cos(angle), -np.sin(angle)]]) @ to_cells.T
    gsd = float(np.hypot(east_x, north_x))
    fit = fit_saddles(picture, expected, axes / np.linalg.norm(axes, axis=1)[:, None], 0.38 * square / gsd)
    made = fit.place - expected
    return np.asarray(made[np.isfinite(made).all(axis=1)])
