"""Measured BRDFs of the RGL material database (EPFL): ``.bsdf`` files of tensors.

The layout is that of the loader of J. Dupuy, W. Jakob, "An adaptive parameterization for efficient material
acquisition and rendering", ACM Trans. Graph. 37(6) (2018), doi:10.1145/3272127.3275059: a magic word, a
version, and for every tensor its name, rank, type, offset and shape, little-endian.
`hyperpaint.simulation.measured_brdf` evaluates the BRDF.
"""

import math
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base import Array, FormatError, Problem, read_limited
from hyperpaint.io.files.reading import refuse

# Largest file [byte]; anisotropic materials have about 110 MB.
MAX_RGL_BYTES = 512 << 20

_MAGIC, _VERSION = b"tensor_file\0", (1, 0)
_MAX_TENSORS, _MAX_RANK = 64, 8
_TYPES = dict(enumerate(("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8"), 1))
_LIGHT = ("light_azimuth", "light_zenith")
#: Tensors by name in the file: type, dims, units, meaning.
_TENSORS = {
    "description": ("u1", ("character",), "", "Name of the material"),
    "jacobian": ("u1", ("flag",), "", "Whether spectra are divided by ndf / (4 sigma)"),
    "phi_i": ("<f4", _LIGHT[:1], "degree", "Azimuth of the light"),
    "theta_i": ("<f4", _LIGHT[1:], "degree", "Zenith angle of the light"),
    "wavelengths": ("<f4", ("wavelength",), "nm", "Wavelength"),
    "ndf": ("<f4", ("ndf_v", "ndf_u"), "sr-1", "Density of facets"),
    "sigma": ("<f4", ("sigma_v", "sigma_u"), "1", "Projected area of facets"),
    "vndf": ("<f4", (*_LIGHT, "vndf_v", "vndf_u"), "1", "Density of facets that the light meets"),
    "luminance": ("<f4", (*_LIGHT, "sample_v", "sample_u"), "1", "Luminance of spectra"),
    "spectra": (
        "<f4", (*_LIGHT, "wavelength", "sample_v", "sample_u"), "1", "BRDF times cosine of the view"
    ),
}  # fmt: skip


