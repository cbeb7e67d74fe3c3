from .band_ratios import (
    band_ratio as band_ratio,
    covariance as covariance,
)
from .colours import paint_colours as paint_colours
from .detection import (
    detect as detect,
    detected_regions as detected_regions,
)
from .mixing import (
    mix_paints as mix_paints,
    sample_paints as sample_paints,
    shade_paints as shade_paints,
)
from .paint_search import search_library as search_library
from .signatures import extract_signatures as extract_signatures
from .starter_paints import starter_library as starter_library
