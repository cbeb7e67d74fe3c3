"""Collects with a wrong scale, light or gain at three strengths, and right ones that resemble them.

Written before the checks that judge them. A fault changes the files of a right collect, states the factor on
reflectance that it causes, and holds the words by which a finding, an error or a warning names it.
"""

import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.io.store import to_store
from hyperpaint.simulation import simulate_collect

from .plausible_collects import (
    RECIPES,
    SCENES,
    Array,
    Recipe,
    change_cube,
    first_cube,
    read,
    repaint,
    right_collect,
    spectra_files,
    write,
)
from .tiny_collects import without_references

LINES, BANDS, COLUMNS = (64, 160), (40, 60), (24, 48)

#: Light, sun and camera of the collects that faults are put into, drawn by the seed.
BASES: tuple[dict[str, Any], ...] = (
    {},
    {"sun_zenith": 50.0},
    {"sun_zenith": 62.0, "exposure_time_ms": 6.0},
    {"column_nonuniformity": 0.03, "dark_pattern": 6.0},
    {"bit_depth": 14, "electrons_per_count": 5.0, "dark_level": 300.0, "read_noise": 1.5},
)


def small_size(rng: np.random.Generator) -> dict[str, Any]:
    sizes = {"lines": LINES, "bands": BANDS, "columns": COLUMNS}
    return {
        **{name: int(rng.integers(first, last + 1)) for name, (first, last) in sizes.items()},
        "seed": int(rng.integers(2**31)), "scene": "plan", "irradiance_margin_s": 30.0,
    }  # fmt: skip


# --- ways to change the files ------------------------------------------------------------------------------


def change_text(path: Path, pattern: str, new: str) -> None:
    # Replace a pattern of a text file, which must be there
    text, count = re.subn(pattern, new, path.read_text(), flags=re.MULTILINE | re.IGNORECASE)
    assert count, (path, pattern)
    path.write_text(text)


