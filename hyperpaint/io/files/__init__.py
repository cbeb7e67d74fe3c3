"""Reading and writing shared by all formats.

In: paths, patterns and limits. Out: bytes and texts of bounded size, checked TOML tables, files that are
written completely or not at all. Called by every room of io and by workflows.
"""
