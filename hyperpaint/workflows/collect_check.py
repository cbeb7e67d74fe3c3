"""`check_collect` at its path of version 0.2, which scripts import."""

from .collects import check_collect as check_collect
