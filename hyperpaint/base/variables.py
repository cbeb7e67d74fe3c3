"""The one table of variables: names, dims, units, dtype and meaning.

Nothing else in the package spells a variable's units or meaning. `hyperpaint.base.schema` checks inputs against
the table, and labels outputs from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr

from .errors import Problem
from .units import same_dimension

ALONG_TRACK, BAND, CROSS_TRACK = "along_track", "band", "cross_track"
CUBE = (ALONG_TRACK, BAND, CROSS_TRACK)
"""Dims of a cube in sensor geometry, in the instrument's own order: band-interleaved by line."""

IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH = "irradiance_time", "irradiance_wavelength"
STEP = "step"
"""Dim of a lab sweep: one wavelength of the monochromator after the other."""

SUN, SLOT = "sun", "slot"
"""Dims of a traced scene: its suns, and the different paths of light that a pixel holds."""

PANEL = "panel"
"""Dim of the panels of known reflectance in a scene."""

SIGNATURE, MEMBER, QUANTILE, FLAG = "signature", "member", "quantile", "flag"
ERROR_SOURCE, LAG = "error_source", "lag"
"""Dims of a paint library."""


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
        """Attributes written with the variable."""
        attrs: dict[str, Any] = {"long_name": self.meaning}
        if self.units:
            attrs["units"] = self.units
        if self.standard_name:
            attrs["standard_name"] = self.standard_name
        return attrs

    @property
    def allowed_dims(self) -> tuple[tuple[str, ...], ...]:
        """Dims in storage order, then the alternatives."""
        return (self.dims, *self.alternatives)

    def dim_problem(self, array: xr.DataArray) -> Problem | None:
        """Return the fault of an array's dims, in any order; None for accepted dims."""
        if any(set(dims) == set(array.dims) and len(dims) == array.ndim for dims in self.allowed_dims):
            return None
        return Problem(
            f"{self.name!r} has dims ({', '.join(map(str, array.dims))})",
            expected=" or ".join(f"({', '.join(dims)})" for dims in self.allowed_dims),
            mend=self._mend_of_dims(array),
            code="dims-wrong",
        )

    def _mend_of_dims(self, array: xr.DataArray) -> str:
        """Return the likely cause of other dims, and the call that mends it."""
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
        if added and not missing and set(added) <= set(CUBE):
            return (
                f"where(..., drop=True) and xr.concat gave it {' and '.join(added)}: choose by .sel() or "
                '.isel(), join with data_vars="minimal", coords="minimal", compat="override"'
            )
        return "rename them, or name them with dims={...}"

    def unit_problem(self, array: xr.DataArray) -> Problem | None:
        """Return the fault of an array's units; None for convertible units, and for a row without units."""
        units = array.attrs.get("units")
        if not self.units:
            return None
        if units is None:
            mend = f"set {self.name}.attrs['units'], for example to {self.units!r}"
            return Problem(f"{self.name!r} has no units", mend=mend, code="units-missing")
        if str(units) == self.units or same_dimension(str(units), self.units):
            return None
        return Problem(
            f"{self.name!r} has units {str(units)!r}",
            expected=f"units like {self.units!r}",
            code="units-not-convertible",
        )


