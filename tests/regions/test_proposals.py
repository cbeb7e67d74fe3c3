"""Regions proposed by rule, on cars drawn by hand."""

import json
import logging
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from click.testing import CliRunner

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.cli.program import main
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.regions import pixels_of, proposals
from hyperpaint.regions.proposals import (
    Level,
    Measures,
    Picture,
    Piece,
    Verdict,
    hull_of,
    judge_level,
    lean_to_sun,
    outline,
)
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of
from hyperpaint.surroundings.corrections import remove_mirrored_sky

ZENITH = 30.0
NM = np.linspace(405.0, 995.0, 48)
RED = np.where(NM > 600.0, 0.6, 0.04)


def drawn(bonnet: bool = True, rear: bool = True, noise: float = 0.005) -> xr.Dataset:
    # Return asphalt with one red car: bonnet, windscreen, roof, rear window and boot
    split = diffuse_fraction(NM, ZENITH)
    seen = np.empty((70, NM.size, 130))
    seen[:] = (0.09 + 0.03 * (NM - 400.0) / 600.0)[:, None]
    red = (RED + 0.04 * split)[:, None]
    glass = (0.012 + 0.04 * split)[:, None]
    seen[20:50, :, 20:112] = red
    seen[24:46, :, 45:60] = glass
    if rear:
        seen[24:46, :, 88:98] = glass
    if bonnet:
        seen[20:50, :, 20:45] *= 0.85  # leans away from the sun
    seen *= 1.0 + noise * np.random.default_rng(5).normal(size=seen.shape)
    cube = ("along_track", "band", "cross_track"), seen.astype(np.float32), {"units": "1"}
    return xr.Dataset({"reflectance": cube}, {"wavelength": ("band", NM, {"units": "nm"})})


def parked(
    length: int = 100,
    width: int = 40,
    windows: tuple[tuple[int, int], ...] = ((28, 42), (68, 84)),
    paint: npt.NDArray[np.float64] = RED,
    gain: float = 0.0,
) -> xr.Dataset:
    # Return asphalt with a car from above: windows across it and along its sides, a crowned roof
    # Along the roof, 5 pixels to either side of the windows' span, its light falls by ``gain`` a pixel
    split = diffuse_fraction(NM, ZENITH)
    seen = np.empty((width + 40, NM.size, length + 60))
    seen[:] = (0.09 + 0.03 * (NM - 400.0) / 600.0)[:, None]
    body = np.s_[20 : 20 + width, :, 30 : 30 + length]
    seen[body] = paint[:, None]
    along = np.arange(length) - 55.0
    seen[body] *= 1.0 + gain * along
    dark = np.zeros((width, length), bool)
    for first, last in windows:
        dark[6 : width - 6, first:last] = True
    # side windows, of which a door is the outer side
    dark[3:6, 32:80] = dark[width - 6 : width - 3, 32:80] = True
    seen[body] = np.where(dark[:, None], 0.012, seen[body])
    seen[body] += 0.04 * split[:, None]
    seen *= 1.0 + 0.004 * np.random.default_rng(3).normal(size=seen.shape)
    cube = ("along_track", "band", "cross_track"), seen.astype(np.float32), {"units": "1"}
    return xr.Dataset({"reflectance": cube}, {"wavelength": ("band", NM, {"units": "nm"})})


def propose(line: xr.Dataset, **options: Any) -> Any:
    return hp.regions.propose_regions(line, sun_zenith=ZENITH, **options)


@pytest.fixture(scope="module")
def car() -> tuple[xr.Dataset, Any]:
    # Return asphalt with one red car, and the proposals of it
    line = drawn()
    return line, propose(line, flightline="raw_0")


def roof_of(level: float) -> Verdict:
    # Return a roof of 64 pixels without a verdict
    piece = Piece(0, (0, 0), np.ones((8, 8), bool))
    return Verdict(piece, Measures(piece.inside, np.full(24, level), {}, pixels=64, glint=0.0), "roof")


