"""One car seen by several lines: signatures joined by place, flakes found by the change with angle.

Lines of a flight overlap, so that a car is seen from different angles to the mirrored sun. Its lean is the
same in all views, and changes the level of a solid paint equally: this does not make the level of solid
paint more certain. A change with the angle shows flakes, and a stray value shows what one view mirrors.
"""

import json
from types import SimpleNamespace

import numpy as np
import xarray as xr
from scipy.cluster.hierarchy import fcluster, linkage

from hyperpaint.base import (
    BAND,
    LIBRARY_VARIABLES,
    SIGNATURE,
    Floats,
    Problems,
    SchemaError,
    finite_mean,
    is_number,
    schema,
    takes_quantities,
)

VIEWS = SimpleNamespace(
    #: Length of a degree of latitude [m].
    degree_m=111_195.0,
    #: Smallest range of angles, seen in several views, that decides on a finish [degree].
    min_range_deg=8.0,
    #: Relative uncertainty of the level of a view where its region states none [1].
    unstated_u=0.05,
)
#: Relative change of level per degree of aspecular angle: at least that of flakes, and at most that of solid
#: paint [degree-1]. Flop indices of 5 to 17 change by 1.3 to 3.5 % a degree between 15 and 110 degrees, and
#: solid paint by none; the mirrored sky leaves 0.3 %.
FLAKE_CHANGE, SOLID_CHANGE = 0.003, 0.006
#: Cause in ``level_terms`` that all views of a car share: it cancels in their differences.
SHARED_CAUSE = "an unknown lean"
#: Largest spectral angle of a view to the median of the views of its car [degree].
MAX_ANGLE_DEG = 3.0


