"""Agreement of paint signatures with what field spectrometers, or other libraries, say of the same paints."""

from .validating import validate
from .validation_result import Validation

__all__ = ["Validation", "validate"]
