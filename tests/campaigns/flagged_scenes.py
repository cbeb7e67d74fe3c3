"""Flags on car parks whose light is traced: what they find, and how much of what they find is true.

    python tests/campaigns/flagged_scenes.py                 seeds 400 to 405, two minutes
    python tests/campaigns/flagged_scenes.py --seeds 7 8     others
    python tests/campaigns/flagged_scenes.py --flakes        with metallic paints, whose flakes add a lobe
    python tests/campaigns/flagged_scenes.py --mitsuba --seeds 750 751     scenes of another renderer
    python tests/campaigns/flagged_scenes.py --json made.json     the same as numbers

Scenes are those of proposed_cars.py: 256 x 320 pixels of 3.5 to 5 cm and 60 bands from 15 m, suns 20 to 50
degrees from the zenith, paints under clear coats, a signal-to-noise ratio of 100. Walls stand around the
scenes of even seeds, walls and trees around those of odd ones. True glint adds more than 4 % of what else
is seen, and 0.004 of reflectance: what matters. True shadow lacks 20 % of the direct beam or more. The flags
know of a scene the sun's place, and nothing else.

Surfaces are what most of a pixel shows; paints are coloured where their spectrum, relative to its mean,
varies by more than 0.5 beyond 430 nm, and else dark below a mean of 0.07. "Outside mixed pixels" leaves out
what is flagged as mixed itself. Clean paint is coloured, lit, and gets less than 0.003 of reflectance by way
of other things. A mixed pixel is filled to less than 95 % by one thing, or touches such a pixel.

Scenes of Mitsuba are those of the fleet benchmark (`benchmarks.fleet_scenes.foreign_cars`), with its noise,
record of irradiance, and cache. Their glint and shadow follow from rays apart from the image. Surfaces that
get less than a tenth of the direct light of level ground, without obstacles, are left out of shadows there:
they are turned away, and nothing is blocked. What other things add is not known of them.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

import hyperpaint as hp

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path[:0] = [str(ROOT), str(ROOT.parent)]

SEEDS = range(400, 406)
GLINT, GLINT_FLOOR, SHADOW = 0.04, 0.004, 0.2
CLEAN, LIT, PURE = 0.003, 0.05, 0.95
"""Reflectance by way of other things, and blocked part of the beam, below which paint is clean; share of a
pixel that one thing fills, from which on it is no mixed one."""
COLOURED, DARK, VIOLET = 0.5, 0.07, 430.0
GROUND = ("asphalt", "concrete", "line", "grass", "panel")
TURNED_AWAY = 0.1
"""Direct light of a surface, relative to level ground, below which it has no shadow."""
SURFACES = ("coloured paint", "grey, white paint", "dark paint", "glass", "ground", "other")
PAINTS = 3
"""Number of the first surfaces, which are paints."""
INNER, WHOLE = "outside mixed pixels", "with mixed pixels"

Counts = dict[str, tuple[int, int, int]]
"""What was counted: found and true, found, true."""


def surroundings_of(seed: int) -> tuple[str, ...]:
    # Return what stands around a scene
    return ("walls", "trees") if seed % 2 else ("walls",)


def surfaces_of(line: Any) -> Any:
    # Return the place in `SURFACES` of what every pixel shows (along_track, cross_track)
    from hyperpaint.simulation.rendering.materials import KINDS
    from hyperpaint.simulation.rendering.scene_spectra import spectrum_of

    kind = np.array([*KINDS, "sky"])[line["surface_class"].values]
    made = np.full(kind.shape, SURFACES.index("other"))
    made[kind == "glass"] = SURFACES.index("glass")
    made[np.isin(kind, GROUND)] = SURFACES.index("ground")
    nm = line["wavelength"].values
    names = line["paint_id"].attrs["flag_meanings"].split()
    for number in np.unique(line["paint_id"].values[kind == "paint"]):
        spectrum = spectrum_of(names[number])(nm)
        coloured = np.ptp(spectrum[nm > VIOLET]) > COLOURED * spectrum.mean()
        plain = "dark paint" if spectrum.mean() < DARK else "grey, white paint"
        shows = (kind == "paint") & (line["paint_id"].values == number)
        made[shows] = SURFACES.index("coloured paint" if coloured else plain)
    return made


def foreign_surfaces(line: Any) -> Any:
    # Return the same of a scene of Mitsuba
    kinds = {"red": "coloured paint", "blue": "coloured paint", "black": "dark paint"}
    paints = [kinds.get(name.split()[0], "grey, white paint") for name in json.loads(line.attrs["paints"])]
    numbers = np.array([SURFACES.index(kind) for kind in paints])
    other = np.where(line["instance"].values > 0, SURFACES.index("glass"), SURFACES.index("ground"))
    return np.where(line["paint_id"].values >= 0, numbers[line["paint_id"].values], other)


def true_layers(line: Any, sky: Any = None) -> dict[str, Any]:
    # Return what the renderer knows of every pixel, of a line without noise
    # ``glint`` whether it matters; ``indirect`` in reflectance [1], NaN without ``sky``; ``shadow`` the
    # blocked part of the beam, ``turned`` whether the surface is turned away from the sun, ``mixed`` whether
    # a pixel is
    from scipy.ndimage import minimum_filter

    # where no ray met any light, shares of it are not numbers
    level = line["reflectance"].values.mean(axis=1, dtype=np.float64)
    glint = np.nan_to_num(line["glint_share"].values)
    indirect = np.full(level.shape, np.nan)
    if sky is not None:
        nm = line["wavelength"].values
        whole = np.interp(nm, sky.wavelength, sky.irradiance)
        # shares are of the mean radiance before the air between, which that of the reflectance is
        radiance = np.einsum("lbx,b->lx", line["reflectance"].values.astype(np.float64), whole) / nm.size
        indirect = np.nan_to_num(line["indirect_share"].values) * radiance / whole.mean()
    return {
        "glint": glint * level > np.maximum(GLINT * (1.0 - glint) * level, GLINT_FLOOR),
        "indirect": indirect,
        "shadow": line["shadow"].values,
        "turned": line["facing"].values < TURNED_AWAY if "facing" in line else np.zeros(level.shape, bool),
        "mixed": minimum_filter(line["purity"].values, 3) < PURE,
    }


def count(bits: Any, true: dict[str, Any], surface: Any) -> Counts:
    # Return what is found and true by flag, pixels and surface, of one scene
    # bits : (along_track, cross_track): ``quality`` as flagged
    # true: From `true_layers`
    # surface : (along_track, cross_track): From `surfaces_of`
    flagged = {name: (bits & int(hp.Quality[name])) > 0 for name in ("GLINT", "SHADOW", "ADJACENCY")}
    mixed = (bits & int(hp.Quality.MIXED_EDGE)) > 0
    everywhere = np.ones(bits.shape, bool)
    made = {}
    for name, is_true in (("glint", true["glint"]), ("shadow", true["shadow"] >= SHADOW)):
        found = flagged[name.upper()]
        judged = everywhere if name == "glint" else ~true["turned"]
        for pixels, counted in ((INNER, ~mixed & judged), (WHOLE, judged)):
            for number, label in enumerate(SURFACES):
                made[f"{name}, {pixels}, {label}"] = _three(found, is_true, counted & (surface == number))
            made[f"{name}, {pixels}, all paint"] = _three(found, is_true, counted & (surface < PAINTS))
            made[f"{name}, {pixels}, all"] = _three(found, is_true, counted)
    clean = (surface == SURFACES.index("coloured paint")) & (true["indirect"] < CLEAN)
    clean &= (true["shadow"] < LIT) & ~mixed
    made["adjacency on clean paint"] = _three(flagged["ADJACENCY"], clean, clean)
    made["mixed pixels"] = _three(mixed, true["mixed"], everywhere)
    made["pixels"] = _three(mixed, everywhere, everywhere)
    return made


def _three(found: Any, true: Any, where: Any) -> tuple[int, int, int]:
    return int((found & true & where).sum()), int((found & where).sum()), int((true & where).sum())


def total(counts: list[Counts]) -> Counts:
    # Return the sums over scenes
    return {name: tuple(np.sum([each[name] for each in counts], axis=0).tolist()) for name in counts[0]}


def precision_and_recall(both: int, found: int, true: int) -> tuple[float, float]:
    # Return how many of the found are true, and of the true found; NaN of none
    return both / found if found else float("nan"), both / true if true else float("nan")


def rows_of(counts: Counts) -> list[str]:
    # Return the table as lines of text
    made = [
        f"{'flag':<7} {'pixels':<21} {'surface':<18} {'precision':>9} {'recall':>7} {'found':>7} {'true':>7}"
    ]
    for name, (both, found, true) in counts.items():
        if name.count(", ") < 2 or not found + true:
            continue
        flag, pixels, surface = name.split(", ", 2)
        precision, recall = precision_and_recall(both, found, true)
        made.append(f"{flag:<7} {pixels:<21} {surface:<18} {precision:9.3f} {recall:7.3f} {found:7} {true:7}")
    both, _, clean = counts["adjacency on clean paint"]
    made.append(f"adjacency: flagged on {both / max(clean, 1):.2%} of {clean} pixels of clean coloured paint")
    precision, recall = precision_and_recall(*counts["mixed pixels"])
    _, flagged, every = counts["pixels"]
    mixed = counts["mixed pixels"][2]
    made.append(
        f"mixed_edge: flagged on {flagged / every:.0%} of all pixels, true on {mixed / every:.0%}; "
        f"precision {precision:.3f}, recall {recall:.3f}"
    )
    return made


def rendered(seed: int, flakes: bool, samples: int) -> tuple[Any, Counts]:
    # Return a scene of this project's renderer, surveyed and flagged, and what was counted
    from campaigns.proposed_cars import render, seen_with_noise

    clean, sky = render(seed, flakes, samples, surroundings_of(seed))
    line = seen_with_noise(clean, seed).chunk(along_track=64)
    light = {"diffuse": "model", "sun_zenith": sky.sun_zenith, "sun_azimuth": sky.sun_azimuth}
    bits = hp.surroundings.flag(line, **light, heading=0.0)["quality"].values
    clean.attrs |= {"sun_zenith": sky.sun_zenith, "sun_azimuth": sky.sun_azimuth}
    return clean, count(bits, true_layers(clean, sky), surfaces_of(clean))


def foreign(seed: int, cache: Path) -> tuple[Any, Counts]:
    # Return the same of a scene of Mitsuba; levels are from the noisy reflectance, whose mean is not noisy
    from benchmarks.fleet_scenes import foreign_cars, verdicts

    line = foreign_cars.line_of(seed, "clear", cache)
    seen, _, flagged = verdicts.looked_at(line)
    layers = true_layers(line.assign(reflectance=seen["reflectance"].variable))
    return line, count(flagged["quality"].values, layers, foreign_surfaces(line))


def look(seed: int, asked: argparse.Namespace) -> Counts:
    # Render, survey and flag a scene, print a row, and return what was counted
    if asked.mitsuba:
        line, counts = foreign(seed, asked.cache)
    else:
        line, counts = rendered(seed, asked.flakes, asked.samples)
    around = "Mitsuba" if asked.mitsuba else "+".join(surroundings_of(seed))
    told = f"{seed:>4} {line.attrs['sun_zenith']:>4.0f}/{line.attrs['sun_azimuth']:>4.0f} {around:<12}"
    for name in ("glint", "shadow"):
        precision, recall = precision_and_recall(*counts[f"{name}, {INNER}, all"])
        told += f"  {name} {precision:.3f} {recall:.3f}"
    print(told, flush=True)
    return counts


def main(arguments: list[str] | None = None) -> int:
    # Print the table; return 1 where a flag's precision or recall, outside mixed pixels, is below 0.95
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--flakes", action="store_true", help="metallic paints too")
    parser.add_argument("--mitsuba", action="store_true", help="scenes of Mitsuba, of the fleet benchmark")
    folder = Path(platformdirs.user_cache_dir("hyperpaint")) / "fleet"
    parser.add_argument("--cache", type=Path, default=folder, help="folder of Mitsuba's scenes")
    parser.add_argument("--samples", type=int, default=128, help="rays a pixel")
    parser.add_argument(
        "--json", type=Path, help="file that the counts of every scene, and their sums, go to"
    )
    asked = parser.parse_args(arguments)
    print("seed     sun around        precision and recall outside mixed pixels", flush=True)
    scenes = {seed: look(seed, asked) for seed in asked.seeds}
    counts = total(list(scenes.values()))
    print("\n".join(rows_of(counts)))
    if asked.json is not None:
        names = ("flakes", "mitsuba", "samples")
        made = {**{name: getattr(asked, name) for name in names}, "scenes": scenes, "all": counts}
        asked.json.write_text(json.dumps(made, indent=1))
    reached = (precision_and_recall(*counts[f"{name}, {INNER}, all"]) for name in ("glint", "shadow"))
    return int(min(value for both in reached for value in both) < 0.95)


if __name__ == "__main__":
    sys.exit(main())
