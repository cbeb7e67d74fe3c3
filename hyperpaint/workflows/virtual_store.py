"""`virtualise` at its path of version 0.2, which scripts import."""

from .pipeline import virtualise as virtualise
