"""Wrong collects that are refused or named, and right ones that pass without a word.

    python tests/campaigns/judged_collects.py                60 wrong and 300 right: a quarter of an hour
    python tests/campaigns/judged_collects.py --seed 0       the collects that thresholds are set by
    python tests/campaigns/judged_collects.py --only panel   those whose name holds a word, said in full
    python tests/campaigns/judged_collects.py --files        60 wrong by their files, 200 right, checked

Twenty faults of scale, light and gain at three strengths (`support.judged_inputs`), twenty faults of files
(`support.plausible_collects`), right ones of all kinds by turns, and whatever of the real files in
`../shared/data` can be judged. Seeds 3300 (scale) and 1800 (files) were written down before any collect of
them was made; 0 to 9 are for setting thresholds. A wrong one counts as named where a finding, an error or a
warning holds the words of its fault; the factor is stored reflectance over the true one.
"""

import argparse
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.errors import PaintError, PaintWarning
from hyperpaint.workflows.collects import check_collect
from hyperpaint.workflows.pipeline import process

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(ROOT))

from support import judged_inputs, plausible_collects  # noqa: E402

DATA = ROOT.parents[1] / "shared" / "data"
SCALE_SEED, FILE_SEED = 3300, 1800
SCALE_RIGHT, FILE_RIGHT = 300, 200


class Verdict(NamedTuple):
    """Everything that is said of a collect, and the reflectance that it gives."""

    checked: list[str]
    refused: str = ""
    warned: Sequence[str] = ()
    factor: float = np.nan  #: Median of reflectance over the true one
    low: float = np.nan  #: of the band with the lowest median
    high: float = np.nan
    over_1: float = np.nan  #: Share of samples above 1.05
    kept: float = np.nan  #: Share of samples that are finite

    @property
    def texts(self) -> list[str]:
        return [*self.checked, *([self.refused] if self.refused else []), *self.warned]

    def said(self, words: str, must_refuse: bool = False) -> str:
        # Return in a word how the fault is met; with a question mark, in the wrong way
        if self.refused.startswith("crash"):
            return "crash"
        if any(re.search(words, text, re.IGNORECASE) for text in self.texts):
            return "refused" if self.refused else "used?" if must_refuse else "named"
        return ("refused?" if self.refused else "other?") if self.texts else "silent"

    def values(self) -> str:
        if self.refused or not np.isfinite(self.factor):
            return ""
        shares = f"over 1.05 {self.over_1:.0%}, kept {self.kept:.0%}"
        return f"{self.factor:.3g} (bands {self.low:.3g} to {self.high:.3g}), {shares}"


def said_of(path: Path, whole: bool = False) -> list[str]:
    # Return all findings, or the error that stops the opening; of a ``whole`` run also what process says
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PaintWarning)
        try:
            if whole:
                process(path, path.parent / "lot.zarr", reflectance="none")
                return [str(each.message) for each in caught]
            findings = [str(finding) for finding in check_collect(path)]
            messages = [str(each.message) for each in caught]
            # of the record and its files: the reader itself leaves out spectra of zeros
            return findings + [text for text in messages if re.search(r"irradiance record|\bsky", text)]
        except PaintError as error:
            return [str(error)]


def judge(path: Path, whole: bool = True) -> Verdict:
    # Return what check and, of a ``whole`` run, process say of a collect, and the scale of its reflectance
    checked = said_of(path)
    if not whole:
        return Verdict(checked)
    refused, out = "", path.parent / "out.zarr"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PaintWarning)
        try:
            process(path, out)
        except PaintError as error:
            refused = str(error)
        except Exception as error:  # is no refusal: the run goes on, and the table says so
            refused = f"crash {type(error).__name__}: {error}"
    warned = [str(each.message) for each in caught if issubclass(each.category, PaintWarning)]
    truth = path.parent / "truth.zarr"
    if refused or not truth.exists():
        return Verdict(checked, refused, warned)
    order = ("along_track", "band", "cross_track")
    found = xr.open_zarr(out, group="flightlines/raw_0")["reflectance"].transpose(*order).values
    true = xr.open_zarr(truth)["reflectance"].transpose(*order).values
    if found.shape != true.shape:
        return Verdict(checked, refused, warned)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        ratio = found / np.where(true > 0.02, true, np.nan)
        bands = np.nanmedian(ratio, axis=(0, 2))
        values = (np.nanmedian(ratio), np.nanmin(bands), np.nanmax(bands))
    shares = ((found > 1.05).mean(), np.isfinite(found).mean())
    return Verdict(checked, refused, warned, *map(float, (*values, *shares)))


def wrong_scales(seed: int, only: str = "") -> Iterator[tuple[str, list[Verdict]]]:
    # Judge every fault of scale at its three strengths
    for fault in (name for name in judged_inputs.FAULTS if only in name):
        verdicts = []
        for strength in range(3):
            with tempfile.TemporaryDirectory() as folder:
                path = judged_inputs.wrong_scale(Path(folder) / "c", fault, strength, seed)
                verdicts.append(judge(path))
        yield fault, verdicts


def right_inputs(seed: int, count: int, only: str = "") -> Iterator[tuple[str, int, Verdict]]:
    # Judge right collects of all kinds in turn, after the real ones; three of a kind are processed too
    with tempfile.TemporaryDirectory() as folder:
        real = judged_inputs.real_collects(Path(folder), DATA) if DATA.is_dir() else ()
        for number, (name, path) in enumerate(real):
            if only in name:
                yield name, number, judge(path)
    kinds = list(judged_inputs.RIGHT)
    for number in range(max(count - 6, 0)):
        kind, own = kinds[number % len(kinds)], seed + number // len(kinds)
        if only in kind:
            with tempfile.TemporaryDirectory() as folder:
                path = judged_inputs.right_input(Path(folder) / "c", kind, own)
                yield kind, own, judge(path, whole=number < 3 * len(kinds))