# --- outlines of pixels ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_outline__holds_the_pixels_and_no_other(seed: int) -> None:
    # Rationale: a polygon along the sides of pixels, with holes and corners that touch
    # Expected: the pixels in it are those of the mask, for random connected masks
    from scipy.ndimage import label

    parts, _ = label(np.random.default_rng(seed).random((18, 23)) > 0.42)
    mask = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    ring, holes = outline(mask, (3, 5))
    line = xr.Dataset({"quality": (("along_track", "cross_track"), np.zeros((30, 40), "u2"))})
    along, across = pixels_of(hp.Regions((hp.Region("it", ring, holes),)), line)[0]
    made = np.zeros((30, 40), bool)
    made[along, across] = True
    expected = np.zeros((30, 40), bool)
    expected[3:21, 5:28] = mask
    assert np.array_equal(made, expected)


@pytest.mark.parametrize("seed", range(6))
def test_footprint__is_the_convex_hull(seed: int) -> None:
    # Rationale: what lies between the parts of a car. Expected: that of the half-planes, pixel by pixel.
    from scipy.spatial import ConvexHull

    mask = np.zeros((30, 40), bool)
    mask[3:27, 5:35] = np.random.default_rng(seed).random((24, 30)) < 0.01 + 0.2 * (seed % 3)
    y, x = np.indices(mask.shape)
    expected = np.ones(mask.shape, bool)
    for down, right, offset in ConvexHull(np.argwhere(mask)).equations:
        expected &= down * y + right * x + offset <= 1e-9
    assert np.array_equal(hull_of(mask), expected)


# --- a car drawn by hand -----------------------------------------------------------------------------------


def test_proposals__are_the_roof_with_reasons(car: tuple[xr.Dataset, Any]) -> None:
    # Rationale: of bonnet, roof and boot only the roof is level for sure
    # Expected: one region between both windows, three pixels from their edges, with the paint's spectrum; its
    # signature has the region's pixels
    line, found = car
    (region,) = found
    along, across = pixels_of(found, line)[0]
    assert across.min() >= 60 + 2
    assert across.max() <= 88 - 3
    assert (region.properties["kind"], region.properties["rank"]) == ("roof", 1)
    assert 0 < region.properties["score"] <= 1
    assert any("windows end it on both sides" in text for text in region.properties["reasons"])
    seen = remove_mirrored_sky(line, sun_zenith=ZENITH)["reflectance"].values[along, :, across]
    assert np.abs(np.median(seen, axis=0) - RED).max() < 0.01
    assert found.table().startswith("red-01  at line 3")
    assert "latitude" not in region.properties  # the line has no positions
    dims, (y, x) = (
        ("along_track", "cross_track"),
        np.indices((line.sizes["along_track"], line.sizes["cross_track"])),
    )
    places = {"north": (dims, 4_770_000.0 - y), "east": (dims, 282_000.0 + x)}
    on_map = propose(line.assign_coords(places).assign_attrs(crs="EPSG:32618"), name="lot")[0]
    assert on_map.name == "lot_red-01"
    from pyproj import Transformer

    at = Transformer.from_crs("EPSG:4326", "EPSG:32618", always_xy=True).transform(
        on_map.properties["longitude"], on_map.properties["latitude"]
    )
    centre = on_map.polygon.mean(axis=0)
    assert np.abs(np.array(at) - (282_000.0 + centre[0], 4_770_000.0 - centre[1])).max() < 3.0
    assert on_map.properties["place"].endswith(f", {on_map.properties['longitude']:.6f}")
    unnamed = replace(found, regions=(replace(region, flightline=""),))
    assert int(hp.extract_signatures(line, unnamed)["n"][0]) == region.properties["pixels"]


def test_refusals__say_why_and_name_scenery_last(car: tuple[xr.Dataset, Any]) -> None:
    # Rationale: a bonnet may lean, and a dark car may be taken for a window: neither may vanish
    # Expected: all refused have reasons, among them the lean or the better part of the car; windows come last
    told = [" ".join(region.properties["refused"]) for region in car[1].refused]
    assert all(told)
    assert any("lean" in text or "same car" in text for text in told)
    scenery = ["as dark as" in text for text in told]
    assert any(scenery)
    assert scenery == sorted(scenery)


def test_proposals__need_a_window() -> None:
    # Rationale: a red sheet on the ground is no car
    # Expected: nothing is proposed, and it is refused for want of a window
    line = drawn(bonnet=False)
    line["reflectance"][20:50, :, 20:112] = line["reflectance"].values[30:31, :, 70:71]
    found = propose(line)
    assert len(found) == 0
    assert any("no window" in " ".join(region.properties["refused"]) for region in found.refused)


