"""Bombs in Zarr stores: sealed as whole by somebody who knows how, and hostile all the same."""

from __future__ import annotations

import gzip
import json
import os
import pickle
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BOMBS"]

Bomb = Callable[[Path], Path]
BOMBS: list[tuple[Bomb, tuple[str, ...]]] = []

#: Doors that read metadata, and those that read chunks as well.
_READ = ("open-store", "verify", "calibration", "foreign")
_ALL = (*_READ, "irradiance", "info")
_NAME = "radiance_gain"
_MEGA = 10**6


def bomb(*doors: str) -> Callable[[Bomb], Bomb]:
    """Register a bomb for the doors that it is put through."""

    def register(made: Bomb) -> Bomb:
        BOMBS.append((made, doors))
        return made

    return register


def _store(folder: Path) -> Path:
    """Write a whole store that every door would let in: a calibration and a series of irradiance in one."""
    import xarray as xr

    import hyperpaint as hp

    units = {"units": "W m-2 sr-1 nm-1 s count-1"}
    stamps = np.datetime64("2024-05-21T12:00:00", "ns") + np.arange(8) * np.timedelta64(1, "s")
    nm = {"units": "nm"}
    made = xr.Dataset(
        {
            _NAME: (("band", "cross_track"), np.full((4, 6), 1e-8, "f4"), units),
            "irradiance": (
                ("irradiance_time", "irradiance_wavelength"),
                np.full((8, 60), 1.0, "f4"),
                {"units": "W m-2 nm-1"},
            ),
            "note": ((), "text"),
        },
        {
            "wavelength": ("band", [500.0, 550.0, 600.0, 650.0], nm),
            "fwhm": ("band", [6.0] * 4, nm),
            "irradiance_time": stamps,
            "irradiance_wavelength": ("irradiance_wavelength", np.arange(400.0, 1000, 10), nm),
        },
        {"srf_shape": "gaussian"},
    )
    return hp.to_store(made, folder / "lot.zarr")


def whole_store(folder: Path) -> Path:
    """Write what is no bomb."""
    return _store(folder)


def _seal(store: Path, *, grids: bool = True) -> Path:
    """Make the records fit what is there now, as whoever forges a store would."""
    from hyperpaint.io.store import record as records

    digests = {}
    for path in sorted(store.glob("*/hyperpaint-chunks.json")):
        document = json.loads((path.parent / "zarr.json").read_bytes())
        kept = json.loads(path.read_bytes())
        kept["metadata"] = records.metadata_checksum(document)
        grid = _grid(document)
        if grids and grid is not None and grid != kept["grid"] and np.prod(grid) < 10**5:
            kept |= {"grid": grid, "crc32c": [0] * int(np.prod(grid))}
        path.write_text(json.dumps(kept))
        digests[path.parent.name] = records.metadata_checksum(kept)
    root = json.loads((store / "zarr.json").read_bytes())
    token = root["attributes"]["hyperpaint_complete"].partition(" ")[0]
    seal = f"{token} chunks={records.metadata_checksum(digests):08x} "
    seal += f"attributes={records.attributes_checksum(root):08x}"
    root["attributes"]["hyperpaint_complete"] = seal
    (store / "zarr.json").write_text(json.dumps(root))
    return store


def unsealed(store: Path) -> Path:
    """Make a store one that hyperpaint never wrote."""
    for path in store.rglob("hyperpaint-chunks.json"):
        path.unlink()
    root = store / "zarr.json"
    if root.is_file():
        root.write_bytes(root.read_bytes().replace(b'"hyperpaint_', b'"other_'))
    return store


