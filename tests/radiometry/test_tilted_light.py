"""Tilted surfaces under the sky that the record tells of."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight, values

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.counts_to_reflectance import reflectance

TOWARDS_SUN = (20.0, 180.0)
UNIFORM = 1.0 + (np.cos(np.radians(10.0)) ** 2 - 1.0) * (1.0 - 0.2)
"""Light on a surface 20 degree from level over that on level ground, of a sky that is the same all around."""


def _line(share: float) -> xr.Dataset:
    # A line whose record is a share of a clear sky's global irradiance, of smooth colour
    line = flight(position=True).line
    nm = line.irradiance_wavelength.values
    zenith, _ = solar_position(line.irradiance_time.values, 43.08, -77.67)
    sky = sum(ClearSky(float(zenith.mean())).irradiance(nm)) * 0.967 * share
    return line.assign(irradiance=line.irradiance.copy(data=np.tile(sky, (12, 1)).astype(np.float32)))


def _onto(line: xr.Dataset, tilt: Any) -> np.ndarray[Any, Any]:
    # Return level over tilted reflectance: the light on the surface over that on level ground
    return np.asarray(np.nanmean(values(line) / values(line, tilt=tilt), axis=(0, 2)))


def test_under_an_overcast_record_no_side_is_brighter() -> None:
    # Rationale: the clear sky that was taken instead gave 1.056 where 0.976 is right
    assert pytest.approx(0.976, abs=5e-4) == UNIFORM
    for tilt in (TOWARDS_SUN, (20.0, 0.0)):
        np.testing.assert_allclose(_onto(_line(0.25), tilt), UNIFORM, atol=2e-3)


def test_under_a_clear_record_the_model_of_the_tilt_counts() -> None:
    line = _line(1.0)
    model = hp.Tilt(*TOWARDS_SUN).factor(
        line.irradiance_time.values[5:6], 43.08, -77.67, line.wavelength.values
    )
    assert model.min() > 1.05
    np.testing.assert_allclose(_onto(line, TOWARDS_SUN), model[0], atol=1e-4)


def test_a_diffuse_fraction_of_the_lines_counts_before_the_record() -> None:
    clear = _line(1.0)
    bands = np.ones(clear.sizes["band"], np.float32)
    fraction = np.tile(bands, (clear.sizes["along_track"], 1))
    overcast = clear.assign(
        diffuse_fraction=(("along_track", "band"), fraction, {"units": "1"}),
        sky_state=("along_track", np.full(len(fraction), 3, np.int8)),
    )
    one = clear.assign(diffuse_fraction=("band", bands, {"units": "1"}))
    for line in (overcast, one):
        np.testing.assert_allclose(_onto(line, TOWARDS_SUN), UNIFORM, atol=1e-4)
    known = hp.Tilt(*TOWARDS_SUN, diffuse_fraction=0.1)
    np.testing.assert_allclose(_onto(overcast, known), _onto(clear, known))


def test_a_record_of_no_sky_is_warned_of() -> None:
    line = reflectance(_line(1.7), tilt=TOWARDS_SUN)
    with pytest.warns(PaintWarning, match="sky-unknown"):
        line.reflectance.compute()
    reflectance(_line(1.7), tilt=(0.0, 0.0)).reflectance.compute()


def test_no_bit_depends_on_chunks_or_on_a_crop() -> None:
    line = _line(0.25)
    whole = values(line, tilt=TOWARDS_SUN)
    crop = line.isel(along_track=slice(7, 15))
    chunked = line.assign(counts=line.counts.chunk(along_track=5))
    np.testing.assert_array_equal(values(chunked, tilt=TOWARDS_SUN), whole)
    np.testing.assert_array_equal(values(crop, tilt=TOWARDS_SUN), whole[7:15])
