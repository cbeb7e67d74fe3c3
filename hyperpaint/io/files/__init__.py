"""What readers and writers of every format share.

In: paths, patterns and limits. Out: bytes and texts of bounded size, checked TOML tables, files that appear
whole or not at all. Called by every room of io and by workflows.
"""
