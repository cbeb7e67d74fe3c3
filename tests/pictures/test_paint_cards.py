"""The card of a paint: its place, what was left out of it, and the interval of its signature."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def measured() -> tuple[xr.Dataset, xr.Dataset]:
    # A line with glint on a corner of its one region, and the library of that
    line = flight(lines=40).line.paint.reflectance().compute()
    quality = np.zeros((40, 6), np.uint16)
    quality[10:12, 1:3] = Quality.GLINT
    line["quality"] = line.quality.copy(data=quality)
    reasons = {"kind": "roof", "finish": "solid", "reasons": ["windows end it on both sides", "40 pixels"]}
    region = hp.Region(
        "red $roof", [(1, 10), (4, 10), (4, 19), (1, 19)], flightline="raw_0", properties=reasons
    )
    return line, hp.extract_signatures({"raw_0": line}, hp.Regions((region,)))


def test_a_card_says_what_was_used_and_why(measured: tuple[xr.Dataset, xr.Dataset], tmp_path: Path) -> None:
    line, library = measured
    figure = hp.pictures.paint_card(line, library, "red $roof", tmp_path / "card.png")
    assert (tmp_path / "card.png").stat().st_size > 10_000
    text, place, used, signature = figure.axes
    said = text.texts[0].get_text()
    assert said.startswith(r"red \$roof  |  roof  |  solid")
    assert "windows end it on both sides; 40 pixels" in said
    # the margin is cut at the edges of the line, and places stay those of the line
    assert (place.get_xlim(), place.get_ylim()) == ((-0.5, 5.5), (-0.5, 33.5))
    named = [entry.get_text() for entry in used.get_legend().get_texts()]
    assert (named[0], named[1]) == (f"used  {library.n.item()} px", "glint  10 %")
    # what is used keeps its colour, what is left out has that of its flag
    picture = np.asarray(used.images[0].get_array())
    np.testing.assert_allclose(picture[10, 1], np.array([0x4D, 0xE6, 0xCC]) / 255.0)
    np.testing.assert_allclose(picture[15, 2], np.asarray(place.images[0].get_array())[15, 2])
    assert signature.get_ylabel() == "reflectance factor [1]"


def test_the_interval_holds_the_uncertainty_of_the_level(measured: tuple[xr.Dataset, xr.Dataset]) -> None:
    line, library = measured
    shape = library.reflectance.shape
    stated = library.assign(
        reflectance_u_random=(("signature", "band"), np.full(shape, 0.003, np.float32), {"units": "1"}),
        reflectance_u_systematic=(("signature", "band"), np.full(shape, 0.004, np.float32), {"units": "1"}),
        level_uncertainty=("signature", np.float32([0.1])),
    )
    axes = hp.pictures.paint_card(line, stated, "red $roof", width=5.0).axes[-1]
    below, above, centre = (curve.get_ydata() for curve in axes.lines[:3])
    level = library.reflectance.values[0].astype(np.float64)
    np.testing.assert_allclose(centre, level)
    np.testing.assert_allclose(above - below, 2 * 1.96 * np.sqrt(0.005**2 + (0.1 * level) ** 2), rtol=1e-6)


def test_what_has_no_card_is_refused(measured: tuple[xr.Dataset, xr.Dataset]) -> None:
    line, library = measured
    card = hp.pictures.paint_card
    cut = line.isel(cross_track=slice(5, None))
    mapped = library.assign_attrs(coordinates_of_regions="map")
    expect_errors(
        (SchemaError, r"'blue'.*paint-unknown", lambda: card(line, library, "blue")),
        (SchemaError, "library-missing", lambda: card(line, line, "red $roof")),
        (
            SchemaError,
            "region-empty",
            lambda: card(cut, library, "red $roof"),
        ),
        (
            SchemaError,
            "region-coordinates",
            lambda: card(line, mapped, "red $roof"),
        ),
        (
            SchemaError,
            "region-missing",
            lambda: card(line, library.drop_vars("region"), "red $roof"),
        ),
    )
