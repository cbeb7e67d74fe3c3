"""Whole files that mutations start from: a small collect, and what other programs write; see `parsers`."""

import json
import struct
from pathlib import Path

import numpy as np
from support.tensor_files import rough_brdf, write_tensors

_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
_QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6))
_FACES = np.array([[quad[i] for i in corner] for quad in _QUADS for corner in ((0, 1, 2), (0, 2, 3))])
_RING = [[1, 1], [5, 1], [5, 4], [1, 4], [1, 1]]
RADCAL = """!FRM4SOC_CP
!RADCAL
[DEVICE]
X1
[LAMPDATA]
400 0 2.0 1.0
500 0 4.0 1.0
[END_OF_LAMPDATA]
[PANELDATA]
400 0 0.99 1.2
500 0 0.99 1.2
[END_OF_PANELDATA]
[CALDATA]
0 0 1024 0 0 0 1024 0 512 0
1 400 1e-4 1.5 10 0 900 1 901 1
2 410 1e-4 1.5 10 0 950 1 951 1
[END_OF_CALDATA]
"""
_SENTENCES = (
    "GPRMC,235959.50,A,4330.0000,N,07736.0000,W,11.2,87.0,310524,,,A",
    "PASHR,235959.50,359.25,T,+1.50,-2.25,,0.01,0.01,0.02,1,1",
    "GPGGA,235959.50,4330.0000,N,07736.0000,W,4,12,0.8,150.0,M,-34.5,M,,",
    "GPGGA,000000.00,4330.0060,N,07736.0000,W,4,12,0.8,150.0,M,-34.5,M,,",
    "PASHR,000000.00,0.25,T,-1.25,2.00,,0.01,0.01,0.02,1,1",
    "GPZDA,000000.00,01,06,2024,00,00",
    "GPHDT,12.5,T",
)


def _sentence(body: bytes) -> bytes:
    checksum = 0
    for byte in body:
        checksum ^= byte
    return b"$%b*%02X" % (body, checksum)


def sentences_mended(log: bytes) -> bytes:
    # Return a damaged log with right checksums, without which a reader looks at none of its sentences
    lines = (line.lstrip(b"$").rpartition(b"*")[0] or line for line in log.split(b"\r\n"))
    return b"\r\n".join(_sentence(line) if line else b"" for line in lines)


def prepare(folder: Path) -> None:
    # Write the simulated seeds: a small collect, and the variants of its files that other programs write
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
    _write_side_inputs(folder)


def sixs_text(micron: float) -> str:
    return (
        f"*  monochromatic calculation at wl : {micron:.3f} micron *\n"
        "*   irr. at ground level (w/m2/mic)   *\n"
        "*     direct solar irr.    atm. diffuse irr.    environment  irr   *\n"
        "*       500.000             180.000               4.000      *\n"
    )


def _sky_texts() -> dict[str, str]:
    # Return light at the ground by name of a file, in every format that is read
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
    # Write a short flight in every format of navigation but Headwall's
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
    # Write a small paint library in every format whose files are read
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


# --- side inputs -------------------------------------------------------------------------------------------


