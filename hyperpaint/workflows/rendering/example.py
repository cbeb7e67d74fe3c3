"""A ``scene.toml`` to begin with."""

from __future__ import annotations

__all__ = ["EXAMPLE"]

EXAMPLE = """\
# A scene: what is seen, where from, by what, in which light. Paths are relative to this file.
# Lines that begin with a single "#" and a key show the default, or what else there is.

[scene]
kind = "car_park"           # or "plane" (size_m, spectrum), or "empty": nothing but meshes
seed = 3                    # chooses cars, paints, places, trees
length_m = 22.0             # northwards from y = 0; the park lies around x = 0
width_m = 16.0              # 16 m hold two rows of cars and an aisle, 32 m four rows
# occupancy = 0.85
# paints = ["white", "red", "blue"]           # a dozen by default
# types = ["sedan", "hatchback", "estate", "suv", "van", "pickup"]
# neighbours = ["trees", "walls", "lamps"]    # and "hedges"; [] for none
# panels = true             # grey panels of known reflectance in the aisle
# coat = true               # false: Lambert paints
# coat_roughness = 0.05

# [[meshes]]                # .obj, or .glb and .ply (python -m pip install 'hyperpaint[mesh]')
# path = "truck.obj"
# kind = "car"              # ground, car, tree, wall, panel, other
# spectrum = "red"          # what it is made of; parts by name: materials = { glass = "glass" }
# offset_m = [3.0, 10.0, 0.0]
# heading_deg = 90.0

[platform]
lines = 200
columns = 160
altitude_m = 15.0
ground_sample_m = 0.1       # or ifov_mrad
wobble_deg = 0.1            # spread of roll, pitch and heading; one number or three
exposure_time_ms = 5.0
frame_period_ms = 7.0       # a line is as long as a pixel is wide, unless speed_m_s or line_spacing_m
# centre_m = [0.0, 11.0]    # middle of the flight; by default that of the park
# heading_deg = 0.0         # clockwise from north
# start_time = 2021-07-20T17:10:00            # UTC

[camera]
bands = 272
first_wavelength_nm = 399.356
last_wavelength_nm = 1001.42
fwhm_nm = 6.0
srf_shape = "gaussian"      # or "slit"
smile_nm = 0.5
bit_depth = 12
# noise = true              # and electrons_per_count, read_noise, dark_level, nonuniformity, bad_elements ...

[[atmospheres]]
preset = "noon"

[[atmospheres]]
preset = "near_sunset"

[[atmospheres]]
preset = "cloudy"

# [[atmospheres]]
# name = "hazy-morning"
# preset = "noon"           # or table = "light.csv", or irradiance = "asd/*.asd", with sun_zenith_deg
# sun_zenith_deg = 60.0
# sun_azimuth_deg = 100.0
# oktas = 3

[sampling]
samples = 64                # rays of a pixel: noise falls with the root of their number
depth = 4                   # scatterings of a ray
seed = 0

# [spectra]                 # your own: lines of wavelength [nm] and reflectance
# mine = "spectra/mine.csv"

# [paints]                  # repaint a car, a material or all that has a spectrum, without tracing again
# car_003 = "mine"
# red = "dark_red"

[output]
product = "counts"          # or "radiance"
true_reflectance = true     # the cube without noise, beside it
"""
"""What ``hyperpaint render --example`` prints."""
