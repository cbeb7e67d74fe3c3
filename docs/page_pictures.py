"""Pictures of the front page, the tour and the how-to pages, from a simulated flight and the demonstration.

hyperpaint demo --out demo
python docs/page_pictures.py demo docs/_static

Other pictures of these pages are first pictures of notebooks, which `notebooks/refresh.py` keeps, and
screenshots of the explorer and of `hyperpaint site demo/lot.zarr`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import chain_picture  # beside this file
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.patches import Polygon
from PIL import Image

import hyperpaint as hp

WIDTHS_PX = {"chain.png": 1400, "quicklook.png": 760}  # of stored pictures; 900 of others


def bare(axes: Any) -> None:
    """Remove the frame lines that carry no scale."""
    axes.spines[["top", "right"]].set_visible(False)


def draw_flight(folder: Path, out: Path) -> None:
    """Draw pictures of a flight over solid paints: chain, roof, regions and raw counts."""
    collect = hp.simulate_collect(
        folder / "collect", lines=400, columns=320, bands=60, samples=8, seed=3, fleet="solid"
    )
    hp.process(collect, folder / "lot.zarr")
    stored = xr.open_zarr(folder / "lot.zarr", group="flightlines/raw_0")
    line = stored.paint.reflectance(uncertainty=True).paint.flag()
    chain_picture.draw(stored, hp.read_regions(collect.parent / "regions.geojson"), out / "chain.png")
    regions = line.paint.propose_regions()
    paints = line.paint.signatures(regions)
    for name, width in {"red_roof": 9.5, "red_roof_narrow": 5.0}.items():
        hp.pictures.paint_card(line, paints, "red-01", out / f"{name}.png", width=width)

    figure, axes = plt.subplots(figsize=(5.0, 5.9), layout="constrained")
    axes.imshow(line.paint.rgb(), origin="lower")
    for region in regions:
        axes.add_patch(Polygon(region.polygon, fill=False, edgecolor="white", linewidth=1.8))
        x, y = np.mean(region.polygon, axis=0)
        axes.annotate(region.name, (x, y + 22), color="white", ha="center", fontsize=9, fontweight="bold",
                      bbox={"facecolor": "black", "alpha": 0.6, "linewidth": 0, "pad": 1.5})  # fmt: skip
    axes.set(xlabel="column", ylabel="line, flown upwards", xlim=(0, 319), ylim=(0, 399))
    figure.savefig(out / "regions.png", dpi=80)

    raw = stored[["counts"]].drop_vars("quality", errors="ignore")
    places = {"red roof": (188, 65), "yellow roof": (80, 90), "asphalt": (150, 160)}
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    left.imshow(raw.paint.rgb(), origin="lower")
    left.set(xlabel="column", ylabel="line")
    for (name, (row, column)), colour in zip(places.items(), ("tab:red", "goldenrod", "0.35"), strict=True):
        left.plot(column, row, "o", color=colour, markeredgecolor="white")
        right.plot(
            raw.wavelength, raw.counts.isel(along_track=row, cross_track=column), color=colour, label=name
        )
    right.set(xlabel="wavelength [nm]", ylabel="raw counts [count]", xlim=(400, 1000), ylim=(0, None))
    right.legend(frameon=False)
    bare(right)
    figure.savefig(out / "counts.png", dpi=80)


def draw_tour(demo: Path, out: Path) -> None:
    """Draw the line and the paints of the demonstration, as the tour does."""
    line = xr.open_zarr(demo / "lot.zarr", group="flightlines/raw_0").paint.reflectance()
    line.paint.quicklook(out / "quicklook.png")
    paints = line.paint.signatures(hp.read_regions(demo / "regions.geojson"))
    hp.pictures.library_overview(paints, out / "paints.png")

    # the panels of the scene, declared with the reflectance that the simulator gave their middle
    true = xr.open_zarr(demo / "truth.zarr").isel(along_track=line.frame.values)
    names = true.surface.attrs["flag_meanings"].split()
    panels = []
    for name in ("panel_20", "panel_50", "panel_90"):
        rows, columns = np.nonzero(true.surface.values == names.index(name))
        middle = [slice(int(place.min()) + 3, int(place.max()) - 2) for place in (rows, columns)]
        expected = true.reflectance.isel(along_track=middle[0], cross_track=middle[1])
        expected = expected.mean(("along_track", "cross_track"), keep_attrs=True)
        panels.append(hp.Panel(*middle, expected.assign_coords(wavelength=line.wavelength)))
    hp.pictures.panel_figure(hp.radiometry.panel_closure(line, panels), out / "panels.png", width=8)


def shrink(path: Path, target: Path) -> None:
    """Store a picture with 256 colours, at most as wide as a page shows it."""
    width = WIDTHS_PX.get(path.name, 900)
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    if picture.width > width:
        height = round(picture.height * width / picture.width)
        picture = picture.resize((width, height), Image.Resampling.LANCZOS)
    picture.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(target, optimize=True)


if __name__ == "__main__":
    target = Path(sys.argv[2])
    with tempfile.TemporaryDirectory() as scratch:
        drawn = Path(scratch)
        draw_flight(drawn / "flight", drawn)
        draw_tour(Path(sys.argv[1]), drawn)
        for file in drawn.glob("*.png"):
            shrink(file, target / file.name)
