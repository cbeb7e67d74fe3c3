"""Wrong collects that are named before they are processed, and right ones that are not.

    python tests/campaigns/wrong_collects.py                    60 wrong, 200 right: twelve minutes
    python tests/campaigns/wrong_collects.py --seed 0           the collects that thresholds were set by
    python tests/campaigns/wrong_collects.py --only interleave  those whose name holds a word, said in full

Twenty faults at three strengths; right ones of 23 kinds by turns, and whatever of the real files in
`../shared/data` can be judged. Seed 1800 was written down before any collect of it was made; 0 to 9 are for
setting thresholds. A wrong one counts as named where a finding or an error holds the name of its fault.
"""

import argparse
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

from hyperpaint.base.errors import PaintError, PaintWarning

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(ROOT))

JUDGING_SEED = 1800
RIGHT = 200


def said_of(path: Path, whole: bool = False) -> list[str]:
    # Return all findings, or the error that stops the opening; of a ``whole`` run what process says
    from hyperpaint.workflows.pipeline import check_collect, process

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PaintWarning)
        try:
            if whole:
                process(path, path.parent / "lot.zarr", reflectance="none")
                return [str(each.message) for each in caught]
            return [str(finding) for finding in check_collect(path)]
        except PaintError as error:
            return [str(error)]


def judge_wrong(seed: int, only: str = "") -> dict[str, list[list[str]]]:
    # Return what is said of every fault at its strengths
    from support.plausible_collects import FAULTS, wrong_collect

    said = {}
    for fault in FAULTS:
        if only in fault:
            said[fault] = []
            for strength in range(3):
                with tempfile.TemporaryDirectory() as folder:
                    path = wrong_collect(Path(folder) / "c", fault, strength, seed)
                    said[fault].append(said_of(path, whole=fault == "flagged pixels"))
    return said


def is_named(fault: str, texts: list[str]) -> bool:
    # Tell whether one of the texts names a fault
    from support.plausible_collects import FAULTS

    return any(word in text for word in FAULTS[fault][1] for text in texts)


def judge_right(seed: int, count: int = RIGHT, only: str = "") -> list[tuple[str, int, list[str]]]:
    # Return the alarms of right collects of all kinds in turn: kind, seed, what is said
    from support.plausible_collects import RECIPES, right_collect

    alarms = []
    for number in range(count):
        kind, own = list(RECIPES)[number % len(RECIPES)], seed + number // len(RECIPES)
        if only in kind:
            with tempfile.TemporaryDirectory() as folder:
                texts = said_of(right_collect(Path(folder) / "c", kind, own))
            if texts:
                alarms.append((kind, own, texts))
    return alarms


