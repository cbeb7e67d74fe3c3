"""Products whose scale, gain, smile or slit cannot be right are named, others pass, as plain arrays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from hyperpaint.cli.program import main
from hyperpaint.io.store import open_store
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.plausibility import KINDS
from hyperpaint.plausibility.judging import CubeSample, Product, judge_dark, judge_product
from hyperpaint.report.store_report import line_section
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows.pipeline import process

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
        light + RNG.normal(size=light.shape) * np.sqrt(light / 320.0), GAIN, NM, 128, 1, factor * ground,
        np.full(BANDS, 1.2 * factor), 1.0, 40.0, SHIFT, _sky,
    )  # fmt: skip
    return right._replace(**changes)


def _blocked(columns: int, share: float, wander: float = 0.0) -> Product:
    # ``wander``: amplitude of the logarithm of the ground's own step there, from block to block
    product = _product()
    step = np.log(share) + wander * np.cos(np.pi * np.arange(8.0))[:, None, None]
    return product._replace(light=product.light * np.exp(np.where(np.arange(COLUMNS) < columns, 0.0, step)))


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
        (_product(16.0, divisor=16), {"reflectance-level", "counts-multiple"}),
        (_product(gain=GAIN[::-1]), {"gain-order"}),
        (_product(gain=GAIN[:, ::-1]), {"gain-order"}),
        (_product(gain=np.roll(GAIN, 2, axis=0)), {"gain-order"}),
        (_product(gain=GAIN * (1.0 + 0.2 * RNG.normal(size=GAIN.shape))), {"gain-pattern"}),
        (_product(shift=-SHIFT), {"smile-sign"}),
        (_product(shift=0.5 * SHIFT), set()),
        (_in_bands(slice(20, 21), 10.0), {"band-jump"}),
        (_in_bands(slice(None, None, 2), 0.8), {"band-jump"}),
        (_in_bands(slice(20, None), 1.6), {"band-jump"}),
        (_in_bands(slice(39, 40), 0.7), set()),  # in the oxygen band
        (_in_bands(slice(20, 21), 1.15), set()),
        (_blocked(17, 0.5), {"swath-step"}),
        (_blocked(30, 0.88), {"swath-step"}),
        (_blocked(17, 0.3, wander=0.07), {"swath-step"}),
        (_blocked(17, 0.3, wander=0.3), set()),
        (_blocked(17, 0.85, wander=0.07), set()),
    ],
)
def test_products_that_pass_and_those_that_are_named(product: Product, named: set[str]) -> None:
    verdicts = list(judge_product(product))
    assert {verdict.kind for verdict in verdicts if not verdict.passes} == named
    assert {verdict.kind for verdict in verdicts} <= set(KINDS)


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
    (level,) = (verdict for verdict in judge_product(product) if verdict.kind.startswith("reflectance"))
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
