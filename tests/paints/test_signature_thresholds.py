"""Thresholds of signatures: inputs on both sides of each, so that twice or half of it changes a result."""

import json
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.light.clear_sky import sunward_gain
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.paints.signatures.extraction import (
    change_over_crown,
    flop_of,
    strength_of,
    with_aspecular_geometry,
)
from hyperpaint.paints.signatures.pixel_statistics import summarise

Floats = npt.NDArray[np.float64]
NM = np.linspace(420.0, 980.0, 60)
ZIGZAG = np.resize([1.0, -1.0], 60)
EVERY = np.ones(60, bool)

# --- members: centre, flop, crown --------------------------------------------------------------------------


@pytest.mark.parametrize(("sd", "is_trimmed"), [(2.8, False), (3.3, True)])
def test_trimmed_mean__leaves_out_values_beyond_three_standard_deviations(
    sd: float, is_trimmed: bool
) -> None:
    # Quantiles of a normal distribution within two standard deviations, and one other value
    normal = np.sort(np.random.default_rng(8).normal(size=4001))
    normal = np.concatenate([values := normal[np.abs(normal) < 2.0], -values])
    centre = summarise(np.append(normal, sd)[:, None], "trimmed_mean")["reflectance"][0]
    assert (abs(centre) < 1e-9) == is_trimmed


def test_flop__is_of_the_means_of_the_outer_fifths() -> None:
    # Levels from 0.7 to 1.3 in equal steps: the means of the outer fifths are 0.76 and 1.24
    members = np.linspace(0.7, 1.3, 1001)[:, None] * np.ones(60)
    assert flop_of(members, EVERY)[1] == pytest.approx(0.48, rel=0.01)


@pytest.mark.parametrize(("count", "is_known"), [(22, True), (18, False)])
def test_flop__needs_twenty_members(count: int, is_known: bool) -> None:
    assert np.isfinite(flop_of(np.linspace(0.7, 1.3, count)[:, None] * np.ones(60), EVERY)[1]) == is_known


@pytest.mark.parametrize(("error", "is_turned"), [(0.09, True), (0.11, False)])
def test_members_of_flakes__are_brought_to_one_angle_where_they_fit(error: float, is_turned: bool) -> None:
    # Most differ by the error from flakes whose brightness changes with the lean
    lean = np.linspace(-0.5, 0.5, 400)
    body, lobe = np.full(60, 0.2), 1.6 + 0.3 * np.cos(NM / 70.0)
    sign = np.resize([1.0, -1.0, -1.0, 1.0], 400)[:, None] * ZIGZAG
    members = body * np.exp(lean[:, None] * lobe) * (1.0 + error * sign)
    library = xr.Dataset(
        {
            "member_reflectance": (("signature", "member", "band"), members[None]),
            "reflectance": (("signature", "band"), body[None]),
            "diffuse_fraction": (("signature", "band"), diffuse_fraction(NM, 45.0)[None]),
            **{
                name: ("signature", [angle])
                for name, angle in (("sun_zenith", 45.0), ("view_zenith", 0.0), ("relative_azimuth", 0.0))
            },
        },
        {"good": ("band", EVERY)},
    )
    turned = with_aspecular_geometry(library).member_reflectance.values[0]
    assert (np.ptp(turned.mean(axis=1)) < 0.05) == is_turned


def roof(shape: tuple[int, int], slope: float = 0.0, dead: float = 0.0) -> xr.Dataset:
    # A roof whose brightness changes by a slope over half its width; a share of its members lacks a band
    y, x = (axis.ravel() for axis in np.indices(shape))
    half = (shape[0] - 1) / 2.0
    members = 0.3 * np.exp(slope * (y - half) / half)[:, None] * np.ones(60)
    members[: round(dead * len(y)), 7] = np.nan
    return xr.Dataset(
        {
            "member_reflectance": (("member", "band"), members),
            "member_along_track": ("member", y),
            "member_cross_track": ("member", x),
        }
    )


@pytest.mark.parametrize(
    ("paint", "is_known"),
    [
        (roof((20, 27)), True),  # a roof is longer than wide
        (roof((20, 22)), False),
        (roof((5, 8), dead=0.05), True),  # 38 of 40 members, of which 25 are needed
        (roof((5, 8), dead=0.5), True),  # a band that many lack is not used
    ],
)
def test_crown__is_known_of_members_along_a_roof(paint: xr.Dataset, is_known: bool) -> None:
    assert (change_over_crown(paint, EVERY) is not None) == is_known


def test_crown__is_level_near_its_middle() -> None:
    # Within a seventh of half its width: drawn roofs are off by some pixels of thirty
    u, _ = change_over_crown(roof((30, 60), slope=0.3), EVERY) or (0.0, 0.0)
    assert 0.1 < u / 0.3 < 0.22


