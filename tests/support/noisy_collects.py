"""Small collects of one grey-green surface, each with errors of its own, in plain numpy.

Nothing of the chain makes them: what it states is judged against how its means really scatter.
"""

from typing import Any

import numpy as np
import xarray as xr

from .strategies import START, labelled

BANDS = 24
WAVELENGTH = 520.0 + 2.2 * np.arange(BANDS)
COMMON = {
    "radiance_gain_u_systematic": 0.02,
    "irradiance_u_systematic": 0.015,
    "dark_counts_u_systematic": 0.3,
    "wavelength_u": 0.1,
}
_EXPOSURE_S, _GAIN, _ELECTRONS = 5e-3, 3e-7, 20.0
_ELEMENT = ("band", "cross_track")


def true_reflectance(nm: Any) -> Any:
    # Return a red edge: bands at its foot and on its shoulder have other errors
    return 0.05 + 0.4 / (1.0 + np.exp(-(np.asarray(nm) - 545.0) / 8.0))


def _light(nm: Any) -> Any:
    return 1.2 * (1.0 - 0.002 * (np.asarray(nm) - 545.0))


def noisy_collect(
    rng: np.random.Generator,
    lines: int,
    columns: int,
    darks: int,
    *,
    read_noise: float = 0.5,
    gain_u: float = 0.005,
    irradiance_u: float = 0.005,
    common: bool | dict[str, float] = False,
    smile: float = 0.0,
    masked: int = 0,
    dark_times: int = 1,
) -> xr.Dataset:
    # Return a collect whose errors are drawn anew; ``common`` may give errors of `COMMON` in standard
    # deviations, and none where it is empty; ``smile`` is the shift at the last column [nm]
    # ``darks`` frames are averaged in each of ``dark_times`` dark references, before and after the line;
    # ``masked`` columns see no light, and the pedestal of every line is another one
    u = COMMON if common else {}
    drawn_error = common if isinstance(common, dict) else {name: rng.standard_normal() for name in u}
    error = {name: u[name] * size for name, size in drawn_error.items()}
    shift = smile * (np.arange(columns) / max(columns - 1, 1)) ** 2
    seen = WAVELENGTH[:, None] + shift + error.get("wavelength_u", 0.0)
    own_gain = rng.normal(0.0, gain_u, (BANDS, columns))
    gain = _GAIN * (1.0 + error.get("radiance_gain_u_systematic", 0.0) + own_gain)
    signal = true_reflectance(seen) * _light(seen) / np.pi * _EXPOSURE_S / gain
    signal[:, :masked] = 0.0
    offset = rng.uniform(95.0, 105.0, (BANDS, columns))
    noise = rng.standard_normal((lines, BANDS, columns)) * np.sqrt(signal / _ELECTRONS + read_noise**2)
    pedestal = rng.normal(20.0, 3.0, (lines, 1, 1)) if masked else 0.0
    counts = np.rint(signal + offset + error.get("dark_counts_u_systematic", 0.0) + pedestal + noise)
    frames = rng.normal(offset, read_noise, (dark_times, darks, BANDS, columns)).round()
    seconds = 3.0 + 0.007 * np.arange(lines)
    samples = np.arange(0.0, seconds[-1] + 5.0, 2.0)
    channels = np.arange(480.0, 620.0)
    drawn = 1.0 + irradiance_u * rng.standard_normal((samples.size, channels.size))
    light = _light(channels) * (1.0 + error.get("irradiance_u_systematic", 0.0)) * drawn
    dark, at_dark = frames.mean(axis=1), seconds[[0, -1]][:dark_times]
    variables: dict[str, Any] = {
        "counts": (("along_track", *_ELEMENT), counts.astype(np.uint16)),
        "dark_counts": (("dark_time", *_ELEMENT), dark) if dark_times > 1 else (_ELEMENT, dark[0]),
        "dark_counts_u_random": (_ELEMENT, np.sqrt(frames.var(axis=1, ddof=1).mean(axis=0) / darks)),
        "radiance_gain": (_ELEMENT, np.full((BANDS, columns), _GAIN, np.float32)),
        "radiance_gain_u_random": (_ELEMENT, np.full((BANDS, columns), gain_u)),
        "exposure_time": ((), _EXPOSURE_S),
        "saturation_count": ((), np.float32(65000.0)),
        "read_noise": ((), np.float32(read_noise)),
        "electrons_per_count": ((), np.float32(_ELECTRONS)),
        "irradiance": (("irradiance_time", "irradiance_wavelength"), light.astype(np.float32)),
        "irradiance_fwhm": ((), 3.0),
        "irradiance_max_gap": ((), 100.0),
        "irradiance_u_random": ((), np.float32(irradiance_u)),
        "time": (("along_track",), START + (seconds * 1e9).round().astype("timedelta64[ns]")),
        "wavelength": (("band",), WAVELENGTH),
        "fwhm": (("band",), np.full(BANDS, 6.0)),
        "good": (("band",), np.ones(BANDS, bool)),
        "irradiance_time": (("irradiance_time",), START + (samples * 1e9).astype("timedelta64[ns]")),
        "irradiance_wavelength": (("irradiance_wavelength",), channels),
        **{name: ((), np.float32(size)) for name, size in u.items()},
    }
    if dark_times > 1:
        times = START + (at_dark * 1e9).round().astype("timedelta64[ns]")
        variables["dark_time"] = (("dark_time",), times)
    if masked:
        variables["masked"] = (("cross_track",), np.arange(columns) < masked)
    if smile:
        variables["wavelength_shift"] = (("cross_track",), shift)
    return labelled(variables, {"srf_shape": "gaussian", "irradiance_srf_shape": "gaussian", "name": "raw_0"})
