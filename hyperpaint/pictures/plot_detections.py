"""Receiver operating characteristics of paint detection."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented

from .figures import ink_of, legend_below, new_figure, save_figure

_COLOURS = ("#3399DD", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#999999")


@documented(path="picture")
def detection_curve(
    detections: xr.Dataset | Mapping[str, xr.Dataset],
    truth: Any,
    path: str | Path | None = None,
    *,
    width: float = 6.0,
) -> Any:
    """Draw the detection rate of paints against the false alarm rate, over all thresholds (ROC).

    Eager.

    Parameters
    ----------
    detections
        Result of `hyperpaint.paints.detect`, or several by name, such as one per method.
    truth
        Pixels that show one of the paints, (along_track, cross_track) bool.
    path
    width

    Returns
    -------
    matplotlib.figure.Figure
        One curve per result: along it the thresholds of all paints are shifted by the same amount. A dot
        marks the detections after rejection of unknown paints; the vertical line is the requested false alarm
        rate.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The input holds no detections, or ``truth`` has another shape, or is True or False everywhere.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> pixel, unit = ("along_track", "cross_track"), {"units": "1"}
    >>> result = xr.Dataset({"detection_score": (pixel, np.float32([[0.1, 0.9, 0.2, 0.8]]), unit),
    ...                     "best_paint": (pixel, np.int16([[0, 0, 0, 0]])),
    ...                     "score_threshold": ("signature", [0.5], unit),
    ...                     "detected": (pixel, [[False, True, False, True]])})
    >>> figure = detection_curve({"ACE": result}, [[False, True, False, False]])
    >>> figure.axes[0].lines[0].get_ydata().tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    by_name: Any = {"": detections} if "detected" in detections else detections
    is_target = np.asarray(getattr(truth, "values", truth), bool)
    figure = new_figure("a detection curve", figsize=(width, 0.8 * width), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, result) in enumerate(dict[str, Any](by_name).items()):
        alarms, hits, dot = _curve(result, is_target)
        colour = _COLOURS[number % len(_COLOURS)]
        axes.plot(alarms, hits, color=colour, label=name or str(result.attrs.get("method", "")))
        axes.plot(max(dot[0], alarms[0]), dot[1], "o", color=colour)
        rate = result.attrs.get("false_alarm_rate")
        if rate is not None:
            axes.axvline(rate, color=ink_of(axes, 0.5), linewidth=0.8, linestyle="--")
    axes.set(xscale="log", ylim=(0.0, 1.02))
    axes.set_xlabel("false alarm rate, share of other pixels [1]")
    axes.set_ylabel("detection rate, share of the paint's pixels [1]")
    legend_below(axes)
    save_figure(figure, path)
    return figure


def _curve(detections: xr.Dataset, is_target: Any) -> tuple[Any, Any, tuple[float, float]]:
    # false alarm and detection rates over all thresholds, and the two rates of the stored detections
    names = ("detection_score", "best_paint", "score_threshold", "detected")
    arrays = schema.require(schema.rename_to_roles(detections), names, "a detection curve")
    score, paint, threshold, detected = (arrays[name].values for name in names)
    if is_target.shape != score.shape:
        raise SchemaError(
            f"truth has shape {is_target.shape}",
            expected=f"{score.shape}, as the detections",
            code="grid-mismatch",
        )
    has_score = paint >= 0
    margin = (score - threshold[paint])[has_score]
    is_hit = is_target[has_score]
    if not is_hit.any() or is_hit.all():
        raise SchemaError(
            f"truth is {bool(is_hit.any())} everywhere",
            expected="True for pixels with a paint, False for all other pixels",
            code="truth-uniform",
        )
    order = np.argsort(-margin, kind="stable")
    hits, alarms = np.cumsum(is_hit[order]) / is_hit.sum(), np.cumsum(~is_hit[order]) / (~is_hit).sum()
    dot = detected[has_score & ~is_target].mean(), detected[has_score & is_target].mean()
    return np.maximum(alarms, 0.5 / (~is_hit).sum()), hits, dot
