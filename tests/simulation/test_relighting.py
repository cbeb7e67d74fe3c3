"""Relighting: products of spectra over bands, against theory, a sum by hand, and through the chain."""

import dataclasses
import functools
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words, refusal
from support.traced_scenes import (
    FEW_BANDS,
    LOW_SUN,
    SUN,
    flat_light,
    flight,
    line_light,
    radiance_by_hand,
    seen_by,
    two_cars,
)
from support.transport_scenes import code as code_of

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import VARIABLES
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import (
    BandResponses,
    BandSet,
    Camera,
    cell_means,
    nominal_responsivity,
    smile,
)
from hyperpaint.simulation.rendering import relighting
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material, base_albedo, coated_reflectance
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.relighting import SHARES, ProductTable, factor_spectra
from hyperpaint.simulation.rendering.scene import SceneRecord, plane
from hyperpaint.simulation.rendering.scene_spectra import CAR_PAINTS, paint_spec, reflectance, spectrum_of
from hyperpaint.simulation.settings import SimulationSettings
from hyperpaint.simulation.transport.path_codes import (
    PathCodes,
    is_direct,
    is_indirect,
    is_mirrored,
    source_of,
)

# --- relighting ---

SAMPLES = {"samples": 8, "seed": 3, "overcast": True, "sun_radius": 0.0}
MANY_BANDS = BandSet(np.linspace(399.356, 1001.42, 68), np.array(6.0))


def tracing(scene: Any = None, **more: Any) -> xr.Dataset:
    return hp.simulation.trace(scene or two_cars(), flight(), [SUN, LOW_SUN], **{**SAMPLES, **more})


@pytest.fixture(scope="module")
def traced() -> xr.Dataset:
    return tracing().compute()


def panel(spectrum: str = "panel_20", coat: Coat | None = None) -> Any:
    return plane(500.0, Material("panel", spectrum, "panel", coat))


# --- theory


@pytest.mark.parametrize("sun", [SUN, LOW_SUN])
def test_a_lambert_plane(sun: tuple[float, float]) -> None:
    # L = rho (E_sun cos + E_sky) / pi in every pixel and every one of 272 bands
    scene, platform = panel(), flight(8, 12, wobble=2.0)
    trace = hp.simulation.trace(scene, platform, [SUN, LOW_SUN], samples=16, sun_radius=0.0)
    made = trace.paint.relight(atmosphere=flat_light(1.2, 0.3, sun))
    light = 1.2 * np.cos(np.radians(sun[0])) + 0.3
    assert made.radiance.shape == (8, 272, 12)
    np.testing.assert_allclose(made.radiance, 0.2 * light / np.pi, rtol=1e-6)
    np.testing.assert_allclose(made.reflectance, 0.2, rtol=1e-6)
    np.testing.assert_allclose(made.sun_share, 1.2 * np.cos(np.radians(sun[0])) / light, rtol=1e-6)
    for layer in ("glint_share", "mirrored_sky_share", "indirect_share", "shadow"):
        assert not made[layer].values.any(), layer


def test_a_lambert_plane_under_lines() -> None:
    # The same where light and paint have spectra: reflectance is their irradiance-weighted mean
    light = dataclasses.replace(line_light(), clear_shares=None)  # met evenly, not by chance
    made = (
        hp.simulation.trace(panel("red"), flight(2, 3), [SUN], samples=4, sun_radius=0.0)
        .paint.relight(atmosphere=light)
        .compute()
    )
    grid = light.wavelength
    expected = []
    for centre in made.wavelength.values:
        lit = np.exp(-4 * np.log(2) * ((grid - centre) / 6.0) ** 2) * light.irradiance
        expected.append((lit * spectrum_of("red")(grid)).sum() / lit.sum())
    np.testing.assert_allclose(
        made.reflectance, np.broadcast_to(np.array(expected)[:, None], (2, 272, 3)), rtol=1e-4
    )


def test_an_overcast_plane() -> None:
    # Both skies give a level surface the same light; the overcast one is met by chance
    trace = hp.simulation.trace(panel(), flight(16, 16), [SUN], samples=64, overcast=True)
    made = trace.paint.relight(FEW_BANDS, atmosphere=flat_light(0.0, 1.0, overcast_share=0.6))
    assert float(made.radiance.mean()) == pytest.approx(0.2 / np.pi, rel=2e-3)
    np.testing.assert_allclose(made.sky_share, 1.0, rtol=1e-6)


