"""Opening and checks of collects, with their geometry and white references; calibration of lab sweeps."""

import itertools
import json
import os
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    CROSS_TRACK,
    CollectError,
    Convention,
    FormatError,
    PaintWarning,
    Problems,
    SchemaError,
    as_path,
    documented,
    label,
    one_of,
    warn_user,
)
from hyperpaint.geometry.georeference.locating import PinholeCamera
from hyperpaint.geometry.navigation_checking import navigation_findings
from hyperpaint.io.collect.collect_toml import (
    Collect,
    OpenedCollect,
    WhiteEntry,
    open_with_settings,
    read_collect,
)
from hyperpaint.io.files.reading import decoded_text, numbers, read_limited_text
from hyperpaint.io.flightline.flightline_opening import Reference, Timing, read_reference
from hyperpaint.io.flightline.side_files import open_sweep
from hyperpaint.io.spectrometers.record_faults import RECORD
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate, read_panel_table
from hyperpaint.io.store import to_store
from hyperpaint.light.aircraft_receiver import level_irradiance
from hyperpaint.pictures.figures import check_picture
from hyperpaint.plausibility import KINDS, Finding, judge_dark_cube, judge_line
from hyperpaint.radiometry import white_reference
from hyperpaint.radiometry.counts_to_reflectance import panel_closure
from hyperpaint.radiometry.panels import RULES, declared_panels
from hyperpaint.radiometry.planning import has_white


def calibrate_sweep(
    path: str | os.PathLike[str], *, progress: Callable[[int, int], None] | None = None, **options: Any
) -> xr.Dataset:
    # Return the calibration of a stored lab sweep (see `open_sweep`); ``options`` are those of `calibrate`.
    #
    # Raises `FormatError` or `SchemaError` if the sweep cannot be read or calibrated; all problems are
    # listed. Warns as `calibrate`.
    from hyperpaint.calibration import calibrate

    sweep = open_sweep(path)
    try:
        calibration = calibrate(sweep, progress=progress, **options)
    except SchemaError as error:
        raise error.about(str(path)) from error
    return calibration.assign_attrs(sweep=as_path(path).name)


