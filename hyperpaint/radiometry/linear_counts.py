"""Linearity of the detector: a polynomial or a table from raw counts to counts proportional to light.

Declared for dark-subtracted counts, c = L(C - D), or for raw counts, c = L(C) - L(D), depending on whether
amplifier and converter, which process light and dark, are nonlinear, or the detector wells.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import one_of
from hyperpaint.base.schema import Floats, require
from hyperpaint.kernels.arguments import DetectorModel

DARK_SUBTRACTED, RAW = "dark-subtracted", "raw"
TABLE = ("linearity_counts", "linear_counts")
#: Number of terms of a polynomial in the kernel; longer polynomials become tables.
MAX_KERNEL_TERMS = 4
#: Nodes of a table: every eighth count of 16 bits, so that interpolation of a curve with 5 % at full scale is
#: accurate to 1e-5 counts.
TABLE_NODES = 8192
#: Range of a table below 0, as a share of the highest count [1], which covers dark noise.
BELOW_DARK_SHARE = 1.0 / 16.0
_NO_MASKED_ELEMENTS = np.empty((0, 2), np.int64)
#: End of the curve [count] if the calibration has no saturation count.
DEFAULT_HIGHEST_COUNT = 65535.0


@dataclass(frozen=True)
class Linearity:
    # Curve from counts to counts proportional to light; see `linearity_of`.
    coefficients: tuple[float, ...] = ()  #: a2, a3 ... of c + a2 c^2 + a3 c^3 + ...; none with a table
    #: measured, linear (node,) [count]: the table, linear between nodes and beyond them; None without a table
    measured: Floats | None = None
    linear: Floats | None = None
    on_raw: bool = False  #: Whether the curve applies to raw counts, which include the dark

    def __bool__(self) -> bool:
        return bool(self.coefficients) or self.measured is not None

    def described(self, as_table: bool) -> str:
        # Return a description for an attribute; ``as_table``: the curve is a table that is not read yet.
        form = "table" if as_table else f"polynomial of degree {len(self.coefficients) + 1}"
        return f"{form} on {RAW if self.on_raw else DARK_SUBTRACTED} counts"

    def correction(self, counts: Any) -> Any:
        # Return the counts to add to counts of any shape to make them proportional to light [count].
        if self.measured is not None and self.linear is not None:
            nodes, corrections = self.measured, self.linear - self.measured
            lower = np.clip(np.searchsorted(nodes, counts) - 1, 0, nodes.size - 2)
            return corrections[lower] + (np.diff(corrections) / np.diff(nodes))[lower] * (
                counts - nodes[lower]
            )
        relative = 0.0
        for coefficient in reversed(self.coefficients):
            relative = (relative + coefficient) * counts
        return counts * relative

    def net(self, raw: Any, dark: Any) -> Any:
        # Return counts above dark, proportional to light; without a curve their difference, bit for bit.
        if not self:
            return raw - dark
        if self.on_raw:
            return (raw + self.correction(raw)) - (dark + self.correction(dark))
        net = raw - dark
        return net + self.correction(net)

    def detector_model(self, highest_count: float) -> DetectorModel:
        # Return the curve for the kernel: a short polynomial unchanged, any other curve as a fine table.
        polynomial = table = np.empty(0, np.float32)
        first, per_count = 0.0, 1.0
        if 0 < len(self.coefficients) <= MAX_KERNEL_TERMS:
            polynomial = np.zeros(MAX_KERNEL_TERMS, np.float32)
            polynomial[: len(self.coefficients)] = self.coefficients
        elif self:
            end = highest_count if np.isfinite(highest_count) else DEFAULT_HIGHEST_COUNT
            first = -BELOW_DARK_SHARE * end
            table = np.asarray(self.correction(np.linspace(first, end, TABLE_NODES)), np.float32)
            per_count = (TABLE_NODES - 1) / (end - first)
        on_raw = np.bool_(bool(self) and self.on_raw)
        return DetectorModel(
            polynomial, table, np.float32(first), np.float32(per_count), _NO_MASKED_ELEMENTS, on_raw
        )

    def check(self, problems: Problems, highest_count: float) -> None:
        # Add problems of a curve that is not finite, or does not increase up to the highest count.
        if not self:
            return
        if self.measured is not None and self.linear is not None:
            is_finite = np.isfinite(self.measured).all() and np.isfinite(self.linear).all()
            if self.measured.size < 2 or not is_finite or (np.diff(self.measured) <= 0).any():
                problems.add(
                    f"the table of linearity has {self.measured.size} counts from {self.measured[:1]} to "
                    f"{self.measured[-1:]}",
                    expected="two or more finite counts that increase",
                    code="linearity-invalid",
                )
                return
        end = highest_count if np.isfinite(highest_count) else DEFAULT_HIGHEST_COUNT
        counts = np.linspace(0.0, end, 1025)
        linear = counts + self.correction(counts)
        problems.add_if(
            not np.isfinite(linear).all() or (np.diff(linear) <= 0).any(),
            f"linearity is not monotonic below {end:g} counts",
            expected="linear counts that rise with the counts",
            mend="fit it over the whole range, or with a lower degree",
            code="linearity-not-monotonic",
        )


def linearity_of(dataset: xr.Dataset) -> Linearity:
    # Return the curve that a calibration or a line declares.
    #
    # Attribute ``linearity``: coefficients of `hyperpaint.calibration.linearity`, or "identity"; the variable
    # ``linear_counts`` over ``linearity_counts`` in their place is a table. Attribute ``linearity_on``:
    # "dark-subtracted", the default, or "raw".
    #
    # Raises `SchemaError`: The attribute or the table is invalid.
    declared = declared_linearity(dataset.attrs)
    if "linear_counts" not in dataset.variables:
        return declared
    arrays = require(dataset, TABLE, "linearity")
    measured, linear = (arrays[name].to_numpy().astype(np.float64) for name in TABLE)
    return Linearity((), measured, linear, declared.on_raw)


def declared_linearity(attrs: Mapping[Any, Any]) -> Linearity:
    # Return the curve that attributes alone declare; see `linearity_of`.
    kind = attrs.get("linearity_on", DARK_SUBTRACTED)
    one_of(kind, (DARK_SUBTRACTED, RAW), "attribute linearity_on")
    declared = attrs.get("linearity", ())
    coefficients = () if isinstance(declared, str) else np.atleast_1d(np.asarray(declared, np.float64))
    numbers = tuple(float(value) for value in coefficients)
    SchemaError.raise_if(
        not np.isfinite(numbers).all(),
        f"linearity {numbers}",
        expected="finite coefficients a2, a3 ...",
        code="linearity-invalid",
    )
    return Linearity(numbers if any(numbers) else (), on_raw=kind == RAW)
