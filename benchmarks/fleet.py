"""Signatures of the cars that exist, judged through the product: right, wrong or refused.

    python benchmarks/fleet.py --seeds tune              scenes that rules may be tuned on
    python benchmarks/fleet.py --seeds judge             others: run once, at the end, and never looked into
    python benchmarks/fleet.py --seeds tune --source mitsuba
    python benchmarks/fleet.py --seeds tune --rows --json results.json

Scenes: car parks of the real fleet under hyperpaint's own renderer, each under a clear and a second sky
(hazy, broken, overcast), suns 15 to 76 degrees from the zenith; and car parks of other bodies, paints and
skies under Mitsuba. Noisy radiance and a record of irradiance become reflectance, this is surveyed, regions
are proposed and signatures extracted, all with the defaults of the product.

A signature is right where its shape is right after one factor, and its level (`fleet_scenes.verdicts` has
the tolerances); wrong, too, where a paint with flakes is stated to be solid. Of paints with flakes the truth
is the reflectance factor at the geometry of the line; of solid ones what the panel reflects near-normally.
The intervals of shares are Wilson's, 95 %; covered are levels within the 95 % interval that is stated.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `benchmarks` is then not importable yet
    sys.path.insert(0, str(ROOT))

from benchmarks.fleet_scenes import foreign_cars, rendered_cars  # noqa: E402
from benchmarks.fleet_scenes.verdicts import NORMAL_95, Verdict, judged  # noqa: E402

# Apart, and written down before anything was tuned; 710-719, 810-819 and 854-855 before any of them was run.
TUNE = {"hyperpaint": range(700, 720), "mitsuba": range(750, 754)}
JUDGE = {"hyperpaint": range(800, 820), "mitsuba": range(850, 856)}
SCENES: dict[str, Any] = {"hyperpaint": rendered_cars, "mitsuba": foreign_cars}
LOW_SUN_DEG = 60.0


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (E. B. Wilson, J. Am. Stat. Assoc. 22, 209, 1927)."""
    if not total:
        return 0.0, 1.0
    share, square = count / total, NORMAL_95**2
    middle = (share + square / (2 * total)) / (1 + square / total)
    half = NORMAL_95 * np.sqrt(share * (1 - share) / total + square / (4 * total**2)) / (1 + square / total)
    return float(max(middle - half, 0.0)), float(min(middle + half, 1.0))


def verdicts_of(seeds: dict[str, Any], sources: Sequence[str], cache: Path) -> list[Verdict]:
    """Return the verdicts on all scenes, with a bar on stderr."""
    from hyperpaint.base.progress_reports import as_progress

    report = as_progress(True, "fleet")
    jobs = [
        (SCENES[source], seed, sky)
        for source in sources
        for seed in seeds[source]
        for sky in SCENES[source].skies_of(seed)
    ]
    verdicts: list[Verdict] = []
    for done, (scenes, seed, sky) in enumerate(jobs, start=1):
        verdicts += judged(scenes.line_of(seed, sky, cache), scenes.truth_of)
        report(done, len(jobs))
    return verdicts


Choice = Callable[[Verdict], bool]


