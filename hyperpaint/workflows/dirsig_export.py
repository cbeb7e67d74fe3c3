"""A scene file as a DIRSIG scene, painted with a measured library."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.mirrored_light import EXCLUDED

if TYPE_CHECKING:
    from .scene_parts import RenderParts

_GRID_NM = np.arange(380.0, 1051.0, 2.0)  # wavelengths on which built-in spectra are written


def export_dirsig_scene(
    scene_file: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    library: xr.Dataset | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    r"""Write the scene of a ``scene.toml`` for DIRSIG.

    Parameters
    ----------
    scene_file
        A scene file of `hyperpaint.render_scene`; its ``[paints]`` repaint materials and cars.
    folder
        A folder, new or empty.
    library
        Measured paints, which take precedence over the file's ``[spectra]`` and over built-in spectra of the
        same name. Paints that are not named in the scene are assigned in turn to the cars without another
        repaint.
    overwrite, progress, **options
        As for `hyperpaint.io.dirsig.write_dirsig_scene`.

    Returns
    -------
    Dataset
        The written materials, as returned by `hyperpaint.io.dirsig.write_dirsig_scene`.

    Raises
    ------
    FormatError, SchemaError, StoreError
        As `hyperpaint.render_scene` and `hyperpaint.io.dirsig.write_dirsig_scene`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "lawn.toml")
    ...     text = '[scene]\nkind = "plane"\nspectrum = "grass"\n[platform]\nlines = 2\ncolumns = 2\n'
    ...     _ = path.write_text(text + "ground_sample_m = 0.1\naltitude_m = 15.0\n")
    ...     export_dirsig_scene(path, Path(folder, "out")).material_id.values.tolist()
    ['grass']
    """
    from hyperpaint.io.dirsig import write_dirsig_scene
    from hyperpaint.simulation.settings import ORIGIN

    from .scene_files import read_scene_file
    from .scene_parts import build_parts

    file = read_scene_file(Path(scene_file))
    parts = build_parts(file)
    repaint = dict(file.paints)
    libraries = [] if library is None else [library]
    if library is not None:
        repaint = assigned_paints(parts.scene, list(map(str, library["signature"].values)), repaint)
    libraries += [*named_libraries(parts.spectra), _spectra_library(parts, repaint)]
    return write_dirsig_scene(
        parts.scene,
        folder,
        libraries,
        repaint=repaint,
        origin=ORIGIN,
        overwrite=overwrite,
        progress=progress,
        **options,
    )


def assigned_paints(scene: Any, names: Sequence[str], repaint: Mapping[str, str]) -> dict[str, str]:
    """Return new paints by instance: ``repaint``, and other ``names`` in turn for cars without a repaint.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.car_parks import car_park
    >>> scene = car_park(length=5.0, width=16.0, neighbours=(), seed=1)
    >>> [instance.paint for instance in scene.instances if instance.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> assigned_paints(scene, ["yellow", "roof 7", "roof 8"], {"car_000": "roof 8"})
    {'car_000': 'roof 8', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    scene_names = {item.name for item in (*scene.materials, *scene.instances)}
    scene_names |= {item.spectrum for item in scene.materials} | set(repaint.values())
    new_paints = [name for name in names if name not in scene_names]
    cars = [
        item.name
        for item in scene.instances
        if item.kind == "car" and item.name not in repaint and not {item.paint} & {*names, *repaint}
    ]
    return {
        **repaint,
        **{car: new_paints[number % len(new_paints)] for number, car in enumerate(cars) if new_paints},
    }


def named_libraries(spectra: Mapping[str, Any]) -> list[xr.Dataset]:
    """Return the paint libraries among spectra; paints are "<key>/<name>", a single paint also "<key>"."""
    libraries = []
    for key, value in spectra.items():
        if hasattr(value, "data_vars"):
            names = [str(name) for name in value["signature"].values]
            libraries.append(value.assign_coords(signature=[f"{key}/{name}" for name in names]))
            if len(names) == 1:
                libraries.append(value.assign_coords(signature=[key]))
    return libraries


def _spectra_library(parts: RenderParts, repaint: Mapping[str, str]) -> xr.Dataset:
    # spectra of the file and built-in spectra as a library; DIRSIG has no flakes, so that the reflectance of
    # a paint with flakes is the sum of pigment and flakes
    from hyperpaint.simulation.rendering.scene_spectra import spectrum_of

    flakes = {
        material.spectrum: material.flakes
        for material in parts.scene.materials
        if material.flakes is not None
    }
    names = [material.spectrum for material in parts.scene.materials] + list(repaint.values())
    spectra: dict[str, Floats] = {}
    for name in dict.fromkeys(names):
        file_spectrum: Any = parts.spectra.get(name)
        if file_spectrum is not None and not hasattr(file_spectrum, "data_vars"):
            wavelength, values = file_spectrum
            spectra[name] = np.interp(_GRID_NM, wavelength, values, left=np.nan, right=np.nan)
            continue
        try:
            body = spectrum_of(name)(_GRID_NM)
        except SchemaError:
            continue  # a paint of the library; the writer reports unknown names
        flake = flakes.get(name)
        if flake is not None:
            body = (1.0 - flake.share) * body + flake.share * spectrum_of(flake.spectrum)(_GRID_NM)
        spectra[name] = body
    reflectance = np.array(list(spectra.values()), np.float32).reshape(-1, len(_GRID_NM))
    return xr.Dataset(
        {"reflectance": (("signature", "band"), reflectance, {"units": "1", "mirror_reflection": EXCLUDED})},
        {
            "signature": np.array(list(spectra), object),
            "wavelength": ("band", _GRID_NM, {"units": "nm"}),
        },
    )
