r"""What skies there may be over a spectrometer, and how well each explains a spectrum of irradiance.

Skies are drawn once, always the same: states of clear air, and clouds of four kinds over them. With direct
light D and diffuse light S of the clear air, and a cloud's tint t,

.. math:: E = a D + b S + e D + c \, t (D + S), \qquad f_{dif} = 1 - a D / E

clear or hazy: a = b = 1; thin cloud: what the beam loses comes back in part as diffuse light e D; broken: the
sun is seen, hidden or behind an edge, clouds of the cover c take the place of blue sky; overcast: c alone.
All in arrays, of draws and wavelengths; labels are those of `diffuse_record`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats, Ints

from .clear_sky import ClearSky
from .sun import Scatterers, scattered_light

KINDS = ("air", "thin", "broken", "overcast")
"""Kinds of sky that are drawn: no cloud, thin cloud before the sun, broken cloud, overcast."""


@dataclass(frozen=True)
class SkyRules:
    """What is expected of skies and of receivers before a spectrum is seen.

    Attributes
    ----------
    window_nm
        Centres of the intervals that are compared [nm]: between the bands of oxygen and water.
    half_width_nm
        Of the intervals [nm]: wide enough for lines of the sun to be alike for all spectrometers.
    shape_u
        Relative standard uncertainty of an interval by itself [1]: noise, sunlight, the model's bands.
    colour_u, colour_nm
        That of slow changes over the spectrum [1], and their length [nm]: a lamp's and a receiver's, and what
        SPECTRL2 leaves against other models (tests: 2 to 3 %).
    wide_u, wide_prior
        Relative standard uncertainty of the level where a receiver is not what it says [1], and how often
        that is. A light sensor as it comes is wrong by a quarter (MicaSense's, as their tutorial has it).
    aerosol, aerosol_spread
        Median of the optical depth at 500 nm, and spread of its logarithm (AERONET, continental sites).
    hazy_aerosol
        Optical depth from which clear air is called hazy [1].
    priors
        Of `KINDS`.
    calm, restless
        Relative standard deviation of the level over `window_s` below which, and above which, each of
        `KINDS` is unlikely [1]: cirrus drifts by a per cent in a minute, broken cloud takes the sun and gives
        it back.
    calm_spread, restless_spread
        Spread of its logarithm beyond them.
    window_s
        Seconds to both sides in which light is compared with itself: clouds pass in seconds to a minute.
    wrong_clock
        How often a clock, or a place, is wrong, so that the sun stands elsewhere [1].
    other_sun_deg
        Distance of that sun in zenith angle, at least [degree]: nearer ones are hardly told apart.
    misfit
        Chi-square per interval of the best draw beyond which no sky explains a spectrum.
    decided
        Probability that a state needs to be named [1].
    floor, model
        Standard uncertainty of a diffuse fraction that no record removes: alone, and times f (1 - f) [1].
    """

    window_nm: tuple[float, ...] = (
        415.0, 445.0, 475.0, 500.0, 525.0, 550.0, 575.0, 615.0, 640.0, 670.0, 708.0, 748.0, 778.0, 865.0,
        882.0, 1005.0,
    )  # fmt: skip
    half_width_nm: float = 8.0
    shape_u: float = 0.015
    colour_u: float = 0.03
    colour_nm: float = 200.0
    wide_u: float = 0.2
    wide_prior: float = 0.08
    aerosol: float = 0.12
    aerosol_spread: float = 0.9
    hazy_aerosol: float = 0.25
    priors: tuple[float, ...] = (0.43, 0.12, 0.20, 0.25)
    calm: tuple[float, ...] = (0.0, 0.004, 0.06, 0.0)
    restless: tuple[float, ...] = (0.01, 0.03, np.inf, 0.05)
    calm_spread: tuple[float, ...] = (1.0, 0.8, 0.5, 1.0)
    restless_spread: float = 0.5
    window_s: float = 90.0
    wrong_clock: float = 0.02
    other_sun_deg: float = 7.0
    misfit: float = 4.0
    decided: float = 0.5
    floor: float = 0.008
    model: float = 0.10


RULES = SkyRules()

_AIRS = 512
"""States of the air; clouds are drawn over each."""
_REPEATS = {"air": 1, "thin": 2, "broken": 4, "overcast": 2}
_NODES_NM = np.array(
    [300.0, 350, 380, 410, 450, 500, 550, 600, 650, 700, 760, 830, 900, 1000, 1200, 1600, 2500]
)
_LOWEST = 88.0  # degree: where the sun stands lower, it is not told what the light is
_POINTS = 5  # wavelengths of an interval at which the model is asked


class _Draws(NamedTuple):
    kind: Ints  # (draw,) number of `KINDS`
    air: Ints  # (draw,) which state of the air
    beam: Floats  # (draw,) a
    blue: Floats  # b
    returned: Floats  # e
    cloud: Floats  # c
    tint: Floats  # of the cloud: share that goes with the fourth power of the wavelength
    states: Floats  # (parameter, air): aerosol, exponent, ozone, relative pressure, ground, water


@functools.cache
def _draws() -> _Draws:
    """Return the skies that are compared: the same ones in every run."""
    rng = np.random.default_rng(19_590)
    # one stratum for each draw, so that a few hundred fill the range
    strata = (np.argsort(rng.random((6, _AIRS)), axis=1) + rng.random((6, _AIRS))) / _AIRS
    from scipy.special import ndtri

    normal = ndtri(strata)
    states = np.stack(
        [
            np.clip(RULES.aerosol * np.exp(RULES.aerosol_spread * normal[0]), 0.01, 1.2),
            np.clip(1.2 + 0.35 * normal[1], 0.2, 2.2),
            np.clip(0.31 + 0.03 * normal[2], 0.2, 0.45),
            np.exp(0.01 * normal[3]),
            np.clip(0.2 + 0.08 * normal[4], 0.03, 0.6),
            0.2 + 2.5 * strata[5],
        ]
    )
    parts = []
    for number, name in enumerate(KINDS):
        count = _AIRS * _REPEATS[name]
        u = rng.random((5, count))
        ones, none = np.ones(count), np.zeros(count)
        tint = 0.3 * u[0]
        if name == "air":
            amounts = ones, ones, none, none
        elif name == "thin":
            beam = 0.25 + 0.7 * u[1]
            amounts = beam, 1.0 - 0.3 * (1.0 - beam) * u[3], (1.0 - beam) * (0.3 + 0.6 * u[2]), none
        elif name == "broken":
            cover = 0.1 + 0.85 * u[2]
            # in 45 of 100 the sun is free, in 35 hidden, else behind an edge
            beam = np.where(u[1] < 0.45, 1.0, np.where(u[1] < 0.8, 0.1 * u[4], u[4]))
            amounts = beam, 1.0 - cover, none, cover * (0.15 + 0.4 * u[3])
        else:
            amounts = none, none, none, np.exp(np.log(0.03) + u[1] * np.log(0.75 / 0.03))
        air = np.tile(np.arange(_AIRS), _REPEATS[name])
        parts.append((np.full(count, number), air, *amounts, tint))
    kind, own, beam, blue, returned, cloud, tint = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Draws(kind, own, beam, blue, returned, cloud, tint, states)


class Windows(NamedTuple):
    """Intervals of the spectrum that a spectrometer covers."""

    centre: Floats  # (window,) [nm]
    operator: Floats  # (window, channel): means over channels


def windows_in(wavelength: Floats) -> Windows:
    """Return the intervals that channels (channel,) [nm], in any order, cover."""
    rows, centres = [], []
    for centre in RULES.window_nm:
        inside = np.abs(wavelength - centre) <= RULES.half_width_nm
        reach = wavelength.size and wavelength.min() <= centre - 2.0 and centre + 2.0 <= wavelength.max()
        if reach and inside.any():
            rows.append(inside / inside.sum())
            centres.append(centre)
    return Windows(np.array(centres), np.array(rows).reshape(len(rows), wavelength.size))


class _Spectra(NamedTuple):
    level: Floats  # (draw, window): logarithm of the irradiance
    fraction: Floats  # (draw, node): diffuse fraction
    clear: Floats  # (draw, node): diffuse fraction of the clear air itself


def _mixed(draws: _Draws, nm: Floats, direct: Floats, diffuse: Floats) -> tuple[Floats, Floats]:
    """Return irradiance and its diffuse fraction of all draws (draw, wavelength)."""
    beam, blue, returned, cloud, tint = (each[:, None] for each in draws[2:7])
    direct, diffuse = direct[draws.air], diffuse[draws.air]
    colour = 1.0 - tint + tint * (nm / 490.0) ** -4.0
    scattered = blue * diffuse + returned * direct + cloud * colour * (direct + diffuse)
    whole = beam * direct + scattered
    return whole, scattered / whole


def _points_of(centres: tuple[float, ...]) -> Floats:
    """Return the wavelengths at which the model is asked of intervals, some for each [nm]."""
    steps = np.linspace(-RULES.half_width_nm, RULES.half_width_nm, 2 * _POINTS + 1)[1::2]
    return np.asarray((np.array(centres)[:, None] + steps).ravel())


@functools.lru_cache(maxsize=64)
def _spectra(sun_zenith: float, pressure: float, centres: tuple[float, ...]) -> _Spectra:
    """Return what all draws send down under a sun at one zenith angle [degree]."""
    draws = _draws()
    aerosol, exponent, ozone, relative, ground, water = (each[:, None] for each in draws.states)
    at = np.array(centres)
    points = _points_of(centres)
    sky = ClearSky(
        sun_zenith, aerosol, exponent, ozone=ozone, water=water, pressure=pressure * relative, ground=ground
    )
    shape = (_AIRS, at.size, _POINTS)
    direct, diffuse = (part.reshape(shape).mean(axis=2) for part in sky.irradiance(points))
    whole, _ = _mixed(draws, at, direct, diffuse)
    air = Scatterers(aerosol, exponent, pressure * relative, ground)
    # gases take of both parts alike
    direct, diffuse = scattered_light(_NODES_NM, sun_zenith, air)
    _, fraction = _mixed(draws, _NODES_NM, direct, diffuse)
    clear = (diffuse / (direct + diffuse))[draws.air]
    return _Spectra(np.log(whole), fraction, clear)


@functools.lru_cache(maxsize=16)
def _whitening(centres: tuple[float, ...], level_u: float) -> tuple[Floats, float]:
    """Return what makes misfits of intervals independent, of unit size, and half the log determinant."""
    at = np.array(centres)
    covariance = RULES.shape_u**2 * np.eye(at.size) + level_u**2
    covariance += RULES.colour_u**2 * np.exp(-0.5 * ((at[:, None] - at) / RULES.colour_nm) ** 2)
    lower = np.linalg.cholesky(covariance)
    return np.linalg.inv(lower), float(np.log(np.diag(lower)).sum())


class Evidence(NamedTuple):
    """What is known of the samples of a record."""

    level: Floats  # (sample, window): logarithm of the irradiance [W m-2 nm-1]
    sun_zenith: Floats  # (sample,) [degree]
    seconds: Floats  # (sample,) since the first
    level_u: float  # relative standard uncertainty of the level


class Explained(NamedTuple):
    """Diffuse fraction and state of the sky of every sample."""

    fraction: Floats  # (sample, node)
    u: Floats  # (sample, node)
    probability: Floats  # (sample, state): clear, hazy, broken, overcast, contradictory
    cloud: Floats  # (sample,): how far the fraction is from that of clear air to 1
    nodes: Floats  # (node,) [nm]


class _Weighed(NamedTuple):
    """What each kind of sky says of each sample, for both widths of the level (sample, width, kind ...)."""

    log: Floats  # logarithm of the evidence
    mean: Floats  # (..., node) of the diffuse fraction
    square: Floats  # (..., node) of its square
    clear: Floats  # (..., node) of the fraction without clouds
    turbid: Floats  # probability that the air is hazy
    best: Floats  # (sample,): chi-square per interval of the best draw


def _weighed(evidence: Evidence, windows: Windows, pressure: float) -> _Weighed:
    draws, centres = _draws(), tuple(map(float, windows.centre))
    shape = evidence.level.shape[0], 2, len(KINDS)
    log, turbid = np.zeros(shape), np.zeros(shape)
    mean, square, clear = (np.zeros((*shape, _NODES_NM.size)) for _ in range(3))
    best = np.full(shape[0], np.inf)
    is_hazy = (draws.states[0][draws.air] >= RULES.hazy_aerosol).astype(np.float64)
    kinds = [np.flatnonzero(draws.kind == number) for number in range(len(KINDS))]
    sun = np.minimum(evidence.sun_zenith, _LOWEST)
    node_zenith = np.round(2.0 * sun) / 2.0
    for zenith in np.unique(node_zenith):
        spectra = _spectra(float(zenith), pressure, centres)
        for part in np.array_split(here := np.flatnonzero(node_zenith == zenith), 1 + here.size // 128):
            # the sun moves on between the nodes
            turn = np.cos(np.radians(sun[part])) / np.cos(np.radians(zenith))
            seen = evidence.level[part] - np.log(turn)[:, None]
            for width, level_u in enumerate((evidence.level_u, np.hypot(evidence.level_u, RULES.wide_u))):
                white, size = _whitening(centres, float(level_u))
                ours, theirs = seen @ white.T, spectra.level @ white.T
                chi = (ours**2).sum(axis=1)[:, None] + (theirs**2).sum(axis=1) - 2.0 * ours @ theirs.T
                if width == 0:
                    best[part] = chi.min(axis=1) / len(centres)
                chi /= np.maximum(1.0, best[part] / RULES.misfit)[:, None]
                for number, own in enumerate(kinds):
                    least = chi[:, own].min(axis=1)
                    weight = np.exp(-0.5 * (chi[:, own] - least[:, None]))
                    total = weight.sum(axis=1)
                    log[part, width, number] = np.log(total / own.size) - 0.5 * least - size
                    weight /= total[:, None]
                    mean[part, width, number] = weight @ spectra.fraction[own]
                    square[part, width, number] = weight @ spectra.fraction[own] ** 2
                    clear[part, width, number] = weight @ spectra.clear[own]
                    turbid[part, width, number] = weight @ is_hazy[own]
    return _Weighed(log, mean, square, clear, turbid, best)


class _Elsewhere(NamedTuple):
    """What clear air says of each sample under a sun that the clock has elsewhere (sample, ...)."""

    log: Floats  # logarithm of the evidence
    mean: Floats  # (sample, node) of the diffuse fraction
    square: Floats  # (sample, node) of its square


_OTHER_SUNS_DEG = np.arange(5.0, 85.1, 2.5)


@functools.lru_cache(maxsize=64)
def _clear_air(sun_zenith: float, pressure: float, centres: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return level (air, window) and diffuse fraction (air, node) of every fourth state of clear air."""
    aerosol, exponent, ozone, relative, ground, water = (each[::4, None] for each in _draws().states)
    air = Scatterers(aerosol, exponent, pressure * relative, ground)
    sky = ClearSky(
        sun_zenith, aerosol, exponent, ozone=ozone, water=water, pressure=pressure * relative, ground=ground
    )
    direct, diffuse = scattered_light(_NODES_NM, sun_zenith, air)
    whole = np.sum(sky.irradiance(_points_of(centres)), axis=0)
    whole = whole.reshape(aerosol.size, len(centres), -1).mean(axis=2)
    return np.log(whole), diffuse / (direct + diffuse)


def _elsewhere(evidence: Evidence, windows: Windows, pressure: float) -> _Elsewhere:
    centres = tuple(map(float, windows.centre))
    white, size = _whitening(centres, float(evidence.level_u))
    ours = evidence.level @ white.T
    shape = evidence.level.shape[0], _OTHER_SUNS_DEG.size
    log, mean, square = np.empty(shape), *np.empty((2, *shape, _NODES_NM.size))
    for number, zenith in enumerate(_OTHER_SUNS_DEG):
        level, fraction = _clear_air(float(zenith), pressure, centres)
        theirs = level @ white.T
        chi = (ours**2).sum(axis=1)[:, None] + (theirs**2).sum(axis=1) - 2.0 * ours @ theirs.T
        least = chi.min(axis=1)
        weight = np.exp(-0.5 * (chi - least[:, None]))
        total = weight.sum(axis=1)
        log[:, number] = np.log(total / len(theirs)) - 0.5 * least - size
        mean[:, number] = weight @ fraction / total[:, None]
        square[:, number] = weight @ fraction**2 / total[:, None]
    log[np.abs(_OTHER_SUNS_DEG - evidence.sun_zenith[:, None]) < RULES.other_sun_deg] = -np.inf
    most = log.max(axis=1)
    share = np.exp(log - most[:, None])
    total = share.sum(axis=1)
    share = (share / total[:, None])[..., None]
    return _Elsewhere(
        most + np.log(total / _OTHER_SUNS_DEG.size), (share * mean).sum(axis=1), (share * square).sum(axis=1)
    )


def explain(evidence: Evidence, windows: Windows, pressure: float) -> Explained:
    r"""Return what the skies drawn say of a record, each weighted by how well it explains a sample.

    Notes
    -----
    Misfits of the logarithm are Gaussian, with the covariance of a level that is common to all wavelengths,
    of slow colour and of single intervals; the level is `Evidence.level_u` or, with a small prior, `wide_u`.
    The evidence of a kind of sky is averaged over `window_s` and weighted by how much the level varies in it;
    where even the best draw does not fit, all misfits are divided until it does, which leaves a wide answer.
    What a clear sky under a sun elsewhere explains better contradicts the clock.
    """
    weighed = _weighed(evidence, windows, pressure)
    prior = np.log(np.array([[1.0 - RULES.wide_prior], [RULES.wide_prior]]) * np.array(RULES.priors))
    variation = _variation(evidence)
    logs = _averaged(weighed.log, evidence.seconds) + prior + variation[:, None, :]
    share = np.exp(logs - logs.max(axis=(1, 2), keepdims=True))
    total = share.sum(axis=(1, 2))
    share /= total[:, None, None]
    probability = _probabilities(share, weighed.turbid)
    fraction, square, clear = (
        (share[..., None] * part).sum(axis=(1, 2)) for part in (weighed.mean, weighed.square, weighed.clear)
    )
    if (probability[:, :2].sum(axis=1) < RULES.decided).any():
        # what is no clear sky may be one at another hour
        elsewhere = _elsewhere(evidence, windows, pressure)
        other = _averaged(elsewhere.log, evidence.seconds) + variation[:, KINDS.index("air")]
        here = logs.max(axis=(1, 2)) + np.log(total) - np.log(RULES.wrong_clock)
        wrong = 1.0 / (1.0 + np.exp(np.clip(here - other, -500.0, 500.0)))[:, None]
        probability = (1.0 - wrong) * probability + wrong * np.eye(5)[4]
        fraction += wrong * (elsewhere.mean - fraction)
        square += wrong * (elsewhere.square - square)
    probability[(weighed.best > RULES.misfit) | (evidence.sun_zenith > _LOWEST)] = np.eye(5)[4]
    # the mean of the kind that is likely, with the doubt about it in the uncertainty
    kind = np.array([0, 0, KINDS.index("broken"), KINDS.index("overcast")])
    state = probability[:, :4].argmax(axis=1)
    sure = probability[:, :4].max(axis=1) >= RULES.decided
    mean = np.where(sure[:, None], weighed.mean[np.arange(state.size), 0, kind[state]], fraction)
    model = RULES.floor + RULES.model * mean * (1.0 - mean)
    u = np.sqrt(np.maximum(square - 2.0 * mean * fraction + mean**2, 0.0) + model**2)
    fraction = mean
    # between clouds the receiver has at one moment what the ground has at the next
    apart = fraction - fraction.mean(axis=0)
    square = _averaged(apart**2, evidence.seconds) - _averaged(apart, evidence.seconds) ** 2
    change = np.maximum(square, 0.0)
    u = np.sqrt(u**2 + share[:, :, KINDS.index("broken")].sum(axis=1)[:, None] * change)
    middle = int(np.abs(_NODES_NM - 550.0).argmin())
    cloud = (fraction - clear)[:, middle] / np.maximum(1.0 - clear[:, middle], 1e-6)
    return Explained(fraction, u, probability, np.clip(cloud, 0.0, 1.0), _NODES_NM)


def _probabilities(share: Floats, turbid: Floats) -> Floats:
    """Return the probability of the five states (sample, state).

    Of the shares of kinds (sample, width of the level, kind), and of turbid air among them. Thin cloud, and a
    level that is not what it should be, contradict the others.
    """
    sure = share[:, 0]
    air, thin, broken, overcast = sure.T
    hazy = air * turbid[:, 0, 0]
    return np.stack([air - hazy, hazy, broken, overcast, share[:, 1].sum(axis=1) + thin], axis=1)


def _near(seconds: Floats) -> tuple[Ints, Ints]:
    """Return first and last but one of the samples that lie within the window of each (sample,)."""
    first = np.searchsorted(seconds, seconds - RULES.window_s, side="left")
    return first, np.searchsorted(seconds, seconds + RULES.window_s, side="right")


def _averaged(values: Floats, seconds: Floats) -> Floats:
    """Return the means of values (sample, ...) over the window of each sample, whose times increase."""
    first, last = _near(seconds)
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    count = (last - first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((sums[last] - sums[first]) / count)


def _variation(evidence: Evidence) -> Floats:
    """Return the logarithm of how likely the level's changes are under each kind of sky (sample, kind)."""
    height = np.maximum(np.cos(np.radians(np.minimum(evidence.sun_zenith, 88.0))), 1e-3)
    level = evidence.level.mean(axis=1) - np.log(height)
    level = level - level.mean()
    mean = _averaged(level, evidence.seconds)
    spread = np.sqrt(np.maximum(_averaged(level**2, evidence.seconds) - mean**2, 0.0))
    # a record of some seconds says little of what a minute brings
    first, last = _near(evidence.seconds)
    span = (evidence.seconds[last - 1] - evidence.seconds[first]) / (2.0 * RULES.window_s)
    log = np.log(np.maximum(spread, 1e-3))[:, None]
    with np.errstate(divide="ignore"):
        below = np.maximum(np.log(RULES.calm) - log, 0.0) / np.array(RULES.calm_spread)
    above = np.maximum(log - np.log(RULES.restless), 0.0) / RULES.restless_spread
    return np.asarray(-0.5 * (below**2 * np.minimum(span, 1.0)[:, None] + above**2))
