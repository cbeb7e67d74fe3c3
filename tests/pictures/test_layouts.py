"""Nothing is cut off and nothing overlaps: as wide as a screen and as 400 pixels, in light and dark."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import agreeing, field, seen
from support.flown_lines import fly, located
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint import pictures
from hyperpaint.simulation import simulate_line, simulate_sweep

pytest.importorskip("matplotlib")

from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

NARROW = 400 / 110  # [inch]
PLACES = [(3, 4), (20, 9)]
Draw = Callable[[Any], Any]


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    return simulate_line(lines=48, columns=24, bands=40).paint.reflectance().compute()


@pytest.fixture(scope="module")
def paints(line: xr.Dataset) -> xr.Dataset:
    corners = [(0, 0), (9, 0), (9, 9), (0, 9)]
    regions = [hp.Region(f"paint {n}", [(x, y + 10 * n) for x, y in corners]) for n in range(4)]
    return hp.extract_signatures(line, hp.Regions(tuple(regions)), exclude=0)


@pytest.fixture(scope="module")
def agreement() -> hp.validation.Validation:
    signatures, asd = agreeing()
    nm = np.arange(390.0, 1011.0, 1.5)
    return hp.validate(signatures, [asd, field(1.01 * seen(nm, 3.5), nm=nm, fwhm=3.5, instrument="SVC")])


@pytest.fixture(scope="module")
def calibration() -> xr.Dataset:
    return hp.calibrate(simulate_sweep(steps=31, bands=136, columns=6, nonuniformity=0))


@pytest.fixture
def draw(
    request: pytest.FixtureRequest,
    line: xr.Dataset,
    paints: xr.Dataset,
    agreement: Any,
    calibration: xr.Dataset,
) -> Draw:
    # Return what draws one picture in a width [inch], None for that of a screen
    def own(width: float | None) -> dict[str, float]:
        return {} if width is None else {"width": width}

    region = hp.Region("a roof", [(0, 0), (9, 0), (9, 9), (0, 9)])
    drawers: dict[str, Draw] = {
        "quicklook": lambda width: pictures.quicklook(line, **own(width)),
        "triptych": lambda width: pictures.triptych(line, region, exclude=0, **own(width)),
        "pixels": lambda width: pictures.triptych(line, pixels=PLACES, **own(width)),
        "flags": lambda width: pictures.flag_overlay(line, **own(width)),
        "layer": lambda width: pictures.flag_overlay(line, layer="surface", **own(width)),
        "spectra": lambda width: pictures.spectrum(paints, **own(width)),
        "spectra of pixels": lambda width: pictures.spectrum(line, pixels=PLACES, **own(width)),
        "library": lambda width: pictures.library_overview(paints, columns=1 if width else 4),
        "validation": lambda width: pictures.validation_figure(agreement, columns=1 if width else 3),
        "calibration": lambda width: pictures.calibration_report(calibration, **own(width)),
    }
    return drawers[request.param]


@pytest.mark.slow
# the layout is that of every theme, and the ink that of every width
@pytest.mark.parametrize(("width", "theme"), [(None, "default"), (NARROW, "dark_background")])
@pytest.mark.parametrize(
    "draw",
    ["quicklook", "triptych", "pixels", "flags", "layer", "spectra", "spectra of pixels", "library",
     "validation", "calibration"],
    indirect=True,
)  # fmt: skip
def test_all_is_inside_and_apart(draw: Draw, width: float | None, theme: str) -> None:
    # Expected: every text and axis inside of the figure; no axes over another; text seen on its ground
    with pyplot.style.context(theme):
        drawn = draw(width)
        figure = drawn if hasattr(drawn, "savefig") else drawn.figure
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer = canvas.get_renderer()
        size = figure.get_size_inches()
        box = figure.get_tightbbox(renderer)
        assert box.x0 > -0.03, "cut off on the left"
        assert box.y0 > -0.03, "cut off below"
        assert box.x1 < size[0] + 0.03, "cut off on the right"
        assert box.y1 < size[1] + 0.03, "cut off above"
        for one, other in itertools.combinations(
            [axes.get_window_extent(renderer) for axes in figure.axes if axes.axison], 2
        ):
            overlap = one.intersection(one, other)
            assert overlap is None or min(overlap.width, overlap.height) < 1.0
            assert min(one.width, one.height) > 10.0
        ground = np.mean(figure.get_facecolor()[:3])
        for axes in figure.axes:
            for curve in axes.lines:
                rim = [effect for effect in curve.get_path_effects() if hasattr(effect, "_gc")]
                assert rim or np.abs(np.array(to_rgb(curve.get_color())) - ground).max() > 0.25
    pyplot.close("all")


@pytest.mark.parametrize("width", [8.0, NARROW])
def test_before_and_after_straightening(width: float) -> None:
    # Expected: the line upright with all its lines, beside it the map, north up, in metres
    flown = fly(60, 30, "calm")
    values = np.random.default_rng(0).uniform(0.1, 0.6, (60, 4, 30)).astype("f4")
    line = located(
        flown,
        reflectance=xr.DataArray(values, dims=("along_track", "band", "cross_track"), attrs={"units": "1"}),
    ).assign_coords(wavelength=("band", [450.0, 550.0, 650.0, 900.0], {"units": "nm"}))
    # a saturated pixel without values is a white glint in both pictures
    line["quality"] = xr.zeros_like(line.reflectance.isel(band=0), dtype="u4")
    line["quality"][30, 15], line["reflectance"][30, :, 15] = hp.Quality.SATURATED, np.nan
    figure = pictures.straightening(line, width=width)
    raw, straight = figure.axes
    assert raw.images[0].get_array()[30, 15].min() > 0.99
    assert (straight.images[0].get_array().min(axis=-1) > 0.99).any()
    assert raw.images[0].get_array().shape == (60, 30, 3)
    left, right, *vertical = straight.images[0].get_extent()
    assert left < flown.east.mean() < right
    assert min(vertical) < flown.north.mean() < max(vertical)
    assert [axes.get_title() for axes in figure.axes] == ["as recorded", "straightened"]
    assert straight.get_ylabel() == "north, up [m]"
    expect_error(
        hp.SchemaError, "line-not-located", lambda: pictures.straightening(line.drop_vars(["east", "north"]))
    )
