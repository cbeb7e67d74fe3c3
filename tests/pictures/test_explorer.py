"""The explorer: what clicks become. The browser itself is not needed, panel for the last tests."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors, expect_words, refusal
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import MissingExtraError, SchemaError, StoreError
from hyperpaint.base.schema import CUBE
from hyperpaint.pictures import exploring
from hyperpaint.pictures.exploring import INFRARED, Explored, Explorer, Spectrum, corners_at

BEGIN = hp.Regions((hp.Region("roof", [(1, 2), (4, 2), (4, 9)], properties={"colour": "red"}),))
PLACES = st.floats(-5.0, 30.0)


@pytest.fixture
def state() -> Explored:
    # What an explorer shows of a line of 24 x 6 pixels
    return Explored(flight().line, BEGIN, library=hp.paints.starter_library(members=0), flightline="raw_0")


def spectrum_of(state: Explored, place: exploring.Place) -> Spectrum:
    spectrum = state.spectrum_of(place)
    assert isinstance(spectrum, Spectrum), spectrum
    return spectrum


# --- regions -----------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(PLACES, PLACES), max_size=8))
def test_corners_are_whole_pixels_of_the_line(places: list[tuple[float, float]]) -> None:
    made = corners_at([place[0] for place in places], [place[1] for place in places], (24, 6))
    if made is None:
        return
    assert made.dtype == np.float64
    assert (made == np.round(made)).all()
    assert made.min() >= 0
    assert (made.max(axis=0) <= [5, 23]).all()
    assert (made != np.roll(made, 1, axis=0)).any(axis=1).all()
    hp.Region("any", made)


@pytest.mark.parametrize(
    "places", [[], [(1, 1)], [(1, 1), (2, 2)], [(1, 1), (2, 2), (3, 3)], [(1, 1), (1.2, 1.1), (0.9, 1.0)]]
)
def test_without_area_there_is_no_polygon(places: list[tuple[float, float]]) -> None:
    assert corners_at([place[0] for place in places], [place[1] for place in places], (24, 6)) is None
    assert corners_at([1, 5, np.nan], [1, 1, 4], (24, 6)) is None


def test_polygons_become_regions_whose_corners_move_and_names_change(state: Explored) -> None:
    assert (state.regions, state.add([0.2, 9.6, 9.4, 9.4], [0, 0, 3.4, 3.4])) == (BEGIN, "region 1")
    assert state.add([1, 2], [1, 2]) is None
    assert state.add([0, 9, 9], [0, 0, 3]) == "region 2"
    first = state.regions[1]
    assert (first.polygon.tolist(), first.flightline) == ([[0, 0], [0, 10], [3, 9]], "raw_0")
    state.drop("region 1")
    assert state.add([0, 9, 9], [0, 0, 3]) == "region 1"
    assert state.regions.names == ("roof", "region 2", "region 1")
    # corners move, and properties stay
    for along, is_area in ([1, 4, 4], True), ([1, 4, 5], False):
        assert state.move("roof", [2, 2, 12.2 if is_area else 2], along) == is_area
        assert state.regions[0].polygon.tolist() == [[1, 2], [4, 2], [4, 12]]
    assert state.regions[0].properties == {"colour": "red"}
    # names are taken, or refused with a reason
    state.drop("region 2")
    assert state.rename("region 1", " bonnet ") is None
    assert state.regions.names == ("roof", "bonnet")
    assert "occurs twice" in str(state.rename("bonnet", "roof"))
    assert "is empty" in str(state.rename("bonnet", " "))
    assert state.regions.names == ("roof", "bonnet")


def test_what_is_drawn_is_saved_and_signatures_take_it(state: Explored, tmp_path: Path) -> None:
    state.add([0, 0, 23, 23], [0, 5, 5, 0])
    path = state.save(tmp_path / "r.geojson")
    assert hp.read_regions(path) == state.regions
    library = hp.extract_signatures(flight().line, path, min_pixels=1, members=0)
    assert library["signature"].values.tolist() == ["roof", "region 1"]
    spectrum = spectrum_of(state, state.drawn[1])
    middle = library["reflectance_quantiles"].sel(quantile=0.5, method="nearest")[1]
    np.testing.assert_array_equal(spectrum.reflectance.astype(np.float32), middle.values)


def test_what_cannot_be_explored_is_refused() -> None:
    line = flight().line
    holed = hp.Region("ring", [(0, 0), (5, 0), (5, 9)], ([(2, 1), (3, 1), (3, 2)],))
    expect_errors(
        (SchemaError, "region-coordinates", lambda: Explored(line, hp.Regions(tuple(BEGIN), "map"))),
        (SchemaError, r"ring.*region-holes", lambda: Explored(line, holed)),
        (SchemaError, "reflectance", lambda: Explored(line.drop_vars("counts"))),
        (SchemaError, "dim-missing", lambda: Explored(line.isel(along_track=3))),
    )


def test_raw_counts_radiance_and_maps_are_explored(tmp_path: Path) -> None:
    line = flight().line
    raw = line[["counts", "wavelength"]]
    hp.io.write_envi(raw, tmp_path / "cube.hdr", interleave="bsq")
    (opened,) = exploring.shown_lines(tmp_path / "cube.hdr").values()
    lit = line.drop_vars("irradiance").drop_dims(
        ["irradiance_time", "irradiance_wavelength"], errors="ignore"
    )
    for cube, quantity, values in (
        (opened(), "values", raw.counts),
        (raw.drop_vars("wavelength"), "raw counts [count]", raw.counts),
        (lit, "radiance", line.paint.radiance().radiance),
    ):
        state = Explored(cube, library=hp.paints.starter_library(members=0))
        assert state.quantity.startswith(quantity)
        spectrum = spectrum_of(state, (7, 3))
        np.testing.assert_array_equal(spectrum.reflectance, values.transpose(*CUBE).values[7, :, 3])
        assert state.near_paints(spectrum) == []
        assert quantity in str(state.uncertainty_of((7, 3)))
        assert state.picture(*state.recipes.values()).rgba.any()
    # bands without wavelengths are named by their numbers
    bands = Explored(raw.drop_vars("wavelength"))
    assert next(iter(bands.recipes)).startswith("band ")
    # of another program, the only cube is shown
    raw.rename(counts="rad").to_zarr(tmp_path / "other.zarr", zarr_format=2)
    (other,) = exploring.shown_lines(tmp_path / "other.zarr").values()
    np.testing.assert_array_equal(Explored(other()).line["reflectance"], raw.counts)
    # a map is north up: its columns run to the right
    numbers = {"y": ("y", np.arange(24.0, 0.0, -1.0)), "x": ("x", np.arange(6.0))}
    chart = raw.rename(along_track="y", cross_track="x").drop_vars(("y", "x"), errors="ignore")
    chart = chart.assign_coords(numbers)
    state = Explored(chart)
    assert (state.shape, state.is_mirrored) == ((6, 24), False)
    assert "column 3, row 7" in spectrum_of(state, (3, 7)).text
    expect_error(SchemaError, "line-is-map", lambda: state.save(tmp_path / "r.geojson"))


def test_on_a_crop_regions_have_the_numbers_of_the_line() -> None:
    line = flight().line.assign_coords(along_track=np.arange(24) + 100, cross_track=np.arange(6) + 10)
    begin = hp.Regions((hp.Region("roof", [(11, 102), (14, 102), (14, 109)]),))
    state = Explored(line, begin)
    assert state.regions.digest == begin.digest
    # where it is on the picture, of which a click says the place
    assert state.drawn[0].polygon.tolist() == [[1, 2], [4, 2], [4, 9]]
    assert state.add([2, 9, 9], [1, 1, 4]) == "region 1"
    assert state.regions[1].polygon.tolist() == [[11, 102], [11, 109], [14, 109]]
    spectrum = spectrum_of(state, state.drawn[1])
    middle = hp.extract_signatures(line, state.regions[1:2], members=0, min_pixels=1)[
        "reflectance_quantiles"
    ].sel(quantile=0.5, method="nearest")[0]
    np.testing.assert_array_equal(spectrum.reflectance.astype(np.float32), middle.values)
    assert "line 105, column 13" in spectrum_of(state, (5, 3)).text


def test_regions_of_other_lines_are_kept_and_not_drawn(tmp_path: Path) -> None:
    other = hp.Region("hood", [(0, 0), (4, 0), (4, 9)], ([(2, 1), (3, 1), (3, 2)],), flightline="raw_1")
    own = hp.Region("trunk", [(0, 0), (4, 0), (4, 9)], flightline="raw_0")
    path = hp.write_regions([other, own, *BEGIN], tmp_path / "both.geojson")
    state = Explored(flight().line, path, flightline="raw_0")
    assert state.drawn.names == state.regions.names == ("trunk", "roof")
    assert state.is_saved
    # names are of both, as they are of the file
    assert "occurs twice" in str(state.rename("roof", "hood"))
    assert (state.drawn.names, state.add([0, 9, 9], [0, 0, 3])) == (("trunk", "roof"), "region 1")
    state.save_again(path)
    saved = hp.read_regions(path)
    assert sorted(saved.names) == ["hood", "region 1", "roof", "trunk"]
    assert next(region for region in saved if region.name == "hood") == other
    # what the line says of itself, as signatures read it
    assert Explored(flight().line, path).drawn.names == ("trunk", "roof", "region 1")
    nameless = flight().line.assign_attrs(name="")
    whole = [own, hp.Region("hood", other.polygon, flightline="raw_1")]
    assert Explored(nameless, whole).drawn.names == ("trunk", "hood")


def test_a_file_that_was_changed_elsewhere_is_left_as_it_is(tmp_path: Path) -> None:
    path = hp.write_regions(BEGIN, tmp_path / "r.geojson")
    state = Explored(flight().line, path)
    state.add([0, 9, 9], [0, 0, 3])
    state.save_again(path)
    state.drop("region 1")
    state.save_again(path)
    changed = path.read_text(encoding="utf-8").replace("roof", "bonnet")
    path.write_text(changed, encoding="utf-8")
    state.drop("roof")
    with refusal(StoreError, "file-changed", "changed by another program"):
        state.save_again(path)
    assert path.read_text(encoding="utf-8") == changed
    assert not state.is_saved
    path.rename(tmp_path / "theirs.geojson")
    state.save_again(path)
    assert state.is_saved
    # one that appears meanwhile is not ours either
    expect_error(StoreError, r"not read.*file-changed", lambda: state.save_again(tmp_path / "theirs.geojson"))


def test_a_page_loaded_anew_says_what_is_not_saved(tmp_path: Path) -> None:
    pytest.importorskip("panel")
    state, path = Explored(flight().line, BEGIN), tmp_path / "r.geojson"
    state.add([0, 9, 9], [0, 0, 3])
    shown = Explorer(state, save_to=path)
    assert "2 regions, not saved" in shown._widgets.message.object
    path.write_text("{}", encoding="utf-8")
    shown._widgets.save_button.clicks += 1
    assert "begin anew with --regions" in shown._widgets.message.object
    path.unlink()
    shown._widgets.save_button.clicks += 1
    assert Explorer(state, save_to=path)._widgets.message.object == "2 regions"


# --- spectra -----------------------------------------------------------------------------------------------


def test_a_click_has_the_bits_of_the_pixel(state: Explored, monkeypatch: pytest.MonkeyPatch) -> None:
    line = flight().line
    whole = line.paint.reflectance()
    for along, across in ((0, 0), (7, 3), (23, 5)):
        spectrum = spectrum_of(state, (along, across))
        assert spectrum.reflectance.dtype == np.float32
        pixel = line.paint.pixels(along, across)
        good = line["good"].values if "good" in line.variables else np.ones(pixel.sizes["band"], bool)
        for other in (pixel.reflectance, whole.reflectance[along, :, across]):
            assert (
                spectrum.reflectance.tobytes() == np.where(good, other.values, np.float32(np.nan)).tobytes()
            )
        assert all(
            name.replace("_", " ") in spectrum.text for name in hp.base.schema.flag_names(int(pixel.quality))
        )
    # of a large region every n-th line is taken
    state.add([0, 0, 23, 23], [0, 5, 5, 0])
    monkeypatch.setattr(exploring, "MAX_REGION_PIXELS", 60)
    spectrum = spectrum_of(state, state.drawn[1])
    assert "of 48 pixels (every 3. line)" in spectrum.text
    rows = flight().line.paint.reflectance().compute().isel(along_track=slice(None, None, 3))
    values = rows.reflectance.transpose("along_track", "cross_track", "band").values[
        (rows.quality.values & exploring.EXCLUDED) == 0
    ]
    np.testing.assert_allclose(spectrum.reflectance, np.median(values, axis=0), rtol=1e-6)


def test_flags_of_a_region_are_named_and_left_out() -> None:
    line = flight().line.paint.reflectance().compute()
    quality = line["quality"].values.copy()
    quality[:12] |= np.uint16(hp.Quality.GLINT)
    line["quality"] = line["quality"].copy(data=quality)
    state = Explored(line)
    state.add([0, 0, 23, 23], [0, 5, 5, 0])
    spectrum = spectrum_of(state, state.drawn[0])
    assert "glint 50 %" in spectrum.text
    assert "72 of 144" in spectrum.text or int(spectrum.text.split()[2]) <= 72
    state.add([0, 0, 9, 9], [0, 5, 5, 0])
    message = str(state.spectrum_of(state.drawn[1]))
    assert "glint 100 %" in message
    assert message.endswith("[region-empty]")
    # a sliver between the pixels' centres
    assert "sliver contains no pixel" in str(
        state.spectrum_of(hp.Region("sliver", [(0.2, 0.2), (0.4, 0.2), (0.4, 20.0)]))
    )


def test_the_uncertainty_is_that_of_the_mean() -> None:
    noise = {"electrons_per_count": 20.0, "read_noise": 0.5}
    line = flight().line.assign(
        {name: hp.base.schema.label(xr.DataArray(np.float32(value)), name) for name, value in noise.items()}
    )
    state = Explored(line)
    sure = state.uncertainty_of((7, 3))
    assert not isinstance(sure, str), sure
    u, text = sure
    expect_words(text, "of a pixel", "systematic")
    mean = hp.radiometry.mean_uncertainty(
        line.isel(along_track=slice(7, 8), cross_track=slice(3, 4)).paint.reflectance(uncertainty=True)
    )
    np.testing.assert_array_equal(u, np.hypot(mean.u_random.values, np.nan_to_num(mean.u_systematic.values)))
    state.add([2, 2, 9, 9], [1, 4, 4, 1])
    whole = state.uncertainty_of(state.drawn[0])
    assert not isinstance(whole, str)
    assert np.nanmedian(whole[0]) < np.nanmedian(u)
    noiseless = Explored(flight().line.drop_vars("read_noise", errors="ignore"))
    assert "read_noise" in str(noiseless.uncertainty_of((0, 0)))


def test_near_paints_are_those_of_the_search(state: Explored) -> None:
    library = state.library
    assert library is not None
    paint = library["reflectance"].values[7]
    spectrum = Spectrum(library["wavelength"].values, 0.5 * paint, None, "")
    near = state.near_paints(spectrum)
    assert near[0].name == str(library["signature"].values[7])
    assert (near[0].angle, near[0].factor) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.5))
    assert [one.angle for one in near] == sorted(one.angle for one in near)
    assert max(one.angle for one in near) <= exploring.MAX_NEAR_ANGLE
    assert state.near_paints(spectrum._replace(reflectance=8.0 * paint)) == []  # another brightness
    assert state.near_paints(spectrum._replace(reflectance=np.full(paint.shape, np.nan))) == []


# --- pictures ----------------------------------------------------------------------------------------------


def test_a_picture_of_a_band_has_the_levels_of_the_band(
    state: Explored, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = flight().line.paint.pixels(wavelength=650.0).reflectance.values
    bytes_of = state.picture((650.0,), (0.0, 100.0)).rgba.view(np.uint8).reshape(6, 24, 4)
    there = np.isfinite(values).T
    assert (bytes_of[..., 3] == np.where(there, 255, 0)).all()
    # brighter pixels are never darker in the picture
    assert (np.diff(bytes_of[..., 0][there][np.argsort(values.T[there])].astype(int)) >= 0).all()
    assert (bytes_of[..., 0][there].min(), bytes_of[..., 0][there].max()) == (0, 255)
    # a part has the colours of the whole
    for recipe in ((), INFRARED, (550.0,)):
        if state.has_bands(recipe):
            whole, part = state.picture(recipe), state.picture(recipe, window=(5, 12))
            assert (part.first, part.last) == (5, 12)
            np.testing.assert_array_equal(part.rgba, whole.rgba[:, 5:12])
    monkeypatch.setattr(exploring, "DETAIL_LINES", 10)
    monkeypatch.setattr(exploring, "SPARSE_STEP", 5)
    sparse = Explored(flight().line).picture((550.0,))
    assert (sparse.rgba.shape, sparse.first, sparse.last) == ((6, 5), 0, 25)
    assert "every 5. line" in sparse.text


def test_flags_are_drawn_in_their_colours() -> None:
    line = flight().line.paint.reflectance().compute()
    quality = np.zeros_like(line["quality"].values)
    quality[3:5, 2] = hp.Quality.SHADOW
    quality[4, 2] |= np.uint16(hp.Quality.GLINT)
    line["quality"] = line["quality"].copy(data=quality)
    glint = line[["reflectance", "quality"]].copy(deep=True)
    glint["reflectance"][{"along_track": 6, "cross_track": 1}] = np.nan
    glint["quality"][6, 1] = np.uint16(hp.Quality.SATURATED)
    bands = Explored(glint).picture((550.0,)).rgba.view(np.uint8).reshape(6, 24, 4)
    assert bands[1, 6].tolist() == [255] * 4  # saturated pixels are white
    state = Explored(line)
    assert state.flag_shares == {hp.Quality.GLINT: 1 / 144, hp.Quality.SHADOW: 2 / 144}
    drawn = state.flag_picture(state.flag_shares).rgba.view(np.uint8).reshape(6, 24, 4)
    assert np.argwhere(drawn[..., 3]).tolist() == [[2, 3], [2, 4]]
    # the rarest is on top
    assert bytes(drawn[2, 4, :3]).hex() == "4de6cc"


# --- the widget --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["panel", "bokeh"])
def test_without_the_extra(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "panel", ModuleType("panel"))
    monkeypatch.setitem(sys.modules, "bokeh", ModuleType("bokeh"))
    monkeypatch.setitem(sys.modules, package, None)
    caught = expect_error(MissingExtraError, "extra-missing", lambda: flight().line.paint.explore())
    assert f"needs {package}" in caught.problem.found
    assert "hyperpaint[interactive]" in caught.problem.mend


@pytest.fixture
def shown() -> Any:
    # An explorer with its widget
    pytest.importorskip("panel")
    return flight().line.paint.explore(BEGIN)


def test_a_click_shows_the_spectrum_and_a_drag_the_median(shown: Any) -> None:
    shown.tap(7.2, 2.9)
    curves = shown._sources["curves"].data
    assert curves["name"] == ["roof", "clicked"]
    np.testing.assert_array_equal(
        curves["reflectance"][1], flight().line.paint.pixels(7, 3).reflectance.values
    )
    assert "line 7, column 3" in shown._widgets.spectrum.object
    assert len(shown._widgets.paint_boxes.options) <= 5
    shown.tap(40.0, 2.0)  # beside the picture
    assert "line 7, column 3" in shown._widgets.spectrum.object
    shown.drag({"type": "rect", "x0": 9.4, "x1": 1.6, "y0": 0.7, "y1": 3.2})
    assert "of 24 pixels" in shown._widgets.spectrum.object
    assert not shown._widgets.box_button.disabled
    shown._widgets.box_button.clicks += 1
    assert shown.regions[1].polygon.tolist() == [[1, 2], [3, 2], [3, 9], [1, 9]]
    assert shown._widgets.region_menu.value == "region 1"
    assert "not saved" in shown._widgets.message.object


def test_clicks_draw_and_a_double_click_closes(shown: Any) -> None:
    shown._widgets.mode.value = "draw"
    for along, across in ((10, 0), (20, 0.3), (20.4, 3)):
        shown.tap(along, across)
    assert shown._sources["draft"].data["along"] == [10, 20, 20.4]
    shown._widgets.undo_button.clicks += 1
    assert shown._sources["draft"].data["along"] == [10, 20]
    shown.tap(20.4, 3)
    shown.close(20.3, 3.1)
    assert shown._sources["draft"].data == {"along": [], "across": []}
    assert shown.regions[1].polygon.tolist() == [[0, 10], [0, 20], [3, 20]]
    assert shown._widgets.region_menu.options == [None, "roof", "region 1"]
    assert shown._widgets.name.value == shown._widgets.region_menu.value == "region 1"
    assert shown._sources["curves"].data["name"] == ["roof", "region 1"]
    shown.close(10, 0)
    assert "no area" in shown._widgets.message.object
    assert len(shown.regions) == 2
    # clicks in haste end nothing
    shown.tap(12, 0)
    shown.close(12, 4)
    assert shown.regions[2].polygon.tolist() == [[0, 10], [0, 12], [4, 12]]


def test_corners_are_dragged_and_bands_chosen_on_the_picture(shown: Any) -> None:
    corners = shown._sources["corners"]
    assert corners.data["along"] == []
    shown._widgets.mode.value = "edit"
    shown.tap(4.0, 3.5)
    assert corners.data == {"along": [2, 2, 9], "across": [1, 4, 4]}
    corners.data = {"along": [2, 2, 15.3], "across": [1, 4, 4]}
    assert shown.regions[0].polygon.tolist() == [[1, 2], [4, 2], [4, 15]]
    assert corners.data["along"] == [2, 2, 15]
    corners.data = {"along": [2, 2, 2], "across": [1, 4, 4]}
    assert corners.data["along"] == [2, 2, 15]
    # pixel centres lie on whole numbers
    base = shown._sources["base"].data
    assert [base[name][0] for name in ("x", "y", "dw", "dh")] == [-0.5, -0.5, 24, 6]
    assert base["image"][0].shape == (6, 24)
    # the first column is on top
    y_range = shown._plot.y_range
    assert y_range.start > y_range.end
    # bands and flags are chosen
    band = shown._widgets.band.options[-1]
    shown.take_band(band + 40.0)
    assert (shown._widgets.recipe.value, shown._widgets.band.value) == ("one band", band)
    assert shown._shown_band.location == band
    assert f"{band:.1f} nm" in shown._widgets.caption.object
    shown._widgets.recipe.value = "true colour"
    assert not shown._shown_band.visible
    shown._sources["view"].data = {"along": [-0.5, 15.5]}
    assert shown._sources["detail"].data["dw"] == [shown._window[1]]


def test_regions_are_renamed_saved_and_removed(shown: Any, tmp_path: Path) -> None:
    shown._widgets.name.value = "<b>bonnet"
    assert shown.regions.names == ("<b>bonnet",)
    assert "&lt;b&gt;bonnet" in shown._widgets.spectrum.object
    shown._widgets.name.value = ""
    assert "&#x27;&#x27; is empty" in shown._widgets.message.object
    assert shown._widgets.name.value == "<b>bonnet"
    shown._widgets.file.value = str(tmp_path / "r.geojson")
    shown._widgets.save_button.clicks += 1
    assert hp.read_regions(tmp_path / "r.geojson") == shown.regions
    shown._widgets.remove_button.clicks += 1
    assert len(shown.regions) == 0
    assert shown._widgets.region_menu.value is None
    shown._widgets.save_button.clicks += 1
    assert "saved" in shown._widgets.message.object
    shown._widgets.file.value = str(tmp_path / "other.geojson")
    (tmp_path / "other.geojson").write_text("{}", encoding="utf-8")
    shown._widgets.save_button.clicks += 1
    assert "other.geojson" in shown._widgets.message.object
    assert (tmp_path / "other.geojson").read_text(encoding="utf-8") == "{}"
