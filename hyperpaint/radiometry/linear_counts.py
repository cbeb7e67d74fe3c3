"""Counts that are proportional to light, from counts as they are read: a polynomial or a table.

Declared for dark-subtracted counts, c = L(C - D), or for raw ones, c = L(C) - L(D): which of the two a
detector needs depends on whether amplifier and converter bend the sum, or the wells bend the light alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import require
from hyperpaint.kernels.arguments import DetectorModel

DARK_SUBTRACTED, RAW = "dark-subtracted", "raw"
TABLE = ("linearity_counts", "linear_counts")
#: Terms of a polynomial that the kernel computes [1]; more of them take the way of a table.
_TERMS = 4
#: Places at which the kernel knows a curve [1]: every eighth count of 16 bits, so that between them a bend of
#: 5 % at full scale is straight to 1e-5 counts.
_NODES = 8192
#: Share of the highest count by which the curve is known below 0 [1]: as far as dark noise reaches.
_BELOW_DARK = 1.0 / 16.0
_NONE_MASKED = np.empty((0, 2), np.int64)
#: End of the curve [count] where the calibration does not say at which count the converter is full.
_HIGHEST_COUNT = 65535.0


@dataclass(frozen=True)
class Linearity:
    """A curve from counts to ones proportional to light; see `linearity_of`."""

    coefficients: tuple[float, ...] = ()  #: a2, a3 ... of c + a2 c^2 + a3 c^3 + ...; none with a table
    #: measured, linear (node,) [count]: the table, straight between nodes and beyond them; None without
    measured: Floats | None = None
    linear: Floats | None = None
    on_raw: bool = False  #: Whether it holds for raw counts, dark included

    def __bool__(self) -> bool:
        return bool(self.coefficients) or self.measured is not None

    def described(self, as_table: bool) -> str:
        """Return what it is, as an attribute says it; ``as_table``: of a table that is not read yet."""
        what = "table" if as_table else f"polynomial of degree {len(self.coefficients) + 1}"
        return f"{what} on {RAW if self.on_raw else DARK_SUBTRACTED} counts"

    def correction(self, counts: Any) -> Any:
        """Return what is to be added to counts of any shape to have them proportional to light [count]."""
        if self.measured is not None and self.linear is not None:
            node, beyond = self.measured, self.linear - self.measured
            place = np.clip(np.searchsorted(node, counts) - 1, 0, node.size - 2)
            rise = np.diff(beyond) / np.diff(node)
            return beyond[place] + rise[place] * (counts - node[place])
        relative = 0.0
        for coefficient in reversed(self.coefficients):
            relative = (relative + coefficient) * counts
        return counts * relative

    def net(self, raw: Any, dark: Any) -> Any:
        """Return counts above dark, proportional to light; without a curve their difference, bit for bit."""
        if not self:
            return raw - dark
        if self.on_raw:
            return (raw + self.correction(raw)) - (dark + self.correction(dark))
        above = raw - dark
        return above + self.correction(above)

    def as_kernel_takes_it(self, highest_count: float) -> DetectorModel:
        """Return the curve as the kernel takes it: a short polynomial as it is, all else as a fine table."""
        none = np.empty(0, np.float32)
        if not self:
            return DetectorModel(none, none, np.float32(0.0), np.float32(1.0), _NONE_MASKED, np.bool_(False))
        if 0 < len(self.coefficients) <= _TERMS:
            short = np.zeros(_TERMS, np.float32)
            short[: len(self.coefficients)] = self.coefficients
            return DetectorModel(
                short, none, np.float32(0.0), np.float32(1.0), _NONE_MASKED, np.bool_(self.on_raw)
            )
        end = highest_count if np.isfinite(highest_count) else _HIGHEST_COUNT
        first = -_BELOW_DARK * end
        table = np.asarray(self.correction(np.linspace(first, end, _NODES)), np.float32)
        per_count = np.float32((_NODES - 1) / (end - first))
        return DetectorModel(none, table, np.float32(first), per_count, _NONE_MASKED, np.bool_(self.on_raw))

    def check(self, problems: Problems, highest_count: float) -> None:
        """Note a curve that is not finite, or does not rise with the light up to the highest count."""
        if not self:
            return
        if self.measured is not None and self.linear is not None:
            both = np.isfinite(self.measured).all() and np.isfinite(self.linear).all()
            if self.measured.size < 2 or not both or (np.diff(self.measured) <= 0).any():
                problems.add(
                    "the table of linearity needs two or more finite counts that increase, found "
                    f"{self.measured.size} from {self.measured[:1]} to {self.measured[-1:]}",
                    code="linearity-invalid",
                )
                return
        end = highest_count if np.isfinite(highest_count) else _HIGHEST_COUNT
        counts = np.linspace(0.0, end, 1025)
        linear = counts + self.correction(counts)
        if not np.isfinite(linear).all() or (np.diff(linear) <= 0).any():
            problems.add(
                f"linearity turns back below {end:g} counts",
                expected=(
                    "linear counts that rise with the counts: fit it over the whole range, or with a "
                    "lower degree"
                ),
                code="linearity-turning",
            )


def linearity_of(dataset: xr.Dataset) -> Linearity:
    """Return the curve that a calibration or a line declares.

    Attribute ``linearity``: coefficients of `hyperpaint.calibration.linearity`, or "identity"; the variable
    ``linear_counts`` over ``linearity_counts`` in their place is a table. Attribute ``linearity_on``:
    "dark-subtracted", the default, or "raw".

    Raises
    ------
    SchemaError
        The attribute or the table is none.
    """
    declared = declared_linearity(dataset.attrs)
    if "linear_counts" not in dataset.variables:
        return declared
    arrays = require(dataset, TABLE, "linearity")
    measured, linear = (arrays[name].to_numpy().astype(np.float64) for name in TABLE)
    return Linearity((), measured, linear, declared.on_raw)


def declared_linearity(attrs: Mapping[Any, Any]) -> Linearity:
    """Return the curve that attributes alone declare; see `linearity_of`."""
    kind = attrs.get("linearity_on", DARK_SUBTRACTED)
    if kind not in (DARK_SUBTRACTED, RAW):
        raise SchemaError(
            f"attribute linearity_on is {kind!r}",
            expected=f"{DARK_SUBTRACTED!r} or {RAW!r}",
            code="choice-unknown",
        )
    stated = attrs.get("linearity", ())
    coefficients = () if isinstance(stated, str) else polynomial(stated)
    return Linearity(coefficients, on_raw=kind == RAW)


def polynomial(coefficients: Sequence[float] | Any) -> tuple[float, ...]:
    """Return coefficients as a tuple of numbers; all of them zero are the identity."""
    numbers = tuple(float(value) for value in np.atleast_1d(np.asarray(coefficients, np.float64)))
    if not np.isfinite(numbers).all():
        raise SchemaError(
            f"linearity {numbers} must be finite coefficients a2, a3 ...", code="linearity-invalid"
        )
    return numbers if any(numbers) else ()
