"""The one table of variables (name, dims, units, dtype, meaning), its checks, and the types of arrays.

Nothing else in the package spells a variable's units or meaning. Functions take their inputs through `require`
and label their outputs through `label`, which *replaces* attributes, since xarray carries stale ones through
arithmetic.
"""

import contextlib
import functools
import hashlib
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import xarray as xr

from .errors import Problem, SchemaError, warn_user
from .facts import convert, plain, same_dimension

Array: TypeAlias = npt.NDArray[Any]
ArrayLike: TypeAlias = npt.ArrayLike
Bools: TypeAlias = npt.NDArray[np.bool_]
Floats: TypeAlias = npt.NDArray[np.float64]
Floats32: TypeAlias = npt.NDArray[np.float32]
Indices: TypeAlias = npt.NDArray[np.intp]
Ints: TypeAlias = npt.NDArray[np.int64]
Times: TypeAlias = npt.NDArray[np.datetime64]
#: Called with the number of steps done and the total.
Progress: TypeAlias = Callable[[int, int], None]


def round_bits(values: Floats32, kept: int) -> Floats32:
    """Return values rounded to ``kept`` bits of the float32 mantissa, half to even, to compress well.

    Examples
    --------
    >>> round_bits(np.float32([0.1, np.nan]), 10)
    array([0.09997559,        nan], dtype=float32)
    """
    dropped = np.uint32(23 - kept)
    bits = np.ascontiguousarray(values).view(np.uint32)
    half = np.uint32((1 << (int(dropped) - 1)) - 1)
    return ((bits + half + ((bits >> dropped) & np.uint32(1))) >> dropped << dropped).view(np.float32)


ALONG_TRACK, BAND, CROSS_TRACK = "along_track", "band", "cross_track"
#: Dims of a cube in sensor geometry, in the instrument's own order: band-interleaved by line.
CUBE = (ALONG_TRACK, BAND, CROSS_TRACK)

IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH = "irradiance_time", "irradiance_wavelength"
#: Type of times in the table, which names the unit of the ticks.
TIME = "datetime64[ns]"
#: Dim of a lab sweep: one wavelength of the monochromator after the other.
STEP = "step"

#: Dims of a traced scene: its suns, and the light paths of a pixel.
SUN, SLOT = "sun", "slot"

#: Dim of the panels of known reflectance in a scene.
PANEL = "panel"

#: Dims of a paint library.
SIGNATURE, MEMBER, QUANTILE, FLAG = "signature", "member", "quantile", "flag"
ERROR_SOURCE, LAG = "error_source", "lag"


@dataclass(frozen=True)
class Variable:
    """One row of the table."""

    name: str  #: Name in datasets and stores
    dims: tuple[str, ...]  #: Dims in storage order; `alternatives` lists other accepted dims
    units: str  #: CF spelling, as written to disk; empty for flags, names and time stamps
    dtype: str  #: numpy dtype name, before and after compute
    meaning: str  #: One line; becomes ``long_name``
    alternatives: tuple[tuple[str, ...], ...] = ()  #: Other accepted dims
    standard_name: str = ""  #: Of the CF conventions, where there is one
    coordinate: bool = False  #: Whether it is a coordinate rather than a data variable
    gap: int = 0  #: Value of a whole number where it is missing

    @property
    def attrs(self) -> dict[str, Any]:
        texts = {"long_name": self.meaning, "units": self.units, "standard_name": self.standard_name}
        return {key: text for key, text in texts.items() if text}

    @property
    def allowed_dims(self) -> tuple[tuple[str, ...], ...]:
        # Dims in storage order, then the alternatives.
        return (self.dims, *self.alternatives)

    def dim_problem(self, array: xr.DataArray) -> Problem | None:
        # Return the fault of an array's dims, in any order; None for accepted dims.
        is_allowed = any(
            set(dims) == set(array.dims) and len(dims) == array.ndim for dims in self.allowed_dims
        )
        if is_allowed:
            return None
        mend = self._mend_of_dims(array)
        return Problem(
            f"{self.name!r} has dims ({', '.join(map(str, array.dims))})",
            expected=" or ".join(f"({', '.join(dims)})" for dims in self.allowed_dims),
            mend=mend,
            option=mend.partition(", or name them with dims=")[0],
            code="dims-wrong",
        )

    def _mend_of_dims(self, array: xr.DataArray) -> str:
        # compare with the dims that are nearest to those found
        nearest = min(self.allowed_dims, key=lambda dims: len(set(dims) ^ set(array.dims)))
        missing = [dim for dim in nearest if dim not in array.dims]
        added = [str(dim) for dim in array.dims if dim not in nearest]
        for dim in added:
            levels = getattr(array.indexes.get(dim), "names", [])
            if len(levels) > 1:
                return f"{dim} is a stack of {' and '.join(map(str, levels))}: unstack({dim!r}) first"
        if missing and not added:
            dim = missing[0]
            return (
                f"the dimension {dim} was dropped, as isel({dim}=5) or a mean over it does; "
                f"isel({dim}=[5]) keeps it"
            )
        return (
            f"where(..., drop=True) and xr.concat gave it {' and '.join(added)}: choose by .sel() or "
            '.isel(), join with data_vars="minimal", coords="minimal", compat="override"'
            if added and not missing and set(added) <= set(CUBE)
            else "rename them, or name them with dims={...}"
        )

    def unit_problem(self, array: xr.DataArray) -> Problem | None:
        # Return the fault of an array's units; None for convertible units, and for a row without units.
        units = array.attrs.get("units")
        if self.dtype == TIME and array.dtype.kind in "iufm":
            return Problem(
                f"{self.name!r} is {array.dtype}",
                expected=f"{TIME} in UTC",
                mend="set the units of the numbers, such as 'seconds since 2021-09-27', and decode them by "
                "xr.decode_cf(dataset)",
                code="type-wrong",
            )
        if self.units and units is None:
            return Problem(
                f"{self.name!r} has no units",
                mend=f"set {self.name}.attrs['units'], for example to {self.units!r}",
                code="units-missing",
            )
        if not self.units or str(units) == self.units or same_dimension(str(units), self.units):
            return None
        return Problem(
            f"{self.name!r} has units {str(units)!r}",
            expected=f"units like {self.units!r}",
            code="units-not-convertible",
        )


ELEMENT = (BAND, CROSS_TRACK)
_LINE = (ALONG_TRACK,)
_GAIN = "W m-2 sr-1 nm-1 s count-1"
_RADIANCE = "W m-2 sr-1 nm-1"
_IRRADIANCE = "W m-2 nm-1"
_LINE_FIT = (STEP, CROSS_TRACK)
_SWEEP = (STEP, BAND, CROSS_TRACK)
_PIXEL = (ALONG_TRACK, CROSS_TRACK)
_PATH = (ALONG_TRACK, SLOT, CROSS_TRACK)
_CELL = ("y", "x")
_SUN_PIXEL = (ALONG_TRACK, SUN, CROSS_TRACK)
_SPECTRUM = (SIGNATURE, BAND)
_LOOK_ACROSS = "Angle of a column's line of sight from the axis of the camera, positive to the right"

