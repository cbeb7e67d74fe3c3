"""Every public name, and the pages of the reference that list them."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import xarray as xr
from error_codes import codes_page

import hyperpaint

__all__ = ["accessor_methods", "public_names", "rooms", "write_reference"]

_FRONT = """# Reference

These pages list everything public. `hp` is `import hyperpaint as hp`. A method of `.paint` is the function
of the same name with the dataset as its first argument.

"""
#: Sentence about each room for its page.
_ABOUT = {
    "alignment": "Compare and correct the wavelengths of camera and irradiance record in flight",
    "calibration": "Compute wavelengths, widths and gains of the camera from a lab sweep",
    "errors": "Errors that hyperpaint raises, and its warnings",
    "geometry": "Compute ground positions, maps and mosaics from navigation",
    "io": "Read files into labelled datasets, and write datasets to files",
    "light": "Compute the irradiance of every line and band, the sun and the sky",
    "paints": "Extract signatures from regions; search and mix libraries",
    "pictures": "Draw figures",
    "radiometry": "Compute radiance and reflectance from counts, with uncertainties",
    "regions": "Read, write and propose outlines of paint",
    "report": "Write a page about a store",
    "simulation": "Simulate collects and scenes with known true values",
    "surroundings": "Flag and correct glint, shadow and light from neighbours",
    "validation": "Compare paint signatures with references",
}


def rooms() -> dict[str, ModuleType]:
    """Return the rooms that `hp.<Tab>` shows, and the errors."""
    names = [name for name in hyperpaint.__all__ if inspect.ismodule(getattr(hyperpaint, name))]
    return {name: getattr(hyperpaint, name) for name in names}


def public_names() -> Iterator[str]:
    """Yield every public name once, with its dots: those at the top, then what else each room has."""
    top = {name: getattr(hyperpaint, name) for name in hyperpaint.__all__}
    yield from (f"hyperpaint.{name}" for name, value in top.items() if not inspect.ismodule(value))
    seen = {id(value) for value in top.values()}
    for room, module in rooms().items():
        for name in module.__all__:
            value = getattr(module, name)
            if id(value) not in seen and not inspect.ismodule(value):
                yield f"hyperpaint.{room}.{name}"


def accessor_methods() -> list[str]:
    """Return the methods of ``Dataset.paint``."""
    return [name for name in dir(type(xr.Dataset().paint)) if not name.startswith("_")]


def _table(names: list[str], template: str = "") -> str:
    lines = ["```{eval-rst}", ".. autosummary::", "   :toctree: generated/", "   :nosignatures:"]
    if template:
        lines.insert(1, ".. currentmodule:: xarray\n")
    if template:
        lines.append(f"   :template: {template}")
    return "\n".join([*lines, "", *(f"   {name}" for name in names), "```", ""])


def write_reference(folder: Path) -> None:
    """Write the index of the reference, and a page a room; what is unchanged keeps its time."""
    folder.mkdir(exist_ok=True)
    names = list(public_names())
    top = [name for name in names if name.count(".") == 1]
    methods = [f"Dataset.paint.{name}" for name in accessor_methods()]
    pages = {
        "top": (
            "The chain",
            "These functions are at the top of `hp`: open files, run the processing chain, write results.",
            _table(top),
        ),
        "accessor": (
            "Dataset.paint",
            "Methods of a flight line, a map or a library. Every method returns a new object.",
            _table(methods, "autosummary/accessor_method.rst"),
        ),
    }
    for room in sorted(rooms()):
        inside = [name for name in names if name.startswith(f"hyperpaint.{room}.")]
        pages[room] = (f"hp.{room}", f"{_ABOUT[room]}.", _table(inside))
    public = {*names, *(f"xarray.{method}" for method in methods)}
    for page in (folder / "generated").glob("*.rst"):  # of a name that is public no longer
        if page.stem not in public:
            page.unlink()
    index = (
        _FRONT
        + "```{toctree}\n:maxdepth: 1\n\n"
        + "\n".join([*pages, "command_line", "error_codes"])
        + "\n```\n"
    )
    texts = {name: f"# {title}\n\n{about}\n\n{table}" for name, (title, about, table) in pages.items()}
    texts |= {"index": index, "command_line": _command_line(), "error_codes": codes_page()}
    for name, text in texts.items():
        page = folder / f"{name}.md"
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def _command_line() -> str:
    """Return a page of what every command's ``--help`` says."""
    import click

    from hyperpaint.cli.program import main as program

    context = click.Context(program, info_name="hyperpaint")
    parts = ["# Command line\n", "This page shows the output of `--help` for every command.\n"]
    for name in program.list_commands(context):
        command = program.get_command(context, name)
        if command is not None:
            text = command.get_help(
                click.Context(command, info_name=f"hyperpaint {name}", terminal_width=100)
            )
            parts.append(f"## {name}\n\n```text\n{text}\n```\n")
    return "\n".join(parts)
