"""HTML from texts of a store: jinja2 escapes every text, and the page loads nothing from elsewhere."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from markupsafe import Markup

Part: TypeAlias = "tuple[str, Callable[[], Markup]]"  # name of a part, and the function that draws it

MAX_TEXT_CHARS = 2000

_LAYOUT = frozenset("\n\t")
# characters that change the writing direction of the text around them
_BIDIRECTIONAL = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f\u061c")


def page_part(name: str, **content: object) -> Markup:
    """Return a part of a page, made by a macro of ``page.html.j2`` from cleaned and escaped texts.

    Examples
    --------
    >>> print(page_part("paragraph", text="1 < 2"))
    <p class="note">1 &lt; 2</p>
    """
    part: Markup = getattr(_macros(), name)(**content)
    return part


@functools.cache
def _macros() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("hyperpaint", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=plain_text,
    )
    return environment.get_template("page.html.j2").module


def plain_text(value: object) -> object:
    """Return a text without control characters, cut to `MAX_TEXT_CHARS`; finished markup stays unchanged.

    Examples
    --------
    >>> plain_text("one" + chr(7))
    'one\ufffd'
    """
    if hasattr(value, "__html__"):
        return value
    text = str(value)
    printable = "".join(
        char if char in _LAYOUT or (char.isprintable() and char not in _BIDIRECTIONAL) else "\ufffd"
        for char in text[:MAX_TEXT_CHARS]
    )
    return printable + ("..." if len(text) > MAX_TEXT_CHARS else "")
