"""Fault campaigns: damage made on purpose, counted against what the package notices."""
