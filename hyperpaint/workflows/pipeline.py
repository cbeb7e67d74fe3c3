"""Processing of a collect: from the files of the instruments to a store.

Inputs are checked before processing (`check_collect`), recorded in the store as digests, protected from being
overwritten, and compared with the store later (`compare_inputs`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import os
import re
import shlex
import sys
import warnings
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import xarray as xr

from hyperpaint.alignment import align
from hyperpaint.base.constants import ALIGNMENTS, DEFAULT_CODEC, KEPT_BITS, NUMERICS_VERSION, Alignment
from hyperpaint.base.errors import (
    CollectError,
    PaintError,
    PaintWarning,
    Problems,
    SchemaError,
    StoreError,
    needs_extra,
)
from hyperpaint.base.facts import documented, one_of
from hyperpaint.base.schema import ALONG_TRACK, CHUNK_LINES, FORMAT_VERSION, flag_shares
from hyperpaint.io.collect.collect_toml import read_collect
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.envi.envi_header import read_header
from hyperpaint.io.files.reading import sampled_digest
from hyperpaint.io.store import budget, is_complete, open_group
from hyperpaint.io.store.budget import limited_threads, parse_size
from hyperpaint.io.store.computing import RETRIES, client_in_force, errors_of_the_cluster, scheduler_in_force
from hyperpaint.io.store.groups import check_above, groups_above
from hyperpaint.io.store.layout import Codec, Layout, with_layout
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.manifest import INPUTS, SETTINGS, Manifest, content_of, numerics_of
from hyperpaint.io.store.writer import check_codec, check_room, run_contents, whole_run
from hyperpaint.light.diffuse_record import split_of_lines
from hyperpaint.pictures.plot import overview
from hyperpaint.plausibility import KINDS, Finding, judge_dark_cube, judge_line
from hyperpaint.radiometry.coarse_lines import coarse_reflectance
from hyperpaint.radiometry.panels import declared_panels

from .laboratory import opened_collect

if TYPE_CHECKING:
    from distributed import Client

    from hyperpaint.io.collect.collect_toml import Collect, OpenedCollect
    from hyperpaint.io.store.budget import Demand


def paths_in(settings: Any) -> Iterator[Path]:
    """Yield every path in settings, also in nested dataclasses, mappings and sequences."""
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
    """Refuse an output that is an input, lies in an input, or contains inputs.

    ``settings``: contain the paths of the inputs, see `paths_in`. Raises `StoreError`, which lists these
    inputs.
    """
    output = out.resolve()
    problems = Problems(
        f"{command} cannot write {out}, whether or not it may overwrite; choose another --out", StoreError
    )
    for path in dict.fromkeys(path_in_settings.resolve() for path_in_settings in paths_in(settings)):
        if output == path:
            problems.add(f"it is {path}, an input", code="output-is-input")
        elif output in path.parents:
            problems.add(f"it holds {path}, an input", code="output-is-input")
        elif path in output.parents and path.is_dir():
            problems.add(f"it lies in {path}, an input", code="output-is-input")
    problems.raise_if_any()


def finishing_command(command: str, options: Mapping[str, Any]) -> str:
    """Return the command line that finishes an interrupted run, with ``{store}`` for the path of the store.

    ``options``: values by option; None and False leave an option out, a list repeats it.
    """
    arguments = ""
    for name, value in options.items():
        for argument in value if isinstance(value, list) else [value]:
            if argument is not None and argument is not False:
                arguments += f" {name}" if argument is True else f" {name} {quote(str(argument))}"
    return f"hyperpaint {command} --out {{store}}{arguments}"


def settings_of(parameters: Mapping[str, Any]) -> str:
    """Return the settings of a run as text: version of its numerics, and a digest of all settings."""
    text = json.dumps([FORMAT_VERSION, NUMERICS_VERSION, KEPT_BITS, parameters], sort_keys=True)
    return f"numerics={NUMERICS_VERSION} digest={hashlib.sha256(text.encode()).hexdigest()[:32]}"


def _header_form(cube: Path) -> str:
    # fields of the header that change the values read from the same file

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
    """Return a digest of settings, of all values except cubes, and of samples of the cubes' files."""
    import dask

    digest = hashlib.sha256(settings.encode())
    for cube in cubes:
        digest.update(f"{cube.name} {_header_form(cube)} {sampled_digest(cube)}".encode())
    digest.update(json.dumps(dataset.attrs, sort_keys=True, default=str).encode())
    for name, variable in sorted(dataset.variables.items(), key=lambda item: str(item[0])):
        digest.update(f"{name} {variable.dims} {variable.shape} {variable.dtype} {variable.attrs}".encode())
        if not dask.is_dask_collection(variable):
            values = np.ascontiguousarray(variable.values)
            # bytes of an object array are addresses of texts
            digest.update(repr(values.tolist()).encode() if values.dtype == object else values.tobytes())
    return digest.hexdigest()[:32]


