"""The finish of a roof from how its light changes: panels of solid paint and of flakes in closed form."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.regions.proposals import (
    Level,
    Measures,
    Picture,
    Piece,
    Verdict,
    change_with_lean,
    difference_of,
    doubt_about_clouds,
    judge_finish,
    sunny_lines,
)
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.model import SHADED

Floats = npt.NDArray[np.float64]
NM = np.linspace(405.0, 995.0, 48)


@pytest.fixture(scope="module")
def models() -> dict[float, SceneModel]:
    # Return models of a clear sky by the sun's zenith
    import xarray as xr

    seen = np.full((30, NM.size, 30), 0.2)
    cube = ("along_track", "band", "cross_track"), seen.astype(np.float32), {"units": "1"}
    line = xr.Dataset({"reflectance": cube}, {"wavelength": ("band", NM, {"units": "nm"})})
    return {
        zenith: hp.surroundings.survey(line, sun_zenith=zenith) for zenith in (15.0, 25.0, 45.0, 59.0, 70.0)
    }


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
    return Picture(model, seen.astype(np.float32), {}, zenith), (((seen - sky) @ body) / float(body @ body))


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
    for pixels in (55, 65):  # of 60 at least
        piece = Piece(0, (0, 0), np.arange(relative.size).reshape(relative.shape) % 1600 < pixels)
        assert (difference_of(piece, picture, np.ones_like(relative)) is None) == (pixels < 60)


@pytest.mark.parametrize(
    ("expected", "changes"),
    [
        ("unknown", {}),  # so do flakes look far from their lobe
        (
            "unknown",
            {"across": 2.1},
        ),  # flakes change by 1.7 times a solid paint, and 0.5, or more across a roof
        ("metallic", {"across": 2.4}),
        ("unknown", {"along": 5.3}),  # and by five times along it
        ("metallic", {"along": 5.8}),
        ("solid", {"share": 0.10, "low": 0.06}),  # 0.13 of the difference of coloured paint is grey
        ("unknown", {"share": 0.15, "low": 0.06}),
        ("unknown", {"share": 0.30, "low": 0.06}),  # a third of that of flakes
        ("metallic", {"share": 0.36, "low": 0.06}),
        ("unknown", {"share": 0.10, "low": 0.30}),  # hardly coloured
        ("unknown", {"share": 0.10, "low": 0.06, "contrast": 0.15}),  # hardly different
        ("unknown", {"share": 0.05, "low": 0.06, "zenith": 59.0}),  # far from their lobe flakes add little
        ("unknown", {"share": 0.05, "low": 0.06, "across": 1.6}),  # it changes more than a solid paint
        ("unknown", {"share": 0.05, "low": 0.06, "along": 3.0}),
        (
            "solid",
            {"zenith": 25.0, "across": 0.9, "along": 0.0, "level": 0.45},
        ),  # flakes would change by more near their lobe
        # but those of white pearl
        ("unknown", {"zenith": 25.0, "across": 0.9, "along": 0.0, "level": 0.55}),
        ("unknown", {"zenith": 25.0, "across": 1.3, "along": 0.0, "level": 0.45}),
        (
            "unknown",
            {"zenith": 15.0, "across": 0.5, "along": 0.0, "level": 0.45},
        ),  # a lobe may have its peak on the roof
        ("unknown", {"zenith": 25.0, "along": 9.0}),  # the gloss of a rough coat changes as much along a roof
        ("metallic", {"zenith": 25.0, "across": 8.0, "along": 8.0}),
        ("unknown", {"zenith": 70.0, "across": 9.0}),  # a roof shades itself
        ("unknown", {"level": 0.055, "across": 9.0}),  # dust and sky dominate
        ("metallic", {"level": 0.065, "across": 9.0}),
        ("unknown", {"direct": 0.45, "across": 9.0}),  # the sky is most of the light there is
        ("metallic", {"direct": 0.55, "across": 9.0}),
    ],
)
def test_finish__is_stated_where_there_is_evidence(
    models: dict[float, SceneModel], expected: str, changes: dict[str, float]
) -> None:
    # Expected: by change with lean over a solid paint's, and by the colour of the change
    case = {
        "zenith": 45.0,
        "across": 1.0,
        "along": 1.0,
        "share": 0.0,
        "contrast": 0.3,
        "level": 0.5,
        **changes,
    }
    model, zenith = models[case["zenith"]], case["zenith"]
    if "direct" in case:
        model = replace(model, diffuse_fraction=np.full(24, 1.0 - case["direct"]))
    solid = Picture(model, np.empty(0), {}, zenith).direct_share * change_with_lean(zenith)
    level = Level(1.0, 0.01, case["along"] * solid, case["across"] * solid)
    colour = np.where(model.channel_wavelength > 600.0, case["level"], case.get("low", case["level"]))
    assert stated(model, zenith, level, (case["share"], case["contrast"]), colour) == expected
    assert stated(model, zenith, level, None, colour) in ("unknown", expected)


@pytest.mark.parametrize("zenith", [0.0, 30.0, 60.0, 80.0])
def test_change_with_lean__is_the_tangent_and_the_coat(zenith: float) -> None:
    # Expected: tan(zenith) without a coat; with one more, by what Fresnel's reflectance rises there
    from hyperpaint.light.coat_transmission import interface_reflectance

    reflected = interface_reflectance([zenith, zenith + 0.1])
    coat = float(np.diff(reflected)[0]) / np.radians(0.1) / float(1.0 - reflected.mean())
    assert change_with_lean(zenith) == pytest.approx(np.tan(np.radians(zenith)) + coat, rel=0.02, abs=1e-3)


# --- Whether the sun was free over a car between broken clouds: by the record, and by a shadow beside it


FEW_NM = np.linspace(405.0, 995.0, 24)
START = np.datetime64("2024-06-21T12:00", "ns")
LINES, CLEAR = 40, 0.1


def seen(fraction: Any = CLEAR, dark: tuple[float, float] = (60.0, 90.0)) -> tuple[xr.Dataset, Any]:
    # Return ground with a shadow of a diffuse fraction, its record with a cloud between two times [s]
    reflectance = np.full((LINES, FEW_NM.size, 60), 0.2)
    reflectance[5:35, :, 20:30] *= fraction
    seconds = np.arange(-60.0, 120.0)
    light = np.where((seconds >= dark[0]) & (seconds <= dark[1]), 0.4, 1.0)
    line = xr.Dataset(
        {
            "reflectance": (("along_track", "band", "cross_track"), reflectance.astype(np.float32)),
            "irradiance": (
                ("irradiance_time", "irradiance_wavelength"),
                np.tile(light[:, None], FEW_NM.size),
            ),
            "diffuse_fraction": (("along_track", "band"), np.full((LINES, FEW_NM.size), CLEAR, np.float32)),
        },
        {
            "wavelength": ("band", FEW_NM, {"units": "nm"}),
            "time": ("along_track", START + (np.arange(LINES) * 1e9).astype("timedelta64[ns]")),
            "irradiance_time": START + (seconds * 1e9).astype("timedelta64[ns]"),
        },
    )
    line["reflectance"].attrs["units"] = "1"
    model = hp.surroundings.survey(line, sun_zenith=30.0)
    model.attrs["sky_states"] = "clear broken"
    shadow = int(model.segment[20, 25])
    ground = int(model.segment[20, 50])
    assert shadow != ground
    state, body, level = model.state.copy(), model.body.copy(), model.ground.copy()
    state[shadow], body[shadow], level[[shadow, ground]] = SHADED, ground, 1
    return line, replace(model, state=state, body=body, ground=level)


def test_sun__is_free_far_from_the_edges_of_clouds() -> None:
    # Rationale: at 8 m/s a shadow comes 80 m far in ten seconds, as far as a car may be from the receiver
    # Expected: lines more than 10 s before a cloud at 30 s are in free sun, others not; clouds that take a
    # quarter of the light leave no shadow to tell them by, and nothing is free
    line, model = seen(dark=(30.0, 90.0))
    sun = sunny_lines(line, model, None, 30.0)
    assert sun is not None
    lines, fraction = sun
    assert (fraction, np.flatnonzero(lines).tolist()) == (pytest.approx(CLEAR), list(range(20)))
    line["irradiance"][7] = np.nan
    assert sunny_lines(line, model, None, 30.0)[0].sum() == 20
    assert not sunny_lines(line.assign(irradiance=line["irradiance"].clip(0.75)), model, None, 30.0)[0].any()
    model.attrs["sky_states"] = "clear"
    assert sunny_lines(line, model, None, 30.0) is None


@pytest.mark.parametrize(("fraction", "word"), [(0.08, ""), (0.25, "a cloud covered the sun here")])
def test_shadow_beside_a_car__shows_a_cloud(fraction: float, word: str) -> None:
    # Rationale: under a cloud, a shadow keeps more of the light that is left
    # Expected: no doubt where it is as dark as the record says; doubt under a cloud, and where no shadow lies
    line, model = seen(fraction)
    channels = line["reflectance"].values.transpose(0, 2, 1)[:, :, : model.channel_wavelength.size]
    window = np.s_[10:15, 35:40]
    picture = Picture(model, channels, {}, 30.0, sun=(np.ones(LINES, bool), CLEAR))
    doubt = doubt_about_clouds(window, picture)
    assert word in doubt
    assert bool(doubt) == bool(word)
    # the side of a car that is turned away from the sun is no shadow on the ground
    for changed in ({"state": np.zeros_like(model.state)}, {"ground": np.zeros_like(model.ground)}):
        without = replace(picture, model=replace(model, **changed))
        assert "no shadow beside" in doubt_about_clouds(window, without)
    covered = replace(picture, sun=(np.zeros(LINES, bool), CLEAR))
    assert "no irradiance record" in doubt_about_clouds(window, covered)
    assert doubt_about_clouds(window, replace(picture, sun=None)) == ""
