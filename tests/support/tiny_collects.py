"""Collects of many flight lines that are processed in a tenth of a second each."""

from pathlib import Path

import numpy as np

_HEADER = """ENVI
samples = 3
lines = 6
bands = 4
header offset = 0
file type = ENVI Standard
data type = 4
interleave = bil
byte order = 0
wavelength units = nm
wavelength = { 450, 550, 650, 750 }
fwhm = { 5, 5, 5, 5 }
"""


def tiny_collect(folder: Path, lines: int) -> Path:
    # Write cubes of radiance with a ``collect.toml``, as small as they can be; return that
    folder.mkdir()
    text = '[collect]\nname = "lot"\n[camera]\nexposure_time_ms = 5.0\nradiance_units = "uW cm-2 sr-1 nm-1"\n'
    for number in range(lines):
        values = np.random.default_rng(number).uniform(1.0, 10.0, (6, 4, 3))
        values.astype("<f4").tofile(folder / f"raw_{number}")
        (folder / f"raw_{number}.hdr").write_text(_HEADER)
        text += f'[[flightlines]]\nid = "raw_{number}"\ncube = "raw_{number}.hdr"\nframe_period_ms = 7.0\n'
        text += f'start_time = "2026-06-01T{10 + number // 60}:{number % 60:02d}:00Z"\n'
    (folder / "collect.toml").write_text(text)
    return folder / "collect.toml"


def without_references(collect: Path) -> Path:
    # Take the reference spectra out of a ``collect.toml``: reading and writing them is a third of a small run
    text = collect.read_text(encoding="utf-8")
    collect.write_text(text.partition("[[references]]")[0], encoding="utf-8")
    return collect
