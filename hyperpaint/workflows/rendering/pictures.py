"""The renders of a store, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hyperpaint.base.errors import MissingExtraError, StoreError

__all__ = ["draw_renders"]

_WIDTH, _DPI = 4.0, 150  # of one picture [inch]


def draw_renders(store: Path, groups: Sequence[str], path: Path) -> None:
    """Draw the stored overviews of renders side by side, north up.

    Parameters
    ----------
    store
        Written by `hyperpaint.render_scene`.
    groups
        Groups of the store; those without an overview are passed over.
    path
        The picture: its suffix says its format.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    StoreError
        No group has an overview: there are fewer than three visible bands; or the format is not known.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        needed = MissingExtraError.of("matplotlib", "viz", "a picture")
        raise needed from error
    from hyperpaint.io.store import open_store

    opened = {group: open_store(store, group) for group in groups}
    shown = {group: made["overview"] for group, made in opened.items() if "overview" in made}
    if not shown:
        raise StoreError(f"{store} has no overview to draw: a picture takes three visible bands")
    lines, columns = next(iter(shown.values())).shape[:2]
    size = (_WIDTH * len(shown), _WIDTH * min(lines / columns, 5.0) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    for axes, (group, picture) in zip(
        figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True
    ):
        # the first line is the southernmost of a flight to the north
        axes.imshow(picture.values, origin="lower", interpolation="nearest")
        axes.set_title(group.rpartition("/")[2].replace("_", " "))
        axes.set_axis_off()
    try:
        figure.savefig(path, dpi=_DPI)
    except ValueError as error:
        raise StoreError(f"{path}: {error}") from error
