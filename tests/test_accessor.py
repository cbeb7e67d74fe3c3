"""The accessor is a spelling: same signatures, same results, no state."""

from __future__ import annotations

import ast
import copy
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support import accessor_stub
from support.refusals import expect_error, expect_errors, expect_words
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.accessor import METHODS, PaintAccessor
from hyperpaint.base.errors import StoreError


def function_of(name: str) -> Callable[..., Any]:
    room, _, function = METHODS[name].partition(":")
    found: Callable[..., Any] = getattr(getattr(hp, room), function or name)
    return found


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_its_function_with_the_dataset_given(name: str) -> None:
    function = function_of(name)
    method = getattr(xr.Dataset().paint, name)
    mine = [p for p in inspect.signature(method).parameters.values() if p.name != "dims"]
    assert mine == list(inspect.signature(function).parameters.values())[1:]
    assert inspect.getdoc(method).startswith(inspect.getdoc(function))
    assert next(iter(inspect.signature(getattr(PaintAccessor, name)).parameters)) == "self"


def test_editors_see_the_methods_as_they_are() -> None:
    pytest.importorskip("ruff")
    assert ast.dump(ast.parse(accessor_stub.STUB.read_text(encoding="utf-8"))) == ast.dump(
        ast.parse(accessor_stub.formatted(accessor_stub.stub()))
    )


TYPED = """
from typing import TYPE_CHECKING, cast
import xarray as xr
import hyperpaint as hp

if TYPE_CHECKING:
    from hyperpaint.accessor import PaintDataset

line = cast("PaintDataset", xr.open_zarr("lot.zarr", group="flightlines/raw_0"))
reveal_type(line.paint.reflectance().paint.rgb())
line.paint.reflectance(uncertainly=True)
"""


#: Other modules than the accessor and xarray are not read, which would take most of the time. mypy strips no
#: blanks between patterns.
MYPY = """
[mypy-hyperpaint.*,numpy.*,pandas.*,dask.*,zarr.*,distributed.*,pint.*,scipy.*,matplotlib.*,fsspec.*,IPython.*]
follow_imports = skip
ignore_missing_imports = True
[mypy-hyperpaint.accessor]
follow_imports = normal
"""


@pytest.mark.slow
def test_mypy_knows_the_accessor(tmp_path: Path) -> None:
    api = pytest.importorskip("mypy.api")
    script, config = tmp_path / "script.py", tmp_path / "mypy.ini"
    script.write_text(TYPED)
    config.write_text(f"[mypy]{MYPY}")
    text, _, status = api.run(["--config-file", str(config), "--cache-dir", str(tmp_path), str(script)])
    assert status == 1
    expect_words(text, "xarray.core.dataarray.DataArray", 'Unexpected keyword argument "uncertainly"')


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
    xr.testing.assert_identical(bare, hp.surroundings.remove_mirrored_sky(line, sun_zenith=30.0))
    options = {"direct": 0.9, "sky_view_factor": 0.8, "sun_zenith": 30.0}
    xr.testing.assert_identical(
        bare.paint.correct_light(**options), hp.surroundings.correct_light(bare, **options)
    )


def test_verify_finds_the_store_of_a_dataset(tmp_path: Path) -> None:
    line = flight().line
    hp.to_store(line, tmp_path / "lot.zarr", "flightlines/raw_0")
    opened = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    assert opened.paint.verify() == hp.verify(tmp_path / "lot.zarr")
    (tmp_path / "lot.zarr/flightlines/raw_0/counts/c/0/0/0").unlink()
    assert not opened.paint.verify().ok
    caught = expect_error(StoreError, "store-unknown", lambda: line.paint.verify())
    assert "hyperpaint.verify(path)" in caught.problem.mend


@pytest.mark.parametrize("name", [None, "rho"])
def test_a_cube_of_any_name_is_reflectance(name: str | None) -> None:
    cube = flight(lines=8, columns=4).line.paint.reflectance().reflectance.compute()
    for method, options in (("smooth", {"window": 5}), ("to_nominal", {}), ("at", {"wavelength": 550.0})):
        found, expected = (getattr(each.paint, method)(**options) for each in (cube.rename(name), cube))
        xr.testing.assert_identical(found, expected.rename(name))
    np.testing.assert_array_equal(cube.rename(name).paint.rgb(), cube.paint.rgb())
    assert cube.rename(name).paint.spectrum(pixels=[(3, 3)]).axes


@pytest.mark.parametrize("of", ["dataset", "array"])
def test_what_the_accessor_has_not_is_named(of: str) -> None:
    library = xr.Dataset({"reflectance": (("signature", "band"), [[0.1]])}, {"signature": ["a"]})
    accessor = library.paint if of == "dataset" else library.reflectance.paint
    caught = expect_error(AttributeError, r'\'values\'.*library\["signature"\]', lambda: accessor.values)
    assert caught.name == "values"
    expect_errors(
        (AttributeError, r"the nearest is \.paint\.spectrum", lambda: accessor.spectrums),
        (TypeError, r'str.*library\["signature"\]', lambda: accessor == "a"),
    )
    expect_error(TypeError, None, lambda: accessor != "a")
    assert accessor == accessor
    assert accessor != library.copy().paint
    assert accessor in {accessor}
    assert not hasattr(accessor, "_repr_latex_")
    assert copy.copy(library.copy(deep=True)).identical(library)
