"""Flags and layers on the picture: what lies on the axes."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.regions import Region

pytest.importorskip("matplotlib")

from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from support.refusals import expect_errors

from hyperpaint.base.schema import flag_shares
from hyperpaint.light.daylight_colours import ciede2000, encode_srgb, lab_of
from hyperpaint.pictures.plot import background, draw_outlines, flag_overlay


def labels(made: Any) -> list[str]:
    return [text.get_text() for text in made.get_legend().get_texts()]


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
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


def test_flagged_pixels_have_the_colour_of_their_rarest_flag(line: xr.Dataset) -> None:
    drawn = flag_overlay(line, opacity=0.6).axes[0].images[1].get_array()
    assert drawn.shape == (40, 6, 4)  # lines upwards, columns to the right
    expected = np.zeros((40, 6), bool)
    expected[3, 1] = expected[10:20, 2] = True
    np.testing.assert_array_equal(drawn[..., 3] > 0, expected)
    np.testing.assert_allclose(drawn[3, 1], [*to_rgb(Quality.GLINT.colour), 0.6], atol=1e-6)
    np.testing.assert_allclose(drawn[12, 2, :3], to_rgb(Quality.SHADOW.colour), atol=1e-6)
    np.testing.assert_allclose(drawn[15, 2, :3], to_rgb(Quality.SATURATED.colour), atol=1e-6)


def test_the_legend_tells_shares_of_all_pixels(line: xr.Dataset) -> None:
    for lines in (1000, 7):
        made = flag_overlay(line, lines=lines).axes[0]
        assert labels(made) == ["saturated  0.42 %", "glint  0.83 %", "shadow  4.2 %"]


def test_chosen_flags_alone(line: xr.Dataset) -> None:
    by_name = flag_overlay(line, "glint").axes[0].images[1].get_array()
    np.testing.assert_array_equal(by_name, flag_overlay(line, Quality.GLINT).axes[0].images[1].get_array())
    assert int((by_name[..., 3] > 0).sum()) == 2
    assert labels(flag_overlay(line, ["low_sun"]).axes[0]) == ["low sun  0 %"]


def test_a_picture_of_fewer_lines_loses_no_flag(line: xr.Dataset) -> None:
    made = flag_overlay(line, "glint", lines=10).axes[0]
    drawn = made.images[1].get_array()[..., 3] > 0
    assert (drawn.shape, np.argwhere(drawn).tolist()) == ((10, 6), [[0, 1], [3, 2]])
    assert made.images[1].get_extent() == [-0.5, 5.5, -0.5, 39.5]


def test_layers_are_values_over_the_picture(line: xr.Dataset) -> None:
    made = flag_overlay(line, layer="glint_fraction").axes[0]
    assert made.get_legend() is None
    layer = made.images[1]
    assert layer.get_array()[8, 4] == np.float32(0.5)
    assert layer.get_array().mask[0, 0]
    alpha = layer.get_alpha()
    assert (alpha[8, 4], alpha[3, 3]) == (pytest.approx(0.75), 0)
    assert "glint_fraction [1]" in [other.get_ylabel() for other in made.figure.axes]
    fewer = flag_overlay(line, "shadow", layer="glint_fraction", lines=10).axes[0]
    assert float(fewer.images[1].get_array()[:, 4].max()) == 0.5
    assert fewer.get_legend() is not None


def test_layers_below_zero_are_drawn_about_zero(line: xr.Dataset) -> None:
    both = np.zeros((40, 6), np.float32)
    both[:20], both[20:30] = -0.3, 0.6
    tilt = line.assign(blocked_direct=(("along_track", "cross_track"), both))
    layer = flag_overlay(tilt, layer="blocked_direct").axes[0].images[1]
    assert (layer.norm.vmin, layer.norm.vmax) == pytest.approx((-0.6, 0.6))
    np.testing.assert_allclose(layer.get_alpha()[[0, 25, 35], 0], [0.75, 0.75, 0.0], atol=1e-6)
    # a little noise below zero is no sign
    both[:20] = -0.01
    assert flag_overlay(tilt, layer="blocked_direct").axes[0].images[1].norm.vmin == 0


def test_what_is_not_there_is_told(line: xr.Dataset) -> None:
    expect_errors(
        (
            SchemaError,
            r"'glitter'.*saturated.*choice-un",
            lambda: flag_overlay(line, ["glitter"]),
        ),
        (SchemaError, r"'wavelength'.*missing", lambda: flag_overlay(line, layer="wavelength")),
    )


def test_a_line_without_flags_says_so_and_quality_is_computed_where_it_is_missing(line: xr.Dataset) -> None:
    clean = line.assign(quality=line.quality * np.uint16(0))
    assert labels(flag_overlay(clean).axes[0]) == ["no flag set"]
    assert flag_shares(clean.quality.values) == {}
    assert flag_overlay(flight(lines=12).line).axes[0].get_ylabel() == "along_track [line], flown upwards"


def test_the_stored_picture_is_taken_where_it_fits(line: xr.Dataset) -> None:
    stored = np.full((20, 6, 3), 51, np.uint8)
    attrs = {"line_step": 2, "column_step": 1}
    with_picture = line.assign(overview=(("overview_y", "overview_x", "rgb"), stored, attrs))
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
