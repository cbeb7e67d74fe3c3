"""Functions shared by all pictures: figures, labels, legends, PNG files."""

from __future__ import annotations

import base64
import io
import struct
import textwrap
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import SchemaError, needs_extra
from hyperpaint.io.files.publishing import check_place, published_files

_MAX_LABEL_CHARS = 60


def new_figure(purpose: str, **options: Any) -> Any:
    """Return a matplotlib figure independent of pyplot, with options of `Figure`.

    ``purpose``, such as "a quicklook", opens the message where matplotlib is missing (`MissingExtraError`).
    """
    with needs_extra("matplotlib", "viz", purpose):
        from matplotlib.figure import Figure
    return Figure(**options)


def axes_or_new(axes: Any, purpose: str, **options: Any) -> Any:
    """Return the axes passed, or new axes of pyplot, which a notebook displays."""
    if axes is not None:
        return axes
    with needs_extra("matplotlib", "viz", purpose):
        from matplotlib import pyplot
    return pyplot.subplots(layout="constrained", **options)[1]


def ink_of(axes: Any, strength: float = 1.0) -> tuple[float, float, float]:
    """Return the text colour of axes mixed with their background, visible in light and dark themes.

    ``strength``: 1 is the text colour, 0 the background.
    """
    from matplotlib import rcParams
    from matplotlib.colors import to_rgb

    background = axes.get_facecolor()
    ink, ground = np.array(to_rgb(rcParams["text.color"])), np.array(to_rgb(background))
    red, green, blue = (strength * ink + (1.0 - strength) * ground).tolist()
    return red, green, blue


_CHARS_PER_INCH = 15.0  # of small text
_AXIS_HEIGHT_INCH = 0.5  # of ticks and the label of an axis


def axes_width(axes: Any) -> float:
    """Return the width of the part of a figure reserved for axes and their labels [inch]."""
    width, spec = float(axes.figure.get_size_inches()[0]), axes.get_subplotspec()
    if spec is None:
        return width
    outer = spec.get_topmost_subplotspec()
    return width * float(len(outer.colspan) / outer.get_gridspec().ncols)


def legend_below(axes: Any, *others: Any, entries: Mapping[str, Any] | None = None, **options: Any) -> None:
    """Place a legend of the curves of axes and ``others`` below the axes, in as many columns as fit.

    Long names are wrapped, so that they do not narrow the axes. ``entries``: additional handles by name.
    """
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
    settings = {"fontsize": "small", "frameon": False, "ncols": columns, "handlelength": 1.6, **options}
    # below the label of the axis
    below_axes = axes.transAxes + ScaledTranslation(0.0, -_AXIS_HEIGHT_INCH, figure.dpi_scale_trans)
    axes.legend(
        handles_by_label.values(),
        texts,
        loc="upper left",
        bbox_to_anchor=(0.0, 0.0),
        bbox_transform=below_axes,
        borderaxespad=0.0,
        **settings,
    )


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


def save_figure(figure: Any, path: str | Path | None, dpi: int = 110) -> None:
    """Write a figure to ``path``, if any; an existing file is replaced atomically.

    Raises `SchemaError` if matplotlib does not write this file type, `StoreError` if the file cannot be
    written.
    """
    if path is None:
        return
    path = Path(path)
    if not path.suffix:  # as matplotlib does
        path = path.with_name(f"{path.name}.{figure.canvas.get_default_filetype()}")
    with published_files([path], overwrite=True) as (target,):
        try:
            figure.savefig(target, dpi=dpi)
        except ValueError as error:
            raise SchemaError(f"{path}: {error}", code="picture-unwritable") from error


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
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # names may be in any script; glyphs that the font lacks become boxes
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(buffer, format="png", dpi=dpi)
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
    """Return a PNG as a data URL."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
