"""From a line with its truth to the product's signatures: right, wide, wrong or refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

SNR = 100.0
MAX_SHAPE, MAX_RELATIVE_SHAPE, DARK_SHAPE, DARK = 0.01, 0.05, 0.004, 0.1
"""Root mean square of what is left of a spectrum after one factor, at most: the larger of 0.01 and 5 % of its
level [1]; of paint darker than 0.1, the larger of 0.004 and 5 %, since 0.01 would be no limit there."""
MAX_LEVEL, MAX_RELATIVE_LEVEL = 0.004, 0.06
"""Error of the mean over the bands, at most: the larger of both, or the stated 95 % interval [1]."""
MAX_HALF_WIDTH, DARK_HALF_WIDTH, DARK_LEVEL = 0.10, 0.004, 0.03
"""Half width of the stated 95 % interval, at most: relative, and in reflectance below `DARK_LEVEL` [1]."""
NORMAL_95 = 1.96
ROOF_DROP_M = 0.10
"""Height below the highest paint of a car within which its paint is roof [m]."""


@dataclass(frozen=True)
class Verdict:
    """What became of a car, or of a region that is on none."""

    source: str  #: Whose renderer.
    seed: int
    sky: str
    sun_zenith: float  #: [degree]
    car: str  #: Empty for a region elsewhere.
    paint: str
    finish: str  #: True: "solid", "metallic", "pearl"; "none" where it is no paint.
    colour: str
    result: str  #: "right"; "wide": right, with a wider interval than is of use; "wrong"; "refused".
    told: str = ""  #: Why it was refused, or what is wrong.
    stated_finish: str = ""
    kind: str = ""
    shape: float = np.nan  #: [1]
    level: float = np.nan  #: Signature over truth [1].
    true_level: float = np.nan  #: [1]
    is_covered: bool | None = None  #: Whether the level lies in the stated 95 % interval; None without one.
    half_width: float = np.nan  #: Of that interval, relative to the signature's level [1].
    name: str = ""  #: Of the region.
    by_hand: bool = False  #: Whether a person drew the region.
    fleet: str = "real"  #: "real", or "black": a scene of black cars only.
    sun_is_free: bool = True  #: Of broken clouds: whether the sun was free for seconds around the line.


def looked_at(line: Any) -> tuple[Any, Any, Any]:
    """Return reflectance from noisy radiance, its scene model, and the line with flags."""
    import hyperpaint as hp

    radiance = line["radiance"]
    noise = 1.0 + np.random.default_rng([line.attrs["seed"], 7]).normal(size=radiance.shape) / SNR
    noisy = line.assign(radiance=radiance.copy(data=(radiance.values * noise).astype(np.float32)))
    seen = hp.reflectance(_placed(noisy)).compute()
    model = hp.surroundings.survey(seen)
    return seen, model, hp.surroundings.flag(seen, model).compute()


def _placed(line: Any) -> Any:
    """Return a line with times, a place on Earth where the sun stands as it is rendered, and its heading.

    The camera flies north.
    """
    zenith, azimuth = line.attrs["sun_zenith"], line.attrs["sun_azimuth"]
    moment, latitude, longitude = _where_sun_stands(zenith, azimuth)
    shift = moment - line["time"].values[0]
    names = ("time", "irradiance_time")
    line = line.assign_coords({name: line[name].copy(data=line[name].values + shift) for name in names})
    one = np.ones(line.sizes["along_track"])
    columns = {"latitude": latitude * one, "longitude": longitude * one, "heading": 0.0 * one}
    degrees = {"latitude": "degrees_north", "longitude": "degrees_east", "heading": "degree"}
    return line.assign(
        {name: ("along_track", column, {"units": degrees[name]}) for name, column in columns.items()}
    )


def _where_sun_stands(zenith: float, azimuth: float) -> tuple[Any, float, float]:
    """Return time, latitude and longitude [degree] where the sun stands at two angles [degree].

    From sin d = sin(latitude) cos(zenith) + cos(latitude) sin(zenith) cos(azimuth), d the declination, of
    the first of three days on which there is such a latitude; refined by the product's own ephemeris.
    """
    from scipy.optimize import fsolve

    from hyperpaint.light.sun import solar_position

    a, z = np.radians(azimuth), np.radians(zenith)
    length, turn = np.hypot(np.cos(z), np.sin(z) * np.cos(a)), np.arctan2(np.sin(z) * np.cos(a), np.cos(z))
    for day, declination in (("2026-06-21", 23.44), ("2026-09-22", 0.0), ("2026-12-21", -23.44)):
        sine = np.sin(np.radians(declination)) / length
        latitude = np.arcsin(np.clip(sine, -1.0, 1.0)) - turn
        if abs(sine) > 1.0 or abs(latitude) > np.radians(70.0):
            continue
        moment = np.datetime64(f"{day}T12:00", "ns")
        above = np.cos(z) - np.sin(latitude) * np.sin(np.radians(declination))
        hour = np.arctan2(-np.sin(a) * np.sin(z), above / np.cos(latitude))

        def off(place: Any, moment: Any = moment) -> list[float]:
            at = solar_position(moment, *place)
            return [float(at[0]) - zenith, float(at[1]) - azimuth]

        latitude, longitude = fsolve(off, np.degrees([latitude, hour]))
        return moment, float(latitude), float(longitude)
    raise ValueError(f"nowhere stands the sun {zenith} degrees from the zenith at azimuth {azimuth}")


def extracted(flagged: Any, regions: Any) -> Any:
    """Return the library of signatures; None where every region has too few pixels left."""
    import hyperpaint as hp

    try:
        return hp.extract_signatures(flagged, regions, specular_sky=True, drop_small=True).compute()
    except hp.errors.SchemaError as error:
        if "too few pixels" in str(error):
            return None
        raise


def whole_cars(line: Any, names: Sequence[str]) -> list[int]:
    """Return the instances of cars that do not touch the edge of the picture."""
    instance = line["instance"].values
    cut = np.concatenate([instance[0], instance[-1], instance[:, 0], instance[:, -1]])
    return [int(one) for one in np.setdiff1d(instance, cut) if one >= 0 and names[one].startswith("car_")]


def drawn_roofs(line: Any, truth_of: Any) -> Any:
    """Return regions as a person draws them: a quadrilateral over the roof of every whole car.

    The corners are those of the roof's rectangle, drawn in by an eighth of its sides and off by a pixel or
    so; the person knows the finish of the car, and not where its roof is level. None are drawn where a line
    has no heights ``up`` [m].
    """
    from hyperpaint.regions import Region, Regions

    rng = np.random.default_rng([line.attrs["seed"], 13])
    names = [thing["name"] for thing in json.loads(line.attrs["instances"])]
    drawn = []
    for car in whole_cars(line, names) if "up" in line else ():
        up = np.where((line["instance"].values == car) & (line["paint_id"].values >= 0), line["up"], -np.inf)
        roof = np.nonzero(up > up.max() - ROOF_DROP_M)
        # cars stand across the flight: the roof is drawn along the axes of the picture
        (top, bottom), (left, right) = (np.quantile(at, (0.14, 0.86)) for at in roof)
        corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
        corners += rng.normal(0.0, 0.7, corners.shape)
        words = truth_of(line, *roof, spectrum=False).words
        if words["finish"] != "none":
            properties = {"kind": "roof", "finish": words["finish"]}
            drawn.append(Region(names[car], corners.tolist(), properties=properties))
    return Regions(tuple(drawn))


def judged(line: Any, truth_of: Any, scene: Any = None) -> list[Verdict]:
    """Return a verdict on every whole car, on every region elsewhere, and on every region drawn by hand.

    ``truth_of`` takes a line and pixels (along, across), and returns the `Truth` of what most of them show,
    with ``spectrum=False`` in words only; ``scene`` is what `looked_at` returns, made where it is not given.
    """
    import hyperpaint as hp
    from hyperpaint.regions import pixels_of

    seen, model, flagged = scene or looked_at(line)
    proposals = hp.regions.propose_regions(seen, model)
    names = [one["name"] for one in json.loads(line.attrs["instances"])]
    instance = line["instance"].values
    whole = whole_cars(line, names)
    case = {
        "source": line.attrs["source"], "seed": int(line.attrs["seed"]), "sky": line.attrs["sky"],
        "sun_zenith": float(line.attrs["sun_zenith"]), "fleet": line.attrs.get("fleet", "real"),
        "sun_is_free": bool(line.attrs.get("sun_is_free", 1)),
    }  # fmt: skip
    verdicts: list[Verdict] = []
    for regions, by_hand in ((proposals, False), (drawn_roofs(line, truth_of), True)):
        library = extracted(flagged, regions) if len(regions) else None
        for region, (along, across) in zip(regions, pixels_of(regions, line), strict=True):
            at = int(np.bincount(instance[along, across]).argmax())
            outcome = compared(library, region, truth_of(line, along, across))
            car = names[at] if at in whole else ""
            verdicts.append(Verdict(**case, car=car, name=region.name, by_hand=by_hand, **outcome))
    proposed = {one.car for one in verdicts if not one.by_hand}
    refusals: dict[str, list[str]] = {}
    for region, (along, across) in zip(proposals.refused, pixels_of(proposals.refused, line), strict=True):
        at = int(np.bincount(instance[along, across]).argmax())
        refusals.setdefault(names[at], []).extend(region.properties["refused"])
    for at in whole:
        if names[at] not in proposed:
            pixels = np.nonzero((instance == at) & (line["paint_id"].values >= 0))
            truth = truth_of(line, *pixels, spectrum=False)
            told = " | ".join(dict.fromkeys(refusals.get(names[at], ["NO REASON GIVEN"])))
            verdicts.append(Verdict(**case, car=names[at], **truth.words, result="refused", told=told))
    return verdicts


@dataclass(frozen=True)
class Truth:
    """What a region truly shows."""

    words: dict[str, str]  #: paint, finish, colour.
    spectrum: Any  #: (band,): What a signature of it is compared with [1]; None of what is no paint.


def compared(library: Any, region: Any, truth: Truth) -> dict[str, Any]:
    """Return what is said of a region's signature."""
    stated = str(region.properties.get("finish", ""))
    row: dict[str, Any] = {**truth.words, "stated_finish": stated, "kind": region.properties["kind"]}
    if library is None or region.name not in library["signature"].values:
        return row | {"result": "refused", "told": "too few pixels are left after the flags"}
    if truth.spectrum is None:
        return row | {"result": "wrong", "told": "no paint"}
    signature = library.sel(signature=region.name)
    seen = signature["reflectance"].values.astype(np.float64)
    good = np.isfinite(seen)
    true = truth.spectrum
    if truth.words["finish"] != "solid" and "coat_transmission" in signature:
        # of flakes the truth is through the coat; the product divides all paints by what a coat lets through
        true = true / signature["coat_transmission"].values
    seen, true = seen[good], true[good]
    factor = float(seen @ true / (seen @ seen))
    shape = float(np.sqrt(np.mean((factor * seen - true) ** 2)))
    level = float(true.mean())
    off = abs(float(seen.mean()) - level)
    most = max(MAX_SHAPE if level >= DARK else DARK_SHAPE, MAX_RELATIVE_SHAPE * level)
    faults = []
    if shape > most:
        faults.append(f"shape off by {shape:.4f}, {most:.4f} allowed")
    width = _level_sd(signature)
    half_width = np.nan if width is None else NORMAL_95 * width
    if off > max(MAX_LEVEL, MAX_RELATIVE_LEVEL * level, 0.0 if width is None else half_width):
        faults.append(f"level {seen.mean():.4f}, true {level:.4f}, stated to {half_width:.4f}")
    if stated == "solid" and truth.words["finish"] != "solid":
        faults.append(f"stated solid, and {truth.words['finish']}")
    most = max(MAX_HALF_WIDTH * float(seen.mean()), DARK_HALF_WIDTH if level < DARK_LEVEL else 0.0)
    result = "wrong" if faults else "right" if half_width <= most else "wide"
    return row | {
        "result": result, "told": "; ".join(faults), "shape": shape, "level": float(seen.mean()) / level,
        "true_level": level, "is_covered": None if width is None else bool(off <= half_width),
        "half_width": half_width / float(seen.mean()),
    }  # fmt: skip


def _level_sd(signature: Any) -> float | None:
    """Return the stated standard uncertainty of the mean over the bands [1]; None where nothing is stated.

    What is systematic, or of the coat, moves all bands together; what is random averages out over them.
    """
    together = ("reflectance_u_systematic", "reflectance_u_coat")
    stated_ones = [name for name in together if name in signature and np.isfinite(signature[name]).any()]
    parts = [float(np.nanmean(signature[name].values)) for name in stated_ones]
    random = signature["reflectance_u_random"].values
    if np.isfinite(random).any():
        parts.append(float(np.sqrt(np.nanmean(random**2) / np.isfinite(random).sum())))
    if "level_uncertainty" in signature.coords and np.isfinite(signature["level_uncertainty"]):
        level = float(np.nanmean(signature["reflectance"].values))
        parts.append(float(signature["level_uncertainty"]) * level)
    return float(np.hypot.reduce(parts)) if parts else None
