"""The light of the sky, measured in the image itself: in a cast shadow on uniform ground."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hyperpaint.errors import SchemaError

from .model import SHADED
from .references import Matches

__all__ = ["fraction_in_shadow"]

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

_LEAST_PIXELS = 60
_OPEN = (0.6, 0.9)


def fraction_in_shadow(
    channels: npt.NDArray[np.float32],
    places: list[Int],
    spectrum: Float,
    size: Int,
    matches: Matches,
) -> Float:
    r"""Return the diffuse fraction (channel,) from a shadow on the largest body that has one of some size.

    :math:`f_{dif} = \rho_{shadow} / \rho_{sun}`, of the pixels of the shadow that see most of the sky: the
    60th to 90th percentile of brightness in the bluest quarter. What things around hide of the sky, and light
    that comes off them, is not known, and remains in it.

    Raises
    ------
    SchemaError
        There is no such shadow.
    """
    shaded = np.flatnonzero((matches.state == SHADED) & (size >= _LEAST_PIXELS))
    if not shaded.size:
        msg = (
            "diffuse='shadow' found no cast shadow of 60 pixels beside its ground in full sun; "
            "use diffuse='model', or give a measured spectrum"
        )
        raise SchemaError(msg)
    ground = matches.body[shaded]
    best = ground[np.argmax(size[ground])]
    flat = channels.reshape(-1, channels.shape[2])
    here = np.concatenate([places[segment] for segment in shaded[ground == best]])
    values = flat[here].astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    blue = values[:, : max(1, values.shape[1] // 4)].mean(axis=1)
    low, high = np.quantile(blue, _OPEN)
    open_ = values[(blue >= low) & (blue <= high)]
    return np.asarray(np.clip(open_.mean(axis=0) / spectrum[best], 0.0, 1.0))
