"""Layout on disk: chunks, codec, fill values and encodings of every variable.

All groups have the same rule, so that a chunk of `xarray.open_zarr` is the chunk of one task:

* an array along the flight (`along_track` and one or more further dims) has chunks of 32 lines; with
  `"explore"`, of 32 lines and a group of bands; with `"web"`, of small tiles;
* a map (`y`, `x`, ...) has tiles of 128 x 128 cells with all bands;
* means of blocks of a line (`coarse_y`, ...), for display, have chunks of 128 rows and a group of bands;
* any other array is one chunk, unless it is larger than 64 MiB.
"""

import functools
import itertools
import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    DEFAULT_CODEC,
    TIME_UNITS,
    Problems,
    StoreError,
    documented,
    one_of,
)

# Cells along each side of a map tile: 18 MB of float32 at 272 bands.
TILE = 128

# Maximum size of an array without lines that is stored as one chunk [byte].
LARGEST_SINGLE_CHUNK = 64 * 2**20

# Size of the chunks of a larger array [byte].
SPLIT_CHUNK = 16 * 2**20

#: Fill value of integers: larger than all 12- and 14-bit counts; as quality it sets every flag.
_INTEGER_FILL = 65535

# A chunk of a cube holds all bands ("cube"), so that one task computes on one chunk; an eighth of them
# ("explore"), so that a picture of one band reads an eighth; or all bands of a few pixels ("web"), so that a
# spectrum reads little.
Layout = Literal["cube", "explore", "web"]

BAND_GROUPS = 8

# Side of a tile of the web layout [pixel]: 280 kB of float32 at 272 bands; 130 kB of flags.
WEB_CUBE, WEB_PLANE = 16, 256

# Samples are shuffled before lz4 by bits (smallest) or by bytes (in half the time).
Codec = Literal["compact", "fast"]

_SHUFFLES: Mapping[Codec, tuple[str, int]] = {"compact": ("bitshuffle", 2), "fast": ("shuffle", 1)}
_LZ4 = {"cname": "lz4", "clevel": 5}


