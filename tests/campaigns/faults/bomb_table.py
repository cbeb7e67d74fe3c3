"""Table of bombs: small files that would fill the memory, never end, lead out of their folder or run code.

A row names the doors that a bomb is put through, the file that a door is given, and what is written for it.
Bombs in stores change a small store, which a calibration, a record of irradiance and a library are read from;
chunks that unpack to far more than their array declares are not among them: only zarr reads chunks.
"""

import gzip
import io
import json
import os
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.io.store.writer import MARK_TEXT

MEGA = 10**6
#: Every door that takes a store.
STORE_DOORS = "open-store verify info calibration irradiance library"
NAME = "radiance_gain"
PIPE = object()
ENDLESS = Path("/dev/zero")
FOLDER = None


class Bomb(NamedTuple):
    # A row of the table
    # doors: That it is put through, separated by blanks
    # path: What a door is given, in a folder of its own
    # files: By place: a text, bytes or function of the place, all of a file; a dict, entries of a JSON
    # document that change; a path that is linked to; ``PIPE``, ``FOLDER``; a number, the bytes of a sparse
    # file
    # store: The store that the files change: of Zarr format 3 or 2, or of `hyperpaint.to_store`
    # then: What is done to the path at last; returns what the door is given
    doors: str
    path: str
    files: Mapping[str, Any]
    store: dict[str, Any] | None = None
    then: Callable[[Path], Path] | None = None

    def make(self, folder: Path) -> Path:
        # Write the bomb into an empty folder; return the path for the door
        if self.store is not None:
            whole_store(folder, **self.store)
        for place, content in self.files.items():
            put(folder / place, content)
        path = folder / self.path
        return path if self.then is None else self.then(path)


def put(path: Path, content: Any) -> None:
    # Write a file of a bomb, in the place of what is there
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, dict):
        content = json.dumps({**json.loads(path.read_bytes()), **content})
    elif callable(content):
        content = content(path)
    if content is FOLDER:
        path.mkdir()
        return
    path.unlink(missing_ok=True)
    if content is PIPE:
        os.mkfifo(path)
    elif isinstance(content, Path):
        path.symlink_to(content)
    elif isinstance(content, int):
        path.touch()
        os.truncate(path, content)
    else:
        path.write_bytes(content.encode("latin-1") if isinstance(content, str) else content)


def many(
    text: str | bytes, count: int, head: str | bytes = "", tail: str | bytes = ""
) -> Callable[[Path], Any]:
    # Return a text that is made when it is written: a piece many times between two others
    return lambda _: type(text)().join([head or type(text)(), text * count, tail or type(text)()])


# --- instruments -------------------------------------------------------------------------------------------


def cube(extra: Any = "", data: Any = bytes(800), **values: object) -> dict[str, Any]:
    # Return the files of a cube whose header has other entries, and more text
    fields: dict[str, object] = {"samples": 10, "lines": 10, "bands": 4, "header offset": 0}
    fields |= {"data type": 12, "interleave": "bil", "byte order": 0}
    fields |= {key.replace("_", " "): value for key, value in values.items()}
    text = "ENVI\n" + "".join(f"{key} = {value}\n" for key, value in fields.items())
    return {"raw_0": data, "raw_0.hdr": lambda path: text + (extra(path) if callable(extra) else extra)}


def asd(
    changes: Mapping[int, bytes], tail: Callable[[Path], bytes] = lambda _: b"", cut: int | None = None
) -> Any:
    # Return an ASD file that would be right but for ``changes``: offset to bytes
    def content(path: Path) -> bytes:
        from hyperpaint.simulation import simulate_collect

        simulate_collect(path.parent / "made", scene="plan", lines=4, bands=4, columns=4)
        data = bytearray(sorted((path.parent / "made/asd").glob("*.asd"))[0].read_bytes())
        for place, new in changes.items():
            data[place : place + len(new)] = new
        return bytes(data[:cut]) + tail(path)

    return {"sky.asd": content}