@pytest.mark.parametrize("level", [0.05, 0.5])
def test_a_coated_plane_reads_as_an_integrating_sphere_reads_it(level: float) -> None:
    # Under a uniform sky, seen from above: diffuse light in, near normal out, the mirror image with it
    trace = hp.simulation.trace(panel("panel_50", Coat()), flight(12, 12), [SUN], samples=256)
    nm = np.array([380.0, 1050.0])
    made = trace.paint.relight(
        FEW_BANDS, atmosphere=flat_light(0.0, 1.0), paints={"panel_50": (nm, [level, level])}
    )
    sphere = coated_reflectance(base_albedo(level), geometry="d/0", specular_included=True)
    assert float(made.reflectance.mean()) == pytest.approx(float(sphere), rel=5e-3)


def test_air_takes_and_adds(traced: xr.Dataset) -> None:
    clear = line_light()
    air = {"extinction": np.full_like(clear.sun, 2e-3), "path_radiance": 1e-5 * clear.sun}
    hazy = dataclasses.replace(clear, **air)
    thick = dataclasses.replace(clear, extinction=np.full_like(clear.sun, 0.05))
    surface = traced.paint.relight(FEW_BANDS, atmosphere=clear).compute()
    distance = traced.distance.values[:, None]
    for light, extinction in ((hazy, 2e-3), (thick, 0.05)):
        made = traced.paint.relight(FEW_BANDS, atmosphere=light).compute()
        added = made.radiance.values - surface.radiance.values * np.exp(-extinction * distance)
        per_metre = added / distance
        np.testing.assert_allclose(
            per_metre, per_metre[:1, :, :1] * np.ones_like(per_metre), rtol=2e-3, atol=2e-8
        )
        # what is said of the surfaces is said of the surfaces
        for name in ("reflectance", *SHARES):
            np.testing.assert_array_equal(made[name], surface[name])
    made = traced.paint.relight(FEW_BANDS, atmosphere=hazy).radiance.values[0, 1, 0]
    assert made - (surface.radiance.values[0, 1, 0] * np.exp(-2e-3 * distance[0, 0, 0])) == pytest.approx(
        1e-5 * np.interp(550.0, clear.wavelength, clear.sun) * distance[0, 0, 0], rel=0.02
    )


# --- oracles


@pytest.mark.parametrize("share", [0.0, 0.6])
@pytest.mark.parametrize("bent", [False, True])
def test_a_sum_by_hand(traced: xr.Dataset, share: float, bent: bool) -> None:
    light = line_light(LOW_SUN)
    light = dataclasses.replace(light, overcast_share=share, clear_shares=(1.0 - share) * light.clear_shares)
    # the second sun has number 3; by hand only source 2 is known
    only = hp.simulation.trace(two_cars(), flight(), [LOW_SUN], **SAMPLES).compute()
    bands = BandSet(FEW_BANDS.wavelength, FEW_BANDS.fwhm, "gaussian", smile(16, 1.2) if bent else None)
    made = only.paint.relight(bands, atmosphere=light).radiance.values
    for line, column in ((0, 0), (9, 5), (12, 11), (14, 15)):
        np.testing.assert_allclose(
            made[line, :, column], radiance_by_hand(only, line, column, light, bands), rtol=1e-4
        )


def test_a_sun_more_changes_nothing() -> None:
    alone, among = (
        hp.simulation.trace(two_cars(), flight(), suns, **SAMPLES, slots=256).paint.relight(
            FEW_BANDS, atmosphere=line_light(LOW_SUN)
        )
        for suns in ([LOW_SUN], [SUN, LOW_SUN])
    )
    xr.testing.assert_allclose(alone.radiance, among.radiance, rtol=1e-6)
    xr.testing.assert_allclose(alone.shadow, among.shadow)


def test_other_paints_are_another_scene(traced: xr.Dataset) -> None:
    # Relit with swapped paints, the scene is the one that was painted so before it was traced
    swapped = tracing(two_cars("green")).paint.relight(MANY_BANDS, atmosphere=line_light()).compute()
    for paints in (
        {"car_0": "green"},
        {"paint of car_0": "green"},
        {"red": "green"},
        {"red": "yellow", "paint of car_0": "grey", "car_0": spectrum_of("green")},
    ):
        made = traced.paint.relight(MANY_BANDS, atmosphere=line_light(), paints=paints).compute()
        for name in ("radiance", "reflectance", *SHARES, "material", "car_id"):
            np.testing.assert_array_equal(made[name], swapped[name], err_msg=f"{name} {paints}")
    named = traced.paint.relight(atmosphere=line_light(), paints={"car_0": "green"})["paint_id"]
    meanings = named.attrs["flag_meanings"].split()
    on_car_0 = (traced.car_id == traced.car_id.max() - 1).values
    assert {meanings[number] for number in np.unique(named.values[named.values >= 0])} == {"green", "blue"}
    assert meanings[int(named.values[on_car_0][0])] in {"green", "blue"}


