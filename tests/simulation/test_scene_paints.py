"""Paints of scenes: pigments, the fleet and its populations, and pearl."""

import subprocess
import sys
from collections import Counter
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from support.traced_scenes import FEW_BANDS, SUN, flat_light, two_cars

import hyperpaint as hp
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.flight import RenderedFlight
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material, base_albedo
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane
from hyperpaint.simulation.rendering.scene_spectra import (
    CAR_PAINTS,
    COLOUR_SHARES,
    DUST,
    FAMILIES,
    FINISH_SHARES,
    FINISHES,
    FOURTEEN,
    HUE_SHARES,
    MATERIALS,
    SPECTRA,
    WEATHERED,
    Pigments,
    aluminium,
    dusty,
    fleet_names,
    fleet_paint,
    generate_paint,
    is_paint,
    paint_spec,
    spectrum_of,
)
from hyperpaint.simulation.transport.mixing import Grain, member_rows
from hyperpaint.simulation.transport.surfaces import lobes_at, surfaces_of, turned_part

# --- pigments ---

GRID = np.arange(380.0, 1021.0, 1.0)
VISIBLE = (GRID > 430) & (GRID < 680)
INFRARED = GRID > 850


@given(st.sampled_from(FAMILIES), st.integers(0, 10**9 - 1))
def test_generated_paints_are_physical_and_smooth(family: str, number: int) -> None:
    paint = generate_paint(family, number)
    spectra = [paint.reflectance(GRID)]
    if paint.flakes is not None:
        spectra.append(spectrum_of(paint.flakes.spectrum)(GRID))
    for found in spectra:
        assert found.dtype == np.float64
        assert 0.0 < found.min() <= found.max() < 1.0
        # no step that a nanometre's sampling would miss
        assert np.abs(np.diff(found)).max() < 0.04
    assert (paint.flakes is not None) == (family in ("metallic", "pearl"))
    assert paint.finish == (family if paint.flakes else "solid")
    assert all((paint.trade_name, paint.colour))
    assert paint_spec(paint.name) == paint


@given(st.sampled_from(FAMILIES), st.integers(0, 10**6))
def test_a_number_is_one_paint(family: str, number: int) -> None:
    name = f"pigment:{family}:{number}"
    first = spectrum_of(name)(GRID)
    generate_paint.cache_clear()
    assert (spectrum_of(name)(GRID) == first).all()


