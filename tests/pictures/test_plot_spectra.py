"""Spectra on axes: the values drawn are those of the cube."""

import errno
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import MissingExtraError, SchemaError, StoreError
from hyperpaint.base.schema import Quality
from hyperpaint.light.daylight_colours import srgb

pytest.importorskip("matplotlib")

from matplotlib.figure import Figure
from support.refusals import expect_errors, expect_refusals

from hyperpaint.paints.paint_libraries import paint_colours
from hyperpaint.pictures.figures import save_figure
from hyperpaint.pictures.plot import MAX_PAINTS, library_overview, spectrum, triptych

LEFT = hp.Region("left", [(0, 0), (2, 0), (2, 19), (0, 19)])
RIGHT = hp.Region("_right $x", [(3, 0), (5, 0), (5, 19), (3, 19)])


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    return flight(lines=20, bands=24, columns=6).line


@pytest.fixture(scope="module")
def paints(line: xr.Dataset) -> xr.Dataset:
    return hp.extract_signatures(line, hp.Regions((LEFT, RIGHT)), exclude=0)


def texts(made: Any) -> list[str]:
    return [text.get_text() for text in made.get_legend().get_texts()]


def test_a_pixel_is_the_cube_at_its_own_wavelengths(line: xr.Dataset) -> None:
    shift = np.linspace(-1.0, 1.0, 6)
    smiling = line.assign_coords(wavelength_shift=("cross_track", shift, {"units": "nm"}))
    made = spectrum(smiling, pixels=(3, 4)).axes[0]
    nm, values = made.lines[0].get_data()
    np.testing.assert_allclose(nm, line.wavelength.values + shift[4])
    np.testing.assert_array_equal(values, smiling.paint.reflectance().reflectance.values[3, :, 4])
    assert made.get_xlabel() == "wavelength [nm]"


def test_pixels_tell_their_flags_and_uncertainty(line: xr.Dataset) -> None:
    full = line.paint.reflectance().compute()
    quality = np.zeros((20, 6), np.uint16)
    quality[3, 4] = Quality.GLINT | Quality.LOW_SUN
    full["quality"] = (("along_track", "cross_track"), quality)
    u = xr.full_like(full.reflectance, 0.03)
    full["reflectance_u_random"], full["reflectance_u_systematic"] = u, u * np.float32(4 / 3)
    made = spectrum(full, pixels=[(3, 4), (0, 0)]).axes[0]
    assert texts(made) == ["(3, 4): low sun, glint", "(0, 0)"]
    assert made.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(
        full.reflectance.values[3, :, 4].max() + 0.05, abs=1e-6
    )


def test_bands_that_are_not_good_are_left_out(line: xr.Dataset) -> None:
    good = np.ones(24, bool)
    good[5] = False
    made = spectrum(line.assign_coords(good=("band", good)), pixels=(0, 0)).axes[0]
    assert np.isnan(made.lines[0].get_ydata()).nonzero()[0].tolist() == [5]


def test_regions_are_signatures_with_their_quantiles(line: xr.Dataset, paints: xr.Dataset) -> None:
    regions = hp.Regions((LEFT, RIGHT))
    made = spectrum(line, regions, exclude=0).axes[0]
    for number, drawn in enumerate(made.lines):
        np.testing.assert_array_equal(drawn.get_ydata(), paints.reflectance.values[number])
    assert texts(made) == ["left (n = 60)", r" _right \$x (n = 60)"]
    outer = made.collections[0].get_paths()[0].vertices[:, 1]
    assert outer.min() == pytest.approx(paints.reflectance_quantiles.values[0, 0].min())
    assert outer.max() == pytest.approx(paints.reflectance_quantiles.values[0, -1].max())
    assert not spectrum(line, regions, exclude=0, spread="none").axes[0].collections


def test_paints_of_a_library_by_name(paints: xr.Dataset) -> None:
    made = paints.paint.spectrum(paints="left", spread="sd").axes[0]
    assert len(made.lines) == 1
    assert made.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(
        float((paints.reflectance + paints.reflectance_sd)[0].max())
    )
    assert len(paints.paint.spectrum().axes[0].lines) == 2


