"""A flight in the files of a Headwall camera, written here by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.io.flightline.flightline_opening import open_flightline

LINES, BANDS, COLUMNS = 70, 3, 4
T0 = np.datetime64("2021-07-23T12:00:00", "ns")
NM = {"units": "nm"}
GAIN = {"units": "W m-2 sr-1 nm-1 s count-1"}
ELEMENT = ("band", "cross_track")


def write_cube(
    folder: Path, name: str, counts: np.ndarray[Any, Any], comments: str = "", **keys: str
) -> Path:
    # Write a bil cube as Headwall does: the wavelengths led by commas, the comments last
    folder.mkdir(exist_ok=True)
    codes = {"uint8": 1, "int16": 2, "float32": 4, "uint16": 12}
    counts.tofile(folder / name)
    lines, bands, samples = counts.shape
    wavelength = "\n,".join(str(500 + 100 * band) for band in range(bands))
    fields = {
        "description": "{[HEADWALL Hyperspec III]}",
        "samples": samples, "lines": lines, "bands": bands, "header offset": 0,
        "data type": codes[counts.dtype.name], "interleave": "bil", "byte order": 0,
        "wavelength units": "nm", "wavelength": f"{{\n{wavelength}\n}}",
        **{key.replace("_", " "): value for key, value in keys.items()},
    }  # fmt: skip
    text = "ENVI\n" + "".join(f"{key} = {value}\n" for key, value in fields.items()) + comments
    header = folder / f"{name}.hdr"
    header.write_bytes(text.replace("\n", "\r\n").encode())
    return header


def write_index(path: Path, frames: np.ndarray[Any, Any]) -> Path:
    rows = "".join(f"{frame}\t{1_000_000 + 7000 * frame}\r\n" for frame in frames)
    path.write_bytes(f"Frame#\tTimestamp\r\n{rows}".encode())
    return path


def write_nav(path: Path, seconds: float = 1.0) -> Path:
    rows = ["Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\tStatus\tHeading"]
    for step in range(round(seconds * 100) + 1):
        utc = (T0 + np.timedelta64(10 * step, "ms")).astype("datetime64[us]").item()
        date = utc.strftime("%Y/%m/%d %H:%M:%S.%f")
        rows.append(f"0.1\t0.2\t90\t43.1\t-77.6\t{15 + step}\t{1_000_000 + 10_000 * step}\t{date}\t4\t90")
    path.write_bytes("\r\n".join(rows).encode())
    return path


def make_calibration(**changes: Any) -> xr.Dataset:
    made = xr.Dataset(
        {"radiance_gain": (ELEMENT, np.full((BANDS, COLUMNS), 2e-6), GAIN)},
        {
            "wavelength": ("band", [500.0, 600.0, 700.0], NM),
            "fwhm": ("band", [6.0, 6.0, 6.0], NM),
            "wavelength_shift": ("cross_track", [0.5, 0.1, 0.0, 0.2], NM),
        },
        {"srf_shape": "slit"},
    )  # fmt: skip
    return made.assign(changes)


def make_irradiance(start_s: float = -100.0, stop_s: float = 100.0, every_s: float = 2.0) -> xr.Dataset:
    times = T0 + (np.arange(start_s, stop_s, every_s) * 1e9).astype("timedelta64[ns]")
    wavelength = np.arange(400.0, 801.0, 100.0)
    values = np.ones((times.size, wavelength.size), np.float32)
    return xr.Dataset(
        {
            "irradiance": (("irradiance_time", "irradiance_wavelength"), values, {"units": "W m-2 nm-1"}),
            "irradiance_fwhm": ((), 3.0, NM),
            "irradiance_max_gap": ((), 5.0, {"units": "s"}),
        },
        {"irradiance_time": times, "irradiance_wavelength": ("irradiance_wavelength", wavelength, NM)},
        {"irradiance_srf_shape": "gaussian"},
    )


def arguments(folder: Path, **changes: Any) -> dict[str, Any]:
    made = {
        "cube": folder / "flight" / "raw_0.hdr",
        "frame_index": folder / "flight" / "frameIndex_0.txt",
        "nav": folder / "flight" / "imu_gps.txt",
        "dark": folder / "dark" / "raw_0.hdr",
        "calibration": make_calibration(),
        "irradiance": make_irradiance(),
    }
    return {**made, **changes}


def open_line(folder: Path, **changes: Any) -> xr.Dataset:
    made = arguments(folder, **changes)
    return open_flightline(made.pop("cube"), **made)
