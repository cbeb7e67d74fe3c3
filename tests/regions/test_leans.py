"""Leans of roofs from height models."""

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.regions.proposals import height_model_of, measured_lean

SPACING, SHAPE = 0.04, (40, 50)
NORTH = np.array([1.0, 0.0])
"""Shadows fall to later lines, so that the sun is towards earlier ones."""


def crowned(lean_deg: float) -> np.ndarray:
    # Return ground with a roof of 1.2 x 1.6 m, whose ends lie 5 cm below its middle, leaning to the sun
    y, x = (np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2) * SPACING
    top = 1.5 - 0.05 * ((y / 0.6) ** 2 + (x / 0.8) ** 2) + y * np.tan(np.radians(lean_deg))
    return np.where((np.abs(y) <= 0.6) & (np.abs(x) <= 0.8), top, 0.0)


def lean_of(height: np.ndarray | None, prior: float = 1.1) -> tuple[float, float, float]:
    window = np.s_[6:35, 7:44]
    inside = np.ones((29, 37), bool)
    model = None if height is None else (height, SPACING)
    sd, shift, angle = measured_lean(model, window, inside, (14.0, 18.0), prior, NORTH)
    return sd, float(shift[0]), angle


@pytest.mark.parametrize("lean", [-2.0, 0.0, 1.5])
def test_lean__is_that_of_the_heights(lean: float) -> None:
    # Rationale: z = -0.05 (y / 0.6)^2 + y tan(b) is level tan(b) 0.36 / 0.1 m from its middle
    # Expected: that lean, and the way to where it is level, shortened by what was thought before
    sd, shift, angle = lean_of(crowned(lean))
    weight = 1.1**2 / (1.1**2 + 0.3**2)
    assert angle == pytest.approx(lean, abs=1e-6)
    assert shift == pytest.approx(weight * np.tan(np.radians(lean)) * 0.36 / 0.1 / SPACING, abs=1e-6)
    assert sd == pytest.approx(1.1 * 0.3 / np.hypot(1.1, 0.3), rel=1e-6)


def test_noise__is_stated() -> None:
    # Rationale: 1 cm of noise that is alike over 15 cm. Expected: found leans scatter as is stated.
    rng = np.random.default_rng(2)
    found, stated = [], []
    for _ in range(200):
        rough = np.kron(0.01 * rng.normal(size=(10, 13)), np.ones((4, 4)))[: SHAPE[0], : SHAPE[1]]
        sd, _, angle = lean_of(crowned(1.0) + rough, prior=50.0)
        found.append(angle)
        stated.append(np.sqrt(sd**2 - 0.3**2))
    assert np.std(found) == pytest.approx(np.mean(stated), rel=0.25)
    assert np.mean(found) == pytest.approx(1.0, abs=0.1)


def test_bare_ground_and_flat_roofs_have_no_lean() -> None:
    # Rationale: most height models show the ground without cars. Expected: as if there were none.
    assert lean_of(np.add.outer(0.02 * np.arange(40.0), np.zeros(50)))[:2] == lean_of(None)[:2] == (1.1, 0.0)
    y = (np.arange(40) - 20) * SPACING
    height = np.full(SHAPE, 1.5) + 0.05 * y[:, None]
    height[:4] = height[-4:] = 0.0
    assert not np.isfinite(lean_of(height)[1])
    # Expected: the spacing of pixels from their places; None of a line without places
    y, x = np.indices((5, 6)).astype(np.float64)
    dims = ("along_track", "cross_track")
    line = xr.Dataset(coords={"east": (dims, 0.1 * x), "north": (dims, 0.1 * y), "ground_height": (dims, y)})
    model = height_model_of(line)
    assert model is not None
    assert model[1] == pytest.approx(0.1)
    assert height_model_of(line.drop_vars("north")) is None
    assert {"east", "north", "ground_height"} <= set(hp.base.schema.VARIABLES)
