"""Materials and scenes of the simulator DIRSIG: written from a paint library, and read back strictly.

A paint library comes in, or a scene of triangles with one, and a folder of files goes out; ``.ems`` and
``.mat`` files come in, curves and materials go out. Called by users and workflows.
"""

from __future__ import annotations

from .dirsig_scene import write_dirsig_scene
from .dirsig_writing import write_dirsig
from .emissivity_files import Curve, Emissivity, open_emissivity, read_emissivity
from .material_list import Material, Section, materials_text, read_materials

__all__ = [
    "Curve",
    "Emissivity",
    "Material",
    "Section",
    "materials_text",
    "open_emissivity",
    "read_emissivity",
    "read_materials",
    "write_dirsig",
    "write_dirsig_scene",
]
