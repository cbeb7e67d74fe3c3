"""How sure reflectance is: coverage against simulated truth, laziness, refusals, what obsarray reads."""

from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error
from support.strategies import SHIFT, START, flight, labelled, stored, with_noise

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.radiometry.panels import Panel
from hyperpaint.simulation import simulate_line


@pytest.fixture
def known_line() -> xr.Dataset:
    return with_noise(flight(dtype=np.uint16).line, **SYSTEMATIC)


U = ("reflectance_u_random", "reflectance_u_systematic")
SYSTEMATIC = {
    "radiance_gain_u_systematic": 0.02,
    "irradiance_u_systematic": 0.015,
    "dark_counts_u_systematic": 0.5,
    "wavelength_u": 0.3,
}


# ---------------------------------------------------------------------------------------------- coverage

pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")


def test_random_part_covers_one_collect() -> None:
    line = simulate_line(
        lines=100, bands=40, columns=30, seed=5, first_wavelength=450.0, last_wavelength=900.0, glint=0.0
    )
    line["dark_counts_u_random"] = ((), np.sqrt((0.25 + 1 / 12) / 64), {"units": "count"})
    made, truth = reflectance(line, uncertainty=True).compute(), line.true_reflectance.values
    inside = np.isfinite(made.reflectance.values) & (truth >= 0.03) & (truth <= 0.9)
    z = ((made.reflectance.values - truth) / made.reflectance_u_random.values)[inside]
    assert z.size > 1e5
    assert abs(z.mean()) < 0.02
    assert abs(z.std() - 1.0) < 0.05
    assert abs((np.abs(z) < 1.0).mean() - 0.6827) < 0.01
    for low, high in ((0.03, 0.06), (0.06, 0.12), (0.12, 0.3), (0.3, 0.9)):
        some = z[(truth[inside] >= low) & (truth[inside] < high)]
        assert some.size > 2000
        assert abs(some.std() - 1.0) < 0.05, (low, high)


def many_draws(draws: int, *, seed: int = 0) -> tuple[xr.Dataset, np.ndarray]:
    # Return a line each of whose lines is a flight of its own errors, and its true reflectance
    # Four columns of reflectance 0.03 to 0.9 that grow with wavelength, under light that falls; every line
    # meets an irradiance sample of its own, and an instrument whose gain, dark and wavelengths are not as
    # calibrated
    rng = np.random.default_rng(seed)
    bands, levels, element = 5, np.array([0.03, 0.2, 0.5, 0.9]), ("band", "cross_track")
    shape = bands, levels.size
    nm, channels = np.linspace(540.0, 560.0, bands), np.arange(450.0, 651.0)
    error = {name: rng.normal(0.0, size, (draws, 1, 1)) for name, size in SYSTEMATIC.items()}
    of_elements = rng.normal(0.0, 0.01, (draws, *shape))

    def light(at: Any) -> Any:
        return 1.2 * (1.0 - 0.006 * (at - 550.0))

    def surface(at: Any) -> Any:
        return levels * (1.0 + 0.01 * (at - 550.0))

    seen = nm[None, :, None] + error["wavelength_u"]
    gain = 3e-7 * (1.0 + error["radiance_gain_u_systematic"] + of_elements)
    signal = surface(seen) * light(seen) / np.pi * 5e-3 / gain
    counts = signal + 100.0 + error["dark_counts_u_systematic"]
    counts = np.rint(counts + rng.normal(size=counts.shape) * np.sqrt(signal / 20.0 + 4.0))
    spectra = light(channels) * (1.0 + error["irradiance_u_systematic"][..., 0])
    stamps = START + 2 * np.arange(draws).astype("timedelta64[s]")
    base = flight(lines=1, bands=bands, columns=levels.size).line.drop_dims(
        ["along_track", "band", "cross_track", "irradiance_time", "irradiance_wavelength"]
    )
    variables = {
        "counts": (("along_track", *element), counts.astype(np.uint16)),
        "dark_counts": (element, np.full(shape, 100.0, np.float32)),
        "radiance_gain": (element, np.full(shape, 3e-7, np.float32)),
        "irradiance": (("irradiance_time", "irradiance_wavelength"), spectra.astype(np.float32)),
        "saturation_count": ((), np.float32(65000)),
        "time": ("along_track", stamps),
        "irradiance_time": ("irradiance_time", stamps),
        "wavelength": ("band", nm),
        "fwhm": ("band", np.full(bands, 6.0)),
        "irradiance_wavelength": ("irradiance_wavelength", channels),
    }
    made = labelled(variables)
    line = base.assign_coords(made.coords).assign(made.data_vars)
    known = {**SYSTEMATIC, "radiance_gain_u_random": np.full(shape, 0.01)}
    return with_noise(line, **known), np.broadcast_to(surface(nm[:, None]), counts.shape)


