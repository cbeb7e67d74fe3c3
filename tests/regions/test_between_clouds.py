"""Whether the sun was free over a car between broken clouds: by the record, and by a shadow beside it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.regions.proposals import Picture, doubt_about_clouds, sunny_lines
from hyperpaint.surroundings.model import SHADED

NM = np.linspace(405.0, 995.0, 24)
START = np.datetime64("2024-06-21T12:00", "ns")
LINES, CLEAR = 40, 0.1


def seen(fraction: Any = CLEAR, dark: tuple[float, float] = (60.0, 90.0)) -> tuple[xr.Dataset, Any]:
    # Return ground with a shadow of a diffuse fraction, its record with a cloud between two times [s]
    reflectance = np.full((LINES, NM.size, 60), 0.2)
    reflectance[5:35, :, 20:30] *= fraction
    seconds = np.arange(-60.0, 120.0)
    light = np.where((seconds >= dark[0]) & (seconds <= dark[1]), 0.4, 1.0)
    line = xr.Dataset(
        {
            "reflectance": (("along_track", "band", "cross_track"), reflectance.astype(np.float32)),
            "irradiance": (("irradiance_time", "irradiance_wavelength"), np.tile(light[:, None], NM.size)),
            "diffuse_fraction": (("along_track", "band"), np.full((LINES, NM.size), CLEAR, np.float32)),
        },
        {
            "wavelength": ("band", NM, {"units": "nm"}),
            "time": ("along_track", START + (np.arange(LINES) * 1e9).astype("timedelta64[ns]")),
            "irradiance_time": START + (seconds * 1e9).astype("timedelta64[ns]"),
        },
    )
    line["reflectance"].attrs["units"] = "1"
    model = hp.surroundings.survey(line, sun_zenith=30.0)
    model.attrs["sky_states"] = "clear broken"
    shadow = int(model.segment[20, 25])
    ground = int(model.segment[20, 50])
    assert shadow != ground
    state, body, level = model.state.copy(), model.body.copy(), model.ground.copy()
    state[shadow], body[shadow], level[[shadow, ground]] = SHADED, ground, 1
    return line, replace(model, state=state, body=body, ground=level)


def test_sun__is_free_far_from_the_edges_of_clouds() -> None:
    # Rationale: at 8 m/s a shadow comes 80 m far in ten seconds, as far as a car may be from the receiver
    # Expected: lines more than 10 s before a cloud at 30 s are in free sun, others not; clouds that take a
    # quarter of the light leave no shadow to tell them by, and nothing is free
    line, model = seen(dark=(30.0, 90.0))
    sun = sunny_lines(line, model, None, 30.0)
    assert sun is not None
    lines, fraction = sun
    assert (fraction, np.flatnonzero(lines).tolist()) == (pytest.approx(CLEAR), list(range(20)))
    line["irradiance"][7] = np.nan
    assert sunny_lines(line, model, None, 30.0)[0].sum() == 20
    assert not sunny_lines(line.assign(irradiance=line["irradiance"].clip(0.75)), model, None, 30.0)[0].any()
    model.attrs["sky_states"] = "clear"
    assert sunny_lines(line, model, None, 30.0) is None


@pytest.mark.parametrize(("fraction", "word"), [(0.08, ""), (0.25, "a cloud covered the sun here")])
def test_shadow_beside_a_car__shows_a_cloud(fraction: float, word: str) -> None:
    # Rationale: under a cloud, a shadow keeps more of the light that is left
    # Expected: no doubt where it is as dark as the record says; doubt under a cloud, and where no shadow lies
    line, model = seen(fraction)
    channels = line["reflectance"].values.transpose(0, 2, 1)[:, :, : model.channel_wavelength.size]
    window = np.s_[10:15, 35:40]
    picture = Picture(model, channels, {}, 30.0, sun=(np.ones(LINES, bool), CLEAR))
    doubt = doubt_about_clouds(window, picture)
    assert word in doubt
    assert bool(doubt) == bool(word)
    # the side of a car that is turned away from the sun is no shadow on the ground
    for changed in ({"state": np.zeros_like(model.state)}, {"ground": np.zeros_like(model.ground)}):
        without = replace(picture, model=replace(model, **changed))
        assert "no shadow beside" in doubt_about_clouds(window, without)
    covered = replace(picture, sun=(np.zeros(LINES, bool), CLEAR))
    assert "no irradiance record" in doubt_about_clouds(window, covered)
    assert doubt_about_clouds(window, replace(picture, sun=None)) == ""
