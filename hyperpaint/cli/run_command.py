"""The command ``hyperpaint run``: a whole field day."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import click

from .console import EXISTING, EXISTING_FILE, FAILED_CHECK, FOLDER, WRONG_INPUT, is_watched, progress_bar
from .options import command, takes


@command(
    epilog="""\b
Examples:
  hyperpaint run 2021_07_20
  hyperpaint run collect.toml --regions cars.geojson --out products
  hyperpaint run collect.toml --skip map --skip dirsig

\b
Maps need the height of the ground [m above the ellipsoid] in collect.toml: [geometry] ground = 152.4""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING)
@takes(
    "workflows.field_day:run_field_day",
    without=["say"],
    out={"metavar": "DIR", "type": FOLDER},
    regions={"metavar": "R.geojson", "type": EXISTING_FILE},
    skip={
        "type": click.Choice(["signatures", "validate", "map", "mosaic", "dirsig", "report"]),
        "help": "Leave out this step; repeatable.",
    },
    specular_sky={"help": "Subtract the sky that clear coats mirror, which contact probes do not see."},
    alignment={"help": "Correct wavelengths between camera and record.  [default: as COLLECT.toml]"},
)
@click.pass_context
def run(ctx: click.Context, /, collect: Path, **options: Any) -> None:
    """Process a whole field day, from the instruments' files to the report.

    Writes the store, paint signatures, their comparison with the references, maps, a mosaic, DIRSIG materials
    and a report. A step whose inputs have not changed is not repeated, so that an interrupted run resumes.
    Exit status 1 where the validation fails.
    """
    from hyperpaint.workflows.field_day import StepOutcome, run_field_day

    with contextlib.ExitStack() as bars:

        def progress(step: str) -> Any:
            return bars.enter_context(progress_bar(step))

        def say(outcome: StepOutcome) -> None:
            bars.close()
            text = "see below" if outcome.state == "failed" else outcome.text
            click.echo(f"{outcome.step:<10}  {outcome.state:<9}  {text}")

        day = run_field_day(collect, progress=progress if is_watched() else None, say=say, **options)
    for error in day.errors:
        click.echo(f"error: {error.text(on_command_line=True)}", err=True)
    report = day.out / "report.html"
    if report.exists():
        click.echo(f"look at {report}")
    if day.errors:
        ctx.exit(WRONG_INPUT)
    if day.passed is False:
        ctx.exit(FAILED_CHECK)
