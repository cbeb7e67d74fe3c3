"""Processing of a collect: from the files of the instruments to a store.

Inputs are checked before processing (`collects.check_collect`), recorded in the store as digests, protected
from being overwritten, and compared with the store later (`compare_inputs`).

There is one recipe for products: inputs, settings, function and output are declared; one engine makes them.

A product is a store, a file, several files, or a folder. Its declaration says what it is made from. The
engine decides by content whether it is current, refuses to replace content of other programs, makes it, and
reports. Every product is built beside its place and put there in one step, see
`hyperpaint.io.files.publishing`.

`write_groups` makes the groups of a store, `Record.produce` makes files and folders. The manifest of the
store, or the file of the record, says from which inputs an existing product was made.

A virtual store is a collect as a small store that refers to the raw cubes of the camera.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import json
import os
import shlex
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, get_args

import dask
import numpy as np
import xarray as xr

from hyperpaint.alignment import align
from hyperpaint.base import (
    ALIGNMENTS,
    ALONG_TRACK,
    CHUNK_LINES,
    DEFAULT_CODEC,
    FORMAT_VERSION,
    KEPT_BITS,
    NUMERICS_VERSION,
    Alignment,
    CollectError,
    FormatError,
    PaintError,
    PaintWarning,
    Problem,
    Problems,
    SchemaError,
    StoreError,
    as_path,
    documented,
    flag_shares,
    flags_set_from,
    needs_extra,
    one_of,
    origin_of,
    read_limited,
    remote_states,
    url_of,
    warn_user,
)
from hyperpaint.io.collect.collect_toml import Collect, OpenedCollect
from hyperpaint.io.envi.envi_cubes import (
    FILE_DIMS,
    EnviArray,
    find_pair,
    open_envi,
    read_header,
    slab_lines,
    slab_offsets,
)
from hyperpaint.io.files.publishing import publish_file, published_folder
from hyperpaint.io.files.reading import digest_of_file, sampled_digest
from hyperpaint.io.store import (
    INPUTS,
    RETRIES,
    SETTINGS,
    BlockBar,
    Codec,
    Demand,
    Layout,
    Location,
    Manifest,
    RawFile,
    Staging,
    VirtualCube,
    WholeRun,
    budget,
    check_above,
    check_codec,
    check_room,
    client_in_force,
    content_of,
    errors_of_the_cluster,
    groups_above,
    in_parallel,
    is_complete,
    is_virtual,
    limited_threads,
    numerics_of,
    on_workers,
    open_group,
    open_virtual,
    parse_size,
    refuse_kerchunk,
    run_contents,
    scheduler_in_force,
    staging,
    summary_of,
    version_of_program,
    virtual_groups,
    watched,
    whole_run,
    with_layout,
    write_icechunk,
)
from hyperpaint.light.diffuse_record import split_of_lines
from hyperpaint.pictures.plot import overview
from hyperpaint.plausibility import KINDS
from hyperpaint.radiometry.panels import declared_panels
from hyperpaint.radiometry.pixel_reading import coarse_reflectance
from hyperpaint.radiometry.planning import has_white, is_lamp_lit
from hyperpaint.surroundings.scratch import survey_planned
from hyperpaint.surroundings.surveying import flag_line

from .collects import opened_collect, refuse_findings

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class Outcome:
    # Groups that a run wrote or found complete.
    path: Path  #: The store.
    written: tuple[str, ...]  #: Groups that were written.
    unchanged: tuple[str, ...]  #: Groups that were complete, from the same inputs and parameters.
    #: Corrections between camera and irradiance record, by the group of the flight line.
    corrected: Mapping[str, str] = field(default_factory=dict)


def paths_in(settings: Any) -> Iterator[Path]:
    # Yield every path in settings, also in nested dataclasses, mappings and sequences.
    if isinstance(settings, Path):
        yield settings
    elif dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        yield from paths_in([getattr(settings, field.name) for field in dataclasses.fields(settings)])
    elif isinstance(settings, Mapping | list | tuple | set | frozenset):
        for value in settings.values() if isinstance(settings, Mapping) else settings:
            yield from paths_in(value)


def refuse_to_write_over(out: Path, settings: Any, command: str) -> None:
    # Refuse an output that is an input, lies in an input, or contains inputs.
    #
    # ``settings``: contain the paths of the inputs, see `paths_in`. Raises `StoreError`, which lists these
    # inputs.
    output = out.resolve()
    inputs = (as_path(origin_of(path)).resolve() for path in paths_in(settings))
    with Problems(
        f"{command} cannot write {out}, whether or not it may overwrite; choose another --out", StoreError
    ) as problems:
        for path in dict.fromkeys(inputs):
            relation = "is" if output == path else "holds" if output in path.parents else "lies in"
            problems.add_if(
                relation != "lies in" or (path in output.parents and path.is_dir()),
                f"it {relation} {path}, an input",
                code="output-is-input",
            )


def finishing_command(command: str, options: Mapping[str, Any]) -> str:
    # Return the command line that finishes an interrupted run, with ``{store}`` for the path of the store.
    #
    # ``options``: values by option; None and False leave an option out, a list repeats it.
    arguments = ""
    for name, value in options.items():
        for argument in value if isinstance(value, list) else [value]:
            if argument is not None and argument is not False:
                arguments += f" {name}" if argument is True else f" {name} {quote(str(argument))}"
    return f"hyperpaint {command} --out {{store}}{arguments}"


def kept_groups(
    groups: Mapping[str, xr.Dataset],
    out: Path,
    *,
    overwrite: bool,
    command: str,
    only: tuple[str, str] | None = None,
) -> list[str]:
    # Return the complete groups of a store; refuse a store with other groups.
    #
    # ``groups``: the planned groups, with their attribute `INPUTS`; ``command``: its name for messages.
    # ``only``: a prefix, and what its groups belong to: unplanned groups with this prefix are refused.
    #
    # Raises `StoreError` if planned groups exist from other inputs, or unplanned groups exist; all are
    # listed.
    if not out.exists():
        return []
    location = Location.of(out)
    with Problems(f"cannot write {out}", StoreError) as problems:
        parents = dict.fromkeys(parent for name in groups for parent in groups_above(name))
        check_above(parents, location, problems, overwrite=overwrite)
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
                option="pass --overwrite to replace it, or the options it was written with (run has --flags)",
                code="store-exists",
            )
    problems.raise_if_any()
    return complete


def write_groups(
    out: Path,
    groups: Mapping[str, xr.Dataset],
    plan: Callable[[list[str]], Mapping[str, xr.Dataset]],
    attrs: Mapping[Any, Any],
    *,
    source: str | Path,
    command: str,
    options: Mapping[str, Any],
    only: tuple[str, str] | None = None,
    from_stored: Callable[[str, WholeRun], xr.Dataset] | None = None,
    announce: Callable[[str], str] | None = None,
    overwrite: bool = False,
    codec: Codec = DEFAULT_CODEC,
    client: "Client | None" = None,
) -> Outcome:
    # Write the groups of a store that are missing or not current; complete groups stay.
    #
    # Everything is checked, and the first slab of every flight line computed, before anything is written.
    #
    # ``out``: The store. ``groups``: All groups of the store, with the attributes `INPUTS` and `SETTINGS`.
    # ``plan``: Returns the datasets of the groups that will be written, by their names. ``attrs``: Attributes
    # of the root. ``source``: File of the inputs, for messages and for the command that resumes the run.
    # ``command``, ``options``: Command that writes the store, and its options. ``only``: See `kept_groups`.
    # ``from_stored``: Returns the dataset of a group when its turn comes, from groups that are stored
    # already. ``announce``: Returns the line on stderr about a group; None shows no progress.
    complete = kept_groups(groups, out, overwrite=overwrite, command=command, only=only)
    products = plan([name for name in groups if name not in complete])
    check_room(products, out, {name: str(dataset.attrs[INPUTS]) for name, dataset in products.items()}, codec)
    # The first slab of every line shows impossible values before anything is written. On a cluster whose
    # workers share a cache this also compiles the kernels once.
    problems = Problems(f"{source} cannot be processed", CollectError)

    def first_slab(name: str) -> None:
        try:
            with errors_of_the_cluster(f"cannot compute the first lines of /{name}"):
                products[name]["quality"].isel({ALONG_TRACK: slice(0, 1)}).compute(
                    **({} if client is None else {"retries": RETRIES})
                )
        except StoreError:  # a fault of the cluster, not of the data
            raise
        except (PaintError, OSError) as error:
            problems.add_error(f"/{name}", error)

    # the number of groups that keep all threads of a cluster busy, and whether each is one task; groups of
    # one task cost the client least, where there are enough for all threads
    at_once, as_one_task = 1, False
    if client is not None:
        arrays = [array for group in products.values() for array in group.variables.values()]
        slabs = max([1, *(len(array.chunksizes.get(ALONG_TRACK, ())) for array in arrays)])
        threads: int = sum(client.nthreads().values())
        as_one_task = slabs <= _SLABS_OF_A_TASK and len(products) >= 2 * threads
        at_once = max(1, min(len(products), 2 * threads // (1 if as_one_task else slabs)))
    lines = [name for name, dataset in products.items() if "quality" in dataset.variables]
    for names in (lines[:1], lines[1:]):
        in_parallel(first_slab, names, at_once)
    problems.raise_if_any()
    resumed = finishing_command(f"{command} {quote(str(as_path(origin_of(source)).absolute()))}", options)
    with whole_run(
        out, run_contents(groups), products, attrs, command=resumed, overwrite=overwrite, codec=codec
    ) as turn:

        def write(name: str) -> None:
            if announce is not None and at_once == 1:
                sys.stderr.write(announce(name))
            dataset = products[name] if from_stored is None else from_stored(name, turn)
            is_shown = announce is not None and at_once == 1
            turn.write(name, dataset, progress=is_shown, as_one_task=as_one_task)
            if bar is not None:
                bar.advance()

        with contextlib.ExitStack() as shown:
            bar = None
            if announce is not None and at_once > 1:  # one bar for all groups
                shown.enter_context(contextlib.redirect_stdout(sys.stderr))
                bar = shown.enter_context(BlockBar(len(products)))
            names = list(products)
            for group in (names[:1], names[1:]):  # the others may need the first
                in_parallel(write, group, at_once)
    return Outcome(out, tuple(products), tuple(complete))


#: A group with more slabs is more than one task on a cluster.
_SLABS_OF_A_TASK = 8


# --- where it is computed ---

#: Time to wait for the first worker of a cluster [s].
WORKERS_WAIT = 60


@contextlib.contextmanager
def computing_on(address: str | None) -> "Iterator[Client | None]":
    # Compute with dask on a cluster; without an address, on the caller's active client, else on threads.
    #
    # Raises `MissingExtraError` if distributed is not installed; `CollectError` if no scheduler answers at
    # the address; `StoreError` if the cluster has no worker.
    with contextlib.ExitStack() as stack:
        if address is None:
            client = client_in_force()
            # set the scheduler here, so that dask does not search for a client again
            if client is None and not dask.config.get("scheduler", None):
                stack.enter_context(dask.config.set(scheduler=scheduler_in_force()))
        else:
            with needs_extra("distributed", "distributed", "processing on a cluster"):
                from distributed import Client
            with CollectError.instead_of(
                (OSError, ValueError, TimeoutError),
                f"no dask scheduler answers at {address!r} ($whole)",
                expected="an address such as tcp://host:8786",
                code="scheduler-unreachable",
            ):
                # not the default client: if no scheduler answers, it would remain the default, and later
                # computations wait
                client = stack.enter_context(Client(address, timeout="10s", set_as_default=False))
            stack.enter_context(client.as_current())
            stack.enter_context(dask.config.set(scheduler=client.get))
        if client is not None:
            try:
                # the size of tasks depends on the memory of the first worker
                client.wait_for_workers(1, timeout=WORKERS_WAIT)
            except TimeoutError as error:
                scheduler = client.scheduler_info()["address"]
                raise StoreError(
                    f"no worker joined the scheduler at {scheduler} within {WORKERS_WAIT} s",
                    mend="start workers (dask worker ADDRESS), or wait longer: client.wait_for_workers(1)",
                    code="worker-missing",
                ) from error
        if address is not None:
            stack.enter_context(errors_of_the_cluster("cannot compute on the cluster"))
            stack.enter_context(watched(client, is_own=True))
        yield client


# --- files and folders -------------------------------------------------------------------------------------

_HASH = "blake2b"
#: Entry of a product that was begun and not finished: its files may be those of a run.
_UNFINISHED: dict[str, Any] = {"inputs": None, "products": None}


@dataclass(frozen=True)
class StepOutcome:
    """Outcome of a step.

    Attributes
    ----------
    step
        Name of the step.
    state
        ``"done"``, ``"unchanged"`` (products of the same inputs exist), ``"left out"`` or ``"failed"``.
    text
        Products, or the reason why there are none.
    paths
        Files of the products.
    error
        Error of a failed step.
    """

    step: str
    state: str
    text: str
    paths: tuple[Path, ...] = ()
    error: PaintError | None = None


@dataclass(frozen=True)
class Record:
    # File with checksums of the inputs and the files of products, by which the engine knows them again.
    path: Path
    names: Collection[str]  #: Names of all products.

    def entries(self) -> dict[str, Any]:
        # Return the entries by name; entries of products that are damaged count as unfinished.
        if not self.path.is_file():
            return {}
        try:
            record = json.loads(read_limited(self.path, 1 << 20, "the record of products"))
        except ValueError:
            record = None
        entries = record if isinstance(record, dict) else dict.fromkeys(self.names)
        for name in [name for name in self.names if name in entries]:
            entry = entries[name]
            states = entry["products"] if isinstance(entry, dict) and set(entry) == set(_UNFINISHED) else None
            # earlier versions recorded sizes and times
            if not isinstance(states, dict) or not all(
                not state or str(state).startswith(f"{_HASH}:") for state in states.values()
            ):
                entries[name] = _UNFINISHED
        return entries

    def write(self, entries: Mapping[str, Any]) -> None:
        # Write entries; others stay.
        publish_file(
            self.path,
            json.dumps({**self.entries(), **entries}, indent=1, sort_keys=True).encode(),
            overwrite=True,
        )

    def produce(
        self, name: str, paths: tuple[Path, ...], inputs: Any, make: Callable[[], str], *, overwrite: bool
    ) -> StepOutcome:
        # Make a product unless it is current; errors of the package are an outcome.
        #
        # ``paths``: its files or folders; ``inputs``: values for JSON of everything that it depends on,
        # besides the version of the program; ``make``: makes it, and returns a text for the report;
        # ``overwrite``: whether to replace files that another program wrote or changed.
        inputs, listed = digest_of([version_of_program(), name, inputs]), ", ".join(map(str, paths))
        entry, states = self.entries().get(name), states_of(paths)
        if entry == {"inputs": inputs, "products": states} and all(path.exists() for path in paths):
            return StepOutcome(name, "unchanged", listed, paths)
        recorded = (entry or {}).get("products") or {}
        foreign = [path for path in paths if path.exists() and states[path.name] != recorded.get(path.name)]
        try:
            StoreError.raise_if(
                foreign and not (overwrite or entry == _UNFINISHED),
                f"{', '.join(map(str, foreign))}: written or changed by another program",
                mend="move them away, or pass overwrite=True",
                option="move them away, or use --overwrite",
                code="product-foreign",
            )
            # if this run is interrupted, its files are not taken for those of another program
            self.write({name: _UNFINISHED})
            text = make()
        except PaintError as error:
            return StepOutcome(name, "failed", str(error), error=error)
        self.write({name: {"inputs": inputs, "products": states_of(paths)}})
        return StepOutcome(name, "done", text, paths)


def digest_of(inputs: Any) -> str:
    # Return the digest of values for JSON, such as the inputs of a product.
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()


def states_of(paths: Iterable[Path]) -> dict[str, str]:
    # Return checksums by name: of a file's content, of all files of a folder, of the metadata of a store.
    #
    # The metadata of a store contain checksums of its chunks. The checksum of a missing path is empty.
    states: dict[str, str] = {}
    for path in paths:
        only = "zarr.json" if (path / "zarr.json").is_file() else ""
        if (url := url_of(path)) is not None:
            sums: Any = remote_states(url, only=only)
        else:
            files = [path] if path.is_file() else sorted(filter(Path.is_file, path.rglob(only or "*")))
            sums = [(file.relative_to(path).as_posix(), digest_of_file(file, _HASH)) for file in files]
        states[path.name] = f"{_HASH}:{digest_of(sums)}" if sums else ""
    return states


def inputs_digest(dataset: xr.Dataset, cubes: tuple[Path, ...], settings: str) -> str:
    # Return a digest of settings, of all values except cubes, and of samples of the cubes' files.
    digest = hashlib.sha256(settings.encode())
    for cube in cubes:
        # fields of the header that change the values read from the same file
        header = read_header(find_pair(cube)[0])
        factors = (header.data_gain_values, header.data_offset_values)
        form = (
            header.header_offset,
            header.dtype.str,
            header.interleave,
            header.data_ignore_value,
            header.reflectance_scale_factor,
            *(None if values is None else values.tolist() for values in factors),
        )
        digest.update(f"{cube.name} {form!r} {sampled_digest(cube)}".encode())
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


# --- where it is computed ---


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
    flags: bool = False,
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
        The store: a folder or a URL.
    to
        ``"radiance"`` needs no irradiance, and stores unrounded ``radiance`` instead of ``reflectance``.
    reflectance
        ``"none"`` does not store the computed cube; ``.paint.reflectance()`` computes it from the stored
        counts, with the scale of the panels.
    alignment
        Differences between camera and irradiance record in wavelength and band width are corrected if
        significant (``"auto"``), ``"never"``, or whenever they can be measured (``"always"``); by default
        ``[alignment] apply`` of the collect, else ``"auto"``.
    flags
        Detect glint, shadow, light of neighbours and mixed edges on every line, and store them in ``quality``
        with their layers, see `hyperpaint.surroundings.flag`. The line is read once more. Signatures,
        reports, sites and viewers then use these flags. A warning names lines where detection fails.
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
        The store holds other data, is being written by another process, or cannot be written; memory or disk
        does not suffice, which is checked before anything is written; or workers or the scheduler are lost,
        or a block fails repeatedly: the same call then finishes the run.
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
        flags=flags,
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
    flags: bool = False,
    scheduler: str | None = None,
    memory_limit: str | int | None = None,
    accept: Collection[str] = (),
    overwrite: bool = False,
    progress: bool = False,
    codec: Codec = DEFAULT_CODEC,
    layout: Layout = "cube",
) -> Outcome:
    # Process a collect, as `process` does with the same arguments, and return the groups written.
    problems = Problems("cannot process", SchemaError)
    for word, value, allowed in (
        ("to", to, get_args(Product)),
        ("reflectance", reflectance, get_args(Kept)),
        ("alignment", alignment or "auto", ALIGNMENTS),
        ("layout", layout, get_args(Layout)),
    ):
        one_of(value, allowed, word, problems=problems)
    for name in [accept] if isinstance(accept, str) else accept:
        problems.add_if(
            name not in KINDS or isinstance(accept, str),
            f"accept={name!r}",
            expected=f"a list of some of {', '.join(KINDS)}",
            code="choice-unknown",
        )
    problems.raise_if_any(
        (
            flags and to == "radiance",
            Problem(
                "flags need reflectance",
                mend="leave out flags=True, or to='radiance'",
                option="leave out --flags, or --to radiance",
                code="option-conflict",
            ),
        )
    )
    check_codec(codec)
    out = as_path(out)
    limit = None if memory_limit is None else parse_size(memory_limit)
    parameters: dict[str, Any] = {"to": to, "reflectance": reflectance, "alignment": alignment}
    parameters |= {"flags": True} if flags else {}
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(computing_on(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot process {collect}"))
        lines_a_task = CHUNK_LINES if client is None else CLUSTER_LINES
        opened, groups = opened_groups(collect, lines_a_task, parameters)
        refuse_to_write_over(out, (opened.settings, list(opened.cubes.values())), "process")
        aligned: dict[str, xr.Dataset] = {}
        products: dict[str, xr.Dataset] = {}

        def planned(pending: list[str]) -> dict[str, xr.Dataset]:
            # groups to write, in tasks that fit into the memory
            accepted = refuse_findings(opened, pending, accept, lit=to == "reflectance")
            demand = demand_of({name: groups[name] for name in pending}, lines_a_task, client, limit)
            stack.enter_context(limited_threads(demand.threads if client is None else None))
            sources = (
                opened_groups(opened.settings, demand.lines, parameters)[1]
                if demand.lines < lines_a_task
                else groups
            )
            apply = alignment or opened.settings.alignment
            aligned.update({name: aligned_group(sources[name], name, to, apply) for name in pending})
            products.update(
                {
                    name: _product(aligned[name], name, to).assign_attrs(accepted.get(name, {}))
                    for name in pending
                }
            )
            return {name: stored(products[name]) for name in pending}

        def stored(product: xr.Dataset) -> xr.Dataset:
            # only a cube that is computed is left out
            is_left_out = reflectance == "none" and (to == "reflectance" or "counts" in product)
            return with_layout(product.drop_vars([to] if is_left_out else [], errors="ignore"), layout)

        def flagged(name: str, _: Any) -> xr.Dataset:
            # the line is surveyed when its turn comes
            return stored(_with_flags(products[name], name) if flags else products[name])

        def announced(name: str) -> str:
            lines = [group for group in aligned if ALONG_TRACK in aligned[group].dims]
            which = f"flight line {lines.index(name) + 1} of {len(lines)}" if name in lines else ""
            return which and f"{name}: {which}, {aligned[name].sizes[ALONG_TRACK]} scan lines\n"

        outcome = write_groups(
            out,
            groups,
            planned,
            opened.tree.attrs,
            source=opened.settings.path,
            command="process",
            options={
                "--to": None if to == "reflectance" else to,
                "--alignment": alignment,
                "--flags": flags,
                "--overwrite": overwrite,
                "--reflectance": None if reflectance == "stored" else reflectance,
                "--accept": sorted(accept),
                "--codec": None if codec == DEFAULT_CODEC else codec,
                "--layout": {"cube": None}.get(layout, layout),
            },
            only=("flightlines/", "this collect"),
            from_stored=flagged,
            announce=announced if progress else None,
            overwrite=overwrite,
            codec=codec,
            client=client,
        )
    import zarr

    # warn of flags that more than `MANY_FLAGGED` of the pixels of a stored line have
    line_names = (name for name, line in aligned.items() if ALONG_TRACK in line.dims)
    for name in (name for name in line_names if (out / name / "quality").exists()):
        quality = zarr.open_array(os.fspath(out / name / "quality"), mode="r", zarr_format=3)
        shares: Counter[str] = Counter()
        for start in range(0, quality.shape[0], _LINES_A_READ):
            # every scene has shadows and edges
            values = np.asarray(quality[start : start + _LINES_A_READ]) & ~np.uint16(flags_set_from("scene"))
            part = values.size / quality.size
            shares.update({str(flag.name): part * share for flag, share in flag_shares(values).items()})
        if marked := [f"{100 * n:.0f} % {flag.lower()}" for flag, n in shares.items() if n > MANY_FLAGGED]:
            message = (
                f"{name}: many pixels are flagged: {', '.join(marked)}; check these flags before using values"
            )
            warn_user(message, "pixels-flagged")
    return dataclasses.replace(outcome, corrected=corrections_of(aligned))


# --- groups to write ---------------------------------------------------------------------------------------


def opened_groups(
    collect: str | Path | Collect, lines: int, parameters: Mapping[str, Any]
) -> tuple[OpenedCollect, dict[str, xr.Dataset]]:
    # Open a collect with ``lines`` lines per task; return it, and its groups with their digests.
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
        # version of the numerics, and a digest of all settings
        parts = [FORMAT_VERSION, NUMERICS_VERSION, KEPT_BITS, line_parameters if name in cubes else {}]
        settings = f"numerics={NUMERICS_VERSION} digest={digest_of(parts)[:32]}"
        groups[name] = dataset.assign_attrs(
            {INPUTS: inputs_digest(dataset, cubes.get(name, ()), settings), SETTINGS: settings}
        )
    return opened, groups


def corrections_of(lines: Mapping[str, xr.Dataset]) -> dict[str, str]:
    # Return the applied corrections between camera and irradiance record, by the group of the line.
    return {
        name: str(line.attrs["alignment"])
        for name, line in lines.items()
        if line.attrs.get("alignment_state") == "applied"
    }


def aligned_group(dataset: xr.Dataset, name: str, to: Product, apply: Any) -> xr.Dataset:
    # Return a flight line after `hyperpaint.alignment.align`; other groups unchanged.
    is_aligned = to != "radiance" and name.startswith("flightlines/") and not has_white(dataset)
    return align(dataset, apply=apply) if is_aligned else dataset


def _with_flags(line: xr.Dataset, name: str) -> xr.Dataset:
    # Return a flight line with the flags of its scene, or unchanged with a warning where detection fails.
    if ALONG_TRACK not in line.dims or is_lamp_lit(line):
        return line
    try:
        with survey_planned(line, f"the survey of {name}"):
            flagged = flag_line(line)
    except PaintError as error:
        warn_user(f"{name} has no flags of glint and shadow: {error}", "flags-missing")
        return line
    # segments are numbers of the model, which is not stored
    return flagged.line.drop_vars("adjacency_segment")


def _product(dataset: xr.Dataset, name: str, to: Product) -> xr.Dataset:
    if not name.startswith("flightlines/"):
        return dataset
    if to == "radiance":
        product: xr.Dataset = dataset.paint.radiance()
        return product
    product = dataset.paint.reflectance(keep_bits=KEPT_BITS, panel=declared_panels(dataset) or None)
    product["reflectance"].attrs["keep_bits"] = KEPT_BITS
    split = split_of_lines(dataset)
    if split is not None:
        product = product.assign(split.data_vars)
    pictures = {"overview": overview(product), "coarse_reflectance": coarse_reflectance(product)}
    return product.assign({key: picture for key, picture in pictures.items() if picture is not None})


# --- where it is computed ----------------------------------------------------------------------------------


def demand_of(
    groups: Mapping[str, xr.Dataset], lines: int, client: "Client | None", limit: int | None
) -> Demand:
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
    # Result of `compare_inputs`.
    collect: Path  #: The ``collect.toml`` that was opened.
    blocks: int  #: Blocks of cubes that were read.
    problems: tuple[str, ...]  #: Inputs that differ, one line each; empty if all are unchanged.

    def __str__(self) -> str:
        state = f"{len(self.problems)} differ" if self.problems else "all unchanged"
        return "\n  ".join(
            [f"inputs of {self.collect}: {self.blocks} blocks of cubes, {state}", *self.problems]
        )


def compare_inputs(store: Path, collect: Path | None = None) -> InputReport:
    # Read all inputs of a store and compare them with the store's record of its inputs.
    #
    # Cubes are compared with the checksums of the stored samples, block by block; other files by their
    # values. ``collect``: present path of the ``collect.toml``; by default the path recorded in the store.
    #
    # Raises `StoreError` if `process` did not write the store, or the ``collect.toml`` is not found;
    # `CollectError` if the collect, or one of its files, cannot be opened.
    location = Location.of(store)
    manifest = Manifest.read(location)
    try:
        command = shlex.split(manifest.command) if manifest is not None else []
    except ValueError:  # unbalanced quotes, which hyperpaint does not write
        command = []
    StoreError.raise_if(
        command[:2] != ["hyperpaint", "process"] or len(command) < 3,
        f"{location.url} was not written by hyperpaint process and has no record of inputs",
        code="inputs-unrecorded",
    )
    source = as_path(command[2] if collect is None else collect)
    StoreError.raise_if(
        not source.is_file(),
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

    yield from filter(None, on_workers(block_problem, range(0, cube.sizes[ALONG_TRACK], CHUNK_LINES)))


_COPYING = SimpleNamespace(
    #: Maximum share of a cube that is copied [1]; beyond it, processing the collect is better.
    max_copied_share=0.1,
    min_copied_slabs=4,  # number of slabs that may always be copied
)

_INCOMPLETE = "and incomplete"


def virtualise(
    collect: str | Path,
    out: str | Path,
    *,
    alignment: Alignment | None = None,
    accept: Collection[str] = (),
    overwrite: bool = False,
) -> Outcome:
    """Write a store of flight lines that refers to the raw cubes and holds all variables that calibrate them.

    ``.paint.reflectance()`` of `hyperpaint.io.open_virtual` is bit for bit that of the counts stored by
    `hyperpaint.process`. The collect is opened, checked and aligned as by `process`; of cubes only the lines
    needed for this are read.

    A slab of 8 to 64 lines is a contiguous range of bytes in its file. Other slabs are copied into the store:
    incomplete last slabs of a cube, slabs that span two cubes, and slabs with lost frames.

    Parameters
    ----------
    collect
        A ``collect.toml``; see `hyperpaint.open_collect`.
    out
        A folder, for a repository of icechunk.
    alignment, accept
        See `hyperpaint.process`.
    overwrite
        Replace a virtual store of other inputs, once the new store is complete. An incomplete store of the
        same inputs is always written again.

    Returns
    -------
    Outcome
        The store, and its groups.

    Raises
    ------
    CollectError, SchemaError
        As `hyperpaint.process`.
    FormatError
        Slabs of a cube are not contiguous (``bsq``), its samples are not uint16 counts, or too many slabs
        would be copied; all lines are listed.
    StoreError
        ``out`` exists with other inputs, contains inputs, or has the suffix of kerchunk references; or files
        below ``prefix`` differ from the local files.
    MissingExtraError
        icechunk is not installed.

    Examples
    --------
    >>> virtualise("collect.toml", "lot.icechunk").path                               # doctest: +SKIP
    """
    StoreError.raise_if(
        url_of(out) is not None,
        f"virtual writes to a folder, not to {os.fspath(out)!r}",
        mend="write to a folder, and copy it",
        code="output-is-url",
    )
    out = Path(out)
    refuse_kerchunk(out, write=True)
    opened, tree = opened_groups(
        collect, 32, {"to": "reflectance", "reflectance": "none", "alignment": alignment}
    )
    refuse_to_write_over(out, (opened.settings, list(opened.cubes.values())), "virtual")
    lines = {name: tree[name] for name in opened.cubes}
    cubes = _cubes(opened, lines)
    if out.exists():
        # difference of the existing store from the collect, in words; empty if there is none
        difference, summary = "", summary_of({name: (line, cubes[name]) for name, line in lines.items()})
        try:
            if not is_virtual(out):
                difference = "and is not a virtual store"
            elif virtual_groups(out) != summary:
                difference = "from other inputs"
        except StoreError as error:
            difference = f"and cannot be read ({error})"
        if not difference:
            # allow access only to the files of the collect, not to places named in the store
            allow = [file.url for cube in cubes.values() for file in cube.files]
            try:
                for name in summary:
                    open_virtual(out, name, allow=allow)
            except StoreError:
                difference = _INCOMPLETE
        if not difference:
            staging_area = Staging(out.absolute())
            if staging_area.folder.exists():  # leftovers of a run killed at its end
                with contextlib.suppress(StoreError), staging(staging_area.store):
                    pass
            return Outcome(out, (), tuple(lines))
        StoreError.raise_if(
            difference != _INCOMPLETE and not (overwrite and is_virtual(out)),
            f"{out} exists, {difference}",
            mend="pass overwrite=True, which replaces a virtual store, or choose another path"
            if is_virtual(out)
            else "move it away, or choose another path",
            option="pass --overwrite, which replaces a virtual store, or choose another --out"
            if is_virtual(out)
            else "move it away, or choose another --out",
            code="store-exists",
        )
    accepted = refuse_findings(opened, lines, accept, lit=True)
    apply = alignment or opened.settings.alignment
    groups = {}
    for name, line in lines.items():
        # all variables except the cube, in memory
        aligned = aligned_group(line, name, "reflectance", apply)
        companions = aligned.drop_vars("counts")
        if panels := declared_panels(aligned):
            product = aligned.paint.reflectance(panel=panels)
            companions = companions.assign(
                {variable: product[variable] for variable in product if str(variable).startswith("panel_")}
            )
        split = split_of_lines(aligned)
        companions = (companions if split is None else companions.assign(split.data_vars)).compute()
        companions.attrs.pop(SETTINGS, None)
        groups[name] = companions.assign_attrs(accepted.get(name, {})), cubes[name]
    attrs = {str(key): value for key, value in opened.tree.attrs.items()}
    with published_folder(
        out, overwrite=True, foreign=lambda folder: "" if is_virtual(folder) else "other files"
    ) as folder:
        write_icechunk(folder, groups, attrs)
    return Outcome(
        out, tuple(groups), (), corrections_of({name: companions for name, (companions, _) in groups.items()})
    )


def _cubes(opened: OpenedCollect, lines: Mapping[str, xr.Dataset]) -> dict[str, VirtualCube]:
    # references to the slabs in the raw files, by group
    entries = {str(entry.name): entry for entry in opened.settings.flightlines}
    problems = Problems(f"{opened.settings.path}: cubes cannot be referred to", FormatError)
    cubes = {}
    for name, line in lines.items():
        with problems.noting((FormatError, StoreError), f"/{name}"):
            arrays = []
            for entry in map(entries.__getitem__, opened.members[name]):
                # already given when the collect was opened
                with warnings.catch_warnings(action="ignore", category=PaintWarning):
                    dataset = open_envi(entry.path, keep_whole_lines=entry.keep_whole_lines, unsaid="counts")
                lazy: Any = next(iter(dataset.data_vars.values())).variable._data
                array = lazy.array
                FormatError.raise_if(
                    not isinstance(array, EnviArray) or array.scaling is not None or array.dtype != np.uint16,
                    f"{Path(entry.path).name}: samples are {array.dtype.name}, or scaled",
                    expected="raw counts, uint16 (ENVI data type 12)",
                    mend="process the collect instead",
                    code="counts-not-raw",
                )
                arrays.append(array)
            urls = (url_of(array.path) or f"file://{os.path.realpath(array.path)}" for array in arrays)
            files = tuple(map(RawFile.of, urls))
            cubes[name] = _cube(line, arrays, files)
    problems.raise_if_any()
    return cubes


def _cube(line: xr.Dataset, arrays: list[EnviArray], files: tuple[RawFile, ...]) -> VirtualCube:

    first_array = arrays[0]
    interleave = {(0, 1, 2): "bil", (0, 2, 1): "bip"}.get(first_array.axes)
    if interleave is None or len({(array.axes, array.file_shape[1:], array.stored) for array in arrays}) > 1:
        problem = (
            "bsq: a slab of lines is not contiguous in the file"
            if interleave is None
            else "cubes of several layouts"
        )
        raise FormatError(
            problem,
            expected="bil or bip, the same in all cubes",
            mend="process the collect instead",
            code="interleave-unsupported",
        )
    dims = FILE_DIMS[interleave]
    ends = list(itertools.accumulate(array.file_shape[0] for array in arrays))
    count = line.sizes[ALONG_TRACK]
    FormatError.raise_if(
        ends[-1] != count,
        f"{count} lines, and {ends[-1]} in the files: frames were lost between the cubes",
        mend="process the collect instead",
        code="frames-lost",
    )
    lines = slab_lines(ends)
    width = first_array.file_shape[1] * first_array.file_shape[2] * first_array.stored.itemsize
    lost_slabs = np.flatnonzero(np.isnat(line["time"].values)) // lines
    slabs: list[tuple[int, int, int]] = []
    for number, (start, end) in enumerate(itertools.pairwise([0, *ends])):
        first_slab, end_slab = -(-start // lines), end // lines  # slabs that are completely in this file
        offsets = slab_offsets(
            lines, first_slab * lines - start, end_slab - first_slab, arrays[number].offset, width
        )
        slabs += [
            (slab, number, offset)
            for slab, offset in zip(range(first_slab, end_slab), offsets.tolist(), strict=True)
            if slab not in lost_slabs
        ]
    total = -(-count // lines)
    copied = sorted(set(range(total)) - {slab for slab, _, _ in slabs})
    FormatError.raise_if(
        len(copied) > max(_COPYING.min_copied_slabs, _COPYING.max_copied_share * total),
        f"{len(copied)} of {total} slabs have lost frames or span two cubes, and would be copied",
        expected=f"at most {_COPYING.max_copied_share:.0%}",
        mend="process the collect instead",
        code="slabs-copied",
    )
    cube = line["counts"].transpose(*dims)
    copies = {slab: cube[slab * lines : (slab + 1) * lines].values for slab in copied}
    attrs = {key: value for key, value in cube.attrs.items() if isinstance(value, str | int | float | list)}
    return VirtualCube(
        "counts", dims, cube.shape, lines, first_array.stored, attrs, files, tuple(slabs), copies
    )
