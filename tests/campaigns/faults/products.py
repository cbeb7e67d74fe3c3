"""Commands that replace a product and are killed: the place holds the old product or the new one.

    python tests/campaigns/all_faults.py --only products               each command killed 20 times
    python tests/campaigns/all_faults.py --only products --scale 0.1   twice

Half of the kills come at a random instant of the command, half before a call that changes files. The old and
the new product differ in every file. Where several files are one product, the last one, by which it is
opened, may be absent after a kill, until the product is made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import random
import re
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hyperpaint as hp

from .outcome import Outcome
from .whole_runs import PRELOAD, SCRATCH, SIGNALS, Fault
from .writers import UNLISTED

__all__ = ["PRODUCTS", "Lots", "Product", "campaign", "run_kills"]

KILLS = 20
_FAR = 10**9
_MOST_SECONDS = 120.0
_TIME = re.compile(rb"[0-9: -]+ UTC by hyperpaint")  # when a report was written
os.environ.setdefault("ICECHUNK_LOG", "off")  # what it cannot open is counted
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    [*PRELOAD, "rasterio", "hyperpaint.cli.program", "hyperpaint.report.static_site",
     "hyperpaint.report.store_report", "hyperpaint.workflows.library_files", __name__]
)  # fmt: skip


@dataclass(frozen=True)
class Product:
    """The words of a command, which name its inputs and the home of the product, and the product's files."""

    words: str
    places: tuple[str, ...]

    def call(self, inputs: Path, version: str, home: Path) -> list[str]:
        words = self.words.format(inputs=inputs / version, home=home)
        return [*words.split("|"), "--overwrite"]

    def content(self, home: Path) -> str:
        """Return a checksum of all files of the product; empty where there is nothing to open."""
        key = home / self.places[-1]
        if not key.exists():
            return ""
        if key.suffix == ".icechunk":  # names of its files are random
            from hyperpaint.io.store.raw_references import virtual_groups

            try:
                return repr(virtual_groups(key))
            except Exception as error:
                return f"cannot be opened: {error!r:.200}"
        stores = [path.parent for path in key.rglob("zarr.json") if path.parent.suffix == ".zarr"]
        problems = [problem for store in stores for problem in hp.verify(store).problems]
        # between a group's place and the root's list a kill leaves a whole group, of which verify says that
        if wrong := [problem for problem in problems if not problem.startswith(UNLISTED)]:
            return f"verify says {wrong[0]}"
        digest = hashlib.sha256()
        for place in (home / name for name in self.places):
            files = sorted(each for each in place.rglob("*") if each.is_file()) if place.is_dir() else [place]
            for file in files:
                digest.update(f"{file.relative_to(home)}".encode())
                content = file.read_bytes() if file.exists() else b"absent"
                # metadata of a store hold times, and have been verified
                digest.update(b"" if file.name == "zarr.json" else _TIME.sub(b"", content))
        return digest.hexdigest()


PRODUCTS = {
    "signatures": Product(
        "signatures|{inputs}/lot.zarr|--regions|{inputs}/regions.geojson|--no-flags|--out|{home}/paints.zarr|--quiet",
        ("paints.zarr",),
    ),
    "orthorectify": Product(
        "orthorectify|{inputs}/lot.zarr|--line|raw_0|--out|{home}/map.tif|--stac|--quiet",
        ("map.json", "map.tif"),
    ),
    "mosaic": Product(
        "mosaic|{inputs}/lot.zarr|--out|{home}/both.tif|--seamlines|{home}/seams/both.geojson|--quiet",
        ("seams/both.geojson", "both.tif"),
    ),
    "virtual": Product("virtual|{inputs}/raw/collect.toml|--out|{home}/lot.icechunk", ("lot.icechunk",)),
    "export": Product(
        "export|{inputs}/paints.zarr|--format|envi|--curves|all|--out|{home}/paints.sli|--quiet",
        ("paints.sli", "paints.sli.json", "paints.hdr"),
    ),
    "site": Product("site|{inputs}/lot.zarr|--out|{home}/page|--quiet", ("page",)),
    "report": Product("report|{inputs}/lot.zarr|--out|{home}/report.html|--quiet", ("report.html",)),
}


class Lots:
    """Inputs in two versions, older and newer."""

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.inputs = folder
        for number, version in enumerate(("older", "newer")):
            (folder / version).mkdir()
            _write_inputs(folder / version, number, names)

    def reference(self, product: Product, version: str, home: Path) -> None:
        """Make the product of a version, undisturbed."""
        home.mkdir()
        child = _started(product.call(self.inputs, version, home), home)
        child.join()
        if child.exitcode:
            raise RuntimeError(f"{product.words} exits with {child.exitcode}")


