"""Triangles of Wavefront OBJ files.

Only what a scene needs is read: ``v``, ``f``, and the names after ``usemtl``, ``o`` and ``g``. Material
libraries and textures are not opened.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import FormatError

__all__ = ["RawTriangles", "parse_obj"]

_LARGEST_INDEX = 2**40


class RawTriangles(NamedTuple):
    """Triangles as a file has them.

    Attributes
    ----------
    vertices : (vertex, 3) float64
        In the file's units and axes.
    faces : (face, 3) int64
        Vertices of every triangle, in range.
    face_group : (face,) int64
        Number of the group of every triangle.
    groups : tuple of (str, str)
        Names of the material and of the object of every group; empty where there is none.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_group: NDArray[np.int64]
    groups: tuple[tuple[str, str], ...]


def parse_obj(data: bytes, where: str) -> RawTriangles:
    r"""Return the triangles of an OBJ file; polygons become fans.

    Parameters
    ----------
    data
        The whole file.
    where
        Its name, for messages.

    Raises
    ------
    FormatError
        A line cannot be read, or a face names a vertex that does not exist.

    Examples
    --------
    >>> found = parse_obj(b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl red\nf 1 2 3 -1\n", "quad.obj")
    >>> found.faces.tolist(), found.groups
    ([[0, 1, 2], [0, 2, 3]], (('red', ''),))
    """
    text = data.decode("utf-8", errors="replace").replace("\\\n", " ").replace("\\\r\n", " ")
    coordinates: list[float] = []
    corners: list[int] = []
    face_group: list[int] = []
    groups: dict[tuple[str, str], int] = {}
    material, thing = "", ""
    group = -1
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split()
        if not words:
            continue
        keyword = words[0]
        if keyword == "v":
            coordinates.extend(_position(words, where, number))
        elif keyword == "f":
            if group < 0:
                group = groups.setdefault((material, thing), len(groups))
            fan = _corners(words, len(coordinates) // 3, where, number)
            for corner in range(1, len(fan) - 1):
                corners += (fan[0], fan[corner], fan[corner + 1])
                face_group.append(group)
        elif keyword in ("usemtl", "o", "g"):
            name = line.strip()[len(keyword) :].strip()
            material, thing = (name, thing) if keyword == "usemtl" else (material, name)
            group = -1
    vertices = np.asarray(coordinates, np.float64).reshape(-1, 3)
    faces = np.asarray(corners, np.int64).reshape(-1, 3)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        wrong = int(faces.max()) + 1 if faces.max() >= len(vertices) else int(faces.min())
        raise FormatError(
            f"{where}: a face names vertex {wrong}, but there are {len(vertices)}; the file is cut or damaged"
        )
    return RawTriangles(vertices, faces, np.asarray(face_group, np.int64), tuple(groups))


def _position(words: list[str], where: str, number: int) -> list[float]:
    try:
        found = [float(word) for word in words[1:4]]
    except ValueError:
        found = []
    if len(found) != 3:
        raise FormatError(
            f"{where}: line {number} is {' '.join(words)[:60]!r}, expected 'v' and three numbers"
        )
    return found


def _corners(words: list[str], before: int, where: str, number: int) -> list[int]:
    """Return the vertices of a polygon, counted from 0; negative numbers in a file count back from here."""
    try:
        found = [int(word.partition("/")[0]) for word in words[1:]]
    except ValueError:
        found = []
    if len(found) < 3 or not all(0 < abs(index) < _LARGEST_INDEX for index in found):
        raise FormatError(
            f"{where}: line {number} is {' '.join(words)[:60]!r}, expected 'f' and three or more numbers of "
            "vertices, counted from 1"
        )
    return [index - 1 if index > 0 else before + index for index in found]
