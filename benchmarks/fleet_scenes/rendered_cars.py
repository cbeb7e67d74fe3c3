"""Car parks of the real fleet, rendered by hyperpaint's own tracer, each under two skies.

A scene is 13 m of two rows of cars back to back, seen from 15 m with 3.5 to 5 cm and 60 bands, and is traced
once. Everything about it follows from its seed (`conditions_of`): the sun, 15 to 60 degrees from the zenith
and 66 to 76 in every fourth scene, the second of its skies, the size of broken clouds, and whether its cars
are black, as in every fifth scene. Cars lean: the ground falls by 1 to 1.5 %, and each car stands unevenly.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

BANDS, FWHM_NM = np.linspace(405.0, 995.0, 60), 6.0
LENGTH_M, SWATH_M, ALTITUDE_M = 13.0, 12.5, 15.0
SAMPLES = 48
SKIES = ("clear", "hazy", "broken", "overcast")
RECORD_S = 60.0
"""The irradiance record begins so long before a flight, and ends so long after it [s]."""
STATION_M = (25.0, 0.0)
"""East and north of the spectrometer that records the irradiance."""
_KEPT = (
    "radiance", "irradiance", "irradiance_fwhm", "irradiance_max_gap", "irradiance_clock_uncertainty",
    "instance", "paint_id", "shadow", "up",
)  # fmt: skip
DRAINAGE_PERCENT = (1.0, 1.5)
"""Fall of a car park towards its drains."""
STANCE_DEG = 0.3
"""Standard deviation of the lean of a car against its ground, along and across it [degree]."""
FREE_S = 2.5
"""The sun counts as free where it was so for this time before and after the line [s]."""


@dataclass(frozen=True)
class Conditions:
    """The light of a scene."""

    sun_zenith: float  #: [degree]
    sun_azimuth: float  #: [degree]
    gsd: float  #: [m]
    aerosol: float  #: Optical depth of the hazy sky [1].
    skies: tuple[str, ...]  #: Two of `SKIES`.
    fleet: str  #: "real", or "black": only black cars.
    cloud_size: float  #: Correlation length of broken clouds [m].
    fall: tuple[float, float]  #: Slope of the ground, and the azimuth towards which it falls [degree].


def conditions_of(seed: int) -> Conditions:
    """Return the light of a scene: suns spread evenly over the seeds, the other skies in turn."""
    rng = np.random.default_rng([seed, 2026])
    even = (seed * 0.6180339887) % 1.0
    zenith = 66.0 + 10.0 * even if seed % 4 == 3 else 15.0 + 45.0 * even
    gsd, azimuth, aerosol = rng.uniform(0.035, 0.05), rng.uniform(90.0, 270.0), rng.uniform(0.3, 0.4)
    slope = np.degrees(np.arctan(rng.uniform(*DRAINAGE_PERCENT) / 100.0))
    return Conditions(
        zenith,
        float(azimuth),
        float(gsd),
        float(aerosol),
        ("clear", SKIES[1 + seed % 3]),
        "black" if seed % 5 == 4 else "real",
        float(rng.choice([30.0, 120.0, 400.0])),
        (float(slope), float(rng.uniform(0.0, 360.0))),
    )


def skies_of(seed: int) -> tuple[str, ...]:
    """Return the names of a scene's skies."""
    return conditions_of(seed).skies


def line_of(seed: int, sky: str, cache: Path) -> Any:
    """Return a line as it was rendered under a sky; from the cache where it is there."""
    import xarray as xr

    from hyperpaint.base import NUMERICS_VERSION

    prefix = f"rendered_{NUMERICS_VERSION}_{seed}"
    path = cache / f"{prefix}_{sky}.zarr"
    if not path.exists():
        for name, line in _rendered(seed).items():
            store = cache / f"{prefix}_{name}.zarr"
            part = store.with_suffix(".part")
            line.to_zarr(part, mode="w", consolidated=False)
            part.replace(store)
    return xr.open_zarr(path, consolidated=False).load()


