"""The accessor is a spelling: same signatures, same results, no state."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

import hyperpaint as hp
from hyperpaint import alignment
from hyperpaint import surroundings as scene_model
from hyperpaint.accessor import PaintAccessor
from hyperpaint.base import units
from hyperpaint.base.errors import StoreError
from hyperpaint.geometry import georeference, orthorectification
from hyperpaint.io import store
from hyperpaint.paints import signatures
from hyperpaint.pictures import plot, plot_flags, plot_spectra
from hyperpaint.radiometry import bands, smoothing
from hyperpaint.radiometry import counts_to_reflectance as radiometry
from hyperpaint.regions import proposals
from hyperpaint.simulation.rendering import relighting
from hyperpaint.surroundings import flags, sun_and_sky

FUNCTIONS: dict[str, Callable[..., Any]] = {
    "radiance": radiometry.radiance,
    "reflectance": radiometry.reflectance,
    "smooth": smoothing.smooth,
    "at": bands.at,
    "to_nominal": bands.to_nominal,
    "align_to_irradiance": alignment.align_to_irradiance,
    "apply_alignment": alignment.apply_alignment,
    "oxygen_residual": alignment.oxygen_residual,
    "relight": relighting.relight,
    "survey": scene_model.survey,
    "flag": flags.flag,
    "remove_mirrored_sky": sun_and_sky.remove_mirrored_sky,
    "correct_light": sun_and_sky.correct_light,
    "propose_regions": proposals.propose_regions,
    "signatures": signatures.extract_signatures,
    "locate": georeference.locate,
    "orthorectify": orthorectification.orthorectify,
    "rgb": plot.rgb,
    "quicklook": plot.quicklook,
    "spectrum": plot_spectra.spectrum,
    "triptych": plot_spectra.triptych,
    "flag_overlay": plot_flags.flag_overlay,
    "quantify": units.quantify,
    "verify": store.verify,
}


def test_no_method_without_a_function() -> None:
    public = {name for name in vars(PaintAccessor) if not name.startswith("_")}
    assert public == set(FUNCTIONS)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_signatures_are_those_of_the_functions(name: str) -> None:
    method = inspect.signature(getattr(PaintAccessor, name))
    function = inspect.signature(FUNCTIONS[name])
    mine = [p for p in list(method.parameters.values())[1:] if p.name != "dims"]
    theirs = list(function.parameters.values())[1:]
    assert [(p.name, p.kind, p.default) for p in mine] == [(p.name, p.kind, p.default) for p in theirs]
    for own, other in zip(mine, theirs, strict=True):
        assert str(own.annotation) == str(other.annotation)
    assert getattr(PaintAccessor, name).__doc__


def test_accessor_asks_nothing_of_a_dataset() -> None:
    # a check in the constructor would make hasattr() raise
    assert hasattr(xr.Dataset(), "paint")
    assert hasattr(xr.Dataset({"a": 1}), "paint")


def test_it_follows_changes_in_place() -> None:
    line = flight().line
    first = line.paint.reflectance().reflectance.values
    line["radiance_gain"] = (line.radiance_gain * 2).assign_attrs(line.radiance_gain.attrs)
    np.testing.assert_allclose(line.paint.reflectance().reflectance.values, 2 * first, rtol=1e-6)


def test_dims_by_hand() -> None:
    line = flight().line
    other = line.rename_dims(along_track="t", band="b", cross_track="c")
    made = other.paint.reflectance(dims={"along_track": "t", "band": "b", "cross_track": "c"})
    np.testing.assert_array_equal(made.reflectance, line.paint.reflectance().reflectance)
    assert other.counts.dims == ("t", "b", "c")


def test_functions_and_accessor_agree() -> None:
    line = flight().line
    xr.testing.assert_identical(line.paint.reflectance(), hp.reflectance(line))
    xr.testing.assert_identical(line.paint.radiance(), hp.radiance(line))


def test_corrections_in_one_line() -> None:
    line = flight(lines=8, columns=4).line.paint.reflectance()
    bare = line.paint.remove_mirrored_sky(sun_zenith=30.0)
    xr.testing.assert_identical(bare, hp.remove_mirrored_sky(line, sun_zenith=30.0))
    options = {"direct": 0.9, "sky_view_factor": 0.8, "sun_zenith": 30.0}
    xr.testing.assert_identical(bare.paint.correct_light(**options), hp.correct_light(bare, **options))


def test_verify_finds_the_store_of_a_dataset(tmp_path: Path) -> None:
    line = flight().line
    hp.to_store(line, tmp_path / "lot.zarr", "flightlines/raw_0")
    opened = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    assert opened.paint.verify() == hp.verify(tmp_path / "lot.zarr")
    (tmp_path / "lot.zarr/flightlines/raw_0/counts/c/0/0/0").unlink()
    assert not opened.paint.verify().ok
    with pytest.raises(StoreError, match=r"hyperpaint\.verify\(path\)"):
        line.paint.verify()