@pytest.mark.parametrize("new", ["silver", "brown", "white"])
def test_a_repainted_metallic_car_has_the_flakes_of_its_new_paint(new: str) -> None:
    # Sun alone, seen once: no chance is in it. The lobes are those of a plane painted so from the start.
    spec, light = paint_spec(new), flat_light(sky=0.0)
    old = Material("lacquer", "blue", "paint", Coat(), Flakes(0.2))
    images = []
    for material, paints in ((old, {"lacquer": new}), (spec.material("lacquer"), {})):
        traced = hp.simulation.trace(plane(400.0, material), flight(4, 3), [SUN], samples=4, depth=1)
        images.append(traced.paint.relight(MANY_BANDS, atmosphere=light, paints=paints).radiance)
    xr.testing.assert_allclose(*images, rtol=1e-5)
    # a measured spectrum leaves no flakes
    assert factor_spectra(
        SceneRecord.of(plane(4.0, old)), FEW_BANDS, {"lacquer": spectrum_of("red")}
    ).scales == (1.25, 0.0)


def test_spectra_may_be_given_in_any_form(traced: xr.Dataset) -> None:
    nm = np.arange(380.0, 1050.0, 0.5)
    red = spectrum_of("green")(nm)
    microns = {"wavelength": ("wavelength", nm / 1e3, {"units": "um"})}
    labelled = xr.DataArray(100 * red, microns, "wavelength", attrs={"units": "percent"})
    library = xr.Dataset(
        {"reflectance": (("signature", "band"), red[None])},
        {"signature": ["mine"], "wavelength": ("band", nm)},
    )
    # of a field spectrometer, with a gap where water absorbs
    long, gap = np.append(nm, [1400.0, 1900.0, 2500.0]), np.append(red, [0.5, np.nan, 0.4])
    expected = traced.paint.relight(FEW_BANDS, atmosphere=line_light(), paints={"car_0": "green"}).radiance
    for paints, spectra in (
        ({"car_0": (nm, red)}, None),
        ({"car_0": (long, gap)}, None),
        ({"car_0": labelled}, None),
        ({"car_0": "mine"}, {"mine": (nm, red)}),
        ({"car_0": "mine"}, library),
        ({}, {"red": (nm, red)}),
    ):
        made = traced.paint.relight(
            FEW_BANDS, atmosphere=line_light(), paints=paints, spectra=spectra
        ).radiance
        xr.testing.assert_allclose(made, expected, rtol=1e-5)


def test_columns_with_a_smile_see_what_shifted_bands_see(traced: xr.Dataset) -> None:
    shift = smile(16, 1.0)
    made = traced.paint.relight(
        BandSet(MANY_BANDS.wavelength, MANY_BANDS.fwhm, "gaussian", shift), atmosphere=line_light()
    ).compute()
    np.testing.assert_array_equal(made.wavelength_shift, shift)
    for column in (0, 3, 8, 15):
        other = traced.paint.relight(
            BandSet(MANY_BANDS.wavelength + shift[column], MANY_BANDS.fwhm), atmosphere=line_light()
        )
        for name in ("radiance", "reflectance"):
            np.testing.assert_allclose(made[name][..., column], other[name][..., column], rtol=1e-4)


def test_light_that_varies(traced: xr.Dataset) -> None:
    # Direct and diffuse light go their own ways; reflectance only follows where both do the same
    variation = np.random.default_rng(2).uniform(0.2, 1.2, (2, 24))
    light = line_light()
    sun, sky = (dataclasses.replace(light, **{name: 0 * light.sun}) for name in ("sky", "sun"))
    parts = [traced.paint.relight(FEW_BANDS, atmosphere=each).radiance.values for each in (sun, sky)]
    expected = sum(part * factor[:, None, None] for part, factor in zip(parts, variation, strict=True))
    made = traced.paint.relight(FEW_BANDS, atmosphere=light, variation=variation).compute()
    np.testing.assert_allclose(made.radiance, expected, rtol=2e-6)
    same = traced.paint.relight(FEW_BANDS, atmosphere=light, variation=np.stack([variation[0]] * 2)).compute()
    steady = traced.paint.relight(FEW_BANDS, atmosphere=light).compute()
    np.testing.assert_allclose(same.reflectance, steady.reflectance, rtol=2e-6)
    np.testing.assert_allclose(same.sun_share, steady.sun_share, rtol=1e-5)


