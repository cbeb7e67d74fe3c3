"""Means over regions: each source of error against how means really scatter, and against its closed form."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.noisy_collects import BANDS, WAVELENGTH, noisy_collect, true_reflectance

from hyperpaint.radiometry import mean_uncertainty, reflectance
from hyperpaint.radiometry.uncertainty import RegionSums, line_errors, rounding_variance

pytestmark = pytest.mark.filterwarnings(
    "ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning"
)
QUIET = {"gain_u": 0.0, "irradiance_u": 0.0}


def computed(line: xr.Dataset) -> xr.Dataset:
    made = reflectance(line, uncertainty=True)
    names = ["reflectance", "reflectance_u_random", "reflectance_u_systematic"]
    return made.assign(made[names].compute(scheduler="synchronous")).drop_vars(
        ["quality", "irradiance_age", "timing_sensitivity", "irradiance_misfit"]
    )


def pulls(draws: int, seed: int, shape: tuple[int, int, int], **options: Any) -> np.ndarray:
    # Return true over stated standard deviation of a region's mean (band,)
    errors, stated = [], []
    for number in range(draws):
        line = noisy_collect(np.random.default_rng([seed, number]), *shape, **options)
        region = computed(line.assign(counts=line.counts.chunk())).isel(
            cross_track=slice(options.get("masked", 0), None)
        )
        # the sums that `mean_uncertainty` returns, without its number of independent pixels
        of_line = line_errors(region)
        assert of_line is not None
        along, across = (axis.ravel() for axis in np.indices(region.reflectance.shape[::2]))
        sums = RegionSums(of_line, along, across)
        value, noise = (
            region[name].transpose("band", ...).values.reshape(BANDS, -1).astype(np.float64)
            for name in ("reflectance", "reflectance_u_random")
        )
        for band in range(BANDS):
            sums.add(band, value[band], noise[band])
        mean = sums.errors()
        errors.append(value.mean(axis=1) - true_reflectance(WAVELENGTH))
        stated.append(np.hypot(mean.u_random, np.nan_to_num(mean.u_systematic)))
    return np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(stated), axis=0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "columns", "darks", "draws"),
    # all twelve of regions and numbers of darks: tests/campaigns/region_means.py
    [(150, 4, 10, 60), (100, 4, 100, 60), (400, 1, 100, 60), (1, 120, 10, 60)],
)
def test_means_scatter_as_is_stated(lines: int, columns: int, darks: int, draws: int) -> None:
    ratios = pulls(draws, 7000 + darks, (lines, columns, darks))
    assert 0.95 < np.sqrt(np.mean(ratios**2)) < 1.05
    # 60 draws know the ratio of one band to 9.1 %, and of all bands together to 2 %
    assert np.abs(ratios - 1.0).max() < 0.28


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draws", "options"),
    [
        (150, {"common": True}),
        (75, {"masked": 4, **QUIET}),
        (75, {"dark_times": 2, **QUIET}),
        (75, {"read_noise": 0.2, **QUIET}),
    ],
    ids=["all of a flight", "pedestal", "two darks", "rounding"],
)
def test_means_scatter_as_is_stated_with_what_is_shared(draws: int, options: dict[str, Any]) -> None:
    ratios = pulls(draws, 7100, (40, 10, 10), **options)
    # what bands share is one draw a collect: 150 know it to 6 %
    assert 0.85 < np.sqrt(np.mean(ratios**2)) < 1.15


def test_lines_do_not_average_what_a_column_shares() -> None:
    line = computed(noisy_collect(np.random.default_rng(1), 60, 5, 10, **QUIET))
    mean = mean_uncertainty(line)
    sizes = mean.reflectance_errors.to_pandas().T.set_axis(mean.error_source.values, axis=1)
    assert list(sizes) == ["noise", "mean dark"]
    per_count = (line.reflectance / (line.counts - line.dark_counts)).mean("along_track")
    dark = np.sqrt(((per_count * line.dark_counts_u_random) ** 2).sum("cross_track")) / 5
    noise = np.sqrt((line.reflectance_u_random.astype(float) ** 2).sum(["along_track", "cross_track"])) / 300
    np.testing.assert_allclose(sizes["mean dark"], dark, rtol=1e-2)
    np.testing.assert_allclose(sizes["noise"], noise, rtol=1e-6)
    np.testing.assert_allclose(mean.u_random, np.hypot(dark, noise), rtol=1e-2)
    assert mean.u_random.attrs["components"] == "electrons_per_count, read_noise, dark_counts_u_random"
    # a tenth of the lines: noise grows, the dark's error stays
    tenth = mean_uncertainty(line.isel(along_track=slice(0, 6)))
    ratio = (tenth.reflectance_errors / mean.reflectance_errors).mean("band").values
    np.testing.assert_allclose(ratio, [np.sqrt(10.0), 1.0], rtol=2e-2)


def test_two_darks_share_what_lies_between_them() -> None:
    line = computed(noisy_collect(np.random.default_rng(2), 41, 4, 10, dark_times=2, **QUIET))
    own = [
        mean_uncertainty(line.isel(along_track=part)).reflectance_errors.values[1]
        for part in (slice(0, 1), slice(20, 21), slice(0, 41))
    ]
    np.testing.assert_allclose(own[1] / own[0], np.sqrt(0.5), rtol=0.1)
    np.testing.assert_allclose(own[2] / own[0], np.sqrt(0.5), rtol=0.1)


def test_noise_of_irradiance_is_that_of_its_samples() -> None:
    line = computed(noisy_collect(np.random.default_rng(3), 8, 5, 10, gain_u=0.0))
    mean = mean_uncertainty(line)
    noise = mean.reflectance_errors.values[list(mean.error_source.values).index("irradiance noise")]
    relative = noise / mean["mean"].values
    # 8 lines half way between two samples; bands of 6 nm average the channels of a spectrometer of 3 nm
    assert (relative < 0.005 * np.sqrt(0.55)).all()
    assert (relative > 0.3 * 0.005 * np.sqrt(0.5)).all()
    assert (mean.error_correlation.values[1, : BANDS - 1] > 0.2).all()  # bands share channels
    single = mean_uncertainty(line.isel(along_track=slice(0, 1)))
    np.testing.assert_allclose(single.reflectance_errors.values[2], noise, rtol=0.05)


def test_rounding_averages_out_where_there_is_noise() -> None:
    np.testing.assert_allclose(rounding_variance(np.array([0.0, 0.25, 4.0])), [1 / 12, 0.0, 0.0], atol=3e-3)
    rng = np.random.default_rng(0)
    for noise in (0.1, 0.2, 0.3):
        levels = np.linspace(0.0, 1.0, 200, endpoint=False)
        means = np.rint(levels[:, None] + rng.normal(0.0, noise, (200, 20_000))).mean(axis=1)
        assert np.var(means - levels) == pytest.approx(float(rounding_variance(np.array(noise**2))), rel=0.1)


def test_errors_are_told_apart_only_where_the_calibration_is_there() -> None:
    line = computed(noisy_collect(np.random.default_rng(4), 6, 4, 10, common=True))
    whole = mean_uncertainty(line)
    assert "wavelength" in whole.error_source.values
    for name in ("read_noise", "dark_counts_u_random", "wavelength_u", "dark_counts", "irradiance_time"):
        bare = mean_uncertainty(line.drop_vars(name))
        assert "reflectance_errors" not in bare
        assert (bare.u_systematic > 0).all()
    # the sum alone is taken for common, and never underrates
    bare = mean_uncertainty(line[["reflectance", "reflectance_u_random", "reflectance_u_systematic"]])
    assert (np.hypot(bare.u_random, bare.u_systematic) > np.hypot(whole.u_random, whole.u_systematic)).all()


@pytest.mark.parametrize("chunks", [{"along_track": 1}, {"along_track": 5, "band": 7}, {"cross_track": 2}])
def test_the_same_bits_whatever_the_chunks(chunks: dict[str, int]) -> None:
    line = noisy_collect(np.random.default_rng(5), 12, 6, 10, common=True)
    whole, parts = (
        mean_uncertainty(reflectance(each, uncertainty=True)) for each in (line, line.chunk(chunks))
    )
    for name in ("u_random", "u_systematic", "reflectance_errors", "error_correlation"):
        assert whole[name].values.tobytes() == parts[name].values.tobytes()
