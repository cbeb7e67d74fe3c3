"""Flags on scenes built from geometry, never from the division that flags make."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from support.analytic_scenes import (
    as_line,
    bonnet,
    box_shadow,
    smooth_edge,
    wall_beside_plane,
    wavelengths,
)
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality, label_digest
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.simulation import simulate_line
from hyperpaint.surroundings.model import SceneModel
from hyperpaint.surroundings.surveying import LAYERS

NM = wavelengths()
RED = smooth_edge(NM, 600.0, 0.04, 0.6)
ASPHALT = smooth_edge(NM, 600.0, 0.07, 0.12, 150.0)
BLUE = 0.04 + 0.3 * np.exp(-(((NM - 460.0) / 40.0) ** 2)) + 0.2 / (1 + np.exp(-(NM - 800.0) / 30.0))
BLACK = np.full(NM.size, 0.03)
Mask = npt.NDArray[np.bool_]


def has(line: xr.Dataset, bit: Quality) -> Mask:
    return (line["quality"].values & int(bit)) > 0


def precision_and_recall(found: Mask, true: Mask, counted: Mask) -> tuple[float, float]:
    both = (found & true & counted).sum()
    return both / max((found & counted).sum(), 1), both / max((true & counted).sum(), 1)


@pytest.mark.parametrize("seed", [100, 101])
def test_the_shadow_of_a_box(seed: int) -> None:
    cube, blocked, ground = box_shadow(NM, ASPHALT, RED)
    line = hp.surroundings.flag(as_line(cube, NM, snr=100.0, seed=seed), sun_zenith=40.0).compute()
    precision, recall = precision_and_recall(has(line, Quality.SHADOW), blocked >= 0.2, np.ones_like(ground))
    assert precision >= 0.99
    assert recall >= 0.99
    inside = ground & ~has(line, Quality.MIXED_EDGE)
    assert np.abs(line.blocked_direct.values - blocked)[inside].mean() < 0.03


@pytest.mark.parametrize(
    ("body", "zenith"),
    [(RED, 30.0), (RED, 45.0), (BLUE, 30.0), (BLUE, 45.0), (BLACK, 30.0)],
    ids=["red 30", "red 45", "blue 30", "blue 45", "black 30"],
)
def test_the_image_of_the_sun_in_a_bonnet(body: Any, zenith: float) -> None:
    cube, glint = bonnet(NM, body, zenith=zenith)
    line = hp.surroundings.flag(as_line(cube, NM, snr=100.0, seed=103), sun_zenith=zenith).compute()
    # what matters is over 4 % of the bonnet's own level; what is near that may be taken for either
    added = glint * (1.0 - diffuse_fraction(NM, zenith)).mean()
    counted = ~has(line, Quality.MIXED_EDGE)
    limit = np.maximum(0.04 * (cube.mean(axis=2) - added), 0.004)
    found = has(line, Quality.GLINT)
    precision, _ = precision_and_recall(found, added > 0.75 * limit, counted)
    _, recall = precision_and_recall(found, added > 1.5 * limit, counted)
    assert precision >= 0.95
    assert recall >= 0.95


@pytest.mark.parametrize("plane", [0.1, 0.25])
def test_a_red_wall_reddens_a_grey_plane(plane: float) -> None:
    cube, added, masks = wall_beside_plane(NM, np.full(NM.size, plane), RED, height=0.7, pixel=0.05)
    line = as_line(cube, NM, snr=100.0, seed=102)
    model = hp.surroundings.survey(line, sun_zenith=35.0)
    line = hp.surroundings.flag(line, model).compute()
    near = masks["plane"].values & ~has(line, Quality.MIXED_EDGE) & (added > 0.015) & (added < 0.025)
    assert near.sum() > 100
    assert has(line, Quality.ADJACENCY)[near].mean() > 0.99
    assert abs((line.adjacency.values - added)[near].mean()) < 0.002
    assert (line.adjacency_segment.values[near] == model.segment[48, 4]).all()


def test_two_neighbours_add_the_peak_of_their_sum() -> None:
    red, blue = (np.exp(-(((NM - centre) / 60.0) ** 2)) for centre in (850.0, 450.0))
    cube = np.full((48, 64, NM.size), 0.3)
    cube[:, :12], cube[:, -12:] = 0.05 + 0.6 * red, 0.05 + 0.6 * blue
    model = hp.surroundings.survey(as_line(cube, NM), sun_zenith=35.0)
    extra = 0.02 * red + 0.02 * blue
    cube[20:28, 20:44] += extra
    flagged = hp.surroundings.flag(as_line(cube, NM), model).compute()
    inside = np.s_[21:27, 24:40]
    # the tail of neither adds to the peak of the other
    np.testing.assert_allclose(flagged.adjacency.values[inside], extra.max(), atol=0.003)
    assert set(np.unique(flagged.adjacency_segment.values[inside])) <= {
        int(model.segment[24, 4]),
        int(model.segment[24, -4]),
    }


@pytest.mark.parametrize("dead", [[94, 95], [0, 1, *range(40, 60)], range(48)], ids=["2", "22", "half"])
def test_the_shadow_of_a_box_though_bands_are_dead(dead: Any) -> None:
    cube, blocked, _ = box_shadow(NM, ASPHALT, RED)
    cube[..., list(dead)] = np.nan
    line = hp.surroundings.flag(as_line(cube, NM, snr=100.0, seed=100), sun_zenith=40.0).compute()
    found = has(line, Quality.SHADOW)
    precision, recall = precision_and_recall(found, blocked >= 0.2, np.ones_like(found))
    assert precision >= 0.99
    assert recall >= 0.98


def test_a_plain_plane_has_no_flags() -> None:
    plane = as_line(np.broadcast_to(ASPHALT, (64, 64, NM.size)).copy(), NM, snr=100.0, seed=105)
    assert not hp.surroundings.flag(plane, sun_zenith=30.0).quality.values.any()


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    cube, _ = bonnet(NM, RED)
    return as_line(cube, NM, snr=100.0)


@pytest.fixture(scope="module")
def model(line: xr.Dataset) -> SceneModel:
    return hp.surroundings.survey(line, sun_zenith=30.0)


@pytest.fixture(scope="module")
def whole(line: xr.Dataset, model: SceneModel) -> xr.Dataset:
    return hp.surroundings.flag(line, model).compute()


def test_flags_are_lazy_and_keep_their_types(
    line: xr.Dataset, model: SceneModel, no_compute: Callable[[], Any]
) -> None:
    with no_compute():
        flagged = line.paint.flag(model)
    for name in LAYERS:
        assert flagged[name].dims == ("along_track", "cross_track")
        wanted = np.int32 if name == "adjacency_segment" else np.float32
        assert flagged[name].dtype == flagged[name].compute().dtype == wanted
    assert flagged.quality.dtype == flagged.quality.compute().dtype == np.uint16
    assert (flagged.glint_fraction.attrs["units"], flagged.glint_fraction.attrs["threshold"]) == ("1", 0.04)


@pytest.mark.parametrize("lines", [1, 13, 32, 64, 160])
def test_the_same_flags_for_any_chunks(line: xr.Dataset, whole: xr.Dataset, lines: int) -> None:
    other = hp.surroundings.flag(line.chunk(along_track=lines), sun_zenith=30.0).compute()
    for name in (*LAYERS, "quality"):
        np.testing.assert_array_equal(whole[name].values, other[name].values)


def test_flags_of_chosen_pixels_are_those_of_the_whole(
    line: xr.Dataset, model: SceneModel, whole: xr.Dataset, no_compute: Callable[[], Any]
) -> None:
    chosen = xr.DataArray(np.indices((96, 160)).sum(axis=0) % 7 < 2, dims=("cross_track", "along_track"))
    for where in (chosen, chosen.chunk(), chosen.T.values):
        with no_compute():
            flagged = line.paint.flag(model, where=where)
        for name in ("quality", *LAYERS):
            other = flagged[name].where(chosen)
            xr.testing.assert_equal(other, whole[name].where(chosen))
        assert not flagged.quality.where(~chosen, 0).any()
    assert whole.quality.where(~chosen, 0).any()
    expect_refusals(
        (SchemaError, "grid-mismatch", lambda: line.paint.flag(model, where=chosen[1:])),
        (SchemaError, "grid-mismatch", lambda: line.paint.flag(model, where=chosen.astype(int))),
        (SchemaError, "dims-wrong", lambda: line.paint.flag(model, where=chosen.rename(cross_track="depth"))),
    )


def test_bits_that_were_set_stay_and_missing_pixels_have_none(line: xr.Dataset, model: SceneModel) -> None:
    before = xr.DataArray(np.full((160, 96), 10, np.uint16), dims=("along_track", "cross_track"))
    for given in (before, before.chunk(along_track=40)):
        flagged = hp.surroundings.flag(line.assign(quality=given), model)
        assert (flagged.quality.values & 10 == 10).all()
        assert has(flagged.compute(), Quality.GLINT).any()
        np.testing.assert_array_equal(
            hp.radiometry.smooth(flagged, "box", 5).quality.values, flagged.quality.values
        )
    seen = line.reflectance.where(line.reflectance.cross_track != 40).astype(np.float32)
    flagged = hp.surroundings.flag(
        line.assign(reflectance=seen.assign_attrs(units="1")), sun_zenith=30.0
    ).compute()
    assert not flagged.quality.values[:, 40].any()
    assert np.isnan(flagged.glint_fraction.values[:, 40]).all()


def test_thresholds_are_the_users_and_models_of_the_line(line: xr.Dataset, model: SceneModel) -> None:
    found = [
        has(hp.surroundings.flag(line, model, glint=limit).compute(), Quality.GLINT).sum()
        for limit in (0.04, 1.0, 99.0)
    ]
    assert found[0] > found[1] > found[2] == 0
    with pytest.raises(SchemaError, match=r"(?s)160, 96.*bands-diff"):
        hp.surroundings.flag(line.isel(along_track=slice(10), band=slice(20)), model)
    labelled = line.assign_coords(along_track=np.arange(160), cross_track=np.arange(96))
    own = dataclasses.replace(model, attrs={**model.attrs, "labels": label_digest(labelled)})
    for same, surveyed in ((labelled, own), (labelled, model), (line, own)):
        hp.surroundings.flag(same, surveyed)
    reverse, other_columns = {"along_track": slice(None, None, -1)}, {"cross_track": np.arange(9, 105)}
    for other in (labelled.isel(reverse), labelled.assign_coords(other_columns)):
        with pytest.raises(SchemaError, match=r"grid-mismatch"):
            hp.surroundings.flag(other, own)
    with pytest.raises(SchemaError, match="option-conflict"):
        hp.surroundings.flag(line, model, reach=5)
    with pytest.raises(SchemaError, match=r"(?s)glint=-1.*shadow=nan"):
        hp.surroundings.flag(line, model, glint=-1, shadow=float("nan"))


# --- Flags that are set once are set in everything that is made afterwards


SUN = {"sun_zenith": 35.0}
REGION = hp.Region("part", [(2, 4), (17, 4), (17, 27), (2, 27)])

STEPS: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
    "smooth": lambda flagged_line: flagged_line.paint.smooth("box", 5),
    "savitzky-golay": lambda flagged_line: flagged_line.paint.smooth(),
    "to_nominal": lambda flagged_line: flagged_line.paint.to_nominal(),
    "at": lambda flagged_line: flagged_line.paint.at([500.0, 600.0, 700.0]),
    "remove_mirrored_sky": lambda flagged_line: flagged_line.paint.remove_mirrored_sky(**SUN),
    "correct_light": lambda flagged_line: flagged_line.paint.correct_light(direct=0.9, **SUN),
    "reflectance": lambda flagged_line: flagged_line.paint.reflectance(),
    "flag": lambda flagged_line: flagged_line.paint.flag(**SUN, glint=9.0, shadow=9.0, adjacency=9.0, edge=0),
}


@pytest.fixture(scope="module")
def flagged_line() -> xr.Dataset:
    # Return a line from counts, flagged, with every bit that is not of the counts set somewhere
    exposure = {"exposure_time_ms": 14.0, "frame_period_ms": 15.0}
    made = simulate_line(lines=32, bands=24, columns=20, smile_nm=0.6, seed=5, **exposure)
    made = made.drop_vars([name for name in made if str(name).startswith("true_")]).chunk(along_track=8)
    flagged = made.paint.reflectance().paint.flag(**SUN).compute()
    assert (flagged.quality & int(Quality.SATURATED)).any()
    bits = flagged.quality.values.copy()
    # the others are found anew whenever reflectance is computed from counts
    for number, flag in enumerate(flag for flag in Quality if Quality.GLINT <= flag <= Quality.OFF_SWATH):
        bits[number : number + 3, 7] |= np.uint16(flag)
    return flagged.assign(quality=flagged.quality.copy(data=bits)).chunk(along_track=8)


def assert_still_set(made: xr.Dataset, flagged_line: xr.Dataset, name: str) -> None:
    before, after = flagged_line.quality.values, made.quality.values
    assert made.quality.dtype == np.uint16, name
    np.testing.assert_array_equal(after & before, before, err_msg=name)
    assert made.quality.attrs["flag_meanings"].split()[6] == "glint", name
    assert made.quality.attrs["flags_from"] == flagged_line.quality.attrs["flags_from"], name


@pytest.mark.parametrize("name", STEPS)
def test_after_one_step(flagged_line: xr.Dataset, name: str) -> None:
    made = STEPS[name](flagged_line)
    assert_still_set(made, flagged_line, name)
    if name not in ("reflectance", "flag"):
        np.testing.assert_array_equal(made.quality, flagged_line.quality)
    for layer in LAYERS:
        assert layer in made, (name, layer)


def test_saturated_samples_stay_missing_and_flagged_through_smoothing(flagged_line: xr.Dataset) -> None:
    saturated = (flagged_line.quality.values & int(Quality.SATURATED)) > 0
    assert np.isnan(flagged_line.reflectance.values).any(axis=1)[saturated].all()
    smoothed = flagged_line.paint.smooth("box", 5)
    # what a window fills in is still a value of a pixel that is flagged
    assert_still_set(smoothed, flagged_line, "smooth")
    np.testing.assert_array_equal(
        smoothed.paint.remove_mirrored_sky(**SUN).paint.correct_light(direct=0.9, **SUN).quality,
        flagged_line.quality,
    )


def test_after_everything_a_store_and_signatures(flagged_line: xr.Dataset, tmp_path: Path) -> None:
    made = flagged_line
    for name in ("remove_mirrored_sky", "to_nominal", "correct_light", "smooth"):
        made = STEPS[name](made)
        assert_still_set(made, flagged_line, name)
    hp.to_store(made, tmp_path / "lot.zarr", "flightlines/raw_0")
    opened = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    np.testing.assert_array_equal(opened.quality, flagged_line.quality)
    assert_still_set(opened, flagged_line, "to_store")
    once = opened.paint.signatures(REGION, exclude=0, min_pixels=1)
    first = flagged_line.paint.signatures(REGION, exclude=0, min_pixels=1)
    np.testing.assert_array_equal(once.quality_share, first.quality_share)
    assert int(once.quality[0]) == int(first.quality[0])
    assert int(once.quality[0]) & int(Quality.GLINT | Quality.SHADOW | Quality.ADJACENCY)


def test_pixels_that_are_flagged_are_those_left_out(flagged_line: xr.Dataset, tmp_path: Path) -> None:
    smoothed = flagged_line.paint.smooth("box", 5)
    along, across = hp.regions.pixels(REGION, flagged_line)
    bits = flagged_line.quality.values[along, across]
    present = np.isfinite(smoothed.reflectance.values[along, :, across]).any(axis=1)
    left: dict[str, Any] = {}
    for name, given in (("as it was", flagged_line), ("smoothed", smoothed)):
        left[name] = given.paint.signatures(REGION, min_pixels=1)
    exclude = int(EXCLUDED)
    expected = int(((bits & exclude == 0) & present).sum())
    assert int(left["smoothed"].n[0]) == expected < along.size
    np.testing.assert_array_equal(left["smoothed"].member_along_track, left["as it was"].member_along_track)
