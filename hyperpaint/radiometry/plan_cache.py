"""Plans of the lines that were looked at last, in this process: the next click reads counts and nothing else.

A plan is looked up by what it is made of: the line's small variables, its attributes and the options. A
variable in memory counts by its values, which are compared with a copy; one that is read when it is computed
counts by identity, since the names that dask gives stay the same when a store is written anew. So nothing
that was replaced is ever taken for what it was, and no cube is held.
"""

from __future__ import annotations

import dataclasses
import threading
import uuid
import weakref
from collections.abc import Callable
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask.delayed import Delayed

from hyperpaint.base.arrays import Array
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK

from .slabs import Plan

MOST_PLANS = 8
#: Of all plans and the copies that they are looked up by.
MOST_BYTES = 64 * 2**20

#: Of a plan that stands in a graph itself; larger ones are made by its tasks, from less.
MOST_EMBEDDED_BYTES = 8 * 2**20

MOST_PENDING = 16


class _State:
    """A variable as it was."""

    def __init__(self, variable: xr.Variable) -> None:
        self.form = _form(variable)
        self.attrs = dict(variable.attrs)
        self.values = None if _is_lazy(variable) else np.array(variable.values)
        data = variable._data
        # values are assigned to a part of a dask array in place, and rename it
        self.name = getattr(data, "name", None)
        try:
            self.source: Callable[[], Any] = weakref.ref(data)
        except TypeError:  # of xarray, around a file
            self.source = lambda: data

    def holds(self, variable: xr.Variable) -> bool:
        if self.form != _form(variable) or not xr.core.utils.dict_equiv(self.attrs, variable.attrs):
            return False
        if self.values is None:
            data = variable._data
            is_same = self.source() is data and self.name == getattr(data, "name", None)
            return is_same and _is_lazy(variable)
        return not _is_lazy(variable) and _same_values(self.values, np.asarray(variable.values))

    @property
    def nbytes(self) -> int:
        return 0 if self.values is None else self.values.nbytes


def _form(variable: xr.Variable) -> tuple[Any, ...]:
    return variable.dims, variable.shape, variable.dtype


def _is_lazy(variable: xr.Variable) -> bool:
    """Tell whether values are read when they are computed, and were not assigned to since."""
    data = variable._data
    is_read = isinstance(data, da.Array) or not variable._in_memory
    return is_read and not getattr(data, "_copied", False)


def _same_values(one: Array, other: Array) -> bool:
    if one.dtype == object:
        return bool(np.array_equal(one, other))
    # NaN is like itself, and the sign of zero counts
    first, second = (np.ascontiguousarray(each).reshape(-1).view(np.uint8) for each in (one, other))
    return bool(np.array_equal(first, second))


class Origin:
    """What a plan is made of.

    ``line``: with the dims' names by role; ``options``: compared with ``==``.
    """

    def __init__(self, line: xr.Dataset, options: tuple[Any, ...]) -> None:
        self._states = {name: _State(variable) for name, variable in _small(line).items()}
        self._attrs = dict(line.attrs)
        self._options = (*options, "counts" in line.variables)
        self.nbytes = sum(state.nbytes for state in self._states.values())

    def is_of(self, line: xr.Dataset, options: tuple[Any, ...]) -> bool:
        """Tell whether a plan of this origin is that of a line."""
        small = _small(line)
        return (
            self._options == (*options, "counts" in line.variables)
            and self._states.keys() == small.keys()
            and all(state.holds(small[name]) for name, state in self._states.items())
            and bool(xr.core.utils.dict_equiv(self._attrs, line.attrs))
        )


def _small(line: xr.Dataset) -> dict[Any, xr.Variable]:
    """Return all variables but those of pixels, and those of lines and bands."""
    return {
        name: variable
        for name, variable in line.variables.items()
        if ALONG_TRACK not in variable.dims or not {BAND, CROSS_TRACK} & set(variable.dims)
    }


@dataclasses.dataclass(eq=False)
class Entry:
    """A plan, what it is made of, and what else of the line was read for those who look at it."""

    origin: Origin
    plan: Plan
    #: Small coordinates, and as attributes those of its reflectance
    labels: xr.Dataset = dataclasses.field(default_factory=xr.Dataset)

    @property
    def nbytes(self) -> int:
        """Bytes that are held."""
        return self.origin.nbytes + bytes_of(self.plan) + self.labels.nbytes


class PlanCache:
    """The last plans by their `Origin`; safe in many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entries: list[Entry] = []  # the last used comes last
        self._pending: dict[str, Origin] = {}

    def entry(self, line: xr.Dataset, options: tuple[Any, ...]) -> Entry | None:
        """Return the plan of a line; None where there is none."""
        with self._lock:
            entries = self._entries[::-1]
        for entry in entries:
            if entry.origin.is_of(line, options):
                self.add(entry)
                return entry
        return None

    def expect(self, line: xr.Dataset, options: tuple[Any, ...]) -> str:
        """Return the name under which a task will `fulfil` the plan of a line."""
        origin, name = Origin(line, options), uuid.uuid4().hex
        with self._lock:
            if origin.nbytes <= MOST_BYTES // 2:
                self._pending[name] = origin
            while len(self._pending) > MOST_PENDING:
                del self._pending[next(iter(self._pending))]
        return name

    def fulfil(self, name: str, plan: Plan) -> None:
        """Take a plan that was expected; in another process it was not, and nothing is done."""
        with self._lock:
            origin = self._pending.pop(name, None)
        if origin is not None:
            self.add(Entry(origin, plan))

    def add(self, entry: Entry) -> None:
        """Take a plan, or say that it was used; those that were used the longest ago make room."""
        with self._lock:
            self._entries = [each for each in self._entries if each is not entry]
            self._entries.append(entry)
            while len(self._entries) > MOST_PLANS or sum(e.nbytes for e in self._entries) > MOST_BYTES:
                del self._entries[0]


PLANS = PlanCache()


def bytes_of(value: Any) -> int:
    """Return the bytes of all arrays of a plan."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if dataclasses.is_dataclass(value):
        return sum(map(bytes_of, vars(value).values()))
    return sum(map(bytes_of, value)) if isinstance(value, tuple) else 0


def lazy_plan(
    line: xr.Dataset, options: tuple[Any, ...] | None, planner: Callable[..., Plan], **inputs: Any
) -> Callable[..., Delayed]:
    """Return what makes a lazy plan from a cube's shape, dtype and slabs, named by its content.

    With ``options`` None nothing is looked up; else the plan itself stands in the graph where it is at hand.
    """

    def of_cube(shape: tuple[int, int, int], dtype: str, starts: Array) -> Delayed:
        name = f"make_plan-{dask.base.tokenize(planner, shape, dtype, starts, inputs)}"
        expected = ""
        if options is not None:
            of_line = (*options, planner, shape, dtype)
            entry = PLANS.entry(line, of_line)
            if entry is None:
                expected = PLANS.expect(line, of_line)
            elif bytes_of(entry.plan) <= MOST_EMBEDDED_BYTES:
                plan = dataclasses.replace(entry.plan, starts=starts)
                return Delayed(name, {name: plan})
        take = dask.delayed(_taken, pure=True)
        return take(expected, planner, shape, dtype, starts, inputs, dask_key_name=name)

    return of_cube


def _taken(
    expected: str, planner: Callable[..., Plan], shape: Any, dtype: str, starts: Array, inputs: Any
) -> Plan:
    plan = planner(shape, dtype, starts, **inputs)
    PLANS.fulfil(expected, plan)
    return plan
