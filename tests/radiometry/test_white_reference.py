"""Reflectance relative to a white tile, against plain numpy and against known surfaces."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, UnitsError
from hyperpaint.base.schema import Quality

BANDS, COLUMNS, TILE = 5, 7, 0.95
START = np.datetime64("2024-06-14T09:47:35", "ns")
RNG = np.random.default_rng(5)
RESPONSE = RNG.uniform(1.5e5, 3.5e5, (BANDS, COLUMNS))  # counts a second on a surface of reflectance 1


def cube(
    reflectance: float, *, ms: float = 9.0, start_s: float = 0.0, lines: int = 40, drift: float = 0.0
) -> xr.Dataset:
    """Counts of an even surface under a lamp that changes by ``drift`` per second; 50 electrons a count."""
    seconds = start_s + 0.02 * np.arange(lines)
    lamp = 1.0 + drift * seconds
    mean = lamp[:, None, None] * RESPONSE * reflectance * ms * 1e-3
    counts = np.rint(100.0 + RNG.normal(mean, np.sqrt(mean / 50.0 + 1.0))).clip(0, 4095).astype("u2")
    return xr.Dataset(
        {
            "counts": (("along_track", "band", "cross_track"), counts, {"units": "count"}),
            "exposure_time": ((), ms, {"units": "ms"}),
        },
        {
            "wavelength": ("band", np.linspace(450.0, 850.0, BANDS), {"units": "nm"}),
            "time": ("along_track", START + (seconds * 1e9).astype("timedelta64[ns]")),
        },
    )


@pytest.mark.real_data
def test_the_scene_of_a_real_specim_camera_equals_plain_numpy(shared_data: Path):
    pytest.importorskip("h5netcdf", reason="the cubes are netCDF, which h5netcdf reads")
    cubes, counts = {}, {}
    for name in ("capture", "white", "black"):
        array = xr.open_dataset(shared_data / "real_counts" / f"specim_fx10_{name}.nc")[name].astype("u2")
        array = array.rename(sample="along_track", point="cross_track", wavelength="band").rename("counts")
        cubes[name] = array.assign_attrs(units="count").to_dataset().reset_index("band", drop=True)
        cubes[name]["exposure_time"] = ((), 9.0, {"units": "ms"})
        counts[name] = array.transpose(..., "band", "cross_track").values.astype(np.float64)
    dark = counts["black"].mean(axis=0)
    expected = (counts["capture"] - dark) / (counts["white"].mean(axis=0) - dark)
    line = cubes["capture"].paint.reflectance(white=cubes["white"], dark=cubes["black"], tile=1.0)
    np.testing.assert_allclose(line.reflectance.values, expected, rtol=1e-6)
    assert line.reflectance[0].max() == pytest.approx(0.7786328655500226, rel=1e-6)
    assert not line.quality.any()


def test_tile_exposure_and_lamp_are_accounted_for(tmp_path: Path):
    dark = cube(0.0)
    # the tile at half the exposure of the scene, with a dark of its own
    scene = cube(0.3, ms=12.0)
    scene["counts"][3, 2, 4] = 4090  # glint
    line = hp.radiometry.white_reference(
        scene, cube(TILE, ms=6.0), tile=TILE, tile_uncertainty=0.01, dark=cube(0.0, ms=12.0),
        white_dark=cube(0.0, ms=6.0),
    )  # fmt: skip
    product = line.paint.reflectance(uncertainty=True).compute()
    values = product.reflectance.values
    assert np.nanmean(values) == pytest.approx(0.3, rel=1e-3)
    assert np.isnan(values).sum() == 1
    assert product.quality.values[3, 4] == Quality.SATURATED
    noise = product.reflectance_u_random.mean().item()
    assert np.nanstd(values, axis=0).mean() == pytest.approx(noise, rel=0.2)
    assert product.reflectance_u_systematic.mean().item() == pytest.approx(0.003, rel=0.1)
    assert line.electrons_per_count.item() == pytest.approx(50.0, rel=0.3)
    # a certificate over wavelength
    certificate = xr.DataArray([0.9, 1.0], {"wavelength": ("wavelength", [450.0, 850.0], {"units": "nm"})},
                               "wavelength", attrs={"units": "1"})  # fmt: skip
    cube(1.0).to_zarr(tmp_path / "white.zarr", consolidated=False)
    stored = str(tmp_path / "white.zarr")
    relative = cube(0.3).paint.reflectance(white=stored, dark=dark, tile=certificate).reflectance
    means = relative.mean(("along_track", "cross_track")).values
    assert means == pytest.approx(0.3 * np.linspace(0.9, 1.0, BANDS), rel=2e-3)
    # the lamp fades by 9 % from the first white to the second
    whites = [cube(TILE, start_s=at, drift=-0.001) for at in (0.0, 90.0)]
    scene = cube(0.4, start_s=5.0, lines=4000, drift=-0.001).chunk(along_track=1000)
    product = scene.paint.reflectance(white=whites, dark=dark, tile=TILE)
    assert product.reflectance.chunks is not None
    means = product.reflectance.mean(("band", "cross_track")).values
    assert np.abs(means.reshape(40, -1).mean(axis=1) / 0.4 - 1.0).max() < 0.002
    assert (product.quality == Quality.ILLUMINATION_UNSTABLE).all()
    part = product.isel(along_track=slice(1500, 1532), band=slice(1, 3))
    np.testing.assert_array_equal(part.paint.reflectance().reflectance, part.reflectance)
    with pytest.warns(PaintWarning, match=r"4000 of 4000 lines .*white-held"):
        scene.paint.reflectance(white=[w.assign_coords(time=w.time - np.timedelta64(1, "D")) for w in whites],
                                dark=dark, tile=TILE)  # fmt: skip


def test_the_surface_of_the_tile_changes_its_reflectance():
    scene, white, dark = cube(0.3), cube(TILE), cube(0.0)
    options = {"tile": 0.95, "dark": dark, "tile_uncertainty": 0.01}
    plain = hp.radiometry.white_reference(scene, white, **options)
    # lamps at 60 degrees over sintered PTFE: 0.976 of the certificate [Germer 2017]
    lit = hp.radiometry.white_reference(
        scene, white, tile_surface="sintered-ptfe", light_zenith=60.0, **options
    )
    ratio = (lit.reflectance_gain / plain.reflectance_gain).values
    np.testing.assert_allclose(ratio[np.isfinite(ratio)], 0.9756, atol=3e-3)
    assert 0.014 < lit.reflectance_gain_u_systematic.item() < 0.02
    expect_refusals(
        (SchemaError, "panel-light-unknown", "light",
         lambda: hp.radiometry.white_reference(scene, white, tile_surface="sintered-ptfe", **options)),
        (SchemaError, "panel-surface-grey", "0.5",
         lambda: hp.radiometry.white_reference(scene, white, tile_surface="sintered-ptfe", light_zenith=60.0,
                                               **options | {"tile": 0.5})),
    )  # fmt: skip


def test_the_uncertainty_of_the_gain_is_its_scatter_when_the_lamp_fades_by_half():
    scene, errors = cube(0.4, start_s=100.0), []
    for _ in range(12):
        whites = [cube(TILE), cube(TILE, start_s=500.0, drift=-0.001)]
        line = hp.radiometry.white_reference(scene, whites, tile=TILE, dark=cube(0.0))
        # the lamp of the first white, at the middle of its lines, has the response of the camera
        errors.append((line.reflectance_gain * RESPONSE - 1.0) / line.reflectance_gain_u_random)
    assert np.std(errors) == pytest.approx(1.0, abs=0.15)


def test_a_mean_has_its_uncertainty_without_wavelengths():
    raw, white, dark = (cube(level).drop_vars("wavelength") for level in (0.3, TILE, 0.0))
    line = hp.radiometry.white_reference(raw, white, tile=TILE, tile_uncertainty=0.01, dark=dark)
    mean = hp.radiometry.mean_uncertainty(line.paint.reflectance(uncertainty=True))
    assert mean["mean"].values == pytest.approx(np.full(BANDS, 0.3), rel=2e-3)
    assert mean["u_systematic"].values == pytest.approx(np.full(BANDS, 0.003), rel=0.2)


@pytest.mark.parametrize("dtype", ["float32", "int32", "uint32", "where"])
def test_a_white_of_another_dtype_gives_the_same_gain(dtype: str):
    scene, dark, white = cube(0.3), cube(0.0), cube(TILE)
    options = {"dark": dark, "tile": TILE}
    expected = hp.radiometry.white_reference(scene, white, bit_depth=12, **options)
    other = (
        white.where(white.counts > 0)
        if dtype == "where"
        else white.assign(counts=white.counts.astype(dtype, keep_attrs=True))
    )
    found = hp.radiometry.white_reference(scene, other, bit_depth=np.uint8(12), **options)  # 2**12 overflows
    xr.testing.assert_identical(found, expected)


def test_a_white_reference_that_would_mislead_is_refused():
    scene, dark, white = cube(0.3), cube(0.0), cube(TILE)

    def refused(*, of: xr.Dataset = scene, white=white, dark=dark, tile=TILE, **options):
        return lambda: hp.radiometry.white_reference(of, white, dark=dark, tile=tile, **options)

    half = white.copy(deep=True)
    half.counts[20:] = scene.counts[20:]
    shifted = white.assign_coords(wavelength=(white.wavelength + 30.0).assign_attrs(units="nm"))
    columns = np.arange(COLUMNS)
    numbered = scene.assign_coords(cross_track=columns)
    flipped, dark_flipped = (each.assign_coords(cross_track=columns[::-1]) for each in (white, dark))
    fading = [cube(TILE, start_s=at, drift=-0.001).drop_vars("time") for at in (0.0, 90.0)]
    bare = 0.9 * xr.ones_like(white.wavelength).drop_attrs()
    expect_refusals(
        (SchemaError, "tile-missing", refused(tile=None)),
        (SchemaError, "value-out-of-range", "95", refused(tile=95.0)),
        (SchemaError, "white-saturated", "100 % of the elements", refused(white=cube(3.0))),
        (SchemaError, "white-without-light", refused(white=dark)),
        (SchemaError, "white-unsteady", "of 40 lines", refused(white=half)),
        (SchemaError, "grid-mismatch", "5 bands x 6", refused(white=white.isel(cross_track=slice(6)))),
        (SchemaError, "grid-mismatch", "white reference", refused(of=numbered, white=flipped)),
        (SchemaError, "grid-mismatch", "dark=", refused(of=numbered, dark=dark_flipped)),
        (SchemaError, "white-wavelength-differs", "30 nm", refused(white=shifted)),
        (SchemaError, "exposure-missing", refused(white=white.drop_vars("exposure_time"))),
        (SchemaError, "dark-exposure-differs", refused(white=cube(TILE, ms=6.0))),
        (SchemaError, "dark-missing", refused(dark=None)),
        (SchemaError, "white-times-missing", refused(white=fading)),
        (SchemaError, "option-conflict", refused(of=scene.assign_attrs(linearity=[1e-6]))),
        (SchemaError, "argument-missing", lambda: scene.paint.reflectance(tile=0.95)),
        (SchemaError, "type-wrong", "white=[]", refused(white=[])),
        (SchemaError, "type-wrong", refused(white=white.counts.values)),
        (FormatError, "value-out-of-range", "float32", refused(white=white.where(white > white.mean()))),
        (UnitsError, "units-missing", "reflectance.attrs", refused(tile=bare)),
    )  # fmt: skip
    moved = [white, cube(TILE, start_s=90.0)]
    moved[1].counts.values[:] = (moved[1].counts.values * np.linspace(0.8, 1.0, COLUMNS)).astype("u2")
    with pytest.warns(PaintWarning, match="white-moved"):
        refused(of=cube(0.3, start_s=5.0), white=moved)()
