"""A whole collect as one tree: every flight line that a ``collect.toml`` names, opened lazily."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import CollectError, Findings, Problems, Unavailable
from hyperpaint.io.flightline.calibration_store import open_calibration
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs, assemble
from hyperpaint.io.flightline.timing import Timing
from hyperpaint.io.navigation.navigation_records import Navigation, read_imu_gps
from hyperpaint.io.spectrometers.reference_files import open_spectra

from .collect_toml import (
    Camera,
    Collect,
    FlightlineEntry,
    IrradianceEntry,
    ReferenceEntry,
    parse_collect,
    read_collect,
)

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Collect", "OpenedCollect", "open_collect", "open_with_settings", "read_collect"]


@dataclass(frozen=True)
class OpenedCollect:
    """A collect that has been opened, with what its ``collect.toml`` says."""

    tree: xr.DataTree
    settings: Collect

    @property
    def cubes(self) -> dict[str, Path]:
        """Data file of every flight line, by the line's group (``flightlines/<id>``)."""
        from hyperpaint.io.envi.envi_cubes import find_pair

        return {f"flightlines/{entry.id}": find_pair(entry.cube)[1] for entry in self.settings.flightlines}


def open_collect(
    path: str | os.PathLike[str],
    *,
    need_irradiance: bool = True,
    chunks: Any = "auto",
    calibrate: Callable[[Path], xr.Dataset] | None = None,
) -> xr.DataTree:
    """Open everything a ``collect.toml`` names, see `hyperpaint.open_collect`, which brings ``calibrate``."""
    options: Any = {"need_irradiance": need_irradiance, "chunks": chunks, "calibrate": calibrate}
    return open_with_settings(path, **options).tree


def open_with_settings(
    source: str | os.PathLike[str] | Collect,
    *,
    need_irradiance: bool = True,
    chunks: Any = "auto",
    calibrate: Callable[[Path], xr.Dataset] | None = None,
) -> OpenedCollect:
    """Open everything a ``collect.toml`` names, without reading a cube, and keep what it says.

    Parameters
    ----------
    source
        The file, or its settings where it has been read and checked before.
    need_irradiance, chunks
        See `hyperpaint.open_collect`.
    calibrate
        Turns the path of a lab sweep into a calibration.

    Raises
    ------
    CollectError
        The file, or anything it names, cannot be used; all problems of all files are listed.
    """
    import xarray as xr

    path = source.path if isinstance(source, Collect) else Path(source)
    problems = Problems(f"{path} cannot be processed", CollectError)
    reported: set[str] = set()
    if isinstance(source, Collect):
        collect = source
    else:
        collect, reported = parse_collect(path, problems, need_irradiance=need_irradiance)
    findings = Findings(str(path))
    calibration: xr.Dataset | Unavailable | None = None
    if collect.calibration is not None or "calibration" in reported:
        calibration = Unavailable.REPORTED
    if collect.calibration is not None:
        with findings.step():
            calibration = open_calibration(collect.calibration)
    if collect.sweep is not None:
        calibration = Unavailable.REPORTED
        with findings.step():
            calibration = _calibrated(collect.sweep, calibrate)
    irradiance: xr.Dataset | Unavailable | None = Unavailable.REPORTED
    with findings.step():
        irradiance = _open_irradiance(collect.irradiance)
    navigation = dict(_navigation(collect, findings))
    lines: dict[str, xr.Dataset] = {}
    for entry in collect.flightlines:
        own = Findings(entry.id)
        inputs = _inputs(collect, entry, reported, navigation)
        inputs = replace(inputs, calibration=calibration, irradiance=irradiance, chunks=chunks)
        lines[entry.id] = assemble(inputs, own)
        findings.errors += own.errors
    references = dict(_references(collect.references, findings))
    # what several lines share is reported once
    for text in dict.fromkeys(str(error) for error in findings.errors):
        problems.add(text)
    problems.raise_if_any()
    groups: dict[str, xr.Dataset] = {"/": xr.Dataset(attrs={"name": collect.name, "source": path.name})}
    groups |= {f"/flightlines/{name}": line for name, line in lines.items()}
    if isinstance(irradiance, xr.Dataset):
        groups["/irradiance"] = irradiance
    if isinstance(calibration, xr.Dataset):
        groups["/calibration"] = calibration
    groups |= {f"/references/{name}": dataset for name, dataset in references.items()}
    return OpenedCollect(xr.DataTree.from_dict(groups), collect)


