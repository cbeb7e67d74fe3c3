"""Which pieces are of the same car, and which of them is the level one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hyperpaint.scene_model import SceneModel

from .candidates import Measures, Piece
from .judging import Verdict, judge_lean
from .surroundings import Surfaces, extent

__all__ = ["Judged", "group_by_car", "settle"]

Judged = tuple[Piece, Measures, Verdict]

_SAME_PAINT = np.cos(np.radians(5.0))
_FARTHEST = 300.0
_GROUND = 3
_LEAST_WINDOW = 6
_ELONGATED, _STRIP, _LONGER = 1.1, 4.0, 1.3


def group_by_car(judged: list[Judged], model: SceneModel, surfaces: Surfaces) -> list[list[Judged]]:
    """Return pieces that could be paint, those of one car together.

    Two are of one car where their spectra are the same but for brightness, and on the straight way from one
    to the other there is a window and no ground.
    """
    parts = [one for one in judged if one[2].kind and not one[2].scenery]
    group = list(range(len(parts)))
    for later in range(len(parts)):
        for earlier in range(later):
            if _linked(parts[earlier], parts[later], model, surfaces):
                old, new = group[later], group[earlier]
                group = [new if one == old else one for one in group]
    return [
        [part for part, of in zip(parts, group, strict=True) if of == name] for name in dict.fromkeys(group)
    ]


def _linked(one: Judged, other: Judged, model: SceneModel, surfaces: Surfaces) -> bool:
    if (one[2].kind == "dark paint") != (other[2].kind == "dark paint"):
        return False
    spectra = [np.nan_to_num(model.reference[each[0].body]) for each in (one, other)]
    length = float(np.linalg.norm(spectra[0]) * np.linalg.norm(spectra[1]))
    if float(spectra[0] @ spectra[1]) < _SAME_PAINT * length:
        return False
    start, stop = (_middle(each[0]) for each in (one, other))
    far = float(np.hypot(*(stop - start)))
    if far > _FARTHEST:
        return False
    steps = np.linspace(0.0, 1.0, max(2, int(np.ceil(far)) + 1))[:, None]
    y, x = np.rint(start + steps * (stop - start)).astype(np.int64).T
    way = model.segment[y, x]
    way = way[way >= 0]
    off = (surfaces.ground | surfaces.shade)[way] & ~surfaces.dark[way]
    runs = np.convolve(off, np.ones(_GROUND), "valid")
    return bool(runs.max(initial=0.0) < _GROUND and surfaces.dark[way].sum() >= _LEAST_WINDOW)


def _middle(piece: Piece) -> npt.NDArray[np.float64]:
    return np.asarray(np.argwhere(piece.inside).mean(axis=0) + np.array(piece.first, np.float64))


def settle(group: list[Judged], zenith: float | None, shape: tuple[int, int]) -> None:
    """Find the roof of a car among its pieces, and object to the others.

    The level piece is the one with windows at both ends; without one, that with a window at one end which is
    longer than wide. Of dark paint it is the brightest, since windows are darker.
    """
    _name_the_roof(group, shape)
    for one in group:
        judge_lean(one[2], one[1], zenith)
    usable = [one for one in group if not one[2].objections]
    if not usable:
        return
    if usable[0][2].kind == "dark paint":
        best = max(usable, key=lambda one: float(np.nan_to_num(one[1].spectrum).mean()))
    else:
        best = max(usable, key=lambda one: (one[2].kind == "roof", one[2].score))
    for one in usable:
        if one is not best:
            one[2].objections.append(f"another part of the same car is better: {_place(best)}")


def _name_the_roof(group: list[Judged], shape: tuple[int, int]) -> None:
    """Call one piece the roof, and all others panels: a bonnet may lie between a window and a shadow."""
    # what lies in shadow as a whole is a window, seen as shadow of the paint beside it
    lit = [one for one in group if one[1].lost.get("shadow", 0.0) < 0.5]
    roofs = [one for one in lit if one[2].kind == "roof" or _is_long(one, lit, *shape)]
    if not roofs:
        return
    largest = max(int(one[0].inside.sum()) for one in roofs)
    best = max(roofs, key=lambda one: _surely_roof(one, largest))
    for one in group:
        if one[2].kind == "roof" and one is not best:
            one[2].kind = "panel"
    flanks = best[2].flanks
    if best[2].kind == "panel" and flanks is not None:
        best[2].kind = "roof"
        text = f"a roof: {flanks.length:.0f} pixels long and {flanks.width:.0f} wide, longer than any bonnet"
        best[2].reasons.append(text)


def _surely_roof(one: Judged, largest: int) -> float:
    flanks = one[2].flanks
    return (
        0.0 if flanks is None else 0.5 * (flanks.sides + flanks.ends[1]) + 2.0 * one[0].inside.sum() / largest
    )


def _is_cut(piece: Piece, lines: int, columns: int) -> bool:
    """Tell whether a piece goes on beyond the picture."""
    (y, x), (height, width) = piece.first, piece.inside.shape
    return y == 0 or x == 0 or y + height >= lines or x + width >= columns


def _is_long(one: Judged, group: list[Judged], lines: int, columns: int) -> bool:
    """Tell whether a piece is longer than wide, as no bonnet is, and longer than all others of its car."""
    flanks = one[2].flanks
    if (
        flanks is None
        or _is_cut(one[0], lines, columns)
        or not _ELONGATED <= flanks.length / flanks.width <= _STRIP
    ):
        return False
    others = []
    for each in group:
        if each is not one:
            y, x = np.nonzero(each[0].inside)
            others.append(extent(y.astype(np.int64), x.astype(np.int64), flanks.axis)[0])
    return flanks.length >= _LONGER * max(others, default=0.0)


def _place(one: Judged) -> str:
    y, x = _middle(one[0])
    return f"that at line {y:.0f}, column {x:.0f}"
