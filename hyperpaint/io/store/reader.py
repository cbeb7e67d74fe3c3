"""Any Zarr that xarray opens, checked before a value is decoded.

The reader is `xarray.open_zarr`. Metadata are checked first: codecs that run code, and sizes that exceed
memory, are errors. A group in its store's manifest must be unchanged and have all its chunks; zarr compares
the crc32c of a chunk with its bytes during reading.

Groups of a store: metadata, the list of all nodes in the root, and checks before a group is written.

`verify`: check that every chunk of a store is present, readable, and unchanged since it was written.
"""

import functools
import itertools
import json
import math
import os
import stat
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, overload

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    FORMAT_VERSION,
    IncompleteStoreError,
    Problems,
    StoreError,
    as_path,
    documented,
    mirrored,
    stamp_means,
    url_of,
    warn_user,
)

from .budget import counted
from .computing import on_workers, whole_chunk
from .manifest import (
    CONTENT,
    MANIFEST_NODE,
    MAX_CHUNKS,
    MAX_DEPTH,
    MAX_MESSAGES,
    MAX_METADATA_BYTES,
    MAX_NODES,
    MAX_VALUES,
    METADATA,
    OLD_RECORD,
    OWN_ATTRS,
    SEAL,
    GroupEntry,
    Location,
    Manifest,
    attributes_replaced,
    changed_attributes,
    check_state,
    chunk_digest,
    chunk_keys,
    clean_group,
    content_of,
    document_checksum,
    entry_of,
    joined,
    store_state,
)

LIMITS = SimpleNamespace(
    # Maximum size of a group that `load_group` reads into memory [byte].
    max_loaded_bytes=2**30,
    # Maximum size of a decoded chunk [byte]; chunks of `computing` have less than a tenth of it for any
    # camera.
    max_chunk_bytes=2**30,
    # Maximum size of an array with one dim, or of a chunk of texts or times, which xarray loads on opening
    # [B].
    max_index_bytes=64 * 2**20,
    # Memory of a text [byte].
    text_bytes=32,
)
# Maximum size that any files may declare [byte], and maximum ratio of declared size to file size above it.
SMALL_BYTES, MAX_RATIO = 64 * 2**20, 1000
# Parts of the names of codecs that run code from a file.
CODE_CODECS = ("pickle",)
# Files that make a folder a Zarr.
METADATA_FILES = (METADATA, ".zgroup", ".zarray", ".zattrs", ".zmetadata")

COARSE = "coarse_reflectance"


def list_groups(path: Any) -> list[str]:
    # Return the groups of a store that hold arrays, sorted; the root is ``""``.
    #
    # Raises `StoreError`: There is no Zarr store, or its metadata are too large. Raises `MissingExtraError`:
    # The package for this kind of URL is not installed.
    import zarr

    location, source = place_of(path)
    check_metadata(location, "")
    if location is not None and is_format_3(location):
        return location.groups()
    # format 2, or a store object of zarr: zarr lists the members of every group
    with_arrays: list[str] = []
    pending, nodes = [""], 0
    while pending:
        name = pending.pop()
        check_metadata(location, name)
        # zarr and every file system have their own classes
        with StoreError.instead_of(
            Exception,
            f"{path} is not a Zarr store ($kind: $error)",
            expected="a folder, zip file or URL with a zarr.json or .zgroup",
            mend="write cubes, maps and netCDF files into a store with hyperpaint process or hp.to_store",
            code="store-unreadable",
        ):
            members = dict(zarr.open_group(source, path=name, mode="r", use_consolidated=False).members())
        groups = [joined(name, key) for key, node in members.items() if isinstance(node, zarr.Group)]
        with_arrays += [name] if len(groups) < len(members) else []
        pending += groups
        nodes += len(members)
        StoreError.raise_if(
            nodes > MAX_NODES or name.count("/") >= MAX_DEPTH,
            f"{path}: more than {MAX_NODES} nodes, or groups more than {MAX_DEPTH} deep",
            mend="open one group by its path",
            code="nodes-too-many",
        )
    return sorted(with_arrays)


def is_format_3(location: Location) -> bool:
    # Return whether a location is a Zarr 3 store, also a hyperpaint store without its root's metadata.
    return location.has(METADATA) or location.has(MANIFEST_NODE, METADATA)


def is_complete(path: str | os.PathLike[str], group: str | None = None) -> bool:
    # Return whether a group is in its store's manifest, with unchanged metadata and all chunk files.
    #
    # Chunks are not read; `hyperpaint.verify` reads them.
    try:
        location, name = place_of(path)[0] or Location.of(path), clean_group(group)
        manifest = Manifest.read(location)
        if manifest is None or not manifest.allowed(name):  # the manifest does not list the group
            return False
        check_entry(location, name, manifest)
    except StoreError:
        return False
    return True


@overload
def open_store(path: Any, group: str, **kwargs: Any) -> xr.Dataset: ...


@overload
def open_store(path: Any, group: None = None, **kwargs: Any) -> Any: ...


