"""Run the notebooks, and store their outputs in them, or compare the stored outputs with new ones.

python notebooks/refresh.py                  runs all notebooks and stores their outputs
python notebooks/refresh.py 03 05            runs those whose names begin so
python notebooks/refresh.py --check          changes no file; exits 1 if an output differs

Text is equal if its words are equal and its numbers agree to 2 %, or to 0.002 where they are smaller than 0.1.
Of pictures the number and the sizes are compared, since fonts differ between machines. A cell with the tag
``varies`` is run and not compared. All notebooks share one temporary folder, so that the car park is simulated
once. It needs the packages of the extra ``docs``.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import resource
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).resolve().parent
PAGE_PICTURES = {  # first pictures that README and how-to pages show, kept in docs/_static
    "01": "card.png", "03": "straight.png", "08": "white.png", "09": "skies.png", "10": "mean.png", "b2": "labels.png",
}  # fmt: skip
MAX_KB = 300.0  # size of a notebook with its outputs
RELATIVE, ABSOLUTE = 0.02, 0.002  # largest difference of numbers in texts
_NUMBER = re.compile(r"[-\N{MINUS SIGN}]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def small_png(png: str) -> str:
    """Return a PNG (base64) with 256 colours, if that is smaller."""
    picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    out = io.BytesIO()
    picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        out, "PNG", optimize=True
    )
    return min(base64.b64encode(out.getvalue()).decode("ascii"), png.replace("\n", ""), key=len)


def run(path: Path) -> Any:
    """Return a notebook with new outputs, in which only texts, Markdown and pictures are kept."""
    notebook = nbformat.read(path, as_version=4)
    options = {"timeout": 900, "kernel_name": "python3", "coalesce_streams": True}
    NotebookClient(notebook, resources={"metadata": {"path": FOLDER}}, **options).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type != "code":
            continue
        cell.execution_count = None
        kept = []
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                output.data = {"image/png": small_png(data["image/png"]), "text/plain": "a picture"}
            if data:
                output.metadata = {}
            if output.output_type == "execute_result":
                output.execution_count = None
            if output.get("name") != "stderr":
                kept.append(output)
        cell.outputs = kept
    notebook.metadata.pop("widgets", None)
    notebook.metadata.language_info = {"name": "python"}
    return notebook


def keep_picture(path: Path, notebook: Any) -> None:
    """Write the first picture of a notebook to docs/_static, if a page shows it."""
    if name := PAGE_PICTURES.get(path.name[:2]):
        outputs = (output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))
        png = next(data["image/png"] for data in outputs if "image/png" in data)
        (FOLDER.parent / "docs" / "_static" / name).write_bytes(base64.b64decode(png))


def outputs_of(notebook: Any) -> Iterator[tuple[str, str]]:
    """Yield kind and content of every output that is compared: a text, or the size of a picture."""
    for cell in notebook.cells:
        if cell.cell_type != "code" or "varies" in cell.metadata.get("tags", []):
            continue
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                width, height = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).size
                yield "picture", f"{width // 100} x {height // 100} hundred pixels"
            else:
                yield "text", str(data.get("text/markdown") or data.get("text/plain") or output.get("text"))


def differ(stored: str, new: str) -> bool:
    """Return whether two texts differ in words, or in numbers beyond the tolerance."""
    if [part.split() for part in _NUMBER.split(stored)] != [part.split() for part in _NUMBER.split(new)]:
        return True
    pairs = zip(_NUMBER.findall(stored), _NUMBER.findall(new), strict=True)
    values = (
        (float(a.replace("\N{MINUS SIGN}", "-")), float(b.replace("\N{MINUS SIGN}", "-"))) for a, b in pairs
    )
    return any(abs(a - b) > max(ABSOLUTE, RELATIVE * abs(a)) for a, b in values)


def differences(path: Path, new: Any) -> list[str]:
    """Return how new outputs differ from the stored ones."""
    before, after = (list(outputs_of(each)) for each in (nbformat.read(path, as_version=4), new))
    if [kind for kind, _ in before] != [kind for kind, _ in after]:
        return [f"{len(before)} outputs are stored, {len(after)} are made, or their kinds differ"]
    pairs = zip(before, after, strict=True)
    return [
        f"a stored {kind} differs:\n    stored {old[:300]!r}\n    new    {text[:300]!r}"
        for (kind, old), (_, text) in pairs
        if (old != text if kind == "picture" else differ(old, text))
    ]


def main() -> int:
    """Run or compare the notebooks named in the arguments; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="beginnings of names; all notebooks by default")
    parser.add_argument("--check", action="store_true", help="compare only; exit 1 on a difference")
    options = parser.parse_args()
    chosen = [
        path
        for path in sorted(FOLDER.glob("*.ipynb"))
        if not options.names or path.name.startswith(tuple(options.names))
    ]
    faults = 0
    with tempfile.TemporaryDirectory() as scratch:
        os.environ |= {"TMPDIR": scratch, "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
        for path in chosen:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            notebook = run(path)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            text = nbformat.writes(notebook)
            kilobytes = len(text.encode()) / 1000
            told = differences(path, notebook) if options.check else []
            if kilobytes > MAX_KB:
                told.append(f"{kilobytes:.0f} kB with outputs, at most {MAX_KB:.0f}")
            print(f"{path.name}: {seconds:.0f} CPU s, {kilobytes:.0f} kB", *told, sep="\n  ", flush=True)
            faults += len(told)
            if not options.check:
                path.write_text(text + "\n", encoding="utf-8")
                keep_picture(path, notebook)
    return min(faults, 1)


if __name__ == "__main__":
    sys.exit(main())
