"""The collage of chips and renders."""

from pathlib import Path

import numpy as np
import pytest
from support.refusals import expect_error
from support.traced_scenes import SUN, flat_light, flight, two_cars

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.paints import starter_library
from hyperpaint.pictures import chips_and_renders

pytestmark = pytest.mark.slow  # the tracer is compiled


def test_chips_stand_above_the_renders(tmp_path: Path) -> None:
    paints = starter_library(members=6).isel(signature=slice(0, 5))
    traced = hp.simulation.trace(two_cars(), flight(), [SUN], samples=2).compute()
    line = traced.paint.relight(paints=paints, atmosphere=flat_light())
    figure = chips_and_renders(paints, {"noon": line, "again": line}, tmp_path / "x.png", columns=3)
    assert (tmp_path / "x.png").stat().st_size > 10_000
    above, below = figure.subfigs
    assert above.axes[0].get_title() == "Synthetic Polar White"
    assert [axes.get_title() for axes in below.axes] == ["noon", "again"]
    chip = np.asarray(above.axes[0].images[0].get_array())
    assert len(np.unique(chip.reshape(-1, 3), axis=0)) == 6  # members
    plain = chips_and_renders(paints.drop_vars("member_reflectance"), line)
    chip = np.asarray(plain.subfigs[0].axes[0].images[0].get_array())
    assert len(np.unique(chip.reshape(-1, 3), axis=0)) == 1


def test_what_makes_no_collage_is_refused() -> None:
    paints = starter_library(members=0).isel(signature=slice(0, 3))
    expect_error(SchemaError, "empty-input", lambda: chips_and_renders(paints, {}))
