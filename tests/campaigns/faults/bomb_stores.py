"""Bombs in Zarr stores: what declares more than any memory holds, and what would run code of the file.

Each changes a small store, which a calibration, a record of irradiance and a library are read from. Chunks
that unpack to far more than their array declares are not among them: only zarr reads chunks.
"""

from __future__ import annotations

import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.io.store.stage import _MARK_TEXT

__all__ = ["ALL", "BOMBS", "whole_store"]

#: Every door that takes a store.
ALL = ("open-store", "verify", "info", "calibration", "irradiance", "library")
NAME = "radiance_gain"
MEGA = 10**6
#: By name: the doors that a bomb is put through, and what makes it in a folder.
BOMBS: dict[str, tuple[tuple[str, ...], Callable[[Path], Path]]] = {}


def bomb(*doors: str) -> Callable[[Callable[[Path], Path]], Callable[[Path], Path]]:
    """Register a bomb for the doors that it is put through."""

    def register(make: Callable[[Path], Path]) -> Callable[[Path], Path]:
        BOMBS[make.__name__] = (doors, make)
        return make

    return register


def whole_store(folder: Path, zarr_format: int = 3, *, ours: bool = False) -> Path:
    """Write what is no bomb: by plain xarray, or `hyperpaint.to_store`."""
    import xarray as xr

    import hyperpaint as hp

    nm = {"units": "nm"}
    units = {"units": "W m-2 sr-1 nm-1 s count-1"}
    light = {"units": "W m-2 nm-1"}
    values = {
        NAME: (("band", "cross_track"), np.full((4, 6), 1e-8, "f4"), units),
        "irradiance": (("irradiance_time", "irradiance_wavelength"), np.ones((8, 60), "f4"), light),
        "reflectance": (("signature", "band"), np.full((2, 4), 0.5, "f4"), {"units": "1"}),
    }
    made = xr.Dataset(
        values,
        {
            "wavelength": ("band", [500.0, 550.0, 600.0, 650.0], nm),
            "fwhm": ("band", [6.0] * 4, nm),
            "signature": np.array(["rot", "blau"], object),
            "irradiance_time": np.datetime64("2024-05-21T12:00:00", "ns") + np.arange(8) * 1_000_000_000,
            "irradiance_wavelength": ("irradiance_wavelength", np.arange(400.0, 1000, 10), nm),
        },
        {"srf_shape": "gaussian"},
    )
    path = folder / "lot.zarr"
    if ours:
        return hp.to_store(made, path)
    made.to_zarr(path, zarr_format=zarr_format, consolidated=False)
    return path


def changed(path: Path, **entries: Any) -> None:
    """Change entries of a JSON document."""
    path.write_text(json.dumps({**json.loads(path.read_bytes()), **entries}))


def grid_of(*chunk: int) -> dict[str, Any]:
    return {"name": "regular", "configuration": {"chunk_shape": list(chunk)}}


LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
PICKLE = {"name": "numcodecs.pickle", "configuration": {"protocol": 5}}
ZSTD = {"name": "zstd", "configuration": {"level": 1, "checksum": False}}


def shards(outer: int, inner: int) -> dict[str, Any]:
    within = {"chunk_shape": [inner, inner], "codecs": [LITTLE], "index_codecs": [LITTLE, {"name": "crc32c"}]}
    codec = {"name": "sharding_indexed", "configuration": within}
    return {"shape": [outer, outer], "chunk_grid": grid_of(outer, outer), "codecs": [codec]}


