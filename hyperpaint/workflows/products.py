"""One recipe for products: inputs, settings, function and output are declared; one engine makes them.

A product is a store, a file, several files, or a folder. Its declaration says what it is made from. The
engine decides by content whether it is current, refuses to replace content of other programs, makes it, and
reports. Every product is built beside its place and put there in one step, see
`hyperpaint.io.files.publishing`.

`write_groups` makes the groups of a store, `Record.produce` makes files and folders. The manifest of the
store, or the file of the record, says from which inputs an existing product was made.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import dask
import xarray as xr

from hyperpaint.base.constants import DEFAULT_CODEC, NUMERICS_VERSION
from hyperpaint.base.errors import CollectError, PaintError, Problems, StoreError, needs_extra
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.schema import ALONG_TRACK
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.store import is_complete
from hyperpaint.io.store.computing import RETRIES, client_in_force, errors_of_the_cluster, scheduler_in_force
from hyperpaint.io.store.layout import Codec
from hyperpaint.io.store.manifest import INPUTS, Location, Manifest, content_of, numerics_of
from hyperpaint.io.store.reader import check_above, groups_above, version_of_program
from hyperpaint.io.store.writer import WholeRun, check_room, run_contents, whole_run

if TYPE_CHECKING:
    from distributed import Client

#: A URL of fsspec, also one that was converted to a `Path`; not the letter of a drive.
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")


@dataclass(frozen=True)
class Outcome:
    # Groups that a run wrote or found complete.
    path: Path  #: The store.
    written: tuple[str, ...]  #: Groups that were written.
    unchanged: tuple[str, ...]  #: Groups that were complete, from the same inputs and parameters.
    #: Corrections between camera and irradiance record, by the group of the flight line.
    corrected: Mapping[str, str] = field(default_factory=dict)


def local_folder(out: str | Path, command: str) -> Path:
    # Return the store's folder; refuse a URL (`StoreError`).
    StoreError.raise_if(
        _URL.match(os.fspath(out)),
        f"{command} writes to a folder, not to {os.fspath(out)!r}",
        mend=f"{command} to a folder and copy it, or write the groups of open_collect with to_store, "
        "which accepts URLs (guide, 'Object stores')",
        code="output-is-url",
    )
    return Path(out)


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
    problems = Problems(
        f"{command} cannot write {out}, whether or not it may overwrite; choose another --out", StoreError
    )
    for path in dict.fromkeys(map(Path.resolve, paths_in(settings))):
        relation = "is" if output == path else "holds" if output in path.parents else "lies in"
        problems.add_if(
            relation != "lies in" or (path in output.parents and path.is_dir()),
            f"it {relation} {path}, an input",
            code="output-is-input",
        )
    problems.raise_if_any()


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
    client: Client | None = None,
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
    for name, dataset in products.items():
        if "quality" in dataset.variables:
            try:
                with errors_of_the_cluster(f"cannot compute the first lines of /{name}"):
                    dataset["quality"].isel({ALONG_TRACK: slice(0, 1)}).compute(
                        **({} if client is None else {"retries": RETRIES})
                    )
            except StoreError:  # a fault of the cluster, not of the data
                raise
            except (PaintError, OSError) as error:
                problems.add_error(f"/{name}", error)
    problems.raise_if_any()
    resumed = finishing_command(f"{command} {quote(str(Path(source).absolute()))}", options)
    with whole_run(
        out, run_contents(groups), products, attrs, command=resumed, overwrite=overwrite, codec=codec
    ) as turn:
        for name, dataset in products.items():
            if announce is not None and (line := announce(name)):
                sys.stderr.write(line)
            dataset = dataset if from_stored is None else from_stored(name, turn)
            turn.write(name, dataset, progress=announce is not None)
    return Outcome(out, tuple(products), tuple(complete))


# --- where it is computed ---

#: Time to wait for the first worker of a cluster [s].
WORKERS_WAIT = 60


@contextlib.contextmanager
def computing_on(address: str | None) -> Iterator[Client | None]:
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
            try:
                # not the default client: if no scheduler answers, it would remain the default, and later
                # computations wait
                client = stack.enter_context(Client(address, timeout="10s", set_as_default=False))
            except (OSError, ValueError, TimeoutError) as error:
                raise CollectError(
                    f"no dask scheduler answers at {address!r} ({error})",
                    expected="an address such as tcp://host:8786",
                    code="scheduler-unreachable",
                ) from error
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
    """File with checksums of the inputs and the files of products, by which the engine knows them again."""

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
        if entry == {"inputs": inputs, "products": states} and all(map(Path.exists, paths)):
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
        pattern = "zarr.json" if (path / "zarr.json").is_file() else "*"
        files = [path] if path.is_file() else sorted(filter(Path.is_file, path.rglob(pattern)))
        sums = []
        for file_path in files:
            with open(file_path, "rb") as file:
                digest = hashlib.file_digest(file, _HASH).hexdigest()
            sums.append((file_path.relative_to(path).as_posix(), digest))
        states[path.name] = f"{_HASH}:{digest_of(sums)}" if sums else ""
    return states
