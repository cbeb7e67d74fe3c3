"""Benchmarks of hyperpaint, each with its floor beside it."""
