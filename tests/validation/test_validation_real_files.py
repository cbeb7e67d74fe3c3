"""Real spectra: a field spectrometer at the bands of a real camera, and what its software does to files."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import NM, field, library, seen, value_of

import hyperpaint as hp


def _insitu(path: Path) -> xr.Dataset:
    nm, mean, sd = np.loadtxt(path, comments="#", unpack=True, encoding="latin-1")
    return field(mean, (path.stem.removeprefix("insitu_"),), nm=nm, fwhm=None).assign(
        reflectance_sd=(("spectrum", "wavelength"), sd[None], {"units": "1"})
    )


def _bands(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    table = np.loadtxt(folder / "20170320_ang20170228_wavelength_fit.txt")
    return 1e3 * table[:, 1], 1e3 * table[:, 2]


@pytest.mark.real_data
def test_field_spectra_at_the_bands_of_a_real_camera(shared_data: Path) -> None:
    # The width that is missing between an ASD and AVIRIS-NG, by a plain convolution
    folder = shared_data / "radiance_vs_field"
    lawn = _insitu(folder / "insitu_BeckmanLawn.txt")
    at = lawn["wavelength"].values
    centre, fwhm = _bands(folder)
    here = (centre > 400) & (centre < 980)
    centre, fwhm = centre[here], fwhm[here]
    weight = np.exp(-4 * np.log(2) * ((at - centre[:, None]) / np.sqrt(fwhm**2 - 3.0**2)[:, None]) ** 2)
    paints = library(
        weight @ lawn["reflectance"].values[0] / weight.sum(axis=1), ("BeckmanLawn",), nm=centre, fwhm=None
    ).assign_coords(fwhm=("band", fwhm, {"units": "nm"}))
    found = hp.validate(paints, lawn)
    assert found.statistics["bands"].sel(part="all").item() == here.sum()
    assert value_of(found, "rmse") < 1e-4
    assert any("as usual for ASD" in note for note in found.notes[0])
    assert value_of(found, "scale_u") > 0.02  # of 68 readings whose number is not told


@pytest.mark.real_data
def test_red_turf_from_the_air_against_the_field(shared_data: Path) -> None:
    # AVIRIS-NG with the lawn for a panel: colour as on the ground, level to some per cent
    folder = shared_data / "radiance_vs_field"
    centre, fwhm = _bands(folder)
    field_lawn, field_red = (
        _insitu(folder / f"insitu_{name}.txt") for name in ("BeckmanLawn", "AstroRedBaseball")
    )
    nm, red = np.loadtxt(folder / "ang20171108t184227_rdn_v2p11_AstroRedBaseball.txt", unpack=True)
    lawn = np.loadtxt(folder / "ang20171108t184227_rdn_v2p11_BeckmanLawn.txt")[:, 1]
    np.testing.assert_allclose(nm, centre, atol=0.1)
    here = (centre > 560) & (centre < 690)  # little path radiance, little of the lawn's red edge
    paints = library(
        (np.interp(centre, field_lawn["wavelength"], field_lawn["reflectance"].values[0]) * red / lawn)[here],
        ("AstroRedBaseball",),
        nm=centre[here],
        fwhm=None,
    )
    paints = paints.assign_coords(fwhm=("band", fwhm[here], {"units": "nm"}))
    found = hp.validate(paints, field_red, tolerance=1.0)
    assert value_of(found, "spectral_angle") < 12.0
    assert 0.6 < value_of(found, "scale") < 1.5


@pytest.mark.real_data
def test_real_files_of_an_svc_before_and_after_matching(shared_data: Path) -> None:
    # The vendor's matching moves reflectance below the join; which file that is, the result says
    folder = shared_data / "svc_sig"
    raw, matched = (hp.open_svc(folder / f"BNL13001_000{end}.sig", utc_offset_h=0.0) for end in ("", "_moc"))
    found = []
    for source in (raw, matched):
        at = source["wavelength"].values[:512]
        first = source["reflectance"].values[0, :512]
        bands = np.arange(420.0, 950.0, 5.0)
        missing = np.sqrt(6.0**2 - 3.5**2)
        weight = np.exp(-4 * np.log(2) * ((at[at < 965] - bands[:, None]) / missing) ** 2)
        weight *= np.gradient(at[at < 965])
        found.append(
            hp.validate(
                library(
                    weight @ first[at < 965] / weight.sum(axis=1),
                    (str(source["spectrum"].values[0]),),
                    nm=bands,
                ),
                source,
            )
        )
    for one in found:
        assert value_of(one, "rmse") < 2e-4
    assert found[0].statistics.overlap.item() == "preserved"
    assert not found[0].statistics.overlap_matched.item()
    assert found[1].statistics.overlap_matched.item()
    assert "the reference is overlap-matched" in found[1].table()
    apart = hp.validate(
        library(
            found[0].spectra[0]["signature"].values, ("BNL13001_000_moc",), nm=np.arange(420.0, 950.0, 5.0)
        ),
        matched,
        tolerance=0.005,
    )
    # the known values at 550 nm: 8.49 % before, 8.35 % after
    assert apart.spectra[0]["difference"].values[
        np.abs(np.arange(420.0, 950.0, 5.0) - 550).argmin()
    ] == pytest.approx(0.0849 - 0.0835, abs=3e-4)
    assert value_of(apart, "bias", "NIR") > 0.005
    assert not apart.passed


@pytest.mark.real_data
def test_a_white_reference_seen_as_a_target_is_white(shared_data: Path) -> None:
    white = hp.open_svc(
        shared_data / "svc_sig" / "ACPL_D2_P1_T_1_WR_000.sig", dayfirst=False, utc_offset_h=-5.0
    )
    bands = np.arange(420.0, 900.0, 5.0)
    paint = library(np.ones(bands.size), ("panel",), nm=bands)
    found = hp.validate(paint, white, {"panel": "ACPL_D2_P1_T_1_WR_000"})
    assert abs(value_of(found, "scale") - 1.0) < 0.005
    panel = hp.io.read_certificate(shared_data / "spectra_ascii" / "R90.txt")
    scaled = hp.validate(
        library(np.ones(bands.size), ("panel",), nm=bands), white, {"panel": "ACPL_D2_P1_T_1_WR_000"},
        panel=panel, tolerance=1.0,
    )  # fmt: skip
    expected = 1 / np.interp(bands, panel["wavelength"], panel).mean()
    assert value_of(scaled, "scale") == pytest.approx(expected, rel=0.01)


# --- one pigment panel by five laboratories with cameras, beside a spectrophotometer

SAMPLES = (
    *("burnt umber thin", "burnt umber thick", "carmine thin", "carmine thick", "vermilion thin"),
    *("vermilion thick", "malachite thin", "malachite thick", "azurite thin", "azurite thick"),
    *("lead white", "ivory black", "gypsum ground"),
)
LABORATORIES = {
    "Hyspex_VNIR1600": 0.038, "Hyspex_VNIR1800": 0.038, "Specim_V10E_1": 0.035, "Specim_V10E_2": 0.041,
    "Specim_V10E_3": 0.047,
}  # fmt: skip


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
