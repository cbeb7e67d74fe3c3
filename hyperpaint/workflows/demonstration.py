"""A simulated collect, processed like a real one; reflectance and signatures are compared with its truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import MissingExtraError, StoreError
from hyperpaint.base.input_files import head_of
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK
from hyperpaint.io.spectrometers.asd import open_asd
from hyperpaint.io.store import list_groups
from hyperpaint.simulation import simulate_collect
from hyperpaint.simulation.collect import MARKER, PARTS
from hyperpaint.simulation.instruments import CAMERA_SOFTWARE
from hyperpaint.validation.validation_result import aligned

from .pipeline import run

#: Tolerance of the relative RMS error over bands of a signature of many pixels.
MAX_ERROR = 0.01

_MIN_PIXELS = 200  # signatures of fewer pixels are too noisy to judge
_MIN_HEIGHT_M = 0.7  # roofs, bonnets and boots are above this height
_MIN_PURITY, _MAX_SHADOW = 0.999, 0.001  # for pure and sunlit pixels

_SIGNATURE_LEGEND = f"""\
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
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], "", _SIGNATURE_LEGEND])


STORE, PICTURE = "lot.zarr", "quicklook.png"
_DEMONSTRATION_FILES = frozenset({*PARTS, STORE, PICTURE, f".partial-{STORE}"})

#: Compared wavelengths; outside, the responsivity is too low for accurate reflectance.
BANDS_NM = (420.0, 980.0)
#: Window of the oxygen A band, where errors of wavelength are largest.
OXYGEN_NM = (750.0, 780.0)

#: Tolerance of the mean error over pixels and bands of a material [1].
MAX_BIAS = 0.002
#: Tolerance of the RMS error of all single samples, with sensor noise [1].
MAX_RMSE = 0.005
#: Tolerance of the relative error of the scene's mean spectrum in the oxygen window [1].
MAX_OXYGEN = 0.002

#: Effects of a real collect in the demonstration, besides noise and a clock that is 37.25 s slow.
EFFECTS: dict[str, Any] = {"smile_nm": 0.5, "dropped": 3, "glint": 0.002, "drift_per_minute": 0.02}


_LEGEND = """\
Reflectance, {0:.0f} to {1:.0f} nm, of pixels without a quality flag ({4:.2f} % have one).
bias: mean over pixels and bands. RMSE: of single samples, sensor noise included.
RMSE mean: of the mean spectrum, over bands. O2 window: its largest relative error, {2:.0f} to {3:.0f} nm."""


@dataclass(frozen=True)
class Agreement:
    """Recovered and true reflectance of a material [1]."""

    material: str
    pixels: int  #: Number of pixels without a quality flag.
    true: float  #: Mean over pixels and bands.
    recovered: float  #: Mean over pixels and bands.
    rmse_of_mean: float  #: RMS over bands of the error of the mean spectrum.
    rmse: float  #: RMS error of single samples.
    oxygen: float  #: Largest relative error of the mean spectrum in the oxygen window, 750 to 780 nm.

    @property
    def bias(self) -> float:
        """Mean recovered minus mean true reflectance."""
        return self.recovered - self.true

    @property
    def cells(self) -> tuple[str, ...]:
        """A row of the table of a `Comparison`."""
        return (
            self.material,
            f"{self.pixels}",
            f"{self.true:.4f}",
            f"{self.recovered:.4f}",
            f"{self.bias:+.5f}",
            f"{self.rmse_of_mean:.5f}",
            f"{self.rmse:.5f}",
            f"{100 * self.oxygen:.2f} %",
        )


@dataclass(frozen=True)
class Comparison:
    """Recovered and true reflectance of a collect."""

    materials: tuple[Agreement, ...]  #: In the simulator's order.
    overall: Agreement  #: All pixels together.
    flagged: float  #: Share of pixels with a quality flag, which are not compared.
    paints: tuple[PaintAgreement, ...] = ()  #: Signatures of paints, for a rendered scene.

    @property
    def problems(self) -> tuple[str, ...]:
        """Values outside the tolerance, one line each."""
        problems = [
            f"{agreement.material}: bias {agreement.bias:+.4f}, tolerance {MAX_BIAS}"
            for agreement in (*self.materials, self.overall)
            if not abs(agreement.bias) < MAX_BIAS
        ]
        if not self.overall.rmse < MAX_RMSE:
            problems.append(f"all pixels: RMSE {self.overall.rmse:.4f}, tolerance {MAX_RMSE}")
        if not self.overall.oxygen < MAX_OXYGEN:
            problems.append(
                f"all pixels: oxygen window {self.overall.oxygen:.2%}, tolerance {MAX_OXYGEN:.1%}"
            )
        problems += signature_problems(self.paints)
        return tuple(problems)

    @property
    def ok(self) -> bool:
        """Whether all values are within tolerance."""
        return not self.problems

    def __str__(self) -> str:
        head = ("material", "pixels", "true", "recovered", "bias", "RMSE mean", "RMSE", "O2 window")
        lines = aligned([head, *(agreement.cells for agreement in (*self.materials, self.overall))])
        rule = "-" * len(lines[0])
        return "\n".join([lines[0], rule, *lines[1:-1], rule, lines[-1]])