#: Share of flagged pixels of a line from which `process` warns [1].
MANY_FLAGGED = 0.2

_LINES_A_READ = 4096


def check_collect(path: str | os.PathLike[str]) -> tuple[Finding, ...]:
    """Return findings of implausible inputs of a collect, from samples of its cubes and all records.

    Raises `CollectError` if the collect or one of its files cannot be opened; all problems are listed.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> path = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6)
    >>> check_collect(path)
    ()
    """
    needs_irradiance = read_collect(path, need_irradiance=False).irradiance is not None
    opened = opened_collect(path, need_irradiance=needs_irradiance)
    return tuple(itertools.chain(*_findings(opened, opened.members, lit=needs_irradiance).values()))


def refuse_findings(
    opened: OpenedCollect, lines: Iterable[str], accept: Collection[str], *, lit: bool
) -> dict[str, dict[str, Any]]:
    """Check flight lines of an opened collect, named by their groups; return the accepted findings.

    ``accept``: names of accepted findings. ``lit``: whether reflectance is computed, which needs irradiance.

    Returns by group the attributes for the store: the accepted findings of a line. Raises `CollectError` for
    findings that would make results wrong; all are listed. Warns (`PaintWarning`) of other findings.
    """
    refused = []
    accepted: dict[str, dict[str, Any]] = {}
    groups = [name for name in lines if name in opened.members]
    for group, findings in _findings(opened, groups, lit=lit).items():
        for finding in findings:
            if finding.kind.name in accept:
                accepted.setdefault(group, {"accepted_findings": []})["accepted_findings"].append(
                    str(finding)
                )
            elif finding.kind.refused:
                refused.append(finding.problem(acceptable=True))
            else:
                warnings.warn(PaintWarning(str(finding), code=finding.kind.name), stacklevel=3)
    if refused:
        raise CollectError(
            f"{opened.settings.path} is implausible, and is not processed",
            problems=refused,
        )
    return accepted


def check_accepted(accept: Collection[str], problems: Problems) -> None:
    """Add names in ``accept`` that are no kinds of finding to ``problems``."""
    for name in [accept] if isinstance(accept, str) else accept:
        if name not in KINDS or isinstance(accept, str):
            expected = f"a list of some of {', '.join(KINDS)}"
            problems.add(f"accept={name!r}", expected=expected, code="choice-unknown")


def _findings(opened: OpenedCollect, lines: Iterable[str], *, lit: bool) -> dict[str, list[Finding]]:
    # findings on a dark cube are listed with the first line that uses it
    cubes = {str(entry.name): entry for entry in opened.settings.flightlines}
    findings: dict[str, list[Finding]] = {}
    darks: set[Path] = set()
    for name in lines:
        members = tuple(cubes[member] for member in opened.members[name])
        findings[name] = list(judge_line(opened.tree[name].to_dataset(), members, lit=lit))
        dark = members[0].dark if "counts" in opened.tree[name] else None
        for path in dark if isinstance(dark, tuple) else ():
            if path not in darks:
                findings[name] += judge_dark_cube(path)
                darks.add(path)
    return findings


def warn_of_flags(store: Path, lines: Iterable[str]) -> None:
    """Warn of flags that more than `MANY_FLAGGED` of the pixels of a stored line have."""
    import zarr

    for name in lines:
        if not (store / name / "quality").exists():
            continue
        quality = zarr.open_array(store / name / "quality", mode="r", zarr_format=3)
        counts: Counter[str] = Counter()
        for start in range(0, quality.shape[0], _LINES_A_READ):
            values = np.asarray(quality[start : start + _LINES_A_READ])
            counts.update(
                {str(flag.name): share * values.size for flag, share in flag_shares(values).items()}
            )
        shares = {flag: count / quality.size for flag, count in counts.items()}
        texts = [
            f"{100 * share:.0f} % {flag.lower()}" for flag, share in shares.items() if share > MANY_FLAGGED
        ]
        if texts:
            message = (
                f"{name}: many pixels are flagged: {', '.join(texts)}; check these flags before using values"
            )
            warnings.warn(PaintWarning(message, code="pixels-flagged"), stacklevel=3)


