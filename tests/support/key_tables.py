"""Writes generated tables of the documentation: ``python tests/support/key_tables.py``.

Keys come from the facts, flags from `Quality`.
"""

from collections.abc import Mapping
from pathlib import Path

from hyperpaint.base.facts import Facts, toml_text
from hyperpaint.base.schema import Quality
from hyperpaint.io.collect.collect_toml import SCHEMA as COLLECT
from hyperpaint.workflows.rendering import SCHEMA as SCENE

DOCS = Path(__file__).parents[2] / "docs"
BEGIN, END = "<!-- generated: tests/support/key_tables.py -->", "<!-- end of generated -->"


def key_table(facts: Facts) -> str:
    # Return a Markdown table of keys: key, accepted values, default, meaning with unit
    rows = ["| key | accepted | default | meaning |", "| --- | --- | --- | --- |"]
    for key, one in facts.items():
        default = "needed" if one.needed else "" if one.default is None else f"`{toml_text(one.default)}`"
        unit = f" [{one.unit}]" if one.unit else ""
        rows.append(f"| `{key}` | {one.expected} | {default} | {one.doc}{unit} |".replace("|  |", "| |"))
    return "\n".join(rows)


def key_tables(schema: Mapping[str, Facts], lists: tuple[str, ...]) -> list[str]:
    # Return a headed table of every section of a TOML file; ``lists``: sections that may be repeated
    return [
        f"### {f'[[{name}]]' if name in lists else f'[{name}]'}\n\n{key_table(facts)}"
        for name, facts in schema.items()
        if facts
    ]


def flag_table() -> str:
    # Return a Markdown table of the flags
    rows = ["| bit | name | set from | condition | reflectance |", "| --- | --- | --- | --- | --- |"]
    for flag in Quality:
        name = str(flag.name).lower()
        rows.append(f"| {flag.value} | `{name}` | {flag.source} | {flag.condition} | {flag.samples} |")
    return "\n".join(rows)


PAGES = {
    "formats/collect_toml.md": key_tables(COLLECT, ("flightlines", "references", "panels")),
    "formats/scene_toml.md": key_tables(SCENE, ("meshes", "atmospheres")),
    "explanation/quality.md": [flag_table()],
}


def with_tables(page: str) -> str:
    # Return a page with its tables between the markers
    before, rest = (DOCS / page).read_text(encoding="utf-8").split(BEGIN)
    return "\n\n".join([before + BEGIN, *PAGES[page], END + rest.split(END)[1]])


if __name__ == "__main__":
    for name in PAGES:
        (DOCS / name).write_text(with_tables(name), encoding="utf-8")