def test_a_paint_is_the_same_in_another_process() -> None:
    code = (
        "import numpy as np\n"
        "from hyperpaint.simulation.rendering.scene_spectra import spectrum_of\n"
        "print(spectrum_of('pigment:tinted:5')(np.array([450.0, 650.0])).tobytes().hex())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == spectrum_of("pigment:tinted:5")(np.array([450.0, 650.0])).tobytes().hex()


def test_names_mean_the_same_next_year() -> None:
    # stored scenes name these; a change of the generator would repaint them
    for name, expected in {
        "pigment:solid:17": [0.2132, 0.0338, 0.0223, 0.5099],
        "pigment:pearl:17": [0.0219, 0.0248, 0.4804, 0.4805],
        "pigment:metallic:17:flakes": [0.8971, 0.6944, 0.5554, 0.8695],
    }.items():
        assert_allclose(spectrum_of(name)(np.array([450.0, 550.0, 650.0, 850.0])), expected, atol=5e-5)


def test_flakes_shine_through_the_tint_twice_over_a_kubelka_munk_layer() -> None:
    # exp(-2 K d) with S d = 0.05: a K/S of 2 leaves exp(-0.2)
    clear, tinted = (Pigments(ratio).flakes(GRID) for ratio in (0.0, 2.0))
    assert_allclose(tinted / clear, np.exp(-0.2), rtol=1e-12)
    green, dip = np.searchsorted(GRID, [550.0, 825.0])
    assert (clear[green], clear[dip]) == (pytest.approx(0.92, abs=0.01), pytest.approx(0.87, abs=0.01))
    # K/S = (1 - R)^2 / 2 R by its definition
    for ratio in (0.001, 0.5, 20.0):
        albedo = Pigments(ratio).albedo(np.array([500.0]))[0]
        assert (1.0 - albedo) ** 2 / (2.0 * albedo) == pytest.approx(ratio, rel=1e-9)
    # which is the base under the coat
    for family in FAMILIES:
        paint = generate_paint(family, 3)
        assert_allclose(
            base_albedo(paint.reflectance(GRID), Coat().index), paint.pigments.albedo(GRID), rtol=1e-10
        )


class TestFamilies:
    def spectra(self, family: str) -> np.ndarray:
        return np.stack([generate_paint(family, number).reflectance(GRID) for number in range(40)])

    def test_families_look_as_they_are_called(self) -> None:
        found = {family: self.spectra(family) for family in FAMILIES}
        seen = {family: spectra[:, VISIBLE] for family, spectra in found.items()}
        assert seen["white"].min() > 0.6
        assert found["carbon_black"].max() < 0.06
        assert seen["ir_black"].max() < 0.05 < 0.15 < found["ir_black"][:, INFRARED].min()
        assert (np.ptp(seen["grey"], axis=1) / seen["grey"].mean(axis=1)).max() < 0.1
        assert seen["tinted"].mean() > 1.5 * seen["solid"].mean()

    @pytest.mark.parametrize("family", FAMILIES)
    def test_there_is_variety(self, family: str) -> None:
        found = self.spectra(family)
        apart = np.sqrt(((found[:, None] - found[None]) ** 2).mean(axis=2))
        assert (apart + np.eye(len(found)) > 1e-6).all()
        if family in ("solid", "tinted", "metallic", "pearl"):
            assert np.median(apart) > 0.08
            assert len({generate_paint(family, number).colour for number in range(40)}) >= 6

    def test_pearl_flakes_have_an_interference_colour(self) -> None:
        pearl = generate_paint("pearl", 2).pigments
        assert pearl.interference is not None
        thickness, depth = pearl.interference
        plain = Pigments(pearl.absorption, pearl.absorbers)
        expected = 1.0 - depth * np.cos(2.0 * np.pi * thickness / GRID) ** 2
        assert_allclose(pearl.flakes(GRID) / plain.flakes(GRID), expected, rtol=1e-12)


class TestFourteen:
    def test_they_are_fourteen_and_differ(self) -> None:
        assert len(set(FOURTEEN)) == 14
        found = np.stack([spectrum_of(name)(GRID) for name in FOURTEEN])
        assert 0.0 < found.min() <= found.max() < 1.0
        assert (np.sqrt(((found[:, None] - found[None]) ** 2).mean(axis=2)) + np.eye(14)).min() > 0.03
        assert {paint_spec(name).finish for name in FOURTEEN} <= set(FINISHES)

    def test_they_look_as_they_are_called(self) -> None:
        at = dict(
            zip(
                ("blue", "green", "red", "infrared"), np.searchsorted(GRID, [460, 540, 650, 900]), strict=True
            )
        )
        found = {name: {k: spectrum_of(name)(GRID)[i] for k, i in at.items()} for name in FOURTEEN}
        for name, bright, factor, dark in (
            ("red", "red", 5, "green"), ("blue", "blue", 3, "red"), ("green", "green", 2, "blue"),
            ("green", "green", 2, "red"), ("yellow", "green", 5, "blue"),
        ):  # fmt: skip
            assert found[name][bright] > factor * found[name][dark]
        assert found["beige"]["red"] > found["beige"]["green"] > found["beige"]["blue"] > 0.1
        assert 0.05 < found["brown"]["red"] < 0.2
        assert found["ir_black"]["infrared"] > 10 * found["ir_black"]["red"]
        assert found["black"]["infrared"] < 0.05
        # their materials
        silver = paint_spec("silver").material("paint of car_007")
        assert (silver.name, silver.spectrum, silver.kind) == ("paint of car_007", "silver", "paint")
        assert silver.coat == Coat()
        assert silver.flakes is not None
        assert paint_spec("red").material().flakes is None


class TestCatalogue:
    @pytest.mark.parametrize("name", [*SPECTRA, "pigment:solid:17", "pigment:metallic:4:flakes"])
    def test_every_spectrum_is_a_reflectance_from_the_ultraviolet_on(self, name: str) -> None:
        found = spectrum_of(name)(np.arange(300.0, 2501.0))
        assert (found.shape, found.dtype) == ((2201,), np.float64)
        assert ((found >= 0.0) & (found <= 1.0)).all()

    def test_spectra_of_the_simulator_in_any_shape_without_the_first_reflection(self) -> None:
        assert spectrum_of("red")(np.full((2, 3), 500.0)).shape == (2, 3)
        assert spectrum_of("panel_50")(np.array(500)) == 0.5
        for name, paint in CAR_PAINTS.items():
            assert_allclose(spectrum_of(name)(GRID), paint(GRID) - 0.04, rtol=1e-12)
        assert set(MATERIALS) | set(FOURTEEN) <= set(SPECTRA)
        assert {"aluminium", "leaf", "brick", "lamp_red", "lamp_clear", "trim"} <= set(SPECTRA)


# --- fleet ---

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


def test_paints_of_the_fleet_look_like_their_colours_under_dust() -> None:
    levels: dict[str, list[float]] = {}
    for number in range(300):
        levels.setdefault(group_of(number), []).append(
            float(spectrum_of(f"fleet-{number}")(np.array([550.0]))[0])
        )
    assert min(levels["white"]) > 0.45
    assert max(levels["black"]) < 0.15
    assert np.median(levels["black"]) < 0.06
    assert np.median(levels["black"]) < np.median(levels["grey"]) < np.median(levels["silver"]) + 0.2
    # names lead to paints
    spec = paint_spec("fleet-17")
    assert is_paint("fleet-17")
    assert not is_paint("fleet-17:flakes")
    assert (spec.flakes is None) == (spec.finish == "solid")
    assert 1.48 <= spec.coat.index <= 1.55
    np.testing.assert_array_equal(spec.reflectance(NM), spectrum_of("fleet-17")(NM))
    # dust is a layer of two fluxes
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
    # names in files: colour and finish, unique, and field spectra of the cars in view
    names = {paint: flight.name_of(paint) for paint in flight.paints}
    assert len(set(names.values())) == len(names)
    for paint, name in names.items():
        assert name.startswith("{colour} {finish}".format(**flight.paint_properties(paint)))
    assert set(flight.measured_paints) <= set(flight.paints)
    # flakes add light to the body near the mirror direction
    metallic = next(
        paint for paint in flight.paints if flight.paint_properties(paint)["finish"] == "metallic"
    )
    assert (flight.paint_reflectance([metallic], NM) > (1 - 0.6) * spectrum_of(metallic)(NM)).all()
    assert "solid" in finishes
    assert finishes & {"metallic", "pearl"}
    whole = flight.lines(0, 24)
    for start, stop in ((0, 5), (5, 24)):
        np.testing.assert_array_equal(flight.lines(start, stop).counts, whole.counts[start:stop])


# --- populations ---

LIGHT = flat_light()
MEMBER_NM = np.linspace(390.0, 1010.0, 63)


def library(members: np.ndarray) -> xr.Dataset:
    # Return a library of one paint whose centre is the mean of its members (member, band)
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), members.mean(axis=0, keepdims=True)),
            "member_reflectance": (("signature", "member", "band"), members[np.newaxis]),
        },
        {"signature": ["measured"], "wavelength": ("band", MEMBER_NM, {"units": "nm"})},
    )


