"""Light, spectra and camera of one relighting, and what they do to a block of traced lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Array, Floats, Floats32
from hyperpaint.base.errors import SchemaError

from .band_responses import BandResponses, cell_means
from .bands import BandSet
from .four_curves import Atmosphere
from .path_codes import FIRST_SUN, OVERCAST_SKY, SKY, PathCodes, is_direct
from .scene_record import TraceSettings, sun_vectors
from .spectral_products import ProductTable
from .truth_layers import light_shares, share_weights

__all__ = ["Lighting", "make_lighting", "source_spectra", "traced_sun"]


_SAME_DIRECTION = 0.01  # degree


def traced_sun(atmosphere: Atmosphere, settings: TraceSettings) -> int:
    """Return the number of the traced sun that shines in an atmosphere; without direct light the nearest.

    Raises
    ------
    SchemaError
        No sun was traced where the atmosphere has it, or no overcast sky where it has one.
    """
    towards = sun_vectors([(atmosphere.sun_zenith, atmosphere.sun_azimuth)])
    apart = np.degrees(
        2 * np.arcsin(np.linalg.norm(sun_vectors(settings.suns) - towards, axis=1).clip(0, 2) / 2)
    )
    nearest = int(apart.argmin())
    if apart[nearest] > _SAME_DIRECTION and atmosphere.sun.any():
        there = ", ".join(f"({zenith:g}, {azimuth:g})" for zenith, azimuth in settings.suns)
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has its sun at (zenith, azimuth) = "
            f"({atmosphere.sun_zenith:g}, {atmosphere.sun_azimuth:g}) degrees; traced were {there}; "
            "trace the scene with this sun as well"
        )
    if atmosphere.overcast_share > 0 and atmosphere.sky.any() and not settings.overcast:
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has an overcast share of {atmosphere.overcast_share:.3g}, "
            "but no overcast sky was traced; trace the scene with overcast=True"
        )
    return nearest


def source_spectra(atmosphere: Atmosphere, settings: TraceSettings) -> dict[int, Floats]:
    """Return the irradiance of every source of a trace that shines, by number, on the atmosphere's grid.

    Raises
    ------
    SchemaError
        As `traced_sun`.
    """
    sun = traced_sun(atmosphere, settings)
    share = atmosphere.overcast_share
    made = {SKY: atmosphere.sky * (1.0 - share), FIRST_SUN + sun: atmosphere.sun}
    if share > 0:
        made[OVERCAST_SKY] = atmosphere.sky * share
    return made


@dataclass(frozen=True, eq=False)
class Lighting:
    """What all tasks of a relighting share.

    Attributes
    ----------
    table
        Products of paths.
    direct, diffuse : (band, cross_track or 1)
        Level irradiance as the bands see it [W m-2 nm-1].
    extinction, path_radiance : (band, cross_track or 1), float32
        Of the air before the camera [m-1], [W m-2 sr-1 nm-1 m-1].
    """

    table: ProductTable
    direct: Floats
    diffuse: Floats
    extinction: Floats32
    path_radiance: Floats32

    def surface_radiance(self, weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
        """Return what the scene sends to the camera, (line, band, column) [W m-2 sr-1 nm-1].

        Parameters
        ----------
        weight, code : (line, slot, column)
            As traced.
        variation : (line, 2)
            Factors of direct and diffuse light; None for ones.
        """
        lines, _, columns = weight.shape
        out = np.empty((lines, self.table.bands.wavelength.size, columns), np.float32)
        self.table.mix(_varied(weight, code, variation), code, out)
        return out

    def at_sensor(self, surface: Floats32, distance: Floats32, *, in_place: bool = False) -> Floats32:
        """Return L exp(-k d) + Lp d, the radiance behind a distance d of air; NaN, the sky, has none."""
        if not (self.extinction.any() or self.path_radiance.any()):
            return surface
        from hyperpaint.simulation.transport.air import through_air

        out = surface if in_place else np.empty_like(surface)
        through_air(surface, self.extinction, self.path_radiance, distance, out)
        return out

    def reflectance(self, surface: Floats32, variation: Floats | None) -> Floats32:
        """Return pi L / E of what the scene sends to the camera [1]; NaN where there is no light."""
        out = np.empty_like(surface)
        factors = np.ones((len(surface), 2)) if variation is None else variation
        for line, (direct, diffuse) in enumerate(factors):
            light = self.direct * direct + self.diffuse * diffuse
            scale = np.divide(np.pi, light, out=np.full_like(light, np.nan), where=light > 0)
            np.multiply(surface[line], scale.astype(np.float32), out=out[line])
        return out

    def shares(self, weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
        """Return where the light came from, (line, share, column); see `truth_layers.SHARES`."""
        from hyperpaint.simulation.transport.mixing import index_paths, mix

        distinct, index = index_paths(code)
        node = int(np.abs(self.table.bands.nodes).argmin())
        level = self.table.rows(distinct)[node].mean(axis=1, dtype=np.float64)
        parts = share_weights(distinct, level.astype(np.float32))
        sums = np.empty((len(weight), parts.shape[1], weight.shape[2]), np.float32)
        mix(_varied(weight, code, variation), index, parts, sums)
        return light_shares(sums)


def _varied(weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
    if variation is None:
        return weight
    factors = variation.astype(np.float32)[:, :, None, None]
    return np.asarray(weight * np.where(is_direct(code), factors[:, 0], factors[:, 1]))


def make_lighting(
    bands: BandSet,
    codes: PathCodes,
    atmosphere: Mapping[str, Floats],
    sources: Mapping[int, Floats],
    factors: Floats,
    sun_cosine: float,
) -> Lighting:
    """Return the light, the spectra and the camera of a relighting, as its tasks need them.

    Parameters
    ----------
    bands
        Of the camera.
    codes
        How paths are numbered.
    atmosphere
        ``wavelength`` [nm], ``extinction`` and ``path_radiance``, as in `Atmosphere`.
    sources
        From `source_spectra`.
    factors : (factor, grid)
        All factors on the grid of `BandResponses`.
    sun_cosine
        Cosine of the zenith angle of the traced sun.
    """
    wavelength = atmosphere["wavelength"]
    table = ProductTable.of(bands, codes, wavelength, sources, lambda _grid: factors)
    responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])))
    air = [
        cell_means(wavelength, atmosphere[name], responses.fine) for name in ("extinction", "path_radiance")
    ]
    extinction, path = table.to_columns(responses.means(np.stack(air))).astype(np.float32)
    light = {number: table.to_columns(table.irradiance(number)) for number in sources}
    direct = sum((light[number] for number in light if number >= FIRST_SUN), np.zeros(1)) * sun_cosine
    diffuse = sum((light[number] for number in light if number < FIRST_SUN), np.zeros(1))
    return Lighting(table, np.asarray(direct), np.asarray(diffuse), extinction, path)
