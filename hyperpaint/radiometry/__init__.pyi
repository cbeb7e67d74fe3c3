from .counts_to_reflectance import (
    panel_closure as panel_closure,
    radiance as radiance,
    reflectance as reflectance,
    slab as slab,
    white_reference as white_reference,
)
from .panels import Panel as Panel, panel_factor as panel_factor
from .pixel_reading import coarse as coarse, pixels as pixels
from .spectral_axis import (
    at as at,
    smooth as smooth,
    to_nominal as to_nominal,
)
from .uncertainty import (
    estimate_noise as estimate_noise,
    mean_uncertainty as mean_uncertainty,
)
