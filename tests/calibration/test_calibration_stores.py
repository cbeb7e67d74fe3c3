"""From a sweep on disk to a calibration on disk, on the command line and inside a collect."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.codecs import plain_zarr
from support.files import write_file
from support.refusals import expect_error, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, FormatError, PaintWarning, SchemaError
from hyperpaint.cli.program import main
from hyperpaint.io.collect.collect_toml import open_with_settings
from hyperpaint.io.flightline.side_files import open_calibration, open_sweep
from hyperpaint.simulation import simulate_collect, simulate_sweep
from hyperpaint.simulation.atmosphere import Sky


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    sweep = simulate_sweep(steps=31, bands=136, columns=6, nonuniformity=0)
    truth = [name for name in sweep.variables if str(name).startswith("true_")]
    plain_zarr(sweep.drop_vars(truth).chunk(step=1), folder / "sweep.zarr")
    return folder


def test_what_is_written_is_read(lab: Path, tmp_path: Path) -> None:
    made = hp.calibrate(open_sweep(lab / "sweep.zarr"))
    hp.to_store(made, tmp_path / "cal.zarr")
    back = open_calibration(tmp_path / "cal.zarr")
    for name in made.variables:
        np.testing.assert_array_equal(back[name].values, made[name].values, err_msg=str(name))
        assert back[name].dtype == made[name].dtype, name
        assert (name in back.coords) == (name in made.coords), name
    assert (back.srf_shape, back.wavelength_residual_nm) == (made.srf_shape, made.wavelength_residual_nm)


def run(sweep: Path, out: Path, code: int, *words: str, options: tuple[str, ...] = ()) -> None:
    # Calibrate on the command line, and expect an exit code, these words, and no traceback
    done = CliRunner().invoke(main, ["calibrate", str(sweep), "--out", str(out), *options])
    assert done.exit_code == code, done.output
    expect_words(done.output, *words, without=("Traceback",))


@pytest.mark.slow
def test_command_line(lab: Path, tmp_path: Path) -> None:
    sweep, out, other = lab / "sweep.zarr", tmp_path / "cal.zarr", ("--flux-uncertainty", "0.02")
    run(sweep, out, 0, "of 136 bands have a gain", "line shape gaussian, FWHM 6.")
    assert hp.verify(out).ok
    run(sweep, out, 0)
    run(sweep, out, 2, "--overwrite", options=other)
    run(sweep, out, 0, options=(*other, "--wavelength-uncertainty", "0.2", "--overwrite"))
    made = open_calibration(out)
    assert (made.flux_uncertainty, float(made.wavelength_u)) == (0.02, pytest.approx(0.2, rel=0.01))


def test_command_line_says_what_is_wrong(lab: Path, tmp_path: Path) -> None:
    out = tmp_path / "cal.zarr"
    run(tmp_path, out, 2, "no tables of a lab sweep")
    run(lab / "sweep.zarr", lab / "sweep.zarr", 2, "is the sweep itself")
    bad = xr.open_zarr(lab / "sweep.zarr", consolidated=False).drop_vars("flux")
    bad.to_zarr(tmp_path / "bad.zarr", zarr_format=3, consolidated=False)
    run(tmp_path / "bad.zarr", out, 2, "'flux' is missing")
    assert not out.exists()


# --- tables ------------------------------------------------------------------------------------------------

EXAMPLES = Path(__file__).parents[2] / "docs" / "formats" / "examples"
STEP = "flux [uW],exposure_time [ms],monochromator_fwhm [nm],capture_fraction,etendue [m2 sr]"
CONSTANTS = "50,2,1e-6,1.86e-11"


def table_of(sweep: xr.Dataset, path: Path, form: str) -> Path:
    # Write a sweep as a table: "wide", "long", or three frames a step in cubes that it names
    path.mkdir()
    columns = range(sweep.sizes["cross_track"])
    names = {"wide": ["band", *(f"column {c}" for c in columns)], "long": ["band", "cross_track", "counts"]}
    rows = ["# a scan", ",".join(["step_wavelength [nm]", STEP, *names.get(form, ["cube"])])]
    steps = zip(sweep.step_wavelength.values, sweep.flux.values, sweep.counts.values, strict=True)
    for wavelength, flux, counts in [("", "", sweep.dark_counts.values), *steps]:
        light = f"{wavelength},{float(flux) * 1e6!r}" if flux else ","
        if form == "cubes":
            frames = (np.rint(counts) + np.arange(-1, 2)[:, None, None]).astype(np.uint16)
            name = f"scan_{wavelength or 'dark'}.hdr"
            cube = xr.DataArray(frames, dims=("along_track", "band", "cross_track"), attrs={"units": "count"})
            hp.io.write_envi(cube.to_dataset(name="counts"), path / name)
            rows.append(f"{light},{CONSTANTS},{name}")
        for band, values in enumerate(counts.tolist() if form != "cubes" else []):
            start = f"{light},{CONSTANTS},{band}"
            cells = [",".join(map(repr, values))] if form == "wide" else enumerate(values)
            rows += [
                f"{start},{cell}" if form == "wide" else f"{start},{cell[0]},{cell[1]!r}" for cell in cells
            ]
    (path / "power_meter.csv").write_text("\n".join(rows) + "\n")
    return path / "power_meter.csv"


@pytest.mark.parametrize("form", ["wide", "long", "cubes"])
def test_a_table_holds_what_a_store_holds(lab: Path, tmp_path: Path, form: str) -> None:
    sweep = open_sweep(lab / "sweep.zarr").isel(step=slice(0, 8), band=slice(0, 20)).load()
    path = table_of(sweep, tmp_path / "scan", form)
    opened = open_sweep(path.parent if form == "cubes" else path)
    names = ("step_wavelength", "flux", "exposure_time", "monochromator_fwhm", "capture_fraction", "etendue")
    for name in names:
        np.testing.assert_allclose(opened[name], sweep[name], rtol=1e-4 if name == "etendue" else 1e-12)
        assert opened[name].attrs["units"] == sweep[name].attrs["units"]
    for name in ("counts", "dark_counts"):
        assert opened[name].dims == sweep[name].dims
        np.testing.assert_allclose(opened[name], sweep[name], atol=0.51 if form == "cubes" else 0, rtol=0)
    if form == "cubes":
        assert opened["counts"].chunks is not None
        assert (opened.frame_count.values.tolist(), float(opened.counts_variance.max())) == ([3] * 8, 1.0)


def test_a_sphere_gives_linearity_and_flat_field() -> None:
    sphere = open_sweep(EXAMPLES / "sphere_levels.csv")
    assert (float(sphere.saturation_count), sphere.level.values.tolist()) == (4095, [0.5, 0.5, 1, 1])
    net = (sphere.counts - sphere.dark_counts).isel(band=0, cross_track=0)
    assert net.values.tolist() == [200, 400, 400, 800]
    coefficients = hp.calibration.linearity(sphere.level * sphere.exposure_time, net, degree=2)
    assert coefficients == pytest.approx((0.0,), abs=1e-9)
    flat = hp.calibration.flat_field(sphere.counts - sphere.dark_counts)
    assert flat.values[0].tolist() == pytest.approx([1.0, 0.98, 1.02], abs=0.002)
    assert open_sweep(EXAMPLES / "sphere_levels_long.csv").dark_counts.dims == ("band", "cross_track")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[ms]", "[V]", "column 'exposure_time' has the unit 'V', expected a unit such as [s]"),
        (" [ms]", "", "column 'exposure_time' has no unit"),
        ("level", "levle", "unknown column 'levle'"),
        ("column 2", "column 1", "each once"),
        (",501,", ",5o1,", "row 11, column 'column 0': '5o1', expected a number"),
        ("0.5,5,4095,1,403", "0.5,5,4095,0,403", "row 8: band 0, column 0 again"),
        ("0.5,5,4095,1,403,397,402\n", "", "(1, 3) and (2, 3) bands and columns, expected one size"),
        (",103,101,102", ",103,101", "row 4: 6 cells, expected 7"),
        ("\n,", "\n1,", "again"),
        ("0,512", "2,512", "the step with level 0.5, exposure_time 0.01"),
    ],
)
def test_faults_of_a_table_name_row_column_and_unit(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = (EXAMPLES / "sphere_levels.csv").read_text()
    assert old in text
    (tmp_path / "sphere.csv").write_text(text.replace(old, new))
    assert words in str(expect_error(FormatError, None, lambda: open_sweep(tmp_path / "sphere.csv")))
    for name in ("dark", "scan_400", "scan_460"):
        expect_error(
            FormatError,
            rf"cube '{name}.hdr': no such file.*cube-missing",
            lambda: open_sweep(EXAMPLES / "power_meter.csv"),
        )


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (",", ";"),
        (",", "\t"),
        ("\n", ",,\n"),
        ("\n0.5,5,4095,0", "\n,,,,,,\n0.5,5,4095,0"),
    ],
)
def test_tables_of_spreadsheets(tmp_path: Path, old: str, new: str) -> None:
    text = (EXAMPLES / "sphere_levels.csv").read_text()
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    (tmp_path / "sphere.csv").write_text("\n".join([*rows, ""]).replace(old, new))
    xr.testing.assert_identical(
        open_sweep(tmp_path / "sphere.csv"), open_sweep(EXAMPLES / "sphere_levels.csv")
    )
    numbered = [f"{k - 1}," * (k > 0) + "," * (k == 0) + row + ",note" for k, row in enumerate(rows)]
    (tmp_path / "pandas.csv").write_text("\n".join(numbered))
    with pytest.warns(PaintWarning, match="'note'.*column-unknown"):
        xr.testing.assert_identical(
            open_sweep(tmp_path / "pandas.csv"), open_sweep(EXAMPLES / "sphere_levels.csv")
        )
    (tmp_path / "comma.csv").write_text("\n".join(rows).replace(",", ";").replace("0.5;", "0,5;"))
    assert open_sweep(tmp_path / "comma.csv").level.values[0] == 0.5


def test_stores_of_whole_counts_have_negative_differences(tmp_path: Path) -> None:
    sphere = open_sweep(EXAMPLES / "sphere_levels.csv")
    sphere = sphere.assign({n: sphere[n].astype("u2") for n in ("counts", "dark_counts")})
    sphere["counts"][0, 0, 0] = 0
    sphere = sphere.assign_coords(step_wavelength=("step", [4.0, 3, 2, 1])).swap_dims(step="step_wavelength")
    plain_zarr(sphere, tmp_path / "u2.zarr")
    opened = open_sweep(tmp_path / "u2.zarr")
    assert opened.counts.dims == ("step", "band", "cross_track")
    assert float((opened.counts - opened.dark_counts).min()) == -101.0


def test_other_stores_are_no_sweeps(tmp_path: Path) -> None:
    expect_refusals((FormatError, "sweep-missing", lambda: open_sweep(tmp_path)))
    expect_error(FormatError, "no such sweep", lambda: open_sweep(tmp_path / "nothing.zarr"))
    plain_zarr(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "a.zarr")
    expect_refusals((FormatError, "counts-missing", lambda: open_sweep(tmp_path / "a.zarr")))


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect flown with the camera of a sweep, which calibrates it
    folder = tmp_path_factory.mktemp("collect")
    same = {"bands": 136, "columns": 6, "nonuniformity": 0}
    path = simulate_collect(folder / "c", scene="plan", lines=40, **same)
    sweep = simulate_sweep(**same)
    truth = [name for name in sweep.variables if str(name).startswith("true_")]
    plain_zarr(sweep.drop_vars(truth), folder / "c" / "lab.zarr")
    text = path.read_text()
    assert 'path = "calibration.zarr"' in text
    path.write_text(text.replace('path = "calibration.zarr"', 'sweep = "lab.zarr"'))
    return path


def test_a_collect_is_calibrated_on_the_way(collect: Path) -> None:
    tree = hp.open_collect(collect)
    made = tree["calibration"].to_dataset()
    assert made.sweep == "lab.zarr"
    truth = open_calibration(collect.parent / "calibration.zarr")
    assert np.nanmax(np.abs((made.radiance_gain / truth.radiance_gain - 1).values[10:-10])) < 1e-2
    line = tree["flightlines/raw_0"].to_dataset()
    assert not [name for name in line.variables if str(name).startswith(("line_", "beam_", "stray"))]
    assert line.radiance_gain_u_systematic.dims == ("band",)
    assert np.isfinite(line.paint.reflectance().reflectance.values[:, 20:-20]).mean() > 0.9
    expect_refusals((CollectError, "calibrate-missing", lambda: open_with_settings(collect)))


def test_a_collect_has_one_calibration(collect: Path, tmp_path: Path) -> None:
    text = collect.read_text().replace('sweep = "lab.zarr"', 'sweep = "lab.zarr"\npath = "calibration.zarr"')
    both = write_file(collect.with_name("both.toml"), text)
    expect_refusals((CollectError, "option-conflict", lambda: hp.open_collect(both)))


def listed(folder: Path, name: str, size: tuple[int, int] = (136, 6)) -> Path:
    # Write a list of bad elements (3, 1) and (5, 2) as a table, or as an ENVI file
    if name.endswith(".csv"):
        (folder / name).write_text("band,cross_track\n3,1\n5,2\n")
    else:
        mask = np.zeros(size, "<i2")
        mask[3, 1] = mask[5, 2] = 7
        mask.tofile(folder / name)
        shape = f"samples = {size[1]}\nlines = {size[0]}\nbands = 1\ninterleave = bsq"
        header = f"ENVI\n{shape}\ndata type = 2\nheader offset = 0\nbyte order = 0\n"
        (folder / f"{name}.hdr").write_text(header)
    return folder / name


@pytest.mark.parametrize("name", ["bad.csv", "bad_elements"])
def test_bad_elements_are_listed_in_a_file(collect: Path, name: str) -> None:
    bad = listed(collect.parent, name)
    usual = open_calibration(collect.parent / "calibration.zarr").radiance_gain.values
    made = open_calibration(collect.parent / "calibration.zarr", bad_elements=bad).radiance_gain.values
    assert np.argwhere(np.isnan(made) & ~np.isnan(usual)).tolist() == [[3, 1], [5, 2]]
    text = collect.read_text().replace(
        'sweep = "lab.zarr"', f'path = "calibration.zarr"\nbad_elements = "{name}"'
    )
    (toml := collect.with_name("bad.toml")).write_text(text)
    line = hp.open_collect(toml)["flightlines/raw_0"].to_dataset()
    np.testing.assert_array_equal(line.radiance_gain.values, made)
    assert np.isnan(line.paint.radiance().radiance.values[:, [3, 5], [1, 2]]).all()


@pytest.mark.parametrize(
    ("text", "error", "code"),
    [
        ("3,99", SchemaError, "grid-mismatch"),
        ("-1,2", SchemaError, "grid-mismatch"),
        ("x,y", FormatError, "file-unreadable"),
        (None, SchemaError, "grid-mismatch"),
    ],
)
def test_lists_of_other_detectors_are_refused(
    collect: Path, tmp_path: Path, text: str | None, error: type[Exception], code: str
) -> None:
    bad = tmp_path / "bad.csv" if text else listed(tmp_path, "small", (8, 6))
    if text:
        bad.write_text(f"band,column\n{text}\n")
    expect_error(error, code, lambda: open_calibration(collect.parent / "calibration.zarr", bad_elements=bad))


# --- responses that no line model is; sweep and flight are plain sums over a fine grid ----------------------


GRID = np.arange(680.0, 850.0, 0.05)
BANDS = np.arange(710.0, 820.0, 2.22)
SHIFT = np.array([0.0, 0.3, 0.7])
CHANNELS = np.arange(690.0, 841.0)


def slit(offset: np.ndarray, tail: float = 0.0) -> np.ndarray:
    # Return a slit of 6 nm before pixels of 2.22 nm, with a tail of exp(-x / tail) to longer wavelengths
    x = np.arange(-30.0, 30.001, 0.01)
    response = np.clip(0.5 * (6.0 + 2.22) - np.abs(x), 0.0, 2.22)
    if tail:
        response = np.convolve(response, np.where(x >= 0, np.exp(-np.clip(x, 0, None) / tail), 0.0), "same")
    return np.interp(offset, x, response / (response.sum() * 0.01), 0.0, 0.0)


def camera(tail: float) -> np.ndarray:
    # Return the responses of all elements (band, column, grid)
    return slit(GRID - (BANDS[:, None] + SHIFT)[..., None], tail) * np.exp(-(((GRID - 650.0) / 260.0) ** 2))


def sweep_of(elements: np.ndarray, light_nm: float = 2.0) -> xr.Dataset:
    # Return a sweep of 2 nm lines: the frame of the simulator's, with counts that are sums over the grid
    size: dict[str, Any] = {"bands": BANDS.size, "columns": SHIFT.size, "steps": 19}
    sweep = simulate_sweep(
        **size, first_step_nm=705.0, last_step_nm=825.0, monochromator_fwhm_nm=light_nm,
        first_wavelength=BANDS[0], last_wavelength=BANDS[-1], noise=False, quantise=False, dark_pattern=0.0,
    )  # fmt: skip
    lines = np.exp(-4 * np.log(2) * ((GRID - sweep.step_wavelength.values[:, None]) / light_nm) ** 2)
    seen = np.einsum("bcg,kg->kbc", elements, lines / lines.sum(axis=1, keepdims=True))
    power = (sweep.flux * sweep.capture_fraction * sweep.exposure_time).broadcast_like(sweep.counts)
    counts = seen * power.transpose("step", "band", "cross_track").values
    counts *= 2500.0 / counts.max()
    noise = np.sqrt((counts / 20.0 + 0.25) / 50.0) * np.random.default_rng(5).standard_normal(counts.shape)
    sweep["counts"].values[...] = counts + noise + sweep.dark_counts.values
    sweep["counts_variance"].values[...] = counts / 20.0 + 0.25
    return sweep


def error_in_flight(elements: np.ndarray, calibration: xr.Dataset) -> float:
    # Return the largest relative error of reflectance from 745 to 785 nm
    light = sum(Sky(48.2).irradiance(GRID))
    surface = 0.3 + 0.1 * np.tanh((GRID - 760.0) / 60.0)
    seen, lit, area = (
        elements @ part for part in (surface * light / np.pi, light / np.pi, np.ones(GRID.size))
    )
    record = np.exp(-4 * np.log(2) * ((GRID - CHANNELS[:, None]) / 3.0) ** 2)
    record /= record.sum(axis=1, keepdims=True)
    start, wanted = np.datetime64("2021-07-20T17:00", "ns"), ("wavelength", "fwhm", "wavelength_shift")
    line = xr.Dataset(
        {
            "radiance": (("along_track", "band", "cross_track"), (seen / area)[None].astype("f4"), RADIANCE),
            "irradiance": (("irradiance_time", "irradiance_wavelength"), [record @ light] * 2, IRRADIANCE),
            "irradiance_fwhm": ((), 3.0, {"units": "nm"}),
            "radiance_gain": calibration["radiance_gain"],
        },
        {
            "time": ("along_track", [start]),
            "irradiance_time": ("irradiance_time", start + np.array([-1, 1], "timedelta64[s]")),
            "irradiance_wavelength": ("irradiance_wavelength", CHANNELS, {"units": "nm"}),
            **{
                name: calibration[name]
                for name in (*wanted, "band_spacing", "srf_offset")
                if name in calibration
            },
        },
        {"srf_shape": calibration.attrs["srf_shape"]},
    )
    if "srf" in calibration:
        line["srf"] = calibration["srf"]
    near = (BANDS > 745.0) & (BANDS < 785.0)
    return float(np.abs(hp.reflectance(line).reflectance.values[0] / (seen / lit) - 1)[near].max())


RADIANCE, IRRADIANCE = {"units": "W m-2 sr-1 nm-1"}, {"units": "W m-2 nm-1"}


@pytest.fixture(scope="module")
def lopsided() -> np.ndarray:
    return camera(tail=1.5)


def test_a_lopsided_slit_becomes_a_table_that_is_used(lopsided: np.ndarray) -> None:
    calibration = hp.calibrate(sweep_of(lopsided))
    assert (calibration.srf_shape, calibration.srf.dims) == ("tabulated", ("band", "srf_offset"))
    # the response itself, wherever its centre is taken to be
    offset = calibration.srf_offset.values
    seen = calibration.srf.values[20] / np.trapezoid(calibration.srf.values[20], offset)
    away = [np.linalg.norm(slit(offset + d, 1.5) - seen) for d in np.arange(0.0, 3.0, 0.05)]
    assert min(away) < 0.03 * np.linalg.norm(seen)
    assert error_in_flight(lopsided, calibration) < 0.003


def test_a_model_that_is_asked_for_warns_of_what_it_costs(lopsided: np.ndarray) -> None:
    with pytest.warns(PaintWarning, match=r"'gaussian'.*response-shape-misfit") as caught:
        calibration = hp.calibrate(sweep_of(lopsided), srf_shape="gaussian")
    assert (calibration.srf_shape, caught[0].filename) == ("gaussian", __file__)
    assert 0.5 < calibration.attrs["srf_model_effect"] / error_in_flight(lopsided, calibration) < 2.0


@pytest.mark.parametrize(("tail", "most"), [(0.0, 0.005), (0.4, 0.012), (0.5, 0.02)])
def test_a_slit_stays_a_slit(tail: float, most: float) -> None:
    # Up to a tail that changes the curve by 1.2 %
    calibration = hp.calibrate(sweep_of(camera(tail)))
    shape = "slit" if tail < 0.45 else "tabulated"
    assert (calibration.srf_shape, "srf" in calibration) == (shape, shape == "tabulated")
    assert calibration.attrs["srf_model_misfit"] < most
