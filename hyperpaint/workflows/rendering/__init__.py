"""Rendering of a ``scene.toml``: what is seen, where from, by what, in which light.

The tables of the file, each key with its unit in its name; `EXAMPLE` shows them all (``hyperpaint render
--example``):

``[scene]``
    ``kind``: "car_park" (arguments of `hyperpaint.simulation.rendering.car_parks.car_park`), "plane"
    (``size_m``, ``spectrum``) or "empty"; ``name``, ``seed``.
``[[meshes]]``
    ``path`` of an .obj, .glb or .ply file; ``spectrum``, or ``materials`` by the names of its parts;
    ``name``, ``kind``, ``class``, ``coat_index``, ``coat_roughness``, ``flakes``; ``offset_m``,
    ``heading_deg``, ``unit_m``, ``up``.
``[platform]``
    ``lines`` and ``columns``, and arguments of `hyperpaint.simulation.rendering.platforms.pushbroom`.
``[camera]``
    Fields of `hyperpaint.simulation.SimulationSettings` that make a camera.
``[[atmospheres]]``
    ``name``, and a ``preset`` ("noon", "near_sunset", "cloudy"), a ``table`` of four curves, or the
    ``irradiance`` files of a spectrometer; ``sun_zenith_deg``, ``sun_azimuth_deg``, ``oktas`` and others.
``[sampling]``
    ``samples``, ``depth``, ``slots``, ``seed``, ``sun_radius_deg``.
``[spectra]``, ``[paints]``
    Name to a file with a spectrum; name of a spectrum, material or car to that of its new spectrum.
``[output]``
    ``product``: "radiance" or "counts"; ``true_reflectance``.
"""

from __future__ import annotations

from .rendering import render_scene

__all__ = ["render_scene"]
