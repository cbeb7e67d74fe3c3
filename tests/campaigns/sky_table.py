"""``hyperpaint/light/sky_shapes.csv`` and ``sky_weights.csv`` from the Monte Carlo sky of ``tests/oracles``.

``PYTHONPATH=tests python -m campaigns.sky_table`` writes both in some minutes, and prints misfits. For every
sun two functions of zenith and scattering angle are sought with which, beside a uniform sky, non-negative
sums come nearest to the skies of all wavelengths (variable projection: the sums are solved for inside).
"""

from pathlib import Path
from typing import Any

import numpy as np
from oracles.scattered_sky import Air, SkyRadiance, sky_radiance
from scipy.optimize import least_squares, nnls

from hyperpaint.light import sky_functions

SUNS = (60.0, 50.0, 40.0, 25.0, 15.0, 0.0, 70.0, 76.0, 82.0, 86.0)
AEROSOLS = (0.03, 0.1, 0.25, 0.5)
WAVELENGTHS = (380.0, 450.0, 550.0, 680.0, 850.0, 1000.0)
#: How often an aerosol counts where the functions are sought: the usual one most.
SEEN = (0.03, 0.1, 0.1, 0.1, 0.1, 0.25)
ZENITH_WEIGHT = 1.5  # of the zenith, which bonnets mirror, against all the rest of the sky
STAY = 0.03  # pull of a function towards that of the sun before
FIRST = np.array([-1.49, -0.25, 0.03, -1.34, 0.46, -0.01, 0.02, -0.9, -0.09, 0.08, -3.27, 0.13, 0.05, -0.49])

Skies = dict[tuple[float, float], SkyRadiance]


def functions(coefficients: np.ndarray, sun: float, sky: SkyRadiance) -> tuple[np.ndarray, np.ndarray]:
    # Return the functions over the sky (3, zenith, azimuth) and at the zenith (3,), of unit level mean
    cosine, azimuth = np.meshgrid(sky.cosine, sky.azimuth, indexing="ij")
    turn = sky_functions.scattering_cosine(cosine, azimuth, sun)
    parts, zenith = [np.ones_like(cosine)], [1.0]
    for row in coefficients.reshape(2, 7):
        shape = np.append(row, 0.0)
        part = sky_functions.relative_radiance(shape, cosine, turn)
        mean = sky.mean(part)
        parts.append(part / mean)
        above = sky_functions.relative_radiance(shape, np.array(1.0), np.array(np.cos(np.radians(sun))))
        zenith.append(float(above) / mean)
    return np.array(parts), np.array(zenith)


def fitted(parts: np.ndarray, zenith: np.ndarray, sky: SkyRadiance) -> tuple[np.ndarray, np.ndarray]:
    # Return the shares of the functions in a sky, and the residuals, relative
    scale = np.sqrt(2.0 * sky.cosine * sky.cosine_weight / sky.azimuth.size)[:, None] / sky.relative
    rows = np.vstack([(parts * scale).reshape(3, -1).T, ZENITH_WEIGHT * zenith / sky.zenith])
    target = np.append((sky.relative * scale).ravel(), ZENITH_WEIGHT)
    shares, _ = nnls(rows, target)
    return shares, rows @ shares - target


def main(photons: int = 3000) -> None:
    folder = Path(sky_functions.__file__).parent
    before = FIRST
    shapes: dict[float, np.ndarray] = {}
    weights: dict[float, list[Any]] = {}
    for sun in SUNS:
        skies = {
            (aerosol, nm): sky_radiance(
                nm, sun, Air(aerosol=aerosol), photons=photons, zeniths=16, azimuths=16
            )
            for aerosol in AEROSOLS
            for nm in WAVELENGTHS
        }
        start = shapes[60.0] if sun == 70.0 else before

        def residuals(
            coefficients: np.ndarray, sun: float = sun, skies: Skies = skies, start: np.ndarray = start
        ) -> np.ndarray:
            both = functions(coefficients, sun, next(iter(skies.values())))
            apart = [fitted(*both, skies[aerosol, nm])[1] for aerosol in SEEN for nm in WAVELENGTHS]
            return np.concatenate([*apart, STAY * (coefficients - start)])

        before = least_squares(residuals, start, max_nfev=30).x
        shapes[sun] = before
        both = functions(before, sun, next(iter(skies.values())))
        weights[sun] = []
        for (aerosol, nm), sky in skies.items():
            shares, apart = fitted(*both, sky)
            shares /= shares.sum()
            weights[sun].append((aerosol, nm, *shares))
            if aerosol == 0.1:
                rms, above = np.linalg.norm(apart[:-1]), shares @ both[1] / sky.zenith - 1
                print(f"{sun:g} {nm:g}: rms {rms:.3f}, zenith {above:+.3f}")
    with (folder / "sky_shapes.csv").open("w", encoding="utf-8") as file:
        file.write(
            "# Coefficients of the sky functions, see sky_functions.py; from tests/campaigns/sky_table.py.\n"
        )
        file.write("sun_zenith,function,u,uu,uuu,t,tt,ttt,ut\n")
        for sun in sorted(shapes):
            for number, row in enumerate(shapes[sun].reshape(2, 7), start=1):
                file.write(f"{sun:g},{number}," + ",".join(f"{value:.5g}" for value in row) + "\n")
    with (folder / "sky_weights.csv").open("w", encoding="utf-8") as file:
        file.write(
            "# Shares of the sky functions in a clear sky's light; from tests/campaigns/sky_table.py.\n"
        )
        file.write("sun_zenith,aerosol,wavelength_nm,uniform,molecular,aureole\n")
        for sun in sorted(weights):
            for row in weights[sun]:
                file.write(f"{sun:g}," + ",".join(f"{value:.4g}" for value in row) + "\n")


if __name__ == "__main__":
    main()
