"""Real spectra: a field spectrometer at the bands of a real camera, and what its software does to files."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import field, library, value_of

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
    assert (
        abs(
            value_of(
                hp.validate(
                    library(np.ones(bands.size), ("panel",), nm=bands),
                    white,
                    {"panel": "ACPL_D2_P1_T_1_WR_000"},
                ),
                "scale",
            )
            - 1.0
        )
        < 0.005
    )
    panel = hp.io.read_certificate(shared_data / "spectra_ascii" / "R90.txt")
    scaled = hp.validate(
        library(np.ones(bands.size), ("panel",), nm=bands), white, {"panel": "ACPL_D2_P1_T_1_WR_000"},
        panel=panel, tolerance=1.0,
    )  # fmt: skip
    expected = 1 / np.interp(bands, panel["wavelength"], panel).mean()
    assert value_of(scaled, "scale") == pytest.approx(expected, rel=0.01)
