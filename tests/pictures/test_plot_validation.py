"""Pictures of validations show what was compared."""

from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from support.agreeing_spectra import NM, agreeing, field, library, seen
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.pictures import plot
from hyperpaint.pictures.figures import check_picture

mpl.use("Agg")


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


def test_instruments_are_drawn_over_one_another() -> None:
    paints, asd = agreeing()
    nm = np.arange(390.0, 1011.0, 1.5)
    upper, lower = hp.pictures.validation_figure(
        hp.validate(paints, [asd, field(1.01 * seen(nm, 3.5), nm=nm, fwhm=3.5, instrument="SVC")])
    ).axes
    assert (len(upper.lines), len(lower.lines)) == (3, 1 + 2)
    assert len({line.get_linestyle() for line in upper.lines}) == 3


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


def test_any_name_is_drawn(tmp_path: Path) -> None:
    paints = library(seen(NM, 6.0), (("$\\frac{_\x1b" + "x" * 90),))
    hp.pictures.validation_figure(hp.validate(paints, paints), tmp_path / "a.png", limit=0.1)


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
