"""Sun and sky by other programs: libRadtran, MODTRAN, 6S, CSV; each gives the Dataset of `sky_table`."""
