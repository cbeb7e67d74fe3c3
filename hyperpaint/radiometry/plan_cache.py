"""Cache of the plans of recently used lines in this process, so that later calls for pixels read only counts.

A plan is looked up by its inputs: the line's small variables, its attributes and the options. A variable in
memory is compared by value with a copy; a lazy one by identity, since dask's name of an array stays the same
when a store is rewritten. So replaced inputs are always noticed, and the cache contains no cube.
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

MAX_PLANS = 8
#: Largest size of all plans and their origins [byte].
MAX_BYTES = 64 * 2**20
#: Largest plan that is embedded in a graph [byte]; tasks compute larger plans from smaller inputs.
MAX_EMBEDDED_BYTES = 8 * 2**20
MAX_PENDING_PLANS = 16


class _VariableState:
    def __init__(self, variable: xr.Variable) -> None:
        self.layout = (variable.dims, variable.shape, variable.dtype)
        self.attrs = dict(variable.attrs)
        self.values = None if _is_lazy(variable) else np.array(variable.values)
        data = variable._data
        # assigning to a part of a dask array changes its name
        self.name = getattr(data, "name", None)
        try:
            self.source: Callable[[], Any] = weakref.ref(data)
        except TypeError:  # xarray's wrapper of a file has no weak references
            self.source = lambda: data

    def matches(self, variable: xr.Variable) -> bool:
        layout = (variable.dims, variable.shape, variable.dtype)
        if self.layout != layout or not xr.core.utils.dict_equiv(self.attrs, variable.attrs):
            return False
        if self.values is None:
            data = variable._data
            is_same = self.source() is data and self.name == getattr(data, "name", None)
            return is_same and _is_lazy(variable)
        if _is_lazy(variable):
            return False
        values = np.asarray(variable.values)
        if values.dtype == object:
            return bool(np.array_equal(self.values, values))
        # compare bytes: NaN equals NaN, and the sign of zero matters
        stored, current = (np.ascontiguousarray(a).reshape(-1).view(np.uint8) for a in (self.values, values))
        return bool(np.array_equal(stored, current))


def _is_lazy(variable: xr.Variable) -> bool:
    data = variable._data
    return (isinstance(data, da.Array) or not variable._in_memory) and not getattr(data, "_copied", False)


class Origin:
    """Inputs of a plan.

    ``line``: flight line with dims named by role; ``options``: compared with ``==``.
    """

    def __init__(self, line: xr.Dataset, options: tuple[Any, ...]) -> None:
        self._states = {name: _VariableState(variable) for name, variable in _small(line).items()}
        self._attrs = dict(line.attrs)
        self._options = (*options, "counts" in line.variables)
        copies = (state.values for state in self._states.values())
        self.nbytes = sum(values.nbytes for values in copies if values is not None)

    def is_of(self, line: xr.Dataset, options: tuple[Any, ...]) -> bool:
        """Return whether a line with these options gives the same plan."""
        small = _small(line)
        return (
            self._options == (*options, "counts" in line.variables)
            and self._states.keys() == small.keys()
            and all(state.matches(small[name]) for name, state in self._states.items())
            and bool(xr.core.utils.dict_equiv(self._attrs, line.attrs))
        )


def _small(line: xr.Dataset) -> dict[Any, xr.Variable]:
    return {
        name: variable
        for name, variable in line.variables.items()
        if ALONG_TRACK not in variable.dims or not {BAND, CROSS_TRACK} & set(variable.dims)
    }


@dataclasses.dataclass(eq=False)
class Entry:
    """A plan with its origin and the small coordinates of its line."""

    origin: Origin
    plan: Plan
    #: Small coordinates; the attributes are those of reflectance
    labels: xr.Dataset = dataclasses.field(default_factory=xr.Dataset)

    @property
    def nbytes(self) -> int:
        return self.origin.nbytes + bytes_of(self.plan) + self.labels.nbytes


class PlanCache:
    """The most recently used plans by their `Origin`; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entries: list[Entry] = []  # most recently used last
        self._pending: dict[str, Origin] = {}

    def entry(self, line: xr.Dataset, options: tuple[Any, ...]) -> Entry | None:
        """Return the plan of a line; None where it is not cached."""
        with self._lock:
            entries = self._entries[::-1]
        for entry in entries:
            if entry.origin.is_of(line, options):
                self.add(entry)
                return entry
        return None

    def expect(self, line: xr.Dataset, options: tuple[Any, ...]) -> str:
        """Return the name with which a task will `fulfil` the plan of a line."""
        origin, name = Origin(line, options), uuid.uuid4().hex
        with self._lock:
            if origin.nbytes <= MAX_BYTES // 2:
                self._pending[name] = origin
            while len(self._pending) > MAX_PENDING_PLANS:
                del self._pending[next(iter(self._pending))]
        return name

    def fulfil(self, name: str, plan: Plan) -> None:
        """Add an expected plan; does nothing in a process that did not call `expect`."""
        with self._lock:
            origin = self._pending.pop(name, None)
        if origin is not None:
            self.add(Entry(origin, plan))

    def add(self, entry: Entry) -> None:
        """Add a plan or mark it as used; the least recently used plans are dropped."""
        with self._lock:
            self._entries = [*(other for other in self._entries if other is not entry), entry]
            while len(self._entries) > MAX_PLANS or sum(e.nbytes for e in self._entries) > MAX_BYTES:
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
    """Return a function from a cube's shape, dtype and slabs to its lazy plan, named by a hash of the inputs.

    With ``options`` None no cache is used; else a cached plan is embedded in the graph.
    """

    def of_cube(shape: tuple[int, int, int], dtype: str, starts: Array) -> Delayed:
        name = f"make_plan-{dask.base.tokenize(planner, shape, dtype, starts, inputs)}"
        expected = ""
        if options is not None:
            line_options = (*options, planner, shape, dtype)
            entry = PLANS.entry(line, line_options)
            if entry is None:
                expected = PLANS.expect(line, line_options)
            elif bytes_of(entry.plan) <= MAX_EMBEDDED_BYTES:
                return Delayed(name, {name: dataclasses.replace(entry.plan, starts=starts)})
        compute = dask.delayed(_computed, pure=True)
        return compute(expected, planner, shape, dtype, starts, inputs, dask_key_name=name)

    return of_cube


def _computed(
    expected: str, planner: Callable[..., Plan], shape: Any, dtype: str, starts: Array, inputs: Any
) -> Plan:
    plan = planner(shape, dtype, starts, **inputs)
    PLANS.fulfil(expected, plan)
    return plan
