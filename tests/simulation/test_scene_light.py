"""Light of scenes: spectra and haze, tables and measured series, clouds, skies, and the clock of the sun."""

import dataclasses
import functools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from dask.base import tokenize
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from oracles.disort_sky import relative_sky
from scipy.integrate import quad
from support.refusals import expect_error, expect_words, refusal
from support.traced_scenes import (
    FEW_BANDS,
    SERIES_NM,
    SUN,
    flat_light,
    flight,
    irradiance_series as series,
    two_cars,
)

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, UnitsError
from hyperpaint.io.skies import read_sky_csv, sky_dataset
from hyperpaint.light.sky_functions import clear_sky_shares, functions_towards
from hyperpaint.light.sun import solar_position
from hyperpaint.simulation.atmosphere import (
    CIE_OVERCAST_SHARE,
    PRESETS,
    Atmosphere,
    BrokenClouds,
    Haze,
    Sky,
    built_in_sky,
    cloud_factor,
    cloud_transmittance,
    preset_atmosphere,
    relative_air_mass,
    spectral_grid,
)
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.collect import simulate_collect
from hyperpaint.simulation.rendering.materials import Coat, Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import Scene, plane, sun_vectors
from hyperpaint.simulation.settings import (
    DEFAULT_START,
    NEAR_SUNSET,
    ORIGIN,
    SimulationSettings,
    sun_at,
    when_sun_stands,
)

# --- four curves ---

GRID = np.arange(400.0, 1001.0, 1.0)
UNITS = {
    "sun": "W m-2 nm-1",
    "sky": "W m-2 nm-1",
    "extinction": "m-1",
    "path_radiance": "W m-2 sr-1 nm-1 m-1",
}


def total(curve: np.ndarray, wavelength: np.ndarray, first: float = 400.0, last: float = 1000.0) -> float:
    inside = (wavelength >= first) & (wavelength <= last)
    return float(np.trapezoid(curve[inside], wavelength[inside]))


class TestAtmosphere:
    def test_curves_are_kept_apart_cannot_be_changed_and_travel(self) -> None:
        sun = np.ones(3)
        made = Atmosphere([1, 2, 3], sun, sun, sun, sun, 60.0, 0.0)
        sun[:] = 7.0
        assert made.sun.dtype == made.wavelength.dtype == np.float64
        assert_allclose(made.sun, 1.0)
        with pytest.raises(ValueError, match="read-only"):
            made.sun[0] = 2.0
        assert_allclose(made.irradiance, 1.5)  # normal times cos 60, and the sky
        # pickled, it is the same
        noon = preset_atmosphere("noon")
        back = pickle.loads(pickle.dumps(noon))
        assert_allclose(back.sky, noon.sky, atol=0)
        assert back.haze == noon.haze
        assert tokenize(noon) == tokenize(back)  # dask names tasks by it
        assert tokenize(noon) != tokenize(preset_atmosphere("cloudy"))

    def test_all_problems_at_once(self) -> None:
        wrong = ([2, 1], [np.nan, 1], [-1, 1], [1, 1, 1], [1, 1], 90.0, np.inf, 2.0, "bad")
        expect_words(
            str(expect_error(SchemaError, None, lambda: Atmosphere(*wrong))),
            *("'bad'", "wavelength-unordered", "sun has 1", "sky falls to -1", "extinction has shape"),
            *("sun_zenith=90.0", "sun_azimuth=inf", "overcast_share=2.0"),
        )
        words = ("visibility", "angstrom", "asymmetry", "scattering_albedo", "ground")
        expect_words(str(expect_error(SchemaError, None, lambda: Haze(1e9, 9.0, 1.0, 2.0, -1.0))), *words)

    def test_dataset_and_back(self) -> None:
        made = Atmosphere.clear(50.0, 123.0, wavelength=GRID).clouded(3)
        dataset = made.to_dataset()
        for name, units in UNITS.items():
            assert (dataset[name].attrs["units"], dataset[name].dtype) == (units, np.float64)
        assert dataset.wavelength.attrs["units"] == "nm"
        back = Atmosphere.from_dataset(dataset)
        for name in ("wavelength", *UNITS):
            assert_allclose(getattr(back, name), getattr(made, name), atol=0)
        for name in ("sun_zenith", "sun_azimuth", "overcast_share", "name", "haze"):
            assert getattr(back, name) == getattr(made, name)
        # in other units
        clear = Atmosphere.clear(50.0, wavelength=GRID).to_dataset()
        milliwatts = clear.assign(sun=(clear.sun * 1000.0).assign_attrs(units="mW m-2 nm-1"))
        assert_allclose(Atmosphere.from_dataset(milliwatts).sun, clear.sun, rtol=1e-12)