@pytest.mark.parametrize("windows", [((28, 42), (68, 84)), ((28, 42),)], ids=["both", "windscreen only"])
def test_roof__is_found_by_its_windows(windows: tuple[tuple[int, int], ...]) -> None:
    # Rationale: of vans and hatchbacks the rear window is hardly seen from above; windows run along a roof
    # Expected: one region, behind the windscreen, and it is called a roof
    line = parked(windows=windows)
    found = propose(line)
    assert [region.properties["kind"] for region in found] == ["roof"]
    _, across = pixels_of(found, line)[0]
    assert across.min() >= 30 + 42


def test_roof_of_a_square_footprint__is_refused() -> None:
    # Rationale: paint 1.4 times as long as wide is a part of a car, or two cars; its middle need not be level
    # Expected: refused, while the same roof on a car is proposed
    assert len(propose(parked(width=56))) == 1
    found = propose(parked(width=72))
    assert len(found) == 0
    assert any("1.4 times" in " ".join(region.properties["refused"]) for region in found.refused)


def test_short_roof_behind_one_window__may_slope() -> None:
    # Rationale: the roof of a pickup ends at its bed, and roofs of some slope
    # Expected: its lean is less certain than that of a roof between windows, or of a long one
    whole, long, short = (
        propose(line)[0].properties["lean"]
        for line in (parked(), parked(windows=((28, 42),)), parked(length=85, windows=((44, 58),)))
    )
    assert whole < 1.2
    assert long < 1.2
    assert short > 2.0


def test_roof__is_taken_where_it_is_level() -> None:
    # Rationale: a crowned roof leans towards its ends, under this sun by 1 % of its light in two pixels
    # Expected: the signature is that of its middle, although all of the roof is free of glint and shadow
    line = parked(gain=0.005)
    found = propose(line)
    assert len(found) == 1
    along, across = pixels_of(found, line)[0]
    assert abs(float(np.median(across)) - (30 + 55)) < 2.5
    seen = remove_mirrored_sky(line, sun_zenith=ZENITH)["reflectance"].values[along, :, across]
    assert np.abs(np.median(seen, axis=0) - RED).max() < 0.01
    # Rationale: a sunroof is the front half of a roof; what is left of it leans backwards
    # Expected: pixels of the half that is nearer to the sunroof
    line = parked(windows=((28, 55), (80, 90)), gain=0.004)
    (region,) = propose(line)
    _, across = pixels_of(hp.Regions((region,)), line)[0]
    assert region.properties["kind"] == "roof"
    assert float(np.median(across)) < 30 + 67


def test_roof_whose_far_side_is_dark__is_taken_at_its_axis() -> None:
    # Rationale: under a low sun beside the car light falls by 2.5 % a pixel across it, and at the far rail to
    # a fifth, which is darker than paint elsewhere and no window
    # Expected: the level is that of the middle between both rails; taken for glass, the far rail shifts it
    line = parked()
    row = np.arange(line.sizes["along_track"]) - 20.0 - 19.5
    light = 1.0 - 0.025 * row
    light *= np.interp(row, [10.0, 14.0], [1.0, 0.2])
    light[np.abs(row) > 20.0] = 1.0
    sky = 0.04 * diffuse_fraction(NM, ZENITH).astype(np.float32)[:, None]
    seen = line["reflectance"].values - sky
    line["reflectance"].values[:] = seen * light.astype(np.float32)[:, None, None] + sky
    (region,) = hp.regions.propose_regions(line, sun_zenith=62.0, sun_azimuth=180.0, heading=0.0)
    along, across = pixels_of(hp.Regions((region,)), line)[0]
    level = (line["reflectance"].values - sky)[along, :, across].mean()
    assert level == pytest.approx(RED.mean(), rel=0.015)


def test_lean__is_smaller_across_a_car() -> None:
    # Rationale: the sides of a car are alike, its ends are not
    # Expected: least with the sun beside it; where the sun's side is not known, the larger one
    axis = np.array([0.0, 1.0])
    beside, behind, unknown = (
        lean_to_sun(axis, side) for side in (np.array([1.0, 0.0]), np.array([0.0, -1.0]), None)
    )
    assert beside < behind == unknown


