"""A collect as a small store that refers to the raw cubes of the camera."""

from __future__ import annotations

import contextlib
import itertools
import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import Alignment
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, StoreError
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.io.envi.envi_cubes import FILE_DIMS, EnviArray, open_envi, slab_lines, slab_offsets
from hyperpaint.io.files.publishing import published_folder
from hyperpaint.io.store.manifest import SETTINGS
from hyperpaint.io.store.raw_references import (
    RawFile,
    VirtualCube,
    check_url,
    is_virtual,
    open_virtual,
    refuse_kerchunk,
    summary_of,
    virtual_groups,
    write_icechunk,
)
from hyperpaint.io.store.stage import Staging, staging
from hyperpaint.light.diffuse_record import split_of_lines
from hyperpaint.radiometry.panels import declared_panels

from .collect_check import refuse_findings
from .pipeline import aligned_group, corrections_of, opened_groups
from .products import Outcome, local_folder, refuse_to_write_over

if TYPE_CHECKING:
    from hyperpaint.io.collect.collect_toml import OpenedCollect

#: Maximum share of a cube that is copied [1]; beyond it, processing the collect is better.
MAX_COPIED_SHARE = 0.1

_MIN_COPIED_SLABS = 4  # number of slabs that may always be copied
_INCOMPLETE = "and incomplete"
_SAMPLE_BYTES = 16 * 1024


def virtualise(
    collect: str | Path,
    out: str | Path,
    *,
    prefix: str | None = None,
    alignment: Alignment | None = None,
    accept: Collection[str] = (),
    overwrite: bool = False,
) -> Outcome:
    """Write a store of flight lines that refers to the raw cubes and holds all variables that calibrate them.

    ``.paint.reflectance()`` of `hyperpaint.io.open_virtual` is bit for bit that of the counts stored by
    `hyperpaint.process`. The collect is opened, checked and aligned as by `process`; of cubes only the lines
    needed for this are read.

    A slab of 8 to 64 lines is a contiguous range of bytes in its file. Other slabs are copied into the store:
    incomplete last slabs of a cube, slabs that span two cubes, and slabs with lost frames.

    Parameters
    ----------
    collect
        A ``collect.toml``; see `hyperpaint.open_collect`.
    out
        A folder, for a repository of icechunk.
    prefix
        URL (s3, http, https) of a copy of the folder of ``collect``, such as ``s3://bucket/flight``: the
        store refers to this copy. Samples of the copy are compared with the local files.
    alignment, accept
        See `hyperpaint.process`.
    overwrite
        Replace a virtual store of other inputs, once the new store is complete. An incomplete store of the
        same inputs is always written again.

    Returns
    -------
    Outcome
        The store, and its groups.

    Raises
    ------
    CollectError, SchemaError
        As `hyperpaint.process`.
    FormatError
        Slabs of a cube are not contiguous (``bsq``), its samples are not uint16 counts, or too many slabs
        would be copied; all lines are listed.
    StoreError
        ``out`` exists with other inputs, contains inputs, or has the suffix of kerchunk references; or files
        below ``prefix`` differ from the local files.
    MissingExtraError
        icechunk is not installed.

    Examples
    --------
    >>> virtualise("collect.toml", "lot.icechunk").path                               # doctest: +SKIP
    """
    out = local_folder(out, "virtual")
    refuse_kerchunk(out, write=True)
    if prefix is not None:
        check_url(prefix)
    opened, tree = opened_groups(
        collect, 32, {"to": "reflectance", "reflectance": "none", "alignment": alignment}
    )
    refuse_to_write_over(out, (opened.settings, list(opened.cubes.values())), "virtual")
    lines = {name: tree[name] for name in opened.cubes}
    cubes = _cubes(opened, lines, prefix)
    if out.exists():
        # difference of the existing store from the collect, in words; empty if there is none
        difference, summary = "", summary_of({name: (line, cubes[name]) for name, line in lines.items()})
        try:
            if not is_virtual(out):
                difference = "and is not a virtual store"
            elif virtual_groups(out) != summary:
                difference = "from other inputs"
        except StoreError as error:
            difference = f"and cannot be read ({error})"
        if not difference:
            # allow access only to the files of the collect, not to places named in the store
            allow = [file.url for cube in cubes.values() for file in cube.files]
            try:
                for name in summary:
                    open_virtual(out, name, allow=allow)
            except StoreError:
                difference = _INCOMPLETE
        if not difference:
            staging_area = Staging(out.absolute())
            if staging_area.folder.exists():  # leftovers of a run killed at its end
                with contextlib.suppress(StoreError), staging(staging_area.store):
                    pass
            return Outcome(out, (), tuple(lines))
        StoreError.raise_if(
            difference != _INCOMPLETE and not (overwrite and is_virtual(out)),
            f"{out} exists, {difference}",
            mend="pass overwrite=True, which replaces a virtual store, or choose another path",
            option="pass --overwrite, which replaces a virtual store, or choose another --out",
            code="store-exists",
        )
    accepted = refuse_findings(opened, lines, accept, lit=True)
    apply = alignment or opened.settings.alignment
    groups = {}
    for name, line in lines.items():
        # all variables except the cube, in memory
        aligned = aligned_group(line, name, "reflectance", apply)
        companions = aligned.drop_vars("counts")
        if panels := declared_panels(aligned):
            product = aligned.paint.reflectance(panel=panels)
            companions = companions.assign(
                {variable: product[variable] for variable in product if str(variable).startswith("panel_")}
            )
        split = split_of_lines(aligned)
        companions = (companions if split is None else companions.assign(split.data_vars)).compute()
        companions.attrs.pop(SETTINGS, None)
        groups[name] = companions.assign_attrs(accepted.get(name, {})), cubes[name]
    attrs = {str(key): value for key, value in opened.tree.attrs.items()}
    with published_folder(
        out, overwrite=True, foreign=lambda folder: "" if is_virtual(folder) else "other files"
    ) as folder:
        write_icechunk(folder, groups, attrs)
    return Outcome(
        out, tuple(groups), (), corrections_of({name: companions for name, (companions, _) in groups.items()})
    )