def test_total_covers_many_calibrations_and_lights() -> None:
    line, truth = many_draws(1500)
    made = reflectance(line, uncertainty=True).compute()

    def pull(u: xr.Dataset) -> np.ndarray:
        return (made.reflectance.values - truth) / np.hypot(*(u[name].values.astype(float) for name in U))

    # draws are independent, samples of one draw are not
    z = pull(made)
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.1)
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=0.1)
    assert abs((np.abs(z) < 1.0).mean() - 0.6827) < 0.03
    # every component is needed: without one the total is underrated
    for name in ("radiance_gain_u_systematic", "irradiance_u_systematic"):
        less = reflectance(line.drop_vars(name), uncertainty=True).compute()
        assert pull(less)[:, :, 3].std() > 1.12, name


def test_wavelength_acts_on_the_slope_of_the_light() -> None:
    # At the oxygen band an error of the wavelength scale is an error of the light that is divided by
    line = simulate_line(lines=2, bands=272, columns=6, noise=False, quantise=False, smile_nm=0.0)
    made = reflectance(with_noise(line, wavelength_u=0.1), uncertainty=True).compute()
    off = line.assign_coords(wavelength=(line.wavelength + 0.1).assign_attrs(line.wavelength.attrs))
    # the truth at the wavelengths that are said, from that at the wavelengths that are
    nm, spectra = line.wavelength.values, line.true_reflectance.values[0]
    truth = np.stack([np.interp(nm + 0.1, nm, s) for s in spectra.T], axis=1)
    error = np.abs(reflectance(off).reflectance.values[0] - truth)
    claimed, window = made.reflectance_u_systematic.values[0], (nm > 755) & (nm < 775)
    assert claimed[window].max() > 0.005 * spectra[window].mean()
    strong = window[:, None] & (claimed > 0.3 * claimed[window].max(axis=0))
    assert 0.8 < np.median(error[strong] / claimed[strong]) < 1.25


# ------------------------------------------------------------------------------- zero, masks, options


def test_noise_at_and_below_zero_and_of_floats() -> None:
    line = with_noise(flight(dtype=np.uint16).line)
    dark = np.rint(line.dark_counts.values)
    line["dark_counts"] = line.dark_counts.copy(data=dark)
    line["counts"].values[:2] = [dark, dark - 3]
    made = reflectance(line, uncertainty=True).compute()
    np.testing.assert_array_equal(made.reflectance.values[0], 0.0)
    assert (made.reflectance.values[1] < 0).all()
    floor = made.reflectance.values[2] / (line.counts.values[2] - dark) * np.sqrt(4.0 + 1.0 / 12.0)
    np.testing.assert_allclose(made.reflectance_u_random.values[:2], np.stack([floor, floor]), rtol=1e-4)
    # float counts are not rounded
    whole, exact = (
        with_noise(flight(dtype=t, flat=True).line).assign(read_noise=((), 0.0, {"units": "count"}))
        for t in (np.uint16, np.float32)
    )
    u = [reflectance(line, uncertainty=True).reflectance_u_random.values for line in (whole, exact)]
    signal = exact.counts.values - exact.dark_counts.values
    np.testing.assert_allclose((u[0] / u[1]) ** 2, 1.0 + (20.0 / 12.0) / signal, rtol=5e-3)


