"""From a store and a file of regions to a stored paint library: where readers and signatures meet."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import PaintError, SchemaError, StoreError
from hyperpaint.base.progress_reports import part_of
from hyperpaint.base.schema import Quality
from hyperpaint.surroundings.flags import Flagged, flag_line, is_flagged

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.regions import Regions

__all__ = ["table_of", "write_signatures"]

_MOST_TOLD = 10
_SHARED = ("glint", "shadow", "adjacency", "sun_zenith")
"""Options of flags that proposals take as well."""


def write_signatures(
    store: str | os.PathLike[str],
    regions: Any,
    out: str | os.PathLike[str],
    *,
    keep: Sequence[str] = (),
    flags: bool | Mapping[str, Any] = True,
    sun_zenith: float | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    """Write the signatures of regions on the flight lines of a store, and return them.

    Flight lines that nobody has flagged are surveyed and flagged first; those that were keep their flags.
    Reflectance is computed from the stored counts where they are, with its uncertainties where the noise of
    the camera is known; else it is what is stored.

    Parameters
    ----------
    store
        A store with groups ``flightlines/<id>``, as `hyperpaint.process` writes it.
    regions
        See `hyperpaint.regions_from`; None has `hyperpaint.propose_regions` propose some on every line, with
        the survey that flags were made with.
    out
        Folder of the library's store.
    keep
        Names of flags whose pixels are used, though they are left out otherwise; not with ``exclude``.
    flags
        False flags nothing; or thresholds of `hyperpaint.flag` and options of `hyperpaint.survey`, by name.
    sun_zenith
        For flags, proposals and the mirrored sky [degree]; by default from time and position of each line.
    overwrite
        Replace another library; one of the same content is left alone.
    progress
        Called with work done and to do: surveys, then extraction.
    **options
        As `hyperpaint.extract_signatures`.

    Returns
    -------
    xarray.Dataset
        The attribute ``flags`` says where flags are from.

    Raises
    ------
    FormatError, MissingExtraError, SchemaError, UnitsError
        As `hyperpaint.extract_signatures` and `hyperpaint.flag`; or ``keep`` names an unknown flag, or comes
        with ``exclude``.
    StoreError
        The store has no finished flight line of the regions; or the library cannot be written, or its store
        holds something else.
    """
    from hyperpaint.io.store import to_store
    from hyperpaint.paints.signatures import extract_signatures
    from hyperpaint.regions import regions_from

    inside, around = Path(out).resolve(), Path(store).resolve()
    if inside == around or around in inside.parents:
        raise SchemaError(f"{out} is in the store itself; choose another path for the library")
    if keep:
        if options.get("exclude") is not None:
            raise SchemaError("keep= and exclude= say the same in two ways; pass one of them")
        options["exclude"] = _excluded(keep)
    given = None if regions is None else regions_from(regions)
    lines, looked_at = _lines(store, () if given is None else given.flightlines)
    wanted = [name for name in lines if flags is not False and name not in looked_at]
    surveys = {} if flags is True or flags is False else dict(flags)
    surveys.setdefault("sun_zenith", sun_zenith)
    flagged = {}
    for number, name in enumerate(wanted):
        told = part_of(progress, number, len(wanted) + 1)
        flagged[name] = _flagged(lines[name], name, {**surveys, "progress": told})
    origin = _origin(lines, flagged, looked_at)
    found = _proposed(lines, flagged, surveys) if given is None else given
    lines |= {name: done.line for name, done in flagged.items()}
    if options.get("specular_sky"):
        options["sun_zenith"] = sun_zenith
    told = part_of(progress, len(wanted), len(wanted) + 1)
    made = extract_signatures(lines, found, progress=told, **options)
    made.attrs |= {"store": around.name, "flags": origin}
    to_store(made, Path(out), overwrite=overwrite)
    return made


def _lines(
    store: str | os.PathLike[str], wanted: tuple[str, ...]
) -> tuple[dict[str, xr.Dataset], frozenset[str]]:
    """Return the flight lines that are wanted, all if none is named, and which have flags."""
    from hyperpaint.io.store import list_groups, open_store
    from hyperpaint.radiometry.counts_to_reflectance import reflectance

    groups = [group for group in list_groups(store) if group.startswith("flightlines/")]
    names = [group.removeprefix("flightlines/") for group in groups]
    if not groups:
        raise StoreError(
            f"{store} holds no flight line; expected groups flightlines/<id>, as hyperpaint process writes"
        )
    lines, flagged = {}, set()
    for name in names if not wanted or not set(wanted) <= set(names) else wanted:
        line = open_store(store, f"flightlines/{name}")
        # as it is stored: computed from counts, all of them would be read for it
        if is_flagged(line):
            flagged.add(name)
        if "counts" in line.variables:
            known = {"electrons_per_count", "read_noise"} <= set(line.variables)
            line = reflectance(line, uncertainty=known)
        lines[name] = line
    return lines, frozenset(flagged)


def _flagged(line: xr.Dataset, name: str, options: Mapping[str, Any]) -> Flagged:
    """Return a line with its flags.

    Raises
    ------
    MissingExtraError, SchemaError, UnitsError
        As `flag_line`, with a note on how to do without.
    """
    try:
        return flag_line(line, **options)
    except PaintError as error:
        found = f"flight line {name!r} has no flags of glint or shadow yet"
        error.note(found, mend="flags=False does without", option="--no-flags does without")
        raise


def _origin(
    lines: Mapping[str, xr.Dataset], flagged: Mapping[str, Flagged], looked_at: frozenset[str]
) -> str:
    """Return where the flags of glint, shadow and neighbours are from."""
    told = []
    for name, line in lines.items():
        if name in flagged:
            told.append(str(flagged[name].line["quality"].attrs["flags_from"]))
        else:
            text = str(line["quality"].attrs.get("flags_from", "not said from what"))
            told.append(f"those of the store, {text}" if name in looked_at else "not looked for")
    return "; ".join(dict.fromkeys(told))


def _proposed(
    lines: Mapping[str, xr.Dataset], flagged: Mapping[str, Flagged], options: Mapping[str, Any]
) -> Regions:
    """Return the regions that are proposed on flight lines, by the surveys that there are.

    Raises
    ------
    SchemaError
        There is none; what was refused is told.
    """
    from hyperpaint.regions import Regions
    from hyperpaint.regions.proposals import propose_regions

    # with several lines, names of paints begin with that of their line
    made = {}
    for name, line in lines.items():
        paint = "paint" if len(lines) == 1 else f"{name}_paint"
        done = flagged.get(name)
        seen, model = (line, None) if done is None else (done.seen, done.model)
        # beside a model, the survey's other options were used already
        taken = _SHARED if done else set(options) - {"edge"}
        known = {key: options[key] for key in taken if key in options}
        made[name] = propose_regions(seen, model, flightline=name, name=paint, **known)
    found = Regions(tuple(region for proposals in made.values() for region in proposals))
    if not len(found):
        refused = [text for proposals in made.values() for text in proposals.table().splitlines()]
        shown = "".join(f"\n  {text}" for text in refused[:_MOST_TOLD])
        raise SchemaError(
            f"no region can be proposed, {len(refused)} were refused; draw some, and name them{shown}"
        )
    return found


def _excluded(keep: Sequence[str]) -> Quality:
    from hyperpaint.paints.signatures import EXCLUDED

    known = {str(flag.name).lower(): flag for flag in Quality}
    if unknown := [name for name in keep if name.lower() not in known]:
        raise SchemaError(f"no flag {', '.join(map(repr, unknown))}; flags are {', '.join(known)}")
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
