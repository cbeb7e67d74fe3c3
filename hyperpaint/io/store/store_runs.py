"""A run that writes several groups of one store: whole when all are there, and until then unfinished."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .budget import thread_space
from .disk import errors_of_the_system
from .group_writing import Job
from .groups import damaged_groups, groups_above, is_listed
from .layout import Codec
from .location import METADATA, Location
from .root_record import Member, check_set
from .stage import Staging, clear_up
from .writer import Turn, is_sealed, job_of, real_folder, refused_jobs

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["TakeUp", "WholeRun", "whole_run"]

TakeUp = Callable[[Staging, Job], None]
"""Called before a group is written: hands blocks of it over that were written elsewhere."""


class WholeRun:
    """Writes the groups of a run, each of which was named when it began; made by `whole_run`."""

    def __init__(
        self, turn: Turn | None, location: Location, members: Mapping[str, Member], *, overwrite: bool,
        codec: Codec, take_up: TakeUp | None = None,
    ) -> None:  # fmt: skip
        self._turn, self._location, self._members, self._overwrite = turn, location, members, overwrite
        self._codec, self._take_up = codec, take_up
        self._placer = _Placer()
        self._placing: dict[str, xr.Dataset] = {}

    def write(self, group: str, dataset: xr.Dataset, *, progress: bool = False) -> None:
        """Write a group; it gets its place while the next is written, see `settle`.

        Bars go to stderr, so that stdout holds results only.
        """
        assert self._turn is not None  # a run without pending groups writes none
        if self._placer.is_idle:  # what went wrong there is said before this one takes its time
            self.settle()
        job = job_of(group, dataset, self._members[group], self._codec)
        shown = contextlib.redirect_stdout(sys.stderr) if progress else contextlib.nullcontext()
        places = []
        with shown, errors_of_the_system(self._location, {group: dataset}):
            for each in refused_jobs([job], groups_above(group), self._location, overwrite=self._overwrite):
                if self._take_up is not None and self._turn.stage is not None:
                    self._take_up(self._turn.stage, each)
                places.append(self._turn.begin(each, progress=progress))
        self.settle()
        self._placing = {group: dataset}
        with errors_of_the_system(self._location, self._placing):
            for place in places:
                self._placer.submit(place)

    def settle(self) -> None:
        """Wait until every group is in its place; what went wrong with one is raised."""
        with errors_of_the_system(self._location, self._placing):
            self._placer.settle()

    def close(self) -> None:
        """Let nothing go on that still writes, whatever ended the run."""
        self._placer.close()


class _Placer:
    """Seals a group and puts it in its place while the next is written: in one thread, one at a time.

    Each group goes the same way as alone, its seal after its last chunk, its place after its seal, and groups
    share no file: a killed run leaves two groups at the most that are begun, each as if it were the only one.
    The root's record is sealed, and the lock of the store released, after all that.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "hyperpaint-place")
        self._running: Future[None] | None = None

    def submit(self, place: Callable[[], None]) -> None:
        """Place a group in the background; the one before must have been waited for."""
        if thread_space():  # a thread would take the room of one that computes
            place()
        else:
            self._running = self._pool.submit(place)

    @property
    def is_idle(self) -> bool:
        """Whether no group is being placed."""
        return self._running is None or self._running.done()

    def settle(self) -> None:
        """Wait for the group that is being placed; its error is raised here."""
        if self._running is not None:
            self._running.result()
            self._running = None

    def close(self) -> None:
        """Wait for it, through interruptions too, and end the thread; its error is noted in one under way."""
        ending, interruption = sys.exc_info()[1], None
        while self._running is not None and not self._running.done():
            try:
                wait([self._running])
            except BaseException as error:  # Ctrl-C: the lock must not be released under it
                interruption = error
        self._pool.shutdown()
        failure = None if self._running is None else self._running.exception()
        if failure is not None and ending is not None and failure is not ending:
            ending.add_note(f"before that, a group could not be put in its place: {failure}")
        if interruption is not None:
            raise interruption


@contextlib.contextmanager
def whole_run(
    path: Path, members: Mapping[str, Member], pending: Mapping[str, xr.Dataset], attrs: Mapping[Any, Any],
    *, command: str, overwrite: bool, codec: Codec = "compact", take_up: TakeUp | None = None,
) -> Iterator[WholeRun]:  # fmt: skip
    """Hold a store for a run, and seal it when that ends well; nothing is done where all is there.

    ``members``: every group of the run; ``pending``: those that it will write; ``attrs``: of the root;
    ``command``: finishes an interrupted run, with ``{store}`` in place of the path; ``codec``: of `to_store`;
    ``take_up``: see `TakeUp`.

    Raises `StoreError`: another writer is at work, or the store cannot be written. `IncompleteStoreError`:
    groups are lacking at the end, of this run or of another that was begun.
    """
    location = Location.of(path)
    above = list(dict.fromkeys(each for name in members for each in groups_above(name)))
    with contextlib.ExitStack() as stack:
        turn = None
        with errors_of_the_system(location, pending):
            done = not pending and not damaged_groups(above, location)
            sealed = done and is_sealed(members, location, overwrite=overwrite)
            if sealed and _is_listed(attrs, location):
                clear_up(real_folder(path))
            else:
                turn = stack.enter_context(
                    Turn.at(location, members, list(pending), above, command=command, overwrite=overwrite)
                )
        run = WholeRun(turn, location, members, overwrite=overwrite, codec=codec, take_up=take_up)
        with contextlib.closing(run):
            yield run
            run.settle()
        if turn is not None:
            with errors_of_the_system(location, pending):
                sealed = turn.finish({"": dict(attrs)})
            if not sealed:
                check_set(location)


def _is_listed(attrs: Mapping[Any, Any], location: Location) -> bool:
    """Tell whether the root has its attributes and a list of all metadata, which is written with the seal."""
    root = location.read_json("", METADATA) or {}
    return bool(root.get("consolidated_metadata")) and is_listed([], {"": dict(attrs)}, location)
