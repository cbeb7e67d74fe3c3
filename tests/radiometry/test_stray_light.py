"""Light that bands count of others: against plain numpy, over chunks, through a sweep that holds it."""

import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.radiometry import mean_uncertainty
from hyperpaint.radiometry.stray_light import inverse_of, stray_light_of
from hyperpaint.simulation import simulate_line, simulate_sweep
from hyperpaint.simulation.camera import stray_light_wings

# exact signals, which no converter rounds
pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")

BANDS = 24
CAMERA: dict[str, Any] = {"lines": 12, "bands": BANDS, "columns": 64, "noise": False, "quantise": False}
SECONDS = {"units": "s"}


def wings(bands: int, share: float = 0.03) -> np.ndarray:
    # Return light that strays to bands nearby and, evenly, to all; each source loses ``share``
    near = np.exp(-np.abs(np.subtract.outer(np.arange(bands), np.arange(bands))) / 5.0)
    return share * (0.5 * near / near.sum(axis=0) + 0.5 / bands)


def seen_by(line: xr.Dataset, matrix: np.ndarray, shift: float) -> xr.Dataset:
    # Return the line as a camera counts it that strays before its elements and smears behind them
    counts, dark = (
        line[name].transpose(..., "band", "cross_track").values for name in ("counts", "dark_counts")
    )
    share = shift / float(line.exposure_time)
    net = counts.astype(np.float64) - dark
    net = net + np.einsum("bs,lsx->lbx", matrix, net)
    net = net + share * net.sum(axis=1, keepdims=True)
    cube = (line.counts.dims, (net + dark).astype(np.float32), line.counts.attrs)
    return line.assign(counts=cube)


def with_knowledge(line: xr.Dataset, matrix: np.ndarray, shift: float, unsure: float = 0.0) -> xr.Dataset:
    return line.assign(
        stray_light=(("band", "source_band"), matrix, {"units": "1"}),
        stray_light_u=((), np.float32(unsure), {"units": "1"}),
        band_shift_time=((), shift, SECONDS),
    )


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    return simulate_line(**CAMERA, nonuniformity=0.0, glint=0.0)


def test_what_strays_and_smears_is_undone(line: xr.Dataset) -> None:
    matrix, shift = wings(BANDS), 1e-5
    expected, seen = line.paint.reflectance().reflectance.values, seen_by(line, matrix, shift)
    assert np.nanmedian(seen.paint.reflectance().reflectance.values / expected - 1) > 0.05
    mended = with_knowledge(seen, matrix, shift).paint.reflectance().reflectance
    assert mended.dtype == np.float32
    assert "smear" in mended.stray_light_applied
    np.testing.assert_allclose(mended.values, expected, rtol=3e-5)
    # and from radiance
    mended = with_knowledge(seen_by(line, matrix, 0.0), matrix, 0.0).paint.radiance().radiance.values
    np.testing.assert_allclose(mended, line.paint.radiance().radiance.values, rtol=3e-5)


def test_elements_differ_behind_what_strays() -> None:
    even, uneven = (
        simulate_line(**CAMERA | {"columns": 600}, nonuniformity=spread, glint=0.0) for spread in (0.0, 0.02)
    )
    matrix, own = wings(BANDS), (even.radiance_gain / uneven.radiance_gain).values
    light = seen_by(even, matrix, 0.0).counts
    net = (light.transpose("along_track", "band", "cross_track").values - even.dark_counts.values) * own
    counts = (light.dims, (net + uneven.dark_counts.values).astype(np.float32), light.attrs)
    seen = with_knowledge(uneven.assign(counts=counts), matrix, 0.0)
    expected, mended, unaware = (
        each.paint.reflectance().reflectance.values for each in (even, seen, seen.drop_vars("stray_light"))
    )
    # what elements differ in is told from smile by a parabola through 600 of them
    assert np.abs(mended - expected).max() < 0.01 * np.abs(unaware - expected).max()


@pytest.mark.parametrize("keep_bits", [None, 12])
def test_chunks_change_no_bit(line: xr.Dataset, keep_bits: int | None) -> None:
    seen = with_knowledge(seen_by(line, wings(BANDS), 1e-5), wings(BANDS), 1e-5, 0.1)
    whole = seen.paint.reflectance(keep_bits=keep_bits, uncertainty=True).compute()
    for lines in (1, 2, 5, 7):
        part = seen.chunk(along_track=lines).paint.reflectance(keep_bits=keep_bits, uncertainty=True)
        for name in ("reflectance", "reflectance_u_random", "reflectance_u_systematic", "quality"):
            np.testing.assert_array_equal(part[name].values, whole[name].values)