class TestClearSky:
    def test_it_is_the_simulators_sky(self) -> None:
        made = Atmosphere.clear(25.0, wavelength=GRID)
        direct, diffuse = Sky(25.0).irradiance(GRID)
        assert_allclose(made.sun * np.cos(np.radians(25.0)), direct, rtol=1e-12)
        assert_allclose(made.sky, diffuse, rtol=1e-12)

    @pytest.mark.parametrize(
        ("zenith", "mass"), [(0.0, 1.0), (60.0, 1.9943), (75.0, 3.8131), (85.0, 10.306), (90.0, 37.92)]
    )
    def test_air_mass_of_kasten_and_young(self, zenith: float, mass: float) -> None:
        # printed to four digits in their table
        assert relative_air_mass(zenith) == pytest.approx(mass, rel=1e-3)

    def test_it_has_the_lines_of_oxygen(self) -> None:
        noon, sunset = preset_atmosphere("noon"), preset_atmosphere("near_sunset")
        depths = []
        for sky in (noon, sunset):
            band = (sky.wavelength > 760.0) & (sky.wavelength < 763.0)
            beside = (sky.wavelength > 752.0) & (sky.wavelength < 757.0)
            depths.append(sky.irradiance[band].mean() / sky.irradiance[beside].mean())
        assert depths[1] < 0.8 * depths[0]
        assert 0.2 < depths[0] < 0.6
        assert noon.wavelength[0] <= 350.0  # which the cameras need
        assert noon.wavelength[-1] >= 1050.0
        assert_allclose(noon.wavelength, spectral_grid(340.0, 1100.0), atol=0)

    def test_noon_is_within_published_clear_skies(self) -> None:
        noon = preset_atmosphere("noon")
        found = total(noon.irradiance, noon.wavelength)
        # SPECTRL2 (see below), from June's distance of the sun to its mean, 69 % of it within 400-1000 nm
        assert found == pytest.approx(0.69 * (935.0 * np.cos(np.radians(25.0)) + 110.0) * 1.0338, rel=0.03)
        assert 0.05 < total(noon.sky, noon.wavelength) / found < 0.2


@pytest.mark.real_data
class TestReferenceSpectra:
    # ASTM G173: direct light at zenith angle 48.19 degrees, aerosol depth 0.084 at 500 nm, ozone 0.344
    @pytest.fixture
    def reference(self, shared_data: Path) -> tuple[np.ndarray, np.ndarray]:
        table = np.genfromtxt(shared_data / "downwelling" / "ASTMG173.csv", delimiter=",", skip_header=3)
        # the file's headings of direct and global are swapped: the standard's direct light is 900 W m-2
        return table[:, 0], table[:, 3]

    def test_the_built_in_sky(self, reference: tuple[np.ndarray, np.ndarray]) -> None:
        wavelength, direct = reference
        ours = Atmosphere.clear(48.19, aerosol=0.084, ozone=0.344)
        assert total(ours.sun, ours.wavelength) == pytest.approx(total(direct, wavelength), rel=0.07)
        for centre in range(420, 1000, 20):
            if 710 < centre < 730 or 890 < centre < 985:
                continue  # the water lines are where they please
            assert total(ours.sun, ours.wavelength, centre - 20, centre + 20) == pytest.approx(
                total(direct, wavelength, centre - 20, centre + 20), rel=0.2
            )

    def test_as_a_table(self, reference: tuple[np.ndarray, np.ndarray]) -> None:
        wavelength, direct = reference
        table = sky_dataset("G173", wavelength, direct, 0.1 * direct)
        made = Atmosphere.from_table(table, sun_zenith=48.19)
        assert total(made.sun, made.wavelength, 280, 4000) == pytest.approx(900.1, abs=0.5)


class TestPresets:
    def test_the_papers_three(self) -> None:
        noon, sunset, cloudy = (preset_atmosphere(name) for name in PRESETS)
        assert (noon.sun_zenith, sunset.sun_zenith, cloudy.sun_zenith) == (25.0, 82.0, 25.0)
        assert (cloudy.sun == 0.0).all()
        assert cloudy.overcast_share == pytest.approx(4.0 / 7.0)
        assert [sky.name for sky in (noon, sunset, cloudy)] == list(PRESETS)
        levels = [total(sky.irradiance, sky.wavelength) for sky in (noon, sunset, cloudy)]
        assert levels[0] > levels[2] > levels[1]
        # near sunset most of the blue comes from the sky, most of the red from the sun
        blue, red = np.searchsorted(sunset.wavelength, [450.0, 860.0])
        level = sunset.sun * sunset.sun_cosine
        assert level[blue] < 0.4 * sunset.sky[blue]
        assert level[red] > 1.5 * sunset.sky[red]
        assert preset_atmosphere("noon") is noon  # made once


