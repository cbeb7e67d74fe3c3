"""Croissant metadata of a store, for machine-learning tools and dataset search.

Croissant 1.1 (MLCommons) is JSON-LD, http://mlcommons.org/croissant/1.1. Its files are those of the store,
its record sets the groups, each a record of arrays. Not written by ``mlcroissant``, which brings rdflib and
pandas-stubs for one JSON document; the tests read it with that package.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from hyperpaint.base.errors import IncompleteStoreError, Problems, SchemaError

if TYPE_CHECKING:
    import xarray as xr

#: Of one attribute; longer ones (tables of materials, records of a scene) are only named.
MAX_TEXT_CHARACTERS = 4096

_ALIASES = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileObject fileProperty fileSet "
    "format includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references regex "
    "repeated replace samplingRate separator source subField transform"
)
_CONTEXT: Final[dict[str, Any]] = {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/", "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"}, "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "name": {"@container": "@language"}, "description": {"@container": "@language"},
    **{name: f"cr:{name}" for name in _ALIASES.split()},
}  # fmt: skip
_ZARR = "application/vnd+zarr"
_UNKNOWN = "unknown"


def write_croissant(
    store: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    licence: str,
    overwrite: bool = False,
    **about: str | None,
) -> dict[str, Any]:
    """Write the Croissant metadata of a whole store, to a file beside it.

    Every chunk of the store is read and compared with its record first. The same store and arguments give the
    same bytes.

    Parameters
    ----------
    store
        Folder of the store, such as `hyperpaint.render_scene` writes.
    path
        The JSON file, in the folder that the store is in: addresses of files are relative to it.
    licence
        Address or SPDX name of the licence, "unknown" where nobody has said.
    overwrite
        Whether a file that is there may be replaced.
    **about
        ``name`` (that of the store), ``description``, ``creator``, ``cite_as`` (BibTeX), ``version``,
        ``published`` (YYYY-MM-DD), ``url``: what is known of the data set. Croissant wants creator,
        date and address of what is published.

    Returns
    -------
    dict
        The document.

    Raises
    ------
    IncompleteStoreError
        The store is not whole.
    SchemaError
        An argument is empty, unknown or no date.
    StoreError
        There is no such store, or the file may not be written.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> from pathlib import Path
    >>> from hyperpaint.io.store import to_store
    >>> folder = Path(tempfile.mkdtemp())
    >>> line = xr.Dataset({"wavelength": ("band", [450.0, 550.0], {"units": "nm"})})
    >>> store = to_store(line, folder / "lot.zarr", group="renders/noon")
    >>> document = write_croissant(store, folder / "croissant.json", licence="CC0-1.0", creator="A. Painter")
    >>> [field["name"] for field in document["recordSet"][0]["field"]]
    ['wavelength']
    """
    from hyperpaint.io.files.publishing import check_place, publish_file
    from hyperpaint.io.store import open_store, verify

    place, folder = Path(path), Path(store)
    _check(place, folder, {"licence": licence, **about})
    check_place(place, "the metadata", example="croissant.json", store=folder, overwrite=overwrite)
    report = verify(folder)
    if not report.ok:
        raise IncompleteStoreError(
            f"no metadata of a store that is not whole: {report}", code="store-incomplete"
        )
    groups = {group: open_store(folder, group) for group in report.groups}
    created = min(
        (str(line.attrs["created"]) for line in groups.values() if "created" in line.attrs), default=""
    )
    root = folder.absolute().name
    creator = about.get("creator")
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": about.get("name") or root.removesuffix(".zarr"),
        "description": about.get("description")
        or f"Groups of a Zarr store, of hyperpaint: {', '.join(f'/{group}' for group in groups)}.",
        "license": licence,
        "creator": {"@type": "sc:Person", "name": creator} if creator else None,
        "citeAs": about.get("cite_as"),
        "version": about.get("version"),
        "datePublished": about.get("published"),
        "dateCreated": created[:10],
        "url": about.get("url"),
        "distribution": [
            _files(root, "", f"All of the store; open a group with xarray.open_zarr({root!r}, group=...)."),
            *(_metadata(folder, root, group) for group in dict.fromkeys(["", *groups])),
            *(_files(root, group, f"Metadata and chunks of /{group}.") for group in groups if group),
        ],
        "recordSet": [_record_set(root, group, line) for group, line in groups.items()],
    }
    document = {key: value for key, value in document.items() if value}
    text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=True, allow_nan=False)
    publish_file(place, f"{text}\n".encode(), overwrite=overwrite)
    return document


def _check(place: Path, folder: Path, about: dict[str, str | None]) -> None:
    from datetime import date

    allowed = ("licence", "name", "description", "creator", "cite_as", "version", "published", "url")
    problems = Problems("Croissant metadata", SchemaError)
    for key, value in about.items():
        if key not in allowed:
            problems.add(f"{key} is none of {', '.join(allowed)}", code="key-unknown")
        elif value is not None and not (isinstance(value, str) and value.strip()):
            problems.add(
                f"{key} must be text that is not empty, found {value!r}; say {_UNKNOWN!r} of a licence",
                code="text-empty",
            )
    try:
        date.fromisoformat(about.get("published") or "2000-01-01")
    except (TypeError, ValueError):
        problems.add(
            f"published must be a date YYYY-MM-DD, found {about['published']!r}", code="date-unreadable"
        )
    if place.absolute().parent.resolve() != folder.absolute().parent.resolve():
        problems.add(
            f"{place} must be in the folder of the store, {folder.absolute().parent}",
            code="output-outside-store",
        )
    problems.raise_if_any()


def _joined(*parts: str) -> str:
    return "/".join(part for part in parts if part)


def _identity(*parts: str) -> str:
    return quote(_joined(*parts))


def _files(root: str, group: str, description: str) -> dict[str, Any]:
    within = {"containedIn": {"@id": _identity(root)}} if group else {}
    return {
        "@type": "cr:FileSet",
        "@id": _identity(root, group),
        "name": _joined(root, group),
        "description": description,
        "encodingFormat": _ZARR,
        "includes": glob.escape(_joined(root, group)) + "/**",
        **within,
    }


def _metadata(folder: Path, root: str, group: str) -> dict[str, Any]:
    content = (folder / group / "zarr.json").read_bytes()
    return {
        "@type": "cr:FileObject",
        "@id": _identity(root, group, "zarr.json"),
        "name": _joined(root, group, "zarr.json"),
        "contentUrl": _identity(root, group, "zarr.json"),
        "contentSize": f"{len(content)} B",
        "encodingFormat": "application/json",
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _record_set(root: str, group: str, line: xr.Dataset) -> dict[str, Any]:
    identity = f"records/{_identity(group)}" if group else "records"
    return {
        "@type": "cr:RecordSet",
        "@id": identity,
        "name": group or root,
        "description": f"One record: all arrays of the group /{group}.",
        "additionalProperty": [
            {"@type": "sc:PropertyValue", "name": str(key), "value": _text(value)}
            for key, value in sorted(line.attrs.items())
        ],
        "field": [
            _field(root, group, identity, str(name), line[name]) for name in sorted(line.variables, key=str)
        ],
    }


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= MAX_TEXT_CHARACTERS else f"{len(text)} characters, in the store"


def _field(root: str, group: str, record_set: str, name: str, array: xr.DataArray) -> dict[str, Any]:
    shape = ",".join(map(str, array.shape))
    dims = f" ({', '.join(map(str, array.dims))})" if array.ndim else ""
    units = array.attrs.get("units")
    return {
        "@type": "cr:Field",
        "@id": f"{record_set}/{quote(name)}",
        "name": name,
        "description": f"{array.attrs.get('long_name', name)}{dims}",
        "dataType": _data_type(array.dtype),
        "isArray": bool(array.ndim),
        **({"arrayShape": shape} if array.ndim else {}),
        **({"unitText": str(units)} if units else {}),
        "source": {"fileSet": {"@id": _identity(root, group)}, "extract": {"fileProperty": "content"}},
    }


def _data_type(dtype: Any) -> str:
    if dtype.kind in "fiu":
        kind = {"f": "Float", "i": "Int", "u": "UInt"}[dtype.kind]
        return f"cr:{kind}{8 * dtype.itemsize}"
    return {"b": "sc:Boolean", "M": "sc:DateTime", "m": "sc:Duration"}.get(dtype.kind, "sc:Text")
