"""Four spectra of light and air: where they come from, and whether they are plausible."""

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from dask.base import tokenize
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad

from hyperpaint.base.errors import MissingExtraError, SchemaError
from hyperpaint.simulation.atmosphere import Haze, Sky, relative_air_mass, spectral_grid
from hyperpaint.simulation.rendering.four_curves import PRESETS, Atmosphere, preset_atmosphere

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
    def test_curves_are_kept_apart_and_cannot_be_changed(self) -> None:
        sun = np.ones(3)
        made = Atmosphere([1, 2, 3], sun, sun, sun, sun, 60.0, 0.0)
        sun[:] = 7.0
        assert made.sun.dtype == made.wavelength.dtype == np.float64
        assert_allclose(made.sun, 1.0)
        with pytest.raises(ValueError, match="read-only"):
            made.sun[0] = 2.0
        assert_allclose(made.irradiance, 1.5)  # normal times cos 60, and the sky

    def test_all_problems_at_once(self) -> None:
        with pytest.raises(SchemaError) as caught:
            Atmosphere([2, 1], [np.nan, 1], [-1, 1], [1, 1, 1], [1, 1], 90.0, np.inf, 2.0, "bad")
        for part in ("'bad'", "wavelength-unordered", "sun has 1", "sky falls to -1", "extinction has shape"):
            assert part in str(caught.value)
        for part in ("sun_zenith=90.0", "sun_azimuth=inf", "overcast_share=2.0"):
            assert part in str(caught.value)

    def test_it_travels(self) -> None:
        noon = preset_atmosphere("noon")
        back = pickle.loads(pickle.dumps(noon))
        assert_allclose(back.sky, noon.sky, atol=0)
        assert back.haze == noon.haze
        assert tokenize(noon) == tokenize(back)  # dask names tasks by it
        assert tokenize(noon) != tokenize(preset_atmosphere("cloudy"))

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

    def test_a_dataset_in_other_units(self) -> None:
        dataset = Atmosphere.clear(50.0, wavelength=GRID).to_dataset()
        milliwatts = dataset.assign(sun=(dataset.sun * 1000.0).assign_attrs(units="mW m-2 nm-1"))
        assert_allclose(Atmosphere.from_dataset(milliwatts).sun, dataset.sun, rtol=1e-12)


class TestClearSky:
    def test_it_is_the_simulators_sky(self) -> None:
        made = Atmosphere.clear(25.0, wavelength=GRID)
        direct, diffuse = Sky(25.0).irradiance(GRID)
        # only the air mass differs: 1.1028 for 1.1034
        assert_allclose(made.sun * np.cos(np.radians(25.0)), direct, rtol=2e-3, atol=1e-4)
        assert_allclose(made.sky, diffuse, rtol=2e-3, atol=1e-4)

    def test_sky_itself_is_as_it_was(self) -> None:
        np.testing.assert_array_equal(
            Sky(25.0).irradiance(GRID), Sky(25.0, airmass=1.0 / np.cos(np.radians(25.0))).irradiance(GRID)
        )

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
        assert np.diff(noon.wavelength).max() < 0.051

    def test_noon_is_within_published_clear_skies(self) -> None:
        noon = preset_atmosphere("noon")
        found = total(noon.irradiance, noon.wavelength)
        # SPECTRL2 (see below), from June's distance of the sun to its mean, 69 % of it within 400-1000 nm
        assert found == pytest.approx(0.69 * (935.0 * np.cos(np.radians(25.0)) + 110.0) * 1.0338, rel=0.03)
        assert 0.05 < total(noon.sky, noon.wavelength) / found < 0.2


