"""A coat's strength from the pixels of a curved panel, built by plain mirror geometry."""

import numpy as np
import pytest
from oracles.disort_sky import relative_sky
from scipy.interpolate import CubicSpline

from hyperpaint.light.clear_sky import radiance_towards_sun, sunward_gain
from hyperpaint.light.sun import diffuse_fraction
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
