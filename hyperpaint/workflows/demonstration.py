"""A simulated collect, processed like a real one; reflectance and signatures are compared with its truth."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import MissingExtraError, StoreError
from hyperpaint.base.input_files import head_of
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK
from hyperpaint.io.spectrometers.asd import open_asd
from hyperpaint.simulation import simulate_collect
from hyperpaint.simulation.collect import MARKER, PARTS
from hyperpaint.simulation.instruments import CAMERA_SOFTWARE
from hyperpaint.validation.validating import aligned

from .maps import LINES, lines_of_store
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
    # The signature of a paint: mean over pure, sunlit, unflagged pixels of roofs, bonnets and boots.
    #
    # Pixels in which the clear coat mirrors the sun are excluded.
    paint: str
    cars: int  #: Number of cars with this paint.
    pixels: int  #: Number of averaged pixels.
    recovered: float  #: Mean over bands [1].
    error: float  #: Relative RMS error over bands against the true signature of the same pixels.
    field: float  #: Mean over bands of the field spectrum near normal [1].


def compare_paints(store: Path, truth: Path, bands: tuple[float, float]) -> tuple[PaintAgreement, ...]:
    # Return the signatures of the paints of a rendered collect compared with their truth, sorted by name.
    #
    # ``store``: written by `process`; ``truth``: the ``truth.zarr`` of the collect, with the spectrometer's
    # files beside it (``asd_reflectance``); ``bands``: first and last wavelength compared [nm].
    #
    # Raises `FormatError` if the spectrometer's files are missing or cannot be read.
    true_scene = xr.open_zarr(truth)
    attrs = true_scene["paint_id"].attrs
    names = dict(zip(attrs["flag_values"], str(attrs["flag_meanings"]).split(), strict=True))
    #: Pixels, cars, sum of recovered and of true reflectance, by paint.
    sums: dict[int, tuple[int, set[int], Any, Any]] = {}
    wavelength: Floats = np.zeros(0)
    labels = ["reflectance", "paint_id", "car_id", "purity", "shadow", "up", "glint"]
    for slab, true in blocks_with_truth(store, true_scene, labels, bands):
        wavelength = slab["wavelength"].values
        # pure, sunlit, unflagged pixels without mirrored sun, on roofs, bonnets and boots
        is_usable = (true["paint_id"].values >= 0) & (true["purity"].values > _MIN_PURITY)
        is_usable &= (true["shadow"].values < _MAX_SHADOW) & (true["up"].values > _MIN_HEIGHT_M)
        is_usable &= (slab["quality"].values == 0) & ~true["glint"].values
        is_usable[is_usable] = np.isfinite(slab["reflectance"].values[is_usable]).all(axis=1)
        spectra = [block["reflectance"].values[is_usable].astype(np.float64) for block in (slab, true)]
        number, car = (true[name].values[is_usable] for name in ("paint_id", "car_id"))
        for paint in np.unique(number):
            has_paint = number == paint
            pixels, cars, *totals = sums.get(int(paint), (0, set(), 0.0, 0.0))
            recovered, expected = (
                total + values[has_paint].sum(axis=0) for total, values in zip(totals, spectra, strict=True)
            )
            cars = cars | set(np.unique(car[has_paint]).tolist())
            sums[int(paint)] = pixels + int(has_paint.sum()), cars, recovered, expected
    if not sums:
        return ()
    spectrometer = open_asd(truth.parent / "asd_reflectance")
    files = [Path(str(name)).stem.replace(" ", "_") for name in spectrometer["source"].values]
    agreements = []
    for paint, (pixels, cars, recovered, expected) in sums.items():
        field = spectrometer["reflectance"].values[files.index(names[paint])]
        agreements.append(
            PaintAgreement(
                paint=names[paint],
                cars=len(cars),
                pixels=pixels,
                recovered=float((recovered / pixels).mean()),
                error=float(np.sqrt(np.mean(((recovered / pixels) / (expected / pixels) - 1.0) ** 2))),
                field=float(np.interp(wavelength, spectrometer["wavelength"].values, field).mean()),
            )
        )
    return tuple(sorted(agreements, key=lambda agreement: agreement.paint))


def blocks_with_truth(
    store: Path, truth: xr.Dataset, names: list[str], bands: tuple[float, float]
) -> Iterator[tuple[xr.Dataset, xr.Dataset]]:
    # Yield blocks of `CHUNK_LINES` lines of all flight lines, with the variables ``names`` of their truth.
    #
    # Bands come last: the good ones from the first to the last wavelength ``bands`` [nm].
    for name in lines_of_store(store):
        line = xr.open_zarr(store, group=f"{LINES}{name}")
        wavelength, frames = line["wavelength"].values, line["frame"].values
        is_used = line["good"].values & (wavelength >= bands[0]) & (wavelength <= bands[1])
        for start in range(0, frames.size, CHUNK_LINES):
            lines = slice(start, start + CHUNK_LINES)
            slab = line[["reflectance", "quality"]].isel({ALONG_TRACK: lines, BAND: is_used})
            true = truth[names].isel({ALONG_TRACK: frames[lines], BAND: is_used})
            order = (ALONG_TRACK, CROSS_TRACK, ...)
            yield slab.compute().transpose(*order), true.compute().transpose(*order)


def signature_problems(paints: Sequence[PaintAgreement]) -> list[str]:
    # Return texts about signatures outside the tolerance; signatures of few pixels are not judged.
    return [
        f"signature of {paint.paint}: error {paint.error:.2%}, tolerance {MAX_ERROR:.0%}"
        for paint in paints
        if paint.pixels >= _MIN_PIXELS and not paint.error < MAX_ERROR
    ]


def signature_table(paints: Sequence[PaintAgreement]) -> str:
    # Return the signatures as a table with its legend.
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
        # Mean recovered minus mean true reflectance.
        return self.recovered - self.true


@dataclass(frozen=True)
class Comparison:
    """Recovered and true reflectance of a collect."""

    materials: tuple[Agreement, ...]  #: In the simulator's order.
    overall: Agreement  #: All pixels together.
    flagged: float  #: Share of pixels with a quality flag, which are not compared.
    paints: tuple[PaintAgreement, ...] = ()  #: Signatures of paints, for a rendered scene.

    @property
    def problems(self) -> tuple[str, ...]:
        # Values outside the tolerance, one line each.
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
        # Whether all values are within tolerance.
        return not self.problems

    def __str__(self) -> str:
        head = ("material", "pixels", "true", "recovered", "bias", "RMSE mean", "RMSE", "O2 window")
        rows = [
            (
                row.material,
                f"{row.pixels}",
                f"{row.true:.4f}",
                f"{row.recovered:.4f}",
                f"{row.bias:+.5f}",
                f"{row.rmse_of_mean:.5f}",
                f"{row.rmse:.5f}",
                f"{100 * row.oxygen:.2f} %",
            )
            for row in (*self.materials, self.overall)
        ]
        lines = aligned([head, *rows])
        rule = "-" * len(lines[0])
        return "\n".join([lines[0], rule, *lines[1:-1], rule, lines[-1]])


def compare(store: Path, truth: Path) -> Comparison:
    # Compare the reflectance in a store with the truth (``truth.zarr``) of its simulated collect.
    #
    # Compared are good bands between 420 and 980 nm and pixels without a quality flag, at the wavelengths of
    # every column. For a rendered scene, signatures of paints are compared too (see `compare_paints`).
    #
    # Raises `StoreError` if the store has no flight line; `FormatError` if files of the field spectrometer
    # beside the truth of a rendered scene cannot be read.
    true_scene = xr.open_zarr(truth)
    names = str(true_scene["surface"].attrs["flag_meanings"]).split()
    total, slab, sums = 0, None, np.zeros((4, len(names), 1))
    for slab, true in blocks_with_truth(store, true_scene, ["reflectance", "surface"], BANDS_NM):
        unflagged = slab["quality"].values == 0
        total += unflagged.size
        recovered, expected = (
            block["reflectance"].values[unflagged].astype(np.float64) for block in (slab, true)
        )
        is_finite = np.isfinite(recovered)
        error = np.where(is_finite, recovered - expected, 0.0)
        member = (true["surface"].values[unflagged] == np.arange(len(names))[:, None]).astype(np.float64)
        # sums over pixels (material, band): number, truth, error, squared error
        terms = (is_finite, np.where(is_finite, expected, 0.0), error, error**2)
        sums = sums + np.stack([member @ term for term in terms])
    if slab is None:
        raise StoreError(f"{store} holds no flight line to compare", code="flightline-missing")
    wavelength, counts = slab["wavelength"].values, sums[0].max(axis=1)
    window = (wavelength >= OXYGEN_NM[0]) & (wavelength <= OXYGEN_NM[1])

    def agreement(name: str, rows: list[int]) -> Agreement:
        count, true, error, squared = sums[:, rows].sum(axis=1)
        true, error = true / count, error / count
        return Agreement(
            material=name,
            pixels=int(count.max()),
            true=float(true.mean()),
            recovered=float((true + error).mean()),
            rmse_of_mean=float(np.sqrt(np.mean(error**2))),
            rmse=float(np.sqrt(squared.sum() / count.sum())),
            oxygen=float(np.abs(error[window] / true[window]).max()) if window.any() else float("nan"),
        )

    present = [index for index in range(len(names)) if counts[index] > 0]
    return Comparison(
        materials=tuple(agreement(names[index], [index]) for index in present),
        overall=agreement("all pixels", present),
        flagged=1.0 - counts.sum() / max(total, 1),
        paints=compare_paints(store, truth, BANDS_NM) if "car_id" in true_scene else (),
    )


# --- the demonstration -------------------------------------------------------------------------------------

#: Bytes at the beginning of a file that are searched for the name of the simulator.
_HEAD_BYTES = 2**16


def refuse_foreign(folder: Path, *, overwrite: bool) -> None:
    # Refuse a folder whose content a simulated collect must not replace.
    #
    # Raises `StoreError` for a folder that is not empty and not an earlier demonstration; with ``overwrite``,
    # for a folder with raw data that no simulation wrote.
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    toml = folder / "collect.toml"
    simulated = head_of(toml, len(MARKER)) == MARKER.encode()
    patterns = ("flight/*.hdr", "dark/*.hdr", "svc/*.sig", "asd_reflectance/*.asd", "regions.geojson")
    raw_files = [path for pattern in patterns for path in folder.glob(pattern)]
    foreign = sorted(entry.name for entry in folder.iterdir() if entry.name not in _DEMONSTRATION_FILES)
    StoreError.raise_if(
        any(CAMERA_SOFTWARE.encode() not in head_of(path, _HEAD_BYTES) for path in raw_files)
        or (toml.exists() and not simulated),
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
    try:
        xr.open_zarr(store, group=f"{LINES}{lines_of_store(store)[0]}").paint.quicklook(picture)
    except MissingExtraError as error:
        say(f"no picture: {error}")
    else:
        say(f"picture: {picture}")
