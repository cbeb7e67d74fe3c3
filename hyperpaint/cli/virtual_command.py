"""The command ``hyperpaint virtual``: a collect to a store that refers to its raw cubes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from hyperpaint.report.summaries import Facts, counted, facts_of_line, size_of

from .console import EXISTING_FILE, PLACE, say_outcome
from .options import command, takes


def facts_of_virtual(path: Path, allow: Sequence[str] = ()) -> Facts:
    """Yield the groups of a virtual store, and whether its raw files are unchanged.

    ``allow``: as of `open_virtual`.
    """
    from hyperpaint.base.errors import StoreError
    from hyperpaint.io.store.raw_references import RAW_FILES, open_virtual, virtual_groups

    groups = virtual_groups(path)
    yield "is", f"virtual store (icechunk) of {counted(len(groups), 'flight line')}, cubes in their raw files"
    for name, about in groups.items():
        yield f"/{name}", "\n".join(f"{raw.url}, {size_of(raw.size)}" for raw in about[RAW_FILES])
        try:
            line = open_virtual(path, name, allow=allow)
        except StoreError as error:
            yield f"/{name} NOT READ", error.text(on_command_line=True)
        else:
            yield f"/{name} holds", "\n".join(f"{key}: {text}" for key, text in facts_of_line(line) if text)


@command(
    epilog="""\b
Examples:
  hyperpaint virtual collect.toml --out lot.icechunk
  hyperpaint virtual collect.toml --out lot.icechunk --prefix s3://bucket/flight

\b
Then, in Python:
  import hyperpaint as hp
  line = hp.io.open_virtual("lot.icechunk", "flightlines/raw_0")
  line.paint.reflectance()                            the bits of `process`, from the raw file

Raw files that lie neither beside the store nor below its folder are read only if they are allowed:
  hyperpaint info lot.icechunk --allow /data/day
  hp.io.open_virtual("lot.icechunk", allow="/data/day")""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@takes(
    "workflows.virtual_store:virtualise",
    out={"metavar": "STORE", "type": PLACE, "help": "A folder, a repository of icechunk."},
    prefix={
        "metavar": "URL",
        "help": "Address of the raw files, laid out as below the folder of COLLECT.toml: s3, or http or "
        "https without a port. Region, endpoint and keys of s3 come from the environment (AWS_...).",
    },
    alignment={"help": "See process."},
)
def virtual(collect: Path, out: Path, **options: Any) -> None:
    """Write a store of a few kilobytes that refers to the raw cubes of a collect.

    It holds what calibrates the lines; the counts stay where the camera wrote them, and are read from there
    when something is computed. Raw files that were moved, cut short or written to since are refused.
    """
    from hyperpaint.io.store.raw_references import outside, virtual_groups
    from hyperpaint.workflows.virtual_store import virtualise

    say_outcome(virtualise(collect, out, **options))
    _, needed = outside(out, virtual_groups(out))
    if needed:
        shown = needed[0] if len(needed) == 1 else needed
        click.echo(f"its raw files lie elsewhere: open_virtual needs allow={shown!r}, `info` --allow")