class TestHaze:
    @given(st.floats(500.0, 300_000.0))
    def test_at_the_visibility_two_per_cent_of_contrast_are_left(self, visibility: float) -> None:
        assert np.exp(-Haze(visibility).extinction(np.array([550.0]))[0] * visibility) == pytest.approx(
            0.02, rel=1e-3
        )

    def test_haze_of_the_prototype_pure_air_and_none(self) -> None:
        lost = 1.0 - np.exp(-Haze().extinction(np.array([550.0]))[0] * np.array([15.0, 120.0, 3000.0]))
        assert_allclose(lost, [0.0026, 0.020, 0.40], rtol=0.03)
        # pure air scatters as the fourth power
        blue, red = Haze(3.912 / 1.162e-5).extinction(np.array([400.0, 800.0]))
        assert blue / red == pytest.approx(2.0**4.08, rel=1e-6)
        # without haze there is no path
        made = Atmosphere.clear(30.0, wavelength=GRID, haze=None)
        assert not np.any([made.extinction, made.path_radiance])

    @given(st.floats(-0.9, 0.9), st.floats(2_000.0, 300_000.0))
    def test_in_even_light_a_path_changes_nothing(self, asymmetry: float, visibility: float) -> None:
        # a uniform sky over a white ground, and air that absorbs nothing: all is one radiance, E / pi
        haze = Haze(visibility, asymmetry=asymmetry, scattering_albedo=1.0, ground=1.0)
        sky = 1.0 + np.sin(GRID / 50.0) ** 2
        path = haze.path_radiance(GRID, np.zeros_like(GRID), sky, 40.0)
        assert_allclose(path, haze.extinction(GRID) * sky / np.pi, rtol=1e-9)

    @pytest.mark.parametrize("asymmetry", [-0.5, 0.0, 0.65, 0.9])
    def test_scattered_sunlight_is_all_of_it(self, asymmetry: float) -> None:
        # over all directions of the sun the phase function averages to 1: zenith angles 0 to 180 degrees
        haze = Haze(5_000.0, asymmetry=asymmetry, scattering_albedo=1.0, ground=0.0)
        one, none = np.ones(1), np.zeros(1)

        def path(cosine: float) -> float:
            return float(haze.path_radiance(GRID[:1], one, none, np.degrees(np.arccos(cosine)))[0])

        assert (0.5 * quad(path, -1.0, 1.0)[0]) == pytest.approx(
            haze.extinction(GRID[:1])[0] / (4.0 * np.pi), rel=1e-6
        )

    def test_the_back_share_is_that_of_its_phase_function(self) -> None:
        haze = Haze(5_000.0, asymmetry=0.65, scattering_albedo=1.0, ground=0.0)
        air = Haze(3.912 / 1.162e-5, ground=0.0)
        one, none = np.ones(1), np.zeros(1)
        grid = np.array([550.0])
        downward = haze.path_radiance(grid, none, one, 0.0)[0] - air.path_radiance(grid, none, one, 0.0)[0]
        from_above = quad(
            lambda u: float((haze.path_radiance(grid, one, none, np.degrees(np.arccos(u)))
                             - air.path_radiance(grid, one, none, np.degrees(np.arccos(u))))[0]),
            0.0, 1.0,
        )[0]  # fmt: skip
        # a uniform sky of irradiance 1 has radiance 1 / pi from every direction of the upper half
        assert downward == pytest.approx(2.0 * np.pi * from_above / np.pi, rel=1e-6)


# --- measured light ---

HEADER = "wavelength [nm], sun [W m-2 nm-1], sky [W m-2 nm-1]"


class TestSeries:
    @pytest.mark.parametrize(("second", "level"), [("00", 1.0), ("10", 2.0), ("15", 2.5), ("20", 3.0)])
    def test_at_samples_and_between(self, second: str, level: float) -> None:
        made = Atmosphere.from_irradiance(series(), sun_zenith=60.0, time=f"2020-06-21T17:00:{second}")
        assert_allclose(made.irradiance, level, rtol=1e-7)
        assert made.sun.dtype == np.float64

    def test_the_default_split_is_the_built_in_sky(self) -> None:
        made = Atmosphere.from_irradiance(series(1), sun_zenith=60.0)
        sun, sky = built_in_sky(SERIES_NM, 60.0)
        assert_allclose(made.sun * made.sun_cosine / made.sky, sun * 0.5 / sky, rtol=1e-9)
        # units are converted
        converted = Atmosphere.from_irradiance(series(1, "mW m-2 nm-1"), sun_zenith=60.0)
        assert_allclose(converted.irradiance, 1e-3, rtol=1e-6)

    @pytest.mark.parametrize("fraction", [0.0, 0.8, 1.0, np.linspace(0.2, 0.9, SERIES_NM.size)])
    def test_a_split_by_hand(self, fraction: object) -> None:
        made = Atmosphere.from_irradiance(series(1), sun_zenith=60.0, direct_fraction=fraction)
        assert_allclose(made.sun * 0.5, np.broadcast_to(fraction, SERIES_NM.shape), rtol=1e-7)
        assert_allclose(made.irradiance, 1.0, rtol=1e-7)

    def test_noise_below_zero_is_cut_and_more_is_refused(self) -> None:
        noisy = series(1)
        noisy.irradiance[0, :2] = -0.009
        with pytest.warns(PaintWarning, match="2 of 121.*irradiance-negative"):
            made = Atmosphere.from_irradiance(noisy, sun_zenith=60.0)
        assert (made.irradiance[:2] == 0.0).all()
        noisy.irradiance[0, 0] = -0.011
        expect_error(
            SchemaError,
            r"sky.*value-out-of-range",
            lambda: Atmosphere.from_irradiance(noisy, sun_zenith=60.0),
        )
        noisy.irradiance[0, 0] = np.nan
        expect_error(SchemaError, r"not.finite", lambda: Atmosphere.from_irradiance(noisy, sun_zenith=60.0))


