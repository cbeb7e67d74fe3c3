"""What runs inside Mitsuba's own process: ``python foreign_worker.py FOLDER`` renders FOLDER/job.pickle."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

GROUND, LINE, GLASS = 0.10, 0.45, 0.02
MAPS_AT, NEAR = 600.0, 80.0
"""Mitsuba's maps of the sky have no light beyond 830 nm: four bands at a time are rendered as if they lay at
the first [nm], and the spectra of all materials within the second [nm] are moved along."""
SKY_ROWS, SKY_COLUMNS = 64, 256
DEPTH = 5
RAYS = 4
"""Rays along each side of a pixel that find what it shows."""


def sky_map(nm: float, zenith: float, azimuth: float, cosine: Any, turn: Any) -> Any:
    """Return the relative radiance of CIE's clear sky, its aureole stronger and its zenith darker in the NIR.

    Takes the cosine of the zenith angle and the azimuth [rad], any shape.
    """
    red = (nm - 450.0) / 400.0
    a, b, c, d, e = -1.0, -0.32 + 0.10 * red, 8.0 + 7.0 * red, -3.0, 0.45
    sun = np.radians(zenith)
    between = cosine * np.cos(sun) + np.sqrt(1.0 - cosine**2) * np.sin(sun) * np.cos(
        turn - np.radians(azimuth)
    )
    chi = np.arccos(np.clip(between, -1.0, 1.0))
    gradation = 1.0 + a * np.exp(b / np.maximum(cosine, 0.02))
    return gradation * (1.0 + c * (np.exp(d * chi) - np.exp(d * np.pi / 2)) + e * between**2)


def environment(mitsuba: Any, nm: float, light: dict[str, Any]) -> dict[str, Any]:
    """Return the sky as an environment map, black below the horizon; z is up, y north."""
    rows, columns = SKY_ROWS, SKY_COLUMNS
    polar = np.pi * (np.arange(rows) + 0.5) / rows
    # Mitsuba's map, y up: u = atan2(x, -z) / 2 pi; turned so that y becomes z, and -z becomes y
    u = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    cosine, turn = np.meshgrid(np.cos(polar), u, indexing="ij")
    values = np.where(
        cosine > 0.0, sky_map(nm, light["sun_zenith"], light["sun_azimuth"], np.abs(cosine), turn), 0.0
    )
    pixels = np.repeat(values[:, :, None], 3, axis=2).astype(np.float32)
    return {
        "type": "envmap", "bitmap": mitsuba.Bitmap(pixels), "scale": 1.0,
        "to_world": mitsuba.ScalarTransform4f().rotate([1, 0, 0], 90.0),
    }  # fmt: skip


def spectrum(grid: Any, values: Any) -> dict[str, str]:
    """Return a spectrum as Mitsuba takes it."""
    return {
        "type": "irregular", "wavelengths": ", ".join(f"{x:.6g}" for x in grid),
        "values": ", ".join(f"{y:.6g}" for y in np.broadcast_to(values, grid.shape)),
    }  # fmt: skip


def paint(one: dict[str, Any], light: dict[str, Any], grid: Any, *, mirror: bool = True) -> dict[str, Any]:
    """Return a paint, with or without the mirror image in its coat."""
    coated: dict[str, Any] = {
        "type": "roughplastic", "distribution": "ggx", "alpha": light["roughness"], "int_ior": light["index"],
        "nonlinear": True, "diffuse_reflectance": spectrum(grid, one["albedo"]),
    }  # fmt: skip
    if not mirror:
        coated["specular_reflectance"] = spectrum(grid, 1e-9)
    if one["flakes"] is None:
        return coated
    metal = {
        "type": "roughconductor", "material": "none", "distribution": "ggx",
        "alpha": one["flakes"]["roughness"],
        "specular_reflectance": spectrum(grid, one["flakes"]["level"]),
    }  # fmt: skip
    return {"type": "blendbsdf", "weight": one["flakes"]["share"], "base": coated, "flakes": metal}


def direction(zenith: Any, azimuth: Any) -> Any:
    """Return unit vectors (..., 3) of angles [degree], azimuth clockwise from north."""
    a, b = np.radians(zenith), np.radians(azimuth)
    return np.stack([np.sin(a) * np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.ones_like(b)], axis=-1)


def factor(mitsuba: Any, bsdf: Any, nm: float, light: Any, view: Any) -> Any:
    """Return the reflectance factor pi f (direction,) of a level panel for light from directions (..., 3)."""
    interaction = mitsuba.SurfaceInteraction3f()
    interaction.wi = mitsuba.Vector3f(*view.tolist())
    interaction.wavelengths = mitsuba.Spectrum(float(nm))
    context = mitsuba.BSDFContext()
    values = [float(bsdf.eval(context, interaction, mitsuba.Vector3f(*one))[0]) for one in light.tolist()]
    return np.pi * np.array(values) / light[:, 2]


def truths(mitsuba: Any, job: dict[str, Any]) -> dict[str, Any]:
    """Return the reflectance factors (car, band) near-normal, under the sun, and under the sky."""
    light, grid = job["light"], job["grid"]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cosine, turn = np.meshgrid(0.5 * (nodes + 1.0), np.arange(24) * 15.0 + 7.5, indexing="ij")
    dome = direction(np.degrees(np.arccos(cosine)), turn).reshape(-1, 3)
    weight = (cosine * weights[:, None]).ravel()
    sun = direction(np.array([light["sun_zenith"]]), np.array([light["sun_azimuth"]]))
    up = np.array([[0.0, 0.0, 1.0]])
    shape = len(job["paints"]), len(job["bands"])
    found = {name: np.zeros(shape) for name in ("normal", "under_sun", "under_sky")}
    for car, (one, view) in enumerate(zip(job["paints"], job["views"], strict=True)):
        bsdf = mitsuba.load_dict(paint(one, light, grid, mirror=False))
        seen = direction(np.array(view[0]), np.array(view[1]))
        for band, nm in enumerate(job["bands"]):
            found["normal"][car, band] = factor(mitsuba, bsdf, nm, up, up[0])[0]
            found["under_sun"][car, band] = factor(mitsuba, bsdf, nm, sun, seen)[0]
            radiance = sky_map(
                nm, light["sun_zenith"], light["sun_azimuth"], cosine, np.radians(turn)
            ).ravel()
            share = radiance * weight
            found["under_sky"][car, band] = (
                share * factor(mitsuba, bsdf, nm, dome, seen)
            ).sum() / share.sum()
    return found


def materials(job: dict[str, Any], grid: Any, moved: float) -> dict[str, Any]:
    """Return the surfaces of a scene; their spectra at some wavelengths [nm], moved down by some [nm]."""
    at = grid - moved
    surfaces: dict[str, Any] = {
        "asphalt": {
            "type": "diffuse", "reflectance": spectrum(at, GROUND * (0.85 + 0.0006 * (grid - 400.0))),
        },
        "line": {"type": "diffuse", "reflectance": spectrum(at, LINE)},
    }  # fmt: skip
    for number, each in enumerate(job["paints"]):
        near = each | {"albedo": each["albedo"][np.isin(job["grid"], grid)]}
        surfaces[f"paint_{number}"] = {"type": "twosided", "bsdf": paint(near, job["light"], at)}
        surfaces[f"glass_{number}"] = {
            "type": "twosided",
            "bsdf": {"type": "plastic", "int_ior": 1.52, "diffuse_reflectance": spectrum(at, GLASS)},
        }
    return surfaces


def render(mitsuba: Any, job: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return images of sun and sky (row, column, band), and what a white level surface shows times pi."""
    from oracles.mitsuba_scenes import FrameCamera, to_mitsuba

    from hyperpaint.simulation.atmosphere import Atmosphere
    from hyperpaint.simulation.rendering.scene import plane

    light, bands = job["light"], job["bands"]
    camera = FrameCamera(
        (0.0, 0.0, job["altitude"]),
        field_of_view=job["field_of_view"],
        rows=job["rows"],
        columns=job["columns"],
    )
    flat = plane(60.0)
    own = flat.materials[0].name
    small = FrameCamera((0.0, 0.0, 5.0), field_of_view=10.0, rows=8, columns=8)
    images: dict[str, list[Any]] = {name: [] for name in ("sun", "sky", "sun_level", "sky_level")}
    for first in range(0, len(bands), 4):
        group = bands[first : first + 4]
        moved = float(group.mean()) - MAPS_AT
        grid = job["grid"][np.abs(job["grid"] - group.mean()) <= NEAR]
        one = np.ones(grid.size)
        sky = Atmosphere(grid - moved, one, one, 0 * one, 0 * one, light["sun_zenith"], light["sun_azimuth"])
        options = {"wavelength": group - moved, "fwhm": job["fwhm"], "depth": DEPTH}
        white = {own: {"type": "diffuse", "reflectance": spectrum(grid - moved, 1.0)}}
        surfaces = materials(job, grid, moved)
        for source in ("sun", "sky"):
            for name, scene, its, view, samples in (
                (source, job["scene"], surfaces, camera, job["samples"][source]),
                (f"{source}_level", flat, white, small, 4096),
            ):
                place = folder / f"{'flat' if scene is flat else 'cars'}"
                described = to_mitsuba(scene, sky, place, camera=view, samples=samples, **options) | its
                del described["sky" if source == "sun" else "sun"]
                if source == "sky":
                    described["sky"] = environment(mitsuba, float(group.mean()), light)
                image = np.array(mitsuba.render(mitsuba.load_dict(described), seed=7))
                images[name].append(image * np.pi if scene is not flat else image.mean(axis=(0, 1)) * np.pi)
        print(f"bands to {group[-1]:.0f} nm", file=sys.stderr, flush=True)
    joined = {name: np.concatenate(parts, axis=-1) for name, parts in images.items()}
    joined["sun"], joined["sky"] = joined["sun"] / np.pi, joined["sky"] / np.pi
    return joined | shown(
        mitsuba,
        job,
        to_mitsuba(job["scene"], sky, folder / "cars", wavelength=[550.0], camera=camera, samples=1)
        | surfaces,
    )


