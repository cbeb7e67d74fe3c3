"""Counts to radiance to reflectance.

    L   = radiance_gain (counts - dark) / exposure_time
    rho = pi L / E

Both are lazy: one task a slab of lines, one pass over memory.

Reflectance relative to a white tile: for cubes without calibration, navigation and irradiance record.

    rho = rho_tile (C - D) / (W - D_W) (t_W / t)        for every band and column

A white reference is a gain per detector element, ``reflectance_gain``, in place of calibration and
irradiance; several white references in time add the change of the light, ``white_level``.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    Bools,
    Floats,
    Problems,
    SchemaError,
    dtype_of,
    flags_set_from,
    good_bands,
    label,
    refuse_other_labels,
    rename_to_roles,
    require,
    shown,
    takes_quantities,
    warn_if,
    warn_user,
)
from hyperpaint.io.flightline.flightline_opening import (
    MIN_NOISE_LINES,
    Reference,
    Timing,
    check_shape,
    open_dark,
    own_dark,
    read_reference,
    utc_of,
)
from hyperpaint.io.flightline.side_files import find_exposure, recording_clock, saturation_of
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
from hyperpaint.io.spectrometers.spectrum_texts import find_paths
from hyperpaint.io.store import is_zarr, open_unverified
from hyperpaint.light.illumination import UNSTABLE_CHANGE, Tilt, replace_record

from . import slabs
from .darks import SAME_EXPOSURE_SHARE, darks_of_lines
from .panels import (
    CLOSURE,
    LAMBERTIAN,
    Panel,
    closure_variables,
    declared_panels,
    declared_scale,
    is_lambertian,
    panel_factor,
    panel_inputs,
    several_panels,
    without_panels,
)
from .planning import (
    COUNTED,
    cube_inputs,
    has_white,
    lazy_plan,
    make_plan,
    plan_inputs,
    refuse_calibration,
)
from .stray_light import OF_ELEMENTS, STRAY_SOURCES, TABLE, Linearity, described
from .uncertainty import UNCERTAINTIES, with_uncertainty

TILE = SimpleNamespace(
    #: Share of saturated elements [1] above which a white reference is refused; fewer become bad elements.
    max_saturated_share=0.01,
    #: Light of an element over its standard uncertainty, below which the element is bad.
    min_significance=3.0,
    #: Share of elements with light [1] below which a white reference is refused.
    min_lit_share=0.5,
    #: Relative deviation of lines of a white reference from their median [1].
    max_line_deviation=0.05,
    #: Share of lines that may deviate by more [1]: beyond, the cube shows more than the tile.
    max_deviating_line_share=0.02,
    #: Difference between the wavelengths of the headers of white and scene that is refused [nm].
    max_wavelength_difference_nm=0.5,
    #: Change of the light between two white references that differs between columns [1], above which tile or
    #: lamp have moved.
    max_column_change=0.02,
)

#: Variables of a white reference.
WHITE_VARIABLES = (
    "reflectance_gain",
    "reflectance_gain_u_random",
    "reflectance_gain_u_systematic",
    "white_level",
    "white_time",
)
#: Attributes of a line that name its white references, and the reflectance of the tile.
WHITE_ATTRS = ("white_source", "white_tile")
_DARK_VARIABLES = ("dark_counts", "dark_time", "dark_exposure_time")


@takes_quantities(exposure_time="s", white_exposure_time="s")
def white_reference(
    dataset: xr.Dataset,
    white: Any,
    *,
    tile: Any = None,
    tile_uncertainty: float | None = None,
    dark: Any = None,
    white_dark: Any = None,
    exposure_time: float | Sequence[float] | None = None,
    white_exposure_time: float | None = None,
    bit_depth: int = 12,
    tile_surface: Any = LAMBERTIAN,
    light_zenith: float | None = None,
    direct_share: float = 1.0,
) -> xr.Dataset:
    r"""Calibrate raw counts by a white tile, so that ``reflectance()`` needs nothing else.

    The cubes of white and dark are read at once, in blocks of lines; the counts of the line stay lazy.

    Parameters
    ----------
    dataset
        Raw ``counts`` (along_track, band, cross_track): a cube from ``xr.open_dataset("scene.hdr")``, or a
        flight line, whose dark and exposure are then used.
    white
        Cube of the tile: the path of its ENVI header or a Zarr, a Dataset with ``counts``, or a DataArray of
        counts; several of them, or a pattern such as ``"WHITEREF_*.hdr"``, for light that changes. Between
        two white references the light is linear in time, band by band; before the first and after the last it
        is constant, with a warning.
    tile
        Reflectance factor of the tile: a number [1] such as 0.95, the file of its certificate, or a DataArray
        with a coordinate ``wavelength``. There is no default: 1.0 gives reflectance relative to the tile.
    tile_uncertainty
        Relative standard uncertainty of ``tile`` [1]. Without it the systematic uncertainty does not contain
        the tile.
    dark
        Dark of the scene: a path, several, a Dataset, or ``"none"``, as in `hyperpaint.open_flightline`.
    white_dark
        Dark of the white; by default that of the scene, which must have the exposure of the white, or two
        exposures, for bias and rate.
    exposure_time, white_exposure_time
        Exposures of scene and white [s], where their files do not state them.
    bit_depth
        Bits of the converter, for the count at which an element is saturated, where the dataset has no
        ``saturation_count``.
    tile_surface
        Surface of the tile, for its reflectance by direction, seen from the nadir: ``lambertian``,
        ``sintered-ptfe``, or a table of its factors or its file, see `hyperpaint.radiometry.panel_factor`.
    light_zenith
        Zenith angle of the lamps or the sun over the tile [degree]; for surfaces other than ``lambertian``.
    direct_share
        Their light over all light on the tile [1].

    Returns
    -------
    Dataset
        The line with ``reflectance_gain`` (band, cross_track) [s count-1], NaN for elements that are
        saturated or without light on the tile, its uncertainties ``reflectance_gain_u_random`` and
        ``reflectance_gain_u_systematic`` [1], with several white references ``white_level`` (white_time,
        band) [1]; and, where they are missing, dark, exposure, saturation, noise, and from a Specim header
        ``time``.

    Raises
    ------
    SchemaError, FormatError
        ``tile`` or a dark is missing; an exposure is unknown, or the dark has another exposure; the white is
        saturated, without light, not the same in all lines, of another camera, binning or wavelengths; the
        dataset has corrections of a calibration, such as ``linearity``; or white references of unknown times
        differ; or the surface of the tile is declared without ``light_zenith``. All problems of the white are
        listed.

    Warns
    -----
    PaintWarning
        Elements are saturated on the tile; lines lie before or after all white references; the light changes
        differently between columns; or a certificate does not cover all bands.

    Notes
    -----
    .. math:: \rho = \rho_{tile}\,\frac{C - D}{W - D_W}\,\frac{t_W}{t}

    with the means :math:`W` and :math:`D_W` of the lines of the white and of its dark. It is valid where
    scene and tile lie in the same light: at the same distance from the lamps. Where the dataset has no
    ``electrons_per_count``, it follows from the noise of the white.

    Examples
    --------
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> raw = worked_example()[["counts", "dark_counts", "exposure_time", "saturation_count"]]
    >>> raw["counts"] = raw.counts.astype("uint16")
    >>> line = white_reference(raw, raw, tile=0.95)  # the scene is the tile
    >>> line.paint.reflectance().reflectance.values.round(4)[0, 0]
    array([0.95, 0.95, 0.95], dtype=float32)
    """
    line = _with_counts(dataset)
    SchemaError.raise_if(
        "counts" not in line.data_vars,
        f"white reference of {', '.join(map(str, line.data_vars)) or 'no variable'}",
        expected="raw 'counts' (along_track, band, cross_track), whole numbers without a sign",
        mend="open the raw cube; for signed integers: dataset.astype('uint16')",
        code="counts-missing",
    )
    SchemaError.raise_if(
        tile is None,
        "the reflectance of the white tile is missing",
        mend="pass tile=, such as 0.95 or the file of its certificate; tile=1.0 gives reflectance relative "
        "to the tile",
        option="state reflectance or certificate in [reference]; reflectance = 1.0 gives reflectance "
        "relative to the tile",
        code="tile-missing",
    )
    corrections = {"linear_counts", "masked", "linearity", *OF_ELEMENTS, *STRAY_SOURCES} & {
        *line.variables,
        *line.attrs,
    }
    SchemaError.raise_if(
        corrections,
        f"a white reference and {', '.join(sorted(corrections))} of a calibration",
        mend="open the cube without the calibration, or drop these variables and attributes",
        code="option-conflict",
    )
    line = _with_raw_inputs(line, dark, exposure_time, bit_depth)
    whites = [_white(source, line, white_dark, white_exposure_time) for source in _sources(white)]
    limit = line["saturation_count"].astype(np.float64).values - SATURATION_MARGIN_COUNTS
    with Problems("this white reference cannot be used", SchemaError) as problems:
        for each in whites:
            each.check(limit, line, problems)
    certified = Panel(
        slice(None),
        slice(None),
        read_certificate(tile) if isinstance(tile, str | os.PathLike) else tile,
        tile_uncertainty or 0.0,
        surface=tile_surface,
    )
    # reflectance factor of the tile in every band, and the uncertainty by its surface
    bands = line["wavelength"].values if "wavelength" in line.coords else np.full(line.sizes[BAND], np.nan)
    factor, surface_u = np.ones(bands.shape), 0.0
    if not is_lambertian(certified.surface):
        light_zenith = SchemaError.raise_if_none(
            light_zenith,
            "the surface of the tile is declared, but not the direction of its light",
            mend="pass light_zenith=, the zenith angle of the lamps or the sun [degree]",
            option="state light_zenith_deg in [reference]",
            code="panel-light-unknown",
        )
        directional = panel_factor(bands, light_zenith, surface=certified.surface, direct_share=direct_share)
        factor, surface_u = directional.factor, float(np.nanmax(directional.u, initial=0.0))
    SchemaError.raise_if(
        "wavelength" not in line.coords and (np.ndim(certified.reflectance) or np.isnan(factor).any()),
        "the certificate or the factors of a tile, and a cube without wavelengths",
        mend="add a coordinate wavelength (band) [nm], or pass tile= as a number",
        code="wavelength-missing",
    )
    reflectance: Floats = certified.at(bands) * factor
    if (missing := np.isnan(reflectance)).any():
        warn_user(
            f"the certificate of the tile does not cover {missing.sum()} of {missing.size} bands, which are "
            f"NaN: {bands[missing].min():g} to {bands[missing].max():g} nm",
            "tile-certificate-short",
        )
    if tile_uncertainty is not None:
        tile_uncertainty = float(np.hypot(tile_uncertainty, surface_u))
    # variables of a white reference: gain, its uncertainty, and the change of the light.
    times = [each.reference.time for each in whites]
    is_timed = "time" in line.coords and all(time is not None for time in times) and len(set(times)) > 1
    by_time = sorted(whites, key=lambda each: each.reference.time or np.datetime64(0, "ns"))
    rates = np.stack([each.light / each.exposure for each in by_time])
    is_used: Bools = np.all([each.is_lit & ~each.saturated(limit) for each in by_time], axis=0)
    rates[:, ~is_used] = np.nan
    warn_if(
        saturated := np.any([each.saturated(limit) for each in by_time], axis=0).sum(),
        f"{saturated} elements are saturated on the white tile: they are bad elements, NaN",
        "white-saturated",
    )
    # light on the tile of every band, over that of the first white; bands without light keep 1
    totals = np.nansum(rates, axis=2)
    level = np.where(totals[:1] > 0, totals / np.where(totals[:1] > 0, totals[:1], 1.0), 1.0)
    # Check the change of the light (white, band) between white references, and whether columns share it.
    change = float(np.nanmax(np.nanmedian(np.abs(level - 1.0), axis=1)))
    SchemaError.raise_if(
        change > UNSTABLE_CHANGE and not is_timed,
        f"the light on the white references changes by {100 * change:.3g} %, and times of white or scene are "
        "unknown",
        expected=f"times, or a change of at most {100 * UNSTABLE_CHANGE:g} %",
        mend="give scene and white a coordinate time, or name one white reference",
        code="white-times-missing",
    )
    lit = np.isfinite(rates[0]).any(axis=0)
    columns = np.nanmedian((rates / rates[:1] / level[:, :, None])[:, :, lit], axis=1)
    column_change = float(np.abs(columns - 1.0).max())
    warn_if(
        column_change > TILE.max_column_change,
        f"between white references the light of a column changes by {100 * column_change:.3g} % beside "
        "that of the other columns: tile or lamp have moved; name the white references of this setup",
        "white-moved",
    )
    rate = (rates / level[:, :, None] if is_timed else rates).mean(axis=0)
    variances = np.stack([each.variance / each.exposure**2 for each in by_time]) / level[:, :, None] ** 2
    variance = variances.sum(axis=0) / len(whites) ** 2
    with np.errstate(invalid="ignore"):
        values: dict[str, tuple[tuple[str, ...], Any]] = {
            "reflectance_gain": (CUBE[1:], reflectance[:, None] / rate),
            "reflectance_gain_u_random": (CUBE[1:], np.sqrt(variance) / rate),
        }
    if tile_uncertainty is not None:
        values["reflectance_gain_u_systematic"] = ((), tile_uncertainty)
    if is_timed:
        stamps = np.array([each.reference.time for each in by_time], "datetime64[ns]")
        values |= {"white_level": (("white_time", BAND), level), "white_time": (("white_time",), stamps)}
        # lines before the first or after the last white reference, whose light is not interpolated
        known = line["time"].values[~np.isnat(line["time"].values)]
        warn_if(
            outside := int(((known < stamps[0]) | (known > stamps[-1])).sum()),
            f"{outside} of {known.size} lines lie before the first or after the last white reference: "
            "the light of the nearest one is used",
            "white-held",
        )
    if electrons := _electrons_per_count(line, by_time, is_used):
        values["electrons_per_count"] = (), electrons
    return line.assign(
        {
            name: label(xr.DataArray(array, dims=dims).astype(dtype_of(name)), name)
            for name, (dims, array) in values.items()
        }
    ).assign_attrs(
        white_source=", ".join(str(each) for each in whites),
        white_tile=f"{tile:g}" if np.ndim(tile) == 0 and not isinstance(tile, str | Path) else "certificate",
    )


class _White(NamedTuple):
    # Counts of the tile above their dark, of one cube.
    reference: Reference
    exposure: float  #: [s]
    light: Floats  #: (band, cross_track): counts above the dark, mean over lines
    variance: Floats  #: (band, cross_track): variance of that mean, with that of the dark [count2]

    def __str__(self) -> str:
        return f"{self.reference.name} ({self.reference.frames.lines} lines, {self.exposure * 1e3:g} ms)"

    def saturated(self, limit: Any) -> Bools:
        # Whether an element reaches the limit in any line.
        return np.asarray(self.reference.frames.maximum >= limit, bool)

    @property
    def is_lit(self) -> Bools:
        # Whether the tile is significantly brighter than the dark.
        return np.asarray(self.light > TILE.min_significance * np.sqrt(self.variance), bool)

    def check(self, limit: Any, line: xr.Dataset, problems: Problems) -> None:
        name, frames = f"white {self.reference.name}", self.reference.frames
        good = good_bands(line)
        share = float(self.saturated(limit)[good].mean())
        problems.add_if(
            share > TILE.max_saturated_share,
            f"{name}: {100 * share:.3g} % of the elements are saturated",
            expected=f"at most {100 * TILE.max_saturated_share:g} %",
            mend="record the tile again with a shorter exposure; the exposure of the scene may be longer",
            code="white-saturated",
        )
        lit = float(self.is_lit[good].mean())
        median = float(np.nanmedian(self.light[good]))
        problems.add_if(
            lit < TILE.min_lit_share,
            f"{name}: {100 * lit:.3g} % of the elements are brighter than the dark, by {median:.3g} counts "
            "in the median",
            expected=f"{100 * TILE.min_lit_share:g} % and more",
            mend="name the cube of the white tile, and its dark; check that they are not swapped",
            code="white-without-light",
        )
        if lit >= TILE.min_lit_share:
            levels = frames.line_mean - float(np.nanmean(frames.mean - self.light))
            deviating = np.abs(levels / np.median(levels) - 1.0) > TILE.max_line_deviation
            problems.add_if(
                deviating.mean() > TILE.max_deviating_line_share,
                f"{name}: {deviating.sum()} of {deviating.size} lines differ by more than "
                f"{100 * TILE.max_line_deviation:g} % from the median",
                expected="lines that show nothing but the tile, under steady light",
                mend="select them: white=xr.open_dataset(path).isel(along_track=slice(10, 90))",
                code="white-unsteady",
            )
        if self.reference.wavelength is not None and "wavelength" in line.coords:
            difference = float(np.abs(self.reference.wavelength - line["wavelength"].values).max())
            problems.add_if(
                difference > TILE.max_wavelength_difference_nm,
                f"{name}: its wavelengths differ by up to {difference:.3g} nm from those of the scene",
                expected=f"at most {TILE.max_wavelength_difference_nm:g} nm",
                mend="name the white of this camera and binning, or mend the header that is wrong",
                code="white-wavelength-differs",
            )


def _with_counts(dataset: xr.Dataset) -> xr.Dataset:
    # Return a dataset with integers of an undeclared quantity as counts: with a white reference they are raw.
    line = rename_to_roles(dataset)
    is_raw = "values" in line.data_vars and line["values"].dtype.kind == "u"
    return line.rename(values="counts").assign(counts=label(line["values"], "counts")) if is_raw else line


def _sources(white: Any) -> list[Any]:
    # Return the cubes of white references: paths of headers, and Datasets.
    if isinstance(white, str | os.PathLike) and is_zarr(white):
        white = open_unverified(white, chunks={})
    if isinstance(white, str | os.PathLike):
        headers = lambda paths: [path for path in paths if path.suffix.lower() == ".hdr"]  # noqa: E731
        return list(find_paths(white, headers, "ENVI headers of white references", headers))
    white = white.to_dataset(name="counts") if isinstance(white, xr.DataArray) else white
    if isinstance(white, xr.Dataset | Reference):
        return [white]
    sources = [source for entry in white for source in _sources(entry)] if np.iterable(white) else []
    SchemaError.raise_if(
        not sources,
        f"white={shown(white)}",
        expected="the path of an ENVI header or a Zarr, a Dataset or DataArray of counts, or several of them",
        code="type-wrong",
    )
    return sources


def _with_raw_inputs(line: xr.Dataset, dark: Any, exposure_time: Any, bit_depth: int) -> xr.Dataset:
    # Return a line with dark, exposure, saturation and, where a header states it, time.
    source = line.encoding.get("source")
    path = Path(source) if isinstance(source, str) and Path(source).is_file() else None
    name = str(line.attrs.get("source", "this line"))
    added: dict[str, xr.DataArray] = {}
    if exposure_time is not None or "exposure_time" not in line.variables:
        seconds = find_exposure(exposure_time, path, name, line, required=True)[0]
        added["exposure_time"] = label(
            xr.DataArray(seconds, dims=(ALONG_TRACK,) if seconds is not None and seconds.ndim else ()),
            "exposure_time",
        )
    if "saturation_count" not in line.variables:
        added["saturation_count"] = saturation_of(None, bit_depth, None)
    if dark is not None or "dark_counts" not in line.variables:
        opened = open_dark(own_dark(dark, path, line), Timing(), None, line["counts"])
        if opened is not None:
            others = (*_DARK_VARIABLES, "dark_counts_u_random", "dark_counts_u_systematic")
            line = line.drop_vars(others, errors="ignore")
            added |= opened.variables(needs_noise="read_noise" not in line.variables)
    start, period = recording_clock(line)
    if "time" not in line.coords and start is not None and period is not None:
        steps = np.round((np.arange(line.sizes[ALONG_TRACK]) + 0.5) * period * 1e9).astype("timedelta64[ns]")
        added["time"] = label(xr.DataArray(utc_of(start, "start time") + steps, dims=ALONG_TRACK), "time")
    return line.assign(added).set_coords([name for name in ("time",) if name in added])


def _white(source: Any, line: xr.Dataset, white_dark: Any, white_exposure_time: float | None) -> _White:
    # Read one white reference, and subtract the dark of its exposure.
    sizes = (line.sizes[BAND], line.sizes[CROSS_TRACK])
    if isinstance(source, xr.Dataset):
        source = _with_counts(source)
        refuse_other_labels(source, line, "the white reference", (CROSS_TRACK,))
    reference = source if isinstance(source, Reference) else read_reference(source, Timing(), None, "white")
    check_shape(reference.frames.mean.shape, sizes, f"white {reference.name}", "white")
    exposure = SchemaError.raise_if_none(
        reference.exposure if white_exposure_time is None else white_exposure_time,
        f"white {reference.name}: no exposure beside it or in its header",
        mend=(
            "pass white_exposure_time= [s]; it is that of the scene only if the camera's setting was "
            "not changed"
        ),
        option="state exposure_time_ms in [reference]",
        code="exposure-missing",
    )
    darks: Any = line
    if white_dark is not None and (opened := open_dark(white_dark, Timing(), None, line["counts"])):
        darks = xr.Dataset(opened.variables(needs_noise=False))
    of_scene = np.asarray(line["exposure_time"].values, np.float64)
    SchemaError.raise_if(
        white_dark is None
        and "dark_exposure_time" not in darks.variables
        and np.abs(exposure / of_scene - 1.0).max() > SAME_EXPOSURE_SHARE
        and bool(darks["dark_counts"].values.any()),
        f"white {reference.name} was taken at {exposure * 1e3:g} ms, the scene at "
        f"{of_scene.flat[0] * 1e3:g} ms, and the exposure of the dark is unknown",
        mend="pass white_dark=, a dark at the exposure of the white",
        option="state dark in [reference]",
        code="dark-exposure-differs",
    )
    cube = {name: darks[name].values for name in _DARK_VARIABLES if name in darks.variables}
    cube["dark_counts"] = darks["dark_counts"].transpose(..., *CUBE[1:]).values
    if reference.time is not None:
        cube["time"] = np.array([reference.time])
    counts, index, weight = darks_of_lines(cube, np.array([exposure]), f"white {reference.name}")
    before = counts[index[0]].astype(np.float64)
    dark = before + float(weight[0]) * (counts[min(index[0] + 1, len(counts) - 1)] - before)
    frames = reference.frames
    variance = np.maximum(
        frames.mean, 1.0
    )  # of a single line; lower bound: shot noise at one electron per count
    if frames.lines > 1:
        # few lines: shrink the variance of an element to the mean variance
        freedom = frames.lines - 1
        pooled = max(0, MIN_NOISE_LINES - frames.lines)
        variance = (freedom * frames.variance + pooled * frames.variance.mean()) / (freedom + pooled)
    dark_u = darks.variables.get("dark_counts_u_random", np.zeros(()))
    return _White(reference, exposure, frames.mean - dark, variance / frames.lines + np.square(dark_u))


def _electrons_per_count(line: xr.Dataset, whites: list[_White], is_used: Bools) -> float | None:
    # Return the electrons per count from the noise of the longest white reference; None if it has few lines,
    # or the line states it.
    #
    # The variance of an element is light / electrons, and the square of its light times the flicker of the
    # lamp, which the means of lines show.
    longest = max(whites, key=lambda each: each.reference.frames.lines)
    frames = longest.reference.frames
    is_stated = "electrons_per_count" in line.variables
    if is_stated or frames.lines < MIN_NOISE_LINES or "read_noise" not in line.variables:
        return None
    read_noise = np.broadcast_to(line["read_noise"].values.astype(np.float64), is_used.shape)
    excess = frames.variance - read_noise**2 - QUANTISATION_VARIANCE_COUNT2
    is_valid = is_used & np.isfinite(excess)
    level, noise = float(np.nanmean(longest.light)), float(frames.variance.mean()) / frames.variance.size
    flicker = max(float(frames.line_mean.var(ddof=1)) - noise, 0.0) / level**2
    shot = float((excess - flicker * longest.light**2)[is_valid].sum())
    return float(longest.light[is_valid].sum()) / shot if shot > 0.0 else None


# --- white tiles -------------------------------------------------------------------------------------------

#: Bits that every product derives anew; bits of other rooms stay.
_PRODUCT_BITS = {"radiance": flags_set_from("counts"), "reflectance": flags_set_from("counts", "light")}


@takes_quantities()
def radiance(dataset: xr.Dataset) -> xr.Dataset:
    r"""Spectral radiance at the sensor, from raw counts.

    Lazy: one task a slab of lines, no pixel is read.

    Parameters
    ----------
    dataset
        A flight line: ``counts`` (along_track, band, cross_track), ``dark_counts`` and ``radiance_gain``
        (band, cross_track), ``exposure_time`` and ``saturation_count``, each with ``units``.

    Returns
    -------
    Dataset
        The line with ``radiance`` (along_track, band, cross_track), float32 [W m-2 sr-1 nm-1], and
        ``quality`` (along_track, cross_track), uint16. Saturated samples and bad elements are NaN.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, or have other dims or units; every problem is listed. The gain has
        no absolute scale (attribute ``absolute_scale`` of the calibration), or ``linearity_on`` is unknown.
        When computed: values are out of range, such as a dark at another exposure or a linearity curve that
        is not monotonic; bands or columns have too few masked elements; stray light belongs to other bands or
        columns.

    Warns
    -----
    PaintWarning
        When computed: elements respond unlike their neighbours, while stray light is subtracted without a
        ``flat_field``.

    Notes
    -----
    .. math:: L = g\,\ell(C - D) / t \quad\text{or}\quad L = g\,(\ell(C) - \ell(D)) / t

    with :math:`g` the radiance gain, :math:`C` and :math:`D` the counts and the dark, :math:`t` the
    exposure time and :math:`\ell` the detector's linearity, as the calibration declares it (attributes
    ``linearity`` and ``linearity_on``, or the table ``linear_counts``, from which elements may differ by
    ``linearity_basis`` and ``linearity_map``): the identity without one. Saturation is judged on raw counts.
    The attribute ``linearity_applied`` names the applied curve.

    Where the calibration or the line declares ``masked`` elements, which receive no light, the mean of their
    counts above their dark in a line, the pedestal, is added to the dark of every element of that line;
    elements further than 5 standard deviations from the mean are left out. By the attributes ``pedestal`` and
    ``pedestal_statistic`` there are pedestals of bands and of columns, also by the median. The attribute
    ``pedestal_applied`` records it. The noise of pedestals is in the systematic uncertainty.

    Where the calibration or the line holds ``stray_light``, the share of each band's light that other bands
    receive, or ``band_shift_time``, in which a frame is shifted by a band under the light, the light of other
    bands is subtracted: :math:`c = (1 + D)^{-1} (s - \kappa \sum s)`, where of :math:`n` bands
    :math:`\kappa = \epsilon / (1 + n \epsilon)`, and :math:`\epsilon` is the shift time over the exposure.
    ``stray_light_across`` does the same between columns. Light scatters before the detector: responses of
    elements are levelled by ``flat_field``, or by a robust fit to the gain, which names weak elements.
    The attribute ``stray_light_applied`` records it; its uncertainty ``stray_light_u`` is in the systematic
    uncertainty.

    The paper's eq. 4 has the exposure ratio inverted and an area in place of the pupil's; altitude never
    enters. Several darks are interpolated in time, or to the line's exposure by bias and
    rate, never by scaling the bias.

    Examples
    --------
    The worked example: 1966.09 counts above the dark in 5 ms.

    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> line = worked_example()
    >>> print(f"{float(hp.radiance(line).radiance[0, 0, 0]):.6f}")
    0.165521
    """
    dataset = rename_to_roles(dataset)
    if "counts" not in dataset.variables:
        _require_one_of(dataset, ("counts", "radiance"), "radiance")
        return dataset.assign(require(dataset, ["radiance"], "radiance"))
    cube, values = cube_inputs(dataset, "radiance")
    refuse_calibration(dataset, needs_scale=True)
    (radiances,), quality, _ = slabs.calibrated(
        slabs.line_chunked(cube), lazy_plan(dataset, None, make_plan, cube=values, light=None)
    )
    return _with_product(dataset, "radiance", radiances, quality, applied(values))


@takes_quantities(tilt="degree")
def reflectance(
    dataset: xr.Dataset,
    irradiance: xr.Dataset | None = None,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    panel: Panel | Sequence[Panel] | None = None,
    white: Any = None,
    tile: Any = None,
    dark: Any = None,
    keep_bits: int | None = None,
) -> xr.Dataset:
    r"""Reflectance factor under the irradiance measured at the time of every line, or relative to a white.

    Lazy: one task a slab of lines, one pass over memory, no pixel is read.

    Parameters
    ----------
    dataset
        A flight line. From ``counts`` when present, with the variables that `radiance` needs; else from
        ``radiance``; else the stored ``reflectance`` is returned. Further ``time`` (along_track),
        ``wavelength`` and ``fwhm`` (band), ``wavelength_shift`` where there is smile, and the irradiance.
    irradiance
        Replaces the line's own record: ``irradiance`` (irradiance_time, irradiance_wavelength),
        ``irradiance_fwhm`` and optionally ``irradiance_max_gap`` and ``irradiance_clock_uncertainty``, each
        with ``units``.
    uncertainty
        Add standard uncertainties. They need counts, and ``electrons_per_count`` and ``read_noise`` of the
        calibration or from `hyperpaint.radiometry.estimate_noise`.
    tilt
        Attitude of a tilted surface, as `Tilt` or (angle, azimuth) [degree]; needs latitude and longitude.
        Without a ``diffuse_fraction`` of its own, the fraction of the lines is used, else the fraction that
        `hyperpaint.light.diffuse_from_record` derives from the record.
    panel
        A target of known reflectance in the scene, to which every band is scaled; or several, seen at
        different times, which correct the level of the record between them. Their measured factors and states
        are stored beside reflectance, see `panel_closure`. By default the scale that `hyperpaint.process`
        derived from the panels which the line declares (attribute ``panels``), in crops as well;
        ``dataset.drop_vars("panel_weight")`` leaves it out.
    white, tile, dark
        Cube of a white tile in the light of the scene, the tile's reflectance factor (0.95, or the file of
        its certificate), and the dark of the scene, see `white_reference`: then the line needs neither
        calibration nor irradiance, nor position and time. A line that `white_reference` calibrated needs none
        of the three.
    keep_bits
        Mantissa bits that are kept, rounding to nearest-even; all 23 by default.

    Returns
    -------
    Dataset
        The line with ``reflectance`` (along_track, band, cross_track), float32 [1], ``quality`` (along_track,
        cross_track), uint16, ``irradiance_age`` (along_track), float32 [s], ``timing_sensitivity``
        (along_track), float32 [1]: the relative change of irradiance within the clocks' uncertainty, and
        ``irradiance_misfit`` (band), float32 [1]. NaN where a sample is saturated, an element bad, or a line
        outside the irradiance record or in a gap of it. Values below 0 and, in glint, above 1 are kept. With
        ``uncertainty`` also ``reflectance_u_random`` and ``reflectance_u_systematic``, as ``reflectance``,
        with obsarray's attributes, which name the known components.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        Variables are missing, or have other dims or units, or irradiance times do not increase; every
        problem is listed. The gain has no absolute scale and there is no ``panel``. When computed: values are
        out of range; or all panels are refused, with the reason.

    Warns
    -----
    PaintWarning
        The line has a scale by panels that was derived with another record than ``irradiance``. When
        computed: no line is within the record.

    Notes
    -----
    .. math:: \rho = \pi L / E

    with :math:`E` the downwelling irradiance on a level surface in the imager's band at that column, linear
    in time between the two samples around the line. It is a hemispherical-conical reflectance factor, the
    irradiance-weighted mean over the band's response; no cosine of the sun's zenith angle enters, since the
    receptor already measures horizontal irradiance. The paper's eq. 6 prints a product of radiance and
    irradiance, which is not a reflectance.

    Uncertainties are absolute, so that they hold at and below zero:

    .. math:: u_r &= \frac{\pi g}{t E} \sqrt{\max(C - D, 0) / k + \sigma_r^2 + 1/12} \\
              u_s^2 &= \rho^2 (u_g^2 + u_E^2)
              + \left(\frac{\pi}{E} \frac{\partial L}{\partial \lambda} u_\lambda\right)^2
              + \left(\frac{\pi g}{t E}\right)^2 (u_D^2 + u_{D,s}^2)

    with :math:`k` electrons a count, :math:`\sigma_r` the read noise, 1/12 for whole counts, :math:`u_D` of
    the mean dark, and the ``radiance_gain_u_*``, ``irradiance_u_systematic``, ``wavelength_u`` and
    ``dark_counts_u_systematic`` of the dataset; missing ones count as zero. Wavelength acts on radiance,
    since the irradiance is matched to the assumed wavelengths: where the light is flat, it is
    :math:`\partial\rho / \partial\lambda`, beside an absorption band of the air mostly the slope of the
    light. With a panel, its own uncertainty replaces the components that all elements share. In a mean each
    component shrinks as far as samples do not share it; see `hyperpaint.radiometry.mean_uncertainty`. Where
    counts are made linear, :math:`u_r` grows by the slope :math:`\ell'` of that curve, and ``linearity_u`` is
    added to the gain's uncertainty.

    References
    ----------
    .. [1] Z. Mulhollan, A. Rangnekar, T. Bauch, M. J. Hoffman, A. Vodacek, "Calibrated Vehicle Paint
       Signatures for Simulating Hyperspectral Imagery", CVPR Workshops 2020, section 3.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> line = worked_example()
    >>> print(f"{float(hp.reflectance(line).reflectance[0, 0, 0]):.6f}")
    0.400000
    """
    SchemaError.raise_if(
        white is None and not (tile is None and dark is None),
        "tile= and dark= without white=",
        mend="pass the cube of the white tile; a target in the scene is panel=hp.Panel(...)",
        code="argument-missing",
    )
    SchemaError.raise_if(
        white is not None and irradiance is not None,
        "both white= and irradiance=",
        mend="pass one of them",
        code="option-conflict",
    )
    if white is not None:
        dataset = white_reference(dataset, white, tile=tile, dark=dark)
    elif irradiance is not None:
        # the record replaces the white reference of the line
        dataset = dataset.drop_vars(WHITE_VARIABLES, errors="ignore")
    return _reflectance(
        dataset,
        irradiance,
        uncertainty=uncertainty,
        tilt=tilt,
        panels=several_panels(panel),
        keep_bits=keep_bits,
    )


@takes_quantities()
def panel_closure(
    dataset: xr.Dataset, panel: Panel | Sequence[Panel], irradiance: xr.Dataset | None = None
) -> xr.Dataset:
    r"""Return the ratio of measured to expected panel reflectance, and the state of each panel.

    Lazy. The same is stored beside ``reflectance(panel=)``, which refuses doubtful panels; this function
    refuses none.

    Parameters
    ----------
    dataset, irradiance
        As of `reflectance`.
    panel
        One panel, or several.

    Returns
    -------
    Dataset
        ``panel_factor``, ``panel_factor_u`` and ``panel_used`` (panel, band), float32 [1]: the factor, its
        combined standard uncertainty, and the share of pixels used; ``panel_state`` (panel), uint8, bits of
        the faults found; ``panel_time`` (panel).

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `reflectance`; a panel's region lies outside of the line, or contains no valid pixel.

    Notes
    -----
    .. math:: F = \frac{1}{\rho} \left\langle \frac{\pi L}{E} \right\rangle

    Computing warns of saturated pixels, pixels that are shaded or show something else, a mean with more than
    1 % standard error, the spectrum of a tilted panel, and a factor beyond twice its uncertainty. Methods and
    thresholds: `hyperpaint.radiometry.panels`.

    Examples
    --------
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> line = worked_example()
    >>> whole = Panel(slice(None), slice(None), 0.4)
    >>> panel_closure(line, whole).panel_factor.values.round(3)
    array([[1., 1., 1.]], dtype=float32)
    """
    return _reflectance(dataset, irradiance, panels=several_panels(panel), refuses=False)[list(CLOSURE)]


def _reflectance(
    dataset: xr.Dataset,
    irradiance: xr.Dataset | None,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    panels: tuple[Panel, ...] = (),
    keep_bits: int | None = None,
    refuses: bool = True,
) -> xr.Dataset:
    # Compute `reflectance`; with `refuses=False` panels are judged but not refused.
    dataset = rename_to_roles(dataset)
    if isinstance(tilt, tuple) and len(tilt) == 2:
        tilt = Tilt(*tilt)
    SchemaError.raise_if(
        tilt is not None and not isinstance(tilt, Tilt),
        f"tilt={tilt!r}",
        expected="hyperpaint.Tilt or (angle, azimuth) in degrees",
        code="type-wrong",
    )
    _require_one_of(dataset, ("counts", "radiance", "reflectance"), "reflectance")
    if not {"counts", "radiance"} & set(dataset.variables):
        SchemaError.raise_if(
            any(option is not None for option in (irradiance, tilt, panels or None, keep_bits)),
            "irradiance=, tilt=, panel= and keep_bits= need more than 'reflectance'",
            expected="'counts' or 'radiance'",
            code="option-conflict",
        )
        return dataset.assign(
            require(dataset, ["reflectance", *(UNCERTAINTIES if uncertainty else ())], "reflectance")
        )
    is_white = has_white(dataset)
    SchemaError.raise_if(
        is_white and (tilt is not None or bool(panels)),
        "tilt= or panel= for a line with a white reference",
        expected="neither: scene and tile lie in the same light",
        mend='drop the variable "reflectance_gain" to use the irradiance record',
        code="option-conflict",
    )
    stored = None if panels or is_white else declared_scale(dataset, other_light=irradiance is not None)
    if irradiance is not None:
        dataset = replace_record(dataset, irradiance)
    scale_panels = panels if stored is None else declared_panels(dataset)
    SchemaError.raise_if(
        keep_bits is not None and not 1 <= keep_bits <= 23,
        f"keep_bits={keep_bits}",
        expected="1 to 23 mantissa bits of float32",
        code="value-out-of-range",
    )
    cube, inputs = plan_inputs(
        dataset, stored, scale_panels, tilt=tilt, keep_bits=keep_bits, uncertainty=uncertainty
    )
    if panels:
        inputs["panel"] = panel_inputs(dataset, panels, reflectance) | {"refuses": refuses}
    # plans of level surfaces, without panels, are cached
    options = (stored is None, keep_bits, uncertainty) if tilt is None and not panels else None
    uncertain = inputs["uncertain"]
    cubes, quality, plan = slabs.calibrated(
        slabs.line_chunked(cube),
        lazy_plan(dataset, options, make_plan, **inputs),
        cubes=1 if uncertain is None else 3,
    )
    attributes = {"tilt": str(tilt) if tilt else None, "panel": "; ".join(map(str, scale_panels)) or None}
    attributes |= applied(inputs["cube"])
    if is_white:
        attributes["white"] = "; tile ".join(str(dataset.attrs[k]) for k in WHITE_ATTRS if k in dataset.attrs)
    # drop uncertainties of an earlier reflectance
    result = _with_product(
        dataset.drop_vars(UNCERTAINTIES, errors="ignore"), "reflectance", cubes[0], quality, attributes
    )
    if uncertain is not None:
        result = with_uncertainty(result, cubes[1:], uncertain)
    if is_white:
        return result
    lines, bands = cube.sizes[ALONG_TRACK], cube.sizes[BAND]
    light_of_lines = dask.delayed(slabs.light_of_lines, pure=True)
    for name, (values, dim, size) in {
        "irradiance_age": (light_of_lines(plan, "age"), ALONG_TRACK, lines),
        "timing_sensitivity": (light_of_lines(plan, "sensitivity"), ALONG_TRACK, lines),
        "irradiance_misfit": (plan.misfit, BAND, bands),
    }.items():
        result[name] = label(xr.DataArray(da.from_delayed(values, (size,), np.float32), dims=dim), name)
    if stored is not None:
        return result
    # replace the panels of an earlier reflectance
    result = without_panels(result)
    return result.assign(closure_variables(plan, len(panels), bands, lines)) if panels else result


def _require_one_of(dataset: xr.Dataset, names: tuple[str, ...], purpose: str) -> None:
    SchemaError.raise_if(
        not set(names) & set(dataset.variables),
        f"cannot compute {purpose} from {', '.join(map(str, dataset.data_vars)) or 'no variable'}",
        expected=f"'counts' with {', '.join(COUNTED[1:])}, or {' or '.join(map(repr, names[1:]))}",
        mend="pass white=, tile= and dark= for raw counts" if purpose == "reflectance" else "",
        code="variable-missing",
    )


def applied(values: dict[str, Any]) -> dict[str, str | None]:
    # Return the attributes that name the applied detector corrections; None for corrections not applied.
    linearity: Linearity | None = values.get("linearity")
    attributes: dict[str, str | None] = {}
    if linearity is not None:
        attributes["linearity_applied"] = linearity.described(TABLE[0] in values)
    if "masked" in values:
        part, statistic = values["pedestal"]
        each = "line" if part == "line" else f"{part} of each line"
        attributes["pedestal_applied"] = (
            f"{statistic} of the masked elements of each {each}, beyond their dark"
        )
    attributes["stray_light_applied"] = described(values)
    return attributes


def _with_product(
    dataset: xr.Dataset, name: str, cube: Any, quality: Any, attributes: dict[str, str | None]
) -> xr.Dataset:
    # Return the dataset with a calibrated cube, its quality, and `attributes` that are not empty.
    earlier_quality = (
        require(dataset, ["quality"], name)["quality"].variable if "quality" in dataset.variables else None
    )
    bits = merged_quality(name, quality, earlier_quality, anew="counts" in dataset.variables)
    attrs = {key: text for key, text in attributes.items() if text}
    return dataset.assign({name: label(xr.DataArray(cube, dims=CUBE), name, **attrs), "quality": bits})


def merged_quality(name: str, quality: Any, before: xr.Variable | None, *, anew: bool) -> xr.DataArray:
    # Return the flags of a product, merged with flags that were set before.
    #
    # ``anew``: flags derived from counts replace earlier ones.
    flags = xr.DataArray(quality, dims=(ALONG_TRACK, CROSS_TRACK))
    attrs: dict[str, Any] = {}
    if before is not None:
        # bits of other rooms, such as glint or shadow, stay
        flags = flags | (before & np.uint16(0xFFFF ^ (int(_PRODUCT_BITS[name]) if anew else 0)))
        attrs = {key: text for key, text in before.attrs.items() if key == "flags_from"}
    return label(flags.astype(np.uint16), "quality", **attrs)


# -- Calibrate whole lines in memory at once, in the calling thread: the unit of work for any engine.


@takes_quantities(tilt="degree")
def slab(
    dataset: xr.Dataset,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    keep_bits: int | None = None,
) -> xr.Dataset:
    """Reflectance and quality of some whole lines: numpy in, numpy out, the bits of ``.paint.reflectance()``.

    For engines other than dask, and for user loops: the function, its inputs and its outputs can be
    pickled, and no scheduler is used. Recipes for cubed, Ray, process pools and dask.distributed are in
    docs/howto/engines.md.

    Parameters
    ----------
    dataset
        Whole lines of a flight line, with their calibration: ``line.isel(along_track=slice(0, 32))``.
        Variables that are read from files on demand (``chunks=None``) are read here; 32 to 256 lines are a
        good size.
    uncertainty, tilt, keep_bits
        As of `hyperpaint.reflectance`.

    Returns
    -------
    Dataset
        The lines in memory, with the variables that `hyperpaint.reflectance` adds.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `hyperpaint.reflectance`, at once; or variables are arrays of dask.

    Notes
    -----
    Lines do not depend on one another, so the bits are those of the whole line. Three options use all lines
    passed: ``tilt`` their mean position, ``uncertainty`` the largest share of the dark's noise,
    and darks of several exposures the range of the lines' exposures, where these differ.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> line = worked_example()
    >>> print(f"{hp.slab(line).reflectance.values[0, 0, 0]:.6f}")
    0.400000
    """
    line = rename_to_roles(dataset)
    lazy = [str(name) for name, variable in line.variables.items() if variable.chunks is not None]
    SchemaError.raise_if(
        lazy,
        f"slab computes no dask arrays: {', '.join(lazy[:3])}{', ...' if len(lazy) > 3 else ''}",
        expected="lines in memory",
        mend="pass line.load(), open with chunks=None, or call .paint.reflectance() on all lines",
        code="lines-not-loaded",
    )
    line = line.compute()  # reads variables that are opened with chunks=None
    cubes = {name: line[name] for name in ("counts", "radiance") if name in line.data_vars}
    # one chunk with a random name: a hash of the values would take a pass over them
    single_chunk = {
        name: cube.copy(data=da.from_array(cube.values, chunks=-1, name=False))
        for name, cube in cubes.items()
    }
    product = reflectance(line.assign(single_chunk), uncertainty=uncertainty, tilt=tilt, keep_bits=keep_bits)
    return product.compute(scheduler="synchronous").assign(cubes)
