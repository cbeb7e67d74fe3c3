"""Exploring a flight line in a notebook, or a store in a browser (extra ``interactive``).

`Explored` is the state, without widgets: pictures, spectra, flags, regions and similar paints; `Explorer` is
the widget.
"""

import contextlib
import functools
import html
import itertools
import os
import secrets
import signal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, TypeVar
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    Array,
    Floats,
    PaintError,
    Quality,
    SchemaError,
    StoreError,
    as_path,
    documented,
    good_bands,
    is_plain_file,
    needs_extra,
    one_of,
    rename_to_roles,
    schema,
)
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import digest_of_file
from hyperpaint.io.library import open_library
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.light.daylight_colours import encode_srgb, srgb_weights
from hyperpaint.paints.paint_libraries import search_library, starter_library
from hyperpaint.paints.signatures.extraction import EXCLUDED
from hyperpaint.paints.signatures.pixel_statistics import excluded_of, summarise
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.pixel_reading import coarse, pixels
from hyperpaint.radiometry.spectral_axis import at, bands_at
from hyperpaint.radiometry.uncertainty import UNCERTAINTIES, mean_uncertainty
from hyperpaint.regions import Region, Regions, pixels_of, regions_from, write_regions
from hyperpaint.regions.polygons import contains, renumbered

from .figures import map_dims, orientation_of
from .plot import (
    STRETCH,
    flag_label,
    linear_srgb,
    percent,
    quantity_label,
    reduced_lines,
    shown_quantity,
    stored_picture,
    visible_bands,
    with_shown_cube,
)

# Recipe of a picture: empty for true colour, else the wavelengths of one or three bands [nm]
TRUE_COLOUR: tuple[float, ...] = ()
INFRARED = (860.0, 650.0, 550.0)

DETAIL_LINES = 1536  # maximum number of lines that a picture reads completely; more are subsampled
_VIEW = SimpleNamespace(
    sparse_lines=48,  # number of lines of a subsampled picture
    visible_bands=24,  # bands read for a detailed true-colour picture: colour matching functions are smooth
    max_uncertainty_pixels=4096,  # maximum size of a region whose uncertainty is computed on a click
    flag_opacity=170,  # of 255
    max_near_factor=2.0,  # factor of brightness up to which a paint is near
)
SPARSE_STEP = 64  # step [lines] from which `pixels` reads single chunks
MAX_REGION_PIXELS = 20_000  # maximum number of pixels for a region's spectrum; larger regions are subsampled
_CUBES = {"counts", "radiance", "reflectance", "values"}  # "values": quantity unknown
MAX_NEAR_ANGLE = 5.0  # spectral angle up to which a paint of the library is near [degree]
_RECIPES = {"true colour": TRUE_COLOUR, "colour infrared": INFRARED}


T = TypeVar("T")
Place = tuple[int, int] | Region  # position of a pixel along and across the track, or a region
Lines = tuple[int, int, int]  # first, end and step, as of a slice


class Picture(NamedTuple):
    # Picture of lines ``first`` to ``last - 1``, flown to the right
    rgba: npt.NDArray[np.uint32]  #: (column, line)
    first: int
    last: int
    text: str  #: Subsampling of the picture; empty if every line is shown


class Spectrum(NamedTuple):
    # Reflectance of a pixel, or the median over the pixels of a region.
    wavelength: Floats  #: (band,) [nm]: for a pixel the wavelengths of its column
    reflectance: Array  #: (band,) [1]: NaN in bad bands
    spread: Floats | None  #: (2, band): 5 and 95 % of a region's pixels
    text: str  #: Place or number of pixels, and their flags


class NearPaint(NamedTuple):
    # A paint of the library that is similar to a spectrum
    name: str
    angle: float  #: Spectral angle [degree]
    factor: float  #: Scales the paint to the brightness of the spectrum
    wavelength: Floats
    reflectance: Floats  #: Multiplied by the factor