class TestTable:
    def write(self, folder: Path, text: str | bytes) -> Path:
        path = folder / "modtran.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    def test_three_columns_in_any_order_of_rows_with_or_without_haze(self, tmp_path: Path) -> None:
        path = self.write(tmp_path, f"# MODTRAN\n\n{HEADER}\n500,2,0.25\n# gap\n400,1,0.5\n")
        made = Atmosphere.from_table(read_sky_csv(path), sun_zenith=30.0, sun_azimuth=90.0)
        assert_allclose([made.wavelength, made.sun, made.sky], [[400.0, 500.0], [1.0, 2.0], [0.5, 0.25]])
        assert (made.extinction == 0.0).all()
        assert (made.name, made.sun_azimuth) == ("modtran", 90.0)
        hazy = Atmosphere.from_table(read_sky_csv(path), sun_zenith=30.0, haze=Haze())
        assert_allclose(hazy.extinction, Haze().extinction(hazy.wavelength))

    def test_five_columns_in_other_units_and_order(self, tmp_path: Path) -> None:
        header = (
            "sky (uW cm-2 nm-1),WAVELENGTH [um],extinction [km-1],sun[W m-2 um-1],"
            "path_radiance [W m-2 sr-1 nm-1 km-1]"
        )
        path = self.write(tmp_path, f"\ufeff{header}\r\n50,0.4,0.17,1000,0.01\r\n25,0.5,0.1,2000,0.02\r\n")
        made = Atmosphere.from_table(read_sky_csv(path), sun_zenith=30.0, haze=Haze())
        assert_allclose([made.wavelength, made.sun, made.sky], [[400.0, 500.0], [1.0, 2.0], [0.5, 0.25]])
        assert_allclose(made.extinction, [1.7e-4, 1e-4])
        assert_allclose(made.path_radiance, [1e-5, 2e-5])
        assert made.haze is None

    @pytest.mark.parametrize(
        ("text", "problem"),
        [
            ("", "column-missing"),
            ("# nothing\n", "column-missing"),
            ("400,1,2\n500,1,2\n", "'400'.*heading-unreadable"),
            (f"{HEADER}\n", "length-mismatch"),
            (f"{HEADER}\n400,1,1\n", "wavelength-repeated"),
            (f"{HEADER}\n400,1\n500,1,1\n", "row 2.*length-mismatch"),
            (f"{HEADER}\n400,1,1_0\n500,1,1\n", "1_0.*number-unreadable"),
            (f"{HEADER}\n400,1,one\n500,1,1\n", "one.*number-unreadable"),
            (f"{HEADER}\n400,nan,1\n500,1,1\n", "not-finite"),
            (f"{HEADER}\n400,1e999,1\n500,1,1\n", "number-unreadable"),
            (f"{HEADER}\n400,-1,1\n500,1,1\n", "value-out-of-range"),
            ("wavelength [nm], sun [W m-2 nm-1]\n400,1\n500,1\n", "diffuse.*column-missing"),
            ("wavelength [nm], sun, sky [W m-2 nm-1]\n400,1,1\n500,1,1\n", "sun.*heading-unreadable"),
            (f"{HEADER}, sun [W m-2 nm-1]\n400,1,1,1\n500,1,1,1\n", "column-repeated"),
            (f"{HEADER}, moon [W m-2 nm-1]\n400,1,1,1\n500,1,1,1\n", "heading-unreadable"),
            (f"{HEADER}, extinction [m-1]\n400,1,1,1\n500,1,1,1\n", "column-missing"),
            (b"wavelength\xff\n", "heading-unreadable"),
            ("wavelength [nm], sun [W m-2], sky [W m-2 nm-1]\n400,1,1\n500,1,1\n", "units-"),
        ],
    )
    def test_files_that_are_none(self, tmp_path: Path, text: str | bytes, problem: str) -> None:
        expect_error(
            (FormatError, UnitsError),
            problem,
            lambda: Atmosphere.from_table(read_sky_csv(self.write(tmp_path, text)), sun_zenith=30.0),
        )

    @given(st.binary(max_size=300) | st.text(alphabet="waveln gth[m],su\n0159.e-#()_°٣ ", max_size=300))
    def test_whatever_a_file_holds(self, tmp_path: Path, text: str | bytes) -> None:
        for before in (b"", HEADER.encode() + b"\n"):
            content = before + (text if isinstance(text, bytes) else text.encode())
            try:
                Atmosphere.from_table(read_sky_csv(self.write(tmp_path, content)), sun_zenith=30.0)
            except (FormatError, UnitsError):
                continue