def _write_side_inputs(folder: Path) -> None:
    # Write one small file of every kind
    texts = {
        "flight.nmea": "".join(_sentence(each.encode()).decode() + "\r\n" for each in _SENTENCES),
        "radcal.txt": RADCAL,
        "panel.csv": "Diffuse target;95 %\nWavelength [nm];R [%]\n"
        + "".join(f"{400 + 50 * row};{98.1 - row / 10}\n" for row in range(12)),
        "zenith.txt": "nm R\n" + "".join(f"{400 + row} {0.98 - row / 1000}\n" for row in range(60)),
        "points.csv": "# crs: EPSG:32617\nname;flightline;line;sample;east [ft];north [m];height_m\n"
        + "".join(f"P{row};raw_0;{row}.5;{row};{500000 + row};{3700000 + row};-20\n" for row in range(9)),
        "light.csv": "wavelength [nm], sun [W m-2 nm-1], sky [W m-2 nm-1]\n"
        + "".join(f"{400 + 50 * row},{1.2 - row / 40},{0.3 - row / 60}\n" for row in range(14)),
        "falling.csv": "Wavelength (nm);Reflectance;Uncertainty (k=2)\n"
        + "".join(f"{900 - 40 * row};0,98{row};0,005\n" for row in range(9)),
        **_texts_of_spectrometers(),
        "pairs.csv": "paint,reference\nhood,svc_0012\n\"roof, left\",svc_0013\n",
        "regions.geojson": json.dumps(_regions()),
        "box.obj": _obj(),
        "heights.asc": "ncols 4\nnrows 3\nxllcorner 500000\nyllcorner 3700000\ncellsize 2\n"
        "NODATA_value -9999\n" + "1 2 3 4\n5 6 -9999 8\n9 10 11.5 12\n",
        "heights.prj": "Projection UTM\nDatum WGS84\nZone 17\nUnits METERS\n",
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_bytes(text.encode())
    from hyperpaint.workflows.rendering import example_scene

    (folder / "scene.toml").write_text(example_scene(), encoding="utf-8")
    (folder / "box.ply").write_bytes(_ply())
    (folder / "box.glb").write_bytes(_glb())
    write_tensors(folder / "paint.bsdf", rough_brdf())
    _write_rasters(folder)


def _texts_of_spectrometers() -> dict[str, str]:
    # Return a small file of every form of `spectrum_texts`, of the tables of samples, and of other loggers
    rows = range(400, 700, 10)
    tables = "".join(f"{row} {400 + 5 * row} 5.0 0.0 4.0\n" for row in range(4))
    error, u = (
        f"[COLUMN_NAMES]\npx wl\\angle -60 0 60\n[{name}]\n{tables}[END_OF_{name}]\n"
        for name in ("COSERROR", "UNCERTAINTY")
    )
    return {
        "door.sed": "Comment: door\nInstrument: PSR-3500_SN1 [3]\nDate: 03/05/2024,03/05/2024\n"
        "Time: 10:00:00.07,10:00:20.07\nUnits: W/m^2/sr/nm\nLatitude: 72.35670\nLongitude: 126.31747\n"
        "Altitude: 10.50\nGPS Time: 03:31:37\nColumns [4]:\nData:\n"
        "Wvl\tRad. (Ref.)\tRad. (Target)\tTgt./Ref. %\n"
        + "".join(f" {nm}.0\t2.342770E-002\t9.092904E-004\t  3.8833\n" for nm in rows),
        "sky.JazIrrad": "Jaz Absolute Irradiance File\n++++\nDate: Sat Jun 01 10:00:00 CEST 2024\n"
        "Integration Time (usec): 495000 (JAZA2517)\nSpectra Averaged: 3 (JAZA2517)\n"
        ">>>>>Begin Processed Spectral Data<<<<<\nW\tD\tS\tP\n"
        + "".join(f"{nm},191016\t0,000000\t0,5\t{nm / 7:.6f}\n".replace(".", ",") for nm in rows)
        + ">>>>>End Processed Spectral Data<<<<<\n>>>>>Begin Calibration Data<<<<<\n5.8e-05\n",
        "li180.txt": "Model Name\tLI-180\nSerial Number\tA1\nTime\t2021/03/02_09:24:26\n"
        "R:B\t1.48\nI-Time\t92.0\n"
        + "".join(f"{nm}nm\t{nm / 9:.6f}\n" for nm in rows)
        + "CCT\t5465.0\n",
        "door.ttt": "1305084U1- I C\nIntegration time: 95,00 ms\nAverage: 20 scans\n"
        "Wave   ;Sample   ;Dark     ;Reference;Reflectance\n[nm]   ;[counts] ;[counts] ;[counts] ;[%]\n\n"
        + "".join(f" {nm},00;   -6,893;  -10,335;   -9,339;52,16336\n" for nm in rows),
        "sky.irr": '" File: roof"\n" RAD->  Wave:643.77nm  Time:100ms  Avg:1"\n'
        + "".join(f" {nm}.50  1.0000E-001\n" for nm in rows)
        + ": 5\n",
        "ecosis.csv": "Site,sample name,Latitude,Wavelength Units," + ",".join(map(str, rows)) + "\n"
        + "".join(f"lot,roof {row},61.5,Nanometers{',0.25' * len(rows)}\n" for row in range(4)),
        "specchio.csv": "File Name,red,blue\nLocation Name,Hyytiala, Finland\nAltitude,170.0,171.5\n"
        + "".join(f"{nm}.0,0.13252,0.16318\n" for nm in rows),
        "logger.csv": "# units: W m-2 nm-1\nDate;Time;" + ";".join(f"{nm} nm" for nm in rows) + "\n"
        + "".join(f"13/06/2024;10:00:{row:02d} AM{';0,812' * len(rows)}\n" for row in range(20)),
        "angular.txt": "!FRM4SOC_CP\n!ANGDATA\n"
        + "".join(f"[AZIMUTH_ANGLE]\n{angle}\n{error}{u}" for angle in (0, 90)),
    }  # fmt: skip


def _regions() -> dict[str, object]:
    outline = {"type": "Polygon", "coordinates": [_RING, [[2, 2], [3, 2], [3, 3], [2, 2]]]}
    several = {"type": "MultiPolygon", "coordinates": [[_RING]]}
    features = [
        {"type": "Feature", "geometry": shape, "properties": {"name": name, "flightline": "raw_0", "n": 3}}
        for name, shape in (("hood", outline), ("roof", several))
    ]
    return {"type": "FeatureCollection", "coordinates": "sensor", "features": features}


def _obj() -> str:
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in _CORNERS)
    quads = "".join("f " + " ".join(f"{corner + 1}/1/1" for corner in quad) + "\n" for quad in _QUADS)
    return f"# a box\nmtllib box.mtl\no lower\n{corners}vt 0 0\nvn 0 0 1\nusemtl red\n{quads}f -1 -2 -3\n"


