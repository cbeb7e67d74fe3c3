"""The one table of variables: names, dims, units, dtype and meaning.

Nothing else in the package spells a variable's units or meaning. A function takes its inputs through
`require` and hands its outputs through `label`, which *replaces* attributes, since xarray carries stale ones
through arithmetic.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any

from .errors import Problems, SchemaError
from .units import convert, same_dimension

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

__all__ = [
    "ALONG_TRACK",
    "BAND",
    "CHUNK_LINES",
    "CROSS_TRACK",
    "CUBE",
    "DIM_ALIASES",
    "FORMAT_VERSION",
    "IRRADIANCE_TIME",
    "IRRADIANCE_WAVELENGTH",
    "MONOCHROMATOR_SHAPES",
    "SRF_SHAPES",
    "STEP",
    "SWEEP_VARIABLES",
    "TIME_UNITS",
    "VARIABLES",
    "Quality",
    "Variable",
    "describe",
    "dtype_of",
    "find",
    "label",
    "quality_attrs",
    "rename_to_roles",
    "require",
]

FORMAT_VERSION = 1
"""Version of the layout on disk, repeated in every group as ``hyperpaint_format``."""

CHUNK_LINES = 32
"""Lines in one storage chunk, and in one task on threads (see the design decisions in the README)."""

ALONG_TRACK, BAND, CROSS_TRACK = "along_track", "band", "cross_track"
CUBE = (ALONG_TRACK, BAND, CROSS_TRACK)
"""Dims of a cube in sensor geometry, in the instrument's own order: band-interleaved by line."""

IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH = "irradiance_time", "irradiance_wavelength"
STEP = "step"
"""Dim of a lab sweep: one wavelength of the monochromator after the other."""

TIME_UNITS = "nanoseconds since 1970-01-01"

#: What the neighbours call our dims, in lower case.
DIM_ALIASES: Mapping[str, tuple[str, ...]] = {
    ALONG_TRACK: ("line", "lines", "downtrack", "y", "frame"),
    BAND: ("bands", "wavelength", "wavelengths", "channel"),
    CROSS_TRACK: ("sample", "samples", "crosstrack", "x", "column"),
}