# --- clouds ---


clear_of = functools.cache(functools.partial(Atmosphere.clear, wavelength=GRID))


def test_amount_of_kasten_and_czeplak_and_colour_of_clouds() -> None:
    # 1 - 0.75 (N/8)^3.4 by hand
    for oktas, left in ((0, 1.0), (4, 0.92895), (6, 0.71800), (8, 0.25)):
        assert cloud_factor(oktas) == pytest.approx(left, abs=1e-4)
    # colour of an overcast sky
    # the prototype's figures; the ratio at 490 nm is the cloud factor itself
    found = cloud_transmittance(np.array([400.0, 490.0, 700.0, 1000.0]), 8)
    assert_allclose(found, [0.306, 0.250, 0.216, 0.208], atol=5e-4)
    # the printed coefficients, a(CF) = 0.76 + 0.24 CF and b(CF) = 0.24 (1 - CF)
    factor = cloud_factor(6)
    expected = factor * (0.76 + 0.24 * factor + 0.24 * (1.0 - factor) * (GRID / 490.0) ** -4)
    assert_allclose(cloud_transmittance(GRID, 6), expected, rtol=1e-12)
    assert_allclose(cloud_transmittance(GRID, 8, colour=0.0), 0.25, rtol=1e-14)


@given(st.floats(0.0, 8.0), st.sampled_from([0.0, 35.0, 60.0, 85.0]))
def test_light_is_split_and_never_negative(oktas: float, zenith: float) -> None:
    clear = clear_of(zenith)
    cloudy = clear.clouded(oktas)
    assert_allclose(cloudy.sun, clear.sun * (1.0 - oktas / 8.0), rtol=1e-12, atol=1e-18)
    assert_allclose(cloudy.irradiance, clear.irradiance * cloud_transmittance(GRID, oktas), rtol=1e-12)
    assert (cloudy.sky >= 0.0).all()
    assert (cloudy.path_radiance >= 0.0).all()


def test_eight_oktas_leave_no_sun_and_a_cie_sky() -> None:
    clear = clear_of(40.0)
    overcast = clear.clouded(8)
    assert (overcast.sun == 0.0).all()
    assert (overcast.overcast_share, overcast.name) == (CIE_OVERCAST_SHARE, "clear, 8 oktas")
    blue, red = np.searchsorted(GRID, [450.0, 700.0])
    assert (
        overcast.irradiance[blue] / overcast.irradiance[red] > clear.irradiance[blue] / clear.irradiance[red]
    )
    # no clouds change nothing
    same = clear.clouded(0)
    for name in ("sun", "sky", "extinction", "path_radiance"):
        assert_allclose(getattr(same, name), getattr(clear, name), rtol=1e-12)
    assert same.overcast_share == 0.0


def test_the_two_parts_are_the_cie_overcast_sky() -> None:
    cosine = (np.arange(100_000) + 0.5) / 100_000
    cie = (1.0 + 2.0 * cosine) / 3.0  # zenith radiance 1
    level = 2.0 * np.pi * np.mean(cie * cosine)
    assert level == pytest.approx(7.0 * np.pi / 9.0, rel=1e-8)
    share = CIE_OVERCAST_SHARE
    assert_allclose((1.0 - share) * level / np.pi + share * 1.5 * cosine * level / np.pi, cie, rtol=1e-8)


def test_a_path_adds_in_proportion_where_the_haze_is_not_known() -> None:
    clear = clear_of(40.0)
    overcast = Atmosphere(
        GRID,
        clear.sun,
        clear.sky,
        clear.extinction,
        clear.path_radiance,
        40.0,
        180.0,
        name="table",
    ).clouded(8)
    light = overcast.sky * 2.0 / (clear.sun + 2.0 * clear.sky)
    assert_allclose(overcast.path_radiance, clear.path_radiance * light, rtol=1e-12)
    dark = Atmosphere(
        GRID,
        0 * GRID,
        0 * GRID,
        0 * GRID,
        0 * GRID,
        40.0,
        180.0,
    ).clouded(8)
    assert (dark.path_radiance == 0.0).all()


@pytest.mark.parametrize(("oktas", "colour", "words"), [(-1, 1.0, "oktas"), (8.5, 1.0, "oktas"),
    (np.nan, 1.0, "oktas"), (9, -1.0, "(?s)oktas.*colour")])  # fmt: skip
def test_there_are_no_such_oktas(oktas: float, colour: float, words: str) -> None:
    expect_error(SchemaError, words, lambda: clear_of(40.0).clouded(oktas, colour=colour))


EAST, NORTH = np.meshgrid(np.arange(0.0, 20_000.0, 50.0), np.arange(0.0, 20_000.0, 50.0))


