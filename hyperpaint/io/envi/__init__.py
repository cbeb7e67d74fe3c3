"""ENVI cubes and their headers, read lazily and written.

A header or data file comes in, a lazy dataset goes out; or a dataset comes in and an ENVI cube goes out.
Called by `flightline`, `library`, `navigation` and users.
"""
