"""Light, spectra and camera of a relighting, and the radiance of a block of traced lines.

A path of weight ``w`` adds ``w E(lambda)/pi x product of its factors`` to the radiance of a pixel. The term
after ``w`` depends only on the path's code, of which a scene has some thousands: it is computed once for
every code and band, and cached.

Shares of light are shares of the radiance at the surface, before the air, as a mean over all bands at the
wavelengths of the centre column. Shares of sun and sky add up to 1; glint, mirrored sky and indirect light
are disjoint parts of them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array, Floats, Floats32, Ints
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.transport.mixing import (
    Texture,
    index_paths,
    integrate_bands,
    mix,
    mix_shifted,
    through_air,
)
from hyperpaint.simulation.transport.path_codes import (
    CLEAR_SKY_FUNCTIONS,
    FIRST_CLEAR_SKY,
    FIRST_SUN,
    OVERCAST_SKY,
    SKY,
    SOURCES,
    PathCodes,
    is_direct,
    is_indirect,
    is_mirrored,
    source_of,
)

from .camera_bands import BandResponses, BandSet, cell_means
from .four_curves import Atmosphere
from .scene_record import TraceSettings, sun_vectors

#: Layers with the shares of light in a pixel by source.
SHARES = ("sun_share", "sky_share", "glint_share", "mirrored_sky_share", "indirect_share")

_MAX_SUN_ANGLE_DEG = 0.01  # between the sun of an atmosphere and the traced sun


def traced_sun(atmosphere: Atmosphere, settings: TraceSettings) -> int:
    """Return the number of the traced sun of an atmosphere; without direct light, of the nearest sun.

    Raises
    ------
    SchemaError
        The sun of the atmosphere, or its overcast or clear sky, was not traced.
    """
    towards = sun_vectors([(atmosphere.sun_zenith, atmosphere.sun_azimuth)])
    angles = np.degrees(
        2 * np.arcsin(np.linalg.norm(sun_vectors(settings.suns) - towards, axis=1).clip(0, 2) / 2)
    )
    nearest = int(angles.argmin())
    has_clear_sky = bool((atmosphere.sky * (atmosphere.molecular + atmosphere.aureole)).any())
    if angles[nearest] > _MAX_SUN_ANGLE_DEG and (atmosphere.sun.any() or has_clear_sky):
        traced_directions = ", ".join(f"({zenith:g}, {azimuth:g})" for zenith, azimuth in settings.suns)
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has its sun at (zenith, azimuth) = "
            f"({atmosphere.sun_zenith:g}, {atmosphere.sun_azimuth:g}) degrees",
            expected=f"a traced sun: {traced_directions}",
            mend="trace the scene with this sun as well",
            code="sun-not-traced",
        )
    if atmosphere.overcast_share > 0 and atmosphere.sky.any() and not settings.overcast:
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has an overcast share of {atmosphere.overcast_share:.3g}, "
            "but no overcast sky was traced",
            mend="trace the scene with overcast=True",
            code="sky-not-traced",
        )
    if has_clear_sky and not settings.clear:
        raise SchemaError(
            f"atmosphere {atmosphere.name!r} has a clear sky, but no clear sky was traced",
            mend="trace the scene with clear=True",
            code="sky-not-traced",
        )
    return nearest


def source_spectra(atmosphere: Atmosphere, settings: TraceSettings) -> dict[int, Floats]:
    """Return the irradiance of every traced source that shines, by number, on the atmosphere's grid."""
    sun = traced_sun(atmosphere, settings)
    first_function = FIRST_CLEAR_SKY + CLEAR_SKY_FUNCTIONS * sun
    shares = {
        SKY: atmosphere.uniform,
        OVERCAST_SKY: np.asarray(atmosphere.overcast_share),
        first_function: atmosphere.molecular,
        first_function + 1: atmosphere.aureole,
    }
    skies = {number: atmosphere.sky * share for number, share in shares.items() if share.any()}
    return {**skies, FIRST_SUN + sun: atmosphere.sun}


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light and camera, shared by all tasks of a relighting.

    Attributes
    ----------
    table
        Products of paths.
    direct, diffuse : (band, cross_track or 1)
        Irradiance of a level surface in the bands [W m-2 nm-1].
    extinction, path_radiance : (band, cross_track or 1), float32
        Properties of the air before the camera [m-1], [W m-2 sr-1 nm-1 m-1].
    """

    table: ProductTable
    direct: Floats
    diffuse: Floats
    extinction: Floats32
    path_radiance: Floats32

    def surface_radiance(
        self, weight: Floats32, code: Array, variation: Floats | None, texture: Texture | None = None
    ) -> Floats32:
        """Return the radiance at the surface towards the camera, (line, band, column) [W m-2 sr-1 nm-1].

        Parameters
        ----------
        weight, code : (line, slot, column)
            Paths as traced.
        variation : (line, 2) or (line, 2, column)
            Factors of direct and diffuse light; None for factors of 1.
        texture
            Members of populations shown by pixels; None for the means.
        """
        lines, _, columns = weight.shape
        radiance = np.empty((lines, self.table.bands.wavelength.size, columns), np.float32)
        self.table.mix(_varied(weight, code, variation), code, radiance, texture)
        return radiance

    def at_sensor(self, surface: Floats32, distance: Floats32, *, in_place: bool = False) -> Floats32:
        # L exp(-k d) + Lp d, the radiance after a distance d of air; NaN distances have no air
        if not (self.extinction.any() or self.path_radiance.any()):
            return surface
        out = surface if in_place else np.empty_like(surface)
        through_air(surface, self.extinction, self.path_radiance, distance, out)
        return out

    def reflectance(self, surface: Floats32, variation: Floats | None) -> Floats32:
        # pi L / E of the radiance at the surface [1]; NaN without light
        factor = np.empty_like(surface)
        factors = np.ones((len(surface), 2)) if variation is None else variation
        for line, (direct, diffuse) in enumerate(factors):
            light = self.direct * direct + self.diffuse * diffuse
            scale = np.divide(np.pi, light, out=np.full_like(light, np.nan), where=light > 0)
            np.multiply(surface[line], scale.astype(np.float32), out=factor[line])
        return factor

    def shares(self, weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
        # shares of light by source, (line, share, column); see `SHARES`
        distinct, index = index_paths(code)
        node = int(np.abs(self.table.bands.nodes).argmin())
        level = self.table.rows(distinct)[node].mean(axis=1, dtype=np.float64)
        # weight of every path in the total light, and in the layers of `SHARES`
        sun, mirrored, indirect = is_direct(distinct), is_mirrored(distinct), is_indirect(distinct)
        mirror_image = mirrored & ~indirect
        all_paths = np.ones(distinct.shape, bool)
        members = [all_paths, sun, ~sun, mirror_image & sun, mirror_image & ~sun, indirect]
        terms = np.stack(
            [np.where(is_member, level.astype(np.float32), 0.0) for is_member in members], axis=1
        )
        sums = np.empty((len(weight), terms.shape[1], weight.shape[2]), np.float32)
        mix(_varied(weight, code, variation), index, terms.astype(np.float32), sums)
        total = sums[:, :1]
        return np.divide(sums[:, 1:], total, out=np.full_like(sums[:, 1:], np.nan), where=total > 0)


def _varied(weight: Floats32, code: Array, variation: Floats | None) -> Floats32:
    if variation is None:
        return weight
    factors = variation.astype(np.float32).reshape(len(weight), 2, 1, -1)
    return np.asarray(weight * np.where(is_direct(code), factors[:, 0], factors[:, 1]))


def make_lighting(
    bands: BandSet, codes: PathCodes, atmosphere: Atmosphere, settings: TraceSettings, factors: Floats
) -> Lighting:
    """Return light, spectra and camera of a relighting.

    ``factors`` (factor, grid): spectra of all factors of paths, on the grid of `BandResponses`.
    """
    wavelength, sources = atmosphere.wavelength, source_spectra(atmosphere, settings)
    sun_cosine = float(np.cos(np.radians(settings.suns[traced_sun(atmosphere, settings)][0])))
    table = ProductTable(bands, codes, wavelength, sources, lambda _grid: factors)
    responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])))
    curves = atmosphere.extinction, atmosphere.path_radiance
    air = np.stack([cell_means(wavelength, curve, responses.fine) for curve in curves])
    extinction, path = table.to_columns(responses.means(air)).astype(np.float32)
    light = {number: table.to_columns(table.irradiance(number)) for number in sources}
    suns = [number for number in light if is_direct(np.array(number))]
    direct = sum((light[number] for number in suns), np.zeros(1)) * sun_cosine
    diffuse = sum((light[number] for number in light if number not in suns), np.zeros(1))
    return Lighting(table, np.asarray(direct), np.asarray(diffuse), extinction, path)


_MAX_CACHE_BYTES = 96 * 2**20  # maximum size of cached products; others are computed whenever needed


class ProductTable:
    """Band spectra of path codes, computed when first needed.

    Products are means over the responses [W m-2 sr-1 nm-1]. With ``normalise=False`` they are integrals INT L
    R d lambda [W m-2 sr-1 count J-1] for a detector; the caller multiplies the sum over paths by the element
    factors (`Imager.element_factor`) to get the input of `simulation.camera.expected_counts`.

    Threads share a table. It can be sent to other processes, where it starts empty. Products do not depend on
    earlier or simultaneous requests.

    Parameters
    ----------
    bands
        Bands of the camera.
    codes
        Layout of the path codes.
    wavelength : (point,)
        Wavelengths of the sources, increasing [nm]; responses are cut to this range.
    sources
        Irradiance by number of the source, shape (point,) [W m-2 nm-1]: direct normal for a sun, diffuse on a
        level surface for a sky. Missing sources are dark.
    factors
        Function that returns all factors at wavelengths [nm], shape (factor, wavelength); see
        `hyperpaint.simulation.rendering.painting.factor_spectra`.
    normalise
        See `BandResponses`.

    Examples
    --------
    A grey panel of reflectance 0.4 under a sun of 1.3 W m-2 nm-1; its path has source 2 and factor 0.

    >>> light = np.array([300.0, 1100.0]), {2: np.array([1.3, 1.3])}
    >>> codes, bands = PathCodes.of(factors=1, depth=4), BandSet.nano_hyperspec()
    >>> table = ProductTable(bands, codes, *light, lambda grid: np.full((1, grid.size), 0.4))
    >>> rows = table.rows(np.array([codes.code(2, (0,))]))
    >>> rows.shape, rows.dtype, round(float(rows[0, 0, 0]), 6)  # (node, path, band), 0.4 x 1.3 / pi
    ((1, 1, 272), dtype('float32'), 0.165521)
    """

    def __init__(
        self,
        bands: BandSet,
        codes: PathCodes,
        wavelength: Floats,
        sources: Mapping[int, Floats],
        factors: Callable[[Floats], Floats],
        *,
        normalise: bool = True,
    ) -> None:
        self.bands, self.codes = bands, codes
        responses = BandResponses(bands, (float(wavelength[0]), float(wavelength[-1])), normalise=normalise)
        means = {
            number: cell_means(wavelength, np.asarray(spectrum, np.float64), responses.fine)
            for number, spectrum in sources.items()
        }
        lit = {number: spectrum for number, spectrum in means.items() if spectrum.any()}
        self._row_of_source = np.full(SOURCES, -1, np.int64)
        self._row_of_source[list(lit)] = np.arange(len(lit))
        spectra = np.stack([*lit.values()]) if lit else np.zeros((1, responses.fine.size))
        self._weights = responses.weights(spectra) / np.pi
        self._first_band = responses.first_band
        self._factors = np.ascontiguousarray(factors(responses.grid), np.float64)
        self._start_empty()

    def _start_empty(self) -> None:
        nodes, bands = self.bands.nodes.size, self.bands.wavelength.size
        self._cached_codes: Ints = np.empty(0, np.int64)
        self._products = np.empty((0, nodes, bands), np.float32)
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        excluded = {"_cached_codes", "_products", "_lock"}
        return {name: value for name, value in self.__dict__.items() if name not in excluded}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start_empty()

    def rows(self, codes: Ints) -> NDArray[np.float32]:
        """Return the products of paths, shape (node, path, band), float32.

        Parameters
        ----------
        codes : (path,)
            Distinct codes, without empty slots.

        Raises
        ------
        SchemaError
            A code names a factor that the scene does not have.
        """
        codes = np.ascontiguousarray(codes, np.int64)
        with self._lock:
            cached_codes, products = self._cached_codes, self._products
        rows = _lookup(cached_codes, codes)
        new_codes = np.flatnonzero(rows < 0)
        if not new_codes.size:
            return np.ascontiguousarray(products[rows].swapaxes(0, 1))
        new_products = self._compute_products(codes[new_codes])
        self._add_to_cache(codes[new_codes], new_products)
        gathered = np.empty((codes.size, *new_products.shape[1:]), np.float32)
        is_cached = rows >= 0
        gathered[is_cached], gathered[new_codes] = products[rows[is_cached]], new_products
        return np.ascontiguousarray(gathered.swapaxes(0, 1))

    def to_columns(self, at_nodes: Floats) -> Floats:
        # interpolate values at nodes (..., node, band) to columns, (..., band, cross_track)
        if self.bands.wavelength_shift is None:
            return np.moveaxis(at_nodes, -2, -1)
        first, weight = self.bands.between_nodes()
        at_columns = sum(at_nodes[..., first + j, :] * weight[:, j, None] for j in range(4))
        return np.moveaxis(np.asarray(at_columns), -2, -1)

    def mix(
        self,
        weight: NDArray[np.float32],
        codes: Ints,
        out: NDArray[np.float32],
        texture: Texture | None = None,
    ) -> None:
        """Write the sum of weight x product over the paths of every pixel, with the smile of the columns.

        Parameters
        ----------
        weight, codes : (line, slot, column)
            Paths as traced; empty slots add nothing.
        out : (line, band, column)
            Result, in the units of the table.
        texture
            Members of populations shown by pixels; None for the means.
        """
        distinct, index = index_paths(codes)
        lit = self._row_of_source[source_of(distinct)] >= 0
        if not lit.all():  # skip paths from dark sources
            new_index = np.append(np.where(lit, np.cumsum(lit) - 1, -1), -1).astype(np.int32)
            distinct, index = distinct[lit], new_index[index]
        products = self.rows(distinct)
        columns = out.shape[2]
        nodes = np.zeros(columns, np.int64), np.ones((columns, 1))
        if self.bands.wavelength_shift is not None:
            nodes = self.bands.between_nodes()
        if texture is not None:
            texture = texture._replace(paths=self.codes.factors(distinct))
        mix_shifted(weight, index, products, *nodes, out, texture)

    def irradiance(self, source: int) -> Floats:
        # Irradiance of a source in the bands, shape (node, band).
        return np.pi * self.rows(np.array([source], np.int64))[:, 0].astype(np.float64)

    def _compute_products(self, codes: Ints) -> NDArray[np.float32]:
        out = np.empty((self.bands.nodes.size, codes.size, self.bands.wavelength.size), np.float32)
        chosen, source = self.codes.factors(codes), self._row_of_source[source_of(codes)]
        if chosen.max(initial=-1) >= len(self._factors):
            raise SchemaError(
                f"a path code names spectrum {chosen.max()}",
                expected=f"a number below {len(self._factors)}, the spectra of the scene",
                mend="trace the scene again: transport_path is damaged, or belongs to another scene",
                code="path-code-unknown",
            )
        integrate_bands(self._factors, chosen, source, self._weights, self._first_band, out)
        return out.swapaxes(0, 1)

    def _add_to_cache(self, codes: Ints, products: NDArray[np.float32]) -> None:
        with self._lock:
            if self._products.nbytes + products.nbytes > _MAX_CACHE_BYTES:
                return
            new = _lookup(self._cached_codes, codes) < 0  # another thread may have made them meanwhile
            all_codes = np.concatenate([self._cached_codes, codes[new]])
            order = np.argsort(all_codes)
            self._cached_codes = all_codes[order]
            self._products = np.concatenate([self._products, products[new]])[order]


def _lookup(sorted_codes: Ints, codes: Ints) -> Ints:
    # -1 for codes that are not in the array.
    if not sorted_codes.size:
        return np.full(codes.shape, -1, np.int64)
    index = np.searchsorted(sorted_codes, codes).clip(max=sorted_codes.size - 1)
    return np.where(sorted_codes[index] == codes, index, -1)
