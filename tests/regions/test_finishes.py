"""The finish of a roof from how its light changes: panels of solid paint and of flakes in closed form."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import hyperpaint as hp
from hyperpaint.regions.proposals.candidates import Measures, Picture, Piece
from hyperpaint.regions.proposals.cars import Level, Verdict, change_with_lean, difference_of, judge_finish
from hyperpaint.surroundings import SceneModel

Floats = npt.NDArray[np.float64]
NM = np.linspace(405.0, 995.0, 48)


@pytest.fixture(scope="module")
def models() -> dict[float, SceneModel]:
    # Return models of a clear sky by the sun's zenith
    import xarray as xr

    seen = np.full((30, NM.size, 30), 0.2)
    cube = ("along_track", "band", "cross_track"), seen.astype(np.float32), {"units": "1"}
    line = xr.Dataset({"reflectance": cube}, {"wavelength": ("band", NM, {"units": "nm"})})
    return {zenith: hp.surroundings.survey(line, sun_zenith=zenith) for zenith in (25.0, 45.0, 59.0)}


def picture_of(model: SceneModel, zenith: float, flakes: float) -> tuple[Picture, Floats]:
    # Return a red roof whose light changes by 40 % across it, and its brightness over its middle's
    # A share ``flakes`` of the change has the colour of the light
    nm = model.channel_wavelength
    diffuse = model.diffuse_fraction
    body = np.where(nm > 600.0, 0.5, 0.06)
    lean = np.linspace(-0.2, 0.2, 40)[:, None, None] * np.ones((1, 40, 1))
    change = (1.0 - flakes) * body + flakes * float(body.mean())
    sky = 0.04 * diffuse * model.zenith_radiance
    seen = body + lean * (1.0 - diffuse) * change + sky
    relative = ((seen - sky) @ body) / float(body @ body)
    return Picture(model, seen.astype(np.float32), {}, zenith), relative


def stated(
    model: SceneModel, zenith: float, level: Level, difference: tuple[float, float] | None, colour: Any
) -> str:
    measures = Measures(np.ones((8, 8), bool), np.asarray(colour, np.float64), {}, pixels=64)
    verdict = Verdict(Piece(0, (0, 0), measures.usable), measures, "roof")
    judge_finish(verdict, Picture(model, np.empty(0), {}, zenith), level, difference)
    assert (verdict.finish == "unknown") == (not verdict.reasons)
    return verdict.finish


@pytest.mark.parametrize("flakes", [0.0, 0.25, 0.6])
def test_difference__has_the_flat_share_of_flakes(models: dict[float, SceneModel], flakes: float) -> None:
    # Expected: the share that is put in, whatever the sky that is mirrored, within 0.02
    picture, relative = picture_of(models[45.0], 45.0, flakes)
    difference = difference_of(Piece(0, (0, 0), np.ones(relative.shape, bool)), picture, relative)
    assert difference is not None
    assert difference[0] == pytest.approx(flakes, abs=0.02)
    assert 0.1 < difference[1] < 0.4


def test_difference__needs_pixels(models: dict[float, SceneModel]) -> None:
    picture, relative = picture_of(models[45.0], 45.0, 0.0)
    assert difference_of(Piece(0, (0, 0), np.ones(relative.shape, bool)), picture, 3.0 * relative) is None


@pytest.mark.parametrize(
    ("zenith", "across", "along", "flat_share", "coloured", "expected"),
    [
        (
            45.0,
            1.0,
            1.0,
            0.0,
            False,
            "unknown",
        ),  # so do flakes look far from their lobe
        (45.0, 4.0, 1.0, 0.0, False, "metallic"),
        (45.0, 1.0, 8.0, 0.0, False, "metallic"),
        (45.0, 1.0, 1.0, 0.05, True, "solid"),
        (45.0, 1.0, 1.0, 0.20, True, "unknown"),
        (59.0, 1.0, 1.0, 0.05, True, "unknown"),  # far from their lobe flakes add little to what changes
        (45.0, 1.0, 1.0, 0.50, True, "metallic"),
        (45.0, 1.6, 1.0, 0.05, True, "unknown"),  # it changes more than a solid paint
        (25.0, 0.5, 0.5, 0.0, False, "solid"),  # flakes would change by more so near their lobe
        (25.0, 2.0, 2.0, 0.0, False, "unknown"),
        (25.0, 1.0, 9.0, 0.0, False, "unknown"),  # the gloss of a rough coat changes as much along a roof
        (25.0, 8.0, 8.0, 0.0, False, "metallic"),
    ],
)
def test_finish__is_stated_where_there_is_evidence(
    models: dict[float, SceneModel],
    zenith: float,
    across: float,
    along: float,
    flat_share: float,
    coloured: bool,
    expected: str,
) -> None:
    # Expected: by change with lean over a solid paint's, and by the colour of the change
    model = models[zenith]
    solid = Picture(model, np.empty(0), {}, zenith).direct_share * change_with_lean(zenith)
    level = Level(1.0, 0.01, along * solid, across * solid)
    colour = np.where(model.channel_wavelength > 600.0, 0.5, 0.06) if coloured else np.full(24, 0.3)
    assert stated(model, zenith, level, (flat_share, 0.3), colour) == expected


def test_finish__of_a_dark_roof_or_under_clouds_is_unknown(models: dict[float, SceneModel]) -> None:
    # Expected: nothing is stated of 0.02, nor where the sky is all the light there is
    from dataclasses import replace

    level = Level(1.0, 0.01, 9.0, 9.0)
    assert stated(models[45.0], 45.0, level, None, np.full(24, 0.02)) == "unknown"
    covered = replace(models[45.0], diffuse_fraction=np.ones_like(models[45.0].diffuse_fraction))
    assert stated(covered, 45.0, level, None, np.full(24, 0.3)) == "unknown"


@pytest.mark.parametrize("zenith", [0.0, 30.0, 60.0, 80.0])
def test_change_with_lean__is_the_tangent_and_the_coat(zenith: float) -> None:
    # Expected: tan(zenith) without a coat; with one more, by what Fresnel's reflectance rises there
    from hyperpaint.light.coat_transmission import interface_reflectance

    reflected = interface_reflectance([zenith, zenith + 0.1])
    coat = float(np.diff(reflected)[0]) / np.radians(0.1) / float(1.0 - reflected.mean())
    assert change_with_lean(zenith) == pytest.approx(np.tan(np.radians(zenith)) + coat, rel=0.02, abs=1e-3)
