"""Rays of a line camera to the ground: a level surface, or a raster of heights.

Every line has a local frame: metres to the east (e), north (n) and up (u) of its navigation position. Map
coordinates, raster coordinates and ellipsoidal height are polynomials of second degree in (e, n, u), with ten
coefficients in the order ``1 e n u ee nn uu en eu nu``. Along a straight ray each is a parabola in the
distance s from the camera.

Line and column of a flight line at every cell of a map: the inverse of the map position of its pixels.

Four neighbouring pixels span a quadrilateral on the map, and a bilinear patch between the lines and columns.
Every cell whose centre lies in it gets the fractional line and column of the patch at that centre.
"""

import math

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import borrowing_kernel, kernel

from .arguments import BLOCK, InverseTile, LineFrames, LinePositions, LineRays, MapCells, Places, Raster

# Rule that selects one of several patches over a cell: nearest to the middle column, first line, last line.
NADIR, FIRST, LAST = 0, 1, 2

# Lower edges of a patch are moved outwards and upper edges inwards by this fraction of the patch: a centre on
# a common edge belongs to one patch in spite of rounding.
_EDGE = 1e-9
# Outer edges of a flight line are moved outwards by this fraction of a patch: rounding of map coordinates.
_OUTER_EDGE = 1e-6


@kernel
def _inside_patch(
    p: tuple[float, float],
    a: tuple[float, float],
    b: tuple[float, float],
    c: tuple[float, float],
    start: tuple[float, float],
    end: tuple[float, float],
) -> tuple[bool, float, float]:
    # Solve p = u a + v b + u v c with u and v within limits, and u and v in 0 to 1.
    # Eliminating u leaves a quadratic in v, solved in the form without cancellation.
    px, py = p
    ax, ay = a
    bx, by = b
    cx, cy = c
    k2 = by * cx - bx * cy
    k1 = ax * by - ay * bx + px * cy - py * cx
    k0 = ay * px - ax * py
    discriminant = k1 * k1 - 4.0 * k2 * k0
    if not discriminant >= 0.0:
        return False, 0.0, 0.0
    q = -0.5 * (k1 + math.copysign(math.sqrt(discriminant), k1))
    for root in range(2):
        v = math.nan
        if root == 0 and q != 0.0:
            v = k0 / q
        elif root == 1 and k2 != 0.0:
            v = q / k2
        if not start[1] <= v < end[1]:
            continue
        jx, jy = ax + v * cx, ay + v * cy
        if jx == 0.0 and jy == 0.0:
            continue
        u = (px - v * bx) / jx if abs(jx) > abs(jy) else (py - v * by) / jy
        if start[0] <= u < end[0]:
            return True, min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    return False, 0.0, 0.0


@kernel
def _nearest_corner(
    px: float, py: float, ax: float, ay: float, bx: float, by: float, fx: float, fy: float
) -> tuple[int, int]:
    # Return line and column offset (0 or 1) of the nearest of the corners at 0, a, b and b + f.
    line, column = 0, 0
    shortest = px * px + py * py
    distance = (px - ax) ** 2 + (py - ay) ** 2
    if distance < shortest:
        shortest, column = distance, 1
    qx, qy = px - bx, py - by
    distance = qx * qx + qy * qy
    if distance < shortest:
        shortest, line, column = distance, 1, 0
    if (qx - fx) ** 2 + (qy - fy) ** 2 < shortest:
        line, column = 1, 1
    return line, column


@kernel
def _to_cells(
    east: Array, north: Array, frame: Array, x: Array, y: Array, reach: tuple[float, float, float, float]
) -> tuple[int, int]:
    # Write the pixels of a line in cell coordinates; return the first and last column within reach.
    # ``reach`` holds the least and largest row, then column, of a corner of any patch over the tile.
    for j in range(east.size):  # a loop without branches, which vectorises
        e, n = east[j] - frame[0], north[j] - frame[1]
        x[j] = frame[2] * e + frame[3] * n
        y[j] = frame[4] * e + frame[5] * n
    first, last = 0, east.size - 1
    while first <= last and not (reach[0] <= y[first] <= reach[1] and reach[2] <= x[first] <= reach[3]):
        first += 1
    while last > first and not (reach[0] <= y[last] <= reach[1] and reach[2] <= x[last] <= reach[3]):
        last -= 1
    return first, last


