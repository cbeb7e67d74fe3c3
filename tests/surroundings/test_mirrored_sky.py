"""The light that clear coats mirror: of the sky, in lobes of flakes, and the attribute that tells of it."""

from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from oracles.disort_sky import relative_sky
from oracles.fresnel import plain_fresnel
from support.analytic_scenes import as_line, smooth_edge, wavelengths

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.light.clear_sky import zenith_radiance
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.simulation import simulate_line
from hyperpaint.surroundings.corrections import mirrored_sky, split_of

# --- The sky in a level coat, by direction: against another reading of the tables, and by drawn skies


THREE_NM = np.array([430.0, 550.0, 860.0])
STAMP, PLACE = np.datetime64("2024-06-21T09:10", "ns"), (50.0, 0.0)
SUN, AZIMUTH = (float(angle) for angle in solar_position(STAMP, *PLACE))


def truth(sun: float, view: float, turned: float, aerosol: float, n: float = 1.5) -> np.ndarray:
    # Return what a level coat mirrors to a camera; ``turned``: azimuth from the sun to the camera
    f = diffuse_fraction(THREE_NM, sun, aerosol_optical_depth=aerosol)
    cosine, azimuth = np.cos(np.radians(view)), np.radians(180.0 - turned)
    sky = [float(relative_sky(nm, sun, cosine, azimuth, aerosol=aerosol)) for nm in THREE_NM]
    return np.asarray(plain_fresnel(np.radians(view), n) * f * sky)


def split(sun: float, aerosol: float) -> Any:
    line = xr.Dataset(coords={"wavelength": ("band", THREE_NM, {"units": "nm"})})
    return split_of(line, diffuse_fraction(THREE_NM, sun, aerosol_optical_depth=aerosol), sun, "clear")


@pytest.mark.parametrize("aerosol", [0.05, 0.1, 0.35])
@pytest.mark.parametrize("sun", [17.0, 27.0, 60.0])
def test_the_sky_of_the_direction(sun: float, aerosol: float) -> None:
    for view, turned in ((0.0, 0.0), (14.0, 0.0), (14.0, 180.0), (20.0, 75.0), (20.0, 180.0)):
        value, u = mirrored_sky(split(sun, aerosol), view, turned)
        expected = truth(sun, view, turned, aerosol)
        np.testing.assert_allclose(value, expected, atol=5e-4)
        assert (u > 0.09 * value).all()
    # an unknown view is the zenith, within its uncertainty
    value, u = mirrored_sky(split(sun, aerosol), np.nan, np.nan)
    np.testing.assert_allclose(value, truth(sun, 0.0, 0.0, aerosol), atol=5e-4)
    assert (np.abs(truth(sun, 14.0, 180.0, aerosol) - value) < 2.5 * u).all()


def test_drawn_coats_leans_and_skies_have_the_stated_spread() -> None:
    # Index, lean and aerosol at random; haze changes the diffuse fraction with the sky
    rng, sun, view = np.random.default_rng(5), 35.0, 12.0
    fractions = diffuse_fraction(THREE_NM, sun, aerosol_optical_depth=0.16)
    more = diffuse_fraction(THREE_NM, sun, aerosol_optical_depth=0.19)
    measured = split_of(
        xr.Dataset(coords={"wavelength": ("band", THREE_NM, {"units": "nm"})}), fractions, sun, "clear"
    )
    uncertain = type(measured)(**{**vars(measured), "u": measured.fraction.copy(data=more - fractions)})
    _, u = mirrored_sky(uncertain, view, 180.0, lean_u=1.5)
    drawn = []
    for _ in range(150):
        lean = np.radians(2.0 * 1.5 * rng.standard_normal(2))
        east, north = np.sin(np.radians(view)) + lean[0], lean[1]  # the sun is in the east
        zenith, azimuth = np.degrees(np.arcsin(np.hypot(east, north))), np.degrees(np.arctan2(north, east))
        index, aerosol = 1.5 + 0.03 * rng.standard_normal(), 0.16 + 0.03 * rng.standard_normal()
        drawn.append(truth(sun, zenith, 180.0 - azimuth, max(aerosol, 0.03), index))
    spread = np.std(drawn, axis=0)
    # the model of the sky itself adds 6 %
    expected = np.hypot(spread, 0.06 * truth(sun, view, 180.0, 0.16))
    np.testing.assert_allclose(u, expected, rtol=0.15)


