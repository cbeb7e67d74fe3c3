"""Simulated flights over a panel with known faults: light on it by two cosines, nothing of the chain."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

import hyperpaint as hp
from hyperpaint.simulation.collect import line_dataset
from hyperpaint.simulation.flight import PlanFlight
from hyperpaint.simulation.settings import SimulationSettings


@dataclass(frozen=True)
class Laid:
    # A panel in a scene of the plan, and what is wrong with it
    lines: tuple[int, int] = (6, 26)
    columns: tuple[int, int] = (4, 24)
    seed: int = 0  # of its texture
    reflectance: float = 0.5
    texture: float = 0.01  # spread of its brightness from pixel to pixel, 1 sigma [1]
    slope: float = 0.0  # rise of its brightness from the first to the last column [1]
    lean: tuple[float, float] = (0.0, 0.0)  # angle and azimuth of its normal [degree]
    shaded: float = 0.0  # share of its pixels without the sun, in a corner
    asphalt: float = 0.0  # share of its pixels that show 0.05 besides, from all of it to none
    directional: float = 1.0  # reflectance factor in the light of the sun, over that in the light of the sky
    level: float = 1.0  # of what the camera sees of it, as a panel that has aged

    @property
    def along(self) -> slice:
        return slice(*self.lines)

    @property
    def across(self) -> slice:
        return slice(*self.columns)

    @property
    def pattern(self) -> np.ndarray:
        # Brightness of its pixels (line, column), of mean 1 but for chance
        shape = np.ptp(self.lines), np.ptp(self.columns)
        rng = np.random.default_rng([self.seed, *shape])
        ramp = np.linspace(-0.5, 0.5, shape[1]) * self.slope
        return (1.0 + ramp) * (1.0 + self.texture * rng.standard_normal(shape))

    def first(self, share: float) -> np.ndarray:
        # Return the first of its pixels line by line (line, column)
        shape = self.pattern.shape
        return (np.arange(shape[0] * shape[1]) < round(share * shape[0] * shape[1])).reshape(shape)

    @property
    def panel(self) -> hp.Panel:
        return hp.Panel(self.along, self.across, self.reflectance)


class _OverPanels(PlanFlight):
    laid: tuple[Laid, ...] = ()

    def _element_radiance(self, line: int, surface: Any, factors: Any, mirrored: Any) -> Any:
        seen = super()._element_radiance(line, surface, factors, mirrored)
        zenith, azimuth = np.radians(self.settings.sun)
        sky = np.array([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)])
        for laid in self.laid:
            if not laid.along.start <= line < laid.along.stop:
                continue
            angle, towards = np.radians(laid.lean)
            normal = np.sin(angle) * np.sin(towards), np.sin(angle) * np.cos(towards), np.cos(angle)
            view = (1.0 + np.cos(angle)) / 2.0
            row = line - laid.along.start
            sun = np.where(laid.first(laid.shaded)[row], 0.0, max(sky @ normal, 0.0) / sky[2])
            dark = laid.first(laid.asphalt)[row]
            share = np.where(dark, np.linspace(0.0, 1.0, dark.size), 1.0)
            rho = laid.level * laid.reflectance * laid.pattern[row] * share + 0.05 * (1.0 - share)
            direct, diffuse = (
                factor * part[:, laid.across] for factor, part in zip(factors, self.incident, strict=True)
            )
            ground = 0.2 * (1.0 - view) * (direct + diffuse)
            seen[:, laid.across] = rho * (laid.directional * sun * direct + view * diffuse + ground)
        return seen


@functools.lru_cache(maxsize=8)
def _flown_over(*laid: Laid, seed: int, lines: int, **effects: Any) -> xr.Dataset:
    usual = {"lines": lines, "columns": 28, "bands": 68, "bit_depth": 14, "electrons_per_count": 5.0}
    settings = SimulationSettings.of({**usual, "seed": seed, **effects})
    flight = _OverPanels(settings)
    flight.laid = laid
    line = line_dataset(flight, flight.lines(0, settings.lines), matched=False)
    direct, diffuse = (part.mean(axis=1) for part in flight.incident)
    return line.assign_attrs(diffuse_of_the_sky=(diffuse / (direct + diffuse)).tolist())


def flown_over(*laid: Laid, seed: int, lines: int = 32, saturated: float = 0.0, **effects: Any) -> xr.Dataset:
    # Return a line over panels; of the first the share ``saturated`` of pixels is, by a lower converter
    line = _flown_over(*laid, seed=seed, lines=lines, **effects).copy()
    if saturated:
        counts = line.counts.values[laid[0].along, :, laid[0].across]
        full = np.floor(np.quantile(counts.max(axis=1), 1.0 - saturated)) + 16.0
        line["counts"] = line.counts.copy(data=np.minimum(line.counts.values, full).astype(line.counts.dtype))
        line["saturation_count"] = line.saturation_count.copy(data=np.float32(full))
    return line
