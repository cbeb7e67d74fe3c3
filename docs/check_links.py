"""Check every link of the built site, without the network: ``python docs/check_links.py docs/_build``.

A link inside the site must lead to a file, and to an anchor that the file has; an address outside of it must
be https and well formed, and a DOI look like one. Whether other servers answer is for Sphinx's linkcheck.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_HOST = re.compile(r"([a-z0-9-]+\.)+[a-z]{2,}$")
_DOI = re.compile(r"/10\.\d{4,9}/\S+$")


class Page(HTMLParser):
    """Anchors of a page, and where its links lead."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = {"", "top"}
        self.links: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, _tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value for name, value in attrs if value}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.links += [values[name] for name in ("href", "src") if name in values]


def fault_outside(link: str) -> str:
    """Return what is wrong with an address of another site; nothing where all is well."""
    parts = urlsplit(link)
    if parts.scheme != "https" or not _HOST.match(parts.hostname or "") or re.search(r"\s", link):
        return "no well-formed https address"
    if parts.hostname == "doi.org" and not _DOI.match(parts.path):
        return "no DOI"
    return ""


def faults(site: Path) -> tuple[int, list[str]]:
    """Return how many links the site has, and those that lead nowhere, each with its page."""
    pages = {
        path.resolve(): Page(path) for path in sorted(site.rglob("*.html")) if "_static" not in path.parts
    }
    wrong = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in ("data", "javascript", "mailto"):
                continue
            if parts.scheme or parts.netloc:
                fault = fault_outside(link)
            else:
                target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
                anchors = pages[target].anchors if target in pages else {""}
                exists = target.is_file() and (target not in pages or unquote(parts.fragment) in anchors)
                fault = "" if exists else "no such anchor" if target.is_file() else "no such file"
            if fault:
                wrong.append(f"{path.relative_to(site.resolve())}: {link}: {fault}")
    return sum(len(page.links) for page in pages.values()), wrong


if __name__ == "__main__":
    count, wrong = faults(Path(sys.argv[1]))
    print("\n".join([*sorted(set(wrong)), f"{count} links, {len(wrong)} of them wrong"]))
    raise SystemExit(bool(wrong) or not count)
