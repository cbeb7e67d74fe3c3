"""What cannot be relit, and how that is said."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import refusal
from support.traced_scenes import (
    FEW_BANDS,
    LOW_SUN,
    SUN,
    flat_light,
    flight,
    line_light,
    two_cars,
)

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.materials import Material
from hyperpaint.simulation.rendering.scene import plane

SAMPLES = {"samples": 8, "seed": 3, "overcast": True}
MANY_BANDS = BandSet(np.linspace(399.356, 1001.42, 68), np.array(6.0))


def tracing(scene: Any = None, **more: Any) -> xr.Dataset:
    return hp.simulation.trace(scene or two_cars(), flight(), [SUN, LOW_SUN], **{**SAMPLES, **more})


@pytest.fixture(scope="module")
def traced() -> xr.Dataset:
    return tracing().compute()


def test_a_sun_that_was_not_traced(traced: xr.Dataset) -> None:
    with pytest.raises(SchemaError, match="sun-not-traced"):
        traced.paint.relight(atmosphere=flat_light(direction=(40.02, 150.0)))
    traced.paint.relight(atmosphere=flat_light(direction=(40.009, 150.0)))
    traced.paint.relight(atmosphere=flat_light(0.0, direction=(10.0, 0.0)))  # no sun, no direction
    with pytest.raises(SchemaError, match="sky-not-traced"):
        hp.simulation.trace(two_cars(), flight(), [SUN]).paint.relight(
            atmosphere=flat_light(overcast_share=0.5)
        )


def test_paints_that_cannot_be_are_all_named(traced: xr.Dataset) -> None:
    nm = np.array([380.0, 1050.0])
    with pytest.raises(SchemaError) as caught:
        traced.paint.relight(
            paints={
                "car_9": "red",
                "car_0": (nm, np.array([0.5, 1.2])),
                "car_1": (np.array([450.0, 1050.0]), np.array([0.5, 0.5])),
                "brick": "no such spectrum",
                "asphalt": (nm, np.array([-0.1, np.nan])),
            },
            atmosphere=line_light(),
        )
    message = str(caught.value)
    for found in (
        "paints['car_9']",
        "'car_0' ranges from 0.5 to 1.2",
        "'car_1' covers 450.0 to 1050.0 nm",
        "'no such spectrum'",
        "'asphalt' is not finite",
    ):
        assert found in message
    assert message.count("\n") == 5


def test_reflectances_may_be_clipped(traced: xr.Dataset) -> None:
    nm = np.array([380.0, 1050.0])
    high, limited = (nm, np.array([1.3, -0.2])), (nm, np.array([1.3, -0.2]))
    with pytest.raises(SchemaError, match="value-out-of-range"):
        traced.paint.relight(FEW_BANDS, paints={"asphalt": high}, atmosphere=line_light())
    made = traced.paint.relight(FEW_BANDS, paints={"asphalt": high}, atmosphere=line_light(), clip=True)
    by_hand = lambda grid: np.interp(grid, *limited).clip(0.0, 1.0)  # noqa: E731
    other = traced.paint.relight(FEW_BANDS, paints={"asphalt": by_hand}, atmosphere=line_light())
    xr.testing.assert_allclose(made.radiance, other.radiance, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ({"variation": np.ones((24, 2))}, "dims-wrong"),
        ({"variation": -np.ones((2, 24))}, "variation.*value-out-of-range"),
        (
            {"bands": BandSet(np.array([500.0]), np.array(6.0), "gaussian", np.zeros(3) + 0.1)},
            "3 columns.*length-mismatch",
        ),
        (
            {"bands": BandSet(np.array([500.0, 1200.0]), np.array(6.0))},
            "atmosphere-coverage",
        ),
        ({"atmosphere": "midnight"}, "choice-unknown"),
        ({"atmosphere": 3}, "atmosphere.*type-wrong"),
        ({"spectra": [1, 2]}, "spectra.*type-wrong"),
        ({"paints": {"car_0": "red", "nothing": "red"}}, "'nothing'"),
    ],
)
def test_arguments_that_cannot_be(traced: xr.Dataset, arguments: dict[str, Any], found: str) -> None:
    with pytest.raises(SchemaError, match=found):
        hp.simulation.relight(traced, **{"atmosphere": flat_light(), **arguments})


def test_an_untraced_dataset() -> None:
    with pytest.raises(SchemaError, match="metadata-missing"):
        xr.Dataset().paint.relight()
    made = tracing()
    with pytest.raises(SchemaError, match="transport_path"):
        made.drop_vars("transport_path").paint.relight()


def test_an_instance_of_many_materials_has_no_one_paint() -> None:
    stripes = [Material(f"stripe {n}", "panel_20", "panel") for n in range(2)]
    scene = plane(4.0, stripes[0], instance="chart")
    other = plane(4.0, stripes[1], centre=(4.0, 0, 0), instance="other")
    joined = type(scene).join([scene, other])
    both = dataclasses.replace(joined, face_instance=np.zeros_like(joined.face_instance))
    with pytest.raises(SchemaError, match="paint-target-ambiguous"):
        hp.simulation.trace(both, flight(1, 1), [SUN]).paint.relight(
            paints={"chart": "red"}, atmosphere=flat_light()
        )
    shared = dataclasses.replace(joined, face_material=np.zeros_like(joined.face_material))
    with refusal(SchemaError, "paint-target-shared", "'other'"):
        hp.simulation.trace(shared, flight(1, 1), [SUN]).paint.relight(
            paints={"chart": "red"}, atmosphere=flat_light()
        )
