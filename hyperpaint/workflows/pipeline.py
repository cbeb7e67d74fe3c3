"""Processing of a collect: from the files of the instruments to a store.

Inputs are checked before processing (`collect_check`), recorded in the store as digests, protected from being
overwritten, and compared with the store later (`compare_inputs`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shlex
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import xarray as xr

from hyperpaint.alignment import align
from hyperpaint.base.constants import ALIGNMENTS, DEFAULT_CODEC, KEPT_BITS, NUMERICS_VERSION, Alignment
from hyperpaint.base.errors import (
    PaintError,
    Problems,
    SchemaError,
    StoreError,
    warn_user,
)
from hyperpaint.base.facts import documented, one_of
from hyperpaint.base.schema import ALONG_TRACK, CHUNK_LINES, FORMAT_VERSION, flag_shares, flags_set_from
from hyperpaint.io.envi.envi_cubes import find_pair, read_header
from hyperpaint.io.files.reading import sampled_digest
from hyperpaint.io.store import budget, open_group
from hyperpaint.io.store.budget import limited_threads, parse_size
from hyperpaint.io.store.computing import errors_of_the_cluster
from hyperpaint.io.store.layout import Codec, Layout, with_layout
from hyperpaint.io.store.manifest import INPUTS, SETTINGS, Location, Manifest, content_of
from hyperpaint.io.store.writer import check_codec
from hyperpaint.light.diffuse_record import split_of_lines
from hyperpaint.pictures.plot import overview
from hyperpaint.plausibility import KINDS
from hyperpaint.radiometry.panels import declared_panels
from hyperpaint.radiometry.pixel_reading import coarse_reflectance
from hyperpaint.radiometry.planning import has_white, is_lamp_lit
from hyperpaint.surroundings.flags import flag_line
from hyperpaint.surroundings.scratch import survey_planned

from .collect_check import refuse_findings
from .laboratory import opened_collect
from .products import Outcome, computing_on, digest_of, local_folder, refuse_to_write_over, write_groups

if TYPE_CHECKING:
    from distributed import Client

    from hyperpaint.io.collect.collect_toml import Collect, OpenedCollect
    from hyperpaint.io.store.budget import Demand


def inputs_digest(dataset: xr.Dataset, cubes: tuple[Path, ...], settings: str) -> str:
    # Return a digest of settings, of all values except cubes, and of samples of the cubes' files.
    import dask

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


def warn_of_flags(store: Path, lines: Iterable[str]) -> None:
    # Warn of flags that more than `MANY_FLAGGED` of the pixels of a stored line have.
    import zarr

    for name in (name for name in lines if (store / name / "quality").exists()):
        quality = zarr.open_array(store / name / "quality", mode="r", zarr_format=3)
        shares: Counter[str] = Counter()
        for start in range(0, quality.shape[0], _LINES_A_READ):
            # every scene has shadows and edges
            values = np.asarray(quality[start : start + _LINES_A_READ]) & ~np.uint16(flags_set_from("scene"))
            part = values.size / quality.size
            shares.update({str(flag.name): part * share for flag, share in flag_shares(values).items()})
        if flags := [f"{100 * n:.0f} % {flag.lower()}" for flag, n in shares.items() if n > MANY_FLAGGED]:
            message = f"{name}: many pixels are flagged: {', '.join(flags)}"
            mend = "check these flags before using values"
            warn_user(f"{message}; {mend}", "pixels-flagged")


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
    problems.add_if(
        flags and to == "radiance",
        "flags need reflectance",
        mend="leave out flags=True, or to='radiance'",
        option="leave out --flags, or --to radiance",
        code="option-conflict",
    )
    problems.raise_if_any()
    check_codec(codec)
    out = local_folder(out, "process")
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
            demand = _demand({name: groups[name] for name in pending}, lines_a_task, client, limit)
            stack.enter_context(limited_threads(demand.threads if client is None else None))
            sources = groups
            if demand.lines < lines_a_task:
                sources = opened_groups(opened.settings, demand.lines, parameters)[1]
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
            left_out = [to] if is_left_out else []
            return with_layout(product.drop_vars(left_out, errors="ignore"), layout)

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
    warn_of_flags(out, [name for name, line in aligned.items() if ALONG_TRACK in line.dims])
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
    product: xr.Dataset
    if to == "radiance":
        product = dataset.paint.radiance()
        return product
    product = dataset.paint.reflectance(keep_bits=KEPT_BITS, panel=declared_panels(dataset) or None)
    product["reflectance"].attrs["keep_bits"] = KEPT_BITS
    split = split_of_lines(dataset)
    if split is not None:
        product = product.assign(split.data_vars)
    pictures = {"overview": overview(product), "coarse_reflectance": coarse_reflectance(product)}
    return product.assign({key: picture for key, picture in pictures.items() if picture is not None})


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
    source = Path(command[2]) if collect is None else collect
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

    with ThreadPoolExecutor() as pool:
        yield from filter(None, pool.map(block_problem, range(0, cube.sizes[ALONG_TRACK], CHUNK_LINES)))
