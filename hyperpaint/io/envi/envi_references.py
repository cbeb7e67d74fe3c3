"""References to raw ENVI cubes without copying: slabs of whole lines are byte ranges of the data file.

`slab_lines` and `slab_offsets` give the slabs; `EnviParser` is a parser of VirtualiZarr.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Ints
from hyperpaint.base.errors import FormatError, needs_extra
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK
from hyperpaint.io.files.reading import decoded_text

from .envi_header import parse_header

if TYPE_CHECKING:
    from virtualizarr.manifests import ManifestStore

# Dims in the order of the file, slowest first.
FILE_DIMS = {
    "bil": (ALONG_TRACK, BAND, CROSS_TRACK),
    "bip": (ALONG_TRACK, CROSS_TRACK, BAND),
    "bsq": (BAND, ALONG_TRACK, CROSS_TRACK),
}

# Range of the lines of a slab: with fewer lines, overhead dominates a task; more lines take much memory.
MIN_SLAB_LINES, MAX_SLAB_LINES = 8, 64


def slab_lines(ends: Sequence[int]) -> int:
    """Return the lines of a slab for successive cubes.

    ``ends``: the line after the last line of each cube. The result gives the fewest slabs that are short or
    span two cubes; among equal sizes, the one nearest to that of stored chunks.

    Examples
    --------
    >>> slab_lines([2000]), slab_lines([2000, 4000, 5100]), slab_lines([2003])
    (40, 25, 32)
    """
    return min(
        range(MIN_SLAB_LINES, MAX_SLAB_LINES + 1),
        key=lambda lines: (
            len({end // lines for end in ends if end % lines}),
            abs(math.log(lines / CHUNK_LINES)),
        ),
    )


def slab_offsets(lines: int, first: int, count: int, header_offset: int, line_bytes: int) -> Ints:
    """Return the byte offsets of ``count`` slabs of ``lines`` lines in a file, from line ``first`` on.

    Examples
    --------
    >>> slab_offsets(32, 0, 3, header_offset=512, line_bytes=10).tolist()
    [512, 832, 1152]
    """
    return header_offset + (first + lines * np.arange(count, dtype=np.int64)) * line_bytes


class EnviParser:
    """A parser of VirtualiZarr for ENVI cubes, such as those of Headwall's recorders.

    Samples are referenced in place: slabs of whole lines of a ``bil`` or ``bip`` file, parts of the
    planes of a ``bsq`` file. Sizes, type, byte order and offset come from the header beside the data file.

    Parameters
    ----------
    variable
        Name of the array.
    lines
        Lines of a chunk, a divisor of the lines of the cube, since chunk grids are regular; by default the
        divisor nearest to 32.

    Examples
    --------
    >>> parser = EnviParser("counts", lines=32)
    >>> parser.variable, parser.lines
    ('counts', 32)
    >>> from virtualizarr import open_virtual_dataset                             # doctest: +SKIP
    >>> cube = open_virtual_dataset(url, registry=registry, parser=parser)        # doctest: +SKIP
    """

    def __init__(self, variable: str = "counts", lines: int | None = None) -> None:
        self.variable = variable
        self.lines = lines

    def __call__(self, url: str, registry: Any) -> ManifestStore:
        """Return the cube as a store of references.

        ``url``: of the data file or of its header; ``registry``: an
        ``obspec_utils.registry.ObjectStoreRegistry`` with a store that reaches both.

        Raises `FormatError`: the header is damaged, or does not fit the size of the data file, or the lines
        of a chunk do not divide the lines of the cube; `MissingExtraError`: VirtualiZarr is not installed.
        """
        with needs_extra("virtualizarr", "virtual", "parsing for VirtualiZarr"):
            from virtualizarr.manifests import ChunkManifest, ManifestArray, ManifestGroup, ManifestStore
            from virtualizarr.manifests.utils import create_v3_array_metadata

        data_url = url.removesuffix(".hdr")
        store, data = registry.resolve(data_url)
        _, header_path = registry.resolve(f"{data_url}.hdr")
        header = parse_header(decoded_text(bytes(store.get(str(header_path)).buffer())), f"{data_url}.hdr")
        size = int(store.head(str(data))["size"])
        expected = header.header_offset + header.lines * header.line_bytes
        if size != expected:
            raise FormatError(
                f"{data_url}: {size} bytes",
                expected=f"{expected} by its header",
                mend="copy it again",
                code="file-size",
            )
        # by default the divisor nearest to the lines of stored chunks
        divisors = (n for n in range(1, MAX_SLAB_LINES + 1) if header.lines % n == 0)
        lines = self.lines or min(divisors, key=lambda n: abs(n - CHUNK_LINES))
        if header.lines % lines:
            raise FormatError(
                f"{data_url}: {header.lines} lines in chunks of {lines}",
                expected="a divisor of the lines",
                code="length-mismatch",
            )
        dims = FILE_DIMS[header.interleave]
        sizes = {ALONG_TRACK: header.lines, BAND: header.bands, CROSS_TRACK: header.samples}
        planes = header.bands if header.interleave == "bsq" else 1
        chunks = tuple({ALONG_TRACK: lines, BAND: sizes[BAND] // planes}.get(dim, sizes[dim]) for dim in dims)
        # slabs of all planes in file order; line numbers continue from plane to plane
        row = header.line_bytes // planes
        offsets = slab_offsets(lines, 0, planes * header.lines // lines, header.header_offset, row)
        grid = tuple(sizes[dim] // chunk for dim, chunk in zip(dims, chunks, strict=True))
        manifest = ChunkManifest.from_arrays(
            paths=np.full(grid, data_url, np.dtypes.StringDType()),
            offsets=offsets.astype(np.uint64).reshape(grid),
            lengths=np.full(grid, lines * row, np.uint64),
        )
        metadata = create_v3_array_metadata(
            shape=tuple(sizes[dim] for dim in dims),
            data_type=header.dtype,
            chunk_shape=chunks,
            dimension_names=dims,
        )
        spectral = {"wavelength": header.wavelength, "fwhm": header.fwhm}
        attributes = {name: values.tolist() for name, values in spectral.items() if values is not None}
        group = ManifestGroup(
            arrays={self.variable: ManifestArray(metadata, manifest)},
            attributes={**attributes, "envi_header": json.dumps(header.fields)},
        )
        return ManifestStore(group=group, registry=registry)
