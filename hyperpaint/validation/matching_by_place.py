"""Matches of references to paints by their positions, never by their spectra."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

#: Metres in a degree of latitude.
_METRES_PER_DEGREE = 111_195.0

#: Latitude and longitude [degree]; None where unknown.
Place = tuple[float, float] | None


class PlaceMatch(NamedTuple):
    # The paint at the place of a reference, or the reason why there is none.
    paint: int | None  #: Key of the paint.
    text: str
    near: frozenset[int]  #: Keys of paints within the accuracy.


def match_places(
    paints: Mapping[int, tuple[float, float]],
    names: Mapping[int, str],
    references: Sequence[Place],
    instruments: Sequence[str],
    accuracy_m: float,
) -> dict[int, PlaceMatch]:
    """Return the nearest paint of every reference, by the number of the reference.

    ``paints``: latitude and longitude [degree] by key; ``names``: names of paints; ``accuracy_m``: a paint
    beyond this distance is no match, nor is a paint where the next one is less than this farther away [m].
    Several references of one of the ``instruments`` at one paint may be readings of it or of other paints:
    none is a match.

    Examples
    --------
    >>> paints = {0: (43.0, -77.0), 1: (43.0, -76.9999)}
    >>> places = [(43.00001, -77.0), (43.0, -76.99995), (43.001, -77.0)]
    >>> for match in match_places(paints, {0: "red-01", 1: "red-02"}, places, ["SVC"] * 3, 5.0).values():
    ...     print(match.paint, match.text)
    0 1.1 m from red-01, 8.2 m from the next paint
    None ambiguous: 4.1 m from red-01, 4.1 m from red-02, with an accuracy of 5 m
    None 111.2 m from the nearest paint red-01, beyond 5 m
    """
    keys = list(paints)
    at = np.array(list(paints.values()), np.float64).reshape(-1, 2)
    matches = {}
    for number, place in enumerate(references):
        if place is None or not keys:
            continue
        steps = (at - place) * _METRES_PER_DEGREE
        distances = np.hypot(steps[:, 0], steps[:, 1] * np.cos(np.radians(place[0])))
        first, *others = np.argsort(distances, kind="stable")
        name, distance, paint = names[keys[first]], distances[first], None
        if distance > accuracy_m:
            text = f"{distance:.1f} m from the nearest paint {name}, beyond {accuracy_m:g} m"
        elif others and distances[others[0]] - distance < accuracy_m:
            further = f"{distances[others[0]]:.1f} m from {names[keys[others[0]]]}"
            text = f"ambiguous: {distance:.1f} m from {name}, {further}, with an accuracy of {accuracy_m:g} m"
        else:
            further = f", {distances[others[0]]:.1f} m from the next paint" if others else ""
            paint, text = keys[first], f"{distance:.1f} m from {name}{further}"
        matches[number] = PlaceMatch(
            paint, text, frozenset(keys[k] for k in np.flatnonzero(distances <= accuracy_m))
        )
    counts = Counter((match.paint, instruments[number]) for number, match in matches.items())
    for number, match in matches.items():
        count = counts[match.paint, instruments[number]]
        if match.paint is not None and count > 1:
            text = f"{match.text}, as {count - 1} more of its instrument: readings of it, or of other paints"
            matches[number] = match._replace(paint=None, text=text)
    return matches