def test_masks_survive(known_line: xr.Dataset) -> None:
    line = known_line
    line["counts"].values[3, 5, 2] = 4090
    line["radiance_gain"].values[7, 1] = np.nan
    line["time"].values[9] = np.datetime64("NaT", "ns")
    plain, made = reflectance(line).compute(), reflectance(line, uncertainty=True).compute()
    missing = np.zeros(plain.reflectance.shape, bool)
    missing[3, 5, 2] = missing[:, 7, 1] = missing[9] = True
    for name in ("reflectance", *U):
        np.testing.assert_array_equal(np.isnan(made[name].values), missing)
    np.testing.assert_array_equal(np.isnan(plain.reflectance.values), missing)
    assert made.quality.values[3, 2] & hp.Quality.SATURATED
    np.testing.assert_array_equal(made.quality.values, plain.quality.values)


@pytest.mark.filterwarnings("ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning")  # flat
@pytest.mark.filterwarnings("ignore:the panel at lines:hyperpaint.base.errors.PaintWarning")  # no panel
@pytest.mark.parametrize("smile", [None, SHIFT, np.broadcast_to(SHIFT, (12, 6)) + 0.1])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"keep_bits": 12},
        {"tilt": (5.0, 180.0)},
        {"panel": Panel(slice(0, 4), slice(0, 3), 0.4, uncertainty=0.1)},
    ],
    ids=lambda o: next(iter(o), "plain"),
)
def test_reflectance_is_the_same_bit_for_bit(smile: Any, options: dict[str, Any]) -> None:
    line = with_noise(flight(dtype=np.uint16, smile=smile, position=True).line, **SYSTEMATIC)
    plain = reflectance(line, **options).compute()
    made = reflectance(line, uncertainty=True, **options).compute()
    for name in ("reflectance", "quality", "irradiance_age"):
        assert made[name].values.tobytes() == plain[name].values.tobytes()
    per_count = plain.reflectance.values / (line.counts.values - line.dark_counts.values)
    signal = line.counts.values - line.dark_counts.values
    expected = per_count * np.sqrt(signal / 20.0 + 4.0 + 1.0 / 12.0)
    np.testing.assert_allclose(made.reflectance_u_random.values, expected, rtol=1e-3)
    if options.get("keep_bits"):
        for name in U:
            assert not (made[name].values.view(np.uint32) & ((1 << 11) - 1)).any()


def test_a_panel_takes_the_place_of_what_all_elements_share() -> None:
    known = {"radiance_gain_u_systematic": 0.05, "irradiance_u_systematic": 0.04}
    line = with_noise(flight(flat=True).line, radiance_gain_u_random=np.full((12, 6), 0.003), **known)
    panel = Panel(slice(0, 4), slice(0, 3), 0.4, uncertainty=0.01)
    for made, relative in (
        (reflectance(line, uncertainty=True), np.sqrt(0.05**2 + 0.04**2 + 0.003**2)),
        (reflectance(line, uncertainty=True, panel=panel), np.hypot(0.01, 0.003)),
    ):
        u = made.reflectance_u_systematic / made.reflectance
        np.testing.assert_allclose(u, relative, rtol=1e-5)
    assert made.reflectance_u_systematic.attrs["components"] == "radiance_gain_u_random, panel"
    expect_error(
        SchemaError, "value-out-of-range", lambda: Panel(slice(0, 4), slice(0, 3), 0.4, uncertainty=2.0)
    )


