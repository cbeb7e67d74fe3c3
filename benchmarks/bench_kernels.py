"""Loops over arrays: memory in, memory out, one thread."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import dataclasses

import numpy as np

from .common import (
    BANDS,
    COLUMNS,
    FRAME_PERIOD,
    SMILE,
    counts_block,
    error_terms_of_plan,
    flight_line,
    instrument,
    plan_of,
    sky,
    wavelengths,
)


class Calibrate:
    """Counts to reflectance in a preallocated slab; the floor is numpy's cast of the same arrays."""

    params = ([128],)
    param_names = ("lines",)

    def setup(self, lines):
        self.counts = counts_block(lines)
        self.out = np.empty(self.counts.shape, np.float32)
        self.quality = np.empty((lines, COLUMNS), np.uint16)
        self.no_quality = np.empty((0, 0), np.uint16)
        self.plans = [plan_of(flight_line(lines, smile=smile, counts=self.counts)) for smile in (False, True)]
        self.terms = error_terms_of_plan()
        self.u_random, self.u_systematic = (np.empty(self.counts.shape, np.float32) for _ in range(2))
        self.time_plain(lines)
        self.time_uncertainty(lines)
        self.time_smile_quality_rounding(lines)

    def _run(self, smile, quality, cleared_bits=0, terms=None, linearity=None):
        from hyperpaint.kernels.arguments import SlabOutputs
        from hyperpaint.radiometry.slabs import calibrate_lines

        plan = dataclasses.replace(self.plans[smile], cleared_bits=cleared_bits, error_terms=terms)
        if linearity is not None:
            plan = dataclasses.replace(plan, detector=linearity.detector_model(65535.0))
        none = np.empty((0, 0, 0), np.float32)
        cubes = (none, none) if terms is None else (self.u_random, self.u_systematic)
        calibrate_lines(plan, self.counts, 0, SlabOutputs(self.out, quality, *cubes))

    def time_floor(self, lines):
        np.copyto(self.out, self.counts)

    def time_plain(self, lines):
        self._run(smile=False, quality=self.no_quality)

    def time_quality(self, lines):
        self._run(smile=False, quality=self.quality)

    def time_smile(self, lines):
        self._run(smile=True, quality=self.no_quality)

    def time_linearity(self, lines):
        from hyperpaint.radiometry.stray_light import Linearity

        self._run(smile=False, quality=self.quality, linearity=Linearity((1e-6, 1e-11)))

    def time_smile_linearity(self, lines):
        from hyperpaint.radiometry.stray_light import Linearity

        self._run(smile=True, quality=self.quality, linearity=Linearity((1e-6, 1e-11)))

    def time_linearity_of_a_table(self, lines):
        from hyperpaint.radiometry.stray_light import Linearity

        nodes = np.linspace(0.0, 65535.0, 17)
        self._run(smile=False, quality=self.quality, linearity=Linearity((), nodes, 1.03 * nodes))

    def time_pedestal(self, lines):
        plan = self.plans[False]
        masked = np.argwhere(np.broadcast_to(np.arange(COLUMNS) < 8, (BANDS, COLUMNS)))
        self.plans[False] = dataclasses.replace(
            plan, detector=plan.detector._replace(masked=masked, groups=np.array([[0, len(masked), -1, 0]]))
        )
        self._run(smile=False, quality=self.quality)
        self.plans[False] = plan

    def time_stray_light(self, lines):
        from hyperpaint.radiometry.stray_light import stray_light_of

        # scattered over bands as a laboratory finds it: half over all, half within some
        apart = np.abs(np.subtract.outer(np.arange(BANDS), np.arange(BANDS)))
        near = np.exp(-apart / 27.0)
        wings = {"stray_light": 0.015 * (near / near.sum(axis=0) + 1.0 / BANDS)}
        plan, lit = self.plans[False], np.empty((0, 2), np.int64)
        stray = stray_light_of(wings, np.ones(lines), plan.gain, lit)
        self.plans[False] = dataclasses.replace(plan, stray=stray)
        self._run(smile=False, quality=self.quality)
        self.plans[False] = plan

    def time_uncertainty(self, lines):
        self._run(smile=False, quality=self.no_quality, terms=self.terms)

    def time_uncertainty_without_wavelength(self, lines):
        terms = self.terms._replace(slope=np.empty((0, 4), np.float32))
        self._run(smile=False, quality=self.no_quality, terms=terms)

    def time_three_casts(self, lines):
        # what writing three cubes costs, whatever is in them
        for cube in (self.out, self.u_random, self.u_systematic):
            np.copyto(cube, self.counts)

    def time_everything(self, lines):
        self._run(smile=True, quality=self.quality, cleared_bits=11, terms=self.terms)

    def time_smile_quality_rounding(self, lines):
        self._run(smile=True, quality=self.quality, cleared_bits=11)


