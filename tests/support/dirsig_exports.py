"""A library to export for DIRSIG, and a parser of what is written that shares nothing with the package."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

BANDS = 9
NM = np.linspace(399.356, 1001.42, BANDS)


def strict_ems(path: Path) -> tuple[list[float], np.ndarray, np.ndarray]:
    # Return weights, micrometres (wavelength,) and emissivity (curve, wavelength); fail on anything odd
    raw = path.read_bytes()
    assert raw.endswith(b"\n")
    assert b"\r" not in raw
    lines = raw.decode("ascii").split("\n")[:-1]
    count, weights, rest = int(lines[0]), [float(line) for line in lines[1:92]], lines[92:]
    assert len(weights) == 91
    starts = [number for number, line in enumerate(rest) if line == "CURVE_BEGIN"]
    assert len(starts) == count
    assert starts[0] == 0
    curves = [rest[a + 1 : b] for a, b in zip(starts, [*starts[1:], len(rest)], strict=True)]
    pairs = np.array([[[float(cell) for cell in row.split("\t")] for row in curve] for curve in curves])
    assert (np.diff(pairs[:, :, 0]) > 0).all()
    assert (pairs[:, :, 0] == pairs[0, :, 0]).all()
    assert ((pairs[:, :, 1] >= 0) & (pairs[:, :, 1] <= 1)).all()
    return weights, pairs[0, :, 0], pairs[:, :, 1]


def library(paints: int = 3, members: int = 5, seed: int = 0, **attrs: Any) -> xr.Dataset:
    values = np.random.default_rng(seed).uniform(0.02, 0.9, (paints, members, BANDS)).astype(np.float32)
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), values.mean(axis=1), {"units": "1", **attrs}),
            "member_reflectance": (("signature", "member", "band"), values, {"units": "1"}),
            "reflectance_quantiles": (
                ("signature", "quantile", "band"),
                np.quantile(values, [0.1, 0.9], axis=1).swapaxes(0, 1).astype(np.float32),
                {"units": "1"},
            ),
        },
        {
            "signature": [f"paint {number}" for number in range(paints)],
            "wavelength": ("band", NM, {"units": "nm"}),
            "make": ("signature", np.array(["Lada"] * paints, object)),
        },
    )


def specular_fraction(material: Any) -> float | None:
    # Return SPECULAR_FRACTION of a material, None without it
    surface = material.entry.section("SURFACE_PROPERTIES")
    properties = surface.section("EMISSIVITY_PROP") if surface else None
    text = properties.get("SPECULAR_FRACTION") if properties else None
    return None if text is None else float(text)
