"""Every public name, and the pages of the reference that list them."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType

import xarray as xr
from error_codes import codes_page

import hyperpaint
from hyperpaint.accessor import METHOD_GROUPS, METHODS

__all__ = ["accessor_methods", "public_names", "rooms", "write_reference"]

_FRONT = """# Reference

These pages list everything public. `hp` is `import hyperpaint as hp`. A method of `.paint` is the function
of the same name with the dataset as its first argument.

"""
#: Tasks of the reference, and what each page holds: the chain, the accessor and the rooms.
_TASKS = {
    "Start here": {
        "top": "Open files, run the processing chain, write results",
        "accessor": "Methods of a flight line, a map or a library",
    },
    "From files to reflectance": {
        "io": "Read files into labelled datasets, and write datasets to files",
        "calibration": "Compute wavelengths, widths and gains of the camera from a lab sweep",
        "light": "Compute the irradiance of every line and band, the sun and the sky",
        "radiometry": "Compute radiance and reflectance from counts, with uncertainties",
        "alignment": "Compare and correct the wavelengths of camera and irradiance record in flight",
    },
    "From reflectance to paints": {
        "surroundings": "Flag and correct glint, shadow and light from neighbours",
        "regions": "Read, write and propose outlines of paint",
        "paints": "Extract signatures from regions; search and mix libraries",
        "validation": "Compare paint signatures with references",
    },
    "Maps, pictures and reports": {
        "geometry": "Compute ground positions, maps and mosaics from navigation",
        "pictures": "Draw figures",
        "report": "Write a page about a store",
    },
    "Simulation": {"simulation": "Simulate collects and scenes with known true values"},
    "Look up": {"errors": "Errors that hyperpaint raises, and its warnings"},
}
_ABOUT = {room: sentence for pages in _TASKS.values() for room, sentence in pages.items()}
#: Beginnings of the names at the top, by task; what is left are objects and errors.
_TOP_TASKS = {
    "Open files": ("open_", "read_"),
    "Compute": ("radiance", "reflectance", "calibrate", "extract_", "validate", "slab"),
    "Process and store": ("process", "to_store", "verify"),
    "Write files": ("write_",),
    "Simulate": ("simulate_", "render_"),
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


def accessor_methods() -> set[str]:
    """Return the methods of ``Dataset.paint``."""
    return {name for name in dir(type(xr.Dataset().paint)) if not name.startswith("_")}


def _table(names: Iterable[str], template: str = "") -> str:
    lines = ["```{eval-rst}", ".. autosummary::", "   :toctree: generated/", "   :nosignatures:"]
    if template:
        lines.insert(1, ".. currentmodule:: xarray\n")
        lines.append(f"   :template: {template}")
    return "\n".join([*lines, "", *(f"   {name}" for name in names), "```", ""])


def _tables(groups: Mapping[str, Iterable[str]], template: str = "") -> str:
    """Return a heading and a table for every group."""
    return "\n".join(
        f"## {title[0].upper()}{title[1:]}\n\n{_table(names, template)}" for title, names in groups.items()
    )


def write_reference(folder: Path) -> None:
    """Write the index of the reference, and a page a room; what is unchanged keeps its time."""
    folder.mkdir(exist_ok=True)
    names = list(public_names())
    left = [name for name in names if name.count(".") == 1]
    top = {}
    for task, starts in _TOP_TASKS.items():
        top[task] = [name for name in left if name.split(".")[-1].startswith(starts)]
        left = [name for name in left if name not in top[task]]
    methods = METHOD_GROUPS | {"store and units": accessor_methods() - set(METHODS)}
    groups = {task: [f"Dataset.paint.{name}" for name in sorted(group)] for task, group in methods.items()}
    pages = {
        "top": ("The chain", _tables(top | {"Objects and errors": left})),
        "accessor": ("Dataset.paint", _tables(groups, "autosummary/accessor_method.rst")),
    }
    for room in sorted(rooms()):
        pages[room] = (f"hp.{room}", _table(name for name in names if name.startswith(f"hyperpaint.{room}.")))
    public = {*names, *(f"xarray.{method}" for group in groups.values() for method in group)}
    for page in (folder / "generated").glob("*.rst"):  # of a name that is public no longer
        if page.stem not in public:
            page.unlink()
    extra = {"Look up": ["command_line", "error_codes"]}
    index = _FRONT + "\n".join(
        f"```{{toctree}}\n:maxdepth: 1\n:caption: {task}\n\n"
        + "\n".join([*inside, *extra.get(task, [])])
        + "\n```\n"
        for task, inside in _TASKS.items()
    )
    texts = {name: f"# {title}\n\n{_ABOUT[name]}.\n\n{table}" for name, (title, table) in pages.items()}
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