# --- layers


def test_shares_of_light(traced: xr.Dataset) -> None:
    made = traced.paint.relight(MANY_BANDS, atmosphere=line_light()).compute()
    np.testing.assert_allclose(made.sun_share + made.sky_share, 1.0, rtol=1e-6)
    others = made.glint_share + made.mirrored_sky_share + made.indirect_share
    assert ((others >= 0) & (others <= 1 + 1e-6)).all()
    assert (made.glint_share <= made.sun_share + 1e-6).all()
    assert (made.mirrored_sky_share <= made.sky_share + 1e-6).all()
    on_top = ((made.paint_id >= 0) & (made.purity == 1)) & (made.up > 1.19)
    assert made.mirrored_sky_share.values[on_top].mean() > 0.01  # a coat mirrors the sky
    matt = (made.purity == 1) & (made.surface_class == 0)
    assert not made.mirrored_sky_share.values[matt.values].any()
    dark = (made.shadow == 1) & matt
    assert dark.any()
    # what the sun does not see directly, it lights by way of something else
    np.testing.assert_allclose(
        made.sun_share.values[dark.values], (made.sun_share * (made.indirect_share > 0)).values[dark.values]
    )
    assert (
        made.reflectance.values[:, 2][dark.values].mean()
        < 0.5 * made.reflectance.values[:, 2][matt.values].max()
    )
    for name in SHARES:
        assert made[name].attrs["units"] == "1"


def test_shadow_is_that_of_the_sun_that_shines_whatever_the_chunks(traced: xr.Dataset) -> None:
    for number, sun in enumerate((SUN, LOW_SUN)):
        made = traced.paint.relight(FEW_BANDS, atmosphere=flat_light(direction=sun))
        np.testing.assert_allclose(made.shadow, 1 - traced.sun_visibility[:, number], rtol=1e-6)
    # chunks that split lines are put together
    split = traced.chunk({"along_track": 5, "cross_track": 3, "slot": 7})
    whole = split.paint.relight(FEW_BANDS, atmosphere=line_light()).compute()
    xr.testing.assert_identical(whole, traced.paint.relight(FEW_BANDS, atmosphere=line_light()).compute())


def test_variables_are_those_of_the_table_before_and_after(traced: xr.Dataset, no_compute: Any) -> None:
    with no_compute():
        lazy = traced.chunk({"along_track": 7}).paint.relight(atmosphere=line_light())
        varied = traced.chunk({"along_track": 7}).paint.relight(
            atmosphere=line_light(), variation=np.ones((2, 24))
        )
    assert lazy.radiance.chunksizes == {"along_track": (7, 7, 7, 3), "band": (272,), "cross_track": (16,)}
    for made in (lazy, lazy.compute(), varied):
        for name, array in made.variables.items():
            row = VARIABLES[str(name)]
            assert array.dims in (row.dims, *row.alternatives), name
            assert (array.dtype, array.attrs.get("units", "")) == (row.dtype, row.units), name
    for name in ("radiance", "reflectance", "shadow", *SHARES):
        assert lazy[name].chunks is not None, name
    assert set(lazy.data_vars) - set(
        traced.paint.relight(atmosphere=line_light(), truth=False).data_vars
    ) == {
        "reflectance",
        "shadow",
        *SHARES,
    }


# --- laziness, chunks, stores


@pytest.mark.slow
def test_the_same_bits_whatever_the_chunks(scheduler_of_lines: Callable[[int], Any]) -> None:
    bands = BandSet(FEW_BANDS.wavelength, FEW_BANDS.fwhm, "gaussian", smile(16, 0.6))
    light = Atmosphere.clear(*SUN)
    variation = np.random.default_rng(0).uniform(0.5, 1.0, (2, 24))
    with dask.config.set(scheduler="synchronous"):
        whole = tracing().paint.relight(bands, atmosphere=light, variation=variation).compute()
    for chunk_lines in (1, 7, 24):
        made = tracing(chunk_lines=chunk_lines).paint.relight(bands, atmosphere=light, variation=variation)
        with scheduler_of_lines(chunk_lines):
            xr.testing.assert_identical(made.compute(), whole)


