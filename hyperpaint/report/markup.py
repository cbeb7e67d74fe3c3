"""HTML out of texts that nobody vouches for: every text is escaped, nothing outside of the page is named."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence

__all__ = ["Markup", "element", "joined", "table_of_facts", "text", "void"]

LONGEST_TEXT = 2000
"""Characters of one text; what is longer is cut."""

_KEPT = frozenset("\n\t")
#: They would turn the direction of what stands around them.
_TURNING = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f\u061c")


class Markup(str):
    """HTML that is ready; any other text is escaped before it becomes part of it."""

    __slots__ = ()


def text(value: object, longest: int = LONGEST_TEXT) -> Markup:
    """Return a text for a page: escaped, without control signs, cut where it is too long.

    Examples
    --------
    >>> print(text('<b onclick="x">'))
    &lt;b onclick=&quot;x&quot;&gt;
    """
    if isinstance(value, Markup):
        return value
    told = str(value)
    cut = len(told) > longest
    told = "".join(sign if _is_safe(sign) else "\ufffd" for sign in told[:longest])
    return Markup(html.escape(told + ("..." if cut else ""), quote=True))


def _is_safe(sign: str) -> bool:
    return sign in _KEPT or (sign.isprintable() and sign not in _TURNING)


def element(tag: str, *content: object, **attributes: object) -> Markup:
    """Return an element; content and values of attributes are escaped, names of both are the program's.

    Examples
    --------
    >>> print(element("p", "1 < 2", class_="note"))
    <p class="note">1 &lt; 2</p>
    """
    return Markup(f"{void(tag, **attributes)}{''.join(map(text, content))}</{tag}>")


def void(tag: str, **attributes: object) -> Markup:
    """Return an element without content, or the opening of one."""
    # a picture inside the page is as long as it is
    given = (
        f' {name.rstrip("_").replace("_", "-")}="{text(value, longest=2**31)}"'
        for name, value in attributes.items()
    )
    return Markup(f"<{tag}{''.join(given)}>")


def joined(parts: Iterable[object]) -> Markup:
    """Return parts one after the other."""
    return Markup("".join(map(text, parts)))


def table_of_facts(
    facts: Mapping[str, object] | Sequence[tuple[str, object]], **attributes: object
) -> Markup:
    """Return names and texts as a table of two columns; facts without a text are left out."""
    pairs = facts.items() if isinstance(facts, Mapping) else facts
    rows = (
        element("tr", element("th", name, scope="row"), element("td", told))
        for name, told in pairs
        if str(told)
    )
    return element("table", joined(rows), **attributes)
