"""What lies on the axes of pictures: spectra, flags and layers, adjacency, and the ground."""

import errno
import io
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.flown_lines import fly, located
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import MissingExtraError, SchemaError, StoreError
from hyperpaint.base.schema import Quality
from hyperpaint.light.daylight_colours import srgb
from hyperpaint.regions import Region

pytest.importorskip("matplotlib")

from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from support.refusals import expect_error, expect_errors, expect_refusals

from hyperpaint.base.schema import flag_shares
from hyperpaint.light.daylight_colours import ciede2000, encode_srgb, lab_of
from hyperpaint.paints.paint_libraries import paint_colours
from hyperpaint.pictures.figures import orientation_of, save_figure, show_picture
from hyperpaint.pictures.plot import (
    MAX_PAINTS,
    adjacency_figure,
    background,
    draw_outlines,
    flag_overlay,
    library_overview,
    spectrum,
    triptych,
)

# --- Spectra on axes: the values drawn are those of the cube


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


def test_a_pixel_is_the_cube_at_its_own_wavelengths_in_good_bands(line: xr.Dataset, tmp_path: Path) -> None:
    shift = np.linspace(-1.0, 1.0, 6)
    smiling = line.assign_coords(wavelength_shift=("cross_track", shift, {"units": "nm"}))
    made = spectrum(smiling, pixels=(3, 4)).axes[0]
    nm, values = made.lines[0].get_data()
    np.testing.assert_allclose(nm, line.wavelength.values + shift[4])
    np.testing.assert_array_equal(values, smiling.paint.reflectance().reflectance.values[3, :, 4])
    assert made.get_xlabel() == "wavelength [nm]"
    # bands that are not good are left out
    good = np.ones(24, bool)
    good[5] = False
    made = spectrum(line.assign_coords(good=("band", good)), pixels=(0, 0)).axes[0]
    assert np.isnan(made.lines[0].get_ydata()).nonzero()[0].tolist() == [5]
    # axes may be of a subfigure
    figure = Figure(layout="constrained")
    axes = figure.subfigures(1, 2)[0].subplots()
    assert spectrum(line, pixels=(0, 0), axes=axes, path=tmp_path / "a.png") is figure
    assert flag_overlay(line, axes=axes) is figure


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
    # paints of a library by name
    named = paints.paint.spectrum(paints="left", spread="sd").axes[0]
    assert len(named.lines) == 1
    assert named.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(
        float((paints.reflectance + paints.reflectance_sd)[0].max())
    )
    assert len(paints.paint.spectrum().axes[0].lines) == 2


