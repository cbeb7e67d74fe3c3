"""Whole files that mutations start from: a small collect, and what other programs write; see `parsers`."""

from __future__ import annotations

from pathlib import Path

from .seed_files import write_side_inputs

__all__ = ["prepare", "sixs_text"]


def prepare(folder: Path) -> None:
    """Write the simulated seeds: a small collect, and the variants of its files that other programs write."""
    from hyperpaint.simulation import simulate_collect

    simulate_collect(folder, scene="plan", lines=24, bands=4, columns=6, overwrite=True)
    _write_libraries(folder / "library")
    times = [f"12:00:{step // 10:02d}.{step % 10}" for step in range(30)]
    micro = [f"12:00:{step // 10:02d} {step % 10}00000" for step in range(30)]
    spectra = "".join(f",{1.0 + band / 100:.3f}" for band in range(60))
    head = "".join(f",{400 + 10 * band}" for band in range(60))
    nav = "0.1\t0.2\t90.5\t43.1\t-77.6\t150.0"
    columns = "".join(f"{0.4 + band / 100:.7f}\t{0.9 - band / 100:.6f}\n" for band in range(60))
    written = {
        "sky.csv": "# units: W m-2 nm-1\n# fwhm_nm: 3\n"
        + f"time{head}\n"
        + "".join(f"2024-05-21T{time}Z{spectra}\n" for time in times),
        "zone.csv": f"time{head}\n" + "".join(f"2024-05-21 {time}{spectra}\n" for time in times),
        "sky.txt": "Wavelength\tsky.asd\tsky2.asd\r\n"
        + "".join(f"{nm}\t{nm / 900:.6f}\t{nm / 800:.4E}\r\n" for nm in range(350, 650)),
        "frameIndex_time.txt": "Frame#\tTime\r\n"
        + "".join(f"{row}\t{time}\r\n" for row, time in enumerate(micro)),
        "frameIndex_seconds.txt": "Frame#\tTime\r\n"
        + "".join(f"{row}\t12:00:{row // 10:02d}\r\n" for row in range(40)),
        "imu_gps_month.txt": "Roll\tPitch\tYaw\tLat\tLon\tAlt\tSystemTime\tGPS_UTC\tGps_UTC_Date&Time\r\n"
        + "".join(f"{nav}\t{1000000 + row}\t{row}\t2021/Jul/20 {time}\r\n" for row, time in enumerate(times)),
        "imu_gps_time.txt": "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTime\r\n"
        + "".join(f"{nav}\t{time}\r\n" for time in micro),
        "settings_comments.txt": "Exposure (ms) = 5.0\r\nExposure = 5.0 ms\r\n[camera]\r\nfps=140\r\n",
        "paint.ems": "2\n" + "1.0\n" * 91 + 2 * ("CURVE_BEGIN\n" + columns),
        "paint.txt": columns,
        "table.csv": "# lab\nwavelength (nm);red (%);blue (%)\n"
        + "".join(f"{400 + band};{band},5;{60 - band},25\n" for band in range(60)),
        "paints.mat": "MATERIAL_MAP {\n    LUT {\n        0:red\n    }\n}\n\nMATERIAL_ENTRY {\n    ID = red\n"
        "    NAME = red, matt\n\n    SURFACE_PROPERTIES {\n        EMISSIVITY_PROP_NAME = ClassicEmissivity\n"
        "        EMISSIVITY_PROP {\n            FILENAME          = emissivity/red.ems\n"
        "            SPECULAR_FRACTION = 0.1\n        }\n    }\n}\n",
        **_sky_texts(),
        "gps_time.txt": "PC\tPOS\r\n"
        + "".join(f"{pc}\t2021/07/20 {time}\r\n" for pc, time in zip(micro, times, strict=True)),
    }
    for name, text in written.items():
        (folder / name).write_bytes(text.encode())
    _write_navigation(folder)
    write_side_inputs(folder)


def sixs_text(micron: float) -> str:
    return (
        f"*  monochromatic calculation at wl : {micron:.3f} micron *\n"
        "*   irr. at ground level (w/m2/mic)   *\n"
        "*     direct solar irr.    atm. diffuse irr.    environment  irr   *\n"
        "*       500.000             180.000               4.000      *\n"
    )