@documented()
def open_store(path: Any, group: str | None = None, **kwargs: Any) -> Any:
    """Open a group lazily, like `xarray.open_zarr`, or all of a collect's store.

    Any Zarr that xarray opens is accepted. If the store has a manifest, the groups in it must be finished and
    unchanged, and the chunks of the opened group must exist. zarr checks the crc32c of every chunk during
    reading; `hyperpaint.verify` also finds valid chunks of another array or time. Groups and variables that
    other programs added are opened as well.

    Parameters
    ----------
    path
        Folder, zip file or URL of the store, or a store object of zarr, such as that of an icechunk session.
    group
        Group in the store, ``""`` for the root; by default the root, or all groups if the root has no arrays.
    **kwargs

    Returns
    -------
    xarray.Dataset or xarray.DataTree
        A dataset with one dask chunk per storage chunk, or per all bands of a slab, unless ``chunks`` is
        given. A tree if all groups are opened.

    Raises
    ------
    IncompleteStoreError
        The store or the group differs from its manifest.
    StoreError
        There is no such store or group (existing groups are listed); or it has codecs that run code, or
        declares sizes that exceed memory.
    MissingExtraError
        The package for this kind of URL is not installed.

    See Also
    --------
    open_group : A finished group of a store that is still being written.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.io.store import to_store
    >>> light = xr.Dataset({"wavelength": ("band", [450.0, 550.0])})
    >>> path = to_store(light, "memory://small_collect.zarr", "flightlines/raw_0")
    >>> open_store(path, "flightlines/raw_0").wavelength.values
    array([450., 550.])
    >>> sorted(open_store(path)["flightlines"].children)
    ['raw_0']
    """
    location, _ = place_of(path)
    groups = list_groups(path) if group is None else [""]
    if "" not in groups and location is not None:
        check_state(location)
        manifest = Manifest.read(location)
        recorded = manifest.groups.items() if manifest is not None else ()
        groups = sorted({*groups, *(name for name, entry in recorded if entry.arrays)})
    if groups and "" not in groups:
        with Problems(
            f"{path} has unusable groups; open_store(path, group) opens other groups",
            IncompleteStoreError,
        ) as problems:
            opened = {}
            for name in groups:
                with problems.noting(IncompleteStoreError, f"group {'/' + name!r}"):
                    opened[name] = open_group(path, name, **kwargs)
        return xr.DataTree.from_dict(opened)
    name = clean_group(group)
    # an error if a running or interrupted run has not written all its groups
    if (
        location is not None
        and (manifest := Manifest.read(location)) is not None
        and any(
            manifest.lacking(write, lambda group_name: content_of(location, group_name, manifest))
            for write in manifest.writes
            if name in write.contents
        )
    ):
        check_state(location)
    return open_group(path, name, **kwargs)


def open_group(path: Any, group: str, **kwargs: Any) -> xr.Dataset:
    # Open a finished group like `open_store`, even while other groups of the store are being written.
    #
    # Raises `IncompleteStoreError, StoreError, MissingExtraError`: As `open_store`, for this group.
    name, (location, _) = clean_group(group), place_of(path)
    if location is None:
        return open_unverified(path, name, **kwargs)
    for attempt in range(2):
        check_metadata(location, name)
        content = content_of(location, name)
        try:
            manifest = Manifest.read(location)
            if manifest is not None and manifest.allowed(name):
                check_entry(location, name, manifest)
            opened = open_unverified(path, name, **kwargs)
            entry = manifest.groups.get(name) if manifest is not None else None
            if entry is not None and attributes_replaced(location, name, entry):
                recorded = {key: value for key, value in entry.attributes.items() if key not in OWN_ATTRS}
                opened.attrs = recorded | opened.attrs
            return opened
        except (StoreError, OSError):
            # if a writer replaced the group since the checks, open the new group
            if attempt or content_of(location, name) == content:
                raise
    raise AssertionError


def check_entry(location: Location, group: str, manifest: Manifest) -> None:
    # Refuse a group whose metadata differ from the manifest, or whose chunk files are incomplete.
    #
    # Warns `PaintWarning`: Another program replaced the group's attributes; its arrays are unchanged.
    where, mend = f"group {'/' + group!r} of {location.url}", "write the group again"
    content, entry = content_of(location, group, manifest), manifest.groups.get(group)
    if content not in manifest.allowed(group):
        state = "differs from the manifest" if location.has(group, METADATA) else "was deleted"
        raise IncompleteStoreError(f"{where} {state}", mend=mend, code="group-changed")
    if entry is None or content != entry.content:
        entry_of(location, group)  # the group is published but not yet in the manifest: all chunks must exist
        return
    with Problems(f"{where} is not as it was written; {mend}", IncompleteStoreError) as problems:
        if attributes_replaced(location, group, entry):
            warn_user(
                f"{where}: another program replaced its attributes; the manifest's are used",
                "attributes-replaced",
            )
        elif changed := changed_attributes(location, group, entry):
            problems.add(
                f"attributes differ from the manifest: {', '.join(changed)}", code="attributes-changed"
            )
        files = location.files(group)
        for name, array in entry.arrays.items():
            document = location.metadata(joined(group, name))
            if document is None or document_checksum(document) != array.metadata:
                problems.add(
                    f"{name}: metadata {'are missing' if document is None else 'differ from the manifest'}",
                    code="metadata-changed",
                )
                continue
            missing = [key for key in chunk_keys(document, name) if joined(name, key) not in files]
            if missing and METADATA in files:  # not all servers list their files
                problems.add(
                    f"{name}: {len(missing)} of {array.chunks} chunks are missing, first {missing[0]}",
                    code="chunk-missing",
                )


