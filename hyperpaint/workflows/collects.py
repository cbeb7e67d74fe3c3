"""Opening of collects, with their geometry and white references, and calibration of lab sweeps."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    CROSS_TRACK,
    CollectError,
    Convention,
    Floats,
    FormatError,
    SchemaError,
    documented,
    label,
    one_of,
)
from hyperpaint.geometry.georeference.locating import PinholeCamera
from hyperpaint.io.collect.collect_toml import Collect, OpenedCollect, WhiteEntry, open_with_settings
from hyperpaint.io.files.reading import decoded_text, numbers, read_limited_text
from hyperpaint.io.flightline.calibration_store import open_sweep
from hyperpaint.io.flightline.flightline_opening import Reference, Timing, read_reference
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate, read_panel_table
from hyperpaint.io.store import to_store
from hyperpaint.light.aircraft_receiver import level_irradiance
from hyperpaint.pictures.figures import check_picture
from hyperpaint.radiometry import white_reference


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
    return calibration.assign_attrs(sweep=Path(path).name)


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
        Path(out).resolve() == Path(sweep).resolve(),
        f"{out} is the sweep itself",
        mend="choose another path for the calibration",
        code="output-is-input",
    )
    if picture is not None:
        check_picture(Path(picture))
    calibration = calibrate_sweep(sweep, progress=progress, **options)
    to_store(calibration, Path(out), overwrite=overwrite)
    if picture is not None:
        from hyperpaint.pictures.plot import calibration_report

        calibration_report(calibration, open_sweep(sweep), Path(picture))
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
    opened = open_with_settings(
        collect,
        need_irradiance=need_irradiance,
        chunks=chunks,
        calibrate=calibrate_sweep,
        mount=_with_geometry,
        level=level_irradiance,
        whiten=_by_white(),
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


def _by_white() -> Callable[[xr.Dataset, WhiteEntry], xr.Dataset]:
    # Return a function that calibrates a line by [reference]; the cubes of the white are read once.
    references: list[Reference] = []

    def whiten(line: xr.Dataset, entry: WhiteEntry) -> xr.Dataset:
        if not references:
            references.extend(read_reference(path, Timing(), None, "white") for path in entry.cubes)
        return white_reference(line, references, **entry.options)

    return whiten


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
        angles = _column_angles(geometry["look_angle"], line.sizes[CROSS_TRACK])
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


def _column_angles(path: Path, columns: int) -> Floats:
    # angle of every column, positive to the right [degree]
    content = "a text file with the angle of every column, positive to the right [degree]"
    angles = numbers(
        decoded_text(read_limited_text(path, _MAX_ANGLE_FILE_BYTES, content)).replace(",", " ").split()
    )
    found = "words" if angles is None else f"{len(angles)} numbers"
    FormatError.raise_if(
        angles is None or len(angles) != columns,
        f"{path}: {found}",
        expected=f"{columns} angles [degree], one for every column",
        code="length-mismatch",
    )
    return np.asarray(angles, np.float64)
