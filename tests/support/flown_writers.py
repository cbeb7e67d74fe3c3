"""A camera that records: writes a finished flight anew, frame by frame, at a rate of its own.

    python tests/support/flown_writers.py COLLECT_FOLDER COPY

Frames, rows of frame index and navigation, and spectra of the record come at the time at which they would.
"""

from __future__ import annotations

import argparse
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

FRAME_LINES = 8
"""Frames between two flushes."""


class Recording:
    """A flight that is written anew in a copy of its collect; `record` writes up to a time."""

    def __init__(self, source: Path, copy: Path, *, header: str = "planned") -> None:
        from hyperpaint.io.envi.envi_header import read_header

        self.header_style = header
        copy.mkdir(parents=True, exist_ok=True)
        for entry in source.iterdir():
            if entry.name in ("flight", "asd", "products", "truth.zarr"):
                continue
            target = copy / entry.name
            if not target.exists():
                (shutil.copytree if entry.is_dir() else shutil.copy2)(entry, target)
        self.flight, self.sky = copy / "flight", copy / "asd"
        self.flight.mkdir(exist_ok=True)
        self.sky.mkdir(exist_ok=True)
        raw = source / "flight"
        shutil.copy2(raw / "settings.txt", self.flight)
        self._header = (raw / "raw_0.hdr").read_text()
        layout = read_header(raw / "raw_0.hdr")
        self.lines = layout.lines
        self._cube = np.memmap(raw / "raw_0", np.uint8, "r").reshape(self.lines, layout.line_bytes)
        self._index = (raw / "frameIndex_0.txt").read_bytes().splitlines(keepends=True)
        self._poses = (raw / "imu_gps.txt").read_bytes().splitlines(keepends=True)
        column = self._poses[0].split(b"\t").index(b"Timestamp")
        #: Times of lines and poses on the instrument's clock [s], from the first line on
        lines_us = np.array([int(row.split()[1]) for row in self._index[1:]])
        poses_us = np.array([int(row.split(b"\t")[column]) for row in self._poses[1:]])
        self._line_s, self._pose_s = ((each - lines_us[0]) * 1e-6 for each in (lines_us, poses_us))
        self._spectra = sorted((source / "asd").glob("*.asd"))
        self._spectrum_s = self._times_of_spectra(source)
        self.at = [0, 0, 0]
        if header != "late":
            self._write_header(0 if header == "zero" else self.lines)

    def _times_of_spectra(self, source: Path) -> np.ndarray:
        """Return when the spectra were saved [s]: at the end of what they average."""
        from hyperpaint.workflows.laboratory import open_collect

        tree = open_collect(source / "collect.toml")
        middles = tree["irradiance"]["irradiance_time"].values
        first = tree["flightlines/raw_0"]["time"].values[0]
        half = float(tree["irradiance"].attrs["irradiance_averaging_s"]) / 2.0
        return (middles - first) / np.timedelta64(1, "s") + half

    def _write_header(self, lines: int) -> None:
        text = re.sub(r"(?m)^lines = .*$", f"lines = {lines}", self._header)
        (self.flight / "raw_0.hdr").write_text(text)

    @property
    def length_s(self) -> float:
        """Until all is written."""
        return float(max(self._line_s[-1], self._pose_s[-1], self._spectrum_s[-1]))

    def record(self, until_s: float) -> int:
        """Write what comes up to a time [s]; return how many lines are there."""
        stops = [int(np.searchsorted(each, until_s, side="right"))
                 for each in (self._line_s, self._pose_s, self._spectrum_s)]  # fmt: skip
        for name, rows, stop, place in (
            ("frameIndex_0.txt", self._index, stops[0], 0), ("imu_gps.txt", self._poses, stops[1], 1),
        ):  # fmt: skip
            with open(self.flight / name, "ab") as file:
                head = rows[:1] if file.tell() == 0 else []
                file.write(b"".join((*head, *rows[self.at[place] + 1 : stop + 1])))
        with open(self.flight / "raw_0", "ab") as file:
            file.write(self._cube[self.at[0] : stops[0]])
        for path in self._spectra[self.at[2] : stops[2]]:
            shutil.copyfile(path, self.sky / path.name)
        self.at = stops
        return stops[0]

    def finish(self) -> None:
        """Write all that is left, and the header as it is in the end."""
        self.record(self.length_s + 1.0)
        self._write_header(self.lines)

    def run(self, pace: float = 1.0, clock: Callable[[], float] = time.perf_counter) -> None:
        """Write in real time, or ``pace`` times as fast."""
        step = FRAME_LINES * float(self._line_s[-1]) / (self.lines - 1)
        before = float(min(self._spectrum_s[0], 0.0))
        begun, now = clock(), before
        while now < self.length_s:
            now = before + (clock() - begun) * pace
            self.record(now)
            time.sleep(max(0.0, step / pace - 0.001))
        self.finish()


def main() -> None:
    """Write a flight anew."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("copy", type=Path)
    parser.add_argument("--header", default="planned", choices=("planned", "zero", "late"))
    parser.add_argument("--pace", type=float, default=1.0)
    parsed = parser.parse_args()
    recording = Recording(parsed.source, parsed.copy, header=parsed.header)
    print("ready", flush=True)
    recording.run(parsed.pace)


if __name__ == "__main__":
    main()
