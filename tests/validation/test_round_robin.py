"""One pigment panel as five real laboratories with real cameras published it, beside a spectrophotometer.

Pillay et al., Sensors 2020, 20, 3812; in every laboratory's data thin and thick burnt umber are exchanged.
"""

import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import NM, field, library, seen, value_of

import hyperpaint as hp

SAMPLES = (
    *("burnt umber thin", "burnt umber thick", "carmine thin", "carmine thick", "vermilion thin"),
    *("vermilion thick", "malachite thin", "malachite thick", "azurite thin", "azurite thick"),
    *("lead white", "ivory black", "gypsum ground"),
)
LABORATORIES = {
    "Hyspex_VNIR1600": 0.038, "Hyspex_VNIR1800": 0.038, "Specim_V10E_1": 0.035, "Specim_V10E_2": 0.041,
    "Specim_V10E_3": 0.047,
}  # fmt: skip
"""RMSE over all samples, 420 to 950 nm, by a plain interpolation."""


def reference(folder: Path) -> xr.Dataset:
    table = np.loadtxt(folder / "pigment_panel_reference.csv")
    table = table[table[:, 0] < 1100.0]
    return field(table[:, 1:].T, SAMPLES, nm=table[:, 0], fwhm=None, instrument="spectrophotometer")


def laboratory(folder: Path, name: str) -> tuple[xr.Dataset, np.ndarray]:
    # Return a laboratory's library, and its RMSE by a plain interpolation (sample,)
    table = np.loadtxt(folder / f"{name}.csv")
    table = table[(table[:, 0] >= 420.0) & (table[:, 0] <= 950.0)]
    known = np.loadtxt(folder / "pigment_panel_reference.csv")
    away = [
        table[:, 2 + k] - np.interp(table[:, 0], known[:, 0], known[:, 1 + k]) for k in range(len(SAMPLES))
    ]
    return library(table[:, 2:].T, SAMPLES, nm=table[:, 0], fwhm=None), np.sqrt(
        (np.array(away) ** 2).mean(axis=1)
    )


def validated(paints: xr.Dataset, references: xr.Dataset) -> tuple[np.ndarray, list[str]]:
    # Return the RMSE of every paint, and what was said
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        agreement = hp.validate(paints, references)
    return np.array([value_of(agreement, "rmse", pair=pair) for pair in range(paints.sizes["signature"])]), [
        str(each.message) for each in said
    ]


@pytest.mark.real_data
@pytest.mark.parametrize("name", LABORATORIES)
def test_a_laboratorys_own_figures(shared_data: Path, name: str) -> None:
    folder = shared_data / "round_robin"
    paints, plain = laboratory(folder, name)
    rmse, said = validated(paints, reference(folder))
    np.testing.assert_allclose(rmse, plain, atol=1e-3)
    assert np.sqrt((rmse**2).mean()) == pytest.approx(LABORATORIES[name], abs=6e-4)
    exchanged = [text for text in said if "were exchanged" in text]
    assert len(exchanged) == 1
    assert exchanged[0].startswith(
        "burnt umber thin and burnt umber thick: each agrees with the reference of"
    )


@pytest.mark.real_data
@pytest.mark.parametrize("name", LABORATORIES)
def test_put_right_nothing_is_said(shared_data: Path, name: str) -> None:
    folder = shared_data / "round_robin"
    paints, _ = laboratory(folder, name)
    rmse, said = validated(
        paints.assign_coords(signature=[SAMPLES[1], SAMPLES[0], *SAMPLES[2:]]), reference(folder)
    )
    assert not [text for text in said if "were exchanged" in text]
    assert 0.029 < np.sqrt((rmse**2).mean()) < 0.0435


def test_exchanged_names_are_noticed_and_paints_alike_are_not() -> None:
    nm = np.arange(380.0, 1021.0)
    levels = {"a": 1.0, "b": 1.2, "c": 1.21}
    names = tuple(levels)
    spectra = np.stack([level * seen(NM, 6.0) for level in levels.values()])
    references = field(np.stack([level * seen(nm, 3.0) for level in levels.values()]), names, nm=nm)
    assert not validated(library(spectra, names), references)[1]
    _, said = validated(library(spectra[[1, 0, 2]], names), references)
    assert [text.split(":")[0] for text in said] == ["a and b"]
    # all off alike: whose reference is nearer is chance
    _, said = validated(library(0.9 * spectra[[0, 2, 1]], names), references)
    assert not said
