"""The command line: ``hyperpaint`` or ``python -m hyperpaint``.

Thin: options in, one function of the package, text out; a file a command, loaded when it is asked for.
What is heavy is imported inside a command.

Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong, 130 stopped by Ctrl-C, 143 by
SIGTERM.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import warnings
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import click

from hyperpaint import __version__
from hyperpaint.base.errors import PaintError, PaintWarning

from .console import SIGNALLED, WRONG_INPUT, is_watched

COMMANDS = {
    **{name: name for name in ("calibrate", "check", "croissant", "demo", "export", "follow", "info")},
    **{name: name for name in ("init", "process", "render", "run", "simulate", "site", "validate", "verify")},
    "detect": "detect_paints", "mosaic": "make_mosaic", "orthorectify": "make_map",
    "paints": "list_paints", "report": "make_report", "signatures": "make_signatures",
    "check-library": "check_library", "virtual": "virtual",
    "view": "view", "warm": "warm",
}  # fmt: skip
"""Every command, with the name of its function in ``<command>_command.py``."""


RESUMED = ("follow", "process", "render", "run")
"""Commands that, stopped and called again, go on from what is finished."""


class Program(click.Group):
    """A group of commands, each in a file of its own that is loaded when the command is asked for.

    Their errors are one readable message, and their warnings are one line each; so is what Ctrl-C says.
    """

    def list_commands(self, _ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, _ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of that name, from its own file."""
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f".{cmd_name.replace('-', '_')}_command", __package__)
        command: click.Command = getattr(module, COMMANDS[cmd_name])
        return command

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that the context names."""
        with _short_warnings(), _stopped_by_signals():
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt as stop:
                number = next((each for each in stop.args if isinstance(each, int)), signal.SIGINT)
                if is_watched(quiet=False):  # the line of a progress bar ends here
                    click.echo(err=True)
                text = f"stopped by {signal.Signals(number).name}"
                if ctx.invoked_subcommand in RESUMED:
                    text += ": what is finished stays, and the same command goes on from there"
                click.echo(text, err=True)
                ctx.exit(SIGNALLED + number)
            except (PaintError, OSError) as error:
                texts = (
                    [error.text(on_command_line=True), *error.notes(on_command_line=True)]
                    if isinstance(error, PaintError)
                    else [str(error)]
                )
                click.echo("error: " + "\n".join(texts), err=True)
                ctx.exit(WRONG_INPUT)


@contextlib.contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end a command in order, once; a second one ends the process where it is."""
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, _: Any) -> None:
        for each in caught:
            signal.signal(each, signal.SIG_DFL)
        raise KeyboardInterrupt(number)

    # what a shell or nohup told to ignore a signal goes on ignoring it
    caught = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    try:
        for number in caught:
            signal.signal(number, stop)
        yield
    finally:
        for number in caught:
            signal.signal(number, before[number])


@contextlib.contextmanager
def _short_warnings() -> Iterator[None]:
    """Print each of hyperpaint's own warnings once, without Python's file and line."""
    seen: set[str] = set()
    with warnings.catch_warnings():
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if not issubclass(category, PaintWarning):
                otherwise(message, category, *where, **more)
            elif str(message) not in seen:
                seen.add(str(message))
                click.echo(f"warning: {message}", err=True)

        warnings.showwarning = show
        warnings.simplefilter("always", PaintWarning)
        yield


@click.group(
    cls=Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
    epilog="""\b
Examples:
  hyperpaint demo                                     see the whole chain on a simulated collect
  hyperpaint init 2021_07_20                          a commented collect.toml of what lies in a folder
  hyperpaint run 2021_07_20                           all of it: store, paints, validation, maps, report

\b
Step by step:
  hyperpaint info flight/raw_0.hdr                    what is this file?
  hyperpaint info collect.toml                        does everything open, and what would be done?
  hyperpaint check collect.toml                       can what it names be true?
  hyperpaint calibrate sweep.zarr                     a lab sweep to a calibration
  hyperpaint process collect.toml --out lot.zarr      raw counts to calibrated reflectance
  hyperpaint virtual collect.toml --out lot.icechunk  the same without copying the raw cubes
  hyperpaint verify lot.zarr                          is every chunk of it there and right?
  hyperpaint orthorectify lot.zarr --ground 152.4 --out map.tif   a map (see its --help for the camera)
  hyperpaint mosaic lot.zarr --out mosaic.tif         all its lines on one map
  hyperpaint signatures lot.zarr --regions cars.geojson --out paints.zarr
  hyperpaint validate paints.zarr --reference 'svc/*.sig'
  hyperpaint export paints.zarr --format dirsig --out dirsig
  hyperpaint paints --colour red                      red ones of the synthetic starter library
  hyperpaint detect lot.zarr --library wanted.zarr    which pixels show these paints?
  hyperpaint report lot.zarr --out report.html        all of it on one page
  hyperpaint view lot.zarr                            look at it with the mouse
  hyperpaint site lot.zarr --out page                 the same for any web server: click for spectra
  hyperpaint render --example > scene.toml            a synthetic scene to begin with
  hyperpaint render scene.toml                        its cubes, with what is true of every pixel
  hyperpaint croissant scene.zarr --licence CC0-1.0   the metadata that machine-learning tools read

\b
Then, in Python:
  import xarray as xr, hyperpaint
  line = xr.open_zarr("lot.zarr", group="flightlines/raw_0")
  line.paint.reflectance()                            lazy, from the stored counts
  line.paint.quicklook("line.png")

\b
Commands and options are completed by the shell, after this in its start file:
  eval "$(_HYPERPAINT_COMPLETE=bash_source hyperpaint)"     zsh_source for zsh

Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong, 130 stopped by Ctrl-C,
143 by SIGTERM; process, run and render then go on from what is finished.""",
)
@click.version_option(__version__, prog_name="hyperpaint")
def main() -> None:
    """Turn the raw counts of a pushbroom camera into calibrated reflectance, in labelled xarray."""
