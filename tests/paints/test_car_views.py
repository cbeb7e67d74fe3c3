"""Views of one car are joined by place, and their change with the angle shows flakes."""

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.paints import join_views

BAND = np.linspace(0.0, 1.0, 30)
RED = 0.05 + 0.4 / (1.0 + np.exp(-12.0 * (BAND - 0.5)))


def views_of(
    angle: list[float], level: list[float], u: float = 0.02, east_m: list[float] | None = None
) -> xr.Dataset:
    # Views of a red paint (view,), its level over the aspecular angle; 5.5 m to the next car by default
    places = np.zeros(len(angle)) if east_m is None else np.asarray(east_m)
    spectra = np.float32(np.outer(level, RED / RED.mean()))
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), spectra, {"units": "1"}),
            "aspecular_angle": ("signature", np.asarray(angle, float), {"units": "degree"}),
        },
        {
            "signature": [f"red-{number:02}" for number in range(len(angle))],
            "latitude": ("signature", np.full(len(angle), 48.0)),
            "longitude": ("signature", 11.0 + places / (111_195.0 * np.cos(np.radians(48.0)))),
            "level_uncertainty": ("signature", np.full(len(angle), u)),
        },
    )


def test_places__join_views_and_part_neighbours() -> None:
    """Expected: views 1 m apart are one car; the next bay, 2.5 m on, is another; no place, a car alone."""
    views = views_of([20.0] * 4, [0.3] * 4, east_m=[0.0, 1.0, 2.5, 0.5])
    views["latitude"][3] = np.nan
    joined = join_views(views)
    assert joined.views.values.tolist() == [2, 2, 1, 1]
    assert joined.car.values.tolist() == ["red-00", "red-00", "red-02", "red-03"]
    assert join_views(views, distance=0.5).views.values.tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("change", "u", "finish"),
    [(-0.013, 0.02, "metallic"), (-0.035, 0.05, "metallic"), (0.0, 0.02, "solid"), (0.0, 0.10, "unknown")],
    ids=["flop index 5", "flop index 17", "solid", "too uncertain"],
)
def test_finish__follows_from_the_change_with_the_angle(change: float, u: float, finish: str) -> None:
    """Rationale: flakes darken by 1.3 to 3.5 % a degree away from the mirrored sun, solid paint does not."""
    angle = np.array([20.0, 35.0, 50.0])
    joined = join_views(views_of(angle.tolist(), np.exp(change * (angle - 35.0)).tolist(), u))
    assert set(joined.finish.values) == {finish}
    np.testing.assert_allclose(joined.level_change, change, atol=1e-6)
    np.testing.assert_allclose(joined.level_change_u, u / np.sqrt(450.0), rtol=1e-6)


def test_lean__cancels_between_views() -> None:
    """Expected: a car leans alike in all views, and its slope is uncertain by the other causes alone."""
    views = views_of([20.0, 50.0], [0.35, 0.30], 0.05)
    terms = '{"noise and dust": 0.01, "an unknown lean of 0.9 degrees": 0.049}'
    joined = join_views(views.assign_coords(level_terms=("signature", [terms, terms])))
    np.testing.assert_allclose(joined.level_change_u, 0.01 * np.sqrt(2.0) / 30.0, rtol=1e-6)
    assert set(joined.finish.values) == {"metallic"}


def test_angles_too_near__decide_nothing() -> None:
    joined = join_views(views_of([30.0, 36.0], [0.3, 0.2]))
    assert set(joined.finish.values) == {"unknown"}
    assert np.isnan(joined.level_change).all()


def test_stray_view__is_voted_out() -> None:
    """Expected: a view of another colour decides neither on the finish nor is it the best."""
    views = views_of([20.0, 35.0, 50.0, 65.0], [0.3] * 4)
    views["reflectance"][1] += 0.1
    joined = join_views(views)
    assert joined.is_stray.values.tolist() == [False, True, False, False]
    assert set(joined.finish.values) == {"solid"}
    assert not joined.is_best[1]


def test_best_view__has_least_mirrored_light() -> None:
    """Expected: of alike views the lowest; of flakes the surest."""
    assert join_views(views_of([30.0, 31.0, 32.0], [0.31, 0.30, 0.33])).is_best.values.tolist() == [
        False, True, False,
    ]  # fmt: skip
    flakes = views_of([20.0, 60.0], [0.5, 0.2])
    flakes["level_uncertainty"][0] = 0.01
    joined = join_views(flakes)
    assert joined.is_best.values.tolist() == [True, False]
    assert joined.isel(signature=joined.is_best).sizes["signature"] == 1


def test_missing_values__decide_nothing() -> None:
    """Expected: a view without values or without an angle is joined, and the others decide as without it."""
    views = views_of([20.0, 35.0, 50.0, 50.0, np.nan], [0.3] * 5)
    views["reflectance"][2] = np.nan
    joined = join_views(views)
    assert joined.views.values.tolist() == [5] * 5
    assert set(joined.finish.values) == {"solid"}
    assert joined.is_best.sum() == 1
    assert not joined.is_best[2]
    assert join_views(views.isel(signature=[2])).is_best.all()
    assert join_views(views.isel(signature=[])).sizes["signature"] == 0


def test_wrong_distance__is_refused() -> None:
    with pytest.raises(SchemaError) as caught:
        join_views(views_of([20.0], [0.3]), distance=0.0)
    assert caught.value.codes == ("value-out-of-range",)
