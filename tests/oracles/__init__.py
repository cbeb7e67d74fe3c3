"""Renderers and packages that hyperpaint is checked against."""