def test_what_is_unsure_of_it_is_systematic_and_stays_in_a_mean(line: xr.Dataset) -> None:
    seen = seen_by(line, wings(BANDS), 0.0)
    sure, unsure = (
        with_knowledge(seen, wings(BANDS), 0.0, part).paint.reflectance(uncertainty=True)
        for part in (0.0, 0.2)
    )
    subtracted = seen.paint.reflectance().reflectance - sure.reflectance
    added = np.sqrt(unsure.reflectance_u_systematic**2 - sure.reflectance_u_systematic**2)
    np.testing.assert_allclose(added, 0.2 * np.abs(subtracted), rtol=0.02, atol=1e-5)
    assert sure.reflectance_u_random.equals(unsure.reflectance_u_random)
    # and in a mean
    seen = with_knowledge(seen_by(line, wings(BANDS), 1e-6), wings(BANDS), 1e-6, 0.1)
    made = seen.paint.reflectance(uncertainty=True).isel(cross_track=slice(20, 60)).compute()
    mean = mean_uncertainty(made)
    assert mean.u_systematic.attrs["components"] == "stray_light_u"
    own = np.abs(made.reflectance_u_systematic.mean(["along_track", "cross_track"]))
    # at the dim ends of the spectrum what the product of matrices leaves out is a tenth of what strays
    for part, within in ((slice(1, 21), 0.05), (slice(None), 0.15)):
        np.testing.assert_allclose(mean.u_systematic[part], own[part], rtol=within)
    # of some bands it is not known from where light strays into them
    assert "reflectance_errors" not in mean_uncertainty(made.isel(band=slice(2, 8)))


def test_bad_elements_stray_as_their_neighbours_and_saturated_ones_as_they_are(line: xr.Dataset) -> None:
    seen = with_knowledge(seen_by(line, wings(BANDS), 0.0), wings(BANDS), 0.0)
    expected = seen.paint.reflectance().reflectance.values
    gain, counts = seen.radiance_gain.copy(), seen.counts.copy()
    gain[{"band": 7, "cross_track": 3}] = np.nan
    counts[{"band": 7, "cross_track": 3}] = 60_000.0
    counts[{"band": 9, "cross_track": 5, "along_track": 4}] = np.float32(seen.saturation_count)
    made = seen.assign(radiance_gain=gain, counts=counts).paint.reflectance().reflectance.values
    missing = np.isnan(made)
    assert missing[:, 7, 3].all()
    assert missing[4, 9, 5]
    assert (missing[:, :, 3].sum(axis=1) == 1).all()
    missing[4, :, 5] = True  # light that is not counted
    np.testing.assert_allclose(made[~missing], expected[~missing], rtol=1e-2, atol=2e-4)


@pytest.mark.filterwarnings("ignore:.*elements-weak")
@pytest.mark.parametrize("columns", [slice(20, 21), slice(0, 1), slice(0, 20)], ids=["one", "edge", "many"])
@pytest.mark.parametrize("share", [0.5, 0.1, 0.01])
def test_weak_elements_change_no_other_column(line: xr.Dataset, columns: slice, share: float) -> None:
    response = np.ones((BANDS, 64))
    response[::3, columns] = share
    seen = with_knowledge(seen_by(line, wings(BANDS), 0.0), wings(BANDS), 0.0)
    net = (seen.counts.transpose(..., "band", "cross_track").values - seen.dark_counts.values) * response
    weak = seen.assign(
        counts=(("along_track", "band", "cross_track"), net + seen.dark_counts.values, seen.counts.attrs),
        radiance_gain=seen.radiance_gain.copy(data=seen.radiance_gain.values / response),
    )
    expected, made = (each.paint.radiance().radiance.values for each in (line, weak))
    error = np.abs(made / expected - 1.0)
    assert np.delete(error, columns, axis=2).max() < 2e-3
    assert error.max() < 1e-2


def test_weak_elements_are_named(line: xr.Dataset) -> None:
    gain = line.radiance_gain.values.copy()
    gain[7, 3] *= 5.0
    seen = with_knowledge(line, wings(BANDS), 0.0).assign(radiance_gain=line.radiance_gain.copy(data=gain))
    with pytest.warns(PaintWarning, match=r"^1 elements.*elements-weak"):
        seen.paint.radiance().radiance.compute()
    flat = (("band", "cross_track"), np.ones(gain.shape), {"units": "1"})
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*elements-weak")
        seen.assign(flat_field=flat).paint.radiance().radiance.compute()


@pytest.mark.parametrize("terms", ["few", "all"])
def test_light_between_columns_is_undone(line: xr.Dataset, terms: str) -> None:
    near = np.abs(np.subtract.outer(np.arange(64), np.arange(64)))
    across = np.exp(-near / 8.0) if terms == "few" else np.where(near == 2, 1.0, 0.0)
    across *= 0.02 / across.sum(axis=0).max()
    counts, dark = seen_by(line, wings(BANDS), 0.0).counts, line.dark_counts.values
    net = counts.transpose(..., "band", "cross_track").values.astype(float) - dark
    cube = (net + np.einsum("xs,lbs->lbx", across, net) + dark).astype(np.float32)
    variable = (("cross_track", "source_column"), across, {"units": "1"})
    seen = line.assign(counts=(("along_track", "band", "cross_track"), cube, counts.attrs))
    seen = with_knowledge(seen, wings(BANDS), 0.0, 0.1).assign(stray_light_across=variable)
    made = seen.paint.reflectance(uncertainty=True).compute()
    expected = line.paint.reflectance().reflectance.values
    assert "between columns" in made.reflectance.stray_light_applied
    np.testing.assert_allclose(made.reflectance.values, expected, rtol=1e-4, atol=1e-5)
    for lines in (1, 5):
        part = seen.chunk(along_track=lines).paint.reflectance(uncertainty=True)
        for name in ("reflectance", "reflectance_u_systematic"):
            np.testing.assert_array_equal(part[name].values, made[name].values)
    expect_error(
        SchemaError, "columns-selected", lambda: seen.isel(cross_track=slice(3, 9)).paint.radiance().compute()
    )


