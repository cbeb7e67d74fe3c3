"""Reference systems and maps of the earth, through pyproj (extra ``geo``)."""

import functools
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base import (
    WGS84_ECCENTRICITY_SQUARED,
    WGS84_SEMI_MAJOR_AXIS_M,
    Floats,
    SchemaError,
    needs_extra,
)

GEODETIC = "EPSG:4979"  # latitude, longitude, height above the ellipsoid of WGS 84
_GEOCENTRIC = "EPSG:4978"
_MAX_LATITUDE_DEG = 89.9  # nearer to a pole, east and north rotate too fast for a polynomial


def _pyproj() -> Any:
    with needs_extra("pyproj", "geo", "placing pixels on a map"):
        import pyproj
    return pyproj


@functools.lru_cache(maxsize=64)
def _crs(text: str) -> Any:
    return _pyproj().CRS.from_user_input(text).to_2d()


@functools.lru_cache(maxsize=64)
def _transformer(source: str, target: str) -> Any:
    # x or longitude come first; only `GEODETIC` and geocentric X, Y, Z [m] have heights [m]; other systems
    # are reduced to two dimensions
    systems = (name if name in (GEODETIC, _GEOCENTRIC) else _crs(name) for name in (source, target))
    return _pyproj().Transformer.from_crs(*systems, always_xy=True)


def crs_of(crs: Any) -> str:
    # Return a reference system as text: its EPSG code, else WKT.
    #
    # ``crs``: A reference system in a form that pyproj reads: ``"EPSG:32617"``, 32617, WKT, a CRS of pyproj
    # or rasterio.
    #
    # Raises `SchemaError`: PROJ does not know it, or it is not of the earth's surface. Raises
    # `MissingExtraError`: pyproj is not installed.
    pyproj = _pyproj()
    try:
        system = pyproj.CRS.from_user_input(crs).to_2d()
    except pyproj.exceptions.CRSError as error:
        raise SchemaError(
            f"crs {crs!r:.80} is unknown to PROJ", expected="such as 'EPSG:32617'", code="crs-unknown"
        ) from error
    SchemaError.raise_if(
        not (system.is_projected or system.is_geographic),
        f"crs {crs!r:.80} is neither projected nor geographic",
        expected="such as 'EPSG:32617'",
        code="crs-unusable",
    )
    code = system.to_authority(min_confidence=100)
    return ":".join(code) if code and pyproj.CRS(":".join(code)) == system else system.to_wkt()


class Vertical(NamedTuple):
    # Heights of a compound or three-dimensional reference system.
    name: str
    unit: str
    metres: float  #: Metres of a unit upwards; negative for depths
    reference: str  #: ``"ellipsoid"`` or ``"geoid"``, the surface from which heights are measured


def vertical_of(crs: Any) -> Vertical | None:
    # Return the heights of a reference system; None where it has none.
    #
    # ``crs``: as in `crs_of`, which reports a system that PROJ does not know.
    system = _pyproj().CRS.from_user_input(crs)
    parts = [part for part in system.sub_crs_list if part.is_vertical] or [system]
    axis = next((axis for axis in parts[0].axis_info if axis.direction in ("up", "down")), None)
    if axis is None:
        return None
    is_ellipsoidal = parts[0].is_geographic or "ellips" in parts[0].name.lower()
    sign = -1.0 if axis.direction == "down" else 1.0
    reference = "ellipsoid" if is_ellipsoidal else "geoid"
    return Vertical(parts[0].name, axis.unit_name, sign * axis.unit_conversion_factor, reference)


