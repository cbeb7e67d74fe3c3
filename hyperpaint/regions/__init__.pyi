from .polygons import (
    Region as Region,
    Regions as Regions,
    pixels as pixels,
    pixels_of as pixels_of,
    read_regions as read_regions,
    region_mask as region_mask,
    regions_from as regions_from,
    write_regions as write_regions,
)
from .proposals import (
    Proposals as Proposals,
    propose_regions as propose_regions,
)
