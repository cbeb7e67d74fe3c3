"""Car parks that share nothing with hyperpaint's renderer: other bodies, paints and skies, under Mitsuba 3.

Bodies are height fields, superellipses across and a profile along; paints are Mitsuba's rough plastic, and a
blend of it with a rough conductor where they have flakes; the sky is CIE's general sky (ISO 15469) whose
aureole narrows and grows towards the near infrared, with SPECTRL2's split of direct and diffuse light
(pvlib). Sun and sky are rendered apart, so that spectra of irradiance are put in afterwards. Mitsuba runs in
a process of its own, see `foreign_worker`.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

BANDS, FWHM_NM = np.linspace(405.0, 995.0, 32), 10.0
ROWS, COLUMNS, GSD_M, ALTITUDE_M = 256, 320, 0.04, 16.0
SAMPLES = {"sun": 24, "sky": 64}
GRID = np.arange(360.0, 1041.0, 5.0)
PLACES = [(x, y) for x in (-3.1, 3.1) for y in (-2.75, 0.0, 2.75)]
PAINTS = {
    "white": 0.34, "black": 0.14, "red": 0.09, "blue": 0.09, "silver flakes": 0.10, "grey flakes": 0.14,
    "black flakes": 0.10,
}  # fmt: skip
"""Shares of the paints."""

Arrays = Any


def conditions_of(seed: int) -> dict[str, Any]:
    """Return sun, sky and cars of a scene; all follows from its seed."""
    rng = np.random.default_rng([seed, 99])
    return {
        "sun_zenith": float(18.0 + 40.0 * ((seed * 0.6180339887) % 1.0)),
        "sun_azimuth": float(rng.uniform(95.0, 265.0)),
        "aerosol": float(rng.uniform(0.05, 0.2)),
        "roughness": float(rng.uniform(0.01, 0.05)),
        "index": float(rng.uniform(1.48, 1.55)),
        "cars": [str(one) for one in rng.choice(list(PAINTS), len(PLACES), p=list(PAINTS.values()))],
    }


def skies_of(seed: int) -> tuple[str, ...]:
    """Return the names of a scene's skies."""
    del seed
    return ("clear",)


def albedo(name: str, rng: np.random.Generator) -> Arrays:
    """Return the albedo of a paint's base under its coat, at `GRID`."""
    nm, colour = GRID, name.partition(" ")[0]
    rise = lambda at, width: 1.0 / (1.0 + np.exp(-(nm - at) / width))  # noqa: E731
    if colour == "white":
        return rng.uniform(0.86, 0.93) * rise(395.0, 8.0) - 0.00012 * (nm - 400.0)
    if colour == "black":
        return rng.uniform(0.03, 0.07) * (1.0 + 0.0004 * (nm - 550.0))
    if colour == "red":
        return 0.06 + rng.uniform(0.55, 0.75) * rise(rng.uniform(590.0, 615.0), 11.0)
    if colour == "blue":
        hump = np.exp(-(((nm - rng.uniform(450.0, 475.0)) / 45.0) ** 2))
        return 0.06 + 0.4 * hump + 0.5 * rise(rng.uniform(700.0, 740.0), 18.0)
    if colour == "silver":
        return np.full(nm.size, rng.uniform(0.3, 0.45))
    return np.full(nm.size, rng.uniform(0.12, 0.3))


def flakes(name: str, rng: np.random.Generator) -> dict[str, float] | None:
    """Return share, roughness and reflectance of the flakes of a paint; None without."""
    if "flakes" not in name:
        return None
    share = {"silver": (0.35, 0.5), "grey": (0.12, 0.25), "black": (0.03, 0.08)}[name.split()[0]]
    return {
        "share": float(rng.uniform(*share)), "roughness": float(rng.uniform(0.3, 0.45)), "level": 0.75
    }  # fmt: skip


