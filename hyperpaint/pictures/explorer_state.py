"""State of an explorer, without widgets: pictures, spectra, flags, regions and similar paints."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import PaintError, SchemaError, StoreError
from hyperpaint.base.input_files import is_plain_file
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Quality
from hyperpaint.paints.colours import encode_srgb, srgb_weights
from hyperpaint.paints.paint_search import search_library
from hyperpaint.paints.signatures.extraction import EXCLUDED
from hyperpaint.paints.signatures.pixel_statistics import excluded_of, summarise
from hyperpaint.radiometry.coarse_lines import coarse
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.pixel_reading import pixels
from hyperpaint.radiometry.spectral_axis import at, bands_at
from hyperpaint.radiometry.uncertainty.averages import mean_uncertainty
from hyperpaint.radiometry.uncertainty.propagation import UNCERTAINTIES
from hyperpaint.regions import Region, Regions, pixels_of, regions_from, write_regions
from hyperpaint.regions.pixels_in_regions import renumbered

from .figures import map_dims, orientation_of
from .plot import STRETCH, flag_label, linear_srgb, percent, stored_picture, visible_bands
from .plot_flags import reduced_lines
from .plot_spectra import good_bands

# Recipe of a picture: empty for true colour, else the wavelengths of one or three bands [nm]
TRUE_COLOUR: tuple[float, ...] = ()
INFRARED = (860.0, 650.0, 550.0)

DETAIL_LINES = 1536  # maximum number of lines that a picture reads completely; more are subsampled
_SPARSE_LINES = 48  # number of lines of a subsampled picture
SPARSE_STEP = 64  # step [lines] from which `pixels` reads single chunks
_VISIBLE_BANDS = 24  # bands read for a detailed true-colour picture: colour matching functions are smooth
MAX_REGION_PIXELS = 20_000  # maximum number of pixels for a region's spectrum; larger regions are subsampled
_MAX_UNCERTAINTY_PIXELS = 4096  # maximum size of a region whose uncertainty is computed on a click
_FLAG_OPACITY = 170  # of 255


T = TypeVar("T")
Place = tuple[int, int] | Region  # position of a pixel along and across the track, or a region
Lines = tuple[int, int, int]  # first, end and step, as of a slice


class Picture(NamedTuple):
    """Picture of lines ``first`` to ``last - 1``, flown to the right."""

    rgba: npt.NDArray[np.uint32]  #: (column, line)
    first: int
    last: int
    text: str  #: Subsampling of the picture; empty if every line is shown


class Spectrum(NamedTuple):
    """Reflectance of a pixel, or the median over the pixels of a region."""

    wavelength: Floats  #: (band,) [nm]: for a pixel the wavelengths of its column
    reflectance: Array  #: (band,) [1]: NaN in bad bands
    spread: Floats | None  #: (2, band): 5 and 95 % of a region's pixels
    text: str  #: Place or number of pixels, and their flags


class Uncertainty(NamedTuple):
    """Standard uncertainty of a spectrum."""

    u: Floats  #: (band,) [1]: standard uncertainty
    text: str  #: Median over the bands, and missing parts


class NearPaint(NamedTuple):
    """A paint of the library that is similar to a spectrum."""

    name: str
    angle: float  #: Spectral angle [degree]
    factor: float  #: Scales the paint to the brightness of the spectrum
    wavelength: Floats
    reflectance: Floats  #: Multiplied by the factor


class Explored:
    """An opened flight line and the regions drawn on it, in positions on the picture.

    Takes the arguments of `hyperpaint.pictures.explore`.
    """

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
        self._numbered = schema.rename_to_roles(line)
        if map_dims(self._numbered):
            raise SchemaError(
                "this is a map", expected="a flight line", mend="explore the flight line", code="line-is-map"
            )
        if not {"counts", "radiance", "reflectance"} & set(self._numbered.variables):
            schema.require(self._numbered, ["reflectance"], "an explorer")
        self.line = self._numbered.drop_vars((ALONG_TRACK, CROSS_TRACK), errors="ignore")
        self.shape = self.line.sizes[ALONG_TRACK], self.line.sizes[CROSS_TRACK]
        self.orientation = orientation_of(self._numbered)
        variable = schema.require(self.line, ["wavelength"], "an explorer")["wavelength"]
        self.wavelength = np.asarray(variable.values, np.float64)
        self.library = library
        self.flightline = flightline
        self._excluded = int(EXCLUDED if exclude is None else exclude)
        self._files = RegionFiles(regions)  # takes checksums before the regions are read
        line_regions, self._others = regions_on(regions, flightline or str(line.attrs.get("name", "")))
        self._regions = renumbered(line_regions, self._numbered, back=True)
        self._saved_digest = self._all_regions.digest
        self._linear = functools.lru_cache(6)(self._read_linear)
        self._spectra: dict[Any, Spectrum] = {}
        self._uncertainties: dict[Any, Uncertainty] = {}

    @property
    def regions(self) -> Regions:
        """Regions drawn, in sensor coordinates: x is cross_track, y is along_track, whole pixels."""
        return renumbered(self._regions, self._numbered)

    @property
    def drawn(self) -> Regions:
        """Regions drawn on this line, in positions on the picture."""
        return self._regions

    @property
    def others(self) -> tuple[Region, ...]:
        """Regions of other flight lines, which are saved together with the regions of this line."""
        return self._others

    @property
    def _all_regions(self) -> Regions:
        return Regions((*self.regions, *self._others)) if self._others else self.regions

    @property
    def is_saved(self) -> bool:
        """Whether the regions are unchanged since they were read or last saved."""
        return self._all_regions.digest == self._saved_digest

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the regions of this and of other lines as GeoJSON; see `hyperpaint.write_regions`."""
        file = write_regions(self._all_regions, path, overwrite=overwrite)
        self._files.remember(file)
        self._saved_digest = self._all_regions.digest
        return file

    def save_again(self, path: Path) -> Path:
        """Save to a new file, or replace a file unless another program has changed it."""
        return self.save(path, overwrite=self._files.may_replace(path))

    # --- regions -------------------------------------------------------------------------------------------

    def add(self, along: Sequence[float], across: Sequence[float]) -> str | None:
        """Add a region with these corners; return its name, or None if the corners enclose no area."""
        corners = corners_at(along, across, self.shape)
        if corners is None:
            return None
        number = 1
        while (name := f"region {number}") in self._all_regions.names:
            number += 1
        self._regions = Regions((*self._regions, Region(name, corners, flightline=self.flightline)))
        return name

    def move(self, name: str, along: Sequence[float], across: Sequence[float]) -> bool:
        """Move the corners of a region; return False if the new corners enclose no area."""
        corners = corners_at(along, across, self.shape)
        if corners is not None:
            self._replace(name, polygon=corners)
        return corners is not None

    def rename(self, name: str, new: str) -> str | None:
        """Rename a region; return the problem if that fails, else None."""
        regions = self._regions
        try:
            self._replace(name, name=new.strip())
            _ = self._all_regions  # raises if a region of another line has this name
        except PaintError as error:
            self._regions = regions
            return str(error)
        return None

    def drop(self, name: str) -> None:
        """Remove a region."""
        self._regions = Regions(tuple(region for region in self._regions if region.name != name))

    def _replace(self, old_name: str, **changes: Any) -> None:
        self._regions = Regions(
            tuple(
                replace(region, **changes) if region.name == old_name else region for region in self._regions
            )
        )

    # --- spectra -------------------------------------------------------------------------------------------

    def spectrum_of(self, place: Place) -> Spectrum | str:
        """Return the spectrum of a pixel or the median spectrum of a region, or a message with the problem.

        The spectrum of a pixel equals ``line.paint.pixels(along, across)`` bit for bit. Flagged pixels of a
        region are excluded as in signatures.
        """
        return _cached(self._spectra, self._spectrum, place)

    def uncertainty_of(self, place: Place) -> Uncertainty | str:
        """Return the standard uncertainty of a pixel or of a region's mean, or a message with the problem."""
        return _cached(self._uncertainties, self._uncertainty, place)

    def _spectrum(self, place: Place) -> Spectrum:
        return self._median_spectrum(place) if isinstance(place, Region) else self._pixel_spectrum(*place)

    def _pixel_spectrum(self, along: int, across: int) -> Spectrum:
        pixel = pixels(self.line, along, across)
        shift = pixel["wavelength_shift"].values if "wavelength_shift" in pixel.coords else 0.0
        values = np.where(good_bands(self.line), pixel["reflectance"].values, np.float32(np.nan))
        rows, columns = (schema.numbers_of(self._numbered, dim) for dim in (ALONG_TRACK, CROSS_TRACK))
        text = f"line {rows[along]:g}, column {columns[across]:g}"
        if "quality" in pixel:
            text += f": {_flag_text(schema.flag_names(int(pixel['quality'])))}"
        return Spectrum(self.wavelength + shift, values, None, text)

    def _median_spectrum(self, region: Region) -> Spectrum:
        along, across, step = self._region_pixels(region)
        lines = slice(int(along.min()), int(along.max()) + 1, step)
        window = pixels(self.line, lines, slice(int(across.min()), int(across.max()) + 1))
        indices = (along - lines.start) // step, across - int(across.min())
        values = window["reflectance"].transpose(ALONG_TRACK, CROSS_TRACK, BAND).values[indices]
        flags = window["quality"].values[indices] if "quality" in window else np.zeros(along.size, np.uint16)
        is_used = (flags & excluded_of(region, self._excluded)) == 0
        shares = schema.flag_shares(flags)
        flag_texts = [f"{flag_label(flag)} {percent(share)}" for flag, share in shares.items()]
        if not is_used.any():
            raise SchemaError(
                f"{region.name}: all {along.size} pixels are excluded: {', '.join(flag_texts)}",
                code="region-empty",
            )
        quantiles = summarise(values[is_used], "median")["reflectance_quantiles"]
        quantiles[:, ~good_bands(self.line)] = np.nan
        subsampling = f" (every {step}. line)" if step > 1 else ""
        text = f"median of {int(is_used.sum())} of {along.size} pixels{subsampling}: {_flag_text(flag_texts)}"
        return Spectrum(self.wavelength, quantiles[2], quantiles[[0, -1]], text)

    def _region_pixels(self, region: Region) -> tuple[Array, Array, int]:
        # pixels along and across the track, in every ``step``-th line of a large region
        along, across = pixels_of(Regions((Region(region.name, region.polygon),)), self.line)[0]
        if not along.size:
            raise SchemaError(
                f"{region.name} contains no pixel centre", mend="draw it larger", code="region-empty"
            )
        step = -(-along.size // MAX_REGION_PIXELS)
        is_read = (along - along.min()) % step == 0
        return along[is_read], across[is_read], step

    def _uncertainty(self, place: Place) -> Uncertainty:
        if isinstance(place, Region):
            along, across, step = self._region_pixels(place)
        else:
            along, across, step = *np.array(place).reshape(2, 1), 1
        if along.size > _MAX_UNCERTAINTY_PIXELS or step > 1:
            raise SchemaError(
                f"{along.size} pixels",
                expected=f"at most {_MAX_UNCERTAINTY_PIXELS}",
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
        subject = "a pixel" if along.size == 1 else "the mean"
        text = f"± {np.nanmedian(u):.1g} [1], k = 1, of {subject} in the median band"
        return Uncertainty(u, text + ("" if has_systematic else "; systematic errors are unknown"))

    # --- paints --------------------------------------------------------------------------------------------

    def near_paints(self, spectrum: Spectrum, count: int = 5) -> list[NearPaint]:
        """Return the paints at the smallest spectral angles; none with fewer than five good bands."""
        wavelength = (BAND, spectrum.wavelength, {"units": "nm"})
        target = xr.DataArray(spectrum.reflectance, dims=BAND, coords={"wavelength": wavelength})
        try:
            matches = None if self.library is None else search_library(self.library, like=target, limit=count)
        except PaintError:
            matches = None
        if matches is None:
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
            if np.isfinite(angle):
                near_paints.append(
                    NearPaint(name, float(np.degrees(angle)), factor, library_nm, factor * paint)
                )
        return near_paints

    # --- pictures ------------------------------------------------------------------------------------------

    def picture(
        self,
        recipe: tuple[float, ...] = TRUE_COLOUR,
        stretch: tuple[float, float] = STRETCH,
        window: tuple[int, int] | None = None,
    ) -> Picture:
        """Return a picture of some lines, by default of all.

        Up to 1536 lines are read completely. Of more lines, the picture is the stored overview (true colour),
        else the stored means of blocks of pixels, else a subsample of lines. Black and white are percentiles
        (``stretch``) of brightness over the complete flight line; pixels without a value are transparent.
        """
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
        return Picture(_rgba(colours, np.asarray(np.isfinite(linear).all(axis=-1))), first, last, text)

    def _window(self, window: tuple[int, int] | None) -> tuple[int, int]:
        first, last = (0, self.shape[0]) if window is None else window
        first = min(max(0, first), self.shape[0] - 1)
        return first, max(first + 1, min(last, self.shape[0]))

    @staticmethod
    def _line_step(lines: int) -> int:
        return max(SPARSE_STEP, -(-lines // _SPARSE_LINES)) if lines > DETAIL_LINES else 1

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
        nm = np.sort(self.wavelength[visible[:: max(1, visible.size // _VISIBLE_BANDS)]])
        values = self._bands(lines, nm).swapaxes(1, 2)
        linear = linear_srgb(values, weights=srgb_weights(nm, None))
        linear[np.isnan(values).all(axis=1)] = np.nan
        return linear

    def _bands(self, lines: Lines | None, wavelength: Any) -> Array:
        # reflectance (line, column, band) of some lines, or with ``lines`` None of the stored means
        nm = list(wavelength)
        if lines is None and self._means is not None:
            values = at(self._means, nm)["reflectance"]
        else:
            values = pixels(self.line, slice(*(lines or (None,))), wavelength=nm)["reflectance"]
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
        """Return whether the line has the bands of a recipe."""
        try:
            bands_at(self.line, list(recipe))
            return recipe != TRUE_COLOUR or bool(visible_bands(self.wavelength).size)
        except SchemaError:
            return False

    # --- flags ---------------------------------------------------------------------------------------------

    @functools.cached_property
    def _quality(self) -> Array | None:
        if "quality" not in self.line.variables:
            return None
        return np.asarray(self.line["quality"].transpose(ALONG_TRACK, CROSS_TRACK).values)

    @functools.cached_property
    def flag_shares(self) -> dict[Quality, float]:
        """Share of all pixels with each flag that occurs; empty without flags."""
        return {} if self._quality is None else schema.flag_shares(self._quality)

    def flag_picture(self, flags: Iterable[Quality], window: tuple[int, int] | None = None) -> Picture:
        """Return the flags of some lines in their colours, transparent elsewhere, the rarest on top."""
        first, last = self._window(window)
        step = -(-(last - first) // DETAIL_LINES)
        last = min(first + step * -(-(last - first) // step), self.shape[0])
        rows = -(-(last - first) // step)
        colours = np.zeros((self.shape[1], rows, 4), np.uint8)
        if self._quality is not None:
            bits = reduced_lines(self._quality[first:last], step, np.bitwise_or)
            for flag in sorted(flags, key=lambda flag: -self.flag_shares.get(flag, 0.0)):
                colour = (*bytes.fromhex(flag.colour[1:]), _FLAG_OPACITY)
                colours[(bits.T & int(flag)) != 0] = colour
        return Picture(colours.view(np.uint32)[..., 0], first, first + rows * step, "")


def _cached(results: dict[Any, T], compute: Callable[[Place], T], place: Place) -> T | str:
    key = place.polygon.tobytes() if isinstance(place, Region) else place
    if key not in results:
        try:
            results[key] = compute(place)
        except PaintError as error:
            return str(error)
    return results[key]


def _flag_text(names: Sequence[str]) -> str:
    return ", ".join(names).replace("_", " ") or "no flag"


def _rgba(picture: Array, is_opaque: Array | None = None) -> npt.NDArray[np.uint32]:
    # pixels as bokeh draws them: columns of the flight line are rows, lines run to the right
    colours = np.full((*picture.shape[:2], 4), 255, np.uint8)
    colours[..., :3] = (np.nan_to_num(picture).clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    if is_opaque is not None:
        colours[..., 3] = np.where(is_opaque, 255, 0)
    return np.ascontiguousarray(colours.swapaxes(0, 1)).view(np.uint32)[..., 0]


# --- regions drawn on a flight line: corners of polygons, regions by flight line, and region ---------------


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
    if outlines.coordinates != "sensor":
        raise SchemaError(
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
    if holed := [region.name for region in outlines if region.holes]:
        raise SchemaError(
            f"regions with holes cannot be drawn: {', '.join(holed)}",
            mend="leave them out",
            code="region-holes",
        )
    return outlines, tuple(others)


class RegionFiles:
    """Checksums of region files, so that changes by other programs are not overwritten."""

    def __init__(self, regions: Any) -> None:
        self._digests: dict[str, str] = {}
        if isinstance(regions, str | os.PathLike) and is_plain_file(regions):
            with contextlib.suppress(OSError):  # reading the regions reports an unreadable file
                self.remember(Path(regions))

    def remember(self, path: Path) -> None:
        """Store the checksum of a file that was read or saved by this object's owner."""
        self._digests[os.path.realpath(path)] = _digest(path)

    def may_replace(self, path: Path) -> bool:
        """Return whether a file exists and may be replaced; `StoreError` if another program changed it."""
        if not is_plain_file(path):
            return False
        digest = self._digests.get(os.path.realpath(path))
        if digest != _digest(path):
            raise StoreError(
                f"{path} was {'not read or saved here' if digest is None else 'changed by another program'}, "
                "so regions are not saved to it",
                mend="move it away or choose another file, and save again",
                option="move it away and save again, or begin anew with --regions and another file",
                code="file-changed",
            )
        return True


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
