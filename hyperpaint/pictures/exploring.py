"""Exploring a flight line in a notebook, or a store in a browser (extra ``interactive``)."""

from __future__ import annotations

import functools
import html
import os
import secrets
import signal
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import xarray as xr

from hyperpaint.base.errors import StoreError, needs_extra
from hyperpaint.base.facts import documented
from hyperpaint.base.old_names import renamed
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, Quality, rename_to_roles
from hyperpaint.io.library import open_library
from hyperpaint.io.store import list_groups, open_store
from hyperpaint.paints.starter_paints import starter_library

from .explorer import FULL_WIDTH, INK, Explorer
from .explorer_state import Explored


@documented(line="dataset")
def explore(
    line: xr.Dataset,
    regions: Any = None,
    *,
    library: xr.Dataset | str | os.PathLike[str] | None = None,
    flightline: str = "",
    exclude: Quality | int | None = None,
    theme: Literal["light", "dark"] = "light",
) -> Explorer:
    """Show a flight line in an interactive widget: bands, spectra, flags, regions, similar paints.

    Click on the picture for the spectrum of a pixel, drag for the median of a box. Draw polygons, which
    become regions; name them, drag their corners, save them.

    Parameters
    ----------
    line
    regions
        Regions to show and edit, in sensor coordinates, see `hyperpaint.read_regions`; also the proposals of
        `hyperpaint.regions.propose_regions`.
    library
        A paint library, or its path, whose paints are compared with clicked spectra; by default
        `hyperpaint.paints.starter_library`, of synthetic paints.
    flightline
        Name of the flight line, which new regions get; needed to combine regions of several lines. Regions of
        other flight lines are hidden, and saved with the others.
    exclude
    theme
        Theme of the figures, ``"light"`` or ``"dark"``.

    Returns
    -------
    Explorer
        Show it as the last line of a cell; ``.regions`` holds the regions drawn.

    Raises
    ------
    MissingExtraError
        panel or bokeh is not installed.
    SchemaError
        Reflectance or wavelength is missing, or the regions are not in sensor coordinates.

    Notes
    -----
    The spectrum of a pixel is bit for bit that of `hyperpaint.radiometry.pixels`. The spectrum of a region is
    the median of its pixels that are not excluded, with their 5 to 95 % range shaded. The shade around the
    last clicked curve is its standard uncertainty, k = 1, if the noise of the line is known; see
    `hyperpaint.radiometry.mean_uncertainty`.

    A notebook loads the widget's scripts from the internet, as panel does by default; without internet, set
    ``PANEL_INLINE=True`` in the environment of the kernel, which puts them into the notebook.

    Examples
    --------
    >>> from hyperpaint.regions import Region
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> grass = Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)])
    >>> explorer = explore(line, [grass])  # the last line of a cell shows it     # doctest: +SKIP
    >>> line.paint.signatures(explorer.regions).sizes["signature"]                    # doctest: +SKIP
    1
    """
    require_panel()
    if library is None:
        library = starter_library(members=0)
    elif isinstance(library, str | os.PathLike):
        library = open_library(library)
    state = Explored(line, regions, library=library, flightline=flightline, exclude=exclude)
    return Explorer(state, theme=theme)


def require_panel() -> None:
    # Raise `MissingExtraError` where panel or bokeh is not installed
    for package in ("panel", "bokeh"):
        with needs_extra(package, "interactive", "an explorer"):
            __import__(package)


