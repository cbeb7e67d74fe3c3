"""The unit of work for any engine: some whole lines in memory, calibrated at once, in this thread."""

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

    For engines other than dask, and for loops of one's own: the function, what goes in and what comes out can
    be pickled, and no scheduler is asked. Recipes for cubed, Ray, process pools and dask.distributed stand in
    docs/howto/engines.md.

    Parameters
    ----------
    dataset
        Whole lines of a flight line, with all that calibrates them: ``line.isel(along_track=slice(0, 32))``.
        What is read from files when asked for (``chunks=None``) is read here; 32 to 256 lines are a good
        size.
    uncertainty, tilt, keep_bits
        As of `hyperpaint.reflectance`.

    Returns
    -------
    Dataset
        The same in memory, with what `hyperpaint.reflectance` adds.

    Raises
    ------
    SchemaError, UnitsError, TimeError
        As `hyperpaint.reflectance`, at once; or variables are arrays of dask.

    Notes
    -----
    Lines do not depend on one another, so the bits are those of the whole line. Three options take something
    from all lines given: ``tilt`` their mean position, ``uncertainty`` the largest share of the dark's noise,
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
            f"{', '.join(lazy[:3])}{' and others' if len(lazy) > 3 else ''}: dask arrays, which slab does "
            "not compute",
            expected="lines in memory",
            mend="pass line.load(), open with chunks=None, or call .paint.reflectance() on all lines",
            code="lines-not-loaded",
        )
    line = line.compute()  # reads what is read when asked for
    cubes = {name: line[name] for name in ("counts", "radiance") if name in line.data_vars}
    # one chunk, without a name that would cost a pass over it
    whole = {
        name: cube.copy(data=da.from_array(cube.values, chunks=-1, name=False))
        for name, cube in cubes.items()
    }
    product = reflectance(line.assign(whole), uncertainty=uncertainty, tilt=tilt, keep_bits=keep_bits)
    return product.compute(scheduler="synchronous").assign(cubes)
