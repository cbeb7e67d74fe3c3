"""What type checkers see of ``Dataset.paint``; written by tests/support/accessor_stub.py.

xarray lets type checkers take any attribute of a Dataset for anything. To have ``.paint`` completed and
checked, say once what a dataset is: ``line = cast(PaintDataset, xr.open_zarr(...))``; what its methods return
is one again. `PaintDataset` exists for type checkers only: import it under ``if TYPE_CHECKING:``.
"""

import os
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pint
import xarray as xr

from hyperpaint.alignment.comparison import Window
from hyperpaint.base import ArrayLike, Convention, Progress, Quality
from hyperpaint.geometry.georeference.locating import Interpolation, PinholeCamera
from hyperpaint.io.store import StoreReport
from hyperpaint.light.illumination import Tilt
from hyperpaint.paints.signatures.line_sources import Smoothing
from hyperpaint.pictures.exploring import Explorer
from hyperpaint.radiometry.panels import Panel
from hyperpaint.radiometry.pixel_reading import Place
from hyperpaint.regions.proposals import Proposals
from hyperpaint.simulation.atmosphere import Atmosphere, BrokenClouds
from hyperpaint.surroundings.model import SceneModel

METHOD_GROUPS: dict[str, dict[str, str]]
METHODS: dict[str, str]
ARRAY_METHODS: tuple[str, ...]
Dims = Mapping[str, Hashable]

class PaintDataset(xr.Dataset):
    """A Dataset whose ``.paint`` is known."""

    @property
    def paint(self) -> PaintAccessor: ...

class PaintDataArray(xr.DataArray):
    """A DataArray whose ``.paint`` is known."""

    @property
    def paint(self) -> PaintArrayAccessor: ...

