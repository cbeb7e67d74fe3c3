"""Arguments of the slab kernel from a plain mapping, and its rounding on whole arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.kernels.arguments import Calibration, CountLimits, FixedFlags, LightCells
from hyperpaint.kernels.radiometry import round_row


def grouped(p: dict[str, Any]) -> tuple[Any, ...]:
    """Return the counts and what belongs to them, as the kernel takes them."""
    return (
        p["counts"],
        Calibration(p["dark"], p["dark_index"], p["dark_weight"], p["gain"]),
        LightCells(p["light"], p["shift"], p["edges"], p["cells"]),
        CountLimits(p["limit"], p["noise_margin"], p["most_negative"], p["whole"]),
        FixedFlags(p["line_flags"], p["column_flags"], p["no_data"]),
    )


def round_values(values: np.ndarray, cleared_bits: int) -> None:
    """Round in place."""
    round_row(values.view(np.uint32).ravel(), np.uint32(cleared_bits))
