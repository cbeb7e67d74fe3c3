"""The command ``hyperpaint info``: a short description of a file or a store."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

import hyperpaint as hp
import hyperpaint.workflows as workflows
from hyperpaint.base import (
    ALONG_TRACK,
    VECTOR_FILES,
    CollectError,
    FormatError,
    IncompleteStoreError,
    StoreError,
    as_path,
    byte_size,
    head_of,
    input_path,
    origin_of,
    url_of,
)
from hyperpaint.io.files.reading import foreign_format
from hyperpaint.io.store import (
    RAW_FILES,
    is_complete,
    is_virtual,
    is_zarr,
    list_groups,
    open_group,
    open_unverified,
    open_virtual,
    place_of,
    refuse_kerchunk,
    store_state,
    virtual_groups,
)
from hyperpaint.io.store.budget import counted
from hyperpaint.report.summaries import (
    Facts,
    facts_of_bands,
    facts_of_grid,
    facts_of_irradiance,
    facts_of_line,
    facts_of_map,
    form_of,
    range_of,
    size_of,
    table_of_facts,
    times_of,
    with_times,
)

from .options import EXISTING, command

if TYPE_CHECKING:
    from hyperpaint.workflows.field_folder import FieldFolder

_KNOWN_FORMATS = (
    "an ENVI header or cube, a GeoTIFF, regions in GeoJSON, an ASD file, an SVC .sig file, "
    "a text or csv export of spectra, "
    "a spectral library, a DIRSIG .ems or .mat file, a frame index, imu_gps.txt, "
    "SBET, .lcf or csv navigation, settings.txt, "
    "a collect.toml, the folder of a field day, a virtual store, or a Zarr store or a group in it"
)
_TABLES = (".txt", ".csv", ".tsv", ".asc")
MAX_NAMES = 5
_DAY_NS = 86_400 * 10**9
_HEAD_BYTES = 4096


def facts_of_path(path: str | Path, allow: Sequence[str] = ()) -> dict[str, str]:
    # Return the facts of `describe_path` by name; unknown facts are empty texts.
    if url_of(path) is not None and is_zarr(path):
        return dict(_store(as_path(path)))
    path = input_path(path, "a file, a folder or a store", content=False)
    FormatError.raise_if(
        not path.exists(), f"{origin_of(path)}: no such file or folder", code="file-not-found"
    )
    if is_virtual(path):
        return dict(facts_of_virtual(path, allow))
    refuse_kerchunk(path)
    if not path.is_dir():
        from hyperpaint.io.spectrometers.asd import sniff
        from hyperpaint.io.spectrometers.spectrum_texts import is_named_as_scans

        name, suffix, foreign = path.name.lower(), path.suffix.lower(), foreign_format(path, is_binary=True)
        reader = _svc if is_named_as_scans(path) else _BY_SUFFIX.get(suffix)
        if reader is None:
            reader = _poses if _is_pose_table(path) else _BY_CONTENT.get(sniff(path))
        if reader is None:
            headers = [
                path.with_name(stem + end) for stem in (path.name, path.stem) for end in (".hdr", ".HDR")
            ]
            rules = (
                (name.startswith("frameindex"), _frame_index),
                ("imu" in name and suffix == ".txt", _navigation),
                (name == "settings.txt", _settings),
                (any(header.is_file() for header in headers), _envi),
                (suffix in (*_TABLES, ".ems"), _spectra_if_any),
                (suffix == ".mat" and foreign is None, _materials),
            )
            reader = next((rule_reader for is_met, rule_reader in rules if is_met), None)
        if reader is None and foreign is not None:
            raise FormatError(f"{path}: {foreign.found}", mend=foreign.mend, code=foreign.code)
        reader = FormatError.raise_if_none(
            reader, f"{path}: unknown kind of file", expected=_KNOWN_FORMATS, code="format-unknown"
        )
        return dict(reader(path))
    if is_zarr(path):
        return dict(_store(path))
    if any(path.glob("*.spectrum.txt")):
        return dict(_library(path))
    with StoreError.instead_of(
        CollectError,
        f"{path} is a folder, but neither a Zarr store nor a field day ($whole)",
        expected=_KNOWN_FORMATS,
        code="format-unknown",
    ):
        return dict(facts_of_field_folder(workflows.field_folder.find_field_files(path)))


def describe_path(path: str | Path, allow: Sequence[str] = ()) -> str:
    # Describe a file, a Zarr store or a group of a store: dims, units, wavelengths, times, completeness.
    #
    # Reads headers and small files, but no samples of cubes. Of a ``collect.toml`` all files are opened, and
    # the products of `process` are described. ``allow``: folders of the raw files of a virtual store, see
    # `open_virtual`.
    #
    # Raises `FormatError` if the file is damaged, or has an unknown format; `CollectError` if the collect
    # cannot be processed, with all problems; `StoreError` if the folder is not a Zarr store, or the path is
    # that of kerchunk references.
    return table_of_facts(str(path), facts_of_path(path, allow).items())


# --- facts by kind of file ---------------------------------------------------------------------------------


def _envi(path: Path) -> Facts:

    from hyperpaint.io.envi.envi_cubes import MAX_LIBRARY_HEADER_BYTES, find_pair, open_envi, read_header
    from hyperpaint.io.flightline.side_files import exposure_seconds
    from hyperpaint.io.navigation.navigation_records import is_eph_att

    header_path, data = find_pair(path)
    header = read_header(header_path, MAX_LIBRARY_HEADER_BYTES)
    if header.is_spectral_library:
        yield from _library(header_path)
        return
    if is_eph_att(header):
        yield from _poses(path)
        return
    dataset = open_envi(path)
    name, cube = next(iter(dataset.data_vars.items()))
    form = f"{header.interleave}, {header.dtype.newbyteorder('=')}, {size_of(byte_size(data))}"
    exposure = exposure_seconds(header.comments, header_path.name)
    yield from (
        ("is", f"ENVI cube, {form}"),
        (str(name), form_of(cube)),
        *facts_of_bands(dataset),
        ("exposure", "" if exposure is None else f"{exposure * 1e3:g} ms (header comments)"),
        ("notes", "\n".join(header.notes)),
    )


def _geotiff(path: Path) -> Facts:

    from hyperpaint.io.maps.map_grids import read_geotiff_header

    header = read_geotiff_header(path)
    (rows, cols), unlocated = header.shape, [("crs", "unknown, as is its location")]
    nm = [band.removesuffix(" nm") for band in header.descriptions if band.endswith(" nm")]
    has_wavelengths = len(nm) == header.bands
    yield from (
        ("is", f"GeoTIFF, {size_of(path.stat().st_size)}"),
        ("map", f"{rows} x {cols} cells, {counted(header.bands, 'band')}, {header.dtype}"),
        *(unlocated if header.grid is None else facts_of_grid(header.grid, header.shape)),
        ("wavelength", range_of([float(text) for text in nm], "nm") if has_wavelengths else ""),
        ("bands", "" if has_wavelengths else _first_names([text for text in header.descriptions if text])),
        ("overviews", ", ".join(f"1:{factor}" for factor in header.overviews) or "none"),
    )


def _regions(path: Path) -> Facts:

    regions = hp.read_regions(path)
    bounds = ""
    if len(regions):
        corners = np.concatenate([region.polygon for region in regions])
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        bounds = f"x {x0:.10g} to {x1:.10g}, y {y0:.10g} to {y1:.10g}"
    yield from (
        ("is", f"{counted(len(regions), 'region')} in coordinates of the {regions.coordinates}"),
        ("names", _first_names(regions.names)),
        ("crs", "" if regions.coordinates == "sensor" else regions.crs or "not said"),
        ("flight lines", ", ".join(regions.flightlines)),
        ("bounds", bounds),
        ("also says", ", ".join(dict.fromkeys(name for region in regions for name in region.properties))),
    )


def _asd(path: Path) -> Facts:

    from hyperpaint.io.spectrometers.asd import read_asd

    file = read_asd(path)
    panel = "" if file.reference is None else ", white reference"
    zone = "zone unknown" if file.utc_offset_h is None else f"UTC{file.utc_offset_h:+g} h"
    optic = "cosine receptor" if file.fore_optic >= 180 else f"{file.fore_optic} degree"
    blocks = (f"{kind} ({block.name})" for kind, block in file.calibrations.items())
    yield from (
        ("is", f"ASD spectrum, binary version {file.version}, {file.instrument} {file.instrument_number}"),
        ("holds", f"{file.data_type} (stored as raw counts){panel}"),
        ("wavelength", range_of(file.wavelength, "nm")),
        ("saved", f"{file.local_time} by the logging PC ({zone})"),
        ("exposure", f"{file.integration_ms:g} ms, {file.sample_averages} averaged"),
        ("fore optic", "none" if file.fore_optic == 0 else optic),
        ("calibration", ", ".join(blocks) or "none"),
        ("position", "" if file.gps is None else f"{file.gps.latitude:.6f}, {file.gps.longitude:.6f}"),
        ("saturated", ", ".join(sorted(file.saturated))),
    )


def _svc(path: Path) -> Facts:

    from hyperpaint.io.spectrometers.spectrum_texts import error_bits, overlap_of, pair, position_of, read_svc

    file = read_svc(path)
    overlap, position = overlap_of(file.header), position_of(file.header, 1)
    reference = "white reference and target" if file.has_reference else "target without white reference"
    factors = file.header.get("factors", "").partition("[")[0].strip()
    clock = pair(file.header, "gpstime")[1]
    place = "cannot be read" if position is None else "{:.6f}, {:.6f}".format(*position)
    yield from (
        ("is", f"{file.dialect.instrument} spectrum, {file.header.get('instrument', 'instrument unknown')}"),
        ("holds", f"{reference}, in {' and '.join(dict.fromkeys(file.units))}"),
        ("wavelength", f"{range_of(file.wavelength, 'nm')}, {counted(len(file.wavelength), 'channel')}"),
        ("overlap", overlap.text),
        ("matching", f"{overlap.matching or 'unknown'} (factors {factors or 'unknown'})"),
        ("saved", f"{pair(file.header, 'time')[1]} by the local clock, as written"),
        ("GPS time", f"{clock} UTC" if clock else ""),
        ("position", place if position is None or not np.isnan(position[0]) else ""),
        ("errors", "reference {}, target {} (bits of the instrument)".format(*error_bits(file.header))),
        ("comment", file.header.get("comm", "")),
    )


def _asd_text(path: Path) -> Facts:

    from hyperpaint.io.spectrometers.asd import read_asd_text

    text = read_asd_text(path)
    local_time, integration_ms = (text.preamble.get(key) for key in ("local_time", "integration_ms"))
    likely = text.likely_quantity
    yield from (
        ("is", f"text export of {text.instrument} spectra: {len(text.spectra)} spectra"),
        ("holds", f"{likely} (a guess from the plot range)" if likely else "unknown units"),
        ("wavelength", range_of(text.wavelength, "nm")),
        ("saved", "" if local_time is None else f"{local_time} by the logging PC (zone unknown)"),
        ("exposure", "" if integration_ms is None else f"{integration_ms:g} ms"),
    )


def _spectrum_text(path: Path) -> Facts:

    from hyperpaint.io.spectrometers.spectrum_texts import read_spectrum_text

    text = read_spectrum_text(path)
    held = dict.fromkeys(f"{c.quantity or 'unknown quantity'} of the {c.scan}" for c in text.columns)
    zone = "zone unknown" if text.utc_offset_h is None else f"UTC{text.utc_offset_h:+g} h"
    yield from (
        ("is", f"{text.instrument} text"),
        ("holds", ", ".join(held)),
        ("wavelength", range_of(text.wavelength, "nm")),
        ("saved", "" if text.local_time is None else f"{text.local_time} by its clock ({zone})"),
    )


def _irradiance_csv(path: Path) -> Facts:

    from hyperpaint.io.spectrometers.irradiance import read_irradiance_csv

    series: Any = read_irradiance_csv(path)
    shape = np.shape(series.values)
    yield from (
        ("is", f"csv series of irradiance: {shape[0]} samples x {shape[-1]} wavelengths"),
        ("wavelength", range_of(series.wavelength, "nm")),
    )


def _spectra_if_any(path: Path) -> Facts:
    # the error on a damaged table says that the file may have another format
    with FormatError.instead_of(
        FormatError,
        f"{path}: unknown kind of file (as spectra: $whole)",
        expected=_KNOWN_FORMATS,
        code="format-unknown",
    ):
        yield from _library(path)


def _library(path: Path) -> Facts:

    library = hp.open_library(path)
    form = library.attrs.get("format", library.attrs.get("layout", "paint library"))
    about = (str(name) for name, array in library.coords.items() if array.dims == ("signature",))
    spectra = counted(library.sizes["signature"], "spectrum").replace("spectrums", "spectra")
    yield from (
        ("is", f"{form}: {spectra}"),
        ("paints", _first_names(library["signature"].values.tolist())),
        *((str(name), form_of(array)) for name, array in library.data_vars.items()),
        *facts_of_bands(library),
        ("also says", ", ".join(name for name in about if name != "signature")),
        ("notes", str(library.attrs.get("notes", "")).replace("; ", "\n")),
    )


def _first_names(names: Sequence[object]) -> str:
    hidden = len(names) - MAX_NAMES
    # separated by semicolons, because names may contain commas
    return "; ".join(map(str, names[:MAX_NAMES])) + (f"; and {hidden} more" if hidden > 0 else "")


def _materials(path: Path) -> Facts:
    from hyperpaint.io.dirsig import read_materials

    materials = read_materials(path)
    names = _first_names([f"{material.id} ({material.name})" for material in materials])
    yield from (("is", f"DIRSIG material list: {counted(len(materials), 'material')}"), ("materials", names))


def _frame_index(path: Path) -> Facts:

    from hyperpaint.io.flightline.side_files import read_frame_index

    frames = read_frame_index(path).frame
    missing = int(frames[-1] - frames[0] + 1 - frames.size)
    numbers = f"{frames.size}, number {frames[0]} to {frames[-1]}, {missing} missing"
    yield from (("is", "Headwall frame index"), ("frames", numbers))


def _navigation(path: Path) -> Facts:

    from hyperpaint.io.navigation.navigation_records import read_imu_gps

    record = read_imu_gps(path)
    units = {"latitude": "degree", "longitude": "degree", "altitude": "m"}
    yield from (
        ("is", f"navigation record: {record.rows.size} rows"),
        ("times", "" if record.utc is None else times_of(record.utc.astype("datetime64[ns]"))),
        *((name, range_of(record.values[name], unit, digits=6)) for name, unit in units.items()),
    )


def _is_pose_table(path: Path) -> bool:

    from hyperpaint.io.navigation.navigation_records import is_navigation_csv, is_nmea

    if path.suffix.lower() in (".sbet", ".lcf"):
        return True
    head = head_of(path, _HEAD_BYTES)
    return (
        b"\0" in head
        if path.suffix.lower() == ".out"
        else is_nmea(head) or (path.suffix.lower() in _TABLES and is_navigation_csv(head))
    )


def _poses(path: Path) -> Facts:

    from hyperpaint.io.navigation.navigation_records import navigation_format, read_record

    kind = navigation_format(path)
    if kind == "imu_gps":
        yield from _navigation(path)
        return
    # NMEA sentences without a date get the first day of the epoch
    record = read_record(path, kind, midnight=0)
    convention = record.convention
    if record.counts_from == "week":
        week = "a GPS week: pass week= or date=" if record.week is None else f"GPS week {record.week}"
        times = f"{range_of(record.stamp / 1e9, 's')} of {week}"
    else:
        clock = {"gps": " (clock of GPS)"}.get(record.time_scale, "")
        is_undated = kind == "nmea" and record.stamp[0] < _DAY_NS
        times = times_of(record.stamp.astype("datetime64[ns]")) + (
            " (of an unknown day: pass date=)" if is_undated else clock
        )
    units = {"latitude": "degree", "longitude": "degree", "altitude": "m"}
    meaning = (
        f"roll + {convention.roll_positive}, pitch + {convention.pitch_positive}, "
        f"heading {convention.heading_positive} from {convention.heading_reference} north, "
        f"height above the {convention.height_reference}"
    )
    yield from (
        ("is", f"navigation record ({record.format}): {counted(record.stamp.size, 'row')}"),
        ("times", times),
        *(
            (name, range_of(values, units.get(name, convention.angle_unit), digits=6))
            for name, values in record.values.items()
        ),
        ("means", meaning.replace("_", " ")),
        ("assumed", ", ".join(record.assumed)),
    )


def _settings(path: Path) -> Facts:

    from hyperpaint.io.flightline.side_files import exposure_seconds, read_settings

    pairs = read_settings(path)
    exposure = exposure_seconds(pairs, path.name)
    exposure_text = "" if exposure is None else f"{exposure * 1e3:g} ms"
    yield from (("is", f"Headwall settings: {len(pairs)} entries"), ("exposure", exposure_text))


# --- collects and stores -----------------------------------------------------------------------------------


def _collect(path: Path) -> Facts:

    from hyperpaint.io.collect.collect_toml import read_collect

    collect = read_collect(path, need_irradiance=False)
    has_irradiance = collect.irradiance is not None
    # without dask, because nothing is computed
    tree = hp.open_collect(path, need_irradiance=has_irradiance, chunks=None)
    lines_text = counted(len(collect.flightlines), "flight line")
    lines = {str(entry.name): tree[f"flightlines/{entry.name}"].to_dataset() for entry in collect.flightlines}
    total = sum(line["counts" if "counts" in line else "radiance"].nbytes for line in lines.values())
    yield "is", f"collect {collect.name!r}, {lines_text}; every file opens"
    yield from ((f"/flightlines/{name}", _facts_text(facts_of_line(line))) for name, line in lines.items())
    if has_irradiance:
        yield "irradiance", _facts_text(facts_of_irradiance(tree["irradiance"].to_dataset()))
    references = [f"{each.instrument}: {counted(len(each.files), 'file')}" for each in collect.references]
    if references:
        yield "references", "\n".join(references)
    product, options = (
        ("reflectance", "")
        if has_irradiance or collect.white is not None
        else ("radiance only, because there is no irradiance", " --to radiance")
    )
    products = f"{lines_text} ({size_of(total)} of cubes), quality and {product}"
    yield (
        "process",
        f"would store {products}:\nhyperpaint process {origin_of(path)} --out STORE.zarr{options}",
    )


def _store(path: Path) -> Facts:

    groups, (location, _) = list_groups(path), place_of(path)
    if groups == [""]:
        yield from (("is", "one group of Zarr arrays"), *_group(path, ""))
        return
    yield "is", f"Zarr store, {counted(len(groups), 'group')} with arrays"
    if location is not None:
        state = store_state(location, groups)
        yield from (("NOT WHOLE", "\n".join(state.problems)), ("note", "\n".join(state.notes)))
    yield from ((f"/{name}", _facts_text(_group(path, name))) for name in groups)


def _group(path: Path, name: str) -> Facts:

    # open without chunks, decoded times and indexes, for which xarray imports dask, pint and others
    options = {"chunks": None, "decode_times": False, "create_default_indexes": False}
    try:
        group = with_times(open_group(path, name, **options))
        origin = f"written {group.attrs.get('created', 'at an unknown time')}"
        by = "" if "hyperpaint_version" in group.attrs else " by another program"
        unknown = f"not in a manifest, so that completeness is unknown; {origin}{by}"
        yield "state", f"complete, {origin}" if is_complete(path, name) else unknown
    except IncompleteStoreError as error:
        group = with_times(open_unverified(path, name, **options))
        yield "state", f"NOT COMPLETE: {error}"
    if ALONG_TRACK in group.dims:
        yield from facts_of_line(group)
        named_above = ("counts", "radiance", "reflectance", "irradiance", "exposure_time")
        yield "also holds", ", ".join(sorted(str(key) for key in group.data_vars if key not in named_above))
    elif {"y", "x"} <= set(group.dims):
        yield from facts_of_map(group)
    elif "irradiance" in group:
        yield from facts_of_irradiance(group)
    else:
        has_names = "signature" in group.coords and group["signature"].ndim == 1
        yield "paints", _first_names(group["signature"].values.tolist()) if has_names else ""
        yield from ((str(name), form_of(group[name])) for name in sorted(map(str, group.data_vars)))
        yield from facts_of_bands(group)


def _facts_text(facts: Facts) -> str:
    return "\n".join(f"{name}: {text}" for name, text in facts if text)


def facts_of_field_folder(field: "FieldFolder") -> Facts:
    # Yield the facts about the folder of a field day.
    def relative(path: Path | None) -> str:
        is_inside = path is not None and path.is_relative_to(field.folder)
        return "" if path is None else str(path.relative_to(field.folder) if is_inside else path)

    yield "is", f"folder of a field day: {counted(len(field.cubes), 'raw cube')}"
    for cube in field.cubes:
        parts = {
            "frame index": cube.frame_index,
            "navigation": cube.navigation,
            "exposure": cube.exposure_s is not None,
        }
        yield relative(cube.header), ", ".join(name if part else f"no {name}" for name, part in parts.items())
    has_toml = (field.folder / "collect.toml").exists()
    references = (
        f"{instrument} in {', '.join(map(relative, paths))}" for instrument, paths in field.references.items()
    )
    yield from (
        ("dark", ", ".join(map(relative, field.darks)) or "none"),
        ("white", ", ".join(map(relative, field.whites))),
        ("calibration", relative(field.calibration)),
        ("lab sweep", relative(field.sweep)),
        ("irradiance", ", ".join(map(relative, field.irradiance)) or "none"),
        ("references", ", ".join(references)),
        ("notes", "\n".join(field.notes)),
        (
            "process",
            f"hyperpaint run {field.folder}"
            if has_toml
            else f"hyperpaint init {field.folder} writes its collect.toml",
        ),
    )


def facts_of_virtual(path: Path, allow: Sequence[str] = ()) -> Facts:
    # Yield the groups of a virtual store, and whether its raw files are unchanged.
    #
    # ``allow``: see `open_virtual`.
    groups = virtual_groups(path)
    yield "is", f"virtual store (icechunk) of {counted(len(groups), 'flight line')}, cubes in their raw files"
    for name, about in groups.items():
        yield f"/{name}", "\n".join(f"{raw.url}, {size_of(raw.size)}" for raw in about[RAW_FILES])
        try:
            line = open_virtual(path, name, allow=allow)
        except StoreError as error:
            yield f"/{name} NOT READ", error.text(on_command_line=True)
        else:
            yield f"/{name} holds", _facts_text(facts_of_line(line))


# --- kinds of files ---

#: Readers of the facts by suffix; these kinds of files have no other content.
_BY_SUFFIX = {
    ".toml": _collect,
    ".zip": _store,
    ".hdr": _envi,
    **dict.fromkeys((".tif", ".tiff"), _geotiff),
    **dict.fromkeys((".geojson", *VECTOR_FILES), _regions),
}
#: Readers of files of field spectrometers by the kind of their content.
_BY_CONTENT = {
    "binary": _asd,
    "text": _asd_text,
    "table": _asd_text,
    "scans": _svc,
    "instrument": _spectrum_text,
    "csv": _irradiance_csv,
}


# --- the command ---


@command(
    epilog="""\b
Examples:
  hyperpaint info collect.toml
  hyperpaint info lot.zarr/flightlines/raw_0""",
)
@click.argument("path", type=EXISTING)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")
@click.option(
    "--allow",
    metavar="PREFIX",
    multiple=True,
    help="Folder or URL below which raw files of a virtual store may be read, besides its own folder.",
)
def info(path: Path, as_json: bool, allow: tuple[str, ...]) -> None:
    """Describe a file or a store: dims, units, wavelengths, times, exposure, completeness.

    PATH is an ENVI header or cube, a GeoTIFF, regions, an ASD file, a text or csv export, a frame index, a
    navigation record, a collect.toml, the folder of a field day, or a Zarr store or one of its groups. All
    files of a collect are opened; the result of `process` is described.
    """
    if not as_json:
        click.echo(describe_path(path, allow))
        return
    texts = facts_of_path(path, allow)
    facts = {name: text.split("\n") if "\n" in text else text for name, text in texts.items()}
    document = {"path": str(path), **{name: text for name, text in facts.items() if text}}
    click.echo(json.dumps(document, indent=1, ensure_ascii=False))