def test_a_stored_scene_is_relit_without_tracing(
    tmp_path: Path, traced: xr.Dataset, monkeypatch: pytest.MonkeyPatch, no_compute: Any
) -> None:
    path = tmp_path / "traced.zarr"
    hp.to_store(traced, path)
    lights = [
        {"atmosphere": line_light()},
        {"atmosphere": line_light(LOW_SUN), "paints": {"car_1": "yellow"}},
        {"atmosphere": line_light().clouded(8)},
    ]
    even = np.ones((2, 24))
    expected = [traced.paint.relight(FEW_BANDS, **light, variation=even).compute() for light in lights]

    def refuse(*_: Any) -> None:
        raise AssertionError("the scene was traced again")

    monkeypatch.setattr(relighting, "trace_lines", refuse)
    for opened in (xr.open_zarr(path), hp.open_store(path)):
        for light, relit in zip(lights, expected, strict=True):
            with no_compute():
                made = opened.paint.relight(FEW_BANDS, **light, variation=even)
            xr.testing.assert_equal(made.compute(), relit)
    expect_error(AssertionError, "traced again", lambda: tracing().compute())
    relit = tmp_path / "relit.zarr"
    hp.to_store(hp.open_store(path).paint.relight(FEW_BANDS, atmosphere=line_light()), relit)
    assert hp.verify(relit).ok
    assert hp.open_store(relit).radiance.dtype == np.float32


def test_radiance_alone_costs_no_truth(traced: xr.Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    from hyperpaint.simulation.rendering.relighting import Lighting

    def refuse(*_: Any) -> None:
        raise AssertionError("truth was computed")

    monkeypatch.setattr(Lighting, "shares", refuse)
    monkeypatch.setattr(Lighting, "reflectance", refuse)
    traced.paint.relight(FEW_BANDS, atmosphere=line_light())["radiance"].compute()


# --- the chain


@pytest.mark.parametrize("varies", [False, True])
def test_a_relit_scene_is_a_flight_line(varies: bool) -> None:
    # Radiance and the record of the spectrometer give back the reflectance of the surfaces
    lines = 24
    seconds = np.arange(lines) / lines
    variation = np.stack([1.0 - 0.3 * seconds, 1.0 + 0.2 * seconds]) if varies else None
    made = hp.simulation.trace(
        two_cars(), pushbroom(lines, 6, altitude=12.0, frame_period=0.5), [SUN], samples=4
    ).paint.relight(atmosphere=line_light(), variation=variation)
    found = made.drop_vars("reflectance").paint.reflectance().compute()
    np.testing.assert_allclose(found.reflectance, made.reflectance, rtol=1e-3)
    assert not found.quality.values.any()


def test_what_was_not_traced_and_light_beyond_the_bands(traced: xr.Dataset) -> None:
    expect_error(
        SchemaError,
        "sun-not-traced",
        lambda: traced.paint.relight(atmosphere=flat_light(direction=(40.02, 150.0))),
    )
    traced.paint.relight(atmosphere=flat_light(direction=(40.009, 150.0)))
    traced.paint.relight(atmosphere=flat_light(0.0, direction=(10.0, 0.0)))  # no sun, no direction
    expect_error(
        SchemaError,
        "sky-not-traced",
        lambda: hp.simulation.trace(two_cars(), flight(), [SUN]).paint.relight(
            atmosphere=flat_light(overcast_share=0.5)
        ),
    )
    expect_errors(
        (SchemaError, "metadata-missing", lambda: xr.Dataset().paint.relight()),
        (SchemaError, "transport_path", lambda: tracing().drop_vars("transport_path").paint.relight()),
    )
    # light covers the wings of the bands
    # One and a half widths before 1100 nm, where the light ends; a little further is refused above
    bands = BandSet(np.array([500.0, 1090.9]), np.array(6.0))
    assert hp.simulation.relight(traced, bands, atmosphere=flat_light()).radiance.shape[1] == 2


def test_paints_that_cannot_be_are_all_named(traced: xr.Dataset) -> None:
    nm = np.array([380.0, 1050.0])
    paints = {
        "car_9": "red",
        "car_0": (nm, np.array([0.5, 1.2])),
        "car_1": (np.array([450.0, 1050.0]), np.array([0.5, 0.5])),
        "brick": "no such spectrum",
        "asphalt": (nm, np.array([-0.1, np.nan])),
    }
    light = line_light()
    message = str(
        expect_error(SchemaError, None, lambda: traced.paint.relight(paints=paints, atmosphere=light))
    )
    expect_words(
        message,
        "paints['car_9']",
        "'car_0' ranges from 0.5 to 1.2",
        "'car_1' covers 450.0 to 1050.0 nm",
        "'no such spectrum'",
        "'asphalt' is not finite",
    )
    assert message.count("\n") == 5
    # unless they are clipped
    high = (nm, np.array([1.3, -0.2]))
    expect_error(
        SchemaError,
        "value-out-of-range",
        lambda: traced.paint.relight(FEW_BANDS, paints={"asphalt": high}, atmosphere=line_light()),
    )
    made = traced.paint.relight(FEW_BANDS, paints={"asphalt": high}, atmosphere=line_light(), clip=True)
    by_hand = lambda grid: np.interp(grid, *high).clip(0.0, 1.0)  # noqa: E731
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
        ({"bands": BandSet(np.array([500.0, 1091.1]), np.array(6.0))}, "atmosphere-coverage"),
        ({"atmosphere": "midnight"}, "choice-unknown"),
        ({"atmosphere": 3}, "atmosphere.*type-wrong"),
        ({"spectra": [1, 2]}, "spectra.*type-wrong"),
        ({"paints": {"car_0": "red", "nothing": "red"}}, "'nothing'"),
    ],
)
def test_arguments_that_cannot_be(traced: xr.Dataset, arguments: dict[str, Any], found: str) -> None:
    expect_error(
        SchemaError, found, lambda: hp.simulation.relight(traced, **{"atmosphere": flat_light(), **arguments})
    )


