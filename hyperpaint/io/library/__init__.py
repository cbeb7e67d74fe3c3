"""Spectral libraries of all formats: read into paint libraries, and written from them."""

from .library_formats import check_library, declare_library, open_library, write_library

__all__ = ["check_library", "declare_library", "open_library", "write_library"]
