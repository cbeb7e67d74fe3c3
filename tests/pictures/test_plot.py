"""True colour from spectra, and the figure of a flight line."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.codecs import plain_zarr
from support.refusals import expect_errors, expect_refusals
from support.strategies import flight

from hyperpaint import calibrate
from hyperpaint.base.errors import MissingExtraError, PaintWarning, SchemaError
from hyperpaint.base.schema import Quality, label_digest
from hyperpaint.calibration.calibration_dataset import fitted_lines
from hyperpaint.cli.program import main
from hyperpaint.light.daylight_colours import colour_matching
from hyperpaint.pictures.figures import check_picture
from hyperpaint.pictures.plot import calibration_report, overview, quicklook, rgb
from hyperpaint.simulation import simulate_sweep

NM = np.arange(385.0, 780.0, 5.0)
WHITE = (0.0, 100.0)


def scene(spectra: np.ndarray) -> xr.Dataset:
    # Return spectra (pixel, band) as a flight line one pixel wide
    values = np.asarray(spectra, "f4")[:, :, None]
    return xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), values, {"units": "1"})},
        {"wavelength": ("band", NM, {"units": "nm"})},
    )


@pytest.mark.parametrize(
    ("nm", "x", "y", "z"),
    [  # CIE 1931 tables
        (450, 0.3362, 0.0380, 1.7721),
        (500, 0.0049, 0.3230, 0.2720),
        (550, 0.4334, 0.9950, 0.0087),
        (600, 1.0622, 0.6310, 0.0008),
        (650, 0.2835, 0.1070, 0.0000),
    ],
)
def test_observer_of_1931(nm: float, x: float, y: float, z: float) -> None:
    np.testing.assert_allclose(colour_matching([nm])[:, 0], [x, y, z], atol=0.03)


def test_colours_have_their_names_and_saturated_is_white() -> None:
    made = rgb(scene(np.array([[1.0], [0.2], [0.0]]) * np.ones(NM.size)), stretch=WHITE).values[:, 0]
    np.testing.assert_allclose(made[0], 1.0, atol=0.01)
    # 0.2 as the standard encodes it
    np.testing.assert_allclose(made[1], 1.055 * 0.2 ** (1 / 2.4) - 0.055, atol=0.01)
    np.testing.assert_allclose(made[2], 0.0, atol=1e-6)
    # colours have their names
    spectra = np.array(
        [0.05 + 0.8 * ((low <= NM) & (high >= NM)) for low, high in [(600, 780), (500, 580), (385, 480)]]
    )
    named = rgb(scene(spectra), stretch=WHITE)
    assert named.rgb.values.tolist() == ["red", "green", "blue"]
    assert named.values[:, 0].argmax(axis=1).tolist() == [0, 1, 2]
    # saturated is white, and nothing is black
    spectra = np.full((3, NM.size), 0.2)
    spectra[1] = np.nan
    spectra[1, :3] = 0.2
    spectra[2] = np.nan
    lost = rgb(scene(spectra), stretch=WHITE).values[:, 0]
    assert (lost[1] > 0.95).all()
    assert (lost[2] == 0).all()
    assert not np.isnan(lost).any()


@pytest.mark.parametrize("chunks", [None, 1])
def test_pixels_whose_every_band_is_saturated_are_white(chunks: int | None) -> None:
    spectra = np.full((4, NM.size), np.nan)
    spectra[0] = 0.2
    line = scene(spectra)
    bits = [Quality.SATURATED, Quality.SATURATED, Quality.NO_DATA, Quality(0)]
    quality = np.array([[bit.value] for bit in bits], np.uint16)
    line = line.assign(quality=(("along_track", "cross_track"), quality))
    made = rgb(line if chunks is None else line.chunk(along_track=chunks), stretch=WHITE)
    assert made.dtype == np.float32
    grey, saturated, *others = made.values[:, 0]
    assert (grey < 0.6).all()
    assert (saturated > 0.999).all()
    assert not np.any(others)


def test_lazy_labelled_and_float32(no_compute: Any) -> None:
    line = flight(lines=70).line
    chunked = line.chunk(along_track=16).assign_coords(line.coords)
    with no_compute():
        made = rgb(chunked)
    assert made.dims == ("along_track", "cross_track", "rgb")
    assert made.dtype == made.compute().dtype == np.float32
    assert 0 <= made.values.min() < made.values.max() <= 1
    np.testing.assert_allclose(made.values, line.paint.rgb().values, atol=1e-6)
    assert "units" not in made.attrs


def on_a_map(lines: int = 12, columns: int = 9) -> xr.Dataset:
    # Return a map of three colours, as `orthorectify` makes it: north up, UTM, with a spatial_ref
    pyproj = pytest.importorskip("pyproj")
    values = np.random.default_rng(0).uniform(0.05, 0.6, (lines, columns, NM.size)).astype("f4")
    return xr.Dataset(
        {"reflectance": (("y", "x", "band"), values, {"units": "1", "grid_mapping": "spatial_ref"})},
        {
            "wavelength": ("band", NM, {"units": "nm"}),
            "y": 4_770_000.0 - 0.5 * np.arange(lines),
            "x": 300_000.0 + 0.5 * np.arange(columns),
            "spatial_ref": ((), 0, pyproj.CRS("EPSG:32616").to_cf()),
        },
    )


@pytest.mark.parametrize("lazy", [False, True])
def test_the_colours_clash_with_nothing(lazy: bool, tmp_path: Any) -> None:
    # Rationale: of an array named as its own coordinate no Dataset is made, which hvplot and netCDF need
    line = flight(lines=20).line
    made = rgb(line.chunk(along_track=8) if lazy else line).assign_coords(along_track=np.arange(100, 120))
    assert made["along_track"].values.tolist() == list(range(100, 120))
    whole = made.to_dataset()
    assert list(whole.data_vars) == ["true_colour"]
    made.to_netcdf(tmp_path / "picture.nc", engine="h5netcdf")
    np.testing.assert_array_equal(whole["true_colour"].sel(along_track=105, rgb="red"), made.values[5, :, 0])
    assert len(whole.isel(rgb=0).to_dataframe()) == made.size // 3


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # rioxarray, of affine
@pytest.mark.parametrize("called", [rgb, lambda cube: cube.paint.rgb()])
def test_a_map_stays_a_map(called: Any) -> None:
    # Expected: y, x, their coordinates and the CRS; rioxarray reprojects the picture as it does the cube
    pytest.importorskip("rioxarray")
    cube = on_a_map()
    made = called(cube)
    assert made.dims == ("y", "x", "rgb")
    for name in ("y", "x"):
        xr.testing.assert_identical(made[name].drop_vars("spatial_ref"), cube[name].drop_vars("spatial_ref"))
        assert name in made.indexes
    there = made.transpose("rgb", "y", "x")
    assert there.rio.crs.to_epsg() == 32616
    warped = there.rio.reproject("EPSG:4326")
    expected = cube["reflectance"].transpose("band", "y", "x").rio.reproject("EPSG:4326")
    np.testing.assert_allclose(warped["x"], expected["x"])
    np.testing.assert_allclose(warped["y"], expected["y"])


def test_quicklook_draws_a_picture(tmp_path: Any) -> None:
    pytest.importorskip("matplotlib")
    figure = flight(lines=30).line.paint.quicklook(tmp_path / "line.png", lines=10)
    assert (tmp_path / "line.png").read_bytes().startswith(b"\x89PNG")
    assert len(figure.axes) == 4
    # a cube and a map whose header does not name the quantity
    cube = scene(np.linspace(0.1, 0.6, 3 * NM.size).reshape(3, NM.size)).rename(reflectance="values")
    for dataset in (cube, on_a_map().rename(reflectance="values")):
        assert "values" in dataset.paint.quicklook().axes[0].get_title()


def test_pictures_without_matplotlib(monkeypatch: pytest.MonkeyPatch, calibration: xr.Dataset) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    expect_errors(
        (MissingExtraError, r"\[viz\].*extra-missing", lambda: quicklook(flight().line)),
        (MissingExtraError, r"\[viz\].*extra-missing", lambda: calibration_report(calibration)),
    )


def test_smile_does_not_tint_the_picture() -> None:
    # Expected: one paint, seen by columns on their own wavelengths, has one colour
    shift = np.linspace(-3.0, 3.0, 7)
    edge = 0.1 + 0.6 / (1.0 + np.exp(-(NM[:, None] + shift - 590.0) / 12.0))
    cube = xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), edge[None].astype("f4"), {"units": "1"})},
        {
            "wavelength": ("band", NM, {"units": "nm"}),
            "wavelength_shift": ("cross_track", shift, {"units": "nm"}),
        },
    )
    seen = rgb(cube, stretch=WHITE).values[0]
    tinted = rgb(cube.drop_vars("wavelength_shift"), stretch=WHITE).values[0]
    assert np.ptp(seen, axis=0).max() < 0.1 * np.ptp(tinted, axis=0).max()


def test_the_overview_serves_where_few_lines_are_asked_for(no_compute: Any) -> None:
    whole = flight(lines=60, columns=9).line.paint.reflectance().compute()
    whole = whole.assign_coords(along_track=np.arange(100, 160))
    few = whole.isel(along_track=slice(None, None, 3)).drop_vars("along_track")
    picture = overview(few)
    assert picture is not None
    picture.attrs["line_step"] = 3
    line = whole.assign(overview=picture.compute()).chunk({"along_track": 16})
    with no_compute():
        small = rgb(line, lines=20)
    assert small.attrs["level"] == "overview, every 3. line and 1. column"
    assert small.dims == ("along_track", "cross_track", "rgb")
    assert small.along_track.values.tolist() == list(range(100, 160, 3))
    np.testing.assert_allclose(small.values, rgb(few).values, atol=0.5 / 255 + 1e-6)
    # no more lines than asked for, none of a stretch that it does not have, nor lines that it lacks
    fewer = rgb(line, lines=13)
    assert fewer.attrs["level"] == "overview, every 6. line and 1. column"
    np.testing.assert_array_equal(fewer.values, small.values[::2])
    other = rgb(line, lines=20, stretch=WHITE)
    assert other.attrs["level"] == "cube, every 3. line and 1. column"
    np.testing.assert_array_equal(other.values, rgb(line, stretch=WHITE).values[::3])
    more = rgb(line, lines=40)
    assert (more.attrs["level"], more.sizes["along_track"]) == ("cube, every 2. line and 1. column", 30)
    assert "level" not in rgb(line).attrs
    assert rgb(line.isel(along_track=slice(0, 30)), lines=10).attrs["level"].startswith("cube")
    # the picture is computed for other pixels, another order, and another cube than those of the overview
    fixed = line.assign_coords(cross_track=np.arange(line.sizes["cross_track"]))
    fixed["overview"].attrs["labels"] = label_digest(fixed)
    stored = fixed.compute()
    for name in ("overview", "reflectance"):
        stored[name].encoding["chunks"] = stored[name].shape
    assert rgb(stored, lines=20).attrs["level"].startswith("overview")
    for other in (
        line.isel(along_track=slice(None, None, -1)),
        fixed.roll(cross_track=2, roll_coords=True),
        fixed.isel(along_track=slice(1, None)),
        stored.assign(reflectance=stored.reflectance * 0.5),
    ):
        assert rgb(other, lines=20).attrs["level"].startswith("cube")
    # without a cube it is all there is
    alone = line.drop_vars(["counts", "reflectance"])
    np.testing.assert_array_equal(rgb(alone).values, small.values)
    expect_errors(
        (SchemaError, "variable-missing", lambda: rgb(alone.drop_vars("overview"))),
        (SchemaError, r"lines=0.*out-of-range", lambda: rgb(line, lines=0)),
        (SchemaError, "band-missing", lambda: rgb(whole.assign_coords(wavelength=whole.wavelength + 600))),
    )


# --- The figure of a calibration: what is drawn is what was found, and calls that cannot be are refused


COLUMNS, STEPS = 6, 31


@pytest.fixture(scope="module")
def sweep() -> xr.Dataset:
    return simulate_sweep(steps=STEPS, bands=136, columns=COLUMNS, smile_nm=1.5, seed=2)


@pytest.fixture(scope="module")
def calibration(sweep: xr.Dataset) -> xr.Dataset:
    return calibrate(sweep)


@pytest.fixture(scope="module")
def figure(sweep: xr.Dataset, calibration: xr.Dataset) -> Any:
    pytest.importorskip("matplotlib")
    return calibration_report(calibration, sweep)


def panel(figure: Any, title: str) -> Any:
    # Return the axes whose title opens with these words
    (found,) = (axes for axes in figure.axes if axes.get_title().startswith(title))
    return found


def curve(axes: Any, label: str) -> np.ndarray:
    (found,) = (line for line in axes.get_lines() if str(line.get_label()).startswith(label))
    return np.asarray(found.get_ydata(), np.float64)


def test_every_axis_says_what_it_shows(figure: Any) -> None:
    titles = (
        "lamp lines",
        "wavelength residual",
        "smile",
        "width of",
        "responsivity",
        "standard uncertainty",
    )
    ylabels = [panel(figure, title).get_ylabel() for title in titles]
    assert ylabels == [
        *("counts above dark [count]", "cross_track [column]", "cross_track [column]", "FWHM [nm]"),
        *("counts per joule in a pixel [count J$^{-1}$]", "relative to the gain [%]"),
    ]
    assert all(panel(figure, title).get_xlabel() == "wavelength [nm]" for title in titles[1:])
    bars = {axes.get_ylabel() for axes in figure.axes}
    assert {"map - monochromator [nm]", "wavelength shift [nm]"} <= bars
    assert f"{STEPS} of {STEPS} steps used" in figure.get_suptitle()


def test_lines_are_the_counts_of_the_sweep(figure: Any, sweep: xr.Dataset, calibration: xr.Dataset) -> None:
    axes = panel(figure, "lamp lines and")
    assert axes.get_title().endswith(f"column {COLUMNS // 2}")
    curves = [line for line in axes.get_lines() if str(line.get_label()).endswith(" nm")]
    points = [line for line in axes.get_lines() if line.get_marker() == "o"]
    assert len(curves) == len(points) == 5
    for fit, drawn in zip(curves, points, strict=True):
        at = float(str(fit.get_label()).removesuffix(" nm"))
        counts = (sweep.counts.sel(step=sweep.step_wavelength == at) - sweep.dark_counts)[0, :, COLUMNS // 2]
        assert drawn.get_ydata().max() == pytest.approx(float(counts.max()), abs=3.0)
        # between the points, the fit is where the counts would be
        there = np.interp(drawn.get_xdata(), fit.get_xdata(), fit.get_ydata())
        np.testing.assert_allclose(there, drawn.get_ydata(), atol=0.05 * fit.get_ydata().max())
    low, high = (axes.get_xlim() for axes in (axes, figure.axes[1]))
    assert low == high


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
@pytest.mark.parametrize("light", ["gaussian", "triangle"])
def test_fits_of_exact_lines_leave_nothing(shape: str, light: str) -> None:
    exact: Any = {"noise": False, "quantise": False, "nonuniformity": 0.0}
    sweep = simulate_sweep(
        steps=13, bands=272, columns=3, srf_shape=shape, monochromator_shape=light,
        monochromator_fwhm_nm=4.0, **exact,
    )  # fmt: skip
    for line in fitted_lines(calibrate(sweep), sweep, [3, 6, 9], 1):
        assert line.counts.size > 5
        assert np.abs(line.residual).max() < 0.01
        assert line.curve.max() == pytest.approx(line.counts.max(), rel=0.1)


def test_maps_curves_uncertainties_and_shades_are_those_of_the_calibration(
    figure: Any, calibration: xr.Dataset
) -> None:
    residual = panel(figure, "wavelength residual").collections[0].get_array()
    expected = calibration.line_centre - calibration.step_wavelength
    np.testing.assert_allclose(residual.filled(np.nan), expected.where(calibration.line_trusted).values.T)
    np.testing.assert_allclose(
        panel(figure, "smile").collections[0].get_array(), calibration.wavelength_shift.values.T
    )
    np.testing.assert_array_equal(curve(panel(figure, "width of"), "calibration"), calibration.fwhm)
    response = panel(figure, "responsivity")
    np.testing.assert_array_equal(
        curve(response, f"column {COLUMNS // 2}"), calibration.responsivity[:, COLUMNS // 2]
    )
    assert len(response.collections[0].get_segments()) == COLUMNS
    # uncertainties add in squares
    axes = panel(figure, "standard uncertainty")
    random, common = curve(axes, "random"), curve(axes, "systematic")
    np.testing.assert_allclose(curve(axes, "both"), np.hypot(random, common))
    np.testing.assert_allclose(common, 100 * calibration.radiance_gain_u_systematic, rtol=1e-6)
    assert np.nanmedian(common) == pytest.approx(4.0, rel=0.05)  # the power meter's
    # bands without a gain are shaded
    bad = ~calibration.good.values
    assert bad[0]
    assert bad[-1]
    for title in ("width of", "responsivity", "standard uncertainty"):
        patches = panel(figure, title).patches
        assert len(patches) == 2
        left, right = (patch.get_extents() for patch in patches)
        data = panel(figure, title).transData.inverted()
        (end, _), (begin, _) = data.transform([(left.x1, 0), (right.x0, 0)])
        inside = (calibration.wavelength > end) & (calibration.wavelength < begin)
        np.testing.assert_array_equal(inside, calibration.good)


def test_without_the_sweep_fits_stand_alone(calibration: xr.Dataset) -> None:
    pytest.importorskip("matplotlib")
    axes = panel(calibration_report(calibration, column=0), "lamp lines and")
    assert axes.get_title().endswith("column 0")
    assert sum(line.get_xdata().size > 0 for line in axes.get_lines()) == 5


def test_unlit_columns_and_single_columns_are_drawn() -> None:
    pytest.importorskip("matplotlib")
    beam = simulate_sweep(steps=13, bands=136, columns=24, beam_fwhm_columns=6.0, seed=1)
    with pytest.warns(PaintWarning, match="columns are not lit"):
        calibration = calibrate(beam)
    assert not calibration.line_trusted.any("step").all()
    assert "column 12" in panel(calibration_report(calibration, beam), "lamp lines and").get_title()
    dark = panel(calibration_report(calibration, beam, column=0), "lamp lines and")
    assert not [line for line in dark.get_lines() if line.get_xdata().size]
    narrow = simulate_sweep(steps=13, bands=136, columns=1)
    assert len(calibration_report(calibrate(narrow), narrow).axes) == 9


def test_what_cannot_be_drawn_is_refused(sweep: xr.Dataset, calibration: xr.Dataset, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    part, codes = sweep.isel(step=slice(9)), ("grid-mismatch", "value-out-of-range")
    expect_refusals(
        (SchemaError, codes, lambda: calibration_report(calibration, part, column=9)),
        (
            SchemaError,
            "variable-missing",
            "line_band",
            lambda: calibration_report(calibration.drop_vars("line_band")),
        ),
        (
            SchemaError,
            "suffix-unknown",
            "cal.xls",
            ".pdf",
            ".png",
            lambda: check_picture(tmp_path / "cal.xls"),
        ),
        (SchemaError, "folder-missing", lambda: check_picture(tmp_path / "none" / "cal.png")),
    )


@pytest.mark.slow
def test_command_line_writes_the_picture(sweep: xr.Dataset, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    known = [name for name in sweep.variables if not str(name).startswith("true_")]
    plain_zarr(sweep[known], tmp_path / "sweep.zarr")

    def call(picture: str) -> Any:
        paths = [str(tmp_path / name) for name in ("sweep.zarr", "cal.zarr", picture)]
        return CliRunner().invoke(main, ["calibrate", paths[0], "--out", paths[1], "--picture", paths[2]])

    refused = call("report.xls")
    assert refused.exit_code == 2
    assert "suffix-unknown" in refused.stderr
    assert not (tmp_path / "cal.zarr").exists()  # before anything is computed
    done = call("report.png")
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[-1] == f"look at it in {tmp_path / 'report.png'}"
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "cal.zarr").is_dir()