def shown(mitsuba: Any, job: dict[str, Any], described: dict[str, Any]) -> dict[str, Any]:
    """Return what every pixel shows (row, column), by `RAYS` x `RAYS` rays through it.

    ``instance``: 0 the ground, n + 1 the car n. ``paint``: number of the car, -1 for other surfaces.
    ``purity``: share of the rays that hit the surface of most of them. ``facing``: direct light without
    obstacles, relative to level ground; ``shadow``: share of it that is blocked. ``glint``: reflectance of
    the coat for the sun alone, relative to its light on level ground.
    """
    # unmerged: merged meshes have no names
    scene = mitsuba.load_dict(described, optimize=False)
    light, shape = job["light"], (job["rows"], job["columns"])
    black = np.full(job["grid"].size, 1e-9)
    coats = [
        (mitsuba.load_dict(paint({"albedo": black, "flakes": None}, light, job["grid"])), flakes)
        for flakes in ((each["flakes"] or {"share": 0.0})["share"] for each in job["paints"])
    ]
    towards = direction(light["sun_zenith"], light["sun_azimuth"])
    sun, level = mitsuba.Vector3f(*towards.tolist()), float(towards[2])
    place = mitsuba.Point3f(0.0, 0.0, float(job["altitude"]))
    context, wavelengths = mitsuba.BSDFContext(), mitsuba.Spectrum(550.0)
    names = [f"mesh of {name}" for name in described if f"mesh of {name}" in described]
    # surface of every ray, and sums over the rays
    hits = np.zeros((RAYS**2, *shape), np.int16)
    facing, blocked, glint = np.zeros((3, *shape))
    half = np.tan(np.radians(job["field_of_view"] / 2))
    steps = (np.arange(RAYS) + 0.5) / RAYS
    for ray, (down, right) in enumerate((down, right) for down in steps for right in steps):
        y, x = np.meshgrid(
            (np.arange(shape[0]) + down) / shape[0], (np.arange(shape[1]) + right) / shape[1], indexing="ij"
        )
        look = np.stack(
            [half * (2 * x - 1), -half * (2 * y - 1) * shape[0] / shape[1], -np.ones_like(x)], axis=-1
        )
        look /= np.linalg.norm(look, axis=-1, keepdims=True)
        for pixel, vector in zip(np.ndindex(shape), look.reshape(-1, 3).tolist(), strict=True):
            hit = scene.ray_intersect(mitsuba.Ray3f(place, mitsuba.Vector3f(*vector)))
            name = hit.shape.id()
            hits[ray][pixel] = names.index(name)
            local = hit.to_local(sun)
            if local.z <= 0.0:
                continue
            facing[pixel] += local.z / level
            if scene.ray_test(hit.spawn_ray(sun)):
                blocked[pixel] += local.z / level
            elif name.startswith("mesh of paint_"):
                coat, flakes = coats[int(name.rpartition("_")[2])]
                hit.wavelengths = wavelengths
                factor = np.pi * float(coat.eval(context, hit, local)[0]) / level
                glint[pixel] += (1.0 - flakes) * factor
    counts = np.stack([(hits == number).sum(axis=0) for number in range(len(names))])
    kinds = [name.removeprefix("mesh of ").partition("_") for name in names]
    cars = np.array([int(number) if number else -1 for _, _, number in kinds])
    painted = np.array([kind == "paint" for kind, _, _ in kinds])
    most = counts.argmax(axis=0)
    return {
        "instance": (cars[most] + 1).astype(np.int32),
        "paint": np.where(painted[most], cars[most], -1).astype(np.int16),
        "purity": counts.max(axis=0) / RAYS**2,
        "facing": facing / RAYS**2,
        "shadow": np.divide(blocked, facing, where=facing > 0.0, out=np.zeros(shape)),
        "glint": glint / RAYS**2,
    }


def main(folder: Path) -> None:
    """Render a job."""
    import mitsuba

    mitsuba.set_variant("scalar_spectral")
    job = pickle.loads((folder / "job.pickle").read_bytes())  # of the benchmark itself
    np.savez(folder / "images.npz", **render(mitsuba, job, folder), **truths(mitsuba, job))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