def read_rgl(path: str | Path) -> xr.Dataset:
    """Return a measured BRDF from a spectral file of the RGL material database.

    Parameters
    ----------
    path
        File with the tensors of Dupuy and Jakob's parameterization, such as ``cc_ibiza_sunset_spec.bsdf``
        from https://rgl.epfl.ch/materials (CC0).

    Returns
    -------
    Dataset
        ``spectra`` (light_azimuth, light_zenith, wavelength, sample_v, sample_u), ``luminance`` without
        wavelength, ``vndf`` (light_azimuth, light_zenith, vndf_v, vndf_u), ``ndf`` (ndf_v, ndf_u) and
        ``sigma`` (sigma_v, sigma_u), float32. ``light_azimuth``, ``light_zenith`` [degree] and ``wavelength``
        [nm] are float64; u is sqrt(2 zenith / pi) and v (azimuth + pi) / (2 pi) of a direction, or of
        samples, 0 to 1. Attributes: ``description``, and ``jacobian``, 1 where spectra are divided by
        ndf / (4 sigma), else 0.

    Raises
    ------
    FormatError
        The file is of another format or version, is cut short, or lacks a tensor; a tensor has another type
        or shape, or values outside their range.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "short.bsdf")
    >>> _ = path.write_bytes(b"tensor_file")
    >>> read_rgl(path)
    Traceback (most recent call last):
    hyperpaint.base.errors.FormatError: ... [format-unknown]
    """
    where = str(path)
    data = read_limited(path, MAX_RGL_BYTES, "a BRDF of the RGL material database")
    # tensors by name, as views of the data; sizes of the header are compared with those of the file
    refuse(
        where,
        (
            not data.startswith(_MAGIC),
            Problem(f"it begins with {data[:12]!r}", expected=f"{_MAGIC!r}", code="format-unknown"),
        ),
    )
    tensors: dict[str, Array] = {}
    with FormatError.instead_of(
        struct.error, f"{where}: its header ends early", mend="copy the file again", code="header-truncated"
    ):
        *version, count = struct.unpack_from("<BBI", data, len(_MAGIC))
        wrong_version = Problem(f"version {version}", expected=f"{list(_VERSION)}", code="format-version")
        too_many = Problem(f"{count} tensors", expected=f"at most {_MAX_TENSORS}", code="tensor-count")
        refuse(where, (tuple(version) != _VERSION, wrong_version), (count > _MAX_TENSORS, too_many))
        place = len(_MAGIC) + 6
        for _ in range(count):
            (size,) = struct.unpack_from("<H", data, place)
            title = data[place + 2 : place + 2 + size].decode("utf-8", "replace")
            rank, number, offset = struct.unpack_from("<HBQ", data, place + 2 + size)
            subject, found = f"{where}: tensor {title[:40]!r}", f"{rank} dimensions"
            refuse(
                subject,
                (rank > _MAX_RANK, Problem(found, expected=f"at most {_MAX_RANK}", code="tensor-rank")),
            )
            extent = struct.unpack_from(f"<{rank}Q", data, place + 13 + size)
            place += 13 + size + 8 * rank
            refuse(
                subject,
                (number not in _TYPES, Problem(f"type {number}", expected="1 to 11", code="tensor-type")),
                (title in tensors, Problem("it is repeated", code="tensor-repeated")),
                (0 in extent, Problem(f"shape {extent}", expected="sizes above 0", code="tensor-empty")),
            )
            end = offset + math.prod(extent) * np.dtype(_TYPES[number]).itemsize
            beyond = Problem(f"bytes {offset} to {end}", expected=f"up to {len(data)}", code="file-truncated")
            refuse(subject, (end > len(data), beyond))
            tensors[title] = np.frombuffer(data, _TYPES[number], math.prod(extent), offset).reshape(extent)
    missing = sorted(set(_TENSORS) - set(tensors))
    has_colours = Problem(
        "it has colours, not spectra",
        mend="take the spectral file, whose name ends with _spec.bsdf",
        code="spectra-missing",
    )
    lacking = Problem(f"no tensor {', '.join(missing)}", expected=", ".join(_TENSORS), code="tensor-missing")
    refuse(where, ("rgb" in tensors and "spectra" in missing, has_colours), (missing, lacking))
    # a dimension has one size in all tensors; unit squares need two nodes to interpolate
    sizes: dict[str, int] = {"flag": 1}
    for name, (kind, dims, _, _) in _TENSORS.items():
        tensor = tensors[name]
        if tensor.ndim == len(dims):
            sizes = dict(zip(dims, tensor.shape, strict=True)) | sizes
        shape = [max(sizes.get(dim, 1), 2 if dim in _squares(dims) else 1) for dim in dims]
        wrong_type = Problem(f"type {tensor.dtype}", expected=str(np.dtype(kind)), code="tensor-type")
        wrong_shape = Problem(f"shape {tensor.shape}", expected=f"{dims} {shape}", code="tensor-shape")
        refuse(
            f"{where}: tensor {name!r}",
            (tensor.dtype != np.dtype(kind), wrong_type),
            (list(tensor.shape) != shape, wrong_shape),
            (not np.isfinite(tensor).all(), Problem("values are not finite", code="not-finite")),
        )
    coords = {}
    for name, least, most in (("phi_i", -180.0, 180.0), ("theta_i", 0.0, 90.0), ("wavelengths", 1.0, 1e5)):
        _, (dim,), units, meaning = _TENSORS[name]
        axis = tensors[name].astype(np.float64)
        axis = np.degrees(axis) if units == "degree" else axis
        outside = Problem(
            f"{axis.min():g} to {axis.max():g}",
            expected=f"{least:g} to {most:g} {units}",
            code="value-out-of-range",
        )
        refuse(
            f"{where}: tensor {name!r}",
            (axis.min() < least - 1e-3 or axis.max() > most + 1e-3, outside),
            (not (np.diff(axis) > 0.0).all(), Problem("values do not ascend", code="order-wrong")),
        )
        coords[dim] = (dim, axis, {"units": units, "long_name": meaning})
    for name in ("ndf", "sigma", "vndf"):
        is_density = tensors[name].min() >= 0.0 and tensors[name].max(axis=(-2, -1)).min() > 0.0
        negative = Problem("negative values, or only 0", expected="densities", code="density-wrong")
        refuse(f"{where}: tensor {name!r}", (not is_density, negative))
    return xr.Dataset(
        {
            name: (dims, tensors[name], {"units": units, "long_name": meaning})
            for name, (_, dims, units, meaning) in _TENSORS.items()
            if len(dims) > 1
        },
        coords | {d: (d, np.linspace(0.0, 1.0, sizes[d]), {"units": "1"}) for d in _squares(sizes)},
        {
            "description": tensors["description"].tobytes().decode("utf-8", "replace"),
            "jacobian": int(tensors["jacobian"][0]),
            "source": where,
        },
    )


def _squares(dims: Iterable[str]) -> list[str]:
    # dims of unit squares
    return [dim for dim in dims if dim.endswith(("_u", "_v"))]
