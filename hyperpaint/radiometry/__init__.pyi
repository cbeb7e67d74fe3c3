from .bands import (
    at as at,
    to_nominal as to_nominal,
)
from .counts_to_reflectance import (
    Panel as Panel,
    radiance as radiance,
    reflectance as reflectance,
)
from .smoothing import smooth as smooth
from .uncertainty import (
    estimate_noise as estimate_noise,
    mean_uncertainty as mean_uncertainty,
)
