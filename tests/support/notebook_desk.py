"""What lies on a user's desk: a line, a store, a library and a collect, for what people do in a notebook."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

import hyperpaint as hp
from hyperpaint.simulation import simulate_collect, simulate_line

LINES, BANDS, COLUMNS = 48, 20, 12


def laid_out(folder: Path) -> SimpleNamespace:
    # Return what lies on a user's desk: a line in memory and in a store, a library, a collect
    line = simulate_line(lines=LINES, bands=BANDS, columns=COLUMNS).paint.reflectance().compute()
    store = hp.to_store(line, folder / "lot.zarr", "flightlines/raw_0")
    hp.to_store(line.isel(along_track=slice(0, 32)), store, "flightlines/raw_1")
    flown = simulate_collect(folder / "flown", scene="plan", lines=LINES, bands=BANDS, columns=COLUMNS)
    processed = xr.open_zarr(hp.process(flown, folder / "flown.zarr"), group="flightlines/raw_0")
    regions = hp.Regions(
        tuple(
            hp.Region(f"paint {k}", [(1, 10 * k + 1), (9, 10 * k + 1), (9, 10 * k + 7), (1, 10 * k + 7)])
            for k in range(3)
        )
    )
    with np.errstate(all="ignore"):
        library = hp.extract_signatures(line, regions, exclude=0)
    return SimpleNamespace(
        folder=folder, line=line, store=store, library=library, regions=regions,
        lazy=xr.open_zarr(store, group="flightlines/raw_0"),
        processed=processed,
        collect=simulate_collect(folder / "collect", scene="plan", lines=40, bands=4, columns=6, cubes=2),
    )  # fmt: skip


def same(first: Any, second: Any) -> None:
    np.testing.assert_allclose(np.asarray(first), np.asarray(second), rtol=1e-6)


Habit = Callable[[SimpleNamespace], Any]
