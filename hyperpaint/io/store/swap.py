"""Two folders change places in one step, where the system has such a step."""

from __future__ import annotations

import ctypes
import errno
import functools
import os
import sys
from pathlib import Path
from typing import Any

__all__ = ["exchange"]

_HERE = -100  # AT_FDCWD
_EXCHANGE = 2  # RENAME_EXCHANGE
#: What kernels, sandboxes and file systems that do not know it answer.
_UNKNOWN = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM)


def exchange(one: Path, other: Path) -> bool:
    """Let two paths change places, both of which must be there.

    Returns
    -------
    bool
        False where system or file system cannot: nothing is done then. Linux can, on most local disks.

    Raises
    ------
    OSError
        A path is missing, or may not be changed.
    """
    rename = _renameat2()
    if rename is None:
        return False
    # as `os.rename` does: this is one
    sys.audit("os.rename", os.fspath(one), os.fspath(other), -1, -1)
    if rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNKNOWN:
        return False
    raise OSError(code, os.strerror(code), os.fspath(one), None, os.fspath(other))


@functools.cache
def _renameat2() -> Any:
    """Return the C library's function, None where there is none."""
    if sys.platform != "linux":
        return None
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return None
    function.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    function.restype = ctypes.c_int
    return function