def test_uncertainty__covers_unknown_views_and_skies() -> None:
    no_spread = {"index_u": 0.0, "lean_u": 0.0}
    # an unknown view lies in the field of a usual camera, up to 20 degrees to both sides
    value, u = mirrored_sky(split(40.0, 0.1), np.nan, np.nan, **no_spread)
    views = [truth(40.0, view, turned, 0.1) for view in range(0, 21, 4) for turned in (0.0, 90.0, 180.0)]
    np.testing.assert_allclose(u / value, np.sqrt(np.mean((views / value.values - 1.0) ** 2, axis=0)), 0.35)
    # polarisation changes a sky by 3 to 6 %, the phase function of its aerosol as much
    value, u = mirrored_sky(split(40.0, 0.1), **no_spread)
    assert (0.042 * value < u).all()
    assert (u < 0.085 * value).all()
    # a sky taken for uniform may be clear, with a bright or a dark zenith
    line = xr.Dataset(coords={"wavelength": ("band", THREE_NM, {"units": "nm"})})
    value, u = mirrored_sky(split_of(line, np.full(3, 0.3), 40.0, "uniform"), **no_spread)
    zeniths = np.array([zenith_radiance(THREE_NM, sun) for sun in (20.0, 30.0, 40.0, 50.0, 60.0)])
    np.testing.assert_allclose(u / value, np.sqrt(np.mean((zeniths - 1.0) ** 2)), 0.3)


def panel_line(level: float = 0.02) -> xr.Dataset:
    # Return a line of black paint without its mirrored sky, seen to both sides of a flight to the north
    lines, columns = 6, 9
    cube = np.full((lines, THREE_NM.size, columns), level, np.float32)
    rows = {"latitude": PLACE[0], "longitude": PLACE[1], "roll": 1.0, "pitch": 0.0, "heading": 0.0}
    degree = {"units": "degree"}
    return xr.Dataset(
        {
            "reflectance": (("along_track", "band", "cross_track"), cube, {"units": "1"}),
            "look_angle": ("cross_track", np.linspace(-20.0, 20.0, columns), degree),
            **{name: ("along_track", np.full(lines, value), degree) for name, value in rows.items()},
        },
        {"wavelength": ("band", THREE_NM, {"units": "nm"}), "time": ("along_track", np.full(lines, STAMP))},
    )


def test_every_pixel_loses_the_sky_of_its_direction(no_compute: Any) -> None:
    line = panel_line()
    bare = hp.surroundings.remove_mirrored_sky(line, diffuse="model")
    removed = 0.02 - bare.reflectance.values[2].T
    views = line.look_angle.values - 1.0  # rolled to the right
    for view, taken in zip(views, removed, strict=True):
        # columns to the right of a flight to the north see from the west
        camera = 270.0 if view > 0.0 else 90.0
        np.testing.assert_allclose(taken, truth(SUN, abs(view), camera - AZIMUTH, 0.1), atol=5e-4)
    assert np.ptp(removed[:, 0]) > 0.004
    assert bare.reflectance.attrs["mirrored_sky_removed"].endswith("that a level panel mirrors")
    # the same from the view of every pixel, in any chunks, and of signatures
    view = np.broadcast_to(views, (6, 9))
    planes = {
        "view_zenith": (("along_track", "cross_track"), np.abs(view), {"units": "degree"}),
        "view_azimuth": (
            ("along_track", "cross_track"),
            np.where(view > 0, 270.0, 90.0),
            {"units": "degree"},
        ),
    }
    located = line.drop_vars(["look_angle", "roll", "pitch", "heading"]).assign(planes)
    chunked = located.assign(reflectance=located.reflectance.chunk(along_track=4, cross_track=5))
    # stores divide coordinates otherwise than cubes
    chunked = chunked.assign_coords(frame=("along_track", da.arange(6, chunks=3)))
    with no_compute():
        lazy = hp.surroundings.remove_mirrored_sky(chunked, diffuse="model")
    again = hp.surroundings.remove_mirrored_sky(located, diffuse="model")
    np.testing.assert_array_equal(lazy.reflectance.values, again.reflectance.values)
    np.testing.assert_allclose(again.reflectance, bare.reflectance, atol=1e-6)
    edge = hp.Regions((hp.Region("edge", [(8, 0), (8, 5), (8.4, 5), (8.4, 0)]),))
    signature = hp.extract_signatures(line, edge, specular_sky=True, diffuse="model", coat=False)
    np.testing.assert_allclose(signature.reflectance[0], bare.reflectance[2, :, 8], atol=2e-4)
    # without its azimuth a view is not used
    upright = hp.surroundings.remove_mirrored_sky(line.drop_vars("heading"), diffuse="model")
    np.testing.assert_allclose(0.02 - upright.reflectance[2, :, 8], truth(SUN, 0.0, 0.0, 0.1), atol=5e-4)
    assert upright.reflectance.attrs["mirrored_sky_removed"].endswith("at the zenith")


