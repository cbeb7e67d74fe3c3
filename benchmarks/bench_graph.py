"""Building and optimising the graph of a cube that no memory holds."""

# ruff: noqa: ARG002 (asv hands every parameter to every method)

from __future__ import annotations

import functools

from .common import BANDS, COLUMNS, flight_line, scratch


def write_without_cube(path, lines):
    """Write all of a flight line but the chunks of its cube."""
    import warnings

    import dask.array as da
    import zarr

    from hyperpaint.io.store.computing import encoding_of

    cube = da.zeros((lines, BANDS, COLUMNS), dtype="uint16", chunks=(32, BANDS, COLUMNS))
    line = flight_line(lines, counts=cube)
    encoding = {name: encoding_of(variable) for name, variable in line.variables.items()}
    line.to_zarr(path, zarr_format=3, consolidated=False, encoding=encoding, compute=False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        zarr.consolidate_metadata(path)


@functools.cache
def empty_store(lines):
    path = scratch() / f"empty-{lines}.zarr"
    write_without_cube(path, lines)
    return path


class Graph:
    """`reflectance` of a store that plain `xarray.open_zarr` opened."""

    params = ([100_000],)
    param_names = ("lines",)

    def setup(self, lines):
        import xarray as xr

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
