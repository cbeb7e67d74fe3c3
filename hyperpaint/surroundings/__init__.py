"""What is known of a scene after one look at all of it; flags are then a matter of single pixels."""

from __future__ import annotations

from .model import SceneModel
from .surveying import survey

__all__ = ["SceneModel", "survey"]
