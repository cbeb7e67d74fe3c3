"""Materials and scenes of the simulator DIRSIG: writers and strict readers.

A paint library, or a scene of triangles with paint libraries, is written as a folder of files; ``.ems`` and
``.mat`` files are read as curves and materials. Called by users and workflows.
"""

from .dirsig_files import (
    Curve,
    Emissivity,
    Material,
    Section,
    materials_text,
    open_emissivity,
    read_emissivity,
    read_materials,
)
from .dirsig_writing import write_dirsig, write_dirsig_scene

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
