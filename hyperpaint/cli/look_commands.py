"""The commands ``simulate``, ``render``, ``view``, ``report`` and ``site``."""

import webbrowser
from pathlib import Path
from typing import Any

import click

import hyperpaint as hp
import hyperpaint.workflows as workflows

from .options import (
    EXISTING,
    EXISTING_FILE,
    FILE,
    FOLDER,
    PLACE,
    beside,
    command,
    end_with_problems,
    is_watched,
    progress_bar,
    say_outcome,
    say_picture,
    settable,
    takes,
    without_none,
)


@command(
    renamed={"--sky": "--atmosphere", "--no-smile": "--set smile_nm=0"},
    epilog="""\b
Examples:
  hyperpaint simulate sim --lines 2000
  hyperpaint simulate sim --atmosphere near_sunset --samples 64
  hyperpaint simulate sim --set srf_shape=slit --set smile_nm=1.5 --set cloud=0.6,4,2 --set dropped=12
  hyperpaint simulate sim --scene checkerboard --set swath=5 --set wobble=rough
  hyperpaint simulate sim --set noise=no --set smile_nm=0 --seed 7 --overwrite""",
)
@click.argument("folder", metavar="DIR", type=FOLDER)
@takes(
    "simulation.collect:simulate_collect",
    only=["lines", "bands", "columns", "seed", "scene"],
    lines={"help": "Scan lines."},
    bands={"help": "Spectral bands."},
    columns={"help": "Columns."},
    scene={
        "type": click.Choice(["rendered", "plan", "checkerboard"]),
        "help": "A ray-traced car park, a flat picture, or squares of known corners.",
    },
)
@takes(
    "simulation.settings:SimulationSettings",
    only=["samples", "sky"],
    samples={"metavar": "N", "default": None, "help": "Rays a pixel of a rendered scene.  [default: 16]"},
    sky={
        "spelling": "--atmosphere",
        "type": click.Choice(["clear", "near_sunset", "overcast"]),
        "default": None,
        "help": "Light on the scene.  [default: clear]",
    },
)
@settable(
    {"simulation.settings:SimulationSettings": []},
    without=["lines", "bands", "columns", "seed", "scene", "samples", "sky", "quantise", "psf_kernel"],
)
@takes(
    "simulation.collect:simulate_collect",
    only=["truth", "sweep", "overwrite"],
    truth={"help": "Write truth.zarr."},
    sweep={"is_flag": True, "default": False, "help": "Write a lab sweep, named by collect.toml."},
)
def simulate(
    folder: Path, truth: bool, sweep: bool, overwrite: bool, settings: dict[str, Any], **options: Any
) -> None:
    """Write a simulated collect with known truth, in the instruments' own formats.

    DIR receives a Headwall folder (flight), a dark cube, ASD and SVC files, calibration.zarr, truth.zarr,
    regions.geojson (pure, sunlit pixels of the paints, for signatures --regions) and collect.toml. --set
    changes or switches off every effect of camera, light and instruments.
    """
    effects = {**without_none(options), **settings}
    if overwrite:
        workflows.demonstration.refuse_foreign(folder, overwrite=True)
    with progress_bar("simulating") as progress:
        path = hp.simulate_collect(
            folder,
            truth=truth,
            sweep={} if sweep else None,
            overwrite=overwrite,
            progress=progress,
            **effects,
        )
    click.echo(f"{path}\nprocess it with: hyperpaint process {path} --out lot.zarr")
    collect = hp.simulation.collect
    if not len(hp.read_regions(path.parent / collect.REGIONS)):
        side = collect.MIN_SIDE_PIXELS
        click.echo(
            f"note: {collect.REGIONS} has no region: no paint has a clean level area of {side} by {side} "
            "pixels; pass more --columns, or more --lines",
            err=True,
        )


def _print_example(ctx: click.Context, _: click.Parameter, is_set: bool) -> None:
    if is_set and not ctx.resilient_parsing:
        click.echo(workflows.rendering.example_scene(), nl=False)
        ctx.exit()


