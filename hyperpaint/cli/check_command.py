"""The command ``hyperpaint check``: whether the inputs of a collect are plausible."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import click

from .console import EXISTING_FILE, FAILED_CHECK
from .options import command


def _list_kinds(ctx: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    from hyperpaint.plausibility import KINDS

    if wanted and not ctx.resilient_parsing:
        for kind in KINDS.values():
            click.echo(f"{kind.name}  ({'refused' if kind.refused else 'warned of'})")
            for text in (kind.meaning, kind.mend):
                click.echo(textwrap.fill(text, 100, initial_indent="    ", subsequent_indent="    "))
        ctx.exit()


@command(
    epilog="""\b
Examples:
  hyperpaint check collect.toml
  hyperpaint check --list                             all possible findings by name""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING_FILE)
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_kinds,
    help="List all possible findings, and exit.",
)
@click.pass_context
def check(ctx: click.Context, /, collect: Path, **_options: Any) -> None:
    """Check whether the inputs of a collect are plausible, in seconds.

    Prints every finding: its name, the observed value, the expected value, and the remedy. process and run
    check the same first: they stop where results would be wrong, and warn of the rest; --accept FINDING
    continues. Exit status 1 where something was found.
    """
    from hyperpaint.workflows.collect_check import check_collect

    findings = check_collect(collect)
    for finding in findings:
        click.echo(f"{'wrong' if finding.kind.refused else 'doubtful'}: {finding}")
    if findings:
        ctx.exit(FAILED_CHECK)
    click.echo(f"{collect}: nothing found")
