from .counts_to_reflectance import (
    Panel as Panel,
    radiance as radiance,
    reflectance as reflectance,
)
from .spectral_axis import (
    at as at,
    smooth as smooth,
    to_nominal as to_nominal,
)
from .uncertainty import (
    estimate_noise as estimate_noise,
    mean_uncertainty as mean_uncertainty,
)