#: Time to wait for the first worker of a cluster [s].
WORKERS_WAIT = 60

#: A URL of fsspec, also one that was converted to a `Path`; not the letter of a drive.
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")


@dataclass(frozen=True)
class Outcome:
    """Groups that a run wrote or found complete."""

    path: Path  #: The store.
    written: tuple[str, ...]  #: Groups that were written.
    unchanged: tuple[str, ...]  #: Groups that were complete, from the same inputs and parameters.
    #: Corrections between camera and irradiance record, by the group of the flight line.
    corrected: Mapping[str, str] = field(default_factory=dict)


def local_folder(out: str | Path, command: str) -> Path:
    """Return the store's folder; refuse a URL (`StoreError`)."""
    if _URL.match(os.fspath(out)):
        raise StoreError(
            f"{command} writes to a folder, not to {os.fspath(out)!r}",
            mend=f"{command} to a folder and copy it, or write the groups of open_collect with to_store, "
            "which accepts URLs (guide, 'Object stores')",
            code="output-is-url",
        )
    return Path(out)


def kept_groups(
    groups: Mapping[str, xr.Dataset],
    out: Path,
    *,
    overwrite: bool,
    command: str,
    only: tuple[str, str] | None = None,
) -> list[str]:
    """Return the complete groups of a store; refuse a store with other groups.

    ``groups``: the planned groups, with their attribute `INPUTS`; ``command``: its name for messages.
    ``only``: a prefix, and what its groups belong to: unplanned groups with this prefix are refused.

    Raises `StoreError` if planned groups exist from other inputs, or unplanned groups exist; all are listed.
    """
    if not out.exists():
        return []
    location = Location.of(out)
    problems = Problems(f"cannot write {out}", StoreError)
    parents = dict.fromkeys(parent for name in groups for parent in groups_above(name))
    check_above(parents, location, problems, overwrite=overwrite)
    problems.raise_if_any()
    complete = []
    contents = run_contents(groups)
    manifest = Manifest.read(location, ignore_damage=overwrite)
    for name in location.groups():
        content = content_of(location, name, manifest)
        is_from_run = len(content.split(" ", 2)) == 3  # a run records group, inputs and settings
        if name not in groups:
            if only is not None and name.startswith(only[0]) and is_from_run:
                problems.add(
                    f"it holds /{name}, which does not belong to {only[1]}",
                    mend="choose another path",
                    code="group-foreign",
                )
        elif content == contents[name]:
            # a group with a missing chunk is written again
            if is_complete(out, name):
                complete.append(name)
        elif not overwrite:
            numerics = numerics_of(content)
            state = "from other inputs or parameters"
            if not is_from_run:
                state = f"not written by {command}, or written by hyperpaint 0.2 or older"
            elif numerics not in (None, NUMERICS_VERSION):
                state = f"from version {numerics} of the numerics; this is version {NUMERICS_VERSION}"
            problems.add(
                f"/{name} exists, {state}",
                mend="pass overwrite=True to replace it",
                option="pass --overwrite to replace it",
                code="store-exists",
            )
    problems.raise_if_any()
    return complete


# --- where it is computed ---


@contextlib.contextmanager
def computing_on(address: str | None) -> Iterator[Client | None]:
    """Compute with dask on a cluster; without an address, on the caller's active client, else on threads.

    Raises `MissingExtraError` if distributed is not installed; `CollectError` if no scheduler answers at the
    address; `StoreError` if the cluster has no worker.
    """
    import dask

    if address is None:
        client = client_in_force()
        if client is not None:
            _wait_for_workers(client)
        # set the scheduler here, so that dask does not search for a client again
        has_scheduler = client is not None or dask.config.get("scheduler", None)
        with dask.config.set({} if has_scheduler else {"scheduler": scheduler_in_force()}):
            yield client
        return
    with needs_extra("distributed", "distributed", "processing on a cluster"):
        from distributed import Client
    try:
        # not the default client: if no scheduler answers, it would remain the default, and later computations
        # wait
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise CollectError(
            f"no dask scheduler answers at {address!r} ({error})",
            expected="an address such as tcp://host:8786",
            code="scheduler-unreachable",
        ) from error
    with client, client.as_current(), dask.config.set(scheduler=client.get):
        _wait_for_workers(client)
        yield client


