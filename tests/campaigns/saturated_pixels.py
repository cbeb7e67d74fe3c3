"""Saturated pixels of traced cars: how many the flag finds, and how many of those it names are.

    python tests/campaigns/saturated_pixels.py                  four scenes of seeds 300 to 303, two minutes
    python tests/campaigns/saturated_pixels.py --seeds 0 1      others

Scenes: metallic and solid cars under clear coats that mirror the sun, 160 x 200 pixels of 6 cm and 60 bands,
at three exposures, the longest of which clips a good part of the car park. A camera of 16 bits whose noise is
that of the one of 12 bits, sample by sample, tells what the counts would have been without the converter's
end.

What is true of a pixel, with c the largest of its counts before they are clipped, noise and dark included,
and full = 4095:

* clipped: c >= full - 0.5, so that the converter lost something. What must never be missed.
* margin: c >= full - 16 - 0.5, the flag's promise: a converter is not trusted within 16 counts of its end.
* bright: the same as clipped for counts without noise, which no flag can know.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

import hyperpaint as hp

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(ROOT))

BITS, MARGIN = 12, 16.0
TRUTHS = ("clipped", "margin", "bright")
EXPOSURES = (0.003, 0.006, 0.012)


def trace_scene(seed: int, lines: int = 160, columns: int = 200, samples: int = 24) -> tuple[Any, Any, Any]:
    # Return radiance of glossy and metallic cars in the sun, the flight, and the light
    from hyperpaint.simulation.atmosphere import Atmosphere
    from hyperpaint.simulation.rendering.car_parks import car_park
    from hyperpaint.simulation.rendering.platforms import pushbroom

    rng = np.random.default_rng([seed, 4095])
    sky = Atmosphere.clear(float(rng.uniform(20, 50)), float(rng.uniform(90, 270)))
    gsd = 0.06
    park = car_park(length=lines * gsd + 4, width=24.0, seed=seed, neighbours=(), margin=6.0, flakes=True)
    flight = pushbroom(
        lines, columns, ground_sample=gsd, line_spacing=gsd, start=(0.0, 2.0), exposure_time=0.004
    )
    return hp.simulation.trace(park, flight, [sky], samples=samples, seed=seed).compute(), flight, sky


def exposed(traced: Any, sky: Any, exposure: float, seed: int, bands: int = 60) -> tuple[Any, dict[str, Any]]:
    # Return the flight line of a 12-bit camera, and what is true of its pixels
    import hyperpaint as hp
    from hyperpaint.simulation.camera import BandSet, Camera
    from hyperpaint.simulation.settings import SimulationSettings
    from hyperpaint.workflows.rendering import counts_of

    settings = {"bands": bands, "columns": traced.sizes["cross_track"], "seed": seed, "smile_nm": 0.0}
    camera, whole = (Camera.of(SimulationSettings(**settings, bit_depth=bits)) for bits in (BITS, 16))
    relit = hp.simulation.relight(traced, BandSet.of(camera.imager), atmosphere=sky, truth=False)
    light = relit["radiance"].chunk(along_track=32)
    line = counts_of(light, camera, exposure, seed, "noon").compute()
    unclipped, noiseless = (
        counts_of(light, whole, exposure, seed, "noon", noise=noise)["counts"]
        .max("band")
        .values.astype(float)
        for noise in (True, False)
    )
    full = 2.0**BITS - 1
    true = {
        "clipped": unclipped >= full - 0.5,
        "margin": unclipped >= full - MARGIN - 0.5,
        "bright": noiseless >= full - 0.5,
    }
    coords = {"wavelength": ("band", camera.imager.wavelength, {"units": "nm"})}
    return line.assign_coords(coords).assign_attrs(srf_shape="gaussian"), true


def found_in(line: Any) -> Any:
    # Return which pixels the chain flags as saturated (along_track, cross_track)
    return (hp.radiance(line)["quality"].values & int(hp.Quality.SATURATED)) > 0


def recall_and_precision(found: Any, true: Any) -> tuple[float, float]:
    # Return how many of the true pixels are found, and how many of the found are true; 1 of none
    both = float((found & true).sum())
    return both / max(int(true.sum()), 1), both / max(int(found.sum()), 1)


def main(arguments: list[str] | None = None) -> int:
    # Print the table; return 1 for a missed clipped pixel, or 1 in 100 flags outside the margin
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(300, 304)))
    asked = parser.parse_args(arguments)
    heads = "  ".join(f"{name + ' R':>9} {'P':>7}" for name in TRUTHS)
    print(f"{'seed':>4} {'ms':>4} {'flagged':>8}  {heads}")
    failed = False
    masks: dict[str, list[Any]] = {name: [] for name in ("found", *TRUTHS)}
    for seed in asked.seeds:
        traced, _, sky = trace_scene(seed)
        for exposure in EXPOSURES:
            line, true = exposed(traced, sky, exposure, seed)
            found = found_in(line)
            scores = {name: recall_and_precision(found, true[name]) for name in TRUTHS}
            row = "  ".join(f"{recall:9.4f} {precision:7.4f}" for recall, precision in scores.values())
            print(f"{seed:>4} {1e3 * exposure:>4.0f} {int(found.sum()):>8}  {row}", flush=True)
            for name, mask in {"found": found, **true}.items():
                masks[name].append(mask)
    every = {name: np.concatenate([mask.ravel() for mask in of]) for name, of in masks.items()}
    for name in TRUTHS:
        recall, precision = recall_and_precision(every["found"], every[name])
        print(f"all, {name}: {int(every[name].sum())} pixels, recall {recall:.4f}, precision {precision:.4f}")
        failed |= name != "bright" and recall < 1.0
        failed |= name == "margin" and precision < 0.99
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
