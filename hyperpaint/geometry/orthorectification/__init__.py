"""From a located flight line to a map, with the position in the line of every cell.

A located line comes in, a map on dask goes out; for workflows and the accessor. Files: `grids` (cells, and
the survey of all lines), `tiling` (pixel and values at a cell, the graph, and the variables of the map),
`mapping` (`orthorectify`).
"""
