"""Bombs in Zarr stores: sealed as whole by somebody who knows how, and hostile all the same."""

from __future__ import annotations

import gzip
import json
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from .bomb_making import (
    ALL,
    BOMBS,
    GZIP,
    MEGA,
    NAME,
    READ,
    ZSTD,
    altered,
    bomb,
    codec_chain,
    framed,
    grid_of,
    seal,
    sealed_store,
)

__all__ = ["BOMBS"]


# --- metadata ----------------------------------------------------------------------------------------------


@bomb(*ALL)
def json_50000_deep(folder: Path) -> Path:
    store = sealed_store(folder)
    text = (store / NAME / "zarr.json").read_text().rstrip().removesuffix("}")
    (store / NAME / "zarr.json").write_text(text + ', "x": ' + "[" * 50_000 + "]" * 50_000 + "}")
    return store


@bomb(*ALL)
def json_500_deep_in_attributes(folder: Path) -> Path:
    deep: Any = 1
    for _ in range(500):
        deep = [deep]
    return altered(folder, attributes={"x": deep})


@bomb(*ALL)
def json_50000_deep_at_the_root(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / "zarr.json").write_text('{"a": ' * 50_000)
    return store


@bomb(*ALL)
def json_of_100_mb(folder: Path) -> Path:
    store = sealed_store(folder)
    with open(store / NAME / "zarr.json", "ab") as file:
        file.write(b" " * 100 * MEGA)
    return store


@bomb(*ALL)
def json_of_10_million_lists(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / NAME / "zarr.json").write_text('{"x": [' + "[]," * 10 * MEGA + "0]}")
    return store


@bomb(*ALL)
def json_number_of_a_megabyte(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / NAME / "zarr.json").write_text('{"shape": [' + "9" * MEGA + "]}")
    return store


@bomb(*ALL)
def metadata_are_a_pipe(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / NAME / "zarr.json").unlink()
    os.mkfifo(store / NAME / "zarr.json")
    return store


@bomb(*ALL)
def metadata_are_a_link_out(folder: Path) -> Path:
    store = sealed_store(folder)
    bait = folder.parent / "bait/zarr.json"
    shutil.move(store / NAME / "zarr.json", bait)
    (store / NAME / "zarr.json").symlink_to(bait)
    return store


@bomb(*ALL)
def metadata_are_an_endless_device(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / NAME / "zarr.json").unlink()
    (store / NAME / "zarr.json").symlink_to("/dev/zero")
    return store


@bomb(*ALL)
def an_array_is_a_link_out(folder: Path) -> Path:
    store = sealed_store(folder)
    shutil.move(store / NAME, folder.parent / "bait" / NAME)
    (store / NAME).symlink_to(folder.parent / "bait" / NAME)
    return store


@bomb("verify", "info")
def groups_are_links_around(folder: Path) -> Path:
    store = sealed_store(folder)
    for name in "ab":
        (store / name).symlink_to(".")
    return store


def _nested(folder: Path, name: str, depth: int) -> Path:
    """Write a store with groups in groups, by steps: the whole path may be longer than the system takes."""
    store = sealed_store(folder)
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
    store = sealed_store(folder)
    here = os.open(store / NAME, os.O_RDONLY)
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


@bomb(*READ)
def codec_pickle(folder: Path) -> Path:
    return framed(folder, _payload(folder), {"name": "pickle"})


@bomb(*READ)
def codec_numcodecs_pickle(folder: Path) -> Path:
    return framed(folder, _payload(folder), {"name": "numcodecs.pickle", "configuration": {"protocol": 5}})


@bomb(*READ)
def codec_pickle_in_place_of_bytes(folder: Path) -> Path:
    store = framed(folder, _payload(folder))
    path = store / NAME / "zarr.json"
    document = json.loads(path.read_bytes())
    document["codecs"] = [{"name": "numcodecs.pickle", "configuration": {"protocol": 5}}]
    document["data_type"] = "object"
    path.write_text(json.dumps(document))
    return seal(store)


@bomb("calibration", "irradiance", "info", "open-store")
def zarr_2_with_text_and_pickle_filters(folder: Path) -> Path:
    path = folder / "old.zarr"
    (path / NAME).mkdir(parents=True)
    (path / ".zgroup").write_text('{"zarr_format": 2}')
    described = {"zarr_format": 2, "shape": [4, 6], "chunks": [4, 6], "dtype": "|O", "compressor": None}
    filters = [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}]
    described |= {"fill_value": None, "order": "C", "filters": filters}
    (path / NAME / ".zarray").write_text(json.dumps(described))
    (path / NAME / ".zattrs").write_text('{"_ARRAY_DIMENSIONS": ["band", "cross_track"]}')
    (path / NAME / "0.0").write_bytes(_payload(folder))
    return path


@bomb(*READ)
def codec_of_a_module(folder: Path) -> Path:
    return altered(folder, codecs=codec_chain({"name": "os.system"}))


@bomb(*READ)
def codec_vlen_bytes(folder: Path) -> Path:
    return altered(folder, data_type="variable_length_bytes", codecs=codec_chain(first="vlen-bytes"))


@bomb(*READ)
def codec_bz2(folder: Path) -> Path:
    return altered(folder, codecs=codec_chain({"name": "numcodecs.bz2", "configuration": {"level": 9}}))


@bomb(*READ)
def codecs_a_thousand(folder: Path) -> Path:
    return altered(folder, codecs=codec_chain(*[ZSTD] * 1000))


