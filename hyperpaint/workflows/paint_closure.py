"""Signatures of paints from a processed collect, compared with the truth of its rendered scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK
from hyperpaint.validation.validation_result import aligned

#: Tolerance of the relative RMS error over bands of a signature of many pixels.
MAX_ERROR = 0.01

_MIN_PIXELS = 200  # signatures of fewer pixels are too noisy to judge
_MIN_HEIGHT_M = 0.7  # roofs, bonnets and boots are above this height
_MIN_PURITY, _MAX_SHADOW = 0.999, 0.001  # for pure and sunlit pixels

_LEGEND = f"""\
Signatures: means over pure, sunlit, unflagged pixels without glint, over {_MIN_HEIGHT_M} m high on a car.
error: RMS over bands against the truth of the same pixels, relative. field: mean of the ASD spectrum near
normal; differences of the scene from it are slopes, mirrored sky and light from neighbours, not errors."""


@dataclass(frozen=True)
class PaintAgreement:
    """The signature of a paint: mean over pure, sunlit, unflagged pixels of roofs, bonnets and boots.

    Pixels in which the clear coat mirrors the sun are excluded.
    """

    paint: str
    cars: int  #: Number of cars with this paint.
    pixels: int  #: Number of averaged pixels.
    recovered: float  #: Mean over bands [1].
    error: float  #: Relative RMS error over bands against the true signature of the same pixels.
    field: float  #: Mean over bands of the field spectrum near normal [1].


def compare_paints(store: Path, truth: Path, bands: tuple[float, float]) -> tuple[PaintAgreement, ...]:
    """Return the signatures of the paints of a rendered collect compared with their truth, sorted by name.

    ``store``: written by `process`; ``truth``: the ``truth.zarr`` of the collect, with the spectrometer's
    files beside it (``asd_reflectance``); ``bands``: first and last wavelength compared [nm].

    Raises `FormatError` if the spectrometer's files are missing or cannot be read.
    """
    from hyperpaint.io.store import list_groups

    true_scene = xr.open_zarr(truth)
    attrs = true_scene["paint_id"].attrs
    names = dict(zip(attrs["flag_values"], str(attrs["flag_meanings"]).split(), strict=True))
    sums: dict[int, _Signature] = {}
    wavelength: Floats = np.zeros(0)
    for group in (name for name in list_groups(store) if name.startswith("flightlines/")):
        line = xr.open_zarr(store, group=group)
        wavelength = line["wavelength"].values
        is_used = line["good"].values & (wavelength >= bands[0]) & (wavelength <= bands[1])
        for recovered, true, number, car in _paint_pixels(line, true_scene, is_used):
            for paint in np.unique(number):
                has_paint = number == paint
                sums.setdefault(int(paint), _Signature()).add(
                    recovered[has_paint], true[has_paint], car[has_paint]
                )
    if not sums:
        return ()
    field = _field_spectra(truth.parent / "asd_reflectance", wavelength[is_used])
    agreements = [signature.agreement(names[paint], field[names[paint]]) for paint, signature in sums.items()]
    return tuple(sorted(agreements, key=lambda agreement: agreement.paint))


def blocks_with_truth(
    line: xr.Dataset, truth: xr.Dataset, names: list[str]
) -> Iterator[tuple[xr.Dataset, xr.Dataset]]:
    """Yield blocks of `CHUNK_LINES` lines of a flight line, with the variables ``names`` of their truth."""
    frames = line["frame"].values
    for start in range(0, frames.size, CHUNK_LINES):
        lines = slice(start, start + CHUNK_LINES)
        true = truth[names].isel({ALONG_TRACK: frames[lines]})
        yield line[["reflectance", "quality"]].isel({ALONG_TRACK: lines}).compute(), true.compute()


Pixels = tuple[Floats, Floats, npt.NDArray[np.int64], npt.NDArray[np.int64]]


def _paint_pixels(line: xr.Dataset, truth: xr.Dataset, is_used: npt.NDArray[np.bool_]) -> Iterator[Pixels]:
    # recovered and true reflectance (pixel, band), paint and car of pure, sunlit, unflagged pixels
    labels = ["reflectance", "paint_id", "car_id", "purity", "shadow", "up", "glint"]
    for slab, true in blocks_with_truth(line, truth, labels):
        is_usable = (true["paint_id"].values >= 0) & (true["purity"].values > _MIN_PURITY)
        is_usable &= (
            (true["shadow"].values < _MAX_SHADOW)
            & (true["up"].values > _MIN_HEIGHT_M)
            & (slab["quality"].values == 0)
        )
        is_usable &= ~true["glint"].values
        recovered, true_reflectance = (
            block["reflectance"].transpose(ALONG_TRACK, CROSS_TRACK, BAND).values[is_usable][:, is_used]
            for block in (slab, true)
        )
        finite = np.isfinite(recovered).all(axis=1)
        yield (
            recovered[finite].astype(np.float64),
            true_reflectance[finite].astype(np.float64),
            true["paint_id"].values[is_usable][finite].astype(np.int64),
            true["car_id"].values[is_usable][finite].astype(np.int64),
        )


class _Signature:
    def __init__(self) -> None:
        self.pixels, self.cars = 0, set[int]()
        self.recovered: Floats | float = 0.0
        self.true: Floats | float = 0.0

    def add(self, recovered: Floats, true: Floats, car: npt.NDArray[np.int64]) -> None:
        self.pixels += len(car)
        self.cars.update(np.unique(car).tolist())
        self.recovered = self.recovered + recovered.sum(axis=0)
        self.true = self.true + true.sum(axis=0)

    def agreement(self, name: str, field: Floats) -> PaintAgreement:
        recovered, true = np.asarray(self.recovered) / self.pixels, np.asarray(self.true) / self.pixels
        return PaintAgreement(
            paint=name,
            cars=len(self.cars),
            pixels=self.pixels,
            recovered=float(recovered.mean()),
            error=float(np.sqrt(np.mean((recovered / true - 1.0) ** 2))),
            field=float(field.mean()),
        )


def _field_spectra(folder: Path, wavelength: Floats) -> dict[str, Floats]:
    from hyperpaint.io.spectrometers.asd import open_asd

    spectra = open_asd(folder)
    nm = spectra["wavelength"].values
    return {
        Path(str(name)).stem: np.interp(wavelength, nm, spectrum)
        for name, spectrum in zip(spectra["source"].values, spectra["reflectance"].values, strict=True)
    }


def signature_problems(paints: Sequence[PaintAgreement]) -> list[str]:
    """Return texts about signatures outside the tolerance; signatures of few pixels are not judged."""
    return [
        f"signature of {paint.paint}: error {paint.error:.2%}, tolerance {MAX_ERROR:.0%}"
        for paint in paints
        if paint.pixels >= _MIN_PIXELS and not paint.error < MAX_ERROR
    ]


def signature_table(paints: Sequence[PaintAgreement]) -> str:
    """Return the signatures as a table with its legend."""
    head = ("signature", "cars", "pixels", "field", "recovered", "error")
    rows = [
        (
            paint.paint,
            f"{paint.cars}",
            f"{paint.pixels}",
            f"{paint.field:.4f}",
            f"{paint.recovered:.4f}",
            f"{paint.error:.2%}",
        )
        for paint in paints
    ]
    lines = aligned([head, *rows])
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], "", _LEGEND])
