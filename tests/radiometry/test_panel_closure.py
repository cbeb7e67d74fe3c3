"""Panels that are not what they are taken for; the truth is the simulator's, with faults laid by hand."""

import warnings
from typing import Any

import numpy as np
import pytest
from support.laid_panels import Laid, flown_over
from support.strategies import START, flight

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.radiometry import panel_closure
from hyperpaint.radiometry.panels import PANEL_STATES, PanelContext, judge_panels

SEED = 7301


def closure_of(laid: Laid, **effects: Any) -> Any:
    # Return the closure, what was noticed, and what was said
    line = flown_over(laid, seed=effects.pop("seed", SEED), **effects)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        closure = panel_closure(line, laid.panel).compute()
    state = int(closure.panel_state.values[0])
    names = {name for bit, name in enumerate(PANEL_STATES) if state >> bit & 1}
    return closure, names, " ".join(str(each.message) for each in said)


def bias(laid: Laid, right: Laid, **effects: Any) -> float:
    # Return the largest departure of a panel's factor from that of one without its fault, each its own
    factors = []
    for each, own in ((laid, effects), (right, {k: v for k, v in effects.items() if k != "saturated"})):
        is_panel = ~(each.first(each.shaded) | each.first(each.asphalt))
        factors.append(closure_of(each, **own)[0].panel_factor.values[0] / each.pattern[is_panel].mean())
    return float(np.abs(factors[0] / factors[1] - 1.0).max())


@pytest.mark.parametrize(
    "seed", [*range(2), *(pytest.param(s, marks=pytest.mark.slow) for s in range(2, 20))]
)
def test_right_panels_raise_no_alarm(seed: int) -> None:
    rng = np.random.default_rng([SEED, seed])
    size = int(rng.choice([5, 8, 14, 20]))
    grey, texture = float(rng.choice([0.1, 0.5, 0.8])), float(rng.choice([0.0, 0.01, 0.02]))
    laid = Laid((6, 6 + size), (4, 4 + size), seed, reflectance=grey, texture=texture)
    sun = float(rng.uniform(25.0, 65.0))
    closure, names, said = closure_of(laid, seed=seed + SEED, sun_zenith=sun, irradiance_noise=0.002)
    assert (names, said, float(closure.panel_used.min())) == (set(), "", 1.0)
    np.testing.assert_allclose(np.median(closure.panel_factor) / laid.pattern.mean(), 1.0, atol=2e-3)


@pytest.mark.parametrize("slope", [0.0, 0.15])
@pytest.mark.parametrize("share", [0.02, 0.2, 0.4])
def test_a_partly_saturated_panel_is_noticed_and_right(share: float, slope: float) -> None:
    laid = Laid(slope=slope)
    _, names, said = closure_of(laid, saturated=share)
    assert names == {"saturated"}
    assert "% of its pixels are saturated, in" in said
    assert bias(laid, laid, saturated=share) < 2e-3


def test_a_band_that_is_mostly_saturated_is_refused() -> None:
    laid = Laid()
    closure, names, said = closure_of(laid, saturated=0.95)
    assert names == {"saturated"}
    lost = np.isnan(closure.panel_factor.values[0])
    assert 0 < lost.sum() < lost.size / 2
    assert f"and {lost.sum()} bands are refused" in said
    line = flown_over(laid, seed=SEED, saturated=0.95)
    with pytest.warns(PaintWarning, match=r"bands .*panel-doubtful"):
        scaled = hp.reflectance(line, panel=laid.panel).reflectance.values
    assert np.isnan(scaled[:, lost]).all()


@pytest.mark.parametrize("fault", [{"shaded": 0.05}, {"shaded": 0.01}, {"shaded": 0.4}, {"asphalt": 0.05}])
def test_what_is_no_sunlit_panel_is_noticed_and_left_out(fault: dict[str, float]) -> None:
    laid = Laid(**fault)
    _, names, said = closure_of(laid)
    assert names == {"partly_other"}
    assert "are shaded or show something else" in said
    assert bias(laid, Laid()) < 2e-3


def test_a_panel_of_which_half_is_in_shade_is_refused() -> None:
    # Which half is the panel, nothing tells
    _, names, said = closure_of(Laid(shaded=0.5))
    assert ("refused" in names, "uneven" in said) == (True, True)
    line = flown_over(Laid(shaded=0.5), seed=SEED)
    with pytest.warns(PaintWarning), pytest.raises(SchemaError, match="panel-refused"):
        hp.reflectance(line, panel=Laid(shaded=0.5).panel).compute()