def _cubes(
    opened: OpenedCollect, lines: Mapping[str, xr.Dataset], prefix: str | None
) -> dict[str, VirtualCube]:
    # references to the slabs in the raw files, by group
    entries = {str(entry.name): entry for entry in opened.settings.flightlines}
    problems = Problems(f"{opened.settings.path}: cubes cannot be referred to", FormatError)
    base = opened.settings.path.absolute().parent
    cubes = {}
    for name, line in lines.items():
        try:
            arrays = []
            for entry in map(entries.__getitem__, opened.members[name]):
                with warnings.catch_warnings():  # already given when the collect was opened
                    warnings.simplefilter("ignore", PaintWarning)
                    dataset = open_envi(entry.path, keep_whole_lines=entry.keep_whole_lines, unsaid="counts")
                lazy: Any = next(iter(dataset.data_vars.values())).variable._data
                array = lazy.array
                if not isinstance(array, EnviArray) or array.scaling is not None or array.dtype != np.uint16:
                    raise FormatError(
                        f"{Path(entry.path).name}: samples are {array.dtype.name}, or scaled",
                        expected="raw counts, uint16 (ENVI data type 12)",
                        mend="process the collect instead",
                        code="counts-not-raw",
                    )
                arrays.append(array)
            files = tuple(_raw_file(Path(array.path), base, prefix) for array in arrays)
            cubes[name] = _cube(line, arrays, files)
        except (FormatError, StoreError) as error:
            problems.add_error(f"/{name}", error)
    problems.raise_if_any()
    return cubes