# --- Mirror images of the sun as spots: told from flakes' broad lobe, from stains of light and from edges


NM = wavelengths(48)
ZENITH = 35.0
DIRECT = 1.0 - diffuse_fraction(NM, ZENITH)
ASPHALT = smooth_edge(NM, 600.0, 0.07, 0.12, 150.0)
SILVER = smooth_edge(NM, 500.0, 0.28, 0.32, 200.0)
RED = smooth_edge(NM, 600.0, 0.04, 0.6)
SPOT = (40, 52)
Mask = npt.NDArray[np.bool_]


def panel(paint: Any, flakes: float, peak: float, width: float = 0.8) -> tuple[Any, Mask]:
    # Return a panel on asphalt with a broad lobe of flakes and a spot of the sun, and where that matters
    y, x = np.mgrid[:80, :104]
    far = (y - SPOT[0]) ** 2 + (x - SPOT[1]) ** 2
    inside = (y > 10) & (y < 70) & (x > 12) & (x < 92)
    broad = flakes * np.exp(-far / (2.0 * 14.0**2))
    spot = np.where(inside, peak * np.exp(-far / (2.0 * width**2)), 0.0)
    cube = np.where(inside[..., None], paint + broad[..., None] * DIRECT, ASPHALT) + spot[..., None] * DIRECT
    return cube, spot * DIRECT.mean() > 0.04 * (cube.mean(axis=2) - spot * DIRECT.mean())


def flagged(cube: Any, **variables: Any) -> Mask:
    line = as_line(cube, NM, snr=100.0, seed=7)
    if variables:
        line = line.assign({name: (("along_track", "cross_track"), bits) for name, bits in variables.items()})
    bits = hp.surroundings.flag(line, sun_zenith=ZENITH).quality.values
    return np.asarray((bits & int(Quality.GLINT)) > 0)


@pytest.mark.parametrize(("paint", "flakes"), [(SILVER, 0.5), (SILVER, 0.0), (RED, 0.0), (0.1 * SILVER, 0.1)])
def test_the_spot_is_glint_and_the_flakes_around_it_are_not(paint: Any, flakes: float) -> None:
    cube, true = panel(paint, flakes, 20.0)
    found = flagged(cube)
    assert (found & true).sum() >= 0.7 * true.sum() > 5
    assert (found & ~true).sum() <= 0.1 * found.sum()


@pytest.mark.parametrize(("across", "along"), [(0.8, 8.0), (4.0, 7.0)], ids=["a streak", "a wide lobe"])
def test_a_streak_and_a_wide_lobe__are_glint_to_their_ends(across: float, along: float) -> None:
    """Rationale: body parts that curve one way only stretch the mirrored sun; rough coats widen it."""
    cube, _ = panel(SILVER, 0.0, 0.0)
    y, x = np.mgrid[:80, :104]
    far = ((y - SPOT[0]) / across) ** 2 + ((x - SPOT[1]) / along) ** 2
    spot = 12.0 * np.exp(-far / 2.0)
    found, true = flagged(cube + spot[..., None] * DIRECT), spot * DIRECT.mean() > 0.04 * SILVER.mean()
    assert (found & true).sum() >= 0.6 * true.sum() > 50
    assert (found & ~true).sum() <= 0.05 * found.sum()


