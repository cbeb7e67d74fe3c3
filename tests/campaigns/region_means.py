"""How means of regions and band ratios scatter over many collects, against what is stated of them.

Prints true over stated standard deviation of signatures: root mean square over bands, the least and the most
of one band, and of three ratios of bands. Each collect has errors of its own, drawn in plain numpy.

``python tests/campaigns/region_means.py``
"""

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any

import dask
import numpy as np

from hyperpaint import Region, Regions, extract_signatures
from hyperpaint.base.errors import PaintWarning
from hyperpaint.paints import band_ratio, covariance

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.noisy_collects import WAVELENGTH, noisy_collect, true_reflectance

PAIRS = ((564.0, 526.6), (544.2, 542.0), (568.4, 548.6))
#: Columns and lines of what is flown, and of the regions on it.
FLIGHTS = {
    (400, 20): {"400 x 20": (0, 399, 0, 19), "100 x 20": (150, 249, 0, 19), "400 x 1": (0, 399, 13, 13)},
    (1, 400): {"1 x 400": (0, 0, 0, 399)},
}
DARKS = (10, 100, 1000)


def regions(parts: dict[str, tuple[int, int, int, int]]) -> Regions:
    # Return rectangles: first and last line, first and last column
    return Regions(
        tuple(Region(name, [(x, y), (u, y), (u, v), (x, v)]) for name, (y, v, x, u) in parts.items())
    )


def drawn(darks: int, draws: int, seed: int, **options: Any) -> dict[str, np.ndarray]:
    # Return true over stated standard deviation by region: of every band, then of the ratios
    truth = true_reflectance(WAVELENGTH)
    places = [[int(np.abs(WAVELENGTH - nm).argmin()) for nm in pair] for pair in PAIRS]
    expected = np.concatenate([truth, [truth[p] / truth[q] for p, q in places]])
    errors: dict[str, list[Any]] = {}
    for number in range(draws):
        rng = np.random.default_rng([seed, darks, number])
        for size, parts in FLIGHTS.items():
            library = extract_signatures(noisy_collect(rng, *size, darks, **options), regions(parts))
            ratios = [band_ratio(library, *pair) for pair in PAIRS]
            seen = np.column_stack([library.reflectance, *(each.ratio for each in ratios)])
            own = np.sqrt(np.diagonal(covariance(library).values, axis1=1, axis2=2))
            stated = np.column_stack([own, *(each.ratio_u for each in ratios)])
            for name, value, u in zip(parts, seen, stated, strict=True):
                errors.setdefault(name, []).append((value - expected, u))
    squares = {name: np.mean(np.square(pairs), axis=0) for name, pairs in errors.items()}
    return {name: np.sqrt(true / stated) for name, (true, stated) in squares.items()}


def main() -> int:
    # Print a row a region and number of darks
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--seed", type=int, default=9200)
    given = parser.parse_args()
    warnings.simplefilter("ignore", PaintWarning)  # the light of these collects is no sky's
    print("| region (lines x columns) | darks | mean | bands | ratios |")
    print("| --- | --- | --- | --- | --- |")
    with dask.config.set(scheduler="synchronous"):
        for darks in DARKS:
            for name, ratios in drawn(darks, given.draws, given.seed).items():
                bands, pairs = ratios[: WAVELENGTH.size], ratios[WAVELENGTH.size :]
                print(
                    f"| {name} | {darks} | {np.sqrt(np.mean(bands**2)):.2f} | {bands.min():.2f} to "
                    f"{bands.max():.2f} | {', '.join(f'{each:.2f}' for each in pairs)} |",
                    flush=True,
                )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