def test_an_instance_of_many_materials_has_no_one_paint() -> None:
    stripes = [Material(f"stripe {n}", "panel_20", "panel") for n in range(2)]
    scene = plane(4.0, stripes[0], instance="chart")
    joined = type(scene).join([scene, plane(4.0, stripes[1], centre=(4.0, 0, 0), instance="other")])
    both = dataclasses.replace(joined, face_instance=np.zeros_like(joined.face_instance))
    expect_error(
        SchemaError,
        "paint-target-ambiguous",
        lambda: hp.simulation.trace(both, flight(1, 1), [SUN]).paint.relight(
            paints={"chart": "red"}, atmosphere=flat_light()
        ),
    )
    shared = dataclasses.replace(joined, face_material=np.zeros_like(joined.face_material))
    with refusal(SchemaError, "paint-target-shared", "'other'"):
        hp.simulation.trace(shared, flight(1, 1), [SUN]).paint.relight(
            paints={"chart": "red"}, atmosphere=flat_light()
        )


# --- spectral products ---

NAMES = list(CAR_PAINTS)
CODES = PathCodes.of(len(NAMES), 4)
GRID = np.arange(350.0, 1050.0, 0.05)


@functools.cache
def clear() -> Atmosphere:
    return Atmosphere.clear(60.0)


def paints(grid: np.ndarray) -> np.ndarray:
    return reflectance(NAMES, grid)