class PaintAccessor:
    """Methods on a flight line; each returns something new, lazily unless it says otherwise."""

    def __init__(self, dataset: xr.Dataset) -> None: ...
    def _repr_html_(self) -> str: ...
    def verify(self) -> StoreReport:
        """Read every chunk of the store that the dataset was opened from (eager)."""
    def quantify(self, registry: pint.UnitRegistry[Any] | None = None) -> PaintDataset:
        """Return a view for pint-xarray users: data variables as Quantities (extra ``units``)."""

    def rgb(
        self,
        *,
        stretch: tuple[float, float] = (2.0, 98.0),
        lines: int | None = None,
        dims: Dims | None = None,
    ) -> xr.DataArray:
        """Return a true-colour picture: reflectance through the CIE 1931 observer to sRGB."""
    def quicklook(
        self,
        path: str | Path | None = None,
        *,
        lines: int = 1000,
        width: float = 11.0,
        dims: Dims | None = None,
    ) -> Any:
        """Draw a flight line: true colour, flags, irradiance over time, spread of reflectance."""
    def spectrum(
        self,
        regions: Any = None,
        path: str | Path | None = None,
        *,
        pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
        paints: str | Iterable[str] | None = None,
        spread: str = "quantiles",
        exclude: Quality | int | None = None,
        width: float = 8.0,
        axes: Any = None,
        dims: Dims | None = None,
    ) -> Any:
        """Draw reflectance over wavelength: of regions or pixels of a flight line, or of paints of a library."""
    def triptych(
        self,
        region: Any = None,
        path: str | Path | None = None,
        *,
        pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
        exclude: Quality | int | None = None,
        width: float = 13.0,
        dims: Dims | None = None,
    ) -> Any:
        """Draw a region, or single pixels, as counts, as radiance and as reflectance, side by side."""
    def flag_overlay(
        self,
        flags: Quality | int | str | Iterable[str] | None = None,
        path: str | Path | None = None,
        *,
        layer: str | None = None,
        lines: int = 1000,
        opacity: float = 0.75,
        width: float = 6.8,
        axes: Any = None,
        dims: Dims | None = None,
    ) -> Any:
        """Draw flags, or a continuous layer, over the true-colour picture of a flight line."""
    def explore(
        self,
        regions: Any = None,
        *,
        library: xr.Dataset | str | os.PathLike[str] | None = None,
        flightline: str = "",
        exclude: Quality | int | None = None,
        theme: Literal["light", "dark"] = "light",
        dims: Dims | None = None,
    ) -> Explorer:
        """Show a flight line in an interactive widget: bands, spectra, flags, regions, similar paints."""
    def radiance(self, *, dims: Dims | None = None) -> PaintDataset:
        """Spectral radiance at the sensor, from raw counts."""
    def reflectance(
        self,
        irradiance: xr.Dataset | None = None,
        *,
        uncertainty: bool = False,
        tilt: Tilt | tuple[float, float] | None = None,
        panel: Panel | Sequence[Panel] | None = None,
        white: Any = None,
        tile: Any = None,
        dark: Any = None,
        keep_bits: int | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Reflectance factor under the irradiance measured at the time of every line, or relative to a white."""
    def white_reference(
        self,
        white: Any,
        *,
        tile: Any = None,
        tile_uncertainty: float | None = None,
        dark: Any = None,
        white_dark: Any = None,
        exposure_time: float | Sequence[float] | None = None,
        white_exposure_time: float | None = None,
        bit_depth: int = 12,
        tile_surface: Any = "lambertian",
        light_zenith: float | None = None,
        direct_share: float = 1.0,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Calibrate raw counts by a white tile, so that ``reflectance()`` needs nothing else."""
    def pixels(
        self,
        along_track: Place = slice(None),
        cross_track: Place = slice(None),
        *,
        wavelength: ArrayLike | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Return reflectance of a pixel, a region or a band, with the bits of `reflectance`."""
    def coarse(self, *, side: int | None = None, dims: Dims | None = None) -> PaintDataset:
        """Return a flight line at the size of a screen: means of blocks of ``side`` x ``side`` pixels."""
    def smooth(
        self, method: str = "savitzky-golay", window: int = 11, *, order: int = 2, dims: Dims | None = None
    ) -> PaintDataset:
        """Smooth ``reflectance`` over the bands."""
    def at(self, wavelength: ArrayLike, *, dims: Dims | None = None) -> PaintDataset:
        """Return the bands nearest to one or several wavelengths."""
    def to_nominal(self, *, dims: Dims | None = None) -> PaintDataset:
        """Return spectra interpolated to the nominal wavelengths: the smile is removed."""
    def align_to_irradiance(
        self,
        *,
        window: Window | Sequence[Window] | None = None,
        separate: bool = False,
        lines: slice | None = None,
        degree: int = 5,
        group: int = 1,
        max_shift: float = 2.0,
        max_uncertainty: float = 0.1,
        progress: Progress | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """In-flight spectral calibration: smile and FWHM of every column from lines of the daylight."""
    def apply_alignment(
        self, alignment: xr.Dataset, *, degree: int = 2, fwhm: bool = True, dims: Dims | None = None
    ) -> PaintDataset:
        """Return the line with wavelengths and widths from `hyperpaint.alignment.align_to_irradiance`."""
    def oxygen_residual(self, *, progress: Progress | None = None, dims: Dims | None = None) -> xr.DataArray:
        """Return the residual depth of the oxygen A band in the reflectance of every column."""
    def survey(
        self,
        *,
        diffuse: Any = None,
        sun_zenith: float | None = None,
        sun_azimuth: float | None = None,
        heading: float | None = None,
        reach: int = 120,
        progress: Progress | bool | None = None,
        dims: Dims | None = None,
    ) -> SceneModel:
        """Survey a flight line, and return the scene model that flags use."""
    def flag(
        self,
        model: SceneModel | xr.Dataset | None = None,
        *,
        glint: float = 0.04,
        shadow: float = 0.2,
        adjacency: float = 0.01,
        edge: int = 1,
        where: Any = None,
        progress: Progress | bool | None = None,
        dims: Dims | None = None,
        **options: Any,
    ) -> PaintDataset:
        """Set the bits of glint, shadow, adjacency and mixed edges, and add their layers."""
    def remove_mirrored_sky(
        self,
        *,
        strength: float = 0.04,
        sky_view_factor: float = 1.0,
        diffuse: Any = None,
        sun_zenith: float | None = None,
        sky: str | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Subtract the sky that a level clear coat mirrors to the camera."""
    def correct_coat(
        self,
        *,
        index: float = 1.5,
        index_u: float = 0.03,
        lean_u: float = 2.0,
        diffuse: Any = None,
        sun_zenith: float | None = None,
        view_zenith: float | None = None,
        sky: str | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Divide by the transmission of a clear coat relative to its transmission near the normal."""
    def correct_light(
        self,
        *,
        direct: Any = 1.0,
        sky_view_factor: Any = 1.0,
        neighbour_reflectance: float = 0.2,
        diffuse: Any = None,
        sun_zenith: float | None = None,
        sky: str | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Divide by the light on a tilted surface, or on one with partly hidden sky."""
    def locate(
        self,
        *,
        navigation: xr.Dataset | None = None,
        boresight: Sequence[float] | None = None,
        lever_arm: Sequence[float] | None = None,
        ground: float | None = None,
        dem: xr.DataArray | None = None,
        crs: Any = None,
        camera: PinholeCamera | xr.Dataset | None = None,
        clock_offset_s: float = 0.0,
        convention: Convention | None = None,
        max_gap_s: float | None = None,
        interpolation: Interpolation = "linear",
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Add the ground position of every pixel, and the direction from there to the camera."""
    def orthorectify(
        self,
        gsd: float | None = None,
        *,
        grid: Literal["north", "flight"] = "north",
        variables: Iterable[str] | None = None,
        method: Literal["nearest", "bilinear"] = "nearest",
        multi_hit: Literal["nadir", "first", "last"] = "nadir",
        max_stretch: float = 3.0,
        tile: int = 256,
        bounds: Sequence[float] | None = None,
        progress: Progress | None = None,
        dims: Dims | None = None,
        **location: Any,
    ) -> PaintDataset:
        """Return a flight line as a map of square cells, with the position in the line of every cell."""
    def propose_regions(
        self,
        model: SceneModel | xr.Dataset | None = None,
        *,
        most: int | None = None,
        min_pixels: int = 40,
        erode: int = 3,
        glint: float = 0.02,
        shadow: float = 0.2,
        adjacency: float = 0.02,
        brightness: float = 0.03,
        angle: float = 5.0,
        max_level_u: float = 0.15,
        flightline: str = "",
        name: str = "",
        progress: Progress | bool | None = None,
        dims: Dims | None = None,
        **options: Any,
    ) -> Proposals:
        """Propose regions of car paint, best first, each with its reasons, and list the refused pieces."""
    def signatures(
        self,
        regions: Any,
        *,
        exclude: Quality | int | None = None,
        members: int = 256,
        centre: str = "trimmed_mean",
        smooth: Smoothing = None,
        specular_sky: bool = False,
        sun_zenith: float | None = None,
        diffuse: Any = None,
        coat: bool | None = None,
        coat_index: float = 1.5,
        min_pixels: int = 5,
        drop_small: bool = False,
        seed: int = 0,
        progress: Progress | None = None,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Return a paint library: one signature a region, with spread, uncertainty and provenance."""
    def detect(
        self,
        library: xr.Dataset,
        *,
        method: str = "ace",
        false_alarm_rate: float = 0.001,
        unknown_rate: float | None = None,
        others: xr.Dataset | None = None,
        background: Any = None,
        exclude: Quality | int | None = None,
        sky: Any = "auto",
        shrinkage: float = 0.0,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Search a flight line for the paints of a library, at a given rate of false alarms."""
    def relight(
        self,
        bands: Any = None,
        *,
        paints: Mapping[str, Any] | xr.Dataset | None = None,
        atmosphere: Atmosphere | str = "noon",
        spectra: Mapping[str, Any] | xr.Dataset | None = None,
        variation: ArrayLike | BrokenClouds | None = None,
        truth: bool = True,
        clip: bool = False,
        hold_edges: bool | None = None,
        population: bool = True,
        dims: Dims | None = None,
    ) -> PaintDataset:
        """Return the radiance of a traced scene under an atmosphere in the bands of a camera."""

class PaintArrayAccessor:
    """Methods on one cube; each returns something new."""

    def __init__(self, array: xr.DataArray) -> None: ...
    def quantify(self, registry: pint.UnitRegistry[Any] | None = None) -> PaintDataArray:
        """Return a view for pint-xarray users, a Quantity."""

    def rgb(
        self,
        *,
        stretch: tuple[float, float] = (2.0, 98.0),
        lines: int | None = None,
        dims: Dims | None = None,
    ) -> xr.DataArray:
        """Return a true-colour picture: reflectance through the CIE 1931 observer to sRGB."""
    def spectrum(
        self,
        regions: Any = None,
        path: str | Path | None = None,
        *,
        pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
        paints: str | Iterable[str] | None = None,
        spread: str = "quantiles",
        exclude: Quality | int | None = None,
        width: float = 8.0,
        axes: Any = None,
        dims: Dims | None = None,
    ) -> Any:
        """Draw reflectance over wavelength: of regions or pixels of a flight line, or of paints of a library."""
    def smooth(
        self, method: str = "savitzky-golay", window: int = 11, *, order: int = 2, dims: Dims | None = None
    ) -> PaintDataArray:
        """Smooth ``reflectance`` over the bands."""
    def at(self, wavelength: ArrayLike, *, dims: Dims | None = None) -> PaintDataArray:
        """Return the bands nearest to one or several wavelengths."""
    def to_nominal(self, *, dims: Dims | None = None) -> PaintDataArray:
        """Return spectra interpolated to the nominal wavelengths: the smile is removed."""