def zipped_zeros(_: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("sky.txt", bytes(50 * MEGA))
    return packed.getvalue()


def sky(pattern: str) -> str:
    return (
        f'[irradiance]\nfiles = "{pattern}"\nquantity = "irradiance"\n'
        '[[flightlines]]\nid = "a"\ncube = "raw_0"\n'
        "start_time = 2024-05-21T12:00:00Z\nframe_period_ms = 7.0\n"
    )


FRAMES, NAVIGATION = "Frame#\tTimestamp", "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time"
ANY_TEXT = "settings frame-index imu-gps asd irradiance info"

ENVI: dict[str, tuple[str, dict[str, Any]]] = {
    "envi_with_10_to_12_samples": ("envi info", cube(samples=10**12)),
    "envi_with_10_to_12_lines_and_1_sample": ("envi", cube(samples=1, lines=10**12, bands=1)),
    # 2**32 * 2**31 * 4 * 2 bytes are 0 modulo 2**64
    "envi_product_overflows_to_the_right_size": ("envi", cube(samples=2**32, lines=2**31, bands=4, data=b"")),
    "envi_product_overflows_to_800_bytes": ("envi", cube(samples=2**62 + 100, lines=4, bands=1)),
    "envi_negative_sizes": ("envi", cube(samples=-10, lines=-10)),
    "envi_zero_samples": ("envi", cube(samples=0)),
    "envi_size_of_5000_digits": ("envi", cube(samples="9" * 5000)),
    "envi_huge_header_offset": ("envi", cube(header_offset=2**63 - 1)),
    "envi_negative_header_offset": ("envi", cube(header_offset=-800)),
    "envi_brace_list_with_one_value_a_line": (
        "envi",
        cube(many("1,\n", 1_390_000, "wavelength = {\n", "1}\n")),
    ),
    "envi_300000_band_names": ("envi info", cube(many("Band 1234567,", 300_000, "band names = {", "x}\n"))),
    "envi_4_mb_of_wavelengths": ("envi", cube(many("450.0,", 690_000, "wavelength = {", "1}\n"))),
    "envi_280000_keys": ("envi", cube(lambda _: "".join(f"key{number} = 1\n" for number in range(280_000)))),
    "envi_brace_never_closed": ("envi", cube(many("{", MEGA, "description = {"))),
    "envi_header_of_100_mb": ("envi", cube(many("x", 100 * MEGA, "; "))),
    "envi_header_is_gzip": (
        "envi",
        cube() | {"raw_0.hdr": lambda _: gzip.compress(cube()["raw_0.hdr"](_).encode())},
    ),
    "envi_wavelengths_beyond_float": ("envi", cube("wavelength = {1e999, nan, inf, -1e308}\n")),
    "envi_data_is_a_sparse_terabyte": ("envi", cube(data=10**12)),
    "envi_path_in_the_header": (
        "envi",
        cube("data file = ../bait/cube\n", data=b"") | {"../bait/cube": bytes(800)},
    ),
}
FILES: dict[str, tuple[str, str, Any]] = {
    "asd_text_with_ten_million_columns": (
        "asd",
        "sky.txt",
        lambda _: "Wavelength" + "\ta" * 10 * MEGA + "\n350" + "\t1" * 10 * MEGA + "\n",
    ),
    "asd_text_is_a_zip": ("asd", "sky.txt", zipped_zeros),
    "csv_of_one_line_of_100_mb": ("irradiance info", "sky.csv", many(b"1,", 50 * MEGA, b"time,400,410\n")),
    "csv_with_a_header_of_100_mb": ("irradiance", "sky.csv", many(b",400", 25 * MEGA, b"time")),
    "csv_is_gzip": ("irradiance", "sky.csv", lambda _: gzip.compress(b"time,400,410\n" + bytes(50 * MEGA))),
    "csv_numbers_of_a_megabyte": (
        "irradiance",
        "sky.csv",
        lambda _: "time,400,410\n2024-05-21T12:00:00Z," + "9" * MEGA + "e" + "9" * MEGA + ",1\n",
    ),
    "csv_quote_never_closed": (
        "irradiance",
        "sky.csv",
        many("2024-05-21T12:00:00Z,1,1\n", 5_000, 'time,400,410\n"'),
    ),
    "frame_number_of_10_to_18": (
        "frame-index info",
        "frameIndex_0.txt",
        f"{FRAMES}\n0\t1000000\n{10**18}\t2000000\n",
    ),
    "frame_number_beyond_int64": (
        "frame-index",
        "frameIndex_0.txt",
        f"{FRAMES}\n{2**64}\t1\n{'9' * 100_000}\t2\n",
    ),
    "frame_index_with_a_million_columns": (
        "frame-index",
        "frameIndex_0.txt",
        lambda _: FRAMES + "\tx" * MEGA + "\n" + "1\t" * MEGA + "\n",
    ),
    "navigation_with_a_million_columns": (
        "imu-gps",
        "imu_gps.txt",
        lambda _: NAVIGATION + "\tx" * MEGA + "\n" + "1\t" * MEGA + "\n",
    ),
    "navigation_of_numbers_beyond_float": (
        "imu-gps info",
        "imu_gps.txt",
        f"{NAVIGATION}\n"
        + "".join(
            f"1e999\tnan\t{'9' * 9999}\t1e999\t1\t1\t{'9' * 99}\t2021/07/20 12:00:00.{i}\n" for i in range(9)
        ),
    ),
    "settings_of_one_line_of_100_mb": (
        "settings info",
        "settings.txt",
        many(b"5", 100 * MEGA, b"Exposure (ms) = "),
    ),
    "settings_exposure_of_15_mb": ("settings", "settings.txt", many(b"5", 15 * MEGA, b"Exposure (ms) = ")),
    "settings_of_brackets": (
        "settings",
        "settings.txt",
        many(b"Exposure (", 1_500_000, tail=b"ms) = 5 x\nExposure (ms) = 4\n"),
    ),
    "pipe_in_place_of_a_file": (ANY_TEXT, "settings.txt", PIPE),
    "endless_device_in_place_of_a_file": (ANY_TEXT, "settings.txt", ENDLESS),
    "toml_of_nested_lists": ("collect info", "collect.toml", "x = " + "[" * 500_000),
    "toml_of_nested_tables": ("collect", "collect.toml", "x = " + "{a = " * 100_000),
    "toml_key_of_100000_parts": ("collect", "collect.toml", ".".join("a" * 100_000) + " = 1\n"),
    "toml_table_of_100000_parts": ("collect", "collect.toml", "[" + " . ".join("a" * 100_000) + "]\n"),
    "toml_with_half_a_million_files": (
        "collect",
        "collect.toml",
        many('"",', 300_000, "[irradiance]\nfiles = [", "]\n"),
    ),
    "toml_of_10_mb": ("collect", "collect.toml", many("x", 10 * MEGA, "# ")),
    "toml_numbers_of_a_megabyte": ("collect", "collect.toml", many("f", MEGA, "[camera]\nbit_depth = 0x")),
    "toml_with_20000_flight_lines_of_one_name": (
        "collect",
        "collect.toml",
        many('[[flightlines]]\nid="a"\ncube="b"\n', 20_000),
    ),
    "toml_is_a_pipe": ("collect", "collect.toml", PIPE),
    "toml_is_an_endless_device": ("collect", "collect.toml", ENDLESS),
    "toml_pattern_over_the_whole_disk": ("collect", "collect.toml", sky("/**/*.asd")),
    "toml_names_an_endless_device": ("collect", "collect.toml", sky("/dev/zero")),
    "toml_flight_line_id_leads_out": (
        "collect",
        "collect.toml",
        '[[flightlines]]\nid = "../../bait"\ncube = "raw_0"\n',
    ),
}
COLLECTS: dict[str, tuple[str, dict[str, Any]]] = {
    "toml_pattern_around_in_links": ("**/*.asd", dict.fromkeys("ab", Path("."))),
    "toml_pattern_of_stars_around_in_links": ("*/" * 36 + "*.asd", dict.fromkeys("abc", Path("."))),
    "toml_pattern_that_takes_fnmatch_long": ("*a" * 100 + "b", {"a" * 200: b""}),
    "toml_with_many_double_stars": ("**/" * 30 + "*.asd", {"d/" * 29 + "d": FOLDER}),
    "toml_names_a_pipe": ("sky.asd", {"sky.asd": PIPE}),
    "toml_names_a_link_to_a_device": ("sky.asd", {"sky.asd": ENDLESS}),
}
SPECTRA: dict[str, tuple[str, dict[str, Any]]] = {
    "asd_with_65535_channels": ("asd info", asd({204: struct.pack("<H", 65535)})),
    "asd_with_no_channels": ("asd", asd({204: struct.pack("<H", 0)})),
    "asd_with_forged_blocks": ("asd", asd({}, many(struct.pack("<H", 65535), 50_000, b"\x01"))),
    "asd_of_100_mb": ("asd", asd({}, lambda _: bytes(100 * MEGA))),
    "asd_ends_within_its_header": ("asd", asd({}, cut=300)),
    "asd_with_endless_wavelengths": ("asd", asd({191: struct.pack("<ff", 1e38, 1e38)})),
}
#: By name.
BOMBS: dict[str, Bomb] = {
    **{name: Bomb(doors, "raw_0.hdr", files) for name, (doors, files) in ENVI.items()},
    **{name: Bomb(doors, "sky.asd", files) for name, (doors, files) in SPECTRA.items()},
    **{name: Bomb(doors, path, {path: content}) for name, (doors, path, content) in FILES.items()},
    **{
        name: Bomb("collect", "collect.toml", files | {"collect.toml": sky(pattern)})
        for name, (pattern, files) in COLLECTS.items()
    },
}


# --- stores ------------------------------------------------------------------------------------------------


def whole_store(folder: Path, zarr_format: int = 3, *, ours: bool = False) -> Path:
    # Write what is no bomb: by plain xarray, or `hyperpaint.to_store`
    import xarray as xr

    import hyperpaint as hp

    nm = {"units": "nm"}
    light = {"units": "W m-2 nm-1"}
    values = {
        NAME: (("band", "cross_track"), np.full((4, 6), 1e-8, "f4"), {"units": "W m-2 sr-1 nm-1 s count-1"}),
        "irradiance": (("irradiance_time", "irradiance_wavelength"), np.ones((8, 60), "f4"), light),
        "reflectance": (("signature", "band"), np.full((2, 4), 0.5, "f4"), {"units": "1"}),
    }
    coords = {
        "wavelength": ("band", [500.0, 550.0, 600.0, 650.0], nm),
        "fwhm": ("band", [6.0] * 4, nm),
        "signature": np.array(["rot", "blau"], object),
        "irradiance_time": np.datetime64("2024-05-21T12:00:00", "ns") + np.arange(8) * 1_000_000_000,
        "irradiance_wavelength": ("irradiance_wavelength", np.arange(400.0, 1000, 10), nm),
    }
    made, path = xr.Dataset(values, coords, {"srf_shape": "gaussian"}), folder / "lot.zarr"
    if ours:
        return hp.to_store(made, path)
    made.to_zarr(path, zarr_format=zarr_format, consolidated=False)
    return path


def grid(*chunk: int) -> dict[str, Any]:
    return {"name": "regular", "configuration": {"chunk_shape": list(chunk)}}


LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
PICKLE = {"name": "numcodecs.pickle", "configuration": {"protocol": 5}}
OURS: dict[str, Any] = {"ours": True}


def shard(*inner: int, codecs: Any = (LITTLE,)) -> list[dict[str, Any]]:
    within = {"chunk_shape": inner, "codecs": codecs, "index_codecs": [LITTLE, {"name": "crc32c"}]}
    return [{"name": "sharding_indexed", "configuration": within}]


def square(size: int, inner: int) -> dict[str, Any]:
    return {"shape": [size, size], "chunk_grid": grid(size, size), "codecs": shard(inner, inner)}


#: Entries of an array's ``zarr.json``, by the name of the bomb; of the gain or the array after the colon.
ARRAYS: dict[str, dict[str, Any]] = {
    "codec_pickle": {"codecs": [LITTLE, {"name": "pickle"}]},
    "codec_numcodecs_pickle": {"codecs": [PICKLE]},
    "codec_pickle_in_a_shard": {"codecs": shard(4, 6, codecs=[LITTLE, PICKLE])},
    "codec_of_a_module": {"codecs": [LITTLE, {"name": "os.system"}]},
    "data_type_object": {"data_type": "object"},
    "data_type_of_a_gigabyte": {
        "data_type": {"name": "fixed_length_utf32", "configuration": {"length_bytes": 2**30}}
    },
    "data_type_raw_bits": {"data_type": "r8000000000"},
    "shape_10_to_12": {"shape": [10**12, 6]},
    "shape_10_to_12_in_one_chunk": {"shape": [10**12, 6], "chunk_grid": grid(10**12, 6)},
    "shape_beyond_int64": {"shape": [2**63, 2**63]},
    "shape_product_overflows": {"shape": [2**32, 2**32], "chunk_grid": grid(2**32, 2**32)},
    "shape_of_3_million_chunks": {"shape": [3 * MEGA, 6], "chunk_grid": grid(1, 6)},
    "chunk_10_to_12": {"chunk_grid": grid(MEGA, MEGA)},
    "chunk_of_2_gb": {"shape": [20_000, 30_000], "chunk_grid": grid(20_000, 30_000)},
    "shard_of_huge_inner_chunks": square(10**6, 10**6),
    "shard_of_a_billion_inner_chunks": square(32_000, 1),
    "index_of_a_terabyte:irradiance_wavelength": {"shape": [2**37], "chunk_grid": grid(2**37)},
    "index_of_a_gigabyte:irradiance_wavelength": {"shape": [2**27], "chunk_grid": grid(2**20)},
    "times_of_a_gigabyte:irradiance_time": {"shape": [2**27], "chunk_grid": grid(2**20)},
    "texts_of_a_gigabyte:signature": {"shape": [2**27], "chunk_grid": grid(2**20)},
    "texts_in_a_chunk_of_10_to_9:signature": {"shape": [10**9], "chunk_grid": grid(10**9)},
}
#: The same of a ``.zarray``.
ARRAYS_2: dict[str, dict[str, Any]] = {
    "format_2_pickle": {"dtype": "|O", "filters": [{"id": "pickle", "protocol": 5}], "fill_value": None},
    "format_2_text_and_pickle": {
        "dtype": "|O",
        "filters": [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}],
        "fill_value": None,
    },
    "format_2_pickle_as_compressor": {"compressor": {"id": "pickle", "protocol": 5}},
    "format_2_object_without_a_filter": {"dtype": "|O", "filters": None, "fill_value": None},
    "format_2_shape_10_to_12": {"shape": [10**12, 6]},
    "format_2_shape_10_to_12_in_one_chunk": {"shape": [10**12, 6], "chunks": [10**12, 6]},
    "format_2_chunk_of_2_gb": {"shape": [20_000, 30_000], "chunks": [20_000, 30_000]},
    "format_2_index_of_a_gigabyte:irradiance_wavelength": {"shape": [2**27], "chunks": [2**20]},
    "format_2_dtype_of_a_gigabyte": {"dtype": "|S1000000000"},
}