_ELEMENT = (BAND, CROSS_TRACK)
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
    Variable("dark_counts", _ELEMENT, "count", "float32", "Counts with the lens capped", alternatives=(("dark_time", BAND, CROSS_TRACK),)),
    Variable("dark_time", ("dark_time",), "", "datetime64[ns]", "UTC of each dark reference", coordinate=True),
    Variable("dark_exposure_time", (), "s", "float64", "Exposure time of the dark reference", alternatives=(("dark_time",),)),
    Variable("radiance_gain", _ELEMENT, _GAIN, "float32", "Spectral radiance per count rate"),
    Variable("exposure_time", (), "s", "float64", "Exposure time", alternatives=(_LINE,)),
    Variable("saturation_count", (), "count", "float32", "Count at which the converter is full", alternatives=(_ELEMENT,)),
    Variable("electrons_per_count", (), "electron count-1", "float32", "Electrons per count", alternatives=(_ELEMENT,)),
    Variable("read_noise", (), "count", "float32", "Spread of a dark count before rounding (1 sigma)", alternatives=(_ELEMENT,)),
    # --- light
    Variable(
        "irradiance", (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), _IRRADIANCE, "float32",
        "Downwelling spectral irradiance on a level surface",
        standard_name="surface_downwelling_radiative_flux_per_unit_wavelength_in_air",
    ),
    Variable(IRRADIANCE_TIME, (IRRADIANCE_TIME,), "", "datetime64[ns]", "UTC at the middle of each irradiance sample", coordinate=True),
    Variable(IRRADIANCE_WAVELENGTH, (IRRADIANCE_WAVELENGTH,), "nm", "float64", "Wavelength of the irradiance spectrometer", standard_name="radiation_wavelength", coordinate=True),
    Variable("irradiance_fwhm", (), "nm", "float64", "Full width at half maximum of the irradiance spectrometer", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("irradiance_max_gap", (), "s", "float64", "Longest interval between irradiance samples that is still interpolated"),
    Variable("irradiance_clock_uncertainty", (), "s", "float64", "How far the clocks of camera and spectrometer may disagree"),
    Variable("irradiance_tilt", (IRRADIANCE_TIME,), "degree", "float32", "Angle of a light sensor on the aircraft from level"),
    Variable("irradiance_misfit", (BAND,), "1", "float32", "Distance of the response that irradiance was matched to from that of the camera, relative"),
    Variable("irradiance_age", _LINE, "s", "float32", "Time to the nearest irradiance sample"),
    Variable("timing_sensitivity", _LINE, "1", "float32", "Largest relative change of irradiance within the clocks' uncertainty"),
    Variable("diffuse_fraction", (ALONG_TRACK, BAND), "1", "float32", "Diffuse part of the irradiance on level ground", alternatives=((IRRADIANCE_TIME, BAND), (BAND,))),
    Variable("diffuse_fraction_u", (ALONG_TRACK, BAND), "1", "float32", "Standard uncertainty of diffuse_fraction", alternatives=((IRRADIANCE_TIME, BAND), (BAND,))),
    Variable("sky_state", _LINE, "", "int8", "What sky the irradiance is of", alternatives=((IRRADIANCE_TIME,), ()), gap=-1),
    Variable("coat_transmission", (BAND,), "1", "float32", "What a clear coat leaves of its body's light, over what it leaves near the normal", alternatives=((ALONG_TRACK, BAND),)),
    Variable("coat_transmission_u", (BAND,), "1", "float32", "Standard uncertainty of coat_transmission", alternatives=((ALONG_TRACK, BAND),)),
    # --- panels in the scene
    Variable("panel_factor", (PANEL, BAND), "1", "float32", "Reflectance of a panel through irradiance over its known one"),
    Variable("panel_factor_u", (PANEL, BAND), "1", "float32", "Standard uncertainty of panel_factor by gain, irradiance, the panel and its pixels"),
    Variable("panel_used", (PANEL, BAND), "1", "float32", "Share of a panel's pixels that panel_factor is the mean of"),
    Variable("panel_state", (PANEL,), "", "uint8", "What was noticed of a panel"),
    Variable("panel_time", (PANEL,), "", "datetime64[ns]", "UTC at which a panel was seen"),
    Variable("panel_weight", (ALONG_TRACK, PANEL), "1", "float32", "Weight of a panel in the logarithm of the scale of a line; 0 of a refused one"),
    Variable("panel_scale_u", _LINE, "1", "float32", "Relative standard uncertainty of the level that panels give reflectance"),
    # --- coordinates of a line and of a band
    Variable("time", _LINE, "", "datetime64[ns]", "UTC at mid exposure", standard_name="time", coordinate=True),
    Variable(ALONG_TRACK, _LINE, "", "int64", "Line of the cube", coordinate=True),
    Variable(CROSS_TRACK, (CROSS_TRACK,), "", "int64", "Column of the cube", coordinate=True),
    Variable("frame", _LINE, "1", "int64", "Frame number of the instrument", coordinate=True),
    Variable("wavelength", (BAND,), "nm", "float64", "Centre wavelength at the centre column", standard_name="radiation_wavelength", coordinate=True),
    Variable("fwhm", (BAND,), "nm", "float64", "Full width at half maximum of the line shape", coordinate=True),
    Variable("band_spacing", (BAND,), "nm", "float64", "Distance to the neighbouring bands of the camera, whatever bands are left here", coordinate=True),
    Variable("good", (BAND,), "", "bool", "False where a band is not to be used", coordinate=True),
    Variable("wavelength_shift", (CROSS_TRACK,), "nm", "float64", "Wavelength of an element minus that of its band at the centre column (smile)", alternatives=(_ELEMENT,), coordinate=True),
    Variable("latitude", _LINE, "degree", "float64", "Latitude of the camera, north positive", standard_name="latitude", coordinate=True),
    Variable("longitude", _LINE, "degree", "float64", "Longitude of the camera, east positive", standard_name="longitude", coordinate=True),
    Variable("altitude", _LINE, "m", "float64", "Altitude of the camera", coordinate=True),
    Variable("roll", _LINE, "degree", "float64", "Roll", coordinate=True),
    Variable("pitch", _LINE, "degree", "float64", "Pitch", coordinate=True),
    Variable("heading", _LINE, "degree", "float64", "Heading", coordinate=True),
    # --- from where a pixel is seen
    Variable("look_across", (CROSS_TRACK,), "degree", "float64", _LOOK_ACROSS),
    Variable("look_along", (CROSS_TRACK,), "degree", "float64", "Angle of a column's line of sight from the plane of the slit, positive forward"),
    Variable("ground_height", _PIXEL, "m", "float64", "Height of what is seen above the ellipsoid", coordinate=True),
    Variable("look_angle", (CROSS_TRACK,), "degree", "float64", _LOOK_ACROSS),
    Variable("view_zenith", _PIXEL, "degree", "float64", "Angle between the vertical and the direction to the camera", standard_name="sensor_zenith_angle", coordinate=True),
    Variable("view_azimuth", _PIXEL, "degree", "float64", "Direction to the camera from what is seen, clockwise from north", standard_name="sensor_azimuth_angle", coordinate=True),
    # --- what a lab calibration adds
    Variable("dark_bias", _ELEMENT, "count", "float32", "Dark counts at no exposure"),
    Variable("dark_rate", _ELEMENT, "count s-1", "float32", "Dark counts per exposure time"),
    Variable("dark_counts_u_random", _ELEMENT, "count", "float32", "Standard uncertainty of dark_counts, independent from element to element", alternatives=((),)),
    Variable("dark_counts_u_systematic", _ELEMENT, "count", "float32", "Standard uncertainty of dark_counts, common to all elements", alternatives=((), (BAND,))),
    Variable("flat_field", _ELEMENT, "1", "float32", "Factor on dark-subtracted counts that levels the columns"),
    Variable("radiance_gain_u_random", _ELEMENT, "1", "float32", "Relative standard uncertainty of radiance_gain by noise and by what elements differ in", alternatives=((BAND,), ())),
    Variable("radiance_gain_u_systematic", _ELEMENT, "1", "float32", "Relative standard uncertainty of radiance_gain, common to all elements", alternatives=((BAND,), ())),
    Variable("wavelength_u", (), "nm", "float64", "Standard uncertainty of wavelength", alternatives=((BAND,),)),
    Variable("irradiance_u_systematic", (), "1", "float32", "Relative standard uncertainty of irradiance, common to all times", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("irradiance_u_random", (), "1", "float32", "Relative standard uncertainty of one irradiance sample by noise, independent from time to time and channel to channel", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("responsivity", _ELEMENT, "count J-1", "float64", "Counts per energy of light entering a pixel's etendue"),
    Variable("quantum_efficiency", (BAND,), "1", "float64", "Electrons per photon entering a pixel's etendue", alternatives=(_ELEMENT,)),
    Variable("stray_light", (BAND, "source_band"), "1", "float64", "Share of the light of a band that another band sees"),
    # --- the lines a calibration was made from
    Variable("step_wavelength", (STEP,), "nm", "float64", "Wavelength of the monochromator", coordinate=True),
    Variable("line_band", _LINE_FIT, "1", "float64", "Band at the centre of a monochromatic line"),
    Variable("line_centre", _LINE_FIT, "nm", "float64", "Where the wavelength map puts a line, to be compared with step_wavelength"),
    Variable("line_fwhm", _LINE_FIT, "nm", "float64", "Full width at half maximum of a line, as seen by the camera"),
    Variable("line_own_fwhm", _LINE_FIT, "nm", "float64", "The same with the monochromator's own width taken out"),
    Variable("line_amplitude", _LINE_FIT, "count", "float64", "Height of a line"),
    Variable("line_area", _LINE_FIT, "count", "float64", "Sum over bands of a line"),
    Variable("line_covariance", (*_LINE_FIT, "parameter", "other_parameter"), "", "float64", "Covariance of centre [band], own width [band], area [count] and offset [count] of a line"),
    Variable("line_trusted", _LINE_FIT, "", "bool", "Whether a line went into the calibration"),
    Variable("beam_centre", (STEP,), "1", "float64", "Column at the centre of the beam"),
    Variable("beam_fwhm", (STEP,), "1", "float64", "Full width at half maximum of the beam in columns"),
    Variable("out_of_band", (STEP,), "1", "float64", "Share of a line's counts that lies outside of the line"),
    Variable("second_order", (STEP,), "1", "float64", "Counts at twice the wavelength over those of the line"),
    # --- a traced scene: weights of paths of light, before any spectrum
    Variable("transport_weight", _PATH, "1", "float32", "Weight of a path of light: radiance is the sum of weight x irradiance / pi x its reflectances"),
    Variable("transport_path", _PATH, "", "int64", "Source and reflectances of a path of light, as a code; -1 where there is none", gap=-1),
    Variable("distance", _PIXEL, "m", "float32", "Distance from the camera to what is seen"),
    Variable("material", _PIXEL, "", "int32", "Material that most of a pixel shows; -1 for the sky", gap=-1),
    Variable("instance", _PIXEL, "", "int32", "Thing that most of a pixel shows; -1 for the sky", gap=-1),
    Variable("surface_class", _PIXEL, "", "int16", "Semantic class that most of a pixel shows; -1 for the sky", gap=-1),
    Variable("paint_id", _PIXEL, "", "int16", "Spectrum of the paint that most of a pixel shows; -1 where it is none", gap=-1),
    Variable("car_id", _PIXEL, "", "int32", "Instance number of the car that most of a pixel shows; -1 where it is none", gap=-1),
    Variable("purity", _PIXEL, "1", "float32", "Share of a pixel that its material and instance fill"),
    Variable("sun_visibility", _SUN_PIXEL, "1", "float32", "Share of a pixel that sees the sun"),
    Variable("sun_incidence", _SUN_PIXEL, "1", "float32", "Cosine of the angle between surface normal and sun, 0 where turned away"),
    Variable("east", _PIXEL, "m", "float64", "Position of what is seen, to the east"),
    Variable("north", _PIXEL, "m", "float64", "Position of what is seen, to the north"),
    Variable("up", _PIXEL, "m", "float64", "Position of what is seen, upwards"),
    Variable("sun_zenith", (SUN,), "degree", "float64", "Angle between the sun and the vertical", coordinate=True),
    Variable("sun_azimuth", (SUN,), "degree", "float64", "Direction of the sun, clockwise from north", coordinate=True),
    # --- what is known of the light of a rendered pixel
    Variable("sun_share", _PIXEL, "1", "float32", "Share of the light that came from the sun"),
    Variable("sky_share", _PIXEL, "1", "float32", "Share of the light that came from the sky"),
    Variable("glint_share", _PIXEL, "1", "float32", "Share of the light that is the mirror image of the sun in the surface seen"),
    Variable("mirrored_sky_share", _PIXEL, "1", "float32", "Share of the light that is the mirror image of the sky in the surface seen"),
    Variable("indirect_share", _PIXEL, "1", "float32", "Share of the light that met other surfaces before the one seen"),
    Variable("shadow", _PIXEL, "1", "float32", "Share of a pixel that does not see the sun"),
    # --- what flags are set from
    Variable("glint_fraction", _PIXEL, "1", "float32", "Mirror image of the sun, as reflectance under the sun alone"),
    Variable("blocked_direct", _PIXEL, "1", "float32", "Part of the direct light that is missing; negative where a surface leans towards the sun"),
    Variable("adjacency", _PIXEL, "1", "float32", "Largest reflectance, in any channel, that coloured neighbours add"),
    Variable("adjacency_segment", _PIXEL, "", "int32", "Segment of the scene model that adds most of adjacency; -1 for none", gap=-1),
    Variable("mirrored_sky", _PIXEL, "1", "float32", "Mirror image of the sky beyond that of the rest of the body"),
    # --- paints looked for
    Variable("detection_score", _PIXEL, "1", "float32", "Score of the paint that a pixel shows most likely"),
    Variable("best_paint", _PIXEL, "", "int16", "Number of the paint that a pixel shows most likely; -1 where it has not all values", gap=-1),
    Variable("paint_distance", _PIXEL, "1", "float32", "What a paint at some level and the mirrored sky leave of a pixel, relative to the paint"),
    Variable("paint_level", _PIXEL, "1", "float32", "Level at which the paint explains a pixel"),
    Variable("detected", _PIXEL, "", "bool", "Whether a pixel shows a paint that was looked for"),
    Variable("score_threshold", (SIGNATURE,), "1", "float64", "Score from which a pixel may show a paint"),
    Variable("distance_limit", (SIGNATURE,), "1", "float64", "Distance up to which a pixel may show a paint; 0 where others are too near"),
    Variable("checked_rate", (), "1", "float64", "Share of the background above thresholds from other parts of the line"),
    Variable("checked_rate_u", (), "1", "float64", "Half of the 95 % interval of checked_rate"),
    Variable("explained_share", (), "1", "float64", "Share of the valid pixels that a paint explains, left out of the background"),
    # --- where a cell of a map lies in its flight line
    Variable("glt_line", _CELL, "1", "float64", "Line that shows a cell, with the part of the way to the next"),
    Variable("glt_sample", _CELL, "1", "float64", "Column that shows a cell, with the part of the way to the next"),
    Variable("nearest_line", _CELL, "1", "int32", "Line of the pixel nearest to a cell"),
    Variable("nearest_sample", _CELL, "1", "int32", "Column of the pixel nearest to a cell"),
    Variable("hits", _CELL, "1", "uint16", "How often a flight line shows a cell"),
    Variable("gap", _CELL, "", "bool", "Whether nothing shows a cell between the ends of the lines"),
    # --- line shapes measured sample by sample (srf_shape = "tabulated")
    Variable("srf_offset", ("srf_offset",), "nm", "float64", "Distance from the centre of a band", coordinate=True),
    Variable("srf", (BAND, "srf_offset"), "1", "float64", "Line shape of a band, any scale"),
    # --- what the detector does to counts
    Variable("masked", (CROSS_TRACK,), "", "bool", "Whether an element sees no light, so that what it counts beyond its dark is the pedestal of a line", alternatives=(_ELEMENT, (BAND,))),
    Variable("linearity_counts", ("linearity_counts",), "count", "float64", "Counts, raw or dark-subtracted, at which linear_counts is known", coordinate=True),
    Variable("linear_counts", ("linearity_counts",), "count", "float64", "Counts proportional to light, as many as measured ones at low light"),
    Variable("stray_light_u", (), "1", "float32", "Relative standard uncertainty of the light that is subtracted as stray light and smear"),
    Variable("band_shift_time", (), "s", "float64", "Time in which a frame is shifted by one band under the light; attribute bands: how many there are"),
    Variable("linearity_u", (), "1", "float32", "Relative standard uncertainty that linearity leaves in linear counts"),
)

#: A lab sweep, whose counts are means on other dims than those of a flight line.
_SWEEP_TABLE = (
    Variable("counts", _SWEEP, "count", "float32", "Counts, mean of the frames of a step, dark not subtracted"),
    Variable("counts_variance", _SWEEP, "count2", "float32", "Variance of one frame over the frames of a step"),
    Variable("dark_counts", _ELEMENT, "count", "float32", "Counts without light", alternatives=(_SWEEP,)),
    Variable("dark_exposure_time", (), "s", "float64", "Exposure time of the dark reference", alternatives=((STEP,),)),
    Variable("frame_count", (), "1", "int64", "Frames averaged in a step", alternatives=((STEP,),)),
    Variable("dark_frame_count", (), "1", "int64", "Frames averaged in a dark reference", alternatives=((STEP,),)),
    Variable("step_wavelength", (STEP,), "nm", "float64", "Wavelength of the monochromator", coordinate=True),
    Variable("flux", (STEP,), "W", "float64", "Radiant flux of the whole beam, equal in all lit columns", alternatives=(_LINE_FIT,)),
    Variable("capture_fraction", (), "1", "float64", "Share of flux that enters slit width by one column, all bands", alternatives=((STEP,), _LINE_FIT)),
    Variable("exposure_time", (), "s", "float64", "Exposure time", alternatives=((STEP,),)),
    Variable("monochromator_fwhm", (), "nm", "float64", "Full width at half maximum of the monochromator's line", alternatives=((STEP,),)),
    Variable("etendue", (), "m2 sr", "float64", "Filled slit width times pixel pitch times projected solid angle", alternatives=((CROSS_TRACK,),)),
)

#: A paint library, whose spectra are on other dims than those of a flight line.
_LIBRARY_TABLE = (
    Variable("signature", (SIGNATURE,), "", "str", "Name of the signature, which is that of its region", coordinate=True),
    Variable("reflectance", _SPECTRUM, "1", "float32", "Hemispherical-conical reflectance factor, centre of the pixels used"),
    Variable("reflectance_sd", _SPECTRUM, "1", "float32", "Standard deviation of reflectance over the pixels used"),
    Variable("reflectance_quantiles", (SIGNATURE, QUANTILE, BAND), "1", "float32", "Quantiles of reflectance over the pixels used"),
    Variable("reflectance_u_random", _SPECTRUM, "1", "float32", "Random standard uncertainty of the mean reflectance"),
    Variable("reflectance_u_systematic", _SPECTRUM, "1", "float32", "Systematic standard uncertainty of the mean reflectance"),
    Variable("reflectance_errors", (SIGNATURE, ERROR_SOURCE, BAND), "1", "float32", "Standard uncertainty of the mean reflectance by each source of error; with its sign where all bands share the error"),
    Variable("error_correlation", (SIGNATURE, LAG, BAND), "1", "float32", "Correlation of what bands do not share as one, of a band with that so many after it"),
    Variable(ERROR_SOURCE, (ERROR_SOURCE,), "", "str", "Source of an error", coordinate=True),
    Variable(LAG, (LAG,), "1", "int64", "Bands from a band to one after it", coordinate=True),
    Variable("error_form", (ERROR_SOURCE,), "", "str", "How samples share the error, dim by dim, in the words of FIDUCEO and obsarray", coordinate=True),
    Variable("member_reflectance", (SIGNATURE, MEMBER, BAND), "1", "float32", "Reflectance of single pixels, NaN beyond the last"),
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
    Variable("sky_state", (SIGNATURE,), "", "int8", "What sky the irradiance is of", gap=-1),
    Variable("coat_transmission", _SPECTRUM, "1", "float32", "What a clear coat leaves of its body's light, over what it leaves near the normal"),
    Variable("coat_transmission_u", _SPECTRUM, "1", "float32", "Standard uncertainty of coat_transmission"),
    Variable("aspecular_angle", (SIGNATURE,), "degree", "float64", "Angle between the view and the direction in which a level panel mirrors the sun"),
    Variable("aspecular_range", (SIGNATURE,), "degree", "float64", "Difference of aspecular_angle between the ends of the panel, at the most"),
    Variable("flop", _SPECTRUM, "1", "float32", "Change of reflectance from the dark to the bright end of the panel, relative"),
    Variable("reflectance_u_coat", _SPECTRUM, "1", "float32", "Standard uncertainty of reflectance by the coat's share and the mirrored sky subtracted, common to a paint's pixels"),
    Variable("coat_strength", (SIGNATURE,), "1", "float64", "Sky that the coat mirrors over what its index predicts, from differences of the pixels"),
    Variable("coat_strength_u", (SIGNATURE,), "1", "float64", "Standard uncertainty of coat_strength"),
    Variable("coat_strength_reason", (SIGNATURE,), "", "str", "Why coat_strength is not told; empty where it is", coordinate=True),
    Variable("irradiance_age", (SIGNATURE,), "s", "float32", "Longest time from a line to the nearest irradiance sample"),
    Variable("time", (SIGNATURE,), "", "datetime64[ns]", "Mean UTC of the pixels used", standard_name="time", coordinate=True),
    Variable("flightline", (SIGNATURE,), "", "str", "Flight line of the region", coordinate=True),
    Variable("region", (SIGNATURE,), "", "str", "The region as a Feature of GeoJSON", coordinate=True),
    Variable(QUANTILE, (QUANTILE,), "1", "float64", "Share of the pixels used that are below", coordinate=True),
    Variable(FLAG, (FLAG,), "", "str", "Name of a quality flag", coordinate=True),
)
# fmt: on


def _table(rows: tuple[Variable, ...], *of_a_line: str) -> Mapping[str, Variable]:
    """Return rows by name, with those of a flight line that hold here too."""
    shared = tuple(variable for variable in _LINE_TABLE if variable.name in of_a_line)
    return {variable.name: variable for variable in rows + shared}


VARIABLES = _table(_LINE_TABLE)
"""Variables of a flight line, its calibration and light, its scenes and maps."""

SWEEP_VARIABLES = _table(
    _SWEEP_TABLE, "saturation_count", "electrons_per_count", "read_noise", "band_shift_time"
)
"""Variables of a lab sweep."""

LIBRARY_VARIABLES = _table(_LIBRARY_TABLE, "wavelength", "fwhm", "good")
"""Variables of a paint library."""
