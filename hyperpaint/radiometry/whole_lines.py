"""Calibrate whole lines in memory at once, in the calling thread: the unit of work for any engine."""

from __future__ import annotations

import dask.array as da
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import rename_to_roles
from hyperpaint.base.units import takes_quantities
from hyperpaint.light.illumination import Tilt

from .counts_to_reflectance import reflectance


@takes_quantities(tilt="degree")
def slab(
    dataset: xr.Dataset,
    *,
    uncertainty: bool = False,
    tilt: Tilt | tuple[float, float] | None = None,
    keep_bits: int | None = None,
) -> xr.Dataset:
    """Reflectance and quality of some whole lines: numpy in, numpy out, the bits of ``.paint.reflectance()``.

    For engines other than dask, and for loops of your own: the function, its inputs and its outputs can be
    pickled, and no scheduler is used. Recipes for cubed, Ray, process pools and dask.distributed are in
    docs/howto/engines.md.

    Parameters
    ----------
    dataset
        Whole lines of a flight line, with their calibration: ``line.isel(along_track=slice(0, 32))``.
        Variables that are read from files on demand (``chunks=None``) are read here; 32 to 256 lines are a
        good size.
    uncertainty, tilt, keep_bits
        As of `hyperpaint.reflectance`.

    Returns
    -------
    Dataset
        The lines in memory, with the variables that `hyperpaint.reflectance` adds.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `hyperpaint.reflectance`, at once; or variables are arrays of dask.

    Notes
    -----
    Lines do not depend on one another, so the bits are those of the whole line. Three options use all lines
    passed: ``tilt`` their mean position, ``uncertainty`` the largest share of the dark's noise,
    and darks of several exposures the range of the lines' exposures, where these differ.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> line = worked_example()
    >>> print(f"{hp.slab(line).reflectance.values[0, 0, 0]:.6f}")
    0.400000
    """
    line = rename_to_roles(dataset)
    lazy = [str(name) for name, variable in line.variables.items() if variable.chunks is not None]
    if lazy:
        raise SchemaError(
            f"slab computes no dask arrays: {', '.join(lazy[:3])}{', ...' if len(lazy) > 3 else ''}",
            expected="lines in memory",
            mend="pass line.load(), open with chunks=None, or call .paint.reflectance() on all lines",
            code="lines-not-loaded",
        )
    line = line.compute()  # reads variables that are opened with chunks=None
    cubes = {name: line[name] for name in ("counts", "radiance") if name in line.data_vars}
    # one chunk, without a name, whose hash would cost a pass over it
    whole = {
        name: cube.copy(data=da.from_array(cube.values, chunks=-1, name=False))
        for name, cube in cubes.items()
    }
    product = reflectance(line.assign(whole), uncertainty=uncertainty, tilt=tilt, keep_bits=keep_bits)
    return product.compute(scheduler="synchronous").assign(cubes)