def test_uncertainty_of_every_wavelength_and_detector_joins_without_a_slope() -> None:
    line = with_noise(flight().line)
    grows = (0.01 + 1e-4 * (line.irradiance_wavelength - 500.0)).clip(0).astype("f4")
    line["irradiance_u_systematic"] = grows.assign_attrs(units="1")
    made = reflectance(line, uncertainty=True)
    u = made.reflectance_u_systematic.values / made.reflectance.values
    expected = 0.01 + 1e-4 * (line.wavelength.values - 500.0)
    np.testing.assert_allclose(u, np.broadcast_to(expected[:, None], u.shape), rtol=1e-4)
    # detector joins have no slope
    line = with_noise(flight(flat=True).line, wavelength_u=1.0)
    line["counts"].values[:, 6:] += 300.0  # the second detector
    nm = np.r_[np.linspace(500, 550, 6), np.linspace(548, 598, 6)]
    line = line.assign_coords(wavelength=("band", nm, {"units": "nm"}))
    u = reflectance(line, uncertainty=True).reflectance_u_systematic.values
    single = [reflectance(line.isel(band=part), uncertainty=True) for part in (slice(0, 6), slice(6, None))]
    expected = np.concatenate([part.reflectance_u_systematic.values for part in single], axis=1)
    np.testing.assert_allclose(u, expected, rtol=1e-5)


# ---------------------------------------------------------------------------------- laziness, labels


def test_nothing_is_read_while_building(tmp_path: Any, no_compute: Any) -> None:
    known = with_noise(flight(lines=40, smile=SHIFT).line, **SYSTEMATIC)
    line, expected = stored(known, tmp_path / "line.zarr"), reflectance(known, uncertainty=True).compute()
    with no_compute():
        made = line.paint.reflectance(uncertainty=True)
        for name in U:
            assert (made[name].dtype, made[name].dims) == (np.float32, ("along_track", "band", "cross_track"))
            assert made[name].chunks is not None
    for name in U:
        array = made[name].compute()
        assert (array.dtype, array.attrs["units"]) == (np.float32, "1")
        assert array.values.tobytes() == expected[name].values.tobytes()
    (fused,) = dask.optimize(made[U[0]])
    assert len(fused.__dask_graph__()) <= 2 * len(made[U[0]].chunks[0]) + 30


@pytest.mark.parametrize("chunks", [{"along_track": 1}, {"along_track": 7, "band": 5}, {"cross_track": 2}])
def test_the_same_bits_whatever_the_chunks(chunks: dict[str, int]) -> None:
    line = with_noise(flight(lines=30, dtype=np.uint16, smile=SHIFT).line, **SYSTEMATIC)
    whole = reflectance(line, uncertainty=True, keep_bits=12).compute()
    parts = reflectance(line.chunk(chunks), uncertainty=True, keep_bits=12).compute()
    for name in ("reflectance", "quality", *U):
        assert whole[name].values.tobytes() == parts[name].values.tobytes()


def test_what_changes_the_noise_leaves_its_uncertainty_out() -> None:
    made = reflectance(with_noise(flight(smile=SHIFT).line, **SYSTEMATIC), uncertainty=True)
    assert set(U) <= set(made.variables)
    for other in (reflectance(made), made.paint.to_nominal()):
        assert not set(U) & set(other.variables)
    assert reflectance(made.drop_vars("counts"), uncertainty=True)[U[0]].identical(made[U[0]])
    smoothed = made.paint.smooth("box", 3)
    assert U[0] not in smoothed.variables
    assert (smoothed.reflectance.attrs["unc_comps"], made.reflectance.attrs["unc_comps"]) == ([U[1]], list(U))


def test_attributes_are_those_of_obsarray(tmp_path: Any) -> None:
    known = {**SYSTEMATIC, "radiance_gain_u_random": np.full((12, 6), 0.01)}
    made = reflectance(with_noise(flight().line, **known), uncertainty=True)
    assert made.reflectance.attrs["unc_comps"] == list(U)
    for name, form in zip(U, ("random", "systematic"), strict=True):
        expected = {
            "err_corr_1_form": form, "err_corr_1_dim": ["along_track", "band", "cross_track"],
            "err_corr_1_params": [], "err_corr_1_units": [], "pdf_shape": "gaussian",
        }  # fmt: skip
        assert expected.items() <= made[name].attrs.items()
    random, systematic = (made[name].attrs["components"].split(", ") for name in U)
    assert (random, set(systematic)) == (["electrons_per_count", "read_noise"], set(known))
    hp.to_store(made[["reflectance", *U]], tmp_path / "made.zarr")
    again = xr.open_zarr(tmp_path / "made.zarr")
    assert (again.reflectance.attrs, again[U[1]].attrs) == (made.reflectance.attrs, made[U[1]].attrs)


