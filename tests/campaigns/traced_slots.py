"""How many pixels of a car park have more paths than slots, and the noise it makes: rows for a table.

``python tests/campaigns/traced_slots.py``
"""

import numpy as np

from hyperpaint.simulation import relight, trace
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.platforms import pushbroom


def main() -> None:
    park = car_park(length=30.0)
    flight = pushbroom(48, 64, altitude=60.0, ground_sample=0.25, centre=(0.0, 15.0))
    bands = BandSet(np.array([450.0, 550.0, 650.0, 850.0]), np.full(4, 6.0))
    print("| samples | slots | pixels whose paths all fit | noise |\n| --- | --- | --- | --- |")
    for samples in (16, 64, 256):
        usual, ample = (trace(park, flight, samples=samples, slots=slots).compute() for slots in (None, 2048))
        slots = usual.sizes["slot"]
        fits = float(((ample.transport_path >= 0).sum("slot") <= slots).mean())
        seen, exact = (relight(traced, bands).radiance.values for traced in (usual, ample))
        noise = float(np.sqrt(np.mean((seen / exact - 1.0) ** 2)))
        print(f"| {samples} | {slots} | {100 * fits:.1f} % | {100 * noise:.2f} % |")


if __name__ == "__main__":
    main()
