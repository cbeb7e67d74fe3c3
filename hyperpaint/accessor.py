"""The ``.paint`` accessor: the spelling of hyperpaint's functions on a Dataset, and nothing else."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import xarray as xr

if TYPE_CHECKING:
    import numpy.typing as npt

    from .alignment.column_means import Progress
    from .alignment.windows import Window
    from .base.attitude_conventions import Convention
    from .base.schema import Quality
    from .geometry.georeference import PinholeCamera
    from .geometry.georeference.poses import Interpolation
    from .io.store import StoreReport
    from .light.illumination import Tilt
    from .paints.signatures.line_sources import Smoothing
    from .radiometry.counts_to_reflectance import Panel
    from .regions.proposals import Proposals
    from .simulation.rendering.four_curves import Atmosphere
    from .surroundings import SceneModel

__all__ = ["PaintAccessor"]

Dims = Mapping[str, Hashable]


@xr.register_dataset_accessor("paint")
class PaintAccessor:
    """Methods on a flight line. Each returns something new, lazily unless it says otherwise.

    Dims are found by role; those of other programs (downtrack, crosstrack, bands, y, x, ...) are known, and
    any other is named by ``dims={"along_track": "my_dim"}``.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def __repr__(self) -> str:
        from .report.summaries import summary_text

        return summary_text(self._dataset)

    def _repr_html_(self) -> str:
        from .report.summaries import summary_html

        return summary_html(self._dataset)

    def _by_role(self, dims: Dims | None = None) -> xr.Dataset:
        from .base.schema import rename_to_roles

        return rename_to_roles(self._dataset, dims)

    def radiance(self, *, dims: Dims | None = None) -> xr.Dataset:
        """Add ``radiance`` and ``quality``; see `hyperpaint.radiance`."""
        from .radiometry.counts_to_reflectance import radiance

        return radiance(self._by_role(dims))

    def reflectance(
        self,
        irradiance: xr.Dataset | None = None,
        *,
        uncertainty: bool = False,
        tilt: Tilt | tuple[float, float] | None = None,
        panel: Panel | None = None,
        keep_bits: int | None = None,
        dims: Dims | None = None,
    ) -> xr.Dataset:
        """Add ``reflectance``, ``quality`` and ``irradiance_age``; see `hyperpaint.reflectance`."""
        from .radiometry.counts_to_reflectance import reflectance

        line = self._by_role(dims)
        return reflectance(
            line, irradiance, uncertainty=uncertainty, tilt=tilt, panel=panel, keep_bits=keep_bits
        )

    def smooth(
        self, method: str = "savitzky-golay", window: int = 11, *, order: int = 2, dims: Dims | None = None
    ) -> xr.Dataset:
        """Replace ``reflectance`` by its smoothed self; see `hyperpaint.smooth`."""
        from .radiometry.smoothing import smooth

        return smooth(self._by_role(dims), method, window, order=order)

    def at(self, wavelength: npt.ArrayLike, *, dims: Dims | None = None) -> xr.Dataset:
        """Return the bands nearest to wavelengths [nm]; see `hyperpaint.radiometry.bands.at`."""
        from .radiometry.bands import at

        return at(self._by_role(dims), wavelength)

    def to_nominal(self, *, dims: Dims | None = None) -> xr.Dataset:
        """Return spectra with the smile taken out; see `hyperpaint.radiometry.bands.to_nominal`."""
        from .radiometry.bands import to_nominal

        return to_nominal(self._by_role(dims))

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
    ) -> xr.Dataset:
        """Find shift and width of every column (eager); see `hyperpaint.align_to_irradiance`."""
        from .alignment import align_to_irradiance

        return align_to_irradiance(
            self._by_role(dims),
            window=window,
            separate=separate,
            lines=lines,
            degree=degree,
            group=group,
            max_shift=max_shift,
            max_uncertainty=max_uncertainty,
            progress=progress,
        )

    def apply_alignment(
        self, alignment: xr.Dataset, *, degree: int = 2, fwhm: bool = True, dims: Dims | None = None
    ) -> xr.Dataset:
        """Return the line with the wavelengths found in flight; see `hyperpaint.apply_alignment`."""
        from .alignment import apply_alignment

        return apply_alignment(self._by_role(dims), alignment, degree=degree, fwhm=fwhm)

    def oxygen_residual(self, *, progress: Progress | None = None, dims: Dims | None = None) -> xr.DataArray:
        """Return what is left of the oxygen band, by column (eager); see `hyperpaint.oxygen_residual`."""
        from .alignment import oxygen_residual

        return oxygen_residual(self._by_role(dims), progress=progress)

    def relight(
        self,
        bands: Any = None,
        *,
        paints: Mapping[str, Any] | None = None,
        atmosphere: Atmosphere | str = "noon",
        spectra: Mapping[str, Any] | xr.Dataset | None = None,
        variation: npt.ArrayLike | None = None,
        truth: bool = True,
        clip: bool = False,
        dims: Dims | None = None,
    ) -> xr.Dataset:
        """Return the radiance of a traced scene under an atmosphere; see `hyperpaint.relight`."""
        from .simulation.rendering.relighting import relight

        return relight(
            self._by_role(dims),
            bands,
            paints=paints,
            atmosphere=atmosphere,
            spectra=spectra,
            variation=variation,
            truth=truth,
            clip=clip,
        )

    def survey(
        self,
        *,
        diffuse: Any = "model",
        sun_zenith: float | None = None,
        sun_azimuth: float | None = None,
        heading: float | None = None,
        reach: int = 120,
        progress: Progress | bool | None = None,
        dims: Dims | None = None,
    ) -> SceneModel:
        """Return what is known of the scene as a whole (eager); see `hyperpaint.survey`."""
        from .surroundings import survey

        return survey(
            self._by_role(dims),
            diffuse=diffuse,
            sun_zenith=sun_zenith,
            sun_azimuth=sun_azimuth,
            heading=heading,
            reach=reach,
            progress=progress,
        )

    def flag(
        self,
        model: SceneModel | xr.Dataset | None = None,
        *,
        glint: float = 0.02,
        shadow: float = 0.2,
        adjacency: float = 0.01,
        edge: int = 1,
        progress: Progress | bool | None = None,
        dims: Dims | None = None,
        **options: Any,
    ) -> xr.Dataset:
        """Flag glint, shadow, adjacency and mixed edges; see `hyperpaint.flag`."""
        from .surroundings.flags import flag

        return flag(
            self._by_role(dims),
            model,
            glint=glint,
            shadow=shadow,
            adjacency=adjacency,
            edge=edge,
            progress=progress,
            **options,
        )

    def remove_mirrored_sky(
        self,
        *,
        strength: float = 0.04,
        sky_view_factor: float = 1.0,
        diffuse: Any = "model",
        sun_zenith: float | None = None,
        dims: Dims | None = None,
    ) -> xr.Dataset:
        """Subtract the sky that a clear coat mirrors; see `hyperpaint.remove_mirrored_sky`."""
        from .surroundings.sun_and_sky import remove_mirrored_sky

        return remove_mirrored_sky(
            self._by_role(dims),
            strength=strength,
            sky_view_factor=sky_view_factor,
            diffuse=diffuse,
            sun_zenith=sun_zenith,
        )

    def correct_light(
        self,
        *,
        direct: Any = 1.0,
        sky_view_factor: Any = 1.0,
        neighbour_reflectance: float = 0.2,
        diffuse: Any = "model",
        sun_zenith: float | None = None,
        dims: Dims | None = None,
    ) -> xr.Dataset:
        """Divide by the light of a tilted surface, or one with less sky; see `hyperpaint.correct_light`."""
        from .surroundings.sun_and_sky import correct_light

        return correct_light(
            self._by_role(dims),
            direct=direct,
            sky_view_factor=sky_view_factor,
            neighbour_reflectance=neighbour_reflectance,
            diffuse=diffuse,
            sun_zenith=sun_zenith,
        )

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
        flightline: str = "",
        name: str = "paint",
        progress: Progress | bool | None = None,
        dims: Dims | None = None,
        **options: Any,
    ) -> Proposals:
        """Return regions of car paint, ranked, with reasons (eager); see `hyperpaint.propose_regions`."""
        from .regions.proposals import propose_regions

        return propose_regions(
            self._by_role(dims),
            model,
            most=most,
            min_pixels=min_pixels,
            erode=erode,
            glint=glint,
            shadow=shadow,
            adjacency=adjacency,
            brightness=brightness,
            angle=angle,
            flightline=flightline,
            name=name,
            progress=progress,
            **options,
        )

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
        min_pixels: int = 5,
        seed: int = 0,
        progress: Progress | None = None,
        dims: Dims | None = None,
    ) -> xr.Dataset:
        """Return a paint library, one paint a region (eager); see `hyperpaint.extract_signatures`."""
        from .paints.signatures import extract_signatures

        return extract_signatures(
            self._by_role(dims),
            regions,
            exclude=exclude,
            members=members,
            centre=centre,
            smooth=smooth,
            specular_sky=specular_sky,
            sun_zenith=sun_zenith,
            min_pixels=min_pixels,
            seed=seed,
            progress=progress,
        )

    def rgb(self, *, stretch: tuple[float, float] = (2.0, 98.0), dims: Dims | None = None) -> xr.DataArray:
        """Return a true-colour picture; see `hyperpaint.pictures.plot.rgb`."""
        from .pictures.plot import rgb

        return rgb(self._by_role(dims), stretch=stretch)

    def quicklook(
        self, path: str | Path | None = None, *, lines: int = 1000, dims: Dims | None = None
    ) -> Any:
        """Draw colour, quality, irradiance and spectra (eager); see `hyperpaint.pictures.plot.quicklook`."""
        from .pictures.plot import quicklook

        return quicklook(self._by_role(dims), path, lines=lines)

    def spectrum(
        self,
        regions: Any = None,
        *,
        pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
        paints: str | Iterable[str] | None = None,
        spread: str = "quantiles",
        exclude: Quality | int | None = None,
        axes: Any = None,
        dims: Dims | None = None,
    ) -> Any:
        """Draw spectra of regions, pixels or paints (eager); see `hyperpaint.spectrum`."""
        from .pictures.plot_spectra import spectrum

        return spectrum(
            self._by_role(dims),
            regions,
            pixels=pixels,
            paints=paints,
            spread=spread,
            exclude=exclude,
            axes=axes,
        )

    def triptych(
        self,
        region: Any,
        path: str | Path | None = None,
        *,
        exclude: Quality | int | None = None,
        dims: Dims | None = None,
    ) -> Any:
        """Draw a region as counts, radiance and reflectance (eager); see `hyperpaint.triptych`."""
        from .pictures.plot_spectra import triptych

        return triptych(self._by_role(dims), region, path, exclude=exclude)

    def flag_overlay(
        self,
        flags: Quality | str | Iterable[str] | None = None,
        *,
        layer: str | None = None,
        lines: int = 1000,
        opacity: float = 0.75,
        axes: Any = None,
        dims: Dims | None = None,
    ) -> Any:
        """Draw flags or a layer over the true-colour picture (eager); see `hyperpaint.flag_overlay`."""
        from .pictures.plot_flags import flag_overlay

        return flag_overlay(self._by_role(dims), flags, layer=layer, lines=lines, opacity=opacity, axes=axes)

    def locate(
        self,
        *,
        navigation: xr.Dataset | None = None,
        boresight: Sequence[float] = (0.0, 0.0, 0.0),
        lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
        ground: float | None = None,
        dem: xr.DataArray | None = None,
        crs: Any = None,
        camera: PinholeCamera | xr.Dataset | None = None,
        clock_offset_s: float = 0.0,
        convention: Convention | None = None,
        max_gap_s: float | None = None,
        interpolation: Interpolation = "linear",
        dims: Dims | None = None,
    ) -> xr.Dataset:
        """Add the place on the ground that every pixel shows; see `hyperpaint.locate`."""
        from .geometry.georeference import locate

        return locate(
            self._by_role(dims),
            navigation=navigation,
            boresight=boresight,
            lever_arm=lever_arm,
            ground=ground,
            dem=dem,
            crs=crs,
            camera=camera,
            clock_offset_s=clock_offset_s,
            convention=convention,
            max_gap_s=max_gap_s,
            interpolation=interpolation,
        )

    def orthorectify(
        self,
        gsd: float | None = None,
        *,
        grid: Literal["flight", "north"] = "flight",
        variables: Iterable[str] | None = None,
        method: Literal["nearest", "bilinear"] = "nearest",
        multi_hit: Literal["nadir", "first", "last"] = "nadir",
        max_stretch: float = 20.0,
        tile: int = 256,
        bounds: Sequence[float] | None = None,
        progress: Progress | None = None,
        dims: Dims | None = None,
        **location: Any,
    ) -> xr.Dataset:
        """Return the line as a map, located first where it is not; see `hyperpaint.orthorectify`."""
        from .geometry.orthorectification import orthorectify

        return orthorectify(
            self._by_role(dims),
            gsd,
            grid=grid,
            variables=variables,
            method=method,
            multi_hit=multi_hit,
            max_stretch=max_stretch,
            tile=tile,
            bounds=bounds,
            progress=progress,
            **location,
        )

    def verify(self) -> StoreReport:
        """Read every chunk of the store that the dataset was opened from (eager); see `hyperpaint.verify`.

        Raises
        ------
        StoreError
            The dataset does not say where it was opened from, or no Zarr store is there.
        """
        from .base.errors import StoreError
        from .io.store import verify

        source = self._dataset.encoding.get("source")
        if not isinstance(source, str):
            raise StoreError(
                "the dataset does not say which store it was opened from, as those do that xarray.open_zarr "
                "opens by path or URL; call hyperpaint.verify(path), or load it whole where it is in icechunk"
            )
        return verify(source)

    def quantify(self) -> xr.Dataset:
        """Return a view for pint-xarray users: data variables as Quantities (extra ``units``).

        Coordinates stay plain, so that they can still be selected on. Quantities are for looking and for
        arithmetic in a session; stores, graphs and hyperpaint's own functions take the plain dataset.
        """
        from .base.units import quantify

        return quantify(self._dataset)