@pytest.mark.filterwarnings("ignore")  # those of obsarray and its dependencies are not ours to mend
def test_obsarray_reads_them() -> None:
    pytest.importorskip("obsarray", reason="obsarray (GPL) is no dependency; install it to run this")
    line = with_noise(flight(lines=2, bands=3, columns=2).line, **SYSTEMATIC)
    made = reflectance(line, uncertainty=True)[["reflectance", *U]].compute()
    read = made.unc["reflectance"]
    assert set(read.comps) == set(U)
    assert (read[U[0]].is_random, read[U[1]].is_systematic) == (True, True)
    assert read[U[0]].pdf_shape == "gaussian"
    u = [made[name].values.ravel().astype(float) for name in U]
    expected = np.diag(u[0] ** 2) + np.outer(u[1], u[1])
    np.testing.assert_allclose(read.total_err_cov_matrix().values, expected, rtol=1e-5, atol=1e-12)


# ------------------------------------------------------------------------------------------ refusals


def test_unknown_noise_is_refused_with_a_way_out() -> None:
    line = flight().line
    bright = radiance(with_noise(line)).drop_vars("counts")
    for match, source in (
        ("electrons_per_count", line.drop_vars("read_noise")),
        (r"read_noise.*estimate_noise", line.drop_vars("read_noise")),
        (r"'counts'.*variable-missing", bright),
        ("reflectance_u_random", reflectance(line)[["reflectance"]]),
    ):
        with pytest.raises(SchemaError, match=match):
            reflectance(source, uncertainty=True)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("electrons_per_count", 0.0, "value-out-of-range"),
        ("read_noise", -1.0, "value-out-of-range"),
        ("radiance_gain_u_systematic", 2.0, "value-out-of-range"),
        ("irradiance_u_systematic", np.inf, "value-out-of-range"),
        ("wavelength_u", np.nan, "not-finite"),
    ],
)
def test_values_that_cannot_be(name: str, value: float, word: str) -> None:
    line = with_noise(flight().line, **SYSTEMATIC)
    line[name] = line[name].copy(data=np.asarray(value))
    lazily = reflectance(line, uncertainty=True)
    with pytest.raises(SchemaError, match=word) as caught:
        lazily.reflectance.compute()
    assert name in str(caught.value)
    reflectance(line).reflectance.compute()  # not asked for, not looked at


def test_darks_that_are_extrapolated_are_less_sure() -> None:
    # At three times the first exposure the second dark counts twice, and the first is taken off
    line = simulate_line(lines=4, bands=24, columns=6, glint=0.0).drop_vars(
        "dark_counts_u_random", errors="ignore"
    )
    exposure = float(line.exposure_time)
    darks = np.broadcast_to(line.dark_counts.values, (2, *line.dark_counts.shape)).astype(np.float32)
    several = line.assign(
        dark_counts=(("dark_time", *line.dark_counts.dims), darks, line.dark_counts.attrs),
        dark_exposure_time=(("dark_time",), exposure * np.array([1 / 3, 2 / 3]), {"units": "s"}),
    )
    u = {"dark_counts_u_random": ((), np.float32(2.0), {"units": "count"})}
    one, two = (
        each.assign(u).paint.reflectance(uncertainty=True).reflectance_u_systematic.values
        for each in (line, several)
    )
    np.testing.assert_allclose(two, np.sqrt(5.0) * one, rtol=1e-3)
