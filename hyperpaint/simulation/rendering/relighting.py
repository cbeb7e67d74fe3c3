"""From traced weights to radiance, for any paints, atmosphere and camera, without tracing again.

A path of weight ``w`` adds ``w E(lambda)/pi x product of its factors`` to the radiance of a pixel. The term
after ``w`` depends only on the path's code, of which a scene has some thousands: it is computed once for
every code and band, and cached.

Shares of light are shares of the radiance at the surface, before the air, as a mean over all bands at the
wavelengths of the centre column. Shares of sun and sky add up to 1; glint, mirrored sky and indirect light
are disjoint parts of them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import dask
import dask.array as da
import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array, Floats, Floats32, Ints
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    FORMAT_VERSION,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    SLOT,
    SUN,
    VARIABLES,
    dtype_of,
    label,
    require,
)
from hyperpaint.simulation.atmosphere import BrokenClouds
from hyperpaint.simulation.camera import BandResponses, BandSet, cell_means, convolve_gaussian
from hyperpaint.simulation.transport.mixing import (
    Texture,
    index_paths,
    integrate_bands,
    member_rows,
    mix,
    mix_shifted,
    through_air,
)
from hyperpaint.simulation.transport.path_codes import (
    CLEAR_SKY_FUNCTIONS,
    FIRST_CLEAR_SKY,
    FIRST_SUN,
    OVERCAST_SKY,
    SKY,
    SOURCES,
    PathCodes,
    is_direct,
    is_indirect,
    is_mirrored,
    source_of,
)

from .four_curves import Atmosphere, preset_atmosphere
from .painting import Populations, factor_spectra, populations_of
from .scene_record import LabelTable, SceneRecord, TraceSettings, sun_vectors

_PATHS = ("transport_weight", "transport_path", "distance")

#: Layers of the traced dataset that no light changes.
_UNLIT_LAYERS = (
    "material",
    "instance",
    "surface_class",
    "car_id",
    "purity",
    "distance",
    "east",
    "north",
    "up",
)

_COVERED = 1.5  # full widths around the bands' centres that an atmosphere must cover

#: Layers with the shares of light in a pixel by source.
SHARES = ("sun_share", "sky_share", "glint_share", "mirrored_sky_share", "indirect_share")

_MAX_SUN_ANGLE_DEG = 0.01  # between the sun of an atmosphere and the traced sun
_MAX_CACHE_BYTES = 96 * 2**20  # maximum size of cached products; others are computed whenever needed

_FWHM_NM, _STEP_NM = 3.0, 1.0  # of the irradiance spectrometer
_GRID_STEP_NM = 0.05
_REACH = 3.3  # extent of its line shape [full widths]
_MARGIN = np.timedelta64(10**9, "ns")  # record before the first and after the last line
_MAX_TIMES = 2000


def relight(
    traced: xr.Dataset,
    bands: Any = None,
    *,
    paints: Mapping[str, Any] | xr.Dataset | None = None,
    atmosphere: Atmosphere | str = "noon",
    spectra: Mapping[str, Any] | xr.Dataset | None = None,
    variation: npt.ArrayLike | BrokenClouds | None = None,
    truth: bool = True,
    clip: bool = False,
    hold_edges: bool = False,
    population: bool = True,
) -> xr.Dataset:
    r"""Return the radiance of a traced scene under an atmosphere in the bands of a camera.

    Parameters
    ----------
    traced
        Dataset from `hyperpaint.simulation.trace`, or read from its store.
    bands
        A `BandSet`, an imager of the simulator, or a Dataset with ``wavelength`` and ``fwhm`` (attribute
        ``srf_shape``); by default the 272 bands of a Nano-Hyperspec.
    paints
        New spectra by name of an instance ("car_007": its paint), of a material, or of a spectrum of the
        scene's materials, in this order of precedence. A value is the name of a spectrum, ``(wavelength
        [nm], reflectance)``, a DataArray with a coordinate ``wavelength``, or a function of wavelength [nm].
        Reflectances are near normal, without the specular component. A car traced with flakes gets the flake
        share of the named paint, and no flakes from a measured spectrum; a car traced without flakes gets
        none. A paint library instead of a mapping: its paints replace the spectrum, material or instance of
        their name, and the other paints are assigned in turn to the remaining cars.
    atmosphere
        The light; or the name of a preset one: "noon", "near_sunset", "cloudy".
    spectra
        Further spectra by name, as values of ``paints`` or as a paint library; they replace built-in spectra
        of the same name. A library of one paint as a value has its key as name; of several paints each is
        named ``key/paint``.
    variation
        Factors of direct and of diffuse light in every line, shape (2, along_track), for a cloud that passes
        during the flight; or `BrokenClouds`, whose shadows move over the scene. Light from neighbouring
        surfaces has the factors of the pixel that it reaches.
    truth
        Add ``reflectance`` and the layers with the shares of light by source.
    clip
        Limit reflectances to 0 to 1 instead of an error.
    hold_edges
        Hold tabulated spectra constant beyond their ends and their last bands with values, and interpolate
        bands without values, or not ``good``, linearly, instead of an error.
    population
        Show in every pixel a member of the population of its paint, if a library has
        ``member_reflectance``; False shows the mean.

    Returns
    -------
    Dataset
        Lazy; a flight line on which ``.paint.reflectance()`` runs. ``radiance`` (along_track, band,
        cross_track) at the sensor; the layers ``material``, ``instance``, ``surface_class``, ``paint_id``,
        ``car_id``, ``purity``, ``distance``, ``east``, ``north``, ``up``; ``irradiance`` as a spectrometer of
        3 nm beside the scene records it. With ``truth``: ``reflectance``, of the surfaces themselves, before
        the air between; ``sun_share``, ``sky_share``, ``glint_share``, ``mirrored_sky_share``,
        ``indirect_share`` of the mean radiance over all bands, before the air between; ``shadow``.

    Raises
    ------
    SchemaError
        The dataset is no traced one; the atmosphere's sun (to 0.01 degrees) or its overcast sky was not
        traced, or it does not cover the bands; names are unknown, spectra leave 0 to 1 or do not cover the
        bands; ``variation`` has another shape. All problems of a kind are listed.

    Warns
    -----
    PaintWarning
        Paints of a library exceed 0 to 1 by noise and are clipped; or a library contains the mirror
        reflection of coats, which the renderer adds again.

    Notes
    -----
    Of a band of response R,

    .. math:: L = e^{-k d} \sum_p w_p \frac{\int R E_{s(p)} \prod_f \rho'_f\, d\lambda}{\pi \int R\, d\lambda}
              + L_p d, \qquad \rho = \frac{\pi L_{d=0}}{\int R E\, d\lambda / \int R\, d\lambda}

    The integrals are exact to 1e-5 for all absorption lines of the light; they are computed once for every
    code. k and L_p are means over the band.

    A random field over the dominant surface of a pixel selects its member. The field varies over 20, 5 and
    1.25 cm, each with a third of the variance: pixels of any size have the spread of the members, and
    neighbours are similar. Light from other surfaces has their mean spectra. The mean over all members is
    the reflectance of the library. The member depends only on seed, position and instance.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.platforms import pushbroom
    >>> from hyperpaint.simulation.rendering.scene import plane
    >>> from hyperpaint.simulation.rendering.tracing import trace
    >>> traced = trace(plane(100.0), pushbroom(64, 8), ["noon"], samples=4)
    >>> line = relight(traced, atmosphere="noon")
    >>> line.radiance.dims, line.radiance.dtype, line.radiance.attrs["units"]
    (('along_track', 'band', 'cross_track'), dtype('float32'), 'W m-2 sr-1 nm-1')
    """
    record, settings = SceneRecord.from_attrs(traced.attrs)
    variables = require(traced, _PATHS, "radiance from traced paths")
    sky = preset_atmosphere(atmosphere) if isinstance(atmosphere, str) else atmosphere
    if not isinstance(sky, Atmosphere):
        raise SchemaError(
            f"atmosphere is {type(sky).__name__}",
            expected="an Atmosphere or the name of a preset",
            code="type-wrong",
        )
    camera = BandSet.of(bands)
    lines, columns = (variables["distance"].sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK))
    problems = Problems("the traced scene cannot be relit", SchemaError)
    min_nm = camera.wavelength[0] + camera.nodes.min() - _COVERED * camera.fwhm[0]
    max_nm = camera.wavelength[-1] + camera.nodes.max() + _COVERED * camera.fwhm[-1]
    first_nm, last_nm = sky.wavelength[[0, -1]]
    if first_nm > min_nm or last_nm < max_nm:
        problems.add(
            f"atmosphere {sky.name!r} covers {first_nm:.1f} to {last_nm:.1f} nm",
            expected=f"the range of the bands and their wings, {min_nm:.1f} to {max_nm:.1f} nm",
            code="atmosphere-coverage",
        )
    if camera.wavelength_shift is not None and camera.wavelength_shift.size != columns:
        problems.add(
            f"wavelength_shift has {camera.wavelength_shift.size} columns",
            expected=f"{columns}, as the traced scene",
            code="length-mismatch",
        )
    problems.raise_if_any()
    if variation is not None and not isinstance(variation, BrokenClouds):
        variation = np.ascontiguousarray(variation, np.float64)
        if variation.shape != (2, lines):
            raise SchemaError(
                f"variation has shape {variation.shape}",
                expected=f"(2, along_track) = (2, {lines})",
                code="dims-wrong",
            )
        if not np.isfinite(variation).all() or (variation < 0).any():
            raise SchemaError(
                "variation has factors that are negative or not finite", code="value-out-of-range"
            )
    painted = factor_spectra(record, camera, paints, spectra, clip=clip, hold_edges=hold_edges)
    sun = traced_sun(sky, settings)
    # light and camera are a node of the dask graph, shared by all tasks
    shared = (camera, record.codes(settings), sky, settings, painted(BandResponses(camera).grid))
    light = dask.delayed(make_lighting, pure=True)(*shared)
    populations = populations_of(record, painted, camera) if population else None
    cubes = _lazy_cubes(traced, light, camera, variation, populations, settings.seed, truth=truth)
    names = [""] * len(record.materials)  # spectra of the bases
    for factor, name in zip(record.factors, painted.names, strict=True):
        if not (factor.flakes or factor.through):
            names[factor.material] = name
    line = _dataset(cubes, traced, camera, record.labels(names)["paint_id"])
    if truth and "sun_visibility" in traced.variables:
        line["shadow"] = label(
            (1.0 - traced["sun_visibility"].isel({SUN: sun}, drop=True)).astype(np.float32), "shadow"
        )
    series = _irradiance_record(
        traced, sky, float(np.cos(np.radians(settings.suns[sun][0]))), camera, variation
    )
    attrs = {
        "hyperpaint_format": FORMAT_VERSION,
        "name": str(traced.attrs.get("name", record.name)),
        "atmosphere": sky.name,
        "materials": traced.attrs["materials"],
        "instances": traced.attrs["instances"],
        "srf_shape": camera.shape,
        **series.attrs,
    }
    return line.assign_coords(series.coords).assign(series.data_vars).assign_attrs(attrs)


def _whole_lines(array: xr.DataArray) -> da.Array:
    if array.chunks is None:
        array = array.chunk({ALONG_TRACK: CHUNK_LINES})
    split = [dim for dim in (SLOT, CROSS_TRACK) if len(array.variable.chunksizes.get(dim, (0,))) > 1]
    return cast("da.Array", array.chunk(dict.fromkeys(split, -1)).data if split else array.data)


_PIXEL_LAYERS = ("material", "instance", "east", "north", "up")


def _lazy_cubes(
    traced: xr.Dataset,
    light: Any,
    bands: BandSet,
    variation: Floats | BrokenClouds | None,
    populations: Populations | None,
    seed: int,
    *,
    truth: bool,
) -> dict[str, da.Array]:
    # lazy radiance, reflectance and shares; without truth a block of radiance is a single task
    weight, code, distance = (_whole_lines(traced[name]) for name in _PATHS)
    line_chunks = weight.chunks[0]
    varied: tuple[Any, Any] = (None, None)
    if isinstance(variation, BrokenClouds):
        east, north = (_whole_lines(traced[name]).rechunk({0: line_chunks}) for name in ("east", "north"))
        first = np.datetime64(traced.attrs["time_coverage_start"], "ns")
        seconds = da.asarray((traced["time"].data - first) / np.timedelta64(1, "s"))
        places = (east, "lx", north, "lx", seconds.rechunk((line_chunks,))[:, None], "lx")
        factors = da.blockwise(
            BrokenClouds.factors, "vlx", variation, None, *places, new_axes={"v": 2}, dtype=np.float64,
            meta=np.empty((0, 0, 0)),
        )  # fmt: skip
        varied = factors, "vlx"
    elif variation is not None:
        varied = da.from_array(variation, chunks=(-1, line_chunks)), "vl"
    lit = (weight, "lsx", code, "lsx", *varied)
    textured: tuple[Any, ...] = (*lit, None, None, None, None)
    if populations is not None:
        # population member of every pixel as row of a table, and the table
        layers = [_whole_lines(traced[name].reset_coords(drop=True)) for name in _PIXEL_LAYERS]
        inputs = [part for layer in layers for part in (layer, "lx")]
        options = {"grain": populations.grain, "seed": seed, "meta": np.empty((0, 0), np.int32)}
        rows = da.blockwise(member_rows, "lx", *inputs, **options, dtype=np.int32)
        textured = (*lit, rows, "lx", dask.delayed(populations, pure=True, traverse=False), None)

    def cube(method: Callable[..., Array], dims: str, *arguments: Any, **axes: int) -> da.Array:
        return da.blockwise(
            method, dims, light, None, *arguments, new_axes=axes, concatenate=True, dtype=np.float32,
            meta=np.empty((0, 0, 0), np.float32),
        )  # fmt: skip

    count = bands.wavelength.size
    if not truth:
        return {"radiance": cube(Lighting.radiance, "lbx", *textured, distance, "lx", b=count)}
    surface = cube(Lighting.surface_radiance, "lbx", *textured, b=count)
    shares = cube(Lighting.shares, "lcx", *lit, c=len(SHARES))
    return {
        "radiance": cube(Lighting.at_sensor, "lbx", surface, "lbx", distance, "lx"),
        "reflectance": cube(Lighting.reflectance, "lbx", surface, "lbx", *varied),
        **{name: shares[:, index] for index, name in enumerate(SHARES)},
    }


def _dataset(
    cubes: dict[str, da.Array], traced: xr.Dataset, bands: BandSet, paints: LabelTable
) -> xr.Dataset:
    variables = {
        name: (CUBE if array.ndim == 3 else (ALONG_TRACK, CROSS_TRACK), array, VARIABLES[name].attrs)
        for name, array in cubes.items()
    }
    coords: dict[str, Any] = {
        "wavelength": (BAND, bands.wavelength),
        "fwhm": (BAND, bands.fwhm),
        "good": (BAND, np.ones(bands.wavelength.size, bool)),
    }
    if bands.wavelength_shift is not None:
        coords["wavelength_shift"] = (CROSS_TRACK, bands.wavelength_shift)
    line = xr.Dataset(variables, {n: (*value, VARIABLES[n].attrs) for n, value in coords.items()})
    if "time" in traced.variables:
        line = line.assign_coords(time=traced["time"].variable)
    for name in _UNLIT_LAYERS:
        if name in traced.variables:
            line[name] = traced[name].variable
    if "material" in traced.variables:
        paint_id = xr.apply_ufunc(
            paints.table.__getitem__,
            traced["material"].reset_coords(drop=True),
            dask="parallelized",
            output_dtypes=[dtype_of("paint_id")],
            keep_attrs=True,
        )
        line["paint_id"] = label(paint_id, "paint_id", **paints.attrs)
    return line


def _irradiance_record(
    traced: xr.Dataset,
    atmosphere: Atmosphere,
    sun_cosine: float,
    bands: BandSet,
    variation: Floats | BrokenClouds | None,
) -> xr.Dataset:
    # ``irradiance`` and related variables of a spectrometer beside the scene, for the wavelengths of the
    # bands, from before until after the flight. With light that varies between lines, (2, line), the record
    # is lazy.
    # wavelengths of the channels [nm]
    wavelength, reach = atmosphere.wavelength, _REACH * _FWHM_NM
    min_nm = max(wavelength[0], bands.limits[0] - 4 * _FWHM_NM)
    max_nm = min(wavelength[-1], bands.limits[1] + 4 * _FWHM_NM)
    centres = np.arange(np.ceil(min_nm / _STEP_NM), np.floor(max_nm / _STEP_NM) + 1) * _STEP_NM
    # at the ends of the spectra a channel uses the available part of its line shape
    grid_start, grid_end = max(wavelength[0], centres[0] - reach), min(wavelength[-1], centres[-1] + reach)
    grid = (
        np.arange(np.ceil(grid_start / _GRID_STEP_NM), np.floor(grid_end / _GRID_STEP_NM) + 1) * _GRID_STEP_NM
    )
    # direct and diffuse irradiance, (2, channel)
    curves = np.stack(
        [cell_means(wavelength, curve, grid) for curve in ((atmosphere.sun * sun_cosine, atmosphere.sky))]
    )
    spectra = convolve_gaussian(curves, grid, centres, _FWHM_NM)
    # times before and after the flight; with varying light also times during the flight
    try:
        start, end = (np.datetime64(traced.attrs[f"time_coverage_{name}"], "ns") for name in ("start", "end"))
    except (KeyError, ValueError, TypeError) as error:
        raise SchemaError(
            f"not a traced dataset: time_coverage_start or _end: {error}",
            mend="pass a dataset from hyperpaint.simulation.trace",
            code="metadata-damaged",
        ) from error
    during = np.empty(0, "datetime64[ns]")
    lines = 0 if variation is None else traced.sizes[ALONG_TRACK]
    if lines:
        span = int(np.asarray(end - start, "timedelta64[ns]").astype(np.int64))
        steps = np.linspace(0, span, min(max(lines, 2), _MAX_TIMES)).astype(np.int64)
        during = start + np.unique(steps).astype("timedelta64[ns]")
    times = np.concatenate([[start - _MARGIN], during, [end + _MARGIN]]).astype("datetime64[ns]")
    values: Any = np.broadcast_to(spectra.sum(axis=0), (times.size, centres.size)).astype(np.float32)
    if isinstance(variation, BrokenClouds):
        seconds = (times - (times[0] + _MARGIN)) / np.timedelta64(1, "s")
        values = (variation.factors(*variation.station, seconds).T @ spectra).astype(np.float32)
    elif variation is not None:
        record = dask.delayed(_irradiance_at_times, pure=True)(traced["time"].data, times, variation, spectra)
        values = da.from_delayed(record, (times.size, centres.size), dtype=dtype_of("irradiance"))
    variables = {
        "irradiance": ((IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), values),
        "irradiance_fwhm": ((), np.float64(_FWHM_NM)),
        "irradiance_max_gap": ((), np.float64(2.5 * (np.diff(times).max() / np.timedelta64(1, "s")))),
        "irradiance_clock_uncertainty": ((), np.float64(0.0)),
        IRRADIANCE_TIME: (IRRADIANCE_TIME, times),
        IRRADIANCE_WAVELENGTH: (IRRADIANCE_WAVELENGTH, centres),
    }
    labelled = {name: (*value, VARIABLES[name].attrs) for name, value in variables.items()}
    coords = {name: labelled.pop(name) for name in (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH)}
    return xr.Dataset(labelled, coords, {"irradiance_srf_shape": "gaussian"})


def _irradiance_at_times(
    line_times: Any, times: Any, variation: Floats, spectra: Floats
) -> NDArray[np.float32]:
    line_ns = np.asarray(line_times).astype("datetime64[ns]").astype(np.int64)
    order = np.argsort(line_ns, kind="stable")
    relative_ns = times.astype(np.int64) - line_ns[order[0]]
    factors = np.stack(
        [np.interp(relative_ns, line_ns[order] - line_ns[order[0]], factor[order]) for factor in variation]
    )
    return (factors.T @ spectra).astype(np.float32)


def traced_sun(atmosphere: Atmosphere, settings: TraceSettings) -> int:
    """Return the number of the traced sun of an atmosphere; without direct light, of the nearest sun.

    Raises
    ------
    SchemaError
        The sun of the atmosphere, or its overcast or clear sky, was not traced.
    """
    towards = sun_vectors([(atmosphere.sun_zenith, atmosphere.sun_azimuth)])
    angles = np.degrees(
        2 * np.arcsin(np.linalg.norm(sun_vectors(settings.suns) - towards, axis=1).clip(0, 2) / 2)
    )
    nearest = int(angles.argmin())
    has_clear_sky = bool((atmosphere.sky * (atmosphere.molecular + atmosphere.aureole)).any())
    if angles[nearest] > _MAX_SUN_ANGLE_DEG and (atmosphere.sun.any() or has_clear_sky):
        traced_directions = ", ".join(f"({zenith:g}, {azimuth:g})" for zenith, azimuth in settings.suns)
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has its sun at (zenith, azimuth) = "
            f"({atmosphere.sun_zenith:g}, {atmosphere.sun_azimuth:g}) degrees",
            expected=f"a traced sun: {traced_directions}",
            mend="trace the scene with this sun as well",
            code="sun-not-traced",
        )
    if atmosphere.overcast_share > 0 and atmosphere.sky.any() and not settings.overcast:
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has an overcast share of {atmosphere.overcast_share:.3g}, "
            "but no overcast sky was traced",
            mend="trace the scene with overcast=True",
            code="sky-not-traced",
        )
    if has_clear_sky and not settings.clear:
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has a clear sky, but no clear sky was traced",
            mend="trace the scene with clear=True",
            code="sky-not-traced",
        )
    return nearest


def source_spectra(atmosphere: Atmosphere, settings: TraceSettings) -> dict[int, Floats]:
    # irradiance of every traced source that shines, by number, on the atmosphere's grid
    sun = traced_sun(atmosphere, settings)
    first_function = FIRST_CLEAR_SKY + CLEAR_SKY_FUNCTIONS * sun
    shares = {
        SKY: atmosphere.uniform,
        OVERCAST_SKY: np.asarray(atmosphere.overcast_share),
        first_function: atmosphere.molecular,
        first_function + 1: atmosphere.aureole,
    }
    skies = {number: atmosphere.sky * share for number, share in shares.items() if share.any()}
    return {**skies, FIRST_SUN + sun: atmosphere.sun}


# Light and camera, shared by all tasks of a relighting
@dataclass(frozen=True, eq=False)
class Lighting:
    table: ProductTable  # products of paths
    # direct, diffuse: (band, cross_track or 1): irradiance of a level surface in the bands [W m-2 nm-1]
    direct: Floats
    diffuse: Floats
    # extinction, path_radiance: (band, cross_track or 1), float32: properties of the air before the camera
    # [m-1], [W m-2 sr-1 nm-1 m-1]
    extinction: Floats32
    path_radiance: Floats32

    def surface_radiance(
        self,
        weight: Floats32,
        code: Array,
        variation: Floats | None,
        rows: Array | None = None,
        populations: Populations | None = None,
    ) -> Floats32:
        # radiance at the surface towards the camera, (line, band, column) [W m-2 sr-1 nm-1]
        # weight, code : (line, slot, column): paths as traced
        # variation : (2, line) or (2, line, column): factors of direct and diffuse light; None for factors of
        # 1
        # rows : (line, column): members of ``populations`` shown by pixels
        # populations: None for the means
        lines, _, columns = weight.shape
        radiance = np.empty((lines, self.table.bands.wavelength.size, columns), np.float32)
        texture = None if populations is None or rows is None else populations.of_rows(rows)
        self.table.mix(_varied(weight, code, variation), code, radiance, texture)
        return radiance

    def radiance(
        self,
        weight: Floats32,
        code: Array,
        variation: Floats | None,
        rows: Array | None,
        populations: Populations | None,
        distance: Floats32,
    ) -> Floats32:
        surface = self.surface_radiance(weight, code, variation, rows, populations)
        return self.at_sensor(surface, distance, in_place=True)

    def at_sensor(self, surface: Floats32, distance: Floats32, *, in_place: bool = False) -> Floats32:
        # L exp(-k d) + Lp d, the radiance after a distance d of air; NaN distances have no air
        if not (self.extinction.any() or self.path_radiance.any()):
            return surface
        out = surface if in_place else np.empty_like(surface)
        through_air(surface, self.extinction, self.path_radiance, distance, out)
        return out

    def reflectance(self, surface: Floats32, variation: Floats | None) -> Floats32:
        # pi L / E of the radiance at the surface [1]; NaN without light
        factor = np.empty_like(surface)
        for line, (direct, diffuse) in enumerate(
            zip(*(np.ones((2, len(surface))) if variation is None else variation), strict=True)
        ):
            light = self.direct * direct + self.diffuse * diffuse
            scale = np.divide(np.pi, light, out=np.full_like(light, np.nan), where=light > 0)
            np.multiply(surface[line], scale.astype(np.float32), out=factor[line])
        return factor

    def shares(self, weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
        # shares of light by source, (line, share, column); see `SHARES`
        distinct, index = index_paths(code)
        node = int(np.abs(self.table.bands.nodes).argmin())
        level = self.table.rows(distinct)[node].mean(axis=1, dtype=np.float64)
        # weight of every path in the total light, and in the layers of `SHARES`
        sun, mirrored, indirect = is_direct(distinct), is_mirrored(distinct), is_indirect(distinct)
        mirror_image = mirrored & ~indirect
        all_paths = np.ones(distinct.shape, bool)
        members = [all_paths, sun, ~sun, mirror_image & sun, mirror_image & ~sun, indirect]
        terms = np.stack(
            [np.where(is_member, level.astype(np.float32), 0.0) for is_member in members], axis=1
        )
        sums = np.empty((len(weight), terms.shape[1], weight.shape[2]), np.float32)
        mix(_varied(weight, code, variation), index, terms.astype(np.float32), sums)
        total = sums[:, :1]
        return np.divide(sums[:, 1:], total, out=np.full_like(sums[:, 1:], np.nan), where=total > 0)


def _varied(weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
    if variation is None:
        return weight
    return np.asarray(
        weight * np.where(is_direct(code), *variation.astype(np.float32).reshape(2, len(weight), 1, -1))
    )


def make_lighting(
    bands: BandSet, codes: PathCodes, atmosphere: Atmosphere, settings: TraceSettings, factors: Floats
) -> Lighting:
    # light, spectra and camera of a relighting.
    # ``factors`` (factor, grid): spectra of all factors of paths, on the grid of `BandResponses`.
    wavelength, sources = atmosphere.wavelength, source_spectra(atmosphere, settings)
    sun_cosine = float(np.cos(np.radians(settings.suns[traced_sun(atmosphere, settings)][0])))
    table = ProductTable(bands, codes, wavelength, sources, lambda _grid: factors)
    responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])))
    curves = atmosphere.extinction, atmosphere.path_radiance
    air = np.stack([cell_means(wavelength, curve, responses.fine) for curve in curves])
    extinction, path = table.to_columns(responses.means(air)).astype(np.float32)
    light = {number: table.to_columns(table.irradiance(number)) for number in sources}
    suns = [number for number in light if is_direct(np.array(number))]
    direct = sum((light[number] for number in suns), np.zeros(1)) * sun_cosine
    diffuse = sum((light[number] for number in light if number not in suns), np.zeros(1))
    return Lighting(table, np.asarray(direct), np.asarray(diffuse), extinction, path)


class ProductTable:
    """Band spectra of path codes, computed when first needed.

    Products are means over the responses [W m-2 sr-1 nm-1]. With ``normalise=False`` they are integrals INT L
    R d lambda [W m-2 sr-1 count J-1] for a detector; the caller multiplies the sum over paths by the element
    factors (`Imager.element_factor`) to get the input of `simulation.camera.expected_counts`.

    Threads share a table. It can be sent to other processes, where it starts empty. Products do not depend on
    earlier or simultaneous requests.

    Parameters
    ----------
    bands
        Bands of the camera.
    codes
        Layout of the path codes.
    wavelength : (point,)
        Wavelengths of the sources, increasing [nm]; responses are cut to this range.
    sources
        Irradiance by number of the source, shape (point,) [W m-2 nm-1]: direct normal for a sun, diffuse on a
        level surface for a sky. Missing sources are dark.
    factors
        Function that returns all factors at wavelengths [nm], shape (factor, wavelength); see
        `hyperpaint.simulation.rendering.painting.factor_spectra`.
    normalise
        See `BandResponses`.

    Examples
    --------
    A grey panel of reflectance 0.4 under a sun of 1.3 W m-2 nm-1; its path has source 2 and factor 0.

    >>> light = np.array([300.0, 1100.0]), {2: np.array([1.3, 1.3])}
    >>> codes, bands = PathCodes.of(factors=1, depth=4), BandSet.nano_hyperspec()
    >>> table = ProductTable(bands, codes, *light, lambda grid: np.full((1, grid.size), 0.4))
    >>> rows = table.rows(np.array([2 + (1 << 7)]))
    >>> rows.shape, rows.dtype, round(float(rows[0, 0, 0]), 6)  # (node, path, band), 0.4 x 1.3 / pi
    ((1, 1, 272), dtype('float32'), 0.165521)
    """

    def __init__(
        self,
        bands: BandSet,
        codes: PathCodes,
        wavelength: Floats,
        sources: Mapping[int, Floats],
        factors: Callable[[Floats], Floats],
        *,
        normalise: bool = True,
    ) -> None:
        self.bands, self.codes = bands, codes
        responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])), normalise=normalise)
        means = {
            number: cell_means(wavelength, np.asarray(spectrum, np.float64), responses.fine)
            for number, spectrum in sources.items()
        }
        lit = {number: spectrum for number, spectrum in means.items() if spectrum.any()}
        self._row_of_source = np.full(SOURCES, -1, np.int64)
        self._row_of_source[list(lit)] = np.arange(len(lit))
        spectra = np.stack([*lit.values()]) if lit else np.zeros((1, responses.fine.size))
        self._weights = responses.weights(spectra) / np.pi
        self._first_band = responses.first_band
        self._factors = np.ascontiguousarray(factors(responses.grid), np.float64)
        self._start_empty()

    def _start_empty(self) -> None:
        nodes, bands = self.bands.nodes.size, self.bands.wavelength.size
        self._cached_codes: Ints = np.empty(0, np.int64)
        self._products = np.empty((0, nodes, bands), np.float32)
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        excluded = {"_cached_codes", "_products", "_lock"}
        return {name: value for name, value in self.__dict__.items() if name not in excluded}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start_empty()

    def rows(self, codes: Ints) -> NDArray[np.float32]:
        """Return the products of paths, shape (node, path, band), float32.

        Parameters
        ----------
        codes : (path,)
            Distinct codes, without empty slots.

        Raises
        ------
        SchemaError
            A code names a factor that the scene does not have.
        """
        codes = np.ascontiguousarray(codes, np.int64)
        with self._lock:
            cached_codes, products = self._cached_codes, self._products
        rows = _lookup(cached_codes, codes)
        is_new = rows < 0
        if not is_new.any():
            return np.ascontiguousarray(products[rows].swapaxes(0, 1))
        # products of codes that are not cached
        new_codes = codes[is_new]
        computed = np.empty((self.bands.nodes.size, new_codes.size, self.bands.wavelength.size), np.float32)
        chosen, source = self.codes.factors(new_codes), self._row_of_source[source_of(new_codes)]
        if chosen.max(initial=-1) >= len(self._factors):
            raise SchemaError(
                f"a path code names spectrum {chosen.max()}",
                expected=f"a number below {len(self._factors)}, the spectra of the scene",
                mend="trace the scene again: transport_path is damaged, or belongs to another scene",
                code="path-code-unknown",
            )
        integrate_bands(self._factors, chosen, source, self._weights, self._first_band, computed)
        new_products = computed.swapaxes(0, 1)
        gathered = np.empty((codes.size, *new_products.shape[1:]), np.float32)
        gathered[~is_new], gathered[is_new] = products[rows[~is_new]], new_products
        with self._lock:
            if self._products.nbytes + new_products.nbytes <= _MAX_CACHE_BYTES:
                added = _lookup(self._cached_codes, new_codes) < 0  # another thread may have added some
                all_codes = np.concatenate([self._cached_codes, new_codes[added]])
                order = np.argsort(all_codes)
                self._cached_codes = all_codes[order]
                self._products = np.concatenate([self._products, new_products[added]])[order]
        return np.ascontiguousarray(gathered.swapaxes(0, 1))

    def to_columns(self, at_nodes: Floats) -> Floats:
        # interpolate values at nodes (..., node, band) to columns, (..., band, cross_track)
        if self.bands.wavelength_shift is None:
            return np.moveaxis(at_nodes, -2, -1)
        first, weight = self.bands.between_nodes()
        at_columns = sum(at_nodes[..., first + j, :] * weight[:, j, None] for j in range(4))
        return np.moveaxis(np.asarray(at_columns), -2, -1)

    def mix(
        self,
        weight: NDArray[np.float32],
        codes: Ints,
        out: NDArray[np.float32],
        texture: Texture | None = None,
    ) -> None:
        # write the sum of weight x product over the paths of every pixel, with the smile of the columns
        # weight, codes : (line, slot, column): paths as traced; empty slots add nothing
        # out : (line, band, column): result, in the units of the table
        # texture: members of populations shown by pixels; None for the means
        distinct, index = index_paths(codes)
        lit = self._row_of_source[source_of(distinct)] >= 0
        if not lit.all():  # skip paths from dark sources
            new_index = np.append(np.where(lit, np.cumsum(lit) - 1, -1), -1).astype(np.int32)
            distinct, index = distinct[lit], new_index[index]
        products = self.rows(distinct)
        columns = out.shape[2]
        nodes = np.zeros(columns, np.int64), np.ones((columns, 1))
        if self.bands.wavelength_shift is not None:
            nodes = self.bands.between_nodes()
        if texture is not None:
            texture = texture._replace(paths=self.codes.factors(distinct))
        mix_shifted(weight, index, products, *nodes, out, texture)

    def irradiance(self, source: int) -> Floats:
        # Irradiance of a source in the bands, shape (node, band).
        return np.pi * self.rows(np.array([source], np.int64))[:, 0].astype(np.float64)


def _lookup(sorted_codes: Ints, codes: Ints) -> Ints:
    # -1 for codes that are not in the array.
    if not sorted_codes.size:
        return np.full(codes.shape, -1, np.int64)
    index = np.searchsorted(sorted_codes, codes).clip(max=sorted_codes.size - 1)
    return np.where(sorted_codes[index] == codes, index, -1)
