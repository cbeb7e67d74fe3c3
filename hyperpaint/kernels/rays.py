"""Rays of a line camera to the ground: a level surface, or a raster of heights.

Every line has a local frame: metres to the east (e), north (n) and up (u) of its navigation position. Map
coordinates, raster coordinates and ellipsoidal height are polynomials of second degree in (e, n, u), with ten
coefficients in the order ``1 e n u ee nn uu en eu nu``. Along a straight ray each is a parabola in the
distance s from the camera.
"""

import math

import numpy as np

from hyperpaint.base.jit import borrowing_kernel, kernel
from hyperpaint.base.schema import Array

from .arguments import BLOCK, LineFrames, LineRays, Raster

Vector = tuple[float, float, float]
Parabola = tuple[float, float, float]

# Results of a pixel: x and y on the map, height [m], zenith and azimuth of the camera [degree].
PLACES = 5

# Horizontal part of a direction below which its azimuth is undefined, and set to 0.
_UPRIGHT = 1e-9
# Distance from the surface at which an intersection is accepted [m].
_SURFACE = 1e-9
# Rays are followed this far above the highest and below the lowest point of a raster [m].
_MARGIN = 1e-3
# Distance by which a ray is moved across the border of a cell [cell].
_BORDER_STEP = 1e-7
# Speed below which a ray does not leave its cell [cell m-1].
_MIN_SPEED = 1e-30


@borrowing_kernel
def _value_at(c: Array, e: float, n: float, u: float) -> float:
    value: float = (
        c[0]
        + e * (c[1] + c[4] * e + c[7] * n + c[8] * u)
        + n * (c[2] + c[5] * n + c[9] * u)
        + u * (c[3] + c[6] * u)
    )
    return value


@borrowing_kernel
def _gradient(c: Array, e: float, n: float, u: float) -> Vector:
    return (
        c[1] + 2.0 * c[4] * e + c[7] * n + c[8] * u,
        c[2] + 2.0 * c[5] * n + c[7] * e + c[9] * u,
        c[3] + 2.0 * c[6] * u + c[8] * e + c[9] * n,
    )


@borrowing_kernel
def _along_ray(c: Array, e: float, n: float, u: float, direction: Vector) -> Parabola:
    # Return a polynomial along a ray from (e, n, u) as a parabola in s.
    de, dn, du = direction
    ge, gn, gu = _gradient(c, e, n, u)
    curvature = (
        c[4] * de * de + c[5] * dn * dn + c[6] * du * du + c[7] * de * dn + c[8] * de * du + c[9] * dn * du
    )
    return _value_at(c, e, n, u), ge * de + gn * dn + gu * du, curvature


@borrowing_kernel
def _first_zero(a: float, b: float, c: float) -> float:
    # Smallest s > 0 with a + b s + c s s = 0, for a > 0 and b < 0; NaN without a solution.
    if not (a > 0.0 and b < 0.0):
        return math.nan
    discriminant = b * b - 4.0 * a * c
    if not discriminant >= 0.0:
        return math.nan
    return 2.0 * a / (-b + math.sqrt(discriminant))


@borrowing_kernel
def _write_pixel(
    frames: LineFrames, position: Vector, direction: Vector, out: Array, line: int, column: int
) -> None:
    # Write map position, height and camera angles of a pixel at (e, n, u), seen in direction (de, dn, du).
    e, n, u = position
    de, dn, du = direction
    out[0, line, column] = _value_at(frames.x[line], e, n, u)
    out[1, line, column] = _value_at(frames.y[line], e, n, u)
    out[2, line, column] = _value_at(frames.height[line], e, n, u)
    # vertical at the ground, not at the camera
    ve, vn, vu = _gradient(frames.height[line], e, n, u)
    upwards = -(ve * de + vn * dn + vu * du)
    # from sine and cosine: an arc cosine loses half the digits near the zenith
    ce, cn, cu = vn * du - vu * dn, vu * de - ve * du, ve * dn - vn * de
    out[3, line, column] = math.degrees(math.atan2(math.sqrt(ce * ce + cn * cn + cu * cu), upwards))
    length = ve * ve + vn * vn + vu * vu
    along = upwards / length
    level_e, level_n = -de - along * ve, -dn - along * vn
    if math.hypot(level_e, level_n) < _UPRIGHT:
        out[4, line, column] = 0.0
        return
    # meridians converge: north at the ground is rotated against north at the camera
    azimuth = math.degrees(math.atan2(level_e, level_n) + frames.convergence[line] * e)
    out[4, line, column] = azimuth % 360.0


