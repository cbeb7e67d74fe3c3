"""``hyperpaint/light/sunlight_1nm.csv`` from the tables of ASTM G173 and of SPECTRL2 that pvlib has.

``PYTHONPATH=tests python tests/campaigns/sunlight_table.py`` writes it; without pvlib there is nothing to do.
"""

import importlib
from pathlib import Path

import numpy as np

from hyperpaint.light import clear_sky

HEAD = """\
# Sunlight above the air and what gases take of it, at 1 nm (5 nm beyond 1700 nm).
# extraterrestrial, W m-2 nm-1 at 1 AU: ASTM G173-03, from the table of the standard.
# ozone, cm-1 (base e): SPECTRL2, Bird & Riordan, J. Climate Appl. Meteor. 25, 87 (1986), table 1.
# mixed (oxygen, carbon dioxide), water: -ln(T) / 1.5 with T what is left of G173's direct beam (air mass 1.5,
# 1.416 cm of water, 0.344 atm cm of ozone) after SPECTRL2's Rayleigh, aerosol (0.084, 1.14) and ozone.
# Made by tests/campaigns/sunlight_table.py from pvlib's copies of both tables.
wavelength_nm,extraterrestrial,ozone,mixed,water
"""
#: Bands [nm] of oxygen and carbon dioxide, and of water; a rest elsewhere is an error of the model.
MIXED = ((627, 632), (686, 698), (758, 772), (1243, 1290), (1560, 1625), (1940, 2085))
WATER = ((584, 606), (640, 668), (699, 752), (780, 846), (880, 2500))


def inside(wavelength: np.ndarray, bands: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.any([(wavelength >= low) & (wavelength <= high) for low, high in bands], axis=0)


def table() -> str:
    # Return the text of the file
    from pvlib.spectrum import get_reference_spectra

    coefficients = importlib.import_module("pvlib.spectrum.spectrl2")._SPECTRL2_COEFFS
    spectra = get_reference_spectra(standard="ASTM G173-03")
    nm = spectra.index.values
    here = (nm >= 300) & (nm <= 2500)
    nm, above, direct = nm[here], spectra.extraterrestrial.values[here], spectra.direct.values[here]
    ozone = np.interp(nm, coefficients["wavelength"], coefficients["ozone_absorption"])
    um = nm / 1000.0
    rayleigh = np.exp(-1.5 / (um**4 * (115.6406 - 1.335 / um**2)))
    aerosol = np.exp(-1.5 * 0.084 * (um / 0.5) ** -1.14)
    left = direct / above / rayleigh / aerosol / np.exp(-1.5 * 0.344 * ozone)
    depth = -np.log(np.clip(left, 1e-6, 1.0)) / 1.5
    mixed = np.where(inside(nm, MIXED), depth, 0.0)
    water = np.where(inside(nm, WATER) & ~inside(nm, MIXED), depth, 0.0)
    rows = zip(nm, above, ozone, mixed, water, strict=True)
    return HEAD + "".join(f"{a:g},{b:.5g},{c:.4g},{d:.4g},{e:.4g}\n" for a, b, c, d, e in rows)


if __name__ == "__main__":
    Path(clear_sky.__file__).with_name("sunlight_1nm.csv").write_text(table(), encoding="utf-8")
