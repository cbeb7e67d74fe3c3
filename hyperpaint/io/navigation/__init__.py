"""Navigation of any format as one dataset whose conventions are declared; control points; clocks."""
