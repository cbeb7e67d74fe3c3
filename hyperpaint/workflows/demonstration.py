"""A simulated collect, processed like a real one.

Its paints are compared with the field spectrometer, as in a real flight. Then the loop is closed: reflectance
of pixels is compared with the simulator's own values of the same pixels.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    MissingExtraError,
    StoreError,
    flags_set_from,
    head_of,
)
from hyperpaint.io.spectrometers.spectrum_texts import open_svc
from hyperpaint.paints.signatures.extraction import EXCLUDED, extract_signatures
from hyperpaint.regions.polygons import read_regions
from hyperpaint.simulation import simulate_collect
from hyperpaint.simulation.collect import MARKER, PARTS, REGIONS, SVC_FOLDER
from hyperpaint.simulation.instruments import CAMERA_SOFTWARE
from hyperpaint.validation.validating import Validation, aligned, validate

from .maps import LINES, lines_of_store
from .pipeline import run

STORE, PICTURE = "lot.zarr", "quicklook.png"
_DEMONSTRATION_FILES = frozenset({*PARTS, STORE, PICTURE, f".partial-{STORE}"})

GOALS = SimpleNamespace(
    #: Compared wavelengths; outside, the responsivity is too low for accurate reflectance.
    bands_nm=(420.0, 980.0),
    #: Window of the oxygen A band, where errors of wavelength are largest.
    oxygen_nm=(750.0, 780.0),
    #: Tolerance of the mean error over pixels and bands of a material [1].
    max_bias=0.002,
    #: Tolerance of the RMS error of all single samples, with sensor noise [1].
    max_rmse=0.005,
    #: Tolerance of the relative error of the scene's mean spectrum in the oxygen window [1].
    max_oxygen=0.002,
)


#: Effects of a real collect in the demonstration, besides noise and a clock that is 37.25 s slow. The sun is
#: 45 degrees from the zenith: nearer to it, the level of metallic paints depends on the lean of a roof.
EFFECTS: dict[str, Any] = {
    "smile_nm": 0.5,
    "dropped": 3,
    "glint": 0.002,
    "drift_per_minute": 0.02,
    "sun_zenith": 45.0,
    "gain_u": 0.01,
}

#: Wavelengths of the printed spectra [nm].
_PRINTED_NM = (450.0, 550.0, 650.0, 750.0, 850.0, 950.0)

_FIELD_LEGEND = """\
Means of clean paint on roofs and bonnets, without mirrored sky, and of samples of the same paints on the
ground. RMSE: over all bands. A metallic paint has a level for one geometry only: here 45 degrees between the
view and the mirror direction of the sun, for camera and spectrometer."""

_LEGEND = """\
bias: recovered minus simulated reflectance, {0:.0f} to {1:.0f} nm, of pixels without a quality flag
({4:.2f} % have one). RMSE: of single samples, sensor noise included. RMSE mean: of the mean spectrum, over
bands. O2 window: its largest relative difference, {2:.0f} to {3:.0f} nm."""


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
    """Recovered and true reflectance of a collect: closure, and paints against the field spectrometer."""

    materials: tuple[Agreement, ...]  #: In the simulator's order.
    overall: Agreement  #: All pixels together.
    flagged: float  #: Share of pixels with a quality flag, which are not compared.
    field: Validation | None = None  #: Paints against the field spectrometer; None without regions.

    @property
    def problems(self) -> tuple[str, ...]:
        # Values of the closure outside the tolerance, one line each.
        rmse, oxygen = self.overall.rmse, self.overall.oxygen
        checks = (
            *(
                (
                    abs(row.bias) < GOALS.max_bias,
                    f"{row.material}: bias {row.bias:+.4f}, tolerance {GOALS.max_bias}",
                )
                for row in (*self.materials, self.overall)
            ),
            (rmse < GOALS.max_rmse, f"all pixels: RMSE {rmse:.4f}, tolerance {GOALS.max_rmse}"),
            (
                oxygen < GOALS.max_oxygen,
                f"all pixels: oxygen window {oxygen:.2%}, tolerance {GOALS.max_oxygen:.1%}",
            ),
        )
        return tuple(text for holds, text in checks if not holds)

    @property
    def ok(self) -> bool:
        # Whether the loop closes within tolerance.
        return not self.problems

    def __str__(self) -> str:
        head = ("material", "pixels", "true", "recovered", "bias", "RMSE mean", "RMSE", "O2 window")
        rows = [
            (
                row.material,
                f"{row.pixels}",
                f"{row.true:.4f}",
                f"{row.recovered:.4f}",
                f"{round(row.bias, 5) + 0.0:+.5f}",  # no sign of a zero
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
    # every column.
    #
    # Raises `StoreError` if the store has no flight line.
    true_scene = xr.open_zarr(truth)
    names = str(true_scene["surface"].attrs["flag_meanings"]).split()
    total, slab, sums = 0, None, np.zeros((4, len(names), 1))
    for name in lines_of_store(store):
        line = xr.open_zarr(store, group=f"{LINES}{name}")
        nm, frames = line["wavelength"].values, line["frame"].values
        is_used = line["good"].values & (nm >= GOALS.bands_nm[0]) & (nm <= GOALS.bands_nm[1])
        for start in range(0, frames.size, CHUNK_LINES):
            lines, order = slice(start, start + CHUNK_LINES), (ALONG_TRACK, CROSS_TRACK, ...)
            slab = line[["reflectance", "quality"]].isel({ALONG_TRACK: lines, BAND: is_used}).compute()
            true = true_scene[["reflectance", "surface"]].isel({ALONG_TRACK: frames[lines], BAND: is_used})
            slab, true = slab.transpose(*order), true.compute().transpose(*order)
            unflagged = slab["quality"].values == 0
            total += unflagged.size
            # pixels in the order of their materials
            surface = true["surface"].values[unflagged]
            by_surface = np.argsort(surface, kind="stable")
            found, starts = np.unique(surface[by_surface], return_index=True)
            if not found.size:
                continue
            recovered, expected = (
                block["reflectance"].values[unflagged][by_surface].astype(np.float64)
                for block in (slab, true)
            )
            is_finite = np.isfinite(recovered)
            error = np.where(is_finite, recovered - expected, 0.0)
            # sums over pixels (material, band): number, truth, error, squared error
            terms = (is_finite.astype(np.float64), np.where(is_finite, expected, 0.0), error, error**2)
            sums = sums + np.zeros((1, 1, error.shape[1]))
            sums[:, found] += np.stack([np.add.reduceat(term, starts, axis=0) for term in terms])
    slab = StoreError.raise_if_none(
        slab, f"{store} holds no flight line to compare", code="flightline-missing"
    )
    wavelength, counts = slab["wavelength"].values, sums[0].max(axis=1)
    window = (wavelength >= GOALS.oxygen_nm[0]) & (wavelength <= GOALS.oxygen_nm[1])

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
    )


def compare_with_field(store: Path, folder: Path) -> Validation | None:
    # Return the agreement of the paints of a simulated collect with its SVC spectrometer.
    #
    # None without regions: on a coarse picture no paint has a clean level area.
    regions = read_regions(folder / REGIONS)
    if not len(regions):
        return None
    paints = extract_signatures(
        xr.open_zarr(store, group=f"{LINES}{lines_of_store(store)[0]}"),
        regions,
        exclude=EXCLUDED & ~flags_set_from("scene"),  # the simulator's regions are clean
        specular_sky=True,
        members=0,
    )
    return validate(paints, open_svc(folder / SVC_FOLDER))


def field_table(validation: Validation) -> str:
    # Return the spectra of paints, seen from the air and on the ground, with the outcome of every pair
    head = ("reflectance [1]", "seen by", *(f"{nm:.0f} nm" for nm in _PRINTED_NM), "RMSE", "limit", "")
    rows: list[tuple[str, ...]] = []
    for row, spectra in enumerate(validation.spectra):
        whole = validation.statistics.isel(pair=row)
        verdict = "not judged" if whole["exclusion"].item() else "pass" if whole["passes"].all() else "FAIL"
        of_all = whole.sel(part="all")
        ends = ("", "", ""), (f"{of_all['rmse']:.4f}", f"{of_all['rmse_limit']:.4f}", verdict)
        sides = {"signature": "camera", "reference": str(whole["instrument"].item())}
        for (side, instrument), end in zip(sides.items(), ends, strict=True):
            used = spectra[side].dropna(BAND)
            values = np.interp(_PRINTED_NM, used["wavelength"].values, used.values)
            name = str(whole["signature"].item()) if side == "signature" else ""
            rows.append((name, instrument, *(f"{value:.4f}" for value in values), *end))
    lines = aligned([head, *rows], names=2)
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], validation.verdict])


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
    is_earlier = simulated and (folder / STORE).is_dir() and not foreign
    names = ", ".join(foreign[:5] or sorted(entry.name for entry in folder.iterdir())[:5])
    StoreError.raise_if(
        not (overwrite or is_earlier),
        f"{folder} is not empty ({names})",
        mend="choose another folder, or pass overwrite=True to write into it",
        option="choose another folder, or pass --overwrite to write into it",
        code="folder-not-empty",
    )


def run_demonstration(
    folder: Path,
    *,
    lines: int = 160,
    bands: int = 136,
    columns: int = 200,
    seed: int = 9,
    scene: str = "rendered",
    samples: int | None = None,
    overwrite: bool = False,
    progress: bool = False,
    simulated: Callable[[int, int], None] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Comparison:
    """Simulate a collect, process it like a real one, and compare paints with the field spectrometer.

    Then the loop is closed: reflectance is compared with the simulator's own values of the same pixels.

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
    if found := compare_with_field(outcome.path, folder):
        comparison = replace(comparison, field=found)
        say(f"\n{field_table(found)}\n\n{_FIELD_LEGEND}")
    say(f"\nclosure with the simulator's own pixels:\n{comparison}")
    say(f"\n{_LEGEND.format(*GOALS.bands_nm, *GOALS.oxygen_nm, 100 * comparison.flagged)}")
    overall = comparison.overall
    say(
        f"closure: bias {round(overall.bias, 5) + 0.0:+.5f} (tolerance {GOALS.max_bias}, "
        "for each material too), "
        f"RMSE {overall.rmse:.5f} ({GOALS.max_rmse}), "
        f"O2 window {overall.oxygen:.2%} ({GOALS.max_oxygen:.1%}): "
        + ("within tolerance" if comparison.ok else "OUTSIDE TOLERANCE")
    )
    for problem in comparison.problems:
        say(f"  {problem}")
    draw_comparison(outcome.path, folder / PICTURE, say)
    return comparison


def draw_comparison(store: Path, picture: Path, say: Callable[[str], None]) -> None:
    try:
        xr.open_zarr(store, group=f"{LINES}{lines_of_store(store)[0]}").paint.quicklook(picture)
    except MissingExtraError as error:
        say(f"no picture: {error}")
    else:
        say(f"picture: {picture}")
