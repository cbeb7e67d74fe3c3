"""The command line: ``hyperpaint`` or ``python -m hyperpaint``.

Thin: options in, one function of the package, text out. The files of commands are loaded when needed.
Heavy modules are imported inside a command.

Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong, 130 stopped by Ctrl-C, 143 by
SIGTERM.
"""

import contextlib
import signal
import threading
import warnings
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import click

from hyperpaint import __version__
from hyperpaint.base import PaintError, PaintWarning

from .options import SIGNALLED, WRONG_INPUT, Command, is_watched, suggestion, unknown_option

#: Every command by its group, with one line of help.
GROUPS = {
    "Start": {
        "demo": "Simulate a collect, process it, compare with the truth.",
        "init": "Write a collect.toml from the files of a folder.",
        "run": "Process a whole field day: store, paints, maps, report.",
    },
    "Flight": {
        "info": "Describe a file, a collect or a store.",
        "check": "Check whether the inputs of a collect are plausible.",
        "process": "Process a collect into a store of reflectance.",
        "virtual": "Write a store that refers to the raw cubes.",
        "calibrate": "Turn a lab sweep into a calibration.",
        "orthorectify": "Resample a flight line to a map.",
        "mosaic": "Combine flight lines on one map.",
    },
    "Paints": {
        "signatures": "Extract paint signatures from regions.",
        "validate": "Compare signatures with field spectrometers.",
        "detect": "Find the paints of a library in a store.",
        "paints": "List, search and save paints of a library.",
        "check-library": "Check a library against its specification.",
        "export": "Export a library for DIRSIG, ENVI and others.",
    },
    "Scenes": {
        "simulate": "Write a simulated collect with known truth.",
        "render": "Render a synthetic scene under atmospheres.",
    },
    "Look": {
        "view": "Explore a store in a browser.",
        "report": "Write one page about a store.",
        "site": "Write a page about a store for any web server.",
    },
    "Care": {
        "verify": "Check every chunk of a store.",
    },
}

#: Commands that resume an interrupted run.
RESUMED = ("process", "render", "run")

#: Options of the program that have a value.
_WITH_VALUE = ("--memory-limit", "--scheduler")

#: Commands that plan their memory, also without ``--memory-limit``.
PLANNED = ("detect", "mosaic", "orthorectify", "render", "report", "signatures", "site")


