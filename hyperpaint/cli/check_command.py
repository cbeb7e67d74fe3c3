"""The command ``hyperpaint check``: whether the inputs of a collect can be true."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click

from .console import EXISTING_FILE, FAILED_CHECK


def _list_kinds(ctx: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    from hyperpaint.plausibility import KINDS

    if wanted and not ctx.resilient_parsing:
        for kind in KINDS.values():
            click.echo(f"{kind.name}  ({'refused' if kind.refused else 'warned of'})")
            for text in (kind.meaning, kind.mend):
                click.echo(textwrap.fill(text, 100, initial_indent="    ", subsequent_indent="    "))
        ctx.exit()


@click.command(
    short_help="Can the inputs of a collect be true?",
    epilog="""\b
Examples:
  hyperpaint check collect.toml
  hyperpaint check --list                             every finding there may be, by name""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@click.option(
    "--list", is_flag=True, is_eager=True, expose_value=False, callback=_list_kinds,
    help="Name every finding that there may be, and stop.",
)  # fmt: skip
@click.pass_context
def check(ctx: click.Context, /, collect: Path, **_options: Any) -> None:
    """Judge what a collect names by the pictures and records themselves, in seconds.

    Shown is every finding of every line: its name, what was found, what was expected, and what to mend.
    process and run do the same first: they stop where results would be wrong, and warn of the rest; --accept
    NAME lets them go on. Exit status 0 where nothing was found, 1 where something was.
    """
    from hyperpaint.workflows.collect_check import check_collect

    findings = check_collect(collect)
    for finding in findings:
        click.echo(f"{'wrong' if finding.kind.refused else 'doubtful'}: {finding}")
    if findings:
        ctx.exit(FAILED_CHECK)
    click.echo(f"{collect}: nothing found")