def open_unverified(path: Any, group: str | None = None, **kwargs: Any) -> xr.Dataset:
    # Open a group of any Zarr lazily, without regard to a manifest.
    #
    # Raises `StoreError`: There is no such store or group, or it must not be read. Raises
    # `MissingExtraError`: The package for this kind of URL is not installed.
    import zarr

    (location, source), name = place_of(path), clean_group(group)
    check_metadata(location, name)
    # consolidated metadata of a local store may be outdated, if its writer was killed before the end
    is_remote = isinstance(source, str) and "://" in source
    # zarr warns of files of other programs, which `verify` reports
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Object at .* is not recognized")
        try:
            node = zarr.open_group(source, path=name, mode="r", use_consolidated=None if is_remote else False)
            arrays = dict(node.arrays())
            check_arrays(f"{path}/{name}".rstrip("/"), arrays)
            options = {"consolidated": node.metadata.consolidated_metadata is not None, **kwargs}
            cut = {
                key
                for key, array in arrays.items()
                if getattr(array.metadata, "dimension_names", None) == (ALONG_TRACK, BAND, CROSS_TRACK)
                and array.chunks[1:] != array.shape[1:]
            }
            # one task per slab, also for cubes with chunks of some bands or of tiles
            if cut and "chunks" not in options:
                options["chunks"] = {BAND: -1, CROSS_TRACK: -1}
            # store object with dask names from its content, not from path and time, for a group of hyperpaint
            content, seal = node.attrs.get(CONTENT), str(node.attrs.get(SEAL))
            is_whole = seal.partition(" ")[0] == str(len(arrays))  # no array that is not part of the content
            if content is not None and is_whole and isinstance(source, str):
                from .named_stores import NamedFsspecStore, NamedLocalStore

                kind: Any = NamedFsspecStore.from_url if is_remote else NamedLocalStore
                named = kind(source, read_only=True)
                named.content = f"{source} {content} {seal}"
                source = named
            opened: xr.Dataset = xr.open_zarr(source, group=name or None, **options)
            if COARSE in cut:  # so that a picture of one band reads one group of bands
                options |= {"chunks": {}, "drop_variables": [key for key in arrays if key != COARSE]}
                opened[COARSE] = xr.open_zarr(source, group=name or None, **options)[COARSE].variable
        except StoreError:
            raise
        except FileNotFoundError as error:
            try:
                text = f"groups found: {', '.join('/' + group for group in list_groups(path)) or 'none'}"
            except StoreError as list_error:
                text = str(list_error)
            raise StoreError(
                f"there is no group {'/' + name!r} of {path}; {text}", code="group-unknown"
            ) from error
        except Exception as error:  # zarr, file systems and xarray's decoding have their own classes
            text = f"{type(error).__name__}: {error!s:.200}"
            raise StoreError(f"{path}/{name} cannot be opened: {text}", code="store-unreadable") from error
    if COARSE in opened.variables:
        stamp_means(opened[COARSE], opened)
    if isinstance(path, str | os.PathLike):
        opened.encoding["source"] = os.fspath(path)
    for key in OWN_ATTRS:  # not valid for datasets derived from the group
        opened.attrs.pop(key, None)
    return opened


def load_group(path: Any, group: str | None = None) -> xr.Dataset:
    # Read all of a small group into memory; a group in a manifest must be unchanged.
    #
    # Raises `StoreError`: As `open_group`; a value cannot be read; or its arrays are larger than
    # `LIMITS.max_loaded_bytes` together, or far larger than its files. Raises `MissingExtraError`: The
    # package for this kind of URL is not installed.
    opened, limit = open_group(path, group or "", chunks=None), LIMITS.max_loaded_bytes
    if isinstance(path, str | os.PathLike) and os.path.exists(path):
        files = [file.stat() for file in (Path(path), *Path(path, clean_group(group)).rglob("*"))]
        StoreError.raise_if(
            not all(stat.S_ISREG(file.st_mode) or stat.S_ISDIR(file.st_mode) for file in files),
            f"{path} contains a pipe or device",
            expected="regular files",
            code="file-not-plain",
        )
        limit = min(limit, max(SMALL_BYTES, MAX_RATIO * sum(file.st_size for file in files)))
    StoreError.raise_if(
        opened.nbytes > limit,
        f"{path} declares {opened.nbytes} bytes",
        expected=f"at most {limit}",
        code="file-too-large",
    )
    # every codec has its own classes
    with StoreError.instead_of(Exception, f"{path} cannot be read: $kind: $error", code="store-unreadable"):
        opened.load()
    return opened


# --- location and checks -----------------------------------------------------------------------------------


def place_of(path: Any) -> tuple[Location | None, Any]:
    # Return the location of a path or URL (None for a store object of zarr), and the argument for zarr.
    import zarr

    if isinstance(path, zarr.abc.store.Store | zarr.storage.StorePath):
        return None, path
    location = Location.of(path)
    is_file = location.local is not None and os.path.isfile(location.url)  # a pipe would wait for ever
    if not is_file or not zipfile.is_zipfile(location.url):
        return location, location.url
    from fsspec.implementations.zip import ZipFileSystem  # type: ignore[import-untyped]

    fs = ZipFileSystem(location.url, skip_instance_cache=True)
    return Location(location.url, "", fs, None), zarr.storage.ZipStore(location.url, mode="r")


