"""One page about a store, and short descriptions of datasets.

A store or a dataset comes in, HTML or text goes out. For the accessor and the command line.
"""