def _rendered(seed: int) -> dict[str, Any]:
    import hyperpaint as hp
    from hyperpaint.simulation.atmosphere import Atmosphere, BrokenClouds
    from hyperpaint.simulation.camera import BandSet
    from hyperpaint.simulation.rendering.car_parks import car_park
    from hyperpaint.simulation.rendering.platforms import pushbroom
    from hyperpaint.simulation.rendering.scene_spectra import fleet_paint

    light = conditions_of(seed)
    lines, columns = round(LENGTH_M / light.gsd), round(SWATH_M / light.gsd)
    around = ("walls", "trees") if seed % 2 else ("walls",)
    first = 1000 * seed
    black = [f"fleet-{car}" for car in range(first, first + 400) if fleet_paint(car).colour == "black"]
    park = car_park(
        length=LENGTH_M + 6.0, width=32.0, seed=seed, neighbours=around, margin=10.0, fleet="real",
        islands=False, occupancy=0.95, paints=black if light.fleet == "black" else None,
    )  # fmt: skip
    park = leaning(park, light.fall, np.random.default_rng([seed, 11]))
    flight = pushbroom(
        lines, columns, ground_sample=light.gsd, line_spacing=light.gsd, start=(-0.1, 3.0), wobble=0.1,
        altitude=ALTITUDE_M, seed=seed,
    )  # fmt: skip
    sun = light.sun_zenith, light.sun_azimuth
    clear = Atmosphere.clear(*sun)
    atmospheres = {
        "clear": clear,
        "hazy": Atmosphere.clear(*sun, aerosol=light.aerosol),
        "broken": clear,
        "overcast": clear.clouded(8),
    }
    suns = [clear, atmospheres["overcast"]] if "overcast" in light.skies else [clear]
    traced = hp.simulation.trace(park, flight, suns, samples=SAMPLES, seed=seed, sun_radius=0.267).compute()
    bands = BandSet(BANDS, np.full(BANDS.size, FWHM_NM))
    rendered = {}
    for name in light.skies:
        sky = atmospheres[name]
        clouds = None
        if name == "broken":
            clouds = BrokenClouds(cover=0.4, size=light.cloud_size, opacity=0.7, station=STATION_M, seed=seed)
        line = hp.simulation.relight(traced, bands, atmosphere=sky, variation=clouds)
        whole = [
            hp.simulation.relight(traced, bands, atmosphere=dark)["irradiance"].values[0]
            for dark in (replace(sky, sky=0.0 * sky.sky), replace(sky, sun=0.0 * sky.sun))
        ]
        seen = _with_record(line[list(_KEPT)].compute(), np.stack(whole), clouds)
        rendered[name] = _with_truth(seen, line, traced, sky, clouds, bands)
        rendered[name].attrs |= {"seed": seed, "sky": name, "source": "hyperpaint", **vars(light)}
        rendered[name].attrs["sun_is_free"] = int(_is_free(line, clouds))
    return rendered


def leaning(park: Any, fall: tuple[float, float], rng: Any) -> Any:
    """Return a car park whose cars lean with the fall of the ground, and each by itself, about its place."""
    from scipy.spatial.transform import Rotation

    slope, towards = np.radians(fall)
    vertices, normals = park.vertices.copy(), park.normals.copy()
    for number, instance in enumerate(park.instances):
        if instance.kind != "car":
            continue
        # a plane that falls towards an azimuth is turned about the horizontal axis to the right of it
        axis = slope * np.array([np.cos(towards), -np.sin(towards), 0.0])
        axis += np.radians(rng.normal(0.0, STANCE_DEG, 3)) * (1.0, 1.0, 0.0)
        turn = Rotation.from_rotvec(-axis)
        rows = np.unique(park.faces[park.face_instance == number])
        place = np.append(vertices[rows, :2].mean(axis=0), 0.0)
        vertices[rows] = turn.apply(vertices[rows] - place) + place
        normals[rows] = turn.apply(normals[rows])
    return replace(park, vertices=vertices, normals=normals)


def _is_free(line: Any, clouds: Any) -> bool:
    """Return whether the sun over the scene and over the record is free of clouds, also seconds around."""
    if clouds is None:
        return True
    seconds = (line["time"].values[[0, -1]] - line["time"].values[0]) / np.timedelta64(1, "s")
    around = np.linspace(seconds[0] - FREE_S, seconds[1] + FREE_S, 101)
    places = ((0.0, 0.0), (0.0, LENGTH_M), STATION_M)
    return bool(min(clouds.factors(*place, around)[0].min() for place in places) > 0.98)


