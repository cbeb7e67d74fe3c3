"""The ``.paint`` accessor: the spelling of hyperpaint's functions on a Dataset, and nothing else."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

if TYPE_CHECKING:
    import numpy.typing as npt

    from .alignment.column_means import Progress
    from .alignment.windows import Window
    from .illumination import Tilt
    from .io.store import StoreReport
    from .radiometry import Panel

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

    def _by_role(self, dims: Dims | None = None) -> xr.Dataset:
        from .schema import rename_to_roles

        return rename_to_roles(self._dataset, dims)

    def radiance(self, *, dims: Dims | None = None) -> xr.Dataset:
        """Add ``radiance`` and ``quality``; see `hyperpaint.radiance`."""
        from .radiometry import radiance

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
        from .radiometry import reflectance

        line = self._by_role(dims)
        return reflectance(
            line, irradiance, uncertainty=uncertainty, tilt=tilt, panel=panel, keep_bits=keep_bits
        )

    def smooth(
        self, method: str = "savitzky-golay", window: int = 11, *, order: int = 2, dims: Dims | None = None
    ) -> xr.Dataset:
        """Replace ``reflectance`` by its smoothed self; see `hyperpaint.smooth`."""
        from .smoothing import smooth

        return smooth(self._by_role(dims), method, window, order=order)

    def at(self, wavelength: npt.ArrayLike, *, dims: Dims | None = None) -> xr.Dataset:
        """Return the bands nearest to wavelengths [nm]; see `hyperpaint.bands.at`."""
        from .bands import at

        return at(self._by_role(dims), wavelength)

    def to_nominal(self, *, dims: Dims | None = None) -> xr.Dataset:
        """Return spectra with the smile taken out; see `hyperpaint.bands.to_nominal`."""
        from .bands import to_nominal

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

    def rgb(self, *, stretch: tuple[float, float] = (2.0, 98.0), dims: Dims | None = None) -> xr.DataArray:
        """Return a true-colour picture; see `hyperpaint.plot.rgb`."""
        from .plot import rgb

        return rgb(self._by_role(dims), stretch=stretch)

    def quicklook(
        self, path: str | Path | None = None, *, lines: int = 1000, dims: Dims | None = None
    ) -> Any:
        """Draw colour, quality, irradiance and spectra (eager); see `hyperpaint.plot.quicklook`."""
        from .plot import quicklook

        return quicklook(self._by_role(dims), path, lines=lines)

    def verify(self) -> StoreReport:
        """Read every chunk of the store that the dataset was opened from (eager); see `hyperpaint.verify`.

        Raises
        ------
        StoreError
            The dataset does not say where it was opened from, or no Zarr store is there.
        """
        from .errors import StoreError
        from .io.store import verify

        source = self._dataset.encoding.get("source")
        if not isinstance(source, str):
            msg = (
                "the dataset does not say which store it was opened from, as those do that xarray.open_zarr "
                "opens by path or URL; call hyperpaint.verify(path), or load it whole where it is in icechunk"
            )
            raise StoreError(msg)
        return verify(source)

    def quantify(self) -> xr.Dataset:
        """Return a view for pint-xarray users: data variables as Quantities (extra ``units``).

        Coordinates stay plain, so that they can still be selected on. Quantities are for looking and for
        arithmetic in a session; stores, graphs and hyperpaint's own functions take the plain dataset.
        """
        from .units import quantify

        return quantify(self._dataset)