def spread_members(count: int = 200, spread: float = 0.10) -> np.ndarray:
    rng = np.random.default_rng(1)
    level = rng.standard_normal(count)
    level = 1.0 + spread * (level - level.mean()) / level.std()
    tilt = 0.02 * rng.standard_normal((count, 1)) * (MEMBER_NM - 700.0) / 300.0
    return np.asarray((0.3 + 0.1 * np.sin(MEMBER_NM / 80.0)) * (level[:, None] + tilt - tilt.mean()))


def panel(ground_sample: float, lines: int = 96, columns: int = 96, **more: Any) -> xr.Dataset:
    # Return a traced flight over a coated plane
    paint = Material("paint", "white", "paint", Coat(1.5, 0.05))
    flight = pushbroom(lines, columns, altitude=15.0, ground_sample=ground_sample, centre=(0.0, 0.0))
    return hp.simulation.trace(plane(200.0, paint), flight, [SUN], samples=2, depth=1, **more).compute()


@pytest.mark.slow
@pytest.mark.parametrize("ground_sample", [0.015, 0.10])
def test_rendered_pixels_have_the_spread_of_the_members(ground_sample: float) -> None:
    traced, paints = panel(ground_sample), library(spread_members())
    sunlight = flat_light(sky=0.0)  # without the noise of a sampled sky
    options = {"paints": {"white": "measured"}, "spectra": paints, "atmosphere": sunlight}
    flat = traced.paint.relight(FEW_BANDS, **options, population=False)
    mirrored = traced.paint.relight(
        FEW_BANDS, paints={"white": (MEMBER_NM, 0 * MEMBER_NM)}, atmosphere=sunlight
    )
    body = (traced.paint.relight(FEW_BANDS, **options).reflectance - mirrored.reflectance).values
    relative = body.std(axis=(0, 2)) / body.mean(axis=(0, 2))
    assert abs(relative - 0.10).max() < 0.01, relative
    # over 1.4 m of a panel some 50 patches of 20 cm are drawn, over 10 m thousands
    np.testing.assert_allclose(
        body.mean(axis=(0, 2)), (flat.reflectance - mirrored.reflectance).values.mean(axis=(0, 2)), rtol=0.03
    )