def change_scans(folder: Path, change: Callable[[int, Array], Array]) -> None:
    # Replace spectra of the binary record by change(number from the middle of the line, values)
    files = spectra_files(folder)
    for number, (path, data) in enumerate(files):
        size = 8 * int.from_bytes(data[204:206], "little")
        values = np.frombuffer(bytes(data[484 : 484 + size]), "<f8").copy()
        new = np.asarray(change(number - len(files) // 2, values), "<f8")
        data[484 : 484 + size] = new.tobytes()
        path.write_bytes(data)


def as_logger(folder: Path, change: Callable[[Array], Array], form: str = "{:.6g}") -> None:
    # Replace the binary record by a CSV of a logger; values [W m-2 nm-1] by change(values)
    record = open_irradiance(str(folder / "asd/*.asd"), utc_offset_h=-5.0, clock_offset_s=37.25)
    values = change(record["irradiance"].values.astype(float))
    head = ",".join(f"{nm:g}" for nm in record["irradiance_wavelength"].values)
    rows = [
        f"{time}Z," + ",".join(form.format(value) for value in row)
        for time, row in zip(record["irradiance_time"].values, values, strict=True)
    ]
    lines = ["# units: W m-2 nm-1", "# fwhm_nm: 3", f"time,{head}", *rows]
    (folder / "sky.csv").write_text("\n".join(lines) + "\n")
    table = '[irradiance]\nfiles = "sky.csv"\nstamp = "mid"\n'
    change_text(folder / "collect.toml", r"^\[irradiance\]\n(.+\n)+", table)


def change_calibration(folder: Path, change: Callable[[xr.Dataset], xr.Dataset]) -> None:
    path = folder / "calibration.zarr"
    dataset = change(xr.open_zarr(path).load()).drop_encoding()
    shutil.rmtree(path)
    to_store(dataset, path)


def scale_gain(folder: Path, factor: Callable[[Array], Array]) -> None:
    # Multiply the gain by factor(wavelength [nm] as a column)
    def changed(data: xr.Dataset) -> xr.Dataset:
        gain = data["radiance_gain"]
        values = gain.values * factor(data["wavelength"].values[:, None])
        return data.assign(radiance_gain=gain.copy(data=values.astype(gain.dtype)))

    change_calibration(folder, changed)


def state_exposure(folder: Path, stated_ms: float) -> None:
    # State another exposure in the declaration, the settings and all headers
    true = re.search(r"exposure_time_ms = ([0-9.]+)", (folder / "collect.toml").read_text())
    assert true
    found = rf"(exposure[^\n=:]*[=:]\s*){true[1]}\b"
    for path in sorted(folder.rglob("*")):
        if path.name in ("collect.toml", "settings.txt") or path.suffix == ".hdr":
            text = re.sub(found, rf"\g<1>{stated_ms:g}", path.read_text(), flags=re.IGNORECASE)
            path.write_text(text)


def full_light(folder: Path) -> tuple[Array, Array]:
    # Return the dark, and the counts that a reflectance of 1 adds to it (band, cross_track), by the truth
    truth = xr.open_zarr(folder / "truth.zarr")["reflectance"]
    true = truth.transpose("along_track", "band", "cross_track").values
    dark, counts = read(folder / "dark/raw_0").mean(axis=0), read(first_cube(folder)).astype(float)
    is_usable = (true > 0.05) & (true < 0.95)
    sums = np.where(is_usable, counts - dark, 0.0).sum(axis=0)
    light = sums / np.maximum(np.where(is_usable, true, 0.0).sum(axis=0), 1e-3)
    return dark, np.where(light > 0.0, light, np.median(light, axis=1, keepdims=True))


def add_panel(folder: Path, factor: float, heading: str, scale: float = 1.0) -> None:
    # Lay a panel of 0.5 on 8 x 8 pixels, and declare it with a certificate of factor times 0.5
    dark, light = full_light(folder)
    rng = np.random.default_rng(8)

    def laid(counts: Array) -> Array:
        pixels = dark + 0.5 * light
        noise = rng.normal(size=(8, len(dark), 8)) * np.sqrt(np.maximum(pixels, 0.0) / 20.0 + 0.25)[:, 8:16]
        counts[20:28, :, 8:16] = pixels[:, 8:16] + noise
        return counts

    change_cube(first_cube(folder), laid)
    rows = "".join(f"{nm},{scale * factor * 0.5:.5f}\n" for nm in range(380, 1021, 5))
    (folder / "panel.csv").write_text(f"wavelength [nm],reflectance [{heading}]\n{rows}")
    path = without_references(folder / "collect.toml")
    with path.open("a") as file:
        file.write(
            '\n[[panels]]\nline = "raw_0"\nalong_track = [20, 28]\ncross_track = [8, 16]\n'
            'certificate = "panel.csv"\nuncertainty = 0.02\n'
        )


# --- faults of scale ---------------------------------------------------------------------------------------


def record_level(folder: Path, factor: float) -> None:
    change_scans(folder, lambda _, values: factor * values)


def shaded_scan(folder: Path, factor: float) -> None:
    change_scans(folder, lambda number, values: values * (factor if number == 0 else 1.0))


def lightless_scan(folder: Path, value: float) -> None:
    def lost(values: Array) -> Array:
        values[len(values) // 2] = value
        return values

    as_logger(folder, lost)


def _among(values: Array, channels: slice | None) -> Array:
    return np.isin(np.arange(values.shape[-1]), np.arange(values.shape[-1])[channels])


def zero_channels(folder: Path, channels: slice) -> None:
    change_scans(folder, lambda _, values: np.where(_among(values, channels), 0.0, values))


def clipped_channels(folder: Path, level: float) -> None:
    change_scans(folder, lambda _, values: np.minimum(values, level * values.max()))


def filled_channels(folder: Path, fault: tuple[slice, float]) -> None:
    channels, value = fault
    as_logger(folder, lambda values: np.where(_among(values, channels), value, values))


def stuck_channels(folder: Path, channels: slice) -> None:
    first: list[Array] = []

    def stuck(_: int, values: Array) -> Array:
        first.append(values)
        return np.where(_among(values, channels), first[0], values)

    change_scans(folder, stuck)


def stepped_record(folder: Path, factor: float) -> None:
    # the step is three scans before the middle of the line
    change_scans(folder, lambda number, values: values * (factor if number >= -3 else 1.0))


def gain_factor(folder: Path, factor: float) -> None:
    scale_gain(folder, lambda nm: np.full_like(nm, factor))


def gain_in_other_order(folder: Path, order: Callable[[Array], Array]) -> None:
    def changed(data: xr.Dataset) -> xr.Dataset:
        gain = data["radiance_gain"]
        return data.assign(radiance_gain=gain.copy(data=order(gain.values)))

    change_calibration(folder, changed)


def gain_of_another_camera(folder: Path, amplitude: float) -> None:
    # another grating and detector: a smooth curve over wavelength, the median near 1
    scale_gain(folder, lambda nm: np.exp(amplitude * np.cos(np.pi * (nm - 430.0) / 330.0)))


def blocked_swath(folder: Path, fault: tuple[float, float]) -> None:
    first, share = fault
    dark = read(folder / "dark/raw_0").mean(axis=0)

    def blocked(counts: Array) -> Array:
        column = int(first * counts.shape[2])
        counts[:, :, column:] = (dark + share * (counts - dark))[:, :, column:]
        return counts

    change_cube(first_cube(folder), blocked)


def dark_with_scene(folder: Path, share: float) -> None:
    scene = read(first_cube(folder)).astype(float).mean(axis=(0, 2))
    change_cube(
        folder / "dark/raw_0",
        lambda dark: dark + share * (scene - dark.mean(axis=(0, 2)))[None, :, None],
    )


def left_justified(folder: Path, fault: tuple[float, int]) -> None:
    factor, bits = fault
    for cube in (first_cube(folder), folder / "dark/raw_0"):
        change_cube(cube, lambda counts: np.minimum(counts * factor, 2**bits - 1))
    change_text(folder / "collect.toml", r"^bit_depth = .*$", f"bit_depth = {bits}")


def smile_sign(folder: Path, factor: float) -> None:
    change_calibration(
        folder,
        lambda data: data.assign_coords(wavelength_shift=factor * data["wavelength_shift"]),
    )


class Fault(NamedTuple):
    change: Callable[[Path, Any], None]
    strengths: tuple[Any, Any, Any]  #: The third is the weakest
    factors: str  #: Factor on reflectance of the strengths; a range is over bands, columns or lines
    words: str  #: Expression by which a finding, an error or a warning names the fault
    settings: Mapping[str, Any] = MappingProxyType({})
    refused: int = 0  #: Number of strengths for which a name is not enough


_LIGHT = r"irradiance|daylight|\brecord\b"
_SCAN = r"\bscans?\b|spectr(um|a) .*(neighbour|differ|unlike|left out|missing)|neighbouring spectra"
_CHANNEL = r"channels?"
_GAIN = r"gain|calibration|responsivity"

FAULTS: dict[str, Fault] = {
    "record behind a filter": Fault(record_level, (0.05, 0.2, 0.5), "20, 5, 2", _LIGHT),
    "radiance for irradiance": Fault(
        record_level, (1 / np.pi, 0.5 / np.pi, np.pi), "3.14, 6.28, 0.32", _LIGHT + r"|\bpi\b|radiance"
    ),
    "one scan shaded": Fault(shaded_scan, (0.1, 0.3, 0.6), "to 10, 3.3, 1.7", _SCAN),
    "one scan without light": Fault(
        lightless_scan, (0.0, -1.0, -9999.0), "to 1e4 or NaN", _SCAN + "|zero|negative|fill|left out|-9999"
    ),
    "zero channels": Fault(
        zero_channels, (slice(None, None, 2), slice(None, None, 5), slice(300, 308)), "1 to 2, or NaN",
        _CHANNEL + "|zero",
    ),
    "clipped channels": Fault(
        clipped_channels, (0.5, 0.75, 0.93), "to 2, 1.3, 1.07", r"clip|saturat|flat|plateau"
    ),
    "filled channels": Fault(
        filled_channels,
        ((slice(100, 300), -9999.0), (slice(400, 440), 65535.0), (slice(250, 254), -1.0)),
        "NaN, 0 or negative in these bands", _CHANNEL + "|fill|negative|-9999|65535",
    ),
    "stuck channels": Fault(
        stuck_channels, (slice(0, 363), slice(200, 260), slice(300, 304)), "0.5 in these bands",
        _CHANNEL + r"|stuck|constant|stand", {"cloud": (0.5, 0.3, -8.0)},
    ),
    "gain x 1000": Fault(gain_factor, (1000.0, 100.0, 10.0), "1000, 100, 10", _GAIN),
    "gain per ms": Fault(gain_factor, (1e-3, 1e-2, 0.1), "0.001, 0.01, 0.1", _GAIN),
    "exposure": Fault(state_exposure, (1.0, 25.0, 2.5), "5, 0.2, 2", "exposure", {"exposure_time_ms": 5.0}),
    "order of the gain": Fault(
        gain_in_other_order,
        (
            lambda gain: gain[::-1],
            lambda gain: np.roll(gain, len(gain) // 4, axis=0),
            lambda gain: np.roll(gain, 3, axis=0),
        ),
        "0.34 to 2.9, 0.4 to 2.5, 0.8 to 1.2", _GAIN + "|band-order|order of the bands",
    ),
    "gain of another camera": Fault(
        gain_of_another_camera, (0.7, 0.25, 0.1), "0.5 to 2, 0.78 to 1.28, 0.9 to 1.1", _GAIN + "|shape"
    ),
    "gain flipped across": Fault(
        gain_in_other_order, (lambda gain: gain[:, ::-1],) * 3, "+-20, +-10, +-4 % between columns",
        "column|across|flip|stripe",
    ),
    "swath blocked": Fault(
        blocked_swath, ((0.5, 0.5), (0.85, 0.3), (0.4, 0.85)), "0.5, 0.3, 0.85 there",
        r"column|across|block|vignett|swath",
    ),
    "dark with scene light": Fault(dark_with_scene, (0.2, 0.05, 0.015), "0.7, 0.91, 0.98", r"\bdark"),
    "counts left-justified": Fault(
        left_justified, ((16.0, 16), (4.0, 14), (65535 / 4095, 16)), "16, 4, 16",
        r"justif|divisor|multiple|bit.?depth|\bbits?\b|shift", {"bit_depth": 12, "electrons_per_count": 20.0},
    ),
    "certificate of the panel": Fault(
        lambda folder, fault: add_panel(folder, *fault),
        ((1.0, "%"), (0.1, "1"), (1.25, "1")), "0.01, 0.1, 1.25",
        "panel|certificate", refused=2,
    ),
    "step in the record": Fault(stepped_record, (0.1, 0.5, 0.85), "10, 2, 1.18", r"\bstep|gain|factor"),
    "sign of the smile": Fault(
        smile_sign, (-1.0, -1.0, -1.0), "0.96 to 1.04 near narrow absorption", "smile|wavelength.?shift"
    ),
}  # fmt: skip

#: Settings by strength where they make the strength.
STRENGTHS: dict[str, tuple[dict[str, Any], ...]] = {
    "gain flipped across": tuple({"column_nonuniformity": share} for share in (0.1, 0.05, 0.02)),
    "sign of the smile": tuple({"smile_nm": shift} for shift in (4.0, 2.0, 0.8)),
}


def wrong_scale(folder: Path, fault: str, strength: int, seed: int, right: Path | None = None) -> Path:
    # Simulate a small collect with its truth and one fault, or put the fault into a copy of a right one
    row = FAULTS[fault]
    if right is None:
        rng = np.random.default_rng([seed, list(FAULTS).index(fault), strength])
        base = BASES[int(rng.integers(len(BASES)))]
        settings = {**small_size(rng), **base, **row.settings}
        settings |= STRENGTHS.get(fault, ({},) * 3)[strength]
        simulate_collect(folder, irradiance_noise=0.002, **settings)
    else:
        shutil.copytree(right, folder)
    row.change(folder, row.strengths[strength])
    return without_references(folder / "collect.toml")


# --- right ones that resemble the faults --------------------------------------------------------------------


def _dark(folder: Path) -> Array:
    return read(folder / "dark/raw_0").mean(axis=0)


def bright_roofs(folder: Path, rng: np.random.Generator) -> None:
    # the whole swath is one white roof of 0.82, as bright as the sky allows
    truth = xr.open_zarr(folder / "truth.zarr")["reflectance"]
    true = truth.transpose("along_track", "band", "cross_track").values
    dark = _dark(folder)
    roof = 0.82 * np.exp(0.01 * rng.normal(size=(len(true), 1, true.shape[2])))
    change_cube(
        first_cube(folder),
        lambda counts: np.minimum(dark + (counts - dark) * roof / np.maximum(true, 0.02), 4095),
    )


def shadow_edge(folder: Path, rng: np.random.Generator) -> None:
    # a wandering edge of a shadow, nearly along the track
    dark = _dark(folder)

    def shaded(counts: Array) -> Array:
        lines, _, columns = counts.shape
        edge = columns * 0.5 + 3.0 * np.sin(np.arange(lines) / rng.uniform(6.0, 12.0))
        lit = np.where(np.arange(columns)[None, :] >= np.rint(edge)[:, None], 0.4, 1.0)
        return dark + (counts - dark) * lit[:, None, :]

    change_cube(first_cube(folder), shaded)


def road_along_the_track(folder: Path, rng: np.random.Generator) -> None:
    # asphalt left and grass right of a straight edge, at one column in all lines
    dark, cube = _dark(folder), first_cube(folder)
    repaint(folder, "meadow", rng)
    grass = read(cube).astype(float)
    repaint(folder, "dark", rng)
    road = (read(cube) - dark) / 0.3 + dark
    column = int(rng.integers(grass.shape[2] // 4, 3 * grass.shape[2] // 4))
    write(cube, np.minimum(np.concatenate([road[:, :, :column], grass[:, :, column:]], axis=2), 4095))


def record_of_three_digits(folder: Path, rng: np.random.Generator) -> None:
    as_logger(folder, lambda values: values, form="{:.3g}")


def scan_missing(folder: Path, rng: np.random.Generator) -> None:
    # the spectrometer missed a scan, and wrote none
    files = [path for path, _ in spectra_files(folder)]
    files[len(files) // 3].unlink()


def right_panel(folder: Path, rng: np.random.Generator) -> None:
    add_panel(folder, float(rng.uniform(0.99, 1.01)), *(("%", 100.0) if rng.random() < 0.5 else ("1",)))


def white_reference(folder: Path, rng: np.random.Generator) -> None:
    # a white tile in place of calibration and record, in cubes of 24 lines
    dark, light = full_light(folder)
    tile = 0.5 * light  # a tile of 0.5: one of 0.95 saturates in places
    (folder / "white").mkdir()
    for name in ("raw_0", "raw_0.hdr"):
        shutil.copy(folder / "flight" / name, folder / "white" / name)
    noise = rng.normal(size=(24, *dark.shape)) * np.sqrt(np.maximum(tile, 0.0) / 20.0 + 0.25)
    write(folder / "white/raw_0", np.minimum(dark + tile + noise, 4095))
    toml = folder / "collect.toml"
    change_text(
        toml, r"^\[calibration\]\npath.*\n", '[reference]\nwhite = "white/raw_0.hdr"\nreflectance = 0.5\n'
    )
    change_text(toml, r"^\[irradiance\]\n(.+\n)+", "")


Change = Callable[[Path, np.random.Generator], None]
RIGHT: dict[str, tuple[Recipe, Change | None]] = {
    **{name: (recipe, None) for name, recipe in RECIPES.items() if name != "traced"},
    "sun at 75 degrees": (lambda _: {"sun_zenith": 75.0}, None),
    "short exposure, stated": (lambda _: {"exposure_time_ms": 1.0}, None),
    "uneven slit, calibrated": (lambda _: {"column_nonuniformity": 0.15}, None),
    "bright dark": (lambda _: {"dark_level": 400.0, "dark_pattern": 12.0}, None),
    "cloud before the line": (lambda _: {"cloud": (0.4, 8.0, -20.0)}, None),
    "edge of a cloud in the line": (lambda _: {"cloud": (0.6, 0.3, 0.2), "irradiance_interval_s": 1}, None),
    "camera of 14 bits": (
        lambda _: {"bit_depth": 14, "electrons_per_count": 5.0, "dark_level": 300.0, "read_noise": 1.5}, None,
    ),
    "strong smile, calibrated": (lambda _: {"smile_nm": 4.0}, None),
    "record of three digits": (lambda _: {}, record_of_three_digits),
    "scan missing": (lambda _: {}, scan_missing),
    "bright roofs": (lambda _: {}, bright_roofs),
    "shadow along the track": (lambda _: {}, shadow_edge),
    "road along the track": (lambda _: {}, road_along_the_track),
    "panel": (lambda _: {}, right_panel),
    "white reference": (lambda _: {"glint": 0.0}, white_reference),
}  # fmt: skip


#: Flags of most pixels that are true of a right collect, so that telling them is no alarm.
TRUE_FLAGS = {
    "cloud": {"illumination_unstable", "timing_sensitive"},
    "edge of a cloud in the line": {"illumination_unstable", "timing_sensitive"},
    "low sun": {"low_sun"},
    "sun at 75 degrees": {"low_sun"},
    "cloud before the line": {"timing_sensitive"},  # 20 s before, within the 40 s of an unknown clock
    "spectrometer": {"timing_sensitive"},  # 5 % a minute, without an uncertainty of the clock
    "optics": {"bad_detector"},
}


def is_true(kind: str, text: str) -> bool:
    # Tell whether a text only names flags that a right collect of a kind has
    flags = set(re.findall(r"[0-9]+ % ([a-z_]+)", text))
    return "[pixels-flagged]" in text and flags <= TRUE_FLAGS.get(kind, set())


def right_input(folder: Path, kind: str, seed: int) -> Path:
    # Simulate a small right collect of a kind
    recipe, change = RIGHT[kind]
    if kind in RECIPES:
        path = right_collect(folder, kind, seed, lambda rng: small_size(rng) | {"truth": False})
        return without_references(path)
    rng = np.random.default_rng([seed, list(RIGHT).index(kind)])
    path = simulate_collect(folder, irradiance_noise=0.002, **{**small_size(rng), **recipe(rng)})
    if change is not None:
        change(folder, rng)
    return without_references(path)


# --- real counts -------------------------------------------------------------------------------------------


def real_collects(folder: Path, data: Path) -> Iterable[tuple[str, Path]]:
    # Collects of the two frames of a real line scanner, with its white reference and its dark
    parts = {}
    for part in ("capture", "white", "black"):
        counts = xr.open_dataset(data / f"real_counts/specim_fx10_{part}.nc")[part]
        parts[part] = counts.transpose("sample", "wavelength", "point").astype("u2")
    nm = parts["black"]["wavelength"].values
    for name, bands, columns in (
        ("FX10", slice(None, None, 4), slice(None, None, 8)),
        ("FX10 centre", slice(60, 400, 8), slice(400, 448)),
        ("FX10 of all bands", slice(None), slice(500, 524)),
    ):
        for scene in ("capture", "white"):
            home = folder / f"{name} {scene}".replace(" ", "_")
            home.mkdir()
            for part, cube in (("scene", scene), ("white", "white"), ("dark", "black")):
                counts = parts[cube].values[:, bands, columns]
                counts.astype("<u2").tofile(home / part)
                shape = dict(zip(("lines", "bands", "samples"), counts.shape, strict=True))
                fields = {
                    **shape, "header offset": 0, "file type": "ENVI Standard", "data type": 12,
                    "interleave": "bil", "byte order": 0, "tint": 9.0, "wavelength units": "nm",
                    "wavelength": "{" + ", ".join(f"{x:.2f}" for x in nm[bands]) + "}",
                }  # fmt: skip
                text = "".join(f"{key} = {value}\n" for key, value in fields.items())
                (home / f"{part}.hdr").write_text("ENVI\n" + text)
            (home / "collect.toml").write_text(
                '[collect]\nname = "stage"\n[camera]\nbit_depth = 12\nexposure_time_ms = 9.0\n'
                '[dark]\ncubes = ["dark.hdr"]\n[reference]\nwhite = "white.hdr"\nreflectance = 0.99\n'
                '[[flightlines]]\nid = "line"\ncube = "scene.hdr"\n'
            )
            yield f"{name} {scene}", home / "collect.toml"


assert set(SCENES) <= set(RIGHT)
