"""The card of a paint: its place, what was left out of it, and the interval of its signature."""

from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import NM, agreeing, field, library, seen
from support.laid_panels import Laid, flown_over
from support.refusals import expect_errors
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.pictures import plot
from hyperpaint.pictures.figures import check_picture
from hyperpaint.report.store_report import line_section

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
        level_uncertainty=("signature", np.float32([0.1]), {"units": "1"}),
        reflectance_u_coat=0.05 * library.reflectance,
        level_terms=("signature", ['{"noise and dust": 0.008, "an unknown lean": 0.0997, "haze": 0.001}']),
    )
    text, *_, axes = hp.pictures.paint_card(line, stated, "red $roof", width=5.0).axes
    causes = "an unknown lean 10.0%, the coat and the sky that it mirrors 5.0%, noise and dust 0.8%"
    assert causes in " ".join(text.texts[0].get_text().split("\n"))
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


# --- the picture of panels shows what they measured ---------------------------------------------------------


mpl.use("Agg")


def test_curves_are_the_factors(tmp_path: Path) -> None:
    faulty, right = Laid((4, 16), level=0.85), Laid((20, 32))
    line = flown_over(faulty, right, seed=31, lines=36, bands=20)
    with pytest.warns(PaintWarning, match="measures"):
        closure = hp.radiometry.panel_closure(line, [faulty.panel, right.panel]).compute()
    figure = hp.pictures.panel_figure(closure, tmp_path / "panels.png")
    assert (tmp_path / "panels.png").stat().st_size > 5000
    (axes,) = figure.axes
    for drawn, factor in zip(axes.lines[1:], closure.panel_factor.values, strict=True):
        np.testing.assert_array_equal(drawn.get_ydata(), factor)
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert texts[0].endswith(": off level")
    assert texts[1].endswith(": as expected")
    expect_errors((SchemaError, "variable-missing", lambda: hp.pictures.panel_figure(flight().line)))
    # a report has a part for panels
    white = flight(flat=True).line
    scaled = hp.reflectance(white, panel=hp.Panel(slice(3, 8), slice(1, 4), 0.4)).compute()
    assert "Panels" in dict(line_section(scaled, lines=20))["panels"]()
    assert "panels" not in dict(line_section(hp.reflectance(white), lines=20))


# --- pictures of validations show what was compared ---------------------------------------------------------


def test_curves_are_the_spectra() -> None:
    nm = np.arange(500.0, 901.0)
    found = hp.validate(
        library(seen(NM, 6.0), reflectance_sd=np.full(NM.size, 0.01)), field(0.97 * seen(nm, 3.0), nm=nm)
    )
    upper, lower = hp.pictures.validation_figure(found).axes
    spectra = found.spectra[0]
    used = spectra["used"].values
    for line, name in zip(upper.lines, ("signature", "reference"), strict=True):
        drawn = np.asarray(line.get_ydata())
        np.testing.assert_array_equal(drawn[used], spectra[name].values[used])
        assert np.isnan(drawn[~used]).all()
    np.testing.assert_array_equal(
        np.asarray(lower.lines[1].get_ydata())[used], spectra["difference"].values[used]
    )
    assert len(upper.collections) == 1  # the spread of the pixels
    assert upper.get_title(loc="left") == "hood"
    texts = " ".join(" ".join(text.get_text().split()) for text in lower.get_legend().get_texts())
    rmse, limit = (float(found.statistics[name].sel(part="all").item()) for name in ("rmse", "rmse_limit"))
    assert f"reference (ASD): RMSE {rmse:.4f} of {limit:.4f}" in texts
    low, high = lower.get_ylim()
    assert low == -high
    assert high >= float(np.abs(spectra["difference"]).max())


def test_instruments_are_drawn_over_one_another(tmp_path: Path) -> None:
    paints, asd = agreeing()
    nm = np.arange(390.0, 1011.0, 1.5)
    upper, lower = hp.pictures.validation_figure(
        hp.validate(paints, [asd, field(1.01 * seen(nm, 3.5), nm=nm, fwhm=3.5, instrument="SVC")])
    ).axes
    assert (len(upper.lines), len(lower.lines)) == (3, 1 + 2)
    assert len({line.get_linestyle() for line in upper.lines}) == 3
    # any name is drawn
    odd = library(seen(NM, 6.0), (("$\\frac{_\x1b" + "x" * 90),))
    hp.pictures.validation_figure(hp.validate(odd, odd), tmp_path / "a.png", limit=0.1)


def test_the_worst_of_many_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert plot.MAX_PAIRS == 24
    monkeypatch.setattr(plot, "MAX_PAIRS", 4)
    count = 7
    names = [f"paint {n}" for n in range(count)]
    paints = library(np.outer(np.linspace(0.9, 1.0, count), seen(NM, 6.0)), names)
    references = library(np.outer(np.ones(count), seen(NM, 6.0)), names)
    figure = hp.pictures.validation_figure(hp.validate(paints, references), tmp_path / "many.png", columns=6)
    titles = [axes.get_title(loc="left") for axes in figure.axes[::2]]
    assert titles == [*(f"FAIL  {name}" for name in names[:3]), names[3]]  # 5 % of the level pass
    assert f"the 4 worst of {count} shown" in figure.get_suptitle()
    assert (tmp_path / "many.png").stat().st_size > 10_000


def test_sizes_and_places_are_refused_before_any_work(tmp_path: Path) -> None:
    draw = partial(hp.pictures.validation_figure, hp.validate(*agreeing()))
    check_picture(tmp_path / "a.PNG")
    expect_errors(
        *(
            (SchemaError, "value-out-of-range", partial(draw, **{name: wrong}))
            for name, wrong in (("columns", 0), ("limit", 0.0), ("limit", float("nan")))
        ),
        (SchemaError, "suffix-unknown", lambda: check_picture(tmp_path / "a.nope")),
        (SchemaError, "suffix-unknown", lambda: check_picture(tmp_path / "a")),
        (SchemaError, "folder-missing", lambda: check_picture(tmp_path / "none/a.png")),
    )
