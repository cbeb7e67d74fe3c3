"""Building and optimising the graph of a cube that no memory holds."""

from __future__ import annotations

import functools

from .common import BANDS, COLUMNS, flight_line, scratch


@functools.cache
def empty_store(lines):
    """Write all of a flight line but the chunks of its cube: whoever reads one is found out."""
    import dask.array as da
    import zarr

    from hyperpaint.io.store.layout import encoding_of

    cube = da.zeros((lines, BANDS, COLUMNS), "uint16", chunks=(32, BANDS, COLUMNS))
    line = flight_line(lines, smile=True, counts=cube)
    path = scratch() / f"empty-{lines}.zarr"
    encoding = {name: encoding_of(variable) for name, variable in line.variables.items()}
    line.to_zarr(path, zarr_format=3, consolidated=False, encoding=encoding, compute=False)
    zarr.consolidate_metadata(path)
    return path


class Graph:
    """`reflectance` of a store that plain `xarray.open_zarr` opened."""

    params = ([1_000, 100_000],)
    param_names = ("lines",)

    def setup(self, lines):
        import warnings

        import xarray as xr

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            self.path = empty_store(lines)
        self.line = xr.open_zarr(self.path)
        self.made = self.line.paint.reflectance()

    def time_open(self, lines):
        import xarray as xr

        xr.open_zarr(self.path)

    def time_build(self, lines):
        self.line.paint.reflectance()

    def time_optimise(self, lines):
        import dask

        dask.optimize(self.made["reflectance"])

    def time_build_and_optimise(self, lines):
        import dask

        dask.optimize(self.line.paint.reflectance()["reflectance"])

    def track_tasks_per_slab(self, lines):
        import dask

        (optimised,) = dask.optimize(self.made["reflectance"])
        return len(dict(optimised.__dask_graph__())) / self.made["reflectance"].data.numblocks[0]

    track_tasks_per_slab.unit = "tasks"
