"""The same flags on a cluster of processes as on threads."""

from typing import Any

import numpy as np
import pytest
from support.analytic_scenes import as_line, bonnet, smooth_edge, wavelengths

import hyperpaint as hp
from hyperpaint.surroundings.flags import LAYERS


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_a_cluster_finds_the_same_flags(two_workers: Any) -> None:
    nm = wavelengths()
    cube, _ = bonnet(nm, smooth_edge(nm, 600.0, 0.04, 0.6))
    line = as_line(cube, nm, snr=100.0)
    first = hp.surroundings.flag(line, sun_zenith=30.0).compute(scheduler="synchronous")
    with two_workers.as_current():
        other = hp.surroundings.flag(line.chunk(along_track=64), sun_zenith=30.0).compute()
    for name in (*LAYERS, "quality"):
        np.testing.assert_array_equal(first[name].values, other[name].values)
