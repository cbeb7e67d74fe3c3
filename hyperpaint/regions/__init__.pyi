from .geojson import (
    read_regions as read_regions,
    regions_from as regions_from,
    write_regions as write_regions,
)
from .outlines import (
    Region as Region,
    Regions as Regions,
)
from .pixels_in_regions import (
    pixels as pixels,
    pixels_of as pixels_of,
    region_mask as region_mask,
)
from .proposals import (
    Proposals as Proposals,
    propose_regions as propose_regions,
)
