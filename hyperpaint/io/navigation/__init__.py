"""Navigation of any format as one dataset with declared conventions; control points; clocks."""
