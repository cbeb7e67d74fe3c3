"""Layout on disk: chunks, codec, fill values and encodings of every variable.

One rule for every group, so that what `xarray.open_zarr` shows a user is what one task computes on:

* an array along the flight (`along_track` and at least one more dim) is cut every 32 whole lines, and for
  looking at, `"explore"`, a cube into groups of bands as well; for pages, `"web"`, into small tiles;
* a map (`y`, `x`, ...) is cut in tiles of 128 x 128 cells, all bands;
* means of blocks of a line (`coarse_y`, ...), for looking at, are cut every 128 rows and in groups of bands;
* anything else is one chunk, unless it is larger than 64 MiB.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

from hyperpaint.base.errors import Problems, SchemaError, StoreError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, TIME_UNITS

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

TILE = 128
"""Cells along each side of a map tile: 18 MB of float32 at 272 bands."""

LARGEST_SINGLE_CHUNK = 64 * 2**20
"""Bytes of an array without lines that is still stored in one piece."""

SPLIT_CHUNK = 16 * 2**20
"""Bytes of the pieces of one that is not."""

#: Sentinel of small integers: no 12- or 14-bit camera counts to it, and as quality it sets every flag.
_INTEGER_FILL = 65535

Layout = Literal["cube", "explore", "web"]
"""Whether a chunk of a cube holds all bands, so that one task computes on one chunk; or an eighth of them, so
that a picture of one band reads an eighth; or all bands of a few pixels, so that a spectrum reads little."""

BAND_GROUPS = 8

WEB_CUBE, WEB_PLANE = 16, 256
"""Pixels along each side of a tile of the web: 280 kB of float32 at 272 bands; 130 kB of flags."""

Codec = Literal["compact", "fast"]
"""How samples are shuffled before lz4: by bits, which takes least room, or by bytes, in half the time."""

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
    chunks = [max(1, size) for size in shape]
    if layout == "web" and ({ALONG_TRACK, CROSS_TRACK} <= set(dims) or {"y", "x"} <= set(dims)):
        side = WEB_CUBE if BAND in dims else WEB_PLANE
        places = (ALONG_TRACK, CROSS_TRACK, "y", "x")
        chunks = [min(c, side) if dim in places else c for dim, c in zip(dims, chunks, strict=True)]
    elif ALONG_TRACK in dims and len(dims) > 1:
        axis = dims.index(ALONG_TRACK)
        chunks[axis] = min(chunks[axis], CHUNK_LINES)
        if layout == "explore" and {BAND, CROSS_TRACK} <= set(dims):
            chunks[dims.index(BAND)] = -(-chunks[dims.index(BAND)] // BAND_GROUPS)
    elif "coarse_y" in dims and BAND in dims:
        chunks[dims.index("coarse_y")] = min(chunks[dims.index("coarse_y")], TILE)
        chunks[dims.index(BAND)] = -(-chunks[dims.index(BAND)] // BAND_GROUPS)
    elif "y" in dims and "x" in dims:
        for name in ("y", "x"):
            chunks[dims.index(name)] = min(chunks[dims.index(name)], TILE)
    elif len(dims) > 1 and math.prod(chunks) * itemsize > LARGEST_SINGLE_CHUNK:
        row = math.prod(chunks[1:]) * itemsize
        chunks[0] = min(chunks[0], max(1, SPLIT_CHUNK // row))
    return tuple(chunks)


def chunks_of(variable: xr.Variable) -> tuple[int, ...]:
    """Return the storage chunk of a variable, in the layout that `with_layout` gave it."""
    itemsize = variable.dtype.itemsize if variable.dtype.kind in "biufcmM" else 1
    return storage_chunks(variable.dims, variable.shape, itemsize, variable.encoding.get(_LAYOUT, "cube"))


_LAYOUT = "hyperpaint_layout"


def layouts_of(dataset: xr.Dataset) -> dict[Hashable, Layout]:
    """Return the layouts that `with_layout` gave variables."""
    return {name: v.encoding[_LAYOUT] for name, v in dataset.variables.items() if _LAYOUT in v.encoding}


def with_layout(dataset: xr.Dataset, layout: Layout) -> xr.Dataset:
    """Return a dataset that will be stored in a layout; `SchemaError` where that is none."""
    if layout not in get_args(Layout):
        raise SchemaError(f"layout={layout!r}, expected {' or '.join(map(repr, get_args(Layout)))}")
    marked = dataset.copy(deep=False)
    for variable in marked.variables.values():
        if layout != "cube" or _LAYOUT in variable.encoding:
            variable.encoding = {**variable.encoding, _LAYOUT: layout}
    return marked


def regroup(pieces: Sequence[int], step: int) -> tuple[int, ...]:
    """Return dask chunks along one dim that start at multiples of the storage chunk.

    Borders move down to the next multiple of ``step``; those that meet become one. What is aligned already
    comes back unchanged, so nothing is recomputed or moved without need. ``pieces``: dask chunks along the
    dim; ``step``: storage chunk along it.

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
    return tuple(after - before for before, after in itertools.pairwise(sorted(borders)))


