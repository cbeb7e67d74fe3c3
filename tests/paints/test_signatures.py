"""Paint signatures against plain numpy, and whatever the chunks."""

import tracemalloc
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.analytic_scenes import as_line, bonnet, smooth_edge, wavelengths
from support.painted_lines import CHUNKINGS, RAW, SPECTRA, TWO, assert_same_bits, made, raw
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint import Quality, Region, Regions, SchemaError, extract_signatures, surroundings
from hyperpaint.base.schema import CUBE
from hyperpaint.paints.signatures import extraction, pixel_statistics
from hyperpaint.paints.signatures.pixel_statistics import (
    chosen_members,
    effective_pixels,
    geometric_median,
    summarise,
)
from hyperpaint.regions import pixels
from hyperpaint.simulation import simulate_line
from hyperpaint.simulation.rendering.scene_spectra import MATERIALS
from hyperpaint.surroundings.surveying import LAYERS

# --- against plain numpy -----------------------------------------------------------------------------------


def trimmed(values: np.ndarray) -> float:
    kept = values[np.isfinite(values)].astype(float)
    centre = np.median(kept)
    spread = 1.482602218505602 * np.median(np.abs(kept - centre))
    while True:
        near = np.abs(kept - centre) <= 3 * spread
        if near.all() or not near.any():
            return float(kept.mean())
        kept = kept[near]
        centre, spread = kept.mean(), kept.std()


def test_a_library_is_what_numpy_makes_of_the_pixels() -> None:
    line = made()
    library = extract_signatures(line, TWO)
    for number, region in enumerate(TWO):
        along, across = pixels(region, line)
        cube, flags = line.reflectance.values[along, :, across], line.quality.values[along, across]
        used = (flags & int(Quality.GLINT)) == 0
        values = cube[used].astype(float)
        row = library.isel(signature=number)
        assert row.n == used.sum() > 20
        assert row.n_excluded == (~used).sum() > 0
        expected = [trimmed(column) for column in values.T]
        np.testing.assert_allclose(row.reflectance, expected, rtol=1e-6)
        np.testing.assert_allclose(row.reflectance_sd, np.nanstd(values, axis=0, ddof=1), rtol=1e-6)
        levels = [0.05, 0.25, 0.5, 0.75, 0.95]
        np.testing.assert_allclose(
            row.reflectance_quantiles, np.nanquantile(values, levels, axis=0), rtol=1e-6
        )
        assert row.quality == np.bitwise_or.reduce(flags[used]) == int(Quality.LOW_SUN)
        share = dict(zip(library.flag.values, row.quality_share.values, strict=True))
        assert share["glint"] == np.float32((flags & 64 != 0).mean())
        # outliers of three in a hundred move a mean, and not the centre
        plain = np.nanmean(values, axis=0)
        assert np.abs(np.array(expected) - plain).max() > 0.002


@pytest.mark.filterwarnings("ignore:.*flags-averaged")
def test_padded_lines_have_no_members() -> None:
    line = made()
    padded = line.assign_coords(along_track=np.arange(line.sizes["along_track"])).pad(along_track=2)
    assert (extract_signatures(padded, TWO, exclude=0).member_along_track >= -1).all()


@pytest.mark.parametrize("factor", [1e4, 1e-4])
def test_a_scale_that_no_surface_has_is_named(factor: float) -> None:
    line = made()
    line = line.assign(reflectance=(line.reflectance * factor).assign_attrs(line.reflectance.attrs))
    with pytest.warns(hp.errors.PaintWarning, match="scale-doubtful"):
        extract_signatures(line, TWO)


def test_members_are_pixels_of_the_region() -> None:
    line = made()
    library = extract_signatures(line, TWO, members=20)
    assert library.sizes["member"] == 20
    for number, region in enumerate(TWO):
        row = library.isel(signature=number)
        places = list(zip(row.member_along_track.values, row.member_cross_track.values, strict=True))
        assert len(set(places)) == 20
        assert set(places) <= set(zip(*pixels(region, line), strict=True))
        for spectrum, (along, across) in zip(row.member_reflectance.values, places, strict=True):
            assert spectrum.tobytes() == line.reflectance.values[along, :, across].tobytes()
    whole = extract_signatures(line, TWO, members=10_000)
    assert whole.sizes["member"] == whole.n.max()
    few = whole.isel(signature=int(np.argmin(whole.n.values)))
    n = int(few.n)
    assert np.isnan(few.member_reflectance[n:]).all()
    assert (few.member_along_track[n:] == -1).all()
    assert (few.member_along_track[:n] >= 0).all()
    assert extract_signatures(line, TWO, members=0).sizes["member"] == 0
    along, across = np.divmod(np.arange(5000), 50)
    first = set(chosen_members(along, across, 100, seed=0).tolist())
    assert first != set(chosen_members(along, across, 100, seed=1).tolist())
    # without a pixel that was chosen one other takes its place
    gone = sorted(first)[40]
    kept = np.delete(np.arange(5000), gone)
    second = set(kept[chosen_members(along[kept], across[kept], 100, seed=0)].tolist())
    assert first - {gone} < second
    assert len(second) == 100
    # they lie all over the region
    counts = np.histogram(along[sorted(set(chosen_members(along, across, 1000, seed=3).tolist()))], 10)[0]
    assert counts.min() > 60


