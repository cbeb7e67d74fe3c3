"""Twelve ways to misunderstand a navigation record, each as the record that is then read wrongly."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from hyperpaint.base.attitude_conventions import Convention
from support.wobbly_flights import Flight

DECLARED = Convention(column_order="left_to_right", stamp_reference="mid")
Made = tuple[xr.Dataset, xr.Dataset, Convention]


def _times(factor: float, *names: str) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda nav: nav.assign({name: nav[name] * factor for name in names})


def _more(by: float, name: str) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda nav: nav.assign({name: nav[name] + by})


def _ordered(order: str) -> Callable[[xr.Dataset], xr.Dataset]:
    def made(nav: xr.Dataset) -> xr.Dataset:
        turned = Rotation.from_euler(
            "ZYX", np.stack([nav[n].values for n in ("heading", "pitch", "roll")], -1), degrees=True
        )
        angles = dict(zip(order, turned.as_euler(order, degrees=True).T, strict=True))
        return nav.assign(
            {n: ("navigation_time", angles[a]) for n, a in (("roll", "X"), ("pitch", "Y"), ("heading", "Z"))}
        )

    return made


def _swapped(nav: xr.Dataset) -> xr.Dataset:
    return nav.assign(latitude=nav.longitude, longitude=nav.latitude)


#: What is misunderstood: the field of the check, and what the record then holds.
RECORDS: dict[str, tuple[str, Callable[[xr.Dataset], xr.Dataset]]] = {
    "roll positive with the right wing up": ("roll_positive", _times(-1, "roll")),
    "pitch positive with the nose down": ("pitch_positive", _times(-1, "pitch")),
    "heading counterclockwise": ("heading_positive", _times(-1, "heading")),
    "radians taken for degrees": ("angle_unit", _times(np.pi / 180, "roll", "pitch", "heading")),
    "rotations in the order XYZ": ("euler_order", _ordered("XYZ")),
    "rotations in the order ZXY": ("euler_order", _ordered("ZXY")),
    "magnetic north, declination -11": ("heading_reference", _more(11.0, "heading")),
    "heights above a geoid at -32 m": ("height_reference", _more(32.0, "altitude")),
    "latitude and longitude swapped": ("positions", _swapped),
}  # fmt: skip


def cases(flight: Flight) -> dict[str, tuple[str, Callable[[], Made]]]:
    # Return the twelve: the name of what is wrong, and what makes line, record and declaration
    line, nav = flight.line(), flight.navigation()
    made: dict[str, Any] = {
        name: (field, lambda change=change: (line, change(nav), DECLARED))
        for name, (field, change) in RECORDS.items()
    }
    degrees = DECLARED.replace(angle_unit="radian")
    made["degrees taken for radians"] = ("angle_unit", lambda: (line, nav, degrees))
    other = line.isel(cross_track=slice(None, None, -1)).assign_coords(cross_track=line.cross_track)
    made["columns from right to left"] = ("column_order", lambda: (other, nav, DECLARED))
    late = np.timedelta64(round(flight.exposure * 1e9), "ns")
    early = line.assign_coords(time=line.time + late)
    end = DECLARED.replace(stamp_reference="start")
    made["stamps of the end taken for the start"] = ("stamp_reference", lambda: (early, nav, end))
    return made


def right(flight: Flight) -> Made:
    # Return a line and a record that mean what is declared
    return flight.line(), flight.navigation(), DECLARED


def flown(seed: int, **changes: Any) -> Flight:
    # Return one of many flights: other courses, winds, mountings, places
    rng = np.random.default_rng([seed, 99])
    made = Flight(
        seed=seed,
        wobble=("calm", "rough")[seed % 2],
        lines=1500,
        columns=320,
        heading=float(rng.uniform(0, 360)),
        crab=float(rng.uniform(-8, 8)),
        latitude=float(rng.uniform(25, 60)),
        longitude=float(rng.uniform(-120, 30)),
        boresight=tuple(rng.normal(0, 0.5, 3)),
    )
    return replace(made, **changes)