@kernel
def invert_lines(positions: LinePositions, first: int, last: int, cells: MapCells, out: InverseTile) -> None:
    # Write line and column at every cell of a tile, as far as the given lines cover it.
    #
    # ``first`` is the number of the first line in ``positions``, ``last`` of the last line of the flight.
    # Lines may overlap earlier ones: patches of all orientations are visited.
    east, north, hidden = positions.east, positions.north, positions.hidden
    pixel_position, nearest, rank, hits = out
    frame, (first_row, first_col), rule = cells.frame, cells.corner, cells.rule
    last_row, last_col = first_row + hits.shape[0] - 1.0, first_col + hits.shape[1] - 1.0
    columns = east.shape[1]
    x0, y0, x1, y1 = np.empty(columns), np.empty(columns), np.empty(columns), np.empty(columns)
    bounds = np.empty((5, columns))
    # a corner of a patch is at most twice the longest edge away from a cell inside the patch
    margin = 2.0 * cells.longest + 1.0
    reach = (first_row - margin, last_row + margin, first_col - margin, last_col + margin)
    start0, stop0 = _to_cells(positions.east_before, positions.north_before, frame, x0, y0, reach)
    for i in range(east.shape[0]):
        start1, stop1 = _to_cells(east[i], north[i], frame, x1, y1, reach)
        start, stop = max(start0, start1), min(stop0, stop1)
        start_v = -_OUTER_EDGE if first + i == 1 else -_EDGE
        end_v = 1.0 + _OUTER_EDGE if first + i == last else 1.0 - _EDGE
        if start < stop:
            for j in range(start, stop + 1):
                bounds[0, j], bounds[1, j] = min(x0[j], x1[j]) - _OUTER_EDGE, max(x0[j], x1[j]) + _OUTER_EDGE
                bounds[2, j], bounds[3, j] = min(y0[j], y1[j]) - _OUTER_EDGE, max(y0[j], y1[j]) + _OUTER_EDGE
                bounds[4, j] = x0[j] + y0[j] + x1[j] + y1[j]
            for j in range(start, stop):
                if not abs(bounds[4, j] + bounds[4, j + 1]) < math.inf:  # a corner is unknown
                    continue
                if hidden.size and hidden[i, j]:
                    continue
                left, right = min(bounds[0, j], bounds[0, j + 1]), max(bounds[1, j], bounds[1, j + 1])
                upper, lower = min(bounds[2, j], bounds[2, j + 1]), max(bounds[3, j], bounds[3, j + 1])
                top_row, left_col = math.ceil(max(upper, first_row)), math.ceil(max(left, first_col))
                if top_row > min(lower, last_row) or left_col > min(right, last_col):  # no centre in between
                    continue
                ax, ay = x0[j + 1] - x0[j], y0[j + 1] - y0[j]
                bx, by = x1[j] - x0[j], y1[j] - y0[j]
                fx, fy = x1[j + 1] - x1[j], y1[j + 1] - y1[j]
                gx, gy = x1[j + 1] - x0[j + 1], y1[j + 1] - y0[j + 1]
                longest_squared = max(ax * ax + ay * ay, bx * bx + by * by)
                edge_squared = max(longest_squared, max(fx * fx + fy * fy, gx * gx + gy * gy))
                if edge_squared > cells.longest * cells.longest:
                    continue
                start_u = -_OUTER_EDGE if j == 0 else -_EDGE
                end_u = 1.0 + _OUTER_EDGE if j == columns - 2 else 1.0 - _EDGE
                for row in range(top_row, math.floor(min(lower, last_row)) + 1):
                    for col in range(left_col, math.floor(min(right, last_col)) + 1):
                        px, py = col - x0[j], row - y0[j]
                        inside, u, v = _inside_patch(
                            (px, py),
                            (ax, ay),
                            (bx, by),
                            (fx - ax, fy - ay),
                            (start_u, start_v),
                            (end_u, end_v),
                        )
                        if not inside:
                            continue
                        r, c = row - first_row, col - first_col
                        if hits[r, c] < 65535:
                            hits[r, c] += 1
                        line, sample = first + i - 1 + v, j + u
                        rank_here = abs(sample - 0.5 * (columns - 1))
                        if rule == FIRST:
                            rank_here = line
                        elif rule == LAST:
                            rank_here = -line
                        if rank_here < rank[r, c]:
                            rank[r, c] = rank_here
                            pixel_position[0, r, c] = line
                            pixel_position[1, r, c] = sample
                            line_step, column_step = _nearest_corner(px, py, ax, ay, bx, by, fx, fy)
                            nearest[0, r, c] = first + i - 1 + line_step
                            nearest[1, r, c] = j + column_step
        x0, x1 = x1, x0
        y0, y1 = y1, y0
        start0, stop0 = start1, stop1


