"""Mixtures of paints, and shades of single paints."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import documented, one_of
from hyperpaint.base.schema import SIGNATURE
from hyperpaint.base.units import takes_quantities

from .kubelka_munk import coating_of
from .synthetic_paints import MEMBERS, SPECULAR, specular_of, synthetic_library

Method = Literal["kubelka-munk", "linear"]

#: How paints are mixed: as pigments in a pot, or as areas side by side.
METHODS = ("kubelka-munk", "linear")


@takes_quantities()
@documented(library="opaque library")
def mix_paints(
    library: xr.Dataset,
    recipes: Mapping[str, Mapping[str, float]],
    *,
    method: Method = "kubelka-munk",
    scattering: Mapping[str, float] | None = None,
    k1: float = 0.04,
    k2: float = 0.60,
    mirrored: Any = None,
) -> xr.Dataset:
    r"""Mix paints of a library into new ones.

    Parameters
    ----------
    library
    recipes
        Parts of each parent by its name, for every new paint by its name. Only the ratio of the parts
        matters.
    method
        "kubelka-munk" mixes pigments in a pot: absorption and scattering add up. "linear" mixes areas side by
        side, as a pixel does: reflectances add up.
    scattering
        Relative scattering of a part of a paint [1], by name; 1 by default. White (rutile) scatters several
        times more than coloured pigments.
    k1, k2
        Reflectance of the coat for light from outside, and for diffuse light from inside [1]; the defaults
        are for an index of 1.5. Not used by "linear".
    mirrored
        Part of the library's reflectance that the coat mirrors [1], a number or one a band. By default 0
        where the library excludes it (attribute ``mirror_reflection``), else k1. Outdoors it is about k1
        times the diffuse fraction of the light.

    Returns
    -------
    Dataset
        A paint library with ``reflectance`` (signature, band), float32 [1], 0 to 1, including mirrored light
        where the library does. ``member_reflectance`` (signature, member, band), where all parents have
        members: the first members of all parents are mixed, then the second, up to the smallest number of
        members; NaN beyond; with ``reflectance_sd`` and ``reflectance_quantiles``. Coordinates ``provenance``
        ("synthetic"), ``parents``, ``weights`` (JSON, normalised to 1) and ``method`` (signature).

    Raises
    ------
    SchemaError
        The library lacks variables; recipes name unknown or ambiguous paints, or negative parts; an option is
        invalid; or paints are darker than the mirrored light in them. All are listed.
    UnitsError
        Units cannot be read.

    Warns
    -----
    PaintWarning
        Some reflectances are impossible for such a layer, or outside 0 to 1 with "linear"; they are replaced
        by the nearest possible value. Parents of a paint have different numbers of members.

    Notes
    -----
    With the shares c, scattering s and K/S of each parent q,

    .. math:: q_{mix} = \sum_i c_i s_i q_i \Big/ \sum_i c_i s_i

    (Duncan, Proc. Phys. Soc. 52, 390, 1940; with equal s the single-constant theory), where q follows from
    reflectance through Saunderson's correction, see `hyperpaint.paints.mixing.kubelka_munk`. Absorption
    dominates: one part of black in nine of white darkens by far more than a tenth. The
    ``specular_reflectance`` of a library is averaged. A band that is NaN in one parent is NaN. Eager.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> paints = starter_library(members=0)
    >>> white, black = "Synthetic Polar White", "Synthetic Carbon Black"
    >>> grey = {"grey": {white: 9, black: 1}}
    >>> for method in ("kubelka-munk", "linear"):
    ...     mixed = mix_paints(paints, grey, method=method)
    ...     print(method, mixed.reflectance.mean().item().__round__(2))
    kubelka-munk 0.1
    linear 0.64
    >>> mixed.weights.item()
    '[0.9, 0.1]'
    """
    shares = _checked(library, recipes, method, scattering)
    parents = list(dict.fromkeys(name for recipe in shares.values() for name in recipe))
    values = _spectra(library, parents)
    weights = np.array([[recipe.get(name, 0.0) for name in parents] for recipe in shares.values()])
    specular = {SPECULAR: _averaged(weights, values[SPECULAR])} if SPECULAR in values else {}
    settings: dict[str, Any] = {}
    if method == "linear":
        areas = {name: _averaged(weights, array) for name, array in values.items() if name != SPECULAR}
        for array in areas.values():
            outside = int(((array < 0.0) | (array > 1.0)).sum())
            if outside:
                finite_count = int(np.isfinite(array).sum())
                msg = f"{outside} of {finite_count} reflectances clipped to 0 to 1; check the scale"
                warnings.warn(PaintWarning(msg, code="reflectance-clipped"), stacklevel=2)
        mix = {name: np.clip(array, 0.0, 1.0) for name, array in areas.items()}
    else:
        coating = coating_of(library, k1, k2, mirrored)
        scatter = np.array([(scattering or {}).get(name, 1.0) for name in parents])
        relative = weights * scatter / (weights @ scatter)[:, np.newaxis]
        mix = {
            name: coating.reflectance(_averaged(relative, coating.ratio(array, parents)))
            for name, array in values.items()
            if name != SPECULAR
        }
        factors = ", ".join(f"{name} {number:g}" for name, number in (scattering or {}).items())
        settings = {"k1": k1, "k2": k2, "scattering": factors if scattering is not None else "equal"}
    if MEMBERS in values:
        _warn_of_unpaired(weights > 0.0, values[MEMBERS])
    values = _trimmed(specular | mix)
    return synthetic_library(library, list(shares), values, list(shares.values()), method, **settings)


@takes_quantities()
@documented(library="opaque library")
def shade_paints(
    library: xr.Dataset, depths: Sequence[float], *, k1: float = 0.04, k2: float = 0.60, mirrored: Any = None
) -> xr.Dataset:
    r"""Make every paint of a library lighter and deeper: a ladder of depths of shade.

    Parameters
    ----------
    library
    depths
        Depths of shade relative to the paint [1]: pigment per scatterer. 0.1 is a tint, one part of the paint
        in nine of a white without absorption; 2 has twice the pigment. To darken with black, mix it in with
        `hyperpaint.paints.mix_paints`.
    k1, k2, mirrored
        See `hyperpaint.paints.mix_paints`.

    Returns
    -------
    Dataset
        A paint library as from `hyperpaint.paints.mix_paints`, every paint at every depth, named
        ``"<paint> x <depth>"``, with the coordinate ``depth`` (signature) [1].

    Raises
    ------
    SchemaError
        The library lacks variables, a depth is not above 0, an option is invalid, or paints are darker than
        the mirrored light in them. All of a kind are listed.
    UnitsError
        Units cannot be read.

    Warns
    -----
    PaintWarning
        Some reflectances are impossible for such a layer; they are replaced by the nearest possible value.

    Notes
    -----
    K/S is multiplied by the depth, see `hyperpaint.paints.mixing.kubelka_munk`. Eager.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> red = starter_library(members=0).isel(signature=[5])
    >>> ladder = shade_paints(red, [0.1, 1.0])
    >>> ladder["signature"].values.tolist(), ladder.reflectance[:, :60].mean("band").values.round(2)
    (['Synthetic Signal Red x 0.1', 'Synthetic Signal Red x 1'], array([0.15, 0.02], dtype=float32))
    """
    factors = np.asarray(depths, np.float64)
    if factors.ndim != 1 or not factors.size or not ((factors > 0.0) & np.isfinite(factors)).all():
        raise SchemaError(
            f"depths={depths!r:.60}",
            expected="numbers above 0, such as [0.1, 0.5, 2]",
            code="value-out-of-range",
        )
    _require(library)
    names = [str(name) for name in library[SIGNATURE].values]
    coating = coating_of(library, k1, k2, mirrored)
    values = _spectra(library, None)
    count = len(names)
    spectra: dict[str, Floats] = {}
    for name, array in values.items():
        if name == SPECULAR:
            spectra[name] = np.repeat(array, factors.size, axis=0)
            continue
        scale = np.tile(factors, count).reshape(-1, *[1] * (array.ndim - 1))
        spectra[name] = coating.reflectance(
            np.repeat(coating.ratio(array, names), factors.size, axis=0) * scale
        )
    shades = [f"{name} x {depth:g}" for name in names for depth in factors.tolist()]
    parents = [{name: 1.0} for name in names for _ in factors]
    shaded = synthetic_library(
        library, shades, _trimmed(spectra), parents, "kubelka-munk shade", k1=k1, k2=k2
    )
    attrs = {"long_name": "Pigment relative to that of the parent", "units": "1"}
    return shaded.assign_coords(depth=(SIGNATURE, np.tile(factors, count), attrs))


def _averaged(weights: Floats, values: Floats) -> Floats:
    # Weighted sums (mixture, ..., band) of values (parent, ..., band); NaN with weight 0 does not count.
    # Takes `weights` (mixture, parent).
    sums = np.zeros((len(weights), *values.shape[1:]))
    for row, shares in zip(sums, weights, strict=True):
        for number in np.flatnonzero(shares):
            row += shares[number] * values[number]
    return sums


def _require(library: xr.Dataset) -> None:
    names = [SIGNATURE, "reflectance", "wavelength"]
    schema.require(library, names, "new paints", schema.LIBRARY_VARIABLES)


def _spectra(library: xr.Dataset, parents: list[str] | None) -> dict[str, Floats]:
    # Spectra to mix by variable, float64 [1]; `parents` None selects all paints
    if parents is not None:
        names = [str(name) for name in library[SIGNATURE].values]
        library = library.isel({SIGNATURE: [names.index(name) for name in parents]})
    names = [name for name in ("reflectance", MEMBERS) if name in library.variables]
    variables = schema.require(library, names, "new paints", schema.LIBRARY_VARIABLES)
    spectra = {name: np.asarray(array.values, np.float64) for name, array in variables.items()}
    if SPECULAR in library.variables:
        spectra[SPECULAR] = np.asarray(specular_of(library), np.float64)
    if MEMBERS in spectra:
        # members of parents are mixed in pairs: missing members are sorted to the end
        absent = ~np.isfinite(spectra[MEMBERS]).any(axis=2)
        order = np.argsort(absent, axis=1, kind="stable")[:, :, np.newaxis]
        spectra[MEMBERS] = np.take_along_axis(spectra[MEMBERS], order, axis=1)
    return spectra


def _trimmed(values: dict[str, Floats]) -> dict[str, Floats]:
    # Spectra without the members that all paints lack
    if MEMBERS not in values:
        return values
    count = int(np.isfinite(values[MEMBERS]).any(axis=2).sum(axis=1).max(initial=0))
    result = {name: array for name, array in values.items() if name != MEMBERS}
    return {**result, MEMBERS: values[MEMBERS][:, :count]} if count else result


def _warn_of_unpaired(has_parent: Bools, members: Floats) -> None:
    # Warn of members without a partner among the other parents.
    # Takes `has_parent` (mixture, parent); `members` (parent, member, band).
    counts = np.isfinite(members).any(axis=2).sum(axis=1)
    unpaired = np.array([int((counts[row] - counts[row].min()).sum()) for row in has_parent])
    if unpaired.any():
        msg = (
            f"{unpaired.sum()} members of the parents of {int((unpaired > 0).sum())} of {len(unpaired)} "
            "paints have no partner and were excluded; draw the same number of members of each parent with "
            "sample_paints first"
        )
        warnings.warn(PaintWarning(msg, code="members-unpaired"), stacklevel=3)


def _checked(
    library: xr.Dataset,
    recipes: Mapping[str, Mapping[str, float]],
    method: str,
    scattering: Mapping[str, float] | None,
) -> dict[str, dict[str, float]]:
    _require(library)
    problems = Problems("paints cannot be mixed", SchemaError)
    paint_names = [str(name) for name in library[SIGNATURE].values]
    one_of(method, METHODS, "method", problems=problems)
    if not recipes:
        problems.add(
            "recipes= is empty",
            mend='pass at least one recipe, such as {"grey": {"white": 9, "black": 1}}',
            code="empty-input",
        )
    shares = {}
    for name, recipe in recipes.items():
        for parent in recipe:
            _check_name(str(parent), f"{name!r}", paint_names, problems)
        parts = np.array([*recipe.values()], np.float64)
        if not (parts.size and np.isfinite(parts).all() and (parts >= 0.0).all() and parts.sum() > 0.0):
            problems.add(
                f"{name!r}: parts are {list(recipe.values())}",
                expected="0 or more, not all 0",
                code="value-out-of-range",
            )
        elif not len(problems):
            shares[str(name)] = dict(zip(recipe, (parts / parts.sum()).tolist(), strict=True))
    for name, number in (scattering or {}).items():
        _check_name(name, "scattering", paint_names, problems)
        if not 0.0 < number < np.inf:
            problems.add(
                f"scattering of {name!r} is {number!r}",
                expected="a number above 0",
                code="value-out-of-range",
            )
    problems.raise_if_any()
    return shares


def _check_name(name: str, subject: str, paint_names: list[str], problems: Problems) -> None:
    count = paint_names.count(name)
    if count > 1:
        problems.add(
            f"{subject}: {count} paints are named {name!r}",
            mend="give them different names, or select one of them with isel",
            code="paint-ambiguous",
        )
    elif not count:
        close = difflib.get_close_matches(name, paint_names, 1)
        mend = f"did you mean {close[0]!r}?" if close else ""
        problems.add(f"{subject}: there is no paint {name!r}", mend=mend, code="paint-unknown")
