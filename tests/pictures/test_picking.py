"""Drawing regions: what clicks become. The browser itself is not needed, panel for the last tests."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import MissingExtraError, SchemaError
from hyperpaint.pictures import picking
from hyperpaint.pictures.picking import RegionPicker, corners_at, pick_regions

BEGIN = hp.Regions((hp.Region("roof", [(1, 2), (4, 2), (4, 9)], properties={"colour": "red"}),))


class NoView:
    """Stands in for the widget where panel is not installed."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.layout = None


@pytest.fixture
def picker(monkeypatch: pytest.MonkeyPatch) -> RegionPicker:
    """A picker of a line of 24 x 6 pixels without its widget."""
    monkeypatch.setattr(picking, "PickerView", NoView)
    monkeypatch.setattr(picking, "_need_extra", lambda: None)
    return pick_regions(flight().line, BEGIN, flightline="raw_0")


PLACES = st.floats(-5.0, 30.0)


@settings(max_examples=60)
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


def test_polygons_become_regions_with_names_of_their_own(picker: RegionPicker) -> None:
    assert picker.regions == BEGIN
    assert picker.add([0.2, 9.6, 9.4, 9.4], [0, 0, 3.4, 3.4]) == "region 1"
    assert picker.add([1, 2], [1, 2]) is None
    assert picker.add([0, 9, 9], [0, 0, 3]) == "region 2"
    first = picker.regions[1]
    assert first.polygon.tolist() == [[0, 0], [0, 10], [3, 9]]
    assert first.flightline == "raw_0"
    picker.drop("region 1")
    assert picker.add([0, 9, 9], [0, 0, 3]) == "region 1"
    assert picker.regions.names == ("roof", "region 2", "region 1")


def test_corners_move_and_properties_stay(picker: RegionPicker) -> None:
    assert picker.move("roof", [2, 2, 12.2], [1, 4, 4])
    assert picker.regions[0].polygon.tolist() == [[1, 2], [4, 2], [4, 12]]
    assert picker.regions[0].properties == {"colour": "red"}
    assert not picker.move("roof", [2, 2, 2], [1, 4, 5])
    assert picker.regions[0].polygon.tolist() == [[1, 2], [4, 2], [4, 12]]


def test_names_are_taken_or_refused_with_a_reason(picker: RegionPicker) -> None:
    picker.add([0, 9, 9], [0, 0, 3])
    assert picker.rename("region 1", " bonnet ") is None
    assert picker.regions.names == ("roof", "bonnet")
    assert "occurs twice" in str(picker.rename("bonnet", "roof"))
    assert "is empty" in str(picker.rename("bonnet", " "))
    assert picker.regions.names == ("roof", "bonnet")


def test_the_spectrum_is_that_of_the_signature(picker: RegionPicker) -> None:
    picker.add([0, 0, 23, 23], [0, 5, 5, 0])
    found = picker.spectrum_of(picker.regions[1])
    assert not isinstance(found, str)
    expected = hp.extract_signatures(flight().line, hp.Regions((hp.Region("a", picker.regions[1].polygon),)))
    np.testing.assert_array_equal(found[0], expected.wavelength.values)
    np.testing.assert_allclose(found[1][1], expected.reflectance_quantiles.values[0, 2], rtol=1e-6)


def test_a_region_without_pixels_says_why(picker: RegionPicker) -> None:
    # a sliver between the pixels' centres
    told = picker.spectrum_of(hp.Region("sliver", [(0.2, 0.2), (0.4, 0.2), (0.4, 20.0)]))
    assert "sliver" in str(told)


def test_what_is_drawn_is_saved(picker: RegionPicker, tmp_path: Path) -> None:
    assert hp.read_regions(picker.save(tmp_path / "r.geojson")) == picker.regions


def test_regions_to_begin_with_can_be_drawn(picker: RegionPicker) -> None:
    with pytest.raises(SchemaError, match="map coordinates"):
        pick_regions(flight().line, hp.Regions(tuple(BEGIN), "map"))
    holed = hp.Region("ring", [(0, 0), (5, 0), (5, 9)], ([(2, 1), (3, 1), (3, 2)],))
    with pytest.raises(SchemaError, match="holes cannot be drawn: ring"):
        pick_regions(flight().line, holed)


