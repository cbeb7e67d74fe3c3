"""A writer of ``.sig`` files in any dialect, independent of the package's readers and simulator."""

import numpy as np

# three short detectors that overlap twice
GRID = np.concatenate(
    [np.arange(400.0, 1011.0, 10.0), np.arange(965.0, 1911.0, 15.0), np.arange(1890.0, 2500.0, 20.0)]
)
PANEL = np.round(20000.0 - 5.0 * (GRID - 400.0), 2)
SURFACE = np.round(PANEL * (0.2 + 0.3 * np.sin(GRID / 200.0) ** 2), 2)
MATCHED = "Matching Type: Radiance @ 976 - 1010 / NIR-SWIR On"


def svc_text(
    wavelength=GRID,
    panel=PANEL,
    surface=SURFACE,
    percent=None,
    *,
    first="/*** Spectra Vista SIG Data ***/",
    separator="  ",
    data="data= ",
    end="\r\n",
    **keys,
):
    # Return a file; ``keys`` replace lines of the header: ``_`` is a blank there, None leaves one out
    header = {
        "name": "paint.sig",
        "instrument": "HI: 1152050 (HR-test)",
        "integration": "70.0, 9.0, 7.0, 200.0, 30.0, 7.0",
        "scan coadds": "28, 170, 205, 10, 61, 205",
        "error": "7, 3",
        "units": "Radiance, Radiance",
        "time": "27.05.2025 09:39:32, 27.05.2025 09:42:59",
        "longitude": "01332.0665E     , 01332.0490E     ",
        "latitude": "5225.9761N      , 5225.9748N      ",
        "gpstime": "073923.357      , 074250.357      ",
        "comm": "",
        "factors": "1.080, 1.133, 1.000 [Overlap: Preserve, Matching Type: None]",
    }
    header |= {key.replace("_", " "): value for key, value in keys.items()}
    lines = [first, *(f"{key}= {value}" for key, value in header.items() if value is not None), data]
    if percent is None:
        with np.errstate(all="ignore"):
            percent = 100.0 * np.asarray(surface) / np.asarray(panel)
    columns = (wavelength, panel, surface, percent)
    for nm, *values in zip(*columns, strict=True):
        lines.append(separator.join([f"{nm:.1f}", *(f"{value:.2f}" for value in values)]))
    return end.join(lines) + end


def german(text):
    # Return a file as a PC in Germany saves it: decimal commas, also inside lists
    lines, table = [], False
    for line in text.splitlines():
        key = line.partition("=")[0]
        if table or key in ("integration", "temp", "vis detector temp", "battery"):
            line = line.replace(".", ",")
        elif key == "factors":
            numbers, bracket, rest = line.partition("[")
            line = numbers.replace(".", ",") + bracket + rest
        elif key == "time":
            stamps = [stamp.split() for stamp in line.partition("= ")[2].split(", ")]
            line = f"time= {', '.join(_german_stamp(*parts) for parts in stamps)}"
        table |= key == "data"
        lines.append(line)
    return "\r\n".join(lines) + "\r\n"


def _german_stamp(date, clock, half=""):
    month, day, year = map(int, date.split("/"))
    hour, minute, second = map(int, clock.split(":"))
    hour = hour % 12 + 12 * (half == "PM") if half else hour
    return f"{day:02d}.{month:02d}.{year} {hour:02d}:{minute:02d}:{second:02d}"