# fmt: off
_LINE_TABLE = (
    # --- cubes
    Variable("counts", CUBE, "count", "uint16", "Raw counts"),
    Variable("radiance", CUBE, _RADIANCE, "float32", "Spectral radiance at the sensor", standard_name="upwelling_radiance_per_unit_wavelength_in_air"),
    Variable("reflectance", CUBE, "1", "float32", "Hemispherical-conical reflectance factor", standard_name="surface_bidirectional_reflectance"),
    Variable("reflectance_u_random", CUBE, "1", "float32", "Random uncertainty of reflectance"),
    Variable("reflectance_u_systematic", CUBE, "1", "float32", "Systematic uncertainty of reflectance"),
    Variable("quality", _PIXEL, "", "uint16", "Quality flags", gap=2048),
    Variable("overview", ("overview_y", "overview_x", "rgb"), "", "uint8", "Small true-colour picture (sRGB)"),
    Variable("coarse_reflectance", ("coarse_y", BAND, "coarse_x"), "1", "float32", "Reflectance factor, means of blocks of pixels"),
    # --- calibration of every detector element
    Variable("dark_counts", ELEMENT, "count", "float32", "Counts with the lens capped", alternatives=(("dark_time", BAND, CROSS_TRACK),)),
    Variable("dark_time", ("dark_time",), "", "datetime64[ns]", "UTC of each dark reference", coordinate=True),
    Variable("dark_exposure_time", (), "s", "float64", "Exposure time of the dark reference", alternatives=(("dark_time",),)),
    Variable("radiance_gain", ELEMENT, _GAIN, "float32", "Spectral radiance per count rate"),
    Variable("reflectance_gain", ELEMENT, "s count-1", "float32", "Reflectance factor per count rate, from a white reference"),
    Variable("reflectance_gain_u_random", ELEMENT, "1", "float32", "Relative standard uncertainty of reflectance_gain by noise of white and dark"),
    Variable("reflectance_gain_u_systematic", (), "1", "float32", "Relative standard uncertainty of reflectance_gain by the reflectance of the white tile, common to all elements", alternatives=((BAND,),)),
    Variable("white_level", ("white_time", BAND), "1", "float64", "Light on each white reference over the light that reflectance_gain is valid for"),
    Variable("white_time", ("white_time",), "", "datetime64[ns]", "UTC of each white reference", coordinate=True),
    Variable("exposure_time", (), "s", "float64", "Exposure time", alternatives=(_LINE,)),
    Variable("saturation_count", (), "count", "float32", "Count at which the converter is full", alternatives=(ELEMENT,)),
    Variable("electrons_per_count", (), "electron count-1", "float32", "Electrons per count", alternatives=(ELEMENT,)),
    Variable("read_noise", (), "count", "float32", "Spread of a dark count before rounding (1 sigma)", alternatives=(ELEMENT,)),
    # --- light
    Variable(
        "irradiance", (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), _IRRADIANCE, "float32",
        "Downwelling spectral irradiance on a level surface",
        standard_name="surface_downwelling_radiative_flux_per_unit_wavelength_in_air",
    ),
    Variable(IRRADIANCE_TIME, (IRRADIANCE_TIME,), "", "datetime64[ns]", "UTC at the middle of each irradiance sample", coordinate=True),
    Variable(IRRADIANCE_WAVELENGTH, (IRRADIANCE_WAVELENGTH,), "nm", "float64", "Wavelength of the irradiance spectrometer", standard_name="radiation_wavelength", coordinate=True),
    Variable("irradiance_fwhm", (), "nm", "float64", "Full width at half maximum of the irradiance spectrometer", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("irradiance_max_gap", (), "s", "float64", "Longest interval between irradiance samples that is interpolated"),
    Variable("irradiance_clock_uncertainty", (), "s", "float64", "Uncertainty of the offset between the clocks of camera and spectrometer"),
    Variable("irradiance_tilt", (IRRADIANCE_TIME,), "degree", "float32", "Tilt of a light sensor on the aircraft"),
    Variable("irradiance_misfit", (BAND,), "1", "float32", "Relative difference between the response to which irradiance was matched and the camera's response"),
    Variable("irradiance_age", _LINE, "s", "float32", "Time to the nearest irradiance sample"),
    Variable("timing_sensitivity", _LINE, "1", "float32", "Largest relative change of irradiance within the clocks' uncertainty"),
    Variable("diffuse_fraction", (ALONG_TRACK, BAND), "1", "float32", "Diffuse part of the irradiance on level ground", alternatives=((IRRADIANCE_TIME, BAND), (BAND,))),
    Variable("diffuse_fraction_u", (ALONG_TRACK, BAND), "1", "float32", "Standard uncertainty of diffuse_fraction", alternatives=((IRRADIANCE_TIME, BAND), (BAND,))),
    Variable("sky_state", _LINE, "", "int8", "Kind of sky in the irradiance record", alternatives=((IRRADIANCE_TIME,), ()), gap=-1),
    Variable("coat_transmission", (BAND,), "1", "float32", "Transmission of a clear coat for light of the body, relative to its transmission near the normal", alternatives=((ALONG_TRACK, BAND),)),
    Variable("coat_transmission_u", (BAND,), "1", "float32", "Standard uncertainty of coat_transmission", alternatives=((ALONG_TRACK, BAND),)),
    # --- panels in the scene
    Variable("panel_factor", (PANEL, BAND), "1", "float32", "Measured reflectance of a panel over its certified reflectance"),
    Variable("panel_factor_u", (PANEL, BAND), "1", "float32", "Standard uncertainty of panel_factor by gain, irradiance, the panel and its pixels"),
    Variable("panel_used", (PANEL, BAND), "1", "float32", "Share of the pixels of a panel that enter panel_factor"),
    Variable("panel_state", (PANEL,), "", "uint8", "Findings on a panel"),
    Variable("panel_time", (PANEL,), "", "datetime64[ns]", "UTC at which a panel was seen"),
    Variable("panel_weight", (ALONG_TRACK, PANEL), "1", "float32", "Weight of a panel in the logarithm of the scale of a line; 0 for a refused panel"),
    Variable("panel_scale_u", _LINE, "1", "float32", "Relative standard uncertainty of the reflectance scale from panels"),
    # --- coordinates of a line and of a band
    Variable("time", _LINE, "", "datetime64[ns]", "UTC at mid exposure", standard_name="time", coordinate=True),
    Variable(ALONG_TRACK, _LINE, "", "int64", "Line of the cube", coordinate=True),
    Variable(CROSS_TRACK, (CROSS_TRACK,), "", "int64", "Column of the cube", coordinate=True),
    Variable("frame", _LINE, "1", "int64", "Frame number of the instrument", coordinate=True),
    Variable("wavelength", (BAND,), "nm", "float64", "Centre wavelength at the centre column", standard_name="radiation_wavelength", coordinate=True),
    Variable("fwhm", (BAND,), "nm", "float64", "Full width at half maximum of the line shape", coordinate=True),
    Variable("band_spacing", (BAND,), "nm", "float64", "Distance between neighbouring bands of the camera, before bands were selected", coordinate=True),
    Variable("responsivity_slope", (BAND,), "nm-1", "float64", "Relative slope of the camera's responsivity, before bands and columns were selected", coordinate=True),
    Variable("good", (BAND,), "", "bool", "Whether a band may be used", coordinate=True),
    Variable("wavelength_shift", (CROSS_TRACK,), "nm", "float64", "Wavelength of an element minus that of its band at the centre column (smile)", alternatives=(ELEMENT,), coordinate=True),
    Variable("latitude", _LINE, "degree", "float64", "Latitude of the camera, north positive", standard_name="latitude", coordinate=True),
    Variable("longitude", _LINE, "degree", "float64", "Longitude of the camera, east positive", standard_name="longitude", coordinate=True),
    Variable("altitude", _LINE, "m", "float64", "Altitude of the camera", coordinate=True),
    Variable("roll", _LINE, "degree", "float64", "Roll", coordinate=True),
    Variable("pitch", _LINE, "degree", "float64", "Pitch", coordinate=True),
    Variable("heading", _LINE, "degree", "float64", "Heading", coordinate=True),
    # --- directions from a pixel to the camera
    Variable("look_across", (CROSS_TRACK,), "degree", "float64", _LOOK_ACROSS),
    Variable("look_along", (CROSS_TRACK,), "degree", "float64", "Angle of a column's line of sight from the plane of the slit, positive forward"),
    Variable("ground_height", _PIXEL, "m", "float64", "Height of the observed point above the ellipsoid", coordinate=True),
    Variable("look_angle", (CROSS_TRACK,), "degree", "float64", _LOOK_ACROSS),
    Variable("view_zenith", _PIXEL, "degree", "float64", "Angle between the vertical and the direction to the camera", standard_name="sensor_zenith_angle", coordinate=True),
    Variable("view_azimuth", _PIXEL, "degree", "float64", "Direction from the observed point to the camera, clockwise from north", standard_name="sensor_azimuth_angle", coordinate=True),
    # --- lab calibration
    Variable("dark_bias", ELEMENT, "count", "float32", "Dark counts at no exposure"),
    Variable("dark_rate", ELEMENT, "count s-1", "float32", "Dark counts per exposure time"),
    Variable("dark_counts_u_random", ELEMENT, "count", "float32", "Standard uncertainty of dark_counts, independent from element to element", alternatives=((),)),
    Variable("dark_counts_u_systematic", ELEMENT, "count", "float32", "Standard uncertainty of dark_counts, common to all elements", alternatives=((), (BAND,))),
    Variable("flat_field", ELEMENT, "1", "float32", "Factor on dark-subtracted counts that levels the columns"),
    Variable("radiance_gain_u_random", ELEMENT, "1", "float32", "Relative standard uncertainty of radiance_gain by noise and by differences between elements", alternatives=((BAND,), ())),
    Variable("radiance_gain_u_systematic", ELEMENT, "1", "float32", "Relative standard uncertainty of radiance_gain, common to all elements", alternatives=((BAND,), ())),
    Variable("wavelength_u", (), "nm", "float64", "Standard uncertainty of wavelength", alternatives=((BAND,),)),
    Variable("irradiance_u_systematic", (), "1", "float32", "Relative standard uncertainty of irradiance, common to all times", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("irradiance_u_random", (), "1", "float32", "Relative standard uncertainty of one irradiance sample by noise, independent from time to time and channel to channel", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("responsivity", ELEMENT, "count J-1", "float64", "Counts per energy of light entering a pixel's etendue"),
    Variable("quantum_efficiency", (BAND,), "1", "float64", "Electrons per photon entering a pixel's etendue", alternatives=(ELEMENT,)),
    Variable("stray_light", (BAND, "source_band"), "1", "float64", "Share of the light of a source band that scatters into another band"),
    Variable("stray_light_across", (CROSS_TRACK, "source_column"), "1", "float64", "Share of the light of a source column that scatters into another column"),
    # --- lamp lines that a calibration was computed from
    Variable("step_wavelength", (STEP,), "nm", "float64", "Wavelength of the monochromator", coordinate=True),
    Variable("line_band", _LINE_FIT, "1", "float64", "Band at the centre of a monochromatic line"),
    Variable("line_centre", _LINE_FIT, "nm", "float64", "Wavelength of a lamp line by the wavelength map, to compare with step_wavelength"),
    Variable("line_fwhm", _LINE_FIT, "nm", "float64", "Full width at half maximum of a lamp line, as measured by the camera"),
    Variable("line_own_fwhm", _LINE_FIT, "nm", "float64", "Full width at half maximum of a lamp line without the width of the monochromator"),
    Variable("line_amplitude", _LINE_FIT, "count", "float64", "Height of a lamp line"),
    Variable("line_area", _LINE_FIT, "count", "float64", "Sum of a lamp line over bands"),
    Variable("line_covariance", (*_LINE_FIT, "parameter", "other_parameter"), "", "float64", "Covariance of centre [band], instrument width [band], area [count] and offset [count] of a lamp line"),
    Variable("line_trusted", _LINE_FIT, "", "bool", "Whether a lamp line entered the calibration"),
    Variable("beam_centre", (STEP,), "1", "float64", "Column at the centre of the beam"),
    Variable("beam_fwhm", (STEP,), "1", "float64", "Full width at half maximum of the beam in columns"),
    Variable("out_of_band", (STEP,), "1", "float64", "Share of the counts of a lamp line outside its peak"),
    Variable("second_order", (STEP,), "1", "float64", "Counts at twice the wavelength relative to the lamp line"),
    # --- a traced scene: weights of paths of light, before any spectrum
    Variable("transport_weight", _PATH, "1", "float32", "Weight of a path of light: radiance is the sum of weight x irradiance / pi x its reflectances"),
    Variable("transport_path", _PATH, "", "int64", "Source and reflectances of a path of light, as a code; -1 without a path", gap=-1),
    Variable("distance", _PIXEL, "m", "float32", "Distance from the camera to the observed point"),
    Variable("material", _PIXEL, "", "int32", "Material with the largest share of a pixel; -1 for the sky", gap=-1),
    Variable("instance", _PIXEL, "", "int32", "Instance with the largest share of a pixel; -1 for the sky", gap=-1),
    Variable("surface_class", _PIXEL, "", "int16", "Semantic class with the largest share of a pixel; -1 for the sky", gap=-1),
    Variable("paint_id", _PIXEL, "", "int16", "Spectrum of the paint with the largest share of a pixel; -1 without paint", gap=-1),
    Variable("car_id", _PIXEL, "", "int32", "Instance number of the car with the largest share of a pixel; -1 without a car", gap=-1),
    Variable("purity", _PIXEL, "1", "float32", "Share of a pixel that its material and instance cover"),
    Variable("sun_visibility", _SUN_PIXEL, "1", "float32", "Share of a pixel that sees the sun"),
    Variable("sun_incidence", _SUN_PIXEL, "1", "float32", "Cosine of the angle between surface normal and sun, 0 where turned away"),
    Variable("east", _PIXEL, "m", "float64", "East coordinate of the observed point"),
    Variable("north", _PIXEL, "m", "float64", "North coordinate of the observed point"),
    Variable("up", _PIXEL, "m", "float64", "Height coordinate of the observed point"),
    Variable("sun_zenith", (SUN,), "degree", "float64", "Angle between the sun and the vertical", coordinate=True),
    Variable("sun_azimuth", (SUN,), "degree", "float64", "Direction of the sun, clockwise from north", coordinate=True),
    # --- light of a rendered pixel
    Variable("sun_share", _PIXEL, "1", "float32", "Share of the light that came from the sun"),
    Variable("sky_share", _PIXEL, "1", "float32", "Share of the light that came from the sky"),
    Variable("glint_share", _PIXEL, "1", "float32", "Share of the light that is the mirror image of the sun in the observed surface"),
    Variable("mirrored_sky_share", _PIXEL, "1", "float32", "Share of the light that is the mirror image of the sky in the observed surface"),
    Variable("indirect_share", _PIXEL, "1", "float32", "Share of the light that other surfaces scattered before the observed surface"),
    Variable("shadow", _PIXEL, "1", "float32", "Share of a pixel that does not see the sun"),
    # --- inputs of flags
    Variable("glint_fraction", _PIXEL, "1", "float32", "Mirror image of the sun, as reflectance under the sun alone"),
    Variable("blocked_direct", _PIXEL, "1", "float32", "Missing part of the direct light; negative for a surface tilted towards the sun"),
    Variable("adjacency", _PIXEL, "1", "float32", "Largest reflectance, in any channel, that coloured neighbours add"),
    Variable("adjacency_segment", _PIXEL, "", "int32", "Segment of the scene model with the largest part of adjacency; -1 for none", gap=-1),
    Variable("mirrored_sky", _PIXEL, "1", "float32", "Mirror image of the sky, minus that of the rest of the body"),
    # --- detections of searched paints
    Variable("detection_score", _PIXEL, "1", "float32", "Score of the most likely paint of a pixel"),
    Variable("best_paint", _PIXEL, "", "int16", "Number of the most likely paint of a pixel; -1 where values are missing", gap=-1),
    Variable("paint_distance", _PIXEL, "1", "float32", "Residual of a pixel after a scaled paint and the mirrored sky, relative to the paint"),
    Variable("paint_level", _PIXEL, "1", "float32", "Scale of the paint that fits a pixel"),
    Variable("detected", _PIXEL, "", "bool", "Whether a searched paint was detected in a pixel"),
    Variable("score_threshold", (SIGNATURE,), "1", "float64", "Smallest score for a detection of a paint"),
    Variable("distance_limit", (SIGNATURE,), "1", "float64", "Largest paint_distance for a detection of a paint; 0 where other paints are too similar"),
    Variable("checked_rate", (), "1", "float64", "Share of the background above thresholds from other parts of the line"),
    Variable("checked_rate_u", (), "1", "float64", "Half of the 95 % interval of checked_rate"),
    Variable("explained_share", (), "1", "float64", "Share of the valid pixels that fit a paint and are left out of the background"),
    # --- where a cell of a map lies in its flight line
    Variable("glt_line", _CELL, "1", "float64", "Line at the centre of a cell, with the fraction to the next line"),
    Variable("glt_sample", _CELL, "1", "float64", "Column at the centre of a cell, with the fraction to the next column"),
    Variable("nearest_line", _CELL, "1", "int32", "Line of the pixel nearest to a cell"),
    Variable("nearest_sample", _CELL, "1", "int32", "Column of the pixel nearest to a cell"),
    Variable("hits", _CELL, "1", "uint16", "Number of times that a flight line covers a cell"),
    Variable("gap", _CELL, "", "bool", "Whether a cell between the ends of the lines has no data"),
    # --- line shapes measured sample by sample (srf_shape = "tabulated")
    Variable("srf_offset", ("srf_offset",), "nm", "float64", "Distance from the centre of a band", coordinate=True),
    Variable("srf", (BAND, "srf_offset"), "1", "float64", "Line shape of a band, any scale"),
    # --- effects of the detector on counts
    Variable("masked", (CROSS_TRACK,), "", "bool", "Whether an element receives no light, so that its dark-subtracted counts are the pedestal of a line", alternatives=(ELEMENT, (BAND,))),
    Variable("linearity_counts", ("linearity_counts",), "count", "float64", "Counts, raw or dark-subtracted, at which linear_counts was measured", coordinate=True),
    Variable("linear_counts", ("linearity_counts",), "count", "float64", "Counts proportional to light, equal to measured counts at low light"),
    Variable("linearity_basis", ("linearity_term", "linearity_counts"), "1", "float64", "Functions of counts by which the linear counts of elements differ, relative to the counts"),
    Variable("linearity_map", ("linearity_term", *ELEMENT), "1", "float32", "Coefficients of linearity_basis of an element"),
    Variable("stray_light_u", (), "1", "float32", "Relative standard uncertainty of the light that is subtracted as stray light and smear"),
    Variable("band_shift_time", (), "s", "float64", "Time in which a frame is shifted by one band under the light; attribute bands: number of bands"),
    Variable("linearity_u", (), "1", "float32", "Relative standard uncertainty that linearity leaves in linear counts"),
)

#: A lab sweep: its counts are means, on other dims than the counts of a flight line.
_SWEEP_TABLE = (
    Variable("counts", _SWEEP, "count", "float32", "Counts, mean of the frames of a step, dark not subtracted"),
    Variable("counts_variance", _SWEEP, "count2", "float32", "Variance of one frame over the frames of a step"),
    Variable("dark_counts", ELEMENT, "count", "float32", "Counts without light", alternatives=(_SWEEP,)),
    Variable("dark_exposure_time", (), "s", "float64", "Exposure time of the dark reference", alternatives=((STEP,),)),
    Variable("frame_count", (), "1", "int64", "Frames averaged in a step", alternatives=((STEP,),)),
    Variable("dark_frame_count", (), "1", "int64", "Frames averaged in a dark reference", alternatives=((STEP,),)),
    Variable("step_wavelength", (STEP,), "nm", "float64", "Wavelength of the monochromator", coordinate=True),
    Variable("flux", (STEP,), "W", "float64", "Radiant flux of the whole beam, equal in all lit columns", alternatives=(_LINE_FIT,)),
    Variable("capture_fraction", (), "1", "float64", "Share of flux that enters slit width by one column, all bands", alternatives=((STEP,), _LINE_FIT)),
    Variable("level", (STEP,), "1", "float64", "Light of a lamp or sphere, in any constant proportion to it"),
    Variable("exposure_time", (), "s", "float64", "Exposure time", alternatives=((STEP,),)),
    Variable("monochromator_fwhm", (), "nm", "float64", "Full width at half maximum of the monochromator", alternatives=((STEP,),)),
    Variable("etendue", (), "m2 sr", "float64", "Filled slit width times pixel pitch times projected solid angle", alternatives=((CROSS_TRACK,),)),
)

#: A paint library, whose spectra are on other dims than those of a flight line.
_LIBRARY_TABLE = (
    Variable("signature", (SIGNATURE,), "", "str", "Name of the signature and of its region", coordinate=True),
    Variable("reflectance", _SPECTRUM, "1", "float32", "Hemispherical-conical reflectance factor, centre of the pixels used"),
    Variable("reflectance_sd", _SPECTRUM, "1", "float32", "Standard deviation of reflectance over the pixels used"),
    Variable("reflectance_quantiles", (SIGNATURE, QUANTILE, BAND), "1", "float32", "Quantiles of reflectance over the pixels used"),
    Variable("reflectance_u_random", _SPECTRUM, "1", "float32", "Random standard uncertainty of the mean reflectance"),
    Variable("reflectance_u_systematic", _SPECTRUM, "1", "float32", "Systematic standard uncertainty of the mean reflectance"),
    Variable("reflectance_errors", (SIGNATURE, ERROR_SOURCE, BAND), "1", "float32", "Standard uncertainty of the mean reflectance by each source of error; with its sign where all bands share the error"),
    Variable("error_correlation", (SIGNATURE, LAG, BAND), "1", "float32", "Correlation of the partly shared error of a band with the band ``lag`` after it"),
    Variable(ERROR_SOURCE, (ERROR_SOURCE,), "", "str", "Source of an error", coordinate=True),
    Variable(LAG, (LAG,), "1", "int64", "Distance in bands", coordinate=True),
    Variable("error_form", (ERROR_SOURCE,), "", "str", "Correlation form of the error in each dim, in the terms of FIDUCEO and obsarray", coordinate=True),
    Variable("member_reflectance", (SIGNATURE, MEMBER, BAND), "1", "float32", "Reflectance of single pixels, of paints with flakes at the stated geometry; NaN beyond the last"),
    Variable("member_along_track", (SIGNATURE, MEMBER), "1", "int64", "Line of a member, -1 beyond the last", gap=-1),
    Variable("member_cross_track", (SIGNATURE, MEMBER), "1", "int64", "Column of a member, -1 beyond the last", gap=-1),
    Variable("n", (SIGNATURE,), "1", "int64", "Pixels used"),
    Variable("n_eff", (SIGNATURE,), "1", "float64", "Independent pixels among those used"),
    Variable("n_excluded", (SIGNATURE,), "1", "int64", "Pixels of the region that were left out"),
    Variable("quality", (SIGNATURE,), "", "uint16", "Quality flags of the pixels used", gap=2048),
    Variable("quality_share", (SIGNATURE, FLAG), "1", "float32", "Share of the region's pixels that have a flag, used or not"),
    Variable("sun_zenith", (SIGNATURE,), "degree", "float64", "Zenith angle of the sun", standard_name="solar_zenith_angle"),
    Variable("sun_azimuth", (SIGNATURE,), "degree", "float64", "Azimuth of the sun, clockwise from north", standard_name="solar_azimuth_angle"),
    Variable("view_zenith", (SIGNATURE,), "degree", "float64", "Angle between the vertical and the mean direction to the camera", standard_name="sensor_zenith_angle"),
    Variable("view_azimuth", (SIGNATURE,), "degree", "float64", "Mean direction to the camera, clockwise from north", standard_name="sensor_azimuth_angle"),
    Variable("relative_azimuth", (SIGNATURE,), "degree", "float64", "Angle between the azimuths of sun and camera, 0 where the sun is behind the camera"),
    Variable("diffuse_fraction", _SPECTRUM, "1", "float32", "Diffuse part of the irradiance on level ground"),
    Variable("diffuse_fraction_u", _SPECTRUM, "1", "float32", "Standard uncertainty of diffuse_fraction"),
    Variable("sky_state", (SIGNATURE,), "", "int8", "Kind of sky in the irradiance record", gap=-1),
    Variable("coat_transmission", _SPECTRUM, "1", "float32", "Transmission of a clear coat for light of the body, relative to its transmission near the normal"),
    Variable("coat_transmission_u", _SPECTRUM, "1", "float32", "Standard uncertainty of coat_transmission"),
    Variable("aspecular_angle", (SIGNATURE,), "degree", "float64", "Angle between the view and the mirror direction of the sun on a level surface"),
    Variable("aspecular_range", (SIGNATURE,), "degree", "float64", "Largest difference of aspecular_angle within the region"),
    Variable("flop", _SPECTRUM, "1", "float32", "Relative change of reflectance from the dark to the bright end of the region"),
    Variable("reflectance_u_coat", _SPECTRUM, "1", "float32", "Standard uncertainty of reflectance by the subtracted coat reflection and mirrored sky, common to the pixels of a paint"),
    Variable("quantity", (SIGNATURE,), "", "str", "Quantity that reflectance of the paint is; a body under a coat only of solid paint", coordinate=True),
    Variable("lean", (SIGNATURE,), "degree", "float64", "Standard deviation of the unknown lean of the body part in each direction", coordinate=True),
    Variable("level_uncertainty", (SIGNATURE,), "1", "float64", "Relative standard uncertainty of the level of reflectance", coordinate=True),
    Variable("level_terms", (SIGNATURE,), "", "str", "Parts of level_uncertainty by cause, as JSON", coordinate=True),
    Variable("coat_strength", (SIGNATURE,), "1", "float64", "Mirrored sky relative to the prediction from the index of the coat, from differences between pixels"),
    Variable("coat_strength_u", (SIGNATURE,), "1", "float64", "Standard uncertainty of coat_strength"),
    Variable("coat_strength_reason", (SIGNATURE,), "", "str", "Reason for a missing coat_strength; empty where it is present", coordinate=True),
    Variable("irradiance_age", (SIGNATURE,), "s", "float32", "Longest time from a line to the nearest irradiance sample"),
    Variable("time", (SIGNATURE,), "", "datetime64[ns]", "Mean UTC of the pixels used", standard_name="time", coordinate=True),
    Variable("flightline", (SIGNATURE,), "", "str", "Flight line of the region", coordinate=True),
    Variable("region", (SIGNATURE,), "", "str", "The region as a Feature of GeoJSON", coordinate=True),
    Variable(QUANTILE, (QUANTILE,), "1", "float64", "Share of the used pixels below the quantile", coordinate=True),
    Variable(FLAG, (FLAG,), "", "str", "Name of a quality flag", coordinate=True),
)
# fmt: on


def _table(rows: tuple[Variable, ...], *line_names: str) -> Mapping[str, Variable]:
    # Return the rows by name, with the rows of the flight-line table named in `line_names` appended.
    shared = tuple(variable for variable in _LINE_TABLE if variable.name in line_names)
    return {variable.name: variable for variable in rows + shared}


#: Variables of a flight line, its calibration and light, its scenes and maps.
VARIABLES = _table(_LINE_TABLE)

#: Variables of a lab sweep.
SWEEP_VARIABLES = _table(
    _SWEEP_TABLE, "saturation_count", "electrons_per_count", "read_noise", "band_shift_time"
)

#: Variables of a paint library.
LIBRARY_VARIABLES = _table(_LIBRARY_TABLE, "wavelength", "fwhm", "good")


#: Version of the layout on disk, repeated in every group as ``hyperpaint_format``: 3 has one manifest; 2 (of
#: 0.2) had a record in every array's folder and one in the root; 1 (of 0.1) had none in the root.
FORMAT_VERSION = 3

#: Lines in one storage chunk, and in one task on threads (see docs/explanation/design.md).
CHUNK_LINES = 32

TIME_UNITS = "nanoseconds since 1970-01-01"

#: Line shapes of a monochromator, named by the attribute ``monochromator_shape`` of a sweep.
MONOCHROMATOR_SHAPES = ("gaussian", "triangle")

#: Line shapes of a band, named by the dataset attribute ``srf_shape``.
SRF_SHAPES = ("gaussian", "slit", "tabulated")

#: Names of our dims in other packages, in lower case.
DIM_ALIASES: Mapping[str, tuple[str, ...]] = {
    ALONG_TRACK: ("line", "lines", "downtrack", "y", "frame"),
    BAND: ("bands", "wavelength", "wavelengths", "channel"),
    CROSS_TRACK: ("sample", "samples", "crosstrack", "x", "column"),
}


# Rooms that set flags: radiometry, light, surroundings, geometry.
_Source = Literal["counts", "light", "scene", "map"]


class Quality(IntFlag):
    """Bits of ``quality``; a bit set early is still set in every later product.

    A flag declares its ``source``, ``colour`` in pictures, ``condition``, and the fate of its ``samples``.

    Examples
    --------
    >>> import numpy as np
    >>> quality = np.uint16([0, 64, 65])
    >>> (quality & Quality.GLINT) != 0
    array([False,  True,  True])
    >>> Quality(65)
    <Quality.SATURATED|GLINT: 65>
    """

    source: _Source
    # The same in all pictures. Palettes for colour-blind readers have 8 colours (Okabe and Ito) or 10 (Tol),
    # flags are 13: these were searched so that any two differ by 15 or more in CIEDE2000, also as protanopes
    # and deuteranopes see them (Machado et al., IEEE Trans. Vis. Comput. Graph. 15, 1291, 2009).
    colour: str
    condition: str
    samples: str  # fate of the samples of a flagged pixel

    # Type checkers want the defaults in Quality(65).
    def __new__(
        cls,
        bit: int,
        source: _Source = "counts",
        colour: str = "",
        condition: str = "",
        samples: str = "kept",
    ) -> "Quality":
        flag = int.__new__(cls, bit)
        flag._value_ = bit
        flag.source, flag.colour, flag.condition, flag.samples = source, colour, condition, samples
        return flag

    SATURATED = 1, "counts", "#ff3300", "a band within 16 counts of the converter's maximum", "the band NaN"
    BELOW_DARK = 2, "counts", "#330080", "counts below the dark, by 5 sigma of noise or in over 10 % of bands"
    BAD_DETECTOR = 4, "counts", "#808080", "over 5 % of the good bands have a bad element", "bad elements NaN"
    IRRADIANCE_GAP = 8, "light", "#80334d", "outside the record, or in a gap over `irradiance_max_gap`", "NaN"
    ILLUMINATION_UNSTABLE = 16, "light", "#e6ffb3", "irradiance changes by over 2 % between two samples"
    LOW_SUN = 32, "light", "#990000", "sun more than 75 degrees from the zenith"
    GLINT = 64, "scene", "#4de6cc", "the sun mirrored by the clear coat adds over 4 % to the other light"
    SHADOW = 128, "scene", "#0033ff", "over 20 % of direct sunlight blocked on the ground, 60 % on objects"
    ADJACENCY = 256, "scene", "#9980ff", "light of neighbours adds over 0.01 to the reflectance of a band"
    MIXED_EDGE = 512, "scene", "#66b380", "the pixel contains an edge between surfaces"
    OFF_SWATH = 1024, "map", "#99ccff", "no pixel covers this cell of a map", "NaN"
    NO_DATA = 2048, "counts", "#000000", "a dropped frame, or NaN counts", "NaN"
    TIMING_SENSITIVE = 4096, "light", "#e6cc00", "irradiance changes by over 1 % within the clock uncertainty"

    def __invert__(self) -> "Quality":
        # Python below 3.11.4 loses the upper bits, since the members have values of several parts
        return Quality(sum(Quality) & ~int(self))


def flag_names(bits: int = -1) -> list[str]:
    """Return the lower-case names of the flags that are set in ``bits``; by default of all flags.

    Examples
    --------
    >>> flag_names(Quality.GLINT | Quality.MIXED_EDGE)
    ['glint', 'mixed_edge']
    """
    return [str(flag.name).lower() for flag in Quality if flag & bits]


def flags_set_from(*sources: _Source) -> Quality:
    """Return the bits of all flags from some sources.

    Examples
    --------
    >>> flag_names(flags_set_from("scene"))
    ['glint', 'shadow', 'adjacency', 'mixed_edge']
    """
    return Quality(sum(flag for flag in Quality if flag.source in sources))


def flag_shares(quality: np.ndarray[Any, Any]) -> dict[Quality, float]:
    """Return the share of pixels with every flag that occurs.

    Examples
    --------
    >>> import numpy as np
    >>> flag_shares(np.array([[1, 0], [65, 0]], np.uint16))
    {<Quality.SATURATED: 1>: 0.5, <Quality.GLINT: 64>: 0.25}
    """
    counts = {flag: int(((quality & int(flag)) != 0).sum()) for flag in Quality}
    return {flag: count / quality.size for flag, count in counts.items() if count}


def flags_named(names: Iterable[str]) -> list[Quality]:
    # Return flags by their names, in any case.
    #
    # Raises `SchemaError`: There is no such flag; all unknown names are listed.
    by_name = dict(zip(flag_names(), Quality, strict=True))
    names = list(names)
    SchemaError.raise_if(
        unknown := [name for name in names if name.lower() not in by_name],
        f"no flag {', '.join(map(repr, unknown))}",
        expected=f"some of {', '.join(by_name)}",
        code="choice-unknown",
    )
    return [by_name[name.lower()] for name in names]


def rename_to_roles(dataset: xr.Dataset, dims: Mapping[str, Hashable] | None = None) -> xr.Dataset:
    # Return ``dataset`` with its dims named by role: ``along_track``, ``band``, ``cross_track``.
    #
    # Quantities become numbers (`hyperpaint.base.facts.plain`), and coordinates along one dim are converted
    # to the units of the table. Side effects of `where` and `concat` are undone: dims that they added to
    # variables which do not vary along them, and flags that became floats.
    #
    # ``dataset``: Any dataset with a cube. ``dims``: Role to dim name, for names that `DIM_ALIASES` does not
    # know.
    #
    # Raises `SchemaError`: ``dims`` names a role or a dim that does not exist; a dim of the cube has size 0;
    # or arrays are of cubed or cupy.
    # arrays of other packages look like numpy's or dask's; none of the packages is imported here
    for array_name, variable in dataset.variables.items():
        row = VARIABLES.get(str(array_name))
        # times of a file opened with decode_times=False
        if row and row.dtype == TIME and " since " in str(variable.attrs.get("units")):
            with contextlib.suppress(ValueError):  # units that are not a time; `require` refuses numbers
                dataset = dataset.assign(
                    {array_name: xr.conventions.decode_cf_variable(array_name, variable)}
                )
        data = variable._data
        for array in (data, getattr(data, "_meta", None)):  # a dask array of such arrays
            package = type(array).__module__.partition(".")[0]
            SchemaError.raise_if(
                package in _FOREIGN_ARRAYS,
                f"{array_name!r} is an array of {package}",
                expected="numpy or dask",
                mend=_FOREIGN_ARRAYS.get(package, ""),
                code="array-foreign",
            )
    # maps in degrees, such as those of EMIT-tools
    for north, east in (("latitude", "longitude"), ("lat", "lon")):
        if {north, east} <= set(dataset.dims):
            dataset = dataset.rename({north: "y", east: "x"})
    # lines and times vary from cell to cell of a map
    is_map = {"y", "x"} <= {*dataset.dims, *dataset.coords} or "spatial_ref" in dataset.variables
    dataset = _with_table_units(plain(dataset))
    names: dict[Hashable, Hashable] = {}
    for role, name in (dims or {}).items():
        SchemaError.raise_if(
            role not in CUBE or name not in dataset.dims,
            f"dims={{{role!r}: {name!r}}}",
            expected=f"roles {list(CUBE)} and dims of the dataset {list(map(str, dataset.dims))}",
            code="dim-missing",
        )
        names[name] = role
    for role, aliases in DIM_ALIASES.items():
        if role in dataset.dims or role in names.values():
            continue
        index = next(
            (dim for dim in dataset.dims if dim in VARIABLES and VARIABLES[str(dim)].dims == (role,)), None
        )
        if index is not None and role in dataset.coords:  # after swap_dims(along_track="time")
            dataset = dataset.swap_dims({index: role})
            continue
        names_of_role = (role, *aliases)
        alias = next((d for d in dataset.dims if str(d).lower() in names_of_role and d not in names), None)
        if alias is not None:
            names[alias] = role
    # a dim `wavelength` with a coordinate of that name becomes the coordinate wavelength(band)
    indexed = [name for name, role in names.items() if role == BAND and name in dataset.coords]
    if indexed:
        dataset = dataset.reset_index(indexed)
    names = {old: new for old, new in names.items() if old != new}
    dataset = dataset.rename_dims(names) if names else dataset
    if "wavelength" not in dataset.variables:  # the only axis of wavelengths of another name
        axes = [
            name
            for name, variable in dataset.variables.items()
            if variable.dims == (BAND,)
            and (
                str(name).lower() in _WAVELENGTH_NAMES
                or variable.attrs.get("standard_name") == "radiation_wavelength"
            )
        ]
        if len(axes) == 1:
            renamed = _with_table_units(dataset.rename({axes[0]: "wavelength"}).set_coords("wavelength"))
            dataset = renamed.drop_indexes("wavelength", errors="ignore")
    for dim, item in zip(CUBE, ("line", "band", "column"), strict=True):
        SchemaError.raise_if(
            dataset.sizes.get(dim) == 0,
            f"nothing is selected: {dim} has size 0",
            expected=f"one {item} or more",
            mend="widen the slice, mask or wavelength range",
            code="selection-empty",
        )
    SchemaError.raise_if(
        "good" in dataset.variables and dataset["good"].dtype.kind in "UST",  # "False" would count as good
        "'good' holds text",
        expected="true or false for every band",
        mend="line.assign_coords(good=line.good == 'True')",
        code="type-wrong",
    )
    return with_integer_dtypes(dataset) if is_map else _with_table_dims(dataset)


#: Names of wavelengths in cubes of other programs, in lower case.
_WAVELENGTH_NAMES = (
    "wavelengths",
    "wavelength",
    "wvl",
    "wl",
    "wave",
    "center_wavelength",
    "centre_wavelength",
)
_ELEMENT_VARIABLES = ("dark_counts", "radiance_gain")
_WHOLE_LINE_VARIABLES = ("overview", "coarse_reflectance")


def _with_table_dims(dataset: xr.Dataset) -> xr.Dataset:
    # `where` and `concat` change dims and integers. Lazy arrays stay lazy: that they are constant along a
    # removed dim is checked when they are computed.
    changed: dict[Hashable, xr.Variable] = {}
    dropped = []
    # after where() on counts, darks and gain have the dims of the cube: `require` refuses them and names isel
    is_masked = "counts" in dataset.variables and dataset.variables["counts"].dtype.kind == "f"
    for name, variable in dataset.variables.items():
        row = VARIABLES.get(str(name))
        if row is None or not set(variable.dims) & set(CUBE) or (is_masked and name in _ELEMENT_VARIABLES):
            continue
        if name not in _WHOLE_LINE_VARIABLES:
            reduced = _without_added_dims(variable, row)
            changed |= {} if reduced is variable else {name: reduced}
        elif not set(variable.dims) <= set(row.dims):
            dropped.append(name)  # it describes the whole line, not this selection
    if "quality" in dataset.variables and _is_averaged(dataset):
        dropped.append("quality")
        warn_user(
            "flags of 'quality' are means over pixels, and are left out; choose pixels by their flags "
            "before averaging",
            "flags-averaged",
        )
    dataset = dataset.drop_vars(dropped) if dropped else dataset
    return with_integer_dtypes(dataset.assign(changed) if changed else dataset)


def _is_averaged(dataset: xr.Dataset) -> bool:
    # coarsen and interp average flags over pixels.
    quality = dataset.variables["quality"]
    return quality.dtype.kind == "f" and (
        any(dim in dataset.coords and dataset[dim].dtype.kind == "f" for dim in (ALONG_TRACK, CROSS_TRACK))
        or (quality.chunks is None and bool((np.nan_to_num(quality.values) % 1.0 != 0.0).any()))
    )


def _without_added_dims(variable: xr.Variable, row: Variable) -> xr.Variable:
    # Drop the dims of a cube along which a variable is constant; missing values are ignored.
    dims = set(variable.dims)
    fitting = [shape for shape in row.allowed_dims if set(shape) < dims and dims - set(shape) <= set(CUBE)]
    if not fitting or any(dims == set(shape) for shape in row.allowed_dims):
        return variable
    if variable.dtype == object and row.dtype == "bool":  # with gaps
        variable = variable.astype(np.float32)
    if variable.dtype.kind not in "biufmM":
        return variable
    added = [dim for dim in variable.dims if dim not in max(fitting, key=len)]
    low, high = variable.min(added), variable.max(added)
    if low._in_memory and high._in_memory:
        if not ((low == high) | low.isnull()).all():
            return variable
    else:
        import dask.array as da

        constant = da.map_blocks(
            _constant, low.data, high.data, name_of=row.name, dims=added, dtype=low.dtype, meta=low.data._meta
        )
        low = low.copy(data=constant)
    low.attrs = variable.attrs
    return low


def _constant(low: Any, high: Any, *, name_of: str, dims: list[str]) -> Any:
    # Return the minima, which must equal the maxima.
    SchemaError.raise_if(
        not ((low == high) | (low != low)).all(),
        f"{name_of!r} differs along {' and '.join(dims)}",
        mend="choose by .sel() or .isel() where where(..., drop=True) or xr.concat gave it that dim",
        code="dims-wrong",
    )
    return low


def with_integer_dtypes(dataset: xr.Dataset, table: Mapping[str, Variable] = VARIABLES) -> xr.Dataset:
    # Return flags, indices and classes as integers where `where` made them floats; lazy arrays stay lazy.
    #
    # Missing values become the ``gap`` of the table: `Quality.NO_DATA` in flags, -1 or 0 in indices. Counts
    # and index coordinates stay floats: both may be fractions.
    changed = {}
    for name, row in table.items():
        variable = dataset.variables.get(name)
        if (
            variable is None
            or variable.dtype.kind not in "fO"
            or row.dtype in ("str", TIME)
            or np.dtype(row.dtype).kind not in "iub"
            or name == "counts"
            or variable.dims == (name,)
        ):
            continue
        integers = functools.partial(_integers, gap=row.gap, dtype=row.dtype)
        changed[name] = (
            variable.copy(data=integers(variable.values))
            if variable.chunks is None
            else variable.copy(data=variable.data.map_blocks(integers, dtype=row.dtype))
        )
    return dataset.assign(changed) if changed else dataset


def _integers(values: Any, *, gap: int, dtype: str) -> Any:
    numbers = np.asarray(values, np.float64)
    return np.where(np.isfinite(numbers), np.rint(numbers), gap).astype(dtype)


_FOREIGN_ARRAYS = {
    "cubed": "map hyperpaint.slab over its blocks (docs/howto/engines.md), or open with dask or chunks=None",
    "cupy": "take it from the GPU first, by dataset.as_numpy() or array.get(): the kernels run on the CPU",
}


#: Attribute of ``radiance_gain``: names of the other variables of the calibration that change values.
CALIBRATION_NAMES = "calibration_variables"

_CALIBRATION_VARIABLES = (
    "wavelength_shift",
    "good",
    "masked",
    "linear_counts",
    "linearity_map",
    "stray_light",
    "stray_light_across",
    "band_shift_time",
    "srf",
)


def with_calibration_names(line: xr.Dataset) -> xr.Dataset:
    # Return a flight line whose gain lists the other calibration variables, so that a loss is noticed.
    if "radiance_gain" not in line.variables:
        return line
    names = " ".join(name for name in _CALIBRATION_VARIABLES if name in line.variables)
    return line.assign(radiance_gain=line["radiance_gain"].assign_attrs({CALIBRATION_NAMES: names}))


def warn_of_lost_calibration(line: xr.Dataset, purpose: str) -> None:
    # Warn of calibration variables that the gain names and the line lacks, as after ``drop_vars``.
    gain = line.variables.get("radiance_gain")
    names = str(gain.attrs.get(CALIBRATION_NAMES, "")).split() if gain is not None else []
    missing_names = [name for name in names if name in _CALIBRATION_VARIABLES and name not in line.variables]
    if missing_names:
        smile = " (smile is not corrected)" if "wavelength_shift" in missing_names else ""
        warn_user(
            f"{purpose} is computed without {', '.join(map(repr, missing_names))}, which the calibration "
            f"of this line has; keep them beside 'radiance_gain'{smile}",
            "calibration-incomplete",
        )


def with_numbers(line: xr.Dataset) -> xr.Dataset:
    # Return a flight line with index coordinates that number its lines and columns.
    #
    # A crop keeps its numbers; ``band`` has no numbers, since xarray would align two cameras by them.
    numbers = {dim: np.arange(line.sizes[dim]) for dim in (ALONG_TRACK, CROSS_TRACK) if dim in line.dims}
    return line.assign_coords(
        {
            dim: (dim, values, VARIABLES[dim].attrs)
            for dim, values in numbers.items()
            if dim not in line.coords
        }
    )


def numbers_of(line: xr.Dataset, dim: str) -> Floats:
    # Return the numbers of a flight line's lines or columns: its index coordinate, else 0, 1, 2 ...
    #
    # A crop keeps the numbers of the whole line, so that regions of the whole line fit it.
    return (
        np.asarray(line[dim].values, np.float64)
        if dim in line.coords and line[dim].dims == (dim,) and line[dim].dtype.kind in "iuf"
        else np.arange(line.sizes[dim], dtype=np.float64)
    )


def good_bands(dataset: xr.Dataset) -> Bools:
    # Return which bands are good (band,): all bands of a dataset without ``good``
    good = dataset.variables.get("good")
    return np.ones(dataset.sizes.get(BAND, 1), bool) if good is None else np.asarray(good.values, bool)


def label_digest(line: xr.Dataset, dims: tuple[str, ...] = _PIXEL) -> str:
    # Return a digest of the labels of lines and columns, which tells crops and other orders of a line apart.
    #
    # Empty where one of the dims has no index coordinate.
    numbers = [numbers_of(line, dim).tobytes() for dim in dims if dim in line.indexes]
    return hashlib.sha256(b"".join(numbers)).hexdigest()[:16] if len(numbers) == len(dims) else ""


def has_labels_of(product: Any, line: xr.Dataset, dims: tuple[str, ...] = _PIXEL) -> bool:
    # Return whether the attribute ``labels`` of a product of a line may be the digest of this line.
    #
    # True without labels on both sides, as for products of older versions.
    return len({label_digest(line, dims), str(product.attrs.get("labels", ""))} - {""}) < 2


def refuse_other_labels(
    argument: Any, line: Any, name: str, dims: tuple[str, ...] = _PIXEL, of: str = "the flight line"
) -> None:
    # Refuse an argument of the size of the line with other labels, since values are combined by position.
    for dim in dims:
        labels = [array.indexes[dim] for array in (argument, line) if dim in array.indexes]
        SchemaError.raise_if(
            len(labels) == 2 and len(labels[0]) == len(labels[1]) and not labels[0].equals(labels[1]),
            f"{name}: its labels {dim!r} differ from those of {of}",
            mend=f"select the same pixels of both in the same order, or drop its coordinate {dim!r}",
            code="grid-mismatch",
        )


def pixel_mask(mask: Any, line: xr.Dataset, name: str) -> Any:
    # Return an argument that selects pixels as a bool array (line, column) of the line, lazy where it is.
    if hasattr(mask, "dims"):
        labelled = rename_to_roles(mask.to_dataset(name="mask"))["mask"]
        SchemaError.raise_if(
            set(labelled.dims) != set(_PIXEL),
            f"{name} has dims {mask.dims}",
            expected="lines and columns",
            code="dims-wrong",
        )
        refuse_other_labels(labelled, line, name)
        mask = labelled.transpose(*_PIXEL).data
    mask, shape = (
        mask if hasattr(mask, "dtype") else np.asarray(mask),
        tuple(line.sizes[dim] for dim in _PIXEL),
    )
    SchemaError.raise_if(
        mask.shape != shape or mask.dtype != bool,
        f"{name} is {mask.dtype} of shape {mask.shape}",
        expected=f"bool of shape {shape}",
        code="grid-mismatch",
    )
    return mask


def with_steps(sweep: xr.Dataset) -> xr.Dataset:
    # Return a lab sweep whose dim ``step`` replaces a dim of its wavelengths, as of ``swap_dims``.
    is_swapped = STEP not in sweep.dims and "step_wavelength" in sweep.dims
    return sweep.rename_dims(step_wavelength=STEP) if is_swapped else sweep


def _with_table_units(dataset: xr.Dataset) -> xr.Dataset:
    converted = {}
    for name in (str(name) for name in dataset.coords if name in VARIABLES):
        variable, table_units = dataset.variables[name], VARIABLES[name].units
        units = variable.attrs.get("units", table_units)
        if table_units != units and variable.ndim < 2 and same_dimension(str(units), table_units):
            converted[name] = convert(dataset[name], table_units).variable
    return dataset.assign_coords(converted) if converted else dataset


def quality_attrs() -> dict[str, Any]:
    return {
        **VARIABLES["quality"].attrs,
        "flag_masks": np.array([int(flag) for flag in Quality], dtype=np.uint16),
        "flag_meanings": " ".join(flag_names()),
    }


def label(array: xr.DataArray, name: str, **extra: Any) -> xr.DataArray:
    # Return ``array`` with the name and attributes of the table, which replace its old ones.
    attrs = quality_attrs() if name == "quality" else VARIABLES[name].attrs
    labelled = array.rename(name).copy(deep=False)  # rename alone would share the attributes
    labelled.attrs = {**attrs, **extra}
    return labelled


def require(
    dataset: xr.Dataset, names: Iterable[str], purpose: str, table: Mapping[str, Variable] = VARIABLES
) -> dict[str, xr.DataArray]:
    # Return the named variables, in the units and dim order of the table.
    #
    # Reads dims, dtypes and attributes only, never values.
    #
    # ``dataset``: Holds the variables. ``names``: Rows of the table that are needed. ``purpose``: Product
    # that cannot be computed without them; opens the message. ``table``: `VARIABLES`, `SWEEP_VARIABLES` for a
    # lab sweep, or `LIBRARY_VARIABLES` for a paint library.
    #
    # Raises `SchemaError`: Variables are missing, or have dims or units that the table does not allow; all
    # are listed.
    arrays, faults = find(dataset, names, table)
    if faults:
        raise SchemaError(f"cannot compute {purpose}", problems=faults)
    return arrays


def find(
    dataset: xr.Dataset, names: Iterable[str], table: Mapping[str, Variable] = VARIABLES
) -> tuple[dict[str, xr.DataArray], list[Problem]]:
    # Return the variables that the table accepts, as `require` does, and the faults of the rest.
    problems: list[Problem] = []
    arrays: dict[str, xr.DataArray] = {}
    for name in names:
        row = table[name]
        if name not in dataset.variables:
            shape = ", ".join(row.dims) or "a scalar"
            # variables of other programs with the dims and unit of a missing coordinate
            others = [
                repr(str(other))
                for other, variable in dataset.variables.items()
                if row.coordinate
                and other not in table
                and variable.dims == row.dims
                and same_dimension(str(variable.attrs.get("units", "1")), row.units)
            ]
            problems.append(
                Problem(
                    f"{name!r} is missing: {row.meaning.lower()} ({shape}) [{row.units or row.dtype}]",
                    mend=f"rename {' or '.join(others[:3])} to {name!r}" if others else "",
                    code="variable-missing",
                )
            )
            continue
        array = plain(dataset[name])
        fault = row.dim_problem(array) or row.unit_problem(array)
        if not fault and name == "reflectance" and array.dtype.kind in "iu":
            fault = Problem(
                f"{name!r} is {array.dtype} without scale_factor",
                expected="reflectance as a fraction",
                mend="divide it by the stored value of a reflectance of one, such as 10000",
                code="scale-missing",
            )
        if fault:
            # one call mends all variables with the same fault: the message names it once
            is_repeated = any(fault.mend == other.mend for other in problems)
            problems.append(replace(fault, mend="") if is_repeated else fault)
            continue
        array = array.transpose(*next(dims for dims in row.allowed_dims if set(dims) == set(array.dims)))
        arrays[name] = convert(array, row.units) if row.units else array
    return arrays, problems


def with_band_dim(library: xr.Dataset) -> xr.Dataset:
    # Return a library with the dim ``band``, also after ``swap_dims(band="wavelength")``.
    is_swapped = "wavelength" in library.dims and BAND not in library.dims and SIGNATURE in library.variables
    return library.swap_dims(wavelength=BAND) if is_swapped else library


def dtype_of(name: str) -> np.dtype[Any]:
    return np.dtype(VARIABLES[name].dtype)


_MEANS_STAMP = "means_of"
MAX_HASHED_BYTES = 2**24
_NOT_INPUTS = {"coarse_reflectance", "reflectance", "overview", "quality", ALONG_TRACK, CROSS_TRACK}


def stamp_means(means: xr.DataArray | xr.Variable, line: xr.Dataset) -> None:
    # Store the identities of the arrays of the line in the encoding of means computed from them.
    means.encoding[_MEANS_STAMP] = {str(name): _identity(line[name].variable) for name in line.variables}


def has_own_means(line: xr.Dataset) -> bool:
    # Return whether ``coarse_reflectance`` follows from the arrays of this line.
    stamp = line["coarse_reflectance"].encoding.get(_MEANS_STAMP)
    if stamp is None:
        return False
    names = (
        {"reflectance"}
        if "reflectance" in line.variables
        else (set(stamp) | {str(name) for name in line.variables}) - _NOT_INPUTS
    )
    identities = {name: _identity(line[name].variable) for name in names if name in line.variables}
    return all(identities.get(name) is not None and identities[name] == stamp.get(name) for name in names)


def has_own_overview(line: xr.Dataset) -> bool:
    # Return whether ``overview`` shows the lines and columns of this line in their order, and its cube.
    overview = line["overview"]
    # overviews of older versions have no digest: labels must at least increase
    indexes = [line.indexes[dim] for dim in _PIXEL if dim in line.indexes]
    is_whole = has_labels_of(overview, line) and all(index.is_monotonic_increasing for index in indexes)
    # variables that are read from a file have an encoding; computed ones have none
    cube = line.get("reflectance", line.get("counts", overview))
    return is_whole and (not overview.encoding or bool(cube.encoding))


def _identity(variable: xr.Variable) -> str | None:
    # Return None where a hash would have to read an array from a file.
    from dask.base import is_dask_collection, tokenize

    if is_dask_collection(variable):
        return str(tokenize(variable.data.name, variable.dims, variable.shape))
    # without dask, xarray opens a scalar of a store lazily
    return (
        None
        if variable.nbytes > MAX_HASHED_BYTES or (variable.ndim and not variable._in_memory)
        else str(tokenize(variable.dims, variable.values))
    )