def _sky_texts() -> dict[str, str]:
    """Return light at the ground by name of a file, in every format that is read."""
    import numpy as np

    cosines, azimuths = np.cos(np.radians(np.arange(5.0, 86.0, 20.0))), "0.0 60.0 120.0 180.0"
    sky = "".join(f" {-cosine:.6f} 0.0 {'40.0 ' * 4}\n" for cosine in cosines)
    tape = "FREQ TOT_TRANS THRML_EM THRML_SCT SURF_EMIS MULT_SCAT SING_SCAT GRND_RFLT DRCT_RFLT"
    return {
        "sixs.txt": sixs_text(0.45),
        "uvspec.out": "".join(f" {nm} 500.0 180.0 1. 1. 1. 1.\n {azimuths}\n{sky}" for nm in (450.0, 550.0)),
        "tape7": f"   1   5\n STANDARD\n {tape}\n"
        + "".join(f"{nu:9.2f} 0.8 0 0 0 0 0 2e-10 1e-10\n" for nu in (22222.0, 18182.0, 11765.0))
        + "  -9999.\n",
        "radiances.csv": "wavelength [um],zenith [degree],azimuth [degree],radiance [mW m-2 sr-1 nm-1],"
        "direct_normal [mW m-2 nm-1],diffuse [mW m-2 nm-1]\n"
        + "".join(
            f"{nm},{zenith},{azimuth},45.5,1000,200\n"
            for nm in (0.45, 0.55) for azimuth in (0.0, 90.0) for zenith in (10.0, 40.0, 70.0)
        ),
    }  # fmt: skip


def _write_navigation(folder: Path) -> None:
    """Write a short flight in every format of navigation but Headwall's."""
    import numpy as np

    rows = np.arange(30.0)
    seconds = 300_000.0 + rows / 100.0
    flat = np.zeros_like(rows)
    angles = [0.01 * np.sin(rows), 0.02 * np.cos(rows), 3.0 + rows / 1000.0]
    place = [0.75 + rows * 1e-8, -1.35 + flat, 150.0 + flat]
    sbet = np.stack([seconds, *place, *[flat] * 3, *angles, *[flat] * 7], axis=1)
    sbet.astype("<f8").tofile(folder / "flight.sbet")
    degrees = [43.1 + rows * 1e-6, -77.6 + flat, 150.0 + flat]
    lcf = np.stack([1.3e9 + rows / 100.0, *angles, degrees[1], degrees[0], degrees[2], flat, flat], axis=1)
    np.savetxt(folder / "flight.lcf", lcf, "%.9f", "\t")
    eph = folder / "ang20170323t202244_eph_att"
    np.stack([418977.0 + rows / 10.0, *degrees, *angles], axis=1).astype("<f8").tofile(eph)
    eph.with_name(eph.name + ".hdr").write_text(
        "ENVI\nsamples = 1\nlines = 30\nbands = 7\nheader offset = 0\ndata type = 5\ninterleave = bip\n"
        "byte order = 0\nmap info = {  }\n"
        "band names = { gpstime , lat , lon , alt , pitch , roll , heading }\n"
    )
    names = "latitude [degree],longitude [degree],altitude [m],roll [rad],pitch [rad],heading [rad]"
    values = [",".join(f"{value:.9f}" for value in row) for row in np.stack([*degrees, *angles], axis=1)]
    (folder / "flight.csv").write_text(
        f"# column_order: left_to_right\n# roll_positive: right_wing_up\ntime,{names}\n"
        + "".join(f"2024-06-01T12:00:{i // 10:02d}.{i % 10}Z,{row}\n" for i, row in enumerate(values))
    )
    (folder / "flight_gps.csv").write_text(
        f"# gps_week: 2158\n# leap_seconds: 18\ngps_time [s];{names.replace(',', ';')}\n"
        + "".join(f"{300_000 + i / 10:.2f};{row.replace(',', ';')}\n" for i, row in enumerate(values))
    )


def _write_libraries(folder: Path) -> None:
    """Write a small paint library in every format whose files are read."""
    import numpy as np
    import xarray as xr

    from hyperpaint.io.library import write_library

    members = np.linspace(0.01, 0.99, 3 * 4 * 20, dtype=np.float32).reshape(3, 4, 20)
    members[1, 2:] = np.nan
    paints = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.ascontiguousarray(members[:, 0]), {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), members, {"units": "1"}),
            "n": ("signature", np.arange(3), {"units": "1"}),
        },
        coords={
            "signature": ["red", "blue, matt", "Gr\u00fcn"],
            "make": ("signature", ["a", "b", ""]),
            "time": ("signature", np.array(["2024-05-21T11:33:07", "NaT", "2024-05-21"], "datetime64[ns]")),
            "wavelength": ("band", np.linspace(400.0, 1000.0, 20), {"units": "nm"}),
        },
        attrs={"title": "paints"},
    )
    folder.mkdir()
    write_library(paints, folder / "paints.sli", curves="all")
    write_library(paints, folder / "paints.csv", curves="all")
    (folder / "text").mkdir()
    rows = "".join(f"{0.4 + band / 100:.2f}\t{20 + band / 7:.9g}\n" for band in range(20))
    (folder / "text" / "red.spectrum.txt").write_text(
        "Name: red\nType: manmade\nClass: Paint\nSubclass: none\nCollection Date: 2024-05-21\n"
        "First Column: X\nSecond Column: Y\nX Units: Wavelength (micrometers)\n"
        "Y Units: Reflectance (percent)\nFirst X Value: 0.4\nLast X Value: 0.59\nNumber of X Values: 20\n"
        'Additional Information: hyperpaint metadata {"make": "a", "n": 0, '
        f'"time": "2024-05-21T11:33:07.000000000"}}\n\n{rows}'
    )
