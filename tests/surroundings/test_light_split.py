"""Where the diffuse fraction of a line is from, and what sky that is."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light.clear_sky import zenith_radiance
from hyperpaint.light.diffuse_record import SKY_STATES, split_of_lines
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.simulation import simulate_line
from hyperpaint.surroundings.corrections import split_of, sun_zenith_of

NM = np.linspace(420.0, 980.0, 15)
LINES = 8


def flat(**own: Any) -> xr.Dataset:
    # Return a grey line; ``own`` are variables of its light
    seen = np.full((LINES, NM.size, 6), 0.2, np.float32)
    cube = (("along_track", "band", "cross_track"), seen, {"units": "1"})
    units = {"units": "1"}
    variables = {
        name: ((("along_track", "band") if value.ndim == 2 else ("along_track",)), value, units)
        for name, value in own.items()
    }
    return xr.Dataset({"reflectance": cube, **variables}, {"wavelength": ("band", NM, {"units": "nm"})})


def recorded(fraction: Any, word: str) -> xr.Dataset:
    return flat(
        diffuse_fraction=np.full((LINES, NM.size), fraction, np.float32),
        diffuse_fraction_u=np.full((LINES, NM.size), 0.02, np.float32),
        sky_state=np.full(LINES, SKY_STATES.index(word), np.int8),
    )


def taken(line: xr.Dataset, **options: Any) -> np.ndarray:
    bare = hp.surroundings.remove_mirrored_sky(line, sun_zenith=40.0, **options).reflectance
    return 0.2 - bare.isel(along_track=3, cross_track=2).values


def test_a_clear_sky_is_not_taken_in_silence() -> None:
    for use in (
        lambda **options: hp.surroundings.survey(flat(), sun_zenith=40.0, **options),
        lambda **options: hp.surroundings.remove_mirrored_sky(flat(), sun_zenith=40.0, **options),
        lambda **options: hp.surroundings.correct_light(flat(), direct=0.9, sun_zenith=40.0, **options),
    ):
        with pytest.warns(PaintWarning, match="clear-sky-assumed"):
            use()
        use(diffuse="model")  # warnings are errors: said, there is none


@pytest.mark.parametrize("word", ["overcast", "clear", "hazy"])
def test_the_lines_own_sky_goes_first(word: str) -> None:
    # a clear record has the sky of its haze
    fraction = 0.6 if word == "overcast" else diffuse_fraction(NM, 40.0, aerosol_optical_depth=0.25)
    zenith = 9.0 / 7.0 if word == "overcast" else zenith_radiance(NM, 40.0, aerosol=0.25)
    np.testing.assert_allclose(taken(recorded(fraction, word)), 0.04 * fraction * zenith, rtol=1e-3)
    # what the user says goes before
    np.testing.assert_allclose(taken(recorded(0.6, word), sky="uniform"), 0.024, rtol=1e-4)
    modelled = 0.04 * diffuse_fraction(NM, 40.0) * zenith_radiance(NM, 40.0)
    np.testing.assert_allclose(taken(recorded(0.6, word), diffuse="model"), modelled, rtol=1e-4)


def test_broken_skies_are_in_between_by_their_share() -> None:
    share = (0.6 - diffuse_fraction([NM[3]], 40.0)[0]) / (1.0 - diffuse_fraction([NM[3]], 40.0)[0])
    expected = 0.04 * 0.6 * ((1.0 - share) * zenith_radiance(NM, 40.0) + share * 9.0 / 7.0)
    assert NM[3] == 540.0
    for word in ("broken", "contradictory"):
        np.testing.assert_allclose(taken(recorded(0.6, word)), expected, rtol=1e-4)
    with pytest.warns(PaintWarning, match="sky-contradictory"):
        hp.surroundings.survey(recorded(0.6, "contradictory"), sun_zenith=40.0)


def test_a_survey_takes_the_mean_of_the_lines() -> None:
    line = recorded(0.6, "broken")
    line["diffuse_fraction"][: LINES // 2] = 0.2
    model = hp.surroundings.survey(line, sun_zenith=40.0)
    np.testing.assert_allclose(model.diffuse_fraction, 0.4, rtol=1e-6)
    # of lines that differ, the spread is part of the doubt
    np.testing.assert_allclose(model.attrs["diffuse_fraction_u"], np.hypot(0.02, 0.2), rtol=1e-5)
    assert model.attrs["sky_states"] == "broken"
    assert "own record, sky broken" in model.attrs["diffuse_fraction_from"]
    assert hp.surroundings.SceneModel.from_dataset(model.to_dataset()).attrs["sky_states"] == "broken"


def test_a_line_with_a_record_alone() -> None:
    line = simulate_line(lines=32, bands=40, columns=24)
    whole = split_of(line, None, None)
    own = split_of_lines(line)
    assert own is not None
    np.testing.assert_array_equal(whole.fraction, own.diffuse_fraction)
    assert whole.mean().states == ("clear",)
    assert own is not None
    stored = line.assign(own.data_vars)
    # the light is that of 22.6 degrees; with a sun at 75 it is no sky's, and near the clock's it is kept
    with pytest.warns(PaintWarning, match=r"75\.0 .*contradictory"):
        assert split_of(stored, None, 75.0).mean().states == ("contradictory",)
    assert split_of(stored, None, 23.0).mean().states == ("clear",)
    # clocks and places are off by less than two degrees
    clock = sun_zenith_of(line, None)
    for turned, is_kept in ((1.7, True), (2.3, False)):
        light = split_of(stored, None, clock + turned).fraction
        assert np.array_equal(light, own.diffuse_fraction) == is_kept


@pytest.mark.parametrize(("lines", "states"), [(8, ("clear", "broken")), (16, ("clear",))])
def test_states__are_those_of_a_tenth_of_the_lines(lines: int, states: tuple[str, ...]) -> None:
    line = xr.concat((lines // LINES) * [recorded(0.2, "clear")], "along_track", data_vars="minimal")
    line["sky_state"][0] = SKY_STATES.index("broken")
    assert split_of(line, None, 40.0).mean().states == states


def test_words_that_are_none() -> None:
    body = flat()
    body["reflectance"].attrs["mirror_reflection"] = "excluded"
    corner = hp.Region("corner", [(0, 0), (4, 0), (4, 4), (0, 4)])
    expect_refusals(
        (SchemaError, "choice-unknown", lambda: split_of(flat(), "guess", 30.0)),
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.surroundings.remove_mirrored_sky(flat(), diffuse="shadow", sun_zenith=30.0),
        ),
        (
            SchemaError,
            "choice-unknown",
            "'model', 'pvlib' or",
            lambda: hp.extract_signatures(body, corner, coat=True, diffuse="shadow", sun_zenith=30.0),
        ),
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.surroundings.correct_coat(body, diffuse="shadow", sun_zenith=30.0),
        ),
    )


def test_signatures_take_the_split_that_they_state() -> None:
    regions = hp.Regions((hp.Region("roof", [(0, 0), (0, 7), (5, 7), (5, 0)]),))
    for fraction, word in ((0.6, "clear"), (1.0, "overcast")):
        line = recorded(fraction, word)
        paints = hp.extract_signatures(line, regions, specular_sky=True, coat=False, sun_zenith=40.0)
        np.testing.assert_allclose(0.2 - paints.reflectance.values[0], taken(line), rtol=1e-4)
        np.testing.assert_allclose(paints.diffuse_fraction.values[0], fraction)
        assert float(paints.sun_zenith[0]) == 40.0


def test_without_a_word_the_sky_is_told_by_the_fraction() -> None:
    line = flat(diffuse_fraction=np.ones((LINES, NM.size), np.float32))
    np.testing.assert_allclose(taken(line), 0.04 * 9.0 / 7.0, rtol=1e-4)
    # nothing contradicts it, and the sun need not be known where it is not asked for
    assert split_of(line, None, None).mean().states == ()
    paints = hp.extract_signatures(line, hp.Regions((hp.Region("roof", [(0, 0), (0, 7), (5, 7), (5, 0)]),)))
    assert int(paints.sky_state[0]) == -1
    clear = recorded(0.3, "clear")
    with pytest.raises(SchemaError, match="sun-unknown"):
        split_of(clear, None, None).mean().mirrored()
    line = flat().assign(diffuse_fraction=(("irradiance_time", "band"), np.full((3, NM.size), 0.3)))
    with pytest.raises(SchemaError, match="dims-wrong"):
        taken(line)


def test_a_word_of_few_lines_is_none_of_the_flight() -> None:
    line = recorded(0.3, "clear").isel(along_track=np.arange(80) % LINES)
    for count, words in ((4, ("clear",)), (12, ("clear", "broken"))):
        state = line.sky_state.values.copy()
        state[:count] = SKY_STATES.index("broken")
        assert split_of(line.assign(sky_state=("along_track", state)), None, 40.0).mean().states == words


def test_a_dead_channel_of_the_record_costs_itself_alone() -> None:
    line = simulate_line(lines=16, bands=40, columns=6)
    whole = split_of_lines(line)
    dead = line.copy(deep=True).load()
    nm = dead.irradiance_wavelength.values
    dead.irradiance.values[:, np.abs(nm - 550.0).argmin()] = np.nan
    without = split_of_lines(dead)
    assert whole is not None
    assert without is not None
    assert np.isfinite(without.diffuse_fraction.values).all()
    np.testing.assert_allclose(without.diffuse_fraction, whole.diffuse_fraction, atol=0.02)
