"""Text cells of tables, protected from being run as formulas by spreadsheets."""

from __future__ import annotations

import re

from .reading import number

#: Includes full-width signs, which spreadsheets treat like ASCII ones, and leading blanks, which they skip.
_FORMULA = re.compile("'*(?:[\\t\\r]|\\s*[=+\\-@\uff1d\uff0b\uff0d\uff20])")


def safe_cell(text: str) -> str:
    """Return a text for a table, with an apostrophe before formulas; numbers are unchanged.

    Examples
    --------
    >>> safe_cell("=cmd()"), safe_cell("-5.2"), safe_cell("- matt"), safe_cell("red")
    ("'=cmd()", '-5.2', "'- matt", 'red')
    """
    return text if (_FORMULA.match(text) is None or number(text) is not None) else f"'{text}"


def text_of_cell(cell: str) -> str:
    """Return the original text of a cell made by `safe_cell`.

    Examples
    --------
    >>> text_of_cell("'=cmd()"), text_of_cell("'red'"), text_of_cell(safe_cell("'=cmd()"))
    ('=cmd()', "'red'", "'=cmd()")
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