@takes_quantities(distance="m")
def join_views(library: xr.Dataset, *, distance: float = 1.2) -> xr.Dataset:
    r"""Join the signatures of one car from several lines, and judge its finish by their differences.

    Parameters
    ----------
    library
        Signatures of `hyperpaint.extract_signatures` from several lines, whose regions have ``latitude`` and
        ``longitude`` [degree], as those of `hyperpaint.regions.propose_regions` do. Signatures without them
        are cars by themselves.
    distance
        Largest distance between the views of a car [m].

    Returns
    -------
    Dataset
        The same with coordinates ``car`` (signature), the name of the car's best view; ``views``, their
        number; ``is_stray``, whether a view has another spectrum than most of its car's views; ``is_best``,
        true for one view of each car; ``level_change`` and ``level_change_u``, the relative change of its
        level with the angle to the mirrored sun and its standard uncertainty [degree-1], NaN where unknown;
        and ``finish``: "metallic" or "solid" where the change decides it, else as before. ``library.isel(
        signature=library.is_best)`` has each car once.

    Raises
    ------
    SchemaError
        Variables are missing, or ``distance`` is not a positive number.
    UnitsError

    Notes
    -----
    A straight line is fitted to the logarithm of the levels :math:`L_i` of a car over their aspecular angles
    :math:`\alpha_i`, weighted by the stated ``level_uncertainty`` without the lean, if ``level_terms`` has
    it. Its slope s, with the uncertainty u, is that of flakes where :math:`s + 2 u < -0.003` per degree, and
    else of solid paint where :math:`|s| + 2 u < 0.006`, from views over at least 8 degrees.

    The best view of paint with flakes has the smallest uncertainty. Mirrored light only adds to other paint:
    its best view has the smallest upper limit of the level, :math:`L (1 + 2 u)`.

    Examples
    --------
    >>> rows = np.float32([[0.30, 0.20], [0.20, 0.13], [0.40, 0.40]])
    >>> views = xr.Dataset(
    ...     {
    ...         "reflectance": (("signature", "band"), rows, {"units": "1"}),
    ...         "aspecular_angle": ("signature", [20.0, 40.0, 20.0], {"units": "degree"}),
    ...     },
    ...     {
    ...         "signature": ["grey-01", "grey-02", "white-01"],
    ...         "latitude": ("signature", [50.0, 50.000002, 50.0]),
    ...         "longitude": ("signature", [8.0, 8.0, 8.0001]),
    ...         "level_uncertainty": ("signature", [0.02, 0.02, 0.02]),
    ...     },
    ... )
    >>> joined = join_views(views)
    >>> joined.car.values.tolist(), joined.finish.values.tolist()
    (['grey-01', 'grey-01', 'white-01'], ['metallic', 'metallic', 'unknown'])
    """
    with Problems("views cannot be joined", SchemaError) as problems:
        problems.add_if(
            not is_number(distance) or not distance > 0.0,
            f"distance={distance!r}",
            expected="a positive number of metres",
            code="value-out-of-range",
        )
    variables = schema.require(
        library, ["reflectance", "aspecular_angle"], "the views of cars", LIBRARY_VARIABLES
    )
    spectra = variables["reflectance"].transpose(SIGNATURE, BAND).values.astype(np.float64)
    spectra = np.where(schema.good_bands(library), spectra, np.nan)
    angle, names = variables["aspecular_angle"].values, library[SIGNATURE].values
    # a signature without values takes no part in decisions
    level = finite_mean(spectra, axis=1)
    u = _column(library, "level_uncertainty", VIEWS.unstated_u)
    difference_u = u.copy()
    for number, text in enumerate(
        library["level_terms"].values if "level_terms" in library.variables else ()
    ):
        parts = json.loads(text or "{}").items()
        remaining = [part for cause, part in parts if not cause.startswith(SHARED_CAUSE)]
        difference_u[number] = np.hypot.reduce(remaining) if remaining else u[number]
    latitude = _column(library, "latitude")
    longitude = _column(library, "longitude")
    # number of the car (signature,) whose views all lie within a distance [m] of one another; a signature
    # without a place is a car by itself
    placed = np.isfinite(latitude + longitude)
    car = np.arange(latitude.size) + latitude.size
    if placed.sum() > 1:
        scale = np.cos(np.radians(latitude[placed].mean()))
        metres = VIEWS.degree_m * np.stack([latitude[placed], longitude[placed] * scale], axis=1)
        car[placed] = fcluster(linkage(metres, "complete"), distance, "distance")
    finish = (
        library["finish"].values.astype(object)
        if "finish" in library.variables
        else np.full(len(names), "unknown", object)
    )
    best, name = np.zeros(len(names), bool), names.astype(object)
    stray = np.zeros(len(names), bool)
    change, change_u = np.full((2, len(names)), np.nan)
    for number in np.unique(car):
        (views,) = np.nonzero(car == number)
        measured = views[np.isfinite(level[views])]
        # views whose spectra (view, band) have another shape than the median; two views cannot decide
        if measured.size > 2:
            used = np.isfinite(spectra[measured]).all(axis=0)
            shapes = spectra[measured][:, used]
            shapes /= np.linalg.norm(shapes, axis=1, keepdims=True)
            median = np.median(shapes, axis=0)
            is_stray = shapes @ median / np.linalg.norm(median) < np.cos(np.radians(MAX_ANGLE_DEG))
            stray[measured] = is_stray & (2 * is_stray.sum() < measured.size)
        kept = measured[~stray[measured]] if measured.size else views
        angled = kept[np.isfinite(angle[kept] + level[kept])]
        if angled.size and np.ptp(angle[angled]) >= VIEWS.min_range_deg:
            logs = np.log(np.maximum(level[angled], 1e-6))
            # weighted straight line; scatter beyond the uncertainty widens that of its slope
            weight = difference_u[angled] ** -2.0
            centre = angle[angled] - np.average(angle[angled], weights=weight)
            spread = float((weight * centre**2).sum())
            slope = float((weight * centre * logs).sum()) / spread
            residual = logs - np.average(logs, weights=weight) - slope * centre
            excess = float((weight * residual**2).sum()) / max(angled.size - 2, 1)
            slope_u = float(np.sqrt(max(1.0, excess) / spread))
            change[views], change_u[views] = slope, slope_u
            if slope + 2.0 * slope_u < -FLAKE_CHANGE:
                finish[views] = "metallic"
            elif abs(slope) + 2.0 * slope_u < SOLID_CHANGE:
                finish[views] = "solid"
        has_flakes = finish[kept[0]] in ("metallic", "pearl")
        order = u[kept] if has_flakes else level[kept] * (1.0 + 2.0 * u[kept])
        chosen = kept[np.argmin(np.nan_to_num(order, nan=np.inf))]
        best[chosen], name[views] = True, names[chosen]
    counts = np.unique(car, return_inverse=True, return_counts=True)
    columns = {
        "car": name, "views": counts[2][counts[1]], "is_stray": stray, "is_best": best, "finish": finish,
        "level_change": change, "level_change_u": change_u,
    }  # fmt: skip
    units = {"level_change": "degree-1", "level_change_u": "degree-1", "views": "1"}
    return library.assign_coords(
        {
            key: (SIGNATURE, values, {"units": units[key]} if key in units else {})
            for key, values in columns.items()
        }
    )


def _column(library: xr.Dataset, name: str, default: float = np.nan) -> Floats:
    # A property of the regions (signature,), with a default where it is absent or not finite
    absent = xr.full_like(library[SIGNATURE], np.nan, np.float64)
    values = library.get(name, absent).values.astype(np.float64)
    return np.where(np.isfinite(values), values, default)
