"""Real counts of a camera, its light sensor and a known panel: closure is far off, and is caught to be."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import PaintWarning
from hyperpaint.radiometry import panel_closure
from hyperpaint.radiometry.panels import PANEL_STATES

Image = pytest.importorskip("PIL.Image", reason="pillow, which reads the camera's TIFF, comes with extra viz")

pytestmark = pytest.mark.real_data

ROWS, COLUMNS = slice(490, 670), slice(660, 840)
"""Where the panel lies in the first capture; SOURCES.md says what is what."""
CERTIFIED = xr.DataArray(
    [0.67, 0.61], {"wavelength": ("wavelength", [475.0, 840.0], {"units": "nm"})}, attrs={"units": "1"}
)
EXPOSURE, SUBSECONDS, ISO, XMP, BLACK, EXIF = 33434, 37520, 34867, 700, 50714, 0x8769


class Frame(NamedTuple):
    # One band of a capture
    radiance: np.ndarray  # (row, column) [W m-2 sr-1 nm-1]
    wavelength: float
    fwhm: float
    irradiance: float  # [W m-2 nm-1]


def numbers(text: str, name: str) -> list[float]:
    held = re.search(rf"<\w+:{name}>(.*?)</\w+:{name}>", text, re.DOTALL)
    assert held, name
    return [float(each) for each in re.findall(r"-?\d+\.?\d*(?:e[+-]?\d+)?", held[1])]


def frame_of(path: Path) -> Frame:
    # Return radiance by the maker's formula
    # L = V a1 / g (p - p0) / (t + a2 y - a3 t y), p over 2^16, V one over a polynomial of the distance from
    # the centre of vignetting
    with Image.open(path) as image:
        counts = np.asarray(image, np.float64)
        (packet,) = image.tag_v2[XMP]
        text = packet.decode()
        black = float(np.mean(image.tag_v2[BLACK]))
        exif = image.getexif().get_ifd(EXIF)
    exposure, gain = float(exif[EXPOSURE]), float(exif[ISO]) / 100.0
    a1, a2, a3 = numbers(text, "RadiometricCalibration")
    y, x = np.mgrid[: counts.shape[0], : counts.shape[1]].astype(np.float64)
    x0, y0 = numbers(text, "VignettingCenter")
    away = np.hypot(x - x0, y - y0)
    fall = 1.0 + sum(k * away ** (n + 1) for n, k in enumerate(numbers(text, "VignettingPolynomial")))
    radiance = a1 / gain / fall * (counts - black) / 65536.0 / (exposure + a2 * y - a3 * exposure * y)
    single = (
        numbers(text, name)[0] for name in ("CentralWavelength", "WavelengthFWHM", "SpectralIrradiance")
    )
    return Frame(radiance, *single)


@pytest.fixture(scope="module")
def line(shared_data: Path) -> xr.Dataset:
    # Return the panel and what is around it as a flight line under what the light sensor read
    folder = shared_data / "rededge_panel"
    frames = sorted(
        (frame_of(folder / f"IMG_0000_{band}.tif") for band in range(1, 6)),
        key=lambda frame: frame.wavelength,
    )
    nm, fwhm = (np.array([getattr(frame, name) for frame in frames]) for name in ("wavelength", "fwhm"))
    cube = np.stack([frame.radiance[ROWS, COLUMNS] for frame in frames], axis=1).astype(np.float32)
    start = np.datetime64("2017-10-19T20:40:39", "ns")
    light = np.array([frame.irradiance for frame in frames], np.float32)
    grid = np.arange(400.0, 951.0)
    # as wide as the camera's bands, each of the sensor's channels is the light of its whole band
    variables = {
        "radiance": (schema.CUBE, cube),
        "irradiance": (
            ("irradiance_time", "irradiance_wavelength"),
            np.tile(light[np.abs(grid[:, None] - nm).argmin(axis=1)], (2, 1)),
        ),
        "irradiance_fwhm": ((), 3.0),
        "irradiance_max_gap": ((), 5.0),
        "time": (("along_track",), start + np.arange(len(cube)) * np.timedelta64(1_000_000, "ns")),
        "wavelength": (("band",), nm),
        "fwhm": (("band",), fwhm),
        "irradiance_time": (("irradiance_time",), start + np.array([-1, 1], "timedelta64[s]")),
        "irradiance_wavelength": (("irradiance_wavelength",), grid),
    }
    labelled = {name: (*value, schema.VARIABLES[name].attrs) for name, value in variables.items()}
    return xr.Dataset(labelled).set_coords(["time", "wavelength", "fwhm"])


PANEL = hp.Panel(slice(None), slice(None), CERTIFIED)


def test_closure_that_is_far_off_is_said(line: xr.Dataset) -> None:
    # 27 % too dark in the blue and 12 % too bright in the near infrared
    with pytest.warns(PaintWarning, match="panel-doubtful") as caught:
        closure = panel_closure(line, PANEL).compute()
    factor = closure.panel_factor.values[0]
    seen = factor * PANEL.at(line.wavelength.values)
    np.testing.assert_allclose(seen, [0.490, 0.572, 0.555, 0.533, 0.684], atol=0.004)
    np.testing.assert_allclose(factor[[0, -1]], [0.731, 1.121], atol=0.006)
    state = int(closure.panel_state[0])
    assert state & 1 << PANEL_STATES.index("off_level")
    assert not state & 1 << PANEL_STATES.index("refused")
    assert "measures 0.73" in str(caught[0].message)
    assert "to 1.12" in str(caught[0].message)


def test_the_panel_is_right_where_the_sensor_is_not(line: xr.Dataset) -> None:
    with pytest.warns(PaintWarning, match=r"median .*panel-doubtful"):
        scaled = hp.reflectance(line, panel=PANEL).compute()
    seen = np.median(scaled.reflectance.values, axis=(0, 2))
    np.testing.assert_allclose(seen, PANEL.at(line.wavelength.values), rtol=0.012)  # median over mean