@pytest.mark.slow
def test_a_pixel_is_the_render_of_its_member() -> None:
    members = spread_members(3)
    traced = panel(0.1, lines=12, columns=12)
    bands = FEW_BANDS
    line = traced.paint.relight(
        bands, paints={"white": "measured"}, spectra=library(members), atmosphere=LIGHT
    ).radiance.values
    paints = [{"white": (MEMBER_NM, row)} for row in members]
    alone = np.stack([traced.paint.relight(bands, paints=one, atmosphere=LIGHT).radiance for one in paints])
    error = np.abs(line / alone - 1.0).max(axis=2)
    assert error.min(axis=0).max() < 2e-4  # of the band's response over a curved spectrum
    assert len(np.unique(error.argmin(axis=0))) == 3


@pytest.mark.slow
def test_neither_chunks_nor_blocks_change_a_bit() -> None:
    paints = library(spread_members())
    lines = [
        hp.simulation.trace(
            two_cars(), pushbroom(24, 16, altitude=12.0, ground_sample=0.45, line_spacing=0.3), [SUN],
            samples=4, chunk_lines=chunk,
        ).paint.relight(FEW_BANDS, paints=paints, atmosphere=LIGHT)
        for chunk in (1, 7, 24)
    ]  # fmt: skip
    for other in lines[1:]:
        np.testing.assert_array_equal(other.radiance.values, lines[0].radiance.values)
    np.testing.assert_array_equal(
        lines[0].isel(along_track=slice(5, 9)).radiance.values, lines[0].radiance.values[5:9]
    )


@pytest.mark.slow
def test_only_the_painted_car_changes() -> None:
    traced = hp.simulation.trace(
        two_cars(), pushbroom(24, 16, altitude=12.0, ground_sample=0.45, line_spacing=0.3), [SUN], samples=4
    ).compute()
    options = {"paints": {"car_0": "measured"}, "spectra": library(spread_members()), "atmosphere": LIGHT}
    without = traced.paint.relight(FEW_BANDS, **options, population=False)
    changed = (traced.paint.relight(FEW_BANDS, **options).radiance != without.radiance).any("band").values
    car = int(next(n for n, one in enumerate(["ground", "car_0", "car_1", "wall"]) if one == "car_0"))
    assert changed.any()
    assert (traced.instance.values[changed] == car).all()


