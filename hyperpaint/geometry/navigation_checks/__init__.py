"""Checks of a navigation record: signs of angles, clocks, mounting of the camera."""