def compare(store: Path, truth: Path) -> Comparison:
    """Compare the reflectance in a store with the truth (``truth.zarr``) of its simulated collect.

    Compared are good bands between 420 and 980 nm and pixels without a quality flag, at the wavelengths of
    every column. For a rendered scene, signatures of paints are compared too (see `compare_paints`).

    Raises `StoreError` if the store has no flight line; `FormatError` if files of the field spectrometer
    beside the truth of a rendered scene cannot be read.
    """
    true_scene = xr.open_zarr(truth)
    names = str(true_scene["surface"].attrs["flag_meanings"]).split()
    groups = [name for name in list_groups(store) if name.startswith("flightlines/")]
    sums: _Sums | None = None
    for group in groups:
        line = xr.open_zarr(store, group=group)
        if sums is None:
            sums = _Sums.empty(len(names), line["wavelength"].values, line["good"].values)
        for slab, true in blocks_with_truth(line, true_scene, ["reflectance", "surface"]):
            sums.add(slab, true)
    if sums is None:
        raise StoreError(f"{store} holds no flight line to compare", code="flightline-missing")
    paints = compare_paints(store, truth, BANDS_NM) if "car_id" in true_scene else ()
    return replace(sums.comparison(names), paints=paints)


@dataclass
class _Sums:
    # sums over pixels, (material, band), over the compared bands; is_used: (band,) of the flight line
    wavelength: Floats
    is_used: npt.NDArray[np.bool_]
    count: Floats
    true: Floats
    error: Floats
    squared: Floats
    pixels: int = 0

    @classmethod
    def empty(cls, materials: int, wavelength: Floats, good: npt.NDArray[np.bool_]) -> _Sums:
        is_used = good & (wavelength >= BANDS_NM[0]) & (wavelength <= BANDS_NM[1])
        shape = (materials, int(is_used.sum()))
        count, true, error, squared = (np.zeros(shape) for _ in range(4))
        return cls(wavelength[is_used], is_used, count, true, error, squared)

    def add(self, slab: xr.Dataset, truth: xr.Dataset) -> None:
        order = (ALONG_TRACK, CROSS_TRACK, BAND)
        unflagged = slab["quality"].values == 0
        self.pixels += unflagged.size
        recovered = (
            slab["reflectance"].transpose(*order).values[unflagged][:, self.is_used].astype(np.float64)
        )
        true_values = (
            truth["reflectance"].transpose(*order).values[unflagged][:, self.is_used].astype(np.float64)
        )
        is_finite = np.isfinite(recovered)
        error = np.where(is_finite, recovered - true_values, 0.0)
        member = truth["surface"].values[unflagged] == np.arange(len(self.count))[:, None]
        member = member.astype(np.float64)
        self.count += member @ is_finite
        self.true += member @ np.where(is_finite, true_values, 0.0)
        self.error += member @ error
        self.squared += member @ error**2

    def comparison(self, names: list[str]) -> Comparison:
        counts = self.count.max(axis=1)
        present = [index for index in range(len(names)) if counts[index] > 0]
        materials = tuple(self._agreement(names[index], [index]) for index in present)
        overall = self._agreement("all pixels", present)
        return Comparison(materials, overall, 1.0 - counts.sum() / max(self.pixels, 1))

    def _agreement(self, name: str, rows: list[int]) -> Agreement:
        count = self.count[rows].sum(axis=0)
        true, error = self.true[rows].sum(axis=0) / count, self.error[rows].sum(axis=0) / count
        window = (self.wavelength >= OXYGEN_NM[0]) & (self.wavelength <= OXYGEN_NM[1])
        return Agreement(
            material=name,
            pixels=int(count.max()),
            true=float(true.mean()),
            recovered=float((true + error).mean()),
            rmse_of_mean=float(np.sqrt(np.mean(error**2))),
            rmse=float(np.sqrt(self.squared[rows].sum() / count.sum())),
            oxygen=float(np.abs(error[window] / true[window]).max()) if window.any() else float("nan"),
        )


# --- the demonstration -------------------------------------------------------------------------------------

#: Bytes at the beginning of a file that are searched for the name of the simulator.
_HEAD_BYTES = 2**16


