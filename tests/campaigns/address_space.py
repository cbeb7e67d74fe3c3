"""A cube far larger than the address space that may be taken: processed all the same, to the same bits.

    python tests/campaigns/address_space.py                      4 GiB of counts, 1 GiB above the imports
    python tests/campaigns/address_space.py --cube-mib 800 --room-mib 700

A first process does it without a limit. A second one imports everything, limits its address space
(``RLIMIT_AS``) to what that takes and ``--room-mib`` more, and does it again. Compared are the bytes of every
chunk. Takes 11 GB of disk for the whole of it, under TMPDIR. Exits with 1 where anything differs.
"""

import argparse
import hashlib
import importlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import hyperpaint as hp

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `hyperpaint` may not be importable yet
    sys.path.insert(0, str(ROOT))

MIB = 2**20
BLOCK_LINES = 64
IMPORTS = (
    *("dask.array", "numba", "numcodecs.blosc", "pandas", "pint", "scipy.interpolate", "xarray", "zarr"),
    *(
        "hyperpaint.accessor",
        "hyperpaint.io.collect.collect_toml",
        "hyperpaint.io.store",
        "hyperpaint.kernels.radiometry",
    ),
    *(
        "hyperpaint.workflows.pipeline",
        "hyperpaint.pictures.plot",
        "hyperpaint.radiometry.counts_to_reflectance",
    ),
)


def write_collect(folder: Path, cube_bytes: int, *, bands: int = 272, columns: int = 640) -> Path:
    # Write a collect with one cube of at least so many bytes; return its ``collect.toml``
    # Only a block of lines is simulated in full width. The cube repeats it, each time shifted, beside the
    # times, positions and sky of a simulated flight of the whole length.
    lines = -(-cube_bytes // (bands * columns * 2))
    flight = hp.simulate_collect(
        folder / "long", scene="plan", lines=lines, bands=4, columns=4, seed=3, truth=False
    ).parent
    block = hp.simulate_collect(
        folder / "block", scene="plan", lines=BLOCK_LINES, bands=bands, columns=columns, seed=3, truth=False
    ).parent
    for part in ("dark", "calibration.zarr"):
        shutil.rmtree(flight / part)
        (block / part).rename(flight / part)
    header = (block / "flight" / "raw_0.hdr").read_text()
    header = re.sub(r"(?m)^(lines\s*=\s*)\d+", rf"\g<1>{lines}", header)
    (flight / "flight" / "raw_0.hdr").write_text(header)
    counts = np.fromfile(block / "flight" / "raw_0", "<u2").reshape(BLOCK_LINES, bands, columns)
    with open(flight / "flight" / "raw_0", "wb") as file:
        for number, first in enumerate(range(0, lines, BLOCK_LINES)):
            file.write(np.roll(counts, number, axis=2)[: lines - first].tobytes())
    shutil.rmtree(block)
    return flight / "collect.toml"


def digests(store: Path) -> dict[str, str]:
    # Return a digest of the bytes of every chunk
    found = {}
    for file in sorted(store.rglob("*")):
        if file.is_file() and "c" in file.relative_to(store).parts:
            with open(file, "rb") as opened:
                found[str(file.relative_to(store))] = hashlib.file_digest(opened, "blake2b").hexdigest()
    return found


def process(collect: Path, out: Path, room: int | None = None) -> dict[str, float]:
    # Process a collect in a new process; return its peaks [MiB] and time [s]
    # collect, out: As for `hyperpaint.process`
    # room: Address space above the imports [byte]; None for no limit
    command = [sys.executable, __file__, "--child", str(collect), str(out), str(room or 0)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _child(collect: str, out: str, room: str) -> None:
    for module in IMPORTS:
        importlib.import_module(module)

    before = _status()
    if int(room):
        _limit(int(before["VmSize"]) + int(room), Path(collect))
    begun = time.perf_counter()
    # the counts repeat a short flight, and its dark is not theirs
    hp.process(collect, out, accept=["dark-pattern"])
    after = _status()
    found = {
        "imports": before["VmSize"] / MIB,
        "address_space": (after["VmPeak"] - before["VmSize"]) / MIB,
        "resident": (after["VmHWM"] - before["VmRSS"]) / MIB,
        "seconds": time.perf_counter() - begun,
    }
    print(json.dumps(found))


def _limit(size: int, collect: Path) -> None:
    # Limit the address space, and make sure that the limit is one: the cube must not go into it
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    try:
        np.memmap(collect.parent / "flight" / "raw_0", np.uint16, "r")
    except (OSError, MemoryError):
        return
    raise SystemExit("the cube as a whole goes into the limited address space, which shows nothing")


def _status() -> dict[str, int]:
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {words[0].rstrip(":"): 1024 * int(words[1]) for words in lines if words[-1] == "kB"}


def show(folder: Path, cube_bytes: int, room: int) -> bool:
    # Process a collect without and with the limit, print what was measured, tell whether all is equal
    collect = write_collect(folder, cube_bytes)
    size = (collect.parent / "flight" / "raw_0").stat().st_size
    print(
        f"cube of {size / MIB:.0f} MiB, {room / MIB:.0f} MiB of address space above the imports", flush=True
    )
    made = []
    for name, limit in (("no limit", None), ("limited", room)):
        peak = process(collect, folder / "out.zarr", limit)
        made.append(digests(folder / "out.zarr"))
        shutil.rmtree(folder / "out.zarr")
        print(
            f"{name:<10} {peak['address_space']:6.0f} MiB of address space and {peak['resident']:4.0f} MiB "
            f"resident above the imports ({peak['imports']:.0f} MiB), {peak['seconds']:.1f} s, "
            f"{len(made[-1])} chunks",
            flush=True,
        )
    same = bool(made[0]) and made[0] == made[1]
    print("bit-identical" if same else "DIFFERENT")
    return same


def main(arguments: list[str]) -> int:
    # Do what the command line asks for, return the exit status
    if arguments[:1] == ["--child"]:
        _child(*arguments[1:])
        return 0
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cube-mib", type=int, default=4096)
    parser.add_argument("--room-mib", type=int, default=1024)
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="hyperpaint-space-") as folder:
        return 0 if show(Path(folder), asked.cube_mib * MIB, asked.room_mib * MIB) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
