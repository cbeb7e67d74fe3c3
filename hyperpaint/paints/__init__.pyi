from .band_ratios import (
    band_ratio as band_ratio,
    covariance as covariance,
)
from .car_views import join_views as join_views
from .detection import (
    detect as detect,
    detected_regions as detected_regions,
)
from .paint_libraries import (
    mix_paints as mix_paints,
    paint_colours as paint_colours,
    sample_paints as sample_paints,
    search_library as search_library,
    shade_paints as shade_paints,
    starter_library as starter_library,
)
from .signatures import extract_signatures as extract_signatures