class Explored:
    # An opened flight line and the regions drawn on it, in positions on the picture.
    # Takes the arguments of `hyperpaint.pictures.explore`. ``drawn`` holds the regions of this line in
    # positions on the picture; ``others`` the regions of other flight lines, which are saved with them.
    def __init__(
        self,
        line: xr.Dataset,
        regions: Any = None,
        *,
        library: xr.Dataset | None = None,
        flightline: str = "",
        exclude: Quality | int | None = None,
    ) -> None:
        # positions on the picture count from 0; regions of the user have the line and column numbers of the
        # line
        self._numbered = rename_to_roles(line)
        SchemaError.raise_if(
            not {ALONG_TRACK, CROSS_TRACK} <= set(self._numbered.dims),
            f"dims ({', '.join(map(str, line.dims))})",
            expected="a flight line (along_track, cross_track) or a map (y, x)",
            code="dim-missing",
        )
        is_upright = False
        self.is_map = bool(map_dims(self._numbered))
        if self.is_map:
            # columns of a map run to the right, as the lines of a flight
            is_upright = self._numbered.sizes[ALONG_TRACK] > 1 and bool(np.diff(self._numbered["y"][:2]) > 0)
            self._numbered = self._numbered.rename({ALONG_TRACK: CROSS_TRACK, CROSS_TRACK: ALONG_TRACK})
            self._numbered = self._numbered.drop_vars(("x", "y", "spatial_ref"), errors="ignore")
        self.line = self._numbered.drop_vars((ALONG_TRACK, CROSS_TRACK), errors="ignore")
        if not _CUBES & set(self.line.variables):
            schema.require(self.line, ["reflectance"], "an explorer")
        self.has_wavelength = "wavelength" in self.line.variables
        if not self.has_wavelength:  # bands by their numbers, from 1
            numbers = np.arange(1.0, self.line.sizes[BAND] + 1.0)
            self.line = self.line.assign_coords(wavelength=(BAND, numbers, {"units": "nm"}))
        quantity = shown_quantity(self.line)
        self.is_reflectance = quantity == "reflectance"
        self.quantity = "reflectance factor [1]"
        if not self.is_reflectance or ("reflectance" in self.line and "irradiance" not in self.line):
            # a cube that is not computed from counts and light, under the name of reflectance
            shown, _ = with_shown_cube(self.line)
            self.quantity = quantity_label(shown[quantity])
            self.line = shown.drop_vars(_CUBES, errors="ignore").assign(
                reflectance=shown[quantity].assign_attrs(units="1")
            )
        self.shape = self.line.sizes[ALONG_TRACK], self.line.sizes[CROSS_TRACK]
        orientation = orientation_of(self._numbered)
        self.aspect, self.is_mirrored = orientation.aspect, is_upright or orientation.is_mirrored
        self.wavelength = np.asarray(
            schema.require(self.line, ["wavelength"], "an explorer")["wavelength"].values, np.float64
        )
        self.recipes = {name: recipe for name, recipe in _RECIPES.items() if self.has_bands(recipe)}
        if "true colour" not in self.recipes and self.wavelength.size > 2:
            three = np.nanquantile(self.wavelength, (0.75, 0.5, 0.25), method="nearest").tolist()
            self.recipes[", ".join(map(self.band_text, three))] = tuple(three)
        self.library = library
        self.flightline = flightline
        self._excluded = int(EXCLUDED if exclude is None else exclude)
        # checksums of region files, taken before the regions are read: changes by other programs are kept
        self._digests: dict[str, str] = {}
        if isinstance(regions, str | os.PathLike) and is_plain_file(regions):
            with contextlib.suppress(OSError):  # reading the regions reports an unreadable file
                self._digests[os.path.realpath(regions)] = digest_of_file(as_path(regions))
        line_regions, self.others = regions_on(regions, flightline or str(line.attrs.get("name", "")))
        self.drawn = renumbered(line_regions, self._numbered, back=True)
        self._saved_digest = self._all_regions.digest
        self._linear = functools.lru_cache(6)(self._read_linear)
        self._spectra: dict[Any, Spectrum] = {}
        self._uncertainties: dict[Any, tuple[Floats, str]] = {}

    @property
    def regions(self) -> Regions:
        # Regions drawn, in sensor coordinates: x is cross_track, y is along_track, whole pixels.
        return renumbered(self.drawn, self._numbered)

    @property
    def _all_regions(self) -> Regions:
        return Regions((*self.regions, *self.others)) if self.others else self.regions

    @property
    def is_saved(self) -> bool:
        # Whether the regions are unchanged since they were read or last saved
        return self._all_regions.digest == self._saved_digest

    def band_text(self, wavelength: float) -> str:
        # Return a band by its wavelength, or by its number where no wavelengths are known
        return f"{wavelength:.1f} nm" if self.has_wavelength else f"band {wavelength:.0f}"

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        # Write the regions of this and of other lines as GeoJSON; see `hyperpaint.write_regions`.
        SchemaError.raise_if(
            self.is_map,
            "regions drawn on a map are not saved",
            expected="a flight line",
            mend="draw them on the flight line",
            code="line-is-map",
        )
        file = write_regions(self._all_regions, path, overwrite=overwrite)
        self._digests[os.path.realpath(file)] = digest_of_file(file)
        self._saved_digest = self._all_regions.digest
        return file

    def save_again(self, path: Path) -> Path:
        # Save to a new file, or replace a file; `StoreError` if another program has changed it
        is_old = is_plain_file(path)
        digest = self._digests.get(os.path.realpath(path))
        StoreError.raise_if(
            is_old and digest != digest_of_file(path),
            f"{path} was {'not read or saved here' if digest is None else 'changed by another program'}, "
            "so regions are not saved to it",
            mend="move it away or choose another file, and save again",
            option="move it away and save again, or begin anew with --regions and another file",
            code="file-changed",
        )
        return self.save(path, overwrite=is_old)

    # --- regions -------------------------------------------------------------------------------------------

    def add(self, along: Sequence[float], across: Sequence[float]) -> str | None:
        # Add a region with these corners; return its name, or None if the corners enclose no area
        corners = corners_at(along, across, self.shape)
        if corners is None:
            return None
        taken = self._all_regions.names
        name = next(name for number in itertools.count(1) if (name := f"region {number}") not in taken)
        self.drawn = Regions((*self.drawn, Region(name, corners, flightline=self.flightline)))
        return name

    def move(self, name: str, along: Sequence[float], across: Sequence[float]) -> bool:
        # Move the corners of a region; return False if the new corners enclose no area
        corners = corners_at(along, across, self.shape)
        if corners is not None:
            self._replace(name, polygon=corners)
        return corners is not None

    def rename(self, name: str, new: str) -> str | None:
        # Rename a region; return the problem if that fails, else None
        regions = self.drawn
        try:
            self._replace(name, name=new.strip())
            _ = self._all_regions  # raises if a region of another line has this name
        except PaintError as error:
            self.drawn = regions
            return str(error)
        return None

    def drop(self, name: str) -> None:
        # Remove a region
        self.drawn = Regions(tuple(region for region in self.drawn if region.name != name))

    def _replace(self, old_name: str, **changes: Any) -> None:
        self.drawn = Regions(
            tuple(replace(region, **changes) if region.name == old_name else region for region in self.drawn)
        )

    # --- spectra -------------------------------------------------------------------------------------------

    def spectrum_of(self, place: Place) -> Spectrum | str:
        # Return the spectrum of a pixel or the median spectrum of a region, or a message with the problem.
        # The spectrum of a pixel equals ``line.paint.pixels(along, across)`` bit for bit. Flagged pixels of a
        # region are excluded as in signatures.
        return _cached(self._spectra, self._spectrum, place)

    def uncertainty_of(self, place: Place) -> tuple[Floats, str] | str:
        # Return the standard uncertainty of a pixel or of a region's mean (band,) [1], and a text with its
        # median over the bands and missing parts; or a message with the problem.
        return _cached(self._uncertainties, self._uncertainty, place)

    def _spectrum(self, place: Place) -> Spectrum:
        if isinstance(place, Region):
            along, across, step = self._region_pixels(place)
            lines = slice(int(along.min()), int(along.max()) + 1, step)
            window = pixels(self.line, lines, slice(int(across.min()), int(across.max()) + 1))
            indices = (along - lines.start) // step, across - int(across.min())
            values = window["reflectance"].transpose(ALONG_TRACK, CROSS_TRACK, BAND).values[indices]
            flags = (
                window["quality"].values[indices] if "quality" in window else np.zeros(along.size, np.uint16)
            )
            is_used = (flags & excluded_of(place, self._excluded)) == 0
            flag_texts = [
                f"{flag_label(flag)} {percent(share)}" for flag, share in schema.flag_shares(flags).items()
            ]
            SchemaError.raise_if(
                not is_used.any(),
                f"{place.name}: all {along.size} pixels are excluded: {', '.join(flag_texts)}",
                code="region-empty",
            )
            quantiles = summarise(values[is_used], "median")["reflectance_quantiles"]
            quantiles[:, ~good_bands(self.line)] = np.nan
            pixel_text = f"{along.size} pixels" + (f" (every {step}. line)" if step > 1 else "")
            text = f"median of {int(is_used.sum())} of {pixel_text}: {', '.join(flag_texts) or 'no flag'}"
            if np.isfinite(quantiles).any():
                lower, upper = (float(f"{np.nanmedian(edge):.2g}") for edge in (quantiles[0], quantiles[-1]))
                text += f"; 90 % of them from {lower:g} to {upper:g} in the median band"
            return Spectrum(self.wavelength, quantiles[2], quantiles[[0, -1]], text)
        row, column = place
        pixel = pixels(self.line, row, column)
        shift = pixel["wavelength_shift"].values if "wavelength_shift" in pixel.coords else 0.0
        values = np.where(good_bands(self.line), pixel["reflectance"].values, np.float32(np.nan))
        rows, columns = (schema.numbers_of(self._numbered, dim) for dim in (ALONG_TRACK, CROSS_TRACK))
        names = ("column", "row") if self.is_map else ("line", "column")
        text = f"{names[0]} {rows[row]:g}, {names[1]} {columns[column]:g}"
        if "quality" in pixel:
            flags = ", ".join(schema.flag_names(int(pixel["quality"]))).replace("_", " ")
            text += f": {flags or 'no flag'}"
        return Spectrum(self.wavelength + shift, values, None, text)

    def _region_pixels(self, region: Region) -> tuple[Array, Array, int]:
        # pixels along and across the track, in every ``step``-th line of a large region
        along, across = pixels_of(Regions((Region(region.name, region.polygon),)), self.line)[0]
        SchemaError.raise_if(
            not along.size,
            f"{region.name} contains no pixel centre",
            mend="draw it larger",
            code="region-empty",
        )
        step = -(-along.size // MAX_REGION_PIXELS)
        is_read = (along - along.min()) % step == 0
        return along[is_read], across[is_read], step

    def _uncertainty(self, place: Place) -> tuple[Floats, str]:
        SchemaError.raise_if(
            not self.is_reflectance,
            f"this is {self.quantity}",
            expected="reflectance",
            code="variable-missing",
        )
        along, across, step = (
            self._region_pixels(place) if isinstance(place, Region) else (*np.array(place).reshape(2, 1), 1)
        )
        SchemaError.raise_if(
            along.size > _VIEW.max_uncertainty_pixels or step > 1,
            f"{along.size} pixels",
            expected=f"at most {_VIEW.max_uncertainty_pixels}",
            mend="see line.paint.signatures",
            code="region-too-large",
        )
        lines, columns = (slice(int(place.min()), int(place.max()) + 1) for place in (along, across))
        window = reflectance(self.line.isel({ALONG_TRACK: lines, CROSS_TRACK: columns}), uncertainty=True)
        # computed together, because separate computations would read the same counts again
        names = {"reflectance", *UNCERTAINTIES, "quality"} & set(window.data_vars)
        window = window.assign(dict(window[list(names)].compute().data_vars))
        in_region = np.zeros((window.sizes[ALONG_TRACK], window.sizes[CROSS_TRACK]), bool)
        in_region[along - lines.start, across - columns.start] = True
        if isinstance(place, Region) and "quality" in window.variables:
            in_region &= (window["quality"].values & excluded_of(place, self._excluded)) == 0
        is_used = window["reflectance"].isel({BAND: 0}, drop=True).copy(data=in_region)
        mean = mean_uncertainty(window.assign(reflectance=window["reflectance"].where(is_used)))
        random, systematic = (mean[name].values for name in ("u_random", "u_systematic"))
        has_systematic = bool(np.isfinite(systematic).any())
        # without systematic errors, the random errors are shown
        u = np.hypot(random, np.nan_to_num(systematic)) if has_systematic else random
        subject = "a pixel" if along.size == 1 else "the mean, without the differences of pixels,"
        return u, f"± {np.nanmedian(u):.1g} [1], k = 1, of {subject} in the median band" + (
            "" if has_systematic else "; systematic errors are unknown"
        )

    # --- paints --------------------------------------------------------------------------------------------

    def near_paints(self, spectrum: Spectrum, count: int = 5) -> list[NearPaint]:
        # Return the paints that are near by spectral angle and brightness, the nearest first.
        # None for other cubes than reflectance, and with fewer than five good bands.
        if self.library is None or not self.is_reflectance or not self.has_wavelength:
            return []
        target = xr.DataArray(
            spectrum.reflectance,
            dims=BAND,
            coords={"wavelength": (BAND, spectrum.wavelength, {"units": "nm"})},
        )
        try:
            matches = search_library(self.library, like=target, maximum_angle=np.radians(MAX_NEAR_ANGLE))
        except PaintError:
            return []
        # resample the spectrum to the bands of the library
        library_nm = np.asarray(matches["wavelength"].values, np.float64)
        order = np.argsort(spectrum.wavelength, kind="stable")
        nm, values = (np.asarray(values, np.float64)[order] for values in spectrum[:2])
        is_finite = np.isfinite(nm) & np.isfinite(values)
        resampled = np.interp(library_nm, nm[is_finite], values[is_finite], left=np.nan, right=np.nan)
        near_paints = []
        for number, angle in enumerate(matches["spectral_angle"].values.tolist()):
            paint = matches["reflectance"].values[number].astype(np.float64)
            is_common = np.isfinite(resampled) & np.isfinite(paint)
            power = max(paint[is_common] @ paint[is_common], np.finfo(float).tiny)
            factor = float((resampled[is_common] @ paint[is_common]) / power)
            name = str(matches[schema.SIGNATURE].values[number])
            if np.isfinite(angle) and 1.0 / _VIEW.max_near_factor <= factor <= _VIEW.max_near_factor:
                near_paints.append(
                    NearPaint(name, float(np.degrees(angle)), factor, library_nm, factor * paint)
                )
        return near_paints[:count]

    # --- pictures ------------------------------------------------------------------------------------------

    def picture(
        self,
        recipe: tuple[float, ...] = TRUE_COLOUR,
        stretch: tuple[float, float] = STRETCH,
        window: tuple[int, int] | None = None,
    ) -> Picture:
        # Return a picture of some lines, by default of all.
        # Up to 1536 lines are read completely. Of more lines, the picture is the stored overview (true
        # colour), else the stored means of blocks of pixels, else a subsample of lines. Black and white are
        # percentiles (``stretch``) of brightness over the complete flight line; pixels without a value are
        # transparent, saturated pixels white.
        first, last = self._window(window)
        is_sparse = last - first > DETAIL_LINES
        if is_sparse and recipe == TRUE_COLOUR and stretch == STRETCH:
            overview = stored_picture(self.line, None)
            if overview is not None:
                line_step = -(-self.shape[0] // overview.sizes[ALONG_TRACK])
                rows = slice(first // line_step, -(-last // line_step))
                colours = np.asarray(overview.isel({ALONG_TRACK: rows}).values)
                edges = rows.start * line_step, min(rows.stop * line_step, self.shape[0])
                return Picture(_rgba(colours), *edges, f"overview, every {line_step}. line")
        if is_sparse and self._means is not None:
            side = int(self._means["reflectance"].attrs["block_side"])
            rows = slice(first // side, -(-last // side))
            linear = np.repeat(self._linear(None, recipe)[rows], side, axis=1)[:, : self.shape[1]]
            first, step, text = rows.start * side, side, f"means of {side} x {side} pixels"
        else:
            step = self._line_step(last - first)
            linear = self._linear((first, last, step), recipe)
            text = f"every {step}. line; zoom in for all" if is_sparse else ""
        black, white = self._levels(recipe, stretch)
        colours = encode_srgb(((linear - black) / np.maximum(white - black, 1e-6)).clip(0.0, 1.0))
        last = first + step * len(linear)
        is_opaque = np.asarray(np.isfinite(linear).all(axis=-1))
        if self._quality is not None and len(self._quality[first:last:step]) == len(linear):
            # saturated pixels, such as glints, are white
            is_saturated = (self._quality[first:last:step] & int(Quality.SATURATED)) != 0
            colours[is_saturated & ~is_opaque] = 1.0
            is_opaque |= is_saturated
        return Picture(_rgba(colours, is_opaque), first, last, text)

    def _window(self, window: tuple[int, int] | None) -> tuple[int, int]:
        first, last = (0, self.shape[0]) if window is None else window
        first = min(max(0, first), self.shape[0] - 1)
        return first, max(first + 1, min(last, self.shape[0]))

    @staticmethod
    def _line_step(lines: int) -> int:
        return max(SPARSE_STEP, -(-lines // _VIEW.sparse_lines)) if lines > DETAIL_LINES else 1

    @functools.cached_property
    def _means(self) -> xr.Dataset | None:
        # stored means of blocks of pixels; None if the store has no such means
        if "coarse_reflectance" not in self.line.variables:
            return None
        means = coarse(self.line)
        return means if means["reflectance"].attrs["level"] == "stored" else None

    def _read_linear(self, lines: Lines | None, recipe: tuple[float, ...]) -> Array:
        # linear sRGB (line, column, 3) of some lines, or with ``lines`` None of the stored means
        if recipe != TRUE_COLOUR:
            values = self._bands(lines, recipe)
            return np.broadcast_to(values, (*values.shape[:2], 3))
        visible = visible_bands(self.wavelength)
        nm = np.sort(self.wavelength[visible[:: max(1, visible.size // _VIEW.visible_bands)]])
        values = self._bands(lines, nm).swapaxes(1, 2)
        linear = linear_srgb(values, weights=srgb_weights(nm, None))
        linear[np.isnan(values).all(axis=1)] = np.nan
        return linear

    def _bands(self, lines: Lines | None, wavelength: Any) -> Array:
        # reflectance (line, column, band) of some lines, or with ``lines`` None of the stored means
        nm = list(wavelength)
        values = (
            at(self._means, nm)["reflectance"]
            if lines is None and self._means is not None
            else pixels(self.line, slice(*(lines or (None,))), wavelength=nm)["reflectance"]
        )
        return np.asarray(values.transpose(ALONG_TRACK, CROSS_TRACK, BAND).values)

    def _levels(self, recipe: tuple[float, ...], stretch: tuple[float, float]) -> tuple[Array, Array]:
        # levels shown black and white, by colour, from lines spread over the flight line
        step = self._line_step(self.shape[0])
        lines = (0, self.shape[0], step) if step == 1 or self._means is None else None
        linear = self._linear(lines, recipe).reshape(-1, 3)
        linear = linear[np.isfinite(linear).all(axis=1)]
        if recipe == TRUE_COLOUR:
            linear = np.repeat(linear.mean(axis=1, keepdims=True), 3, axis=1)
        levels = np.percentile(linear if linear.size else np.zeros((1, 3)), stretch, axis=0)
        return levels[0].astype(np.float32), levels[1].astype(np.float32)

    def has_bands(self, recipe: tuple[float, ...]) -> bool:
        # Return whether the line has the bands of a recipe
        try:
            bands_at(self.line, list(recipe))
            has_colour = self.has_wavelength and bool(visible_bands(self.wavelength).size)
            return has_colour if recipe == TRUE_COLOUR else self.has_wavelength
        except SchemaError:
            return False

    # --- flags ---------------------------------------------------------------------------------------------

    @functools.cached_property
    def _quality(self) -> Array | None:
        quality = self.line.get("quality")
        return None if quality is None else np.asarray(quality.transpose(ALONG_TRACK, CROSS_TRACK).values)

    @functools.cached_property
    def flag_shares(self) -> dict[Quality, float]:
        # Share of all pixels with each flag that occurs; empty without flags
        return {} if self._quality is None else schema.flag_shares(self._quality)

    def flag_picture(self, flags: Iterable[Quality], window: tuple[int, int] | None = None) -> Picture:
        # Return the flags of some lines in their colours, transparent elsewhere, the rarest on top
        first, last = self._window(window)
        step = -(-(last - first) // DETAIL_LINES)
        last = min(first + step * -(-(last - first) // step), self.shape[0])
        rows = -(-(last - first) // step)
        colours = np.zeros((self.shape[1], rows, 4), np.uint8)
        if self._quality is not None:
            bits = reduced_lines(self._quality[first:last], step, np.bitwise_or)
            for flag in sorted(flags, key=lambda flag: -self.flag_shares.get(flag, 0.0)):
                colours[(bits.T & int(flag)) != 0] = (*bytes.fromhex(flag.colour[1:]), _VIEW.flag_opacity)
        return Picture(colours.view(np.uint32)[..., 0], first, first + rows * step, "")


def _cached(results: dict[Any, T], compute: Callable[[Place], T], place: Place) -> T | str:
    key = place.polygon.tobytes() if isinstance(place, Region) else place
    if key not in results:
        try:
            results[key] = compute(place)
        except PaintError as error:
            return str(error)
    return results[key]


def _rgba(picture: Array, is_opaque: Array | None = None) -> npt.NDArray[np.uint32]:
    # pixels as bokeh draws them: columns of the flight line are rows, lines run to the right
    colours = np.full((*picture.shape[:2], 4), 255, np.uint8)
    colours[..., :3] = (np.nan_to_num(picture).clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    if is_opaque is not None:
        colours[..., 3] = np.where(is_opaque, 255, 0)
    return np.ascontiguousarray(colours.swapaxes(0, 1)).view(np.uint32)[..., 0]


# --- regions drawn on a flight line ------------------------------------------------------------------------


def corners_at(along: Sequence[float], across: Sequence[float], shape: tuple[int, int]) -> Floats | None:
    """Return clicked places as corners of a polygon: pixel centres inside the line, without repeated corners.

    ``along`` and ``across`` are the clicked positions, ``shape`` is lines and columns. Returns (vertex, 2),
    x (cross_track) and y (along_track); None if the corners enclose no area.

    Examples
    --------
    >>> corners_at([1.2, 8.9, 5.0, 5.0], [-0.4, 0.4, 7.7, 7.8], (100, 50)).tolist()
    [[0.0, 1.0], [0.0, 9.0], [8.0, 5.0]]
    """
    corners = np.column_stack([np.asarray(across, np.float64), np.asarray(along, np.float64)])
    if not len(corners) or not np.isfinite(corners).all():
        return None
    corners = np.clip(np.floor(corners + 0.5), 0, [shape[1] - 1, shape[0] - 1])
    # a double click adds its corner twice
    corners = corners[(corners != np.roll(corners, 1, axis=0)).any(axis=1)]
    if len(corners) < 3:
        return None
    x, y = corners.T
    return corners if x @ np.roll(y, -1) != y @ np.roll(x, -1) else None


def regions_on(regions: Any, flightline: str) -> tuple[Regions, tuple[Region, ...]]:
    """Return the regions of one flight line, and the regions of other lines.

    An empty ``flightline`` takes all regions as its own. Raises `SchemaError` for regions in map coordinates
    or with holes.

    Examples
    --------
    >>> corners = [(0, 0), (4, 0), (4, 3)]
    >>> given = [Region("a", corners), Region("b", corners, flightline="raw_1")]
    >>> outlines, others = regions_on(given, "raw_0")
    >>> outlines.names, [region.name for region in others]
    (('a',), ['b'])
    """
    outlines = Regions(()) if regions is None else regions_from(regions)
    SchemaError.raise_if(
        outlines.coordinates != "sensor",
        "the regions passed to the explorer are in map coordinates",
        expected="coordinates of the sensor (column and line)",
        code="region-coordinates",
    )
    lines = {"", flightline.replace(" ", "_")}
    others = [
        region for region in outlines if flightline and region.flightline.replace(" ", "_") not in lines
    ]
    if others:
        names = {region.name for region in others}
        outlines = Regions(tuple(region for region in outlines if region.name not in names))
    SchemaError.raise_if(
        holed := [region.name for region in outlines if region.holes],
        f"regions with holes cannot be drawn: {', '.join(holed)}",
        mend="leave them out",
        code="region-holes",
    )
    return outlines, tuple(others)


# --- figures of the explorer in bokeh, with their data sources ---------------------------------------------


# colours of the regions, in turn
COLOURS = ("#e6550d", "#1f9ed1", "#31a354", "#c51b8a", "#a6761d", "#6a51a3", "#d7b600", "#17becf")
INK = {"light": "#1a1a1a", "dark": "#f2f2f2"}  # text colour of each theme
NEAR_COLOUR = "#8c8c8c"
DASHES = ("dashed", "dotted", "dotdash", "dashdot", "solid")
PICTURE_HEIGHT, NAVIGATOR_HEIGHT, SPECTRA_HEIGHT = 380, 60, 330
_MAX_PICTURE_HEIGHT = 600  # of a short line

# keeps pixels square (by their aspect ratio on the ground) in every width, and short lines whole
_FIT = """
const {x_range, y_range, inner_width, inner_height} = plot;
if (!inner_width || !inner_height) return;
const whole = inner_width * columns / (lines * aspect);
const height = Math.round(Math.min(most, Math.max(inner_width < 500 ? 220 : least, whole)));
const tall = height + plot.height - inner_height;
if (plot.sizing_mode && Math.abs(tall - plot.height) > 1) { plot.height = tall; return; }
const across = Math.abs(y_range.end - y_range.start);
const along = across * inner_width / inner_height / aspect;
const first = along > lines ? (lines - along) / 2 - 0.5 : x_range.start;
x_range.setv({start: first, end: first + along});
"""
# reports the lines in view 120 ms after the last change; the frame of the navigator changes the lines alone
_WATCH = """
const {x_range, y_range, inner_width, inner_height} = plot;
const across = (x_range.end - x_range.start) * aspect * inner_height / inner_width;
const middle = (y_range.start + y_range.end) / 2, sign = Math.sign(y_range.end - y_range.start);
if (inner_width && Math.abs(across / Math.abs(y_range.end - y_range.start) - 1) > 1e-3)
  y_range.setv({start: middle - sign * across / 2, end: middle + sign * across / 2});
const timers = (window.hyperpaint_timers = window.hyperpaint_timers || {});
clearTimeout(timers[plot.id]);
timers[plot.id] = setTimeout(() => {
  view.data = {along: [plot.x_range.start, plot.x_range.end]};
}, 120);
"""


_IMAGE, _PLACES = ("image", "x", "y", "dw", "dh"), ("along", "across")
#: Data sources of the figures, with their columns.
_SOURCES = {
    # pictures of the complete line, of the lines in view, and of their flags
    **dict.fromkeys(("base", "detail", "flags"), _IMAGE),
    # regions, the polygon in progress, handles of the selected region, and the last click
    "outlines": (*_PLACES, "name", "colour", "width"),
    **dict.fromkeys(("draft", "corners", "spot"), _PLACES),
    "view": ("along",),  # first and last line in view
    "curves": ("nm", "reflectance", "name", "colour", "width", "dash"),
    # spread over the pixels of regions, and uncertainty of a curve
    **dict.fromkeys(("spreads", "uncertainty"), ("nm", "reflectance", "colour")),
}


def band_around(wavelength: Array, lower: Array, upper: Array) -> dict[str, Array]:
    # Return the outline of the area between two curves, over wavelengths where both are finite
    is_finite = np.isfinite(lower) & np.isfinite(upper)
    nm = wavelength[is_finite]
    return {
        "nm": np.concatenate([nm, nm[::-1]]),
        "reflectance": np.concatenate([lower[is_finite], upper[is_finite][::-1]]),
    }


# --- the widget, made with panel and bokeh (extra ``interactive``) ------------------------------------------


_MODES = {"Spectrum": "spectrum", "Draw": "draw", "Edit": "edit", "Move": "move"}
_HELP = {
    "spectrum": "Click for the spectrum of a pixel, drag for the median of a box; the wheel zooms",
    "draw": "Click the corners of a region, double-click the last one",
    "edit": "Click a region to select it, drag its corners",
    "move": "Drag to move the picture; the wheel or two fingers zoom",
}
_ONE_BAND = "one band"
_UNIT_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
FULL_WIDTH = {"sizing_mode": "stretch_width"}


class Explorer:
    """A widget that shows a flight line; see `explore`.

    ``view`` is the panel layout, which ``panel serve`` can show. With ``save_to`` regions are saved only to
    this file.
    """

    def __init__(self, state: Explored, *, theme: str = "light", save_to: Path | None = None) -> None:
        import panel
        from bokeh.events import DoubleTap, SelectionGeometry, Tap
        from bokeh.models import (
            BoxSelectTool,
            ColumnDataSource,
            CustomJS,
            HoverTool,
            PanTool,
            PointDrawTool,
            Range1d,
            RangeTool,
            Span,
        )
        from bokeh.plotting import figure

        panel.extension()  # loads scripts into a notebook
        self._state, self._theme, self._save_to = state, theme, save_to
        self._is_updating = False
        self._window: tuple[int, int] | None = None
        self._sources = {
            name: ColumnDataSource({column: [] for column in columns}) for name, columns in _SOURCES.items()
        }
        # the last clicked pixel or box, or the name of the selected region; at first the central column
        lines, columns = state.shape
        self._selected: Place | str | None = (min(lines, columns) // 2, columns // 2)
        # the picture of the line, flown to the right, and a small picture of the complete line below
        sources = self._sources
        # the flight is to the right, so that columns on its right side are below
        edges = (-0.5, columns - 0.5)[:: 1 if self._state.is_mirrored else -1]
        # a short line leaves no margin
        width = int(_MAX_PICTURE_HEIGHT * lines * self._state.aspect / columns) + 120
        self._plot = plot = figure(
            name="picture",
            height=PICTURE_HEIGHT,
            tools="wheel_zoom,reset",
            active_scroll="wheel_zoom",
            x_axis_label="column" if self._state.is_map else "line, flown to the right",
            y_axis_label="row, north is up" if self._state.is_map else "column",
            max_width=max(width, 300),
            x_range=Range1d(-0.5, min(lines, 2 * columns) - 0.5),
            y_range=Range1d(*edges),
            **FULL_WIDTH,
        )
        for name in ("base", "detail", "flags"):
            plot.image_rgba(*_IMAGE, source=sources[name], level="image")
        plot.patches(
            *_PLACES,
            source=sources["outlines"],
            fill_color="colour",
            line_color="colour",
            fill_alpha=0.2,
            line_width="width",
        )
        for colour, width in (("black", 4), ("white", 2)):
            for name in ("draft", "spot"):
                plot.line(*_PLACES, source=sources[name], line_color=colour, line_width=width)
        style = {"fill_color": "white", "line_color": "black"}
        plot.scatter(*_PLACES, source=sources["draft"], size=7, **style)
        handles = plot.scatter(*_PLACES, source=sources["corners"], size=10, **style)
        # effects of dragging on the picture: select, edit or move
        pan = PanTool(visible=False)
        self._tools = {
            "spectrum": BoxSelectTool(renderers=[], visible=False),
            "draw": pan,
            "edit": PointDrawTool(renderers=[handles], add=False, empty_value=0, visible=False),
            "move": pan,
        }
        plot.add_tools(*dict.fromkeys(self._tools.values()))
        plot.toolbar.active_drag = self._tools["spectrum"]
        self._set_style(plot)
        plot.grid.visible = False
        size: dict[str, Any] = {
            "plot": plot,
            "view": sources["view"],
            "aspect": self._state.aspect,
            "lines": lines,
            "columns": columns,
            "least": PICTURE_HEIGHT - 60,
            "most": _MAX_PICTURE_HEIGHT,
        }
        calls = {_WATCH: (plot.x_range, "start", "end"), _FIT: (plot, "inner_width", "inner_height")}
        for code, (model, *names) in calls.items():
            for name in names:
                model.js_on_change(name, CustomJS(args=size, code=code))
        # the complete line, with a draggable frame around the lines in view
        self._navigator = small = figure(
            name="navigator",
            height=NAVIGATOR_HEIGHT,
            tools="",
            x_range=Range1d(-0.5, lines - 0.5),
            y_range=Range1d(*edges),
            toolbar_location=None,
            **FULL_WIDTH,
        )
        small.image_rgba(*_IMAGE, source=sources["base"], level="image")
        small.axis.visible = small.grid.visible = False
        small.min_border = 0
        tool = RangeTool(x_range=plot.x_range)
        tool.overlay.update(fill_color="white", fill_alpha=0.3, line_color="white", line_width=2)
        small.add_tools(tool)
        small.outline_line_color = small.border_fill_color = small.background_fill_color = None
        # curves of reflectance, the spread over pixels of regions, and the uncertainty of a curve
        self._spectra = chart = figure(
            name="spectra",
            height=SPECTRA_HEIGHT,
            tools="pan,box_zoom,reset",
            x_axis_label="wavelength [nm]" if self._state.has_wavelength else "band",
            y_axis_label=self._state.quantity.replace("$^{", "^").replace("}$", ""),
            **FULL_WIDTH,
        )
        axes = ("nm", "reflectance")
        for name, alpha in (("spreads", 0.12), ("uncertainty", 0.35)):
            chart.patches(
                *axes, source=self._sources[name], fill_color="colour", fill_alpha=alpha, line_alpha=0.0
            )
        curves = chart.multi_line(
            *axes,
            source=self._sources["curves"],
            line_color="colour",
            line_width="width",
            line_dash="dash",
        )
        # the wavelength of the band shown in the picture
        self._shown_band = Span(dimension="height", line_color=NEAR_COLOUR, line_dash="dotted", visible=False)
        chart.add_layout(self._shown_band)
        value = "$y{0.000}" if self._state.is_reflectance else "$y{0.[000]}"
        tips = {
            "": "@name",
            "nm" if self._state.has_wavelength else "band": "$x{0.0}",
            self._state.quantity.partition(" [")[0]: value,
        }
        chart.add_tools(HoverTool(renderers=[curves], tooltips=list(tips.items())))
        self._set_style(chart)
        self._make_widgets()
        plot.on_event(Tap, lambda event: self.tap(event.x, event.y))
        plot.on_event(DoubleTap, lambda event: self.close(event.x, event.y))
        plot.on_event(SelectionGeometry, lambda event: self.drag(event.geometry) if event.final else None)
        self._spectra.on_event(Tap, lambda event: self.take_band(event.x))
        self._sources["corners"].on_change("data", self._corners_changed)
        self._sources["view"].on_change("data", self._view_changed)
        for widget, name, call in (
            (self._widgets.mode, "value", lambda _: self._change_mode()),
            (self._widgets.recipe, "value", lambda _: self._update_pictures()),
            (self._widgets.stretch, "value_throttled", lambda _: self._update_pictures()),
            (self._widgets.band, "value_throttled", lambda event: self.take_band(event.new)),
            (self._widgets.flag_boxes, "value", lambda _: self._update_flags()),
            (self._widgets.region_menu, "value", lambda event: self._select(event.new)),
            (self._widgets.name, "value", lambda event: self._rename(event.new)),
            (self._widgets.paint_boxes, "value", lambda _: self._update_spectra()),
        ):
            widget.param.watch(self._unless_updating(call), name)
        for button, press in (
            (self._widgets.box_button, self._box_to_region),
            (self._widgets.undo_button, lambda: self._change_draft(-1)),
            (self._widgets.remove_button, self._remove_region),
            (self._widgets.save_button, self._write_regions),
        ):
            button.on_click(self._unless_updating(lambda _, press=press: press()))
        self._update_pictures()
        self._select(state.drawn.names[-1] if len(state.drawn) else None)

    @property
    def regions(self) -> Regions:
        # Regions drawn, in sensor coordinates: x is cross_track, y is along_track, whole pixels.
        return self._state.regions

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        # Write the regions as GeoJSON; see `hyperpaint.write_regions`.
        return self._state.save(path, overwrite=overwrite)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        return self.view._repr_mimebundle_(include, exclude)

    # --- figures ------------------------------------------------------------------------------------------

    def _set_style(self, plot: Any) -> None:
        plot.toolbar.logo = None
        plot.border_fill_color = plot.background_fill_color = plot.outline_line_color = None
        for part in (
            "axis_label_text",
            "major_label_text",
            "axis_line",
            "major_tick_line",
            "minor_tick_line",
        ):
            setattr(plot.axis, f"{part}_color", INK[self._theme])
        plot.grid.grid_line_color, plot.grid.grid_line_alpha = NEAR_COLOUR, 0.3

    # --- widgets and layout -------------------------------------------------------------------------------

    def _make_widgets(self) -> None:
        import panel

        def make(kind: str, text: str, **options: Any) -> Any:
            widget = getattr(panel.widgets, kind)
            # panel is renaming the argument
            return widget(**{"label" if "label" in widget.param else "name": text}, **options, **FULL_WIDTH)

        state = self._state
        bands = sorted(set(np.round(state.wavelength[np.isfinite(state.wavelength)], 1).tolist()))
        flags = {f"{flag_label(flag)}, {percent(share)}": flag for flag, share in state.flag_shares.items()}
        file = "regions.geojson" if self._save_to is None else str(self._save_to)
        self._widgets = SimpleNamespace(
            mode=make("RadioButtonGroup", "", options=_MODES, value="spectrum"),
            recipe=make("Select", "Colours", options=[*state.recipes, _ONE_BAND]),
            band=make(
                "DiscreteSlider",
                "Band [nm]" if state.has_wavelength else "Band",
                options=bands,
                value=min(bands, key=lambda band: abs(band - 650.0)),
                formatter="%.1f" if state.has_wavelength else "%.0f",
            ),
            stretch=make("RangeSlider", "Black and white [percentile]", start=0, end=100, value=(2, 98)),
            flag_boxes=make("CheckBoxGroup", "", options=flags),
            region_menu=make("Select", "Region", options=[]),
            name=make("TextInput", "Name"),
            box_button=make("Button", "Box to region", disabled=True),
            undo_button=make("Button", "Undo corner", disabled=True),
            remove_button=make("Button", "Remove"),
            file=make("TextInput", "File", value=file, disabled=self._save_to is not None),
            save_button=make("Button", "Save regions"),
            paint_boxes=make("CheckBoxGroup", "", options={}),
            **{
                name: panel.pane.HTML("", **FULL_WIDTH)
                for name in ("spectrum", "message", "caption", "paints")
            },
        )

        # layout of the widgets
        def pane(figure: Any) -> Any:
            return panel.pane.Bokeh(figure, **FULL_WIDTH)

        def column(flex: str, *parts: Any) -> Any:
            return panel.Column(*parts, styles={"flex": flex, "min-width": "0"}, **FULL_WIDTH)

        def card(title: str, *parts: Any) -> Any:
            return column("1 1 230px", panel.pane.HTML(f"<b>{title}</b>", **FULL_WIDTH), *parts)

        lines, columns = state.shape
        navigator = [pane(self._navigator)] if lines > 3 * columns else []
        flag_card = (
            self._widgets.flag_boxes
            if state.flag_shares
            else panel.pane.HTML("no flags stored", **FULL_WIDTH)
        )
        buttons = panel.Row(
            self._widgets.box_button, self._widgets.undo_button, self._widgets.remove_button, **FULL_WIDTH
        )
        self.view = panel.Column(
            panel.FlexBox(
                column("3 1 340px", self._widgets.mode, pane(self._plot), *navigator, self._widgets.caption),
                column(
                    "2 1 320px",
                    self._widgets.spectrum,
                    pane(self._spectra),
                    self._widgets.paints,
                    self._widgets.paint_boxes,
                ),
                **FULL_WIDTH,
            ),
            panel.FlexBox(
                card("Picture", self._widgets.recipe, self._widgets.band, self._widgets.stretch),
                card("Flags", flag_card),
                card("Regions", self._widgets.region_menu, self._widgets.name, buttons),
                card("Save", self._widgets.file, self._widgets.save_button, self._widgets.message),
                **FULL_WIDTH,
            ),
            **FULL_WIDTH,
        )

    def _unless_updating(self, call: Any) -> Any:
        # ignores events of widgets that this class is setting
        import panel

        def run(event: Any) -> None:
            if not self._is_updating:
                # panel runs the call when it holds the lock of the figures' document
                panel.state.execute(lambda: call(event), schedule=True)

        return run

    # --- events of the mouse -------------------------------------------------------------------------------

    def tap(self, along: float, across: float) -> None:
        # Handle a click on the picture: select a pixel, add a corner, or select a region to edit.
        pixel = int(np.floor(along + 0.5)), int(np.floor(across + 0.5))
        mode = self._widgets.mode.value
        if mode == "draw":
            self._change_draft(None, (along, across))
        elif mode == "edit":
            spot = np.array([across]), np.array([along])
            names = [region.name for region in self._state.drawn if contains(region.polygon, (), *spot)[0]]
            self._select(names[-1] if names else self._widgets.region_menu.value)
        elif all(0 <= number < size for number, size in zip(pixel, self._state.shape, strict=True)):
            self._selected = pixel
            self._select(None)

    def drag(self, geometry: dict[str, Any]) -> None:
        # Show the median spectrum of a box dragged over the picture.
        if self._widgets.mode.value != "spectrum" or geometry.get("type") != "rect":
            return
        ranges = []
        for axis, size in zip("xy", self._state.shape, strict=True):
            minimum, maximum = sorted((geometry[f"{axis}0"], geometry[f"{axis}1"]))
            ranges.append((max(0, int(np.ceil(minimum))), min(size - 1, int(np.floor(maximum)))))
        along, across = ranges
        if along[0] > along[1] or across[0] > across[1]:
            return
        # extend the box by a quarter of a pixel, so that a box of one line contains its pixel centres
        corners = [(across[a] + a / 2 - 0.25, along[b] + b / 2 - 0.25) for a, b in _UNIT_SQUARE]
        self._selected = Region("box", np.array(corners))
        self._select(None)

    def close(self, along: float, across: float) -> None:
        # Add the last corner of the polygon in progress, and make it a region.
        if self._widgets.mode.value == "draw":
            self.tap(along, across)
            draft = self._sources["draft"].data
            # the polygon is not finished while its corners enclose no area
            if self._add_region(draft["along"], draft["across"]):
                self._change_draft(0)

    def take_band(self, wavelength: float) -> None:
        # Show the band nearest to a wavelength [nm].
        self._is_updating = True
        self._widgets.band.value = min(self._widgets.band.options, key=lambda band: abs(band - wavelength))
        self._widgets.recipe.value = _ONE_BAND
        self._is_updating = False
        self._update_pictures()

    def _box_to_region(self) -> None:
        if isinstance(self._selected, Region):
            across, along = self._selected.polygon.T.tolist()
            self._add_region(along, across)

    def _add_region(self, along: list[float], across: list[float]) -> bool:
        name = self._state.add(along, across)
        self._select(name or self._widgets.region_menu.value)
        if name is None:
            self._show_message(
                "these corners enclose no area: a region needs three corners that are not on a line"
            )
        return name is not None

    def _change_draft(self, stop: int | None, *new_corners: tuple[float, float]) -> None:
        draft = self._sources["draft"].data
        self._sources["draft"].data = {
            name: [*draft[name][:stop], *(corner[axis] for corner in new_corners)]
            for axis, name in enumerate(("along", "across"))
        }
        self._widgets.undo_button.disabled = not self._sources["draft"].data["along"]

    def _change_mode(self) -> None:
        self._plot.toolbar.active_drag = self._tools[self._widgets.mode.value]
        self._change_draft(0)
        self._update_caption()
        self._select(self._widgets.region_menu.value)

    def _corners_changed(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002 (bokeh asks for these names)
        name = self._widgets.region_menu.value
        if not self._is_updating and name is not None:
            self._state.move(name, list(new["along"]), list(new["across"]))
            self._select(name)

    def _rename(self, new: str) -> None:
        name = self._widgets.region_menu.value
        if name is not None and new != name:
            problem = self._state.rename(name, new)
            self._select(new.strip() if problem is None else name)
            self._show_message(problem or self._region_count())

    def _remove_region(self) -> None:
        if self._widgets.region_menu.value is not None:
            self._state.drop(self._widgets.region_menu.value)
            self._select(None)

    def _write_regions(self) -> None:
        file = self._save_to or Path(self._widgets.file.value)
        try:
            text = f"{self._region_count()} saved in {self._state.save_again(file)}"
        except PaintError as error:
            text = error.text(on_command_line=self._save_to is not None)
        except OSError as error:
            text = str(error)
        self._show_message(text)

    def _view_changed(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002
        first, last = new["along"]
        window = int(np.floor(first)), int(np.ceil(last)) + 1
        if window != self._window:
            self._window = window
            self._update_pictures(base=False)

    # --- display ----------------------------------------------------------------------------------------

    def _show_message(self, text: str) -> None:
        self._widgets.message.object = html.escape(text)

    def _region_count(self) -> str:
        count = len(self._state.drawn)
        other_count = len(self._state.others)
        return f"{count} region{'' if count == 1 else 's'}" + f" (and {other_count} of other lines)" * bool(
            other_count
        )

    def _update_pictures(self, *, base: bool = True) -> None:
        # update the lines in view; with ``base`` also the picture of the complete line behind them
        recipe = (
            (self._widgets.band.value,)
            if self._widgets.recipe.value == _ONE_BAND
            else self._state.recipes.get(self._widgets.recipe.value, ())
        )
        try:
            if base:
                self._show_picture("base", self._state.picture(recipe, self._widgets.stretch.value))
            detail = self._state.picture(recipe, self._widgets.stretch.value, self._window)
        except PaintError as error:
            self._widgets.caption.object = html.escape(str(error))
            return
        self._show_picture("detail", detail)
        is_one_band = len(recipe) == 1
        colours = self._state.band_text(recipe[0]) if is_one_band else self._widgets.recipe.value
        quantity = "" if self._state.is_reflectance else f" of {self._state.quantity.partition(' [')[0]}"
        lines = f"{'columns' if self._state.is_map else 'lines'} {detail.first} to {detail.last - 1}"
        self._caption = ", ".join(filter(None, (colours + quantity, lines, detail.text)))
        self._update_caption()
        self._update_flags()
        self._shown_band.update(visible=is_one_band, location=recipe[0] if is_one_band else 0.0)

    def _show_picture(self, name: str, picture: Picture | None) -> None:
        # put a picture into a data source; None empties the source
        values: list[Any] = []
        if picture is not None:
            columns, lines = picture.rgba.shape[0], picture.last - picture.first
            values = [picture.rgba, picture.first - 0.5, -0.5, lines, columns]
        self._sources[name].data = {column: values[at : at + 1] for at, column in enumerate(_IMAGE)}

    def _show_rows(self, name: str, rows: list[dict[str, Any]]) -> None:
        self._sources[name].data = {column: [row[column] for row in rows] for column in _SOURCES[name]}

    def _update_caption(self) -> None:
        self._widgets.caption.object = (
            f"{html.escape(_HELP[self._widgets.mode.value])}.<br><small>{self._caption}</small>"
        )

    def _update_flags(self) -> None:
        flags = self._widgets.flag_boxes.value
        self._show_picture("flags", self._state.flag_picture(flags, self._window) if flags else None)

    def _select(self, name: str | None) -> None:
        # select a region, which is drawn bold, with handles in edit mode; None selects no region
        regions = self._state.drawn
        selected_name = name if name in regions.names else None
        if selected_name is not None or isinstance(self._selected, str):
            self._selected = selected_name
        edited = [
            region.polygon
            for region in regions
            if region.name == selected_name and self._widgets.mode.value == "edit"
        ]
        along, across = (edited[0][:, axis].tolist() if edited else [] for axis in (1, 0))
        self._is_updating = True
        try:
            self._widgets.region_menu.options = [None, *regions.names]
            self._widgets.region_menu.value = selected_name
            self._widgets.name.value = selected_name or ""
            self._sources["corners"].data = {"along": along, "across": across}
        finally:
            self._is_updating = False
        self._widgets.name.disabled = self._widgets.remove_button.disabled = selected_name is None
        self._widgets.box_button.disabled = not isinstance(self._selected, Region)
        self._sources["outlines"].data = {
            "along": [region.polygon[:, 1].tolist() for region in regions],
            "across": [region.polygon[:, 0].tolist() for region in regions],
            "name": list(regions.names),
            "colour": [_colour(number) for number in range(len(regions))],
            "width": [3 if region.name == selected_name else 1.5 for region in regions],
        }
        self._show_message(self._region_count() + ("" if self._state.is_saved else ", not saved"))
        self._update_spectra()

    @property
    def _selected_place(self) -> Place | None:
        name = self._selected
        return {region.name: region for region in self._state.drawn}[name] if isinstance(name, str) else name

    def _update_spectra(self) -> None:
        import panel

        rows: list[tuple[Spectrum, str, str, float]] = []
        for number, region in enumerate(self._state.drawn):
            spectrum = self._state.spectrum_of(region)
            if isinstance(spectrum, Spectrum):
                rows.append(
                    (spectrum, region.name, _colour(number), 3 if region.name == self._selected else 1.5)
                )
        clicked = self._selected_place
        spectrum_now = None if clicked is None else self._state.spectrum_of(clicked)
        if isinstance(spectrum_now, Spectrum) and not isinstance(self._selected, str):
            rows.append((spectrum_now, "clicked", INK[self._theme], 2))
        spreads = [
            {**band_around(spectrum.wavelength, *spectrum.spread), "colour": colour}
            for spectrum, _, colour, _ in rows
            if spectrum.spread is not None
        ]
        curves = [_curve(spectrum, name, colour, width, "solid") for spectrum, name, colour, width in rows]
        # list the most similar paints, and draw the ticked ones
        near_paints = self._state.near_paints(spectrum_now) if isinstance(spectrum_now, Spectrum) else []
        self._widgets.paints.object = (
            "<b>Nearest paints</b>: spectral angle, and scale factor"
            if near_paints
            else f"<b>No paint is near</b>: within {MAX_NEAR_ANGLE:g}° and "
            f"a factor of {_VIEW.max_near_factor:g}"
            if self._state.is_reflectance and self._state.library is not None
            else ""
        )
        self._is_updating = True
        self._widgets.paint_boxes.options = {
            f"{paint.name}: {paint.angle:.1f}°, x {paint.factor:.2f}": i
            for i, paint in enumerate(near_paints)
        }
        self._is_updating = False
        curves += [
            _curve(near_paints[i], near_paints[i].name, NEAR_COLOUR, 1.5, DASHES[i % len(DASHES)])
            for i in self._widgets.paint_boxes.value
            if i < len(near_paints)
        ]
        self._show_rows("spreads", spreads)
        self._show_rows("curves", curves)
        self._show_rows("uncertainty", [])
        name = f"{self._selected}: " if isinstance(self._selected, str) else ""
        text = (
            spectrum_now.text
            if isinstance(spectrum_now, Spectrum)
            else spectrum_now or "Click on the picture for a spectrum"
        )
        self._widgets.spectrum.object = html.escape(name + text)
        # the last click, outlined by its corners
        corners = (
            np.array([(clicked[1] + a - 0.5, clicked[0] + b - 0.5) for a, b in _UNIT_SQUARE])
            if isinstance(clicked, tuple)
            else clicked.polygon
            if isinstance(clicked, Region)
            else np.zeros((0, 2))
        )
        across, along = np.vstack([corners, corners[:1]]).T.tolist()
        self._sources["spot"].data = {"along": along, "across": across}
        if isinstance(spectrum_now, Spectrum):
            # show the curve before its uncertainty is computed
            panel.state.execute(self._update_uncertainty, schedule=True)

    def _update_uncertainty(self) -> None:
        clicked = self._selected_place
        spectrum = None if clicked is None else self._state.spectrum_of(clicked)
        if clicked is None or not isinstance(spectrum, Spectrum) or not self._state.is_reflectance:
            return
        uncertainty = self._state.uncertainty_of(clicked)
        name = f"{self._selected}: " if isinstance(self._selected, str) else ""
        if isinstance(uncertainty, str):
            text = f"uncertainty unknown: {uncertainty.splitlines()[-1].strip()}"
        else:
            u, text = uncertainty
            colour = (
                _colour(self._state.drawn.names.index(self._selected))
                if isinstance(self._selected, str)
                else INK[self._theme]
            )
            outline = band_around(spectrum.wavelength, spectrum.reflectance - u, spectrum.reflectance + u)
            self._show_rows("uncertainty", [{**outline, "colour": colour}])
        self._widgets.spectrum.object = (
            f"{html.escape(name + spectrum.text)}<br><small>{html.escape(text)}</small>"
        )


def _curve(spectrum: Spectrum | NearPaint, name: str, colour: str, width: float, dash: str) -> dict[str, Any]:
    return {
        "nm": spectrum.wavelength,
        "reflectance": spectrum.reflectance,
        "name": name,
        "colour": colour,
        "width": width,
        "dash": dash,
    }


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


# --- in a notebook, or in a browser ------------------------------------------------------------------------


@documented(line="dataset")
def explore(
    line: xr.Dataset,
    regions: Any = None,
    *,
    library: xr.Dataset | str | os.PathLike[str] | None = None,
    flightline: str = "",
    exclude: Quality | int | None = None,
    theme: Literal["light", "dark"] = "light",
) -> Explorer:
    """Show a flight line in an interactive widget: bands, spectra, flags, regions, similar paints.

    Click on the picture for the spectrum of a pixel, drag for the median of a box. Draw polygons, which
    become regions; name them, drag their corners, save them.

    Parameters
    ----------
    line
    regions
        Regions to show and edit, in sensor coordinates, see `hyperpaint.read_regions`; also the proposals of
        `hyperpaint.regions.propose_regions`.
    library
        A paint library, or its path, whose paints are compared with clicked spectra; by default
        `hyperpaint.paints.starter_library`, of synthetic paints.
    flightline
        Name of the flight line, which new regions get; needed to combine regions of several lines. Regions of
        other flight lines are hidden, and saved with the others.
    exclude
    theme
        Theme of the figures, ``"light"`` or ``"dark"``.

    Returns
    -------
    Explorer
        Show it as the last line of a cell; ``.regions`` holds the regions drawn.

    Raises
    ------
    MissingExtraError
        panel or bokeh is not installed.
    SchemaError
        Reflectance or wavelength is missing, or the regions are not in sensor coordinates.

    Notes
    -----
    The spectrum of a pixel is bit for bit that of `hyperpaint.radiometry.pixels`. The spectrum of a region is
    the median of its pixels that are not excluded, with their 5 to 95 % range shaded. The shade around the
    last clicked curve is its standard uncertainty, k = 1, if the noise of the line is known; see
    `hyperpaint.radiometry.mean_uncertainty`.

    A notebook loads the widget's scripts from the internet, as panel does by default; without internet, set
    ``PANEL_INLINE=True`` in the environment of the kernel, which puts them into the notebook.

    Examples
    --------
    >>> from hyperpaint.regions import Region
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> grass = Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)])
    >>> explorer = explore(line, [grass])  # the last line of a cell shows it     # doctest: +SKIP
    >>> line.paint.signatures(explorer.regions).sizes["signature"]                    # doctest: +SKIP
    1
    """
    require_panel()
    one_of(theme, INK, "theme")
    if library is None:
        library = starter_library(members=0)
    elif isinstance(library, str | os.PathLike):
        library = open_library(library)
    return Explorer(
        Explored(line, regions, library=library, flightline=flightline, exclude=exclude), theme=theme
    )


def require_panel() -> None:
    # Raise `MissingExtraError` where panel or bokeh is not installed
    for package in ("panel", "bokeh"):
        with needs_extra(package, "interactive", "an explorer"):
            __import__(package)


def serve_explorer(
    store: str | os.PathLike[str],
    line: str | None = None,
    *,
    regions: str | os.PathLike[str] | None = None,
    library: str | os.PathLike[str] | None = None,
    port: int = 0,
    announce: Callable[[str], None],
) -> None:
    """Serve the explorer of a cube, or of a store's flight lines, on this machine until interrupted.

    The address contains a random token. Requests without it, for another host, or from a page of another
    origin are refused, so that other users of the machine and other pages in the browser have no access.

    Parameters
    ----------
    store
        A store with flight lines or maps, or any Zarr with a cube; or an ENVI cube, by its header or data
        file: raw counts, radiance or reflectance, also without wavelengths.
    line
        The flight line shown first; by default the first of the store. The page links to all lines.
    regions
        GeoJSON file of this line's regions, read if it exists, and written on saving. By default, and for
        other lines, ``STORE-LINE-regions.geojson`` in the current folder. Saving keeps regions of other
        flight lines in the file, and never replaces a file that another program has changed.
    library
        A paint library to compare with; by default the starter library.
    port
        Port of the server; 0 takes any free port.
    announce
        Called with the address once it is served.

    Raises
    ------
    FormatError, StoreError
        The store, the regions or the library cannot be read; or the store has no such flight line.
    MissingExtraError
        panel or bokeh is not installed.
    """
    lines = shown_lines(as_path(store))
    first_name = next(iter(lines), "") if line is None else line.rpartition("/")[2]
    StoreError.raise_if(
        first_name not in lines,
        f"{store} has no flight line {line!r:.80}" if line else f"{store} has no flight line",
        expected=", ".join(lines) or "reflectance, radiance or counts of lines, bands and columns",
        code="flightline-unknown",
    )
    require_panel()
    import panel

    paints = starter_library(members=0) if library is None else open_library(library)
    stem = as_path(store).resolve().stem

    def region_file(name: str) -> Path:
        # the name of the store is part, because lines of several stores may have the same name
        default = f"{stem}-regions.geojson" if name == stem else f"{stem}-{name}-regions.geojson"
        return Path(regions if regions is not None and name == first_name else default)

    @functools.cache
    def line_state(name: str) -> Explored:
        # all pages of a line share its state, so that regions survive reloading a page
        file = region_file(name)
        return Explored(lines[name](), file if file.exists() else None, library=paints, flightline=name)

    def page() -> Any:
        name, theme = (
            panel.state.session_args.get(key, [b""])[0].decode("utf-8", "replace")
            for key in ("line", "colours")
        )
        name, theme = name if name in lines else first_name, theme if theme in INK else "light"
        # widgets and figures read the theme when they are created
        panel.config.theme = "dark" if theme == "dark" else "default"
        return panel.Column(
            _head(line_state(name), name, lines, theme),
            Explorer(line_state(name), theme=theme, save_to=region_file(name)).view,
            **FULL_WIDTH,
        )

    line_state(first_name)  # raise reading errors before the server starts
    on_interrupt: Any = signal.getsignal(signal.SIGINT)
    token = secrets.token_urlsafe(32)
    server = panel.serve(
        {"/": page},
        port=port,
        address="127.0.0.1",
        prefix=token,
        show=False,
        start=False,
        verbose=False,
        title=f"hyperpaint {first_name}",
    )
    interrupts: list[int] = []

    def interrupt(number: int, frame: Any) -> None:
        # the loop also stops where a library loses the exception, as while kernels are compiled
        interrupts.append(number)
        server.io_loop.asyncio_loop.call_soon_threadsafe(server.io_loop.stop)
        on_interrupt(number, frame)

    # panel replaced the handler of interrupts; one that is no function ignores them
    signal.signal(signal.SIGINT, interrupt if callable(on_interrupt) else on_interrupt)
    # refuse requests to the server from elsewhere than its own page
    # The host must be this machine, which excludes rebound DNS names; the path must start with the token; a
    # websocket must have an origin; and every origin must be this server.
    from tornado.web import ErrorHandler

    application = server._tornado
    find_handler = application.find_handler
    hosts = {f"localhost:{server.port}", f"127.0.0.1:{server.port}"}

    def find_guarded(request: Any, **options: Any) -> Any:
        senders = request.headers.get_list("Origin")
        if (
            request.host.lower() in hosts
            and secrets.compare_digest("".join(request.path.split("/", 2)[1:2]).encode(), token.encode())
            and all(origin in {f"http://{host}" for host in hosts} for origin in senders)
            and (senders or "websocket" not in request.headers.get("Upgrade", "").lower())
        ):
            return find_handler(request, **options)
        return application.get_handler_delegate(request, ErrorHandler, {"status_code": 403})

    application.find_handler = find_guarded
    server.start()
    announce(f"http://localhost:{server.port}/{token}/")
    try:
        server.io_loop.start()
    finally:
        signal.signal(signal.SIGINT, on_interrupt)
    if interrupts:
        raise KeyboardInterrupt(*interrupts)


def shown_lines(path: Path) -> dict[str, Callable[[], xr.Dataset]]:
    # Return functions that open the cubes of a file or store, by name: first flight lines of the folder
    if path.is_file() and path.suffix != ".zip":
        return {path.stem: functools.partial(open_envi, path)}
    openers = {
        group: functools.partial(_open_cube, path, group)
        for group in sorted(list_groups(path), key=lambda group: not group.startswith("flightlines/"))
    }
    return {
        group.rpartition("/")[2] or path.stem: opener
        for group, opener in openers.items()
        if group.startswith("flightlines/") or _CUBES & set(opener().data_vars)
    }


def _open_cube(path: Path, group: str) -> xr.Dataset:
    # Open a group; of other programs, the only variable of lines, columns and bands is the cube
    dataset = rename_to_roles(open_store(path, group))
    cubes = {str(name) for name, array in dataset.data_vars.items() if set(schema.CUBE) == set(array.dims)}
    if len(cubes) == 1 and not cubes & _CUBES:
        return dataset.rename({cubes.pop(): "values"})
    return dataset if group.startswith("flightlines/") else dataset.drop_vars(_CUBES - cubes, errors="ignore")


def _head(state: Explored, name: str, lines: Iterable[str], theme: str) -> Any:
    import panel

    nm, (count, columns) = state.wavelength, state.shape
    other_theme = next(ink for ink in INK if ink != theme)
    links = [
        f'<a style="color:inherit" href="?line={quote(line)}&colours={theme}">{html.escape(line)}</a>'
        for line in lines
        if line != name
    ]
    links.append(
        f'<a style="color:inherit" href="?line={quote(name)}&colours={other_theme}">{other_theme}</a>'
    )
    sizes = (columns, "rows", count, "columns") if state.is_map else (count, "lines", columns, "columns")
    size = "{:,} {}, {:,} {}, ".format(*sizes) + f"{nm.size} bands"
    size += f", {np.nanmin(nm):.0f} to {np.nanmax(nm):.0f} nm" if state.has_wavelength else ", no wavelengths"
    size += f"; {state.quantity}".replace("$^{", "").replace("}$", "")
    return panel.pane.HTML(
        f"<h2 style='margin:0'>{html.escape(name)}</h2>{size} &nbsp; {' &middot; '.join(links)}", **FULL_WIDTH
    )