def some_codes(number: int = 400, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    made = [
        code_of(
            int(rng.choice([0, 2])),
            *rng.integers(0, len(NAMES), rng.integers(0, 5)),
            digit_bits=CODES.digit_bits,
        )
        for _ in range(number)
    ]
    return np.unique(made)


def table_of(
    bands: BandSet, sources: dict[int, np.ndarray] | None = None, *, codes: PathCodes = CODES, **more: Any
) -> ProductTable:
    light = clear()
    sources = {0: light.sky, 2: light.sun} if sources is None else sources
    return ProductTable(bands, codes, light.wavelength, sources, **{"factors": paints, **more})


def product(code: int, grid: np.ndarray = GRID) -> np.ndarray:
    source = clear().sun if code % 8 else clear().sky
    made = np.interp(grid, clear().wavelength, source) / np.pi
    for factor in CODES.factors(np.array([code]))[0]:
        if factor >= 0:
            made = made * CAR_PAINTS[NAMES[factor]](grid)
    return made


def at_columns(table: ProductTable, codes: np.ndarray) -> np.ndarray:
    # Return the products of paths as every column sees them, (path, band, cross_track)
    return table.to_columns(table.rows(codes).astype(np.float64).swapaxes(0, 1))


@given(
    factors=st.integers(1, 2**14 - 1),
    source=st.integers(0, 7),
    flags=st.tuples(st.booleans(), st.booleans()),
    data=st.data(),
)
def test_codes_say_what_went_in(factors: int, source: int, flags: Any, data: st.DataObject) -> None:
    codes = PathCodes.of(factors, 4)
    met = data.draw(st.lists(st.integers(0, factors - 1), max_size=4))
    code = code_of(source, *met, mirror=flags[0], indirect=flags[1], digit_bits=codes.digit_bits)
    assert 0 <= code < 2**63
    as_array = np.array([code])
    found = codes.factors(as_array)[0]
    assert (sorted(found[found >= 0].tolist()), source_of(as_array)[0]) == (sorted(met), source)
    assert is_direct(as_array)[0] == (source >= 2)
    assert (is_mirrored(as_array)[0], is_indirect(as_array)[0]) == flags


def test_codes_that_do_not_fit_or_are_of_another_scene_are_refused() -> None:
    assert PathCodes.of(2**14 - 1, 4).digit_bits == 14
    expect_refusals(
        (SchemaError, "path-code-too-long", "depth=3", lambda: PathCodes.of(2**14, 4)),
        (SchemaError, "value-out-of-range", lambda: PathCodes.of(3, 0)),
    )
    # of another scene
    table = table_of(BandSet.of(), codes=PathCodes.of(3, 4), factors=lambda nm: np.ones((2, nm.size)))
    assert table.rows(np.empty(0, np.int64)).shape == (1, 0, 272)
    expect_error(
        SchemaError,
        "path-code-unknown",
        lambda: table.rows(np.array([code_of(0, 2, digit_bits=CODES.digit_bits)])),
    )


@pytest.mark.parametrize(
    ("shape", "fwhm", "responsivity"),
    [
        ("gaussian", 6.0, None),
        ("gaussian", 2.0, nominal_responsivity(20.0)),
        ("slit", 5.0, None),
    ],
)
def test_products_are_dense_integrals(shape: str, fwhm: float, responsivity: Any) -> None:
    # Sharp lines and steep edges; the sum itself is no better than some 1e-5
    bands = BandSet(np.linspace(399.356, 1001.42, 272), np.array(fwhm), shape, None, responsivity)
    codes = some_codes()[::97]
    rows = table_of(bands).rows(codes)
    assert (rows.dtype, rows.shape) == (np.float32, (1, codes.size, 272))
    grid = np.arange(350.0, 1050.0, 0.05 if fwhm > 3.0 else 0.01)
    for row, code in zip(rows[0], codes.tolist(), strict=True):
        np.testing.assert_allclose(row, seen_by(bands, grid, product(code, grid)), rtol=1e-4)


def test_responsivity_sources_without_light_and_means_over_cells() -> None:
    centres = np.linspace(750.0, 775.0, 12)
    flat, sloping = (
        table_of(BandSet(centres, np.array(6.0), "gaussian", None, response)).rows(np.array([2]))
        for response in (None, lambda nm: 1.0 - 0.03 * (nm - 760.0))
    )
    assert np.abs(flat / sloping - 1).max() > 0.005
    # a source without light gives nothing
    light = clear()
    table = table_of(BandSet.of(), {2: light.sun, 3: 0 * light.sun})
    assert not table.rows(np.array([0, 1, 3, 4])).any()
    np.testing.assert_allclose(
        table.irradiance(2)[0],
        seen_by(BandSet.of(), GRID, np.interp(GRID, light.wavelength, light.sun)),
        rtol=1e-4,
    )
    # means over cells keep the integral
    rng = np.random.default_rng(3)
    wavelength = np.sort(rng.uniform(400.0, 500.0, 300))
    spectrum = rng.uniform(0.0, 2.0, 300)
    for step in (0.05, 0.7, 5.0):
        grid = np.arange(380.0, 520.0, step)
        inside = np.diff(
            np.concatenate([grid - step / 2, grid[-1:] + step / 2]).clip(wavelength[0], wavelength[-1])
        )
        assert (cell_means(wavelength, spectrum, grid) * inside).sum() == pytest.approx(
            np.trapezoid(spectrum, wavelength), rel=1e-12
        )


def test_columns_see_their_own_wavelengths() -> None:
    shift = 1.5 * np.linspace(-1.0, 1.0, 9) ** 2
    bands = BandSet(np.linspace(399.356, 1001.42, 272), np.array(6.0), "gaussian", shift)
    codes = some_codes()[::61]
    seen = at_columns(table_of(bands), codes)
    for column in (0, 1, 4, 7):
        for place, code in enumerate(codes.tolist()):
            np.testing.assert_allclose(
                seen[place, :, column], seen_by(bands, GRID, product(code), shift[column]), rtol=1e-4
            )


@pytest.mark.parametrize("shift", [None, np.linspace(-0.6, 0.7, 5)], ids=["no smile", "smile"])
def test_mixing_is_the_weighted_sum_over_paths(shift: Any) -> None:
    bands = BandSet(np.linspace(450.0, 900.0, 7), np.array(6.0), wavelength_shift=shift)
    table = table_of(bands)
    rng, known = np.random.default_rng(1), some_codes(6)
    codes = rng.choice(known, (2, 3, 5))
    codes[:, 2, :2] = -1  # empty slots, whatever their weight
    weight = rng.random(codes.shape).astype(np.float32)
    out = np.full((2, 7, 5), np.nan, np.float32)
    table.mix(weight, codes, out)
    products = np.broadcast_to(at_columns(table, known), (known.size, 7, 5))
    expected = np.zeros(out.shape)
    for line, slot, column in zip(*np.nonzero(codes >= 0), strict=True):
        path = np.searchsorted(known, codes[line, slot, column])
        expected[line, :, column] += weight[line, slot, column] * products[path, :, column]
    np.testing.assert_allclose(out, expected, rtol=1e-5)


def test_an_imager_integrates_without_norm() -> None:
    camera = Camera.of(SimulationSettings(bands=40, columns=7, smile_nm=0.8, srf_shape="slit"))
    table = table_of(BandSet.of(camera.imager), normalise=False)
    codes = some_codes()[::97]
    grid = np.arange(340.0, 1080.0, 0.05)
    expected = camera.imager.integrals(
        np.stack([np.interp(grid, GRID, product(code)) for code in codes.tolist()]), grid
    )
    np.testing.assert_allclose(at_columns(table, codes) * camera.imager.element_factor, expected, rtol=1e-4)


def test_who_asks_first_changes_no_bit() -> None:
    codes = some_codes()
    one_by_one, shared = table_of(BandSet.of()), table_of(BandSet.of())
    together = table_of(BandSet.of()).rows(codes)
    for place in np.random.default_rng(1).permutation(codes.size)[:50]:
        np.testing.assert_array_equal(one_by_one.rows(codes[place : place + 1])[:, 0], together[:, place])
    np.testing.assert_array_equal(one_by_one.rows(codes), together)

    def ask(seed: int) -> None:
        chosen = np.sort(np.random.default_rng(seed).choice(codes.size, 60, replace=False))
        np.testing.assert_array_equal(shared.rows(codes[chosen]), together[:, chosen])

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(ask, range(64)))
    cached, products = shared._cache
    assert np.unique(cached).size == cached.size == len(products)