class Program(click.Group):
    # Commands in groups; their file is loaded when one of them is called.
    #
    # Errors are one message, warnings one line each. Options of the program may stand before or after the
    # name of the command.
    def list_commands(self, _ctx: click.Context) -> list[str]:
        # Return the names of all commands, group by group.
        return [name for commands in GROUPS.values() for name in commands]

    def get_command(self, _ctx: click.Context, cmd_name: str) -> click.Command | None:
        # Return a command, imported from its file; None for an unknown name.
        if cmd_name not in self.list_commands(_ctx):
            return None
        file = "info_command" if cmd_name == "info" else "commands"
        values = vars(import_module(f".{file}", __package__)).values()
        return next(value for value in values if isinstance(value, Command) and value.name == cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        # Return the command that the arguments name; for an unknown name, suggest the most similar.
        if args and args[0] not in self.list_commands(ctx) and not args[0].startswith("-"):
            help_text = " hyperpaint --help lists the commands."
            ctx.fail(f"No such command {args[0]!r}.{suggestion(args[0], self.list_commands(ctx), help_text)}")
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Parse the arguments, with the options of the program moved to the front.
        program_options: list[str] = []
        command_arguments = list(args)
        end = command_arguments.index("--") if "--" in command_arguments else len(command_arguments)
        for index in reversed(range(end)):
            word = command_arguments[index]
            if word == "--quiet" or word.startswith(tuple(f"{option}=" for option in _WITH_VALUE)):
                program_options.append(command_arguments.pop(index))
            elif word in _WITH_VALUE:
                program_options += command_arguments[index : index + 2]
                del command_arguments[index : index + 2]
        try:
            return super().parse_args(ctx, [*program_options, *command_arguments])
        except click.NoSuchOption as error:
            raise unknown_option(error, ctx) from error

    def format_commands(self, _ctx: click.Context, formatter: click.HelpFormatter) -> None:
        # Write one line for every command, group by group.
        with formatter.section("Commands"):
            for group, commands in GROUPS.items():
                for number, (name, text) in enumerate(commands.items()):
                    formatter.write(f"  {'' if number else group:<8}{name:<15}{text}\n")

    def invoke(self, ctx: click.Context) -> Any:
        # Run the command that the context names.
        with _short_warnings(), _stopped_by_signals():
            try:
                if ctx.params["scheduler"] is None:
                    return super().invoke(ctx)
                from hyperpaint.io.store import errors_of_the_cluster

                with errors_of_the_cluster("cannot compute on the cluster"):
                    return super().invoke(ctx)
            except KeyboardInterrupt as stop:
                number = next((value for value in stop.args if isinstance(value, int)), signal.SIGINT)
                if is_watched():  # ends the progress bar
                    click.echo(err=True)
                text = f"stopped by {signal.Signals(number).name}"
                if ctx.invoked_subcommand in RESUMED:
                    text += ": finished products are kept, and the same command resumes"
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
    # the first Ctrl-C or SIGTERM ends the command in order; a second signal kills the process
    if threading.current_thread() is not threading.main_thread():  # only the main thread can handle signals
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, _: Any) -> None:
        for caught_number in caught:
            signal.signal(caught_number, signal.SIG_DFL)
        raise KeyboardInterrupt(number)

    # a signal that a shell or nohup ignores stays ignored
    caught = [number for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)]
    try:
        for number in caught:
            signal.signal(number, stop)
        yield
    finally:
        for number in caught:
            signal.signal(number, handlers[number])


@contextlib.contextmanager
def _short_warnings() -> Iterator[None]:
    # show every warning once, without file and line
    shown_messages: set[str] = set()
    with warnings.catch_warnings(action="always", category=PaintWarning):
        default_show = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *location: Any, **options: Any) -> None:
            if not issubclass(category, PaintWarning):
                default_show(message, category, *location, **options)
            elif str(message) not in shown_messages:
                shown_messages.add(str(message))
                click.echo(f"warning: {message}", err=True)

        warnings.showwarning = show
        yield


@click.group(
    cls=Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
    epilog="""\b
Begin with hyperpaint demo or hyperpaint init FOLDER; hyperpaint COMMAND --help has examples.
Completion (bash, or zsh_source): eval "$(_HYPERPAINT_COMPLETE=bash_source hyperpaint)"
Exit status: 0 done, 1 the data fail a check, 2 the call or an input is wrong,
130 Ctrl-C, 143 SIGTERM.""",
)
@click.option("--quiet", is_flag=True, help="No progress bar.")
@click.option("--memory-limit", metavar="SIZE", help="Maximum memory, such as '2 GiB'.  [default: 80 %]")
@click.option("--scheduler", metavar="ADDRESS", help="Compute on this dask.distributed cluster.")
@click.version_option(__version__, prog_name="hyperpaint")
@click.pass_context
def main(ctx: click.Context, quiet: bool, memory_limit: str | None, scheduler: str | None) -> None:  # noqa: ARG001
    """Turn the raw counts of a pushbroom camera into calibrated reflectance."""
    if memory_limit is not None or ctx.invoked_subcommand in PLANNED:
        import zarr

        from hyperpaint.io.store import budget

        ctx.with_resource(budget.memory_limit(memory_limit))
        # each of zarr's threads keeps the memory of the largest chunk that it decoded
        ctx.with_resource(zarr.config.set({"threading.max_workers": budget.thread_count()}))
    if scheduler is not None:
        from hyperpaint.workflows.pipeline import computing_on

        ctx.with_resource(computing_on(scheduler))