def test_lobes_of_flakes__are_known_where_they_are_level() -> None:
    # Rationale: metal flakes mirror the sun over a lobe that is wider than a roof
    # Expected: of brightness that changes by 70 % along a roof a band across its middle, whose level is less
    # sure than 3 %
    line = parked(gain=0.02)
    (region,) = found = propose(line, sun_azimuth=180.0, heading=0.0)
    assert region.properties["level_uncertainty"] > 0.03
    along, across = pixels_of(found, line)[0]
    assert abs(float(np.mean(across)) - (30 + 55)) < 1.5
    seen = remove_mirrored_sky(line, sun_zenith=ZENITH)["reflectance"].values[along, :, across]
    assert np.mean(seen) == pytest.approx(np.mean(RED), rel=2.0 * region.properties["level_uncertainty"])


def test_uncertain_levels__are_of_flakes_haze_and_low_suns() -> None:
    # Rationale: a lean that nothing shows changes the light of flakes more than that of a solid paint
    # Expected: four times the change of a solid paint is of a level less certain, eight times is refused, and
    # the reason names flakes
    model = hp.surroundings.survey(parked(), sun_zenith=45.0)
    picture = Picture(model, np.empty(0), {}, 45.0)
    verdicts, limits = [roof_of(0.3) for _ in range(3)], {"max_level_u": 0.15}
    for verdict, times in zip(verdicts, (1.0, 4.0, 8.0), strict=True):
        judge_level(verdict, picture, 0.5, Level(along_change=times * picture.direct_share), limits)
    assert verdicts[1].level_sd > 1.3 * verdicts[0].level_sd
    assert not verdicts[0].objections
    assert not verdicts[1].objections
    assert any("flakes" in text for text in verdicts[2].objections)
    # Rationale: a coat of unknown index mirrors an unknown share of the sky, most under clouds
    # Expected: grey paint of 0.08 is refused for the sky under a covered one, white paint is not, nor is
    # either under a clear sky
    clear = hp.surroundings.survey(parked(), sun_zenith=45.0)
    covered = replace(clear, diffuse_fraction=np.ones_like(clear.diffuse_fraction))
    of_skies, limits = {}, {"max_level_u": 0.08}
    for sky, scene in (("clear", clear), ("covered", covered)):
        picture = Picture(scene, np.empty(0), {}, 45.0)
        for level in (0.08, 0.7):
            verdict = of_skies[sky, level] = roof_of(level + float(picture.sky[0].mean()))
            judge_level(verdict, picture, 0.5, Level(1.0, 0.01, 0.9), limits)
    refused = [key for key, verdict in of_skies.items() if verdict.objections]
    assert refused == [("covered", 0.08)]
    assert "mirrored" in of_skies["covered", 0.08].objections[0]
    # Rationale: a comparison with NaN is False. Expected: an objection, and no region of a level of NaN.
    verdict = roof_of(0.3)
    judge_level(verdict, Picture(model, np.empty(0), {}, 45.0), float("nan"), Level(), limits)
    assert verdict.objections
    # Rationale: a lean changes the light of a roof by f_dir tan(zenith), and by next to nothing in cloud
    # Expected: under a sun at 80 degrees a roof is refused for its lean, with what to do; under an overcast
    # sky it is proposed, of a level within 2 %
    low_sun = hp.regions.propose_regions(parked(), sun_zenith=80.0, diffuse="model", max_level_u=0.08)
    assert len(low_sun) == 0
    assert any("higher sun" in text for one in low_sun.refused for text in one.properties["refused"])
    (region,) = hp.regions.propose_regions(parked(), sun_zenith=80.0, diffuse=np.full(NM.size, 0.98))
    assert region.properties["level_uncertainty"] < 0.02


def test_options__are_those_of_the_survey_and_the_command_needs_no_regions() -> None:
    # Expected: a word that no survey knows is refused; beside a model its own sun is taken
    line = parked()
    with pytest.raises(TypeError, match="sun_zenit"):
        hp.regions.propose_regions(line, sun_zenit=30.0)
    model = hp.surroundings.survey(line, sun_zenith=ZENITH)
    beside, own = hp.regions.propose_regions(line, model), propose(line)
    assert [one.properties for one in beside] == [one.properties for one in own]
    # Expected: the option is there, and is not required
    told = CliRunner().invoke(main, ["signatures", "--help"]).output
    assert "proposed by rule" in told


