"""Synthetic scenes: tracing paths of light once, and putting spectra to them as often as one likes."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import functools

import numpy as np

from .bench_pipeline import threads
from .common import COLUMNS, cases

SUN = (25.0, 180.0)  # of the preset atmosphere "noon"
BLOCK = (32, COLUMNS)


@functools.cache
def scene():
    from hyperpaint.simulation.rendering.car_parks import car_park

    return car_park(seed=1)


@functools.cache
def platform(lines, columns):
    """Return a flight over the middle of the car park, three centimetres a pixel at 640 columns."""
    from hyperpaint.simulation.rendering.platforms import pushbroom

    sample = max(0.03, 12.0 / columns)
    return pushbroom(lines, columns, altitude=40.0, ground_sample=sample, line_spacing=sample)


@functools.cache
def prepared(samples):
    from hyperpaint.simulation.rendering.relighting import prepare_scene
    from hyperpaint.simulation.rendering.scene import TraceSettings

    return prepare_scene(scene(), TraceSettings([SUN], samples=samples))


@functools.cache
def lighting(smile=0.0):
    """Return what the tasks of a relighting share, for 272 bands."""
    from hyperpaint.simulation.atmosphere import preset_atmosphere
    from hyperpaint.simulation.camera import BandResponses, BandSet, smile as shifts
    from hyperpaint.simulation.rendering.relighting import factor_spectra, make_lighting
    from hyperpaint.simulation.rendering.scene import SceneRecord

    bands = BandSet.nano_hyperspec()
    bands = BandSet(bands.wavelength, bands.fwhm, bands.shape, shifts(BLOCK[1], smile) if smile else None)
    record = SceneRecord.of(scene())
    settings = prepared(64).settings
    sky = preset_atmosphere("noon")
    factors = factor_spectra(record, bands)(BandResponses(bands).grid)
    return make_lighting(bands, record.codes(settings), sky, settings, factors)


@functools.cache
def traced_block(samples):
    from hyperpaint.simulation.rendering.relighting import trace_block

    lines, columns = BLOCK
    return trace_block(prepared(samples), platform(lines, columns), 0, lines)


class Block:
    """One task: 32 lines of a swath, one thread. The floor writes a cube of that size."""

    params = (cases(1, 64),)
    param_names = ("samples",)
    number = 1
    timeout = 300

    def setup(self, samples):
        self.block = traced_block(samples)
        self.light, self.bent = lighting(), lighting(1.5)
        self.cube = np.empty((BLOCK[0], 272, BLOCK[1]), np.float32)
        for method in (self.time_relight, self.time_relight_with_smile, self.time_shares, self.time_trace):
            method(samples)

    def time_trace(self, samples):
        from hyperpaint.simulation.rendering.relighting import trace_block

        trace_block(prepared(samples), platform(*BLOCK), 0, BLOCK[0])

    def time_relight(self, samples):
        self._relight(self.light)

    def time_relight_with_smile(self, samples):
        self._relight(self.bent)

    def _relight(self, light):
        light.radiance(self.block.weight, self.block.code, None, distance=self.block.distance)

    def time_shares(self, samples):
        self.light.shares(self.block.weight, self.block.code, None)

    def time_floor(self, samples):
        np.copyto(np.empty_like(self.cube), self.cube)


class Render:
    """From a scene to radiance in 272 bands, two threads, kernels compiled before."""

    params = (cases(16, 64),)
    param_names = ("pixels",)
    number = 1
    timeout = 300
    samples = 64

    def setup(self, pixels):
        self.time_scene_to_radiance(pixels)  # compiles
        with threads():
            self.traced = self._traced(pixels).compute()

    def _traced(self, pixels):
        import hyperpaint as hp

        flight = platform(pixels, pixels)
        return hp.simulation.trace(
            scene(), flight, [SUN], samples=self.samples, chunk_lines=max(1, pixels // 8)
        )

    def time_scene_to_radiance(self, pixels):
        with threads():
            self._traced(pixels).paint.relight(truth=False)["radiance"].compute()

    def time_trace(self, pixels):
        with threads():
            self._traced(pixels).compute()

    def time_relight_other_paints(self, pixels):
        with threads():
            self.traced.paint.relight(paints={"asphalt": "grass"}, truth=False)["radiance"].compute()

    def time_relight_with_truth(self, pixels):
        with threads():
            self.traced.paint.relight().compute()

    def peakmem_scene_to_radiance(self, pixels):
        self.time_scene_to_radiance(pixels)


class Graph:
    """What is paid before anything is computed."""

    params = (cases(1_000, 100_000),)
    param_names = ("lines",)
    number = 1

    def setup(self, lines):
        self.flight = platform(lines, 640)
        self.time_build(lines)

    def time_build(self, lines):
        import hyperpaint as hp

        hp.simulation.trace(scene(), self.flight, [SUN]).paint.relight()

    def track_tasks_per_block(self, lines):
        """Tasks of the relit radiance for each block of 32 lines, once optimised."""
        import dask

        import hyperpaint as hp

        (made,) = dask.optimize(hp.simulation.trace(scene(), self.flight, [SUN]).paint.relight()["radiance"])
        return len(dict(made.__dask_graph__())) / -(-lines // 32)

    track_tasks_per_block.unit = "tasks"
