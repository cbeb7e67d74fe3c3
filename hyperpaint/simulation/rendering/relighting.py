"""From traced weights to radiance, for any paints, atmosphere and camera, without tracing again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import dask
import dask.array as da
import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array, Floats
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
from hyperpaint.simulation.camera import convolve_gaussian

from .camera_bands import BandResponses, BandSet, cell_means
from .four_curves import Atmosphere, preset_atmosphere
from .lighting import SHARES, Lighting, make_lighting, traced_sun
from .painting import FactorSpectra, Populations, factor_spectra, populations_of, rows_of_pixels
from .scene_record import LabelTables, SceneRecord
from .sky_models import BrokenClouds

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
    r"""Return the radiance of a traced scene under an atmosphere, as a camera's bands see it.

    Parameters
    ----------
    traced
        From `hyperpaint.simulation.trace`, or the store it was written to.
    bands
        A `BandSet`, an imager of the simulator, or a Dataset with ``wavelength`` and ``fwhm`` (attribute
        ``srf_shape``); by default the 272 bands of a Nano-Hyperspec.
    paints
        New spectra by name of an instance ("car_007": its paint), of a material, or of a spectrum that
        materials of the scene have; the first counts most. A value is the name of a spectrum, ``(wavelength
        [nm], reflectance)``, a DataArray with a coordinate ``wavelength``, or a function of wavelength [nm].
        Reflectances are near normal, without the specular component. A car that was traced with flakes gets
        as many as the named paint has, and none from a measured spectrum; one traced without stays so. A
        paint library instead of a mapping: its paints go where a spectrum, material or instance has their
        name, the others in turn to the cars that are left.
    atmosphere
        The light; or the name of a preset one: "noon", "near_sunset", "cloudy".
    spectra
        Further spectra by name, as values of ``paints`` or as a paint library; they go before the built-in
        ones of the same name. A library as a value: of one paint it is that name's spectrum, of several each
        is ``name/paint``.
    variation
        Factors of direct and of diffuse light in every line, shape (2, along_track), such as a cloud's that
        passes while the camera flies; or `BrokenClouds`, whose shadows move over the scene. Light that
        reaches a pixel by way of other surfaces varies with that pixel's.
    truth
        Add ``reflectance`` and the layers that say where light came from.
    clip
        Limit reflectances to 0 to 1 where they would be an error.
    hold_edges
        Hold tabulated spectra constant beyond their ends and their last bands with values, and bridge bands
        without values, or not ``good``, by straight lines; they are an error otherwise.
    population
        Let every pixel show a member of the population of its paint, where a library has
        ``member_reflectance``; False shows the centre alone.

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
        Noise takes paints of a library a little beyond 0 to 1, where they are cut; or a library says that it
        holds the light that coats mirror, which the renderer adds once more.

    Notes
    -----
    Of a band of response R,

    .. math:: L = e^{-k d} \sum_p w_p \frac{\int R E_{s(p)} \prod_f \rho'_f\, d\lambda}{\pi \int R\, d\lambda}
              + L_p d, \qquad \rho = \frac{\pi L_{d=0}}{\int R E\, d\lambda / \int R\, d\lambda}

    The integrals are exact to 1e-5 whatever lines the light has; they are made once for every code. k and
    L_p are means over the band.

    A pixel draws its member by a random field over the surface that it shows most of, which varies over
    20, 5 and 1.25 cm, a third of the variance each: a pixel has the spread of the members whatever its size,
    and neighbours in between are alike. Light that other surfaces throw on it has their means. The mean over
    all members is the reflectance of the library. Seed, position and instance alone choose the member.

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
    _check(camera, sky, columns)
    factors = None if isinstance(variation, BrokenClouds) else _variation(variation, lines)
    painted = factor_spectra(record, camera, paints, spectra, clip=clip, hold_edges=hold_edges)
    sun = traced_sun(sky, settings)
    cosine = float(np.cos(np.radians(settings.suns[sun][0])))
    # light and camera are a node of the dask graph, shared by all tasks
    shared = (camera, record.codes(settings), sky, settings, painted(BandResponses(camera).grid))
    light = dask.delayed(make_lighting, pure=True)(*shared)
    paths = [_whole_lines(variables[name]) for name in _PATHS]
    texture = _texture(traced, record, painted, camera, settings.seed) if population else None
    varied: Any = (
        _cloud_factors(traced, variation, paths[0].chunks[0])
        if isinstance(variation, BrokenClouds)
        else factors
    )
    cubes = _lazy_cubes(paths, light, varied, camera, texture, truth=truth)
    names = [""] * len(record.materials)  # spectra of the bases
    for factor, name in zip(record.factors, painted.names, strict=True):
        if not (factor.flakes or factor.through):
            names[factor.material] = name
    line = _dataset(cubes, traced, camera, LabelTables.of(record, names))
    if truth and "sun_visibility" in traced.variables:
        visible = traced["sun_visibility"].isel({SUN: sun}, drop=True)
        line["shadow"] = label((1.0 - visible).astype(np.float32), "shadow")
    series = _irradiance_record(
        traced, sky, cosine, camera, variation if isinstance(variation, BrokenClouds) else factors
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


def _check(bands: BandSet, atmosphere: Atmosphere, columns: int) -> None:
    problems = Problems("the traced scene cannot be relit", SchemaError)
    min_nm = bands.wavelength[0] + bands.nodes.min() - _COVERED * bands.fwhm[0]
    max_nm = bands.wavelength[-1] + bands.nodes.max() + _COVERED * bands.fwhm[-1]
    first_nm, last_nm = atmosphere.wavelength[[0, -1]]
    if first_nm > min_nm or last_nm < max_nm:
        problems.add(
            f"atmosphere {atmosphere.name!r} covers {first_nm:.1f} to {last_nm:.1f} nm",
            expected=f"the range of the bands and their wings, {min_nm:.1f} to {max_nm:.1f} nm",
            code="atmosphere-coverage",
        )
    if bands.wavelength_shift is not None and bands.wavelength_shift.size != columns:
        problems.add(
            f"wavelength_shift has {bands.wavelength_shift.size} columns",
            expected=f"{columns}, as the traced scene",
            code="length-mismatch",
        )
    problems.raise_if_any()


def _variation(variation: npt.ArrayLike | None, lines: int) -> Floats | None:
    if variation is None:
        return None
    factors = np.asarray(variation, np.float64)
    if factors.shape != (2, lines):
        raise SchemaError(
            f"variation has shape {factors.shape}",
            expected=f"(2, along_track) = (2, {lines})",
            code="dims-wrong",
        )
    if not np.isfinite(factors).all() or (factors < 0).any():
        raise SchemaError("variation has factors that are negative or not finite", code="value-out-of-range")
    return np.ascontiguousarray(factors.T)


def _cloud_factors(traced: xr.Dataset, clouds: BrokenClouds, chunks: tuple[int, ...]) -> da.Array:
    places = [_whole_lines(traced[name]).rechunk({0: chunks}) for name in ("east", "north")]
    first = np.datetime64(traced.attrs["time_coverage_start"], "ns")
    return da.blockwise(
        _factors_task,
        "lvx",
        clouds,
        None,
        places[0],
        "lx",
        places[1],
        "lx",
        da.asarray((traced["time"].data - first) / np.timedelta64(1, "s")).rechunk((chunks,)),
        "l",
        new_axes={"v": 2},
        dtype=np.float64,
        meta=np.empty((0, 2, places[0].shape[1])),
    )


def _factors_task(clouds: BrokenClouds, east: Array, north: Array, seconds: Array) -> Array:
    return np.moveaxis(clouds.factors(east, north, seconds[:, None]), 0, 1)


def _whole_lines(array: xr.DataArray) -> da.Array:
    if array.chunks is None:
        array = array.chunk({ALONG_TRACK: CHUNK_LINES})
    split = [dim for dim in (SLOT, CROSS_TRACK) if len(array.variable.chunksizes.get(dim, (0,))) > 1]
    return cast("da.Array", array.chunk(dict.fromkeys(split, -1)).data if split else array.data)


_PIXEL_LAYERS = ("material", "instance", "east", "north", "up")


def _texture(
    traced: xr.Dataset, record: SceneRecord, painted: FactorSpectra, bands: BandSet, seed: int
) -> tuple[Any, Any] | None:
    # population member of every pixel (lazy, as row of a table), and the table
    populations = populations_of(record, painted, bands)
    if populations is None:
        return None
    layers = [_whole_lines(traced[name].reset_coords(drop=True)) for name in _PIXEL_LAYERS]
    inputs = [part for layer in layers for part in (layer, "lx")]
    shared = {"grain": populations.grain, "seed": seed}
    rows = da.blockwise(
        rows_of_pixels, "lx", *inputs, **shared, dtype=np.int32, meta=np.empty((0, 0), np.int32)
    )
    return rows, dask.delayed(populations, pure=True, traverse=False)


def _lazy_cubes(
    paths: list[da.Array],
    light: Any,
    variation: Any,
    bands: BandSet,
    texture: tuple[Any, Any] | None,
    *,
    truth: bool,
) -> dict[str, da.Array]:
    # lazy radiance, reflectance and shares; without truth a block of radiance is a single task
    weight, code, distance = paths
    varied: tuple[Any, Any] = (None, None)
    if isinstance(variation, da.Array):
        varied = variation, "lvx"
    elif variation is not None:
        varied = da.from_array(variation, chunks=(weight.chunks[0], -1)), "lv"
    traced = (weight, "lsx", code, "lsx", *varied)
    rows, populations = (None, None) if texture is None else texture
    textured = (*traced, rows, None if rows is None else "lx", populations, None)
    size = {"b": bands.wavelength.size}
    cube = {"dtype": np.float32, "meta": np.empty((0, 0, 0), np.float32)}
    if not truth:
        radiance_arguments = (light, None, *textured, distance, "lx")
        return {"radiance": da.blockwise(_radiance_task, "lbx", *radiance_arguments, new_axes=size, **cube)}
    surface = da.blockwise(_surface_task, "lbx", light, None, *textured, new_axes=size, **cube)
    air_arguments = (light, None, surface, "lbx", distance, "lx")
    shares = da.blockwise(_shares_task, "lcx", light, None, *traced, new_axes={"c": len(SHARES)}, **cube)
    return {
        "radiance": da.blockwise(Lighting.at_sensor, "lbx", *air_arguments, **cube),
        "reflectance": da.blockwise(_reflectance_task, "lbx", light, None, surface, "lbx", *varied, **cube),
        **{name: shares[:, index] for index, name in enumerate(SHARES)},
    }


def _single_block(nested: Any) -> Any:
    # dask passes the only block of a dim with one block as nested lists
    while isinstance(nested, list):
        (nested,) = nested
    return nested


def _surface_task(
    light: Lighting, weight: Any, code: Any, variation: Any, rows: Any, populations: Populations | None
) -> Array:
    texture = None if populations is None else populations.of_rows(_single_block(rows))
    return light.surface_radiance(
        _single_block(weight), _single_block(code), _single_block(variation), texture
    )


def _radiance_task(
    light: Lighting,
    weight: Any,
    code: Any,
    variation: Any,
    rows: Any,
    populations: Populations | None,
    distance: Array,
) -> Array:
    surface = _surface_task(light, weight, code, variation, rows, populations)
    return light.at_sensor(surface, distance, in_place=True)


def _reflectance_task(light: Lighting, surface: Array, variation: Any) -> Array:
    return light.reflectance(surface, _single_block(variation))


def _shares_task(light: Lighting, weight: Any, code: Any, variation: Any) -> Array:
    return light.shares(_single_block(weight), _single_block(code), _single_block(variation))


def _dataset(
    cubes: dict[str, da.Array], traced: xr.Dataset, bands: BandSet, tables: LabelTables
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
            tables.paint_id.__getitem__,
            traced["material"].reset_coords(drop=True),
            dask="parallelized",
            output_dtypes=[dtype_of("paint_id")],
            keep_attrs=True,
        )
        line["paint_id"] = label(paint_id, "paint_id", **tables.attrs("paint_id"))
    return line


_FWHM_NM, _STEP_NM = 3.0, 1.0  # of the irradiance spectrometer
_GRID_STEP_NM = 0.05
_REACH = 3.3  # extent of its line shape [full widths]
_MARGIN = np.timedelta64(10**9, "ns")  # record before the first and after the last line
_MAX_TIMES = 2000


def _irradiance_record(
    traced: xr.Dataset,
    atmosphere: Atmosphere,
    sun_cosine: float,
    bands: BandSet,
    variation: Floats | BrokenClouds | None,
) -> xr.Dataset:
    # ``irradiance`` and related variables of a spectrometer beside the scene, for the wavelengths of the
    # bands, from before until after the flight. With light that varies between lines, (line, 2), the record
    # is lazy.
    centres, spectra = _spectra(atmosphere, sun_cosine, bands)
    times = _sample_times(traced, 0 if variation is None else traced.sizes[ALONG_TRACK])
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


def _spectra(atmosphere: Atmosphere, sun_cosine: float, bands: BandSet) -> tuple[Floats, Floats]:
    # wavelengths of the channels [nm], and their direct and diffuse irradiance, (2, channel)
    wavelength = atmosphere.wavelength
    reach = _REACH * _FWHM_NM
    min_nm = max(wavelength[0], bands.lowest() - 4 * _FWHM_NM)
    max_nm = min(wavelength[-1], bands.highest() + 4 * _FWHM_NM)
    centres = np.arange(np.ceil(min_nm / _STEP_NM), np.floor(max_nm / _STEP_NM) + 1) * _STEP_NM
    # at the ends of the spectra a channel uses the available part of its line shape
    grid_start, grid_end = max(wavelength[0], centres[0] - reach), min(wavelength[-1], centres[-1] + reach)
    grid = (
        np.arange(np.ceil(grid_start / _GRID_STEP_NM), np.floor(grid_end / _GRID_STEP_NM) + 1) * _GRID_STEP_NM
    )
    level = (atmosphere.sun * sun_cosine, atmosphere.sky)
    curves = np.stack([cell_means(wavelength, curve, grid) for curve in level])
    return centres, convolve_gaussian(curves, grid, centres, _FWHM_NM)


def _sample_times(traced: xr.Dataset, lines: int) -> NDArray[np.datetime64]:
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
    if lines:
        span = int(np.asarray(end - start, "timedelta64[ns]").astype(np.int64))
        steps = np.linspace(0, span, min(max(lines, 2), _MAX_TIMES)).astype(np.int64)
        during = start + np.unique(steps).astype("timedelta64[ns]")
    return np.concatenate([[start - _MARGIN], during, [end + _MARGIN]]).astype("datetime64[ns]")


def _irradiance_at_times(
    line_times: Any, times: Any, variation: Floats, spectra: Floats
) -> NDArray[np.float32]:
    line_ns = np.asarray(line_times).astype("datetime64[ns]").astype(np.int64)
    order = np.argsort(line_ns, kind="stable")
    relative_ns = times.astype(np.int64) - line_ns[order[0]]
    factors = np.stack(
        [np.interp(relative_ns, line_ns[order] - line_ns[order[0]], factor[order]) for factor in variation.T]
    )
    return (factors.T @ spectra).astype(np.float32)
