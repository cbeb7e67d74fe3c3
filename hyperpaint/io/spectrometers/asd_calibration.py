"""From the raw counts of an ASD file to the quantity that its white reference or calibration gives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError

from .asd_binary import AsdFile
from .spectrum_files import ratio

__all__ = ["CALIBRATION_KEYS", "derive_quantity", "panel_of"]


CALIBRATION_KEYS = {"lamp": "LMP", "fore_optic": "FO", "panel": "BSE", "absolute": "ABS"}
"""What users call the files of an instrument's calibration, and the kind of block each replaces."""

_NEEDED_BLOCKS = {"irradiance": ("LMP", "FO"), "radiance": ("LMP", "FO", "BSE")}


def derive_quantity(
    file: AsdFile, quantity: str, external: Mapping[str, AsdFile], *, absolute: bool = False
) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Return the wavelengths, the values in ``quantity``, and where the detector was saturated.

    See the notes of `open_asd` for the formulas; ``external`` holds calibration files by kind, which win
    over the blocks in the file. ``absolute`` multiplies reflectance by that of the white panel.

    Raises FormatError: The reference or calibration blocks that the quantity needs are missing.
    """
    wavelength, values = file.wavelength, file.spectrum
    if quantity == "reflectance":
        if file.reference is None:
            raise FormatError(
                f"{file.name}: no white reference in the file, so no reflectance; "
                "pass quantity='counts', or give files saved after the white reference was taken"
            )
        values = ratio(file.spectrum, file.reference)
        if absolute:
            with np.errstate(all="ignore"):
                values = values * _needed_blocks(file, ("ABS",), "absolute reflectance", external)["ABS"][0]
    elif quantity in _NEEDED_BLOCKS:
        with np.errstate(all="ignore"):  # damaged values; what is not finite is reported later
            values = file.spectrum * _responsivity(file, quantity, external)
        vnir = wavelength <= _splices(file)[0]
        return wavelength[vnir], values[vnir], _saturated(file)[vnir]
    return wavelength, values, _saturated(file)


def panel_of(file: AsdFile, external: Mapping[str, AsdFile]) -> str:
    """Return the name of the panel whose reflectance makes that of the file absolute; empty without one."""
    if "ABS" in external:
        return external["ABS"].name
    return file.calibrations["ABS"].name if "ABS" in file.calibrations else ""


def _needed_blocks(
    file: AsdFile, kinds: tuple[str, ...], purpose: str, external: Mapping[str, AsdFile]
) -> dict[str, tuple[Floats, float]]:
    """Return values and integration time [ms] of the calibration blocks of some kinds."""
    blocks = {kind: (block.values, block.integration_ms) for kind, block in file.calibrations.items()}
    for kind, other in external.items():
        if kind in kinds and not np.array_equal(other.wavelength, file.wavelength):
            raise FormatError(f"{file.name}: its wavelengths are not those of calibration file {other.name}")
        blocks[kind] = (other.spectrum, other.integration_ms)
    missing = [kind for kind in kinds if kind not in blocks]
    if missing:
        keys = [key for key, kind in CALIBRATION_KEYS.items() if kind in missing]
        raise FormatError(
            f"{file.name}: no calibration block {' and '.join(missing)} in the file, so no {purpose}; pass "
            f"calibration={{{', '.join(f'{key!r}: path' for key in keys)}}} with the instrument's files "
            "(.ill, .raw, .ref), or export the spectra as text with the vendor's software"
        )
    return blocks


def _responsivity(file: AsdFile, quantity: str, external: Mapping[str, AsdFile]) -> Floats:
    """Return irradiance or radiance per count (wavelength)."""
    blocks = _needed_blocks(file, _NEEDED_BLOCKS[quantity], quantity, external)
    lamp_counts, lamp_ms = blocks["FO"]
    if file.integration_ms <= 0 or lamp_ms <= 0:
        raise FormatError(
            f"{file.name}: integration time {file.integration_ms:g} ms, that of the calibration "
            f"{lamp_ms:g} ms; expected positive numbers"
        )
    per_count = ratio(blocks["LMP"][0], lamp_counts) * (lamp_ms / file.integration_ms)
    return per_count * blocks["BSE"][0] / np.pi if quantity == "radiance" else per_count


def _splices(file: AsdFile) -> tuple[float, float]:
    """Return the last wavelengths of VNIR and SWIR 1, infinite where there is no further detector."""
    first, second = (splice if splice > 0 else np.inf for splice in file.splices)
    return first, second


def _saturated(file: AsdFile) -> npt.NDArray[np.bool_]:
    first, second = _splices(file)
    detector = np.searchsorted([first, max(first, second)], file.wavelength)
    flags = np.array([name in file.saturated for name in ("VNIR", "SWIR1", "SWIR2")])
    return flags[detector]