def test_all_that_is_wrong_is_told_at_once(line: xr.Dataset, paints: xr.Dataset) -> None:
    outside = [(20, 0), (0, -1)]
    expect_refusals(
        (SchemaError, ("choice-unknown", "argument-missing"), lambda: spectrum(line, spread="range")),
        (SchemaError, ("pixel-outside",) * 2, lambda: spectrum(line, pixels=outside)),
        (SchemaError, "dim-missing", lambda: spectrum(line.isel(along_track=5), pixels=[(5, 5)])),
        (SchemaError, "option-conflict", lambda: spectrum(paints, pixels=(0, 0))),
        (
            SchemaError,
            "paint-unknown",
            "'middle'",
            "left, _right $x",
            lambda: spectrum(paints, paints="middle"),
        ),
    )
    expect_errors(
        (SchemaError, r"whole.*type-wrong", lambda: spectrum(line, pixels=(0.5, 1.0))),
        (SchemaError, "curve-number", lambda: spectrum(line, pixels=[(0, 0)] * 25)),
        (SchemaError, "type-wrong", lambda: spectrum(line, pixels=(0, 0), axes=Figure().subplots(2))),
        (SchemaError, "type-wrong", lambda: spectrum(line, pixels=(0, 0), path=io.BytesIO())),
        (SchemaError, "value-out-of-range", lambda: spectrum(line, pixels=(0, 0), width=1.0)),
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


def test_colours_of_paints_and_the_bounded_overview() -> None:
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
    # the overview is bounded
    coarse = np.arange(400.0, 800.0, 40.0)
    count = MAX_PAINTS + 3
    many = xr.Dataset(
        {"reflectance": (("signature", "band"), np.full((count, coarse.size), 0.3, "f4"), {"units": "1"})},
        {"wavelength": ("band", coarse, {"units": "nm"}), "signature": [f"p{k}" for k in range(count)]},
    )
    figure = library_overview(many, columns=8)
    assert len(figure.axes) == MAX_PAINTS
    assert figure.get_suptitle() == f"the first {MAX_PAINTS} of {count} paints"
    expect_error(SchemaError, "library-empty", lambda: library_overview(many.isel(signature=slice(0, 0))))


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


# --- Flags and layers on the picture: what lies on the axes


@pytest.fixture(scope="module")
def flagged() -> xr.Dataset:
    # A flight line of 40 x 6 pixels, with flags and a layer of known places
    made = flight(lines=40, columns=6).line.paint.reflectance().compute()
    quality = np.zeros((40, 6), np.uint16)
    quality[3, 1] = Quality.GLINT
    quality[10:20, 2] = Quality.SHADOW
    quality[15, 2] |= int(Quality.SATURATED | Quality.GLINT)
    made["quality"] = (("along_track", "cross_track"), quality)
    glint = np.zeros((40, 6), np.float32)
    glint[7, 4], glint[8, 4], glint[0, 0] = 0.25, 0.5, np.nan
    made["glint_fraction"] = (("along_track", "cross_track"), glint, {"units": "1", "long_name": "Glint"})
    return made


# Machado, Oliveira and Fernandes (2009), severity 1, in linear sRGB
SEEN_BY = {
    "everyone": np.eye(3),
    "protanopes": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopes": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


@pytest.mark.parametrize("readers", SEEN_BY)
def test_colours_of_flags_are_told_apart(readers: str) -> None:
    # Expected: any two differ by 15 in CIEDE2000, of which 1 can just be seen; those before, by 1
    encoded = np.array([to_rgb(flag.colour) for flag in Quality])
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    lab = lab_of(encode_srgb(np.clip(linear @ SEEN_BY[readers].T, 0.0, 1.0)))
    assert (ciede2000(lab[:, np.newaxis], lab) + 1e3 * np.eye(len(lab))).min() > 15.0


def test_flagged_pixels_their_legend_and_chosen_flags_in_fewer_lines(flagged: xr.Dataset) -> None:
    drawn = flag_overlay(flagged, opacity=0.6).axes[0].images[1].get_array()
    assert drawn.shape == (40, 6, 4)  # lines upwards, columns to the right
    expected = np.zeros((40, 6), bool)
    expected[3, 1] = expected[10:20, 2] = True
    np.testing.assert_array_equal(drawn[..., 3] > 0, expected)
    np.testing.assert_allclose(drawn[3, 1], [*to_rgb(Quality.GLINT.colour), 0.6], atol=1e-6)
    np.testing.assert_allclose(drawn[12, 2, :3], to_rgb(Quality.SHADOW.colour), atol=1e-6)
    np.testing.assert_allclose(drawn[15, 2, :3], to_rgb(Quality.SATURATED.colour), atol=1e-6)
    # the legend tells shares of all pixels
    for lines in (1000, 7):
        made = flag_overlay(flagged, lines=lines).axes[0]
        assert texts(made) == ["saturated  0.42 %", "glint  0.83 %", "shadow  4.2 %"]
    # chosen flags alone
    by_name = flag_overlay(flagged, "glint").axes[0].images[1].get_array()
    np.testing.assert_array_equal(by_name, flag_overlay(flagged, Quality.GLINT).axes[0].images[1].get_array())
    assert int((by_name[..., 3] > 0).sum()) == 2
    assert texts(flag_overlay(flagged, ["low_sun"]).axes[0]) == ["low sun  0 %"]
    # a picture of fewer lines loses no flag
    made = flag_overlay(flagged, "glint", lines=10).axes[0]
    kept = made.images[1].get_array()[..., 3] > 0
    assert (kept.shape, np.argwhere(kept).tolist()) == ((10, 6), [[0, 1], [3, 2]])
    assert made.images[1].get_extent() == [-0.5, 5.5, -0.5, 39.5]


def test_layers_are_values_over_the_picture(flagged: xr.Dataset) -> None:
    made = flag_overlay(flagged, layer="glint_fraction").axes[0]
    assert made.get_legend() is None
    layer = made.images[1]
    assert layer.get_array()[8, 4] == np.float32(0.5)
    assert layer.get_array().mask[0, 0]
    alpha = layer.get_alpha()
    assert (alpha[8, 4], alpha[3, 3]) == (pytest.approx(0.75), 0)
    assert "glint_fraction [1]" in [other.get_ylabel() for other in made.figure.axes]
    fewer = flag_overlay(flagged, "shadow", layer="glint_fraction", lines=10).axes[0]
    assert float(fewer.images[1].get_array()[:, 4].max()) == 0.5
    assert fewer.get_legend() is not None
    # layers below zero are drawn about zero
    both = np.zeros((40, 6), np.float32)
    both[:20], both[20:30] = -0.3, 0.6
    tilt = flagged.assign(blocked_direct=(("along_track", "cross_track"), both))
    layer = flag_overlay(tilt, layer="blocked_direct").axes[0].images[1]
    assert (layer.norm.vmin, layer.norm.vmax) == pytest.approx((-0.6, 0.6))
    np.testing.assert_allclose(layer.get_alpha()[[0, 25, 35], 0], [0.75, 0.75, 0.0], atol=1e-6)
    # a little noise below zero is no sign
    both[:20] = -0.01
    assert flag_overlay(tilt, layer="blocked_direct").axes[0].images[1].norm.vmin == 0


def test_a_line_without_flags_says_so_and_quality_is_computed_where_it_is_missing(
    flagged: xr.Dataset,
) -> None:
    clean = flagged.assign(quality=flagged.quality * np.uint16(0))
    assert texts(flag_overlay(clean).axes[0]) == ["no flag set"]
    assert flag_shares(clean.quality.values) == {}
    assert flag_overlay(flight(lines=12).line).axes[0].get_ylabel() == "along_track [line], flown upwards"
    # what is not there is told
    expect_errors(
        (
            SchemaError,
            r"'glitter'.*saturated.*choice-un",
            lambda: flag_overlay(flagged, ["glitter"]),
        ),
        (SchemaError, r"'wavelength'.*missing", lambda: flag_overlay(flagged, layer="wavelength")),
    )


def test_the_stored_picture_is_taken_where_it_fits(flagged: xr.Dataset) -> None:
    stored = np.full((20, 6, 3), 51, np.uint8)
    attrs = {"line_step": 2, "column_step": 1}
    with_picture = flagged.assign(overview=(("overview_y", "overview_x", "rgb"), stored, attrs))
    np.testing.assert_allclose(background(with_picture, 4), np.full((10, 6, 3), 0.2), atol=1e-6)
    # it is too coarse for every line, and of a part of the line it is another's picture
    assert background(with_picture, 1).shape == (40, 6, 3)
    part = with_picture.isel(along_track=slice(0, 20))
    assert background(part, 1).shape == (20, 6, 3)
    assert not np.allclose(background(part, 1), 0.2)


def test_outlines_close_and_lie_where_the_region_is() -> None:
    made = Figure().add_subplot()
    draw_outlines(made, [Region("$roof", [(1, 10), (4, 10), (4, 20)])])
    x, y = made.lines[0].get_data()
    assert (x.tolist(), y.tolist()) == ([1, 4, 4, 1], [10, 10, 20, 10])
    assert made.texts[0].get_text() == r"\$roof"


# --- A red car reddens a grey one: what is drawn, and whether light says so


NM = np.linspace(400.0, 1000.0, 31)


def rectangle(name: str, columns: tuple[int, int], lines: tuple[int, int]) -> hp.Region:
    (left, right), (first, last) = columns, lines
    return hp.Region(name, [(left, first), (right, first), (right, last), (left, last)])


NEAR, FAR = rectangle("near", (4, 8), (2, 4)), rectangle("far", (4, 8), (22, 24))


def hood(added: float = 0.04) -> xr.Dataset:
    # Return a grey hood whose first lines are lit by something red, less and less
    red = added * np.exp(-np.arange(30) / 6.0)[:, None] * (NM > 600)
    cube = np.repeat((0.2 + red)[..., None], 12, axis=2).astype(np.float32)
    dims = ("along_track", "band", "cross_track")
    made = xr.Dataset(
        {"reflectance": (dims, cube, {"units": "1"})}, {"wavelength": ("band", NM, {"units": "nm"})}
    )
    layer = np.repeat(red.max(axis=1)[:, None], 12, axis=1).astype(np.float32)
    return made.assign(adjacency=(("along_track", "cross_track"), layer, {"units": "1"}))


def test_curves_are_the_mean_of_their_pixels(tmp_path: Path) -> None:
    line, plain = hood(), hood(0.0)
    _, along, spectra, added = adjacency_figure(
        line.chunk(along_track=7), NEAR, FAR, tmp_path / "a.png", without=plain, width=3
    ).axes
    assert (tmp_path / "a.png").stat().st_size > 10_000
    distance, values = along.lines[2].get_data()  # 650 nm
    np.testing.assert_array_equal(distance, np.arange(21))
    expected = 0.2 + 0.04 * np.exp(-(3 + np.arange(21)) / 6.0)
    np.testing.assert_allclose(values, expected, rtol=1e-5)
    np.testing.assert_allclose(along.lines[0].get_ydata(), 0.2, rtol=1e-5)  # 450 nm
    np.testing.assert_allclose(along.lines[6].get_ydata(), 0.2, rtol=1e-5)  # 650 nm, without
    np.testing.assert_allclose(added.lines[2].get_ydata(), expected - 0.2, atol=1e-6)
    np.testing.assert_allclose(added.lines[-1].get_ydata(), expected - 0.2, atol=1e-6)  # as flagged
    near = spectra.lines[0].get_ydata()
    np.testing.assert_allclose(
        near[NM > 600], 0.2 + 0.04 * np.exp(-np.array([2, 3, 4]) / 6).mean(), rtol=1e-5
    )
    np.testing.assert_allclose(near[NM < 600], 0.2, rtol=1e-5)
    labels = [text.get_text() for text in spectra.get_legend().get_texts()]
    assert labels == ["near", "far", "without the neighbour's colour"]


def test_without_anything_to_compare_with() -> None:
    _, along, _, added = adjacency_figure(hood().drop_vars("adjacency"), NEAR, FAR).axes
    assert not added.axison
    assert along.get_xlabel() == "distance from the near end [pixel]"
    slanted = adjacency_figure(hood(), NEAR, rectangle("far", (0, 2), (20, 22)), wavelengths=(450, 650))
    assert slanted.axes[1].lines[0].get_xdata().size == int(np.hypot(18, 5)) + 1


def test_bands_and_pixels_that_are_missing() -> None:
    line = hood()
    line["reflectance"][:, 4] = np.nan
    line["reflectance"][3, :, 6] = np.nan
    near = adjacency_figure(line, NEAR, FAR).axes[2].lines[0].get_ydata()
    assert np.isnan(near[4])
    assert np.isfinite(np.delete(near, 4)).all()


def test_what_cannot_be_drawn() -> None:
    line = hood()
    with pytest.raises(SchemaError) as refused:
        adjacency_figure(line, NEAR, hp.Regions((NEAR, FAR)), without=line.isel(band=slice(5)), width=0)
    assert refused.value.codes == ("grid-mismatch", "value-out-of-range", "region-number")
    expect_errors(
        (
            SchemaError,
            r"'off'.*region-empty",
            lambda: adjacency_figure(line, NEAR, rectangle("off", (40, 50), (2, 4))),
        ),
        (
            SchemaError,
            "region-overlap",
            lambda: adjacency_figure(line, NEAR, rectangle("same", (4, 8), (2, 4))),
        ),
        (
            SchemaError,
            "'reflectance' is missing",
            lambda: adjacency_figure(line.drop_vars("reflectance"), NEAR, FAR),
        ),
    )


def test_scenes_stand_above_the_spectra_of_their_regions() -> None:
    scenes = {"noon": hood(), "cloudy": 0.5 * hood(0.0)}
    for scene in scenes.values():
        scene.reflectance.attrs["units"] = "1"
    draw = partial(hp.pictures.scenes_and_spectra, scenes, variable="reflectance")
    *_, spectra = draw([NEAR, FAR]).axes[:2]
    assert [line.get_linestyle() for line in spectra.lines[:2]] == ["-", "-"]
    apart = draw({"noon": [NEAR], "cloudy": [FAR]}, together=False).axes
    assert len(apart) == 4
    np.testing.assert_allclose(apart[3].lines[0].get_ydata(), 0.1, rtol=1e-5)
    expect_errors(
        (SchemaError, "value-out-of-range", lambda: hp.pictures.scenes_and_spectra({}, [NEAR])),
        (SchemaError, "region-empty", lambda: draw([rectangle("off", (40, 50), (2, 4))])),
    )


# --- Pictures lie as the ground does: triangles keep their sense on the screen, and their lengths


LINES, COLUMNS = 40, 20


def on_screen(dataset: xr.Dataset) -> Any:
    # Return what leads from the data coordinates of the picture to the screen [pixel]
    axes = Figure(figsize=(6, 6)).add_subplot()
    lines, columns = (dataset.sizes[dim] for dim in ("along_track", "cross_track"))
    show_picture(axes, np.zeros((lines, columns, 3)), orientation_of(dataset))
    axes.figure.draw_without_rendering()
    return axes, axes.transData.transform


def line_of(heading: float, turned: bool) -> xr.Dataset:
    line = located(fly(LINES, COLUMNS, "none", heading=heading), chunk=None)
    return line.isel(cross_track=slice(None, None, -1)) if turned else line


@pytest.mark.parametrize("heading", [0.0, 60.0, 180.0, 290.0])
@pytest.mark.parametrize("turned", [False, True])
def test_a_line_is_never_mirrored(heading: float, turned: bool) -> None:
    # Expected: of three pixels, east and north turn the same way as right and up on the screen, whichever way
    # the flight goes and the columns run; the flight goes upwards; and lengths are those of the ground
    line = line_of(heading, turned)
    axes, to_screen = on_screen(line)
    pixels = [(5, 3), (30, 3), (5, 16)]  # line, column
    ground = np.array([[float(line[name][pixel]) for name in ("east", "north")] for pixel in pixels])
    shown = to_screen([(column, row) for row, column in pixels])
    sides = [points[1:] - points[0] for points in (ground, shown)]
    assert np.sign(np.linalg.det(sides[0])) == np.sign(np.linalg.det(sides[1]))
    assert shown[1, 1] > shown[0, 1]
    lengths = [np.linalg.norm(side, axis=1) for side in sides]
    assert lengths[1][0] / lengths[1][1] == pytest.approx(lengths[0][0] / lengths[0][1], rel=0.02)
    assert axes.get_ylabel() == "along_track [line], flown upwards"


@pytest.mark.parametrize(
    ("order", "rightwards", "label"),
    [
        ("left_to_right", True, "cross_track [column]"),
        ("right_to_left", False, "cross_track [column]"),
        (None, True, "cross_track [column], assumed to run to the right"),
    ],
)
def test_columns_run_as_declared(order: str | None, rightwards: bool, label: str) -> None:
    dataset = xr.Dataset({"quality": (("along_track", "cross_track"), np.zeros((LINES, COLUMNS), np.uint16))})
    if order:
        dataset.attrs["convention_column_order"] = order
    axes, to_screen = on_screen(dataset)
    left, right = to_screen([(2, 5), (9, 5)])
    assert bool(right[0] > left[0]) is rightwards
    assert axes.get_xlabel() == label
    up, along = np.diff(to_screen([(0, 0), (0, 1), (1, 1)]), axis=0)
    assert np.linalg.norm(up) == pytest.approx(np.linalg.norm(along), rel=1e-6)  # square


@pytest.mark.parametrize("rows_go_south", [True, False])
def test_a_map_has_north_up(rows_go_south: bool) -> None:
    north = 4_770_000.0 + 0.5 * np.arange(LINES) * (-1 if rows_go_south else 1)
    attrs = {"units": "m", "standard_name": "projection_y_coordinate"}
    axes, to_screen = on_screen(
        xr.Dataset(
            {"quality": (("along_track", "cross_track"), np.zeros((LINES, COLUMNS), np.uint16))},
            {
                "y": ("along_track", north, attrs),
                "x": ("cross_track", 3e5 + 0.5 * np.arange(COLUMNS), {"units": "m"}),
            },
        )
    )
    south, far_north = to_screen([(3e5, north.min()), (3e5, north.max())])
    assert far_north[1] > south[1]
    assert axes.images[0].get_extent()[2] == north[0] - 0.25 * np.sign(north[1] - north[0])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("east [m]", "north, up [m]")


def test_angles_of_the_columns_count_before_the_declared_order() -> None:
    line = xr.Dataset({"a": (("along_track", "cross_track"), np.zeros((4, 3)))})
    line.attrs["convention_column_order"] = "left_to_right"
    assert not orientation_of(line).is_mirrored
    turned = line.assign_coords(look_across=("cross_track", [9.0, 0.0, -9.0], {"units": "degree"}))
    assert orientation_of(turned).is_mirrored
    assert orientation_of(turned).labels[0] == "cross_track [column]"