def test_geometric_median_is_the_nearest_to_all() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(0.3, 0.01, (300, 6))
    values[:90] += 0.3
    centre = geometric_median(values)

    def total(point: np.ndarray) -> float:
        return float(np.sqrt(((values - point) ** 2).sum(axis=1)).sum())

    best = total(centre)
    for _ in range(200):
        assert total(centre + rng.normal(0, 1e-3, 6)) > best
    assert np.abs(centre - 0.3).max() < 0.01 < np.abs(values.mean(axis=0) - 0.3).min()
    values[5, 2] = np.nan
    values[:, 4] = np.nan
    holed = geometric_median(values)
    assert np.isnan(holed).tolist() == [False] * 4 + [True, False]
    np.testing.assert_allclose(holed[:4], centre[:4], atol=2e-3)


@pytest.mark.parametrize("centre", ["trimmed_mean", "geometric_median", "median"])
def test_centres_stand_a_fifth_of_outliers(centre: str) -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(0.1, 0.003, (500, 5)).astype("f4")
    values[::5] += rng.uniform(0.05, 2.0, (100, 1)).astype("f4")
    np.testing.assert_allclose(summarise(values, centre)["reflectance"], 0.1, atol=0.0015)


def test_few_values_and_none() -> None:
    values = np.array(
        [[0.2, np.nan, np.nan, 0.5], [0.2, 0.4, np.nan, np.inf], [0.2, 0.6, np.nan, np.nan]], "f4"
    )
    found = summarise(values, "trimmed_mean")
    np.testing.assert_allclose(found["reflectance"], [0.2, 0.5, np.nan, 0.5], rtol=1e-6)
    np.testing.assert_allclose(
        found["reflectance_sd"], [0.0, 0.1 * np.sqrt(2), np.nan, np.nan], rtol=1e-6, atol=1e-12
    )
    np.testing.assert_array_equal(
        np.isnan(found["reflectance_quantiles"]).any(axis=0), [False, False, True, False]
    )


# --- the same bits -----------------------------------------------------------------------------------------


def test_the_same_bits_whatever_the_chunks() -> None:
    line = made()
    expected = extract_signatures(line, TWO)
    for chunks in CHUNKINGS[1:]:
        assert_same_bits(extract_signatures(line.chunk(chunks), TWO), expected)
    # and from counts
    line = raw()
    expected = line.paint.signatures(RAW, smooth="box")
    for chunks in CHUNKINGS[1:]:
        lazy = line.assign(counts=line.counts.chunk(chunks))
        assert_same_bits(lazy.paint.signatures(RAW, smooth="box"), expected)
    assert (expected.reflectance_u_systematic[:, 1:-1] > 0).all()


@pytest.mark.slow
def test_the_same_bits_on_a_cluster_of_two_processes(two_workers: Any) -> None:
    line = raw().chunk({"along_track": 8})
    nm = wavelengths()
    panel = as_line(bonnet(nm, smooth_edge(nm, 600.0, 0.04, 0.6))[0], nm, snr=100.0)
    expected = extract_signatures(line, RAW)
    flags = surroundings.flag(panel, sun_zenith=30.0).compute(scheduler="synchronous")
    told: list[tuple[int, int]] = []
    with two_workers.as_current():
        found = extract_signatures(line, RAW)
        watched = extract_signatures(line, RAW, progress=lambda *each: told.append(each))
        other_flags = surroundings.flag(panel.chunk(along_track=64), sun_zenith=30.0).compute()
    assert_same_bits(found, expected)
    assert_same_bits(watched, expected)
    assert told[-1][0] == told[-1][1]
    for name in (*LAYERS, "quality"):
        np.testing.assert_array_equal(flags[name], other_flags[name])


