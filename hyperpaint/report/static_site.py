"""A folder for any web server whose page reads a Zarr store in the browser.

The folder holds a copy of the data in small chunks (layout ``"web"``), a store that `hyperpaint.open_store`
opens; or the page reads a store at another address.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import numpy as np
import xarray as xr

from hyperpaint.base.constants import KEPT_BITS
from hyperpaint.base.errors import FormatError, SchemaError, StoreError, warn_user
from hyperpaint.base.facts import documented
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.old_names import renamed
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, SIGNATURE, Quality, numbers_of, rename_to_roles
from hyperpaint.io.files.publishing import published_folder
from hyperpaint.io.store import to_store
from hyperpaint.light.daylight_colours import srgb_hex
from hyperpaint.paints.colours import paint_colours
from hyperpaint.pictures.figures import encode_png, flown_right, orientation_of
from hyperpaint.pictures.plot import flag_label, rgb
from hyperpaint.pictures.plot_spectra import find_usable
from hyperpaint.radiometry.counts_to_reflectance import reflectance

from .store_report import HIDDEN_VARIABLES, Written, flagged, groups_to_show, message_of, regions_of

_Picture: TypeAlias = "np.ndarray[Any, np.dtype[np.uint8]]"

FORMAT = "hyperpaint site 1"
_INDEX = "site.json"
_WEB = resources.files("hyperpaint") / "report" / "web"
_MAX_INDEX_BYTES = 16 * 2**20
_ORIGIN = re.compile(r"[A-Za-z0-9.-]+(:\d{1,5})?")

# variables of a line or map that the page reads
_SHOWN_VARIABLES = (
    "reflectance",
    "quality",
    "wavelength",
    "wavelength_shift",
    "look_across",
    "fwhm",
    "good",
    "spatial_ref",
    "time",
)


@renamed(signatures="library", lines="max_lines")
@documented(library="library page", overwrite="own overwrite", progress="progress bar")
def write_site(
    store: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    flightlines: Sequence[str] | None = None,
    library: str | os.PathLike[str] | None = None,
    link: str | None = None,
    max_lines: int = 4000,
    flags: bool = True,
    overwrite: bool = False,
    progress: bool = False,
) -> Written:
    """Write a page that shows a store in a browser, without a program on the server.

    The page shows flight lines and maps in true colour with their flags; a click reads the spectrum of a
    pixel from the Zarr store, some 100 kB, bit for bit as `hyperpaint.open_store` reads it; paints are drawn
    beside it. The address holds the view, and can be shared.

    Parameters
    ----------
    store
    out
        A folder, new or empty, or an earlier site. It holds the page, pictures and ``store.zarr``: the
        reflectance of the store, or else computed from its counts and rounded as by `hyperpaint.process`;
        flags, wavelengths and paints.
    flightlines
    library
    link
        Copy nothing: the page reads the store at this address, absolute or relative to the page. A click then
        reads whole chunks of that store, 8 to 20 MB in the layouts of `hyperpaint.process`; another origin
        must allow it (CORS).
    max_lines
        Maximum picture height [lines]; longer flight lines are subsampled, but all lines can be clicked.
    flags
        Detect glint, shadow and light of neighbours on lines without these flags, see
        `hyperpaint.surroundings.flag`, for the copy. A warning names lines where detection fails.
    overwrite
    progress

    Returns
    -------
    Written
        The folder, the flight lines and maps on the page, and unreadable parts.

    Raises
    ------
    SchemaError
        The store has no flight line of a name, ``max_lines`` is not positive, ``link`` is not an address, or
        ``link`` and ``library`` are both present.
    StoreError
        The store is missing or has nothing to show; or ``out`` holds other files, which are kept.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.io.store import to_store
    >>> from hyperpaint.simulation import simulate_line
    >>> folder = Path(tempfile.mkdtemp())
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> store = to_store(line, folder / "lot.zarr", "flightlines/raw_0")
    >>> write_site(store, folder / "page", flags=False).flightlines
    ('flightlines/raw_0',)
    """
    SchemaError.raise_if(
        max_lines < 1, f"max_lines={max_lines}", expected="1 or more", code="value-out-of-range"
    )
    SchemaError.raise_if(
        link is not None and library is not None,
        "link and library: a page that copies nothing shows only the store's signatures",
        mend="leave out link or library",
        code="option-conflict",
    )
    origin = "" if link is None else _remote_origin(link)
    folder = Path(out)
    StoreError.raise_if(
        Path(store).resolve() in (folder.resolve(), *folder.resolve().parents),
        f"{out} is in the store itself",
        mend="choose another path",
        code="path-in-store",
    )
    groups = groups_to_show(store, flightlines, library)
    problems, unreadable = list(groups.problems), set()
    shown: dict[str, xr.Dataset] = {}
    lines: list[dict[str, Any]] = []
    libraries: list[dict[str, Any]] = []
    pictures: dict[str, _Picture] = {}
    notes: dict[str, str] = {}
    for name, group in (groups.lines | groups.maps).items():
        path = name if name in groups.groups else "map" if link is None else ""
        try:
            if flags and link is None and name in groups.lines:
                group, note = flagged(group, None, None)
                notes[name] = "" if group is not groups.lines[name] else note
            variables = _page_variables(group, stored=link is not None)
            picture, places = _picture(variables, group, max_lines)
            file = f"pictures/{len(pictures)}.png"  # the name of a group may be no valid file name
            shown[path], pictures[file] = variables, picture
            short_name = name.rpartition("/")[2]
            label = name if any(entry["name"] == short_name for entry in lines) else short_name
            # sorted, because xarray lists coordinates in random order
            entry = {
                "name": label,
                "group": path,
                "picture": file,
                "variables": sorted(map(str, variables.variables)),
            }
            lines.append(entry | places)
        except Exception as error:  # list an unreadable group and show all other groups
            problems.append(f"/{name}: {message_of(error)}")
            unreadable.add(name)
    for name, paints in groups.libraries.items():
        path = name if name in groups.groups else "library"
        usable, faults = find_usable(paints)
        problems.extend(f"/{name}: {text}" for text in faults)
        shown[path] = usable.drop_vars(HIDDEN_VARIABLES, errors="ignore")
        colours = [srgb_hex(colour) for colour in paint_colours(usable)]
        names = sorted(map(str, shown[path].variables))
        # polygons on the lines where the paints were measured, by paint
        outlines: dict[str, list[dict[str, Any]]] = {str(paint): [] for paint in usable[SIGNATURE].values}
        for flightline, paint, region in regions_of(usable):
            outline = {"polygon": region.polygon.tolist()}
            outlines[paint] += [
                {"line": entry["name"], **outline} for entry in lines if flightline in ("", entry["name"])
            ]
        drawn = {"colours": colours, "outlines": list(outlines.values())}
        libraries.append({"name": name, "group": path, "variables": names, **drawn})
    for name, note in notes.items():
        if note:
            warn_user(f"/{name}: {note}", "group-not-shown")
    StoreError.raise_if(
        not shown,
        f"{store} has no readable flight line, map or paint library: {'; '.join(problems)}",
        code="store-empty",
    )
    with published_folder(folder, overwrite=overwrite, foreign=_foreign) as build:
        if link is None:
            to_store(xr.DataTree.from_dict(shown), build / "store.zarr", layout="web", progress=progress)
        collects = [str(group.attrs["collect"]) for group in shown.values() if "collect" in group.attrs]
        index = {
            "format": FORMAT,
            "title": collects[0] if collects else folder.name,
            "store": link or "store.zarr",
            "lines": lines,
            "libraries": libraries,
            "flags": [
                {"mask": int(flag), "name": flag_label(flag), "colour": flag.colour} for flag in Quality
            ],
        }
        (build / "pictures").mkdir()
        for file, picture in pictures.items():
            (build / file).write_bytes(encode_png(picture))
        for source in _WEB.iterdir():
            text = source.read_text(encoding="utf-8").replace("%ORIGIN%", origin)
            (build / source.name).write_text(text, encoding="utf-8", newline="\n")
        (build / _INDEX).write_text(json.dumps(index, allow_nan=False), encoding="utf-8")
    lines_and_maps = [
        tuple(name for name in names if name not in unreadable) for names in (groups.lines, groups.maps)
    ]
    return Written(folder, lines_and_maps[0], lines_and_maps[1], tuple(problems))


def _page_variables(group: xr.Dataset, *, stored: bool) -> xr.Dataset:
    # with ``stored``, reflectance is not computed from counts
    if "reflectance" not in group.variables:
        StoreError.raise_if(
            stored,
            "the line holds no reflectance for the page to read",
            mend="leave out link",
            option="leave out --link",
            code="variable-missing",
        )
        group = reflectance(group, keep_bits=KEPT_BITS)
    dims = group["reflectance"].dims
    SchemaError.raise_if(
        "wavelength" not in group.variables or len(dims) != 3,
        f"reflectance {dims}",
        expected="lines, columns and bands, with wavelengths",
        code="dim-missing",
    )
    names = [name for name in group.variables if name in _SHOWN_VARIABLES or name in dims]
    return group.reset_coords()[names].set_coords([n for n in names if n not in ("reflectance", "quality")])


def _picture(group: xr.Dataset, source: xr.Dataset, lines: int) -> tuple[_Picture, dict[str, Any]]:
    # the picture as the page shows it, and its geometry: rows and columns of the group, steps, mirroring
    dataset = rename_to_roles(group)
    rows, columns = (dataset.sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK))
    is_line = CROSS_TRACK in group.dims
    geometry: dict[str, Any] = {"rows": rows, "columns": columns, "lies": is_line, "mirrored": False}
    geometry["first"] = [
        int(numbers_of(dataset, dim)[0]) if is_line else 0 for dim in (ALONG_TRACK, CROSS_TRACK)
    ]
    try:
        colours = np.asarray(rgb(dataset, lines=lines))
    except SchemaError:  # fewer than three visible bands: a grey picture to click on
        colours = np.full((min(rows, lines), columns, 3), 0.5, np.float32)
    geometry["steps"] = [-(-rows // colours.shape[0]), -(-columns // colours.shape[1])]
    picture = (np.nan_to_num(colours).clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    if is_line:
        orientation = orientation_of(source)
        geometry["mirrored"] = orientation.is_mirrored
        picture = flown_right(picture, orientation)
    return np.ascontiguousarray(picture), geometry


def _remote_origin(link: str) -> str:
    # the web origin that the page reads from; empty for a path relative to the page
    address = urlsplit(link)
    if not address.scheme and not address.netloc and address.path:
        return ""
    SchemaError.raise_if(
        address.scheme not in ("http", "https") or not _ORIGIN.fullmatch(address.netloc),
        f"link={link!r:.200}",
        expected="an address such as https://bucket.example.org/lot.zarr, or a path such as ../lot.zarr",
        code="link-invalid",
    )
    return f"{address.scheme}://{address.netloc}"


def _foreign(folder: Path) -> str:
    try:
        index = json.loads(read_limited(folder / _INDEX, _MAX_INDEX_BYTES, "a site"))
    except (FormatError, OSError, ValueError, RecursionError):
        index = None
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        return "other files"
    site_names = {_INDEX, "pictures", "store.zarr", *(file.name for file in _WEB.iterdir())}
    foreign = sorted(path.name for path in folder.iterdir() if path.name not in site_names)
    return f"{foreign[0]}, which is not part of a site" if foreign else ""
