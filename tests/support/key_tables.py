"""Writes the tables of keys in the documentation from the facts: ``python tests/support/key_tables.py``."""

from __future__ import annotations

from pathlib import Path

from hyperpaint.base.facts import Facts, toml_text
from hyperpaint.io.collect.collect_toml import SCHEMA as COLLECT
from hyperpaint.workflows.scene_files import SCHEMA as SCENE

DOCS = Path(__file__).parents[2] / "docs" / "formats"
BEGIN, END = "<!-- keys: tests/support/key_tables.py -->", "<!-- end of keys -->"
PAGES: dict[str, tuple[dict[str, Facts], tuple[str, ...]]] = {
    "collect_toml.md": (dict(COLLECT), ("flightlines", "references", "panels")),
    "scene_toml.md": (dict(SCENE), ("meshes", "atmospheres")),
}


def key_table(facts: Facts) -> str:
    """Return a Markdown table of keys: key, accepted values, default, meaning with unit."""
    rows = ["| key | accepted | default | meaning |", "| --- | --- | --- | --- |"]
    for key, one in facts.items():
        default = "needed" if one.needed else "" if one.default is None else f"`{toml_text(one.default)}`"
        unit = f" [{one.unit}]" if one.unit else ""
        rows.append(f"| `{key}` | {one.expected} | {default} | {one.doc}{unit} |".replace("|  |", "| |"))
    return "\n".join(rows)


def with_tables(page: str) -> str:
    """Return a page with its tables of keys between the markers."""
    schema, lists = PAGES[page]
    before, rest = (DOCS / page).read_text(encoding="utf-8").split(BEGIN)
    tables = [
        f"### {f'[[{name}]]' if name in lists else f'[{name}]'}\n\n{key_table(facts)}"
        for name, facts in schema.items()
        if facts
    ]
    return "\n\n".join([before + BEGIN, *tables, END + rest.split(END)[1]])


if __name__ == "__main__":
    for name in PAGES:
        (DOCS / name).write_text(with_tables(name), encoding="utf-8")
