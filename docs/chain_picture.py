"""The picture of the chain on the front page and in the README, which `page_pictures.py` draws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.patches import Polygon

import hyperpaint as hp

FLAGS = (hp.Quality.GLINT, hp.Quality.SHADOW, hp.Quality.MIXED_EDGE)


def draw(stored: xr.Dataset, regions: Any, path: Path) -> None:
    """Draw five stages side by side: counts, irradiance, reflectance, flags and regions, signatures."""
    line = stored.paint.reflectance(uncertainty=True).paint.flag()
    paints = hp.extract_signatures(line, regions)
    figure, axes = plt.subplots(1, 5, figsize=(11, 2.7), layout="constrained", facecolor="white")
    figure.get_layout_engine().set(wspace=0.05)

    counts = line.counts.isel(band=int(np.argmin(np.abs(line.wavelength.values - 550.0)))).values
    axes[0].imshow(counts, cmap="gray", origin="lower", aspect="equal", vmax=np.percentile(counts, 99))
    axes[0].set_title("raw counts")

    record = line.irradiance
    wavelength = record.irradiance_wavelength.values
    light = (wavelength >= 400) & (wavelength <= 1000)
    axes[1].plot(wavelength[light], record.mean("irradiance_time").values[light], color="#d98c00", lw=1)
    axes[1].set(title="+ irradiance", xlabel="wavelength [nm]", ylim=(0, None))
    axes[1].set_ylabel("[W m$^{-2}$ nm$^{-1}$]")

    colour = line.paint.rgb().transpose("along_track", "cross_track", "rgb").values
    axes[2].imshow(colour, origin="lower")
    axes[2].set_title("= reflectance")

    quality = line.quality.values
    axes[3].imshow(0.35 * colour + 0.65, origin="lower")
    for flag in FLAGS:
        layer = np.zeros((*quality.shape, 4))
        layer[(quality & int(flag)) != 0] = (*plt.matplotlib.colors.to_rgb(flag.colour), 0.8)
        axes[3].imshow(layer, origin="lower")
        axes[3].plot([], [], "s", color=flag.colour, label=str(flag.name).lower().replace("_", " "))
    shades = dict(zip(paints["signature"].values, hp.paints.paint_colours(paints), strict=True))
    for region in regions:
        ring = region.polygon
        axes[3].add_patch(Polygon(ring, fill=False, edgecolor="#d6336c", lw=1.2))
    axes[3].set_title("\N{RIGHTWARDS ARROW} clean paint, flags")
    axes[3].legend(loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, frameon=False, fontsize=9,
                   handletextpad=0.1, columnspacing=0.8)  # fmt: skip

    for name, shade in shades.items():
        paint = paints.sel(signature=name)
        spread = np.hypot(paint.reflectance_u_random.fillna(0), paint.reflectance_u_systematic.fillna(0))
        axes[4].fill_between(
            paints.wavelength, paint.reflectance - spread, paint.reflectance + spread, color=shade, alpha=0.3
        )
        axes[4].plot(paints.wavelength, paint.reflectance, color=shade, lw=1.4)
    axes[4].set(
        title="\N{RIGHTWARDS ARROW} paint signatures",
        xlabel="wavelength [nm]",
        ylabel="reflectance factor [1]",
        ylim=(0, None),
    )
    axes[4].set_facecolor("#eceff1")
    for ax in (axes[0], axes[2], axes[3]):
        ax.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=160)
