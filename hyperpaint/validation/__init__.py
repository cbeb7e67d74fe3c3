"""Agreement of paint signatures with what field spectrometers, or other libraries, say of the same paints."""

from .result import Validation
from .validating import validate

__all__ = ["Validation", "validate"]
