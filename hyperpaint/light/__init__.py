"""Light on the scene: spectral responses, the sun, and the irradiance of every scan line.

An irradiance record and the bands of a camera come in, the irradiance that each band of each line saw goes
out. For radiometry and all above it.
"""