@pytest.mark.parametrize("cover", [0.2, 0.5, 0.8])
def test_as_much_is_in_shadow_as_is_asked_for(cover: float) -> None:
    direct, diffuse = BrokenClouds(cover=cover, size=300.0, opacity=0.7).factors(EAST, NORTH, 0.0)
    assert np.mean((1.0 - direct) / 0.7) == pytest.approx(cover, abs=0.05)
    assert (direct.min(), direct.max()) == (pytest.approx(0.3), 1.0)
    assert np.ptp(diffuse) == 0.0 < diffuse[0, 0] - 1.0


def test_shadows_are_as_large_as_is_asked_for_and_go_with_the_wind() -> None:
    for size in (200.0, 800.0):
        direct, _ = BrokenClouds(size=size, cover=0.5).factors(EAST, NORTH, 0.0)
        part = direct - direct.mean()
        shift = round(size / 50.0)
        # a field with correlation 1/e, cut at its median: 2/pi arcsin(1/e)
        assert ((part[:, shift:] * part[:, :-shift]).mean() / (part**2).mean()) == pytest.approx(
            2.0 / np.pi * np.arcsin(np.exp(-1.0)), abs=0.12
        )
    # and go with the wind
    clouds = BrokenClouds(speed=10.0, heading=60.0)
    moved = 30.0 * 10.0 * np.array([np.sin(np.radians(60.0)), np.cos(np.radians(60.0))])
    np.testing.assert_allclose(
        clouds.factors(EAST + moved[0], NORTH + moved[1], 30.0), clouds.factors(EAST, NORTH, 0.0), atol=1e-9
    )


def relit(clouds: BrokenClouds, chunk_lines: int = 32) -> tuple[xr.Dataset, xr.Dataset]:
    flown = pushbroom(40, 24, altitude=40.0, ground_sample=2.0, line_spacing=2.0)
    trace = hp.simulation.trace(
        plane(400.0, Material("grey", "panel_20", "panel")), flown, [SUN], samples=4, sun_radius=0.0,
        chunk_lines=chunk_lines,
    )  # fmt: skip
    return trace, trace.paint.relight(FEW_BANDS, atmosphere=flat_light(), variation=clouds)


@pytest.mark.slow
def test_the_swath_is_lit_by_its_own_clouds() -> None:
    clouds = BrokenClouds(size=20.0, speed=5.0, seed=2, station=(3.0, 4.0))
    trace, made = relit(clouds)
    assert made.radiance.chunks is not None
    start = np.datetime64(trace.attrs["time_coverage_start"], "ns")
    direct, diffuse = clouds.factors(
        trace.east.values, trace.north.values, ((trace.time.values - start) / np.timedelta64(1, "s"))[:, None]
    )
    assert np.ptp(direct[0]) > 0.5  # over one line
    level = 1.2 * np.cos(np.radians(SUN[0])) * direct + 0.3 * diffuse
    np.testing.assert_allclose(made.radiance[:, 0] * np.pi, 0.2 * level, rtol=1e-4)
    np.testing.assert_allclose(made.reflectance, 0.2, rtol=1e-4)
    there = clouds.factors(*clouds.station, (made.irradiance_time.values - start) / np.timedelta64(1, "s"))
    np.testing.assert_allclose(
        made.irradiance[:, 100], 1.2 * np.cos(np.radians(SUN[0])) * there[0] + 0.3 * there[1], rtol=1e-4
    )
    _, other = relit(clouds, chunk_lines=7)
    np.testing.assert_array_equal(made.radiance, other.radiance)


@pytest.mark.parametrize(
    "wrong", [{"cover": 1.2}, {"size": 0.0}, {"opacity": -1}, {"station": (np.nan, 0.0)}]
)
def test_there_are_no_such_clouds(wrong: dict[str, Any]) -> None:
    expect_error(SchemaError, next(iter(wrong)), lambda: BrokenClouds(**wrong))


# --- rendered skies ---

BANDS = BandSet(np.array([450.0, 550.0, 850.0]), np.array(6.0))
NM = np.array([400.0, 450.0, 550.0, 850.0, 900.0])


def dome(count: int = 100) -> np.ndarray:
    # Return directions spread evenly over the whole sphere (direction, 3)
    number = np.arange(2 * count * count) + 0.5
    up = 1.0 - number / (count * count)
    angle = np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - up**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), up], axis=1)


DOME = dome()


def sky_light(
    direction: tuple[float, float], *, clear: int | None = None, overcast_share: float = 0.0
) -> Atmosphere:
    # Return skylight of 1 alone, uniform, overcast, or with one of the functions of a clear sky
    none = np.zeros(NM.shape)
    shares = None
    if clear is not None:
        shares = np.zeros((4, NM.size))
        shares[clear] = 1.0
    return Atmosphere(
        NM, none, none + 1.0, none, none, *direction, overcast_share=overcast_share, clear_shares=shares
    )


def slope(tilt: float, azimuth: float) -> tuple[Scene, np.ndarray]:
    # Return a Lambert panel of 0.5 that leans towards an azimuth [degree], and its normal
    normal = sun_vectors([(tilt, azimuth)])[0]
    aside = np.cross(normal, [0.3, 0.2, 1.0])
    aside /= np.linalg.norm(aside)
    ahead = np.cross(normal, aside)
    corners = 5.0 * np.array([aside + ahead, aside - ahead, -aside - ahead, ahead - aside])
    return Scene.from_arrays(corners, [[0, 1, 2], [0, 2, 3]], Material("grey", "panel_50", "panel")), normal


