"""The command ``hyperpaint run``: a whole field day."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import click

from hyperpaint.base.constants import ALIGNMENTS

from .console import EXISTING, EXISTING_FILE, FAILED_CHECK, FOLDER, WRONG_INPUT, is_watched, progress_bar


@click.command(
    short_help="Do all that a field day asks for: store, paints, validation, maps, report.",
    epilog="""\b
Examples:
  hyperpaint run 2021_07_20
  hyperpaint run collect.toml --regions cars.geojson --out products
  hyperpaint run collect.toml --skip map --skip dirsig

\b
Maps need the height of the ground [m above the ellipsoid] in collect.toml: [geometry] ground = 152.4""",
)
@click.argument("collect", metavar="COLLECT.toml", type=EXISTING)
@click.option(
    "--out", metavar="DIR", type=FOLDER,
    help="Folder of the products.  [default: products beside COLLECT.toml]",
)  # fmt: skip
@click.option(
    "--regions", metavar="R.geojson", type=EXISTING_FILE,
    help="Regions of paint.  [default: regions.geojson beside COLLECT.toml, else proposed by rule]",
)  # fmt: skip
@click.option(
    "--skip", multiple=True,
    type=click.Choice(["signatures", "validate", "map", "mosaic", "dirsig", "report"]),
    help="Leave out this step; may be given several times.",
)  # fmt: skip
@click.option(
    "--specular-sky", is_flag=True,
    help="Subtract the sky that clear coats mirror, which contact probes do not see.",
)  # fmt: skip
@click.option(
    "--alignment", type=click.Choice(ALIGNMENTS),
    help="Correct what separates camera and irradiance record in wavelength and width. 'auto': where "
    "significant; 'never': report only; 'always': whenever it can be found.  [default: as [alignment] apply "
    "of COLLECT.toml, else auto]",
)  # fmt: skip
@click.option(
    "--accept", metavar="NAME", multiple=True,
    help="Go on with this finding of `hyperpaint check`; may be given several times.",
)  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace a store made from other inputs.")
@click.option("--quiet", is_flag=True, help="No progress bars.")
@click.pass_context
def run(ctx: click.Context, /, collect: Path, quiet: bool, **options: Any) -> None:
    """Do all that a field day asks for, from the instruments' files to the report.

    Processes the collect, flags it, makes signatures of regions, compares them with the references, writes a
    map of each line that has navigation and one of all of them, DIRSIG materials and a report. A step whose
    inputs have not changed is left as it is: an interrupted run goes on where it ended. Exit status 1 where
    the validation fails.
    """
    from hyperpaint.workflows.field_day import StepOutcome, run_field_day

    with contextlib.ExitStack() as bars:

        def progress(step: str) -> Any:
            return bars.enter_context(progress_bar(step, True))

        def say(outcome: StepOutcome) -> None:
            bars.close()
            text = "see below" if outcome.state == "failed" else outcome.text
            click.echo(f"{outcome.step:<10}  {outcome.state:<9}  {text}")

        watched = is_watched(quiet)
        day = run_field_day(collect, progress=progress if watched else None, say=say, **options)
    for error in day.errors:
        click.echo(f"error: {error.text(on_command_line=True)}", err=True)
    report = day.out / "report.html"
    if report.exists():
        click.echo(f"look at {report}")
    if day.errors:
        ctx.exit(WRONG_INPUT)
    if day.passed is False:
        ctx.exit(FAILED_CHECK)