def is_zarr(path: Any) -> bool:
    # Return whether a path is a store object, ``.zarr``, or a folder or zip file with Zarr metadata; also a
    # URL without a suffix where nothing is found.
    if not isinstance(path, str | os.PathLike):
        return not isinstance(path, Sequence) and place_of(path)[0] is None
    text = os.fsdecode(path)
    if text.startswith(("file:", "local:")) and "::" not in text:
        text = os.fspath(as_path(text))
    if (url := url_of(text)) is not None and not text.rstrip("/").endswith((".zarr", ".zip")):
        text = os.fspath(mirrored(url))
        if not os.path.lexists(text):
            return not os.path.splitext(text)[1]
    files = (os.path.join(text, name) for name in METADATA_FILES[:3])
    if "://" in text or text.rstrip("/").endswith(".zarr") or any(map(os.path.lexists, files)):
        return True
    if not os.path.isfile(text) or not zipfile.is_zipfile(text):
        return False
    with zipfile.ZipFile(text) as file:
        return not {*METADATA_FILES[:3]}.isdisjoint(file.namelist())


def check_metadata(location: Location | None, group: str) -> None:
    # Raise for metadata documents of a group and its arrays that would fill the memory when parsed.
    #
    # At a URL only the document of the group is checked; for a store object none.
    if location is None:
        return
    total = values = 0
    for count, (name, size) in enumerate(_documents(location, group)):
        if size > 2**20:
            raw = location.read(name, limit=MAX_METADATA_BYTES) or b""
            values += sum(map(raw.count, (b"{", b"[", b",")))
        total += size
        StoreError.raise_if(
            total > 2 * MAX_METADATA_BYTES or values > MAX_VALUES or count > 3 * MAX_NODES,
            f"{location.url}: metadata of {total} bytes or more, up to {name!r:.80}",
            expected=f"at most {2 * MAX_METADATA_BYTES} bytes, {MAX_VALUES} values, {MAX_NODES} arrays",
            code="file-too-large",
        )


def _documents(location: Location, group: str) -> Iterator[tuple[str, int]]:
    if location.local is not None:
        folder = location.key(group)
        names = itertools.chain([""], os.listdir(folder) if os.path.isdir(folder) else ())
        for key in (joined(group, name, file) for name in names for file in METADATA_FILES):
            if not os.path.lexists(location.key(key)):
                continue
            StoreError.raise_if(
                not os.path.isfile(location.key(key)),
                f"{location.key(key)} is not a regular file",
                expected="metadata",
                code="file-not-plain",
            )
            yield key, os.path.getsize(location.key(key))
    elif hasattr(location.fs, "zip"):
        for entry in location.fs.zip.infolist():
            if entry.filename.endswith(METADATA_FILES):
                yield entry.filename, entry.file_size
            elif entry.file_size > LIMITS.max_chunk_bytes:
                raise StoreError(
                    f"{location.url}: {entry.filename:.80} has {entry.file_size} bytes",
                    expected=f"at most {LIMITS.max_chunk_bytes}",
                    code="file-too-large",
                )
    else:
        for key in (joined(group, file) for file in METADATA_FILES):
            if location.has(key):
                yield key, location.fs.size(location.key(key)) or 0