#: Entries of an array's ``zarr.json``, by the name of the bomb; of the gain or the array after the colon.
ARRAYS: dict[str, dict[str, Any]] = {
    "codec_pickle": {"codecs": [LITTLE, {"name": "pickle"}]},
    "codec_numcodecs_pickle": {"codecs": [PICKLE]},
    "codec_pickle_in_a_shard": {"codecs": [{"name": "sharding_indexed", "configuration": {
        "chunk_shape": [4, 6], "codecs": [LITTLE, PICKLE], "index_codecs": [LITTLE, {"name": "crc32c"}]}}]},
    "codec_of_a_module": {"codecs": [LITTLE, {"name": "os.system"}]},
    "data_type_object": {"data_type": "object"},
    "data_type_of_a_gigabyte": {
        "data_type": {"name": "fixed_length_utf32", "configuration": {"length_bytes": 2**30}}},
    "data_type_raw_bits": {"data_type": "r8000000000"},
    "shape_10_to_12": {"shape": [10**12, 6]},
    "shape_10_to_12_in_one_chunk": {"shape": [10**12, 6], "chunk_grid": grid_of(10**12, 6)},
    "shape_beyond_int64": {"shape": [2**63, 2**63]},
    "shape_product_overflows": {"shape": [2**32, 2**32], "chunk_grid": grid_of(2**32, 2**32)},
    "shape_of_3_million_chunks": {"shape": [3 * MEGA, 6], "chunk_grid": grid_of(1, 6)},
    "chunk_10_to_12": {"chunk_grid": grid_of(MEGA, MEGA)},
    "chunk_of_2_gb": {"shape": [20_000, 30_000], "chunk_grid": grid_of(20_000, 30_000)},
    "shard_of_huge_inner_chunks": shards(10**6, 10**6),
    "shard_of_a_billion_inner_chunks": shards(32_000, 1),
    "index_of_a_terabyte:irradiance_wavelength": {"shape": [2**37], "chunk_grid": grid_of(2**37)},
    "index_of_a_gigabyte:irradiance_wavelength": {"shape": [2**27], "chunk_grid": grid_of(2**20)},
    "times_of_a_gigabyte:irradiance_time": {"shape": [2**27], "chunk_grid": grid_of(2**20)},
    "texts_of_a_gigabyte:paint": {"shape": [2**27], "chunk_grid": grid_of(2**20)},
    "texts_in_a_chunk_of_10_to_9:paint": {"shape": [10**9], "chunk_grid": grid_of(10**9)},
}  # fmt: skip
#: The same of a ``.zarray``.
ARRAYS_2: dict[str, dict[str, Any]] = {
    "format_2_pickle": {"dtype": "|O", "filters": [{"id": "pickle", "protocol": 5}], "fill_value": None},
    "format_2_text_and_pickle": {
        "dtype": "|O", "filters": [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}], "fill_value": None},
    "format_2_pickle_as_compressor": {"compressor": {"id": "pickle", "protocol": 5}},
    "format_2_object_without_a_filter": {"dtype": "|O", "filters": None, "fill_value": None},
    "format_2_shape_10_to_12": {"shape": [10**12, 6]},
    "format_2_shape_10_to_12_in_one_chunk": {"shape": [10**12, 6], "chunks": [10**12, 6]},
    "format_2_chunk_of_2_gb": {"shape": [20_000, 30_000], "chunks": [20_000, 30_000]},
    "format_2_index_of_a_gigabyte:irradiance_wavelength": {"shape": [2**27], "chunks": [2**20]},
    "format_2_dtype_of_a_gigabyte": {"dtype": "|S1000000000"},
}  # fmt: skip


class _Canary:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.path}'",)


def _altered(label: str, entries: dict[str, Any], zarr_format: int) -> Callable[[Path], Path]:
    """Return what makes a store with an array of other entries; a chunk of it is a pickle that runs code."""
    name = label.partition(":")[2] or NAME

    def make(folder: Path) -> Path:
        store = whole_store(folder, zarr_format)
        changed(store / name / ("zarr.json" if zarr_format == 3 else ".zarray"), **entries)
        payload = pickle.dumps(np.array([_Canary(folder / "canary")] * 24, dtype=object))
        for chunk in ("c/0/0", "0.0"):
            if (store / name / chunk).is_file() and "pickle" in label:
                (store / name / chunk).write_bytes(payload)
        return store

    return make


for _label, _entries in ARRAYS.items():
    BOMBS[_label.partition(":")[0]] = (ALL, _altered(_label, _entries, 3))
for _label, _entries in ARRAYS_2.items():
    BOMBS[_label.partition(":")[0]] = (ALL, _altered(_label, _entries, 2))


