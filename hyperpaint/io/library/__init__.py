"""Spectral libraries of other programs and our own: read into paint libraries, written from them."""

from __future__ import annotations

from .opening import open_library
from .specification import check_library, declare_library
from .writing import write_library

__all__ = ["check_library", "declare_library", "open_library", "write_library"]