class _Canary:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch '{self.path}'",)


def hidden_code(chunk: Path) -> bytes:
    # Return the first chunk of the gain as a pickle that runs code
    canary = chunk.parents[1 if chunk.name == "0.0" else 3].with_name("canary")
    return pickle.dumps(np.array([_Canary(canary)] * 24, dtype=object))


def array(label: str, entries: dict[str, Any], zarr_format: int) -> dict[str, Any]:
    # Return the files that change an array of a store
    name = label.partition(":")[2] or NAME
    files: dict[str, Any] = {f"lot.zarr/{name}/{'zarr.json' if zarr_format == 3 else '.zarray'}": entries}
    return files | (
        {f"lot.zarr/{name}/{'c/0/0' if zarr_format == 3 else '0.0'}": hidden_code}
        if "pickle" in label
        else {}
    )


for _tables, _format in ((ARRAYS, 3), (ARRAYS_2, 2)):
    BOMBS |= {
        label.partition(":")[0]: Bomb(
            STORE_DOORS, "lot.zarr", array(label, entries, _format), {"zarr_format": _format}
        )
        for label, entries in _tables.items()
    }

#: What a metadata document is replaced by, and the places of such documents.
DOCUMENTS: dict[str, Callable[[Path], str]] = {
    "json_50000_deep": lambda _: '{"x": ' + "[" * 50_000 + "]" * 50_000 + "}",
    "json_of_100_mb": many(" ", 100 * MEGA, '{"zarr_format": 3}'),
    "json_of_10_million_lists": many("[],", 10 * MEGA, '{"x": [', "0]}"),
    "json_number_of_a_megabyte": many("9", MEGA, '{"shape": [', "]}"),
}
PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "{}": (f"{NAME}/zarr.json", {}),
    "{}_at_the_root": ("zarr.json", {}),
    "{}_as_manifest": ("hyperpaint/zarr.json", OURS),
    "format_2_{}": (f"{NAME}/.zarray", {"zarr_format": 2}),
    "format_2_{}_at_the_root": (".zgroup", {"zarr_format": 2}),
}
BOMBS |= {
    name.format(label): Bomb(STORE_DOORS, "lot.zarr", {f"lot.zarr/{place}": text}, store)
    for label, text in DOCUMENTS.items()
    for name, (place, store) in PLACES.items()
}