@dataclass(frozen=True)
class Variable:
    """One row of the table.

    Attributes
    ----------
    name
        Name in datasets and stores.
    dims
        Dims in storage order; `alternatives` lists the other shapes that are allowed.
    units
        CF spelling, as written to disk; empty for flags, names and time stamps.
    dtype
        numpy dtype name, before and after compute.
    meaning
        One line; becomes ``long_name``.
    alternatives
        Other dims that are allowed.
    standard_name
        Of the CF conventions, where there is one.
    coordinate
        Whether it is a coordinate rather than a data variable.
    """

    name: str
    dims: tuple[str, ...]
    units: str
    dtype: str
    meaning: str
    alternatives: tuple[tuple[str, ...], ...] = ()
    standard_name: str = ""
    coordinate: bool = False

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes written with the variable."""
        made: dict[str, Any] = {"long_name": self.meaning}
        if self.units:
            made["units"] = self.units
        if self.standard_name:
            made["standard_name"] = self.standard_name
        return made


class Quality(IntFlag):
    """Bits of ``quality``; a bit set early is still set in every later product."""

    SATURATED = 1
    BELOW_DARK = 2
    BAD_DETECTOR = 4
    IRRADIANCE_GAP = 8
    ILLUMINATION_UNSTABLE = 16
    LOW_SUN = 32
    GLINT = 64
    SHADOW = 128
    ADJACENCY = 256
    MIXED_EDGE = 512
    OFF_SWATH = 1024
    NO_DATA = 2048
    TIMING_SENSITIVE = 4096


_ELEMENT = (BAND, CROSS_TRACK)
_LINE = (ALONG_TRACK,)
_GAIN = "W m-2 sr-1 nm-1 s count-1"
_RADIANCE = "W m-2 sr-1 nm-1"
_IRRADIANCE = "W m-2 nm-1"
_LINE_FIT = (STEP, CROSS_TRACK)
_SWEEP = (STEP, BAND, CROSS_TRACK)

# fmt: off
_TABLE = (
    # --- cubes
    Variable("counts", CUBE, "count", "uint16", "Raw counts"),
    Variable(
        "radiance", CUBE, _RADIANCE, "float32", "Spectral radiance at the sensor",
        standard_name="upwelling_radiance_per_unit_wavelength_in_air",
    ),
    Variable(
        "reflectance", CUBE, "1", "float32", "Hemispherical-conical reflectance factor",
        standard_name="surface_bidirectional_reflectance",
    ),
    Variable("reflectance_u_random", CUBE, "1", "float32", "Random uncertainty of reflectance"),
    Variable("reflectance_u_systematic", CUBE, "1", "float32", "Systematic uncertainty of reflectance"),
    Variable("quality", (ALONG_TRACK, CROSS_TRACK), "", "uint16", "Quality flags"),
    Variable("overview", ("overview_y", "overview_x", "rgb"), "", "uint8", "Small true-colour picture (sRGB)"),
    # --- calibration of every detector element
    Variable(
        "dark_counts", _ELEMENT, "count", "float32", "Counts with the lens capped",
        alternatives=(("dark_time", BAND, CROSS_TRACK),),
    ),
    Variable("dark_time", ("dark_time",), "", "datetime64[ns]", "UTC of each dark reference", coordinate=True),
    Variable(
        "dark_exposure_time", (), "s", "float64", "Exposure time of the dark reference",
        alternatives=(("dark_time",),),
    ),
    Variable("radiance_gain", _ELEMENT, _GAIN, "float32", "Spectral radiance per count rate"),
    Variable("exposure_time", (), "s", "float64", "Exposure time", alternatives=(_LINE,)),
    Variable(
        "saturation_count", (), "count", "float32", "Count at which the converter is full",
        alternatives=(_ELEMENT,),
    ),
    Variable(
        "electrons_per_count", (), "electron count-1", "float32", "Electrons per count",
        alternatives=(_ELEMENT,),
    ),
    Variable("read_noise", (), "count", "float32", "Spread of a dark count before rounding (1 sigma)", alternatives=(_ELEMENT,)),
    # --- light
    Variable(
        "irradiance", (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), _IRRADIANCE, "float32",
        "Downwelling spectral irradiance on a level surface",
        standard_name="surface_downwelling_radiative_flux_per_unit_wavelength_in_air",
    ),
    Variable(
        IRRADIANCE_TIME, (IRRADIANCE_TIME,), "", "datetime64[ns]",
        "UTC at the middle of each irradiance sample", coordinate=True,
    ),
    Variable(
        IRRADIANCE_WAVELENGTH, (IRRADIANCE_WAVELENGTH,), "nm", "float64",
        "Wavelength of the irradiance spectrometer", standard_name="radiation_wavelength", coordinate=True,
    ),
    Variable(
        "irradiance_fwhm", (), "nm", "float64", "Full width at half maximum of the irradiance spectrometer",
        alternatives=((IRRADIANCE_WAVELENGTH,),),
    ),
    Variable(
        "irradiance_max_gap", (), "s", "float64",
        "Longest interval between irradiance samples that is still interpolated",
    ),
    Variable(
        "irradiance_clock_uncertainty", (), "s", "float64",
        "How far the clocks of camera and spectrometer may disagree",
    ),
    Variable(
        "irradiance_misfit", (BAND,), "1", "float32",
        "Distance of the response that irradiance was matched to from that of the camera, relative",
    ),
    Variable("irradiance_age", _LINE, "s", "float32", "Time to the nearest irradiance sample"),
    Variable(
        "timing_sensitivity", _LINE, "1", "float32",
        "Largest relative change of irradiance within the clocks' uncertainty",
    ),
    # --- coordinates of a line and of a band
    Variable("time", _LINE, "", "datetime64[ns]", "UTC at mid exposure", standard_name="time", coordinate=True),
    Variable("frame", _LINE, "1", "int64", "Frame number of the instrument", coordinate=True),
    Variable(
        "wavelength", (BAND,), "nm", "float64", "Centre wavelength at the centre column",
        standard_name="radiation_wavelength", coordinate=True,
    ),
    Variable("fwhm", (BAND,), "nm", "float64", "Full width at half maximum of the line shape", coordinate=True),
    Variable(
        "band_spacing", (BAND,), "nm", "float64",
        "Distance to the neighbouring bands of the camera, whatever bands are left here", coordinate=True,
    ),
    Variable("good", (BAND,), "", "bool", "False where a band is not to be used", coordinate=True),
    Variable(
        "wavelength_shift", (CROSS_TRACK,), "nm", "float64",
        "Wavelength of an element minus that of its band at the centre column (smile)",
        alternatives=(_ELEMENT,), coordinate=True,
    ),
    Variable(
        "latitude", _LINE, "degree", "float64", "Latitude of the camera, north positive",
        standard_name="latitude", coordinate=True,
    ),
    Variable(
        "longitude", _LINE, "degree", "float64", "Longitude of the camera, east positive",
        standard_name="longitude", coordinate=True,
    ),
    Variable("altitude", _LINE, "m", "float64", "Altitude of the camera", coordinate=True),
    Variable("roll", _LINE, "degree", "float64", "Roll", coordinate=True),
    Variable("pitch", _LINE, "degree", "float64", "Pitch", coordinate=True),
    Variable("heading", _LINE, "degree", "float64", "Heading", coordinate=True),
    # --- what a lab calibration adds
    Variable("dark_bias", _ELEMENT, "count", "float32", "Dark counts at no exposure"),
    Variable("dark_rate", _ELEMENT, "count s-1", "float32", "Dark counts per exposure time"),
    Variable(
        "dark_counts_u_random", _ELEMENT, "count", "float32",
        "Standard uncertainty of dark_counts, independent from element to element", alternatives=((),),
    ),
    Variable(
        "dark_counts_u_systematic", _ELEMENT, "count", "float32",
        "Standard uncertainty of dark_counts, common to all elements", alternatives=((), (BAND,)),
    ),
    Variable("flat_field", _ELEMENT, "1", "float32", "Factor on dark-subtracted counts that levels the columns"),
    Variable(
        "radiance_gain_u_random", _ELEMENT, "1", "float32",
        "Relative standard uncertainty of radiance_gain by noise and by what elements differ in",
        alternatives=((BAND,), ()),
    ),
    Variable(
        "radiance_gain_u_systematic", _ELEMENT, "1", "float32",
        "Relative standard uncertainty of radiance_gain, common to all elements", alternatives=((BAND,), ()),
    ),
    Variable("wavelength_u", (), "nm", "float64", "Standard uncertainty of wavelength", alternatives=((BAND,),)),
    Variable(
        "irradiance_u_systematic", (), "1", "float32", "Relative standard uncertainty of irradiance, common to all times",
        alternatives=((IRRADIANCE_WAVELENGTH,),),
    ),
    Variable("responsivity", _ELEMENT, "count J-1", "float64", "Counts per energy of light entering a pixel's etendue"),
    Variable(
        "quantum_efficiency", (BAND,), "1", "float64", "Electrons per photon entering a pixel's etendue",
        alternatives=(_ELEMENT,),
    ),
    Variable("stray_light", (BAND, "source_band"), "1", "float64", "Share of the light of a band that another band sees"),
    # --- the lines a calibration was made from
    Variable("step_wavelength", (STEP,), "nm", "float64", "Wavelength of the monochromator", coordinate=True),
    Variable("line_band", _LINE_FIT, "1", "float64", "Band at the centre of a monochromatic line"),
    Variable("line_centre", _LINE_FIT, "nm", "float64", "Where the wavelength map puts a line, to be compared with step_wavelength"),
    Variable("line_fwhm", _LINE_FIT, "nm", "float64", "Full width at half maximum of a line, as seen by the camera"),
    Variable("line_own_fwhm", _LINE_FIT, "nm", "float64", "The same with the monochromator's own width taken out"),
    Variable("line_amplitude", _LINE_FIT, "count", "float64", "Height of a line"),
    Variable("line_area", _LINE_FIT, "count", "float64", "Sum over bands of a line"),
    Variable(
        "line_covariance", (*_LINE_FIT, "parameter", "other_parameter"), "", "float64",
        "Covariance of centre [band], own width [band], area [count] and offset [count] of a line",
    ),
    Variable("line_trusted", _LINE_FIT, "", "bool", "Whether a line went into the calibration"),
    Variable("beam_centre", (STEP,), "1", "float64", "Column at the centre of the beam"),
    Variable("beam_fwhm", (STEP,), "1", "float64", "Full width at half maximum of the beam in columns"),
    Variable("out_of_band", (STEP,), "1", "float64", "Share of a line's counts that lies outside of the line"),
    Variable("second_order", (STEP,), "1", "float64", "Counts at twice the wavelength over those of the line"),
    # --- line shapes measured sample by sample (srf_shape = "tabulated")
    Variable("srf_offset", ("srf_offset",), "nm", "float64", "Distance from the centre of a band", coordinate=True),
    Variable("srf", (BAND, "srf_offset"), "1", "float64", "Line shape of a band, any scale"),
)
# fmt: on

VARIABLES: Mapping[str, Variable] = {variable.name: variable for variable in _TABLE}

# fmt: off
_SWEEP_TABLE = (
    Variable("counts", _SWEEP, "count", "float32", "Counts, mean of the frames of a step, dark not subtracted"),
    Variable("counts_variance", _SWEEP, "count2", "float32", "Variance of one frame over the frames of a step"),
    Variable("dark_counts", _ELEMENT, "count", "float32", "Counts without light", alternatives=(_SWEEP,)),
    Variable(
        "dark_exposure_time", (), "s", "float64", "Exposure time of the dark reference", alternatives=((STEP,),)
    ),
    Variable("frame_count", (), "1", "int64", "Frames averaged in a step", alternatives=((STEP,),)),
    Variable("dark_frame_count", (), "1", "int64", "Frames averaged in a dark reference", alternatives=((STEP,),)),
    Variable("step_wavelength", (STEP,), "nm", "float64", "Wavelength of the monochromator", coordinate=True),
    Variable(
        "flux", (STEP,), "W", "float64", "Radiant flux of the whole beam, equal in all lit columns",
        alternatives=(_LINE_FIT,),
    ),
    Variable(
        "capture_fraction", (), "1", "float64", "Share of flux that enters slit width by one column, all bands",
        alternatives=((STEP,), _LINE_FIT),
    ),
    Variable("exposure_time", (), "s", "float64", "Exposure time", alternatives=((STEP,),)),
    Variable(
        "monochromator_fwhm", (), "nm", "float64", "Full width at half maximum of the monochromator's line",
        alternatives=((STEP,),),
    ),
    Variable(
        "etendue", (), "m2 sr", "float64", "Filled slit width times pixel pitch times projected solid angle",
        alternatives=((CROSS_TRACK,),),
    ),
    VARIABLES["saturation_count"],
    VARIABLES["electrons_per_count"],
    VARIABLES["read_noise"],
)
# fmt: on

SWEEP_VARIABLES: Mapping[str, Variable] = {variable.name: variable for variable in _SWEEP_TABLE}
"""The table of a lab sweep, whose counts are means on other dims than those of a flight line."""

MONOCHROMATOR_SHAPES = ("gaussian", "triangle")
"""Line shapes of a monochromator, named by the attribute ``monochromator_shape`` of a sweep."""

SRF_SHAPES = ("gaussian", "slit", "tabulated")
"""Line shapes of a band, named by the dataset attribute ``srf_shape``."""


def describe() -> str:
    """Return the table as text, one variable a line."""
    rows = [(v.name, ", ".join(v.dims) or "scalar", v.units or "-", v.dtype, v.meaning) for v in _TABLE]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return "\n".join(
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[4]])
        for row in rows
    )


def quality_attrs() -> dict[str, Any]:
    """Return the CF attributes of ``quality``."""
    import numpy as np

    return {
        **VARIABLES["quality"].attrs,
        "flag_masks": np.array([int(flag) for flag in Quality], dtype=np.uint16),
        "flag_meanings": " ".join(str(flag.name).lower() for flag in Quality),
    }


def label(array: xr.DataArray, name: str, **extra: Any) -> xr.DataArray:
    """Return ``array`` under the name and attributes of the table, which replace those it had."""
    attrs = quality_attrs() if name == "quality" else VARIABLES[name].attrs
    made = array.rename(name).copy(deep=False)  # renamed alone, it would share its attributes
    made.attrs = {**attrs, **extra}
    return made


def require(
    dataset: xr.Dataset, names: Iterable[str], purpose: str, table: Mapping[str, Variable] = VARIABLES
) -> dict[str, xr.DataArray]:
    """Return the named variables, in the units and dim order of the table.

    Reads dims, dtypes and attributes only, never values.

    Parameters
    ----------
    dataset
        Holds the variables.
    names
        Rows of the table that are needed.
    purpose
        Opens the message: what cannot be computed without them.
    table
        `VARIABLES`, or `SWEEP_VARIABLES` for a lab sweep.

    Raises
    ------
    SchemaError
        Variables are missing, or have other dims or units than the table allows; all are listed.
    """
    found, wrong = find(dataset, names, table)
    problems = Problems(f"cannot compute {purpose}", SchemaError)
    for problem in wrong:
        problems.add(problem)
    problems.raise_if_any()
    return found


def find(
    dataset: xr.Dataset, names: Iterable[str], table: Mapping[str, Variable] = VARIABLES
) -> tuple[dict[str, xr.DataArray], list[str]]:
    """Return what `require` returns of the variables that are as they should be, and the others' problems."""
    problems: list[str] = []
    found: dict[str, xr.DataArray] = {}
    for name in names:
        spec = table[name]
        if name not in dataset.variables:
            shape = ", ".join(spec.dims) or "a scalar"
            problems.append(
                f"{name!r} is missing: {spec.meaning.lower()} ({shape}) [{spec.units or spec.dtype}]"
            )
            continue
        array = dataset[name]
        wrong = _dim_problem(array, spec)
        if wrong is None and spec.units:
            wrong = _unit_problem(array, spec)
        if wrong:
            problems.append(wrong)
            continue
        order = next(dims for dims in (spec.dims, *spec.alternatives) if set(dims) == set(array.dims))
        array = array.transpose(*order)
        found[name] = convert(array, spec.units) if spec.units else array
    return found, problems


