"""Figures, plots and the picker of regions.

Lines, libraries and results come in, matplotlib axes and PNG files go out. For reports, workflows and the
accessor.
"""
