"""Can the inputs of a flight line be true? Judged before anything is processed, by the inputs themselves.

Opened lines and their files come in, `Finding`s go out: a name, what was found, what was expected, how to
mend it. Called by `workflows`, which refuses or warns.
"""

from .finding import KINDS, Finding, Kind
from .line_judging import judge_dark_cube, judge_line

__all__ = ["KINDS", "Finding", "Kind", "judge_dark_cube", "judge_line"]
