"""From a located flight line to a map, with the place of every cell in the line.

A located line comes in, a map on dask goes out; for workflows and the accessor. Files: `grids` (how cells
lie, and the one look at all lines that comes first), `indexing` (which place of the line lies at a cell, and
its values), `tiling` (the graph, and what comes along under which name), `mapping` (`orthorectify`).
"""

from .grids import MapGrid
from .mapping import map_report, orthorectify

__all__ = ["MapGrid", "map_report", "orthorectify"]