@kernel
def fill_between(ends: Array, frame: Array, corner: tuple[int, int], inside: Array) -> None:
    # Mark the cells whose centres lie between the ends of successive lines: ``inside`` (row, col).
    #
    # ``ends`` (pair, 4, 2) are east and north of the corners of the area between two lines, in the order
    # around it [m]; ``frame`` and ``corner`` those of `hyperpaint.kernels.arguments.MapCells`.
    first_row, first_col = corner
    last_row, last_col = first_row + inside.shape[0] - 1.0, first_col + inside.shape[1] - 1.0
    x, y, crossing = np.empty(4), np.empty(4), np.empty(4)
    for pair in range(ends.shape[0]):
        low, high = math.inf, -math.inf
        for k in range(4):
            e, n = ends[pair, k, 0] - frame[0], ends[pair, k, 1] - frame[1]
            x[k] = frame[2] * e + frame[3] * n
            y[k] = frame[4] * e + frame[5] * n
            low, high = min(low, y[k]), max(high, y[k])
        if not (high >= first_row and low <= last_row):
            continue
        for row in range(math.ceil(max(low, first_row)), math.floor(min(high, last_row)) + 1):
            count = 0
            for k in range(4):
                k1 = (k + 1) % 4
                if (y[k] <= row) != (y[k1] <= row):
                    x_cross = x[k] + (row - y[k]) / (y[k1] - y[k]) * (x[k1] - x[k])
                    slot = count
                    while slot > 0 and crossing[slot - 1] > x_cross:
                        crossing[slot] = crossing[slot - 1]
                        slot -= 1
                    crossing[slot] = x_cross
                    count += 1
            for k in range(0, count - 1, 2):
                if crossing[k] > last_col or crossing[k + 1] < first_col:
                    continue
                for col in range(
                    math.ceil(max(crossing[k], first_col)), math.floor(min(crossing[k + 1], last_col)) + 1
                ):
                    inside[row - first_row, col - first_col] = True


@kernel
def look_at_lines(east: Array, north: Array, frame: Array, out: Array) -> None:
    # Write bounding box and ends of the located pixels of lines; lines without located pixels keep NaN.
    #
    # ``frame`` (6,) are east and north of an anchor, then the factors that turn offsets from it into
    # distances to the right and down. ``out`` (line, 8 or more): least and largest distance to the right and
    # down [m], then east and north of the first and the last pixel.
    for line in range(east.shape[0]):
        left, right, upper, lower = math.inf, -math.inf, math.inf, -math.inf
        for column in range(east.shape[1]):
            if not (math.isfinite(east[line, column]) and math.isfinite(north[line, column])):
                continue
            e, n = east[line, column] - frame[0], north[line, column] - frame[1]
            x, y = frame[2] * e + frame[3] * n, frame[4] * e + frame[5] * n
            if left == math.inf:
                out[line, 4], out[line, 5] = east[line, column], north[line, column]
            out[line, 6], out[line, 7] = east[line, column], north[line, column]
            left, right = min(left, x), max(right, x)
            upper, lower = min(upper, y), max(lower, y)
        if left < math.inf:
            out[line, 0], out[line, 1], out[line, 2], out[line, 3] = left, right, upper, lower


# --- spectra of a slab of lines, copied or interpolated to the cells of a map ------------------------------


# Columns transposed together: one cache line of float32.
_COLUMNS = 16


