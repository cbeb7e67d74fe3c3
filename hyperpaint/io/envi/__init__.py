"""ENVI cubes and their headers, read lazily and written.

A header or data file comes in, a lazy dataset goes out, and the other way round. Called by `flightline`,
`library`, `navigation` and users.
"""