def _write_inputs(folder: Path, number: int, names: Sequence[str]) -> None:
    import numpy as np
    import xarray as xr
    from support.flown_lines import fly, located

    from hyperpaint.simulation import simulate_collect

    if "virtual" in names:
        simulate_collect(folder / "raw", scene="plan", lines=64, bands=4, columns=6, seed=number)
    rng, lines = np.random.default_rng(number), {}
    for at in range(2):
        flown = fly(40, 20, "calm", heading=30.0 + 90.0 * at, seed=at)
        values = rng.random((40, 6, 20)).astype(np.float32)
        line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
        zenith = (("along_track", "cross_track"), np.full((40, 20), 5.0 - at + number), {"units": "degree"})
        wavelength = ("band", np.linspace(450.0, 700.0, 6), {"units": "nm"})
        lines[f"/flightlines/raw_{at}"] = line.assign_coords(wavelength=wavelength, view_zenith=zenith)
    hp.to_store(xr.DataTree.from_dict(lines), folder / "lot.zarr")
    corners = [(2, 2), (18 - number, 2), (18, 30 - number), (2, 30)]
    regions = [hp.Region(f"paint {at}", corners, flightline="raw_0") for at in range(1 + number)]
    hp.write_regions(regions, folder / "regions.geojson")
    if "export" in names:
        rho = ("signature", "band"), rng.random((4, 30)).astype(np.float32), {"units": "1"}
        nm = "band", np.linspace(400.0, 900.0, 30), {"units": "nm"}
        labels = [f"paint {at} of {number}" for at in range(4)]
        coords = {"signature": labels, "wavelength": nm}
        paints = xr.Dataset({"reflectance": rho, "standard_error": rho}, coords)
        hp.write_library(paints, folder / "paints.zarr")


def _child(words: list[str], home: Path, fault: Fault | None, ready: Any) -> None:
    """Run a command; send the number of its calls that change files."""
    from hyperpaint.cli.program import main

    ready.send(True)
    counter = (fault or Fault(_FAR)).arm(home)
    with open(os.devnull, "w") as sink, contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        status = main.main(words, "hyperpaint", standalone_mode=False)
    for number in SIGNALS[1:]:
        signal.signal(number, signal.SIG_IGN)
    ready.send(next(counter) - 1)
    os._exit(status or 0)


def _started(words: list[str], home: Path, fault: Fault | None = None) -> Any:
    """Start a command in a process of its own; its attribute ``calls`` receives the number of its calls."""
    receiver, sender = _CONTEXT.Pipe(duplex=False)
    process = _CONTEXT.Process(target=_child, args=(words, home, fault, sender))
    process.start()
    sender.close()
    if receiver.poll(_MOST_SECONDS):
        receiver.recv()
    process.calls = receiver
    return process


def run_kills(name: str, lots: Lots, folder: Path, numbers: range) -> Iterator[Outcome]:
    """Yield the outcome of each kill of a command: even numbers at an instant, odd ones before a call."""
    product = PRODUCTS[name]
    old, new = folder / "older", folder / "newer"
    lots.reference(product, "older", old)
    lots.reference(product, "newer", new)
    contents = {product.content(old): "old", product.content(new): "new", "": "absent"}
    again = folder / "again"
    shutil.copytree(old, again)
    start = time.monotonic()
    child = _started(product.call(lots.inputs, "newer", again), again)
    calls = child.calls.recv()
    child.join()
    duration = time.monotonic() - start
    if len(contents) < 3 or contents.get(product.content(again)) != "new":
        yield Outcome(f"products: {name}", 1, ["old and new are the same, or two runs write different bytes"])
        return
    entries = _entries(new)
    for number in numbers:
        outcome = Outcome(f"products: {name}", 1)
        home = folder / f"kill {number}"
        shutil.copytree(old, home)
        fault, which = f"{name}, kill {number}", SIGNALS[number // 2 % len(SIGNALS)]
        at_call = 1 + (number // 2 * calls) // max(1, len(numbers) // 2) % calls if number % 2 else _FAR
        child = _started(product.call(lots.inputs, "newer", home), home, Fault(at_call))
        if number % 2:
            fault += f" (call {at_call} of {calls})"
        else:
            wait = random.Random(f"{name}:{number}").uniform(0.0, duration)
            fault += f" ({which.name} after {wait:.2f} of {duration:.2f} s)"
            child.join(wait)
            if child.is_alive():
                os.kill(child.pid, which)
        child.join()
        found = contents.get(product.content(home), "mixed")
        outcome.notes[f"{found} left"] += 1
        if found == "mixed" or (found == "absent" and len(product.places) == 1):
            outcome.wrong.append(f"{fault}: {found} is left, {_entries(home)}")
        child = _started(product.call(lots.inputs, "newer", home), home)
        child.join()
        found = contents.get(product.content(home), "mixed")
        if child.exitcode or found != "new" or _entries(home) != entries:
            outcome.wrong.append(f"{fault}: the rerun exits with {child.exitcode}, {found}, {_entries(home)}")
        shutil.rmtree(home)
        yield outcome


def _entries(home: Path) -> list[str]:
    return sorted(str(path.relative_to(home)) for path in (*home.iterdir(), *home.glob("seams/*")))


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every kill."""
    numbers = range(first, first + max(2, round(KILLS * scale)))
    with tempfile.TemporaryDirectory(dir=SCRATCH) as home:
        lots = Lots(Path(home), tuple(PRODUCTS))
        for name in PRODUCTS:
            with tempfile.TemporaryDirectory(dir=SCRATCH) as scratch:
                yield from run_kills(name, lots, Path(scratch), numbers)
