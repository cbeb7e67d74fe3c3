"""Whole files of side inputs that mutations start from: meshes, rasters, certificates, sentences, scenes."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

__all__ = ["sentences_mended", "write_side_inputs"]

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
    """Return a damaged log with right checksums, without which a reader looks at none of its sentences."""
    lines = (line.lstrip(b"$").rpartition(b"*")[0] or line for line in log.split(b"\r\n"))
    return b"\r\n".join(_sentence(line) if line else b"" for line in lines)


def write_side_inputs(folder: Path) -> None:
    """Write one small file of every kind."""
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
        "pairs.csv": "paint,reference\nhood,svc_0012\n\"roof, left\",svc_0013\n",
        "regions.geojson": json.dumps(_regions()),
        "box.obj": _obj(),
        "heights.asc": "ncols 4\nnrows 3\nxllcorner 500000\nyllcorner 3700000\ncellsize 2\n"
        "NODATA_value -9999\n" + "1 2 3 4\n5 6 -9999 8\n9 10 11.5 12\n",
        "heights.prj": "Projection UTM\nDatum WGS84\nZone 17\nUnits METERS\n",
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_bytes(text.encode())
    from hyperpaint.workflows.scene_files import example_scene

    (folder / "scene.toml").write_text(example_scene(), encoding="utf-8")
    (folder / "box.ply").write_bytes(_ply())
    (folder / "box.glb").write_bytes(_glb())
    _write_rasters(folder)


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
    """Write rasters of heights."""
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