@borrowing_kernel
def _direction(rays: LineRays, line: int, column: int) -> Vector:
    # Return the direction of a column in the frame of the line.
    a, b, c = rays.look[column, 0], rays.look[column, 1], rays.look[column, 2]
    m = rays.rotation[line]
    return (
        m[0, 0] * a + m[0, 1] * b + m[0, 2] * c,
        m[1, 0] * a + m[1, 1] * b + m[1, 2] * c,
        m[2, 0] * a + m[2, 1] * b + m[2, 2] * c,
    )


@kernel
def level_places(rays: LineRays, frames: LineFrames, ground: float, out: Array) -> None:
    # Intersect the rays of lines with the surface at ``ground`` [m] above the ellipsoid.
    #
    # ``out`` (`PLACES`, line, column) is written; NaN where a ray meets no ground.
    for line in range(rays.origin.shape[0]):
        e, n, u = rays.origin[line, 0], rays.origin[line, 1], rays.origin[line, 2]
        for column in range(rays.look.shape[0]):
            direction = _direction(rays, line, column)
            h0, h1, h2 = _along_ray(frames.height[line], e, n, u, direction)
            s = _first_zero(h0 - ground, h1, h2)
            if not s > 0.0:
                for k in range(PLACES):
                    out[k, line, column] = np.nan
                continue
            de, dn, du = direction
            _write_pixel(frames, (e + s * de, n + s * dn, u + s * du), direction, out, line, column)


@borrowing_kernel
def _parabola_at(parabola: Parabola, s: float) -> float:
    return parabola[0] + s * (parabola[1] + s * parabola[2])


@borrowing_kernel
def _height_above(
    heights: Array, i: int, j: int, ray: tuple[Parabola, Parabola, Parabola], s: float
) -> float:
    # Height of a ray above the bilinear patch of cell (i, j) [m]; NaN over a hole.
    row, col, h = ray
    v, w = _parabola_at(row, s) - i, _parabola_at(col, s) - j
    lower = heights[i, j] + w * (heights[i, j + 1] - heights[i, j])
    upper = heights[i + 1, j] + w * (heights[i + 1, j + 1] - heights[i + 1, j])
    surface: float = lower + v * (upper - lower)
    return _parabola_at(h, s) - surface


@borrowing_kernel
def _intersection(
    heights: Array,
    i: int,
    j: int,
    ray: tuple[Parabola, Parabola, Parabola],
    low: float,
    height_low: float,
    high: float,
    height_high: float,
) -> float:
    # Find the intersection by the Illinois method between ``low`` (above the patch) and ``high`` (not above).
    side = 0
    for _ in range(60):
        if height_high == height_low:
            break
        middle = (low * height_high - high * height_low) / (height_high - height_low)
        height = _height_above(heights, i, j, ray, middle)
        if abs(height) < _SURFACE:
            return middle
        if height > 0.0:
            low, height_low = middle, height
            if side == 1:
                height_high *= 0.5
            side = 1
        else:
            high, height_high = middle, height
            if side == -1:
                height_low *= 0.5
            side = -1
    return 0.5 * (low + high)


@borrowing_kernel
def _to_border(position: float, speed: float, low: float, high: float) -> float:
    if speed > _MIN_SPEED:
        return (high - position) / speed
    if speed < -_MIN_SPEED:
        return (low - position) / speed
    return math.inf


@borrowing_kernel
def _to_raster(position: float, speed: float, last: float) -> float:
    # Return the distance to the interval from 0 to ``last``: 0 inside, infinite where the ray never enters
    # it.
    if 0.0 <= position <= last:
        return 0.0
    gap = -position if position < 0.0 else last - position
    if gap * speed <= 0.0 or abs(speed) < _MIN_SPEED:
        return math.inf
    return gap / speed


