"""Navigation files written here by hand."""

from pathlib import Path
from typing import Any

import numpy as np

POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "ns")
CSV_HEADER = (
    "time,latitude [degree],longitude [degree],altitude [m],roll [degree],pitch [degree],heading [degree]"
)
CSV_ROWS = (
    "2024-06-01T12:00:00Z,43.1,-77.6,150.5,1,-2,359.5",
    "2024-06-01T12:00:00.25Z,43.2,-77.7,151,2,-1,0.5",
)


def write_sbet(path: Path, seconds: Any, **columns: Any) -> Path:
    # Write 17 columns of float64: time, place [rad, m], velocity, attitude [rad], wander, and the rest
    records = np.zeros((len(seconds), 17), "<f8")
    records[:, 0] = seconds
    places = {"latitude": 1, "longitude": 2, "altitude": 3, "roll": 7, "pitch": 8, "heading": 9, "wander": 10}
    for name, values in columns.items():
        records[:, places[name]] = values
    path.write_bytes(records.tobytes())
    return path


def write_csv(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def seconds_since(time: Any, start: Any) -> list[float]:
    return ((time - np.datetime64(start, "ns")) / np.timedelta64(1, "ns") / 1e9).tolist()
