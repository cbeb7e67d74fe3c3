"""The simulated monochromator sweep against integrals written out here, and the effect of every switch."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.refusals import expect_words

from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.base.schema import SWEEP_VARIABLES
from hyperpaint.cli import program as cli
from hyperpaint.simulation import (
    SimulationSettings,
    SweepSettings,
    simulate_collect,
    simulate_line,
    simulate_sweep,
    write_sweep,
)
from hyperpaint.simulation.camera import nominal_responsivity

QUIET: dict[str, Any] = {"noise": False, "quantise": False}
EVEN: dict[str, Any] = {"nonuniformity": 0.0, "smile_nm": 0.0}
SMALL: dict[str, Any] = {"steps": 7, "bands": 272, "columns": 3}


def above_dark(sweep: xr.Dataset) -> xr.DataArray:
    return sweep.counts - sweep.dark_counts


def energy(sweep: xr.Dataset) -> xr.DataArray:
    return sweep.flux * sweep.capture_fraction * sweep.exposure_time


# --- the integral -----------------------------------------------------------------------------------------


def gaussian(offset: np.ndarray, fwhm: float) -> np.ndarray:
    sigma = fwhm / (2 * np.sqrt(2 * np.log(2)))
    return np.exp(-0.5 * (offset / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


def triangle(offset: np.ndarray, fwhm: float) -> np.ndarray:
    return np.maximum(1 - np.abs(offset) / fwhm, 0) / fwhm


def trapezoid(offset: np.ndarray, one: float, other: float) -> np.ndarray:
    # Return two boxes convolved: how much of a box ``one`` wide lies in a box ``other`` wide
    return np.maximum(
        np.minimum(offset + one / 2, other / 2) - np.maximum(offset - one / 2, -other / 2), 0
    ) / (one * other)


def oracle(sweep: xr.Dataset, step: int, band: int, column: int) -> float:
    # Return the counts above dark of one element by a sum over 100 000 points
    centre, width = float(sweep.step_wavelength[step]), float(sweep.monochromator_fwhm)
    nm = np.linspace(centre - 4 * width, centre + 4 * width, 100_001)
    line = {"gaussian": gaussian, "triangle": triangle}[sweep.monochromator_shape](nm - centre, width)
    wavelength = sweep.true_wavelength.values
    offset = nm - wavelength[band] - float(sweep.true_wavelength_shift[column])
    fwhm = float(sweep.true_fwhm[band])
    if sweep.true_srf_shape == "gaussian":
        shape = gaussian(offset, fwhm)
    else:
        shape = trapezoid(offset, fwhm, np.gradient(wavelength)[band])
    return float(
        np.sum(line * (nominal_responsivity(20.0)(nm) * shape)) * (nm[1] - nm[0]) * energy(sweep)[step]
    )


@pytest.mark.parametrize("width", [0.3, 2.0, 12.0])
@pytest.mark.parametrize("monochromator", ["gaussian", "triangle"])
@pytest.mark.parametrize("camera", ["gaussian", "slit"])
def test_every_element_against_a_plain_sum(camera: str, monochromator: str, width: float) -> None:
    sweep = simulate_sweep(
        steps=3, columns=40, first_step_nm=441.3, last_step_nm=955.0, srf_shape=camera, smile_nm=1.5,
        monochromator_fwhm_nm=width, monochromator_shape=monochromator, nonuniformity=0.0, fwhm_slope=0.15,
        dispersion_bow_nm=3.0, dark_level=0.0, dark_pattern=0.0, **QUIET,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    for step in range(3):
        seen = above_dark(sweep)[step].values
        peak = seen.max()
        for band, column in rng.choice(np.argwhere(seen > 0.01 * peak), 12):
            assert seen[band, column] == pytest.approx(
                oracle(sweep, step, band, column), abs=2.5e-5 * float(peak)
            )


@pytest.mark.parametrize("camera", ["gaussian", "slit"])
@pytest.mark.parametrize("width", [0.5, 2.0, 6.0, 12.0])
def test_line_area_is_the_responsivity_at_the_line(camera: str, width: float) -> None:
    # SUM_b counts / energy = responsivity per band spacing (physics 2.1), but for its curvature
    sweep = simulate_sweep(
        **SMALL,
        first_step_nm=450,
        last_step_nm=950,
        srf_shape=camera,
        monochromator_fwhm_nm=width,
        **EVEN,
        **QUIET,
    )
    truth = sweep.true_responsivity.isel(cross_track=0).values
    at_line = np.interp(sweep.step_wavelength, sweep.true_wavelength, truth)
    np.testing.assert_allclose(
        (above_dark(sweep).sum("band") / energy(sweep)).isel(cross_track=0), at_line, rtol=2e-3
    )
    gain = sweep.true_radiance_gain.isel(cross_track=0)
    np.testing.assert_allclose(
        gain * np.gradient(sweep.true_wavelength) * float(sweep.etendue) * truth, 1.0, rtol=1e-12
    )


def test_columns_of_an_uneven_slit() -> None:
    size: dict[str, Any] = {"steps": 2, "first_step_nm": 500, "last_step_nm": 800, "columns": 40}
    uneven = simulate_sweep(**size, column_nonuniformity=0.03, **EVEN, **QUIET)
    factor = above_dark(uneven).sum("band") / above_dark(simulate_sweep(**size, **EVEN, **QUIET)).sum("band")
    np.testing.assert_allclose(factor[0], factor[1], rtol=1e-4)
    assert 0.02 < float(factor[0].std()) < 0.04
    gain = uneven.true_radiance_gain.isel(band=100)
    np.testing.assert_allclose(gain * factor[0], float(gain[0] * factor[0, 0]), rtol=1e-4)


def test_columns_differ_by_their_own_factor_and_their_smile() -> None:
    plain = simulate_sweep(steps=1, first_step_nm=600, columns=21, seed=4, smile_nm=0.0, **QUIET)
    even = simulate_sweep(
        steps=1, first_step_nm=600, columns=21, seed=4, nonuniformity=0.0, smile_nm=0.0, **QUIET
    )
    lit = above_dark(even)[0].values > 1
    assert 0.01 < (above_dark(plain)[0].values[lit] / above_dark(even)[0].values[lit]).std() < 0.03
    bent = simulate_sweep(
        steps=1, first_step_nm=600, columns=21, seed=4, nonuniformity=0.0, smile_nm=1.5, **QUIET
    )
    counts = above_dark(bent)[0].values
    centre = (counts * np.arange(272)[:, None]).sum(axis=0) / counts.sum(axis=0)
    # an element of longer wavelength sees the line at a lower band
    np.testing.assert_allclose(
        (centre[10] - centre) * np.gradient(bent.true_wavelength)[90], bent.true_wavelength_shift, atol=0.01
    )


# --- the contract -----------------------------------------------------------------------------------------


def test_variables_are_those_of_the_table() -> None:
    sweep = simulate_sweep(
        steps=4, bands=12, columns=5, step_exposure_ms=[10.0, 20.0, 30.0, 40.0], beam_fwhm_columns=3.0
    )
    for name in sweep.variables:
        if str(name).startswith("true_"):
            continue
        row, array = SWEEP_VARIABLES[str(name)], sweep[name]
        assert array.dims in (row.dims, *row.alternatives)
        assert (array.dtype, array.attrs["units"]) == (row.dtype, row.units)
    # what a real sweep may state, and this camera has not
    absent = {"electrons_per_count", "read_noise", "band_shift_time", "level"}
    assert (set(SWEEP_VARIABLES) - set(sweep.variables), sweep.flux.dims) == (absent, ("step", "cross_track"))
    assert sweep.exposure_time.dims == sweep.dark_exposure_time.dims == ("step",)
    assert sweep.dark_counts.dims == ("step", "band", "cross_track")


def test_same_camera_in_the_lab_and_in_the_air() -> None:
    camera: dict[str, Any] = {
        "bands": 24, "columns": 9, "seed": 11, "smile_nm": 1.1, "srf_shape": "slit", "fwhm_nm": 5.0,
        "fwhm_slope": 0.1, "dispersion_bow_nm": 2.0, "bad_elements": 6, "dark_rate": 300.0,
    }  # fmt: skip
    lab = simulate_sweep(steps=2, **camera)
    line = simulate_line(lines=2, exposure_time_ms=6.0, **camera, **QUIET)
    np.testing.assert_allclose(lab.true_radiance_gain, line.radiance_gain, rtol=1e-6)
    assert int(np.isnan(line.radiance_gain).sum()) == int(lab.true_bad.sum()) == 6
    for name in ("wavelength", "wavelength_shift", "fwhm"):
        np.testing.assert_allclose(lab[f"true_{name}"], line[name], rtol=1e-12)
    np.testing.assert_allclose(lab.true_dark_bias + lab.true_dark_rate * 6e-3, line.dark_counts, rtol=1e-5)
    other = simulate_sweep(steps=2, **{**camera, "seed": 12})
    assert not np.allclose(other.true_radiance_gain, lab.true_radiance_gain, equal_nan=True)


# --- effects ----------------------------------------------------------------------------------------------


def test_bad_elements_see_no_light() -> None:
    sweep = simulate_sweep(**SMALL, bad_elements=40, **QUIET)
    assert int(sweep.true_bad.sum()) == 40
    assert float(abs(above_dark(sweep).where(sweep.true_bad)).max()) < 1e-4
    assert np.isnan(sweep.true_radiance_gain.values[sweep.true_bad.values]).all()


def test_dark_is_bias_and_rate() -> None:
    sweep = simulate_sweep(
        **SMALL, dark_rate=400.0, dark_exposure_ms=[5.0, 50.0, 200.0], step_exposure_ms=20.0, **QUIET
    )
    assert sweep.dark_counts.dims[0] == "step"
    np.testing.assert_array_equal(sweep.dark_exposure_time * 1e3, [5, 50, 200, 5, 50, 200, 5])
    expected = sweep.true_dark_bias + sweep.true_dark_rate * sweep.dark_exposure_time
    np.testing.assert_allclose(sweep.dark_counts, expected.transpose("step", ...), rtol=1e-5)
    unlit = sweep.counts.isel(step=0, band=-1)
    np.testing.assert_allclose(unlit, (sweep.true_dark_bias + 0.02 * sweep.true_dark_rate)[-1], rtol=1e-5)


def test_counts_grow_with_exposure_and_flux() -> None:
    one = above_dark(simulate_sweep(**SMALL, dark_rate=0.0, **QUIET)).astype(float)
    exposures = np.linspace(10, 70, 7)
    long = simulate_sweep(
        **SMALL, step_exposure_ms=exposures, beam_power_w=6e-6, dark_exposure_ms=50.0, **QUIET
    )
    factor = xr.DataArray(2 * exposures / 50.0, dims="step")
    np.testing.assert_allclose(above_dark(long), (one * factor).transpose("step", ...), atol=1e-3)


def test_beam_along_the_slit() -> None:
    beam: dict[str, Any] = {"steps": 9, "columns": 41, "beam_fwhm_columns": 10.0, "beam_wander_columns": 4.0}
    known = simulate_sweep(**beam, **EVEN, **QUIET)
    counts = above_dark(known).sum("band")
    centre = (counts * np.arange(41)).sum("cross_track") / counts.sum("cross_track")
    assert float(centre.max() - centre.min()) == pytest.approx(8.0, abs=0.3)
    area = (counts / energy(known)).where(known.flux > 0.2 * known.flux.max("cross_track"))
    np.testing.assert_allclose(area.max("cross_track"), area.min("cross_track"), rtol=1e-5)
    assert int((known.flux[0] >= 0.5 * known.flux[0].max()).sum()) in (10, 11)
    unknown = simulate_sweep(**beam, beam_recorded=False, **EVEN, **QUIET)
    assert unknown.flux.dims == ("step",)
    np.testing.assert_array_equal(unknown.counts, known.counts)
    np.testing.assert_allclose(unknown.true_flux.max("cross_track"), unknown.flux, rtol=0.02)


def test_power_meter_and_dial_are_off() -> None:
    exact = simulate_sweep(**SMALL, **QUIET)
    meter = simulate_sweep(**SMALL, flux_bias=0.05, flux_noise=0.01, **QUIET)
    np.testing.assert_array_equal(meter.counts, exact.counts)
    ratio = meter.flux / exact.flux
    assert float(ratio.mean()) == pytest.approx(1.05, abs=0.012)
    assert 0.002 < float(ratio.std()) < 0.03
    dial = simulate_sweep(**SMALL, monochromator_offset_nm=1.3, monochromator_jitter_nm=0.1, **EVEN, **QUIET)
    np.testing.assert_array_equal(dial.step_wavelength, exact.step_wavelength)
    off = dial.true_step_wavelength - dial.step_wavelength
    assert float(off.mean()) == pytest.approx(1.3, abs=0.2)
    assert float(off.std()) > 0.02
    counts = above_dark(dial)[3, :, 0]
    # the responsivity's slope pulls the centre of gravity by a hundredth
    assert float((counts * dial.true_wavelength).sum() / counts.sum()) == pytest.approx(
        float(dial.true_step_wavelength[3]), abs=0.05
    )


def test_stray_light_is_the_matrix_it_says() -> None:
    plain = above_dark(simulate_sweep(**SMALL, nonuniformity=0.0, **QUIET))
    hazy = simulate_sweep(**SMALL, nonuniformity=0.0, stray_light=0.02, **QUIET)
    share = hazy.true_stray_light.values
    np.testing.assert_allclose(share.sum(axis=0), 0.02, rtol=1e-12)
    assert ((above_dark(hazy)[3, 5] / above_dark(hazy)[3].max("band")) > 1e-6).all()
    mended = np.linalg.solve(np.eye(272) + share, above_dark(hazy)[3].values.astype(float))
    np.testing.assert_allclose(mended, plain[3], atol=2e-3)


def test_second_order_falls_at_twice_the_wavelength() -> None:
    sweep = simulate_sweep(
        steps=1, first_step_nm=450, columns=3, second_order=0.05, monochromator_fwhm_nm=2.0, **EVEN, **QUIET
    )
    counts, wavelength = above_dark(sweep)[0, :, 0].values.astype(float), sweep.true_wavelength.values
    late = wavelength > 800
    assert np.average(wavelength[late], weights=counts[late]) == pytest.approx(900.0, abs=0.2)
    assert counts[late].sum() == pytest.approx(0.05 * counts[~late].sum(), rel=1e-3)
    # as wide as camera and a monochromator of twice the width make it
    assert np.sqrt(np.average((wavelength[late] - 900) ** 2, weights=counts[late])) * 2 * np.sqrt(
        2 * np.log(2)
    ) == pytest.approx(np.hypot(6.0, 4.0), rel=0.01)


def test_nonlinearity_takes_its_share() -> None:
    straight = above_dark(simulate_sweep(**SMALL, **QUIET)).astype(float)
    bent = simulate_sweep(**SMALL, nonlinearity=0.04, **QUIET)
    np.testing.assert_allclose(above_dark(bent), straight - 0.04 * straight**2 / 4095, atol=2e-3)


# --- noise ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quantise", [False, True])
def test_noise_of_mean_and_variance(quantise: bool) -> None:
    size: dict[str, Any] = {"steps": 1, "first_step_nm": 600, "columns": 400, "frames": 25, **EVEN}
    exact = above_dark(simulate_sweep(**size, **QUIET))[0].values.astype(float)
    noisy = simulate_sweep(**size, quantise=quantise)
    error = noisy.counts[0].values - exact - noisy.true_dark_bias.values
    expected = exact / 20.0 + 0.25 + quantise / 12
    for lit in (exact > 500, exact < 1e-3):
        z = (error / np.sqrt(expected / 25))[lit]
        count = len(z)
        assert abs(z.mean()) < 5 / np.sqrt(count)
        assert z.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * count))
        ratio = (noisy.counts_variance[0].values / expected)[lit]
        assert ratio.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / 24 / count))
        assert ratio.std() == pytest.approx(np.sqrt(2 / 24), rel=0.1)
    if quantise:
        np.testing.assert_allclose(noisy.counts * 25, np.rint(noisy.counts * 25), atol=0.01)


def test_frames_drawn_together_are_as_frames_drawn_one_by_one() -> None:
    # Mean and variance have the distributions of real averages of whole counts
    rng, frames = np.random.default_rng(3), 8
    raw = np.rint(110.3 + 6.0 + np.sqrt(6.0 / 20 + 0.25) * rng.standard_normal((frames, 40_000)))
    means, variances = raw.mean(axis=0), raw.var(axis=0, ddof=1)
    sweep = simulate_sweep(
        steps=1, first_step_nm=600, columns=400, frames=frames, dark_level=110.3, dark_pattern=0.0, **EVEN
    )
    unlit = np.s_[0, -100:]
    assert np.std(sweep.counts.values[unlit]) == pytest.approx(np.sqrt((0.25 + 1 / 12) / frames), rel=0.02)
    assert means.std() == pytest.approx(np.sqrt((0.3 + 0.25 + 1 / 12) / frames), rel=0.02)
    assert np.mean(sweep.counts_variance.values[unlit]) / (0.25 + 1 / 12) == pytest.approx(
        np.mean(variances) / (0.3 + 0.25 + 1 / 12), rel=0.01
    )


def test_full_converter() -> None:
    sweep = simulate_sweep(**SMALL, beam_power_w=1e-4)
    assert float(sweep.counts.max()) == float(sweep.saturation_count) == 4095
    assert float(sweep.counts_variance.where(sweep.counts == 4095).max()) == 0.0
    assert float(sweep.counts.min()) > 0


def test_one_frame_has_no_variance() -> None:
    sweep = simulate_sweep(steps=2, bands=8, columns=4, frames=1)
    assert np.isnan(sweep.counts_variance).all()
    np.testing.assert_array_equal(sweep.counts, np.rint(sweep.counts))
    assert "counts_variance" not in simulate_sweep(steps=2, bands=8, columns=4, variance=False)


def test_seed_decides() -> None:
    size: dict[str, Any] = {"steps": 3, "bands": 16, "columns": 4}
    one, same = simulate_sweep(**size, seed=5), simulate_sweep(**size, seed=5)
    xr.testing.assert_identical(one, same)
    assert (one.counts != simulate_sweep(**size, seed=6).counts).any()


# --- stores -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dark_exposure", [None, [5.0, 50.0]])
def test_store_is_what_memory_holds(tmp_path: Path, dark_exposure: Any) -> None:
    size: dict[str, Any] = {"steps": 4, "bands": 16, "columns": 5, "stray_light": 0.01}
    seen: list[tuple[int, int]] = []
    path = write_sweep(
        tmp_path / "sweep.zarr",
        **size,
        dark_exposure_ms=dark_exposure,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    memory = simulate_sweep(**size, dark_exposure_ms=dark_exposure)
    with xr.open_zarr(path) as stored, xr.open_zarr(tmp_path / "sweep_truth.zarr") as truth:
        assert not [name for name in stored.variables if "true" in str(name)]
        assert "true_srf_shape" not in stored.attrs
        for name in (*stored.variables, *truth.variables):
            found = stored[name] if name in stored.variables else truth[name]
            np.testing.assert_array_equal(found, memory[name])
            assert (found.dims, found.attrs) == (memory[name].dims, memory[name].attrs)
            assert found.dtype == memory[name].dtype
        assert set(stored.variables) | set(truth.variables) == set(memory.variables)
        assert stored.counts.chunks[0] == (1, 1, 1, 1)


def test_store_is_replaced_only_on_request(tmp_path: Path) -> None:
    size: dict[str, Any] = {"steps": 2, "bands": 8, "columns": 3}
    path = write_sweep(tmp_path / "sweep.zarr", **size)
    with pytest.raises(StoreError, match="store-exists"):
        write_sweep(path, **size)
    write_sweep(path, **size, seed=1, truth=False, overwrite=True)
    assert not (tmp_path / "sweep_truth.zarr").exists()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "keep.txt").write_text("dear")
    with pytest.raises(StoreError, match="store-exists"):
        write_sweep(tmp_path / "notes", **size, overwrite=True)
    assert (tmp_path / "notes" / "keep.txt").is_file()
    (tmp_path / "notes" / "zarr.json").write_text('{"attributes": {"name": "lot"}, "node_type": "group"}')
    with pytest.raises(StoreError, match="store-exists"):
        write_sweep(tmp_path / "notes", **size, overwrite=True)
    assert (tmp_path / "notes" / "keep.txt").is_file()


def test_collect_with_its_sweep(tmp_path: Path) -> None:
    size: dict[str, Any] = {
        "scene": "plan", "lines": 8, "bands": 16, "columns": 6, "seed": 3, "srf_shape": "slit",
    }  # fmt: skip
    toml = simulate_collect(tmp_path / "with", **size, sweep={"steps": 5, "frames": 9, "noise": False})
    assert tomllib.loads(toml.read_text())["calibration"] == {"sweep": "lab/sweep.zarr"}
    lab = xr.open_zarr(toml.parent / "lab" / "sweep.zarr")
    truth = xr.open_zarr(toml.parent / "lab" / "sweep_truth.zarr")
    exact = xr.open_zarr(toml.parent / "calibration.zarr")
    assert (dict(lab.counts.sizes), int(lab.frame_count)) == ({"step": 5, "band": 16, "cross_track": 6}, 9)
    assert truth.attrs["true_srf_shape"] == exact.attrs["srf_shape"] == "slit"
    np.testing.assert_allclose(truth.true_radiance_gain, exact.radiance_gain, rtol=1e-6)
    without = simulate_collect(tmp_path / "without", **size)
    assert tomllib.loads(without.read_text())["calibration"] == {"path": "calibration.zarr"}
    assert not (without.parent / "lab").exists()
    for name in ("flight/raw_0", "dark/raw_0"):
        assert (toml.parent / name).read_bytes() == (without.parent / name).read_bytes()
    simulate_collect(toml.parent, **size, overwrite=True)
    assert not (toml.parent / "lab").exists()


def test_command_line_writes_a_sweep(tmp_path: Path) -> None:
    arguments = [
        "simulate",
        str(tmp_path / "sim"),
        "--scene",
        "plan",
        "--lines",
        "4",
        "--bands",
        "8",
        "--columns",
        "4",
        "--sweep",
    ]
    done = CliRunner().invoke(cli.main, arguments)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "sim" / "lab" / "sweep.zarr" / "zarr.json").is_file()


# --- settings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": 0}, {"monochromator_shape": "box"}, {"monochromator_fwhm_nm": 0.0}, {"frames": 2.5},
        {"monochromator_fwhm_nm": [1.0, 2.0]}, {"step_exposure_ms": -1.0}, {"dark_exposure_ms": []},
        {"stray_light": 2.0}, {"beam_fwhm_columns": 0.0}, {"capture_fraction": 0.0}, {"beam_recorded": 1},
        {"flux_noise": float("nan")}, {"srf_shape": "box"}, {"lines": 5},
        {"exposure_time_ms": 5.0}, {"colour": 1},
    ],
)  # fmt: skip
def test_wrong_settings(wrong: dict[str, Any]) -> None:
    with pytest.raises(SchemaError, match=next(iter(wrong))):
        SweepSettings.of(wrong)


def test_all_problems_are_listed_together() -> None:
    with pytest.raises(SchemaError) as caught:
        SweepSettings(steps=0, second_order=-1.0, monochromator_shape="box", beam_power_w="bright")  # type: ignore[arg-type]
    expect_words(str(caught.value), "steps", "second_order", "monochromator_shape", "beam_power_w")


def test_a_sweep_cannot_change_the_camera_of_a_flight(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match=r"smile_nm.*key-unknown"):
        SweepSettings.of({"smile_nm": 1.0}, SimulationSettings())
    with pytest.raises(SchemaError, match="seed"):
        simulate_collect(tmp_path / "sim", scene="plan", lines=4, bands=4, columns=4, sweep={"seed": 1})
    assert not (tmp_path / "sim").exists()
