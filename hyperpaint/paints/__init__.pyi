from .band_ratios import (
    band_ratio as band_ratio,
    covariance as covariance,
)
from .detection import (
    detect as detect,
    detected_regions as detected_regions,
)
from .mixing import (
    mix_paints as mix_paints,
    sample_paints as sample_paints,
    shade_paints as shade_paints,
)
from .mixing.synthetic_paints import starter_library as starter_library
from .paint_search import paint_colours as paint_colours, search_library as search_library
from .signatures import extract_signatures as extract_signatures
