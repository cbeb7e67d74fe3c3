"""Noise of traced pixels from seed to seed, by light and surface: rows for a table.

``python tests/campaigns/traced_noise.py`` renders a car park eight times under each light at 64 samples, and
prints the relative standard deviation of a pixel, mean over four bands: median over all pixels of a class,
and over those that see one thing alone.
"""

import numpy as np

from hyperpaint.simulation import relight, trace
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import KINDS
from hyperpaint.simulation.rendering.platforms import pushbroom

SAMPLES, SEEDS = 64, 8


def noise(sky: str) -> dict[str, tuple[float, float]]:
    # Return the noise under a light by class: median over all pixels, and over pure ones
    park = car_park(seed=1)
    flight = pushbroom(24, 200, altitude=40.0, ground_sample=0.06, line_spacing=0.25)
    bands = BandSet(np.array([450.0, 550.0, 650.0, 850.0]), np.full(4, 6.0))
    seen = []
    for seed in range(SEEDS):
        traced = trace(park, flight, [sky], samples=SAMPLES, seed=seed).compute()
        seen.append(relight(traced, bands, atmosphere=sky, truth=False).radiance.values)
    spread = (np.std(seen, axis=0, ddof=1) / np.mean(seen, axis=0)).mean(axis=1)
    surface, pure = traced.surface_class.values, traced.purity.values == 1.0
    shares = {}
    for kind in ("asphalt", "paint"):
        there = surface == KINDS.index(kind)
        shares[kind] = float(np.median(spread[there])), float(np.median(spread[there & pure]))
    return shares


def main() -> None:
    print("| light | surface | noise | of pure pixels |\n| --- | --- | --- | --- |")
    for sky in ("cloudy", "noon"):
        for kind, (every, pure) in noise(sky).items():
            print(f"| {sky} | {kind} | {100 * every:.2f} % | {100 * pure:.2f} % |")


if __name__ == "__main__":
    main()
