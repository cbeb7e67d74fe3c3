"""A lab sweep to a calibration."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import functools

import numpy as np

from .common import cases

STEPS, BANDS = 61, 272


@functools.cache
def lab_sweep(columns):
    """Return a sweep in memory, noise, smile and all, and its true gain."""
    from hyperpaint.simulation import simulate_sweep

    sweep = simulate_sweep(steps=STEPS, bands=BANDS, columns=columns, smile_nm=1.5, nonuniformity=0.0)
    known = [name for name in sweep.variables if not str(name).startswith("true_")]
    return sweep[known], sweep.true_radiance_gain


class Sweep:
    """`hyperpaint.calibrate`; the floor takes the dark off every step and sums the bands."""

    params = (cases(8, 64),)
    param_names = ("columns",)

    def setup(self, columns):
        self.sweep, self.truth = lab_sweep(columns)
        self.counts, self.dark = self.sweep.counts.values, self.sweep.dark_counts.values
        self.calibration = self.made()  # compiles

    def made(self, **options):
        from hyperpaint.calibration import calibrate

        return calibrate(self.sweep, **options)

    def time_floor(self, columns):
        for frame in self.counts:
            np.subtract(frame, self.dark, dtype=np.float64).sum(axis=0)

    def time_calibrate(self, columns):
        self.made()

    def time_calibrate_known_shape(self, columns):
        self.made(srf_shape="gaussian")

    def track_gain_error(self, columns):
        """Worst error of the gain [%]: a faster calibration must be as good."""
        inside = (self.calibration.wavelength > 412) & (self.calibration.wavelength < 988)
        error = (self.calibration.radiance_gain / self.truth - 1).where(inside)
        return 100 * float(np.abs(error).max())

    track_gain_error.unit = "%"
