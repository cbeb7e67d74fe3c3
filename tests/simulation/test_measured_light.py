"""Light from an irradiance series and from tables; what is no table raises FormatError and nothing else."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from support.traced_scenes import SERIES_NM as GRID, irradiance_series as series

from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError
from hyperpaint.simulation.atmosphere import Haze, built_in_sky
from hyperpaint.simulation.rendering.four_curves import Atmosphere

HEADER = "wavelength [nm], sun [W m-2 nm-1], sky [W m-2 nm-1]"


class TestSeries:
    def test_between_samples(self) -> None:
        made = Atmosphere.from_irradiance(series(), sun_zenith=60.0, time="2020-06-21T17:00:15")
        assert_allclose(made.irradiance, 2.5, rtol=1e-7)
        assert made.sun.dtype == np.float64

    @pytest.mark.parametrize(("second", "level"), [("00", 1.0), ("10", 2.0), ("20", 3.0)])
    def test_at_samples(self, second: str, level: float) -> None:
        made = Atmosphere.from_irradiance(series(), sun_zenith=60.0, time=f"2020-06-21T17:00:{second}")
        assert_allclose(made.irradiance, level, rtol=1e-7)

    def test_the_default_split_is_the_built_in_sky(self) -> None:
        made = Atmosphere.from_irradiance(series(1), sun_zenith=60.0)
        sun, sky = built_in_sky(GRID, 60.0)
        assert_allclose(made.sun * made.sun_cosine / made.sky, sun * 0.5 / sky, rtol=1e-9)

    @pytest.mark.parametrize("fraction", [0.0, 0.8, 1.0, np.linspace(0.2, 0.9, GRID.size)])
    def test_a_split_by_hand(self, fraction: object) -> None:
        made = Atmosphere.from_irradiance(series(1), sun_zenith=60.0, direct_fraction=fraction)
        assert_allclose(made.sun * 0.5, np.broadcast_to(fraction, GRID.shape), rtol=1e-7)
        assert_allclose(made.irradiance, 1.0, rtol=1e-7)

    def test_units_are_converted(self) -> None:
        made = Atmosphere.from_irradiance(series(1, "mW m-2 nm-1"), sun_zenith=60.0)
        assert_allclose(made.irradiance, 1e-3, rtol=1e-6)

    def test_noise_below_zero_is_cut_and_more_is_refused(self) -> None:
        noisy = series(1)
        noisy.irradiance[0, :2] = -0.009
        with pytest.warns(PaintWarning, match="2 of 121.*irradiance-negative"):
            made = Atmosphere.from_irradiance(noisy, sun_zenith=60.0)
        assert (made.irradiance[:2] == 0.0).all()
        noisy.irradiance[0, 0] = -0.011
        with pytest.raises(SchemaError, match=r"sky.*value-out-of-range"):
            Atmosphere.from_irradiance(noisy, sun_zenith=60.0)
        noisy.irradiance[0, 0] = np.nan
        with pytest.raises(SchemaError, match=r"not.finite"):
            Atmosphere.from_irradiance(noisy, sun_zenith=60.0)


class TestTable:
    def write(self, folder: Path, text: str | bytes) -> Path:
        path = folder / "modtran.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    def test_three_columns(self, tmp_path: Path) -> None:
        path = self.write(tmp_path, f"# MODTRAN\n\n{HEADER}\n400,1,0.5\n# gap\n500,2,0.25\n")
        made = Atmosphere.from_table(path, sun_zenith=30.0, sun_azimuth=90.0)
        assert_allclose([made.wavelength, made.sun, made.sky], [[400.0, 500.0], [1.0, 2.0], [0.5, 0.25]])
        assert (made.extinction == 0.0).all()
        assert (made.name, made.sun_azimuth) == ("modtran", 90.0)

    def test_haze_where_the_table_says_nothing(self, tmp_path: Path) -> None:
        made = Atmosphere.from_table(
            self.write(tmp_path, f"{HEADER}\n400,1,0.5\n500,2,0.25\n"), sun_zenith=30.0, haze=Haze()
        )
        assert_allclose(made.extinction, Haze().extinction(made.wavelength))

    def test_five_columns_in_other_units_and_order(self, tmp_path: Path) -> None:
        header = (
            "sky (uW cm-2 nm-1),WAVELENGTH [um],extinction [km-1],sun[W m-2 um-1],"
            "path_radiance [W m-2 sr-1 nm-1 km-1]"
        )
        path = self.write(tmp_path, f"\ufeff{header}\r\n50,0.4,0.17,1000,0.01\r\n25,0.5,0.1,2000,0.02\r\n")
        made = Atmosphere.from_table(path, sun_zenith=30.0, haze=Haze())
        assert_allclose([made.wavelength, made.sun, made.sky], [[400.0, 500.0], [1.0, 2.0], [0.5, 0.25]])
        assert_allclose(made.extinction, [1.7e-4, 1e-4])
        assert_allclose(made.path_radiance, [1e-5, 2e-5])
        assert made.haze is None

    def test_a_mapping(self) -> None:
        columns = {"wavelength [nm]": [400, 500], "sun [W m-2 nm-1]": [1, 2], "sky [W m-2 nm-1]": [0, 1]}
        made = Atmosphere.from_table(columns, sun_zenith=30.0)
        assert_allclose(made.irradiance, np.cos(np.radians(30.0)) * np.array([1, 2]) + [0, 1])

    @pytest.mark.parametrize(
        ("text", "problem"),
        [
            ("", "empty-input"),
            ("# nothing\n", "empty-input"),
            ("400,1,2\n500,1,2\n", "'400'.*heading-unreadable"),
            (f"{HEADER}\n", r"shape \(0,\)"),
            (f"{HEADER}\n400,1,1\n", r"shape \(1,\)"),
            (f"{HEADER}\n400,1\n500,1,1\n", "line 2.*number-unreadable"),
            (f"{HEADER}\n400,1,1_0\n500,1,1\n", "line 2.*number-unreadable"),
            (f"{HEADER}\n400,1,one\n500,1,1\n", "line 2.*number-unreadable"),
            (f"{HEADER}\n400,nan,1\n500,1,1\n", "not-finite"),
            (f"{HEADER}\n400,1e999,1\n500,1,1\n", "not-finite"),
            (f"{HEADER}\n400,-1,1\n500,1,1\n", "value-out-of-range"),
            (f"{HEADER}\n500,1,1\n400,1,1\n", "wavelength-unordered"),
            ("wavelength [nm], sun [W m-2 nm-1]\n400,1\n500,1\n", "sky.*column-missing"),
            ("wavelength [nm], sun [W m-2], sky [W m-2 nm-1]\n400,1,1\n500,1,1\n", "column 'sun'"),
            ("wavelength [nm], sun, sky [W m-2 nm-1]\n400,1,1\n500,1,1\n", "'sun'.*heading-unreadable"),
            (f"{HEADER}, sun [W m-2 nm-1]\n400,1,1,1\n500,1,1,1\n", "column-duplicate"),
            (f"{HEADER}, moon [W m-2 nm-1]\n400,1,1,1\n500,1,1,1\n", "column-unknown"),
            (f"{HEADER}, extinction [m-1]\n400,1,1,1\n500,1,1,1\n", "column-missing"),
            (b"wavelength\xff\n", "text-unreadable"),
        ],
    )
    def test_files_that_are_none(self, tmp_path: Path, text: str | bytes, problem: str) -> None:
        with pytest.raises(FormatError, match=problem):
            Atmosphere.from_table(self.write(tmp_path, text), sun_zenith=30.0)

    def test_problems_are_listed_together_but_not_without_end(self, tmp_path: Path) -> None:
        with pytest.raises(FormatError) as caught:
            Atmosphere.from_table(self.write(tmp_path, f"{HEADER}\n" + "x\n" * 10_000), sun_zenith=30.0)
        assert str(caught.value).count("line ") == 10

    def test_a_file_too_large(self, tmp_path: Path) -> None:
        path = tmp_path / "huge.csv"
        with path.open("wb") as file:
            file.truncate(20 * 2**20)
        with pytest.raises(FormatError, match="16777216"):
            Atmosphere.from_table(path, sun_zenith=30.0)

    @given(st.binary(max_size=300) | st.text(alphabet="waveln gth[m],su\n0159.e-#()_°٣ ", max_size=300))
    @settings(max_examples=150)
    def test_whatever_a_file_holds(self, tmp_path: Path, text: str | bytes) -> None:
        for before in (b"", HEADER.encode() + b"\n"):
            content = before + (text if isinstance(text, bytes) else text.encode())
            try:
                Atmosphere.from_table(self.write(tmp_path, content), sun_zenith=30.0)
            except FormatError:
                continue