@pytest.mark.parametrize("package", ["panel", "bokeh"])
def test_without_the_extra(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "panel", ModuleType("panel"))
    monkeypatch.setitem(sys.modules, "bokeh", ModuleType("bokeh"))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"needs {package}; .*hyperpaint\[interactive\]"):
        pick_regions(flight().line)


# --- the widget --------------------------------------------------------------------------------------------


@pytest.fixture
def shown() -> Any:
    """A picker with its widget."""
    pytest.importorskip("panel")
    return pick_regions(flight().line, BEGIN)


def test_clicks_draw_and_a_double_click_closes(shown: Any) -> None:
    view = shown._shown
    for along, across in ((10, 0), (20, 0.3), (20.4, 3)):
        view.tap(along, across)
    assert view._draft.data["along"] == [10, 20, 20.4]
    view.close(20.3, 3.1)
    assert view._draft.data == {"along": [], "across": []}
    assert shown.regions[1].polygon.tolist() == [[0, 10], [0, 20], [3, 20]]
    # shown is what is kept, the new one with corners to drag
    assert view._outlines.data["along"][1] == [10, 20, 20]
    assert view._corners.data == {"along": [10, 20, 20], "across": [0, 0, 3]}
    assert view._chosen.options == ["roof", "region 1"]
    assert view._name.value == view._chosen.value == "region 1"
    assert view._curves.data["name"] == ["roof", "region 1"]
    assert view._message.object == "2 regions"


def test_too_few_corners_are_told(shown: Any) -> None:
    shown._shown.close(10, 0)
    assert "no area" in shown._shown._message.object
    assert len(shown.regions) == 1


def test_corners_are_dragged(shown: Any) -> None:
    view = shown._shown
    view._corners.data = {"along": [2, 2, 15.3], "across": [1, 4, 4]}
    assert shown.regions[0].polygon.tolist() == [[1, 2], [4, 2], [4, 15]]
    assert view._corners.data["along"] == [2, 2, 15]
    view._corners.data = {"along": [2, 2, 2], "across": [1, 4, 4]}
    assert view._corners.data["along"] == [2, 2, 15]


def test_a_corner_is_undone_a_region_renamed_and_removed(shown: Any) -> None:
    view = shown._shown
    view.tap(1, 1)
    view.tap(2, 2)
    view._undo.clicks += 1
    assert view._draft.data == {"along": [1], "across": [1]}
    view._name.value = "<b>bonnet"
    assert shown.regions.names == ("<b>bonnet",)
    view._name.value = ""
    assert "&#x27;&#x27; is empty" in view._message.object
    assert view._name.value == "<b>bonnet"
    view._remove.clicks += 1
    assert len(shown.regions) == 0
    assert view._chosen.value is None


def test_the_picture_puts_pixel_centres_on_whole_numbers(shown: Any) -> None:
    from bokeh.models import ImageRGBA, Plot

    plot = next(
        iter(shown.view.select(lambda pane: hasattr(pane, "object") and isinstance(pane.object, Plot)))
    )
    image = next(r for r in plot.object.renderers if isinstance(r.glyph, ImageRGBA))
    assert (image.glyph.x, image.glyph.y, image.glyph.dw, image.glyph.dh) == (-0.5, -0.5, 24, 6)
    assert image.data_source.data["image"][0].shape == (6, 24)
    # the first column is on top
    assert plot.object.y_range.start > plot.object.y_range.end


def test_on_a_crop_regions_have_the_numbers_of_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picking, "PickerView", NoView)
    monkeypatch.setattr(picking, "_need_extra", lambda: None)
    line = flight().line.assign_coords(along_track=np.arange(24) + 100, cross_track=np.arange(6) + 10)
    begin = hp.Regions((hp.Region("roof", [(11, 102), (14, 102), (14, 109)]),))
    picker = pick_regions(line, begin)
    assert picker.regions.digest == begin.digest
    # where it is on the picture, of which a click says the place
    assert picker.drawn[0].polygon.tolist() == [[1, 2], [4, 2], [4, 9]]
    name = picker.add([2, 9, 9], [1, 1, 4])
    assert picker.regions[1].polygon.tolist() == [[11, 102], [11, 109], [14, 109]]
    (_, drawn) = picker.spectrum_of(picker.drawn[1])
    library = hp.extract_signatures(line, picker.regions[1:2], members=0, min_pixels=1)
    middle = library["reflectance_quantiles"].sel(quantile=0.5, method="nearest")[0]
    np.testing.assert_allclose(drawn[1], middle, equal_nan=True)
    assert name == "region 1"
