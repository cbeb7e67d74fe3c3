"""From a store and a file of regions to a stored paint library: where readers and signatures meet."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import SchemaError, StoreError
from .schema import Quality

if TYPE_CHECKING:
    import xarray as xr

    from .regions import Regions

__all__ = ["table_of", "write_signatures"]

_MOST_TOLD = 10


def write_signatures(
    store: str | os.PathLike[str],
    regions: Any,
    out: str | os.PathLike[str],
    *,
    keep: Sequence[str] = (),
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    """Write the signatures of regions on the flight lines of a store, and return them.

    Reflectance is computed from the stored counts where they are, with its uncertainties where the noise of
    the camera is known; else it is what is stored.

    Parameters
    ----------
    store
        A store with groups ``flightlines/<id>``, as `hyperpaint.process` writes it.
    regions
        See `hyperpaint.regions_from`; None has `hyperpaint.propose_regions` propose some on every line.
    out
        Folder of the library's store.
    keep
        Names of flags whose pixels are used, though they are left out otherwise; not with ``exclude``.
    overwrite
        Replace another library; one of the same content is left alone.
    progress, **options
        As `hyperpaint.extract_signatures`.

    Returns
    -------
    xarray.Dataset

    Raises
    ------
    FormatError, SchemaError, UnitsError
        As `hyperpaint.extract_signatures`; or ``keep`` names an unknown flag, or comes
        with ``exclude``.
    StoreError
        The store has no finished flight line of the regions; or the library cannot be written, or its store
        holds something else.
    """
    from .io.store import to_store
    from .regions import regions_from
    from .signatures import extract_signatures

    inside, around = Path(out).resolve(), Path(store).resolve()
    if inside == around or around in inside.parents:
        msg = f"{out} is in the store itself; choose another path for the library"
        raise SchemaError(msg)
    if keep:
        if options.get("exclude") is not None:
            msg = "keep= and exclude= say the same in two ways; pass one of them"
            raise SchemaError(msg)
        options["exclude"] = _excluded(keep)
    if regions is None:
        lines = _lines(store, ())
        found = _proposed(lines)
    else:
        found = regions_from(regions)
        lines = _lines(store, found.flightlines)
    made = extract_signatures(lines, found, progress=progress, **options)
    made.attrs["store"] = around.name
    to_store(made, Path(out), overwrite=overwrite)
    return made


def _lines(store: str | os.PathLike[str], wanted: tuple[str, ...]) -> dict[str, xr.Dataset]:
    """Return the flight lines that are wanted, all where none is named, with reflectance."""
    from .io.store import list_groups, open_store
    from .radiometry import reflectance

    groups = [group for group in list_groups(store) if group.startswith("flightlines/")]
    names = [group.removeprefix("flightlines/") for group in groups]
    if not groups:
        msg = f"{store} holds no flight line; expected groups flightlines/<id>, as hyperpaint process writes"
        raise StoreError(msg)
    lines = {}
    for name in names if not wanted or not set(wanted) <= set(names) else wanted:
        line = open_store(store, f"flightlines/{name}")
        if "counts" in line.variables:
            known = {"electrons_per_count", "read_noise"} <= set(line.variables)
            line = reflectance(line, uncertainty=known)
        lines[name] = line
    return lines


def _proposed(lines: dict[str, xr.Dataset]) -> Regions:
    """Return the regions that are proposed on flight lines.

    Raises
    ------
    SchemaError
        There is none; what was refused is told.
    """
    from .proposals import propose_regions
    from .regions import Regions

    # with several lines, names of paints begin with that of their line
    made = {
        name: propose_regions(line, flightline=name, name="paint" if len(lines) == 1 else f"{name}_paint")
        for name, line in lines.items()
    }
    found = Regions(tuple(region for proposals in made.values() for region in proposals))
    if not len(found):
        refused = [text for proposals in made.values() for text in proposals.table().splitlines()]
        shown = "".join(f"\n  {text}" for text in refused[:_MOST_TOLD])
        msg = f"no region can be proposed, {len(refused)} were refused; draw some, and name them{shown}"
        raise SchemaError(msg)
    return found


def _excluded(keep: Sequence[str]) -> Quality:
    from .signatures import EXCLUDED

    known = {str(flag.name).lower(): flag for flag in Quality}
    if unknown := [name for name in keep if name.lower() not in known]:
        msg = f"no flag {', '.join(map(repr, unknown))}; flags are {', '.join(known)}"
        raise SchemaError(msg)
    exclude = EXCLUDED
    for name in keep:
        exclude &= ~known[name.lower()]
    return exclude


def table_of(library: xr.Dataset) -> str:
    """Return a line of text for every paint of a library."""
    names = [str(name) for name in library["paint"].values]
    width = max(map(len, names))
    rows = zip(names, *(library[name].values for name in ("n", "n_eff", "n_excluded")), strict=True)
    return "\n".join(
        f"  {name:<{width}}  {n} pixels, {n_eff:.0f} independent" + (f", {left} left out" if left else "")
        for name, n, n_eff, left in rows
    )
