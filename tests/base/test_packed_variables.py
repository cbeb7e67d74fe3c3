"""Scale, offset and fill value in attributes, integers without a scale, and axes of other names."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.base.facts import plain
from hyperpaint.base.schema import require

NM = np.linspace(400.0, 1000.0, 31)
TRUE = np.linspace(0.1, 0.5, 31)
FULL = np.broadcast_to(TRUE[:, None], (6, 31, 5))


def cube(values: Any, axis: str = "wavelength", **attrs: Any) -> xr.Dataset:
    return xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), values, {"units": "1", **attrs})},
        {axis: ("band", NM, {"units": "nm"})},
    )


PACKED: dict[str, tuple[Any, dict[str, Any]]] = {
    "ten thousandths": (np.rint(FULL * 1e4).astype("i2"), {"scale_factor": 1e-4}),
    "per cent in bytes": (np.rint(FULL * 200).astype("u1"), {"scale_factor": 0.005}),
    "offset": (np.rint(FULL * 1e4 + 1000).astype("u2"), {"scale_factor": 1e-4, "add_offset": -0.1}),
    "offset alone": (FULL.astype("f4") + 1, {"add_offset": -1.0}),
    "numpy scalars": (np.rint(FULL * 1e4).astype("i4"), {"scale_factor": np.float32(1e-4)}),
    "floats, one": (FULL.astype("f4"), {"scale_factor": 1.0, "add_offset": 0.0}),
}


@pytest.mark.parametrize("case", PACKED)
@pytest.mark.parametrize("chunks", [None, {"along_track": 2}])
def test_packed_reflectance_is_unpacked_wherever_it_enters(case: str, chunks: Any) -> None:
    values, attrs = PACKED[case]
    line = cube(values, **attrs)
    line = line if chunks is None else line.chunk(chunks)
    region = hp.Regions((hp.Region("a", [(0, 0), (5, 0), (5, 6), (0, 6)]),))
    spectra = {
        "signatures": hp.extract_signatures(line, region, exclude=0).reflectance[0],
        "at": line.paint.at(NM).reflectance[0, :, 0],
        "smooth": line.paint.smooth(window=3, order=1).reflectance[0, :, 0],
        "require": require(line, ["reflectance"], "a test")["reflectance"][0, :, 0],
    }
    for name, spectrum in spectra.items():
        np.testing.assert_allclose(spectrum, TRUE, atol=0.003, err_msg=name)
    plain_picture = cube(FULL.astype("f4")).paint.rgb()
    np.testing.assert_allclose(line.paint.rgb(), plain_picture, atol=0.03)


def test_fill_values_become_missing() -> None:
    values = np.rint(FULL * 1e4).astype("i2")
    values[0, 0, 0] = -9999
    for name in ("_FillValue", "missing_value", "nodata"):
        unpacked = plain(cube(values, scale_factor=1e-4, **{name: np.int16(-9999)})).reflectance
        assert int(np.isnan(unpacked).sum()) == 1
    for name in ("_FillValue", "nodata"):
        alone = cube(np.where(values == -9999, -9999.0, FULL), **{name: -9999.0})
        assert int(np.isnan(plain(alone).reflectance).sum()) == 1
        # counts and flags keep their type
        assert plain(cube(values, **{name: np.int16(-9999)})).reflectance.dtype == values.dtype


def test_pictures_do_not_depend_on_the_order_of_bands() -> None:
    order = np.random.default_rng(1).permutation(31)
    line = cube(FULL.astype("f4"))
    np.testing.assert_allclose(line.isel(band=order).paint.rgb(), line.paint.rgb(), atol=1e-5)


def test_unpacking_reads_nothing(tmp_path: Any) -> None:
    path = tmp_path / "packed.zarr"
    cube(np.rint(FULL * 1e4).astype("i2"), scale_factor=1e-4).to_zarr(path, consolidated=False)
    line = xr.open_zarr(path, chunks=None, mask_and_scale=False, consolidated=False)
    assert not plain(line).reflectance.variable._in_memory


@pytest.mark.parametrize(
    ("attrs", "code"),
    [({}, "scale-missing"), ({"scale_factor": "1e-4"}, "scale-wrong"), ({"scale_factor": 0}, "scale-wrong")],
)
def test_integers_without_a_scale_are_refused(attrs: dict[str, Any], code: str) -> None:
    line = cube(np.rint(FULL * 1e4).astype("i2"), **attrs)
    region = hp.Regions((hp.Region("a", [(0, 0), (5, 0), (5, 6), (0, 6)]),))
    expect_refusals((PaintError, code, lambda: hp.extract_signatures(line, region, exclude=0)))


@pytest.mark.parametrize("axis", ["wavelengths", "Wavelength", "wvl", "WL", "centre_wavelength"])
def test_wavelengths_of_another_name_are_found(axis: str) -> None:
    line = cube(FULL.astype("f4"), axis)
    np.testing.assert_allclose(line.paint.at(700.0).reflectance, TRUE[15], rtol=1e-6)
    assert line.paint.rgb().shape == (6, 5, 3)


@pytest.mark.parametrize("units", ["unitless", "dimensionless", "1", "%", "percent"])
def test_words_for_fractions(units: str) -> None:
    factor = 100.0 if units in ("%", "percent") else 1.0
    line = cube((FULL * factor).astype("f4"), units=units)
    np.testing.assert_allclose(line.paint.smooth(window=3, order=1).reflectance[0, :, 0], TRUE, atol=1e-3)
