"""Covariance of the bands of signatures against how signatures of simulated collects scatter."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.noisy_collects import COMMON, WAVELENGTH, noisy_collect, true_reflectance
from support.refusals import expect_errors

from hyperpaint import Region, extract_signatures
from hyperpaint.base.errors import SchemaError
from hyperpaint.paints import band_ratio, covariance
from hyperpaint.radiometry import mean_uncertainty, reflectance

pytestmark = pytest.mark.filterwarnings(
    "ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning"
)
#: Places of pairs of bands, near and far; a band is in one pair only, so that the pairs err independently.
PAIRS = np.array([(20, 3), (11, 10), (22, 13), (23, 0), (21, 1), (19, 2),
                  (18, 17), (16, 4), (15, 14), (12, 5), (9, 6), (8, 7)])  # fmt: skip


def signature(line: xr.Dataset, **options: Any) -> xr.Dataset:
    last, right = line.sizes["along_track"] - 1, line.sizes["cross_track"] - 1
    region = Region("paint", [(0, 0), (right, 0), (right, last), (0, last)])
    return extract_signatures(line, region, **options)


def scatter(
    draws: int, seed: int, size: tuple[int, int, int], truth: np.ndarray, smooth: Any = None, **options: Any
) -> np.ndarray:
    # Return true over stated standard deviation of a signature (band,), then of band ratios (pair,)
    # where bands share errors, every 16 collects have all their combinations of signs: the sum is exact
    signs = [*product((-1.0, 1.0), repeat=len(COMMON))] if options.pop("common", False) else [()]
    p, q = PAIRS.T
    errors, stated = [], []
    for number in range(draws):
        options["common"] = dict(zip(COMMON, signs[number % len(signs)], strict=False))
        line = noisy_collect(np.random.default_rng([seed, number]), *size, **options)
        library = signature(line, smooth=smooth)
        level, bands = library.reflectance.values[0].astype(np.float64), covariance(library).values[0]
        ratio = level[p] / level[q]
        ratio_u = np.sqrt(bands[p, p] - 2.0 * ratio * bands[p, q] + ratio**2 * bands[q, q]) / level[q]
        if not number:  # the function gives the same; it computes a covariance for every pair
            found = [band_ratio(library, *WAVELENGTH[pair]) for pair in PAIRS[:3]]
            np.testing.assert_allclose([[float(f.ratio[0]), float(f.ratio_u[0])] for f in found],
                                       np.stack([ratio, ratio_u], axis=1)[:3], rtol=1e-6)  # fmt: skip
        errors.append(np.concatenate([level - truth, ratio - truth[p] / truth[q]]))
        stated.append(np.concatenate([np.sqrt(np.diagonal(bands)), ratio_u]))
    return np.sqrt(np.nanmean(np.square(errors), axis=0) / np.nanmean(np.square(stated), axis=0))


@pytest.mark.slow
@pytest.mark.parametrize(("common", "draws"), [(False, 20), (True, 16)])
def test_signatures_and_ratios_scatter_as_is_stated(common: bool, draws: int) -> None:
    ratios = scatter(draws, 8000, (100, 20, 10), true_reflectance(WAVELENGTH), common=common)
    assert 0.9 < np.sqrt(np.mean(ratios[:24] ** 2)) < 1.1
    assert 0.9 < np.sqrt(np.mean(ratios[24:] ** 2)) < 1.1


@pytest.mark.slow
def test_smile_and_smoothing_are_in_the_covariance() -> None:
    truth = true_reflectance(WAVELENGTH)
    # what smoothing does to a spectrum without errors is no uncertainty
    weights = np.linalg.pinv(np.vander(np.arange(-3.0, 4.0), 3, increasing=True))[0]
    truth[3:-3] = np.lib.stride_tricks.sliding_window_view(truth, 7) @ weights
    smooth = {"method": "savitzky-golay", "window": 7, "order": 2}
    ratios = scatter(90, 8100, (60, 4, 10), truth, smooth=smooth, smile=1.5)
    inner = ((PAIRS >= 4) & (PAIRS < 20)).all(axis=1)
    assert 0.92 < np.sqrt(np.mean(ratios[4:20] ** 2)) < 1.08
    assert 0.85 < np.sqrt(np.mean(ratios[24:][inner] ** 2)) < 1.15


def test_what_bands_share_leaves_a_ratio() -> None:
    library = signature(noisy_collect(np.random.default_rng(1), 30, 8, 10, common=True))
    ratio = band_ratio(library, 564.0, 562.0)
    level = library.isel(band=20)
    total = np.hypot(level.reflectance_u_random, level.reflectance_u_systematic) / level.reflectance
    assert (ratio.ratio_u < 0.2 * total).all()
    bands = covariance(library)
    assert bands.dims == ("signature", "band", "other_band")
    own = np.sqrt(np.diagonal(bands.values[0]))
    total = np.hypot(library.reflectance_u_random, library.reflectance_u_systematic).values[0]
    np.testing.assert_allclose(own, total, rtol=1e-5)
    np.testing.assert_array_equal(bands.values, bands.values.transpose(0, 2, 1))
    # correlations are cut at 1 %
    assert (np.linalg.eigvalsh(bands.values[0]) > -0.02 * own.min() ** 2).all()


def test_signs_of_errors_and_means() -> None:
    line = noisy_collect(np.random.default_rng(2), 20, 6, 10, common=True)
    mean = mean_uncertainty(reflectance(line, uncertainty=True))
    np.testing.assert_allclose(covariance(mean).values, covariance(signature(line)).values[0], rtol=1e-4)
    library = signature(noisy_collect(np.random.default_rng(3), 20, 6, 10, common=True))
    row = library.reflectance_errors.values[0, list(library.error_source.values).index("wavelength")]
    light = 1.0 - 0.002 * (WAVELENGTH - 545.0)
    expected = 0.1 * np.gradient(true_reflectance(WAVELENGTH) * light, WAVELENGTH) / light
    np.testing.assert_allclose(row[2:-2], expected[2:-2], rtol=0.1, atol=4e-5)


def test_a_library_without_sources_has_a_covariance() -> None:
    line = reflectance(noisy_collect(np.random.default_rng(4), 10, 6, 10, common=True), uncertainty=True)
    bare = signature(line.drop_vars("dark_counts"))
    assert "reflectance_errors" not in bare
    own = np.sqrt(np.diagonal(covariance(bare).values[0]))
    total = np.hypot(bare.reflectance_u_random, bare.reflectance_u_systematic).values[0]
    np.testing.assert_allclose(own, total, rtol=1e-6)
    both = xr.concat([bare.drop_vars("region"), bare.drop_vars("region")], "signature")
    assert covariance(both).shape == (2, 24, 24)
    expect_errors(
        (SchemaError, "reflectance_u_random", lambda: covariance(bare.drop_vars("reflectance_u_random"))),
        (SchemaError, r"900 nm.*band-missing", lambda: band_ratio(bare, 900.0, 550.0)),
    )


def test_libraries_of_other_sources_and_bands() -> None:
    library = signature(noisy_collect(np.random.default_rng(7), 10, 6, 10))
    whole, picked = (covariance(each).values[0] for each in (library, library.isel(band=[3, 4, 20])))
    np.testing.assert_allclose(np.diagonal(picked), np.diagonal(whole)[[3, 4, 20]], rtol=1e-6)
    assert whole[3, 4] > 0.0
    assert picked[0, 1] == picked[1, 2] == 0.0
    one = signature(noisy_collect(np.random.default_rng(5), 10, 6, 10, common=True))
    other = signature(noisy_collect(np.random.default_rng(6), 10, 6, 10, irradiance_u=0.0, smile=1.0))
    assert one.sizes["error_source"] > other.sizes["error_source"]
    how: Any = {"join": "outer", "coords": "different", "compat": "equals", "data_vars": "all"}
    joined = xr.concat([one, other], "signature", **how)
    for number, each in enumerate((one, other)):
        np.testing.assert_allclose(covariance(joined).values[number], covariance(each).values[0], rtol=1e-6)