# --- documents ---------------------------------------------------------------------------------------------

#: What a metadata document is replaced by.
DOCUMENTS: dict[str, Callable[[], str]] = {
    "json_50000_deep": lambda: '{"x": ' + "[" * 50_000 + "]" * 50_000 + "}",
    "json_of_100_mb": lambda: '{"zarr_format": 3}' + " " * 100 * MEGA,
    "json_of_10_million_lists": lambda: '{"x": [' + "[]," * 10 * MEGA + "0]}",
    "json_number_of_a_megabyte": lambda: '{"shape": [' + "9" * MEGA + "]}",
}


def _document(text: Callable[[], str], place: str, zarr_format: int = 3) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        store = whole_store(folder, zarr_format, ours="hyperpaint" in place)
        (store / place).write_text(text())
        return store

    return make


for _label, _text in DOCUMENTS.items():
    BOMBS[_label] = (ALL, _document(_text, f"{NAME}/zarr.json"))
    BOMBS[f"{_label}_at_the_root"] = (ALL, _document(_text, "zarr.json"))
    BOMBS[f"{_label}_as_manifest"] = (ALL, _document(_text, "hyperpaint/zarr.json"))
    BOMBS[f"format_2_{_label}"] = (ALL, _document(_text, f"{NAME}/.zarray", 2))
    BOMBS[f"format_2_{_label}_at_the_root"] = (ALL, _document(_text, ".zgroup", 2))


@bomb(*ALL)
def metadata_are_a_pipe(folder: Path) -> Path:
    store = whole_store(folder)
    (store / NAME / "zarr.json").unlink()
    os.mkfifo(store / NAME / "zarr.json")
    return store


@bomb(*ALL)
def metadata_are_an_endless_device(folder: Path) -> Path:
    store = whole_store(folder)
    (store / NAME / "zarr.json").unlink()
    (store / NAME / "zarr.json").symlink_to("/dev/zero")
    return store


@bomb(*ALL)
def many_documents_of_30_mb(folder: Path) -> Path:
    store = whole_store(folder)
    text = (store / NAME / "zarr.json").read_text()
    for number in range(10):
        (store / f"a{number}").mkdir()
        (store / f"a{number}/zarr.json").write_text(text + " " * 30 * MEGA)
    return store


@bomb("calibration", "irradiance")
def chunk_is_a_pipe(folder: Path) -> Path:
    store = whole_store(folder)
    (store / NAME / "c/0/0").unlink()
    os.mkfifo(store / NAME / "c/0/0")
    return store


@bomb("calibration", "irradiance")
def a_gigabyte_without_chunks(folder: Path) -> Path:
    store = whole_store(folder)
    document = json.loads((store / NAME / "zarr.json").read_bytes())
    document |= {"shape": [2**14, 2**14], "chunk_grid": grid_of(2**12, 2**12), "dimension_names": ["x", "y"]}
    (store / "more").mkdir()
    (store / "more/zarr.json").write_text(json.dumps(document))
    return store


@bomb("calibration")
def text_of_four_billion_items(folder: Path) -> Path:
    store = whole_store(folder)
    changed(store / "paint/zarr.json", codecs=[{"name": "vlen-utf8"}])
    (store / "paint/c/0").write_bytes((2**32 - 1).to_bytes(4, "little"))
    return store


# --- zip files ---------------------------------------------------------------------------------------------


def _zipped(store: Path, more: dict[str, int]) -> Path:
    """Pack a store, with entries of zeros, by name and size."""
    path = Path(shutil.make_archive(str(store), "zip", store))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file:
        for name, size in more.items():
            with file.open(name, "w", force_zip64=True) as entry:
                for start in range(0, size, 64 * MEGA):
                    entry.write(b" " * min(64 * MEGA, size - start))
    return path


@bomb(*ALL)
def zip_with_metadata_of_100_mb(folder: Path) -> Path:
    return _zipped(whole_store(folder), {"more/zarr.json": 100 * MEGA})


