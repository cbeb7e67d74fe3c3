"""Values gathered by their keys, and lists of names for messages."""

from collections.abc import Iterable, Sequence
from typing import TypeVar

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


def grouped(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    """Return the values of every key, keys and values in the order of the pairs.

    Examples
    --------
    >>> grouped([("red", 1), ("blue", 2), ("red", 3)])
    {'red': [1, 3], 'blue': [2]}
    """
    groups: dict[_Key, list[_Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def listed(names: Sequence[str], max_names: int = 20) -> str:
    # Return the names as text, shortened to the first ``max_names``.
    remainder = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + remainder