@bomb(*READ)
def codecs_stacked_compressors(folder: Path) -> Path:
    return framed(folder, gzip.compress(gzip.compress(bytes(96))), GZIP, GZIP)


@bomb(*READ)
def codec_shards_in_shards(folder: Path) -> Path:
    inner: list[dict[str, Any]] = codec_chain()
    for _ in range(20):
        index = codec_chain({"name": "crc32c"})
        within = {"chunk_shape": [1, 1], "codecs": inner, "index_codecs": index}
        inner = [{"name": "sharding_indexed", "configuration": within}]
    return altered(folder, codecs=inner)


@bomb(*READ)
def data_type_object(folder: Path) -> Path:
    return altered(folder, data_type="object")


@bomb(*READ)
def data_type_with_a_gigabyte_a_sample(folder: Path) -> Path:
    return altered(folder, data_type={"name": "fixed_length_utf32", "configuration": {"length_bytes": 2**30}})


@bomb(*READ)
def data_type_raw_bits(folder: Path) -> Path:
    return altered(folder, data_type="r8000000000")


@bomb(*READ)
def storage_transformer(folder: Path) -> Path:
    return altered(folder, storage_transformers=[{"name": "pickle"}])


@bomb(*READ)
def fill_value_of_a_megabyte(folder: Path) -> Path:
    return altered(folder, fill_value="0x" + "f" * MEGA)


@bomb(*READ)
def dimension_name_of_a_megabyte(folder: Path) -> Path:
    return altered(folder, dimension_names=["band", "x" * MEGA])


# --- sizes -------------------------------------------------------------------------------------------------


@bomb(*READ)
def shape_10_to_12(folder: Path) -> Path:
    return altered(folder, shape=[10**12, 6])


@bomb(*READ)
def shape_10_to_12_in_one_chunk(folder: Path) -> Path:
    return altered(folder, shape=[10**12, 6], chunk_grid=grid_of(10**12, 6))


@bomb(*READ)
def shape_beyond_int64(folder: Path) -> Path:
    return altered(folder, shape=[2**63, 2**63])


@bomb(*READ)
def shape_product_overflows(folder: Path) -> Path:
    return altered(folder, shape=[2**32, 2**32], chunk_grid=grid_of(2**32, 2**32))


@bomb(*READ)
def shape_negative(folder: Path) -> Path:
    return altered(folder, shape=[-4, 6])


@bomb("open-store", "verify")
def shape_of_a_thousand_dims(folder: Path) -> Path:
    return altered(folder, shape=[1] * 1000, chunk_grid=grid_of(*[1] * 1000), dimension_names=None)


@bomb(*READ)
def chunk_10_to_12(folder: Path) -> Path:
    return altered(folder, chunk_grid=grid_of(10**6, 10**6))


@bomb(*READ)
def chunk_0(folder: Path) -> Path:
    return altered(folder, chunk_grid=grid_of(0, 6))


@bomb(*READ)
def chunk_of_other_dims(folder: Path) -> Path:
    return altered(folder, chunk_grid=grid_of(4))


@bomb("open-store", "verify", "irradiance", "info")
def index_of_a_terabyte(folder: Path) -> Path:
    return altered(folder, "irradiance_wavelength", shape=[2**37], chunk_grid=grid_of(2**27))


@bomb("open-store", "verify", "irradiance")
def times_beyond_all_years(folder: Path) -> Path:
    attributes = {"units": "centuries since 9999-99-99", "calendar": "none"}
    return altered(folder, "irradiance_time", attributes=attributes)


@bomb("open-store", "verify")
def record_of_10_to_9_chunks(folder: Path) -> Path:
    store = sealed_store(folder)
    path = store / NAME / "hyperpaint-chunks.json"
    path.write_text(json.dumps({**json.loads(path.read_bytes()), "grid": [10**9, 1]}))
    return seal(store, grids=False)


@bomb("open-store", "verify")
def record_of_3_million_chunks(folder: Path) -> Path:
    store = sealed_store(folder)
    kept = json.loads((store / NAME / "hyperpaint-chunks.json").read_bytes())
    kept |= {"grid": [3 * MEGA, 1], "crc32c": [0] * 3 * MEGA}
    (store / NAME / "hyperpaint-chunks.json").write_text(json.dumps(kept))
    return store


@bomb("open-store", "verify")
def record_whose_grid_takes_long_to_multiply(folder: Path) -> Path:
    store = sealed_store(folder)
    kept = json.loads((store / NAME / "hyperpaint-chunks.json").read_bytes())
    kept |= {"grid": [int("9" * 4000)] * 7000}
    (store / NAME / "hyperpaint-chunks.json").write_text(json.dumps(kept))
    return store


# --- what a writer finds beside a store --------------------------------------------------------------------


def _beside(folder: Path, name: str) -> Path:
    """Return a path in the staging folder of a whole store."""
    path = sealed_store(folder).parent / ".partial-lot.zarr" / name
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
    (sealed_store(folder).parent / ".partial-lot.zarr").symlink_to(folder.parent / "bait")
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
    _beside(folder, "lock").write_bytes(b" " * (10 * MEGA))
    return folder / "lot.zarr"


# --- consolidated metadata ---------------------------------------------------------------------------------


def _listing(folder: Path, listed: dict[str, Any]) -> Path:
    store = sealed_store(folder)
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
    return _listing(folder, {NAME: {"zarr_format": 3, "node_type": "array", "shape": [10**12]}})


@bomb("verify")
def listing_is_no_object(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / "zarr.json").write_text(
        '{"zarr_format": 3, "node_type": "group", "consolidated_metadata": [[]]}'
    )
    return store
