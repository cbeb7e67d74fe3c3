"""Right collects of many kinds, and the faults that make them wrong, in plain numpy on the files.

Scenes that the simulator lacks (snow, water, dusk) come from a forward model of their own: endmembers mixed
by smooth fields, times daylight, over the gain, plus the dark and noise.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from hyperpaint.simulation import simulate_collect
from hyperpaint.simulation.flight import sky_irradiance

Array = np.ndarray[Any, Any]


def header_of(cube: Path) -> dict[str, str]:
    text = cube.with_name(f"{cube.name}.hdr").read_text()
    return dict(re.findall(r"^([a-z ]+?) *= *([^{\n]+)$", text, re.MULTILINE))


def read(cube: Path) -> Array:
    # Return the counts of a bil cube (line, band, column)
    fields = header_of(cube)
    shape = tuple(int(fields[key]) for key in ("lines", "bands", "samples"))
    return np.fromfile(cube, "<u2").reshape(shape)


def write(cube: Path, counts: Array, **fields: Any) -> None:
    # Write counts, and what the header says anew
    np.ascontiguousarray(np.clip(np.rint(counts), 0, 65535), "<u2").tofile(cube)
    header = cube.with_name(f"{cube.name}.hdr")
    text = header.read_text()
    for key, value in {"lines": len(counts), **fields}.items():
        text = re.sub(rf"^{key} *=.*$", f"{key} = {value}", text, flags=re.MULTILINE)
    header.write_text(text)


# --- right ones --------------------------------------------------------------------------------------------


def _spectra(nm: Array) -> dict[str, Array]:
    edge = 1.0 / (1.0 + np.exp(-(nm - 715.0) / 12.0))
    return {
        "snow": 0.95 - 0.25 * np.clip((nm - 700.0) / 300.0, 0.0, 1.0),
        "water": 0.06 * np.exp(-np.clip(nm - 520.0, 0.0, None) / 70.0) + 0.002,
        "asphalt": 0.05 + 0.04 * (nm - 400.0) / 600.0,
        "grass": 0.04 + 0.04 * np.exp(-(((nm - 550.0) / 35.0) ** 2)) + 0.42 * edge,
        "soil": 0.08 + 0.3 * (nm - 400.0) / 600.0,
        "shade": 0.01 + 0.005 * (nm - 400.0) / 600.0,
    }


SCENES: dict[str, tuple[tuple[str, ...], float]] = {
    # endmembers, and how much of the usual light there is
    "snow": (("snow", "shade"), 0.25),
    "water": (("water",), 1.0),
    "shore": (("water", "grass", "soil"), 1.0),
    "snow and water": (("snow", "water"), 0.25),
    "dusk": (("asphalt", "grass"), 0.03),
    "dark": (("asphalt", "shade"), 0.3),
    "meadow": (("grass",), 1.0),
    "field edge": (("grass", "soil"), 1.0),
}


def repaint(folder: Path, scene: str, rng: np.random.Generator, sharp: bool = False) -> None:
    # Let the camera of a simulated collect fly over another scene
    names, level = SCENES[scene]
    calibration = xr.open_zarr(folder / "calibration.zarr").load()
    nm, gain = calibration["wavelength"].values, calibration["radiance_gain"].values.astype(float)
    fwhm = float(np.mean(calibration["fwhm"].values))
    grid = np.arange(nm.min() - 30.0, nm.max() + 30.0, 0.5)
    light = sky_irradiance("clear", 40.0, grid).sum(axis=0)
    weights = np.exp(-0.5 * ((grid - nm[:, None]) / (fwhm / 2.3548)) ** 2)
    light = (weights * light).sum(axis=1) / weights.sum(axis=1)
    exposure = float(re.search(r"exposure_time_ms = ([0-9.]+)", (folder / "collect.toml").read_text())[1])
    dark = read(folder / "dark/raw_0").mean(axis=0)
    for header in sorted((folder / "flight").glob("raw_*.hdr")):
        cube = header.with_suffix("")
        lines, _, columns = read(cube).shape
        fields = np.stack([_field(rng, lines, columns, sharp) for _ in names])
        share = np.exp(3.0 * fields)
        share = (share == share.max(axis=0)) * 1.0 if sharp else share / share.sum(axis=0)
        shading = np.exp(0.15 * _field(rng, lines, columns, False) + 0.02 * rng.normal(size=(lines, columns)))
        table = np.stack([_spectra(nm)[name] for name in names])
        reflectance = np.einsum("klx,kb->lbx", share * shading, table)
        rate = level * reflectance * (light / np.pi)[:, None] / gain * exposure * 1e-3
        electrons = 20.0 * np.nan_to_num(rate)
        counts = dark + rng.poisson(electrons) / 20.0 + rng.normal(0.0, 0.5, electrons.shape)
        write(cube, np.minimum(np.rint(counts), 4095))


def _field(rng: np.random.Generator, lines: int, columns: int, along: bool) -> Array:
    size = rng.uniform(2.0, 30.0)
    noise = rng.normal(size=(lines, 1 if along else columns))
    field = gaussian_filter(noise, (size, 0.0 if along else size), mode="wrap")
    field = np.clip((field - field.mean()) / max(float(field.std()), 1e-3), -4.0, 4.0)
    return np.broadcast_to(field, (lines, columns))


def reordered(folder: Path, interleave: str) -> None:
    # Write the cubes in another interleave, and say so
    axes = {"bip": (0, 2, 1), "bsq": (1, 0, 2)}[interleave]
    for header in (folder / "flight").glob("raw_*.hdr"):
        cube = header.with_suffix("")
        counts = read(cube)
        write(cube, counts.transpose(axes), lines=len(counts), interleave=interleave)


def _size(rng: np.random.Generator, **more: Any) -> dict[str, Any]:
    size = {
        "lines": int(rng.integers(30, 260)), "bands": int(rng.integers(30, 160)),
        "columns": int(rng.integers(12, 72)), "seed": int(rng.integers(2**31)),
    }  # fmt: skip
    return {"scene": "plan", "truth": False, **size, **more}


Recipe = Callable[[np.random.Generator], dict[str, Any]]
RECIPES: dict[str, Recipe] = {
    "usual": lambda _: {},
    "cloud": lambda rng: {"cloud": (float(rng.uniform(0.3, 0.9)), float(rng.uniform(0.2, 1.0)), 0.1)},
    "overcast": lambda _: {"sky": "overcast"},
    "low sun": lambda _: {"sky": "near_sunset"},
    "narrow": lambda rng: {"columns": int(rng.integers(1, 9))},
    "few bands": lambda rng: {"bands": int(rng.integers(3, 13)), "fwhm_nm": float(rng.uniform(6, 30))},
    "camera of 16 bits": lambda _: {
        "bit_depth": 16, "electrons_per_count": 1.2, "dark_level": 1500.0, "dark_pattern": 40.0,
        "read_noise": 8.0, "srf_shape": "slit", "first_wavelength": 450.0, "last_wavelength": 950.0,
    },
    "camera of 10 bits": lambda _: {
        "bit_depth": 10, "electrons_per_count": 80.0, "dark_level": 20.0, "dark_pattern": 1.0,
        "dark_rate": 400.0, "first_wavelength": 400.0, "last_wavelength": 700.0, "nonuniformity": 0.08,
    },
    "darks": lambda rng: {
        "dark_frames": int(rng.choice([1, 2, 5, 400])), "dark_pattern": float(rng.choice([0, 0.4, 3, 25])),
    },
    "cubes": lambda rng: {"lines": 240, "cubes": int(rng.integers(2, 5)), "dropped": int(rng.integers(0, 9))},
    "optics": lambda _: {
        "bad_elements": 40, "masked_columns": 2, "stray_light": 0.03, "keystone_columns": 0.6,
        "smile_nm": 3.0, "pedestal": 6.0, "dispersion_bow_nm": 5.0, "psf_across_columns": 1.5,
    },
    "short": lambda rng: {"lines": int(rng.integers(2, 17))},
    "spectrometer": lambda rng: {
        "irradiance_noise": 0.01, "irradiance_interval_s": int(rng.integers(1, 5)), "drift_per_minute": 0.05,
    },
    "platform": lambda rng: {
        "scene": "checkerboard", "lines": 80, "bands": 40, "columns": 40,
        "course": float(rng.uniform(0, 360)), "wobble": str(rng.choice(["slow", "calm", "rough"])),
    },
    "traced": lambda _: {"scene": "rendered", "lines": 48, "bands": 40, "columns": 32, "samples": 4},
    **{scene: lambda _: {} for scene in SCENES},
}  # fmt: skip


Size = Callable[[np.random.Generator], dict[str, Any]]


def right_collect(folder: Path, recipe: str, seed: int, size: Size = _size) -> Path:
    # Simulate a collect of a kind that can be true, in any interleave
    rng = np.random.default_rng([seed, list(RECIPES).index(recipe)])
    settings = RECIPES[recipe](rng)
    with np.errstate(invalid="ignore"):  # an SVC sees nothing in a low sun's band of water
        path = simulate_collect(folder, **{**size(rng), **settings})
    if recipe in SCENES:
        repaint(folder, recipe, rng, sharp=bool(rng.random() < 0.4))
    interleave = str(rng.choice(["bil", "bil", "bip", "bsq"]))
    if interleave != "bil":
        reordered(folder, interleave)
    return path


# --- wrong ones --------------------------------------------------------------------------------------------


def first_cube(folder: Path) -> Path:
    return sorted((folder / "flight").glob("raw_*.hdr"))[0].with_suffix("")


def change_cube(cube: Path, change: Callable[[Array], Array], **fields: Any) -> None:
    write(cube, change(read(cube).astype(float)), **fields)


def over_range(folder: Path, strength: int) -> None:
    def spikes(counts: Array) -> Array:
        counts[:, :, ::10] = np.where(counts[:, :, ::10] > 200, 40000, counts[:, :, ::10])
        return counts

    change_cube(first_cube(folder), (lambda counts: counts * 16, lambda counts: counts * 4, spikes)[strength])


def dark_zeros(folder: Path, strength: int) -> None:
    def zeros(counts: Array) -> Array:
        counts[(..., (..., slice(None, None, 2)), (slice(None, None, 2),))[strength]] = 0
        return counts

    change_cube(folder / "dark/raw_0", zeros)


def dark_bright(folder: Path, strength: int) -> None:
    light = read(first_cube(folder)).astype(float)
    share = (1.5, 0.3, 0.1)[strength]

    def lit(counts: Array) -> Array:
        picked = light[np.arange(len(counts)) % len(light)]
        return counts + share * np.clip(picked - counts.mean(axis=0), 0, None)

    change_cube(folder / "dark/raw_0", lit)


def dark_exposed(folder: Path, strength: int) -> None:
    # a hotter or longer one: the pedestal grows, and so does its pattern
    change_cube(folder / "dark/raw_0", lambda counts: counts * (12.0, 6.0, 4.0)[strength])


def dark_foreign(folder: Path, strength: int) -> None:
    rng = np.random.default_rng(strength)

    def foreign(counts: Array) -> Array:
        if strength == 0:
            pattern = rng.permutation(counts.mean(axis=0).ravel()).reshape(counts.shape[1:])
            return counts - counts.mean(axis=0) + pattern
        return counts[..., ::-1] if strength == 1 else np.roll(counts, 1, axis=2)

    change_cube(folder / "dark/raw_0", foreign)


def bands_turned(folder: Path, strength: int) -> None:
    order = np.arange(read(first_cube(folder)).shape[1])
    order = (order[::-1], np.roll(order, order.size // 3), np.random.default_rng(1).permutation(order))[
        strength
    ]
    for cube in (first_cube(folder), folder / "dark/raw_0"):
        change_cube(cube, lambda counts: counts[:, order])


def bands_shifted(folder: Path, strength: int) -> None:
    for cube in (first_cube(folder), folder / "dark/raw_0"):
        change_cube(cube, lambda counts: np.roll(counts, (20, -10, 5)[strength], axis=1))


def wavelengths(folder: Path, strength: int) -> None:
    path = folder / "calibration.zarr"
    calibration = xr.open_zarr(path).load()
    nm = calibration["wavelength"].values
    wrong = (nm[::-1], np.linspace(500.0, 900.0, nm.size), nm + 30.0)[strength]
    calibration = calibration.assign_coords(wavelength=calibration["wavelength"].copy(data=wrong))
    from hyperpaint.io.store import to_store

    shutil.rmtree(path)
    to_store(calibration, path)


def interleave(folder: Path, strength: int) -> None:
    said, axes = (("bil", (0, 2, 1)), ("bil", (1, 0, 2)), ("bsq", (0, 1, 2)))[strength]
    counts = read(first_cube(folder))
    write(first_cube(folder), counts.transpose(axes), lines=len(counts), interleave=said)


def byte_order(folder: Path, strength: int) -> None:
    if strength == 0:
        change_cube(first_cube(folder), lambda counts: counts, **{"byte order": 1})
    elif strength == 1:
        change_cube(first_cube(folder), lambda counts: counts.astype("<u2").byteswap())
    else:
        axes = (0, 2, 1)
        counts = read(first_cube(folder)).transpose(axes).astype("<u2").byteswap()
        write(first_cube(folder), counts, interleave="bip")


def _index(cube: Path) -> Path:
    return cube.with_name(f"frameIndex_{cube.name.split('_')[1]}.txt")


def _rows(path: Path) -> tuple[str, list[list[str]]]:
    header, *rows = path.read_text().splitlines()
    return header, [row.split("\t") for row in rows]


def _write_rows(path: Path, header: str, rows: list[list[str]]) -> None:
    path.write_text("\n".join([header, *("\t".join(row) for row in rows)]) + "\n")


def first_frame(folder: Path, strength: int) -> None:
    index = _index(first_cube(folder))
    header, rows = _rows(index)
    _write_rows(index, header, [[str(int(row[0]) + (1, 40, 2000)[strength]), *row[1:]] for row in rows])


def foreign_index(folder: Path, strength: int) -> None:
    cube, text = first_cube(folder), (folder / "collect.toml").read_text()
    header, rows = _rows(_index(cube))
    first = (len(rows), 458, 2000)[strength]
    other = cube.with_name(f"frameIndex_{first}.txt")
    _write_rows(other, header, [[str(int(row[0]) + first), *row[1:]] for row in rows])
    (folder / "collect.toml").write_text(text.replace(f"flight/{_index(cube).name}", f"flight/{other.name}"))


def doubled(folder: Path, strength: int) -> None:
    def repeat(counts: Array) -> Array:
        line = np.arange(len(counts))
        middle = len(line) // 2
        if strength == 0:
            line[middle:] -= 1
        elif strength == 1:
            line = np.sort(np.concatenate([line, line[5:-5:9]]))[: len(line)]
        else:
            line[middle:] = middle
        return counts[line]

    change_cube(first_cube(folder), repeat)


def _lose(folder: Path, count: int, stamps_know: bool) -> None:
    cube = first_cube(folder)
    counts, (header, rows) = read(cube), _rows(_index(cube))
    at = len(counts) // 2
    write(cube, np.delete(counts, slice(at, at + count), axis=0))
    stamps = [row[1:] for row in rows]
    stamps = stamps[:at] + stamps[at + count :] if stamps_know else stamps[: len(rows) - count]
    _write_rows(_index(cube), header, [[str(number), *stamp] for number, stamp in enumerate(stamps)])


def lost_by_stamps(folder: Path, strength: int) -> None:
    _lose(folder, (2, 10, 40)[strength], stamps_know=True)


def lost_unknown(folder: Path, strength: int) -> None:
    _lose(folder, (5, 20, 60)[strength], stamps_know=False)


_SPECTRUM = slice(484, 484 + 8 * 726)


def spectra_files(folder: Path) -> list[tuple[Path, bytearray]]:
    return [(path, bytearray(path.read_bytes())) for path in sorted((folder / "asd").glob("*.asd"))]


def light_still(folder: Path, strength: int) -> None:
    files = spectra_files(folder)
    source = files[(0, 1, len(files) // 3)[strength]][1][_SPECTRUM]
    for place, (path, data) in enumerate(files):
        if place >= (0, 1, len(files) // 3)[strength]:
            data[_SPECTRUM] = source
            path.write_bytes(data)


def light_level(folder: Path, strength: int) -> None:
    for path, data in spectra_files(folder):
        values = np.frombuffer(bytes(data[_SPECTRUM]), "<f8") * (1e-3, 1e3, 1e-2)[strength]
        data[_SPECTRUM] = values.tobytes()
        path.write_bytes(data)


def _places(folder: Path, change: Callable[[int, int, list[str]], list[str]]) -> None:
    path = folder / "flight/imu_gps.txt"
    header, rows = _rows(path)
    _write_rows(path, header, [change(place, len(rows), row) for place, row in enumerate(rows)])


def navigation_still(folder: Path, strength: int) -> None:
    rng = np.random.default_rng(0)
    fixed = _rows(folder / "flight/imu_gps.txt")[1]

    def still(place: int, rows: int, row: list[str]) -> list[str]:
        if strength == 2 and place < 0.5 * rows:
            return row
        at = fixed[rows // 2 if strength == 2 else 0][3:5]
        if strength == 1:
            at = [f"{float(degree) + rng.normal(0.0, 1e-9):.9f}" for degree in at]
        return [*row[:3], *at, *row[5:]]

    _places(folder, still)


def navigation_nan(folder: Path, strength: int) -> None:
    def lost(place: int, rows: int, row: list[str]) -> list[str]:
        if strength == 0:
            return ["nan", "nan", "nan", "nan", "nan", "nan", *row[6:]]
        gone = place > 0.5 * rows if strength == 1 else place % 2
        return [*row[:3], "nan", "nan", *row[5:]] if gone else row

    _places(folder, lost)


def flagged(folder: Path, strength: int) -> None:
    def clipped(counts: Array) -> Array:
        counts[:, :, : (counts.shape[2] * (30, 50, 90)[strength] // 100)] = 4095
        return counts

    change_cube(first_cube(folder), clipped)


FAULTS: dict[str, tuple[Callable[[Path, int], None], tuple[str, ...]]] = {
    # and the names by which a finding, an error or a warning says it
    "counts over the range": (over_range, ("counts-over-range",)),
    "dark of zeros": (dark_zeros, ("dark-of-zeros", "dark-unsteady")),
    "dark brighter than the scene": (dark_bright, ("dark-over-scene", "dark-lit", "dark-unsteady")),
    "foreign pattern of the dark": (dark_foreign, ("dark-pattern",)),
    "order of bands": (bands_turned, ("band-order",)),
    "bands shifted": (bands_shifted, ("band-order",)),
    "wavelengths of another camera": (wavelengths, ("band-order",)),
    "interleave": (interleave, ("interleave",)),
    "byte order": (byte_order, ("byte-order",)),
    "first frame": (first_frame, ("first-frame",)),
    "index of another cube": (foreign_index, ("foreign-frame-index",)),
    "doubled frames": (doubled, ("doubled-frames",)),
    "lost frames, by their stamps": (lost_by_stamps, ("lost-frames",)),
    "lost frames, by the picture": (lost_unknown, ("lost-frames",)),
    "irradiance stands still": (light_still, ("irradiance-constant",)),
    "level of irradiance": (light_level, ("irradiance-level", "sun above the atmosphere", "twilight")),
    "navigation stands still": (navigation_still, ("navigation-still",)),
    "navigation without numbers": (navigation_nan, ("navigation-gaps", "nan")),
    "flagged pixels": (flagged, ("many pixels are flagged",)),
    "dark of another exposure": (dark_exposed, ("dark-over-scene", "dark-pattern")),
}  # fmt: skip


def wrong_collect(folder: Path, fault: str, strength: int, seed: int, right: Path | None = None) -> Path:
    # Simulate a collect with one fault, or put the fault into a copy of the right collect in a folder
    if right is None:
        rng = np.random.default_rng([seed, list(FAULTS).index(fault), strength])
        size = {"lines": int(rng.integers(140, 220)), "bands": int(rng.integers(60, 140))}
        path = simulate_collect(
            folder, **_size(rng, **size, columns=int(rng.integers(24, 64)), irradiance_noise=0.002)
        )
    else:
        path = Path(shutil.copytree(right, folder), "collect.toml")
    FAULTS[fault][0](folder, strength)
    return path
