"""What wrong wavelengths and widths leave of the oxygen A band."""

from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation import simulate_line


def test_oxygen_residual_has_a_sign() -> None:
    line = simulate_line(lines=8, columns=3, smile_nm=0.0, noise=False)
    assert abs(hp.alignment.oxygen_residual(line)).max() < 2e-3
    longer = hp.alignment.oxygen_residual(line.assign_coords(wavelength=line.wavelength + 0.2))
    wider = hp.alignment.oxygen_residual(line.assign_coords(fwhm=line.fwhm + 0.2))
    assert ((longer < -0.008).all(), (wider > 0.003).all(), longer.attrs["units"]) == (True, True, "1")
    expect_refusals(
        (SchemaError, "bands-too-few", lambda: hp.alignment.oxygen_residual(line.isel(band=slice(0, 20))))
    )