@command(
    renamed={"--paints": "--library"},
    epilog="""\b
Examples:
  hyperpaint render --example > scene.toml                       a car park as a start
  hyperpaint render scene.toml
  hyperpaint render scene.toml --out quick.zarr --samples 8      a first look
  hyperpaint render scene.toml --out scene.zarr --atmosphere noon --picture noon.png
  hyperpaint render scene.toml --library paints.zarr --out again.zarr     with paints of a flight

\b
Then, in Python:
  import xarray as xr, hyperpaint
  line = xr.open_zarr("scene.zarr", group="renders/noon")
  line.paint.reflectance()                                as a flight would recover it
  line.true_reflectance, line.surface_class, line.car_id  the truth
  traced = xr.open_zarr("scene.zarr", group="transport")
  traced.paint.relight(paints={"car_003": "red"}, atmosphere="cloudy")    no tracing again""",
)
@click.argument("scene", metavar="SCENE.toml", type=EXISTING_FILE)
@takes(
    "workflows.rendering:render_scene",
    out={
        "metavar": "SCENE.zarr",
        "type": PLACE,
        "required": False,
        "help": "The store.  [default: SCENE.zarr beside SCENE.toml]",
    },
    samples={"metavar": "N", "help": "Rays a pixel.  [default: as SCENE.toml, or 64]"},
    to={"help": "Product of the camera.  [default: as SCENE.toml, or radiance]"},
    atmospheres={"spelling": "--atmosphere", "metavar": "NAME", "help": "Only this atmosphere; repeatable."},
    library={
        "type": PLACE,
        "help": "Paint the cars with this library: a paint replaces the scene's paint of the same name, "
        "other paints go to the remaining cars.",
    },
    hold_edges={"help": "Extend spectra beyond their last band, and bridge gaps.  [default: as SCENE.toml]"},
    scheduler={"metavar": "ADDRESS", "help": "Compute on this dask.distributed cluster."},
)
@click.option("--picture", metavar="PICTURE", type=FILE, help="Draw the renders side by side (png, pdf ...).")
@click.option(
    "--example",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_example,
    help="Print a commented SCENE.toml and exit.",
)
def render(scene: Path, out: Path | None, picture: Path | None, **options: Any) -> None:
    """Render a synthetic scene: cubes of hundreds of bands, with the truth of every pixel.

    Light is traced once, without spectra, into the group transport; each atmosphere becomes a group
    renders/NAME, a flight line with labels for training: surface_class, paint_id, car_id, instance, purity,
    shadow, and shares of sun, sky, glint and indirect light. Run again, the command resumes an interrupted
    run and leaves a complete store unchanged.
    """
    out = out or scene.with_suffix(".zarr")
    outcome = workflows.rendering.run(scene, out, progress=is_watched(), **options)
    say_outcome(outcome)
    if picture is not None:
        workflows.rendering.draw_renders(out, (*outcome.written, *outcome.unchanged), picture)
    say_picture(picture)


@command(
    renamed={"--group": "--line"},
    epilog="""\b
Examples:
  hyperpaint view lot.zarr
  hyperpaint view raw_0.hdr                    raw counts, radiance or reflectance of any ENVI cube
  hyperpaint view lot.zarr --line raw_1 --regions cars.geojson
  hyperpaint view lot.zarr --library paints.zarr --port 8000 --no-browser

\b
Then, with the regions drawn:
  hyperpaint signatures lot.zarr --regions cars.geojson""",
)
@click.argument("store", metavar="STORE.zarr|CUBE.hdr", type=EXISTING)
@takes(
    "pictures.exploring:serve_explorer",
    without=["announce"],
    line={"metavar": "ID"},
    regions={"metavar": "FILE.geojson", "type": PLACE},
    library={"type": EXISTING},
    port={"type": click.IntRange(0, 65535), "metavar": "PORT", "help": "0 takes any free port."},
)
@click.option("--browser/--no-browser", default=True, help="Open a browser.")
def view(store: Path, browser: bool, **options: Any) -> None:
    """Look at an ENVI cube, or the flight lines and maps of a store, in a browser, until Ctrl-C.

    Raw counts, radiance and reflectance are shown in their units, also without wavelengths. Click for the
    spectrum of a pixel, drag for the median of a box, each with flags, uncertainty and the nearest paints of
    a library. Show true colour, colour infrared, single bands or flags; draw, name, edit and save regions for
    `hyperpaint signatures --regions`.

    The page is served to this machine only, at a new address in every call. It needs `python -m pip install
    'hyperpaint[interactive]'`. To see it from another machine: --port 8000 --no-browser here, and ssh -L
    8000:localhost:8000 HOST there.
    """
    from hyperpaint.pictures.exploring import serve_explorer

    def announce(address: str) -> None:
        click.echo(f"{address} shows {store}; Ctrl-C ends it")
        if browser:
            webbrowser.open(address)

    serve_explorer(store, announce=announce, **options)