@renamed(group="line")
def serve_explorer(
    store: str | os.PathLike[str],
    line: str | None = None,
    *,
    regions: str | os.PathLike[str] | None = None,
    library: str | os.PathLike[str] | None = None,
    port: int = 0,
    announce: Callable[[str], None],
) -> None:
    """Serve the explorer of a store's flight lines on this machine until interrupted.

    The address contains a random token. Requests without it, for another host, or from a page of another
    origin are refused, so that other users of the machine and other pages in the browser have no access.

    Parameters
    ----------
    store
        A store with flight lines, or one line.
    line
        The flight line shown first; by default the first of the store. The page links to all lines.
    regions
        GeoJSON file of this line's regions, read if it exists, and written on saving. By default, and for
        other lines, ``STORE-LINE-regions.geojson`` in the current folder. Saving keeps regions of other
        flight lines in the file, and never replaces a file that another program has changed.
    library
        A paint library to compare with; by default the starter library.
    port
        Port of the server; 0 takes any free port.
    announce
        Called with the address once it is served.

    Raises
    ------
    FormatError, StoreError
        The store, the regions or the library cannot be read; or the store has no such flight line.
    MissingExtraError
        panel or bokeh is not installed.
    """
    # groups of flight lines by name: those of the folder first, then other groups with a cube of pixels
    groups = list_groups(store)
    line_groups = [group for group in groups if group.startswith("flightlines/")]
    for group in [group for group in groups if group not in line_groups]:
        dataset = rename_to_roles(open_store(store, group))
        has_cube = bool({"counts", "radiance", "reflectance"} & set(dataset.data_vars))
        if {ALONG_TRACK, CROSS_TRACK} <= set(dataset.dims) and "wavelength" in dataset.variables and has_cube:
            line_groups.append(group)
    lines = {group.rpartition("/")[2] or Path(store).stem: group for group in line_groups}
    first_name = next(iter(lines), "") if line is None else line.rpartition("/")[2]
    if first_name not in lines:
        raise StoreError(
            f"{store} has no flight line {line!r:.80}" if line else f"{store} has no flight line",
            expected=", ".join(lines) or "a group with reflectance, or counts, and wavelength",
            code="flightline-unknown",
        )
    require_panel()
    import panel

    paints = starter_library(members=0) if library is None else open_library(library)
    stem = Path(store).resolve().stem

    def region_file(name: str) -> Path:
        if regions is not None and name == first_name:
            return Path(regions)
        # the name of the store is part, because lines of several stores may have the same name
        return Path(f"{stem}-regions.geojson" if name == stem else f"{stem}-{name}-regions.geojson")

    @functools.cache
    def line_state(name: str) -> Explored:
        # all pages of a line share its state, so that regions survive reloading a page
        file = region_file(name) if region_file(name).exists() else None
        return Explored(open_store(store, lines[name]), file, library=paints, flightline=name)

    def page() -> Any:
        arguments = panel.state.session_args
        name, theme = (arguments.get(key, [b""])[0].decode("utf-8", "replace") for key in ("line", "colours"))
        name, theme = name if name in lines else first_name, theme if theme in INK else "light"
        # widgets and figures read the theme when they are created
        panel.config.theme = "dark" if theme == "dark" else "default"
        explorer = Explorer(line_state(name), theme=theme, save_to=region_file(name))
        return panel.Column(_head(line_state(name), name, lines, theme), explorer.view, **FULL_WIDTH)

    line_state(first_name)  # raise reading errors before the server starts
    interrupted = signal.getsignal(signal.SIGINT)
    token = secrets.token_urlsafe(32)
    server = panel.serve(
        {"/": page},
        port=port,
        address="127.0.0.1",
        prefix=token,
        show=False,
        start=False,
        verbose=False,
        title=f"hyperpaint {first_name}",
    )
    signal.signal(signal.SIGINT, interrupted)  # panel replaced the handler of interrupts
    _guard(server, token)
    server.start()
    announce(f"http://localhost:{server.port}/{token}/")
    server.io_loop.start()


def _guard(server: Any, token: str) -> None:
    # Refuse requests to the server from elsewhere than its own page.
    # The host must be this machine, which excludes rebound DNS names; the path must start with the token; a
    # websocket must have an origin; and every origin must be this server.
    from tornado.web import ErrorHandler

    application = server._tornado
    find_handler = application.find_handler
    hosts = {f"localhost:{server.port}", f"127.0.0.1:{server.port}"}
    origins = [f"http://{host}" for host in hosts]

    def find_guarded(request: Any, **options: Any) -> Any:
        path_start = request.path.split("/", 2)[1:2]
        senders = request.headers.get_list("Origin")
        is_websocket = "websocket" in request.headers.get("Upgrade", "").lower()
        if (
            request.host.lower() in hosts
            and secrets.compare_digest("".join(path_start).encode(), token.encode())
            and all(origin in origins for origin in senders)
            and (senders or not is_websocket)
        ):
            return find_handler(request, **options)
        return application.get_handler_delegate(request, ErrorHandler, {"status_code": 403})

    application.find_handler = find_guarded


def _head(state: Explored, name: str, lines: Iterable[str], theme: str) -> Any:
    import panel

    nm, (count, columns) = state.wavelength, state.shape
    other_theme = next(ink for ink in INK if ink != theme)
    links = [
        f'<a style="color:inherit" href="?line={quote(line)}&colours={theme}">{html.escape(line)}</a>'
        for line in lines
        if line != name
    ]
    links.append(
        f'<a style="color:inherit" href="?line={quote(name)}&colours={other_theme}">{other_theme}</a>'
    )
    size = f"{count:,} lines, {columns:,} columns, {nm.size} bands"
    size += f", {np.nanmin(nm):.0f} to {np.nanmax(nm):.0f} nm"
    text = f"<h2 style='margin:0'>{html.escape(name)}</h2>{size} &nbsp; {' &middot; '.join(links)}"
    return panel.pane.HTML(text, **FULL_WIDTH)
