"""Paint signatures against plain numpy, and whatever the chunks."""

import tracemalloc
from typing import Any

import dask.array as da
import numpy as np
import pytest
from support.analytic_scenes import as_line, bonnet, smooth_edge, wavelengths
from support.painted_lines import CHUNKINGS, RAW, SPECTRA, TWO, assert_same_bits, made, raw

from hyperpaint import Quality, Region, Regions, SchemaError, extract_signatures, surroundings
from hyperpaint.base.schema import CUBE
from hyperpaint.paints.signatures import extraction, pixel_statistics
from hyperpaint.paints.signatures.pixel_statistics import chosen_members, geometric_median, summarise
from hyperpaint.regions import pixels
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


def test_the_same_bits_from_counts() -> None:
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
    with pytest.raises(SchemaError, match=r"'hood'.*region-too-large"):
        extract_signatures(line, TWO, centre="geometric_median")


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
