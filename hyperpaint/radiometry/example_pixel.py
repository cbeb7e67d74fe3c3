"""The worked example: one pixel of known reflectance, with its calibration and light."""

import numpy as np
import xarray as xr

from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    VARIABLES,
)


def worked_example() -> xr.Dataset:
    # Return one pixel whose reflectance is 0.4 by construction (three equal columns, three bands).
    #
    # E 1.3 W m-2 nm-1 on a surface of reflectance 0.4; etendue 1.8598e-11 m2 sr, 5 ms, bands 6 nm wide of
    # peak response 2e16 counts per joule: 1966.09 counts above the dark.
    gaussian_area = np.sqrt(np.pi / (4 * np.log(2)))
    etendue, exposure, peak, fwhm = 1.8598e-11, 5e-3, 2.0e16, 6.0
    gain = 1.0 / (etendue * peak * gaussian_area * fwhm)
    counts = exposure * 0.4 * 1.3 / np.pi / gain
    time = np.datetime64("2020-06-21T17:00:00", "ns")
    variables = {
        "counts": (CUBE, np.full((1, 3, 3), counts + 100.0, np.float32)),
        "dark_counts": ((BAND, CROSS_TRACK), np.full((3, 3), 100.0, np.float32)),
        "radiance_gain": ((BAND, CROSS_TRACK), np.full((3, 3), gain, np.float32)),
        "exposure_time": ((), exposure),
        "saturation_count": ((), np.float32(4095.0)),
        "irradiance": ((IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH), np.full((2, 301), 1.3, np.float32)),
        "irradiance_fwhm": ((), 3.0),
    }
    coords = {
        "time": (ALONG_TRACK, [time + np.timedelta64(1, "s")]),
        "wavelength": (BAND, [548.0, 550.0, 552.0]),
        "fwhm": (BAND, np.full(3, fwhm)),
        IRRADIANCE_TIME: time + np.array([0, 2], "timedelta64[s]"),
        IRRADIANCE_WAVELENGTH: np.arange(400.0, 701.0),
    }
    line = xr.Dataset(variables, coords)
    for name in line.variables:
        line[name].attrs = dict(VARIABLES[str(name)].attrs)
    return line
