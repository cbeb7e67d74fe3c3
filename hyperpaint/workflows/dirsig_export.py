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
    from .scene_parts import Parts

_GRID_NM = np.arange(380.0, 1051.0, 2.0)  # of spectra that are formulas


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
        As `hyperpaint.render_scene` takes it; its ``[paints]`` repaint.
    folder
        New or empty.
    library
        Measured paints, which go before the file's ``[spectra]`` and before the built-in spectra of the same
        name. Those that have no name of the scene are dealt in turn to the cars that nothing else paints.
    overwrite, progress, **options
        As for `hyperpaint.io.dirsig.write_dirsig_scene`.

    Returns
    -------
    Dataset
        What was written, as `hyperpaint.io.dirsig.write_dirsig_scene` says it.

    Raises
    ------
    FormatError, SchemaError, StoreError
        As `hyperpaint.render_scene` and `hyperpaint.io.dirsig.write_dirsig_scene`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as place:
    ...     path = Path(place, "lawn.toml")
    ...     text = '[scene]\nkind = "plane"\nspectrum = "grass"\n[platform]\nlines = 2\ncolumns = 2\n'
    ...     _ = path.write_text(text + "ground_sample_m = 0.1\naltitude_m = 15.0\n")
    ...     export_dirsig_scene(path, Path(place, "out")).material_id.values.tolist()
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
        repaint = dealt_paints(parts.scene, list(map(str, library["signature"].values)), repaint)
    libraries += [*named_libraries(parts.spectra), _formulas(parts, repaint)]
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


def dealt_paints(scene: Any, names: Sequence[str], repaint: Mapping[str, str]) -> dict[str, str]:
    """Return the paints of things: those that are said, and the rest of ``names`` in turn on the other cars.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.car_parks import car_park
    >>> scene = car_park(length=5.0, width=16.0, neighbours=(), seed=1)
    >>> [one.paint for one in scene.instances if one.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> dealt_paints(scene, ["yellow", "roof 7", "roof 8"], {"car_000": "roof 8"})
    {'car_000': 'roof 8', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    known = {each.name for each in (*scene.materials, *scene.instances)}
    known |= {each.spectrum for each in scene.materials} | set(repaint.values())
    rest = [name for name in names if name not in known]
    cars = [
        each.name
        for each in scene.instances
        if each.kind == "car" and each.name not in repaint and not {each.paint} & {*names, *repaint}
    ]
    return {**repaint, **{car: rest[number % len(rest)] for number, car in enumerate(cars) if rest}}


def named_libraries(spectra: Mapping[str, Any]) -> list[xr.Dataset]:
    """Return the paint libraries among a file's spectra; paints are "<key>/<name>", or "<key>" if alone."""
    libraries = []
    for key, value in spectra.items():
        if hasattr(value, "data_vars"):
            names = [str(name) for name in value["signature"].values]
            libraries.append(value.assign_coords(signature=[f"{key}/{name}" for name in names]))
            if len(names) == 1:
                libraries.append(value.assign_coords(signature=[key]))
    return libraries


def _formulas(parts: Parts, repaint: Mapping[str, str]) -> xr.Dataset:
    # spectra of the file and built-in ones; the reflectance of a paint with flakes is the sum of pigment and
    # flakes, since DIRSIG has no flakes

    from hyperpaint.simulation.rendering.scene_spectra import spectrum_of

    flakes = {each.spectrum: each.flakes for each in parts.scene.materials if each.flakes is not None}
    names = [each.spectrum for each in parts.scene.materials] + list(repaint.values())
    spectra: dict[str, Floats] = {}
    for name in dict.fromkeys(names):
        given: Any = parts.spectra.get(name)
        if given is not None and not hasattr(given, "data_vars"):
            wavelength, values = given
            spectra[name] = np.interp(_GRID_NM, wavelength, values, left=np.nan, right=np.nan)
            continue
        try:
            body = spectrum_of(name)(_GRID_NM)
        except SchemaError:
            continue  # of the library, or unknown, of which the writer says more
        mixed = flakes.get(name)
        if mixed is not None:
            body = (1.0 - mixed.share) * body + mixed.share * spectrum_of(mixed.spectrum)(_GRID_NM)
        spectra[name] = body
    reflectance = np.array(list(spectra.values()), np.float32).reshape(-1, len(_GRID_NM))
    return xr.Dataset(
        {"reflectance": (("signature", "band"), reflectance, {"units": "1", "mirror_reflection": EXCLUDED})},
        {
            "signature": np.array(list(spectra), object),
            "wavelength": ("band", _GRID_NM, {"units": "nm"}),
        },
    )
