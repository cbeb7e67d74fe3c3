"""What all pictures share: figures without a screen, texts that are only texts, and PNG."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import SchemaError, needs_extra

__all__ = [
    "axes_or_new", "check_picture", "data_uri", "encode_png", "label_for", "new_figure", "png_of",
    "save_figure",
]  # fmt: skip

_LONGEST_LABEL = 60


def new_figure(purpose: str, **options: Any) -> Any:
    """Return a matplotlib figure that no screen and no global state knows of, with options of `Figure`.

    ``purpose``, such as "a quicklook", opens the message where matplotlib is missing (`MissingExtraError`).
    """
    with needs_extra("matplotlib", "viz", purpose):
        from matplotlib.figure import Figure
    return Figure(**options)


def axes_or_new(axes: Any, purpose: str, **options: Any) -> Any:
    """Return the axes given, or those of a new figure of pyplot, which a notebook shows by itself."""
    if axes is not None:
        return axes
    with needs_extra("matplotlib", "viz", purpose):
        from matplotlib import pyplot
    return pyplot.subplots(layout="constrained", **options)[1]


def label_for(text: object, longest: int = _LONGEST_LABEL) -> str:
    r"""Return a text as matplotlib draws it letter by letter: no formula, nothing hidden, no control sign.

    Examples
    --------
    >>> print(label_for("$5 paint"))
    \$5 paint
    """
    shown = "".join(sign if sign.isprintable() else "\ufffd" for sign in str(text))
    if len(shown) > longest:
        shown = shown[: longest - 3] + "..."
    shown = shown.replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown  # a legend leaves out what begins with one


def save_figure(figure: Any, path: str | Path | None, dpi: int = 110) -> None:
    """Write a figure to a file, where one is named; `SchemaError` where matplotlib writes no such picture."""
    if path is None:
        return
    try:
        figure.savefig(path, dpi=dpi)
    except ValueError as error:
        raise SchemaError(f"{path}: {error}") from error


def check_picture(path: Path) -> None:
    """Refuse a place for a picture before anything is drawn; all reasons are listed.

    Examples
    --------
    >>> check_picture(Path("calibration.xls"))
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: the picture cannot be written to calibration.xls:
      expected a name that ends in one of ..., .svg, ...
    """
    from hyperpaint.io.files.publishing import check_place

    kinds = new_figure("a picture").canvas.get_supported_filetypes()
    suffixes = [f".{kind}" for kind in sorted(kinds)]
    check_place(
        path, "the picture", example="agreement.png", kinds=suffixes, overwrite=True, error=SchemaError
    )


def png_of(figure: Any, dpi: int = 110) -> bytes:
    """Return a figure as PNG."""
    import io
    import warnings

    held = io.BytesIO()
    with warnings.catch_warnings():
        # names may be written in any script; what the font lacks becomes a box
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(held, format="png", dpi=dpi)
    return held.getvalue()


def encode_png(picture: npt.NDArray[np.uint8]) -> bytes:
    r"""Return a picture (line, column, 3) as PNG, without any package.

    Examples
    --------
    >>> encode_png(np.zeros((2, 3, 3), np.uint8))[:8]
    b'\x89PNG\r\n\x1a\n'
    """
    lines, columns, _ = picture.shape
    # each line opens with its filter: 0, none
    rows = np.zeros((lines, 1 + 3 * columns), np.uint8)
    rows[:, 1:] = picture.reshape(lines, -1)
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, lines, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    )
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def data_uri(png: bytes) -> str:
    """Return a PNG as a URL that holds the picture itself."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
