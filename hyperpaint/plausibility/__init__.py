"""Check whether the inputs of a flight line can be true, before anything is processed.

Opened lines and their files come in, `Finding`s go out: a name, found, expected, and mend. Called by
`workflows`, which refuses or warns.
"""

from .judging import KINDS, Finding, Kind, judge_dark_cube, judge_line

__all__ = ["KINDS", "Finding", "Kind", "judge_dark_cube", "judge_line"]