def _grid(document: dict[str, Any]) -> list[int] | None:
    try:
        chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
        return [-(-size // step) for size, step in zip(document["shape"], chunk, strict=True)]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


def _with(folder: Path, name: str = _NAME, **entries: Any) -> Path:
    """Write a sealed store in which an array's metadata have other entries."""
    store = _store(folder)
    path = store / name / "zarr.json"
    path.write_text(json.dumps({**json.loads(path.read_bytes()), **entries}))
    return _seal(store)


def _codecs(*last: dict[str, Any], first: str = "bytes") -> list[dict[str, Any]]:
    little = {"configuration": {"endian": "little"}} if first == "bytes" else {}
    return [{"name": first, **little}, *last]


def _blosc(**configuration: Any) -> dict[str, Any]:
    known = {"typesize": 4, "cname": "lz4", "clevel": 5, "shuffle": "bitshuffle", "blocksize": 0}
    return {"name": "blosc", "configuration": {**known, **configuration}}


_ZSTD = {"name": "zstd", "configuration": {"level": 1, "checksum": False}}
_GZIP = {"name": "gzip", "configuration": {"level": 5}}


def _frame(folder: Path, frame: bytes, *codecs: dict[str, Any], name: str = _NAME, **entries: Any) -> Path:
    """Write a sealed store in which a chunk is ``frame``, its array declaring ``codecs``."""
    first = "vlen-utf8" if name == "note" else "bytes"
    store = _with(folder, name, codecs=_codecs(*codecs, first=first), **entries)
    chunk = next(path for path in (store / name / "c", store / name / "c/0/0") if path.is_file())
    chunk.write_bytes(frame)
    return store


def _grid_of(*chunk: int) -> dict[str, Any]:
    return {"name": "regular", "configuration": {"chunk_shape": list(chunk)}}


def _sizes(*chunk: int) -> dict[str, Any]:
    """Return the entries of an array of one chunk."""
    return {"shape": list(chunk), "chunk_grid": _grid_of(*chunk)}


# --- metadata ----------------------------------------------------------------------------------------------


@bomb(*_ALL)
def json_50000_deep(folder: Path) -> Path:
    store = _store(folder)
    text = (store / _NAME / "zarr.json").read_text().rstrip().removesuffix("}")
    (store / _NAME / "zarr.json").write_text(text + ', "x": ' + "[" * 50_000 + "]" * 50_000 + "}")
    return store


@bomb(*_ALL)
def json_500_deep_in_attributes(folder: Path) -> Path:
    deep: Any = 1
    for _ in range(500):
        deep = [deep]
    return _with(folder, attributes={"x": deep})


@bomb(*_ALL)
def json_50000_deep_at_the_root(folder: Path) -> Path:
    store = _store(folder)
    (store / "zarr.json").write_text('{"a": ' * 50_000)
    return store


@bomb(*_ALL)
def json_of_100_mb(folder: Path) -> Path:
    store = _store(folder)
    with open(store / _NAME / "zarr.json", "ab") as file:
        file.write(b" " * 100 * _MEGA)
    return store


@bomb(*_ALL)
def json_of_10_million_lists(folder: Path) -> Path:
    store = _store(folder)
    (store / _NAME / "zarr.json").write_text('{"x": [' + "[]," * 10 * _MEGA + "0]}")
    return store


@bomb(*_ALL)
def json_number_of_a_megabyte(folder: Path) -> Path:
    store = _store(folder)
    (store / _NAME / "zarr.json").write_text('{"shape": [' + "9" * _MEGA + "]}")
    return store


@bomb(*_ALL)
def metadata_are_a_pipe(folder: Path) -> Path:
    store = _store(folder)
    (store / _NAME / "zarr.json").unlink()
    os.mkfifo(store / _NAME / "zarr.json")
    return store


@bomb(*_ALL)
def metadata_are_a_link_out(folder: Path) -> Path:
    store = _store(folder)
    bait = folder.parent / "bait/zarr.json"
    shutil.move(store / _NAME / "zarr.json", bait)
    (store / _NAME / "zarr.json").symlink_to(bait)
    return store


@bomb(*_ALL)
def metadata_are_an_endless_device(folder: Path) -> Path:
    store = _store(folder)
    (store / _NAME / "zarr.json").unlink()
    (store / _NAME / "zarr.json").symlink_to("/dev/zero")
    return store


@bomb(*_ALL)
def an_array_is_a_link_out(folder: Path) -> Path:
    store = _store(folder)
    shutil.move(store / _NAME, folder.parent / "bait" / _NAME)
    (store / _NAME).symlink_to(folder.parent / "bait" / _NAME)
    return store


@bomb("verify", "info")
def groups_are_links_around(folder: Path) -> Path:
    store = _store(folder)
    for name in "ab":
        (store / name).symlink_to(".")
    return store


def _nested(folder: Path, name: str, depth: int) -> Path:
    """Write a store with groups in groups, by steps: the whole path may be longer than the system takes."""
    store = _store(folder)
    here = os.open(store, os.O_RDONLY)
    for _ in range(depth):
        os.mkdir(name, dir_fd=here)
        below = os.open(name, os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
        with open(os.open("zarr.json", os.O_WRONLY | os.O_CREAT, dir_fd=here), "w") as file:
            file.write('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    os.close(here)
    return store


@bomb("verify", "info")
def groups_600_deep(folder: Path) -> Path:
    return _nested(folder, "d", 600)


@bomb("verify", "info")
def groups_beyond_the_longest_path(folder: Path) -> Path:
    return _nested(folder, "d" * 200, 30)


@bomb("verify")
def folders_600_deep_in_an_array(folder: Path) -> Path:
    store = _store(folder)
    here = os.open(store / _NAME, os.O_RDONLY)
    for _ in range(600):
        os.mkdir("c0", dir_fd=here)
        below = os.open("c0", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)
    return store


# --- codecs and data types ---------------------------------------------------------------------------------


class _Canary:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.path}'",)


def _payload(folder: Path) -> bytes:
    return pickle.dumps(np.array([_Canary(folder / "canary")] * 24, dtype=object))


@bomb(*_READ)
def codec_pickle(folder: Path) -> Path:
    return _frame(folder, _payload(folder), {"name": "pickle"})


@bomb(*_READ)
def codec_numcodecs_pickle(folder: Path) -> Path:
    return _frame(folder, _payload(folder), {"name": "numcodecs.pickle", "configuration": {"protocol": 5}})


@bomb(*_READ)
def codec_pickle_in_place_of_bytes(folder: Path) -> Path:
    store = _frame(folder, _payload(folder))
    path = store / _NAME / "zarr.json"
    document = json.loads(path.read_bytes())
    document["codecs"] = [{"name": "numcodecs.pickle", "configuration": {"protocol": 5}}]
    document["data_type"] = "object"
    path.write_text(json.dumps(document))
    return _seal(store)


@bomb("calibration", "irradiance", "info", "open-store")
def zarr_2_with_text_and_pickle_filters(folder: Path) -> Path:
    path = folder / "old.zarr"
    (path / _NAME).mkdir(parents=True)
    (path / ".zgroup").write_text('{"zarr_format": 2}')
    described = {"zarr_format": 2, "shape": [4, 6], "chunks": [4, 6], "dtype": "|O", "compressor": None}
    filters = [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}]
    described |= {"fill_value": None, "order": "C", "filters": filters}
    (path / _NAME / ".zarray").write_text(json.dumps(described))
    (path / _NAME / ".zattrs").write_text('{"_ARRAY_DIMENSIONS": ["band", "cross_track"]}')
    (path / _NAME / "0.0").write_bytes(_payload(folder))
    return path


@bomb(*_READ)
def codec_of_a_module(folder: Path) -> Path:
    return _with(folder, codecs=_codecs({"name": "os.system"}))


@bomb(*_READ)
def codec_vlen_bytes(folder: Path) -> Path:
    return _with(folder, data_type="variable_length_bytes", codecs=_codecs(first="vlen-bytes"))


@bomb(*_READ)
def codec_bz2(folder: Path) -> Path:
    return _with(folder, codecs=_codecs({"name": "numcodecs.bz2", "configuration": {"level": 9}}))


@bomb(*_READ)
def codecs_a_thousand(folder: Path) -> Path:
    return _with(folder, codecs=_codecs(*[_ZSTD] * 1000))


@bomb(*_READ)
def codecs_stacked_compressors(folder: Path) -> Path:
    return _frame(folder, gzip.compress(gzip.compress(bytes(96))), _GZIP, _GZIP)


@bomb(*_READ)
def codec_shards_in_shards(folder: Path) -> Path:
    inner: list[dict[str, Any]] = _codecs()
    for _ in range(20):
        index = _codecs({"name": "crc32c"})
        within = {"chunk_shape": [1, 1], "codecs": inner, "index_codecs": index}
        inner = [{"name": "sharding_indexed", "configuration": within}]
    return _with(folder, codecs=inner)


@bomb(*_READ)
def data_type_object(folder: Path) -> Path:
    return _with(folder, data_type="object")


@bomb(*_READ)
def data_type_with_a_gigabyte_a_sample(folder: Path) -> Path:
    return _with(folder, data_type={"name": "fixed_length_utf32", "configuration": {"length_bytes": 2**30}})


@bomb(*_READ)
def data_type_raw_bits(folder: Path) -> Path:
    return _with(folder, data_type="r8000000000")


@bomb(*_READ)
def storage_transformer(folder: Path) -> Path:
    return _with(folder, storage_transformers=[{"name": "pickle"}])


@bomb(*_READ)
def fill_value_of_a_megabyte(folder: Path) -> Path:
    return _with(folder, fill_value="0x" + "f" * _MEGA)


@bomb(*_READ)
def dimension_name_of_a_megabyte(folder: Path) -> Path:
    return _with(folder, dimension_names=["band", "x" * _MEGA])


# --- sizes -------------------------------------------------------------------------------------------------


@bomb(*_READ)
def shape_10_to_12(folder: Path) -> Path:
    return _with(folder, shape=[10**12, 6])


@bomb(*_READ)
def shape_10_to_12_in_one_chunk(folder: Path) -> Path:
    return _with(folder, shape=[10**12, 6], chunk_grid=_grid_of(10**12, 6))


@bomb(*_READ)
def shape_beyond_int64(folder: Path) -> Path:
    return _with(folder, shape=[2**63, 2**63])


@bomb(*_READ)
def shape_product_overflows(folder: Path) -> Path:
    return _with(folder, shape=[2**32, 2**32], chunk_grid=_grid_of(2**32, 2**32))


@bomb(*_READ)
def shape_negative(folder: Path) -> Path:
    return _with(folder, shape=[-4, 6])


@bomb("open-store", "verify")
def shape_of_a_thousand_dims(folder: Path) -> Path:
    return _with(folder, shape=[1] * 1000, chunk_grid=_grid_of(*[1] * 1000), dimension_names=None)


@bomb(*_READ)
def chunk_10_to_12(folder: Path) -> Path:
    return _with(folder, chunk_grid=_grid_of(10**6, 10**6))


@bomb(*_READ)
def chunk_0(folder: Path) -> Path:
    return _with(folder, chunk_grid=_grid_of(0, 6))


@bomb(*_READ)
def chunk_of_other_dims(folder: Path) -> Path:
    return _with(folder, chunk_grid=_grid_of(4))


@bomb("open-store", "verify", "irradiance", "info")
def index_of_a_terabyte(folder: Path) -> Path:
    return _with(folder, "irradiance_wavelength", shape=[2**37], chunk_grid=_grid_of(2**27))


@bomb("open-store", "verify", "irradiance")
def times_beyond_all_years(folder: Path) -> Path:
    attributes = {"units": "centuries since 9999-99-99", "calendar": "none"}
    return _with(folder, "irradiance_time", attributes=attributes)


@bomb("open-store", "verify")
def record_of_10_to_9_chunks(folder: Path) -> Path:
    store = _store(folder)
    path = store / _NAME / "hyperpaint-chunks.json"
    path.write_text(json.dumps({**json.loads(path.read_bytes()), "grid": [10**9, 1]}))
    return _seal(store, grids=False)


@bomb("open-store", "verify")
def record_of_3_million_chunks(folder: Path) -> Path:
    store = _store(folder)
    kept = json.loads((store / _NAME / "hyperpaint-chunks.json").read_bytes())
    kept |= {"grid": [3 * _MEGA, 1], "crc32c": [0] * 3 * _MEGA}
    (store / _NAME / "hyperpaint-chunks.json").write_text(json.dumps(kept))
    return store


@bomb("open-store", "verify")
def record_whose_grid_takes_long_to_multiply(folder: Path) -> Path:
    store = _store(folder)
    kept = json.loads((store / _NAME / "hyperpaint-chunks.json").read_bytes())
    kept |= {"grid": [int("9" * 4000)] * 7000}
    (store / _NAME / "hyperpaint-chunks.json").write_text(json.dumps(kept))
    return store


# --- chunks ------------------------------------------------------------------------------------------------


def _compressed(size: int = 96) -> bytearray:
    from numcodecs import Blosc

    return bytearray(Blosc("lz4", shuffle=Blosc.BITSHUFFLE).encode(np.zeros(size // 4, "f4")))


@bomb(*_READ)
def blosc_frame_of_2_gib(folder: Path) -> Path:
    frame = _compressed()
    frame[4:8] = (2**31 - 17).to_bytes(4, "little")
    return _frame(folder, bytes(frame), _blosc())


@bomb(*_READ)
def blosc_frame_that_ends_beyond_the_chunk(folder: Path) -> Path:
    frame = _compressed()
    frame[12:16] = (2**30).to_bytes(4, "little")
    return _frame(folder, bytes(frame), _blosc())


@bomb(*_READ)
def blosc_frame_of_blocks_larger_than_itself(folder: Path) -> Path:
    frame = _compressed()
    frame[8:12] = (2**31 - 1).to_bytes(4, "little")
    return _frame(folder, bytes(frame), _blosc())


@bomb(*_READ)
def blosc_frame_of_a_true_gigabyte(folder: Path) -> Path:
    return _frame(folder, bytes(_compressed(2**28)), _blosc(), **_sizes(4, 250_000))


@bomb(*_READ)
def blosc_frame_of_15_bytes(folder: Path) -> Path:
    return _frame(folder, bytes(_compressed()[:15]), _blosc())


def _zstd_frame(size: int, blocks: int) -> bytes:
    """Return a zstd frame that says ``size``, of as many blocks that repeat a zero 128 KiB long."""
    head = b"\x28\xb5\x2f\xfd\xe0" + size.to_bytes(8, "little")
    run = (2**17 << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    last = (2**17 << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"\0"
    return head + run * (blocks - 1) + last


@bomb(*_READ)
def zstd_bomb_of_10_gb(folder: Path) -> Path:
    return _frame(folder, _zstd_frame(80_000 * 2**17, 80_000), _ZSTD, **_sizes(4, 30_000))


@bomb(*_READ)
def zstd_frame_that_says_a_tebibyte(folder: Path) -> Path:
    return _frame(folder, _zstd_frame(2**40, 1), _ZSTD)


@bomb(*_READ)
def zstd_frame_that_says_nothing(folder: Path) -> Path:
    frame = _zstd_frame(0, 8000)
    return _frame(folder, frame[:4] + b"\x00\x58" + frame[13:], _ZSTD, **_sizes(4, 30_000))


@bomb(*_READ)
def zstd_frame_that_holds_more_than_it_says(folder: Path) -> Path:
    return _frame(folder, _zstd_frame(96, 900), _ZSTD)


@bomb(*_READ)
def zstd_second_frame_after_an_honest_one(folder: Path) -> Path:
    from numcodecs import Zstd

    return _frame(folder, bytes(Zstd().encode(bytes(96))) + _zstd_frame(8000 * 2**17, 1000), _ZSTD)


@bomb(*_READ)
def gzip_bomb(folder: Path) -> Path:
    piece = zlib.compressobj(9, wbits=31)
    data = b"".join(piece.compress(bytes(_MEGA)) for _ in range(200)) + piece.flush()
    return _frame(folder, data[:4000], _GZIP)


@bomb(*_READ)
def gzip_bomb_in_a_large_chunk(folder: Path) -> Path:
    piece = zlib.compressobj(9, wbits=31)
    data = b"".join(piece.compress(bytes(_MEGA)) for _ in range(400)) + piece.flush()
    return _frame(folder, data, _GZIP, **_sizes(4, 3 * _MEGA))


@bomb(*_READ)
def gzip_of_many_members(folder: Path) -> Path:
    return _frame(folder, gzip.compress(b"") * 200, _GZIP)


@bomb(*_READ)
def chunk_of_100_mb_for_96_bytes(folder: Path) -> Path:
    store = _store(folder)
    os.truncate(store / _NAME / "c/0/0", 100 * _MEGA)
    return store


@bomb(*_READ)
def text_of_four_billion_items(folder: Path) -> Path:
    return _frame(folder, (2**32 - 1).to_bytes(4, "little"), name="note")


@bomb(*_READ)
def text_that_ends_beyond_the_chunk(folder: Path) -> Path:
    return _frame(folder, (1).to_bytes(4, "little") + (2**31).to_bytes(4, "little") + b"text", name="note")


@bomb(*_READ)
def text_in_a_forged_frame(folder: Path) -> Path:
    frame = _compressed()
    frame[4:8] = (2**31 - 17).to_bytes(4, "little")
    return _frame(folder, bytes(frame), _blosc(typesize=1), name="note")


@bomb(*_READ)
def chunk_is_a_link_out(folder: Path) -> Path:
    store = _store(folder)
    bait = folder.parent / "bait/chunk"
    shutil.move(store / _NAME / "c/0/0", bait)
    (store / _NAME / "c/0/0").symlink_to(bait)
    return store


@bomb(*_READ)
def chunk_folder_is_a_link_out(folder: Path) -> Path:
    store = _store(folder)
    shutil.move(store / _NAME / "c", folder.parent / "bait/c")
    (store / _NAME / "c").symlink_to(folder.parent / "bait/c")
    return store


@bomb(*_READ)
def chunk_is_a_pipe(folder: Path) -> Path:
    store = _store(folder)
    (store / _NAME / "c/0/0").unlink()
    os.mkfifo(store / _NAME / "c/0/0")
    return store


@bomb("verify")
def link_to_the_whole_disk_among_chunks(folder: Path) -> Path:
    store = _store(folder)
    (store / _NAME / "c/more").symlink_to("/")
    return store


# --- what a writer finds beside a store --------------------------------------------------------------------


def _beside(folder: Path, name: str) -> Path:
    """Return a path in the staging folder of a whole store."""
    path = _store(folder).parent / ".partial-lot.zarr" / name
    path.parent.mkdir()
    return path


@bomb("writer")
def staged_group_leads_out(folder: Path) -> Path:
    (_beside(folder, "replaced-..%2Fescaped") / "c").mkdir(parents=True)
    return folder / "lot.zarr"


@bomb("writer")
def staged_group_is_a_link_out(folder: Path) -> Path:
    _beside(folder, "replaced-more").symlink_to(folder.parent / "bait")
    return folder / "lot.zarr"


@bomb("writer")
def staging_folder_is_a_link_out(folder: Path) -> Path:
    (_store(folder).parent / ".partial-lot.zarr").symlink_to(folder.parent / "bait")
    return folder / "lot.zarr"


@bomb("writer")
def lock_is_a_pipe(folder: Path) -> Path:
    os.mkfifo(_beside(folder, "lock"))
    return folder / "lot.zarr"


@bomb("writer")
def lock_is_a_link_out(folder: Path) -> Path:
    _beside(folder, "lock").symlink_to(folder.parent / "bait")
    return folder / "lot.zarr"


@bomb("writer")
def lock_of_4000_lists(folder: Path) -> Path:
    _beside(folder, "lock").write_text("[" * 4000)
    return folder / "lot.zarr"


@bomb("writer")
def lock_of_10_mb(folder: Path) -> Path:
    _beside(folder, "lock").write_bytes(b" " * (10 * _MEGA))
    return folder / "lot.zarr"


# --- consolidated metadata ---------------------------------------------------------------------------------


def _listing(folder: Path, listed: dict[str, Any]) -> Path:
    store = _store(folder)
    root = json.loads((store / "zarr.json").read_bytes())
    root["consolidated_metadata"]["metadata"] |= listed
    (store / "zarr.json").write_text(json.dumps(root))
    return store


@bomb("verify")
def listed_names_lead_out(folder: Path) -> Path:
    (folder.parent / "bait/zarr.json").write_text('{"zarr_format": 3, "node_type": "group"}')
    return _listing(folder, {"../../bait": {}, "/etc": {}, "a/../../../bait": {}, "nul\0": {}})


@bomb("verify")
def listed_are_200000_nodes(folder: Path) -> Path:
    return _listing(folder, {f"node{number}": {} for number in range(200_000)})


@bomb("verify")
def listed_is_another_array_than_there_is(folder: Path) -> Path:
    return _listing(folder, {_NAME: {"zarr_format": 3, "node_type": "array", "shape": [10**12]}})


@bomb("verify")
def listing_is_no_object(folder: Path) -> Path:
    store = _store(folder)
    (store / "zarr.json").write_text(
        '{"zarr_format": 3, "node_type": "group", "consolidated_metadata": [[]]}'
    )
    return store
