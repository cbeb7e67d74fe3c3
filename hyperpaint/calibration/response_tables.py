"""Measure the camera's response from all lamp lines of a sweep, where neither line model fits.

Every lamp line is the monochromator's line convolved with the camera's response, sampled at as many places as
columns and steps put bands beside it. In units of the width all lines are one curve; the monochromator's line
is deconvolved by least squares without negative response.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.responses import Responses

from .lab_sweep import LabSweep
from .steps import Lines, Read
from .wavelength_map import WavelengthMap


@dataclass(frozen=True)
class ShapeRules:
    """Thresholds between a line model and a table.

    Attributes
    ----------
    reach
        Half support of the table in widths; beyond lie 2e-7 of a Gaussian.
    step
        Of the table in widths.
    smoothing
        Weight of the table's second differences against the curve: keeps noise of 1e-3 from ringing where the
        monochromator is as wide as the camera's response.
    least_samples
        Least mean number of samples at a place of the curve.
    least_misfit
        Distance of curve and model, relative to the model, from which a table is used [1]: the right model
        leaves 0.0006, a slit with a tail of a tenth of its width 0.024.
    widest_light
        Width of the monochromator over the camera's from which its line hides the response [1].
    sun_zenith_deg
        Zenith angle of the sun in the daylight for which the effect is stated [degree].
    """

    reach: float = 2.0
    step: float = 0.04
    smoothing: float = 1e-4
    least_samples: float = 4.0
    least_misfit: float = 0.012
    widest_light: float = 0.7
    sun_zenith_deg: float = 48.2


SHAPE_RULES = ShapeRules()


class MeasuredShape(NamedTuple):
    """The response in units of its width.

    ``offset`` (place,): wavelength minus that of the band, over the width; ``response`` (place,), of unit
    area; ``misfit``: distance of the lamp lines from the best model, relative [1]; ``effect``: largest
    relative change of matched daylight by the model instead of the response [1]; ``is_resolved``: whether the
    light was narrow enough.
    """

    offset: Floats
    response: Floats
    misfit: float
    effect: float
    is_resolved: bool

    @property
    def is_another(self) -> bool:
        """Whether the response fits neither model."""
        return self.misfit > SHAPE_RULES.least_misfit

    def table(self, fwhm: Floats) -> tuple[Floats, Floats]:
        """Return offsets (srf_offset,) [nm], and the response of bands of widths (band,) [nm] there."""
        offset = self.offset * float(fwhm.max())
        return offset, np.stack([np.interp(offset, self.offset * w, self.response, 0.0, 0.0) for w in fwhm])


def measured_shape(
    lab: LabSweep,
    read: Read,
    lines: Lines,
    surface: WavelengthMap,
    placed: Bools,
    own: Floats,
    shape: str,
) -> MeasuredShape | None:
    """Return the response measured from the lamp lines; None where they are too few.

    ``placed`` (step, cross_track): lines that are used; ``own`` (step,): the camera's width there [nm];
    ``shape``: the best line model.
    """
    rules = SHAPE_RULES
    edges = np.arange(-rules.reach - rules.step / 2, rules.reach + rules.step, rules.step)
    # area, area times place, area times height of what falls between two edges
    sums, light, spacing, count = np.zeros((3, edges.size - 1)), [], [], 0
    for step, window in enumerate(read.windows):
        if window is None:
            continue
        used = placed[step, window.columns] & ~window.saturated
        columns = window.columns[used]
        if not columns.size:
            continue
        places, centre = window.places[used], lines.centre[step, columns][:, None]
        apart = (surface.at(centre, columns[:, None]) - surface.at(places, columns[:, None])) / own[step]
        pitch = surface.spacing(places, columns[:, None]) / own[step]
        density = window.values[used] / (lines.area[step, columns][:, None] * pitch)
        there = np.isfinite(density)
        bins = np.digitize(apart[there], edges) - 1
        inside = (bins >= 0) & (bins < edges.size - 1)
        # noise is that of light counted: the brighter a line, the more it says
        area = np.broadcast_to(lines.area[step, columns][:, None], density.shape)[there][inside]
        for row, value in zip(sums, (1.0, apart[there][inside], density[there][inside]), strict=True):
            row += np.bincount(bins[inside], area * value, row.size)
        light.append(float(lab.width[step] / own[step]))
        spacing.append(float(np.median(pitch)))
        count += int(inside.sum())
    if count < rules.least_samples * (edges.size - 1):
        return None
    offset, width = 0.5 * (edges[1:] + edges[:-1]), float(np.median(light))
    # steps and bands repeat their distances: where nothing falls, nothing is known but by its neighbours
    weight = sums[0, sums[0] > 0]
    place, seen = sums[1:, sums[0] > 0] / weight
    source = _convolution(place, offset, width, triangular=lab.triangular)
    pitch_of_all = np.array([np.median(spacing)])
    model = Responses(np.zeros(1), np.ones(1), shape, spacing=pitch_of_all).on(offset, 0)
    ideal = source @ model
    share = np.sqrt(weight)
    misfit = float(np.linalg.norm(share * (seen - ideal)) / np.linalg.norm(share * ideal))
    response = _without_light(source, seen, weight)
    return MeasuredShape(
        offset=offset,
        response=response,
        misfit=misfit,
        effect=_effect(offset, response, model, float(np.median(own))),
        is_resolved=width <= rules.widest_light,
    )


def _convolution(place: Floats, offset: Floats, width: float, *, triangular: bool) -> Floats:
    # Matrix from a response (offset,) to a curve at places (place,) through a line of a width
    apart = place[:, None] - offset
    if triangular:
        line = np.clip(1.0 - np.abs(apart) / width, 0.0, None) / width
    else:
        line = np.exp(-4.0 * np.log(2.0) * (apart / width) ** 2) * np.sqrt(4.0 * np.log(2.0) / np.pi) / width
    return np.asarray(line * SHAPE_RULES.step)


def _without_light(source: Floats, seen: Floats, weight: Floats) -> Floats:
    # Response (offset,), not negative and of unit area, whose convolution fits a curve
    from scipy.optimize import nnls

    size = source.shape[1]
    share = np.sqrt(weight / weight.mean())
    bend = np.diff(np.eye(size), 2, axis=0) * np.sqrt(SHAPE_RULES.smoothing) / SHAPE_RULES.step
    response, _ = nnls(
        np.vstack([share[:, None] * source, bend]), np.concatenate([share * seen, np.zeros(size - 2)])
    )
    return np.asarray(response / (response.sum() * SHAPE_RULES.step))


def _effect(offset: Floats, response: Floats, model: Floats, width: float) -> float:
    # Largest relative change of daylight in a band, 420 to 950 nm, by a model of its response
    nm = np.arange(380.0, 1001.0)
    mass = 1.0 / np.cos(np.radians(SHAPE_RULES.sun_zenith_deg))
    direct, diffuse = ClearSky(SHAPE_RULES.sun_zenith_deg, airmass=float(mass)).irradiance(nm)
    light = np.interp(np.arange(420.0, 950.0)[:, None] + offset * width, nm, direct + diffuse)
    return float(np.abs(light @ response / (light @ model) * model.sum() / response.sum() - 1.0).max())
