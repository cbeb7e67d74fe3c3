"""Functions shared by all pictures: figures, labels, legends, PNG files."""

import base64
import io
import struct
import textwrap
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    CROSS_TRACK,
    Array,
    SchemaError,
    as_path,
    is_number,
    needs_extra,
    numbers_of,
)
from hyperpaint.io.files.publishing import check_place, published_files

_MAX_LABEL_CHARS = 60
_MIN_WIDTH_INCH = 2.0  # axes and their labels have no room in less
#: Colours of curves, of Okabe and Ito for colour-blind readers.
COLOURS = BLUE, VERMILION, GREEN, PURPLE, ORANGE, _ = (
    "#3399DD",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#999999",
)


def new_figure(purpose: str, **options: Any) -> Any:
    # Return a matplotlib figure independent of pyplot, with options of `Figure`.
    # ``purpose``, such as "a quicklook", opens the message where matplotlib is missing (`MissingExtraError`).
    with needs_extra("matplotlib", "viz", purpose):
        from matplotlib.figure import Figure
    width = options.get("figsize", (_MIN_WIDTH_INCH,))[0]
    SchemaError.raise_if(
        not (is_number(width) and width >= _MIN_WIDTH_INCH),
        f"a figure {width!r} inches wide",
        expected=f"at least {_MIN_WIDTH_INCH:g}",
        code="value-out-of-range",
    )
    return Figure(**options)


def axes_or_new(axes: Any, purpose: str, **options: Any) -> Any:
    # Return the axes passed, or the axes of a new figure; refuse anything else, such as an array of axes
    SchemaError.raise_if(
        axes is not None and not hasattr(axes, "get_subplotspec"),
        f"axes= is {type(axes).__name__}",
        expected="one Axes of matplotlib",
        mend="choose one, such as axes[0]",
        code="type-wrong",
    )
    return new_figure(purpose, layout="constrained", **options).subplots() if axes is None else axes


def ink_of(axes: Any, strength: float = 1.0) -> tuple[float, float, float]:
    # Return the text colour of axes mixed with their background, visible in light and dark themes.
    # ``strength``: 1 is the text colour, 0 the background.
    from matplotlib import rcParams
    from matplotlib.colors import to_rgb

    ink, ground = np.array(to_rgb(rcParams["text.color"])), np.array(to_rgb(axes.get_facecolor()))
    red, green, blue = (strength * ink + (1.0 - strength) * ground).tolist()
    return red, green, blue


_CHARS_PER_INCH = 15.0  # of small text
_AXIS_HEIGHT_INCH = 0.5  # of ticks and the label of an axis


def axes_width(axes: Any) -> float:
    # Return the width of the part of a figure reserved for axes and their labels [inch]
    width, spec = float(axes.figure.bbox.width / axes.figure.dpi), axes.get_subplotspec()
    if spec is None:
        return width
    outer = spec.get_topmost_subplotspec()
    return width * float(len(outer.colspan) / outer.get_gridspec().ncols)


def legend_below(axes: Any, *others: Any, entries: Mapping[str, Any] | None = None, **options: Any) -> None:
    # Place a legend of the curves of axes and ``others`` below the axes, in as many columns as fit.
    # Long names are wrapped, so that they do not narrow the axes. ``entries``: additional handles by name.
    from matplotlib.transforms import ScaledTranslation

    handles_by_label: dict[str, Any] = dict(entries or {})
    for plot in (*others, axes):
        handles, labels = plot.get_legend_handles_labels()
        handles_by_label |= dict(zip(labels, handles, strict=True))
    if not handles_by_label:
        return
    figure = axes.figure
    room = axes_width(axes) - 1.0
    texts = [textwrap.fill(label, max(12, int(_CHARS_PER_INCH * (room - 0.4)))) for label in handles_by_label]
    max_chars = max(len(line) for text in texts for line in text.splitlines())
    columns = max(1, min(len(texts), int(room / (max_chars / _CHARS_PER_INCH + 0.6))))
    # below the label of the axis
    axes.legend(
        handles_by_label.values(),
        texts,
        loc="upper left",
        bbox_to_anchor=(0.0, 0.0),
        bbox_transform=axes.transAxes + ScaledTranslation(0.0, -_AXIS_HEIGHT_INCH, figure.dpi_scale_trans),
        borderaxespad=0.0,
        **{"fontsize": "small", "frameon": False, "ncols": columns, "handlelength": 1.6, **options},
    )


def label_axes(axes: Any, **labels: Any) -> None:
    # Set title, labels and limits of finished axes, by default over wavelength, and place their legend.
    axes.set(**{"xlabel": "wavelength [nm]", **labels})
    legend_below(axes)


