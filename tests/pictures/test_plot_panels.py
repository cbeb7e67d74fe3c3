"""The picture of panels shows what they measured."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from support.laid_panels import Laid, flown_over
from support.refusals import expect_errors
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.report.store_report import line_section

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


def test_a_report_has_a_part_for_panels() -> None:
    line = flight(flat=True).line
    scaled = hp.reflectance(line, panel=hp.Panel(slice(3, 8), slice(1, 4), 0.4)).compute()
    assert "Panels" in dict(line_section(scaled, lines=20))["panels"]()
    assert "panels" not in dict(line_section(hp.reflectance(line), lines=20))