def check_arrays(subject: str, arrays: Mapping[str, Any]) -> None:
    # Check zarr arrays by name, without reading a value.
    #
    # Raises `StoreError`: Codecs run code, or sizes exceed memory; all problems are listed.
    with Problems(f"{subject} cannot be read safely", StoreError) as problems:
        chunks = index_bytes = 0
        for name, array in arrays.items():
            metadata = array.metadata
            # format 3 has a list of codecs, format 2 a compressor and filters
            codec_names = repr([getattr(metadata, key, None) for key in ("codecs", "compressor", "filters")])
            code_codec = next((word for word in CODE_CODECS if word in codec_names.lower()), "")
            dtype = np.dtype(array.dtype)
            is_text = dtype.kind in "OT"
            known = not is_text or any(
                word in str(type(metadata.dtype)) for word in ("VariableLength", "String")
            )
            # sizes; of shards, zarr reads the inner chunks one by one
            item = LIMITS.text_bytes if is_text else dtype.itemsize
            limit = (
                LIMITS.max_index_bytes
                if is_text or "since" in str(array.attrs.get("units"))
                else LIMITS.max_chunk_bytes
            )
            for is_wrong, found, expected, code in (
                (code_codec, f"codec {code_codec!r}, which runs code in the file", "", "codec-runs-code"),
                (not known, f"data type {metadata.dtype!s:.80}", "numbers, times or text", "type-wrong"),
                (
                    math.prod(array.chunks) * item > limit,
                    f"chunks of {array.chunks} {dtype}",
                    f"at most {limit} bytes",
                    "size-too-large",
                ),
                (array.ndim > 32, f"{array.ndim} dims", "at most 32", "size-too-large"),
            ):
                problems.add_if(is_wrong, f"{name}: {found}", expected=expected, code=code)
            sizes = zip(array.shape, array.chunks, strict=True)
            chunks += math.prod(-(-size // max(step, 1)) for size, step in sizes)
            if array.ndim == 1:
                index_bytes = max(index_bytes, array.shape[0] * max(item, 8))
        for size, most, unit in (
            (chunks, MAX_CHUNKS, "chunks"),
            (index_bytes, LIMITS.max_index_bytes, "bytes of an array with one dim"),
        ):
            problems.add_if(size > most, f"{size} {unit}", expected=f"at most {most}", code="size-too-large")


# --- names of groups ---------------------------------------------------------------------------------------

# Attributes that depend on the time of writing, and are not part of the content.
VOLATILE_ATTRS = ("created", "history", "hyperpaint_version", *OWN_ATTRS)

LISTED = {"kind": "inline", "must_understand": False}


def groups_above(group: str) -> list[str]:
    # Return the ancestors of a group, the root first.
    names = group.split("/") if group else []
    return ["/".join(names[:depth]) for depth in range(len(names))]


def stamped(attrs: Mapping[Any, Any], action: str) -> dict[str, Any]:
    # Return attributes with format, version, time and a new line of history.
    import datetime

    time = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    line = f"{time} hyperpaint {version_of_program()}: {action}"
    return {
        **{key: value for key, value in attrs.items() if key not in OWN_ATTRS},
        "Conventions": "CF-1.11",
        "hyperpaint_format": FORMAT_VERSION,
        "hyperpaint_version": version_of_program(),
        "created": time,
        "history": "\n".join(text for text in (str(attrs.get("history", "")), line) if text),
    }


@functools.cache
def version_of_program() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hyperpaint")
    except PackageNotFoundError:
        return "unknown"


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "attributes": json.loads(json.dumps(attributes, default=lambda value: value.tolist())),
        "zarr_format": 3,
        "node_type": "group",
    }


def ensure_groups(groups: Iterable[str], location: Location) -> None:
    # Write the missing or damaged metadata of groups; their contents stay.
    for group in groups:
        try:
            if location.metadata(group) is not None:
                continue
        except IncompleteStoreError:
            pass
        location.write_json(group_document(stamped({}, "created")), group, METADATA)


def set_attributes(group: str, attributes_to_set: Mapping[str, Any], location: Location) -> None:
    stored = location.attributes(group)
    if not has_attributes(group, attributes_to_set, location):
        location.write_json(
            group_document({**stored, **stamped({**stored, **attributes_to_set}, "to_store")}),
            group,
            METADATA,
        )


def has_attributes(group: str, expected: Mapping[str, Any], location: Location) -> bool:
    # Return whether a group exists with the expected attributes, except `VOLATILE_ATTRS`.
    if not location.has(group, METADATA):
        return False
    stored, plain = location.attributes(group), group_document(expected)["attributes"]
    lasting = {key: value for key, value in plain.items() if key not in VOLATILE_ATTRS}
    return all(key in stored and stored[key] == value for key, value in lasting.items())


def listed_documents(location: Location) -> dict[str, Any]:
    # Return the consolidated metadata of the root by path, empty if it has none.
    try:
        root = location.read_json("", METADATA) or {}
    except IncompleteStoreError:
        return {}
    listed = root.get("consolidated_metadata")
    documents = listed.get("metadata") if isinstance(listed, dict) else None
    return dict(documents) if isinstance(documents, dict) else {}


def with_listed(root: Mapping[str, Any], documents: Mapping[str, Any]) -> dict[str, Any]:
    # Return the root's metadata with those of all nodes, as consolidated by zarr.
    listed = {}
    for path in sorted(documents, key=lambda path: (path.count("/"), path)):
        document = {key: value for key, value in documents[path].items() if key != "consolidated_metadata"}
        if document["node_type"] == "group":
            document["consolidated_metadata"] = {**LISTED, "metadata": {}}
        listed[path] = document
    return {**root, "consolidated_metadata": {**LISTED, "metadata": listed}}


# --- checks before a group is written ----------------------------------------------------------------------


def check_above(groups: Iterable[str], location: Location, problems: Problems, *, overwrite: bool) -> None:
    # Add the reasons why no group can be written below ``groups`` to the problems.
    #
    # ``overwrite``: whether damaged metadata may be replaced.
    entries = location.entries("")
    file = location.local is not None and location.local.is_file()
    # a store without the root's metadata has a manifest
    if file or (entries and METADATA not in entries and MANIFEST_NODE not in entries):
        problems.add("it exists and is not a Zarr v3 store", mend="choose another path", code="store-foreign")
        return
    parents = [] if location.local is None else location.local.absolute().parents
    if outer := [str(parent) for parent in parents if (parent / METADATA).is_file()]:
        problems.add(
            f"it is inside the store {outer[0]}",
            mend="write a group of that store, or choose another path",
            code="path-inside-store",
        )
        return
    for group in groups:
        try:
            # a store with only a manifest was left by a writer that was killed at its start
            damaged = location.metadata(group) is None and not group and bool({*entries} - {MANIFEST_NODE})
        except IncompleteStoreError:
            damaged = True
        problems.add_if(
            damaged and not overwrite,
            f"the metadata of group {'/' + group!r} are missing or damaged",
            mend="pass overwrite=True to replace them; the groups in it stay",
            option="pass --overwrite to replace them; the groups in it stay",
            code="metadata-damaged",
        )


def occupant(group: str, content: str, location: Location, manifest: Manifest | None) -> str:
    # Return the state of the path where a group with some content is to be written.
    #
    # ``""``: nothing. ``"same"``: this content, complete. ``"lacks chunks"``: this content, chunks missing.
    # ``"parent"``: other groups or files of other programs. ``"array"``: an array, there or at a parent. Any
    # other text describes a group that only ``overwrite`` replaces.
    kinds = [location.kind(node) for node in (*groups_above(group)[1:], group)]
    if "array" in kinds:
        return "array"
    entries = [name for name in location.entries(group) if name != MANIFEST_NODE or group]
    if not kinds[-1] and not entries:
        return ""
    stored, lacks_chunks = content_of(location, group, manifest), False
    if stored == content:
        try:
            if manifest is None:
                entry_of(location, group)
            else:
                check_entry(location, group, manifest)
            return "same"
        except StoreError:
            lacks_chunks = True
    # only arrays of the group, also damaged ones, may be overwritten
    children = {name: location.kind(joined(group, name)) for name in location.folders(group)}
    children.pop("" if group else MANIFEST_NODE, None)
    arrays = {
        name
        for name, node_type in children.items()
        if node_type == "array" or (node_type == "unreadable" and location.has(group, name, "c"))
    }
    if len(arrays) < len(children) or (group and location.strays(group)):
        return "parent"
    entry = manifest.groups.get(group) if manifest is not None else None
    added = sorted(arrays - set(entry.arrays)) if entry is not None else []
    if lacks_chunks and added:
        return f"lacks chunks, and contains {', '.join(added)} of other programs"
    # behind a URL a killed run leaves arrays in their place, and no metadata of their group
    is_begun = manifest is not None and any(group in write.contents for write in manifest.writes)
    if lacks_chunks or (is_begun and not kinds[-1] and location.local is None):
        return "lacks chunks"
    return "with other content" if stored else "was not written by this version of hyperpaint"


#: Attributes of array wrappers of xarray and hyperpaint that refer to the wrapped array.
_INNER = ("array", "_array", "variable", "_data")


def reads_from(dataset: xr.Dataset, location: Any, group: str) -> list[str]:
    # Return the names of variables that read lazily from a group of a store or store object of zarr.
    return [
        str(name)
        for name, variable in dataset.variables.items()
        if any(_lies_in(array, location, group) for array in _zarr_arrays(variable))
    ]


def is_named_by_content(variable: xr.Variable) -> bool:
    # Return whether dask's name for a variable changes with the content of the Zarr arrays it reads.
    #
    # Usual names depend on the URL and the time of the root folder, names of `named_stores` on the content.
    return all(getattr(array.store_path.store, "content", "") for array in _zarr_arrays(variable))


def _zarr_arrays(variable: xr.Variable) -> Iterator[Any]:
    import dask
    import zarr
    from dask.blockwise import Blockwise

    pending: list[Any] = [] if variable._in_memory else [variable]
    # values in the layers of a graph, without creating their tasks
    if pending and dask.is_dask_collection(variable):
        pending = []
        for layer in variable.__dask_graph__().layers.values():  # type: ignore[union-attr]
            if isinstance(layer, Blockwise):
                pending += [layer.task, *(value for value, index in layer.indices if index is None)]
            else:
                pending += getattr(layer, "mapping", {}).values()
    # search the wrappers for zarr arrays
    visited: set[int] = set()
    while pending:
        value = pending.pop()
        if id(value) not in visited:
            visited.add(id(value))
            if isinstance(value, zarr.Array):
                yield value
            else:
                pending.extend(_parts(value))


def _parts(value: Any) -> Iterable[Any]:
    if isinstance(value, Mapping):
        return value.values()
    if isinstance(value, list | tuple | set):
        return value
    module = type(value).__module__.partition(".")[0]
    if module == "dask":  # Task, DataNode, Alias
        return (getattr(value, name) for name in ("args", "kwargs", "value") if hasattr(value, name))
    if module in ("xarray", "hyperpaint"):
        slots = (slot for kind in type(value).__mro__ for slot in getattr(kind, "__slots__", ()))
        names = {*slots, *getattr(value, "__dict__", ())}
        return (getattr(value, name) for name in _INNER if name in names)
    return ()


def _lies_in(array: Any, location: Any, group: str) -> bool:
    place = array.store_path
    if not isinstance(location, Location):
        return bool(place.store == location) and f"{place.path}/".startswith(f"{group}/" if group else "")
    root, base = getattr(place.store, "root", None), getattr(place.store, "path", None)
    if location.local is not None:  # local stores
        return root is not None and (Path(root) / place.path).resolve().is_relative_to(
            (location.local / group).resolve()
        )
    if base is None or root is not None:  # fsspec stores
        return False
    source = "/".join(part.strip("/") for part in (str(base), place.path) if part)
    return (source + "/").startswith(location.key(group).strip("/") + "/")


# --- verification ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoreReport:
    """Result of `verify`.

    Attributes
    ----------
    path
        The store.
    groups
        Groups that hold arrays.
    chunks
        Number of chunks read.
    problems
        One line per problem with its code at the end; empty for a valid store.
    notes
        Groups and arrays that could not be checked, and additions by other programs.
    resume
        Command that finishes an unfinished store; empty if unknown.
    """

    path: str
    groups: tuple[str, ...]
    chunks: int
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    resume: str = ""

    @property
    def ok(self) -> bool:
        # Whether there are no problems.
        return not self.problems

    def __str__(self) -> str:
        state = counted(len(self.problems), "problem") if self.problems else "whole"
        counts = f"{counted(len(self.groups), 'group')}, {counted(self.chunks, 'chunk')}"
        return "\n  ".join(
            [f"{self.path}: {counts}, {state}", *self.problems, *(f"note: {note}" for note in self.notes)]
        )


def verify(path: str | os.PathLike[str]) -> StoreReport:
    """Read every chunk of a store and compare it with the store's manifest.

    Finds groups that are unfinished, deleted, exchanged or changed; chunks that are missing, damaged,
    exchanged or outdated; and changed metadata. Groups and variables that other programs added are read, and
    listed in the notes. In a Zarr store without a manifest, damaged chunks are found if they have checksums.

    Parameters
    ----------
    path
        Folder, zip file or URL of the store.

    Returns
    -------
    StoreReport
        Report with all problems; ``report.ok`` is True if there are none.

    Raises
    ------
    StoreError
        There is no Zarr store; or it is a store object or a repository of icechunk, which icechunk checks.
    MissingExtraError
        The package for this kind of URL is not installed.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.io.store import to_store
    >>> path = to_store(xr.Dataset({"wavelength": ("band", np.arange(3.0))}), "memory://small.zarr")
    >>> print(verify(path))
    memory://small.zarr: 1 group, 1 chunk, whole
    """
    import zarr

    opened_location, source = place_of(path)
    location = opened_location or Location.of(path)
    check_metadata(location, "")
    StoreError.raise_if(
        location.has("snapshots") and location.has("manifests"),
        f"{location.url} is an icechunk repository, whose snapshots icechunk checks",
        expected="a Zarr store",
        code="store-unreadable",
    )
    begin = _stamp(location)
    nodes = (
        location.nodes()
        if is_format_3(location)
        else {
            joined(group, name): "array"
            for group in list_groups(path)
            for name in zarr.open_group(source, path=group, mode="r", use_consolidated=False).array_keys()
        }
    )
    groups = sorted({name.rpartition("/")[0] for name, node_type in nodes.items() if node_type == "array"})
    state = store_state(location, groups)
    manifest = Manifest.read(location, ignore_damage=True) or Manifest()  # damage is reported by the state
    unreadable = (name for name, node_type in nodes.items() if node_type == "unreadable")
    problems = [
        *state.problems,
        *(f"/{name}: its metadata cannot be read [metadata-damaged]" for name in unreadable),
        *_metadata_problems(location, "", manifest.groups.get("")),
    ]
    notes = list(state.notes)
    if manifest.groups:
        problems += _listing_problems(location, nodes, manifest)
        for group in ("", *(name for name, node_type in nodes.items() if node_type == "group")):
            strays = [name for name in location.strays(group) if joined(group, name) not in manifest.groups]
            stray_paths = [joined(group, name) for name in strays[:MAX_MESSAGES]]
            notes += [f"/{stray_path}: neither a group nor an array" for stray_path in stray_paths]
    chunks = 0
    for group in dict.fromkeys((*manifest.groups, *groups)):
        entry = manifest.groups.get(group)
        # a group with the content of another write is reported by `store_state`
        replaced = entry is not None and attributes_replaced(location, group, entry)
        content = content_of(location, group, manifest)
        current = entry is not None and entry.content == content
        if not current and content in manifest.allowed(group):  # its writer has not yet written the manifest
            try:
                entry, current = entry_of(location, group), True
            except StoreError as error:
                problems.append(f"/{group}: {error!s:.400}")
        recorded: Mapping[str, Any] = entry.arrays if entry is not None and current else {}
        if replaced:
            notes.append(f"/{group}: another program replaced its attributes; open_store knows them")
        elif entry is not None and current and group:
            problems += _metadata_problems(location, group, entry)
        array_names = [name for name in location.folders(group) if nodes.get(joined(group, name)) == "array"]
        for name in dict.fromkeys((*recorded, *array_names)):
            array_path = joined(group, name)
            if recorded and name not in recorded:
                notes.append(f"/{array_path}: added by another program, not in the manifest")
            try:
                count, faults = (
                    _recorded_chunks(location, group, name, recorded[name])
                    if name in recorded
                    else _other_chunks(location, source, array_path)
                )
                chunks += count
                problems += faults
            except StoreError as error:
                problems.append(f"/{array_path}: {error!s:.400}")
    if _stamp(location) != begin:
        problems.insert(0, "/: a writer changed the store during the check; run verify again [store-locked]")
    return StoreReport(
        location.url,
        tuple(groups),
        chunks,
        tuple(dict.fromkeys(problems)),
        tuple(dict.fromkeys(notes)),
        state.resume,
    )


def _stamp(location: Location) -> bytes | None:
    # Bytes of the manifest, which every writer changes at its start and end
    try:
        return location.read(MANIFEST_NODE, METADATA)
    except StoreError:
        return None


def _listing_problems(location: Location, nodes: Mapping[str, str], manifest: Manifest) -> Iterator[str]:
    # Differences between the consolidated metadata of the root and the manifest
    try:
        root, listed = location.read_json("", METADATA) or {}, listed_documents(location)
    except StoreError:
        return  # reported by `_metadata_problems`
    head = root.get("consolidated_metadata")
    if not isinstance(head, dict) or not head.items() >= LISTED.items():
        yield "/: the root has no list of all metadata; run the writer again [listing-missing]"
        return
    missing = [name for name in listed if name not in nodes and name.partition("/")[0] != MANIFEST_NODE]
    for name in missing[:MAX_MESSAGES]:
        yield f"/{name[:200]}: listed in the root's metadata but missing [listing-wrong]"
    expected = {}
    for group, entry in manifest.groups.items():
        # skip a group that a killed writer replaced by one with other content
        if not entry.content or content_of(location, group, manifest) == entry.content:
            if group and not attributes_replaced(location, group, entry):
                expected[group] = entry.metadata
            expected |= {joined(group, name): array.metadata for name, array in entry.arrays.items()}
    for name in filter(nodes.get, expected):
        document = listed.get(name)
        listed_document = dict(document) if isinstance(document, dict) else {}
        inner_list = listed_document.pop("consolidated_metadata", {**LISTED, "metadata": {}})
        if document_checksum(listed_document) != expected[name] or inner_list != {**LISTED, "metadata": {}}:
            yield f"/{name}: the root's list of all metadata differs; run the writer again [listing-wrong]"


def _metadata_problems(location: Location, group: str, entry: GroupEntry | None) -> Iterator[str]:
    # Problems of a group's metadata: unreadable, missing, or different from the manifest
    try:
        document = location.metadata(group)
        if entry is not None and document is None and not entry.content:  # else reported by `store_state`
            yield f"/{group}: its metadata are missing [metadata-missing]"
        changed = [] if entry is None or document is None else changed_attributes(location, group, entry)
        if changed:
            names = ", ".join(changed)[:200]
            yield f"/{group}: attributes differ from those written: {names} [attributes-changed]"
    except StoreError as error:
        yield f"/{group}: {error!s:.200}"


_READERS_AT_URL = 16


def _recorded_chunks(location: Location, group: str, name: str, array: Any) -> tuple[int, list[str]]:
    # Number of chunks of an array, and their differences from its manifest entry
    array_path = joined(group, name)
    document = location.metadata(array_path)
    if document is None or document_checksum(document) != array.metadata:
        changed = "metadata differ from those written [metadata-changed]"
        return 0, [
            f"/{array_path}: {'the array is missing [array-missing]' if document is None else changed}"
        ]
    keys = chunk_keys(document, array_path)
    problems = [
        f"/{array_path}/{stray}: not a chunk of this array [chunk-foreign]"
        for stray in sorted(location.files(array_path) - {*keys, METADATA, OLD_RECORD})[:MAX_MESSAGES]
    ]

    def end(key: str) -> bytes | str:
        encoded = location.read(array_path, key, limit=LIMITS.max_chunk_bytes)
        if encoded is None:
            return "the chunk is missing [chunk-missing]"
        return "the chunk is damaged [chunk-damaged]" if whole_chunk(encoded) is None else encoded[-4:]

    # behind a URL threads wait for answers
    threads = _READERS_AT_URL if location.local is None else None
    ends = dict(zip(keys, on_workers(end, keys, threads), strict=True))
    faults = [f"/{array_path}/{key}: {state}" for key, state in ends.items() if isinstance(state, str)]
    if not faults and chunk_digest(group, name, ends.items()) != array.digest:  # type: ignore[arg-type]
        faults = [
            f"/{array_path}: chunks differ from those written: exchanged, stale or altered [chunk-changed]"
        ]
    return len(keys), problems + faults


def _other_chunks(location: Location, source: Any, array_path: str) -> tuple[int, list[str]]:
    # Number of chunks of an array without a manifest entry, and its unreadable chunks
    import zarr

    try:
        array: Any = zarr.open_array(source, path=array_path, mode="r")
    except Exception as error:  # zarr raises many classes of errors
        return 0, [f"/{array_path}: {type(error).__name__}: {error!s:.200} [array-unreadable]"]
    check_arrays(location.url, {array_path: array})

    def state(index: tuple[int, ...]) -> str:
        region = tuple(slice(i * step, (i + 1) * step) for i, step in zip(index, array.chunks, strict=True))
        try:
            np.asarray(array[region])
        except Exception as error:  # a damaged chunk may raise anything that a codec raises
            cause = f"{type(error).__name__}: {error!s:.200}"
            return f"/{array_path}: chunk {index} cannot be read: {cause} [chunk-damaged]"
        return ""

    positions = list(
        np.ndindex(*(-(-size // max(step, 1)) for size, step in zip(array.shape, array.chunks, strict=True)))
    )
    is_large = array.nbytes > LIMITS.max_chunk_bytes // 8 * len(positions)  # chunks are read one by one
    states = map(state, positions) if is_large else on_workers(state, positions)
    return len(positions), [text for text in states if text]
