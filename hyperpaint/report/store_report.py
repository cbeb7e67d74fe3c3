"""Pages about a store: a report in one file, and a site that reads the store in the browser.

The report shows pictures, flags, light, signatures and provenance of every flight line. It is one file that
opens anywhere: it contains its pictures, refers to nothing outside, and runs no script. All texts of a store
are escaped.

The site is a folder for any web server. The folder holds a copy of the data in small chunks (layout
``"web"``), a store that `hyperpaint.open_store` opens; or the page reads a store at another address.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias
from urllib.parse import urlsplit

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    KEPT_BITS,
    SIGNATURE,
    Array,
    PaintError,
    PaintWarning,
    Progress,
    Quality,
    SchemaError,
    StoreError,
    as_path,
    documented,
    grouped,
    numbers_of,
    part_of,
    rename_to_roles,
    schema,
    warn_if,
    with_new_names,
)
from hyperpaint.geometry.orthorectification.mapping import orthorectify
from hyperpaint.io.files.publishing import (
    check_place,
    foreign_content,
    publish_file,
    published_folder,
)
from hyperpaint.io.store import (
    Location,
    list_groups,
    open_group,
    open_store,
    open_unverified,
    place_of,
    store_state,
    to_store,
    version_of_program,
)
from hyperpaint.light.daylight_colours import srgb_hex
from hyperpaint.paints.paint_libraries import paint_colours
from hyperpaint.pictures.figures import data_uri, encode_png, flown_right, new_figure, orientation_of, png_of
from hyperpaint.pictures.plot import (
    background,
    calibration_report,
    draw_gain,
    draw_irradiance,
    draw_outlines,
    draw_panels,
    draw_spread,
    draw_uncertainties,
    find_usable,
    flag_label,
    flag_overlay,
    flags_of,
    library_overview,
    paint_card,
    rgb,
    triptych,
    validation_figure,
)
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.regions import Region, regions_from
from hyperpaint.surroundings.scratch import compute_into, release, scratch_array, survey_planned
from hyperpaint.surroundings.surveying import flag_line, is_flagged
from hyperpaint.validation import Validation, validate

from .summaries import Part, facts_of_bands, facts_of_line, facts_of_map, page_part

if TYPE_CHECKING:
    from markupsafe import Markup


@dataclass(frozen=True)
class Written:
    """Result of `write_report` and `write_site`."""

    path: Path  #: The page.
    flightlines: tuple[str, ...]  #: Groups of flight lines on the page.
    maps: tuple[str, ...]  #: Groups of maps on the page.
    problems: tuple[str, ...]  #: Unreadable parts of the store; the page lists them too.


@documented(library="library page")
def write_report(
    store: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    flightlines: Sequence[str] | None = None,
    library: str | os.PathLike[str] | None = None,
    max_lines: int = 1000,
    flags: bool = True,
    cards: int = 12,
    validation: Validation | None = None,
    sun_zenith: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Written:
    """Write the content of a store as one self-contained HTML page.

    For every flight line and map: true colour, flags on it and their shares, irradiance over time, panels,
    spread of reflectance, the steps from counts to reflectance, a map, alignment of camera and record,
    provenance; then paint signatures with their uncertainty, their agreement with the references in the
    store, and the calibration, if the store has them. The page lists unreadable parts and shows all others.

    Parameters
    ----------
    store
    out
        The page, a file.
    flightlines
    library
    max_lines
        Maximum picture height [lines]; longer flight lines are subsampled. Flags are read completely, two
        bytes a pixel.
    flags
        Detect glint, shadow and light of neighbours on lines without these flags, see
        `hyperpaint.surroundings.flag`; if detection fails, the page gives the reason. Flags are not stored.
    cards
        Maximum number of paints of a flight line shown one by one: region, pixels used and excluded,
        signature (`hyperpaint.pictures.paint_card`); the table has all. Each takes half a second and 60 kB.
    validation
        Agreement of ``library`` with the references; by default `hyperpaint.validate` compares them.
    sun_zenith
        Sun zenith angle for the flags [degree]; by default from time and position of each line.
    overwrite
    progress

    Returns
    -------
    Written
        Path of the page, groups on it, and unreadable parts.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``max_lines`` is not positive, ``cards`` is negative, or the store has no flight line of a name.
    StoreError
        The store is missing or has nothing to show; or the page exists already, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.io.store import to_store
    >>> from hyperpaint.simulation import simulate_line
    >>> folder = Path(tempfile.mkdtemp())
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> store = to_store(line, folder / "lot.zarr", "flightlines/raw_0")
    >>> write_report(store, folder / "report.html").flightlines
    ('flightlines/raw_0',)
    """
    new_figure("a report")  # before anything is read
    page_path = as_path(out)
    check_place(page_path, "the report", example="report.html", store=as_path(store), overwrite=overwrite)
    for option, value, least in (("max_lines", max_lines, 1), ("cards", cards, 0)):
        SchemaError.raise_if(
            value < least, f"{option}={value}", expected=f"{least} or more", code="value-out-of-range"
        )
    groups = groups_to_show(store, flightlines, library)
    lines, maps, libraries, problems = groups.lines, groups.maps, groups.libraries, groups.problems
    paints: list[tuple[str, xr.Dataset, str, Region]] = []  # flight line, library, name and region of paints
    for name, library_of_paints in libraries.items():
        try:
            paints += [
                (line, library_of_paints, paint, region)
                for line, paint, region in regions_of(library_of_paints)
            ]
        except Exception as error:  # see _draw_section
            problems.append(f"/{name}, regions: {message_of(error)}")
    calibration = groups.groups.get("calibration")
    references = [group for name, group in groups.groups.items() if name.startswith("references/")]
    has_validation = bool(libraries and references)
    steps = len(lines) + len(libraries) + has_validation + (calibration is not None)
    sections: list[tuple[str, Iterator[Part]]] = []
    for number, (name, line) in enumerate(lines.items()):
        share = part_of(progress, number, steps)
        on_line = [row for row in paints if row[0] in ("", name, name.rpartition("/")[2])]
        detect = partial(flagged, sun_zenith=sun_zenith, progress=share) if flags else None
        sections.append((name, _line_parts(line, max_lines, on_line, cards, detect)))
    sections += [
        *((name, map_section(group, max_lines)) for name, group in maps.items()),
        *((name, library_section(paints)) for name, paints in libraries.items()),
    ]
    if has_validation:
        known = {} if library is None or validation is None else {as_path(library).name: validation}
        sections.append(("validation", validation_section(libraries, references, known)))
    if calibration is not None:
        sections.append(("calibration", calibration_section(calibration)))
    drawn_sections = []
    for number, (name, parts) in enumerate(sections):
        if progress is not None:
            progress(1000 * number, 1000 * steps)
        # Replace a part that cannot be drawn by a text with its problem
        markups: list[Markup] = []
        for part_name, draw in parts:
            try:
                markups.append(draw())
            # reading a damaged chunk fails, and drawing data of other programs may fail
            except Exception as error:
                message = message_of(error)
                problems.append(f"/{name}, {part_name}: {message}")
                markups.append(
                    page_part(
                        "paragraph", text=f"This could not be shown: {part_name}: {message}", kind="problem"
                    )
                )
        drawn_sections.append((name, markups))
    created = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="seconds")
    collects = [str(group.attrs["collect"]) for group in groups.groups.values() if "collect" in group.attrs]
    title = as_path(store).resolve().name
    facts = {
        "store": title,
        "collect": ", ".join(dict.fromkeys(collects)),
        "groups": ", ".join(f"/{name}" for name in groups.groups),
        "reported": f"{created.removesuffix('+00:00')} UTC by hyperpaint {version_of_program()}",
    }
    head = page_part("head", pairs=list(facts.items()), problems=problems)
    publish_file(
        page_path,
        page_part("page", title=title, head=head, sections=drawn_sections).encode("utf-8", "replace"),
        overwrite=True,
    )
    if progress is not None:
        progress(1000 * steps, 1000 * steps)
    return Written(page_path, tuple(lines), tuple(maps), tuple(problems))


def _line_parts(
    line: xr.Dataset,
    lines: int,
    paints: Sequence[tuple[str, xr.Dataset, str, Region]],
    cards: int,
    detect: Callable[[xr.Dataset], tuple[xr.Dataset, str]] | None,
) -> Iterator[Part]:
    line, note = (line, "") if detect is None else detect(line)
    for section_part in line_section(line, lines, [region for *_, region in paints], note):
        yield section_part
        # detected flags lie in memory-mapped files, which a picture reads completely
        for name in ("quality", *LAYERS):
            values = line.variables[name]._data if name in line.variables else None
            if isinstance(values, np.ndarray):
                release(values)
    # the cards of the paints measured on the line; libraries are loaded once for all cards, without the
    # variables that a card does not show
    loaded = {
        id(library): library.drop_vars(HIDDEN_VARIABLES, errors="ignore").load()
        for _, library, _, _ in paints[:cards]
    }
    for number, (_, library, paint, _) in enumerate(paints[:cards]):
        heading = "" if number else "Paint by paint"
        caption = f"{paint}: its region, the pixels used, and its signature."
        draw = partial(paint_card, line, loaded[id(library)], paint)
        yield f"card of {paint}", partial(_drawn, draw, caption, heading, "wide card")
    if len(paints) > cards:
        text = f"and {len(paints) - cards} more paints, without a card"
        yield "more cards", partial(page_part, "paragraph", text=text)


# --- the page ----------------------------------------------------------------------------------------------


#: Variables of a library that pages do not show.
HIDDEN_VARIABLES = (
    "member_reflectance",
    "member_along_track",
    "member_cross_track",
    "reflectance_errors",
    "error_correlation",
    "quality_share",
)
MAX_LINES = 64  # flight lines of one page: each takes some megabytes

_SCENE_FLAGS = "Glint, shadow and light of neighbours"


class ShownGroups(NamedTuple):
    # Opened groups of a store by name.
    groups: dict[str, xr.Dataset]
    lines: dict[str, xr.Dataset]
    maps: dict[str, xr.Dataset]
    libraries: dict[str, xr.Dataset]
    problems: list[str]  #: Unreadable groups, with the reason


def groups_to_show(
    store: str | os.PathLike[str],
    flightlines: Sequence[str] | None,
    signatures: str | os.PathLike[str] | None,
) -> ShownGroups:
    # Return the chosen flight lines, all maps and libraries of a store, and a library beside it.
    #
    # Raises `SchemaError` for an unknown flight line, or if ``signatures`` is not a paint library;
    # `StoreError` if the store has nothing to show.
    listed, groups = list_groups(store), {}
    # an unfinished store is a problem, but its finished groups are shown
    problems = list(store_state(place_of(store)[0] or Location.of(store), listed).problems)
    for name in listed:
        try:
            groups[name] = with_new_names(open_group(store, name))
        except StoreError as error:
            problems.append(f"/{name}: {error}")
            with contextlib.suppress(StoreError):  # show the readable variables
                groups[name] = open_unverified(store, name)
    cubes = {"counts", "radiance", "reflectance", "quality"}
    lines = {
        name: group
        for name, group in groups.items()
        if {ALONG_TRACK, CROSS_TRACK} <= set(group.dims) and cubes & set(group.variables)
    }
    if flightlines is None:
        lines = dict(list(lines.items())[:MAX_LINES])
    else:
        keys = {
            name: next((key for key in lines if name in (key, key.rpartition("/")[2])), None)
            for name in flightlines
        }
        SchemaError.raise_if(
            unknown := [name for name, key in keys.items() if key is None],
            f"{store} has no flight line {', '.join(map(repr, unknown))}",
            expected=", ".join(lines) or "none",
            code="flightline-unknown",
        )
        lines = {key: lines[key] for key in keys.values() if key is not None}
    maps = {
        name or as_path(store).name: group for name, group in groups.items() if {"y", "x"} <= set(group.dims)
    }
    libraries = {name: group for name, group in groups.items() if _is_library(group)}
    if signatures is not None:
        library = with_new_names(open_store(signatures, ""))
        SchemaError.raise_if(
            not _is_library(library),
            f"{signatures} is no paint library",
            expected="reflectance (signature, band), as `hyperpaint signatures` writes",
            code="library-missing",
        )
        libraries[Path(signatures).name] = library
    reason = "; ".join(problems) or f"its groups are {', '.join(groups) or 'none'}"
    StoreError.raise_if(
        not lines and not libraries and not maps,
        f"{store} has no flight line, map or signatures to show: {reason}",
        code="store-empty",
    )
    return ShownGroups(groups, lines, maps, libraries, problems)


def _is_library(group: xr.Dataset) -> bool:
    return "reflectance" in group.variables and SIGNATURE in group["reflectance"].dims


def flagged(line: xr.Dataset, sun_zenith: float | None, progress: Progress | None) -> tuple[xr.Dataset, str]:
    # Return a line with scene flags, detected if it has none, and a note for the page about their origin.
    if not {"reflectance", "irradiance"} & set(line.variables):
        return line, ""
    names = ("quality", *LAYERS)
    try:
        if is_flagged(line):
            return line, ""
        # survey the line, then detect all flags in one pass
        calibrated = line if "reflectance" in line.variables else reflectance(line)
        with survey_planned(line, "the survey"):
            flags = flag_line(calibrated, sun_zenith=sun_zenith, progress=part_of(progress, 0, 2)).line
            lazy = [flags[name].transpose(ALONG_TRACK, CROSS_TRACK).data for name in names]
            values = [scratch_array(array.shape, array.dtype) for array in lazy]
            compute_into(lazy, values)
    # the line is shown even if detection fails; drawing reports damaged data again
    except Exception as error:
        # without the remedy, since not every caller has its argument
        cause = message_of(error)
        if isinstance(error, PaintError) and not error.problem.inner:
            cause = f"{error.problem.found:.1000}"
        return line, f"{_SCENE_FLAGS} could not be detected: {cause}"
    arrays = {
        name: flags[name].reset_coords(drop=True).copy(data=array)
        for name, array in zip(names, values, strict=True)
    }
    return line.assign(arrays), f"{_SCENE_FLAGS} were detected for this page; the store has no such flags."


def message_of(error: Exception) -> str:
    # Return the message of an error for the page; errors of other packages with their class.
    kind = "" if isinstance(error, PaintError) else f"{type(error).__name__}: "
    return f"{kind}{error!s:.1000}"


# --- sections of a report: a flight line, a map, a paint library, a calibration ----------------------------


MAX_ROWS = 500  # paints in a table
MAX_PLACES = 3  # places of refused regions listed for a reason

LAYERS = ("glint_fraction", "blocked_direct", "adjacency")  # continuous layers drawn if the store has them


def line_section(
    line: xr.Dataset, lines: int, regions: Sequence[Region] = (), note: str = ""
) -> Iterator[Part]:
    # Yield the parts of a flight line's section; draw a part before taking the next.
    #
    # ``lines``: maximum height of a picture; ``regions``: drawn as outlines, in sensor coordinates; ``note``:
    # remark about the flags.
    names, pictures = set(map(str, line.variables)), list[bool]()
    yield "facts", lambda: page_part("facts", pairs=list(facts_of_line(line)))
    yield "true colour", partial(_true_colour, line, lines, pictures)
    # flags are drawn only if there is a picture; otherwise the page already gives the reason
    heading = "Flags and regions" if regions else "Flags"
    if pictures and "quality" in names:
        yield "flags", lambda: _flags(line, lines, regions, heading)
    chain = {"counts", "radiance_gain", "exposure_time", "irradiance", "wavelength"}
    can_be_mapped = {"east", "north"} <= names or (names >= _POSE and "ground" in line.attrs)
    shares_heading = "Shares of flags" if pictures else heading
    rows: list[tuple[bool, str, Callable[[], Markup]]] = [
        ("reflectance" in names and can_be_mapped, "map", partial(_map, line)),
        ("quality" in names, "shares of flags", lambda: _table_of_flags(flags_of(line), shares_heading)),
        *(
            (bool(pictures) and layer in names, layer, partial(_flags, line, lines, (), layer=layer))
            for layer in LAYERS
        ),
        (bool(note), "origin of flags", partial(page_part, "paragraph", text=note)),
        ("irradiance" in names, "irradiance", partial(_chart, "irradiance", line)),
        ("panel_factor" in names, "panels", partial(_chart, "panels", line)),
        (bool({"reflectance", "irradiance"} & names), "reflectance", partial(_reflectance, line)),
        (chain <= names, "counts to reflectance", partial(_triptych, line, regions)),
        ("passed_checks" in line.attrs, "checks", partial(_checks, line.attrs)),
        ("alignment_state" in line.attrs, "alignment", partial(_alignment, line.attrs)),
        (True, "provenance", partial(_provenance, line.attrs)),
    ]
    yield from ((name, draw) for is_there, name, draw in rows if is_there)


def map_section(orthomap: xr.Dataset, rows: int) -> Iterator[Part]:
    # Yield the parts of a map's section; its picture has at most ``rows`` rows.
    step = max(1, -(-orthomap.sizes["y"] // rows))
    group = rename_to_roles(orthomap)

    def picture() -> Markup:
        bytes_ = picture_bytes(
            rgb(group.isel({ALONG_TRACK: slice(None, None, step), CROSS_TRACK: slice(None, None, step)}))
        )
        return page_part(
            "true_colour",
            src=data_uri(encode_png(bytes_)),
            caption=f"{orthomap.sizes['y']} rows down, {orthomap.sizes['x']} columns to the right.",
        )

    yield from (
        ("facts", lambda: page_part("facts", pairs=list(facts_of_map(orthomap)))),
        ("true colour", picture),
    )
    if "quality" in group.variables:
        yield "shares of flags", lambda: _table_of_flags(flags_of(group), "Flags")
    if "reflectance" in group.variables:
        yield "reflectance", partial(_reflectance, group)
    yield "provenance", partial(_provenance, orthomap.attrs)


def _true_colour(line: xr.Dataset, lines: int, pictures: list[bool]) -> Markup:
    # add an entry to ``pictures`` if the picture can be drawn
    SchemaError.raise_if(
        not line.sizes[ALONG_TRACK] or not line.sizes[CROSS_TRACK],
        f"the line has no pixels: {line.sizes[ALONG_TRACK]} lines of {line.sizes[CROSS_TRACK]} columns",
        code="line-empty",
    )
    try:
        picture = background(line, max(1, -(-line.sizes[ALONG_TRACK] // lines)))
    except SchemaError as error:  # no reflectance, no visible bands
        return page_part("paragraph", text=f"There is no picture: {error}", heading="True colour")
    # flown upwards, as in all pictures of a line
    orientation = orientation_of(line)
    upright = picture_bytes(picture[::-1, :: -1 if orientation.is_mirrored else 1])
    columns = "left" if orientation.is_mirrored else "right"
    caption = (
        f"{line.sizes[ALONG_TRACK]} lines, flown upwards;"
        f" {line.sizes[CROSS_TRACK]} columns, counted to the {columns}."
    )
    pictures.append(True)
    return page_part("true_colour", src=data_uri(encode_png(upright)), caption=caption, kind="half")


def _flags(
    line: xr.Dataset, lines: int, regions: Sequence[Region], heading: str = "", layer: str | None = None
) -> Markup:
    # a layer, or all flags with the outlines of regions; lines are flown upwards
    width = 3.9 if layer else 4.9
    height = min(max(orientation_of(line).height_of(width - 0.8), 1.5), 9.0) + (0.9 if layer else 1.7)
    axes = _new_axes(height, width)
    flag_overlay(line, layer=layer, lines=lines, axes=axes)
    axes.set(title="", xlabel="" if layer else axes.get_xlabel(), ylabel="" if layer else axes.get_ylabel())
    draw_outlines(axes, regions)
    caption = (
        schema.VARIABLES[layer].meaning if layer else "Flagged pixels; of several flags the rarest is shown"
    )
    return figure_part(axes.figure, f"{caption}.", heading, kind="third" if layer else "half")


def _reflectance(line: xr.Dataset) -> Markup:
    axes = _new_axes(3.2, _CHART_INCH)
    step = max(1, line.sizes[ALONG_TRACK] // 50)
    sample = line.isel({ALONG_TRACK: slice(None, None, step)})
    draw_spread(axes, sample if "reflectance" in sample else reflectance(sample))
    every = "all lines" if step == 1 else f"one line in {step}"
    return figure_part(
        axes.figure,
        f"Spread of reflectance over the pixels of {every}, band by band.",
        "Reflectance",
        kind="chart half",
    )


def _table_of_flags(quality: Array, heading: str) -> Markup:
    shares = schema.flag_shares(quality)
    if not shares:
        return page_part("paragraph", text="No flag is set on any pixel.", heading=heading)
    rows = [
        (flag_label(flag), np.count_nonzero(quality & int(flag)), share) for flag, share in shares.items()
    ]
    return page_part(
        "flags",
        rows=rows,
        unflagged=f"{100 * float((quality == 0).mean()):.2f} % of {quality.size} pixels have no flag.",
        heading=heading,
    )


def library_section(library: xr.Dataset) -> Iterator[Part]:
    # Yield the parts of a paint library's section; variables that break the schema are left out.
    usable, problems = find_usable(library)
    yield (
        "facts",
        lambda: page_part("facts", pairs=[("paints", usable.sizes[SIGNATURE]), *facts_of_bands(usable)]),
    )
    refuse: Any = partial(SchemaError.raise_if, True, code="variable-unusable")
    yield from (("variables", partial(refuse, problem)) for problem in problems)
    yield (
        "spectra",
        lambda: figure_part(
            library_overview(usable),
            "Colour in daylight, centre, middle half and 5 to 95 % of the pixels of every paint.",
        ),
    )
    if "reflectance_u_random" in usable.variables:
        yield "uncertainty", partial(_chart, "uncertainty", usable)
    yield "paints", lambda: _table_of_paints(usable)
    if refused := library.attrs.get("refused"):
        yield "refused", partial(_refusals, [str(text) for text in np.atleast_1d(refused)])
    yield "provenance", lambda: _provenance({k: text for k, text in library.attrs.items() if k != "refused"})


def _refusals(refused: Sequence[str]) -> Markup:
    # refused regions by reason, the most frequent first; reasons that differ in numbers only are one
    groups = grouped(
        (re.sub(r"\d+(\.\d+)?", "#", reason), (reason, place))
        for place, _, reason in (text.partition(": ") for text in refused)
    )
    rows = []
    for found in sorted(groups.values(), key=len, reverse=True):
        more = f" and {len(found) - MAX_PLACES} more" if len(found) > MAX_PLACES else ""
        rows.append((len(found), found[0][0], "; ".join(place for _, place in found[:MAX_PLACES]) + more))
    return page_part(
        "table",
        heads=("regions", "reason", "where"),
        rows=rows,
        numbers=1,
        heading=f"Refused regions: {len(refused)}",
    )


def _table_of_paints(library: xr.Dataset) -> Markup:
    first_paints = library.isel({SIGNATURE: slice(0, MAX_ROWS)})
    columns = [name for name in ("n", "n_eff", "n_excluded") if name in first_paints.variables]
    standard = {"time", "region", *schema.LIBRARY_VARIABLES}
    # sorted, because the coordinates of a store come in the order of its folder's listing
    extra = sorted(
        str(name)
        for name in first_paints.coords
        if first_paints[name].dims == (SIGNATURE,) and name not in standard
    )[:12]
    values = {name: first_paints[name].values for name in (SIGNATURE, *columns, *extra)}
    quality = (
        first_paints["quality"].values
        if "quality" in first_paints.variables
        else np.zeros(len(values[SIGNATURE]), int)
    )
    rows = [
        {
            "rgb": ",".join(map(str, (255 * colour + 0.5).astype(int))) if np.isfinite(colour).all() else "",
            "name": values[SIGNATURE][k],
            "numbers": [f"{values[name][k]:.0f}" for name in columns],
            "flags": ", ".join(schema.flag_names(int(quality[k]))),
            "extra": [values[name][k] for name in extra],
        }
        for k, colour in enumerate(paint_colours(first_paints))
    ]
    numbers = [name.replace("_", " ") for name in columns]
    hidden_count = library.sizes[SIGNATURE] - len(rows)
    note = f"and {hidden_count} more paints" if hidden_count > 0 else ""
    return page_part("paints", rows=rows, numbers=numbers, extra=extra, note=note)


def regions_of(library: xr.Dataset) -> Iterator[tuple[str, str, Region]]:
    # Yield flight line, name and region of the paints of a library.
    #
    # Regions on a map, and invalid regions in libraries of other programs, are left out.
    in_sensor = library.attrs.get("coordinates_of_regions", "sensor") == "sensor"
    if not in_sensor or not {"region", "flightline"} <= set(library.variables):
        return
    columns = (library[name].values for name in ("flightline", SIGNATURE, "region"))
    for flightline, paint, geojson in list(zip(*columns, strict=True))[:MAX_ROWS]:
        with contextlib.suppress(PaintError, ValueError, RecursionError):
            yield str(flightline), str(paint), regions_from(json.loads(str(geojson)))[0]


def calibration_section(calibration: xr.Dataset) -> Iterator[Part]:
    # Yield the parts of the calibration's section; a calibration from a lab sweep has its report.
    yield "facts", lambda: page_part("facts", pairs=list(facts_of_bands(calibration)))
    # a calibration from files has no lamp lines of a lab sweep
    if "line_centre" in calibration.variables:
        yield (
            "lab sweep",
            lambda: figure_part(
                calibration_report(calibration), "Lamp lines of the lab sweep and the calibration from them."
            ),
        )
    elif "radiance_gain" in calibration.variables:
        yield "gain and smile", partial(_gain, calibration)
    yield "provenance", partial(_provenance, calibration.attrs)


_CHART_INCH = 7.4  # width of a chart whose text can be read on a telephone


def _new_axes(height: float, width: float = 10.0) -> Any:
    return new_figure("a report", figsize=(width, height), layout="constrained").add_subplot()


#: Charts of a line or library: function that draws them, size [inch], heading, caption, kind of figure.
_CHARTS: Mapping[str, tuple[Callable[[Any, xr.Dataset], None], tuple[float, float], str, str, str]] = {
    "irradiance": (
        draw_irradiance,
        (_CHART_INCH, 3.2),
        "Irradiance over time",
        "Downwelling irradiance around the line; the time of the line is shaded.",
        "chart half",
    ),
    "panels": (
        draw_panels,
        (_CHART_INCH, 4.0),
        "Panels",
        "Ratio of measured to certified reflectance of the panels, with twice the combined standard "
        "uncertainty: where the shade misses 1, calibration, irradiance or panel is wrong.",
        "chart half",
    ),
    "uncertainty": (
        draw_uncertainties,
        (10.0, 3.8),
        "Uncertainty",
        "Standard uncertainty of the mean reflectance; dashed: its random part.",
        "wide",
    ),
}


def _chart(name: str, dataset: xr.Dataset) -> Markup:
    draw, (width, height), heading, caption, kind = _CHARTS[name]
    axes = _new_axes(height, width)
    draw(axes, dataset)
    return figure_part(axes.figure, caption, heading, kind)


def _drawn(draw: Callable[[], Any], caption: str, heading: str = "", kind: str = "wide") -> Markup:
    return figure_part(draw(), caption, heading, kind)


def _gain(calibration: xr.Dataset) -> Markup:
    figure = new_figure("a report", figsize=(10, 3.4), layout="constrained")
    draw_gain(figure, calibration)
    return figure_part(
        figure,
        "Gain and width of every band, and wavelength shift over the columns.",
        "Gain, width and smile",
        kind="chart wide",
    )


def _provenance(attrs: Mapping[Any, Any]) -> Markup:
    return page_part("provenance", pairs=[(str(name), text) for name, text in attrs.items()])


_DPI = 100
_MAX_MAP_CELLS = 800  # rows or columns
_MAX_MAP_BANDS = 24
_POSE = {"latitude", "longitude", "altitude", "roll", "pitch", "heading"}

# results of the comparison of camera and record in the attributes, see `hyperpaint.alignment.align`
_COMPARED = {
    "state": "state",
    "shift": "wavelength shift, camera minus record, at 600 nm [nm]",
    "shift_slope": "change of the shift over 100 nm [nm]",
    "width": "band width over declared width [1]",
    "departure": "departure from no shift [standard uncertainties]",
    "effect": "largest change of irradiance [1]",
    "residual": "residual of solar lines, aligned [1]",
    "residual_declared": "residual of solar lines, as declared [1]",
    "record_shift": "shift of the record against solar lines [nm]",
    "camera_shift": "shift of the camera against solar lines [nm]",
    "record_fwhm": "width of the record's bands [nm]",
    "camera_width": "width of the camera's bands over declared width [1]",
}


def _triptych(line: xr.Dataset, regions: Sequence[Region]) -> Markup:
    heading = "From counts to reflectance"
    for region in regions:
        try:
            caption = f"{region.name}: median of its pixels, the middle half and 5 to 95 % of them."
            return figure_part(triptych(line, region, width=13.0), caption, heading)
        except SchemaError:  # all pixels of the region are flagged, or it lies outside the line
            continue
    centre = (line.sizes[ALONG_TRACK] // 2, line.sizes[CROSS_TRACK] // 2)
    caption = f"The pixel in the middle of the line: line {centre[0]}, column {centre[1]} of the store."
    return figure_part(triptych(line, pixels=centre, width=13.0), caption, heading)


def _map(line: xr.Dataset) -> Markup:
    # few visible bands, and cells large enough for the size of the page
    nm = line["wavelength"].values
    visible = np.flatnonzero((nm > 400) & (nm < 700))
    bands = visible[
        np.unique(np.linspace(0, visible.size - 1, min(visible.size, _MAX_MAP_BANDS)).astype(int))
    ]
    names = ["reflectance", *(name for name in ("east", "north") if name in line.variables)]
    selection = line.isel({BAND: bands})[[*names, *(n for n in _POSE if n in line.data_vars)]].assign_coords(
        line.coords if BAND not in line.dims else line.isel({BAND: bands}).coords
    )
    try:
        orthomap = orthorectify(selection, variables=["reflectance"])
        cells = max(orthomap.sizes["y"], orthomap.sizes["x"])
        if cells > _MAX_MAP_CELLS:
            gsd = float(abs(orthomap["x"][1] - orthomap["x"][0])) * cells / _MAX_MAP_CELLS
            orthomap = orthorectify(selection, gsd, variables=["reflectance"])
    except PaintError as error:  # camera or heights are missing, which is not a fault of the store
        return page_part("paragraph", text=f"There is no map: {error}", heading="Map")
    x, y = orthomap["x"].values, orthomap["y"].values
    caption = (
        f"North up, cells of {abs(x[1] - x[0]):.2g} m; easting {x.min():.0f} to {x.max():.0f}, northing "
        f"{y.min():.0f} to {y.max():.0f} m."
    )
    picture = picture_bytes(rgb(rename_to_roles(orthomap)))
    return page_part(
        "true_colour", src=data_uri(encode_png(picture)), caption=caption, heading="Map", kind="half"
    )


def figure_part(figure: Any, caption: str, heading: str = "", kind: str = "wide") -> Markup:
    # Return a figure for a page; a figure of kind ``chart`` may be inverted in dark themes.
    return page_part(
        "picture", src=data_uri(png_of(figure, dpi=_DPI)), caption=caption, heading=heading, kind=kind
    )


def picture_bytes(picture: xr.DataArray | Array) -> _Picture:
    # Return a picture from 0 to 1 as bytes; pixels without a value are black.
    values = np.nan_to_num(np.asarray(picture)).clip(0.0, 1.0)
    return np.ascontiguousarray((values * 255.0 + 0.5).astype(np.uint8))


def _checks(attrs: Mapping[Any, Any]) -> Markup:
    # judgements of the inputs by their result, and findings that were accepted
    rows = [
        *(("accepted", text, "") for text in attrs.get("accepted_findings", ())),
        *(("passed", *text.split("; expected ")) for text in attrs["passed_checks"]),
    ]
    return page_part(
        "table", heads=("", "found", "expected"), rows=rows, numbers=0, heading="Checks of the inputs"
    )


def _alignment(attrs: Mapping[Any, Any]) -> Markup:
    rows = []
    for name, label in _COMPARED.items():
        value, u = (attrs.get(f"alignment_{name}{suffix}") for suffix in ("", "_u"))
        if isinstance(value, int | float):
            has_u = isinstance(u, int | float)
            rows.append((label, f"{value:.4g} \u00b1 {u:.2g}" if has_u else f"{value:.4g}"))
        elif value is not None:
            rows.append((label, value))
    return page_part("provenance", pairs=rows, summary="Alignment of camera and irradiance record")


def _pairs(agreement: Validation) -> Markup:
    # agreement of every pair over the part of the spectrum with most bands
    rows = []
    for number in range(agreement.statistics.sizes["pair"]):
        pair = agreement.statistics.isel(pair=number)
        part = pair.isel(part=int(pair["bands"].values.argmax()))
        names = [str(pair[name].item()) for name in ("signature", "reference", "instrument")]
        numbers = [f"{float(part[name]):.4f}" for name in ("rmse", "rmse_limit", "scale")]
        rows.append((*numbers, *names, "pass" if bool(pair["passes"].all()) else "FAIL"))
    return page_part(
        "table",
        heads=("RMSE", "limit", "scale", "paint", "reference", "instrument", ""),
        rows=rows,
        numbers=3,
    )


def validation_section(
    libraries: Mapping[str, xr.Dataset], references: Sequence[xr.Dataset], known: Mapping[str, Validation]
) -> Iterator[Part]:
    # Yield the agreement of each library with the field spectra in the store; ``known``: results by library.
    for name, library in libraries.items():
        try:
            with warnings.catch_warnings(action="ignore", category=PaintWarning):  # the page has them
                agreement = known[name] if name in known else validate(library, list(references))
        except SchemaError as error:
            yield name, partial(page_part, "paragraph", text=f"{name} cannot be compared: {error}")
            continue
        yield "verdict", partial(page_part, "paragraph", text=agreement.verdict, heading=name)
        yield (
            "agreement",
            partial(
                _drawn,
                partial(validation_figure, agreement, columns=4),
                "Signatures over their references, and the differences with their standard uncertainty.",
            ),
        )
        yield "pairs", partial(_pairs, agreement)
        lines = agreement.table().splitlines()
        yield "statistics", partial(page_part, "preformatted", lines=lines, summary="All statistics")
        for message in agreement.remarks:
            yield "remark", partial(page_part, "paragraph", text=message)


_Picture: TypeAlias = "np.ndarray[Any, np.dtype[np.uint8]]"

FORMAT = "hyperpaint site 1"
_INDEX = "site.json"
_WEB = resources.files("hyperpaint") / "report" / "web"
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
    # the web origin that the page reads from; empty for a path relative to the page
    address = urlsplit("page" if link is None else link)
    is_relative = not address.scheme and not address.netloc and bool(address.path)
    origin = "" if is_relative else f"{address.scheme}://{address.netloc}"
    SchemaError.raise_if(
        not is_relative
        and (address.scheme not in ("http", "https") or not _ORIGIN.fullmatch(address.netloc)),
        f"link={link!r:.200}",
        expected="an address such as https://bucket.example.org/lot.zarr, or a path such as ../lot.zarr",
        code="link-invalid",
    )
    folder = as_path(out)
    StoreError.raise_if(
        as_path(store).resolve() in (folder.resolve(), *folder.resolve().parents),
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
            calibrated = group
            # with ``link``, reflectance is not computed from counts
            if "reflectance" not in group.variables:
                StoreError.raise_if(
                    link is not None,
                    "the line holds no reflectance for the page to read",
                    mend="leave out link",
                    option="leave out --link",
                    code="variable-missing",
                )
                calibrated = reflectance(group, keep_bits=KEPT_BITS)
            dims = calibrated["reflectance"].dims
            SchemaError.raise_if(
                "wavelength" not in calibrated.variables or len(dims) != 3,
                f"reflectance {dims}",
                expected="lines, columns and bands, with wavelengths",
                code="dim-missing",
            )
            shown_names = [name for name in calibrated.variables if name in _SHOWN_VARIABLES or name in dims]
            variables = calibrated.reset_coords()[shown_names].set_coords(
                [name for name in shown_names if name not in ("reflectance", "quality")]
            )
            picture, places = _picture(variables, group, max_lines)
            file = f"pictures/{len(pictures)}.png"  # the name of a group may be no valid file name
            shown[path], pictures[file] = variables, picture
            short_name = name.rpartition("/")[2]
            # sorted, because xarray lists coordinates in random order
            entry = {
                "name": name if any(entry["name"] == short_name for entry in lines) else short_name,
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
        warn_if(note, f"/{name}: {note}", "flags-not-searched")
    StoreError.raise_if(
        not shown,
        f"{store} has no readable flight line, map or paint library: {'; '.join(problems)}",
        code="store-empty",
    )
    site_names = {_INDEX, "pictures", "store.zarr", *(file.name for file in _WEB.iterdir())}
    foreign = partial(
        foreign_content, product="a site", marker=_INDEX, form=FORMAT, is_own=site_names.__contains__
    )
    with published_folder(folder, overwrite=overwrite, foreign=foreign) as build:
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
    if is_line:
        orientation = orientation_of(source)
        geometry["mirrored"] = orientation.is_mirrored
        colours = flown_right(colours, orientation)
    return picture_bytes(colours), geometry
