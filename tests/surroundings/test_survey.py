"""What a survey finds, and that it is the same whatever the chunks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.analytic_scenes import as_line, bonnet, box_shadow, smooth_edge, wavelengths
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings.corrections import measured_fraction, shadow_side_of, split_of
from hyperpaint.surroundings.model import LIT, SHADED, SceneModel
from hyperpaint.surroundings.segments import Light, Matches, divide, touching
from hyperpaint.surroundings.surveying import (
    channel_noise,
    channel_numbers,
    coloured,
    nearest_coloured,
    to_nominal_channels,
    without_unknown,
)

NM = wavelengths()
BANDS = xr.Dataset(coords={"wavelength": ("band", NM)})
RED = smooth_edge(NM, 600.0, 0.04, 0.6)
ASPHALT = smooth_edge(NM, 600.0, 0.07, 0.12, 150.0)


@pytest.fixture(scope="module")
def shadow_line() -> xr.Dataset:
    cube, _, _ = box_shadow(NM, ASPHALT, RED)
    return as_line(cube, NM, snr=100.0)


@pytest.fixture(scope="module")
def model(shadow_line: xr.Dataset) -> SceneModel:
    return hp.surroundings.survey(shadow_line, sun_zenith=40.0)


def test_a_shadow_is_matched_to_the_ground_around_it(
    model: SceneModel, tmp_path: Any, shadow_line: xr.Dataset
) -> None:
    shaded = np.flatnonzero(model.state == SHADED)
    assert shaded.size >= 1
    lit = model.body[shaded]
    assert (model.state[lit] == LIT).all()
    np.testing.assert_allclose(
        model.reference[lit[0]], np.bincount(model.channel, ASPHALT) / np.bincount(model.channel), rtol=0.01
    )
    assert (model.shade_distance[model.segment == shaded[0]] == 0).all()
    hp.to_store(model.to_dataset(), tmp_path / "model.zarr", group="scene")
    stored = xr.open_zarr(tmp_path / "model.zarr", group="scene")
    np.testing.assert_array_equal(SceneModel.from_dataset(stored).reference, model.reference)
    flagged = [hp.surroundings.flag(shadow_line, one).quality.values for one in (model, stored)]
    np.testing.assert_array_equal(*flagged)


def test_the_light_of_the_sky_is_measured_in_a_shadow(shadow_line: xr.Dataset, model: SceneModel) -> None:
    found = hp.surroundings.survey(shadow_line, sun_zenith=40.0, diffuse="shadow").diffuse_fraction
    true = np.bincount(model.channel, diffuse_fraction(NM, 40.0))
    # the box hides some of the sky, which is not known
    ratio = found / (true / np.bincount(channel_numbers(NM, np.ones(NM.size, bool))))
    assert ratio.min() > 0.7
    assert ratio.max() < 1.01
    assert np.ptp(ratio) < 0.02
    plane = as_line(np.broadcast_to(ASPHALT, (32, 32, NM.size)).copy(), NM)
    with pytest.raises(SchemaError, match="shadow-missing"):
        hp.surroundings.survey(plane, sun_zenith=30.0, diffuse="shadow")


@pytest.mark.parametrize("lines", [1, 7, 32, 50, 160])
def test_the_same_bits_for_any_chunks(shadow_line: xr.Dataset, model: SceneModel, lines: int) -> None:
    other = hp.surroundings.survey(shadow_line.chunk(along_track=lines, band=20), sun_zenith=40.0)
    xr.testing.assert_identical(other.to_dataset(), model.to_dataset())


def test_what_is_no_model_is_refused_before_anything_is_looked_up(model: SceneModel) -> None:
    broken = model.to_dataset().drop_vars(["segment", "body"])
    with pytest.raises(SchemaError, match=r"(?s)segment.*body"):
        SceneModel.from_dataset(broken)
    points = model.to_dataset()
    points["body"] = points["body"] + 1000
    with pytest.raises(SchemaError, match="segment-unknown"):
        SceneModel.from_dataset(points)
    stored = model.to_dataset()
    damaged = stored.isel(cell_along=slice(3))
    damaged["band_channel"] = damaged.band_channel + 10
    damaged["diffuse_fraction"] = damaged.diffuse_fraction * np.nan
    damaged["segment"] = damaged.segment.astype(np.float64) * np.nan
    with pytest.raises(SchemaError, match=r"(?s)segment.*channel-unk"):
        SceneModel.from_dataset(damaged)
    damaged["segment"] = stored.segment.astype(np.int64) + 2**32
    with pytest.raises(SchemaError, match=r"int64.*int32 .type-wrong"):
        SceneModel.from_dataset(damaged)
    damaged["segment"] = stored.segment
    with pytest.raises(SchemaError, match=r"neighb.*grid-mismatch"):
        SceneModel.from_dataset(damaged)
    for numbers in (model.channel - 1, np.minimum(model.channel, 20), np.full(NM.size, -1)):
        with pytest.raises(SchemaError, match=r"24 c.*channel-unknown"):
            SceneModel.from_dataset(stored.assign(band_channel=("band", numbers)))


def test_channels_are_even_runs_of_good_bands_that_most_pixels_have() -> None:
    channels = np.ones((4, 5, 3), np.float32)
    channels[..., 1] = np.nan
    channels[0, 0] = np.nan
    left, numbers = without_unknown(channels, np.array([0, 0, 1, -1, 2]))
    assert (left.shape, numbers.tolist()) == ((4, 5, 2), [0, 0, -1, -1, 1])
    channels[:] = np.nan
    assert without_unknown(channels, np.arange(3))[0].shape == (4, 5, 3)
    good = np.ones(272, bool)
    good[100:110] = False
    numbers = channel_numbers(np.linspace(400.0, 1000.0, 272), good)
    assert (numbers[100:110] == -1).all()
    counts = np.bincount(numbers[good])
    assert counts.size == 24
    assert set(counts) <= {10, 11}
    diffuse = diffuse_fraction(NM, 40.0)
    spectrum = np.stack([np.full(NM.size, 0.4), RED])
    whole = coloured(spectrum, Light.under(diffuse))
    spectrum[:, 30] = np.nan
    holed = coloured(spectrum, Light.under(diffuse))
    assert holed[0] < 1e-12
    np.testing.assert_allclose(holed[1], whole[1], rtol=0.02)


def test_a_line_that_cannot_be_surveyed_says_why(shadow_line: xr.Dataset) -> None:
    dead = shadow_line.isel(along_track=slice(0)).assign(good=("band", np.zeros(NM.size, bool)))
    with pytest.raises(SchemaError, match="along_track"):
        hp.surroundings.survey(dead, sun_zenith=40.0)
    with pytest.raises(SchemaError, match="cross_track"):
        hp.surroundings.survey(shadow_line.isel(cross_track=slice(0)), sun_zenith=40.0)
    nm = np.where(np.arange(NM.size) == 7, np.nan, NM)
    unknown = shadow_line.assign_coords(wavelength=("band", nm, {"units": "nm"}))
    with pytest.raises(SchemaError, match="wavelength-missing"):
        hp.surroundings.survey(unknown, sun_zenith=40.0)
    good = np.isfinite(nm)
    flagged = hp.surroundings.flag(unknown.assign(good=("band", good)), sun_zenith=40.0).compute()
    assert (flagged.quality.values & 128).any()
    with pytest.raises(SchemaError, match="sun-unknown"):
        hp.surroundings.survey(shadow_line, diffuse="shadow")
    expect_refusals(
        (SchemaError, "sun-unknown", lambda: hp.surroundings.survey(shadow_line)),
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.surroundings.survey(shadow_line, diffuse="guess", sun_zenith=30.0),
        ),
    )


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_scenes_of_nothing_have_no_flags(value: float) -> None:
    cube = np.full((32, 40, NM.size), value)
    assert not hp.surroundings.flag(as_line(cube, NM), sun_zenith=40.0).compute().quality.values.any()
    cube[:, 20:] = 0.5
    assert hp.surroundings.survey(as_line(cube, NM), sun_zenith=40.0).segments == (2 if value == 0 else 1)


def test_progress_is_told_and_missing_pixels_belong_to_nothing(
    shadow_line: xr.Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    told: list[tuple[int, int]] = []
    hp.surroundings.survey(
        shadow_line, sun_zenith=40.0, progress=lambda done, total: told.append((done, total))
    )
    assert told[-1] == (160, 160)
    hp.surroundings.survey(shadow_line, sun_zenith=40.0, progress=True)
    assert "160/160 lines" in capsys.readouterr().err
    holes = shadow_line.reflectance.where(shadow_line.reflectance.along_track != 5).astype(np.float32)
    holes.attrs = shadow_line.reflectance.attrs
    found = hp.surroundings.survey(shadow_line.assign(reflectance=holes), sun_zenith=40.0)
    assert (found.segment[5] == -1).all()
    assert (np.delete(found.segment, 5, axis=0) >= 0).all()


def test_segments_split_where_materials_meet() -> None:
    cube = np.full((24, 30, 4), 0.1, np.float32)
    cube[:, 12:] = 0.3
    cube[3, 3] = 0.9  # a single pixel goes with its neighbours
    segments = divide(cube)
    assert segments.size.tolist() == [24 * 12, 24 * 18]
    assert not segments.sure[3, 3]
    pairs = touching(segments.number, 2)
    assert (pairs.one.tolist(), pairs.length.tolist()) == ([0, 1], [24, 24])
    assert pairs.sides.tolist() == [[0, 0, 24, 0], [0, 0, 0, 24]]


def test_a_measured_split_must_fit() -> None:
    expect_refusals(
        (SchemaError, "length-mismatch", lambda: measured_fraction(np.ones(3), NM)),
        (SchemaError, "value-out-of-range", lambda: measured_fraction(np.full(NM.size, 1.5), NM)),
    )
    given = xr.DataArray([0.4, 0.1], {"wavelength": ("w", [400.0, 1000.0])}, "w")
    np.testing.assert_allclose(measured_fraction(given, NM), np.linspace(0.4, 0.1, NM.size))
    nothing = xr.Dataset()
    # flying north, sun in the south: shadows ahead; sun in the east: to the left
    np.testing.assert_allclose(shadow_side_of(nothing, 180.0, 0.0), [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shadow_side_of(nothing, 90.0, 0.0), [0.0, -1.0], atol=1e-12)
    assert shadow_side_of(nothing, None, 0.0) is None
    # of a picture with the lines or columns in reverse
    reverse = xr.Dataset(coords={"along_track": [2, 1], "cross_track": [0, 1]})
    leftward = reverse.assign(look_across=("cross_track", [3.0, -3.0]))
    np.testing.assert_allclose(shadow_side_of(reverse, 180.0, 0.0), [-1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shadow_side_of(leftward, 90.0, 0.0), [0.0, 1.0], atol=1e-12)


def test_pvlib_gives_a_split_near_that_of_the_core() -> None:
    pytest.importorskip("pvlib")
    from hyperpaint.surroundings.corrections import diffuse_from_clear_sky

    ours, theirs = (diffuse_from_clear_sky(source, NM, 30.0) for source in ("model", "pvlib"))
    np.testing.assert_allclose(ours, theirs, rtol=0.15, atol=0.01)


@pytest.mark.parametrize("snr", [40.0, 100.0])
def test_the_noise_of_channels_is_measured(snr: float) -> None:
    cube, _, _ = box_shadow(NM, ASPHALT, RED)
    found = hp.surroundings.survey(as_line(cube, NM, snr=snr), sun_zenith=40.0).noise
    # a channel is the mean of four bands
    np.testing.assert_allclose(found, 1.0 / snr / 2.0, rtol=0.1)
    assert (hp.surroundings.survey(as_line(cube, NM), sun_zenith=40.0).noise < 2e-4).all()
    assert (
        channel_noise(np.ones((4, 4, 2), np.float32), np.zeros((4, 4), np.int32), cube[:4, :4, 0] > 0) == 0
    ).all()


def test_smile_is_taken_out_of_channels() -> None:
    centre = np.linspace(412.0, 988.0, 24)
    shift = np.stack([np.zeros(24), np.full(24, 3.0), np.linspace(-2.0, 2.0, 24)], axis=1)
    seen = smooth_edge(centre[:, None] + shift, 600.0, 0.04, 0.6, 60.0).T[None].repeat(40, axis=0)
    channels = seen.astype(np.float32)
    channels[3, 2, 5] = np.nan
    to_nominal_channels(channels, centre, shift)
    true = smooth_edge(centre, 600.0, 0.04, 0.6, 60.0)
    assert np.nanmax(np.abs(channels - true)) < 0.0025 < 0.05 * np.abs(seen - true).max() * 10
    assert np.isnan(channels[3, 2, 5])
    assert np.isnan(channels).sum() == 1
    np.testing.assert_array_equal(channels[:, 0], seen[:, 0].astype(np.float32))


def test_a_smile_changes_no_flags() -> None:
    cube, _ = bonnet(NM, RED)
    smile = 3.0 * np.linspace(-1.0, 1.0, cube.shape[1]) ** 2
    bent = np.stack(
        [[np.interp(NM + nm, NM, here) for nm, here in zip(smile, row, strict=True)] for row in cube]
    )
    straight = hp.surroundings.flag(as_line(cube, NM, snr=200.0), sun_zenith=30.0)
    flagged = hp.surroundings.flag(
        as_line(bent, NM, snr=200.0).assign_coords(wavelength_shift=("cross_track", smile, {"units": "nm"})),
        sun_zenith=30.0,
    )
    assert (flagged.quality.values != straight.quality.values).mean() < 0.01
    inside = np.s_[:, 30:66]
    apart = (flagged.glint_fraction - straight.glint_fraction).values[inside]
    assert np.abs(apart[straight.glint_fraction.values[inside] < 0.5]).mean() < 0.001


def test_parts_of_one_car_show_one_paint() -> None:
    direct = 1.0 - diffuse_fraction(NM, 30.0)
    cube = np.broadcast_to(ASPHALT, (80, 96, NM.size)).copy()
    cube[10:40, 20:70] = RED  # the roof
    cube[40:46, 20:70] = 0.02
    _, sunward = split_of(BANDS, "model", 30.0).mirrored()
    # the bonnet, in glint all over, and in the light around the sun
    cube[46:70, 20:70] = 0.9 * RED + 0.03 * direct + 0.04 * sunward * (1.0 - direct)
    line = as_line(cube, NM, snr=200.0)
    model = hp.surroundings.survey(line, sun_zenith=30.0)
    roof, bonnet_ = model.body[model.segment[20, 40]], model.body[model.segment[60, 40]]
    assert roof != bonnet_
    assert model.paint[roof] == model.paint[bonnet_] != model.paint[model.segment[5, 5]]
    clean = np.bincount(model.channel, RED) / np.bincount(model.channel)
    scale = model.reference[bonnet_, -1] / clean[-1]
    np.testing.assert_allclose(model.reference[bonnet_] / scale, clean, rtol=0.005, atol=0.0025)
    flagged = hp.surroundings.flag(line, model).compute()
    np.testing.assert_allclose(flagged.glint_fraction.values[50:66, 30:60], 0.03, atol=0.008)
    # that much all over a panel, without a spot, may be what flakes do: it is no glint for certain
    assert not (flagged.quality.values[50:66, 30:60] & int(Quality.GLINT)).any()
    assert not (flagged.quality.values[12:38, 24:66] & int(Quality.ADJACENCY)).any()


def test_a_clear_sky_has_a_dark_zenith_and_a_bright_side(tmp_path: Path, shadow_line: xr.Dataset) -> None:
    model = hp.surroundings.survey(shadow_line, sun_zenith=60.0)
    blue, red = np.searchsorted(model.channel_wavelength, [450.0, 850.0])
    # a Monte Carlo of molecules and aerosol has 0.53 and 0.34 there
    np.testing.assert_allclose(model.zenith_radiance[[blue, red]], [0.53, 0.34], rtol=0.07)
    # where the sun is, aerosol makes the sky brighter, and redder than elsewhere
    assert 1.0 < model.sunward_radiance[blue] < model.sunward_radiance[red]
    hp.to_store(model.to_dataset(), tmp_path / "m.zarr", "models/raw_0")
    stored = hp.open_store(tmp_path / "m.zarr", "models/raw_0")
    np.testing.assert_array_equal(
        hp.surroundings.SceneModel.from_dataset(stored).sunward_radiance, model.sunward_radiance
    )
    # models of before say nothing of directions: they were made with a uniform sky
    before = hp.surroundings.SceneModel.from_dataset(
        stored.drop_vars(["zenith_radiance", "sunward_radiance"])
    )
    assert (before.zenith_radiance == 1.0).all()
    assert (before.sunward_radiance == 0.0).all()
    with pytest.raises(SchemaError, match=r"zenith.*out-of-range"):
        hp.surroundings.SceneModel.from_dataset(stored.assign(zenith_radiance=-stored.zenith_radiance))
    # a measured split may be of any sky
    measured = hp.surroundings.survey(shadow_line, sun_zenith=60.0, diffuse=diffuse_fraction(NM, 60.0))
    assert (measured.zenith_radiance == 1.0).all()


@pytest.mark.parametrize(("zenith", "amount"), [(35.0, 0.04), (60.0, 0.03)])
def test_the_sky_around_the_sun_in_a_coat_is_no_glint(zenith: float, amount: float) -> None:
    split = diffuse_fraction(NM, zenith)
    above, sunward = split_of(BANDS, "model", zenith).mirrored()
    cube = np.broadcast_to(ASPHALT, (80, 96, NM.size)).copy()
    cube[10:70, 20:76] = RED + 0.04 * above * split
    cube[30:50, 36:60] += amount * sunward * split
    assert (amount * sunward * split / (1.0 - split)).mean() > 0.0075
    flagged = hp.surroundings.flag(as_line(cube, NM, snr=100.0), sun_zenith=zenith).compute()
    inside = np.s_[12:68, 22:74]
    assert ((flagged.quality.values[inside] & int(Quality.GLINT)) > 0).mean() < 0.001
    cube[38:42, 44:50] += 0.2 * (1.0 - split)
    flagged = hp.surroundings.flag(as_line(cube, NM, snr=100.0), sun_zenith=zenith).compute()
    np.testing.assert_allclose(flagged.glint_fraction.values[38:42, 44:50], 0.2, atol=0.02)


def test_neither_glint_nor_grey_things_light_others() -> None:
    nm = np.linspace(412.0, 988.0, 24)
    light = Light.under(diffuse_fraction(nm, 40.0))
    red = 0.04 + 0.5 / (1.0 + np.exp((600.0 - nm) / 10.0))
    spectrum = np.stack([np.full(24, 0.1), red, 8.0 * red, np.linspace(0.6, 0.75, 24)])
    number = np.zeros((32, 80), np.int32)
    for place in (1, 2, 3):
        number[8:24, 20 * place : 20 * place + 10] = place
    size = np.bincount(number.ravel()).astype(np.int64)
    lit = Matches(np.full(4, LIT, np.int8), np.arange(4, dtype=np.int32))
    assert set(np.unique(nearest_coloured(number, size, spectrum, lit, light, 120))) == {-1, 1}