@pytest.mark.slow
def test_regions_read_some_bands_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    line, counts = made(), raw()
    expected, from_counts = extract_signatures(line, TWO), extract_signatures(counts, RAW)
    for size, total in ((12_000, 1000), (3_000, 3000)):
        monkeypatch.setattr(extraction, "MAX_GATHERED_BYTES", size)
        told: list[tuple[int, int]] = []
        found = extract_signatures(line, TWO, progress=lambda *each, told=told: told.append(each))
        assert_same_bits(found, expected)
        assert told[-1] == (total, total)
        assert told == sorted(told)
        assert_same_bits(extract_signatures(counts, RAW), from_counts)
    monkeypatch.setattr(extraction, "MAX_COMPLETE_BYTES", size)  # what a geometric median may gather whole
    expect_error(
        SchemaError,
        r"'hood'.*region-too-large",
        lambda: extract_signatures(line, TWO, centre="geometric_median"),
    )


@pytest.mark.slow
def test_a_large_region_takes_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    lines, bands, columns = 304, 240, 128
    monkeypatch.setattr(extraction, "MAX_GATHERED_BYTES", 2 * 2**20)
    monkeypatch.setattr(pixel_statistics, "MAX_GRID_PIXELS", 2**14)

    def block(block_info: Any = None) -> np.ndarray:
        start, stop = block_info[None]["array-location"][0]
        line_level = 0.3 + 0.01 * np.cos(np.arange(start, stop, dtype="f4"))
        return np.tile(line_level[:, None, None], (1, bands, columns))

    pieces = (16,) * (lines // 16)
    cube = da.map_blocks(
        block, chunks=(pieces, (bands,), (columns,)), dtype="f4", meta=np.empty((0, 0, 0), "f4")
    )
    line = made(8, bands, 16).isel(along_track=[], cross_track=[])[["wavelength"]]
    line = line.assign(reflectance=(CUBE, cube, {"units": "1"}))
    everything = Region("all", [(0, 0), (columns, 0), (columns, lines), (0, lines)])
    extract_signatures(made(), TWO)  # what is imported does not count
    tracemalloc.start()
    found = extract_signatures(line, [everything], min_pixels=38_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.n.item() == lines * columns
    np.testing.assert_allclose(found.reflectance, 0.3, atol=1e-4)
    # the cube has 37 MB; beside 2 MiB of samples are blocks at work and some 100 bytes a pixel
    assert peak < 18e6, peak


def test_only_the_lines_of_a_region_are_read() -> None:
    line = made(lines=64)
    seen: set[int] = set()

    def block(values: np.ndarray, block_id: Any = ()) -> np.ndarray:
        seen.add(block_id[0])
        return values

    cube = da.from_array(line.reflectance.values, chunks=(8, -1, -1))
    cube = da.map_blocks(block, cube, dtype="f4", meta=np.empty((0, 0, 0), "f4"))
    lazy = line.assign(reflectance=(CUBE, cube, {"units": "1"}))
    region = Region("a", [(2, 17), (6, 17), (6, 23), (2, 30)])
    found = extract_signatures(lazy, region)
    assert seen == {2, 3}
    assert_same_bits(found, extract_signatures(line, region))
    line = made()
    forward = extract_signatures(line, TWO)
    backward = extract_signatures(line, Regions(TWO.regions[::-1]))
    for name in (*SPECTRA, "n_eff"):
        both = [library[name].sel(signature="roof", drop=True) for library in (forward, backward)]
        size = min(int(library.n.sel(signature="roof")) for library in (forward, backward))
        both = [array.isel(member=slice(size), missing_dims="ignore") for array in both]
        np.testing.assert_array_equal(*both)


# --- Paint signatures against the truth, and how sure they are


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


def test_light_and_time_are_told_and_unknown_uncertainties_are_not_zero() -> None:
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
    # uncertainties that are not known are not zero
    library = extract_signatures(made(), TWO)
    assert np.isnan(library.reflectance_u_random).all()
    assert library.reflectance_u_random.attrs["components"] == "none known"
    library = extract_signatures(raw().drop_vars("radiance_gain_u_systematic"), RAW)
    assert np.isnan(library.reflectance_u_systematic).all()
    assert (library.reflectance_u_random[:, 1:-1] > 0).all()
    np.testing.assert_array_equal(np.isnan(library.reflectance_u_random), np.isnan(library.reflectance))


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