def _raw_file(path: Path, base: Path, prefix: str | None) -> RawFile:
    # the local file, or its copy below the URL ``prefix``
    local = RawFile.of(f"file://{os.path.realpath(path)}")
    if prefix is None:
        return local
    StoreError.raise_if(
        not path.is_relative_to(base),
        f"{path} is outside {base}, the folder of which {prefix} is a copy",
        code="file-outside-prefix",
    )
    from fsspec.core import url_to_fs  # type: ignore[import-untyped]

    copy = RawFile.of(f"{prefix.rstrip('/')}/{path.relative_to(base).as_posix()}")
    StoreError.raise_if(
        copy.size != local.size,
        f"{copy.url}: {copy.size} bytes",
        expected=f"{local.size}, as {path}",
        mend="copy it again",
        code="copy-differs",
    )
    fs, key = url_to_fs(copy.url)
    with open(path, "rb") as file:
        for start in (0, local.size // 2, max(0, local.size - _SAMPLE_BYTES)):
            file.seek(start)
            stop = min(start + _SAMPLE_BYTES, local.size)
            StoreError.raise_if(
                fs.cat_file(key, start=start, end=stop) != file.read(stop - start),
                f"{copy.url} differs from {path} at byte {start} or after it",
                mend="copy it again",
                code="copy-differs",
            )
    return copy


def _cube(line: xr.Dataset, arrays: list[EnviArray], files: tuple[RawFile, ...]) -> VirtualCube:

    first_array = arrays[0]
    interleave = {(0, 1, 2): "bil", (0, 2, 1): "bip"}.get(first_array.axes)
    if interleave is None or len({(array.axes, array.file_shape[1:], array.stored) for array in arrays}) > 1:
        problem = (
            "bsq: a slab of lines is not contiguous in the file"
            if interleave is None
            else "cubes of several layouts"
        )
        raise FormatError(
            problem,
            expected="bil or bip, the same in all cubes",
            mend="process the collect instead",
            code="interleave-unsupported",
        )
    dims = FILE_DIMS[interleave]
    ends = list(itertools.accumulate(array.file_shape[0] for array in arrays))
    count = line.sizes[ALONG_TRACK]
    FormatError.raise_if(
        ends[-1] != count,
        f"{count} lines, and {ends[-1]} in the files: frames were lost between the cubes",
        mend="process the collect instead",
        code="frames-lost",
    )
    lines = slab_lines(ends)
    width = first_array.file_shape[1] * first_array.file_shape[2] * first_array.stored.itemsize
    lost_slabs = np.flatnonzero(np.isnat(line["time"].values)) // lines
    slabs: list[tuple[int, int, int]] = []
    for number, (start, end) in enumerate(itertools.pairwise([0, *ends])):
        first_slab, end_slab = -(-start // lines), end // lines  # slabs that are completely in this file
        offsets = slab_offsets(
            lines, first_slab * lines - start, end_slab - first_slab, arrays[number].offset, width
        )
        slabs += [
            (slab, number, offset)
            for slab, offset in zip(range(first_slab, end_slab), offsets.tolist(), strict=True)
            if slab not in lost_slabs
        ]
    total = -(-count // lines)
    copied = sorted(set(range(total)) - {slab for slab, _, _ in slabs})
    FormatError.raise_if(
        len(copied) > max(_MIN_COPIED_SLABS, MAX_COPIED_SHARE * total),
        f"{len(copied)} of {total} slabs have lost frames or span two cubes, and would be copied",
        expected=f"at most {MAX_COPIED_SHARE:.0%}",
        mend="process the collect instead",
        code="slabs-copied",
    )
    cube = line["counts"].transpose(*dims)
    copies = {slab: cube[slab * lines : (slab + 1) * lines].values for slab in copied}
    attrs = {key: value for key, value in cube.attrs.items() if isinstance(value, str | int | float | list)}
    return VirtualCube(
        "counts", dims, cube.shape, lines, first_array.stored, attrs, files, tuple(slabs), copies
    )
