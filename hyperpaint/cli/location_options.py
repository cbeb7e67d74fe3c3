"""Options that say where a flight line lies, which commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click

from .console import EXISTING

_THREE = click.Tuple([float, float, float])
_OPTIONS = (
    click.option("--ground", type=float, metavar="M", help="Height of level ground."),
    click.option("--dem", type=EXISTING, metavar="FILE", help="Heights, instead of --ground."),
    click.option(
        "--dem-heights", type=click.Choice(["ellipsoid", "geoid"]),
        help="What the heights of --dem are above.",
    ),
    click.option("--geoid", type=float, metavar="M", help="Height of the geoid above the ellipsoid there."),
    click.option(
        "--field-of-view", type=float, metavar="DEGREE", help="Between the outer edges of the columns."
    ),
    click.option("--focal-length-mm", type=float, metavar="MM", help="With --pixel-pitch-um, instead."),
    click.option("--pixel-pitch-um", type=float, metavar="UM", help="Distance of columns on the detector."),
    click.option(
        "--column-order", type=click.Choice(["left_to_right", "right_to_left"]),
        help="Which way the columns go.",
    ),
    click.option(
        "--boresight", type=_THREE, metavar="R P H", help="Turn of the camera in the body [degree]."
    ),
    click.option("--lever-arm", type=_THREE, metavar="F R D", help="Camera from the antenna [m]."),
    click.option("--clock-offset", type=float, metavar="S", help="Added to line times."),
    click.option("--crs", metavar="EPSG:N", help="Map.  [default: UTM zone of the line]"),
)  # fmt: skip


def takes_location(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command with the options of `hyperpaint.workflows.maps.location_of`."""
    return functools.reduce(lambda inner, option: option(inner), reversed(_OPTIONS), command)