def test_black_paint_and_vans__are_told_by_windows() -> None:
    # Rationale: a black roof of 0.025 mirrors as much sky as its windows, of 0.012
    # Expected: it is proposed; a car all of whose paint is as dark as its windows is not
    (region,) = propose(parked(paint=np.full(NM.size, 0.025)))
    assert (region.properties["kind"], len(propose(parked(paint=np.full(NM.size, 0.0125))))) == ("roof", 0)
    # Rationale: behind windscreen and bonnet, no other part is longer than half a car
    # Expected: the rest is proposed as the roof; where the windscreen ends the car there is no bonnet, and it
    # is not
    (region,) = propose(drawn(rear=False))
    assert region.properties["kind"] == "roof"
    assert "all of the car behind" in region.properties["reasons"][0]
    assert len(propose(drawn(rear=False).isel(cross_track=slice(45, None)))) == 0
    # Rationale: lots are full of white cars. Expected: two regions, one on each car.
    one = parked()
    line = xr.concat([one, one.copy(deep=True)], "along_track", coords="minimal", compat="override")
    found = propose(line)
    assert len(found) == 2
    assert sorted(int(np.median(along)) // 80 for along, _ in pixels_of(found, line)) == [0, 1]


@pytest.mark.parametrize("windows", [((28, 42),), ((28, 42), (94, 98))])
def test_black_roof_behind_a_windscreen__is_one(windows: tuple[tuple[int, int], ...]) -> None:
    # Rationale: an estate has nothing behind its roof, or a tail of a few centimetres
    # Expected: its roof is proposed by the bonnet and by the windows along it; without a bonnet the middle of
    # the side windows, which begin 62 pixels from the left and end 110 from it
    (region,) = propose(parked(paint=np.full(NM.size, 0.03), windows=windows))
    assert region.properties["kind"] == "roof"
    line = parked(paint=np.full(NM.size, 0.03), windows=((2, 16),))
    (along, across), *others = pixels_of(propose(line), line)
    assert not others
    assert 0.5 * (across.min() + across.max()) == pytest.approx(86.0, abs=1.5)
    assert np.ptp(across) < 0.4 * 48
    assert 20 + 6 < along.min() < along.max() < 60 - 6


@pytest.mark.slow
def test_proposals__are_the_same_on_a_cluster(car: tuple[xr.Dataset, Any]) -> None:
    # Rationale: layers come off workers in any order. Expected: the digest of a run without them.
    distributed = pytest.importorskip("distributed")
    line, whole = car
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": False, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(silence_logs=logging.CRITICAL, **options) as local,
        distributed.Client(local),
    ):
        made = propose(line.chunk({"along_track": 13}), flightline="raw_0")
    assert (made.digest, made.refused.digest) == (whole.digest, whole.refused.digest)


def test_proposals__do_not_depend_on_chunks(car: tuple[xr.Dataset, Any]) -> None:
    # Rationale: a survey, then pointwise layers, then rules on whole arrays
    # Expected: equal digests for five chunkings, the last through the accessor
    line, whole = car
    for chunks in ({"along_track": 32}, {"along_track": 7}, {"along_track": 70, "band": 5}):
        assert propose(line.chunk(chunks), flightline="raw_0").digest == whole.digest
    lazy = line.chunk(cross_track=11)
    assert lazy.paint.propose_regions(sun_zenith=ZENITH, flightline="raw_0").digest == whole.digest


def test_model_of_another_line__is_refused(car: tuple[xr.Dataset, Any]) -> None:
    # Expected: other pixels and other bands are told together, for lines with flags and without
    line, _ = car
    other = drawn().isel(along_track=slice(60), band=slice(40))
    model = hp.surroundings.survey(other, sun_zenith=ZENITH)
    flagged = hp.surroundings.flag(line, hp.surroundings.survey(line, sun_zenith=ZENITH))
    for wrong in (line, flagged):
        with pytest.raises(SchemaError, match=r"(?s)grid-mismatch.*bands-differ"):
            propose(wrong, model=model)