def utm_zone(latitude: float, longitude: float) -> str:
    """Return the EPSG code of the UTM zone of a position, on WGS 84.

    The irregular zones of Norway and Svalbard are included.

    Parameters
    ----------
    latitude, longitude
        [degree].

    Returns
    -------
    str
        Such as ``"EPSG:32617"``.

    Raises
    ------
    SchemaError
        The position is not finite, or beyond 84 degrees north or 80 degrees south.

    Examples
    --------
    >>> utm_zone(34.0, -81.0)
    'EPSG:32617'
    >>> utm_zone(60.4, 5.3)
    'EPSG:32632'
    """
    SchemaError.raise_if(
        not (-80.0 <= latitude <= 84.0 and np.isfinite(longitude)),
        f"no UTM zone at latitude {latitude:g}, longitude {longitude:g}",
        mend="pass crs=",
        code="crs-missing",
    )
    longitude = (longitude + 180.0) % 360.0 - 180.0
    zone = int((longitude + 180.0) // 6.0) + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude >= 72.0 and 0.0 <= longitude < 42.0:
        zone = (31, 33, 35, 37)[int((longitude + 3.0) // 12.0)]
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def meridian_convergence(latitude: npt.ArrayLike, longitude: npt.ArrayLike, crs: Any) -> Floats:
    """Return the direction of grid north, clockwise from true north [degree].

    Parameters
    ----------
    latitude, longitude
        [degree].
    crs
        Projected reference system.

    Returns
    -------
    float64
        Positive where grid north lies east of true north; 0 for a geographic system.

    Raises
    ------
    SchemaError
        PROJ does not know the system.
    MissingExtraError
        pyproj is not installed.

    Examples
    --------
    East of the central meridian, in the northern hemisphere, grid north lies to the east of true north:

    >>> round(float(meridian_convergence(45.0, -80.0, "EPSG:32617")), 4)
    0.7071
    """
    pyproj = _pyproj()
    system = _crs(crs_of(crs))
    latitude, longitude = np.broadcast_arrays(np.asarray(latitude, float), np.asarray(longitude, float))
    return (
        np.zeros(latitude.shape)
        if system.is_geographic
        else np.asarray(pyproj.Proj(system).get_factors(longitude, latitude).meridian_convergence, np.float64)
    )


def grid_mapping_attrs(crs: str) -> dict[str, Any]:
    # Return the CF attributes of a ``spatial_ref`` coordinate.
    system = _crs(crs)
    return {**system.to_cf(), "spatial_ref": system.to_wkt()}


def between_maps(positions: Floats, source: str, target: str) -> Floats:
    # Return positions (n, 2) converted between reference systems, x or longitude first.
    if source == target:
        return positions
    x, y = _transformer(source, target).transform(positions[:, 0], positions[:, 1])
    return np.stack([x, y], axis=-1)


def is_in_metres(crs: str) -> bool:
    # Return whether a reference system is a map with coordinates in metres to the east and north.
    #
    # Axes to the west or south (EPSG:2053) would mirror every map.
    system = _crs(crs)
    directions = {axis.direction.lower() for axis in system.axis_info}
    # both axes of a map of the north pole may point south
    if "west" in directions or {"south", "east"} <= directions:
        return False
    return system.is_projected and all(axis.unit_conversion_factor == 1.0 for axis in system.axis_info)


def near_turns(x: Floats, middle: float, crs: str) -> Floats:
    # Return the shift in full turns that brings x nearest to ``middle``.
    #
    # Multiples of 360 where x is a longitude [degree]; 0 on a map.
    return (
        np.zeros_like(x)
        if not _crs(crs).is_geographic
        else np.asarray(360.0 * np.round((middle - x) / 360.0))
    )


# --- frames of lines ---------------------------------------------------------------------------------------

_OFFSETS = np.array(
    [(0, 0, 0)]
    + [tuple(sign * (axis == k) for k in range(3)) for axis in range(3) for sign in (1, -1)]
    + [
        tuple(a if k == i else b if k == j else 0 for k in range(3))
        for i, j in ((0, 1), (0, 2), (1, 2))
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ],
    dtype=np.float64,
)  # points around the camera, whose differences give a polynomial of second degree


def polynomials(
    latitude: Floats, longitude: Floats, altitude: Floats, reach: Floats, crs: str
) -> tuple[Floats, Floats, Floats]:
    # Return map coordinates and height around cameras, as polynomials of metres east, north and up.
    #
    # ``latitude``, ``longitude``, ``altitude`` (line,): Position of every camera [degree, m above the
    # ellipsoid]. ``reach`` (line,): Distance from the camera up to which the polynomials are accurate [m].
    # ``crs``: Map, as `crs_of` returns it.
    #
    # Returns: ``x, y, height`` (line, 10), float64: Coefficients in the order of `hyperpaint.kernels.rays`;
    # NaN where the position is NaN.
    #
    # Direction of north and scale of a map change from place to place. Terms beyond the second degree are of
    # the order of d (d / R)^2, for a distance d on an earth of radius R: 25 nm at 100 m, 0.2 mm at 2 km.
    coefficients = np.full((3, latitude.size, 10), np.nan)
    is_valid = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(altitude) & np.isfinite(reach)
    is_valid &= np.abs(latitude) < _MAX_LATITUDE_DEG
    if is_valid.any():
        lat, lon, alt, distance = (part[is_valid] for part in (latitude, longitude, altitude, reach))
        # map coordinates and heights of points around the cameras
        geocentric = _transformer(GEODETIC, _GEOCENTRIC)
        origin = np.stack(geocentric.transform(lon, lat, alt), axis=-1)
        points = origin[:, None] + (_OFFSETS * distance[:, None, None]) @ east_north_up(lat, lon)
        lon, lat, height = geocentric.transform(*np.moveaxis(points, -1, 0), direction="INVERSE")
        x, y, *_ = _transformer(GEODETIC, crs).transform(lon, lat, height)
        if _crs(crs).is_geographic:
            x = x[:, :1] + (x - x[:, :1] + 180.0) % 360.0 - 180.0
        fitted = np.stack([_coefficients(np.asarray(value), distance) for value in (x, y, height)])
        coefficients[:, is_valid] = np.where(np.isfinite(fitted), fitted, np.nan)  # infinite outside the map
    return coefficients[0], coefficients[1], coefficients[2]


def east_north_up(latitude: Floats, longitude: Floats) -> Floats:
    phi, lam = np.radians(latitude), np.radians(longitude)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    rows = [
        [-sin_lon, cos_lon, np.zeros_like(sin_lat)],
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _coefficients(value: Floats, reach: Floats) -> Floats:
    # Return ten coefficients (line, 10) from values at `_OFFSETS` times the reach (line, 19).
    centre, axis_points, corners = (
        value[:, 0],
        value[:, 1:7].reshape(-1, 3, 2),
        value[:, 7:].reshape(-1, 3, 4),
    )
    linear_terms = (axis_points[..., 0] - axis_points[..., 1]) / (2.0 * reach[:, None])
    square_terms = (axis_points[..., 0] + axis_points[..., 1] - 2.0 * centre[:, None]) / (
        2.0 * reach[:, None] ** 2
    )
    equal_signs, opposite_signs = corners[..., 0] + corners[..., 3], corners[..., 1] + corners[..., 2]
    mixed_terms = (equal_signs - opposite_signs) / (4.0 * reach[:, None] ** 2)
    return np.concatenate([centre[:, None], linear_terms, square_terms, mixed_terms], axis=1)


def turn_of_north(latitude: Floats) -> Floats:
    # Return the rotation of true north per metre to the east [rad m-1].
    phi = np.radians(latitude)
    radius = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    return np.asarray(np.tan(phi) / radius)
