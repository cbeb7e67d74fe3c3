"""Survey of a whole line: its channels, segments, their spectra in full light, and neighbours."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import dask.array as da
import numpy as np
import numpy.typing as npt
import scipy.sparse
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools, Floats, Floats32, Ints, Progress
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.progress_reports import as_progress
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, Quality
from hyperpaint.base.units import takes_quantities
from hyperpaint.radiometry.slabs import line_chunked

from .detection_rules import BODIES, GLINT, SHADOWS, SURVEY
from .full_light import AS_GLINT, Light, Matches, match_segments, median_spectra, unmix_spectra
from .light_split import LightSplit, split_of
from .lobes import Picture, Shown, mirror_lobes
from .model import CELL, LIT, SHADED, SceneModel, nearest_at
from .scratch import compute_into, gather, line_parts, release, scratch_array, trim_memory
from .segments import (
    Segments,
    Touching,
    beyond,
    border_steps,
    distance_to,
    distinct_pairs,
    divide,
    edge_distance,
    sample_pixels,
    touching,
)
from .shadows import match_shade, of_shadows, penumbrae, shaded_pixels
from .sun_and_sky import fraction_in_shadow, shadow_side_of
from .vegetation import is_vegetation

# -- Bodies in full light: coloured bodies that light others, and reference spectra without glint.


def coloured(spectrum: Floats, light: Light) -> Floats:
    """Return the colour of spectra (segment,): rms residual of a fit of direct light and grey [1].

    Over the channels with values; 0 where these are too few.
    """
    basis = np.stack([np.ones_like(light.direct), light.diffuse], axis=1)
    is_finite = np.isfinite(spectrum)
    colour = np.zeros(len(spectrum))
    for pattern in np.unique(is_finite, axis=0):
        if pattern.sum() <= basis.shape[1]:
            continue
        same = (is_finite == pattern).all(axis=1)
        seen = spectrum[same][:, pattern]
        amounts, *_ = np.linalg.lstsq(basis[pattern], seen.T, rcond=None)
        colour[same] = np.sqrt(np.mean((seen - (basis[pattern] @ amounts).T) ** 2, axis=1))
    return colour


def coloured_bodies(spectrum: Floats, light: Light) -> Bools:
    """Return whether spectra are coloured enough to be distinguished from mirrored sunlight (segment,)."""
    return np.asarray(_relative_colour(spectrum, light) > BODIES.min_paint_colour)


def nearest_coloured(
    number: npt.NDArray[np.int32], size: Ints, spectrum: Floats, matches: Matches, light: Light, reach: int
) -> npt.NDArray[np.int32]:
    """Return the nearest coloured segments (cell_along, cell_cross, rank) in full light.

    Takes ``number`` (line, column): segment of every pixel; ``size``, ``spectrum``, ``matches``: of the
    segments; ``light``: parts of the irradiance; ``reach``: maximum distance of their light [pixel].
    """
    from hyperpaint.kernels.segmentation import nearest_sources

    sends = (
        (coloured(spectrum, light) > BODIES.min_sender_colour)
        & (matches.state == LIT)
        & (size >= BODIES.min_sender_px)
        & (np.nan_to_num(spectrum).mean(axis=1) < BODIES.max_sender_level)
        & coloured_bodies(spectrum, light)
    )
    centre = number[CELL // 2 :: CELL, CELL // 2 :: CELL]
    cells = tuple(-(-length // CELL) for length in number.shape)
    labels = np.full((*cells, BODIES.neighbours_of_cell), -1, np.int32)
    distances = np.full((*cells, BODIES.neighbours_of_cell), np.inf)
    sources: Any = np.where(np.append(sends, False)[centre], centre, -1)
    labels[: centre.shape[0], : centre.shape[1], 0] = sources
    distances[..., 0] = np.where(labels[..., 0] >= 0, 0.0, np.inf)
    nearest_sources(labels, distances, reach / CELL)
    return labels


_BESIDE = 2 * [(0.0, 0.1), (0.0, 0.05)]
#: Prior of the amounts in a pixel: expected values and standard deviations (2, part).
_AS_PIXEL = np.transpose(
    [(1.0, 0.2), (1.0, 0.3), (BODIES.offset, 0.1), (BODIES.offset, 0.02), (0.0, 0.03), *_BESIDE]
)


class Paints(NamedTuple):
    """Bodies of one paint."""

    first: npt.NDArray[np.int32]  #: (segment,): First of the bodies with the same paint as a segment.
    #: (pair,): Bodies of the same paint near one another, in both orders.
    one: Ints
    other: Ints


def _relative_colour(spectrum: Floats, light: Light) -> Floats:
    # Colour of spectra relative to their brightness (segment,) [1]
    return np.asarray(coloured(spectrum, light) / np.maximum(np.nan_to_num(spectrum).mean(axis=1), 1e-6))


def same_paints(spectrum: Floats, size: Ints, pairs: Touching, matches: Matches, light: Light) -> Paints:
    r"""Return the bodies that are parts of one car: of the same colour, except for tilt and glint.

    For bodies that touch, or have a small segment between them, one is the other's paint where :math:`\rho (c
    f_{dir} + V f_{dif}) + g f_{dir}` fits it to 2 %. Grey bodies cannot be distinguished, and are not joined.
    """
    near = beyond(pairs, size)
    one, other = matches.body[near[0]].astype(np.int64), matches.body[near[1]].astype(np.int64)
    paint = np.isfinite(spectrum).all(axis=1) & (_relative_colour(spectrum, light) > BODIES.min_paint_colour)
    open_ = (one != other) & paint[one] & paint[other]
    one, other = distinct_pairs(one[open_], other[open_], size.size)
    finite_spectrum = np.nan_to_num(spectrum)
    _, misfit, _ = unmix_spectra(
        finite_spectrum[one], other, finite_spectrum, light, GLINT.tolerance, AS_GLINT
    )
    one, other = one[misfit < 1.0], other[misfit < 1.0]
    joined = scipy.sparse.csr_array((np.ones(one.size), (one, other)), shape=(size.size, size.size))
    _, label = scipy.sparse.csgraph.connected_components(joined, directed=False)
    _, first = np.unique(label, return_index=True)
    both_orders = np.concatenate([one, other]), np.concatenate([other, one])
    return Paints(first[label][matches.body].astype(np.int32), *distinct_pairs(*both_orders, size.size))


def clean_references(
    channels: Floats32,
    places: list[Ints],
    spectrum: Floats,
    matches: Matches,
    paints: Paints,
    light: Light,
    neighbours: Callable[[Ints], npt.NDArray[np.int32]],
    zenith: float,
) -> tuple[Floats, Floats]:
    """Return the spectra of bodies (segment, channel) without glint, and the lean of their parts (segment,).

    Where the light added by glint and neighbours differs from pixel to pixel by over 0.003, the pixels with
    least of it are averaged. On grey bodies its amount cannot be seen; where brightness differs by more than
    tilt towards the sun allows, the darkest pixels that see as much of the sky are used, and the rest is
    glint. For bodies wholly in glint another part of the car shows the paint.

    Takes ``channels`` (line, column, channel): reflectance [1]; ``places``: pixels of every segment;
    ``spectrum``, ``matches``, ``paints``, ``light``: of the segments, and the irradiance; ``neighbours``:
    returns the coloured segments beside pixels (pixel, 2); ``zenith``: of the sun [degree]; NaN where
    unknown.
    """
    finite_spectrum = np.nan_to_num(spectrum)
    reference, tilt = finite_spectrum.copy(), np.full(len(spectrum), BODIES.tilt)
    colour = _relative_colour(spectrum, light)
    most = BODIES.min_glint_brightness / max(np.cos(np.radians(np.nan_to_num(zenith, nan=60.0))), 0.2)
    flat = channels.reshape(-1, channels.shape[2])
    for segment, here in enumerate(places):
        if matches.body[segment] != segment or not np.isfinite(spectrum[segment]).all():
            continue
        values = gather(flat, here).astype(np.float64)
        is_finite = np.isfinite(values).all(axis=1)
        here, values = here[is_finite], values[is_finite]
        if here.size < BODIES.min_body_px:
            continue
        grey = colour[segment] < BODIES.max_grey_colour
        darkest = _darkest(values, light, most) if grey else None
        if darkest is not None:
            reference[segment] = darkest
            middle = np.median(values.mean(axis=1)) / darkest.mean()
            if darkest.mean() > BODIES.bright and middle > BODIES.min_mostly_glint:
                tilt[segment] = BODIES.glint_tilt
            continue
        extra, direct = _additions(values, segment, finite_spectrum, light, neighbours(here))
        low, high = np.quantile(extra, [0.1, 0.5])
        if high - low > BODIES.min_difference:
            first, last = np.quantile(extra, BODIES.clean_grey_quantiles if grey else BODIES.clean_quantiles)
            chosen = (extra >= first) & (extra <= last) & (direct > 0.7)
            if chosen.sum() >= BODIES.min_clean_px:
                # scaled to the usual lean of the body, which may differ from the lean of those pixels
                usual = 1.0 if grey else np.median(direct) / np.median(direct[chosen])
                reference[segment] = values[chosen].mean(axis=0) * usual
    reference -= _common_glint(reference, places, paints, light) @ np.stack([light.direct, light.sunward])
    return np.ascontiguousarray(reference[matches.body]), tilt[matches.body]


def _darkest(values: Floats, light: Light, most: float) -> Floats | None:
    # Mean of a grey body's darkest pixels; None where these may not be free of glint.
    # The brightest are brighter by `most` at least; half of the body is not much brighter, unlike beside a
    # shadow; and the darkest see as much of the sky as other pixels.
    if not light.direct.any():
        return None
    level = values @ light.direct / (light.direct @ light.direct)
    first, last, usual, middle, high = np.quantile(
        level, [*BODIES.darkest_quantiles, BODIES.usual_quantile, 0.5, BODIES.brightest_quantile]
    )
    if first <= 0.0 or high <= most * usual or middle >= BODIES.max_even_ratio * first:
        return None
    low, wide = np.quantile(level, BODIES.clean_grey_quantiles)
    if wide - low < BODIES.max_plateau:  # mostly without glint: the darkest lean away
        first, last = low, wide
    darkest = values[(level >= first) & (level <= last)].mean(axis=0)
    split = np.stack([light.direct, light.diffuse], axis=1)
    both = np.stack([darkest, np.median(values, axis=0)], axis=1)
    (_, (here, there)), *_ = np.linalg.lstsq(split, both, rcond=None)
    return np.asarray(darkest) if here > BODIES.min_sky * there else None


def _additions(
    values: Floats, segment: int, finite_spectrum: Floats, light: Light, neighbours: npt.NDArray[np.int32]
) -> tuple[Floats, Floats]:
    # Light added to pixels by glint and neighbours, up to a constant, and their direct light.
    # An amount of each is first added to all pixels, so that less than the mean shows as well.
    first = neighbours[:, 0]
    mirrored = np.where(first[:, None] >= 0, finite_spectrum[first], 0.0)
    lifted = values + BODIES.offset * (light.direct + light.above) + BODIES.lift * mirrored
    body = np.full(len(values), segment)
    amount, _, added = unmix_spectra(lifted, body, finite_spectrum, light, 0.01, _AS_PIXEL, neighbours)
    return amount[:, 2] + amount[:, 4] + added.sum(axis=1) - BODIES.lift * mirrored.max(axis=1), amount[:, 0]


def _common_glint(reference: Floats, places: list[Ints], paints: Paints, light: Light) -> Floats:
    # Mirrored sun, and sky around it, that covers a whole body (segment, 2).
    # From a comparison with other parts of the same paint.
    size = np.array([here.size for here in places])
    large = size[paints.other] >= BODIES.min_part_share * size[paints.one]
    one, other = paints.one[large], paints.other[large]
    amount, misfit, _ = unmix_spectra(reference[one], other, reference, light, GLINT.tolerance, AS_GLINT)
    glint = np.zeros((len(reference), 2))
    np.maximum.at(glint, one[misfit < 1.0], amount[misfit < 1.0][:, [2, 4]])
    return glint


def channel_numbers(wavelength: Array, good: Array) -> Ints:
    """Return the channel of every band: runs of equally many good bands; -1 for bands that are not good.

    The ends of the spectrum, where colours have their steepest edges, are treated like the rest: 24 channels
    of a 400-1000 nm camera are 25 nm wide.
    """
    order = np.flatnonzero(good)[np.argsort(wavelength[good], kind="stable")]
    numbers = np.full(wavelength.size, -1, np.int64)
    numbers[order] = np.arange(order.size) * min(SURVEY.channels, order.size) // max(order.size, 1)
    return numbers


def to_channels(block: Array, channel: Ints) -> Floats32:
    """Return the means (line, column, channel) of a block (line, band, column)."""
    from hyperpaint.kernels.unmixing import average_bands

    out = np.empty((block.shape[0], block.shape[2], int(channel.max()) + 1), np.float32)
    average_bands(np.ascontiguousarray(block, np.float32), channel, out)
    return out


def read_channels(
    cube: xr.DataArray, channel: Ints, progress: Progress | None, quality: xr.DataArray | None = None
) -> tuple[Floats32, Bools]:
    """Return the whole line in channels (line, column, channel), in scratch, read in blocks.

    Also returns whether pixels are saturated (line, column). A pixel's means depend on its own bands alone,
    so that results have the same bits for any blocks.
    """
    cube = line_chunked(cube)
    lines, columns = cube.sizes[ALONG_TRACK], cube.sizes[cube.dims[2]]
    count = int(channel.max()) + 1
    out, saturated = scratch_array((lines, columns, count), np.float32), np.zeros((lines, columns), bool)
    blocks = da.map_blocks(
        to_channels,
        cube.data,
        channel,
        dtype=np.float32,
        chunks=(cube.data.chunks[0], (columns,), (count,)),
        meta=np.empty((0, 0, 0), np.float32),
    )
    if quality is None:
        compute_into([blocks], [out], progress)
    else:
        bits = da.asarray(quality.data).rechunk((cube.data.chunks[0], -1))
        compute_into([blocks, (bits & np.uint16(Quality.SATURATED)) > 0], [out, saturated], progress)
    return out, saturated


def without_unknown(channels: Floats32, channel: Ints) -> tuple[Floats32, Ints]:
    """Return a line in channels, and the channel of every band, without channels that most pixels lack.

    Otherwise one channel that is dead for the whole line would leave no segment with all channels. If no
    channel would remain, all are kept.
    """
    data, finite_count = 0, np.zeros(channels.shape[2], np.int64)
    for _, part in line_parts(channels):
        is_finite = np.isfinite(part)
        data += int(is_finite.any(axis=2).sum())
        finite_count += is_finite.sum(axis=(0, 1))
    retained = 2 * finite_count >= data
    if retained.all() or not retained.any():
        return channels, channel
    numbers = np.append(np.where(retained, np.cumsum(retained) - 1, -1), -1)  # the last one is that of -1
    some = scratch_array((*channels.shape[:2], int(retained.sum())), np.float32)
    for lines, part in line_parts(channels):
        some[lines] = part[..., retained]
        release(some)
    return some, numbers[channel]


def shift_of_channels(line: xr.Dataset, channel: Ints, columns: int) -> Floats:
    """Return true less nominal wavelength of the channels (channel, column) [nm].

    0 where the line has no ``wavelength_shift``, or it is NaN.
    """
    bands = (channel == np.arange(channel.max() + 1)[:, None]).astype(np.float64)
    bands /= bands.sum(axis=1, keepdims=True)
    if "wavelength_shift" not in line.variables:
        return np.zeros((len(bands), columns))
    variable = schema.require(line, ["wavelength_shift"], "smile")["wavelength_shift"].variable
    if variable.ndim > 1:
        variable = variable.transpose(BAND, CROSS_TRACK)
    shift = np.nan_to_num(np.asarray(variable.values, np.float64))
    return np.ascontiguousarray(bands @ np.broadcast_to(shift, (channel.size, columns)))


def to_nominal_channels(channels: Floats32, centre: Floats, shift: Floats) -> None:
    """Remove the smile from channels (line, column, channel), in place: slope times shift.

    The slope is that between the channels on both sides, which are much wider than any smile.
    """
    if len(centre) < 2 or not shift.any():
        return
    for _, part in line_parts(channels):
        for block in np.split(part, range(CHUNK_LINES, len(part), CHUNK_LINES)):
            slope = np.gradient(block.astype(np.float64), centre, axis=2)
            block -= np.nan_to_num(slope * shift.T).astype(np.float32)


def channel_noise(channels: Floats32, number: npt.NDArray[np.int32], inside: Bools) -> Floats:
    """Return the noise of channels (channel,), relative to the reflectance [1].

    From second differences over the channels of the differences of neighbouring pixels of one segment: light
    and surface change little from pixel to pixel, and smoothly over the channels. 0 where it cannot be
    estimated.

    Takes ``channels`` (line, column, channel): reflectance [1]; ``number``, ``inside`` (line, column):
    segment of every pixel, and whether it lies inside.
    """
    count = channels.shape[2]
    same = (number[:, 1:] == number[:, :-1]) & (number[:, 1:] >= 0) & inside[:, 1:] & inside[:, :-1]
    total, first = int(np.count_nonzero(same)), 0
    if count < 3 or not total:
        return np.zeros(count)
    step = max(1, total // SURVEY.max_noise_pairs)
    pairs: list[list[Array]] = []
    for lines, part in line_parts(channels):
        line, x = np.nonzero(same[lines])
        some = slice(-first % step, None, step)  # every so many of all
        first += line.size
        pairs.append([part[line[some], x[some] + right] for right in (0, 1)])
    one, other = (np.concatenate(side).T for side in zip(*pairs, strict=True))
    noise = np.zeros(count - 2)
    for k in range(1, count - 1):
        # of three channels at a time, for memory
        here, beside = one[k - 1 : k + 2].astype(np.float64), other[k - 1 : k + 2].astype(np.float64)
        apart, level = here - beside, (here[1] + beside[1]) / 2
        bent = (apart[1] - (apart[2] + apart[0]) / 2) / np.maximum(level, SURVEY.min_noise_level)
        deviations = np.abs(bent[np.isfinite(bent)])
        # three variances of a channel: one and two halves, squared, of two pixels
        noise[k - 1] = 1.4826 * np.median(deviations) / np.sqrt(3.0) if deviations.size else 0.0
    return np.pad(noise, 1, mode="edge")


@takes_quantities(sun_zenith="degree", sun_azimuth="degree", heading="degree")
def survey(
    line: xr.Dataset,
    *,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    sun_azimuth: float | None = None,
    heading: float | None = None,
    reach: int = 120,
    progress: Progress | bool | None = None,
) -> SceneModel:
    r"""Survey a whole line, and return the scene model that flags use.

    Eager. The line is read once, some blocks at a time, and held as means over 24 channels (96 bytes a pixel,
    in a temporary file for more than some 500 lines) during the survey, beside some 30 bytes a pixel in
    memory. Results have the same bits for any chunks and scheduler.

    Parameters
    ----------
    line
        A flight line with ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``. Time,
        latitude, longitude and heading, where present, determine the direction of the sun in the image.
    diffuse
        Source of the diffuse part of the irradiance: None, the line's ``diffuse_fraction`` or else its record
        of ``irradiance``, mean over lines; "model", the clear sky of `hyperpaint.light.sun`, also assumed,
        with a warning, where the line has no record; "pvlib", SPECTRL2 (extra ``sim``); "shadow", a cast
        shadow on the ground in the image; or a measured spectrum (band,) or with a coordinate
        ``wavelength``, such as a reading in the shade of a small disc over the reading in full light.
    sun_zenith
        [degree]; by default from time and place.
    sun_azimuth, heading
        Clockwise from north [degree]; by default from the line. Without them, the side of shadows is
        estimated from the most certain ones.
    reach
        Maximum distance at which light of a coloured object is considered [pixel].
    progress
        True for a bar on stderr, or a function called with (lines done, lines to do).

    Returns
    -------
    SceneModel

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing or have other dims or units; the line has no pixel or no good band; the
        wavelength of a good band is missing; the position of the sun is unknown; ``diffuse`` has another
        value, or there is no shadow.
    MissingExtraError
        pvlib is not installed.

    Warns
    -----
    PaintWarning
        A clear sky is assumed, since the line has no record of its light.

    Notes
    -----
    1. Segments: neighbouring pixels are joined in ascending order of their difference [1]_; small or thin
       segments are joined to a neighbour, and are mixed pixels where they lie between two bodies. Where parts
       of one car differ by tilt, pixels between them are not mixed.
    2. Segments that are another segment's surface in shadow,
       :math:`\rho (c f_{dir} + V f_{dif} + b \rho_n)` with small c and the light b of one coloured neighbour,
       or that fade into another under the mirror image of the sun,
       :math:`\rho (c f_{dir} + V f_{dif}) + g f_{dir}`, get its spectrum. Dark glass and black paint can look
       like asphalt in shadow in every band: a shadow touches its lit body, on a side away from the sun, or
       another shadow. On the ground, single pixels are shadow where direct light is missing and light of the
       sky is not. Where the sky has over 95 % of the light there are no shadows, and no mirror images of the
       sun.
    3. A body's reference is the mean of the pixels with least glint and light from coloured neighbours, less
       glint that covers the whole body, estimated from other parts of the same coloured paint.
    4. The nearest coloured segments of every 4 x 4 pixels.

    Channels that most pixels lack, such as those of dead bands, are left out. A body that lies wholly in
    shadow or in glint, without a touching part outside, keeps its spectrum.

    References
    ----------
    .. [1] P. F. Felzenszwalb, D. P. Huttenlocher, "Efficient graph-based image segmentation", Int. J. Comput.
       Vis. 59, 167-181 (2004). doi:10.1023/B:VISI.0000022288.19776.77

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> nm = np.linspace(400.0, 1000.0, 48)
    >>> seen = np.full((16, 48, 16), 0.1, np.float32)
    >>> seen[:, :, 8:] = 0.5
    >>> line = xr.Dataset({"reflectance": (("along_track", "band", "cross_track"), seen, {"units": "1"})},
    ...                   {"wavelength": ("band", nm, {"units": "nm"})})
    >>> survey(line, sun_zenith=30.0, diffuse="model").segments
    2
    """
    from hyperpaint.kernels.segmentation import boundary_distance

    line = schema.rename_to_roles(line)
    variables = schema.require(line, ["reflectance", "wavelength"], "a scene model")
    cube = variables["reflectance"]
    wavelength = variables["wavelength"].values.astype(np.float64)
    good = _good_bands(line, cube, wavelength)
    try:
        divided = split_of(line, diffuse, sun_zenith).mean()
    except SchemaError as error:
        if not (isinstance(diffuse, str) and diffuse == "shadow"):
            raise
        found = "diffuse='shadow' starts from the light of a clear sky"
        raise SchemaError(found, problems=[error.problem]) from error
    fraction, zenith = divided.fraction.values, divided.zenith
    channel = channel_numbers(wavelength, good)
    bits = None
    if "quality" in line.variables:
        bits = schema.require(line, ["quality"], "a scene model")["quality"].transpose(
            ALONG_TRACK, CROSS_TRACK
        )
    channels, saturated = read_channels(cube, channel, as_progress(progress, "survey"), bits)
    channels, channel = without_unknown(channels, channel)
    bands = (wavelength, fraction, divided.u.values, *divided.mirrored())
    centre, split, split_u, *sky = (_mean_of(values, channel) for values in bands)
    shift = shift_of_channels(line, channel, channels.shape[1])
    to_nominal_channels(channels, centre, shift)
    light = Light.under(split, *sky)
    segments = divide(channels)
    trim_memory()
    count = segments.size.size
    boundary_px = np.empty(segments.number.shape, np.uint8)
    boundary_distance(segments.number, segments.sure, 255, boundary_px)
    is_inside = boundary_px >= SURVEY.min_edge_distance_px
    places = sample_pixels(segments.number, is_inside, count)
    del boundary_px
    spectrum = median_spectra(channels, places)
    side = shadow_side_of(line, sun_azimuth, heading)
    pairs = touching(segments.number, count)
    steps = border_steps(channels, segments.number, pairs)

    def matched(light: Light) -> tuple[Matches, Bools]:
        if light.direct.mean() < SURVEY.min_direct:
            lit = Matches(np.full(count, LIT, np.int8), np.arange(count, dtype=np.int32))
            return lit, np.zeros(count, bool)
        shade, ground = match_shade(segments.number, spectrum, segments.size, pairs, light, side)
        ground |= is_vegetation(spectrum, centre)
        return match_segments(spectrum, segments.size, pairs, light, shade, steps, zenith), ground

    matches, ground = matched(light)
    if isinstance(diffuse, str) and diffuse == "shadow":
        split = fraction_in_shadow(channels, places, spectrum, segments.size, matches)
        light = Light.under(split, *sky)
        matches, ground = matched(light)
    trim_memory()
    number = penumbrae(channels, segments.number, matches, ground, light)
    if number is not segments.number:
        sizes = np.bincount(number[number >= 0], minlength=count).astype(np.int64)
        segments = Segments(number, segments.sure, sizes)
    neighbour = nearest_coloured(segments.number, segments.size, spectrum, matches, light, reach)
    paints = same_paints(spectrum, segments.size, pairs, matches, light)
    beside = partial(nearest_at, neighbour, matches.body, paints.first, segments.number)
    reference, tilt = clean_references(channels, places, spectrum, matches, paints, light, beside, zenith)
    del places
    coated = coloured_bodies(reference, light)
    # ground without any cast shadow may be a bonnet that fills the picture
    bare = ground & ground[matches.body[matches.state == SHADED]].any()
    lobe = (
        np.zeros(saturated.shape, np.uint8)
        if light.direct.mean() < SURVEY.min_direct
        else mirror_lobes(
            Picture(channels, saturated, Shown(segments.number, matches.body), bare, reference, coated, light)
        )
    )
    noise = channel_noise(channels, segments.number, is_inside)
    del is_inside
    trim_memory()
    shade_distance = _shade_distance(channels, segments.number, matches, ground, reference, light)
    trim_memory()
    return SceneModel(
        wavelength=wavelength,
        channel=channel,
        channel_wavelength=centre,
        diffuse_fraction=split,
        zenith_radiance=sky[0],
        sunward_radiance=sky[1],
        shift=shift,
        noise=noise,
        segment=segments.number,
        shade_distance=shade_distance,
        edge_distance=edge_distance(segments, matches.body, paints.first),
        lobe=lobe,
        neighbour=neighbour,
        size=segments.size,
        state=matches.state,
        body=matches.body,
        ground=ground[matches.body].astype(np.int8),
        paint=paints.first,
        tilt=tilt,
        spectrum=spectrum,
        reference=reference,
        attrs={
            "diffuse_fraction_from": _source_text(diffuse, divided),
            "diffuse_fraction_u": split_u.tolist(),
            "sky_states": " ".join(divided.states),
            "reach": reach,
            "sun_zenith": zenith,
        },
    )


def _shade_distance(
    channels: Floats32,
    number: npt.NDArray[np.int32],
    matches: Matches,
    ground: Bools,
    reference: Floats,
    light: Light,
) -> npt.NDArray[np.uint8]:
    # Distance of every pixel from any shadow (line, column) [pixel]
    distance = distance_to(np.append(matches.state == SHADED, False)[number])
    shaded = shaded_pixels(channels, number, ground & (matches.state == LIT), reference, light)
    level = np.append(np.nan_to_num(reference).mean(axis=1), 0.0)
    deep = np.empty_like(shaded)
    for part, seen in line_parts(channels):
        deep[part] = shaded[part] & (seen.mean(axis=2) < SHADOWS.max_deep_level * level[number[part]])
    distance[of_shadows(shaded, (distance == 0) | deep)] = 0
    return distance


def _good_bands(line: xr.Dataset, cube: xr.DataArray, wavelength: Floats) -> Bools:
    problems = Problems("this line cannot be surveyed", SchemaError)
    if not cube.size:
        problems.add(
            f"reflectance has shape {cube.shape}",
            expected="at least one line, band and column",
            code="empty-input",
        )
    good = np.ones(wavelength.size, bool)
    if "good" in line.variables:
        if line["good"].dims != (BAND,):
            problems.add(f"'good' has dims {line['good'].dims}", expected=f"({BAND!r},)", code="dims-wrong")
        else:
            good = line["good"].values.astype(bool)
    if not good.any():
        problems.add(
            f"'good' is False in all {good.size} bands",
            mend="correct 'good', or drop it to use all of them",
            code="good-bands-missing",
        )
    without = np.flatnonzero(good & ~np.isfinite(wavelength))
    if without.size:
        problems.add(
            f"wavelength is missing in {without.size} good bands, the first of them {without[0]}",
            mend="give it, or set 'good' to False there",
            code="wavelength-missing",
        )
    problems.raise_if_any()
    return good


def _source_text(diffuse: Any, split: LightSplit) -> str:
    place = f"sun at {split.zenith:.1f} degrees from the zenith"
    if split.source == "measured":
        return "a measured spectrum"
    if split.states:
        return f"the lines' own record, sky {', '.join(split.states)}, {place}"
    return {
        "pvlib": f"SPECTRL2 of pvlib, {place}",
        "shadow": "cast shadow in the image",
    }.get(str(diffuse), f"clear sky of hyperpaint.light.sun, {place}")


def _mean_of(values: Floats, channel: Ints) -> Floats:
    # Means of values (band,) over the bands of every channel (channel,)
    used = channel >= 0
    return np.asarray(np.bincount(channel[used], values[used]) / np.bincount(channel[used]))
