"""Paint signatures against plain numpy, against the truth, and whatever the chunks."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint import Quality, Region, Regions, SchemaError, extract_signatures
from hyperpaint.regions import pixels, regions_from
from hyperpaint.schema import CUBE, LIBRARY_VARIABLES, VARIABLES
from hyperpaint.signatures import extraction, independence
from hyperpaint.signatures.independence import effective_pixels
from hyperpaint.signatures.reduction import chosen_members, geometric_median, summarise
from hyperpaint.simulation import simulate_line
from hyperpaint.simulation.paints import MATERIALS

TWO = Regions(
    (
        Region("hood", [(1, 2), (8, 2), (8, 12), (3, 17), (1, 12)], (), "", {"colour": "red", "year": 2019}),
        Region("roof", [(6, 10), (13, 14), (9, 22)], ([(9, 15), (10, 15), (10, 16)],), "", {"make": "x"}),
    )
)  # fmt: skip
CHUNKINGS: tuple[Any, ...] = (
    None,
    {"along_track": 1},
    {"along_track": 7},
    {"along_track": (3, 20, 1, 16), "band": 5},
    {"along_track": 16, "cross_track": 4},
    {"along_track": -1, "band": 1},
)
SPECTRA = ("reflectance", "reflectance_sd", "reflectance_quantiles", "member_reflectance")


def made(lines: int = 40, bands: int = 12, columns: int = 16, seed: int = 0) -> xr.Dataset:
    """Return a line of reflectance with outliers, missing samples and flags."""
    rng = np.random.default_rng(seed)
    base = 0.3 + 0.1 * np.sin(np.arange(bands) / 3)
    values = base[:, None] * (1 + 0.05 * rng.standard_normal((lines, 1, columns)))
    values = values + 0.004 * rng.standard_normal((lines, bands, columns))
    values = (values + 0.4 * (rng.random((lines, 1, columns)) < 0.05)).astype("f4")
    values[rng.random(values.shape) < 0.01] = np.nan
    values[:, 5, 7] = np.nan
    quality = np.where(rng.random((lines, columns)) < 0.1, int(Quality.GLINT), 0)
    quality |= np.where(rng.random((lines, columns)) < 0.2, int(Quality.LOW_SUN), 0)
    return xr.Dataset(
        {
            "reflectance": (CUBE, values, {"units": "1"}),
            "quality": (("along_track", "cross_track"), quality.astype("u2")),
        },
        {"wavelength": ("band", np.linspace(400.0, 900.0, bands), {"units": "nm"})},
        {"name": "raw_0"},
    )


def assert_same_bits(first: xr.Dataset, second: xr.Dataset) -> None:
    assert set(first.variables) == set(second.variables)
    for name in first.variables:
        a, b = first[name].values, second[name].values
        assert a.dtype == b.dtype, name
        assert a.tolist() == b.tolist() if a.dtype == object else a.tobytes() == b.tobytes(), name


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
        row = library.isel(paint=number)
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


def test_members_are_pixels_of_the_region() -> None:
    line = made()
    library = extract_signatures(line, TWO, members=20)
    assert library.sizes["member"] == 20
    for number, region in enumerate(TWO):
        row = library.isel(paint=number)
        places = list(zip(row.member_along_track.values, row.member_cross_track.values, strict=True))
        assert len(set(places)) == 20
        assert set(places) <= set(zip(*pixels(region, line), strict=True))
        for spectrum, (along, across) in zip(row.member_reflectance.values, places, strict=True):
            assert spectrum.tobytes() == line.reflectance.values[along, :, across].tobytes()
    whole = extract_signatures(line, TWO, members=10_000)
    assert whole.sizes["member"] == whole.n.max()
    few = whole.isel(paint=int(np.argmin(whole.n.values)))
    n = int(few.n)
    assert np.isnan(few.member_reflectance[n:]).all()
    assert (few.member_along_track[n:] == -1).all()
    assert (few.member_along_track[:n] >= 0).all()
    assert extract_signatures(line, TWO, members=0).sizes["member"] == 0


def test_the_choice_of_members_is_of_the_pixels_alone() -> None:
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
    np.testing.assert_allclose(summarise(values, centre).centre, 0.1, atol=0.0015)


def test_few_values_and_none() -> None:
    values = np.array(
        [[0.2, np.nan, np.nan, 0.5], [0.2, 0.4, np.nan, np.inf], [0.2, 0.6, np.nan, np.nan]], "f4"
    )
    found = summarise(values, "trimmed_mean")
    np.testing.assert_allclose(found.centre, [0.2, 0.5, np.nan, 0.5], rtol=1e-6)
    np.testing.assert_allclose(found.sd, [0.0, 0.1 * np.sqrt(2), np.nan, np.nan], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(np.isnan(found.quantiles).any(axis=0), [False, False, True, False])


# --- the same bits -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunks", CHUNKINGS[1:])
def test_the_same_bits_whatever_the_chunks(chunks: Any) -> None:
    line = made()
    assert_same_bits(extract_signatures(line.chunk(chunks), TWO), extract_signatures(line, TWO))


RAW = Regions((Region("a", [(0, 0), (20, 0), (20, 39), (0, 30)]), Region("b", [(4, 20), (9, 20), (9, 38)])))


def raw(**more: Any) -> xr.Dataset:
    """Return a line of counts with smile, noise that is known, and errors of the gain that are."""
    line = simulate_line(lines=40, bands=24, columns=24, smile_nm=1.5, seed=3, **more)
    gain_u = {"radiance_gain_u_systematic": ((), np.float32(0.04), {"units": "1"})}
    return line.drop_vars([name for name in line if str(name).startswith("true_")]).assign(gain_u)


@pytest.mark.parametrize("chunks", CHUNKINGS[1:])
def test_the_same_bits_from_counts(chunks: Any) -> None:
    line = raw()
    counts = line.counts.chunk(chunks)
    expected = line.paint.signatures(RAW, smooth="box")
    assert_same_bits(line.assign(counts=counts).paint.signatures(RAW, smooth="box"), expected)
    assert (expected.reflectance_u_systematic[:, 1:-1] > 0).all()


@pytest.mark.slow
def test_the_same_bits_on_a_cluster_of_two_processes() -> None:
    distributed = pytest.importorskip("distributed")
    line = raw().chunk({"along_track": 8})
    expected = extract_signatures(line, RAW)
    told: list[tuple[int, int]] = []
    local = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    )
    with local, distributed.Client(local):
        found = extract_signatures(line, RAW)
        watched = extract_signatures(line, RAW, progress=lambda *each: told.append(each))
    assert_same_bits(found, expected)
    assert_same_bits(watched, expected)
    assert told[-1][0] == told[-1][1]


def test_the_order_of_regions_changes_nothing() -> None:
    line = made()
    forward = extract_signatures(line, TWO)
    backward = extract_signatures(line, Regions(TWO.regions[::-1]))
    for name in (*SPECTRA, "n_eff"):
        both = [library[name].sel(paint="roof", drop=True) for library in (forward, backward)]
        size = min(int(library.n.sel(paint="roof")) for library in (forward, backward))
        both = [array.isel(member=slice(size), missing_dims="ignore") for array in both]
        np.testing.assert_array_equal(*both)


@pytest.mark.parametrize("size", [3_000, 12_000])
def test_regions_read_some_bands_at_a_time(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = extract_signatures(made(), TWO)
    from_counts = extract_signatures(raw(), RAW)
    monkeypatch.setattr(extraction, "GATHERED_BYTES", size)
    told: list[tuple[int, int]] = []
    found = extract_signatures(made(), TWO, progress=lambda *each: told.append(each))
    assert_same_bits(found, expected)
    assert told[-1][0] == told[-1][1] == (1000 if size > 10_000 else 3000)
    assert told == sorted(told)
    assert_same_bits(extract_signatures(raw(), RAW), from_counts)
    if size == 3_000:
        with pytest.raises(SchemaError, match=r"'hood' has \d+ pixels.*cut it smaller"):
            extract_signatures(made(), TWO, centre="geometric_median")


@pytest.mark.slow
def test_a_large_region_takes_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    lines, bands, columns = 304, 240, 128
    monkeypatch.setattr(extraction, "GATHERED_BYTES", 2 * 2**20)
    monkeypatch.setattr(independence, "_MOST_CELLS", 2**14)

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


# --- against the truth -------------------------------------------------------------------------------------


def patch_of(line: xr.Dataset, material: str) -> Region:
    """Return a rectangle of pixels that all see one material."""
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
        row = library.isel(paint=number)
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
    zenith, azimuth = hp.solar_position(library.time.values[1], *place)
    np.testing.assert_allclose([library.sun_zenith[1], library.sun_azimuth[1]], [zenith, azimuth], atol=1e-6)
    age = line.paint.reflectance().irradiance_age.values[along]
    assert library.irradiance_age.values[1] == age.max()
    assert 0 < age.max() < 2


# --- how sure it is ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("reach", "expected"), [(1, independence.SMEAR), (2, 4.0), (3, 9.0)])
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


def test_few_pixels_share_light_with_their_neighbours() -> None:
    along, across = np.divmod(np.arange(12), 4)
    assert effective_pixels(np.random.default_rng(0).random((12, 3)), along, across) == 12 / 1.3
    assert effective_pixels(np.zeros((1, 2)), along[:1], across[:1]) == 1.0
    # a region that says nothing, and one that is all the same
    along, across = np.divmod(np.arange(100), 10)
    assert effective_pixels(np.full((100, 2), np.nan), along, across) == 100 / 1.3
    assert 1.0 <= effective_pixels(np.full((100, 2), 0.3), along, across) <= 100.0


def test_more_pixels_are_never_worth_less() -> None:
    # noise without any correlation: from 32 pixels on it is told from values, and a camera still smears
    worth = []
    for count in (31, 32, 33):
        along, across = np.divmod(np.arange(count), 6)
        values = [np.random.default_rng(seed).standard_normal((count, 8)) for seed in range(20)]
        found = [effective_pixels(each, along, across) for each in values]
        assert max(found) <= count / 1.3
        worth.append(np.max(found))
    assert worth == sorted(worth)
    assert worth[2] == 33 / 1.3


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
    row = extract_signatures(line, Region("all", [(0, 0), (15, 0), (15, 39), (0, 39)])).isel(paint=0)
    n, n_eff = 640, float(row.n_eff)
    assert row.n == n
    whole = np.mean(u[:, 0].astype(float) ** 2)
    expected = [np.sqrt(whole / n_eff), 0.01 / np.sqrt(n_eff * 480 / n), np.nan, 0.04]
    np.testing.assert_allclose(row.reflectance_u_random[:4], expected, rtol=1e-5)
    np.testing.assert_allclose(
        row.reflectance_u_systematic[:4], [u[:, 0].mean(), 0.01, np.nan, 0.04], rtol=1e-5
    )


def test_uncertainty_of_a_rectangle_is_that_of_the_mean() -> None:
    line = raw().paint.reflectance(uncertainty=True)
    rectangle = Region("a", [(2, 3), (12, 3), (12, 30), (2, 30)])
    row = extract_signatures(line, rectangle, exclude=0).isel(paint=0)
    part = line.isel(along_track=slice(3, 31), cross_track=slice(2, 13))
    expected = hp.mean_uncertainty(part)
    # smile leaves columns without a value in the outermost bands
    inner = slice(1, -1)
    np.testing.assert_allclose(row.reflectance_u_systematic[inner], expected.u_systematic[inner], rtol=1e-5)
    alone = (expected.u_random * np.sqrt(expected.n_eff))[inner]
    np.testing.assert_allclose(row.reflectance_u_random[inner], alone / np.sqrt(row.n_eff), rtol=1e-5)
    assert row.reflectance_u_systematic.attrs["components"] == "radiance_gain_u_systematic"
    assert "electrons_per_count" in row.reflectance_u_random.attrs["components"]


def test_uncertainties_that_are_not_known_are_not_zero() -> None:
    library = extract_signatures(made(), TWO)
    assert np.isnan(library.reflectance_u_random).all()
    assert library.reflectance_u_random.attrs["components"] == "none known"
    line = raw().drop_vars("radiance_gain_u_systematic")
    library = extract_signatures(line, RAW)
    assert np.isnan(library.reflectance_u_systematic).all()
    assert (library.reflectance_u_random[:, 1:-1] > 0).all()
    np.testing.assert_array_equal(np.isnan(library.reflectance_u_random), np.isnan(library.reflectance))


# --- flags, smoothing and refusals -------------------------------------------------------------------------


def test_excluded_flags_are_the_users_choice() -> None:
    line = made()
    everything = extract_signatures(line, TWO, exclude=0)
    assert (everything.n_excluded == 0).all()
    assert everything.quality.values.tolist() == [64 | 32] * 2
    assert everything.attrs["exclude"] == "none"
    strict = extract_signatures(line, TWO, exclude=Quality.GLINT | Quality.LOW_SUN)
    assert (strict.n < extract_signatures(line, TWO).n).all()
    assert strict.attrs["exclude"] == "low_sun glint"
    assert (extract_signatures(line.drop_vars("quality"), TWO).n_excluded == 0).all()


def test_all_regions_with_too_few_pixels_are_named() -> None:
    line = made()
    line["quality"].values[:] = int(Quality.SHADOW)
    with pytest.raises(SchemaError) as caught:
        extract_signatures(line, TWO)
    told = str(caught.value)
    for region in TWO:
        size = pixels(region, line)[0].size
        assert f"{region.name!r}: 0 of {size} pixels are left, expected 5 (100% shadow)" in told, told
    beyond = Regions(
        (TWO[0], Region("far", [(90, 90), (99, 90), (99, 99)]), Region("off", [(90, 0), (99, 0), (99, 9)]))
    )
    with pytest.raises(SchemaError, match=r"(?s)'far' holds no pixel.*40 lines of 16 columns.*'off'"):
        extract_signatures(line, beyond)


def test_a_pixel_without_any_value_is_left_out() -> None:
    line = made()
    line["reflectance"].values[5, :, 3] = np.nan
    line["quality"].values[:] = 0
    assert extract_signatures(line, TWO).n_excluded.values.tolist() == [1, 0]


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
def test_one_bad_band_touches_its_window_only(method: str) -> None:
    line = made()
    line["reflectance"] = line.reflectance.fillna(0.3)
    smoothing = {"method": method, "window": 5}
    whole = extract_signatures(line, TWO, smooth=smoothing)
    holed = line.copy(deep=True)
    holed["reflectance"].values[:, 6, :] = np.nan
    found = extract_signatures(holed, TWO, smooth=smoothing)
    for name in SPECTRA:
        array, before = (library[name].transpose(..., "band").values for library in (found, whole))
        same = np.array([np.array_equal(array[..., k], before[..., k], equal_nan=True) for k in range(12)])
        assert same.tolist() == [True] * 4 + [False] * 5 + [True] * 3, name
        assert np.isfinite(array[..., :6][before[..., :6] == before[..., :6]]).all()
    assert found.attrs["smoothing"].lower().startswith(method)
    assert whole.attrs["smoothing"] != extract_signatures(line, TWO).attrs["smoothing"] == "none"
    with pytest.raises(SchemaError, match="smoothed already"):
        extract_signatures(line.paint.smooth("box", 3), TWO, smooth="box")
    assert extract_signatures(line.paint.smooth("box", 3), TWO).attrs["smoothing"] == "box, 3 bands"


# --- corrections -------------------------------------------------------------------------------------------

SMILE = ("wavelength_shift", ("cross_track", np.linspace(-1.0, 1.0, 16), {"units": "nm"}))


@pytest.mark.parametrize("smile", [False, True])
def test_what_was_corrected_is_said(smile: bool) -> None:
    line = made().assign_coords(dict([SMILE] if smile else []))
    tilted = line.reflectance.assign_attrs(tilt="tilted by 3 degree")
    removed = hp.remove_mirrored_sky(line.assign(reflectance=tilted), sun_zenith=40.0)
    library = extract_signatures({"a": removed, "b": line}, on_lines("a", "b"), smooth="box")
    text = removed.reflectance.attrs["mirrored_sky_removed"]
    assert library.attrs["corrections"] == f"mirrored_sky_removed: {text}; tilt: tilted by 3 degree; none"
    assert library.reflectance.attrs["mirrored_sky_removed"] == f"{text}; none"
    assert library.reflectance.attrs["tilt"] == "tilted by 3 degree; none"
    with pytest.raises(SchemaError, match="it was before"):
        hp.remove_mirrored_sky(library, sun_zenith=40.0)
    lit = hp.correct_light(line, direct=0.9, sun_zenith=40.0)
    assert extract_signatures(lit, TWO).attrs["corrections"].startswith("light_corrected: direct 0.9")
    assert extract_signatures(line, TWO).attrs["corrections"] == "none"
    assert "tilt" not in line.reflectance.attrs


@pytest.mark.parametrize("chunks", CHUNKINGS[1:])
def test_the_same_bits_without_the_mirrored_sky(chunks: Any) -> None:
    line = raw()
    lazy = line.assign(counts=line.counts.chunk(chunks), time=line.time.chunk(along_track=7))
    expected = line.paint.signatures(RAW, specular_sky=True, smooth="box")
    assert_same_bits(lazy.paint.signatures(RAW, specular_sky=True, smooth="box"), expected)
    assert expected.attrs["corrections"].startswith("mirrored_sky_removed: F0 0.04")


def test_the_mirrored_sky_is_subtracted() -> None:
    line = raw()
    seen, less = (line.paint.signatures(RAW, specular_sky=sky) for sky in (False, True))
    stamps = (line[name].values for name in ("time", "latitude", "longitude"))
    zenith = float(hp.solar_position(*stamps)[0].mean())
    taken = 0.04 * hp.sun.diffuse_fraction(line.wavelength.values, zenith)
    assert taken.max() > 0.01
    for name in ("reflectance", "reflectance_quantiles", "member_reflectance"):
        lower = (seen[name] - less[name]).transpose(..., "band").mean("paint").values[..., 1:-1]
        np.testing.assert_allclose(lower, np.broadcast_to(taken[1:-1], lower.shape), atol=1e-6)
    np.testing.assert_allclose(less.reflectance_sd, seen.reflectance_sd, rtol=1e-3)
    low = line.paint.signatures(RAW, specular_sky=True, sun_zenith=80.0)
    assert (low.reflectance[:, 2] < less.reflectance[:, 2]).all()
    assert "sun zenith 80 degree" in low.attrs["corrections"]


def test_a_mirrored_sky_that_cannot_be_subtracted() -> None:
    line = made()
    with pytest.raises(SchemaError, match="give sun_zenith="):
        extract_signatures(line, TWO, specular_sky=True)
    with pytest.raises(SchemaError, match="specular_sky=True as well"):
        extract_signatures(line, TWO, sun_zenith=30.0)
    removed = hp.remove_mirrored_sky(line.assign_coords(dict([SMILE])), sun_zenith=40.0)
    with pytest.raises(SchemaError, match="it was before"):
        extract_signatures(removed, TWO, specular_sky=True, sun_zenith=40.0)


def test_every_wrong_option_is_told() -> None:
    with pytest.raises(SchemaError) as caught:
        extract_signatures(
            made(), Regions(()), exclude="glint", members=-1, centre="mean", min_pixels=0  # type: ignore[arg-type]
        )  # fmt: skip
    told = str(caught.value)
    assert all(
        word in told
        for word in ("no region", "exclude='glint'", "members=-1", "centre='mean'", "min_pixels=0")
    )
    with pytest.raises(SchemaError, match="line is int"):
        extract_signatures(3, TWO)  # type: ignore[arg-type]
    with pytest.raises(SchemaError, match="cannot compute reflectance"):
        extract_signatures(made().drop_vars("reflectance"), TWO)
    with pytest.raises(SchemaError, match="'wavelength' is missing"):
        extract_signatures(made().drop_vars("wavelength"), TWO)


# --- several lines, and the library ------------------------------------------------------------------------


def on_lines(*names: str) -> Regions:
    return Regions(tuple(Region(f"p{k}", TWO[0].polygon, flightline=name) for k, name in enumerate(names)))


def test_regions_of_several_flight_lines() -> None:
    lines = {"raw_0": made(), "raw_9": made(seed=9).chunk({"along_track": 8}), "raw_18": made(seed=5)}
    regions = on_lines("raw_9", "raw_0", "raw_9")
    library = extract_signatures(lines, regions)
    assert library.flightline.values.tolist() == ["raw_9", "raw_0", "raw_9"]
    for number, region in enumerate(regions):
        alone = extract_signatures(lines[region.flightline].assign_attrs(name=region.flightline), region)
        for name in ("reflectance", "n", "n_eff", "quality_share"):
            np.testing.assert_array_equal(library[name][number], alone[name][0])
    tree = xr.DataTree.from_dict({f"/flightlines/{name}": line for name, line in lines.items()})
    assert_same_bits(extract_signatures(tree, regions), library)
    other = made(seed=1).assign_coords(wavelength=("band", np.linspace(400.0, 901.0, 12), {"units": "nm"}))
    with pytest.raises(SchemaError, match="bands of 'raw_0' are not those of 'raw_9'"):
        extract_signatures({**lines, "raw_0": other}, regions)


def test_a_region_of_another_line_is_never_taken_for_this_one() -> None:
    with pytest.raises(SchemaError, match=r"'p0' is of flight line 'raw_7'; there is 'raw_0'"):
        extract_signatures(made(), on_lines("raw_7"))
    with pytest.raises(SchemaError, match=r"(?s)'p0' names no flight line; there is 'a', 'b'.*'p1' is of"):
        extract_signatures({"a": made(), "b": made()}, on_lines("", "c"))
    nameless = made()
    del nameless.attrs["name"]
    assert extract_signatures(nameless, on_lines("raw_7")).n.size == 1
    with pytest.raises(SchemaError, match="'p1' is of flight line 'raw_8'"):
        extract_signatures(nameless, on_lines("raw_7", "raw_8"))


def test_the_library_is_that_of_the_table() -> None:
    library = extract_signatures(made(), TWO)
    for name, row in LIBRARY_VARIABLES.items():
        array = library[name]
        assert array.dims == row.dims, name
        assert array.dtype == (object if row.dtype == "str" else row.dtype), name
        assert row.attrs.items() <= array.attrs.items(), name
        assert (name in library.coords) == row.coordinate, name
    assert set(library.data_vars) <= set(LIBRARY_VARIABLES)
    assert library["colour"].values.tolist() == ["red", ""]
    np.testing.assert_array_equal(library["year"], [2019.0, np.nan])
    assert regions_from(json.loads(library["region"].values[1]))[0] == TWO[1]
    assert library.attrs["regions"] == TWO.digest
    assert library.quality.attrs["flag_masks"].tolist() == [int(flag) for flag in Quality]
    assert VARIABLES["reflectance"].dims == CUBE


def test_properties_that_are_no_names_stay_in_the_region() -> None:
    odd = {
        "n": 3,
        "a b": 1,
        "x/y": 2,
        "__hidden": 3,
        "nested": {"a": [1]},
        "ok": True,
        "big": 2**70,
        "band": 1,
    }
    library = extract_signatures(made(), Region("a", TWO[0].polygon, properties=odd))
    assert library["nested"].item() == '{"a": [1]}'
    assert library["ok"].item() == "true"
    assert library["big"].item() == str(2**70)
    assert not {"a b", "x/y", "__hidden", "band"} & set(library.variables)
    assert library["n"].item() > 3
    assert '"x/y": 2' in library["region"].item()
    many = Region("a", TWO[0].polygon, properties={f"p{k}": k for k in range(500)})
    assert len(extract_signatures(made(), many).coords) < 80


def test_the_store_gives_back_the_same_bits(tmp_path: Path) -> None:
    library = extract_signatures(
        raw(), Regions((Region("Škoda, red", RAW[0].polygon, properties={"year": 2019}), RAW[1]))
    )
    for group in (None, "signatures"):
        path = hp.to_store(library, tmp_path / f"{group}.zarr", group)
        found = xr.open_zarr(path, group=group, consolidated=False).load()
        xr.testing.assert_equal(found, library)
        for name in library.data_vars:
            assert found[name].dtype == library[name].dtype
            assert found[name].values.tobytes() == library[name].values.tobytes(), name
        assert found.attrs.items() >= library.attrs.items()
    hp.to_store(library, tmp_path / "None.zarr")  # the same content: nothing is done


def test_reflectance_in_per_cent() -> None:
    line = made()
    percent = line.assign(reflectance=(line.reflectance * np.float32(100)).assign_attrs(units="percent"))
    a, b = (extract_signatures(each, TWO).reflectance for each in (line, percent))
    np.testing.assert_allclose(a, b, rtol=1e-5)


def test_signatures_of_a_map() -> None:
    line = made()
    grid = (
        line[["reflectance", "wavelength"]]
        .rename(along_track="y", cross_track="x")
        .transpose("y", "x", "band")
    )
    grid = grid.assign_coords(x=100.0 + np.arange(16), y=500.0 - np.arange(40))
    region = Region("a", [(103, 480), (110, 480), (110, 490), (103, 490)])
    placed = extract_signatures(grid, Regions((region,), "map", "EPSG:32618"))
    drawn = extract_signatures(line.drop_vars("quality"), Region("a", [(3, 10), (10, 10), (10, 20), (3, 20)]))
    np.testing.assert_array_equal(placed.reflectance, drawn.reflectance)


def test_the_accessor_says_the_same() -> None:
    line = made().rename(along_track="downtrack", cross_track="crosstrack", band="bands")
    assert_same_bits(line.paint.signatures(TWO, members=9), extract_signatures(made(), TWO, members=9))
    odd = made().rename(along_track="flown")
    assert odd.paint.signatures(TWO, dims={"along_track": "flown"}).sizes["paint"] == 2


def test_smile_is_taken_out_before_pixels_are_put_together() -> None:
    # a steep edge, seen by every column at wavelengths of its own
    line = made(bands=40)
    nominal = line.wavelength.values
    shift = np.linspace(-6.0, 6.0, 16)
    edge = 0.1 + 0.6 / (1 + np.exp(-(nominal[:, None] + shift - 650.0) / 12.0))
    line["reflectance"] = (CUBE, np.broadcast_to(edge.astype("f4"), (40, 40, 16)).copy(), {"units": "1"})
    smiling = line.assign_coords(wavelength_shift=("cross_track", shift, {"units": "nm"}))
    expected = 0.1 + 0.6 / (1 + np.exp(-(nominal - 650.0) / 12.0))
    region = Region("a", [(0, 0), (15, 0), (15, 39), (0, 39)])
    found = extract_signatures(smiling, region).isel(paint=0)
    inner = slice(1, -1)
    np.testing.assert_allclose(found.reflectance[inner], expected[inner], atol=2e-3)
    assert found.reflectance_sd[inner].max() < 2e-3
    assert extract_signatures(line, region).reflectance_sd.max() > 0.03
    assert found.attrs["spectral_axis"] == "nominal wavelengths"