@pytest.mark.parametrize("towards", [178.0, 358.0, 223.0])
@pytest.mark.parametrize("sun_zenith", [25.0, 50.0])
def test_a_panel_that_leans_is_refused(sun_zenith: float, towards: float) -> None:
    laid = Laid(lean=(5.0, towards))
    closure, names, _ = closure_of(laid, sun_zenith=sun_zenith)
    assert names == {"leaning", "refused"}
    assert np.isfinite(closure.panel_factor).all()  # judged, whatever is refused
    line = flown_over(laid, seed=SEED, sun_zenith=sun_zenith)
    with pytest.warns(PaintWarning, match="tilted"), pytest.raises(SchemaError, match="panel-refused"):
        hp.reflectance(line, panel=laid.panel).compute()


def test_a_panel_of_a_known_attitude_is_as_good_as_a_level_one() -> None:
    laid = Laid(lean=(5.0, 178.0))
    line, place = flown_over(laid, seed=SEED), (laid.along, laid.across, laid.reflectance)
    factor = panel_closure(line, hp.Panel(*place, tilt=(5.0, 178.0))).panel_factor.values[0]
    level = closure_of(Laid())[0].panel_factor.values[0]
    np.testing.assert_allclose(factor / level, 1.0, atol=5e-3)  # the simulated sky is even
    # a panel may be declared to be off
    with pytest.warns(PaintWarning, match="tilted"):
        scaled = hp.reflectance(line, panel=hp.Panel(*place, uncertainty=0.03)).compute()
    assert int(scaled.panel_state[0]) == 1 << PANEL_STATES.index("leaning")


def test_a_panel_that_does_not_close_is_applied_and_said() -> None:
    laid = Laid(level=0.85)
    line = flown_over(laid, seed=SEED)
    with pytest.warns(PaintWarning, match=r"median 0\.850.*panel-doubtful"):
        scaled = hp.reflectance(line, panel=laid.panel).compute()
    expected = hp.reflectance(line).reflectance.values / scaled.panel_factor.values[0][:, None]
    np.testing.assert_allclose(scaled.reflectance.values, expected, rtol=1e-6)
    u = scaled.panel_factor_u.values[0] / scaled.panel_factor.values[0]
    np.testing.assert_allclose(u, np.hypot(0.03, 0.05), rtol=0.01)
    # uncertainties of the line judge a panel that is nearer
    line = flown_over(Laid(level=0.97), seed=SEED)
    for name, u in (("radiance_gain_u_systematic", 0.01), ("irradiance_u_systematic", 0.005)):
        line[name] = ((), np.float32(u), {"units": "1"})
    with pytest.warns(PaintWarning, match=r"uncertainty of 0\.011"):
        panel_closure(line, Laid().panel).compute()


def test_pixels_that_differ_are_said_and_count_in_the_uncertainty() -> None:
    laid = Laid((6, 9), (4, 7), texture=0.08)
    line = flown_over(laid, seed=SEED)
    line["read_noise"] = ((), np.float32(2.0), {"units": "count"})
    line["electrons_per_count"] = ((), np.float32(5.0), {"units": "electron count-1"})
    with pytest.warns(PaintWarning, match=r"uneven.*panel-doubtful"):
        scaled = hp.reflectance(line, panel=laid.panel, uncertainty=True).compute()
    assert 0.01 < float(scaled.panel_scale_u[0]) < 0.05
    relative = scaled.reflectance_u_systematic / scaled.reflectance
    assert float(relative.median()) >= float(scaled.panel_scale_u[0]) * 0.999


def test_bad_elements_are_not_taken_for_saturated_and_others_are_no_panels() -> None:
    line = flight(flat=True).line
    for wrong in ([], "white", [0.5]):
        with pytest.raises(SchemaError, match="type-wrong"):
            hp.reflectance(line, panel=wrong)
    line["radiance_gain"].values[2, 2] = np.nan
    scaled = hp.reflectance(line, panel=hp.Panel(slice(3, 8), slice(1, 4), 0.4)).compute()
    # another reflectance forgets the panel
    assert not [name for name in hp.reflectance(scaled).variables if str(name).startswith("panel_")]
    assert int(scaled.panel_state[0]) == 0
    np.testing.assert_allclose(scaled.panel_used.values[0, 2], 2 / 3, rtol=1e-6)
    np.testing.assert_allclose(scaled.panel_factor, 1.0, rtol=1e-5)


