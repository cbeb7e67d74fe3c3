from .geojson import (
    Region as Region,
    Regions as Regions,
    read_regions as read_regions,
    regions_from as regions_from,
    write_regions as write_regions,
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
