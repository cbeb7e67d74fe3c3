"""Lazy opening of ENVI cubes: raw counts, radiance or reflectance of any length.

The file is read in slabs when values are needed. Sensor geometry becomes
``(along_track, band, cross_track)`` for any interleave, map geometry ``(y, x, band)``.

A data file may be a link to another folder, as raw cubes on a large disk often are: the user placed it beside
the header. Paths written inside a header are never followed.

A memory map passed to dask is copied into memory, and pickled with the graph. `EnviArray` takes a few hundred
bytes instead: the path and the layout. Each read opens the file, so that threads and processes share nothing.

`slab_lines` and `slab_offsets` give slabs of whole lines as byte ranges of the data file, to refer to cubes
without copying them; `EnviParser` is a parser of VirtualiZarr.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from hyperpaint.base import schema, units
from hyperpaint.base.arrays import Array, Ints
from hyperpaint.base.errors import FormatError, Problem, Problems, needs_extra, warn_user
from hyperpaint.base.facts import one_of
from hyperpaint.base.input_files import input_path, is_plain_file
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK
from hyperpaint.io.files.reading import decoded_text, refuse

from .envi_header import FILE_AXES, EnviHeader, parse_header, read_header

if TYPE_CHECKING:
    from virtualizarr.manifests import ManifestStore

_DATA_SUFFIXES = (".img", ".dat", ".raw", ".bil", ".bip", ".bsq", ".bin", ".sli")
_LEVEL = re.compile(r"(?:^|,)\s*(radiance|reflectance|counts)\s*(?=$|[\],\[])", re.IGNORECASE)
# Headwall's recorder writes its name; its software adds the processing level
_RAW = re.compile(r"\[headwall\b|\braw\b|\bdigital (?:numbers?|counts?)\b|\bcounts\b|\bdn\b", re.IGNORECASE)
_COUNT_UNITS = ("count", "counts", "dn", "digital number", "digital numbers", "digital counts", "adu")
_QUANTITIES = ("counts", "radiance", "reflectance", "values")


# --- samples of a data file ------------------------------------------------------------------------------


# gaps up to this size are read and dropped, which is faster than another system call [byte]
_MAX_GAP_BYTES = 32 * 2**10
# largest piece read at once if not all of it is kept [byte]
_MAX_BOX_BYTES = 8 * 2**20


@dataclass(frozen=True, eq=False)
class Scaling:
    # From stored samples to values: ``(stored * gain + offset) / divisor``, `ignore` becomes NaN
    dtype: np.dtype[Any]  # Type of the values, floating or complex
    ignore: int | float | None = None  # Compared with stored samples, before scaling
    divisor: float | None = None  # The reflectance scale factor
    # gain, offset: One value per band
    gain: npt.NDArray[np.float64] | None = None
    offset: npt.NDArray[np.float64] | None = None

    def apply(self, stored: Array, per_band: Callable[[Array], Array]) -> Array:
        # Return values of `stored`; `per_band` selects and reshapes a band vector to match it
        # float32 holds 16 bits exactly; wider integers pass through float64
        values = stored.astype(np.result_type(stored.dtype, np.float32))
        if self.gain is not None:
            values *= per_band(self.gain)
        if self.offset is not None:
            values += per_band(self.offset)
        if self.divisor is not None:
            values /= self.divisor
        if self.ignore is not None:
            values[stored == self.ignore] = np.nan
        return values.astype(self.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class EnviArray(BackendArray):
    # Samples of an ENVI data file, in any order of dims, in native byte order
    path: str  # Absolute path of the data file
    # file_size, modified_ns: Of the file when it was opened; a read refuses a file that has changed since.
    # dask names an array by its fields: a changed file gets another name.
    file_size: int
    modified_ns: int
    offset: int  # Bytes before the first sample
    stored: np.dtype[Any]  # Type of a stored sample, byte order included
    file_shape: tuple[int, int, int]  # Slowest axis of the file first
    axes: tuple[int, int, int]  # Axis of the file of each dim
    band_axis: int  # The dim that counts bands
    scaling: Scaling | None = None  # None for stored samples

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.file_shape[axis] for axis in self.axes)

    @property
    def dtype(self) -> np.dtype[Any]:
        # Type of the values, in native byte order
        return self.stored.newbyteorder("=") if self.scaling is None else self.scaling.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._outer
        )

    def _outer(self, key: tuple[Any, ...]) -> Array:
        # Return the samples at the crossings of an index, slice or sorted index array per dim.
        positions = [_positions(index, size) for index, size in zip(key, self.shape, strict=True)]
        values = self._read(positions)
        if self.scaling is not None:
            vector_shape = tuple(-1 if axis == self.band_axis else 1 for axis in range(3))
            bands = positions[self.band_axis]
            values = self.scaling.apply(values, lambda vector: vector[bands].reshape(vector_shape))
        shape = [
            size
            for size, index in zip(values.shape, key, strict=True)
            if not isinstance(index, int | np.integer)
        ]
        return values.reshape(shape)

    def _read(self, positions: list[Ints]) -> Array:
        samples = np.empty(tuple(len(index) for index in positions), self.stored.newbyteorder("="))
        if samples.size == 0:
            return samples
        # a view of the same memory, axes in the order of the file
        in_file_order = samples.transpose(np.argsort(self.axes))
        indices = [positions[axis] for axis in np.argsort(self.axes)]
        with open(self.path, "rb", buffering=0) as file:
            self._refuse_changed(file)
            # complete successive planes of the file are read in one piece
            planes, rows, columns = indices
            _, height, width = self.file_shape
            if (
                self.axes == (0, 1, 2)
                and (np.diff(planes) == 1).all()
                and np.array_equal(rows, np.arange(height))
                and np.array_equal(columns, np.arange(width))
            ):
                self._fill(file, int(planes[0]) * height * width, samples.reshape(-1))
                if not self.stored.isnative:
                    samples.byteswap(inplace=True)
            else:
                self._gather(file, indices, in_file_order)
        return samples

    def _refuse_changed(self, file: io.FileIO) -> None:
        # Raise FormatError if the file has changed since it was opened: its layout may differ.
        status = os.fstat(file.fileno())
        if (status.st_size, status.st_mtime_ns) != (self.file_size, self.modified_ns):
            raise FormatError(
                f"ENVI data file {self.path!r} has changed since it was opened: found {status.st_size} bytes "
                f"of {np.datetime64(status.st_mtime_ns, 'ns')} UTC",
                expected=f"{self.file_size} bytes of {np.datetime64(self.modified_ns, 'ns')} UTC",
                mend="open it again",
                code="file-changed",
            )

    def _gather(self, file: io.FileIO, indices: list[Ints], out: Array) -> None:
        # Read blocks of file lines around the requested samples, and keep these samples.
        planes, rows, samples = indices
        columns = self.file_shape[2]
        # lines of the file, counted through all planes
        lines = (planes[:, np.newaxis] * self.file_shape[1] + rows).ravel()
        first, last = int(samples[0]), int(samples[-1])
        gaps = np.diff(lines) * columns - (last - first + 1)
        lines_per_box = max(1, _MAX_BOX_BYTES // (columns * self.stored.itemsize))
        is_break = (gaps * self.stored.itemsize > _MAX_GAP_BYTES) | (
            np.diff((lines - lines[0]) // lines_per_box) != 0
        )
        is_break |= np.diff(lines) < 0  # a plane that is repeated
        edges = [0, *(np.flatnonzero(is_break) + 1).tolist(), len(lines)]
        plane_and_row = np.unravel_index(np.arange(len(lines)), out.shape[:2])
        columns_kept = _selector(samples)
        for start, stop in itertools.pairwise(edges):
            first_line = int(lines[start])
            buffer = np.empty((int(lines[stop - 1]) - first_line + 1, columns), self.stored)
            buffer_part = buffer.reshape(-1)[first : (len(buffer) - 1) * columns + last + 1]
            self._fill(file, first_line * columns + first, buffer_part)
            rows = buffer if stop - start == 1 else buffer[_selector(lines[start:stop] - first_line)]
            out[plane_and_row[0][start:stop], plane_and_row[1][start:stop]] = rows[:, columns_kept]

    def _fill(self, file: io.FileIO, first: int, out: Array) -> None:
        # Read samples from number `first` on into contiguous memory, without conversion.
        view = out.view(np.uint8).data
        file.seek(self.offset + first * self.stored.itemsize)
        done = 0
        while done < len(view):
            count = file.readinto(view[done:])
            if not count:
                raise FormatError(
                    f"ENVI data file {self.path!r} ends {len(view) - done} bytes early",
                    expected=f"{self.file_size} bytes, as when it was opened",
                    mend="open it again",
                    code="file-truncated",
                )
            done += count


def _positions(index: Any, size: int) -> Ints:
    if isinstance(index, slice):
        return np.arange(*index.indices(size), dtype=np.int64)
    return np.atleast_1d(np.asarray(index, dtype=np.int64))


def _selector(positions: Ints) -> slice | Ints:
    # Return a slice for evenly spaced positions, which avoids a copy.
    steps = np.diff(positions)
    if len(steps) == 0:
        return slice(int(positions[0]), int(positions[0]) + 1)
    if steps[0] > 0 and (steps == steps[0]).all():
        return slice(int(positions[0]), int(positions[-1]) + 1, int(steps[0]))
    return positions


# --- cubes -------------------------------------------------------------------------------------------------


def find_pair(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    # Return the header and the data file that belong together.
    # ``path``: header or data file. A header ``raw_0.hdr`` belongs to ``raw_0``, or to that name with one of
    # the suffixes .img .dat .raw .bil .bip .bsq .bin .sli; a data file belongs to its name and ``.hdr``, with
    # its suffix or without.
    # Returns header, data: paths in the spelling of the caller.
    # Raises `FormatError`: The other file is missing or ambiguous. Raises `FileNotFoundError`: There is no
    # such file.
    path = input_path(path, "an ENVI header, or the data file beside it")
    if not path.is_file():
        raise FileNotFoundError(f"no such file: {str(path)!r}")

    def existing(suffixes: Iterable[str], *stems: Path) -> list[Path]:
        # the files among the names; two spellings of one file count once
        files: list[Path] = []
        for name in (Path(f"{stem}{suffix}") for stem in stems for suffix in suffixes):
            if is_plain_file(name) and not any(name.samefile(other) for other in files):
                files.append(name)
        return files

    bare_path = path.with_suffix("")
    if path.suffix.lower() != ".hdr":
        headers = existing((".hdr", ".HDR"), path, bare_path)
        if not headers:
            raise FormatError(
                f"ENVI data file {str(path)!r} has no header beside it",
                expected=f"{path.name + '.hdr'!r} or {path.stem + '.hdr'!r}",
                code="header-missing",
            )
        return headers[0], path
    suffixes = [suffix for lower in _DATA_SUFFIXES for suffix in (lower, lower.upper())]
    candidates = existing([""], bare_path) or existing(suffixes, bare_path)
    if not candidates:
        raise FormatError(
            f"ENVI header {str(path)!r} has no data file beside it",
            expected=f"{bare_path.name!r}, with no suffix or with one of {' '.join(_DATA_SUFFIXES)}",
            code="data-file-missing",
        )
    if len(candidates) > 1:
        names = ", ".join(repr(candidate.name) for candidate in candidates)
        raise FormatError(
            f"ENVI header {str(path)!r} could belong to {names}",
            mend="open the data file you mean",
            code="data-file-ambiguous",
        )
    return path, candidates[0]


def open_envi(
    path: str | os.PathLike[str],
    *,
    keep_whole_lines: bool = False,
    quantity: str | None = None,
    unsaid: str = "values",
) -> xr.Dataset:
    """Open an ENVI cube lazily.

    Parameters
    ----------
    path
        The header or the data file.
    keep_whole_lines
        Use the number of lines from the size of the data file instead of the header, for recordings that
        were cut short (power loss, or a header written before the last line). An incomplete line at the end
        of a short file is dropped; a file longer than declared must hold complete lines, since a remainder
        means that the header describes another cube. Not possible for ``bsq``: a short file lacks bands.
    quantity
        ``counts``, ``radiance``, ``reflectance`` or ``values``: quantity of the samples, where the header
        does not state it. A header that contradicts it is refused.
    unsaid
        Quantity of integers, used where neither the header nor ``quantity`` states one; for readers of darks.

    Returns
    -------
    xarray.Dataset
        One variable: ``counts`` (integers), ``radiance`` or ``reflectance``, where the header or ``quantity``
        says so, else ``values``; dims (along_track, band, cross_track), or (y, x, band) with map info.
        Radiance and reflectance are float32, with reflectance scale factor or band gains and offsets applied,
        and NaN where the stored sample equals the ignore value. Integers without a scale keep their type, and
        the attribute ``data_ignore_value``. Coordinates ``wavelength`` [nm], ``fwhm`` [nm] and ``good`` on
        ``band``, without an index; ``y`` and ``x`` [map units] at pixel centres where the grid is not rotated
        (a rotated one has the attribute ``map_info`` alone). Attributes ``envi_header`` and ``envi_comments``
        hold the whole header, as JSON text.

    Raises
    ------
    FormatError
        The header is damaged, contradicts itself or ``quantity``, or does not fit the size of the data file.
    FileNotFoundError
        There is no such file.

    Warns
    -----
    PaintWarning
        An assumption may make values or wavelengths wrong, or lines were kept or dropped.

    Notes
    -----
    A level in the description (``,RADIANCE``, ``,REFLECTANCE``: the last one counts) takes precedence over
    Headwall's ``;Units`` comment, which sets the units of radiance and is known to stay behind in reflectance
    products. Integers called reflectance without a scale are ``values``. Integers are ``counts`` by the word
    raw, counts or DN in the description, by units of counts, or by a description of Headwall's recorder
    without a level; scaled products of other software without such a word are ``values``.

    Examples
    --------
    >>> import tempfile
    >>> scratch = tempfile.TemporaryDirectory()
    >>> folder = Path(scratch.name)
    >>> np.arange(24, dtype="u2").tofile(folder / "raw_0")
    >>> _ = (folder / "raw_0.hdr").write_text('''ENVI
    ... samples = 4
    ... description = {raw}
    ... lines = 3
    ... bands = 2
    ... data type = 12
    ... interleave = bil
    ... byte order = 0
    ... wavelength units = nm
    ... wavelength = {450, 550}''')
    >>> line = open_envi(folder / "raw_0.hdr")
    >>> dict(line.sizes)
    {'along_track': 3, 'band': 2, 'cross_track': 4}
    >>> line.counts.isel(along_track=1, cross_track=0).values
    array([ 8, 12], dtype=uint16)
    >>> scratch.cleanup()
    """
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    problems = Problems(f"ENVI header {str(header_path)!r} cannot be used", FormatError)
    has_scale = header.reflectance_scale_factor not in (None, 1.0)
    checks = (
        (
            header.is_spectral_library,
            Problem(
                f"file type is {header.fields.get('file type')!r}: a spectral library",
                expected="a cube",
                code="file-type-wrong",
            ),
        ),
        (
            has_scale and _has_gain(header),
            Problem(
                "both 'reflectance scale factor' and band gains or offsets are given",
                mend="delete those that do not belong to the stored samples",
                code="scale-conflict",
            ),
        ),
        (
            has_scale and _level(header) == "radiance",
            Problem(
                "the description says RADIANCE but a 'reflectance scale factor' is given",
                mend="delete one",
                code="scale-conflict",
            ),
        ),
    )
    problems.extend(problem for is_wrong, problem in checks if is_wrong)
    problems.raise_if_any()
    status = os.stat(data_path)
    lines = _lines_in_file(header, data_path, status.st_size, keep_whole_lines)
    # doubts that may make values wrong
    doubts = list(header.warnings)
    if _is_unscaled(header):
        doubts.append(
            "the description says REFLECTANCE but integers are stored and no scale is given: opened as "
            "'values'; add for example 'reflectance scale factor = 10000' to the header"
        )
    if lines != header.lines:
        doubts.append(f"{lines} whole lines are kept where the header says {header.lines}")
    if doubts:
        warn_user(f"{data_path.name}: {'; '.join(doubts)}", "header-doubtful")
    # axes of the file, and of the array
    name, attrs = _quantity(header, quantity, unsaid, data_path)
    sizes = {"l": lines, "b": header.bands, "s": header.samples}
    file_axes = FILE_AXES[header.interleave]
    order = "lbs" if header.map_info is None else "lsb"
    dims = schema.CUBE if header.map_info is None else ("y", "x", "band")
    array = EnviArray(
        path=os.path.abspath(data_path),
        file_size=status.st_size,
        modified_ns=status.st_mtime_ns,
        offset=header.header_offset,
        stored=header.dtype,
        file_shape=(sizes[file_axes[0]], sizes[file_axes[1]], sizes[file_axes[2]]),
        axes=(file_axes.index(order[0]), file_axes.index(order[1]), file_axes.index(order[2])),
        band_axis=order.index("b"),
        scaling=_scaling(header, name),
    )
    if array.scaling is None and header.data_ignore_value is not None:
        attrs["data_ignore_value"] = header.data_ignore_value
    chunks = dict(zip(dims, array.shape, strict=True))
    chunks[dims[0]] = min(schema.CHUNK_LINES, lines)
    variable = xr.Variable(
        dims, indexing.LazilyIndexedArray(array), attrs, encoding={"preferred_chunks": chunks}
    )
    # fastpath: otherwise xarray imports dask to check the type of the values, which takes longer than the
    # rest
    coords: dict[str, Any] = {
        name: xr.Variable("band", values, schema.VARIABLES[name].attrs, fastpath=True)
        for name, values in (
            ("wavelength", header.wavelength),
            ("fwhm", header.fwhm),
            ("good", header.good),
        )
        if values is not None
    }
    if header.map_info is not None and header.map_info.rotation == 0:
        # pixel centres of an unrotated grid; the reference pixel (1, 1) is an outer corner
        info = header.map_info
        column, row = info.reference_pixel
        x = info.reference[0] + (np.arange(header.samples) + 1.5 - column) * info.pixel_size[0]
        y = info.reference[1] - (np.arange(lines) + 1.5 - row) * info.pixel_size[1]
        if info.projection.lower().startswith("geographic"):
            x_attrs = {"standard_name": "longitude", "units": "degrees_east"}
            y_attrs = {"standard_name": "latitude", "units": "degrees_north"}
        else:
            unit = {"meters": "m", "metres": "m", "feet": "ft", "degrees": "degree"}.get(info.units.lower())
            x_attrs, y_attrs = (
                {"standard_name": f"projection_{axis}_coordinate", **({"units": unit} if unit else {})}
                for axis in "xy"
            )
        coords |= {"y": ("y", y, y_attrs), "x": ("x", x, x_attrs)}
    map_keys = ("map info", "coordinate system string") if header.map_info is not None else ()
    line_attrs: dict[str, Any] = {
        "source": data_path.name,
        "envi_header": json.dumps(header.fields),
        "envi_comments": json.dumps(header.comments) if header.comments else "",
        "envi_notes": "; ".join(header.notes),
        "lines_declared": header.lines if lines != header.lines else "",
        **{key.replace(" ", "_"): header.fields.get(key, "") for key in map_keys},
    }
    line_attrs = {key: value for key, value in line_attrs.items() if value != ""}
    return xr.Dataset({name: variable}, coords=coords, attrs=line_attrs)


def _has_gain(header: EnviHeader) -> bool:
    gain, offset = header.data_gain_values, header.data_offset_values
    return bool((gain is not None and (gain != 1).any()) or (offset is not None and (offset != 0).any()))


def _lines_in_file(header: EnviHeader, path: Path, size: int, keep_whole_lines: bool) -> int:
    # Return the number of lines; FormatError if the size of the file contradicts the header.
    expected = header.header_offset + header.lines * header.line_bytes
    if size == expected:
        return header.lines
    n_complete, remainder = divmod(max(0, size - header.header_offset), header.line_bytes)
    has_line_order = header.interleave != "bsq"
    can_keep = has_line_order and n_complete >= 1 and (size < expected or remainder == 0)
    if keep_whole_lines and can_keep:
        return n_complete
    relation = "shorter" if size < expected else "longer"
    found = (
        f"found {size} bytes, expected {expected} ({header.header_offset} + {header.lines} lines x "
        f"{header.bands} bands x {header.samples} samples x {header.dtype.itemsize} bytes): the file is "
        f"{abs(expected - size)} bytes {relation} than its header says"
    )
    if has_line_order:
        found += f"\nit holds {n_complete} whole lines and {remainder} bytes more"
    mend = (
        f"keep_whole_lines=True (keep_whole_lines = true in collect.toml) opens those {n_complete} lines"
        if can_keep
        else "check samples, bands, lines and data type, or copy the file again"
    )
    raise FormatError(
        f"ENVI data file {str(path)!r} does not fit its header",
        problems=[Problem(found, mend=mend, code="file-size")],
    )


def _level(header: EnviHeader) -> str | None:
    levels = _LEVEL.findall(header.description[:10_000])
    return str(levels[-1]).lower() if levels else None


def _is_unscaled(header: EnviHeader) -> bool:
    # Return whether the header declares integers as reflectance without a scale.
    has_no_scale = header.reflectance_scale_factor in (None, 1.0) and not _has_gain(header)
    return _level(header) == "reflectance" and header.dtype.kind in "iu" and has_no_scale


_CUBE_TYPES = ("", "envi", "envi standard")


def _quantity(
    header: EnviHeader, quantity: str | None, unsaid: str, path: Path
) -> tuple[str, dict[str, Any]]:
    # Return the quantity of the samples, and its attributes; refuse a contradicting ``quantity``.
    declared, radiance_units = _declared_quantity(header)
    is_integer, has_gain = header.dtype.kind in "iu", _has_gain(header)
    if quantity is not None:
        one_of(quantity, _QUANTITIES, "quantity", error=FormatError)
    but = f"quantity={quantity!r}, but"
    refuse(
        path.name,
        (
            quantity is not None and declared not in (None, quantity),
            Problem(
                f"{but} its header says {declared}",
                mend="correct the header, or leave quantity= out",
                code="quantity-conflict",
            ),
        ),
        (
            quantity == "counts" and (not is_integer or has_gain),
            Problem(
                f"{but} samples are {header.dtype.name}{', with gains' if has_gain else ''}, no counts",
                code="quantity-conflict",
            ),
        ),
        (
            quantity == "reflectance" and is_integer and not (declared or has_gain),
            Problem(
                f"{but} integers are stored without a scale",
                mend="add for example 'reflectance scale factor = 10000' to its header",
                code="quantity-conflict",
            ),
        ),
    )
    if quantity is None and is_integer and not has_gain and header.file_type in _CUBE_TYPES:
        quantity = unsaid
    name = declared or quantity or "values"
    attrs = {} if name == "values" else dict(schema.VARIABLES[name].attrs)
    if name == "radiance":
        del attrs["units"]
        attrs |= {"units": radiance_units} if radiance_units else {}
    return name, attrs


def _declared_quantity(header: EnviHeader) -> tuple[str | None, str | None]:
    # Return the quantity that the header declares, and its units of radiance; None if undeclared.
    if _is_unscaled(header):
        return "values", None
    # Headwall's comment on units, if it can be read as units
    comment = next((text for key, text in header.comments.items() if key.lower() == "units"), "")
    unit_text = comment.replace("^", "").strip()
    is_radiance = unit_text and units.same_dimension(unit_text, schema.VARIABLES["radiance"].units)
    radiance_units = unit_text if is_radiance else None
    level, scale, is_integer = _level(header), header.reflectance_scale_factor, header.dtype.kind in "iu"
    if level is None and scale is not None and (scale != 1.0 or not is_integer):
        level = "reflectance"
    if level is None and radiance_units is not None:
        level = "radiance"
    if level in ("reflectance", "radiance"):
        return level, radiance_units
    # raw counts, by units, description or level
    has_count_units = header.fields.get("data units", comment).strip().lower() in _COUNT_UNITS
    is_raw = has_count_units or _RAW.search(header.description[:10_000]) or level == "counts"
    is_cube = is_integer and not _has_gain(header) and header.file_type in _CUBE_TYPES
    return "counts" if is_cube and is_raw else None, None


def _scaling(header: EnviHeader, name: str) -> Scaling | None:
    has_gain, ignore = _has_gain(header), header.data_ignore_value
    divisor = None if header.reflectance_scale_factor == 1.0 else header.reflectance_scale_factor
    stored = header.dtype.newbyteorder("=")
    changes_values = has_gain or divisor is not None
    is_float32 = (changes_values or name in ("radiance", "reflectance")) and stored.kind != "c"
    dtype = np.dtype(np.float32) if is_float32 else stored
    if dtype == stored and not changes_values and (ignore is None or stored.kind in "iu"):
        return None
    return Scaling(
        dtype=dtype,
        ignore=ignore,
        divisor=divisor,
        gain=header.data_gain_values if has_gain else None,
        offset=header.data_offset_values if has_gain else None,
    )


# --- references without copying ----------------------------------------------------------------------------


# Dims in the order of the file, slowest first.
FILE_DIMS = {
    name: tuple({"l": ALONG_TRACK, "b": BAND, "s": CROSS_TRACK}[axis] for axis in axes)
    for name, axes in FILE_AXES.items()
}

# Range of the lines of a slab: with fewer lines, overhead dominates a task; more lines take much memory.
MIN_SLAB_LINES, MAX_SLAB_LINES = 8, 64


def slab_lines(ends: Sequence[int]) -> int:
    """Return the lines of a slab for successive cubes.

    ``ends``: the line after the last line of each cube. The result gives the fewest slabs that are short or
    span two cubes; among equal sizes, the one nearest to that of stored chunks.

    Examples
    --------
    >>> slab_lines([2000]), slab_lines([2000, 4000, 5100]), slab_lines([2003])
    (40, 25, 32)
    """
    return min(
        range(MIN_SLAB_LINES, MAX_SLAB_LINES + 1),
        key=lambda lines: (
            len({end // lines for end in ends if end % lines}),
            abs(math.log(lines / CHUNK_LINES)),
        ),
    )


def slab_offsets(lines: int, first: int, count: int, header_offset: int, line_bytes: int) -> Ints:
    """Return the byte offsets of ``count`` slabs of ``lines`` lines in a file, from line ``first`` on.

    Examples
    --------
    >>> slab_offsets(32, 0, 3, header_offset=512, line_bytes=10).tolist()
    [512, 832, 1152]
    """
    return header_offset + (first + lines * np.arange(count, dtype=np.int64)) * line_bytes


class EnviParser:
    """A parser of VirtualiZarr for ENVI cubes, such as those of Headwall's recorders.

    Samples are referenced in place: slabs of whole lines of a ``bil`` or ``bip`` file, parts of the
    planes of a ``bsq`` file. Sizes, type, byte order and offset come from the header beside the data file.

    Parameters
    ----------
    variable
        Name of the array.
    lines
        Lines of a chunk, a divisor of the lines of the cube, since chunk grids are regular; by default the
        divisor nearest to 32.

    Examples
    --------
    >>> parser = EnviParser("counts", lines=32)
    >>> parser.variable, parser.lines
    ('counts', 32)
    >>> from virtualizarr import open_virtual_dataset                             # doctest: +SKIP
    >>> cube = open_virtual_dataset(url, registry=registry, parser=parser)        # doctest: +SKIP
    """

    def __init__(self, variable: str = "counts", lines: int | None = None) -> None:
        self.variable = variable
        self.lines = lines

    def __call__(self, url: str, registry: Any) -> ManifestStore:
        """Return the cube as a store of references.

        ``url``: of the data file or of its header; ``registry``: an
        ``obspec_utils.registry.ObjectStoreRegistry`` with a store that reaches both.

        Raises `FormatError`: the header is damaged, or does not fit the size of the data file, or the lines
        of a chunk do not divide the lines of the cube; `MissingExtraError`: VirtualiZarr is not installed.
        """
        with needs_extra("virtualizarr", "virtual", "parsing for VirtualiZarr"):
            from virtualizarr.manifests import ChunkManifest, ManifestArray, ManifestGroup, ManifestStore
            from virtualizarr.manifests.utils import create_v3_array_metadata

        data_url = url.removesuffix(".hdr")
        store, data = registry.resolve(data_url)
        _, header_path = registry.resolve(f"{data_url}.hdr")
        header = parse_header(decoded_text(bytes(store.get(str(header_path)).buffer())), f"{data_url}.hdr")
        size = int(store.head(str(data))["size"])
        expected = header.header_offset + header.lines * header.line_bytes
        # by default the divisor nearest to the lines of stored chunks
        divisors = (n for n in range(1, MAX_SLAB_LINES + 1) if header.lines % n == 0)
        lines = self.lines or min(divisors, key=lambda n: abs(n - CHUNK_LINES))
        refuse(
            data_url,
            (
                size != expected,
                Problem(
                    f"{size} bytes",
                    expected=f"{expected} by its header",
                    mend="copy it again",
                    code="file-size",
                ),
            ),
            (
                header.lines % lines,
                Problem(
                    f"{header.lines} lines in chunks of {lines}",
                    expected="a divisor of the lines",
                    code="length-mismatch",
                ),
            ),
        )
        dims = FILE_DIMS[header.interleave]
        sizes = {ALONG_TRACK: header.lines, BAND: header.bands, CROSS_TRACK: header.samples}
        planes = header.bands if header.interleave == "bsq" else 1
        chunks = tuple({ALONG_TRACK: lines, BAND: sizes[BAND] // planes}.get(dim, sizes[dim]) for dim in dims)
        # slabs of all planes in file order; line numbers continue from plane to plane
        row = header.line_bytes // planes
        offsets = slab_offsets(lines, 0, planes * header.lines // lines, header.header_offset, row)
        grid = tuple(sizes[dim] // chunk for dim, chunk in zip(dims, chunks, strict=True))
        manifest = ChunkManifest.from_arrays(
            paths=np.full(grid, data_url, np.dtypes.StringDType()),
            offsets=offsets.astype(np.uint64).reshape(grid),
            lengths=np.full(grid, lines * row, np.uint64),
        )
        metadata = create_v3_array_metadata(
            shape=tuple(sizes[dim] for dim in dims),
            data_type=header.dtype,
            chunk_shape=chunks,
            dimension_names=dims,
        )
        spectral = {"wavelength": header.wavelength, "fwhm": header.fwhm}
        attributes = {name: values.tolist() for name, values in spectral.items() if values is not None}
        group = ManifestGroup(
            arrays={self.variable: ManifestArray(metadata, manifest)},
            attributes={**attributes, "envi_header": json.dumps(header.fields)},
        )
        return ManifestStore(group=group, registry=registry)