@kernel
def _transpose(source: Array, start: int, stop: int, out: Array) -> None:
    # Copy (band, column) to (column, band).
    for block in range(start, stop, _COLUMNS):
        end = min(block + _COLUMNS, stop)
        for band in range(source.shape[0]):
            for column in range(block, end):
                out[column, band] = source[band, column]


@kernel
def gather_nearest(
    slab: Array, lines: Array, columns: Array, cells: Array, spectra: Array, out: Array
) -> None:
    # Copy the spectra of pixels of a slab (line, band, column) to ``out`` (cell, band).
    #
    # ``lines`` and ``columns`` (pixel,) are the pixels in the order of their lines, ``cells`` (pixel,) their
    # targets; ``spectra`` (column, band) is a buffer of the dtype of ``out``.
    k = 0
    while k < lines.size:
        stop, low, high = k, columns[k], columns[k]
        while stop < lines.size and lines[stop] == lines[k]:
            low, high = min(low, columns[stop]), max(high, columns[stop])
            stop += 1
        _transpose(slab[lines[k]], low, high + 1, spectra)
        for pixel in range(k, stop):
            column, cell = columns[pixel], cells[pixel]
            for band in range(spectra.shape[1]):
                out[cell, band] = spectra[column, band]
        k = stop


@kernel
def gather_bilinear(
    slab: Array, after: Array, places: Places, spectra: Array, next_spectra: Array, out: Array
) -> None:
    # Write spectra (cell, band), interpolated between four pixels of a slab (line, band, column).
    #
    # A value is NaN where a pixel that has weight is NaN. ``after`` (band, column) is the line that follows
    # the slab; ``spectra`` and ``next_spectra`` (column, band) are buffers of the dtype of ``out``.
    lines, columns, along, across, cells = places
    last = slab.shape[2] - 1
    k = 0
    while k < lines.size:
        line = lines[k]
        stop, low, high = k, columns[k], columns[k]
        while stop < lines.size and lines[stop] == line:
            low, high = min(low, columns[stop]), max(high, columns[stop])
            stop += 1
        high = min(high + 1, last)
        _transpose(slab[line], low, high + 1, spectra)
        if line + 1 < slab.shape[0]:
            _transpose(slab[line + 1], low, high + 1, next_spectra)
        else:
            _transpose(after, low, high + 1, next_spectra)
        for number in range(k, stop):
            along_share, across_share = along[number], across[number]
            left = columns[number]
            right = left if across_share == 0 else left + 1
            lower = spectra
            upper = lower if along_share == 0 else next_spectra
            cell = cells[number]
            for band in range(out.shape[1]):
                before = lower[left, band] + across_share * (lower[right, band] - lower[left, band])
                next_value = upper[left, band] + across_share * (upper[right, band] - upper[left, band])
                out[cell, band] = before + along_share * (next_value - before)
        k = stop


# --- inverse maps ------------------------------------------------------------------------------------------

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
    return 2.0 * a / (-b + math.sqrt(discriminant)) if discriminant >= 0.0 else math.nan


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
    return (low - position) / speed if speed < -_MIN_SPEED else math.inf


@borrowing_kernel
def _to_raster(position: float, speed: float, last: float) -> float:
    # Return the distance to the interval from 0 to ``last``: 0 inside, infinite where the ray never enters
    # it.
    if 0.0 <= position <= last:
        return 0.0
    gap = -position if position < 0.0 else last - position
    return math.inf if gap * speed <= 0.0 or abs(speed) < _MIN_SPEED else gap / speed


@borrowing_kernel
def _first_hit(raster: Raster, ray: tuple[Parabola, Parabola, Parabola]) -> float:
    # Return the distance s at which a ray (row, column, height) first meets the raster; NaN where unknown.
    heights, block_max, lowest, highest = raster.heights, raster.block_max, raster.lowest, raster.highest
    row, col, h = ray
    last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
    end = _first_zero(h[0] - (lowest - _MARGIN), h[1], h[2])
    if not end > 0.0:
        return math.nan
    s = _first_zero(h[0] - (highest + _MARGIN), h[1], h[2]) if h[0] > highest + _MARGIN else 0.0
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