def grain(length: float, count: int = 1000, *, is_averaged: bool = False) -> Grain:
    return grains([count], length, is_averaged)


def grains(counts: list[int], length: float = 1.0, is_averaged: bool = False) -> Grain:
    # Return fields of several materials without an order by angle
    size, zero = len(counts), np.zeros(len(counts))
    one = np.ones((size, 1))
    first = np.zeros(size, int)
    return Grain(first, np.array(counts), length * one, one, np.full(size, is_averaged), zero, zero)


def rows(label: np.ndarray, instance: np.ndarray, place: Any, made: Grain, seed: int) -> np.ndarray:
    shade = np.full(label.shape, np.nan, np.float32)
    return member_rows(label, instance, *place, shade, sun_zenith=30.0, grain=made, seed=seed)


def field(spacing: float, made: Grain, seed: int = 3, instance: int = 0) -> np.ndarray:
    east, north = np.meshgrid(np.arange(200) * spacing, np.arange(150) * spacing)
    label = np.zeros(east.shape, np.int32)
    place = np.stack([east + 0.123, north - 7.77, 0.0 * east])
    return rows(label, label + np.int32(instance), place, made, seed) / 1000.0


def test_ranks_are_even_and_alike_over_the_length() -> None:
    ranks = field(0.05, grain(0.1))
    assert abs(ranks.mean() - 0.5) < 0.02
    assert abs(ranks.std() - np.sqrt(1 / 12)) < 0.01
    assert abs((np.histogram(ranks, 10, (0, 1))[0] / ranks.size) - 0.1).max() < 0.02
    near = np.corrcoef(field(0.005, grain(0.1))[:, :-1].ravel(), field(0.005, grain(0.1))[:, 1:].ravel())
    assert near[0, 1] > 0.95
    assert abs(np.corrcoef(ranks[:, :-5].ravel(), ranks[:, 5:].ravel())[0, 1]) < 0.03


def test_fields_of_things_and_seeds_and_what_has_none() -> None:
    first = field(0.05, grain(0.1))
    for other in (field(0.05, grain(0.1), instance=1), field(0.05, grain(0.1), seed=4)):
        assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.05
    # what is smaller than a pixel averages out
    assert field(0.4, grain(0.1, is_averaged=True)).std() < 0.35 * field(0.4, grain(0.1)).std()
    assert (field(0.01, grain(0.1, is_averaged=True)).std() / field(0.01, grain(0.1)).std()) > 0.95
    # the sky and plain surfaces have no member
    label = np.array([[-1, 0, 1]], np.int32)
    made = grains([0, 9])
    place = np.array([[[np.nan, 0.0, 1.0]]] * 3)
    assert rows(label, label, place, made, 0).tolist()[0][:2] == [-1, -1]
    assert rows(label, label, place, made, 0)[0, 2] >= 0


