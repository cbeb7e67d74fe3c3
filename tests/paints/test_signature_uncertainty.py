"""Paint signatures against the truth, and how sure they are."""

import numpy as np
import pytest
import xarray as xr
from support.painted_lines import RAW, TWO, made, raw

import hyperpaint as hp
from hyperpaint import Region, Regions, extract_signatures
from hyperpaint.base.schema import CUBE
from hyperpaint.paints.signatures import pixel_statistics
from hyperpaint.paints.signatures.pixel_statistics import effective_pixels
from hyperpaint.regions import pixels
from hyperpaint.simulation import simulate_line
from hyperpaint.simulation.rendering.scene_spectra import MATERIALS

# --- against the truth -------------------------------------------------------------------------------------


def patch_of(line: xr.Dataset, material: str) -> Region:
    # Return a rectangle of pixels that all see one material
    here = line.surface.values == list(MATERIALS).index(material)
    best: tuple[int, ...] = (0, 0, 0, 0, 0)
    for row, column in np.argwhere(here):
        for height in (4, 6, 9):
            for width in (3, 5, 8):
                window = here[row : row + height, column : column + width]
                if window.shape == (height, width) and window.all() and height * width > best[0]:
                    best = (height * width, row, column, height, width)
    _, y, x, height, width = best
    corners = [(x, y), (x + width - 1, y), (x + width - 1, y + height - 1), (x, y + height - 1)]
    return Region(material, corners)


def test_signatures_of_a_simulated_line_are_the_truth_within_noise() -> None:
    line = simulate_line(lines=96, bands=100, columns=128, smile_nm=0.0, glint=0.05, seed=1)
    counts = {name: (line.surface.values == k).sum() for k, name in enumerate(MATERIALS)}
    found = [patch_of(line, name) for name, count in counts.items() if count > 100 and name != "glass"]
    regions = Regions(tuple(region for region in found if pixels(region, line)[0].size >= 12))
    assert len(regions) >= 6
    library = line.paint.signatures(regions)
    for number, region in enumerate(regions):
        along, across = pixels(region, line)
        lit = ~line.true_saturated.values[along, across]
        truth = np.median(line.true_reflectance.values[along[lit], :, across[lit]], axis=0)
        row = library.isel(signature=number)
        # the mean of n pixels, and truth that is itself the median of a texture of as many
        within = (
            5 * np.hypot(row.reflectance_u_random, 1.6 * row.reflectance_sd / np.sqrt(row.n_eff))
            + 0.004 * truth
        )
        away = np.abs(row.reflectance.values - truth)
        assert (away[5:-5] < within.values[5:-5]).all(), (region.name, away.max())
        assert row.n + row.n_excluded == along.size


def test_what_is_told_of_light_and_time() -> None:
    line = raw()
    library = line.paint.signatures(RAW)
    along, _ = pixels(RAW[1], line)
    stamps = line.time.values[along].astype("i8")
    assert abs(library.time.values[1].astype("i8") - stamps.mean()) <= 1000
    place = (float(line[name].values[along].mean()) for name in ("latitude", "longitude"))
    zenith, azimuth = hp.light.solar_position(library.time.values[1], *place)
    np.testing.assert_allclose([library.sun_zenith[1], library.sun_azimuth[1]], [zenith, azimuth], atol=1e-6)
    age = line.paint.reflectance().irradiance_age.values[along]
    assert library.irradiance_age.values[1] == age.max()
    assert 0 < age.max() < 2


# --- how sure it is ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("reach", "expected"), [(1, pixel_statistics.SMEAR), (2, 4.0), (3, 9.0)])
def test_independent_pixels_of_noise_that_is_smeared(reach: int, expected: float) -> None:
    # a box of r x r pixels over white noise: the autocorrelations of all distances sum to r**2;
    # pixels of a camera that moves share some light in any case
    along, across = np.divmod(np.arange(80 * 80), 80)
    ratios = []
    for seed in range(6):
        white = np.random.default_rng(seed).standard_normal((80 + reach - 1, 80 + reach - 1, 4))
        windows = np.lib.stride_tricks.sliding_window_view(white, (reach, reach), axis=(0, 1))
        values = 0.3 + 0.01 * windows.mean(axis=(-1, -2))
        values[5, 7] += 1.0  # one outlier does not hide the others' correlation
        ratios.append(along.size / effective_pixels(values.reshape(-1, 4).astype("f4"), along, across))
    assert np.mean(ratios) == pytest.approx(expected, rel=0.12)


def test_the_spread_of_means_is_what_independent_pixels_say() -> None:
    # means over many regions of smeared noise scatter by sd / sqrt(n_eff), not by sd / sqrt(n)
    along, across = np.divmod(np.arange(24 * 24), 24)
    means, told, naive = [], [], []
    for seed in range(120):
        white = np.random.default_rng(seed).standard_normal((26, 26))
        plane = np.lib.stride_tricks.sliding_window_view(white, (3, 3)).mean(axis=(-1, -2)).reshape(-1, 1)
        means.append(plane.mean())
        told.append(plane.std() / np.sqrt(effective_pixels(plane, along, across)))
        naive.append(plane.std() / 24)
    assert np.std(means) == pytest.approx(np.mean(told), rel=0.25)
    assert np.std(means) > 2 * np.mean(naive)


