"""The page of a report: its frame and its style, without anything from outside."""

from __future__ import annotations

from collections.abc import Sequence

from .markup import Markup, element, joined, text, void

__all__ = ["page"]

# what a browser may load for the page: nothing but the pictures and the style inside it
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"

_STYLE = """
:root { color-scheme: light dark; --page: #fbfbf9; --ink: #1d2126; --soft: #5c6570; --rule: #d9dcd8;
  --card: #ffffff; --bar: #b5543c; --wrong: #fdecea; --wrong-rule: #c0392b; }
@media (prefers-color-scheme: dark) {
  :root { --page: #15181c; --ink: #e6e8ea; --soft: #9aa4ae; --rule: #32383f; --card: #1d2227;
    --bar: #d9805f; --wrong: #3a1f1c; --wrong-rule: #e0705f; }
  figure img { filter: brightness(.9); } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 68rem; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 3rem 0 .75rem; padding-top: 1rem; border-top: 2px solid var(--rule);
  overflow-wrap: anywhere; }
h3 { font-size: 1rem; margin: 1.75rem 0 .5rem; }
nav { margin: 1rem 0; } nav a { margin-right: 1rem; }
a { color: inherit; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
th, td { text-align: left; vertical-align: top; padding: .2rem .75rem .2rem 0; overflow-wrap: anywhere;
  white-space: pre-line; border-bottom: 1px solid var(--rule); }
th[scope=row] { width: 12rem; font-weight: 600; color: var(--soft); }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
figure { margin: .5rem 0 1rem; } figure img { display: block; max-width: 100%; height: auto;
  border: 1px solid var(--rule); border-radius: 6px; background: #fff; }
img.pixels { width: 100%; image-rendering: pixelated; }
figcaption, .note { color: var(--soft); font-size: .85rem; }
.bar { display: inline-block; height: .7em; background: var(--bar); min-width: 1px; }
.swatch { display: inline-block; width: 2.2em; height: 1.1em; border: 1px solid var(--rule);
  border-radius: 3px; vertical-align: -.15em; }
.problem { background: var(--wrong); border-left: 4px solid var(--wrong-rule); padding: .6rem .9rem;
  margin: 1rem 0; white-space: pre-line; overflow-wrap: anywhere; }
details { margin: 1rem 0; } summary { cursor: pointer; font-weight: 600; }
@media print { body { background: #fff; color: #000; } h2 { break-before: page; } }
"""


def page(title: str, head: Markup, sections: Sequence[tuple[str, Markup]]) -> Markup:
    """Return a whole page.

    Parameters
    ----------
    title
        Of the page.
    head
        What stands above the sections.
    sections
        Heading and content of each, in order.
    """
    contents = joined(
        element("a", name, href=f"#section-{number}") for number, (name, _) in enumerate(sections)
    )
    body = joined(
        element("section", element("h2", name), content, id=f"section-{number}")
        for number, (name, content) in enumerate(sections)
    )
    meta = joined(
        [
            void("meta", charset="utf-8"),
            void("meta", http_equiv="Content-Security-Policy", content=_POLICY),
            void("meta", name="viewport", content="width=device-width, initial-scale=1"),
            void("meta", name="color-scheme", content="light dark"),
            void("meta", name="referrer", content="no-referrer"),
            element("title", f"{title} - hyperpaint report"),
            Markup(f"<style>{_STYLE}</style>"),
        ]
    )
    main = element("main", element("h1", title), head, element("nav", contents), body)
    return Markup(f'<!DOCTYPE html>\n<html lang="en"><head>{meta}</head><body>{text(main)}</body></html>\n')