def _with_record(line: Any, parts: Any, clouds: Any) -> Any:
    """Return a line whose record of direct and diffuse irradiance ``parts`` is one of minutes, at 1 Hz."""
    import xarray as xr

    first, last = line["time"].values[[0, -1]]
    length = int(RECORD_S + (last - first) / np.timedelta64(1, "s") + RECORD_S)
    seconds = np.arange(length + 1.0) - RECORD_S
    factors = np.ones((2, seconds.size))
    if clouds is not None:
        factors = clouds.factors(*clouds.station, seconds)
    dims = line["irradiance"].dims
    record = xr.DataArray((factors.T @ parts).astype(np.float32), dims=dims, attrs=line["irradiance"].attrs)
    time = first + (seconds * 1e9).astype("timedelta64[ns]")
    line = line.drop_dims(dims[0]).assign(irradiance=record)
    line["irradiance_max_gap"] = line["irradiance_max_gap"].copy(data=2.5)
    return line.assign_coords({dims[0]: (dims[0], time)})


def _with_truth(line: Any, lit: Any, traced: Any, sky: Any, clouds: Any, bands: Any) -> Any:
    """Return a line with the direction of view, and what its paints and its light truly are.

    ``dust`` (along_track, cross_track) is the row of ``dust_ratio`` (row, band): what a pixel's paint is to
    the mean of its car's. ``true_direct``, ``true_shares`` (band): of the light at the middle of the scene.
    """
    from hyperpaint.simulation.rendering.relighting import factor_spectra, populations_of, traced_sun
    from hyperpaint.simulation.rendering.scene import SceneRecord
    from hyperpaint.simulation.transport.mixing import member_rows

    record, settings = SceneRecord.from_attrs(traced.attrs)
    painted = factor_spectra(record, bands, None, None)
    populations = populations_of(record, painted, bands)
    planes = ("along_track", "cross_track")
    east, north, up = (lit[name].values for name in ("east", "north", "up"))
    # as the renderer draws them: in shade there is no angle to the mirrored sun
    sun = traced_sun(sky, settings)
    lit_by = traced[["sun_incidence", "sun_visibility"]].isel(sun=sun)
    is_sunny = (lit_by["sun_visibility"].values > 0.5) & bool(sky.sun.any())
    incidence = np.where(is_sunny, lit_by["sun_incidence"].values, np.nan)
    rows = member_rows(
        lit["material"].values, lit["instance"].values, east, north, up, incidence,
        sun_zenith=settings.suns[sun][0], grain=populations.grain, seed=settings.seed,
    )  # fmt: skip
    line["dust"] = planes, rows
    line["dust_ratio"] = ("row", "band"), np.asarray(populations.ratio)
    # the camera flies north along x = -0.1
    view = np.degrees(np.arctan2(east + 0.1, ALTITUDE_M - up))
    line["view_zenith"] = planes, np.abs(view).astype(np.float32), {"units": "degree"}
    azimuth = np.where(view > 0.0, 270.0, 90.0)
    line["view_azimuth"] = planes, azimuth.astype(np.float32), {"units": "degree"}
    direct, diffuse = (
        np.interp(BANDS, sky.wavelength, curve) for curve in (sky.sun * sky.sun_cosine, sky.sky)
    )
    if clouds is not None:
        changed = clouds.factors(np.nanmean(east), np.nanmean(north), 1.0)
        direct, diffuse = direct * changed[0], diffuse * changed[1]
    line["true_direct"] = "band", direct / (direct + diffuse)
    shares = [np.interp(BANDS, sky.wavelength, part) for part in (sky.uniform, *sky.clear_shares)]
    line["true_shares"] = ("share", "band"), np.stack([*shares, np.full(BANDS.size, sky.overcast_share)])
    line.attrs["paints"] = json.dumps(line["paint_id"].attrs["flag_meanings"].split())
    return line


def truth_of(line: Any, along: Any, across: Any, *, spectrum: bool = True) -> Any:
    """Return the `Truth` of the paint that most of some pixels show.

    Of a solid paint, what it reflects near-normally lit and seen, with the dust that lies on these pixels. Of
    one with flakes there is no such: its reflectance factor under this sun and sky as seen from here, on a
    level panel. Both without the mirror image in the coat.
    """
    from hyperpaint.simulation.rendering.scene_spectra import fleet_paint, paint_spec, spectrum_of

    from .verdicts import Truth

    shown = line["paint_id"].values[along, across]
    names = json.loads(line.attrs["paints"])
    if not (shown >= 0).mean() > 0.5:
        return Truth({"paint": "none", "finish": "none", "colour": "none"}, None)
    name = names[int(np.bincount(shown[shown >= 0]).argmax())]
    car, spec = fleet_paint(int(name.partition("-")[2])), paint_spec(name)
    words = {
        "paint": name, "finish": spec.finish, "colour": car.colour if car.colour in PLAIN else "coloured"
    }  # fmt: skip
    if not spectrum:
        return Truth(words, None)
    rows = line["dust"].values[along, across]
    ratio = line["dust_ratio"].values[rows[rows >= 0]].mean(axis=0) if (rows >= 0).any() else 1.0
    body = np.asarray(spectrum_of(name)(BANDS) * ratio)
    if spec.flakes is None:
        return Truth(words, body)
    view = float(np.nanmean(line["view_zenith"].values[along, across]))
    azimuth = float(np.nanmedian(line["view_azimuth"].values[along, across]))
    metal = spectrum_of(spec.flakes.spectrum)(BANDS)
    turned = spectrum_of(spec.flakes.turned)(BANDS) if spec.flakes.turned else metal
    return Truth(words, _under_sky(line, spec.material(), (body, metal, turned), (view, azimuth)))