def traced(scene: Scene, light: Atmosphere, samples: int = 1024) -> xr.Dataset:
    # Return the light that a panel alone scatters once
    platform = pushbroom(16, 16, altitude=40.0, ground_sample=0.05)
    return hp.simulation.trace(scene, platform, [light], samples=samples, slots=64, depth=1).compute()


def skylight(trace: xr.Dataset, light: Atmosphere) -> float:
    # Return the mean radiance times pi
    return float(trace.paint.relight(BANDS, atmosphere=light, truth=False).radiance.mean()) * np.pi


@pytest.mark.parametrize(
    ("tilt", "turn", "sun"),
    [
        (0.0, 0.0, (82.0, 265.0)),
        (35.0, 0.0, (25.0, 180.0)),
        (35.0, 0.0, (82.0, 265.0)),
        (35.0, 180.0, (60.0, 75.0)),
        (60.0, 90.0, (25.0, 180.0)),
        (60.0, 90.0, (60.0, 75.0)),
    ],
)
def test_the_functions_on_slopes(tilt: float, turn: float, sun: tuple[float, float]) -> None:
    # The irradiance of a panel is the sum of each function over what it sees of the sky
    scene, normal = slope(tilt, sun[1] + turn)
    trace = traced(scene, sky_light(sun, clear=0))
    above = DOME[:, 2] > 0.0
    azimuth = np.arctan2(DOME[above, 0], DOME[above, 1]) - np.radians(sun[1])
    for number, value in enumerate(functions_towards(sun[0], DOME[above, 2], azimuth)[1:]):
        # the noise of a quarter of a million paths
        assert skylight(trace, sky_light(sun, clear=number)) == pytest.approx(
            0.5 * 4.0 * np.sum(value * np.maximum(DOME[above] @ normal, 0.0)) / len(DOME), rel=0.015
        ), number


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_an_overcast_sky_on_slopes(tilt: float) -> None:
    # CIE's sky on a slope, (1 + cos) / 2 for its uniform part, and nothing from below the horizon
    scene, normal = slope(tilt, 100.0)
    expected = 0.5 * 4.0 * np.mean(1.5 * DOME[:, 2] * (DOME[:, 2] > 0.0) * np.maximum(DOME @ normal, 0.0))
    light = sky_light((40.0, 180.0), overcast_share=1.0)
    assert skylight(traced(scene, light, samples=4096), light) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("sun", [(25.0, 180.0), (60.0, 90.0), (82.0, 265.0)])
def test_a_bonnet_mirrors_the_zenith(sun: tuple[float, float]) -> None:
    # A level black roof with a smooth coat, seen from above, under the sky alone
    light = Atmosphere.clear(*sun, haze=None, wavelength=np.arange(380.0, 951.0))
    light = dataclasses.replace(light, sun=0.0 * light.sun)
    scene = plane(50.0, Material("roof", "panel_50", "paint", Coat(roughness=0.01)))
    made = hp.simulation.trace(
        scene, pushbroom(8, 8, altitude=200.0, ground_sample=0.1), [light], samples=512
    ).paint.relight(BANDS, atmosphere=light, paints={"panel_50": ([300.0, 1100.0], [0.0, 0.0])})
    mirrored = made.reflectance.mean(("along_track", "cross_track")).values
    above = [float(relative_sky(nm, sun[0], np.array(1.0), np.array(0.0))) for nm in BANDS.wavelength]
    np.testing.assert_allclose(mirrored, 0.04 * np.array(above), rtol=0.02)


def test_presets_have_the_sky_of_their_sun() -> None:
    for name in ("noon", "near_sunset"):
        light = preset_atmosphere(name)
        shares = clear_sky_shares(light.wavelength, light.sun_zenith)
        np.testing.assert_allclose(light.clear_shares, shares[1:])
    assert not preset_atmosphere("cloudy").clear_shares.any()
    half = preset_atmosphere("noon").clouded(4)
    np.testing.assert_allclose(half.clear_shares, 0.5 * preset_atmosphere("noon").clear_shares)
    np.testing.assert_allclose(half.uniform + half.clear_shares.sum(axis=0) + half.overcast_share, 1.0)


def test_the_sky_is_written_and_read() -> None:
    light = Atmosphere.clear(50.0, wavelength=np.arange(380.0, 1000.0))
    stored = light.to_dataset()
    np.testing.assert_array_equal(Atmosphere.from_dataset(stored).clear_shares, light.clear_shares)
    old = Atmosphere.from_dataset(stored.drop_vars("clear_shares"))
    np.testing.assert_array_equal(old.uniform, 1.0)
    # shares of other functions are no shares of these
    others = stored.assign_coords(function=list("abcd")), stored.rename(clear_shares="aureole")
    for dataset in others:
        with pytest.raises(SchemaError, match="trace-outdated"):
            Atmosphere.from_dataset(dataset)
    expect_error(
        SchemaError,
        "length-mismatch",
        lambda: dataclasses.replace(light, clear_shares=light.clear_shares[:2]),
    )