@command(
    "report",
    renamed={"--signatures": "--library", "--lines": "--max-lines"},
    epilog="""\b
Examples:
  hyperpaint report lot.zarr
  hyperpaint report lot.zarr --out report.html --library paints.zarr
  hyperpaint report lot.zarr --out raw_0.html --line raw_0 --overwrite
  hyperpaint report map.zarr --out map.html""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "report.store_report:write_report",
    without=("validation",),
    out={
        "metavar": "REPORT.html",
        "type": PLACE,
        "required": False,
        "help": "The page.  [default: report.html beside STORE.zarr]",
    },
    library={"type": EXISTING, "help": "Paint library to show as well."},
    max_lines={"type": click.IntRange(min=1)},
    cards={"type": click.IntRange(min=0)},
    sun_zenith={"type": click.FloatRange(0.0, 90.0), "metavar": "DEGREE"},
)
@click.pass_context
def make_report(
    ctx: click.Context,
    /,
    store: Path,
    out: Path | None,
    flightlines: tuple[str, ...],
    **options: Any,
) -> None:
    """Write one self-contained HTML page about a store.

    For every flight line: true colour, flags, irradiance over time, panels, histograms of reflectance, the
    steps from counts to reflectance, map, alignment, provenance, and a card for every paint. For the store:
    paint signatures with uncertainty, agreement with references, and the calibration. Unreadable parts are
    listed on the page and on stderr, with exit status 1.
    """
    out = out or beside(store, "report.html")
    with progress_bar("drawing") as progress:
        page = hp.report.write_report(
            store, out, flightlines=flightlines or None, progress=progress, **options
        )
    names = ", ".join(group.rpartition("/")[2] for group in page.flightlines)
    count = len(page.flightlines)
    lines = f"{count} flight line{'' if count == 1 else 's'}" + (f" ({names})" if names else "")
    maps = f"map {', '.join(page.maps)}" if page.maps else ""
    texts = (lines if count or not maps else "", maps, f"{page.path.stat().st_size / 1e6:.1f} MB")
    click.echo(f"{page.path}: {', '.join(filter(None, texts))}")
    end_with_problems(ctx, page.problems, "cannot be read")


@command(
    "site",
    renamed={"--signatures": "--library", "--lines": "--max-lines"},
    epilog="""\b
Examples:
  hyperpaint site lot.zarr --out page --library paints.zarr
  python -m http.server --directory page 8000          then open http://localhost:8000
  aws s3 sync page s3://bucket/lot                     or any other place for files
  hyperpaint site lot.zarr --out page --link https://data.example.org/lot.zarr""",
)
@click.argument("store", metavar="STORE.zarr", type=EXISTING)
@takes(
    "report.static_site:write_site",
    out={"metavar": "DIR", "type": FOLDER},
    library={"type": EXISTING, "help": "Paint library to show as well."},
    link={"metavar": "URL"},
    max_lines={"type": click.IntRange(min=1)},
)
@click.pass_context
def site(ctx: click.Context, /, store: Path, out: Path, flightlines: tuple[str, ...], **options: Any) -> None:
    """Write a folder that any web server or bucket can serve: the page reads the Zarr store itself.

    The page shows lines and maps in true colour, flags, the spectrum of a clicked pixel, and paints; every
    view has its own address. No program runs on the server, nothing is loaded from elsewhere, and values
    equal those of the store bit for bit. The folder's store.zarr is a copy in small tiles.
    """
    page = hp.report.write_site(store, out, flightlines=flightlines or None, progress=is_watched(), **options)
    names = ", ".join(group.rpartition("/")[2] for group in (*page.flightlines, *page.maps)) or "paints"
    size = sum(file.stat().st_size for file in page.path.rglob("*") if file.is_file())
    look = f"look at it: python -m http.server --directory {page.path} 8000, then http://localhost:8000"
    click.echo(f"{page.path}: {names}, {size / 1e6:.1f} MB\n{look}")
    end_with_problems(ctx, page.problems, "cannot be shown")
