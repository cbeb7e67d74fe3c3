"""Signatures of paints from a processed collect, against the truth of the rendered scene below it."""

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

#: Of a signature of many pixels against its truth: RMS over bands, relative.
MAX_ERROR = 0.01

_MANY = 200  # pixels; below, sensor noise is all there is to see
_ROOF = 0.7  # m; roofs, bonnets and boots are above
_PURE, _LIT = 0.999, 0.001

_LEGEND = f"""\
Signatures: means over pure, sunlit, unflagged pixels without glint, of what is over {_ROOF} m high on a car.
error: RMS over bands against the truth of the same pixels, relative. field: mean of what the ASD saw near
normal; that the scene shows more or less is no error, but slopes, mirrored sky and light from neighbours."""


@dataclass(frozen=True)
class PaintAgreement:
    """The signature of one paint: a mean over pure, sunlit, unflagged pixels of roofs, bonnets and boots.

    Pixels in which the clear coat mirrors the sun are left out.
    """

    paint: str
    cars: int  #: Cars that it was seen on.
    pixels: int  #: Pixels that were averaged.
    recovered: float  #: Mean over bands [1].
    error: float  #: Recovered against true signature of the same pixels: RMS over bands, relative.
    field: float  #: Mean over bands of the field spectrum near normal [1].


def compare_paints(store: Path, truth: Path, bands: tuple[float, float]) -> tuple[PaintAgreement, ...]:
    """Return the signatures of the paints of a rendered collect against their truth, by name.

    ``store`` was made by `process`, ``truth`` is the ``truth.zarr`` of the collect, beside which lie the
    spectrometer's files, ``asd_reflectance``; ``bands`` are the first and last wavelength that count [nm].

    Raises `FormatError`: the spectrometer's files are missing or cannot be read.
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
        used = line["good"].values & (wavelength >= bands[0]) & (wavelength <= bands[1])
        for recovered, true, number, car in _paint_pixels(line, true_scene, used):
            for paint in np.unique(number):
                here = number == paint
                sums.setdefault(int(paint), _Signature()).add(recovered[here], true[here], car[here])
    if not sums:
        return ()
    field = _field_spectra(truth.parent / "asd_reflectance", wavelength[used])
    agreements = [one.agreement(names[paint], field[names[paint]]) for paint, one in sums.items()]
    return tuple(sorted(agreements, key=lambda one: one.paint))


def blocks_with_truth(
    line: xr.Dataset, truth: xr.Dataset, names: list[str]
) -> Iterator[tuple[xr.Dataset, xr.Dataset]]:
    """Yield `CHUNK_LINES` lines at a time of a flight line, and ``names`` of the truth of the same frames."""
    frames = line["frame"].values
    for start in range(0, frames.size, CHUNK_LINES):
        lines = slice(start, start + CHUNK_LINES)
        true = truth[names].isel({ALONG_TRACK: frames[lines]})
        yield line[["reflectance", "quality"]].isel({ALONG_TRACK: lines}).compute(), true.compute()


Pixels = tuple[Floats, Floats, npt.NDArray[np.int64], npt.NDArray[np.int64]]


def _paint_pixels(line: xr.Dataset, truth: xr.Dataset, used: npt.NDArray[np.bool_]) -> Iterator[Pixels]:
    # recovered and true reflectance (pixel, band), paint and car of the clean pixels
    labels = ["reflectance", "paint_id", "car_id", "purity", "shadow", "up", "glint"]
    for seen, true in blocks_with_truth(line, truth, labels):
        chosen = (true["paint_id"].values >= 0) & (true["purity"].values > _PURE)
        chosen &= (true["shadow"].values < _LIT) & (true["up"].values > _ROOF) & (seen["quality"].values == 0)
        chosen &= ~true["glint"].values
        recovered, exact = (
            each["reflectance"].transpose(ALONG_TRACK, CROSS_TRACK, BAND).values[chosen][:, used]
            for each in (seen, true)
        )
        finite = np.isfinite(recovered).all(axis=1)
        yield (
            recovered[finite].astype(np.float64),
            exact[finite].astype(np.float64),
            true["paint_id"].values[chosen][finite].astype(np.int64),
            true["car_id"].values[chosen][finite].astype(np.int64),
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

    seen = open_asd(folder)
    at = seen["wavelength"].values
    return {
        Path(str(name)).stem: np.interp(wavelength, at, spectrum)
        for name, spectrum in zip(seen["source"].values, seen["reflectance"].values, strict=True)
    }


def signature_problems(paints: Sequence[PaintAgreement]) -> list[str]:
    """Return signatures outside the tolerance, one line each; signatures of few pixels are not judged."""
    return [
        f"signature of {one.paint}: error {one.error:.2%}, tolerance {MAX_ERROR:.0%}"
        for one in paints
        if one.pixels >= _MANY and not one.error < MAX_ERROR
    ]


def signature_table(paints: Sequence[PaintAgreement]) -> str:
    """Return the signatures as a table with its legend."""
    head = ("signature", "cars", "pixels", "field", "recovered", "error")
    rows = [
        (
            one.paint,
            f"{one.cars}",
            f"{one.pixels}",
            f"{one.field:.4f}",
            f"{one.recovered:.4f}",
            f"{one.error:.2%}",
        )
        for one in paints
    ]
    lines = aligned([head, *rows])
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], "", _LEGEND])