def test_of_radiance_the_brightest_samples_are_the_limit() -> None:
    laid = Laid(slope=0.15)
    line = flown_over(laid, seed=SEED, saturated=0.2)
    of_counts = closure_of(laid, saturated=0.2)[0].panel_factor.values
    radiance = hp.radiance(line).drop_vars("counts").compute()
    with pytest.warns(PaintWarning, match="saturated"):
        factor = panel_closure(radiance, laid.panel).panel_factor.values
    np.testing.assert_allclose(factor, of_counts, rtol=2e-3)


def judged(
    pattern: Any, spectrum: Any = 1.0, u: float = 0.0, saturated: float = 0.0, share: Any = None
) -> set[str]:
    # Return the faults of a panel of 0.5 with a pattern of its pixels, in twenty bands
    observed = 0.5 * pattern[:, None, :] * np.broadcast_to(spectrum, 20)[:, None]
    ceiling = np.full(observed.shape, np.quantile(observed[:, 0], 1.0 - saturated) if saturated else 2.0)
    ceiling[:, 5:] = 2.0
    observed[observed > ceiling] = np.nan
    panel = {
        "observed": observed, "ceiling": ceiling, "reflectance": np.full(20, 0.5), "uncertainty": u,
        "name": "the panel", "time": START, "direct_share": share,
    }  # fmt: skip
    context = PanelContext(np.linspace(450.0, 950.0, 20), np.ones(20, bool), np.full(20, 0.0583), True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        closure = judge_panels((panel,), context)
    faults = {name for bit, name in enumerate(PANEL_STATES) if int(closure.state[0]) >> bit & 1}
    return faults | ({"bands lost"} if np.isnan(closure.factor).any() else set())


def test_every_rule_of_panels_counts() -> None:
    # pairs of panels around each threshold, so that twice and half of it change a verdict
    normal, rising = np.random.default_rng(1).standard_normal((14, 14)), np.linspace(0.6, 0.9, 20)
    even, textured = 1.0 + 1e-3 * normal, 1.0 + 0.01 * normal
    teeth = np.sign(np.sin(2.1 * np.arange(20)))

    def other(count: int, by: float, spread: float = 0.01) -> Any:
        pattern = 1.0 + spread * normal
        pattern.ravel()[:count] = 1.0 + by
        return pattern

    def sloping(by: float) -> Any:
        return np.repeat(1.0 + by * np.linspace(-1.0, 1.0, 14)[:, None], 14, 1)

    def leaning(by: float, share: Any = rising, **options: Any) -> set[str]:
        return judged(even, 1.0 + by * share + options.pop("teeth", 0.0), share=share[None], **options)

    bright_bands = [np.where(np.arange(20) < count, 1.3, 1.0) for count in (1, 3)]
    verdicts = {
        "outlier_sd": (judged(other(4, 0.045)), judged(other(4, 0.09))),
        "least_departure": (judged(other(4, 0.014, 1e-4)), judged(other(4, 0.03, 1e-4))),
        "noticed_share": (judged(other(1, 0.5)), judged(other(3, 0.5))),
        "most_error": (judged(sloping(0.16)), judged(sloping(0.3))),
        "refused_error": (judged(sloping(0.4)), judged(sloping(0.7))),
        "least_lean": (leaning(0.0095), leaning(0.02)),
        "lean_misfit": (leaning(0.06, teeth=0.0035 * teeth), leaning(0.06, teeth=0.0016 * teeth)),
        "least_contrast": (leaning(0.2, 0.6 + rising / 5.0), leaning(0.2, 0.6 + rising / 2.5)),
        "coverage": (leaning(0.03, u=0.015), leaning(0.06, u=0.015)),
        "off_bands": tuple(judged(even, bands) for bands in bright_bands),
        "most_saturated": (judged(textured, saturated=0.3), judged(textured, saturated=0.7)),
    }
    right: set[str] = set()
    assert verdicts == {
        "outlier_sd": (right, {"partly_other"}),
        "least_departure": (right, {"partly_other"}),
        "noticed_share": (right, {"partly_other"}),
        "most_error": (right, {"uneven"}),
        "refused_error": ({"uneven"}, {"uneven", "refused"}),
        "least_lean": (right, {"leaning", "refused"}),
        "lean_misfit": (right, {"leaning", "refused"}),
        "least_contrast": ({"off_level"}, {"leaning", "refused", "off_level"}),
        "coverage": ({"leaning"}, {"leaning", "refused"}),
        "off_bands": (right, {"off_level"}),
        "most_saturated": ({"saturated"}, {"saturated", "bands lost"}),
    }
