"""Reflectance relative to a white tile: for cubes without calibration, navigation and irradiance record.

    rho = rho_tile (C - D) / (W - D_W) (t_W / t)        for every band and column

A white reference is a gain per detector element, ``reflectance_gain``, in place of calibration and
irradiance; several white references in time add the change of the light, ``white_level``.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2, SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import Problems, SchemaError, warn_user
from hyperpaint.base.facts import takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    Bools,
    Floats,
    dtype_of,
    label,
    rename_to_roles,
)
from hyperpaint.io.flightline.calibration_store import saturation_of
from hyperpaint.io.flightline.dark import (
    MIN_NOISE_LINES,
    Reference,
    check_shape,
    open_dark,
    own_dark,
    read_reference,
)
from hyperpaint.io.flightline.headwall import find_exposure, recording_clock
from hyperpaint.io.flightline.timing import Timing, utc_of
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
from hyperpaint.io.spectrometers.spectrum_files import find_paths
from hyperpaint.io.store.reader import is_zarr, open_unverified
from hyperpaint.light.synchrony import UNSTABLE_CHANGE

from .panels import Panel
from .planning import SAME_EXPOSURE_SHARE, darks_of_lines

#: Share of saturated elements [1] above which a white reference is refused; fewer become bad elements.
MAX_SATURATED_SHARE = 0.01
#: Light of an element over its standard uncertainty, below which the element is bad.
MIN_SIGNIFICANCE = 3.0
#: Share of elements with light [1] below which a white reference is refused.
MIN_LIT_SHARE = 0.5
#: Relative deviation of lines of a white reference from their median [1].
MAX_LINE_DEVIATION = 0.05
#: Share of lines that may deviate by more [1]: beyond, the cube shows more than the tile.
MAX_DEVIATING_LINE_SHARE = 0.02
#: Difference between the wavelengths of the headers of white and scene that is refused [nm].
MAX_WAVELENGTH_DIFFERENCE_NM = 0.5
#: Change of the light between two white references that differs between columns [1], above which tile or lamp
#: have moved.
MAX_COLUMN_CHANGE = 0.02

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
        differ. All problems of the white are listed.

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
    >>> from hyperpaint.radiometry.example_pixel import worked_example
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
    names = {*line.variables, *line.attrs}
    corrections = {"linear_counts", "masked", "stray_light", "band_shift_time", "linearity"} & names
    SchemaError.raise_if(
        corrections,
        f"a white reference and {', '.join(sorted(corrections))} of a calibration",
        mend="open the cube without the calibration, or drop these variables and attributes",
        code="option-conflict",
    )
    line = _with_raw_inputs(line, dark, exposure_time, bit_depth)
    whites = [_white(source, line, white_dark, white_exposure_time) for source in _sources(white)]
    limit = line["saturation_count"].astype(np.float64).values - SATURATION_MARGIN_COUNTS
    problems = Problems("this white reference cannot be used", SchemaError)
    for each in whites:
        each.check(limit, line, problems)
    problems.raise_if_any()
    return line.assign(_gain_variables(line, whites, limit, tile, tile_uncertainty)).assign_attrs(
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
        return np.asarray(self.light > MIN_SIGNIFICANCE * np.sqrt(self.variance), bool)

    def check(self, limit: Any, line: xr.Dataset, problems: Problems) -> None:
        name, frames = f"white {self.reference.name}", self.reference.frames
        good = line["good"].values if "good" in line.coords else np.ones(len(self.light), bool)
        share = float(self.saturated(limit)[good].mean())
        problems.add_if(
            share > MAX_SATURATED_SHARE,
            f"{name}: {100 * share:.3g} % of the elements are saturated",
            expected=f"at most {100 * MAX_SATURATED_SHARE:g} %",
            mend="record the tile again with a shorter exposure; the exposure of the scene may be longer",
            code="white-saturated",
        )
        lit = float(self.is_lit[good].mean())
        median = float(np.nanmedian(self.light[good]))
        problems.add_if(
            lit < MIN_LIT_SHARE,
            f"{name}: {100 * lit:.3g} % of the elements are brighter than the dark, by {median:.3g} counts "
            "in the median",
            expected=f"{100 * MIN_LIT_SHARE:g} % and more",
            mend="name the cube of the white tile, and its dark; check that they are not swapped",
            code="white-without-light",
        )
        if lit >= MIN_LIT_SHARE:
            levels = frames.line_mean - float(np.nanmean(frames.mean - self.light))
            deviating = np.abs(levels / np.median(levels) - 1.0) > MAX_LINE_DEVIATION
            problems.add_if(
                deviating.mean() > MAX_DEVIATING_LINE_SHARE,
                f"{name}: {deviating.sum()} of {deviating.size} lines differ by more than "
                f"{100 * MAX_LINE_DEVIATION:g} % from the median",
                expected="lines that show nothing but the tile, under steady light",
                mend="select them: white=xr.open_dataset(path).isel(along_track=slice(10, 90))",
                code="white-unsteady",
            )
        if self.reference.wavelength is not None and "wavelength" in line.coords:
            difference = float(np.abs(self.reference.wavelength - line["wavelength"].values).max())
            problems.add_if(
                difference > MAX_WAVELENGTH_DIFFERENCE_NM,
                f"{name}: its wavelengths differ by up to {difference:.3g} nm from those of the scene",
                expected=f"at most {MAX_WAVELENGTH_DIFFERENCE_NM:g} nm",
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
    return [source for entry in white for source in _sources(entry)]


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
    source = _with_counts(source) if isinstance(source, xr.Dataset) else source
    reference = source if isinstance(source, Reference) else read_reference(source, Timing(), None, "white")
    check_shape(reference.frames.mean.shape, sizes, f"white {reference.name}", "white")
    exposure = reference.exposure if white_exposure_time is None else white_exposure_time
    if exposure is None:
        raise SchemaError(
            f"white {reference.name}: no exposure beside it or in its header",
            mend="pass white_exposure_time= [s]; it is that of the scene only if the camera's setting was "
            "not changed",
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


def _gain_variables(
    line: xr.Dataset, whites: list[_White], limit: Any, tile: Any, tile_uncertainty: float | None
) -> dict[str, xr.DataArray]:
    # Return the variables of a white reference: gain, its uncertainty, and the change of the light.
    times = [each.reference.time for each in whites]
    is_timed = "time" in line.coords and all(time is not None for time in times) and len(set(times)) > 1
    whites = sorted(whites, key=lambda each: each.reference.time or np.datetime64(0, "ns"))
    rates = np.stack([each.light / each.exposure for each in whites])
    is_used: Bools = np.all([each.is_lit & ~each.saturated(limit) for each in whites], axis=0)
    rates[:, ~is_used] = np.nan
    if saturated := np.any([each.saturated(limit) for each in whites], axis=0).sum():
        warn_user(
            f"{saturated} elements are saturated on the white tile: they are bad elements, NaN",
            "white-saturated",
        )
    # light on the tile of every band, over that of the first white; bands without light keep 1
    totals = np.nansum(rates, axis=2)
    level = np.where(totals[:1] > 0, totals / np.where(totals[:1] > 0, totals[:1], 1.0), 1.0)
    _check_change(rates, level, is_timed=is_timed)
    rate = (rates / level[:, :, None] if is_timed else rates).mean(axis=0)
    reflectance = _tile_of_bands(line, tile, tile_uncertainty or 0.0)
    variances = np.stack([each.variance / each.exposure**2 for each in whites]) / level[:, :, None] ** 2
    variance = variances.sum(axis=0) / len(whites) ** 2
    with np.errstate(invalid="ignore"):
        values: dict[str, tuple[tuple[str, ...], Any]] = {
            "reflectance_gain": (CUBE[1:], reflectance[:, None] / rate),
            "reflectance_gain_u_random": (CUBE[1:], np.sqrt(variance) / rate),
        }
    if tile_uncertainty is not None:
        values["reflectance_gain_u_systematic"] = ((), tile_uncertainty)
    if is_timed:
        stamps = np.array([each.reference.time for each in whites], "datetime64[ns]")
        values |= {"white_level": (("white_time", BAND), level), "white_time": (("white_time",), stamps)}
        # lines before the first or after the last white reference, whose light is not interpolated
        known = line["time"].values[~np.isnat(line["time"].values)]
        if outside := int(((known < stamps[0]) | (known > stamps[-1])).sum()):
            warn_user(
                f"{outside} of {known.size} lines lie before the first or after the last white reference: "
                "the light of the nearest one is used",
                "white-held",
            )
    if electrons := _electrons_per_count(line, whites, is_used):
        values["electrons_per_count"] = (), electrons
    return {
        name: label(xr.DataArray(array, dims=dims).astype(dtype_of(name)), name)
        for name, (dims, array) in values.items()
    }


def _check_change(rates: Floats, level: Floats, *, is_timed: bool) -> None:
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
    if column_change > MAX_COLUMN_CHANGE:
        warn_user(
            f"between white references the light of a column changes by {100 * column_change:.3g} % beside "
            "that of the other columns: tile or lamp have moved; name the white references of this setup",
            "white-moved",
        )


def _tile_of_bands(line: xr.Dataset, tile: Any, uncertainty: float) -> Floats:
    # Return the reflectance factor of the tile in every band.
    if isinstance(tile, str | os.PathLike):
        tile = read_certificate(tile)
    certified = Panel(slice(None), slice(None), tile, uncertainty)
    if np.ndim(tile) == 0:
        return np.full(line.sizes[BAND], float(tile))
    SchemaError.raise_if(
        "wavelength" not in line.coords,
        "the certificate of a tile, and a cube without wavelengths",
        mend="add a coordinate wavelength (band) [nm], or pass tile= as a number",
        code="wavelength-missing",
    )
    wavelength = line["wavelength"].values
    reflectance: Floats = certified.at(wavelength)
    if (missing := np.isnan(reflectance)).any():
        warn_user(
            f"the certificate of the tile does not cover {missing.sum()} of {missing.size} bands, which are "
            f"NaN: {wavelength[missing].min():g} to {wavelength[missing].max():g} nm",
            "tile-certificate-short",
        )
    return reflectance


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