def _dim_problem(array: xr.DataArray, spec: Variable) -> str | None:
    allowed = (spec.dims, *spec.alternatives)
    if any(set(dims) == set(array.dims) and len(dims) == array.ndim for dims in allowed):
        return None
    expected = " or ".join(f"({', '.join(dims)})" for dims in allowed)
    return (
        f"{spec.name!r} has dims ({', '.join(map(str, array.dims))}), expected {expected}; "
        "rename them, or name them with dims={...}"
    )


def _unit_problem(array: xr.DataArray, spec: Variable) -> str | None:
    units = array.attrs.get("units")
    if units is None:
        return f"{spec.name!r} has no units; set {spec.name}.attrs['units'], for example to {spec.units!r}"
    if not same_dimension(str(units), spec.units):
        return f"{spec.name!r} has units {str(units)!r}, expected something like {spec.units!r}"
    return None


def rename_to_roles(dataset: xr.Dataset, dims: Mapping[str, Hashable] | None = None) -> xr.Dataset:
    """Return ``dataset`` with its dims named by role: ``along_track``, ``band``, ``cross_track``.

    Parameters
    ----------
    dataset
        Any dataset with a cube.
    dims
        Role to dim name, for names that `DIM_ALIASES` does not know.

    Raises
    ------
    SchemaError
        ``dims`` names a role or a dim that does not exist.
    """
    names: dict[Hashable, Hashable] = {}
    for role, name in (dims or {}).items():
        if role not in CUBE or name not in dataset.dims:
            msg = (
                f"dims={{{role!r}: {name!r}}}: expected roles {list(CUBE)} "
                f"and dims of the dataset {list(map(str, dataset.dims))}"
            )
            raise SchemaError(msg)
        names[name] = role
    for role, aliases in DIM_ALIASES.items():
        if role in dataset.dims or role in names.values():
            continue
        known = (role, *aliases)
        alias = next((d for d in dataset.dims if str(d).lower() in known and d not in names), None)
        if alias is not None:
            names[alias] = role
    # a dim `wavelength` with a coordinate of that name becomes the coordinate wavelength(band)
    indexed = [name for name, role in names.items() if role == BAND and name in dataset.coords]
    if indexed:
        dataset = dataset.reset_index(indexed)
    names = {old: new for old, new in names.items() if old != new}
    return dataset.rename_dims(names) if names else dataset


def dtype_of(name: str) -> np.dtype[Any]:
    """Return the numpy dtype of a variable of the table."""
    import numpy as np

    return np.dtype(VARIABLES[name].dtype)
