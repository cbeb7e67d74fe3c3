"""What stands around cars: trees, hedges, walls and lamps.

A crown is a cloud of leaves: two triangles each, bent along the midrib, most of them near the surface of a
few overlapping blobs and turned any way around facing outwards. Leaves are Lambert and let no light through.
"""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Floats

from .primitives import Mesh, cuboid, put_together, smoothed, tube, uniform

__all__ = ["brick_wall", "hedge", "lamp_post", "leafy_tree"]


_LEAF = 0.20  # length of a leaf, or of the tuft that stands for several [m]


def leafy_tree(
    rng: np.random.Generator, *, height: float = 6.0, crown: float = 2.0, leaves: int = 2000
) -> Mesh:
    """Return a tree that stands on the origin, of the surfaces "leaf" and "bark".

    Parameters
    ----------
    rng
        Chooses where its leaves are.
    height
        Of its top [m].
    crown
        Radius of the crown [m].
    leaves
        Number of leaves.

    Examples
    --------
    >>> tree = leafy_tree(np.random.default_rng(0), height=5.0, crown=1.5, leaves=100)
    >>> bool(tree.vertices[:, 2].max() < 5.2), int((tree.surface == tree.surfaces.index("leaf")).sum())
    (True, 200)
    """
    middle = np.array([0.0, 0.0, height - 0.95 * crown])
    blobs = 9
    direction = _directions(rng, blobs)
    direction[:, 2] = 0.75 * np.abs(direction[:, 2]) - 0.2
    centres = middle + crown * 0.55 * direction
    radii = crown * rng.uniform(0.38, 0.52, blobs)
    chosen = rng.choice(blobs, leaves, p=radii**2 / (radii**2).sum())
    outward = _directions(rng, leaves)
    places = centres[chosen] + (radii[chosen] * rng.uniform(0.55, 1.0, leaves) ** 0.5)[:, None] * outward
    places[:, 2] = np.minimum(places[:, 2], height)
    trunk = tube((0, 0, -0.05), middle, (0.045 * crown + 0.06, 0.05), "bark", sides=8)
    boughs = [
        tube(middle - (0, 0, 0.4 * crown), centre, (0.05, 0.02), "bark", sides=5) for centre in centres[:5]
    ]
    return put_together([_foliage(rng, places, outward), smoothed(trunk), *boughs])


def hedge(
    rng: np.random.Generator,
    length: float,
    *,
    height: float = 1.3,
    thickness: float = 0.7,
    density: float = 160.0,
) -> Mesh:
    """Return a clipped hedge from the origin to the north, of the surface "leaf".

    Parameters
    ----------
    rng
        Chooses where its leaves are.
    length, height, thickness
        [m].
    density
        Leaves a square metre of its outside [m-2].

    Examples
    --------
    >>> hedge(np.random.default_rng(0), 2.0).vertices[:, 1].max().round()
    np.float64(2.0)
    """
    core = cuboid((0.8 * thickness, length - 0.1, 0.9 * height), "leaf").shifted((0, length / 2, -0.05))
    sizes = np.array(
        [length * thickness, length * height, length * height, thickness * height, thickness * height]
    )
    normals = np.array([[0, 0, 1], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], np.float64)
    count = int(density * sizes.sum())
    outward = normals[rng.choice(5, count, p=sizes / sizes.sum())]
    inside = rng.uniform(-1.0, 1.0, (count, 3))
    places = np.where(outward != 0, outward * rng.uniform(0.85, 1.0, (count, 1)), inside)
    places = 0.5 * places * (thickness, length, height) + (0.0, 0.5 * length, 0.5 * height)
    return put_together([_foliage(rng, places, outward), core])


def brick_wall(length: float, *, height: float = 1.6, thickness: float = 0.24) -> Mesh:
    """Return a wall with a coping from the origin to the north, of the surfaces "brick" and "concrete".

    Examples
    --------
    >>> brick_wall(10.0, height=2.0).vertices[:, 2].max().round(3)
    np.float64(2.06)
    """
    body = cuboid((thickness, length, height + 0.05), "brick").shifted((0, length / 2, -0.05))
    coping = cuboid((thickness + 0.08, length, 0.06), "concrete").shifted((0, length / 2, height))
    return put_together([body, coping])


def lamp_post(height: float = 6.0, arm: float = 1.2) -> Mesh:
    """Return a lamp that stands on the origin, its arm to the east, of the surfaces "steel" and "lamp".

    Examples
    --------
    >>> lamp_post(5.0).vertices[:, 2].max().round(1)
    np.float64(5.2)
    """
    post = smoothed(tube((0, 0, -0.05), (0, 0, height), (0.07, 0.045), "steel", sides=8))
    beam = smoothed(tube((0, 0, height), (arm, 0, height + 0.12), (0.035, 0.03), "steel", sides=6))
    head = cuboid((0.55, 0.24, 0.07), "steel").shifted((arm + 0.2, 0, height + 0.09))
    glass = cuboid((0.45, 0.18, 0.02), "lamp").shifted((arm + 0.2, 0, height + 0.075))
    foot = cuboid((0.3, 0.3, 0.1), "steel").shifted((0, 0, -0.02))
    return put_together([post, beam, head, glass, foot])


def _directions(rng: np.random.Generator, count: int) -> Floats:
    vectors = rng.standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _foliage(rng: np.random.Generator, places: Floats, outward: Floats) -> Mesh:
    """Return leaves at ``places`` (leaf, 3) that face roughly ``outward`` (leaf, 3) and up."""
    count = len(places)
    facing = outward + (0.0, 0.0, 0.5) + 0.9 * rng.standard_normal((count, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    along = np.cross(facing, _directions(rng, count))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(facing, along)
    size = _LEAF * rng.uniform(0.7, 1.3, (count, 1))
    fold = 0.12 * size * facing
    corners = np.stack(
        [
            places - 0.5 * size * along,
            places + 0.32 * size * aside + fold,
            places + 0.5 * size * along,
            places - 0.32 * size * aside + fold,
        ],
        axis=1,
    )
    first = 4 * np.arange(count)[:, None, None]
    return uniform(corners.reshape(-1, 3), (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3), "leaf")