def test_all_that_is_wrong_is_told_at_once(line: xr.Dataset, paints: xr.Dataset) -> None:
    with pytest.raises(SchemaError) as refused:
        spectrum(line, spread="range")
    assert refused.value.codes == ("choice-unknown", "argument-missing")
    expect_refusals(
        (SchemaError, "option-conflict", lambda: spectrum(paints, pixels=(0, 0))),
        (
            SchemaError,
            "paint-unknown",
            "'middle'",
            "left, _right $x",
            lambda: spectrum(paints, paints="middle"),
        ),
    )
    with pytest.raises(SchemaError) as refused:
        spectrum(line, pixels=[(20, 0), (0, -1)])
    assert refused.value.codes == ("pixel-outside",) * 2
    expect_errors(
        (SchemaError, r"whole.*type-wrong", lambda: spectrum(line, pixels=(0.5, 1.0))),
        (SchemaError, "curve-number", lambda: spectrum(line, pixels=[(0, 0)] * 25)),
    )


def test_without_matplotlib(line: xr.Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    expect_errors(
        (MissingExtraError, r"\[viz\].*extra-missing", lambda: spectrum(line, pixels=(0, 0))),
        (MissingExtraError, r"\[viz\].*extra-missing", lambda: triptych(line, LEFT)),
    )


# --- the triptych ------------------------------------------------------------------------------------------


def test_a_triptych_shows_the_medians_of_all_three(line: xr.Dataset, tmp_path: Any) -> None:
    figure = line.paint.triptych(LEFT, tmp_path / "left.png", exclude=0)
    assert (tmp_path / "left.png").read_bytes().startswith(b"\x89PNG")
    assert [made.get_title() for made in figure.axes] == ["counts", "radiance", "reflectance"]
    cubes = (line.counts, line.paint.radiance().radiance, line.paint.reflectance().reflectance)
    for made, cube in zip(figure.axes, cubes, strict=True):
        expected = np.median(cube.values[:20, :, 0:3].astype("f4"), axis=(0, 2))
        drawn = {curve.get_label(): curve for curve in made.lines}["median"]
        np.testing.assert_allclose(drawn.get_ydata(), expected, rtol=1e-6)
    counts, light = ({c.get_label(): c for c in made.lines} for made in figure.axes[:2])
    np.testing.assert_allclose(counts["dark"].get_ydata(), np.median(line.dark_counts.values[:, :3], axis=1))
    assert counts["saturation"].get_ydata()[0] == line.saturation_count
    nm, white = light["white surface"].get_data()
    nearest = np.abs(line.irradiance_time.values - line.time.values[10]).argmin()
    np.testing.assert_allclose(
        white, line.irradiance.sel(irradiance_wavelength=nm).values[nearest] / np.pi, rtol=1e-6
    )


def test_single_pixels_go_through_the_chain(line: xr.Dataset) -> None:
    # Expected: each pixel's own counts, radiance and reflectance, in its own colour, flags or not
    places = [(3, 4), (10, 1)]
    full = line.paint.reflectance().compute()
    full["quality"][3, 4] |= np.uint16(Quality.GLINT)
    figure = triptych(line, pixels=places)
    cubes = (line.counts, line.paint.radiance().radiance, full.reflectance)
    colours = srgb(full.reflectance.values[[3, 10], :, [4, 1]], line.wavelength.values)
    for made, cube in zip(figure.axes, cubes, strict=True):
        for drawn, place, colour in zip(made.lines[:2], places, colours, strict=True):
            np.testing.assert_allclose(drawn.get_ydata(), cube.values[place[0], :, place[1]], rtol=1e-6)
            np.testing.assert_allclose(drawn.get_color(), colour, atol=1e-6)
    labels = [text.get_text() for text in figure.axes[2].get_legend().get_texts()]
    assert [label[:7] for label in labels] == ["(3, 4)", "(10, 1)"] or labels[0].startswith("(3, 4)")
    expect_refusals(
        (SchemaError, "option-conflict", lambda: triptych(line, LEFT, pixels=places)),
        (SchemaError, "pixel-outside", lambda: triptych(line, pixels=[(99, 0)])),
        (SchemaError, "type-wrong", lambda: triptych(line, pixels=[(1.5, 0)])),
    )


def test_curves_have_the_colours_of_their_paints(paints: xr.Dataset) -> None:
    nm = np.arange(400.0, 800.0, 10.0)
    spectra = np.stack([0.05 + 0.7 * (nm > 600), 0.06 + 0.7 * (nm > 600), np.full(nm.size, 0.9)])
    library = xr.Dataset(
        {"reflectance": (("signature", "band"), spectra.astype("f4"), {"units": "1"})},
        {"wavelength": ("band", nm, {"units": "nm"}), "signature": ["red", "like it", "white"]},
    )
    drawn = spectrum(library).axes[0].lines
    for curve, colour in zip(drawn, paint_colours(library), strict=True):
        np.testing.assert_allclose(curve.get_color(), colour, atol=1e-6)
    assert drawn[0].get_linestyle() == "-" != drawn[1].get_linestyle()
    # white on white has a rim, seen on any ground
    assert 0.3 < np.mean(drawn[2].get_path_effects()[0]._gc["foreground"]) < 0.7


@pytest.mark.filterwarnings("ignore:.*counts-averaged")
def test_a_triptych_is_of_one_region_with_pixels_left(line: xr.Dataset) -> None:
    expect_errors((SchemaError, "region-number", lambda: triptych(line, hp.Regions((LEFT, RIGHT)))))
    dark = line.assign(saturation_count=((), np.float32(60.0), {"units": "count"}))
    expect_errors(
        (SchemaError, r"'left'.*region-empty", lambda: triptych(dark, LEFT)),
        (SchemaError, "counts", lambda: triptych(line.drop_vars("counts"), LEFT)),
    )


def test_a_triptych_counts_pixels_that_have_a_value(line: xr.Dataset) -> None:
    # of a column without a gain there are counts, and no reflectance
    gain = line.radiance_gain.copy(data=np.where(np.arange(6) == 1, np.nan, line.radiance_gain.values))
    assert (
        triptych(line.assign(radiance_gain=gain), LEFT, exclude=0).get_suptitle() == "left: 40 of 60 pixels"
    )


# --- the library -------------------------------------------------------------------------------------------


def test_the_overview_draws_every_paint_in_its_colour(paints: xr.Dataset) -> None:
    shown = [made for made in library_overview(paints, columns=3).axes if made.axison]
    assert [made.get_title(loc="left") for made in shown] == ["left  n = 60", r" _right \$x  n = 60"]
    for number, made in enumerate(shown):
        np.testing.assert_array_equal(made.lines[0].get_ydata(), paints.reflectance.values[number])
        np.testing.assert_allclose(
            made.patches[0].get_facecolor()[:3],
            srgb(paints.reflectance.values[number], paints.wavelength.values),
            atol=1e-6,
        )


def test_colours_of_paints() -> None:
    nm = np.arange(400.0, 1000.0, 10.0)
    spectra = np.stack([0.05 + 0.7 * (nm > 600), 0.05 + 0.7 * (nm < 480), np.full(nm.size, 0.5)])
    library = xr.Dataset(
        {"reflectance": (("signature", "band"), spectra.astype("f4"), {"units": "1"})},
        {"wavelength": ("band", nm, {"units": "nm"}), "signature": ["red", "blue", "grey"]},
    )
    red, blue, grey = paint_colours(library)
    assert (red.argmax(), blue.argmax()) == (0, 2)
    assert np.ptp(grey) < 0.02
    # bands without a value: their neighbours stand in
    holed = library.copy(deep=True)
    holed.reflectance[2, 5:8] = np.nan
    np.testing.assert_allclose(paint_colours(holed)[2], grey, atol=1e-6)
    infrared = library.assign_coords(wavelength=("band", nm + 500, {"units": "nm"}))
    assert np.isnan(paint_colours(infrared)).all()
    assert len(library_overview(infrared).axes) == 3


def test_the_overview_is_bounded() -> None:
    nm = np.arange(400.0, 800.0, 40.0)
    count = MAX_PAINTS + 3
    library = xr.Dataset(
        {"reflectance": (("signature", "band"), np.full((count, nm.size), 0.3, "f4"), {"units": "1"})},
        {"wavelength": ("band", nm, {"units": "nm"}), "signature": [f"p{k}" for k in range(count)]},
    )
    figure = library_overview(library, columns=8)
    assert len(figure.axes) == MAX_PAINTS
    assert figure.get_suptitle() == f"the first {MAX_PAINTS} of {count} paints"
    with pytest.raises(SchemaError, match="library-empty"):
        library_overview(library.isel(signature=slice(0, 0)))


def test_a_picture_replaces_an_old_one_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figure, path = Figure(), tmp_path / "spectra.png"
    save_figure(figure, path)
    before = path.read_bytes()

    def half(target: Path, **_: Any) -> None:
        target.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(figure, "savefig", half)
        expect_errors((StoreError, r"No space left.* free", lambda: save_figure(figure, path)))
    assert path.read_bytes() == before
    save_figure(figure, tmp_path / "without_suffix")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["spectra.png", "without_suffix.png"]