@borrowing_kernel
def _first_hit(raster: Raster, ray: tuple[Parabola, Parabola, Parabola]) -> float:
    # Return the distance s at which a ray (row, column, height) first meets the raster; NaN where unknown.
    heights, block_max, lowest, highest = raster.heights, raster.block_max, raster.lowest, raster.highest
    row, col, h = ray
    last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
    end = _first_zero(h[0] - (lowest - _MARGIN), h[1], h[2])
    if not end > 0.0:
        return math.nan
    s = 0.0
    if h[0] > highest + _MARGIN:
        s = _first_zero(h[0] - (highest + _MARGIN), h[1], h[2])
    is_unknown = True  # whether the ray may already be below the surface
    for _ in range(8 * (last_row + last_col + 8)):
        if not s < end:
            return math.nan
        y, x = _parabola_at(row, s), _parabola_at(col, s)
        vy, vx = row[1] + 2.0 * s * row[2], col[1] + 2.0 * s * col[2]
        nudge = _BORDER_STEP / max(abs(vy), abs(vx), _MIN_SPEED)
        to_raster = max(_to_raster(y, vy, last_row), _to_raster(x, vx, last_col))
        if to_raster > 0.0:
            s += to_raster + nudge
            is_unknown = True
            continue
        i, j = min(int(y), last_row - 1), min(int(x), last_col - 1)
        # skip a block if the ray leaves it above its highest point
        bi, bj = i // BLOCK, j // BLOCK
        leave = (
            s
            + nudge
            + min(
                _to_border(y, vy, bi * BLOCK, min((bi + 1) * BLOCK, last_row)),
                _to_border(x, vx, bj * BLOCK, min((bj + 1) * BLOCK, last_col)),
            )
        )
        if leave < end and _parabola_at(h, leave) > block_max[bi, bj]:
            is_unknown = block_max[bi, bj] == -math.inf
            s = leave
            continue
        leave = s + nudge + min(_to_border(y, vy, i, i + 1), _to_border(x, vx, j, j + 1))
        leave = min(leave, end)
        height = _height_above(heights, i, j, ray, s)
        height_leave = _height_above(heights, i, j, ray, leave)
        if math.isnan(height) or math.isnan(height_leave):
            is_unknown = True
            s = leave
            continue
        if height <= 0.0:
            return math.nan if is_unknown and height < -_SURFACE else s
        is_unknown = False
        if height_leave <= 0.0:
            return _intersection(heights, i, j, ray, s, height, leave, height_leave)
        # above a patch the height is a parabola, which may have two roots between s and ``leave``
        halfway = _height_above(heights, i, j, ray, 0.5 * (s + leave))
        curvature, slope = (
            2.0 * (height + height_leave - 2.0 * halfway),
            4.0 * halfway - 3.0 * height - height_leave,
        )
        if curvature > 0.0 and 0.0 < -slope < 2.0 * curvature:
            summit = s - slope / (2.0 * curvature) * (leave - s)
            height_summit = _height_above(heights, i, j, ray, summit)
            if height_summit <= 0.0:
                return _intersection(heights, i, j, ray, s, height, summit, height_summit)
        s = leave
    return math.nan


@kernel
def raster_places(rays: LineRays, frames: LineFrames, raster: Raster, out: Array) -> None:
    # Intersect the rays of lines with the bilinear surface through a raster; see `level_places`.
    #
    # The first intersection counts. A ray that is below the surface where it leaves a hole or enters the
    # raster has met the ground at an unknown position: its results are NaN.
    for line in range(rays.origin.shape[0]):
        e, n, u = rays.origin[line, 0], rays.origin[line, 1], rays.origin[line, 2]
        for column in range(rays.look.shape[0]):
            direction = _direction(rays, line, column)
            ray = (
                _along_ray(raster.row[line], e, n, u, direction),
                _along_ray(raster.col[line], e, n, u, direction),
                _along_ray(frames.height[line], e, n, u, direction),
            )
            s = _first_hit(raster, ray)
            if not s > 0.0:
                for k in range(PLACES):
                    out[k, line, column] = np.nan
                continue
            de, dn, du = direction
            _write_pixel(frames, (e + s * de, n + s * dn, u + s * du), direction, out, line, column)
