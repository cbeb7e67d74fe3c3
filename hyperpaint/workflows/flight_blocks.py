"""Blocks of a group whose line is still being recorded: written as its lines come, taken up when it is whole.

A flight is a build like any other, ``build-<group>-flight_<codec>-<attempt>`` in the staging folder, of
which only whole slabs are written. Its log names, for every slab, all that its products were calibrated with.
When the line is whole, its own counts and plan are compared with those: slabs that agree are handed over to
the writer, which takes them up as it does those of a killed run, and the others are made anew.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.io.store.chunks import Target, whole_chunk
from hyperpaint.io.store.layout import Codec
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.stage import Staging, flight_content
from hyperpaint.io.store.writer import Job

_LOG = "slabs.log"
_ENTRY = re.compile(r"(\d{1,9}) ([0-9a-f]{32})")


class FlightBlocks:
    """Blocks of a group in flight; ``form``: names, dims and dtypes of its arrays."""

    def __init__(self, folder: Path, form: xr.Dataset, codec: Codec) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        place = Location.of(folder)
        self._targets = {
            str(name): Target.of(str(name), v, place, codec) for name, v in form.variables.items()
        }
        for name in self._targets:
            (folder / name).mkdir(exist_ok=True)
        self._lock = threading.Lock()
        self.digests = self._logged()

    @classmethod
    def begun(cls, stage: Staging, group: str, form: xr.Dataset, codec: Codec) -> list[FlightBlocks]:
        """Return the blocks of earlier attempts at a group, killed or ended."""
        return [cls(folder, form, codec) for folder in stage.leftovers(group, flight_content(codec))]

    @classmethod
    def of(cls, stage: Staging, group: str, form: xr.Dataset, codec: Codec) -> FlightBlocks:
        """Return where the blocks of a group go, with those that are there already."""
        begun = cls.begun(stage, group, form, codec)
        return begun[0] if begun else cls(stage.build(group, flight_content(codec)), form, codec)

    def _logged(self) -> dict[int, str]:
        # a line that was cut short by a kill counts for nothing
        try:
            text = (self.folder / _LOG).read_text(encoding="ascii", errors="replace")
        except FileNotFoundError:
            return {}
        if not text.endswith("\n"):
            self._append("\n")
        entries = filter(None, map(_ENTRY.fullmatch, text.splitlines()))
        return {int(entry[1]): entry[2] for entry in entries}

    def _append(self, text: str) -> None:
        with open(self.folder / _LOG, "a", encoding="ascii") as file:
            file.write(text)

    def checksum(self, name: str, slab: int) -> int | None:
        """Return the crc32c of a stored slab; None where the slab is missing or damaged."""
        try:
            return whole_chunk((self.folder / name / self._key(name, slab)).read_bytes())
        except OSError:
            return None

    def write(self, slab: int, arrays: Mapping[str, np.ndarray], digest: str | None = None) -> None:
        """Write a slab of whole lines of some arrays; ``digest`` names what products were made with."""
        for name, block in arrays.items():
            self._targets[name].write(block, self._position(name, slab))
        if digest is not None:
            with self._lock:
                self._append(f"{slab} {digest}\n")
                self.digests[slab] = digest

    def forget(self, slabs: Iterable[int], names: Iterable[str]) -> None:
        """Drop slabs of arrays, which are then made anew."""
        for slab in slabs:
            for name in names:
                (self.folder / name / self._key(name, slab)).unlink(missing_ok=True)

    def hand_over(self, stage: Staging, job: Job) -> None:
        """Let the writer of a group find these blocks."""
        os.rename(self.folder, stage.build(job.group, job.build))

    def _position(self, name: str, slab: int) -> tuple[int, ...]:
        return (slab, *(0 for _ in self._targets[name].chunk[1:]))

    def _key(self, name: str, slab: int) -> str:
        return self._targets[name].key(self._position(name, slab))
