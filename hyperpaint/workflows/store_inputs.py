"""Inputs of a store: their names, their comparison, and protection against overwriting."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import KEPT_BITS, NUMERICS_VERSION
from hyperpaint.base.errors import Problems, StoreError
from hyperpaint.base.schema import FORMAT_VERSION
from hyperpaint.io.files.reading import sampled_digest


def paths_in(settings: Any) -> Iterator[Path]:
    """Yield every path that settings name, however deep it stands in them."""
    if isinstance(settings, Path):
        yield settings
    elif dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        for field in dataclasses.fields(settings):
            yield from paths_in(getattr(settings, field.name))
    elif isinstance(settings, Mapping):
        for value in settings.values():
            yield from paths_in(value)
    elif isinstance(settings, list | tuple | set | frozenset):
        for value in settings:
            yield from paths_in(value)


def refuse_to_write_over(out: Path, settings: Any, command: str) -> None:
    """Refuse a store that is an input, lies in one, or whose folder holds inputs; nothing allows it.

    ``settings``: what names the inputs, see `paths_in`.

    Raises `StoreError`: all such inputs are listed.
    """
    place = out.resolve()
    problems = Problems(
        f"{command} cannot write {out}, whether or not it may overwrite; choose another --out", StoreError
    )
    for path in dict.fromkeys(each.resolve() for each in paths_in(settings)):
        if place == path:
            problems.add(f"it is {path}, an input", code="output-is-input")
        elif place in path.parents:
            problems.add(f"it holds {path}, an input", code="output-is-input")
        elif path in place.parents and path.is_dir():
            problems.add(f"it lies in {path}, an input", code="output-is-input")
    problems.raise_if_any()


def finishing_command(command: str, options: Mapping[str, Any]) -> str:
    """Return the command line that finishes an interrupted run, ``{store}`` in place of the store.

    ``options``: by their names; those that are None or False were not given, lists several times.
    """
    given = ""
    for name, value in options.items():
        for each in value if isinstance(value, list) else [value]:
            if each is not None and each is not False:
                given += f" {name}" if each is True else f" {name} {quote(str(each))}"
    return f"hyperpaint {command} --out {{store}}{given}"


def settings_of(parameters: Mapping[str, Any]) -> str:
    """Return the text for the settings of a run: version of its numerics, and a digest of all."""
    text = json.dumps([FORMAT_VERSION, NUMERICS_VERSION, KEPT_BITS, parameters], sort_keys=True)
    return f"numerics={NUMERICS_VERSION} digest={hashlib.sha256(text.encode()).hexdigest()[:32]}"


def _stored_form(cube: Path) -> str:
    # another header gives the same file other values
    from hyperpaint.io.envi.envi_cubes import find_pair
    from hyperpaint.io.envi.envi_header import read_header

    header = read_header(find_pair(cube)[0])
    factors = [
        None if values is None else values.tolist()
        for values in (header.data_gain_values, header.data_offset_values)
    ]
    form = (
        header.header_offset,
        header.dtype.str,
        header.interleave,
        header.data_ignore_value,
        header.reflectance_scale_factor,
        *factors,
    )
    return repr(form)


def inputs_digest(dataset: xr.Dataset, cubes: tuple[Path, ...], settings: str) -> str:
    """Return a digest of all values but the cubes', of samples of the cubes' content, and of the settings."""
    import dask

    digest = hashlib.sha256(settings.encode())
    for cube in cubes:
        digest.update(f"{cube.name} {_stored_form(cube)} {sampled_digest(cube)}".encode())
    digest.update(json.dumps(dataset.attrs, sort_keys=True, default=str).encode())
    for name, variable in sorted(dataset.variables.items(), key=lambda item: str(item[0])):
        digest.update(f"{name} {variable.dims} {variable.shape} {variable.dtype} {variable.attrs}".encode())
        if not dask.is_dask_collection(variable):
            values = np.ascontiguousarray(variable.values)
            # of texts numpy holds places in memory
            digest.update(repr(values.tolist()).encode() if values.dtype == object else values.tobytes())
    return digest.hexdigest()[:32]