def test_masked_elements_see_no_light_and_few_terms_stand_for_all() -> None:
    gain = np.ones((4, 3), np.float32)
    gain[1, 0] = gain[:, 2] = np.nan
    masked = np.argwhere(np.broadcast_to(np.arange(3) == 2, gain.shape))
    stray = stray_light_of({"stray_light": wings(4)}, np.ones(2), gain, masked)
    assert stray is not None
    rows = {(int(x), int(band)): int(other) for x, band, other in stray.replacements}
    assert rows == {(0, 1): 0} | {(2, band): -1 for band in range(4)}
    # few terms stand for all
    matrix = stray_light_wings(np.linspace(400.0, 1000.0, 272), 0.03)
    smooth = stray_light_of(
        {"stray_light": matrix}, np.ones(1), np.ones((272, 2), np.float32), np.empty((0, 2), int)
    )
    assert smooth is not None
    terms = smooth.bands
    assert terms.out is not None
    rest = (terms.out.astype(float) @ terms.source.astype(float)[:, :272]) - (
        np.eye(272) - inverse_of(matrix, "stray_light")
    )
    assert np.abs(rest).sum(axis=1).max() < 4e-4
    assert terms.source.shape[0] < 100


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"band_shift_time": ((), 0.1, SECONDS)}, "smear-implausible"),
        ({"stray_light_u": ((), np.float32(2.0), {"units": "1"})}, "value-out-of-range"),
        ({"stray_light": (("band", "source_band"), -np.eye(BANDS), {"units": "1"})}, "stray-matrix-singular"),
    ],
)
def test_what_cannot_be_is_refused(line: xr.Dataset, change: dict[str, Any], problem: str) -> None:
    seen = with_knowledge(line, wings(BANDS), 0.0).assign(change)
    expect_error(SchemaError, problem, lambda: seen.paint.reflectance().reflectance.compute())


def test_lines_of_daylight_are_found_through_what_strays() -> None:
    clear = simulate_line(lines=16, bands=272, columns=6, smile_nm=0.0, glint=0.0)
    hazy = with_knowledge(seen_by(clear, wings(272, 0.02), 0.0), wings(272, 0.02), 0.0)
    shift, expected = (hp.alignment.align_to_irradiance(each).shift_correction for each in (hazy, clear))
    np.testing.assert_allclose(shift, expected, atol=0.005)
    assert len({hp.alignment.align(each, apply="never").attrs["alignment"] for each in (hazy, clear)}) == 1


def test_smear_of_a_sweep_is_none_of_its_wings() -> None:
    clean, shift = simulate_sweep(bands=136, columns=12, seed=4), 1e-6
    share = shift / float(clean.exposure_time.mean())
    counts = clean.counts + share * (clean.counts - clean.dark_counts).sum("band")
    counts = counts.transpose(*clean.counts.dims).astype("f4").assign_attrs(clean.counts.attrs)
    smeared = clean.assign(counts=counts, band_shift_time=((), shift, SECONDS))
    made, expected, unaware = (
        hp.calibrate(each) for each in (smeared, clean, smeared.drop_vars("band_shift_time"))
    )
    lost, right, smear = (float(each.stray_light.sum("band").median()) for each in (made, expected, unaware))
    assert abs(lost - right) < 1e-4
    assert smear > 0.5 * 136 * share
    np.testing.assert_allclose(made.radiance_gain, expected.radiance_gain, rtol=1e-4)
    assert (float(made.band_shift_time), made.band_shift_time.bands) == (shift, 136)


def test_some_bands_are_not_all(line: xr.Dataset) -> None:
    some = {"band": slice(4, 9)}
    shifted = line.assign(band_shift_time=((), 1e-5, SECONDS | {"bands": BANDS})).isel(some)
    seen = with_knowledge(line, wings(BANDS), 0.0).isel(some)
    expect_errors(
        (SchemaError, r"24 bands.* 5.*bands-selected", lambda: shifted.paint.reflectance().compute()),
        (SchemaError, "bands-selected", lambda: seen.paint.reflectance().compute()),
    )
    assert seen.drop_vars("stray_light").paint.reflectance().reflectance.compute().sizes["band"] == 5
