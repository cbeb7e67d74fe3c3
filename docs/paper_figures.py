"""All figures of the paper, from the store of the demonstration and a rendered car park.

hyperpaint demo --out demo
python docs/paper_figures.py demo docs/_static
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from PIL import Image

import hyperpaint as hp
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.platforms import pushbroom

WIDTH_PX = 900  # of a stored picture


def box(name: str, lines: Any, columns: Any) -> hp.Region:
    """Return a rectangle of a line, by its first and last line and column."""
    (top, bottom), (left, right) = lines, columns
    return hp.Region(name, [(left, top), (right, top), (right, bottom), (left, bottom)])


def clean_boxes(line: xr.Dataset, half: int = 2) -> dict[str, hp.Region]:
    """Return a small rectangle on every car of a render, where it shows only paint in the sun."""
    found = {}
    is_paint = (line.surface_class == line.surface_class.flag_meanings.split().index("paint")).values
    clean = (
        is_paint
        & (line.purity == 1.0).values
        & (line.shadow == 0.0).values
        & (line.glint_share < 0.01).values
    )
    for car in np.unique(line.car_id.values[clean]):
        rows, columns = np.nonzero(clean & (line.car_id.values == car))
        centre = [int(np.median(places)) for places in (rows, columns)]
        window = clean[tuple(slice(max(place - half, 0), place + half + 1) for place in centre)]
        if window.all() and window.size == (2 * half + 1) ** 2:
            spans = [(place - half, place + half) for place in centre]
            found[f"car {car}"] = box(f"car {car}", *spans)
    return found


def draw(demo: Path, out: Path) -> None:
    """Draw every figure."""
    lot = xr.open_zarr(demo / "lot.zarr", group="flightlines/raw_0")
    regions = hp.read_regions(demo / "regions.geojson")
    line = lot.paint.reflectance(uncertainty=True).paint.flag().compute()
    paints = hp.extract_signatures(line, regions, specular_sky=True)
    orthomap = hp.geometry.orthorectify(line)
    traced = (
        hp.simulation.trace(
            car_park(length=18.0, width=18.0, seed=3, neighbours=()),
            pushbroom(180, 180, altitude=15.0, ground_sample=0.1),
            ["noon", "near_sunset", "cloudy"],
            samples=48,
        )
        .isel(along_track=slice(40, None))
        .compute()
    )
    skies = {
        name: traced.paint.relight(paints=paints, atmosphere=name).compute()
        for name in ("noon", "near_sunset", "cloudy")
    }
    cars = list(clean_boxes(skies["noon"]).values())[:6]

    red = regions[1]
    signatures = hp.extract_signatures(skies["noon"], cars, exclude=0).reflectance
    reddest = cars[int((signatures.isel(band=120) / signatures.isel(band=60)).argmax("signature"))]
    pictures = hp.pictures
    pictures.scenes_and_spectra(
        {"flown": line, "rendered": skies["noon"]},
        {"flown": [red], "rendered": [reddest]},
        out / "paper_1.png",
        variable={"flown": "counts", "rendered": "radiance"},
        together=False,
    )
    mapped = hp.pictures.rgb(orthomap).plot.imshow(rgb="rgb", aspect=1.3, size=5.0)
    mapped.axes.set_title("")
    mapped.figure.savefig(out / "paper_2a.png")
    # pixels of a white bonnet, and the pixels of its glint
    white = [(line_number, 75) for line_number in range(28, 35, 2)]
    glint = np.argwhere((line.quality.values & int(hp.Quality.GLINT)) != 0)
    on_car = glint[(glint[:, 0] < 45) & (glint[:, 1] > 40) & (glint[:, 1] < 120)][:3]
    pictures.triptych(line, pixels=[*white, *map(tuple, on_car)], path=out / "paper_2bcd.png")
    pictures.straightening(line, orthomap, out / "paper_3.png")
    beside_red = traced.paint.relight(paints={"car_001": "red"}, atmosphere="noon").compute()
    near, far = (box(name, lines, (145, 165)) for name, lines in (("near", (44, 47)), ("far", (10, 13))))
    pictures.adjacency_figure(beside_red, near, far, out / "paper_4.png")
    agreement = hp.validate(
        paints, [hp.open_store(demo / "lot.zarr", f"references/{name}") for name in ("asd", "svc")]
    )
    pictures.validation_figure(agreement, out / "paper_5.png", columns=4)
    pictures.scenes_and_spectra(skies, cars, out / "paper_6.png")
    pictures.chips_and_renders(paints, skies["noon"], out / "paper_7.png")
    pictures.scenes_and_spectra(skies, cars, out / "paper_S.png", together=False)
    for path in sorted(out.glob("paper_*.png")):
        picture = Image.open(path).convert("RGB")
        picture.thumbnail((WIDTH_PX, WIDTH_PX))
        picture.quantize(128).save(path, optimize=True)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