def body(rng: np.random.Generator) -> list[tuple[str, Arrays, Arrays, Arrays]]:
    """Return the parts of a car: "paint" or "glass", with vertices, normals and faces; its length along x."""
    length, width = rng.uniform(4.0, 4.7), rng.uniform(1.72, 1.88)
    roof, belt = rng.uniform(1.40, 1.60), rng.uniform(0.88, 0.98)
    screen, back = rng.uniform(0.26, 0.32), rng.uniform(0.74, 0.84)  # of the length, from the front
    ends = [screen, screen + rng.uniform(0.12, 0.15), back - rng.uniform(0.08, 0.11), back]
    power, crown = rng.uniform(4.0, 6.0), rng.uniform(0.02, 0.04)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 181), np.linspace(-1.0, 1.0, 91), indexing="ij")
    middle = 0.5 * (ends[1] + ends[2])
    top = roof - crown * ((u - middle) / (0.5 * (ends[2] - ends[1]))) ** 2
    ramp = np.interp(u, [0.0, *ends, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    lower = (
        belt - 0.10 * np.clip(1.0 - u / screen, 0.0, 1.0) ** 2 - 0.06 * np.clip((u - back) / (1 - back), 0, 1)
    )
    long = np.clip(1.0 - np.abs(2.0 * u - 1.0) ** 14, 1e-9, 1.0) ** (1 / 14)
    shell = lower * long * np.clip(1.0 - np.abs(v) ** 8, 1e-9, 1.0) ** (1 / 8)
    inner = np.abs(v) / 0.80
    cabin = np.clip(1.0 - np.minimum(inner, 1.0) ** power, 0.0, 1.0) ** (1 / power)
    z = shell + ramp * (top - lower) * cabin
    x, y = (u - 0.5) * length, 0.5 * v * width
    points = np.stack([x, y, z], axis=2)
    slope = np.gradient(z, axis=0) / np.gradient(x, axis=0), np.gradient(z, axis=1) / np.gradient(y, axis=1)
    normal = np.stack([-slope[0], -slope[1], np.ones_like(z)], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 2, 3)
    at = [0.25 * (w[:-1, :-1] + w[1:, :-1] + w[1:, 1:] + w[:-1, 1:]) for w in (u, inner)]
    margin = 0.01
    slopes = [(at[0] > low + margin) & (at[0] < high - margin) for low, high in (ends[:2], ends[2:])]
    across = (slopes[0] | slopes[1]) & (at[1] < 0.85)
    pillars = np.abs(at[0] - middle) < 0.012
    beside = (at[0] > ends[1] - 0.03) & (at[0] < ends[2] + 0.03) & (at[1] > 0.88) & (at[1] < 0.995) & ~pillars
    glass = np.repeat((across | beside).ravel(), 2)
    flat = faces.reshape(-1, 3)
    return [
        (name, points.reshape(-1, 3), normal.reshape(-1, 3), flat[which])
        for name, which in (("paint", ~glass), ("glass", glass))
    ]


def scene_of(seed: int) -> Any:
    """Return the geometry of a scene as hyperpaint's, which `oracles.mitsuba_scenes` writes for Mitsuba."""
    from hyperpaint.simulation.rendering.materials import Material
    from hyperpaint.simulation.rendering.scene import Instance, Scene

    rng = np.random.default_rng([seed, 5])
    sheets = [("asphalt", (0.0, 0.0), (60.0, 60.0), 0.0)]
    sheets += [("line", (x, y), (4.9, 0.12), 0.004) for x, _ in PLACES[::3] for y in (-4.1, -1.37, 1.37, 4.1)]
    parts: list[tuple[str, str, Arrays, Arrays, Arrays]] = []
    for name, (x, y), (wide, deep), z in sheets:
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 0.5 * np.array([wide, deep]) + (x, y)
        points = np.column_stack([corners, np.full(4, z)])
        parts.append(
            (name, "ground", points, np.tile([0.0, 0.0, 1.0], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]))
        )
    for number, (x, y) in enumerate(PLACES):
        turn = np.radians(rng.choice([0.0, 180.0]) + rng.normal(0.0, 1.5))
        rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        offset = np.array([x + rng.uniform(-0.25, 0.25), y + rng.uniform(-0.15, 0.15), 0.0])
        for kind, points, normals, faces in body(rng):
            parts.append(
                (
                    f"{kind}_{number}",
                    f"car_{number:03d}",
                    points @ rotation.T + offset,
                    normals @ rotation.T,
                    faces,
                )
            )
    names = list(dict.fromkeys(part[0] for part in parts))
    things = list(dict.fromkeys(part[1] for part in parts))
    sizes = np.cumsum([0, *(len(part[2]) for part in parts)])
    counts = [len(part[4]) for part in parts]
    return Scene(
        f"foreign cars {seed}",
        np.concatenate([part[2] for part in parts]),
        np.concatenate([part[4] + first for part, first in zip(parts, sizes[:-1], strict=True)]),
        np.concatenate([part[3] for part in parts]),
        np.repeat([names.index(part[0]) for part in parts], counts),
        np.repeat([things.index(part[1]) for part in parts], counts),
        tuple(Material(name, "panel_20", "other") for name in names),
        tuple(Instance(name, "car" if "car" in name else "ground") for name in things),
    )


def line_of(seed: int, sky: str, cache: Path) -> Any:
    """Return a line as Mitsuba rendered it; from the cache where it is there."""
    import xarray as xr

    store = cache / f"foreign_cars_2_{seed}_{sky}.zarr"
    if not store.exists():
        line = _rendered(seed)
        part = store.with_suffix(".part")
        line.to_zarr(part, mode="w", consolidated=False)
        part.replace(store)
    return xr.open_zarr(store, consolidated=False).load()


def _rendered(seed: int) -> Any:
    rng = np.random.default_rng([seed, 6])
    light = conditions_of(seed)
    paints = [
        {"name": name, "albedo": np.clip(albedo(name, rng), 0.001, 0.97), "flakes": flakes(name, rng)}
        for name in light["cars"]
    ]
    job = {
        "scene": scene_of(seed), "light": light, "paints": paints, "grid": GRID, "bands": BANDS,
        "fwhm": FWHM_NM, "rows": ROWS, "columns": COLUMNS, "altitude": ALTITUDE_M, "samples": SAMPLES,
        "field_of_view": float(np.degrees(2.0 * np.arctan(0.5 * COLUMNS * GSD_M / ALTITUDE_M))),
        "views": [
            tuple(np.degrees([np.arctan2(np.hypot(x, y), ALTITUDE_M - 1.4), np.arctan2(-x, -y)]))
            for x, y in PLACES
        ],
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "job.pickle").write_bytes(pickle.dumps(job))
        worker = Path(__file__).with_name("foreign_worker.py")
        subprocess.run([sys.executable, str(worker), folder], check=True, cwd=folder)
        with np.load(Path(folder) / "images.npz") as images:
            return _assembled(seed, light, dict(images))


def _irradiance(light: dict[str, Any]) -> tuple[Arrays, Arrays, Arrays]:
    """Return wavelengths, direct and diffuse irradiance of a level surface, by SPECTRL2."""
    from pvlib.spectrum import spectrl2

    zenith = light["sun_zenith"]
    spectra = spectrl2(
        apparent_zenith=zenith, aoi=zenith, surface_tilt=0, ground_albedo=0.15, surface_pressure=101325.0,
        relative_airmass=1.0 / np.cos(np.radians(zenith)), precipitable_water=1.5, ozone=0.31,
        aerosol_turbidity_500nm=light["aerosol"], dayofyear=172,
    )  # fmt: skip
    nm, diffuse = np.ravel(spectra["wavelength"]), np.ravel(spectra["poa_sky_diffuse"])
    direct = np.ravel(spectra["poa_direct"])
    return nm, direct, diffuse


def _assembled(seed: int, light: dict[str, Any], images: dict[str, Arrays]) -> Any:
    """Return the flight line of rendered images, the first line in the south."""
    import xarray as xr

    from hyperpaint.base.schema import VARIABLES

    nm, direct, diffuse = _irradiance(light)
    parts = {name: np.interp(BANDS, nm, curve) for name, curve in (("sun", direct), ("sky", diffuse))}
    levels = np.array([images[f"{name}_level"] for name in parts])
    dark = [f"{band:.0f}" for band in BANDS[~(levels > 0.0).all(axis=0)]]
    if dark:
        raise ValueError(f"Mitsuba gave no light at {', '.join(dark)} nm, of which nothing can be judged")
    radiance = sum(images[name] / images[f"{name}_level"] * part for name, part in parts.items())
    cube = np.moveaxis(radiance[::-1], 2, 1).astype(np.float32)
    record_nm = np.arange(375.0, 1026.0)
    whole = np.interp(record_nm, nm, direct + diffuse).astype(np.float32)
    first = np.datetime64("2026-06-21T10:00:00", "ns")
    time = first + (np.arange(ROWS) * 7_000_000).astype("timedelta64[ns]")
    record_time = first + ((np.arange(121) - 60) * 1_000_000_000).astype("timedelta64[ns]")
    planes = ("along_track", "cross_track")
    share = parts["sun"] / (parts["sun"] + parts["sky"])
    at_geometry = share * images["under_sun"] + (1.0 - share) * images["under_sky"]
    variables = {
        "radiance": (("along_track", "band", "cross_track"), cube),
        "irradiance": (("irradiance_time", "irradiance_wavelength"), np.tile(whole, (121, 1))),
        "irradiance_fwhm": ((), 3.0), "irradiance_max_gap": ((), 2.5),
        "irradiance_clock_uncertainty": ((), 0.0),
        "wavelength": ("band", BANDS), "fwhm": ("band", np.full(BANDS.size, FWHM_NM)),
        "time": ("along_track", time), "irradiance_time": ("irradiance_time", record_time),
        "irradiance_wavelength": ("irradiance_wavelength", record_nm),
    }  # fmt: skip
    coords = ("wavelength", "fwhm", "time", "irradiance_time", "irradiance_wavelength")
    labelled = {name: (*value, VARIABLES[name].attrs) for name, value in variables.items()}
    line = xr.Dataset(
        {name: value for name, value in labelled.items() if name not in coords},
        {**{name: labelled[name] for name in coords}, "good": ("band", np.ones(BANDS.size, bool))},
    )
    line["instance"] = planes, images["instance"][::-1]
    line["paint_id"] = planes, images["paint"][::-1]
    for name in ("purity", "facing", "shadow"):
        line[name] = planes, images[name][::-1].astype(np.float32)
    # of the mean radiance over that of a white surface, in the same light
    level = (np.pi * cube / (parts["sun"] + parts["sky"])[:, None]).mean(axis=1)
    glint = images["glint"][::-1] * share.mean()
    line["glint_share"] = planes, (glint / np.maximum(level, 1e-6)).astype(np.float32)
    line["solid_truth"] = ("car", "band"), images["normal"]
    line["geometry_truth"] = ("car", "band"), at_geometry
    things = ["ground", *(f"car_{number:03d}" for number in range(len(PLACES)))]
    line.attrs = {
        "seed": seed, "sky": "clear", "source": "mitsuba", "sun_zenith": light["sun_zenith"],
        "sun_azimuth": light["sun_azimuth"], "paints": json.dumps(light["cars"]), "srf_shape": "gaussian",
        "irradiance_srf_shape": "gaussian", "hyperpaint_format": 1,
        "instances": json.dumps([{"name": name} for name in things]),
    }  # fmt: skip
    return line


def truth_of(line: Any, along: Any, across: Any, *, spectrum: bool = True) -> Any:
    """Return the `Truth` of the paint that most of some pixels show."""
    from .verdicts import Truth

    shown = line["paint_id"].values[along, across]
    if not (shown >= 0).mean() > 0.5:
        return Truth({"paint": "none", "finish": "none", "colour": "none"}, None)
    number = int(np.bincount(shown[shown >= 0]).argmax())
    name = json.loads(line.attrs["paints"])[number]
    colour, _, kind = name.partition(" ")
    words = {
        "paint": name, "finish": "metallic" if kind else "solid",
        "colour": colour if colour in ("white", "black", "grey", "silver") else "coloured",
    }  # fmt: skip
    if not spectrum:
        return Truth(words, None)
    return Truth(words, line["geometry_truth" if kind else "solid_truth"].values[number])
