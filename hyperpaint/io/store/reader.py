"""Any Zarr that xarray opens, checked before a value is decoded.

The reader is `xarray.open_zarr`. Metadata are checked first: codecs that run code, and sizes that exceed
memory, are errors. A group in its store's manifest must be unchanged and have all its chunks; zarr compares
the crc32c of a chunk with its bytes during reading.
"""

import itertools
import math
import os
import stat
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
import xarray as xr

from hyperpaint.base.errors import IncompleteStoreError, Problems, StoreError, warn_user
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, stamp_means

from .location import (
    MANIFEST_NODE,
    MAX_DEPTH,
    MAX_METADATA_BYTES,
    MAX_NODES,
    MAX_VALUES,
    METADATA,
    Location,
    clean_group,
    joined,
)
from .manifest import (
    CONTENT,
    MAX_CHUNKS,
    OWN_ATTRS,
    SEAL,
    Manifest,
    attributes_replaced,
    changed_attributes,
    check_state,
    chunk_keys,
    content_of,
    document_checksum,
    entry_of,
)

# Maximum size of a group that `load_group` reads into memory [byte].
MAX_LOADED_BYTES = 2**30
# Maximum size of a decoded chunk [byte]; chunks of `layout` have less than a tenth of it for any camera.
MAX_CHUNK_BYTES = 2**30
# Maximum size of an array with one dim, or of a chunk of texts or times, which xarray loads on opening [B].
MAX_INDEX_BYTES = 64 * 2**20
# Memory of a text [byte].
TEXT_BYTES = 32
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
        try:
            members = dict(zarr.open_group(source, path=name, mode="r", use_consolidated=False).members())
        except Exception as error:  # zarr and every file system have their own classes
            raise StoreError(
                f"{path} is not a Zarr store ({type(error).__name__}: {error!s:.200})",
                expected="a folder, zip file or URL with a zarr.json or .zgroup",
                code="store-unreadable",
            ) from error
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
        problems = Problems(
            f"{path} has unusable groups; open_store(path, group) opens other groups",
            IncompleteStoreError,
        )
        opened = {}
        for name in groups:
            try:
                opened[name] = open_group(path, name, **kwargs)
            except IncompleteStoreError as error:
                problems.add_error(f"group {'/' + name!r}", error)
        problems.raise_if_any()
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
    problems = Problems(f"{where} is not as it was written; {mend}", IncompleteStoreError)
    if attributes_replaced(location, group, entry):
        warn_user(
            f"{where}: another program replaced its attributes; the manifest's are used",
            "attributes-replaced",
        )
    elif changed := changed_attributes(location, group, entry):
        problems.add(f"attributes differ from the manifest: {', '.join(changed)}", code="attributes-changed")
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
    problems.raise_if_any()


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
            source = _named(source, node, arrays)
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
    # `MAX_LOADED_BYTES` together, or far larger than its files. Raises `MissingExtraError`: The package for
    # this kind of URL is not installed.
    opened, limit = open_group(path, group or "", chunks=None), MAX_LOADED_BYTES
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
    try:
        opened.load()
    except Exception as error:  # every codec has its own classes
        raise StoreError(
            f"{path} cannot be read: {type(error).__name__}: {error!s:.200}", code="store-unreadable"
        ) from error
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
    # Return whether a path is a URL, store object, ``.zarr``, or a folder or zip file with Zarr metadata.
    if not isinstance(path, str | os.PathLike):
        return not isinstance(path, Sequence) and place_of(path)[0] is None
    text = os.fsdecode(path)
    files = (os.path.join(text, name) for name in METADATA_FILES[:3])
    if "://" in text or text.rstrip("/").endswith(".zarr") or any(map(os.path.lexists, files)):
        return True
    if not os.path.isfile(text) or not zipfile.is_zipfile(text):
        return False
    with zipfile.ZipFile(text) as file:
        return not {*METADATA_FILES[:3]}.isdisjoint(file.namelist())


def _named(source: Any, node: Any, arrays: Mapping[str, Any]) -> Any:
    # Store object with dask names from its content, not from path and time, for a group of hyperpaint
    content, seal = node.attrs.get(CONTENT), str(node.attrs.get(SEAL))
    has_foreign = seal.partition(" ")[0] != str(len(arrays))  # arrays that are not part of the content
    if content is None or has_foreign or not isinstance(source, str):
        return source
    from .named_stores import NamedFsspecStore, NamedLocalStore

    store: Any = (NamedFsspecStore.from_url if "://" in source else NamedLocalStore)(source, read_only=True)
    store.content = f"{source} {content} {seal}"
    return store


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
            elif entry.file_size > MAX_CHUNK_BYTES:
                raise StoreError(
                    f"{location.url}: {entry.filename:.80} has {entry.file_size} bytes",
                    expected=f"at most {MAX_CHUNK_BYTES}",
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
    problems = Problems(f"{subject} cannot be read safely", StoreError)
    chunks = index_bytes = 0
    for name, array in arrays.items():
        metadata = array.metadata
        # format 3 has a list of codecs, format 2 a compressor and filters
        codec_names = repr([getattr(metadata, key, None) for key in ("codecs", "compressor", "filters")])
        code_codec = next((word for word in CODE_CODECS if word in codec_names.lower()), "")
        dtype = np.dtype(array.dtype)
        is_text = dtype.kind in "OT"
        known = not is_text or any(word in str(type(metadata.dtype)) for word in ("VariableLength", "String"))
        # sizes; of shards, zarr reads the inner chunks one by one
        item = TEXT_BYTES if is_text else dtype.itemsize
        limit = MAX_INDEX_BYTES if is_text or "since" in str(array.attrs.get("units")) else MAX_CHUNK_BYTES
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
        (index_bytes, MAX_INDEX_BYTES, "bytes of an array with one dim"),
    ):
        problems.add_if(size > most, f"{size} {unit}", expected=f"at most {most}", code="size-too-large")
    problems.raise_if_any()
