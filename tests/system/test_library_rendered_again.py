"""The paper's last step: signatures of a flight are rendered, and measured again they are the same."""

from collections.abc import Sequence

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.paints import starter_library
from hyperpaint.regions import Region, Regions
from hyperpaint.simulation.rendering.materials import Coat, Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import Instance, Scene, box, plane

pytestmark = pytest.mark.slow

#: The first has 2 % of spread, the others 3 and 8 %.
PAINTS = ("Synthetic Polar White", "Synthetic Signal Red", "Synthetic Carbon Black")
PLATE = 3.0


def plates() -> Scene:
    # Return three level coated plates on asphalt, far enough apart to throw little light on one another
    things = [plane(60.0)]
    for number, _ in enumerate(PAINTS):
        paint = Material(f"paint of car_{number}", "white", "paint", Coat(1.5, 0.004))
        car = Instance(f"car_{number}", "car", "white")
        things.append(box((PLATE, PLATE, 0.05), paint, centre=(0.0, 6.0 * number - 6.0, 0.0), instance=car))
    return Scene.join(things, "plates")


def flown(paints: xr.Dataset, seed: int) -> xr.Dataset:
    # Return the flight line over the plates in these paints
    flight = pushbroom(180, 32, altitude=15.0, ground_sample=0.1, centre=(0.0, 0.0))
    traced = hp.simulation.trace(plates(), flight, ["noon"], samples=32, seed=seed)
    cars = {f"car_{number}": str(name) for number, name in enumerate(paints["signature"].values)}
    return hp.simulation.relight(traced, paints=cars, spectra=paints, atmosphere="noon")


def signatures(line: xr.Dataset, names: Sequence[str]) -> xr.Dataset:
    # Return the library of regions that lie well inside the plates
    seen = hp.reflectance(line)
    regions = []
    for number, name in enumerate(names):
        lines, columns = np.nonzero((line.instance == number + 1).values & (line.purity == 1.0).values)
        top, bottom, left, right = lines.min() + 1, lines.max() - 1, columns.min() + 1, columns.max() - 1
        regions.append(Region(name, [(left, top), (right, top), (right, bottom), (left, bottom)]))
    library = hp.extract_signatures(
        seen, Regions(tuple(regions)), specular_sky=True, sun_zenith=25.0, diffuse="model"
    )
    return library.compute()


def test_a_library_that_is_rendered_and_measured_again_is_the_same() -> None:
    drawn = starter_library(members=200)
    truth = drawn.isel(signature=[list(drawn["signature"].values).index(name) for name in PAINTS])
    first = signatures(flown(truth, seed=1), PAINTS)
    second = signatures(flown(first, seed=2), PAINTS)
    good = (first.wavelength > 420.0) & (first.wavelength < 980.0)
    for number in range(len(PAINTS)):
        one, again = (library.isel(signature=number, band=good) for library in (first, second))
        apart = np.abs(again.reflectance - one.reflectance)
        assert float((apart / one.reflectance_sd).max()) < 1.0
        # standard errors of both means, of so many independent pixels as the libraries say, and what coat
        # and mirrored sky leave uncertain of each
        errors = [each.reflectance_sd**2 / each.n_eff + each.reflectance_u_coat**2 for each in (one, again)]
        assert float((apart < 1.96 * np.sqrt(errors[0] + errors[1])).mean()) > 0.95
        assert float((apart / one.reflectance).median()) < (0.004 if one.reflectance.mean() > 0.1 else 0.03)
        assert 0.85 < float((again.reflectance_sd / one.reflectance_sd).median()) < 1.15
