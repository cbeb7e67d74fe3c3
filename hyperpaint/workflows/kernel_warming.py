"""Compile the kernels of usual work before they are needed: by doing a little of it, on a small scene.

A kernel is compiled for the types of its arguments and for what is None among them, so that work itself is
the surest list of what work takes.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Progress
from hyperpaint.base.constants import KEPT_BITS
from hyperpaint.base.errors import PaintWarning, StoreError

_SCENE = """
[scene]
kind = "car_park"
length_m = 12.0
[platform]
lines = 24
columns = 24
altitude_m = 15.0
ground_sample_m = 0.4
[camera]
bands = 12
smile_nm = 0.5
[[atmospheres]]
preset = "noon"
[sampling]
samples = 1
"""
_LINE = "flightlines/raw_0"


class Warmth(NamedTuple):
    """Compiled kernels on disk."""

    folder: Path  #: Of those of one module; the others' are beside it
    kernels: int  #: Compiled by this call; 0 where all were there
    processor: str  #: That they are compiled for


def warm_kernels(progress: Progress | None = None) -> Warmth:
    """Compile the kernels of reflectance, smoothing, flags, maps, signatures and renders, on disk."""
    from numba.core.registry import cpu_target

    from hyperpaint.kernels.radiometry import calibrate_slab

    cache: Any = getattr(calibrate_slab, "_cache", None)
    place = getattr(cache, "cache_path", None)
    mend = "set NUMBA_CACHE_DIR to a folder that can be written, and NUMBA_DISABLE_JIT to nothing"
    if place is None:
        raise StoreError(f"there is no folder for compiled kernels; {mend}", code="cache-folder-missing")
    with tempfile.TemporaryDirectory(prefix="hyperpaint-warm-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        warnings.filterwarnings("error", "compiled kernels cannot be kept", PaintWarning)
        try:
            before = _on_disk(Path(place))
            for done, job in enumerate(_JOBS):
                if progress is not None:
                    progress(done, len(_JOBS))
                job(Path(folder))
        except PaintWarning as refusal:
            raise StoreError(str(refusal), code="cache-folder-refused") from refusal
    if progress is not None:
        progress(len(_JOBS), len(_JOBS))
    triple, processor, _ = cpu_target.target_context.codegen().magic_tuple()
    return Warmth(Path(place), _on_disk(Path(place)) - before, f"{processor} ({triple})")


def _on_disk(place: Path) -> int:
    # .../kernels_<hash> beside .../transport_<hash>, or .../kernels/__pycache__ in the package
    above = place.parents[1] if place.name == "__pycache__" else place.parent
    return sum(1 for _ in above.rglob("*.nbc"))


# --- a little of the work


def _simulate(folder: Path) -> None:
    from hyperpaint.simulation.collect import simulate_collect

    simulate_collect(folder / "lot", lines=64, bands=40, columns=48, samples=1, truth=False)


def _process(folder: Path) -> None:
    from .pipeline import process

    process(folder / "lot" / "collect.toml", folder / "lot.zarr")


def _calibrate(_: Path) -> None:
    from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
    from hyperpaint.radiometry.pixel_reading import pixels
    from hyperpaint.simulation.collect import simulate_line

    for smile in (0.0, 0.5):
        line = simulate_line(lines=8, bands=12, columns=6, smile_nm=smile)
        pixels(line, 3, 4)
        pixels(line, wavelength=550.0)
        for bits in (None, KEPT_BITS):
            reflectance(line, keep_bits=bits).compute(scheduler="sync")
            reflectance(line, keep_bits=bits, uncertainty=True).compute(scheduler="sync")
    radiance(line).compute(scheduler="sync")


def _smooth(_: Path) -> None:
    import dask

    from hyperpaint.radiometry.spectral_axis import smooth, to_nominal
    from hyperpaint.simulation.collect import simulate_line

    line = simulate_line(lines=8, bands=24, columns=6, smile_nm=0.5)
    spectra = line.paint.reflectance()
    dask.compute(smooth(spectra), smooth(spectra, "box"), to_nominal(spectra), scheduler="sync")


def _look(folder: Path) -> None:
    import xarray as xr

    line = xr.open_zarr(folder / "lot.zarr", group=_LINE)
    line.paint.flag(line.paint.survey())["quality"].compute(scheduler="sync")
    line.paint.rgb().compute(scheduler="sync")
    mapped = {"variables": ["reflectance", "quality"], "ground": 160.0}
    for method in ("nearest", "bilinear"):
        line.paint.orthorectify(method=method, **mapped).compute(scheduler="sync")


def _extract(folder: Path) -> None:
    import xarray as xr

    from hyperpaint.paints.signatures import extract_signatures
    from hyperpaint.regions import Region, Regions

    line = xr.open_zarr(folder / "lot.zarr", group=_LINE)
    corners = np.array([(0.0, 0.0), (0.0, 40.0), (40.0, 40.0), (40.0, 0.0)])
    extract_signatures(line, Regions((Region("any", corners),)))


def _render(folder: Path) -> None:
    from .rendering import render_scene

    (folder / "scene.toml").write_text(_SCENE)
    render_scene(folder / "scene.toml", folder / "scene.zarr")


_JOBS: tuple[Callable[[Path], None], ...] = (
    _simulate, _process, _calibrate, _smooth, _look, _extract, _render,
)  # fmt: skip