class Smooth:
    """Filters over the spectral axis; the floor is the cast of a cube of this shape."""

    params = ([128],)
    param_names = ("lines",)

    def setup(self, lines):
        from hyperpaint.radiometry.spectral_axis import window_polynomials

        self.counts = counts_block(lines)
        self.values = self.counts.astype(np.float32)
        self.out = np.empty_like(self.values)
        self.polynomials = window_polynomials(11, 2, BANDS)
        self.time_box(lines)
        self.time_savitzky_golay(lines)

    def time_floor(self, lines):
        np.copyto(self.out, self.counts)

    def time_box(self, lines, width=11):
        from hyperpaint.kernels.radiometry import average_slab

        average_slab(self.values, width, self.out)

    def time_wide_box(self, lines):
        self.time_box(lines, 51)

    def time_savitzky_golay(self, lines):
        from hyperpaint.kernels.radiometry import filter_slab

        first, weights, fallback = self.polynomials
        filter_slab(self.values, weights, first, fallback, self.out)


class MatchIrradiance:
    """A sky series to the imager's bands; the floor is the bare float64 product with a ready operator."""

    params = ([1800],)
    param_names = ("spectra",)

    def setup(self, spectra):
        from hyperpaint.base.responsivity import log_slope
        from hyperpaint.light.responses import Responses

        self.samples = np.arange(350.0, 2501.0)
        drift = 1.0 + 0.1 * np.sin(np.arange(spectra) * FRAME_PERIOD)
        self.series = (drift[:, None] * sky(self.samples)).astype(np.float32)
        self.bands = wavelengths()
        slope = log_slope(self.bands, 1.0 / instrument()["gain"].mean(axis=1), np.full(BANDS, 12.0))
        self.imager = Responses(self.bands, np.full(BANDS, 6.0), slope=slope)
        inside = slice(*np.searchsorted(self.samples, [380.0, 1021.0]))
        self.window = self.series[:, inside].astype(np.float64)
        self.operator = self._gaussians(self.samples[inside])

    def _gaussians(self, samples):
        weights = np.exp(-0.5 * ((samples - self.bands[:, None]) / 2.2) ** 2)
        return np.ascontiguousarray(weights.T / weights.sum(axis=1))

    def time_floor(self, spectra):
        self.window @ self.operator

    def time_match(self, spectra):
        self._match(np.zeros(1))

    def time_match_with_smile(self, spectra):
        self._match(np.arange(-0.5, SMILE + 0.75, 0.5))

    def _match(self, nodes):
        from hyperpaint.light.illumination import matched_series

        matched_series(self.series, self.samples, 3.0, "gaussian", self.imager, nodes)

    def integral_of_each_band(self, spectra):
        # not timed by asv, since it takes seconds; `ratios.py` shows it
        responses = np.exp(-0.5 * ((self.samples - self.bands[:, None]) / 2.2) ** 2)
        for response in responses:
            np.trapezoid(self.series * response, self.samples) / np.trapezoid(response, self.samples)