PLAIN = ("white", "black", "grey", "silver")


def _under_sky(line: Any, material: Any, spectra: tuple[Any, ...], view: tuple[float, float]) -> Any:
    """Return the reflectance factor (band,) of a level panel with flakes under the sun and sky of a line.

    Integral of the paint's reflectance factor over the directions of the light, weighted by their shares of
    the level irradiance. ``spectra`` are those of body, flakes, and flakes at right angles.
    """
    from hyperpaint.light.sky_functions import functions_towards

    zenith, azimuth = line.attrs["sun_zenith"], line.attrs["sun_azimuth"]
    nodes, weights = np.polynomial.legendre.leggauss(40)
    # evenly in the zenith angle: the lobe of flakes is narrow around the mirror direction
    tilt = 0.25 * np.pi * (nodes + 1.0)
    angle, turn = np.meshgrid(tilt, np.radians(np.arange(48) * 7.5), indexing="ij")
    cosine = np.cos(angle)
    level = cosine * np.sin(angle) * weights[:, None]
    # 1.5 cos has the level irradiance of a uniform sky of radiance 1
    skies = np.concatenate([functions_towards(zenith, cosine, turn), 1.5 * cosine[None]])
    share = np.tensordot(line["true_shares"].values.T, skies, 1) * level
    share /= share.sum(axis=(1, 2), keepdims=True)
    dome = np.degrees(angle).ravel(), azimuth + np.degrees(turn).ravel()
    of_sky = factors(material, spectra, dome, view)
    (of_sun,) = factors(material, spectra, (np.array([zenith]), np.array([azimuth])), view)
    sky = np.einsum("bd,db->b", share.reshape(BANDS.size, -1), of_sky)
    direct = line["true_direct"].values
    return direct * of_sun + (1.0 - direct) * sky


def factors(
    material: Any, spectra: tuple[Any, ...], light: tuple[Any, Any], view: tuple[float, float]
) -> Any:
    """Return reflectance factors (direction, band) without the mirror image in the coat.

    Takes zenith and azimuth of the light (direction,), and of the view [degree]; what
    `simulation.rendering.materials.reflectance_factor` returns, for many directions.
    """
    from hyperpaint.simulation.rendering.materials import measured_factor
    from hyperpaint.simulation.transport.surfaces import lobes_at, sun_weights, surfaces_of, turned_part

    one, factor = np.ones(1), np.zeros(1, np.int32)
    index, alpha, share = material.coat.index, material.flakes.roughness, material.flakes.share
    surfaces = surfaces_of(index * one, 0 * one, 0 * one, 0.5 * one, alpha * one, factor, factor)
    seen = _vector(view[0], 0.0)
    lobes = lobes_at(surfaces, 0, seen, seen, 0.0)
    rows = np.empty((4, light[0].size))
    for number, (zenith, azimuth) in enumerate(zip(*light, strict=True)):
        at = _vector(float(zenith), float(azimuth) - view[1])
        base, _, flakes, recycled = sun_weights(surfaces.numbers, lobes, at, at, 0.0)
        # half of the light meets flakes
        rows[:3, number] = 2.0 * base / at[2], 2.0 * flakes / at[2], 2.0 * recycled / at[2]
        rows[3, number] = turned_part(lobes, at)
    base, flakes, recycled, part = rows[:, :, None]
    body, metal, turned = spectra
    pigment, mixed = measured_factor(body, index), metal + part * (turned - metal)
    again = share * mixed + (1.0 - share) * pigment
    return (1.0 - share) * base * pigment + share * mixed * (flakes + recycled * again)


def _vector(zenith: float, azimuth: float) -> tuple[float, float, float]:
    a, b = np.radians([zenith, azimuth])
    return float(np.sin(a) * np.cos(b)), float(np.sin(a) * np.sin(b)), float(np.cos(a))