def _ply() -> bytes:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 8\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(_FACES)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = b"".join(b"\x03" + row.tobytes() for row in _FACES.astype("<i4"))
    return head.encode() + _CORNERS.astype("<f4").tobytes() + rows


def _glb() -> bytes:
    indices, points = _FACES.astype("<u2").tobytes(), _CORNERS.astype("<f4").tobytes()
    body = indices + points
    attributes = {"attributes": {"POSITION": 1}, "indices": 0}
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "first", "children": [1]}, {"mesh": 0, "translation": [10, 0, 0]}],
        "meshes": [{"name": "box", "primitives": [attributes]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": 36, "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(indices)},
            {"buffer": 0, "byteOffset": len(indices), "byteLength": len(points)},
        ],
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(body)) + chunks + body


def _write_rasters(folder: Path) -> None:
    # Write rasters of heights
    import rasterio

    heights = np.arange(12, dtype=np.float32).reshape(3, 4)
    profile = {
        "driver": "GTiff", "width": 4, "height": 3, "count": 1, "dtype": "float32", "nodata": -9999.0,
        "crs": "EPSG:32617", "transform": rasterio.Affine(2.0, 0.0, 500000.0, 0.0, -2.0, 3700000.0),
    }  # fmt: skip
    for name, extra in (("heights.tif", {}), ("tiled.tif", {"tiled": True, "blockxsize": 16,
                        "blockysize": 16, "compress": "deflate"})):  # fmt: skip
        with rasterio.open(folder / name, "w", **profile, **extra) as raster:
            raster.write(heights, 1)