def fill_value(dtype: np.dtype[Any]) -> Any:
    """Return what a missing chunk reads as: never a value that could be taken for data, where one exists.

    NaN for floats, NaT for times, 65535 (or the largest number of a smaller type) for integers; booleans
    and strings have no such value, for them `hyperpaint.verify` is the only protection.
    """
    import numpy as np

    if dtype.kind in "fc":
        return dtype.type(np.nan)
    if dtype.kind in "mM":
        return int(np.iinfo(np.int64).min)
    if dtype.kind in "iu":
        return min(_INTEGER_FILL, int(np.iinfo(dtype).max))
    return False if dtype.kind == "b" else None


def encoding(dataset: xr.Dataset, codec: Codec = "compact") -> dict[Hashable, dict[str, Any]]:
    """Return the xarray encoding `to_store` uses, for writers that know nothing of hyperpaint.

    With it, `Dataset.to_zarr` into any Zarr v3 store (an icechunk session, say) keeps chunks of 32 whole
    lines, fill values that cannot be taken for data, and the crc32c that lets every later reader notice a
    damaged chunk; Zarr's default has none.

    Parameters
    ----------
    dataset
        What will be written; reads dims, shapes and dtypes only.
    codec
        As that of `to_store`.

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


def encoding_of(variable: xr.Variable, codec: Codec = "compact") -> dict[str, Any]:
    """Return the xarray encoding of a variable: chunks, codec, fill value, and units of time."""
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
        # NaN stands for itself: a `_FillValue` would only cost each reader one more pass
        encoding["_FillValue"] = None
    elif dtype.kind == "M":
        encoding |= {"units": TIME_UNITS, "dtype": "int64"}
    elif dtype.kind == "m":
        encoding |= {"units": "nanoseconds", "dtype": "int64"}
    return encoding


def prepare(dataset: xr.Dataset, group: str) -> xr.Dataset:
    """Return ``dataset`` as it will be stored: no stale encodings, strings as objects, aligned dask chunks.

    StoreError where names, dtypes or attributes cannot be stored; all are listed.
    """
    import xarray as xr

    problems = Problems(f"the dataset cannot be stored as group {'/' + group!r}", StoreError)
    _check_attrs("the dataset", dataset.attrs, problems)
    for name, variable in dataset.variables.items():
        _check_name(name, problems)
        _check_attrs(f"{name!r}", variable.attrs, problems)
        if variable.dtype.kind not in "biufcmMUOT":
            problems.add(f"{name!r} has dtype {variable.dtype}; expected numbers, booleans, times or text")
        elif variable.dtype.kind == "O" and (wrong := _not_text(variable)):
            problems.add(f"{name!r} holds Python objects ({wrong}); expected text, or a numeric dtype")
    multi = xr.indexes.PandasMultiIndex
    for name in sorted({str(index.dim) for index in dataset.xindexes.values() if isinstance(index, multi)}):
        problems.add(f"{name!r} has a multi-index; call .reset_index({name!r}) first")
    problems.raise_if_any()
    layouts = layouts_of(dataset)
    prepared = dataset.drop_encoding()
    for name, layout in layouts.items():
        prepared.variables[name].encoding = {_LAYOUT: layout}
    changed = {name: _prepared(variable) for name, variable in prepared.variables.items()}
    replaced = {name: new for name, new in changed.items() if new is not prepared.variables[name]}
    return with_variables(prepared, replaced, prepared.coords)


def with_variables(
    dataset: xr.Dataset, variables: Mapping[Any, xr.Variable], coords: Collection[Hashable]
) -> xr.Dataset:
    """Return a dataset with variables added or replaced; those named in ``coords`` become coordinates."""
    inner = {name: variable for name, variable in variables.items() if name not in coords}
    return dataset.assign_coords({n: v for n, v in variables.items() if n in coords}).assign(inner)


def _prepared(variable: xr.Variable) -> xr.Variable:
    import dask.array as da

    if variable.dtype.kind in "UT":
        # fixed-length text has no place in the Zarr v3 specification
        return variable.astype(object)
    if not is_at_hand(variable) or not isinstance(variable.data, da.Array) or not variable.size:
        return variable
    step = chunks_of(variable)
    chunks = tuple(
        regroup(pieces, each) if each < size else (size,)
        for pieces, each, size in zip(variable.data.chunks, step, variable.shape, strict=True)
    )
    return variable if chunks == variable.data.chunks else variable.copy(data=variable.data.rechunk(chunks))


def is_at_hand(variable: xr.Variable) -> bool:
    """Tell whether ``variable.data`` costs nothing: a lazy file-backed array would be read whole."""
    import dask

    return dask.is_dask_collection(variable) or bool(variable._in_memory)


def _not_text(variable: xr.Variable) -> str | None:
    import numpy as np

    if not variable._in_memory:
        return None
    odd = {type(value).__name__ for value in np.ravel(variable.values) if not isinstance(value, str)}
    return ", ".join(sorted(odd)) or None


def _check_name(name: Hashable, problems: Problems) -> None:
    if not isinstance(name, str) or not name or "/" in name or name.startswith((".", "__")):
        problems.add(f"variable name {name!r}; expected text without '/' that starts with no '.' or '__'")


def _check_attrs(owner: str, attrs: Mapping[Any, Any], problems: Problems) -> None:
    for key, value in attrs.items():
        if not isinstance(key, str) or not _is_plain(value):
            kind = type(value).__name__
            problems.add(
                f"attribute {key!r} of {owner} is a {kind}; expected text, numbers, lists or dicts of them "
                "(write times as ISO text)"
            )


def _is_plain(value: Any, depth: int = 0) -> bool:
    import numpy as np

    if value is None or isinstance(value, str | bool | int | float | np.bool | np.integer | np.floating):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biufU"
    if depth > 20:
        return False
    if isinstance(value, Mapping):
        return all(isinstance(k, str) and _is_plain(v, depth + 1) for k, v in value.items())
    return isinstance(value, list | tuple) and all(_is_plain(v, depth + 1) for v in value)


@functools.cache
def _blosc(typesize: int, shuffle: int) -> Callable[[np.ndarray[Any, Any]], bytes]:
    """Return what makes a blosc frame of an array: the package ``blosc`` where it is there, else numcodecs.

    Both make the same bytes; the first has the wider instructions of newer processors. Many tasks encode at
    once, one thread each.
    """
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
    block: np.ndarray[Any, Any], chunk: tuple[int, ...], fill: Any, codec: Codec = "compact"
) -> tuple[bytes, bytes]:
    """Return a storage chunk as its bytes on disk: blosc, then the crc32c that follows it.

    The very bytes that zarr-python makes with the codecs of `encoding_of`, without its copies and its one
    event loop, which cost as much again as the compression. ``block`` is C-contiguous and little-endian; at
    the far edge of an array, where it is smaller than ``chunk``, ``fill`` completes it.
    """
    import google_crc32c
    import numpy as np

    if block.shape != chunk:
        padded = np.full(chunk, fill, dtype=block.dtype)
        padded[tuple(slice(0, size) for size in block.shape)] = block
        block = padded
    encoded = _blosc(block.dtype.itemsize, _SHUFFLES[codec][1])(block)
    return encoded, int(google_crc32c.value(encoded)).to_bytes(4, "little")
