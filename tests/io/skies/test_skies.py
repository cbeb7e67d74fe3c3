"""Files of other programs' skies, as their documents and sources word them, and skies fitted to tables."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from oracles.scattered_sky import sky_radiance
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError
from hyperpaint.io.skies import read_sky_csv, sky_dataset
from hyperpaint.light.clear_sky import zenith_radiance
from hyperpaint.light.sky_functions import clear_sky_shares, functions_towards
from hyperpaint.simulation.atmosphere import Atmosphere

SUN = 60.0
ZENITHS, AZIMUTHS = np.arange(5.0, 86.0, 10.0), np.arange(0.0, 181.0, 20.0)


def sky_of(nm: float) -> np.ndarray:
    # Return the package's sky over a uniform one, (zenith, azimuth)
    zenith, azimuth = np.meshgrid(np.radians(ZENITHS), np.radians(AZIMUTHS), indexing="ij")
    functions = functions_towards(SUN, np.cos(zenith), azimuth)
    return np.tensordot(clear_sky_shares([nm], SUN)[:, 0], functions, 1)


def uvspec_text(order: int = 1) -> str:
    # Return lines of disort with umu and phi; a row of downward umu first, as angles increase
    lines = []
    for nm, edir, edn in ((450.0, 500.0, 180.0), (850.0, 420.0, 40.0)):
        lines.append(f" {nm:.3f} {edir:.4e} {edn:.4e} 6.1e+01 7.9e+01 4.5e+01 1.2e+01")
        lines.append("     " + " ".join(f"{phi + 30.0:.4f}" for phi in AZIMUTHS))
        rows = [
            f" {-np.cos(np.radians(zenith)):.8f} 0.0 " + " ".join(f"{value:.6e}" for value in row)
            for zenith, row in zip(ZENITHS, sky_of(nm) * edn / np.pi, strict=True)
        ]
        lines += rows[::order]
        lines.append(" 0.50000000 0.0 " + " ".join("1.0e+00" for _ in AZIMUTHS))  # looks down
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("order", [1, -1])
def test_uvspec_with_radiances(tmp_path: Path, order: int) -> None:
    path = write_file(tmp_path / "uvspec.out", uvspec_text(order))
    table = hp.io.read_uvspec(
        path, sun_zenith=SUN, sun_azimuth=30.0, units="mW m-2 nm-1", directions=ZENITHS.size + 1
    )
    np.testing.assert_allclose(table.direct_normal, [1.0, 0.84], rtol=1e-6)
    np.testing.assert_allclose(table.diffuse, [0.18, 0.04], rtol=1e-6)
    np.testing.assert_allclose(table.sky_zenith, ZENITHS, atol=1e-5)
    np.testing.assert_allclose(table.sky_azimuth, AZIMUTHS, atol=1e-9)
    np.testing.assert_allclose(table.sky_radiance[0], sky_of(450.0) * 0.18 / np.pi, rtol=1e-5)
    fit = hp.light.fit_sky(table, SUN)
    np.testing.assert_allclose(fit.share.T, clear_sky_shares([450.0, 850.0], SUN), atol=2e-3)
    assert float(fit.misfit.max()) < 1e-4
    light = Atmosphere.from_table(table, sun_zenith=SUN)
    np.testing.assert_allclose(light.clear_shares, clear_sky_shares([450.0, 850.0], SUN)[1:], atol=2e-3)
    np.testing.assert_allclose(light.sun, table.direct_normal)


def test_uvspec_without_radiances_and_other_columns(tmp_path: Path) -> None:
    path = write_file(
        tmp_path / "uvspec.out", " 450.0 500.0 180.0 1. 1. 1. 1.\n 451.0 500.0 181.0 1. 1. 1. 1.\n"
    )
    table = hp.io.read_uvspec(path, sun_zenith=0.0, units="mW m-2 nm-1")
    np.testing.assert_allclose(table.direct_normal, 0.5)
    assert "sky_radiance" not in table
    expect_errors(
        (
            FormatError,
            "length-mismatch",
            lambda: hp.io.read_uvspec(path, sun_zenith=0.0, units="mW m-2 nm-1", directions=10),
        )
    )
    path.write_text(" 450.0 500.0 180.0 1.\n 451.0 500.0 181.0 1.\n")
    expect_errors(
        (
            FormatError,
            "model-output-wrong",
            lambda: hp.io.read_uvspec(path, sun_zenith=0.0, units="mW m-2 nm-1"),
        ),
        (SchemaError, "below 90", lambda: hp.io.read_uvspec(path, sun_zenith=95.0, units="mW m-2 nm-1")),
        *(
            (
                SchemaError,
                f"directions( is |=){count}, expected a whole number.*(value-out-of-range|type-wrong)",
                lambda count=count: hp.io.read_uvspec(
                    path, sun_zenith=0.0, units="mW m-2 nm-1", directions=count
                ),
            )
            for count in (-1, -2, 1.5)
        ),
    )


NAMES_5 = (
    "   FREQ   TOT TRANS   PTH THRML   THRML SCT   SURF EMIS   SOL SCAT   SING SCAT   GRND RFLT   DRCT RFLT"
)
NAMES_6 = "    FREQ  TOT_TRANS   THRML_EM  THRML_SCT  SURF_EMIS  MULT_SCAT  SING_SCAT  GRND_RFLT  DRCT_RFLT"


@pytest.mark.parametrize("names", [NAMES_5, NAMES_6])
def test_tape7(tmp_path: Path, names: str) -> None:
    wavenumber, transmitted, ground = np.array([22222.0, 18182.0, 11765.0]), 0.8, 0.3
    nm = 1e7 / wavenumber
    whole, direct = np.array([1.1, 1.0, 0.5]), np.array([0.8, 0.85, 0.46])  # on level ground
    per_wavenumber = ground * transmitted / np.pi / (1e-3 * wavenumber**2)
    rows = [
        f"{nu:12.2f} {transmitted:.6f} 1e-9 9e-9 8e-9 2e-9 1e-9 {w:.8e} {d:.8e}"
        for nu, w, d in zip(wavenumber, per_wavenumber * whole, per_wavenumber * direct, strict=True)
    ]
    path = write_file(
        tmp_path / "tape7",
        "\n".join(["    1    5    0    6", "   361976 U S STANDARD", names, *rows, "  -9999."]),
    )
    table = hp.io.read_tape7(path, sun_zenith=SUN, ground=ground)
    np.testing.assert_allclose(table.wavelength, nm)
    np.testing.assert_allclose(table.direct_normal, direct / 0.5, rtol=1e-6)
    np.testing.assert_allclose(table.diffuse, whole - direct, rtol=1e-5)
    whole_text = path.read_text()
    path.write_text(whole_text[: whole_text.rindex("\n")])
    expect_errors(
        (FormatError, "file-truncated", lambda: hp.io.read_tape7(path, sun_zenith=SUN, ground=ground))
    )
    path.write_text(whole_text[: whole_text.index("1e-9 9e-9")] + "\n  -9999.")
    expect_errors(
        (FormatError, "number-unreadable", lambda: hp.io.read_tape7(path, sun_zenith=SUN, ground=ground))
    )
    path.write_text("    1    5\n  WAVLEN  TRANS\n 450.0 0.8\n")
    expect_errors(
        (FormatError, "model-output-wrong", lambda: hp.io.read_tape7(path, sun_zenith=SUN, ground=ground)),
        (SchemaError, "ground 0", lambda: hp.io.read_tape7(path, sun_zenith=SUN, ground=0)),
    )


SIXS = """\
*                       spectral condition                                    *
*             monochromatic calculation at wl : {micron:.3f} micron                   *
*                         irr. at ground level (w/m2/mic)                     *
*     direct solar irr.    atm. diffuse irr.    environment  irr              *
*           {direct:9.3f}           {diffuse:9.3f}           {environment:9.3f}              *
"""


def test_sixs(tmp_path: Path) -> None:
    paths = []
    for micron, direct, diffuse in ((0.65, 700.0, 100.0), (0.45, 500.0, 180.0)):
        paths.append(tmp_path / f"{micron}.txt")
        paths[-1].write_text(SIXS.format(micron=micron, direct=direct, diffuse=diffuse, environment=4.0))
    table = hp.io.read_sixs(paths, sun_zenith=SUN)
    np.testing.assert_allclose(table.wavelength, [450.0, 650.0])
    np.testing.assert_allclose(table.direct_normal, [1.0, 1.4])
    np.testing.assert_allclose(table.diffuse, [0.184, 0.104])
    paths[0].write_text(SIXS.replace("monochromatic calculation at wl", "value of filter function"))
    expect_errors((FormatError, "model-output-wrong", lambda: hp.io.read_sixs(paths, sun_zenith=SUN)))


def test_csv_of_radiances(tmp_path: Path) -> None:
    rows = [
        f"{nm},{z},{a},{0.1 * nm * (1 + z + a):.6f},1000,200"
        for nm in (0.45, 0.55) for a in (0.0, 90.0) for z in (10.0, 40.0, 70.0)
    ]  # fmt: skip
    heading = (
        "wavelength [um],zenith [degree],azimuth [degree],radiance [mW m-2 sr-1 nm-1],"
        "direct_normal [mW m-2 nm-1],diffuse [mW m-2 nm-1]"
    )
    path = write_file(tmp_path / "sky.csv", "\n".join(["# a sky", heading, *rows]))
    table = read_sky_csv(path)
    np.testing.assert_allclose(table.wavelength, [450.0, 550.0])
    np.testing.assert_allclose(table.direct_normal, 1.0)
    assert float(table.sky_radiance.sel(sky_zenith=40.0, sky_azimuth=90.0)[1]) == pytest.approx(
        0.055 * 131 / 1e3
    )
    path.write_text("\n".join([heading, *rows[:-1]]))
    expect_errors((FormatError, "grid-mismatch", lambda: read_sky_csv(path)))
    scattered = [f"{0.45 + n * 1e-5},{n * 1e-4},{n * 1e-3},1,1000,200" for n in range(50_000)]
    path.write_text("\n".join([heading, *scattered]))  # a grid of these has 10^14 places
    expect_errors((FormatError, "grid-mismatch", lambda: read_sky_csv(path)))
    for rows_after, match in (
        ([rows[0][:-4]], "length-mismatch"),
        ([], "length-mismatch"),
        (["nan" + rows[0][4:]], "not-finite"),
    ):
        path.write_text("\n".join([heading, *rows_after]))
        expect_error(FormatError, match, lambda: read_sky_csv(path))
    path.write_text("wavelength [nm],sky [W m-2 nm-1]\n450,0.2\n")
    expect_errors((FormatError, "column-missing", lambda: read_sky_csv(path)))


@pytest.mark.slow
def test_a_foreign_sky_is_fitted_and_the_misfit_said() -> None:
    # The Monte Carlo's radiances at a wavelength; the zenith comes out as that of the built-in sky
    truth = sky_radiance(550.0, SUN, photons=8000)
    zenith, azimuth = np.degrees(np.arccos(truth.cosine)), np.degrees(truth.azimuth)
    radiance = np.stack([truth.relative, truth.relative]) * 0.2 / np.pi
    fit = hp.light.fit_sky(
        sky_dataset(
            "Monte Carlo", np.array([549.0, 551.0]), np.ones(2), np.full(2, 0.2), (zenith, azimuth, radiance)
        ),
        SUN,
    )
    assert 0.01 < float(fit.misfit[0]) < 0.06
    above = fit.share[0].values @ functions_towards(SUN, 1.0, 0.0)
    assert above == pytest.approx(truth.zenith, rel=0.06)
    assert above == pytest.approx(zenith_radiance([550.0], SUN)[0], rel=0.06)


def test_a_sky_that_is_none_of_ours_is_told() -> None:
    # Stripes of this contrast leave a residual of 0.20 and 0.33; from 0.25 on the fit is poor
    for contrast in (0.2, 0.35):
        stripes = 0.11 * (1.0 + np.where(np.arange(ZENITHS.size) % 2, contrast, -contrast))
        sky = np.broadcast_to(stripes[:, None], (2, ZENITHS.size, AZIMUTHS.size))
        table = sky_dataset(
            "stripes", np.array([450.0, 550.0]), np.ones(2), np.full(2, 0.2), (ZENITHS, AZIMUTHS, sky)
        )
        with pytest.warns(PaintWarning, match=r"stripes.*sky-fit-poor") if contrast > 0.3 else nullcontext():
            Atmosphere.from_table(table, sun_zenith=SUN)
    expect_refusals(
        (
            SchemaError,
            "variable-missing",
            "sky_radiance",
            lambda: hp.light.fit_sky(table.drop_vars("sky_radiance"), SUN),
        )
    )
    few = table.isel(sky_zenith=slice(0, 1), sky_azimuth=slice(0, 3))
    expect_refusals((SchemaError, "sky-directions-few", "3 ", lambda: hp.light.fit_sky(few, SUN)))


def test_what_is_no_light_is_refused() -> None:
    nm = np.array([450.0, 450.0])
    caught = expect_error(FormatError, None, lambda: sky_dataset("a", nm, np.ones(2), np.array([0.1, -0.1])))
    assert caught.codes == ("wavelength-repeated", "value-out-of-range")
    assert caught.problems[1].found.startswith("diffuse")
    assert isinstance(sky_dataset("a", nm + np.arange(2.0), np.ones(2), np.ones(2)), xr.Dataset)