def judge_scales(seed: int, right: int, only: str) -> bool:
    # Print the table of faults and the alarms of right collects; return whether the promise is kept
    states: Counter[str] = Counter()
    start = time.process_time()
    for fault, verdicts in wrong_scales(seed, only):
        row = judged_inputs.FAULTS[fault]
        met = [verdict.said(row.words, k < row.refused) for k, verdict in enumerate(verdicts)]
        states.update(met)
        print(f"{fault:26} {'  '.join(f'{word:9}' for word in met)} factor {row.factors}", flush=True)
        for verdict, word in zip(verdicts, met, strict=True):
            print(f"    {word:9} {verdict.values()}")
            texts = verdict.texts if only else [text[:300].replace("\n", " ") for text in verdict.texts[:4]]
            for text in texts:
                print(f"        {text}")
    print(f"wrong, by what is said: {dict(states)}; {time.process_time() - start:.0f} s")
    refused: Counter[str] = Counter()
    warned: Counter[str] = Counter()
    judged = 0
    for kind, own, verdict in right_inputs(seed, right, only):
        judged += 1
        texts = [text for text in verdict.texts if not judged_inputs.is_true(kind, text)]
        if texts:
            (refused if verdict.refused else warned)[kind] += 1
            print(
                f"alarm: {kind}, seed {own}:",
                *(text[:400] for text in texts),
                sep="\n    ",
                flush=True,
            )
    named = states["refused"] + states["named"]
    print(
        f"named {named} of {states.total()} wrong; of {judged} right {refused.total()} refused and "
        f"{warned.total()} warned of; {time.process_time() - start:.0f} s\n{dict(refused)}\n{dict(warned)}"
    )
    return named >= 0.9 * states.total() and not refused and warned.total() <= 0.01 * judged


def judge_wrong(seed: int, only: str = "") -> dict[str, list[list[str]]]:
    # Return what is said of every fault of files at its strengths
    said: dict[str, list[list[str]]] = {}
    for fault in (name for name in plausible_collects.FAULTS if only in name):
        said[fault] = []
        for strength in range(3):
            with tempfile.TemporaryDirectory() as folder:
                path = plausible_collects.wrong_collect(Path(folder) / "c", fault, strength, seed)
                said[fault].append(said_of(path, whole=fault == "flagged pixels"))
    return said


def is_named(fault: str, texts: list[str]) -> bool:
    # Tell whether one of the texts names a fault of files
    return any(word in text for word in plausible_collects.FAULTS[fault][1] for text in texts)


def judge_right(seed: int, count: int, only: str = "") -> list[tuple[str, int, list[str]]]:
    # Return the alarms of right collects of all kinds in turn: kind, seed, what is said
    alarms = []
    kinds = list(plausible_collects.RECIPES)
    for number in range(count):
        kind, own = kinds[number % len(kinds)], seed + number // len(kinds)
        if only in kind:
            with tempfile.TemporaryDirectory() as folder:
                texts = said_of(plausible_collects.right_collect(Path(folder) / "c", kind, own))
            if texts:
                alarms.append((kind, own, texts))
    return alarms


def judge_real(data: Path) -> dict[str, list[str]]:
    # Return what is said of real files: counts and darks of two cameras, cubes, a sky record, poses
    from hyperpaint.io.envi.envi_cubes import open_envi
    from hyperpaint.io.navigation.navigation_records import open_navigation
    from hyperpaint.plausibility.judging import (
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


def judge_files(seed: int, right: int, only: str) -> bool:
    # Print what was named and what alarmed of faults of files; return whether the promise is kept
    named: Counter[str] = Counter()
    total = 0
    for fault, said in judge_wrong(seed, only).items():
        marks = [is_named(fault, texts) for texts in said]
        named[fault], total = sum(marks), total + len(marks)
        print(f"{fault:32} {sum(marks)} of {len(marks)}", flush=True)
        for strength, (mark, texts) in enumerate(zip(marks, said, strict=True)):
            if only or not mark:
                print(f"    strength {strength}:", *texts or ["nothing"], sep="\n        ")
    alarms = judge_right(seed, right, only)
    for kind, own, texts in alarms:
        print(f"alarm: {kind}, seed {own}:", *texts, sep="\n    ")
    real = judge_real(DATA) if DATA.is_dir() and not only else {}
    for name, texts in real.items():
        if texts:
            alarms.append((name, 0, texts))
            print(f"alarm: {name}:", *texts, sep="\n    ")
    print(f"real files judged: {len(real)}")
    print(f"named {named.total()} of {total} wrong; alarms {len(alarms)} of {right + len(real)} right")
    return named.total() >= 55 and not alarms


def main(arguments: list[str] | None = None) -> int:
    # Print what was named and what alarmed; 1 where the promise is not kept
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--files", action="store_true", help="faults of files instead of faults of scale")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--right", type=int)
    parser.add_argument("--only", default="")
    asked = parser.parse_args(arguments)
    run, seed, right = (
        (judge_files, FILE_SEED, FILE_RIGHT) if asked.files else (judge_scales, SCALE_SEED, SCALE_RIGHT)
    )
    seed = seed if asked.seed is None else asked.seed
    return int(not run(seed, right if asked.right is None else asked.right, asked.only))


if __name__ == "__main__":
    raise SystemExit(main())
