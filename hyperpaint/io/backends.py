"""Entry points of xarray to our readers.

xarray loads this module at any user's first `open_dataset`: it imports nothing but xarray.
"""

import contextlib
import os
import re
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from xarray.backends import BackendEntrypoint

if TYPE_CHECKING:
    import xarray as xr

# a file with another suffix is taken for ENVI data only if "name.suffix.hdr" lies beside it
_DATA_SUFFIXES = ("", ".img", ".dat", ".raw", ".bil", ".bip", ".bsq")


class EnviBackendEntrypoint(BackendEntrypoint):
    # Opens ENVI cubes lazily: ``xr.open_dataset("raw_0.hdr")``, or with ``engine="envi"``.
    #
    # See `hyperpaint.io.envi.envi_cubes.open_envi` for the dataset; lines and columns are numbered.
    description: ClassVar[str] = "ENVI cubes (.hdr and data file) through hyperpaint"
    open_dataset_parameters: ClassVar[tuple[str, ...]] = (
        "filename_or_obj",
        "drop_variables",
        "keep_whole_lines",
    )

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        # Return whether this is an ENVI header, or a data file that has one beside it.
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        path = local_path(filename_or_obj)
        if path.suffix.lower() == ".hdr":
            return _is_envi_header(path)
        if not os.path.isfile(path):
            return False
        beside = [Path(f"{path}{suffix}") for suffix in (".hdr", ".HDR")]
        if path.suffix.lower() in _DATA_SUFFIXES:
            beside += [path.with_suffix(suffix) for suffix in (".hdr", ".HDR")]
        return any(_is_envi_header(header) for header in beside)

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        keep_whole_lines: bool = False,
        quantity: str | None = None,
    ) -> "xr.Dataset":
        # Open an ENVI cube lazily.
        #
        # ``filename_or_obj``: Path of the header or of the data file. ``drop_variables``: Names left out of
        # the dataset. ``keep_whole_lines``: Open recordings that were cut short; see
        # `hyperpaint.io.envi.envi_cubes.open_envi`. ``quantity``: Quantity of the samples where the header
        # does not state it, such as ``"counts"``.
        #
        # Raises `FormatError`: The header is damaged, contradicts itself or ``quantity``, or does not fit the
        # size of the file. Raises `FileNotFoundError`: There is no such file.
        from hyperpaint.base.schema import with_numbers

        from .envi.envi_cubes import open_envi

        cube = open_envi(filename_or_obj, keep_whole_lines=keep_whole_lines, quantity=quantity)
        return with_numbers(_without(cube, drop_variables))


class _SpectrometerEntrypoint(BackendEntrypoint):
    # Shared part of the engines of field spectrometers: one file is one spectrum.
    open_dataset_parameters: ClassVar[tuple[str, ...]] = ("filename_or_obj", "drop_variables", "quantity")
    suffix: ClassVar[str]
    #: Module, and function in it that opens such files; see there for ``quantity`` and the errors.
    opener: ClassVar[tuple[str, str]]
    #: Regular expression that the first bytes of a file match.
    beginning: ClassVar[bytes]

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        path = local_path(filename_or_obj)
        return path.suffix.lower() == self.suffix and bool(re.match(self.beginning, first_bytes(path, 120)))

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        quantity: str | None = None,
    ) -> "xr.Dataset":
        module, name = self.opener
        open_file = getattr(import_module(module, __package__), name)
        return _without(open_file(filename_or_obj, quantity), drop_variables)


class AsdBackendEntrypoint(_SpectrometerEntrypoint):
    # Opens binary files of ASD spectrometers: ``xr.open_dataset("white.asd")``, or with ``engine="asd"``.
    #
    # See `hyperpaint.open_asd` for the dataset, for many files at once and for all options.
    description: ClassVar[str] = "ASD field spectrometers (.asd) through hyperpaint"
    suffix, opener = ".asd", (".spectrometers.asd", "open_asd")
    beginning = rb"ASD|asd|as[2-8]"


class SvcBackendEntrypoint(_SpectrometerEntrypoint):
    # Opens files of SVC spectrometers: ``xr.open_dataset("hood.sig")``, or with ``engine="svc"``.
    #
    # See `hyperpaint.open_svc` for the dataset, for many files at once and for all options.
    description: ClassVar[str] = "SVC field spectrometers (.sig) through hyperpaint"
    suffix, opener = ".sig", (".spectrometers.spectrum_texts", "open_svc")
    beginning = rb"(?i)(\xef\xbb\xbf)?\s*/\*+[^\r\n]{0,80}Spectra Vista"


def _without(dataset: "xr.Dataset", drop_variables: str | Iterable[str] | None) -> "xr.Dataset":
    dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
    return dataset.drop_vars(dropped, errors="ignore")


def local_path(path: str | os.PathLike[str]) -> Path:
    # The path of a file, also behind a URL of our suffixes: other URLs are left to other engines
    text = os.fsdecode(path)
    if "://" in text and "::" not in text and text.lower().endswith((".hdr", ".asd", ".sig", ".toml")):
        from hyperpaint.base.input_files import input_path

        with contextlib.suppress(Exception):  # servers that do not answer: another engine tells
            return input_path(text)
    return Path(text)


def _is_envi_header(path: Path) -> bool:
    return first_bytes(path, 7).removeprefix(b"\xef\xbb\xbf").startswith(b"ENVI")


def first_bytes(path: Path, count: int) -> bytes:
    # Empty for an unreadable file.
    try:
        if not path.is_file():  # a pipe would wait
            return b""
        with open(path, "rb") as file:
            return file.read(count)
    except (OSError, ValueError):
        return b""
