"""The one table of variables: names, dims, units, dtype and meaning.

Nothing else in the package spells a variable's units or meaning. `hyperpaint.base.schema` checks inputs against
the table, and labels outputs from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr

from .errors import Problem
from .units import same_dimension

ALONG_TRACK, BAND, CROSS_TRACK = "along_track", "band", "cross_track"
#: Dims of a cube in sensor geometry, in the instrument's own order: band-interleaved by line.
CUBE = (ALONG_TRACK, BAND, CROSS_TRACK)

IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH = "irradiance_time", "irradiance_wavelength"
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
        attrs: dict[str, Any] = {"long_name": self.meaning}
        if self.units:
            attrs["units"] = self.units
        if self.standard_name:
            attrs["standard_name"] = self.standard_name
        return attrs

    @property
    def allowed_dims(self) -> tuple[tuple[str, ...], ...]:
        # Dims in storage order, then the alternatives.
        return (self.dims, *self.alternatives)

    def dim_problem(self, array: xr.DataArray) -> Problem | None:
        # Return the fault of an array's dims, in any order; None for accepted dims.
        if any(set(dims) == set(array.dims) and len(dims) == array.ndim for dims in self.allowed_dims):
            return None
        return Problem(
            f"{self.name!r} has dims ({', '.join(map(str, array.dims))})",
            expected=" or ".join(f"({', '.join(dims)})" for dims in self.allowed_dims),
            mend=self._mend_of_dims(array),
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
        if added and not missing and set(added) <= set(CUBE):
            return (
                f"where(..., drop=True) and xr.concat gave it {' and '.join(added)}: choose by .sel() or "
                '.isel(), join with data_vars="minimal", coords="minimal", compat="override"'
            )
        return "rename them, or name them with dims={...}"

    def unit_problem(self, array: xr.DataArray) -> Problem | None:
        # Return the fault of an array's units; None for convertible units, and for a row without units.
        units = array.attrs.get("units")
        if not self.units:
            return None
        if units is None:
            return Problem(
                f"{self.name!r} has no units",
                mend=f"set {self.name}.attrs['units'], for example to {self.units!r}",
                code="units-missing",
            )
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
    Variable("reflectance_gain", _ELEMENT, "s count-1", "float32", "Reflectance factor per count rate, from a white reference"),
    Variable("reflectance_gain_u_random", _ELEMENT, "1", "float32", "Relative standard uncertainty of reflectance_gain by noise of white and dark"),
    Variable("reflectance_gain_u_systematic", (), "1", "float32", "Relative standard uncertainty of reflectance_gain by the reflectance of the white tile, common to all elements", alternatives=((BAND,),)),
    Variable("white_level", ("white_time", BAND), "1", "float64", "Light on each white reference over the light that reflectance_gain is valid for"),
    Variable("white_time", ("white_time",), "", "datetime64[ns]", "UTC of each white reference", coordinate=True),
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
    Variable("good", (BAND,), "", "bool", "Whether a band may be used", coordinate=True),
    Variable("wavelength_shift", (CROSS_TRACK,), "nm", "float64", "Wavelength of an element minus that of its band at the centre column (smile)", alternatives=(_ELEMENT,), coordinate=True),
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
    Variable("dark_bias", _ELEMENT, "count", "float32", "Dark counts at no exposure"),
    Variable("dark_rate", _ELEMENT, "count s-1", "float32", "Dark counts per exposure time"),
    Variable("dark_counts_u_random", _ELEMENT, "count", "float32", "Standard uncertainty of dark_counts, independent from element to element", alternatives=((),)),
    Variable("dark_counts_u_systematic", _ELEMENT, "count", "float32", "Standard uncertainty of dark_counts, common to all elements", alternatives=((), (BAND,))),
    Variable("flat_field", _ELEMENT, "1", "float32", "Factor on dark-subtracted counts that levels the columns"),
    Variable("radiance_gain_u_random", _ELEMENT, "1", "float32", "Relative standard uncertainty of radiance_gain by noise and by differences between elements", alternatives=((BAND,), ())),
    Variable("radiance_gain_u_systematic", _ELEMENT, "1", "float32", "Relative standard uncertainty of radiance_gain, common to all elements", alternatives=((BAND,), ())),
    Variable("wavelength_u", (), "nm", "float64", "Standard uncertainty of wavelength", alternatives=((BAND,),)),
    Variable("irradiance_u_systematic", (), "1", "float32", "Relative standard uncertainty of irradiance, common to all times", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("irradiance_u_random", (), "1", "float32", "Relative standard uncertainty of one irradiance sample by noise, independent from time to time and channel to channel", alternatives=((IRRADIANCE_WAVELENGTH,),)),
    Variable("responsivity", _ELEMENT, "count J-1", "float64", "Counts per energy of light entering a pixel's etendue"),
    Variable("quantum_efficiency", (BAND,), "1", "float64", "Electrons per photon entering a pixel's etendue", alternatives=(_ELEMENT,)),
    Variable("stray_light", (BAND, "source_band"), "1", "float64", "Share of the light of a source band that scatters into another band"),
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
    Variable("masked", (CROSS_TRACK,), "", "bool", "Whether an element receives no light, so that its dark-subtracted counts are the pedestal of a line", alternatives=(_ELEMENT, (BAND,))),
    Variable("linearity_counts", ("linearity_counts",), "count", "float64", "Counts, raw or dark-subtracted, at which linear_counts was measured", coordinate=True),
    Variable("linear_counts", ("linearity_counts",), "count", "float64", "Counts proportional to light, equal to measured counts at low light"),
    Variable("stray_light_u", (), "1", "float32", "Relative standard uncertainty of the light that is subtracted as stray light and smear"),
    Variable("band_shift_time", (), "s", "float64", "Time in which a frame is shifted by one band under the light; attribute bands: number of bands"),
    Variable("linearity_u", (), "1", "float32", "Relative standard uncertainty that linearity leaves in linear counts"),
)

#: A lab sweep: its counts are means, on other dims than the counts of a flight line.
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