def test_flakes_and_red_spots_are_no_glint() -> None:
    cube, _ = panel(SILVER, 0.6, 0.0)
    assert not flagged(cube).any()
    cube, _ = panel(SILVER, 0.0, 0.0)
    cube[39:42, 51:54] += 2.0 * RED  # a lamp's glass
    assert not flagged(cube).any()


def test_saturated_pixels_and_models_of_before() -> None:
    cube, true = panel(SILVER, 0.3, 60.0, 1.0)
    bits = np.zeros(true.shape, np.uint16)
    saturated = cube.max(axis=2) > 2.0
    assert saturated.sum() > 5
    cube[saturated] = np.nan
    bits[saturated] = int(Quality.SATURATED)
    found = flagged(cube, quality=bits)
    assert found[saturated].all()
    assert (found & true).sum() >= 0.7 * true.sum()
    # a white car that is saturated all over is none
    cube, _ = panel(SILVER, 0.0, 0.0)
    cube[20:60, 20:80] = np.nan
    bits[:] = 0
    bits[20:60, 20:80] = int(Quality.SATURATED)
    assert not flagged(cube, quality=bits).any()
    cube, _ = panel(RED, 0.0, 20.0)
    line = as_line(cube, NM, snr=100.0)
    model = hp.surroundings.survey(line, sun_zenith=ZENITH)
    before = hp.surroundings.SceneModel.from_dataset(model.to_dataset().drop_vars("lobe"))
    assert (before.lobe == 1).all()
    now, then = (hp.surroundings.flag(line, each).quality.values & 64 for each in (model, before))
    assert (then[now > 0] > 0).all()


# --- The attribute that says whether reflectance holds what a clear coat mirrors, from pixel to simulator


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    return hp.reflectance(simulate_line(lines=32, bands=40, columns=24, smile_nm=0.0))


@pytest.fixture(scope="module")
def regions() -> hp.Regions:
    return hp.Regions((hp.Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]),))


def told(library: xr.Dataset) -> object:
    return library.reflectance.attrs["mirror_reflection"]


def test_signatures_say_it(line: xr.Dataset, regions: hp.Regions, tmp_path: Path) -> None:
    seen = hp.extract_signatures(line, regions)
    removed = hp.extract_signatures(line, regions, specular_sky=True, sun_zenith=40.0, diffuse="model")
    afterwards = hp.surroundings.remove_mirrored_sky(seen, sun_zenith=40.0)
    before = hp.extract_signatures(
        hp.surroundings.remove_mirrored_sky(line, sun_zenith=40.0, diffuse="model"), regions
    )
    assert [told(each) for each in (seen, removed, afterwards, before)] == ["included", *["excluded"] * 3]
    made = hp.write_dirsig(afterwards, tmp_path / "dirsig", specular=0.02)
    assert made.attrs["mirror_reflection"] == "excluded"
    with pytest.raises(SchemaError, match="coat-counted-twice"):
        hp.write_dirsig(seen, tmp_path / "twice", specular=0.02)
    lines = {"a": line, "b": hp.surroundings.remove_mirrored_sky(line, sun_zenith=40.0, diffuse="model")}
    corners = [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]
    both = hp.Regions(tuple(hp.Region(f"grass {name}", corners, flightline=name) for name in lines))
    assert told(hp.extract_signatures(lines, both)) == "included"
    body = hp.surroundings.remove_mirrored_sky(hp.extract_signatures(line, regions), sun_zenith=40.0)
    darker = hp.paints.shade_paints(body, [2.0])
    assert told(darker) == "excluded"
    assert (darker.reflectance <= body.reflectance.clip(min=1e-3).values).all()
    assert told(hp.paints.sample_paints(body, 5)) == "excluded"