def judge_real(data: Path) -> dict[str, list[str]]:
    # Return what is said of real files: counts and darks of two cameras, cubes, a sky record, poses
    import numpy as np
    import xarray as xr

    from hyperpaint.io.envi.envi_cubes import open_envi
    from hyperpaint.io.navigation.navigation_opening import open_navigation
    from hyperpaint.plausibility.line_judging import (
        judge_bands,
        judge_dark,
        judge_dark_frames,
        judge_doubles,
        judge_irradiance,
        judge_layout,
        judge_navigation,
        sample_cube,
    )

    said: dict[str, list[str]] = {}

    def note(name: str, *findings: object) -> None:
        said[name] = [str(each) for part in findings for each in part]  # type: ignore[attr-defined]

    parts = ("capture", "white", "black")
    fx10 = {
        part: xr.open_dataset(data / f"real_counts/specim_fx10_{part}.nc")[part]
        .transpose("sample", "wavelength", "point")
        .astype("u2")
        for part in parts
    }
    black = fx10["black"].values.astype(float)
    spread, nm = np.abs(np.diff(black, axis=0))[0] / 2.0, fx10["black"]["wavelength"].values
    gain = 1.0 / np.maximum(fx10["white"].values.mean(axis=0) - black.mean(axis=0), 1.0)
    for part in parts[:2]:
        sample = sample_cube(fx10[part], np.ones(2, bool))
        light = (sample.mean - black.mean(axis=0)).mean(axis=1)
        note(
            f"FX10 {part}", judge_dark(part, black.mean(axis=0), spread, gain, sample, 4000.0),
            judge_bands(part, light, np.ones(nm.size), nm, 5.5, None),
            judge_doubles(part, fx10[part], False, np.ones(2, bool)),
        )  # fmt: skip
    note("FX10 black", judge_dark_frames("black", fx10["black"]))
    for path in sorted((data / "dark_exposures").glob("*.nc")):
        pair = xr.open_dataset(path)
        white = xr.DataArray(pair["xps_img_wht"].values[None, :, None], dims=("line", "band", "column"))
        sample = sample_cube(white, np.ones(1, bool))
        dark = pair["xps_img_drk"].values.astype(float)[:, None]
        note(path.name, judge_dark("dark", dark, None, np.ones_like(dark), sample, 65535.0))
    for name in ("darkReference.hdr", "corn-kernel-hyperspectral.hdr", "test_image.hdr"):
        path = data / "envi_cube" / name
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PaintWarning)  # one header lacks its byte order
            cube = next(iter(open_envi(path).data_vars.values()))
        note(name, judge_layout(name, path, cube.shape[0]),
             judge_doubles(name, cube, False, np.ones(cube.shape[0], bool)))  # fmt: skip
    flox = np.genfromtxt(data / "downwelling/flox_spectra_9cycles.csv", delimiter=",", names=True)
    record = np.stack([flox["coeff_sky_channel_E"] * flox[f"E_{cycle}"] for cycle in range(9)])
    usable = np.isfinite(record).all(axis=0)
    times = np.datetime64("2016-07-29T09:13:59", "ns") + np.arange(9) * np.timedelta64(146, "s")
    sky = xr.Dataset(
        {"irradiance": (("irradiance_time", "irradiance_wavelength"), 1e-3 * record[:, usable])},
        {"irradiance_time": times, "irradiance_wavelength": flox["wavelength_nm"][usable],
         "time": ("along_track", times[1:3])},
    )  # fmt: skip
    note("FloX", judge_irradiance("FloX", sky))
    poses = open_navigation(data / "nav/ang20170323t202244_eph_att")
    rows = {str(key).replace("navigation_time", "time"): poses[key].values for key in poses.variables}
    line = xr.Dataset(coords={key: ("along_track", values) for key, values in rows.items()})
    note("AVIRIS-NG poses", judge_navigation("poses", line))
    return said


def main() -> int:
    # Print what was named and what alarmed; 1 where the promise is not kept
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=JUDGING_SEED)
    parser.add_argument("--right", type=int, default=RIGHT)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    named: Counter[str] = Counter()
    total = 0
    for fault, said in judge_wrong(given.seed, given.only).items():
        marks = [is_named(fault, texts) for texts in said]
        named[fault], total = sum(marks), total + len(marks)
        print(f"{fault:32} {sum(marks)} of {len(marks)}", flush=True)
        for strength, (mark, texts) in enumerate(zip(marks, said, strict=True)):
            if given.only or not mark:
                print(f"    strength {strength}:", *texts or ["nothing"], sep="\n        ")
    alarms = judge_right(given.seed, given.right, given.only)
    for kind, seed, texts in alarms:
        print(f"alarm: {kind}, seed {seed}:", *texts, sep="\n    ")
    data = ROOT.parents[1] / "shared" / "data"
    real = judge_real(data) if data.is_dir() and not given.only else {}
    for name, texts in real.items():
        if texts:
            alarms.append((name, 0, texts))
            print(f"alarm: {name}:", *texts, sep="\n    ")
    print(f"real files judged: {len(real)}")
    print(f"named {named.total()} of {total} wrong; alarms {len(alarms)} of {given.right + len(real)} right")
    return int(named.total() < 55 or bool(alarms))


if __name__ == "__main__":
    raise SystemExit(main())