def groups() -> dict[str, Choice]:
    """Return the groups of the table, by name; the first ones have a goal."""
    sun = {
        "sun 15-60": lambda one: one.sun_zenith <= LOW_SUN_DEG,
        "sun 66-76": lambda one: one.sun_zenith > LOW_SUN_DEG,
    }
    high = sun["sun 15-60"]
    chosen: dict[str, Choice] = {
        "solid, clear, sun 15-60": lambda one: one.finish == "solid" and one.sky == "clear" and high(one),
        "all finishes, not overcast, sun 15-60": lambda one: one.sky != "overcast" and high(one),
        "sun 66-76, not overcast": lambda one: one.sky != "overcast" and not high(one),
        "overcast": lambda one: one.sky == "overcast",
    }
    for name, values in {
        "sky": ("clear", "hazy", "broken", "overcast"),
        "finish": ("solid", "metallic", "pearl"),
        "colour": (*rendered_cars.PLAIN, "coloured"),
    }.items():
        for value in values:
            chosen[f"{name} {value}"] = lambda one, name=name, value=value: getattr(one, name) == value
    return chosen | {"all": lambda one: bool(one.car)}


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """Return the table as lines of text, one part for each renderer."""
    lines = []
    for source in dict.fromkeys(one.source for one in verdicts):
        own = [one for one in verdicts if one.source == source]
        cars = [one for one in own if one.car]
        shares = f"{'cars':>5} {'right':>6} {'wrong':>6} {'refused':>8}"
        lines.append(f"{source:<38} {shares}  right, 95 %    wrong, 95 %    covered")
        for name, choice in groups().items():
            lines += _row(name, [one for one in per_car(cars) if choice(one)])
        strays = Counter(one.result for one in own if not one.car)
        lines.append(f"elsewhere, on parts of cars: {strays['right']} right, {strays['wrong']} wrong")
    return lines


def per_car(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Return one verdict a car: wrong where one of its regions is, refused where none is left."""
    worst = ("wrong", "right", "refused")
    best: dict[tuple[Any, ...], Verdict] = {}
    for one in verdicts:
        key = one.source, one.seed, one.sky, one.car
        if key not in best or worst.index(one.result) < worst.index(best[key].result):
            best[key] = one
    return list(best.values())


def _row(name: str, cars: Sequence[Verdict]) -> list[str]:
    if not cars:
        return []
    counts = Counter(one.result for one in cars)
    total = len(cars)
    intervals = "  ".join(
        "{:5.1%}..{:6.1%}".format(*wilson(counts[word], total)) for word in ("right", "wrong")
    )
    stated = [one.is_covered for one in cars if one.is_covered is not None]
    covered = f"{sum(stated)}/{len(stated)}" if stated else "nothing stated"
    shares = f"{counts['right'] / total:6.1%} {counts['wrong'] / total:6.1%} {counts['refused'] / total:8.1%}"
    return [f"{name:<38} {total:>5} {shares}  {intervals}  {covered}"]


def rows(verdicts: Sequence[Verdict]) -> list[str]:
    """Return a line of text for every verdict."""
    return [
        f"{one.seed} {one.sky:<8} {one.sun_zenith:4.0f} {one.car or 'elsewhere':<9} {one.colour:<8} "
        f"{one.finish:<8} {one.stated_finish:<8} {one.kind:<10} {one.true_level:6.3f} {one.level:6.3f} "
        f"{one.shape:7.4f} {one.result:<7} {one.told:.140}"
        for one in verdicts
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; return 1 where a car's signature is wrong."""
    import platformdirs

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", choices=("tune", "judge"), default="tune")
    parser.add_argument("--source", choices=("hyperpaint", "mitsuba", "both"), default="both")
    parser.add_argument("--only", type=int, nargs="+", help="some of the seeds")
    parser.add_argument(
        "--cache", type=Path, default=Path(platformdirs.user_cache_dir("hyperpaint")) / "fleet"
    )
    parser.add_argument("--rows", action="store_true", help="a line for every car, too")
    parser.add_argument("--json", type=Path, help="file for the verdicts")
    asked = parser.parse_args(arguments)
    asked.cache.mkdir(parents=True, exist_ok=True)
    seeds: dict[str, Any] = dict(TUNE if asked.seeds == "tune" else JUDGE)
    if asked.only:
        seeds = {source: [seed for seed in own if seed in asked.only] for source, own in seeds.items()}
    sources = ("hyperpaint", "mitsuba") if asked.source == "both" else (asked.source,)
    verdicts = verdicts_of(seeds, sources, asked.cache)
    print("\n".join([*(rows(verdicts) if asked.rows else []), *table(verdicts)]))
    if asked.json is not None:
        asked.json.write_text(json.dumps([asdict(one) for one in verdicts], indent=1))
    return int(any(one.result == "wrong" for one in verdicts))


if __name__ == "__main__":
    sys.exit(main())
