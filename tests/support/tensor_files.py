"""Files of tensors after the layout of the RGL material database, and BRDFs to store in them."""

import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

#: Numbers of the types in a file.
TYPES = {np.dtype(name): number for name, number in (("u1", 1), ("<u4", 5), ("<f4", 10), ("<f8", 11))}


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray]) -> Path:
    # Write tensors one after the other, each at a multiple of eight bytes
    head = 18 + sum(13 + len(name.encode()) + 8 * tensor.ndim for name, tensor in tensors.items())
    table, body = b"tensor_file\0" + struct.pack("<BBI", 1, 0, len(tensors)), b""
    for name, tensor in tensors.items():
        body += bytes(-(head + len(body)) % 8)
        table += struct.pack("<H", len(name.encode())) + name.encode()
        table += struct.pack("<HBQ", tensor.ndim, TYPES[tensor.dtype], head + len(body))
        table += struct.pack(f"<{tensor.ndim}Q", *tensor.shape)
        body += tensor.tobytes()
    path.write_bytes(table + body)
    return path


def rough_brdf(azimuths: int = 1, span: float = 2.0, jacobian: int = 1) -> dict[str, np.ndarray]:
    # Return tensors of random values; ``span``: range of the azimuths of the light in units of pi. The
    # projected area of an isotropic material, with one azimuth, does not depend on the azimuth
    rng = np.random.default_rng(azimuths)
    zeniths, bands = 5, 7

    def field(*shape: int) -> np.ndarray:
        return rng.uniform(0.2, 1.0, shape).astype("<f4")

    return {
        "version": np.array([1, 2], "<u4"),
        "description": np.frombuffer(b"rough paint", "u1"),
        "phi_i": np.linspace(-np.pi, (span - 1.0) * np.pi, azimuths, dtype="<f4"),
        "theta_i": np.linspace(0.0, 1.5, zeniths, dtype="<f4"),
        "wavelengths": np.linspace(360.0, 1000.0, bands, dtype="<f4"),
        "sigma": field(8, 12) if azimuths > 1 else np.tile(field(1, 12), (8, 1)),
        "ndf": field(9, 16),
        "vndf": field(azimuths, zeniths, 6, 10),
        "luminance": field(azimuths, zeniths, 11, 11),
        "spectra": field(azimuths, zeniths, bands, 11, 11),
        "jacobian": np.array([jacobian], "u1"),
    }


def gridded_brdf(
    brdf: Callable[[np.ndarray, np.ndarray], np.ndarray], wavelength: np.ndarray, size: int = 64
) -> dict[str, np.ndarray]:
    """Return the tensors of an isotropic BRDF, with samples that are even over the square of facets.

    Takes ``brdf``: function of light (3,) and views (..., 3), unit vectors, to the BRDF (..., wavelength)
    [sr-1]; ``wavelength`` [nm]; ``size``: samples along a side.
    """
    grid = np.linspace(0.0, 1.0, size)
    zenith, turn = 0.5 * np.pi * grid**2, np.pi * (2.0 * grid[:, None] - 1.0)
    facets = np.stack(
        np.broadcast_arrays(np.sin(zenith) * np.cos(turn), np.sin(zenith) * np.sin(turn), np.cos(zenith)), -1
    )
    light_zenith = 0.5 * np.pi * np.linspace(0.0, 0.94, 12) ** 0.8
    slices = []
    for angle in light_zenith:
        light = np.array([np.sin(angle), 0.0, np.cos(angle)])
        views = 2.0 * (facets @ light)[..., None] * facets - light
        views[..., 2] = np.maximum(views[..., 2], 1e-3)
        views /= np.linalg.norm(views, axis=-1, keepdims=True)
        slices.append(np.moveaxis(brdf(light, views) * views[..., 2:], -1, 0))
    spectra = np.array(slices, "<f4")[None]
    even = np.ones((2, 2), "<f4")
    return {
        "description": np.frombuffer(b"gridded", "u1"),
        "phi_i": np.zeros(1, "<f4"),
        "theta_i": light_zenith.astype("<f4"),
        "wavelengths": wavelength.astype("<f4"),
        "sigma": 0.25 * even,
        "ndf": even,
        "vndf": np.broadcast_to(even, (1, 12, 2, 2)).copy(),
        "luminance": spectra.mean(axis=2),
        "spectra": spectra,
        "jacobian": np.ones(1, "u1"),
    }
