"""`extract_signatures`: from regions of flight lines to a library of paints.

Only blocks of lines with pixels of regions are computed, one task a block, which returns these pixels only.
They are reduced in the order of the regions, so that results have the same bits for any chunking.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    AT_GEOMETRY,
    BAND,
    BODY,
    CROSS_TRACK,
    EXCLUDED as MIRROR_EXCLUDED,
    FINISHES,
    FLAKE_PAINTS,
    INCLUDED,
    LIBRARY_VARIABLES,
    MAX_ASPECULAR_RANGE_DEG,
    OUTSIDE,
    QUANTILE,
    SIGNATURE,
    THROUGH_COAT,
    Array,
    Floats,
    Problem,
    Problems,
    Progress,
    Quality,
    SchemaError,
    documented,
    flag_names,
    flags_set_from,
    flake_exponents,
    mirror_reflection,
    numbers_of,
    one_of,
    part_of,
    quality_attrs,
    shows_flakes,
    takes_quantities,
    warn_if,
    warn_user,
)
from hyperpaint.geometry.georeference.viewing import mean_view
from hyperpaint.io.library.spectra_files import warn_of_scale
from hyperpaint.light.clear_sky import radiance_towards_sun, sunward_gain
from hyperpaint.light.coat_transmission import COAT_INDEX, interface_reflectance
from hyperpaint.light.diffuse_record import SKY_STATES, sky_state_attrs
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.uncertainty import (
    NONE_KNOWN,
    UNCERTAINTIES,
    MeanErrors,
    RegionSums,
    error_variables,
)
from hyperpaint.regions import Regions, pixels_of, regions_from
from hyperpaint.regions.proposals import (
    GAPS,
    JUDGING,
    LEANS,
    LEVELS as ROOF_LEVELS,
    change_with_lean,
    fitted_surface,
)
from hyperpaint.surroundings.corrections import (
    LEVELS,
    NORMAL_REFLECTANCE,
    WIDTHS,
    correct_coat,
    remove_mirrored_sky,
)

from .line_sources import (
    RegionPixels,
    Smoothing,
    Source,
    distinct_pixels,
    lines_of,
    relative_azimuth,
    source_of,
)
from .pixel_statistics import (
    CENTRES,
    QUANTILES,
    chosen_members,
    effective_pixels,
    excluded_of,
    gather,
    summarise,
    words_of,
)

# --- correction of the clear coat for regions of paint -----------------------------------------------------

#: Values of a region's ``kind`` or ``material`` for surfaces without a clear coat.
_NO_PAINT = frozenset(
    {
        "asphalt",
        "concrete",
        "glass",
        "grass",
        "ground",
        "leaf",
        "line",
        "soil",
        "target",
        "tyre",
        "vegetation",
        "wall",
        "white panel",
        "window",
    }
)


def without_coat(
    library: xr.Dataset,
    regions: Regions,
    index: float,
    sun_zenith: float | None,
) -> xr.Dataset:
    # Return a library corrected for a coat of the given index; see `correct_coat`.
    #
    # Regions of other surfaces than paint, and metallic and matt paint, stay unchanged.
    has_coat = np.array([not words_of(region) & (_NO_PAINT | FLAKE_PAINTS | {"matt"}) for region in regions])
    if not has_coat.any():
        return library
    corrected = correct_coat(library, index=index, sun_zenith=sun_zenith)
    if has_coat.all():
        return corrected
    is_corrected = xr.DataArray(has_coat, dims=SIGNATURE)
    # reflectance of the other regions stays unchanged, their transmission is certainly 1
    uncorrected: dict[str, Any] = {
        "reflectance_u_coat": 0.0,
        **{name: library[name] for name in (*LEVELS, *WIDTHS) if name in library},
        "coat_transmission": 1.0,
        "coat_transmission_u": 0.0,
    }
    return corrected.assign(
        {
            name: corrected[name].where(is_corrected, values).transpose(*corrected[name].dims)
            for name, values in uncorrected.items()
        }
    )


# --- angle between view and mirrored sun on a body part, and change of reflectance over that angle ---------
# A metallic paint has no single reflectance: flakes lie nearly level, and reflect most around the direction
# in which the body part mirrors the sun. Its signature holds for this angle only.

FLAKES = SimpleNamespace(
    #: Share of a body part's pixels that forms its bright end, and share that forms its dark end [1].
    flop_share=0.2,
    #: Minimum number of pixels for a flop.
    min_flop_members=20,
    #: Minimum share of a body part's pixels with a value in a band, for this band to be used [1].
    min_band_share=0.9,
    #: Maximum relative difference from the centre of nine tenths of the values of members of a paint with
    #: flakes, after they are brought to the stated angle [1].
    max_flake_misfit=0.1,
)


#: Maximum lean inferred from a change of brightness [degree]; the mirrored sun turns by twice the lean.
MAX_LEAN_DEG = MAX_ASPECULAR_RANGE_DEG / 2.0


def aspecular_angle(
    sun_zenith: npt.ArrayLike, view_zenith: npt.ArrayLike, relative_azimuth: npt.ArrayLike
) -> Floats:
    r"""Return the angle between the view and the mirrored sun of a level body part [degree].

    NaN where one of the angles is NaN.

    Parameters
    ----------
    sun_zenith, view_zenith
        Angles from the vertical [degree].
    relative_azimuth
        Between the azimuths of sun and camera [degree], 0 where the sun is behind the camera.

    Notes
    -----
    .. math:: \cos \alpha = \cos \theta_s \cos \theta_v - \sin \theta_s \sin \theta_v \cos \varphi

    since the mirror direction has the sun's zenith angle and the opposite azimuth. Where the body part leans
    by :math:`\beta`, this direction turns by up to :math:`2 \beta`. ASTM E2194 defines the angles at which
    paint shops measure metallic paints: 15, 45 and 110 degrees.

    Examples
    --------
    >>> aspecular_angle([45.0, 45.0, 45.0], [0.0, 45.0, 45.0], [0.0, 180.0, 0.0]).round(6)
    array([45.,  0., 90.])
    """
    sun, view, turn = (
        np.radians(np.asarray(angle, np.float64)) for angle in (sun_zenith, view_zenith, relative_azimuth)
    )
    cosine = np.cos(sun) * np.cos(view) - np.sin(sun) * np.sin(view) * np.cos(turn)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def flop_of(members: Array, good: Array) -> tuple[Floats, float]:
    r"""Return the change of reflectance from the dark to the bright end of a body part.

    The bright end less the dark end, over their mean (band,), NaN where unknown; and the same for the means
    over all good bands [1].

    Parameters
    ----------
    members : (member, band)
        Reflectance of pixels of the body part [1]; NaN beyond the last.
    good : (band,)
        Bands by which pixels are sorted.

    Notes
    -----
    Pixels are sorted by their mean ratio to the median spectrum. The ends are the means of the first and the
    last fifth, :math:`\rho_1` and :math:`\rho_5`:

    .. math:: \frac{2 (\rho_5 - \rho_1)}{\rho_5 + \rho_1}

    For solid paint this is :math:`f_{dir} \Delta c / c`, the change by lean alone, without features of the
    paint; flakes and pearl add their own spectrum. Sorting by noise would cause a change, too; the mean over
    many bands keeps it small.
    """
    values = members[np.isfinite(members[:, good]).all(axis=1)].astype(np.float64)
    if len(values) < FLAKES.min_flop_members or not good.any():
        return np.full(members.shape[1], np.nan), np.nan
    median = np.median(values[:, good], axis=0)
    order = np.argsort((values[:, good] / np.maximum(median, 1e-6)).mean(axis=1), kind="stable")
    count = max(1, round(FLAKES.flop_share * len(values)))
    dark, bright = values[order[:count]].mean(axis=0), values[order[-count:]].mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        spectrum = np.where(dark + bright > 0.0, 2.0 * (bright - dark) / (bright + dark), np.nan)
    total = bright[good].mean() + dark[good].mean()
    contrast = 2.0 * float(bright[good].mean() - dark[good].mean()) / total if total > 0.0 else np.nan
    return spectrum, contrast


def lean_range(contrast: npt.ArrayLike, sun_zenith: npt.ArrayLike, direct: npt.ArrayLike) -> Floats:
    r"""Return the maximum difference of lean between the two ends of a body part [degree].

    A lean :math:`\Delta \beta` changes the light on solid paint by the contrast :math:`f_{dir} \tan \theta_s
    \, \Delta \beta`; with flakes the same contrast needs a smaller lean. The result is at most
    `MAX_LEAN_DEG`, also where the light does not depend on the lean; NaN for a contrast of NaN.

    Takes ``contrast``: see `flop_of`; ``sun_zenith``: zenith angle of the sun [degree]; ``direct``: direct
    part of the irradiance [1].

    Examples
    --------
    >>> lean_range([0.1, 0.1], [45.0, 0.0], 0.8).round(1)
    array([ 7.1, 15. ])
    """
    slope = np.asarray(direct, np.float64) * np.tan(np.radians(np.asarray(sun_zenith, np.float64)))
    lean = np.degrees(np.arctan(np.abs(np.asarray(contrast, np.float64)) / np.maximum(slope, 1e-9)))
    return np.asarray(np.minimum(lean, MAX_LEAN_DEG))


def with_aspecular_geometry(library: xr.Dataset) -> xr.Dataset:
    # Return a library with the angles between view and mirrored sun of its body parts, and their flop.
    #
    # Members of a paint with flakes are brought to the stated angle: the change over the body part is the
    # flop's, and would be noise in a renderer that draws members at random.
    #
    # Adds ``aspecular_angle`` (signature) of a level body part; ``aspecular_range`` (signature), twice
    # `lean_range`, its possible variation between the ends of the body part [degree]; and ``flop``
    # (signature, band), `flop_of` of the members [1]; NaN where members, sun or view are unknown.
    good = library["good"].values.astype(bool)
    members = library["member_reflectance"].transpose(SIGNATURE, ..., BAND).values.copy()
    # bands that many pixels lack, such as bands without irradiance, are excluded instead of the pixels
    has_value = np.isfinite(members)
    band_is_used = has_value.sum(axis=1) > FLAKES.min_band_share * has_value.any(axis=2).sum(axis=1)[:, None]
    flops, contrast = zip(*map(flop_of, members, good & band_is_used), strict=True)
    # without a split all light is assumed to be direct, which gives the smallest lean
    split = library["diffuse_fraction"].transpose(SIGNATURE, BAND).values[:, good]
    direct = 1.0 - np.array([np.nanmean(row) if np.isfinite(row).any() else 0.0 for row in split])
    sun_zenith, view_zenith, relative_azimuth = (
        library[name].values for name in ("sun_zenith", "view_zenith", "relative_azimuth")
    )
    ranges = 2.0 * lean_range(contrast, sun_zenith, direct)
    variables = {
        "aspecular_angle": (SIGNATURE, aspecular_angle(sun_zenith, view_zenith, relative_azimuth)),
        "aspecular_range": (SIGNATURE, ranges),
        "flop": ((SIGNATURE, BAND), np.array(flops, np.float32)),
    }
    for number in np.flatnonzero(shows_flakes(np.array(flops)[:, good], ranges)):
        centre, used = library["reflectance"].values[number], good & band_is_used[number]
        used &= np.isfinite(centre)
        rows = np.flatnonzero(np.isfinite(members[number][:, used]).all(axis=1))
        level = members[number][np.ix_(rows, used)].mean(axis=1) / centre[used].mean()
        # place of a member between the dark and the bright end, by its level
        place = np.log(np.maximum(level, 1e-3)) / flake_exponents(np.array(contrast[number]))
        turned = members[number, rows] * np.exp(-place[:, None] * flake_exponents(flops[number]))
        # several materials in a region do not become alike
        misfit = np.abs(turned[:, used] / centre[used] - 1.0)
        if misfit.size and float(np.quantile(misfit, 0.9)) <= FLAKES.max_flake_misfit:
            members[number, rows] = turned
    return library.assign(member_reflectance=library["member_reflectance"].copy(data=members)).assign(
        {
            name: xr.DataArray(values, dims=dims, attrs=LIBRARY_VARIABLES[name].attrs)
            for name, (dims, values) in variables.items()
        }
    )


# --- level and quantity of every signature -----------------------------------------------------------------

DRAWN = SimpleNamespace(
    #: Standard deviation of the brightness of the level part of a region, relative to the difference of its
    #: quartiles [1]: it lies anywhere between them.
    crown_share=1.0 / np.sqrt(12.0),
    #: Standard deviation of the level part of a drawn roof from its middle [half widths].
    middle_sd_half_widths=0.15,
    min_aspect=1.2,  # minimum length of a drawn roof over its width for its axis to be known
    #: Uncertainty of the level where a cloud may have covered the sun, relative [1].
    covered_sun_u=0.5,
    #: Maximum standard uncertainty of the diffuse fraction under broken clouds with free sun [1].
    free_sun_u=0.12,
)


def change_over_crown(paint: xr.Dataset, good: npt.NDArray[np.bool_]) -> tuple[float, float] | None:
    # Return the relative uncertainty of a roof's mean as its level, and its change with lean [1/rad].
    #
    # The lean grows with the distance from the level part, which is near the middle of a roof: a surface of
    # second order through the logarithms of the members' brightness gives the difference of mean and middle,
    # and the slope in the middle over the known curvature of roofs. None with too few members, or where
    # length and width of the roof are too alike to be told apart.
    # bands that many members lack are left out
    spectra = paint["member_reflectance"].values[:, good]
    has_value = np.isfinite(spectra)
    has_band = has_value.sum(axis=0) > FLAKES.min_band_share * has_value.any(axis=1).sum()
    members = spectra[:, has_band].sum(axis=1) / max(int(has_band.sum()), 1)
    is_used = members > 0.0  # not NaN, and at least one band
    if is_used.sum() < ROOF_LEVELS.min_fitted_px:
        return None
    places = np.stack([paint[f"member_{dim}"].values[is_used] for dim in (ALONG_TRACK, CROSS_TRACK)], axis=1)
    variances, axes = np.linalg.eigh(np.cov(places.T))
    # half extents of a uniform distribution, across the roof first
    half = np.sqrt(3.0 * np.maximum(variances, 1.0))
    if half[1] < DRAWN.min_aspect * half[0]:
        return None
    v, u = ((places - places.mean(axis=0)) @ axes / half[0]).T
    design = np.stack([np.ones(u.size), u, v, u * u, u * v, v * v], axis=1)
    terms, _, sd = fitted_surface(design, np.log(members[is_used]).astype(np.float64))
    # over the leans half a width from the middle, along and across [rad]
    lean_along = min(2.0 * ROOF_LEVELS.drop * half[0] / half[1], np.radians(ROOF_LEVELS.max_crown_deg))
    change = np.hypot(terms[1] / lean_along, terms[2] / np.radians(ROOF_LEVELS.crown_deg))
    return float(
        np.hypot.reduce(
            [(design @ terms).mean() - terms[0], DRAWN.middle_sd_half_widths * np.hypot(*terms[1:3]), sd]
        )
    ), float(change)


def with_levels(library: xr.Dataset, regions: Regions) -> xr.Dataset:
    # Return a library with ``level_uncertainty``, ``level_terms`` and ``quantity`` (signature).
    #
    # Proposed regions have their own uncertainty of the level. That of others combines noise and dust, the
    # lean, the change over the region, the light of neighbours, and broken clouds; the mirrored sky is in
    # ``reflectance_u_coat``. A mean over the crown of a roof is not its level part: flakes and low suns make
    # the difference large, which the members of a roof show; of other parts their quartiles bound it.
    good = library["good"].values.astype(bool)
    levels, terms, quantities, clouded = [], [], [], []
    quantity = library["reflectance"].attrs["quantity"]
    transmission = library.get("coat_transmission", xr.ones_like(library["reflectance"]))
    for number, region in enumerate(regions):
        paint, words = library.isel({SIGNATURE: number}), words_of(region)
        is_divided = bool((transmission.isel({SIGNATURE: number}).values[good] < 1.0).any())
        at_geometry = f"{AT_GEOMETRY}, over coat_transmission" if is_divided else AT_GEOMETRY
        quantities.append(quantity if quantity == OUTSIDE or "solid" in words else at_geometry)
        values = paint["reflectance"].values[good]
        level = float(np.nanmean(values)) if np.isfinite(values).any() else 0.0
        if "level_uncertainty" in region.properties or words & _NO_PAINT or not level > 0.0:
            levels.append(float(region.properties.get("level_uncertainty", np.nan)))
            terms.append(region.properties.get("level_terms", {}))
            continue
        split, split_u = (
            float(np.nan_to_num(paint[name].values[good], nan=0.0).mean())
            for name in ("diffuse_fraction", "diffuse_fraction_u")
        )
        # windows and edges in a region lie outside of its quartiles
        quartiles = paint["reflectance_quantiles"].sel({QUANTILE: [0.25, 0.75]}).transpose(QUANTILE, BAND)
        spread = float(np.nanmean(np.diff(quartiles.values[:, good], axis=0))) / level
        zenith, lean = float(paint["sun_zenith"]), float(paint["lean"])
        change = change_with_lean(45.0 if np.isnan(zenith) else zenith)
        # the width of a part of a roof is not known
        crown = change_over_crown(paint, good) if "roof" in words and "part" not in words else None
        if crown is None and "solid" not in words:  # flakes change by more
            change = max(change, JUDGING.unseen_change)
        change = max((1.0 - split) * change, 0.0 if crown is None else crown[1])
        parts = {
            "noise and dust": JUDGING.least_sd,
            f"an unknown lean of {lean:.1f} degrees": np.radians(lean) * change,
            "its change over the region, such as over a crown": DRAWN.crown_share * spread
            if crown is None
            else crown[0],
            "the light of neighbours": JUDGING.mirror_sd / level,
        }
        if int(paint["sky_state"]) == SKY_STATES.index("broken"):
            parts["broken clouds"] = GAPS.sd if split_u < DRAWN.free_sun_u else DRAWN.covered_sun_u
            clouded.append(region.name)
        levels.append(float(np.hypot.reduce(list(parts.values()))))
        terms.append({cause: round(float(part), 5) for cause, part in parts.items()})
    warn_if(
        clouded,
        f"clouds were broken over {', '.join(clouded[:5])}: a cloud may have covered the sun there and "
        "not at the receiver, or the reverse; their level may be wrong by a factor (level_uncertainty); "
        "take a line flown between clouds, or a region that propose_regions accepts",
        "clouds-broken",
    )
    columns = {
        "level_uncertainty": levels,
        "level_terms": [json.dumps(parts, ensure_ascii=False) if parts else "" for parts in terms],
        "quantity": quantities,
    }
    return library.assign_coords(
        {
            name: (SIGNATURE, np.array(column, np.float64 if name == "level_uncertainty" else object),
                   LIBRARY_VARIABLES[name].attrs)
            for name, column in columns.items()
        }
    )  # fmt: skip


# --- sky mirrored by a coat relative to its Fresnel reflectance, from the variation of pixels --------------


#: Conditions under which the strength of a coat can be measured.
STRENGTH = SimpleNamespace(
    # Minimum number of member pixels: fewer have no reliable principal component.
    min_members=40,
    # Minimum and maximum zenith angle of the sun [degree]: under a high sun leans change the light little,
    # under a low sun terms of higher order matter.
    sun_zenith_deg=(25.0, 70.0),
    # Minimum share of the pixels' variance in the first component [1]: below, it is noise.
    min_share=0.5,
    # Maximum part of the component that the fit of its two terms does not explain [1].
    max_misfit=0.05,
    # Maximum standard uncertainty of a reported strength [1].
    max_u=0.3,
    # Zenith angle of the two directions between which the slope of sky radiance is taken [degree]: twice a
    # usual lean, since a part mirrors the sky at twice its lean.
    slope_deg=4.0,
    # Relative uncertainty of the strength from terms of higher order [1]: from simulated mirroring body parts
    # with leans of 2.5 degrees (tests).
    first_order=0.1,
)


def strength_of(
    members: Floats, wavelength: Floats, diffuse: Floats, sun_zenith: float, removed: float = 0.0
) -> tuple[float, float, str]:
    r"""Return a coat's strength [1], its standard uncertainty, and the reason where it cannot be measured.

    Takes ``members`` (member, band): reflectance of single pixels; ``wavelength``, ``diffuse`` (band,): bands
    [nm], and the diffuse fraction of a clear sky there [1]; ``sun_zenith`` [degree]; ``removed``: reflectance
    of the coat of a mirrored sky that was subtracted from the members [1].

    Notes
    -----
    A pixel of a body part that leans towards the sun by :math:`\beta` gets more direct light, and mirrors the
    sky :math:`2 \beta` nearer to the sun. To first order its spectrum changes by

    .. math:: \beta \left[ \tan\theta_s (f_{dir} + g f_{dif}) (\bar\rho - k F_0 f_{dif} L_z)
              + 2 k F_0 f_{dif} L' \right]

    with the zenith radiance :math:`L_z` over the mean of the sky, the slope of radiance towards the sun
    :math:`L'`, the gain of diffuse light g, and the coat's strength k: 1 where it mirrors as its index
    predicts. The first principal component of a region's pixels is proportional to this change. Amounts of
    its two terms are fitted to the component; their quotient is k. Only on a dark body is the mirrored part
    large enough to be measured.
    """
    unknown = (np.nan, np.nan)
    if len(members) < STRENGTH.min_members:
        return *unknown, f"{len(members)} pixels, expected {STRENGTH.min_members}"
    low, high = STRENGTH.sun_zenith_deg
    if not low <= sun_zenith <= high:
        return *unknown, f"the sun at {sun_zenith:.0f} degrees, expected {low:g} to {high:g}"
    # zenith radiance over the mean of the sky, its slope towards the sun, and the gain of diffuse light
    turn = STRENGTH.slope_deg
    towards, away, above = (
        radiance_towards_sun(wavelength, sun_zenith, angle) for angle in (turn, -turn, 0.0)
    )
    sky_slope = (towards - away) / (2.0 * np.radians(turn))
    gain = sunward_gain(wavelength, sun_zenith)
    members = members + removed * diffuse * above
    mean = members.mean(axis=0)
    scores, sizes, directions = np.linalg.svd(members - mean, full_matrices=False)
    share = float(sizes[0] ** 2 / max((sizes**2).sum(), 1e-30))  # of equal pixels 0
    if not share >= STRENGTH.min_share:
        return *unknown, (
            f"the first principal component has {share:.0%} of the pixels' variance, expected "
            f"{STRENGTH.min_share:.0%}"
        )
    # noise of the component: residuals without it
    residuals = members - mean - np.outer(scores[:, 0] * sizes[0], directions[0])
    noise = np.sqrt((residuals**2).sum(axis=0) / max(len(members) - 2, 1)) / sizes[0]
    noise = np.maximum(noise, 0.2 * np.median(noise) + 1e-9)
    mirror = NORMAL_REFLECTANCE * diffuse
    lit = np.tan(np.radians(sun_zenith)) * (1.0 - diffuse + gain * diffuse)
    terms = np.stack([lit * mean, 2.0 * mirror * sky_slope - lit * mirror * above], axis=1)
    scaled_terms, target = terms / noise[:, None], directions[0] / noise
    covariance = np.linalg.inv(scaled_terms.T @ scaled_terms)
    amounts = covariance @ scaled_terms.T @ target
    misfit = directions[0] - terms @ amounts
    unexplained = float((misfit**2).sum())
    if unexplained > STRENGTH.max_misfit:
        return *unknown, f"{unexplained:.0%} of the differences are neither lean nor mirrored sky"
    strength = float(amounts[1] / amounts[0])
    # misfits are smooth over the bands: some ten values of a spectrum are independent
    excess = max(1.0, float(np.mean((misfit / noise) ** 2))) * max(1.0, target.size / 10.0)
    gradient = np.array([-strength, 1.0]) / amounts[0]
    u = float(np.hypot(np.sqrt(gradient @ covariance @ gradient * excess), STRENGTH.first_order * strength))
    return (
        (*unknown, f"the body is too bright: the strength would be uncertain by {u:.1f}")
        if not u <= STRENGTH.max_u
        else (strength, u, "")
    )


def with_coat_strength(library: xr.Dataset, sun_zenith: float | None = None) -> xr.Dataset:
    # Return a library with ``coat_strength``, ``coat_strength_u`` and ``coat_strength_reason`` (signature).
    #
    # The library holds ``diffuse_fraction``, ``sky_state`` and ``sun_zenith`` of every paint, without a
    # correction of the coat; a subtracted mirrored sky is added again. After a correction of the light the
    # strength cannot be measured.
    attrs = library["reflectance"].attrs
    removed = NORMAL_REFLECTANCE if mirror_reflection(library) == MIRROR_EXCLUDED else 0.0
    columns: list[tuple[float, float, str]] = []
    good = library["good"].values.astype(bool)
    nm = library["wavelength"].values
    clear = {SKY_STATES.index("clear"), SKY_STATES.index("hazy")}
    for number in range(library.sizes[SIGNATURE]):
        paint = library.isel({SIGNATURE: number})
        members = paint["member_reflectance"].values.astype(np.float64)
        members = members[np.isfinite(members).any(axis=1)]
        # bands at the ends of the spectrum may have no values
        bands = good & (np.isfinite(members).sum(axis=0) > 0.9 * len(members))
        members = members[:, bands][np.isfinite(members[:, bands]).all(axis=1)]
        diffuse, sun = paint["diffuse_fraction"].values[bands].astype(np.float64), float(paint["sun_zenith"])
        sun = sun if sun_zenith is None else sun_zenith  # the argument takes precedence over the clock
        if changed := [name for name in ("light_corrected", "tilt", "coat_corrected") if name in attrs]:
            columns.append((np.nan, np.nan, f"the light was corrected before ({changed[0]})"))
        elif not (np.isfinite(diffuse).all() and np.isfinite(sun)):
            columns.append((np.nan, np.nan, "the diffuse fraction or the position of the sun is unknown"))
        elif int(paint["sky_state"]) not in clear:
            columns.append((np.nan, np.nan, f"the sky is {SKY_STATES[int(paint['sky_state'])]}, not clear"))
        else:
            columns.append(strength_of(members, nm[bands], diffuse, min(sun, 89.0), removed))
    names = ("coat_strength", "coat_strength_u", "coat_strength_reason")
    variables: dict[str, Any] = {
        name: (SIGNATURE, np.array(column, dtype), LIBRARY_VARIABLES[name].attrs)
        for name, column, dtype in zip(
            names, zip(*columns, strict=True), (np.float64, np.float64, object), strict=True
        )
    }
    return library.assign(variables).set_coords("coat_strength_reason")


#: Flags of pixels whose reflectance differs from that of the surface.
EXCLUDED = (
    Quality.SATURATED
    | Quality.IRRADIANCE_GAP
    | Quality.NO_DATA
    | Quality.GLINT
    | Quality.SHADOW
    | Quality.ADJACENCY
    | Quality.MIXED_EDGE
)

#: Flags of lines whose light may differ from the record: excluded where a region has other pixels.
UNSTEADY = Quality.ILLUMINATION_UNSTABLE | Quality.TIMING_SENSITIVE

#: Maximum size of samples in memory [byte]; a larger region is processed in several rounds of bands.
MAX_GATHERED_BYTES = 64 * 2**20
#: Maximum size of a region for which all bands must be in memory together [byte].
MAX_COMPLETE_BYTES = 256 * 2**20


@takes_quantities(sun_zenith="degree")
@documented()
def extract_signatures(
    line: xr.Dataset | xr.DataTree | Mapping[str, xr.Dataset],
    regions: Any,
    *,
    exclude: Quality | int | None = None,
    members: int = 256,
    centre: str = "trimmed_mean",
    smooth: Smoothing = None,
    specular_sky: bool = False,
    sun_zenith: float | None = None,
    diffuse: Any = None,
    coat: bool | None = None,
    coat_index: float = COAT_INDEX,
    min_pixels: int = 5,
    drop_small: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""Return a paint library: one signature a region, with spread, uncertainty and provenance.

    Eager. Only blocks of lines with pixels of regions are read. Samples take at most 64 MiB of memory; a
    larger region is read several times, some bands at a time. The geometric median needs all bands of a
    region, at most 256 MiB.

    Parameters
    ----------
    line
        A flight line with ``reflectance``, or with the inputs of `hyperpaint.reflectance`; or a map of one
        from `hyperpaint.geometry.orthorectify`; several by name, or a DataTree of them.
    regions
        `Regions`, the path of a GeoJSON file or its content, see `hyperpaint.regions.regions_from`. Regions
        in map coordinates may have another reference system than the line; a line with poses but without
        ground coordinates is located first, with its declared height of the ground.
    exclude
        Flags of excluded pixels; 0 excludes none. By default the flags in the property ``excluded_flags`` of
        a region, which `propose_regions` sets, else the flags of pixels whose reflectance differs from that
        of the surface: saturated, irradiance_gap, no_data, shadow and, except for regions whose ``finish`` or
        ``kind`` is metallic or pearl, as flakes shine like them, glint, adjacency and mixed_edge. By default
        pixels of lines with unsteady light are excluded, too (illumination_unstable and
        timing_sensitive), unless a region then has too few pixels: it keeps them, with a warning.
    members
        Maximum number of single pixels stored with a signature.
    centre
        "trimmed_mean": mean of a band without values farther than three standard deviations from it, see
        Notes of `hyperpaint.paints.signatures.pixel_statistics.summarise`; "geometric_median" of spectra; or
        "median" of a band.
    smooth
        Method of `hyperpaint.radiometry.smooth`, or its arguments by name; applied to the spectrum of every
        pixel.
    specular_sky
        Subtract the sky that a clear coat mirrors, see `hyperpaint.surroundings.remove_mirrored_sky`.
    sun_zenith
    diffuse
        Diffuse part of the light for these corrections, see `hyperpaint.surroundings.survey`; by default
        from the declaration of every line.
    coat
        Divide by the transmission of the clear coat relative to its transmission near the normal, see
        `hyperpaint.surroundings.correct_coat`; needs reflectance without the mirrored sky. By default with
        ``specular_sky``. Regions whose property ``kind`` or ``material`` names another surface than paint,
        such as "asphalt", stay unchanged.
    coat_index
        Refractive index of the coat [1].
    min_pixels
        Minimum number of usable pixels of a region.
    drop_small
        Omit regions with fewer usable pixels, and list them in the attribute ``left_out``, instead of raising
        an error. If all regions are too small, the error is raised.
    seed
        Seed of the choice of members.
    progress

    Returns
    -------
    Dataset
        ``reflectance``, ``reflectance_sd``, ``reflectance_u_random``, ``reflectance_u_systematic``
        (signature, band), ``reflectance_quantiles`` (signature, quantile, band), ``member_reflectance``
        (signature, member, band), for paints with flakes at the stated ``aspecular_angle``, all float32 [1],
        NaN where unknown; ``n``, ``n_eff`` and ``n_excluded``
        (signature) pixels; ``quality`` (signature), the flags of the pixels that were used; ``quality_share``
        (signature, flag), the share of all pixels with each flag [1]; ``sun_zenith``, ``sun_azimuth``,
        ``view_zenith``, ``view_azimuth``, ``relative_azimuth`` [degree] and ``irradiance_age`` [s]
        (signature); ``diffuse_fraction``, ``diffuse_fraction_u`` (signature, band) [1], NaN where
        undeclared, and ``sky_state`` (signature); ``coat_transmission``, ``coat_transmission_u`` and
        ``reflectance_u_coat`` (signature, band) [1] where the coat was corrected. ``coat_strength`` and
        ``coat_strength_u`` (signature) [1], the mirrored sky over the prediction from the coat's index, where
        dark curved body parts show it; else NaN, and ``coat_strength_reason``. ``aspecular_angle``, between
        the view and the direction in which a level body part mirrors the sun, and ``aspecular_range``, its
        possible variation over the body part (signature) [degree]; ``flop`` (signature, band), the relative
        change of reflectance from the dark to the bright end of the body part [1]. Coordinates:
        ``quantity``: of solid paint the attribute of reflectance, of flakes and of unknown finishes the
        reflectance factor at this geometry; ``lean`` [degree] and ``level_uncertainty`` [1], of proposed
        regions their own, of others as in Notes, with ``level_terms``; ``signature``, ``wavelength``,
        ``fwhm``, ``good``, ``time``, ``flightline``, ``region`` (as GeoJSON), and every property of the
        regions. Attributes hold the settings; attributes of reflectance define it: ``quantity``, of the body
        under a coat, of the body through the coat, or of its outside; ``mirror_reflection`` and
        ``specular_component``, whether the mirrored sky is "included" or "excluded"; and ``geometry``.

    Raises
    ------
    FormatError
        The regions cannot be read.
    SchemaError, UnitsError
        Options, lines or regions cannot be used: a region has no pixels, too few usable ones (see
        ``drop_small``) or lines that occur twice; flight lines have different bands; the mirrored sky was
        removed before, or the position of the sun is unknown. All faults of a kind are listed.

    Warns
    -----
    PaintWarning
        All pixels of a region are of lines with unsteady light; clouds were broken over a region that was not
        proposed; no surface has such reflectance, as with a wrong scale; or flags of the scene are excluded,
        but a line was not searched for them (`hyperpaint.surroundings.flag`): the attribute ``exclude``
        lists only flags that were searched in all lines.

    Notes
    -----
    A region that was not proposed has the ``level_uncertainty`` of noise and dust, of a lean (0.9 degrees
    where its ``kind`` is "roof", else 7), of the change over the region, whose mean is not its level part,
    and of the light of neighbours; the mirrored sky is in ``reflectance_u_coat``. Over the crown of a roof
    (not of a "roof part") both changes are measured: a surface of second order through its members gives the
    difference of mean and middle, and its slope there, over the known curvature of roofs, the change with
    lean.

    The signature of a metallic or pearl paint (by ``finish`` or ``kind`` of its region) holds only for its
    ``aspecular_angle`` under its sun and sky; it is not corrected for the coat, and ``flop`` shows the change
    with the angle. Matt paint has no coat that mirrors: it is corrected for none, and keeps the light of the
    sky that its surface scatters.

    In a map with the indices of the pixels that its cells show, every pixel counts once, and members have
    their positions in the flight line; a map of nearest pixels omits some pixels of the flight line.

    Spectra are resampled to the nominal wavelengths first. A sample that is missing in a pixel is missing in
    that band only. The direction of view follows from the line's ``view_zenith`` and ``view_azimuth``, else
    from ``look_across`` or ``look_angle``, ``roll``, ``pitch`` and ``heading`` in the line's declared
    convention, and its ``boresight``; without these it is NaN, and the attribute ``view_geometry`` names the
    missing variables. The standard uncertainties hold for the mean of these pixels. For a flight line with
    its counts and calibration they are propagated source by source, also where the line's reflectance has
    none, see `hyperpaint.radiometry.mean_uncertainty`:
    ``reflectance_u_random`` is the part that bands do not share, ``reflectance_u_systematic`` the part that
    they share, ``reflectance_errors`` (signature, error_source, band) has each source, and
    ``error_correlation`` (signature, lag, band) is the correlation of neighbouring bands, nominal wavelengths
    and smoothing included; see `hyperpaint.paints.covariance`. For a map, and for reflectance that was
    corrected or stored without its calibration,

    .. math:: u_r = \sqrt{\frac{\overline{u_{r,i}^2}}{\max(1, n_{eff} n_b / n)}}, \qquad
              u_s = \overline{u_{s,i}}, \qquad
              n_{eff} = n^2 \Big/ \sum_{ij} \overline{c_{ij}}

    over the :math:`n_b` pixels with a value in a band, NaN without such pixels, with :math:`c_{ij}` the
    autocorrelation of reflectance at the distance of two pixels, averaged over bands; :math:`n_{eff}` is
    at most :math:`n / 1.3`, since the camera moves during the exposure of a line. Smoothing reduces the
    random part below this value. ``reflectance_sd`` and the quantiles show how far other parts of the paint
    may differ. Results have the same bits for any chunking and any order of the regions.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> from hyperpaint.regions import Region, Regions
    >>> line = simulate_line(lines=32, bands=40, columns=24, smile_nm=0.0)
    >>> grass = Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)], properties={"colour": "green"})
    >>> paints = extract_signatures(line, Regions((grass,)))
    >>> paints["signature"].item(), paints["colour"].item(), paints["n"].item()
    ('grass', 'green', 32)
    """
    region_list = regions_from(regions)
    flags = EXCLUDED if exclude is None else exclude
    with Problems("signatures cannot be extracted", SchemaError) as problems:
        problems.add_if(
            not len(region_list),
            "regions= is empty",
            mend="draw regions, or call propose_regions",
            code="empty-input",
        )
        problems.add_if(
            not isinstance(flags, int) or not 0 <= flags < 2 * max(Quality),
            f"exclude={flags!r:.40}",
            expected="flags such as Quality.GLINT | Quality.SHADOW, or 0",
            code="choice-unknown",
        )
        for name, count, minimum in (("members", members, 0), ("min_pixels", min_pixels, 1)):
            problems.add_if(
                count < minimum, f"{name}={count}", expected=f"{minimum} or more", code="value-out-of-range"
            )
        one_of(centre, CENTRES, "centre", problems=problems)
    for option, value in (("sun_zenith", sun_zenith), ("diffuse", diffuse)):
        SchemaError.raise_if(
            value is not None and not (specular_sky or coat),
            f"{option}={value!r:.40} is used for the mirrored sky and the coat only",
            mend="pass specular_sky=True as well",
            option="give --specular-sky as well",
            code="argument-missing",
        )
    lines = lines_of(line, region_list)
    sources = {
        name: source_of(dataset, smooth, specular_sky, sun_zenith, diffuse)
        for name, (dataset, _) in lines.items()
    }
    (first_name, first_source), *further = sources.items()
    with Problems("signatures of these flight lines cannot be in one library", SchemaError) as problems:
        for other_name, other in further:
            nm, first_nm = other.wavelength, first_source.wavelength
            problems.add_if(
                nm.shape != first_nm.shape or not np.allclose(nm, first_nm, rtol=0.0, atol=1e-3),
                f"bands of {other_name!r} differ from those of {first_name!r}",
                mend="extract a library from every line",
                code="bands-differ",
            )
    names = {position: name for name, (_, positions) in lines.items() for position in positions}
    pixels = _pixels_of_regions(region_list, lines, sources)
    rounds = [
        (name, batch, bands)
        for name, (_, positions) in lines.items()
        for batch, bands in _rounds(sources[name], positions, pixels, all_bands=centre == "geometric_median")
    ]
    with Problems("the geometric median needs all bands of a region in memory", SchemaError) as problems:
        for name, (number, *_), bands in rounds if centre == "geometric_median" else ():
            problems.add_if(
                bands.start == 0 and bands.stop < sources[name].wavelength.size,
                f"region {region_list[number].name!r} has {pixels[number].size} pixels: more than "
                f"{MAX_COMPLETE_BYTES >> 20} MiB",
                mend='draw a smaller region, or pass centre="trimmed_mean"',
                code="region-too-large",
            )
    drafts = [Draft(sources[names[position]], region_pixels) for position, region_pixels in enumerate(pixels)]
    unknown = [
        f"{region.name!r} ({finish!s:.40})"
        for region in region_list
        if (finish := region.properties.get("finish") or "") and not words_of(region) & {*FINISHES}
    ]
    warn_if(
        unknown,
        f"the finish of {', '.join(unknown[:5])} is none of {', '.join(FINISHES)}: taken for paint "
        "with a clear coat and without flakes",
        "finish-unknown",
    )
    excluded = [excluded_of(region, flags) if exclude is None else exclude for region in region_list]
    for number, (name, batch, bands) in enumerate(rounds):
        # gather and reduce the pixels of a round; reading is the first half of the work, reducing the second
        report, source = part_of(progress, number, len(rounds)), sources[name]
        along, across = (np.concatenate([drafts[k].cells[axis] for k in batch]) for axis in (0, 1))
        gathering = None if report is None else lambda count, blocks, report=report: report(count, 2 * blocks)
        spectra, values = gather(source.cubes, source.planes, along, across, bands, source.small, gathering)
        line_values = {key: values[key] for key in source.small}
        start = 0
        for position in batch:
            draft = drafts[position]
            rows = slice(start, start + draft.along.size)
            start = rows.stop
            if bands.start == 0:
                planes = {key: values[key][rows] for key in source.planes}
                exclusions = [excluded[position]]
                if exclude is None:  # lines of unsteady light stay where too few pixels have steady light
                    exclusions.insert(0, exclusions[0] | UNSTEADY)
                for exclusion in exclusions:
                    draft.choose(values["present"][rows], planes, line_values, exclusion, members, seed)
                    if draft.n >= min_pixels:
                        break
            if draft.n >= min_pixels:
                draft.take_bands({key: cube[rows] for key, cube in spectra.items()}, bands, centre)
            if report is not None:
                report(along.size + start, 2 * along.size)
    small = _small(region_list, drafts, min_pixels)
    large_enough = [number for number in range(len(region_list)) if number not in small]
    if small and not (drop_small and large_enough):
        mend = "draw another region, exclude fewer flags, lower min_pixels, or pass drop_small=True"
        raise SchemaError(
            "regions have too few usable pixels",
            problems=[Problem(text, mend=mend, code="region-too-small") for text in small.values()],
        )
    searched = _searched_flags(sources, drafts, names, flags | UNSTEADY if exclude is None else flags)
    if exclude is None and (unsteady := [k for k in large_enough if drafts[k].values["quality"] & UNSTEADY]):
        warn_user(
            "all pixels are of lines with unsteady light (illumination_unstable, timing_sensitive), and are "
            f"used: {', '.join(region_list[k].name for k in unsteady[:5])}; their level may be wrong by the "
            "change of the light; state clock_uncertainty_s of the record, or measure under a steady sky",
            "light-unsteady",
        )
    remaining = Regions(tuple(region_list[k] for k in large_enough), region_list.coordinates, region_list.crs)
    notes = {
        "exclude": " ".join(flag_names(searched)) or "none",
        "members": members,
        "centre": centre,
        "min_pixels": min_pixels,
        "seed": seed,
    }
    library = paint_library(
        remaining, [drafts[k] for k in large_enough], [names[k] for k in large_enough], sources, notes
    )
    warn_of_scale(
        library["reflectance"].values[:, library["good"].values.astype(bool)],
        "the reflectance of the signatures",
        "check the scale of the line, such as 'reflectance scale factor' of an ENVI header",
    )
    if sun_zenith is not None:  # takes precedence over the clock
        library = library.assign(
            sun_zenith=library["sun_zenith"].copy(data=np.full(library.sizes[SIGNATURE], float(sun_zenith)))
        )
    # lean of proposed regions their own, of others the prior lean of a roof, or of a body part that nothing
    # shows to be a roof; NaN of other surfaces than paint
    roof_lean = float(np.hypot(LEANS.roll_deg, LEANS.rake_deg))
    leans = [
        np.nan
        if words_of(region) & _NO_PAINT
        else region.properties.get("lean", roof_lean if "roof" in words_of(region) else JUDGING.panel_deg)
        for region in remaining
    ]
    lean = xr.DataArray(np.array(leans, np.float64), dims=SIGNATURE, attrs=LIBRARY_VARIABLES["lean"].attrs)
    library = with_coat_strength(library.assign_coords(lean=lean), sun_zenith)
    if specular_sky:
        strength = float(interface_reflectance(0.0, coat_index))
        measured = library
        library = remove_mirrored_sky(library, strength=strength, diffuse=diffuse, sun_zenith=sun_zenith)
        is_matt = xr.DataArray(["matt" in words_of(region) for region in remaining], dims=SIGNATURE)
        if is_matt.any():  # its surface scatters the sky, and mirrors none of it
            levels = {name: library[name] for name in LEVELS if name in library}
            library = library.assign(
                {
                    name: level.where(~is_matt, measured[name]).transpose(*level.dims)
                    for name, level in levels.items()
                }
            )
    if specular_sky if coat is None else coat:
        library = without_coat(library, remaining, coat_index, sun_zenith)
    library = with_aspecular_geometry(with_levels(library, remaining))
    return library.assign_attrs(left_out=list(small.values())) if small else library


def _searched_flags(
    sources: Mapping[str, Source], drafts: "Sequence[Draft]", names: Mapping[int, str], flags: int
) -> int:
    # Flags among ``flags`` for which all lines were searched; warns of lines without flags of the scene.
    scene = flags_set_from("scene")
    shares = {name: np.zeros(len(Quality)) for name in sources}
    for position, draft in enumerate(drafts):
        shares[names[position]] += draft.values["quality_share"]
    searched, without = flags, []
    for name, source in sources.items():
        quality = source.planes.get("quality")
        # lines of other programs have bits without a record of the search
        has_bits = any(share and flag & scene for flag, share in zip(Quality, shares[name], strict=True))
        if quality is None or not ("flags_from" in quality.attrs or has_bits):
            without.append(name or "the line")
            searched &= 0 if quality is None else ~scene
    warn_if(
        without and flags & scene,
        f"{', '.join(without)} was not searched for {', '.join(flag_names(flags & scene))}: such pixels "
        "are in the signatures; flag the line first with line.paint.flag()",
        "flags-not-searched",
    )
    return searched


_DEGREES_WITHOUT_CRS = (
    "without a crs the coordinates are columns and lines: if they are longitude and latitude, pass "
    'Regions(..., coordinates="map", crs="OGC:CRS84"), or write "crs": "OGC:CRS84" beside "features" in '
    "the file"
)
_NEGATIVE_LINES = (
    "all y are negative, as of a picture without a map in QGIS: change the sign of y, and subtract 0.5 from "
    "x and y, since whole numbers are centres of pixels; longitude and latitude need a crs"
)
_METRES_WITHOUT_CRS = (
    "without a crs the coordinates are columns and lines; these look like metres of a map: pass "
    'Regions(..., coordinates="map", crs=...) with the crs of the map, such as "EPSG:32633"'
)


# --- pixels and rounds, with checks before values are read -------------------------------------------------


def _pixels_of_regions(
    regions: Regions, lines: Mapping[str, Any], sources: Mapping[str, Source]
) -> list[RegionPixels]:
    problems = Problems("regions contain no pixels", SchemaError)
    pixels: list[Any] = [None] * len(regions)
    for name, (_, positions) in lines.items():
        line_regions = Regions(tuple(regions[k] for k in positions), regions.coordinates, regions.crs)
        line = sources[name].line
        # sensor coordinates that are all valid longitudes and latitudes, as in RFC 7946
        corners = np.abs(np.concatenate([region.polygon for region in line_regions]))
        is_sensor = line_regions.coordinates == "sensor"
        could_be_degrees = is_sensor and bool((corners <= [180.0, 90.0]).all())
        # no camera has so many columns
        could_be_metres = is_sensor and bool((corners > 10_000.0).all())
        metres_mend = _METRES_WITHOUT_CRS if could_be_metres else ""
        lowest = max(region.polygon[:, 1].max() for region in line_regions)
        if is_sensor and lowest <= 0.0:
            metres_mend, could_be_degrees = _NEGATIVE_LINES, False
        for position, region_pixels in zip(
            positions, distinct_pixels(line, pixels_of(line_regions, line)), strict=True
        ):
            pixels[position] = region_pixels
            if not region_pixels.size:
                size = f"{line.sizes['along_track']} lines of {line.sizes['cross_track']} columns"
                problems.add(
                    f"region {regions[position].name!r} contains no pixel of the line ({size})",
                    mend=_DEGREES_WITHOUT_CRS if could_be_degrees else metres_mend,
                    code="region-empty",
                )
    problems.raise_if_any()
    return pixels


def _rounds(
    source: Source, positions: Sequence[int], pixels: Sequence[RegionPixels], *, all_bands: bool
) -> Iterator[tuple[list[int], slice]]:
    # Yield regions that are gathered together, and their bands; `all_bands`: in one round where possible
    bands = source.wavelength.size
    pixel_bytes = 4 * len(source.cubes) * bands
    batch: list[int] = []
    batch_bytes = 0
    for position in positions:
        region_bytes = pixels[position].size * pixel_bytes
        if batch and batch_bytes + region_bytes > MAX_GATHERED_BYTES:
            yield batch, slice(0, bands)
            batch, batch_bytes = [], 0
        if region_bytes > (MAX_COMPLETE_BYTES if all_bands else MAX_GATHERED_BYTES):
            step = max(1, MAX_GATHERED_BYTES // (region_bytes // bands))
            for start in range(0, bands, step):
                yield [position], slice(start, min(start + step, bands))
        else:
            batch.append(position)
            batch_bytes += region_bytes
    if batch:
        yield batch, slice(0, bands)


def _small(regions: Regions, drafts: "Sequence[Draft]", min_pixels: int) -> dict[int, str]:
    # Text about every region with too few usable pixels, by its number
    texts = {}
    for number, (region, draft) in enumerate(zip(regions, drafts, strict=True)):
        if draft.n < min_pixels:
            shares = zip(flag_names(), draft.values["quality_share"], strict=True)
            flags = ", ".join(f"{share:.0%} {name}" for name, share in shares if share > 0)
            texts[number] = (
                f"region {region.name!r}: {draft.n} of {draft.along.size} pixels are usable, expected "
                f"{min_pixels} ({flags or 'no flags'})"
            )
    return texts


# --- one signature, band by band, and the dataset of all signatures ----------------------------------------

#: Number of good bands, spread over the spectrum, in which the correlation of pixels is computed.
_CORRELATED_BANDS = 8

_NAT = np.datetime64("NaT", "ns")

UNKNOWN_SKY = -1  #: Number of an unknown state of the sky; see `SKY_STATES`.


class Draft:
    """The signature of one region while it is computed.

    Attributes
    ----------
    cells
        Positions of its pixels in the opened flight line or map.
    along, across : (pixel,)
        Positions of its pixels in the flight line.
    n
        Number of pixels that are used.
    values
        Values by variable of a library: numbers and flags of pixels; mean time, sun, view and light; spectra
        (band,), quantiles (quantile, band) and members (member, band), float64, NaN where unknown; and
        positions of the members, in a flight line by its index coordinates.
    errors
        Sources of error of the mean, after its last band.
    """

    def __init__(self, source: Source, pixels: RegionPixels) -> None:
        bands = source.cubes["reflectance"].sizes[BAND]
        self.cells, (self.along, self.across) = pixels.cells, pixels.pixels
        self._source, self._pixels = source, pixels
        self.n = 0
        self.values: dict[str, Any] = {
            name: np.full(bands, np.nan) for name in ("reflectance", "reflectance_sd", *UNCERTAINTIES)
        }
        self.values["reflectance_quantiles"] = np.full((len(QUANTILES), bands), np.nan)
        self._is_used = np.zeros(self.along.size, bool)
        self._value_counts = np.zeros(bands, np.intp)
        self._members = np.zeros(0, np.intp)
        good = np.flatnonzero(source.good)
        positions = np.linspace(0, good.size - 1, min(good.size, _CORRELATED_BANDS)).astype(np.intp)
        self._correlated_bands = good[positions] if good.size else good
        self._correlated_values: list[Array] = []
        self._sums: RegionSums | None = None
        self.errors: MeanErrors | None = None

    def choose(
        self,
        present: Array,
        planes: Mapping[str, Array],
        lines: Mapping[str, Array],
        exclude: int,
        max_members: int,
        seed: int,
    ) -> None:
        # Choose the pixels that are used and the members, and compute their geometry.
        #
        # Takes ``present`` (pixel,): whether a pixel has a value, others are excluded; ``planes``: variables
        # of pixels (pixel,), among them ``quality``, 0 where it is absent; ``lines``: variables of the line
        # (along_track,); ``exclude``: flags of excluded pixels; ``max_members``, ``seed``: see
        # `chosen_members`.
        source = self._source
        quality = planes.get("quality", np.zeros(self.along.size, np.uint16))
        self._is_used = (quality & np.uint16(exclude) == 0) & present
        self.n = int(self._is_used.sum())
        along, across = self.along[self._is_used], self.across[self._is_used]
        if source.errors is not None:
            self._sums = RegionSums(source.errors, along, across)
        self._members = chosen_members(along, across, max_members, seed)
        member_along, member_across = along[self._members], across[self._members]
        if self._pixels.cells is self._pixels.pixels:  # in a flight line, not in a map
            rows, columns = (numbers_of(source.line, dim) for dim in (ALONG_TRACK, CROSS_TRACK))
            # numbers of padded rows are NaN, and have no members
            member_along = rows[member_along].astype(np.int64)
            member_across = columns[member_across].astype(np.int64)
        unknown = np.full(source.cubes["reflectance"].sizes[BAND], np.nan)
        cell_rows = self.cells[0][self._is_used]
        line_values = {name: values[cell_rows] for name, values in lines.items()}
        pixel_values = {name: values[self._is_used] for name, values in planes.items()}
        sun = _sun_geometry({**line_values, **pixel_values})
        zenith, azimuth = mean_view(source.viewing, pixel_values, line_values, across)
        self.values |= {
            "n": self.n,
            "n_excluded": self.along.size - self.n,
            "quality": int(np.bitwise_or.reduce(quality[self._is_used], initial=0)),
            "quality_share": np.array([(quality & np.uint16(flag) != 0).mean() for flag in Quality]),
            "member_along_track": member_along,
            "member_cross_track": member_across,
            "member_reflectance": np.full((self._members.size, unknown.size), np.nan),
            **sun,
            "view_zenith": zenith,
            "view_azimuth": azimuth,
            "relative_azimuth": relative_azimuth(azimuth, sun["sun_azimuth"]),
            "diffuse_fraction": unknown,
            "diffuse_fraction_u": unknown,
            "sky_state": UNKNOWN_SKY,
            **({} if source.light is None else source.light.mean(cell_rows)),
        }

    def take_bands(self, cubes: Mapping[str, Array], bands: slice, centre: str) -> None:
        # Reduce some bands of the region's pixels.
        #
        # Takes ``cubes``: reflectance and its uncertainties (pixel, band), by name; ``bands``: slice of these
        # bands in the spectrum; ``centre``: see `summarise`.
        values = cubes["reflectance"][self._is_used]
        has_value = np.isfinite(values)
        self._value_counts[bands] = has_value.sum(axis=0)
        for name, array in summarise(values, centre).items():
            self.values[name][..., bands] = array
        self.values["member_reflectance"][:, bands] = values[self._members]
        in_bands = (self._correlated_bands >= bands.start) & (self._correlated_bands < bands.stop)
        self._correlated_values.append(values[:, self._correlated_bands[in_bands] - bands.start])
        if self._sums is not None:
            measured = cubes.get("measured", cubes["reflectance"])[self._is_used]
            noise = cubes["reflectance_u_random"][self._is_used]
            for column, band in enumerate(range(*bands.indices(self._value_counts.size))):
                self._sums.add(band, measured[:, column], noise[:, column])
            if bands.stop >= self._value_counts.size:
                self.errors = self._sums.errors(self._source.axis, self._source.filtering)
                self._sums = None  # frees the memory of the sums
            return
        for name in UNCERTAINTIES:
            if name in cubes and self._source.components[name] != NONE_KNOWN:
                # random errors: mean square here, divided in `finish` by the number of independent pixels
                power = 2.0 if name == "reflectance_u_random" else 1.0
                # over the pixels with a reflectance; band by band, so that the order of the sum is that of
                # the pixels for any number of bands
                for band, column in enumerate(cubes[name][self._is_used].T):
                    errors = column[has_value[:, band] & np.isfinite(column)].astype(np.float64)
                    if errors.size:
                        self.values[name][bands.start + band] = (errors**power).mean()

    def finish(self) -> None:
        # Compute the uncertainties of the mean, and the number of independent pixels among those used.
        spectra = np.concatenate([np.zeros((self.n, 0), np.float32), *self._correlated_values], axis=1)
        self._correlated_values = []
        along, lines = self.along[self._is_used], self._pixels.lines
        if lines is not None and along.size:
            # pixels of different flight lines are not neighbours: shift the flight lines far from one another
            flightline = np.unique(lines[self._is_used], return_inverse=True)[1]
            along = along + flightline * (2 * int(np.ptp(along)) + 2)
        self.values["n_eff"] = n_eff = effective_pixels(spectra, along, self.across[self._is_used])
        if self.errors is not None:
            uncertainties = (self.errors.u_random, self.errors.u_systematic)
            for name, values in zip(UNCERTAINTIES, uncertainties, strict=True):
                self.values[name] = np.where(self._value_counts == 0, np.nan, values)
        else:
            # the number of independent pixels in a band is proportional to its number of values
            n_eff_of_band = np.maximum(1.0, n_eff * self._value_counts / max(self.n, 1))
            self.values["reflectance_u_random"] = np.sqrt(self.values["reflectance_u_random"] / n_eff_of_band)


def _sun_geometry(variables: Mapping[str, Array]) -> dict[str, Any]:
    # Mean time, position of the sun and maximum age of the irradiance, from values of pixels (pixel,)
    times = variables.get("time", np.full(0, _NAT)).astype("datetime64[ns]")
    times = times[~np.isnat(times)]
    mean_time = (
        times[0] + np.timedelta64(round(float((times - times[0]).astype(np.int64).mean())), "ns")
        if times.size
        else _NAT
    )
    position = [variables.get(name, np.full(0, np.nan)) for name in ("latitude", "longitude")]
    position = [values[np.isfinite(values)] for values in position]
    zenith = azimuth = np.nan
    if times.size and all(values.size for values in position):
        means = (float(values.mean()) for values in position)
        zenith, azimuth = map(float, solar_position(mean_time, *means))
    age = variables.get("irradiance_age", np.full(0, np.nan))
    age = age[np.isfinite(age)]
    return {
        "time": mean_time,
        "sun_zenith": zenith,
        "sun_azimuth": azimuth,
        "irradiance_age": float(age.max()) if age.size else np.nan,
    }


#: Maximum number of properties that become coordinates; the coordinate ``region`` holds all properties.
MAX_PROPERTIES = 64


def paint_library(
    regions: Regions,
    drafts: Sequence[Draft],
    flightlines: Sequence[str],
    sources: Mapping[str, Source],
    notes: Mapping[str, Any],
) -> xr.Dataset:
    # Return finished signatures as a dataset.
    #
    # Takes ``regions``, ``drafts``, ``flightlines``: regions, their signatures and the names of their flight
    # lines, in the same order; ``sources``: the flight lines, by name, with the same bands; ``notes``:
    # settings of the extraction, stored as attributes.
    first_source = next(iter(sources.values()))
    for draft in drafts:
        draft.finish()
    values: dict[str, Any] = {name: [draft.values[name] for draft in drafts] for name in drafts[0].values}
    max_members = max(map(len, values["member_along_track"]))
    for name, fill in (
        ("member_reflectance", np.nan),
        ("member_along_track", -1),
        ("member_cross_track", -1),
    ):
        # all paints have as many rows as the paint with the most members
        pads = [[(0, max_members - len(array)), *[(0, 0)] * (array.ndim - 1)] for array in values[name]]
        values[name] = [
            np.pad(array, pad, constant_values=fill) for array, pad in zip(values[name], pads, strict=True)
        ]
    values |= {
        "signature": list(regions.names),
        "quantile": list(QUANTILES),
        "flag": flag_names(),
        "flightline": list(flightlines),
        "region": [json.dumps(region.feature(), ensure_ascii=False) for region in regions],
        "wavelength": first_source.wavelength,
        "fwhm": first_source.fwhm,
        "good": np.all([source.good for source in sources.values()], axis=0),
    }
    components = {}
    for k, name in enumerate(UNCERTAINTIES):
        texts = [draft.errors.components[k] for draft in drafts if draft.errors is not None]
        texts += [
            source.components.get(name, NONE_KNOWN) for source in sources.values() if source.errors is None
        ]
        components[name] = {"components": _joined(texts)}
    flags: dict[str, Any] = {"quality": quality_attrs(), "sky_state": sky_state_attrs()}
    variables = {}
    for name, row in LIBRARY_VARIABLES.items():
        if name in values:  # variables of corrections are added later
            # objects are texts of any length
            array = np.array(values[name], object if row.dtype == "str" else row.dtype)
            attrs = {**flags.get(name, {}), **row.attrs, **components.get(name, {})}
            variables[name] = (row.dims, array, attrs)
    library = xr.Dataset(variables | error_variables([draft.errors for draft in drafts]))
    library = library.set_coords(
        [name for name, row in LIBRARY_VARIABLES.items() if row.coordinate and name in library]
    )
    # Columns (signature,) of the properties that can be coordinates: numbers, else text
    names = dict.fromkeys(name for region in regions for name in region.properties)
    reserved = {*LIBRARY_VARIABLES, BAND, "member"}
    usable = [name for name in names if name.isidentifier() and name not in reserved and name[:2] != "__"]
    library = library.assign_coords(
        {
            name: (SIGNATURE, column, {"long_name": f"Property {name} of the regions"})
            for name, column in (
                {
                    name: _column([region.properties.get(name) for region in regions])
                    for name in usable[:MAX_PROPERTIES]
                }
            ).items()
        }
    )
    # attributes of corrections prevent a second correction
    corrections = dict.fromkeys(name for source in sources.values() for name in source.corrections)
    library["reflectance"].attrs |= {
        "centre": notes["centre"],
        **_quantity(sources),
        **{
            name: _joined(source.corrections.get(name, "none") for source in sources.values())
            for name in corrections
        },
        "geometry": "sun and sky on a level surface, camera above: sun_zenith, view_zenith, "
        "relative_azimuth, diffuse_fraction of every paint",
    }
    files = dict.fromkeys(str(source.line.attrs.get("source", "")) for source in sources.values())
    library.attrs = {
        "title": "Paint signatures",
        "source": ", ".join(text for text in files if text),
        "flightlines": list(sources),
        "regions": regions.digest,
        "coordinates_of_regions": regions.coordinates,
        "spectral_axis": "nominal wavelengths",
        "view_geometry": _joined(source.viewing.description for source in sources.values()),
        "smoothing": _joined(source.smoothing for source in sources.values()),
        "corrections": _joined(
            _joined(f"{name}: {text}" for name, text in source.corrections.items()) or "none"
            for source in sources.values()
        ),
        **notes,
    }
    return library


def _joined(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(texts))


def _quantity(sources: Mapping[str, Source]) -> dict[str, str]:
    # Attributes that define the reflectance; the line with the most light of the coat in it decides
    def quantity_of(source: Source) -> str:
        is_excluded = source.declared.get("mirror_reflection") == MIRROR_EXCLUDED
        if not (is_excluded or "mirrored_sky_removed" in source.corrections):
            return OUTSIDE
        return BODY if "coat_corrected" in source.corrections else THROUGH_COAT

    quantities = {quantity_of(source) for source in sources.values()}
    quantity = next(candidate for candidate in (OUTSIDE, THROUGH_COAT, BODY) if candidate in quantities)
    word = INCLUDED if quantity == OUTSIDE else MIRROR_EXCLUDED
    return {"quantity": quantity, "specular_component": word, "mirror_reflection": word}


def _column(values: Sequence[Any]) -> Array:
    present = [value for value in values if value is not None]
    numbers = [value for value in present if isinstance(value, int | float) and not isinstance(value, bool)]
    if present and len(numbers) == len(present) and all(abs(value) < 2**53 for value in numbers):
        is_integer = len(present) == len(values) and all(isinstance(value, int) for value in present)
        filled = [np.nan if value is None else value for value in values]
        return np.array(filled, np.int64 if is_integer else np.float64)
    texts = ["" if value is None else value for value in values]
    return np.array(
        [text if isinstance(text, str) else json.dumps(text, ensure_ascii=False) for text in texts], object
    )
