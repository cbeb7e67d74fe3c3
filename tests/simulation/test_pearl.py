"""Pearl: flakes whose interference colour changes with the angle between light and view."""

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane
from hyperpaint.simulation.rendering.scene_spectra import (
    Pigments,
    aluminium,
    fleet_names,
    paint_spec,
    spectrum_of,
)
from hyperpaint.simulation.transport.surfaces import lobes_at, surfaces_of, turned_part

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