@bomb(*ALL)
def zip_with_an_entry_of_2_gb(folder: Path) -> Path:
    return _zipped(whole_store(folder), {f"{NAME}/c/9/9": 2 * 10**9})


@bomb(*ALL)
def zip_of_a_huge_array(folder: Path) -> Path:
    return _zipped(_altered("", {"shape": [10**12, 6]}, 3)(folder), {})


@bomb(*ALL)
def zip_of_a_pickle(folder: Path) -> Path:
    return _zipped(_altered("pickle", ARRAYS_2["format_2_pickle"], 2)(folder), {})


# --- manifests of somebody who knows how -------------------------------------------------------------------


def _forged(folder: Path, **entries: Any) -> Path:
    """Write a store of ours in which an array has other metadata, and the manifest fits them."""
    from hyperpaint.io.store.location import Location
    from hyperpaint.io.store.manifest import Manifest, document_checksum

    store = whole_store(folder, ours=True)
    changed(store / NAME / "zarr.json", **entries)
    location = Location.of(store)
    manifest = Manifest.read(location)
    assert manifest is not None
    arrays = dict(manifest.groups[""].arrays)
    document = location.metadata(NAME)
    arrays[NAME] = arrays[NAME]._replace(metadata=document_checksum(document), chunks=10**12)
    manifest.groups[""] = manifest.groups[""]._replace(arrays=arrays)  # type: ignore[index]
    manifest.write(location)
    return store


@bomb(*ALL)
def manifest_of_10_to_12_chunks(folder: Path) -> Path:
    return _forged(folder, shape=[10**12, 6], chunk_grid=grid_of(1, 6))


@bomb(*ALL)
def manifest_of_a_pickle(folder: Path) -> Path:
    return _forged(folder, codecs=[PICKLE])


@bomb(*ALL)
def manifest_of_no_grid(folder: Path) -> Path:
    return _forged(folder, chunk_grid={"name": "regular"})


@bomb("verify")
def listed_are_100000_nodes(folder: Path) -> Path:
    store = whole_store(folder, ours=True)
    root = json.loads((store / "zarr.json").read_bytes())
    root["consolidated_metadata"]["metadata"] |= {f"node{number}": {} for number in range(100_000)}
    (store / "zarr.json").write_text(json.dumps(root))
    return store


# --- groups ------------------------------------------------------------------------------------------------


def _nested(folder: Path, name: str, depth: int, zarr_format: int = 3) -> Path:
    """Write a store with groups in groups, by steps: the whole path may be longer than the system takes."""
    store = whole_store(folder, zarr_format)
    here = os.open(store, os.O_RDONLY)
    file, document = (".zgroup", {}) if zarr_format == 2 else ("zarr.json", {"node_type": "group"})
    for _ in range(depth):
        os.mkdir(name, dir_fd=here)
        below = os.open(name, os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
        with open(os.open(file, os.O_WRONLY | os.O_CREAT, dir_fd=here), "w") as out:
            json.dump({"zarr_format": zarr_format, **document}, out)
    os.close(here)
    return store


@bomb("verify", "info")
def groups_600_deep(folder: Path) -> Path:
    return _nested(folder, "d", 600)


@bomb("verify", "info")
def groups_beyond_the_longest_path(folder: Path) -> Path:
    return _nested(folder, "d" * 200, 30)


@bomb("verify", "info")
def format_2_groups_100_deep(folder: Path) -> Path:
    return _nested(folder, "d", 100, 2)


@bomb("verify", "info")
def groups_are_links_around(folder: Path) -> Path:
    store = whole_store(folder)
    for name in "ab":
        (store / name).symlink_to(".")
    return store


# --- what a writer finds beside a store --------------------------------------------------------------------


def _beside(folder: Path, name: str) -> Path:
    """Return a path in the staging folder of a whole store."""
    path = whole_store(folder, ours=True).parent / ".partial-lot.zarr" / name
    path.parent.mkdir()
    (path.parent / "hyperpaint").write_bytes(_MARK_TEXT)
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
    store = whole_store(folder, ours=True)
    (store.parent / ".partial-lot.zarr").symlink_to(folder.parent / "bait")
    return store


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
