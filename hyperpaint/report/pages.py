"""HTML of texts from anywhere: jinja2 escapes every text, nothing outside the page is named."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from markupsafe import Markup

Part: TypeAlias = "tuple[str, Callable[[], Markup]]"
"""What a part shows, and what draws it."""

LONGEST_TEXT = 2000
"""Characters of one text; what is longer is cut."""

_LAYOUT = frozenset("\n\t")
#: They would turn the direction of what stands around them.
_TURNING = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f\u061c")


def page_part(name: str, **content: object) -> Markup:
    """Return a part of a page, a macro of ``page.html.j2``; texts are cleaned and escaped.

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
    """Return a text without control signs, cut where it is too long; markup that is ready stays as it is.

    Examples
    --------
    >>> plain_text("one" + chr(7))
    'one\ufffd'
    """
    if hasattr(value, "__html__"):
        return value
    text = str(value)
    shown = "".join(sign if _is_safe(sign) else "\ufffd" for sign in text[:LONGEST_TEXT])
    return shown + ("..." if len(text) > LONGEST_TEXT else "")


def _is_safe(sign: str) -> bool:
    return sign in _LAYOUT or (sign.isprintable() and sign not in _TURNING)
