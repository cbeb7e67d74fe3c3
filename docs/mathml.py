"""Equations as MathML, which browsers draw themselves: the site needs no script and no network for them.

Sphinx's own renderers load MathJax from a server or call LaTeX. What latex2mathml does not know is a warning,
and so an error where the site is built as CI builds it.
"""

from __future__ import annotations

import re
from typing import Any, NoReturn

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number, wrap_displaymath

_LOG = logging.getLogger(__name__)
#: Functions are set like letters, without the thin space that TeX has beside them.
_FUNCTION = re.compile(r"<mi>(cos|sin|tan|arccos|arctan|exp|ln)</mi>(?=(<mo[^>]*>&#x00028;)?)")

#: A bar as wide as what is below it, in place of a dash of one width.
_BAR = '<mo accent="true">&#x02015;</mo>', '<mo accent="true" stretchy="true">&#x000AF;</mo>'


def _mathml(latex: str, node: nodes.Element, display: str) -> str:
    try:
        text = str(convert(latex, display=display))
    except Exception as error:  # of any kind: it has no class of its own
        text = f"\\ {error!r}"
    text = _FUNCTION.sub(_spaced, text).replace(*_BAR)
    if "\\" in text:
        _LOG.warning("no MathML of %r: %s", latex, text, location=node)
    return text


def _spaced(name: re.Match[str]) -> str:
    right = "0" if name[2] else "0.17em"
    return f'<mo lspace="0.17em" rspace="{right}">{name[1]}</mo>'


def _inline(translator: Any, node: nodes.Element) -> NoReturn:
    translator.body.append(_mathml(node.astext(), node, "inline"))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.Element) -> NoReturn:
    latex = node.astext()
    if "\\\\" in latex or "&" in latex:
        latex = wrap_displaymath(latex, None, False)
    translator.body.append(translator.starttag(node, "div", CLASS="math notranslate nohighlight"))
    if node["number"]:
        number = get_node_equation_number(translator, node)
        translator.body.append(f'<span class="eqno">({number})</span>')
    translator.body.append(_mathml(latex, node, "block") + "</div>\n")
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Offer the renderer `html_math_renderer = "mathml"`."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