def storage_chunks(
    dims: Sequence[Hashable], shape: Sequence[int], itemsize: int, layout: Layout = "cube"
) -> tuple[int, ...]:
    """Return the storage chunk of an array, each size at least 1; ``itemsize``: bytes of one sample.

    Examples
    --------
    >>> storage_chunks(("along_track", "band", "cross_track"), (2000, 272, 640), 2)
    (32, 272, 640)
    >>> storage_chunks(("along_track", "band", "cross_track"), (2000, 272, 640), 2, "explore")
    (32, 34, 640)
    >>> storage_chunks(("along_track", "band", "cross_track"), (2000, 272, 640), 4, "web")
    (16, 272, 16)
    >>> storage_chunks(("band", "cross_track"), (272, 640), 4)
    (272, 640)
    """
    sizes = dict(zip(dims, shape, strict=True))
    # maximum size of a chunk along some dims; along others it has the size of the array
    max_sizes: dict[Hashable, int] = {}
    if layout == "web" and ({ALONG_TRACK, CROSS_TRACK} <= sizes.keys() or {"y", "x"} <= sizes.keys()):
        max_sizes = dict.fromkeys(
            (ALONG_TRACK, CROSS_TRACK, "y", "x"), WEB_CUBE if BAND in sizes else WEB_PLANE
        )
    elif ALONG_TRACK in sizes and len(dims) > 1:
        max_sizes = {ALONG_TRACK: CHUNK_LINES}
        if layout == "explore" and {BAND, CROSS_TRACK} <= sizes.keys():
            max_sizes[BAND] = -(-sizes[BAND] // BAND_GROUPS)
    elif "coarse_y" in sizes and BAND in sizes:
        max_sizes = {"coarse_y": TILE, BAND: -(-sizes[BAND] // BAND_GROUPS)}
    elif "y" in sizes and "x" in sizes:
        max_sizes = {"y": TILE, "x": TILE}
    elif len(dims) > 1 and math.prod(shape) * itemsize > LARGEST_SINGLE_CHUNK:
        max_sizes = {dims[0]: SPLIT_CHUNK // (math.prod(shape[1:]) * itemsize)}
    return tuple(max(1, min(size, max_sizes.get(dim, size))) for dim, size in zip(dims, shape, strict=True))


def chunks_of(variable: xr.Variable) -> tuple[int, ...]:
    # Return the storage chunk of a variable in its layout (see `with_layout`).
    itemsize = variable.dtype.itemsize if variable.dtype.kind in "biufcmM" else 1
    return storage_chunks(variable.dims, variable.shape, itemsize, variable.encoding.get(_LAYOUT, "cube"))


_LAYOUT = "hyperpaint_layout"


def layouts_of(dataset: xr.Dataset) -> dict[Hashable, Layout]:
    # Return the layouts of variables that are marked with one (see `with_layout`).
    return {name: v.encoding[_LAYOUT] for name, v in dataset.variables.items() if _LAYOUT in v.encoding}


def with_layout(dataset: xr.Dataset, layout: Layout) -> xr.Dataset:
    # Return a dataset whose variables are marked with a layout; `SchemaError` for an unknown layout.
    one_of(layout, get_args(Layout), "layout")
    marked = dataset.copy(deep=False)
    for variable in marked.variables.values():
        if layout != "cube" or _LAYOUT in variable.encoding:
            variable.encoding = {**variable.encoding, _LAYOUT: layout}
    return marked


def regroup(pieces: Sequence[int], step: int) -> tuple[int, ...]:
    """Return dask chunks along one dim that start at multiples of the storage chunk.

    Borders move down to the next multiple of ``step``, and equal borders merge; aligned chunks are returned
    unchanged. ``pieces``: dask chunks along the dim; ``step``: storage chunk along it.

    Examples
    --------
    >>> regroup((50, 50, 20), 32)
    (32, 64, 24)
    >>> regroup((8,) * 9, 32)
    (32, 32, 8)
    """
    size = sum(pieces)
    if size == 0:
        return tuple(pieces)
    borders = {0, size, *(border // step * step for border in itertools.accumulate(pieces))}
    return tuple(end - start for start, end in itertools.pairwise(sorted(borders)))


def fill_value(dtype: np.dtype[Any]) -> Any:
    # Return the value that readers get for samples of a missing chunk; if possible, no valid data has it.
    #
    # NaN for floats, NaT for times, 65535 (or the largest number of a smaller type) for integers. Booleans
    # and strings have no such value: only `hyperpaint.verify` detects their loss.
    if dtype.kind in "fc":
        return dtype.type(np.nan)
    if dtype.kind in "mM":
        return int(np.iinfo(np.int64).min)
    if dtype.kind in "iu":
        return min(_INTEGER_FILL, int(np.iinfo(dtype).max))
    return False if dtype.kind == "b" else None


@documented()
def encoding(dataset: xr.Dataset, codec: Codec = DEFAULT_CODEC) -> dict[Hashable, dict[str, Any]]:
    """Return the xarray encoding that `to_store` uses, for writers other than hyperpaint.

    With it, `Dataset.to_zarr` writes any Zarr v3 store (such as an icechunk session) with chunks of 32 lines,
    fill values that are not valid data, and the crc32c by which readers detect a damaged chunk; the default
    of Zarr has no checksum.

    Parameters
    ----------
    dataset
        The dataset to write; only dims, shapes and dtypes are read.
    codec

    Returns
    -------
    dict
        Variable name to encoding, for the ``encoding`` of `xarray.Dataset.to_zarr`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> cube = xr.Dataset({"reflectance": (("along_track", "band"), np.ones((100, 4), "float32"))})
    >>> encoding(cube)["reflectance"]["chunks"]
    (32, 4)
    """
    return {name: encoding_of(variable, codec) for name, variable in dataset.variables.items()}


def encoding_of(variable: xr.Variable, codec: Codec = DEFAULT_CODEC) -> dict[str, Any]:
    # Return the xarray encoding of a variable: chunks, codec, fill value, and units of time.
    from zarr.codecs import BloscCodec, Crc32cCodec

    dtype = variable.dtype
    typesize = dtype.itemsize if dtype.kind in "biufcmM" else 1
    shuffle, _ = _SHUFFLES[codec]
    encoding: dict[str, Any] = {
        "compressors": (BloscCodec(typesize=typesize, shuffle=shuffle, **_LZ4), Crc32cCodec()),
        "write_empty_chunks": True,
    }
    if variable.ndim:
        encoding["chunks"] = chunks_of(variable)
    fill = fill_value(dtype)
    if fill is not None:
        encoding["fill_value"] = fill
    if dtype.kind in "fc":
        # NaN needs no `_FillValue`, for which readers would search all values
        encoding["_FillValue"] = None
    elif dtype.kind == "M":
        encoding |= {"units": TIME_UNITS, "dtype": "int64"}
    elif dtype.kind == "m":
        encoding |= {"units": "nanoseconds", "dtype": "int64"}
    return encoding


def prepare(dataset: xr.Dataset, group: str) -> xr.Dataset:
    # Return a dataset without old encodings, with strings as objects and aligned dask chunks.
    #
    # StoreError if names, dtypes or attributes cannot be stored; all are listed.
    import dask.array as da

    problems = Problems(f"the dataset cannot be stored as group {'/' + group!r}", StoreError)
    for owner, attrs in {
        "the dataset": dataset.attrs,
        **{f"{name!r}": variable.attrs for name, variable in dataset.variables.items()},
    }.items():
        for key, value in attrs.items():
            problems.add_if(
                not isinstance(key, str) or not _is_plain(value),
                f"attribute {key!r} of {owner} is a {type(value).__name__}",
                expected="text, numbers, lists or dicts of them",
                mend="write times as ISO text",
                code="attribute-type",
            )
    for name, variable in dataset.variables.items():
        problems.add_if(
            not isinstance(name, str) or not name or "/" in name or name.startswith((".", "__")),
            f"variable name {name!r}",
            expected="text without '/' that does not start with '.' or '__'",
            code="variable-name",
        )
        if variable.dtype.kind not in "biufcmMUOT":
            problems.add(
                f"{name!r} has dtype {variable.dtype}",
                expected="numbers, booleans, times or text",
                code="type-wrong",
            )
        elif variable.dtype.kind == "O" and variable._in_memory:
            other_types = {
                type(item).__name__ for item in np.ravel(variable.values) if not isinstance(item, str)
            }
            problems.add_if(
                other_types,
                f"{name!r} contains Python objects ({', '.join(sorted(other_types))})",
                expected="text, or a numeric dtype",
                code="type-wrong",
            )
    multi = xr.indexes.PandasMultiIndex
    for name in sorted({str(index.dim) for index in dataset.xindexes.values() if isinstance(index, multi)}):
        problems.add(
            f"{name!r} has a multi-index", mend=f"call .reset_index({name!r}) first", code="index-multiple"
        )
    problems.raise_if_any()
    layouts = layouts_of(dataset)
    prepared = dataset.drop_encoding()
    replaced = {}
    for name, variable in prepared.variables.items():
        if name in layouts:
            variable.encoding = {_LAYOUT: layouts[name]}
        if variable.dtype.kind in "UT":
            # the Zarr v3 specification has no fixed-length text
            replaced[name] = variable.astype(object)
        elif is_at_hand(variable) and isinstance(variable.data, da.Array) and variable.size:
            # let dask chunks begin at storage chunks
            chunks = tuple(
                regroup(pieces, step) if step < size else (size,)
                for pieces, step, size in zip(
                    variable.data.chunks, chunks_of(variable), variable.shape, strict=True
                )
            )
            if chunks != variable.data.chunks:
                replaced[name] = variable.copy(data=variable.data.rechunk(chunks))
    return with_variables(prepared, replaced, prepared.coords)


def with_variables(
    dataset: xr.Dataset, variables: Mapping[Any, xr.Variable], coords: Collection[Hashable]
) -> xr.Dataset:
    # Return a dataset with variables added or replaced; names in ``coords`` become coordinates.
    return dataset.assign_coords({n: v for n, v in variables.items() if n in coords}).assign(
        {name: variable for name, variable in variables.items() if name not in coords}
    )


def is_at_hand(variable: xr.Variable) -> bool:
    # Return whether access to ``variable.data`` reads no file.
    import dask

    return dask.is_dask_collection(variable) or bool(variable._in_memory)


def _is_plain(value: Any, depth: int = 0) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biufU"
    if isinstance(value, Mapping):
        return depth <= 20 and all(isinstance(k, str) and _is_plain(v, depth + 1) for k, v in value.items())
    if isinstance(value, list | tuple):
        return depth <= 20 and all(_is_plain(item, depth + 1) for item in value)
    return value is None or isinstance(value, str | bool | int | float | np.bool | np.integer | np.floating)


@functools.cache
def _blosc(typesize: int, shuffle: int) -> Callable[[np.ndarray[Any, Any]], bytes]:
    # Function that encodes an array as a blosc frame, by the package ``blosc`` or else numcodecs.
    # Both write the same bytes; ``blosc`` uses faster instructions of new processors. Tasks run in parallel,
    # so that an encoder has one thread.
    import numcodecs.blosc

    try:
        import blosc
    except ImportError:
        numcodecs.blosc.use_threads = False
        encode: Callable[[np.ndarray[Any, Any]], bytes]
        encode = numcodecs.blosc.Blosc(shuffle=shuffle, typesize=typesize, **_LZ4).encode
        return encode
    blosc.set_nthreads(1)
    blosc.set_releasegil(True)

    def frame(block: np.ndarray[Any, Any]) -> bytes:
        return bytes(blosc.compress_ptr(block.ctypes.data, block.size, typesize, shuffle=shuffle, **_LZ4))

    return frame


def encode_chunk(
    block: np.ndarray[Any, Any], chunk: tuple[int, ...], fill: Any, codec: Codec = DEFAULT_CODEC
) -> tuple[bytes, bytes]:
    # Return the bytes of a storage chunk on disk: the blosc frame, and the crc32c after it.
    #
    # The bytes equal those of zarr-python with the codecs of `encoding_of`, whose copies and event loop take
    # as much time as the compression. ``block`` is C-contiguous and little-endian; at the far edge of an
    # array, where it is smaller than ``chunk``, it is padded with ``fill``.
    import google_crc32c

    if block.shape != chunk:
        padded = np.full(chunk, fill, dtype=block.dtype)
        padded[tuple(slice(0, size) for size in block.shape)] = block
        block = padded
    encoded = _blosc(block.dtype.itemsize, _SHUFFLES[codec][1])(block)
    return encoded, int(google_crc32c.value(encoded)).to_bytes(4, "little")