# --- uncertainty of the level ------------------------------------------------------------------------------


def terms_of(state: str, fraction_u: float) -> Any:
    # Terms of the level of a panel whose brightness is 0.3, between 0.27 and 0.33
    lines, nm = 24, NM[::5]
    cube = np.broadcast_to(np.linspace(0.27, 0.33, 20), (lines, nm.size, 20)).astype(np.float32)
    size = lines, nm.size
    line = xr.Dataset(
        {
            "reflectance": (("along_track", "band", "cross_track"), cube, {"units": "1"}),
            "diffuse_fraction": (("along_track", "band"), np.full(size, 0.2), {"units": "1"}),
            "diffuse_fraction_u": (("along_track", "band"), np.full(size, fraction_u), {"units": "1"}),
            "sky_state": ("along_track", np.full(lines, SKY_STATES.index(state), np.int8)),
        },
        {"wavelength": ("band", nm, {"units": "nm"})},
    )
    corners = [(0, 0), (19, 0), (19, lines - 1), (0, lines - 1)]
    regions = hp.Regions((hp.Region("hood", corners, properties={"finish": "solid"}),))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return json.loads(hp.extract_signatures(line, regions, sun_zenith=None).level_terms.item())


@pytest.mark.parametrize(("fraction_u", "least", "most"), [(0.11, 0.0, 0.1), (0.13, 0.4, 0.7)])
def test_broken_clouds__leave_the_sun_free_or_cover_it(fraction_u: float, least: float, most: float) -> None:
    # A covered sun takes half of the light and more
    assert least < terms_of("broken", fraction_u)["broken clouds"] < most


def test_level__lies_anywhere_between_the_quartiles() -> None:
    # Expected: the standard deviation of a uniform distribution over half of the change
    (part,) = (value for name, value in terms_of("clear", 0.02).items() if name.startswith("its change over"))
    assert part == pytest.approx(np.std(np.linspace(-0.05, 0.05, 10_001)), rel=0.02)


# --- strength of a coat ------------------------------------------------------------------------------------


def components(*parts: tuple[Floats, float], count: int = 200) -> Floats:
    # Members of a dark body whose differences are some spectra, with shares of their variance
    scores = np.linalg.qr(np.random.default_rng(5).normal(size=(count, len(parts))))[0]
    scores -= scores.mean(axis=0)
    scores = np.linalg.qr(scores)[0]
    sizes = [np.sqrt(share) * spectrum / np.linalg.norm(spectrum) for spectrum, share in parts if share > 0.0]
    return np.asarray(np.full(60, 0.02) + 0.02 * scores[:, : len(sizes)] @ np.stack(sizes))


def leaning(sun: float) -> Floats:
    # Change of a dark body's spectrum with lean
    split = diffuse_fraction(NM, sun)
    return np.asarray(1.0 - split + sunward_gain(NM, sun) * split)


@pytest.mark.parametrize(
    ("sun", "count", "share", "unexplained", "words"),
    [
        (45.0, 42, 1.0, 0.0, ""),
        (45.0, 38, 1.0, 0.0, "38 pixels"),
        (27.0, 200, 1.0, 0.0, ""),
        (23.0, 200, 1.0, 0.0, "the sun at 23"),
        (68.0, 200, 1.0, 0.0, ""),
        (72.0, 200, 1.0, 0.0, "the sun at 72"),
        (45.0, 200, 0.53, 0.0, ""),
        (45.0, 200, 0.47, 0.0, "the first principal component"),
        (45.0, 200, 1.0, 0.045, ""),
        (45.0, 200, 1.0, 0.055, "neither lean nor mirrored sky"),
    ],
)
def test_strength_of_a_coat__is_measured_where_lean_and_sky_explain_the_pixels(
    sun: float, count: int, share: float, unexplained: float, words: str
) -> None:
    smooth = leaning(sun) / np.linalg.norm(leaning(sun))
    rough = ZIGZAG / np.sqrt(60.0)
    first = np.sqrt(1.0 - unexplained) * smooth + np.sqrt(unexplained) * rough
    rest = [np.roll(np.resize([1.0, 1.0, -1.0, -1.0], 60), k) * np.sin(NM / 40.0 + k) for k in range(2)]
    members = components((first, share), *((part, (1.0 - share) / 2.0) for part in rest), count=count)
    reason = strength_of(members, NM, diffuse_fraction(NM, sun), sun)[2]
    refusals = ("pixels, expected", "the sun at", "principal component", "neither lean")
    assert words in reason
    assert any(text in reason for text in refusals) == bool(words)