def test_a_table_travels_without_what_it_has_made(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = some_codes()
    table = table_of(BandSet.of())
    empty = len(pickle.dumps(table))
    rows = table.rows(codes)
    assert len(pickle.dumps(table)) == empty
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(table)).rows(codes), rows)
    # and what does not fit is made again each time
    monkeypatch.setattr(relighting, "_MAX_CACHE_BYTES", 100 * 272 * 4)
    small = pickle.loads(pickle.dumps(table))
    for start in range(0, codes.size, 30):
        np.testing.assert_array_equal(small.rows(codes[start : start + 30]), rows[:, start : start + 30])
    assert 0 < small._cache[1].nbytes <= 100 * 272 * 4


def test_bands_that_cannot_be_are_all_named() -> None:
    wrong = (np.array([500.0, 400.0]), np.array([1.0, 2.0, 3.0]), "box", np.array([[1.0]]))
    assert str(expect_error(SchemaError, None, lambda: BandSet(*wrong))).count("\n") == 4
    expect_error(SchemaError, "wavelength", lambda: BandSet(np.array([500.0, np.nan]), np.array(6.0)))
    expect_refusals((SchemaError, "variable-missing", "'wavelength'", "'fwhm'", lambda: BandSet.of(object())))


@pytest.mark.parametrize("bands", [1, 2, 5, 272])
def test_few_bands(bands: int) -> None:
    centres = np.linspace(420.0, 980.0, bands)
    table = table_of(BandSet(centres, np.array(6.0)), {0: np.ones_like(clear().sky)})
    np.testing.assert_allclose(table.rows(np.array([0])), 1 / np.pi, rtol=1e-6)
    assert BandResponses(BandSet(centres, np.array(6.0))).width <= bands
