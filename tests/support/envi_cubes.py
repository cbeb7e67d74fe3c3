"""Small ENVI cubes, written by plain numpy."""

from pathlib import Path

import numpy as np

CODES = {
    "u1": 1,
    "i2": 2,
    "i4": 3,
    "f4": 4,
    "f8": 5,
    "c8": 6,
    "c16": 9,
    "u2": 12,
    "u4": 13,
    "i8": 14,
    "u8": 15,
}


FROM_LBS = {"bil": (0, 1, 2), "bip": (0, 2, 1), "bsq": (1, 0, 2)}


def write_cube(
    path: Path, cube: np.ndarray, *lines: str, interleave: str = "bil", order: str = "<", offset: int = 0
) -> Path:
    # Write a (line, band, sample) cube and its header by plain numpy, and return the header's path
    stored = cube.astype(cube.dtype.newbyteorder(order)).transpose(FROM_LBS[interleave])
    path.write_bytes(b"\xee" * offset + stored.tobytes())
    header = path.parent / (path.name + ".hdr")
    code = CODES[cube.dtype.newbyteorder("=").str[1:]]
    header.write_text(
        f"ENVI\nlines = {cube.shape[0]}\nbands = {cube.shape[1]}\nsamples = {cube.shape[2]}\n"
        f"data type = {code}\ninterleave = {interleave}\nbyte order = {'<>'.index(order)}\n"
        f"header offset = {offset}\n" + "\n".join(lines) + "\n"
    )
    return header


def toy(dtype: str = "f4") -> np.ndarray:
    # Return the cube of test_image: 1 + sample + 4 line + 20 band
    i, k, j = np.meshgrid(np.arange(5), np.arange(20), np.arange(4), indexing="ij")
    made: np.ndarray = (1 + j + 4 * i + 20 * k).astype(dtype)
    return made