@pytest.mark.slow
def test_a_measured_paint_with_flakes_is_drawn_by_its_geometry() -> None:
    # members at one angle; rendered on a level panel, where all pixels have the angle of the sun
    speckled = library(spread_members(spread=0.04))
    traced, dark = panel(0.1, lines=12, columns=12), {"white": (MEMBER_NM, 0.0 * MEMBER_NM)}

    def body(stated_angle: float, light: Any, **of_sun: list[float]) -> np.ndarray:
        geometry = {"aspecular_angle": [stated_angle], "aspecular_range": [30.0], **of_sun}
        paints = speckled.assign({name: ("signature", value) for name, value in geometry.items()})
        paints["flop"] = 0.0 * paints.reflectance + 2.0 / 3.0  # the bright end has twice the dark end
        paints["diffuse_fraction"] = 0.0 * paints.reflectance + 0.2
        options = {"paints": {"white": "measured"}, "spectra": paints, "atmosphere": light}
        line = traced.paint.relight(FEW_BANDS, **options).reflectance
        return np.asarray(line - traced.paint.relight(FEW_BANDS, paints=dark, atmosphere=light).reflectance)

    sunlight = flat_light(sky=0.0)
    middle = body(SUN[0], sunlight)
    assert (middle.std(axis=(0, 2)) / middle.mean(axis=(0, 2))).max() < 1e-3
    np.testing.assert_allclose(body(SUN[0] + 7.5, sunlight) / middle, 2.0**0.25, rtol=0.03)
    np.testing.assert_allclose(body(SUN[0] + 50.0, sunlight) / middle, 2.0**0.5, rtol=0.05)
    np.testing.assert_allclose(body(SUN[0] - 50.0, sunlight) / middle, 2.0**-0.5, rtol=0.03)
    # part of the change is the sun's cosine on the leaning body part, which the renderer adds itself
    end = body(SUN[0] + 50.0, sunlight, sun_zenith=[45.0]) / body(SUN[0], sunlight, sun_zenith=[45.0])
    np.testing.assert_allclose(end, 2.0**0.5 / (1.0 + 0.8 * np.radians(7.5)), rtol=0.05)
    overcast = flat_light(sun=0.0)
    np.testing.assert_array_equal(body(SUN[0] + 50.0, overcast), body(SUN[0], overcast))


# --- pearl ---

COAT, SHARE, LOBE = Coat(waviness=0.0), 0.5, 0.3
PEARL = Material("pearl", "body", "paint", COAT, Flakes(SHARE, LOBE, "face", "right angle"))
ENDS = np.array([400.0, 900.0])
BANDS = BandSet(np.array([650.0]), np.array(6.0))


def direction(zenith: float, azimuth: float) -> tuple[float, float, float]:
    z, a = np.radians([zenith, azimuth])
    return float(np.sin(z) * np.cos(a)), float(np.sin(z) * np.sin(a)), float(np.cos(z))


def part(view: tuple[float, float, float], light: tuple[float, float, float]) -> float:
    one, factor = np.ones(1), np.zeros(1, np.int32)
    surfaces = surfaces_of(1.5 * one, 0 * one, 0 * one, SHARE * one, LOBE * one, factor, factor)
    return float(turned_part(lobes_at(surfaces, 0, view, view, 0.0), light))


def relit(traced: xr.Dataset, light: Atmosphere, face: float, turned: float) -> float:
    levels = {"body": 0.0, "face": face, "right angle": turned}
    line = hp.simulation.relight(
        traced, BANDS, atmosphere=light, spectra={name: (ENDS, [level] * 2) for name, level in levels.items()}
    )
    return float(line.reflectance.mean())


def lit(sun: float, sky: float, zenith: float = 40.0) -> Atmosphere:
    none = np.zeros(2)
    return Atmosphere(ENDS, none + sun, none + sky, none, none, zenith, 90.0)


def traced(light: Atmosphere, paint: Material = PEARL, samples: int = 16, size: int = 4) -> xr.Dataset:
    flight = pushbroom(size, size, altitude=1000.0, ground_sample=0.01)
    return hp.simulation.trace(
        plane(5e3, paint), flight, [light], samples=samples, clear=False, sun_radius=0.0
    )


