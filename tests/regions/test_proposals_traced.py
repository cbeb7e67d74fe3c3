"""Regions proposed by rule, on cars whose light is traced."""

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.regions import pixels_of
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of
from hyperpaint.surroundings.corrections import remove_mirrored_sky

NM = np.linspace(405.0, 995.0, 48)


@pytest.mark.slow
def test_proposals_on_traced_cars__are_right_or_refused() -> None:
    # Rationale: coats, cast shadows, glint and neighbours from geometry, which no rule here knows
    # Expected: something is proposed, and every signature is its paint within max(0.03, 6 %), and within 0.01
    # in shape
    sky = Atmosphere.clear(34.0, 105.0)
    park = car_park(length=14.0, width=32.0, seed=3, neighbours=(), margin=10.0, flakes=False, islands=False)
    flight = pushbroom(150, 200, altitude=15.0, ground_sample=0.06, line_spacing=0.06, start=(-0.1, 2.0))
    traced = hp.simulation.trace(park, flight, [sky], samples=24, seed=3, sun_radius=0.267)
    line = hp.simulation.relight(traced, BandSet(NM, np.full(NM.size, 6.0)), atmosphere=sky).compute()
    found = hp.regions.propose_regions(line, sun_zenith=34.0, sun_azimuth=105.0, heading=0.0, erode=2)
    assert len(found) >= 1
    corrected = remove_mirrored_sky(line, sun_zenith=34.0)["reflectance"].values
    names = line["paint_id"].attrs["flag_meanings"].split()
    for along, across in pixels_of(found, line):
        shown = line["paint_id"].values[along, across]
        assert (shown >= 0).all()
        own = spectrum_of(names[shown[0]])(NM)
        made = np.median(corrected[along, :, across], axis=0)
        assert (np.abs(made - own) < np.maximum(0.03, 0.06 * own)).all()
        assert np.sqrt(np.mean((made * (made @ own) / (made @ made) - own) ** 2)) < 0.01