def test_what_was_not_traced_is_said() -> None:
    bare = hp.simulation.trace(two_cars(), flight(2, 2), [SUN], samples=2, clear=False)
    expect_error(
        SchemaError, "sky-not-traced", lambda: bare.paint.relight(BANDS, atmosphere=Atmosphere.clear(*SUN))
    )
    bare.paint.relight(BANDS, atmosphere=flat_light())
    for attrs in ({"source_bits": 3}, {"clear": 1, "clear_sky_functions": "molecular, aureole"}):
        with pytest.raises(SchemaError, match="trace-outdated"):
            bare.assign_attrs(attrs).paint.relight(BANDS, atmosphere=flat_light())


# --- sun clock ---

PLACE = ORIGIN[:2]


def test_the_sun_is_that_of_the_chains_own_ephemeris() -> None:
    moments = np.datetime64("2021-01-01T11:00", "ns") + np.arange(0, 365 * 24, 301) * np.timedelta64(
        3600, "s"
    )
    zenith, azimuth = sun_at(moments, *PLACE)
    expected, at = solar_position(moments, np.full(moments.size, PLACE[0]), np.full(moments.size, PLACE[1]))
    day = expected < 85.0
    np.testing.assert_allclose(zenith[day], expected[day], atol=0.15)
    np.testing.assert_allclose((azimuth - at + 180.0)[day] % 360.0, 180.0, atol=0.3)


def direction(zenith: float, azimuth: float) -> np.ndarray:
    up, north = np.radians(zenith), np.radians(azimuth)
    return np.array([np.sin(up) * np.sin(north), np.sin(up) * np.cos(north), np.cos(up)])


def apart(zenith: float, azimuth: float, moment: np.datetime64) -> float:
    # Return the angle between a direction and the sun of the chain's own ephemeris [degree]
    seen, at = solar_position(np.array([moment]), np.array([PLACE[0]]), np.array([PLACE[1]]))
    cosine = direction(zenith, azimuth) @ direction(float(seen[0]), float(at[0]))
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


@pytest.mark.parametrize(
    ("zenith", "azimuth"),
    [(60.0, 178.0), (50.0, 250.0), (24.0, 200.0), (24.0, 160.0), (30.0, 230.0), (45.0, 110.0), NEAR_SUNSET],
)
def test_the_clock_has_the_sun_of_the_scene(zenith: float, azimuth: float) -> None:
    moment = when_sun_stands(zenith, azimuth, *PLACE)
    assert moment != DEFAULT_START
    assert apart(zenith, azimuth, moment) < 1.2


@pytest.mark.parametrize(
    ("zenith", "azimuth"), [(75.0, 170.0), (24.0, 90.0), (24.0, 5.0), (24.0, 350.0), (20.0, 300.0)]
)
def test_where_the_sun_never_stands_there_its_zenith_angle_is_right(zenith: float, azimuth: float) -> None:
    seen, at = sun_at(when_sun_stands(zenith, azimuth, *PLACE), *PLACE)
    assert float(seen) == pytest.approx(zenith, abs=1.0)
    # in the morning for a light from the east, in the afternoon for one from the west
    assert (float(at) > 180.0) == (azimuth > 180.0)


def test_the_usual_clock_stays_where_its_sun_is_as_good_or_not_seen() -> None:
    assert when_sun_stands(25.0, 178.0, *PLACE) == DEFAULT_START
    assert when_sun_stands(22.0, 178.0, *PLACE) == SimulationSettings().start == DEFAULT_START
    # Rationale: nothing under a closed cloud shows where its sun stands
    # Expected: the sun's own time where it has one, the usual one where it has none; a given one in any case
    assert (
        SimulationSettings(sky="overcast", sun_zenith=60.0).start == SimulationSettings(sun_zenith=60.0).start
    )
    assert SimulationSettings(sky="overcast", sun_zenith=5.0).start == DEFAULT_START
    given = SimulationSettings(sky="overcast", sun_zenith=60.0, start_time="2021-06-21T12:00:00")
    assert given.start == np.datetime64("2021-06-21T12:00:00")


def test_a_sun_that_never_stands_there_is_refused_with_all_else_that_is_wrong(tmp_path: Path) -> None:
    codes = ("value-out-of-range", "sun-unreachable")
    with refusal(SchemaError, codes, "lines=-1", "sun_zenith=12", "start_time="):
        simulate_collect(tmp_path / "new", sun_zenith=12, lines=-1)
    assert not (tmp_path / "new").exists()
    assert SimulationSettings(sun_zenith=12, start_time="2021-06-21T17:10:00").start == np.datetime64(
        "2021-06-21T17:10:00"
    )
