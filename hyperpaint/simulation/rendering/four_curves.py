"""The light on a scene, and the air before the camera, as four spectra.

The spectra are those of DIRSIG5's FourCurveAtmosphere: sunlight and skylight at the ground, extinction and
path radiance per metre. Their sources are the sky of the simulator, SPECTRL2, a spectrometer, or tables of
MODTRAN or libRadtran.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.errors import (
    FormatError,
    Problems,
    SchemaError,
    UnitsError,
    needs_extra,
    warn_user,
)
from hyperpaint.base.facts import check_values, conversion_factor, convert, one_of
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.schema import Floats, require
from hyperpaint.light.sky_functions import fit_sky
from hyperpaint.simulation.atmosphere import (
    CIE_OVERCAST_SHARE,
    HAZE,
    SKY,
    Haze,
    built_in_sky,
    check_curves,
    check_sky,
    check_wavelengths,
    clear_spread,
    cloud_transmittance,
    relative_air_mass,
    spectral_grid,
)
from hyperpaint.simulation.settings import moment_of

_CURVES = {
    "sun": ("W m-2 nm-1", "Direct solar irradiance at the ground, normal to the beam"),
    "sky": ("W m-2 nm-1", "Diffuse sky irradiance of a level surface"),
    "extinction": ("m-1", "Extinction coefficient of the air near the ground"),
    "path_radiance": ("W m-2 sr-1 nm-1 m-1", "Radiance that a metre of path adds"),
}
_SHARES = {
    "molecular": ("1", "Share of skylight that is spread as molecules scatter it"),
    "aureole": ("1", "Share of skylight that is spread around the sun, as aerosol scatters it"),
}
_NUMBERS = {
    name: (SKY[name].unit or "1", SKY[name].doc.capitalize())
    for name in ("sun_zenith", "sun_azimuth", "overcast_share")
}
_RANGE_NM = (340.0, 1100.0)  # wavelengths of the built-in sky
_MAX_BYTES = 16 * 2**20
_MAX_LINES = 200_000
_MAX_PROBLEMS = 10
_MAX_RESIDUAL = 0.25  # relative root mean square, reached by aerosol or thin cloud
_NOISE = 0.01  # maximum negative noise relative to the maximum irradiance
_HEADING = re.compile(r"([A-Za-z_]{1,40}) ?[\[(]([^\[\]()]{1,80})[\])]")
#: Columns of a table, and their units in `Atmosphere`.
_COLUMNS = {"wavelength": "nm"} | {name: units for name, (units, _) in _CURVES.items()}
_REQUIRED = ("wavelength", "sun", "sky")


@dataclass(frozen=True, eq=False)
class Atmosphere:
    """Light at the ground and the air before the camera.

    Attributes
    ----------
    wavelength
        Increasing wavelengths, with steps much finer than the narrowest band, shape (wavelength,) [nm].
    sun
        Direct irradiance at the ground on a surface normal to the beam, shape (wavelength,) [W m-2 nm-1].
    sky
        Diffuse irradiance of a level surface, shape (wavelength,) [W m-2 nm-1].
    extinction
        Extinction of the air near the ground, shape (wavelength,) [m-1].
    path_radiance
        Radiance added by a metre of air, shape (wavelength,) [W m-2 sr-1 nm-1 m-1].
    sun_zenith, sun_azimuth
        Zenith angle and azimuth of the sun, clockwise from north [degree].
    overcast_share
        Share of the diffuse irradiance whose radiance is proportional to the cosine of the zenith angle: 0 to
        1, 4/7 for a CIE overcast sky (see `hyperpaint.simulation.atmosphere`).
    name
        Name of the atmosphere.
    haze
        Source of extinction and path radiance; None if these were passed.
    molecular, aureole
        Shares of the diffuse irradiance that are distributed like the functions of a clear sky
        (`hyperpaint.light.sky_functions`), shape (wavelength,) [1]; None for 0. The rest is uniform.

    Raises
    ------
    SchemaError
        Shapes differ, wavelengths do not increase, values are not finite or negative, the sun is not above
        the horizon; all are listed.

    Examples
    --------
    >>> noon = Atmosphere.clear(25.0)
    >>> round(float(np.interp(550.0, noon.wavelength, noon.irradiance)), 1)
    1.6
    """

    wavelength: Floats
    sun: Floats
    sky: Floats
    extinction: Floats
    path_radiance: Floats
    sun_zenith: float
    sun_azimuth: float
    overcast_share: float = 0.0
    name: str = ""
    haze: Haze | None = None
    molecular: Floats = None  # type: ignore[assignment]  # None becomes zeros
    aureole: Floats = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for name in _SHARES:
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(np.shape(self.wavelength)))
        for name in ("wavelength", *_CURVES, *_SHARES):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)  # presets are shared objects
            object.__setattr__(self, name, array)
        problems = Problems(f"atmosphere {self.name!r} cannot be used", SchemaError)
        check_curves(problems, {name: getattr(self, name) for name in ("wavelength", *_CURVES, *_SHARES)})
        check_values(SKY, {name: getattr(self, name) for name in _NUMBERS}, problems)
        if not problems and self.uniform.min(initial=0.0) < -1e-9:
            total = 1.0 - self.uniform.min()
            problems.add(
                f"overcast_share + molecular + aureole is {total:.4g}",
                expected="at most 1",
                code="shares-too-large",
            )
        problems.raise_if_any()

    @property
    def uniform(self) -> Floats:
        # Share of the diffuse irradiance that is uniform, shape (wavelength,) [1].
        return np.asarray(1.0 - self.overcast_share - self.molecular - self.aureole)

    @property
    def sun_cosine(self) -> float:
        # Cosine of the sun's zenith angle.
        return float(np.cos(np.radians(self.sun_zenith)))

    @property
    def irradiance(self) -> Floats:
        # Total irradiance of a level surface, shape (wavelength,) [W m-2 nm-1].
        return np.asarray(self.sun * self.sun_cosine + self.sky)

    @classmethod
    def clear(
        cls,
        sun_zenith: float = 25.0,
        sun_azimuth: float = 180.0,
        *,
        aerosol: float = 0.10,
        ozone: float = 0.31,
        water: float = 1.0,
        haze: Haze | None = HAZE,
        wavelength: npt.ArrayLike | None = None,
        name: str = "clear",
    ) -> Atmosphere:
        # Return the clear sky of the simulator, which resolves the absorption lines of oxygen.
        #
        # ``sun_zenith``, ``sun_azimuth``, ``name``: See `Atmosphere`. ``aerosol``: Aerosol optical depth of
        # the whole atmosphere at 500 nm. ``ozone``: Ozone column [atm cm]. ``water``: Precipitable water
        # relative to a typical summer day. ``haze``: The air before the camera; None for no air.
        # ``wavelength``: Grid, shape (wavelength,) [nm]; by default 340 to 1100 nm in steps of 0.05 nm. The
        # sky has no absorption bands beyond 1000 nm.
        #
        # Raises `SchemaError`: The sun is not above the horizon, or the grid is invalid.
        grid = spectral_grid(*_RANGE_NM) if wavelength is None else np.asarray(wavelength, dtype=np.float64)
        sun, sky = built_in_sky(grid, sun_zenith, aerosol=aerosol, ozone=ozone, water=water)
        return cls._with_haze(
            grid, sun, sky, haze, aerosol=aerosol, sun_zenith=sun_zenith, sun_azimuth=sun_azimuth, name=name
        )

    @classmethod
    def _with_haze(
        cls,
        grid: Floats,
        sun: Floats,
        sky: Floats,
        haze: Haze | None,
        *,
        spread: Mapping[str, Any] | None = None,
        aerosol: float = 0.10,
        **options: Any,
    ) -> Atmosphere:
        # atmosphere whose extinction and path radiance are computed from haze, sun and sky, and shares of a
        # clear sky, unless passed, from the sun
        extinction = path = np.zeros_like(grid)
        zenith, overcast_share = options["sun_zenith"], options.get("overcast_share", 0.0)
        if haze is not None:
            extinction, path = haze.extinction(grid), haze.path_radiance(grid, sun, sky, zenith)
        shares = spread or clear_spread(grid, sun, zenith, overcast_share, aerosol)
        return cls(grid, sun, sky, extinction, path, haze=haze, **shares, **options)

    @classmethod
    def spectrl2(
        cls,
        sun_zenith: float = 25.0,
        sun_azimuth: float = 180.0,
        *,
        aerosol: float = 0.10,
        ozone: float = 0.31,
        precipitable_water: float = 1.5,
        ground: float = 0.15,
        pressure: float = 101325.0,
        dayofyear: int = 172,
        haze: Haze | None = HAZE,
        wavelength: npt.ArrayLike | None = None,
        name: str = "spectrl2",
    ) -> Atmosphere:
        # Return the clear sky of SPECTRL2 (Bird & Riordan 1986), by pvlib.
        #
        # Its steps of 5 nm around the oxygen A band and 10 to 20 nm elsewhere are interpolated linearly, so
        # that bands of oxygen and water are shallower and wider than in nature.
        #
        # ``sun_zenith``, ``sun_azimuth``, ``aerosol``, ``ozone``, ``haze``, ``name``: See `clear`; inaccurate
        # for zenith angles beyond 85 degrees. ``precipitable_water``: Water column [cm]. ``ground``:
        # Reflectance of the surroundings, which brightens the sky. ``pressure``: Air pressure at the ground
        # [Pa]. ``dayofyear``: Day of the year, for the distance of the sun. ``wavelength``: Grid, shape
        # (wavelength,), within 300 to 4000 [nm]; by default 340 to 1100 nm in steps of 0.5 nm.
        #
        # Raises `MissingExtraError`: pvlib is not installed. Raises `SchemaError`: The sun is not above the
        # horizon, or the grid exceeds 300 to 4000 nm.
        grid = (
            spectral_grid(*_RANGE_NM, 0.5) if wavelength is None else np.asarray(wavelength, dtype=np.float64)
        )
        check_wavelengths(grid)
        check_sky(sun_zenith=sun_zenith, aerosol=aerosol)
        with needs_extra("pvlib", "sim", "the SPECTRL2 atmosphere"):
            from pvlib.spectrum import spectrl2
        table = spectrl2(
            apparent_zenith=sun_zenith,
            aoi=sun_zenith,
            surface_tilt=0.0,
            relative_airmass=relative_air_mass(sun_zenith),
            ground_albedo=ground,
            surface_pressure=pressure,
            dayofyear=dayofyear,
            aerosol_turbidity_500nm=aerosol,
            ozone=ozone,
            precipitable_water=precipitable_water,
        )
        coarse = np.asarray(table["wavelength"], dtype=np.float64)
        SchemaError.raise_if(
            not (coarse[0] <= grid[0] and grid[-1] <= coarse[-1]),
            f"wavelength goes from {grid[0]:g} to {grid[-1]:g} nm",
            expected=f"{coarse[0]:g} to {coarse[-1]:g} nm, the range of SPECTRL2",
            code="value-out-of-range",
        )
        sun, sky = (np.interp(grid, coarse, np.ravel(table[name])) for name in ("dni", "dhi"))
        return cls._with_haze(
            grid, sun, sky, haze, aerosol=aerosol, sun_zenith=sun_zenith, sun_azimuth=sun_azimuth, name=name
        )

    @classmethod
    def from_irradiance(
        cls,
        series: xr.Dataset,
        *,
        sun_zenith: float,
        sun_azimuth: float = 180.0,
        time: Any = None,
        direct_fraction: npt.ArrayLike | None = None,
        overcast_share: float = 0.0,
        haze: Haze | None = HAZE,
        name: str = "measured",
    ) -> Atmosphere:
        # Return the atmosphere of a measured irradiance series at one time.
        #
        # ``series``: Dataset with ``irradiance`` (irradiance_time, irradiance_wavelength), total on a level
        # surface. ``sun_zenith``, ``sun_azimuth``, ``overcast_share``, ``name``: See `Atmosphere`. ``time``:
        # Time, UTC, at which irradiance is interpolated; None for a series of one sample.
        # ``direct_fraction``: Direct over total irradiance, one number or shape (wavelength,): 0 under an
        # overcast sky. By default the fraction of the built-in clear sky with this sun. ``haze``: The air
        # before the camera; None for none.
        #
        # Raises `SchemaError`: ``irradiance`` is missing, has other dims or units, or is not finite or
        # negative; the time is outside the series, or missing with more than one sample; ``direct_fraction``
        # is not from 0 to 1.
        #
        # Warns `PaintWarning`: Noise around zero, down to -1 % of the largest value, is set to 0.
        # Wavelengths [nm] and irradiance [W m-2 nm-1] of a series at one time
        arrays = require(
            series, ["irradiance", "irradiance_wavelength"], "the atmosphere of an irradiance series"
        )
        values = np.asarray(arrays["irradiance"].values, dtype=np.float64)
        grid = np.asarray(arrays["irradiance_wavelength"].values, dtype=np.float64)
        check_wavelengths(grid)
        first = last = 0  # samples before and after the time
        weight = 0.0
        SchemaError.raise_if(
            time is None and len(values) != 1,
            f"the irradiance series has {len(values)} samples",
            expected="1 without time",
            mend="pass time= in UTC",
            code="argument-missing",
        )
        if time is not None:
            times = require(series, ["irradiance_time"], "the irradiance at one time")[
                "irradiance_time"
            ].values
            stamps = times.astype("datetime64[ns]").astype(np.int64)
            moment = moment_of(time)
            SchemaError.raise_if(
                np.isnat(moment),
                f"time is {time!r}",
                expected="UTC such as '2020-06-21T17:00:15'",
                code="time-unreadable",
            )
            time_ns = moment.astype(np.int64)
            SchemaError.raise_if(
                not len(stamps) or not stamps[0] <= time_ns <= stamps[-1],
                f"time {moment} is outside the irradiance series",
                expected=f"from {times[0]} to {times[-1]}" if len(stamps) else "a series with samples",
                code="irradiance-coverage",
            )
            if len(stamps) > 1:
                last = min(max(int(np.searchsorted(stamps, time_ns)), 1), len(stamps) - 1)
                first = last - 1
                weight = (time_ns - stamps[first]) / (stamps[last] - stamps[first])
        total = values[first] + weight * (values[last] - values[first])
        # set small negative noise to 0; larger negative values are kept and refused later
        if -_NOISE * total.max() <= total.min() < 0.0:
            warn_user(
                f"{int((total < 0.0).sum())} of {total.size} irradiances below zero, down to "
                f"{total.min():.3g}, were set to 0",
                "irradiance-negative",
            )
            total = np.maximum(total, 0.0)
        if direct_fraction is None:
            sun, sky = built_in_sky(grid, sun_zenith)
            level = sun * np.cos(np.radians(sun_zenith))
            direct_fraction = level / (level + sky)
        fraction = np.asarray(direct_fraction, dtype=np.float64)
        share = SKY["direct_fraction"]
        SchemaError.raise_if(
            fraction.shape not in ((), grid.shape) or any(map(share.fault, fraction.ravel().tolist())),
            f"direct_fraction of shape {fraction.shape}",
            expected=f"{share.expected}, or an array of such numbers of shape {grid.shape}",
            code="value-out-of-range",
        )
        sun = total * fraction / np.cos(np.radians(sun_zenith))
        sky = total * (1.0 - fraction)
        return cls._with_haze(
            grid,
            sun,
            sky,
            haze,
            sun_zenith=sun_zenith,
            sun_azimuth=sun_azimuth,
            overcast_share=overcast_share,
            name=name,
        )

    @classmethod
    def from_table(
        cls,
        table: str | Path | Mapping[str, npt.ArrayLike],
        *,
        sun_zenith: float,
        sun_azimuth: float = 180.0,
        overcast_share: float = 0.0,
        haze: Haze | None = None,
        name: str | None = None,
    ) -> Atmosphere:
        # Return the atmosphere of a table, for example with results of MODTRAN or libRadtran.
        #
        # ``table``: A text file of comma-separated columns with comments after ``#``, or a mapping of
        # columns. Headings are a name and units: ``wavelength [nm]``, ``sun [W m-2 nm-1]`` (normal to the
        # beam), ``sky [W m-2 nm-1]`` (on a level surface), and, both or neither, ``extinction [m-1]`` and
        # ``path_radiance [W m-2 sr-1 nm-1 m-1]``, or others of the same dimension. Or a Dataset from a reader
        # of `hyperpaint.io.skies`, whose ``sky_radiance``, if any, is fitted (`hyperpaint.light.fit_sky`).
        # ``sun_zenith``, ``sun_azimuth``, ``overcast_share``: See `Atmosphere`. ``haze``: The air before the
        # camera, if the table does not have it; None for no air. ``name``: Name of the atmosphere; by default
        # the name of the file.
        #
        # Raises `FormatError`: The table has another form; all problems are listed. Raises `SchemaError`: The
        # sun is not above the horizon.
        fitted = None
        if isinstance(table, Mapping) and "direct_normal" in table:
            sky_table = cast("xr.Dataset", table)
            variables = {"wavelength": "wavelength", "sun": "direct_normal", "sky": "diffuse"}
            curves = {
                name: np.asarray(
                    convert(sky_table[variable].reset_coords(drop=True), _COLUMNS[name]).values, np.float64
                )
                for name, variable in variables.items()
            }
            if "sky_radiance" in sky_table:
                fit = fit_sky(sky_table, sun_zenith)
                fitted = {key: fit["share"].sel(function=key).values for key in _SHARES}
                if (max_residual := float(fit["misfit"].max())) > _MAX_RESIDUAL:
                    source = sky_table.attrs.get("source", "the table")
                    warn_user(
                        f"clear-sky functions fit the radiance of {source} with a residual of "
                        f"{max_residual:.0%}",
                        "sky-fit-poor",
                    )
        else:
            curves = read_table(table)
        if name is None:
            name = "table" if isinstance(table, Mapping) else Path(table).stem
        options: dict[str, Any] = {
            "sun_zenith": sun_zenith,
            "sun_azimuth": sun_azimuth,
            "overcast_share": overcast_share,
        }
        air = [curves[name] for name in ("extinction", "path_radiance") if name in curves]
        grid, sun, sky = curves["wavelength"], curves["sun"], curves["sky"]
        hazy = cls._with_haze(grid, sun, sky, None if air else haze, spread=fitted, **options, name=name)
        return replace(hazy, extinction=air[0], path_radiance=air[1]) if air else hazy

    def clouded(self, oktas: float, *, colour: float = 0.24) -> Atmosphere:
        """Return this clear atmosphere under clouds; `hyperpaint.simulation.atmosphere` has the model.

        Parameters
        ----------
        oktas
            Cloud amount, 0 to 8.
        colour
            Strength of the blue tint, 0 to 1.

        Raises
        ------
        SchemaError
            ``oktas`` or ``colour`` is outside its range.

        Examples
        --------
        >>> overcast = Atmosphere.clear(40.0).clouded(8)
        >>> bool((overcast.sun == 0.0).all()), round(overcast.overcast_share, 3)
        (True, 0.571)
        """
        cover = oktas / 8.0
        transmittance = cloud_transmittance(self.wavelength, oktas, colour=colour)
        sun = self.sun * (1.0 - cover)
        sky = self.irradiance * transmittance - sun * self.sun_cosine
        # without haze the phase function is unknown: path radiance in proportion to the light in the air
        before, after = self.sun + 2.0 * self.sky, sun + 2.0 * sky
        path = (
            self.path_radiance * np.divide(after, before, out=np.zeros_like(after), where=before > 0)
            if self.haze is None
            else self.haze.path_radiance(self.wavelength, sun, sky, self.sun_zenith)
        )
        return replace(
            self,
            sun=sun,
            sky=sky,
            path_radiance=path,
            overcast_share=(1.0 - cover) * self.overcast_share + cover * CIE_OVERCAST_SHARE,
            molecular=(1.0 - cover) * self.molecular,
            aureole=(1.0 - cover) * self.aureole,
            name=f"{self.name}, {oktas:g} oktas" if self.name else f"{oktas:g} oktas",
        )

    def to_dataset(self) -> xr.Dataset:
        # Return the curves as labelled variables on ``wavelength``, with CF units.
        variables = {
            name: (
                () if name in _NUMBERS else "wavelength",
                np.asarray(getattr(self, name), np.float64),
                {"units": units, "long_name": text},
            )
            for name, (units, text) in (_CURVES | _SHARES | _NUMBERS).items()
        }
        grid = ("wavelength", self.wavelength, {"units": "nm", "long_name": "Wavelength"})
        haze = "" if self.haze is None else json.dumps(asdict(self.haze))
        return xr.Dataset(variables, {"wavelength": grid}, {"name": self.name, "haze": haze})

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Atmosphere:
        # Return the atmosphere that `to_dataset` wrote.
        #
        # Raises `SchemaError`: Variables are missing, or their values cannot be used; all are listed. Raises
        # `UnitsError`: A variable has no units, or units of another quantity.
        problems = Problems("an atmosphere cannot be read", SchemaError)
        for name in ("wavelength", *_CURVES, *_NUMBERS):
            problems.add_if(name not in dataset.variables, f"{name!r} is missing", code="variable-missing")
        problems.raise_if_any()
        sun, sky, extinction, path = (
            convert(dataset[name], units).values for name, (units, _) in _CURVES.items()
        )
        # older datasets without shares have a uniform sky
        shares = {name: convert(dataset[name], "1").values for name in _SHARES if name in dataset.variables}
        zenith, azimuth, share = (
            float(convert(dataset[name], units)) for name, (units, _) in _NUMBERS.items()
        )
        grid = convert(dataset["wavelength"].reset_coords(drop=True), "nm").values
        try:
            text = dataset.attrs.get("haze", "")
            haze = Haze(**json.loads(text)) if text else None
        except (ValueError, TypeError) as error:
            raise SchemaError(
                f"attribute 'haze' is {text!r}",
                expected="the JSON text that to_dataset writes",
                code="metadata-damaged",
            ) from error
        name = str(dataset.attrs.get("name", ""))
        return cls(grid, sun, sky, extinction, path, zenith, azimuth, share, name, haze, **shares)


def read_table(table: str | Path | Mapping[str, npt.ArrayLike]) -> dict[str, Floats]:
    # curves of a table by name, in the units of `Atmosphere`; see `Atmosphere.from_table`
    if isinstance(table, Mapping):
        problems = Problems("the table of an atmosphere cannot be used", FormatError)
        headings, arrays = list(table), []
        for heading, column in table.items():
            try:
                arrays.append(np.asarray(column, dtype=np.float64))
            except (ValueError, TypeError):
                problems.add(f"column {heading!r} does not hold numbers", code="number-unreadable")
        shapes = sorted({array.shape for array in arrays})
        problems.add_if(
            not problems and (len(shapes) != 1 or len(shapes[0]) != 1),
            f"columns have shapes {shapes}",
            expected="one dim and the same length",
            code="length-mismatch",
        )
        problems.raise_if_any()
        rows = np.stack(arrays, axis=1)
    else:
        problems = Problems(f"{Path(table).name}: not the table of an atmosphere", FormatError)
        headings, rows = _read_rows(Path(table), problems)
    problems.raise_if_any()
    # column of every curve, and the factor to the units of `Atmosphere`
    factors: dict[str, tuple[int, float]] = {}
    for column, heading in enumerate(headings):
        match = _HEADING.fullmatch(str(heading).strip())
        name, units = (match[1].lower(), match[2].strip()) if match else ("", "")
        if match is None:
            problems.add(
                f"heading {str(heading)[:60]!r}",
                expected="a name and units such as 'sun [W m-2 nm-1]'",
                code="heading-unreadable",
            )
        elif name not in _COLUMNS:
            problems.add(
                f"column {name!r} is unknown",
                expected=f"some of {', '.join(_COLUMNS)}",
                code="column-unknown",
            )
        elif name in factors:
            problems.add(f"column {name!r} appears twice", code="column-duplicate")
        else:
            try:
                factors[name] = (column, conversion_factor(units, _COLUMNS[name]))
            except UnitsError as error:
                problems.add_error(f"column {name!r}", error)
    absent = [name for name in _REQUIRED if name not in factors]
    problems.add_if(
        absent and not problems,
        f"column {' and '.join(absent)} is missing",
        expected=", ".join(_REQUIRED),
        code="column-missing",
    )
    problems.add_if(
        ("extinction" in factors) != ("path_radiance" in factors),
        "only one of extinction and path_radiance is present",
        mend="add the other, or remove it",
        code="column-missing",
    )
    problems.raise_if_any()
    curves = {name: rows[:, column] * factor for name, (column, factor) in factors.items()}
    check_curves(problems, curves)
    problems.raise_if_any()
    return curves


def _read_rows(path: Path, problems: Problems) -> tuple[list[str], Floats]:
    # headings and numbers (row, column) of a text file
    content = read_limited(path, _MAX_BYTES, "the table of an atmosphere")
    if (count := max(content.count(b"\n"), content.count(b"\r"))) > _MAX_LINES:
        problems.add(f"{count} lines", expected=f"at most {_MAX_LINES}", code="file-too-large")
        problems.raise_if_any()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problems.add(f"it is not UTF-8 text (byte {error.start})", code="text-unreadable")
        problems.raise_if_any()
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        problems.add(
            "it is empty",
            expected="headings such as 'wavelength [nm], sun [W m-2 nm-1], sky [W m-2 nm-1]'",
            code="empty-input",
        )
        problems.raise_if_any()
    headings = [heading.strip() for heading in lines[0][1].split(",")]
    rows = []
    for number, line in lines[1:]:
        cells = line.split(",")
        try:
            if len(cells) != len(headings) or "_" in line:  # Python reads 1_0 as 10
                raise ValueError
            rows.append([float(cell) for cell in cells])
        except ValueError:
            problems.add(
                f"line {number}: {line[:60]!r}",
                expected=f"{len(headings)} numbers",
                code="number-unreadable",
            )
            if len(problems) == _MAX_PROBLEMS:
                break
    return headings, np.array(rows, dtype=np.float64).reshape(len(rows), len(headings))


#: Zenith angle and azimuth of the sun in the three atmospheres of the paper [degree].
PRESETS = {"noon": (25.0, 180.0), "near_sunset": (82.0, 265.0), "cloudy": (25.0, 180.0)}


@functools.cache
def preset_atmosphere(name: str) -> Atmosphere:
    """Return one of the paper's three atmospheres.

    "noon" is clear with the sun 25 degrees from the zenith in the south; "near_sunset" is clear with the sun
    82 degrees from the zenith in the west; "cloudy" is noon under 8 oktas, a completely overcast sky.

    Parameters
    ----------
    name
        One of `PRESETS`.

    Returns
    -------
    Atmosphere
        The same object at every call.

    Raises
    ------
    SchemaError
        The preset is unknown.

    Examples
    --------
    >>> preset_atmosphere("near_sunset").sun_zenith
    82.0
    """
    one_of(name, PRESETS, "preset")
    clear = Atmosphere.clear(*PRESETS[name], name=name)
    return replace(clear.clouded(8.0), name=name) if name == "cloudy" else clear
