"""Fresnel's equations by Snell's angles, and the glint of a rough coat: nothing of the package."""

from typing import Any

import numpy as np


def plain_fresnel(angle: Any, index: float) -> Any:
    # Return the reflectance of an interface, the mean of both polarisations; angle [radian]
    inside = np.arcsin(np.sin(angle) / index)
    s = (np.cos(angle) - index * np.cos(inside)) / (np.cos(angle) + index * np.cos(inside))
    p = (index * np.cos(angle) - np.cos(inside)) / (index * np.cos(angle) + np.cos(inside))
    return (s**2 + p**2) / 2


def plain_glint(view: np.ndarray, light: np.ndarray, index: float, alpha: float) -> float:
    # Return F D G / (4 cos_o) of a level coat [sr-1], in the mean over lights (light, 3) or of one (3)
    # GGX in tangents: Walter et al. 2007, equation 33; Heitz 2014, equation 99 (height-correlated G)
    half = (view + light) / np.linalg.norm(view + light, axis=-1, keepdims=True)
    up = half[..., 2]
    density = alpha**2 / (np.pi * up**4 * (alpha**2 + ((1 - up**2) / up**2)) ** 2)
    smith = [(np.sqrt(1 + alpha**2 * np.tan(np.arccos(side[..., 2])) ** 2) - 1) / 2 for side in (view, light)]
    glints = plain_fresnel(np.arccos(half @ view), index) * density / (1 + sum(smith)) / (4 * view[2])
    return float(np.mean(glints))