def test_flagged_lines__are_not_flagged_again(
    car: tuple[xr.Dataset, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Expected: the proposals of the line without flags; progress ends at all lines
    line, whole = car
    model = hp.surroundings.survey(line, sun_zenith=ZENITH)
    flagged = hp.surroundings.flag(line, model)
    monkeypatch.setattr(proposals, "flag_channels", None)
    calls: list[tuple[int, int]] = []
    found = propose(flagged, model=model, flightline="raw_0", progress=lambda *done: calls.append(done))
    assert (found.digest, found.refused.digest) == (whole.digest, whole.refused.digest)
    assert calls == sorted(calls)
    assert calls[-1] == (70, 70)


def test_proposals__go_into_a_file_and_back_and_on_a_crop(car: tuple[xr.Dataset, Any], tmp_path: Any) -> None:
    line, found = car
    numbered = line.assign_coords(
        along_track=np.arange(line.sizes["along_track"]) + 1000,
        cross_track=np.arange(line.sizes["cross_track"]) + 50,
    )
    moved = propose(numbered)
    for bare, other in zip(found, moved, strict=True):
        np.testing.assert_array_equal(other.polygon, np.add(bare.polygon, [50, 1000]))
    assert all((region.polygon >= [49, 999]).all() for region in moved.refused)
    # Rationale: people edit proposals. Expected: GeoJSON as any regions, what is refused stays out of it.
    found = car[1]
    path = hp.write_regions(found, tmp_path / "cars.geojson")
    again = hp.read_regions(path)
    assert (again.names, len(json.loads(path.read_text())["features"])) == (found.names, len(found))
    assert again[0].flightline == "raw_0"


def test_flags_that_a_region_names__are_those_left_out(car: tuple[xr.Dataset, Any]) -> None:
    # Rationale: a proposed roof was judged by its brightness, and flags of glint on it are no news
    # Expected: its pixels under a flag it does not name count; under one it names, none is left; flags that
    # there are not are refused by name
    line, found = car
    region = replace(found[0], flightline="")
    flagged = line.assign(quality=xr.full_like(line["reflectance"][:, 0], int(hp.Quality.GLINT), np.uint16))
    assert int(hp.extract_signatures(flagged, hp.Regions((region,)))["n"][0]) == region.properties["pixels"]
    for names, code in ((["glint"], "region-too-small"), (["dust"], "choice-unknown")):
        other = replace(region, properties={**region.properties, "excluded_flags": names})
        with pytest.raises(SchemaError, match=code):
            hp.extract_signatures(flagged, hp.Regions((other,)))


@pytest.mark.parametrize("wrong", [{"erode": -1}, {"min_pixels": 0}, {"most": 0}, {"glint": float("nan")}])
def test_limits_that_cannot_be__are_refused(car: tuple[xr.Dataset, Any], wrong: dict[str, Any]) -> None:
    with pytest.raises(SchemaError, match="value-out-of-range"):
        propose(car[0], **wrong)


# --- Regions proposed by rule, on cars whose light is traced


@pytest.mark.slow
def test_proposals_on_traced_cars__are_right_or_refused() -> None:
    # Rationale: coats, cast shadows, glint and neighbours from geometry, which no rule here knows
    # Expected: something is proposed, and every signature is its paint within max(0.03, 6 %), and within 0.01
    # in shape
    sky = Atmosphere.clear(34.0, 105.0)
    park = car_park(length=14.0, width=32.0, seed=3, neighbours=(), margin=10.0, flakes=False, islands=False)
    flight = pushbroom(150, 200, altitude=15.0, ground_sample=0.06, line_spacing=0.06, start=(-0.1, 2.0))
    traced = hp.simulation.trace(park, flight, [sky], samples=24, seed=3, sun_radius=0.267)
    line = hp.simulation.relight(traced, BandSet(NM, np.full(NM.size, 6.0)), atmosphere=sky).compute()
    found = hp.regions.propose_regions(line, sun_zenith=34.0, sun_azimuth=105.0, heading=0.0, erode=2)
    assert len(found) >= 1
    corrected = remove_mirrored_sky(line, sun_zenith=34.0)["reflectance"].values
    names = line["paint_id"].attrs["flag_meanings"].split()
    for along, across in pixels_of(found, line):
        shown = line["paint_id"].values[along, across]
        assert (shown >= 0).all()
        own = spectrum_of(names[shown[0]])(NM)
        made = np.median(corrected[along, :, across], axis=0)
        assert (np.abs(made - own) < np.maximum(0.03, 0.06 * own)).all()
        assert np.sqrt(np.mean((made * (made @ own) / (made @ made) - own) ** 2)) < 0.01