class TestSpectrl2:
    @pytest.mark.parametrize(("zenith", "normal", "diffuse"), [(25, 935, 110), (60, 795, 83), (85, 301, 25)])
    def test_broadband_figures(self, zenith: float, normal: float, diffuse: float) -> None:
        pytest.importorskip("pvlib")
        made = Atmosphere.spectrl2(zenith, wavelength=np.arange(300.0, 4001.0, 1.0))
        assert total(made.sun, made.wavelength, 300, 4000) == pytest.approx(normal, rel=0.01)
        assert total(made.sky, made.wavelength, 300, 4000) == pytest.approx(diffuse, rel=0.05)

    def test_level_irradiance_is_pvlibs_global(self) -> None:
        pvlib_spectrum = pytest.importorskip("pvlib.spectrum")
        made = Atmosphere.spectrl2(50.0)
        reference = pvlib_spectrum.spectrl2(
            50.0, 50.0, 0.0, 0.15, 101325.0, relative_air_mass(50.0), 1.5, 0.31, 0.10, dayofyear=172
        )
        inside = (reference["wavelength"] >= 340) & (reference["wavelength"] <= 1100)
        there = np.interp(reference["wavelength"][inside], made.wavelength, made.irradiance)
        # the grid has every sample of SPECTRL2 but a few that lie between its half nanometres
        assert_allclose(there, reference["poa_global"].ravel()[inside], rtol=5e-3)

    @pytest.mark.parametrize(("zenith", "tolerance"), [(25, 0.06), (60, 0.06), (82, 0.10), (85, 0.20)])
    def test_the_built_in_sky_agrees(self, zenith: float, tolerance: float) -> None:
        pytest.importorskip("pvlib")
        ours, theirs = Atmosphere.clear(zenith), Atmosphere.spectrl2(zenith)
        for curve in ("sun", "irradiance"):
            found, expected = (total(getattr(x, curve), x.wavelength) for x in (ours, theirs))
            assert found == pytest.approx(expected, rel=tolerance)
        # our sky has no multiple scattering and no ground, theirs loses more to absorption at low sun
        found, expected = (total(x.sky, x.wavelength) for x in (ours, theirs))
        assert found == pytest.approx(expected, rel=0.30)

    def test_without_pvlib(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "pvlib", None)
        monkeypatch.setitem(sys.modules, "pvlib.spectrum", None)
        with pytest.raises(MissingExtraError, match=r"hyperpaint\[sim\]"):
            Atmosphere.spectrl2(30.0)
        assert Atmosphere.clear(30.0, wavelength=GRID).name == "clear"


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

    def test_spectrl2(self, reference: tuple[np.ndarray, np.ndarray]) -> None:
        pytest.importorskip("pvlib")
        wavelength, direct = reference
        made = Atmosphere.spectrl2(48.19, aerosol=0.084, ozone=0.344, precipitable_water=1.42)
        assert total(made.sun, made.wavelength) == pytest.approx(total(direct, wavelength), rel=0.04)

    def test_as_a_table(self, reference: tuple[np.ndarray, np.ndarray]) -> None:
        wavelength, direct = reference
        columns = {
            "wavelength [nm]": wavelength,
            "sun [W m-2 nm-1]": direct,
            "sky [W m-2 nm-1]": 0.1 * direct,
        }
        made = Atmosphere.from_table(columns, sun_zenith=48.19)
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
    @settings(max_examples=20)
    def test_at_the_visibility_two_per_cent_of_contrast_are_left(self, visibility: float) -> None:
        assert np.exp(-Haze(visibility).extinction(np.array([550.0]))[0] * visibility) == pytest.approx(
            0.02, rel=1e-3
        )

    def test_loss_over_heights_of_the_prototype(self) -> None:
        lost = 1.0 - np.exp(-Haze().extinction(np.array([550.0]))[0] * np.array([15.0, 120.0, 3000.0]))
        assert_allclose(lost, [0.0026, 0.020, 0.40], rtol=0.03)

    def test_pure_air_scatters_as_the_fourth_power(self) -> None:
        blue, red = Haze(3.912 / 1.162e-5).extinction(np.array([400.0, 800.0]))
        assert blue / red == pytest.approx(2.0**4.08, rel=1e-6)

    @given(st.floats(-0.9, 0.9), st.floats(2_000.0, 300_000.0))
    @settings(max_examples=20)
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

    def test_no_haze_no_path(self) -> None:
        made = Atmosphere.clear(30.0, wavelength=GRID, haze=None)
        assert not np.any([made.extinction, made.path_radiance])

    def test_all_problems_at_once(self) -> None:
        with pytest.raises(SchemaError) as caught:
            Haze(1e9, 9.0, 1.0, 2.0, -1.0)
        for name in ("visibility", "angstrom", "asymmetry", "scattering_albedo", "ground"):
            assert name in str(caught.value)


def test_the_default_grid_covers_the_cameras() -> None:
    noon = preset_atmosphere("noon")
    assert noon.wavelength[0] <= 350.0
    assert noon.wavelength[-1] >= 1050.0
    assert_allclose(noon.wavelength, spectral_grid(340.0, 1100.0), atol=0)
