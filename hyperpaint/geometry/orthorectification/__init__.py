"""From a located flight line to a map, with the place of every cell in the line.

Rooms: `grids` (how cells lie on the map), `surveys` (the one look at all lines that comes first), `indexing`
(which place of the line lies at a cell), `resampling` (values of a tile), `tiling` (the graph), `carrying`
(what comes along, under which name), `mapping` (`orthorectify`), `reporting` (what a map covers).
"""

from .grids import MapGrid
from .mapping import orthorectify
from .reporting import map_report

__all__ = ["MapGrid", "map_report", "orthorectify"]
