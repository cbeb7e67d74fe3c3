"""A fleet in its shares, with age and dust, on ground that is worn."""

from collections import Counter

import numpy as np
import pytest
from support.traced_scenes import SUN, flat_light

import hyperpaint as hp
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendered_flight import RenderedFlight
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane
from hyperpaint.simulation.rendering.scene_spectra import (
    COLOUR_SHARES,
    DUST,
    FINISH_SHARES,
    HUE_SHARES,
    WEATHERED,
    dusty,
    fleet_paint,
    is_paint,
    paint_spec,
    spectrum_of,
)

NM = np.arange(400.0, 1001.0, 10.0)
TEN_BANDS = BandSet(np.linspace(430.0, 970.0, 10), np.array(20.0))


def group_of(number: int) -> str:
    colour = fleet_paint(number).colour
    return "coloured" if colour in HUE_SHARES else colour


def test_colours_and_finishes_have_their_shares() -> None:
    cars = range(2000)
    groups = Counter(map(group_of, cars))
    for colour, share in COLOUR_SHARES.items():
        assert abs(groups[colour] / 2000 - share) < 0.005
    finishes = Counter((group_of(car), fleet_paint(car).finish) for car in cars)
    for colour, shares in FINISH_SHARES.items():
        for finish, share in shares.items():
            assert abs(finishes[colour, finish] / groups[colour] - share) < 0.03
    assert 0.5 < sum(fleet_paint(car).flake_share > 0.0 for car in cars) / 2000 < 0.7


@pytest.mark.parametrize("first", [0, 1234, 999_999_900])
def test_a_small_car_park_has_the_shares_too(first: int) -> None:
    groups = Counter(group_of(first + car) for car in range(60))
    for colour, share in COLOUR_SHARES.items():
        assert abs(groups[colour] - 60 * share) < 2.5


def test_paints_look_like_their_colours() -> None:
    levels: dict[str, list[float]] = {}
    for number in range(300):
        levels.setdefault(group_of(number), []).append(
            float(spectrum_of(f"fleet-{number}")(np.array([550.0]))[0])
        )
    assert min(levels["white"]) > 0.45
    assert max(levels["black"]) < 0.15
    assert np.median(levels["black"]) < 0.06
    assert np.median(levels["black"]) < np.median(levels["grey"]) < np.median(levels["silver"]) + 0.2


def test_names_lead_to_paints() -> None:
    spec = paint_spec("fleet-17")
    assert is_paint("fleet-17")
    assert not is_paint("fleet-17:flakes")
    assert (spec.flakes is None) == (spec.finish == "solid")
    assert 1.48 <= spec.coat.index <= 1.55
    np.testing.assert_array_equal(spec.reflectance(NM), spectrum_of("fleet-17")(NM))


def test_dust_is_a_layer_of_two_fluxes() -> None:
    # Adding-doubling of a partial cover: light is sent to and fro between dust and paint
    cover, body = 0.3, np.array([0.02, 0.4, 0.9])
    nm = np.full(3, 600.0)
    through, back = (1.0 - cover), cover * DUST(nm)
    series = sum(through * body * (back * body) ** n * through for n in range(40))
    np.testing.assert_allclose(dusty(body, cover, nm), back + series, rtol=1e-12)


@pytest.mark.parametrize("name", [*WEATHERED, "fleet-3", "fleet-4"])
def test_the_mean_of_a_population_is_its_spectrum(name: str) -> None:
    spectrum = spectrum_of(name)
    members = spectrum.population(NM)
    assert members.shape[0] >= 20
    assert 0.0 <= members.min() <= members.max() <= 1.0
    np.testing.assert_allclose(members.mean(axis=0), spectrum(NM), rtol=1e-12)
    assert (
        (members / members.mean(axis=1, keepdims=True)).std(axis=0) > 1e-4
    ).any()  # spectra differ in shape, not in level alone


def test_a_real_car_park_has_a_fleet_on_worn_ground() -> None:
    park = car_park(length=20.0, fleet="real", neighbours=(), seed=4)
    paints = [one.paint for one in park.instances if one.kind == "car"]
    assert len(set(paints)) == len(paints)
    assert all(paint.startswith("fleet-") for paint in paints)
    spectra = {material.spectrum for material in park.materials}
    assert {"worn_asphalt", "worn_line", "weathered_concrete", "mixed_grass"} <= spectra
    assert "asphalt" not in spectra
    solid = car_park(length=20.0, neighbours=(), seed=4)
    np.testing.assert_array_equal(park.vertices, solid.vertices)
    assert {material.spectrum for material in solid.materials} & {"asphalt", "painted_line"}


@pytest.mark.slow
def test_asphalt_is_rendered_with_texture_that_averages_out() -> None:
    ground = plane(100.0, Material("asphalt", "worn_asphalt", "asphalt"))
    spreads = []
    for ground_sample in (0.01, 0.10, 0.45):
        traced = hp.simulation.trace(
            ground, pushbroom(64, 64, altitude=12.0, ground_sample=ground_sample), [SUN], samples=1, depth=1
        )
        level = traced.paint.relight(TEN_BANDS, atmosphere=flat_light(sky=0.0)).compute().reflectance.values
        spreads.append(float((level.std(axis=(0, 2)) / level.mean(axis=(0, 2))).mean()))
        flat = traced.paint.relight(TEN_BANDS, atmosphere=flat_light(sky=0.0), population=False)
        assert float(flat.reflectance.std(["along_track", "cross_track"]).max()) < 1e-6
    fine, usual, coarse = spreads
    assert 0.10 < fine < 0.35
    assert usual < 0.85 * fine
    assert coarse < usual


@pytest.mark.slow
def test_a_simulated_flight_over_a_real_fleet() -> None:
    settings = {"scene": "rendered", "lines": 24, "columns": 64, "bands": 8, "samples": 2, "fleet": "real"}
    flight = RenderedFlight(hp.simulation.SimulationSettings(**settings))
    assert all(paint.startswith("fleet-") for paint in flight.paints)
    finishes = {flight.paint_properties(paint)["finish"] for paint in flight.paints}
    assert "solid" in finishes
    assert finishes & {"metallic", "pearl"}
    whole = flight.lines(0, 24)
    for start, stop in ((0, 5), (5, 24)):
        np.testing.assert_array_equal(flight.lines(start, stop).counts, whole.counts[start:stop])
