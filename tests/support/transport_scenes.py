"""Small scenes and cameras for the tests of light transport, made without the package's own scenes."""

import functools

import numba
import numpy as np

from hyperpaint.simulation.transport.hierarchy import Geometry, build_geometry
from hyperpaint.simulation.transport.paths import Block, Rays, Settings, Sources, trace_lines
from hyperpaint.simulation.transport.surfaces import Surfaces, surfaces_of

#: False where the tests run as plain Python, some hundred times slower.
COMPILED = not numba.config.DISABLE_JIT

QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def joined(*parts: tuple[np.ndarray, np.ndarray, int]) -> Geometry:
    # Return geometry of (corners, faces, material) parts; the instance is the number of the part
    vertices, faces, material, instance, count = [], [], [], [], 0
    for number, (corners, sides, label) in enumerate(parts):
        vertices.append(corners)
        faces.append(sides + count)
        material += [label] * len(sides)
        instance += [number] * len(sides)
        count += len(corners)
    return build_geometry(np.concatenate(vertices), np.concatenate(faces), [], material, instance)


def rectangle(origin: list[float], first: list[float], second: list[float]) -> np.ndarray:
    # Return the four corners of a rectangle
    o, a, b = (np.array(part, float) for part in (origin, first, second))
    return np.array([o, o + a, o + a + b, o + b])


def ground(half: float = 500.0, z: float = 0.0) -> np.ndarray:
    return rectangle([-half, -half, z], [2 * half, 0, 0], [0, 2 * half, 0])


def box(x: float, y: float, half: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    # Return a closed box that stands on the ground
    corners = np.array(
        [[x + i * half, y + j * half, k * height] for k in (0, 1) for j in (-1, 1) for i in (-1, 1)]
    )
    sides = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    return corners, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def materials(*coats: tuple[float, float] | None, flakes: float = 0.0, flake_alpha: float = 0.35) -> Surfaces:
    # Return surfaces: None for Lambert, else index and alpha of the coat; factors in the same order
    return Surfaces(*(part.copy() for part in _materials(coats, flakes, flake_alpha)))


@functools.cache
def _materials(coats: tuple[tuple[float, float] | None, ...], flakes: float, flake_alpha: float) -> Surfaces:
    # the tables of a coat take long without compilation
    count, (index, alpha) = len(coats), np.array([coat or (0.0, 0.0) for coat in coats]).T
    flake_factor = np.arange(count, 2 * count) if flakes else np.full(count, -1)
    shares, alphas = np.full(count, flakes), np.full(count, flake_alpha)
    return surfaces_of(index, alpha, np.zeros(count), shares, alphas, np.arange(count), flake_factor)


def sun(zenith: float, azimuth: float = 90.0) -> np.ndarray:
    # Return the unit vector towards a sun [degrees, clockwise from north]
    z, a = np.radians([zenith, azimuth])
    return np.array([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)])


def suns(*directions: np.ndarray, overcast: bool = False, radius: float = 0.0) -> Sources:
    return Sources(np.array(directions).reshape(-1, 3), np.full(len(directions), radius), overcast)


DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # forward north, right east


def nadir(lines: int, columns: int, *, width: float, height: float = 20.0) -> Rays:
    # Return a pushbroom camera that flies north above the middle of the scene, square pixels
    pixel = width / columns
    origin = np.zeros((lines, 2, 3))
    origin[:, :, 1] = (np.arange(lines)[:, None] - lines / 2 + [0, 1]) * pixel
    origin[:, :, 2] = height
    edges = np.linspace(-width / 2, width / 2, columns + 1) / height
    return Rays(origin, np.tile(DOWN, (lines, 2, 1, 1)), edges, np.array([-0.5, 0.5]) * pixel / height)


def staring(point: list[float], towards_camera: np.ndarray, columns: int, distance: float = 10.0) -> Rays:
    # Return one line of pixels that all see one point, from one direction
    down = -towards_camera
    forward = np.cross(down, [0.3, 0.5, -0.7])
    forward /= np.linalg.norm(forward)
    rotation = np.stack([forward, np.cross(down, forward), down], axis=1)
    origin = np.array(point) + distance * towards_camera
    edges = np.linspace(-1e-9, 1e-9, columns + 1)
    return Rays(np.tile(origin, (1, 2, 1)), np.tile(rotation, (1, 2, 1, 1)), edges, np.array([-1e-9, 1e-9]))


def traced(
    geometry: Geometry,
    surfaces: Surfaces,
    sources: Sources,
    rays: Rays,
    *,
    first_line: int = 0,
    samples: int = 16,
    depth: int = 4,
    digit_bits: int = 4,
    seed: int = 0,
    slots: int = 48,
) -> Block:
    block = Block.empty(len(rays.origin), slots, len(rays.column_edges) - 1, len(sources.suns))
    numbers = Settings(first_line, samples, depth, digit_bits, seed)
    trace_lines(geometry, surfaces, sources, rays, numbers, block)
    return block


def code(
    source: int, *factors: int, mirror: bool = False, indirect: bool = False, digit_bits: int = 4
) -> int:
    # Return the code of a path, written as the contract words it
    digits = sorted((factor + 1 for factor in factors), reverse=True)
    found = sum(digit << (7 + digit_bits * place) for place, digit in enumerate(digits))
    return found + source + 32 * mirror + 64 * indirect


def weight_of(block: Block, wanted: int) -> np.ndarray:
    # Return the weight of one code, (line, column)
    return np.where(block.code == wanted, block.weight.astype(float), 0).sum(axis=1)
