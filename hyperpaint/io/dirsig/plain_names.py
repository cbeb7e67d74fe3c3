"""What paints are called in DIRSIG: tokens without blanks, and names in plain ASCII."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable

__all__ = ["material_ids", "material_names", "plain_name"]

_LONGEST_ID, _LONGEST_NAME = 48, 120
_LETTERS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss", "æ": "ae", "Æ": "Ae",
     "ø": "oe", "Ø": "Oe", "å": "aa", "Å": "Aa", "œ": "oe", "Œ": "Oe", "ł": "l", "Ł": "L", "µ": "u",
     "\u2013": "-", "\u2014": "-", "\u2019": "'"}
)  # fmt: skip
"""What is written otherwise in ASCII, an umlaut with two letters; other accents are dropped."""
_UNSAFE = re.compile(r"[^ -~]|[{}=\"#<>&;]")
_NO_TOKEN = re.compile(r"[^A-Za-z0-9]+")
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
"""Names of devices, which are no files on Windows."""


def plain_name(name: str) -> str:
    """Return a name in ASCII without what the tag format gives a meaning.

    Umlauts become two letters, other accents are dropped, and what is left becomes an underscore.

    Examples
    --------
    >>> plain_name("Brillantsilber métallisé, 775/9775 {Türkis}")
    'Brillantsilber metallise, 775/9775 _Tuerkis_'
    """
    # one spelling for letters with accents, whichever way they were typed
    text = unicodedata.normalize("NFC", name).translate(_LETTERS)
    text = "".join(sign for sign in unicodedata.normalize("NFKD", text) if not unicodedata.combining(sign))
    return " ".join(_UNSAFE.sub("_", " ".join(text.split())).split())[:_LONGEST_NAME].strip()


def material_names(names: Iterable[str], taken: Collection[str] = ()) -> list[str]:
    """Return a plain name for every name, no two alike.

    Examples
    --------
    >>> material_names(["red", "red", "赤"], taken=["red"])
    ['red (2)', 'red (3)', 'paint 3']
    """
    plain = [plain_name(name) for name in names]
    usable = [text if text.strip("_ ") else f"paint {number}" for number, text in enumerate(plain, start=1)]
    return _unique(usable, taken, " ({})")


def material_ids(names: Iterable[str], taken: Collection[str] = ()) -> list[str]:
    """Return a token for every name, no two alike on any file system: it also names the paint's files.

    Examples
    --------
    >>> material_ids(["Rouge / Grün", "rouge grün", "1", "", "con"])
    ['Rouge_Gruen', 'rouge_gruen_2', 'paint_1', 'paint_4', 'paint_con']
    """
    tokens = []
    for number, name in enumerate(names, start=1):
        token = _NO_TOKEN.sub("_", plain_name(name)).strip("_")[:_LONGEST_ID].strip("_")
        if token.isdigit() or token.lower() in _DEVICES:
            # a scene's own materials are often numbered
            token = f"paint_{token}"
        tokens.append(token or f"paint_{number}")
    return _unique(tokens, taken, "_{}")


def _unique(texts: list[str], taken: Collection[str], suffix: str) -> list[str]:
    """Return the texts, with a number where one is there already in upper or lower case."""
    used = {text.casefold() for text in taken}
    count: dict[str, int] = {}
    unique = []
    for text in texts:
        key, given = text.casefold(), text
        while given.casefold() in used:
            count[key] = count.get(key, 1) + 1
            given = text + suffix.format(count[key])
        used.add(given.casefold())
        unique.append(given)
    return unique