def _calibrated(sweep: Path, calibrate: Callable[[Path], xr.Dataset] | None) -> xr.Dataset:
    if calibrate is None:
        raise CollectError(
            f"{sweep}: a lab sweep, for which open_collect needs calibrate=; hyperpaint.open_collect has it"
        )
    return open_calibration(calibrate(sweep))


def _open_irradiance(entry: IrradianceEntry | None) -> xr.Dataset | None:
    if entry is None or not entry.files:
        return None
    from hyperpaint.io.spectrometers.irradiance import open_irradiance

    files: Any = list(entry.files) if len(entry.files) > 1 else entry.files[0]
    return open_irradiance(files, **entry.options)


def _references(entries: tuple[ReferenceEntry, ...], findings: Findings) -> Iterator[tuple[str, xr.Dataset]]:
    """Open the files of each field spectrometer: one instrument has one set of wavelengths."""
    for entry in entries:
        if not entry.files:  # which has been reported
            continue
        with findings.step():
            opened = open_spectra(entry.files)
            if len(opened) > 1:
                raise CollectError(
                    f"[[references]] {entry.instrument!r}: files of {len(opened)} kinds of instruments; give "
                    "each its own [[references]]"
                )
            label = {} if entry.group == entry.instrument else {"instrument_name": entry.instrument}
            yield entry.group, opened[0].assign_attrs(label)


def _navigation(collect: Collect, findings: Findings) -> Iterator[tuple[Path, Navigation]]:
    """Read each navigation file once; the cubes of one flight share it."""
    camera = collect.camera
    for path in dict.fromkeys(entry.nav for entry in collect.flightlines):
        if path is not None:
            with findings.step():
                yield path, read_imu_gps(path, _timing(camera).correction)


def _timing(camera: Camera, **line: Any) -> Timing:
    return Timing(
        stamp=camera.stamp,
        clock_offset_s=camera.clock_offset_s,
        time_scale="gps" if camera.time_scale == "gps" else "utc",
        gps_leap_seconds=camera.gps_leap_seconds,
        **line,
    )


def _inputs(
    collect: Collect, entry: FlightlineEntry, reported: set[str], navigation: Mapping[Path, Navigation]
) -> FlightlineInputs:
    camera = collect.camera
    timing: Timing | Unavailable = Unavailable.REPORTED
    if f"times of {entry.id}" not in reported and (entry.nav is None or entry.nav in navigation):
        timing = _timing(
            camera,
            frame_index=entry.frame_index,
            nav=None if entry.nav is None else navigation[entry.nav],
            gps_time=entry.gps_time,
            date=entry.date,
            start_time=entry.start_time,
            frame_period=entry.frame_period or camera.frame_period,
        )
    exposure = camera.exposure_time if entry.exposure_time is None else entry.exposure_time
    attrs = {"collect": collect.name} | ({} if exposure is None else {"exposure_source": collect.path.name})
    dark: Any = list(collect.dark) if isinstance(collect.dark, tuple) else collect.dark
    return FlightlineInputs(
        cube=entry.cube,
        timing=timing,
        exposure_time=exposure,
        dark=Unavailable.REPORTED if "dark" in reported else dark,
        bit_depth=camera.bit_depth,
        saturation_count=camera.saturation_count,
        radiance_units=camera.radiance_units,
        fwhm_nm=camera.fwhm_nm,
        name=entry.id,
        keep_whole_lines=entry.keep_whole_lines,
        attrs=attrs,
        convention=collect.navigation,
    )
