"""Collects that cannot be true, from the file to the refusal and on."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from campaigns import judged_collects
from click.testing import CliRunner
from support.plausible_collects import FAULTS, RECIPES, right_collect, wrong_collect
from support.refusals import expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning, SchemaError
from hyperpaint.cli.program import main
from hyperpaint.io.store import open_store
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.plausibility import KINDS, Finding
from hyperpaint.plausibility.judging import (
    CubeSample,
    Product,
    judge_dark,
    judge_irradiance,
    judge_navigation,
    judge_product,
    mean_dark,
)
from hyperpaint.report.store_report import line_section
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows.collects import check_collect
from hyperpaint.workflows.pipeline import process


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    simulate_collect(folder, scene="plan", lines=40, bands=40, columns=24, seed=3, truth=False)
    return folder


@pytest.fixture
def collect(flown: Path, tmp_path: Path) -> Path:
    return shutil.copytree(flown, tmp_path / "collect") / "collect.toml"


def _change(cube: Path, change: object) -> None:
    counts = np.fromfile(cube, "<u2")
    np.asarray(change(counts), "<u2").tofile(cube)  # type: ignore[operator]


def test_all_findings_are_shown_at_once_and_listed(collect: Path) -> None:
    for path in (collect, collect.parent):
        assert CliRunner().invoke(main, ["check", str(path)]).output.endswith("judgements passed\n")
    _change(collect.parent / "flight/raw_0", lambda counts: counts * 16)
    _change(collect.parent / "dark/raw_0", np.zeros_like)
    done = CliRunner().invoke(main, ["check", str(collect)])
    assert done.exit_code == 1
    expect_words(
        done.output,
        "[counts-over-range]",
        "multiples of 16: left-justified, above 4095",
        "raw_0: 100 % of the dark",
    )
    listed = CliRunner().invoke(main, ["check", "--list"])
    assert listed.exit_code == 0
    assert all(f"{name}  (" in listed.output for name in KINDS)


def test_what_cannot_be_true_is_processed_and_stored_where_accepted_alone(
    collect: Path, tmp_path: Path
) -> None:
    _change(collect.parent / "dark/raw_0", np.zeros_like)
    assert [finding.kind.name for finding in check_collect(collect)] == ["dark-of-zeros"]
    expect_errors(
        (
            CollectError,
            r"accept=.*dark-of-zeros",
            lambda: process(collect, tmp_path / "lot.zarr", reflectance="none"),
        ),
        (SchemaError, "accept='all'", lambda: process(collect, tmp_path / "lot.zarr", accept=["all"])),
    )
    assert not (tmp_path / "lot.zarr").exists()
    call = ["process", str(collect), "--out", str(tmp_path / "lot.zarr"), "--quiet"]
    refused = CliRunner().invoke(main, call)
    assert refused.exit_code == 2
    assert "--accept dark-of-zeros" in refused.output
    assert CliRunner().invoke(main, [*call, "--accept", "dark-of-zeros"]).exit_code == 0
    line = open_store(tmp_path / "lot.zarr", "flightlines/raw_0")
    assert "100 % of the dark" in line.attrs["accepted_findings"][0]


@pytest.mark.parametrize(
    ("factor", "stated", "code"),
    [
        (100.0, None, None),
        (1.0, None, "level"),
        (1e6, None, "impossible"),
        (100.0, "W m-2 sr-1 nm-1", "units-conflict"),
    ],
)
def test_the_level_of_a_radiance_cube_is_judged(
    collect: Path, factor: float, stated: str | None, code: str | None
) -> None:
    # the header says uW cm-2, so that 100 is the right factor
    flight, text = collect.parent / "flight", collect.read_text()
    counts, dark = (
        np.fromfile(collect.parent / place / "raw_0", "<u2").reshape(-1, 40, 24).astype("f4")
        for place in ("flight", "dark")
    )
    gain = xr.open_zarr(collect.parent / "calibration.zarr")["radiance_gain"].values
    (factor * (counts - dark.mean(axis=0)) * gain / 0.005).astype("<f4").tofile(flight / "raw_0")
    header = (flight / "raw_0.hdr").read_text().replace("data type = 12", "data type = 4")
    header = header.replace("III]}", "III],RADIANCE}") + ";Units = uW cm-2 sr-1 nm-1\n"
    (flight / "raw_0.hdr").write_text(header)
    text = text.replace("[calibration]\npath", "[dark]\n#").replace("[dark]\ncubes", "#")
    extra = f"fwhm_nm = 6.0\n{'' if stated is None else f'radiance_units = {stated!r}'}\n"
    collect.write_text(text.replace("bit_depth = 12\n", extra))
    if code == "units-conflict":
        expect_errors((CollectError, code, lambda: check_collect(collect)))
    else:
        names = [finding.kind.name for finding in check_collect(collect)]
        assert names == ([] if code is None else [f"reflectance-{code}"])


@pytest.mark.parametrize("is_subtracted", [True, False])
def test_counts_without_a_dark_that_stand_on_a_level(collect: Path, is_subtracted: bool) -> None:
    dark = np.fromfile(collect.parent / "dark/raw_0", "<u2").reshape(-1, 40 * 24).mean(axis=0)
    if is_subtracted:
        _change(
            collect.parent / "flight/raw_0",
            lambda counts: np.clip(counts.reshape(40, -1) - dark, 0, None).round(),
        )
    collect.write_text(collect.read_text().replace('cubes = ["dark/raw_0.hdr"]', 'cubes = "none"'))
    assert 'cubes = "none"' in collect.read_text()
    assert [f.kind.name for f in check_collect(collect)] == ["dark-missing"] * (not is_subtracted)


def test_status_words_and_counts_of_one_value(collect: Path) -> None:
    cube = collect.parent / "flight/raw_0"
    counts = np.fromfile(cube, "<u2")
    word = counts.copy()
    word[3 :: 40 * 24] = 65535
    word.tofile(cube)
    (finding,) = check_collect(collect)
    assert (finding.kind.name, finding.kind.refused) == ("stray-counts", False)
    # a band of words, over light that hardly varies, so that they are all that the picture shows
    frames = counts.reshape(40, 40, 24) // 64 + 400
    frames[:, 5] = 65000
    frames.tofile(cube)
    named = {each.kind.name for each in check_collect(collect)}
    expect_words(named, "counts-over-range", without=("byte-order",))
    # one value is not called left-justified
    np.full_like(counts, 65000).tofile(cube)
    (found,) = (each.found for each in check_collect(collect) if each.kind.name == "counts-over-range")
    assert found == "counts up to 65000, above 4095 in 100 % of the elements"


@pytest.mark.parametrize(
    ("band", "column", "step", "modulus"),
    [(0, 0, 97, 4096), (0, 1, 1, 4096), (3, 23, 7, 512), (5, 0, -3, 2000), (slice(None), 23, 1, 4096)],
)
def test_a_frame_counter_in_the_picture_is_named(
    collect: Path, band: int | slice, column: int, step: int, modulus: int
) -> None:
    def stamped(counts: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        frames = counts.reshape(40, 40, 24)
        frames[:, band, column] = (np.arange(40) * step % modulus).reshape(-1, *[1] * isinstance(band, slice))
        return frames

    _change(collect.parent / "flight/raw_0", stamped)
    (finding,) = (each for each in check_collect(collect) if each.kind.name == "frame-counter")
    assert f"band {0 if isinstance(band, slice) else band} of column {column}" in finding.found


def test_a_fore_optic_in_the_files_is_named(collect: Path, tmp_path: Path) -> None:
    for path in (collect.parent / "asd").glob("*.asd"):
        data = bytearray(path.read_bytes())
        data[394:396] = (25).to_bytes(2, "little")
        path.write_bytes(data)
    with pytest.warns(PaintWarning, match="fore-optic-wrong"):
        (finding,) = check_collect(collect)
    assert (finding.kind.name, finding.found) == ("irradiance-receptor", "fore optic of 25 degree")


def test_a_record_that_stands_still_matters_to_reflectance_only(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = Finding(KINDS["irradiance-constant"], "raw_0", "2 of 2 spectra", "spectra that differ")
    monkeypatch.setattr("hyperpaint.plausibility.judging.judge_irradiance", lambda *_: iter([still]))
    expect_errors(
        (
            CollectError,
            "irradiance-constant",
            lambda: process(collect, tmp_path / "lot.zarr", reflectance="none"),
        )
    )
    process(collect, tmp_path / "lot.zarr", to="radiance", reflectance="none")


def test_darks_of_other_exposures_angles_and_a_record_of_zeros(collect: Path) -> None:
    # Bias and rate are fitted to darks before and after at other exposures; their mean is no dark
    line = hp.open_collect(collect)["flightlines/raw_0"].to_dataset()
    dark, exposure = line["dark_counts"].squeeze(drop=True), float(line["exposure_time"].mean())
    bias = dark.transpose("band", "cross_track").values.astype(float)
    factors = np.array([0.5, 10.0, 50.0])
    darks = bias + (factors[:, None, None] - 1.0) * 0.05 * bias
    several = line.drop_vars(["dark_counts", "dark_time", "dark_exposure_time"], errors="ignore").assign(
        dark_counts=(("dark_time", "band", "cross_track"), darks.astype("float32")),
        dark_exposure_time=("dark_time", factors * exposure),
    )
    found, is_measured = mean_dark(several)
    np.testing.assert_allclose(found, bias, rtol=1e-4)
    assert not is_measured
    assert mean_dark(line)[1]
    # angles that nothing measured are no gap
    for lost, is_gap in ((("roll", "pitch", "heading"), False), (("latitude",), True)):
        without = line.assign_coords({key: line[key] * np.nan for key in lost})
        assert bool([*judge_navigation("raw_0", without)]) is is_gap
    # a record of zeros is no daylight
    (finding,) = judge_irradiance("raw_0", line.assign(irradiance=line["irradiance"] * np.nan))
    assert finding.kind.name == "irradiance-level"
    assert "zero or undefined" in finding.found


def test_a_cube_that_lost_its_first_frame_or_its_name_is_only_said(collect: Path) -> None:
    flight = collect.parent / "flight"
    for ending in ("", ".hdr"):
        (flight / f"raw_0{ending}").rename(flight / f"raw_7{ending}")
    collect.write_text(collect.read_text().replace("flight/raw_0", "flight/raw_7"))
    assert {each.kind.name for each in check_collect(collect)} == {"first-frame"}


def test_a_flag_on_many_pixels_is_said(collect: Path, tmp_path: Path) -> None:
    def clipped(counts: np.ndarray) -> np.ndarray:
        columns = counts.reshape(40, 40, 24)
        columns[..., :8] = 4095
        return columns

    _change(collect.parent / "flight/raw_0", clipped)
    with pytest.warns(PaintWarning, match="33 % saturated"):
        process(collect, tmp_path / "lot.zarr", reflectance="none")


# --- A thinned round of the campaign of wrong and right collects ---

UNSEEN = {"lost frames, by the picture"}  # no promise: an edge of a field across the track looks the same


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # One collect for all faults; the campaign draws one for each
    folder = tmp_path_factory.mktemp("right") / "c"
    simulate_collect(
        folder, scene="plan", truth=False, seed=17, lines=160, bands=90, columns=40, irradiance_noise=0.002
    )
    return folder


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_every_fault_is_named(number: int, right: Path, tmp_path: Path) -> None:
    fault, strength = list(FAULTS)[number], number % 3
    texts = judged_collects.said_of(
        wrong_collect(tmp_path / "c", fault, strength, 17, right), whole=fault == "flagged pixels"
    )
    assert judged_collects.is_named(fault, texts) or fault in UNSEEN, texts


@pytest.mark.campaign
@pytest.mark.parametrize("kind", [kind for kind in RECIPES if kind != "traced"])
def test_right_ones_pass_without_a_word(kind: str, tmp_path: Path) -> None:
    assert judged_collects.said_of(right_collect(tmp_path / "c", kind, seed=17)) == []


@pytest.mark.real_data
def test_real_files_pass_without_a_word(shared_data: Path) -> None:
    said = judged_collects.judge_real(shared_data)
    assert len(said) == 14
    assert not any(said.values()), said


# --- Products whose scale, gain, smile or slit cannot be right are named, others pass, as plain arrays


NM, BANDS, COLUMNS = np.linspace(400.0, 1000.0, 66), 66, 40
FINE = np.arange(380.0, 1020.0, 0.5)
SKY = np.convolve(sum(ClearSky(40.0).irradiance(FINE)), np.hanning(25) / 12.0, "same")
SHIFT = np.linspace(-1.5, 1.5, COLUMNS) ** 2
RNG = np.random.default_rng(33)
GAIN = (1.0 + ((NM - 600.0) / 300.0) ** 2)[:, None] * (1.0 + 0.02 * RNG.normal(size=(BANDS, COLUMNS)))
GREEN = 0.05 + 0.4 / (1.0 + np.exp((715.0 - NM) / 12.0))


def _sky(nm: np.ndarray) -> np.ndarray:
    return np.interp(nm, FINE, SKY)


def _product(factor: float = 1.0, white: float = 0.0, **changes: Any) -> Product:
    # Return grey and green ground of a sunny day, or a white one, with reflectance off by a factor
    share = np.linspace(0.1, 0.9, 8)[:, None, None] + 0.003 * RNG.normal(size=(8, 1, COLUMNS))
    ground = (
        share * 0.1 + (1.0 - share) * GREEN[:, None] if not white else np.full((8, BANDS, COLUMNS), white)
    )
    sky = np.stack([_sky(NM + shift) for shift in SHIFT], axis=1)
    light = 4000.0 * ground * sky / GAIN
    right = Product(
        light + RNG.normal(size=light.shape) * np.sqrt(light / 320.0), GAIN, NM, 128, 1, 65520.0,
        factor * ground, np.full(BANDS, 1.2 * factor), 1.0, 40.0, SHIFT, _sky,
    )  # fmt: skip
    return right._replace(**changes)


def _blocked(columns: int, share: float, wander: float = 0.0) -> Product:
    # ``wander``: amplitude of the logarithm of the ground's own step there, from block to block
    product = _product()
    step = np.log(max(share, 1e-9)) + wander * np.cos(np.pi * np.arange(8.0))[:, None, None]
    return product._replace(light=product.light * np.exp(np.where(np.arange(COLUMNS) < columns, 0.0, step)))


def _partly(columns: int, share: float, clear: int) -> Product:
    # a blocked slit, along which edges of coloured ground lie in all blocks but `clear` ones
    product = _blocked(columns, share)
    edges = np.where(np.arange(8.0) < clear, 0.0, np.arange(8.0) / 8.0)[:, None, None]
    slope = edges * ((NM - 500.0) / 500.0)[:, None] * (np.arange(COLUMNS) >= columns)
    return product._replace(light=product.light * np.exp(slope))


def _in_bands(bands: slice, factor: float) -> Product:
    product = _product()
    assert product.reflectance is not None
    factors = np.ones((BANDS, 1))
    factors[bands] = factor
    return product._replace(reflectance=product.reflectance * factors)


def _edge(columns: int) -> Product:
    # asphalt beside meadow, at one column in all lines
    product = _product()
    surface = np.where(np.arange(COLUMNS)[None] < columns, 0.1, GREEN[:, None])
    return product._replace(light=4000.0 * surface * _sky(NM)[:, None] / GAIN * np.ones((8, 1, 1)))


@pytest.mark.parametrize(
    ("product", "named"),
    [
        (_product(), set()),
        (_product(white=0.95), set()),
        (_product(0.1, full_scale=None), set()),
        (_product(2.0), set()),
        (_product(1.6, zenith=75.0), set()),
        (_product(divisor=16), set()),
        (_product(divisor=16, saturation=4090.0), {"counts-multiple"}),
        (_product(gain=np.broadcast_to(GAIN.mean(axis=1, keepdims=True), GAIN.shape)), set()),
        (_product(shift=None, irradiance_at=None, reflectance=None), set()),
        (_edge(17), set()),
        (_product(np.pi), {"reflectance-level"}),
        (_product(1.6, white=0.95), {"reflectance-level"}),
        (_product(0.1), {"reflectance-level"}),
        (_product(0.01), {"reflectance-level"}),
        (_product(20.0, share=0.05), {"reflectance-impossible"}),
        (_product(1000.0), {"reflectance-impossible"}),
        (_product(0.001), {"reflectance-impossible"}),
        (_product(0.0), {"reflectance-impossible"}),  # a capped lens
        (_product(-1e-3), {"reflectance-impossible"}),
        (_product(16.0, divisor=16), {"reflectance-level", "counts-multiple"}),
        (_product(gain=GAIN[::-1]), {"gain-order"}),
        (_product(gain=GAIN[:, ::-1]), {"gain-order"}),
        (_product(gain=np.roll(GAIN, 2, axis=0)), {"gain-order"}),
        (_product(gain=GAIN * (1.0 + 0.2 * RNG.normal(size=GAIN.shape))), {"gain-pattern"}),
        (_product(shift=-SHIFT), {"smile-sign"}),
        (_product(shift=0.5 * SHIFT), set()),
        (_product(irradiance_at=lambda nm: _sky(nm + 10.0)), set()),
        (_in_bands(slice(20, 21), 10.0), {"band-jump"}),
        (_in_bands(slice(None, None, 2), 0.8), {"band-jump"}),
        (_in_bands(slice(20, None), 1.6), {"band-jump"}),
        (_in_bands(slice(39, 40), 0.7), set()),  # in the oxygen band
        (_in_bands(slice(20, 21), 1.15), set()),
        (_blocked(17, 0.5), {"swath-step"}),
        (_blocked(30, 0.88), {"swath-step"}),
        (_blocked(17, 0.0), {"swath-step"}),
        (_blocked(17, 0.3, wander=0.07), {"swath-step"}),
        (_blocked(17, 0.3, wander=0.3), set()),
        (_blocked(17, 0.85, wander=0.07), set()),
        (_partly(17, 0.5, clear=5), {"swath-step"}),
        (_partly(17, 0.5, clear=2), set()),
        # a lawn beside asphalt, as a camera of the near infrared records it
        (_blocked(17, 0.5)._replace(wavelength=NM + 320.0, shift=None, reflectance=None), set()),
    ],
)
def test_products_that_pass_and_those_that_are_named(product: Product, named: set[str]) -> None:
    findings = judge_product("line", product)
    assert {finding.kind.name for finding in findings if not finding.passes} == named


@pytest.mark.parametrize(
    ("dark", "numbers"),
    [
        (slice(17, None), ["17", "0.50"]),
        (slice(None, 17), ["16", "0.50"]),
        (slice(12, 17), ["12", "16", "0.50"]),
    ],
)
def test_the_darker_columns_are_named(dark: slice, numbers: list[str]) -> None:
    share = np.ones(COLUMNS)
    share[dark] = 0.5
    product = _product()
    findings = judge_product("line", product._replace(light=product.light * share))
    (step,) = (finding for finding in findings if not finding.passes)
    assert (step.kind.name, re.findall(r"[\d.]+", step.found)) == ("swath-step", numbers)


@pytest.mark.parametrize(
    ("product", "blamed", "slip"),
    [
        (_product(np.pi, share=1 / np.pi), "irradiance record", "3.142 (radiance taken for irradiance)"),
        (_product(20.0, share=0.05), "irradiance record", "20 (a filter"),
        (_product(1000.0), "gain of the calibration, the exposure time", "1000 (mW taken for W"),
        (_product(5.0), "exposure time", "5 (an exposure time"),
        (
            _product(16.0, divisor=16),
            "bit depth",
            "factor of about 16; known slips of this size: 16 (counts of 12 bits",
        ),
    ],
)
def test_the_likely_slip_of_a_level_has_its_factor(product: Product, blamed: str, slip: str) -> None:
    findings = judge_product("line", product)
    (level,) = (finding for finding in findings if finding.kind.name.startswith("reflectance"))
    assert blamed in level.found
    assert slip in level.found


@pytest.mark.parametrize(
    ("share", "named"),
    [(0.0, []), (0.002, []), (0.015, ["dark-faintly-lit"]), (0.05, ["dark-lit"])],
)
def test_light_in_the_dark(share: float, named: list[str]) -> None:
    light = 1000.0 * GREEN * _sky(NM) / GAIN.mean(axis=1)
    bias = 110.0 + 0.2 * np.arange(BANDS)[:, None] + 3.0 * RNG.normal(size=(BANDS, 200))
    scene = bias + light[:, None]
    dark = bias + share * light[:, None]
    found = judge_dark(
        "dark",
        dark,
        None,
        np.ones_like(dark),
        CubeSample(128, scene, scene, 1, np.zeros(scene.shape, bool)),
        4000.0,
    )
    assert [finding.kind.name for finding in found] == named


def test_what_passed_is_printed_stored_and_shown(tmp_path: Path) -> None:
    collect = simulate_collect(
        tmp_path / "c", scene="plan", lines=40, bands=30, columns=24, seed=3, truth=False
    )
    done = CliRunner().invoke(main, ["check", str(collect), "--json"])
    document = json.loads(done.output)
    assert document["findings"] == []
    assert {row["code"] for row in document["passed"]} >= {"reflectance-level", "gain-pattern"}
    process(collect, tmp_path / "lot.zarr", reflectance="none")
    line = open_store(tmp_path / "lot.zarr", "flightlines/raw_0")
    assert len(line.attrs["passed_checks"]) == len(document["passed"])
    (draw,) = (draw for name, draw in line_section(line, 64) if name == "checks")
    assert "the median reflectance is" in str(draw())
    cube = collect.parent / "flight/raw_0"
    np.fromfile(cube, "<u2").reshape(40, 30, 24)[:, ::-1].tofile(cube)
    document = json.loads(CliRunner().invoke(main, ["check", str(collect), "--json"]).output)
    wrong = {row["code"]: row for row in document["findings"]}
    assert wrong["gain-order"]["kind"] == "wrong"
    assert {"found", "expected", "likely_cause", "mend"} <= set(wrong["gain-order"])