def _wait_for_workers(client: Client) -> None:
    # the size of tasks depends on the memory of the first worker
    try:
        client.wait_for_workers(1, timeout=WORKERS_WAIT)
    except TimeoutError as error:
        raise StoreError(
            f"no worker joined the scheduler at {client.scheduler_info()['address']} within {WORKERS_WAIT} s",
            mend="start workers (dask worker ADDRESS), or wait longer: client.wait_for_workers(1)",
            code="worker-missing",
        ) from error


def token_of(dataset: xr.Dataset) -> str:
    """Return the digest of the inputs of a group."""
    return str(dataset.attrs[INPUTS])


#: Lines in a task on a cluster, where the overhead of a task is larger than on threads.
CLUSTER_LINES = 256

Product = Literal["radiance", "reflectance"]
Kept = Literal["none", "stored"]


@documented(overwrite="group overwrite", progress="stderr progress")
def process(
    collect: str | Path,
    out: str | Path,
    *,
    to: Product = "reflectance",
    reflectance: Kept = "stored",
    alignment: Alignment | None = None,
    scheduler: str | None = None,
    memory_limit: str | int | None = None,
    accept: Collection[str] = (),
    overwrite: bool = False,
    progress: bool = False,
    codec: Codec = DEFAULT_CODEC,
    layout: Layout = "cube",
) -> Path:
    """Process a collect into one Zarr store.

    Each flight line becomes a group ``flightlines/<id>`` with: counts and all variables that calibrate them,
    ``quality``, ``irradiance_age``, ``reflectance`` rounded to 12 mantissa bits, the split into direct and
    diffuse light (``diffuse_fraction``, ``diffuse_fraction_u``, ``sky_state``, see
    `hyperpaint.light.diffuse_from_record`), a small true-colour ``overview``, and means of blocks
    (``coarse_reflectance``). First, wavelengths of camera and irradiance record are compared and corrected
    (`hyperpaint.alignment.align`; the group has its attributes). Panels of the collect (``[[panels]]``) scale
    their line, and their factors are stored (``panel_factor`` and others, see
    `hyperpaint.radiometry.panel_closure`). The store also archives the complete irradiance record, the
    calibration and the spectra of field spectrometers.

    All files are opened, and the first slab of every line is computed, before anything is written. A rerun
    writes only missing groups.

    Parameters
    ----------
    collect
        A ``collect.toml``; see `open_collect`.
    out
        The store, a folder. To write to a URL, write the groups of `open_collect` with `to_store`.
    to
        ``"radiance"`` needs no irradiance, and stores unrounded ``radiance`` instead of ``reflectance``.
    reflectance
        ``"none"`` does not store the computed cube; ``.paint.reflectance()`` computes it from the stored
        counts, with the scale of the panels.
    alignment
        Differences between camera and irradiance record in wavelength and band width are corrected if
        significant (``"auto"``), ``"never"``, or whenever they can be measured (``"always"``); by default
        ``[alignment] apply`` of the collect, else ``"auto"``.
    scheduler
    memory_limit
        Maximum memory of this process, or of each worker: bytes, or text such as ``"2 GiB"``; by default 80 %
        of the available memory. The peak is estimated before the run; if it exceeds the limit, tasks have
        fewer lines and fewer threads run.
    accept
        Names of findings of `hyperpaint check` to accept; implausible inputs are refused otherwise.
    overwrite
    progress
    codec, layout
        See `to_store`. Complete groups are kept with their codec and layout.

    Returns
    -------
    Path of the store.

    Raises
    ------
    CollectError
        The collect, or one of its files, cannot be used; all problems of all files are listed.
    SchemaError
        ``to``, ``reflectance``, ``alignment``, ``accept`` or ``codec`` is not one of the accepted words, or
        ``memory_limit`` is no size.
    StoreError
        ``out`` is a URL; the store holds other data, is being written by another process, or cannot be
        written; memory or disk does not suffice, which is checked before anything is written; or workers or
        the scheduler are lost, or a block fails repeatedly: the same call then finishes the run.
    MissingExtraError
        ``scheduler`` is used, and distributed is not installed.

    Warns
    -----
    PaintWarning
        As `open_collect` and `hyperpaint.alignment.align`.

    Examples
    --------
    >>> import tempfile, hyperpaint as hp
    >>> collect = hp.simulate_collect(tempfile.mkdtemp(), scene="plan", lines=40, bands=4, columns=6)
    >>> path = process(collect, collect.with_name("lot.zarr"))
    >>> hp.open_store(path, "flightlines/raw_0").paint.reflectance().sizes["along_track"]
    40
    """
    return run(
        collect,
        out,
        to=to,
        reflectance=reflectance,
        alignment=alignment,
        scheduler=scheduler,
        memory_limit=memory_limit,
        accept=accept,
        overwrite=overwrite,
        progress=progress,
        codec=codec,
        layout=layout,
    ).path