def write_calibration(
    sweep: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    picture: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    # Write the calibration of a stored lab sweep into a store, and return it; see `calibrate_sweep`.
    #
    # ``overwrite`` replaces a calibration of other content; an equal calibration is not written again.
    # ``picture``: file for the figure of `hyperpaint.pictures.calibration_report`.
    #
    # Raises `FormatError` or `SchemaError` as `calibrate_sweep`, or if the picture cannot be written;
    # `MissingExtraError` if the picture needs matplotlib; `StoreError` if the store cannot be written, or
    # holds other data.
    SchemaError.raise_if(
        as_path(out).resolve() == as_path(sweep).resolve(),
        f"{out} is the sweep itself",
        mend="choose another path for the calibration",
        code="output-is-input",
    )
    if picture is not None:
        check_picture(as_path(picture))
    calibration = calibrate_sweep(sweep, progress=progress, **options)
    to_store(calibration, as_path(out), overwrite=overwrite)
    if picture is not None:
        from hyperpaint.pictures.plot import calibration_report

        calibration_report(calibration, open_sweep(sweep), as_path(picture))
    return calibration


@documented()
def open_collect(
    path: str | os.PathLike[str], *, need_irradiance: bool = True, chunks: Any = "auto"
) -> xr.DataTree:
    """Open all files of a ``collect.toml``, without reading cubes.

    A lab sweep (``[calibration] sweep``) is calibrated.

    Parameters
    ----------
    path
    need_irradiance
        False to accept a collect without irradiance, for radiance.
    chunks
        dask chunks of the cubes, as for `open_flightline`.

    Returns
    -------
    xarray.DataTree
        ``/flightlines/<id>`` (see `open_flightline`), ``/irradiance``, ``/calibration`` and
        ``/references/<instrument>``; the root holds attributes and no variables.

    Raises
    ------
    CollectError
        The ``collect.toml`` or one of its files cannot be used; all problems of all files are listed.

    Warns
    -----
    PaintWarning
        As `open_flightline`, `open_irradiance` and `calibrate`.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> path = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6, cubes=2)
    >>> tree = open_collect(path)
    >>> sorted(tree.children), sorted(tree["flightlines"].children)
    (['calibration', 'flightlines', 'irradiance', 'references'], ['raw_0', 'raw_20'])
    """
    return opened_collect(path, need_irradiance=need_irradiance, chunks=chunks).tree


def opened_collect(
    collect: str | os.PathLike[str] | Collect, *, need_irradiance: bool = True, chunks: Any = "auto"
) -> OpenedCollect:
    # Open a collect, as `open_collect` does, with its settings.
    # calibrates a line by [reference]; the cubes of the white are read once
    references: list[Reference] = []

    def whiten(line: xr.Dataset, entry: WhiteEntry) -> xr.Dataset:
        if not references:
            references.extend(read_reference(path, Timing(), None, "white") for path in entry.cubes)
        return white_reference(line, references, **entry.options)

    opened = open_with_settings(
        collect,
        need_irradiance=need_irradiance,
        chunks=chunks,
        calibrate=calibrate_sweep,
        mount=_with_geometry,
        level=level_irradiance,
        whiten=whiten,
    )
    lines: Mapping[str, xr.DataTree] = opened.tree["flightlines"].children
    panels_by_line: dict[str, list[dict[str, Any]]] = {}
    for panel in opened.settings.panels:
        one_of(panel.line, list(lines), "[[panels]] line", error=CollectError)
        reflectance: Any = panel.reflectance
        if isinstance(reflectance, Path):
            certificate = read_certificate(reflectance)
            reflectance = np.stack([certificate["wavelength"].values, certificate.values], axis=-1).tolist()
        surface = panel.surface
        table = surface if isinstance(surface, str) else read_panel_table(surface).to_dict()
        row = {**vars(panel), "reflectance": reflectance, "surface": table}
        panels_by_line.setdefault(panel.line, []).append(row)
    for name, rows in panels_by_line.items():
        lines[name].dataset = lines[name].to_dataset().assign_attrs(panels=json.dumps(rows))
    return opened


def _with_geometry(line: xr.Dataset, geometry: Mapping[str, Any]) -> xr.Dataset:
    # Store [geometry] in a line: ``ground`` [m above the ellipsoid], ``boresight`` and ``lever_arm`` as
    # attributes for `locate`; the field of view, or the file ``look_angle``, as the angle of every column.
    names = {"ground": "ground", "boresight_deg": "boresight", "lever_arm_m": "lever_arm"}
    attrs = {
        names[key]: list(value) if isinstance(value, tuple) else float(value)
        for key, value in geometry.items()
        if key in names
    }
    if geometry.get("look_angle") is not None:
        path, columns = geometry["look_angle"], line.sizes[CROSS_TRACK]
        # angle of every column, positive to the right [degree]
        cells = numbers(
            decoded_text(
                read_limited_text(
                    path,
                    _MAX_ANGLE_FILE_BYTES,
                    "a text file with the angle of every column, positive to the right [degree]",
                )
            )
            .replace(",", " ")
            .split()
        )
        found = "words" if cells is None else f"{len(cells)} numbers"
        FormatError.raise_if(
            cells is None or len(cells) != columns,
            f"{path}: {found}",
            expected=f"{columns} angles [degree], one for every column",
            code="length-mismatch",
        )
        angles = np.asarray(cells, np.float64)
    elif "fov_deg" in geometry and "roll" in line.variables:
        convention = Convention.from_attrs(line.attrs)
        if convention is None or convention.column_order is None:
            raise SchemaError(
                "[geometry] fov_deg without the order of columns",
                mend='declare [navigation] column_order = "left_to_right" or "right_to_left"',
                code="column-order-missing",
            )
        camera = PinholeCamera(line.sizes[CROSS_TRACK], field_of_view=geometry["fov_deg"], edges="outer")
        angles = camera.look_across(convention.column_order)
    else:
        return line.assign_attrs(attrs)
    return line.assign_coords(
        look_across=label(xr.DataArray(angles, dims=(CROSS_TRACK,)), "look_across")
    ).assign_attrs(attrs)


_MAX_ANGLE_FILE_BYTES = 2**20


def check_collect(path: str | os.PathLike[str], *, passed: bool = False) -> tuple[Finding, ...]:
    """Return findings of implausible inputs of a collect, from samples of its cubes and all records.

    Reflectance of the samples is judged as well, by level, colour and pattern. Conventions of the navigation
    and clocks are tested on the picture of one line. ``passed`` adds the judgements of the product that
    passed, with their values.

    Raises `CollectError` if the collect or one of its files cannot be opened; all problems are listed.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> path = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6)
    >>> check_collect(path)
    ()
    """
    needs_irradiance = read_collect(path, need_irradiance=False).irradiance is not None
    texts: tuple[str, ...] = ()
    try:
        with warnings.catch_warnings(record=True, action="always") as caught:
            opened = opened_collect(path, need_irradiance=needs_irradiance)
        findings = list(itertools.chain(*_findings(opened, opened.members, lit=needs_irradiance).values()))
        texts = tuple(finding.found for finding in findings if finding.line == RECORD)
    finally:
        # a fault of the record is a finding where a line uses it, and a warning otherwise
        for each in caught:
            if not any(text in str(each.message) for text in texts):
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    lines = {name: opened.tree[name].to_dataset() for name in opened.members}
    for line, found in navigation_findings(lines):
        kind = KINDS["navigation-clock" if "clock" in found.field else "navigation-convention"]
        text = f"{found.field} {found.declared}: {found.evidence}"
        findings.append(Finding(kind, str(lines[line].attrs["name"]), text, found.likely))
    if needs_irradiance:
        findings += itertools.chain(*(_panel_findings(line) for line in lines.values()))
    return tuple(finding for finding in findings if passed or not finding.passes)


def _panel_findings(line: xr.Dataset) -> Iterator[Finding]:
    # Measure the panels that a line declares; processing refuses or warns of the same.
    name = str(line.attrs["name"])
    for panel in declared_panels(line) if "wavelength" in line.coords else ():
        with warnings.catch_warnings(record=True, action="always", category=PaintWarning) as caught:
            closure = panel_closure(line, panel).compute()
        factor = float(closure["panel_factor"].median())
        texts = [
            str(each.message) for each in caught if getattr(each.message, "code", "") == "panel-doubtful"
        ]
        has_scale = line.attrs.get("absolute_scale") != "unknown"
        is_other = has_scale and max(factor, 1.0 / factor) > RULES.most_factor
        kind = KINDS["panel-level" if is_other else "panel-doubtful"]
        found = texts[0].rpartition(" [")[0] if texts else f"a panel measures {factor:.3f} of its certificate"
        yield Finding(kind, name, found, "1 within its uncertainty", passes=not texts)


def refuse_findings(
    opened: OpenedCollect, lines: Iterable[str], accept: Collection[str], *, lit: bool
) -> dict[str, dict[str, Any]]:
    # Check flight lines of an opened collect, named by their groups; return what was accepted and passed.
    #
    # ``accept``: names of accepted findings. ``lit``: whether reflectance is computed, which needs
    # irradiance.
    #
    # Returns by group the attributes for the store: accepted findings of a line, and judgements that it
    # passed. Raises `CollectError`
    # for findings that would make results wrong; all are listed. Warns (`PaintWarning`) of other findings.
    with Problems(f"{opened.settings.path} is implausible, and is not processed", CollectError) as problems:
        accepted: dict[str, dict[str, Any]] = {}
        for group, findings in _findings(
            opened, [name for name in lines if name in opened.members], lit=lit
        ).items():
            for finding in findings:
                if finding.passes:
                    accepted.setdefault(group, {}).setdefault("passed_checks", []).append(
                        f"{finding.found}; expected {finding.expected}"
                    )
                elif finding.kind.name in accept:
                    accepted.setdefault(group, {}).setdefault("accepted_findings", []).append(str(finding))
                elif finding.kind.refused:
                    problems.extend([finding.problem(acceptable=True)])
                elif finding.line != RECORD:  # whose faults were told when it was opened
                    warn_user(str(replace(finding.problem(), code="")), finding.kind.name)
    return accepted


def _findings(opened: OpenedCollect, lines: Iterable[str], *, lit: bool) -> dict[str, list[Finding]]:
    # findings on a dark cube or the record are listed with the first line that uses it
    cubes = {str(entry.name): entry for entry in opened.settings.flightlines}
    findings: dict[str, list[Finding]] = {}
    darks: set[Path] = set()
    listed: set[str] = set()
    for name in lines:
        members = tuple(cubes[member] for member in opened.members[name])
        line = opened.tree[name].to_dataset()
        judged = judge_line(line, members, lit=lit and not has_white(line))
        findings[name] = [each for each in judged if each.line != RECORD or each.found not in listed]
        listed |= {each.found for each in findings[name]}
        dark = members[0].dark if "counts" in opened.tree[name] else None
        for path in dark if isinstance(dark, tuple) else ():
            if path not in darks:
                findings[name] += judge_dark_cube(path)
                darks.add(path)
    return findings