def zipped(**more: int) -> Callable[[Path], Path]:
    # Return what packs a store, with entries of blanks, by name and size
    def pack(store: Path) -> Path:
        path = Path(shutil.make_archive(str(store), "zip", store))
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file:
            for name, size in more.items():
                with file.open(name, "w", force_zip64=True) as entry:
                    for start in range(0, size, 64 * MEGA):
                        entry.write(b" " * min(64 * MEGA, size - start))
        return path

    return pack


def listed_in_the_manifest(store: Path) -> Path:
    # Let the manifest of a store of ours fit the metadata of its gain, as somebody would who knows how
    from hyperpaint.io.store.manifest import Location, Manifest, document_checksum

    location = Location.of(store)
    manifest = Manifest.read(location)
    assert manifest is not None
    arrays = dict(manifest.groups[""].arrays)
    arrays[NAME] = arrays[NAME]._replace(metadata=document_checksum(location.metadata(NAME)), chunks=10**12)
    manifest.groups[""] = manifest.groups[""]._replace(arrays=arrays)  # type: ignore[index]
    manifest.write(location)
    return store


def nested(name: str, depth: int, zarr_format: int = 3) -> Callable[[Path], Path]:
    # Return what writes groups in groups, by steps: the whole path may be longer than the system takes
    def nest(store: Path) -> Path:
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

    return nest


