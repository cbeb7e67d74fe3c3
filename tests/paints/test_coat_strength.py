"""A coat's strength from the pixels of a curved panel, built by plain mirror geometry."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from oracles.disort_sky import relative_sky
from oracles.fresnel import plain_fresnel
from scipy.interpolate import CubicSpline
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.light.clear_sky import radiance_towards_sun, sunward_gain
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.paints.signatures.extraction import strength_of

NM = np.linspace(420.0, 980.0, 60)


def pixels(
    body: np.ndarray, strength: float, sun: float, *, noise: float = 1e-4, seed: int = 0
) -> np.ndarray:
    # Return pixels of a panel that leans by some degrees everywhere, seen from straight above
    rng = np.random.default_rng(seed)
    lean, around = np.radians(rng.normal(0.0, 2.5, 200)), rng.uniform(0.0, 2.0 * np.pi, 200)
    normal = np.stack([np.sin(lean) * np.cos(around), np.sin(lean) * np.sin(around), np.cos(lean)], axis=1)
    s = np.radians(sun)
    towards = np.array([np.sin(s), 0.0, np.cos(s)])
    mirrored = 2.0 * normal[:, 2:] * normal - np.array([0.0, 0.0, 1.0])
    azimuth = np.arctan2(mirrored[:, 1], mirrored[:, 0])
    knots = np.linspace(NM[0], NM[-1], 15)
    sky = CubicSpline(knots, [relative_sky(nm, sun, mirrored[:, 2], azimuth) for nm in knots])(NM).T
    f = diffuse_fraction(NM, sun)
    c = (normal @ towards / np.cos(s))[:, None]
    seen = body * (c * (1.0 - f) + (1.0 + sunward_gain(NM, sun) * (c - 1.0)) * f)
    seen = seen + strength * 0.04 * f * sky
    return seen + noise * rng.standard_normal(seen.shape)


@pytest.mark.parametrize(
    ("sun", "strength"), [(35.0, 0.6), (35.0, 1.4), (50.0, 1.0), (60.0, 0.6), (60.0, 1.4)]
)
def test_black_panels_tell_their_coat(sun: float, strength: float) -> None:
    body = 0.012 + 0.008 * (NM - 420.0) / 560.0
    split = diffuse_fraction(NM, sun)
    answers = [strength_of(pixels(body, strength, sun, seed=seed), NM, split, sun) for seed in range(16)]
    # under a low sun the gradient around the zenith is weak: one of sixteen remains too uncertain
    answers = [answer for answer in answers if "uncertain by 0." not in answer[2]]
    assert len(answers) == 16 or (sun == 60.0 and len(answers) == 15)
    assert {reason for _, _, reason in answers} == {""}
    strengths, u = (np.array([answer[part] for answer in answers]) for part in (0, 1))
    assert u.max() < 0.3
    assert np.mean(np.abs(strengths - strength) < 2.0 * u) > 0.85  # 95 %, of sixteen
    assert abs(strengths.mean() - strength) < 0.1 * strength
    # where a coat is not what its index says, less is left of it than by the index
    sky = 0.04 * split * radiance_towards_sun(NM, sun, 0.0)
    seen = pixels(body, strength, sun).mean(axis=0)
    left = [np.abs(seen - amount * sky - body).mean() for amount in (np.mean(strengths), 1.0)]
    assert strength == 1.0 or left[0] < 0.6 * left[1]


def test_what_cannot_be_told_is_refused_with_a_reason() -> None:
    white = np.full(NM.size, 0.7)
    dark = np.full(NM.size, 0.015)
    cases = {
        "too bright": (pixels(white, 1.0, 45.0, noise=2e-3), 45.0),
        "expected 40": (pixels(dark, 1.0, 45.0)[:20], 45.0),
        "the sun at 10 degrees": (pixels(dark, 1.0, 45.0), 10.0),
        "first principal component": (pixels(dark, 1.0, 45.0, noise=0.02), 45.0),
        "neither lean nor mirrored sky": (
            dark + np.random.default_rng(0).normal(size=(100, 1)) * 0.01 * np.sin(NM / 20.0), 45.0,
        ),
    }  # fmt: skip
    for text, (members, sun) in cases.items():
        strength, u, reason = strength_of(members, NM, diffuse_fraction(NM, sun), sun)
        assert np.isnan(strength)
        assert np.isnan(u)
        assert text in reason


def test_strength__is_as_uncertain_as_leans_of_higher_order_make_it() -> None:
    # Without noise the errors over all suns are those of the first order, on average as large as stated
    errors = []
    for sun in (30.0, 35.0, 45.0, 55.0, 60.0):
        members = pixels(np.full(NM.size, 0.012), 1.0, sun, noise=1e-6)
        strength, u, _ = strength_of(members, NM, diffuse_fraction(NM, sun), sun)
        errors.append((strength - 1.0) / u)
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_strength__is_reported_where_it_distinguishes_coats() -> None:
    # A freshly polished coat has a strength of 1, a worn one of 0.4 and less: two uncertainties apart
    reported, refused = [], []
    for noise in np.linspace(1e-4, 8e-4, 8):
        members = pixels(np.full(NM.size, 0.02), 1.0, 45.0, noise=noise)
        _, u, reason = strength_of(members, NM, diffuse_fraction(NM, 45.0), 45.0)
        (refused if reason else reported).append(float(reason.split()[-1]) if reason else u)
    assert 0.2 < max(reported) <= 0.3 <= min(refused) < 0.5


# --- signatures of the body under a clear coat: what is put into a line by plain arithmetic comes back ----


NM_PAINTS = np.linspace(420.0, 980.0, 12)
BODY = 0.3 + 0.4 * (NM_PAINTS - 420.0) / 560.0
STAMP, PLACE = np.datetime64("2024-06-21T16:20", "ns"), (50.0, 0.0)
SUN = float(solar_position(STAMP, *PLACE)[0])
CORNERS = [(0, 0), (0, 7), (7, 7), (7, 0)]


def line(sky: float, body: np.ndarray = BODY, n: float = 1.5) -> xr.Dataset:
    # Return a coated panel under a clear sky of which the coat reflects ``sky``
    f = diffuse_fraction(NM_PAINTS, SUN)
    level, sunny = (plain_fresnel(angle, n) for angle in (0.0, np.radians(SUN)))
    share = ((1.0 - f) * (1.0 - sunny) + f * (1.0 - sky)) / (1.0 - level)
    above = np.array([float(relative_sky(nm, SUN, np.array(1.0), np.array(0.0))) for nm in NM_PAINTS])
    seen = share * body + level * f * above
    cube = np.broadcast_to(seen[:, None].astype(np.float32), (8, NM_PAINTS.size, 8)).copy()
    rows = {name: ("along_track", np.full(8, value), {"units": "degree"})
            for name, value in zip(("latitude", "longitude"), PLACE, strict=True)}  # fmt: skip
    return xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), cube, {"units": "1"})},
        {
            "wavelength": ("band", NM_PAINTS, {"units": "nm"}),
            "time": ("along_track", np.full(8, STAMP)),
            **rows,
        },
    )


def signature(seen: xr.Dataset, **options: Any) -> xr.Dataset:
    regions = hp.Regions((hp.Region("hood", CORNERS, properties={"kind": "panel"}),))
    return hp.extract_signatures(seen, regions, specular_sky=True, diffuse="model", **options)


def mean_sky(n: float) -> np.ndarray:
    # Return a clear sky's mean of Fresnel's reflectance, by sums over another reading of its tables
    zenith, azimuth = np.meshgrid(
        np.radians(np.arange(0.5, 90.0)), np.radians(np.arange(1.0, 180.0, 2.0)), indexing="ij"
    )
    lost = plain_fresnel(zenith, n)
    skies = [
        np.cos(zenith) * np.sin(zenith) * relative_sky(nm, SUN, np.cos(zenith), azimuth) for nm in NM_PAINTS
    ]
    return np.array([(sky * lost).sum() / sky.sum() for sky in skies])


@pytest.mark.parametrize("n", [1.5, 1.47])
def test_the_body_comes_back(n: float) -> None:
    seen = line(mean_sky(n), n=n)
    body = signature(seen, coat_index=n)
    assert SUN > 50.0
    np.testing.assert_allclose(body.reflectance[0], BODY, rtol=2e-3)
    np.testing.assert_allclose(body.member_reflectance[0, 0], BODY, rtol=2e-3)
    attrs = body.reflectance.attrs
    assert attrs["quantity"] == "body reflectance factor under the clear coat"
    assert attrs["specular_component"] == attrs["mirror_reflection"] == "excluded"
    assert attrs["coat_corrected"].startswith(f"clear coat of index {n:g}")
    assert "coat_corrected" in body.attrs["corrections"]
    through = signature(seen, coat=False, coat_index=n)
    assert through.reflectance.attrs["quantity"] == "reflectance factor of the body through its clear coat"
    np.testing.assert_allclose(through.reflectance / body.reflectance, body.coat_transmission, rtol=1e-5)
    assert "coat_transmission" not in through
    # what of the index, the lean and the sky is not known
    assert 0.001 < float(body.coat_transmission_u.min()) < float(body.coat_transmission_u.max()) < 0.02


def test_ground_has_no_coat_and_refusals(no_compute: Any) -> None:
    seen = line(0.1)
    corners = {"hood": {}, "road": {"kind": "asphalt"}}
    regions = hp.Regions(tuple(hp.Region(name, CORNERS, properties=own) for name, own in corners.items()))
    both = hp.extract_signatures(seen, regions, specular_sky=True, diffuse="model")
    assert float((both.reflectance[0] / both.reflectance[1]).min()) > 1.02
    assert (both.coat_transmission[1] == 1.0).all()
    assert (both.coat_transmission_u[1] == 0.0).all()
    assert both.reflectance.dtype == np.float32
    expect_error(SchemaError, "mirrored-sky-included", lambda: hp.surroundings.correct_coat(seen))
    bare = hp.surroundings.remove_mirrored_sky(seen, diffuse="model")
    body = hp.surroundings.correct_coat(bare, diffuse="model")
    expect_errors(
        (SchemaError, "corrected-before", lambda: hp.surroundings.correct_coat(body)),
        (SchemaError, "correct the coat last", lambda: hp.surroundings.remove_mirrored_sky(body)),
        (SchemaError, r"index=0\.9, expected 1", lambda: hp.surroundings.correct_coat(bare, index=0.9)),
    )
    seen = seen.assign(reflectance=seen.reflectance.chunk(along_track=4))
    seen = hp.surroundings.remove_mirrored_sky(seen, diffuse="model")
    with no_compute():
        body = hp.surroundings.correct_coat(seen, diffuse="model")
    assert body.reflectance.dtype == np.float32


def test_a_library_is_corrected_as_an_extraction() -> None:
    seen = line(0.1)
    once = signature(seen)
    again = hp.surroundings.correct_coat(signature(seen, coat=False))
    np.testing.assert_allclose(again.reflectance, once.reflectance, rtol=1e-6)
    of_line = hp.surroundings.correct_coat(
        hp.surroundings.remove_mirrored_sky(seen, diffuse="model"), diffuse="model"
    )
    np.testing.assert_allclose(of_line.reflectance[3, :, 3], once.reflectance[0], rtol=1e-5)
    bare = signature(seen, coat=False)
    uncertain = bare.assign(
        reflectance_u_systematic=(
            ("signature", "band"),
            np.full((1, NM_PAINTS.size), 0.003, np.float32),
            {"units": "1"},
        )
    )
    u = hp.surroundings.correct_coat(uncertain)
    c, uc = u.coat_transmission, u.coat_transmission_u
    # of the body what the coat transmits, and of black paint the sky in its mirror
    by_coat, by_sky = u.reflectance * uc / c, bare.reflectance_u_coat / c
    np.testing.assert_allclose(u.reflectance_u_systematic, np.hypot(0.003 / c, by_coat), rtol=1e-5)
    np.testing.assert_allclose(u.reflectance_u_coat, np.hypot(by_coat, by_sky), rtol=1e-5)
    # the sky that was removed from a line is as uncertain
    plain = hp.extract_signatures(seen, hp.Regions((hp.Region("hood", CORNERS),)), coat=False)
    both = plain.assign(reflectance_u_systematic=uncertain.reflectance_u_systematic)
    both = hp.surroundings.remove_mirrored_sky(both, diffuse="model")
    np.testing.assert_allclose(both.reflectance_u_coat, bare.reflectance_u_coat, rtol=1e-3)
    expected = np.hypot(0.003, both.reflectance_u_coat)
    np.testing.assert_allclose(both.reflectance_u_systematic, expected, rtol=1e-5)