def test_few_pixels_share_light_and_more_are_never_worth_less() -> None:
    along, across = np.divmod(np.arange(12), 4)
    assert effective_pixels(np.random.default_rng(0).random((12, 3)), along, across) == 12 / 1.3
    assert effective_pixels(np.zeros((1, 2)), along[:1], across[:1]) == 1.0
    # a region that says nothing, and one that is all the same
    along, across = np.divmod(np.arange(100), 10)
    assert effective_pixels(np.full((100, 2), np.nan), along, across) == 100 / 1.3
    assert 1.0 <= effective_pixels(np.full((100, 2), 0.3), along, across) <= 100.0
    # noise without any correlation: from 32 pixels on it is told from values, and a camera still smears
    worth = []
    for count in (31, 32, 33):
        along, across = np.divmod(np.arange(count), 6)
        values = [np.random.default_rng(seed).standard_normal((count, 8)) for seed in range(20)]
        found = [effective_pixels(each, along, across) for each in values]
        assert max(found) <= count / 1.3
        worth.append(np.max(found))
    assert (worth, worth[2]) == (sorted(worth), 33 / 1.3)


def test_uncertainty_is_that_of_the_pixels_with_a_value() -> None:
    line = made(bands=6).drop_vars("quality")
    value = np.full((40, 6, 16), 0.3, "f4") + np.random.default_rng(2).normal(0, 0.01, (40, 6, 16)).astype(
        "f4"
    )
    u = np.where(np.arange(16) < 4, 0.04, 0.01).astype("f4") * np.ones((40, 6, 1), "f4")
    value[:, 1, :4] = np.nan
    value[:, 2, :] = np.nan
    value[:, 3, 1:], value[1:, 3, 0] = np.nan, np.nan
    told = {"units": "1", "components": "known"}
    line = line.assign(
        reflectance=(CUBE, value, {"units": "1"}),
        reflectance_u_random=(CUBE, u, told),
        reflectance_u_systematic=(CUBE, u, told),
    )
    row = extract_signatures(line, Region("all", [(0, 0), (15, 0), (15, 39), (0, 39)])).isel(signature=0)
    n, n_eff = 640, float(row.n_eff)
    assert row.n == n
    whole = np.mean(u[:, 0].astype(float) ** 2)
    expected = [np.sqrt(whole / n_eff), 0.01 / np.sqrt(n_eff * 480 / n), np.nan, 0.04]
    np.testing.assert_allclose(row.reflectance_u_random[:4], expected, rtol=1e-5)
    np.testing.assert_allclose(
        row.reflectance_u_systematic[:4], [u[:, 0].mean(), 0.01, np.nan, 0.04], rtol=1e-5
    )


def test_uncertainty_of_a_rectangle_is_that_of_the_mean() -> None:
    # at the columns' own wavelengths; those of a signature with smile are at nominal ones, see below
    line = raw().drop_vars("wavelength_shift").paint.reflectance(uncertainty=True)
    rectangle = Region("a", [(2, 3), (12, 3), (12, 30), (2, 30)])
    row = extract_signatures(line, rectangle, exclude=0).isel(signature=0)
    part = line.isel(along_track=slice(3, 31), cross_track=slice(2, 13))
    expected = hp.radiometry.mean_uncertainty(part)
    np.testing.assert_allclose(row.reflectance_u_systematic, expected.u_systematic, rtol=1e-5)
    # noise is fresh in every pixel, however few of them differ in what they show (n_eff)
    np.testing.assert_allclose(row.reflectance_u_random, expected.u_random, rtol=1e-5)
    np.testing.assert_allclose(row.reflectance_errors, expected.reflectance_errors, rtol=1e-5)
    square = (part.reflectance_u_random.astype(float) ** 2).mean(["along_track", "cross_track"])
    np.testing.assert_allclose(row.reflectance_u_random, np.sqrt(square / float(row.n)), rtol=1e-5)
    assert row.reflectance_u_systematic.attrs["components"] == "radiance_gain_u_systematic"
    assert "electrons_per_count" in row.reflectance_u_random.attrs["components"]


def test_uncertainties_that_are_not_known_are_not_zero() -> None:
    library = extract_signatures(made(), TWO)
    assert np.isnan(library.reflectance_u_random).all()
    assert library.reflectance_u_random.attrs["components"] == "none known"
    library = extract_signatures(raw().drop_vars("radiance_gain_u_systematic"), RAW)
    assert np.isnan(library.reflectance_u_systematic).all()
    assert (library.reflectance_u_random[:, 1:-1] > 0).all()
    np.testing.assert_array_equal(np.isnan(library.reflectance_u_random), np.isnan(library.reflectance))


def test_reflectance_without_uncertainty_gets_that_of_its_counts() -> None:
    line = simulate_line(lines=48, bands=24, columns=48, smile_nm=0.0, gain_u=0.01, seed=1)
    line = line.drop_vars([name for name in line.variables if str(name).startswith("reflectance")])
    grass = Regions((patch_of(line, "grass"),))
    wanted, found = line.paint.signatures(grass), line.paint.reflectance().paint.signatures(grass)
    for name in ("reflectance", "reflectance_u_random", "reflectance_u_systematic"):
        np.testing.assert_array_equal(found[name], wanted[name])
    share = found.reflectance_u_systematic / found.reflectance
    np.testing.assert_allclose(share.dropna("band"), 0.01, rtol=0.01)
    # a changed reflectance has an uncertainty that the counts do not tell
    changed = line.paint.reflectance()
    changed["reflectance"] = changed["reflectance"].assign_attrs(smoothing="median")
    assert changed.paint.signatures(grass).reflectance_u_systematic.isnull().all()