@pytest.mark.parametrize("thickness", [180.0, 300.0, 420.0])
def test_two_spectra_make_those_of_the_film_at_every_angle(thickness: float) -> None:
    # Snell's angle in titanium dioxide on mica, and the phase of the film at it
    # A straight line between two spectra is worst at the violet end of the thickest film
    nm, depth = np.arange(400.0, 1001.0, 5.0), 0.4
    pigments = Pigments(0.0, (), (thickness, depth))
    face, turned = pigments.flakes(nm) / aluminium(nm), pigments.flakes(nm, turned=True) / aluminium(nm)
    for away in (0.0, 20.0, 40.0, 60.0, 80.0):  # light and view on both sides of a flake's normal
        view, light = direction(away, 0.0), direction(away, 180.0)
        film = np.sqrt(1.0 - (np.sin(np.radians(away)) / 2.5) ** 2)
        exact = 1.0 - depth * np.cos(2.0 * np.pi * thickness * film / nm) ** 2
        mixed = face + part(view, light) * (turned - face)
        np.testing.assert_allclose(mixed, exact, atol=0.04)
        if away >= 60.0:
            assert np.abs(face - exact).max() > 3.0 * np.abs(mixed - exact).max()


def test_light_and_view_may_change_places() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        view, light = (direction(*one) for one in rng.uniform([0, 0], [85, 360], (2, 2)))
        assert part(view, light) == pytest.approx(part(light, view), rel=1e-12)
        assert part(view, view) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("light", [lit(1.0, 0.0), lit(0.0, 1.0)])
def test_no_light_is_lost_by_turning(light: Atmosphere) -> None:
    # Flakes of two equal spectra are flakes of one, path by path
    metal = Material("metal", "body", "paint", COAT, Flakes(SHARE, LOBE, "face"))
    assert relit(traced(light), light, 0.7, 0.7) == pytest.approx(
        relit(traced(light, metal), light, 0.7, 0.0), rel=1e-5
    )


def test_suns_are_the_reflectance_factor_of_the_paint() -> None:
    light = lit(1.0, 0.0)
    for face, turned in ((0.8, 0.2), (0.0, 0.9)):
        expected = hp.simulation.reflectance_factor(PEARL, 0.0, face, light=40.0, view=0.0, turned=turned)
        assert relit(traced(light), light, face, turned) == pytest.approx(float(expected), rel=2e-3)


@pytest.mark.slow
def test_a_sky_is_the_mean_of_suns() -> None:
    sky = lit(0.0, 1.0)
    zeniths = np.degrees(np.arcsin(np.sqrt((np.arange(120) + 0.5) / 120)))  # even in level irradiance
    suns = [
        hp.simulation.reflectance_factor(PEARL, 0.0, 0.0, light=zenith, view=0.0, turned=1.0)
        for zenith in zeniths
    ]
    lines = traced(sky, samples=512, size=24)  # spectra are chosen by chance: 1.1 % of noise
    turned = relit(lines, sky, 0.0, 1.0) - relit(lines, sky, 0.0, 0.0)  # without the sky in the coat
    assert turned == pytest.approx(np.mean(suns), rel=0.03)


def test_pearls_of_the_fleet_turn_and_metallics_do_not() -> None:
    nm = np.linspace(400.0, 900.0, 51)
    for name in fleet_names(0, 40):
        paint = paint_spec(name)
        assert bool(paint.flakes and paint.flakes.turned) == (paint.finish == "pearl")
        if paint.flakes and paint.flakes.turned:
            face, turned = (spectrum_of(each)(nm) for each in (paint.flakes.spectrum, paint.flakes.turned))
            assert 0.01 < np.abs(turned / face - 1.0).max() < 0.5


def test_a_pearl_is_repainted() -> None:
    names = [name for name in fleet_names(0, 40) if paint_spec(name).finish != "solid"]
    pearl, metal = (
        next(name for name in names if paint_spec(name).finish == finish) for finish in ("pearl", "metallic")
    )
    park = car_park(length=10.0, width=16.0, neighbours=(), paints=[pearl])
    lines = hp.simulation.trace(
        park, pushbroom(8, 16, altitude=30.0, ground_sample=0.5, centre=(0.0, 5.0)), ["noon"], samples=8
    ).compute()
    car = next(one.name for one in park.instances if one.kind == "car")
    for paint in (metal, pearl, (ENDS, [0.5, 0.5])):
        again = hp.simulation.relight(lines, BANDS, paints={car: paint}, truth=False).radiance
        assert np.isfinite(again.values).all()