def refuse_foreign(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder whose content a simulated collect must not replace.

    Raises `StoreError` for a folder that is not empty and not an earlier demonstration; with ``overwrite``,
    for a folder with raw data that no simulation wrote.
    """
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    toml = folder / "collect.toml"
    simulated = head_of(toml, len(MARKER)) == MARKER.encode()
    patterns = ("flight/*.hdr", "dark/*.hdr", "svc/*.sig", "asd_reflectance/*.asd", "regions.geojson")
    raw_files = [path for pattern in patterns for path in folder.glob(pattern)]
    foreign = sorted(entry.name for entry in folder.iterdir() if entry.name not in _DEMONSTRATION_FILES)
    if any(CAMERA_SOFTWARE.encode() not in head_of(path, _HEAD_BYTES) for path in raw_files) or (
        toml.exists() and not simulated
    ):
        raise StoreError(
            f"{folder} holds raw files that no simulation wrote",
            mend="choose another folder",
            code="raw-data-present",
        )
    if overwrite or (simulated and (folder / STORE).is_dir() and not foreign):
        return
    names = ", ".join(foreign[:5] or sorted(entry.name for entry in folder.iterdir())[:5])
    mend = "choose another folder, or pass {} to write into it"
    raise StoreError(
        f"{folder} is not empty ({names})",
        mend=mend.format("overwrite=True"),
        option=mend.format("--overwrite"),
        code="folder-not-empty",
    )


def run_demonstration(
    folder: Path,
    *,
    lines: int = 256,
    bands: int = 272,
    columns: int = 320,
    seed: int = 0,
    scene: str = "rendered",
    samples: int | None = None,
    overwrite: bool = False,
    progress: bool = False,
    simulated: Callable[[int, int], None] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Comparison:
    """Simulate a collect, process it like a real one, and compare the result with its truth.

    Writes the raw files, ``collect.toml``, ``truth.zarr``, ``regions.geojson``, the store ``lot.zarr`` and,
    if matplotlib is installed, ``quicklook.png`` into the folder, and replaces those of an earlier
    demonstration.

    Parameters
    ----------
    folder
        Folder of all products.
    lines
        Scan lines.
    bands
        Spectral bands.
    columns
        Columns of the detector.
    seed
        Random seed; the same seed gives the same files.
    scene
        "rendered": a ray-traced car park; "plan": a flat picture.
    samples
        Rays a pixel of a rendered scene; by default 16.
    overwrite
        Write into a folder that holds other files, which are kept.
    progress
        Show the processing on stderr.
    simulated
        Called with the numbers of lines done and in total while the collect is simulated.
    say
        Called with every text to show.

    Raises
    ------
    StoreError
        The folder holds other files, or cannot be written.
    SchemaError
        A size or the scene is out of range; all problems are listed.
    """
    refuse_foreign(folder, overwrite=overwrite)
    effects = EFFECTS if samples is None else {**EFFECTS, "samples": samples}
    start = time.perf_counter()
    collect = simulate_collect(
        folder,
        lines=lines,
        bands=bands,
        columns=columns,
        seed=seed,
        scene=scene,
        overwrite=True,
        progress=simulated,
        **effects,
    )
    simulated_at = time.perf_counter()
    say(
        f"simulated {lines} lines x {bands} bands x {columns} columns in "
        f"{simulated_at - start:.1f} s: {collect}"
    )
    outcome = run(collect, folder / STORE, overwrite=True, progress=progress)
    say(f"processed as if it were real in {time.perf_counter() - simulated_at:.1f} s: {outcome.path}")
    comparison = compare(outcome.path, folder / "truth.zarr")
    say(f"\n{comparison}\n\n{_LEGEND.format(*BANDS_NM, *OXYGEN_NM, 100 * comparison.flagged)}")
    if comparison.paints:
        say(f"\n{signature_table(comparison.paints)}")
    overall = comparison.overall
    say(
        f"overall bias {overall.bias:+.5f} (tolerance {MAX_BIAS}, for each material too), "
        f"RMSE {overall.rmse:.5f} ({MAX_RMSE}), O2 window {overall.oxygen:.2%} ({MAX_OXYGEN:.1%}): "
        + ("within tolerance" if comparison.ok else "OUTSIDE TOLERANCE")
    )
    for problem in comparison.problems:
        say(f"  {problem}")
    _draw(outcome.path, folder / PICTURE, say)
    return comparison


def _draw(store: Path, picture: Path, say: Callable[[str], None]) -> None:
    group = next(name for name in list_groups(store) if name.startswith("flightlines/"))
    try:
        xr.open_zarr(store, group=group).paint.quicklook(picture)
    except MissingExtraError as error:
        say(f"no picture: {error}")
    else:
        say(f"picture: {picture}")