def columns_for(width: float, plot: float, most: int) -> int:
    """Return the number of plots that fit side by side; ``width`` and ``plot`` in inches.

    Examples
    --------
    >>> columns_for(13.0, 4.0, 4), columns_for(3.6, 4.0, 4)
    (3, 1)
    """
    return max(1, min(most, int(width // plot)))


def label_for(text: object, longest: int = _MAX_LABEL_CHARS) -> str:
    r"""Return a text that matplotlib draws literally, without control characters, cut to ``longest``.

    Examples
    --------
    >>> print(label_for("$5 paint"))
    \$5 paint
    """
    label = "".join(sign if sign.isprintable() else "\ufffd" for sign in str(text))
    if len(label) > longest:
        label = label[: longest - 3] + "..."
    label = label.replace("$", r"\$")
    # a legend omits labels that start with an underscore
    return f" {label}" if label.startswith("_") else label


def save_figure(figure: Any, path: str | Path | None, dpi: int = 110) -> Any:
    # Write a figure, or the figure of a subfigure, to ``path``, if any, and return it; an existing file is
    # replaced atomically.
    # Raises `SchemaError` if matplotlib does not write this file type, `StoreError` if the file cannot be
    # written.
    figure = figure.get_figure(root=True)
    if path is None:
        return figure
    path = as_path(path)
    if not path.suffix:  # as matplotlib does
        path = path.with_name(f"{path.name}.{figure.canvas.get_default_filetype()}")
    with (
        published_files([path], overwrite=True) as (target,),
        SchemaError.instead_of(ValueError, f"{path}: $whole", code="picture-unwritable"),
    ):
        figure.savefig(target, dpi=dpi)
    return figure


def check_picture(path: Path) -> None:
    """Check folder and file type of a picture before drawing, and list all problems.

    Examples
    --------
    >>> check_picture(Path("calibration.xls"))
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: the picture cannot be written to calibration.xls:
      the name ends in '.xls', expected ..., .svg, ... [suffix-unknown]
    """
    suffixes = [f".{kind}" for kind in sorted(new_figure("a picture").canvas.get_supported_filetypes())]
    check_place(
        path, "the picture", example="agreement.png", kinds=suffixes, overwrite=True, error=SchemaError
    )


def png_of(figure: Any, dpi: int = 110) -> bytes:
    # Return a figure as PNG
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # names may be in any script; glyphs that the font lacks become boxes
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        # savefig draws twice, the first time for the layout only
        figure.dpi = dpi
        FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def encode_png(picture: npt.NDArray[np.uint8]) -> bytes:
    r"""Return a picture (line, column, 3) as PNG.

    Examples
    --------
    >>> encode_png(np.zeros((2, 3, 3), np.uint8))[:8]
    b'\x89PNG\r\n\x1a\n'
    """
    lines, columns, _ = picture.shape
    # every line starts with its PNG filter type; 0 is no filter
    rows = np.zeros((lines, 1 + 3 * columns), np.uint8)
    rows[:, 1:] = picture.reshape(lines, -1)
    fields = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, lines, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    )
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in fields
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def data_uri(png: bytes) -> str:
    # Return a PNG as a data URL
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


# --- orientation of pictures: not mirrored, and pixels with their aspect ratio on the ground ---------------


@dataclass(frozen=True)
class Orientation:
    # Position of a picture's pixels on its axes
    extent: tuple[float, float, float, float]  # outer edges of first and last column, of first and last line
    is_mirrored: bool  # whether columns run to the left of the flight, so that their axis is reversed
    goes_down: bool  # whether the vertical axis grows downwards
    aspect: float  # length of a pixel along the vertical axis over its length along the horizontal axis
    labels: tuple[str, str]  # of the horizontal and of the vertical axis

    def height_of(self, width: float) -> float:
        # Return the height of a picture of a given width
        left, right, first_line, last_line = self.extent
        return width * self.aspect * abs((last_line - first_line) / (right - left))


def map_dims(cube: xr.DataArray | xr.Dataset) -> dict[str, str]:
    # Return "y" and "x" by role if a dataset has the coordinates of a map, otherwise an empty dict
    pairs = {ALONG_TRACK: "y", CROSS_TRACK: "x"}
    is_map = all(name in cube.coords and cube[name].dims == (role,) for role, name in pairs.items())
    return pairs if is_map else {}


def orientation_of(dataset: xr.Dataset) -> Orientation:
    # Return the orientation of a flight line or a map.
    # Columns are reversed if they run to the left of the flight, by ``east`` and ``north`` of the pixels,
    # else by ``look_across``, else by the declared column order. Pixels have the aspect ratio of their
    # spacing on the ground where it is known, else they are square.
    lines, columns = dataset.sizes[ALONG_TRACK], dataset.sizes[CROSS_TRACK]
    if map_dims(dataset) and lines > 1 and columns > 1:
        x, y = (np.asarray(dataset[name].values, np.float64) for name in ("x", "y"))
        half_x, half_y = (0.5 * float(values[-1] - values[0]) / (values.size - 1) for values in (x, y))
        extent = (float(x[0]) - half_x, float(x[-1]) + half_x, float(y[0]) - half_y, float(y[-1]) + half_y)
        attrs = [dataset[name].attrs for name in ("x", "y")]
        # rows of a grid along the flight count down from its corner
        is_flight_grid = any("along the flight" in f"{a.get('crs')} {a.get('long_name')}" for a in attrs)
        names = ("to the right in the grid", "down in the grid") if is_flight_grid else ("east", "north, up")
        units = [f" [{label_for(a['units'])}]" if a.get("units") else "" for a in attrs]
        labels = names[0] + units[0], names[1] + units[1]
        return Orientation(extent, half_x < 0, is_flight_grid, 1.0, labels)
    # centres of pixels are whole numbers; a crop keeps the line and column numbers of its flight line
    line_numbers, column_numbers = numbers_of(dataset, ALONG_TRACK), numbers_of(dataset, CROSS_TRACK)
    SchemaError.raise_if(
        np.isnan(np.concatenate([line_numbers, column_numbers])).any(),
        "lines or columns have no number, as after pad()",
        mend="number them by assign_coords(along_track=...), or drop_vars(['along_track', 'cross_track'])",
        code="not-finite",
    )
    extent = (
        column_numbers[0] - 0.5,
        column_numbers[-1] + 0.5,
        line_numbers[0] - 0.5,
        line_numbers[-1] + 0.5,
    )
    labels = "cross_track [column]", "along_track [line], flown upwards"
    is_placed = all(
        name in dataset.coords and set(dataset[name].dims) == {ALONG_TRACK, CROSS_TRACK}
        for name in ("east", "north")
    )
    if is_placed and lines > 1 and columns > 1:
        # (east, north) of a step along and a step across the track [m], computed along the central column and
        # across the central line only
        central_column = dataset[["east", "north"]].isel({CROSS_TRACK: columns // 2}).compute()
        central_line = dataset[["east", "north"]].isel({ALONG_TRACK: lines // 2}).compute()
        forward, right = (
            np.array([_mean_step(positions[name].values) for name in ("east", "north")])
            for positions in (central_column, central_line)
        )
        if all(np.isfinite(step).all() and np.hypot(*step) > 0.0 for step in (forward, right)):
            mirrored = right[0] * forward[1] - right[1] * forward[0] < 0.0
            aspect = float(np.hypot(*forward) / np.hypot(*right))
            return Orientation(extent, bool(mirrored), False, aspect, labels)
    # column order from the look angles, as in `locate`, else the declared column order
    look = dataset.variables.get("look_across")
    slope = 0.0 if look is None or look.dims != (CROSS_TRACK,) else _mean_step(look.values)
    order = "left_to_right" if slope > 0.0 else "right_to_left" if slope < 0.0 else ""
    order = order or dataset.attrs.get("convention_column_order", "")
    assumed = "" if order in ("left_to_right", "right_to_left") else ", assumed to run to the right"
    return Orientation(extent, order == "right_to_left", False, 1.0, (labels[0] + assumed, labels[1]))


def _mean_step(values: Array) -> float:
    # mean step between neighbours, from the first to the last finite value
    places = np.flatnonzero(np.isfinite(values))
    return (
        float("nan")
        if places.size < 2
        else float((values[places[-1]] - values[places[0]]) / (places[-1] - places[0]))
    )


def flown_right(picture: Array, orientation: Orientation) -> Array:
    # Return a picture (line, column, ...) as (row, line, ...) with the flight to the right
    # the flight is to the right, so that columns on its right side are below
    return np.asarray((picture[:, ::-1] if orientation.is_mirrored else picture).swapaxes(0, 1))


def show_picture(axes: Any, picture: Array, orientation: Orientation, **options: Any) -> Any:
    # Show a picture (line, column, ...) on axes, in pixels of the line or metres of the map
    image = axes.imshow(
        picture,
        origin="lower",
        extent=orientation.extent,
        aspect=orientation.aspect,
        interpolation="nearest",
        **options,
    )
    # columns to the right of the flight are on the right, and the vertical axis grows upwards or downwards
    left, right, *vertical = orientation.extent
    axes.set(
        xlim=(right, left) if orientation.is_mirrored else (left, right),
        ylim=sorted(vertical, reverse=orientation.goes_down),
        xlabel=orientation.labels[0],
        ylabel=orientation.labels[1],
    )
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize="small")
    axes.locator_params(axis="x", nbins=4)  # easting has six digits
    return image