def run(
    collect: str | Path,
    out: str | Path,
    *,
    to: Product = "reflectance",
    reflectance: Kept = "stored",
    alignment: Alignment | None = None,
    scheduler: str | None = None,
    memory_limit: str | int | None = None,
    accept: Collection[str] = (),
    overwrite: bool = False,
    progress: bool = False,
    codec: Codec = DEFAULT_CODEC,
    layout: Layout = "cube",
) -> Outcome:
    """Process a collect, as `process` does with the same arguments, and return the groups written."""
    problems = Problems("cannot process", SchemaError)
    for word, value, allowed in (
        ("to", to, get_args(Product)),
        ("reflectance", reflectance, get_args(Kept)),
        ("alignment", alignment or "auto", ALIGNMENTS),
        ("layout", layout, get_args(Layout)),
    ):
        one_of(value, allowed, word, problems=problems)
    check_accepted(accept, problems)
    problems.raise_if_any()
    check_codec(codec)
    out = local_folder(out, "process")
    limit = None if memory_limit is None else parse_size(memory_limit)
    parameters = {"to": to, "reflectance": reflectance, "alignment": alignment}
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(computing_on(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot process {collect}"))
        lines_a_task = CHUNK_LINES if client is None else CLUSTER_LINES
        opened, groups = opened_groups(collect, lines_a_task, parameters)
        refuse_to_write_over(out, (opened.settings, list(opened.cubes.values())), "process")
        complete = kept_groups(
            groups, out, overwrite=overwrite, command="process", only=("flightlines/", "this collect")
        )
        pending = [name for name in groups if name not in complete]
        accepted = refuse_findings(opened, pending, accept, lit=to == "reflectance")
        demand = _demand({name: groups[name] for name in pending}, lines_a_task, client, limit)
        stack.enter_context(limited_threads(demand.threads if client is None else None))
        if demand.lines < lines_a_task:
            opened, groups = opened_groups(opened.settings, demand.lines, parameters)
        apply = alignment or opened.settings.alignment
        aligned = {name: aligned_group(groups[name], name, to, apply) for name in pending}
        products = {
            name: with_layout(_product(aligned[name], name, to, reflectance), layout).assign_attrs(
                accepted.get(name, {})
            )
            for name in pending
        }
        check_room(products, out, {name: token_of(dataset) for name, dataset in products.items()}, codec)
        _compute_first_slabs(products, collect, client)
        lines = [name for name, dataset in products.items() if ALONG_TRACK in dataset.dims]
        again = {
            "--to": None if to == "reflectance" else to,
            "--alignment": alignment,
            "--overwrite": overwrite,
            "--reflectance": None if reflectance == "stored" else reflectance,
            "--accept": sorted(accept),
            "--codec": None if codec == DEFAULT_CODEC else codec,
            "--layout": {"cube": None}.get(layout, layout),
        }
        command = finishing_command(f"process {quote(str(opened.settings.path.absolute()))}", again)
        turn = stack.enter_context(
            whole_run(
                out,
                run_contents(groups),
                products,
                opened.tree.attrs,
                command=command,
                overwrite=overwrite,
                codec=codec,
            )
        )
        for name, dataset in products.items():
            if progress and name in lines:
                which = f"flight line {lines.index(name) + 1} of {len(lines)}"
                sys.stderr.write(f"{name}: {which}, {dataset.sizes[ALONG_TRACK]} scan lines\n")
            turn.write(name, dataset, progress=progress)
    warn_of_flags(out, lines)
    corrected = {
        name: str(line.attrs["alignment"])
        for name, line in aligned.items()
        if line.attrs.get("alignment_state") == "applied"
    }
    return Outcome(out, tuple(products), tuple(complete), corrected)


# --- groups to write ---------------------------------------------------------------------------------------


def opened_groups(
    collect: str | Path | Collect, lines: int, parameters: Mapping[str, Any]
) -> tuple[OpenedCollect, dict[str, xr.Dataset]]:
    """Open a collect with ``lines`` lines per task; return it, and its groups with their digests."""
    opened = opened_collect(
        collect, need_irradiance=parameters["to"] == "reflectance", chunks={ALONG_TRACK: lines}
    )
    tree, cubes = opened.tree, opened.cubes
    line_parameters = dict(parameters)
    if line_parameters["to"] == "radiance":
        del line_parameters["alignment"]
    elif line_parameters["alignment"] is None:
        line_parameters["alignment"] = opened.settings.alignment
    groups = {}
    references = (f"references/{name}" for name in tree.children.get("references", {}))
    for name in (*cubes, "irradiance", "calibration", *references):
        if f"/{name}" not in tree.groups:
            continue
        dataset = tree[name].to_dataset()
        settings = settings_of(line_parameters if name in cubes else {})
        digest = inputs_digest(dataset, cubes.get(name, ()), settings)
        groups[name] = dataset.assign_attrs({INPUTS: digest, SETTINGS: settings})
    return opened, groups


def aligned_group(dataset: xr.Dataset, name: str, to: Product, apply: Any) -> xr.Dataset:
    """Return a flight line after `hyperpaint.alignment.align`; other groups unchanged."""
    if to == "radiance" or not name.startswith("flightlines/"):
        return dataset

    return align(dataset, apply=apply)


def _product(dataset: xr.Dataset, name: str, to: Product, storage: Kept) -> xr.Dataset:
    if not name.startswith("flightlines/"):
        return dataset
    product: xr.Dataset
    if to == "radiance":
        product = dataset.paint.radiance()
        return product.drop_vars("radiance") if storage == "none" and "counts" in product else product

    product = dataset.paint.reflectance(keep_bits=KEPT_BITS, panel=declared_panels(dataset) or None)
    product["reflectance"].attrs["keep_bits"] = KEPT_BITS
    split = split_of_lines(dataset)
    if split is not None:
        product = product.assign(split.data_vars)
    pictures = {"overview": overview(product), "coarse_reflectance": coarse_reflectance(product)}
    product = product.assign({key: picture for key, picture in pictures.items() if picture is not None})
    return product.drop_vars("reflectance") if storage == "none" else product


def _compute_first_slabs(
    groups: Mapping[str, xr.Dataset], collect: str | Path, client: Client | None
) -> None:
    # The first slab of every line shows impossible values before anything is written. On a cluster whose
    # workers share a cache this also compiles the kernels once.
    options = {} if client is None else {"retries": RETRIES}
    problems = Problems(f"{collect} cannot be processed", CollectError)
    for name, dataset in groups.items():
        if "quality" in dataset.variables:
            try:
                with errors_of_the_cluster(f"cannot compute the first lines of /{name}"):
                    dataset["quality"].isel({ALONG_TRACK: slice(0, 1)}).compute(**options)
            except StoreError:  # a fault of the cluster, not of the data
                raise
            except (PaintError, OSError) as error:
                problems.add_error(f"/{name}", error)
    problems.raise_if_any()


# --- where it is computed ----------------------------------------------------------------------------------


def _demand(groups: Mapping[str, xr.Dataset], lines: int, client: Client | None, limit: int | None) -> Demand:
    # lines per task and threads with which this process, or each worker, stays within its memory

    loads = {name: budget.Load.of(line) for name, line in groups.items() if ALONG_TRACK in line.dims}
    if client is None:
        resident = budget.resident_memory()
        return budget.fit(
            loads,
            lines=lines,
            threads=budget.thread_count(),
            fixed=max(budget.PROCESS, resident + budget.RUNNING),
            limit=budget.process_limit(resident, limit),
            a_thread=budget.thread_space(),
        )
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    limits = [worker["memory_limit"] for worker in workers if worker["memory_limit"]]
    if limit is None and limits:
        limit = int(budget.USABLE * min(limits))
    threads = max((worker["nthreads"] for worker in workers), default=1)
    return budget.fit(
        loads, lines=lines, threads=threads, fixed=budget.WORKER, limit=limit, least_threads=threads
    )


#: Variables of a raw cube; the first of these in a line is the one in its file.
_RAW = ("counts", "radiance")


@dataclass(frozen=True)
class InputReport:
    """Result of `compare_inputs`."""

    collect: Path  #: The ``collect.toml`` that was opened.
    blocks: int  #: Blocks of cubes that were read.
    problems: tuple[str, ...]  #: Inputs that differ, one line each; empty if all are unchanged.

    def __str__(self) -> str:
        state = f"{len(self.problems)} differ" if self.problems else "all unchanged"
        return "\n  ".join(
            [f"inputs of {self.collect}: {self.blocks} blocks of cubes, {state}", *self.problems]
        )


def compare_inputs(store: Path, collect: Path | None = None) -> InputReport:
    """Read all inputs of a store and compare them with the store's record of its inputs.

    Cubes are compared with the checksums of the stored samples, block by block; other files by their values.
    ``collect``: present path of the ``collect.toml``; by default the path recorded in the store.

    Raises `StoreError` if `process` did not write the store, or the ``collect.toml`` is not found;
    `CollectError` if the collect, or one of its files, cannot be opened.
    """
    location = Location.of(store)
    manifest = Manifest.read(location)
    command = _process_command(location, manifest)
    source = Path(command[2]) if collect is None else collect
    if not source.is_file():
        raise StoreError(
            f"{source}, the collect of {store}, does not exist",
            mend="pass its present path: compare_inputs(store, collect)",
            option="pass its present path: --collect COLLECT.toml",
            code="file-not-found",
        )
    opened = opened_collect(source, need_irradiance="radiance" not in command)
    problems: list[str] = []
    blocks = 0
    for group in location.groups():
        words = content_of(location, group, manifest).split(" ", 2)
        if len(words) < 3:
            continue  # not written by a run, which records group, inputs and settings
        if f"/{group}" not in opened.tree.groups:
            problems.append(f"/{group}: {source.name} no longer has this group")
            continue
        dataset = opened.tree[group].to_dataset()
        cubes = opened.cubes.get(group, ())
        if inputs_digest(dataset, cubes, words[2]) != words[1]:
            problems.append(f"/{group}: its inputs have changed")
        for name in [name for name in _RAW if name in dataset][:1] if cubes else []:
            stored = open_group(store, group, chunks=None)
            if name in stored:
                blocks += -(-stored.sizes[ALONG_TRACK] // CHUNK_LINES)
                problems += _different_blocks(group, dataset[name], stored[name])
    return InputReport(source, blocks, tuple(problems))


def _process_command(location: Location, manifest: Manifest | None) -> list[str]:
    try:
        words = shlex.split(manifest.command) if manifest is not None else []
    except ValueError:  # unbalanced quotes, which hyperpaint does not write
        words = []
    if words[:2] != ["hyperpaint", "process"] or len(words) < 3:
        raise StoreError(
            f"{location.url} was not written by hyperpaint process and has no record of inputs",
            code="inputs-unrecorded",
        )
    return words


def _different_blocks(group: str, cube: xr.DataArray, stored: xr.DataArray) -> Iterator[str]:
    name = str(cube.name)
    if cube.shape != stored.shape:
        yield f"/{group}: {name} has the shape {cube.shape}, stored is {stored.shape}"
        return

    def block_problem(start: int) -> str:
        lines = {ALONG_TRACK: slice(start, start + CHUNK_LINES)}
        try:
            values = cube.isel(lines).compute(scheduler="synchronous").values
            is_equal = np.array_equal(values, stored.isel(lines).values, equal_nan=values.dtype.kind == "f")
        except (PaintError, OSError, ValueError) as error:
            return f"/{group}: {name} cannot be read: {error!s:.300}"
        end = min(start + CHUNK_LINES, len(cube)) - 1
        return (
            "" if is_equal else f"/{group}: {name}, lines {start} to {end}: differs from the stored samples"
        )

    with ThreadPoolExecutor() as pool:
        yield from filter(None, pool.map(block_problem, range(0, cube.sizes[ALONG_TRACK], CHUNK_LINES)))
