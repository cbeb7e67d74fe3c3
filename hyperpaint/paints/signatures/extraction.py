"""`extract_signatures`: from regions of flight lines to a library of paints.

Only blocks of lines with pixels of regions are computed, one task a block, which returns these pixels only.
They are reduced in the order of the regions, so that results have the same bits for any chunking.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array, Floats, Progress
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented, one_of
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, Quality, flag_names
from hyperpaint.base.units import takes_quantities
from hyperpaint.light.coat_transmission import COAT_INDEX
from hyperpaint.regions import Regions, pixels_of, regions_from
from hyperpaint.surroundings.corrections import LEVELS, WIDTHS, correct_coat

from .coat_strength import with_coat_strength
from .line_sources import RegionPixels, Smoothing, Source, distinct_pixels, lines_of, source_of
from .pixel_gathering import gather
from .pixel_statistics import CENTRES, excluded_of
from .signature_library import Draft, paint_library

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

#: Values of ``finish`` or ``kind`` for paints with flakes, whose signature holds for one geometry of sun and
#: view and includes the coat.
_FLAKE_PAINTS = frozenset({"metallic", "pearl"})


def without_coat(
    library: xr.Dataset,
    regions: Regions,
    index: float,
    sun_zenith: float | None,
) -> xr.Dataset:
    """Return a library corrected for a coat of the given index; see `correct_coat`.

    Regions of other surfaces than paint, and metallic paint, stay unchanged.
    """
    words = [
        {str(region.properties.get(name, "")).lower() for name in ("kind", "material", "finish")}
        for region in regions
    ]
    has_coat = np.array([not region_words & (_NO_PAINT | _FLAKE_PAINTS) for region_words in words])
    if not has_coat.any():
        return library
    corrected = correct_coat(library, index=index, sun_zenith=sun_zenith)
    if has_coat.all():
        return corrected
    is_corrected = xr.DataArray(has_coat, dims=SIGNATURE)
    uncorrected = library.assign(
        coat_transmission=xr.ones_like(corrected["coat_transmission"]),
        coat_transmission_u=xr.zeros_like(corrected["coat_transmission_u"]),
        reflectance_u_coat=xr.zeros_like(corrected["reflectance_u_coat"]),
    )
    changed = (*LEVELS, *WIDTHS, "coat_transmission", "coat_transmission_u", "reflectance_u_coat")
    return corrected.assign(
        {
            name: corrected[name].where(is_corrected, uncorrected[name]).transpose(*corrected[name].dims)
            for name in changed
            if name in corrected
        }
    )


# --- angle between view and mirrored sun on a body part, and change of reflectance over that angle ---------
# A metallic paint has no single reflectance: flakes lie nearly level, and reflect most around the direction
# in which the body part mirrors the sun. Its signature holds for this angle only.

#: Share of a body part's pixels that forms its bright end, and share that forms its dark end [1].
FLOP_SHARE = 0.2

#: Minimum number of pixels for a flop.
MIN_FLOP_MEMBERS = 20

#: Minimum share of a body part's pixels with a value in a band, for this band to be used [1].
MIN_BAND_SHARE = 0.9

#: Maximum lean inferred from a change of brightness [degree].
MAX_LEAN_DEG = 15.0


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


class Flop(NamedTuple):
    """Change of reflectance from the dark to the bright end of a body part."""

    spectrum: Floats  #: (band,): Bright end less dark end, over their mean [1]; NaN where unknown.
    contrast: float  #: The same for the means over all good bands [1].


def flop_of(members: Array, good: Array) -> Flop:
    r"""Return the change of reflectance from the dark to the bright end of a body part.

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
    if len(values) < MIN_FLOP_MEMBERS or not good.any():
        return Flop(np.full(members.shape[1], np.nan), np.nan)
    median = np.median(values[:, good], axis=0)
    order = np.argsort((values[:, good] / np.maximum(median, 1e-6)).mean(axis=1), kind="stable")
    count = max(1, round(FLOP_SHARE * len(values)))
    dark, bright = values[order[:count]].mean(axis=0), values[order[-count:]].mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        spectrum = np.where(dark + bright > 0.0, 2.0 * (bright - dark) / (bright + dark), np.nan)
    total = bright[good].mean() + dark[good].mean()
    contrast = 2.0 * float(bright[good].mean() - dark[good].mean()) / total if total > 0.0 else np.nan
    return Flop(spectrum, contrast)


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
    """Return a library with the angles between view and mirrored sun of its body parts, and their flop.

    Adds ``aspecular_angle`` (signature) of a level body part; ``aspecular_range`` (signature), twice
    `lean_range`, its possible variation between the ends of the body part [degree]; and ``flop`` (signature,
    band), `flop_of` of the members [1]; NaN where members, sun or view are unknown.
    """
    good = library["good"].values.astype(bool)
    members = library["member_reflectance"].transpose(SIGNATURE, ..., BAND).values
    # bands that many pixels lack, such as bands without irradiance, are excluded instead of the pixels
    has_value = np.isfinite(members)
    band_is_used = has_value.sum(axis=1) > MIN_BAND_SHARE * has_value.any(axis=2).sum(axis=1)[:, None]
    flops = [
        flop_of(paint_members, good & bands)
        for paint_members, bands in zip(members, band_is_used, strict=True)
    ]
    contrast = np.array([flop.contrast for flop in flops])
    # without a split all light is assumed to be direct, which gives the smallest lean
    direct = np.ones(len(flops))
    if "diffuse_fraction" in library.variables:
        split = library["diffuse_fraction"].transpose(SIGNATURE, BAND).values
        direct = 1.0 - np.array(
            [np.nanmean(row[good]) if np.isfinite(row[good]).any() else 0.0 for row in split]
        )
    sun_zenith, view_zenith, relative_azimuth = (
        library[name].values for name in ("sun_zenith", "view_zenith", "relative_azimuth")
    )
    variables = {
        "aspecular_angle": (SIGNATURE, aspecular_angle(sun_zenith, view_zenith, relative_azimuth)),
        "aspecular_range": (SIGNATURE, 2.0 * lean_range(contrast, sun_zenith, direct)),
        "flop": ((SIGNATURE, BAND), np.array([flop.spectrum for flop in flops], np.float32)),
    }
    return library.assign(
        {
            name: xr.DataArray(values, dims=dims, attrs=LIBRARY_VARIABLES[name].attrs)
            for name, (dims, values) in variables.items()
        }
    )


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
        of the surface: saturated, irradiance_gap, no_data, glint, shadow, adjacency and mixed_edge.
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
        (signature, member, band), all float32 [1], NaN where unknown; ``n``, ``n_eff`` and ``n_excluded``
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
        ``signature``, ``wavelength``, ``fwhm``, ``good``, ``time``, ``flightline``, ``region`` (as GeoJSON),
        and every property of the regions. Attributes hold the settings; attributes of reflectance define it:
        ``quantity``, of the body under a coat, of the body through the coat, or of its outside;
        ``mirror_reflection`` and ``specular_component``, whether the mirrored sky is "included" or
        "excluded"; and ``geometry``.

    Raises
    ------
    FormatError
        The regions cannot be read.
    SchemaError, UnitsError
        Options, lines or regions cannot be used: a region has no pixels, or too few usable ones (see
        ``drop_small``); flight lines have different bands; the mirrored sky was removed before, or the
        position of the sun is unknown. All faults of a kind are listed.

    Notes
    -----
    The signature of a metallic or pearl paint (by ``finish`` or ``kind`` of its region) holds only for its
    ``aspecular_angle`` under its sun and sky; it is not corrected for the coat, and ``flop`` shows the change
    with the angle.

    In a map with the indices of the pixels that its cells show, every pixel counts once, and members have
    their positions in the flight line; a map of nearest pixels omits some pixels of the flight line.

    Spectra are resampled to the nominal wavelengths first. A sample that is missing in a pixel is missing in
    that band only. The direction of view follows from the line's ``view_zenith`` and ``view_azimuth``, else
    from ``look_across`` or ``look_angle``, ``roll``, ``pitch`` and ``heading`` in the line's declared
    convention, and its ``boresight``; without these it is NaN, and the attribute ``view_geometry`` names the
    missing variables. The standard uncertainties hold for the mean of these pixels. For a flight line with
    its calibration they are propagated source by source, see `hyperpaint.radiometry.mean_uncertainty`:
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
    options = _Options(EXCLUDED if exclude is None else exclude, members, centre, min_pixels, seed)
    region_list = regions_from(regions)
    options.check(region_list)
    for option, value in (("sun_zenith", sun_zenith), ("diffuse", diffuse)):
        if value is not None and not (specular_sky or coat):
            raise SchemaError(
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
    _check_bands(sources)
    names = {position: name for name, (_, positions) in lines.items() for position in positions}
    pixels = _pixels_of_regions(region_list, lines, sources)
    rounds = [
        _Round(name, batch, bands)
        for name, (_, positions) in lines.items()
        for batch, bands in _rounds(sources[name], positions, pixels, all_bands=centre == "geometric_median")
    ]
    if centre == "geometric_median":
        _check_complete(rounds, sources, pixels, region_list)
    drafts = [Draft(sources[names[position]], region_pixels) for position, region_pixels in enumerate(pixels)]
    excluded = [
        excluded_of(region, options.exclude) if exclude is None else exclude for region in region_list
    ]
    for number, gathering_round in enumerate(rounds):
        round_progress = part_of(progress, number, len(rounds))
        _reduce(gathering_round, sources[gathering_round.line], drafts, options, excluded, round_progress)
    small = _small(region_list, drafts, min_pixels)
    large_enough = [number for number in range(len(region_list)) if number not in small]
    if small and not (drop_small and large_enough):
        problems = Problems("regions have too few usable pixels", SchemaError)
        for text in small.values():
            problems.add(
                text,
                mend="draw another region, exclude fewer flags, lower min_pixels, or pass drop_small=True",
                code="region-too-small",
            )
        problems.raise_if_any()
    remaining = Regions(tuple(region_list[k] for k in large_enough), region_list.coordinates, region_list.crs)
    library = paint_library(
        remaining, [drafts[k] for k in large_enough], [names[k] for k in large_enough], sources, options.notes
    )
    if sun_zenith is not None:  # takes precedence over the clock
        zenith = np.full(library.sizes[SIGNATURE], float(sun_zenith))
        library = library.assign(sun_zenith=library["sun_zenith"].copy(data=zenith))
    library = with_coat_strength(library, sun_zenith)
    if specular_sky if coat is None else coat:
        library = without_coat(library, remaining, coat_index, sun_zenith)
    library = with_aspecular_geometry(library)
    return library.assign_attrs(left_out=list(small.values())) if small else library


@dataclass(frozen=True)
class _Options:
    exclude: int
    members: int
    centre: str
    min_pixels: int
    seed: int

    def check(self, regions: Regions) -> None:
        problems = Problems("signatures cannot be extracted", SchemaError)
        if not len(regions):
            problems.add(
                "regions= is empty", mend="draw regions, or call propose_regions", code="empty-input"
            )
        if not isinstance(self.exclude, int) or not 0 <= self.exclude < 2 * max(Quality):
            problems.add(
                f"exclude={self.exclude!r:.40}",
                expected="flags such as Quality.GLINT | Quality.SHADOW, or 0",
                code="choice-unknown",
            )
        for name, value, minimum in (("members", self.members, 0), ("min_pixels", self.min_pixels, 1)):
            if value < minimum:
                problems.add(f"{name}={value}", expected=f"{minimum} or more", code="value-out-of-range")
        one_of(self.centre, CENTRES, "centre", problems=problems)
        problems.raise_if_any()

    @property
    def notes(self) -> dict[str, Any]:
        return {**asdict(self), "exclude": " ".join(flag_names(self.exclude)) or "none"}


@dataclass(frozen=True)
class _Round:
    # Regions of a flight line, by number, and bands that are gathered together
    line: str
    batch: list[int]
    bands: slice


def _reduce(
    gathering_round: _Round,
    source: Source,
    drafts: Sequence[Draft],
    options: _Options,
    excluded: Sequence[int],
    progress: Progress | None,
) -> None:
    # Gather and reduce the pixels of a round; `excluded` holds the excluded flags of every draft
    bands = gathering_round.bands
    batch = [drafts[position] for position in gathering_round.batch]
    along, across = (np.concatenate([draft.cells[axis] for draft in batch]) for axis in (0, 1))
    # reading is the first half of the work, reducing the second
    gathering = None if progress is None else lambda count, blocks: progress(count, 2 * blocks)
    spectra, values = gather(source.cubes, source.planes, along, across, bands, source.small, gathering)
    line_values = {key: values[key] for key in source.small}
    start = 0
    for position, draft in zip(gathering_round.batch, batch, strict=True):
        rows = slice(start, start + draft.along.size)
        start = rows.stop
        if bands.start == 0:
            present = values["present"][rows]
            planes = {name: values[name][rows] for name in source.planes}
            draft.choose(present, planes, line_values, excluded[position], options.members, options.seed)
        if draft.n >= options.min_pixels:
            draft.take_bands({name: cube[rows] for name, cube in spectra.items()}, bands, options.centre)
        if progress is not None:
            progress(along.size + start, 2 * along.size)


_DEGREES_WITHOUT_CRS = (
    "without a crs the coordinates are columns and lines: if they are longitude and latitude, pass "
    'Regions(..., coordinates="map", crs="OGC:CRS84"), or write "crs": "OGC:CRS84" beside "features" in '
    "the file"
)


# --- pixels and rounds, with checks before values are read -------------------------------------------------


def _check_bands(sources: Mapping[str, Source]) -> None:
    (reference_name, reference), *further = sources.items()
    problems = Problems("signatures of these flight lines cannot be in one library", SchemaError)
    for name, source in further:
        has_same_bands = source.wavelength.shape == reference.wavelength.shape and np.allclose(
            source.wavelength, reference.wavelength, rtol=0.0, atol=1e-3
        )
        if not has_same_bands:
            problems.add(
                f"bands of {name!r} differ from those of {reference_name!r}",
                mend="extract a library from every line",
                code="bands-differ",
            )
    problems.raise_if_any()


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
        could_be_degrees = line_regions.coordinates == "sensor" and bool((corners <= [180.0, 90.0]).all())
        pixels_of_line = distinct_pixels(line, pixels_of(line_regions, line))
        for position, region_pixels in zip(positions, pixels_of_line, strict=True):
            pixels[position] = region_pixels
            if not region_pixels.size:
                size = f"{line.sizes['along_track']} lines of {line.sizes['cross_track']} columns"
                problems.add(
                    f"region {regions[position].name!r} contains no pixel of the line ({size})",
                    mend=_DEGREES_WITHOUT_CRS if could_be_degrees else "",
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


def _check_complete(
    rounds: Sequence[_Round], sources: Mapping[str, Source], pixels: Sequence[RegionPixels], regions: Regions
) -> None:
    # Raise for regions whose bands are divided among rounds
    problems = Problems("the geometric median needs all bands of a region in memory", SchemaError)
    for gathering_round in rounds:
        bands, number = gathering_round.bands, gathering_round.batch[0]
        if bands.start == 0 and bands.stop < sources[gathering_round.line].wavelength.size:
            count = pixels[number].size
            problems.add(
                f"region {regions[number].name!r} has {count} pixels: more than "
                f"{MAX_COMPLETE_BYTES >> 20} MiB",
                mend='draw a smaller region, or pass centre="trimmed_mean"',
                code="region-too-large",
            )
    problems.raise_if_any()


def _small(regions: Regions, drafts: Sequence[Draft], min_pixels: int) -> dict[int, str]:
    # Text about every region with too few usable pixels, by its number
    texts = {}
    for number, (region, draft) in enumerate(zip(regions, drafts, strict=True)):
        if draft.n < min_pixels:
            shares = zip(flag_names(), draft.share, strict=True)
            flags = ", ".join(f"{share:.0%} {name}" for name, share in shares if share > 0)
            texts[number] = (
                f"region {region.name!r}: {draft.n} of {draft.along.size} pixels are usable, expected "
                f"{min_pixels} ({flags or 'no flags'})"
            )
    return texts
