"""Children that are disturbed at work: by signals, at a call that changes files, or as common users."""

import ctypes
import itertools
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import PaintError

DONE, REFUSED, ENDED_AT_A_CALL = 0, 3, 9
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_START_S, _END_S = 120.0, 120.0
_CHANGES = ("os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.link", "os.truncate")
#: Children are forked by a server that has imported everything: they write within milliseconds.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "xarray",
        "dask.array",
        "zarr",
        "rasterio",
        "distributed",
        "hyperpaint",
        "hyperpaint.accessor",
        "hyperpaint.workflows.pipeline",
        "hyperpaint.workflows.laboratory",
        "hyperpaint.workflows.library_files",
        "hyperpaint.alignment",
        "hyperpaint.pictures.plot",
        "hyperpaint.io.store.writer",
        "hyperpaint.radiometry",
        "hyperpaint.kernels.radiometry",
        "hyperpaint.cli.program",
        "hyperpaint.report.static_site",
        "hyperpaint.report.store_report",
        "campaigns.faults.interruptions",
        "campaigns.faults.disks",
    ]
)


@dataclass(frozen=True)
class Fault:
    # What happens at a call that changes files: the process ends, or the call fails
    number: int
    code: int | None = None  # errno; None ends the process

    def arm(self, folder: Path) -> Iterator[int]:
        # Let it happen at a call of this process below a folder; return the counter of such calls
        counter = itertools.count(1)

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            if event == "open":
                _, mode, flags = arguments
                writes = os.O_CREAT | os.O_WRONLY | os.O_RDWR
                changes = bool(set(mode) & set("wax+")) if mode else bool(flags & writes)
            else:
                changes = event in _CHANGES
            if not changes or isinstance(arguments[0], int):
                return
            # folders are removed by names relative to a descriptor
            place = os.fsdecode(arguments[0])
            inside = place.startswith(os.fspath(folder)) or (event != "open" and not os.path.isabs(place))
            if inside and next(counter) == self.number:
                if self.code is None:
                    os._exit(ENDED_AT_A_CALL)
                raise OSError(self.code, os.strerror(self.code), place)

        sys.addaudithook(hook)
        return counter


def start(
    work: Callable[..., object],
    *arguments: Any,
    fault: Fault | None = None,
    folder: Path | None = None,
    common: bool = False,
) -> Any:
    # Start a child; return its process when it is at work
    # work, *arguments: What it does
    # fault, folder: What happens to it, below which folder; without a fault its calls there are counted
    # only
    # common: Let it heed permissions as a common user does
    receiver, sender = CONTEXT.Pipe(duplex=False)
    process = CONTEXT.Process(target=_run, args=(sender, fault, folder, common, work, *arguments))
    process.start()
    sender.close()
    if receiver.poll(_START_S):
        receiver.recv()
    process.report = receiver
    return process


def end_of(process: Any) -> tuple[int, str, int]:
    # Wait for a child; return its exit status, its error, and how many of its calls change files
    process.join(_END_S)
    if process.is_alive():
        process.kill()
        process.join()
    try:
        text, calls = process.report.recv()
    except EOFError:
        text, calls = "", 0
    process.report.close()
    return process.exitcode, text, calls


def _run(
    sender: Any,
    fault: Fault | None,
    folder: Path | None,
    common: bool,
    work: Callable[..., object],
    *arguments: Any,
) -> None:
    # Work; a signal is an exception, an error of hyperpaint a status of its own
    # Before the first message and after the end a signal would only meet the start and the end of
    # `multiprocessing`, which answers an interrupt there with a status of 1
    import dask

    if common:
        # permission bits hold for root; another user may not be able to read Python itself
        header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        if ctypes.CDLL(None, use_errno=True).capset(header, none):
            raise OSError(ctypes.get_errno(), "capset")
    for number in SIGNALS[1:]:
        signal.signal(number, lambda got, _: sys.exit(128 + got))
    sender.send("at work")
    counter = itertools.count(1) if folder is None else (fault or Fault(-1)).arm(folder)
    status, text = DONE, ""
    try:
        # one thread: the calls of two runs are the same
        with dask.config.set(scheduler="threads", num_workers=1):
            work(*arguments)
    except PaintError as error:
        status, text = REFUSED, str(error)
    except Exception:
        status, text = 1, traceback.format_exc()[-800:]
    for number in SIGNALS[1:]:
        signal.signal(number, signal.SIG_IGN)
    sender.send((text, next(counter) - 1))
    os._exit(status)
