"""The page of error codes: every code with its messages and remedies, read from the sources of hyperpaint."""

from __future__ import annotations

import ast
import functools
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import hyperpaint
from hyperpaint.plausibility.judging import KINDS

_FRONT = """# Error codes

Every error, warning and finding ends with a stable code in brackets, such as `[region-empty]`. In scripts,
test the code and not the message:

```python
try:
    signatures = line.paint.signatures(regions)
except hp.errors.SchemaError as error:
    if "region-empty" not in error.codes:
        raise
```

`error.problems` lists the faults of an input, each with `found`, `expected`, `mend` (in Python), `option`
(on the command line) and `code`. A `PaintWarning` has `code`. To process despite a finding of
`hyperpaint check`, accept its code (`--accept dark-lit`).

This page is generated from the sources; `...` stands for a value.
"""
_MESSAGES = 4


@dataclass(frozen=True)
class Fault:
    """One place that raises, notes or warns of a fault."""

    code: str
    found: str
    expected: str
    mend: str
    room: str


@functools.cache
def faults() -> tuple[Fault, ...]:
    """Return every fault with a literal code, in the order of the files."""
    root, found_faults = Path(hyperpaint.__file__).parent, []
    for path in sorted(root.rglob("*.py")):
        room = path.relative_to(root).parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            keywords = {keyword.arg: keyword.value for keyword in node.keywords}
            code = keywords.get("code")
            if isinstance(code, ast.Constant) and isinstance(code.value, str) and code.value and node.args:
                found = next((text for text in map(_template, node.args) if " " in text), "")
                expected, mend = (_template(keywords.get(name)) for name in ("expected", "mend"))
                mend = mend or _template(keywords.get("option"))
                found_faults.append(Fault(code.value, found, expected, mend, room))
    kinds = (Fault(kind.name, kind.meaning, "", kind.mend, "plausibility") for kind in KINDS.values())
    return (*found_faults, *kinds)


def _template(node: ast.expr | None) -> str:
    """Return the text of an expression, with `...` for every value."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        parts = (part.value if isinstance(part, ast.Constant) else "..." for part in node.values)
        return re.sub(r"(\.\.\.){2,}", "...", "".join(map(str, parts)))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _template(node.left) + _template(node.right)
    return "" if node is None else "..."


def codes_page() -> str:
    """Return the page: a section a code, with its messages, accepted values and remedies."""
    by_code: dict[str, list[Fault]] = defaultdict(list)
    for fault in faults():
        by_code[fault.code].append(fault)
    parts = [_FRONT]
    for code, places in sorted(by_code.items()):
        rooms = ", ".join(sorted({f"`{fault.room}`" for fault in places}))
        parts.append(f"({code})=\n## {code}\n\nRaised in {rooms}.\n")
        rows = dict.fromkeys((fault.found, fault.expected, fault.mend) for fault in places if fault.found)
        for found, expected, mend in list(rows)[:_MESSAGES]:
            message = f"{found}, expected {expected}" if expected else found
            parts.append(f"* Found: {_escaped(message)}" + (f"\n  Mend: {_escaped(mend)}" if mend else ""))
        if len(rows) > _MESSAGES:
            parts.append(f"* and {len(rows) - _MESSAGES} more messages")
        parts.append("")
    return "\n".join(parts)


def _escaped(text: str) -> str:
    """Return a message as literal text on one line."""
    flat = re.sub(r"\s+", " ", text).strip().replace("`", "'")
    return f"``{flat}``"


if __name__ == "__main__":
    print(codes_page())