def padded(path: Path) -> bytes:
    return (path.parents[1] / NAME / "zarr.json").read_bytes() + b" " * 30 * MEGA


def gigabyte(path: Path) -> str:
    document = json.loads((path.parents[1] / NAME / "zarr.json").read_bytes())
    document |= {"shape": [2**14, 2**14], "chunk_grid": grid(2**12, 2**12), "dimension_names": ["x", "y"]}
    return json.dumps(document)


def long_list(path: Path) -> str:
    root = json.loads(path.read_bytes())
    root["consolidated_metadata"]["metadata"] |= {f"node{number}": {} for number in range(100_000)}
    return json.dumps(root)


#: Doors, what is changed in the store, of which kind it is, and what is done to it at last.
STORES: dict[str, tuple[str, dict[str, Any], dict[str, Any], Callable[[Path], Path] | None]] = {
    "metadata_are_a_pipe": (STORE_DOORS, {f"{NAME}/zarr.json": PIPE}, {}, None),
    "metadata_are_an_endless_device": (STORE_DOORS, {f"{NAME}/zarr.json": ENDLESS}, {}, None),
    "many_documents_of_30_mb": (STORE_DOORS, {f"a{n}/zarr.json": padded for n in range(10)}, {}, None),
    "chunk_is_a_pipe": ("calibration irradiance", {f"{NAME}/c/0/0": PIPE}, {}, None),
    "a_gigabyte_without_chunks": ("calibration irradiance", {"more/zarr.json": gigabyte}, {}, None),
    "text_of_four_billion_items": (
        "calibration",
        {
            "signature/zarr.json": {"codecs": [{"name": "vlen-utf8"}]},
            "signature/c/0": (2**32 - 1).to_bytes(4, "little"),
        },
        {},
        None,
    ),
    "zip_with_metadata_of_100_mb": (STORE_DOORS, {}, {}, zipped(**{"more/zarr.json": 100 * MEGA})),
    "zip_with_an_entry_of_2_gb": (STORE_DOORS, {}, {}, zipped(**{f"{NAME}/c/9/9": 2 * 10**9})),
    "zip_of_a_huge_array": (STORE_DOORS, {f"{NAME}/zarr.json": {"shape": [10**12, 6]}}, {}, zipped()),
    "zip_of_a_pickle": (
        STORE_DOORS,
        {f"{NAME}/.zarray": ARRAYS_2["format_2_pickle"], f"{NAME}/0.0": hidden_code},
        {"zarr_format": 2},
        zipped(),
    ),
    "manifest_of_10_to_12_chunks": (
        STORE_DOORS,
        {f"{NAME}/zarr.json": {"shape": [10**12, 6], "chunk_grid": grid(1, 6)}},
        OURS,
        listed_in_the_manifest,
    ),
    "manifest_of_a_pickle": (
        STORE_DOORS,
        {f"{NAME}/zarr.json": {"codecs": [PICKLE]}},
        OURS,
        listed_in_the_manifest,
    ),
    "manifest_of_no_grid": (
        STORE_DOORS,
        {f"{NAME}/zarr.json": {"chunk_grid": {"name": "regular"}}},
        OURS,
        listed_in_the_manifest,
    ),
    "listed_are_100000_nodes": ("verify", {"zarr.json": long_list}, OURS, None),
    "groups_600_deep": ("verify info", {}, {}, nested("d", 600)),
    "groups_beyond_the_longest_path": ("verify info", {}, {}, nested("d" * 200, 30)),
    "format_2_groups_100_deep": ("verify info", {}, {"zarr_format": 2}, nested("d", 100, 2)),
    "groups_are_links_around": ("verify info", dict.fromkeys("ab", Path(".")), {}, None),
    "staging_folder_is_a_link_out": ("writer", {"../.partial-lot.zarr": Path("../bait")}, OURS, None),
}
#: What a writer finds in the staging folder beside a store.
STAGED: dict[str, tuple[str, Any]] = {
    "staged_group_leads_out": ("replaced-..%2Fescaped/c", FOLDER),
    "staged_group_is_a_link_out": ("replaced-more", Path("../../bait")),
    "lock_is_a_pipe": ("lock", PIPE),
    "lock_is_a_link_out": ("lock", Path("../../bait")),
    "lock_of_4000_lists": ("lock", "[" * 4000),
    "lock_of_10_mb": ("lock", b" " * (10 * MEGA)),
}
BOMBS |= {
    name: Bomb(
        doors, "lot.zarr", {f"lot.zarr/{place}": content for place, content in files.items()}, store, then
    )
    for name, (doors, files, store, then) in STORES.items()
}
BOMBS |= {
    name: Bomb(
        "writer",
        "lot.zarr",
        {".partial-lot.zarr/hyperpaint": MARK_TEXT, f".partial-lot.zarr/{place}": content},
        OURS,
    )
    for name, (place, content) in STAGED.items()
}
